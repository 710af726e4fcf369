"""The retained messages: one a topic, bounded in number and bytes, each until it expires."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterator

from appliance.broker.complaints import Complaints
from appliance.broker.ledger import Ledger
from appliance.broker.message import Message
from appliance.broker.session import LEVEL_SIZE
from appliance.mqtt.codec import quote
from appliance.mqtt.topics import TopicTree

#: Retained messages that one tick lets expire.
EXPIRED_A_TURN = 1024


def retained_size(message: Message) -> int:
    """Bytes that are counted for a retained message: it, and its topic's levels in the tree."""
    return message.size + LEVEL_SIZE * message.topic.count("/")


class Retained:
    """The retained messages by topic; `changed` is told of each that is new, replaced or gone.

    One that is gone it is told as an empty message.
    """

    def __init__(
        self, ledger: Ledger, complaints: Complaints, changed: Callable[[Message], None]
    ) -> None:
        #: Bytes of all of them, see `retained_size`.
        self.bytes = 0
        self._ledger = ledger
        self._complaints = complaints
        self._changed = changed
        self._messages: TopicTree[Message] = TopicTree()
        #: When they expire, soonest first.
        self._expiring: list[tuple[float, int, Message]] = []
        self._order = itertools.count()

    def __len__(self) -> int:
        return len(self._messages)

    def get(self, topic: str) -> Message | None:
        """The topic's retained message, or None."""
        return self._messages.get(topic)

    def find(self, topic_filter: str) -> Iterator[tuple[str, Message]]:
        """Topics and messages that the filter matches, see `TopicTree.find`."""
        return self._messages.find(topic_filter)

    def find_in_steps(self, topic_filter: str) -> Iterator[tuple[str, Message] | None]:
        """`find`, with a None now and then, so that a long search can be put off in its middle."""
        return self._messages.find_in_steps(topic_filter)

    def restore(self, messages: list[Message]) -> None:
        """Take up what the store has kept."""
        for message in messages:
            self._messages.set(message.topic, message)
            self.bytes += retained_size(message)
            self._schedule_expiry(message)

    def keep(self, message: Message) -> bool:
        """Retain the message, or with an empty one none any more; False when there is no room."""
        ledger = self._ledger
        if ledger.refusing and message.qos:
            return False
        old = self._messages.get(message.topic)
        if not message.payload:  # [MQTT-3.3.1-6], 3.1.1 [MQTT-3.3.1-10]
            if old is None:
                return True
            self.bytes -= retained_size(old)
            self._messages.delete(message.topic)
        else:
            message.settle()
            grown = self.bytes + retained_size(message)
            grown -= retained_size(old) if old is not None else 0
            limits = ledger.limits
            if grown > limits.retained_bytes or (
                old is None and len(self._messages) >= limits.retained_messages
            ):
                ledger.counters.publish_dropped += 1
                self._complaints.tell(
                    ledger.now,
                    "retained",
                    "no room to retain %s: %d messages and %d bytes are retained "
                    "(broker.limits.retained_messages, broker.limits.retained_bytes)",
                    quote(message.topic),
                    len(self._messages),
                    self.bytes,
                )
                return False
            self.bytes = grown
            self._messages.set(message.topic, message)
            self._schedule_expiry(message)
        self._changed(message)
        return True

    def delete(self, topic: str) -> None:
        """Retain nothing for the topic any more."""
        self.keep(Message(topic, b"", retain=True))

    def _schedule_expiry(self, message: Message) -> None:
        if message.expires_at is None:
            return
        heapq.heappush(self._expiring, (message.expires_at, next(self._order), message))
        # Those that were replaced are not kept until their time comes.
        if len(self._expiring) > 2 * len(self._messages) + 64:
            self._expiring = [
                entry for entry in self._expiring if self._messages.get(entry[2].topic) is entry[2]
            ]
            heapq.heapify(self._expiring)

    def expire(self, now: float) -> None:
        """Delete those whose time is over, as many as one turn is for."""
        left = EXPIRED_A_TURN
        while left and self._expiring and self._expiring[0][0] <= now:
            left -= 1
            _, _, message = heapq.heappop(self._expiring)
            if self._messages.get(message.topic) is message:
                self._ledger.faults.run("clock.expiry", self.delete, message.topic, otherwise=None)
