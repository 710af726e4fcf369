"""The retained schemas of what is bridged: which there are, and how many at most."""

from __future__ import annotations

import asyncio
import json
import threading

import pytest
from waiting import PATIENCE, until

from appliance.broker.broker import Broker
from appliance.mqtt.codec import Property
from appliance.net.callbacks import Entries
from appliance.ros import schema_topics
from appliance.ros.node import FakeNode
from appliance.ros.payload.definitions import UnknownTypeError, load_description
from appliance.ros.schema_topics import SchemaTopics
from appliance.store import MemoryStore

pytest.importorskip("test_msgs.action")
from bridge_harness import STRING, TWIST, Client, Harness, Rules, to_ros
from call_harness import AllTypes, CallHarness, action, service

SCHEMAS = "r2d2/_appliance/schema/"
FIBONACCI, SET_BOOL = "test_msgs/action/Fibonacci", "std_srvs/srv/SetBool"
STRING_SCHEMA, TWIST_SCHEMA = f"{SCHEMAS}std_msgs/String", f"{SCHEMAS}geometry_msgs/Twist"


@pytest.fixture
async def harness():
    harness = Harness()
    yield harness
    await harness.bridge.stop()


def names(broker):
    """The types that have a schema."""
    return {topic.removeprefix(SCHEMAS) for topic, _ in broker.retained.find(f"{SCHEMAS}#")}


async def test_bridged_types_have_a_schema(harness):
    harness.start(to_ros("/chatter", type=STRING), to_ros("/cmd_vel", type=TWIST))
    retained = harness.broker.retained
    await until(lambda: retained.get(STRING_SCHEMA) and retained.get(TWIST_SCHEMA), "both schemas")
    schema = retained.get(TWIST_SCHEMA)
    assert json.loads(schema.payload)["title"] == TWIST
    assert schema.properties[Property.CONTENT_TYPE] == "application/schema+json"
    harness.bridge.replace([to_ros("/cmd_vel", type=TWIST)])
    harness.node.spin()
    await until(lambda: retained.get(STRING_SCHEMA) is None, "the schema goes with its route")
    assert retained.get(TWIST_SCHEMA) is not None


async def test_those_of_before_a_crash_are_cleared(harness):
    harness.client.send(TWIST_SCHEMA, b"{}", retain=True)
    harness.start(to_ros("/chatter", type=STRING))
    await until(lambda: names(harness.broker) == {"std_msgs/String"}, "the schema of now alone")


async def test_services_and_actions_have_schemas():
    harness = CallHarness(FakeNode(types=AllTypes()))
    harness.node.add_service("/arm/grip", SET_BOOL, None)
    for name, kind in (("send_goal", "_SendGoal"), ("get_result", "_GetResult")):
        harness.node.add_service(f"/walk/_action/{name}", FIBONACCI + kind, None)
    harness.node.add_service("/walk/_action/cancel_goal", "action_msgs/srv/CancelGoal", None)
    harness.start(service("/arm/grip"), action("/walk"))
    harness.node.spin()
    expected = {f"{SET_BOOL}_{part}" for part in ("Request", "Response")} | {
        f"{FIBONACCI}_{part}" for part in ("Goal", "Feedback", "Result")
    }
    await until(lambda: names(harness.broker) == expected, "schemas of calls")
    goal = json.loads(harness.broker.retained.get(f"{SCHEMAS}{FIBONACCI}_Goal").payload)
    assert goal["properties"]["order"]["type"] == "integer"
    entries = {entry["ros"]: entry for entry in harness.bridge.calls.bridged()}
    assert entries["/walk"]["cancel"] == "own" and entries["/walk"]["timeout"] == 5.0
    await harness.bridge.stop()
    assert names(harness.broker) == set()


class Schemas:
    """The schemas alone, of types that a test describes."""

    def __init__(self, describe):
        self.broker = Broker(Rules(), MemoryStore())
        entries = Entries(asyncio.get_running_loop(), self.broker.faults)
        self.topics = SchemaTopics(self.broker, entries, "r2d2", describe)
        self.topics.start(Client(self.broker).session)

    @property
    def names(self):
        return names(self.broker)


async def test_a_slow_description_holds_nobody_up():
    """The loop goes on while a thread describes; what is bridged no more is not published."""
    begun, go_on = threading.Event(), threading.Event()

    def slow(name):
        begun.set()
        go_on.wait(PATIENCE)
        return load_description(name)

    schemas = Schemas(slow)
    schemas.topics.replace([STRING, TWIST])
    await until(begun.is_set, "the thread")
    assert schemas.names == set()
    schemas.topics.replace([TWIST])
    go_on.set()
    await until(lambda: schemas.names == {"geometry_msgs/Twist"}, "that of the route left")


async def test_one_that_fails_is_tried_once_and_harms_no_other(caplog):
    asked = []

    def broken(name):
        asked.append(name)
        if name == STRING:
            raise UnknownTypeError("not installed")
        return load_description(name)

    schemas = Schemas(broken)
    for _ in range(2):
        schemas.topics.replace([STRING, TWIST])
        await until(lambda: schemas.names == {"geometry_msgs/Twist"}, "the other")
    assert asked == [STRING, TWIST]
    assert caplog.text.count("there is no schema of std_msgs/msg/String: not installed") == 1


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("MOST", 1, "and others: 1 are published"),
        ("MOST_BYTES", 300, "and others: 1 are published"),
        ("LARGEST", 300, "it has "),
    ],
)
async def test_they_are_bounded(monkeypatch, caplog, name, value, said):
    monkeypatch.setattr(schema_topics, name, value)
    schemas = Schemas(load_description)
    schemas.topics.replace([STRING, TWIST])
    await until(lambda: said in caplog.text, "the warning")
    assert schemas.names == {"std_msgs/String"}
    schemas.topics.replace([TWIST])
    assert schemas.names == set()
