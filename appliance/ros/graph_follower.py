"""Follows the ROS graph for the bridge, on the ROS thread.

The follower polls the graph 6 times a second, twice a second with a thousand topics. It opens and
closes what carries messages as routes are replaced and as topics come and go, and it notices when
the bus is lost. It shares two immutable snapshots with the event loop's thread, each replaced as a
whole: the loop writes `TopicRoutes`, the follower writes `FollowedTopics`. Everything else that the
loop has to know is posted to it as a call of `GraphEvents`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from appliance.broker.faults import Faults
from appliance.ros.calls.routes import CallPoller
from appliance.ros.diagnostics import DiagnosticsTopic
from appliance.ros.node import RosNode
from appliance.ros.skipped import Skipped
from appliance.ros.topics.echo import EchoFilter
from appliance.ros.topics.factory import FlowFactory
from appliance.ros.topics.flow import Flow
from appliance.ros.topics.route import BridgeRoute, Direction
from appliance.ros.topics.to_mqtt import ToMqtt
from appliance.ros.topics.to_ros import ToRos

#: Every flow asks for its endpoints at each 5th poll (within a second, or three with a thousand
#: topics) although their number has not changed: one may have been replaced by another. At each
#: poll it is another fifth of them.
THOROUGH_POLL = 5

#: The nodes on the bus are counted at each 10th poll.
NODE_COUNT_POLL = 10

#: What identifies a flow in one direction: its ROS topic and its MQTT topic.
FlowKey = tuple[str, str]


@dataclass(frozen=True, slots=True)
class TopicRoutes:
    """The routes to follow; a snapshot from the loop's thread.

    `named` are the topics that routes name, which take precedence over patterns. `to_ros` are the
    flows of routes that name a topic for ROS: the loop's thread makes those.
    """

    routes: tuple[BridgeRoute, ...] = ()
    named: Mapping[Direction, frozenset[str]] = field(
        default_factory=lambda: {"to_mqtt": frozenset(), "to_ros": frozenset()}
    )
    to_ros: Mapping[FlowKey, ToRos] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class FollowedTopics:
    """What the follower has made of the routes; a snapshot from the ROS thread.

    `matched` are the flows to ROS whose topics were found by patterns. `refused` are the topics
    that a pattern includes and no route takes.
    """

    to_mqtt: tuple[ToMqtt, ...] = ()
    matched: tuple[ToRos, ...] = ()
    refused: tuple[Skipped, ...] = ()


class GraphEvents(Protocol):
    """What the follower reports; called on the loop's thread."""

    def on_joined(self) -> None:
        """The bus has been joined."""

    def on_nodes_counted(self, peers: int, has_twin: bool) -> None:
        """So many other nodes are there; with a twin, another one has our name."""

    def on_routes_followed(self) -> None:
        """New routes have been taken over: flows of old ones publish nothing any more."""

    def on_matched(self, flows: list[ToRos]) -> None:
        """These flows to ROS, found by patterns, can be received for."""

    def on_ended(self, flow: Flow) -> None:
        """A flow that the follower has made is closed for good."""

    def on_bridged_changed(self) -> None:
        """Other topics are bridged, or refused, than before."""

    def on_bus_lost(self, reason: str) -> None:
        """The bus cannot be joined, or was lost."""

    def rejoin_later(self) -> None:
        """Join the bus again later; called when `on_bus_lost` has failed."""


class GraphFollower:
    """Opens and closes flows as the graph and the routes change.

    `follow`, `followed` and `release` are for the loop's thread, all else for the ROS thread.
    """

    def __init__(
        self,
        node: RosNode,
        flows: FlowFactory,
        calls: CallPoller,
        diagnostics: DiagnosticsTopic | None,
        events: GraphEvents,
        post: Callable[..., None],
        faults: Faults,
    ) -> None:
        """`post` calls on the loop's thread; `faults` are counted there, too."""
        self._node = node
        self._factory = flows
        self._calls = calls
        self._diagnostics = diagnostics
        self._events = events
        self._post = post
        self._faults = faults
        #: From the loop's thread, and what of it has been taken over.
        self._wanted = TopicRoutes()
        self._current: TopicRoutes | None = None
        #: For the loop's thread.
        self._followed = FollowedTopics()
        self._is_joined = False
        #: Whether other routes have been taken over, which is not reported yet.
        self._has_followed = False
        self._polls = 0
        self._to_mqtt: dict[FlowKey, ToMqtt] = {}
        self._matched: dict[FlowKey, ToRos] = {}
        #: Those of `_matched` that the loop's thread receives for.
        self._ready: list[ToRos] = []
        #: Flows that have ended and still are in the snapshot.
        self._ended: list[Flow] = []
        #: The graph's topics when patterns were last matched.
        self._topics: dict[str, list[str]] | None = None
        self._refused: list[Skipped] = []

    # The loop's thread

    @property
    def followed(self) -> FollowedTopics:
        """What is followed now."""
        return self._followed

    def follow(self, routes: TopicRoutes) -> None:
        """Follow these from the next poll on."""
        self._wanted = routes

    def release(self) -> None:
        """Forget the bus; called when the ROS thread has ended."""
        self._lose_flows()

    # The ROS thread

    def poll(self) -> None:
        """Follow what has come and gone on the graph."""
        if not self._is_joined:
            self._is_joined = True
            self._polls = 0
            self._post(self._events.on_joined)
        if self._polls % NODE_COUNT_POLL == 0:
            names = self._node.nodes()
            has_twin = names.count(self._node.name) > 1
            peers = len(set(names) - {self._node.name})
            self._post(self._events.on_nodes_counted, peers, has_twin)
        self._polls += 1
        try:
            has_changed = self._follow_routes()
            has_changed |= self._match_patterns()
        finally:
            self._share()
        has_changed |= self._poll_flows()
        self._calls.poll_graph()
        ready = [flow for flow in self._matched.values() if flow.follower.bridged]
        if ready != self._ready:
            self._ready = ready
            self._post(self._events.on_matched, ready)
        if self._diagnostics is not None:
            self._diagnostics.poll_graph()
        if has_changed:
            self._post(self._events.on_bridged_changed)

    def on_failed(self, reason: str) -> None:
        """The bus cannot be joined, or the node has ended by itself."""
        self._is_joined = False
        self._lose_flows()
        self._calls.on_bus_lost()
        if self._diagnostics is not None:
            self._diagnostics.on_bus_lost()
        events = self._events
        self._post(events.on_bus_lost, reason, failed=events.rejoin_later)
        self._post(events.on_bridged_changed)

    def _lose_flows(self) -> None:
        for flow in self._flows():
            flow.follower.on_bus_lost()
        self._refused = []
        self._share()

    def _flows(self) -> list[Flow]:
        named = () if self._current is None else self._current.to_ros.values()
        return [*self._to_mqtt.values(), *named, *self._matched.values()]

    def _share(self) -> None:
        """Replace the snapshot for the loop's thread; report flows that are no longer in it."""
        before = self._followed
        to_mqtt, matched = tuple(self._to_mqtt.values()), tuple(self._matched.values())
        refused = tuple(self._refused)
        if (to_mqtt, matched, refused) != (before.to_mqtt, before.matched, before.refused):
            self._followed = FollowedTopics(to_mqtt, matched, refused)
        ended, self._ended = self._ended, []
        for flow in ended:
            self._post(self._events.on_ended, flow)
        if self._has_followed:
            self._has_followed = False
            # What flows of old routes had sent is behind us then.
            self._post(self._events.on_routes_followed)

    def _poll_flows(self) -> bool:
        """Let each flow follow its topic; returns whether what is bridged has changed.

        A flow that fails is set up anew and does not keep others from their poll. An error that
        all flows fail with is raised: then it is the bus.
        """
        has_changed = False
        flows = self._flows()
        failures = 0
        for flow in flows:
            is_thorough = (flow.follower.number + self._polls) % THOROUGH_POLL == 0
            try:
                has_changed |= flow.follower.poll_graph(self._node, is_thorough)
            except Exception as error:
                failures += 1
                if failures == len(flows) > 1:
                    raise
                self._post(self._faults.caught, "bridge.look", error, str(flow))
                flow.follower.reset(f"a fault in the appliance: {error!r:.200}")
        return has_changed

    def _follow_routes(self) -> bool:
        """Begin and end flows as the routes have changed; True when what is bridged has changed."""
        wanted, current = self._wanted, self._current
        if wanted is current:
            return False
        self._current = wanted
        self._topics = None
        self._has_followed = True
        has_changed = False
        for key, named in ({} if current is None else current.to_ros).items():
            if wanted.to_ros.get(key) is not named:
                has_changed = True
                named.follower.close()
        routes = set(wanted.routes)
        for flow in (*self._to_mqtt.values(), *self._matched.values()):
            is_taken = flow.is_matched and flow.ros in wanted.named[flow.direction]
            if flow.route not in routes or is_taken:
                has_changed = True
                self._end(flow)
        there = {flow.route for flow in self._to_mqtt.values()}
        for route in wanted.routes:
            is_named = route.direction == "to_mqtt" and not route.is_pattern
            if is_named and route not in there:
                self._add_to_mqtt(route, route.settings.names[0])
        for key in wanted.to_ros:
            self._pair(key)
        return has_changed

    def _match_patterns(self) -> bool:
        """Begin flows for topics that have come, end those of topics that have gone; True when what
        is bridged has changed."""
        current = self._current or self._wanted
        patterns = [route for route in current.routes if route.is_pattern]
        if not patterns:
            self._refused = []
            return False
        topics = self._node.topics()
        if topics == self._topics:
            return False
        self._topics = topics
        has_changed = False
        for flow in (*self._to_mqtt.values(), *self._matched.values()):
            if flow.is_matched and not flow.route.matches(flow.ros, topics.get(flow.ros, ())):
                has_changed |= flow.follower.bridged is not None
                self._end(flow)
        taken: dict[Direction, set[str]] = {
            "to_mqtt": {*current.named["to_mqtt"]} | {flow.ros for flow in self._to_mqtt.values()},
            "to_ros": {*current.named["to_ros"]} | {flow.ros for flow in self._matched.values()},
        }
        for route in patterns:
            taken_here = taken[route.direction]
            for ros, types in topics.items():
                if ros not in taken_here and route.matches(ros, types):
                    taken_here.add(ros)
                    add = self._add_to_mqtt if route.direction == "to_mqtt" else self._add_to_ros
                    add(route, ros)
        refused = self._find_refused(patterns, topics, taken)
        has_changed |= refused != self._refused
        self._refused = refused
        return has_changed

    def _find_refused(
        self,
        patterns: list[BridgeRoute],
        topics: Mapping[str, list[str]],
        taken: Mapping[Direction, set[str]],
    ) -> list[Skipped]:
        found: dict[tuple[str, str], Skipped] = {}
        for route in patterns:
            direction = route.direction
            for ros, types in topics.items():
                # The topics of actions belong to bridge.actions, which reports them itself.
                if ros in taken[direction] or (ros, direction) in found or "/_action/" in ros:
                    continue
                refusal = route.refusal(ros, types)
                if refusal is not None:
                    found[ros, direction] = Skipped(ros, direction, min(types), *refusal)
        return list(found.values())

    def _add_to_mqtt(self, route: BridgeRoute, ros: str) -> None:
        flow = self._factory.to_mqtt(route, ros)
        key = flow.ros, flow.mqtt
        if key in self._to_mqtt:
            text = "%s has a route already; the later one is left out"
            self._factory.log(logging.WARNING, text, flow)
            return
        self._to_mqtt[key] = flow
        self._pair(key)

    def _add_to_ros(self, route: BridgeRoute, ros: str) -> None:
        flow = self._factory.to_ros(route, ros)
        key = flow.ros, flow.mqtt
        self._matched[key] = flow
        self._pair(key)

    def _pair(self, key: FlowKey) -> None:
        """Let the two flows of a topic that is bridged both ways share an echo filter."""
        there = self._to_mqtt.get(key)
        named = {} if self._current is None else self._current.to_ros
        back = self._matched.get(key) or named.get(key)
        if there is None or back is None:
            return
        if back.follower.echo is None or there.follower.echo is None:
            echo = EchoFilter(self._node.serialization)
            there.follower.share_echo(echo)
            back.follower.share_echo(echo)

    def _end(self, flow: Flow) -> None:
        flow.follower.close()
        key = flow.ros, flow.mqtt
        if flow.direction == "to_mqtt":
            del self._to_mqtt[key]
        else:
            del self._matched[key]
        self._ended.append(flow)
