"""Reason codes (MQTT 5.0 section 2.4) and the error that carries one."""

from __future__ import annotations

from enum import IntEnum


class ReasonCode(IntEnum):
    """The reason codes of MQTT 5.0, section 2.4; those from 0x80 on are failures.

    This package uses them for MQTT 3.1.1, too: packets translate them when they are encoded.
    """

    SUCCESS = 0x00
    NORMAL_DISCONNECTION = 0x00
    GRANTED_QOS_0 = 0x00
    GRANTED_QOS_1 = 0x01
    GRANTED_QOS_2 = 0x02
    DISCONNECT_WITH_WILL_MESSAGE = 0x04
    NO_MATCHING_SUBSCRIBERS = 0x10
    NO_SUBSCRIPTION_EXISTED = 0x11
    CONTINUE_AUTHENTICATION = 0x18
    RE_AUTHENTICATE = 0x19
    UNSPECIFIED_ERROR = 0x80
    MALFORMED_PACKET = 0x81
    PROTOCOL_ERROR = 0x82
    IMPLEMENTATION_SPECIFIC_ERROR = 0x83
    UNSUPPORTED_PROTOCOL_VERSION = 0x84
    CLIENT_IDENTIFIER_NOT_VALID = 0x85
    BAD_USER_NAME_OR_PASSWORD = 0x86
    NOT_AUTHORIZED = 0x87
    SERVER_UNAVAILABLE = 0x88
    SERVER_BUSY = 0x89
    BANNED = 0x8A
    SERVER_SHUTTING_DOWN = 0x8B
    BAD_AUTHENTICATION_METHOD = 0x8C
    KEEP_ALIVE_TIMEOUT = 0x8D
    SESSION_TAKEN_OVER = 0x8E
    TOPIC_FILTER_INVALID = 0x8F
    TOPIC_NAME_INVALID = 0x90
    PACKET_IDENTIFIER_IN_USE = 0x91
    PACKET_IDENTIFIER_NOT_FOUND = 0x92
    RECEIVE_MAXIMUM_EXCEEDED = 0x93
    TOPIC_ALIAS_INVALID = 0x94
    PACKET_TOO_LARGE = 0x95
    MESSAGE_RATE_TOO_HIGH = 0x96
    QUOTA_EXCEEDED = 0x97
    ADMINISTRATIVE_ACTION = 0x98
    PAYLOAD_FORMAT_INVALID = 0x99
    RETAIN_NOT_SUPPORTED = 0x9A
    QOS_NOT_SUPPORTED = 0x9B
    USE_ANOTHER_SERVER = 0x9C
    SERVER_MOVED = 0x9D
    SHARED_SUBSCRIPTIONS_NOT_SUPPORTED = 0x9E
    CONNECTION_RATE_EXCEEDED = 0x9F
    MAXIMUM_CONNECT_TIME = 0xA0
    SUBSCRIPTION_IDENTIFIERS_NOT_SUPPORTED = 0xA1
    WILDCARD_SUBSCRIPTIONS_NOT_SUPPORTED = 0xA2


class ProtocolError(Exception):
    """The peer violated the protocol: `code` goes into CONNACK or DISCONNECT before the close.

    The message is for the log; it contains no payload and no secret. With `notify_peer` False the
    code is not sent: where the standard leaves that open, this follows mosquitto.
    """

    def __init__(self, code: ReasonCode, message: str, *, notify_peer: bool = True) -> None:
        super().__init__(message)
        self.code = code
        self.notify_peer = notify_peer


class ContentError(ProtocolError):
    """What a publisher has put into a message is wrong, where the packet itself is in order: its
    topic, or a property with which it was published.

    A server may have passed it on as it was: whose fault it is, only the publisher's server knows.
    """


# 3.1.1 has five refusals (table 3.1). 3, "server unavailable", invites the client to try again;
# 5, "not authorized", does not.
_CONNACK_V311 = {
    ReasonCode.SUCCESS: 0,
    ReasonCode.UNSUPPORTED_PROTOCOL_VERSION: 1,
    ReasonCode.CLIENT_IDENTIFIER_NOT_VALID: 2,
    ReasonCode.SERVER_UNAVAILABLE: 3,
    ReasonCode.BAD_USER_NAME_OR_PASSWORD: 4,
    ReasonCode.NOT_AUTHORIZED: 5,
}
_CONNACK_V5 = {return_code: reason for reason, return_code in _CONNACK_V311.items()}
_NOT_WORTH_A_RETRY = frozenset(
    {
        ReasonCode.BANNED,
        ReasonCode.BAD_AUTHENTICATION_METHOD,
        ReasonCode.TOPIC_NAME_INVALID,
        ReasonCode.PACKET_TOO_LARGE,
        ReasonCode.PAYLOAD_FORMAT_INVALID,
        ReasonCode.RETAIN_NOT_SUPPORTED,
        ReasonCode.QOS_NOT_SUPPORTED,
    }
)


def connack_v311(code: int) -> int:
    """The CONNACK return code (0 to 5, MQTT 3.1.1 section 3.2.2.3) that is closest to `code`.

    A return code of 3.1.1 (1 to 5, none of which is a CONNACK reason code of 5.0) is unchanged.
    """
    if code in _CONNACK_V5:
        return code
    if code in _NOT_WORTH_A_RETRY:
        return 5
    return _CONNACK_V311.get(ReasonCode(code), 3)


def connack_v5(return_code: int) -> ReasonCode:
    """The reason code for a CONNACK return code of 3.1.1; KeyError when it is not 0 to 5."""
    return _CONNACK_V5[return_code]
