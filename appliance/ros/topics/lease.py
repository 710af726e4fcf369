"""The state that all routes to one ROS topic share: which client commands it alone, and which
commands a stop message has overtaken."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol
from weakref import WeakValueDictionary

from appliance.broker.session import Session
from appliance.broker.values import Decision

#: The client id of the bridge's own session, which has no identity.
BRIDGE_CLIENT_ID = "_bridge"

_FREE = Decision(True, "nobody commands it")

#: Why a command that was held or queued when a stop came is not carried out.
OVERTAKEN = "a stop came after it"

#: After so many stops in a row, each at most so many seconds after the one before, a client only
#: repeats its stop, as an idle joystick does. Nobody presses a button in alarm that often.
REPEATED = 5
REPEAT_WITHIN = 1.0

#: Clients whose last stop is remembered; the oldest is evicted.
MAX_CLIENTS = 1000


class CommandRoute(Protocol):
    """A route with command rules that leads to the topic."""

    @property
    def is_exclusive(self) -> bool:
        """Whether only one client at a time may command."""

    def watch(self) -> None:
        """Watch for the lease's holder being silent for too long."""

    def is_stop_message(self, cdr: bytes) -> bool:
        """Whether it is the route's stop message, or equivalent to it."""


@dataclass(slots=True)
class _Stops:
    """The stops of one client: how many in a row, and the number and time of the last one."""

    number: int = -1
    at: float = -math.inf
    in_a_row: int = 0


class Lease:
    """The lease of one ROS topic; times are in seconds.

    Exclusive routes grant it, and it holds for all routes that lead to the topic. So does a stop:
    commands that came before it are not carried out after it, whatever their route and client. But
    if the robot is stopped already, a client that only repeats its stop overtakes only its own
    commands: otherwise no held or queued command would be carried out beside an idle joystick.
    """

    def __init__(self, topic: str, changed: Callable[[], object] = lambda: None) -> None:
        """`changed` is called when another client holds it, or none does."""
        self.topic = topic
        self._holder: Session | None = None
        self._changed = changed
        #: When the holder commanded last.
        self.commanded_at = -math.inf
        self._routes: list[CommandRoute] = []
        #: A stop overtakes commands with a lower number (`StalenessDetector.number`). The second
        #: number is for commands without a session, which every stop overtakes.
        self._stopped = 0
        self._stopped_last = 0
        #: The stops of each client, by its client id: it may have reconnected since.
        self._stops: OrderedDict[str, _Stops] = OrderedDict()
        #: Whether the last message for ROS was a stop.
        self._is_stopped = False

    @property
    def holder(self) -> Session | None:
        """The client that commands alone, if one does."""
        return self._holder

    @holder.setter
    def holder(self, holder: Session | None) -> None:
        has_changed = holder is not self._holder
        self._holder = holder
        if has_changed:
            self._changed()

    def add_route(self, route: CommandRoute) -> None:
        """A route with command rules leads to the topic from now on."""
        self._routes.append(route)

    def remove_route(self, route: CommandRoute) -> None:
        """A route does so no longer. The lease ends with the last exclusive route; until then the
        other ones watch it."""
        self._routes.remove(route)
        exclusive = [other for other in self._routes if other.is_exclusive]
        if not exclusive:
            self.holder = None
        elif self.holder is not None:
            for other in exclusive:
                other.watch()

    def stop(self, number: int) -> None:
        """A stop goes to ROS: commands with lower numbers are not carried out any more."""
        self._stopped = max(self._stopped, number)
        self._stopped_last = max(self._stopped_last, number)
        self._is_stopped = True

    def on_published(self, cdr: bytes, number: int, origin: Session | None, now: float) -> None:
        """The session's message with that number goes to ROS: it is a stop if it is the stop
        message of one of the routes to the topic."""
        own = None if origin is None else self._stops.get(origin.client_id)
        if not any(route.is_stop_message(cdr) for route in self._routes):
            self._is_stopped = False
            if own is not None:
                own.in_a_row = 0
            return
        if origin is not None:
            own = self._stops_of(origin.client_id)
            if number != own.number:  # it may have several routes
                own.in_a_row = own.in_a_row + 1 if now - own.at <= REPEAT_WITHIN else 1
                own.number, own.at = max(own.number, number), now
        is_repeated = own is not None and own.in_a_row >= REPEATED
        if self._is_stopped and is_repeated:
            self._stopped_last = max(self._stopped_last, number)
        else:
            self.stop(number)

    def _stops_of(self, client_id: str) -> _Stops:
        own = self._stops.setdefault(client_id, _Stops())
        self._stops.move_to_end(client_id)
        if len(self._stops) > MAX_CLIENTS:
            _, forgotten = self._stops.popitem(last=False)
            self._stopped = max(self._stopped, forgotten.number)
        return own

    def is_overtaken(self, number: int, origin: Session | None) -> bool:
        """Whether a later stop that went to ROS overtakes the session's command."""
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
    """The leases of all topics that routes lead to; for the loop's thread."""

    def __init__(self, changed: Callable[[], object]) -> None:
        """`changed` is called when a lease has another holder, or none any more."""
        self._changed = changed
        self._leases: WeakValueDictionary[str, Lease] = WeakValueDictionary()

    def of(self, topic: str) -> Lease:
        """The lease of a topic."""
        lease = self._leases.get(topic)
        if lease is None:
            lease = self._leases[topic] = Lease(topic, self._changed)
        return lease
