"""A client that does nothing by itself: what it sends and what it receives are bytes to look at."""

from __future__ import annotations

import contextlib
import itertools
import socket
import struct
from typing import Any

from appliance_process import BrokerProcess

from appliance.mqtt.packets import Connect, Packet, Pingreq, Pingresp, decode_packet


class RawClient:
    """A connection on which nothing was sent yet; `version` is 4 (3.1.1) or 5."""

    def __init__(self, broker: BrokerProcess, version: int, *, tls: bool = False) -> None:
        self.broker = broker
        self.version = version
        self.socket = self.open(tls=tls)
        self.packet_ids = itertools.count(1)
        self._buffer = b""

    def open(self, *, tls: bool) -> socket.socket:
        """A new connection, with nothing sent on it."""
        return self.broker.open(tls=tls)

    def __enter__(self) -> RawClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    @property
    def address(self) -> str:
        """As the broker's log has it."""
        host, port = self.socket.getsockname()[:2]
        return f"{host}:{port}"

    def connect(
        self,
        client_id: str,
        user: str | None = "alice",
        password: str | None = None,
        *,
        clean: bool = True,
        **fields: Any,
    ) -> bytes:
        """Send CONNECT, with the user's right password unless another is given; the answer."""
        packet = self.connect_packet(client_id, user, password, clean=clean, **fields)
        self.socket.sendall(packet)
        return self.receive()

    def connect_packet(
        self,
        client_id: str,
        user: str | None = "alice",
        password: str | None = None,
        *,
        clean: bool = True,
        **fields: Any,
    ) -> bytes:
        if password is None and user is not None:
            password = self.broker.passwords[user]
        secret = None if password is None else password.encode()
        connect = Connect(
            client_id,
            clean_start=clean,
            version=self.version,
            username=user,
            password=secret,
            **fields,
        )
        return connect.encode()

    def send(self, *packets: Packet) -> None:
        self.socket.sendall(b"".join(packet.encode(self.version) for packet in packets))

    def receive(self) -> bytes:
        """The next packet; b"" when the broker has closed the connection."""
        while (size := _packet_size(self._buffer)) is None or len(self._buffer) < size:
            data = self.socket.recv(65536)
            if not data:
                assert not self._buffer
                return b""
            self._buffer += data
        packet, self._buffer = self._buffer[:size], self._buffer[size:]
        return packet

    def decode(self, data: bytes) -> Packet:
        """The packet that these bytes are."""
        start = next(index for index in range(1, 5) if data[index] < 0x80) + 1
        return decode_packet(data[0], data[start:], self.version)

    def drain(self) -> list[Packet]:
        """All that the broker has for the client up to now, and that the connection is there."""
        self.send(Pingreq())
        received: list[Packet] = []
        while True:
            data = self.receive()
            assert data, f"the connection is closed; received before: {received}"
            packet = self.decode(data)
            if isinstance(packet, Pingresp):
                return received
            received.append(packet)

    def kill(self) -> None:
        """Be gone without a word."""
        with contextlib.suppress(OSError):
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.socket.close()


def _packet_size(data: bytes) -> int | None:
    """Bytes of the packet that begins here, None when there are too few to tell."""
    length = 0
    for index, byte in enumerate(data[1:5]):
        length |= (byte & 0x7F) << 7 * index
        if byte < 0x80:
            return 2 + index + length
    return None
