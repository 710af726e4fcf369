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
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import orjson

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ReasonCode
from appliance.ros.convert import Converters
from appliance.ros.definitions import describe
from appliance.ros.flows import Bridged, Direction, Flow, Pattern, RouteSettings, ToMqtt, ToRos
from appliance.ros.mailbox import Counters, Mailbox
from appliance.ros.node import RosNode

__all__ = ["Bridge", "Bridged", "RouteSettings", "RouteStatus"]

log = logging.getLogger(__name__)

CLIENT_ID = "_bridge"

#: Messages that the loop's thread publishes before it lets others have their turn.
BATCH = 64

#: Looks at the graph between two that do not trust the number of endpoints: one may have been
#: replaced by another. Some 2 s.
THOROUGH_LOOK = 13


@dataclass(frozen=True, slots=True)
class RouteStatus:
    """What one route carries in one direction, and what it has counted since the start."""

    settings: RouteSettings
    direction: Direction
    topics: tuple[Bridged, ...]
    messages: int
    bytes: int
    dropped: int
    throttled: int
    errors: int
    last_error: str | None


class Bridge:
    """Carries the routes' topics between a node and the broker."""

    def __init__(
        self,
        node: RosNode,
        broker: Broker,
        routes: Iterable[RouteSettings],
        loop: asyncio.AbstractEventLoop,
        robot: str,
    ) -> None:
        """Assign only; `robot` is the first level of `{robot}/_appliance/routes`."""
        self._node = node
        self._broker = broker
        self._loop = loop
        self._topic = f"{robot}/_appliance/routes"
        self._converters = Converters(lambda name: describe(node.load(name), node.load))
        self._mailbox = Mailbox(self._wake)
        self._session = None  # type: ...
