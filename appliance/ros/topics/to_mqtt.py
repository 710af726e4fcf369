"""Carries one topic from ROS to MQTT, with its rate limit and its byte budget.

`SubscriptionFollower` is the ROS thread's part, `ToMqtt` the loop's. Either may be handed messages,
but never both at once; what they know of the messages before is in `RosMessages`.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from time import monotonic

from appliance.broker.message import CountedMessage, Message
from appliance.mqtt.codec import Properties, encode_property_list, encode_string
from appliance.ros.mailbox import LARGE, Lane, Mailbox
from appliance.ros.metrics import FlowCounters, ReceiveCounters
from appliance.ros.node import Endpoint, QosProfile, RosNode, RosSubscription, TakeBatch
from appliance.ros.payload.converter import ConversionError
from appliance.ros.payload.encodings.base import PictureOptions
from appliance.ros.payload.encodings.registry import ENCODINGS
from appliance.ros.payload.payloads import packer
from appliance.ros.qos import mqtt_qos, mqtt_retain, subscription_qos
from appliance.ros.topics.echo import EchoFilter
from appliance.ros.topics.flow import Flow, ProblemLog
from appliance.ros.topics.follower import RoutedTopic, TopicFollower
from appliance.ros.topics.off_loop import ConversionThreads, Converted, TopicConversions
from appliance.ros.topics.route import BridgeRoute
from appliance.ros.topics.transforms import TYPES, StaticTransforms

#: Seconds without a message after which a topic with a byte budget counts as silent.
QUIET = 1.0

#: The burst that the rate limit tolerates, in seconds of messages: those of a fast topic come in
#: batches when the computer is busy.
BURST_TOLERANCE = 0.05


@dataclass(frozen=True, slots=True)
class Intake:
    """How messages from ROS are converted; a snapshot from the ROS thread."""

    pack: Callable[[bytes], tuple[bytes, Properties]]
    #: Merges a message with the earlier ones it belongs with, before any is throttled.
    merge: Callable[[bytes], bytes] | None = None
    qos: int = 0
    retain: bool = False
    #: Whether the publishers retain messages for late subscribers.
    is_latched: bool = False
    echo: EchoFilter | None = None
    #: Whether that takes so long that it is done on a thread.
    is_slow: bool = False


class RosMessages:
    """Converts and throttles the messages of one topic.

    `convert` and `fail` are for the thread that has been handed a message, never both at once, and
    all else is for the ROS thread, which may send the throttled message at the same time. Each
    thread passes its own counters.
    """

    def __init__(
        self,
        route: BridgeRoute,
        mqtt: str,
        lane: Lane,
        mailbox: Mailbox,
        counters: ReceiveCounters,
        problems: ProblemLog,
        threads: ConversionThreads,
    ) -> None:
        """`counters` are the ROS thread's; those of the loop's thread are the lane's."""
        settings = route.settings
        self._mqtt = mqtt
        self._lane = lane
        self._mailbox = mailbox
        self._counters = counters
        self._problems = problems
        self._conversions = TopicConversions(threads)
        self._interval = 1 / settings.rate if settings.rate else 0.0
        self._tolerance = max(0.0, BURST_TOLERANCE - self._interval)
        self._due = 0.0
        #: Bytes that may be sent now; negative after a message that was larger.
        self._budget = self._bytes_per_second = float(settings.bytes_per_second or 0)
        self._budget_at = 0.0
        #: The newest message that was throttled, and when it came. The poll may send it while the
        #: loop's thread is handed another message: messages are admitted one at a time.
        self._throttled: tuple[bytes, float] | None = None
        self._admission = threading.Lock()
        #: Whether a message was large although its type is not: texts and paths may be.
        self.is_large = False
        self._topic_wire = encode_string(mqtt)
        #: The properties of the last message, most often those of the next, and their bytes; in one
        #: tuple, because two threads may replace it.
        self._last: tuple[Properties, bytes] = ({}, b"")

    def convert(
        self, intake: Intake, cdr: bytes, published_at: int, counters: ReceiveCounters
    ) -> Message | None:
        """The message for MQTT; None for an echo, for a throttled one, one that has failed, and one
        that is being converted on a thread, which then puts it into the mailbox.

        Nothing may be logged by ROS here: it would feed /rosout.
        """
        if len(cdr) > LARGE:
            self.is_large = True  # the next thorough poll subscribes with a smaller depth
        if intake.echo is not None and intake.echo.is_own(cdr):
            return None
        if intake.merge is not None:
            try:
                cdr = intake.merge(cdr)
            except ConversionError as error:
                self.fail(f"cannot be converted: {error}", counters)
                return None
        if self._interval or self._bytes_per_second:
            now = monotonic()
            with self._admission:
                is_admitted = self._admit(now, counters)
                self._throttled = None if is_admitted else (cdr, now)
            if not is_admitted:
                return None
        if intake.is_slow:
            self._convert_slowly(intake, cdr, published_at, counters)
            return None
        message = self._message(intake, cdr, published_at, counters)
        if message is not None:
            self._spend(message)
        return message

    def _spend(self, message: Message) -> None:
        if self._bytes_per_second:
            with self._admission:
                self._budget -= len(message.payload)

    def _convert_slowly(
        self, intake: Intake, cdr: bytes, published_at: int, counters: ReceiveCounters
    ) -> None:
        """Convert it on a thread, and put it into the mailbox."""

        def take(converted: Converted) -> None:
            if isinstance(converted, ConversionError):
                self.fail(f"cannot be converted: {converted}", self._lane.counters)
            elif isinstance(converted, Exception):
                self.fail(f"ended in a fault: {converted!r:.200}", self._lane.counters)
                raise converted
            else:
                message = self._made(intake, *converted, published_at)
                self._spend(message)
                self._mailbox.put(self._lane, message)

        self._conversions.put(partial(intake.pack, cdr), take, counters)

    def fail(self, problem: str, counters: ReceiveCounters) -> None:
        """Count a message that could not be carried, and log that at most once a minute."""
        counters.errors += 1
        counters.note_error(problem)
        self._problems.add(problem, self._counters.errors + self._lane.counters.errors)

    def catch_up(self, intake: Intake) -> None:
        """Send the throttled message if nothing has come since: a topic's last state is carried."""
        if self._throttled is None:
            return
        now = monotonic()
        with self._admission:
            throttled = self._throttled
            if throttled is None or now < throttled[1] + (self._interval or QUIET):
                return
            self._counters.throttled -= 1  # it is counted once only
            if self._admit(now, self._counters):
                self._release(intake, throttled[0])

    def open(self) -> None:
        """Messages come from now on; after `close`, too."""
        self._conversions.open()

    def close(self, intake: Intake) -> None:
        """The flow ends, or what it carries does: send the throttled message although it is early.

        Pictures that are not done are not sent: they would come when the topic belongs to nobody
        any more, or to another route.
        """
        self._conversions.close(self._counters)
        self.send_throttled(intake)

    def send_throttled(self, intake: Intake) -> None:
        """Send the throttled message although it is early: nothing comes after it for now."""
        with self._admission:
            if self._throttled is not None:
                self._counters.throttled -= 1
                self._release(intake, self._throttled[0])

    def _release(self, intake: Intake, cdr: bytes) -> None:
        self._throttled = None
        if intake.is_slow:
            self._convert_slowly(intake, cdr, 0, self._counters)
            return
        message = self._message(intake, cdr, 0, self._counters)
        if message is not None:
            if self._bytes_per_second:
                self._budget -= len(message.payload)
            self._mailbox.put(self._lane, message)

    def _message(
        self, intake: Intake, cdr: bytes, published_at: int, counters: ReceiveCounters
    ) -> Message | None:
        try:
            payload, properties = intake.pack(cdr)
        except ConversionError as error:
            self.fail(f"cannot be converted: {error}", counters)
            return None
        return self._made(intake, payload, properties, published_at)

    def _made(
        self, intake: Intake, payload: bytes, properties: Properties, published_at: int
    ) -> Message:
        """The message for MQTT that this has become."""
        known, wire = self._last
        if properties is not known:
            wire = encode_property_list(properties)
            self._last = properties, wire
        message = CountedMessage(
            self._mqtt,
            payload,
            intake.qos,
            intake.retain,
            properties,
            None,
            self._topic_wire,
            wire,
        )
        message.skip_counter = self._lane.counters
        if published_at:
            self._lane.timed = message, published_at
        return message

    def _admit(self, now: float, counters: ReceiveCounters) -> bool:
        """Whether a message at that time is within the rate limit, averaged over uneven gaps, and
        within the byte budget, of which one second can be saved up."""
        if self._bytes_per_second:
            saved = self._budget + (now - self._budget_at) * self._bytes_per_second
            self._budget = min(saved, self._bytes_per_second)
            self._budget_at = now
        if now < self._due or self._budget < 0:
            counters.throttled += 1
            return False
        if self._interval:
            late = now - self._due
            if late >= self._interval:
                late = min(late, self._tolerance)
            self._due = now - late + self._interval
        return True


class SubscriptionFollower(TopicFollower):
    """Opens and closes the subscription of a flow to MQTT, and takes messages on the ROS thread.

    `intake` is read by the loop's thread.
    """

    direction = "to_mqtt"
    absence = "no node publishes it"

    def __init__(
        self,
        topic: RoutedTopic,
        mailbox: Mailbox,
        lane: Lane,
        on_batch: TakeBatch,
        threads: ConversionThreads,
    ) -> None:
        """`on_batch`, a method of the flow, takes messages on the loop's thread."""
        super().__init__(topic)
        self.intake = Intake(packer(None, "cdr", "none", []))
        problems = ProblemLog(str(self), topic.log)
        self.messages = RosMessages(
            self.route, self.mqtt, lane, mailbox, self.counters, problems, threads
        )
        self._mailbox = mailbox
        self._lane = lane
        # The flow owns this follower. Only the garbage collector would free a cycle of the two, and
        # it never looks at old objects (`app/main.py`).
        self._on_batch = weakref.WeakMethod(on_batch)
        self._subscription: RosSubscription | None = None
        self._transforms: StaticTransforms | None = None

    def __str__(self) -> str:
        return f"{self.ros} → {self.mqtt}"

    def _find(self, node: RosNode) -> list[Endpoint]:
        return node.publishers(self.ros)

    def _choose_qos(self, endpoints: list[Endpoint], type_name: str) -> QosProfile:
        qos = subscription_qos(endpoints, self._lane.depth, self._converters.bulk(type_name))
        if self.messages.is_large and not mqtt_retain(
            qos
        ):  # a latched message would only be received once more
            return subscription_qos(endpoints, self._lane.depth)
        return qos

    def _open(self, node: RosNode, type_name: str, qos: QosProfile, type_hash: str | None) -> str:
        self._unsubscribe()
        settings = self.settings
        converter = None
        encoding = ENCODINGS[settings.encoding]
        self.messages.open()
        if encoding.serialization is None:
            converter = self._converters.get(type_name, settings.fields)
            encoding.check(converter, to_ros=False)
        about = [("ros-type", type_name)]
        if type_hash is not None:
            about.append(("ros-type-hash", type_hash))
        picture = PictureOptions(settings.quality, settings.max_width)
        pack = packer(converter, settings.encoding, settings.compression, about, picture)
        is_latched = mqtt_retain(qos)
        wanted_qos, wanted_retain = settings.qos, settings.retain
        level = mqtt_qos(qos) if wanted_qos is None else wanted_qos
        retain = is_latched if wanted_retain is None else wanted_retain
        merge = None
        if type_name in TYPES and retain and is_latched:
            known = self._transforms or StaticTransforms(self._converters.get(type_name))
            self._transforms, merge = known, known.add
        # Messages come as soon as there is a subscription.
        self.intake = Intake(
            pack, merge, level, retain, is_latched, self.intake.echo, encoding.is_slow
        )
        self._subscription = node.subscribe_raw(
            self.ros, type_name, qos, self.on_message, timed=True, on_loop=self._on_batch()
        )
        return f"; MQTT QoS {level}{', retained' if retain else ''}"

    def _close(self) -> None:
        self._unsubscribe()
        self.messages.close(self.intake)

    def _unsubscribe(self) -> None:
        self.bridged = None
        if self._subscription is not None:
            self.counters.lost += self._subscription.take_lost()
            self._subscription.destroy()
            self._subscription = None

    def poll_graph(self, node: RosNode, thorough: bool) -> bool:
        has_changed = super().poll_graph(node, thorough)
        if thorough and self._subscription is not None:
            self.counters.lost += self._subscription.take_lost()
        self.messages.catch_up(self.intake)
        return has_changed

    def on_bus_lost(self) -> None:
        super().on_bus_lost()
        self.messages.send_throttled(self.intake)
        self._subscription = self._transforms = None

    @property
    def echo(self) -> EchoFilter | None:
        """The echo filter that is shared with the other direction."""
        return self.intake.echo

    def share_echo(self, echo: EchoFilter) -> None:
        self.intake = replace(self.intake, echo=echo)

    def on_message(self, cdr: bytes, published_at: int = 0) -> None:
        """Take a message; `published_at` is known for a few, in nanoseconds since the epoch."""
        message = self.messages.convert(self.intake, cdr, published_at, self.counters)
        if message is not None:
            self._mailbox.put(self._lane, message)


class ToMqtt(Flow):
    """A flow from ROS to MQTT, on the loop's thread: takes batches of messages and publishes them.

    Its raw subscription is opened and closed by its follower, which also takes the messages that
    come on the ROS thread, and puts them into the mailbox.
    """

    follower: SubscriptionFollower

    def __init__(
        self,
        topic: RoutedTopic,
        mailbox: Mailbox,
        publish: Callable[[Iterable[tuple[Lane, Message]]], None],
        threads: ConversionThreads,
    ) -> None:
        """`publish` publishes messages that were received on the loop's thread."""
        counters = FlowCounters()
        self._lane = lane = Lane(topic.route.settings.samples, counters)
        follower = SubscriptionFollower(topic, mailbox, lane, self.on_batch, threads)
        super().__init__(follower, topic.log, counters)
        self.follower = follower
        self._messages = follower.messages
        self._mailbox = mailbox
        self._publish = publish

    def add_to(self, total: FlowCounters) -> None:
        super().add_to(total)
        total.dropped += self._lane.dropped

    def finish(self) -> None:
        self._publish([(self._lane, message) for message in self._mailbox.take_of(self._lane)])

    def on_batch(self, batch: list[tuple[bytes, int]], lost: int, is_late: bool) -> None:
        """Take a batch of messages and publish it directly.

        Messages that are still in the mailbox go first. Of a late batch only the newest message is
        carried, unless the route keeps more, or they are latched: then each may be the last message
        of another publisher.
        """
        lane, counters = self._lane, self.counters
        intake, convert = self.follower.intake, self._messages.convert
        if is_late and lane.depth == 1 and not intake.is_latched:
            lost += len(batch) - 1
            batch = batch[-1:]
        counters.dropped += lost
        messages = []
        failure: Exception | None = None
        for cdr, published_at in batch:
            try:
                message = convert(intake, cdr, published_at, counters)
            except Exception as error:  # it alone is lost, and raised after the others
                self._messages.fail(f"ended in a fault: {error!r:.200}", counters)
                failure = error
                continue
            if message is None:
                continue
            if lane.waiting:
                self._mailbox.put(lane, message)
            else:
                messages.append((lane, message))
        if messages:
            self._publish(messages)
        if failure is not None:
            raise failure
