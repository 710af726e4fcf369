"""Carries one topic from MQTT to ROS: the part of it on the loop's thread."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.broker.values import Decision, PublishRejection
from appliance.mqtt.codec import Property, quote
from appliance.mqtt.reason import ReasonCode
from appliance.net.callbacks import Entries
from appliance.ros.metrics import FlowCounters
from appliance.ros.node import BusError
from appliance.ros.payload.converter import ConversionError
from appliance.ros.payload.encodings.registry import ENCODINGS
from appliance.ros.payload.payloads import user_property
from appliance.ros.topics.conversions import LITTLE, ConversionQueue, size_of
from appliance.ros.topics.flow import Flow, ProblemLog
from appliance.ros.topics.follower import RoutedTopic
from appliance.ros.topics.lease import OVERTAKEN, Lease, Leases
from appliance.ros.topics.publication import Outlet, PublicationFollower
from appliance.ros.topics.staleness import StalenessDetector

#: Reasons that are sent to clients are cut to so many characters.
REASON_LENGTH = 500


class RuleViolationError(ConversionError):
    """A message was converted, but violates the route's rules."""


@dataclass(frozen=True, slots=True)
class ToRosContext:
    """What all flows to ROS share.

    `entries` call back on the loop's thread, `post` does so from any thread. `conversions` queues
    large messages.
    """

    entries: Entries
    post: Callable[..., None]
    broker: Broker
    leases: Leases
    conversions: ConversionQueue
    staleness: StalenessDetector


class ToRos(Flow):
    """A flow from MQTT to ROS, on the loop's thread: converts messages and publishes them.

    Its publisher is opened and closed by its follower, on the ROS thread.
    """

    follower: PublicationFollower
    _follower_type: ClassVar[type[PublicationFollower]] = PublicationFollower

    def __init__(self, topic: RoutedTopic, context: ToRosContext) -> None:
        follower = self._follower_type(topic, self, context.post)
        super().__init__(follower, topic.log, FlowCounters())
        self.follower = follower
        self._problems = ProblemLog(str(follower), topic.log)
        self._context = context
        self._is_left = True
        #: The topic's name on ROS, where a remapping gives it another.
        self._name = topic.ros
        self._lease = Lease(topic.ros)

    def fail(self, problem: str) -> None:
        """Count a message that could not be carried, and log that at most once a minute."""
        self.counters.errors += 1
        self._log_uncarried(problem, self.counters.errors)

    def refuse(self, problem: str) -> None:
        """Count a message that violates the route's rules, and log that at most once a minute."""
        self.counters.refused += 1
        self._log_uncarried(problem, self.counters.refused)

    def _log_uncarried(self, problem: str, count: int) -> None:
        self.counters.note_error(problem)
        self._problems.add(problem, count)

    @property
    def takes_retained(self) -> bool:
        """Whether the route takes messages that were retained before it subscribed."""
        rules = self.settings.rules
        return rules is not None and rules.take_retained

    def enter(self, before: ToRos | None) -> None:
        """Messages are received from now on; until now `before` has received them."""
        self._is_left = False
        self._share_lease()
        broker = self._context.broker
        # Also without rules: the topic is then known as one that no response is published on.
        broker.guards.setdefault(self.mqtt, []).append(self)
        broker.guards_changed()

    def leave(self) -> None:
        """No messages are received any more; may be called twice."""
        if self._is_left:
            return
        self._is_left = True
        broker = self._context.broker
        guards = broker.guards[self.mqtt]
        guards.remove(self)
        if not guards:
            del broker.guards[self.mqtt]
        broker.guards_changed()

    def receive(
        self, message: Message, retain: bool, origin: Session | None, number: int
    ) -> PublishRejection | None:
        """Convert a message from MQTT and publish it on ROS; a rejection is logged and returned.

        `origin` is the session that published it, `number` the staleness detector's. With `retain`
        the message was retained before the route: it may be an old command, and does not reach ROS.
        """
        if retain:
            return None
        if self._lease.is_overtaken(number, origin):  # while it was queued
            self.counters.expired += 1
            self._log_uncarried(f"was not published: {OVERTAKEN}", self.counters.expired)
            return None
        cdr = self._convert(message, origin)
        return (
            cdr
            if isinstance(cdr, PublishRejection)
            else self._publish(cdr, message, origin, number)
        )

    def _convert(self, message: Message, origin: Session | None) -> bytes | PublishRejection:
        """The message as CDR, or its rejection, which is logged."""
        outlet = self.follower.publication.outlet
        if outlet is None:
            return self._fail_and_reject(message, f"was refused: {self._why_not()}")
        try:
            return self._read(outlet, message, origin)
        except RuleViolationError as error:
            problem = f"was refused: {error}"
            self.refuse(problem)
            return self.reject(message, problem)
        except ConversionError as error:
            problem = f"cannot be converted: {error}"
            return self._fail_and_reject(message, problem, ReasonCode.PAYLOAD_FORMAT_INVALID)

    def _publish(
        self, cdr: bytes, message: Message, origin: Session | None, number: int
    ) -> PublishRejection | None:
        """Publish the converted message on ROS; returns a rejection if that fails."""
        publication = self.follower.publication
        outlet = publication.outlet
        if outlet is None:
            return self._fail_and_reject(message, f"was refused: {self._why_not()}")
        try:
            if publication.echo is not None:
                publication.echo.sent(cdr)
            outlet.publisher.publish(cdr)
        except BusError as error:
            return self._fail_and_reject(message, f"could not be published: {error}")
        finally:  # a stop overtakes earlier commands although ROS has not taken it
            self._lease.on_published(cdr, number, origin, self._context.entries.time())
        self.counters.messages += 1
        self.counters.bytes += len(message.payload)
        return None

    def _fail_and_reject(
        self,
        message: Message,
        problem: str,
        code: ReasonCode = ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR,
    ) -> PublishRejection:
        self.fail(problem)
        return self.reject(message, problem, code)

    def reject(
        self,
        message: Message,
        problem: str,
        code: ReasonCode = ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR,
    ) -> PublishRejection:
        """The rejection that is sent to the client; for QoS 1 its PUBACK carries it."""
        rejection = PublishRejection(code, f"a message for {self.ros} {problem}"[:REASON_LENGTH])
        # Only while its publisher waits for an answer: a message that is retained or queued would
        # keep the reason, uncounted.
        if message.qos == 1 and message.publisher is not None:
            message.rejection = rejection
        return rejection

    def obstacle(self) -> str:
        """Why nobody on ROS would receive a message now; empty when somebody would."""
        outlet = self.follower.publication.outlet
        if outlet is None:
            return f"{self.ros}: {self._why_not()}"
        return "" if outlet.publisher.has_subscribers else f"no node has subscribed to {self.ros}"

    def fault(self, message: Message, error: Exception) -> PublishRejection:
        """Reject a message because of a fault of the appliance, which is reported."""
        self._context.broker.faults.caught("bridge.receive", error, self)
        self.counters.errors += 1
        return self.reject(message, "could not be carried: see the log")

    # A Guard of the broker: who may publish

    def decide(self, session: Session) -> Decision:
        """Whether the session may publish a command now."""
        return self._lease.decide(session)

    def announced(self, message: Message, session: Session) -> None:
        """A message of QoS 2 has come that is not released yet; command rules need its time."""

    def inspect(self, message: Message, session: Session) -> PublishRejection | None:
        """Reject a message of QoS 2 that cannot be converted. A large one is examined only if no
        other conversion is going on; otherwise it is in its turn."""
        conversions = self._context.conversions
        if size_of(message.payload) <= LITTLE:
            cdr = conversions.little(partial(self._convert, message, session))
        elif conversions.is_busy:
            return None
        else:
            cdr = conversions.now(partial(self._convert, message, session)) or b""
        return cdr if isinstance(cdr, PublishRejection) else None

    def refused(self, session: Session) -> None:
        """A message of the session was refused, by this guard or another."""
        if not self.decide(session):
            self.counters.refused += 1

    # A PublicationListener

    def on_resolved(self, name: str) -> None:
        """The topic has another name on ROS: share the lease by that one."""
        self._name = name
        self._share_lease()

    def on_found(self) -> None:
        """A subscription on ROS has found our publisher, which only command rules ask for."""

    def _share_lease(self) -> None:
        """Share the lease with all flows to the topic, by whatever route and name."""
        self._lease = self._context.leases.of(self._name)
        self._context.broker.guards_changed()

    def _read(self, outlet: Outlet, message: Message, origin: Session | None) -> bytes:
        """The message as CDR. Raises ConversionError, also if its properties state another type."""
        properties = message.properties
        if properties is None:
            return outlet.unpack(message.payload)
        claimed = user_property(properties, "ros-type")
        if claimed is not None and claimed != outlet.type:
            problem = f"it says to be {quote(claimed)}, {self.ros} carries {outlet.type}"
            raise ConversionError("", problem)
        try:
            return outlet.unpack(message.payload)
        except ConversionError as error:
            stated = properties.get(Property.CONTENT_TYPE)
            encoding = self.settings.encoding
            if not isinstance(stated, str) or stated == ENCODINGS[encoding].content_type:
                raise
            problem = (
                f"{error.problem} (it says to be {quote(stated)}, and the route takes {encoding})"
            )
            raise ConversionError(error.path, problem) from None

    def _why_not(self) -> str:
        state = self.follower.state
        if state.type is not None:
            return "its type cannot be bridged"
        if not state.is_polled:
            return "ROS is not ready"
        return f"no node subscribes to {self.ros}, which would tell its type; the route can name it"
