"""What routes have retained that there are no more is taken back."""

from __future__ import annotations

import pytest
from test_bridge import LATCHED, STRING, house, string, to_mqtt, to_ros
from waiting import until

from appliance.broker.message import Message
from appliance.mqtt.codec import Property
from appliance.ros.calls.routes import ActionSettings, CallRoutes, ParameterSettings
from appliance.ros.retained_cleanup import TopicOwners

__all__ = ["house"]


def of_route(topic):
    told = {Property.USER_PROPERTY: [("ros-type", STRING)]}
    return Message(topic, b"old", 1, True, told)


def topics(house):
    return sorted(topic for topic, _ in house.broker.retained.find("r2d2/#"))


def others(house):
    return [topic for topic in topics(house) if "/_appliance/" not in topic]


async def test_at_the_start_what_an_earlier_run_has_left(house):
    inside = house.broker.accounting.accounts.inside
    alice = house.broker.accounting.accounts.of_user("alice")
    for topic in ("r2d2/map", "r2d2/gone", "elsewhere/gone", "r2d2/camera/a", "r2d2/only_commands"):
        house.broker.retained.keep(of_route(topic), inside)
    house.broker.retained.keep(of_route("r2d2/alices"), alice)
    house.broker.retained.keep(Message("r2d2/plugins", b"old", 1, True), inside)
    house.broker.retained.keep(Message("r2d2/node/_param/gone", b"1", 1, True), inside)
    house.start(to_mqtt("/map"), to_mqtt("/camera/**"), to_ros("/only_commands", type=STRING))
    await house.settle()
    # Of nodes that are not there yet it stays, and what others have retained, too.
    assert others(house) == ["r2d2/alices", "r2d2/camera/a", "r2d2/map", "r2d2/plugins"]
    assert house.broker.retained.get("elsewhere/gone") is None


async def test_at_a_reload(house, caplog):
    caplog.set_level("INFO")
    house.start(to_mqtt("/map"), to_mqtt("/camera/*"))
    for name in ("/map", "/camera/a"):
        house.node.add_publisher(name, STRING, LATCHED).publish(string("latched"))
    await until(lambda: others(house) == ["r2d2/camera/a", "r2d2/map"])
    house.client.received.clear()
    house.bridge.replace([to_mqtt("/camera/*")])
    house.bridge.forget_leftovers()
    house.node.spin()
    await until(lambda: others(house) == ["r2d2/camera/a"])
    assert house.client.payloads("r2d2/map") == [b""], "who subscribes is told that it is gone"
    assert "taken back: 1" in caplog.text
    house.bridge.replace([to_mqtt("/camera/*", retain=False)])
    house.node.spin()
    await until(lambda: others(house) == [])


@pytest.mark.parametrize(
    ("topic", "is_owned"),
    [
        ("r2/walk/_status", True),
        ("r2/walk/_result/00", True),
        ("r2/run/_status", False),
        ("r2/controller/_param/p", True),
        ("r2/controller/_param/secret", False),
        ("r2/other/_param/p", False),
        ("r2/_param/use_sim_time", True),  # of ROS 1
        ("r2/controller/p", False),
    ],
)
def test_what_is_called_has_topics_too(topic, is_owned):
    calls = CallRoutes(
        actions=(ActionSettings(names=("/walk",), mqtt="r2/walk"),),
        parameters=(
            ParameterSettings(
                names=("/controller/*", "!/controller/secret", "/use_sim_time"),
                mqtt="r2{node}/_param",
            ),
        ),
    )
    assert TopicOwners([], calls).has(topic) is is_owned
