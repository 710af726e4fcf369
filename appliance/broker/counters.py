"""The broker's counters: the source of `$SYS`, of the metrics and of the cost limit of a turn."""

from __future__ import annotations

from dataclasses import dataclass, field

#: The cost that one client may cause in one turn of the event loop, see `Counters.cost`: some
#: milliseconds of work.
COST_PER_TURN = 1000


@dataclass(slots=True)
class Counters:
    """Counters of one broker; each only grows from the broker's start."""

    bytes_received: int = 0
    bytes_sent: int = 0
    control_received: int = 0
    control_sent: int = 0
    publish_received: int = 0
    publish_sent: int = 0
    publish_dropped: int = 0
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
