"""Crash reports, in files beside the state.

The file `running` exists while the appliance runs. Python's fault handler writes the tracebacks of
all threads into it when a signal ends the process (SIGSEGV, and the SIGABRT that systemd sends to a
service that hangs). The next start finds the file and turns it into a report. An exception that
nothing caught is reported at once, with the last lines of the log.
"""

from __future__ import annotations

import asyncio
import errno
import faulthandler
import fcntl
import logging
import os
import platform
import threading
import time
import traceback
from contextlib import suppress
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml

from appliance.broker.faults import Faults
from appliance.config import Settings, describe, secrets_of
from appliance.config.redaction import redacted
from appliance.ops import logs

log = logging.getLogger(__name__)

#: Reports of a kind that are kept, and reports of a kind that one process writes.
KEPT = 5
OF_ONE_RUN = 3

#: Bytes of a report, half of which a traceback may take.
LARGEST = 256 * 1024

#: Shorter secrets are not masked in a report, because they are part of many words.
SHORTEST_SECRET = 6

_enable = faulthandler.enable

_RUNNING = "running"
_REPORTED = "reported in "
_END_OF_HEAD = "-- what it ended with --\n"


class CrashReports:
    """Writes reports into `folder`; with None there are no reports.

    `previous` is the report of the last run, None if that did not crash. When reports cannot be
    written, the log says so and the appliance runs without them.
    """

    def __init__(self, folder: Path | None, settings: Settings) -> None:
        self.previous: Path | None = None
        self._folder = folder or Path()
        self._wanted = folder is not None
        self._settings = settings
        self._running: int | None = None
        self._reported = self._faults = 0
        secrets = secrets_of(settings)
        self._secrets = [secret for secret in secrets if len(secret) >= SHORTEST_SECRET]

    def start(self) -> None:
        """Report how the last run ended if it crashed, and prepare to report this one."""
        if not self._wanted:
            return
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            flags = os.O_CREAT | os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW
            self._running = os.open(self._folder / _RUNNING, flags, 0o600)
            # If another appliance uses the folder, this one reports nothing.
            fcntl.flock(self._running, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self.previous = self._find_previous()
            os.ftruncate(self._running, 0)
            os.lseek(self._running, 0, os.SEEK_SET)
            _write(self._running, self._head())
        except OSError as error:
            self._close()
            why = "another appliance uses it" if error.errno == errno.EAGAIN else error.strerror
            log.warning("crashes are not reported (crash_reports): %s: %s", self._folder, why)
            return
        _enable(self._running, all_threads=True)
        # rclpy's EventsExecutor redirects the handler to standard error as soon as it is imported.
        faulthandler.enable = lambda *_, **__: None
        threading.excepthook = self._on_thread

    def stop(self) -> None:
        """End a run that did not crash; may be called twice."""
        if self._running is not None:
            (self._folder / _RUNNING).unlink(missing_ok=True)
            self._close()

    def crash(self, error: BaseException) -> None:
        """Report the exception that ends the run."""
        path = self.report(error, "the appliance crashed")
        if self._running is not None and path is not None:
            with suppress(OSError):  # on a full disk the next start assumes a power cut
                _write(self._running, f"{_REPORTED}{path.name}\n")
            self._close()

    def watch(self, loop: asyncio.AbstractEventLoop, faults: Faults) -> None:
        """Count what escapes from callbacks and tasks of libraries as faults."""

        def on_loop(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
            error = context.get("exception")
            if error is None or isinstance(error, OSError):  # the network's, not a fault
                loop.default_exception_handler(context)
            else:
                faults.caught("loop", error, context.get("message", ""))

        loop.set_exception_handler(on_loop)

    def fault(self, error: BaseException, what: str) -> Path | None:
        """Report a contained fault; the run continues, and may report as many crashes as before."""
        if self._faults >= OF_ONE_RUN:
            return None
        self._faults += 1
        return self._write(error, what, "fault")

    def report(self, error: BaseException, what: str) -> Path | None:
        """Write a report of an exception, log its path and return it."""
        if self._reported >= OF_ONE_RUN:
            return None
        self._reported += 1
        path = self._write(error, what, "crash")
        if path is not None:
            why = redacted(f"{type(error).__name__}: {error}", self._secrets)
            log.critical("%s: %s; the report is %s", what, why, path)
        return path

    def _write(self, error: BaseException, what: str, kind: str) -> Path | None:
        if self._running is None:
            return None
        lines = "".join(traceback.format_exception(error))[-LARGEST // 2 :]
        text = "\n".join(logs.recent)[-LARGEST // 4 :]
        report = f"{what}\n{lines}\n-- the last lines of the log --\n{text}\n"
        try:
            return self._save(_encoded(f"{self._head()}{redacted(report, self._secrets)}"), kind)
        except OSError as failure:
            log.error("%s, and no report can be written: %s", what, failure)
            return None

    def _find_previous(self) -> Path | None:
        assert self._running is not None
        status = os.fstat(self._running)
        if not status.st_size:
            return None
        data = os.pread(self._running, LARGEST, 0)
        end = data.partition(_END_OF_HEAD.encode())[2].strip()
        when = datetime.fromtimestamp(status.st_mtime).strftime("%Y-%m-%d %H:%M:%S")
        if not end:
            text = "the run that began on %s did not end by itself: killed, or a power cut"
            log.info(text, when)
            return None
        why = end.splitlines()[0].decode(errors="replace")
        if why.startswith(_REPORTED):
            path = self._folder / Path(why.removeprefix(_REPORTED)).name
        else:
            path = self._save(data)
        log.warning("the last run crashed on %s (%s); the report is %s", when, why, path)
        return path

    def _head(self) -> str:
        try:
            ours = version("ros-mqtt-appliance")
        except PackageNotFoundError:
            ours = "unknown"
        settings = yaml.safe_dump(describe(self._settings), sort_keys=False)[: LARGEST // 4]
        return (
            f"appliance {ours}, Python {platform.python_version()}, {platform.platform()}\n"
            f"process {os.getpid()}, at {datetime.now(timezone.utc).isoformat(timespec='seconds')}"
            f", {time.monotonic():.0f} s after the computer's start\n"
            f"\n{settings}\n{_END_OF_HEAD}"
        )

    def _save(self, data: bytes, kind: str = "crash") -> Path:
        moment = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%S.%fZ")
        path = self._folder / f"{kind}-{moment}.txt"
        flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC
        descriptor = os.open(path, flags, 0o600)
        try:
            _write(descriptor, data[:LARGEST])
            os.fsync(descriptor)
        except OSError:  # half a report would replace an older, whole one
            path.unlink(missing_ok=True)
            raise
        finally:
            os.close(descriptor)
        # By the time of writing: if the clock was set back, the newest has not the last name.
        reports = sorted(self._folder.glob(f"{kind}-*.txt"), key=lambda p: p.stat().st_ctime_ns)
        for old in reports[:-KEPT]:
            old.unlink(missing_ok=True)
        return path

    def _close(self) -> None:
        if self._running is not None:
            faulthandler.disable()
            faulthandler.enable = _enable
            threading.excepthook = threading.__excepthook__
            os.close(self._running)
            self._running = None

    def _on_thread(self, arguments: threading.ExceptHookArgs) -> None:
        threading.__excepthook__(arguments)
        if arguments.exc_value is not None:
            name = arguments.thread.name if arguments.thread else "?"
            self.report(arguments.exc_value, f"the thread {name} ended")


def _write(descriptor: int, data: bytes | str) -> None:
    rest = memoryview(_encoded(data) if isinstance(data, str) else data)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


def _encoded(text: str) -> bytes:
    """Encode as UTF-8, with escapes for bytes of file names that are not UTF-8."""
    return text.encode(errors="backslashreplace")
