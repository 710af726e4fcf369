"""The comparison: which mosquitto it takes, rounds, medians and spread, goals, the report."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance import bench
from appliance.bench import command, peers, report
from appliance.bench.cells import BROKER, CELLS, Cell, Side
from appliance.bench.comparison import OURS, Row, compare, median, newest, row_of, run_round, turn
from appliance.bench.growth import GrowthCell, GrowthRow, Statement
from appliance.bench.load import Result
from appliance.bench.peers import Peer, PeerError, Site, find_peer, find_peers

MOSQUITTO = shutil.which("mosquitto") or shutil.which("/usr/sbin/mosquitto")
needs_mosquitto = pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")
OLDER = Peer("/old", (2, 0, 11), "mosquitto 2.0.11")
NEWER = Peer("/new", (2, 1, 2), "mosquitto 2.1.2")


def program(path: Path, text: str, mode: int = 0o755) -> str:
    path.write_text(text)
    path.chmod(mode)
    return str(path)


def pretended(path: Path, version: str) -> str:
    """The installed mosquitto, which says that it is another version."""
    script = f'[ "$1" = -h ] && echo "mosquitto version {version}" && exit\nexec {MOSQUITTO} "$@"\n'
    return program(path, f"#!/bin/sh\n{script}")


# Which mosquitto


def test_a_peer_is_named_by_its_version(tmp_path: Path) -> None:
    plain = program(tmp_path / "a", "#!/bin/sh\necho 'mosquitto version 2.1.2'\n")
    candidate = program(tmp_path / "b", "#!/bin/sh\necho\necho 'mosquitto version 2.2.0rc1'\n")
    assert find_peer(plain) == Peer(plain, (2, 1, 2), "mosquitto 2.1.2")
    assert find_peer(candidate) == Peer(candidate, (2, 2, 0), "mosquitto 2.2.0rc1")
    other = program(tmp_path / "c", "#!/bin/sh\necho 'mosquitto version 2.1.2'\n")
    names = [each.name for each in find_peers([plain, candidate, other])]
    assert names == [
        f"mosquitto 2.1.2 ({plain})",
        "mosquitto 2.2.0rc1",
        f"mosquitto 2.1.2 ({other})",
    ]


def test_a_peer_is_found_by_its_name_in_the_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program(tmp_path / "mosquitto-new", "#!/bin/sh\necho 'mosquitto version 2.1.2'\n")
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    assert find_peer("mosquitto-new").command == str(tmp_path / "mosquitto-new")


@pytest.mark.parametrize(
    ("text", "mode", "told"),
    [
        (None, 0, "/mosquitto is not there"),
        ("", 0o644, "/mosquitto is not executable: chmod +x it, or name the program itself"),
        ("\x7fELF\0", 0o755, "/mosquitto cannot be run: Exec format error"),
        (
            "#!/bin/sh\necho usage: cat >&2\nexit 1\n",
            0o755,
            "/mosquitto is not mosquitto, or does not start: asked with -h for its version it"
            " answers: usage: cat",
        ),
        ("#!/bin/sh\n", 0o755, "it answers: nothing"),
        (
            "#!/bin/sh\necho mosquitto version 1.6.12\n",
            0o755,
            "/mosquitto is mosquitto 1.6.12, which is too old: it does not know the passwords of"
            " 2.0; name one of 2.0 or later",
        ),
        ("#!/bin/sh\nexec sleep 60\n", 0o755, "does not answer -h within 0.5 s: is it mosquitto?"),
    ],
)
def test_what_is_wrong_with_a_peer_is_told(
    text: str | None, mode: int, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if text is not None and "sleep" in text:  # what answers at all may take longer
        monkeypatch.setattr(peers, "STOP_SECONDS", 0.5)
    path = tmp_path / "mosquitto"
    if text is not None:
        program(path, text, mode)
    with pytest.raises(PeerError) as caught:
        find_peer(str(path))
    assert str(caught.value).endswith(told)
    assert str(path) in str(caught.value)


def test_a_directory_a_file_of_this_folder_and_what_is_given_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(PeerError, match="is a directory: name the program in it"):
        find_peer(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    path = program(tmp_path / "mosquitto-x", "#!/bin/sh\necho mosquitto version 2.1.2\n")
    with pytest.raises(PeerError, match=r"mosquitto-x is not among.*needs \./ before it"):
        find_peer("mosquitto-x")
    with pytest.raises(PeerError, match="is given twice"):
        find_peers([path, "./mosquitto-x"])
    assert find_peer("./mosquitto-x").version == (2, 1, 2)


def test_a_wrong_peer_ends_the_command(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    old = program(tmp_path / "old", "#!/bin/sh\necho mosquitto version 1.5\n")
    assert bench.main(["qos0-pair"], 0.2, [old], False) == 2
    captured = capsys.readouterr()
    assert "too old" in captured.err.replace("\n", " ") and captured.out == ""


@needs_mosquitto
def test_a_broker_that_ends_is_told_with_its_last_words_and_is_left_out_then(
    tmp_path: Path,
) -> None:
    broken = Peer(
        program(tmp_path / "m", "#!/bin/sh\necho out of order >&2\nexit 3\n"), (2, 1, 2), "new"
    )
    assert MOSQUITTO is not None
    row = compare(CELLS[0], [broken, find_peer(MOSQUITTO)], 0.2, rounds=2)
    assert row.problem == "new does not start; new ended with 3: out of order"
    assert {name: len(runs) for name, runs in row.runs.items()} == {
        OURS: 2,
        find_peer(MOSQUITTO).name: 2,
    }
    assert row.met is None, "the goals are about the newer one"


# Rounds, medians, goals


@dataclasses.dataclass(frozen=True, slots=True)
class FakeSide:
    """A broker of which the next figure is taken from a list."""

    name: str
    figures: list[float]
    order: list[str]

    def measure(self, seconds: float) -> Result:
        self.order.append(self.name)
        return Result("c", False, seconds, messages=100, cpu_us=self.figures.pop(0))


@dataclasses.dataclass(frozen=True, slots=True)
class FakeCell(Cell):
    """Brokers that are not started."""

    figures: dict[str, list[float]] = dataclasses.field(default_factory=dict, kw_only=True)
    order: list[str] = dataclasses.field(default_factory=list, kw_only=True)

    @contextlib.contextmanager
    def ours(self, site: Site) -> Iterator[Side]:
        yield FakeSide(OURS, self.figures[OURS], self.order)

    @contextlib.contextmanager
    def peer(self, site: Site, peer: Peer) -> Iterator[Side]:
        yield FakeSide(peer.name, self.figures[peer.name], self.order)


def fake(goal: float = 2.0) -> FakeCell:
    figures = {OURS: [4.0, 2.0, 3.0], OLDER.name: [9.0, 8.0, 7.0], NEWER.name: [5.0, 4.0, 6.0]}
    return FakeCell("c", "a cell", {"cpu_us": goal}, figures=figures)


def test_each_round_measures_every_broker_once_and_another_one_begins() -> None:
    cell = fake()
    row = compare(cell, [OLDER, NEWER], 1.0)
    one, two, three = OURS, OLDER.name, NEWER.name
    assert cell.order == [one, two, three, two, three, one, three, one, two]
    assert turn([], 3) == []
    assert row.ours == Result("c", False, 1.0, messages=100, cpu_us=3.0)
    assert row.spread(OURS, "cpu_us") == (2.0, 4.0)
    assert row.spread(OLDER.name, "cpu_us") == (7.0, 9.0)
    assert row.spread(OURS, "rate") is None
    assert row.spread("nobody", "cpu_us") is None


def test_each_peer_has_a_ratio_and_the_goals_are_about_the_newest() -> None:
    row = compare(fake(), [NEWER, OLDER], 1.0)
    assert row.against == NEWER.name and newest([NEWER, OLDER]) == NEWER
    assert row.ratio("cpu_us", OLDER.name) == pytest.approx(8.0 / 3.0)
    assert row.ratio("cpu_us") == row.ratio("cpu_us", NEWER.name) == pytest.approx(5.0 / 3.0)
    assert row.met is False, "8 / 3 would do, and is the older one's"
    assert compare(fake(1.6), [OLDER, NEWER], 1.0).met is True


def test_what_is_measured_in_mosquittos_place_runs_once_and_what_needs_one_round_has_one() -> None:
    class Other(FakeCell):
        other = "rclpy"

    cell = Other("c", "a cell", {"cpu_us": 1.0}, figures={OURS: [2.0], NEWER.name: [3.0]})
    row = compare(cell, [OLDER, NEWER], 1.0, rounds=1)
    assert row.against == "rclpy" and row.ratio("cpu_us") == 1.5
    assert list(row.runs) == [OURS, "rclpy"]
    memory = FakeCell("m", "memory", {"memory_kib": 1.0}, figures={OURS: [1.0]})
    row = row_of(memory, [])
    for number in range(3):
        run_round(row, [], 1.0, number)
    assert len(row.runs[OURS]) == 1


def pair(cell: Cell, ours: Result | None, peer: Result | None = None) -> Row:
    runs = {OURS: [ours] if ours else [], NEWER.name: [peer] if peer else []}
    return Row(cell, NEWER.name, {name: each for name, each in runs.items() if each})


def test_ratios_and_goals() -> None:
    cell = Cell("c", "a cell", {"cpu_us": 1.5})
    ours, peer = Result("c", False, 1.0, cpu_us=2.0), Result("c", False, 1.0, cpu_us=3.0)
    assert pair(cell, ours, peer).ratio("cpu_us") == 1.5
    assert pair(cell, ours, peer).met is True
    assert pair(cell, peer, peer).met is False
    assert pair(cell, ours).met is None
    assert Row(cell).met is None


def test_goals_of_our_own_figures() -> None:
    cell = Cell("c", "a cell", {"rate": 1.0}, at_least={"rate": 9.0}, at_most={"p99_us": 5.0})
    ours = Result("c", False, 1.0, rate=9.0, p99_us=5.0)
    peer = dataclasses.replace(ours, rate=8.0)
    assert pair(cell, ours, peer).met is True
    assert pair(cell, ours).met is None
    assert pair(cell, ours, dataclasses.replace(peer, rate=9.1)).meets("rate") is False
    assert pair(cell, dataclasses.replace(ours, rate=8.9), peer).meets("rate") is False
    assert pair(cell, dataclasses.replace(ours, p99_us=5.1), peer).meets("p99_us") is False
    assert pair(cell, dataclasses.replace(ours, p99_us=None), peer).met is None
    assert pair(cell, ours, peer).meets("p50_us") is None
    assert report.goals(cell, "rate") == "≥ 1, appliance ≥ 9.0"
    assert report.goals(cell, "p99_us") == "appliance ≤ 5.0"


def test_what_is_reached_is_at_most_the_goal() -> None:
    statements = (Statement("a", "a", "ms", 50.0), Statement("b", "b"), Statement("c", "c", "", 0))
    cell = GrowthCell("g", "a cell", 7, statements)
    assert GrowthRow(cell, {"a": 50.0, "b": 1e9, "c": 0}).reached is True
    assert GrowthRow(cell, {"a": 50.1, "b": 1.0, "c": 0}).reached is False
    assert GrowthRow(cell, {"a": 1.0, "b": 1.0, "c": 1}).reached is False
    assert GrowthRow(cell, {"a": 1.0}).reached is None
    assert GrowthRow(cell).reached is None


def test_medians_but_every_loss() -> None:
    runs = [Result("c", True, 1.0, lost=1, cpu_us=cpu, memory_kib=None) for cpu in (9.0, 1.0, 2.0)]
    assert median(runs) == Result("c", True, 1.0, lost=3, cpu_us=2.0)


# The table of the broker


def test_the_table_of_the_broker_has_the_goals_against_mosquitto_2_1() -> None:
    goals = {cell.name: cell.goals for cell in BROKER}
    assert bench.broker_cells() == list(goals)
    assert all(list(each) == ["cpu_us"] for each in goals.values())
    assert {name: each["cpu_us"] for name, each in goals.items()} == {
        "qos0-pair": 1.0,
        "qos0-pipelined": 2.0,
        "qos1-inflight50": 2.0,
        "qos1-50pairs": 1.0,
        "qos0-fanout50": 1.0,
        "qos1-100k": 1.0,
        "qos2-inflight20": 1.5,
        "qos0-pair-tls": 1.0,
        "qos1-50pairs-tls": 1.0,
        "qos1-inflight50-tls": 2.0,
    }


@needs_mosquitto
def test_two_mosquittos_side_by_side_in_rounds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = [pretended(tmp_path / "one", "2.1.7"), pretended(tmp_path / "two", "2.0.5")]
    assert bench.main(["qos2-inflight20"], 0.2, both, True, rounds=2) == 0
    captured = capsys.readouterr()
    assert "round 2 of 2, 1 of 1: QoS 2" in captured.err
    printed = json.loads(captured.out)
    assert [(each["name"], each["command"]) for each in printed["peers"]] == [
        ("mosquitto 2.1.7", both[0]),
        ("mosquitto 2.0.5", both[1]),
    ]
    assert (printed["rounds"], printed["goals_against"]) == (2, "mosquitto 2.1.7")
    (row,) = printed["rows"]
    assert row["problem"] is None and isinstance(row["met"], bool)
    for measured in (row["ours"], *row["peers"].values()):
        assert measured["rounds"] == 2 and measured["median"]["lost"] == 0
        lowest, highest = measured["spread"]["cpu_us"]
        assert 0 < lowest <= measured["median"]["cpu_us"] <= highest
    for peer in row["peers"].values():
        ratio = peer["median"]["cpu_us"] / row["ours"]["median"]["cpu_us"]
        assert peer["ratios"]["cpu_us"] == pytest.approx(ratio)
    assert len(row["peers"]) == 2


# The report


def words(capsys: pytest.CaptureFixture[str]) -> list[str]:
    lines = capsys.readouterr().out.splitlines()
    return [" ".join(line.replace("|", " ").split()) for line in lines]


def test_the_tables_say_what_was_not_reached(capsys: pytest.CaptureFixture[str]) -> None:
    cell = Cell("c", "a cell", {"cpu_us": 1.5})
    ours = Result("c", False, 1.0, messages=9, lost=1, cpu_us=3.0, rate=1000.0)
    peer = dataclasses.replace(ours, lost=0, rate=500.0)
    statements = (
        Statement("x", "a ratio", "×", 1.15, "{a-us:.1f} → {b-us:.1f} µs"),
        Statement("y", "a stop", "ms", 50.0),
        Statement("z", "a loss", "", 0),
    )
    figures = {"x": 1.5, "a-us": 2.0, "b-us": 3.0, "y": 2.0, "z": 0}
    grown = GrowthRow(GrowthCell("g", "much", 7, statements), figures, problem="mosquitto: gone")
    report.show(report.Report([pair(cell, ours, peer)], [grown], [NEWER], 1.0, 1))
    shown = words(capsys)
    assert "a cell 3.0 3.0 1.00 ≥ 1.5 not met" in shown
    assert "a cell messages/s 1,000 500 2.00" in shown
    assert "lost by appliance 1 of 10" in shown
    assert "· a ratio 1.50 × (2.0 → 3.0 µs) ≤ 1.15 × not reached" in shown
    assert "· a stop 2.0 ms ≤ 50 ms reached" in shown
    assert "· a loss 0 0 reached" in shown
    assert "mosquitto: gone" in shown
    assert "publish_rate" in " ".join(shown)


def test_the_table_has_medians_with_their_spread_and_a_ratio_for_each_peer(
    capsys: pytest.CaptureFixture[str],
) -> None:
    row = compare(fake(), [OLDER, NEWER], 1.0)
    report.show(report.Report([row], [], [OLDER, NEWER], 1.0, 3))
    shown = words(capsys)
    assert "CPU µs a delivered message, median of 3 rounds (lowest–highest)" in shown
    assert "cell appliance mosquitto 2.0.11 ratio mosquitto 2.1.2 ratio goal" in shown
    assert "a cell 3.0 (2.0–4.0) 8.0 (7.0–9.0) 2.67 5.0 (4.0–6.0) 1.67 ≥ 2 not met" in shown
    assert "The goals are against mosquitto 2.1.2." in shown


def test_an_older_mosquitto_is_not_the_one_that_goals_were_set_for(
    capsys: pytest.CaptureFixture[str],
) -> None:
    report.show(report.Report([compare(fake(), [OLDER], 1.0)], [], [OLDER], 1.0, 3))
    told = " ".join(words(capsys))
    assert "against mosquitto 2.1, built with optimisation; mosquitto 2.0.11 is older" in told
    report.show(report.Report([compare(fake(), [NEWER], 1.0)], [], [NEWER], 1.0, 3))
    assert "is older" not in " ".join(words(capsys))


def test_rounds_that_were_interrupted_are_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = fake()
    cell.figures[OURS][2:] = []

    def interrupted(*arguments: object) -> None:
        if len(cell.order) == 6:
            raise KeyboardInterrupt
        run_round(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(command, "CELLS", (cell,))
    monkeypatch.setattr(command, "run_round", interrupted)
    monkeypatch.setattr(command, "find_peers", lambda commands: [OLDER, NEWER])
    assert bench.main(["c"], 1.0, ["a", "b"], True) == command.INTERRUPTED
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["ours"]["rounds"] == 2 and row["ours"]["spread"]["cpu_us"] == [2.0, 4.0]
