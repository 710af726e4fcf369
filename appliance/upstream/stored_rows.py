"""The rows of a link in the table of latest records: how they are written, and read at the start.

The first byte says what a row is:

- the latest message of a topic: its record, or only its head and the key of the record, which is
  then stored by itself;
- one that was in memory alone when the link was stopped, and is so again: its record;
- a message that is to be tried again: its record;
- the numbers of the rules' journals.
"""

from __future__ import annotations

import json
import math
from collections.abc import Container, Iterable, Mapping
from struct import Struct
from typing import Final

from appliance.broker.backlogs import NO_MESSAGE
from appliance.upstream.latest_values import LatestValue
from appliance.upstream.records import Record, record_head

_LATEST: Final = b"L"
_SINGLE: Final = b"S"
_MEMORY: Final = b"M"
_LATER: Final = b"R"
_NUMBERS: Final = NO_MESSAGE

#: The key and the size of a record that is stored by itself; its head follows.
_SINGLE_HEADER: Final = Struct(">QI")


def latest_row(record: bytes) -> bytes:
    """The row of the latest message of a topic."""
    return _LATEST + record


def single_row(key: int, record: bytes) -> bytes:
    """The row of one whose record is stored by itself, under that key."""
    return _SINGLE + _SINGLE_HEADER.pack(key, len(record)) + record_head(record)


def memory_row(record: bytes) -> bytes:
    """The row of the latest message of a topic that was in memory alone until the link ended."""
    return _MEMORY + record


def later_row(record: bytes) -> bytes:
    """The row of a message that is to be tried again."""
    return _LATER + record


def numbers_row(numbers: Mapping[str, int]) -> bytes:
    """The row with the numbers of the rules' journals, by the rules' names."""
    return _NUMBERS + json.dumps(numbers).encode()


class StoredRows:
    """What the rows of a link contain; `single` are the keys of records stored by themselves."""

    def __init__(self, rows: Iterable[tuple[int, bytes]], single: Container[int]) -> None:
        #: By rule: the number of its journal; and the key of the row that says so.
        self.numbers: dict[str, int] = {}
        self.numbers_key: int | None = None
        #: To be tried again, in the order of publishing: the record, its bytes, its key.
        self.later: list[tuple[Record, int, int]] = []
        #: By rule and topic.
        self.values: dict[tuple[str, str], LatestValue] = {}
        #: The keys of rows whose values are in memory alone from now on.
        self.loaded: list[int] = []
        #: The keys of rows that cannot be used, and why.
        self.unreadable: list[tuple[int, str]] = []
        for key, row in rows:
            try:
                self._read(key, row, single)
            except ValueError as error:
                self.unreadable.append((key, str(error)))
        self.later.sort(key=lambda each: each[0].number)

    def _read(self, key: int, row: bytes, single: Container[int]) -> None:
        """Take over a row. Raises ValueError."""
        kind, data = row[:1], row[1:]
        if kind == _NUMBERS:
            self.numbers_key = key
            self.numbers = _decode_numbers(data)
            return
        if kind == _LATER:
            self.later.append((Record.decode(data), len(data), key))
            return
        if kind in (_LATEST, _MEMORY):
            own, size = None, len(data)
        elif kind == _SINGLE:
            if len(data) < _SINGLE_HEADER.size:
                raise ValueError("too short")
            own, size = _SINGLE_HEADER.unpack_from(data)
            data = data[_SINGLE_HEADER.size :]
        else:
            raise ValueError("of another version")
        record = Record.decode(data)
        if own is not None and own not in single:
            raise ValueError("the record of a row is missing")
        if (record.rule, record.topic) in self.values:
            # A rule's rows have one topic each, unless it was damaged.
            raise ValueError("a second row of a topic")
        expires = math.inf if record.expires_at is None else record.expires_at
        value = LatestValue(
            record.topic, record.number, record.qos, size, record.stored_at, expires
        )
        if kind == _MEMORY:
            self.loaded.append(key)
        else:
            value.key = key
        if own is None:
            value.data = data
        else:
            value.single = own
        self.values[record.rule, record.topic] = value


def _decode_numbers(data: bytes) -> dict[str, int]:
    """The numbers of the rules' journals. Raises ValueError."""
    numbers = json.loads(data)
    if not isinstance(numbers, dict) or not all(isinstance(each, int) for each in numbers.values()):
        raise ValueError("the table of rules is damaged")
    return numbers
