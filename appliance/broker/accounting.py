"""State that all sessions share: the limits in force, the counters, the clock, the memory used."""

from __future__ import annotations

from collections.abc import Sized
from dataclasses import dataclass, field
from typing import Protocol

from appliance.broker.accounts import Account, Accounts, Quotas
from appliance.broker.counters import Counters
from appliance.broker.faults import Faults
from appliance.broker.limits import Limits
from appliance.broker.message import Message
from appliance.broker.store import Store

#: The most bytes of the topics that a session's rates know: 12,000 topics or so. To forget them all
#: at once takes some three milliseconds.
TOPICS_OF_A_SESSION = 4 * 1024 * 1024


class CongestedReader(Protocol):
    """A connected receiver that publishers may wait for, see `backpressure`: its session."""

    @property
    def inflight(self) -> Sized:
        """What it was sent and has not acknowledged."""

    @property
    def awaits_store(self) -> bool:
        """Whether it can be sent nothing until the store has read on."""


class Clock(Protocol):
    """Seconds, from any beginning.

    Not a Callable: mypy would add a field of that type to derived dataclasses once more, and the
    garbage collector would see it twice in compiled ones, which then are never freed.
    """

    def __call__(self) -> float:
        """The time now."""


@dataclass(slots=True)
class Accounting:
    """The limits, counters, clock and memory use that all sessions share."""

    limits: Limits
    store: Store
    counters: Counters = field(default_factory=Counters)
    faults: Faults = field(default_factory=Faults)
    #: Seconds of the clock that `Broker.tick` was last given.
    now: float = 0.0
    #: How much each user holds of the shared resources.
    accounts: Accounts = field(default_factory=Accounts)
    #: Bytes of the queues, subscriptions and wills of all sessions, and of the output buffers.
    queued_bytes: int = 0
    #: The part of these that is unprocessed input: partial packets, and topic aliases.
    input_bytes: int = 0
    #: Whom publishers may have to wait for: connected receivers whose queues are more than half
    #: full (`CongestedReader`), and the disk (`DiskCongestion`).
    congested: dict[object, None] = field(default_factory=dict)
    #: The limits that every message is checked against, copied from `limits` for speed.
    queue_messages: int = field(init=False)
    queue_bytes: int = field(init=False)
    half_queue: int = field(init=False)
    memory: int = field(init=False)
    #: Bytes of the topics that the rates of a session's subscriptions may know, and a user's.
    session_topics: int = field(init=False)
    user_topics: int = field(init=False)
    #: Below this use, in bytes, no quota of a user can be exceeded, so that none is looked up.
    unrestricted_memory: int = field(init=False)
    #: What each user may hold.
    quotas: Quotas = field(init=False)
    #: Bytes that a connected client may hold when others have taken all the memory.
    reserve: int = field(init=False)
    #: The store's last commit failed: nothing can be stored.
    failing: bool = False
    #: A clock, in seconds, that stops while the clients could do nothing because the broker was
    #: busy or the computer was loaded.
    client_time: Clock = field(init=False)

    def __post_init__(self) -> None:
        self.client_time = lambda: self.now
        self.use(self.limits)

    def use(self, limits: Limits) -> None:
        """Apply other limits from now on."""
        self.limits = limits
        self.queue_messages = limits.queue_messages
        self.queue_bytes = limits.queue_bytes
        self.half_queue = limits.queue_bytes // 2
        # An eighth is reserved, so that users that hold much do not starve those that hold little.
        self.memory = limits.memory * 7 // 8
        self.reserve = limits.memory // 8 // limits.connections
        self.quotas = Quotas(limits, self.memory, self.store.size)
        # The larger part of what a user is sure of is for what waits.
        self.session_topics = min(limits.queue_bytes // 4, TOPICS_OF_A_SESSION)
        self.user_topics = self.quotas.memory.sure // 4
        self.unrestricted_memory = min(self.quotas.memory.lent, self.quotas.memory.most)

    def fits(self, account: Account, size: int) -> bool:
        """Whether the account may take `size` more bytes of memory."""
        return account.is_inside or self.quotas.memory.allows(
            account.bytes, self.queued_bytes, size
        )

    def is_reserved(self, account: Account, size: int) -> bool:
        """Whether the account may take `size` bytes from the reserve of its connected clients.

        Clients keep what they took from it when they disconnect: the reserve is limited, too.
        """
        own = self.quotas.memory.own + self.reserve * account.connections
        return account.bytes + size <= own and self.queued_bytes + size <= self.limits.memory

    def memory_shortage(self, size: int) -> str:
        """Why `fits` returned False, as a text that does not name the user."""
        quota = self.quotas.memory
        return quota.shortage(self.queued_bytes, size, "memory", "limits.memory", "memory")

    def may_store(self, account: Account, size: int) -> bool:
        """Whether the account may put `size` more bytes into the store."""
        store = self.store
        if account.is_inside:
            return store.bytes + size <= store.size
        return self.quotas.stored.allows(account.stored, store.bytes, size)

    def store_shortage(self, size: int) -> str:
        """Why `may_store` returned False, as a text that does not name the user."""
        total = self.store.bytes
        return self.quotas.stored.shortage(total, size, "room in the store", "store.size", "stored")

    def take(self, account: Account, size: int) -> None:
        """Count `size` more bytes of memory for the account; negative: fewer."""
        account.bytes += size
        self.queued_bytes += size

    def has_expired(self, message: Message) -> bool:
        """Whether the message has expired [MQTT-3.3.2-5]; if so, it is counted as dropped."""
        if message.expires_at is None or message.expires_at > self.now:
            return False
        self.counters.drop("expired")
        return True
