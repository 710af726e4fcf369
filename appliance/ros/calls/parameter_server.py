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
import re
from collections.abc import Callable
from functools import partial
from time import monotonic
from typing import Any

import pybase64

from appliance.ros.calls.dispatcher import Call, CallDispatcher, CallError
from appliance.ros.calls.parameter_topics import ParameterGroup, ParameterTopics, shorten, to_bytes
from appliance.ros.node import BusError, ParameterServer, RosNode
from appliance.ros.patterns import is_plain
from appliance.ros.payload.encodings.registry import VALUE_ENCODINGS
from appliance.ros.skipped import Skipped

log = logging.getLogger(__name__)

#: Seconds between two looks at the parameters.
INTERVAL = 1.0

#: Lists in lists that a parameter may have.
DEEPEST = 16

_NOT_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]")


class ServerParameters(ParameterTopics[ParameterGroup]):
    """The routes of parameters; for the loop's thread, where it does not say otherwise.

    What stands for a node is a namespace: parameters that are beside each other.
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
        self._post = post
        self._changed = changed
        #: All parameters of the last look, by namespace, and the values of those that are wanted.
        self._names: dict[str, list[str]] = {}
        self._values: dict[str, Any] = {}
        #: Whether nothing is known of the parameters, so that none is absent either; and why not.
        self._is_blind = True
        self._problem: str | None = None
        # The ROS thread's.
        self._looked_at = 0.0

    def _look_again(self) -> None:
        self._looked_at = 0.0

    def follow(self) -> None:
        """Services have come or gone: no matter."""

    def _take(self, names: dict[str, list[str]], values: dict[str, Any]) -> None:
        """What there is now."""
        absent = self._absent()
        has_changed = self._is_blind or self._problem is not None
        self._names, self._values = names, values
        self._is_blind, self._problem = False, None
        has_changed |= self._absent() != absent
        found: dict[str, dict[str, Any]] = {}
        for full_name, value in values.items():
            space, _, name = full_name.rpartition("/")
            found.setdefault(space, {})[name] = value
        for shown in list(self._groups.values()):
            if shown.name not in found:
                self._leave(shown)
                has_changed = True
        for name, own in found.items():
            namespace = self._groups.get(name) or self._find(name, ParameterGroup)
            if namespace is None:  # the routes have changed meanwhile
                continue
            if name not in self._groups:
                self._join(namespace)
                log.info("the parameters of %s are at %s", name or "/", namespace.base)
                has_changed = True
            for parameter in namespace.shown.keys() - own.keys():
                self._show(namespace, parameter, None)
            for parameter, value in own.items():
                if namespace.wants(parameter):
                    self._show(namespace, parameter, value)
        if has_changed:
            self._changed()

    def _fail(self, problem: str) -> None:
        """They could not be read; what was read last stays."""
        if problem != self._problem:
            log.warning("the parameters cannot be read: %s", problem)
            self._is_blind, self._problem = False, problem
            self._changed()

    def _show(self, namespace: ParameterGroup, name: str, value: Any) -> None:
        """Publish a parameter as it is now; None for one that is no more."""
        encoding = VALUE_ENCODINGS[namespace.route.encoding]
        try:
            payload = (
                b""
                if value is None
                else encoding.dumps(value if encoding.has_bytes else _to_plain(value))
            )
        except TypeError:  # an integer too large for JSON
            log.debug("%s/%s cannot be shown", namespace.name, name)
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
            self._node.call_soon(partial(self._set_all, full_names, done))
        except BusError as error:
            raise CallError("ros_error", str(error)) from None
        await done
        return ""

    def skips(self) -> list[Skipped]:
        """The parameters that routes name and are not there."""
        if self._is_blind:
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
        """The bus has been left: no value is true any more."""
        self._forget()

    def _forget(self) -> None:
        self._names, self._values = {}, {}
        self._is_blind = True
        self._leave_all()

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
            self._post(self._fail, str(error))

    def _read(self, server: ParameterServer) -> None:
        names: dict[str, list[str]] = {}
        for full_name in server.names():
            space, _, name = full_name.rpartition("/")
            names.setdefault(space, []).append(name)
        for space in list(names):
            while space:
                space = space.rpartition("/")[0]
                names.setdefault(space, [])
        spaces = {space: self._find(space, ParameterGroup) for space in names}
        wanted = [
            f"{space}/{name}"
            for space, found in names.items()
            if (namespace := spaces[space]) is not None
            for name in found
            if namespace.wants(name)
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
        """The bus is gone, and nothing is known of its parameters."""
        self._looked_at = 0.0
        self._post(self._forget)


def _is_value(value: Any, depth: int = 0) -> bool:
    """Whether a parameter can have it: XML-RPC has no word for nothing, nor XML for all
    characters."""
    if isinstance(value, str):
        return _NOT_XML.search(value) is None
    if isinstance(value, list):
        return depth < DEEPEST and all(_is_value(item, depth + 1) for item in value)
    if isinstance(value, dict):
        return _is_value([*value.keys(), *value.values()], depth)
    if isinstance(value, int):
        return -(2**31) <= value < 2**31
    return isinstance(value, (float, bytes))


def _like(before: Any, name: str, value: Any) -> Any:
    """A value as its payload cannot say it: a double without a fraction, bytes in base64."""
    if isinstance(before, float) and type(value) is int:
        return float(value)
    if isinstance(before, bytes) and not isinstance(value, bytes):
        return to_bytes(name, value)
    return value


def _to_plain(value: Any) -> Any:
    """A value as JSON knows it: bytes are base64."""
    if isinstance(value, list):
        return [_to_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _to_plain(item) for key, item in value.items()}
    return pybase64.b64encode_as_string(value) if isinstance(value, bytes) else value


def _settle(done: asyncio.Future[None], problem: CallError | None) -> None:
    if done.done():
        return
    if problem is None:
        done.set_result(None)
    else:
        done.set_exception(problem)
