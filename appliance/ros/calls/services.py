"""Services both ways, on the loop's thread.

`to: ros`: an MQTT client calls a ROS service at `r2d2/reset/_call`; dispatcher.py answers it.

`to: mqtt`: a ROS service that an MQTT client answers. Each request is a message to
`r2d2/name/_request/{token}`, with `r2d2/name/_response/{token}` as its Response Topic and the token
as its Correlation Data; a 3.1.1 client takes the token from the topic. The first message on the
Response Topic is the response. The user property `status: error`, or the payload `{"error": …}`,
makes it a failure. ROS cannot report a failure to its client: the client gets the route's
`on_error`, or no response and runs into its own time limit.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import secrets
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.mqtt.codec import Property
from appliance.mqtt.reason import ReasonCode
from appliance.ros.calls.context import CallContext
from appliance.ros.calls.dispatcher import (
    REPORT_INTERVAL,
    WITHOUT_RAW,
    Answer,
    Call,
    CallCounters,
    CallEndpoint,
    CallError,
)
from appliance.ros.calls.serialization import from_ros, to_request
from appliance.ros.calls.service_clients import Key
from appliance.ros.calls.service_server import ServiceServer, ServiceServers
from appliance.ros.node import BusError, Respond
from appliance.ros.patterns import assign, compile_pattern, refusals
from appliance.ros.payload.converter import ConversionError
from appliance.ros.payload.definitions import UnknownTypeError
from appliance.ros.payload.encodings.base import EncodingName
from appliance.ros.payload.encodings.registry import (
    CONTENT_TYPE,
    VALUE_ENCODINGS,
    named_encoding,
)
from appliance.ros.skipped import Skipped, SkipReason

log = logging.getLogger(__name__)

#: What every node offers; they are called only where a route names them.
_OF_EVERY_NODE = re.compile(
    r"(rcl_interfaces|type_description_interfaces)/srv/.*|roscpp/srv/(GetLoggers|SetLoggerLevel)"
)


@dataclass(frozen=True, slots=True)
class ServiceSettings:
    """Services, by names and patterns, that MQTT calls (`to` ROS), or one that ROS calls (to MQTT).

    The latter needs a `type`. What begins with `!` in `names` is left out. A `{ros}` in `mqtt`
    stands for the ROS name. `timeout` is in seconds. With a `type`, in which `*` is a part of the
    name, patterns take only services of that type. `encoding` is for calls that name none.
    `on_error` is the JSON of the response that a ROS client gets when MQTT gave none.
    """

    names: tuple[str, ...]
    mqtt: str
    to: Literal["ros", "mqtt"] = "ros"
    type: str | None = None
    timeout: float = 5.0
    encoding: EncodingName = "json"
    on_error: str | None = None

    def base(self, ros: str) -> str:
        """The MQTT topic above all that belong to this service."""
        return self.mqtt.replace("{ros}", ros)


class ServiceRoutes:
    """The routes of services; for the loop's thread, and `servers` for the ROS thread."""

    def __init__(self, context: CallContext, changed: Callable[[], None]) -> None:
        """`changed` is called when what `skips` gives has changed."""
        self._context = context
        self._dispatcher = context.dispatcher
        self._requests = context.requests
        self._converters = context.converters
        self._changed = changed
        self.servers = ServiceServers()
        self._counters: dict[ServiceSettings, CallCounters] = {}
        #: The services that MQTT clients may call, by name.
        self._endpoints: dict[str, tuple[ServiceSettings, CallEndpoint]] = {}
        #: The services that ROS nodes may call.
        self._provided: dict[ServiceSettings, ProvidedService] = {}
        #: Services on the bus that a pattern names and does not take.
        self._refused: list[Skipped] = []
        #: The type that a service last had.
        self._types: dict[str, str] = {}
        #: Those that were logged as callable.
        self._callable: set[str] = set()

    def replace(self, routes: Sequence[ServiceSettings]) -> None:
        """Use these routes from now on; one that was there before goes on without a break."""
        self._counters = {route: self._counters.get(route) or CallCounters() for route in routes}
        wanted = [route for route in self._counters if route.to == "mqtt"]
        for route, provided in list(self._provided.items()):
            if route not in wanted:
                provided.stop()
                del self._provided[route]
        for route in wanted:
            if route not in self._provided:
                self._provided[route] = ProvidedService(
                    route, self._counters[route], self._context, self._changed
                )
        self.servers.replace(provided.server for provided in self._provided.values())
        self.follow()

    def follow(self) -> None:
        """Register endpoints for the services that are on the bus now."""
        for name, types in self._requests.services.items():
            if self._types.get(name) not in types:
                self._types[name] = min(types)
        wanted = self._wanted()
        for name, (route, endpoint) in list(self._endpoints.items()):
            if wanted.get(name) != route:
                self._dispatcher.unregister(endpoint)
                del self._endpoints[name]
        for name, route in wanted.items():
            if name not in self._endpoints:
                self._add_endpoint(name, route)
        self._log_changes()
        self._types = {
            name: found
            for name, found in self._types.items()
            if name in self._requests.services or name in self._endpoints
        }

    def _wanted(self) -> dict[str, ServiceSettings]:
        """The services that MQTT may call, and the route of each."""
        own = {route.names[0] for route in self._provided}
        found = {name: types for name, types in self._requests.services.items() if name not in own}
        routes = [route for route in self._counters if route.to == "ros"]

        def misfit(route: ServiceSettings, name: str) -> tuple[SkipReason, str] | None:
            return _misfit(route, found[name])

        wanted = assign(routes, found, lambda route, name: misfit(route, name) is None)
        # The services of actions belong to bridge.actions.
        others = {name: types for name, types in found.items() if "/_action/" not in name}
        self._refused = refusals(routes, others, wanted, "service", misfit)
        return wanted

    def _add_endpoint(self, name: str, route: ServiceSettings) -> None:
        topic = f"{route.base(name)}/_call"
        endpoint = CallEndpoint(
            topic,
            name,
            route.timeout,
            self._counters[route],
            partial(self._handle, name, route),
            route.encoding,
            (*WITHOUT_RAW, self._context.node.serialization.encoding),
        )
        self._endpoints[name] = route, endpoint
        self._dispatcher.register(endpoint)
        if name not in self._requests.services:
            log.info("%s: no node offers it yet; it will be called at %s", name, topic)

    def _log_changes(self) -> None:
        """Log which services can be called, and which no longer: a route alone offers nothing."""
        there = {name for name in self._endpoints if name in self._requests.services}
        for name in sorted(there - self._callable):
            log.info("%s can be called at %s", name, self._endpoints[name][1].topic)
        for name in sorted(self._callable - there):
            log.info("%s cannot be called any more", name)
        self._callable = there

    def _type(self, name: str, route: ServiceSettings) -> str | None:
        fixed = route.type if route.type is not None and "*" not in route.type else None
        return fixed or self._types.get(name)

    def _handle(
        self, name: str, route: ServiceSettings, call: Call
    ) -> Callable[[], Awaitable[Answer]]:
        type_name = self._type(name, route)
        if type_name is None:
            raise CallError("unavailable", f"there is no {name} on the bus")
        request = to_request(
            self._converters,
            f"{type_name}_Request",
            call.payload,
            call.encoding,
            self._dispatcher.limits.input,
        )
        return partial(self._ask, name, type_name, request, call)

    async def _ask(self, name: str, type_name: str, request: bytes, call: Call) -> Answer:
        response = await self._requests.ask(name, type_name, request)
        response_type = f"{type_name}_Response"
        payload = await self._dispatcher.convert(
            call.caller,
            len(response),
            partial(from_ros, self._converters, response_type, response, call.encoding),
        )
        return Answer(payload, call.encoding, response_type)

    def keys(self) -> Iterable[Key]:
        """The services that need a client that is ready."""
        for name, (route, _) in self._endpoints.items():
            type_name = self._type(name, route)
            if type_name is not None:
                yield name, type_name

    def status(self) -> list[tuple[ServiceSettings, CallCounters, list[str]]]:
        """Each route, its counters, and the services that it bridges now."""
        return [
            (
                route,
                counters,
                [name for name, (of, _) in self._endpoints.items() if of is route]
                + (list(route.names) if route in self._provided else []),
            )
            for route, counters in self._counters.items()
        ]

    def bridged(self) -> list[dict[str, Any]]:
        """Entries for `{robot}/_appliance/routes`."""
        entries = [
            _entry("service", name, endpoint.topic, self._type(name, route), route)
            for name, (route, endpoint) in self._endpoints.items()
            if name in self._requests.services
        ]
        return entries + [
            _entry("provided", name, f"{route.base(name)}/_request", route.type, route)
            for route in self._provided
            for name in route.names
        ]

    def skips(self) -> list[Skipped]:
        """The services that a route names and that cannot be called, or are not provided."""
        skips = list(self._refused)
        for name, (route, _) in self._endpoints.items():
            type_name = self._type(name, route) or ""
            problem = self._requests.problem(name, type_name)
            if problem is not None:
                skips.append(Skipped(name, "service", type_name, "problem", problem))
            elif name not in self._requests.services:
                skips.append(Skipped(name, "service", type_name, "absent", "no node offers it"))
        for provided in self._provided.values():
            skips += provided.skips()
        return skips

    def stop(self) -> None:
        """Remove all services, once the bus has been left."""
        for provided in self._provided.values():
            provided.stop()
        self._provided.clear()
        self.servers.replace(())
        self._endpoints.clear()
        self._refused.clear()


def _misfit(route: ServiceSettings, types: Sequence[str]) -> tuple[SkipReason, str] | None:
    """Why a pattern of the route does not take a service of these types; None when it does."""
    if route.type is not None:
        if any(map(compile_pattern(route.type).fullmatch, types)):
            return None
        return "other_type", f"the route takes {route.type}"
    takes_all = any("*" in name.rpartition("/")[2] for name in route.names if name[0] != "!")
    if takes_all and _OF_EVERY_NODE.fullmatch(min(types)):
        return "of_every_node", "every node has one; patterns take it only where they name it"
    return None


def _entry(
    direction: str, ros: str, mqtt: str, type_name: str | None, route: ServiceSettings
) -> dict[str, Any]:
    return {
        "ros": ros,
        "mqtt": mqtt,
        "type": type_name or "",
        "direction": direction,
        "encoding": route.encoding,
        "timeout": route.timeout,
    }


@dataclass(eq=False, slots=True)
class _PendingRequest:
    """A request from ROS that MQTT has not answered yet."""

    respond: Respond
    timer: asyncio.TimerHandle


class ProvidedService:
    """One ROS service that MQTT clients answer; for the loop's thread, and `server` for the ROS
    thread."""

    def __init__(
        self,
        route: ServiceSettings,
        counters: CallCounters,
        context: CallContext,
        changed: Callable[[], None],
    ) -> None:
        assert route.type is not None
        self._route = route
        self._counters = counters
        self._dispatcher = context.dispatcher
        self._converters = context.converters
        self._node = context.node
        self._entries = context.entries
        self._post = context.post
        self._changed = changed
        (self._ros,) = route.names
        self._base = route.base(self._ros)
        self._request_type = f"{route.type}_Request"
        self._response_type = f"{route.type}_Response"
        self._pending: dict[str, _PendingRequest] = {}
        self._next_log = 0.0
        #: Why ROS does not have the service.
        self._problem: str | None = None
        self._dispatcher.subscribe(f"{self._base}/_response/+", self._on_response)
        self.server = ServiceServer(
            self._ros, route.type, route.encoding, self._node, self._converters, self, self._post
        )

    def created(self) -> None:
        """ROS nodes can call the service now."""
        log.info("%s is offered, and answered at %s", self._ros, self._base)

    def refused(self, problem: str) -> None:
        """The service could not be created."""
        log.error("%s is not offered: %s", self._ros, problem)
        self._counters.last_error = self._problem = problem
        self._changed()

    def skips(self) -> list[Skipped]:
        """Why ROS does not have the service, if that is so."""
        if self._problem is None:
            return []
        return [Skipped(self._ros, "provided", self._route.type or "", "problem", self._problem)]

    def requested(self, payload: bytes, respond: Respond) -> None:
        """Publish a request of a ROS node, and await its response on MQTT."""
        route = self._route
        self._counters.calls += 1
        if len(self._pending) >= self._dispatcher.limits.total:
            count = len(self._pending)
            self.fail(respond, f"too_many: {count} requests are under way (bridge.limits.calls)")
            return
        token = secrets.token_hex(8)
        message = Message(
            f"{self._base}/_request/{token}",
            payload,
            1,
            properties={
                Property.CONTENT_TYPE: CONTENT_TYPE[route.encoding],
                Property.RESPONSE_TOPIC: f"{self._base}/_response/{token}",
                Property.CORRELATION_DATA: token.encode(),
                Property.USER_PROPERTY: [("ros-type", self._request_type)],
            },
            expires_at=self._dispatcher.now() + route.timeout,
        )
        late = f"timeout: no MQTT client answered within {route.timeout:g} s"
        timer = self._entries.later(
            "services.timeout", route.timeout, self._give_up, token, late, served=self._ros
        )
        self._pending[token] = _PendingRequest(respond, timer)
        self._counters.under_way += 1
        if self._dispatcher.publish(message) is ReasonCode.NO_MATCHING_SUBSCRIBERS:
            self._give_up(
                token, f"unavailable: no MQTT client subscribes to {self._base}/_request/+"
            )

    def _on_response(self, origin: Session, message: Message) -> None:
        pending = self._remove(message.topic.rpartition("/")[2])
        if pending is None:
            log.debug("%s: a response to nothing under way", self._ros)
            return
        properties = message.properties or {}
        user_properties = properties.get(Property.USER_PROPERTY)
        encoding = named_encoding(properties.get(Property.CONTENT_TYPE)) or self._route.encoding
        if isinstance(user_properties, list) and ("status", "error") in user_properties:
            self.fail(pending.respond, f"rejected: {message.payload[:200]!r}")
            return
        # The queue needs no limit for these: each request has one response.
        convert = partial(self._convert_response, pending.respond, message.payload, encoding)
        self._dispatcher.conversions.do(origin, len(message.payload), convert)

    def _convert_response(self, respond: Respond, payload: bytes, encoding: EncodingName) -> None:
        limits = self._dispatcher.limits.input
        try:
            cdr = to_request(self._converters, self._response_type, payload, encoding, limits)
        except CallError as error:
            problem = f"bad response: {error}"
            if error.code == "too_large":
                problem = f"too_large: {error}"
            elif _is_error(payload, encoding):
                problem = f"rejected: {payload[:200]!r}"
            self.fail(respond, problem)
            return
        self._counters.answers += 1
        self._respond(respond, cdr)

    def _remove(self, token: str) -> _PendingRequest | None:
        pending = self._pending.pop(token, None)
        if pending is not None:
            pending.timer.cancel()
            self._counters.under_way -= 1
        return pending

    def _give_up(self, token: str, problem: str) -> None:
        pending = self._remove(token)
        if pending is not None:
            self.fail(pending.respond, problem)

    def fail(self, respond: Respond, problem: str) -> None:
        """Answer a request that MQTT gave no response to: with the route's `on_error`, if any."""
        code = problem.partition(":")[0]
        self._counters.errors[code] += 1
        self._counters.last_error = problem
        now = self._entries.time()
        if now >= self._next_log:
            self._next_log = now + REPORT_INTERVAL
            count = sum(self._counters.errors.values())
            log.warning("a call of %s failed (%d so far): %s", self._ros, count, problem)
        cdr = None
        if self._route.on_error is not None:
            try:
                cdr = self._converters.get(self._response_type).from_json(
                    self._route.on_error.encode()
                )
            except (ConversionError, UnknownTypeError) as error:
                log.warning("on_error of %s cannot be used: %s", self._ros, error)
        self._respond(respond, cdr)

    def _respond(self, respond: Respond, cdr: bytes | None) -> None:
        def send() -> None:
            try:
                respond(cdr)
            except BusError as error:
                self._post(log.warning, "%s: no response could be sent: %s", self._ros, error)

        try:
            self._node.call_soon(send)
        except BusError:
            log.debug("%s: the bus has gone", self._ros)

    def stop(self) -> None:
        """Remove the service; requests under way are answered with `on_error`, if any."""
        self._dispatcher.unsubscribe(f"{self._base}/_response/+")
        for token in list(self._pending):
            self._give_up(token, "stopping: the service is offered no longer")
        self.server.retire()
        with contextlib.suppress(BusError):  # without a bus there is no service either
            self._node.call_soon(self.server.close)


def _is_error(payload: bytes, encoding: EncodingName) -> bool:
    # What cannot be read as ROS's own bytes may be an error all the same, which is JSON then.
    values = VALUE_ENCODINGS.get(encoding) or VALUE_ENCODINGS["json"]
    try:
        value = values.loads(payload)
    except ConversionError:
        return False
    return isinstance(value, dict) and isinstance(value.get("error"), dict)
