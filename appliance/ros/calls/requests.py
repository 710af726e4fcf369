"""Requests to ROS services, and the wait for their answers.

A client of a service is made when it is first asked for, or kept ready for those that a route
names; it is discovered by the server within some 0.1 s, and until then a request waits. What the
bus does not tell is found out by looking: a server that has gone leaves its clients not ready.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial

from appliance.ros.calls.dispatcher import CallError, ErrorCode
from appliance.ros.node import BusError, RosClient, RosNode
from appliance.ros.payload.definitions import UnknownTypeError

#: Looks (some 0.15 s each) that a client is kept for which nobody asks: a minute.
IDLE_LOOKS = 400

#: Name and type of a service.
Key = tuple[str, str]


@dataclass(eq=False, slots=True)
class _PendingCall:
    """A request under way; `cdr` is None once it was sent, or given up: a request may be empty."""

    cdr: bytes | None
    answer: asyncio.Future[bytes]
    give_up: Callable[[], None] | None = None


@dataclass(eq=False, slots=True)
class _ServiceClient:
    """A service on the bus as it is seen from here; for the ROS thread."""

    client: RosClient
    was_ready: bool = False
    waiting: list[_PendingCall] = field(default_factory=list)
    sent: set[_PendingCall] = field(default_factory=set)
    idle: int = 0


class Requests:
    """Asks services. `ask`, `keep_ready` and `services` are for the loop's thread, `look` and
    `lost` for the ROS thread."""

    def __init__(
        self,
        node: RosNode,
        loop: asyncio.AbstractEventLoop,
        post: Callable[..., None],
        changed: Callable[[], None],
    ) -> None:
        """`post` calls on the loop's thread; `changed` is called there when services have come or
        gone."""
        #: The types of each service, as of the last look at the graph.
        self.services: dict[str, list[str]] = {}
        self._node = node
        self._loop = loop
        self._post = post
        self._changed = changed
        self._pinned: frozenset[Key] = frozenset()
        # The ROS thread's.
        self._seen: dict[str, list[str]] = {}
        self._remotes: dict[Key, _ServiceClient] = {}
        #: What could not be made a client of, and why; it is tried anew when the graph changes.
        self._unusable: dict[Key, tuple[ErrorCode, str]] = {}

    async def ask(self, service: str, type_name: str, request: bytes) -> bytes:
        """The serialized response to a serialized request; cancel it to give up.

        Raises CallError: unavailable, vanished, unknown_type, ros_error.
        """
        waiting = _PendingCall(request, self._loop.create_future())
        key = service, type_name
        try:
            self._node.call_soon(partial(self._begin, key, waiting))
        except BusError as error:
            raise CallError("ros_error", str(error)) from None
        try:
            return await waiting.answer
        finally:
            waiting.cdr = None
            if waiting.answer.cancelled():
                self._soon(partial(self._give_up, key, waiting))

    def problem(self, service: str, type_name: str) -> str | None:
        """Why a service that is there cannot be asked; from any thread."""
        problem = self._unusable.get((service, type_name))
        return problem[1] if problem else None

    def keep_ready(self, services: Iterable[Key]) -> None:
        """Have a client ready for each of these while they are on the bus."""
        self._pinned = frozenset(services)

    def _soon(self, callback: Callable[[], None]) -> None:
        try:
            self._node.call_soon(callback)
        except BusError:
            return  # `lost` has told, or will tell, all that wait

    def _settle(self, answer: asyncio.Future[bytes], result: bytes | CallError) -> None:
        if answer.done():
            return
        if isinstance(result, CallError):
            answer.set_exception(result)
        else:
            answer.set_result(result)

    # The ROS thread

    @property
    def has_clients(self) -> bool:
        """Whether there is a client of a service: something may be under way, or it is idle yet."""
        return bool(self._remotes)

    def look(self) -> None:
        """Follow the graph, send what has waited for its server, tell who waits in vain."""
        services = self._node.services()
        if services != self._seen:
            self._seen = services
            self._unusable.clear()
            self._post(self._take_services, services)
        for key in self._pinned:
            if key not in self._remotes and self._is_seen(key):
                self._remote(key)
        for key, remote in list(self._remotes.items()):
            self._follow(key, remote)

    def _take_services(self, services: dict[str, list[str]]) -> None:
        self.services = services
        self._changed()

    def _follow(self, key: Key, remote: _ServiceClient) -> None:
        is_ready = remote.client.is_ready()
        if remote.was_ready and not is_ready:
            text = f"{key[0]} went away before it answered"
            for request in remote.sent:
                self._fail(request, "vanished", text)
            remote.sent.clear()
        remote.was_ready = is_ready
        if is_ready:
            for request in remote.waiting:
                self._send(remote, request)
            remote.waiting.clear()
        elif remote.waiting and not self._is_seen(key):
            for request in remote.waiting:
                self._fail(request, *self._unavailable(key))
            remote.waiting.clear()
        remote.idle = 0 if remote.waiting or remote.sent else remote.idle + 1
        if remote.idle > IDLE_LOOKS and key not in self._pinned:
            remote.client.destroy()
            del self._remotes[key]

    def _is_seen(self, key: Key) -> bool:
        service, type_name = key
        return type_name in self._seen.get(service, ())

    def _unavailable(self, key: Key) -> tuple[ErrorCode, str]:
        service, type_name = key
        others = self._seen.get(service)
        if others:
            text = f"{service} is a {', '.join(others)} on the bus, not a {type_name}"
            return "unavailable", text
        return "unavailable", f"there is no {service} on the bus"

    def _remote(self, key: Key) -> _ServiceClient | None:
        remote = self._remotes.get(key)
        if remote is None and key not in self._unusable:
            try:
                remote = self._remotes[key] = _ServiceClient(self._node.create_client(*key))
            except UnknownTypeError as error:
                self._unusable[key] = "unknown_type", str(error)
            except BusError as error:
                self._unusable[key] = "ros_error", f"{key[0]}: {error}"
        return remote

    def _begin(self, key: Key, request: _PendingCall) -> None:
        if request.cdr is None:
            return
        if key not in self._remotes and not self._is_seen(key):
            self._fail(request, *self._unavailable(key))
            return
        remote = self._remote(key)
        if remote is None:
            self._fail(request, *self._unusable[key])
        elif remote.client.is_ready():
            remote.was_ready = True
            self._send(remote, request)
        elif self._is_seen(key):
            remote.waiting.append(request)  # they have not found each other yet
        else:
            self._fail(request, *self._unavailable(key))

    def _send(self, remote: _ServiceClient, request: _PendingCall) -> None:
        cdr, request.cdr = request.cdr, None
        if cdr is None:
            return

        def done(response: bytes | BusError) -> None:
            remote.sent.discard(request)
            if isinstance(response, BusError):
                self._fail(request, "ros_error", str(response))
            else:
                self._post(self._settle, request.answer, response)

        remote.sent.add(request)
        try:
            request.give_up = remote.client.call(cdr, done)
        except BusError as error:
            remote.sent.discard(request)
            self._fail(request, "ros_error", str(error))

    def _give_up(self, key: Key, request: _PendingCall) -> None:
        remote = self._remotes.get(key)
        if remote is None:
            return
        if request in remote.waiting:
            remote.waiting.remove(request)
        if request in remote.sent and request.give_up is not None:
            remote.sent.discard(request)
            request.give_up()

    def _fail(self, request: _PendingCall, code: ErrorCode, text: str) -> None:
        self._post(self._settle, request.answer, CallError(code, text))

    def lost(self) -> None:
        """The bus is gone, and with it all clients."""
        for remote in self._remotes.values():
            for request in (*remote.waiting, *remote.sent):
                self._fail(request, "ros_error", "the connection to ROS ended")
        self._remotes.clear()
        self._seen = {}
        self._post(self._take_services, {})
