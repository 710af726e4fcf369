"""A fair queue for the conversion of large messages: one message per iteration of the event loop.

A large message takes milliseconds to convert, and blocks the loop meanwhile. So one is converted as
it comes, and those that come before the loop has finished another iteration are queued: users take
turns, and so do the clients of a user. The messages of one client stay in order, small ones too.
For the event loop's thread.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from time import thread_time
from typing import TypeAlias, TypeVar

from appliance.broker.accounting import Accounting
from appliance.broker.accounts import Account
from appliance.broker.session import Session
from appliance.net.callbacks import Entries
from appliance.ros.payload.payloads import ZSTD_MAGIC

#: A payload of at most so many bytes is converted at once: within some ten microseconds, unless it
#: is a list of objects, each of which is filled with defaults.
LITTLE = 1024

#: Units of cost in a second of work, see `Counters.cost`.
UNITS = 250_000

#: The limit of the bytes that are queued for one user; OVERHEAD is added for each message.
WAITING_OF_USER = 16 * 1024 * 1024
OVERHEAD = 1024

T = TypeVar("T")

#: The session that sent a message; None for a message without one, such as a retained message.
Who: TypeAlias = "Session | None"


def size_of(payload: bytes) -> int:
    """The size of a payload as a measure of work: a few bytes of zstd can become a megabyte."""
    return len(payload) + (LITTLE if payload.startswith(ZSTD_MAGIC) else 0)


def user_of(who: Who) -> str | None:
    """The user of a session; None for all anonymous ones."""
    return None if who is None or who.identity is None else who.identity.username


@dataclass(frozen=True, slots=True)
class _Work:
    do: Callable[[], None]
    size: int


class ConversionQueue:
    """Runs long work, one piece per iteration of the event loop."""

    def __init__(self, entries: Entries, accounting: Accounting) -> None:
        self._entries = entries
        self._accounting = accounting
        #: The queued work by client; and the clients with queued work, in turn, by user.
        self._waiting: dict[Who, deque[_Work]] = {}
        self._users: OrderedDict[str | None, deque[Who]] = OrderedDict()
        self._bytes: Counter[Account] = Counter()
        #: Whether the loop has not finished an iteration since the last piece of work.
        self.is_busy = False

    def waits(self, who: Who) -> bool:
        """Whether work of this client is queued."""
        return who in self._waiting

    def has_room(self, who: Who, size: int) -> bool:
        """Whether so many more bytes may be queued for the client. A caller that has no other
        limit asks this first."""
        if who is None:
            return True
        size += OVERHEAD
        own = self._bytes[who.account]
        # A single message is not subject to the limit of its user, only to that of memory.
        is_share = not own or own + size <= WAITING_OF_USER
        return is_share and self._accounting.fits(who.account, size)

    def do(self, who: Who, size: int, work: Callable[[], None]) -> None:
        """Do the work, on a payload of so many bytes, now or in its turn. An exception in it is a
        fault."""
        if who in self._waiting:
            self._wait(who, size, work)
        elif size <= LITTLE:
            self.little(partial(self._run, work))
        elif self.is_busy:
            self._wait(who, size, work)
        else:
            self._take(work)

    def little(self, work: Callable[[], T]) -> T:
        """Do work on a little payload now, whatever is queued, and charge what it has taken: a
        kilobyte of JSON, 330 empty objects of a list, can take nine milliseconds."""
        begun = thread_time()
        try:
            return work()
        finally:
            self._accounting.counters.cost += int((thread_time() - begun) * UNITS)

    def now(self, work: Callable[[], T]) -> T | None:
        """Do work that cannot be queued, and return its result; queued work is done later."""
        return self._take(work)

    def _wait(self, who: Who, size: int, work: Callable[[], None]) -> None:
        user = user_of(who)
        size += OVERHEAD
        self._count(who, size)
        queue = self._waiting.get(who)
        if queue is None:
            queue = self._waiting[who] = deque()
            self._users.setdefault(user, deque()).append(who)
        queue.append(_Work(work, size))

    def _count(self, who: Who, size: int) -> None:
        if who is None:
            return
        account = who.account
        self._accounting.take(account, size)
        self._bytes[account] += size
        if not self._bytes[account]:
            del self._bytes[account]

    def _take(self, work: Callable[[], T]) -> T | None:
        """Do it, and nothing else of the queue before the loop's next iteration."""
        was_busy, self.is_busy = self.is_busy, True
        # The processor time of this thread: other processes do not count.
        begun = thread_time()
        try:
            return self._run(work)
        finally:
            self._accounting.counters.cost += int((thread_time() - begun) * 1e6)
            # What came meanwhile is read in the next iteration, and answered before the one after.
            if not was_busy:
                self._entries.soon("turns.pause", self._pause, failed=self._pause)

    def _pause(self) -> None:
        self._entries.soon("turns.next", self._next, failed=self._pause)

    def _run(self, work: Callable[[], T]) -> T | None:
        return self._entries.faults.run("turns.work", work, otherwise=None)

    def _next(self) -> None:
        self.is_busy = False
        if not self._users:
            return
        user, clients = next(iter(self._users.items()))
        who = clients.popleft()
        queue = self._waiting[who]
        work = queue.popleft()
        if queue:
            clients.append(who)
        else:
            del self._waiting[who]
        if clients:
            self._users.move_to_end(user)
        else:
            del self._users[user]
        self._count(who, -work.size)
        self._take(work.do)
