"""Makes the flows of routes, with all that a flow needs beside its route."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from appliance.broker.message import Message
from appliance.ros.mailbox import Lane, Mailbox
from appliance.ros.payload.converter import Converters
from appliance.ros.topics.commands import Commands
from appliance.ros.topics.follower import RoutedTopic
from appliance.ros.topics.off_loop import ConversionThreads
from appliance.ros.topics.route import BridgeRoute, LogFunction
from appliance.ros.topics.to_mqtt import ToMqtt
from appliance.ros.topics.to_ros import ToRos, ToRosContext


@dataclass(frozen=True, slots=True)
class FlowFactory:
    """Makes flows, on either thread.

    `publish` is how a flow to MQTT publishes what it has received on the loop's thread.
    """

    converters: Converters
    log: LogFunction
    mailbox: Mailbox
    publish: Callable[[Iterable[tuple[Lane, Message]]], None]
    context: ToRosContext
    threads: ConversionThreads

    def to_mqtt(self, route: BridgeRoute, ros: str) -> ToMqtt:
        """A flow from a ROS topic to MQTT."""
        return ToMqtt(self._topic(route, ros), self.mailbox, self.publish, self.threads)

    def to_ros(self, route: BridgeRoute, ros: str) -> ToRos:
        """A flow from MQTT to a ROS topic, with the route's command rules if it has some."""
        flow_type = ToRos if route.settings.rules is None else Commands
        return flow_type(self._topic(route, ros), self.context)

    def _topic(self, route: BridgeRoute, ros: str) -> RoutedTopic:
        return RoutedTopic(route, ros, self.converters, self.log)
