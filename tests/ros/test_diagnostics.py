"""What the bridge tells on /diagnostics, on a FakeNode; and what its figures are made of."""

from __future__ import annotations

import asyncio
import logging

import pytest
from waiting import until

from appliance.broker.broker import Broker
from appliance.broker.histogram import BOUNDS, Histogram
from appliance.broker.meter import Meter
from appliance.ros.bridge import Bridge
from appliance.ros.metrics import FlowCounters
from appliance.ros.node import FakeNode
from appliance.ros.topics.rules import CommandRules

pytest.importorskip("diagnostic_msgs.msg")
from bridge_harness import STRING, TWIST, Client, Harness, string, to_mqtt, to_ros
from command_harness import GO, All, AllAllowed, Driver

from appliance.ros.diagnostics import TYPE
from appliance.ros.payload.converter import Converters
from appliance.ros.payload.definitions import load_description
from appliance.store import MemoryStore

OK, WARN, ERROR = 0, 1, 2


class Installed(All):
    """All types but those of one package that there is not, and what is left out."""

    def __init__(self):
        super().__init__()
        self.without = {"no_msgs/msg/Such"}

    def __contains__(self, name):
        return name not in self.without


class DiagnosticsHarness(Harness):
    """A harness with another node that listens to /diagnostics."""

    def __init__(self):
        super().__init__()
        self.broker.detach(self.client.session)
        self.client = Client(self.broker)
        self.broker.access = AllAllowed()
        self.node.types = Installed()
        self.listener = self.node.add_subscriber("/diagnostics", TYPE)
        self.converter = Converters(load_description).get(TYPE)

    def start(self, *routes, interval=0.02):
        loop = asyncio.get_running_loop()
        self.bridge = Bridge(self.node, self.broker, routes, loop, "r2d2", diagnostics=interval)
        self.bridge.start()
        return self.bridge

    async def told(self):
        """The next statuses, by name, with their values as a dict."""
        seen = len(self.listener.received)
        await until(lambda: len(self.listener.received) > seen, "the next statuses")
        message = self.converter.to_dict(self.listener.received[seen])
        assert message["header"]["stamp"]["sec"] > 1_600_000_000
        statuses = message["status"]
        for status in statuses:
            assert status["hardware_id"] == "r2d2"
            status["values"] = {pair["key"]: pair["value"] for pair in status["values"]}
        names = [status["name"] for status in statuses]
        assert len(set(names)) == len(names)
        return {
            name.removeprefix("appliance: "): status
            for name, status in zip(names, statuses, strict=True)
        }


@pytest.fixture
async def harness():
    harness = DiagnosticsHarness()
    yield harness
    await harness.bridge.stop()
    assert harness.node.subscriptions == harness.node.own_publishers == []


def level(status):
    value = status["level"]
    return value if isinstance(value, int) else value[0]


async def test_broker_bridge_and_routes(harness):
    harness.start(to_mqtt("/a"), to_ros("/b", type=STRING), to_mqtt("/never"))
    publisher = harness.node.add_publisher("/a", STRING)
    publisher.publish(string("x"))
    told = await harness.told()
    assert list(told) == ["broker", "bridge", "/a to MQTT", "/b to ROS", "/never to MQTT"]
    assert told["broker"]["values"]["subscriptions"] == "1"
    assert told["bridge"]["message"] == "topics bridged: 2"
    assert told["bridge"]["values"]["node"] == "/appliance"
    a = told["/a to MQTT"]
    assert (level(a), a["values"]["messages"], a["values"]["topics"]) == (OK, "1", "1")
    assert (level(told["/never to MQTT"]), told["/never to MQTT"]["message"]) == (
        OK,
        "waits for its topic",
    )


async def test_what_goes_wrong_is_a_warning_while_it_does(harness):
    harness.start(to_ros("/b", type=STRING))
    await harness.told()
    harness.client.send("r2d2/b", b"nonsense")
    told = (await harness.told())["/b to ROS"]
    assert level(told) == WARN
    assert told["message"] == "messages that could not be carried: 1"
    assert "not JSON" in told["values"]["last error"]
    told = (await harness.told())["/b to ROS"]
    assert (level(told), told["values"]["errors"]) == (OK, "1")


async def test_a_route_that_cannot_be_set_up_is_an_error(harness):
    harness.start(to_ros("/b", type="no_msgs/msg/Such"))
    told = (await harness.told())["/b to ROS"]
    assert level(told) == ERROR
    assert "no_msgs is not installed" in told["message"]


async def test_who_commands_and_what_was_refused(harness):
    harness.broker.tick(asyncio.get_running_loop().time())
    rules = CommandRules(exclusive=True, clamp=(("linear.x", -0.3, 0.3),))
    harness.start(to_ros("/cmd_vel", type=TWIST, rules=rules))
    name = "/cmd_vel to ROS"
    assert (await harness.told())[name]["values"]["commanded by"] == "nobody"
    one, two = Driver(harness.broker, "one"), Driver(harness.broker, "two")
    one.drive(GO)
    two.drive(GO)
    told = (await harness.told())[name]
    assert told["values"]["commanded by"] == "one"
    assert told["values"]["refused"] == "1"
    assert told["values"]["clamped"] == "1"
    assert (level(told), told["message"]) == (WARN, "commands refused: 1")
    one.cut()
    assert (await harness.told())[name]["values"]["commanded by"] == "nobody"


async def test_two_routes_of_one_topic_have_two_names(harness):
    harness.start(to_mqtt("/a"), to_mqtt("/a", mqtt="elsewhere"))
    assert {"/a to MQTT", "/a to MQTT (2)"} <= (await harness.told()).keys()


async def test_it_can_be_switched_off(harness):
    harness.start(to_mqtt("/a"), interval=0)
    harness.node.spin()
    await asyncio.sleep(0.05)
    assert harness.listener.received == []
    assert harness.node.own_publishers == []


async def test_without_the_message_type_there_is_one_warning(harness, caplog):
    harness.node.types.without.add(TYPE)
    with caplog.at_level(logging.WARNING):
        harness.start(to_mqtt("/a"))
        harness.node.spin()
        harness.node.spin()
        await asyncio.sleep(0.05)
    told = [r.getMessage() for r in caplog.records if "/diagnostics" in r.getMessage()]
    assert told == [
        "nothing is published on /diagnostics: no diagnostic_msgs/msg/DiagnosticArray: "
        "the package diagnostic_msgs is not installed here"
    ]


async def test_a_transport_that_refuses_and_a_bus_that_is_lost_harm_nothing(harness):
    harness.start(to_mqtt("/a"))
    await harness.told()
    (publisher,) = harness.node.own_publishers
    publisher.error = "full"
    await asyncio.sleep(0.05)
    publisher.error = None
    await harness.told()
    harness.node.fail("the daemon died")
    seen = len(harness.listener.received)
    await asyncio.sleep(0.05)
    assert len(harness.listener.received) == seen


def test_a_stop_before_the_start_is_nothing():
    loop = asyncio.new_event_loop()
    broker = Broker(AllAllowed(), MemoryStore())
    bridge = Bridge(FakeNode(), broker, [], loop, "r2d2", diagnostics=1.0)
    loop.run_until_complete(bridge.stop())
    loop.close()


# Figures


def test_latency():
    latency = Histogram()
    assert latency.quantile(0.5) is None
    for milliseconds in range(1, 101):
        latency.observe(milliseconds / 1000)
    assert latency.quantile(0.5) == pytest.approx(0.05, abs=0.002)
    assert latency.quantile(0.99) == pytest.approx(0.1, abs=0.003)
    assert latency.total == pytest.approx(5.05)
    other = Histogram()
    other.observe(-1)
    other.observe(100)
    assert other.quantile(1) == BOUNDS[-1]
    latency.add(other)
    assert sum(latency.counts) == 102
    assert latency.counts[0] == 1


def test_counters_add_up():
    one, two = (
        FlowCounters(messages=1, bytes=10, last_error="old"),
        FlowCounters(messages=2, stops=3),
    )
    two.latency.observe(0.001)
    one.add(two)
    assert (one.messages, one.bytes, one.stops, one.last_error) == (3, 10, 3, "old")
    assert sum(one.latency.counts) == 1


def test_rates_are_of_the_last_seconds():
    meter = Meter()
    assert meter.rates == (0, 0)
    for second in range(20):
        meter.tick(float(second), second * 10, second * 1000)
    assert meter.rates == (10, 1000)
    for second in range(20, 26):
        meter.tick(float(second), 190, 19000)
    assert meter.rates == (0, 0)
