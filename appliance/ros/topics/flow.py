"""Routes, and what they come to: one ROS topic carried in one direction is a flow.

A flow follows its topic on the ROS thread: `look` finds the type and the QoS to use from the
endpoints that are there, and sets up or sets anew what carries the messages.
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

#: Seconds between two lines in the log about the same route's errors.
REPORT_INTERVAL = 60.0

#: Seconds that a sample of our own may take to come back; in one process it is microseconds.
ECHO_TIME = 2.0
ECHO_SAMPLES = 1000

_NUMBERS = itertools.count()


@dataclass(frozen=True, slots=True)
class TopicSettings:
    """A route. `ros` is the name of a topic, or a pattern, or several of both: `*` is part of a
    name, `**` of a path, and what begins with `!` is left out again. `mqtt` is a topic; a `{ros}`
    in it stands for the ROS name.

    None is: no limit (`rate`, in Hz, and `bytes_per_second` of payload), found from the graph
    (`type`, which may have a `*` in it too), as the publishers' QoS says (`qos`, `retain`). `keep`
    is how many messages of a topic wait for a busy broker: the latest, or so many. `fields` are the
    paths of those that go to MQTT, all of them when there are none; `limits` are for what comes
    from MQTT.
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
    #: What holds for what goes to ROS; None for no rules but the types.
    rules: CommandRules | None = None

    @property
    def samples(self) -> int:
        """`keep` as a number."""
        return 1 if self.keep == "latest" else self.keep

    @property
    def names(self) -> tuple[str, ...]:
        """`ros`, as many as there are."""
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
        #: What those of its flows have counted that have ended.
        self.past = FlowCounters()
        self._names = Names(settings.names)
        self._types = compile_pattern(settings.type) if settings.type else None

    def matches(self, ros: str, types: Iterable[str]) -> bool:
        """Whether a topic that carries these types is one of this route's."""
        return ros in self._names and any(map(self.fits, types))

    def refusal(self, ros: str, types: Iterable[str]) -> tuple[SkipReason, str] | None:
        """Why a topic that the route's pattern speaks of is not one of its; None when it is, or
        when no pattern speaks of it."""
        if ros not in self._names:
            return self._names.refusal(ros)
        if any(map(self.fits, types)):
            return None
        return "other_type", f"the route takes {self.settings.type}"

    def fits(self, type_name: str) -> bool:
        """Whether it is what the route says of the type, if it says something."""
        return self._types is None or self._types.fullmatch(type_name) is not None


@dataclass(frozen=True, slots=True)
class BridgedTopic:
    """What a flow carries now."""

    ros: str
    mqtt: str
    type: str
    direction: Direction
    encoding: EncodingName


class LogFunction(Protocol):
    """Writes a line to the log, from any thread."""

    def __call__(self, level: int, text: str, *args: object) -> None: ...


class EchoFilter:
    """Tells samples of our own publisher from others', on a topic that is bridged both ways.

    They are told by their content: rclpy cannot ask the middleware to leave out local publishers,
    and what it says about a message's sender is missing up to Jazzy and ends EventsExecutor in
    Kilted. A message that another node publishes with the same content at the same time counts as
    the echo, and the echo in its place as the other's message: on MQTT nobody can tell.
    """

    def __init__(self, serialization: Serialization = CDR) -> None:
        self._header = len(serialization.header)
        #: In CDR, up to three bytes may have been added at the end.
        self._padding = 3 if serialization.header else 0
        self._lock = threading.Lock()
        self._sent: deque[tuple[float, bytes]] = deque(maxlen=ECHO_SAMPLES)

    def sent(self, cdr: bytes) -> None:
        """The sample is about to be published. Without CDR's header, where DDS notes padding."""
        with self._lock:
            self._sent.append((monotonic() + ECHO_TIME, cdr[self._header :]))

    def is_own(self, cdr: bytes) -> bool:
        """Whether the sample received is one that was sent and has not come back yet."""
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
    """One ROS topic carried in one direction; its methods are for the ROS thread."""

    direction: ClassVar[Direction]
    #: Why a topic that a route names may not be carried yet.
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
        #: A number of its own: of so many flows, not all take their time at the same look.
        self.number = next(_NUMBERS)
        #: Whether a pattern found the topic: it is then bridged while it has other ends.
        self.is_matched = route.is_pattern
        self._converters = converters
        self._log = log
        self._count: tuple[int, int] | None = None
        #: Type, QoS and type hash that were last set up, or refused.
        self._wanted: tuple[str, QosProfile, str | None] | None = None
        #: Why the last set-up failed.
        self._problem: str | None = None
        #: Whether the next look must set up what this one could not.
        self._is_due = False
        self._foreign: set[str] = set()
        self._report_at = 0.0

    def poll_graph(self, node: RosNode, thorough: bool) -> bool:
        """Follow the graph; True when what is bridged has changed.

        The endpoints are asked for only when their number has changed, or the look is thorough.
        """
        count = node.count(self.ros)
        if count == self._count and not thorough and not self._is_due:
            return False
        self._is_due = False
        self._count = count
        endpoints = self._find(node)
        found = {endpoint.type for endpoint in endpoints}
        fitting = set(filter(self.route.fits, found))
        if self.is_matched and not fitting:
            was_bridged = self.bridged is not None
            self.close()
            self._wanted = None
            return was_bridged
        known = self._wanted[0] if self._wanted else None
        if not self.is_matched and self.settings.type is not None:
            type_name = self.settings.type
        elif fitting:
            type_name = known if known in fitting else min(fitting)
        elif known is not None:
            type_name = known
        else:
            return False
        self._log_foreign(found - {type_name}, type_name)
        endpoints = [endpoint for endpoint in endpoints if endpoint.type == type_name]
        if not endpoints and self._wanted is not None and self._wanted[0] == type_name:
            return False  # they have left; all stays as it is for their return
        # Towards ROS nobody is told the hash, and another publisher would first have to be found.
        ends = endpoints if self.direction == "to_mqtt" else []
        hashes = [end.type_hash for end in ends if end.type_hash]
        wanted = (type_name, self._choose_qos(endpoints, type_name), min(hashes, default=None))
        before = self.bridged
        if wanted == self._wanted and (before is not None or self._problem is None):
            return False
        self._wanted = wanted
        if before is not None and before.type != type_name:
            # The middleware knows one type a topic, until the executor has let go of the last end.
            self.close()
            self._wanted, self._is_due = None, True
        else:
            self._set_up(node, *wanted)
        return self.bridged != before

    def _set_up(
        self, node: RosNode, type_name: str, qos: QosProfile, type_hash: str | None
    ) -> None:
        encoding = self.settings.encoding
        try:
            detail = self._open(node, type_name, qos, type_hash)
        except (BusError, UnknownTypeError, ConversionError) as error:
            self.close()
            self._is_due = isinstance(error, BusError)
            problem = self.counters.last_error = str(error)
            if problem != self._problem:
                self._problem = problem
                self._log(logging.ERROR, "%s is not bridged: %s", self, problem)
            return
        self._problem = None
        self.bridged = BridgedTopic(self.ros, self.mqtt, type_name, self.direction, encoding)
        self._log(logging.INFO, "%s: %s as %s; ROS %s%s", self, type_name, encoding, qos, detail)

    def reset(self, problem: str) -> None:
        """A fault: what was set up is closed, and the next look sets it up again."""
        self._problem = self.counters.last_error = problem
        self._wanted, self._is_due = None, True
        with suppress(Exception):  # it was counted, and what there is of it may be half a thing
            self.close()
        self.bridged = None

    def skips(self) -> list[Skipped]:
        """What of the topic is not carried; from any thread."""
        problem, count, wanted, bridged = self._problem, self._count, self._wanted, self.bridged
        if bridged is not None:
            reason = f"the topic carries {bridged.type} as well, which is bridged"
            return [
                Skipped(self.ros, self.direction, name, "two_types", reason)
                for name in self._foreign
            ]
        if problem is not None:
            type_name = wanted[0] if wanted else ""
            return [Skipped(self.ros, self.direction, type_name, "problem", problem)]
        if self.is_matched or count is None:
            return []
        type_name = self.settings.type or ""
        return [Skipped(self.ros, self.direction, type_name, "absent", self.absence)]

    def _log_foreign(self, types: set[str], chosen: str) -> None:
        if types != self._foreign:
            self._foreign = types
            for name in sorted(types):
                self._log(
                    logging.WARNING,
                    "%s carries %s; the %s that is there too is left out",
                    self,
                    chosen,
                    name,
                )

    def fail(self, problem: str) -> None:
        """Count a message that could not be carried, and say so once a minute."""
        self.counters.errors += 1
        self._log_uncarried(problem, self.counters.errors)

    def refuse(self, problem: str) -> None:
        """Count a message that the route's rules forbid, and say so once a minute."""
        self.counters.refused += 1
        self._log_uncarried(problem, self.counters.refused)

    def _log_uncarried(self, problem: str, count: int) -> None:
        self.counters.last_error = problem
        now = monotonic()
        if now >= self._report_at:
            self._report_at = now + REPORT_INTERVAL
            self._log(
                logging.WARNING,
                "%s: a message %s (%d so far)",
                self,
                problem,
                count,
            )

    @abstractmethod
    def _find(self, node: RosNode) -> list[Endpoint]:
        """The endpoints of other nodes that tell type and QoS."""

    @abstractmethod
    def _choose_qos(self, endpoints: list[Endpoint], type_name: str) -> QosProfile:
        """The QoS to use with them."""

    @abstractmethod
    def _open(self, node: RosNode, type_name: str, qos: QosProfile, type_hash: str | None) -> str:
        """Set up, or set anew, what carries the messages; returns more for the log.

        Raises BusError, UnknownTypeError, ConversionError.
        """

    @abstractmethod
    def close(self) -> None:
        """Carry nothing any more."""

    def on_bus_lost(self) -> None:
        """The bus is gone, and with it all that was set up."""
        self.bridged = self._count = self._wanted = None

    @property
    def commanding(self) -> str | None:
        """The client that may command alone, None where there is none."""
        return None
