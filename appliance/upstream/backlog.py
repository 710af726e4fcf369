"""What waits for one link: it is accepted here, handed out in order, and kept until settled.

Pure: time is an argument, in seconds of the journals' clock (`Journal.now`), and what is stored
goes through `broker/backlogs.py`. Each rule has a `RuleQueue`; this module decides which
of them is next, what is dropped when the backlog is full, and what is in memory:

- messages that were handed out, at most `IN_FLIGHT_SIZE` bytes;
- the next ones of each journal, `LOADED_SIZE` for all rules; the others are on disk alone;
- the latest ones of topics, and those that are forgotten when the connection ends, see
  `LiveMessages`.

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

Each message that was offered is in the end sent, dropped for a reason, or set aside, see
`BacklogCounts`.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Final

from appliance.broker.backlogs import Backlogs, Segment
from appliance.broker.rate_limited_log import RateLimitedLog
from appliance.upstream.backlog_counts import BacklogCounts, DropReason, Tally, too_old
from appliance.upstream.disk_room import DiskRoom
from appliance.upstream.eviction import Eviction
from appliance.upstream.latest_values import LatestValue
from appliance.upstream.live_messages import LiveMessages
from appliance.upstream.rates import TokenBucket
from appliance.upstream.read_ahead import MOST_LATER, ReadAhead
from appliance.upstream.records import RecordDecoder, encode_record
from appliance.upstream.retries import Retries
from appliance.upstream.rule_queue import (
    AGAIN,
    ENTRY_OVERHEAD,
    GONE,
    IN_FLIGHT,
    LATER,
    LOADED_OVERHEAD,
    Entry,
    HeldSegment,
    RuleQueue,
    size_left,
)
from appliance.upstream.rule_queues import HELD, RuleQueues, bucket_of
from appliance.upstream.rules import PRIORITIES, BacklogLimits, OutRule
from appliance.upstream.set_aside import AsideRecords, SetAside
from appliance.upstream.stored_rows import (
    StoredRows,
    later_row,
)

log = logging.getLogger(__name__)

KIB: Final = 1024
MIB: Final = 1024 * KIB

#: Bytes of memory of messages in flight. With `LOADED_SIZE`, those of `LiveMessages`, and what a
#: higher lane gets in addition, it is 8 MiB a link.
IN_FLIGHT_SIZE: Final = 3 * MIB

#: Bytes that may be in flight in addition while messages wait to be sent again: otherwise one in a
#: higher lane would wait for all of them. However many wait to be tried again, each rule of which
#: none does may have as many.
IN_FLIGHT_RESERVE: Final = 256 * KIB

#: After so many messages of other lanes it is a lane's turn. Both lower lanes may have waited, so
#: that each gets one in 16.
TURN: Final = 14

#: Seconds after which a message says when it was published.
DELAYED: Final = 1.0

#: Expired messages that one call of `next` drops: some milliseconds.
MOST_DROPPED: Final = 1000

#: The largest Message Expiry Interval, in seconds.
_LONGEST_EXPIRY: Final = 0xFFFF_FFFF

#: What is too large for now waits in so many messages at most, and this part of the backlog's size.
MOST_HELD: Final = 10_000
HELD_SHARE: Final = 1 / 4

#: With `when_full: refuse`, the part of the room that is kept free for each more urgent lane.
RESERVE_SHIFT: Final = 3


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
        self._disk = DiskRoom(backlogs)
        self._wake = wake
        self._limits = limits
        #: By lane, the bytes up to which a message has room.
        self._room: list[int] = []
        self._bucket: TokenBucket | None = None
        self._byte_bucket: TokenBucket | None = None
        #: Numbers grow through restarts, as no link has a million messages a second.
        self._number = int(now * 1e6)
        self._online = False
        #: Whether `next` had nothing and nobody was woken since.
        self._idle = True

        self._queues = RuleQueues(name, backlogs, self._latest)
        #: By lane: messages of other lanes since its last one, and whether `live` is next.
        self._passed = [0] * len(PRIORITIES)
        self._live_first = [False] * len(PRIORITIES)
        self._tally = Tally()
        self._live = LiveMessages(
            name, self._latest, self._single, limits, self._tally, self._discard, self._wake_up
        )
        self._read_ahead = ReadAhead(name, self._tally, self._lost, self._wake_up)
        self._eviction = Eviction(
            name,
            self._queues,
            limits,
            self._tally,
            self._live,
            self._read_ahead,
            self._discard,
            self._check_emptied,
        )
        self._decoder = RecordDecoder()
        #: Handed out and not settled, by number, in this order.
        self._flying: dict[int, Entry] = {}
        #: Bytes of memory: in flight, and to be sent again.
        self._flying_size = 0
        self._again_size = 0
        #: To be tried again; their bytes of memory are a part of `_again_size`.
        self._retries = Retries()
        #: Numbers of messages that were stored by themselves and may be in a journal as well, as
        #: what was settled there out of order was not stored.
        self._repeated: set[int] = set()
        self._log = RateLimitedLog()
        #: The bytes of a packet at which all held messages are known to be too large; and at which
        #: those were that have not been handed out on this connection, which takes more.
        self._held_at = 0.0
        self._held_before = math.inf

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
        self._live.use(limits)
        self._eviction.use(limits)
        self._follow(rules, rate, bytes_per_second, now)
        self._queues.forget_drained()
        self._sort()

    def _follow(
        self,
        rules: Iterable[OutRule],
        rate: float | None,
        bytes_per_second: float | None,
        now: float,
    ) -> None:
        self._bucket = bucket_of(self._bucket, rate, now)
        self._byte_bucket = bucket_of(self._byte_bucket, bytes_per_second, now)
        self._queues.follow(rules, self._number, now)

    def _sort(self) -> None:
        self._queues.sort()
        self._read_ahead.divide(len(self._queues.by_name))
        self._divide()

    def _divide(self) -> None:
        """Say up to how many bytes a message of each lane has room.

        Where nothing is dropped for what is more urgent, a part is kept free for it.
        """
        size = self._limits.size
        reserve = size >> RESERVE_SHIFT if self._limits.when_full == "refuse" else 0
        self._room = []
        for queues in self._queues.lanes:
            self._room.append(size)
            if any(queue.configured for queue in queues):
                size -= reserve

    # --- what was stored ------------------------------------------------------------------------

    def _restore(self) -> None:
        single = set(self._single.load())
        rows = StoredRows(self._latest.load(), single)
        for key, problem in rows.unreadable:
            log.warning("backlog of %s: a row is unreadable: %s", self._name, problem)
            self._latest.remove(key)
        for key in rows.loaded:
            self._latest.remove(key)
        for queue in self._queues.restore(rows.numbers, rows.numbers_key):
            assert queue.journal is not None
            segments = queue.journal.segments()
            queue.stored = sum(segment.count - segment.done for segment in segments)
            self._tally.add(queue, queue.stored, sum(map(size_left, segments)))
            queue.behind = queue.stored > 0
            if queue.stored:
                queue.note_restored(self._number)
        values = rows.values
        for each in single.difference(value.single for value in values.values()):
            self._single.remove(each)
        for (name, topic), value in sorted(values.items(), key=lambda each: each[1].number):
            queue = self._queues.orphaned(name)
            if (value.qos or not queue.mixed) and queue.last_stored(topic):
                value.after = value.number  # numbers of the journal are below, or of newer messages
            self._live.keep(queue, value)
            self._tally.add(queue, 1, value.size)
        for record, size, key in rows.later:
            entry = Entry(self._queues.orphaned(record.rule), record, size)
            entry.key = key
            self._tally.add(entry.queue, 1, size)
            entry.state = AGAIN
            self._again_size += size + ENTRY_OVERHEAD
            entry.queue.again.append(entry)
            self._repeated.add(record.number)
        self._tally.restored = self._tally.messages

    def store(self) -> None:
        """The link ends, and `rewind` was called: store what can be of what is in memory alone."""
        if not self._backlogs.failing:
            self._live.store(self._queues.by_name.values())

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
        *,
        is_acknowledged: bool = True,
        user: str | None = None,
    ) -> str | None:
        """Accept a message for the topic there; returns None, or why it is refused (0x97).

        It may be dropped, now or later, as the limits say. What is stored is part of the store's
        open batch. `expires_at` is in seconds of the journals' clock. With QoS 1 or 2 somebody
        may be acknowledged for it, who is then asked to wait (`must_wait`) before it is offered.
        `user` has published it, see `UserShares`.
        """
        queue = self._queues.of(rule) or self._queue_of(rule, now)
        kept = queue.kept[2 * qos + retain]
        self._tally.offered += 1
        if kept == "none" and not self._online:
            self._tally.drop(queue, DropReason.OFFLINE)
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
        if (
            not (qos and is_acknowledged)
            and self._disk.must_drop(queue.lane, qos)
            and self._is_for_disk(queue, topic, kept, size, user)
        ):
            self._drop_unwritten(queue, now)
            return None
        if self._tally.bytes + size > self._room[queue.lane] and not self._make_room(
            queue, topic if kept == "latest" else None, size, now
        ):
            return self._refuse(queue)
        if kept == "all":
            if self._backlogs.failing:
                return self._cannot_store(queue, qos)
            self._append(queue, topic, data, number, awaited=qos > 0)
        elif kept == "latest":
            persistent = qos > 0 or retain
            while not (in_memory := self._live.has_room(queue, topic, size, user)):
                before = queue.latest.get(topic)
                is_known = before is not None and before.single is not None
                if is_known or self._live.has_topic_room(topic):
                    break
                if self._limits.when_full == "refuse" or not self._eviction.drop_oldest_latest(
                    queue.lane
                ):
                    return self._refuse(queue)
            if (persistent or not in_memory) and self._backlogs.failing:
                return self._cannot_store(queue, qos)
            expires = math.inf if expires_at is None else expires_at
            value = LatestValue(topic, number, qos, size, now, expires, user)
            self._live.offer(queue, value, data, persistent=persistent, in_memory=in_memory)
        else:
            memory = size + LOADED_OVERHEAD
            if not self._eviction.make_live_room(queue.lane, memory):
                self._tally.drop(queue, DropReason.FULL)
                return None
            self._live.put(queue, data)
        queue.messages += 1
        queue.bytes += size
        self._tally.messages += 1
        self._tally.bytes += size
        if self._idle:
            self._idle = False
            self._wake()
        return None

    def _make_room(self, queue: RuleQueue, latest: str | None, size: int, now: float) -> bool:
        """Whether the message has room, of which the latest of a topic takes that of the one before
        unless that is dropped meanwhile."""
        room = self._room[queue.lane]
        while True:
            replaced = None if latest is None else queue.latest.get(latest)
            added = size if replaced is None else size - replaced.size
            if added <= 0 or self._tally.bytes + added <= room:
                return True
            if not self._eviction.make_room(queue.lane, added, now, room):
                return False
            if replaced is None or queue.latest.get(replaced.topic) is replaced:
                return True

    @property
    def work(self) -> int:
        """The work of all that was dropped to make room, see `Counters.cost`."""
        return self._eviction.work

    @property
    def is_owing(self) -> bool:
        """Whether `drop_more` has something to do."""
        return self._eviction.is_owing

    def drop_more(self) -> None:
        """Drop more of what is too old or displaced, a part; to be called in later turns."""
        self._eviction.go_on()

    def _queue_of(self, rule: OutRule, now: float) -> RuleQueue:
        """The queue of an equal rule, or of one that is new."""
        queue = self._queues.by_name.get(rule.local_filter)
        if queue is None or not queue.configured:
            queue = self._queues.configure(rule, self._number, now)
            self._sort()
        return queue

    def _refuse(self, queue: RuleQueue) -> str | None:
        if self._limits.when_full == "refuse":
            self._tally.drop(queue, DropReason.REFUSED)
            self._eviction.say_full()
            return f"the backlog of {self._name} is full"
        self._tally.drop(queue, DropReason.FULL)
        self._eviction.say_full()
        return None

    def _cannot_store(self, queue: RuleQueue, qos: int) -> str | None:
        self._tally.drop(queue, DropReason.STORE)
        return f"the backlog of {self._name} cannot be stored" if qos else None

    # --- a disk that is too slow ------------------------------------------------------------------

    @property
    def is_behind_disk(self) -> bool:
        """Whether `must_wait` may be true of some message."""
        return self._disk.is_behind

    def must_wait(
        self, rule: OutRule, topic: str, qos: int, retain: bool, size: int, user: str | None = None
    ) -> bool:
        """Whether the publisher of such a message should wait until more is written, where it is
        acknowledged: the message would be in memory until then. `size` is about its bytes.
        """
        queue = self._queues.by_name.get(rule.local_filter)
        return (
            queue is not None
            and self._disk.must_wait(queue.lane)
            and self._is_for_disk(queue, topic, queue.kept[2 * qos + retain], size, user)
        )

    def _is_for_disk(
        self, queue: RuleQueue, topic: str, kept: str, size: int, user: str | None
    ) -> bool:
        """Whether a message of this size waits to be written, and is in memory until it is."""
        if kept == "latest":
            return not self._live.has_room(queue, topic, size, user)
        return kept == "all"

    def _drop_unwritten(self, queue: RuleQueue, now: float) -> None:
        self._tally.drop(queue, DropReason.DISK)
        text = (
            "the backlog of %s: the disk is too slow for %s, messages of QoS 0 or from ROS are "
            "dropped"
        )
        self._log.warning(log, now, queue.name, text, self._name, queue.name, burst=1)

    # --- the journals -----------------------------------------------------------------------------

    def _append(
        self, queue: RuleQueue, topic: str, data: bytes, number: int, *, awaited: bool
    ) -> Segment:
        journal = queue.journal
        if journal is None:
            self._queues.open_journal(queue)
            journal = queue.journal
            assert journal is not None
        segment = journal.append(data, awaited=awaited)
        queue.stored += 1
        if queue.mixed:
            queue.note_topic(topic, number)
        self._read_ahead.appended(queue, segment, data)
        return segment

    # --- too old ----------------------------------------------------------------------------------

    def tick(self, now: float) -> None:
        """Drop what has become too old, the rest of much in later turns; to be called every second
        or so."""
        self._log.tick(now)
        self._eviction.tick(now)
        if self._queues.forget_drained():
            self._sort()
        self._eviction.say_room()

    # --- out --------------------------------------------------------------------------------------

    def connected(self, packet_size: float = math.inf) -> None:
        """A connection can be sent messages from now on, of at most that size."""
        self._online = True
        held = self._queues.by_name.get(HELD)
        if held is not None:
            self._end_passes(held)
            more = packet_size > self._held_at
            held.passes = float(held.messages if more else len(held.again))
            if more:
                self._held_before, self._held_at = self._held_at, math.inf

    def _end_passes(self, held: RuleQueue) -> None:
        """The connection has ended: what it was not sent was too large for those before."""
        if held.passes > 0:
            self._held_at = min(self._held_at, self._held_before)
        self._held_before = math.inf
        held.passes = 0.0

    def next(self, now: float) -> Entry | None:
        """The next message to be sent; None when there is none, or when it may not be sent yet.

        It is in flight until it is settled, set aside, tried again or rewound; what is sent with
        QoS 0 is to be settled at once.
        """
        if self._tally.messages == len(self._flying):
            self._idle = True  # also while a rate is exceeded: the next message wakes the sender
            return None
        only_again = False
        size = self._flying_size + self._again_size
        if size >= IN_FLIGHT_SIZE:
            if not self._again_size:
                return None
            only_again = size >= IN_FLIGHT_SIZE + IN_FLIGHT_RESERVE
        most_later = MOST_LATER
        if only_again and size - self._retries.size < IN_FLIGHT_RESERVE:
            only_again, most_later = False, 1  # only what was refused fills the memory
        bucket, byte_bucket = self._bucket, self._byte_bucket
        if bucket is not None and bucket.due(now) > now:
            return None
        if byte_bucket is not None and byte_bucket.due(now) > now:
            return None
        if self._retries.count:
            entry = self._next_later(now)
            if entry is not None:
                return entry
        entry = None
        for turn in (2, 1):
            if entry is None and self._passed[turn] >= TURN:
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
        self._note_passed(entry.queue.lane, 1)
        return entry

    def _note_passed(self, lane: int, count: int) -> None:
        """So many messages of the lane were handed out."""
        for other in (1, 2):
            self._passed[other] = min(TURN, self._passed[other] + count) if other != lane else 0

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
        lane, waiting, flying, decoder = queue.lane, queue.waiting, self._flying, self._decoder
        entries: list[Entry] = []
        age = self._limits.age
        before = self._flying_size
        room = IN_FLIGHT_SIZE - before - self._again_size
        may_repeat = HELD in self._queues.by_name
        taken = 0  # bytes of memory
        while len(entries) < most and size > 0 and taken < room and waiting:
            try:
                record = decoder.decode(waiting[0])
            except ValueError:
                break  # it is for `next` to tell
            stored_at, expires_at = record.stored_at, record.expires_at
            if expires_at is not None and expires_at <= now:
                break  # to drop it, too
            if age is not None and stored_at + age <= now:
                break
            if may_repeat and record.number in flying:
                break
            data, part, index = queue.pop_waiting()
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
            taken += length + ENTRY_OVERHEAD
            size -= length
            entries.append(entry)
        self._flying_size = before + taken
        if not entries:
            entry_of_next = self.next(now)
            return [] if entry_of_next is None else [entry_of_next]
        self._read_ahead.has_taken(queue)
        self._live_first[lane] = True
        self._note_passed(lane, len(entries))
        return entries

    def _only_queue(self, most: int) -> tuple[RuleQueue | None, int]:
        """The rule whose read messages are the next ones, and how many of them may be."""
        if (
            self._bucket is not None
            or self._byte_bucket is not None
            or self._retries.count
            or self._repeated
        ):
            return None, 0
        found: RuleQueue | None = None
        for lane, queues in enumerate(self._queues.lanes):
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
                    elif found.lane == lane:
                        return None, 0  # whichever has the older message
                    else:
                        most = min(most, TURN - self._passed[lane])
        if (
            found is None
            or found.again
            or found.latest
            or found.live
            or found.bucket is not None
            or found.name == HELD
            or self._read_ahead.is_due(found)
        ):
            return None, 0
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
            live_number = 0
            for queue in self._queues.lanes[lane]:
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
                if queue.behind and self._read_ahead.is_due(queue):
                    self._read_ahead.read(queue, now)
                if latest.blocked:
                    latest.unblock(queue.first_number_stored())
                if latest.ready and next(iter(latest.ready.values())).data is None:
                    self._live.read_next(queue, now)
                if queue.held_up_by is not None and queue.is_held_up():
                    self._live.read(queue, queue.held_up_by, now)
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
                    and (live is None or number < live_number)
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
            reason = too_old(record.stored_at, record.expires_at, self._limits.age, now)
            if reason is not None:
                self._discard(entry, reason)
                return None
            self._again_size -= entry.size + ENTRY_OVERHEAD
            if record.number in self._flying:  # the same one from the other place
                self._tally.restored -= 1
                self._end(entry)
                return None
            return self._hand_out(entry, now)
        if queue.latest and (value := queue.latest_before()) is not None:
            if value.data is not None:
                return self._take_latest(queue, value, now)
            queue.held_up_by = value
            self._live.read(queue, value, now)
            return None
        data, part, index = self._read_ahead.pop(queue)
        try:
            record = self._decoder.decode(data)
            reason = too_old(record.stored_at, record.expires_at, self._limits.age, now)
        except ValueError as error:
            log.warning("backlog of %s: a message is unreadable: %s", self._name, error)
            reason = DropReason.UNREADABLE
        if reason is not None:
            self._tally.remove(queue, len(data))
            self._tally.drop(queue, reason)
            queue.settle(part, index)
            self._check_emptied(queue)
            return None
        is_repeated = queue.name != HELD and record.number in self._repeated
        # What was held may be in its journal, too: that it was settled there out of order was not
        # stored.
        if is_repeated or record.number in self._flying:
            self._repeated.discard(record.number)
            self._tally.restored -= 1
            self._tally.remove(queue, len(data))
            queue.settle(part, index)
            self._check_emptied(queue)
            return None
        entry = Entry(queue, record, len(data))
        entry.part = part
        entry.index = index
        if queue.name == HELD and record.rule in self._queues.by_name:
            entry.qos = self._queues.by_name[record.rule].qos
        return self._hand_out(entry, now)

    def _take_live(self, queue: RuleQueue, now: float) -> Entry | None:
        for value in queue.latest.ready.values():
            if value.data is not None:
                return self._take_latest(queue, value, now)
            break
        data = self._live.pop(queue)
        reason = self._eviction.why(data, now)
        if reason is not None:
            self._tally.remove(queue, len(data))
            self._tally.drop(queue, reason)
            return None
        entry = Entry(queue, self._decoder.decode(data), len(data))
        entry.qos = min(queue.qos, entry.record.qos)
        return self._hand_out(entry, now)

    def _take_latest(self, queue: RuleQueue, value: LatestValue, now: float) -> Entry | None:
        """Hand out a value that is in memory; None when it was too old, or is unreadable."""
        data = value.data
        assert data is not None
        reason = too_old(value.stored_at, value.expires_at, self._limits.age, now)
        if reason is None:
            try:
                record = self._decoder.decode(data)
            except ValueError as error:
                log.warning("backlog of %s: a message is unreadable: %s", self._name, error)
                reason = DropReason.UNREADABLE
        if reason is not None:
            self._live.drop(queue, value, reason)
            return None
        self._live.take(queue, value)
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
        while (entry := self._retries.pop(now)) is not None:
            record = entry.record
            reason = too_old(record.stored_at, record.expires_at, self._limits.age, now)
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
            return blocked if self._tally.messages > len(self._flying) else None
        retry_at = self._retries.due()
        times = [] if retry_at is None else [retry_at]
        for queue in self._queues.by_name.values():
            times += (queue.read_at, queue.values_at)
            if queue.bucket is not None and queue.messages:
                times.append(queue.bucket.due(now))
        return min((due for due in times if due > now), default=None)

    def _wake_up(self) -> None:
        """`next` may have something again."""
        if self._idle:
            self._idle = False
            self._wake()

    def _lost(self, queue: RuleQueue, segment: Segment) -> None:
        """A segment is damaged on the disk."""
        self._eviction.drop_unread(queue, segment, DropReason.UNREADABLE)

    # --- what becomes of it -----------------------------------------------------------------------

    def settle(self, entry: Entry) -> None:
        """It is acknowledged (below 0x80), or was sent with QoS 0; ignored if not in flight."""
        if entry.state != IN_FLIGHT:
            return
        self._tally.sent += 1
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
        self._tally.sent += count
        self._flying_size -= size + count * ENTRY_OVERHEAD
        self._tally.add(queue, -count, -size)
        queue.settled(part, count)
        self._check_emptied(queue)

    def retry_later(self, entry: Entry, now: float) -> None:
        """The fleet's broker has no room for it (0x97): it is sent again after a while.

        Others overtake it. It is stored by itself, so that they need not be repeated after a kill.
        """
        if entry.state == IN_FLIGHT:
            self._postpone(entry, now)

    def _postpone(self, entry: Entry, now: float) -> None:
        self._land(entry)
        queue = entry.queue
        self._again_size += entry.size + ENTRY_OVERHEAD
        if entry.topic is not None and self._is_replaced(entry):
            entry.state = AGAIN
            self._discard(entry, DropReason.REPLACED)
            return
        if entry.part is not None and queue.later < MOST_LATER and self._disk.may_store_again:
            entry.key = self._latest.put(None, later_row(entry.record.encode()), awaited=False)
            queue.settle(entry.part, entry.index)
            entry.part = None
            self._check_emptied(queue)
        self._retries.add(entry, now)

    def hold(self, entry: Entry, packet_size: int, now: float) -> bool:
        """The fleet's broker takes only smaller packets now: keep it until one takes more than
        `packet_size` bytes, and send what follows.

        False for what only counts as long as nothing newer has come, or is not stored, and where
        too much is kept so. While it cannot be stored in another place it stays where it is, and is
        tried again after a while.
        """
        if entry.topic is not None or (entry.part is None and entry.key is None):
            return False
        held = self._queues.orphaned(HELD)
        if entry.queue is not held and (
            held.messages >= MOST_HELD or held.bytes + entry.size > self._limits.size * HELD_SHARE
        ):
            return False
        if not self._disk.may_store_again:
            self._postpone(entry, now)
            return True
        if not held.messages:
            held.passes = 0.0
            self._held_at = float(packet_size)
            self._sort()
        self._held_at = min(self._held_at, packet_size)
        record = entry.record
        data = record.encode()
        self._append(held, record.topic, data, record.number, awaited=False)
        self._tally.add(held, 1, len(data))
        self._land(entry)
        self._end(entry)
        return True

    def drop(self, entry: Entry, reason: DropReason) -> None:
        """It was handed out, and is not sent: that would be in vain."""
        if entry.state == IN_FLIGHT:
            self._tally.drop(entry.queue, reason)
            self._land(entry)
            self._end(entry)

    def set_aside(self, entry: Entry, reason: str, now: float) -> None:
        """The fleet's broker will never take it: keep it for the user, and send what follows."""
        if entry.state != IN_FLIGHT:
            return
        self._tally.set_aside += 1
        is_latest = entry.value is not None
        self._land(entry)
        self._aside.add(entry.record, reason, now, is_latest=is_latest)
        self._end(entry)

    def rewind(self) -> None:
        """The connection has ended: what was in flight is sent again, in the same order.

        What is only for a connection is forgotten.
        """
        self._online = False
        held = self._queues.by_name.get(HELD)
        if held is not None:
            self._end_passes(held)
        flying = list(self._flying.values())
        self._flying.clear()
        self._flying_size = 0
        for entry in reversed(flying):
            self._again_size += entry.size + ENTRY_OVERHEAD
            self._put_back(entry)
        for entry in list(self._retries):
            if not _is_kept(entry):
                self._discard(entry, DropReason.OFFLINE)
        for queue in self._queues.by_name.values():
            self._live.forget(queue)

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
        self._tally.messages -= 1
        self._tally.bytes -= size
        part = entry.part
        if part is not None:
            queue.settle(part, entry.index)
            self._check_emptied(queue)
        if entry.key is not None:
            self._live.remove_rows(entry.key, None if entry.value is None else entry.value.single)
            entry.key = None
        if entry.topic is not None and queue.newest.get(entry.topic) is entry:
            del queue.newest[entry.topic]

    def _discard(self, entry: Entry, reason: DropReason) -> None:
        """Drop an entry that is not in flight."""
        if entry.state == LATER:
            self._retries.remove(entry)
        self._again_size -= entry.size + ENTRY_OVERHEAD
        self._tally.drop(entry.queue, reason)
        self._end(entry)

    def _check_emptied(self, queue: RuleQueue) -> None:
        if not queue.stored:
            queue.empty(self._number)

    # --- status -----------------------------------------------------------------------------------

    def counts(self) -> BacklogCounts:
        """What waits now, and what has happened since the start; a copy."""
        counts = self._tally
        held = self._queues.by_name.get(HELD)
        oldest: list[float] = [entry.record.stored_at for entry in self._flying.values()]
        oldest += [entry.record.stored_at for entry in self._retries]
        for queue in self._queues.by_name.values():
            for at in (queue.oldest_stored(), queue.oldest_live()):
                if at is not None:
                    oldest.append(at)
        lanes = [sum(queue.messages for queue in queues) for queues in self._queues.lanes]
        return BacklogCounts(
            counts.offered,
            counts.restored,
            counts.sent,
            counts.set_aside,
            Counter(counts.dropped),
            self._tally.messages,
            len(self._flying),
            self._tally.bytes,
            (lanes[0], lanes[1], lanes[2]),
            min(oldest, default=None),
            len(self._aside),
            0 if held is None else held.messages,
        )

    def aside(self) -> list[SetAside]:
        """The messages that were set aside and are kept, the oldest first."""
        return self._aside.list()


def _is_kept(entry: Entry) -> bool:
    """Whether the message outlives the connection."""
    return entry.topic is not None or entry.part is not None or entry.key is not None
