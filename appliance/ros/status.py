"""How the bridge is doing: what MQTT, /diagnostics and `appliance routes` are told of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from appliance.ros.metrics import FlowCounters, Latency
from appliance.ros.payload.encodings.base import EncodingName
from appliance.ros.topics.flow import BridgedTopic, BridgeRoute, Direction, Flow, TopicSettings


@dataclass(frozen=True, slots=True)
class LatencyStatus:
    """Milliseconds that half of the messages, and 99 of 100, took at the most."""

    p50: float
    p99: float


@dataclass(frozen=True, slots=True)
class TopicStatus:
    """What is bridged now; as JSON an entry of `{robot}/_appliance/routes`.

    `rate` is in messages a second, `size` the mean payload in bytes, `latency_ms` from the
    publisher on ROS to the broker, None while none was measured. `last_error` is what was wrong
    with the last message that was not carried. Counts are since the topic came;
    for what is counted see `FlowCounters`.
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


@dataclass(frozen=True, slots=True)
class RouteStatus:
    """What a route carries in one direction, and what it has counted since the start.

    `rate` and `byte_rate` are a second; `commanding` names who holds the lease of an exclusive
    route, and of which topic. For what is counted see `FlowCounters`.
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


def topic_status(bridged: BridgedTopic, flow: Flow) -> TopicStatus:
    """How a flow that is bridged is doing."""
    counters = flow.counters
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
    )


def route_status(route: BridgeRoute, flows: Sequence[Flow]) -> RouteStatus:
    """How a route is doing, with its flows and those that it had."""
    total = FlowCounters()
    for counters in (route.past, *(flow.counters for flow in flows)):
        total.add(counters)
    rates = [flow.meter.rates for flow in flows]
    return RouteStatus(
        route.settings,
        route.direction,
        tuple(flow.bridged for flow in flows if flow.bridged is not None),
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
    )


def latency_status(latency: Latency) -> LatencyStatus | None:
    """The histogram in two numbers, None for an empty one."""
    p50, p99 = latency.quantile(0.5), latency.quantile(0.99)
    if p50 is None or p99 is None:
        return None
    return LatencyStatus(round(p50 * 1000, 2), round(p99 * 1000, 2))
