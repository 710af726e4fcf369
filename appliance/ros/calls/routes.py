"""What of the ROS graph is asked and answered instead of sent: services, actions, parameters.

Beside the bridge's topics, on the same node and the same two threads. What belongs to the ROS
thread is in the methods `look` and `lost`, all else is for the event loop's thread.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

from appliance.broker.broker import Broker
from appliance.net.callbacks import Entries
from appliance.ros.calls.actions import ActionRoutes, ActionSettings
from appliance.ros.calls.dispatcher import CallCounters, CallDispatcher, CallLimits
from appliance.ros.calls.parameter_server import ServerParameters
from appliance.ros.calls.parameter_topics import ParameterSettings
from appliance.ros.calls.parameters import ParameterRoutes
from appliance.ros.calls.requests import Requests
from appliance.ros.calls.services import ServiceRoutes, ServiceSettings
from appliance.ros.mailbox import Mailbox
from appliance.ros.node import RosNode
from appliance.ros.payload.converter import Converters
from appliance.ros.skipped import Skipped
from appliance.ros.topics.conversions import ConversionQueue

__all__ = [
    "ActionSettings",
    "CallBridge",
    "CallLimits",
    "CallRoutes",
    "CallStatus",
    "ParameterSettings",
    "ServiceSettings",
]

AnySettings: TypeAlias = ServiceSettings | ActionSettings | ParameterSettings


@dataclass(frozen=True, slots=True)
class CallRoutes:
    """Every route that is called, and how many calls may be under way."""

    services: tuple[ServiceSettings, ...] = ()
    actions: tuple[ActionSettings, ...] = ()
    parameters: tuple[ParameterSettings, ...] = ()
    limits: CallLimits = field(default_factory=CallLimits)


@dataclass(frozen=True, slots=True)
class CallStatus:
    """A route, the names on the bus that it is for now, and what it has counted."""

    settings: AnySettings
    names: tuple[str, ...]
    counters: CallCounters


class CallBridge:
    """All that is called, in one place: `look` follows the graph, `replace` the configuration."""

    def __init__(
        self,
        node: RosNode,
        broker: Broker,
        entries: Entries,
        converters: Converters,
        mailbox: Mailbox,
        post: Callable[..., None],
        announce: Callable[[], None],
        turns: ConversionQueue,
    ) -> None:
        """`post` calls on the loop's thread; `announce` is called there when what `bridged` gives
        may have changed."""
        self._broker = broker
        self._faults = broker.faults
        self._post = post
        self._announce = announce
        self._routes = CallRoutes()
        self.dispatcher = CallDispatcher(broker, entries, turns)
        self._requests = Requests(node, entries.loop, post, self._follow)
        self._services = ServiceRoutes(
            self.dispatcher, self._requests, converters, node, entries, post, announce
        )
        self._actions = ActionRoutes(
            self.dispatcher, self._requests, converters, node, entries, post, mailbox
        )
        self._parameters: ParameterRoutes | ServerParameters
        if node.parameter_server is not None:
            self._parameters = ServerParameters(self.dispatcher, node, entries.loop, post, announce)
        else:
            self._parameters = ParameterRoutes(
                self.dispatcher, self._requests, converters, node, entries, post
            )

    @property
    def routes(self) -> CallRoutes:
        """Those that there are now."""
        return self._routes

    def replace(self, routes: CallRoutes) -> None:
        """Have these routes from now on; one that was there before does not notice."""
        self._routes = routes
        self.dispatcher.limits = routes.limits
        self._services.replace(routes.services)
        self._actions.replace(routes.actions)
        self._parameters.replace(routes.parameters)
        self._keep_ready()

    def _follow(self) -> None:
        for follow in (
            self._services.follow,
            self._actions.follow,
            self._parameters.follow,
            self._keep_ready,
            self._announce,
        ):
            self._faults.run("calls.follow", follow, otherwise=None)

    def _keep_ready(self) -> None:
        self._requests.keep_ready((*self._services.keys(), *self._actions.keys()))

    def start(self) -> None:
        """Let calls come in."""
        self.dispatcher.start()
        self._actions.start()
        self._parameters.start()
        self._broker.departures.append(self._actions.departed)

    async def leave(self) -> None:
        """The bus is about to be left."""
        await self._actions.cancel_orphans()

    async def stop(self) -> None:
        """Answer what is under way, take back what was shown; may be called twice."""
        if self._actions.departed in self._broker.departures:
            self._broker.departures.remove(self._actions.departed)
        await self._actions.stop()
        await self._parameters.stop()
        self._services.stop()
        await self.dispatcher.stop()

    def status(self) -> list[CallStatus]:
        """Every route's state and counters."""
        found: list[tuple[AnySettings, CallCounters, list[str]]] = [
            *self._services.status(),
            *self._actions.status(),
            *self._parameters.status(),
        ]
        return [CallStatus(route, tuple(names), counters) for route, counters, names in found]

    def bridged(self) -> list[dict[str, str]]:
        """Entries for `{robot}/_appliance/routes`."""
        return [
            *self._services.bridged(),
            *self._actions.bridged(),
            *self._parameters.bridged(),
        ]

    def skips(self) -> list[Skipped]:
        """What routes speak of and is not bridged, and why."""
        return [*self._services.skips(), *self._actions.skips(), *self._parameters.skips()]

    # The ROS thread

    def look(self) -> None:
        """Follow what has come and gone on the graph."""
        routes = self._routes
        looks = [
            self._services.servers.poll_graph,
            self._actions.topics.poll_graph,
            self._parameters.source.poll_graph,
        ]
        has_routes = routes.services or routes.actions or routes.parameters
        if has_routes or self._requests.clients.has_clients:
            looks.insert(0, self._requests.clients.poll_graph)
        for look in looks:
            try:
                look()
            except Exception as error:
                self._post(self._faults.caught, "calls.look", error)

    def lost(self) -> None:
        """The bus is gone, and with it all that was set up."""
        self._requests.clients.on_bus_lost()
        self._services.servers.on_bus_lost()
        self._actions.topics.on_bus_lost()
        self._parameters.source.on_bus_lost()
