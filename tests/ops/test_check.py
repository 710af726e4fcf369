"""`appliance check` finds what would only show when a message comes, and says what was meant."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

from appliance import config
from appliance.access import Passwords
from appliance.ops.check import Finding, check
from appliance.ops.check.commands import commands
from appliance.ops.init import initialise
from appliance.ros.ros2 import node as ros2

TWIST = "geometry_msgs/msg/Twist"
VECTOR = "geometry_msgs/msg/Vector3"


@pytest.fixture
def here(tmp_path: Path) -> Path:
    list(initialise(tmp_path, robot="r2", user="alice"))
    return tmp_path


def found(
    here: Path,
    bridge: dict[str, Any] | None = None,
    upstreams: Sequence[dict[str, Any]] = (),
    **broker: Any,
) -> list[Finding]:
    said = {
        "robot": "r2",
        "upstreams": [*upstreams],
        "broker": broker,
        "bridge": {"discovery": "localhost", **(bridge or {})},
    }
    (here / "appliance.yaml").write_text(yaml.safe_dump(said))
    before = {path: path.read_bytes() for path in here.rglob("*") if path.is_file()}
    told = list(check(config.load(here / "appliance.yaml")))
    after = {path: path.read_bytes() for path in here.rglob("*") if path.is_file()}
    assert after == before, "check changes nothing"
    return told


@pytest.mark.parametrize(
    ("route", "level", "text"),
    [
        ({"type": "std_msgs/msg/Strin"}, "error", "did you mean std_msgs/msg/String?"),
        ({"type": "std_msg/msg/String"}, "warning", "did you mean std_msgs/msg/String?"),
        ({"type": "acme_msgs/msg/Thing"}, "warning", "acme_msgs is not installed here"),
        ({"type": TWIST, "fields": ["liner.x"]}, "error", "there are linear, angular"),
        ({"type": TWIST, "encoding": "text"}, "error", "cannot go as text"),
        ({"type": TWIST, "encoding": "cdr"}, "", ""),
        (
            {"to": "ros", "type": TWIST, "on_silence": {"after": "1 s", "publish": {"liner": {}}}},
            "error",
            "on_silence.publish: liner: unknown field; did you mean 'linear'?",
        ),
        ({"to": "ros", "type": VECTOR, "clamp": {"w": [0, 1]}}, "error", "no field 'w'"),
        ({"to": "ros", "type": VECTOR, "allow": {"x": ["a"]}}, "error", "not a number"),
        ({"to": "ros", "type": VECTOR, "clamp": {"x": [0, 1]}, "allow": {"z": [0]}}, "", ""),
    ],
)
def test_routes(here: Path, route: dict[str, Any], level: str, text: str) -> None:
    pytest.importorskip("rclpy")
    told = found(here, {"topics": [{"ros": "/a", "to": "mqtt", **route}]})
    findings = [each for each in told if each.subject == "route /a"]
    assert [each.level for each in findings] == ([level] if level else [])
    assert all(text in each.text for each in findings), findings


def test_what_the_environment_says_against_the_configuration(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rclpy")
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "RMW_IMPLEMENTATION"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("FASTDDS_DEFAULT_PROFILES_FILE", "/mine.xml")
    told = [each for each in found(here) if each.subject == "bridge.discovery"]
    assert [each.level for each in told] == ["warning", "ok"]
    assert "FASTDDS_DEFAULT_PROFILES_FILE=/mine.xml is not heeded" in told[0].text


@pytest.mark.parametrize(
    ("section", "route", "text"),
    [
        ("services", {"type": "std_srvs/srv/SetBol"}, "did you mean std_srvs/srv/SetBool?"),
        ("services", {"type": "std_srvs/srv/SetBool"}, ""),
        (
            "services",
            {"to": "mqtt", "type": "std_srvs/srv/SetBool", "on_error": {"sucess": False}},
            "on_error: sucess: unknown field; did you mean 'success'?",
        ),
        ("actions", {"type": "test_msgs/action/Fibonaci"}, "mean test_msgs/action/Fibonacci?"),
        ("actions", {"type": "test_msgs/action/Fibonacci"}, ""),
    ],
)
def test_calls(here: Path, section: str, route: dict[str, Any], text: str) -> None:
    pytest.importorskip("rclpy")
    told = found(here, {section: [{"ros": "/a", **route}]})
    findings = [each for each in told if each.subject == "route /a"]
    assert [each.level for each in findings] == (["error"] if text else [])
    assert all(text in each.text and "_Request" not in each.text for each in findings), findings


def test_without_ros_it_says_what_was_not_checked(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros2, "available", lambda: (False, "there is no ROS 2 here"))
    told = found(here, {"topics": [{"ros": "/a", "to": "mqtt", "type": "std_msgs/msg/Strin"}]})
    (finding,) = [each for each in told if each.subject == "bridge"]
    assert finding.level == "warning" and "what routes say was not checked" in finding.text
    assert not [each for each in told if each.subject == "route /a"]


def test_all_mistakes_of_a_route_are_told(here: Path) -> None:
    pytest.importorskip("rclpy")
    route = {
        "ros": "/a",
        "to": "ros",
        "type": TWIST,
        "encoding": "text",
        "clamp": {"linear.w": [0, 1], "angular.z": [0, 1]},
        "allow": {"linear.v": [0]},
        "on_silence": {"after": "1 s", "publish": {"liner": {}}},
    }
    told = found(here, {"topics": [route]})
    texts = [each.text for each in told if each.subject == "route /a" and each.level == "error"]
    assert len(texts) == 4, texts
    for text, part in zip(texts, ("as text", "'w'", "'v'", "'linear'?"), strict=True):
        assert part in text
    route = {"ros": "/a", "to": "mqtt", "type": TWIST, "fields": ["liner.x", "linear.w"]}
    told = found(here, {"topics": [route]})
    assert len([each for each in told if each.subject == "route /a"]) == 2


SAFE = {"expire": "500 ms", "on_silence": {"after": "500 ms"}}


@pytest.mark.parametrize("stamped", [False, True], ids=["AckermannDrive", "AckermannDriveStamped"])
@pytest.mark.parametrize(
    ("stop", "drives"),
    [
        ({}, False),
        ({"speed": 0, "acceleration": 2.0}, False),
        ({"speed": 0.0, "steering_angle": 0.2, "jerk": 1.0}, False),
        ({"speed": 0.1}, True),
        ({"speed": -1, "acceleration": 2.0}, True),
    ],
)
def test_the_stop_of_a_robot_that_steers(
    stop: dict[str, float], drives: bool, stamped: bool
) -> None:
    """It may brake as hard as it is told to, with its wheels where they are."""
    route = {
        "ros": "/a",
        "to": "ros",
        "type": "ackermann_msgs/msg/AckermannDrive" + ("Stamped" if stamped else ""),
        "expire": "500 ms",
        "on_silence": {"after": "500 ms", "publish": {"drive": stop} if stamped else stop},
    }
    settings = config.Settings.model_validate({"bridge": {"topics": [route]}})
    findings = list(commands(settings))
    assert [each.level for each in findings] == (["error"] if drives else []), findings


@pytest.mark.parametrize("bus", ["ros2", "ros1"])
@pytest.mark.parametrize(
    ("route", "level", "text"),
    [
        (SAFE, "", ""),
        ({"on_silence": {"after": "500 ms"}}, "", ""),
        ({"expire": "500 ms"}, "warning", "add: on_silence: {after: 500 ms}"),
        ({"ros": "/arm/cmd_vel", "type": None, "expire": "1 s"}, "warning", "add: on_silence"),
        ({"type": "std_msgs/msg/String"}, "", ""),
        ({"to": "mqtt"}, "", ""),
        ({**SAFE, "on_silence": {"after": "5 min"}}, "warning", "may drive on for 300 s"),
        ({**SAFE, "expire": "5 min"}, "warning", "may drive on for 300 s"),
        ({**SAFE, "lease": "2 s"}, "warning", "no effect without exclusive: true"),
        ({**SAFE, "lease": "2 s", "exclusive": True}, "", ""),
        (
            {**SAFE, "on_silence": {"after": "1 s", "publish": {"linear": {"x": 0.1}}}},
            "error",
            "this stop message drives",
        ),
        ({**SAFE, "on_silence": {"after": "1 s", "publish": {"linear": {"x": 0.0}}}}, "", ""),
        (
            {
                **SAFE,
                "ros": "/cmd_vel",
                "type": None,
                "on_silence": {"after": "1 s", "publish": {"mode": 1}},
            },
            "warning",
            "this stop message drives",
        ),
        (
            {
                **SAFE,
                "ros": "/cmd_vel",
                "type": None,
                "on_silence": {"after": "1 s", "publish": {"linear": {"x": 0.1}}},
            },
            "error",
            "this stop message drives",
        ),
        (
            {
                "type": "std_msgs/msg/Float64",
                "on_silence": {"after": "1 s", "publish": {"data": 1}},
            },
            "",
            "",
        ),
    ],
)
def test_what_lets_a_robot_drive_on(
    here: Path, bus: str, route: dict[str, Any], level: str, text: str
) -> None:
    said = {"ros": "/a", "to": "ros", "type": TWIST, **route}
    said = {key: value for key, value in said.items() if value is not None}
    told = found(here, {"bus": bus, "topics": [said]})
    findings = [each for each in told if each.subject == f"route {said['ros']}"]
    findings = [each for each in findings if each.level != "ok"]
    assert [each.level for each in findings] == ([level] if level else []), findings
    assert all(text in each.text for each in findings), findings


def test_a_route_that_drives_and_has_no_rules(here: Path) -> None:
    told = found(here, {"topics": [{"ros": "/a", "to": "ros", "type": TWIST}]})
    texts = [each.text for each in told if each.subject == "route /a"]
    assert len(texts) == 2 and "add: on_silence" in texts[0] and "add: expire" in texts[1]


@pytest.mark.parametrize(
    ("limit", "is_told"),
    [
        ({"allow": {"linear.x": [0.5]}}, True),
        ({"allow": {"linear.x": [0, 0.5]}}, False),
        ({"clamp": {"linear.x": [0.2, 0.5]}}, True),
        ({"clamp": {"linear.x": [-0.2, 0.5]}}, False),
    ],
)
def test_limits_that_exclude_the_stop_message(
    here: Path, limit: dict[str, Any], is_told: bool
) -> None:
    pytest.importorskip("rclpy")
    told = found(here, {"topics": [{"ros": "/a", "to": "ros", "type": TWIST, **SAFE, **limit}]})
    findings = [each for each in told if each.subject == "route /a"]
    assert [each.level for each in findings] == ["warning"] * is_told, findings
    assert all("against the route's own stop message" in each.text for each in findings)


def test_rules_for_nobody(here: Path) -> None:
    (here / "acl.conf").write_text("user alice\ntopic read a\nuser bob\ntopic read a\ntopic b\n")
    (finding,) = [each for each in found(here) if "no user" in each.text]
    assert finding.subject == "acl.conf:4" and "'bob'" in finding.text
    assert finding.text.endswith("remove them, or: appliance user add bob")


def test_rules_that_name_nothing(here: Path) -> None:
    (here / "acl.conf").write_text(
        "user alice\n"
        "topic read {robto}/x\n"
        "topic read r2/%c/x\n"
        "pattern read r2/%z\n"
        "pattern read r2/%c/%u/100%\n"
        "topic read {robot}/x\n"
    )
    told = {each.subject: each for each in found(here) if each.subject.startswith("acl.conf:")}
    assert sorted(told) == ["acl.conf:2", "acl.conf:3", "acl.conf:4"]
    assert "'{robto}' stands for nothing, only {robot} does" in told["acl.conf:2"].text
    assert "`pattern` lines only" in told["acl.conf:3"].text
    assert "'%z' stands for nothing" in told["acl.conf:4"].text


def test_who_may_command(here: Path) -> None:
    users = Passwords.load(here / "users.passwd")
    users.set("bob", "a long password")
    users.save()
    (here / "acl.conf").write_text("user alice\ntopic write {robot}/a\n")
    topics = [{"ros": name, "to": "ros", "type": TWIST} for name in ("/a", "/b")]
    topics.append({"ros": "/c", "to": "mqtt"})
    told = {each.subject: each for each in found(here, {"topics": topics})}
    assert told["/a ← r2/a"].level == "ok"
    assert told["/a ← r2/a"].text == (
        "alice may send to it; bob may not. To let bob send to it, add to acl.conf below the line "
        "`user bob`: topic write {robot}/a"
    )
    assert told["/b ← r2/b"].level == "warning"
    assert "no user may send to it. To let alice send to it, add" in told["/b ← r2/b"].text
    assert told["/b ← r2/b"].text.endswith("topic write {robot}/b")
    assert not [subject for subject in told if "r2/c" in subject]
    # The line that it names does it.
    (here / "acl.conf").write_text("user alice\ntopic write {robot}/a\ntopic write {robot}/b\n")
    told = {each.subject: each for each in found(here, {"topics": topics})}
    assert told["/b ← r2/b"].level == "ok"


@pytest.mark.parametrize(
    ("plugin", "settings", "level", "text"),
    [
        ("http.UserAuthHttpPlugin", {"request_metod": "get"}, "error", "'request_method'?"),
        (
            "http.UserAuthHttpPlugin",
            {"host": "h", "port": "hunter2", "user_uri": "/u"},
            "error",
            "port",
        ),
        ("http.UserAuthHttpPlugin", {"host": "h", "port": 80, "user_uri": "/u"}, "ok", "takes"),
        ("http.NoSuch", {}, "error", "NoSuch"),
    ],
)
def test_plugins_settings(
    here: Path, plugin: str, settings: dict[str, Any], level: str, text: str
) -> None:
    pytest.importorskip("aiohttp")
    name = f"amqtt.contrib.{plugin}"
    (finding,) = [
        each for each in found(here, plugins={name: settings}) if each.subject == f"plugin {name}"
    ]
    assert finding.level == level
    assert text in finding.text and "hunter2" not in finding.text


def test_what_a_listener_for_websocket_is_for(here: Path) -> None:
    listeners = [{"bind": "127.0.0.1:8080", "protocol": "websocket"}, {"bind": "127.0.0.1:1883"}]
    told = [each for each in found(here, listeners=listeners) if "WebSocket" in each.text]
    assert [each.subject for each in told] == ["listener 127.0.0.1:8080"]
    assert "ws://HOST:PORT/mqtt" in told[0].text and "plain MQTT is refused" in told[0].text


def test_what_a_listener_for_the_web_is_for(here: Path) -> None:
    listeners = [{"bind": "127.0.0.1:8080", "protocol": "web"}, {"bind": "127.0.0.1:1883"}]
    told = [each for each in found(here, listeners=listeners) if "for the web" in each.text]
    assert [each.subject for each in told] == ["listener 127.0.0.1:8080"]
    assert "http://HOST:PORT/" in told[0].text


def test_who_may_read_what_home_assistant_is_told(here: Path) -> None:
    line = "topic read homeassistant/#"
    (nobody,) = [each for each in found(here, {"home_assistant": True}) if line in each.text]
    assert (nobody.level, nobody.subject) == ("warning", "bridge.home_assistant")
    rules = here / "acl.conf"
    rules.write_text(rules.read_text().replace("user alice\n", f"user alice\n{line}\n", 1))
    (may,) = [
        each
        for each in found(here, {"home_assistant": True})
        if each.subject == "bridge.home_assistant"
    ]
    assert (may.level, may.text) == ("ok", "alice may read of homeassistant/#")
    assert "homeassistant" not in str(found(here))


def test_a_link_may_read_what_home_assistant_is_told(here: Path) -> None:
    """Where Home Assistant has a broker of its own, nobody here reads it but the link's user."""
    (here / "acl.conf").write_text("user link\ntopic read homeassistant/sensor/#\n")
    link = {"name": "home", "servers": ["mqtts://home"], "user": "link", "prefix": "r2/"}
    told = found(here, {"home_assistant": True}, upstreams=[link])
    assert [each.text for each in told if each.subject == "bridge.home_assistant"] == [
        "link may read of homeassistant/#"
    ]
