"""What a CONNECT asks for, what it gets of that, and how CONNACK says so."""

from __future__ import annotations

from dataclasses import dataclass

from appliance.broker.message import Message
from appliance.broker.ports import USUAL_PACKET_SIZE, Features, Identity, Limits
from appliance.broker.session import PendingWill
from appliance.mqtt.codec import Properties, Property
from appliance.mqtt.packets import Connect
from appliance.mqtt.reason import ProtocolError, ReasonCode

#: Bytes of a string, at most (5.0 section 1.5.4).
LONGEST_STRING = 0xFFFF


@dataclass(frozen=True, slots=True)
class Agreement:
    """What holds for one connection; times in seconds, 0 for none."""

    keep_alive: int
    expiry: int
    #: QoS 1 and 2 messages that may be on their way to the client.
    window: int
    #: Topic names that may be shortened to a number on the way to the client.
    aliases: int
    #: Whether it may be told more than a reason code (Request Problem Information).
    explain: bool


def agree(connect: Connect, limits: Limits) -> Agreement:
    """What the client asked for, as far as the limits allow.

    Raises:
        ProtocolError: 0x85, a 3.1.1 client cannot be told that its keep alive is too long.
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
    """The largest packet that the client takes, in bytes, from the first answer on; 0 for any."""
    return _number(connect, Property.MAXIMUM_PACKET_SIZE, 0)


def _keep_alive(connect: Connect, limit: int) -> int:
    """Only a limit below the protocol's own caps what was asked for."""
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
    authentication: Properties,
) -> Properties | None:
    """What the client must know to keep within the limits, in mosquitto's order.

    Whatever is as the client asked, or as the standard says without it, is left out.
    `authentication` is what ends an enhanced authentication.
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
    if limits.packet_size < USUAL_PACKET_SIZE:
        properties[Property.MAXIMUM_PACKET_SIZE] = limits.packet_size
    if limits.inflight != 0xFFFF:
        properties[Property.RECEIVE_MAXIMUM] = limits.inflight
    return properties


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
    """Whether a payload that says it is UTF-8 text is that (Payload Format Indicator)."""
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
