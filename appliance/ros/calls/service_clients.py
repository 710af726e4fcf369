"""The ROS thread's side of requests: the clients of services, and the requests that they send.

A client is created when its service is first asked, or ahead for the services that a route names.
The server discovers it within some 0.1 s, and until then requests wait. The bus does not report a
server that goes away, so it is polled: its client is not ready any more.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

from appliance.ros.calls.dispatcher import CallError, ErrorCode
from appliance.ros.node import BusError, RosClient, RosNode
from appliance.ros.payload.definitions import UnknownTypeError

#: Polls (some 0.15 s each) after which a client is destroyed that nobody has used: a minute.
IDLE_POLLS = 400

#: Name and type of a service.
Key: TypeAlias = tuple[str, str]


@dataclass(eq=False, slots=True)
class ServiceRequest:
    """A request on its way from the loop's thread to a service.

    The loop's thread sets `is_abandoned` when nobody waits for the answer any more, and alone
    settles `answer`; all else is the ROS thread's from the moment it has the request. `cdr` is
    None once it was sent.
    """

    key: Key
    cdr: bytes | None
    answer: asyncio.Future[bytes]
    is_abandoned: bool = False
    give_up: Callable[[], None] | None = None


class RequestListener(Protocol):
    """Receives the outcome of requests and the state of the graph, on the loop's thread."""

    def services_changed(self, services: dict[str, list[str]]) -> None:
        """The bus has these services now, each with its types."""

    def problems_changed(self, problems: Mapping[Key, str]) -> None:
        """These services are on the bus and cannot be asked, and why."""

    def settle(self, request: ServiceRequest, result: bytes | CallError) -> None:
        """A request has its response, or has failed."""


@dataclass(eq=False, slots=True)
class _ServiceClient:
    """The client of one service, with the requests that wait for its server or for a response."""

    client: RosClient
    was_ready: bool = False
    waiting: list[ServiceRequest] = field(default_factory=list)
    sent: set[ServiceRequest] = field(default_factory=set)
    idle: int = 0


class ServiceClients:
    """Clients of services. `keep_ready` is for the loop's thread, all else for the ROS thread."""

    def __init__(self, node: RosNode, listener: RequestListener, post: Callable[..., None]) -> None:
        """`post` calls on the loop's thread."""
        self._node = node
        self._listener = listener
        self._post = post
        #: Replaced as one by the loop's thread.
        self._pinned: frozenset[Key] = frozenset()
        self._services: dict[str, list[str]] = {}
        self._clients: dict[Key, _ServiceClient] = {}
        #: Services that no client could be created for, and why; tried anew when the graph changes.
        self._unusable: dict[Key, tuple[ErrorCode, str]] = {}
        self._reported: dict[Key, str] = {}

    def keep_ready(self, services: Iterable[Key]) -> None:
        """Have a client ready for each of these while they are on the bus."""
        self._pinned = frozenset(services)

    @property
    def has_clients(self) -> bool:
        """Whether there is a client, which may have requests under way or be idle."""
        return bool(self._clients)

    def poll_graph(self) -> None:
        """Follow the graph, send requests whose server is ready now, fail those without one."""
        services = self._node.services()
        if services != self._services:
            self._services = services
            self._unusable.clear()
            self._post(self._listener.services_changed, services)
        for key in self._pinned:
            if key not in self._clients and self._is_available(key):
                self._client(key)
        for key, client in list(self._clients.items()):
            self._follow(key, client)
        self._report_problems()

    def _follow(self, key: Key, client: _ServiceClient) -> None:
        is_ready = client.client.is_ready()
        if client.was_ready and not is_ready:
            text = f"{key[0]} went away before it answered"
            for request in client.sent:
                self._fail(request, "vanished", text)
            client.sent.clear()
        client.was_ready = is_ready
        if is_ready:
            while client.waiting:  # one whose sending raises is not sent again by the next poll
                self._send(client, client.waiting.pop(0))
        elif client.waiting and not self._is_available(key):
            for request in client.waiting:
                self._fail(request, *self._unavailable(key))
            client.waiting.clear()
        client.idle = 0 if client.waiting or client.sent else client.idle + 1
        if client.idle > IDLE_POLLS and key not in self._pinned:
            client.client.destroy()
            del self._clients[key]

    def _is_available(self, key: Key) -> bool:
        service, type_name = key
        return type_name in self._services.get(service, ())

    def _unavailable(self, key: Key) -> tuple[ErrorCode, str]:
        service, type_name = key
        others = self._services.get(service)
        if others:
            text = f"{service} is a {', '.join(others)} on the bus, not a {type_name}"
            return "unavailable", text
        return "unavailable", f"there is no {service} on the bus"

    def _client(self, key: Key) -> _ServiceClient | None:
        """The service's client, created if need be; None when it is unusable."""
        client = self._clients.get(key)
        if client is None and key not in self._unusable:
            try:
                client = self._clients[key] = _ServiceClient(self._node.create_client(*key))
            except UnknownTypeError as error:
                self._unusable[key] = "unknown_type", str(error)
            except BusError as error:
                self._unusable[key] = "ros_error", f"{key[0]}: {error}"
        return client

    def _report_problems(self) -> None:
        problems = {key: text for key, (_, text) in self._unusable.items()}
        if problems != self._reported:
            self._reported = problems
            self._post(self._listener.problems_changed, problems)

    def begin(self, request: ServiceRequest) -> None:
        """Send a request, as soon as its server is ready."""
        key = request.key
        if request.is_abandoned:
            return
        if key not in self._clients and not self._is_available(key):
            self._fail(request, *self._unavailable(key))
            return
        client = self._client(key)
        if client is None:
            self._fail(request, *self._unusable[key])
            self._report_problems()
        elif client.client.is_ready():
            client.was_ready = True
            self._send(client, request)
        elif self._is_available(key):
            client.waiting.append(request)  # client and server have not discovered each other yet
        else:
            self._fail(request, *self._unavailable(key))

    def _send(self, client: _ServiceClient, request: ServiceRequest) -> None:
        cdr, request.cdr = request.cdr, None  # it may be large, and is needed no more
        if cdr is None or request.is_abandoned:
            return

        def done(response: bytes | BusError) -> None:
            client.sent.discard(request)
            if isinstance(response, BusError):
                self._fail(request, "ros_error", str(response))
            else:
                self._post(self._listener.settle, request, response)

        client.sent.add(request)
        try:
            request.give_up = client.client.call(cdr, done)
        except BusError as error:
            client.sent.discard(request)
            self._fail(request, "ros_error", str(error))

    def give_up(self, request: ServiceRequest) -> None:
        """Forget a request that was abandoned."""
        client = self._clients.get(request.key)
        if client is None:
            return
        if request in client.waiting:
            client.waiting.remove(request)
        if request in client.sent and request.give_up is not None:
            client.sent.discard(request)
            request.give_up()

    def _fail(self, request: ServiceRequest, code: ErrorCode, text: str) -> None:
        self._post(self._listener.settle, request, CallError(code, text))

    def on_bus_lost(self) -> None:
        """The node has ended, and all clients with it."""
        for client in self._clients.values():
            for request in (*client.waiting, *client.sent):
                self._fail(request, "ros_error", "the connection to ROS ended")
        self._clients.clear()
        self._services = {}
        self._post(self._listener.services_changed, {})
