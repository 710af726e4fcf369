"""The JSON Schemas of what is bridged, retained below `{robot}/_appliance/schema/`.

A thread makes them: to describe a type may import its package, and takes some milliseconds where a
type has many others in it. They are bounded: of what a node brings along, nothing fills the broker.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable
from typing import Final

import orjson

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.mqtt.codec import Properties, Property
from appliance.net.callbacks import Entries
from appliance.ros.payload.definitions import TypeDescription, UnknownTypeError
from appliance.ros.payload.schema import json_schema, topic_of

log = logging.getLogger(__name__)

PROPERTIES: Final[Properties] = {Property.CONTENT_TYPE: "application/schema+json"}

#: Schemas that are retained, and the bytes of one and of all.
MOST: Final = 2000
LARGEST: Final = 256 * 1024
MOST_BYTES: Final = 16 * 1024 * 1024

#: Types that the thread describes before what it has made is published.
_BATCH: Final = 20


class SchemaTopics:
    """The schemas of the types that are bridged now; for the loop's thread."""

    def __init__(
        self,
        broker: Broker,
        entries: Entries,
        robot: str,
        describe: Callable[[str], TypeDescription],
    ) -> None:
        """`describe` is called in a thread, and raises UnknownTypeError."""
        self._broker = broker
        self._entries = entries
        self._describe = describe
        self._above = f"{robot}/_appliance/schema/"
        self._session: Session | None = None
        #: The types that still need a schema, in the order in which they are made.
        self._missing: dict[str, None] = {}
        #: The bytes of each type's retained schema, 0 where there is none.
        self._sizes: dict[str, int] = {}
        self._making: asyncio.Task[None] | None = None
        self._is_full = False

    def start(self, session: Session) -> None:
        """Delete the schemas of a run that was killed: the types may be others now."""
        self._session = session
        for topic, _ in list(self._broker.retained.find(f"{self._above}#")):
            self._publish(topic, b"")
        self._broker.flush()

    def stop(self) -> None:
        """Publish nothing any more."""
        self._session = None

    def replace(self, types: Iterable[str]) -> None:
        """Publish the schemas of these types; the first ones where there are too many."""
        wanted = dict.fromkeys(types)
        for name in self._sizes.keys() - wanted.keys():
            if self._sizes.pop(name):
                self._publish(self._above + topic_of(name), b"")
        self._missing = {name: None for name in wanted if name not in self._sizes}
        if self._missing and (self._making is None or self._making.done()):
            self._making = self._entries.task("schemas.make", self._make())

    async def _make(self) -> None:
        while self._missing and self._session is not None:
            batch = list(self._missing)[:_BATCH]
            for name in batch:
                del self._missing[name]
                self._sizes[name] = 0  # also of one that fails: it would fail again
            for name, payload in await asyncio.to_thread(self._schemas, batch):
                self._take(name, payload)
            self._broker.flush()

    def _schemas(self, names: list[str]) -> list[tuple[str, bytes]]:
        """In a thread: the schemas of those types that can be described."""
        made = []
        for name in names:
            try:
                payload = orjson.dumps(json_schema(self._describe(name)))
            except UnknownTypeError as error:  # which only `cdr` can carry
                log.warning("there is no schema of %s: %s", name, error)
            else:
                made.append((name, payload))
        return made

    def _take(self, name: str, payload: bytes) -> None:
        if name not in self._sizes:
            return  # bridged no more
        count = sum(map(bool, self._sizes.values()))
        if len(payload) > LARGEST:
            log.warning("there is no schema of %s: it has %d bytes", name, len(payload))
        elif count >= MOST or sum(self._sizes.values()) + len(payload) > MOST_BYTES:
            if not self._is_full:
                log.warning("there is no schema of %s and others: %d are published", name, count)
            self._is_full = True
        else:
            self._sizes[name] = len(payload)
            self._publish(self._above + topic_of(name), payload)

    def _publish(self, topic: str, payload: bytes) -> None:
        if self._session is not None:
            properties = PROPERTIES if payload else None
            self._broker.publish(Message(topic, payload, 0, True, properties), self._session)
