"""The database: its tables, its versions, and how it is opened.

Every table has an integer key that is given out once and never again; rows refer to each other by
it. There are no indices and no foreign keys: all is read at the start, and then found in memory.
Times are seconds of the store's own clock, see `clock`.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
from enum import IntEnum
from pathlib import Path
from typing import Literal, TypeAlias

Durability: TypeAlias = Literal["power", "process", "off"]

Value: TypeAlias = "int | float | str | bytes | None"
#: The row's key comes first.
Row: TypeAlias = "tuple[Value, ...]"


class StoreError(Exception):
    """The store cannot be used; the text says which file, why, and what to do."""


class DamagedError(Exception):
    """The database is not what was written to it."""


class Table(IntEnum):
    """The tables, in the order in which they are written."""

    MESSAGE = 0
    SESSION = 1
    SUBSCRIPTION = 2
    OWED = 3
    RECEIVED = 4
    RETAINED = 5
    CLOCK = 6


COLUMNS: dict[Table, tuple[str, ...]] = {
    Table.MESSAGE: (
        *("id", "topic", "payload", "qos", "retain", "properties", "passed_on"),
        *("expires_at", "stored_at"),
    ),
    Table.SESSION: (
        *("id", "client_id", "username", "expiry", "ends_at"),
        *("will", "will_delay", "will_at"),
    ),
    Table.SUBSCRIPTION: (
        *("id", "session", "filter", "qos", "no_local", "retain_as_published"),
        *("retain_handling", "identifier", "replaying"),
    ),
    Table.OWED: (
        *("id", "session", "message", "qos", "retain", "subscription_ids", "share"),
        *("packet_id", "sent"),
    ),
    Table.RECEIVED: ("id", "session", "packet_id", "message", "no_room"),
    Table.RETAINED: ("id", "message", "username", "inside"),
    Table.CLOCK: ("id", "time", "wall", "counted", "boot"),
}

#: What makes each version out of the one before; a database of an older version gets the rest.
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
)

#: Bytes of the database file, "MQTA": so that another program's database is not taken for ours.
APPLICATION_ID = 0x4D515441

#: Pages of the write-ahead log after which it is moved into the database: 4 MB. It is then written
#: from its beginning again, which is faster than to let it grow.
CHECKPOINT_PAGES = 1000

#: Seconds to wait for another program that has the database locked, such as a backup.
BUSY_TIMEOUT = 5.0

_SYNCHRONOUS = {"power": "FULL", "process": "NORMAL"}


def connect(path: Path, durability: Durability = "power") -> sqlite3.Connection:
    """Open the database, making it when there is none; only its user may read it.

    That of an older appliance is in a transaction then, see `_migrate`.

    Raises:
        sqlite3.Error, OSError: it cannot be opened.
        DamagedError: it is a database, but not ours.
        StoreError: a newer appliance made it.
    """
    # SQLite would make it, and what lies beside it, as open as the umask has it.
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
        _migrate(connection, path)
    except BaseException:
        connection.close()
        raise
    return connection


def connect_to_read(path: Path) -> sqlite3.Connection:
    """Open the database to read it, while the appliance may be running. Raises sqlite3.Error."""
    # SQLite would make the files beside it that a database in use has, and leave them there.
    in_use = path.with_name(f"{path.name}-wal").exists()
    mode = "mode=ro" if in_use else "mode=ro&immutable=1"
    return sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True, timeout=BUSY_TIMEOUT)


def _migrate(connection: sqlite3.Connection, path: Path) -> None:
    """Bring the tables up to date, in a transaction that the first write goes on with and commits.

    So a start that fails leaves the database to the older appliance that takes over again. A new
    one has its tables at once: it may be looked at before anything is written.
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
    # It is written down twice: a bit that flipped in one is not a newer version.
    told = connection.execute("SELECT version FROM about").fetchall() if "about" in tables else []
    if told != [(number,)] or owner != APPLICATION_ID:
        raise DamagedError("its version is not readable")
    return int(number)


def roll_back(connection: sqlite3.Connection) -> None:
    """Undo what was begun, if anything was."""
    with contextlib.suppress(sqlite3.Error):
        if connection.in_transaction:
            connection.execute("ROLLBACK")


def insert(table: Table, count: int) -> str:
    """The statement that writes so many rows at once, in the place of those with the same keys."""
    columns = COLUMNS[table]
    row = f"({','.join('?' * len(columns))})"
    return (
        f"INSERT OR REPLACE INTO {table.name.lower()} ({','.join(columns)}) "
        f"VALUES {','.join([row] * count)}"
    )


def delete(table: Table, count: int) -> str:
    """The statement that deletes so many rows at once, by their keys."""
    return f"DELETE FROM {table.name.lower()} WHERE id IN ({','.join('?' * count)})"


def select(table: Table, connection: sqlite3.Connection) -> str:
    """The statement that reads a whole table; what an older appliance made has fewer columns."""
    name = table.name.lower()
    there = {column for _, column, *_ in connection.execute(f"PRAGMA table_info({name})")}
    return f"SELECT {','.join(filter(there.__contains__, COLUMNS[table]))} FROM {name}"
