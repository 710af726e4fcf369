"""What systemd does with a service of Type=notify, as far as a test needs it."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import threading
import time
import uuid
from collections.abc import Callable
from pathlib import Path

from appliance_process import ApplianceProcess
from waiting import PATIENCE


class NotifySocket:
    """A socket as systemd's: abstract, or at `path`; `messages` are what came, with the moment."""

    def __init__(self, path: Path | None = None) -> None:
        self.address = str(path) if path else f"@appliance-test-{uuid.uuid4().hex}"
        self.messages: list[tuple[float, dict[str, str]]] = []
        self._changed = threading.Condition()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self.address.replace("@", "\0", 1) if path is None else self.address)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def __enter__(self) -> NotifySocket:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(PATIENCE)
        self._socket.close()

    def _read(self) -> None:
        while data := self._socket.recv(65536):
            fields = dict(line.split("=", 1) for line in data.decode().splitlines())
            with self._changed:
                self.messages.append((time.monotonic(), fields))
                self._changed.notify_all()

    def all(self, name: str) -> list[str]:
        """All values of a name, in the order they came."""
        with self._changed:
            return [fields[name] for _, fields in self.messages if name in fields]

    def last(self, name: str) -> float:
        """When the name came last."""
        with self._changed:
            return max((when for when, fields in self.messages if name in fields), default=0.0)

    def wait(self, condition: Callable[[], object], what: str, timeout: float = PATIENCE) -> None:
        """Returns when the condition holds, which new messages can make true."""
        with self._changed:
            assert self._changed.wait_for(condition, timeout), f"{what}: {self.messages}"


class Supervised(ApplianceProcess):
    """An appliance that is told of a notify socket, and of a watchdog when there is one.

    `watchdog` is in seconds.
    """

    def supervise(self, notify: NotifySocket, watchdog: float) -> None:
        self.notify = notify
        self.watchdog = watchdog
        self.environment = {
            "NOTIFY_SOCKET": notify.address,
            "WATCHDOG_USEC": str(round(watchdog * 1e6)),
        }

    def start(self) -> None:
        """Start it; it is ready when it says so."""
        ready = len(self.notify.all("READY"))
        super().start()
        self.notify.wait(lambda: len(self.notify.all("READY")) > ready, "READY=1")

    def kill(self) -> int:
        """SIGKILL."""
        os.kill(self.pid, signal.SIGKILL)
        return self.ended()

    def hang(self) -> int:
        """SIGSTOP; then the watchdog notices, and does what systemd does."""
        os.kill(self.pid, signal.SIGSTOP)
        self._wait_for_silence()
        os.kill(self.pid, signal.SIGABRT)
        os.kill(self.pid, signal.SIGCONT)
        return self.ended()

    def watch(self) -> int:
        """The watchdog alone: for an appliance that hangs by itself."""
        self._wait_for_silence()
        os.kill(self.pid, signal.SIGABRT)
        return self.ended()

    def _wait_for_silence(self) -> None:
        """As long as systemd waits, which counts from READY=1 on."""
        while time.monotonic() < self.watchdog + max(map(self.notify.last, ("READY", "WATCHDOG"))):
            time.sleep(0.01)

    def terminate(self) -> int:
        """SIGTERM."""
        os.kill(self.pid, signal.SIGTERM)
        return self.ended()

    def ended(self) -> int:
        """Its exit code, when it has ended."""
        process, reader = self._process, self._reader
        assert process is not None and reader is not None
        try:
            code = process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise AssertionError(f"it did not end:\n{self.log[-3000:]}") from None
        reader.join(PATIENCE)
        self._process = None
        return code
