"""What routes have retained that there are no more is taken back."""

from __future__ import annotations

import pytest
from bridge_harness import LATCHED, STRING, string, to_mqtt, to_ros
from waiting import until

from appliance.broker.message import Message
from appliance.mqtt.codec import Property
from appliance.ros.calls.routes import ActionSettings, CallRoutes, ParameterSettings
from appliance.ros.retained_cleanup import TopicOwners


def of_route(topic):
    told = {Property.USER_PROPERTY: [("ros-type", STRING)]}
    return Message(topic, b"old", 1, True, told)


def topics(harness):
    return sorted(topic for topic, _ in harness.broker.retained.find("r2d2/#"))


def others(harness):
    return [topic for topic in topics(harness) if "/_appliance/" not in topic]


async def test_at_the_start_what_an_earlier_run_has_left(harness):
    inside = harness.broker.accounting.accounts.inside
    alice = harness.broker.accounting.accounts.of_user("alice")
    for topic in ("r2d2/map", "r2d2/gone", "elsewhere/gone", "r2d2/camera/a", "r2d2/only_commands"):
        harness.broker.retained.keep(of_route(topic), inside)
    harness.broker.retained.keep(of_route("r2d2/alices"), alice)
    harness.broker.retained.keep(Message("r2d2/plugins", b"old", 1, True), inside)
    harness.broker.retained.keep(Message("r2d2/node/_param/gone", b"1", 1, True), inside)
    harness.start(to_mqtt("/map"), to_mqtt("/camera/**"), to_ros("/only_commands", type=STRING))
    await harness.settle()
    # Of nodes that are not there yet it stays, and what others have retained, too.
    assert others(harness) == ["r2d2/alices", "r2d2/camera/a", "r2d2/map", "r2d2/plugins"]
    assert harness.broker.retained.get("elsewhere/gone") is None


async def test_at_a_reload(harness, caplog):
    caplog.set_level("INFO")
    harness.start(to_mqtt("/map"), to_mqtt("/camera/*"))
    for name in ("/map", "/camera/a"):
        harness.node.add_publisher(name, STRING, LATCHED).publish(string("latched"))
    await until(lambda: others(harness) == ["r2d2/camera/a", "r2d2/map"])
    harness.client.received.clear()
    harness.bridge.replace([to_mqtt("/camera/*")])
    harness.bridge.clean_up_retained()
    harness.node.spin()
    await until(lambda: others(harness) == ["r2d2/camera/a"])
    assert harness.client.payloads("r2d2/map") == [b""], "who subscribes is told that it is gone"
    await until(lambda: "taken back: 1" in caplog.text, "the end of the sweep")
    harness.bridge.replace([to_mqtt("/camera/*", retain=False)])
    harness.node.spin()
    await until(lambda: others(harness) == [])


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
