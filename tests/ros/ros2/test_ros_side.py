"""The bridge as a citizen of ROS: its node, arguments, time, diagnostics; on real ROS 2."""

from __future__ import annotations

import asyncio
import json
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import yaml
from waiting import PATIENCE, until

from appliance import config
from appliance.host.environment import for_other_programs
from appliance.ops.doctor import ros as doctor
from appliance.ros.bridge import Bridge
from appliance.ros.ros2 import loop_subscription as ros2_loop
from appliance.ros.ros2 import node as ros2
from appliance.ros.ros2.node import Ros2Node

pytest.importorskip("rclpy")
from appliance_process import ROBOT, ApplianceProcess
from rclpy.executors import SingleThreadedExecutor
from rclpy.subscription import Subscription
from ros2_harness import STRING, Harness, Peer, route, string

from appliance.ros.calls.routes import CallRoutes, ServiceSettings
from appliance.ros.diagnostics import TYPE
from appliance.ros.payload.converter import Converters
from appliance.ros.payload.definitions import load_description
from appliance.ros.ros2.network_scope import NetworkScope, find_scope

pytestmark = pytest.mark.usefixtures("isolated_domain")

CLOCK, STAMP = "rosgraph_msgs/msg/Clock", "builtin_interfaces/msg/Time"


@pytest.fixture
async def peer():
    peer = await Peer().start()
    yield peer
    await peer.stop()


@pytest.fixture
async def start():
    houses = []

    def start(*routes, diagnostics=0.0, **node):
        harness = Harness()
        harness.node = Ros2Node(**node)
        loop = asyncio.get_running_loop()
        harness.bridge = Bridge(
            harness.node, harness.broker, routes, loop, "r2d2", diagnostics=diagnostics
        )
        harness.bridge.start()
        houses.append(harness)
        return harness

    yield start
    for harness in houses:
        await harness.bridge.stop()


async def test_messages_come_in_order_and_some_are_timed(start, peer):
    harness = start(route("/a", "mqtt", "text", keep=10_000))
    await peer.do("advertise", "/a", STRING)
    await until(harness.bridged, "/a")
    await peer.do("matched", "/a")
    total = 400
    for number in range(total // 40):
        burst = [f"{number * 40 + i:08d}" for i in range(40)]
        for text in burst:
            await peer.do("publish", "/a", (b"\0\1\0\0\x09\0\0\0" + text.encode() + b"\0").hex())
    await until(lambda: len(harness.payloads("r2d2/a")) == total, "all messages")
    assert [int(payload) for payload in harness.payloads("r2d2/a")] == list(range(total))
    latency = harness.bridge.status()[0].latency_ms
    assert 0 < latency.p50 <= latency.p99 < 1000
    (topic,) = harness.bridge.topics()
    assert topic.size == 8


@pytest.mark.parametrize("has_times", [True, False])
async def test_an_executor_without_events(start, peer, monkeypatch, has_times):
    """Humble, and Jazzy before 7.1.4; in Humble a callback gets nothing but the message."""

    def new_executor(context):
        return SingleThreadedExecutor(context=context), False

    def set_callback(self, callback):
        self._callback = callback
        self._callback_type = Subscription.CallbackType.MessageOnly

    monkeypatch.setattr(ros2, "_new_executor", new_executor)
    if not has_times:
        monkeypatch.setattr(ros2, "_has_message_info", lambda: False)
        humble = property(lambda self: self._callback, set_callback)
        monkeypatch.setattr(Subscription, "callback", humble)
    monkeypatch.setattr(Ros2Node, "_subscribe_on_loop", unavailable)
    harness = start(route("/a", "mqtt", "text", keep=100))
    await peer.do("advertise", "/a", STRING)
    await until(harness.bridged, "/a")
    await peer.do("matched", "/a")
    for number in range(20):
        await peer.do("publish", "/a", string(f"{number}").hex())
    await until(lambda: len(harness.payloads("r2d2/a")) == 20, "all messages")
    assert harness.bridge.problem is None
    assert (harness.bridge.status()[0].latency_ms is not None) is has_times


def unavailable(*_):
    raise ros2_loop.UnavailableError("this middleware is another one")


async def test_messages_latched_before_are_not_timed(start, peer):
    await peer.do("advertise", "/map", STRING, "reliable", "transient_local")
    await peer.do("publish", "/map", (b"\0\1\0\0\x04\0\0\0old\0").hex())
    await asyncio.sleep(0.2)
    harness = start(route("/map", "mqtt", "text"))
    await until(lambda: harness.payloads("r2d2/map"), "the map")
    assert harness.bridge.status()[0].latency_ms is None


async def test_arguments_name_the_node_and_remap_topics(start, peer):
    arguments = ["-r", "__node:=other", "-r", "__ns:=/base", "-r", "/a:=/elsewhere/a"]
    harness = start(
        route("/a", "mqtt", "text"),
        route("/b", "ros", "text", type=STRING),
        arguments=[*arguments, "-r", "/b:=/elsewhere/b"],
        namespace="/not_this",
    )
    await peer.do("advertise", "/elsewhere/a", STRING)
    await peer.do("subscribe", "/elsewhere/b", STRING)
    await until(lambda: len(harness.bridged()) == 2, "both")
    assert harness.node.name == "/base/other"
    await peer.do("matched", "/elsewhere/a")
    await peer.do("publish", "/elsewhere/a", (b"\0\1\0\0\x02\0\0\0x\0").hex())
    await until(lambda: harness.payloads("r2d2/a") == [b"x"], "the message from ROS")

    def arrives():
        harness.send("r2d2/b", b"y")
        return peer.received

    await until(arrives, "the message from MQTT")
    assert peer.received[0][0] == "/elsewhere/b"


async def test_wrong_arguments_are_reported_and_mqtt_goes_on(start):
    harness = start(route("/a", "mqtt", "text"), arguments=["-r", "not a remapping"])
    await until(lambda: harness.bridge.problem, "the problem")
    assert "not a remapping" in harness.bridge.problem


def test_latency_is_that_of_a_clock_that_was_set_meanwhile(monkeypatch):
    """What is measured is what has come since the subscription, whatever the clock says now."""
    wall, counted = 2_000 * 10**9, 500 * 10**9
    since = counted - 10 * 10**9
    monkeypatch.setattr(ros2_loop.time, "monotonic_ns", lambda: counted)
    for jump in (0, 3600, -3600, 10**9, -(10**9)):
        now = wall + jump * 10**9
        monkeypatch.setattr(ros2_loop.time, "time_ns", lambda now=now: now)
        for age, is_timed in ((10**6, True), (9 * 10**9, True), (11 * 10**9, False)):
            published_at = ros2_loop.published_at({"source_timestamp": now - age}, since)
            assert published_at == (now - age if is_timed else 0)


async def test_the_doctor_sees_the_nodes(start, peer, monkeypatch):
    soon = doctor.PATIENCE
    monkeypatch.setattr(doctor, "PATIENCE", PATIENCE)
    settings = config.loads("bridge: {topics: []}", Path("appliance.yaml"))
    deadline, nodes = time.monotonic() + PATIENCE, "/appliance"
    while "/appliance" in nodes and time.monotonic() < deadline:  # of the test before, for a moment
        found = await asyncio.to_thread(lambda: list(doctor.ros(settings, None)))
        by_subject = {finding.subject: finding for finding in found}
        nodes = by_subject["ROS nodes"].text
    assert by_subject["ROS nodes"].text.startswith("seen: 1 (/peer), with ")
    assert by_subject["ROS"].level == by_subject["ROS network"].level == "ok"
    harness = start()
    await until(lambda: harness.bridge.peers == 1, "the peer")
    running = {"ros": {"state": "joined", "node": "/appliance"}}
    found = await asyncio.to_thread(lambda: list(doctor._discover(settings, running)))
    assert [finding.text.partition(",")[0] for finding in found] == ["seen: 1 (/peer)"]
    monkeypatch.setattr(doctor, "PATIENCE", soon)
    running["ros"]["node"] = "/elsewhere"
    found = await asyncio.to_thread(lambda: list(doctor._discover(settings, running)))
    assert [finding.level for finding in found] == ["error"]
    assert "/elsewhere, is not seen" in found[0].text


async def test_a_bus_that_is_late_is_joined_when_it_is_there(start, peer, monkeypatch):
    monkeypatch.setattr("appliance.ros.bridge.RETRY", 0.05)
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_of_tomorrow")
    harness = start(route("/a", "mqtt", "text"))
    await until(lambda: harness.bridge.problem, "the problem")
    assert "rmw_of_tomorrow, which is not installed here" in harness.bridge.problem
    assert harness.bridge.state == "waiting"
    monkeypatch.delenv("RMW_IMPLEMENTATION")
    await until(lambda: harness.bridge.state == "joined", "the bus")
    await peer.do("advertise", "/a", STRING)
    await peer.do("matched", "/a")
    await peer.do("publish", "/a", (b"\0\1\0\0\x02\0\0\0x\0").hex())
    await until(lambda: harness.payloads("r2d2/a") == [b"x"], "the message from ROS")
    await until(lambda: harness.bridge.peers == 1, "the peer")


async def test_a_bus_that_goes_and_comes_back(start, peer, monkeypatch):
    """All is set up again: topics both ways, services, what is told on /diagnostics."""
    monkeypatch.setattr("appliance.ros.bridge.RETRY", 0.05)
    harness = start(
        route("/a", "mqtt", "text"), route("/b", "ros", "text", type=STRING), diagnostics=0.1
    )
    offered = ServiceSettings(
        names=("/ask",), mqtt="r2d2{ros}", to="mqtt", type="std_srvs/srv/Trigger"
    )
    harness.bridge.calls.replace(CallRoutes(services=(offered,)))
    await peer.do("advertise", "/a", STRING)
    await peer.do("subscribe", "/b", STRING)
    await peer.do("subscribe", "/diagnostics", TYPE)
    await until(lambda: len(harness.bridged()) == 2, "both")
    for word in ("before", "after"):
        await peer.do("matched", "/a")
        await peer.do("publish", "/a", string(word).hex())
        await until(lambda word=word: harness.payloads("r2d2/a")[-1:] == [word.encode()], word)

        def arrives(word=word):
            harness.send("r2d2/b", word.encode())
            return any(topic == "/b" and word.encode().hex() in cdr for topic, cdr in peer.received)

        await until(arrives, f"{word} on ROS")
        peer.received.clear()
        await until(lambda: any(topic == "/diagnostics" for topic, _ in peer.received), "health")
        answers = []

        def ask(answers=answers):
            harness.node.call_soon(lambda: answers.append(harness.node.services()))

        def offers(answers=answers, ask=ask):
            if answers and "/ask" not in answers[-1]:  # it is discovered some time after the node
                answers.clear()
                ask()
            return answers

        ask()
        await until(offers, "the service")
        if word == "before":
            harness.node._rclpy.shutdown(context=harness.node._context)
            await until(lambda: harness.bridge.state == "lost", "the loss")
            await until(lambda: harness.bridge.state == "joined", "the return")
            await until(lambda: len(harness.bridged()) == 2, "both again")


async def test_a_network_that_comes_after_the_start_is_used(start, peer, monkeypatch):
    monkeypatch.setattr("appliance.ros.bridge.RETRY", 0.05)
    monkeypatch.setattr(ros2, "NETWORK_INTERVAL", 0.1)
    monkeypatch.setattr(ros2, "find_scope", lambda: found)
    found = NetworkScope.THIS_COMPUTER
    harness = start(route("/a", "mqtt", "text"))
    await until(lambda: harness.bridge.peers == 1, "the peer")
    await asyncio.sleep(0.5)
    assert harness.bridge.state == "joined"
    first, found = harness.node._context, NetworkScope.NETWORK
    await until(lambda: harness.bridge.state == "lost", "the new start")
    assert harness.bridge.problem == "there was no network yet when it was joined, and is now"
    await until(lambda: harness.bridge.peers == 1, "the peer again")
    assert harness.node._context is not first


async def test_a_network_that_comes_while_the_bus_is_joined_is_used(start, peer, monkeypatch):
    monkeypatch.setattr("appliance.ros.bridge.RETRY", 0.05)
    monkeypatch.setattr(ros2, "NETWORK_INTERVAL", 0.1)
    houses = []

    def find_scope():
        is_joined = bool(houses) and houses[0].node._executor is not None
        return NetworkScope.NETWORK if is_joined else NetworkScope.THIS_COMPUTER

    monkeypatch.setattr(ros2, "find_scope", find_scope)
    houses.append(start(route("/a", "mqtt", "text")))
    await until(lambda: houses[0].bridge.problem is not None, "the new start")
    assert houses[0].bridge.problem == "there was no network yet when it was joined, and is now"


def test_the_scope_of_the_network(monkeypatch):
    up, down = SimpleNamespace(isup=True), SimpleNamespace(isup=False)
    states = {"lo": up, "eth0": down}
    ends = {
        name: [SimpleNamespace(family=socket.AF_INET, address=address)]
        for name, address in (("lo", "127.0.0.1"), ("eth0", "10.0.0.1"), ("gone", "10.0.0.2"))
    }
    monkeypatch.setattr(psutil, "net_if_stats", lambda: states)
    monkeypatch.setattr(psutil, "net_if_addrs", lambda: ends)
    assert find_scope({}) is NetworkScope.THIS_COMPUTER
    states["eth0"] = up
    assert find_scope({}) is NetworkScope.NETWORK
    assert find_scope({"ROS_AUTOMATIC_DISCOVERY_RANGE": "localhost"}) is NetworkScope.THIS_COMPUTER
    states["lo"] = states["eth0"] = down
    assert find_scope({}) is NetworkScope.NOBODY


@pytest.mark.parametrize(
    "node", [{"use_sim_time": True}, {"arguments": ["-p", "use_sim_time:=true"]}]
)
async def test_time_is_the_simulations(start, peer, node):
    harness = start(route("/t", "ros", type=STAMP), **node)
    await peer.do("advertise", "/clock", CLOCK)
    await peer.do("subscribe", "/t", STAMP)
    await until(harness.bridged, "/t")
    await peer.do("matched", "/clock")
    assert harness.node.now() == 0
    clock = b"\0\1\0\0" + (1234).to_bytes(4, "little") + (500).to_bytes(4, "little")

    async def has_arrived():
        await peer.do("publish", "/clock", clock.hex())
        harness.send("r2d2/t", b'"now"')
        return any(cdr == clock.hex() for _, cdr in peer.received)

    deadline = time.monotonic() + PATIENCE
    while not await has_arrived():
        assert time.monotonic() < deadline, peer.received[-1:]
        await asyncio.sleep(0.05)
    assert harness.node.now() == 1234 * 10**9 + 500


async def test_the_appliance_reports_its_status_on_ros_on_mqtt_and_by_control(tmp_path, peer):
    appliance = ApplianceProcess(tmp_path, acl=f"user alice\ntopic {ROBOT}/#\n")
    settings = yaml.safe_load(appliance.config.read_text())
    settings["bridge"] = {
        "ros_arguments": ["-r", "__ns:=/base"],
        "diagnostics": "100 ms",
        "topics": [{"ros": ["/some/**", "!/some/raw"], "to": "mqtt"}],
    }
    appliance.config.write_text(yaml.safe_dump(settings))
    await peer.do("advertise", "/some/text", STRING)
    await peer.do("advertise", "/some/raw", STRING)
    await peer.do("subscribe", "/diagnostics", TYPE)

    async def ask(*arguments):
        return await asyncio.to_thread(
            subprocess.run,
            [sys.executable, "-m", "appliance", "routes", "-c", str(appliance.config), *arguments],
            capture_output=True,
            text=True,
            env=for_other_programs(),
        )

    refused = await ask()
    assert refused.returncode == 1
    assert "no appliance is running" in refused.stderr
    appliance.start()
    try:
        await peer.do("matched", "/some/text")
        await peer.do("publish", "/some/text", (b"\0\1\0\0\x02\0\0\0x\0").hex(), 20, 100)
        converter = Converters(load_description).get(TYPE)

        def told():
            if not peer.received:
                return {}
            array = converter.to_dict(bytes.fromhex(peer.received[-1][1]))
            return {status["name"]: status for status in array["status"]}

        name = "base/appliance: /some/**, !/some/raw to MQTT"
        await until(
            lambda: name in told() and "bridged: 1" in told()[name]["message"], "diagnostics"
        )
        (topic,) = [json.loads(line) for line in (await ask("--json")).stdout.splitlines()]
        assert (topic["ros"], topic["mqtt"], topic["type"]) == (
            "/some/text",
            f"{ROBOT}/some/text",
            STRING,
        )
        assert topic["messages"] > 0
        assert topic["latency_ms"]["p50"] > 0
        heading, row, *skipped = (await ask()).stdout.splitlines()
        assert heading.split()[:3] == ["ROS", "MQTT", "TYPE"]
        assert row.split()[:4] == ["/some/text", "→", f"{ROBOT}/some/text", STRING]
        assert skipped[:2] == ["", "skipped: 1 left out"]
        assert skipped[2].split() == ["/some/raw", "→", STRING, "left", "out", "by", "!/some/raw"]
    finally:
        appliance.stop()
