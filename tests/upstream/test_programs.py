"""`python tests/upstream` finds what mosquitto's bridge loses, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from waiting import PATIENCE

from appliance.mqtt.packets import Packet, Publish
from upstream import __main__ as program
from upstream import calls, fake_fleet, hostile_fleet, kills, late_commands, outage, reconnects
from upstream.calls import Calls
from upstream.device import count
from upstream.fake_fleet import Visit
from upstream.hostile_fleet import EVENTS, HostileFleet
from upstream.kills import Kills
from upstream.late_commands import LateCommands
from upstream.outage import Outage
from upstream.reconnects import Reconnects


def test_a_line_that_is_cut_loses_nothing_with_the_bridge_of_3_1_1(tmp_path: Path) -> None:
    report = Kills(tmp_path, 1, device="mosquitto311", victims="nobody").run(2)
    assert not report.problems, "\n".join(report.problems)
    assert report.cuts == 2 and report.acknowledged > 50


def test_kills_that_lose_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """mosquitto acknowledges before it has stored."""
    monkeypatch.setattr(kills, "STALLED", 2.5)
    report = Kills(tmp_path, 1, device="mosquitto311").run(4)
    assert any("LOST" in each for each in report.problems), report
    assert report.kills == 4


def test_an_outage_that_drops_the_newest_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outage, "STALLED", 4.0)
    report = Outage(tmp_path, device="mosquitto", messages=3000, queue=100).run()
    # It keeps the oldest, if it is back by now.
    assert report.problems[0].startswith("fleet/r2d2/events/flood: "), report.problems[0]
    assert any("state/" in each for each in report.problems), "all of a topic are not the latest"


def test_late_commands_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(late_commands, "OFFLINE", 100)
    monkeypatch.setattr(late_commands, "STEADY", 0.5)
    monkeypatch.setattr(late_commands, "SETTLING", 0.5)
    report = LateCommands(tmp_path, device="mosquitto311", silence=1.5, rounds=1).run()
    assert "LATE" in report.problems[0] and "while the link was away CAME" in report.problems[1]


def test_calls_without_an_answer_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calls, "PATIENCE", 2.0)
    report = Calls(tmp_path, device="mosquitto311", count=10, others=0).run()
    assert report.calls == 10 and "UNANSWERED" in report.problems[0]


def test_links_that_take_too_long_to_come_back_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reconnects, "LIMIT", -1.0)
    report = Reconnects(tmp_path, links=5, rounds=1, fleet="mosquitto").run()
    assert ["5 links are online" in each for each in report.problems] == [True, True], report


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """No misdeed takes long."""
    known = hostile_fleet.SCENARIOS
    brief = {name: each for name, each in known.items() if not each.slow}
    monkeypatch.setattr(hostile_fleet, "SCENARIOS", brief)


@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize(("seed", "puts_off"), [(1, True), (2, False)])
def test_a_broker_that_does_anything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int, puts_off: bool
) -> None:
    """A few seconds of it; `python tests/upstream --hostile 5` for minutes, and for pings."""
    monkeypatch.setattr(hostile_fleet, "ANSWERED", PATIENCE)
    report = HostileFleet(tmp_path, seed, seconds=6.0).run()
    assert report.puts_off == puts_off
    assert not report.problems, f"{report}\n" + "\n".join(report.problems)
    assert report.steps > 1 and report.connections > 2
    assert report.acknowledged > 50 and report.received >= report.acknowledged


@pytest.mark.usefixtures("brief")
def test_what_a_broker_loses_and_a_ping_that_waits_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hostile_fleet, "ANSWERED", 0.0)
    monkeypatch.setitem(fake_fleet._HANDLERS, Publish, lose_some(Visit.on_publish))
    report = HostileFleet(tmp_path, 1, seconds=2.0).run()
    assert any("a local ping took" in each for each in report.problems)
    assert any("LOST" in each for each in report.problems), report


def lose_some(
    take: Callable[[Visit, Publish], None],
) -> Callable[[Visit, Packet], None]:
    """The broker acknowledges every tenth message, and forgets it."""

    def taken(visit: Visit, packet: Packet) -> None:
        assert isinstance(packet, Publish)
        take(visit, packet)
        if packet.topic == EVENTS and int(packet.payload.split()[0]) % 10 == 0:
            visit.fleet.published.remove(packet)
            if packet.packet_id in visit.unacknowledged:
                visit.acknowledge(packet.packet_id)

    return taken


def test_the_command_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for arguments in (
        ["--kills", "2"],
        ["--outage"],
        ["--late"],
        ["--calls", "5"],
        ["--hostile", "1"],
    ):
        assert program.program(program.parse(arguments), tmp_path / arguments[0], print)
    with pytest.raises(SystemExit):
        program.parse([])
    with pytest.raises(SystemExit):
        program.parse(["--help"])
    assert "--outage" in capsys.readouterr().out


def test_what_a_status_counts() -> None:
    assert count(None, "dropped") is None
    assert count({"dropped": 3}, "dropped") == 3
    assert (
        count({"dropped": {"events/#": 2, "state/#": {"messages": 5, "bytes": 70}}}, "dropped") == 7
    )
