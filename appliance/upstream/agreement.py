"""What a connection to a fleet's broker asks for, what it is granted, and how it ended."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Final, cast

from appliance.mqtt.codec import MAX_LENGTH, V5, Properties, Property
from appliance.mqtt.framing import DEFAULT_PAIRS
from appliance.mqtt.packets import Connack, Connect, Will
from appliance.mqtt.reason import ReasonCode

#: Characters of a reason of the broker's in a text, and of ours in a DISCONNECT.
LONGEST_REASON: Final = 256


@dataclass(frozen=True, slots=True)
class ConnectSettings:
    """What CONNECT asks for. Intervals are in seconds, sizes in bytes.

    `window` limits the messages sent and not acknowledged, `receive_maximum` the ones received.
    `maximum_packet_size` and `user_properties` (how many) limit received packets; version 3.1.1
    has no way to announce these.
    """

    client_id: str
    version: int = V5
    clean_start: bool = True
    session_expiry: int = 0
    keep_alive: int = 30
    username: str | None = None
    password: bytes | None = field(default=None, repr=False)
    will: Will | None = None
    method: str | None = None
    authentication_data: bytes | None = field(default=None, repr=False)
    window: int = 1000
    receive_maximum: int = 1000
    maximum_packet_size: int = 16 << 20
    topic_alias_maximum: int = 32
    user_properties: int = DEFAULT_PAIRS
    filters_per_packet: int = 100

    def connect(self) -> Connect:
        """The packet (section 3.1)."""
        properties: Properties = {}
        if self.version == V5:
            if self.session_expiry:
                properties[Property.SESSION_EXPIRY_INTERVAL] = self.session_expiry
            if self.receive_maximum < MAX_LENGTH:
                properties[Property.RECEIVE_MAXIMUM] = self.receive_maximum
            properties[Property.MAXIMUM_PACKET_SIZE] = self.maximum_packet_size
            if self.topic_alias_maximum:
                properties[Property.TOPIC_ALIAS_MAXIMUM] = self.topic_alias_maximum
            if self.method is not None:
                properties[Property.AUTHENTICATION_METHOD] = self.method
                if self.authentication_data is not None:
                    properties[Property.AUTHENTICATION_DATA] = self.authentication_data
        return Connect(
            self.client_id,
            self.clean_start,
            self.keep_alive,
            self.version,
            self.username,
            self.password,
            self.will,
            properties or None,
        )


@dataclass(frozen=True, slots=True)
class Granted:
    """What the broker's CONNACK allows (5.0 section 3.2.2.3); what 3.1.1 does not say is allowed.

    `window` is the lesser of ours and the Receive Maximum. `maximum_packet_size` is in bytes,
    None for no limit. `keep_alive` and `session_expiry` are in seconds. `wildcards`, `identifiers`
    and `shared` say which kinds of subscription there are. `properties` are those of the packet.
    """

    session_present: bool
    client_id: str
    window: int
    receive_maximum: int
    maximum_qos: int
    retain: bool
    maximum_packet_size: int | None
    topic_alias_maximum: int
    keep_alive: int
    session_expiry: int
    wildcards: bool
    identifiers: bool
    shared: bool
    properties: Properties = field(default_factory=dict, repr=False)
    reason: str = ""
    server_reference: str | None = None
    authentication_data: bytes | None = field(default=None, repr=False)


class EndedBy(Enum):
    """Who ended a connection."""

    US = "this appliance"
    BROKER = "the broker"
    NETWORK = "the network"


#: Reason codes of DISCONNECT that may be about a message or a subscription that is not allowed.
REFUSALS: Final = frozenset(
    (
        ReasonCode.UNSPECIFIED_ERROR,
        ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR,
        ReasonCode.NOT_AUTHORIZED,
        ReasonCode.TOPIC_FILTER_INVALID,
        ReasonCode.TOPIC_NAME_INVALID,
        ReasonCode.PAYLOAD_FORMAT_INVALID,
        ReasonCode.RETAIN_NOT_SUPPORTED,
        ReasonCode.QOS_NOT_SUPPORTED,
        ReasonCode.WILDCARD_SUBSCRIPTIONS_NOT_SUPPORTED,
    )
)


@dataclass(frozen=True, slots=True)
class Ending:
    """How a connection ended. `text` is for people, and contains no secret.

    `code` is the reason code, UNSPECIFIED_ERROR where there is none. `refused` says that CONNACK
    had an error, `is_new` that the connection ended before CONNACK or by it: some brokers that do
    not know a version say so (`refuses_version`), some only close the connection. `is_silent` says
    that nothing was heard any more, `is_violation` that the broker has violated the protocol,
    `is_close` that it has closed the connection between two packets, and said no reason.
    """

    by: EndedBy
    code: ReasonCode
    text: str
    is_new: bool = False
    refused: bool = False
    server_reference: str | None = None
    is_silent: bool = False
    is_violation: bool = False
    is_close: bool = False

    @property
    def may_refuse(self) -> bool:
        """Whether the broker may have ended the connection because of something that it was sent
        and has not answered, and does not allow."""
        return self.is_close or (self.by is EndedBy.BROKER and self.code in REFUSALS)

    @property
    def refuses_version(self) -> bool:
        """Whether the broker says that it does not know this version of MQTT."""
        return self.code == ReasonCode.UNSUPPORTED_PROTOCOL_VERSION


def granted_by(settings: ConnectSettings, packet: Connack) -> Granted:
    """What CONNACK allows, with the defaults of what it does not say."""
    properties = packet.properties or {}

    def number(name: Property, default: int) -> int:
        return cast(int, properties.get(name, default))

    receive_maximum = number(Property.RECEIVE_MAXIMUM, MAX_LENGTH)
    is_v5 = settings.version == V5
    return Granted(
        session_present=packet.session_present,
        client_id=cast(
            str, properties.get(Property.ASSIGNED_CLIENT_IDENTIFIER, settings.client_id)
        ),
        window=min(settings.window, receive_maximum),
        receive_maximum=receive_maximum,
        maximum_qos=number(Property.MAXIMUM_QOS, 2),
        retain=bool(number(Property.RETAIN_AVAILABLE, 1)),
        maximum_packet_size=cast("int | None", properties.get(Property.MAXIMUM_PACKET_SIZE)),
        topic_alias_maximum=number(Property.TOPIC_ALIAS_MAXIMUM, 0),
        keep_alive=number(Property.SERVER_KEEP_ALIVE, settings.keep_alive),  # [MQTT-3.1.2-21]
        session_expiry=number(Property.SESSION_EXPIRY_INTERVAL, settings.session_expiry),
        wildcards=bool(number(Property.WILDCARD_SUBSCRIPTION_AVAILABLE, 1)),
        identifiers=is_v5 and bool(number(Property.SUBSCRIPTION_IDENTIFIER_AVAILABLE, 1)),
        shared=is_v5 and bool(number(Property.SHARED_SUBSCRIPTION_AVAILABLE, 1)),
        properties=properties,
        reason=reason_string(properties),
        server_reference=cast("str | None", properties.get(Property.SERVER_REFERENCE)),
        authentication_data=cast("bytes | None", properties.get(Property.AUTHENTICATION_DATA)),
    )


def reason_string(properties: Properties | None) -> str:
    """The peer's reason, not longer than is useful in a log."""
    reason = cast(str, (properties or {}).get(Property.REASON_STRING, ""))
    return reason if len(reason) <= LONGEST_REASON else reason[: LONGEST_REASON - 1] + "…"
