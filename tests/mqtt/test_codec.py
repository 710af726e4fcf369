"""The data types and the property table of MQTT."""

from __future__ import annotations

import pytest

from appliance.mqtt import codec
from appliance.mqtt.codec import WILL, PacketType, Property
from appliance.mqtt.reason import ProtocolError, ReasonCode, connack_v5, connack_v311


def refused(code, decode, *arguments):
    with pytest.raises(ProtocolError) as caught:
        decode(*arguments)
    assert caught.value.code is code
    assert str(caught.value)


# Table 1-1 of 5.0 section 1.5.5 (table 2.4 of 3.1.1).
@pytest.mark.parametrize(
    ("value", "wire"),
    [
        (0, "00"),
        (127, "7f"),
        (128, "80 01"),
        (16_383, "ff 7f"),
        (16_384, "80 80 01"),
        (2_097_151, "ff ff 7f"),
        (2_097_152, "80 80 80 01"),
        (268_435_455, "ff ff ff 7f"),
    ],
)
def test_varint(value, wire):
    wire = bytes.fromhex(wire)
    assert codec.encode_varint(value) == wire
    assert codec.decode_varint(b"\xff" + wire + b"\x00", 1) == (value, 1 + len(wire))
    for length in range(len(wire)):
        refused(ReasonCode.MALFORMED_PACKET, codec.decode_varint, wire[:length], 0)


@pytest.mark.parametrize("value", [-1, 268_435_456])
def test_varint_out_of_range(value):
    with pytest.raises(ValueError, match="Variable Byte Integer"):
        codec.encode_varint(value)


@pytest.mark.parametrize("wire", ["80 00", "ff 80 00", "80 80 80 00", "80 80 80 80 01"])
def test_varint_longer_than_it_needs_to_be(wire):
    refused(ReasonCode.MALFORMED_PACKET, codec.decode_varint, bytes.fromhex(wire), 0)


@pytest.mark.parametrize(
    ("value", "wire"),
    [
        ("", "00 00"),
        ("MQTT", "00 04 4d 51 54 54"),
        ("A\U0002a6d4", "00 05 41 f0 aa 9b 94"),  # The example of section 1.5.3.
        ("\ufeffx", "00 04 ef bb bf 78"),
        ("\x01\x7f\ufffe", "00 05 01 7f ef bf be"),
    ],
)
def test_string(value, wire):
    wire = bytes.fromhex(wire)
    assert codec.encode_string(value) == wire
    assert codec.decode_string(b"\xff" + wire + b"\xff", 1) == (value, 1 + len(wire))
    for length in range(len(wire)):
        refused(ReasonCode.MALFORMED_PACKET, codec.decode_string, wire[:length], 0)


@pytest.mark.parametrize(
    "wire",
    [
        "00 01 00",  # U+0000
        "00 03 61 00 62",
        "00 02 c0 80",  # U+0000 in two bytes
        "00 03 ed a0 80",  # U+D800
        "00 03 ed bf bf",  # U+DFFF
        "00 02 c0 af",  # "/" in two bytes
        "00 04 f4 90 80 80",  # beyond U+10FFFF
        "00 01 80",
        "00 01 ff",
    ],
)
def test_string_that_is_not_one(wire):
    refused(ReasonCode.MALFORMED_PACKET, codec.decode_string, bytes.fromhex(wire), 0)


@pytest.mark.parametrize("value", ["a\0b", "\ud800", "x" * 65_536, "ä" * 32_768])
def test_string_that_cannot_be_encoded(value):
    with pytest.raises(ValueError, match=r"U\+0000|surrogates|two bytes"):
        codec.encode_string(value)


def test_binary():
    value = bytes(range(256)) * 255 + bytes(255)
    wire = codec.encode_binary(value)
    assert wire == b"\xff\xff" + value
    assert codec.decode_binary(wire + b"x", 0) == (value, 65_537)
    refused(ReasonCode.MALFORMED_PACKET, codec.decode_binary, wire[:-1], 0)
    with pytest.raises(ValueError, match="65536 bytes"):
        codec.encode_binary(value + b"x")


def test_integers():
    assert codec.encode_uint16(0xABCD) == b"\xab\xcd"
    assert codec.decode_uint16(b"\x00\xab\xcd", 1) == (0xABCD, 3)
    assert codec.encode_uint32(0xABCDEF01) == b"\xab\xcd\xef\x01"
    assert codec.decode_uint32(b"\x00\xab\xcd\xef\x01", 1) == (0xABCDEF01, 5)
    for encode, value in [(codec.encode_uint16, 1 << 16), (codec.encode_uint32, 1 << 32)]:
        with pytest.raises(ValueError, match="does not fit"):
            encode(value)
        with pytest.raises(ValueError, match="does not fit"):
            encode(-1)


# Table 2-4 of 5.0 section 2.2.2.2, typed again: identifier, type, and who may hold it.
TABLE = """
    0x01 BYTE        PUBLISH WILL
    0x02 FOUR_BYTE   PUBLISH WILL
    0x03 STRING      PUBLISH WILL
    0x08 STRING      PUBLISH WILL
    0x09 BINARY      PUBLISH WILL
    0x0B VARINT      PUBLISH SUBSCRIBE
    0x11 FOUR_BYTE   CONNECT CONNACK DISCONNECT
    0x12 STRING      CONNACK
    0x13 TWO_BYTE    CONNACK
    0x15 STRING      CONNECT CONNACK AUTH
    0x16 BINARY      CONNECT CONNACK AUTH
    0x17 BYTE        CONNECT
    0x18 FOUR_BYTE   WILL
    0x19 BYTE        CONNECT
    0x1A STRING      CONNACK
    0x1C STRING      CONNACK DISCONNECT
    0x1F STRING      CONNACK PUBACK PUBREC PUBREL PUBCOMP SUBACK UNSUBACK DISCONNECT AUTH
    0x21 TWO_BYTE    CONNECT CONNACK
    0x22 TWO_BYTE    CONNECT CONNACK
    0x23 TWO_BYTE    PUBLISH
    0x24 BYTE        CONNACK
    0x25 BYTE        CONNACK
    0x26 STRING_PAIR CONNECT CONNACK PUBLISH WILL PUBACK PUBREC PUBREL PUBCOMP SUBSCRIBE SUBACK \
                     UNSUBSCRIBE UNSUBACK DISCONNECT AUTH
    0x27 FOUR_BYTE   CONNECT CONNACK
    0x28 BYTE        CONNACK
    0x29 BYTE        CONNACK
    0x2A BYTE        CONNACK
"""
ROWS = [line.split() for line in TABLE.strip().splitlines()]
OWNERS = [WILL, *PacketType]
SAMPLES = {
    "BYTE": (1, b"\x01"),
    "TWO_BYTE": (258, b"\x01\x02"),
    "FOUR_BYTE": (16_909_060, b"\x01\x02\x03\x04"),
    "VARINT": ([300], b"\xac\x02"),
    "STRING": ("ab", b"\x00\x02ab"),
    "BINARY": (b"\x00\xff", b"\x00\x02\x00\xff"),
    "STRING_PAIR": ([("a", "b")], b"\x00\x01a\x00\x01b"),
}


def test_the_table_is_complete():
    assert len(ROWS) == 27
    assert {int(row[0], 16) for row in ROWS} == set(Property) == set(codec.PROPERTY_RULES)


@pytest.mark.parametrize("row", ROWS, ids=[Property(int(row[0], 16)).name for row in ROWS])
@pytest.mark.parametrize("owner", OWNERS)
def test_property(row, owner):
    identifier = Property(int(row[0], 16))
    value, raw = SAMPLES[row[1]]
    wire = bytes([identifier]) + raw
    allowed = {WILL if name == "WILL" else PacketType[name] for name in row[2:]}
    section = bytes([len(wire)]) + wire
    if owner not in allowed:
        arguments = (section, 0, len(section), owner)
        refused(ReasonCode.MALFORMED_PACKET, codec.decode_properties, *arguments)
        return
    assert codec.encode_properties({identifier: value}) == section
    decoded = codec.decode_properties(b"\xff" + section + b"\xff", 1, len(section) + 2, owner)
    assert decoded == ({identifier: value}, 1 + len(section))
    for length in range(len(section)):
        cut = section[:length]
        refused(ReasonCode.MALFORMED_PACKET, codec.decode_properties, cut, 0, len(cut), owner)
    twice = bytes([2 * len(wire)]) + wire + wire
    if identifier is Property.USER_PROPERTY or (
        identifier is Property.SUBSCRIPTION_IDENTIFIER and owner == PacketType.PUBLISH
    ):
        properties, _ = codec.decode_properties(twice, 0, len(twice), owner)
        assert properties == {identifier: value * 2}
    else:
        refused(ReasonCode.PROTOCOL_ERROR, codec.decode_properties, twice, 0, len(twice), owner)


def test_no_properties():
    assert codec.encode_properties(None) == codec.encode_properties({}) == b"\x00"
    assert codec.decode_properties(b"\x00", 0, 1, PacketType.PUBLISH) == (None, 1)


def test_every_other_identifier_is_unknown():
    for identifier in set(range(256)) - set(Property):
        section = bytes([5, identifier, 1, 0, 0, 0])
        arguments = (section, 0, 6, PacketType.PUBLISH)
        refused(ReasonCode.MALFORMED_PACKET, codec.decode_properties, *arguments)


def test_a_property_that_reaches_into_the_payload():
    section = b"\x04\x03\x00\x02a" + b"b"
    arguments = (section, 0, 6, PacketType.PUBLISH)
    refused(ReasonCode.MALFORMED_PACKET, codec.decode_properties, *arguments)


def test_reason_codes_are_those_of_the_standard():
    assert ReasonCode(0) is ReasonCode.SUCCESS is ReasonCode.NORMAL_DISCONNECTION
    failures = [code for code in ReasonCode if code >= 0x80]
    assert failures == list(range(0x80, 0xA3))
    assert [code for code in ReasonCode if code < 0x80] == [0, 1, 2, 4, 0x10, 0x11, 0x18, 0x19]


def test_connack_of_3_1_1():
    for code in ReasonCode:
        assert 0 <= connack_v311(code) <= 5
        assert (connack_v311(code) == 0) == (code == 0)
    for return_code in range(6):
        assert connack_v311(return_code) == return_code
        assert connack_v311(connack_v5(return_code)) == return_code
    assert connack_v311(ReasonCode.BANNED) == 5
    assert connack_v311(ReasonCode.SERVER_BUSY) == 3
