"""The publisher of a flow to ROS: the ROS thread's part of it."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from appliance.ros.node import Endpoint, QosProfile, RosNode, RosPublisher
from appliance.ros.payload.encodings.registry import ENCODINGS
from appliance.ros.payload.payloads import unpacker
from appliance.ros.qos import publisher_qos
from appliance.ros.topics.echo import EchoFilter
from appliance.ros.topics.follower import RoutedTopic, TopicFollower
from appliance.ros.topics.rules import CommandRules, FieldLimits
from appliance.ros.topics.stop_message import StopMessage, check_rules

#: Polls of the graph from the first one that finds a subscription until the initial stop message is
#: published: the two ends have found each other by then.
POLLS_TO_MATCH = 2


@dataclass(frozen=True, slots=True)
class Outlet:
    """How to convert messages of a type, and where to publish them."""

    type: str
    unpack: Callable[[bytes], bytes]
    publisher: RosPublisher
    #: Of the command rules, for this type.
    limits: FieldLimits | None = None


@dataclass(frozen=True, slots=True)
class Publication:
    """What a flow to ROS publishes with; a snapshot from the ROS thread.

    The stop message, which command rules set for a type, stays when the outlet is closed.
    `is_found` is whether a subscription has had the time to find the outlet's publisher, as far as
    command rules ask for that.
    """

    outlet: Outlet | None = None
    echo: EchoFilter | None = None
    stop: StopMessage | None = None
    is_found: bool = False


class PublicationListener(Protocol):
    """What is reported of a publisher; called on the loop's thread."""

    def on_resolved(self, name: str) -> None:
        """The topic has another name on ROS than it had."""

    def on_found(self) -> None:
        """A subscription on ROS has found our publisher."""


class PublicationFollower(TopicFollower):
    """Opens and closes the publisher of a flow to ROS.

    `publication` is read by the loop's thread.
    """

    direction = "to_ros"
    absence = "no node subscribes to it, which would tell its type; the route can name it"

    def __init__(
        self, topic: RoutedTopic, listener: PublicationListener, post: Callable[..., None]
    ) -> None:
        """`post` calls on the loop's thread."""
        super().__init__(topic)
        self.publication = Publication()
        # The flow owns this follower. Only the garbage collector would free a cycle of the two, and
        # it never looks at old objects (`app/main.py`).
        self._listener = weakref.ref(listener)
        self._post = post
        self._limits: FieldLimits | None = None
        #: The topic's name on ROS, where a remapping gives it another.
        self._name = topic.ros

    def __str__(self) -> str:
        return f"{self.mqtt} → {self.ros}"

    def _find(self, node: RosNode) -> list[Endpoint]:
        found = node.subscribers(self.ros)
        if found or self.is_matched:
            return found
        if self.settings.type is None and self.settings.to == "both":
            return node.publishers(self.ros)  # they have the type, too
        return found

    def _choose_qos(self, endpoints: list[Endpoint], type_name: str) -> QosProfile:
        return publisher_qos(endpoints, self.settings.samples)

    def _open(self, node: RosNode, type_name: str, qos: QosProfile, type_hash: str | None) -> str:
        settings = self.settings
        converter = self._converters.get(type_name)
        ENCODINGS[settings.encoding].check(converter, to_ros=True)
        unpack = unpacker(converter, settings.encoding, settings.compression, settings.limits)
        publisher = node.create_publisher(self.ros, type_name, qos)
        name = node.resolve(self.ros)
        listener = self._listener()
        if name != self._name and listener is not None:
            self._name = name
            self._post(listener.on_resolved, name)
        self._replace(Outlet(type_name, unpack, publisher, self._limits))
        return ""

    def _close(self) -> None:
        self._replace(None)

    def _replace(self, outlet: Outlet | None) -> None:
        """Replace the outlet. The publisher is destroyed when nobody begins to use it any more."""
        before = self.publication.outlet
        self.publication = replace(self.publication, outlet=outlet)
        if before is not None:
            before.publisher.destroy()

    def on_bus_lost(self) -> None:
        super().on_bus_lost()
        self.publication = replace(self.publication, outlet=None)

    @property
    def echo(self) -> EchoFilter | None:
        """The echo filter that is shared with the other direction."""
        return self.publication.echo

    def share_echo(self, echo: EchoFilter) -> None:
        self.publication = replace(self.publication, echo=echo)


class CommandPublicationFollower(PublicationFollower):
    """The same for a route with command rules, which depend on the type."""

    def __init__(
        self, topic: RoutedTopic, listener: PublicationListener, post: Callable[..., None]
    ) -> None:
        super().__init__(topic, listener, post)
        assert self.settings.rules is not None
        self._rules: CommandRules = self.settings.rules
        #: Polls that have found a subscription since this publisher was made.
        self._polls = 0

    def poll_graph(self, node: RosNode, thorough: bool) -> bool:
        has_changed = super().poll_graph(node, thorough)
        is_open = self.publication.outlet is not None
        if self._polls < POLLS_TO_MATCH and is_open and node.count(self.ros)[1]:
            self._polls += 1
            listener = self._listener()
            if self._polls == POLLS_TO_MATCH and listener is not None:
                self.publication = replace(self.publication, is_found=True)
                self._post(listener.on_found)
        return has_changed

    def _open(self, node: RosNode, type_name: str, qos: QosProfile, type_hash: str | None) -> str:
        self._limits, stop = check_rules(self._rules, self._converters.get(type_name))
        # No subscription has found the new publisher yet: as at the route's beginning, a stop
        # message that it sends now may be lost, and is sent again.
        self._polls = 0
        self.publication = replace(self.publication, stop=stop, is_found=False)
        return super()._open(node, type_name, qos, type_hash)
