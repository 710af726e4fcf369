"""Routes of topics and their flows: a flow carries one ROS topic in one direction.

A flow follows its topic on the ROS thread: `poll_graph` derives the type and the QoS from the
endpoints on the topic, and opens or reopens the subscription or publisher that carries messages.
"""

from __future__ import annotations

import itertools
import logging
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from time import monotonic
from typing import ClassVar, Literal, Protocol, TypeAlias

from appliance.ros.metrics import FlowCounters, Meter
from appliance.ros.node import BusError, Endpoint, QosProfile, RosNode
from appliance.ros.patterns import Names, compile_pattern
from appliance.ros.payload.converter import ConversionError, Converters
from appliance.ros.payload.definitions import CDR, Serialization, UnknownTypeError
from appliance.ros.payload.encodings.base import EncodingName
from appliance.ros.payload.payloads import Compression, InputLimits
from appliance.ros.skipped import Skipped, SkipReason
from appliance.ros.topics.rules import CommandRules

Direction: TypeAlias = Literal["to_mqtt", "to_ros"]

#: Errors of a flow are logged at most once in so many seconds.
LOG_INTERVAL = 60.0

#: Seconds within which a sample of our own comes back; within one process it takes microseconds.
#: And the most samples that are remembered for that.
ECHO_TIME = 2.0
ECHO_SAMPLES = 1000

_NUMBERS = itertools.count()


@dataclass(frozen=True, slots=True)
class TopicSettings:
    """The settings of a route for topics.

    `ros` is the name of a topic, or a pattern, or several of both: `*` matches within a part of a
    name, `**` matches a path, and a leading `!` excludes. `mqtt` is a topic; a `{ros}` in it is
    replaced by the ROS name.

    None means: no limit (`rate`, in Hz, and `bytes_per_second` of payload), taken from the graph
    (`type`, which may contain a `*`, too), taken from the publishers' QoS (`qos`, `retain`). `keep`
    is how many messages of a topic are queued for a busy broker. `fields` are the paths of the
    fields that go to MQTT, all of them if empty; `limits` are for messages from MQTT.
    """

    ros: str | tuple[str, ...]
    to: Literal["mqtt", "ros", "both"]
    mqtt: str
    type: str | None = None
    encoding: EncodingName = "json"
    rate: float | None = None
    qos: int | None = None
    retain: bool | None = None
    keep: int | Literal["latest"] = "latest"
    compression: Compression = "none"
    fields: tuple[str, ...] = ()
    bytes_per_second: int | None = None
    limits: InputLimits = field(default_factory=InputLimits)
    #: The command rules for messages to ROS; None for no rules but the types.
    rules: CommandRules | None = None

    @property
    def samples(self) -> int:
        """`keep` as a number."""
        return 1 if self.keep == "latest" else self.keep

    @property
    def names(self) -> tuple[str, ...]:
        """`ros` as a tuple."""
        return (self.ros,) if isinstance(self.ros, str) else self.ros

    @property
    def is_pattern(self) -> bool:
        """Whether the topics of this route are found on the graph."""
        return not isinstance(self.ros, str) or "*" in self.ros or "*" in (self.type or "")


class BridgeRoute:
    """A route in one direction."""

    def __init__(self, settings: TopicSettings, direction: Direction) -> None:
        self.settings = settings
        self.direction: Direction = direction
        self.is_pattern = settings.is_pattern
        #: The totals of flows of this route that have ended.
        self.past = FlowCounters()
        self._names = Names(settings.names)
        self._types = compile_pattern(settings.type) if settings.type else None

    def matches(self, ros: str, types: Iterable[str]) -> bool:
        """Whether the route is for this topic, which carries these types."""
        return ros in self._names and any(map(self.fits, types))

    def refusal(self, ros: str, types: Iterable[str]) -> tuple[SkipReason, str] | None:
        """Why the route does not take a topic that matches its pattern; None when it takes it, or
        when no pattern matches."""
        if ros not in self._names:
            return self._names.refusal(ros)
        if any(map(self.fits, types)):
            return None
        return "other_type", f"the route takes {self.settings.type}"

    def fits(self, type_name: str) -> bool:
        """Whether the route is for this type: it is, unless the route names another."""
        return self._types is None or self._types.fullmatch(type_name) is not None


@dataclass(frozen=True, slots=True)
class BridgedTopic:
    """What a flow carries now; an immutable snapshot."""

    ros: str
    mqtt: str
    type: str
    direction: Direction
    encoding: EncodingName


class LogFunction(Protocol):
    """Writes a line to the log, from any thread."""

    def __call__(self, level: int, text: str, *args: object) -> None: ...


class EchoFilter:
    """Recognizes samples of our own publisher on a topic that is bridged both ways.

    They are recognized by their content: rclpy cannot ask the middleware to ignore local
    publishers, and its information on a message's sender is missing up to Jazzy and ends
    EventsExecutor in Kilted. If another node publishes the same content at the same time, its
    message may be taken for the echo and the echo for its message: on MQTT that is no difference.
    """

    def __init__(self, serialization: Serialization = CDR) -> None:
        self._header = len(serialization.header)
        #: In CDR, up to three bytes may have been added at the end.
        self._padding = 3 if serialization.header else 0
        self._lock = threading.Lock()
        self._sent: deque[tuple[float, bytes]] = deque(maxlen=ECHO_SAMPLES)

    def sent(self, cdr: bytes) -> None:
        """Remember a sample that is about to be published, without the header of CDR, in which DDS
        notes padding."""
        with self._lock:
            self._sent.append((monotonic() + ECHO_TIME, cdr[self._header :]))

    def is_own(self, cdr: bytes) -> bool:
        """Whether a received sample is one that was sent and has not come back yet."""
        if not self._sent:
            return False
        now = monotonic()
        with self._lock:
            while self._sent and self._sent[0][0] < now:
                self._sent.popleft()
            for index, (_, body) in enumerate(self._sent):
                more = len(cdr) - len(body) - self._header
                if 0 <= more <= self._padding and cdr.startswith(body, self._header):
                    del self._sent[index]
                    return True
        return False


class Flow(ABC):
    """Carries one ROS topic in one direction.

    `skips` is for any thread, `fail` and `refuse` are for the thread that carries messages, all
    else is for the ROS thread.
    """

    direction: ClassVar[Direction]
    #: Why a topic that a route names is not carried yet.
    absence: ClassVar[str]

    def __init__(
        self,
        route: BridgeRoute,
        ros: str,
        converters: Converters,
        log: LogFunction,
    ) -> None:
        self.route = route
        self.settings = settings = route.settings
        self.ros = ros
        self.mqtt = settings.mqtt.replace("{ros}", ros)
        self.counters = FlowCounters()
        #: For the loop's thread.
        self.meter = Meter()
        self.bridged: BridgedTopic | None = None
        #: Spreads the thorough polls of all flows over several polls.
        self.number = next(_NUMBERS)
        #: Whether a pattern found the topic: then it is bridged while other nodes have endpoints.
        self.is_matched = route.is_pattern
        self._converters = converters
        self._log = log
        self._count: tuple[int, int] | None = None
        #: Type, QoS and type hash that were last opened, or failed to be.
        self._opened_for: tuple[str, QosProfile, str | None] | None = None
        #: Why the last set-up failed.
        self._problem: str | None = None
        #: Whether the next poll must try again to open it.
        self._must_retry = False
        self._other_types: set[str] = set()
        self._log_next_at = 0.0

    def poll_graph(self, node: RosNode, thorough: bool) -> bool:
        """Follow the graph; returns whether what is bridged has changed.

        The endpoints are asked for only if their number has changed, or the poll is thorough.
        """
        count = node.count(self.ros)
        if count == self._count and not thorough and not self._must_retry:
            return False
        self._must_retry = False
        self._count = count
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
            problem = self.counters.last_error = str(error)
            if problem != self._problem:
                self._problem = problem
                self._log(logging.ERROR, "%s is not bridged: %s", self, problem)
            return
        self._problem = None
        self.bridged = BridgedTopic(self.ros, self.mqtt, type_name, self.direction, encoding)
        self._log(logging.INFO, "%s: %s as %s; ROS %s%s", self, type_name, encoding, qos, detail)

    def reset(self, problem: str) -> None:
        """Close everything after a fault; the next poll opens it again."""
        self._problem = self.counters.last_error = problem
        self._opened_for, self._must_retry = None, True
        with suppress(Exception):  # the fault was counted, and it may be half open
            self.close()
        self.bridged = None

    def skips(self) -> list[Skipped]:
        """What of the topic is not carried, and why; from any thread."""
        problem, count, wanted, bridged = self._problem, self._count, self._opened_for, self.bridged
        if bridged is not None:
            reason = f"the topic carries {bridged.type} as well, which is bridged"
            return [
                Skipped(self.ros, self.direction, name, "two_types", reason)
                for name in self._other_types
            ]
        if problem is not None:
            type_name = wanted[0] if wanted else ""
            return [Skipped(self.ros, self.direction, type_name, "problem", problem)]
        if self.is_matched or count is None:
            return []
        type_name = self.settings.type or ""
        return [Skipped(self.ros, self.direction, type_name, "absent", self.absence)]

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

    def fail(self, problem: str) -> None:
        """Count a message that could not be carried, and log that at most once a minute."""
        self.counters.errors += 1
        self._log_uncarried(problem, self.counters.errors)

    def refuse(self, problem: str) -> None:
        """Count a message that violates the route's rules, and log that at most once a minute."""
        self.counters.refused += 1
        self._log_uncarried(problem, self.counters.refused)

    def _log_uncarried(self, problem: str, count: int) -> None:
        self.counters.last_error = problem
        now = monotonic()
        if now >= self._log_next_at:
            self._log_next_at = now + LOG_INTERVAL
            self._log(
                logging.WARNING,
                "%s: a message %s (%d so far)",
                self,
                problem,
                count,
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

    @abstractmethod
    def close(self) -> None:
        """Close the subscription or publisher; nothing is carried any more."""

    def on_bus_lost(self) -> None:
        """The bus is gone, and with it the subscription or publisher."""
        self.bridged = self._count = self._opened_for = None

    @property
    def commanding(self) -> str | None:
        """The client that holds the lease of an exclusive route, if there is one."""
        return None
