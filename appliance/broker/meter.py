"""Rates of counters that are read about once a second."""

from __future__ import annotations

from collections import deque

#: A rate is the mean over so many seconds.
RATE_WINDOW = 5.0


class Meter:
    """Messages and bytes per second, as the mean over RATE_WINDOW."""

    __slots__ = ("_points",)

    def __init__(self) -> None:
        self._points: deque[tuple[float, int, int]] = deque()

    def tick(self, now: float, messages: int, size: int = 0) -> None:
        """Record the counters; called about once a second."""
        points = self._points
        points.append((now, messages, size))
        while len(points) > 2 and points[1][0] <= now - RATE_WINDOW:
            points.popleft()

    @property
    def rates(self) -> tuple[float, float]:
        """Messages per second, and bytes per second."""
        if len(self._points) < 2:
            return 0.0, 0.0
        (then, messages, size), (now, more, larger) = self._points[0], self._points[-1]
        seconds = now - then
        return (more - messages) / seconds, (larger - size) / seconds
