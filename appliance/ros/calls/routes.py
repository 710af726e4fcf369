"""The bridge's calls: all routes of services, actions and parameters, and what they share.

They use the same node and the same two threads as the bridge's topics.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Protocol, TypeAlias

from appliance.broker.broker import Broker
from appliance.broker.faults import Faults
from appliance.net.callbacks import Entries
from appliance.ros.calls.actions import ActionRoutes, ActionSettings
from appliance.ros.calls.context import CallContext
from appliance.ros.calls.dispatcher import CallCounters, CallDispatcher, CallLimits
from appliance.ros.calls.parameter_server import ServerParameters
from appliance.ros.calls.parameter_topics import ParameterSettings
from appliance.ros.calls.parameters import ParameterRoutes
from appliance.ros.calls.requests import Requests
from appliance.ros.calls.service_clients import ServiceClients
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


#: What the messages of a type are called behind its name, by what `bridged` calls the direction.
_PARTS: Final = {
    "service": ("_Request", "_Response"),
    "provided": ("_Request", "_Response"),
    "action": ("_Goal", "_Feedback", "_Result"),
}


@dataclass(frozen=True, slots=True)
class CallRoutes:
    """All routes of calls, and the limits on calls under way."""

    services: tuple[ServiceSettings, ...] = ()
    actions: tuple[ActionSettings, ...] = ()
    parameters: tuple[ParameterSettings, ...] = ()
    limits: CallLimits = field(default_factory=CallLimits)


@dataclass(frozen=True, slots=True)
class CallStatus:
    """A route, the names on the bus that it bridges now, and its counters."""

    settings: AnySettings
    names: tuple[str, ...]
    counters: CallCounters


class GraphPoller(Protocol):
    """Polls the graph, on the ROS thread."""

    def poll_graph(self) -> None:
        """Follow what has come and gone on the graph."""

    def on_bus_lost(self) -> None:
        """The node has ended, and all that was created with it."""


class CallPoller:
    """The ROS thread's side of all calls. `enable` is for the loop's thread, all else for the ROS
    thread."""

    def __init__(
        self,
        clients: ServiceClients,
        others: Sequence[GraphPoller],
        faults: Faults,
        post: Callable[..., None],
    ) -> None:
        self._clients = clients
        self._others = others
        self._faults = faults
        self._post = post
        #: Replaced by the loop's thread.
        self._is_enabled = False

    def enable(self, is_enabled: bool) -> None:
        """Follow the services on the bus, or only those that are being asked."""
        self._is_enabled = is_enabled

    def poll_graph(self) -> None:
        """Follow what has come and gone on the graph."""
        follows_services = self._is_enabled or self._clients.has_clients
        for follower in (self._clients, *self._others) if follows_services else self._others:
            try:
                follower.poll_graph()
            except Exception as error:
                self._post(self._faults.caught, "calls.look", error)

    def on_bus_lost(self) -> None:
        """The node has ended, and all that was created with it."""
        for follower in (self._clients, *self._others):
            follower.on_bus_lost()


class CallBridge:
    """Bridges services, actions and parameters; for the loop's thread, and `poller` for the ROS
    thread."""

    def __init__(
        self,
        node: RosNode,
        broker: Broker,
        entries: Entries,
        converters: Converters,
        mailbox: Mailbox,
        post: Callable[..., None],
        announce: Callable[[], None],
        conversions: ConversionQueue,
    ) -> None:
        """`post` calls on the loop's thread; `announce` is called there when what `bridged` gives
        may have changed."""
        self._broker = broker
        self._faults = broker.faults
        self._announce = announce
        self._routes = CallRoutes()
        self.dispatcher = CallDispatcher(broker, entries, conversions)
        self._requests = Requests(node, entries.loop, post, self._follow)
        context = CallContext(self.dispatcher, self._requests, converters, node, entries, post)
        self._services = ServiceRoutes(context, announce)
        self._actions = ActionRoutes(context, mailbox)
        self._parameters: ParameterRoutes | ServerParameters
        if node.parameter_server is not None:
            self._parameters = ServerParameters(self.dispatcher, node, entries.loop, post, announce)
        else:
            self._parameters = ParameterRoutes(context)
        followers = (self._services.servers, self._actions.topics, self._parameters.source)
        self.poller = CallPoller(self._requests.clients, followers, broker.faults, post)

    @property
    def routes(self) -> CallRoutes:
        """The routes that are used now."""
        return self._routes

    def replace(self, routes: CallRoutes) -> None:
        """Use these routes from now on; one that was there before goes on without a break."""
        self._routes = routes
        self.poller.enable(bool(routes.services or routes.actions or routes.parameters))
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
        """Accept calls."""
        self.dispatcher.start()
        self._actions.start()
        self._parameters.start()
        self._broker.departures.append(self._actions.departed)

    async def leave(self) -> None:
        """Cancel what may not outlive the appliance, before the bus is left."""
        await self._actions.cancel_orphans()

    async def stop(self) -> None:
        """Answer the calls under way, clear what is retained; may be called twice."""
        if self._actions.departed in self._broker.departures:
            self._broker.departures.remove(self._actions.departed)
        await self._actions.stop()
        await self._parameters.stop()
        self._services.stop()
        await self.dispatcher.stop()

    @property
    def goals(self) -> int:
        """Goals of MQTT clients that are under way."""
        return len(self._actions.goals.slots)

    def status(self) -> list[CallStatus]:
        """Every route's state and counters."""
        found: list[tuple[AnySettings, CallCounters, list[str]]] = [
            *self._services.status(),
            *self._actions.status(),
            *self._parameters.status(),
        ]
        return [CallStatus(route, tuple(names), counters) for route, counters, names in found]

    def types(self) -> list[str]:
        """The types of requests and responses, goals, feedback and results, for their schemas."""
        return [
            entry["type"] + part
            for entry in (*self._services.bridged(), *self._actions.bridged())
            for part in _PARTS[entry["direction"]]
            if entry["type"]
        ]

    def bridged(self) -> list[dict[str, Any]]:
        """Entries for `{robot}/_appliance/routes`."""
        return [
            *self._services.bridged(),
            *self._actions.bridged(),
            *self._parameters.bridged(),
        ]

    def skips(self) -> list[Skipped]:
        """What a route names and is not bridged, and why."""
        return [*self._services.skips(), *self._actions.skips(), *self._parameters.skips()]
