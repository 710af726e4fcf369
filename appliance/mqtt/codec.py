"""The data types of MQTT (section 1.5), the property table (5.0 section 2.2.2.2) and helpers of
all packets.

`encode_x` returns bytes, and raises ValueError for a value that cannot be encoded. `decode_x` reads
at an index, and returns the value and the index behind it; it raises ProtocolError.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Final, TypeAlias, cast

from appliance.mqtt.reason import ContentError, ProtocolError, ReasonCode
from appliance.mqtt.topics import check_topic

V31: Final = 3
"""The protocol level of MQTT 3.1, in CONNECT only: the connection is treated as one of 3.1.1."""

V311: Final = 4
"""The protocol level of MQTT 3.1.1."""

V5: Final = 5
"""The protocol version of MQTT 5.0."""

VERSION_NAMES: Final = {V31: "3.1", V311: "3.1.1", V5: "5"}
"""The names of the versions, for logs."""

MAX_VARINT: Final = 268_435_455
"""The greatest Variable Byte Integer, and so Remaining Length: four bytes of 7 bits."""

MAX_LENGTH: Final = 65_535
"""The greatest length, in bytes, of a string or of binary data: it has a prefix of two bytes."""


class PacketType(IntEnum):
    """MQTT Control Packet types (section 2.2.1; 5.0 section 2.1.2). AUTH exists in 5.0 only."""

    CONNECT = 1
    CONNACK = 2
    PUBLISH = 3
    PUBACK = 4
    PUBREC = 5
    PUBREL = 6
    PUBCOMP = 7
    SUBSCRIBE = 8
    SUBACK = 9
    UNSUBSCRIBE = 10
    UNSUBACK = 11
    PINGREQ = 12
    PINGRESP = 13
    DISCONNECT = 14
    AUTH = 15


WILL: Final = 0
"""The owner of the Will Properties in a CONNECT: a set of their own beside the packet types."""


class Property(IntEnum):
    """Property identifiers of MQTT 5.0, section 2.2.2.2."""

    PAYLOAD_FORMAT_INDICATOR = 0x01
    MESSAGE_EXPIRY_INTERVAL = 0x02
    CONTENT_TYPE = 0x03
    RESPONSE_TOPIC = 0x08
    CORRELATION_DATA = 0x09
    SUBSCRIPTION_IDENTIFIER = 0x0B
    SESSION_EXPIRY_INTERVAL = 0x11
    ASSIGNED_CLIENT_IDENTIFIER = 0x12
    SERVER_KEEP_ALIVE = 0x13
    AUTHENTICATION_METHOD = 0x15
    AUTHENTICATION_DATA = 0x16
    REQUEST_PROBLEM_INFORMATION = 0x17
    WILL_DELAY_INTERVAL = 0x18
    REQUEST_RESPONSE_INFORMATION = 0x19
    RESPONSE_INFORMATION = 0x1A
    SERVER_REFERENCE = 0x1C
    REASON_STRING = 0x1F
    RECEIVE_MAXIMUM = 0x21
    TOPIC_ALIAS_MAXIMUM = 0x22
    TOPIC_ALIAS = 0x23
    MAXIMUM_QOS = 0x24
    RETAIN_AVAILABLE = 0x25
    USER_PROPERTY = 0x26
    MAXIMUM_PACKET_SIZE = 0x27
    WILDCARD_SUBSCRIPTION_AVAILABLE = 0x28
    SUBSCRIPTION_IDENTIFIER_AVAILABLE = 0x29
    SHARED_SUBSCRIPTION_AVAILABLE = 0x2A


PropertyValue: TypeAlias = "int | str | bytes | list[tuple[str, str]] | list[int]"
Properties: TypeAlias = dict[Property, PropertyValue]
"""Properties in wire order. USER_PROPERTY is a list of (name, value) and SUBSCRIPTION_IDENTIFIER a
list of int, also when there is one; intervals are in seconds. No properties at all is None."""


class Kind(Enum):
    """The encoding of a property's value."""

    BYTE = 1
    TWO_BYTE = 2
    FOUR_BYTE = 4
    VARINT = 5
    STRING = 6
    BINARY = 7
    STRING_PAIR = 8


#: The default limit of User Properties in one packet. Decoded, each takes many times its encoded
#: size.
MAXIMUM_PAIRS: Final = 10_000


_USER_PROPERTY: Final = 0x26  # a plain number, because it is compared with each byte

NO_PROPERTIES: Final = b"\0"
"""The encoding of no properties: v5 [MQTT-2.2.2-1]."""


@dataclass(frozen=True, slots=True)
class PropertyRule:
    """The standard's rule for one property.

    `owners` are the packet types (and WILL) that may contain it, `repeatable` those that may
    contain it more than once; a number must be from `minimum` to `maximum`, else the error is
    `out_of_range`.
    """

    kind: Kind
    owners: frozenset[int]
    repeatable: frozenset[int] = frozenset()
    minimum: int = 0
    maximum: int = 0xFFFF_FFFF
    out_of_range: ReasonCode = ReasonCode.PROTOCOL_ERROR


_T = PacketType
_MESSAGE = frozenset({_T.PUBLISH, WILL})
_CONNECT = frozenset({_T.CONNECT})
_CONNACK = frozenset({_T.CONNACK})
_EVERYWHERE = frozenset({WILL, *PacketType}) - {_T.PINGREQ, _T.PINGRESP}
_REASON_STRING = _EVERYWHERE - {WILL, _T.CONNECT, _T.PUBLISH, _T.SUBSCRIBE, _T.UNSUBSCRIBE}

PROPERTY_RULES: Final[dict[Property, PropertyRule]] = {
    Property.PAYLOAD_FORMAT_INDICATOR: PropertyRule(Kind.BYTE, _MESSAGE, maximum=1),
    Property.MESSAGE_EXPIRY_INTERVAL: PropertyRule(Kind.FOUR_BYTE, _MESSAGE),
    Property.CONTENT_TYPE: PropertyRule(Kind.STRING, _MESSAGE),
    Property.RESPONSE_TOPIC: PropertyRule(Kind.STRING, _MESSAGE),
    Property.CORRELATION_DATA: PropertyRule(Kind.BINARY, _MESSAGE),
    Property.SUBSCRIPTION_IDENTIFIER: PropertyRule(
        Kind.VARINT,
        frozenset({_T.PUBLISH, _T.SUBSCRIBE}),
        repeatable=frozenset({_T.PUBLISH}),
        minimum=1,
    ),
    Property.SESSION_EXPIRY_INTERVAL: PropertyRule(
        Kind.FOUR_BYTE, frozenset({_T.CONNECT, _T.CONNACK, _T.DISCONNECT})
    ),
    Property.ASSIGNED_CLIENT_IDENTIFIER: PropertyRule(Kind.STRING, _CONNACK),
    Property.SERVER_KEEP_ALIVE: PropertyRule(Kind.TWO_BYTE, _CONNACK),
    Property.AUTHENTICATION_METHOD: PropertyRule(
        Kind.STRING, frozenset({_T.CONNECT, _T.CONNACK, _T.AUTH})
    ),
    Property.AUTHENTICATION_DATA: PropertyRule(
        Kind.BINARY, frozenset({_T.CONNECT, _T.CONNACK, _T.AUTH})
    ),
    Property.REQUEST_PROBLEM_INFORMATION: PropertyRule(Kind.BYTE, _CONNECT, maximum=1),
    Property.WILL_DELAY_INTERVAL: PropertyRule(Kind.FOUR_BYTE, frozenset({WILL})),
    Property.REQUEST_RESPONSE_INFORMATION: PropertyRule(Kind.BYTE, _CONNECT, maximum=1),
    Property.RESPONSE_INFORMATION: PropertyRule(Kind.STRING, _CONNACK),
    Property.SERVER_REFERENCE: PropertyRule(Kind.STRING, frozenset({_T.CONNACK, _T.DISCONNECT})),
    Property.REASON_STRING: PropertyRule(Kind.STRING, _REASON_STRING),
    Property.RECEIVE_MAXIMUM: PropertyRule(Kind.TWO_BYTE, _CONNECT | _CONNACK, minimum=1),
    Property.TOPIC_ALIAS_MAXIMUM: PropertyRule(Kind.TWO_BYTE, _CONNECT | _CONNACK),
    # v5 [MQTT-3.3.2-8]: an alias is never 0, and has a reason code of its own.
    Property.TOPIC_ALIAS: PropertyRule(
        Kind.TWO_BYTE,
        frozenset({_T.PUBLISH}),
        minimum=1,
        out_of_range=ReasonCode.TOPIC_ALIAS_INVALID,
    ),
    Property.MAXIMUM_QOS: PropertyRule(Kind.BYTE, _CONNACK, maximum=1),
    Property.RETAIN_AVAILABLE: PropertyRule(Kind.BYTE, _CONNACK, maximum=1),
    Property.USER_PROPERTY: PropertyRule(Kind.STRING_PAIR, _EVERYWHERE, repeatable=_EVERYWHERE),
    Property.MAXIMUM_PACKET_SIZE: PropertyRule(Kind.FOUR_BYTE, _CONNECT | _CONNACK, minimum=1),
    Property.WILDCARD_SUBSCRIPTION_AVAILABLE: PropertyRule(Kind.BYTE, _CONNACK, maximum=1),
    Property.SUBSCRIPTION_IDENTIFIER_AVAILABLE: PropertyRule(Kind.BYTE, _CONNACK, maximum=1),
    Property.SHARED_SUBSCRIPTION_AVAILABLE: PropertyRule(Kind.BYTE, _CONNACK, maximum=1),
}
"""All 27 properties of table 2-4."""

# By identifier, because converting an int to a Property is slow, and every PUBLISH with properties
# needs it.
_KNOWN: Final = {int(identifier): (identifier, rule) for identifier, rule in PROPERTY_RULES.items()}


_WITH_NUL: Final = "a string holds U+0000"


def malformed(message: str) -> ProtocolError:
    """The error for bytes that cannot be parsed (5.0 section 4.13)."""
    return ProtocolError(ReasonCode.MALFORMED_PACKET, message)


def protocol_error(message: str) -> ProtocolError:
    """The error for a valid encoding that violates a rule (5.0 section 4.13)."""
    return ProtocolError(ReasonCode.PROTOCOL_ERROR, message)


def encode_varint(value: int) -> bytes:
    """A Variable Byte Integer in as few bytes as it needs (5.0 section 1.5.5)."""
    if value < 0 or value > MAX_VARINT:
        raise ValueError(f"{value} does not fit a Variable Byte Integer (0 to {MAX_VARINT})")
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def decode_varint(buf: bytes, pos: int) -> tuple[int, int]:
    """A Variable Byte Integer at `pos` (5.0 section 1.5.5)."""
    value = 0
    for length in range(4):
        if pos + length >= len(buf):
            raise malformed("the packet ends inside a Variable Byte Integer")
        byte = buf[pos + length]
        value |= (byte & 0x7F) << 7 * length
        if byte < 0x80:
            # v5 [MQTT-1.5.5-1]: the minimum number of bytes, so the last one is not 0.
            if length and not byte:
                raise malformed("a Variable Byte Integer is longer than it needs to be")
            return value, pos + length + 1
    raise malformed("a Variable Byte Integer has more than four bytes")


def decode_byte(buf: bytes, pos: int) -> tuple[int, int]:
    """The byte at `pos`."""
    if pos >= len(buf):
        raise malformed("the packet ends too early")
    return buf[pos], pos + 1


def encode_uint16(value: int) -> bytes:
    """A Two Byte Integer, big-endian."""
    return _encode_uint(value, 2)


def decode_uint16(buf: bytes, pos: int) -> tuple[int, int]:
    """A Two Byte Integer at `pos`, big-endian."""
    if pos + 2 > len(buf):
        raise malformed("the packet ends inside a Two Byte Integer")
    return buf[pos] << 8 | buf[pos + 1], pos + 2


def encode_uint32(value: int) -> bytes:
    """A Four Byte Integer, big-endian."""
    return _encode_uint(value, 4)


def decode_uint32(buf: bytes, pos: int) -> tuple[int, int]:
    """A Four Byte Integer at `pos`, big-endian."""
    if pos + 4 > len(buf):
        raise malformed("the packet ends inside a Four Byte Integer")
    return int.from_bytes(buf[pos : pos + 4], "big"), pos + 4


def _encode_uint(value: int, size: int) -> bytes:
    if value < 0 or value >> 8 * size:
        raise ValueError(f"{value} does not fit {size} bytes")
    return value.to_bytes(size, "big")


def text_size(text: str) -> int:
    """Bytes of memory of a string: up to four per character if one is beyond the BMP."""
    return sys.getsizeof(text)


def encode_binary(value: bytes) -> bytes:
    """Binary Data with its length of two bytes (5.0 section 1.5.6)."""
    if len(value) > MAX_LENGTH:
        raise ValueError(f"{len(value)} bytes are more than a length of two bytes can say")
    return len(value).to_bytes(2, "big") + value


def decode_binary(buf: bytes, pos: int) -> tuple[bytes, int]:
    """Binary Data at `pos` (5.0 section 1.5.6)."""
    length, start = decode_uint16(buf, pos)
    end = start + length
    if end > len(buf):
        raise malformed("the packet ends inside a string or binary data")
    return buf[start:end], end


def encode_string(value: str) -> bytes:
    """A UTF-8 Encoded String (section 1.5.3; 5.0 section 1.5.4)."""
    if "\0" in value:
        raise ValueError("a string must not hold U+0000")  # [MQTT-1.5.3-2] v5 [MQTT-1.5.4-2]
    # Python refuses surrogates by itself: [MQTT-1.5.3-1] v5 [MQTT-1.5.4-1].
    return encode_binary(value.encode())


def decode_string(buf: bytes, pos: int) -> tuple[str, int]:
    """A UTF-8 Encoded String at `pos` (section 1.5.3; 5.0 section 1.5.4).

    A byte order mark stays where it is ([MQTT-1.5.3-3], v5 [MQTT-1.5.4-3]); control characters and
    non-characters are allowed, which the standard leaves to the receiver.
    """
    raw, pos = decode_binary(buf, pos)
    try:
        # Strict about surrogates and overlong forms: [MQTT-1.5.3-1] v5 [MQTT-1.5.4-1].
        value = raw.decode()
    except UnicodeDecodeError as error:
        raise ContentError(ReasonCode.MALFORMED_PACKET, "a string is not UTF-8") from error
    if "\0" in value:  # [MQTT-1.5.3-2] v5 [MQTT-1.5.4-2]
        raise ContentError(ReasonCode.MALFORMED_PACKET, _WITH_NUL)
    return value, pos


def encode_properties(properties: Properties | None) -> bytes:
    """Properties with their length in front (5.0 section 2.2.2); None and {} give a single 0."""
    if not properties:
        return NO_PROPERTIES
    out = encode_property_list(properties)
    return encode_varint(len(out)) + out


def encode_property_list(properties: Properties) -> bytes:
    """Properties, one behind the other, without their length."""
    out = bytearray()
    for identifier, value in properties.items():
        kind = PROPERTY_RULES[identifier].kind
        if kind is Kind.STRING_PAIR:
            for name, text in cast("list[tuple[str, str]]", value):
                out.append(identifier)
                out += encode_string(name)
                out += encode_string(text)
        elif kind is Kind.VARINT:
            for number in cast("list[int]", value):
                out.append(identifier)
                out += encode_varint(number)
        else:
            out.append(identifier)
            if kind is Kind.STRING:
                out += encode_string(cast(str, value))
            elif kind is Kind.BINARY:
                out += encode_binary(cast(bytes, value))
            else:
                out += _encode_uint(cast(int, value), kind.value)
    return bytes(out)


def decode_properties(buf: bytes, pos: int, end: int, owner: int) -> tuple[Properties | None, int]:
    """The properties at `pos`, with their length in front, and the index after them.

    `end` is the end of the packet, `owner` the PacketType, or WILL for Will Properties. What the
    table forbids is Malformed (unknown, or not in this packet) or a Protocol Error (twice, or out
    of range), as 5.0 sections 2.2.2.2 and 3.x.2 say. No properties give None.
    """
    stop, pos = _property_section(buf, pos, end)
    if pos == stop:
        return None, pos
    properties: Properties = {}
    buf = buf[:stop]  # so that a truncated value is not completed by later bytes
    count = 0
    while pos < stop:
        identifier, rule = _legal_property(buf[pos], owner, properties)
        if rule.kind is not Kind.STRING_PAIR:
            pos = _decode_property(buf, pos + 1, identifier, rule, properties)
            continue
        count += 1
        if count > MAXIMUM_PAIRS:
            raise _too_many_pairs(MAXIMUM_PAIRS)
        name, pos = decode_string(buf, pos + 1)
        text, pos = decode_string(buf, pos)
        # The order of User Properties is preserved: v5 [MQTT-3.3.2-18].
        cast("list[tuple[str, str]]", properties.setdefault(identifier, [])).append((name, text))
    return properties, pos


@dataclass(slots=True)
class CheckedProperties:
    """The validated properties of a received message.

    `passed_on` are the encoded properties for the receivers, in the publisher's order and with
    their length in front: all but those of one connection and the expiry interval. `values` are
    all but the User Properties, which are not decoded; `pairs` is the number of these.
    """

    values: Properties
    passed_on: bytes
    pairs: int


#: Properties of one connection, and intervals that change with time: not forwarded unchanged.
_NOT_PASSED_ON: Final = frozenset(
    {
        Property.TOPIC_ALIAS,
        Property.SUBSCRIPTION_IDENTIFIER,
        Property.MESSAGE_EXPIRY_INTERVAL,
        Property.WILL_DELAY_INTERVAL,
    }
)


def check_properties(
    buf: bytes, pos: int, end: int, owner: int, pairs: int
) -> tuple[CheckedProperties | None, int]:
    """Like `decode_properties`, with the same errors, but without decoding User Properties.

    More than `pairs` User Properties exceed a limit of this server: Quota exceeded.
    """
    begin = pos
    stop, pos = _property_section(buf, pos, end)
    if pos == stop:
        return None, pos
    taken = pos  # properties before this index are in `forwarded`, or left out
    values: Properties = {}
    forwarded: list[bytes] = []
    buf = buf[:stop]  # so that a truncated value is not completed by later bytes
    count = 0
    while pos < stop:
        if buf[pos] == _USER_PROPERTY:
            count += 1
            if count > pairs:  # before it is checked
                raise _too_many_pairs(pairs)
            pos = _check_string(buf, _check_string(buf, pos + 1, stop), stop)
            continue
        identifier, rule = _legal_property(buf[pos], owner, values)
        start = pos
        pos = _decode_property(buf, pos + 1, identifier, rule, values)
        if identifier in _NOT_PASSED_ON:
            forwarded.append(buf[taken:start])
            taken = pos
    if not forwarded:
        return CheckedProperties(values, buf[begin:stop], count), pos
    forwarded.append(buf[taken:stop])
    passed_on = b"".join((encode_varint(sum(map(len, forwarded))), *forwarded))
    return CheckedProperties(values, passed_on, count), pos


def read_properties(
    buf: bytes, pos: int, end: int, owner: int, pairs: int | None
) -> tuple[Properties | None, int]:
    """`decode_properties`, or, with a limit of `pairs`, all but the checked User Properties."""
    if pairs is None:
        return decode_properties(buf, pos, end, owner)
    checked, pos = check_properties(buf, pos, end, owner, pairs)
    return (checked.values or None) if checked is not None else None, pos


def find_topic_alias(buf: bytes, pos: int, end: int, most: int) -> int | None:
    """The Topic Alias among the properties at `pos` of a PUBLISH that ends at `end`.

    Nothing is checked but where each property ends: for those in which there is a ContentError.
    Raises one if the alias is not among the first `most` properties, and there are more.
    """
    stop, pos = _property_section(buf, pos, end)
    buf = buf[:stop]  # so that a truncated value is not completed by later bytes
    count = 0
    while pos < stop:
        count += 1
        if count > most:
            raise _too_many_pairs(most)
        known = _KNOWN.get(buf[pos])
        if known is None:
            raise malformed(f"unknown property 0x{buf[pos]:02x}")
        name, rule = known
        pos += 1
        if name is Property.TOPIC_ALIAS:
            return decode_uint16(buf, pos)[0]
        kind = rule.kind
        if kind is Kind.STRING_PAIR:
            pos = _skip(buf, _skip(buf, pos, stop), stop)
        elif kind is Kind.STRING or kind is Kind.BINARY:
            pos = _skip(buf, pos, stop)
        elif kind is Kind.VARINT:
            pos = decode_varint(buf, pos)[1]
        else:
            pos += kind.value  # which is its size
    if pos > stop:
        raise malformed("the packet ends inside a property")
    return None


def _skip(buf: bytes, pos: int, stop: int) -> int:
    """The index behind the string or the binary data at `pos`."""
    if pos + 2 > stop:
        raise malformed("the packet ends inside a Two Byte Integer")
    return pos + 2 + (buf[pos] << 8 | buf[pos + 1])


def _property_section(buf: bytes, pos: int, end: int) -> tuple[int, int]:
    """Where the properties at `pos` end, and where the first of them begins."""
    length, pos = decode_varint(buf, pos)
    if pos + length > end:
        raise malformed("the properties are longer than the packet")
    return pos + length, pos


def _legal_property(
    identifier: int, owner: int, properties: Properties
) -> tuple[Property, PropertyRule]:
    """The property of that identifier and its rule, if it may follow `properties` in the packet."""
    # An identifier is a Variable Byte Integer; no known one needs a second byte.
    known = _KNOWN.get(identifier)
    if known is None:
        raise malformed(f"unknown property 0x{identifier:02x}")
    name, rule = known
    if owner not in rule.owners:
        raise malformed(f"{_owner_name(owner)} may not hold {name.name}")
    if name in properties and owner not in rule.repeatable:
        raise ProtocolError(ReasonCode.PROTOCOL_ERROR, f"{name.name} is there twice")
    return known


def _too_many_pairs(limit: int) -> ProtocolError:
    """The error for more User Properties than the limit.

    0x97 is there for "an implementation or administrative imposed limit", in CONNACK as in
    DISCONNECT (5.0 sections 3.2.2.2 and 3.14.2.1).
    """
    return ContentError(ReasonCode.QUOTA_EXCEEDED, f"more than {limit} User Properties")


def _check_string(buf: bytes, pos: int, stop: int) -> int:
    """Raises the errors of `decode_string`; returns the index behind the string."""
    start = pos + 2
    if start > stop:
        raise malformed("the packet ends inside a Two Byte Integer")
    end = start + (buf[pos] << 8 | buf[pos + 1])
    if end > start:
        if end > stop:
            raise malformed("the packet ends inside a string or binary data")
        if buf.find(0, start, end) >= 0:  # [MQTT-1.5.3-2] v5 [MQTT-1.5.4-2]
            raise ContentError(ReasonCode.MALFORMED_PACKET, _WITH_NUL)
        if not buf[start:end].isascii():
            decode_string(buf, pos)
    return end


def _decode_property(
    buf: bytes, pos: int, identifier: Property, rule: PropertyRule, properties: Properties
) -> int:
    """Decodes one value, not of a User Property, into `properties`; returns the index behind it."""
    kind = rule.kind
    if kind is Kind.STRING:
        text, pos = decode_string(buf, pos)
        if identifier is Property.RESPONSE_TOPIC:
            try:
                check_topic(text)  # v5 [MQTT-3.3.2-14]
            except ValueError as error:
                text = f"response topic: {error}"
                raise ContentError(ReasonCode.PROTOCOL_ERROR, text) from error
        properties[identifier] = text
        return pos
    if kind is Kind.BINARY:
        properties[identifier], pos = decode_binary(buf, pos)
        return pos
    if kind is Kind.BYTE:
        number, pos = decode_byte(buf, pos)
    elif kind is Kind.TWO_BYTE:
        number, pos = decode_uint16(buf, pos)
    elif kind is Kind.FOUR_BYTE:
        number, pos = decode_uint32(buf, pos)
    else:
        number, pos = decode_varint(buf, pos)
    if number < rule.minimum or number > rule.maximum:
        text = f"{identifier.name} must not be {number}"
        if identifier is Property.PAYLOAD_FORMAT_INDICATOR:
            raise ContentError(rule.out_of_range, text)
        raise ProtocolError(rule.out_of_range, text)
    if kind is Kind.VARINT:
        cast("list[int]", properties.setdefault(identifier, [])).append(number)
    else:
        properties[identifier] = number
    return pos


def _owner_name(owner: int) -> str:
    return "a will" if owner == WILL else PacketType(owner).name


def frame(packet_type: PacketType, flags: int, *parts: bytes) -> bytes:
    """A whole packet: fixed header (section 2.2; 5.0 section 2.1.1) and the `parts` of its body."""
    length = encode_varint(sum(map(len, parts)))
    return b"".join((bytes((packet_type << 4 | flags,)), length, *parts))


def check_flags(packet_type: PacketType, flags: int, expected: int = 0) -> None:
    """Refuses reserved flags of the fixed header (section 2.2.2; 5.0 section 2.1.3)."""
    # [MQTT-2.2.2-2] v5 [MQTT-2.1.3-1]; [MQTT-3.6.1-1] [MQTT-3.8.1-1] [MQTT-3.10.1-1]
    if flags != expected:
        raise malformed(f"{packet_type.name} with the reserved flags {flags:04b}")


def check_end(packet_type: PacketType, body: bytes, pos: int) -> None:
    """Refuses bytes after the end of a packet."""
    if pos != len(body):
        raise malformed(f"{packet_type.name} with {len(body) - pos} bytes after its end")


def decode_packet_id(packet_type: PacketType, body: bytes, pos: int) -> tuple[int, int]:
    """A Packet Identifier at `pos` (section 2.3.1; 5.0 section 2.2.1)."""
    packet_id, pos = decode_uint16(body, pos)
    if not packet_id:  # [MQTT-2.3.1-1] v5 [MQTT-2.2.1-3]
        problem = f"{packet_type.name} with the packet identifier 0"
        # The standard names no reason code; these are mosquitto's.
        if packet_type in (PacketType.SUBSCRIBE, PacketType.UNSUBSCRIBE):
            raise malformed(problem)
        raise protocol_error(problem)
    return packet_id, pos


def decode_reason(packet_type: PacketType, code: int, allowed: frozenset[ReasonCode]) -> ReasonCode:
    """A reason code; a Protocol Error when the packet's table does not have it."""
    # [MQTT-3.9.3-2], v5 [MQTT-3.2.2-8] [MQTT-3.4.2-1] [MQTT-3.14.2-1] and the like
    if code not in allowed:
        raise protocol_error(f"{packet_type.name} with the reason code 0x{code:02x}")
    return ReasonCode(code)


def check_qos(qos: int) -> int:
    """A QoS that can be encoded; ValueError for any other."""
    if qos not in (0, 1, 2):
        raise ValueError(f"there is no QoS {qos}")
    return qos


def quote(text: str) -> str:
    """`text` for a log line: escaped, and not longer than a line."""
    part = text[:100]
    shown = repr(part)
    if len(shown) > 300:  # what is escaped takes up to ten characters
        part = text[:25]
        shown = repr(part)
    return shown if len(part) == len(text) else shown + "…"


def reason_name(code: int) -> str:
    """A reason code for a log line."""
    try:
        return ReasonCode(code).name.lower()
    except ValueError:
        return f"0x{code:02x}"
