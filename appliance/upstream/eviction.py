"""What a backlog drops: what is too old, and, when it is full, the oldest of the lowest lane."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Final

from appliance.broker.backlogs import Segment
from appliance.upstream.backlog_counts import DropReason, Tally, too_old
from appliance.upstream.live_messages import DROP_COST, LIVE_SIZE, LiveMessages
from appliance.upstream.read_ahead import ReadAhead
from appliance.upstream.records import record_times
from appliance.upstream.rule_queue import Entry, RuleQueue
from appliance.upstream.rule_queues import RuleQueues
from appliance.upstream.rules import PRIORITIES, BacklogLimits

log = logging.getLogger(__name__)

#: The rules that are looked at for one unit of `Counters.cost` more than the work of dropping.
RULES_PER_COST_UNIT: Final = 2

#: The work that is done in one piece, for what is too old and as much for what is displaced. A
#: large message may displace tens of thousands of small ones, and as many may expire at once, while
#: their broker does nothing else: the others are dropped in later turns, and a message waits
#: already. What is not `Final` here tests replace, also in the compiled build.
MOST_AT_ONCE = 1000

#: By this part more than its size may wait meanwhile, and in any case one message.
OWED_SHARE = 1 / 8

#: No message has displaced more than could be dropped.
_NOBODY: Final = len(PRIORITIES)


class Eviction:
    """Makes room in the backlog of a link.

    `discard` drops an entry that waits to be sent again, `emptied` is told of a rule of whose
    journal something was dropped.
    """

    def __init__(
        self,
        name: str,
        queues: RuleQueues,
        limits: BacklogLimits,
        tally: Tally,
        live: LiveMessages,
        read_ahead: ReadAhead,
        discard: Callable[[Entry, DropReason], None],
        emptied: Callable[[RuleQueue], None],
    ) -> None:
        self._name = name
        self._queues = queues
        self._limits = limits
        self._tally = tally
        self._live = live
        self._read_ahead = read_ahead
        self._discard = discard
        self._emptied = emptied
        #: How many had been dropped as full when that was logged last; None since there is room.
        self._full_since: int | None = None
        #: The work of all that was dropped to make room, in units of `Counters.cost`.
        self.work = 0
        #: The most urgent lane of the messages for which more is to be dropped, of all that waits
        #: and of what is forgotten with the connection; and how much of the latter may stay.
        self._owed_to = self._live_owed_to = _NOBODY
        self._live_limit = LIVE_SIZE
        #: The time up to which more is too old than could be dropped so far.
        self._outdated_at: float | None = None

    def use(self, limits: BacklogLimits) -> None:
        """Follow other limits from now on."""
        self._limits = limits

    # --- full -----------------------------------------------------------------------------------

    def make_room(self, lane: int, size: int, now: float, limit: int) -> bool:
        """Drop until a message of the lane has room within the limit of bytes: too old ones, then
        the lowest lane's oldest, in it the latest ones of who has more than a share of these first.

        Whatever is more urgent than the message stays. What takes too long is left to `go_on`.
        """
        if size > limit:
            return False
        is_all = self._drop_outdated(now)
        before = self._tally.bytes
        if before + size <= limit:
            return True
        # What is too old goes first, also in later turns, if the message may wait meanwhile.
        may_wait = not is_all and _may_owe(before, before + size, limit, is_all=False)
        if self._limits.when_full == "refuse":  # nothing else makes room for it
            return may_wait
        self.say_full()
        if not may_wait:
            is_all = self._drop_down_to(max(limit, before) - size, lane)
        after = self._tally.bytes + size
        if after > limit:
            if not _may_owe(before, after, limit, is_all=is_all):
                return False
            self._owed_to = min(self._owed_to, lane)
        return True

    def make_live_room(self, lane: int, memory: int) -> bool:
        """Drop what is forgotten with the connection until so many bytes have room.

        As for `make_room`.
        """
        live = self._live
        if live.fits(memory):
            return True
        self.say_full()
        before = live.memory
        is_all = self._drop_live_down_to(max(LIVE_SIZE, before) - memory, lane)
        after = live.memory + memory
        if live.memory and after > LIVE_SIZE:
            if not _may_owe(before, after, LIVE_SIZE, is_all=is_all):
                return False
            self._live_owed_to = min(self._live_owed_to, lane)
            self._live_limit = max(LIVE_SIZE, memory)
        return True

    @property
    def is_owing(self) -> bool:
        """Whether `go_on` has something to do."""
        return (
            self._owed_to != _NOBODY
            or self._live_owed_to != _NOBODY
            or self._outdated_at is not None
            or self._live.is_looking
        )

    def tick(self, now: float) -> None:
        """Drop what has become too old, a part if that is much; to be called every second or so."""
        self._outdated_at = now
        self._live.look_for_outdated(self._queues.by_name.values(), now)
        self.go_on()

    def go_on(self) -> None:
        """Drop more of what is too old, then of what was displaced by messages that wait already.

        Without anything else in their lanes and below, that is they themselves in the end.
        """
        end = self.work + MOST_AT_ONCE
        if self._outdated_at is not None and not self._drop_outdated(self._outdated_at):
            return
        self.work += self._live.drop_outdated(end - self.work)
        if self.work >= end:
            return
        if self._owed_to != _NOBODY and self._drop_down_to(self._limits.size, self._owed_to):
            self._owed_to = _NOBODY
        if self._live_owed_to != _NOBODY and self._drop_live_down_to(
            self._live_limit, self._live_owed_to
        ):
            self._live_owed_to = _NOBODY

    def _drop_down_to(self, limit: int, lane: int) -> bool:
        """Drop until so many bytes wait, from the lowest lane up to this one; False when there is
        more to be dropped than may be in one piece."""
        end = self.work + MOST_AT_ONCE
        for lowest in range(len(PRIORITIES) - 1, lane - 1, -1):
            queues = self._queues.lanes[lowest]
            while self._tally.bytes > limit:
                if self.work >= end:
                    return False
                self.work += DROP_COST + len(queues) // RULES_PER_COST_UNIT
                if not (self._live.drop_of_largest(queues) or self._drop_oldest(lowest)):
                    break
        return True

    def _drop_live_down_to(self, limit: int, lane: int) -> bool:
        """The same of what is forgotten with the connection, in bytes of memory."""
        end = self.work + MOST_AT_ONCE
        for lowest in range(len(PRIORITIES) - 1, lane - 1, -1):
            queues = self._queues.lanes[lowest]
            while self._live.memory > limit:
                if self.work >= end:
                    return False
                self.work += DROP_COST + len(queues) // RULES_PER_COST_UNIT
                waiting = [queue for queue in queues if queue.live]
                if not waiting:
                    break
                oldest = min(waiting, key=lambda queue: record_times(queue.live[0])[0])
                self._drop_first_live(oldest, DropReason.FULL)
        return True

    def drop_oldest_latest(self, lane: int) -> bool:
        """Drop the oldest latest message of the lowest lane that is not above, first of who has
        more than a share; False if none."""
        self.say_full()
        for lowest in range(len(PRIORITIES) - 1, lane - 1, -1):
            queues = self._queues.lanes[lowest]
            self.work += DROP_COST + len(queues) // RULES_PER_COST_UNIT
            if self._live.drop_of_largest(queues, topics=True):
                return True
            firsts = [
                (value.number, queue, value)
                for queue in queues
                if (value := queue.latest.oldest()) is not None
            ]
            if firsts:
                _, queue, value = min(firsts, key=lambda each: each[0])
                self._live.drop(queue, value, DropReason.FULL)
                return True
        return False

    def say_full(self) -> None:
        """Log that messages are dropped, once until what waits is half as much."""
        if self._full_since is None:
            self._full_since = self._tally.dropped_as_full()
            what = (
                "messages are refused"
                if self._limits.when_full == "refuse"
                else "the oldest messages of the lowest lane are dropped"
            )
            log.warning(
                "the backlog of %s is full (%d messages, %d bytes): %s",
                self._name,
                self._tally.messages,
                self._tally.bytes,
                what,
            )

    def say_room(self) -> None:
        """Log that there is room again, if it was full and what waits is half as much."""
        if self._full_since is not None and 2 * self._tally.bytes < self._limits.size:
            count = self._tally.dropped_as_full() - self._full_since
            self._full_since = None
            log.warning(
                "the backlog of %s has room again; %d messages were dropped or refused",
                self._name,
                count,
            )

    # --- too old --------------------------------------------------------------------------------

    def why(self, data: bytes, now: float) -> DropReason | None:
        """Why an encoded record is not to be sent any more, if so."""
        _, stored_at, expires_at = record_times(data)
        return too_old(stored_at, expires_at, self._limits.age, now)

    def _drop_outdated(self, now: float) -> bool:
        """Drop what is too old or expired, from the front of each rule's journal and of what is
        forgotten with the connection; False when that is more than may be in one piece."""
        end = self.work + MOST_AT_ONCE
        self._outdated_at = now
        for queue in self._queues.by_name.values():
            while (reason := self._why_first(queue, now)) is not None:
                if self.work >= end:
                    return False
                self.work += DROP_COST
                self._drop_first_stored(queue, reason)
            while queue.live and (reason := self.why(queue.live[0], now)):
                if self.work >= end:
                    return False
                self.work += DROP_COST
                self._drop_first_live(queue, reason)
        self._outdated_at = None
        return True

    def _why_first(self, queue: RuleQueue, now: float) -> DropReason | None:
        """Why the first one in the journal is not to be sent any more, if so."""
        queue.skip_gone()
        age = self._limits.age
        if queue.again:
            record = queue.again[0].record
            return too_old(record.stored_at, record.expires_at, age, now)
        if queue.waiting:
            return self.why(queue.waiting[0], now)
        segment = queue.unread() if queue.behind else None
        if segment is None or age is None or segment.last_at + age > now:
            return None
        return DropReason.AGE

    # --- one ------------------------------------------------------------------------------------

    def _drop_oldest(self, lane: int) -> bool:
        """Drop the oldest message of a lane, or the oldest segment on disk; False without any."""
        oldest = math.inf
        found: RuleQueue | None = None
        is_live = False
        for queue in self._queues.lanes[lane]:
            stored = queue.oldest_stored()
            if stored is not None and stored < oldest:
                oldest, found, is_live = stored, queue, False
            live = queue.oldest_live()
            if live is not None and live < oldest:
                oldest, found, is_live = live, queue, True
        if found is None:
            return False
        value = found.latest.oldest() if is_live else None
        if value is not None:
            self._live.drop(found, value, DropReason.FULL)
        elif is_live:
            self._drop_first_live(found, DropReason.FULL)
        else:
            self._drop_first_stored(found, DropReason.FULL)
        return True

    def _drop_first_live(self, queue: RuleQueue, reason: DropReason) -> None:
        """Drop the first one that is forgotten with the connection."""
        data = self._live.pop(queue)
        self._tally.remove(queue, len(data))
        self._tally.drop(queue, reason)

    def _drop_first_stored(self, queue: RuleQueue, reason: DropReason) -> None:
        """Drop what is the first of `again`, of `waiting` or of what is not read."""
        queue.skip_gone()
        if queue.again:
            self._discard(queue.again.popleft(), reason)
        elif queue.waiting:
            data, part, index = self._read_ahead.pop(queue)
            self._tally.remove(queue, len(data))
            self._tally.drop(queue, reason)
            queue.settle(part, index)
            self._emptied(queue)
        else:
            self.drop_unread(queue, queue.unread(), reason)

    def drop_unread(self, queue: RuleQueue, segment: Segment | None, reason: DropReason) -> None:
        """Drop what of a segment is not in memory, see `RuleQueue.drop_unread`."""
        count, size = queue.drop_unread(segment)
        self._tally.add(queue, -count, -size)
        self._tally.drop(queue, reason, count)
        self._emptied(queue)


def _may_owe(before: int, after: int, limit: int, *, is_all: bool) -> bool:
    """Whether a message may wait although more than the limit do with it, as others will be
    dropped; `is_all` says that there are none."""
    return after <= before or (
        not is_all and (before <= limit or after <= limit * (1 + OWED_SHARE))
    )
