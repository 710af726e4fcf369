"""The computer's clocks. The wall clock cannot be trusted, as many robots' have no battery.

Such a computer starts in 1970, or at the time when it was last switched off, and learns the time
from the network minutes later, or never. So durations are measured with the monotonic clock
(`loop.time`). The wall clock is used only for what has a date: certificates, logs, and what
outlives a restart.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from datetime import datetime, timezone
from typing import Final

#: A clock before this date was not set. To be updated with releases.
RELEASED: Final = datetime(2026, 1, 1, tzinfo=timezone.utc)

#: A change of the wall clock by less than these seconds between two looks is NTP's, not a step.
NUDGE: Final = 2.0

#: Less than this, in seconds, is no sleep: the two clocks that tell it are read one by one.
SHORTEST_SLEEP: Final = 0.01

#: The half-life in seconds of the load that a `SpareClock` has seen; the seconds that a thread
#: waits for the processor at each turn on an idle computer; and the least share of the processor
#: that is assumed for other programs.
LOAD_HALF_LIFE: Final = 0.1
SWITCH_TIME: Final = 0.0001
LEAST_SHARE: Final = 0.25


def is_unset(now: datetime | None = None) -> bool:
    """Whether the wall clock, or the time given, is before this program was released."""
    return (now or datetime.now(timezone.utc)) < RELEASED


class StepWatch:
    """Detects that the wall clock was set, or that the computer slept."""

    def __init__(self, now: float, wall: Callable[[], float] = time.time) -> None:
        """`now` is the time of the monotonic clock, here and in `look`."""
        self._wall = wall
        self._ahead = wall() - now

    def look(self, now: float) -> float:
        """Seconds by which the wall clock was set since the last look; 0 for a small change."""
        ahead = self._wall() - now
        step, self._ahead = ahead - self._ahead, ahead
        return step if abs(step) >= NUDGE else 0.0


class SleepWatch:
    """Counts the seconds in which the computer slept: the monotonic clock stands still in sleep."""

    def __init__(self) -> None:
        # The most of several readings: one that came out low would make the next a sleep.
        self._first = self._slept = max(_asleep() for _ in range(5))

    def seconds(self) -> float:
        """Seconds of sleep since this was made; the same number until there was more."""
        slept = _asleep()
        if slept > self._slept + SHORTEST_SLEEP:
            self._slept = slept
        return self._slept - self._first


def _asleep() -> float:
    """Seconds of sleep since the computer was started, or less."""
    # In this order a thread that loses the processor in between sees no sleep.
    started = time.clock_gettime(time.CLOCK_BOOTTIME)
    return started - time.monotonic()


class SpareClock:
    """A clock that counts the processor time that a thread has left to other programs, in seconds.

    It leaves none while it runs, or is ready to run and waits for the processor. When it has to
    wait, so do others: of the time in which it rested, only the share that they got counts.

    It is the thread of the first call. Without `/proc/thread-self/schedstat`, only the time in
    which it runs is subtracted.
    """

    def __init__(self) -> None:
        self._file = -1
        self._last = (0.0, 0.0, 0.0, 0.0)
        # How long it ran and waited recently.
        self._worked = self._waited = 0.0
        self._ahead = 0.0  # run and wait time that is ahead of the monotonic clock
        self._sum = 0.0

    def __call__(self) -> float:
        """The clock now; only differences have a meaning."""
        now = time.monotonic()
        if self._file < 0:
            try:
                self._file = os.open("/proc/thread-self/schedstat", os.O_RDONLY | os.O_CLOEXEC)
            except OSError:
                return now - time.thread_time()
        worked, waited, turns = os.pread(self._file, 100, 0).split()  # in nanoseconds
        return self.grow(now, int(worked) * 1e-9, int(waited) * 1e-9, float(turns))

    def grow(self, now: float, worked: float, waited: float, turns: float) -> float:
        """The clock at `now`, by the seconds that the thread ran and waited up to then.

        `turns` counts how often it was given the processor, each of which takes a moment. The clock
        never goes back.
        """
        before, self._last = self._last, (now, worked, waited, turns)
        if not before[0]:
            return 0.0
        seconds, worked, waited = now - before[0], worked - before[1], waited - before[2]
        fade = 0.5 ** (seconds / LOAD_HALF_LIFE)
        self._worked = self._worked * fade + worked
        delayed = max(waited - (turns - before[3]) * SWITCH_TIME, 0.0)
        self._waited = self._waited * fade + delayed
        # The share of the processor that a program gets of what it needs. A moment of full share is
        # added to what was seen, so that the estimate returns to it as the history fades.
        free = self._worked + SWITCH_TIME
        share = max(free / (free + self._waited), LEAST_SHARE)
        # The thread may lose the processor between the readings of the two clocks.
        rested = seconds - worked - waited - self._ahead
        self._ahead = max(-rested, 0.0)
        self._sum += max(rested, 0.0) * share
        return self._sum

    def close(self) -> None:
        """Close the file that is read."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
