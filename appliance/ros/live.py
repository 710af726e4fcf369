"""The bridge's live figures, once a second and only while somebody looks at them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from time import time
from typing import Any, Final

import orjson

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.mqtt.codec import Properties, Property
from appliance.net.callbacks import Entries
from appliance.ros.payload.encodings.registry import CONTENT_TYPE
from appliance.ros.status import latency_status
from appliance.ros.topics.flow import Flow, bridged
from appliance.ros.topics.route import BridgedTopic

#: The most topics with figures. An entry has some 160 bytes.
MOST_TOPICS: Final = 1000

#: Topics of one turn of the event loop: less than a millisecond.
TURN: Final = 25

_PROPERTIES: Final[Properties] = {Property.CONTENT_TYPE: CONTENT_TYPE["json"]}


class LiveFigures:
    """Publishes rates, losses and latencies of what is bridged; on the event loop's thread."""

    def __init__(self, broker: Broker, entries: Entries, robot: str) -> None:
        self._broker = broker
        self._entries = entries
        self._topic = f"{robot}/_appliance/live"
        self._is_busy = False

    def publish(self, flows: Iterable[Flow], session: Session) -> None:
        """Publish the figures of these flows, in turns, if a client has asked for them by name.

        While the last ones are still being collected, there are none.
        """
        if self._is_busy or not self._broker.router.is_watched(self._topic):
            return
        self._is_busy = True
        self._go_on(bridged(flows), [], session)

    def _go_on(
        self,
        rest: Iterator[tuple[BridgedTopic, Flow]],
        found: list[dict[str, Any]],
        session: Session,
    ) -> None:
        work = self._collect, rest, found, session
        self._entries.soon("bridge.live", *work, failed=self._end)

    def _collect(
        self,
        rest: Iterator[tuple[BridgedTopic, Flow]],
        found: list[dict[str, Any]],
        session: Session,
    ) -> None:
        part = [_figures(topic, flow) for topic, flow in islice(rest, TURN)]
        found += part
        if len(part) == TURN and len(found) < MOST_TOPICS:
            self._go_on(rest, found, session)
            return
        self._end()
        omitted = sum(1 for _ in rest)
        payload = orjson.dumps({"time": round(time(), 3), "routes": found, "omitted": omitted})
        self._broker.publish(Message(self._topic, payload, 0, False, _PROPERTIES), session)
        self._broker.flush()

    def _end(self) -> None:
        self._is_busy = False


def _figures(topic: BridgedTopic, flow: Flow) -> dict[str, Any]:
    """What changes from second to second, by the names of `TopicStatus`."""
    ours, theirs = flow.counters, flow.follower.counters
    rate, byte_rate = flow.meter.rates
    return {
        "mqtt": topic.mqtt,
        "direction": topic.direction,
        "rate": round(rate, 1),
        "byte_rate": round(byte_rate),
        "lost": ours.lost + theirs.lost,
        "dropped": ours.dropped,
        "throttled": ours.throttled + theirs.throttled,
        "errors": ours.errors + theirs.errors,
        "latency_ms": latency_status(ours.latency),
    }
