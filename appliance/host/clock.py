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

#: Seconds after which half of what a `SpareClock` saw of the computer's load is forgotten, those
#: that a thread may wait for its turn on a computer that has time, and the least share of the
#: processor that is assumed for others.
OF_LATE: Final = 0.1
TURN_TAKES: Final = 0.0001
LEAST_SHARE: Final = 0.25


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


class SpareClock:
    """Seconds that a thread has left to the other programs of its computer, as far as it can tell.

    It left none while it worked, or was ready to and others had the processor. When it had to wait
    for the processor so did they: of the time in which it rested only the part they got counts.

    It is the thread of the first call. Where the system does not tell, only its work is taken off.
    """

    def __init__(self) -> None:
        self._file = -1
        self._last = (0.0, 0.0, 0.0, 0.0)
        # How much it worked and waited of late.
        self._worked = self._waited = 0.0
        self._ahead = 0.0  # what it worked and waited before the time came that it did so in
        self._sum = 0.0

    def __call__(self) -> float:
        """What it is now; by how much it grows is what it is for."""
        now = time.monotonic()
        if self._file < 0:
            try:
                self._file = os.open("/proc/thread-self/schedstat", os.O_RDONLY | os.O_CLOEXEC)
            except OSError:
                return now - time.thread_time()
        worked, waited, turns = os.pread(self._file, 100, 0).split()  # in nanoseconds
        return self.grow(now, int(worked) * 1e-9, int(waited) * 1e-9, float(turns))

    def grow(self, now: float, worked: float, waited: float, turns: float) -> float:
        """What it is at a time, in seconds as is what the thread worked and waited up to then.

        `turns` are the times that it was given the processor, each of which takes a moment. It
        never goes back.
        """
        before, self._last = self._last, (now, worked, waited, turns)
        if not before[0]:
            return 0.0
        seconds, worked, waited = now - before[0], worked - before[1], waited - before[2]
        fade = 0.5 ** (seconds / OF_LATE)
        self._worked = self._worked * fade + worked
        kept_waiting = max(waited - (turns - before[3]) * TURN_TAKES, 0.0)
        self._waited = self._waited * fade + kept_waiting
        # The share of the processor that a program gets of what it needs. A moment in which it got
        # all of it is assumed beside what was seen, which over a rest fades to less than that.
        free = self._worked + TURN_TAKES
        share = max(free / (free + self._waited), LEAST_SHARE)
        # The processor may be lost between the looks at the one clock and the other.
        rested = seconds - worked - waited - self._ahead
        self._ahead = max(-rested, 0.0)
        self._sum += max(rested, 0.0) * share
        return self._sum

    def close(self) -> None:
        """Nobody asks any more."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
