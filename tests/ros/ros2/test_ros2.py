"""The bridge on real ROS 2; the other nodes are in other processes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from ros2_harness import BYTES, SET_BOOL, STRING, TF, TWIST, Peer, route, string
from waiting import PATIENCE, until

from appliance.broker.faults import Faults
from appliance.host.environment import for_other_programs
from appliance.mqtt.codec import Property
from appliance.net.callbacks import Entries
from appliance.ros.bridge import TopicSettings
from appliance.ros.node import BusError, QosProfile, Reliability
from appliance.ros.payload.converter import compile_converter
from appliance.ros.ros2 import fastdds, installation
from appliance.ros.ros2 import node as ros2

pytestmark = pytest.mark.usefixtures("isolated_domain")

pytest.importorskip("rclpy")


async def test_no_request_ends_the_thread():
    node = ros2.Ros2Node()
    told, failures = [], []

    def look():
        if told:
            return
        client = node.create_client("/parameters", "rcl_interfaces/srv/GetParameters")
        for request in (
            # More padding, says its fourth byte, than the message has at its end: Fast DDS 2 of
            # Jazzy does not look at that, and Fast DDS 3 of Kilted refuses it.
            b"\0\1\0\3\0\0\0\0",
            b"\0\1\0\0\xff\xff\xff\xff",  # more names than there are bytes
        ):
            try:
                client.call(request, told.append)
            except BusError as error:
                told.append(str(error))

    node.start(look, failures.append)
    try:
        await until(lambda: told or failures, "the call")
        node.call_soon(lambda: 1 / 0)
        node.call_soon(lambda: told.append("still there"))
        await until(lambda: told[-1] == "still there" or failures, "what comes behind a fault")
        assert failures == []
    finally:
        await asyncio.to_thread(node.stop)


@contextlib.asynccontextmanager
async def looking(look):
    """A node that does so on its thread, again and again; it is not to end before its time."""
    node, failures = ros2.Ros2Node(), []
    node.start(lambda: look(node), failures.append)
    try:
        yield
        assert failures == []
    finally:
        await asyncio.to_thread(node.stop)


async def test_many_answers_at_once_all_arrive(peer):
    await peer.do("gather", "/gather", 200)
    clients, answers = [], []

    def look(node):
        if not clients:
            clients.append(node.create_client("/gather", SET_BOOL))
        elif len(clients) == 1 and clients[0].is_ready():
            clients.append(None)
            for number in range(200):
                clients[0].call(b"\0\1\0\0" + bytes([number % 2]), answers.append)

    async with looking(look):
        await until(lambda: len(answers) == 200, "all answers")
    assert sum(answer[4] for answer in answers) == 100


async def test_many_requests_at_once_all_arrive(peer):
    services, requests = [], []

    def respond(request, answer):
        if not requests:
            time.sleep(0.3)  # they come while nobody takes them
        requests.append(request)
        answer(b"\0\1\0\0\1\0\0\0\3\0\0\0ok\0")

    def look(node):
        if not services:
            services.append(node.create_service("/offered", SET_BOOL, respond))

    async with looking(look):
        await peer.do("ask", "/offered", 200)
        await until(lambda: len(peer.received) == 200, "all answers")
    assert len(requests) == 200


def test_two_nodes_with_services_of_one_name_and_different_types():
    node = ros2.Ros2Node()
    types = {"a": "std_srvs/srv/Trigger", "b": "std_srvs/srv/SetBool", "c": "std_srvs/srv/SetBool"}

    class Graph:
        def get_node_names_and_namespaces(self):
            return [(name, "/") for name in types]

        def get_service_names_and_types_by_node(self, name, namespace):
            return [("/x", [types[name]])]

    node._node = Graph()
    assert node.services() == {"/x": ["std_srvs/srv/SetBool", "std_srvs/srv/Trigger"]}


async def test_names_that_only_dds_accepts_are_skipped():
    """Of another vendor's tools, or by a stranger: asking ROS about one ended the bridge."""
    node = ros2.Ros2Node()
    looked, failures = [], []
    odd = ["/a//b", "/a/", "/1a", "/a+b", "/" + "x" * 300]

    def look():
        own, node._node = node._node, Odd(node._node)
        looked.append((node.topics(), node.services()))
        node._node = own

    class Odd:
        def __init__(self, own):
            self.own = own

        def get_topic_names_and_types(self):
            return [(name, ["std_msgs/msg/String"]) for name in ("/fine", *odd)]

        def get_node_names_and_namespaces(self):
            return [("no name", "/"), *self.own.get_node_names_and_namespaces()]

        def get_service_names_and_types_by_node(self, *of):
            self.own.get_service_names_and_types_by_node(*of)
            return [(name, ["std_srvs/srv/Trigger"]) for name in ("/fine", *odd)]

    node.start(look, failures.append)
    await until(lambda: looked or failures, "a look")
    await asyncio.to_thread(node.stop)
    assert failures == []
    topics, services = looked[0]
    assert set(topics) == set(services) == {"/fine"}


async def test_ros_to_mqtt(harness, peer):
    harness.start(route("/chatter", "mqtt"), route("/fast", "mqtt", "cdr"))
    await peer.do("advertise", "/chatter", STRING)
    await peer.do("advertise", "/fast", STRING, "best_effort")
    await peer.do("matched", "/chatter")
    await peer.do("matched", "/fast")
    await peer.do("publish", "/chatter", string("hello").hex())
    await peer.do("publish", "/fast", string("raw").hex())
    await until(lambda: harness.payloads("r2d2/fast"), "the message of /fast")
    await until(lambda: harness.payloads("r2d2/chatter"), "the message of /chatter")
    found = {m.topic: (m, qos) for m, qos in harness.received}
    message, qos = found["r2d2/chatter"]
    assert (message.payload, qos) == (b'{"data":"hello"}', 1)
    assert message.properties[Property.CONTENT_TYPE] == "application/json"
    (type_name, type_hash) = message.properties[Property.USER_PROPERTY]
    assert type_name == ("ros-type", STRING)
    assert type_hash[1].startswith("RIHS01_")
    message, qos = found["r2d2/fast"]
    assert (message.payload, qos) == (string("raw"), 0)


async def test_mqtt_to_ros(harness, peer):
    harness.start(route("/cmd_vel", "ros"))
    await peer.do("subscribe", "/cmd_vel", TWIST)
    await until(harness.bridged, "the type of /cmd_vel")

    def arrives():
        harness.send("r2d2/cmd_vel", b'{"linear":{"x":0.5}}')
        return peer.received

    await until(arrives, "a command")
    expected = b"\0\1\0\0" + struct.pack("<6d", 0.5, 0, 0, 0, 0, 0)
    assert peer.received[0] == ("/cmd_vel", expected.hex())
    before = len(peer.received)
    harness.send("r2d2/cmd_vel", b'{"linear":{"x":"fast"}}')
    harness.send("r2d2/cmd_vel", b'{"angular":{"z":1}}')
    await until(lambda: peer.received[-1][1] != expected.hex(), "the command after the wrong one")
    assert harness.bridge.status()[0].errors == 1
    assert len(peer.received) <= harness.bridge.status()[0].messages
    assert len(peer.received) > before


async def test_a_late_subscriber_receives_only_the_last_command(harness, peer):
    harness.start(route("/mode", "ros", "text"))
    await peer.do("subscribe", "/mode", STRING, "reliable", "transient_local")
    await until(harness.bridged, "/mode")
    # Of what comes before DDS has matched the two, or while one is on its way, the last counts.
    for text in ("one", "two", "three"):
        harness.send("r2d2/mode", text.encode())
        cdr = string(text).hex()
        await until(lambda cdr=cdr: peer.received and peer.received[-1][1].startswith(cdr), text)
    late = await Peer().start("late")
    try:
        await late.do("subscribe", "/mode", STRING, "reliable", "transient_local")
        await until(lambda: late.received, "the last command")
        harness.send("r2d2/mode", b"four")
        await until(lambda: len(late.received) == 2, "another one")
        for (_, cdr), text in zip(late.received, ("three", "four"), strict=True):
            assert cdr.startswith(string(text).hex())
    finally:
        await late.stop()


async def test_both_ways_without_an_echo(harness, peer):
    harness.start(route("/chat", "both", "text", keep=100))
    await peer.do("advertise", "/chat", STRING)
    await peer.do("subscribe", "/chat", STRING)
    await peer.do("matched", "/chat", 2)  # its own subscription, and the bridge's
    await until(lambda: len(harness.bridged()) == 2, "both directions")

    def arrives():
        harness.send("r2d2/chat", b"probe")
        return peer.received

    await until(arrives, "a message from MQTT")
    sent = harness.bridge.status()[0].messages
    for number in range(20):
        harness.send("r2d2/chat", b"%d" % number)
    await peer.do("publish", "/chat", string("from ros").hex())
    await until(lambda: b"from ros" in harness.payloads("r2d2/chat"), "the message from ROS")
    last = string("19").hex()  # DDS may add padding to it
    await until(lambda: any(cdr.startswith(last) for _, cdr in peer.received), "the last from MQTT")
    # The client has its own messages from the broker, each once; and nothing else from the bridge.
    assert len(harness.payloads("r2d2/chat")) == sent + 20 + 1
    assert harness.bridge.status()[1].messages == 1


async def test_latched_samples_are_retained(harness, peer):
    await peer.do("advertise", "/map", STRING, "reliable", "transient_local")
    await peer.do("publish", "/map", string("old").hex())
    await peer.do("publish", "/map", string("new").hex())
    harness.start(route("/map", "mqtt", "text"))
    retained = harness.broker.retained
    await until(lambda: (m := retained.get("r2d2/map")) and m.payload == b"new", "the new map")
    # Beside it, what the bridge says of itself has come, which is of QoS 0.
    qos = [qos for message, qos in harness.received if message.topic == "r2d2/map"]
    assert qos[-1] == 1


@pytest.mark.parametrize("rate", [None, 1])
async def test_static_transforms_of_all_nodes_are_retained(harness, monkeypatch, tmp_path, rate):
    folder = tmp_path / "share/tf2_msgs/msg"
    folder.mkdir(parents=True)
    (folder / "TFMessage.msg").write_text("geometry_msgs/TransformStamped[] transforms\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path}:{sys.prefix}")
    converter = compile_converter(ros2.describe(ros2.load_message(TF), ros2.load_message))

    def transform(child, x):
        return {"child_frame_id": child, "transform": {"translation": {"x": x}}}

    async def publish(peer, *transforms):
        cdr = converter.from_dict({"transforms": transforms})
        await peer.do("publish", "/tf_static", cdr.hex())

    def retained():
        message = harness.broker.retained.get("r2d2/tf_static")
        return message and {
            each["child_frame_id"]: each["transform"]["translation"]["x"]
            for each in json.loads(message.payload)["transforms"]
        }

    peers = [await Peer().start(name) for name in ("base", "arm", "lidar")]
    try:
        for peer in peers:
            await peer.do("advertise", "/tf_static", TF, "reliable", "transient_local")
        await publish(peers[0], transform("base", 1.0), transform("wheel", 2.0))
        await publish(peers[1], transform("hand", 5.0))
        await publish(peers[2], transform("lidar", 3.0))
        harness.start(route("/tf_static", "mqtt", rate=rate))
        everything = {"base": 1.0, "wheel": 2.0, "hand": 5.0, "lidar": 3.0}
        await until(lambda: retained() == everything, "the transforms of all")
        await publish(peers[0], transform("wheel", 4.0))
        await until(lambda: retained() == everything | {"wheel": 4.0}, "the one that has changed")
    finally:
        for peer in peers:
            await peer.stop()


async def test_publishers_that_change_are_followed(harness, peer):
    harness.start(route("/a", "mqtt", "text"))
    for reliability, qos in (("reliable", 1), ("best_effort", 0), ("reliable", 1)):
        await peer.do("advertise", "/a", STRING, reliability)
        await peer.do("matched", "/a")

        seen = len(harness.received)
        deadline = time.monotonic() + PATIENCE
        came = []
        while not came or came[-1][1] != qos:
            assert time.monotonic() < deadline, f"not followed: {reliability}"
            await peer.do("publish", "/a", string(reliability).hex())
            await asyncio.sleep(0.05)
            came = [each for each in harness.received[seen:] if each[0].topic == "r2d2/a"]
        assert came[-1][0].payload.decode() == reliability
        await peer.do("vanish", "/a")


async def test_pattern(harness, peer):
    harness.start(TopicSettings("/camera/**", "mqtt", "r2d2{ros}", encoding="cdr"))
    await peer.do("advertise", "/camera/left/image", BYTES, "best_effort")
    await until(harness.bridged, "the camera")
    assert harness.bridged()[0].mqtt == "r2d2/camera/left/image"
    await peer.do("vanish", "/camera/left/image")
    await until(lambda: not harness.bridged(), "the camera's end")


def test_images_pass_through_the_larger_shared_memory():
    program = Path(__file__).parent / "large_images.py"
    paths = {"PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run(
        [sys.executable, program], check=True, timeout=2 * PATIENCE, env={**os.environ, **paths}
    )


@pytest.mark.parametrize(
    ("before", "after", "lost"),
    [
        (0, 0, 0),
        (3, 13, 10),
        (0, 0x7FFF_FFFF, 0),
        (0, 0xFFFF_FFFF_8000_0010, 17),  # as seen, of 17 that were lost
        (0xFFFF_FFFF_8000_0010, 0xFFFF_FFFF_8000_0013, 3),
        (0xFFFF_FFFF_8000_0013, 0xFFFF_FFFF_8000_0013, 0),
        (0xFFFF_FFFF_FFFF_FFFF, 2, 3),
    ],
)
def test_what_fast_dds_counts_too_many_is_left_out(before, after, lost):
    assert ros2.lost_between(before, after) == lost


@pytest.mark.parametrize("takes_on_loop", [True, False])
async def test_messages_that_the_middleware_loses_are_counted(peer, takes_on_loop):
    """Images that are larger than the shared memory of a publisher without our profile."""
    node, failures, taken, dropped, lost = ros2.Ros2Node(), [], [], [], []
    subscription = None

    def on_batch(batch, had_to_go, is_late):
        taken.extend(cdr for cdr, _ in batch)
        dropped.append(had_to_go)

    def look():
        nonlocal subscription
        if subscription is None:
            qos = QosProfile(Reliability.BEST_EFFORT, depth=1000)
            on_loop = on_batch if takes_on_loop else None
            subscription = node.subscribe_raw("/image", BYTES, qos, on_message, on_loop=on_loop)
        lost.append(subscription.take_lost())

    def on_message(cdr, published_at=0):
        taken.append(cdr)

    def counted():
        return sum(lost) + sum(dropped) + len(taken)

    await peer.do("advertise", "/image", BYTES, "best_effort")
    node.start(look, failures.append, Entries(asyncio.get_running_loop(), Faults()))
    try:
        await peer.do("matched", "/image")
        published = 0
        while not taken:  # both ends have found each other
            await peer.do("publish_image", "/image", 10, 1, 10)
            published += 1
            assert published < 100, "nothing comes"
        before = published - len(taken)  # went nowhere, before the ends had found each other
        deadline = time.monotonic() + 4 * PATIENCE
        while not sum(lost) or counted() < published - before:
            assert time.monotonic() < deadline, f"{published=}, {before=}, {counted()=}, {lost=}"
            if not sum(lost):
                await peer.do("publish_image", "/image", 4_000_000, 10, 1000)
                published += 10
            # A loss is told of once something follows, which may be lost as well.
            await peer.do("publish_image", "/image", 10, 1, 10)
            published += 1
        assert counted() == published - before
    finally:
        await asyncio.to_thread(node.stop)
        assert failures == []


@pytest.mark.parametrize("reliability", ["reliable", "best_effort"])
async def test_early_and_dropped_messages_do_not_count_as_lost_by_the_middleware(peer, reliability):
    await peer.do("advertise", "/a", STRING, reliability)
    await peer.do("publish", "/a", string("early").hex(), 50, 10_000)
    node, failures, taken = ros2.Ros2Node(), [], []
    subscription = None

    def look():
        nonlocal subscription
        if subscription is None and node.count("/a")[0]:
            qos = QosProfile(Reliability[reliability.upper()], depth=2)
            subscription = node.subscribe_raw("/a", STRING, qos, taken.append)

    node.start(look, failures.append)
    try:
        await until(lambda: subscription is not None, "the subscription")
        await peer.do("matched", "/a")
        await until_published(peer, taken, string("probe"))
        taken.clear()
        told, published = [], threading.Event()

        def hold_up():
            published.wait(PATIENCE)
            told.append("held")

        node.call_soon(hold_up)
        await peer.do("publish", "/a", string("late").hex(), 50, 1000)
        published.set()
        await until(lambda: told, "the ROS thread is free again")
        await until_published(peer, taken, string("last"))
        node.call_soon(lambda: told.append(subscription.take_lost()))
        await until(lambda: len(told) == 2, "the count")
        assert told[1] == 0
        assert len(taken) < 50
    finally:
        await asyncio.to_thread(node.stop)
        assert failures == []


async def until_published(peer, taken, cdr):
    deadline = time.monotonic() + PATIENCE
    while not any(each.startswith(cdr) for each in taken):
        assert time.monotonic() < deadline, f"nothing came within {PATIENCE} s"
        await peer.do("publish", "/a", cdr.hex())
        await asyncio.sleep(0.05)


async def test_refusals_of_ros_are_bus_errors():
    node = ros2.Ros2Node()
    problems, failures = [], []

    def look():
        if problems:
            return
        publisher = node.create_publisher("/fine", STRING, QosProfile())
        publisher.publish(string("x"))
        publisher.destroy()
        for refused in (
            lambda: publisher.publish(string("x")),
            lambda: node.create_publisher("/not a name", STRING, QosProfile()),
            lambda: node.subscribe_raw("/not//a", STRING, QosProfile(), problems.append),
        ):
            try:
                refused()
            except BusError as error:
                problems.append(str(error))

    node.start(look, failures.append)
    await until(lambda: problems or failures, "the look")
    await asyncio.to_thread(node.stop)
    assert failures == []
    assert len(problems) == 3


@pytest.mark.timed
async def test_start_and_stop_at_any_moment():
    for wait in (0.0, 0.05, 0.3):
        node = ros2.Ros2Node()
        looks, failures = [], []
        started = time.monotonic()
        node.start(lambda looks=looks: looks.append(1), failures.append)
        assert time.monotonic() - started < 1
        await asyncio.sleep(wait)
        await asyncio.to_thread(node.stop)
        node.stop()
        assert failures == []
        assert time.monotonic() - started < wait + 5


async def test_an_exception_in_a_poll_ends_the_node_and_is_reported():
    node = ros2.Ros2Node()
    failures = []
    node.start(lambda: 1 // 0, failures.append)
    await until(lambda: failures, "the failure")
    node.stop()
    assert failures == ["ZeroDivisionError: integer division or modulo by zero"]


async def test_a_wrong_node_name_is_reported():
    failures = []
    node = ros2.Ros2Node("not a name")
    node.start(lambda: None, failures.append)
    await until(lambda: failures, "the failure")
    node.stop()
    assert "Invalid node name" in failures[0]


# What is here, and what is not


def test_ros_is_available():
    assert ros2.available() == (True, "")


def test_without_rclpy_one_line_says_so(monkeypatch):
    monkeypatch.setattr(installation, "find_spec", lambda name: None)
    is_available, reason = ros2.available()
    assert not is_available
    assert "rclpy cannot be imported" in reason
    assert "\n" not in reason
    failures = []
    node = ros2.Ros2Node()
    node.start(lambda: None, failures.append)
    node.stop()
    assert failures == [reason]


@pytest.mark.parametrize("domain", ["500", "233", "-1", "one"])
def test_a_wrong_domain_is_reported(monkeypatch, domain):
    """Fast DDS would end the process, and the broker with it."""
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    failures = []
    node = ros2.Ros2Node()
    node.start(lambda: None, failures.append)
    node.stop()
    assert failures == [f"ROS_DOMAIN_ID is {domain}: a domain is a number from 0 to 232"]


def test_a_missing_middleware_is_reported(monkeypatch):
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_nowhere_cpp")
    is_available, reason = ros2.available()
    assert not is_available
    assert "RMW_IMPLEMENTATION is rmw_nowhere_cpp, which is not installed here" in reason
    assert "rmw_fastrtps_cpp" in reason
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    assert ros2.available() == (True, "")


@pytest.mark.parametrize(
    "environment",
    [
        {"FASTDDS_DEFAULT_PROFILES_FILE": "/mine.xml"},
        {"FASTRTPS_DEFAULT_PROFILES_FILE": "/mine.xml"},
        {"FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA"},
        {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"},
    ],
)
def test_the_users_settings_of_fast_dds_take_precedence(environment):
    before = dict(environment)
    assert not fastdds.use_profile(environment)
    assert environment == before


def test_fast_dds_2_has_a_variable_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setattr(fastdds, "_prefixes", lambda: [tmp_path])
    (tmp_path / "share/fastrtps").mkdir(parents=True)
    environment = {"ROS_LOCALHOST_ONLY": "1"}
    assert fastdds.use_profile(environment)
    text = Path(environment["FASTRTPS_DEFAULT_PROFILES_FILE"]).read_text()
    assert "<nackSupressionDuration>" in text
    assert "ransport" not in text  # or it would override the variable
    environment = {"ROS_LOCALHOST_ONLY": "0"}
    assert fastdds.use_profile(environment)
    text = Path(environment["FASTRTPS_DEFAULT_PROFILES_FILE"]).read_text()
    assert "<segment_size>4194304</segment_size>" in text


def test_a_profile_in_the_working_directory_takes_precedence(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    environment = {}
    assert fastdds.use_profile(environment)
    assert [Path(value).is_file() for value in environment.values()] == [True]
    assert fastdds.use_profile(again := {}) and again == environment  # no second file
    Path("DEFAULT_FASTDDS_PROFILES.xml").touch()
    assert not fastdds.use_profile({})


def test_an_old_fast_dds_gets_udp_by_a_profile(tmp_path, monkeypatch):
    environment = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
    monkeypatch.setattr(fastdds, "_prefixes", lambda: [tmp_path])
    assert fastdds.use_profile(environment)
    profile = Path(environment.pop("FASTDDS_DEFAULT_PROFILES_FILE")).read_text()
    assert "<nack_supression_duration>" in profile
    assert "ransport" not in profile  # a new one knows the variable
    (tmp_path / "share/fastrtps").mkdir(parents=True)
    assert fastdds.use_profile(environment)
    profile = Path(environment["FASTRTPS_DEFAULT_PROFILES_FILE"]).read_text()
    assert "UDPv4" in profile and "SHM" not in profile


# The demo robot


async def test_demo_robot_drives_and_stops(harness):
    harness.start(
        route("/odom", "mqtt"),
        route("/battery", "mqtt"),
        route("/scan", "mqtt"),
        route("/chatter", "mqtt", "text"),
        route("/robot_description", "mqtt", "text"),
        route("/cmd_vel", "ros"),
    )
    robot = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "appliance.cli.demo_robot", env=for_other_programs()
    )
    try:
        for name in ("odom", "battery", "scan", "chatter", "robot_description"):
            await until(lambda name=name: harness.payloads(f"r2d2/{name}"), name)
        assert harness.broker.retained.get("r2d2/robot_description").payload.startswith(b"<robot")
        assert json.loads(harness.payloads("r2d2/battery")[-1])["temperature"] is None
        await until(lambda: len(harness.bridged()) == 6, "/cmd_vel")

        def x():
            return json.loads(harness.payloads("r2d2/odom")[-1])["pose"]["pose"]["position"]["x"]

        def drives():
            harness.send("r2d2/cmd_vel", b'{"linear":{"x":1}}')
            return x() > 0.1

        await until(drives, "the robot drives")

        def speed():
            return json.loads(harness.payloads("r2d2/odom")[-1])["twist"]["twist"]["linear"]["x"]

        await until(lambda: speed() == 0, "the robot stops by itself")
    finally:
        robot.terminate()
        assert await asyncio.wait_for(robot.wait(), PATIENCE) == 0
