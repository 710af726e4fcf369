"""Carries one topic from ROS to MQTT, with its rate limit and its byte budget."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from time import monotonic

from appliance.broker.message import CountedMessage, Message
from appliance.mqtt.codec import Properties, encode_property_list, encode_string
from appliance.ros.mailbox import LARGE, Lane, Mailbox
from appliance.ros.node import Endpoint, QosProfile, RosNode, RosSubscription
from appliance.ros.payload.converter import ConversionError, Converters
from appliance.ros.payload.encodings.registry import ENCODINGS
from appliance.ros.payload.payloads import packer
from appliance.ros.qos import mqtt_qos, mqtt_retain, subscription_qos
from appliance.ros.topics.flow import BridgeRoute, EchoFilter, Flow, LogFunction
from appliance.ros.topics.transforms import TYPES, StaticTransforms

#: Seconds without a message after which a topic with a byte budget counts as silent.
QUIET = 1.0

#: The burst that the rate limit tolerates, in seconds of messages: those of a fast topic come in
#: batches when the computer is busy.
BURST_TOLERANCE = 0.05


class ToMqtt(Flow):
    """A flow from ROS to MQTT: a raw subscription whose messages are converted, throttled and put
    into the mailbox.

    `on_message` is called on the ROS thread, `on_batch` on the loop's, never both at once. All else
    is for the ROS thread.
    """

    direction = "to_mqtt"
    absence = "no node publishes it"

    def __init__(
        self,
        route: BridgeRoute,
        ros: str,
        converters: Converters,
        log: LogFunction,
        mailbox: Mailbox,
        publish: Callable[[Iterable[tuple[Lane, Message]]], None],
    ) -> None:
        """`publish` publishes messages that were received on the loop's thread."""
        super().__init__(route, ros, converters, log)
        settings = route.settings
        self.echo: EchoFilter | None = None
        self._mailbox = mailbox
        self._publish = publish
        self._lane = Lane(settings.samples, self.counters)
        self._interval = 1 / settings.rate if settings.rate else 0.0
        self._tolerance = max(0.0, BURST_TOLERANCE - self._interval)
        self._due = 0.0
        #: Bytes that may be sent now; negative after a message that was larger.
        self._budget = self._bytes_per_second = float(settings.bytes_per_second or 0)
        self._budget_at = 0.0
        #: The newest message that was throttled, and when it came. Both threads admit messages, one
        #: at a time.
        self._throttled: tuple[bytes, float] | None = None
        self._admission = threading.Lock()
        self._subscription: RosSubscription | None = None
        #: Whether a message was large although its type is not: texts and paths may be.
        self._is_large = False
        self._pack: Callable[[bytes], tuple[bytes, Properties]] = packer(None, "cdr", "none", [])
        self._transforms: StaticTransforms | None = None
        #: Merges a message with the earlier ones it belongs with, before any is throttled.
        self._merge: Callable[[bytes], bytes] | None = None
        self._topic_wire = encode_string(self.mqtt)
        #: The properties of the last message, most often those of the next, and their bytes.
        self._properties: Properties = {}
        self._properties_wire = b""
        self._qos = 0
        self._retain = False

    def __str__(self) -> str:
        return f"{self.ros} → {self.mqtt}"

    def _find(self, node: RosNode) -> list[Endpoint]:
        return node.publishers(self.ros)

    def _choose_qos(self, endpoints: list[Endpoint], type_name: str) -> QosProfile:
        qos = subscription_qos(endpoints, self._lane.depth, self._converters.bulk(type_name))
        if self._is_large and not mqtt_retain(
            qos
        ):  # a latched message would only be received once more
            return subscription_qos(endpoints, self._lane.depth)
        return qos

    def _open(self, node: RosNode, type_name: str, qos: QosProfile, type_hash: str | None) -> str:
        self._unsubscribe()
        settings = self.settings
        converter = None
        encoding = ENCODINGS[settings.encoding]
        if encoding.serialization is None:
            converter = self._converters.get(type_name, settings.fields)
            encoding.check(converter, to_ros=False)
        about = [("ros-type", type_name)]
        if type_hash is not None:
            about.append(("ros-type-hash", type_hash))
        self._pack = packer(converter, settings.encoding, settings.compression, about)
        wanted_qos, wanted_retain = settings.qos, settings.retain
        self._qos = mqtt_qos(qos) if wanted_qos is None else wanted_qos
        self._retain = mqtt_retain(qos) if wanted_retain is None else wanted_retain
        self._merge = None
        if type_name in TYPES and self._retain and mqtt_retain(qos):
            known = self._transforms or StaticTransforms(self._converters.get(type_name))
            self._transforms, self._merge = known, known.add
        self._subscription = node.subscribe_raw(
            self.ros, type_name, qos, self.on_message, timed=True, on_loop=self.on_batch
        )
        return f"; MQTT QoS {self._qos}{', retained' if self._retain else ''}"

    def close(self) -> None:
        self._unsubscribe()
        self._send_throttled()

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
        if self._throttled is not None:
            self._catch_up(monotonic())
        return has_changed

    def on_bus_lost(self) -> None:
        super().on_bus_lost()
        self._send_throttled()
        self._subscription = self._transforms = None

    def on_message(self, cdr: bytes, published_at: int = 0) -> None:
        """Take a message on the ROS thread; `published_at` is known for a few, in nanoseconds since
        the epoch."""
        message = self._convert(cdr, published_at)
        if message is not None:
            self._mailbox.put(self._lane, message)

    def on_batch(self, batch: list[tuple[bytes, int]], lost: int, is_late: bool) -> None:
        """Take a batch of messages on the loop's thread and publish it directly.

        Messages that are still in the mailbox go first. Of a late batch only the newest message is
        carried, unless the route keeps more, or they are latched: then each may be the last message
        of another publisher.
        """
        lane, wanted = self._lane, self._opened_for
        is_latched = wanted is not None and mqtt_retain(wanted[1])
        if is_late and lane.depth == 1 and not is_latched:
            lost += len(batch) - 1
            batch = batch[-1:]
        self.counters.dropped += lost
        messages = []
        failure: Exception | None = None
        for cdr, published_at in batch:
            try:
                message = self._convert(cdr, published_at)
            except Exception as error:  # it alone is lost, and raised after the others
                self.fail(f"ended in a fault: {error!r:.200}")
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

    def _convert(self, cdr: bytes, published_at: int) -> Message | None:
        """The message for MQTT; None for an echo, for a throttled one and one that has failed.

        Nothing may be logged by ROS here: it would feed /rosout.
        """
        if len(cdr) > LARGE:
            self._is_large = True  # the next thorough poll subscribes with a smaller depth
        if self.echo is not None and self.echo.is_own(cdr):
            return None
        if self._merge is not None:
            try:
                cdr = self._merge(cdr)
            except ConversionError as error:
                self.fail(f"cannot be converted: {error}")
                return None
        if self._interval or self._bytes_per_second:
            now = monotonic()
            with self._admission:
                is_admitted = self._admit(now)
                self._throttled = None if is_admitted else (cdr, now)
            if not is_admitted:
                return None
        return self._message(cdr, published_at)

    def _catch_up(self, now: float) -> None:
        """Send the throttled message if nothing has come since: a topic's last state is carried."""
        with self._admission:
            throttled = self._throttled
            if throttled is None or now < throttled[1] + (self._interval or QUIET):
                return
            self.counters.throttled -= 1  # it is counted once only
            if self._admit(now):
                self._release(throttled[0])

    def _send_throttled(self) -> None:
        """Send the throttled message although it is early: the flow ends."""
        with self._admission:
            if self._throttled is not None:
                self.counters.throttled -= 1
                self._release(self._throttled[0])

    def _release(self, cdr: bytes) -> None:
        self._throttled = None
        message = self._message(cdr, 0)
        if message is not None:
            self._mailbox.put(self._lane, message)

    def _message(self, cdr: bytes, published_at: int) -> Message | None:
        try:
            payload, properties = self._pack(cdr)
        except ConversionError as error:
            self.fail(f"cannot be converted: {error}")
            return None
        if self._bytes_per_second:
            self._budget -= len(payload)
        if properties is not self._properties:
            self._properties, self._properties_wire = properties, encode_property_list(properties)
        message = CountedMessage(
            self.mqtt,
            payload,
            self._qos,
            self._retain,
            properties,
            None,
            self._topic_wire,
            self._properties_wire,
        )
        message.skip_counter = self.counters
        if published_at:
            self._lane.timed = message, published_at
        return message

    def _admit(self, now: float) -> bool:
        """Whether a message at that time is within the rate limit, averaged over uneven gaps, and
        within the byte budget, of which one second can be saved up."""
        if self._bytes_per_second:
            saved = self._budget + (now - self._budget_at) * self._bytes_per_second
            self._budget = min(saved, self._bytes_per_second)
            self._budget_at = now
        if now < self._due or self._budget < 0:
            self.counters.throttled += 1
            return False
        if self._interval:
            late = now - self._due
            if late >= self._interval:
                late = min(late, self._tolerance)
            self._due = now - late + self._interval
        return True
