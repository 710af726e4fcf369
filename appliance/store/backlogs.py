"""The port `Backlogs` in the database: the journals and the latest records of all links."""

from __future__ import annotations

from appliance.net.callbacks import Entries
from appliance.store.clock import StoreClock
from appliance.store.committer import Committer
from appliance.store.journal import StoredJournal
from appliance.store.link_backlogs import LinkBacklogs
from appliance.store.loader import LoadedBacklogs
from appliance.store.reader import Reader
from appliance.store.rows import SINGLE_LANE, Table
from appliance.store.single_records import StoredSingleRecords


class StoredLatestRecords:
    """`LatestRecords` in the database; `records` are those that it has there."""

    def __init__(
        self, link: str, kind: int, records: dict[int, bytes], committer: Committer
    ) -> None:
        self._link = link
        self._kind = kind
        self._records = records
        self._committer = committer

    def load(self) -> list[tuple[int, bytes]]:
        """See `LatestRecords`."""
        return sorted(self._records.items())

    def put(self, key: int | None, record: bytes, *, awaited: bool = True) -> int:
        """See `LatestRecords`."""
        committer = self._committer
        if key is None:
            key = next(committer.keys)
        self._records[key] = record
        committer.open.put(Table.LATEST, key, (key, self._link, self._kind, record))
        if awaited:
            committer.stage()
        else:
            committer.stage_lazily()
        return key

    def remove(self, key: int) -> None:
        """See `LatestRecords`."""
        if self._records.pop(key, None) is not None:
            self._committer.open.remove(Table.LATEST, key)
            self._committer.stage_lazily()


class StoredBacklogs(LinkBacklogs[StoredJournal, StoredLatestRecords, StoredSingleRecords]):
    """`Backlogs` in the database of the committer."""

    def __init__(self, committer: Committer, clock: StoreClock) -> None:
        super().__init__()
        self._committer = committer
        self._clock = clock
        self._reader: Reader | None = None
        self._loaded = LoadedBacklogs()

    def restore(self, loaded: LoadedBacklogs, entries: Entries) -> None:
        """Take over what is in the database, before anything is committed."""
        self._reader = Reader(self._committer.path, entries)
        self._committer.after_commit = self._committed
        self._loaded = loaded
        for link, lane in loaded.segments:
            if lane == SINGLE_LANE:
                self.single(link)
            else:
                self.journal(link, lane)
        for link, kind in loaded.records:
            self.records(link, kind)

    async def stop_reading(self) -> None:
        """Read nothing any more; may be called twice, and before `restore`."""
        if self._reader is not None:
            await self._reader.stop()

    def _committed(self, number: int) -> None:
        for journal in self._journals.values():
            journal.committed(number)
        for single in self._single.values():
            single.committed(number)

    @property
    def failing(self) -> bool:
        """See `Backlogs`."""
        return self._committer.failing

    @property
    def unwritten(self) -> int:
        """See `Backlogs`."""
        return self._committer.unwritten

    def _make_journal(self, link: str, lane: int) -> StoredJournal:
        assert self._reader is not None, "not before `restore`"
        segments = self._loaded.segments.get((link, lane), [])
        return StoredJournal(link, lane, segments, self._committer, self._reader, self._clock)

    def _make_single(self, link: str) -> StoredSingleRecords:
        assert self._reader is not None, "not before `restore`"
        segments = self._loaded.segments.get((link, SINGLE_LANE), [])
        return StoredSingleRecords(link, segments, self._committer, self._reader, self._clock)

    def _make_records(self, link: str, kind: int) -> StoredLatestRecords:
        records = self._loaded.records.get((link, kind), {})
        return StoredLatestRecords(link, kind, records, self._committer)
