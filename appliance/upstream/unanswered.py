"""Topic filters upon which a broker closes the connection in place of an answer: pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

#: After so many of these ends in a row, filters are asked for one at a time.
CLOSED_ON_SOME: Final = 2

#: After so many ends on a filter that was asked for alone it is left out, for so many seconds.
CLOSED_ON_ONE: Final = 3
LEFT_OUT_FOR: Final = 3600.0


class UnansweredFilters:
    """Finds the filter that ends the connection, so that a link works without it.

    RabbitMQ answers so to a login that may not subscribe to a filter, where others refuse it.
    """

    def __init__(self) -> None:
        self._closed = 0
        self._closed_on: dict[str, int] = {}
        self._left_out: dict[str, float] = {}

    @property
    def one_by_one(self) -> bool:
        """Whether to ask for one filter at a time."""
        return self._closed >= CLOSED_ON_SOME

    def left_out(self, now: float) -> list[str]:
        """The filters that are not to be asked for."""
        for topic_filter, since in list(self._left_out.items()):
            if now - since >= LEFT_OUT_FOR:
                del self._left_out[topic_filter]
        return list(self._left_out)

    def closed(self, filters: Sequence[str], now: float) -> str | None:
        """The broker has closed the connection with these unanswered; one that is now left out."""
        self._closed += 1
        if len(filters) != 1:
            return None
        (topic_filter,) = filters
        count = self._closed_on[topic_filter] = self._closed_on.get(topic_filter, 0) + 1
        if count < CLOSED_ON_ONE:
            return None
        self._left_out[topic_filter] = now
        self.answered()
        return topic_filter

    def answered(self) -> None:
        """The broker has answered all that it was asked for."""
        self._closed = 0
        self._closed_on.clear()
