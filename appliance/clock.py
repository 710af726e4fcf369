"""How far the computer's clock can be trusted: many a robot's has no battery.

Such a computer starts in 1970, or with the time at which it was last switched off, and learns the
time from the network minutes later, or never. So what takes so many seconds is measured with the
clock that only counts (`loop.time`), and the wall clock is for what has a date: certificates, logs,
and what outlives a restart.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from datetime import datetime, timezone
from typing import Final

#: A computer whose clock says less has not been told the time. To be moved on with releases.
RELEASED: Final = datetime(2026, 1, 1, tzinfo=timezone.utc)

#: Seconds that the wall clock may be off from one look to the next, as it is nudged by NTP.
NUDGE: Final = 2.0


def is_unset(now: datetime | None = None) -> bool:
    """Whether the computer's clock, or the one given, is of before this program was made."""
    return (now or datetime.now(timezone.utc)) < RELEASED


class StepWatch:
    """Finds out that somebody set the wall clock, or that the computer slept."""

    def __init__(self, now: float, wall: Callable[[], float] = time.time) -> None:
        """`now` is by the clock that only counts, as it is for `look`."""
        self._wall = wall
        self._ahead = wall() - now

    def look(self, now: float) -> float:
        """Seconds that the wall clock went ahead by since the last look; 0 for a nudge."""
        ahead = self._wall() - now
        step, self._ahead = ahead - self._ahead, ahead
        return step if abs(step) >= NUDGE else 0.0


class WorkClock:
    """Seconds that a thread has worked, or was ready to while others had the processor.

    It is the thread of the first call. Where the system does not tell, the second part is missing.
    """

    def __init__(self) -> None:
        self._file = -1

    def __call__(self) -> float:
        """What it is now; by how much it grows is what it is for."""
        if self._file < 0:
            try:
                self._file = os.open("/proc/thread-self/schedstat", os.O_RDONLY | os.O_CLOEXEC)
            except OSError:
                return time.thread_time()
        worked, waited, _ = os.pread(self._file, 100, 0).split()  # in nanoseconds
        return (int(worked) + int(waited)) * 1e-9

    def close(self) -> None:
        """Nobody asks any more."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
