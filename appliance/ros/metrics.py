"""What a flow counts and measures of what it carries: counters, rates, latency."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field, fields
from itertools import accumulate

#: The upper bounds of the classes of latency, in seconds; one more class is for all above.
BOUNDS = (
    *(0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05),
    *(0.1, 0.2, 0.5, 1.0, 2.0, 5.0),
)

#: Seconds that a rate is the mean of.
RATE_WINDOW = 5.0


class Latency:
    """A histogram of seconds."""

    __slots__ = ("counts", "total")

    def __init__(self) -> None:
        #: How many were in each class of BOUNDS, and above all of them.
        self.counts = [0] * (len(BOUNDS) + 1)
        #: The sum of all, in seconds.
        self.total = 0.0

    def observe(self, seconds: float) -> None:
        """Count one. Less than nothing, from a clock that is ahead of ours, is nothing."""
        self.counts[bisect_left(BOUNDS, seconds)] += 1
        self.total += max(seconds, 0.0)

    def add(self, other: Latency) -> None:
        """Count all that the other has counted."""
        self.counts = [one + more for one, more in zip(self.counts, other.counts, strict=True)]
        self.total += other.total

    def quantile(self, share: float) -> float | None:
        """Seconds that so large a share took at the most, taken as even within a class."""
        wanted = share * sum(self.counts)
        if not wanted:
            return None
        sums = list(accumulate(self.counts))
        index = bisect_left(sums, wanted)
        if index == len(BOUNDS):
            return BOUNDS[-1]
        low = BOUNDS[index - 1] if index else 0.0
        before = sums[index] - self.counts[index]
        return low + (BOUNDS[index] - low) * (wanted - before) / self.counts[index]


@dataclass(eq=False, slots=True)
class FlowCounters:
    """What is counted in one direction, all from the start; `bytes` are payload on MQTT.

    `lost` are those that ROS's middleware says it lost before they came here, `dropped` did not fit
    into the mailbox, `throttled` were above the rate or the budget of bytes, `skipped` were not
    sent to a client that was slow, which counts once for each such client, `errors` could not be
    converted or published. Of commands, `expired` came too late, `refused` were against the rules,
    `clamped` went on with other numbers; `stops` are stop messages that a route published by
    itself. `latency` is of a sample of the messages, from the publisher's time stamp to the broker.
    """

    messages: int = 0
    bytes: int = 0
    lost: int = 0
    dropped: int = 0
    throttled: int = 0
    skipped: int = 0
    errors: int = 0
    expired: int = 0
    refused: int = 0
    clamped: int = 0
    stops: int = 0
    last_error: str | None = None
    latency: Latency = field(default_factory=Latency)

    def add(self, other: FlowCounters) -> None:
        """Count all that the other has counted; its last error is now the last."""
        for item in fields(self):
            if item.type == "int":
                total = getattr(self, item.name) + getattr(other, item.name)
                setattr(self, item.name, total)
        self.last_error = other.last_error or self.last_error
        self.latency.add(other.latency)


class Meter:
    """Messages and bytes a second, as the mean of the last RATE_WINDOW."""

    __slots__ = ("_points",)

    def __init__(self) -> None:
        self._points: deque[tuple[float, int, int]] = deque()

    def tick(self, now: float, messages: int, size: int) -> None:
        """Take in the counters, once a second or so."""
        points = self._points
        points.append((now, messages, size))
        while len(points) > 2 and points[1][0] <= now - RATE_WINDOW:
            points.popleft()

    @property
    def rates(self) -> tuple[float, float]:
        """Messages a second, and bytes a second."""
        if len(self._points) < 2:
            return 0.0, 0.0
        (then, messages, size), (now, more, larger) = self._points[0], self._points[-1]
        seconds = now - then
        return (more - messages) / seconds, (larger - size) / seconds
