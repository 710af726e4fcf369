"""The backlogs of links to other brokers that end with the process: the port `Backlogs` in memory.

`durability: off` uses them, and tests of what uses a backlog.
"""

from __future__ import annotations

import itertools
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter

from appliance.broker.backlogs import SEGMENT_SIZE, RecordsRead, Segment
from appliance.store.link_backlogs import LinkBacklogs

#: Calls the function in a later round of the event loop.
Soon = Callable[[Callable[[], None]], object]


class MemoryJournal:
    """A `Journal` in memory; `keys` are those of new segments."""

    def __init__(self, keys: Iterator[int], soon: Soon, now: Callable[[], float]) -> None:
        self.now = now
        self._keys = keys
        self._soon = soon
        self._segments: list[Segment] = []
        #: By the keys of the segments.
        self._records: dict[int, list[bytes]] = {}

    def segments(self) -> Sequence[Segment]:
        """See `Journal`."""
        return self._segments

    def append(self, record: bytes, *, awaited: bool = True) -> Segment:
        """See `Journal`; nothing is ever committed, so nobody waits."""
        now = self.now()
        segment = self._segments[-1] if self._segments else None
        if segment is None or segment.size + len(record) > SEGMENT_SIZE:
            segment = Segment(next(self._keys), 0, 0, 0, now, now)
            self._close_last()
            self._segments.append(segment)
            self._records[segment.key] = []
        self._records[segment.key].append(record)
        segment.count += 1
        segment.size += len(record)
        segment.last_at = now
        return segment

    def _close_last(self) -> None:
        """The last segment does not grow any more."""
        if self._segments and self._segments[-1].done == self._segments[-1].count:
            self.drop(self._segments[-1])

    def settle(self, segment: Segment, done: int) -> None:
        """See `Journal`."""
        if segment.key in self._records:
            segment.done = max(segment.done, done)
            if segment.done == segment.count and segment is not self._segments[-1]:
                self.drop(segment)

    def drop(self, segment: Segment) -> None:
        """See `Journal`."""
        if self._records.pop(segment.key, None) is not None:
            place = bisect_left(self._segments, segment.key, key=attrgetter("key"))
            del self._segments[place]

    def read(self, segment: Segment, callback: RecordsRead) -> None:
        """See `Journal`."""
        records = list(self._records.get(segment.key, ()))
        self._soon(lambda: callback(records))

    def release(self, segment: Segment) -> None:
        """See `Journal`; nothing is merged."""


class MemoryLatestRecords:
    """`LatestRecords` in memory."""

    def __init__(self, keys: Iterator[int]) -> None:
        self._keys = keys
        self._records: dict[int, bytes] = {}

    def load(self) -> list[tuple[int, bytes]]:
        """See `LatestRecords`."""
        return sorted(self._records.items())

    def put(self, key: int | None, record: bytes, *, awaited: bool = True) -> int:
        """See `LatestRecords`."""
        if key is None:
            key = next(self._keys)
        self._records[key] = record
        return key

    def remove(self, key: int) -> None:
        """See `LatestRecords`."""
        self._records.pop(key, None)


class MemorySingleRecords:
    """`SingleRecords` in memory."""

    def __init__(self, keys: Iterator[int], soon: Soon) -> None:
        self._keys = keys
        self._soon = soon
        self._records: dict[int, bytes] = {}

    def load(self) -> list[int]:
        """See `SingleRecords`."""
        return sorted(self._records)

    def put(self, record: bytes, *, awaited: bool = True) -> int:
        """See `SingleRecords`."""
        key = next(self._keys)
        self._records[key] = record
        return key

    def remove(self, key: int) -> None:
        """See `SingleRecords`."""
        self._records.pop(key, None)

    def read(self, key: int, callback: RecordsRead) -> None:
        """See `SingleRecords`."""
        record = self._records.get(key)
        records = [] if record is None else [record]
        self._soon(lambda: callback(records))


class MemoryBacklogs(LinkBacklogs[MemoryJournal, MemoryLatestRecords, MemorySingleRecords]):
    """`Backlogs` in memory; `soon` calls in a later round of the event loop."""

    failing = False
    unwritten = 0

    def __init__(self, soon: Soon, now: Callable[[], float]) -> None:
        super().__init__()
        self._soon = soon
        self._now = now
        self._keys = itertools.count(1)

    def _make_journal(self, link: str, lane: int) -> MemoryJournal:
        return MemoryJournal(self._keys, self._soon, self._now)

    def _make_single(self, link: str) -> MemorySingleRecords:
        return MemorySingleRecords(self._keys, self._soon)

    def _make_records(self, link: str, kind: int) -> MemoryLatestRecords:
        return MemoryLatestRecords(self._keys)
