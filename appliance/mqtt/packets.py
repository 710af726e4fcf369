"""The control packets of MQTT 3.1.1 and 5.0 (chapter 3): one class each, with encode and decode.

All fifteen can be imported from here; those that open a connection are defined in connect.py.

`encode(version)` returns the whole packet and leaves out what that version does not have, such as
properties in 3.1.1; it raises ValueError for a value that cannot be encoded. `decode(flags, body,
version)` takes the low four bits of the first byte and the bytes behind the fixed header; it is
strict, and raises ProtocolError with the standard's reason code. With a limit of User Properties
(`pairs`) these are counted and checked, but not decoded into `properties`: a server that only
forwards or ignores them need not create objects for them. `str()` is short, for logs, and contains
no password and no payload. Reason codes are those of 5.0 in both versions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Final, TypeAlias, TypeVar

from appliance.mqtt.codec import (
    NO_PROPERTIES,
    V5,
    V311,
    PacketType,
    Properties,
    Property,
    check_end,
    check_flags,
    check_properties,
    check_qos,
    decode_byte,
    decode_packet_id,
    decode_properties,
    decode_reason,
    decode_string,
    encode_properties,
    encode_string,
    encode_uint16,
    frame,
    malformed,
    protocol_error,
    quote,
    read_properties,
    reason_name,
)
from appliance.mqtt.connect import Auth, Connack, Connect, Will
from appliance.mqtt.reason import ProtocolError, ReasonCode
from appliance.mqtt.topics import parse_shared

__all__ = [
    "V5",
    "V311",
    "Auth",
    "Connack",
    "Connect",
    "Disconnect",
    "Packet",
    "PacketType",
    "Pingreq",
    "Pingresp",
    "Puback",
    "Pubcomp",
    "Publish",
    "Pubrec",
    "Pubrel",
    "Suback",
    "Subscribe",
    "Subscription",
    "Unsuback",
    "Unsubscribe",
    "Will",
    "decode_packet",
]

#: Topic filters in one packet; each costs far more than its bytes.
MAXIMUM_FILTERS: Final = 4096

_R = ReasonCode
_RECEIVED_REASONS = frozenset(
    {_R.SUCCESS, _R.NO_MATCHING_SUBSCRIBERS, _R.UNSPECIFIED_ERROR}
    | {_R.IMPLEMENTATION_SPECIFIC_ERROR, _R.NOT_AUTHORIZED, _R.TOPIC_NAME_INVALID}
    | {_R.PACKET_IDENTIFIER_IN_USE, _R.QUOTA_EXCEEDED, _R.PAYLOAD_FORMAT_INVALID}
)
_RELEASED_REASONS = frozenset({_R.SUCCESS, _R.PACKET_IDENTIFIER_NOT_FOUND})
_UNSUBACK_REASONS = frozenset(
    {_R.SUCCESS, _R.NO_SUBSCRIPTION_EXISTED, _R.UNSPECIFIED_ERROR}
    | {_R.IMPLEMENTATION_SPECIFIC_ERROR, _R.NOT_AUTHORIZED, _R.TOPIC_FILTER_INVALID}
    | {_R.PACKET_IDENTIFIER_IN_USE}
)
_SUBACK_REASONS = (_UNSUBACK_REASONS - {_R.NO_SUBSCRIPTION_EXISTED}) | {
    _R.GRANTED_QOS_1,
    _R.GRANTED_QOS_2,
    _R.QUOTA_EXCEEDED,
    _R.SHARED_SUBSCRIPTIONS_NOT_SUPPORTED,
    _R.SUBSCRIPTION_IDENTIFIERS_NOT_SUPPORTED,
    _R.WILDCARD_SUBSCRIPTIONS_NOT_SUPPORTED,
}
_SUBACK_REASONS_V311 = frozenset(
    {_R.GRANTED_QOS_0, _R.GRANTED_QOS_1, _R.GRANTED_QOS_2, _R.UNSPECIFIED_ERROR}
)
# The table in 5.0 section 3.14.2.1, and 0x8C, which only section 2.4 gives to DISCONNECT.
_DISCONNECT_REASONS = frozenset(code for code in _R if code >= 0x80 or code in (0x00, 0x04)) - {
    _R.UNSUPPORTED_PROTOCOL_VERSION,
    _R.CLIENT_IDENTIFIER_NOT_VALID,
    _R.BAD_USER_NAME_OR_PASSWORD,
    _R.SERVER_UNAVAILABLE,
    _R.BANNED,
    _R.PACKET_IDENTIFIER_IN_USE,
    _R.PACKET_IDENTIFIER_NOT_FOUND,
}


@dataclass(slots=True)
class Publish:
    """PUBLISH (section 3.3): one message.

    `packet_id` is set for QoS 1 and 2, None for QoS 0. Only rules within the packet are checked;
    `topics.check_topic` validates the topic, which may be empty if there is a Topic Alias (5.0).
    """

    TYPE: ClassVar[PacketType] = PacketType.PUBLISH

    topic: str
    payload: bytes = field(repr=False)
    qos: int = 0
    retain: bool = False
    dup: bool = False
    packet_id: int | None = None
    properties: Properties | None = None
    #: The encoded properties for the receivers, if it was decoded with `pairs`.
    passed_on: bytes = field(default=NO_PROPERTIES, repr=False, compare=False)

    def encode(self, version: int) -> bytes:
        """The whole packet."""
        flags = self.dup << 3 | check_qos(self.qos) << 1 | self.retain
        parts = [encode_string(self.topic)]
        if self.qos:  # [MQTT-2.3.1-5] v5 [MQTT-2.2.1-2]: no packet identifier with QoS 0.
            if not self.packet_id:
                raise ValueError(f"a PUBLISH of QoS {self.qos} needs a packet identifier")
            parts.append(encode_uint16(self.packet_id))
        elif self.dup:  # [MQTT-3.3.1-2]
            raise ValueError("a PUBLISH of QoS 0 is never a duplicate")
        if version == V5:
            parts.append(encode_properties(self.properties))
        return frame(self.TYPE, flags, *parts, self.payload)

    @classmethod
    def decode(cls, flags: int, body: bytes, version: int, pairs: int | None = None) -> Publish:
        """The packet."""
        qos = flags >> 1 & 3
        dup = flags >= 8
        if qos == 3:  # [MQTT-3.3.1-4]
            raise malformed("PUBLISH with QoS 3")
        if dup and not qos:  # [MQTT-3.3.1-2]
            raise malformed("PUBLISH with DUP and QoS 0")
        topic, pos = decode_string(body, 0)  # [MQTT-3.3.2-1]
        packet_id = None
        if qos:
            packet_id, pos = decode_packet_id(cls.TYPE, body, pos)
        properties: Properties | None = None
        passed_on = NO_PROPERTIES
        if version == V5:
            if pairs is None:
                properties, pos = decode_properties(body, pos, len(body), cls.TYPE)
            else:
                checked, pos = check_properties(body, pos, len(body), cls.TYPE, pairs)
                if checked is not None:
                    properties, passed_on = checked.values, checked.passed_on
            # A Protocol Error in 5.0 section 3.3.2.1.
            if not topic and (properties is None or Property.TOPIC_ALIAS not in properties):
                raise protocol_error("PUBLISH without a topic and without a topic alias")
        payload = body[pos:]
        return cls(topic, payload, qos, bool(flags & 1), dup, packet_id, properties, passed_on)

    def __str__(self) -> str:
        number = "" if self.packet_id is None else f" id={self.packet_id}"
        return (
            f"PUBLISH {quote(self.topic)} {len(self.payload)} bytes qos={self.qos}"
            f" retain={self.retain:d} dup={self.dup:d}{number}"
        )


_A = TypeVar("_A", bound="_Acknowledgement")


@dataclass(slots=True)
class UnusablePublish(Publish):
    """A PUBLISH with a ContentError, without its payload and properties; `flaw` says what it is."""

    flaw: str = ""


@dataclass(slots=True)
class _Acknowledgement:
    """What PUBACK, PUBREC, PUBREL and PUBCOMP have in common; 3.1.1 has the packet id only."""

    TYPE: ClassVar[PacketType]
    FLAGS: ClassVar[int] = 0
    REASONS: ClassVar[frozenset[ReasonCode]]

    packet_id: int
    reason_code: int = ReasonCode.SUCCESS
    properties: Properties | None = None

    def encode(self, version: int) -> bytes:
        """The whole packet, in its shortest form (5.0 section 3.4.2)."""
        parts = [encode_uint16(self.packet_id)]
        if version == V5 and (self.reason_code or self.properties):
            parts.append(bytes((self.reason_code,)))
            if self.properties:
                parts.append(encode_properties(self.properties))
        return frame(self.TYPE, self.FLAGS, *parts)

    @classmethod
    def decode(
        cls: type[_A], flags: int, body: bytes, version: int, pairs: int | None = None
    ) -> _A:
        """The packet; without a reason code it is Success (5.0 section 3.4.2.1)."""
        check_flags(cls.TYPE, flags, cls.FLAGS)
        packet_id, pos = decode_packet_id(cls.TYPE, body, 0)
        reason_code = ReasonCode.SUCCESS
        properties = None
        if version == V5:
            if pos < len(body):
                reason_code = decode_reason(cls.TYPE, body[pos], cls.REASONS)
                pos += 1
            if pos < len(body):
                properties, pos = read_properties(body, pos, len(body), cls.TYPE, pairs)
        check_end(cls.TYPE, body, pos)
        return cls(packet_id, reason_code, properties)

    def __str__(self) -> str:
        return f"{self.TYPE.name} id={self.packet_id} {reason_name(self.reason_code)}"


@dataclass(slots=True)
class Puback(_Acknowledgement):
    """PUBACK (section 3.4): the receiver has received a QoS 1 message."""

    TYPE = PacketType.PUBACK
    REASONS = _RECEIVED_REASONS


@dataclass(slots=True)
class Pubrec(_Acknowledgement):
    """PUBREC (section 3.5): the receiver has received a QoS 2 message."""

    TYPE = PacketType.PUBREC
    REASONS = _RECEIVED_REASONS


@dataclass(slots=True)
class Pubrel(_Acknowledgement):
    """PUBREL (section 3.6): the sender of a QoS 2 message has received PUBREC."""

    TYPE = PacketType.PUBREL
    FLAGS = 0b0010  # [MQTT-3.6.1-1]
    REASONS = _RELEASED_REASONS


@dataclass(slots=True)
class Pubcomp(_Acknowledgement):
    """PUBCOMP (section 3.7): the packet identifier of a QoS 2 message is free again."""

    TYPE = PacketType.PUBCOMP
    REASONS = _RELEASED_REASONS


_QOS_3: Final = "SUBSCRIBE with QoS 3"


#: The User Property of SUBSCRIBE for `Subscription.max_rate`.
MAX_RATE: Final = "max-rate"
_MAX_RATE: Final = MAX_RATE.encode()


@dataclass(slots=True)
class Subscription:
    """A topic filter and its options (section 3.8.3); 3.1.1 has only the QoS.

    `retain_handling`: 0 sends retained messages, 1 only when the subscription is new, 2 never.
    `identifier` is the Subscription Identifier of the SUBSCRIBE that it came in, 0 for none; as a
    property of the packet it is not encoded here. Nor is `max_rate`, in messages a second of each
    topic, 0.0 for any: the user property `max-rate`.
    """

    filter: str
    qos: int = 0
    no_local: bool = False
    retain_as_published: bool = False
    retain_handling: int = 0
    identifier: int = 0
    max_rate: float = 0.0

    def _encode(self, version: int) -> bytes:
        options = check_qos(self.qos)
        if version == V5:
            if self.retain_handling not in (0, 1, 2):
                raise ValueError(f"there is no retain handling {self.retain_handling}")
            options |= self.no_local << 2 | self.retain_as_published << 3
            options |= self.retain_handling << 4
        return encode_string(self.filter) + bytes((options,))

    @classmethod
    def _decode(cls, body: bytes, pos: int, version: int) -> tuple[Subscription, int]:
        topic_filter, pos = decode_string(body, pos)  # [MQTT-3.8.3-1]
        options, pos = decode_byte(body, pos)
        # [MQTT-3-8.3-4] v5 [MQTT-3.8.3-5]
        if options & (0b1100_0000 if version == V5 else 0b1111_1100):
            raise malformed(f"SUBSCRIBE with the reserved option bits {options:08b}")
        qos = options & 3
        retain_handling = options >> 4
        if qos == 3:
            # [MQTT-3-8.3-4] calls it malformed, 5.0 section 3.8.3.1 a Protocol Error.
            raise protocol_error(_QOS_3) if version == V5 else malformed(_QOS_3)
        if retain_handling == 3:  # 5.0 section 3.8.3.1
            raise protocol_error("SUBSCRIBE with retain handling 3")
        no_local = bool(options & 0b0100)
        if no_local and _is_shared(topic_filter):  # v5 [MQTT-3.8.3-4]
            raise protocol_error("SUBSCRIBE with No Local on a shared subscription")
        return cls(topic_filter, qos, no_local, bool(options & 0b1000), retain_handling), pos


def _is_shared(topic_filter: str) -> bool:
    try:
        return parse_shared(topic_filter) is not None
    except ValueError:
        return False  # Refused later, by itself, with its own reason code.


@dataclass(slots=True)
class Subscribe:
    """SUBSCRIBE (section 3.8): at least one subscription. The filters are not checked here."""

    TYPE: ClassVar[PacketType] = PacketType.SUBSCRIBE

    packet_id: int
    subscriptions: Sequence[Subscription]
    properties: Properties | None = None

    def encode(self, version: int) -> bytes:
        """The whole packet."""
        parts = [encode_uint16(self.packet_id)]
        if version == V5:
            parts.append(encode_properties(self.properties))
        parts += (subscription._encode(version) for subscription in self.subscriptions)
        return frame(self.TYPE, 0b0010, *parts)

    @classmethod
    def decode(cls, flags: int, body: bytes, version: int, pairs: int | None = None) -> Subscribe:
        """The packet."""
        check_flags(cls.TYPE, flags, 0b0010)  # [MQTT-3.8.1-1]
        packet_id, pos = decode_packet_id(cls.TYPE, body, 0)
        properties = None
        if version == V5:
            start = pos
            properties, pos = read_properties(body, start, len(body), cls.TYPE, pairs)
            if pairs is not None and body.find(_MAX_RATE, start, pos) >= 0:
                # The only User Property that the broker reads; they are not more than `pairs`.
                properties, pos = decode_properties(body, start, len(body), cls.TYPE)
        subscriptions: list[Subscription] = []
        while pos < len(body):
            subscription, pos = Subscription._decode(body, pos, version)
            subscriptions.append(subscription)
            _check_count(subscriptions)
        if not subscriptions:  # [MQTT-3.8.3-3] v5 [MQTT-3.8.3-2]
            raise protocol_error("SUBSCRIBE without a topic filter")
        return cls(packet_id, subscriptions, properties)

    def __str__(self) -> str:
        filters = _list([f"{quote(s.filter)} qos={s.qos}" for s in self.subscriptions[:_SHOWN]])
        return f"SUBSCRIBE id={self.packet_id} {filters}{_more(self.subscriptions)}"


_SHOWN: Final = 5
"""How many filters or reason codes `str()` shows: a packet may hold thousands."""


def _list(items: Sequence[str]) -> str:
    return ", ".join(items)


def _more(items: Sequence[object]) -> str:
    return f" and {len(items) - _SHOWN} more" if len(items) > _SHOWN else ""


@dataclass(slots=True)
class Suback:
    """SUBACK (section 3.9): a reason code for each subscription, in their order.

    3.1.1 has one failure, 0x80, and `encode` says every failure so.
    """

    TYPE: ClassVar[PacketType] = PacketType.SUBACK

    packet_id: int
    reason_codes: Sequence[int]
    properties: Properties | None = None

    def encode(self, version: int) -> bytes:
        """The whole packet."""
        packet_id = encode_uint16(self.packet_id)
        if version == V5:
            properties = encode_properties(self.properties)
            return frame(self.TYPE, 0, packet_id, properties, bytes(self.reason_codes))
        return frame(self.TYPE, 0, packet_id, bytes(min(code, 0x80) for code in self.reason_codes))

    @classmethod
    def decode(cls, flags: int, body: bytes, version: int, pairs: int | None = None) -> Suback:
        """The packet."""
        check_flags(cls.TYPE, flags)
        packet_id, pos = decode_packet_id(cls.TYPE, body, 0)
        properties = None
        allowed = _SUBACK_REASONS_V311
        if version == V5:
            allowed = _SUBACK_REASONS
            properties, pos = read_properties(body, pos, len(body), cls.TYPE, pairs)
        codes = [decode_reason(cls.TYPE, code, allowed) for code in body[pos:]]
        if not codes:
            raise protocol_error("SUBACK without a reason code")
        return cls(packet_id, codes, properties)

    def __str__(self) -> str:
        codes = _list([reason_name(code) for code in self.reason_codes[:_SHOWN]])
        return f"SUBACK id={self.packet_id} {codes}{_more(self.reason_codes)}"


@dataclass(slots=True)
class Unsubscribe:
    """UNSUBSCRIBE (section 3.10): at least one filter. The filters are not checked here."""

    TYPE: ClassVar[PacketType] = PacketType.UNSUBSCRIBE

    packet_id: int
    filters: Sequence[str]
    properties: Properties | None = None

    def encode(self, version: int) -> bytes:
        """The whole packet."""
        parts = [encode_uint16(self.packet_id)]
        if version == V5:
            parts.append(encode_properties(self.properties))
        parts += (encode_string(topic_filter) for topic_filter in self.filters)
        return frame(self.TYPE, 0b0010, *parts)

    @classmethod
    def decode(cls, flags: int, body: bytes, version: int, pairs: int | None = None) -> Unsubscribe:
        """The packet."""
        check_flags(cls.TYPE, flags, 0b0010)  # [MQTT-3.10.1-1]
        packet_id, pos = decode_packet_id(cls.TYPE, body, 0)
        properties = None
        if version == V5:
            properties, pos = read_properties(body, pos, len(body), cls.TYPE, pairs)
        filters: list[str] = []
        while pos < len(body):
            topic_filter, pos = decode_string(body, pos)  # [MQTT-3.10.3-1]
            filters.append(topic_filter)
            _check_count(filters)
        if not filters:  # [MQTT-3.10.3-2]
            raise protocol_error("UNSUBSCRIBE without a topic filter")
        return cls(packet_id, filters, properties)

    def __str__(self) -> str:
        filters = _list([quote(topic_filter) for topic_filter in self.filters[:_SHOWN]])
        return f"UNSUBSCRIBE id={self.packet_id} {filters}{_more(self.filters)}"


@dataclass(slots=True)
class Unsuback:
    """UNSUBACK (section 3.11): a reason code for each filter (5.0), nothing in 3.1.1."""

    TYPE: ClassVar[PacketType] = PacketType.UNSUBACK

    packet_id: int
    reason_codes: Sequence[int] = ()
    properties: Properties | None = None

    def encode(self, version: int) -> bytes:
        """The whole packet."""
        packet_id = encode_uint16(self.packet_id)
        if version == V5:
            properties = encode_properties(self.properties)
            return frame(self.TYPE, 0, packet_id, properties, bytes(self.reason_codes))
        return frame(self.TYPE, 0, packet_id)

    @classmethod
    def decode(cls, flags: int, body: bytes, version: int, pairs: int | None = None) -> Unsuback:
        """The packet; no reason codes in 3.1.1."""
        check_flags(cls.TYPE, flags)
        packet_id, pos = decode_packet_id(cls.TYPE, body, 0)
        if version != V5:
            check_end(cls.TYPE, body, pos)
            return cls(packet_id)
        properties, pos = read_properties(body, pos, len(body), cls.TYPE, pairs)
        codes = [decode_reason(cls.TYPE, code, _UNSUBACK_REASONS) for code in body[pos:]]
        if not codes:
            raise protocol_error("UNSUBACK without a reason code")
        return cls(packet_id, codes, properties)

    def __str__(self) -> str:
        codes = _list([reason_name(code) for code in self.reason_codes[:_SHOWN]])
        return f"UNSUBACK id={self.packet_id} {codes}{_more(self.reason_codes)}".rstrip()


def _check_count(filters: Sequence[object]) -> None:
    if len(filters) > MAXIMUM_FILTERS:
        problem = f"more than {MAXIMUM_FILTERS} topic filters in one packet"
        raise ProtocolError(ReasonCode.QUOTA_EXCEEDED, problem)


_P = TypeVar("_P", bound="_Ping")


@dataclass(slots=True)
class _Ping:
    TYPE: ClassVar[PacketType]

    def encode(self, version: int) -> bytes:
        """The whole packet."""
        return frame(self.TYPE, 0)

    @classmethod
    def decode(
        cls: type[_P], flags: int, body: bytes, version: int, pairs: int | None = None
    ) -> _P:
        """The packet."""
        check_flags(cls.TYPE, flags)
        if body:
            problem = f"{cls.TYPE.name} with {len(body)} bytes after its end"
            raise ProtocolError(ReasonCode.MALFORMED_PACKET, problem, notify_peer=False)
        return cls()

    def __str__(self) -> str:
        return self.TYPE.name


@dataclass(slots=True)
class Pingreq(_Ping):
    """PINGREQ (section 3.12): the client is alive, and asks whether the server is."""

    TYPE = PacketType.PINGREQ


@dataclass(slots=True)
class Pingresp(_Ping):
    """PINGRESP (section 3.13): the answer to PINGREQ."""

    TYPE = PacketType.PINGRESP


@dataclass(slots=True)
class Disconnect:
    """DISCONNECT (section 3.14): the last packet. In 3.1.1 it is empty; only clients send it."""

    TYPE: ClassVar[PacketType] = PacketType.DISCONNECT

    reason_code: int = ReasonCode.NORMAL_DISCONNECTION
    properties: Properties | None = None

    def encode(self, version: int) -> bytes:
        """The whole packet, in its shortest form (5.0 section 3.14.2.1)."""
        if version != V5 or not (self.reason_code or self.properties):
            return frame(self.TYPE, 0)
        properties = encode_properties(self.properties) if self.properties else b""
        return frame(self.TYPE, 0, bytes((self.reason_code,)), properties)

    @classmethod
    def decode(cls, flags: int, body: bytes, version: int, pairs: int | None = None) -> Disconnect:
        """The packet; empty it is a normal disconnection."""
        check_flags(cls.TYPE, flags)  # v5 [MQTT-3.14.1-1]
        if version != V5:
            check_end(cls.TYPE, body, 0)
        if not body:
            return cls()
        try:
            reason_code = decode_reason(cls.TYPE, body[0], _DISCONNECT_REASONS)
        except ProtocolError as error:
            error.notify_peer = False  # it is leaving anyway
            raise
        properties = None
        if len(body) > 1:
            properties, pos = read_properties(body, 1, len(body), cls.TYPE, pairs)
            check_end(cls.TYPE, body, pos)
        return cls(reason_code, properties)

    def __str__(self) -> str:
        name = reason_name(self.reason_code) if self.reason_code else "normal_disconnection"
        return f"DISCONNECT {name}"


Packet: TypeAlias = (
    Connect
    | Connack
    | Publish
    | Puback
    | Pubrec
    | Pubrel
    | Pubcomp
    | Subscribe
    | Suback
    | Unsubscribe
    | Unsuback
    | Pingreq
    | Pingresp
    | Disconnect
    | Auth
)

_DECODERS: dict[int, Callable[[int, bytes, int, int | None], Packet]] = {
    PacketType.CONNECT: Connect.decode,
    PacketType.CONNACK: Connack.decode,
    PacketType.PUBLISH: Publish.decode,
    PacketType.PUBACK: Puback.decode,
    PacketType.PUBREC: Pubrec.decode,
    PacketType.PUBREL: Pubrel.decode,
    PacketType.PUBCOMP: Pubcomp.decode,
    PacketType.SUBSCRIBE: Subscribe.decode,
    PacketType.SUBACK: Suback.decode,
    PacketType.UNSUBSCRIBE: Unsubscribe.decode,
    PacketType.UNSUBACK: Unsuback.decode,
    PacketType.PINGREQ: Pingreq.decode,
    PacketType.PINGRESP: Pingresp.decode,
    PacketType.DISCONNECT: Disconnect.decode,
    PacketType.AUTH: Auth.decode,
}


def decode_packet(first_byte: int, body: bytes, version: int, pairs: int | None = None) -> Packet:
    """Decode the packet whose fixed header begins with `first_byte` and whose rest is `body`.

    `version` is that of the connection; a CONNECT contains its own. `pairs` is as for `decode`.
    Raises ProtocolError if it is not a packet of that version.
    """
    decode = _DECODERS.get(first_byte >> 4)
    if decode is None:  # Packet type 0 is reserved, section 2.2.1.
        raise protocol_error("packet type 0 is reserved")
    return decode(first_byte & 0x0F, body, version, pairs)
