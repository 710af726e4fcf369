"""The thread in which verbs read files and compute: one, and users take turns.

What computes in Python holds the interpreter's lock, for which the event loop then waits: beside
one such thread some milliseconds, beside four half a second. So there is one. It has the loop's own
priority, unlike the threads that hash, which release the lock: a thread with a lower one that waits
for a processor keeps the lock meanwhile. Work that has begun is not cut off, and what is behind it
waits no longer than its call does. A reload, by which users and certificates are taken away, has a
thread of its own: it waits for no verb.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

from appliance.ros.calls.dispatcher import CallError

T = TypeVar("T")


class VerbThread:
    """Does one work at a time. Belongs to the event loop."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="verbs")
        self._is_busy = self._is_closed = False
        #: Who waits, by user; the user whose turn is next comes first.
        self._waiting: OrderedDict[str | None, deque[asyncio.Future[None]]] = OrderedDict()

    async def run(self, user: str | None, work: Callable[[], T]) -> T:
        """The result of the work, once it is the user's turn. None is the appliance itself, and
        whoever has no user. Raises CallError when the appliance stops."""
        await self._wait_for_turn(user)
        try:
            if self._is_closed:
                raise CallError("stopping", "the appliance stops")
            return await asyncio.get_running_loop().run_in_executor(self._thread, work)
        finally:
            # Where its call has ended and the work has not, the next one waits in the executor.
            self._begin_next()

    async def close(self) -> None:
        """Wait for what has begun; may be called twice."""
        self._is_closed = True
        shutdown = partial(self._thread.shutdown, cancel_futures=True)
        await asyncio.get_running_loop().run_in_executor(None, shutdown)

    async def _wait_for_turn(self, user: str | None) -> None:
        if not self._is_busy:
            self._is_busy = True
            return
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(user, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if not turn.cancelled():  # it was its turn already
                self._begin_next()
            raise

    def _begin_next(self) -> None:
        while self._waiting:
            user, turns = self._waiting.popitem(last=False)
            turn = turns.popleft()
            if turns:
                self._waiting[user] = turns  # at the end: the other users come first
            if not turn.done():
                turn.set_result(None)
                return
        self._is_busy = False
