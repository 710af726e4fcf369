"""A client of MQTT 3.1.1 that says bytes and hears bytes.

Packets are written as they are on the wire, as hex with spaces where a field ends:
`82 06 0001 0001 61 00` is SUBSCRIBE, 6 bytes, packet id 1, the filter `a`, QoS 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from broker.conftest import Peer
from raw_client import RawClient

from appliance.broker.broker import Broker

#: A packet as bytes or as hex; spaces in it mean nothing.
Wire: TypeAlias = "bytes | str"

#: Makes connections that nothing was said on yet.
Dial: TypeAlias = Callable[[], RawClient]

ACCEPTED = bytes.fromhex("20 02 00 00")
SESSION_PRESENT = bytes.fromhex("20 02 01 00")

CLEAN_SESSION = 0x02
WILL = 0x04
WILL_RETAIN = 0x20
PASSWORD = 0x40
USER_NAME = 0x80


def wire(packet: Wire) -> bytes:
    """The packet as bytes."""
    return bytes.fromhex(packet) if isinstance(packet, str) else packet


def field(value: bytes | str) -> bytes:
    """A string or binary field, with its length before it."""
    data = value.encode() if isinstance(value, str) else value
    return len(data).to_bytes(2, "big") + data


def packet(first: int, *parts: bytes) -> bytes:
    """A packet, with its remaining length behind the first byte."""
    body = b"".join(parts)
    size = len(body)
    length = bytearray()
    while size > 0x7F:
        length.append(size & 0x7F | 0x80)
        size >>= 7
    return bytes((first, *length, size)) + body


def connect(
    *fields: bytes | str,
    flags: int = CLEAN_SESSION,
    keep_alive: int = 0,
    name: bytes | str = "MQTT",
    level: int = 4,
) -> bytes:
    """CONNECT with these fields as its payload, whether the flags ask for them or not."""
    header = field(name) + bytes((level, flags)) + keep_alive.to_bytes(2, "big")
    return packet(0x10, header, *map(field, fields))


class Client(Peer):
    """One connection, which the broker knows nothing of yet."""

    def __init__(self, broker: Broker) -> None:
        super().__init__(broker, 4)
        self.user: str | None = "user"

    @property
    def closed(self) -> bool:
        """Whether the broker has closed the connection."""
        return self.transport.closed

    def say(self, *packets: Wire) -> bytes:
        """Send the packets in one chunk; returns all that was heard since the last look."""
        self.send(*map(wire, packets))
        return self.hear()

    def hear(self) -> bytes:
        """What has come since the last look."""
        heard = bytes(self.transport.written)
        self.transport.written.clear()
        return heard

    def log_in(self, connect: bytes, user: str | None = "user") -> bytes:
        """Say CONNECT, as somebody with the right password; returns all that was heard."""
        self.user = user
        assert self.say(connect) == b"", "answered before it is known who that is"
        self.let_in()
        return self.hear()


def joined(broker: Broker, client_id: str = "client", **options: object) -> Client:
    """A client that was accepted; what came behind its CONNACK is not heard yet."""
    client = Client(broker)
    assert client.connect(client_id, **options).reason_code == 0
    return client


def owed(client: Client, count: int) -> Client:
    """The client; it has been sent so many messages of QoS 2, and has answered none of them."""
    client.subscribe("a", 2)
    sender = joined(client.broker, "sender")
    for _ in range(count):
        sender.publish("a", b"x", 2)
    client.hear()
    return client


def refused(client: Client, *packets: Wire) -> bool:
    """Whether the broker closes the connection upon these packets, and without a word."""
    return client.say(*packets) == b"" and client.closed
