"""Messages that go in a circle are recognised by the robots that they have passed."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from appliance.mqtt.codec import (
    NO_PROPERTIES,
    PacketType,
    Property,
    decode_properties,
    encode_properties,
)
from appliance.upstream.loops import MOST_ROBOTS, VIA, circle, passed, with_via

NAMES = st.text("abc-", min_size=1, max_size=5)


@given(st.lists(NAMES, max_size=12), st.integers(0, 300))
def test_each_robot_on_the_way_is_named_in_order(robots: list[str], size: int) -> None:
    start = encode_properties(
        {
            Property.CONTENT_TYPE: "x" * size,  # so that the length may take one byte or two
            Property.USER_PROPERTY: [("a", VIA), ("b", "c")],
        }
    )
    wire = start
    for robot in robots:
        wire = with_via(wire, robot)
    assert passed(wire) == robots
    decoded, end = decode_properties(wire, 0, len(wire), PacketType.PUBLISH)
    assert end == len(wire) and decoded is not None
    assert decoded[Property.USER_PROPERTY] == [
        ("a", VIA),
        ("b", "c"),
        *((VIA, robot) for robot in robots),
    ]
    assert decoded[Property.CONTENT_TYPE] == "x" * size


def test_most_messages_have_passed_nobody() -> None:
    assert passed(NO_PROPERTIES) == []
    assert passed(encode_properties({Property.USER_PROPERTY: [("a", VIA)]})) == []
    assert circle(NO_PROPERTIES, "r2") == ""
    assert passed(with_via(NO_PROPERTIES, "r2")) == ["r2"]


def test_what_was_here_before_is_not_taken_on() -> None:
    wire = NO_PROPERTIES
    for number in range(MOST_ROBOTS):
        wire = with_via(wire, f"robot{number}")
        assert circle(wire, "r2") == ""
        assert circle(wire, "robot0") == "it has been at robot0 before"
    assert circle(with_via(wire, "one more"), "r2") == "it has passed more than 8 robots"
