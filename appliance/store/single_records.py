"""The records of links that are read one by one, each a segment of its own in the database.

So their rows, checksums, loading and salvage are those of journals. Unlike segments of a journal
they are not merged, and the order of their keys means nothing.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable
from functools import partial

from appliance.broker.backlogs import RecordsLostError, RecordsRead, Segment
from appliance.store.clock import StoreClock
from appliance.store.committer import Committer
from appliance.store.reader import Reader
from appliance.store.records import UnwrittenSegment, damaged_row
from appliance.store.rows import SINGLE_LANE, Table

log = logging.getLogger("appliance.store")


class StoredSingleRecords:
    """A `SingleRecords` in the database; `segments` are those that it has there."""

    def __init__(
        self,
        link: str,
        segments: Iterable[Segment],
        committer: Committer,
        reader: Reader,
        clock: StoreClock,
    ) -> None:
        self._link = link
        self._committer = committer
        self._reader = reader
        self._clock = clock
        self._keys = {segment.key for segment in segments}
        #: The records that are not committed, by their keys, and the batches that they are in.
        self._uncommitted: dict[int, bytes] = {}
        self._committing: deque[tuple[int, int]] = deque()

    def load(self) -> list[int]:
        """See `SingleRecords`."""
        return sorted(self._keys)

    def put(self, record: bytes, *, awaited: bool = True) -> int:
        """See `SingleRecords`."""
        committer = self._committer
        key = next(committer.keys)
        now = self._clock.now()
        batch = committer.open
        batch.segments[key] = UnwrittenSegment(key, self._link, SINGLE_LANE, now, now, [record])
        batch.put(Table.SEGMENT, key, (key, self._link, SINGLE_LANE, 1, len(record), 0, now, now))
        batch.messages += 1
        batch.bytes += len(record)
        self._keys.add(key)
        self._uncommitted[key] = record
        self._committing.append((batch.number, key))
        if awaited:
            committer.stage()
        else:
            committer.stage_lazily()
        return key

    def remove(self, key: int) -> None:
        """See `SingleRecords`."""
        if key in self._keys:
            self._keys.remove(key)
            record = self._uncommitted.pop(key, None)
            batch = self._committer.open
            if record is not None and key in batch.segments:
                batch.bytes -= len(record)
            batch.remove(Table.SEGMENT, key)
            batch.remove_records(key)
            self._committer.stage_lazily()

    def committed(self, number: int) -> None:
        """Batches up to this one are committed: free their records."""
        committing = self._committing
        while committing and committing[0][0] <= number:
            self._uncommitted.pop(committing.popleft()[1], None)

    def read(self, key: int, callback: RecordsRead) -> None:
        """See `SingleRecords`."""
        record = self._uncommitted.get(key)
        if record is not None:
            self._reader.pass_on([record], callback)
        elif key not in self._keys:
            self._reader.pass_on([], callback)
        else:
            self._reader.read([key], partial(self._was_read, key, callback))

    def _was_read(self, key: int, callback: RecordsRead, outcome: list[bytes] | Exception) -> None:
        if key not in self._keys:  # it was removed meanwhile
            outcome = []
        elif isinstance(outcome, list) and len(outcome) != 1:
            outcome = RecordsLostError("not one record")
        if isinstance(outcome, RecordsLostError):
            # As in a journal: not deleted, and the next start checks the whole database.
            log.error(
                "%s IS DAMAGED: a message for %s cannot be read and is lost (%s). The next start "
                "checks the whole file",
                self._committer.path,
                self._link,
                outcome,
            )
            self._keys.discard(key)
            self._committer.open.put(Table.SEGMENT, key, damaged_row(key))
            self._committer.stage_lazily()
        callback(outcome)
