"""The database's files: locked, read at the start whatever state they are in, and salvaged."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import pwd
import shlex
import shutil
import sqlite3
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from appliance.store.rows import LOADED, MAY_WAIT, QUEUES, SIZES, STORED, Rows, Table
from appliance.store.salvage import salvage, salvage_backlog
from appliance.store.schema import (
    MIGRATIONS,
    DamagedError,
    Durability,
    StoreError,
    connect,
    is_damage,
    is_lost,
    read_table,
    version,
)

log = logging.getLogger("appliance.store")

#: The suffixes of SQLite's files beside a database: the write-ahead log, and the index to it, which
#: SQLite rebuilds.
_LOG, _INDEX = "-wal", "-shm"


#: Messages in queues up to which a start reads all of them, which takes a tenth of a second. If
#: there are more, clients are served meanwhile.
AT_START = 20_000

#: Which rows of a table are read at the start if there are more.
_AT_ONCE = {
    Table.OWED: f"WHERE NOT ({MAY_WAIT})",
    Table.MESSAGE: (
        "WHERE id IN (SELECT will FROM session UNION SELECT message FROM received "
        "UNION SELECT message FROM retained "
        f"UNION SELECT message FROM owed WHERE NOT ({MAY_WAIT}))"
    ),
}


@dataclass(slots=True)
class Contents:
    """What was in the database."""

    rows: Rows = field(default_factory=Rows)
    #: The connection that read it; None when the database cannot be written.
    connection: sqlite3.Connection | None = None
    #: Why it cannot be written.
    problem: str = ""
    #: The rows were salvaged from a damaged database and are in no database yet.
    salvaged: bool = False


class Database:
    """The files of one database, locked against other appliances from `open` to `close`."""

    def __init__(self, path: Path, durability: Durability) -> None:
        self.path = path
        self._durability: Durability = durability
        self._lock: int | None = None
        self._contents: Contents | None = None
        self._opening: threading.Thread | None = None

    def open(self) -> None:
        """Lock the database and read all of it.

        Raises:
            StoreError: another appliance uses it, a newer one made it, or it cannot be read.
        """
        opening, self._opening = self._opening, None
        if opening is not None:
            opening.join()
        if self._contents is not None:
            return
        self._prepare()
        try:
            self._contents = read(self.path, self._durability)
        except BaseException:
            self.close()
            raise

    def _prepare(self) -> None:
        """Make the folder, and lock the database. Raises StoreError."""
        try:
            # The folder is for the appliance's user only when it is created here.
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._take_lock()
        except OSError as error:
            try:
                exists = self.path.exists()
            except PermissionError:
                raise StoreError(_belongs_to_another(self.path)) from None
            if not exists:
                raise StoreError(
                    f"{error.filename or self.path}: {error.strerror} (broker.store.path)"
                ) from None
            log.warning("%s: %s", error.filename, error.strerror)

    def begin_opening(self) -> None:
        """Begin to read it in a thread; `open` waits for that.

        Most of a second for 400,000 messages is SQLite's, which another core can do beside a start.
        Whatever goes wrong there is met again, and said, by `open`: until then nothing is changed.
        """

        def read_it() -> None:
            try:
                if self.path.exists():
                    self._take_lock()
                    self._contents = _read(self.path, self._durability)
            except Exception:
                self.close()

        self._opening = threading.Thread(target=read_it, name="store-open", daemon=True)
        self._opening.start()

    def take_contents(self) -> Contents:
        """What `open` has read; its connection is the caller's from now on."""
        contents, self._contents = self._contents, None
        assert contents is not None
        return contents

    def close(self) -> None:
        """Release the lock, and what was read and not taken; may be called twice."""
        contents, self._contents = self._contents, None
        if contents is not None and contents.connection is not None:
            contents.connection.close()
        descriptor, self._lock = self._lock, None
        if descriptor is not None:
            os.close(descriptor)

    def _take_lock(self) -> None:
        self._lock = lock(self.path)
        if self._lock is None:
            raise StoreError(
                f"{self.path} is in use by another appliance: stop that one, or set another "
                "broker.store.path"
            )


def lock(path: Path) -> int | None:
    """Lock the database until the descriptor is closed; None when another process has locked it.

    Raises:
        OSError: the lock file cannot be created.
    """
    descriptor = os.open(_beside(path, ".lock"), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    return descriptor


def size_on_disk(path: Path) -> int:
    """Bytes of the database's files."""
    total = 0
    for suffix in ("", _LOG):
        with contextlib.suppress(OSError):
            total += os.stat(_beside(path, suffix)).st_size  # noqa: PTH116
    return total


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)


# --- reading -------------------------------------------------------------------------------------


def read(path: Path, durability: Durability) -> Contents:
    """Open the database and read all of it. A damaged one is set aside, and its rows are salvaged.

    Raises:
        StoreError: a newer appliance made it, another program has locked it, or neither it nor its
            folder can be read.
    """
    try:
        return _read(path, durability)
    except DamagedError as error:
        return _set_aside(path, str(error))
    except (sqlite3.Error, OSError) as error:
        if is_damage(error):
            return _set_aside(path, str(error))
        if "locked" in str(error):
            raise StoreError(
                f"{path} is locked by another program: end that, or move the file away"
            ) from None
        return _read_only(path, error)


def _read(path: Path, durability: Durability, *, may_wait: bool = True) -> Contents:
    connection = connect(path, durability)
    try:
        return Contents(_read_all(connection, may_wait=may_wait), connection)
    except BaseException:
        connection.close()
        raise


def _read_all(connection: sqlite3.Connection, *, may_wait: bool = False) -> Rows:
    """All rows, but for those of long queues that may wait until they are read beside a writer."""
    for name in ("sqlite_master", *(table.name.lower() for table in LOADED)):
        _check(connection, f"('{name}')")
    # Of the backlog only where the next records go: there may be a gigabyte of it, and records
    # have a checksum.
    connection.execute("SELECT max(id) FROM backlog").fetchone()
    rows = Rows()
    at_once = dict.fromkeys(LOADED, "")
    # Another connection sees the tables of an older appliance as they were before the transaction.
    if may_wait and not connection.in_transaction:
        one_more = f"SELECT 1 FROM owed WHERE {MAY_WAIT} LIMIT 1 OFFSET {AT_START}"
        if connection.execute(one_more).fetchone() is not None:
            rows.unread.add(connection.execute(QUEUES))
            at_once |= _AT_ONCE
    for table in LOADED:
        rows.of(table).update(read_table(connection, table, at_once[table]))
    if rows.unread.queues:
        _count_messages(connection, rows)
    if any(row.length == 0 for row in rows.segment.values()):
        log.warning("some records of a backlog were damaged: the whole file is being checked")
        _check(connection, "(1)")
    return rows


def _count_messages(connection: sqlite3.Connection, rows: Rows) -> None:
    """Count what is stored, without the messages that nothing refers to."""
    unread = rows.unread
    count, stored = connection.execute(STORED).fetchone()
    unread.stored = int(stored)
    references = unread.references
    if count > len(references) + sum(key not in references for key in rows.message):
        for key, size in connection.execute(SIZES):
            if key not in references and key not in rows.message:
                unread.unreferenced.append(key)
                unread.stored -= size


def _check(connection: sqlite3.Connection, argument: str) -> None:
    """Check a table, or the whole file. Raises DamagedError, sqlite3.Error."""
    try:
        (verdict,) = connection.execute(f"PRAGMA quick_check{argument}").fetchone()
    except sqlite3.OperationalError as error:
        if is_lost(error):
            raise DamagedError(str(error)) from None
        raise
    if verdict != "ok":
        raise DamagedError(verdict.replace("\n", " "))


def _read_only(path: Path, error: Exception) -> Contents:
    """Read it although the disk is full or read-only, so that SQLite cannot create its files."""
    problem = str(error)
    if not path.exists():
        return Contents(problem=problem)
    try:
        return Contents(_read_alone(path), problem=problem)
    except DamagedError as damage:
        return _set_aside(path, str(damage))
    except (sqlite3.Error, UnicodeError):
        return _read_copy(path, problem)


def _read_alone(path: Path) -> Rows:
    """Read it where it is, without an index to its log beside it, which only one process can.

    Raises:
        DamagedError: it is damaged.
        sqlite3.Error, UnicodeError: it is, or it cannot be read in this way.
    """
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA locking_mode = EXCLUSIVE")
        if version(connection) != len(MIGRATIONS):
            raise sqlite3.OperationalError("it is an older appliance's")
        return _read_all(connection)


def _read_copy(path: Path, problem: str) -> Contents:
    with tempfile.TemporaryDirectory(prefix="appliance-store-") as directory:
        copy = Path(directory) / path.name
        try:
            shutil.copyfile(path, copy)
            if _beside(path, _LOG).exists():
                shutil.copyfile(_beside(path, _LOG), _beside(copy, _LOG))
        except PermissionError:
            raise StoreError(_belongs_to_another(path)) from None
        except OSError as failed:
            raise StoreError(f"{path} cannot be read: {problem}; nor copied: {failed}") from None
        try:
            contents = _read(copy, "process", may_wait=False)
        except (DamagedError, sqlite3.Error, UnicodeError) as damage:
            return _set_aside(path, str(damage))
        assert contents.connection is not None
        contents.connection.close()
        return Contents(contents.rows, problem=problem)


def _belongs_to_another(path: Path) -> str:
    """What to do after the appliance has run as another user, such as once with sudo."""
    try:
        owner = path.stat().st_uid
    except PermissionError:
        owner = path.parent.stat().st_uid
    user = os.geteuid()
    return (
        f"{path} belongs to {_user(owner)}, and this runs as {_user(user)}: run it as "
        f"{_user(owner)}, or give it the folder and the files: sudo chown {_user(user)} "
        f"{shlex.quote(str(path.parent))} {shlex.quote(str(path))}*"
    )


def _user(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


# --- salvaging -----------------------------------------------------------------------------------


def _set_aside(path: Path, damage: str) -> Contents:
    """Salvage the rows of the damaged database, and rename it to a name with the date."""
    aside = path.with_name(f"{path.name}.damaged-{time.strftime('%Y%m%dT%H%M%S')}")
    beside = path.with_name(f"{path.name}.salvaged")
    rows = salvage(path)
    lost = salvage_backlog(path, rows, beside)
    try:
        for suffix in ("", _LOG):
            with contextlib.suppress(FileNotFoundError):
                _beside(path, suffix).replace(_beside(aside, suffix))
        _beside(path, _INDEX).unlink(missing_ok=True)
        if rows.segment:
            beside.replace(path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise StoreError(
            f"{path} is damaged ({damage}) and cannot be set aside: {error.strerror}"
        ) from None
    found = ", ".join(f"{len(rows.of(table))} {table.name.lower()}" for table in LOADED)
    log.error(
        "%s IS DAMAGED (%s). It was set aside as %s; what could be read of it is kept (%s), what "
        "could not is lost%s",
        path,
        damage,
        aside,
        found,
        f", such as {lost} segments of backlogs" if lost else "",
    )
    return Contents(rows, salvaged=True)
