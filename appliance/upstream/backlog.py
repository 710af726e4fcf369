"""What waits for one link: it is accepted here, handed out in order, and kept until settled.

Pure: time is an argument, in seconds of the journals' clock (`Journal.now`), and what is stored
goes through `broker/backlogs.py`. Each rule has a `RuleQueue`; this module decides which
of them is next, what is dropped when the backlog is full, and what is in memory:

- messages that were handed out, at most `IN_FLIGHT_SIZE` bytes;
- the next ones of each journal, `LOADED_SIZE` for all rules; the others are on disk alone;
- the latest ones of topics, `LATEST_SIZE`, and with those that are forgotten when the connection
  ends, `LIVE_SIZE`, each for the link as a whole. A latest one that has no room there is only on
  disk, by itself, and its topic is in memory, `TOPICS_SIZE`.

A single message may exceed each of these, as it could not be sent otherwise. Of the rules whose
messages are refused for now (0x97), each but the first may have twice `IN_FLIGHT_RESERVE` more.

Of a rule, messages of which all count are in its journal, and nothing else is. What counts as the
latest one of its topic is in its `LatestValues`, and replaced there. So this holds, over any
sequence of offers, hand-outs, rewinds, acknowledgements and restarts:

- Many messages of a `latest` topic take the room of one. An acknowledged message of which all count
  is dropped only as `size` and `age` say: too old, then the lowest lane, in it the oldest.
- Of the latest messages of a topic, the last that is sent is the newest: at most one waits or was
  put back, and whatever else of the topic was handed out ends with the connection.
- Of a topic that has both, QoS 1 and above keep their order. A latest one is `blocked` while older
  records wait in the journal, and goes before the first newer record of its topic there.

What is larger than the fleet's broker takes on this connection moves to a queue of its own, `HELD`,
of at most `MOST_HELD` messages and `HELD_SHARE` of the size. They are handed out once on each
connection that takes more than that on which the least of them was too large.

Each message that was offered is in the end sent, dropped for a reason, or set aside:
`offered + restored = sent + dropped + set aside + waiting`, see `BacklogCounts`.
"""

from __future__ import annotations

import heapq
import json
import logging
import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from struct import Struct
from typing import Final

from appliance.broker.backlogs import NO_MESSAGE, Backlogs, RecordsLostError, Segment
from appliance.broker.rate_limited_log import RateLimitedLog
from appliance.upstream.latest_values import LatestValue
from appliance.upstream.rates import TokenBucket
from appliance.upstream.records import Record, encode_record, record_head, record_times
from appliance.upstream.rule_queue import (
    AGAIN,
    ENTRY_OVERHEAD,
    GONE,
    IN_FLIGHT,
    LATER,
    LATEST_OVERHEAD,
    LOADED_OVERHEAD,
    SINGLE_OVERHEAD,
    Entry,
    HeldSegment,
    RuleQueue,
    size_left,
)
from appliance.upstream.rules import PRIORITIES, BacklogLimits, OutRule, Priority
from appliance.upstream.set_aside import AsideRecords, SetAside

log = logging.getLogger(__name__)

KIB: Final = 1024
MIB: Final = 1024 * KIB

#: Bytes of memory: of messages in flight, of records that were read, of those that are in memory
#: for other reasons. With what a higher lane gets in addition it is 8 MiB a link.
IN_FLIGHT_SIZE: Final = 3 * MIB
LOADED_SIZE: Final = 5 * MIB // 4
LATEST_SIZE: Final = 3 * MIB
LIVE_SIZE: Final = 7 * MIB // 2

#: Bytes of the topics of which the latest message is only on disk; with more, the oldest are
#: dropped. And of such messages that are read, of which each rule may have one in any case.
TOPICS_SIZE: Final = 32 * MIB
VALUES_SIZE: Final = 256 * KIB
VALUES_AT_ONCE: Final = 32

#: Bytes that may be in flight in addition while messages wait to be sent again: otherwise one in a
#: higher lane would wait for all of them. However many wait to be tried again, each rule of which
#: none does may have as many.
IN_FLIGHT_RESERVE: Final = 256 * KIB

#: Bytes of read records that a rule has at least, however many rules there are.
LOADED_SHARE: Final = 32 * KIB

#: Bytes that may wait to be written for all links, by lane: with more, no message of QoS 0 is
#: stored. What is acknowledged is bounded by the backlog's size.
UNWRITTEN_SIZE: Final = (16 * MIB, 12 * MIB, 8 * MIB)

#: After so many messages of other lanes it is a lane's turn. Both lower lanes may have waited, so
#: that each gets one in 16.
TURN: Final = 14

#: Messages of a rule that wait to be tried again (0x97); with more, no other of that rule is sent
#: until one is due. Other rules go on: the fleet's broker may refuse one user's topics only.
MOST_LATER: Final = 100

#: Seconds until a message is tried again; doubled each time up to the second value.
FIRST_RETRY: Final = 1.0
LONGEST_RETRY: Final = 60.0

#: Seconds after which a message says when it was published.
DELAYED: Final = 1.0

#: Seconds until a segment is read again that could not be read.
READ_AGAIN: Final = 1.0

#: Expired messages that one call of `next` drops: some milliseconds.
MOST_DROPPED: Final = 1000

#: The largest Message Expiry Interval, in seconds.
_LONGEST_EXPIRY: Final = 0xFFFF_FFFF

#: The name of the queue of messages that are too large for now; no filter has such a character.
HELD: Final = "\0too large"

# The first byte of rows in the table of latest records.
_LATEST: Final = b"L"
_LATER: Final = b"R"
_NUMBERS: Final = NO_MESSAGE
#: The key and the size of a record that is stored by itself, and its head.
_SINGLE: Final = b"S"
_SINGLE_HEADER: Final = Struct(">QI")

#: What is too large for now waits in so many messages at most, and this part of the backlog's size.
MOST_HELD: Final = 10_000
HELD_SHARE: Final = 1 / 4


class DropReason(Enum):
    """Why a message is not sent."""

    FULL = "full"  # the backlog, or its part of the memory
    REFUSED = "refused"  # as it is full; the publisher was told
    STORE = "store"  # nothing can be stored now; the publisher was told
    DISK = "disk"  # of QoS 0, as more came than the disk takes
    AGE = "age"
    EXPIRED = "expired"
    REPLACED = "replaced"  # by a newer one of its topic
    OFFLINE = "offline"  # its rule keeps nothing without a connection
    UNREADABLE = "unreadable"  # damaged on the disk


@dataclass(slots=True)
class BacklogCounts:
    """What has happened to messages since the start, and what waits now.

    `waiting` includes those `in_flight`, and so do `bytes`. `oldest_at` is when the oldest of them
    was published, in seconds of the journals' clock. `restored` waited at the start. `dropped` is
    by rule and reason; of those that were set aside, `aside` are kept. Of those that wait, `held`
    are larger than the fleet's broker takes now.
    """

    offered: int = 0
    restored: int = 0
    sent: int = 0
    set_aside: int = 0
    dropped: Counter[tuple[str, DropReason]] = field(default_factory=Counter)
    waiting: int = 0
    in_flight: int = 0
    bytes: int = 0
    lanes: tuple[int, int, int] = (0, 0, 0)
    oldest_at: float | None = None
    aside: int = 0
    held: int = 0


class Backlog:
    """What waits for one link.

    `wake` is called when `next` may have something again after it had nothing, once; it must not
    call back, but see to it that somebody does. After `settle`, `set_aside` and `retry_later`, and
    at the time that `due` says, `next` is to be called anyway.

    A connection begins with `connected` and ends with `rewind`.
    """

    def __init__(
        self,
        name: str,
        backlogs: Backlogs,
        rules: Iterable[OutRule],
        limits: BacklogLimits,
        now: float,
        wake: Callable[[], None],
        *,
        rate: float | None = None,
        bytes_per_second: float | None = None,
    ) -> None:
        self._name = name
        self._backlogs = backlogs
        self._latest = backlogs.latest(name)
        self._single = backlogs.single(name)
        self._wake = wake
        self._limits = limits
        self._bucket: TokenBucket | None = None
        self._byte_bucket: TokenBucket | None = None
        #: Numbers grow through restarts, as no link has a million messages a second.
        self._number = int(now * 1e6)
        self._online = False
        #: Whether `next` had nothing and nobody was woken since.
        self._idle = True

        self._queues: dict[str, RuleQueue] = {}
        #: By the identity of each of these rules, which is faster than the value.
        self._rules: list[OutRule] = []
        self._of_rule: dict[int, RuleQueue] = {}
        self._lanes: list[list[RuleQueue]] = [[] for _ in PRIORITIES]
        #: By lane: messages of other lanes since its last one, and whether `live` is next.
        self._passed = [0] * len(PRIORITIES)
        self._live_first = [False] * len(PRIORITIES)
        #: Bytes of read records that each rule may have in memory.
        self._share = LOADED_SIZE
        #: The rule that has a record in memory which exceeds its share.
        self._oversized: RuleQueue | None = None

        self._messages = 0
        self._bytes = 0
        #: Handed out and not settled, by number, in this order.
        self._flying: dict[int, Entry] = {}
        #: Bytes of memory: in flight, to be sent again, and of `latest` and `live`.
        self._flying_size = 0
        self._again_size = 0
        self._live_size = 0
        #: Of topics whose latest message is only on disk, and the bytes of those that are read.
        self._topics_size = 0
        self._values_size = 0
        #: No latest message expires before.
        self._earliest_end = math.inf
        #: To be tried again: when, number, entry; and how many of them are not GONE.
        self._later: list[tuple[float, int, Entry]] = []
        self._later_count = 0
        #: Their bytes of memory, which are a part of `_again_size`.
        self._later_size = 0
        #: Numbers of messages that were stored by themselves and may be in a journal as well, as
        #: what was settled there out of order was not stored.
        self._repeated: set[int] = set()
        self._full_since: int | None = None
        self._log = RateLimitedLog()
        self._counts = BacklogCounts()
        #: The bytes of a packet at which all held messages are known to be too large; and at which
        #: those were that have not been handed out on this connection, which takes more.
        self._held_at = 0.0
        self._held_before = math.inf

        #: By rule: the number of its journal; and the key of the row that says so.
        self._numbers: dict[str, int] = {}
        self._numbers_key: int | None = None
        self._aside = AsideRecords(backlogs.aside(name))
        self._follow(rules, rate, bytes_per_second, now)
        self._restore()
        self._sort()

    # --- rules ------------------------------------------------------------------------------------

    def replace_rules(
        self,
        rules: Iterable[OutRule],
        limits: BacklogLimits,
        now: float,
        *,
        rate: float | None = None,
        bytes_per_second: float | None = None,
    ) -> None:
        """Follow other rules and limits from now on.

        What waits for a rule that is no more is sent nevertheless.
        """
        self._limits = limits
        self._earliest_end = 0.0
        self._follow(rules, rate, bytes_per_second, now)
        self._forget_drained()
        self._sort()

    def _follow(
        self,
        rules: Iterable[OutRule],
        rate: float | None,
        bytes_per_second: float | None,
        now: float,
    ) -> None:
        self._bucket = _bucket(self._bucket, rate, now)
        self._byte_bucket = _bucket(self._byte_bucket, bytes_per_second, now)
        for queue in self._queues.values():
            queue.configured = False
        self._rules = list(rules)
        self._of_rule.clear()
        for rule in self._rules:
            self._of_rule[id(rule)] = self._configure(rule, now)

    def _configure(self, rule: OutRule, now: float) -> RuleQueue:
        name = rule.local_filter
        queue = self._queues.get(name)
        if queue is None:
            queue = self._queues[name] = RuleQueue(rule)
        elif not queue.configured:
            if not queue.mixed and queue.stored:
                queue.note_restored(self._number)  # their topics were not noted
            queue.use(rule)
        queue.configured = True
        queue.bucket = _bucket(queue.bucket, queue.rule.rate, now)
        return queue

    def _sort(self) -> None:
        for queues in self._lanes:
            queues.clear()
        for queue in self._queues.values():
            self._lanes[queue.lane].append(queue)
        self._share = max(LOADED_SHARE, LOADED_SIZE // max(1, len(self._queues)))

    def _forget_drained(self) -> None:
        """Forget rules that are no more and for which nothing waits."""
        drained = [each for each in self._queues.values() if not each.configured]
        drained = [each for each in drained if not each.messages]
        for queue in drained:
            del self._queues[queue.name]
            self._numbers.pop(queue.name, None)
        if any(queue.number >= 0 for queue in drained):
            self._put_numbers()
        if drained:
            self._sort()

    def _put_numbers(self) -> None:
        row = _NUMBERS + json.dumps(self._numbers).encode()
        self._numbers_key = self._latest.put(self._numbers_key, row, awaited=False)

    def _open_journal(self, queue: RuleQueue) -> None:
        """Give the rule a journal; the number of it is stored before the first record."""
        number = self._numbers.get(queue.name)
        if number is None:
            number = 1 + max(self._numbers.values(), default=-1)
            self._numbers[queue.name] = number
            self._put_numbers()
        queue.number = number
        queue.journal = self._backlogs.journal(self._name, number)

    # --- what was stored ------------------------------------------------------------------------

    def _restore(self) -> None:
        later: list[tuple[Record, int, int]] = []
        values: dict[tuple[str, str], LatestValue] = {}
        single = set(self._single.load())
        for key, row in self._latest.load():
            try:
                self._restore_row(key, row, later, values, single)
            except ValueError as error:
                log.warning("backlog of %s: a row is unreadable: %s", self._name, error)
                self._latest.remove(key)
        for name in self._numbers:
            queue = self._orphaned(name)
            self._open_journal(queue)
            assert queue.journal is not None
            segments = queue.journal.segments()
            queue.stored = sum(segment.count - segment.done for segment in segments)
            self._count(queue, queue.stored, sum(map(size_left, segments)))
            queue.behind = queue.stored > 0
            if queue.stored:
                queue.note_restored(self._number)
        for each in single.difference(value.single for value in values.values()):
            self._single.remove(each)
        for (name, topic), value in sorted(values.items(), key=lambda each: each[1].number):
            queue = self._orphaned(name)
            if (value.qos or not queue.mixed) and queue.last_stored(topic):
                value.after = value.number  # numbers of the journal are below, or of newer messages
            self._keep_latest(queue, value)
            self._count(queue, 1, value.size)
        for record, size, key in sorted(later, key=lambda each: each[0].number):
            entry = Entry(self._orphaned(record.rule), record, size)
            entry.key = key
            self._count(entry.queue, 1, size)
            entry.state = AGAIN
            self._again_size += size + ENTRY_OVERHEAD
            entry.queue.again.append(entry)
            self._repeated.add(record.number)
        self._counts.restored = self._messages

    def _restore_row(
        self,
        key: int,
        row: bytes,
        later: list[tuple[Record, int, int]],
        values: dict[tuple[str, str], LatestValue],
        single: set[int],
    ) -> None:
        """Take over a row; `single` are the keys of records that are stored by themselves.

        Raises ValueError.
        """
        kind, data = row[:1], row[1:]
        if kind == _NUMBERS:
            self._numbers_key = key
            self._numbers = _decode_numbers(data)
            return
        if kind == _LATER:
            later.append((Record.decode(data), len(data), key))
            return
        if kind == _LATEST:
            own, size = None, len(data)
        elif kind == _SINGLE:
            if len(data) < _SINGLE_HEADER.size:
                raise ValueError("too short")
            own, size = _SINGLE_HEADER.unpack_from(data)
            data = data[_SINGLE_HEADER.size :]
        else:
            raise ValueError("of another version")
        record = Record.decode(data)
        if own is not None and own not in single:
            raise ValueError("the record of a row is missing")
        before = values.get((record.rule, record.topic))
        if before is not None:  # a rule's rows have one topic each, unless it was damaged
            raise ValueError("a second row of a topic")
        expires = math.inf if record.expires_at is None else record.expires_at
        value = LatestValue(
            record.topic, record.number, record.qos, size, record.stored_at, expires
        )
        value.key = key
        if own is None:
            value.data = data
        else:
            value.single = own
        values[record.rule, record.topic] = value

    def _orphaned(self, name: str) -> RuleQueue:
        """The queue of a rule that may not be in the configuration any more."""
        queue = self._queues.get(name)
        if queue is None:
            # What cannot be sent now is the first to be dropped.
            priority: Priority = "low" if name == HELD else "normal"
            queue = self._queues[name] = RuleQueue(OutRule(name, "", "", priority=priority))
            queue.configured = False
        return queue

    # --- in ---------------------------------------------------------------------------------------

    def offer(
        self,
        rule: OutRule,
        topic: str,
        payload: bytes,
        qos: int,
        retain: bool,
        properties_wire: bytes,
        expires_at: float | None,
        now: float,
    ) -> str | None:
        """Accept a message for the topic there; returns None, or why it is refused (0x97).

        It may be dropped, now or later, as the limits say. What is stored is part of the store's
        open batch. `expires_at` is in seconds of the journals' clock.
        """
        queue = self._of_rule.get(id(rule)) or self._queue_of(rule, now)
        kept = queue.kept[2 * qos + retain]
        self._counts.offered += 1
        if kept == "none" and not self._online:
            self._drop(queue, DropReason.OFFLINE)
            return None
        self._number = number = self._number + 1
        data = encode_record(
            number,
            queue.encoded_name,
            topic,
            payload,
            qos,
            retain,
            now,
            expires_at,
            properties_wire,
        )
        size = len(data)
        is_for_disk = kept == "all" or (
            kept == "latest" and not self._has_latest_room(queue, topic, size)
        )
        if not qos and is_for_disk and self._is_behind_disk(queue, now):
            return None
        while self._bytes + size > self._limits.size:
            replaced = queue.latest.get(topic) if kept == "latest" else None
            added = size - replaced.size if replaced is not None else size
            if self._bytes + added <= self._limits.size:
                break
            if not self._make_room(queue.lane, added, now):
                return self._refuse(queue)
        if kept == "all":
            if self._backlogs.failing:
                return self._cannot_store(queue, qos)
            self._append(queue, topic, data, number, awaited=qos > 0)
        elif kept == "latest":
            persistent = qos > 0 or retain
            while not (in_memory := self._has_latest_room(queue, topic, size)):
                before = queue.latest.get(topic)
                if (before is not None and before.single is not None) or self._has_topic_room(
                    topic
                ):
                    break
                if self._limits.when_full == "refuse" or not self._drop_oldest_latest(queue.lane):
                    return self._refuse(queue)
            if (persistent or not in_memory) and self._backlogs.failing:
                return self._cannot_store(queue, qos)
            expires = math.inf if expires_at is None else expires_at
            value = LatestValue(topic, number, qos, size, now, expires)
            self._offer_latest(queue, value, data, persistent=persistent, in_memory=in_memory)
        else:
            memory = size + LOADED_OVERHEAD
            if not self._make_live_room(queue.lane, memory):
                self._drop(queue, DropReason.FULL)
                return None
            self._live_size += memory
            queue.live.append(data)
        queue.messages += 1
        queue.bytes += size
        self._messages += 1
        self._bytes += size
        if self._idle:
            self._idle = False
            self._wake()
        return None

    def _queue_of(self, rule: OutRule, now: float) -> RuleQueue:
        """The queue of an equal rule, or of one that is new."""
        queue = self._queues.get(rule.local_filter)
        if queue is None or not queue.configured:
            queue = self._configure(rule, now)
            self._sort()
        return queue

    def _refuse(self, queue: RuleQueue) -> str | None:
        if self._limits.when_full == "refuse":
            self._drop(queue, DropReason.REFUSED)
            self._say_full()
            return f"the backlog of {self._name} is full"
        self._drop(queue, DropReason.FULL)
        self._say_full()
        return None

    def _cannot_store(self, queue: RuleQueue, qos: int) -> str | None:
        self._drop(queue, DropReason.STORE)
        return f"the backlog of {self._name} cannot be stored" if qos else None

    def _is_behind_disk(self, queue: RuleQueue, now: float) -> bool:
        """Drop a message of QoS 0 when more waits to be written than the memory allows."""
        if self._backlogs.failing or self._backlogs.unwritten < UNWRITTEN_SIZE[queue.lane]:
            return False
        self._drop(queue, DropReason.DISK)
        text = "the backlog of %s: the disk is too slow for %s, messages of QoS 0 are dropped"
        self._log.warning(now, queue.name, text, self._name, queue.name, burst=1)
        return True

    def _append(
        self, queue: RuleQueue, topic: str, data: bytes, number: int, *, awaited: bool
    ) -> Segment:
        journal = queue.journal
        if journal is None:
            self._open_journal(queue)
            journal = queue.journal
            assert journal is not None
        segment = journal.append(data, awaited=awaited)
        queue.stored += 1
        if queue.mixed:
            queue.note_topic(topic, number)
        size = len(data)
        if not queue.behind and self._has_memory(queue, size):
            queue.keep(segment, data)
        elif queue.arriving is not None and queue.arriving_size + size <= self._share:
            queue.arriving.append((segment, segment.count - 1, data))
            queue.arriving_size += size + LOADED_OVERHEAD
            queue.spill(segment)
        else:
            queue.arriving = None
            queue.spill(segment)
        return segment

    def _has_memory(self, queue: RuleQueue, size: int) -> bool:
        """Whether a record of this size may be read now."""
        if queue.loaded + size + LOADED_OVERHEAD <= self._share:
            return True
        if queue.waiting or self._oversized is not None:
            return False
        self._oversized = queue
        return True

    # --- the latest of a topic --------------------------------------------------------------------

    def _has_latest_room(self, queue: RuleQueue, topic: str, size: int) -> bool:
        """Whether there is memory for a record of this size as the latest of its topic."""
        value = queue.latest.get(topic)
        before = 0 if value is None or value.single is not None else value.size + LATEST_OVERHEAD
        return self._live_size - before + size + LATEST_OVERHEAD <= LATEST_SIZE

    def _has_topic_room(self, topic: str) -> bool:
        """Whether there is memory for one more topic whose latest message is only on disk."""
        return self._topics_size + len(topic) + SINGLE_OVERHEAD <= TOPICS_SIZE

    def _offer_latest(
        self,
        queue: RuleQueue,
        value: LatestValue,
        data: bytes,
        *,
        persistent: bool,
        in_memory: bool,
    ) -> None:
        """Keep it as the latest of its topic, in place of an older one."""
        key, single = self._replace_latest(queue, value.topic)
        awaited = value.qos > 0
        if value.qos or not queue.mixed:  # MQTT does not order QoS 0 and others
            value.after = queue.last_stored(value.topic)
        if in_memory:
            value.data = data
            if persistent or key is not None:
                key = self._latest.put(key, _LATEST + data, awaited=awaited)
        else:
            value.single = self._single.put(data, awaited=awaited)
            row = _SINGLE + _SINGLE_HEADER.pack(value.single, value.size) + record_head(data)
            key = self._latest.put(key, row, awaited=awaited)
        if single is not None:
            self._single.remove(single)
        value.key = key
        self._keep_latest(queue, value)

    def _replace_latest(self, queue: RuleQueue, topic: str) -> tuple[int | None, int | None]:
        """A newer message of the topic has come: end the older one; returns the keys of its row and
        of its record, which is not needed any more once the row is the newer one's."""
        value = queue.latest.get(topic)
        if value is not None:
            self._uncount(queue, value.size)
            self._free_latest(queue, value)
            self._drop(queue, DropReason.REPLACED)
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

    def _keep_latest(self, queue: RuleQueue, value: LatestValue) -> None:
        queue.latest.put(value)
        self._earliest_end = min(self._earliest_end, self._end_of(value))
        if value.single is None:
            self._live_size += value.size + LATEST_OVERHEAD
        else:
            self._topics_size += len(value.topic) + SINGLE_OVERHEAD

    def _free_latest(self, queue: RuleQueue, value: LatestValue) -> None:
        """Its memory is not needed for the value any more."""
        if value.single is None:
            self._live_size -= value.size + LATEST_OVERHEAD
            return
        self._topics_size -= len(value.topic) + SINGLE_OVERHEAD
        if value.is_read:
            value.is_read = False
            queue.values_read -= 1
            self._values_size -= value.size

    def _drop_latest(self, queue: RuleQueue, value: LatestValue, reason: DropReason) -> None:
        queue.latest.pop(value)
        self._free_latest(queue, value)
        self._uncount(queue, value.size)
        self._remove_rows(value.key, value.single)
        self._drop(queue, reason)

    def _remove_rows(self, key: int | None, single: int | None) -> None:
        if key is not None:
            self._latest.remove(key)
        if single is not None:
            self._single.remove(single)

    def _drop_oldest_latest(self, lane: int) -> bool:
        """Drop the oldest latest message of the lowest lane that is not above; False if none."""
        self._say_full()
        for lowest in range(len(PRIORITIES) - 1, lane - 1, -1):
            firsts = [
                (value.number, queue, value)
                for queue in self._lanes[lowest]
                if (value := queue.latest.oldest()) is not None
            ]
            if firsts:
                _, queue, value = min(firsts, key=lambda each: each[0])
                self._drop_latest(queue, value, DropReason.FULL)
                return True
        return False

    # --- reading the latest -----------------------------------------------------------------------

    def _read_values(self, queue: RuleQueue, now: float) -> None:
        """Read the next values that are only on disk, if there is memory for them."""
        for place, value in enumerate(queue.latest.ready.values()):
            if place == VALUES_AT_ONCE or not self._read_value(queue, value, now):
                break

    def _read_value(self, queue: RuleQueue, value: LatestValue, now: float) -> bool:
        """Read one, if it is not in memory; False if it cannot be read now.

        Each rule may have one, and the link `VALUES_SIZE` bytes.
        """
        if value.single is None or value.is_read:
            return True
        if queue.values_failed:
            queue.values_failed = False
            queue.values_at = now + READ_AGAIN
        if queue.values_at > now:
            return False
        if queue.values_read and self._values_size + value.size > VALUES_SIZE:
            return False
        value.is_read = True
        queue.values_read += 1
        self._values_size += value.size
        self._single.read(value.single, partial(self._value_was_read, queue, value))
        return True

    def _value_was_read(
        self, queue: RuleQueue, value: LatestValue, outcome: list[bytes] | Exception
    ) -> None:
        if queue.latest.get(value.topic) is not value:
            return  # it was dropped meanwhile
        if isinstance(outcome, list) and len(outcome) == 1 and len(outcome[0]) == value.size:
            queue.values_at = 0.0
            value.data = outcome[0]
        elif isinstance(outcome, list | RecordsLostError):
            self._drop_latest(queue, value, DropReason.UNREADABLE)
        else:
            if not queue.values_at:
                log.warning("backlog of %s: cannot be read: %s", self._name, outcome)
            queue.values_failed = True
            value.is_read = False
            queue.values_read -= 1
            self._values_size -= value.size
        if self._idle:
            self._idle = False
            self._wake()

    # --- full -------------------------------------------------------------------------------------

    def _make_room(self, lane: int, size: int, now: float) -> bool:
        """Drop until a message of the lane has room: too old ones, then the lowest lane's oldest.

        Whatever is more urgent than the message stays.
        """
        limit = self._limits.size - size
        if limit < 0:
            return False
        for queue in self._queues.values():
            self._drop_outdated(queue, now)
        if self._bytes <= limit:
            return True
        if self._limits.when_full == "refuse":
            return False
        self._say_full()
        for lowest in range(len(PRIORITIES) - 1, lane - 1, -1):
            while self._bytes > limit and self._drop_oldest(lowest):
                pass
        return self._bytes <= limit

    def _drop_oldest(self, lane: int) -> bool:
        """Drop the oldest message of a lane, or the oldest segment on disk; False without any."""
        oldest = math.inf
        found: RuleQueue | None = None
        is_live = False
        for queue in self._lanes[lane]:
            stored = queue.oldest_stored()
            if stored is not None and stored < oldest:
                oldest, found, is_live = stored, queue, False
            live = queue.oldest_live()
            if live is not None and live < oldest:
                oldest, found, is_live = live, queue, True
        if found is None:
            return False
        if is_live:
            self._drop_first_live(found, DropReason.FULL)
        else:
            self._drop_first_stored(found, DropReason.FULL)
        return True

    def _drop_first_stored(self, queue: RuleQueue, reason: DropReason) -> None:
        """Drop what is the first of `again`, of `waiting` or of what is not read."""
        queue.skip_gone()
        if queue.again:
            self._discard(queue.again.popleft(), reason)
        elif queue.waiting:
            data, part, index = self._pop_waiting(queue)
            self._uncount(queue, len(data))
            self._drop(queue, reason)
            queue.settle(part, index)
            self._check_emptied(queue)
        else:
            self._drop_unread(queue, queue.unread(), reason)

    def _drop_unread(self, queue: RuleQueue, segment: Segment | None, reason: DropReason) -> None:
        count, size = queue.drop_unread(segment)
        self._count(queue, -count, -size)
        self._drop(queue, reason, count)
        self._check_emptied(queue)

    def _drop_first_live(self, queue: RuleQueue, reason: DropReason) -> None:
        value = queue.latest.oldest()
        if value is not None:
            self._drop_latest(queue, value, reason)
            return
        data = queue.live.popleft()
        self._live_size -= len(data) + LOADED_OVERHEAD
        self._uncount(queue, len(data))
        self._drop(queue, reason)

    def _make_live_room(self, lane: int, memory: int) -> bool:
        """Drop what is forgotten with the connection until so many bytes have room.

        As for `_make_room`.
        """
        if self._live_size + memory <= LIVE_SIZE:
            return True
        self._say_full()
        for lowest in range(len(PRIORITIES) - 1, lane - 1, -1):
            while self._live_size + memory > LIVE_SIZE:
                waiting = [queue for queue in self._lanes[lowest] if queue.live]
                if not waiting:
                    break
                oldest = min(waiting, key=lambda queue: record_times(queue.live[0])[0])
                data = oldest.live.popleft()
                self._live_size -= len(data) + LOADED_OVERHEAD
                self._uncount(oldest, len(data))
                self._drop(oldest, DropReason.FULL)
        return not self._live_size or self._live_size + memory <= LIVE_SIZE

    def _say_full(self) -> None:
        """Log that messages are dropped, once until what waits is half as much."""
        if self._full_since is None:
            self._full_since = self._dropped_as_full()
            what = (
                "messages are refused"
                if self._limits.when_full == "refuse"
                else "the oldest messages of the lowest lane are dropped"
            )
            log.warning(
                "the backlog of %s is full (%d messages, %d bytes): %s",
                self._name,
                self._messages,
                self._bytes,
                what,
            )

    def _dropped_as_full(self) -> int:
        dropped = self._counts.dropped.items()
        full = (DropReason.FULL, DropReason.REFUSED)
        return sum(count for (_, reason), count in dropped if reason in full)

    def tick(self, now: float) -> None:
        """Drop what has become too old; to be called every second or so."""
        self._log.tick(now)
        for queue in self._queues.values():
            self._drop_outdated(queue, now)
        self._drop_outdated_latest(now)
        self._forget_drained()
        if self._full_since is not None and 2 * self._bytes < self._limits.size:
            count = self._dropped_as_full() - self._full_since
            self._full_since = None
            log.warning(
                "the backlog of %s has room again; %d messages were dropped or refused",
                self._name,
                count,
            )

    def _drop_outdated_latest(self, now: float) -> None:
        """Drop the latest messages that are too old or expired; most often there can be none."""
        if self._earliest_end > now:
            return
        self._earliest_end = math.inf
        for queue in self._queues.values():
            for value in list(queue.latest):
                reason = self._too_old(value.stored_at, value.expires_at, now)
                if reason is not None:
                    self._drop_latest(queue, value, reason)
                else:
                    self._earliest_end = min(self._earliest_end, self._end_of(value))

    def _end_of(self, value: LatestValue) -> float:
        """When it will be too old."""
        age = self._limits.age
        return value.expires_at if age is None else min(value.expires_at, value.stored_at + age)

    def _drop_outdated(self, queue: RuleQueue, now: float) -> None:
        """Drop what is too old or expired, from the front of the queue."""
        while True:
            queue.skip_gone()
            if queue.again:
                record = queue.again[0].record
                reason = self._too_old(record.stored_at, record.expires_at, now)
            elif queue.waiting:
                reason = self._why(queue.waiting[0], now)
            else:
                segment = queue.unread() if queue.behind else None
                age = self._limits.age
                if segment is None or age is None or segment.last_at + age > now:
                    break
                reason = DropReason.AGE
            if reason is None:
                break
            self._drop_first_stored(queue, reason)
        while queue.live and (reason := self._why(queue.live[0], now)):
            data = queue.live.popleft()
            self._live_size -= len(data) + LOADED_OVERHEAD
            self._uncount(queue, len(data))
            self._drop(queue, reason)

    def _why(self, data: bytes, now: float) -> DropReason | None:
        """Why an encoded record is not to be sent any more, if so."""
        _, stored_at, expires_at = record_times(data)
        return self._too_old(stored_at, expires_at, now)

    def _too_old(self, stored_at: float, expires_at: float | None, now: float) -> DropReason | None:
        if expires_at is not None and expires_at <= now:
            return DropReason.EXPIRED
        age = self._limits.age
        return DropReason.AGE if age is not None and stored_at + age <= now else None

    # --- out --------------------------------------------------------------------------------------

    def connected(self, packet_size: float = math.inf) -> None:
        """A connection can be sent messages from now on, of at most that size."""
        self._online = True
        held = self._queues.get(HELD)
        if held is not None:
            self._end_passes(held)
            more = packet_size > self._held_at
            held.passes = held.messages if more else len(held.again)
            if more:
                self._held_before, self._held_at = self._held_at, math.inf

    def _end_passes(self, held: RuleQueue) -> None:
        """The connection has ended: what it was not sent was too large for those before."""
        if held.passes > 0:
            self._held_at = min(self._held_at, self._held_before)
        self._held_before = math.inf
        held.passes = 0

    def next(self, now: float) -> Entry | None:
        """The next message to be sent; None when there is none, or when it may not be sent yet.

        It is in flight until it is settled, set aside, tried again or rewound; what is sent with
        QoS 0 is to be settled at once.
        """
        if self._messages == len(self._flying):
            self._idle = True  # also while a rate is exceeded: the next message wakes the sender
            return None
        only_again = False
        size = self._flying_size + self._again_size
        if size >= IN_FLIGHT_SIZE:
            if not self._again_size:
                return None
            only_again = size >= IN_FLIGHT_SIZE + IN_FLIGHT_RESERVE
        most_later = MOST_LATER
        if only_again and size - self._later_size < IN_FLIGHT_RESERVE:
            only_again, most_later = False, 1  # only what was refused fills the memory
        bucket, byte_bucket = self._bucket, self._byte_bucket
        if bucket is not None and bucket.due(now) > now:
            return None
        if byte_bucket is not None and byte_bucket.due(now) > now:
            return None
        if self._later_count:
            entry = self._next_later(now)
            if entry is not None:
                return entry
        passed = self._passed
        turn = 2 if passed[2] >= TURN else 1 if passed[1] >= TURN else 0
        entry = None
        if turn:
            passed[turn] = 0
            entry = self._next_of(turn, now, only_again, most_later)
        if entry is None:
            entry = (
                self._next_of(0, now, only_again, most_later)
                or self._next_of(1, now, only_again, most_later)
                or self._next_of(2, now, only_again, most_later)
            )
        if entry is None:
            self._idle = True
            return None
        lane = entry.queue.lane
        passed[1] = passed[1] + 1 if lane != 1 else 0
        passed[2] = passed[2] + 1 if lane != 2 else 0
        return entry

    def take(self, now: float, most: int, size: int) -> list[Entry]:
        """The next messages, at most so many, as that many calls of `next` would hand them out.

        The last is the one with which they have `size` bytes. There may be more although these are
        fewer; there is none to be sent now if these are none.

        A backlog that drains has one rule whose messages wait, and most are found without looking
        at all rules and lanes: that takes half the time of `next`.
        """
        queue, most = self._only_queue(most)
        if queue is None or most < 2:
            entry = self.next(now)
            return [] if entry is None else [entry]
        lane, waiting, flying = queue.lane, queue.waiting, self._flying
        entries: list[Entry] = []
        pop, decode, age = queue.pop_waiting, Record.decode, self._limits.age
        memory = self._flying_size + self._again_size
        while len(entries) < most and size > 0 and memory < IN_FLIGHT_SIZE and waiting:
            try:
                record = decode(waiting[0])
            except ValueError:
                break  # it is for `next` to tell
            stored_at, expires_at = record.stored_at, record.expires_at
            if expires_at is not None and expires_at <= now:
                break  # to drop it, too
            if age is not None and stored_at + age <= now:
                break
            data, part, index = pop()
            length = len(data)
            entry = Entry(queue, record, length)
            entry.part = part
            entry.index = index
            entry.attempts = 1
            if now - stored_at > DELAYED:
                entry.published_at = stored_at
            if expires_at is not None:
                entry.expiry = min(_LONGEST_EXPIRY, math.ceil(expires_at - now))
            flying[record.number] = entry
            memory += length + ENTRY_OVERHEAD
            self._flying_size += length + ENTRY_OVERHEAD
            size -= length
            entries.append(entry)
        if not entries:
            entry_of_next = self.next(now)
            return [] if entry_of_next is None else [entry_of_next]
        if self._oversized is queue:
            self._oversized = None
        self._live_first[lane] = True
        for other in (1, 2):
            self._passed[other] = self._passed[other] + len(entries) if other != lane else 0
        return entries

    def _only_queue(self, most: int) -> tuple[RuleQueue | None, int]:
        """The rule whose read messages are the next ones, and how many of them may be."""
        if (
            self._bucket is not None
            or self._byte_bucket is not None
            or self._later_count
            or self._repeated
        ):
            return None, 0
        found: RuleQueue | None = None
        for queues in self._lanes:
            for queue in queues:
                if not queue.passes:
                    continue  # of what waits here nothing may be sent
                latest = queue.latest
                if (
                    queue.waiting
                    or queue.again
                    or latest.ready
                    or latest.blocked
                    or queue.live
                    or queue.behind
                ):
                    if found is None:
                        found = queue
                    elif found.lane == queue.lane:
                        return None, 0  # whichever has the older message
        if (
            found is None
            or found.again
            or found.latest
            or found.live
            or found.bucket is not None
            or found.name == HELD
            or (found.behind and found.reading is None and 2 * found.loaded <= self._share)
        ):
            return None, 0
        for lane in (1, 2):
            if lane != found.lane:
                most = min(most, TURN - self._passed[lane])
        return found, most

    def put_back(self, entries: Iterable[Entry]) -> None:
        """They were handed out, and not sent: they are the next ones again."""
        for entry in reversed(list(entries)):
            self._land(entry)
            self._again_size += entry.size + ENTRY_OVERHEAD
            self._put_back(entry)

    def _next_of(self, lane: int, now: float, only_again: bool, most_later: int) -> Entry | None:
        """The next message of a lane, handed out; it drops those that are too old.

        Of a rule of which so many wait to be tried again, only those that were in flight before.
        """
        for _ in range(MOST_DROPPED):
            stored: RuleQueue | None = None
            live: RuleQueue | None = None
            live_number = math.inf
            for queue in self._lanes[lane]:
                if not queue.messages or not queue.passes:
                    continue
                bucket = queue.bucket
                if bucket is not None and bucket.due(now) > now:
                    continue
                again, latest = queue.again, queue.latest
                if again and again[0].state == GONE:
                    queue.skip_gone()
                is_refused = queue.later >= most_later
                if (only_again or is_refused) and not again:
                    continue
                if queue.behind and queue.reading is None and 2 * queue.loaded <= self._share:
                    self._read_on(queue, now)
                if latest.blocked:
                    latest.unblock(queue.first_number_stored())
                if latest.ready and next(iter(latest.ready.values())).data is None:
                    self._read_values(queue, now)
                if queue.held_up_by is not None and queue.is_held_up():
                    self._read_value(queue, queue.held_up_by, now)
                    is_held_up = not again
                else:
                    is_held_up = False
                if (
                    (again or queue.waiting)
                    and not is_held_up
                    and (stored is None or queue.first_number() < stored.first_number())
                ):
                    stored = queue
                if (
                    not is_refused
                    and (latest.ready or queue.live)
                    and (number := queue.first_live_number()) is not None
                    and number < live_number
                ):
                    live, live_number = queue, number
            if live is not None and (stored is None or self._live_first[lane]):
                self._live_first[lane] = False
                entry = self._take_live(live, now)
            elif stored is not None:
                self._live_first[lane] = True
                entry = self._take_stored(stored, now)
            else:
                return None
            if entry is not None:
                return entry
        self._wake()  # the rest in another turn
        return None

    def _take_stored(self, queue: RuleQueue, now: float) -> Entry | None:
        queue.passes -= 1
        if queue.again:
            entry = queue.again.popleft()
            record = entry.record
            reason = self._too_old(record.stored_at, record.expires_at, now)
            if reason is not None:
                self._discard(entry, reason)
                return None
            self._again_size -= entry.size + ENTRY_OVERHEAD
            return self._hand_out(entry, now)
        if queue.latest and (value := queue.latest_before()) is not None:
            if value.data is not None:
                return self._take_latest(queue, value, now)
            queue.held_up_by = value
            self._read_value(queue, value, now)
            return None
        data, part, index = self._pop_waiting(queue)
        try:
            record = Record.decode(data)
            reason = self._too_old(record.stored_at, record.expires_at, now)
        except ValueError as error:
            log.warning("backlog of %s: a message is unreadable: %s", self._name, error)
            reason = DropReason.UNREADABLE
        if reason is not None:
            self._uncount(queue, len(data))
            self._drop(queue, reason)
            queue.settle(part, index)
            self._check_emptied(queue)
            return None
        if record.number in self._repeated:
            self._repeated.remove(record.number)
            self._counts.restored -= 1
            self._uncount(queue, len(data))
            queue.settle(part, index)
            self._check_emptied(queue)
            return None
        entry = Entry(queue, record, len(data))
        entry.part = part
        entry.index = index
        if queue.name == HELD and record.rule in self._queues:
            entry.qos = self._queues[record.rule].qos
        return self._hand_out(entry, now)

    def _take_live(self, queue: RuleQueue, now: float) -> Entry | None:
        for value in queue.latest.ready.values():
            if value.data is not None:
                return self._take_latest(queue, value, now)
            break
        data = queue.live.popleft()
        self._live_size -= len(data) + LOADED_OVERHEAD
        reason = self._why(data, now)
        if reason is not None:
            self._uncount(queue, len(data))
            self._drop(queue, reason)
            return None
        entry = Entry(queue, Record.decode(data), len(data))
        entry.qos = min(queue.qos, entry.record.qos)
        return self._hand_out(entry, now)

    def _take_latest(self, queue: RuleQueue, value: LatestValue, now: float) -> Entry | None:
        """Hand out a value that is in memory; None when it was too old, or is unreadable."""
        data = value.data
        assert data is not None
        reason = self._too_old(value.stored_at, value.expires_at, now)
        if reason is None:
            try:
                record = Record.decode(data)
            except ValueError as error:
                log.warning("backlog of %s: a message is unreadable: %s", self._name, error)
                reason = DropReason.UNREADABLE
        if reason is not None:
            self._drop_latest(queue, value, reason)
            return None
        queue.latest.pop(value)
        self._free_latest(queue, value)
        entry = Entry(queue, record, value.size)
        entry.key = value.key
        entry.value = value
        value.data = None
        queue.newest[value.topic] = entry
        if not record.retain:
            entry.qos = min(queue.qos, record.qos)
        return self._hand_out(entry, now)

    def _hand_out(self, entry: Entry, now: float) -> Entry:
        record = entry.record
        entry.state = IN_FLIGHT
        entry.attempts += 1
        stored_at = record.stored_at
        entry.published_at = stored_at if now - stored_at > DELAYED else None
        if record.expires_at is not None:
            # Rounded up: 0 would be "at once", or "never", depending on the receiver.
            entry.expiry = min(_LONGEST_EXPIRY, math.ceil(record.expires_at - now))
        size = entry.size
        self._flying[record.number] = entry
        self._flying_size += size + ENTRY_OVERHEAD
        if entry.queue.bucket is not None:
            entry.queue.bucket.take(1)
        if self._bucket is not None:
            self._bucket.take(1)
        if self._byte_bucket is not None:
            self._byte_bucket.take(size)
        return entry

    def _next_later(self, now: float) -> Entry | None:
        """A message that is to be tried again now."""
        later = self._later
        while later and (later[0][0] <= now or later[0][2].state != LATER):
            entry = heapq.heappop(later)[2]
            if entry.state != LATER:
                continue
            self._count_later(entry, -1)
            record = entry.record
            reason = self._too_old(record.stored_at, record.expires_at, now)
            if reason is None:
                self._again_size -= entry.size + ENTRY_OVERHEAD
                return self._hand_out(entry, now)
            entry.state = AGAIN
            self._discard(entry, reason)
        return None

    def due(self, now: float) -> float | None:
        """When `next` has something that it may not hand out now; None if that is unknown."""
        times = [
            bucket.due(now) for bucket in (self._bucket, self._byte_bucket) if bucket is not None
        ]
        blocked = max(times, default=now)
        if blocked > now:
            return blocked if self._messages > len(self._flying) else None
        while self._later and self._later[0][2].state != LATER:
            heapq.heappop(self._later)
        times = [due for due, _, _ in self._later[:1]]
        for queue in self._queues.values():
            times += (queue.read_at, queue.values_at)
            if queue.bucket is not None and queue.messages:
                times.append(queue.bucket.due(now))
        return min((due for due in times if due > now), default=None)

    # --- reading ----------------------------------------------------------------------------------

    def _read_on(self, queue: RuleQueue, now: float) -> None:
        """Read the next segment of a rule's journal, if there is memory for it."""
        if queue.read_failed:
            queue.read_failed = False
            queue.read_at = now + READ_AGAIN
        if queue.read_at > now:
            return
        segment = queue.unread()
        if segment is None:
            queue.behind = False
            return
        if segment.size > self._share and segment.count == 1 and self._oversized is not None:
            return
        queue.start_reading(segment)
        assert queue.journal is not None
        queue.journal.read(segment, partial(self._was_read, queue, segment))

    def _was_read(
        self, queue: RuleQueue, segment: Segment, outcome: list[bytes] | Exception
    ) -> None:
        if queue.reading is not segment:
            return  # it was dropped meanwhile
        arrived = queue.stop_reading()
        if isinstance(outcome, RecordsLostError):
            self._drop_unread(queue, segment, DropReason.UNREADABLE)
        elif isinstance(outcome, Exception):
            if not queue.read_at:
                log.warning("backlog of %s: cannot be read: %s", self._name, outcome)
            queue.read_failed = True
        else:
            queue.read_at = 0.0
            self._keep_read(queue, segment, outcome, arrived)
        if self._idle:
            self._idle = False
            self._wake()

    def _keep_read(
        self,
        queue: RuleQueue,
        segment: Segment,
        records: list[bytes],
        arrived: list[tuple[Segment, int, bytes]],
    ) -> None:
        """Keep of a segment what the memory allows, and what was appended while it was read."""
        first, underestimated = queue.begin(segment, records)
        self._count(queue, 0, underestimated)
        for data in records[first:]:
            if not self._has_memory(queue, len(data)):
                return
            queue.keep(segment, data)
        for place, index, data in arrived:
            if place is segment and index < len(records):
                continue
            if not self._has_memory(queue, len(data)):
                return
            queue.keep(place, data)
        queue.behind = queue.unread() is not None

    def _pop_waiting(self, queue: RuleQueue) -> tuple[bytes, HeldSegment, int]:
        popped = queue.pop_waiting()
        if self._oversized is queue:
            self._oversized = None
        return popped

    # --- what becomes of it -----------------------------------------------------------------------

    def settle(self, entry: Entry) -> None:
        """It is acknowledged (below 0x80), or was sent with QoS 0; ignored if not in flight."""
        if entry.state != IN_FLIGHT:
            return
        self._counts.sent += 1
        self._land(entry)
        self._end(entry)

    def settle_all(self, entries: Iterable[Entry]) -> None:
        """`settle` for each of them.

        Acknowledgements come in the order of the messages, so that those of a segment are settled
        at once: the journal is told only of the last.
        """
        flying = self._flying
        part: HeldSegment | None = None
        queue: RuleQueue | None = None
        count = size = 0
        for entry in entries:
            found = entry.part
            if (
                found is None
                or entry.index != found.done
                or found.settled
                or entry.state != IN_FLIGHT
            ):
                self.settle(entry)
                continue
            if found is not part:
                if part is not None and queue is not None:
                    self._settled(queue, part, count, size)
                part, queue = found, entry.queue
                count = size = 0
            found.done += 1
            entry.state = GONE
            del flying[entry.record.number]
            count += 1
            size += entry.size
        if part is not None and queue is not None:
            self._settled(queue, part, count, size)

    def _settled(self, queue: RuleQueue, part: HeldSegment, count: int, size: int) -> None:
        """So many records of a segment, of `size` bytes in all, were in flight, and are settled."""
        self._counts.sent += count
        self._flying_size -= size + count * ENTRY_OVERHEAD
        self._count(queue, -count, -size)
        queue.settled(part, count)
        self._check_emptied(queue)

    def retry_later(self, entry: Entry, now: float) -> None:
        """The fleet's broker has no room for it (0x97): it is sent again after a while.

        Others overtake it. It is stored by itself, so that they need not be repeated after a kill.
        """
        if entry.state != IN_FLIGHT:
            return
        self._land(entry)
        queue = entry.queue
        self._again_size += entry.size + ENTRY_OVERHEAD
        if entry.topic is not None and self._is_replaced(entry):
            entry.state = AGAIN
            self._discard(entry, DropReason.REPLACED)
            return
        if entry.part is not None and queue.later < MOST_LATER:
            entry.key = self._latest.put(None, _LATER + entry.record.encode(), awaited=False)
            queue.settle(entry.part, entry.index)
            entry.part = None
            self._check_emptied(queue)
        entry.state = LATER
        self._count_later(entry, 1)
        delay = min(LONGEST_RETRY, FIRST_RETRY * 2 ** min(entry.attempts - 1, 10))
        heapq.heappush(self._later, (now + delay, entry.record.number, entry))

    def _count_later(self, entry: Entry, count: int) -> None:
        """One more is to be tried again at a time, or one less."""
        self._later_count += count
        self._later_size += count * (entry.size + ENTRY_OVERHEAD)
        entry.queue.later += count

    def hold(self, entry: Entry, packet_size: int) -> bool:
        """The fleet's broker takes only smaller packets now: keep it until one takes more than
        `packet_size` bytes, and send what follows.

        False for what only counts as long as nothing newer has come, or is not stored, and where
        too much is kept so.
        """
        if entry.topic is not None or (entry.part is None and entry.key is None):
            return False
        held = self._orphaned(HELD)
        if entry.queue is not held and (
            held.messages >= MOST_HELD or held.bytes + entry.size > self._limits.size * HELD_SHARE
        ):
            return False
        if not held.messages:
            held.passes = 0
            self._held_at = packet_size
            self._sort()
        self._held_at = min(self._held_at, packet_size)
        record = entry.record
        data = record.encode()
        self._append(held, record.topic, data, record.number, awaited=False)
        self._count(held, 1, len(data))
        self._land(entry)
        self._end(entry)
        return True

    def set_aside(self, entry: Entry, reason: str, now: float) -> None:
        """The fleet's broker will never take it: keep it for the user, and send what follows."""
        if entry.state != IN_FLIGHT:
            return
        self._counts.set_aside += 1
        is_latest = entry.value is not None
        self._land(entry)
        self._aside.add(entry.record, reason, now, is_latest=is_latest)
        self._end(entry)

    def rewind(self) -> None:
        """The connection has ended: what was in flight is sent again, in the same order.

        What is only for a connection is forgotten.
        """
        self._online = False
        held = self._queues.get(HELD)
        if held is not None:
            self._end_passes(held)
        flying = list(self._flying.values())
        self._flying.clear()
        self._flying_size = 0
        for entry in reversed(flying):
            self._again_size += entry.size + ENTRY_OVERHEAD
            self._put_back(entry)
        for _, _, entry in self._later:
            if entry.state == LATER and not _is_kept(entry):
                self._discard(entry, DropReason.OFFLINE)
        for queue in self._queues.values():
            while queue.live:
                data = queue.live.popleft()
                self._live_size -= len(data) + LOADED_OVERHEAD
                self._uncount(queue, len(data))
                self._drop(queue, DropReason.OFFLINE)

    def _put_back(self, entry: Entry) -> None:
        """It is not in flight any more, and is sent again before all others of its rule."""
        entry.state = AGAIN
        if entry.topic is not None and self._is_replaced(entry):
            self._discard(entry, DropReason.REPLACED)
        elif not _is_kept(entry):
            self._discard(entry, DropReason.OFFLINE)
        else:
            entry.queue.again.appendleft(entry)

    def _is_replaced(self, entry: Entry) -> bool:
        """Whether a newer message of its topic waits or is in flight."""
        assert entry.topic is not None
        queue = entry.queue
        return queue.newest.get(entry.topic) is not entry or entry.topic in queue.latest

    def _land(self, entry: Entry) -> None:
        """It is not in flight any more."""
        del self._flying[entry.record.number]
        self._flying_size -= entry.size + ENTRY_OVERHEAD

    def _end(self, entry: Entry) -> None:
        """It is not waited for any more: remove it from where it is stored."""
        entry.state = GONE
        queue = entry.queue
        size = entry.size
        queue.messages -= 1
        queue.bytes -= size
        self._messages -= 1
        self._bytes -= size
        part = entry.part
        if part is not None:
            queue.settle(part, entry.index)
            self._check_emptied(queue)
        if entry.key is not None:
            self._remove_rows(entry.key, None if entry.value is None else entry.value.single)
            entry.key = None
        if entry.topic is not None and queue.newest.get(entry.topic) is entry:
            del queue.newest[entry.topic]

    def _discard(self, entry: Entry, reason: DropReason) -> None:
        """Drop an entry that is not in flight."""
        if entry.state == LATER:
            self._count_later(entry, -1)
        self._again_size -= entry.size + ENTRY_OVERHEAD
        self._drop(entry.queue, reason)
        self._end(entry)

    def _check_emptied(self, queue: RuleQueue) -> None:
        if not queue.stored:
            queue.empty(self._number)

    def _drop(self, queue: RuleQueue, reason: DropReason, count: int = 1) -> None:
        if count:
            self._counts.dropped[queue.name, reason] += count

    def _count(self, queue: RuleQueue, messages: int, size: int) -> None:
        queue.messages += messages
        queue.bytes += size
        self._messages += messages
        self._bytes += size

    def _uncount(self, queue: RuleQueue, size: int) -> None:
        self._count(queue, -1, -size)

    # --- status -----------------------------------------------------------------------------------

    def counts(self) -> BacklogCounts:
        """What waits now, and what has happened since the start; a copy."""
        counts = self._counts
        oldest: list[float] = [entry.record.stored_at for entry in self._flying.values()]
        oldest += [entry.record.stored_at for _, _, entry in self._later if entry.state == LATER]
        for queue in self._queues.values():
            for at in (queue.oldest_stored(), queue.oldest_live()):
                if at is not None:
                    oldest.append(at)
        lanes = [sum(queue.messages for queue in queues) for queues in self._lanes]
        return BacklogCounts(
            counts.offered,
            counts.restored,
            counts.sent,
            counts.set_aside,
            Counter(counts.dropped),
            self._messages,
            len(self._flying),
            self._bytes,
            (lanes[0], lanes[1], lanes[2]),
            min(oldest, default=None),
            len(self._aside),
            self._queues[HELD].messages if HELD in self._queues else 0,
        )

    def aside(self) -> list[SetAside]:
        """The messages that were set aside and are kept, the oldest first."""
        return self._aside.list()


def _is_kept(entry: Entry) -> bool:
    """Whether the message outlives the connection."""
    return entry.topic is not None or entry.part is not None or entry.key is not None


def _bucket(bucket: TokenBucket | None, rate: float | None, now: float) -> TokenBucket | None:
    """The bucket of a rate: the same one if the rate has not changed."""
    if rate is None or (bucket is not None and bucket.rate == rate):
        return None if rate is None else bucket
    return TokenBucket(rate, now)


def _decode_numbers(data: bytes) -> dict[str, int]:
    """The numbers of the rules' journals. Raises ValueError."""
    numbers = json.loads(data)
    if not isinstance(numbers, dict) or not all(isinstance(each, int) for each in numbers.values()):
        raise ValueError("the table of rules is damaged")
    return numbers
