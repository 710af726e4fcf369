"""Follows a topic on the ROS graph: the ROS thread's part of a flow.

`poll_graph` derives the type and the QoS from the endpoints on the topic, and opens or reopens the
subscription or publisher that carries messages. What has become of the topic is a `TopicState`, an
immutable snapshot for the loop's thread.
"""

from __future__ import annotations

import itertools
import logging
from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass
from typing import ClassVar

from appliance.ros.metrics import ReceiveCounters
from appliance.ros.node import BusError, Endpoint, QosProfile, RosNode
from appliance.ros.payload.converter import ConversionError, Converters
from appliance.ros.payload.definitions import UnknownTypeError
from appliance.ros.skipped import Skipped
from appliance.ros.topics.echo import EchoFilter
from appliance.ros.topics.route import BridgedTopic, BridgeRoute, Direction, LogFunction

_NUMBERS = itertools.count()


@dataclass(frozen=True, slots=True)
class TopicState:
    """What has become of a topic; a snapshot from the ROS thread."""

    bridged: BridgedTopic | None = None
    #: The type that was last opened, or failed to be.
    type: str | None = None
    #: Whether the graph was asked for the topic.
    is_polled: bool = False
    #: Why the last set-up failed.
    problem: str | None = None
    #: Types that the topic carries beside the one that is bridged.
    other_types: tuple[str, ...] = ()

    def skips(self, topic: TopicFollower) -> list[Skipped]:
        """What of the topic is not carried, and why."""
        ros, direction = topic.ros, topic.direction
        if self.bridged is not None:
            reason = f"the topic carries {self.bridged.type} as well, which is bridged"
            return [Skipped(ros, direction, name, "two_types", reason) for name in self.other_types]
        if self.problem is not None:
            return [Skipped(ros, direction, self.type or "", "problem", self.problem)]
        if topic.is_matched or not self.is_polled:
            return []
        return [Skipped(ros, direction, topic.settings.type or "", "absent", topic.absence)]


@dataclass(frozen=True, slots=True)
class RoutedTopic:
    """A ROS topic of a route, and what its flow converts and logs with."""

    route: BridgeRoute
    ros: str
    converters: Converters
    log: LogFunction


class TopicFollower(ABC):
    """Follows one ROS topic for one direction.

    `state` is read by the loop's thread, and so are the counters; all else is for the ROS thread,
    except for the attributes that never change.
    """

    direction: ClassVar[Direction]
    #: Why a topic that a route names is not carried yet.
    absence: ClassVar[str]

    def __init__(self, topic: RoutedTopic) -> None:
        self.route = route = topic.route
        self.settings = settings = route.settings
        self.ros = topic.ros
        self.mqtt = settings.mqtt.replace("{ros}", topic.ros)
        #: What the ROS thread has counted; the loop's thread adds it to its own.
        self.counters = ReceiveCounters()
        self.state = TopicState()
        self.bridged: BridgedTopic | None = None
        #: Spreads the thorough polls of all flows over several polls.
        self.number = next(_NUMBERS)
        #: Whether a pattern found the topic: then it is bridged while other nodes have endpoints.
        self.is_matched = route.is_pattern
        self._converters = topic.converters
        self._log = topic.log
        self._count: tuple[int, int] | None = None
        #: Type, QoS and type hash that were last opened, or failed to be.
        self._opened_for: tuple[str, QosProfile, str | None] | None = None
        #: Why the last set-up failed.
        self._problem: str | None = None
        #: Whether the next poll must try again to open it.
        self._must_retry = False
        self._other_types: set[str] = set()

    def poll_graph(self, node: RosNode, thorough: bool) -> bool:
        """Follow the graph; returns whether what is bridged has changed.

        The endpoints are asked for only if their number has changed, or the poll is thorough.
        """
        count = node.count(self.ros)
        if count == self._count and not thorough and not self._must_retry:
            return False
        self._must_retry = False
        self._count = count
        try:
            return self._follow(node)
        finally:
            self._share()

    def _follow(self, node: RosNode) -> bool:
        endpoints = self._find(node)
        found = {endpoint.type for endpoint in endpoints}
        fitting = set(filter(self.route.fits, found))
        if self.is_matched and not fitting:
            was_bridged = self.bridged is not None
            self.close()
            self._opened_for = None
            return was_bridged
        known = self._opened_for[0] if self._opened_for else None
        if not self.is_matched and self.settings.type is not None:
            type_name = self.settings.type
        elif fitting:
            type_name = known if known in fitting else min(fitting)
        elif known is not None:
            type_name = known
        else:
            return False
        self._log_other_types(found - {type_name}, type_name)
        endpoints = [endpoint for endpoint in endpoints if endpoint.type == type_name]
        if not endpoints and self._opened_for is not None and self._opened_for[0] == type_name:
            return False  # the endpoints have left; keep everything open for their return
        # Towards ROS the hash is not needed, and a new publisher would first have to be discovered.
        ends = endpoints if self.direction == "to_mqtt" else []
        hashes = [end.type_hash for end in ends if end.type_hash]
        wanted = (type_name, self._choose_qos(endpoints, type_name), min(hashes, default=None))
        before = self.bridged
        if wanted == self._opened_for and (before is not None or self._problem is None):
            return False
        self._opened_for = wanted
        if before is not None and before.type != type_name:
            # The middleware allows one type per topic until the executor has released the last end.
            self.close()
            self._opened_for, self._must_retry = None, True
        else:
            self._try_open(node, *wanted)
        return self.bridged != before

    def _try_open(
        self, node: RosNode, type_name: str, qos: QosProfile, type_hash: str | None
    ) -> None:
        encoding = self.settings.encoding
        try:
            detail = self._open(node, type_name, qos, type_hash)
        except (BusError, UnknownTypeError, ConversionError) as error:
            self.close()
            self._must_retry = isinstance(error, BusError)
            problem = str(error)
            self.counters.note_error(problem)
            if problem != self._problem:
                self._problem = problem
                self._log(logging.ERROR, "%s is not bridged: %s", self, problem)
            return
        self._problem = None
        self.bridged = BridgedTopic(self.ros, self.mqtt, type_name, self.direction, encoding)
        self._log(logging.INFO, "%s: %s as %s; ROS %s%s", self, type_name, encoding, qos, detail)

    def reset(self, problem: str) -> None:
        """Close everything after a fault; the next poll opens it again."""
        self._problem = problem
        self.counters.note_error(problem)
        self._opened_for, self._must_retry = None, True
        with suppress(Exception):  # the fault was counted, and it may be half open
            self.close()
        self.bridged = None
        self._share()

    def _log_other_types(self, types: set[str], chosen: str) -> None:
        if types != self._other_types:
            self._other_types = types
            for name in sorted(types):
                self._log(
                    logging.WARNING,
                    "%s carries %s; the %s that is there too is left out",
                    self,
                    chosen,
                    name,
                )

    @abstractmethod
    def _find(self, node: RosNode) -> list[Endpoint]:
        """The endpoints of other nodes from which type and QoS are derived."""

    @abstractmethod
    def _choose_qos(self, endpoints: list[Endpoint], type_name: str) -> QosProfile:
        """The QoS to use with them."""

    @abstractmethod
    def _open(self, node: RosNode, type_name: str, qos: QosProfile, type_hash: str | None) -> str:
        """Open or reopen the subscription or publisher; returns details for the log.

        Raises BusError, UnknownTypeError, ConversionError.
        """

    def close(self) -> None:
        """Close the subscription or publisher; nothing is carried any more."""
        self.bridged = None
        self._share()
        self._close()

    @abstractmethod
    def _close(self) -> None:
        """Close the subscription or publisher, if there is one."""

    @abstractmethod
    def share_echo(self, echo: EchoFilter) -> None:
        """The topic is bridged both ways: share an echo filter with the other direction."""

    def on_bus_lost(self) -> None:
        """The bus is gone, and with it the subscription or publisher."""
        self.bridged = self._count = self._opened_for = None
        self._share()

    def _share(self) -> None:
        """Replace the snapshot for the loop's thread, if anything in it has changed."""
        wanted = self._opened_for
        state = TopicState(
            self.bridged,
            None if wanted is None else wanted[0],
            self._count is not None,
            self._problem,
            tuple(sorted(self._other_types)),
        )
        if state != self.state:
            self.state = state
