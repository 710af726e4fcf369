"""What is counted of a backlog: messages that wait, by rule and in all, and what became of others.

Each message that was offered is in the end sent, dropped for a reason, or set aside:
`offered + restored = sent + dropped + set aside + waiting`.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import Enum

from appliance.upstream.rule_queue import RuleQueue


class DropReason(Enum):
    """Why a message is not sent."""

    FULL = "full"  # the backlog, or its part of the memory
    REFUSED = "refused"  # as it is full; the publisher was told
    STORE = "store"  # nothing can be stored now; the publisher was told
    DISK = "disk"  # not acknowledged to anybody, as more came than the disk takes
    AGE = "age"
    EXPIRED = "expired"
    REPLACED = "replaced"  # by a newer one of its topic
    OFFLINE = "offline"  # its rule keeps nothing without a connection
    UNREADABLE = "unreadable"  # damaged on the disk
    CLOSED_UPON = "closed upon"  # the fleet's broker has closed the connection upon its topic


def too_old(
    stored_at: float, expires_at: float | None, age: float | None, now: float
) -> DropReason | None:
    """Why a message is not to be sent any more, if so; `age` is the limit of seconds, if any."""
    if expires_at is not None and expires_at <= now:
        return DropReason.EXPIRED
    return DropReason.AGE if age is not None and stored_at + age <= now else None


@dataclass(slots=True)
class BacklogCounts:
    """What has happened to messages since the start, and what waits now.

    `waiting` includes those `in_flight`, and so do `bytes`. `oldest_at` is when the oldest of them
    was published, in seconds of the journals' clock. `restored` waited at the start. `dropped` is
    by rule and reason; of those that were set aside, `aside` are kept. Of those that wait, `held`
    are larger than the fleet's broker takes now.
    """

    offered: int = 0
    restored: int = 0
    sent: int = 0
    set_aside: int = 0
    dropped: Counter[tuple[str, DropReason]] = field(default_factory=Counter)
    waiting: int = 0
    in_flight: int = 0
    bytes: int = 0
    lanes: tuple[int, int, int] = (0, 0, 0)
    oldest_at: float | None = None
    aside: int = 0
    held: int = 0


class Tally:
    """Counts the messages of a link's rules while they come and go."""

    __slots__ = ("bytes", "dropped", "messages", "offered", "restored", "sent", "set_aside")

    def __init__(self) -> None:
        #: Those that wait or are in flight, and the bytes of their records.
        self.messages = 0
        self.bytes = 0
        #: Since the start, as in `BacklogCounts`.
        self.offered = self.restored = self.sent = self.set_aside = 0
        self.dropped: Counter[tuple[str, DropReason]] = Counter()

    def add(self, queue: RuleQueue, messages: int, size: int) -> None:
        """So many more of the rule wait; negative: fewer."""
        queue.messages += messages
        queue.bytes += size
        self.messages += messages
        self.bytes += size

    def remove(self, queue: RuleQueue, size: int) -> None:
        """One message of the rule waits no more."""
        self.add(queue, -1, -size)

    def drop(self, queue: RuleQueue, reason: DropReason, count: int = 1) -> None:
        """So many of the rule are not sent; they do not count as waiting."""
        if count:
            self.dropped[queue.name, reason] += count

    def dropped_as_full(self) -> int:
        """How many were dropped or refused because the backlog was full."""
        full = (DropReason.FULL, DropReason.REFUSED)
        return sum(count for (_, reason), count in self.dropped.items() if reason in full)
