"""The bridge between the robot's bus and the broker: it follows the graph and carries topics.

Two threads meet here. On the ROS thread the graph is looked at, subscriptions and publishers are
made, and what ROS sends is throttled, converted and left in the mailbox. On the event loop's thread
the mailbox is emptied into the broker, and what MQTT sends is converted and published on ROS at
once: a conversion takes microseconds, and rclpy's publish holds the interpreter's lock all the way
through, so that handing it to another thread would add a wake-up and free nothing.
"""

from __future__ import annotations

import asyncio
import logging
import re
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import orjson

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.mqtt.codec import Properties, Property
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ReasonCode
from appliance.ros.commands import Commands, Surroundings
from appliance.ros.convert import Converters
from appliance.ros.definitions import UnknownTypeError, describe
from appliance.ros.flows import Bridged, Direction, Echo, Flow, RouteSettings, ToMqtt, ToRos
from appliance.ros.mailbox import Counters, Mailbox
from appliance.ros.node import RosNode
from appliance.ros.schema import json_schema, topic_of

__all__ = ["Bridge", "Bridged", "RouteSettings", "RouteStatus"]

log = logging.getLogger(__name__)

CLIENT_ID = "_bridge"

#: Messages that the loop's thread publishes before it lets others have their turn.
BATCH = 64

SCHEMA_PROPERTIES: Properties = {Property.CONTENT_TYPE: "application/schema+json"}

#: Every so many looks at the graph (some 2 s) the number of endpoints is not trusted: one may have
#: been replaced by another.
THOROUGH_LOOK = 13


@dataclass(frozen=True, slots=True)
class RouteStatus:
    """What a route carries in one direction, and what it has counted since the start.

    `bytes` are payload on MQTT; `dropped` did not fit into the mailbox, `throttled` were above the
    rate or the budget of bytes, `skipped` not sent to slow clients, `errors` could not be converted
    or published. For commands see `Counters`.
    """

    settings: RouteSettings
    direction: Direction
    topics: tuple[Bridged, ...]
    messages: int
    bytes: int
    dropped: int
    throttled: int
    skipped: int
    errors: int
    last_error: str | None
    expired: int
    refused: int
    clamped: int
    stops: int


@dataclass(eq=False, slots=True)
class _Route:
    """A route in one direction; `pattern` is None when it is of one topic."""

    settings: RouteSettings
    direction: Direction
    counters: Counters
    pattern: re.Pattern[str] | None = None


class Bridge:
    """Carries the topics of routes between a node and the broker; belongs to the loop's thread.

    `problem` is None, or why there is no ROS (any more).
    """

    def __init__(
        self,
        node: RosNode,
        broker: Broker,
        routes: Iterable[RouteSettings],
        loop: asyncio.AbstractEventLoop,
        robot: str,
    ) -> None:
        """What is bridged is told on `{robot}/_appliance/routes`.

        Raises ValueError for a pattern in a route to ROS.
        """
        self.problem: str | None = None
        self._node = node
        self._broker = broker
        self._loop = loop
        self._topic = f"{robot}/_appliance/routes"
        self._schemas = f"{robot}/_appliance/schema/"
        #: The types whose schemas are told.
        self._told: set[str] = set()
        self._session: Session | None = None
        self._mailbox = Mailbox(self._wake)
        self._converters = Converters(lambda name: describe(node.load(name), node.load))
        #: Replaced as one by the loop's thread; the ROS thread follows at its next look.
        self._routes: list[_Route] = []
        self._followed: list[_Route] | None = None
        #: Topics that have a route by name, which goes before patterns.
        self._named: set[str] = set()
        #: By what they carry. The first belongs to the ROS thread, the second to the loop's thread,
        #: which replaces it as one and leaves to the ROS thread what is to be closed.
        self._to_mqtt: dict[tuple[str, str], ToMqtt] = {}
        self._to_ros: dict[tuple[str, str], ToRos] = {}
        self._leaving: deque[ToRos] = deque()
        #: Those to ROS by MQTT topic.
        self._receivers: dict[str, list[ToRos]] = {}
        self._subscribed: dict[str, Subscription] = {}
        self._looks = 0
        self.replace(routes)

    def replace(self, routes: Iterable[RouteSettings]) -> None:
        """Carry these routes from now on; one that was there before does not notice.

        Raises ValueError for a pattern in a route to ROS; nothing has changed then.
        """
        known = {(route.settings, route.direction): route for route in self._routes}
        wanted: list[_Route] = []
        for settings in routes:
            pattern = settings.pattern()
            if pattern is not None and settings.to != "mqtt":
                raise ValueError(f"{settings.ros}: a pattern can only go to MQTT")
            if settings.to != "mqtt":
                route = _Route(settings, "to_ros", Counters())
                wanted.append(known.get((settings, "to_ros"), route))
            if settings.to != "ros":
                route = _Route(settings, "to_mqtt", Counters(), pattern)
                wanted.append(known.get((settings, "to_mqtt"), route))
        self._receive_for([route for route in wanted if route.direction == "to_ros"])
        self._named = {
            route.settings.ros
            for route in wanted
            if route.direction == "to_mqtt" and route.pattern is None
        }
        self._routes = wanted

    def _receive_for(self, routes: Sequence[_Route]) -> None:
        flows: dict[tuple[str, str], ToRos] = {}
        for route in routes:
            flow = self._new_to_ros(route)
            key = flow.ros, flow.mqtt
            known = self._to_ros.get(key)
            if key in flows:
                log.warning("%s has a route already; the later one is left out", flow)
            elif known is not None and known.counters is route.counters:
                flows[key] = known
            else:
                flows[key] = flow
        before, self._to_ros = self._to_ros, flows
        for key, flow in before.items():
            if flows.get(key) is not flow:
                flow.leave()
                self._leaving.append(flow)
        for key, flow in flows.items():
            if before.get(key) is not flow:
                flow.enter()
        receivers: dict[str, list[ToRos]] = {}
        for flow in flows.values():
            receivers.setdefault(flow.mqtt, []).append(flow)
        self._receivers = receivers
        self._subscribe()

    def _new_to_ros(self, route: _Route) -> ToRos:
        settings = route.settings
        if settings.rules is None:
            return ToRos(settings, settings.ros, route.counters, self._converters, self._tell)
        around = Surroundings(self._loop, self._post, self._broker)
        return Commands(
            settings, settings.ros, route.counters, self._converters, self._tell, around
        )

    def _subscribe(self) -> None:
        """Subscribe to what the flows to ROS receive, and to nothing else."""
        session = self._session
        if session is None:
            return
        wanted: dict[str, Subscription] = {}
        for topic, flows in self._receivers.items():
            # No Local stops the echo on a topic that is bridged both ways. A retained message may
            # be an old command: it does not reach ROS, unless a route asks for it. QoS 0 loses
            # nothing here, as the link takes each message at once.
            asks = any(flow.takes_retained for flow in flows)
            wanted[topic] = Subscription(topic, 0, no_local=True, retain_handling=0 if asks else 2)
        before, self._subscribed = self._subscribed, wanted
        for topic, subscription in wanted.items():
            if before.get(topic) != subscription:
                self._broker.subscribe(session, subscription)
                self._broker.send_retained(session, subscription, True)
        for topic in before.keys() - wanted.keys():
            self._broker.unsubscribe(session, topic)

    def _add_to_mqtt(self, route: _Route, ros: str) -> None:
        flow = ToMqtt(
            route.settings, ros, route.counters, self._converters, self._tell, self._mailbox
        )
        key = flow.ros, flow.mqtt
        if key in self._to_mqtt:
            text = "%s has a route already; the later one is left out"
            self._tell(logging.WARNING, text, flow)
            return
        self._to_mqtt[key] = flow
        self._pair(key)

    def _pair(self, key: tuple[str, str]) -> None:
        """Let the two flows of a topic that goes both ways know their echo."""
        there, back = self._to_mqtt.get(key), self._to_ros.get(key)
        if there is not None and back is not None and (back.echo is None or there.echo is None):
            there.echo = back.echo = Echo()

    # The loop's thread

    def start(self) -> None:
        """Subscribe on MQTT, and join the bus in the background."""
        self._session = self._broker.attach(
            CLIENT_ID,
            _Link(self._receive, None),
            lambda origin: _Link(self._receive, origin),
        )
        self._subscribe()
        self._announce(())
        self._node.start(self._look, self._failed)

    async def stop(self) -> None:
        """Leave the bus, hand over what it had sent, and leave the broker; may be called twice."""
        for command in self._to_ros.values():
            command.leave()
        await asyncio.to_thread(self._node.stop)
        session = self._session
        if session is None:
            return
        for flow in self._flows():
            flow.lost()
        while self._deliver():
            pass
        self._announce(())
        self._session = None
        self._broker.detach(session)

    def status(self) -> list[RouteStatus]:
        """Every route's state and counters, one entry a direction."""
        flows = self._flows()
        return [
            RouteStatus(
                route.settings,
                route.direction,
                tuple(
                    flow.bridged
                    for flow in flows
                    if flow.counters is route.counters and flow.bridged is not None
                ),
                route.counters.messages,
                route.counters.bytes,
                route.counters.dropped,
                route.counters.throttled,
                route.counters.skipped,
                route.counters.errors,
                route.counters.last_error,
                route.counters.expired,
                route.counters.refused,
                route.counters.clamped,
                route.counters.stops,
            )
            for route in self._routes
        ]

    def _receive(self, message: Message, retain: bool, origin: Session | None) -> None:
        for receiver in self._receivers.get(message.topic, ()):
            receiver.receive(message, retain, origin)

    def _drain(self) -> None:
        if self._deliver():
            self._loop.call_soon(self._drain)

    def _deliver(self) -> bool:
        """Publish what waits in the mailbox, up to a batch; True when there may be more."""
        session = self._session
        if session is None:
            return False
        batch, has_more = self._mailbox.take(BATCH)
        publish = self._broker.publish
        for lane, message in batch:
            counters = lane.counters
            counters.messages += 1
            counters.bytes += len(message.payload)
            publish(message, session)
        self._broker.flush()
        return has_more

    def _announce(self, bridged: Sequence[Bridged]) -> None:
        if self._session is not None:
            payload = orjson.dumps(bridged)
            self._broker.publish(Message(self._topic, payload, 0, True), self._session)
            self._tell_schemas({entry.type for entry in bridged}, self._session)
            self._broker.flush()

    def _tell_schemas(self, types: set[str], session: Session) -> None:
        for name in sorted(types ^ self._told):
            payload = b""
            if name in types:
                try:
                    payload = orjson.dumps(json_schema(self._converters.get(name).description))
                except UnknownTypeError as error:  # which only `cdr` can carry
                    log.warning("there is no schema of %s: %s", name, error)
                    continue
            topic = self._schemas + topic_of(name)
            self._broker.publish(
                Message(topic, payload, 0, True, SCHEMA_PROPERTIES if payload else None), session
            )
        self._told = types

    def _stopped(self, reason: str) -> None:
        self.problem = reason
        log.warning("there is no bridge to ROS: %s", reason)

    # Any thread

    def _wake(self) -> None:
        self._post(self._drain)

    def _tell(self, level: int, text: str, *args: object) -> None:
        if log.isEnabledFor(level):
            self._post(log.log, level, text, *args)

    def _post(self, callback: Callable[..., object], *args: object) -> None:
        try:
            self._loop.call_soon_threadsafe(callback, *args)
        except RuntimeError:  # the loop is closed: there is nobody to hear it
            log.debug("the event loop is closed")

    def _flows(self) -> list[Flow]:
        return [*self._to_mqtt.copy().values(), *self._to_ros.values()]

    # The ROS thread

    def _look(self) -> None:
        """Follow what has come and gone on the graph."""
        if self._looks == 0:
            self._tell(logging.INFO, "on ROS as %s", self._node.name)
        is_thorough = self._looks % THOROUGH_LOOK == 0
        self._looks += 1
        has_changed = self._follow_routes()
        self._match_patterns()
        for flow in self._flows():
            has_changed |= flow.look(self._node, is_thorough)
        if has_changed:
            self._post(self._announce, self._bridged())

    def _follow_routes(self) -> bool:
        """Begin and end flows as the routes have changed; True when what is bridged has changed."""
        routes = self._routes
        if routes is self._followed:
            return False
        self._followed = routes
        has_changed = False
        while self._leaving:
            has_changed = True
            self._leaving.popleft().close()
        kept = {id(route.counters) for route in routes}
        for key, flow in list(self._to_mqtt.items()):
            if id(flow.counters) not in kept or (flow.is_matched and flow.ros in self._named):
                has_changed = True
                flow.close()
                del self._to_mqtt[key]
        there = {id(flow.counters) for flow in self._to_mqtt.values()}
        for route in routes:
            is_named = route.direction == "to_mqtt" and route.pattern is None
            if is_named and id(route.counters) not in there:
                self._add_to_mqtt(route, route.settings.ros)
        for key in self._to_ros:
            self._pair(key)
        return has_changed

    def _match_patterns(self) -> None:
        """Begin flows for topics that have come, end those of topics that have gone."""
        patterns = [route for route in self._routes if route.pattern is not None]
        if not patterns:
            return
        names = self._node.topics()
        for key, flow in list(self._to_mqtt.items()):
            if flow.is_matched and flow.ros not in names:
                flow.close()
                del self._to_mqtt[key]
        taken = self._named | {flow.ros for flow in self._to_mqtt.values()}
        for route in patterns:
            assert route.pattern is not None
            for ros in names:
                if ros not in taken and route.pattern.fullmatch(ros):
                    taken.add(ros)
                    self._add_to_mqtt(route, ros)

    def _failed(self, reason: str) -> None:
        for flow in self._flows():
            flow.lost()
        self._post(self._stopped, reason)
        self._post(self._announce, ())

    def _bridged(self) -> list[Bridged]:
        return [flow.bridged for flow in self._flows() if flow.bridged is not None]


class _Link:
    """The bridge as the link of its session: it takes everything at once, of one publisher."""

    writable = True

    def __init__(
        self, receive: Callable[[Message, bool, Session | None], None], origin: Session | None
    ) -> None:
        self._receive = receive
        self._origin = origin

    def publish(
        self,
        message: Message,
        qos: int,
        packet_id: int,
        dup: bool,
        retain: bool,
        subscription_ids: list[int] | None,
    ) -> None:
        """A message for ROS."""
        self._receive(message, retain, self._origin)

    def mirror(self, packet: bytes, version: int, payload_size: int) -> bool:
        """It takes messages, not packets."""
        return False

    def pubrel(self, packet_id: int) -> None:
        """Its subscriptions are of QoS 0."""

    def is_behind(self) -> bool:
        """It takes everything at once."""
        return False

    def later(self) -> None:
        """It asks for no retained messages, so that there is nothing to go on with."""

    def close(self, reason: ReasonCode, message: str) -> None:
        """There is no connection to close."""
