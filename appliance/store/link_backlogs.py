"""What both kinds of the port `Backlogs` share: which journal and which records are whose."""

from __future__ import annotations

from typing import Generic, TypeVar

from appliance.broker.backlogs import NO_MESSAGE, Journal, LatestRecords, SingleRecords
from appliance.store.rows import LATEST, SET_ASIDE

AnyJournal = TypeVar("AnyJournal", bound=Journal)
AnyRecords = TypeVar("AnyRecords", bound=LatestRecords)
AnySingle = TypeVar("AnySingle", bound=SingleRecords)


class LinkBacklogs(Generic[AnyJournal, AnyRecords, AnySingle]):
    """The journals and records of all links; each is made when it is first asked for."""

    def __init__(self) -> None:
        self._journals: dict[tuple[str, int], AnyJournal] = {}
        self._records: dict[tuple[str, int], AnyRecords] = {}
        self._single: dict[str, AnySingle] = {}

    def _make_journal(self, link: str, lane: int) -> AnyJournal:
        raise NotImplementedError

    def _make_records(self, link: str, kind: int) -> AnyRecords:
        """`kind` is LATEST or SET_ASIDE."""
        raise NotImplementedError

    def _make_single(self, link: str) -> AnySingle:
        raise NotImplementedError

    def journal(self, link: str, lane: int) -> AnyJournal:
        """See `Backlogs`."""
        found = self._journals.get((link, lane))
        if found is None:
            found = self._journals[link, lane] = self._make_journal(link, lane)
        return found

    def records(self, link: str, kind: int) -> AnyRecords:
        """`latest` or `aside`."""
        found = self._records.get((link, kind))
        if found is None:
            found = self._records[link, kind] = self._make_records(link, kind)
        return found

    def latest(self, link: str) -> AnyRecords:
        """See `Backlogs`."""
        return self.records(link, LATEST)

    def single(self, link: str) -> AnySingle:
        """See `Backlogs`."""
        found = self._single.get(link)
        if found is None:
            found = self._single[link] = self._make_single(link)
        return found

    def aside(self, link: str) -> AnyRecords:
        """See `Backlogs`."""
        return self.records(link, SET_ASIDE)

    def waiting_links(self) -> list[str]:
        """See `Backlogs`."""
        names = {
            link
            for (link, _), journal in self._journals.items()
            if any(segment.done < segment.count for segment in journal.segments())
        }
        names |= {
            link
            for (link, kind), records in self._records.items()
            if kind == LATEST and any(row[:1] != NO_MESSAGE for _, row in records.load())
        }
        names |= {link for link, records in self._single.items() if records.load()}
        return sorted(names)

    def forget(self, link: str) -> None:
        """See `Backlogs`."""
        for (name, _), journal in self._journals.items():
            if name == link:
                for segment in list(journal.segments()):
                    journal.drop(segment)
        for records in (self.latest(link), self.aside(link)):
            for key, _ in records.load():
                records.remove(key)
        single = self.single(link)
        for key in single.load():
            single.remove(key)
