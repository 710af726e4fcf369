"""Flows: what the loop's thread has of one ROS topic that is carried in one direction.

The ROS thread's part of a flow is a `TopicFollower`, which opens and closes the subscription or the
publisher as the graph changes. The two share immutable snapshots, which the follower replaces as a
whole. Each counts in counters of its own, which are added when they are read.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable, Iterator
from time import monotonic

from appliance.broker.meter import Meter
from appliance.ros.metrics import FlowCounters
from appliance.ros.skipped import Skipped
from appliance.ros.topics.follower import TopicFollower
from appliance.ros.topics.route import BridgedTopic, Direction, LogFunction

#: Errors of a flow are logged at most once in so many seconds.
LOG_INTERVAL = 60.0


class ProblemLog:
    """Logs messages of a flow that could not be carried, at most once a minute; for any thread."""

    def __init__(self, flow: str, log: LogFunction) -> None:
        self._flow = flow
        self._log = log
        self._lock = threading.Lock()
        self._next_at = 0.0

    def add(self, problem: str, count: int) -> None:
        """Log it, unless another was logged a moment ago; `count` are the messages so far."""
        with self._lock:
            now = monotonic()
            if now < self._next_at:
                return
            self._next_at = now + LOG_INTERVAL
        text = "%s: a message %s (%d so far)"
        self._log(logging.WARNING, text, self._flow, problem, count)


class Flow:
    """Carries one ROS topic in one direction; the loop's thread's part of it.

    The attributes that say which topic it is never change. Of `follower`, the loop's thread reads
    the snapshots only, and its counters, which the ROS thread counts in.
    """

    follower: TopicFollower

    def __init__(self, follower: TopicFollower, log: LogFunction, counters: FlowCounters) -> None:
        """`counters` are of the loop's thread alone; for all that is counted see `total`."""
        self.follower = follower
        self.route = route = follower.route
        self.settings = route.settings
        self.direction: Direction = route.direction
        self.ros = follower.ros
        self.mqtt = follower.mqtt
        self.is_matched = follower.is_matched
        self.counters = counters
        self.meter = Meter()
        self._log = log

    def __str__(self) -> str:
        return str(self.follower)

    @property
    def bridged(self) -> BridgedTopic | None:
        """What is carried now."""
        return self.follower.state.bridged

    def total(self) -> FlowCounters:
        """The counters of both threads, added up."""
        total = FlowCounters()
        self.add_to(total)
        return total

    def add_to(self, total: FlowCounters) -> None:
        """Add the counters of both threads."""
        total.add(self.counters)
        total.add_received(self.follower.counters)

    def finish(self) -> None:
        """The follower has closed: carry what has come before and still waits."""

    def skips(self) -> list[Skipped]:
        """What of the topic is not carried, and why."""
        return self.follower.state.skips(self.follower)

    @property
    def commanding(self) -> str | None:
        """The client that holds the lease of an exclusive route, if there is one."""
        return None


def bridged(flows: Iterable[Flow]) -> Iterator[tuple[BridgedTopic, Flow]]:
    """Those that carry something now, with what they carry."""
    return ((topic, flow) for flow in flows if (topic := flow.bridged) is not None)
