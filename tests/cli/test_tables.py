"""Tables that fit a terminal, and what `appliance routes` prints in 80 columns."""

from __future__ import annotations

import io
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len

from appliance.cli import routes as command
from appliance.cli import tables
from appliance.cli.tables import cut, fitted, shortened, table

ROWS = [
    ("ROS", "MQTT", "REASON"),
    ("/front/camera/image_raw", "r2d2/front/camera/image_raw", "no message type is installed"),
    ("/o", "r2d2/o", "漢字 漢字漢字漢字"),
]


def test_nothing_is_left_out_for_programs() -> None:
    head, row, _ = table(ROWS)
    assert row == "  ".join(ROWS[1])
    assert head.index("MQTT") == row.index("r2d2/")
    assert list(table([])) == []


@pytest.mark.parametrize("width", [7, 20, 40, 60, 80])
def test_every_line_fits(width: int) -> None:
    found = list(table(ROWS, width))
    assert max(map(cell_len, found)) <= width
    assert len(found) >= len(ROWS)
    if width > 40:  # sentences are whole, in several lines
        assert {"installed", "message", "type"} <= {*" ".join(found).split()}


def test_names_lose_their_middle() -> None:
    assert shortened("/front/camera/image_raw", 15) == "/front/…age_raw"
    assert [shortened("abcdef", width) for width in (0, 1, 2, 6)] == ["", "…", "a…", "abcdef"]
    assert [cut("abcdef", width) for width in (0, 1, 3, 6)] == ["", "…", "ab…", "abcdef"]


@given(st.text(), st.integers(0, 30))
def test_a_shortened_text_fits(text: str, width: int) -> None:
    for shorter in (shortened, cut):
        assert cell_len(shorter(tables.visible(text), width)) <= width


@given(st.lists(st.integers(0, 70_000), min_size=1, max_size=12), st.integers(12, 300))
def test_columns_give_way_only_as_far_as_they_must(widths: list[int], room: int) -> None:
    found = fitted(widths, room)
    assert sum(found) <= room and all(a <= b for a, b in zip(found, widths, strict=True))
    if found != widths:
        cut = {a for a, b in zip(found, widths, strict=True) if a < b}
        assert len(cut) == 1 and sum(found) + len(widths) > room


def test_strangers_do_not_control_the_terminal() -> None:
    (line,) = table([("tablet\x1b[2J\n\u202e", "x\x9b")], 60)
    assert line == "tablet\\x1b[2J\\x0a\\u202e  x\\x9b"


def entry(ros: str, **more: Any) -> dict[str, Any]:
    mqtt = f"r2d2{ros}"
    counters = dict.fromkeys(
        ("lost", "dropped", "skipped", "throttled", "expired", "refused", "errors"), 0
    )
    latency = {"p50": 0.31, "p99": 12.55}
    about = {"type": "nav_msgs/msg/Odometry", "encoding": "json", "direction": "to_mqtt"}
    values = {"rate": 10, "size": 1234, "latency_ms": latency, "last_error": None}
    return {"ros": ros, "mqtt": mqtt, **about, **values, **counters, **more}


CALL = {
    "ros": "/reset",
    "mqtt": "r2d2/reset",
    "type": "std_srvs/srv/Trigger",
    "direction": "service",
    "encoding": "json",
}
BRIDGED = [
    entry("/odom"),
    entry("/front/camera/color/image_raw/compressed", lost=12345, throttled=7, refused=1),
    entry("/scan", last_error="field 'x\x1b[2J': " + "no number " * 20, errors=3),
    CALL,
]


def shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], width: int | None
) -> list[str]:
    monkeypatch.setattr(tables, "terminal_width", lambda: width)
    answers = {"routes": BRIDGED, "skipped": []}
    monkeypatch.setattr(command, "ask_running", lambda config, verb: (answers[verb], ""))
    command.routes()
    return capsys.readouterr().out.splitlines()


@pytest.mark.parametrize("width", [40, 80, 120])
def test_routes_fit(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], width: int
) -> None:
    lines = shown(monkeypatch, capsys, width)
    assert max(map(cell_len, lines[: 1 + 2 * len(BRIDGED)])) <= width
    text = " ".join(" ".join(lines).split())
    assert "nav_msgs/msg/Odometry as json; lost 12345; throttled 7; refused 1" in text
    assert "\\x1b[2J" in text and "\x1b" not in text


def test_routes_for_programs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    head, first, *_ = shown(monkeypatch, capsys, None)
    assert head.split() == [*command.HEAD[:1], *command.HEAD[2:], *command.METRICS]
    assert first.split()[:2] == ["/front/camera/color/image_raw/compressed", "→"]


def test_a_file_is_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout", io.StringIO())
    assert tables.terminal_width() is None
