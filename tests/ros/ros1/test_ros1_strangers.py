"""Nodes of ROS 1 that do what nobody expects, on a robot with simulated time."""

from __future__ import annotations

import itertools
import json
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from xmlrpc.client import ServerProxy
from xmlrpc.server import SimpleXMLRPCServer

import psutil
import pytest
from ros1_world import SYSTEM_PYTHON, Mqtt, Python, Ros1Appliance, World, end, is_installed
from waiting import PATIENCE, eventually

from appliance.ros.ros1.types import MAX_MESSAGE_SIZE

pytestmark = pytest.mark.skipif(
    not is_installed(), reason="needs ROS 1: apt install python3-roslaunch python3-rospy …"
)

BRIDGE = {
    "topics": [{"ros": ["/clock", "/odd/*"], "to": "mqtt", "keep": 100}],
    "services": [{"ros": "/ask", "to": "mqtt", "type": "std_srvs/srv/SetBool"}],
    "parameters": ["/*"],
}
STRING = {"md5sum": "992ce8a1687cec8c8bd883ec73ca41d1", "message_definition": "string data\n"}

#: A clock that ticks, and a topic that is made anew with another type at a tick.
ROBOT = """
import itertools, rospy, time
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Int32, String
rospy.init_node("robot")
clock = rospy.Publisher("/clock", Clock, queue_size=1)
words = rospy.Publisher("/odd/word", String, queue_size=1)
for tick in itertools.count(1):
    clock.publish(Clock(rospy.Time(tick)))
    if words is not None and rospy.get_param("/numbers", 0):
        words.unregister()
        words, numbers = None, rospy.Publisher("/odd/word", Int32, queue_size=1)
    words.publish("one") if words is not None else numbers.publish(1)
    time.sleep(0.1)
"""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    world = World(tmp_path_factory.mktemp("strangers"))
    world.environment["ROS_NAMESPACE"] = "/odd_robot"
    try:
        world.start()
        world.ask("setParam", "/use_sim_time", True)
        yield world
    finally:
        world.kill()


@pytest.fixture(scope="module")
def appliance(
    python: Python, world: World, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Ros1Appliance]:
    process = Ros1Appliance(tmp_path_factory.mktemp("appliance"), python, world, BRIDGE)
    with process.running():
        process.wait_for_log("on ROS as /odd_robot/appliance")
        yield process


def begin(topic: str) -> bytes:
    """The header with which a publisher begins."""
    fields = {"callerid": "/strange", "type": type_of(topic), **STRING}
    lines = [f"{key}={value}".encode() for key, value in fields.items()]
    joined = b"".join(struct.pack("<I", len(line)) + line for line in lines)
    return struct.pack("<I", len(joined)) + joined


def string(text: bytes) -> bytes:
    return struct.pack("<II", 4 + len(text), len(text)) + text


class Stranger:
    """A publisher that calls `behave` with each that connects to it."""

    def __init__(self, world: World, topic: str, behave: Callable[[socket.socket], None]) -> None:
        self._behave = behave
        self._peers: list[socket.socket] = []
        self._tcp = socket.create_server(("127.0.0.1", 0))
        self._node = SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False)
        protocol = ["TCPROS", "127.0.0.1", self._tcp.getsockname()[1]]
        self._node.register_function(lambda *_: [1, "", protocol], "requestTopic")
        for target in (self._node.serve_forever, self._accept):
            threading.Thread(target=target, daemon=True).start()
        register(world, topic, f"http://127.0.0.1:{self._node.server_address[1]}/")

    def __enter__(self) -> Stranger:
        return self

    def __exit__(self, *_: object) -> None:
        self._node.shutdown()
        self._node.server_close()
        self._tcp.shutdown(socket.SHUT_RDWR)
        for closed in (self._tcp, *self._peers):
            closed.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                peer, _ = self._tcp.accept()
                self._peers.append(peer)
                threading.Thread(target=self._meet, args=(peer,), daemon=True).start()

    def _meet(self, peer: socket.socket) -> None:
        with suppress(OSError):
            self._behave(peer)


def type_of(topic: str) -> str:
    """A type that is installed nowhere, and that nobody else has told of."""
    return f"own_msgs/{topic.rpartition('/')[2].title()}"


def register(world: World, topic: str, uri: str) -> None:
    master = ServerProxy(world.environment["ROS_MASTER_URI"])
    name = f"/strange{topic.replace('/', '_')}"
    answer = master.registerPublisher(name, topic, type_of(topic), uri)
    assert answer[0] == 1, answer  # type: ignore[index]


def test_the_clock_and_a_topic_of_another_type(world: World, appliance: Ros1Appliance) -> None:
    robot = world.begin(SYSTEM_PYTHON, "-c", ROBOT)
    try:
        with Mqtt(appliance, "r2d2/clock", "r2d2/odd/word") as client:
            clock = json.loads(client.next("r2d2/clock").payload)
            assert 0 < clock["clock"]["sec"] < 10_000 and clock["clock"]["nanosec"] == 0
            client.next("r2d2/odd/word", {"data": "one"})
            world.ask("setParam", "/numbers", 1)
            client.next("r2d2/odd/word", {"data": 1})
    finally:
        end(robot)


def test_a_second_node_of_the_same_name_does_not_end_the_first(
    world: World, appliance: Ros1Appliance, python: Python, tmp_path_factory: pytest.TempPathFactory
) -> None:
    second = Ros1Appliance(tmp_path_factory.mktemp("second"), python, world, BRIDGE)
    with second.running():
        second.wait_for_log("another node, at .*, is called /odd_robot/appliance: end it, or")
    assert "no bridge to ROS" not in appliance.log


def test_messages_over_the_size_limit_are_dropped(world: World, appliance: Ros1Appliance) -> None:
    process = psutil.Process(appliance.pid)
    before = process.memory_info().rss

    def behave(peer: socket.socket) -> None:
        peer.sendall(begin("/odd/large") + string(b"one"))
        peer.sendall(struct.pack("<I", MAX_MESSAGE_SIZE + 7))
        for _ in range(MAX_MESSAGE_SIZE >> 20):
            peer.sendall(bytes(1 << 20))
        peer.sendall(bytes(7) + string(b"two")[:3])
        time.sleep(0.1)  # so that it comes in two pieces, most often
        peer.sendall(string(b"two")[3:])

    with Mqtt(appliance, "r2d2/odd/large") as client, Stranger(world, "/odd/large", behave):
        client.next("r2d2/odd/large", {"data": "two"})
        assert [m.payload for m in client.received] == [b'{"data":"one"}']
    appliance.wait_for_log(f"a message of {MAX_MESSAGE_SIZE + 7} bytes")
    assert process.memory_info().rss < before + MAX_MESSAGE_SIZE // 2


def test_peers_that_announce_a_header_of_4_gb(world: World, appliance: Ros1Appliance) -> None:
    appliance.wait_for_log("/ask is offered")
    port = int(world.ask("lookupService", "/ask").rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port), PATIENCE) as caller:
        caller.sendall(b"\xff" * 4)
        with suppress(ConnectionError):
            assert caller.recv(1) == b""  # and before anybody has waited for more
    appliance.wait_for_log("a header of 4294967295 bytes")


class _NoNode(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/xml")
        self.send_header("Content-Length", "5")
        self.end_headers()
        self.wfile.write(b"hello")

    def log_message(self, *_: object) -> None:
        """Say nothing."""


def test_a_node_whose_port_is_another_program_s(world: World, appliance: Ros1Appliance) -> None:
    with ThreadingHTTPServer(("127.0.0.1", 0), _NoNode) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        register(world, "/odd/reused", f"http://127.0.0.1:{server.server_address[1]}/")
        appliance.wait_for_log(
            "own_msgs/msg/Reused is not installed here, and its publisher does .*syntax"
        )
        server.shutdown()
    assert "no bridge to ROS" not in appliance.log


def test_a_parameter_that_xml_rpc_cannot_express(world: World, appliance: Ros1Appliance) -> None:
    connection = HTTPConnection("127.0.0.1", world.port, timeout=PATIENCE)
    values = ("string>/test", "string>/large", f"i8>{2**40}")
    params = "".join(f"<param><value><{v}</{v.partition('>')[0]}></value></param>" for v in values)
    call = f"<methodCall><methodName>setParam</methodName><params>{params}</params></methodCall>"
    connection.request("POST", "/RPC2", call, {"Content-Type": "text/xml"})
    assert b"parameter /large set" in connection.getresponse().read()
    connection.close()
    world.ask("setParam", "/after", 1)
    with Mqtt(appliance, "r2d2/_param/#") as client:
        client.next("r2d2/_param/after", 1)
        assert "r2d2/_param/large" not in {m.topic for m in client.received}


def test_slow_publishers_block_neither_others_nor_the_process(
    world: World, appliance: Ros1Appliance
) -> None:
    asked = [threading.Event() for _ in range(5)]

    def dawdle(number: int, peer: socket.socket) -> None:
        peer.sendall(struct.pack("<I", 1 << 20))
        for _ in itertools.count():
            peer.sendall(b"\0")
            asked[number].set()
            time.sleep(0.2)

    def behave(peer: socket.socket) -> None:
        peer.sendall(begin("/odd/quick") + string(b"hi"))

    with ExitStack() as strangers, Mqtt(appliance, "r2d2/odd/quick") as client:
        for number in range(5):
            slow = Stranger(world, f"/odd/slow{number}", lambda peer, own=number: dawdle(own, peer))
            strangers.enter_context(slow)
        strangers.enter_context(Stranger(world, "/odd/quick", behave))
        client.next("r2d2/odd/quick", {"data": "hi"})
        eventually(lambda: all(each.is_set() for each in asked), "all were asked")
        appliance.stop()
