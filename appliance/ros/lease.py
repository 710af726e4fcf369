"""Who commands a ROS topic alone, whichever routes lead there."""

from __future__ import annotations

import math
from collections.abc import Callable
from weakref import WeakValueDictionary

from appliance.broker.ports import Decision
from appliance.broker.session import Session

_FREE = Decision(True, "nobody commands it")


class Lease:
    """One for each ROS topic; times are in seconds.

    It is given by routes that are exclusive, and holds for all that lead to the topic.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.holder: Session | None = None
        #: When the holder commanded last.
        self.heard_at = -math.inf
        #: One of each exclusive route there: has it watch for when the holder has been silent.
        self._watches: list[Callable[[], None]] = []

    def join(self, watch: Callable[[], None]) -> None:
        """An exclusive route leads there."""
        self._watches.append(watch)

    def part(self, watch: Callable[[], None]) -> None:
        """It does no longer. The lease is over with the last one; until then others watch it."""
        self._watches.remove(watch)
        if not self._watches:
            self.holder = None
        elif self.holder is not None:
            for other in self._watches:
                other()

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
