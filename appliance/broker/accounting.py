"""What all sessions share: the limits in force, the counters, the clock, and the memory in use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from appliance.broker.accounts import Account, Accounts, Quotas
from appliance.broker.counters import Counters
from appliance.broker.faults import Faults
from appliance.broker.message import Message
from appliance.broker.ports import Limits, Store

if TYPE_CHECKING:
    from appliance.broker.session import Session


@dataclass(slots=True)
class Accounting:
    """What all sessions share: the limits, the counters, the clock and the bytes queued in all."""

    limits: Limits
    store: Store
    counters: Counters = field(default_factory=Counters)
    faults: Faults = field(default_factory=Faults)
    #: Seconds of the clock that `Broker.tick` was last given.
    now: float = 0.0
    #: Who holds how much of what all share.
    accounts: Accounts = field(default_factory=Accounts)
    #: Bytes that the queues, subscriptions and wills of all sessions hold, and the output buffers.
    queued_bytes: int = 0
    #: Among these, what came from clients and is not done with: parts of packets, topic aliases.
    input_bytes: int = 0
    #: Connected readers whose queues are more than half full, and that publishers may wait for.
    congested: dict[Session, None] = field(default_factory=dict)
    #: Sessions whose connections are to be closed at the next flush, as their queues overflowed.
    overflowed: list[Session] = field(default_factory=list)
    #: Sessions of absent clients whose queues are full, which is to be told; and by what.
    filled: list[tuple[Session, str]] = field(default_factory=list)
    #: The limits that every message is measured against, out of `limits` for speed.
    queue_bytes: int = field(init=False)
    half_queue: int = field(init=False)
    memory: int = field(init=False)
    #: As long as no more than this is in use, in bytes, nobody has to be asked who they are.
    plenty: int = field(init=False)
    #: And what each user may have.
    quotas: Quotas = field(init=False)
    #: And what a connected client may hold when all the memory is taken by others, in bytes.
    reserve: int = field(init=False)
    #: The store's last commit failed: nothing can be stored.
    failing: bool = False
    #: Whether the rules in force still let a session receive what waits for it under a topic.
    may_still_receive: Callable[[Session, str], bool] = field(default=lambda session, topic: True)
    #: Seconds that the broker, and the computer under load, have left to the clients: a clock that
    #: does not go on while these could do nothing.
    spare: Callable[[], float] = field(init=False)

    def __post_init__(self) -> None:
        self.spare = lambda: self.now
        self.use(self.limits)

    def use(self, limits: Limits) -> None:
        """Measure by these limits from now on."""
        self.limits = limits
        self.queue_bytes = limits.queue_bytes
        self.half_queue = limits.queue_bytes // 2
        # An eighth is set apart, so that those who hold much do not starve those who hold little.
        self.memory = limits.memory * 7 // 8
        self.reserve = limits.memory // 8 // limits.connections
        self.quotas = Quotas(limits, self.memory, self.store.size)
        self.plenty = min(self.quotas.memory.lent, self.quotas.memory.most)

    def fits(self, account: Account, size: int) -> bool:
        """Whether the account may take so many bytes of memory more."""
        return account.is_inside or self.quotas.memory.allows(
            account.bytes, self.queued_bytes, size
        )

    def is_reserved(self, account: Account, size: int) -> bool:
        """Whether the account may have that of what is set apart for its connected clients.

        What they have of it they take with them when they go, so it is not without an end.
        """
        own = self.quotas.memory.own + self.reserve * account.connections
        return account.bytes + size <= own and self.queued_bytes + size <= self.limits.memory

    def memory_shortage(self, size: int) -> str:
        """Why `fits` says no, in words, without saying of whom."""
        quota = self.quotas.memory
        return quota.shortage(self.queued_bytes, size, "memory", "limits.memory", "memory")

    def may_store(self, account: Account, size: int) -> bool:
        """Whether a message of so many bytes more may be kept in the store for the account."""
        store = self.store
        if account.is_inside:
            return store.bytes + size <= store.size
        return self.quotas.stored.allows(account.stored, store.bytes, size)

    def store_shortage(self, size: int) -> str:
        """Why `may_store` says no, in words, without saying of whom."""
        total = self.store.bytes
        return self.quotas.stored.shortage(total, size, "room in the store", "store.size", "stored")

    def take(self, account: Account, size: int) -> None:
        """The account holds so many bytes of memory more, or less."""
        account.bytes += size
        self.queued_bytes += size

    def has_expired(self, message: Message) -> bool:
        """Whether it must not be sent any more [MQTT-3.3.2-5]; counted, if so."""
        if message.expires_at is None or message.expires_at > self.now:
            return False
        self.counters.publish_dropped += 1
        return True
