"""The ROS thread's side of services that MQTT clients answer: ROS nodes call them here."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Protocol

from appliance.ros.calls.serialization import from_ros
from appliance.ros.node import BusError, Respond, RosNode, RosService
from appliance.ros.payload.converter import ConversionError, Converters
from appliance.ros.payload.definitions import UnknownTypeError
from appliance.ros.payload.encodings.base import EncodingName


class RequestHandler(Protocol):
    """Answers the requests of ROS nodes, on the loop's thread; `respond` is for the ROS thread."""

    def created(self) -> None:
        """ROS nodes can call the service now."""

    def refused(self, problem: str) -> None:
        """The service could not be created."""

    def requested(self, payload: bytes, respond: Respond) -> None:
        """A ROS node has called."""

    def fail(self, respond: Respond, problem: str) -> None:
        """A ROS node has called, and the request cannot be handled."""


class ServiceServer:
    """A service of this node. `retire` is for the loop's thread, all else for the ROS thread."""

    def __init__(
        self,
        ros: str,
        type_name: str,
        encoding: EncodingName,
        node: RosNode,
        converters: Converters,
        handler: RequestHandler,
        post: Callable[..., None],
    ) -> None:
        """`post` calls on the loop's thread."""
        self._ros = ros
        self._type = type_name
        self._encoding = encoding
        self._node = node
        self._converters = converters
        self._handler = handler
        self._post = post
        self._service: RosService | None = None
        self._is_tried = False
        #: Set by the loop's thread, and never unset.
        self._is_retired = False

    def retire(self) -> None:
        """Never create the service from now on; `close` destroys it where it exists.

        A node that joins meanwhile polls before this is removed from the polled ones.
        """
        self._is_retired = True

    def poll_graph(self) -> None:
        """Create the service as soon as there is a bus."""
        if self._is_retired or self._is_tried:
            return
        self._is_tried = True
        try:
            self._service = self._node.create_service(self._ros, self._type, self._on_request)
        except (BusError, UnknownTypeError) as error:
            self._post(self._handler.refused, str(error))
        else:
            self._post(self._handler.created)

    def _on_request(self, cdr: bytes, respond: Respond) -> None:
        try:
            payload = from_ros(self._converters, f"{self._type}_Request", cdr, self._encoding)
        except (ConversionError, UnknownTypeError) as error:
            self._post(self._handler.fail, respond, f"a request cannot be converted: {error}")
            return
        self._post(self._handler.requested, payload, respond)

    def close(self) -> None:
        """Destroy the service, which was retired before."""
        if self._service is not None:
            self._service.destroy()
            self._service = None

    def on_bus_lost(self) -> None:
        """The node has ended, and the service with it."""
        self._service = None
        self._is_tried = False


class ServiceServers:
    """All services of this node. `replace` is for the loop's thread, all else for the ROS
    thread."""

    def __init__(self) -> None:
        self._servers: tuple[ServiceServer, ...] = ()

    def replace(self, servers: Iterable[ServiceServer]) -> None:
        """Poll these from now on."""
        self._servers = tuple(servers)

    def poll_graph(self) -> None:
        """Create the services that are not there yet."""
        for server in self._servers:
            server.poll_graph()

    def on_bus_lost(self) -> None:
        """The node has ended, and all services with it."""
        for server in self._servers:
            server.on_bus_lost()
