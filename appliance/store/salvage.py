"""What can be read of a damaged database, which is not changed.

The rows that are read at the start go into memory. The records of backlogs, of which there may be a
gigabyte, go from one database into another.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import cast

from appliance.store.records import split
from appliance.store.rows import LOADED, BacklogRow, Rows, SegmentRow, Table
from appliance.store.schema import (
    DamagedError,
    connect,
    insert,
    is_damage,
    read_table,
    roll_back,
)

log = logging.getLogger("appliance.store")

#: Bytes of records that are copied in one transaction.
_COPIED = 4 << 20

_UNREADABLE = (sqlite3.Error, UnicodeError, OverflowError, DamagedError)


def salvage(path: Path) -> Rows:
    """All rows of the tables in `LOADED` that can be read."""
    rows = Rows()
    for with_log in (True, False):
        with contextlib.suppress(*_UNREADABLE), _opened(path, with_log=with_log) as connection:
            for table in LOADED:
                # From both ends, up to the damage.
                for order in ("ASC", "DESC"):
                    with contextlib.suppress(*_UNREADABLE):
                        for key, row in read_table(connection, table, f"ORDER BY id {order}"):
                            rows.of(table).setdefault(key, row)
        if any(map(rows.of, LOADED)):
            break  # reading it without its log as well would mix in an older state
    return rows


@contextlib.contextmanager
def _opened(path: Path, *, with_log: bool) -> Iterator[sqlite3.Connection]:
    """The database to be read, most often in its place. Raises sqlite3.Error."""
    log_file = path.with_name(f"{path.name}-wal")
    with contextlib.ExitStack() as stack:
        if not (with_log and log_file.exists()):
            # Without the log, SQLite makes no index to it, and takes the file as it is.
            yield stack.enter_context(_connected(path, "mode=ro&immutable=1"))
            return
        stack.callback(path.with_name(f"{path.name}-shm").unlink, missing_ok=True)
        try:
            connection = stack.enter_context(_connected(path, "mode=ro"))
            connection.execute("SELECT name FROM sqlite_master").fetchone()
        except sqlite3.OperationalError as error:
            if is_damage(error):
                raise
            # There is no room for the index, or the folder is read-only.
            directory = stack.enter_context(tempfile.TemporaryDirectory(prefix="appliance-store-"))
            copy = Path(directory) / path.name
            with contextlib.suppress(OSError):
                shutil.copyfile(path, copy)
                shutil.copyfile(log_file, copy.with_name(log_file.name))
            connection = stack.enter_context(_connected(copy, "mode=rw"))
        yield connection


@contextlib.contextmanager
def _connected(path: Path, mode: str) -> Iterator[sqlite3.Connection]:
    connection = sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True)
    with contextlib.closing(connection):
        with contextlib.suppress(sqlite3.Error):  # so that damaged cells are not taken for rows
            connection.execute("PRAGMA cell_size_check = ON")
        yield connection


def salvage_backlog(path: Path, rows: Rows, beside: Path) -> int:
    """Copy the intact records of backlogs into a new database; returns how many segments are lost.

    `rows.segment` becomes what there is then; without any there is no new database. A segment whose
    row is lost is restored from its records, and sent again from its beginning.
    """
    known, rows.segment = rows.segment, {}
    _remove(beside)
    expected = {key for key, row in known.items() if row.length != 0}
    for with_log in (True, False):
        with contextlib.suppress(*_UNREADABLE), _opened(path, with_log=with_log) as connection:
            keys = sorted({*_keys(connection), *known})
            if keys:
                _copy(connection, keys, known, rows, beside)
        if rows.segment:
            break
    if not rows.segment:
        _remove(beside)
    return len(expected - rows.segment.keys())


def _remove(database: Path) -> None:
    """Remove what an attempt has left behind, or one that was killed."""
    for suffix in ("", "-journal", "-wal", "-shm"):
        database.with_name(database.name + suffix).unlink(missing_ok=True)


def _keys(connection: sqlite3.Connection) -> set[int]:
    keys: set[int] = set()
    for order in ("ASC", "DESC"):
        with contextlib.suppress(*_UNREADABLE):
            for (key,) in connection.execute(f"SELECT id FROM backlog ORDER BY id {order}"):
                keys.add(key)
    return keys


def _copy(
    damaged: sqlite3.Connection,
    keys: list[int],
    known: dict[int, SegmentRow],
    rows: Rows,
    beside: Path,
) -> None:
    """Copy the segments with these keys that are intact, for as long as the disk has room."""
    with contextlib.closing(connect(beside)) as new:
        # It is renamed when it is complete: until then nothing has to survive.
        new.execute("PRAGMA journal_mode = DELETE")
        new.execute("PRAGMA synchronous = OFF")
        try:
            copied: dict[int, SegmentRow] = {}
            size = 0
            for key in keys:
                found = _segment(damaged, key, known.get(key))
                if found is None:
                    continue
                segment, row = found
                if not new.in_transaction:
                    new.execute("BEGIN")
                new.execute(insert(Table.BACKLOG, 1), row)
                new.execute(insert(Table.SEGMENT, 1), segment)
                copied[key] = segment
                size += len(cast(bytes, row.records))
                if size >= _COPIED:
                    new.execute("COMMIT")
                    rows.segment.update(copied)
                    copied, size = {}, 0
            if new.in_transaction:
                new.execute("COMMIT")
            rows.segment.update(copied)
        except sqlite3.Error as error:
            roll_back(new)
            log.error("not all of the backlogs can be copied: %s", error)
    with beside.open("rb") as file:
        os.fsync(file.fileno())


def _segment(
    damaged: sqlite3.Connection, key: int, known: SegmentRow | None
) -> tuple[SegmentRow, BacklogRow] | None:
    """The rows of a segment; None when it is damaged."""
    columns = ",".join(BacklogRow._fields)
    try:
        found = damaged.execute(f"SELECT {columns} FROM backlog WHERE id = ?", (key,)).fetchone()
        row = BacklogRow(*found)
        length, records = cast(int, row.length), cast(bytes, row.records)
        size = sum(map(len, split(length, records, cast(int, row.checksum))))
    except (*_UNREADABLE, TypeError, ValueError):
        return None
    done = 0
    if known is not None and isinstance(known.done, int) and 0 <= known.done <= length:
        done = known.done
    own = key, row.link, row.lane, length, size, done
    return SegmentRow(*own, row.first_at, row.last_at), row
