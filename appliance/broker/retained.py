"""Retained messages: one per topic, limited in number and bytes, each until it expires."""

from __future__ import annotations

import heapq
import itertools
import logging
from collections.abc import Callable, Iterator
from typing import Final

from appliance.broker.accounting import Accounting
from appliance.broker.accounts import Account
from appliance.broker.counters import COST_PER_TURN
from appliance.broker.message import Message
from appliance.broker.rate_limited_log import RateLimitedLog
from appliance.broker.session import LEVEL_SIZE
from appliance.mqtt.codec import quote, text_size
from appliance.mqtt.topics import TopicTree

log = logging.getLogger(__name__)

#: The cost of retaining or deleting a message; LEVELS_PER_COST_UNIT levels of the topic add one.
RETAIN_COST = 3
LEVELS_PER_COST_UNIT = 2


#: The memory of a retained message beside itself, in bytes: for its owner, and for its expiry.
OWNER_SIZE = 128
EXPIRY_SIZE = 320


def retained_size(message: Message) -> int:
    """Bytes counted for a retained message: itself, and the levels of its topic in the tree."""
    topic = message.topic
    size = message.size + OWNER_SIZE + (EXPIRY_SIZE if message.expires_at is not None else 0)
    levels = topic.count("/")
    return size + (text_size(topic) + LEVEL_SIZE * levels if levels else 0)


#: The reason when the appliance itself would retain more than all users together may.
_IN_ALL: Final = "there is no room left (broker.limits.{})"


class RetainedMessages:
    """The retained messages by topic; `changed` is called when one is set, replaced or deleted.

    A deletion is passed as an empty message. A message counts for its last publisher's account.
    """

    def __init__(
        self,
        accounting: Accounting,
        rate_limited_log: RateLimitedLog,
        changed: Callable[[Message, Account], None],
    ) -> None:
        #: Bytes of all messages, see `retained_size`.
        self.bytes = 0
        self._accounting = accounting
        self._rate_limited_log = rate_limited_log
        self._changed = changed
        self._messages: TopicTree[Message] = TopicTree()
        self._owners: dict[str, Account] = {}
        #: A heap of expiry times, each with a number. Messages that were replaced or deleted leave
        #: these two numbers behind, and nothing else.
        self._expiring: list[tuple[float, int]] = []
        self._numbers: dict[str, int] = {}
        self._topics: dict[int, str] = {}
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
        """Like `find`, but yields None now and then, so that a long search can be suspended."""
        return self._messages.find_in_steps(topic_filter)

    def owner(self, topic: str) -> Account:
        """The account of the topic's retained message. Raises KeyError if there is none."""
        return self._owners[topic]

    def restore(self, messages: list[tuple[Message, Account]]) -> None:
        """Take over the messages of the store."""
        for message, owner in messages:
            self._put(message, owner)

    def keep(self, message: Message, owner: Account, refusable: bool = True) -> bool:
        """Retain the message, or, if it is empty, delete its topic's; False when there is no room.

        While the store fails a `refusable` message of QoS 1 or 2 is not retained either.
        """
        if refusable and message.qos and self._accounting.failing:
            return False
        self._accounting.counters.cost += (
            RETAIN_COST + message.topic.count("/") // LEVELS_PER_COST_UNIT
        )
        old = self._messages.get(message.topic)
        if not message.payload:  # [MQTT-3.3.1-6], 3.1.1 [MQTT-3.3.1-10]
            if old is None:
                return True
            self._take_out(old)
            self._messages.delete(message.topic)
        else:
            message.settle()
            shortage = self._shortage(message, old, owner)
            if shortage:
                self._accounting.counters.drop("not_retained")
                self._log_no_room(message, owner, shortage)
                return False
            self._put(message, owner)
        self._changed(message, owner)
        return True

    def shortage(self, message: Message, owner: Account) -> str:
        """Why the message cannot be retained, with the configuration key; empty if it can."""
        return self._shortage(message, self._messages.get(message.topic), owner)

    def delete(self, topic: str) -> None:
        """Delete the topic's retained message."""
        self.keep(Message(topic, b"", retain=True), self._accounting.accounts.inside)

    def _put(self, message: Message, owner: Account) -> None:
        old = self._messages.get(message.topic)
        if old is not None:
            self._take_out(old)
        size = retained_size(message)
        self.bytes += size
        self._owners[message.topic] = owner
        self._accounting.accounts.retain(owner, 1, size)
        self._messages.set(message.topic, message)
        self._schedule_expiry(message)

    def _take_out(self, old: Message) -> None:
        size = retained_size(old)
        self.bytes -= size
        self._accounting.accounts.retain(self._owners.pop(old.topic), -1, -size)
        number = self._numbers.pop(old.topic, None)
        if number is not None:
            del self._topics[number]

    def _shortage(self, message: Message, old: Message | None, owner: Account) -> str:
        """Why it cannot be retained; replacing `old` frees that one's room, whoever owns it."""
        accounting = self._accounting
        accounts, limits, quotas = accounting.accounts, accounting.limits, accounting.quotas
        size = retained_size(message)
        before = self._owners[message.topic] if old is not None else None
        freed = retained_size(old) if old is not None else 0
        own = freed if before is owner else 0
        if owner.is_inside:  # the appliance may hold as much as all users together
            if owner.retained >= limits.retained_messages + (before is owner):
                return _IN_ALL.format("retained_messages")
            is_much = owner.retained_bytes - own + size > limits.retained_bytes
            return _IN_ALL.format("retained_bytes") if is_much else ""
        if before is owner and size <= freed:
            return ""
        of_users = 0 if before is None or before.is_inside else 1
        count, total = accounts.retained - of_users, accounts.retained_bytes - freed * of_users
        growth = max(0, message.size - (old.size if old else 0))
        if not quotas.retained.allows(owner.retained - (before is owner), count, 1):
            what, key = "room for retained messages", "retained_messages"
            return quotas.retained.shortage(count, 1, what, f"limits.{key}", key)
        if not quotas.retained_bytes.allows(owner.retained_bytes - own, total, size):
            what, key = "room for retained bytes", "retained_bytes"
            return quotas.retained_bytes.shortage(total, size, what, f"limits.{key}", key)
        return "" if accounting.may_store(owner, growth) else accounting.store_shortage(growth)

    def _log_no_room(self, message: Message, owner: Account, shortage: str) -> None:
        self._rate_limited_log.warning(
            log,
            self._accounting.now,
            ("retained", owner.username),
            "no room to retain %s: %s; %s has %d retained messages with %d bytes, of %d with %d in "
            "all",
            quote(message.topic),
            shortage,
            owner,
            owner.retained,
            owner.retained_bytes,
            len(self._messages),
            self.bytes,
        )

    def _schedule_expiry(self, message: Message) -> None:
        if message.expires_at is None:
            return
        number = next(self._order)
        self._numbers[message.topic] = number
        self._topics[number] = message.topic
        heapq.heappush(self._expiring, (message.expires_at, number))
        # Remove the entries of replaced messages before they are due.
        if len(self._expiring) > 2 * len(self._topics) + 64:
            self._expiring = [entry for entry in self._expiring if entry[1] in self._topics]
            heapq.heapify(self._expiring)

    def expire(self, now: float) -> bool:
        """Delete expired messages, up to the cost limit of a turn; True when there are more."""
        counters = self._accounting.counters
        end = counters.cost + COST_PER_TURN
        while self._expiring and self._expiring[0][0] <= now:
            if counters.cost > end:
                return True
            counters.cost += 1
            _, number = heapq.heappop(self._expiring)
            topic = self._topics.get(number)
            if topic is not None:
                self._accounting.faults.run("clock.expiry", self.delete, topic, otherwise=None)
        return False
