"""Group commit: collects changes into batches, and has one batch at a time written."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import sqlite3
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from appliance.broker.histogram import Histogram
from appliance.net.callbacks import Entries
from appliance.store.schema import Durability
from appliance.store.state import StoreState
from appliance.store.writer import Batch, Writer

log = logging.getLogger("appliance.store")

#: Seconds that a change may wait which nothing depends on, such as that a message was acknowledged.
#: Most often it is committed with one that something does depend on. After a power cut such changes
#: of the last second are lost, and what they are about is repeated.
LINGER = 1.0

#: Bytes of what links keep at which a batch is committed though nothing depends on it.
LARGE = 1 << 20

#: Seconds until a batch that could not be written is tried again.
RETRY = 1.0


@dataclass(slots=True)
class CommitMetrics:
    """What was committed since the start, for the log."""

    commits: int = 0
    messages: int = 0
    #: Messages of the largest batch.
    largest: int = 0
    #: How long commits took that succeeded.
    duration: Histogram = field(default_factory=Histogram)
    #: When the first batch was begun that is not committed yet, by the loop's clock; None for none.
    begun_at: float | None = None


class Committer:
    """Commits the changes that are put into `open`, the current batch.

    While one batch is being written, changes go into the next, so that the busier the broker is the
    more changes share a commit. A batch that cannot be written absorbs the next one and is tried
    again, for as long as it takes.
    """

    def __init__(self, state: StoreState, path: Path, durability: Durability) -> None:
        self.open = Batch(state.batch, 1)
        #: The keys of new rows; none is ever given out twice.
        self.keys = itertools.count(1)
        #: Whether nothing can be written now.
        self.failing = False
        self.metrics = CommitMetrics()
        self.path = path
        #: Called after each commit, with the number of the last batch that is committed.
        self.after_commit: Callable[[int], None] = lambda number: None
        self._state = state
        self._writer = Writer(path, durability, self._written)
        self._entries: Entries
        self._failed: Batch | None = None
        self._is_writing = False
        #: Bytes of what links keep in the batch that is being written.
        self._writing = 0
        self._is_running = False
        self._timer: asyncio.TimerHandle | None = None
        #: Whether that is for the next round of the event loop.
        self._is_due = False
        self._notify: Callable[[bool], None] = lambda committed: None
        self._outcome: asyncio.Future[None] | None = None

    @property
    def unwritten(self) -> int:
        """Bytes of what links keep that are only in memory, but for a batch that has failed."""
        return self.open.bytes + self._writing

    @property
    def is_idle(self) -> bool:
        """Whether there is nothing to write, or it cannot be written."""
        return self.failing or not (self._is_writing or self.open)

    def start_keys(self, first: int) -> None:
        """Give out keys from this one on: those before may be in the database."""
        self.keys = itertools.count(first)
        self.open.first_id = first

    def start(
        self, entries: Entries, connection: sqlite3.Connection | None, problem: str = ""
    ) -> None:
        """Begin to commit; `problem` is why the database cannot be written now."""
        self._entries = entries
        self._writer.start(connection)
        self._is_running = True
        if problem:
            self.failing = True
            self._log_failure(problem)
            self.stage_lazily()
            self._notify(False)

    async def stop(self, put_last: Callable[[], None]) -> None:
        """Commit what is left and end; `put_last` adds to the last batch, if there is one."""
        if not self._is_running:
            return
        self._is_running = False
        if self._timer is not None:
            self._timer.cancel()
        while self._is_writing:
            await self._next_outcome()
        # What `restore` alone has changed, the next start would change as well.
        if self._failed is not None or (self.open and self.open.is_changed):
            put_last()
            self.commit()
            await self._next_outcome()
        await self._entries.loop.run_in_executor(None, self._writer.stop)
        if self._failed is not None:
            log.error("%d changes could not be stored, and are lost", len(self._failed))
        elif self.metrics.messages:
            log.info(
                "store: %d commits of %.1f messages on average, the largest of %d",
                self.metrics.commits,
                self.metrics.messages / self.metrics.commits,
                self.metrics.largest,
            )

    async def _next_outcome(self) -> None:
        self._outcome = self._entries.loop.create_future()
        await self._outcome

    def listen(self, callback: Callable[[bool], None]) -> None:
        """See `Store`."""
        self._notify = callback

    def hurry(self) -> None:
        """See `Store`."""
        self.open.is_awaited = True
        # No packet overtakes one that waits, even if the batch that this one waits for is empty.
        self._state.staged = not self.failing
        if self._is_running and not self._is_writing and not self.failing:
            self.commit()

    def stage(self) -> None:
        """Packets may depend on what was put into the open batch."""
        self._state.fresh = self.open.has_dependents = True
        if not self.failing:
            self._state.staged = True
        self.stage_lazily()

    def stage_lazily(self) -> None:
        """Nothing depends on what was put: it is committed with what follows, or after `LINGER`;
        when much was put, in the next round of the event loop."""
        self.open.is_changed = True
        if not self._is_running or self._is_writing:
            return
        is_large = self.open.bytes >= LARGE and not self.failing
        if self._timer is not None:
            if not is_large or self._is_due:
                return
            self._timer.cancel()
        self._is_due = is_large
        delay = 0.0 if is_large else RETRY if self.failing else LINGER
        self._timer = self._entries.later(
            "store.write", delay, self._commit_in_time, failed=self._commit_later
        )

    def _commit_later(self) -> None:
        self._timer = None
        self.stage_lazily()

    def _commit_in_time(self) -> None:
        self._timer = None
        if not self._is_writing and (self.open or self._failed is not None or self.failing):
            self.commit()

    def commit(self) -> None:
        """Have the open batch written, with the one before if that failed, and open the next."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        batch = self.open
        batch.seal()
        if self._failed is not None:
            self._failed.absorb(batch)
            batch, self._failed = self._failed, None
        self._state.batch += 1
        self.open = Batch(self._state.batch, next(self.keys))
        self._is_writing = True
        if self.metrics.begun_at is None:
            self.metrics.begun_at = self._entries.time()
        self._writing = batch.bytes
        self._writer.write(batch)

    def _written(self, batch: Batch, error: Exception | None) -> None:
        """On the writer's thread: pass the outcome to the event loop."""
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody waits for it
            self._entries.from_thread(
                "store.done", self._done, batch, error, failed=partial(self._not_done, batch)
            )

    def _done(self, batch: Batch, error: Exception | None) -> None:
        self._is_writing = False
        self._writing = 0
        try:
            self._settle(batch, error)
        finally:  # whatever went wrong with this batch, the next one is written
            if self._is_running and not self._is_writing:
                if self.open.is_awaited and not self.failing:
                    self.commit()
                elif self.open or self.failing:
                    self.stage_lazily()

    def _not_done(self, batch: Batch) -> None:
        """A fault has lost the outcome: write the batch again, which changes nothing."""
        if self._is_writing:
            self._done(batch, RuntimeError("a fault in the appliance"))

    def _settle(self, batch: Batch, error: Exception | None) -> None:
        if error is None:
            self._state.committed = batch.number
            self.metrics.commits += 1
            if self.metrics.begun_at is not None:
                self.metrics.duration.observe(self._entries.time() - self.metrics.begun_at)
                self.metrics.begun_at = None
            self.metrics.messages += batch.messages
            self.metrics.largest = max(self.metrics.largest, batch.messages)
            if self.failing:
                log.warning("%s can be written again; all that was waiting is kept", self.path)
            self.failing = False
            self._state.staged = self.open.has_dependents
        else:
            self._failed = batch
            self._state.staged = False
            if not self.failing:
                self.failing = True
                self._log_failure(str(error))
        outcome, self._outcome = self._outcome, None
        if outcome is not None:
            outcome.set_result(None)
        self._entries.faults.run("store.committed", self._notify, error is None, otherwise=None)
        if error is None:
            self.after_commit(batch.number)

    def _log_failure(self, problem: str) -> None:
        log.error(
            "%s CANNOT BE WRITTEN: %s. QoS 1 and 2 messages for sessions that are stored, and "
            "retained ones, are refused until it can; that is tried every %g s",
            self.path,
            problem,
            RETRY,
        )
