"""Log lines about what clients do wrong: as many as a reader needs, not as many as a flood has."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass

log = logging.getLogger(__name__)

#: Lines about the same thing that are logged in one interval, and its seconds.
BURST = 5
INTERVAL = 10.0

#: Things that are told apart; of more, those that were heard of least recently are forgotten.
REMEMBERED = 1024


@dataclass(slots=True)
class _Heard:
    since: float
    told: int = 0
    untold: int = 0
    last: str = ""


class RateLimitedLog:
    """Passes warnings on to the log, and counts those of one key that are too many.

    What was left out is told as a number when the interval is over.
    """

    def __init__(self) -> None:
        self._heard: OrderedDict[Hashable, _Heard] = OrderedDict()

    def tell(
        self, now: float, key: Hashable, message: str, *args: object, burst: int = BURST
    ) -> None:
        """Log a warning, unless there were `burst` of them with this key in the last seconds."""
        heard = self._heard.get(key)
        if heard is None or now - heard.since >= INTERVAL:
            if heard is not None:
                self._tell_untold(heard)
            heard = self._heard[key] = _Heard(now)
            if len(self._heard) > REMEMBERED:
                self._tell_untold(self._heard.popitem(last=False)[1])
        self._heard.move_to_end(key)
        if heard.told < burst:
            heard.told += 1
            log.warning(message, *args)
        else:
            heard.untold += 1
            heard.last = message % args

    def tick(self, now: float) -> None:
        """Tell what was left out in intervals that are over."""
        for key, heard in list(self._heard.items()):
            if now - heard.since >= INTERVAL:
                self._tell_untold(heard)
                del self._heard[key]

    def _tell_untold(self, heard: _Heard) -> None:
        if heard.untold:
            log.warning("%d more of this kind, the last: %s", heard.untold, heard.last)
