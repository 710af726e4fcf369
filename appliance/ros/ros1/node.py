"""The node on ROS 1: the only module that imports rospy, and only when the node starts.

Messages pass rospy as their bytes, through classes that have only the name and MD5 sum of a type.
rospy does not reconnect when the Master was away or has been restarted. So the node, which polls
the state of the graph anyway, registers again what is missing there. And rospy can be started only
once: to join the bus again, the node imports it again.
"""

from __future__ import annotations

import logging
import os
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from time import monotonic
from typing import Any

from appliance.net.callbacks import Entries
from appliance.ros.fault_containment import FaultContainment
from appliance.ros.node import (
    BusError,
    Durability,
    Endpoint,
    ParameterServer,
    QosProfile,
    Respond,
    RosClient,
    RosSubscription,
    TakeBatch,
)
from appliance.ros.payload.definitions import PACKED, TypeDescription, UnknownTypeError
from appliance.ros.remapping import with_own_names
from appliance.ros.ros1.actions import (
    HIDDEN,
    ActionClients,
    describe_action,
    find_actions,
    services_of,
)
from appliance.ros.ros1.endpoints import Ros1Client, Ros1Publisher, Ros1Service, Ros1Subscription
from appliance.ros.ros1.peers import (
    Master,
    MasterParameters,
    QueryCache,
    fetch_definition,
    fetch_service_type,
)
from appliance.ros.ros1.rospy_cleanup import ServerShutdown, limit_receive_size, unload
from appliance.ros.ros1.types import Definition, describe, full_name, installed, installed_service

log = logging.getLogger(__name__)

#: Seconds between two polls of the graph: the Master does not notify of changes.
POLL_INTERVAL = 0.2

#: Seconds until the types of topics are fetched again though the same nodes have them: one of these
#: may have created a topic again with another type.
TYPES_INTERVAL = 1.0

#: Seconds between two attempts to reach the Master at the start.
MASTER_RETRY_INTERVAL = 0.5

#: Seconds within which rospy has to leave the bus.
LEAVE_TIMEOUT = 3.0

DEFAULT_MASTER = "http://localhost:11311"

#: The nodes of each topic or service, by its name.
_Graph = dict[str, list[str]]


def available() -> tuple[bool, str]:
    """Whether a node can be started here; if not, one line that says why and what to do.

    Imports nothing of ROS.
    """
    if find_spec("rospy") is None:
        return False, (
            "there is no ROS 1 here: rospy cannot be imported. Source a ROS 1 setup file first, or "
            "apt install python3-rospy, and install the appliance for the system's Python: "
            "/usr/bin/python3 -m venv --system-site-packages"
        )
    messages = find_spec("std_msgs")
    folders = list(messages.submodule_search_locations or ()) if messages is not None else []
    if not any(Path(folder, "msg", "_String.py").is_file() for folder in folders):
        return False, (
            "ROS 2's packages come before those of ROS 1 here, and have the same names. Make an "
            "environment without the extra `ros`, and source no ROS 2"
            if folders
            else "there is rospy, but not std_msgs. apt install python3-std-msgs"
        )
    return True, ""


def found() -> str:
    """The ROS 1 that is used, for people to read; call it only when one is `available`."""
    spec = find_spec("rospy")
    where = Path(spec.origin).parent.parent if spec is not None and spec.origin else "?"
    distribution = os.environ.get("ROS_DISTRO", "")
    return f"ROS 1{' ' if distribution else ''}{distribution} in {where}"


def master_uri() -> str:
    """The URI of the Master, from the environment as for every node of ROS 1."""
    return os.environ.get("ROS_MASTER_URI") or DEFAULT_MASTER


def remappings(arguments: Iterable[str]) -> Iterator[str]:
    """The remappings among ROS arguments, with or without a `-r` before them as in ROS 2."""
    before = ""
    for argument in arguments:
        if ":=" in argument and before not in ("-p", "--param"):
            yield argument
        before = argument


class Ros1Node(FaultContainment):
    """A RosNode on ROS 1. As rospy is, there can be only one at a time in a process.

    rospy calls subscriptions on threads of its own, one message at a time for each subscription.
    """

    serialization = PACKED

    def __init__(
        self, name: str = "appliance", namespace: str = "/", arguments: Sequence[str] = ()
    ) -> None:
        """`arguments` are remappings, `/cmd_vel:=/base/cmd_vel`, as on a command line."""
        super().__init__()
        self._arguments = list(remappings(arguments))
        names = dict(argument.split(":=", 1) for argument in self._arguments)
        space = os.environ.get("ROS_NAMESPACE", "") if namespace == "/" else namespace
        space = names.get("__ns", space).strip("/")
        self.name = (
            f"/{space}/{names.get('__name', name)}" if space else f"/{names.get('__name', name)}"
        )
        self._master = Master(names.get("__master", master_uri()), self.name)
        self.parameter_server: ParameterServer | None = MasterParameters(self._master)
        self._base_name = name
        self._namespace = namespace
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._remote_definitions: dict[str, Definition] = {}
        self._warned: set[str] = set()
        self._reset()

    def _reset(self) -> None:
        """Set the state of a node that has not joined the bus yet."""
        self._work: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._is_running = False
        self._rospy: Any = None
        self._uri = ""
        #: Why the Master does not answer; None when it does.
        self._master_error: str | None = None
        # The graph, as of the last poll.
        self._publishers: _Graph = {}
        self._subscribers: _Graph = {}
        self._servers: _Graph = {}
        self._types: dict[str, str] = {}
        self._types_fetched_at = 0.0
        #: The types of the actions that have a server.
        self._actions: dict[str, str] = {}
        self._action_clients = ActionClients(self)
        #: By topic and node, whether a publisher is latched, which the connection's header says.
        self._is_latched: dict[tuple[str, str], bool] = {}
        #: Queries for definitions of types that are not installed, and for the types of services.
        self._definitions: QueryCache[Definition] = QueryCache()
        self._service_types: QueryCache[str] = QueryCache()
        #: Subscriptions that hold messages until the next poll. A dict, whose single operations are
        #: atomic and which keeps their order.
        self._holding: dict[Ros1Subscription, None] = {}

    @property
    def obstacle(self) -> str | None:
        error = self._master_error
        return None if error is None else f"the ROS Master does not answer: {error}"

    def start(
        self,
        poll: Callable[[], None],
        failed: Callable[[str], None],
        entries: Entries | None = None,
    ) -> None:
        self._entries = entries
        is_available, reason = available()
        if not is_available:
            failed(reason)
            return
        if self._thread is not None:  # it has failed, and is about to end
            self._thread.join()
            self._reset()
        self._thread = threading.Thread(
            target=self._run, args=(poll, failed), name="ros", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        self._work.put(lambda: None)
        thread, self._thread = self._thread, None
        if thread is None:
            return
        thread.join(LEAVE_TIMEOUT)
        if thread.is_alive():
            # rospy waits for a Master that does not answer, on a socket without a timeout.
            log.warning("the node could not unregister from ROS: the Master does not answer")

    def _run(self, poll: Callable[[], None], failed: Callable[[str], None]) -> None:
        reason = ""
        try:
            if self._join():
                self._is_running = True
                self._spin(poll)
        except Exception as error:
            # Any error ends the thread: report it, and leave the bus properly.
            log.debug("the ROS thread ended", exc_info=True)
            reason = (
                str(error) if isinstance(error, BusError) else f"{type(error).__name__}: {error}"
            )
        finally:
            self._is_running = False
            self._leave()
        if reason:
            failed(reason)

    def _join(self) -> bool:
        """Wait for the Master and start the node. Returns False when it was stopped before."""
        os.environ["ROS_MASTER_URI"] = self._master.uri
        if self._namespace != "/":
            os.environ["ROS_NAMESPACE"] = self._namespace
        if not self._await_master():
            return False
        self._check_name()
        unload()
        self._rospy = rospy = import_module("rospy")
        # rospy would reconfigure the logging of the whole process.
        rospy.core.configure_logging = lambda *_, **__: None
        rospy.init_node(
            self._base_name,
            argv=["appliance", *self._arguments],
            # The log lines of this node would be messages on a topic that may itself be bridged.
            disable_rosout=True,
            disable_signals=True,
        )
        ServerShutdown(rospy)
        limit_receive_size(rospy)
        self.name = rospy.get_name()
        self._uri = rospy.core.get_node_uri()
        self._master.caller = self.name
        return True

    def _check_name(self) -> None:
        """Raises BusError when another node has this name.

        The Master would shut the other node down, and when that is restarted, this one.
        """
        uri = self._find_namesake()
        if uri is not None:
            raise BusError(
                f"another node, at {uri}, is called {self.name}: end it, or give this one another "
                "name, bridge.node"
            )

    def _await_master(self) -> bool:
        while not self._stopping.is_set():
            try:
                self._master.call("getPid")
            except BusError as error:
                if self._master_error is None:
                    log.warning("waiting for the ROS Master: %s", error)
                self._master_error = str(error)
                self._stopping.wait(MASTER_RETRY_INTERVAL)
            else:
                self._master_error = None
                return True
        return False

    def _spin(self, poll: Callable[[], None]) -> None:
        while not self._stopping.is_set():
            if self._rospy.is_shutdown():
                raise BusError(
                    f"{self.name} was shut down from outside: by `rosnode kill`, or by another "
                    "node of the same name"
                )
            if self._refresh_graph():
                holding = list(self._holding)
                poll()
                for subscription in holding:
                    subscription.release()
            self._do_work(monotonic() + POLL_INTERVAL)

    def _do_work(self, until: float) -> None:
        while not self._stopping.is_set():
            try:
                callback = self._work.get(timeout=max(0.0, until - monotonic()))
            except queue.Empty:
                return
            callback()

    def _leave(self) -> None:
        self._definitions.close()
        self._service_types.close()
        if self._rospy is not None:
            self._rospy.signal_shutdown("the appliance stops")

    def call_soon(self, callback: Callable[[], None]) -> None:
        if not self._is_running:
            raise BusError("ROS is not ready")
        self._work.put(self._contained("ros.task", callback))

    # The graph

    def nodes(self) -> list[str]:
        graphs = (self._publishers, self._subscribers, self._servers)
        return sorted({node for graph in graphs for nodes in graph.values() for node in nodes})

    def _refresh_graph(self) -> bool:
        """Poll the graph. Returns False when the Master does not answer."""
        try:
            state = [dict(found) for found in self._master.call("getSystemState")]
            self._register_missing(*state)
            connected = self._add_connected(*state[:2])
            has_changed = state != [self._publishers, self._subscribers, self._servers]
            if has_changed or monotonic() >= self._types_fetched_at + TYPES_INTERVAL:
                self._types_fetched_at = monotonic()
                types = dict(self._master.call("getTopicTypes"))
                before = {topic: self._types[topic] for topic in connected if topic in self._types}
                self._types = before | {
                    topic: full_name(name) for topic, name in types.items() if name != "*"
                }
                self._publishers, self._subscribers, self._servers = state
                self._actions = find_actions(self._types, self._publishers)
                there = {(topic, node) for topic in state[0] for node in state[0][topic]}
                for key in self._is_latched.keys() - there:
                    self._is_latched.pop(key, None)
                self._definitions.evict_others(there)
        except (BusError, TypeError, ValueError) as error:
            if self._master_error is None:
                log.warning("the ROS Master does not answer; what is connected stays so: %s", error)
            self._master_error = str(error)
            return False
        if self._master_error is not None:
            self._master_error = None
            log.info("the ROS Master is back at %s", self._master.uri)
        return True

    def _register_missing(self, publishers: _Graph, subscribers: _Graph, servers: _Graph) -> None:
        """Register again what the Master does not know of: it has been restarted."""
        from rospy.impl.registration import get_service_manager, get_topic_manager

        topics, master = get_topic_manager(), self._master
        published = [own for own in topics.get_publications() if self._lacks(publishers, own[0])]
        subscribed = [own for own in topics.get_subscriptions() if self._lacks(subscribers, own[0])]
        served = [own for own in get_service_manager().get_services() if own[0] not in servers]
        count = len(published) + len(subscribed) + len(served)
        # When there is a namesake, the Master is just shutting this node down for it.
        if not count or self._find_namesake():
            return
        for topic, type_name in published:
            master.call("registerPublisher", topic, type_name, self._uri)
        for topic, type_name in subscribed:
            uris = master.call("registerSubscriber", topic, type_name, self._uri)
            # The same message with which the Master reports publishers that register later.
            Master(self._uri, self.name).call("publisherUpdate", topic, uris)
        for service, uri in served:
            master.call("registerService", service, uri, self._uri)
        log.info("registered again with the ROS Master: %d topics and services", count)

    def _lacks(self, graph: _Graph, topic: str) -> bool:
        return self.name not in graph.get(topic, ())

    def _find_namesake(self) -> str | None:
        """The URI of another running node with this node's name; None when there is none."""
        with suppress(BusError):
            uri = str(self._master.call("lookupNode", self.name))
            if uri != self._uri:
                Master(uri, self.name).call("getPid")
                return uri
        return None

    def _add_connected(self, publishers: _Graph, subscribers: _Graph) -> set[str]:
        """Add the nodes that are connected to this one.

        A restarted Master does not know of nodes that do not register again, but these go on.
        Returns the topics that they share with this node.
        """
        from rospy.impl.registration import get_topic_manager

        topics = get_topic_manager()
        found = set()
        for graph, own, attribute in (
            (publishers, topics.subs, "callerid_pub"),
            (subscribers, topics.pubs, "endpoint_id"),
        ):
            for topic, impl in list(own.items()):
                nodes = {getattr(peer, attribute) for peer in impl.connections}
                if more := nodes.difference(graph.get(topic, ()), {"unknown", ""}):
                    graph[topic] = [*graph.get(topic, ()), *sorted(more)]
                    found.add(topic)
        return found

    def now(self) -> int:
        rospy = self._rospy
        if rospy is None or rospy.rostime.is_wallclock():
            return time.time_ns()
        return int(rospy.rostime.get_rostime().to_nsec())

    def topics(self) -> dict[str, list[str]]:
        found = {
            topic: [self._types[topic]]
            for topic in self._publishers | self._subscribers
            if topic in self._types
        }
        return self._with_own_names(found)

    def _with_own_names(self, found: dict[str, list[str]]) -> dict[str, list[str]]:
        if not self._arguments:
            return found
        # rospy, too, remaps the topics of an action each by itself, and not the action.
        return with_own_names(found, self._rospy.names.get_resolved_mappings(), {})

    def services(self) -> dict[str, list[str]]:
        found = services_of(self._actions)
        for service, nodes in self._servers.items():
            key = service, *nodes
            query = partial(fetch_service_type, self._master.uri, self.name, service)
            try:
                name = self._service_types.get(key, query)
            except BusError as error:  # most often its node has crashed and is still registered
                log.debug("%s is skipped: %s", service, error)
                continue
            if name is not None:
                found[service] = [full_name(name, "srv")]
        known = {(service, *nodes) for service, nodes in self._servers.items()}
        self._service_types.evict_others(known)
        return self._with_own_names(found)

    def count(self, topic: str) -> tuple[int, int]:
        topic = self._resolve(topic.replace(HIDDEN, "/"))
        # A latched publisher counts twice: the count changes when it becomes known to be latched.
        publishers = len(self._publishers.get(topic, ())) + len(self._latched(topic))
        return publishers, len(self._subscribers.get(topic, ()))

    def publishers(self, topic: str) -> list[Endpoint]:
        topic = self._resolve(topic)
        has_latched = bool(self._latched(topic))
        found = []
        for node, type_name in self._others(self._publishers, topic):
            if self._is_known(type_name, node, topic):
                # A publisher that has sent nothing yet is assumed to be latched if any other is.
                is_latched = self._is_latched.get((topic, node), has_latched)
                durability = Durability.TRANSIENT_LOCAL if is_latched else Durability.VOLATILE
                found.append(Endpoint(node, type_name, QosProfile(durability=durability, depth=1)))
        return found

    def _latched(self, topic: str) -> list[str]:
        """The publishers that are known to be latched."""
        known = list(self._is_latched.items())  # a copy: other threads add to it
        return [node for (name, node), is_latched in known if is_latched and name == topic]

    def subscribers(self, topic: str) -> list[Endpoint]:
        topic = self._resolve(topic)
        return [
            Endpoint(node, type_name, QosProfile(depth=0))
            for node, type_name in self._others(self._subscribers, topic)
        ]

    def _others(self, graph: _Graph, topic: str) -> list[tuple[str, str]]:
        type_name = self._types.get(topic)
        if type_name is None:
            return []
        return [(node, type_name) for node in graph.get(topic, ()) if node != self.name]

    def _is_known(self, type_name: str, node: str, topic: str) -> bool:
        """Whether the definition of the type is known, or known to be unavailable.

        The definition of a type that is not installed here is fetched from the node.
        """
        with suppress(UnknownTypeError):
            self._definition(type_name)
            return True
        query = partial(fetch_definition, self._master.uri, self.name, node, topic)
        try:
            definition = self._definitions.get((topic, node), query)
        except BusError as error:
            self._warn_once(
                type_name, f"is not installed here, and its publisher does not tell it: {error}"
            )
            return True
        if definition is None:
            return False
        if self._remote_definitions.setdefault(type_name, definition) != definition:
            self._warn_once(
                type_name,
                f"of {node} is defined differently now: restart the appliance to receive it",
            )
        return True

    def _warn_once(self, type_name: str, problem: str) -> None:
        if type_name not in self._warned:
            self._warned.add(type_name)
            log.warning("%s %s", type_name, problem)

    def _definition(self, type_name: str) -> Definition:
        remote = self._remote_definitions.get(type_name)
        return remote if remote is not None else _installed(type_name)

    def describe(self, type_name: str) -> TypeDescription:
        action = describe_action(type_name, self.describe)
        if action is not None:
            return action
        return describe(type_name, self._definition(type_name).text)

    def resolve(self, topic: str) -> str:
        return self._resolve(topic)

    def _resolve(self, name: str) -> str:
        return str(self._rospy.resolve_name(name)) if self._arguments else name

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
        if HIDDEN in topic:
            return self._action_clients.subscribe(topic, type_name, callback)
        is_latched = qos.durability is Durability.TRANSIENT_LOCAL
        definition = self._definition(type_name)
        topic = self._resolve(topic)
        contained = self._contained("ros.message", callback)
        return Ros1Subscription(self._rospy, self, topic, definition, is_latched, contained)

    def track_latching(self, topic: str, node: str, is_latched: bool) -> bool:
        """Note whether a publisher is latched. Returns whether that has changed."""
        key = topic, node
        before = self._is_latched.get(key)
        if before is is_latched:
            return False
        self._is_latched[key] = is_latched
        return is_latched or before is not None

    def release_later(self, subscription: Ros1Subscription) -> None:
        """Call `release` of the subscription after the next refresh of the graph."""
        self._holding[subscription] = None

    def cancel_release(self, subscription: Ros1Subscription) -> None:
        """Do not call it: the subscription holds no messages."""
        self._holding.pop(subscription, None)

    def create_publisher(self, topic: str, type_name: str, qos: QosProfile) -> Ros1Publisher:
        return Ros1Publisher(self._rospy, topic, self._definition(type_name), qos)

    # Services

    def action_type(self, action: str) -> str | None:
        """The type `pkg/action/Name` of an action, None when it has no server."""
        return self._actions.get(action)

    def action_servers(self, action: str) -> list[str]:
        """The nodes that serve an action."""
        return self._publishers.get(f"{action}/result", [])

    def create_client(self, service: str, type_name: str) -> RosClient:
        if HIDDEN in service:
            return self._action_clients.create_client(service, type_name)
        return Ros1Client(self, self._resolve(service), installed_service(type_name))

    @property
    def master_uri(self) -> str:
        """The URI of the Master."""
        return self._master.uri

    def is_served(self, service: str) -> bool:
        """Whether a service is on the graph."""
        return service in self._servers

    def call_failed(self, service: str) -> None:
        """Query the type of a service again, as a call of it has failed."""
        self._service_types.invalidate((service, *self._servers.get(service, ())))

    def create_service(
        self, service: str, type_name: str, callback: Callable[[bytes, Respond], None]
    ) -> Ros1Service:
        definition = installed_service(type_name)
        return Ros1Service(self._rospy, service, definition, callback, self.call_soon)


@cache
def _installed(type_name: str) -> Definition:
    return installed(type_name)
