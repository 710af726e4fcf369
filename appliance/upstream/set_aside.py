"""Messages that the fleet's broker never took: they are kept for the user, and shown."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from struct import Struct, error
from typing import Final

from appliance.broker.backlogs import LatestRecords
from appliance.upstream.records import Record

#: The most that are kept of a link, and their bytes on disk. The oldest of the rule that has most
#: make room: where the fleet's broker refuses what one rule sends, the others' stay.
MOST_ASIDE: Final = 1000
ASIDE_SIZE: Final = 16 << 20

#: Characters of a reason.
_LONGEST_REASON: Final = 500

#: When it was set aside, and the length of the reason; reason and record follow.
_HEADER: Final = Struct(">dH")


@dataclass(frozen=True, slots=True)
class SetAside:
    """A message that was set aside: when, in seconds of the journals' clock, and why.

    `size` is that of its payload in bytes, `stored` of all that is stored of it.
    """

    rule: str
    topic: str
    size: int
    reason: str
    at: float
    stored: int


class AsideRecords:
    """The messages of a link that were set aside: what they are is in memory, they are on disk."""

    def __init__(self, records: LatestRecords) -> None:
        self._records = records
        self._found: dict[int, SetAside] = {}
        self._size = 0
        #: By rule: those of it, the oldest first, and their bytes.
        self._of_rule: dict[str, dict[int, None]] = {}
        self._size_of: Counter[str] = Counter()
        #: By rule and topic, those of them that count only as long as they are the latest. After a
        #: restart it is not known which do.
        self._latest: dict[tuple[str, str], int] = {}
        for key, row in records.load():
            try:
                self._note(key, _decode(row))
            except ValueError:
                records.remove(key)
        self._limit()

    def __len__(self) -> int:
        return len(self._found)

    def add(self, record: Record, reason: str, now: float, *, is_latest: bool = False) -> None:
        """Keep a message. One that `is_latest` of its topic replaces the one before it."""
        name = record.rule, record.topic
        if is_latest and name in self._latest:
            self._forget(self._latest[name])
        text = reason[:_LONGEST_REASON].encode(errors="replace")
        row = _HEADER.pack(now, len(text)) + text + record.encode()
        key = self._records.put(None, row, awaited=False)
        self._note(key, _decode(row))
        if is_latest:
            self._latest[name] = key
        self._limit()

    def _note(self, key: int, found: SetAside) -> None:
        self._found[key] = found
        self._size += found.stored
        self._of_rule.setdefault(found.rule, {})[key] = None
        self._size_of[found.rule] += found.stored

    def _limit(self) -> None:
        found = self._found
        while len(found) > MOST_ASIDE:
            self._forget_one_of(max(self._of_rule, key=lambda rule: len(self._of_rule[rule])))
        while self._size > ASIDE_SIZE and len(found) > 1:
            self._forget_one_of(max(self._of_rule, key=self._size_of.__getitem__))

    def _forget_one_of(self, rule: str) -> None:
        """The oldest of the rule, or of all where it has only the newest of all."""
        key = next(iter(self._of_rule[rule]))
        self._forget(key if key != next(reversed(self._found)) else next(iter(self._found)))

    def _forget(self, key: int) -> None:
        found = self._found.pop(key)
        self._size -= found.stored
        of_rule = self._of_rule[found.rule]
        del of_rule[key]
        self._size_of[found.rule] -= found.stored
        if not of_rule:
            del self._of_rule[found.rule], self._size_of[found.rule]
        name = found.rule, found.topic
        if self._latest.get(name) == key:
            del self._latest[name]
        self._records.remove(key)

    def list(self) -> list[SetAside]:
        """All of them, the oldest first."""
        return list(self._found.values())


def _decode(row: bytes) -> SetAside:
    """What a row contains. Raises ValueError."""
    try:
        at, length = _HEADER.unpack_from(row)
    except error as short:
        raise ValueError(str(short)) from short
    start = _HEADER.size + length
    record = Record.decode(row[start:])
    reason = row[_HEADER.size : start].decode()
    return SetAside(record.rule, record.topic, len(record.payload), reason, at, len(row))
