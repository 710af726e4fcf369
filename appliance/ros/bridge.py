"""The bridge between the robot's bus and the broker: it follows the graph and carries topics.

Two threads meet here. On the ROS thread the graph is looked at, subscriptions and publishers are
made, and what ROS sends is throttled, converted and left in the mailbox. On the event loop's thread
the mailbox is emptied into the broker, and what MQTT sends is converted and published on ROS at
once: a conversion takes microseconds, and rclpy's publish holds the interpreter's lock all the way
through, so that handing it to another thread would add a wake-up and free nothing. For the same
reason small messages from ROS are taken, converted and published on the loop's thread right away,
where the node can do that.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from time import time_ns
from typing import Literal, TypeAlias

import orjson

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.ports import InsideLink
from appliance.broker.session import Session
from appliance.mqtt.codec import Properties, Property
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ReasonCode
from appliance.net.callbacks import Entries, PeriodicCallback
from appliance.ros.calls.routes import CallBridge, CallRoutes
from appliance.ros.diagnostics import Diagnostics
from appliance.ros.mailbox import Lane, Mailbox
from appliance.ros.node import RosNode
from appliance.ros.payload.converter import Converters
from appliance.ros.payload.definitions import UnknownTypeError
from appliance.ros.payload.encodings.registry import CONTENT_TYPE
from appliance.ros.payload.schema import json_schema, topic_of
from appliance.ros.retained_cleanup import TopicOwners, is_of_route
from appliance.ros.ros2.discovery import TWIN, TWIN_ADVICE
from appliance.ros.skipped import Skipped, ordered, summary
from appliance.ros.status import RouteStatus, TopicStatus, route_status, topic_status
from appliance.ros.topics.commands import Commands
from appliance.ros.topics.conversions import LITTLE, ConversionQueue, size_of
from appliance.ros.topics.flow import (
    BridgedTopic,
    BridgeRoute,
    Direction,
    EchoFilter,
    Flow,
    TopicSettings,
)
from appliance.ros.topics.lease import BRIDGE_CLIENT_ID, Leases
from appliance.ros.topics.staleness import StalenessDetector
from appliance.ros.topics.to_mqtt import ToMqtt
from appliance.ros.topics.to_ros import ToRos, ToRosContext

__all__ = ["Bridge", "BridgedTopic", "BusState", "RouteStatus", "TopicSettings", "TopicStatus"]

log = logging.getLogger(__name__)


#: Messages that the loop's thread publishes before it lets others have their turn.
BATCH = 64

#: Every so many looks at the graph (within a second) a topic's number of endpoints is not trusted:
#: one may have been replaced by another. At each look it is the turn of some topics.
THOROUGH_LOOK = 5

#: Every so many looks the other nodes are counted; and how often in a row another node of the same
#: name is there until it is told: one that was killed is seen for 20 s more.
COUNTED_LOOK = 10
TWIN_LOOKS = 15

#: Seconds until ROS is tried again when it could not be joined or was lost; each time twice as
#: many, up to the second of these.
RETRY = 1.0
LONGEST_RETRY = 60.0

#: Seconds between two looks at the counters, for the rates; and how many of these it takes until
#: what is bridged is told again for the figures in it.
METER_INTERVAL = 1.0
METERS_TO_ANNOUNCE = 10

#: Seconds until the mailbox is emptied again, when that went wrong.
DRAIN_AGAIN = 0.05

BusState: TypeAlias = Literal["waiting", "joined", "lost"]

JSON_PROPERTIES: Properties = {Property.CONTENT_TYPE: CONTENT_TYPE["json"]}
SCHEMA_PROPERTIES: Properties = {Property.CONTENT_TYPE: "application/schema+json"}


class Bridge:
    """Carries the topics of routes between a node and the broker; belongs to the loop's thread.

    `problem` is None, or why there is no ROS, or none any more; it is tried again and again.
    `peers` is how many other nodes were seen, None while the bus is not joined.
    """

    def __init__(
        self,
        node: RosNode,
        broker: Broker,
        routes: Iterable[TopicSettings],
        loop: asyncio.AbstractEventLoop,
        robot: str,
        calls: CallRoutes | None = None,
        *,
        diagnostics: float = 0.0,
    ) -> None:
        """What is bridged is told on `{robot}/_appliance/routes`, what is not on `…/skipped`, and
        every so many seconds how it goes on `/diagnostics`, not at all for 0.
        """
        self.problem: str | None = None
        self.peers: int | None = None
        self._twin_looks = 0
        self._was_joined = False
        self._joined_at: float | None = None
        self._retry = RETRY
        self._retry_timer: asyncio.TimerHandle | None = None
        self._is_stopping = False
        self._node = node
        self._broker = broker
        self._loop = loop
        self._faults = broker.faults
        self._entries = entries = Entries(loop, broker.faults)
        self._topic = f"{robot}/_appliance/routes"
        self._skipped_topic = f"{robot}/_appliance/skipped"
        self._schemas = f"{robot}/_appliance/schema/"
        #: The types whose schemas are told.
        self._told: set[str] = set()
        self._session: Session | None = None
        #: What leftovers are being looked for with.
        self._owners: TopicOwners | None = None
        self._mailbox = Mailbox(self._wake)
        self._converters = Converters(node.describe, node.now)
        self._turns = ConversionQueue(entries, broker.accounting)
        self._around = ToRosContext(
            entries, self._post, broker, Leases(), self._turns, StalenessDetector()
        )
        self._diagnostics = Diagnostics(robot, broker, self, diagnostics) if diagnostics else None
        self._meter_timer: PeriodicCallback | None = None
        self._metered = 0
        #: What was last told of what is bridged.
        self._announced = b""
        self._announced_skips = b""
        #: Replaced as one by the loop's thread; the ROS thread follows at its next look.
        self._routes: list[BridgeRoute] = []
        self._followed: list[BridgeRoute] | None = None
        #: Topics that have a route by name, which goes before patterns.
        self._named: dict[Direction, set[str]] = {"to_mqtt": set(), "to_ros": set()}
        #: The topics when patterns were last matched, and those that no pattern took.
        self._topics: dict[str, list[str]] | None = None
        self._refused: list[Skipped] = []
        #: By what they carry. These belong to the ROS thread; those to ROS only as far as patterns
        #: found them, of which the loop's thread is told when they can be received for.
        self._to_mqtt: dict[tuple[str, str], ToMqtt] = {}
        self._found: dict[tuple[str, str], ToRos] = {}
        self._ready: list[ToRos] = []
        #: All to ROS that are received for. They belong to the loop's thread, which replaces them
        #: as one and leaves to the ROS thread what is to be closed.
        self._to_ros: dict[tuple[str, str], ToRos] = {}
        self._matched: list[ToRos] = []
        self._leaving: deque[ToRos] = deque()
        #: Those to ROS by MQTT topic.
        self._receivers: dict[str, list[ToRos]] = {}
        self._subscribed: dict[str, Subscription] = {}
        self._looks = 0
        self._is_joined = False
        #: Services, actions and parameters.
        self.calls = CallBridge(
            node,
            broker,
            entries,
            self._converters,
            self._mailbox,
            self._post,
            self._announce,
            self._turns,
        )
        self.replace(routes)
        self.calls.replace(calls or CallRoutes())

    def replace(self, routes: Iterable[TopicSettings]) -> None:
        """Carry these routes from now on; one that was there before does not notice."""
        known = {(route.settings, route.direction): route for route in self._routes}
        wanted: list[BridgeRoute] = []
        directions: tuple[tuple[Direction, str], ...] = (("to_ros", "mqtt"), ("to_mqtt", "ros"))
        for settings in routes:
            for direction, other in directions:
                if settings.to != other:
                    route = known.get((settings, direction))
                    wanted.append(route or BridgeRoute(settings, direction))
        self._named = {
            direction: {
                route.settings.names[0]
                for route in wanted
                if route.direction == direction and not route.is_pattern
            }
            for direction, _ in directions
        }
        self._receive_for(wanted)
        self._routes = wanted

    def _receive_for(self, routes: list[BridgeRoute]) -> None:
        flows: dict[tuple[str, str], ToRos] = {}
        for route in routes:
            if route.direction != "to_ros" or route.is_pattern:
                continue
            flow = self._new_to_ros(route, route.settings.names[0])
            key = flow.ros, flow.mqtt
            known = self._to_ros.get(key)
            if key in flows:
                log.warning("%s has a route already; the later one is left out", flow)
            elif known is not None and known.route is route:
                flows[key] = known
            else:
                flows[key] = flow
        for found in self._matched:
            if found.route in routes and found.ros not in self._named["to_ros"]:
                flows[found.ros, found.mqtt] = found
        before, self._to_ros = self._to_ros, flows
        for key, flow in before.items():
            if flows.get(key) is not flow:
                flow.leave()
                if not flow.is_matched:
                    self._leaving.append(flow)
                    flow.route.past.add(flow.counters)
        for key, flow in flows.items():
            known = before.get(key)
            if known is not flow:
                flow.enter(known)
        receivers: dict[str, list[ToRos]] = {}
        for flow in flows.values():
            receivers.setdefault(flow.mqtt, []).append(flow)
        self._receivers = receivers
        self._subscribe()

    def _receive_for_matched(self, flows: list[ToRos]) -> None:
        self._matched = flows
        self._receive_for(self._routes)

    def _new_to_ros(self, route: BridgeRoute, ros: str) -> ToRos:
        kind = ToRos if route.settings.rules is None else Commands
        return kind(route, ros, self._converters, self._tell, self._around)

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
                session.take_turn()  # it has no others to leave a turn to
        for topic in before.keys() - wanted.keys():
            self._broker.unsubscribe(session, topic)

    def _add_to_mqtt(self, route: BridgeRoute, ros: str) -> None:
        flow = ToMqtt(route, ros, self._converters, self._tell, self._mailbox, self._publish)
        key = flow.ros, flow.mqtt
        if key in self._to_mqtt:
            text = "%s has a route already; the later one is left out"
            self._tell(logging.WARNING, text, flow)
            return
        self._to_mqtt[key] = flow
        self._pair(key)

    def _add_to_ros(self, route: BridgeRoute, ros: str) -> None:
        flow = self._new_to_ros(route, ros)
        key = flow.ros, flow.mqtt
        self._found[key] = flow
        self._pair(key)

    def _pair(self, key: tuple[str, str]) -> None:
        """Let the two flows of a topic that goes both ways know their echo."""
        there = self._to_mqtt.get(key)
        back = self._found.get(key) or self._to_ros.get(key)
        if there is not None and back is not None and (back.echo is None or there.echo is None):
            there.echo = back.echo = EchoFilter(self._node.serialization)

    # The loop's thread

    def start(self) -> None:
        """Subscribe on MQTT, and join the bus in the background."""
        self._session = self._broker.attach(BRIDGE_CLIENT_ID, _Link(self._receive))
        self._subscribe()
        self._broker.departures.append(self._around.arrivals.departed)
        self.calls.start()
        self._forget_schemas(self._session)
        self.forget_leftovers()
        self._announce()
        self._meter_timer = self._entries.every("bridge.meter", METER_INTERVAL, self._meter)
        if self._diagnostics is not None:
            self._diagnostics.start(self._entries)
        self._join()

    def _join(self) -> None:
        self._node.start(self._look, self._failed, self._entries)

    def _join_later(self) -> None:
        delay, self._retry = self._retry, min(2 * self._retry, LONGEST_RETRY)
        self._retry_timer = self._entries.later(
            "bridge.join", delay, self._join, failed=self._join_later
        )

    @property
    def state(self) -> BusState:
        """Whether the bus is joined, was lost, or has not been there yet."""
        if self._joined_at is not None:
            return "joined"
        return "lost" if self._was_joined else "waiting"

    @property
    def obstacle(self) -> str | None:
        """What is in the way for now, although nothing has failed."""
        return self._node.obstacle

    async def stop(self) -> None:
        """Leave the bus, hand over what it had sent, and leave the broker; may be called twice."""
        self._is_stopping = True
        if self._retry_timer is not None:
            self._retry_timer.cancel()
        if self._meter_timer is not None:
            self._meter_timer.cancel()
        if self._diagnostics is not None:
            self._diagnostics.stop()
        for command in self._to_ros.values():
            command.leave()
        if self._around.arrivals.departed in self._broker.departures:
            self._broker.departures.remove(self._around.arrivals.departed)
        await self.calls.leave()
        await asyncio.to_thread(self._node.stop)
        session = self._session
        if session is None:
            return
        for flow in self._flows():
            flow.lost()
        while self._deliver():
            pass
        await self.calls.stop()
        self._refused = []
        self._announce()
        self._session = None
        self._broker.detach(session)

    def status(self) -> list[RouteStatus]:
        """Every route's state and counters, one entry a direction."""
        flows: dict[BridgeRoute, list[Flow]] = {}
        for flow in self._flows():
            flows.setdefault(flow.route, []).append(flow)
        return [route_status(route, flows.get(route, [])) for route in self._routes]

    def topics(self) -> list[TopicStatus]:
        """What is bridged now, with its figures."""
        return [
            topic_status(flow.bridged, flow) for flow in self._flows() if flow.bridged is not None
        ]

    def skips(self) -> list[Skipped]:
        """What routes speak of and is not bridged, and why."""
        of_flows = [skip for flow in self._flows() for skip in flow.skips()]
        return ordered([*of_flows, *self._refused, *self.calls.skips()])

    @property
    def node_name(self) -> str:
        """The full name of the bridge's node."""
        return self._node.name

    def _receive(self, message: Message, retain: bool, origin: Session | None) -> None:
        size = size_of(message.payload)
        number = self._around.arrivals.count()
        for receiver in self._receivers.get(message.topic, ()):
            self._turns_for(receiver, message, retain, origin, number, size)

    def _turns_for(
        self,
        receiver: ToRos,
        message: Message,
        retain: bool,
        origin: Session | None,
        number: int,
        size: int,
    ) -> None:
        """Hand it over now or, when it is large and others wait, when it is its turn.

        What has waited was acknowledged before: that it cannot be converted is told by its route.
        """
        turns = self._turns
        work = partial(self._hand_over, receiver, message, retain, origin, number)
        if isinstance(receiver, Commands) or (size <= LITTLE and not turns.waits(origin)):
            work()  # where there are rules, what comes is judged first, and waits then
        elif turns.has_room(origin, size):
            turns.do(origin, size, work)
        else:
            why = "was refused: too much of its user waits to be converted"
            receiver.fail(why)
            receiver.reject(message, why, ReasonCode.QUOTA_EXCEEDED)

    def _hand_over(
        self,
        receiver: ToRos,
        message: Message,
        retain: bool,
        origin: Session | None,
        number: int,
    ) -> None:
        try:
            receiver.receive(message, retain, origin, number)
        except Exception as error:
            receiver.fault(message, error)

    def _drain(self) -> None:
        if self._deliver():
            self._entries.soon("bridge.drain", self._drain, failed=self._drain_later)

    def _drain_later(self) -> None:
        # Whatever it was: nobody wakes it up again before the mailbox was empty once.
        self._entries.later("bridge.drain", DRAIN_AGAIN, self._drain, failed=self._drain_later)

    def _deliver(self) -> bool:
        """Publish what waits in the mailbox, up to a batch; True when there may be more."""
        if self._session is None:
            return False
        batch, has_more = self._mailbox.take(BATCH)
        self._publish(batch)
        return has_more

    def _publish(self, batch: Iterable[tuple[Lane, Message]]) -> None:
        session = self._session
        if session is None:
            return
        publish = self._broker.publish
        for lane, message in batch:
            counters = lane.counters
            timed = lane.timed
            if timed is not None and timed[0] is message:
                lane.timed = None
                counters.latency.observe((time_ns() - timed[1]) / 1e9)
            counters.messages += 1
            counters.bytes += len(message.payload)
            try:
                publish(message, session)
            except Exception as error:
                self._faults.caught("bridge.message", error, message.topic)
                counters.errors += 1
        self._broker.flush()

    def _announce(self) -> None:
        """Tell what is bridged, if that or a figure in it has changed."""
        topics = self.topics()
        payload = orjson.dumps([*topics, *self.calls.bridged()])
        if self._session is not None and payload != self._announced:
            self._announced = payload
            self._tell_all(self._topic, payload, self._session)
            self._tell_schemas({topic.type for topic in topics}, self._session)
            self._broker.flush()
        payload = orjson.dumps(summary(self.skips()))
        if self._session is not None and payload != self._announced_skips:
            self._announced_skips = payload
            self._tell_all(self._skipped_topic, payload, self._session)
            self._broker.flush()

    def _tell_all(self, topic: str, payload: bytes, session: Session) -> None:
        self._broker.publish(Message(topic, payload, 0, True, JSON_PROPERTIES), session)

    def _meter(self) -> None:
        now = self._loop.time()
        for flow in self._flows():
            flow.meter.tick(now, flow.counters.messages, flow.counters.bytes)
        self._metered += 1
        if self._metered % METERS_TO_ANNOUNCE == 0:
            self._announce()

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

    def _forget_schemas(self, session: Session) -> None:
        """Take back what a run has told that was killed: the types may be others now."""
        for topic, _ in list(self._broker.retained.find(f"{self._schemas}#")):
            self._broker.publish(Message(topic, b"", 0, True), session)
        self._broker.flush()

    def forget_leftovers(self) -> None:
        """Take back what routes have retained that there are no more, of this run and others."""
        self._owners = TopicOwners((route.settings for route in self._routes), self.calls.routes)
        self._sweep(self._owners, self._broker.retained.find_in_steps("#"), 0)

    def _sweep(
        self, owners: TopicOwners, steps: Iterator[tuple[str, Message] | None], count: int
    ) -> None:
        session = self._session
        if session is None or owners is not self._owners:  # the routes have changed again
            return
        retained = self._broker.retained
        left = []
        has_more = False
        for found in steps:
            if found is None:  # so that others have their turn
                has_more = True
                break
            topic, message = found
            is_ours = retained.owner(topic).is_inside and is_of_route(message)
            if is_ours and not owners.has(topic):
                left.append(topic)
        for topic in left:  # not while they are gone through
            self._broker.publish(Message(topic, b"", 0, True), session)
        count += len(left)
        if has_more:
            self._entries.soon("bridge.sweep", self._sweep, owners, steps, count)
        elif count:
            log.info("retained messages of routes that are gone, taken back: %d", count)
        self._broker.flush()

    def _joined(self) -> None:
        log.info("on ROS as %s", self._node.name)
        self.problem = None
        self._was_joined = True
        self._joined_at = self._loop.time()

    def _counted(self, peers: int, has_twin: bool) -> None:
        self.peers = peers
        self._twin_looks = self._twin_looks + 1 if has_twin else 0
        if self._twin_looks == TWIN_LOOKS:
            log.warning("%s: %s; %s", self._node.name, TWIN, TWIN_ADVICE)

    def _stopped(self, reason: str) -> None:
        before, self.problem = self.problem, reason
        since, self._joined_at, self.peers = self._joined_at, None, None
        if self._is_stopping:
            return
        now = self._loop.time()
        if since is not None and now - since > LONGEST_RETRY:
            self._retry = RETRY
        if reason != before:
            log.warning(
                "there is no bridge to ROS: %s (it is tried again, at least every %g s)",
                reason,
                LONGEST_RETRY,
            )
        self._join_later()

    # Any thread

    def _wake(self) -> None:
        self._post(self._drain, failed=self._drain_later)

    def _tell(self, level: int, text: str, *args: object) -> None:
        if log.isEnabledFor(level):
            self._post(log.log, level, text, *args)

    def _post(
        self,
        callback: Callable[..., object],
        *args: object,
        failed: Callable[[], object] | None = None,
    ) -> None:
        served = getattr(callback, "__qualname__", "")
        try:
            self._entries.from_thread("bridge.post", callback, *args, served=served, failed=failed)
        except RuntimeError:  # the loop is closed: there is nobody to hear it
            log.debug("the event loop is closed")

    def _flows(self) -> list[Flow]:
        found = self._found.copy().values()
        named = [flow for flow in self._to_ros.values() if not flow.is_matched]
        return [*self._to_mqtt.copy().values(), *named, *found]

    # The ROS thread

    def _look(self) -> None:
        """Follow what has come and gone on the graph."""
        if not self._is_joined:
            self._is_joined = True
            self._looks = 0
            self._post(self._joined)
        if self._looks % COUNTED_LOOK == 0:
            names = self._node.nodes()
            has_twin = names.count(self._node.name) > 1
            self._post(self._counted, len(set(names) - {self._node.name}), has_twin)
        self._looks += 1
        has_changed = self._follow_routes()
        has_changed |= self._match_patterns()
        has_changed |= self._look_at_flows()
        self.calls.poller.poll_graph()
        ready = [flow for flow in self._found.values() if flow.bridged is not None]
        if ready != self._ready:
            self._ready = ready
            self._post(self._receive_for_matched, ready)
        if self._diagnostics is not None:
            self._diagnostics.look(self._node, self._converters, self._tell)
        if has_changed:
            self._post(self._announce)

    def _look_at_flows(self) -> bool:
        """Let each follow its topic; one that fails begins anew, and keeps no other from it.

        Raises what all of them fail with: then it is the bus.
        """
        has_changed = False
        flows = self._flows()
        failures = 0
        for flow in flows:
            is_thorough = (flow.turn + self._looks) % THOROUGH_LOOK == 0
            try:
                has_changed |= flow.look(self._node, is_thorough)
            except Exception as error:
                failures += 1
                if failures == len(flows) > 1:
                    raise
                self._post(self._faults.caught, "bridge.look", error, str(flow))
                flow.begin_anew(f"a fault in the appliance: {error!r:.200}")
        return has_changed

    def _follow_routes(self) -> bool:
        """Begin and end flows as the routes have changed; True when what is bridged has changed."""
        routes = self._routes
        if routes is self._followed:
            return False
        self._followed = routes
        self._topics = None
        self._post(self.forget_leftovers)  # what was on its way is behind us then
        has_changed = False
        while self._leaving:
            has_changed = True
            self._leaving.popleft().close()
        for flow in (*self._to_mqtt.values(), *self._found.values()):
            is_taken = flow.is_matched and flow.ros in self._named[flow.direction]
            if flow.route not in routes or is_taken:
                has_changed = True
                self._end(flow)
        there = {flow.route for flow in self._to_mqtt.values()}
        for route in routes:
            is_named = route.direction == "to_mqtt" and not route.is_pattern
            if is_named and route not in there:
                self._add_to_mqtt(route, route.settings.names[0])
        for key in self._to_ros:
            self._pair(key)
        return has_changed

    def _match_patterns(self) -> bool:
        """Begin flows for topics that have come, end those of topics that have gone; True when what
        is bridged has changed."""
        patterns = [route for route in self._routes if route.is_pattern]
        if not patterns:
            self._refused = []
            return False
        topics = self._node.topics()
        if topics == self._topics:
            return False
        self._topics = topics
        has_changed = False
        for flow in (*self._to_mqtt.values(), *self._found.values()):
            if flow.is_matched and not flow.route.matches(flow.ros, topics.get(flow.ros, ())):
                has_changed |= flow.bridged is not None
                self._end(flow)
        taken: dict[Direction, set[str]] = {
            "to_mqtt": self._named["to_mqtt"] | {flow.ros for flow in self._to_mqtt.values()},
            "to_ros": self._named["to_ros"] | {flow.ros for flow in self._found.values()},
        }
        for route in patterns:
            mine = taken[route.direction]
            for ros, types in topics.items():
                if ros not in mine and route.matches(ros, types):
                    mine.add(ros)
                    add = self._add_to_mqtt if route.direction == "to_mqtt" else self._add_to_ros
                    add(route, ros)
        refused = self._find_refused(patterns, taken)
        has_changed |= refused != self._refused
        self._refused = refused
        return has_changed

    def _find_refused(
        self, patterns: list[BridgeRoute], taken: Mapping[Direction, set[str]]
    ) -> list[Skipped]:
        found: dict[tuple[str, str], Skipped] = {}
        for route in patterns:
            direction = route.direction
            for ros, types in (self._topics or {}).items():
                # Those of actions belong to bridge.actions, which has a say of its own.
                if ros in taken[direction] or (ros, direction) in found or "/_action/" in ros:
                    continue
                refusal = route.refusal(ros, types)
                if refusal is not None:
                    found[ros, direction] = Skipped(ros, direction, min(types), *refusal)
        return list(found.values())

    def _end(self, flow: Flow) -> None:
        flow.close()
        key = flow.ros, flow.mqtt
        if flow.direction == "to_mqtt":
            del self._to_mqtt[key]
        else:
            del self._found[key]
        self._post(flow.route.past.add, flow.counters)

    def _failed(self, reason: str) -> None:
        self._is_joined = False
        for flow in (*self._flows(), *self._leaving):
            flow.lost()
        self._refused = []
        self.calls.poller.on_bus_lost()
        if self._diagnostics is not None:
            self._diagnostics.lost()
        self._post(self._stopped, reason, failed=self._join_later)
        self._post(self._announce)


class _Link(InsideLink):
    """The link of the bridge's session."""

    def __init__(self, receive: Callable[[Message, bool, Session | None], None]) -> None:
        self._receive = receive

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
        self._receive(message, retain, message.publisher)
