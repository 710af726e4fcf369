"""Parameters as MQTT clients see them: retained topics below a node's, and calls that set them.

Where the values come from is different: each node has its own (parameters.py), or there is one
place for all (parameter_server.py).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Sequence
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

#: Parameters that one call sets.
SET_AT_ONCE = 200

#: Longer names, in characters, are not shown: they would be no topics.
LONGEST_NAME = 1024


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
        """Those that are wanted of a node; None for none at all."""
        mine: list[str] = []
        for text in self.names:
            is_excluded = text.startswith("!")
            pattern, _, name = text.removeprefix("!").rpartition("/")
            if compile_pattern(pattern, hidden=is_excluded).fullmatch(node):
                mine.append(f"!{name}" if is_excluded else name)
        return Names(mine) if any(not name.startswith("!") for name in mine) else None


@dataclass(eq=False, slots=True)
class ParameterGroup:
    """A node whose parameters are shown, or what stands for one: by name, what is retained."""

    name: str
    base: str
    route: ParameterSettings
    wanted: list[Names]
    shown: dict[str, bytes] = field(default_factory=dict)
    endpoints: list[CallEndpoint] = field(default_factory=list)

    def wants(self, parameter: str) -> bool:
        """Whether it is shown, and may be set."""
        return any(parameter in names for names in self.wanted)


GroupT = TypeVar("GroupT", bound=ParameterGroup)


class ParameterTopics(ABC, Generic[GroupT]):
    """The routes of parameters, and what they show now; for the loop's thread."""

    #: The type of a value on the bus, for who asks what is bridged.
    type_name = ""

    def __init__(self, dispatcher: CallDispatcher) -> None:
        self._dispatcher = dispatcher
        self._counters: dict[ParameterSettings, CallCounters] = {}
        self._routes: Sequence[ParameterSettings] = ()
        self._groups: dict[str, GroupT] = {}

    def start(self) -> None:
        """Nothing is known of the bus yet."""
        for route in self._counters:
            self._dispatcher.clear_retained(route.mqtt, "{node}", ".+")

    def replace(self, routes: Sequence[ParameterSettings]) -> None:
        """Have these routes from now on."""
        if list(routes) == list(self._routes):
            return
        self._routes = routes
        self._counters = {route: self._counters.get(route) or CallCounters() for route in routes}
        self._leave_all()  # which patterns a value is of has to be asked anew
        self._look_again()

    @abstractmethod
    def _look_again(self) -> None:
        """Show what the routes want; nothing is shown now."""

    @abstractmethod
    async def _set(self, group: GroupT, values: dict[str, Any], call: Call, at_once: bool) -> str:
        """Set parameters, all or none if `at_once`; returns what the bus says of it.

        Those that the routes do not want have been refused. Raises CallError.
        """

    def _find(self, name: str, kind: type[GroupT]) -> GroupT | None:
        """The node of that name as the routes want it; None when they do not."""
        wanted = {route: names for route in self._counters if (names := route.of(name))}
        if not wanted:
            return None
        route = next(iter(wanted))
        return kind(name, route.mqtt.replace("{node}", name), route, list(wanted.values()))

    def _join(self, group: GroupT) -> None:
        """Take calls for it from now on."""
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
                largest=LARGEST_LENIENT,
            )
            group.endpoints.append(endpoint)
            self._dispatcher.register(endpoint)

    def _leave(self, group: GroupT) -> None:
        """It is gone, and its values are true no more."""
        del self._groups[group.name]
        for endpoint in group.endpoints:
            self._dispatcher.unregister(endpoint)
        for parameter in list(group.shown):
            self._publish(group, parameter, b"")

    def _leave_all(self) -> None:
        for group in list(self._groups.values()):
            self._leave(group)

    def _publish(self, group: GroupT, name: str, payload: bytes) -> None:
        """Show a parameter as it is now; without a payload it is no more."""
        topic = f"{group.base}/{name}"
        if payload == group.shown.get(name, b"") or not _is_topic(name, topic):
            return
        if payload:
            group.shown[name] = payload
        else:
            del group.shown[name]
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
        said = {"successful": True, "reason": reason}
        return Answer(VALUE_ENCODINGS[call.encoding].dumps(said), call.encoding)

    def status(self) -> list[tuple[ParameterSettings, CallCounters, list[str]]]:
        """Each route, what it has counted, and the nodes that it shows now."""
        return [
            (route, counters, [name for name in self._groups if route.of(name)])
            for route, counters in self._counters.items()
        ]

    def bridged(self) -> list[dict[str, str]]:
        """Entries for `{robot}/_appliance/routes`."""
        return [
            {
                "ros": group.name or "/",
                "mqtt": group.base,
                "type": self.type_name,
                "direction": "parameters",
                "encoding": group.route.encoding,
            }
            for group in self._groups.values()
        ]


def _is_topic(name: str, topic: str) -> bool:
    """Whether a parameter's name makes a topic: a node may give it any."""
    try:
        check_topic(topic)
    except ValueError:
        return False
    return len(name) <= LONGEST_NAME


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
    """The values in a call, by the names of parameters. Raises CallError."""
    values = value_of(call, limits)
    is_mapping = isinstance(values, dict) and all(isinstance(name, str) for name in values)
    if not is_mapping or not values:
        raise CallError("bad_request", 'expected parameters and values: {"speed": 0.5, …}')
    if len(values) > SET_AT_ONCE:
        text = f"{len(values)} parameters, at most {SET_AT_ONCE} are set at once"
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
    """A value as an error shows it."""
    try:
        text = orjson.dumps(value).decode()
    except TypeError:  # what only CBOR has
        text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]}…"
