"""What is bridged and what is not, retained: `{robot}/_appliance/routes`, `…/skipped`.

A robot may have thousands of topics, and an entry takes several microseconds. So the entries are
made in turns of the event loop, and are published when all are there.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Iterator
from typing import Final, Protocol

import orjson

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.mqtt.codec import Properties, Property
from appliance.net.callbacks import Entries
from appliance.ros.calls.routes import CallBridge
from appliance.ros.home_assistant import HomeAssistant
from appliance.ros.payload.encodings.registry import CONTENT_TYPE
from appliance.ros.skipped import Skipped, summary
from appliance.ros.status import topic_status
from appliance.ros.topics.flow import Flow, bridged

#: Topics of one turn of the event loop: less than a millisecond.
TURN: Final = 25

_PROPERTIES: Final[Properties] = {Property.CONTENT_TYPE: CONTENT_TYPE["json"]}


class Announced(Protocol):
    """Who knows what is bridged now, and what is not: the bridge."""

    calls: CallBridge

    def flows(self) -> list[Flow]:
        """Of all topics."""

    def skips(self) -> list[Skipped]:
        """What routes include and is not bridged, and why."""


class Announcements:
    """Publishes both topics where something in them has changed; on the event loop's thread."""

    def __init__(
        self,
        broker: Broker,
        entries: Entries,
        robot: str,
        bridge: Announced,
        use_types: Callable[[Iterable[str]], None],
        home_assistant: HomeAssistant,
    ) -> None:
        """`use_types` is told of all types that are bridged, and Home Assistant of all of it."""
        self._broker = broker
        self._entries = entries
        self._above = f"{robot}/_appliance/"
        self._bridge = bridge
        self._use_types = use_types
        self._home_assistant = home_assistant
        #: The payloads that were published last, by the end of their topic.
        self._published: dict[str, bytes] = {}
        #: The next turn, while entries are being made; and whether they are outdated already.
        self._next: asyncio.Handle | None = None
        self._is_outdated = False

    def publish(self, session: Session) -> None:
        """Publish what is there now; what takes a turn at most is published at once.

        What changes while the entries are being made is published next, however often it does.
        """
        self._is_outdated = self._next is not None
        if not self._is_outdated:
            self._go_on(self._work(session), session)

    def stop(self, session: Session) -> None:
        """Publish what is there at the end, at once."""
        if self._next is not None:
            self._next.cancel()
        for _ in self._work(session):
            pass

    def _go_on(self, work: Iterator[None], session: Session) -> None:
        self._next = None  # first: where this turn fails, `publish` begins anew
        for _ in work:
            self._next = self._entries.soon("bridge.announcing", self._go_on, work, session)
            return
        if self._is_outdated:
            self.publish(session)

    def _work(self, session: Session) -> Iterator[None]:
        """Make the entries, pausing after each turn; then publish them."""
        bridge = self._bridge
        topics = list(bridged(bridge.flows()))
        entries = []
        for topic, flow in topics:
            entries.append(orjson.dumps(topic_status(topic, flow)))
            if not len(entries) % TURN:
                yield
        calls = bridge.calls.bridged()
        entries += map(orjson.dumps, calls)
        if self._publish("routes", b"[%b]" % b",".join(entries), session):
            self._use_types((*(topic.type for topic, _ in topics), *bridge.calls.types()))
        self._publish("skipped", orjson.dumps(summary(bridge.skips())), session)
        routed = ((topic, flow.settings) for topic, flow in topics)
        yield from self._home_assistant.work(routed, calls, session)
        self._broker.flush()

    def _publish(self, name: str, payload: bytes, session: Session) -> bool:
        """Publish it if it has changed; returns whether it has."""
        if payload == self._published.get(name):
            return False
        self._published[name] = payload
        message = Message(self._above + name, payload, 0, True, _PROPERTIES)
        self._broker.publish(message, session)
        return True
