"""The packets, against annotated bytes from the standard: tests/vectors/mqtt-*.txt."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from appliance.mqtt import packets
from appliance.mqtt.codec import PROPERTY_RULES, PacketType, Property
from appliance.mqtt.packets import (
    Auth,
    Connack,
    Connect,
    Disconnect,
    Puback,
    Publish,
    Suback,
    Subscribe,
    Subscription,
    Unsuback,
    Unsubscribe,
    Will,
    decode_packet,
)
from appliance.mqtt.reason import ProtocolError, ReasonCode

VECTORS = Path(__file__).parent.parent / "vectors"
NAMES = {name: getattr(packets, name) for name in packets.__all__}
NAMES |= {"P": Property, "R": ReasonCode}


@dataclass
class Vector:
    name: str
    version: int
    verb: str = ""
    value: str = ""
    cuts: list[int] = field(default_factory=list)
    wire: bytes = b""

    @property
    def first_byte(self) -> int:
        return self.wire[0]

    @property
    def body(self) -> bytes:
        return self.wire[self._header_length() :]

    def _header_length(self) -> int:
        length = 1
        while self.wire[length] & 0x80:
            length += 1
        return length + 1

    def check_remaining_length(self) -> None:
        digits = self.wire[1 : self._header_length()]
        remaining = sum((digit & 0x7F) << 7 * place for place, digit in enumerate(digits))
        assert remaining == len(self.body), f"the vector {self.name!r} is mistyped"

    def packet(self) -> packets.Packet:
        return eval(self.value, dict(NAMES))

    def decode(self) -> packets.Packet:
        return decode_packet(self.first_byte, self.body, self.version)


def read_vectors(path: Path, version: int) -> list[Vector]:
    vectors: list[Vector] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("== "):
            vectors.append(Vector(line[3:], version))
        elif vectors and line:
            vector = vectors[-1]
            directive = re.match(r"(is|reads|fails|cut): (.*)", line)
            if directive is None:
                vector.wire += read_hex(line.partition("|")[0])
            elif directive[1] == "cut":
                for part in directive[2].split():
                    low, _, high = part.partition("..")
                    vector.cuts += range(int(low), int(high or low) + 1)
            else:
                vector.verb, vector.value = directive[1], directive[2]
    return vectors


def read_hex(text: str) -> bytes:
    out = b""
    for token in text.split():
        byte, _, times = token.partition("*")
        out += bytes.fromhex(byte) * int(times or 1)
    return out


ALL = [
    *read_vectors(VECTORS / "mqtt-3.1.txt", 4),
    *read_vectors(VECTORS / "mqtt-3.1.1.txt", 4),
    *read_vectors(VECTORS / "mqtt-5.0.txt", 5),
]
GOOD = [vector for vector in ALL if vector.verb in ("is", "reads")]
EXACT = [vector for vector in ALL if vector.verb == "is"]
BAD = [vector for vector in ALL if vector.verb == "fails"]


def each(vectors):
    ids = [f"v{vector.version} {vector.name}" for vector in vectors]
    return pytest.mark.parametrize("vector", vectors, ids=ids)


@each(ALL)
def test_vector_is_well_typed(vector):
    assert vector.verb in ("is", "reads", "fails")
    vector.check_remaining_length()


@each(GOOD)
def test_decode(vector):
    packet = vector.decode()
    assert packet == vector.packet()
    assert vector.first_byte >> 4 == packet.TYPE
    assert packet.TYPE.name in str(packet)


@each(EXACT)
def test_encode(vector):
    assert vector.packet().encode(vector.version) == vector.wire


@each(BAD)
def test_refused(vector):
    with pytest.raises(ProtocolError) as caught:
        vector.decode()
    assert caught.value.code.name == vector.value


@each(GOOD)
def test_cut_at_each_byte(vector):
    body = vector.body
    for length in range(len(body)):
        if length in vector.cuts:
            shorter = decode_packet(vector.first_byte, body[:length], vector.version)
            assert vector.first_byte >> 4 == shorter.TYPE
        else:
            with pytest.raises(ProtocolError):
                decode_packet(vector.first_byte, body[:length], vector.version)


@each(GOOD)
def test_trailing_data(vector):
    # 0xFF is no reason code, no property and not the beginning of a string that short.
    if isinstance(vector.packet(), Publish):
        longer = decode_packet(vector.first_byte, vector.body + b"\xff", vector.version)
        assert longer.payload == vector.packet().payload + b"\xff"
    else:
        with pytest.raises(ProtocolError):
            decode_packet(vector.first_byte, vector.body + b"\xff", vector.version)


@each(GOOD)
def test_reserved_flags(vector):
    if isinstance(vector.packet(), Publish):
        return
    for flags in set(range(16)) - {vector.first_byte & 0x0F}:
        with pytest.raises(ProtocolError) as caught:
            decode_packet(vector.first_byte & 0xF0 | flags, vector.body, vector.version)
        assert caught.value.code is ReasonCode.MALFORMED_PACKET


def test_vectors_are_complete():
    types = {(vector.version, vector.first_byte >> 4) for vector in EXACT}
    assert types == {(4, kind) for kind in range(1, 15)} | {(5, kind) for kind in range(1, 16)}
    shown = {
        (owner, identifier)
        for vector in EXACT
        for packet in [vector.packet()]
        for owner, holder in [(packet.TYPE, packet), (0, getattr(packet, "will", None))]
        for identifier in getattr(holder, "properties", None) or {}
    }
    assert {identifier for _, identifier in shown} == set(Property)
    # And each with each of its owners, but for some of the reason strings and user properties.
    common = (Property.REASON_STRING, Property.USER_PROPERTY)
    for identifier, rule in PROPERTY_RULES.items():
        if identifier not in common:
            assert rule.owners == {owner for owner, held in shown if held == identifier}


def reason_codes(packet_type: PacketType, version: int) -> list[int]:
    """The reason codes that the decoder of a packet type lets through."""
    method = b"\x04\x15\x00\x01m"
    bodies = {
        PacketType.CONNACK: (b"\x00", b"\x00" if version == 5 else b""),
        PacketType.SUBACK: (b"\x00\x01\x00" if version == 5 else b"\x00\x01", b""),
        PacketType.UNSUBACK: (b"\x00\x01\x00", b""),
        PacketType.DISCONNECT: (b"", b""),
        PacketType.AUTH: (b"", method),
    }
    before, after = bodies.get(packet_type, (b"\x00\x01", b""))
    flags = 2 if packet_type is PacketType.PUBREL else 0
    found = []
    for code in range(256):
        body = before + bytes([code]) + after
        try:
            decode_packet(packet_type << 4 | flags, body, version)
        except ProtocolError as error:
            assert error.code is ReasonCode.PROTOCOL_ERROR
        else:
            found.append(code)
    return found


# The reason code tables of 5.0, sections 3.2.2.2 to 3.15.2.1 (and 2.4 for 8c in DISCONNECT).
@pytest.mark.parametrize(
    ("packet_type", "codes"),
    [
        (
            "CONNACK",
            "00 80 81 82 83 84 85 86 87 88 89 8a 8c 90 95 97 99 9a 9b 9c 9d 9f",
        ),
        ("PUBACK", "00 10 80 83 87 90 91 97 99"),
        ("PUBREC", "00 10 80 83 87 90 91 97 99"),
        ("PUBREL", "00 92"),
        ("PUBCOMP", "00 92"),
        ("SUBACK", "00 01 02 80 83 87 8f 91 97 9e a1 a2"),
        ("UNSUBACK", "00 11 80 83 87 8f 91"),
        (
            "DISCONNECT",
            "00 04 80 81 82 83 87 89 8b 8c 8d 8e 8f 90 93 94 95 96 97 98 99 9a 9b 9c 9d 9e 9f"
            " a0 a1 a2",
        ),
        ("AUTH", "00 18 19"),
    ],
)
def test_reason_codes_of_a_packet(packet_type, codes):
    assert reason_codes(PacketType[packet_type], 5) == list(bytes.fromhex(codes))


def test_return_codes_of_3_1_1():
    assert reason_codes(PacketType.CONNACK, 4) == [0, 1, 2, 3, 4, 5]
    assert reason_codes(PacketType.SUBACK, 4) == [0, 1, 2, 0x80]


def test_3_1_1_leaves_out_what_it_cannot_say():
    properties = {Property.USER_PROPERTY: [("k", "v")]}
    assert Connack(False, ReasonCode.BANNED, properties).encode(4) == b"\x20\x02\x00\x05"
    assert Publish("t", b"", properties=properties).encode(4) == b"\x30\x03\x00\x01t"
    assert Puback(1, ReasonCode.NOT_AUTHORIZED, properties).encode(4) == b"\x40\x02\x00\x01"
    subscription = Subscription("a", 1, True, True, 2)
    subscribe = Subscribe(1, [subscription], properties)
    assert subscribe.encode(4) == b"\x82\x06\x00\x01\x00\x01a\x01"
    suback = Suback(1, [ReasonCode.NOT_AUTHORIZED, 2], properties)
    assert suback.encode(4) == b"\x90\x04\x00\x01\x80\x02"
    assert Unsubscribe(1, ["a"], properties).encode(4) == b"\xa2\x05\x00\x01\x00\x01a"
    assert Unsuback(1, [0x11], properties).encode(4) == b"\xb0\x02\x00\x01"
    assert Disconnect(ReasonCode.SERVER_BUSY, properties).encode(4) == b"\xe0\x00"


@pytest.mark.parametrize(
    ("packet", "version"),
    [
        (Publish("t", b"", qos=3, packet_id=1), 5),
        (Publish("t", b"", qos=1), 5),
        (Publish("t", b"", qos=1, packet_id=0), 5),
        (Publish("t", b"", dup=True), 5),
        (Publish("t\0", b""), 4),
        (Publish("t", bytes(268_435_456)), 4),
        (Puback(65_536), 5),
        (Subscribe(1, [Subscription("a", qos=3)]), 4),
        (Subscribe(1, [Subscription("a", retain_handling=3)]), 5),
        (Connect("c", password=b"pw", version=4), 4),
        (Connect("c", keep_alive=65_536), 5),
        (Connect("c", will=Will("w", b"", qos=3)), 5),
        (Connect("c", will=Will("w", bytes(65_536))), 5),
        (Auth(), 4),
    ],
    ids=str,
)
def test_what_cannot_be_encoded(packet, version):
    with pytest.raises(ValueError, match=r"\w"):
        packet.encode(version)


def test_connect_brings_its_own_version():
    for version in (4, 5):
        wire = Connect("c", version=version).encode()
        for argument in (0, 4, 5):
            assert decode_packet(wire[0], wire[2:], argument).version == version


def test_logs_show_no_secret_and_no_line_break():
    data = {Property.AUTHENTICATION_METHOD: "m", Property.AUTHENTICATION_DATA: b"secret"}
    packets_with_secrets = [
        Connect("c\n", username="u\n", password=b"secret", properties=data),
        Connect("c", will=Will("w\n", b"secret")),
        Connack(properties=data),
        Auth(0x18, data),
        Publish("t\n", b"secret"),
        Subscribe(1, [Subscription("a\n")]),
        Unsubscribe(1, ["a\n"]),
    ]
    for packet in packets_with_secrets:
        for text in (str(packet), repr(packet)):
            assert "secret" not in text
            assert "\n" not in text


def test_log_lines_are_short():
    long = "x" * 60_000
    for packet in [
        Connect(long, username=long, will=Will(long, b"")),
        Publish(long, b""),
        Subscribe(1, [Subscription(long)] * 1000),
        Unsubscribe(1, [long] * 1000),
        Suback(1, [0x80] * 1000),
        Unsuback(1, [0x80] * 1000),
    ]:
        assert len(str(packet)) < 700
    assert str(Puback(7)) == "PUBACK id=7 success"
    assert str(Puback(7, 0x7F)) == "PUBACK id=7 0x7f"
    assert str(Disconnect()) == "DISCONNECT normal_disconnection"
    assert str(Subscribe(7, [Subscription("a", 1)] * 6)).endswith("'a' qos=1 and 1 more")
    assert str(Publish("t", b"abc", 1, packet_id=3)) == (
        "PUBLISH 't' 3 bytes qos=1 retain=0 dup=0 id=3"
    )
