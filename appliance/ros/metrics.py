"""Metrics of a flow: counters, rates, latency."""

from __future__ import annotations

from dataclasses import dataclass, field
from time import monotonic

from appliance.broker.histogram import Histogram


@dataclass(eq=False, slots=True)
class ReceiveCounters:
    """What is counted as messages come from ROS, or do not: on the ROS thread, too.

    `lost` messages were lost by ROS's middleware before they came here, as it reports; `throttled`
    ones exceeded the rate limit or the byte budget; `errors` could not be converted or published.
    """

    lost: int = 0
    throttled: int = 0
    errors: int = 0
    last_error: str | None = None
    #: By `monotonic()`.
    last_error_at: float = 0.0

    def note_error(self, problem: str) -> None:
        """Record the last error."""
        self.last_error = problem
        self.last_error_at = monotonic()


@dataclass(eq=False, slots=True)
class FlowCounters(ReceiveCounters):
    """The counters of one direction, from the start; `bytes` are payload on MQTT.

    `dropped` messages did not fit into the mailbox; `skipped` ones were not sent to a slow client,
    counted once for each such client. Of commands, `expired` ones came too late, `refused` ones
    violated the rules, `clamped` ones were published with other numbers; `stops` are stop messages
    that a route has published by itself. `latency` is of a sample of the messages, from the
    publisher's time stamp to the broker.
    """

    messages: int = 0
    bytes: int = 0
    dropped: int = 0
    skipped: int = 0
    expired: int = 0
    refused: int = 0
    clamped: int = 0
    stops: int = 0
    latency: Histogram = field(default_factory=Histogram)

    def add(self, other: FlowCounters) -> None:
        """Add the counts of others; their last error becomes the last one."""
        # One by one: a loop over the fields takes ten times as long, for each route of `/metrics`.
        self.messages += other.messages
        self.bytes += other.bytes
        self.dropped += other.dropped
        self.skipped += other.skipped
        self.expired += other.expired
        self.refused += other.refused
        self.clamped += other.clamped
        self.stops += other.stops
        if other.latency.total or other.latency.counts[0]:
            self.latency.add(other.latency)
        self._add_received(other)
        if other.last_error is not None:
            self.last_error, self.last_error_at = other.last_error, other.last_error_at

    def add_received(self, other: ReceiveCounters) -> None:
        """Add what another thread has counted of the same messages."""
        self._add_received(other)
        if other.last_error is not None and other.last_error_at > self.last_error_at:
            self.last_error, self.last_error_at = other.last_error, other.last_error_at

    def _add_received(self, other: ReceiveCounters) -> None:
        self.lost += other.lost
        self.throttled += other.throttled
        self.errors += other.errors
