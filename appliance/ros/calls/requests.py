"""Requests to ROS services and the await of their responses, on the loop's thread.

The clients that send them belong to the ROS thread, see service_clients.py.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterable, Mapping
from functools import partial

from appliance.ros.calls.dispatcher import CallError
from appliance.ros.calls.service_clients import Key, ServiceClients, ServiceRequest
from appliance.ros.node import BusError, RosNode


class Requests:
    """Asks services; for the loop's thread, and `clients` for the ROS thread."""

    def __init__(
        self,
        node: RosNode,
        loop: asyncio.AbstractEventLoop,
        post: Callable[..., None],
        changed: Callable[[], None],
    ) -> None:
        """`post` calls on the loop's thread; `changed` is called there when services have come or
        gone, or can or cannot be asked."""
        #: The types of each service on the bus, as of the last poll of the graph.
        self.services: dict[str, list[str]] = {}
        self.clients = ServiceClients(node, self, post)
        self._node = node
        self._loop = loop
        self._changed = changed
        self._problems: Mapping[Key, str] = {}

    async def ask(self, service: str, type_name: str, request: bytes) -> bytes:
        """The serialized response to a serialized request; cancel it to give up.

        Raises CallError: unavailable, vanished, unknown_type, ros_error.
        """
        pending = ServiceRequest((service, type_name), request, self._loop.create_future())
        try:
            self._node.call_soon(partial(self.clients.begin, pending))
        except BusError as error:
            raise CallError("ros_error", str(error)) from None
        try:
            return await pending.answer
        finally:
            pending.is_abandoned = True
            if pending.answer.cancelled():
                # Without a node, `on_bus_lost` fails all requests.
                with contextlib.suppress(BusError):
                    self._node.call_soon(partial(self.clients.give_up, pending))

    def keep_ready(self, services: Iterable[Key]) -> None:
        """Have a client ready for each of these while they are on the bus."""
        self.clients.keep_ready(services)

    def problem(self, service: str, type_name: str) -> str | None:
        """Why a service that is on the bus cannot be asked."""
        return self._problems.get((service, type_name))

    def services_changed(self, services: dict[str, list[str]]) -> None:
        """The bus has these services now, each with its types."""
        self.services = services
        self._changed()

    def problems_changed(self, problems: Mapping[Key, str]) -> None:
        """These services are on the bus and cannot be asked, and why."""
        self._problems = problems
        self._changed()

    def settle(self, request: ServiceRequest, result: bytes | CallError) -> None:
        """A request has its response, or has failed."""
        if request.answer.done():
            return
        if isinstance(result, CallError):
            request.answer.set_exception(result)
        else:
            request.answer.set_result(result)
