"""Batches of changes, and the one thread that writes them."""

from __future__ import annotations

import queue
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import TypeAlias, TypeVar

from appliance.store.schema import (
    Durability,
    Row,
    Table,
    connect,
    delete,
    insert,
    roll_back,
)

#: Rows that one statement writes: the fewer statements the quicker, and each lets go of Python's
#: lock and takes it again, for which it may wait as long as the event loop is busy.
_CHUNKS = (64, 32, 16, 8, 4, 2, 1)

_Item = TypeVar("_Item")


class Batch:
    """Changes that are committed together: rows as they shall be, and keys of those to be deleted.

    A row that is made and deleted inside one batch leaves no trace. `first_id` is the first key
    that is given out in the batch: rows from there on are in no database yet.
    """

    __slots__ = ("deleted", "first_id", "messages", "number", "rows")

    def __init__(self, number: int, first_id: int) -> None:
        self.number = number
        self.first_id = first_id
        self.rows: list[dict[int, Row]] = [{} for _ in Table]
        self.deleted: list[dict[int, None]] = [{} for _ in Table]
        #: Messages that were staged, those among them that are gone again included.
        self.messages = 0

    def __bool__(self) -> bool:
        return any(self.rows) or any(self.deleted)

    def __len__(self) -> int:
        return sum(map(len, self.rows)) + sum(map(len, self.deleted))

    def put(self, table: Table, key: int, row: Row) -> None:
        """Make the row, or change it."""
        self.rows[table][key] = row

    def remove(self, table: Table, key: int) -> None:
        """Delete the row."""
        self.rows[table].pop(key, None)
        if key < self.first_id:
            self.deleted[table][key] = None

    def absorb(self, newer: Batch) -> None:
        """Take in a later batch, as this one could not be written before it."""
        for table in Table:
            for key in newer.deleted[table]:
                self.remove(table, key)
            self.rows[table].update(newer.rows[table])
        self.number = newer.number
        self.messages += newer.messages


#: Told on the writer's thread of each batch: the error, if any, and the seconds that it took.
Done: TypeAlias = "Callable[[Batch, Exception | None, float], None]"


class Writer:
    """Writes one batch after the other, each in one transaction, on a thread of its own."""

    def __init__(self, path: Path, durability: Durability, done: Done) -> None:
        self._path = path
        self._durability = durability
        self._done = done
        self._batches: queue.SimpleQueue[Batch | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="store", daemon=True)
        self._connection: sqlite3.Connection | None = None

    def start(self, connection: sqlite3.Connection | None) -> None:
        """Begin, with the connection that the database was read with, if it could be opened."""
        self._connection = connection
        self._thread.start()

    def write(self, batch: Batch) -> None:
        """Write the batch as soon as those before it are done with."""
        self._batches.put(batch)

    def stop(self) -> None:
        """Write what was handed over, and end; returns when that is done."""
        self._batches.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (batch := self._batches.get()) is not None:
            began = time.perf_counter()
            error: Exception | None = None
            try:
                self._write(batch)
            except Exception as problem:  # whatever it is, the thread has to go on
                error = problem
                # What is wrong may be the file that was opened: the next attempt opens it anew.
                self._close()
            self._done(batch, error, time.perf_counter() - began)
        self._close()

    def _write(self, batch: Batch) -> None:
        if self._connection is None:
            self._connection = connect(self._path, self._durability)
        write(self._connection, batch)

    def _close(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            roll_back(connection)
            connection.close()


def write(connection: sqlite3.Connection, batch: Batch) -> None:
    """Write a batch in one transaction. Raises sqlite3.Error, with the transaction not ended."""
    if not connection.in_transaction:  # as it is when the tables are an older appliance's
        connection.execute("BEGIN IMMEDIATE")
    for table in Table:
        for keys in _chunks(list(batch.deleted[table])):
            connection.execute(delete(table, len(keys)), keys)
        for rows in _chunks(list(batch.rows[table].values())):
            connection.execute(insert(table, len(rows)), list(chain.from_iterable(rows)))
    connection.execute("COMMIT")


def _chunks(items: list[_Item]) -> Iterator[list[_Item]]:
    """In portions of few sizes, so that there are few different statements."""
    start = 0
    for size in _CHUNKS:
        while len(items) - start >= size:
            yield items[start : start + size]
            start += size
