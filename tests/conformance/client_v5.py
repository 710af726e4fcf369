"""A client of MQTT 5.0 that says bytes and hears bytes; client_v311.py explains the notation."""

from __future__ import annotations

import client_v311
from client_v311 import CLEAN_SESSION, PASSWORD, USER_NAME, WILL, WILL_RETAIN, Wire, field
from client_v311 import Dial as Dial
from client_v311 import owed as owed
from client_v311 import packet as packet
from client_v311 import wire as wire

from appliance.broker.broker import Broker

CLEAN_START = CLEAN_SESSION

#: What a client hears that asked for nothing special: Topic Alias Maximum 10, Receive Maximum 20.
ACCEPTED = bytes.fromhex("20 09 00 00 06 22 000a 21 0014")
SESSION_PRESENT = bytes.fromhex("20 09 01 00 06 22 000a 21 0014")

__all__ = [
    "ACCEPTED",
    "CLEAN_START",
    "PASSWORD",
    "SESSION_PRESENT",
    "USER_NAME",
    "WILL",
    "WILL_RETAIN",
    "Client",
    "Wire",
    "connack",
    "connect",
    "disconnect",
    "field",
    "is_closed",
    "joined",
    "packet",
    "properties",
    "publish",
    "turned_away",
    "wire",
]


def properties(*items: Wire) -> bytes:
    """These properties, with their length before them."""
    body = b"".join(map(wire, items))
    assert len(body) < 0x80, "a length of one byte is enough for a test"
    return bytes((len(body),)) + body


def connect(
    *payload: bytes | str,
    flags: int = CLEAN_START,
    keep_alive: int = 0,
    props: bytes = b"\0",
    name: bytes | str = "MQTT",
    version: int = 5,
) -> bytes:
    """CONNECT with this payload: a string as a field with its length, bytes as they are."""
    header = field(name) + bytes((version, flags)) + keep_alive.to_bytes(2, "big") + props
    return packet(0x10, header, *[field(p) if isinstance(p, str) else p for p in payload])


def connack(code: int) -> bytes:
    """The CONNACK of a refusal, in which nothing else is said."""
    return bytes((0x20, 3, 0, code, 0))


def disconnect(code: int) -> bytes:
    """A DISCONNECT in which nothing else is said."""
    return bytes((0xE0, 1, code))


def publish(
    topic: bytes | str,
    payload: bytes = b"",
    qos: int = 0,
    packet_id: int = 1,
    *,
    props: bytes = b"\0",
    retain: bool = False,
    dup: bool = False,
) -> bytes:
    """PUBLISH; the packet identifier is there when the QoS is not 0."""
    identifier = packet_id.to_bytes(2, "big") if qos else b""
    return packet(0x30 | dup << 3 | qos << 1 | retain, field(topic), identifier, props, payload)


class Client(client_v311.Client):
    """One connection, which the broker knows nothing of yet."""

    def __init__(self, broker: Broker) -> None:
        super().__init__(broker)
        self.version = 5


def joined(broker: Broker, client_id: str = "client", **options: object) -> Client:
    """A client that was accepted; what came behind its CONNACK is not heard yet."""
    client = Client(broker)
    assert client.connect(client_id, **options).reason_code == 0
    return client


def turned_away(client: Client, *packets: Wire) -> bool:
    """Whether the connection is closed upon these first packets, and nobody asked who that is.

    The standard leaves it to the server to say why in a CONNACK, or to say nothing (section 4.13).
    """
    heard = client.say(*packets)
    is_refusal = len(heard) == 5 and heard[3] >= 0x80 and heard == connack(heard[3])
    return client.closed and client.transport.asked is None and (not heard or is_refusal)


def is_closed(client: Client, code: int, *packets: Wire) -> bool:
    """Whether the connection is closed upon these packets, with this reason or without a word.

    That it is closed is what the standard asks for; it also should be told why (section 4.13.1).
    """
    heard = client.say(*packets)
    return client.closed and heard in (b"", disconnect(code))
