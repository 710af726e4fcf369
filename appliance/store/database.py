"""Reading the database at the start, whatever state it is in."""

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
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from appliance.store.schema import (
    DamagedError,
    Durability,
    Row,
    StoreError,
    Table,
    connect,
    select,
)

log = logging.getLogger("appliance.store")

#: What SQLite keeps beside a database: the write-ahead log, and an index to it that it makes anew.
_LOG, _INDEX = "-wal", "-shm"

#: Of SQLite's errors, those that say that the file is wrong and not the world around it.
_DAMAGE = ("malformed", "not a database", "no such table", "no such column", "corrupt")

#: Rows of every table by their keys.
Rows: TypeAlias = "list[dict[int, Row]]"


@dataclass(slots=True)
class Contents:
    """What was in the database."""

    rows: Rows = field(default_factory=lambda: [{} for _ in Table])
    #: The connection that it was read with; None where there is none that can be written with.
    connection: sqlite3.Connection | None = None
    #: Why there is none.
    problem: str = ""
    #: The rows are in no database yet: they are what was saved of a damaged one.
    rescued: bool = False


def read(path: Path, durability: Durability) -> Contents:
    """Open the database and read all of it; a damaged one is set aside, and what can be is saved.

    Raises:
        StoreError: a newer appliance made it, or another program has it locked, or neither it nor
            its directory can be read.
    """
    try:
        return _read(path, durability)
    except DamagedError as error:
        return _rescue(path, str(error))
    except (sqlite3.Error, OSError) as error:
        if _is_damage(error):
            return _rescue(path, str(error))
        if "locked" in str(error):
            raise StoreError(
                f"{path} is locked by another program: end that, or move the file away"
            ) from None
        return _read_copy(path, error)


def _is_damage(error: Exception) -> bool:
    return any(word in str(error) for word in _DAMAGE) or isinstance(error, UnicodeError)


def _read(path: Path, durability: Durability) -> Contents:
    connection = connect(path, durability)
    try:
        return Contents(_read_all(connection), connection)
    except BaseException:
        connection.close()
        raise


def _read_all(connection: sqlite3.Connection) -> Rows:
    (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if verdict != "ok":
        raise DamagedError(verdict.replace("\n", " "))
    return [
        {row[0]: row for row in connection.execute(select(table, connection))} for table in Table
    ]


def _read_copy(path: Path, error: Exception) -> Contents:
    """The disk is full, or read-only, so that not even reading works where the database lies."""
    problem = str(error)
    if not path.exists():
        return Contents(problem=problem)
    with tempfile.TemporaryDirectory(prefix="appliance-store-") as directory:
        copy = Path(directory) / path.name
        try:
            shutil.copyfile(path, copy)
            if _beside(path, _LOG).exists():
                shutil.copyfile(_beside(path, _LOG), _beside(copy, _LOG))
        except PermissionError:
            raise StoreError(belongs_to_another(path)) from None
        except OSError as failed:
            raise StoreError(f"{path} cannot be read: {problem}; nor copied: {failed}") from None
        try:
            contents = _read(copy, "process")
        except (DamagedError, sqlite3.Error, UnicodeError) as damage:
            return _rescue(path, str(damage))
        assert contents.connection is not None
        contents.connection.close()
        return Contents(contents.rows, problem=problem)


def belongs_to_another(path: Path) -> str:
    """What to do when an appliance has run here as another user, such as once with sudo."""
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


def _rescue(path: Path, damage: str) -> Contents:
    """Set the database aside, under a name with the date, and read of it what can be read."""
    aside = path.with_name(f"{path.name}.damaged-{time.strftime('%Y%m%dT%H%M%S')}")
    try:
        for suffix in ("", _LOG):
            with contextlib.suppress(FileNotFoundError):
                _beside(path, suffix).replace(_beside(aside, suffix))
        _beside(path, _INDEX).unlink(missing_ok=True)
    except OSError as error:
        raise StoreError(
            f"{path} is damaged ({damage}) and cannot be set aside: {error.strerror}"
        ) from None
    rows = salvage(aside)
    found = ", ".join(f"{len(rows[table])} {table.name.lower()}" for table in Table)
    log.error(
        "%s IS DAMAGED (%s). It was set aside as %s; what could be read of it is kept (%s), what "
        "could not is lost",
        path,
        damage,
        aside,
        found,
    )
    return Contents(rows, rescued=True)


def salvage(path: Path) -> Rows:
    """All rows that can be read from a damaged database, which is not changed."""
    best: Rows = [{} for _ in Table]
    with tempfile.TemporaryDirectory(prefix="appliance-store-") as directory:
        for with_log in (True, False):
            copy = Path(directory) / f"{with_log}.db"
            with contextlib.suppress(OSError):
                shutil.copyfile(path, copy)
                if with_log and _beside(path, _LOG).exists():
                    shutil.copyfile(_beside(path, _LOG), _beside(copy, _LOG))
            for table, rows in zip(Table, _salvage(copy), strict=True):
                if len(rows) > len(best[table]):
                    best[table] = rows
            if any(best):
                break  # without its log an older state would be mixed in
    return best


def _salvage(path: Path) -> Rows:
    rows: Rows = [{} for _ in Table]
    try:
        connection = sqlite3.connect(path)
    except sqlite3.Error:
        return rows
    with contextlib.closing(connection):
        with contextlib.suppress(sqlite3.Error):  # so that what is damaged is not taken for rows
            connection.execute("PRAGMA cell_size_check = ON")
        for table in Table:
            # From both ends, up to what cannot be read.
            for order in ("ASC", "DESC"):
                with contextlib.suppress(sqlite3.Error, UnicodeError, OverflowError):
                    for row in connection.execute(
                        f"{select(table, connection)} ORDER BY id {order}"
                    ):
                        rows[table].setdefault(row[0], row)
    return rows


def make_directory(path: Path) -> None:
    """The directory of the database, for its user only when it is made here. Raises OSError."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)


def lock(path: Path) -> int | None:
    """Take hold of the database, until the descriptor is closed; None when another process has it.

    Raises:
        OSError: the lock's file cannot be made.
    """
    descriptor = os.open(_beside(path, ".lock"), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    return descriptor


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)


def size_on_disk(path: Path) -> int:
    """Bytes of the database's files."""
    total = 0
    for suffix in ("", _LOG):
        with contextlib.suppress(OSError):
            total += os.stat(_beside(path, suffix)).st_size  # noqa: PTH116
    return total
