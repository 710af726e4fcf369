"""The store in a SQLite database, from its start to its end."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import cast

from appliance.broker.broker import Broker
from appliance.broker.saved_sessions import restore
from appliance.net.callbacks import Entries, PeriodicCallback
from appliance.store.clock import KEY, StoreClock, boot_id, stamp_of
from appliance.store.committer import CommitMetrics
from appliance.store.database import Contents, Database
from appliance.store.loader import Loaded, load
from appliance.store.rows import LOADED, Rows, Table
from appliance.store.schema import Durability
from appliance.store.staging import StagingStore, StoredSession
from appliance.store.unread import UnreadQueue, UnreadQueues

log = logging.getLogger("appliance.store")

#: Seconds between two checks of the wall clock, and of the age of messages.
CLOCK_CHECK = 10.0


class SqliteStore(StagingStore):
    """A `SessionStore` in a SQLite database: `open`, `restore`, and at the end `close`.

    It inherits what the broker calls, because the broker does so several times for each message and
    a delegated call costs as much as some of these calls do.

    `size` is the most bytes that messages may take, and `age` the seconds that they may wait at
    most, None for any time.
    """

    def __init__(
        self,
        path: Path,
        durability: Durability = "power",
        *,
        size: int = 1 << 30,
        age: float | None = None,
        wall: Callable[[], float] = time.time,
        boot: Callable[[], str] = boot_id,
    ) -> None:
        super().__init__(path, durability, size, StoreClock(wall, boot))
        self._age = age
        self._database = Database(path, durability)
        #: The batch that the clock's stamp was last put into.
        self._stamped = 0
        self._clock_check: PeriodicCallback | None = None
        #: What the start has left to be read, if there was much.
        self._unread: UnreadQueues | None = None

    @property
    def path(self) -> Path:
        """The database."""
        return self._database.path

    @property
    def failing(self) -> bool:
        """See `SessionStore`."""
        return self._committer.failing

    @property
    def metrics(self) -> CommitMetrics:
        """What was committed since the start."""
        return self._committer.metrics

    def begin_opening(self) -> None:
        """Begin to read the database beside the start; `open` follows."""
        self._database.begin_opening()

    def open(self) -> None:
        """See `SessionStore`."""
        self._database.open()

    def restore(self, broker: Broker) -> None:
        """See `SessionStore`."""
        loop = asyncio.get_running_loop()
        contents = self._database.take_contents()
        rows = contents.rows
        self._clock.start(loop.time, stamp_of(rows.clock))
        loaded = load(rows, self._clock.offset)
        self._prepare_batch(contents, loaded.last_key + 1)
        for key, message in loaded.messages.items():
            stored_at = cast(float, rows.message[key].stored_at)
            self._messages.load(key, message, stored_at)
        if rows.unread.queues:
            self._unread = self._leave_unread(loaded, rows)
        self._restore_retained(broker, loaded)
        restore(
            broker,
            [session.saved for session in loaded.sessions.values()],
            [(message, owner) for _, message, owner in self._retained.values()],
        )
        self._restore_sessions(loaded, rows)
        batch = self._committer.open
        for table, key in loaded.useless:
            batch.rows[table].pop(key, None)
            batch.deleted[table][key] = None
        self._messages.delete_unreferenced()
        entries = Entries(loop, broker.faults)
        self.backlogs.restore(loaded.backlogs, entries)
        self._committer.start(entries, contents.connection, contents.problem)
        if contents.salvaged and not contents.problem:
            self._committer.commit()
        self._clock_check = entries.every("store.clock", CLOCK_CHECK, self._check_clock)
        later = len(self._unread) if self._unread is not None else 0
        if loaded.sessions or loaded.retained:
            log.info(
                "%d sessions, %d messages and %d retained messages restored from %s%s",
                sum(1 for session in loaded.sessions.values() if session.saved.expiry),
                later
                + sum(
                    len(session.inflight) + len(session.queue) + len(session.received)
                    for session in loaded.sessions.values()
                ),
                len(loaded.retained),
                self.path,
                f"; {later} of the messages are read while clients are served" if later else "",
            )
        if self._unread is not None:
            self._unread.start(entries, broker.router.shares.get, broker.flush)

    def _prepare_batch(self, contents: Contents, next_key: int) -> None:
        """Begin the first batch, with what is not in the database yet."""
        committer = self._committer
        committer.start_keys(next_key)
        if contents.salvaged:
            for table in LOADED:
                committer.open.rows[table].update(contents.rows.of(table))
        self._put_stamp()

    def _leave_unread(self, loaded: Loaded, rows: Rows) -> UnreadQueues:
        """Give the sessions the rows that are read later."""
        unread = UnreadQueues(
            self.path,
            loaded,
            rows.unread,
            self._clock.offset,
            self,
            self._messages,
            self._committer,
        )
        for session in loaded.sessions.values():
            if session.unread is not None:
                session.saved.unread = unread.add(session.unread)
        for orphan in loaded.orphans:
            unread.drop_rows(list(orphan.keys))
        return unread

    def _restore_retained(self, broker: Broker, loaded: Loaded) -> None:
        accounts = broker.accounting.accounts
        for key, (message, username, is_inside) in loaded.retained.items():
            before = self._retained.get(message.topic)
            if before is not None:  # a second one of its topic
                self._committer.open.remove(Table.RETAINED, before[0])
                self._messages.release(*before[1:])
            owner = accounts.inside if is_inside else accounts.of_user(username)
            self._retained[message.topic] = key, message, owner
            self._messages.refer(message, owner)

    def _restore_sessions(self, loaded: Loaded, rows: Rows) -> None:
        """Remember which rows the sessions have that the broker has restored."""
        refer = self._messages.refer
        for entry in loaded.sessions.values():
            session = entry.saved.session
            assert session is not None
            stored = self._sessions[session] = StoredSession(entry.key, session.account)
            if self._unread is not None and isinstance(entry.saved.unread, UnreadQueue):
                self._unread.attach(entry.saved.unread, session, stored)
            stored.filters = entry.filters
            inflight = zip(entry.inflight, session.inflight.items(), strict=True)
            for key, (packet_id, delivery) in inflight:
                if delivery is None:
                    stored.recorded[packet_id] = key
                else:
                    stored.owed[id(delivery)] = key, delivery, cast(int, rows.owed[key].sent)
                    refer(delivery[0], stored.account)
            for key, delivery in zip(entry.queue, session.queue, strict=True):
                stored.owed[id(delivery)] = key, delivery, None
                refer(delivery[0], stored.account)
            for packet_id, held in session.received.items():
                stored.received[packet_id] = entry.received[packet_id], held.message
                refer(held.message, stored.account)
            if entry.saved.will is not None:
                stored.will = entry.saved.will.message
                refer(stored.will, stored.account)
            if entry.saved.ends_at is None:  # it expires from now on, also after further restarts
                self._put_session(session, stored)

    async def close(self) -> None:
        """See `SessionStore`."""
        if self._clock_check is not None:
            self._clock_check.cancel()
        if self._unread is not None:
            self._unread.stop()
        await self.backlogs.stop_reading()  # or the writer could not empty the write-ahead log
        await self._committer.stop(self._put_stamp)
        self._database.close()

    def _put_stamp(self) -> None:
        self._committer.open.put(Table.CLOCK, KEY, self._clock.stamp().row())
        self._stamped = self.batch

    def _check_clock(self) -> None:
        """Store the clocks with what is committed anyway, and whenever the wall clock was set.

        On a robot without a battery for its clock that happens some time after each boot.
        """
        self._drop_old()
        if self._clock.was_set() or self._stamped < self.batch - 1:
            self._put_stamp()
            self._committer.stage_lazily()

    def _drop_old(self) -> None:
        """Drop messages that have waited for longer than `age`."""
        is_old = self._messages.older_than(self._age) if self._age is not None else None
        if is_old is None:
            return
        dropped = sum(session.drop_queued(is_old) for session in list(self._sessions))
        if dropped:
            log.warning(
                "%d messages have waited for longer than %g s and are dropped (broker.store.age)",
                dropped,
                self._age,
            )
