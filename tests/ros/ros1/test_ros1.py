"""ROS 1 as the bus: a real Master, nodes of other processes, ROS's commands and mosquitto's."""

from __future__ import annotations

import json
import os
import re
import subprocess
import threading
import time
from functools import partial

import pytest
from ros1_world import (
    HERE,
    SYSTEM_PYTHON,
    Mqtt,
    Node,
    Python,
    Ros1Appliance,
    World,
    end,
    is_installed,
    output,
)
from waiting import PATIENCE, eventually

from appliance.host.environment import for_other_programs

pytestmark = pytest.mark.skipif(
    not is_installed(), reason="needs ROS 1: apt install python3-roslaunch python3-rospy …"
)


def mosquitto(appliance: Ros1Appliance, command: str, *arguments: str) -> list[str]:
    login = ["-h", "127.0.0.1", "-p", str(appliance.plain_port), "-u", "alice"]
    return [command, *login, "-P", appliance.passwords["alice"], *arguments]


def test_strings_between_rostopic_and_mosquitto(world: World, appliance: Ros1Appliance) -> None:
    listener = subprocess.Popen(
        mosquitto(appliance, "mosquitto_sub", "-t", "r2d2/chatter", "-C", "2", "-W", "120"),
        stdout=subprocess.PIPE,
        text=True,
        env=for_other_programs(),
    )
    talker = world.begin("rostopic", "pub", "-r", "10", "/chatter", "std_msgs/String", "data: hi")
    echo = world.begin("rostopic", "echo", "-n", "1", "/hear")
    try:
        assert listener.communicate(timeout=2 * PATIENCE)[0].split("\n")[:2] == [
            '{"data":"hi"}',
            '{"data":"hi"}',
        ]
        hello = mosquitto(
            appliance, "mosquitto_pub", "-t", "r2d2/hear", "-m", '{"data": "hello, ros"}'
        )
        greet = partial(subprocess.run, hello, check=True, env=for_other_programs())
        assert output(echo, greet) == 'data: "hello, ros"\n---\n'
    finally:
        for process in (listener, talker, echo):
            if process.poll() is None:
                end(process)


def test_many_messages_come_in_order_and_none_is_lost(
    robot: Node, appliance: Ros1Appliance
) -> None:
    with Mqtt(appliance, "r2d2/many") as client:
        robot.do("publish", "/many", "std_msgs/String", "first")
        client.next("r2d2/many", {"data": "first"})
        robot.do("burst", "/many", 500)
        client.next("r2d2/many", {"data": "499"})
        found = [json.loads(message.payload)["data"] for message in client.received]
        assert found == [str(number) for number in range(499)]


def test_messages_of_latched_publishers_are_retained(robot: Node, appliance: Ros1Appliance) -> None:
    def is_retained() -> bool:
        with Mqtt(appliance, "r2d2/robot/map") as client:
            message = client.next("r2d2/robot/map")
            assert json.loads(message.payload) == {"data": "a map"}
            return bool(message.retain)

    eventually(is_retained, "the map is retained")


def test_a_type_that_is_installed_nowhere(robot: Node, appliance: Ros1Appliance) -> None:
    schema = "r2d2/_appliance/schema/own_msgs/Own"
    with Mqtt(appliance, "r2d2/robot/own", schema) as client:
        message = client.next("r2d2/robot/own")
        assert json.loads(message.payload) == {
            "name": "mine",
            "data": "AQI=",
            "parts": [{"at": {"sec": 1, "nanosec": 2}, "pair": [0.5, 1.5]}],
        }
        assert ("ros-type", "own_msgs/msg/Own") in message.properties.UserProperty
        assert json.loads(client.next(schema).payload)["title"] == "own_msgs/msg/Own"


def test_ros1_encoding_passes_bytes_without_an_echo(robot: Node, appliance: Ros1Appliance) -> None:
    data = bytes.fromhex(str(robot.do("bytes", "/raw/text", "std_msgs/String", "a\0b é")))
    assert data == b"\x06\0\0\0a\0b \xc3\xa9"
    with Mqtt(appliance, "r2d2/raw/text", "r2d2/both") as client:
        robot.do("publish", "/raw/text", "std_msgs/String", "a\0b é")
        message = client.next("r2d2/raw/text")
        assert (message.payload, message.properties.ContentType) == (data, "application/x-ros1")
        robot.do("hear", "/both", "std_msgs/String")

        def came() -> object:
            client.paho.publish("r2d2/both", data, 1)
            return robot.do("heard", "/both")

        eventually(came, "bytes reach ROS")
        assert set(robot.do("heard", "/both")) == {'data: "a\\0b \\xE9"'}  # type: ignore[call-overload]

        def comes() -> bool:  # the robot hears itself, so that it is not told when we do
            robot.do("publish", "/both", "std_msgs/String", "from ROS")
            return any(m.payload == b"\x08\0\0\0from ROS" for m in client.received)

        eventually(comes, "what ROS says reaches MQTT")
        for cut in (data[:-1], data[:3], b"", b"\xff\xff\xff\xff" + data):
            client.paho.publish("r2d2/both", cut, 1)
        client.paho.publish("r2d2/both", b"\x04\0\0\0last", 1)
        eventually(lambda: "last" in str(robot.do("heard", "/both")), "the last one comes")
        expected = {'data: "a\\0b \\xE9"', 'data: "from ROS"', 'data: "last"'}
        # Whether it hears itself depends on when it found itself.
        assert set(robot.do("heard", "/both")) <= expected  # type: ignore[call-overload]
        # What went to ROS came to us by MQTT alone: the appliance's own samples do not come back.
        own = [m for m in client.received if m.payload == b"\x04\0\0\0last"]
        assert len(own) == 1
    appliance.wait_for_log("r2d2/both → /both: a message cannot be converted: data: truncated")


def test_commands_follow_the_rules_of_their_route(robot: Node, appliance: Ros1Appliance) -> None:
    robot.do("hear", "/cmd_vel", "geometry_msgs/Twist")
    with Mqtt(appliance) as driver, Mqtt(appliance) as other:

        def drives() -> object:
            # A single command, and the next behind a silence: several at once are a queue.
            driver.paho.publish("r2d2/cmd_vel", '{"linear": {"x": 9}}', 1).wait_for_publish(5)
            time.sleep(0.7)
            return "x: 0.5" in str(robot.do("heard", "/cmd_vel"))

        eventually(drives, "commands reach ROS")
        other.paho.publish("r2d2/cmd_vel", '{"linear": {"x": -0.25}}', 1).wait_for_publish(5)
        eventually(
            lambda: "x: 0.0\n  y: 0.0" in str(robot.do("heard", "/cmd_vel")[-1]),  # type: ignore[index]
            "the stop message comes",
        )
        heard = str(robot.do("heard", "/cmd_vel"))
        assert "x: 0.5" in heard and "x: 9" not in heard and "-0.25" not in heard


def test_a_header_and_now(robot: Node, appliance: Ros1Appliance) -> None:
    robot.do("hear", "/stamped", "geometry_msgs/PointStamped")
    with Mqtt(appliance) as client:

        def comes() -> object:
            header = {"stamp": "now", "frame_id": "map", "seq": 7}
            client.paho.publish("r2d2/stamped", json.dumps({"header": header, "point": {"x": 1}}))
            return robot.do("heard", "/stamped")

        eventually(comes, "a point reaches ROS")
        text = robot.do("heard", "/stamped")[0]  # type: ignore[index]
        seconds = re.search(r"secs: (\d+)", text)
        assert seconds and abs(int(seconds[1]) - time.time()) < 60
        assert "seq: 7" in text and 'frame_id: "map"' in text and "x: 1.0" in text


def test_services_both_ways(world: World, robot: Node, appliance: Ros1Appliance) -> None:
    appliance.wait_for_log("/robot/switch can be called at")
    with Mqtt(appliance, "r2d2/ask_human/_request/+") as client:
        call = client.call
        assert call("r2d2/robot/switch", {"data": True}) == {"success": False, "message": "so"}
        assert call("r2d2/robot/switch", {}) == {"success": True, "message": "so"}
        error = call("r2d2/robot/switch", {"data": 1})["error"]  # type: ignore[index]
        assert error == {
            "code": "bad_request",
            "message": "data: expected true or false, got 1",
        }
        # In ROS 1 these are no bytes at all.
        assert call("r2d2/robot/greet", {}) == {"success": True, "message": "hello"}
        assert call("r2d2/robot/rest", {}) == {}
        assert call("r2d2/robot/sleep", {})["error"]["code"] == "timeout"  # type: ignore[index]
        said = world.run("rosservice", "call", "/ask_nobody", "true", check=False)
        assert "nobody on MQTT answered" in said
        assert robot.do("ask", "/ask_human", True) == [False, "nobody"]
        client.next(client.received[-1].topic)

        def answer() -> None:
            request = client.until(lambda m: m.topic.startswith("r2d2/ask_human/_request/"))
            assert json.loads(request.payload) == {"data": False}
            reply = '{"success": true, "message": "a human"}'
            client.paho.publish(request.properties.ResponseTopic, reply, 1)

        human = threading.Thread(target=answer)
        human.start()
        said = world.run("rosservice", "call", "/ask_human", "false")
        human.join(PATIENCE)
        assert said == 'success: True\nmessage: "a human"\n'


SHORT_LIVED = """
import rospy
from std_srvs.srv import SetBool, SetBoolResponse
rospy.init_node("short_lived")
rospy.Service("/robot/mayfly", SetBool, lambda asked: SetBoolResponse(True, "still here"))
rospy.spin()
"""


def test_a_server_that_was_killed_is_missed(world: World, appliance: Ros1Appliance) -> None:
    server = world.begin(SYSTEM_PYTHON, "-c", SHORT_LIVED)
    try:
        appliance.wait_for_log("/robot/mayfly can be called at")
        with Mqtt(appliance) as client:
            answer = client.call("r2d2/robot/mayfly", {})
            assert answer == {"success": True, "message": "still here"}
            server.kill()
            # The Master does not notice, and goes on telling of it.
            assert "error" in client.call("r2d2/robot/mayfly", {})  # type: ignore[operator]
            assert "/robot/mayfly" in world.graph()[2]

            routes = "r2d2/_appliance/routes"
            with Mqtt(appliance, routes) as viewer:
                viewer.until(lambda m: m.topic == routes and b"mayfly" not in m.payload)
    finally:
        end(server)


def test_an_action(robot: Node, appliance: Ros1Appliance) -> None:
    appliance.wait_for_log("/robot/work can be called at")
    with Mqtt(appliance, "r2d2/robot/work/#") as client:
        accepted = client.call("r2d2/robot/work", {"goal": 3}, "_goal")
        goal = accepted["goal_id"]  # type: ignore[index]
        result = client.next(f"r2d2/robot/work/_result/{goal}")
        assert json.loads(result.payload) == {"status": "succeeded", "result": {"result": 3}}
        steps = f"r2d2/robot/work/_feedback/{goal}"  # come over another connection
        client.until(lambda m: m.topic == steps and json.loads(m.payload) == {"feedback": 2})

        accepted = client.call("r2d2/robot/work", {"goal": -1}, "_goal")
        goal = accepted["goal_id"]  # type: ignore[index]
        result = client.next(f"r2d2/robot/work/_result/{goal}")
        assert json.loads(result.payload)["status"] == "aborted"

        accepted = client.call("r2d2/robot/work", {"goal": 400}, "_goal")
        goal = accepted["goal_id"]  # type: ignore[index]
        client.until(lambda m: m.topic == f"r2d2/robot/work/_feedback/{goal}")
        cancelled = client.call("r2d2/robot/work", {"goal_id": goal}, "_cancel")
        assert cancelled == {"goals_canceling": [goal]}
        result = client.next(f"r2d2/robot/work/_result/{goal}")
        assert json.loads(result.payload)["status"] == "canceled"
        again = client.call("r2d2/robot/work", {"goal_id": goal}, "_cancel")
        assert again["error"]["code"] == "unknown_goal"  # type: ignore[index]
        wrong = client.call("r2d2/robot/work", {"gaol": 1}, "_goal")
        assert "did you mean 'goal'?" in wrong["error"]["message"]  # type: ignore[index]


def test_parameters(world: World, appliance: Ros1Appliance) -> None:
    world.run("rosparam", "set", "/arm/gain", "0.5")
    for name, value in (("/arm/secret", 1), ("/arm/pid/p", 1), ("/speed", [1, "two", 3.5])):
        world.ask("setParam", name, value)
    with Mqtt(appliance, "r2d2/arm/_param/#", "r2d2/_param/#") as client:
        client.next("r2d2/arm/_param/gain", 0.5)
        client.next("r2d2/_param/speed", [1, "two", 3.5])

        def set_to(name: str, value: object) -> object:
            return client.call(f"r2d2/arm/_param/{name}", value, "set")

        assert set_to("gain", 2) == {"successful": True, "reason": ""}
        client.next("r2d2/arm/_param/gain", 2.0)
        assert world.run("rosparam", "get", "/arm/gain") == "2.0\n"
        assert set_to("new", [True, "x"]) == {"successful": True, "reason": ""}
        assert world.ask("getParam", "/arm/new") == [True, "x"]
        for name, wrong, code in (
            ("secret", 2, "not_authorized"),
            ("gain", None, "bad_request"),
            ("gain", {"a": 1}, "bad_request"),
            ("pid", 1, "rejected"),
            ("other", 2**40, "bad_request"),
        ):
            assert set_to(name, wrong)["error"]["code"] == code, name  # type: ignore[index]
        world.ask("deleteParam", "/arm/gain")
        client.until(lambda m: m.topic == "r2d2/arm/_param/gain" and not m.payload)
        assert not [m for m in client.received if m.topic.endswith("secret")]


def test_the_commands_show_what_is_bridged(robot: Node, appliance: Ros1Appliance) -> None:
    out = subprocess.run(
        [appliance.python, "-m", "appliance", "routes", "-c", appliance.config],
        env={**os.environ, **appliance.environment},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert "own_msgs/msg/Own" in out and "actionlib/action/Test" in out, out


def test_every_type_of_debians_packages(python: Python, world: World) -> None:
    environment = world.for_ros | {"PYTHONPATH": python.path}
    done = subprocess.run(
        [python.executable, str(HERE / "ros1_all_types.py")],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    packages, types = map(int, re.findall(r"(\d+) (?:packages|types)", done.stdout))
    assert packages >= 18 and types >= 217, done.stdout
