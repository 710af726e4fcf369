"""The node on ROS 2: the only module that imports rclpy, and only when the node starts."""

from __future__ import annotations

import functools
import gc
import logging
import os
import re
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any

from appliance.net.callbacks import Entries
from appliance.ros.fault_containment import FaultContainment
from appliance.ros.node import (
    BusError,
    Durability,
    Endpoint,
    ParameterServer,
    QosProfile,
    Reliability,
    Respond,
    RosSubscription,
    TakeBatch,
)
from appliance.ros.payload import uncompiled
from appliance.ros.payload.definitions import (
    CDR,
    TypeDescription,
    UnknownTypeError,
    describe,
    import_message,
)
from appliance.ros.qos import CALLS
from appliance.ros.remapping import OF_ACTION, remapped_names, with_own_names
from appliance.ros.ros2 import fastdds, installation
from appliance.ros.ros2.loop_subscription import (
    FIRST_TIMED,
    ONE_TIMED_OF,
    LoopSubscription,
    UnavailableError,
    published_at,
)
from appliance.ros.ros2.network_scope import NetworkScope, find_scope, refresh_fast_dds

log = logging.getLogger(__name__)

#: Seconds between two polls of the graph: rclpy does not notify of changes.
POLL_INTERVAL = 0.15

#: With a thousand topics a poll takes 80 ms: then it is rarer, so that it takes no third of a core.
#: Still a topic is noticed within a second.
LONGEST_INTERVAL = 0.5
REST = 6  # times as long as the last poll took

#: Seconds between two checks for new networks.
NETWORK_INTERVAL = 2.0

#: The names of topics and services that ROS accepts, and their greatest length. DDS may have
#: others, but a query to ROS for one of these raises an error.
_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+\Z")
_LONGEST_NAME = 247

#: The highest domain with ports of its own on DDS.
HIGHEST_DOMAIN = 232


def available() -> tuple[bool, str]:
    """Whether a node can be started here; if not, one line that says why and what to do.

    Imports nothing of ROS. A middleware that is configured but not installed is detected here,
    because rcl would end the whole process over it.
    """
    found = installation.find()
    if found.source == "none" or (found.advice and os.environ.get(installation.CHOICE) == "system"):
        return False, found.advice
    wanted = os.environ.get("RMW_IMPLEMENTATION")
    installed = sorted(set(_resources("rmw_typesupport")) - {"rmw_implementation"})
    if wanted and installed and wanted not in installed:
        return False, (
            f"RMW_IMPLEMENTATION is {wanted}, which is not installed here; there is "
            f"{', '.join(installed)}. Install it, or unset RMW_IMPLEMENTATION"
        )
    return True, ""


def _wrong_domain() -> str:
    """The error text for a wrong ROS_DOMAIN_ID, over which Fast DDS would end the whole process;
    empty when it is valid."""
    domain = os.environ.get("ROS_DOMAIN_ID", "").strip()
    if not domain or (domain.isdecimal() and int(domain) <= HIGHEST_DOMAIN):
        return ""
    return f"ROS_DOMAIN_ID is {domain}: a domain is a number from 0 to {HIGHEST_DOMAIN}"


def _resources(kind: str) -> Iterator[str]:
    """The names of a kind of resource in the ament index; that of the wheels is in the venv."""
    for folder in fastdds.shares():
        index = folder / "ament_index" / "resource_index" / kind
        if index.is_dir():
            yield from (entry.name for entry in index.iterdir())


def interval_after(duration: float) -> float:
    """Seconds until the next poll of the graph, when the last one took so many."""
    return min(max(POLL_INTERVAL, REST * duration), LONGEST_INTERVAL)


class Ros2Node(FaultContainment):
    """A RosNode on ROS 2, with raw subscriptions and, where rclpy has it, the EventsExecutor."""

    serialization = CDR
    parameter_server: ParameterServer | None = None
    obstacle: str | None = None

    def __init__(
        self,
        name: str = "appliance",
        namespace: str = "/",
        domain_id: int | None = None,
        arguments: Sequence[str] = (),
        use_sim_time: bool = False,
    ) -> None:
        """With `domain_id` None the domain is ROS_DOMAIN_ID, as for every ROS node. `arguments` are
        those behind `--ros-args` on a command line; they override name and namespace.

        The full name distinguishes this node from others, so it must be unique, as ROS demands.
        """
        super().__init__()
        self.name = f"{namespace.rstrip('/')}/{name}"
        self._base_name = name
        self._namespace = namespace
        self._domain_id = domain_id
        self._arguments = list(arguments)
        self._use_sim_time = use_sim_time
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._rclpy: Any = None
        self._context: Any = None
        self._node: Any = None
        self._executor: Any = None
        self._is_event_driven = False
        self._clock: Any = None
        #: The names on the bus of topics and of services that are remapped, by those used here.
        self._remapped_topics: dict[str, str] = {}
        self._remapped_services: dict[str, str] = {}
        #: The scope of the network when the node joined the bus.
        self._scope = NetworkScope.NOBODY
        #: Whether the loop's thread can take messages itself; False once that has failed.
        self._takes_on_loop = True
        self._on_loop: weakref.WeakSet[LoopSubscription] = weakref.WeakSet()

    def start(
        self,
        poll: Callable[[], None],
        failed: Callable[[str], None],
        entries: Entries | None = None,
    ) -> None:
        self._entries = entries
        _, reason = available()
        if self._domain_id is None:
            reason = reason or _wrong_domain()
        if reason:
            failed(reason)
            return
        fastdds.use_profile(os.environ)
        if self._thread is not None:  # it has failed, and is about to end
            self._thread.join()
        # Not a daemon: one that is alive when Python ends aborts the process.
        self._thread = threading.Thread(target=self._run, args=(poll, failed), name="ros")
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _run(self, poll: Callable[[], None], failed: Callable[[str], None]) -> None:
        reason = ""
        try:
            self._join()
            self._spin(poll)
        except Exception as error:
            # Any error ends the thread: report it, and leave the bus properly.
            log.debug("the ROS thread ended", exc_info=True)
            reason = str(error) if isinstance(error, BusError) else _error_text(error)
        finally:
            self._leave()
        if reason:
            failed(reason)

    def _join(self) -> None:
        import rclpy
        from rclpy.context import Context
        from rclpy.node import Node
        from rclpy.parameter import Parameter
        from rclpy.signals import SignalHandlerOptions

        # Before the node joins, as it may miss a network that appears meanwhile.
        self._scope = find_scope()
        refresh_fast_dds()
        self._rclpy = rclpy
        self._context = Context()
        rclpy.init(
            args=["--ros-args", *self._arguments] if self._arguments else [],
            context=self._context,
            domain_id=self._domain_id,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self._node = Node(
            self._base_name,
            namespace=self._namespace,
            context=self._context,
            # The log lines of this node would be messages on a topic that may itself be bridged.
            enable_rosout=False,
            start_parameter_services=False,
            parameter_overrides=[Parameter("use_sim_time", value=True)]
            if self._use_sim_time
            else [],
        )
        self.name = self._node.get_fully_qualified_name()
        self._find_remapped()
        self._clock = self._node.get_clock()
        self._executor, self._is_event_driven = _new_executor(self._context)
        self._executor.add_node(self._node)

    def _find_remapped(self) -> None:
        from rclpy.expand_topic_name import expand_topic_name

        node = self._node
        for name in remapped_names(self._arguments):
            own = expand_topic_name(name, node.get_name(), node.get_namespace())
            for known, resolve in (
                (self._remapped_topics, node.resolve_topic_name),
                (self._remapped_services, node.resolve_service_name),
            ):
                # A rule for another node, and one behind another for the same name, is none.
                if (resolved := resolve(own)) != own:
                    known[own] = resolved

    def _spin(self, poll: Callable[[], None]) -> None:
        from rclpy.executors import ExternalShutdownException
        from rclpy.task import Future

        check_at = time.monotonic() + NETWORK_INTERVAL
        poll()
        interval = POLL_INTERVAL
        never: Any = Future(executor=self._executor)
        try:
            while not self._stopping.is_set():
                # EventsExecutor needs a finite timeout, too: an endless wait overflows there.
                self._executor.spin_until_future_complete(never, timeout_sec=interval)
                began = time.monotonic()
                poll()
                interval = interval_after(time.monotonic() - began)
                if self._scope < NetworkScope.NETWORK and time.monotonic() >= check_at:
                    check_at = time.monotonic() + NETWORK_INTERVAL
                    if find_scope() > self._scope:
                        raise BusError("there was no network yet when it was joined, and is now")
        except ExternalShutdownException:
            if not self._stopping.is_set():
                raise

    def _leave(self) -> None:
        for subscription in list(self._on_loop):
            subscription.destroy()
        if self._executor is not None:
            self._executor.shutdown()
        if self._node is not None:
            self._node.destroy_node()
        if self._context is not None:
            self._rclpy.try_shutdown(context=self._context)
        self._executor = self._node = self._context = self._clock = None
        # Circles of rclpy's objects keep a node with remappings on the bus, beside the next one,
        # until they are looked for, which the appliance does not do by itself.
        gc.collect()

    def call_soon(self, callback: Callable[[], None]) -> None:
        executor = self._executor
        if executor is None:
            raise BusError("ROS is not ready")

        def run() -> None:
            try:
                callback()
            except Exception as error:  # in EventsExecutor it would end the whole process
                self._report_fault("ros.task", error)

        executor.create_task(run)

    # The graph

    def now(self) -> int:
        clock = self._clock
        return int(clock.now().nanoseconds) if clock is not None else time.time_ns()

    def nodes(self) -> list[str]:
        found = self._node.get_node_names_and_namespaces()
        return [f"{namespace.rstrip('/')}/{name}" for name, namespace in found]

    def elsewhere(self) -> set[str]:
        """The nodes with endpoints on other computers, or in containers with their own network.

        Empty when the middleware is not Fast DDS, whose endpoint ids contain the host.
        """
        from rclpy.impl.implementation_singleton import rclpy_implementation

        middleware = rclpy_implementation.rclpy_get_rmw_implementation_identifier()
        if not middleware.startswith("rmw_fastrtps"):
            return set()
        hosts: dict[str, set[bytes]] = {}
        for topic in map(self._of_remapped_action, self.topics()):
            for info in (
                *self._node.get_publishers_info_by_topic(topic),
                *self._node.get_subscriptions_info_by_topic(topic),
            ):
                name = f"{info.node_namespace.rstrip('/')}/{info.node_name}"
                if "_NODE_NAME_UNKNOWN_" in name:  # not announced yet, or no node of ROS
                    name = "one without a name"
                hosts.setdefault(name, set()).add(bytes(info.endpoint_gid[2:4]))
        here = hosts.get(self.name, set())
        return {name for name, at in hosts.items() if here and not at <= here}

    def topics(self) -> dict[str, list[str]]:
        found = _named(self._node.get_topic_names_and_types())
        if not self._remapped_topics:
            return found
        return with_own_names(found, self._remapped_topics, self._remapped_topics)

    def services(self) -> dict[str, list[str]]:
        from rclpy.node import NodeNameNonExistentError

        # A query for all services at once would also return those that have only clients.
        found: dict[str, list[str]] = {}
        for node in self._node.get_node_names_and_namespaces():
            # The node has left meanwhile, or ROS does not accept its name.
            with suppress(NodeNameNonExistentError, *_errors()):
                named = _named(self._node.get_service_names_and_types_by_node(*node))
                for service, types in named.items():
                    # Two nodes may have services of the same name, also of different types.
                    found[service] = sorted({*found.get(service, ()), *types})
        if not self._remapped_services and not self._remapped_topics:
            return found
        return with_own_names(found, self._remapped_services, self._remapped_topics)

    def count(self, topic: str) -> tuple[int, int]:
        topic = self.resolve(topic)
        handle = self._node.handle  # the node's own methods would expand and check the name again
        with handle:
            return handle.get_count_publishers(topic), handle.get_count_subscribers(topic)

    def resolve(self, topic: str) -> str:
        topic = self._of_remapped_action(topic)
        return self._remapped_topics.get(topic, topic)

    def _of_remapped_action(self, name: str) -> str:
        """The name of a topic or service of an action, with the action's remapped.

        ROS remaps the names of actions from Kilted on, and up to Jazzy only those of each of their
        services and topics; the bridge, which uses these, does both on each.
        """
        action, separator, part = name.partition(OF_ACTION)
        if not separator or action not in self._remapped_topics:
            return name
        return f"{self._remapped_topics[action]}{separator}{part}"

    def publishers(self, topic: str) -> list[Endpoint]:
        topic = self._of_remapped_action(topic)
        return self._others(self._node.get_publishers_info_by_topic(topic))

    def subscribers(self, topic: str) -> list[Endpoint]:
        topic = self._of_remapped_action(topic)
        return self._others(self._node.get_subscriptions_info_by_topic(topic))

    def _others(self, found: list[Any]) -> list[Endpoint]:
        endpoints = [_endpoint(info) for info in found]
        return [endpoint for endpoint in endpoints if endpoint.node != self.name]

    def describe(self, type_name: str) -> TypeDescription:
        return describe(load_message(type_name), load_message)

    # Subscriptions and publishers

    def subscribe_raw(
        self,
        topic: str,
        type_name: str,
        qos: QosProfile,
        callback: Callable[..., None],
        *,
        timed: bool = False,
        on_loop: TakeBatch | None = None,
    ) -> RosSubscription:
        message_class = load_message(type_name)
        topic = self._of_remapped_action(topic)
        if on_loop is not None and self._takes_on_loop and self._entries is not None:
            try:
                return self._subscribe_on_loop(message_class, topic, qos, callback, on_loop)
            except UnavailableError as reason:
                log.info("the ROS thread takes all messages: %s", reason)
                self._takes_on_loop = False
        events = _event_callbacks().SubscriptionEventCallbacks(use_default_callbacks=False)
        callback = self._contained("ros.message", callback)
        if timed and not self._is_event_driven and _has_message_info():
            callback = _with_time(callback)
        with _as_bus_error():
            own = self._node.create_subscription(
                message_class, topic, callback, _to_rclpy(qos), raw=True, event_callbacks=events
            )
        if timed and self._is_event_driven:
            own.__class__ = _timed_subscription()
            own.since = time.monotonic_ns()
        return _Ros2Subscription(self._node, own, _Losses(own.handle))

    def _subscribe_on_loop(
        self,
        message_class: type[Any],
        topic: str,
        qos: QosProfile,
        callback: Callable[..., None],
        on_loop: TakeBatch,
    ) -> LoopSubscription:
        """Raises BusError, UnavailableError."""
        from rclpy.impl.implementation_singleton import rclpy_implementation
        from rclpy.type_support import check_is_valid_msg_type

        assert self._entries is not None
        middleware = rclpy_implementation.rclpy_get_rmw_implementation_identifier()
        if not middleware.startswith("rmw_fastrtps"):
            raise UnavailableError(f"it has not been tried with {middleware}")
        check_is_valid_msg_type(message_class)  # it also loads the type support
        with _as_bus_error(ValueError), self._node.handle:
            # rclpy's create_subscription would add it to the node, and so to the executor.
            handle = rclpy_implementation.Subscription(
                self._node.handle, message_class, topic, _to_rclpy(qos).get_c_qos_profile()
            )
        try:
            losses = _Losses(handle)
            own = LoopSubscription(
                handle, message_class, self._entries, self.call_soon, callback, on_loop, losses
            )
        except UnavailableError:
            losses.destroy()
            handle.destroy_when_not_in_use()
            raise
        self._on_loop.add(own)
        return own

    def create_publisher(self, topic: str, type_name: str, qos: QosProfile) -> _Ros2Publisher:
        message_class = load_message(type_name)
        events = _event_callbacks().PublisherEventCallbacks(use_default_callbacks=False)
        with _as_bus_error():
            own = self._node.create_publisher(
                message_class, topic, _to_rclpy(qos), event_callbacks=events
            )
        return _Ros2Publisher(self._node, own)

    # Services

    def create_client(self, service: str, type_name: str) -> _Ros2Client:
        service_class = import_service(type_name)
        service = self._of_remapped_action(service)
        with _as_bus_error():
            own = self._node.create_client(service_class, service, qos_profile=_to_rclpy(CALLS))
        return _Ros2Client(self._node, own, service_class)

    def create_service(
        self, service: str, type_name: str, callback: Callable[[bytes, Respond], None]
    ) -> _Ros2Service:
        callback = self._contained("ros.request", callback)
        return _Ros2Service(self._node, service, import_service(type_name), callback)


def _named(found: list[tuple[str, list[str]]]) -> dict[str, list[str]]:
    return {
        name: types
        for name, types in found
        if len(name) <= _LONGEST_NAME and _NAME.match(name) is not None
    }


def lost_between(before: int, after: int) -> int:
    """The messages lost between two totals of the middleware, which counts in 32 bits with a sign.

    Now and then Fast DDS counts 2**31 - 1 more, for a gap whose beginning it does not know.
    """
    return ((after - before) & 0xFFFF_FFFF) % 0x7FFF_FFFF


class _Losses:
    """Counts the messages of a subscription that the middleware lost.

    The event is not added to an executor: with EventsExecutor, destroying an endpoint with an event
    handler can crash. Messages that the subscription's own queue dropped are not counted.
    """

    def __init__(self, handle: Any) -> None:
        """`handle` is rclpy's, of the subscription. Without support of the middleware, `take`
        always returns 0."""
        implementation = import_module("rclpy.impl.implementation_singleton").rclpy_implementation
        kinds = implementation.rcl_subscription_event_type_t
        # ROS 2 Humble has another name for it.
        kind = getattr(implementation, "EventHandle", None) or implementation.QoSEvent
        self._refusals = _errors()
        self._event: Any = None
        self._total = 0
        with suppress(implementation.UnsupportedEventTypeError, *self._refusals), handle:
            self._event = kind(handle, kinds.RCL_SUBSCRIPTION_MESSAGE_LOST)

    def take(self) -> int:
        if self._event is None:
            return 0
        with suppress(*self._refusals), self._event:
            status = self._event.take_event()
            if status is None:
                return 0
            # Not its change since the last time, of which a part is gone when the middleware counts
            # meanwhile.
            before, self._total = self._total, int(status.total_count)
            return lost_between(before, self._total)
        return 0

    def destroy(self) -> None:
        if self._event is not None:
            self._event.destroy_when_not_in_use()
            self._event = None


class _Ros2Subscription:
    def __init__(self, node: Any, own: Any, losses: _Losses) -> None:
        self._node = node
        self._own = own
        self._losses = losses

    def take_lost(self) -> int:
        return self._losses.take()

    def destroy(self) -> None:
        self._losses.destroy()
        self._node.destroy_subscription(self._own)


class _Ros2Publisher:
    def __init__(self, node: Any, own: Any) -> None:
        self._node = node
        self._own = own
        self._publish = own.publish
        self._refusals = _errors()

    def publish(self, cdr: bytes) -> None:
        try:
            self._publish(cdr)
        except self._refusals as error:  # the transport is full, or the node has ended
            raise BusError(str(error)) from error

    @property
    def has_subscribers(self) -> bool:
        try:
            return bool(self._own.get_subscription_count())
        except self._refusals:  # it is being destroyed
            return False

    def destroy(self) -> None:
        self._node.destroy_publisher(self._own)


class _Ros2Client:
    """A RosClient. rclpy accepts only message objects, so that requests are deserialized, and
    responses serialized."""

    def __init__(self, node: Any, own: Any, service_class: Any) -> None:
        from rclpy.serialization import deserialize_message, serialize_message

        self._node = node
        self._own = own
        self._request_class = service_class.Request
        self._deserialize, self._serialize = deserialize_message, serialize_message
        self._refusals = _errors()

    def is_ready(self) -> bool:
        return bool(self._own.service_is_ready())

    def call(self, request: bytes, done: Callable[[bytes | BusError], None]) -> Callable[[], None]:
        try:
            future = self._own.call_async(self._deserialize(request, self._request_class))
        except self._refusals as error:
            raise BusError(str(error)) from error

        def finish(future: Any) -> None:
            if future.cancelled() or self._own is None:
                return
            try:
                response: bytes | BusError = self._serialize(future.result())
            except Exception as error:  # a future may raise anything, which must not end the thread
                response = BusError(str(error))
            done(response)

        def give_up() -> None:
            if self._own is not None:
                self._own.remove_pending_request(future)

        future.add_done_callback(finish)
        return give_up

    def destroy(self) -> None:
        own, self._own = self._own, None
        self._node.destroy_client(own)


class _Ros2Service:
    def __init__(
        self,
        node: Any,
        name: str,
        service_class: Any,
        callback: Callable[[bytes, Respond], None],
    ) -> None:
        from rclpy.serialization import deserialize_message, serialize_message

        self._node = node
        self._response_class = service_class.Response
        self._callback = callback
        self._deserialize, self._serialize = deserialize_message, serialize_message
        with _as_bus_error():
            self._own = node.create_service(
                service_class, name, lambda request, _: request, qos_profile=_to_rclpy(CALLS)
            )
        # The executor sends the return value of the callback. To respond later or never, without
        # a coroutine that the executor would keep forever, its `send_response` is replaced.
        self._send = self._own.send_response
        self._own.send_response = self._dispatch

    def _dispatch(self, request: Any, header: Any) -> None:
        def respond(response: bytes | None) -> None:
            if response is not None and self._own is not None:
                with _as_bus_error():
                    self._send(self._deserialize(response, self._response_class), header)

        self._callback(self._serialize(request), respond)

    def destroy(self) -> None:
        own, self._own = self._own, None
        self._node.destroy_service(own)


@functools.cache
def load_message(name: str) -> type[Any]:
    """The class of a message type with its compiled support; where that does not load, a class from
    the definition. Raises UnknownTypeError, which says why there is neither.
    """
    try:
        return _with_support(import_message(name))
    except UnknownTypeError as error:
        definition = uncompiled.find_definition(name)
        if definition is None:
            raise
        if definition.suffix != ".msg":
            raise UnknownTypeError(
                f"{error}; its definition {definition} is not enough: rclpy makes calls only with "
                f"support compiled for its own Python, here {sys.version_info[0]}."
                f"{sys.version_info[1]}"
            ) from error
        found = uncompiled.message_class(name, definition, load_message)
        log.info("%s; %s is read from %s", error, name, definition)
        return found


def _with_support(found: type[Any]) -> type[Any]:
    from rosidl_generator_py.import_type_support_impl import UnsupportedTypeSupport

    try:
        found.__class__.__import_type_support__()  # type: ignore[attr-defined]
    except UnsupportedTypeSupport as error:
        package = found.__module__.partition(".")[0]
        reason = str(error.__context__ or error).partition("\n")[0]
        raise UnknownTypeError(f"the package {package} does not load: {reason}") from error
    return found


def interfaces() -> dict[str, list[str]]:
    """The types of each installed package of interfaces, such as `std_msgs/msg/String`."""
    found: dict[str, list[str]] = {}
    for folder in fastdds.shares():
        index = folder / "ament_index" / "resource_index" / "rosidl_interfaces"
        for entry in index.iterdir() if index.is_dir() else ():
            names = {line.partition(".")[0] for line in entry.read_text().splitlines() if line}
            found.setdefault(entry.name, [f"{entry.name}/{name}" for name in sorted(names)])
    return found


def import_service(name: str) -> Any:
    """The class of a service such as `std_srvs/srv/Trigger`, or of an action's services
    `pkg/action/Name_SendGoal` and `pkg/action/Name_GetResult`. Raises UnknownTypeError.
    """
    request = load_message(f"{name}_Request")
    service = getattr(sys.modules[request.__module__], name.rpartition("/")[2], None)
    if service is None:
        raise UnknownTypeError(f"no {name}: it is not a service")
    return service


def fault_of_arguments(arguments: Sequence[str]) -> str | None:
    """What ROS has against its own arguments, those behind `--ros-args`; None if nothing, or where
    there is no ROS that could be asked.

    It is asked in a process of its own, before any thread is started here: rcl ends its process
    over what it does not like. What only a node can tell, such as a value of another type than its
    parameter, is not seen.
    """
    if not available()[0] or _wrong_domain():
        return None
    outcome, to_parent = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.write(to_parent, _fault_of_arguments(arguments).encode(errors="replace"))
        finally:
            os._exit(0)
    os.close(to_parent)
    with os.fdopen(outcome, "rb") as told:
        text = told.read().decode()
    os.waitpid(child, 0)
    return text or None


def _fault_of_arguments(arguments: Sequence[str]) -> str:
    """The text of the fault, short enough for a pipe; empty without one."""
    try:
        error = _refusal(["--ros-args", *arguments])
        if error is None or _refusal([]) is not None:  # it is not for the arguments
            return ""
    except Exception:  # a ROS that cannot be imported is the bridge's matter
        return ""
    text = re.sub(r",? at /\S+:\d+", "", " ".join(str(error).split()))  # places in rcl's sources
    text = text.removeprefix("failed to initialize rcl: ")[:1000]
    return f"unknown: {text}" if type(error).__name__ == "UnknownROSArgsError" else text


def _refusal(arguments: list[str]) -> Exception | None:
    from rclpy.context import Context

    tried = Context()
    try:
        tried.init(args=arguments, initialize_logging=False)
    except Exception as error:
        return error
    tried.try_shutdown()
    return None


def _error_text(error: Exception) -> str:
    if "have the security libraries" in str(error):
        return (
            "ROS_SECURITY_ENABLE is true, and this Fast DDS was built without security, as PyPI's "
            "is: source a ROS distribution's, or unset it"
        )
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _errors() -> tuple[type[Exception], ...]:
    implementation = import_module("rclpy.impl.implementation_singleton").rclpy_implementation
    return implementation.RCLError, implementation.RMWError, implementation.InvalidHandle


@contextmanager
def _as_bus_error(*more: type[Exception]) -> Iterator[None]:
    from rclpy.exceptions import NameValidationException, NoTypeSupportImportedException

    refusals: tuple[Any, ...] = (NameValidationException, NoTypeSupportImportedException, *more)
    try:
        yield
    except refusals + _errors() as error:
        raise BusError(str(error)) from error


def _new_executor(context: Any) -> tuple[Any, bool]:
    """The best available executor, and whether it is EventsExecutor, which takes an eighth of the
    CPU time of the others and exists since ROS 2 Jazzy (rclpy 7.1.4)."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor(context=context), False
    return EventsExecutor(context=context), True


def _has_message_info() -> bool:
    """Whether rclpy passes a message's times to callbacks that take them: from ROS 2 Iron on."""
    from rclpy.subscription import Subscription

    return hasattr(Subscription, "CallbackType")


def _with_time(callback: Callable[..., None]) -> Callable[[bytes, Any], None]:
    """A callback that passes the times of some messages on; rclpy gives it the times of all."""
    since = time.monotonic_ns()
    until_timed = ONE_TIMED_OF

    def timed(cdr: bytes, info: Any) -> None:
        nonlocal until_timed
        until_timed -= 1
        if until_timed:
            callback(cdr)
            return
        until_timed = ONE_TIMED_OF
        callback(cdr, published_at(info, since))

    return timed


@functools.cache
def _timed_subscription() -> Any:
    """The class of subscriptions that pass the publication time of some messages to the callback,
    of those that were published after `since`.

    With EventsExecutor, in Kilted, a callback cannot request the message info: it would end the
    executor. But the executor reads `callback` just before it takes a message, and a message that
    is taken there instead has its time.
    """
    from rclpy.subscription import Subscription

    class TimedSubscription(Subscription):  # type: ignore[misc]  # rclpy is untyped
        _callback: Any
        _until_timed = 1
        _timed = 0
        since = 0

        @property
        def callback(self) -> Any:
            self._until_timed -= 1
            if not self._until_timed:
                self._take_one()
            return self._callback

        def _take_one(self) -> None:
            self._timed += 1
            self._until_timed = 1 if self._timed < FIRST_TIMED else ONE_TIMED_OF
            taken = self.handle.take_message(self.msg_type, True)
            if taken is not None:
                self._callback(taken[0], published_at(taken[1], self.since))

    return TimedSubscription


def _event_callbacks() -> Any:
    """The module of the event callback classes, which are always used without callbacks: rclpy's
    defaults only log, and with EventsExecutor destroying an endpoint with some can crash."""
    try:
        return import_module("rclpy.event_handler")
    except ImportError:  # ROS 2 Humble
        return import_module("rclpy.qos_event")


def _endpoint(info: Any) -> Endpoint:
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    profile = info.qos_profile
    type_hash = str(getattr(info, "topic_type_hash", ""))  # from ROS 2 Iron on
    return Endpoint(
        f"{info.node_namespace.rstrip('/')}/{info.node_name}",
        info.topic_type,
        QosProfile(
            Reliability.BEST_EFFORT
            if profile.reliability == ReliabilityPolicy.BEST_EFFORT
            else Reliability.RELIABLE,
            Durability.TRANSIENT_LOCAL
            if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            else Durability.VOLATILE,
            profile.depth,
        ),
        type_hash if type_hash.startswith("RIHS") else None,
    )


def _to_rclpy(qos: QosProfile) -> Any:
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        depth=qos.depth,
        reliability=ReliabilityPolicy.BEST_EFFORT
        if qos.reliability is Reliability.BEST_EFFORT
        else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL
        if qos.durability is Durability.TRANSIENT_LOCAL
        else DurabilityPolicy.VOLATILE,
    )
