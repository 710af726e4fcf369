"""Reads the records of segments in a thread, with a connection of its own."""

from __future__ import annotations

import contextlib
import queue
import sqlite3
import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TypeAlias

from appliance.broker.backlogs import RecordsLostError
from appliance.net.callbacks import Entries
from appliance.store.records import split
from appliance.store.schema import connect_beside, is_damage

#: Segments that are read or have been read, and whose records the event loop has not taken yet.
#: The others wait, so that a busy loop does not let records pile up.
AT_ONCE = 2

#: Gets the records of some segments, one after the other, or why they cannot be read.
Outcome: TypeAlias = "Callable[[list[bytes] | Exception], None]"


class _Reading:
    """Keys to read, and who waits for the records; the outcome is passed on once."""

    __slots__ = ("_callback", "is_taken", "keys")

    def __init__(self, keys: list[int], callback: Outcome) -> None:
        self.keys = keys
        #: The event loop has got the outcome.
        self.is_taken = False
        self._callback: Outcome | None = callback

    def done(self, outcome: list[bytes] | Exception) -> None:
        callback, self._callback = self._callback, None
        if callback is not None:
            callback(outcome)

    def failed(self) -> None:
        """A fault has lost the outcome."""
        self.done(_fault())


def _fault() -> Exception:
    return RuntimeError("a fault in the appliance")


class Reader:
    """Reads from the database while the appliance runs; WAL does not make the writer wait."""

    def __init__(self, path: Path, entries: Entries) -> None:
        self._path = path
        self._entries = entries
        self._waiting: deque[_Reading] = deque()
        self._running = 0
        self._thread: threading.Thread | None = None
        self._requests: queue.SimpleQueue[_Reading | None] = queue.SimpleQueue()
        self._is_running = True

    def read(self, keys: list[int], callback: Outcome) -> None:
        """Pass all records of the segments with these keys to the callback, in a later round.

        It gets RecordsLostError when some were damaged or are not there.
        """
        self._waiting.append(_Reading(keys, callback))
        self._go_on()

    def pass_on(self, records: list[bytes], callback: Outcome) -> None:
        """Pass records that are in memory to the callback, in the next round."""
        reading = _Reading([], callback)
        self._entries.soon("store.read", reading.done, records, failed=reading.failed)

    def _go_on(self) -> None:
        while self._waiting and self._running < AT_ONCE and self._is_running:
            self._running += 1
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="store-read", daemon=True)
                self._thread.start()
            self._requests.put(self._waiting.popleft())

    async def stop(self) -> None:
        """End the thread; what was not read yet is not read any more. May be called twice."""
        self._is_running = False
        thread, self._thread = self._thread, None
        if thread is not None:
            self._requests.put(None)
            await self._entries.loop.run_in_executor(None, thread.join)

    def _taken(self, reading: _Reading, outcome: list[bytes] | Exception) -> None:
        """On the event loop: pass the outcome on."""
        reading.is_taken = True
        self._running -= 1
        self._go_on()
        reading.done(outcome)

    def _not_taken(self, reading: _Reading) -> None:
        """A fault has occurred before, in or after `_taken`."""
        if not reading.is_taken:
            self._taken(reading, _fault())

    # --- in the thread -------------------------------------------------------------------------

    def _run(self) -> None:
        connection: sqlite3.Connection | None = None
        while (reading := self._requests.get()) is not None:
            outcome: list[bytes] | Exception
            try:
                if connection is None:
                    connection = connect_beside(self._path)
                outcome = _read(connection, reading.keys)
            except Exception as error:  # whatever it is, the thread has to continue
                outcome = error
                if not isinstance(error, RecordsLostError) and connection is not None:
                    # The open file may be the reason, so the next attempt opens it again.
                    connection.close()
                    connection = None
            with contextlib.suppress(RuntimeError):  # the loop is closed: nobody waits for it
                self._entries.from_thread(
                    "store.read",
                    self._taken,
                    reading,
                    outcome,
                    failed=partial(self._not_taken, reading),
                )
        if connection is not None:
            connection.close()


def _read(connection: sqlite3.Connection, keys: list[int]) -> list[bytes]:
    """The records of the segments, in this order.

    Raises:
        RecordsLostError: some are damaged, or are not there.
        sqlite3.Error: they cannot be read now.
    """
    records: list[bytes] = []
    for key in keys:
        try:
            rows = connection.execute(
                "SELECT length, records, checksum FROM backlog WHERE id = ?", (key,)
            ).fetchall()
            for row in rows:
                records += split(*row)
        except (sqlite3.Error, UnicodeError) as error:
            if is_damage(error):
                raise RecordsLostError(str(error)) from None
            raise
        except (ValueError, TypeError, OverflowError) as error:
            raise RecordsLostError(str(error)) from None
        if not rows:
            raise RecordsLostError("they are not there")
    return records
