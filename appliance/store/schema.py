"""The database's schema: tables, versions and migrations, and how the database is opened.

Every table has an integer key that is given out once and never again, by which rows refer to each
other. There are no indices and no foreign keys, because all rows are read at the start and are then
found in memory. Times are seconds of the store's own clock, see `clock`.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Literal, TypeAlias

from appliance.store.rows import COLUMNS, LOADED, ROW_TYPES, Row, Table, Value

Durability: TypeAlias = Literal["power", "process", "off"]


class StoreError(Exception):
    """The store cannot be used; the text says which file, why, and what to do."""


class DamagedError(Exception):
    """The database does not contain what was written to it."""


#: Parts of SQLite's messages that say that the file is damaged. The others are about its
#: surroundings: the disk is full or read-only, the file is locked.
_DAMAGE = ("malformed", "not a database", "no such table", "no such column", "corrupt")


def is_damage(error: Exception) -> bool:
    """Whether the error says that the database does not contain what was written to it."""
    return any(word in str(error) for word in _DAMAGE) or isinstance(error, UnicodeError)


def is_lost(error: Exception) -> bool:
    """Whether rows cannot be read: they were damaged, or the disk cannot read where they are."""
    return is_damage(error) or "disk I/O error" in str(error)


#: The script that makes each version out of the one before it.
MIGRATIONS: tuple[str, ...] = (
    """
    CREATE TABLE about (version INTEGER NOT NULL);
    INSERT INTO about VALUES (0);
    CREATE TABLE message (
        id INTEGER PRIMARY KEY,
        topic TEXT NOT NULL,
        payload BLOB NOT NULL,
        qos INTEGER NOT NULL,
        retain INTEGER NOT NULL,
        properties BLOB,          -- as in a packet, with their length; of a will with its expiry
        passed_on BLOB,           -- the same in the publisher's order, by older appliances
        expires_at REAL,
        stored_at REAL NOT NULL
    );
    CREATE TABLE session (
        id INTEGER PRIMARY KEY,
        client_id TEXT NOT NULL,
        username TEXT,            -- NULL for an anonymous one
        expiry INTEGER NOT NULL,  -- seconds; 0: kept for its will only
        ends_at REAL,             -- NULL while its client is connected
        will INTEGER,             -- a message
        will_delay INTEGER NOT NULL,
        will_at REAL
    );
    CREATE TABLE subscription (
        id INTEGER PRIMARY KEY,
        session INTEGER NOT NULL,
        filter TEXT NOT NULL,
        qos INTEGER NOT NULL,
        no_local INTEGER NOT NULL,
        retain_as_published INTEGER NOT NULL,
        retain_handling INTEGER NOT NULL,
        identifier INTEGER NOT NULL
    );
    CREATE TABLE owed (
        id INTEGER PRIMARY KEY,   -- in the order of queueing
        session INTEGER NOT NULL,
        message INTEGER,          -- NULL: PUBREC came, PUBREL is all that is left
        qos INTEGER NOT NULL,
        retain INTEGER NOT NULL,
        subscription_ids TEXT,    -- JSON
        share TEXT,               -- the filter of the shared subscription that chose the session
        packet_id INTEGER,        -- NULL while it waits
        sent INTEGER              -- in the order of sending: what is retained passes the queue
    );
    CREATE TABLE received (
        id INTEGER PRIMARY KEY,
        session INTEGER NOT NULL,
        packet_id INTEGER NOT NULL,
        message INTEGER NOT NULL,
        no_room TEXT              -- JSON: keys of sessions, and filters of shared subscriptions
    );
    CREATE TABLE retained (
        id INTEGER PRIMARY KEY,
        message INTEGER NOT NULL
    );
    """,
    """
    CREATE TABLE clock (          -- one row
        id INTEGER PRIMARY KEY,
        time REAL NOT NULL,       -- the store's, when the computer's clocks said:
        wall REAL NOT NULL,
        counted REAL NOT NULL,
        boot TEXT NOT NULL
    );
    """,
    """
    -- 1: the client has yet to be sent some of the retained messages that it subscribed to
    ALTER TABLE subscription ADD COLUMN replaying INTEGER NOT NULL DEFAULT 0;
    """,
    """
    -- whose client has published it: NULL for an anonymous one, as for all of an older appliance
    ALTER TABLE retained ADD COLUMN username TEXT;
    -- 1: the appliance itself has
    ALTER TABLE retained ADD COLUMN inside INTEGER NOT NULL DEFAULT 0;
    """,
    """
    CREATE TABLE segment (        -- of the journal of a link to another broker
        id INTEGER PRIMARY KEY,   -- in the order of the records
        link TEXT NOT NULL,
        lane INTEGER NOT NULL,
        length INTEGER NOT NULL,  -- records; 0: they were damaged
        size INTEGER NOT NULL,    -- bytes of the records
        done INTEGER NOT NULL,    -- records at the beginning that need not be sent
        first_at REAL NOT NULL,
        last_at REAL NOT NULL
    );
    CREATE TABLE backlog (        -- a segment's records, apart: segments are read without them
        id INTEGER PRIMARY KEY,   -- of the segment
        link TEXT NOT NULL,
        lane INTEGER NOT NULL,
        length INTEGER NOT NULL,
        first_at REAL NOT NULL,
        last_at REAL NOT NULL,
        checksum INTEGER NOT NULL,  -- CRC-32 of:
        records BLOB NOT NULL     -- their lengths, 4 bytes each, the lowest first; the records
    );
    CREATE TABLE latest (
        id INTEGER PRIMARY KEY,
        link TEXT NOT NULL,
        kind INTEGER NOT NULL,    -- 0: the latest of its topic; 1: it was set aside
        record BLOB NOT NULL
    );
    """,
    """
    -- messages a second of each topic; 0: any
    ALTER TABLE subscription ADD COLUMN max_rate REAL NOT NULL DEFAULT 0;
    """,
)

#: "MQTA" in the header of the database file, so that another program's database is not taken for
#: ours.
APPLICATION_ID = 0x4D515441

#: Pages of the write-ahead log after which SQLite moves it into the database: 4 MB. The log is then
#: overwritten from its beginning, which is faster than to let it grow.
CHECKPOINT_PAGES = 1000

#: Seconds to wait for another program that has the database locked, such as a backup.
BUSY_TIMEOUT = 5.0

_SYNCHRONOUS = {"power": "FULL", "process": "NORMAL"}


def connect(path: Path, durability: Durability = "power") -> sqlite3.Connection:
    """Open the database, or create it, so that only its user may read it.

    The database of an older appliance is then within a transaction, see `_migrate`.

    Raises:
        sqlite3.Error, OSError: it cannot be opened.
        DamagedError: it is a database, but not ours.
        StoreError: a newer appliance made it.
    """
    # SQLite would give the file, and those beside it, whatever mode the umask leaves.
    os.close(os.open(path, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600))
    connection = sqlite3.connect(
        path,
        timeout=BUSY_TIMEOUT,
        isolation_level=None,
        check_same_thread=False,
        cached_statements=256,
    )
    try:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute(f"PRAGMA synchronous = {_SYNCHRONOUS[durability]}")
        connection.execute(f"PRAGMA wal_autocheckpoint = {CHECKPOINT_PAGES}")
        connection.execute("PRAGMA temp_store = MEMORY")
        # Debian's SQLite is built to write zeros over all that is deleted, also in pages that it
        # would not write otherwise. With FAST it leaves those: what was there may stay in the file
        # until they are used again.
        connection.execute("PRAGMA secure_delete = FAST")
        _migrate(connection, path)
    except BaseException:
        connection.close()
        raise
    return connection


def connect_to_read(path: Path) -> sqlite3.Connection:
    """Open the database to read it, while the appliance may be running. Raises sqlite3.Error."""
    # Without `immutable` SQLite would create the log and its index beside a database that is not in
    # use, and leave them there.
    in_use = path.with_name(f"{path.name}-wal").exists()
    mode = "mode=ro" if in_use else "mode=ro&immutable=1"
    return sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True, timeout=BUSY_TIMEOUT)


def connect_beside(path: Path) -> sqlite3.Connection:
    """Open the database to read it beside the writer, who does not have to wait (WAL).

    Raises:
        sqlite3.Error: it cannot be opened.
    """
    return sqlite3.connect(
        f"{path.absolute().as_uri()}?mode=ro",
        uri=True,
        timeout=BUSY_TIMEOUT,
        isolation_level=None,
        check_same_thread=False,
    )


def _migrate(connection: sqlite3.Connection, path: Path) -> None:
    """Bring the tables up to date in a transaction that the first batch commits.

    So a start that fails leaves the database to the older appliance that replaces this one again.
    The tables of a new database are committed at once, so that it can be read before anything is
    written.
    """
    found = version(connection)
    if found > len(MIGRATIONS):
        raise StoreError(
            f"{path} was written by a newer appliance (version {found} of its tables, this one "
            f"knows {len(MIGRATIONS)}): install that one again, or move the file away"
        )
    if found == len(MIGRATIONS):
        return
    connection.execute("BEGIN IMMEDIATE")
    for script in MIGRATIONS[found:]:
        for statement in script.split(";\n"):
            connection.execute(statement)
    connection.execute("UPDATE about SET version = ?", (len(MIGRATIONS),))
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {len(MIGRATIONS)}")
    if not found:
        connection.execute("COMMIT")


def version(connection: sqlite3.Connection) -> int:
    """The version of the tables, 0 for an empty database. Raises DamagedError."""
    (number,) = connection.execute("PRAGMA user_version").fetchone()
    (owner,) = connection.execute("PRAGMA application_id").fetchone()
    tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}
    if not tables and not number and not owner:
        return 0
    # The version is stored twice, so that a flipped bit is not taken for a newer version.
    about = connection.execute("SELECT version FROM about").fetchall() if "about" in tables else []
    if about != [(number,)] or owner != APPLICATION_ID:
        raise DamagedError("its version is not readable")
    return int(number)


def tables_of(found: int) -> list[Table]:
    """The tables of that version which are read at the start."""
    first = {Table.CLOCK: 2, Table.SEGMENT: 5, Table.LATEST: 5}
    return [table for table in LOADED if found >= first.get(table, 1)]


def roll_back(connection: sqlite3.Connection) -> None:
    """End the transaction, if there is one, without its changes."""
    with contextlib.suppress(sqlite3.Error):
        if connection.in_transaction:
            connection.execute("ROLLBACK")


def insert(table: Table, count: int) -> str:
    """The statement that writes `count` rows, replacing those with the same keys."""
    columns = COLUMNS[table]
    row = f"({','.join('?' * len(columns))})"
    return (
        f"INSERT OR REPLACE INTO {table.name.lower()} ({','.join(columns)}) "
        f"VALUES {','.join([row] * count)}"
    )


def delete(table: Table, count: int) -> str:
    """The statement that deletes `count` rows by their keys."""
    return f"DELETE FROM {table.name.lower()} WHERE id IN ({','.join('?' * count)})"


def read_table(
    connection: sqlite3.Connection, table: Table, rest: str = "", values: Sequence[Value] = ()
) -> Iterator[tuple[int, Row]]:
    """All rows of a table, as named tuples, with their keys.

    `rest` is what follows in the statement, which selects or orders the rows, with its `values`.

    Raises:
        sqlite3.Error, UnicodeError, OverflowError: it cannot be read.
        DamagedError: a column is missing that every version of the table has.
    """
    name = table.name.lower()
    present = {column for _, column, *_ in connection.execute(f"PRAGMA table_info({name})")}
    # Tables of an older appliance have fewer columns; the named tuple has defaults for these.
    kind = ROW_TYPES[table]
    defaults = {
        column: "NULL" if value is None else repr(value)
        for column, value in kind._field_defaults.items()
    }
    try:
        columns = ",".join(each if each in present else defaults[each] for each in COLUMNS[table])
    except KeyError:
        raise DamagedError(f"the table {name} has lost columns") from None
    # Without the named tuple's own `__new__`, which takes as long as half of the reading.
    make: Callable[[Row], Row] = partial(tuple.__new__, kind)
    for row in connection.execute(f"SELECT {columns} FROM {name} {rest}", values):
        yield row[0], make(row)
