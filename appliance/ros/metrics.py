"""Metrics of a flow: counters, rates, latency."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field, fields, replace
from itertools import accumulate
from time import monotonic

#: The upper bounds of the latency histogram's buckets, in seconds; one more bucket is for the rest.
BOUNDS = (
    *(0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05),
    *(0.1, 0.2, 0.5, 1.0, 2.0, 5.0),
)


class Latency:
    """A histogram of latencies, in seconds."""

    __slots__ = ("counts", "total")

    def __init__(self) -> None:
        #: The count of each bucket of BOUNDS, and of the one above.
        self.counts = [0] * (len(BOUNDS) + 1)
        #: The sum of all latencies, in seconds.
        self.total = 0.0

    def observe(self, seconds: float) -> None:
        """Count a latency. A negative one, from a clock that is ahead of ours, counts as 0."""
        self.counts[bisect_left(BOUNDS, seconds)] += 1
        self.total += max(seconds, 0.0)

    def add(self, other: Latency) -> None:
        """Add the counts of another histogram."""
        self.counts = [one + more for one, more in zip(self.counts, other.counts, strict=True)]
        self.total += other.total

    def quantile(self, share: float) -> float | None:
        """The quantile in seconds, interpolated within its bucket; None without any latencies."""
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
class ReceiveCounters:
    """What is counted as messages come from ROS, or do not: on the ROS thread, too.

    `lost` messages were lost by ROS's middleware before they came here, as it reports; `throttled`
    ones exceeded the rate limit or the byte budget; `errors` could not be converted or published.
    """

    lost: int = 0
    throttled: int = 0
    errors: int = 0
    last_error: str | None = None
    #: By `monotonic()`.
    last_error_at: float = 0.0

    def note_error(self, problem: str) -> None:
        """Record the last error."""
        self.last_error = problem
        self.last_error_at = monotonic()


@dataclass(eq=False, slots=True)
class FlowCounters(ReceiveCounters):
    """The counters of one direction, from the start; `bytes` are payload on MQTT.

    `dropped` messages did not fit into the mailbox; `skipped` ones were not sent to a slow client,
    counted once for each such client. Of commands, `expired` ones came too late, `refused` ones
    violated the rules, `clamped` ones were published with other numbers; `stops` are stop messages
    that a route has published by itself. `latency` is of a sample of the messages, from the
    publisher's time stamp to the broker.
    """

    messages: int = 0
    bytes: int = 0
    dropped: int = 0
    skipped: int = 0
    expired: int = 0
    refused: int = 0
    clamped: int = 0
    stops: int = 0
    latency: Latency = field(default_factory=Latency)

    def with_received(self, other: ReceiveCounters) -> FlowCounters:
        """A copy, with what another thread has counted of the same messages."""
        last = self if self.last_error_at >= other.last_error_at else other
        return replace(
            self,
            lost=self.lost + other.lost,
            throttled=self.throttled + other.throttled,
            errors=self.errors + other.errors,
            last_error=last.last_error,
            last_error_at=last.last_error_at,
        )

    def add(self, other: FlowCounters) -> None:
        """Add the counts of others; their last error becomes the last one."""
        for item in fields(self):
            if item.type == "int":
                total = getattr(self, item.name) + getattr(other, item.name)
                setattr(self, item.name, total)
        self.last_error = other.last_error or self.last_error
        self.latency.add(other.latency)
