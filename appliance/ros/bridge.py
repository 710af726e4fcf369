"""The bridge between the robot's bus and the broker: the event loop's side of it.

Two threads meet here. On the ROS thread the graph follower opens and closes subscriptions and
publishers, and what ROS sends is throttled, converted and put into the mailbox. On the event loop's
thread the bridge empties the mailbox into the broker, and converts what MQTT sends and publishes it
on ROS at once: a conversion takes microseconds, and rclpy's publish holds the interpreter's lock
all the way through, so that handing it to another thread would add a wake-up and free nothing. For
the same reason small messages from ROS are taken, converted and published on the loop's thread
right away, where the node can do that.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable
from functools import partial
from time import time_ns
from types import MappingProxyType
from typing import Literal, TypeAlias

from appliance.broker.broker import Broker
from appliance.broker.link import ReceivingLink
from appliance.broker.message import Message
from appliance.broker.session import Session, publisher_of
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ReasonCode
from appliance.net.callbacks import Entries, PeriodicCallback
from appliance.ros.announcements import Announcements
from appliance.ros.calls.routes import CallBridge, CallRoutes
from appliance.ros.diagnostics import Diagnostics, DiagnosticsTopic
from appliance.ros.graph_follower import FlowKey, GraphFollower, TopicRoutes
from appliance.ros.home_assistant import HomeAssistant
from appliance.ros.live import LiveFigures
from appliance.ros.mailbox import Lane, Mailbox
from appliance.ros.node import RosNode
from appliance.ros.payload.converter import Converters
from appliance.ros.retained_cleanup import RetainedCleanup, TopicOwners
from appliance.ros.ros2.discovery import TWIN, TWIN_ADVICE
from appliance.ros.schema_topics import SchemaTopics
from appliance.ros.skipped import Skipped, ordered
from appliance.ros.status import (
    RouteStatus,
    RouteTotal,
    TopicStatus,
    route_status,
    route_total,
    topic_status,
)
from appliance.ros.topics.commands import Commands
from appliance.ros.topics.conversions import LITTLE, ConversionQueue, size_of
from appliance.ros.topics.factory import FlowFactory
from appliance.ros.topics.flow import Flow, bridged
from appliance.ros.topics.lease import BRIDGE_CLIENT_ID, Leases
from appliance.ros.topics.off_loop import ConversionThreads
from appliance.ros.topics.route import BridgedTopic, BridgeRoute, Direction, TopicSettings
from appliance.ros.topics.staleness import StalenessDetector
from appliance.ros.topics.to_ros import ToRos, ToRosContext

__all__ = ["Bridge", "BridgedTopic", "BusState", "RouteStatus", "TopicSettings", "TopicStatus"]

log = logging.getLogger(__name__)

#: Messages from the mailbox that are published before other callbacks of the loop have a turn.
BATCH = 64

#: Counts of the nodes in a row that find another node of our name until it is logged: a node that
#: was killed is seen for 20 s more.
TWIN_COUNTS = 15

#: Seconds until the bus is joined again after it could not be joined or was lost; the delay doubles
#: with each attempt, up to the second of these.
RETRY = 1.0
LONGEST_RETRY = 60.0

#: Seconds between two readings of the counters, for the rates; and readings between two updates of
#: the metrics in `{robot}/_appliance/routes`.
METER_INTERVAL = 1.0
METERS_TO_ANNOUNCE = 10

#: Seconds until it is announced that another client commands, or none: others may follow at once.
ANNOUNCE_LEASE = 0.2

#: Seconds from joining the bus on for which a topic of a pattern that is not there is expected.
DISCOVERY = 10.0

#: Seconds until the mailbox is emptied again after that has failed.
DRAIN_AGAIN = 0.05

BusState: TypeAlias = Literal["waiting", "joined", "lost"]


class Bridge:
    """Carries the topics of routes between a node and the broker; belongs to the loop's thread.

    `problem` is None, or why the bus is not joined; the bridge keeps trying to join it. `peers` is
    the number of other nodes, None while the bus is not joined.
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
        home_assistant: bool = False,
    ) -> None:
        """The bridge publishes what is bridged on `{robot}/_appliance/routes`, what is not on
        `…/skipped`, while somebody looks figures on `…/live`, and every `diagnostics` seconds its
        status on `/diagnostics`; never for 0. It tells Home Assistant of its routes if wanted.
        """
        self.problem: str | None = None
        self.peers: int | None = None
        self._twin_counts = 0
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
        self._schemas = SchemaTopics(broker, entries, robot, node.describe)
        self._home_assistant = HomeAssistant(broker, robot, home_assistant)
        self._announcements = Announcements(
            broker, entries, robot, self, self._schemas.replace, self._home_assistant
        )
        self._session: Session | None = None
        self._cleanup = RetainedCleanup(broker, entries)
        self._live = LiveFigures(broker, entries, robot)
        self._mailbox = Mailbox(self._wake)
        self._converters = Converters(node.describe, node.now)
        self._conversions = ConversionQueue(entries, broker.accounting)
        self._threads = ConversionThreads(entries)
        self._context = ToRosContext(
            entries,
            self._post,
            broker,
            Leases(self._announce_soon),
            self._conversions,
            StalenessDetector(),
        )
        self._meter_timer: PeriodicCallback | None = None
        self._metered = 0
        self._announce_timer: asyncio.TimerHandle | None = None
        self._routes: list[BridgeRoute] = []
        #: Topics that a route names; such a route takes precedence over patterns.
        self._named: dict[Direction, frozenset[str]] = {}
        #: The flows to ROS that messages are received for, and those of them whose topics patterns
        #: have found.
        self._to_ros: dict[FlowKey, ToRos] = {}
        self._matched: list[ToRos] = []
        #: The flows to ROS by MQTT topic.
        self._receivers: dict[str, list[ToRos]] = {}
        self._subscribed: dict[str, Subscription] = {}
        self._factory = FlowFactory(
            self._converters,
            self._log,
            self._mailbox,
            self._publish,
            self._context,
            self._threads,
        )
        #: Services, actions and parameters.
        self.calls = CallBridge(
            node,
            broker,
            entries,
            self._converters,
            self._mailbox,
            self._post,
            self._announce,
            self._conversions,
        )
        self._diagnostics: Diagnostics | None = None
        diagnostics_topic: DiagnosticsTopic | None = None
        if diagnostics:
            diagnostics_topic = DiagnosticsTopic(node, self._converters, self._log)
            self._diagnostics = Diagnostics(robot, broker, self, diagnostics_topic, diagnostics)
        self._follower = GraphFollower(
            node,
            self._factory,
            self.calls.poller,
            diagnostics_topic,
            self,
            self._post,
            broker.faults,
        )
        self.replace(routes)
        self.calls.replace(calls or CallRoutes())

    def replace(self, routes: Iterable[TopicSettings]) -> None:
        """Carry these routes from now on; unchanged routes are not interrupted."""
        known = {(route.settings, route.direction): route for route in self._routes}
        wanted: list[BridgeRoute] = []
        directions: tuple[tuple[Direction, str], ...] = (("to_ros", "mqtt"), ("to_mqtt", "ros"))
        for settings in routes:
            for direction, other in directions:
                if settings.to != other:
                    route = known.get((settings, direction))
                    wanted.append(route or BridgeRoute(settings, direction))
        self._named = {
            direction: frozenset(
                route.settings.names[0]
                for route in wanted
                if route.direction == direction and not route.is_pattern
            )
            for direction, _ in directions
        }
        self._receive_for(wanted)
        self._routes = wanted
        self._home_assistant.routes_change()
        named = {key: flow for key, flow in self._to_ros.items() if not flow.is_matched}
        self._follower.follow(
            TopicRoutes(tuple(wanted), MappingProxyType(self._named), MappingProxyType(named))
        )

    def _receive_for(self, routes: list[BridgeRoute]) -> None:
        """Receive messages for the flows to ROS of these routes, and for no others."""
        flows: dict[tuple[str, str], ToRos] = {}
        for route in routes:
            if route.direction != "to_ros" or route.is_pattern:
                continue
            flow = self._factory.to_ros(route, route.settings.names[0])
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
                if not flow.is_matched:  # the follower reports the end of those
                    flow.route.past.add(flow.total())
        for key, flow in flows.items():
            known = before.get(key)
            if known is not flow:
                flow.enter(known)
        receivers: dict[str, list[ToRos]] = {}
        for flow in flows.values():
            receivers.setdefault(flow.mqtt, []).append(flow)
        self._receivers = receivers
        self._subscribe()

    def _subscribe(self) -> None:
        """Subscribe to the MQTT topics of the flows to ROS, and to nothing else."""
        session = self._session
        if session is None:
            return
        wanted: dict[str, Subscription] = {}
        for topic, flows in self._receivers.items():
            # No Local stops the echo on a topic that is bridged both ways. A retained message may
            # be an old command: it does not reach ROS, unless a route asks for it. QoS 0 loses
            # nothing here, as the link takes each message at once.
            takes_retained = any(flow.takes_retained for flow in flows)
            retain_handling = 0 if takes_retained else 2
            wanted[topic] = Subscription(topic, 0, no_local=True, retain_handling=retain_handling)
        before, self._subscribed = self._subscribed, wanted
        for topic, subscription in wanted.items():
            if before.get(topic) != subscription:
                self._broker.subscribe(session, subscription)
                self._broker.send_retained(session, subscription, True)
                session.take_turn()  # nothing else is queued for this session
        for topic in before.keys() - wanted.keys():
            self._broker.unsubscribe(session, topic)

    def start(self) -> None:
        """Subscribe on MQTT, and join the bus in the background."""
        self._session = self._broker.attach(BRIDGE_CLIENT_ID, ReceivingLink(self._receive))
        self._subscribe()
        self._broker.departures.append(self._context.staleness.on_departed)
        self._broker.obstacles.append(self._obstacle)
        self.calls.start()
        self._schemas.start(self._session)
        self.clean_up_retained()
        self._announce()
        self._meter_timer = self._entries.every("bridge.meter", METER_INTERVAL, self._meter)
        if self._diagnostics is not None:
            self._diagnostics.start(self._entries)
        self._join()

    def _join(self) -> None:
        self._node.start(self._follower.poll, self._follower.on_failed, self._entries)

    def rejoin_later(self) -> None:
        """Join the bus again later; the delay doubles with each attempt."""
        delay, self._retry = self._retry, min(2 * self._retry, LONGEST_RETRY)
        self._retry_timer = self._entries.later(
            "bridge.join", delay, self._join, failed=self.rejoin_later
        )

    @property
    def state(self) -> BusState:
        """Whether the bus is joined, was lost, or has not been there yet."""
        if self._joined_at is not None:
            return "joined"
        return "lost" if self._was_joined else "waiting"

    @property
    def obstacle(self) -> str | None:
        """What keeps the bus from being joined for now, although nothing has failed; else None."""
        return self._node.obstacle

    async def stop(self) -> None:
        """Leave the bus, publish what it had sent, and leave the broker; may be called twice."""
        self._is_stopping = True
        if self._retry_timer is not None:
            self._retry_timer.cancel()
        if self._meter_timer is not None:
            self._meter_timer.cancel()
        if self._announce_timer is not None:
            self._announce_timer.cancel()
        if self._diagnostics is not None:
            self._diagnostics.stop()
        for flow in self._to_ros.values():
            flow.leave()
        if self._context.staleness.on_departed in self._broker.departures:
            self._broker.departures.remove(self._context.staleness.on_departed)
            self._broker.obstacles.remove(self._obstacle)
        await self.calls.leave()
        await asyncio.to_thread(self._node.stop)
        self._threads.close()
        session = self._session
        if session is None:
            return
        self._follower.release()
        while self._deliver():
            pass
        await self.calls.stop()
        self._announcements.stop(session)
        self._schemas.stop()
        self._cleanup.stop()
        self._session = None
        self._broker.detach(session)

    def status(self) -> list[RouteStatus]:
        """Every route's state and counters, one entry a direction."""
        return [route_status(route, flows) for route, flows in self._by_route()]

    def totals(self) -> list[RouteTotal]:
        """Every route's counters alone, one entry a direction."""
        return [route_total(route, flows) for route, flows in self._by_route()]

    def _by_route(self) -> list[tuple[BridgeRoute, list[Flow]]]:
        flows: dict[BridgeRoute, list[Flow]] = {}
        for flow in self.flows():
            flows.setdefault(flow.route, []).append(flow)
        return [(route, flows.get(route, [])) for route in self._routes]

    def topics(self) -> list[TopicStatus]:
        """What is bridged now, with its metrics."""
        return [topic_status(topic, flow) for topic, flow in bridged(self.flows())]

    def count_topics(self) -> int:
        """How many topics are bridged now."""
        return sum(1 for _ in bridged(self.flows()))

    def skips(self) -> list[Skipped]:
        """What routes include and is not bridged, and why."""
        of_flows = [skip for flow in self.flows() for skip in flow.skips()]
        return ordered([*of_flows, *self._follower.followed.refused, *self.calls.skips()])

    def flows(self) -> list[Flow]:
        """Of all topics of routes, bridged now or not."""
        followed = self._follower.followed
        named = [flow for flow in self._to_ros.values() if not flow.is_matched]
        return [*followed.to_mqtt, *named, *followed.matched]

    @property
    def node_name(self) -> str:
        """The full name of the bridge's node."""
        return self._node.name

    def _obstacle(self, topic: str) -> str:
        """See `Broker.obstacles`: why ROS would not get a message to this topic now."""
        flows = self._receivers.get(topic)
        if flows:
            return next(filter(None, (flow.obstacle() for flow in flows)), "")
        since = self._joined_at
        if since is not None and self._loop.time() - since > DISCOVERY:
            return ""
        patterns = (route for route in self._routes if route.direction == "to_ros")
        if not any(route.is_pattern and route.takes(topic) for route in patterns):
            return ""
        return "ROS is not ready" if since is None else "no such topic is known on ROS yet"

    def _receive(self, message: Message, retain: bool, subscription_ids: list[int] | None) -> None:
        size = size_of(message.payload)
        number = self._context.staleness.next_number()
        origin = publisher_of(message)
        for receiver in self._receivers.get(message.topic, ()):
            self._dispatch(receiver, message, retain, origin, number, size)

    def _dispatch(
        self,
        receiver: ToRos,
        message: Message,
        retain: bool,
        origin: Session | None,
        number: int,
        size: int,
    ) -> None:
        """Hand a message to its flow now or, if it is large and others are queued, in its turn.

        A message that was queued is acknowledged before it is converted: if that fails, the route
        reports it. A flow with command rules judges each message at once and queues it itself.
        """
        conversions = self._conversions
        work = partial(self._hand_over, receiver, message, retain, origin, number)
        if isinstance(receiver, Commands):
            work()
        elif size <= LITTLE and not conversions.waits(origin):
            conversions.little(work)
        elif conversions.has_room(origin, size):
            conversions.do(origin, size, work)
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
        # The mailbox wakes the loop only after it has been empty: retry here, whatever has failed.
        self._entries.later("bridge.drain", DRAIN_AGAIN, self._drain, failed=self._drain_later)

    def _deliver(self) -> bool:
        """Publish a batch from the mailbox; True when there may be more."""
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
        """Publish what is bridged and what is skipped, where that or a metric in it has changed."""
        if self._session is not None:
            self._announcements.publish(self._session)

    def tell_home_assistant(self, is_on: bool) -> None:
        """Tell Home Assistant from the next routes on, or no more: `replace` has to follow."""
        self._home_assistant.use(is_on)

    def _announce_soon(self) -> None:
        """Another client holds a lease, or none does: announce that, with what follows."""
        if self._announce_timer is None and not self._is_stopping:
            self._announce_timer = self._entries.later(
                "bridge.announce", ANNOUNCE_LEASE, self._announce_lease
            )

    def _announce_lease(self) -> None:
        self._announce_timer = None
        self._announce()

    def _meter(self) -> None:
        now = self._loop.time()
        flows = self.flows()
        for flow in flows:
            flow.meter.tick(now, flow.counters.messages, flow.counters.bytes)
        if self._session is not None:
            self._live.publish(flows, self._session)
        self._metered += 1
        if self._metered % METERS_TO_ANNOUNCE == 0:
            self._announce()

    def clean_up_retained(self) -> None:
        """Delete retained messages of routes that are gone, of this run and earlier ones."""
        if self._session is not None:
            owners = TopicOwners(
                [route.settings for route in self._routes],
                self.calls.routes,
                self._home_assistant.is_on,
            )
            self._cleanup.start(self._session, owners)

    # GraphEvents

    def on_joined(self) -> None:
        """The bus has been joined."""
        log.info("on ROS as %s", self._node.name)
        self.problem = None
        self._was_joined = True
        self._joined_at = self._loop.time()

    def on_nodes_counted(self, peers: int, has_twin: bool) -> None:
        """So many other nodes are there; with a twin, another one has our name."""
        self.peers = peers
        self._twin_counts = self._twin_counts + 1 if has_twin else 0
        if self._twin_counts == TWIN_COUNTS:
            log.warning("%s: %s; %s", self._node.name, TWIN, TWIN_ADVICE)

    def on_routes_followed(self) -> None:
        """New routes are in effect: flows of old ones publish nothing any more."""
        self._home_assistant.routes_followed()
        self.clean_up_retained()
        if self._home_assistant.is_on:
            self._announce()

    def on_matched(self, flows: list[ToRos]) -> None:
        """Receive for these flows to ROS, whose topics were found by patterns."""
        self._matched = flows
        self._receive_for(self._routes)

    def on_ended(self, flow: Flow) -> None:
        """A flow that the follower has made is closed: its route goes on with its counters."""
        try:
            flow.finish()
        finally:
            flow.route.past.add(flow.total())

    def on_bridged_changed(self) -> None:
        """Other topics are bridged, or refused, than before."""
        self._announce()

    def on_bus_lost(self, reason: str) -> None:
        """The bus cannot be joined, or was lost: join it again later."""
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
        self.rejoin_later()

    # Any thread

    def _wake(self) -> None:
        self._post(self._drain, failed=self._drain_later)

    def _log(self, level: int, text: str, *args: object) -> None:
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
        except RuntimeError:  # the loop is closed: nobody can receive it
            log.debug("the event loop is closed")
