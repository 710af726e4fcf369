"""Publishes on `/diagnostics` how the broker, the bridge and each of its routes are doing.

Names, levels and keys are as diagnostic_aggregator and rqt_robot_monitor show them.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any, Protocol, TypeAlias

from appliance.broker.broker import Broker
from appliance.net.callbacks import Entries, PeriodicCallback
from appliance.ros.node import BusError, QosProfile, RosNode, RosPublisher
from appliance.ros.payload.converter import ConversionError, Converter, Converters
from appliance.ros.payload.definitions import UnknownTypeError
from appliance.ros.status import RouteStatus
from appliance.ros.topics.route import LogFunction

TOPIC = "/diagnostics"
TYPE = "diagnostic_msgs/msg/DiagnosticArray"

log = logging.getLogger(__name__)

#: The counts of the last report, by the name of the status.
_Counts: TypeAlias = dict[str, dict[str, int]]

# diagnostic_msgs/msg/DiagnosticStatus
OK, WARN, ERROR = 0, 1, 2

#: Counters whose growth makes a route's status a warning, and its message.
_WARNINGS = (
    ("errors", "messages that could not be carried"),
    ("lost", "messages lost by ROS's middleware before they came here"),
    ("dropped", "messages dropped"),
    ("refused", "commands refused"),
    ("expired", "commands that came too late"),
)


class StatusSource(Protocol):
    """The bridge, as far as it is reported on here."""

    @property
    def node_name(self) -> str:
        """The full name of the bridge's node."""

    def status(self) -> list[RouteStatus]:
        """Every route's state and counters."""


class DiagnosticsTopic:
    """The publisher of `/diagnostics`; `output` is for the loop's thread, all else for the ROS
    thread."""

    def __init__(self, node: RosNode, converters: Converters, log_line: LogFunction) -> None:
        self._node = node
        self._converters = converters
        self._log = log_line
        self._was_opened = False
        #: What to publish with, None without a bus; replaced as a whole by the ROS thread.
        self.output: tuple[Converter, RosPublisher] | None = None

    def poll_graph(self) -> None:
        """Make the publisher, once each time the bus is joined."""
        if self._was_opened:
            return
        self._was_opened = True
        try:
            converter = self._converters.get(TYPE)
            self.output = converter, self._node.create_publisher(TOPIC, TYPE, QosProfile())
        except (BusError, UnknownTypeError) as error:
            self._log(logging.WARNING, "nothing is published on %s: %s", TOPIC, error)

    def on_bus_lost(self) -> None:
        """The bus is gone."""
        self.output = None
        self._was_opened = False


class Diagnostics:
    """Publishes a DiagnosticArray every `interval` seconds; for the loop's thread."""

    def __init__(
        self,
        robot: str,
        broker: Broker,
        bridge: StatusSource,
        topic: DiagnosticsTopic,
        interval: float,
    ) -> None:
        self._robot = robot
        self._broker = broker
        self._bridge = bridge
        self._topic = topic
        self._interval = interval
        self._timer: PeriodicCallback | None = None
        self._reported: _Counts = {}

    def start(self, entries: Entries) -> None:
        """Publish from now on, while the bus is joined."""
        self._timer = entries.every("diagnostics", self._interval, self._tick)

    def stop(self) -> None:
        """Publish no more; may be called twice."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _tick(self) -> None:
        output = self._topic.output
        if output is None:
            return
        converter, publisher = output
        routes = self._bridge.status()
        before, self._reported = self._reported, {}
        statuses = [
            self._of_broker(before),
            self._of_bridge(routes),
            *self._of_routes(routes, before),
        ]
        try:
            publisher.publish(converter.from_dict({"header": {"stamp": "now"}, "status": statuses}))
        except (BusError, ConversionError) as error:
            log.debug("%s: %s", TOPIC, error)

    def _of_broker(self, before: _Counts) -> dict[str, Any]:
        broker = self._broker
        counters = broker.counters
        counts = {
            "messages received": counters.publish_received,
            "messages sent": counters.publish_sent,
            "messages dropped": counters.publish_dropped,
            "messages refused": counters.publish_refused,
        }
        grown = self._grown("broker", counts, before)
        is_dropping = grown["messages dropped"] > 0
        values = {
            "clients connected": len(broker.clients),
            "subscriptions": broker.subscription_count,
            "retained messages": len(broker.retained),
            "bytes queued": broker.accounting.queued_bytes,
            **counts,
        }
        text = f"clients: {len(broker.clients)}"
        if is_dropping:
            text = f"messages dropped for clients that are slow: {grown['messages dropped']}"
        return self._status("broker", WARN if is_dropping else OK, text, values)

    def _of_bridge(self, routes: list[RouteStatus]) -> dict[str, Any]:
        topics = sum(len(route.topics) for route in routes)
        values = {"node": self._bridge.node_name, "routes": len(routes), "topics bridged": topics}
        return self._status("bridge", OK, f"topics bridged: {topics}", values)

    def _of_routes(self, routes: list[RouteStatus], before: _Counts) -> Iterator[dict[str, Any]]:
        known: dict[str, int] = {}
        for route in routes:
            arrow = "to MQTT" if route.direction == "to_mqtt" else "to ROS"
            name = f"{', '.join(route.settings.names)} {arrow}"
            known[name] = known.get(name, 0) + 1
            if known[name] > 1:  # to another MQTT topic, or with another type
                name += f" ({known[name]})"
            yield self._of_route(name, route, before)

    def _of_route(self, name: str, route: RouteStatus, before: _Counts) -> dict[str, Any]:
        grown = self._grown(name, {key: getattr(route, key) for key, _ in _WARNINGS}, before)
        complaints = [f"{text}: {grown[key]}" for key, text in _WARNINGS if grown[key]]
        if complaints:
            level, message = WARN, ", ".join(complaints)
        elif route.topics:
            message = f"topics bridged: {len(route.topics)}, {route.rate:g} messages/s"
            level = OK
        elif route.last_error is not None:
            level, message = ERROR, f"not bridged: {route.last_error}"
        else:
            level, message = OK, "waits for its topic"
        values: dict[str, object] = {
            "topics": len(route.topics),
            "messages": route.messages,
            "messages/s": route.rate,
            "bytes": route.bytes,
            "bytes/s": route.byte_rate,
            "errors": route.errors,
            "last error": route.last_error or "",
        }
        if route.direction == "to_mqtt":
            values["lost in ROS"] = route.lost
            values |= {"dropped": route.dropped, "throttled": route.throttled}
            values["skipped"] = route.skipped
            if route.latency_ms is not None:
                values["latency p50 (ms)"] = route.latency_ms.p50
                values["latency p99 (ms)"] = route.latency_ms.p99
        elif route.settings.rules is not None:
            values |= {
                "expired": route.expired,
                "refused": route.refused,
                "clamped": route.clamped,
                "stop messages": route.stops,
            }
            if route.settings.rules.exclusive:
                holders = [client for _, client in route.commanding]
                values["commanded by"] = ", ".join(holders) or "nobody"
        return self._status(name, level, message, values)

    def _grown(self, name: str, counts: dict[str, int], before: _Counts) -> dict[str, int]:
        self._reported[name] = counts
        # A route that was replaced counts anew.
        last = before.get(name, counts)
        return {key: max(0, count - last[key]) for key, count in counts.items()}

    def _status(
        self, name: str, level: int, message: str, values: dict[str, Any]
    ) -> dict[str, Any]:
        return {
            "level": level,
            "name": f"{self._bridge.node_name.lstrip('/')}: {name}",
            "message": message,
            "hardware_id": self._robot,
            "values": [{"key": key, "value": str(value)} for key, value in values.items()],
        }
