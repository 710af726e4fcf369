"""`appliance upstream`: what it prints of links."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import pytest
import typer
import yaml

from appliance.cli import main as cli
from appliance.cli import tables, upstream
from appliance.ops import control
from appliance.upstream.backlog_counts import DropReason
from appliance.upstream.status import LinkStatus

LINK = LinkStatus(
    "fleet",
    "generic",
    server="mqtts://a:8883",
    came={"fleet/r2/cmd/#": 7, "fleet/r2/stop": 0},
    problem="it says\nwhat\x1b[2J",
    dropped={
        "r2/state/#": {DropReason.REPLACED.value: 900},
        "r2/events/#": {DropReason.REPLACED.value: 50, DropReason.FULL.value: 3},
    },
)
ASIDE = {"rule": "r2/events/#", "topic": "t", "size": 1, "reason": "no\nway", "age": 300.0}


def test_each_thing_to_know_is_a_line_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "appliance.yaml").write_text(yaml.safe_dump({"robot": "r2"}))
    (tmp_path / "broken.yaml").write_text("robott: r2")
    links = [{**asdict(LINK), "aside": [ASIDE]}]
    monkeypatch.setattr(control, "ask", lambda *_, **__: links)
    with pytest.raises(SystemExit):  # what is in force is shown, whatever the file says
        cli.main(["upstream", "-c", str(tmp_path / "broken.yaml")])
    shown = capsys.readouterr()
    assert "what is in force is older than the file" in shown.err and "robott" in shown.err
    assert "\\x0a" not in shown.err
    assert "not connected" in shown.out
    with pytest.raises(SystemExit) as ended:
        cli.main(["upstream", "-c", str(tmp_path / "appliance.yaml")])
    assert ended.value.code == 1  # it is not connected
    head, row, *lines = capsys.readouterr().out.splitlines()
    assert row[head.index("DROPPED") :].split()[0] == "3"  # what was replaced is not lost
    assert lines == [
        "",
        r"fleet: it says\x0awhat\x1b[2J",
        "fleet: came from there: 7 of fleet/r2/cmd/#, 0 of fleet/r2/stop",
        "fleet: dropped of r2/events/#: 3 full",
        r"fleet: set aside 5 min ago, t: no\x0away",
    ]


def test_all_columns_are_there_where_the_terminal_is_narrow(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    links = [{**asdict(LINK), "aside": []}]
    monkeypatch.setattr(upstream, "ask_running", lambda *_: (links, ""))
    monkeypatch.setattr(tables, "terminal_width", lambda: 60)
    with pytest.raises(typer.Exit):
        upstream.upstream()
    head, link, *more = capsys.readouterr().out.splitlines()
    assert head.split() == ["NAME", "SERVER", "STATE"]
    assert link.split() == ["fleet", "mqtts://a:8883", "not", "connected"]
    text = " ".join(" ".join(more[:2]).split())
    assert text.startswith("out 0; in 0; waiting 0;") and "dropped 3;" in text
    assert max(map(len, [head, link, *more[:2]])) <= 60
