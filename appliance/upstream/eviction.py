"""What a backlog drops: what is too old, and, when it is full, the oldest of the lowest lane."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

from appliance.broker.backlogs import Segment
from appliance.upstream.backlog_counts import DropReason, Tally, too_old
from appliance.upstream.live_messages import LiveMessages
from appliance.upstream.read_ahead import ReadAhead
from appliance.upstream.records import record_times
from appliance.upstream.rule_queue import Entry, RuleQueue
from appliance.upstream.rule_queues import RuleQueues
from appliance.upstream.rules import PRIORITIES, BacklogLimits

log = logging.getLogger(__name__)


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

    def use(self, limits: BacklogLimits) -> None:
        """Follow other limits from now on."""
        self._limits = limits

    # --- full -----------------------------------------------------------------------------------

    def make_room(self, lane: int, size: int, now: float) -> bool:
        """Drop until a message of the lane has room: too old ones, then the lowest lane's oldest,
        in it the latest ones of who has more than a share of these first.

        Whatever is more urgent than the message stays.
        """
        limit = self._limits.size - size
        if limit < 0:
            return False
        self.drop_outdated(now)
        if self._tally.bytes <= limit:
            return True
        if self._limits.when_full == "refuse":
            return False
        self.say_full()
        for lowest in range(len(PRIORITIES) - 1, lane - 1, -1):
            queues = self._queues.lanes[lowest]
            while self._tally.bytes > limit and (
                self._live.drop_of_largest(queues) or self._drop_oldest(lowest)
            ):
                pass
        return self._tally.bytes <= limit

    def make_live_room(self, lane: int, memory: int) -> bool:
        """Drop what is forgotten with the connection until so many bytes have room.

        As for `make_room`.
        """
        if self._live.fits(memory):
            return True
        self.say_full()
        for lowest in range(len(PRIORITIES) - 1, lane - 1, -1):
            while not self._live.fits(memory):
                waiting = [queue for queue in self._queues.lanes[lowest] if queue.live]
                if not waiting:
                    break
                oldest = min(waiting, key=lambda queue: record_times(queue.live[0])[0])
                self.drop_first_live(oldest, DropReason.FULL)
        return not self._live.memory or self._live.fits(memory)

    def drop_oldest_latest(self, lane: int) -> bool:
        """Drop the oldest latest message of the lowest lane that is not above, first of who has
        more than a share; False if none."""
        self.say_full()
        for lowest in range(len(PRIORITIES) - 1, lane - 1, -1):
            queues = self._queues.lanes[lowest]
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

    def drop_outdated(self, now: float) -> None:
        """Drop what is too old or expired, from the front of each rule's journal and of what is
        forgotten with the connection."""
        for queue in self._queues.by_name.values():
            while (reason := self._why_first(queue, now)) is not None:
                self._drop_first_stored(queue, reason)
            while queue.live and (reason := self.why(queue.live[0], now)):
                self.drop_first_live(queue, reason)

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
            self.drop_first_live(found, DropReason.FULL)
        else:
            self._drop_first_stored(found, DropReason.FULL)
        return True

    def drop_first_live(self, queue: RuleQueue, reason: DropReason) -> None:
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
