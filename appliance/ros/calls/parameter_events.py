"""The ROS thread's side of nodes' parameters: `/parameter_events`, and restarted nodes."""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable
from typing import Protocol

from appliance.ros.node import BusError, QosProfile, RosNode, RosSubscription
from appliance.ros.payload.definitions import UnknownTypeError

log = logging.getLogger(__name__)

EVENTS = "/parameter_events"
EVENT = "rcl_interfaces/msg/ParameterEvent"

#: Events that wait for the loop's thread; with more, all nodes are read anew.
MAX_EVENTS = 1000


class EventListener(Protocol):
    """Receives what concerns parameters, on the loop's thread."""

    def take_events(self) -> None:
        """There are events in the queue."""

    def nodes_restarted(self, names: list[str]) -> None:
        """Another node of each of these names has appeared."""


class EventQueue:
    """Serialized events on their way from the ROS thread, which puts, to the loop's, which takes.

    A full queue has lost events.
    """

    def __init__(self, wake: Callable[[], None]) -> None:
        """`wake` is called on the ROS thread when there is something to take and it has not been
        called since the last `sleep`."""
        self._wake = wake
        self._events: deque[bytes] = deque()
        self._is_awake = False

    def __len__(self) -> int:
        return len(self._events)

    def put(self, event: bytes) -> None:
        """Queue an event; a full queue drops it."""
        if len(self._events) < MAX_EVENTS:
            self._events.append(event)
        if not self._is_awake:
            self._is_awake = True
            self._wake()

    def sleep(self) -> None:
        """Let the next event wake the loop's thread again."""
        self._is_awake = False

    def take(self) -> bytes:
        """Remove and return the oldest event."""
        return self._events.popleft()

    def clear_if_full(self) -> bool:
        """Drop all events when some were lost; whether that is so."""
        is_full = len(self._events) >= MAX_EVENTS
        if is_full:
            self._events.clear()
        return is_full


class ParameterEvents:
    """Follows the parameters of all nodes. `enable` is for the loop's thread, all else for the ROS
    thread."""

    def __init__(self, node: RosNode, listener: EventListener, post: Callable[..., None]) -> None:
        """`post` calls on the loop's thread."""
        self.queue = EventQueue(lambda: post(listener.take_events, failed=self.queue.sleep))
        self._node = node
        self._listener = listener
        self._post = post
        #: Replaced by the loop's thread.
        self._is_enabled = False
        self._subscription: RosSubscription | None = None
        self._is_refused = False
        #: How many nodes there are of each name.
        self._nodes: Counter[str] = Counter()

    def enable(self, is_enabled: bool) -> None:
        """Follow parameters, or follow them no longer."""
        self._is_enabled = is_enabled

    def poll_graph(self) -> None:
        """Subscribe to the changes of all nodes' parameters, and look for restarted nodes."""
        is_enabled = self._is_enabled
        if is_enabled and self._subscription is None and not self._is_refused:
            try:
                self._subscription = self._node.subscribe_raw(
                    EVENTS, EVENT, QosProfile(depth=1000), self.queue.put
                )
            except (BusError, UnknownTypeError) as error:
                self._is_refused = True
                self._post(log.error, "%s is not followed: %s", EVENTS, error)
        elif not is_enabled and self._subscription is not None:
            self._subscription.destroy()
            self._subscription = None
        if is_enabled:
            self._find_restarts()

    def _find_restarts(self) -> None:
        """Report nodes that are there twice: one that was killed stays on the graph for a while,
        beside the one that takes its place and has values of its own."""
        before, self._nodes = self._nodes, Counter(self._node.nodes())
        names = [name for name, count in self._nodes.items() if count > before.get(name, count)]
        if names:
            self._post(self._listener.nodes_restarted, names)

    def on_bus_lost(self) -> None:
        """The node has ended, and its subscription with it."""
        self._subscription = None
        self._is_refused = False
        self._nodes.clear()
