"""Messages that go in a circle: the user property `appliance-via` names the robots on the way.

A link adds its robot's name to what it sends. What has its own name, or came over more than eight
robots, is dropped when it comes in. MQTT 3.1.1 has no user properties; there the rules of a link
must not overlap, see `UpstreamSettings.overlapping`.
"""

from __future__ import annotations

from typing import Final, cast

from appliance.mqtt.codec import (
    PacketType,
    Property,
    decode_properties,
    decode_varint,
    encode_string,
    encode_varint,
)

VIA: Final = "appliance-via"

#: The most robots that a message passes: more are a circle in which nobody knows its own name.
MOST_ROBOTS: Final = 8

#: User properties that a message gets on its way, at most: of each link the robot, `id` and
#: `published-at`.
MOST_ADDED: Final = 3 * (MOST_ROBOTS + 1)

_PAIR: Final = bytes((Property.USER_PROPERTY,)) + encode_string(VIA)


def passed(properties: bytes) -> list[str]:
    """The robots that a message has passed, from its encoded and valid properties.

    The properties are those of `Message.properties_wire`, with their length in front.
    """
    if _PAIR not in properties:  # most messages: nothing has to be decoded
        return []
    decoded = decode_properties(properties, 0, len(properties), PacketType.PUBLISH)[0] or {}
    pairs = cast("list[tuple[str, str]]", decoded.get(Property.USER_PROPERTY, []))
    return [robot for name, robot in pairs if name == VIA]


def circle(properties: bytes, robot: str) -> str:
    """Why a message is not to be taken on by that robot; empty when it is."""
    robots = passed(properties)
    if robot in robots:
        return f"it has been at {robot} before"
    if len(robots) > MOST_ROBOTS:
        return f"it has passed more than {MOST_ROBOTS} robots"
    return ""


def with_via(properties: bytes, robot: str) -> bytes:
    """The encoded properties with this robot's name added, behind all others."""
    start = decode_varint(properties, 0)[1]
    inside = properties[start:] + _PAIR + encode_string(robot)
    return encode_varint(len(inside)) + inside
