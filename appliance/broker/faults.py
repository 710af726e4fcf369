"""Containment of internal errors: an exception ends what it occurred in, and nothing else.

Each point where work enters from outside is an *entry* and has a name: a received chunk, a turn, a
timer, a commit, a batch from ROS, a command. It catches the exception, ends the one client, call,
will, route or timer that was served, passes the exception to `Faults.caught`, and in any case
schedules the next work. Callbacks of the event loop are contained by `appliance.net.callbacks`,
others by `Faults.run`, or by their own `try` where another call would cost too much.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from appliance.broker.rate_limited_log import RateLimitedLog

log = logging.getLogger(__name__)

T = TypeVar("T")

#: Places in the code whose first error is logged in full; further places are rate limited.
PLACES = 64

#: The limit of characters that are logged of the served object and of the error: both may contain
#: a client's text.
LONGEST = 200


class Faults:
    """Counts caught exceptions, logs them with a rate limit, and has crash reports written.

    `report` writes a report and returns its path, or None; it is called once for each place in the
    code, and may limit the number of reports itself.
    """

    def __init__(self, rate_limited_log: RateLimitedLog | None = None) -> None:
        #: Seconds of the broker's clock.
        self.now = 0.0
        #: The number of exceptions since the start: in all, and by entry.
        self.count = 0
        self.by_entry: dict[str, int] = {}
        #: The last exception, as a text; empty while there was none.
        self.last = ""
        #: The last report that was written.
        self.reported = ""
        self.report: Callable[[BaseException, str], object] = _no_report
        self._rate_limited_log = rate_limited_log or RateLimitedLog()
        self._places: set[str] = set()

    def caught(self, entry: str, error: BaseException, served: object = "") -> None:
        """Count and log an exception at an entry, which occurred for `served`; never raises."""
        self.count += 1
        self.by_entry[entry] = self.by_entry.get(entry, 0) + 1
        what = f"a fault in the appliance ({entry})"
        try:
            name = str(served)[:LONGEST]
            what += f" while it served {name}" if name else ""
            self.last = f"{what}: {_words(error)}"
            self._log(entry, error, what)
        except Exception:  # an error in logging must not escape
            log.exception("%s, and it could not be logged", what)

    def _log(self, entry: str, error: BaseException, what: str) -> None:
        place = f"{entry} {type(error).__name__} {_place(error)}"
        if place in self._places or len(self._places) >= PLACES:
            self._rate_limited_log.warning(log, self.now, ("fault", entry), "%s", self.last)
            return
        self._places.add(place)
        written = self.report(error, what)
        ended = "that alone is ended, all else goes on"
        if written:
            self.reported = str(written)
            log.error("%s; %s. The report is %s", self.last, ended, written)
        else:
            log.error("%s; %s", self.last, ended, exc_info=error)

    def run(self, entry: str, work: Callable[..., T], *args: object, otherwise: T) -> T:
        """Return the result of `work`; if it raises, catch that and return `otherwise`."""
        try:
            return work(*args)
        except Exception as error:
            self.caught(entry, error)
            return otherwise


def _no_report(error: BaseException, what: str) -> object:
    return None


def _words(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"[:LONGEST]


def _place(error: BaseException) -> str:
    """The file and line where it was raised."""
    trace = error.__traceback__
    if trace is None:
        return ""
    while trace.tb_next is not None:
        trace = trace.tb_next
    return f"{trace.tb_frame.f_code.co_filename}:{trace.tb_lineno}"
