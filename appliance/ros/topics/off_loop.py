"""Conversions that take longer than the event loop may be busy, on threads: pictures.

Of one topic one message is converted at a time. Of those that come meanwhile the newest is next;
the others are counted as throttled, and so is what is not done when the topic's flow ends.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple, TypeAlias

from appliance.mqtt.codec import Properties
from appliance.net.callbacks import Entries
from appliance.ros.metrics import ReceiveCounters

#: Threads of all topics, and by how much their priority is lower than the loop's, see nice(2).
THREADS = 2
NICE = 5

#: What is made of a message: payload and properties, or why it cannot be converted.
Converted: TypeAlias = "tuple[bytes, Properties] | Exception"


class ConversionThreads:
    """The threads that convert, which exist once there is something to convert."""

    def __init__(self, entries: Entries) -> None:
        self.entries = entries
        self._pool: ThreadPoolExecutor | None = None
        self._lock = threading.Lock()
        self._is_closed = False

    def run(self, work: Callable[[], None]) -> bool:
        """Run it on one of the threads, which may be called from any thread; False after `close`.

        It must not raise.
        """
        with self._lock:
            if self._is_closed:
                return False
            if self._pool is None:
                self._pool = ThreadPoolExecutor(
                    THREADS, thread_name_prefix="picture", initializer=_lower_priority
                )
            self._pool.submit(work)
            return True

    def close(self) -> None:
        """Forget what waits, and do not wait for what runs; may be called twice."""
        with self._lock:
            self._is_closed = True
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(wait=False, cancel_futures=True)


class _Conversion(NamedTuple):
    convert: Callable[[], Converted]
    take: Callable[[Converted], None]


class TopicConversions:
    """The conversions of one topic."""

    def __init__(self, threads: ConversionThreads) -> None:
        self._threads = threads
        self._lock = threading.Lock()
        #: The number of what is converted, or was last; and what is next.
        self._number = 0
        self._is_busy = False
        self._next: _Conversion | None = None
        #: Whether what is converted is to be taken; it is not any more once that has begun.
        self._is_wanted = False
        self._is_closed = False

    def put(
        self,
        convert: Callable[[], Converted],
        take: Callable[[Converted], None],
        counters: ReceiveCounters,
    ) -> None:
        """Call `convert` on a thread as soon as the one before is done, unless a newer one comes,
        and then `take` on the event loop's thread, with what that returned or raised.

        May be called on any thread, with counters of its own.
        """
        with self._lock:
            if self._is_closed:
                counters.throttled += 1
                return
            if self._next is not None:
                counters.throttled += 1
            self._next = _Conversion(convert, take)
            if not self._is_busy:
                self._start()

    def open(self) -> None:
        """Convert again after `close`."""
        with self._lock:
            self._is_closed = False

    def close(self, counters: ReceiveCounters) -> None:
        """Take nothing any more: what is converted and what is next are counted as throttled.

        Only a `take` that has begun on the event loop's thread goes on; whatever is handed to the
        loop from now on comes after it.
        """
        with self._lock:
            self._is_closed = True
            counters.throttled += self._is_wanted + (self._next is not None)
            self._is_wanted, self._next = False, None

    def _start(self) -> None:
        """Begin with the next one; the caller has the lock."""
        conversion, self._next = self._next, None
        self._number += 1
        self._is_busy = self._is_wanted = conversion is not None and self._threads.run(
            partial(self._convert, self._number, conversion)
        )

    def _convert(self, number: int, conversion: _Conversion) -> None:
        """On one of the threads."""
        converted: Converted
        try:
            converted = conversion.convert()
        except Exception as error:
            converted = error
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._threads.entries.from_thread(
                "bridge.picture",
                self._converted,
                *(number, conversion.take, converted),
                failed=partial(self._go_on, number),
            )

    def _converted(
        self, number: int, take: Callable[[Converted], None], converted: Converted
    ) -> None:
        try:
            with self._lock:
                is_wanted, self._is_wanted = self._is_wanted, False
            if is_wanted:
                take(converted)
        finally:
            self._go_on(number)

    def _go_on(self, number: int) -> None:
        """That one is done; may be called twice."""
        with self._lock:
            if number == self._number and self._is_busy:
                self._start()


def _lower_priority() -> None:
    with contextlib.suppress(OSError):  # on Linux each thread has its own
        thread = threading.get_native_id()
        priority = os.getpriority(os.PRIO_PROCESS, thread) + NICE
        os.setpriority(os.PRIO_PROCESS, thread, min(priority, 19))
