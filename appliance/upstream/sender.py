"""Sends what waits in a backlog, and sets aside what the fleet's broker will never take."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from typing import Final

from appliance.broker.rate_limited_log import RateLimitedLog
from appliance.host.clock import RELEASED
from appliance.mqtt.codec import NO_PROPERTIES, V5, quote
from appliance.mqtt.reason import ReasonCode
from appliance.upstream.agreement import EndedBy, Ending
from appliance.upstream.backlog import Backlog
from appliance.upstream.backlog_counts import DropReason
from appliance.upstream.limits import FleetLimits
from appliance.upstream.link import FleetConnection
from appliance.upstream.publish_properties import PublishProperties
from appliance.upstream.refusals import message_advice, reason_words
from appliance.upstream.rule_queue import Entry
from appliance.upstream.rules import UpstreamSettings
from appliance.upstream.transport import WRITE_PORTION

log = logging.getLogger(__name__)

#: The wall clock below which it was not set.
_RELEASED: Final = RELEASED.timestamp()

#: Messages that are sent in one turn of the event loop: a millisecond of work, as machine code a
#: third of it. Then others have theirs.
SENT_PER_TURN: Final = 128

#: Bytes of a PUBLISH beside its topic, properties and payload, at most.
HEADER_SIZE: Final = 9

#: Reason codes with which the broker says that it will never take a message.
POISON: Final = frozenset(
    (
        ReasonCode.NOT_AUTHORIZED,
        ReasonCode.TOPIC_NAME_INVALID,
        ReasonCode.PACKET_TOO_LARGE,
        ReasonCode.PAYLOAD_FORMAT_INVALID,
    )
)

#: Reason codes of DISCONNECT that may be about a message.
CLOSES_ON_MESSAGE: Final = POISON | {
    ReasonCode.UNSPECIFIED_ERROR,
    ReasonCode.MALFORMED_PACKET,
    ReasonCode.PROTOCOL_ERROR,
    ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR,
    ReasonCode.RECEIVE_MAXIMUM_EXCEEDED,
    ReasonCode.RETAIN_NOT_SUPPORTED,
    ReasonCode.QOS_NOT_SUPPORTED,
}

#: Messages beside the suspects after which the rest of these is forgotten; and those after which
#: none with QoS 0 is suspected any more.
PATIENCE: Final = 1000
PATIENCE_UNANSWERED: Final = 200

#: A message is set aside when the broker has closed the connection so often on it, sent alone.
#: Messages are sent alone after so many connections that ended without any progress.
CLOSED_ON: Final = 3
WITHOUT_PROGRESS: Final = 2

#: A message that the broker has refused so often, not for want of room, is set aside: that takes
#: ten minutes.
MOST_REFUSED: Final = 15

#: What stands for messages with QoS 0 among the suspects: no topic is empty. Connections that end
#: without any other message count together when they do so within these seconds.
UNANSWERED: Final = ""
STUCK_WITHIN: Final = 600.0

#: Seconds for which nothing is sent to a topic upon which the broker closes, where messages take
#: each other's place; then it is tried again. And the most such topics.
FORBIDDEN_FOR: Final = 3600.0
MOST_FORBIDDEN: Final = 1000

#: Topics of which it is known whether they can be sent; with more, all are forgotten. Longer ones,
#: in bytes of UTF-8, are looked at each time.
KNOWN_TOPICS: Final = 1024
LONGEST_KNOWN: Final = 256


class Sender:
    """Hands messages of a backlog to connections, one after the other.

    `clock` is that of the backlog's journals.
    """

    def __init__(
        self,
        settings: UpstreamSettings,
        backlog: Backlog,
        clock: Callable[[], float],
        limits: FleetLimits,
    ) -> None:
        self._settings = settings
        self._backlog = backlog
        self._clock = clock
        #: Of the kind of broker, and of the present connection.
        self._of_kind = limits
        self._use(limits)
        #: The oldest message in flight when the last connection ended, see `_mark`, and of how many
        #: in a row that was so.
        self._stuck_on: int | str = -1
        self._stuck = 0
        #: Of messages with QoS 0: whether some were sent since the last acknowledgement, and when
        #: connections began to end with none but these on their way.
        self._has_sent_unanswered = False
        self._stuck_since = -math.inf
        #: Topics upon which the broker has closed so often that what waits for them is dropped, up
        #: to a time.
        self._forbidden: dict[str, float] = {}
        #: Messages on one of which the broker may have closed, with how often it has when the
        #: message was sent alone. While there are any, one message is sent at a time, and none with
        #: QoS 0: the one that is in flight would be blamed for it.
        self._suspects: dict[int | str, int] = {}
        #: Messages to be acknowledged until the rest of the suspects, which were dropped, is
        #: forgotten.
        self._patience = 0
        self._properties = PublishProperties()
        #: By topic: its bytes, and why it cannot be used there. Most messages are for a topic that
        #: was looked at before.
        self._topics: dict[str, tuple[int, str]] = {}
        self._log = RateLimitedLog()

    def tick(self) -> None:
        """Log how many messages were set aside and not told; to be called every second or so."""
        self._log.tick(self._clock())

    def begin(self, limits: FleetLimits) -> None:
        """A connection is up, with these limits."""
        self._use(limits)
        self._topics.clear()
        self._has_sent_unanswered = False
        self._backlog.connected(limits.packet_size)

    def _use(self, limits: FleetLimits) -> None:
        self._limits = limits
        # What each message is compared with.
        self._packet_size = limits.packet_size
        self._qos, self._may_retain = limits.qos, limits.retain

    def send(self, connection: FleetConnection[Entry | None]) -> bool:
        """Hand messages to the connection; True if there may be more for another turn."""
        now = self._clock()
        wall = time.time()
        # A date from a clock that was not set is worse than none.
        offset = None if wall < _RELEASED else wall - now
        is_v5 = connection.settings.version == V5
        left = SENT_PER_TURN
        while left > 0:
            room, size = connection.room, WRITE_PORTION - connection.waiting
            if not room or (self._suspects and connection.inflight):
                return False
            if size <= 0:
                return True
            entries = self._backlog.take(now, 1 if self._suspects else min(left, room), size)
            if not entries:
                return False
            left -= len(entries)
            for place, entry in enumerate(entries):
                try:
                    self._publish(connection, entry, offset, is_v5)
                except BaseException:
                    self._backlog.put_back(entries[place + 1 :])
                    raise
        return connection.room > 0

    def due(self) -> float | None:
        """Seconds until there may be something to send; None if that is unknown."""
        now = self._clock()
        due = self._backlog.due(now)
        return None if due is None else max(0.0, due - now)

    def _publish(
        self,
        connection: FleetConnection[Entry | None],
        entry: Entry,
        offset: float | None,
        is_v5: bool,
    ) -> None:
        """Hand one to the connection; the wall clock is ahead of the backlog's by `offset`: None
        where it is not set."""
        record = entry.record
        topic, payload = record.topic, record.payload
        if self._forbidden and self._is_forbidden(entry):
            self._backlog.drop(entry, DropReason.CLOSED_UPON)
            return
        properties = NO_PROPERTIES
        if is_v5:
            properties = record.properties_wire
            at, number = entry.published_at, record.number if record.qos == 2 else None
            if at is not None:
                at = None if offset is None else at + offset
            if at is not None or number is not None or entry.expiry is not None:
                properties = self._properties.encode(properties, entry.expiry, number, at)
        topic_size, why = self._topics.get(topic) or self._look_at(topic)
        size = HEADER_SIZE + topic_size + len(properties) + len(payload)
        if why or size > self._packet_size:
            why = self._limits.unsendable(topic, size)
            # The kind of broker never takes it; or this connection, and perhaps a later one does.
            is_for_now = not self._of_kind.unsendable(topic, size)
            # With a limit below its payload it need not be tried again: each try writes it anew.
            too_small = max(self._packet_size, len(payload))
            if is_for_now and self._backlog.hold(entry, too_small, self._clock()):
                return
            self._set_aside(entry, f"the fleet's broker does not take it: {why}")
            return
        qos = min(1 if self._suspects else entry.qos, self._qos)
        retain = record.retain and self._may_retain
        code = connection.publish(entry, topic, payload, qos, retain, properties)
        if code:
            self._set_aside(entry, f"the fleet's broker does not take it: {reason_words(code)}")
        elif not qos:
            self._has_sent_unanswered = True
            self._backlog.settle(entry)

    def _is_forbidden(self, entry: Entry) -> bool:
        """Whether the broker would close the connection upon it, most likely."""
        until = self._forbidden.get(entry.record.topic)
        if until is None or _mark(entry) != entry.record.topic:
            return False
        if self._clock() < until:
            return True
        del self._forbidden[entry.record.topic]
        return False

    def _look_at(self, topic: str) -> tuple[int, str]:
        """The bytes of a topic, and why it cannot be used there."""
        found = len(topic.encode()), self._limits.unusable(topic)
        if found[0] <= LONGEST_KNOWN:
            if len(self._topics) >= KNOWN_TOPICS:
                self._topics.clear()
            self._topics[topic] = found
        return found

    def acknowledged(self, entries: Sequence[Entry | None], code: int, reason: str) -> None:
        """Messages were acknowledged, or refused with a code of 0x80 or above."""
        ours = [entry for entry in entries if entry is not None]
        self._has_sent_unanswered = False
        if self._stuck and any(_mark(entry) == self._stuck_on for entry in ours):
            self._stuck_on, self._stuck = -1, 0
        if self._suspects:
            for entry in ours:
                self._clear(entry)
        if code < 0x80:
            self._backlog.settle_all(ours)
            return
        for entry in ours:
            if code in POISON:
                text = f"the fleet's broker refuses it: {reason_words(code)}"
                text = f"{text}, {quote(reason)}" if reason else text
                advice = message_advice(code, self._settings, entry.record.topic)
                self._set_aside(entry, f"{text}: {advice}" if advice else text)
                continue
            if code != ReasonCode.QUOTA_EXCEEDED:
                entry.refused += 1
            if entry.refused >= MOST_REFUSED:
                text = f"the fleet's broker has refused it {entry.refused} times, the last time: "
                self._set_aside(entry, text + reason_words(code))
            else:
                self._backlog.retry_later(entry, self._clock())

    def _clear(self, entry: Entry) -> None:
        """The broker has answered: it does not close the connection on this message."""
        self._suspects.pop(_mark(entry), None)
        self._patience -= 1
        if self._patience <= 0:
            self._suspects.clear()
            self._stuck_on, self._stuck = -1, 0

    def end(self, ending: Ending, inflight: Sequence[Entry | None], *, was_settled: bool) -> bool:
        """The connection has ended with these messages in flight: they are sent again.

        It `was_settled` if the broker had answered all else that it was sent at the beginning.
        Returns whether one of them may be the reason: it is not the first connection to end on it.
        """
        ours = [entry for entry in inflight if entry is not None]
        is_upon = bool(ours) or self._has_sent_unanswered
        if is_upon and was_settled and _may_be_poison(ending):
            if ours:
                self._suspect(ours, ending)
            else:
                self._suspect_unanswered()
        self._backlog.rewind()
        return is_upon and (bool(self._suspects) or self._stuck >= WITHOUT_PROGRESS)

    def _suspect_unanswered(self) -> None:
        """The broker has closed the connection with none in flight, perhaps because of a message
        with QoS 0: from now on such messages are sent with QoS 1, so that the one is found."""
        now = self._clock()
        if self._stuck_on != UNANSWERED or now > self._stuck_since + STUCK_WITHIN:
            self._stuck_on, self._stuck, self._stuck_since = UNANSWERED, 0, now
        self._stuck += 1
        if self._stuck >= WITHOUT_PROGRESS and not self._suspects:
            self._suspects = {UNANSWERED: 0}
            self._patience = PATIENCE_UNANSWERED

    def _suspect(self, inflight: list[Entry], ending: Ending) -> None:
        """The broker has closed the connection: perhaps because of one of these messages."""
        first = inflight[0]
        mark = _mark(first)
        if self._suspects:
            closed = self._suspects[mark] = self._suspects.get(mark, 0) + 1
            if closed >= CLOSED_ON:
                del self._suspects[mark]
                self._suspects.pop(UNANSWERED, None)
                if isinstance(mark, str):
                    self._forbid(mark)
                self._set_aside(
                    first,
                    f"the connection has ended {CLOSED_ON} times when the fleet's broker was sent "
                    f"this message alone; the last time: {ending.text}",
                )
            return
        self._stuck = self._stuck + 1 if self._stuck_on == mark else 1
        self._stuck_on = mark
        if self._stuck >= WITHOUT_PROGRESS:
            self._suspects = {_mark(entry): 0 for entry in inflight}
            self._patience = len(inflight) + PATIENCE

    def _forbid(self, topic: str) -> None:
        """Send nothing for a topic for a while, of which only the newest message counts."""
        while len(self._forbidden) >= MOST_FORBIDDEN:
            del self._forbidden[next(iter(self._forbidden))]
        self._forbidden[topic] = self._clock() + FORBIDDEN_FOR

    def _set_aside(self, entry: Entry, reason: str) -> None:
        now = self._clock()
        self._log.warning(
            log,
            now,
            entry.record.rule,
            "upstream '%s': a message for %s is set aside: %s",
            self._settings.name,
            quote(entry.record.topic),
            reason,
        )
        self._backlog.set_aside(entry, reason, now)


def _mark(entry: Entry) -> int | str:
    """By what a message is known on the next connection: its number, or its topic where a newer one
    takes its place."""
    is_itself = entry.part is not None or (entry.key is not None and entry.topic is None)
    return entry.record.number if is_itself else entry.record.topic


def _may_be_poison(ending: Ending) -> bool:
    """Whether the connection may have ended because of a message that the broker was sent."""
    if ending.is_silent:
        return False
    if ending.by is EndedBy.US:
        return ending.is_violation  # it has answered nonsense
    return ending.by is EndedBy.NETWORK or ending.code in CLOSES_ON_MESSAGE
