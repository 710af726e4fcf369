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
from typing import TypeVar, cast

from appliance.broker.backlogs import NO_MESSAGE
from appliance.mqtt.topics import check_filter, matches
from appliance.store import database
from appliance.store.clock import Clocks, boot_id, stamp_of
from appliance.store.loader import load
from appliance.store.rows import (
    LATEST,
    SINGLE_LANE,
    OwedRow,
    ReceivedRow,
    Rows,
    SubscriptionRow,
    Table,
    Value,
)
from appliance.store.schema import (
    DamagedError,
    StoreError,
    connect,
    connect_to_read,
    read_table,
    tables_of,
    version,
)
from appliance.store.writer import Batch, write

_OfSession = TypeVar("_OfSession", SubscriptionRow, OwedRow, ReceivedRow)


@dataclass(frozen=True, slots=True)
class SessionSummary:
    """One session; `ends_at`, by the wall clock, is None while its client is connected."""

    client_id: str
    username: str | None
    subscriptions: int
    #: Messages queued or inflight, the bytes of their payloads, and the time of the oldest.
    messages: int
    size: int
    oldest: float | None
    ends_at: float | None


@dataclass(frozen=True, slots=True)
class BacklogSummary:
    """What is stored for a link to another broker: in the journal of one of its lanes, as the
    latest of topics, or set aside.

    The size in bytes is that of whole segments; `oldest` is by the wall clock, of journals only.
    """

    link: str
    lane: int | str
    messages: int
    size: int
    oldest: float | None


@dataclass(frozen=True, slots=True)
class Summary:
    """What is stored; sizes in bytes."""

    sessions: list[SessionSummary]
    messages: int
    payload_size: int
    retained: int
    retained_size: int
    file_size: int
    backlogs: list[BacklogSummary]


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
            # The database of an older appliance has fewer tables until this one runs.
            tables = tables_of(version(connection))
            connection.execute("BEGIN")
            rows = Rows()
            for table in tables:
                rows.of(table).update(read_table(connection, table))
            return rows
    except (sqlite3.Error, DamagedError) as error:
        raise StoreError(f"{path} cannot be read: {error}") from None


def summarise(path: Path) -> Summary:
    """What is stored in the database. Raises StoreError."""
    rows = read(path)
    to_date = _wall_clock(rows)

    def payload_size(key: Value) -> int:
        row = rows.message.get(cast(int, key))
        return len(cast(bytes, row.payload)) if row is not None else 0

    subscriptions = _by_session(rows.subscription)
    owed = _by_session(rows.owed)
    sessions = []
    for session in rows.session.values():
        if not session.expiry:
            continue
        keys = [row.message for row in owed[session.id]]
        found = (rows.message.get(cast(int, key)) for key in keys)
        stored = [cast(float, row.stored_at) for row in found if row is not None]
        sessions.append(
            SessionSummary(
                str(session.client_id),
                cast("str | None", session.username),
                len(subscriptions[session.id]),
                len(keys),
                sum(map(payload_size, keys)),
                to_date(min(stored, default=None)),
                to_date(session.ends_at),
            )
        )
    return Summary(
        sorted(sessions, key=lambda session: session.client_id),
        len(rows.message),
        sum(map(payload_size, rows.message)),
        len(rows.retained),
        sum(payload_size(row.message) for row in rows.retained.values()),
        database.size_on_disk(path),
        _backlogs(rows),
    )


def _backlogs(rows: Rows) -> list[BacklogSummary]:
    loaded = load(rows, 0.0).backlogs
    to_date = _wall_clock(rows)
    found = [
        BacklogSummary(
            *place,
            sum(segment.count - segment.done for segment in segments),
            sum(segment.size for segment in segments),
            to_date(min(segment.first_at for segment in segments)),
        )
        for place, segments in loaded.segments.items()
        if place[1] != SINGLE_LANE
    ]
    for (link, kind), records in loaded.records.items():
        # A large one is a record by itself, and what it is says a row of the table `latest`.
        single = loaded.segments.get((link, SINGLE_LANE), ()) if kind == LATEST else ()
        messages = list(records.values())
        if kind == LATEST:
            messages = [each for each in messages if each[:1] != NO_MESSAGE]
        size = sum(map(len, messages)) + sum(segment.size for segment in single)
        lane = "latest" if kind == LATEST else "set aside"
        if messages:
            found.append(BacklogSummary(link, lane, len(messages), size, None))
    return sorted(found, key=lambda each: (each.link, str(each.lane)))


def _wall_clock(rows: Rows) -> Callable[[Value], float | None]:
    """A function that converts a time of the store's clock to one of the wall clock."""
    stamp = stamp_of(rows.clock)
    shift = stamp.shift if stamp is not None else 0.0
    return lambda moment: moment + shift if isinstance(moment, float) else None


def _by_session(rows: dict[int, _OfSession]) -> defaultdict[Value, list[_OfSession]]:
    """The rows of a table that belong to sessions, by the session's key."""
    found: defaultdict[Value, list[_OfSession]] = defaultdict(list)
    for row in rows.values():
        found[row.session].append(row)
    return found


def export(path: Path) -> Iterator[dict[str, object]]:
    """Sessions, retained messages and what backlogs have, as values for JSON. Raises StoreError."""
    rows = read(path)
    to_date = _wall_clock(rows)

    def message(key: Value) -> dict[str, object]:
        row = rows.message.get(cast(int, key))
        if row is None:
            return {}
        exported: dict[str, object] = {
            "topic": row.topic,
            "qos": row.qos,
            "retain": bool(row.retain),
            "stored_at": to_date(row.stored_at),
            "expires_at": to_date(row.expires_at),
        }
        payload = cast(bytes, row.payload)
        try:
            exported["payload"] = payload.decode()
        except UnicodeDecodeError:
            exported["payload_base64"] = base64.b64encode(payload).decode()
        return exported

    subscriptions = _by_session(rows.subscription)
    owed = _by_session(rows.owed)
    received = _by_session(rows.received)
    for session in rows.session.values():
        will = None
        if session.will:
            due = {"delay": session.will_delay, "due_at": to_date(session.will_at)}
            will = message(session.will) | due
        yield {
            "session": session.client_id,
            "user": session.username,
            "expiry": session.expiry,
            "ends_at": to_date(session.ends_at),
            "will": will,
            "subscriptions": [
                {
                    "filter": row.filter,
                    "qos": row.qos,
                    "identifier": row.identifier,
                    "max_rate": row.max_rate or None,
                }
                for row in subscriptions[session.id]
            ],
            "messages": [
                message(row.message) | {"qos": row.qos, "packet_id": row.packet_id}
                for row in sorted(owed[session.id], key=lambda row: row.id)
            ],
            "unreleased": [
                message(row.message) | {"packet_id": row.packet_id} for row in received[session.id]
            ],
        }
    for row in rows.retained.values():
        yield {"retained": message(row.message)}
    for backlog in _backlogs(rows):
        yield {
            "upstream": backlog.link,
            "lane": backlog.lane,
            "messages": backlog.messages,
            "bytes": backlog.size,
            "oldest": backlog.oldest,
        }


def _now(rows: Rows) -> float:
    """The store's time."""
    stamp = stamp_of(rows.clock)
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
        for key, row in rows.retained.items():
            message = rows.message.get(cast(int, row.message))
            topic = cast(str, message.topic) if message is not None else ""
            if any(matches(each, topic) for each in filters):
                batch.remove(Table.RETAINED, key)
        return len(batch.deleted[Table.RETAINED])


def prune_upstream(path: Path, link: str) -> int:
    """Delete all that is stored for a link to another broker; returns how many messages.

    Raises:
        StoreError: an appliance is running, or there is no database, or nothing of that link.
        sqlite3.Error, OSError: it cannot be written.
    """
    with _changing(path) as (rows, batch):
        found = [backlog for backlog in _backlogs(rows) if backlog.link == link]
        for key, row in rows.segment.items():
            if row.link == link:
                batch.remove(Table.SEGMENT, key)
                batch.remove_records(key)
        for key, latest in rows.latest.items():
            if latest.link == link:
                batch.remove(Table.LATEST, key)
        if not batch:
            raise StoreError(f"nothing waits for an upstream {link!r}")
        return sum(backlog.messages for backlog in found)


@contextlib.contextmanager
def _changing(path: Path) -> Iterator[tuple[Rows, Batch]]:
    """All rows, and a batch of changes that is written at the end.

    Messages that nothing refers to any more are deleted as well, and the file shrinks.
    """
    _require(path)
    with _locked(path):
        rows, batch = read(path), Batch(0, 1 << 62)
        yield rows, batch
        references = (
            (Table.SESSION, ((row.id, row.will) for row in rows.session.values())),
            (Table.OWED, ((row.id, row.message) for row in rows.owed.values())),
            (Table.RECEIVED, ((row.id, row.message) for row in rows.received.values())),
            (Table.RETAINED, ((row.id, row.message) for row in rows.retained.values())),
        )
        used = {
            message
            for table, pairs in references
            for key, message in pairs
            if key not in batch.deleted[table]
        }
        for key in rows.message.keys() - used:
            batch.remove(Table.MESSAGE, key)
        with contextlib.closing(connect(path)) as connection:
            connection.execute("PRAGMA secure_delete = ON")  # gone, even if VACUUM has no room
            write(connection, batch)
            # VACUUM needs as much disk again for a moment; without that the file stays large.
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
    """Delete messages that have waited for sessions for longer than `older_than` seconds.

    Without `older_than`, delete the sessions. With `client_ids`, only those of these clients.
    Returns the numbers of sessions and messages that were deleted.

    Raises:
        StoreError: an appliance is running, there is no database, or no such client.
        sqlite3.Error, OSError: it cannot be written.
    """
    with _changing(path) as (rows, batch):
        chosen = {
            key: row
            for key, row in rows.session.items()
            if not client_ids or row.client_id in client_ids
        }
        missing = set(client_ids) - {row.client_id for row in chosen.values()}
        if missing:
            raise StoreError(f"no session of {', '.join(map(repr, sorted(missing)))} is kept")
        limit = None if older_than is None else _now(rows) - older_than
        for key, row in rows.owed.items():
            stored = rows.message.get(cast(int, row.message)) if row.message is not None else None
            if row.session in chosen and (
                limit is None or (stored is not None and cast(float, stored.stored_at) < limit)
            ):
                batch.remove(Table.OWED, key)
        if limit is None:
            for key in chosen:
                batch.remove(Table.SESSION, key)
            for key, subscription in rows.subscription.items():
                if subscription.session in chosen:
                    batch.remove(Table.SUBSCRIPTION, key)
            for key, received in rows.received.items():
                if received.session in chosen:
                    batch.remove(Table.RECEIVED, key)
        return len(batch.deleted[Table.SESSION]), len(batch.deleted[Table.OWED])
