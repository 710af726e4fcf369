"""The ROS thread's side of a parameter server: reads the values once a second, and sets them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from time import monotonic
from typing import Any, Protocol

from appliance.ros.calls.dispatcher import CallError
from appliance.ros.calls.parameter_topics import ParameterSettings, matching_routes
from appliance.ros.node import BusError, ParameterServer, RosNode

#: Seconds between two reads of all parameters.
INTERVAL = 1.0


class ParameterListener(Protocol):
    """Receives what was read and done, on the loop's thread."""

    def parameters_read(self, names: dict[str, list[str]], values: dict[str, Any]) -> None:
        """There are these parameters, by namespace; `values` has those that the routes want."""

    def read_failed(self, problem: str) -> None:
        """The parameters could not be read."""

    def settle(self, done: asyncio.Future[None], problem: CallError | None) -> None:
        """Parameters were set, or could not be."""

    def bus_lost(self) -> None:
        """Nothing is known of the parameters any more."""


class ParameterReader:
    """Reads and sets parameters. `replace` is for the loop's thread, all else for the ROS
    thread."""

    def __init__(
        self, node: RosNode, listener: ParameterListener, post: Callable[..., None]
    ) -> None:
        """`post` calls on the loop's thread."""
        self._node = node
        self._listener = listener
        self._post = post
        #: Replaced as one by the loop's thread.
        self._routes: tuple[ParameterSettings, ...] = ()
        self._read_routes: tuple[ParameterSettings, ...] | None = None
        self._read_at = 0.0

    def replace(self, routes: tuple[ParameterSettings, ...]) -> None:
        """Read what these routes want, at the next poll and then once in each interval."""
        self._routes = routes

    def poll_graph(self) -> None:
        """Read the parameters when the interval is over or the routes have changed."""
        server, routes = self._node.parameter_server, self._routes
        now = monotonic()
        if server is None or not routes:
            return
        if routes is self._read_routes and now < self._read_at + INTERVAL:
            return
        self._read_routes, self._read_at = routes, now
        try:
            self._read(server, routes)
        except BusError as error:
            self._post(self._listener.read_failed, str(error))

    def _read(self, server: ParameterServer, routes: tuple[ParameterSettings, ...]) -> None:
        names: dict[str, list[str]] = {}
        for full_name in server.names():
            namespace, _, name = full_name.rpartition("/")
            names.setdefault(namespace, []).append(name)
        for namespace in list(names):
            while namespace:
                namespace = namespace.rpartition("/")[0]
                names.setdefault(namespace, [])
        wanted: list[str] = []
        for namespace, found in names.items():
            patterns = matching_routes(routes, namespace).values()
            wanted += [
                f"{namespace}/{name}"
                for name in found
                if any(name in pattern for pattern in patterns)
            ]
        self._post(self._listener.parameters_read, names, server.get(wanted))

    def set_all(self, values: Mapping[str, Any], done: asyncio.Future[None]) -> None:
        """Set parameters by their full names, and read all again; the listener settles `done`."""
        server = self._node.parameter_server
        problem: CallError | None = None
        try:
            if server is None:
                raise BusError("ROS is not ready")
            for name, value in values.items():
                server.set(name, value)
            self._read(server, self._routes)
        except BusError as error:
            problem = CallError("ros_error", str(error))
        self._post(self._listener.settle, done, problem)

    def on_bus_lost(self) -> None:
        """The node has ended: read again as soon as it is back."""
        self._read_routes = None
        self._post(self._listener.bus_lost)
