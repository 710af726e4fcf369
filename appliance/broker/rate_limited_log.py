"""Rate limit for log lines that clients can cause: a flood of mistakes is not a flood of lines."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass

#: Lines that are logged for one key in one interval, and the length of an interval in seconds.
BURST = 5
INTERVAL = 10.0

#: Keys that are counted at the same time; above this the least recently used one is evicted.
MAXIMUM_KEYS = 1024

#: Characters that are kept of the last text of a key, and lines that one tick logs.
LONGEST = 500
LINES_PER_TICK = 64


@dataclass(slots=True)
class _Entry:
    """What was logged and suppressed for one key since the interval began."""

    since: float
    log: logging.Logger
    logged: int = 0
    suppressed: int = 0
    last: str = ""


class RateLimitedLog:
    """Logs warnings, at most BURST for a key in an interval.

    Suppressed warnings are counted; the count and the last text are logged when the interval ends.
    """

    def __init__(self) -> None:
        self._entries: OrderedDict[Hashable, _Entry] = OrderedDict()

    def warning(
        self,
        log: logging.Logger,
        now: float,
        key: Hashable,
        message: str,
        *args: object,
        burst: int = BURST,
    ) -> None:
        """Log a warning, unless `burst` warnings were logged for this key in this interval.

        `log` is the logger of the module that warns.
        """
        entry = self._entries.get(key)
        if entry is None or now - entry.since >= INTERVAL:
            if entry is not None:
                self._log_suppressed(entry)
            entry = self._entries[key] = _Entry(now, log)
            if len(self._entries) > MAXIMUM_KEYS:
                self._log_suppressed(self._entries.popitem(last=False)[1])
        self._entries.move_to_end(key)
        if entry.logged < burst:
            entry.logged += 1
            entry.log.warning(message, *args)
        else:
            entry.suppressed += 1
            entry.last = (message % args)[:LONGEST]

    def tick(self, now: float) -> None:
        """Log the counts of suppressed warnings of intervals that have ended; those that are more
        than a few lines are left to the next calls."""
        left = LINES_PER_TICK
        for key, entry in list(self._entries.items()):
            if now - entry.since >= INTERVAL:
                if entry.suppressed:
                    if not left:
                        break
                    left -= 1
                self._log_suppressed(entry)
                del self._entries[key]

    def _log_suppressed(self, entry: _Entry) -> None:
        if entry.suppressed:
            entry.log.warning("%d more of this kind, the last: %s", entry.suppressed, entry.last)
