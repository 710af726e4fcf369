"""The ROS thread's side of actions: subscriptions to feedback and status, published to MQTT.

The loop's thread (actions.py) hands over immutable snapshots; results go back as messages in the
mailbox and as posted calls of an `ActionListener`.
"""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from appliance.broker.faults import Faults
from appliance.broker.message import Message
from appliance.mqtt.codec import Properties, Property
from appliance.ros.calls import goals
from appliance.ros.calls.goals import STATUS
from appliance.ros.calls.serialization import from_ros
from appliance.ros.mailbox import Lane, Mailbox
from appliance.ros.metrics import FlowCounters
from appliance.ros.node import BusError, Durability, QosProfile, RosNode, RosSubscription
from appliance.ros.payload.converter import ConversionError, Converters
from appliance.ros.payload.definitions import UnknownTypeError
from appliance.ros.payload.encodings.base import EncodingName
from appliance.ros.payload.encodings.registry import CONTENT_TYPE
from appliance.ros.qos import BURST

log = logging.getLogger(__name__)

#: Goals whose newest feedback is queued while the broker is busy; the oldest goal loses its lane.
MAX_FEEDBACK_LANES = 256


@dataclass(frozen=True, slots=True)
class ActionSnapshot:
    """The state of an action that its subscriptions depend on; never changed, only replaced."""

    type: str | None = None
    is_available: bool = False
    #: How often the retained status was cleared. A latched publisher that stayed sends its status
    #: to new subscriptions only, so each clearing takes a new subscription.
    status_clears: int = 0
    #: Goals to cancel should their server accept them yet.
    abandoned: frozenset[bytes] = frozenset()
    #: Whether the route was removed, which is final. A node that joins meanwhile polls before the
    #: action is removed from the polled ones, and must not subscribe.
    is_removed: bool = False


class ActionListener(Protocol):
    """Receives an action's events, on the loop's thread."""

    def server_joined(self) -> None:
        """Another server of the action has appeared on the bus."""

    def goals_running(self, ids: list[bytes]) -> None:
        """The status names running goals, an abandoned one among them."""

    def topic_failed(self, problem: str) -> None:
        """A topic cannot be subscribed to, or a message cannot be converted."""


class ActionSubscriptions:
    """The subscriptions of one action. `update` is for the loop's thread, all else for the ROS
    thread."""

    def __init__(
        self,
        ros: str,
        base: str,
        encoding: EncodingName,
        node: RosNode,
        converters: Converters,
        mailbox: Mailbox,
        listener: ActionListener,
        post: Callable[..., None],
    ) -> None:
        """`base` is the MQTT topic above the action's; `post` calls on the loop's thread."""
        self.ros = ros
        self._base = base
        self._encoding = encoding
        self._node = node
        self._converters = converters
        self._mailbox = mailbox
        self._listener = listener
        self._post = post
        self._snapshot = ActionSnapshot()
        self._subscriptions: list[RosSubscription] = []
        self._subscribed_type: str | None = None
        self._handled_clears = 0
        self._servers = 0
        self._last_problem = ""
        counters = FlowCounters()
        self._feedback_lanes: OrderedDict[bytes, Lane] = OrderedDict()
        self._new_lane = partial(Lane, 1, counters)
        self._status_lane = self._new_lane()

    def update(self, snapshot: ActionSnapshot) -> None:
        """Replace the state that the next poll, and the next message, go by."""
        self._snapshot = snapshot

    def poll_graph(self) -> None:
        """Report new servers, and subscribe once the type is known."""
        snapshot = self._snapshot  # read once: the loop's thread may replace it meanwhile
        type_name = snapshot.type
        if snapshot.is_removed or type_name is None:
            return
        servers = self._node.count(f"{self.ros}/_action/status")[0]
        if servers > self._servers and self._subscribed_type is not None:
            self._post(self._listener.server_joined)
        self._servers = servers
        needs_status = snapshot.is_available and snapshot.status_clears != self._handled_clears
        if type_name == self._subscribed_type and not needs_status:
            return
        self._handled_clears = snapshot.status_clears
        self._unsubscribe()
        self._subscribed_type = type_name
        self._last_problem = ""
        self._subscribe(type_name)

    def _subscribe(self, type_name: str) -> None:
        latched = QosProfile(durability=Durability.TRANSIENT_LOCAL, depth=1)
        on_feedback = partial(self._on_feedback, f"{type_name}_Feedback")
        topics = (
            ("status", STATUS, latched, self._on_status),
            ("feedback", f"{type_name}_FeedbackMessage", QosProfile(depth=BURST), on_feedback),
        )
        try:
            for name, message_type, qos, callback in topics:
                topic = f"{self.ros}/_action/{name}"
                subscription = self._node.subscribe_raw(topic, message_type, qos, callback)
                self._subscriptions.append(subscription)
        except (BusError, UnknownTypeError) as error:
            self._report(str(error))
            self._post(log.error, "%s has no feedback: %s", self.ros, error)

    def _unsubscribe(self) -> None:
        for subscription in self._subscriptions:
            subscription.destroy()
        self._subscriptions.clear()

    def close(self) -> None:
        """End the subscriptions of a removed action, and clear the retained status."""
        self._unsubscribe()
        self._clear_status()

    def on_bus_lost(self) -> None:
        """The node has ended, and its subscriptions with it."""
        self._subscriptions.clear()
        self._subscribed_type = None
        self._servers = 0
        self._clear_status()

    def _clear_status(self) -> None:
        """Queue the clearing behind a status that is still in the mailbox, as that one would be
        retained for good otherwise."""
        self._mailbox.put(self._status_lane, Message(f"{self._base}/_status", b"", 0, True))

    def _on_status(self, cdr: bytes) -> None:
        abandoned = self._snapshot.abandoned
        try:
            payload = goals.statuses(self._converters, cdr, self._encoding)
            running = goals.running(self._converters, cdr) if abandoned else []
        except ConversionError as error:
            self._report(str(error))
            return
        if any(id_ in abandoned for id_ in running):
            self._post(self._listener.goals_running, running)
        self._put(self._status_lane, f"{self._base}/_status", payload, STATUS, retain=True)

    def _on_feedback(self, type_name: str, cdr: bytes) -> None:
        id_, feedback = goals.split_id(cdr, self._node.serialization)
        try:
            payload = from_ros(self._converters, type_name, feedback, self._encoding)
        except (ConversionError, UnknownTypeError) as error:
            self._report(str(error))
            return
        lane = self._feedback_lanes.pop(id_, None) or self._new_lane()
        self._feedback_lanes[id_] = lane
        if len(self._feedback_lanes) > MAX_FEEDBACK_LANES:
            self._feedback_lanes.popitem(last=False)
        self._put(lane, f"{self._base}/_feedback/{id_.hex()}", payload, type_name)

    def _put(
        self, lane: Lane, topic: str, payload: bytes, type_name: str, *, retain: bool = False
    ) -> None:
        properties: Properties = {
            Property.CONTENT_TYPE: CONTENT_TYPE[self._encoding],
            Property.USER_PROPERTY: [("ros-type", type_name)],
        }
        self._mailbox.put(lane, Message(topic, payload, int(retain), retain, properties))

    def _report(self, problem: str) -> None:
        """Post a problem once: every message of a type that is not installed fails alike."""
        if problem != self._last_problem:
            self._last_problem = problem
            self._post(self._listener.topic_failed, problem)


class ActionTopics:
    """The subscriptions of all actions. `replace` is for the loop's thread, all else for the ROS
    thread."""

    def __init__(self, faults: Faults, post: Callable[..., None]) -> None:
        self._faults = faults
        self._post = post
        self._actions: tuple[ActionSubscriptions, ...] = ()

    def replace(self, actions: Iterable[ActionSubscriptions]) -> None:
        """Poll these from now on."""
        self._actions = tuple(actions)

    def poll_graph(self) -> None:
        """Let each action follow the graph; one that fails keeps no other from it."""
        for action in self._actions:
            try:
                action.poll_graph()
            except Exception as error:
                self._post(self._faults.caught, "actions.look", error, action.ros)

    def on_bus_lost(self) -> None:
        """The node has ended, and all subscriptions with it."""
        for action in self._actions:
            action.on_bus_lost()
