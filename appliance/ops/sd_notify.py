"""Notifies systemd of the service's state: sd_notify(3) and sd_watchdog_enabled(3), by a socket.

A notification is a datagram of `NAME=value` lines to the Unix socket that NOTIFY_SOCKET names.
Nothing here raises an error: without systemd there are no notifications, and one that systemd does
not accept is dropped.
"""

from __future__ import annotations

import logging
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager

from appliance.net.callbacks import Entries, PeriodicCallback

log = logging.getLogger(__name__)

#: Seconds between two updates of STATUS=.
STATUS_INTERVAL = 10.0

#: Characters of a line, each of which may take four bytes: systemd ignores datagrams of more than
#: 4096 bytes (NOTIFY_BUFFER_MAX), with the READY=1 in them.
LONGEST_LINE = 900

#: Characters that would end a line within a value, and the null byte, for which systemd ignores the
#: whole datagram.
_ENDS = dict.fromkeys(map(ord, "\n\r\0"), " ")

#: Seconds that a change of state may wait for systemd to accept it; keep-alives never wait.
PATIENCE = 1.0


class Notifier:
    """Notifies systemd that the service is ready, reloads, stops and is alive, and of its status.

    Belongs to the event loop's thread. `watchdog` is the number of seconds without a keep-alive
    after which systemd restarts the service, None when it never does.
    """

    def __init__(self, address: str | None = None, watchdog: float | None = None) -> None:
        """`address` is a path, `@` and the name of an abstract socket, or None for no systemd."""
        self.watchdog = watchdog if address else None
        self._socket = _connect(address) if address else None
        self._timer: PeriodicCallback | None = None
        self._status = ""
        self._is_ready_pending = False

    @classmethod
    def from_environment(cls, environment: MutableMapping[str, str]) -> Notifier:
        """Take systemd's variables out of the environment, as they are not for child processes."""
        address = environment.pop("NOTIFY_SOCKET", "")
        microseconds = environment.pop("WATCHDOG_USEC", "")
        watched = environment.pop("WATCHDOG_PID", "")
        # The single file's main process, which systemd knows, is the parent that unpacked it.
        pids = (os.getpid(), os.getppid()) if hasattr(sys, "frozen") else (os.getpid(),)
        for_us = not watched or watched in map(str, pids)
        watchdog = int(microseconds) / 1e6 if microseconds.isdecimal() and for_us else 0.0
        return cls(address or None, watchdog or None)

    def start(
        self, entries: Entries, status: Callable[[], str], is_alive: Callable[[], bool]
    ) -> None:
        """Notify that the service is ready, and from now on send keep-alives and the status."""
        self._status = status()
        self._notify_ready(f"STATUS={self._status}")
        if self._socket is None:
            return
        # systemd recommends half the time; with a quarter, one may be late or lost.
        interval = min(STATUS_INTERVAL, self.watchdog / 4 if self.watchdog else STATUS_INTERVAL)
        updated = entries.time()

        def beat() -> None:
            nonlocal updated
            if self.watchdog and is_alive():
                self._notify("WATCHDOG=1", wait=False)
            if self._is_ready_pending:
                self._notify_ready(wait=False)
            if entries.time() >= updated + STATUS_INTERVAL:
                updated = entries.time()
                text = status()  # last: should it fail, the service still lives
                if text != self._status and self._notify(f"STATUS={text}", wait=False):
                    self._status = text

        self._timer = entries.every("notify", interval, beat, 0)

    @contextmanager
    def reloading(self) -> Iterator[None]:
        """Notify that a reload begins, and that it has ended, whether it failed or not."""
        # With Type=notify-reload (systemd 253) RELOADING=1 has to be later than systemd's signal.
        self._notify("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")
        try:
            yield
        finally:
            self._notify_ready()

    def stopping(self) -> None:
        """Notify that the service ends because it was asked to."""
        self._is_ready_pending = False
        self._notify("STOPPING=1", "STATUS=stopping")

    def close(self) -> None:
        """Send no more notifications; may be called twice."""
        if self._timer is not None:
            self._timer.cancel()
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _notify_ready(self, *lines: str, wait: bool = True) -> None:
        """Notify now, or with the next keep-alive: without READY=1 systemd ends the service."""
        self._is_ready_pending = not self._notify("READY=1", *lines, wait=wait)

    def _notify(self, *lines: str, wait: bool = True) -> bool:
        """Send a datagram; returns whether systemd accepted it."""
        if self._socket is None:
            return False
        text = "\n".join(line[:LONGEST_LINE].translate(_ENDS) for line in lines)
        try:
            self._socket.settimeout(PATIENCE if wait else 0)
            self._socket.send(text.encode(errors="replace"))
        except OSError as error:
            log.debug("systemd did not accept %s: %s", lines[0], error)
            return False
        return True


def _connect(address: str) -> socket.socket | None:
    if address[0] not in "/@":  # vsock:…, for a hypervisor
        log.warning("NOTIFY_SOCKET is %s: only Unix sockets are supported", address)
        return None
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        sock.connect("\0" + address[1:] if address[0] == "@" else address)
    except OSError as error:
        log.warning("NOTIFY_SOCKET is %s, which cannot be used: %s", address, error)
        sock.close()
        return None
    return sock
