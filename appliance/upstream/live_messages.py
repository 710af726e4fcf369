"""What waits for a link beside the journals: latest messages of topics, and what is forgotten with
the connection.

Most of it is in memory: latest ones `LATEST_SIZE`, and with those that are forgotten when the
connection ends, `LIVE_SIZE`, each for the link as a whole. A latest one that has no room there is
only on disk, by itself, and its topic is in memory, `TOPICS_SIZE`.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Final

from appliance.broker.backlogs import LatestRecords, RecordsLostError, SingleRecords
from appliance.upstream.backlog_counts import DropReason, Tally, too_old
from appliance.upstream.latest_values import LatestValue
from appliance.upstream.rule_queue import (
    AGAIN,
    LATER,
    LATEST_OVERHEAD,
    LOADED_OVERHEAD,
    READ_AGAIN,
    SINGLE_OVERHEAD,
    Entry,
    RuleQueue,
)
from appliance.upstream.rules import BacklogLimits
from appliance.upstream.stored_rows import latest_row, memory_row, single_row
from appliance.upstream.user_shares import UserShares

log = logging.getLogger(__name__)

KIB: Final = 1024
MIB: Final = 1024 * KIB

#: Bytes of memory: of latest messages, and of them and what is forgotten with the connection. What
#: is not `Final` here tests replace, also in the compiled build.
LATEST_SIZE = 3 * MIB
LIVE_SIZE: Final = 7 * MIB // 2

#: Bytes of the topics of which the latest message is only on disk; with more, the oldest are
#: dropped. And of such messages that are read, see `LiveMessages.read`.
TOPICS_SIZE = 32 * MIB
VALUES_SIZE = 256 * KIB
VALUES_AT_ONCE: Final = 32

#: The work of dropping one message that is too old, in units of `Counters.cost`, and the messages
#: that are looked at for one unit more.
DROP_COST: Final = 2
LOOKED_AT_PER_COST_UNIT: Final = 32


class LiveMessages:
    """The messages of all rules of a link that are in `latest` and `live`.

    `discard` drops an entry that a newer message replaces, `wake` is called when one was read.
    """

    def __init__(
        self,
        name: str,
        latest: LatestRecords,
        single: SingleRecords,
        limits: BacklogLimits,
        tally: Tally,
        discard: Callable[[Entry, DropReason], None],
        wake: Callable[[], None],
    ) -> None:
        self._name = name
        self._latest = latest
        self._single = single
        self._age = limits.age
        self._tally = tally
        self._discard = discard
        self._wake = wake
        #: Bytes of memory of all that are in memory.
        self.memory = 0
        #: Of topics whose latest message is only on disk, and the bytes of those that are read.
        self._topics_size = 0
        self._values_size = 0
        #: What the latest messages of each user take: of `size`, of the memory, and of the topics.
        self._shares = UserShares(limits.size)
        self._memory_shares = UserShares(LATEST_SIZE)
        self._topic_shares = UserShares(TOPICS_SIZE)
        #: No latest message expires before.
        self._earliest_end = math.inf
        #: The latest messages that are still to be looked at, whether they are too old then.
        self._outdated: Iterator[tuple[RuleQueue, LatestValue]] | None = None
        self._outdated_at = 0.0

    def use(self, limits: BacklogLimits) -> None:
        """Follow other limits from now on."""
        self._age = limits.age
        self._shares.resize(limits.size)
        self._earliest_end = 0.0

    # --- what is forgotten with the connection --------------------------------------------------

    def fits(self, size: int) -> bool:
        """Whether a message that takes so many bytes of memory has room."""
        return self.memory + size <= LIVE_SIZE

    def put(self, queue: RuleQueue, data: bytes) -> None:
        """It waits behind the others of its rule."""
        self.memory += len(data) + LOADED_OVERHEAD
        queue.live.append(data)

    def pop(self, queue: RuleQueue) -> bytes:
        """Take the rule's first one."""
        data = queue.live.popleft()
        self.memory -= len(data) + LOADED_OVERHEAD
        return data

    def forget(self, queue: RuleQueue) -> None:
        """The connection has ended. All at once, as there may be tens of thousands."""
        count, size = len(queue.live), sum(map(len, queue.live))
        queue.live.clear()
        self.memory -= size + count * LOADED_OVERHEAD
        self._tally.add(queue, -count, -size)
        self._tally.drop(queue, DropReason.OFFLINE, count)

    # --- the latest of a topic --------------------------------------------------------------------

    def has_room(self, queue: RuleQueue, topic: str, size: int, user: str | None) -> bool:
        """Whether there is memory for a user's record of this size as the latest of its topic."""
        value = queue.latest.get(topic)
        before = 0 if value is None or value.single is not None else value.size + LATEST_OVERHEAD
        added = size + LATEST_OVERHEAD
        total = self.memory - before + added
        if before and value is not None and value.user == user:
            added -= before
        return self._memory_shares.allows(user, added, total)

    def has_topic_room(self, topic: str) -> bool:
        """Whether there is memory for one more topic whose latest message is only on disk."""
        return self._topics_size + len(topic) + SINGLE_OVERHEAD <= TOPICS_SIZE

    def offer(
        self,
        queue: RuleQueue,
        value: LatestValue,
        data: bytes,
        *,
        persistent: bool,
        in_memory: bool,
    ) -> None:
        """Keep it as the latest of its topic, in place of an older one."""
        key, single = self._replace(queue, value.topic)
        awaited = value.qos > 0
        if value.qos or not queue.mixed:  # MQTT does not order QoS 0 and others
            value.after = queue.last_stored(value.topic)
        if in_memory:
            value.data = data
            if persistent or key is not None:
                key = self._latest.put(key, latest_row(data), awaited=awaited)
        else:
            value.single = self._single.put(data, awaited=awaited)
            row = single_row(value.single, data)
            key = self._latest.put(key, row, awaited=awaited)
        if single is not None:
            self._single.remove(single)
        value.key = key
        self.keep(queue, value)

    def store(self, queues: Iterable[RuleQueue]) -> None:
        """The link ends: what is in memory alone of the latest messages is stored until the next
        start. That is of QoS 0, and no more than there is memory for."""
        for queue in queues:
            for value in queue.latest:
                if value.key is None and value.data is not None:
                    value.key = self._latest.put(None, memory_row(value.data), awaited=False)

    def _replace(self, queue: RuleQueue, topic: str) -> tuple[int | None, int | None]:
        """A newer message of the topic has come: end the older one; returns the keys of its row and
        of its record, which is not needed any more once the row is the newer one's."""
        value = queue.latest.get(topic)
        if value is not None:
            self._tally.remove(queue, value.size)
            self._free(queue, value)
            self._tally.drop(queue, DropReason.REPLACED)
            return value.key, value.single
        before = queue.newest.get(topic)
        if before is None:
            return None, None
        assert before.value is not None
        key, single = before.key, before.value.single
        before.key = before.value.single = None
        if before.state in (AGAIN, LATER):
            self._discard(before, DropReason.REPLACED)
        return key, single

    def keep(self, queue: RuleQueue, value: LatestValue) -> None:
        """It waits as the latest of its topic; it is where its attributes say."""
        queue.latest.put(value)
        self._earliest_end = min(self._earliest_end, self._end_of(value))
        self._count(value, 1)

    def _count(self, value: LatestValue, count: int) -> None:
        """One more waits, or one less."""
        user = value.user
        self._shares.count(user, count * value.size)
        if value.single is None:
            memory = count * (value.size + LATEST_OVERHEAD)
            self.memory += memory
            self._memory_shares.count(user, memory)
        else:
            memory = count * (len(value.topic) + SINGLE_OVERHEAD)
            self._topics_size += memory
            self._topic_shares.count(user, memory)

    def _free(self, queue: RuleQueue, value: LatestValue) -> None:
        """Its memory is not needed for the value any more."""
        self._count(value, -1)
        if value.single is not None and value.is_read:
            value.is_read = False
            queue.values_read -= 1
            self._values_size -= value.size

    def take(self, queue: RuleQueue, value: LatestValue) -> None:
        """It does not wait any more: it is handed out."""
        queue.latest.pop(value)
        self._free(queue, value)

    def drop(self, queue: RuleQueue, value: LatestValue, reason: DropReason) -> None:
        """It is not sent."""
        self.take(queue, value)
        self._tally.remove(queue, value.size)
        self.remove_rows(value.key, value.single)
        self._tally.drop(queue, reason)

    def drop_of_largest(self, queues: Sequence[RuleQueue], *, topics: bool = False) -> bool:
        """Drop the oldest latest message in these of who has more than a share of the backlog, or
        of the room for topics; False if there is none."""
        shares = self._topic_shares if topics else self._shares
        for user in shares.largest():
            firsts = [
                (value.number, queue, value)
                for queue in queues
                if (value := queue.latest.oldest_of(user)) is not None
            ]
            if firsts:
                _, queue, value = min(firsts, key=lambda each: each[0])
                self.drop(queue, value, DropReason.FULL)
                return True
        return False

    def remove_rows(self, key: int | None, single: int | None) -> None:
        """Remove a value's row, and its record if that is stored by itself."""
        if key is not None:
            self._latest.remove(key)
        if single is not None:
            self._single.remove(single)

    def look_for_outdated(self, queues: Iterable[RuleQueue], now: float) -> None:
        """Begin to look for latest messages that are too old or expired, which `drop_outdated`
        drops; most often there can be none."""
        if self._outdated is None and self._earliest_end <= now:
            self._earliest_end = math.inf
            self._outdated_at = now
            self._outdated = iter([(queue, value) for queue in queues for value in queue.latest])

    @property
    def is_looking(self) -> bool:
        """Whether `drop_outdated` has something to do."""
        return self._outdated is not None

    def drop_outdated(self, most: int) -> int:
        """Look at more of them; returns the work, which is about so much at most."""
        if self._outdated is None:
            return 0
        dropped = work = 0
        for looked_at, (queue, value) in enumerate(self._outdated, 1):
            if queue.latest.get(value.topic) is value:
                reason = too_old(value.stored_at, value.expires_at, self._age, self._outdated_at)
                if reason is not None:
                    self.drop(queue, value, reason)
                    dropped += 1
                else:
                    self._earliest_end = min(self._earliest_end, self._end_of(value))
            work = DROP_COST * dropped + looked_at // LOOKED_AT_PER_COST_UNIT
            if work >= most:
                break
        else:
            self._outdated = None
        return work

    def _end_of(self, value: LatestValue) -> float:
        """When it will be too old."""
        age = self._age
        return value.expires_at if age is None else min(value.expires_at, value.stored_at + age)

    # --- reading ----------------------------------------------------------------------------------

    def read_next(self, queue: RuleQueue, now: float) -> None:
        """Read the next values that are only on disk, if there is memory for them."""
        for place, value in enumerate(queue.latest.ready.values()):
            is_first = not place
            if place == VALUES_AT_ONCE or not self.read(queue, value, now, is_first=is_first):
                break

    def read(
        self, queue: RuleQueue, value: LatestValue, now: float, *, is_first: bool = False
    ) -> bool:
        """Read one, if it is not in memory; False if it cannot be read now.

        The link may have `VALUES_SIZE` bytes, each rule one in any case, and the first of its
        `ready` ones: those behind it would keep the memory until it was sent.
        """
        if value.single is None or value.is_read:
            return True
        if queue.values_failed:
            queue.values_failed = False
            queue.values_at = now + READ_AGAIN
        if queue.values_at > now:
            return False
        is_full = self._values_size + value.size > VALUES_SIZE
        if is_full and queue.values_read and not is_first:
            return False
        value.is_read = True
        queue.values_read += 1
        self._values_size += value.size
        self._single.read(value.single, partial(self._was_read, queue, value))
        return True

    def _was_read(
        self, queue: RuleQueue, value: LatestValue, outcome: list[bytes] | Exception
    ) -> None:
        if queue.latest.get(value.topic) is not value:
            return  # it was dropped meanwhile
        if isinstance(outcome, list) and len(outcome) == 1 and len(outcome[0]) == value.size:
            queue.values_at = 0.0
            value.data = outcome[0]
        elif isinstance(outcome, list | RecordsLostError):
            self.drop(queue, value, DropReason.UNREADABLE)
        else:
            if not queue.values_at:
                log.warning("backlog of %s: cannot be read: %s", self._name, outcome)
            queue.values_failed = True
            value.is_read = False
            queue.values_read -= 1
            self._values_size -= value.size
        self._wake()
