"""The queues that a start has left in the database: they are read while clients are served.

A start that reads 400,000 queued messages takes seconds in which no client is answered. So it
reads the sessions only, and where the rows of their queues are; `UnreadQueues` reads these, some in
each turn of the event loop.
"""

from __future__ import annotations

import asyncio
import logging
import sqlite3
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

from appliance.broker.delivery import Delivery
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.broker.shared import Share
from appliance.net.callbacks import Entries
from appliance.store.committer import Committer
from appliance.store.loader import Loaded, message_of, pending_of
from appliance.store.messages import StoredMessages
from appliance.store.rows import (
    COLUMNS,
    MESSAGES_OF,
    ROW_TYPES,
    SIZE,
    MessageRow,
    OwedRow,
    Table,
    UnreadContents,
    UnreadRows,
)
from appliance.store.schema import connect_beside
from appliance.store.staging import StoredSession
from appliance.store.state import StoreState

log = logging.getLogger("appliance.store")

#: Messages, and bytes of them, that are read in one turn of the event loop: a millisecond.
MESSAGES_A_TURN = 100
BYTES_A_TURN = 256 * 1024

#: The least part of a turn that a queue takes, and the most messages that are read before it is
#: known how large they are.
A_QUEUE = 0.05
AT_ONCE = 25

#: Seconds until a turn that has failed is repeated.
AGAIN = 0.1

#: Rows that one statement selects.
_SELECTED = 100

#: Seconds between two reports in the log.
REPORT = 5.0


def _marks(keys: Sequence[int]) -> str:
    return ",".join("?" * len(keys))


def _text(data: bytes) -> str | bytes:
    """Text that is damaged makes its own row wrong, and not the others."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data


class UnreadQueue:
    """The rows of a session's queue that were not read yet: the port `Unread`."""

    def __init__(self, queues: UnreadQueues, rows: UnreadRows) -> None:
        self._queues = queues
        self.rows = rows
        #: The keys of rows that could not be read.
        self.left: list[int] = []
        #: Set when the broker has restored the session.
        self.session: Session
        self.stored: StoredSession

    @property
    def count(self) -> int:
        """See `Unread`."""
        return len(self.rows)

    @property
    def bytes(self) -> int:
        """See `Unread`."""
        return self.rows.bytes

    @property
    def is_shared(self) -> bool:
        """See `Unread`."""
        return self.rows.is_shared

    def read(self, count: int) -> list[Delivery]:
        """See `Unread`."""
        return self._queues.read(self, count)

    def hurry(self) -> None:
        """See `Unread`."""
        self._queues.hurry(self)

    def drop(self) -> None:
        """Delete the rows: the session has ended."""
        self._queues.drop(self)


class UnreadQueues:
    """Reads the queues: in turns, and earlier what a client or the broker waits for.

    A message that several rows refer to is read once. Until the last of these rows is read, it is
    kept in memory and in the database, whatever becomes of the others.
    """

    def __init__(
        self,
        path: Path,
        loaded: Loaded,
        unread: UnreadContents,
        offset: float,
        state: StoreState,
        messages: StoredMessages,
        committer: Committer,
    ) -> None:
        self._path = path
        self._offset = offset
        self._state = state
        self._messages = messages
        self._committer = committer
        self._connection: sqlite3.Connection | None = None
        #: Those that were not read to their end; among them those that somebody waits for, the
        #: longest wait first.
        self._queues: dict[UnreadQueue, None] = {}
        self._awaited: dict[UnreadQueue, None] = {}
        self._references = unread.references
        #: Messages that rows refer to which were not read yet, by their keys.
        self._known: dict[int, Message] = {}
        self._topics: dict[str, bytes] = {}
        self._share_of: Callable[[str], Share | None]
        self._flush: Callable[[], None]
        self._entries: Entries
        self._timer: asyncio.TimerHandle | None = None
        self._total = self._left_there = self._wrong = 0
        self._began = self._report_at = 0.0
        self._is_running = self._is_stopped = False
        state.bytes = unread.stored
        for key, message in loaded.messages.items():
            if key in self._references:
                messages.hold(message)
                self._known[key] = message

    def __len__(self) -> int:
        return sum(queue.count for queue in self._queues)

    def add(self, rows: UnreadRows) -> UnreadQueue:
        """Read these rows, too, when `attach` has said whose they are."""
        queue = UnreadQueue(self, rows)
        self._queues[queue] = None
        return queue

    def attach(self, queue: UnreadQueue, session: Session, stored: StoredSession) -> None:
        """The rows are those of this restored session."""
        queue.session, queue.stored = session, stored
        stored.drop_unread = queue.drop
        stored.account.stored += queue.rows.size

    def start(
        self,
        entries: Entries,
        share_of: Callable[[str], Share | None],
        flush: Callable[[], None],
    ) -> None:
        """Begin to read in turns.

        `share_of` returns the group of a shared subscription, `flush` is the broker's, for what a
        turn sends.
        """
        self._entries, self._share_of, self._flush = entries, share_of, flush
        self._total = len(self)
        self._began = entries.time()
        self._report_at = self._began + REPORT
        self._is_running = True
        self._next_turn()

    def stop(self) -> None:
        """Read no more; what is left is there for the next start."""
        self._is_stopped = True
        self._end_turns()

    def _end_turns(self) -> None:
        self._is_running = False
        if self._timer is not None:
            self._timer.cancel()
        self._close()

    def _close(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def hurry(self, queue: UnreadQueue) -> None:
        """Read this one before those that nobody waits for."""
        if queue in self._queues:
            self._awaited.setdefault(queue)

    # --- turns ---------------------------------------------------------------------------------

    def _next_turn(self, delay: float = 0.0) -> None:
        if self._timer is not None:
            self._timer.cancel()
        if self._is_running:
            self._timer = self._entries.later(
                "store.unread", delay, self._turn, failed=partial(self._next_turn, AGAIN)
            )

    def _turn(self) -> None:
        if not self._is_running:
            return
        began = self._entries.time()
        try:
            budget = 1.0
            while self._queues and budget > 0:
                budget -= self._read_some(next(iter(self._awaited or self._queues)), budget)
        finally:
            self._flush()
        now = self._entries.time()
        if self._queues:
            if now >= self._report_at:
                self._report_at += REPORT
                log.info("%d of %d messages of queues are still to be read", len(self), self._total)
            # Half of the time is for the rest of the start, and for others' messages.
            self._next_turn(now - began)
        else:
            self._finish()

    def _read_some(self, queue: UnreadQueue, budget: float) -> float:
        """Read on in a queue; returns the part of a turn that it took."""
        rows, before = queue.rows, queue.count
        if not before:  # a fault has kept it here
            queue.session.read_on(1)
            self._end(queue)
            return A_QUEUE
        size = rows.size
        cost = max(1 / MESSAGES_A_TURN, size / before / BYTES_A_TURN)  # of one, on average
        queue.session.read_on(max(1, min(int(budget / cost), AT_ONCE)))
        if queue.count == before:
            self._end(queue)
        read, taken = before - queue.count, size - rows.size
        return max(A_QUEUE, read / MESSAGES_A_TURN, taken / BYTES_A_TURN)

    def _finish(self) -> None:
        self._end_turns()
        self._topics.clear()
        self._messages.lose_order()
        if self._wrong:
            log.warning("%d rows of the store mean nothing, and were left out", self._wrong)
        if self._left_there:
            log.error(
                "%d messages of queues could not be read: they are left for the next start",
                self._left_there,
            )
        seconds = self._entries.time() - self._began
        log.info("%d messages of queues read in %.1f s", self._total - self._left_there, seconds)

    # --- reading -------------------------------------------------------------------------------

    def read(self, queue: UnreadQueue, count: int) -> list[Delivery]:
        """See `Unread`."""
        rows = queue.rows
        found: list[Delivery] = []
        end = min(rows.next + max(count, 1), len(rows.keys))
        while rows.next < end:
            keys = rows.keys[rows.next : min(rows.next + _SELECTED, end)]
            sizes: dict[int, int] = {}
            try:
                owed = cast("dict[int, OwedRow]", self._select(Table.OWED, keys))
                referred = {cast(int, row.message) for row in owed.values()}
                missing = sorted(referred - self._known.keys())
                stored = cast("dict[int, MessageRow]", self._select(Table.MESSAGE, missing, sizes))
            except (sqlite3.Error, UnicodeError) as error:
                self._give_up(queue, error)
                break
            rows.next += len(keys)
            for key in keys:
                try:
                    row = owed[key]
                    message = self._message(cast(int, row.message), stored, sizes)
                    found.append(self._delivery(queue, row, message))
                except Exception as error:  # whatever a damaged row leads to
                    log.debug("a queued message cannot be restored: %s", error)
                    self._wrong += 1
                    self._committer.open.remove(Table.OWED, key)
                    self._committer.stage_lazily()
                if key in owed:
                    message_key = cast(int, owed[key].message)
                    self._unrefer(message_key, sizes.get(message_key, 0))
        if not len(rows):
            self._end(queue)
        return found

    def _end(self, queue: UnreadQueue) -> None:
        """All rows were read, or need not be."""
        rows = queue.rows
        rows.keys, rows.next = rows.keys[:0], 0  # the session refers to it for as long as it lives
        queue.stored.account.stored -= rows.size
        rows.size = 0
        self._queues.pop(queue, None)
        self._awaited.pop(queue, None)

    def _select(
        self, table: Table, keys: Sequence[int], sizes: dict[int, int] | None = None
    ) -> dict[int, object]:
        """The rows with these keys; of messages also their `sizes`, which are added.

        Raises:
            sqlite3.Error, UnicodeError: they cannot be read.
        """
        if not keys:
            return {}
        make = partial(tuple.__new__, ROW_TYPES[table])
        columns = ",".join(COLUMNS[table])
        size = SIZE if sizes is not None else "0"
        found = self._execute(
            f"SELECT {columns}, {size} FROM {table.name.lower()} WHERE id IN ({_marks(keys)})", keys
        )
        if sizes is not None:
            sizes.update((row[0], row[-1] or 0) for row in found)
        return {row[0]: make(row[:-1]) for row in found}

    def _execute(self, statement: str, keys: Sequence[int]) -> list[tuple[Any, ...]]:
        """Raises sqlite3.Error, UnicodeError."""
        try:
            return self._connected().execute(statement, keys).fetchall()
        except sqlite3.Error:  # the open file may be the reason
            self._close()
            return self._connected().execute(statement, keys).fetchall()

    def _connected(self) -> sqlite3.Connection:
        """Raises sqlite3.Error."""
        if self._is_stopped:
            raise sqlite3.OperationalError("the appliance is stopping")
        if self._connection is None:
            self._connection = connect_beside(self._path)
            self._connection.text_factory = _text
        return self._connection

    def _message(self, key: int, stored: dict[int, MessageRow], sizes: dict[int, int]) -> Message:
        """A message that rows refer to which were not read yet. Raises one of `WRONG`."""
        message = self._known.get(key)
        if message is None:
            row = stored[key]
            message, _ = message_of(row, self._offset, self._topics)
            self._messages.load(key, message, cast(float, row.stored_at))
            self._state.bytes -= sizes[key]  # which was counted at the start
            self._messages.hold(message)
            self._known[key] = message
        return message

    def _delivery(self, queue: UnreadQueue, row: OwedRow, message: Message) -> Delivery:
        """Raises one of `WRONG`."""
        pending = pending_of(row, message)
        share = self._share_of(pending.share) if pending.share is not None else None
        ids = pending.subscription_ids
        delivery = cast(Delivery, (message, pending.qos, pending.retain, ids, share))
        stored = queue.stored
        stored.owed[id(delivery)] = row.id, delivery, None
        self._messages.refer(message, stored.account)
        size = self._messages.size(message)  # it was counted at the start
        stored.account.stored -= size
        queue.rows.size -= size
        return delivery

    def _unrefer(self, key: int, size: int) -> None:
        """One row less is left that refers to the message, of `size` bytes if it was not loaded."""
        left = self._references.pop(key, 1) - 1
        if left:
            self._references[key] = left
            return
        message = self._known.pop(key, None)
        if message is not None:
            self._messages.let_go(message)
        else:
            self._state.bytes -= size
            self._committer.open.remove(Table.MESSAGE, key)

    def _give_up(self, queue: UnreadQueue, error: Exception) -> None:
        """Leave the rest of the rows in the database: the next start reads or salvages them."""
        if not self._left_there:
            log.error("queues in %s CANNOT BE READ: %s", self._path, error)
        self._left_there += len(queue.rows)
        queue.left = list(queue.rows.keys[queue.rows.next :])
        self._end(queue)

    def drop(self, queue: UnreadQueue) -> None:
        """Delete the rows that were not read, because the session has ended."""
        self.drop_rows(queue.left or list(queue.rows.keys[queue.rows.next :]))
        queue.left = []
        self._end(queue)

    def drop_rows(self, keys: list[int]) -> None:
        """Delete rows, and the messages that nothing else refers to."""
        for key in keys:
            self._committer.open.remove(Table.OWED, key)
        try:
            for start in range(0, len(keys), _SELECTED):
                part = keys[start : start + _SELECTED]
                for _, message, size in self._execute(f"{MESSAGES_OF} IN ({_marks(part)})", part):
                    self._unrefer(message, size)
        except sqlite3.Error as error:
            log.error("messages that nobody gets any more stay in %s: %s", self._path, error)
        if not self._is_running and not self._queues:
            self._close()
