"""Faults of our own: whatever escapes while one client, call, will, route or timer is served.

Each place where work comes in from outside is an *entry* and has a name: a received chunk, a turn,
a timer, a commit, a batch from ROS, a command. It catches what escapes, ends the one thing that was
being served, hands the exception to `Faults.caught`, and sets up what comes next either way. What
the event loop calls back is contained by `appliance.net.callbacks`, the rest by `Faults.run`, or by
a `try` of its own where a call more would cost too much.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from appliance.broker.rate_limited_log import RateLimitedLog

log = logging.getLogger(__name__)

T = TypeVar("T")

#: Places that are told apart; faults in further ones are counted, and told as a flood is.
PLACES = 64

#: Characters that are told of what was served, and of what went wrong: both may be a stranger's.
LONGEST = 200


class Faults:
    """Counts what was caught, tells the log without a flood, and has reports written.

    `report` writes one and returns where it is, None when there is none; it is asked once for each
    place in the code, and it is its own affair how many there may be in all.
    """

    def __init__(self, rate_limited_log: RateLimitedLog | None = None) -> None:
        #: Seconds of the broker's clock.
        self.now = 0.0
        #: How many there were since the start; in all, and by entry.
        self.count = 0
        self.by_entry: dict[str, int] = {}
        #: The last one, in words: empty while there was none.
        self.last = ""
        #: The last report that was written.
        self.reported = ""
        self.report: Callable[[BaseException, str], object] = _no_report
        self._rate_limited_log = rate_limited_log or RateLimitedLog()
        self._places: set[str] = set()

    def caught(self, entry: str, error: BaseException, served: object = "") -> None:
        """Count and tell what escaped at the entry, while `served` was; never raises."""
        self.count += 1
        self.by_entry[entry] = self.by_entry.get(entry, 0) + 1
        what = f"a fault in the appliance ({entry})"
        try:
            name = str(served)[:LONGEST]
            what += f" while it served {name}" if name else ""
            self.last = f"{what}: {_words(error)}"
            self._log(entry, error, what)
        except Exception:  # to tell of a fault must not become one
            log.exception("%s, and it could not be told", what)

    def _log(self, entry: str, error: BaseException, what: str) -> None:
        place = f"{entry} {type(error).__name__} {_place(error)}"
        if place in self._places or len(self._places) >= PLACES:
            self._rate_limited_log.warning(self.now, ("fault", entry), "%s", self.last)
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
        """What `work` returns; `otherwise` when it fails, which is caught."""
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
    """Where in the code it was raised."""
    trace = error.__traceback__
    if trace is None:
        return ""
    while trace.tb_next is not None:
        trace = trace.tb_next
    return f"{trace.tb_frame.f_code.co_filename}:{trace.tb_lineno}"
