"""Which version of MQTT each server is spoken to in: pure."""

from __future__ import annotations

from typing import Final

from appliance.mqtt.codec import V5, V311

#: When a server answers so many CONNECTs of MQTT 5 in a row by closing, the next one is of 3.1.1.
CLOSED_ON: Final = 2


class ServerVersions:
    """MQTT 5 where it is wanted, and 3.1.1 where the server does not know 5; servers by position.

    A server that says so in CONNACK is believed for good. Some old ones close the connection
    without a word; but so do proxies whose broker is down, and many others. Therefore, when that
    has happened twice in a row, one connection is tried with 3.1.1, at once, so that little else
    can have changed in between. If it is answered, that holds for this connection: the next one
    begins with MQTT 5 again, and needs to be closed once to go on with 3.1.1.
    """

    def __init__(self, wanted: int) -> None:
        self._wanted = wanted
        self._old: set[int] = set()
        self._closed: dict[int, int] = {}

    def of(self, server: int) -> int:
        """The version for the next connection to a server."""
        if server in self._old or self._closed.get(server, 0) >= CLOSED_ON:
            return V311
        return self._wanted

    def refused(self, server: int) -> None:
        """The server has said that it does not know MQTT 5."""
        self._old.add(server)

    def closed(self, server: int, version: int) -> bool:
        """The server has closed the connection without CONNACK; whether to try 3.1.1 at once."""
        if version != V5:
            self.failed(server)
            return False
        self._closed[server] = self._closed.get(server, 0) + 1
        return self._closed[server] >= CLOSED_ON

    def failed(self, server: int) -> None:
        """The dial failed, or the connection ended in another way, before the server said anything.

        If that was the one connection with 3.1.1, it has shown nothing, and the next one is of
        MQTT 5 again.
        """
        if self._closed.get(server, 0) >= CLOSED_ON:
            del self._closed[server]

    def answered(self, server: int, version: int) -> None:
        """The server has answered CONNECT: it knows this version, even if it refuses the login."""
        if version == V5:
            self._closed.pop(server, None)
        elif server in self._closed:
            self._closed[server] = CLOSED_ON - 1
