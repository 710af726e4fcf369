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
    can have changed in between. If it is accepted, that holds for this connection: the next one
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
            self._closed.pop(server, None)  # that was not the reason
            return False
        self._closed[server] = self._closed.get(server, 0) + 1
        return self._closed[server] >= CLOSED_ON

    def accepted(self, server: int, version: int) -> None:
        """The server has accepted a connection."""
        if version == V5:
            self._closed.pop(server, None)
        elif server in self._closed:
            self._closed[server] = CLOSED_ON - 1
