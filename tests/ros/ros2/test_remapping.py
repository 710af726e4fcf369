"""Names that are remapped, on real ROS 2: routes name them as a node's code does."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import time
from pathlib import Path

import pytest
from waiting import PATIENCE, until

pytest.importorskip("rclpy")
pytest.importorskip("test_msgs.action")
from call_harness import CallHarness, action, parameters, service
from robot_process import Robot
from ros2_harness import STRING, TWIST, Peer, string
from ros_domain import claim

from appliance.ros.bridge import TopicSettings
from appliance.ros.remapping import remapped_names, with_own_names
from appliance.ros.ros2.node import Ros2Node, fault_of_arguments

#: The node of a bridge with parameters is seen for a while after it has left: not by other tests.
DOMAIN, _HELD = claim()

PARAMETERS = ("describe", "get", "list", "set")
RULES = (
    "/reset:=/turtle/reset",
    "pen:=turtle/pen",  # relative to __ns on both sides, which is / here
    "/walk:=/turtle/walk",
    "rosservice:///ask:=/turtle/ask_human",
    "/cmd:=/cmd_vel",
    "/talk:=/elsewhere/talk",
    "stranger:/turtle/think:=/nowhere",  # a rule for another node
    *(f"/its/{verb}_parameters:=/turtle/{verb}_parameters" for verb in PARAMETERS),
    "/its/get_parameter_types:=/turtle/get_parameter_types",
    "/its/set_parameters_atomically:=/turtle/set_parameters_atomically",
)
CALLS = (
    service(["/reset", "/p*", "/turtle/*"]),
    service("/ask", to="mqtt", type="std_srvs/srv/SetBool"),
    action("/walk"),
    parameters("/its/*"),
)
TOPICS = (
    TopicSettings("/cmd", "ros", "r2d2/cmd", TWIST),
    TopicSettings(("/talk", "/elsewhere/*"), "mqtt", "r2d2{ros}", encoding="text"),
)


@pytest.fixture(autouse=True)
def own_domain(isolated_domain, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", DOMAIN)


@pytest.fixture
def robot():
    robot = Robot()
    yield robot
    robot.stop()


@pytest.fixture
async def peer():
    peer = await Peer().start()
    yield peer
    await peer.stop()


@pytest.fixture
async def harness():
    arguments = [word for rule in RULES for word in ("-r", rule)]
    harness = CallHarness(Ros2Node(arguments=[*arguments, "-p", "use_sim_time:=false"]))
    harness.start(*CALLS, topics=TOPICS)
    yield harness
    await harness.stop()


async def test_all_that_is_remapped_is_carried(harness, robot, peer):
    alice = harness.client("alice", "r2d2/#")
    await asyncio.to_thread(robot.wait)
    await peer.do("advertise", "/elsewhere/talk", STRING)
    await peer.do("advertise", "/talk", STRING)  # which the bridge cannot reach: it goes elsewhere

    def status():
        return {name for each in harness.bridge.calls.status() for name in each.names}

    wanted = {"/reset", "/pen", "/ask", "/walk", "/its", "/turtle/think"}
    await until(lambda: wanted <= status(), "the calls")
    # Each has one name, and what has become of another by a remapping has no second one.
    assert status() == wanted
    topics = harness.bridge.topics

    await until(lambda: len(topics()) == 2, "the topics")
    assert {(topic.ros, topic.mqtt) for topic in topics()} == {
        ("/cmd", "r2d2/cmd"),
        ("/talk", "r2d2/talk"),
    }
    await peer.do("matched", "/elsewhere/talk")
    await peer.do("publish", "/talk", string("not this").hex())
    await peer.do("publish", "/elsewhere/talk", string("x").hex())
    await until(lambda: alice.on("r2d2/talk"), "the message from ROS")
    assert [message.payload for message in alice.on("r2d2/talk")] == [b"x"]

    async def drives():
        alice.send("r2d2/cmd", {"linear": {"x": 0.25}})
        return (await alice.call("r2d2/reset/_call"))[1]["message"] == "cmd_vel 0.25"

    deadline = time.monotonic() + PATIENCE
    while not await drives():
        assert time.monotonic() < deadline
        await asyncio.sleep(0.05)
    assert await alice.call("r2d2/pen/_call", {"data": True}) == (
        "ok",
        {"success": True, "message": "down"},
    )

    goal = (await alice.call("r2d2/walk/_goal", {"order": 3}))[1]["goal_id"]
    await until(lambda: alice.on(f"r2d2/walk/_result/{goal}"), "the result")
    (result,) = alice.payloads(f"r2d2/walk/_result/{goal}")
    assert result["result"]["sequence"] == [0, 1, 1, 2, 3]
    await until(lambda: alice.on(f"r2d2/walk/_feedback/{goal}"), "feedback")
    await until(lambda: alice.on("r2d2/walk/_status"), "the status")

    await until(lambda: harness.retained("r2d2/its/_param/mode") == "calm", "the parameters")
    assert (await alice.call("r2d2/its/_param/mode/set", b'"wild"'))[0] == "ok"

    asking = asyncio.create_task(asyncio.to_thread(robot.do, "ask", True))
    await until(lambda: [m for m in alice.received if "/ask/_request/" in m.topic], "the request")
    (request,) = [m for m in alice.received if "/ask/_request/" in m.topic]
    alice.send(request.topic.replace("_request", "_response"), {"success": True, "message": "me"})
    assert "me" in str(await asking)


def test_the_names_that_are_remapped():
    arguments = ["-r", "/a:=/b", "--remap", "c:=d", "-p", "x:=1", "--param", "y:=2"]
    arguments += [
        "-r",
        "__node:=n",
        "-r",
        "__ns:=/s",
        "-r",
        "other:e:=f",
        "--params-file",
        "g.yaml",
    ]
    arguments += ["-r", "rostopic://h:=i", "-r", "n:rosservice:///j:=k", "-r", "~/l:=/m"]
    assert [*remapped_names(arguments)] == ["/a", "c", "e", "h", "/j", "~/l"]


def test_names_of_the_graph_are_the_nodes_own():
    found = {"/a": 1, "/b": 2, "/c": 3, "/act/_action/x": 4, "/on/_action/x": 5, "/action": 6}
    assert with_own_names(found, {}, {}) == found
    # Exchanged, as two arms may be; and /c leads to what is not there.
    assert with_own_names(found, {"/a": "/b", "/b": "/a", "/c": "/d"}, {}) == {
        "/a": 2,
        "/b": 1,
        "/act/_action/x": 4,
        "/on/_action/x": 5,
        "/action": 6,
    }
    assert with_own_names(found, {}, {"/own": "/act", "/on": "/act"}) == {
        "/a": 1,
        "/b": 2,
        "/c": 3,
        "/own/_action/x": 4,
        "/on/_action/x": 4,
        "/action": 6,
    }


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--bogus"], "unknown: ['--bogus']"),
        (["--params-file", "/nowhere/sim.yaml"], "Couldn't parse params file: '--params-file"),
        (["-r", "say=base"], "Couldn't parse remap rule: '-r say=base'"),
        (["-r", "__ns:=r2d2"], "Couldn't parse remap rule: '-r __ns:=r2d2'"),
    ],
)
def test_arguments_that_ros_cannot_read_end_the_start(
    isolated_domain: None, tmp_path: Path, arguments: list[str], said: str
) -> None:
    """Tried again and again they would never be right."""
    file = tmp_path / "appliance.yaml"
    file.write_text("{robot: r2d2, broker: {listeners: [{bind: '127.0.0.1:0'}]}}")
    done = subprocess.run(
        [sys.executable, "-m", "appliance", "run", "-c", file, "--ros-args", *arguments],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 1
    assert f"ROS arguments (behind --ros-args): {said}" in done.stderr
    assert " at /" not in done.stderr.splitlines()[-1]


def test_arguments_that_are_right_are_no_fault(
    isolated_domain: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert fault_of_arguments(["-r", "/a:=/b", "-p", "use_sim_time:=true"]) is None
    monkeypatch.setenv("ROS_DOMAIN_ID", "no-number")
    assert fault_of_arguments(["-r", "/a:=/b"]) is None, "which is not for the arguments"
    monkeypatch.delenv("ROS_DOMAIN_ID")
    # rcl would end its process, and the broker has to run without a bridge.
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_of_nobody")
    assert fault_of_arguments(["--bogus"]) is None
