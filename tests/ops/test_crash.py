"""Reports of crashes: what is in them, and that they are bounded."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from appliance import config
from appliance.broker.faults import Faults
from appliance.ops import crash, logs
from appliance.ops.crash import KEPT, LARGEST, OF_ONE_RUN, CrashReports

SETTINGS = """\
robot: r2d2
broker: {plugins: {some.Plugin: {password: s3cret-word}}}
"""

#: The appliance with a part that fails at its start.
FAILING = """\
import sys
from appliance.app import main as app
from appliance.cli.main import main
def fail(self):
    raise ValueError("a part\\nfailed")
app.App._open_control_socket = fail
main(["run", "-c", sys.argv[1]])
"""


def reports(folder: Path, kind: str = "crash") -> list[Path]:
    return sorted(folder.glob(f"{kind}-*.txt"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "crashes"


def started(folder: Path) -> CrashReports:
    found = CrashReports(folder, config.loads(SETTINGS, folder / "appliance.yaml"))
    found.start()
    return found


def test_an_exception_that_nothing_caught(tmp_path: Path) -> None:
    file = tmp_path / "appliance.yaml"
    settings = {"robot": "r2d2", "bridge": {"bus": "none"}, "reload_on_change": False}
    settings["broker"] = {"listeners": [{"bind": "127.0.0.1:0"}], "audit": {"path": "audit.log"}}
    file.write_text(yaml.safe_dump(settings))
    (tmp_path / "users.passwd").touch(0o600)
    (tmp_path / "acl.conf").touch()
    command = [sys.executable, "-c", FAILING, file]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    (report,) = reports(tmp_path / "state/crashes")
    assert ended.returncode == 1
    assert f"the appliance crashed: ValueError: a part\\x0afailed; the report is {report}" in (
        ended.stderr
    )
    text = report.read_text()
    assert "appliance " in text and "robot: r2d2" in text and "in fail" in text
    assert "listening on 127.0.0.1:" in text.partition("last lines of the log")[2]
    again = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert "the last run crashed on " in again.stderr and f"the report is {report}" in again.stderr


def test_secrets_are_masked_and_nobody_else_reads_them(folder: Path) -> None:
    started(folder).crash(ValueError("x"))
    (report,) = reports(folder)
    assert "s3cret-word" not in report.read_text() and "some.Plugin" in report.read_text()
    assert report.stat().st_mode & 0o777 == 0o600 and folder.stat().st_mode & 0o777 == 0o700


def test_secrets_in_what_failed_are_masked_too(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    logs.recent.append("cannot log in with s3cret-word")
    found = started(folder)
    found.report(ValueError("no connection to sql://me:s3cret-word@db"), "a task failed")
    found.stop()
    (report,) = reports(folder)
    assert "no connection to sql://me:****" in report.read_text()
    assert "s3cret-word" not in report.read_text() + caplog.text


def test_what_is_no_text_is_reported_too(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file's name may have any bytes in it, and be in an error."""
    # pytest sends what is logged to another process, which such text keeps it from.
    monkeypatch.setattr(logging.getLogger("appliance.ops.crash"), "propagate", False)
    found = started(folder)
    found.report(OSError("no such file: \udcff.yaml"), "a task failed")
    found.stop()
    (report,) = reports(folder)
    assert "no such file: \\udcff.yaml" in report.read_text()


def test_half_a_report_is_none(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found, write = started(folder), os.write
    left = [100]

    def full(descriptor: int, data: memoryview) -> int:
        if left[0] <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = write(descriptor, data[: left[0]])
        left[0] -= written
        return written

    monkeypatch.setattr(os, "write", full)
    assert found.report(ValueError("x"), "a task failed") is None
    assert reports(folder) == []
    left[0] = 100_000
    monkeypatch.setattr(crash, "_REPORTED", "x" * 100_000)
    found.crash(ValueError("y"))  # there is room for the report, and no more
    monkeypatch.undo()
    (report,) = reports(folder)
    assert "ValueError: y" in report.read_text()


def test_they_are_bounded(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(KEPT + 2):
        found = started(folder)
        for _ in range(OF_ONE_RUN + 2):
            found.report(ValueError("y" * LARGEST), f"run {number}")
        found.stop()
    assert len(reports(folder)) == KEPT
    assert all(report.stat().st_size <= LARGEST for report in reports(folder))
    assert f"run {KEPT + 1}" in reports(folder)[-1].read_text()
    logs.recent.extend(["z" * 2000] * 2000)
    assert len(logs.recent) < 2000


def test_a_signal_whoever_else_wants_its_report(folder: Path) -> None:
    """rclpy's EventsExecutor enables the fault handler for standard error."""
    code = (
        "import faulthandler, os, sys; from pathlib import Path\n"
        "from appliance import config; from appliance.ops import crash;"
        "folder = Path(sys.argv[1]);"
        "crash.CrashReports(folder, config.loads('', folder / 'appliance.yaml')).start();"
        "faulthandler.enable(); os.abort()"
    )
    ended = subprocess.run([sys.executable, "-c", code, folder], check=False)
    assert ended.returncode == -signal.SIGABRT
    found = started(folder)
    (report,) = reports(folder)
    assert found.previous == report and "Fatal Python error: Aborted" in report.read_text()
    found.stop()


def test_killed_is_no_crash(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "appliance.ops.crash")
    killed = started(folder)
    os.close(killed._running or -1)
    killed._running = None
    found = started(folder)
    assert "did not end by itself: killed, or a power cut" in caplog.text
    assert found.previous is None and not reports(folder)
    found.stop()


@pytest.mark.parametrize(
    "content", [b"\xff" * 9000, b"-- what it ended with --\n\x1b[31m\n", b"\n"]
)
def test_whatever_is_in_the_file(folder: Path, content: bytes) -> None:
    folder.mkdir()
    (folder / "running").write_bytes(content)
    found = started(folder)
    found.stop()
    assert not (folder / "running").exists()


def test_two_appliances_with_one_folder(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    first, second = started(folder), started(folder)
    assert f"{folder}: another appliance uses it" in caplog.text
    second.stop()
    assert (folder / "running").exists()
    first.stop()


def test_a_folder_that_cannot_be(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder.write_text("a file")
    started(folder).stop()
    assert f"crashes are not reported (crash_reports): {folder}: File exists" in caplog.text
    crash.CrashReports(None, config.loads("", folder)).start()


async def test_what_the_loop_fails_with(folder: Path, escaped: list[str]) -> None:
    found = started(folder)
    loop = asyncio.get_running_loop()
    faults = Faults()
    faults.report = found.fault
    found.watch(loop, faults)
    loop.call_soon(lambda: {}["missing"])
    loop.call_exception_handler({"message": "lost", "exception": ConnectionResetError()})
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    loop.set_exception_handler(None)
    (report,) = reports(folder, "fault")
    assert "KeyError: 'missing'" in report.read_text() and not reports(folder)
    assert faults.count == 1 and str(report) in escaped.pop()
    found.stop()
