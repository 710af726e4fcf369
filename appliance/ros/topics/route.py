"""Routes of topics: their settings, and what is bridged for them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal, Protocol, TypeAlias

from appliance.ros.metrics import FlowCounters
from appliance.ros.patterns import Names, compile_pattern
from appliance.ros.payload.encodings.base import EncodingName
from appliance.ros.payload.payloads import Compression, InputLimits
from appliance.ros.skipped import SkipReason
from appliance.ros.topics.rules import CommandRules

Direction: TypeAlias = Literal["to_mqtt", "to_ros"]


@dataclass(frozen=True, slots=True)
class TopicSettings:
    """The settings of a route for topics.

    `ros` is the name of a topic, or a pattern, or several of both: `*` matches within a part of a
    name, `**` matches a path, and a leading `!` excludes. `mqtt` is a topic; a `{ros}` in it is
    replaced by the ROS name.

    None means: no limit (`rate`, in Hz, and `bytes_per_second` of payload), taken from the graph
    (`type`, which may contain a `*`, too), taken from the publishers' QoS (`qos`, `retain`). `keep`
    is how many messages of a topic are queued for a busy broker. `fields` are the paths of the
    fields that go to MQTT, all of them if empty; `limits` are for messages from MQTT. `quality` and
    `max_width` are of pictures.
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
    quality: int = 80
    max_width: int | None = None
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

    def takes(self, mqtt: str) -> bool:
        """Whether the route may be for this MQTT topic, by its ROS name."""
        before, has_name, after = self.settings.mqtt.partition("{ros}")
        if not has_name:
            return mqtt == before
        is_around = mqtt.startswith(before) and mqtt.endswith(after)
        return is_around and mqtt[len(before) : len(mqtt) - len(after)] in self._names

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
