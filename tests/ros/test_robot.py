"""A robot driven end to end: the appliance, the robot and the clients are as in the field."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import uuid
from pathlib import Path

import cbor2
import pytest
import yaml
from appliance_process import ApplianceProcess
from waiting import PATIENCE, eventually

pytest.importorskip("rclpy")
pytest.importorskip("test_msgs.action")

from robot_client import TURTLE, V5, V311, Client

from appliance.host.environment import for_other_programs

both = pytest.mark.parametrize("version", [V5, V311], ids=["v5", "v311"])
BRIDGE = {
    "node": "bridge",
    "topics": [{"ros": "/cmd_vel", "to": "ros", "type": "geometry_msgs/msg/Twist"}],
    "services": [
        "/turtle/*",
        {"ros": "/turtle/think", "timeout": "10 s"},
        "/turtle/absent",
        {
            "ros": "/turtle/ask_human",
            "to": "mqtt",
            "type": "std_srvs/srv/SetBool",
            "timeout": "5 s",
            "on_error": {"success": False, "message": "nobody"},
        },
    ],
    "actions": ["/turtle/walk"],
    "parameters": ["/turtle/*", "!/turtle/gains", "/visit*/use_*"],
    "limits": {"calls_per_client": 8},
}
ACL = """\
user alice
topic readwrite r2d2/#
topic readwrite answers/#

user mallory
topic write r2d2/turtle/pen/_call/#
topic write r2d2/turtle/walk/_goal/#
topic write r2d2/turtle/walk/_cancel/#
pattern read r2d2/turtle/walk/_reply/%c/#
topic readwrite answers/#
"""


@pytest.fixture(scope="module")
def appliance(domain, robot, tmp_path_factory):
    appliance = ApplianceProcess(
        tmp_path_factory.mktemp("appliance"),
        users={"mallory": "mallory's"},
        acl=ACL,
        bridge=BRIDGE,
    )
    appliance.start()
    try:
        appliance.wait_for_log(r"/turtle/pen can be called")
        appliance.wait_for_log(r"parameters of /turtle are at")
        yield appliance
    finally:
        print(appliance.log)
        appliance.stop()


@pytest.fixture
def client_of(appliance):
    clients = []

    def make(version, *args, **kw):
        clients.append(Client(appliance, version, *args, **kw))
        return clients[-1]

    yield make
    for client in clients:
        client.leave()


# Services


def test_the_command_shows_what_can_be_called(appliance):
    done = subprocess.run(
        [sys.executable, "-m", "appliance", "routes", "-c", str(appliance.config)],
        capture_output=True,
        text=True,
        env=for_other_programs(),
        check=True,
    )
    head, *lines = (line.split() for line in done.stdout.splitlines())
    assert head[:4] == ["ROS", "MQTT", "TYPE", "AS"]
    for line in (
        ["/turtle/pen", "service", "r2d2/turtle/pen/_call", "std_srvs/srv/SetBool", "json"],
        ["/turtle/walk", "action", "r2d2/turtle/walk", "test_msgs/action/Fibonacci", "json"],
        [
            "/turtle",
            "parameters",
            "r2d2/turtle/_param",
            "rcl_interfaces/msg/ParameterValue",
            "json",
        ],
    ):
        assert line in lines
    (counts,) = (line for line in done.stdout.splitlines() if line.startswith("skipped: "))
    assert "1 not there" in counts
    assert ["/turtle/absent", "service", "no", "node", "offers", "it"] in lines


@both
def test_a_service_and_a_command(client_of, version):
    client = client_of(version)
    assert client.call(f"{TURTLE}/pen/_call", {"data": True}) == {
        "success": True,
        "message": "down",
    }
    speed = 0.25 if version == V5 else -1.5
    client.publish("r2d2/cmd_vel", {"linear": {"x": speed}})
    eventually(
        lambda: client.call(f"{TURTLE}/reset/_call")["message"] == f"cmd_vel {speed}",
        "the robot has its command",
    )


@both
def test_services_that_are_absent_silent_or_vanish(client_of, robot, version):
    client = client_of(version)
    assert client.error(f"{TURTLE}/absent/_call") == (
        "unavailable",
        "there is no /turtle/absent on the bus",
    )
    assert client.error(f"{TURTLE}/think/_call") == (
        "timeout",
        "no answer from /turtle/think within 10 s",
    )
    code, message = client.error(f"{TURTLE}/pen/_call", {"data": "yes"})
    assert code == "bad_request" and message.startswith("data: expected true or false")


def test_a_service_comes_and_vanishes_with_a_call_under_way(client_of, robot, appliance):
    client = client_of(V5)
    assert client.publish(f"{TURTLE}/muse/_call", ResponseTopic=f"answers/{client.name}") == 0x10
    robot.do("offer", "muse")
    appliance.wait_for_log("/turtle/muse can be called")
    ticket = client.send(f"{TURTLE}/muse/_call")
    robot.hear("asked", "muse")
    robot.do("vanish", "muse")
    assert client.answer(ticket)["error"] == {
        "code": "vanished",
        "message": "/turtle/muse went away before it answered",
    }


@both
def test_a_call_without_a_way_back(client_of, robot, version):
    client = client_of(version)
    client.subscribe(f"{TURTLE}/pen/_reply/{client.name}")
    client.publish(f"{TURTLE}/pen/_call", {"data": True})
    error = client.next(f"{TURTLE}/pen/_reply/{client.name}")["error"]
    assert error["code"] == "no_response_topic"
    assert f"{TURTLE}/pen/_call/TOKEN" in error["message"]


def test_rights(client_of):
    alice, mallory = client_of(V5), client_of(V5, "mallory")
    old = client_of(V311, "mallory")
    alice.subscribe(f"{TURTLE}/reset/#", f"{TURTLE}/pen/_reply/#", "r2d2/cmd_vel")
    assert mallory.call(f"{TURTLE}/pen/_call", {"data": True})["message"] == "down"
    # It may not write to that call topic.
    here = f"answers/{mallory.name}"
    assert mallory.publish(f"{TURTLE}/reset/_call", ResponseTopic=here) == 0x87
    # Nor have an answer published where it may not publish, nor get one that it may not read.
    mallory.publish(f"{TURTLE}/pen/_call", {"data": True}, ResponseTopic="r2d2/cmd_vel")
    old.publish(f"{TURTLE}/pen/_call/1", {"data": True})
    for client in mallory, old:
        error = alice.next(f"{TURTLE}/pen/_reply/{client.name}")["error"]
        assert error["code"] == "not_authorized"
    assert alice.payloads("r2d2/cmd_vel") == []
    assert alice.payloads(f"{TURTLE}/reset/_call") == []


@both
def test_too_many_calls_of_one_client(client_of, robot, version):
    client, other = client_of(version), client_of(version)
    tickets = [client.send(f"{TURTLE}/think/_call") for _ in range(9)]
    assert other.call(f"{TURTLE}/pen/_call")["success"]
    codes = [client.answer(ticket)["error"]["code"] for ticket in tickets]
    assert codes == ["timeout"] * 8 + ["too_many"]


@both
def test_an_mqtt_client_answers_a_ros_client(client_of, robot, version):
    assert robot.do("ask", True) == [False, "nobody"]
    client = client_of(version)
    request = f"{TURTLE}/ask_human/_request/+"
    client.subscribe(request)

    def on_request(paho_client, userdata, message):
        token = message.topic.rpartition("/")[2]
        answer = f"{TURTLE}/ask_human/_response/{token}"
        if version == V5:
            assert message.properties.ResponseTopic == answer
        asked = json.loads(message.payload)["data"]
        payload = {"success": asked, "message": "human"} if asked else {"success": "no"}
        paho_client.publish(answer, json.dumps(payload), 1)

    client.paho.message_callback_add(request, on_request)
    assert robot.do("ask", True) == [True, "human"]
    assert robot.do("ask", False) == [False, "nobody"]  # what it said was no answer


# Actions


WALK = f"{TURTLE}/walk"


@both
def test_several_goals_at_once_to_their_ends(client_of, version):
    client = client_of(version)
    client.subscribe(f"{WALK}/_feedback/+", f"{WALK}/_result/+", f"{WALK}/_status")
    tickets = {order: client.send(f"{WALK}/_goal", {"order": order}) for order in (3, 6, 99)}
    goals = {order: client.answer(ticket)["goal_id"] for order, ticket in tickets.items()}
    results = {order: client.next(f"{WALK}/_result/{goal}") for order, goal in goals.items()}
    assert results == {
        3: {"status": "succeeded", "result": {"sequence": [0, 1, 1, 2, 3]}},
        6: {"status": "succeeded", "result": {"sequence": [0, 1, 1, 2, 3, 5, 8, 13]}},
        99: {"status": "aborted", "result": {"sequence": [0, 1, 1, 2]}},
    }
    client.until(f"{WALK}/_feedback/{goals[6]}", {"sequence": [5, 8, 13]})
    feedback = client.payloads(f"{WALK}/_feedback/{goals[6]}")
    # The newest goes to a client that is slow, and none comes twice.
    steps = [[0, 1, 1], [1, 1, 2], [1, 2, 3], [2, 3, 5], [3, 5, 8], [5, 8, 13]]
    every = [{"sequence": step} for step in steps]
    assert feedback == [step for step in every if step in feedback]
    assert feedback[0] == every[0] and 3 <= len(feedback) <= 6

    def ended():
        return {
            one["goal_id"]: one["status"]
            for status in client.payloads(f"{WALK}/_status")[-1:]
            for one in status
        }

    expected = {goals[6]: "succeeded", goals[99]: "aborted"}
    eventually(lambda: expected.items() <= ended().items(), "the status")


@both
def test_a_goal_cancelled_half_way(client_of, robot, version):
    client = client_of(version)
    client.subscribe(f"{WALK}/_feedback/+", f"{WALK}/_result/+")
    goal = client.call(f"{WALK}/_goal", {"order": 300})["goal_id"]
    client.next(f"{WALK}/_feedback/{goal}")
    assert client.call(f"{TURTLE}/reset/_call")["message"] == "it walks"
    assert client.call(f"{WALK}/_cancel", {"goal_id": goal}) == {"goals_canceling": [goal]}
    result = client.next(f"{WALK}/_result/{goal}")
    assert result["status"] == "canceled"
    assert 2 < len(result["result"]["sequence"]) < 100
    code, message = client.error(f"{WALK}/_cancel", {"goal_id": goal})
    assert (code, message) == ("unknown_goal", "the goal has ended already")


def test_a_robot_that_is_driven_in_cbor(client_of, robot, appliance):
    client = client_of(V5)

    def call(topic, payload):
        properties = {
            "ResponseTopic": f"answers/{client.name}",
            "ContentType": "application/cbor",
        }
        assert client.publish(topic, cbor2.dumps(payload), **properties) == 0
        payload, _, about = client._take("message", f"answers/{client.name}")
        assert about.ContentType == "application/cbor"
        return payload

    assert call(f"{TURTLE}/pen/_call", {"data": True}) == {"success": True, "message": "down"}
    assert call(f"{PARAM}/speed/set", 1.25) == {"successful": True, "reason": ""}
    error = call(f"{WALK}/_goal", {"order": "far"})["error"]
    assert error["code"] == "bad_request" and error["message"].startswith("order: ")
    client.subscribe(f"{WALK}/_feedback/+", f"{WALK}/_result/+")
    accepted = call(f"{WALK}/_goal", {"order": 200})
    goal = accepted["goal_id"]
    other = call(f"{WALK}/_goal", {"order": 201})["goal_id"]
    # The route's own: JSON. On a busy computer newer feedback takes the place of the first.
    steps = [0, 1, 1, 2, 3, 5, 8, 13, 21, 34]
    feedback = client.next(f"{WALK}/_feedback/{goal}")["sequence"]
    assert feedback in [steps[at : at + 3] for at in range(len(steps) - 2)]
    # What the goal's answer gave cancels that goal, and no other.
    assert call(f"{WALK}/_cancel", accepted) == {"goals_canceling": [goal]}
    assert client.next(f"{WALK}/_result/{goal}")["status"] == "canceled"
    assert client.payloads(f"{WALK}/_result/{other}") == []
    # Up to the time of the first: the second is later. Then up to now.
    assert call(f"{WALK}/_cancel", {"stamp": accepted["stamp"]}) == {"goals_canceling": []}
    assert call(f"{WALK}/_cancel", {"stamp": "now"}) == {"goals_canceling": [other]}
    assert client.next(f"{WALK}/_result/{other}")["status"] == "canceled"


def test_only_one_s_own_goals_are_cancelled_by_who_may_no_more(client_of):
    alice, mallory = client_of(V5), client_of(V311, "mallory")
    alice.subscribe(f"{WALK}/_result/+")
    hers = alice.call(f"{WALK}/_goal", {"order": 300})["goal_id"]
    his = mallory.call(f"{WALK}/_goal", {"order": 301})["goal_id"]
    for payload in ({"goal_id": hers}, {"all": True}, {"goal_id": "00" * 16}):
        code, message = mallory.error(f"{WALK}/_cancel", payload)
        assert code == "not_authorized" and f"{WALK}/_cancel_any" in message
    assert mallory.call(f"{WALK}/_cancel", {"goal_id": his}) == {"goals_canceling": [his]}
    assert alice.next(f"{WALK}/_result/{his}")["status"] == "canceled"
    assert alice.payloads(f"{WALK}/_result/{hers}") == []
    assert alice.call(f"{WALK}/_cancel", {"all": True}) == {"goals_canceling": [hers]}
    assert alice.next(f"{WALK}/_result/{hers}")["status"] == "canceled"


def test_goals_that_are_refused(client_of):
    client = client_of(V5)
    assert client.error(f"{WALK}/_goal", {"order": -1}) == (
        "rejected",
        "/turtle/walk does not accept the goal",
    )
    code, message = client.error(f"{WALK}/_goal", {"order": 2**31})
    assert code == "bad_request" and message.startswith("order: ")
    code, message = client.error(f"{WALK}/_cancel", {"goal_id": "00" * 15 + "01"})
    assert code == "unknown_goal"
    assert client.error(f"{WALK}/_cancel", {"goal": 1})[0] == "bad_request"
    goal = client.call(f"{WALK}/_goal", {"order": 113})["goal_id"]
    assert client.error(f"{WALK}/_cancel", {"goal_id": goal}) == (
        "rejected",
        "the action's server does not cancel it",
    )
    goals = [client.call(f"{WALK}/_goal", {"order": 300})["goal_id"] for _ in range(2)]
    cancelled = client.call(f"{WALK}/_cancel", {"all": True})["goals_canceling"]
    assert sorted(cancelled) == sorted(goals)
    client.subscribe(f"{WALK}/_result/{goal}")
    assert client.next(f"{WALK}/_result/{goal}")["status"] == "succeeded"


@both
def test_a_client_that_comes_back_gets_its_goals_result(client_of, robot, version):
    name = f"tablet-{uuid.uuid4().hex[:6]}"
    client = client_of(version, name=name, keeps=True)
    client.subscribe(f"{WALK}/_result/+")
    goal = client.call(f"{WALK}/_goal", {"order": 100})["goal_id"]
    client.drop()
    robot.hear("walked", 100, 100)
    back = client_of(version, name=name, keeps=True)
    assert back.next(f"{WALK}/_result/{goal}")["status"] == "succeeded"
    # One that had no session finds it retained.
    late = client_of(version)
    late.subscribe(f"{WALK}/_result/{goal}")
    assert len(late.next(f"{WALK}/_result/{goal}")["result"]["sequence"]) == 102


def test_the_goals_of_a_client_that_has_gone_are_cancelled_when_the_route_says_so(
    client_of, robot, appliance
):
    client, watcher = client_of(V5), client_of(V311)
    goal = client.call(f"{WALK}/_goal", {"order": 301})["goal_id"]
    settings = yaml.safe_load(appliance.config.read_text())
    settings["bridge"]["actions"] = [
        {"ros": "/turtle/walk", "cancel_on_disconnect": True, "keep_result": "1 s"}
    ]
    appliance.config.write_text(yaml.safe_dump(settings))
    os.kill(appliance.pid, signal.SIGHUP)
    appliance.wait_for_log("reloaded: bridge.actions")
    watcher.subscribe(f"{WALK}/_result/+")
    # The goal of before goes on; it is known to the route that it was sent through.
    assert watcher.call(f"{WALK}/_cancel", {"goal_id": goal}) == {"goals_canceling": [goal]}
    assert watcher.next(f"{WALK}/_result/{goal}")["status"] == "canceled"
    goal = client.call(f"{WALK}/_goal", {"order": 302})["goal_id"]
    client.drop()
    assert watcher.next(f"{WALK}/_result/{goal}")["status"] == "canceled"
    appliance.wait_for_log(f"goal {goal} of /turtle/walk is cancelled: client .* has gone")
    # What it kept is gone in its time.
    late = client_of(V5)

    def is_kept():
        late.subscribe(f"{WALK}/_result/{goal}")
        late.call(f"{TURTLE}/pen/_call")
        found = late.payloads(f"{WALK}/_result/{goal}")
        late.received.clear()
        return found

    eventually(lambda: not is_kept(), "the result is kept no longer")


# Parameters


PARAM = f"{TURTLE}/_param"


@both
def test_parameters_are_shown_and_set(client_of, robot, version):
    client = client_of(version)
    client.subscribe(f"{PARAM}/+")
    assert client.next(f"{PARAM}/serial") == "T-800"
    assert client.next(f"{PARAM}/mode") == "calm"
    robot.do("set", "speed", 1.5)
    client.until(f"{PARAM}/speed", 1.5)
    ok = {"successful": True, "reason": ""}
    assert client.call(f"{PARAM}/speed/set", 1) == ok  # a double, as the node has declared it
    client.until(f"{PARAM}/speed", 1.0)
    assert client.error(f"{PARAM}/steps/set", 1.0) == (
        "bad_request",
        "steps: expected an integer, got 1.0",
    )
    code, message = client.error(f"{PARAM}/speed/set", 3)
    assert code == "rejected" and "out of range" in message and "speed" in message
    assert client.error(f"{PARAM}/mode/set", "lazy") == (
        "rejected",
        "/turtle does not set mode: there is no mode lazy",
    )
    assert client.error(f"{PARAM}/serial/set", "X") == ("rejected", "serial is read-only")
    assert client.error(f"{PARAM}/nothing/set", 1)[0] == "rejected"
    assert client.error(f"{PARAM}/gains/set", [1]) == (
        "not_authorized",
        "the parameter /turtle/gains is not among bridge.parameters",
    )
    # Several of them: all, or none.
    code, message = client.error(f"{PARAM}/_set", {"speed": 0.5, "mode": "lazy"})
    assert code == "rejected" and "there is no mode lazy" in message
    assert client.call(f"{PARAM}/_set", {"speed": 0.75, "mode": "wild"}) == ok
    client.until(f"{PARAM}/mode", "wild")
    client.until(f"{PARAM}/speed", 0.75)
    assert 0.5 not in client.payloads(f"{PARAM}/speed")[1:]
    assert client.payloads(f"{PARAM}/gains") == []
    robot.do("set", "speed", 0.5)
    robot.do("set", "mode", "calm")
    client.until(f"{PARAM}/mode", "calm")


def test_parameters_come_and_go(client_of, robot):
    client = client_of(V5)
    client.subscribe(f"{PARAM}/+")
    robot.do("declare", "whim", "tea")
    client.until(f"{PARAM}/whim", "tea")
    robot.do("set", "whim", 7)
    client.until(f"{PARAM}/whim", 7)
    robot.do("set", "whim", None)
    client.until(f"{PARAM}/whim", None)


@contextlib.contextmanager
def visitor():
    process = subprocess.Popen(
        [sys.executable, str(Path(__file__).parent / "peer.py"), "visitor"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        env=for_other_programs(),
    )
    try:
        yield process
    finally:
        process.stdin.close()
        process.wait(PATIENCE)


def test_a_node_comes_and_goes(client_of, appliance):
    value = "r2d2/visitor/_param/use_sim_time"
    client = client_of(V311)
    client.subscribe("r2d2/visitor/_param/+")

    def change():
        client.until(value, False)
        answer = client.call(f"{value}/set", True)
        if answer.get("error", {}).get("code") == "timeout":
            # A node that has not discovered within 100 ms who asks it drops its answer (Fast DDS).
            answer = client.call(f"{value}/set", True)
        assert answer.get("successful"), answer
        client.until(value, True)

    with visitor():
        change()
    client.until(value, None)
    client.received.clear()
    with visitor() as first:
        change()
        client.received.clear()
        first.kill()  # it is on the graph for a while yet, next to the one that takes its place
        with visitor():
            client.until(value, False)


# The end


def test_an_action_whose_server_ends(client_of, robot):
    """The last test: there are no walks after it."""
    client = client_of(V5)
    client.subscribe(f"{WALK}/_result/+", f"{WALK}/_status")
    goal = client.call(f"{WALK}/_goal", {"order": 303})["goal_id"]
    robot.do("end_walks")
    result = client.next(f"{WALK}/_result/{goal}")
    assert (result["status"], result["error"]["code"]) == ("unknown", "vanished")
    client.until(f"{WALK}/_status", None)
    assert client.error(f"{WALK}/_goal", {"order": 1})[0] == "unavailable"
