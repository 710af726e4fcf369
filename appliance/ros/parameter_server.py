"""Parameters of a bus that keeps them all in one place, as ROS 1's Master does.

They are shown and set as those of nodes are (parameters.py): `/arm/speed` is retained at
`r2d2/arm/_param/speed`, `…/_param/speed/set` sets it, `…/_param/_set` several of them. What is
before the last `/` stands for the node, which there need not be. The values are read once a second.

A parameter has no declared type: it takes that of the value, but an integer for a double is a
double, as JSON does not tell the two.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from time import monotonic
from typing import Any

import orjson

from appliance.broker.message import Message
from appliance.mqtt.codec import Properties, Property
from appliance.ros.calls import JSON, Answer, Call, CallCounters, CallError, Offer, Switchboard
from appliance.ros.node import BusError, ParameterServer, RosNode
from appliance.ros.parameters import ParameterSettings, from_json, shorten
from appliance.ros.patterns import Names

log = logging.getLogger(__name__)

#: Seconds between two looks at the parameters.
INTERVAL = 1.0


@dataclass(eq=False, slots=True)
class _Namespace:
    """Parameters that stand beside each other: by name, what is retained."""

    name: str
    base: str
    route: ParameterSettings
    wanted: Names
    shown: dict[str, bytes] = field(default_factory=dict)


class ServerParameters:
    """The routes of parameters; for the loop's thread, where it does not say otherwise."""

    def __init__(
        self,
        board: Switchboard,
        node: RosNode,
        loop: asyncio.AbstractEventLoop,
        post: Callable[..., None],
        changed: Callable[[], None],
    ) -> None:
        """`changed` is called when what `bridged` gives has changed."""
        self._board = board
        self._node = node
        self._loop = loop
        self._post = post
        self._changed = changed
        self._counters: dict[ParameterSettings, CallCounters] = {}
        self._routes: Sequence[ParameterSettings] = ()
        self._namespaces: dict[str, _Namespace] = {}
        #: All parameters of the last look, by namespace, and the values of those that are wanted.
        self._names: dict[str, list[str]] = {}
        self._values: dict[str, Any] = {}
        # The ROS thread's.
        self._looked_at = 0.0

    def start(self) -> None:
        """Nothing is known of the bus yet."""
        for route in self._counters:
            self._board.clear(route.mqtt, "{node}", ".+")

    def replace(self, routes: Sequence[ParameterSettings]) -> None:
        """Have these routes from now on."""
        if list(routes) == list(self._routes):
            return
        self._routes = routes
        self._counters = {
            route: self._counters.get(route) or CallCounters()
            for route in routes
            if not route.node.startswith("!")
        }
        for namespace in list(self._namespaces.values()):
            self._leave(namespace)
        self._looked_at = 0.0

    def follow(self) -> None:
        """Services have come or gone: no matter."""

    def _find(self, name: str) -> _Namespace | None:
        """The namespace `/arm`, as the routes want it; None when they do not."""
        mine = [route for route in self._counters if name in Names([route.node])]
        if not mine:
            return None
        excluded = [
            f"!{route.name}"
            for route in self._routes
            if route.node.startswith("!") and name in Names([route.node[1:]])
        ]
        wanted = Names([*(route.name for route in mine), *excluded])
        return _Namespace(name, mine[0].mqtt.replace("{node}", name), mine[0], wanted)

    def _take(self, names: dict[str, list[str]], values: dict[str, Any]) -> None:
        """What there is now."""
        self._names, self._values = names, values
        found: dict[str, dict[str, bytes]] = {}
        for full_name, value in values.items():
            space, _, name = full_name.rpartition("/")
            try:
                found.setdefault(space, {})[name] = orjson.dumps(value)
            except TypeError:  # an integer too large for JSON
                log.debug("%s cannot be shown", full_name)
        has_changed = False
        for shown in list(self._namespaces.values()):
            if shown.name not in found:
                self._leave(shown)
                has_changed = True
        for name, own in found.items():
            namespace = self._namespaces.get(name) or self._find(name)
            if namespace is None:  # the routes have changed meanwhile
                continue
            if name not in self._namespaces:
                self._join(namespace)
                has_changed = True
            for parameter in namespace.shown.keys() - own.keys():
                self._show(namespace, parameter, b"")
            for parameter, payload in own.items():
                if parameter in namespace.wanted:
                    self._show(namespace, parameter, payload)
        if has_changed:
            self._changed()

    def _join(self, namespace: _Namespace) -> None:
        self._namespaces[namespace.name] = namespace

        async def set_one(call: Call) -> Answer:
            return await self._set(namespace, {call.topic.split("/")[-2]: from_json(call.payload)})

        async def set_all(call: Call) -> Answer:
            values = from_json(call.payload)
            if not isinstance(values, dict) or not values:
                raise CallError("bad_request", 'expected parameters and values: {"speed": 0.5, …}')
            return await self._set(namespace, values)

        counters = self._counters[namespace.route]
        for topic, handle in (("+/set", set_one), ("_set", set_all)):
            what = f"the parameters of {namespace.name or '/'}"
            topic = f"{namespace.base}/{topic}"
            self._board.offer(Offer(topic, what, namespace.route.timeout, counters, handle))
        log.info("the parameters of %s are at %s", namespace.name or "/", namespace.base)

    def _leave(self, namespace: _Namespace) -> None:
        del self._namespaces[namespace.name]
        for topic in ("+/set", "_set"):
            self._board.withdraw(f"{namespace.base}/{topic}")
        for parameter in list(namespace.shown):
            self._show(namespace, parameter, b"")

    def _show(self, namespace: _Namespace, name: str, payload: bytes) -> None:
        if payload == namespace.shown.get(name, b"") or set("+#\0") & set(name):
            return
        if payload:
            namespace.shown[name] = payload
        else:
            del namespace.shown[name]
        properties: Properties = {Property.CONTENT_TYPE: JSON}
        self._board.publish(Message(f"{namespace.base}/{name}", payload, 1, True, properties))

    async def _set(self, namespace: _Namespace, values: dict[str, Any]) -> Answer:
        full_names = {f"{namespace.name}/{name}": value for name, value in values.items()}
        for full_name, value in full_names.items():
            if full_name.rpartition("/")[
                2
            ] not in namespace.wanted or "/" in full_name.removeprefix(f"{namespace.name}/"):
                text = f"the parameter {full_name!r} is not among bridge.parameters"
                raise CallError("not_authorized", text)
            if value is None or isinstance(value, dict):
                text = f"{full_name}: no parameter can have the value {shorten(value)}"
                raise CallError("bad_request", text)
            if full_name in self._names:
                text = f"{full_name} holds other parameters: set these"
                raise CallError("rejected", text)
            if isinstance(self._values.get(full_name), float) and type(value) is int:
                full_names[full_name] = float(value)
        done: asyncio.Future[None] = self._loop.create_future()
        try:
            self._node.call_soon(partial(self._set_all, full_names, done))
        except BusError as error:
            raise CallError("ros_error", str(error)) from None
        await done
        return Answer(orjson.dumps({"successful": True, "reason": ""}))

    def status(self) -> list[tuple[ParameterSettings, CallCounters, list[str]]]:
        """Each route, what it has counted, and the namespaces that it shows now."""
        return [
            (route, counters, [name for name in self._namespaces if name in Names([route.node])])
            for route, counters in self._counters.items()
        ]

    def bridged(self) -> list[dict[str, str]]:
        """Entries for `{robot}/_appliance/routes`."""
        return [
            {
                "ros": namespace.name or "/",
                "mqtt": namespace.base,
                "type": "",
                "direction": "parameters",
                "encoding": "json",
            }
            for namespace in self._namespaces.values()
        ]

    async def stop(self) -> None:
        """The bus has been left: no value is true any more."""
        for namespace in list(self._namespaces.values()):
            self._leave(namespace)

    # The ROS thread

    def look(self) -> None:
        """Read the parameters, now and then."""
        server = self._node.parameter_server
        now = monotonic()
        if server is None or not self._routes or now < self._looked_at + INTERVAL:
            return
        self._looked_at = now
        try:
            self._read(server)
        except BusError as error:
            self._post(log.debug, "the parameters cannot be read: %s", error)

    def _read(self, server: ParameterServer) -> None:
        names: dict[str, list[str]] = {}
        for full_name in server.names():
            space, _, name = full_name.rpartition("/")
            names.setdefault(space, []).append(name)
        for space in list(names):
            while space:
                space = space.rpartition("/")[0]
                names.setdefault(space, [])
        spaces = {space: self._find(space) for space in names}
        wanted = [
            f"{space}/{name}"
            for space, found in names.items()
            if (namespace := spaces[space]) is not None
            for name in found
            if name in namespace.wanted
        ]
        self._post(self._take, names, server.get(wanted))

    def _set_all(self, values: dict[str, Any], done: asyncio.Future[None]) -> None:
        server = self._node.parameter_server
        problem: CallError | None = None
        try:
            if server is None:
                raise BusError("ROS is not ready")
            for name, value in values.items():
                server.set(name, value)
            self._read(server)
        except BusError as error:
            problem = CallError("ros_error", str(error))
        self._post(_settle, done, problem)

    def lost(self) -> None:
        """The bus is gone; `stop` takes back what is shown."""
        self._post(self._take, {}, {})


def _settle(done: asyncio.Future[None], problem: CallError | None) -> None:
    if done.done():
        return
    if problem is None:
        done.set_result(None)
    else:
        done.set_exception(problem)
