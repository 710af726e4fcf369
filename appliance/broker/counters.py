"""The broker's counters: the source of `$SYS`, of the metrics and of the cost limit of a turn."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal, TypeAlias, get_args

#: The cost that one client may cause in one turn of the event loop, see `Counters.cost`: some
#: milliseconds of work.
COST_PER_TURN: Final = 1000

#: Why a message was dropped.
DropReason: TypeAlias = Literal[
    "queue_full",  # no room in the client's queue, or no memory
    "replaced",  # a newer one of its topic took its place, for a slow client
    "expired",  # it waited too long
    "too_large",  # larger than the client takes
    "forbidden",  # by the rules or limits that are in force meanwhile
    "not_stored",  # the store has no room for it, or fails
    "not_retained",  # no room among the retained messages; it was delivered
    "fault",  # of the appliance
]

DROP_REASONS: Final[tuple[DropReason, ...]] = get_args(DropReason)


@dataclass(slots=True)
class Counters:
    """Counters of one broker; each only grows from the broker's start."""

    bytes_received: int = 0
    bytes_sent: int = 0
    control_received: int = 0
    control_sent: int = 0
    publish_received: int = 0
    publish_sent: int = 0
    dropped: dict[DropReason, int] = field(default_factory=lambda: dict.fromkeys(DROP_REASONS, 0))
    last_drop: DropReason = "queue_full"
    #: Messages that a newer one replaced because of a subscription's max-rate.
    publish_throttled: int = 0
    publish_refused: int = 0
    publish_bytes_received: int = 0
    publish_bytes_sent: int = 0
    connects: int = 0
    #: By reason code; `logins_failed` are those of a wrong password or no right to come in, over
    #: HTTP too.
    refusals: dict[int, int] = field(default_factory=dict)
    logins_failed: int = 0
    connections_refused: int = 0
    sockets: int = 0
    #: Work done, in units of about four microseconds: the time that one message takes. Code that
    #: takes longer adds its own cost here, so that a client's turn can be ended without reading
    #: the clock.
    cost: int = 0
    sessions_expired: int = 0
    #: Connections and sessions that were ended to make room for another client, see
    #: `Broker._make_room`.
    evicted: int = 0
    clients_maximum: int = 0

    def drop(self, reason: DropReason) -> None:
        """Count a message that is dropped for this reason."""
        self.dropped[reason] += 1
        self.last_drop = reason

    def take_back_drop(self) -> None:
        """The message that was counted last is kept after all."""
        self.dropped[self.last_drop] -= 1

    @property
    def publish_dropped(self) -> int:
        """Messages that were dropped, for whatever reason."""
        return sum(self.dropped.values())

    @property
    def connects_refused(self) -> int:
        """CONNECT packets that were refused."""
        return sum(self.refusals.values())

    def refuse(self, code: int) -> None:
        """Count a CONNECT that is refused with this reason code."""
        self.refusals[code] = self.refusals.get(code, 0) + 1

    @property
    def messages_received(self) -> int:
        """Packets of all kinds that came in; `control_received` counts all but PUBLISH."""
        return self.publish_received + self.control_received

    @property
    def messages_sent(self) -> int:
        """Packets of all kinds that went out."""
        return self.publish_sent + self.control_sent
