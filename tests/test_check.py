"""`appliance check` finds what would only show when a message comes, and says what was meant."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from appliance import config
from appliance.access import Passwords
from appliance.check import Finding, check
from appliance.init import initialise
from appliance.ros import ros2

TWIST = "geometry_msgs/msg/Twist"


@pytest.fixture
def here(tmp_path: Path) -> Path:
    list(initialise(tmp_path, robot="r2", user="alice"))
    return tmp_path


def found(here: Path, bridge: dict[str, Any] | None = None, **broker: Any) -> list[Finding]:
    said = {
        "robot": "r2",
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
        ({"to": "ros", "type": TWIST, "clamp": {"linear.w": [0, 1]}}, "error", "no field 'w'"),
        ({"to": "ros", "type": TWIST, "allow": {"linear.x": ["a"]}}, "error", "not a number"),
        (
            {"to": "ros", "type": TWIST, "clamp": {"linear.x": [0, 1]}, "allow": {"linear.z": [0]}},
            "",
            "",
        ),
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


def test_without_ros_it_says_what_was_not_looked_at(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros2, "available", lambda: (False, "there is no ROS 2 here"))
    told = found(here, {"topics": [{"ros": "/a", "to": "mqtt", "type": "std_msgs/msg/Strin"}]})
    (finding,) = [each for each in told if each.subject == "bridge"]
    assert finding.level == "warning" and "what routes say was not checked" in finding.text
    assert not [each for each in told if each.subject == "route /a"]


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
    assert "written by alice" in told["/a ← r2/a"].text
    assert "not by bob" in told["/a ← r2/a"].text
    assert told["/b ← r2/b"].level == "warning"
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
