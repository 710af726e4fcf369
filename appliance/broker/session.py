"""A client's session: subscriptions, the inflight window, the bounded queue and packet ids."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from typing import Any, Final, cast

from appliance.broker.accounting import Accounting
from appliance.broker.backpressure import Congestion
from appliance.broker.counters import DropReason
from appliance.broker.delivery import Delivery, Group, PendingWill, UnreleasedPublish, held_size
from appliance.broker.link import Link
from appliance.broker.max_rate import RateLimit, RateSchedule
from appliance.broker.message import Message
from appliance.broker.store import Unread
from appliance.broker.values import Identity
from appliance.mqtt.codec import text_size
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ProtocolError, ReasonCode

#: Retained messages that are sent or skipped for new subscriptions in one turn of the event loop:
#: some milliseconds, half of a turn, then it is the turn of other clients.
REPLAYED_PER_TURN = 224

#: The cost of one of these, which may be a step of the search for them. REPLAYS_PER_COST_UNIT
#: replays that are looked at, and cannot go on, add one unit.
REPLAY_COST = 2
REPLAYS_PER_COST_UNIT = 8

#: Messages of a session that are looked at for one unit of cost: whether others may have them.
PASSED_PER_COST_UNIT = 16

#: Messages of a restored queue that are read at once when the oldest ones are to be dropped.
FEW_READ = 16
MANY_READ = 100

#: The cost of reading one of them.
READ_COST = 2

#: The size, in bytes, above which a message is large: an image or a map, not a state or a command.
#: A slow client gets large QoS 0 messages after everything else, see `Link.is_behind`.
LARGE_MESSAGE: Final = 32 * 1024

#: The approximate memory of a subscription, in bytes: itself, and each level of its filter.
SUBSCRIPTION_SIZE = 600
LEVEL_SIZE = 350


def subscription_size(topic_filter: str) -> int:
    """Bytes counted for a subscription: its filter is in the session, and in the tree."""
    return SUBSCRIPTION_SIZE + 2 * text_size(topic_filter) + LEVEL_SIZE * topic_filter.count("/")


#: Keys for queued QoS 0 messages, in their order of arrival.
_NUMBERS = itertools.count()


def _wrong(kind: str, packet_id: int) -> ProtocolError:
    problem = f"{kind} for message {packet_id}, which waits for something else"
    return ProtocolError(ReasonCode.PROTOCOL_ERROR, problem)


@dataclass(slots=True)
class SessionAccounting(Accounting):
    """The accounting of the sessions, and what they leave for the broker to do."""

    #: Sessions to be disconnected at the next flush because their queues overflowed.
    overflowed: list[Session] = field(default_factory=list)
    #: Sessions of absent clients whose queues have become full, to be logged, each with the reason.
    filled: list[tuple[Session, str]] = field(default_factory=list)
    #: Whether the rules in force still let a session receive a queued message of a topic.
    may_still_receive: Callable[[Session, str], bool] = field(default=lambda session, topic: True)
    #: When messages are due that wait because of the rate of a subscription.
    rates: RateSchedule = field(init=False)

    def __post_init__(self) -> None:
        Accounting.__post_init__(self)
        self.rates = RateSchedule(lambda: self.now)


class Gap:
    """The place in a restored queue of messages that are only in the store yet.

    `Session.queue` has those before it, `newer` what came in since the start.
    """

    __slots__ = ("bytes", "newer", "unread")

    def __init__(self, unread: Unread) -> None:
        self.unread = unread
        #: What the session counts for them.
        self.bytes = unread.bytes
        self.newer: deque[Delivery] = deque()


class Replay:
    """The retained messages that a new subscription is still to be sent."""

    __slots__ = ("deliveries", "waiting")

    def __init__(self, deliveries: Iterator[Delivery | None]) -> None:
        #: None among them is a message that is skipped, or a step of the search.
        self.deliveries = deliveries
        #: The next one, if it has been looked up and could not be sent yet.
        self.waiting: Delivery | None = None


class Session:
    """The session state of a client id (3.1.1 section 3.1.1, 5.0 section 4.1).

    A session inside the appliance belongs to one of its parts (`Broker.attach`); if it has no
    `identity`, it has all rights. `expiry` is the time in seconds for which the session outlives
    its connection.
    """

    __slots__ = (
        "_agreed_window",
        "_last_packet_id",
        "account",
        "accounting",
        "batch",
        "bytes",
        "client_id",
        "congestion",
        "connected_at",
        "ended_well",
        "ends_at",
        "epoch",
        "expiry",
        "gap",
        "identity",
        "inflight",
        "is_full_logged",
        "is_inside",
        "is_replaying",
        "large",
        "latest",
        "link",
        "queue",
        "queue_bytes",
        "rate_limits",
        "rated",
        "readable",
        "readable_epoch",
        "received",
        "replays",
        "replays_left",
        "replays_of_qos_0",
        "resends",
        "routes",
        "subscriptions",
        "topic_bytes",
        "unchecked",
        "will",
        "will_at",
        "window",
    )

    def __init__(
        self,
        client_id: str,
        identity: Identity | None,
        accounting: SessionAccounting,
        *,
        is_inside: bool = False,
    ) -> None:
        self.client_id = client_id
        self.identity = identity
        self.is_inside = is_inside
        self.accounting = accounting
        #: The account in which its memory is counted: its user's, or the appliance's own.
        accounts = accounting.accounts
        self.account = accounts.inside if is_inside else accounts.of(identity)
        self.link: Link | None = None
        self.expiry = 0
        #: When its connection began, in seconds of the broker's clock.
        self.connected_at = accounting.now
        #: Whether its last connection ended with a DISCONNECT that discards the will.
        self.ended_well = False
        self.ends_at: float | None = None
        #: Whether it was logged that the queue has become full during the client's absence.
        self.is_full_logged = False
        self.will: PendingWill | None = None
        self.will_at: float | None = None
        self.subscriptions: dict[str, Subscription] = {}
        #: Sent and not acknowledged, in the order sent; None after PUBREC [MQTT-4.3.3-8].
        self.inflight: dict[int, Delivery | None] = {}
        #: Packet ids in flight that were not yet sent again on the new connection.
        self.resends: deque[int] = deque()
        #: The number of messages that may be in flight; 0 while the store cannot store them.
        self.window = self._agreed_window = accounting.limits.inflight
        #: The batch of the store that the session's output depends on.
        self.batch = 0
        #: QoS 1 and 2, waiting for the window or the client.
        self.queue: deque[Delivery] = deque()
        #: The bytes of these messages: to add them up for each new one would cost as much as all.
        self.queue_bytes = 0
        #: Set while the store has messages of the queue that were not read since the start.
        self.gap: Gap | None = None
        #: Set while publishers may have to wait for its client.
        self.congestion: Congestion | None = None
        #: Retained messages of new subscriptions, by filter; they are sent before newer messages.
        #: Each is looked up when it can be sent, so that a slow client's replay takes no memory.
        self.replays: dict[str, Replay] = {}
        #: Those among them that do not need the window [MQTT-3.3.4-8].
        self.replays_of_qos_0: dict[str, Replay] = {}
        self.is_replaying = False
        self.replays_left = REPLAYED_PER_TURN
        #: QoS 0 messages for a slow client, oldest first: the latest of each topic or, if the limit
        #: `keep` is set, that many messages, by number.
        self.latest: dict[str | int, Delivery] = {}
        #: The large ones among these; empty if the limit `keep` is set, which preserves the order.
        self.large: dict[str | int, Delivery] = {}
        #: The rates of subscriptions that have one, by filter, and how many messages wait for them.
        self.rate_limits: dict[str, RateLimit] = {}
        self.rated = 0
        #: Bytes of the topics that the rates know. Nothing waits there: they are not in `bytes`,
        #: and take no room of messages.
        self.topic_bytes = 0
        #: QoS 2 from the client, waiting for PUBREL.
        self.received: dict[int, UnreleasedPublish] = {}
        self.bytes = 0
        #: Whether the access rules have changed since they allowed the queued messages.
        self.unchecked = False
        #: Whether the client may receive a topic; valid while the epoch is the access rules'.
        self.readable: dict[str, bool] = {}
        self.readable_epoch = -1
        #: The routes of what this session publishes, by topic: a cache of the router, which alone
        #: knows what a route is. It is valid while `epoch` is the router's.
        self.routes: dict[bytes, Any] = {}
        self.epoch = -1
        self._last_packet_id = 0

    def __str__(self) -> str:
        return str(self.identity) if self.identity else f"'{self.client_id}'"

    @property
    def age(self) -> float:
        """Seconds since its connection began."""
        return self.accounting.now - self.connected_at

    @property
    def persistent(self) -> bool:
        """Whether the session outlives its connection."""
        return self.expiry > 0

    # --- towards the client -------------------------------------------------------------------

    @property
    def waiting(self) -> int:
        """QoS 1 and 2 messages that wait for the window or the client."""
        if self.gap is None:
            return len(self.queue)
        return len(self.queue) + self.gap.unread.count + len(self.gap.newer)

    @property
    def awaits_store(self) -> bool:
        """Whether it can be sent nothing until the store has read on."""
        return self.gap is not None and not self.queue

    @property
    def ready(self) -> bool:
        """Whether a message would be sent immediately."""
        link = self.link
        return (
            link is not None
            and link.writable
            and not self.queue
            and self.gap is None
            and not self.latest
            and not self.large
            and len(self.inflight) < self.window
        )

    def deliver(
        self,
        message: Message,
        qos: int,
        retain: bool,
        subscription_ids: list[int] | None,
        share: Group | None = None,
        refusable: bool = True,
    ) -> bool:
        """Send the message, or queue it; False when it was dropped, and counted.

        `refusable` is as for `Broker.publish_to`.
        """
        link = self.link
        if not qos:
            if link is None:
                return False  # QoS 0 is not queued for an absent client, as the standard allows
            if link.writable:  # replays then wait for the window only, which QoS 0 does not need
                link.publish(message, 0, 0, False, retain, subscription_ids)
                return True
            return self.keep_latest(cast(Delivery, (message, 0, retain, subscription_ids, share)))
        # `fits` and `_count` are inlined here and in `_enqueue`, which saves two calls per message.
        accounting = self.accounting
        size = message.size
        if (
            self.bytes + size <= accounting.half_queue
            and accounting.queued_bytes + size <= accounting.unrestricted_memory
        ) or self._fits_tightly(size):
            if (
                link is not None
                and link.writable
                and len(self.inflight) < self.window
                and not self.queue
                and self.gap is None
                and not self.replays
            ):
                self.bytes += size
                self.account.bytes += size
                accounting.queued_bytes += size
                self._send(link, cast(Delivery, (message, qos, retain, subscription_ids, share)))
                return True
            if self.waiting < accounting.queue_messages:
                return self._enqueue(
                    cast(Delivery, (message, qos, retain, subscription_ids, share)), refusable
                )
        if accounting.limits.queue_full == "drop-oldest" and self._drop_oldest_for(
            message, refusable
        ):
            return self._enqueue(
                cast(Delivery, (message, qos, retain, subscription_ids, share)), refusable
            )
        if accounting.limits.queue_full == "disconnect" and link is not None:
            accounting.overflowed.append(self)
        self._report_full(size)
        self.drop(message, "queue_full")
        return False

    def deliver_promised(self, delivery: Delivery) -> None:
        """Deliver a QoS 2 message that had room at its PUBREC, even if there is none now.

        A PUBREL cannot be refused. The limits are exceeded by no more than the messages that all
        publishers have between PUBREC and PUBREL.
        """
        if not self.deliver(*delivery):
            self.accounting.counters.take_back_drop()
            self._enqueue(delivery, promised=True)

    def has_room(self, message: Message, refusable: bool = True) -> bool:
        """Whether a QoS 1 or 2 message would be queued; `refusable` as for `deliver`."""
        accounting = self.accounting
        if self.expiry and not self._may_store(message, refusable):
            return False
        return (
            self.waiting < accounting.queue_messages and self.fits(message.size)
        ) or accounting.limits.queue_full == "drop-oldest"

    def _may_store(self, message: Message, refusable: bool) -> bool:
        accounting = self.accounting
        if refusable and accounting.failing:
            return False
        return accounting.may_store(self.account, message.size)

    def _enqueue(
        self, delivery: Delivery, refusable: bool = True, *, promised: bool = False
    ) -> bool:
        """Queue it; False, and counted as dropped, when it has to be stored and cannot be."""
        message = delivery[0]
        if self.expiry:
            if not promised and not self._may_store(message, refusable):
                if not (refusable and self.accounting.failing):
                    self._report_full(message.size)
                self.accounting.counters.drop("not_stored")
                return False
            self._depend_on_batch()
            self.accounting.store.queued(self, delivery)
        message.settle()
        size = message.size
        self.bytes += size
        self.account.bytes += size
        self.accounting.queued_bytes += size
        (self.queue if self.gap is None else self.gap.newer).append(delivery)
        self.queue_bytes += size
        if self.congestion is None and 2 * self.waiting > self.accounting.queue_messages:
            self._congest()
        return True

    def _depend_on_batch(self) -> None:
        """Make later output depend on the change that is about to be staged."""
        self.batch = self.accounting.store.batch

    def _drop_oldest_for(self, message: Message, refusable: bool) -> bool:
        """Drop the oldest queued messages to make room; False when that is not enough."""
        accounting = self.accounting
        if not self.fits(message.size - self.queue_bytes):
            return False
        if self.expiry and refusable and self.accounting.failing:
            return False
        while (self.queue or self.gap is not None) and not (
            self.waiting < accounting.queue_messages and self.fits(message.size)
        ):
            if not self.queue:
                too_many = self.waiting - accounting.queue_messages
                self._read(max(FEW_READ, min(too_many, MANY_READ)))
                continue
            self._report_full(message.size)
            oldest = self.queue.popleft()
            self.queue_bytes -= oldest[0].size
            self._uncount(oldest[0])
            self._settled(oldest)
            self.drop(oldest[0], "queue_full")
        return self.fits(message.size)

    def replay(self, topic_filter: str, deliveries: Iterator[Delivery | None]) -> None:
        """Let `pump` send retained messages, after other replays; a repeated replay starts anew.

        A None among the deliveries is a message that is skipped.
        """
        self._end_replay(topic_filter)
        self.replays[topic_filter] = replay = Replay(deliveries)
        if not self.subscriptions[topic_filter].qos:
            self.replays_of_qos_0[topic_filter] = replay

    def _end_replay(self, topic_filter: str) -> None:
        self.replays.pop(topic_filter, None)
        self.replays_of_qos_0.pop(topic_filter, None)

    def take_turn(self) -> None:
        """Send what is queued, in a new turn: other clients have had theirs in between."""
        self.replays_left = REPLAYED_PER_TURN
        self.pump()

    def pump(self) -> None:
        """Send what is queued, as far as the window and the link allow."""
        link = self.link
        if link is None:
            return
        if self.resends:
            self._pump_resends(link)
        if self.replays and not self.resends and not self._pump_replays(link):
            link.later()
        if not self.replays and not self.resends:
            self._pump_queue(link)
        if self.latest or self.large:
            self._pump_latest(link)
        if self.congestion is not None:
            self._relieve(self.congestion)
        if self.unchecked and not (
            self.queue or self.gap is not None or self.latest or self.large or self.resends
        ):
            self.unchecked = False

    def _pump_resends(self, link: Link) -> None:
        # The window may be smaller than it was on the last connection [MQTT-3.3.4-9].
        resends = self.resends
        while resends and link.writable and len(self.inflight) - len(resends) < self.window:
            packet_id = resends.popleft()
            delivery = self.inflight.get(packet_id)
            if delivery is None:
                continue
            message, qos, retain, subscription_ids, _ = delivery
            if self._is_forbidden(message):
                self.give_up(packet_id)
                continue
            try:
                link.publish(message, qos, packet_id, True, retain, subscription_ids)
            except Exception as error:
                self._cannot_be_sent(error, packet_id)

    def _pump_replays(self, link: Link) -> bool:
        """Send retained messages; False when the limit of one turn is reached.

        Thousands of replays may wait for the window. Once it is full only those are looked at that
        do not need it, so that an acknowledgement costs what it makes room for.
        """
        if self.is_replaying:  # a session inside the appliance acknowledges in `publish`
            return True
        self.is_replaying = True
        try:
            if len(self.inflight) < self.window and not self._go_on_with(self.replays, link):
                return False
            return len(self.inflight) < self.window or self._go_on_with(self.replays_of_qos_0, link)
        finally:
            self.is_replaying = False

    def _go_on_with(self, replays: dict[str, Replay], link: Link) -> bool:
        """Go on with all replays, as long as the window has room, or with those of QoS 0."""
        needs_window = replays is self.replays
        accounting = self.accounting
        ended: list[str] = []
        failed: list[str] = []
        looked, has_turn = 0, True
        for topic_filter, replay in replays.items():
            if not (has_turn and link.writable):
                break
            if needs_window and len(self.inflight) >= self.window:
                break
            looked += 1
            is_free = topic_filter in self.replays_of_qos_0
            while link.writable and (is_free or len(self.inflight) < self.window):
                delivery, replay.waiting = replay.waiting, None
                if delivery is None:
                    if not self.replays_left:
                        has_turn = False
                        break
                    self.replays_left -= 1
                    accounting.counters.cost += REPLAY_COST
                    try:
                        delivery = next(replay.deliveries)
                    except StopIteration:
                        ended.append(topic_filter)
                        break
                    except Exception as error:
                        accounting.faults.caught("session.replay", error, self)
                        failed.append(topic_filter)
                        break
                    if delivery is None:
                        continue
                message, qos, _, _, _ = delivery
                if (
                    len(self.inflight) >= self.window
                    or (self.inflight and not self.fits(message.size))
                    if qos
                    else message.size > LARGE_MESSAGE and link.is_behind()
                ):
                    # Continue when messages are acknowledged, or when output has been written.
                    replay.waiting = delivery
                    break
                if qos:
                    self._count(message)
                    self._send(link, delivery)
                else:
                    self._publish(link, delivery)
        accounting.counters.cost += looked // REPLAYS_PER_COST_UNIT
        for topic_filter in failed:
            self._end_replay(topic_filter)
        for topic_filter in ended:
            self._end_replay(topic_filter)
            if self.expiry and self.subscriptions[topic_filter].qos:
                accounting.store.subscribed(self, self.subscriptions[topic_filter])
        return has_turn

    def _pump_queue(self, link: Link) -> None:
        inflight = self.inflight
        while self.queue and link.writable and len(inflight) < self.window:
            delivery = self.queue.popleft()
            message = delivery[0]
            self.queue_bytes -= message.size
            # Most messages neither expire nor have to be checked, which saves two calls for each.
            if (message.expires_at is not None and self.accounting.has_expired(message)) or (
                self.unchecked and self._is_forbidden(message)
            ):
                self._uncount(message)
                self._settled(delivery)
                # Its packet id is skipped, as in mosquitto, which assigns ids on queueing.
                self._last_packet_id = self._last_packet_id % 65535 + 1
            else:
                self._send(link, delivery)  # it stays counted
        if self.gap is not None and not self.queue:
            self.gap.unread.hurry()

    def read_on(self, count: int) -> None:
        """Read up to so many messages of the queue that only the store has; send what can be."""
        self._read(count)
        self.pump()

    def read_all(self) -> None:
        """Read all messages of the queue that only the store has: as many as a queue may have."""
        while self.gap is not None:
            self._read(self.gap.unread.count)

    def _read(self, count: int) -> None:
        gap = self.gap
        if gap is None:
            return
        found = gap.unread.read(count)
        self.accounting.counters.cost += READ_COST * len(found)
        gap.bytes -= sum(delivery[0].size for delivery in found)
        self.queue.extend(found)
        if not gap.unread.count:
            self.gap = None
            self.queue.extend(gap.newer)
            # What could not be read, and what the estimate of a topic's memory was wrong by.
            self.queue_bytes -= gap.bytes
            self.take(-gap.bytes)

    def drop_queued(self, is_old: Callable[[Message], bool]) -> int:
        """Drop queued messages that are too old; returns their number.

        While some are only in the store, none: they are looked at when they have been read.
        """
        if self.gap is not None:
            return 0
        remaining = deque(delivery for delivery in self.queue if not is_old(delivery[0]))
        dropped = len(self.queue) - len(remaining)
        if dropped:
            for delivery in self.queue:
                if is_old(delivery[0]):
                    self.queue_bytes -= delivery[0].size
                    self._uncount(delivery[0])
                    self._settled(delivery)
                    self.drop(delivery[0], "expired")
            self.queue = remaining
            if self.congestion is not None:
                self._relieve(self.congestion)
        return dropped

    def open_window(self, size: int) -> None:
        """Allow `size` messages in flight, or none as long as the store fails."""
        self._agreed_window = size
        self.window = 0 if self.accounting.failing and self.expiry else size

    def hold_back(self) -> None:
        """Send no message that has to be stored until `go_on`: the store fails."""
        self.window = 0 if self.expiry else self._agreed_window

    def go_on(self) -> None:
        """The store works again: send what was held back."""
        self.window = self._agreed_window
        if self.link is not None:
            for packet_id, delivery in self.inflight.items():
                if delivery is None:  # PUBREC may have arrived meanwhile
                    self.link.pubrel(packet_id)
            self.pump()

    def restore(
        self,
        inflight: dict[int, Delivery | None],
        queue: list[Delivery],
        received: dict[int, UnreleasedPublish],
        unread: Unread | None = None,
    ) -> None:
        """Take over the messages that the store has for this session.

        `unread` are those of the queue that it reads later; `queue` is empty then.
        """
        self.inflight.update(inflight)
        self.queue.extend(queue)
        self.received.update(received)
        in_flight = sum(each[0].size for each in inflight.values() if each is not None)
        queued = sum(delivery[0].size for delivery in queue)
        self.queue_bytes += queued
        self.take(in_flight + queued)
        for held in received.values():
            self.take(held_size(held))
        self._last_packet_id = next(reversed(inflight), 0)
        if unread is not None:
            self.gap = Gap(unread)
            self.queue_bytes += self.gap.bytes
            self.take(self.gap.bytes)

    def resend(self) -> None:
        """Send again what was in flight when the last connection ended [MQTT-4.4.0-1]."""
        link = self.link
        assert link is not None
        self.resends.clear()
        for packet_id, delivery in self.inflight.items():
            if delivery is not None:
                self.resends.append(packet_id)
            elif not (self.expiry and self.accounting.failing):
                link.pubrel(packet_id)
        if self.congestion is not None:
            self.congestion.resume()
        elif self._is_crowded():
            self._congest()
        self.pump()

    def _send(self, link: Link, delivery: Delivery) -> None:
        """Send a QoS 1 or 2 message that is counted already."""
        message, qos, retain, subscription_ids, _ = delivery
        inflight = self.inflight
        packet_id = self._last_packet_id % 65535 + 1
        while packet_id in inflight:  # [MQTT-2.2.1-3]
            packet_id = packet_id % 65535 + 1
        self._last_packet_id = packet_id
        inflight[packet_id] = delivery
        if self.congestion is not None:
            self.congestion.sent(packet_id)
        if self.expiry:
            self._depend_on_batch()
            self.accounting.store.sent(self, delivery, packet_id)
        try:
            link.publish(message, qos, packet_id, False, retain, subscription_ids)
        except Exception as error:
            self._cannot_be_sent(error, packet_id)

    def _publish(self, link: Link, delivery: Delivery) -> None:
        """Send a queued QoS 0 message."""
        message, _, retain, subscription_ids, _ = delivery
        try:
            link.publish(message, 0, 0, False, retain, subscription_ids)
        except Exception as error:
            self._cannot_be_sent(error)

    def _cannot_be_sent(self, error: Exception, packet_id: int = 0) -> None:
        """Drop a message whose sending failed, so that it does not block the queue."""
        self.accounting.counters.drop("fault")
        self.accounting.faults.caught("session.send", error, self)
        if packet_id:
            self.give_up(packet_id)

    def _pump_latest(self, link: Link) -> None:
        while link.writable and (waiting := self.latest or self.large):
            oldest = next(iter(waiting))
            if waiting is self.large and link.is_behind():
                return
            delivery = waiting.pop(oldest)
            message = delivery[0]
            self._uncount(message)
            if not (self.accounting.has_expired(message) or self._is_forbidden(message)):
                self._publish(link, delivery)

    def _is_forbidden(self, message: Message) -> bool:
        """Whether changed rules forbid a queued message; if so, it is counted as dropped."""
        if not self.unchecked or self.accounting.may_still_receive(self, message.topic):
            return False
        self.accounting.counters.drop("forbidden")
        return True

    def is_wanted_still(self, message: Message) -> bool:
        """Whether a message that has waited may be sent; if not, it is counted as dropped.

        It has not expired, and the rules in force let the client receive it.
        """
        accounting = self.accounting
        if accounting.has_expired(message):
            return False
        if accounting.may_still_receive(self, message.topic):
            return True
        accounting.counters.drop("forbidden")
        return False

    def keep_latest(self, delivery: Delivery) -> bool:
        """Queue a QoS 0 message for a slow client; False when it was dropped, and counted."""
        message = delivery[0]
        limits = self.accounting.limits
        replaced: Delivery | None = None
        key: str | int = message.topic
        if limits.keep:
            key = next(_NUMBERS)
            if len(self.latest) >= limits.keep:
                replaced = self.latest.pop(next(iter(self.latest)))
        else:
            replaced = self.latest.pop(key, None) or self.large.pop(key, None)
        if replaced is not None:
            self._uncount(replaced[0])
            self.drop(replaced[0], "queue_full" if limits.keep else "replaced")
        room = limits.keep or len(self.latest) + len(self.large) < limits.queue_messages
        if room and self.fits(message.size):
            message.settle()
            self._count(message)
            is_large = message.size > LARGE_MESSAGE and not limits.keep
            (self.large if is_large else self.latest)[key] = delivery
            return True
        self.drop(message, "queue_full")
        return False

    def overtake(self, topic: str) -> None:
        """Drop a queued large message of the topic, because a newer QoS 0 message is sent."""
        waiting = self.large.pop(topic, None)
        if waiting is not None:
            self._uncount(waiting[0])
            self.drop(waiting[0], "replaced")

    def _report_full(self, size: int) -> None:
        """Have the full queue logged once in an absence: nobody else notices the lost messages."""
        if self.link is None and not self.is_full_logged:
            self.is_full_logged = True
            self.accounting.filled.append((self, self.shortage(size)))

    def drop(self, message: Message, reason: DropReason) -> None:
        """Count a message that is dropped because the client is too slow."""
        self.accounting.counters.drop(reason)
        message.dropped()

    def _count(self, message: Message) -> None:
        self.take(message.size)

    def _uncount(self, message: Message) -> None:
        self.take(-message.size)

    def _settled(self, delivery: Delivery) -> None:
        if self.expiry:
            self.accounting.store.settled(self, delivery)

    # --- acknowledgements of the client --------------------------------------------------------

    def puback(self, packet_id: int) -> bool:
        """Process PUBACK, and send what it makes room for; False when no message with that id is in
        flight.

        Raises:
            ProtocolError: the message with that id does not wait for a PUBACK.
        """
        is_known = self.acknowledged(packet_id)
        if is_known:
            self.fill_window()
        return is_known

    def acknowledged(self, packet_id: int) -> bool:
        """The part of `puback` that makes room; `fill_window` has to follow."""
        delivery = self.inflight.get(packet_id)
        if delivery is None or delivery[1] != 1:
            if packet_id in self.inflight:
                raise _wrong("PUBACK", packet_id)
            return False
        del self.inflight[packet_id]
        if self.resends and packet_id in self.resends:
            self.resends.remove(packet_id)
        size = delivery[0].size
        self.bytes -= size
        self.account.bytes -= size
        self.accounting.queued_bytes -= size
        if self.expiry:
            self.accounting.store.settled(self, delivery)
        if self.congestion is not None:
            self.congestion.acknowledged(packet_id, size)
        return True

    def fill_window(self) -> None:
        """Send what acknowledgements have made room for."""
        if self.queue or self.replays or self.resends or self.congestion is not None:
            self.pump()

    def pubrec(self, packet_id: int, code: int) -> bool:
        """Process PUBREC, which may refuse the message; False when no message has that id.

        Raises:
            ProtocolError: the message with that id has QoS 1.
        """
        if packet_id not in self.inflight:
            return False
        delivery = self.inflight[packet_id]
        if delivery is not None and delivery[1] != 2:
            raise _wrong("PUBREC", packet_id)
        if packet_id in self.resends:
            self.resends.remove(packet_id)
        if code >= 0x80:
            self.give_up(packet_id)
            self.pump()
        elif delivery is None:
            pass  # a repeated PUBREC: PUBREL is sent again
        else:
            self.inflight[packet_id] = None
            self._uncount(delivery[0])
            if self.congestion is not None:
                self.congestion.acknowledged(packet_id, delivery[0].size)
                self.congestion.sent(packet_id)  # the PUBREL
                self._relieve(self.congestion)
            if self.expiry:
                self._depend_on_batch()
                self.accounting.store.recorded(self, delivery, packet_id)
        return True

    def pubcomp(self, packet_id: int) -> bool:
        """Process PUBCOMP; False when no message with that id is in flight.

        Raises:
            ProtocolError: the message with that id does not wait for a PUBCOMP.
        """
        if packet_id not in self.inflight:
            return False
        if self.inflight[packet_id] is not None:
            raise _wrong("PUBCOMP", packet_id)
        del self.inflight[packet_id]
        if self.congestion is not None:
            self.congestion.settled(packet_id)
        if self.expiry:
            self.accounting.store.completed(self, packet_id)
        if self.queue or self.replays or self.resends:
            self.pump()
        return True

    def give_up(self, packet_id: int) -> None:
        """Remove a message from those in flight that cannot be sent [MQTT-3.1.2-25]."""
        delivery = self.inflight.pop(packet_id, None)
        if self.congestion is not None:
            self.congestion.settled(packet_id)
        if delivery is not None:
            self._uncount(delivery[0])
            self._settled(delivery)

    # --- QoS 2 from the client -----------------------------------------------------------------

    def hold(self, packet_id: int, held: UnreleasedPublish) -> bool:
        """Hold a QoS 2 message from the client until PUBREL; False when there is no room."""
        if not self.fits(held_size(held)):
            return False
        held.message.settle()
        self.received[packet_id] = held
        self.take(held_size(held))
        if self.expiry:
            self.accounting.store.held(self, packet_id, held)
        return True

    def reconnected(self) -> None:
        """Forget when held messages arrived: the clock of the last connection is gone."""
        for packet_id, held in self.received.items():
            self.received[packet_id] = held._replace(since=-math.inf)

    def unhold(self, packet_id: int) -> UnreleasedPublish | None:
        """Remove and return the held message with that id, if there is one."""
        held = self.received.pop(packet_id, None)
        if held is not None:
            self.take(-held_size(held))
            if self.expiry:
                self.accounting.store.unheld(self, packet_id)
        return held

    # --- subscriptions and the will ------------------------------------------------------------

    def subscribe(self, subscription: Subscription) -> None:
        """Add and count a subscription; it replaces one with the same filter."""
        if subscription.filter not in self.subscriptions:
            self.take(subscription_size(subscription.filter))
        self.subscriptions[subscription.filter] = subscription
        is_of_qos_0 = subscription.filter in self.replays_of_qos_0
        if subscription.filter in self.replays and is_of_qos_0 is (subscription.qos > 0):
            self.replays_of_qos_0 = {  # it goes on with the new QoS, in its place
                name: replay
                for name, replay in self.replays.items()
                if not self.subscriptions[name].qos
            }
        limit = self.rate_limits.get(subscription.filter)
        if (limit.rate if limit is not None else 0.0) == subscription.max_rate:
            return
        if limit is not None:  # [MQTT-3.8.4-3]: no message is lost because of the replacement
            del self.rate_limits[subscription.filter]
            limit.end(sends=True)
        if subscription.max_rate:
            self.rate_limits[subscription.filter] = RateLimit(
                self, subscription.max_rate, self.accounting, self.accounting.rates
            )

    def unsubscribe(self, topic_filter: str) -> bool:
        """Remove a subscription; False when there is none."""
        if self.subscriptions.pop(topic_filter, None) is None:
            return False
        self._end_replay(topic_filter)
        limit = self.rate_limits.pop(topic_filter, None)
        if limit is not None:
            limit.end()
        self.take(-subscription_size(topic_filter))
        return True

    def set_will(self, will: PendingWill | None) -> PendingWill | None:
        """Set or remove the will; returns the previous one."""
        before, self.will = self.will, will
        self.take((will.message.size if will else 0) - (before.message.size if before else 0))
        return before

    def fits(self, size: int) -> bool:
        """Whether the session may take `size` more bytes."""
        accounting = self.accounting
        held = self.bytes + size
        return held <= accounting.queue_bytes and (
            accounting.fits(self.account, size)
            or (
                self.link is not None
                and held <= accounting.reserve
                and accounting.is_reserved(self.account, size)
            )
        )

    def shortage(self, size: int) -> str:
        """Why the session has no room for `size` more bytes, with the configuration key.

        The text names neither the client nor its user, because publishers may receive it.
        """
        accounting = self.accounting
        limits = accounting.limits
        if self.waiting >= limits.queue_messages:
            return f"{self.waiting} messages wait already (broker.limits.queue_messages)"
        if self.bytes + size > accounting.queue_bytes:
            return f"{self.bytes} bytes wait already (broker.limits.queue_bytes)"
        if not self.fits(size):
            return accounting.memory_shortage(size)
        if self.expiry and not accounting.may_store(self.account, size):
            return accounting.store_shortage(size)
        return "others wait for the room there is"

    # --- backpressure --------------------------------------------------------------------------

    def is_full(self, size: int) -> bool:
        """Whether the queue has no room for a QoS 1 or 2 message of this size.

        Room that other publishers already wait for does not count.
        """
        accounting = self.accounting
        if self.congestion is not None and self.congestion.awaited:
            return True
        if self.waiting >= accounting.queue_messages:
            return True
        if (
            self.bytes + size <= accounting.half_queue
            and accounting.queued_bytes + size <= accounting.unrestricted_memory
        ):
            return False
        return not self.fits(size)

    def _is_crowded(self) -> bool:
        """Whether the queue is more than half full."""
        accounting = self.accounting
        return 2 * self.waiting > accounting.queue_messages or self.bytes > accounting.half_queue

    def _fits_tightly(self, size: int) -> bool:
        """`fits`, for a message that makes the session use more than half of its limit."""
        if self.congestion is None and self.bytes + size > self.accounting.half_queue:
            self._congest()
        return self.fits(size)

    def _congest(self) -> None:
        if self.link is not None and not self.is_inside:
            self.congestion = Congestion(self, self.accounting)

    def _relieve(self, congestion: Congestion) -> None:
        """Wake publishers when half of the queue is free; end the congestion when it is empty."""
        if self._is_crowded():
            return
        congestion.wake()
        if not self.queue and self.gap is None:
            congestion.end()
            self.congestion = None

    def take(self, size: int) -> None:
        """Count `size` more bytes of memory; negative: fewer."""
        self.bytes += size
        self.account.bytes += size
        self.accounting.queued_bytes += size

    def may_know(self, size: int) -> bool:
        """Whether a rate of the session may know one more topic, of `size` bytes."""
        accounting, account = self.accounting, self.account
        return (
            self.topic_bytes + size <= accounting.session_topics
            and account.topic_bytes + size <= accounting.user_topics
            and accounting.fits(account, size)
        )

    def know(self, size: int) -> None:
        """Count `size` more bytes of known topics; negative: fewer."""
        self.topic_bytes += size
        self.account.topic_bytes += size
        self.account.bytes += size
        self.accounting.queued_bytes += size

    def hand_over(
        self, shares: Collection[Group] | None, give: Callable[[Delivery], bool], *, sent: bool
    ) -> None:
        """Pass messages of these shared subscriptions (None: of all) on to other members.

        A message stays here if `give` returns False. With `sent`, QoS 1 messages in flight are
        passed on, too: the other member may get a duplicate. QoS 2 messages stay [MQTT-4.8.2-4],
        [MQTT-4.8.2-5].
        """
        gap = self.gap
        if gap is not None and (
            gap.unread.is_shared or any(delivery[4] is not None for delivery in gap.newer)
        ):
            self.read_all()

        def is_given(delivery: Delivery) -> bool:
            share = delivery[4]
            return share is not None and (shares is None or share in shares) and give(delivery)

        waiting = len(self.queue) + len(self.inflight)
        self.accounting.counters.cost += waiting // PASSED_PER_COST_UNIT
        if sent:
            for packet_id, delivery in list(self.inflight.items()):
                if delivery is not None and delivery[1] == 1 and is_given(delivery):
                    self.give_up(packet_id)
        remaining: deque[Delivery] = deque()
        given = 0
        for delivery in self.queue:
            if is_given(delivery):
                given += delivery[0].size
                self._uncount(delivery[0])
                self._settled(delivery)
            else:
                remaining.append(delivery)
        self.queue = remaining
        self.queue_bytes -= given
        if self.congestion is not None:
            self._relieve(self.congestion)

    # --- the session's end ---------------------------------------------------------------------

    def forget_transient(self) -> None:
        """Drop the state that ends with the connection: QoS 0 messages, and caches of topics.

        Publishers no longer wait for the client.
        """
        if self.congestion is not None:
            self.congestion.end()
        for waiting in (self.latest, self.large):
            for delivery in waiting.values():
                self._uncount(delivery[0])
            waiting.clear()
        for limit in self.rate_limits.values():
            limit.end()
        for topic_filter in list(self.replays_of_qos_0):
            self._end_replay(topic_filter)
        self.routes.clear()
        self.readable.clear()

    def clear(self) -> None:
        """Free everything that this session holds."""
        if self.congestion is not None:
            self.congestion.end()
            self.congestion = None
        for limit in self.rate_limits.values():
            limit.end()
        self.rate_limits.clear()  # they refer to this session: avoid a reference cycle
        self.take(-self.bytes)
        self.know(-self.topic_bytes)
        self.will = None
        self.subscriptions.clear()
        for waiting in (self.queue, self.latest, self.large, self.inflight, self.received):
            waiting.clear()
        self.queue_bytes = 0
        self.gap = None
        self.resends.clear()
        self.replays.clear()
        self.replays_of_qos_0.clear()
        self.routes.clear()  # their targets may refer to this session: avoid a reference cycle

    def close_link(self, reason: ReasonCode, message: str) -> None:
        """End the session's connection, if it has one."""
        if self.link is not None:
            self.link.close(reason, message)


def publisher_of(message: Message) -> Session | None:
    """The session that publishes the message; None when the message is not being delivered."""
    publisher = message.publisher
    assert publisher is None or isinstance(publisher, Session)
    return publisher
