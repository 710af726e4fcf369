"""What `appliance store` shows, exports and prunes."""

from __future__ import annotations

import base64
import contextlib
import os
import sqlite3
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from appliance.mqtt.topics import check_filter, matches
from appliance.store import database
from appliance.store.clock import KEY, Clocks, boot_id, stamp_of
from appliance.store.database import Rows
from appliance.store.schema import (
    DamagedError,
    Row,
    StoreError,
    Table,
    Value,
    connect,
    connect_to_read,
    select,
    version,
)
from appliance.store.writer import Batch, write


@dataclass(frozen=True, slots=True)
class SessionSummary:
    """One session; times are of the wall clock, None for a client that is connected."""

    client_id: str
    username: str | None
    subscriptions: int
    #: Messages that wait for it or are on their way, their payloads' bytes, and since when.
    messages: int
    size: int
    oldest: float | None
    ends_at: float | None


@dataclass(frozen=True, slots=True)
class Summary:
    """What is kept; sizes in bytes."""

    sessions: list[SessionSummary]
    messages: int
    payload_size: int
    retained: int
    retained_size: int
    file_size: int


def _require(path: Path) -> None:
    if not path.exists():
        raise StoreError(f"{path} is not there: nothing has been stored yet")


def read(path: Path) -> Rows:
    """All rows, while the appliance may be running.

    Raises:
        StoreError: there is no database, or it cannot be read.
    """
    _require(path)
    try:
        with contextlib.closing(connect_to_read(path)) as connection:
            # What an older appliance wrote has fewer tables until this one runs.
            tables = [*Table] if version(connection) > 1 else [*Table][: Table.CLOCK]
            connection.execute("BEGIN")
            rows: Rows = [{} for _ in Table]
            for table in tables:
                rows[table] = {row[0]: row for row in connection.execute(select(table, connection))}
            return rows
    except (sqlite3.Error, DamagedError) as error:
        raise StoreError(f"{path} cannot be read: {error}") from None


def summarise(path: Path) -> Summary:
    """What is kept in the database. Raises StoreError."""
    rows = read(path)
    messages = rows[Table.MESSAGE]
    dated = _dates(rows)

    def payload_size(key: object) -> int:
        row = messages.get(cast(int, key))
        return len(cast(bytes, row[2])) if row is not None else 0

    subscriptions = _by_session(rows, Table.SUBSCRIPTION)
    owed_to = _by_session(rows, Table.OWED)
    sessions = []
    for key, client_id, username, expiry, ends_at, *_ in rows[Table.SESSION].values():
        if not expiry:
            continue
        owed = [row[2] for row in owed_to[key]]
        stored = [cast(float, messages[cast(int, m)][8]) for m in owed if m in messages]
        sessions.append(
            SessionSummary(
                str(client_id),
                cast("str | None", username),
                len(subscriptions[key]),
                len(owed),
                sum(map(payload_size, owed)),
                dated(min(stored, default=None)),
                dated(ends_at),
            )
        )
    retained = [row[1] for row in rows[Table.RETAINED].values()]
    return Summary(
        sorted(sessions, key=lambda session: session.client_id),
        len(messages),
        sum(map(payload_size, messages)),
        len(retained),
        sum(map(payload_size, retained)),
        database.size_on_disk(path),
    )


def _dates(rows: Rows) -> Callable[[Value], float | None]:
    """What makes a time of the wall clock out of one of the store's."""
    stamp = stamp_of(rows[Table.CLOCK].get(KEY))
    shift = stamp.shift if stamp is not None else 0.0
    return lambda moment: moment + shift if isinstance(moment, float) else None


def _by_session(rows: Rows, table: Table) -> defaultdict[object, list[Row]]:
    """The rows of a table that belongs to sessions, by the session's key."""
    found: defaultdict[object, list[Row]] = defaultdict(list)
    for row in rows[table].values():
        found[row[1]].append(row)
    return found


def export(path: Path) -> Iterator[dict[str, object]]:
    """Every session and every retained message as what JSON can say. Raises StoreError."""
    rows = read(path)
    dated = _dates(rows)

    def message(key: object) -> dict[str, object]:
        row = rows[Table.MESSAGE].get(cast(int, key))
        if row is None:
            return {}
        _, topic, payload, qos, retain, _, _, expires_at, stored_at = row
        told: dict[str, object] = {"topic": topic, "qos": qos, "retain": bool(retain)}
        told |= {"stored_at": dated(stored_at), "expires_at": dated(expires_at)}
        try:
            told["payload"] = cast(bytes, payload).decode()
        except UnicodeDecodeError:
            told["payload_base64"] = base64.b64encode(cast(bytes, payload)).decode()
        return told

    subscriptions = _by_session(rows, Table.SUBSCRIPTION)
    owed_to = _by_session(rows, Table.OWED)
    received = _by_session(rows, Table.RECEIVED)
    for row in rows[Table.SESSION].values():
        key, client_id, username, expiry, ends_at, will, will_delay, will_at = row
        yield {
            "session": client_id,
            "user": username,
            "expiry": expiry,
            "ends_at": dated(ends_at),
            "will": message(will) | {"delay": will_delay, "due_at": dated(will_at)}
            if will
            else None,
            "subscriptions": [
                {"filter": row[2], "qos": row[3], "identifier": row[7]}
                for row in subscriptions[key]
            ],
            "messages": [
                message(row[2]) | {"qos": row[3], "packet_id": row[7]}
                for row in sorted(owed_to[key], key=lambda row: cast(int, row[0]))
            ],
            "unreleased": [message(row[3]) | {"packet_id": row[2]} for row in received[key]],
        }
    for row in rows[Table.RETAINED].values():
        yield {"retained": message(row[1])}


def _now(rows: Rows) -> float:
    """The store's time."""
    stamp = stamp_of(rows[Table.CLOCK].get(KEY))
    clocks = Clocks(time.time(), time.monotonic(), boot_id())
    return clocks.wall if stamp is None else stamp.later(clocks)


def prune_retained(path: Path, filters: list[str]) -> int:
    """Delete the retained messages of the topics that a filter matches; returns how many.

    Raises:
        ValueError: one is no topic filter.
        StoreError: an appliance is running, or there is no database.
        sqlite3.Error, OSError: it cannot be written.
    """
    for topic_filter in filters:
        check_filter(topic_filter)
    with _changing(path) as (rows, batch):
        topics = {key: cast(str, row[1]) for key, row in rows[Table.MESSAGE].items()}
        for key, row in rows[Table.RETAINED].items():
            topic = topics.get(cast(int, row[1]), "")
            if any(matches(each, topic) for each in filters):
                batch.remove(Table.RETAINED, key)
        return len(batch.deleted[Table.RETAINED])


#: What refers to messages, and in which column.
_REFERRING = ((Table.SESSION, 5), (Table.OWED, 2), (Table.RECEIVED, 3), (Table.RETAINED, 1))


@contextlib.contextmanager
def _changing(path: Path) -> Iterator[tuple[Rows, Batch]]:
    """All rows, and what is to be done with them, which is written at the end.

    Messages that nothing refers to any more go with it, and what room they had in the file.
    """
    _require(path)
    with _locked(path):
        rows, batch = read(path), Batch(0, 1 << 62)
        yield rows, batch
        used = {
            row[column]
            for table, column in _REFERRING
            for key, row in rows[table].items()
            if key not in batch.deleted[table]
        }
        for key in rows[Table.MESSAGE].keys() - used:
            batch.remove(Table.MESSAGE, key)
        with contextlib.closing(connect(path)) as connection:
            write(connection, batch)
            # It takes as much room again for a moment; without that the file stays as large.
            with contextlib.suppress(sqlite3.Error):
                connection.execute("VACUUM")


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    descriptor = database.lock(path)
    if descriptor is None:
        raise StoreError(f"{path} is in use: stop the appliance first")
    try:
        yield
    finally:
        os.close(descriptor)


def prune(path: Path, older_than: float | None, client_ids: list[str]) -> tuple[int, int]:
    """Delete what waits for sessions for longer than so many seconds; without that, sessions.

    With `client_ids` of theirs only. Returns how many sessions and messages are gone.

    Raises:
        StoreError: an appliance is running, there is no database, or no such client.
        sqlite3.Error, OSError: it cannot be written.
    """
    with _changing(path) as (rows, batch):
        chosen = {
            key: row
            for key, row in rows[Table.SESSION].items()
            if not client_ids or row[1] in client_ids
        }
        missing = set(client_ids) - {row[1] for row in chosen.values()}
        if missing:
            raise StoreError(f"no session of {', '.join(map(repr, sorted(missing)))} is kept")
        messages = rows[Table.MESSAGE]
        limit = None if older_than is None else _now(rows) - older_than
        for key, row in rows[Table.OWED].items():
            stored = messages.get(cast(int, row[2])) if row[2] is not None else None
            if row[1] in chosen and (
                limit is None or (stored is not None and cast(float, stored[8]) < limit)
            ):
                batch.remove(Table.OWED, key)
        if limit is None:
            for key in chosen:
                batch.remove(Table.SESSION, key)
            for table in (Table.SUBSCRIPTION, Table.RECEIVED):
                for key, row in rows[table].items():
                    if row[1] in chosen:
                        batch.remove(table, key)
        return len(batch.deleted[Table.SESSION]), len(batch.deleted[Table.OWED])
