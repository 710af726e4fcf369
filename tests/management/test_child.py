"""A program that is run beside the event loop."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

import pytest
from waiting import until

from appliance.management.child import Child
from appliance.ros.calls.dispatcher import CallError


def shell(text: str) -> tuple[str, ...]:
    return ("sh", "-c", text)


async def test_what_it_prints() -> None:
    assert await Child(("cat",), 1 << 20, 0).output(b"x" * 50_000) == b"x" * 50_000
    assert await Child(shell("pwd"), 100, 0, directory="/").output() == b"/\n"
    assert await Child(shell("echo 1; exit 1"), 100, 0, codes=(0, 1)).output() == b"1\n"


async def test_failures(caplog: pytest.LogCaptureFixture) -> None:
    for text, code in (("echo partial; exit 3", 3), ("echo partial; kill -9 $$", -9)):
        caplog.clear()
        assert await Child(shell(text), 100, 0).output() == b""
        assert f"ended with {code}" in caplog.text
    with pytest.raises(CallError, match="no process can be started"):
        await Child(("/no/such/program",), 100, 0).output()


async def test_more_than_the_longest() -> None:
    assert await Child(("yes",), 100, 0).output() == (b"y\n" * 51)[:101]


async def test_cancelled_it_ends_with_its_children(tmp_path: Path) -> None:
    """The one that the program has started holds its output open."""
    pid = tmp_path / "pid"
    program = shell(f"sleep 1000 & echo $! > {pid}; wait")
    task = asyncio.create_task(Child(program, 100, 0).output())
    await until(lambda: pid.exists() and pid.read_text().strip(), "the child")
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    child = int(pid.read_text())
    await until(lambda: not is_running(child), "its end")


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False
