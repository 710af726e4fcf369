"""A topic from MQTT to ROS."""

from __future__ import annotations

from collections.abc import Callable

from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.mqtt.codec import Property, quote
from appliance.ros.convert import ConversionError, Converters
from appliance.ros.flows import Echo, Flow, Route, Tell
from appliance.ros.node import BusError, Endpoint, QosProfile, RosNode, RosPublisher
from appliance.ros.payloads import CONTENT_TYPE, check, claim, unpacker
from appliance.ros.qos import publisher_qos


class ToRos(Flow):
    """From MQTT to ROS: a publisher. `receive` and `fail` are for the loop's thread."""

    direction = "to_ros"
    absence = "no node subscribes to it, which would tell its type; the route can name it"

    def __init__(
        self,
        route: Route,
        ros: str,
        converters: Converters,
        tell: Tell,
    ) -> None:
        super().__init__(route, ros, converters, tell)
        self.echo: Echo | None = None
        #: Replaced as one, because the loop's thread reads it.
        self._out: tuple[Callable[[bytes], bytes], RosPublisher] | None = None

    def __str__(self) -> str:
        return f"{self.mqtt} → {self.ros}"

    def _find(self, node: RosNode) -> list[Endpoint]:
        found = node.subscribers(self.ros)
        if found or self.is_matched:
            return found
        if self.settings.type is None and self.settings.to == "both":
            return node.publishers(self.ros)  # whoever is there knows the type
        return found

    def _choose_qos(self, endpoints: list[Endpoint], type_name: str) -> QosProfile:
        return publisher_qos(endpoints, self.settings.samples)

    def _open(self, node: RosNode, type_name: str, qos: QosProfile, type_hash: str | None) -> str:
        settings = self.settings
        converter = self._converters.get(type_name)
        check(converter, settings.encoding, to_ros=True)
        unpack = unpacker(converter, settings.encoding, settings.compression, settings.largest)
        publisher = node.create_publisher(self.ros, type_name, qos)
        before, self._out = self._out, (unpack, publisher)
        if before is not None:
            before[1].destroy()
        return ""

    def close(self) -> None:
        self.bridged = None
        before, self._out = self._out, None
        if before is not None:
            before[1].destroy()

    def lost(self) -> None:
        super().lost()
        self._out = None

    @property
    def takes_retained(self) -> bool:
        """Whether retained messages from before the route are wanted."""
        rules = self.settings.rules
        return rules is not None and rules.take_retained

    def enter(self, before: ToRos | None) -> None:
        """Messages are going to be received from now on; until now `before` has had them."""

    def leave(self) -> None:
        """None will be received any more."""

    def receive(self, message: Message, retain: bool, origin: Session | None) -> None:
        """A message from MQTT, of that session; `retain` when it is from before the route.

        It may then be an old command, and does not reach ROS.
        """
        if retain:
            return
        out = self._out
        if out is None:
            self.fail(f"was refused: {self._why_not()}")
            return
        self._publish(*out, message, origin)

    def _publish(
        self,
        convert: Callable[[bytes], bytes],
        publisher: RosPublisher,
        message: Message,
        origin: Session | None,
    ) -> bytes | None:
        """Publish the message on ROS; its CDR, or None when that failed, which is told."""
        try:
            cdr = self._read(convert, message, origin)
            if self.echo is not None:
                self.echo.sent(cdr)
            publisher.publish(cdr)
        except ConversionError as error:
            self.fail(f"cannot be converted: {error}")
        except BusError as error:
            self.fail(f"could not be published: {error}")
        else:
            self.counters.messages += 1
            self.counters.bytes += len(message.payload)
            return cdr
        return None

    def _read(
        self, convert: Callable[[bytes], bytes], message: Message, origin: Session | None
    ) -> bytes:
        """The message's CDR. Raises ConversionError, also for what says to be something else."""
        properties = message.properties
        if properties is None:
            return convert(message.payload)
        wanted = self._wanted
        claimed = claim(properties, "ros-type")
        if wanted is not None and claimed is not None and claimed != wanted[0]:
            problem = f"it says to be {quote(claimed)}, {self.ros} carries {wanted[0]}"
            raise ConversionError("", problem)
        try:
            return convert(message.payload)
        except ConversionError as error:
            said = properties.get(Property.CONTENT_TYPE)
            encoding = self.settings.encoding
            if not isinstance(said, str) or said == CONTENT_TYPE[encoding]:
                raise
            problem = (
                f"{error.problem} (it says to be {quote(said)}, and the route takes {encoding})"
            )
            raise ConversionError(error.path, problem) from None

    def _why_not(self) -> str:
        if self._wanted is not None:
            return "its type cannot be bridged"
        if self._count is None:
            return "ROS is not ready"
        return f"no node subscribes to {self.ros}, which would tell its type; the route can name it"
