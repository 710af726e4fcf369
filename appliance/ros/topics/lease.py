"""What holds for a ROS topic, whichever routes lead there: who commands it alone, and which
commands a stop message has overtaken."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import Protocol
from weakref import WeakValueDictionary

from appliance.broker.ports import Decision
from appliance.broker.session import Session

#: The client id of the bridge's own session, which has no identity.
BRIDGE_CLIENT_ID = "_bridge"

_FREE = Decision(True, "nobody commands it")

#: Why a command is not carried out that waited for something when a stop came.
OVERTAKEN = "a stop came after it"

#: Stops of one client in a row, each at most so many seconds after the one before, from which on it
#: only repeats what it says, as a joystick does that nobody touches. Who presses a button in alarm
#: presses it less often.
REPEATED = 5
WITHIN = 1.0

#: Clients of which is known when they stopped a topic.
CLIENTS = 1000


class CommandRoute(Protocol):
    """A route with rules that leads to the topic."""

    @property
    def is_exclusive(self) -> bool:
        """Whether one client commands there at a time."""

    def watch(self) -> None:
        """See when the holder of the lease has been silent for too long."""

    def stops(self, cdr: bytes) -> bool:
        """Whether it is the route's stop message, or says the same."""


@dataclass(slots=True)
class _Stops:
    """Those of one client: how many in a row, and the last one's number and time."""

    number: int = -1
    at: float = -math.inf
    in_a_row: int = 0


class Lease:
    """One for each ROS topic; times are in seconds.

    It is given by routes that are exclusive, and holds for all that lead to the topic. So does a
    stop: what came before it is not carried out behind it, by whatever route and whose ever it is.
    But where the robot stands already, who only repeats its stop overtakes nothing but what it has
    sent itself: beside an idle joystick no command that waits would be carried out otherwise.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.holder: Session | None = None
        #: When the holder commanded last.
        self.heard_at = -math.inf
        self._routes: list[CommandRoute] = []
        #: A stop overtakes commands with a lower number (`StalenessDetector.number`). The second
        #: number is for commands without a session, which every stop overtakes.
        self._stopped = 0
        self._stopped_last = 0
        #: The stops of each client, by its client id: it may have a new connection since.
        self._stops: OrderedDict[str, _Stops] = OrderedDict()
        #: Whether what went to ROS last was a stop.
        self._stands = False

    def join(self, route: CommandRoute) -> None:
        """A route with rules leads there."""
        self._routes.append(route)

    def part(self, route: CommandRoute) -> None:
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
        self._stopped_last = max(self._stopped_last, number)
        self._stands = True

    def said(self, cdr: bytes, number: int, origin: Session | None, now: float) -> None:
        """A message of the session goes to ROS that came with that number: it may be what one of
        the routes there knows as a stop."""
        own = None if origin is None else self._stops.get(origin.client_id)
        if not any(route.stops(cdr) for route in self._routes):
            self._stands = False
            if own is not None:
                own.in_a_row = 0
            return
        if origin is not None:
            own = self._stops_of(origin.client_id)
            if number != own.number:  # it may have several routes
                own.in_a_row = own.in_a_row + 1 if now - own.at <= WITHIN else 1
                own.number, own.at = max(own.number, number), now
        is_repeated = own is not None and own.in_a_row >= REPEATED
        if self._stands and is_repeated:
            self._stopped_last = max(self._stopped_last, number)
        else:
            self.stop(number)

    def _stops_of(self, client_id: str) -> _Stops:
        own = self._stops.setdefault(client_id, _Stops())
        self._stops.move_to_end(client_id)
        if len(self._stops) > CLIENTS:
            _, forgotten = self._stops.popitem(last=False)
            self._stopped = max(self._stopped, forgotten.number)
        return own

    def is_overtaken(self, number: int, origin: Session | None) -> bool:
        """Whether a stop has gone to ROS that came later, and overtakes what the session sent."""
        if origin is None:
            return number < self._stopped_last
        own = self._stops.get(origin.client_id)
        return number < self._stopped or (own is not None and number < own.number)

    def decide(self, session: Session) -> Decision:
        """Whether the session may command now."""
        holder = self.holder
        # What the bridge itself publishes there has come from ROS.
        is_bridge = session.identity is None and session.client_id == BRIDGE_CLIENT_ID
        if holder is None or session is holder or is_bridge:
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
