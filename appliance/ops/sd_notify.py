"""What systemd is told of the service: sd_notify(3) and sd_watchdog_enabled(3), by a socket.

A message is a datagram of `NAME=value` lines to the Unix socket that NOTIFY_SOCKET names. Nothing
here ever fails: without systemd nobody is told, and what systemd does not take is left out.
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

#: Seconds between two looks at what STATUS= is to say.
STATUS_INTERVAL = 10.0

#: Characters of a line, which may take four bytes each: of datagrams with more than 4096 systemd
#: takes nothing at all (NOTIFY_BUFFER_MAX), not even READY=1.
LONGEST_LINE = 900

#: What systemd takes for a line's end, which in a value would begin another one, and the character
#: with which it takes nothing of a datagram.
_ENDS = dict.fromkeys(map(ord, "\n\r\0"), " ")

#: Seconds that a change of state may wait for systemd to take it; a sign of life never waits.
PATIENCE = 1.0


class Notifier:
    """Tells systemd that the service is ready, reloads, stops, is alive, and how it is.

    Belongs to the event loop's thread. `watchdog` is the silence in seconds after which systemd
    takes the service for hung and restarts it, None when it does not.
    """

    def __init__(self, address: str | None = None, watchdog: float | None = None) -> None:
        """`address` is a path, or a name behind `@` of an abstract socket; None tells nobody."""
        self.watchdog = watchdog if address else None
        self._socket = _connect(address) if address else None
        self._timer: PeriodicCallback | None = None
        self._status = ""
        self._owes_ready = False

    @classmethod
    def from_environment(cls, environment: MutableMapping[str, str]) -> Notifier:
        """As systemd has set the variables, which are taken out: they are not for our children."""
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
        """Tell that the service is ready; from now on, that it is alive, and what `status` says."""
        self._status = status()
        self._tell_ready(f"STATUS={self._status}")
        if self._socket is None:
            return
        # Half of it is what systemd asks for; one that is late, or lost, is not to be the end.
        interval = min(STATUS_INTERVAL, self.watchdog / 4 if self.watchdog else STATUS_INTERVAL)
        looked = entries.time()

        def beat() -> None:
            nonlocal looked
            if self.watchdog and is_alive():
                self._tell("WATCHDOG=1", wait=False)
            if self._owes_ready:
                self._tell_ready(wait=False)
            if entries.time() >= looked + STATUS_INTERVAL:
                looked = entries.time()
                text = status()  # last: should it fail, the service still lives
                if text != self._status and self._tell(f"STATUS={text}", wait=False):
                    self._status = text

        self._timer = entries.every("notify", interval, beat, 0)

    @contextmanager
    def reloading(self) -> Iterator[None]:
        """Tell that files are being taken over, and when that is done, well or not."""
        # With Type=notify-reload (systemd 253) it waits for a RELOADING=1 later than its signal.
        self._tell("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")
        try:
            yield
        finally:
            self._tell_ready()

    def stopping(self) -> None:
        """Tell that the service ends because it was asked to."""
        self._owes_ready = False
        self._tell("STOPPING=1", "STATUS=stopping")

    def close(self) -> None:
        """Tell nothing any more; may be called twice."""
        if self._timer is not None:
            self._timer.cancel()
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _tell_ready(self, *lines: str, wait: bool = True) -> None:
        """Now, or with a later sign of life: systemd waits for it, and then ends the service."""
        self._owes_ready = not self._tell("READY=1", *lines, wait=wait)

    def _tell(self, *lines: str, wait: bool = True) -> bool:
        """Returns whether systemd takes it."""
        if self._socket is None:
            return False
        text = "\n".join(line[:LONGEST_LINE].translate(_ENDS) for line in lines)
        try:
            self._socket.settimeout(PATIENCE if wait else 0)
            self._socket.send(text.encode(errors="replace"))
        except OSError as error:
            log.debug("systemd was not told %s: %s", lines[0], error)
            return False
        return True


def _connect(address: str) -> socket.socket | None:
    if address[0] not in "/@":  # vsock:…, which tells a hypervisor
        log.warning("NOTIFY_SOCKET is %s: only Unix sockets are told anything", address)
        return None
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        sock.connect("\0" + address[1:] if address[0] == "@" else address)
    except OSError as error:
        log.warning("NOTIFY_SOCKET is %s, which cannot be used: %s", address, error)
        sock.close()
        return None
    return sock
