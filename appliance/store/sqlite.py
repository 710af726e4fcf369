"""The store on disk: what the broker stages, in batches, to the writer's thread."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import cast

from appliance.broker.accounts import Account
from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.ports import Identity
from appliance.broker.saved_sessions import restore
from appliance.broker.session import Delivery, Session, UnreleasedPublish
from appliance.host.clock import NUDGE, StepWatch
from appliance.mqtt.packets import Subscription
from appliance.net.callbacks import Entries, PeriodicCallback
from appliance.store import database
from appliance.store.clock import KEY, Clocks, Stamp, boot_id, stamp_of
from appliance.store.loader import (
    Loaded,
    load,
    message_row,
    owed_row,
    received_row,
    retained_row,
    session_row,
    subscription_row,
)
from appliance.store.schema import Durability, StoreError, Table
from appliance.store.writer import Batch, Writer

log = logging.getLogger("appliance.store")

#: Seconds that a change may wait which nobody waits for, such as that a message was acknowledged:
#: most often it goes with one that somebody does. It is what is repeated after a power cut.
LINGER = 1.0

#: Seconds until a batch that could not be written is tried again.
RETRY = 1.0

#: Seconds between two looks at the wall clock. What is too old is looked for as often.
CLOCK_CHECK = 10.0

#: Bytes that a message takes in the database beside topic, payload and properties, roughly, with
#: what it is owed to.
MESSAGE_OVERHEAD = 120


class _Stored:
    """The row of a message, and how many rows refer to it."""

    __slots__ = ("expires_at", "key", "references", "size", "stored_at")

    def __init__(self, key: int, message: Message, stored_at: float) -> None:
        self.key = key
        self.references = 0
        self.size = len(message.topic_wire) + len(message.payload) + MESSAGE_OVERHEAD
        self.size += len(message.properties_wire)
        self.expires_at = message.expires_at
        self.stored_at = stored_at


class _Known:
    """The rows of a session, and whose room they take."""

    __slots__ = ("account", "filters", "key", "owed", "received", "recorded", "will")

    def __init__(self, key: int, account: Account) -> None:
        self.key = key
        self.account = account
        self.filters: dict[str, int] = {}
        #: By the delivery's identity: its row, itself, and its place in the order of sending.
        self.owed: dict[int, tuple[int, Delivery, int | None]] = {}
        #: After PUBREC, by packet id.
        self.recorded: dict[int, int] = {}
        self.received: dict[int, tuple[int, Message]] = {}
        self.will: Message | None = None


class SqliteStore:
    """The `Store` in a SQLite database; `open`, `restore`, `start`, and at the end `close`.

    `size` is the most that messages may take, in bytes, and `age`, in seconds, how long they may
    wait at most; None for ever. Only the event loop's thread may call it.
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
        self.path = path
        self.size = size
        self.age = age
        self.staged = False
        self.fresh = False
        self.batch = 1
        self.committed = 0
        #: Bytes of all messages, as they are counted against `size`.
        self.bytes = 0
        #: What was committed so far, for the log: batches, rows, messages, the largest group.
        self.commits = 0
        self.messages_written = 0
        self.largest_group = 0
        self._durability: Durability = durability
        self._wall = wall
        self._boot = boot
        #: What the store's own time is ahead of the loop's.
        self._offset = 0.0
        self._steps = StepWatch(0.0, wall)
        self._stamped = 0
        self._lock: int | None = None
        self._contents: database.Contents | None = None
        self._loop: asyncio.AbstractEventLoop
        self._entries: Entries
        self._writer = Writer(path, durability, self._done_soon)
        self._keys = itertools.count(1)
        self._sessions: dict[Session, _Known] = {}
        self._messages: dict[Message, _Stored] = {}
        self._retained: dict[str, tuple[int, Message, Account]] = {}
        self._open = Batch(self.batch, 1)
        #: Whether something may depend on what is in the open batch.
        self._depended = False
        #: Whether anything has changed since it was opened.
        self._is_changed = False
        self._failed: Batch | None = None
        self._failing = False
        self._writing = False
        self._running = False
        self._timer: asyncio.TimerHandle | None = None
        self._clock: PeriodicCallback | None = None
        self._tell: Callable[[bool], None] = lambda kept: None
        #: Whether somebody waits for what is in the open batch.
        self._urgent = False
        self._outcome: asyncio.Future[None] | None = None

    @property
    def failing(self) -> bool:
        """Whether nothing can be written now."""
        return self._failing

    # --- start and end -------------------------------------------------------------------------

    def open(self) -> None:
        """Take hold of the database and read it.

        Raises:
            StoreError: another appliance has it, a newer one made it, or it cannot be read.
        """
        try:
            database.make_directory(self.path)
            self._take_lock()
        except OSError as error:
            try:
                found = self.path.exists()
            except PermissionError:
                raise StoreError(database.belongs_to_another(self.path)) from None
            if found:
                log.warning("%s: %s", error.filename, error.strerror)
            else:
                raise StoreError(
                    f"{error.filename or self.path}: {error.strerror} (broker.store.path)"
                ) from None
        try:
            self._contents = database.read(self.path, self._durability)
        except BaseException:
            self._let_go()
            raise

    def _take_lock(self) -> None:
        self._lock = database.lock(self.path)
        if self._lock is None:
            raise StoreError(
                f"{self.path} is in use by another appliance: stop that one, or set another "
                "broker.store.path"
            )

    def _let_go(self) -> None:
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)

    def restore(self, broker: Broker) -> None:
        """Give the broker what was kept; to be called on the event loop, after `open`."""
        contents, self._contents = self._contents, None
        assert contents is not None
        self._loop = asyncio.get_running_loop()
        self._entries = Entries(self._loop, broker.faults)
        self._set_clock(stamp_of(contents.rows[Table.CLOCK].get(KEY)))
        loaded = load(contents.rows, self._offset)
        self._keys = itertools.count(loaded.last_key + 1)
        self._open.first_id = loaded.last_key + 1
        if contents.rescued:
            self._open.first_id = 1  # nothing is in the new database
            for table in Table:
                self._open.rows[table].update(contents.rows[table])
        self._put_stamp()
        for key, message in loaded.messages.items():
            self._messages[message] = stored = _Stored(key, message, 0.0)
            stored.stored_at = float(contents.rows[Table.MESSAGE][key][8] or 0.0)
            self.bytes += stored.size
        self._adopt(broker, loaded, contents.rows)
        for table, key in loaded.useless:
            self._open.rows[table].pop(key, None)
            self._open.deleted[table][key] = None
        for message, stored in list(self._messages.items()):
            if not stored.references:
                self._forget(message)
        self._writer.start(contents.connection)
        self._running = True
        if contents.problem:
            self._failing = True
            self._complain(contents.problem)
            self._stage_lazily()
            self._tell(False)
        elif contents.rescued:
            self._hand_over()
        self._clock = self._entries.every("store.clock", CLOCK_CHECK, self._check_clock)
        if loaded.sessions or loaded.retained:
            log.info(
                "%d sessions, %d messages and %d retained messages restored from %s",
                sum(1 for session in loaded.sessions.values() if session.kept.expiry),
                sum(
                    len(session.inflight) + len(session.queue) + len(session.received)
                    for session in loaded.sessions.values()
                ),
                len(loaded.retained),
                self.path,
            )

    def _adopt(self, broker: Broker, loaded: Loaded, rows: database.Rows) -> None:
        accounts = broker.accounting.accounts
        for key, (message, username, is_inside) in loaded.retained.items():
            before = self._retained.get(message.topic)
            if before is not None:
                self._open.remove(Table.RETAINED, before[0])
                self._release(*before[1:])
            owner = accounts.inside if is_inside else accounts.of_user(username)
            self._retained[message.topic] = key, message, owner
            self._adopt_message(message, owner)
        restore(
            broker,
            [session.kept for session in loaded.sessions.values()],
            [(message, owner) for _, message, owner in self._retained.values()],
        )
        for entry in loaded.sessions.values():
            session = entry.kept.session
            assert session is not None
            known = self._sessions[session] = _Known(entry.key, session.account)
            known.filters = entry.filters
            flying = zip(entry.inflight, session.inflight.items(), strict=True)
            for key, (packet_id, delivery) in flying:
                if delivery is None:
                    known.recorded[packet_id] = key
                else:
                    self._take(known, key, delivery, cast(int, rows[Table.OWED][key][8]))
            for key, delivery in zip(entry.queue, session.queue, strict=True):
                self._take(known, key, delivery, None)
            for packet_id, held in session.received.items():
                known.received[packet_id] = entry.received[packet_id], held.message
                self._adopt_message(held.message, known.account)
            if entry.kept.will is not None:
                known.will = entry.kept.will.message
                self._adopt_message(known.will, known.account)
            if entry.kept.ends_at is None:  # its time runs from now on, through further restarts
                self._put_session(session, known)

    def _take(self, known: _Known, key: int, delivery: Delivery, sent: int | None) -> None:
        known.owed[id(delivery)] = key, delivery, sent
        self._adopt_message(delivery[0], known.account)

    def _adopt_message(self, message: Message, account: Account) -> None:
        stored = self._messages[message]
        stored.references += 1
        account.stored += stored.size

    async def close(self) -> None:
        """Write what is left, and end; may be called twice, and instead of `restore`."""
        if self._contents is not None and self._contents.connection is not None:
            self._contents.connection.close()
        if self._running:
            self._running = False
            for timer in (self._timer, self._clock):
                if timer is not None:
                    timer.cancel()
            while self._writing:
                await self._next_outcome()
            # What `restore` alone has changed, the next start would change as well.
            if self._failed is not None or (self._open and self._is_changed):
                self._put_stamp()
                self._hand_over()
                await self._next_outcome()
            await self._loop.run_in_executor(None, self._writer.stop)
            if self._failed is not None:
                log.error("%d changes could not be stored, and are lost", len(self._failed))
            elif self.messages_written:
                log.info(
                    "store: %d commits of %.1f messages on average, the largest of %d",
                    self.commits,
                    self.messages_written / self.commits,
                    self.largest_group,
                )
        self._let_go()

    async def _next_outcome(self) -> None:
        self._outcome = self._loop.create_future()
        await self._outcome

    # --- batches -------------------------------------------------------------------------------

    def listen(self, callback: Callable[[bool], None]) -> None:
        """See `Store`."""
        self._tell = callback

    def hurry(self) -> None:
        """See `Store`."""
        self._urgent = True
        # Nothing passes what waits, also when nothing was staged in the batch that it waits for.
        self.staged = not self._failing
        if self._running and not self._writing and not self._failing:
            self._hand_over()

    def _stage(self) -> None:
        """Something may depend on what was just staged."""
        self.fresh = self._depended = True
        if not self._failing:
            self.staged = True
        self._stage_lazily()

    def _stage_lazily(self) -> None:
        """Nothing depends on it: it is written when something else is, or in a while."""
        self._is_changed = True
        if self._timer is None and self._running and not self._writing:
            delay = RETRY if self._failing else LINGER
            self._timer = self._entries.later(
                "store.write", delay, self._write_in_time, failed=self._write_later
            )

    def _write_later(self) -> None:
        self._timer = None
        self._stage_lazily()

    def _write_in_time(self) -> None:
        self._timer = None
        if not self._writing and (self._open or self._failed is not None or self._failing):
            self._hand_over()

    def _hand_over(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        batch = self._open
        if self._failed is not None:
            self._failed.absorb(batch)
            batch, self._failed = self._failed, None
        self.batch += 1
        key = next(self._keys)
        self._open = Batch(self.batch, key)
        self._depended = self._urgent = False
        self._writing = True
        self._writer.write(batch)

    def _done_soon(self, batch: Batch, error: Exception | None, seconds: float) -> None:
        """On the writer's thread: the outcome is for the event loop's."""
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody wants to know
            self._entries.from_thread(
                "store.done", self._done, batch, error, failed=partial(self._not_done, batch)
            )

    def _done(self, batch: Batch, error: Exception | None) -> None:
        self._writing = False
        try:
            self._settle(batch, error)
        finally:  # whatever is wrong with this batch, the next one is written
            if self._running and not self._writing:
                if self._urgent and not self._failing:
                    self._hand_over()
                elif self._open or self._failing:
                    self._stage_lazily()

    def _not_done(self, batch: Batch) -> None:
        """Nobody has heard of the batch's end: it is written again, which changes nothing."""
        if self._writing:
            self._done(batch, RuntimeError("a fault in the appliance"))

    def _settle(self, batch: Batch, error: Exception | None) -> None:
        if error is None:
            self.committed = batch.number
            self.commits += 1
            self.messages_written += batch.messages
            self.largest_group = max(self.largest_group, batch.messages)
            if self._failing:
                log.warning("%s can be written again; all that was waiting is kept", self.path)
            self._failing = False
            self.staged = self._depended
        else:
            self._failed = batch
            self.staged = False
            if not self._failing:
                self._failing = True
                self._complain(str(error))
        outcome, self._outcome = self._outcome, None
        if outcome is not None:
            outcome.set_result(None)
        self._entries.faults.run("store.committed", self._tell, error is None, otherwise=None)

    def _complain(self, problem: str) -> None:
        log.error(
            "%s CANNOT BE WRITTEN: %s. QoS 1 and 2 messages for sessions that are stored, and "
            "retained ones, are refused until it can; that is tried every %g s",
            self.path,
            problem,
            RETRY,
        )

    def _clocks(self) -> Clocks:
        return Clocks(self._wall(), self._loop.time(), self._boot())

    def _set_clock(self, stamp: Stamp | None) -> None:
        """Let the store's time go on from what was stored."""
        clocks = self._clocks()
        self._steps = StepWatch(clocks.counted, self._wall)
        self._offset = (clocks.wall if stamp is None else stamp.later(clocks)) - clocks.counted
        if stamp is not None and clocks.wall < stamp.clocks.wall - NUDGE:
            log.warning(
                "this computer's clock is behind that of the last run by %.0f s: sessions and "
                "messages expire as if it had not been switched off since",
                stamp.clocks.wall - clocks.wall,
            )

    def _put_stamp(self) -> None:
        clocks = self._clocks()
        stamp = Stamp(clocks.counted + self._offset, clocks)
        self._open.put(Table.CLOCK, KEY, stamp.row())
        self._stamped = self.batch

    def _check_clock(self) -> None:
        """Keep what the clocks say: with what is written anyway, and when the wall clock was set,
        as it is on a robot after its boot."""
        self._drop_old()
        if self._steps.look(self._loop.time()) or self._stamped < self.batch - 1:
            self._put_stamp()
            self._stage_lazily()

    def _drop_old(self) -> None:
        """Drop what has waited for longer than `age`."""
        if self.age is None:
            return
        limit = self._loop.time() + self._offset - self.age
        oldest = next(iter(self._messages.values()), None)
        if oldest is None or oldest.stored_at >= limit:
            return

        def is_old(message: Message) -> bool:
            stored = self._messages.get(message)
            return stored is not None and stored.stored_at < limit

        dropped = sum(session.drop_queued(is_old) for session in list(self._sessions))
        if dropped:
            log.warning(
                "%d messages have waited for longer than %g s and are dropped (broker.store.age)",
                dropped,
                self.age,
            )

    # --- messages ------------------------------------------------------------------------------

    def _refer(self, message: Message, account: Account, expiry: int | None = None) -> int:
        """The key of the message's row, which is made when there is none, for one who refers.

        `expiry` is that of a will.
        """
        stored = self._messages.get(message)
        if stored is None:
            stored = _Stored(next(self._keys), message, self._loop.time() + self._offset)
            self._messages[message] = stored
            self.bytes += stored.size
            self._open.messages += 1
            self._put_message(message, stored, expiry)
        elif stored.expires_at is not message.expires_at:  # a will that is published
            self._put_message(message, stored)
        stored.references += 1
        account.stored += stored.size
        return stored.key

    def _put_message(self, message: Message, stored: _Stored, expiry: int | None = None) -> None:
        stored.expires_at = message.expires_at
        row = message_row(stored.key, message, self._offset, stored.stored_at, expiry)
        self._open.put(Table.MESSAGE, stored.key, row)

    def _release(self, message: Message, account: Account) -> None:
        """One less refers to it."""
        stored = self._messages[message]
        stored.references -= 1
        account.stored -= stored.size
        if not stored.references:
            self._forget(message)

    def _forget(self, message: Message) -> None:
        stored = self._messages.pop(message)
        self.bytes -= stored.size
        self._open.remove(Table.MESSAGE, stored.key)

    # --- what is staged ------------------------------------------------------------------------

    def session_saved(self, session: Session) -> None:
        """See `Store`; a session without expiry is kept as long as it has a will, for that."""
        if not session.expiry and session.will is None:
            self.session_removed(session)
            return
        if type(session.identity) is not Identity:
            return  # it is nobody's yet
        known = self._sessions.get(session)
        is_new = known is None
        if known is None:
            known = self._sessions[session] = _Known(next(self._keys), session.account)
        will = session.will.message if session.will is not None else None
        if will is not known.will:
            if session.will is not None:
                self._refer(session.will.message, known.account, session.will.expiry)
            if known.will is not None:
                self._release(known.will, known.account)
            known.will = will
        self._put_session(session, known)
        if not session.expiry:
            self._drop(known)
        elif is_new:
            self._put_all(session)
        if session.link is not None:
            self._stage()
        else:
            self._stage_lazily()

    def _put_session(self, session: Session, known: _Known) -> None:
        will = self._messages[known.will].key if known.will is not None else None
        row = session_row(known.key, session, will, self._offset)
        self._open.put(Table.SESSION, known.key, row)

    def _put_all(self, session: Session) -> None:
        """A session that has something already is stored for the first time."""
        for subscription in session.subscriptions.values():
            self.subscribed(session, subscription)
        for packet_id, delivery in session.inflight.items():
            if delivery is not None:
                self.sent(session, delivery, packet_id)
        for delivery in session.queue:
            self.queued(session, delivery)
        for packet_id, held in session.received.items():
            self.held(session, packet_id, held)

    def _drop(self, known: _Known) -> None:
        """Forget all of a session but for itself and its will."""
        for key in known.filters.values():
            self._open.remove(Table.SUBSCRIPTION, key)
        for key, delivery, _ in known.owed.values():
            self._open.remove(Table.OWED, key)
            self._release(delivery[0], known.account)
        for key in known.recorded.values():
            self._open.remove(Table.OWED, key)
        for key, message in known.received.values():
            self._open.remove(Table.RECEIVED, key)
            self._release(message, known.account)
        for rows in (known.filters, known.owed, known.recorded, known.received):
            rows.clear()

    def session_removed(self, session: Session) -> None:
        """See `Store`."""
        known = self._sessions.pop(session, None)
        if known is None:
            return
        self._drop(known)
        if known.will is not None:
            self._release(known.will, known.account)
        self._open.remove(Table.SESSION, known.key)
        self._stage()

    def subscribed(self, session: Session, subscription: Subscription) -> None:
        """See `Store`."""
        known = self._sessions.get(session)
        if known is None:
            return
        key = known.filters.get(subscription.filter)
        if key is None:
            key = known.filters[subscription.filter] = next(self._keys)
        replaying = subscription.qos > 0 and subscription.filter in session.replays
        row = subscription_row(key, known.key, subscription, replaying=replaying)
        self._open.put(Table.SUBSCRIPTION, key, row)
        self._stage()

    def unsubscribed(self, session: Session, topic_filter: str) -> None:
        """See `Store`."""
        known = self._sessions.get(session)
        key = known.filters.pop(topic_filter, None) if known is not None else None
        if key is not None:
            self._open.remove(Table.SUBSCRIPTION, key)
            self._stage()

    def retained(self, message: Message, owner: Account) -> None:
        """See `Store`; the broker's own topics are made anew by every run, and not kept."""
        topic = message.topic
        if topic.startswith("$"):
            return
        before = self._retained.pop(topic, None)
        if message.payload:
            key = before[0] if before is not None else next(self._keys)
            row = retained_row(key, self._refer(message, owner), owner)
            self._open.put(Table.RETAINED, key, row)
            self._retained[topic] = key, message, owner
        elif before is not None:
            self._open.remove(Table.RETAINED, before[0])
        if before is not None:
            self._release(*before[1:])
        if message.qos:
            self._stage()
        else:
            self._stage_lazily()

    def queued(self, session: Session, delivery: Delivery) -> None:
        """See `Store`."""
        self._owe(session, delivery, None)

    def sent(self, session: Session, delivery: Delivery, packet_id: int) -> None:
        """See `Store`."""
        self._owe(session, delivery, packet_id)

    def _owe(self, session: Session, delivery: Delivery, packet_id: int | None) -> None:
        known = self._sessions.get(session)
        if known is None:
            return
        entry = known.owed.get(id(delivery))
        if entry is None:
            key = next(self._keys)
            message = self._refer(delivery[0], known.account)
        else:
            key = entry[0]
            message = self._messages[delivery[0]].key
        sent = next(self._keys) if packet_id is not None else None
        known.owed[id(delivery)] = key, delivery, sent
        row = owed_row(key, known.key, message, delivery, packet_id, sent)
        self._open.put(Table.OWED, key, row)
        self._stage()

    def settled(self, session: Session, delivery: Delivery) -> None:
        """See `Store`."""
        known = self._sessions.get(session)
        entry = known.owed.pop(id(delivery), None) if known is not None else None
        if entry is not None:
            self._open.remove(Table.OWED, entry[0])
            self._release(delivery[0], session.account)
            self._stage_lazily()

    def recorded(self, session: Session, delivery: Delivery, packet_id: int) -> None:
        """See `Store`."""
        known = self._sessions.get(session)
        entry = known.owed.pop(id(delivery), None) if known is not None else None
        if known is not None and entry is not None:
            key, _, sent = entry
            known.recorded[packet_id] = key
            row = owed_row(key, known.key, None, delivery, packet_id, sent)
            self._open.put(Table.OWED, key, row)
            self._release(delivery[0], known.account)
            self._stage()

    def completed(self, session: Session, packet_id: int) -> None:
        """See `Store`."""
        known = self._sessions.get(session)
        key = known.recorded.pop(packet_id, None) if known is not None else None
        if key is not None:
            self._open.remove(Table.OWED, key)
            self._stage_lazily()

    def held(self, session: Session, packet_id: int, held: UnreleasedPublish) -> None:
        """See `Store`."""
        known = self._sessions.get(session)
        if known is None:
            return
        key = next(self._keys)
        known.received[packet_id] = key, held.message
        message = self._refer(held.message, known.account)
        full = [
            self._sessions[each].key
            for each in held.full
            if isinstance(each, Session) and each in self._sessions
        ]
        row = received_row(key, known.key, packet_id, message, held, full)
        self._open.put(Table.RECEIVED, key, row)
        self._stage()

    def unheld(self, session: Session, packet_id: int) -> None:
        """See `Store`."""
        known = self._sessions.get(session)
        entry = known.received.pop(packet_id, None) if known is not None else None
        if entry is not None:
            self._open.remove(Table.RECEIVED, entry[0])
            self._release(entry[1], session.account)
            self._stage()
