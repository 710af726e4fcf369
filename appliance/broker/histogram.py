"""Histograms of durations, whose buckets are those of the metrics."""

from __future__ import annotations

from bisect import bisect_left
from itertools import accumulate
from typing import Final

#: The upper bounds of the buckets, in seconds; one more bucket is for the rest. Its type has no
#: length: compiled code takes a final tuple of so many floats for one that is not set (mypyc 2).
BOUNDS: Final[tuple[float, ...]] = (
    *(0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05),
    *(0.1, 0.2, 0.5, 1.0, 2.0, 5.0),
)


class Histogram:
    """Durations in seconds, counted by bucket."""

    __slots__ = ("counts", "total")

    def __init__(self) -> None:
        #: The count of each bucket of BOUNDS, and of the one above.
        self.counts = [0] * (len(BOUNDS) + 1)
        #: The sum of all durations, in seconds.
        self.total = 0.0

    def observe(self, seconds: float) -> None:
        """Count a duration. A negative one, from a clock that is ahead of ours, counts as 0."""
        self.counts[bisect_left(BOUNDS, seconds)] += 1
        self.total += max(seconds, 0.0)

    def add(self, other: Histogram) -> None:
        """Add the counts of another histogram."""
        self.counts = [one + more for one, more in zip(self.counts, other.counts, strict=True)]
        self.total += other.total

    def quantile(self, share: float) -> float | None:
        """The quantile in seconds, interpolated within its bucket; None without any durations."""
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
