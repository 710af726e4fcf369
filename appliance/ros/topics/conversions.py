"""Converting large messages for ROS: one a turn of the event loop, with everybody else in between.

A large message takes milliseconds to convert, and all others wait meanwhile. So one is converted as
it comes, and those that come before the loop has been round once more wait in a queue: users take
turns, and each user's clients; what one client sends stays in its order, small messages too. For
the event loop's thread.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from time import thread_time
from typing import TypeAlias, TypeVar

from appliance.broker.accounting import Accounting
from appliance.broker.accounts import Account
from appliance.broker.session import Session
from appliance.net.callbacks import Entries
from appliance.ros.payload.payloads import ZSTD_MAGIC

#: Bytes of a payload up to which converting it takes some ten microseconds.
LITTLE = 1024

#: Bytes of one user that wait for their turn; each of them with so much for what is around it.
WAITING_OF_USER = 16 * 1024 * 1024
OVERHEAD = 1024

T = TypeVar("T")

#: Who sent it; None for what is nobody's, such as a retained message.
Who: TypeAlias = "Session | None"


def size_of(payload: bytes) -> int:
    """Bytes of a payload as far as work is concerned: a few of zstd can be a megabyte."""
    return len(payload) + (LITTLE if payload.startswith(ZSTD_MAGIC) else 0)


def user_of(who: Who) -> str | None:
    """The user whose client it is; None for all that are anonymous."""
    return None if who is None else who.account.username


@dataclass(frozen=True, slots=True)
class _Work:
    do: Callable[[], None]
    size: int


class ConversionQueue:
    """Does what takes long, one thing a turn."""

    def __init__(self, entries: Entries, accounting: Accounting) -> None:
        self._entries = entries
        self._accounting = accounting
        #: What waits, by client; and the clients whose turn it is, by user.
        self._waiting: dict[Who, deque[_Work]] = {}
        self._users: OrderedDict[str | None, deque[Who]] = OrderedDict()
        self._bytes: Counter[Account] = Counter()
        #: Whether the others have not had their turn yet since the last one.
        self.is_busy = False

    def waits(self, who: Who) -> bool:
        """Whether something of this client waits for its turn."""
        return who in self._waiting

    def has_room(self, who: Who, size: int) -> bool:
        """Whether so many bytes more of the client may wait. Who has no other bound for what it
        lets wait asks first."""
        if who is None:
            return True
        size += OVERHEAD
        own = self._bytes[who.account]
        # One alone needs no more than memory.
        is_share = not own or own + size <= WAITING_OF_USER
        return is_share and self._accounting.fits(who.account, size)

    def do(self, who: Who, size: int, work: Callable[[], None]) -> None:
        """Do the work, which is on a payload of so many bytes, now or when it is its turn. What it
        raises is a fault."""
        if who in self._waiting:
            self._wait(who, size, work)
        elif size <= LITTLE:
            self._run(work)
        elif self.is_busy:
            self._wait(who, size, work)
        else:
            self._take(work)

    def now(self, work: Callable[[], T]) -> T | None:
        """Do what cannot wait, and return what comes of it; what does wait has its turn later."""
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
        """Do it, and let the others have their turn."""
        was_busy, self.is_busy = self.is_busy, True
        # The time of the thread's own work, whoever else has the processor.
        begun = thread_time()
        try:
            return self._run(work)
        finally:
            self._accounting.counters.cost += int((thread_time() - begun) * 1e6)
            # What came meanwhile is read in the next round, and is answered before the one after.
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
