"""The journals of links to other brokers, in the transactions of the store.

The records that a batch appends to a journal are one row of the table `backlog`, a *segment*. What
is known of it without the records is a row of `segment`; that table alone is read at the start, and
changes when records are settled.

At a low rate a segment has few records. While they only wait, neighbours are read again and written
as one segment. A record is rewritten once at most.
"""

from __future__ import annotations

import logging
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from functools import partial
from operator import attrgetter

from appliance.broker.backlogs import SEGMENT_SIZE, RecordsLostError, RecordsRead, Segment
from appliance.store.clock import StoreClock
from appliance.store.committer import Committer
from appliance.store.reader import Reader
from appliance.store.records import UnwrittenSegment, damaged_row
from appliance.store.rows import Table
from appliance.store.writer import Batch

log = logging.getLogger("appliance.store")

#: Bytes of records below which a segment is merged with its neighbours.
SMALL = 64 * 1024

#: Bytes of neighbours that are merged at once. With the last of them the new segment has less than
#: `SEGMENT_SIZE`, and is never merged again.
MERGED = SEGMENT_SIZE - SMALL

#: Segments that are looked at for a merge after one commit: a millisecond's work.
LOOKED_AT = 1000

#: Attempts to read a segment where the disk reports an error, before its records count as lost.
ATTEMPTS = 3

_key = attrgetter("key")


class StoredJournal:
    """A `Journal` in the database; `segments` are those that it has there."""

    def __init__(
        self,
        link: str,
        lane: int,
        segments: list[Segment],
        committer: Committer,
        reader: Reader,
        clock: StoreClock,
    ) -> None:
        self.now = clock.now
        self._link = link
        self._lane = lane
        self._committer = committer
        self._reader = reader
        self._segments = segments
        #: The records of segments that are not committed, by their keys.
        self._uncommitted: dict[int, list[bytes]] = {}
        #: The batches that they are in, in the order of the batches, with their keys.
        self._committing: deque[tuple[int, int]] = deque()
        #: The segment that grows, and its records: the last one of the open batch.
        self._last: Segment | None = None
        self._records: list[bytes] = []
        #: What the open batch will have of this journal, when it is sealed.
        self._is_sealed = True
        self._appended: dict[int, Segment] = {}
        self._changed: dict[int, Segment] = {}
        #: The keys of segments whose records the user has, and failed attempts to read them.
        self._held: set[int] = set()
        self._attempts: dict[int, int] = {}
        #: Neighbours to be merged, and their bytes; the last segment that was looked at for that.
        self._run: list[Segment] = []
        self._run_size = 0
        self._looked_at = 0
        self._is_merging = False

    def segments(self) -> Sequence[Segment]:
        """See `Journal`."""
        return self._segments

    # --- changes -------------------------------------------------------------------------------

    def append(self, record: bytes, *, awaited: bool = True) -> Segment:
        """See `Journal`."""
        now = self.now()
        segment = self._last
        size = len(record)
        if segment is None or segment.size + size > SEGMENT_SIZE:
            segment = self._begin(now)
        self._records.append(record)
        self._committer.open.bytes += size
        self._held.add(segment.key)
        segment.count += 1
        segment.size += size
        segment.last_at = now
        if awaited:
            self._committer.stage()
        else:
            self._committer.stage_lazily()
        return segment

    def _begin(self, now: float) -> Segment:
        self._end_last()
        key = next(self._committer.keys)
        segment = self._last = Segment(key, 0, 0, 0, now, now)
        self._records = self._uncommitted[key] = []
        self._segments.append(segment)
        self._appended[key] = segment
        self._touch()
        return segment

    def _end_last(self) -> None:
        """The last segment does not grow any more."""
        last, self._last = self._last, None
        if last is not None and last.done >= last.count:
            place = self._place(last)
            assert place is not None
            self._remove(place)

    def _touch(self) -> None:
        """The open batch changes something of this journal."""
        if self._is_sealed:
            self._is_sealed = False
            self._committer.open.sealers.append(self._seal)

    def settle(self, segment: Segment, done: int) -> None:
        """See `Journal`."""
        place = self._place(segment)
        if place is None or done <= segment.done:
            return
        segment.done = done
        if done >= segment.count and segment is not self._last:
            self._remove(place)
        elif segment.key not in self._appended:
            self._changed[segment.key] = segment
            self._touch()
        self._committer.stage_lazily()

    def drop(self, segment: Segment) -> None:
        """See `Journal`."""
        place = self._place(segment)
        if place is not None:
            self._remove(place)
            self._committer.stage_lazily()

    def release(self, segment: Segment) -> None:
        """See `Journal`."""
        if segment.key in self._held and self._place(segment) is not None:
            self._held.discard(segment.key)
            if segment.key <= self._looked_at:
                self._look_again(segment.key)

    def _place(self, segment: Segment) -> int | None:
        """The segment's index in the list, most often the first; None when it is not there."""
        segments = self._segments
        if segments and segments[0] is segment:
            return 0
        place = bisect_left(segments, segment.key, key=_key)
        if place < len(segments) and segments[place] is segment:
            return place
        return None

    def _remove(self, place: int) -> None:
        """Delete a segment and its records."""
        segment = self._segments.pop(place)
        key = segment.key
        batch = self._committer.open
        if key in self._appended:
            batch.bytes -= segment.size
        batch.remove(Table.SEGMENT, key)
        batch.remove_records(key)
        self._forget(key)
        if segment is self._last:
            self._last = None

    def _forget(self, key: int) -> None:
        self._uncommitted.pop(key, None)
        self._appended.pop(key, None)
        self._changed.pop(key, None)
        self._held.discard(key)
        self._attempts.pop(key, None)

    # --- commits -------------------------------------------------------------------------------

    def _seal(self, batch: Batch) -> None:
        """Put the rows of what was appended and settled into the batch, which is handed over."""
        self._end_last()
        for key, segment in self._appended.items():
            records = self._uncommitted[key]
            moments = segment.first_at, segment.last_at
            batch.segments[key] = UnwrittenSegment(key, self._link, self._lane, *moments, records)
            batch.messages += segment.count
            self._committing.append((batch.number, key))
            self._put_row(batch, segment)
        for segment in self._changed.values():
            self._put_row(batch, segment)
        self._appended.clear()
        self._changed.clear()
        self._is_sealed = True

    def _put_row(self, batch: Batch, segment: Segment) -> None:
        own = segment.key, self._link, self._lane, segment.count, segment.size, segment.done
        batch.put(Table.SEGMENT, segment.key, (*own, segment.first_at, segment.last_at))

    def committed(self, number: int) -> None:
        """Batches up to this one are committed: free their records, and merge what is small."""
        committing = self._committing
        while committing and committing[0][0] <= number:
            self._uncommitted.pop(committing.popleft()[1], None)
        if not self._is_merging:
            self._look()

    # --- reading -------------------------------------------------------------------------------

    def read(self, segment: Segment, callback: RecordsRead) -> None:
        """See `Journal`."""
        key = segment.key
        records = self._uncommitted.get(key)
        if self._place(segment) is None:
            self._reader.pass_on([], callback)
        elif records is not None:
            self._held.add(key)
            self._reader.pass_on(list(records), callback)
        else:
            self._held.add(key)
            self._reader.read([key], partial(self._was_read, segment, callback))

    def _was_read(
        self, segment: Segment, callback: RecordsRead, outcome: list[bytes] | Exception
    ) -> None:
        if self._place(segment) is None:  # it was dropped meanwhile
            outcome = []
        elif isinstance(outcome, list) and len(outcome) != segment.count:
            outcome = RecordsLostError("some are missing")
        elif isinstance(outcome, Exception) and "disk I/O error" in str(outcome):
            attempts = self._attempts[segment.key] = self._attempts.get(segment.key, 0) + 1
            if attempts >= ATTEMPTS:
                outcome = RecordsLostError(str(outcome))
        if isinstance(outcome, RecordsLostError):
            self._lose(segment, outcome)
        callback(outcome)

    def _lose(self, segment: Segment, error: RecordsLostError) -> None:
        """Report damaged records and give them up.

        They are not deleted: pages that they refer to may be those of other rows. The next start
        checks the whole database.
        """
        log.error(
            "%s IS DAMAGED: %d messages for %s cannot be read and are lost (%s). The next start "
            "checks the whole file",
            self._committer.path,
            segment.count - segment.done,
            self._link,
            error,
        )
        place = self._place(segment)
        assert place is not None
        del self._segments[place]
        self._forget(segment.key)
        self._committer.open.put(Table.SEGMENT, segment.key, damaged_row(segment.key))
        self._committer.stage_lazily()

    # --- merging -------------------------------------------------------------------------------

    def _may_be_merged(self, segment: Segment) -> bool:
        return segment.size < SMALL and not segment.done and segment.key not in self._held

    def _look_again(self, key: int) -> None:
        """Look at the segments from this one on again."""
        self._run.clear()
        self._run_size = 0
        self._looked_at = key - 1

    def _look(self) -> None:
        """Look at segments since the last time, and merge neighbours that are small."""
        first = bisect_left(self._segments, self._looked_at + 1, key=_key)
        for segment in self._segments[first : first + LOOKED_AT]:
            # The last one is in use until the next one is there.
            if segment.key in self._uncommitted or segment is self._segments[-1]:
                return
            self._looked_at = segment.key
            if self._may_be_merged(segment):
                self._run.append(segment)
                self._run_size += segment.size
            else:
                self._run.clear()
                self._run_size = 0
            if self._run_size >= MERGED:
                run, self._run, self._run_size = self._run, [], 0
                self._is_merging = True
                self._reader.read([each.key for each in run], partial(self._merge, run))
                return

    def _merge(self, run: list[Segment], outcome: list[bytes] | Exception) -> None:
        """Replace neighbours, whose records were read, by one segment."""
        self._is_merging = False
        if isinstance(outcome, Exception) or len(outcome) != sum(each.count for each in run):
            return  # it is reported when they are read to be sent
        first = self._place(run[0])
        if first is None or self._segments[first : first + len(run)] != run:
            return  # some were dropped: those before them are next
        if not all(map(self._may_be_merged, run)):
            return  # they are being sent
        key = run[0].key
        size = sum(each.size for each in run)
        merged = Segment(key, len(outcome), size, 0, run[0].first_at, run[-1].last_at)
        batch = self._committer.open
        for each in run:
            batch.remove(Table.SEGMENT, each.key)
            batch.remove_records(each.key)
            self._forget(each.key)
        self._segments[first : first + len(run)] = [merged]
        self._uncommitted[key] = outcome
        self._appended[key] = merged
        batch.bytes += size
        self._touch()
        self._committer.stage_lazily()
