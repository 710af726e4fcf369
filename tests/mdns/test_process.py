"""The announcing program is started, watched and ended; what it says is a stranger's."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, cast

import psutil
import pytest
from waiting import PATIENCE, until

from appliance.mdns import process as announcing
from appliance.mdns.announcement import SECURE_MQTT, Announcement, Service
from appliance.mdns.process import LINE_SIZE, LINKS, TEXT_SIZE, AnnouncerProcess, report_of

WANTED = Announcement("r2d2", "", "appliance-0", (Service(SECURE_MQTT, 8883, ("",)),))
SAID: dict[str, Any] = {"name": "r2d2", "links": ["eth0: 192.0.2.1"], "problem": ""}

#: Says SAID for each line, and ends with its input.
GOOD = (
    f"while read line; do echo '{json.dumps(SAID)}'; echo \"$line\" >> told; done; echo bye >> told"
)


@asynccontextmanager
async def running(script: str, delay: float = 0.01) -> AsyncIterator[AnnouncerProcess]:
    """An appliance's side of a program that is that script."""
    process = AnnouncerProcess(("sh", "-c", script), delay)
    task = asyncio.create_task(process.run())
    try:
        yield process
    finally:
        # As the appliance does: asyncio waits for good for the end of a process that was cancelled
        # before its pipes were connected.
        while not task.done():
            task.cancel()
            await asyncio.wait({task}, timeout=10)


class Told:
    """What the script GOOD was told."""

    def lines(self) -> list[str]:
        file = Path("told")
        return file.read_text().splitlines() if file.exists() else []


@pytest.fixture(autouse=True)
def told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Told:
    monkeypatch.setattr(announcing, "LINE_INTERVAL", 0.001)
    monkeypatch.chdir(tmp_path)
    return Told()


def child() -> int:
    """What a script has started."""
    file = Path("child")
    return int(file.read_text().strip() or 0) if file.exists() else 0


async def test_it_is_told_and_says_what_it_does(
    told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(announcing, "FAREWELL", PATIENCE)
    async with running(GOOD) as process:
        assert process.status()["state"] == "off" and process.pid is None
        process.announce(WANTED)
        await until(lambda: process.status()["state"] == "announced")
        status = process.status()
        assert (status["name"], status["links"]) == ("r2d2", ["eth0: 192.0.2.1"])
        assert status["problem"] is None and status["restarts"] == 0
        process.announce(WANTED)  # the same: not said again
        other = Announcement("r2d2", "AB" * 32, "appliance-0", WANTED.services)
        process.announce(other)
        await until(lambda: len(told.lines()) == 2)
        assert [Announcement.from_line(each.encode()) for each in told.lines()] == [WANTED, other]
        # It is ended by the end of its input, and that is no fault.
        pid = process.pid
        process.announce("broker.mdns is false")
        await until(lambda: process.pid is None)
        assert told.lines()[-1] == "bye"
        assert process.status()["reason"] == "broker.mdns is false"
        assert process.status()["problem"] is None
        process.announce(WANTED)
        await until(lambda: process.status()["state"] == "announced")
        assert process.pid not in (None, pid)
    assert process.pid is None and told.lines()[2:].count("bye") == 2


async def test_it_is_started_again(caplog: pytest.LogCaptureFixture) -> None:
    async with running(f"{GOOD}; exit 0") as process:
        process.announce(WANTED)
        await until(lambda: process.status()["state"] == "announced")
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        await until(lambda: process.restarts == 1 and process.status()["state"] == "announced")
        assert "the announcing program ended with -9" in caplog.text


async def test_one_that_fails_is_tried_less_and_less(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(announcing, "LONGEST_DELAY", 0.05)
    async with running("echo ImportError: no zeroconf >&2; exit 3") as process:
        process.announce(WANTED)
        await until(lambda: process.restarts >= 4)
        problem = "the announcing program ended with 3: ImportError: no zeroconf"
        assert process.status()["state"] in ("failed", "starting")
        assert process.status()["problem"] == problem
    found = [record.args for record in caplog.records if "started again" in record.msg]
    assert [args[1] for args in found if isinstance(args, tuple)][:4] == [0.01, 0.02, 0.04, 0.05]


@pytest.mark.parametrize("rounds", range(4))
async def test_a_cancellation_that_comes_with_the_end_is_not_lost(rounds: int) -> None:
    """The appliance stops by it, whatever the program does meanwhile."""
    is_over = asyncio.Event()

    class Ending:
        """A program whose output ends when it is over."""

        async def read(self, size: int) -> bytes:
            await is_over.wait()
            return b""

        async def wait(self) -> int:
            return 0

    process = Ending()
    process.stdout = process  # type: ignore[attr-defined]
    waiting = asyncio.create_task(announcing._ended(cast(Any, process)))
    for _ in range(3):
        await asyncio.sleep(0)
    is_over.set()
    for _ in range(rounds):
        await asyncio.sleep(0)
    if waiting.cancel():
        with pytest.raises(asyncio.CancelledError):
            await waiting
    else:
        assert rounds, "it has ended before it could be cancelled"


async def test_one_that_is_not_there() -> None:
    process = AnnouncerProcess(("/no/such/program",), 0.01)
    task = asyncio.create_task(process.run())
    process.announce(WANTED)
    await until(lambda: "cannot be started" in (process.status()["problem"] or ""))
    task.cancel()


async def test_one_that_does_not_end_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    """With what it has started."""
    monkeypatch.setattr(announcing, "FAREWELL", 0.05)
    async with running("sleep 1000 & echo $! > child; wait") as process:
        process.announce(WANTED)
        await until(lambda: process.pid and child())  # not while it is being started
    await until(lambda: not is_running(child()))


def is_running(pid: int) -> bool:
    with contextlib.suppress(psutil.NoSuchProcess):  # it may end while it is asked about
        return psutil.Process(pid).status() != "zombie"
    return False


async def test_a_line_that_is_too_long(caplog: pytest.LogCaptureFixture) -> None:
    async with running(f"head -c {2 * LINE_SIZE} /dev/zero; sleep 1000") as process:
        process.announce(WANTED)
        await until(lambda: process.restarts)
        assert f"it printed a line of more than {LINE_SIZE} bytes" in caplog.text


async def test_a_flood_of_lines_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(announcing, "LINE_INTERVAL", 1000.0)
    heard = 0

    def hear(self: AnnouncerProcess, said: dict[str, Any]) -> None:
        nonlocal heard
        heard += 1

    monkeypatch.setattr(AnnouncerProcess, "_hear", hear)
    async with running(f"while :; do echo '{json.dumps(SAID)}'; done") as process:
        process.announce(WANTED)
        await until(lambda: heard)
        for _ in range(100):
            await asyncio.sleep(0)
        assert heard == 1


@pytest.mark.usefixtures("no_collection")
@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"\n",
        b"[]\n",
        b"{}\n",
        b"null\n",
        b'"name"\n',
        b"\xff\xfe\n",
        b'{"name": 1, "links": [], "problem": ""}\n',
        b'{"name": "a", "links": "eth0", "problem": ""}\n',
        b'{"name": "a", "links": [[]], "problem": ""}\n',
        b'{"name": "a", "links": null, "problem": ""}\n',
        b'{"name": "a", "links": []}\n',
        b"[" * 10_000 + b"\n",
    ],
)
def test_what_is_no_report(line: bytes) -> None:
    assert report_of(line) is None


def test_as_much_of_a_report_as_is_allowed() -> None:
    line = json.dumps({"name": "n" * 9999, "links": ["l" * 9999] * 99, "problem": "p" * 9999})
    said = report_of(line.encode())
    assert said is not None
    assert said["links"] == ["l" * TEXT_SIZE] * LINKS
    assert (len(said["name"]), len(said["problem"])) == (TEXT_SIZE, TEXT_SIZE)


async def test_its_problem_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "appliance.mdns")
    told = json.dumps({**SAID, "problem": "somebody claims every name"})
    script = f"read line; echo '{told}'; echo '{told}'; echo '{json.dumps(SAID)}'; read line"
    async with running(script) as process:
        process.announce(WANTED)
        await until(lambda: process.status() and "announced as" in caplog.text)
        await until(lambda: process.status()["problem"] is None)
    assert caplog.text.count("somebody claims every name") == 1


async def test_the_program_itself_ends_with_its_input() -> None:
    """Whether or not it was told anything."""
    for given in (b"", b"nonsense\n"):
        program = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "appliance.mdns.announcer"),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        output, _ = await program.communicate(given)
        assert (program.returncode == 0) is not given or b"JSONDecodeError" in output
