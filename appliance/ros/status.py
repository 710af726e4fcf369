"""The status of the bridge, for MQTT, /diagnostics and `appliance routes`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

from appliance.broker.histogram import Histogram
from appliance.ros.metrics import FlowCounters
from appliance.ros.payload.encodings.base import EncodingName
from appliance.ros.topics.flow import Flow
from appliance.ros.topics.route import BridgedTopic, BridgeRoute, Direction, TopicSettings


@dataclass(frozen=True, slots=True)
class LatencyStatus:
    """The median and the 99th percentile of the latency, in milliseconds."""

    p50: float
    p99: float


@dataclass(frozen=True, slots=True)
class CommandStatus:
    """What a route to ROS does to commands, for who drives; times in seconds.

    `clamp` has the bounds of fields by their path. `on_silence` is the time after which the stop
    message follows, None without one. A command that is older than `expire` is not published, None
    for any age. `lease` is how long a silent client holds the topic, None if it is not exclusive,
    and `commanding` is who holds it.
    """

    clamp: dict[str, tuple[float, float]]
    expire: float | None
    on_silence: float | None
    exclusive: bool
    lease: float | None
    commanding: str | None


@dataclass(frozen=True, slots=True)
class TopicStatus:
    """A topic that is bridged now; as JSON an entry of `{robot}/_appliance/routes`.

    `rate` is in messages per second, `size` the mean payload in bytes, `latency_ms` from the
    publisher on ROS to the broker, None if none was measured. `last_error` is the problem with the
    last message that was not carried. The counters are `FlowCounters` since the topic came.
    `max_rate` (messages per second), `qos` and `retain` are the route's, None where it has none.
    `rules` are those of a topic to ROS, None if its route has none.
    """

    ros: str
    mqtt: str
    type: str
    direction: Direction
    encoding: EncodingName
    messages: int
    rate: float
    size: int
    lost: int
    dropped: int
    throttled: int
    skipped: int
    errors: int
    expired: int
    refused: int
    last_error: str | None
    latency_ms: LatencyStatus | None
    max_rate: float | None
    qos: int | None
    retain: bool | None
    rules: CommandStatus | None


@dataclass(frozen=True, slots=True)
class RouteStatus:
    """What a route carries in one direction, and its counters since the start.

    `rate` and `byte_rate` are per second; `commanding` has the topics of an exclusive route and the
    clients that hold their leases. For the counters see `FlowCounters`.
    """

    settings: TopicSettings
    direction: Direction
    topics: tuple[BridgedTopic, ...]
    messages: int
    bytes: int
    lost: int
    dropped: int
    throttled: int
    skipped: int
    errors: int
    last_error: str | None
    expired: int
    refused: int
    clamped: int
    stops: int
    rate: float
    byte_rate: float
    latency_ms: LatencyStatus | None
    commanding: tuple[tuple[str, str], ...]
    #: By `monotonic()`.
    last_error_at: float


@dataclass(frozen=True, slots=True)
class RouteTotal:
    """The counters of a route in one direction since the start, and how many topics it bridges."""

    settings: TopicSettings
    direction: Direction
    topics: int
    counters: FlowCounters


def topic_status(bridged: BridgedTopic, flow: Flow) -> TopicStatus:
    """The status of a flow that is bridged."""
    counters = flow.total()
    return TopicStatus(
        bridged.ros,
        bridged.mqtt,
        bridged.type,
        bridged.direction,
        bridged.encoding,
        counters.messages,
        round(flow.meter.rates[0], 1),
        counters.bytes // counters.messages if counters.messages else 0,
        counters.lost,
        counters.dropped,
        counters.throttled,
        counters.skipped,
        counters.errors,
        counters.expired,
        counters.refused,
        counters.last_error,
        latency_status(counters.latency),
        flow.settings.rate,
        flow.settings.qos,
        flow.settings.retain,
        _command_status(bridged, flow),
    )


def _command_status(bridged: BridgedTopic, flow: Flow) -> CommandStatus | None:
    rules = flow.settings.rules
    if rules is None or bridged.direction == "to_mqtt":
        return None
    return CommandStatus(
        {path: (low, high) for path, low, high in rules.clamp},
        None if rules.oldest == inf else rules.oldest,
        None if rules.on_silence is None else rules.on_silence.after,
        rules.exclusive,
        rules.lease if rules.exclusive else None,
        flow.commanding,
    )


def route_total(route: BridgeRoute, flows: Sequence[Flow]) -> RouteTotal:
    """The counters of a route, with its present and past flows."""
    total = FlowCounters()
    total.add(route.past)
    for flow in flows:
        flow.add_to(total)
    bridged = sum(flow.bridged is not None for flow in flows)
    return RouteTotal(route.settings, route.direction, bridged, total)


def route_status(route: BridgeRoute, flows: Sequence[Flow]) -> RouteStatus:
    """The status of a route, with its present and past flows."""
    total = route_total(route, flows).counters
    rates = [flow.meter.rates for flow in flows]
    return RouteStatus(
        route.settings,
        route.direction,
        tuple(bridged for flow in flows if (bridged := flow.bridged) is not None),
        total.messages,
        total.bytes,
        total.lost,
        total.dropped,
        total.throttled,
        total.skipped,
        total.errors,
        total.last_error,
        total.expired,
        total.refused,
        total.clamped,
        total.stops,
        round(sum(rate for rate, _ in rates), 1),
        round(sum(byte_rate for _, byte_rate in rates), 1),
        latency_status(total.latency),
        tuple((flow.ros, flow.commanding) for flow in flows if flow.commanding is not None),
        total.last_error_at,
    )


def latency_status(latency: Histogram) -> LatencyStatus | None:
    """The summary of a histogram, None for an empty one."""
    p50, p99 = latency.quantile(0.5), latency.quantile(0.99)
    if p50 is None or p99 is None:
        return None
    return LatencyStatus(round(p50 * 1000, 2), round(p99 * 1000, 2))
