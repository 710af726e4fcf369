"""Batches of changes, and the thread that writes them to the database."""

from __future__ import annotations

import queue
import sqlite3
import threading
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import TypeAlias, TypeVar

from appliance.store.records import UnwrittenSegment, damaged_row
from appliance.store.rows import Row, Table
from appliance.store.schema import (
    Durability,
    connect,
    delete,
    insert,
    is_lost,
    roll_back,
)

#: Numbers of rows that one statement writes. Fewer statements are faster: each releases Python's
#: global lock, and may wait to acquire it again for as long as the event loop is busy.
_CHUNKS = (64, 32, 16, 8, 4, 2, 1)

_Item = TypeVar("_Item")


class Batch:
    """Changes that are committed together: rows to write, and keys of rows to delete.

    A row that is written and deleted within one batch leaves no trace. `first_id` is the first key
    that was given out for the batch: rows from there on are in no database yet.
    """

    __slots__ = (
        "bytes",
        "deleted",
        "first_id",
        "has_dependents",
        "is_awaited",
        "is_changed",
        "messages",
        "number",
        "rows",
        "sealers",
        "segments",
    )

    def __init__(self, number: int, first_id: int) -> None:
        self.number = number
        self.first_id = first_id
        self.rows: list[dict[int, Row]] = [{} for _ in Table]
        self.deleted: list[dict[int, None]] = [{} for _ in Table]
        #: Segments of backlogs whose records are to be written, by their keys.
        self.segments: dict[int, UnwrittenSegment] = {}
        #: Put the last rows into the batch, when it is handed over.
        self.sealers: list[Callable[[Batch], None]] = []
        #: Messages that were staged, including those that were deleted again; of what links keep,
        #: also the bytes.
        self.messages = 0
        self.bytes = 0
        #: Something was staged, beside what the start itself has changed.
        self.is_changed = False
        #: Packets may depend on it: they are sent when it is committed.
        self.has_dependents = False
        #: Somebody waits for its commit.
        self.is_awaited = False

    def __bool__(self) -> bool:
        return any(self.rows) or any(self.deleted) or bool(self.sealers)

    def __len__(self) -> int:
        return sum(map(len, self.rows)) + sum(map(len, self.deleted)) + len(self.segments)

    def put(self, table: Table, key: int, row: Row) -> None:
        """Create the row, or replace it."""
        self.rows[table][key] = row

    def remove(self, table: Table, key: int) -> None:
        """Delete the row."""
        self.rows[table].pop(key, None)
        if key < self.first_id:
            self.deleted[table][key] = None

    def remove_records(self, key: int) -> None:
        """Delete the records of a segment."""
        self.segments.pop(key, None)
        self.remove(Table.BACKLOG, key)

    def seal(self) -> None:
        """Complete the batch before it is handed over; nothing is put into it afterwards."""
        sealers, self.sealers = self.sealers, []
        for seal in sealers:
            seal(self)

    def absorb(self, newer: Batch) -> None:
        """Take over the changes of a later batch, because this one could not be written first."""
        for table in Table:
            for key in newer.deleted[table]:
                self.remove(table, key)
            self.rows[table].update(newer.rows[table])
        for key in newer.deleted[Table.BACKLOG]:
            self.segments.pop(key, None)
        self.segments.update(newer.segments)
        self.number = newer.number
        self.messages += newer.messages
        self.bytes += newer.bytes


#: Called on the writer's thread after each batch, with the error, if any.
Written: TypeAlias = "Callable[[Batch, Exception | None], None]"


class Writer:
    """Writes one batch after the other, each in one transaction, on a thread of its own."""

    def __init__(self, path: Path, durability: Durability, written: Written) -> None:
        self._path = path
        self._durability = durability
        self._written = written
        self._batches: queue.SimpleQueue[Batch | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="store", daemon=True)
        self._connection: sqlite3.Connection | None = None

    def start(self, connection: sqlite3.Connection | None) -> None:
        """Start the thread, with the connection that has read the database, if there is one."""
        self._connection = connection
        self._thread.start()

    def write(self, batch: Batch) -> None:
        """Write the batch after those before it."""
        self._batches.put(batch)

    def stop(self) -> None:
        """End the thread after the batches that it was given; blocks until then."""
        self._batches.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (batch := self._batches.get()) is not None:
            error: Exception | None = None
            try:
                self._write(batch)
            except Exception as problem:  # whatever it is, the thread has to continue
                error = problem
                # The open file may be the reason, so the next attempt opens it again.
                self._close()
            self._written(batch, error)
        self._close()

    def _write(self, batch: Batch) -> None:
        if self._connection is None:
            self._connection = connect(self._path, self._durability)
        try:
            write(self._connection, batch)
        except sqlite3.Error as error:
            if not batch.deleted[Table.BACKLOG] or not is_lost(error):
                raise
            roll_back(self._connection)
            _spare_damaged(self._connection, batch)
            write(self._connection, batch)

    def _close(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            roll_back(connection)
            connection.close()


def write(connection: sqlite3.Connection, batch: Batch) -> None:
    """Write a batch in one transaction. Raises sqlite3.Error, with the transaction still open."""
    if not connection.in_transaction:  # the migration of an older appliance's tables began one
        connection.execute("BEGIN IMMEDIATE")
    for table in Table:
        for keys in _chunks(list(batch.deleted[table])):
            connection.execute(delete(table, len(keys)), keys)
        for rows in _chunks(list(batch.rows[table].values())):
            connection.execute(insert(table, len(rows)), list(chain.from_iterable(rows)))
    for segment in batch.segments.values():
        connection.execute(insert(Table.BACKLOG, 1), segment.row())
    connection.execute("COMMIT")


def _spare_damaged(connection: sqlite3.Connection, batch: Batch) -> None:
    """Leave records there that cannot be read, because they cannot be deleted either.

    Their segments are marked as damaged. Raises sqlite3.Error.
    """
    for key in list(batch.deleted[Table.BACKLOG]):
        try:
            connection.execute("SELECT records FROM backlog WHERE id = ?", (key,)).fetchall()
        except sqlite3.Error as error:
            if not is_lost(error):
                raise
            del batch.deleted[Table.BACKLOG][key]
            batch.deleted[Table.SEGMENT].pop(key, None)
            batch.put(Table.SEGMENT, key, damaged_row(key))


def _chunks(items: list[_Item]) -> Iterator[list[_Item]]:
    """Chunks of few different sizes, so that there are few different statements."""
    start = 0
    for size in _CHUNKS:
        while len(items) - start >= size:
            yield items[start : start + size]
            start += size
