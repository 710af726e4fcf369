"""`appliance status`: the running one is asked, and the answer is about it."""

from __future__ import annotations

import json
import time
from datetime import datetime, timezone
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from appliance_process import ApplianceProcess
from command_line import run
from raw_client import RawClient

from appliance import config
from appliance.app.status import Status, _shortage, problem_of, topic_shown
from appliance.broker.broker import Broker
from appliance.broker.limits import Limits
from appliance.broker.link import InsideLink
from appliance.broker.values import Identity
from appliance.config import reading
from appliance.mqtt.packets import Publish
from appliance.store import MemoryStore


def status(appliance: ApplianceProcess, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert run("status", "--json", "-c", str(appliance.config)) == 0
    told = json.loads(capsys.readouterr().out)
    assert isinstance(told, dict)
    return told


def test_the_running_one_tells_how_it_is(
    appliance: ApplianceProcess, topic: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = status(appliance, capsys)
    with RawClient(appliance, 5) as client:
        client.connect("status-client")
        client.send(*(Publish(topic, b"x", 1, packet_id=number) for number in range(1, 11)))
        client.drain()
        told = status(appliance, capsys)
        assert told["clients"] == before["clients"] + 1
        assert told["messages"]["received"] >= before["messages"]["received"] + 10
    assert told["pid"] == appliance.pid
    assert told["robot"] == "r2d2" and told["configuration"] == str(appliance.config)
    assert 0 <= told["uptime"] < 3600
    since = datetime.fromisoformat(told["since"])
    assert abs((datetime.now(timezone.utc) - since).total_seconds() - told["uptime"]) < 5
    assert told["listeners"] == [
        {"bind": f"127.0.0.1:{appliance.port}", "tls": True, "protocol": "mqtt"},
        {"bind": f"127.0.0.1:{appliance.plain_port}", "tls": False, "protocol": "mqtt"},
    ]
    assert told["store"]["path"] == str(appliance.directory / "state/store.db")
    assert told["store"]["failing"] is False
    assert told["memory"]["process"] > 1 << 20 and told["ros"] == {"bus": "none"}
    ends = {each["what"]: each["days"] for each in told["certificates"]}
    assert 820 <= ends["server"] <= 824 and ends["ca"] > 3600


def test_it_is_told_to_people_too(
    appliance: ApplianceProcess, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("reload", "-c", str(appliance.config)) == 0
    assert run("status", "-c", str(appliance.config)) == 0
    text = capsys.readouterr().out
    for part in (
        f"robot r2d2, pid {appliance.pid}",
        f"listening on  127.0.0.1:{appliance.port} (TLS)",
        "ROS           off: a broker alone",
        "last reload   ",
        "nothing has changed",
        "certificates  the server's certificate: 82",
    ):
        assert part in text


def test_when_none_is_running(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "appliance.yaml"
    file.write_text("robot: r2")
    assert run("status", "-c", str(file)) == 1
    assert "no appliance is running (nobody listens on " in capsys.readouterr().err
    file.write_text("robbot: r2")
    assert run("status", "-c", str(file)) == 1
    assert "did you mean" in capsys.readouterr().err


def test_a_file_that_was_broken_since_is_no_reason_not_to_ask(
    appliance: ApplianceProcess, capsys: pytest.CaptureFixture[str]
) -> None:
    good = appliance.config.read_text()
    try:
        appliance.config.write_text(f"{good}\nrobbot: r2\n")
        assert run("reload", "-c", str(appliance.config)) == 1
        told = status(appliance, capsys)
    finally:
        appliance.config.write_text(good)
    assert told["pid"] == appliance.pid
    assert any("robbot" in warning for warning in told["warnings"])


def test_the_control_of_a_broken_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as that of the service, whose control is not beside its configuration."""
    file = tmp_path / "appliance.yaml"
    for text in ("control: run/c.sock\nrobbot: r2\n", "robot: [\ncontrol: run/c.sock # here\n"):
        file.write_text(text)
        assert config.load_control(file).control == tmp_path / "run/c.sock"
    for text in ("control: [\n", "robbot: r2\n", "\0"):
        file.write_text(text)
        assert config.load_control(file).control == tmp_path / "state/control.sock"
    file.write_text("robbot: r2\n")
    monkeypatch.setattr(reading, "SEARCH_PATH", (tmp_path / "none.yaml", file))
    assert config.load_control().file == file
    assert config.load_control(tmp_path / "no/none.yaml").file == tmp_path / "no/none.yaml"


@pytest.mark.parametrize(
    ("names", "template", "shown"),
    [
        (["/odom"], "r2{ros}", "r2/odom"),
        (["/odom"], "elsewhere/odom", "elsewhere/odom"),
        (["/camera/**", "!/camera/raw"], "r2{ros}", "r2/camera/**"),
        (["/a", "/b"], "r2{ros}", "r2/a, r2/b"),
        (["/controller/*", "/controller/p"], "r2{node}/_param", "r2/controller/_param"),
    ],
)
def test_a_route_is_shown_with_its_topic(names: list[str], template: str, shown: str) -> None:
    assert topic_shown(names, template) == shown


def test_what_ros_routes_carry_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    flows = [
        SimpleNamespace(
            bridged=SimpleNamespace(direction=direction), meter=SimpleNamespace(rates=[rate, 0.0])
        )
        for direction, rate in (("to_mqtt", 10.0), ("to_mqtt", 2.5), ("to_ros", 20.0))
    ]
    flows.append(SimpleNamespace(bridged=None))  # there is no such topic now
    bridge = SimpleNamespace(flows=lambda: flows)
    asked = SimpleNamespace(_parts=SimpleNamespace(bridge=bridge))
    rates = Status._ros_rates(asked)  # type: ignore[arg-type]
    assert rates == {"from_ros_a_second": 12.5, "to_ros_a_second": 20.0}
    asked._parts.bridge = None
    assert set(Status._ros_rates(asked).values()) == {0.0}  # type: ignore[arg-type]


def test_an_error_of_long_ago_is_no_problem_of_a_route() -> None:
    def problem(ago: float) -> str | None:
        counted = {"errors": 1, "last_error": "bad_request", "lost": 0, "dropped": 0}
        at = time.monotonic() - ago
        return problem_of(SimpleNamespace(topics=("a",), last_error_at=at, **counted))  # type: ignore[arg-type]

    told = "messages that could not be carried: 1 (the last 5 min ago: bad_request)"
    assert problem(300) == told
    assert problem(601) is None


def test_who_has_most_is_told_when_little_is_left() -> None:
    class Access:
        epoch = 0

        def decide(self, *args: object) -> None:
            raise AssertionError("nobody asks")

    broker = Broker(Access(), MemoryStore(), Limits(sessions=10))  # type: ignore[arg-type]
    asked = SimpleNamespace(_parts=SimpleNamespace(broker=broker))

    def come(user: str, number: int) -> None:
        who = Identity(user, f"{user}-{number}")
        broker.connect(InsideLink(), who, clean_start=True, expiry=60, will=None)

    come("alice", 0)
    for number in range(6):
        come("mallory", number)
    assert not list(Status._short(asked))  # type: ignore[arg-type]
    for number in range(4):
        come(f"user-{number}", 0)
    (short,) = Status._short(asked)  # type: ignore[arg-type]
    assert _shortage(short) == (
        "10 of 10 sessions in use (broker.limits.sessions), most of it: "
        "user 'mallory' 5, user 'alice' 1, user 'user-0' 1"
    )
