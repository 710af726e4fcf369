"""`Backlogs` as plain lists that can be committed and lost: the slow twin of the store's."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable, Sequence

from appliance.broker.backlogs import RecordsLostError, RecordsRead, Segment


class PlainJournal:
    """A `Journal`: its segments and, by key, their records."""

    def __init__(self, owner: PlainBacklogs) -> None:
        self.owner = owner
        self.list: list[Segment] = []
        self.records: dict[int, list[bytes]] = {}
        self.held: set[int] = set()
        self.growing: Segment | None = None

    def now(self) -> float:
        return self.owner.time

    def segments(self) -> Sequence[Segment]:
        return self.list

    def append(self, record: bytes, *, awaited: bool = True) -> Segment:
        owner = self.owner
        last = self.growing
        if last is None or last.size + len(record) > owner.segment_size:
            self.end()
            last = self.growing = Segment(owner.key(), 0, 0, 0, owner.time, owner.time)
            self.list.append(last)
            self.records[last.key] = []
        self.records[last.key].append(record)
        self.held.add(last.key)
        last.count += 1
        last.size += len(record)
        last.last_at = owner.time
        return last

    def end(self) -> None:
        """The last segment does not grow any more."""
        last, self.growing = self.growing, None
        if last is not None and last.done == last.count:
            self.drop(last)

    def settle(self, segment: Segment, done: int) -> None:
        if segment in self.list:
            assert segment.done <= done <= segment.count
            segment.done = done
            if done == segment.count and segment is not self.growing:
                self.drop(segment)

    def drop(self, segment: Segment) -> None:
        if segment in self.list:
            self.list.remove(segment)
            del self.records[segment.key]
            self.held.discard(segment.key)
            if segment is self.growing:
                self.growing = None

    def read(self, segment: Segment, callback: RecordsRead) -> None:
        self.owner.reads += 1
        if segment in self.list:
            self.held.add(segment.key)
        records = list(self.records.get(segment.key, ()))
        outcome = self.owner.failures.popleft() if self.owner.failures else records
        if isinstance(outcome, RecordsLostError):
            self.drop(segment)
        self.owner.rounds.append(lambda: callback(outcome))

    def release(self, segment: Segment) -> None:
        self.held.discard(segment.key)

    def merge(self) -> None:
        """Merge neighbours that are not held."""
        place = 0
        while place + 1 < len(self.list):
            one, other = self.list[place : place + 2]
            pair = {one.key, other.key}
            if pair & self.held or one.done or other.done or other is self.growing:
                place += 1
                continue
            count, size = one.count + other.count, one.size + other.size
            self.list[place : place + 2] = [
                Segment(one.key, count, size, 0, one.first_at, other.last_at)
            ]
            self.records[one.key] += self.records.pop(other.key)


class PlainRecords:
    """A `LatestRecords`."""

    def __init__(self, owner: PlainBacklogs) -> None:
        self.owner = owner
        self.rows: dict[int, bytes] = {}

    def load(self) -> list[tuple[int, bytes]]:
        return sorted(self.rows.items())

    def put(self, key: int | None, record: bytes, *, awaited: bool = True) -> int:
        if key is None:
            key = self.owner.key()
        self.rows[key] = record
        return key

    def remove(self, key: int) -> None:
        self.rows.pop(key, None)


class PlainSingle(PlainRecords):
    """A `SingleRecords`."""

    def load(self) -> list[int]:  # type: ignore[override]
        return sorted(self.rows)

    def put(self, record: bytes, *, awaited: bool = True) -> int:  # type: ignore[override]
        return super().put(None, record)

    def read(self, key: int, callback: RecordsRead) -> None:
        self.owner.reads += 1
        records = [self.rows[key]] if key in self.rows else []
        outcome = self.owner.failures.popleft() if self.owner.failures else records
        self.owner.rounds.append(lambda: callback(outcome))


class PlainBacklogs:
    """A `Backlogs` of one link. `rounds` are the next ones of the event loop."""

    def __init__(self, segment_size: int = 256 * 1024) -> None:
        self.segment_size = segment_size
        self.failing = False
        self.unwritten = 0
        self.time = 1000.0
        self.keys = 0
        self.reads = 0
        self.rounds: deque[Callable[[], None]] = deque()
        #: What the next reads give instead of records.
        self.failures: deque[Exception] = deque()
        self.journals: dict[int, PlainJournal] = {}
        self.latest_records = PlainRecords(self)
        self.aside_records = PlainRecords(self)
        self.single_records = PlainSingle(self)
        self.disk = self.snapshot()

    def key(self) -> int:
        self.keys += 1
        return self.keys

    def journal(self, link: str, lane: int) -> PlainJournal:
        return self.journals.setdefault(lane, PlainJournal(self))

    def latest(self, link: str) -> PlainRecords:
        return self.latest_records

    def aside(self, link: str) -> PlainRecords:
        return self.aside_records

    def single(self, link: str) -> PlainSingle:
        return self.single_records

    def links(self) -> list[str]:
        raise NotImplementedError

    def forget(self, link: str) -> None:
        raise NotImplementedError

    def turn(self) -> None:
        """Run the rounds of the event loop until there are none."""
        while self.rounds:
            self.rounds.popleft()()

    def snapshot(self) -> object:
        journals = {
            lane: [(copy.copy(each), list(journal.records[each.key])) for each in journal.list]
            for lane, journal in self.journals.items()
        }
        records = self.latest_records, self.aside_records, self.single_records
        return journals, tuple(dict(each.rows) for each in records)

    def commit(self) -> None:
        """What was staged is on disk, and segments end."""
        for journal in self.journals.values():
            journal.end()
        self.disk = self.snapshot()

    def restarted(self) -> PlainBacklogs:
        """What a process finds that starts after a kill."""
        again = PlainBacklogs(self.segment_size)
        again.time = self.time
        again.keys = self.keys
        journals, (latest, aside, single) = copy.deepcopy(self.disk)  # type: ignore[misc]
        for lane, segments in journals.items():
            journal = again.journal("", lane)
            journal.list = [segment for segment, _ in segments]
            journal.records = {segment.key: records for segment, records in segments}
        again.latest_records.rows = latest
        again.aside_records.rows = aside
        again.single_records.rows = single
        again.disk = again.snapshot()
        return again
