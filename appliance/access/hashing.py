"""The threads that hash passwords: few, at low priority, and round-robin over the addresses.

At low priority a flood of logins delays nobody. But where other programs keep all cores busy, a
check takes many times as long (4 s instead of 0.5 s, measured beside seven of them). So one that
comes alone has normal priority: now and then, as many would be a flood that comes one by one. A
thread may lower its priority and not raise it again, so there is a thread for each.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Final, Generic, TypeVar

#: By how much the threads' priority is lower than the event loop's, see nice(2).
NICE: Final = 10

#: The most of the time for which a check runs at the event loop's own priority.
PROMPT_SHARE: Final = 0.05

T = TypeVar("T")


class QueueFullError(Exception):
    """Too many checks wait already."""


class HashingPool(Generic[T]):
    """Runs checks in `workers` threads; at most `max_waiting` wait. Belongs to the event loop.

    The queues are served round-robin. When no more may wait, a new check replaces the last one of
    the longest queue, if that is longer than its own: a flood from one address keeps nobody else
    out.
    """

    def __init__(self, workers: int, max_waiting: int) -> None:
        self._workers = workers
        self._max_waiting = max_waiting
        self._running = 0
        self._waiting = 0
        self._closed = False
        self._queues: OrderedDict[bytes, deque[tuple[asyncio.Future[T], Callable[[], T]]]]
        self._queues = OrderedDict()
        self._pool = ThreadPoolExecutor(
            workers, thread_name_prefix="password", initializer=_lower_priority
        )
        self._prompt = ThreadPoolExecutor(1, thread_name_prefix="prompt-password")
        #: When the next check may run at normal priority, by the loop's clock.
        self._prompt_from = 0.0

    @property
    def idle(self) -> bool:
        """Whether nothing runs and nothing waits."""
        return not (self._running or self._waiting)

    async def run(self, queue: bytes, check: Callable[[], T]) -> T:
        """Run the check and return its result; it must not raise.

        Raises:
            QueueFullError: there was no room for it, or it had to make room.
            CancelledError: `close` was called.
        """
        if self._closed:
            raise asyncio.CancelledError
        if self._waiting >= self._max_waiting and self._running >= self._workers:
            self._make_room(queue)
        future: asyncio.Future[T] = asyncio.get_running_loop().create_future()
        self._queues.setdefault(queue, deque()).append((future, check))
        self._waiting += 1
        self._start_next()
        return await future

    def close(self) -> None:
        """Cancel the checks that wait, and wait for those that run. May be called twice."""
        self._closed = True
        for queue in self._queues.values():
            for future, _ in queue:
                with contextlib.suppress(RuntimeError):  # its event loop may be closed already
                    future.cancel()
        self._queues.clear()
        self._waiting = 0
        for pool in (self._prompt, self._pool):
            pool.shutdown(wait=True, cancel_futures=True)

    def _make_room(self, queue: bytes) -> None:
        longest = max(self._queues, key=lambda name: len(self._queues[name]), default=queue)
        if len(self._queues.get(longest, ())) <= len(self._queues.get(queue, ())) + 1:
            raise QueueFullError
        future, _ = self._queues[longest].pop()
        self._waiting -= 1
        if not future.done():
            future.set_exception(QueueFullError())

    def _start_next(self) -> None:
        while self._queues and self._running < self._workers:
            name, queue = self._queues.popitem(last=False)
            future, check = queue.popleft()
            if queue:
                self._queues[name] = queue  # at the end: the other queues come first
            self._waiting -= 1
            if future.done():  # the client has gone
                continue
            loop = asyncio.get_running_loop()
            began = loop.time()
            if self.idle and began >= self._prompt_from:
                running = loop.run_in_executor(self._prompt, check)
                running.add_done_callback(partial(self._rest, began))
            else:
                running = loop.run_in_executor(self._pool, check)
            self._running += 1
            running.add_done_callback(partial(self._ended, future))

    def _rest(self, began: float, ran: asyncio.Future[T]) -> None:
        """The check that began then had normal priority; the next has it after a while."""
        now = ran.get_loop().time()
        self._prompt_from = began + (now - began) / PROMPT_SHARE

    def _ended(self, future: asyncio.Future[T], ran: asyncio.Future[T]) -> None:
        self._running -= 1
        if not future.done():
            if ran.cancelled():
                future.cancel()
            elif (error := ran.exception()) is not None:
                future.set_exception(error)
            else:
                future.set_result(ran.result())
        if not self._closed:
            self._start_next()  # last: if it fails, the finished check has its result


def _lower_priority() -> None:
    # On Linux each thread has its own priority, and may lower it without rights. On other systems
    # hashing competes with everything else.
    with contextlib.suppress(OSError):
        thread = threading.get_native_id()
        priority = os.getpriority(os.PRIO_PROCESS, thread) + NICE
        os.setpriority(os.PRIO_PROCESS, thread, min(priority, 19))
