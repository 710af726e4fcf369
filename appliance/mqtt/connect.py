"""CONNECT, CONNACK and AUTH: the packets that begin a connection; see packets.py for the rules."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import ClassVar, Final

from appliance.mqtt.codec import (
    NO_PROPERTIES,
    V5,
    V31,
    V311,
    VERSION_NAMES,
    WILL,
    PacketType,
    Properties,
    Property,
    check_end,
    check_flags,
    check_properties,
    check_qos,
    decode_binary,
    decode_byte,
    decode_properties,
    decode_reason,
    decode_string,
    decode_uint16,
    encode_binary,
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
from appliance.mqtt.reason import ProtocolError, ReasonCode, connack_v5, connack_v311
from appliance.mqtt.topics import check_topic, holds_control

#: [MQTT-3.1.2-1] [MQTT-3.1.2-2]; MQTT 3.1 calls itself otherwise.
_PROTOCOLS: Final = {V31: "MQIsdp", V311: "MQTT", V5: "MQTT"}
_FLAG_RESERVED: Final = 0x01
_FLAG_CLEAN_START: Final = 0x02
_FLAG_WILL: Final = 0x04
_FLAG_WILL_RETAIN: Final = 0x20
_FLAG_PASSWORD: Final = 0x40
_FLAG_USERNAME: Final = 0x80

_R = ReasonCode
_CONNACK_REASONS = frozenset(
    {_R.SUCCESS, *(code for code in _R if 0x80 <= code <= _R.BAD_AUTHENTICATION_METHOD)}
    | {_R.TOPIC_NAME_INVALID, _R.PACKET_TOO_LARGE, _R.QUOTA_EXCEEDED, _R.PAYLOAD_FORMAT_INVALID}
    | {_R.RETAIN_NOT_SUPPORTED, _R.QOS_NOT_SUPPORTED, _R.USE_ANOTHER_SERVER, _R.SERVER_MOVED}
    | {_R.CONNECTION_RATE_EXCEEDED}
) - {_R.SERVER_SHUTTING_DOWN}
_AUTH_REASONS = frozenset({_R.SUCCESS, _R.CONTINUE_AUTHENTICATION, _R.RE_AUTHENTICATE})


def _check_authentication(
    packet_type: PacketType, properties: Properties | None, needed: bool = False
) -> None:
    # A Protocol Error in 5.0 sections 3.1.2.11.10 and 3.15.2.2.2.
    properties = properties or {}
    needed = needed or Property.AUTHENTICATION_DATA in properties
    if needed and Property.AUTHENTICATION_METHOD not in properties:
        raise protocol_error(f"{packet_type.name} without an authentication method")


@dataclass(slots=True)
class Will:
    """The message that the server publishes when the client is gone (section 3.1.2.5)."""

    topic: str
    payload: bytes = field(repr=False)
    qos: int = 0
    retain: bool = False
    properties: Properties | None = None
    #: As `Publish.passed_on`.
    passed_on: bytes = field(default=NO_PROPERTIES, repr=False, compare=False)


@dataclass(slots=True)
class Connect:
    """CONNECT (section 3.1): the first packet of a client.

    `clean_start` is the Clean Session flag of 3.1.1, `keep_alive` is in seconds and 0 is none.
    `version` is the packet's own: `encode` and `decode` do not look at theirs.
    """

    TYPE: ClassVar[PacketType] = PacketType.CONNECT

    client_id: str
    clean_start: bool = True
    keep_alive: int = 0
    version: int = V5
    username: str | None = None
    password: bytes | None = field(default=None, repr=False)
    will: Will | None = None
    # Authentication Data may be in there.
    properties: Properties | None = field(default=None, repr=False)

    def encode(self, version: int = 0) -> bytes:
        """The whole packet, in the version that it asks for."""
        v5 = self.version == V5
        will = self.will
        flags = _FLAG_CLEAN_START if self.clean_start else 0
        name = encode_string(_PROTOCOLS[self.version])
        parts = [name, bytes((self.version,)), b"", encode_uint16(self.keep_alive)]
        if v5:
            parts.append(encode_properties(self.properties))
        parts.append(encode_string(self.client_id))
        if will is not None:
            flags |= _FLAG_WILL | check_qos(will.qos) << 3
            if will.retain:
                flags |= _FLAG_WILL_RETAIN
            if v5:
                parts.append(encode_properties(will.properties))
            parts += (encode_string(will.topic), encode_binary(will.payload))
        if self.username is not None:
            flags |= _FLAG_USERNAME
            parts.append(encode_string(self.username))
        if self.password is not None:
            if self.username is None and not v5:  # [MQTT-3.1.2-22]
                raise ValueError("MQTT 3 has no password without a user name")
            flags |= _FLAG_PASSWORD
            parts.append(encode_binary(self.password))
        parts[2] = bytes((flags,))
        return frame(self.TYPE, 0, *parts)

    @classmethod
    def decode(cls, flags: int, body: bytes, version: int = 0, pairs: int | None = None) -> Connect:
        """The packet; what is wrong after the version is in that version's terms."""
        check_flags(cls.TYPE, flags)
        name, pos = decode_string(body, 0)
        level, pos = decode_byte(body, pos)
        if _PROTOCOLS.get(level) != name:
            raise ProtocolError(
                ReasonCode.UNSUPPORTED_PROTOCOL_VERSION,
                f"protocol {quote(name)} level {level} is not MQTT 3.1, 3.1.1 or 5.0",
                notify_peer=name in _PROTOCOLS.values(),
            )
        v5 = level == V5
        # In 5.0 wrong properties are answered; other wrong bytes only end the connection.
        with _untold():
            connect_flags, pos = decode_byte(body, pos)
            if level == V31:
                connect_flags &= ~_FLAG_RESERVED  # it says nothing about that one
            _check_connect_flags(connect_flags, v5)
            keep_alive, pos = decode_uint16(body, pos)
        properties: Properties | None = None
        if v5 and pairs is None:
            properties, pos = decode_properties(body, pos, len(body), cls.TYPE)
        elif v5:
            checked, pos = check_properties(body, pos, len(body), cls.TYPE, pairs or 0)
            if checked is not None:
                properties = checked.values
                pairs = (pairs or 0) - checked.pairs  # the will's count with them
        if v5:
            _check_authentication(cls.TYPE, properties)
        client_id, pos = _decode_client_id(body, pos)
        will = username = password = None
        if connect_flags & _FLAG_WILL:
            will, pos = _decode_will(connect_flags, body, pos, v5, pairs)
        # In section 3.1 of 3.1 the length takes precedence over what the last two flags promise.
        end = len(body) if level == V31 else -1
        with _untold():
            if connect_flags & _FLAG_USERNAME and pos != end:
                username, pos = decode_string(body, pos)
                if holds_control(username):
                    raise malformed("the user name holds control characters")
            if connect_flags & _FLAG_PASSWORD and pos != end:
                password, pos = decode_binary(body, pos)
        check_end(cls.TYPE, body, pos)
        clean_start = bool(connect_flags & _FLAG_CLEAN_START)
        return cls(client_id, clean_start, keep_alive, level, username, password, will, properties)

    def __str__(self) -> str:
        parts = [f"CONNECT v{VERSION_NAMES[self.version]} {quote(self.client_id)}"]
        parts.append(f"clean_start={self.clean_start:d} keep_alive={self.keep_alive}")
        if self.username is not None:
            parts.append(f"username={quote(self.username)}")
        if self.will is not None:
            parts.append(f"will={quote(self.will.topic)}")
        return " ".join(parts)


@contextmanager
def _untold() -> Iterator[None]:
    """What is wrong in here ends the connection without an answer."""
    try:
        yield
    except ProtocolError as error:
        error.notify_peer = False
        raise


def _decode_client_id(body: bytes, pos: int) -> tuple[str, int]:
    try:
        client_id, pos = decode_string(body, pos)
    except ProtocolError as error:
        raise ProtocolError(ReasonCode.CLIENT_IDENTIFIER_NOT_VALID, f"client id: {error}") from None
    if holds_control(client_id):
        problem = "the client id holds control characters"
        raise ProtocolError(ReasonCode.CLIENT_IDENTIFIER_NOT_VALID, problem)
    return client_id, pos


def _check_connect_flags(flags: int, v5: bool) -> None:
    if flags & _FLAG_RESERVED:  # [MQTT-3.1.2-3]
        raise malformed("CONNECT with the reserved flag set")
    will_qos = flags >> 3 & 3
    if flags & _FLAG_WILL:
        if will_qos == 3:  # [MQTT-3.1.2-14] v5 [MQTT-3.1.2-12]
            raise malformed("CONNECT with the will QoS 3")
    elif will_qos or flags & _FLAG_WILL_RETAIN:
        # [MQTT-3.1.2-13] [MQTT-3.1.2-15] v5 [MQTT-3.1.2-11] [MQTT-3.1.2-13]
        raise malformed("CONNECT with a will QoS or will retain but no will")
    # [MQTT-3.1.2-22]; v5 allows it, section 3.1.2.9.
    if flags & _FLAG_PASSWORD and not flags & _FLAG_USERNAME and not v5:
        raise malformed("CONNECT with a password but no user name")


def _decode_will(
    flags: int, body: bytes, pos: int, v5: bool, pairs: int | None
) -> tuple[Will, int]:
    properties: Properties | None = None
    passed_on = NO_PROPERTIES
    if v5 and pairs is None:
        properties, pos = decode_properties(body, pos, len(body), WILL)
    elif v5:
        checked, pos = check_properties(body, pos, len(body), WILL, pairs or 0)
        if checked is not None:
            properties, passed_on = checked.values, checked.passed_on
    with _untold():
        topic, pos = decode_string(body, pos)
        try:
            check_topic(topic)
        except ValueError as error:
            raise malformed(f"will topic: {error}") from error
        payload, pos = decode_binary(body, pos)
    retain = bool(flags & _FLAG_WILL_RETAIN)
    return Will(topic, payload, flags >> 3 & 3, retain, properties, passed_on), pos


@dataclass(slots=True)
class Connack:
    """CONNACK (section 3.2): the server's answer to CONNECT.

    3.1.1 has five refusals only; `encode` picks the nearest, see `reason.connack_v311`.
    """

    TYPE: ClassVar[PacketType] = PacketType.CONNACK

    session_present: bool = False
    reason_code: int = ReasonCode.SUCCESS
    # Authentication Data may be in there.
    properties: Properties | None = field(default=None, repr=False)

    def encode(self, version: int) -> bytes:
        """The whole packet."""
        if version == V5:
            parts = (bytes((self.session_present, self.reason_code)),)
            return frame(self.TYPE, 0, *parts, encode_properties(self.properties))
        return frame(self.TYPE, 0, bytes((self.session_present, connack_v311(self.reason_code))))

    @classmethod
    def decode(cls, flags: int, body: bytes, version: int, pairs: int | None = None) -> Connack:
        """The packet, a return code of 3.1.1 as the reason code that means the same."""
        check_flags(cls.TYPE, flags)
        acknowledge_flags, pos = decode_byte(body, 0)
        if acknowledge_flags > 1:  # v5 [MQTT-3.2.2-1]
            raise malformed("CONNACK with a reserved flag set")
        code, pos = decode_byte(body, pos)
        properties = None
        if version == V5:
            reason_code = decode_reason(cls.TYPE, code, _CONNACK_REASONS)
            properties, pos = read_properties(body, pos, len(body), cls.TYPE, pairs)
            _check_authentication(cls.TYPE, properties)
        elif code <= 5:
            reason_code = connack_v5(code)
        else:
            raise protocol_error(f"CONNACK with the return code {code}")
        check_end(cls.TYPE, body, pos)
        if acknowledge_flags and reason_code:  # [MQTT-3.2.2-4] v5 [MQTT-3.2.2-6]
            raise protocol_error("CONNACK with an error and a session")
        return cls(bool(acknowledge_flags), reason_code, properties)

    def __str__(self) -> str:
        return f"CONNACK {reason_name(self.reason_code)} session_present={self.session_present:d}"


@dataclass(slots=True)
class Auth:
    """AUTH (5.0 section 3.15): a step of enhanced authentication. 3.1.1 has no such packet."""

    TYPE: ClassVar[PacketType] = PacketType.AUTH

    reason_code: int = ReasonCode.SUCCESS
    # Authentication Data may be in there.
    properties: Properties | None = field(default=None, repr=False)

    def encode(self, version: int) -> bytes:
        """The whole packet, in its shortest form (5.0 section 3.15.2.1)."""
        if version != V5:
            raise ValueError("MQTT 3.1.1 has no AUTH")
        if not (self.reason_code or self.properties):
            return frame(self.TYPE, 0)
        return frame(self.TYPE, 0, bytes((self.reason_code,)), encode_properties(self.properties))

    @classmethod
    def decode(cls, flags: int, body: bytes, version: int, pairs: int | None = None) -> Auth:
        """The packet; empty it is Success."""
        if version != V5:  # Packet type 15 is reserved, section 2.2.1.
            raise malformed("MQTT 3.1.1 has no AUTH")
        check_flags(cls.TYPE, flags)  # v5 [MQTT-3.15.1-1]
        if not body:
            return cls()
        reason_code = decode_reason(cls.TYPE, body[0], _AUTH_REASONS)
        properties, pos = read_properties(body, 1, len(body), cls.TYPE, pairs)
        check_end(cls.TYPE, body, pos)
        _check_authentication(cls.TYPE, properties, needed=reason_code != ReasonCode.SUCCESS)
        return cls(reason_code, properties)

    def __str__(self) -> str:
        return f"AUTH {reason_name(self.reason_code)}"
