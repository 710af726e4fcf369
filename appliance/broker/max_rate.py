"""A rate for a subscription, `max-rate`: of each topic a message in an interval, and the newest.

The first message of a topic is sent at once. What comes within `1 / rate` seconds after it waits,
each in the place of the one before, and the newest is sent when the interval is over, so that the
last value always arrives. That sending begins the next interval. It all happens before a packet is
encoded. The messages have QoS 0.

A topic is known for as long as its interval lasts. Known topics are memory of the user, with a
bound for each session and each user: who publishes to many topics must not fill the queue of a
client that reads fast. Beyond the bound a message is sent at once, as without a rate, and its topic
stays unknown.

A message that waits counts as memory of the session, as do those that wait for a slow client, but
takes no more than half of it: the other half is for QoS 1 and 2. If it finds no room to wait it is
dropped: of such a topic comes the first message of each interval, and not the last.
"""

from __future__ import annotations

import heapq
import math
import re
from collections import deque
from collections.abc import Callable
from typing import Protocol, TypeAlias, cast

from appliance.broker.accounting import Accounting
from appliance.broker.counters import DropReason
from appliance.broker.delivery import Delivery
from appliance.broker.link import Link
from appliance.broker.message import Message
from appliance.mqtt.codec import Properties, Property, quote, text_size
from appliance.mqtt.packets import MAX_RATE

#: Its value: messages a second, such as `10` or `0.5`.
_VALUE = re.compile(r"[0-9]{1,6}(\.[0-9]{1,6})?", re.ASCII)

#: The lowest and the highest value that this allows.
SLOWEST_RATE = 1e-6
FASTEST_RATE = 1e6

#: The approximate memory of a known topic beside its name, in bytes.
TOPIC_SIZE = 300

#: How many known topics are forgotten for a unit of `Counters.cost`.
FORGOTTEN_PER_COST_UNIT = 16

#: What is due within this part of an interval is sent together, but within GATHERED seconds at the
#: most: one write for many topics. Nothing comes early by that.
GATHERED_PART = 1 / 8
GATHERED = 0.02


def max_rate(properties: Properties | None) -> float:
    """The `max-rate` of a SUBSCRIBE in messages a second, 0.0 without.

    Raises:
        ValueError: it is not a rate, or is given twice; the text is for the client.
    """
    pairs = cast("list[tuple[str, str]]", (properties or {}).get(Property.USER_PROPERTY, []))
    values = [value for name, value in pairs if name == MAX_RATE]
    if not values:
        return 0.0
    if len(values) > 1:
        raise ValueError(f"{MAX_RATE} is given {len(values)} times")
    if not _VALUE.fullmatch(values[0]) or not float(values[0]):
        raise ValueError(
            f"{MAX_RATE} is {quote(values[0][:40])}, and not a number of messages a second above 0 "
            "with up to six digits before and after the point"
        )
    return float(values[0])


class RatedSession(Protocol):
    """A session, as far as the rates of its subscriptions need it."""

    link: Link | None
    bytes: int
    #: Rated messages that wait for the end of an interval.
    rated: int
    latest: dict[str | int, Delivery]
    large: dict[str | int, Delivery]

    def fits(self, size: int) -> bool:
        """Whether the session may take `size` more bytes."""

    def take(self, size: int) -> None:
        """Count `size` more bytes; negative: fewer."""

    def may_know(self, size: int) -> bool:
        """Whether one more topic of `size` bytes may be known."""

    def know(self, size: int) -> None:
        """Count `size` more bytes of known topics; negative: fewer."""

    def deliver(
        self,
        message: Message,
        qos: int,
        retain: bool,
        subscription_ids: list[int] | None,
    ) -> bool:
        """Send the message, or queue it; False when it was dropped, and counted."""

    def keep_latest(self, delivery: Delivery) -> bool:
        """Queue a QoS 0 message for a slow client; False when it was dropped, and counted."""

    def is_wanted_still(self, message: Message) -> bool:
        """Whether a message that has waited may be sent; if not, it is counted as dropped."""

    def drop(self, message: Message, reason: DropReason) -> None:
        """Count a message that is dropped because there is no room."""


def _ignore(when: float) -> None:
    """Nobody waits: the owner of the broker calls `Broker.send_due` anyway."""


class RateSchedule:
    """When messages of all sessions are due that wait for the end of an interval.

    `clock` is in seconds, and finer than the broker's, which may stand for a second while only the
    bridge publishes. `wake` is called with the time at which `Broker.send_due` has to be called, if
    that is earlier than known before.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self.clock = clock
        self.wake: Callable[[float], None] = _ignore
        self._heap: list[tuple[float, int]] = []
        #: What the numbers in the heap stand for; a number that is missing here was cancelled.
        self._limits: dict[int, RateLimit] = {}
        self._last = 0
        self._is_sending = False

    def __len__(self) -> int:
        return len(self._limits)

    def add(self, limit: RateLimit, when: float) -> int:
        """Call the limit's `send_due` at that time; returns the number for `cancel`."""
        self._last += 1
        self._limits[self._last] = limit
        is_first = not self._heap or when < self._heap[0][0]
        heapq.heappush(self._heap, (when, self._last))
        # Ended subscriptions of long intervals must not make it grow.
        if len(self._heap) > 2 * len(self._limits) + 64:
            self._heap = [entry for entry in self._heap if entry[1] in self._limits]
            heapq.heapify(self._heap)
        if is_first and not self._is_sending:
            self.wake(when)
        return self._last

    def cancel(self, number: int) -> None:
        """Do not call it; may be called twice."""
        self._limits.pop(number, None)

    def next_due(self, now: float) -> RateLimit | None:
        """Take out the next limit with something due; None if there is none."""
        while self._heap and self._heap[0][0] <= now:
            _, number = heapq.heappop(self._heap)
            limit = self._limits.pop(number, None)
            if limit is not None:
                return limit
        return None

    def sending(self, is_sending: bool) -> None:
        """While due messages are sent nobody has to be woken."""
        self._is_sending = is_sending

    @property
    def next_at(self) -> float:
        """When something is due next; infinity for never."""
        while self._heap and self._heap[0][1] not in self._limits:
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else math.inf


class _Topic:
    """A topic of which a message was sent less than an interval ago."""

    __slots__ = ("due", "name", "size", "waiting")

    def __init__(self, name: str) -> None:
        self.name = name
        self.size = TOPIC_SIZE + text_size(name)
        #: When its interval is over, and the newest message since it began.
        self.due = 0.0
        self.waiting: Delivery | None = None


class RateLimit:
    """The rate of one subscription, and the messages that wait because of it."""

    __slots__ = (
        "_accounting",
        "_counters",
        "_grain",
        "_interval",
        "_number",
        "_order",
        "_schedule",
        "_topics",
        "rate",
        "session",
    )

    def __init__(
        self, session: RatedSession, rate: float, accounting: Accounting, schedule: RateSchedule
    ) -> None:
        """`rate` is in messages a second of each topic."""
        self.rate = rate
        self.session = session
        self._accounting = accounting
        self._counters = accounting.counters
        self._schedule = schedule
        self._interval = 1 / rate
        self._grain = min(self._interval * GATHERED_PART, GATHERED)
        self._topics: dict[str, _Topic] = {}
        #: The ends of their intervals. An entry counts if the topic's interval still ends then.
        self._order: deque[tuple[float, _Topic]] = deque()
        #: Its number in the schedule; 0 while nothing is to be done.
        self._number = 0

    @property
    def size(self) -> int:
        """Bytes that are counted for the messages that wait, counted anew."""
        topics = self._topics.values()
        return sum(topic.waiting[0].size for topic in topics if topic.waiting is not None)

    @property
    def topic_bytes(self) -> int:
        """Bytes that are counted for the topics that it knows, counted anew."""
        return sum(topic.size for topic in self._topics.values())

    def offer(
        self, message: Message, retain: bool, subscription_ids: list[int] | None, now: float
    ) -> bool:
        """Send the message, or let it wait; False when it was dropped, and counted.

        `now` is a time of the schedule's clock.
        """
        session = self.session
        if session.link is None:
            return False  # QoS 0 is not queued for an absent client
        name = message.topic
        topic = self._topics.get(name)
        if (session.large or session.latest) and (name in session.large or name in session.latest):
            # One of the topic waits for the slow client already: a newer one takes its place there,
            # so that one of a topic waits, and not two.
            if topic is not None and topic.waiting is not None:
                self._throttled(topic)
            return session.keep_latest(cast(Delivery, (message, 0, retain, subscription_ids, None)))
        if topic is None:
            topic = self._begin(name)
            if topic is None:
                return session.deliver(message, 0, retain, subscription_ids)
        elif now < topic.due:
            return self._wait(topic, message, retain, subscription_ids)
        if topic.waiting is not None:
            self._throttled(topic)
        self._sent(topic, now)
        return session.deliver(message, 0, retain, subscription_ids)

    def offer_retained(
        self, message: Message, subscription_ids: list[int] | None, now: float
    ) -> bool:
        """Whether a retained message may be sent now, as the first of its topic.

        If not it waits, unless a newer one does.
        """
        topic = self._topics.get(message.topic)
        if topic is None:
            topic = self._begin(message.topic)
            if topic is None:
                return True
        elif now < topic.due:
            if topic.waiting is None:
                self._wait(topic, message, True, subscription_ids)
            return False
        elif topic.waiting is not None:
            return False  # which is due
        self._sent(topic, now)
        return True

    def send_due(self, now: float, cost: int) -> None:
        """Send what is due, until `Counters.cost` exceeds this; `go_on` has to be called then."""
        counters = self._counters
        order = self._order
        session = self.session
        while order and order[0][0] <= now and counters.cost <= cost:
            due, topic = order.popleft()
            if due != topic.due:
                continue  # a message was sent since
            counters.cost += 1
            waiting = topic.waiting
            if waiting is None:
                self._forget(topic)
                continue
            self._free(topic)
            if not session.is_wanted_still(waiting[0]):
                self._forget(topic)
                continue
            self._sent(topic, now)
            session.deliver(waiting[0], 0, waiting[2], waiting[3])

    def go_on(self, now: float) -> None:
        """`send_due` has ended, or failed: it is called again when something is due."""
        self._number = 0
        self._schedule_next(now)

    def end(self, *, sends: bool = False) -> None:
        """Forget all topics; with `sends`, send what waits first."""
        session, topics = self.session, self._topics.values()
        waiting = [topic.waiting for topic in topics if topic.waiting is not None]
        self._counters.cost += len(topics) // FORGOTTEN_PER_COST_UNIT + len(waiting)
        session.take(-sum(delivery[0].size for delivery in waiting))
        session.rated -= len(waiting)
        session.know(-self.topic_bytes)
        self._topics.clear()
        self._order.clear()
        self._schedule.cancel(self._number)
        self._number = 0
        if sends:
            for delivery in waiting:
                if session.is_wanted_still(delivery[0]):
                    session.deliver(delivery[0], 0, delivery[2], delivery[3])

    def _begin(self, name: str) -> _Topic | None:
        """Know a topic that was not known; None if there is no room, then it has no rate."""
        topic = _Topic(name)
        if not self.session.may_know(topic.size):
            return None
        self.session.know(topic.size)
        self._topics[name] = topic
        return topic

    def _forget(self, topic: _Topic) -> None:
        topic.due = 0.0  # which no entry of the order has
        del self._topics[topic.name]
        self.session.know(-topic.size)

    def _sent(self, topic: _Topic, now: float) -> None:
        """A message is sent: the next one not before the end of the interval."""
        topic.due = now + self._interval
        self._order.append((topic.due, topic))
        if not self._number:
            self._schedule_next(now)

    def _schedule_next(self, now: float) -> None:
        if self._order and not self._number:
            due = max(self._order[0][0], now)
            # Times on a grid, so that what many clients are due is sent in one turn.
            when = max(math.ceil(due / self._grain) * self._grain, due)
            self._number = self._schedule.add(self, when)

    def _wait(
        self, topic: _Topic, message: Message, retain: bool, subscription_ids: list[int] | None
    ) -> bool:
        before = topic.waiting
        session = self.session
        if before is not None:
            grown = message.size - before[0].size
            if grown <= 0 or self._has_room(grown):
                if grown:
                    session.take(grown)
                message.settle()
                topic.waiting = cast(Delivery, (message, 0, retain, subscription_ids, None))
                self._counters.publish_throttled += 1
                return True
            self._throttled(topic)
        limit = self._accounting.limits.queue_messages
        if session.rated >= limit or not self._has_room(message.size):
            session.drop(message, "queue_full")
            return False
        message.settle()
        session.take(message.size)
        session.rated += 1
        topic.waiting = cast(Delivery, (message, 0, retain, subscription_ids, None))
        return True

    def _throttled(self, topic: _Topic) -> None:
        """A newer message takes the place of the one that waits."""
        self._free(topic)
        self._counters.publish_throttled += 1

    def _free(self, topic: _Topic) -> None:
        waiting, topic.waiting = topic.waiting, None
        if waiting is not None:
            self.session.take(-waiting[0].size)
            self.session.rated -= 1

    def _has_room(self, size: int) -> bool:
        """Whether a message of this size may wait: beyond half, publishers wait for the reader."""
        accounting = self._accounting
        session = self.session
        return session.bytes + size <= accounting.half_queue and (
            accounting.queued_bytes + size <= accounting.unrestricted_memory or session.fits(size)
        )


#: limit, retain as published, subscription identifiers
RatedTarget: TypeAlias = "tuple[RateLimit, bool, list[int] | None]"
