"""Parameters of a bus with one server for all of them, as ROS 1's Master is.

They are published and set like those of nodes (parameters.py): `/arm/speed` is retained at
`r2d2/arm/_param/speed`, `…/_param/speed/set` sets it, `…/_param/_set` sets several. The namespace
before the last `/` stands for the node; there need not be such a node. The values are read once a
second.

Parameters have no declared type, so they take the type of the value. An integer for a parameter
that is a double becomes a double, as JSON does not distinguish the two.
"""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import Callable
from functools import partial
from typing import Any

import pybase64

from appliance.ros.calls.dispatcher import Call, CallDispatcher, CallError
from appliance.ros.calls.parameter_reader import ParameterReader
from appliance.ros.calls.parameter_topics import ParameterGroup, ParameterTopics, shorten, to_bytes
from appliance.ros.node import BusError, RosNode
from appliance.ros.patterns import is_plain
from appliance.ros.payload.encodings.registry import VALUE_ENCODINGS
from appliance.ros.skipped import Skipped

log = logging.getLogger(__name__)

#: Levels of lists in lists that a parameter may have.
MAX_DEPTH = 16

_NOT_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]")


class ServerParameters(ParameterTopics[ParameterGroup]):
    """The routes of parameters; for the loop's thread, and `source` for the ROS thread.

    A group is a namespace: the parameters that differ in their last name only.
    """

    def __init__(
        self,
        dispatcher: CallDispatcher,
        node: RosNode,
        loop: asyncio.AbstractEventLoop,
        post: Callable[..., None],
        changed: Callable[[], None],
    ) -> None:
        """`changed` is called when what `bridged` gives has changed."""
        super().__init__(dispatcher)
        self._node = node
        self._loop = loop
        self._changed = changed
        self.source = ParameterReader(node, self, post)
        #: All parameters as last read, by namespace, and the values of those that are wanted.
        self._names: dict[str, list[str]] = {}
        self._values: dict[str, Any] = {}
        #: Whether the parameters have not been read yet, so that none can be called absent.
        self._is_unknown = True
        #: Why the last read has failed.
        self._problem: str | None = None

    def _routes_changed(self) -> None:
        self.source.replace(tuple(self._routes))

    def follow(self) -> None:
        """Ignore services that come and go: the values are polled."""

    def parameters_read(self, names: dict[str, list[str]], values: dict[str, Any]) -> None:
        """Publish the parameters as they are now."""
        absent = self._absent()
        has_changed = self._is_unknown or self._problem is not None
        self._names, self._values = names, values
        self._is_unknown, self._problem = False, None
        has_changed |= self._absent() != absent
        found: dict[str, dict[str, Any]] = {}
        for full_name, value in values.items():
            space, _, name = full_name.rpartition("/")
            found.setdefault(space, {})[name] = value
        for group in list(self._groups.values()):
            if group.name not in found:
                self._remove(group)
                has_changed = True
        for name, own in found.items():
            namespace = self._groups.get(name) or self._new_group(name, ParameterGroup)
            if namespace is None:  # the routes have changed meanwhile
                continue
            if name not in self._groups:
                self._add(namespace)
                log.info("the parameters of %s are at %s", name or "/", namespace.base)
                has_changed = True
            for parameter in namespace.retained.keys() - own.keys():
                self._publish_value(namespace, parameter, None)
            for parameter, value in own.items():
                if namespace.wants(parameter):
                    self._publish_value(namespace, parameter, value)
        if has_changed:
            self._changed()

    def read_failed(self, problem: str) -> None:
        """Report that the parameters could not be read; those that were read before stay."""
        if problem != self._problem:
            log.warning("the parameters cannot be read: %s", problem)
            self._is_unknown, self._problem = False, problem
            self._changed()

    def _publish_value(self, namespace: ParameterGroup, name: str, value: Any) -> None:
        """Publish a parameter as it is now; None clears it."""
        encoding = VALUE_ENCODINGS[namespace.route.encoding]
        try:
            payload = (
                b""
                if value is None
                else encoding.dumps(value if encoding.has_bytes else _to_plain(value))
            )
        except TypeError:  # an integer too large for JSON
            log.debug("%s/%s cannot be published", namespace.name, name)
            return
        self._publish(namespace, name, payload)

    async def _set(
        self, group: ParameterGroup, values: dict[str, Any], call: Call, at_once: bool
    ) -> str:
        full_names = {f"{group.name}/{name}": value for name, value in values.items()}
        for full_name, value in full_names.items():
            if isinstance(value, dict) or not _is_value(value):
                text = f"{full_name}: no parameter can have the value {shorten(value)}"
                if isinstance(value, int):
                    text += ": integers have 32 bits in ROS 1"
                raise CallError("bad_request", text)
            if full_name in self._names:
                text = f"{full_name} holds other parameters: set these"
                raise CallError("rejected", text)
            full_names[full_name] = _like(self._values.get(full_name), full_name, value)
        done: asyncio.Future[None] = self._loop.create_future()
        try:
            self._node.call_soon(partial(self.source.set_all, full_names, done))
        except BusError as error:
            raise CallError("ros_error", str(error)) from None
        await done
        return ""

    def skips(self) -> list[Skipped]:
        """The parameters that a route names and that are not there."""
        if self._is_unknown:
            return []
        if self._problem is not None:
            return [Skipped("/", "parameters", "", "problem", self._problem)]
        reason = "the Master has no such parameter"
        return [
            Skipped(name, "parameters", "", "absent", reason) for name in sorted(self._absent())
        ]

    def _absent(self) -> set[str]:
        named = {name for route in self._counters for name in route.names if is_plain(name)}
        return named - self._values.keys()

    async def stop(self) -> None:
        """Clear all values, once the bus has been left."""
        self.bus_lost()

    def bus_lost(self) -> None:
        """Clear all values: nothing is known of the parameters any more."""
        self._names, self._values = {}, {}
        self._is_unknown = True
        self._remove_all()

    def settle(self, done: asyncio.Future[None], problem: CallError | None) -> None:
        """Finish a call that sets parameters."""
        if done.done():
            return
        if problem is None:
            done.set_result(None)
        else:
            done.set_exception(problem)


def _is_value(value: Any, depth: int = 0) -> bool:
    """Whether a parameter can have the value: XML-RPC cannot express None, nor XML every
    character."""
    if isinstance(value, str):
        return _NOT_XML.search(value) is None
    if isinstance(value, list):
        return depth < MAX_DEPTH and all(_is_value(item, depth + 1) for item in value)
    if isinstance(value, dict):
        return _is_value([*value.keys(), *value.values()], depth)
    if isinstance(value, int):
        return -(2**31) <= value < 2**31
    return isinstance(value, (float, bytes))


def _like(before: Any, name: str, value: Any) -> Any:
    """The value with the type of the one before: a double without a fraction, bytes of base64."""
    if isinstance(before, float) and type(value) is int:
        return float(value)
    if isinstance(before, bytes) and not isinstance(value, bytes):
        return to_bytes(name, value)
    return value


def _to_plain(value: Any) -> Any:
    """A value that JSON can express: bytes become base64."""
    if isinstance(value, list):
        return [_to_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _to_plain(item) for key, item in value.items()}
    return pybase64.b64encode_as_string(value) if isinstance(value, bytes) else value
