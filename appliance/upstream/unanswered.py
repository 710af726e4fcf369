"""Topic filters upon which a broker closes the connection in place of an answer: pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

#: After so many of these ends in a row, filters are asked for one at a time.
CLOSED_ON_SOME: Final = 2

#: After so many ends on a filter, with proof, it is left out.
CLOSED_ON_ONE: Final = 2

#: Seconds for which a filter is left out, the first time and at most: it doubles, because asking
#: for it again ends the connection again if nothing has changed.
LEFT_OUT_FOR: Final = 3600.0
LONGEST_LEFT_OUT: Final = 86_400.0

#: Seconds that a connection lives without a filter before it is asked for: if it ends then, the
#: filter is the reason.
LIVED: Final = 5.0


class UnansweredFilters:
    """Finds the filter that ends the connections to one server, so that a link works without it.

    RabbitMQ answers so to a login that may not subscribe to a filter, where others refuse it. But a
    broker that is just starting closes connections as well. So a filter is blamed only with proof:
    if another one was answered on the same connection, or the connection lived without this one. A
    filter that was asked for first is therefore asked for last on the next connection, and if all
    are such ones, only when the connection has lived for a while.
    """

    def __init__(self) -> None:
        self._closed = 0
        #: Filters that were asked for alone, first on a connection that ended then.
        self._suspects: set[str] = set()
        self._blamed: dict[str, int] = {}
        #: Filters that are left out: until when, and for how long this time.
        self._left_out: dict[str, tuple[float, float]] = {}

    @property
    def one_by_one(self) -> bool:
        """Whether to ask for one filter at a time."""
        return self._closed >= CLOSED_ON_SOME

    def ask(self, filters: Iterable[str]) -> list[str]:
        """The filters to ask for on a new connection, in order."""
        wanted = [each for each in filters if each not in self._left_out]
        fresh = [each for each in wanted if each not in self._suspects]
        return fresh + [each for each in wanted if each in self._suspects] if fresh else []

    def due(self, missing: Iterable[str], lived: float, now: float) -> list[str]:
        """Those of the missing filters to ask for on a connection that has lived for so long."""
        if lived < LIVED:
            return []
        return [each for each in missing if now >= self._left_out.get(each, (now, 0.0))[0]]

    def closed(
        self, filters: Sequence[str], now: float, answered: Iterable[str], *, lived: bool
    ) -> str | None:
        """The broker has closed the connection with these unanswered; one that is now left out.

        `answered` are those that it has answered on this connection; `lived` says that all that
        was asked for at its beginning was answered, or nothing was.
        """
        answered = list(answered)
        self._forget(answered)
        was_one_by_one = self.one_by_one
        self._closed += 1
        topic_filter = filters[0]
        if topic_filter in self._left_out:
            self._leave_out(topic_filter, now)
            return topic_filter
        if not was_one_by_one:
            return None
        if not answered and not lived:
            self._suspects.add(topic_filter)
            return None
        count = self._blamed[topic_filter] = self._blamed.get(topic_filter, 0) + 1
        if count < CLOSED_ON_ONE:
            return None
        self._leave_out(topic_filter, now)
        return topic_filter

    def _leave_out(self, topic_filter: str, now: float) -> None:
        _, before = self._left_out.get(topic_filter, (0.0, LEFT_OUT_FOR / 2))
        time = min(2 * before, LONGEST_LEFT_OUT)
        self._forget([topic_filter])
        self._left_out[topic_filter] = now + time, time

    def _forget(self, answered: Iterable[str]) -> None:
        for topic_filter in answered:
            self._suspects.discard(topic_filter)
            self._blamed.pop(topic_filter, None)
            self._left_out.pop(topic_filter, None)

    def answered(self, filters: Iterable[str]) -> None:
        """The broker has answered all that it was asked for on a connection, these filters."""
        self._forget(filters)
        if not self._suspects:
            self._closed = 0
            self._blamed.clear()
