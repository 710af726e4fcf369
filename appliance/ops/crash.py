"""A report of each crash, in files beside the state.

The file `running` is there while the appliance runs. Python's fault handler writes all threads'
tracebacks into it when a signal ends the process (SIGSEGV, and the SIGABRT that systemd sends to a
service that hangs); the next start finds it, and makes a report of it. An exception that nothing
caught is reported at once, with the last lines of the log.
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
from appliance.config import Settings, describe, secrets_in
from appliance.config.redaction import redacted
from appliance.ops import logs

log = logging.getLogger(__name__)

#: Reports that stay; reports of one process; and bytes of one, of which tracebacks are the end.
KEPT = 5
OF_ONE_RUN = 3
LARGEST = 256 * 1024

#: A secret of fewer characters is not looked for in a report: it is in many words.
SHORTEST_SECRET = 6

_enable = faulthandler.enable

_RUNNING = "running"
_REPORTED = "reported in "
_END_OF_HEAD = "-- what it ended with --\n"


class CrashReports:
    """Writes reports into `folder`, none where that is None.

    `previous` is the report of the last run, None when that did not crash.
    Reports never keep the appliance from running: where they cannot be written, the log says so.
    """

    def __init__(self, folder: Path | None, settings: Settings) -> None:
        self.previous: Path | None = None
        self._folder = folder or Path()
        self._wanted = folder is not None
        self._settings = settings
        self._running: int | None = None
        self._reported = self._faults = 0
        secrets = secrets_in(settings.broker.plugins)
        self._secrets = [secret for secret in secrets if len(secret) >= SHORTEST_SECRET]

    def start(self) -> None:
        """Find out how the last run ended, and be ready for the end of this one."""
        if not self._wanted:
            return
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            flags = os.O_CREAT | os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW
            self._running = os.open(self._folder / _RUNNING, flags, 0o600)
            # Another appliance with the same folder keeps it, and this one reports nothing.
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
        # rclpy's EventsExecutor would have it write to standard error, as soon as it is imported.
        faulthandler.enable = lambda *_, **__: None
        threading.excepthook = self._on_thread

    def stop(self) -> None:
        """The run ends well; may be called twice."""
        if self._running is not None:
            (self._folder / _RUNNING).unlink(missing_ok=True)
            self._close()

    def crash(self, error: BaseException) -> None:
        """The run ends with an exception that nothing caught."""
        path = self.report(error, "the appliance crashed")
        if self._running is not None and path is not None:
            with suppress(OSError):  # the disk is full: the next start takes it for a power cut
                _write(self._running, f"{_REPORTED}{path.name}\n")
            self._close()

    def watch(self, loop: asyncio.AbstractEventLoop, faults: Faults) -> None:
        """Count, as a fault, what callbacks and tasks fail with that are no entry of ours."""

        def on_loop(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
            error = context.get("exception")
            if error is None or isinstance(error, OSError):  # those are the network's
                loop.default_exception_handler(context)
            else:
                faults.caught("loop", error, context.get("message", ""))

        loop.set_exception_handler(on_loop)

    def fault(self, error: BaseException, what: str) -> Path | None:
        """Report one that was contained: the run goes on, and keeps its reports of crashes."""
        if self._faults >= OF_ONE_RUN:
            return None
        self._faults += 1
        return self._write(error, what, "fault")

    def report(self, error: BaseException, what: str) -> Path | None:
        """Write a report of an exception; the log says where it is, and so does what returns."""
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
        told = f"{what}\n{lines}\n-- the last lines of the log --\n{text}\n"
        try:
            return self._save(_encoded(f"{self._head()}{redacted(told, self._secrets)}"), kind)
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
        except OSError:  # half a report would take the place of a whole one
            path.unlink(missing_ok=True)
            raise
        finally:
            os.close(descriptor)
        # By when they were written: a clock that was set back must not delete the newest.
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
    """UTF-8, also of what is none: a file's name with other bytes may be in any error."""
    return text.encode(errors="backslashreplace")
