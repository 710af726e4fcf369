"""What holds for a ROS topic, whichever routes lead there: who commands it alone, and which
commands a stop message has overtaken."""

from __future__ import annotations

import math
from typing import Protocol
from weakref import WeakValueDictionary

from appliance.broker.ports import Decision
from appliance.broker.session import Session

_FREE = Decision(True, "nobody commands it")

#: Why a command is not carried out that waited for something when a stop came.
OVERTAKEN = "a stop came after it"


class Ruled(Protocol):
    """A route with rules that leads to the topic."""

    @property
    def is_exclusive(self) -> bool:
        """Whether one client commands there at a time."""

    def watch(self) -> None:
        """See when the holder of the lease has been silent for too long."""

    def stops(self, cdr: bytes) -> bool:
        """Whether it is the route's stop message, or says the same."""


class Lease:
    """One for each ROS topic; times are in seconds.

    It is given by routes that are exclusive, and holds for all that lead to the topic. So does a
    stop: what came before it is not carried out behind it, by whatever route and whose ever it is.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.holder: Session | None = None
        #: When the holder commanded last.
        self.heard_at = -math.inf
        self._routes: list[Ruled] = []
        #: What came with a number below this is overtaken, see `Arrivals.number`.
        self._stopped = 0

    def join(self, route: Ruled) -> None:
        """A route with rules leads there."""
        self._routes.append(route)

    def part(self, route: Ruled) -> None:
        """It does no longer. The lease is over with the last one that is exclusive; until then
        others watch it."""
        self._routes.remove(route)
        exclusive = [other for other in self._routes if other.is_exclusive]
        if not exclusive:
            self.holder = None
        elif self.holder is not None:
            for other in exclusive:
                other.watch()

    def stop(self, number: int) -> None:
        """A stop goes to ROS: nothing is carried out any more that came before that number."""
        self._stopped = max(self._stopped, number)

    def said(self, cdr: bytes, number: int) -> None:
        """A message goes to ROS that came with that number: it may be what one of the routes
        there knows as a stop."""
        if any(route.stops(cdr) for route in self._routes):
            self.stop(number)

    def is_overtaken(self, number: int) -> bool:
        """Whether a stop has gone to ROS that came later."""
        return number < self._stopped

    def decide(self, session: Session) -> Decision:
        """Whether the session may command now."""
        holder = self.holder
        # What the bridge itself publishes there is what it heard on ROS.
        if holder is None or session is holder or session.link_for is not None:
            return _FREE
        return Decision(False, f"{holder} commands {self.topic}, and the route is exclusive")


class Leases:
    """Those of all topics that routes lead to; for the loop's thread."""

    def __init__(self) -> None:
        self._leases: WeakValueDictionary[str, Lease] = WeakValueDictionary()

    def of(self, topic: str) -> Lease:
        """The lease of a topic."""
        lease = self._leases.get(topic)
        if lease is None:
            lease = self._leases[topic] = Lease(topic)
        return lease
