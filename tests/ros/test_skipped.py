"""What is not bridged, and why: on a FakeNode, and as `appliance routes` prints it."""

from __future__ import annotations

import asyncio
import json

import pytest
from waiting import until

pytest.importorskip("std_srvs.srv")
from call_harness import AllTypes, CallHarness, action, call_routes, parameters, service

from appliance.cli import main as cli
from appliance.ops import control
from appliance.ros.bridge import TopicSettings
from appliance.ros.node import FakeNode
from appliance.ros.payload.definitions import UnknownTypeError
from appliance.ros.skipped import MAX_ENTRIES

STRING, TWIST = "std_msgs/msg/String", "geometry_msgs/msg/Twist"
TRIGGER = "std_srvs/srv/Trigger"


class Bus(FakeNode):
    """Knows which services' types are installed, as rclpy does."""

    def create_client(self, service, type_name):
        self._check(type_name)
        return super().create_client(service, type_name)

    def create_service(self, service, type_name, callback):
        self._check(type_name)
        return super().create_service(service, type_name, callback)

    def _check(self, type_name):
        if type_name.startswith("acme"):
            raise UnknownTypeError(f"no {type_name}: the package is not installed here")


@pytest.fixture
async def harness():
    harness = CallHarness(Bus(types=AllTypes()))
    yield harness
    await harness.stop()


def topic(ros, to="mqtt", **kw):
    names = (ros,) if isinstance(ros, str) else tuple(ros)
    return TopicSettings(names[0] if len(names) == 1 else names, to, "r2d2{ros}", **kw)


def skipped(harness):
    """Why, by name and direction."""
    return {(skip.ros, skip.direction): skip.why for skip in harness.bridge.skips()}


def told(harness):
    return harness.retained("r2d2/_appliance/skipped")


async def look(harness):
    harness.node.spin()
    await asyncio.sleep(0)
    await asyncio.sleep(0)


async def test_topics(harness):
    node = harness.node
    harness.start(
        topics=[
            topic("/odom"),
            topic("/cmd", "ros"),
            topic("/lidar", "mqtt", type="acme_msgs/msg/Points"),
            topic(["/arm/**", "!/arm/raw"]),
            topic("/**", type="std_msgs/msg/*"),
        ]
    )
    for name, kind in (
        ("/lidar", "acme_msgs/msg/Points"),
        ("/arm/joint", TWIST),
        ("/arm/raw", TWIST),
        ("/arm/_secret", TWIST),
        ("/text", STRING),
        ("/twist", TWIST),
        ("/_text", STRING),
        ("/walk/_action/feedback", STRING),
    ):
        node.add_publisher(name, kind)
    await look(harness)
    assert skipped(harness) == {
        ("/lidar", "to_mqtt"): "problem",
        ("/odom", "to_mqtt"): "absent",
        ("/cmd", "to_ros"): "absent",
        ("/arm/raw", "to_mqtt"): "left_out",
        ("/arm/_secret", "to_mqtt"): "hidden",
        ("/_text", "to_mqtt"): "hidden",
        ("/twist", "to_mqtt"): "other_type",
    }
    by_name = {skip.ros: skip for skip in harness.bridge.skips()}
    assert by_name["/arm/raw"].reason == "left out by !/arm/raw"
    assert by_name["/arm/raw"].type == TWIST
    assert "acme_msgs is not installed" in by_name["/lidar"].reason
    assert by_name["/twist"].reason == "the route takes std_msgs/msg/*"
    assert [skip.why for skip in harness.bridge.skips()][:3] == ["problem", "absent", "absent"]
    # They come, and are skipped no longer.
    node.add_publisher("/odom", "nav_msgs/msg/Odometry")
    node.add_subscriber("/cmd", TWIST)
    await look(harness)
    assert not {("/odom", "to_mqtt"), ("/cmd", "to_ros")} & skipped(harness).keys()
    assert told(harness)["count"] == 6  # /cmd is of another type than patterns to MQTT take
    assert told(harness)["by_reason"] == {"problem": 1, "left_out": 1, "hidden": 2, "other_type": 2}
    assert told(harness)["skipped"][0] == {
        "ros": "/lidar",
        "direction": "to_mqtt",
        "type": "acme_msgs/msg/Points",
        "why": "problem",
        "reason": by_name["/lidar"].reason,
    }
    # Another type on a topic that is bridged.
    node.add_publisher("/text", TWIST)
    for _ in range(6):
        await look(harness)
    # Of two types that fit, one is carried.
    node.add_publisher("/arm/joint", STRING)
    for _ in range(6):
        await look(harness)
    assert skipped(harness)["/arm/joint", "to_mqtt"] == "two_types"
    # And other routes.
    harness.bridge.replace([topic("/twist")])
    await look(harness)
    assert skipped(harness) == {}


def action_of(name, kind):
    """The services of an action, and their types."""
    return (
        (f"{name}/_action/send_goal", f"{kind}_SendGoal"),
        (f"{name}/_action/get_result", f"{kind}_GetResult"),
        (f"{name}/_action/cancel_goal", "action_msgs/srv/CancelGoal"),
    )


async def test_what_is_called(harness):
    node = harness.node
    harness.start(
        service(["/absent", "/arm/*", "!/arm/off", "/odd"]),
        service("/**", type="std_srvs/srv/Set*"),
        service("/ask", to="mqtt", type="acme_srvs/srv/Ask"),
        action(["/fly", "/walk*"], type="test_msgs/action/Fib*"),
        parameters(["/ghost/speed", "/node/*", "/mute/*"]),
    )
    for name, kind in (
        ("/arm/grip", TRIGGER),
        ("/arm/off", TRIGGER),
        ("/arm/_grip", TRIGGER),
        ("/odd", "acme_srvs/srv/Odd"),
        ("/trigger", TRIGGER),
        ("/arm/get_parameters", "rcl_interfaces/srv/GetParameters"),
        *action_of("/walk", "test_msgs/action/Fibonacci"),
        *action_of("/walk_far", "test_msgs/action/Far"),
    ):
        node.add_service(name, kind, lambda request, respond: None)
    await look(harness)
    await look(harness)
    assert skipped(harness) == {
        ("/absent", "service"): "absent",
        ("/odd", "service"): "problem",
        ("/arm/off", "service"): "left_out",
        ("/arm/_grip", "service"): "hidden",
        ("/arm/get_parameters", "service"): "of_every_node",
        ("/trigger", "service"): "other_type",
        ("/ask", "provided"): "problem",
        ("/fly", "action"): "absent",
        ("/walk_far", "action"): "other_type",
        ("/ghost", "parameters"): "absent",
        ("/node", "parameters"): "absent",
        ("/mute", "parameters"): "absent",
    }

    def refuse(request, respond):
        pass

    node.add_service("/mute/get_parameters", "rcl_interfaces/srv/GetParameters", refuse)
    await look(harness)  # and no list_parameters
    mute = "/mute", "parameters"
    await until(lambda: skipped(harness).get(mute) == "problem", "it cannot be read")
    harness.bridge.calls.replace(call_routes())
    assert skipped(harness) == {}


async def test_what_is_told_on_mqtt_is_bounded(harness):
    harness.start(service("/arm/*"), topics=[topic(["/**", "!/a/**"])])
    for number in range(MAX_ENTRIES + 50):
        harness.node.add_publisher(f"/a/topic_{number}", STRING)
    await look(harness)
    assert told(harness)["count"] == MAX_ENTRIES + 50
    assert len(told(harness)["skipped"]) == MAX_ENTRIES
    await harness.bridge.stop()
    assert told(harness)["count"] == 0


def entry(number, why="left_out"):
    return {
        "ros": f"/arm/raw_{number}",
        "direction": "to_mqtt",
        "type": STRING,
        "why": why,
        "reason": "left out by !/arm/raw*",
    }


@pytest.mark.parametrize("arguments", [[], ["--all"], ["--json"], ["--json", "--all"]])
def test_the_command(tmp_path, monkeypatch, capsys, arguments):
    (tmp_path / "appliance.yaml").write_text("")
    skips = [entry(1, "problem"), *map(entry, range(2, 33)), entry(40, "of_every_node")]
    monkeypatch.setattr(control, "ask", lambda path, what, **_: skips if what == "skipped" else [])
    with pytest.raises(SystemExit) as ended:
        cli.main(["routes", "-c", str(tmp_path / "appliance.yaml"), *arguments])
    assert ended.value.code == 0
    output = capsys.readouterr().out
    if "--json" in arguments:  # without --all there are those only that programs know
        expected = skips if "--all" in arguments else []
        assert [json.loads(line) for line in output.splitlines()] == expected
        return
    lines = output.splitlines()
    assert lines[:3] == [
        "nothing is bridged now",
        "",
        "skipped: 1 cannot be set up, 31 left out, 1 that every node has",
    ]
    assert lines[3].split() == ["/arm/raw_1", "→", STRING, "left", "out", "by", "!/arm/raw*"]
    if arguments:
        assert len(lines) == 3 + 33
    else:
        assert len(lines) == 3 + 20 + 1
        assert lines[-1] == "and 13 more: appliance routes --all"


def carried(**counts):
    about = {"ros": "/image", "mqtt": "r2/image", "type": "sensor_msgs/msg/Image"}
    zeros = dict.fromkeys(
        ("lost", "dropped", "skipped", "throttled", "errors", "expired", "refused"), 0
    )
    figures = {"rate": 30.0, "size": 1_000_000, "latency_ms": None, "messages": 12}
    return {**about, "direction": "to_mqtt", "encoding": "cdr", **zeros, **figures, **counts}


def test_the_command_says_what_ros_lost_and_what_to_do(tmp_path, monkeypatch, capsys):
    (tmp_path / "appliance.yaml").write_text("")
    told = [carried(lost=88, dropped=3)]
    monkeypatch.setattr(control, "ask", lambda path, what, **_: [] if what == "skipped" else told)
    with pytest.raises(SystemExit):
        cli.main(["routes", "-c", str(tmp_path / "appliance.yaml")])
    head, row, *rest = capsys.readouterr().out.splitlines()
    figures = dict(zip(head.split()[4:], row.split()[5:], strict=False))
    assert (figures["LOST"], figures["DROPPED"]) == ("88", "3")
    assert "appliance fastdds" in rest[-1]
    told[0] = carried(dropped=3)
    with pytest.raises(SystemExit):
        cli.main(["routes", "-c", str(tmp_path / "appliance.yaml")])
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_the_command_says_what_was_wrong_last(tmp_path, monkeypatch, capsys):
    (tmp_path / "appliance.yaml").write_text("")
    told = [carried(direction="to_ros", errors=2, last_error="cannot be converted: not JSON")]
    monkeypatch.setattr(control, "ask", lambda path, what, **_: [] if what == "skipped" else told)
    with pytest.raises(SystemExit):
        cli.main(["routes", "-c", str(tmp_path / "appliance.yaml")])
    lines = capsys.readouterr().out.splitlines()
    assert lines[2:] == ["/image ←  last error: cannot be converted: not JSON"]
