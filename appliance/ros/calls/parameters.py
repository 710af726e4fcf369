"""Parameters of other nodes: their values as retained topics, and calls that set them.

`r2d2/node/_param/speed` has the value of `/node`'s parameter `speed` as plain JSON, and follows
`/parameter_events`; byte arrays are base64, or bytes where the encoding is `cbor`.
`…/_param/speed/set` sets it, `…/_param/_set` sets several of the node or none of them:
`{"speed": 0.5, "mode": "slow"}`. Values have the type that the node has declared: `1` is accepted
for a double. When the node goes, its values are cleared.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine, Iterable, Mapping
from dataclasses import dataclass
from time import monotonic
from typing import Any

import pybase64
from async_timeout import timeout

from appliance.ros.calls.context import CallContext
from appliance.ros.calls.dispatcher import Call, CallError
from appliance.ros.calls.parameter_events import EVENT, EVENTS, ParameterEvents
from appliance.ros.calls.parameter_topics import (
    ParameterGroup,
    ParameterTopics,
    shorten,
    to_bytes,
    unlike,
)
from appliance.ros.patterns import is_plain
from appliance.ros.payload.converter import ConversionError, TooLargeError
from appliance.ros.payload.definitions import UnknownTypeError
from appliance.ros.payload.encodings.base import EncodingName
from appliance.ros.payload.encodings.registry import VALUE_ENCODINGS
from appliance.ros.skipped import Skipped

log = logging.getLogger(__name__)

GET = "/get_parameters"

#: Seconds until a node is asked again that has not answered.
RETRY = 2.0

#: Seconds that a node may take to send all its parameters.
READ_TIMEOUT = 5.0

#: Seconds that the other services of a node may take to be discovered after the first: each is
#: announced by itself, and who sees a value may set it at once.
DISCOVERY = 2.0

#: Seconds between two looks for one of them.
LOOK = 0.05

#: Parameters that one request asks for.
CHUNK = 200

#: By the numbers of rcl_interfaces/msg/ParameterType: the field of a value, and its name.
_FIELDS = (
    ("", "not set"),
    ("bool_value", "a bool"),
    ("integer_value", "an integer"),
    ("double_value", "a double"),
    ("string_value", "a string"),
    ("byte_array_value", "an array of bytes"),
    ("bool_array_value", "an array of bools"),
    ("integer_array_value", "an array of integers"),
    ("double_array_value", "an array of doubles"),
    ("string_array_value", "an array of strings"),
)
_NOT_SET, _BOOL, _INTEGER, _DOUBLE, _STRING, _BYTES = range(6)
_BOOLS, _INTEGERS, _DOUBLES, _STRINGS = range(6, 10)


@dataclass(eq=False, slots=True)
class _NodeParameters(ParameterGroup):
    """A node, and the state of reading its values."""

    is_loading: bool = False
    is_stale: bool = True
    is_gone: bool = False
    #: Why its parameters cannot be read.
    problem: str | None = None


class ParameterRoutes(ParameterTopics[_NodeParameters]):
    """The routes of parameters; for the loop's thread, and `source` for the ROS thread."""

    type_name = "rcl_interfaces/msg/ParameterValue"

    def __init__(self, context: CallContext) -> None:
        super().__init__(context.dispatcher)
        self._requests = context.requests
        self._converters = context.converters
        self._node = context.node
        self._entries = context.entries
        self.source = ParameterEvents(context.node, self, context.post)
        self._tasks: set[asyncio.Task[None]] = set()
        self._is_stopped = False

    def _routes_changed(self) -> None:
        self.source.enable(bool(self._routes))
        self.follow()

    def follow(self) -> None:
        """Publish the parameters of the nodes that are on the bus now."""
        there = {
            service.removesuffix(GET)
            for service, types in self._requests.services.items()
            if service.endswith(GET) and "rcl_interfaces/srv/GetParameters" in types
        }
        for node in list(self._groups.values()):
            if node.name not in there:
                self._remove(node)
        for name in sorted(there - self._groups.keys() - {self._node.name}):
            found = self._new_group(name, _NodeParameters)
            if found is not None:
                self._add(found)
                self._load(found)

    def nodes_restarted(self, names: Iterable[str]) -> None:
        """Read the parameters of nodes anew of which another has appeared."""
        for name in names:
            node = self._groups.get(name)
            if node is not None:
                self._load(node)

    def _remove(self, node: _NodeParameters) -> None:
        node.is_gone = True
        super()._remove(node)

    def skips(self) -> list[Skipped]:
        """The nodes that a route names and that are not there, or do not answer."""
        if self._is_stopped:
            return []
        skips = [
            Skipped(node.name, "parameters", "", "problem", node.problem)
            for node in self._groups.values()
            if node.problem is not None
        ]
        named = {name.rpartition("/")[0] for route in self._counters for name in route.names}
        return skips + [
            Skipped(node, "parameters", "", "absent", "there is no such node, or it has none")
            for node in sorted(named - self._groups.keys())
            if is_plain(node)
        ]

    async def stop(self) -> None:
        """Clear all values, once the bus has been left."""
        self._is_stopped = True
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._remove_all()

    # Values

    async def _ask(
        self, node: _NodeParameters, verb: str, kind: str, fields: object
    ) -> dict[str, Any]:
        return await self._ask_for(node, verb, kind, self._write(kind, fields))

    def _write(self, kind: str, fields: object) -> bytes:
        try:
            return self._converters.get(f"rcl_interfaces/srv/{kind}_Request").from_dict(fields)
        except UnknownTypeError as error:
            raise CallError("unknown_type", str(error)) from None

    async def _ask_for(
        self, node: _NodeParameters, verb: str, kind: str, request: bytes
    ) -> dict[str, Any]:
        type_name = f"rcl_interfaces/srv/{kind}"
        service = f"{node.name}/{verb}"
        await self._discover(node, service)
        response = await self._requests.ask(service, type_name, request)
        try:
            return self._converters.get(f"{type_name}_Response").to_dict(response)
        except UnknownTypeError as error:
            raise CallError("unknown_type", str(error)) from None

    async def _discover(self, node: _NodeParameters, service: str) -> None:
        """Wait until a service of a node is on the bus, unless it does not come."""
        last = monotonic() + DISCOVERY
        while service not in self._requests.services and not node.is_gone:
            if monotonic() >= last:
                return
            await asyncio.sleep(LOOK)

    def _load(self, node: _NodeParameters) -> None:
        """Read a node's parameters in the background, again until none has changed meanwhile."""
        node.is_stale = True
        if not node.is_loading and not self._is_stopped:
            node.is_loading = True
            self._start_task(self._read(node))

    def _start_task(self, work: Coroutine[Any, Any, None]) -> None:
        task = self._entries.task("parameters.read", work)
        self._tasks.add(task)
        self._entries.when_done("parameters.end", task, self._tasks.discard, task)

    async def _read(self, node: _NodeParameters) -> None:
        try:
            await self._read_all(node)
        finally:
            node.is_loading = False

    async def _read_all(self, node: _NodeParameters) -> None:
        has_failed = False
        while node.is_stale and not node.is_gone:
            node.is_stale = False
            try:
                async with timeout(READ_TIMEOUT):
                    values = await self._get_all(node)
            except (CallError, ConversionError, asyncio.TimeoutError) as error:
                if self._is_stopped:  # Python 3.10 loses a cancellation that comes with the timeout
                    return
                why = str(error) or "no answer"
                node.problem = f"its parameters cannot be read: {why}"
                if not has_failed:
                    log.warning("the parameters of %s cannot be read: %s", node.name, why)
                has_failed = node.is_stale = True
                await asyncio.sleep(RETRY)
                continue
            node.problem = None
            if not node.is_stale and not node.is_gone:
                for name in node.retained.keys() - values.keys():
                    self._publish_value(node, name, None)
                for name, value in values.items():
                    self._publish_value(node, name, value)
                log.info("%d parameters of %s are at %s", len(values), node.name, node.base)

    async def _get_all(self, node: _NodeParameters) -> dict[str, Any]:
        listed = await self._ask(node, "list_parameters", "ListParameters", {"depth": 0})
        names = [name for name in listed["result"]["names"] if node.wants(name)]
        values: dict[str, Any] = {}
        for start in range(0, len(names), CHUNK):
            chunk = names[start : start + CHUNK]
            got = await self._get(node, chunk)
            if len(got) != len(chunk):
                # A parameter that the node cannot give leaves the response without any.
                single = [await self._get(node, [name]) for name in chunk]
                chunk = [name for name, one in zip(chunk, single, strict=True) if len(one) == 1]
                got = [one[0] for one in single if len(one) == 1]
            values.update(zip(chunk, got, strict=True))
        return values

    async def _get(self, node: _NodeParameters, names: list[str]) -> list[Any]:
        response = await self._ask(node, "get_parameters", "GetParameters", {"names": names})
        values: list[Any] = response["values"]
        return values

    def _publish_value(
        self, node: _NodeParameters, name: str, value: Mapping[str, Any] | None
    ) -> None:
        """Publish a parameter as it is now; None clears it."""
        if node.wants(name):
            payload = b"" if value is None else _to_payload(value, node.route.encoding)
            self._publish(node, name, payload)

    def take_events(self) -> None:
        """Publish what the queued events report as changed."""
        queue = self.source.queue
        queue.sleep()
        if queue.clear_if_full():
            for node in self._groups.values():
                self._load(node)
            return
        while queue:
            try:
                event = self._converters.get(EVENT).to_dict(queue.take())
            except (ConversionError, UnknownTypeError) as error:
                log.warning("%s: a message cannot be read: %s", EVENTS, error)
                continue
            group = self._groups.get(event["node"])
            if group is None:
                continue
            if group.is_loading:
                group.is_stale = True  # what is being read may be older, or newer
                continue
            for one in (*event["new_parameters"], *event["changed_parameters"]):
                self._publish_value(group, one["name"], one["value"])
            for one in event["deleted_parameters"]:
                self._publish_value(group, one["name"], None)

    # Setting

    async def _set(
        self, node: _NodeParameters, values: dict[str, Any], call: Call, at_once: bool
    ) -> str:
        names = list(values)
        response = await self._ask(
            node, "describe_parameters", "DescribeParameters", {"names": names}
        )
        descriptors = {one["name"]: one for one in response["descriptors"]}
        verb, kind = "set_parameters", "SetParameters"
        if at_once:
            verb, kind = "set_parameters_atomically", "SetParametersAtomically"

        def write() -> bytes:
            parameters = [
                {"name": name, "value": to_value(name, value, descriptors.get(name, {}))}
                for name, value in values.items()
            ]
            return self._write(kind, {"parameters": parameters})

        try:
            request = await self._dispatcher.convert(call.caller, len(call.payload), write)
            response = await self._ask_for(node, verb, kind, request)
        except TooLargeError as error:
            raise CallError("too_large", str(error)) from None
        except ConversionError as error:
            raise CallError("bad_request", f"{', '.join(names)}: {error.problem}") from None
        result = response["result"] if at_once else (response["results"] or [{}])[0]
        if not result.get("successful"):
            reason = result.get("reason") or "it gives no reason"
            raise CallError("rejected", f"{node.name} does not set {', '.join(names)}: {reason}")
        return str(result["reason"])


def _to_payload(value: Mapping[str, Any], encoding: EncodingName) -> bytes:
    """The payload of a ParameterValue; empty when the parameter is not set."""
    kind = value["type"]
    if not 0 < kind < len(_FIELDS):
        return b""
    plain = value[_FIELDS[kind][0]]
    described = VALUE_ENCODINGS[encoding]
    if described.has_bytes and kind == _BYTES:
        plain = pybase64.b64decode(plain)
    return described.dumps(plain)


def to_value(name: str, value: Any, descriptor: Mapping[str, Any]) -> dict[str, Any]:
    """The ParameterValue of a JSON value, with the type that the node has declared.

    A parameter of dynamic type, or one that is not declared, takes its type from the value.
    Raises CallError: bad_request, rejected for what is read-only.
    """
    if descriptor.get("read_only"):
        raise CallError("rejected", f"{name} is read-only")
    kind = descriptor.get("type", _NOT_SET)
    if kind == _NOT_SET or descriptor.get("dynamic_typing") or kind >= len(_FIELDS):
        kind = _type_of(name, value)
    field_name, expected = _FIELDS[kind]
    if kind == _BYTES:
        value = to_bytes(name, value)
    elif kind in (_BOOLS, _INTEGERS, _DOUBLES, _STRINGS):
        if not isinstance(value, list) or not all(_is(kind - 5, item) for item in value):
            raise unlike(name, expected, value)
        value = [float(item) for item in value] if kind == _DOUBLES else value
    elif not _is(kind, value):
        raise unlike(name, expected, value)
    elif kind == _DOUBLE:
        value = float(value)
    return {"type": kind, field_name: value}


def _is(kind: int, value: Any) -> bool:
    """Whether a JSON value is accepted for a parameter of that type, which is no array."""
    if kind in (_BOOL, _STRING):
        return isinstance(value, bool if kind == _BOOL else str)
    if isinstance(value, bool):
        return False
    if kind == _INTEGER:
        return isinstance(value, int) and -(2**63) <= value < 2**63
    return isinstance(value, (int, float))


def _type_of(name: str, value: Any) -> int:
    for kind in (_BOOL, _INTEGER, _DOUBLE, _STRING):
        if _is(kind, value):
            return kind
        if isinstance(value, list) and value and all(_is(kind, item) for item in value):
            return kind + 5
    raise CallError("bad_request", f"{name}: no parameter can have the value {shorten(value)}")
