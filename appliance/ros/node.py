"""The bridge's node on the robot's bus: the protocol of a bus adapter, and a fake for tests."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Protocol, TypeAlias

from appliance.net.callbacks import Entries
from appliance.ros.payload.definitions import (
    CDR,
    Serialization,
    TypeDescription,
    UnknownTypeError,
    describe,
)


class BusError(Exception):
    """The bus has refused something; the message says what and why."""


class Reliability(Enum):
    """Whether a lost sample is sent again (REP 2003)."""

    BEST_EFFORT = "best effort"
    RELIABLE = "reliable"


class Durability(Enum):
    """Whether a late subscriber receives the last samples (REP 2003)."""

    VOLATILE = "volatile"
    TRANSIENT_LOCAL = "transient local"


@dataclass(frozen=True, slots=True)
class QosProfile:
    """The QoS of an endpoint; `depth` is in samples, 0 if it is not known."""

    reliability: Reliability = Reliability.RELIABLE
    durability: Durability = Durability.VOLATILE
    depth: int = 10

    def satisfies(self, requested: QosProfile) -> bool:
        """Whether a publisher with this profile matches a subscription that has `requested`."""
        return (
            self.reliability is Reliability.RELIABLE
            or requested.reliability is Reliability.BEST_EFFORT
        ) and (
            self.durability is Durability.TRANSIENT_LOCAL
            or requested.durability is Durability.VOLATILE
        )

    def __str__(self) -> str:
        depth = f", depth {self.depth}" if self.depth else ""
        return f"{self.reliability.value}, {self.durability.value}{depth}"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A publisher or subscription that another node has on a topic.

    `node` is that node's full name, `type` as in `std_msgs/msg/String`, `type_hash` as in
    `RIHS01_…` (REP 2011), None where the bus does not report it.
    """

    node: str
    type: str
    qos: QosProfile
    type_hash: str | None = None


class RosSubscription(Protocol):
    """A subscription of this node."""

    def destroy(self) -> None:
        """End it: the callback is not called again, except for messages that the loop's thread has
        taken already. On the ROS thread."""

    def take_lost(self) -> int:
        """How many messages the middleware has lost since the last call, as far as it reports
        losses: mostly when another message follows them. On the ROS thread."""


class RosPublisher(Protocol):
    """A publisher of this node."""

    def publish(self, cdr: bytes) -> None:
        """Publish a serialized message; from any thread. Raises BusError."""

    @property
    def has_subscribers(self) -> bool:
        """Whether a subscription is connected to it; from any thread."""

    def destroy(self) -> None:
        """End it; `publish` raises BusError from now on. On the ROS thread."""


class RosClient(Protocol):
    """A client of a service. Its methods are for the ROS thread."""

    def is_ready(self) -> bool:
        """Whether a server has been found; false again when the last one is gone."""

    def call(self, request: bytes, done: Callable[[bytes | BusError], None]) -> Callable[[], None]:
        """Send a serialized request; `done` is called with the response, on the ROS thread.

        That may be never: there is no timeout, and servers vanish. Returns a function that cancels
        the call: `done` is not called after it. Raises BusError.
        """

    def destroy(self) -> None:
        """End it; calls that are under way get no response any more."""


#: Takes a batch of messages as CDR, each with the time at which it was published, in nanoseconds
#: since the epoch, or 0; how many others were lost for lack of room; and whether newer messages
#: have been queued behind them for so long that this is no burst.
TakeBatch: TypeAlias = Callable[[list[tuple[bytes, int]], int, bool], None]


#: Sends the serialized response to a request, or none for None; called once, on the ROS thread.
Respond: TypeAlias = Callable[[bytes | None], None]


class RosService(Protocol):
    """A service that this node offers."""

    def destroy(self) -> None:
        """End it. On the ROS thread."""


class ParameterServer(Protocol):
    """The parameters of a whole bus. Its methods are for the ROS thread; all raise BusError."""

    def names(self) -> list[str]:
        """The full names of all parameters."""

    def get(self, names: Sequence[str]) -> dict[str, Any]:
        """The values of those that are there: as JSON knows values, and bytes."""

    def set(self, name: str, value: Any) -> None:
        """Set one, which need not be there yet. Integers have 32 bits."""


class RosNode(Protocol):
    """A node on the robot's bus, with a thread of its own: the ROS thread.

    `start`, `stop`, `call_soon` and `RosPublisher.publish` may be called from any thread, all else
    only from inside the callbacks, which are called on the ROS thread. Only those of a subscription
    may be called on another, one at a time.

    CDR stands for the bus's own serialized bytes here; `serialization` says which they are.
    """

    #: The node's full name, such as `/appliance`.
    name: str
    #: How messages are serialized on the bus.
    serialization: Serialization
    #: The server of all parameters; None if every node has its own, with services for them.
    parameter_server: ParameterServer | None

    @property
    def obstacle(self) -> str | None:
        """What keeps the bus from being joined, or its nodes from being seen, for now: one line;
        from any thread."""

    def start(
        self,
        poll: Callable[[], None],
        failed: Callable[[str], None],
        entries: Entries | None = None,
    ) -> None:
        """Join the bus in the background and return at once.

        `poll` is called when the node is there and then 5 to 10 times a second, to follow the
        graph. `failed` is called once, with one line, when the bus cannot be joined or the
        node ends by itself; nothing is called after it, until the node is started again.
        `entries` are of the loop whose thread may take messages itself, and counts the faults.
        """

    def stop(self) -> None:
        """Leave the bus and wait until the ROS thread has ended; may be called twice."""

    def call_soon(self, callback: Callable[[], None]) -> None:
        """Call it on the ROS thread. Raises BusError when there is none."""

    def now(self) -> int:
        """ROS's time in nanoseconds since the epoch; from any thread. With `use_sim_time` it is the
        simulation's: 0 until the first message of /clock, as in every node."""

    def nodes(self) -> list[str]:
        """The full names of all known nodes on the bus, including this one."""

    def topics(self) -> dict[str, list[str]]:
        """The types of each topic that has an endpoint, including this node's.

        What a remapping of this node leads to has the remapped name, here and in `services`.
        """

    def services(self) -> dict[str, list[str]]:
        """The types of each service that has a server, including this node's.

        An action's services are among them: `/name/_action/send_goal` and so on.
        """

    def count(self, topic: str) -> tuple[int, int]:
        """The number of publishers and subscriptions, including our own; the cheapest query."""

    def publishers(self, topic: str) -> list[Endpoint]:
        """The publishers of other nodes."""

    def subscribers(self, topic: str) -> list[Endpoint]:
        """The subscriptions of other nodes."""

    def describe(self, type_name: str) -> TypeDescription:
        """The description of a type such as `std_msgs/msg/String`; from any thread.

        Raises UnknownTypeError, and BusError if it is not known yet.
        """

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
        """Call `callback` with each message, as CDR. If `timed`, for a few messages also with the
        time at which they were published, in nanoseconds since the epoch.

        If the bus can wake the event loop itself, `on_loop` is called instead for small messages,
        on the loop's thread: that saves waking the ROS thread for each of them. The two are never
        called at once, and all messages come in their order.

        Raises BusError, UnknownTypeError.
        """

    def resolve(self, topic: str) -> str:
        """The name on the bus of a topic, or of an action's, after remapping."""

    def create_publisher(self, topic: str, type_name: str, qos: QosProfile) -> RosPublisher:
        """Make a publisher of serialized messages. Raises BusError, UnknownTypeError."""

    def create_client(self, service: str, type_name: str) -> RosClient:
        """Make a client of a service such as `std_srvs/srv/Trigger`, or of a service of an action:
        `pkg/action/Name_SendGoal`, `pkg/action/Name_GetResult`.

        Raises BusError, UnknownTypeError.
        """

    def create_service(
        self, service: str, type_name: str, callback: Callable[[bytes, Respond], None]
    ) -> RosService:
        """Call `callback` with each serialized request. Raises BusError, UnknownTypeError."""


# The fake, for tests


@dataclass(eq=False, slots=True)
class FakePeer:
    """An endpoint of another node on a FakeNode's bus; a subscription fills `received`."""

    bus: FakeNode
    topic: str
    endpoint: Endpoint
    received: list[bytes] = field(default_factory=list)
    latched: list[bytes] = field(default_factory=list)

    def publish(self, cdr: bytes) -> None:
        """Publish to all subscriptions that match; transient local ones keep the last samples."""
        if self.endpoint.qos.durability is Durability.TRANSIENT_LOCAL:
            self.latched = [*self.latched, cdr][-(self.endpoint.qos.depth or 1) :]
        self.bus.deliver(self.topic, self.endpoint, cdr)

    def remove(self) -> None:
        """The other node ends this endpoint, or vanishes."""
        for peers in (self.bus.remote_publishers, self.bus.remote_subscribers):
            if self in peers:
                peers.remove(self)
        self.bus.spin()


@dataclass(eq=False, slots=True)
class FakeSubscription:
    """A subscription of a FakeNode."""

    bus: FakeNode
    topic: str
    endpoint: Endpoint
    callback: Callable[..., None]
    on_loop: TakeBatch | None = None
    #: The losses that `take_lost` has not returned yet.
    lost: int = 0

    def take(self, cdr: bytes) -> None:
        """A message has come for it."""
        if self.bus.takes_on_loop and self.on_loop is not None:
            self.on_loop([(cdr, 0)], 0, False)
        else:
            self.callback(cdr)

    def take_lost(self) -> int:
        lost, self.lost = self.lost, 0
        return lost

    def destroy(self) -> None:
        self.bus.subscriptions.remove(self)


@dataclass(eq=False, slots=True)
class FakePublisher:
    """A publisher of a FakeNode; with `error` set, publishing is refused."""

    bus: FakeNode
    topic: str
    endpoint: Endpoint
    error: str | None = None
    destroyed: bool = False

    def publish(self, cdr: bytes) -> None:
        if self.error or self.destroyed:
            raise BusError(self.error or "the publisher has been destroyed")
        self.bus.deliver(self.topic, self.endpoint, cdr)

    @property
    def has_subscribers(self) -> bool:
        peers = self.bus.remote_subscribers
        return any(peer.topic == self.topic for peer in peers)

    def destroy(self) -> None:
        self.destroyed = True
        self.bus.own_publishers.remove(self)


@dataclass(eq=False, slots=True)
class FakeService:
    """A service of another node (`handler` answers) or of a FakeNode."""

    bus: FakeNode
    name: str
    type: str
    handler: Callable[[bytes, Respond], None]

    def remove(self) -> None:
        """The other node ends it, or vanishes."""
        self.bus.remote_services.remove(self)
        self.bus.spin()

    def destroy(self) -> None:
        self.bus.own_services.remove(self)


@dataclass(eq=False, slots=True)
class FakeClient:
    """A FakeNode's client of a service."""

    bus: FakeNode
    name: str
    type: str

    def _servers(self) -> list[FakeService]:
        return [
            service
            for service in (*self.bus.remote_services, *self.bus.own_services)
            if (service.name, service.type) == (self.name, self.type)
        ]

    def is_ready(self) -> bool:
        return bool(self._servers())

    def call(self, request: bytes, done: Callable[[bytes | BusError], None]) -> Callable[[], None]:
        waiting = [done]

        def respond(response: bytes | None) -> None:
            if waiting and response is not None and self in self.bus.clients:
                waiting.pop()(response)

        for server in self._servers()[:1]:
            server.handler(request, respond)
        return waiting.clear

    def destroy(self) -> None:
        self.bus.clients.remove(self)


class FakeNode:
    """A RosNode on a bus of its own, without threads: everything happens in the caller's.

    A test adds and removes endpoints of other nodes, and each time the bridge polls the graph at
    once. Messages reach subscriptions whose QoS and type match, including our own, as on a real
    bus. `types` are the types that can be loaded; None: any, as an empty class. With
    `takes_on_loop` set, `on_loop` of subscriptions is called, in the caller's thread.
    """

    serialization = CDR
    parameter_server: ParameterServer | None = None
    obstacle: str | None = None

    def __init__(self, name: str = "/appliance", types: Mapping[str, type[Any]] | None = None):
        self.name = name
        self.types = types
        self.running = False
        #: The names of remapped topics on the bus.
        self.remapped: dict[str, str] = {}
        self.takes_on_loop = False
        self.remote_publishers: list[FakePeer] = []
        self.remote_subscribers: list[FakePeer] = []
        self.subscriptions: list[FakeSubscription] = []
        self.own_publishers: list[FakePublisher] = []
        self.remote_services: list[FakeService] = []
        self.own_services: list[FakeService] = []
        self.clients: list[FakeClient] = []
        self._poll: Callable[[], None] | None = None
        self._failed: Callable[[str], None] | None = None

    # What a test does, and the other nodes

    def add_publisher(
        self,
        topic: str,
        type_name: str,
        qos: QosProfile | None = None,
        *,
        node: str = "/other",
        type_hash: str | None = None,
    ) -> FakePeer:
        """Another node gets a publisher."""
        peer = FakePeer(self, topic, Endpoint(node, type_name, qos or QosProfile(), type_hash))
        self.remote_publishers.append(peer)
        self.spin()
        return peer

    def add_subscriber(
        self,
        topic: str,
        type_name: str,
        qos: QosProfile | None = None,
        *,
        node: str = "/other",
        type_hash: str | None = None,
    ) -> FakePeer:
        """Another node subscribes."""
        peer = FakePeer(self, topic, Endpoint(node, type_name, qos or QosProfile(), type_hash))
        self.remote_subscribers.append(peer)
        self.spin()
        return peer

    def add_service(
        self, name: str, type_name: str, handler: Callable[[bytes, Respond], None]
    ) -> FakeService:
        """Another node offers a service."""
        service = FakeService(self, name, type_name, handler)
        self.remote_services.append(service)
        self.spin()
        return service

    def ask(self, name: str, request: bytes, done: Callable[[bytes | None], None]) -> None:
        """Another node calls a service of this one; nothing happens when there is none."""
        for service in self.own_services:
            if service.name == name:
                service.handler(request, done)

    def spin(self) -> None:
        """Let the bridge poll the graph."""
        if self.running and self._poll:
            self._poll()

    def fail(self, reason: str) -> None:
        """The node ends by itself."""
        self.stop()
        if self._failed:
            self._failed(reason)

    def deliver(self, topic: str, publisher: Endpoint, cdr: bytes) -> None:
        """Deliver a message to the subscriptions that match."""

        def matches(other_topic: str, other: Endpoint) -> bool:
            return (
                other_topic == topic
                and other.type == publisher.type
                and publisher.qos.satisfies(other.qos)
            )

        for peer in list(self.remote_subscribers):
            if matches(peer.topic, peer.endpoint):
                peer.received.append(cdr)
        for subscription in list(self.subscriptions):
            if matches(subscription.topic, subscription.endpoint):
                subscription.take(cdr)

    # RosNode

    def start(
        self,
        poll: Callable[[], None],
        failed: Callable[[str], None],
        entries: Entries | None = None,
    ) -> None:
        self._poll = poll
        self._failed = failed
        self.running = True
        poll()

    def stop(self) -> None:
        self.running = False
        self.subscriptions.clear()
        self.clients.clear()
        self.own_services.clear()
        for publisher in list(self.own_publishers):
            publisher.destroy()

    def call_soon(self, callback: Callable[[], None]) -> None:
        if not self.running:
            raise BusError("ROS is not ready")
        callback()

    def services(self) -> dict[str, list[str]]:
        found: dict[str, set[str]] = {}
        for service in (*self.remote_services, *self.own_services):
            found.setdefault(service.name, set()).add(service.type)
        return {name: sorted(types) for name, types in found.items()}

    def now(self) -> int:
        return time.time_ns()

    def resolve(self, topic: str) -> str:
        return self.remapped.get(topic, topic)

    def nodes(self) -> list[str]:
        ends = [*self.remote_publishers, *self.remote_subscribers]
        return [self.name, *sorted({end.endpoint.node for end in ends})]

    def topics(self) -> dict[str, list[str]]:
        found: dict[str, set[str]] = {}
        for topic, endpoint in (*self._all_publishers(), *self._all_subscribers()):
            found.setdefault(topic, set()).add(endpoint.type)
        return {topic: sorted(types) for topic, types in found.items()}

    def count(self, topic: str) -> tuple[int, int]:
        return (
            sum(name == topic for name, _ in self._all_publishers()),
            sum(name == topic for name, _ in self._all_subscribers()),
        )

    def _all_publishers(self) -> list[tuple[str, Endpoint]]:
        return [(end.topic, end.endpoint) for end in self.remote_publishers] + [
            (end.topic, end.endpoint) for end in self.own_publishers
        ]

    def _all_subscribers(self) -> list[tuple[str, Endpoint]]:
        return [(end.topic, end.endpoint) for end in self.remote_subscribers] + [
            (end.topic, end.endpoint) for end in self.subscriptions
        ]

    def publishers(self, topic: str) -> list[Endpoint]:
        return [peer.endpoint for peer in self.remote_publishers if peer.topic == topic]

    def subscribers(self, topic: str) -> list[Endpoint]:
        return [peer.endpoint for peer in self.remote_subscribers if peer.topic == topic]

    def describe(self, type_name: str) -> TypeDescription:
        return describe(self.load(type_name), self.load)

    def load(self, type_name: str) -> type[Any]:
        """The class of a type. Raises UnknownTypeError."""
        if self.types is None:
            return type(type_name.rpartition("/")[2], (), {})
        if type_name not in self.types:
            package = type_name.partition("/")[0]
            raise UnknownTypeError(f"no {type_name}: the package {package} is not installed here")
        return self.types[type_name]

    def subscribe_raw(
        self,
        topic: str,
        type_name: str,
        qos: QosProfile,
        callback: Callable[..., None],
        *,
        timed: bool = False,
        on_loop: TakeBatch | None = None,
    ) -> FakeSubscription:
        self.load(type_name)
        own = FakeSubscription(self, topic, Endpoint(self.name, type_name, qos), callback, on_loop)
        self.subscriptions.append(own)
        if qos.durability is Durability.TRANSIENT_LOCAL:
            for peer in self.remote_publishers:
                if (
                    peer.topic == topic
                    and peer.endpoint.type == type_name
                    and peer.endpoint.qos.satisfies(qos)
                ):
                    for cdr in peer.latched:
                        own.take(cdr)
        return own

    def create_publisher(self, topic: str, type_name: str, qos: QosProfile) -> FakePublisher:
        self.load(type_name)
        own = FakePublisher(self, topic, Endpoint(self.name, type_name, qos))
        self.own_publishers.append(own)
        return own

    def create_client(self, service: str, type_name: str) -> FakeClient:
        client = FakeClient(self, service, type_name)
        self.clients.append(client)
        return client

    def create_service(
        self, service: str, type_name: str, callback: Callable[[bytes, Respond], None]
    ) -> FakeService:
        own = FakeService(self, service, type_name, callback)
        self.own_services.append(own)
        return own
