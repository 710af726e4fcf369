"""Parameters as MQTT clients see them: retained topics below a node's, and calls that set them.

The values come from the nodes, which keep their own (parameters.py), or from a server that keeps
all of them (parameter_server.py).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Generic, TypeVar

import orjson
import pybase64

from appliance.broker.message import Message
from appliance.mqtt.codec import Properties, Property
from appliance.mqtt.topics import check_topic
from appliance.ros.calls.dispatcher import (
    Answer,
    Call,
    CallCounters,
    CallDispatcher,
    CallEndpoint,
    CallError,
)
from appliance.ros.patterns import Names, compile_pattern
from appliance.ros.payload.converter import LARGEST_LENIENT, ConversionError, TooLargeError
from appliance.ros.payload.encodings.base import EncodingName
from appliance.ros.payload.encodings.registry import CONTENT_TYPE, VALUE_ENCODINGS
from appliance.ros.payload.payloads import InputLimits

#: Parameters that one call may set.
MAX_SET_AT_ONCE = 200

#: Longer names, in characters, are not published: they would be no topics.
MAX_NAME_LENGTH = 1024


@dataclass(frozen=True, slots=True)
class ParameterSettings:
    """Parameters, by names and patterns such as `/node/parameter`; what begins with `!` is left
    out.

    `mqtt` is the topic above a node's values; a `{node}` in it stands for the node's full name.
    `timeout` is for setting, in seconds.
    """

    names: tuple[str, ...]
    mqtt: str
    timeout: float = 5.0
    encoding: EncodingName = "json"

    def of(self, node: str) -> Names | None:
        """The names of a node's parameters that are bridged; None when there are none."""
        mine: list[str] = []
        for text in self.names:
            is_excluded = text.startswith("!")
            pattern, _, name = text.removeprefix("!").rpartition("/")
            if compile_pattern(pattern, hidden=is_excluded).fullmatch(node):
                mine.append(f"!{name}" if is_excluded else name)
        return Names(mine) if any(not name.startswith("!") for name in mine) else None


@dataclass(eq=False, slots=True)
class ParameterGroup:
    """A node whose parameters are published, or a namespace that stands for one.

    `retained` has the payloads that are retained now, by the parameter's name.
    """

    name: str
    base: str
    route: ParameterSettings
    wanted: list[Names]
    retained: dict[str, bytes] = field(default_factory=dict)
    endpoints: list[CallEndpoint] = field(default_factory=list)

    def wants(self, parameter: str) -> bool:
        """Whether the parameter is published, and may be set."""
        return any(parameter in names for names in self.wanted)


GroupT = TypeVar("GroupT", bound=ParameterGroup)


def matching_routes(
    routes: Iterable[ParameterSettings], node: str
) -> dict[ParameterSettings, Names]:
    """The routes that bridge parameters of the node, each with their names."""
    return {route: names for route in routes if (names := route.of(node))}


class ParameterTopics(ABC, Generic[GroupT]):
    """The routes of parameters, and what they publish now; for the loop's thread."""

    #: The type of a value on the bus, as `bridged` reports it.
    type_name = ""

    def __init__(self, dispatcher: CallDispatcher) -> None:
        self._dispatcher = dispatcher
        self._counters: dict[ParameterSettings, CallCounters] = {}
        self._routes: Sequence[ParameterSettings] = ()
        self._groups: dict[str, GroupT] = {}

    def start(self) -> None:
        """Clear what another run has left retained: nothing is known of the bus yet."""
        for route in self._counters:
            self._dispatcher.clear_retained(route.mqtt, "{node}", ".+")

    def replace(self, routes: Sequence[ParameterSettings]) -> None:
        """Use these routes from now on."""
        if list(routes) == list(self._routes):
            return
        self._routes = routes
        self._counters = {route: self._counters.get(route) or CallCounters() for route in routes}
        self._remove_all()  # their parameters have to be matched with the patterns anew
        self._routes_changed()

    @abstractmethod
    def _routes_changed(self) -> None:
        """Publish what the routes want; nothing is published now."""

    @abstractmethod
    async def _set(self, group: GroupT, values: dict[str, Any], call: Call, at_once: bool) -> str:
        """Set parameters, all or none if `at_once`; returns the reason that the bus gives.

        Parameters that no route wants have been rejected before. Raises CallError.
        """

    def _new_group(self, name: str, kind: type[GroupT]) -> GroupT | None:
        """A new group for the node of that name; None when no route wants it."""
        wanted = matching_routes(self._counters, name)
        if not wanted:
            return None
        route = next(iter(wanted))
        return kind(name, route.mqtt.replace("{node}", name), route, list(wanted.values()))

    def _add(self, group: GroupT) -> None:
        """Accept calls for a group from now on."""
        self._groups[group.name] = group

        def set_one(call: Call) -> Callable[[], Awaitable[Answer]]:
            values = {call.topic.split("/")[-2]: value_of(call, self._dispatcher.limits.input)}
            return partial(self._check_and_set, group, values, call, at_once=False)

        def set_all(call: Call) -> Callable[[], Awaitable[Answer]]:
            values = values_of(call, self._dispatcher.limits.input)
            return partial(self._check_and_set, group, values, call, at_once=True)

        route = group.route
        for topic, handle in (("+/set", set_one), ("_set", set_all)):
            endpoint = CallEndpoint(
                f"{group.base}/{topic}",
                f"the parameters of {group.name or '/'}",
                route.timeout,
                self._counters[route],
                handle,
                route.encoding,
                max_bytes=LARGEST_LENIENT,
            )
            group.endpoints.append(endpoint)
            self._dispatcher.register(endpoint)

    def _remove(self, group: GroupT) -> None:
        """Remove a group that is gone, and clear its values."""
        del self._groups[group.name]
        for endpoint in group.endpoints:
            self._dispatcher.unregister(endpoint)
        for parameter in list(group.retained):
            self._publish(group, parameter, b"")

    def _remove_all(self) -> None:
        for group in list(self._groups.values()):
            self._remove(group)

    def _publish(self, group: GroupT, name: str, payload: bytes) -> None:
        """Publish a parameter where it has changed; an empty payload clears it."""
        topic = f"{group.base}/{name}"
        if payload == group.retained.get(name, b"") or not _is_topic(name, topic):
            return
        if payload:
            group.retained[name] = payload
        else:
            del group.retained[name]
        properties: Properties = {Property.CONTENT_TYPE: CONTENT_TYPE[group.route.encoding]}
        self._dispatcher.publish(Message(topic, payload, 1, True, properties))

    async def _check_and_set(
        self, group: GroupT, values: dict[str, Any], call: Call, *, at_once: bool
    ) -> Answer:
        for name in values:
            if not group.wants(name):
                text = f"the parameter {group.name}/{name} is not among bridge.parameters"
                raise CallError("not_authorized", text)
        reason = await self._set(group, values, call, at_once)
        result = {"successful": True, "reason": reason}
        return Answer(VALUE_ENCODINGS[call.encoding].dumps(result), call.encoding)

    def status(self) -> list[tuple[ParameterSettings, CallCounters, list[str]]]:
        """Each route, its counters, and the nodes that it bridges now."""
        return [
            (route, counters, [name for name in self._groups if route.of(name)])
            for route, counters in self._counters.items()
        ]

    def bridged(self) -> list[dict[str, Any]]:
        """Entries for `{robot}/_appliance/routes`."""
        return [
            {
                "ros": group.name or "/",
                "mqtt": group.base,
                "type": self.type_name,
                "direction": "parameters",
                "encoding": group.route.encoding,
                "timeout": group.route.timeout,
            }
            for group in self._groups.values()
        ]


def _is_topic(name: str, topic: str) -> bool:
    """Whether a parameter's name can be in a topic: a node may choose any name."""
    try:
        check_topic(topic)
    except ValueError:
        return False
    return len(name) <= MAX_NAME_LENGTH


def value_of(call: Call, limits: InputLimits) -> Any:
    """The value in a call. Raises CallError."""
    try:
        encoding = VALUE_ENCODINGS[call.encoding]
        limits.check(call.payload, encoding)
        return encoding.loads(call.payload)
    except TooLargeError as error:
        raise CallError("too_large", str(error)) from None
    except ConversionError as error:
        raise CallError("bad_request", str(error)) from None


def values_of(call: Call, limits: InputLimits) -> dict[str, Any]:
    """The values in a call, by the parameters' names. Raises CallError."""
    values = value_of(call, limits)
    is_mapping = isinstance(values, dict) and all(isinstance(name, str) for name in values)
    if not is_mapping or not values:
        raise CallError("bad_request", 'expected parameters and values: {"speed": 0.5, …}')
    if len(values) > MAX_SET_AT_ONCE:
        text = f"{len(values)} parameters, at most {MAX_SET_AT_ONCE} are set at once"
        raise CallError("too_large", text)
    named: dict[str, Any] = values
    return named


def to_bytes(name: str, value: Any) -> bytes:
    """The bytes that a value of JSON or CBOR stands for. Raises CallError."""
    try:
        if isinstance(value, str):
            return pybase64.b64decode(value, validate=True)
        if isinstance(value, (bytes, list)):
            return bytes(value)
    except (TypeError, ValueError):
        pass
    raise unlike(name, "an array of bytes, as base64 or a list", value)


def unlike(name: str, expected: str, value: Any) -> CallError:
    """The error for a value of another type than the parameter has."""
    return CallError("bad_request", f"{name}: expected {expected}, got {shorten(value)}")


def shorten(value: Any) -> str:
    """A value as errors quote it."""
    try:
        text = orjson.dumps(value).decode()
    except TypeError:  # what only CBOR has
        text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]}…"
