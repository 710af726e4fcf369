"""Calls in every encoding on ROS 1, what is skipped, what the appliance's commands say and do, and
that it joins ROS again."""

from __future__ import annotations

import json
import struct
import time
from xmlrpc.client import Binary

import cbor2
import paho.mqtt.client as paho
import pytest
from ros1_world import Mqtt, Node, Ros1Appliance, Run, World, is_installed
from waiting import eventually

pytestmark = pytest.mark.skipif(
    not is_installed(), reason="needs ROS 1: apt install python3-roslaunch python3-rospy …"
)

CBOR, RAW, CDR = "application/cbor", "application/x-ros1", "application/cdr"


def about(message: paho.MQTTMessage) -> tuple[str, dict[str, str]]:
    """Content type and user properties."""
    properties = message.properties
    return properties.ContentType, dict(properties.UserProperty)  # type: ignore[union-attr]


def error(message: paho.MQTTMessage) -> tuple[str, str]:
    found = json.loads(message.payload)["error"]
    return found["code"], found["message"]


def test_a_service_in_cbor_and_in_ros_bytes(robot: Node, appliance: Ros1Appliance) -> None:
    with Mqtt(appliance) as client:
        topic = "r2d2/robot/switch/_call"
        answer = client.ask(topic, cbor2.dumps({"data": True}), CBOR)
        assert cbor2.loads(answer.payload) == {"success": False, "message": "so"}
        assert about(answer)[0] == CBOR
        answer = client.ask(topic, b"\1", RAW)
        assert answer.payload == b"\0\2\0\0\0so"
        said = {"status": "ok", "ros-type": "std_srvs/srv/SetBool_Response"}
        assert about(answer) == (RAW, said)
        assert client.ask(topic, b"", RAW).payload[0] == 1  # nothing is the default, false
        code, text = error(client.ask(topic, bytes(8), CDR))
        assert code == "bad_request" and "json or cbor or ros1, not cdr" in text
        code, text = error(client.ask("r2d2/robot/work/_goal", b"\1\2", RAW))
        assert code == "bad_request" and "truncated" in text


def test_a_service_that_is_remapped(robot: Node, appliance: Ros1Appliance) -> None:
    appliance.wait_for_log("/greet can be called at r2d2/greet/_call")
    with Mqtt(appliance) as client:
        answer = client.call("r2d2/greet", {})
        assert answer == {"success": True, "message": "hello, whoever"}
    assert "/elsewhere/greet can be called" not in appliance.log


def test_a_service_that_fails_stays(robot: Node, appliance: Ros1Appliance) -> None:
    appliance.wait_for_log("/robot/fail can be called")
    with Mqtt(appliance) as client:
        for _ in range(20):
            code, text = error(client.ask("r2d2/robot/fail/_call", b"{}"))
            assert code == "ros_error" and text.startswith("/robot/fail says: ")
    assert len(appliance.wait_for_log("/robot/fail can be called")) == 1


def test_payloads_over_the_size_limit_are_refused(robot: Node, appliance: Ros1Appliance) -> None:
    large = b'{"data": "' + bytes(70_000).replace(b"\0", b"x") + b'"}'
    with Mqtt(appliance) as client:
        code, text = error(client.ask("r2d2/robot/switch/_call", large))
        assert code == "too_large" and "bridge.limits.payload" in text
        robot.do("hear", "/hear", "std_msgs/String")
        client.paho.publish("r2d2/hear", large, 1)
        appliance.wait_for_log("/hear.*70012 bytes, at most 65536 are converted")

        def is_heard() -> bool:
            client.paho.publish("r2d2/hear", '{"data": "small"}', 1)
            return bool(robot.do("heard", "/hear"))

        eventually(is_heard, "small messages go on")
        assert robot.do("heard", "/hear")[0] == 'data: "small"'  # type: ignore[index]


def test_goals_in_cbor_and_in_ros_bytes(robot: Node, appliance: Ros1Appliance) -> None:
    with Mqtt(appliance, "r2d2/robot/work/#") as client:
        answer = client.ask("r2d2/robot/work/_goal", struct.pack("<i", 2), RAW)
        assert about(answer)[1]["ros-type"] == "action_msgs/msg/GoalInfo"
        id_, sec = answer.payload[:16], struct.unpack("<II", answer.payload[16:])[0]
        assert abs(sec - time.time()) < 60
        found = client.next(f"r2d2/robot/work/_result/{id_.hex()}")
        assert json.loads(found.payload) == {"status": "succeeded", "result": {"result": 2}}
        feedback = client.next(f"r2d2/robot/work/_feedback/{id_.hex()}")
        assert json.loads(feedback.payload)["feedback"] in (0, 1)

        def begin() -> tuple[str, dict[str, int]]:
            answer = client.ask("r2d2/robot/work/_goal", cbor2.dumps({"goal": 1000}), CBOR)
            said = cbor2.loads(answer.payload)
            return said["goal_id"], said["stamp"]

        def cancel(which: object) -> list[str]:
            answer = client.ask("r2d2/robot/work/_cancel", cbor2.dumps(which), CBOR)
            found: list[str] = cbor2.loads(answer.payload)["goals_canceling"]
            return found

        goal, stamp = begin()
        # Those of before are others, and this one goes on.
        assert cancel({"stamp": {**stamp, "sec": stamp["sec"] - 10}}) == []
        assert cancel({"stamp": stamp}) == [goal]
        ended = client.next(f"r2d2/robot/work/_result/{goal}")
        assert json.loads(ended.payload)["status"] == "canceled"
        goal, _ = begin()
        answer = client.ask("r2d2/robot/work/_cancel", bytes.fromhex(goal) + bytes(8), RAW)
        assert answer.payload[:21] == struct.pack("<bI", 0, 1) + bytes.fromhex(goal)
        ended = client.next(f"r2d2/robot/work/_result/{goal}")
        assert json.loads(ended.payload)["status"] == "canceled"


def test_parameters_in_cbor_and_what_is_absent(world: World, appliance: Ros1Appliance) -> None:
    def absent(message: paho.MQTTMessage) -> list[str]:
        return [
            one["ros"]
            for one in json.loads(message.payload)["skipped"]
            if (one["direction"], one["why"]) == ("parameters", "absent")
        ]

    skipped = "r2d2/_appliance/skipped"
    with Mqtt(appliance, "r2d2/camera/_param/#", "r2d2/arm/_param/#", skipped) as client:
        client.until(lambda m: m.topic == skipped and "/arm/absent" in absent(m))
        world.ask("setParam", "/camera/key", Binary(b"\0\1"))
        world.ask("setParam", "/arm/key", Binary(b"\0\1"))
        world.ask("setParam", "/arm/absent", 1)
        found = client.until(lambda m: m.topic == "r2d2/camera/_param/key")
        assert (cbor2.loads(found.payload), found.properties.ContentType) == (b"\0\1", CBOR)
        assert client.next("r2d2/arm/_param/key").payload == b'"AAE="'
        client.until(lambda m: m.topic == skipped and "/arm/absent" not in absent(m))
        answer = client.ask("r2d2/camera/_param/_set", cbor2.dumps({"key": b"\2", "n": 1}), CBOR)
        assert cbor2.loads(answer.payload) == {"successful": True, "reason": ""}
        client.until(lambda m: m.topic == "r2d2/camera/_param/key" and m.payload == b"A\2")
        # In JSON what was bytes is base64.
        client.ask("r2d2/arm/_param/key/set", b'"Ag=="')
        assert world.ask("getParam", "/arm/key").data == b"\2"
        for topic, payload, content_type in (
            ("camera/_param/key/set", b"\1", RAW),
            ("arm/_param/key/set", b'"no base64"', ""),
            ("arm/_param/name/set", b'"\\u0001"', ""),
            ("arm/_param/deep/set", b"[" * 100 + b"]" * 100, ""),
            ("arm/_param/_set", b"{}", ""),
        ):
            code, _ = error(client.ask(f"r2d2/{topic}", payload, content_type))
            assert code == "bad_request", topic
        for name in ("/camera", "/arm/key", "/arm/absent"):
            world.ask("deleteParam", name)


def test_commands_that_call(world: World, robot: Node, appliance: Ros1Appliance, run: Run) -> None:
    def reach(*arguments: str) -> tuple[int, str]:
        ca = str(appliance.ca)
        return run(*arguments, "-p", str(appliance.port), "--ca", ca, "-u", "alice")

    assert reach("call", "/robot/switch", "{data: false}") == (
        0,
        '{"success":true,"message":"so"}\n',
    )
    code, text = reach("goal", "/robot/work", "{goal: 2}")
    assert code == 0 and text.endswith('succeeded {"result":2}\n'), text
    world.ask("setParam", "/speed", 1.5)
    with Mqtt(appliance, "r2d2/_param/speed") as client:
        client.next("r2d2/_param/speed", 1.5)
    assert reach("param", "set", "/", "speed", "2") == (0, "")
    assert reach("param", "get", "/", "speed") == (0, "2.0\n")


def test_commands_that_report_the_status(robot: Node, appliance: Ros1Appliance, run: Run) -> None:
    code, text = run("check")
    assert code == 0 and "bridge: ROS 1 in /" in text, text
    code, text = run("status")
    assert code == 0 and "joined as /appliance, other nodes seen: " in text, text
    code, text = run("doctor")
    for part in (
        "ok      ROS: ROS 1 in /",
        "ok      ROS network: other nodes are told to connect to 127.0.0.1 (ROS_HOSTNAME)",
        "ok      ROS Master: http://127.0.0.1:",
        "ok      ROS nodes: seen: ",
    ):
        assert part in text, text
    assert "problem " not in text
    code, text = run("doctor", ROS_MASTER_URI="http://127.0.0.1:1", ROS_HOSTNAME="no.such.invalid")
    assert code == 1 and "problem ROS Master: it does not answer: http://127.0.0.1:1" in text
    assert "warning ROS network" in text and "has no address here" in text
