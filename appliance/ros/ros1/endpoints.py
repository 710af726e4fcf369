"""The endpoints of a node on ROS 1: subscriptions, publishers, clients and services of serialized
messages.

They get rospy as an argument: only node.py imports it.
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cache, partial
from io import BytesIO
from typing import Any, Protocol

from appliance.ros.node import BusError, Durability, QosProfile, Respond
from appliance.ros.ros1.peers import ServiceCall
from appliance.ros.ros1.types import Definition, ServiceDefinition

#: Messages of a latched publisher that a subscription holds until the graph shows it as latched.
MAX_HELD = 10


class LatchTracker(Protocol):
    """Tracks which publishers are latched, from the headers of their connections."""

    def track_latching(self, topic: str, node: str, is_latched: bool) -> bool:
        """Note whether a publisher is latched. Returns whether that has changed."""

    def release_later(self, subscription: Ros1Subscription) -> None:
        """Call `release` of the subscription after the next refresh of the graph."""

    def cancel_release(self, subscription: Ros1Subscription) -> None:
        """Do not call it: the subscription holds no messages."""


class ClientNode(Protocol):
    """The part of the node that its clients use."""

    name: str

    @property
    def master_uri(self) -> str:
        """The URI of the Master."""

    def call_soon(self, callback: Callable[[], None]) -> None:
        """Call it on the ROS thread."""

    def is_served(self, service: str) -> bool:
        """Whether a service is on the graph."""

    def call_failed(self, service: str) -> None:
        """A call of the service has failed: its type may have changed."""


@cache
def message_class(rospy: Any, definition: Definition) -> Any:
    """A class that rospy accepts as a message class, whose messages have their bytes only."""
    attributes = {
        "__slots__": [],
        "_type": definition.name,
        "_md5sum": definition.md5sum,
        "_full_text": definition.text,
    }
    return type("Raw", (rospy.AnyMsg,), attributes)


@cache
def _service_class(rospy: Any, definition: ServiceDefinition) -> Any:
    attributes = {
        "_type": definition.name,
        "_md5sum": definition.md5sum,
        "_request_class": message_class(rospy, definition.request),
        "_response_class": message_class(rospy, definition.response),
    }
    return type("RawService", (), attributes)


def forget_classes() -> None:
    """Clear the caches of classes: these keep a rospy that has ended, which is 1 MB, in memory."""
    message_class.cache_clear()
    _service_class.cache_clear()


def _new_message(kind: Any, data: bytes) -> Any:
    message = kind()
    message._buff = data
    return message


def _serialized(message: Any) -> bytes:
    buffer = BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


class Ros1Subscription:
    """A RosSubscription.

    Messages of latched publishers are retained on MQTT. Whether a publisher is latched is known
    only once a message of it has arrived. Its first messages are held until the graph has been
    refreshed: most often the subscription is then replaced by one for latched publishers, and the
    message arrives once more.
    """

    def __init__(
        self,
        rospy: Any,
        latches: LatchTracker,
        topic: str,
        definition: Definition,
        is_latched: bool,
        callback: Callable[..., None],
    ) -> None:
        self._latches = latches
        self._topic = topic
        self._is_latched = is_latched
        self._callback = callback
        self._lock = threading.Lock()
        self._is_over = False
        self._held: deque[bytes] = deque(maxlen=MAX_HELD)
        self._raw = rospy.AnyMsg
        kind = message_class(rospy, definition)
        self._own = rospy.Subscriber(topic, kind, self._on_message, tcp_nodelay=True)
        found = self._own.impl.data_class
        # With simulated time, rospy itself subscribes to /clock with a class of its own.
        is_own = not issubclass(found, rospy.AnyMsg) and found._md5sum == kind._md5sum
        if found is not kind and not is_own:
            other = self._own.impl.type
            self.destroy()
            raise BusError(f"another route receives {topic} as {other}")

    def _on_message(self, message: Any) -> None:
        header: Mapping[str, str] = message._connection_header
        is_latched = header.get("latching") == "1"
        data = message._buff if isinstance(message, self._raw) else _serialized(message)
        with self._lock:
            if self._is_over:
                return
            has_changed = self._latches.track_latching(
                self._topic, header.get("callerid", ""), is_latched
            )
            if is_latched and not self._is_latched and (has_changed or self._held):
                self._held.append(data)
                self._latches.release_later(self)
            else:
                self._callback(data)

    def release(self) -> None:
        """Deliver the held messages. Not all publishers are latched, so that this subscription was
        not replaced."""
        self._latches.cancel_release(self)
        with self._lock:
            while self._held and not self._is_over:
                self._callback(self._held.popleft())

    def take_lost(self) -> int:
        return 0  # TCP loses no messages, and rospy does not count those that its queues drop

    def destroy(self) -> None:
        with self._lock:
            self._is_over = True
        self._latches.cancel_release(self)
        self._own.unregister()


class Ros1Publisher:
    """A RosPublisher."""

    def __init__(self, rospy: Any, topic: str, definition: Definition, qos: QosProfile) -> None:
        self._class = kind = message_class(rospy, definition)
        self._refusals = (rospy.ROSException, rospy.ROSSerializationException, OSError)
        self._own = rospy.Publisher(
            topic,
            kind,
            latch=qos.durability is Durability.TRANSIENT_LOCAL,
            tcp_nodelay=True,
            # When a subscriber does not read, drop its oldest messages; do not block the others.
            queue_size=qos.depth,
        )
        if self._own.impl.data_class is not kind:
            other = self._own.impl.type
            self._own.unregister()
            raise BusError(f"another route publishes {topic} as {other}")

    def publish(self, cdr: bytes) -> None:
        try:
            self._own.publish(_new_message(self._class, cdr))
        except self._refusals as error:
            raise BusError(str(error)) from error

    @property
    def has_subscribers(self) -> bool:
        impl = self._own.impl  # rospy's, which is None once the publisher is unregistered
        return impl is not None and impl.has_connections()

    def reaches(self, nodes: Iterable[str]) -> bool:
        """Whether one of these nodes is connected."""
        return any(map(self._own.impl.has_connection, nodes))

    def destroy(self) -> None:
        self._own.unregister()


class Ros1Client:
    """A RosClient. Each call has a connection and a thread of its own."""

    def __init__(self, node: ClientNode, service: str, definition: ServiceDefinition) -> None:
        self._node = node
        self._service = service
        self._definition = definition
        self._calls: set[ServiceCall] = set()

    def is_ready(self) -> bool:
        return self._node.is_served(self._service)

    def call(self, request: bytes, done: Callable[[bytes | BusError], None]) -> Callable[[], None]:
        node = self._node

        def finish(result: bytes | BusError) -> None:
            if call in self._calls:
                self._calls.discard(call)
                if isinstance(result, BusError):
                    node.call_failed(self._service)
                done(result)

        def report(result: bytes | BusError) -> None:
            with suppress(BusError):
                node.call_soon(partial(finish, result))

        def give_up() -> None:
            self._calls.discard(call)
            call.give_up()

        call = ServiceCall(
            node.master_uri, node.name, self._service, self._definition, request, report
        )
        self._calls.add(call)
        return give_up

    def destroy(self) -> None:
        for call in self._calls:
            call.give_up()
        self._calls.clear()


class Ros1Service:
    """A RosService. rospy waits for each response on a thread of its own."""

    def __init__(
        self,
        rospy: Any,
        name: str,
        definition: ServiceDefinition,
        callback: Callable[[bytes, Respond], None],
        call_soon: Callable[[Callable[[], None]], None],
    ) -> None:
        self._error = rospy.ServiceException
        self._response_class = message_class(rospy, definition.response)
        self._callback = callback
        self._call_soon = call_soon
        self._pending: set[queue.SimpleQueue[bytes | None]] = set()
        try:
            self._own = rospy.Service(name, _service_class(rospy, definition), self._serve)
        except rospy.ServiceException as error:
            raise BusError(str(error)) from error

    def _serve(self, request: Any) -> Any:
        answer: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._pending.add(answer)
        try:
            self._call_soon(partial(self._dispatch, request._buff, answer.put))
            response = answer.get()
        except BusError as error:
            raise self._error(str(error)) from error
        finally:
            self._pending.discard(answer)
        if response is None:
            raise self._error("nobody on MQTT answered")
        return _new_message(self._response_class, response)

    def _dispatch(self, request: bytes, respond: Respond) -> None:
        try:
            self._callback(request, respond)
        except Exception:
            respond(None)  # or rospy's thread would wait forever
            raise

    def destroy(self) -> None:
        self._own.shutdown("its route has ended")
        for answer in list(self._pending):
            answer.put(None)
