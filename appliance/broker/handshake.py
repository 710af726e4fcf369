"""Negotiation of a connection: what a CONNECT requests, what is granted, and the CONNACK."""

from __future__ import annotations

from dataclasses import dataclass

from appliance.broker.delivery import PendingWill
from appliance.broker.limits import USUAL_PACKET_SIZE, Features, Limits, Terms
from appliance.broker.message import Message
from appliance.broker.values import Identity
from appliance.mqtt.codec import VERSION_NAMES, Properties, Property
from appliance.mqtt.packets import Connect
from appliance.mqtt.reason import ProtocolError, ReasonCode

#: The longest string, in bytes (5.0 section 1.5.4).
LONGEST_STRING = 0xFFFF


@dataclass(frozen=True, slots=True)
class Agreement:
    """The values granted to one connection; times in seconds, 0 for none."""

    keep_alive: int
    expiry: int
    #: QoS 1 and 2 messages that may be in flight to the client.
    window: int
    #: Topic aliases that may be used towards the client.
    aliases: int
    #: Whether it accepts reason strings (Request Problem Information).
    explain: bool


def agree(connect: Connect, limits: Limits) -> Agreement:
    """Grant what the client requests, as far as the limits allow.

    Raises:
        ProtocolError: 0x85, the keep alive of a 3.1.1 client is too long, which CONNACK cannot say.
    """
    expiry = _number(connect, Property.SESSION_EXPIRY_INTERVAL, 0)
    if connect.version != 5:
        expiry = 0 if connect.clean_start else limits.session_expiry
    return Agreement(
        keep_alive=_keep_alive(connect, limits.keep_alive),
        expiry=min(expiry, limits.session_expiry),
        window=min(_number(connect, Property.RECEIVE_MAXIMUM, 65535), limits.inflight),
        aliases=min(_number(connect, Property.TOPIC_ALIAS_MAXIMUM, 0), limits.topic_alias),
        explain=bool(_number(connect, Property.REQUEST_PROBLEM_INFORMATION, 1)),
    )


def maximum_packet_size(connect: Connect) -> int:
    """The largest packet that the client accepts, in bytes, CONNACK included; 0 for any."""
    return _number(connect, Property.MAXIMUM_PACKET_SIZE, 0)


def _keep_alive(connect: Connect, limit: int) -> int:
    """The keep alive; only a limit below the protocol's maximum reduces it."""
    asked = connect.keep_alive
    if limit == 0xFFFF or 0 < asked <= limit:
        return asked
    if connect.version != 5:  # as mosquitto does
        raise ProtocolError(
            ReasonCode.CLIENT_IDENTIFIER_NOT_VALID,
            f"keep alive {asked} s, more than the limit of {limit} s (broker.limits.keep_alive)",
        )
    return limit


def connack_properties(
    connect: Connect,
    agreement: Agreement,
    identity: Identity,
    limits: Limits,
    features: Features,
    terms: Terms,
    authentication: Properties,
) -> Properties | None:
    """The properties of CONNACK, in mosquitto's order: the limits that the client must observe.

    Values that are as requested, or the standard's default, are left out. `authentication` are the
    last properties of an enhanced authentication.
    """
    if connect.version != 5:
        return None
    properties: Properties = {}
    if connect.keep_alive != agreement.keep_alive:  # [MQTT-3.1.2-21], [MQTT-3.2.2-22]
        properties[Property.SERVER_KEEP_ALIVE] = agreement.keep_alive
    if limits.topic_alias:
        properties[Property.TOPIC_ALIAS_MAXIMUM] = limits.topic_alias
    if not connect.client_id:  # [MQTT-3.2.2-16]
        properties[Property.ASSIGNED_CLIENT_IDENTIFIER] = identity.client_id
    if _number(connect, Property.SESSION_EXPIRY_INTERVAL, 0) != agreement.expiry:
        properties[Property.SESSION_EXPIRY_INTERVAL] = agreement.expiry
    asked = _number(connect, Property.REQUEST_RESPONSE_INFORMATION, 0)
    if asked and features.response_information:  # [MQTT-3.1.2-28]
        information = features.response_information.replace("%c", identity.client_id)
        information = information.replace("%u", identity.username or "")
        if len(information.encode()) <= LONGEST_STRING:  # a user name may be that long by itself
            properties[Property.RESPONSE_INFORMATION] = information
    properties |= authentication
    if not terms.retain:
        properties[Property.RETAIN_AVAILABLE] = 0
    if limits.packet_size < USUAL_PACKET_SIZE:
        properties[Property.MAXIMUM_PACKET_SIZE] = limits.packet_size
    if limits.inflight != 0xFFFF:
        properties[Property.RECEIVE_MAXIMUM] = limits.inflight
    if terms.max_qos < 2:  # [MQTT-3.2.2-9]
        properties[Property.MAXIMUM_QOS] = terms.max_qos
    return properties


def refusal_of_connect(
    connect: Connect, client_id: str, payload_size: int, terms: Terms
) -> tuple[ReasonCode, str] | None:
    """Why this listener does not take such a client, if so: the code for CONNACK, and in words.

    `client_id` is the one that it will have, also where the broker gives it.
    """
    if connect.version not in terms.versions:  # [MQTT-3.1.2-2], 3.1.1 [MQTT-3.1.2-2]
        name = VERSION_NAMES[connect.version]
        reason = f"MQTT {name} is not spoken at its listener (protocol_versions)"
        return ReasonCode.UNSUPPORTED_PROTOCOL_VERSION, reason
    prefixes = terms.client_id_prefixes
    if prefixes and not client_id.startswith(prefixes):
        reason = "its id begins otherwise than its listener asks for (client_id_prefixes)"
        return ReasonCode.CLIENT_IDENTIFIER_NOT_VALID, reason
    will = connect.will
    if will is None:
        return None
    if will.qos > terms.max_qos:  # [MQTT-3.2.2-12]
        reason = f"its will has QoS {will.qos}, more than its listener's max_qos of {terms.max_qos}"
        return ReasonCode.QOS_NOT_SUPPORTED, reason
    if will.retain and not terms.retain:  # [MQTT-3.2.2-13]
        reason = "its will is to be retained, which its listener does not take (retain: false)"
        return ReasonCode.RETAIN_NOT_SUPPORTED, reason
    if len(will.payload) > payload_size:
        return ReasonCode.QUOTA_EXCEEDED, f"its will has {too_large(will.payload, payload_size)}"
    return None


def too_large(payload: bytes, limit: int) -> str:
    """What is wrong with a payload that exceeds the limit."""
    return f"a payload of {len(payload)} bytes, more than {limit} (broker.limits.payload_size)"


def pending_will(connect: Connect) -> PendingWill | None:
    """The will of a CONNECT."""
    will = connect.will
    if will is None:
        return None
    properties = will.properties or {}
    delay = properties.get(Property.WILL_DELAY_INTERVAL, 0)
    expiry = properties.get(Property.MESSAGE_EXPIRY_INTERVAL)
    assert isinstance(delay, int)
    message = Message(
        will.topic, will.payload, will.qos, will.retain, properties_wire=will.passed_on
    )
    return PendingWill(message, delay, expiry if isinstance(expiry, int) else None)


def is_text(payload: bytes, properties: Properties | None) -> bool:
    """Whether the payload is UTF-8 text, if the Payload Format Indicator says so."""
    if not properties or not properties.get(Property.PAYLOAD_FORMAT_INDICATOR):
        return True
    try:
        payload.decode()
    except UnicodeDecodeError:
        return False
    return True


def _number(connect: Connect, name: Property, default: int) -> int:
    value = (connect.properties or {}).get(name, default)
    assert isinstance(value, int)
    return value
