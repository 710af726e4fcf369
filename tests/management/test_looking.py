"""Verbs that look: the last lines of the log and of the audit log, and the doctor."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path

import pytest
from waiting import until

from appliance.management import records
from appliance.management.examination import DoctorVerb
from appliance.management.records import newest
from appliance.management.verbs import LOCAL, Arguments
from appliance.ops import logs
from appliance.ros.calls.dispatcher import CallError
from management.managed import Site


async def test_the_last_lines(site: Site, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(logs, "recent", logs.recent.__class__(maxlen=logs.recent.maxlen))
    assert logs.recent.maxlen == records.MOST_LINES
    logs.recent.extend(f"\x1b[33mline {number}\x1b[0m" for number in range(1500))
    admin = await site.join("a")
    lines = (await admin.call("log", {"lines": 1000}))["lines"]
    assert lines == [f"line {number}" for number in range(500, 1500)]
    assert (await admin.call("log", {"lines": 1}))["lines"] == ["line 1499"]
    await admin.call("reload")
    await until(lambda: site.audited(), "the audit log")
    with (site.directory / "audit.log").open("a") as file:
        file.write("cut o\n")
    entries = (await admin.call("audit", {"lines": 2}))["entries"]
    assert entries[0]["what"] == "reload" and entries[0]["by"]["user"] == "admin"
    assert entries[1] == {"event": "unreadable"}


def test_an_answer_is_bounded():
    lines = newest([f"{number:04}" + "ä" * 10_000 for number in range(100)], 1000)
    assert [line[:4] for line in lines] == [f"{number:04}" for number in range(87, 100)]


async def test_the_doctor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    doctor = DoctorVerb(tmp_path / "appliance.yaml")

    def command(code: str) -> None:
        monkeypatch.setattr(doctor, "_command", (sys.executable, "-c", code))

    finding = {"level": "problem", "subject": "clock", "text": "it is wrong", "advice": "set it"}
    command(f"print({json.dumps(finding)!r}); raise SystemExit(1)")
    assert await doctor._examine(LOCAL, Arguments()) == {"findings": [finding]}
    for code, told in (
        ("print('x' * 300_000, flush=True); import time; time.sleep(600)", "bytes of findings"),
        ("print('Traceback')", "has not printed"),
    ):
        command(code)
        with pytest.raises(CallError, match=told):
            await doctor._examine(LOCAL, Arguments())
    # One at a time; and it is ended with the call.
    command("import time; time.sleep(600)")
    first = asyncio.ensure_future(doctor._examine(LOCAL, Arguments()))
    await until(doctor._lock.locked)
    with pytest.raises(CallError, match="under way"):
        await doctor._examine(LOCAL, Arguments())
    first.cancel()
    with pytest.raises(asyncio.CancelledError):
        await first
