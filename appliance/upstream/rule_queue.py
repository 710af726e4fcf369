"""What waits for one rule of a link: records on disk, of which the next ones are in memory as well.

A rule has a journal of its own. So the order of its messages holds whatever other rules do, its
rate delays nobody else, and a drop is counted for it without reading what is dropped.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections import deque
from operator import attrgetter
from typing import Final

from appliance.broker.backlogs import Journal, Segment
from appliance.upstream.latest_values import LatestValue, LatestValues
from appliance.upstream.rates import TokenBucket
from appliance.upstream.records import Record, record_times, record_topic
from appliance.upstream.rules import OutRule

#: Bytes of memory beside its own that are counted for a record that was read, for the latest record
#: of a topic, and for one that was handed out.
LOADED_OVERHEAD: Final = 64
LATEST_OVERHEAD: Final = 400
ENTRY_OVERHEAD: Final = 500

#: Slots of the table of topics that the journal may contain, see `RuleQueue.last_stored`.
_TOPICS: Final = 4096

#: What is counted for a topic whose latest message is only on disk, beside its text: for what is in
#: memory here and in the store.
SINGLE_OVERHEAD: Final = 600

#: Seconds until what could not be read is read again.
READ_AGAIN: Final = 1.0

# States of an entry.
IN_FLIGHT: Final = 0
AGAIN: Final = 1  # to be sent again, at the front of its rule
LATER: Final = 2  # to be sent again at a time
GONE: Final = 3


class HeldSegment:
    """A segment of the journal from which records are in memory or were handed out.

    Those before `next` were handed out, those before `loaded` were read, of which the rest is in
    memory; `size` is the bytes of those before `loaded`. Those before `done` are settled, and of
    those behind it `settled`.
    """

    __slots__ = ("done", "loaded", "next", "segment", "settled", "size")

    def __init__(self, segment: Segment, start: int, size: int) -> None:
        self.segment = segment
        self.next = self.loaded = self.done = start
        self.size = size
        self.settled: set[int] = set()

    def first(self) -> int:
        """The index of the first record that is in memory, `loaded` if none is: behind those that
        were handed out, and those of the rest of the segment that were lost."""
        index = self.next
        if self.settled or index < self.done:
            index = max(index, self.done)
            while index in self.settled:
                index += 1
        return index


class Entry:
    """A message handed out by `Backlog.next`, until it is settled, set aside or tried again.

    `qos` is that of the PUBLISH to be sent, 0 or 1. `expiry` is its Message Expiry Interval.
    `published_at` is when it was published, in seconds of the journal's clock, if that is over a
    second ago. `attempts` says how often it was handed out, this time included, and `refused` how
    often the fleet's broker has refused it, not for want of room.
    """

    __slots__ = (
        "attempts",
        "expiry",
        "index",
        "key",
        "part",
        "published_at",
        "qos",
        "queue",
        "record",
        "refused",
        "size",
        "state",
        "value",
    )

    def __init__(self, queue: RuleQueue, record: Record, size: int) -> None:
        self.queue = queue
        self.record = record
        #: Bytes of the encoded record.
        self.size = size
        self.qos = queue.qos
        self.expiry: int | None = None
        self.published_at: float | None = None
        self.attempts = 0
        self.refused = 0
        self.state = IN_FLIGHT
        #: Where it is stored: in the journal, as a row of its own, or not at all.
        self.part: HeldSegment | None = None
        self.index = 0
        self.key: int | None = None
        #: What it was before, when it counts only as long as it is the latest one of its topic.
        self.value: LatestValue | None = None

    @property
    def topic(self) -> str | None:
        """Its topic, when it counts only as long as it is the latest one of it."""
        return None if self.value is None else self.value.topic


class RuleQueue:
    """The messages of one rule, waiting or in flight.

    They leave in this order: `again`, then `waiting`, then the rest of the journal. Beside these
    are `latest`, by topic, and `live`, which is forgotten when the connection ends.
    """

    def __init__(self, rule: OutRule) -> None:
        self.name = rule.local_filter
        self.encoded_name = self.name.encode()
        self.use(rule)
        #: False when the configuration does not contain the rule any more.
        self.configured = True
        self.bucket: TokenBucket | None = None
        #: How many more of its messages may be handed out on this connection.
        self.passes = math.inf
        #: Messages that wait or are in flight, and their bytes.
        self.messages = 0
        self.bytes = 0
        #: Of `messages`, those that are to be tried again at a time.
        self.later = 0

        self.journal: Journal | None = None
        #: The number of its journal.
        self.number = -1
        #: Of `messages`, those in the journal.
        self.stored = 0
        #: Whether a part of the journal is only on disk.
        self.behind = False
        self.waiting: deque[bytes] = deque()
        #: Bytes of memory of these.
        self.loaded = 0
        #: The segments of which records are in `waiting`, and the last one that was read.
        self.held: deque[HeldSegment] = deque()
        self.last: HeldSegment | None = None
        #: The segment that is being read, and records that were appended meanwhile, if it is the
        #: last one: segment, index, record; None if they are too many.
        self.reading: Segment | None = None
        self.arriving: list[tuple[Segment, int, bytes]] | None = None
        self.arriving_size = 0
        #: The next record of the segment that was read last had no room in memory.
        self.has_large_next = False
        #: Reading failed; it is tried again at `read_at`.
        self.read_failed = False
        self.read_at = 0.0
        #: The last segment to which a record was appended that is not in memory.
        self.spilled: Segment | None = None

        self.again: deque[Entry] = deque()
        self.latest = LatestValues()
        #: Of them, those that are being read or were.
        self.values_read = 0
        #: Reading one failed; it is tried again at `values_at`.
        self.values_failed = False
        self.values_at = 0.0
        #: The value that goes before the first record in `waiting`, and is only on disk.
        self.held_up_by: LatestValue | None = None
        #: By topic: the newest entry of it that is not settled.
        self.newest: dict[str, Entry] = {}
        self.live: deque[bytes] = deque()

        #: By the hash of a topic: the number of the last record of it in the journal. Records up
        #: to `emptied` are not there any more.
        self._topics: array[int] | None = None
        self._emptied = 0

    def use(self, rule: OutRule) -> None:
        """Follow the rule as it is from now on."""
        self.rule = rule
        self.lane = rule.lane
        self.mixed = rule.keep == "auto"
        #: The most QoS of what is sent.
        self.qos = 0 if rule.qos == 0 else 1
        #: By QoS and retain: how a message waits.
        self.kept = tuple(rule.kept(qos, retain) for qos in range(3) for retain in (False, True))

    # --- order within a topic -------------------------------------------------------------------

    def note_topic(self, topic: str, number: int) -> None:
        """A record of the topic was appended to the journal."""
        if self._topics is None:
            self._topics = array("Q", bytes(8 * _TOPICS))
        self._topics[hash(topic) % _TOPICS] = number

    def last_stored(self, topic: str) -> int:
        """The number up to which the journal may contain records of the topic that are not settled,
        which a newer one may not overtake; 0 if it contains none."""
        if not self.stored or self._topics is None:
            return 0
        number = self._topics[hash(topic) % _TOPICS]
        return number if number > self._emptied else 0

    def note_restored(self, number: int) -> None:
        """The journal has records of any topic, up to this number."""
        self._topics = array("Q", [number]) * _TOPICS

    def first_number_stored(self) -> float:
        """A number below which nothing of `again` and the journal waits; infinity without any."""
        self.skip_gone()
        if self.again:
            return 0
        if self.waiting:
            return record_times(self.waiting[0])[0]
        return 0 if self.behind else math.inf

    def latest_before(self) -> LatestValue | None:
        """The value that is to be sent before the first record in `waiting`: it was published
        before, for the same topic. (MQTT does not order QoS 0 and others.)"""
        data = self.waiting[0]
        try:
            value = self.latest.get(record_topic(data))
        except ValueError:
            return None
        if value is None or not value.qos or value.number > record_times(data)[0]:
            return None
        return value

    def is_held_up(self) -> bool:
        """Whether the first record in `waiting` has to wait until a value was read."""
        value = self.held_up_by
        if value is None:
            return False
        if value.data is None and self.latest.get(value.topic) is value:
            return True
        self.held_up_by = None
        return False

    # --- the journal ----------------------------------------------------------------------------

    def keep(self, segment: Segment, data: bytes) -> None:
        """Keep an appended or read record in memory: the next one after those in `waiting`."""
        last = self._last_of(segment, len(data))
        last.loaded += 1
        last.size += len(data)
        self.waiting.append(data)
        self.loaded += len(data) + LOADED_OVERHEAD

    def keep_rest(self, segment: Segment, records: list[bytes], first: int, share: int) -> bool:
        """`keep` the records of a segment from that one on; False if they exceed the memory."""
        rest = records[first:] if first else records
        size = sum(map(len, rest))
        memory = size + len(rest) * LOADED_OVERHEAD
        if not rest or self.loaded + memory > share:
            return False
        last = self._last_of(segment, len(rest[0]))
        last.loaded += len(rest)
        last.size += size
        self.waiting.extend(rest)
        self.loaded += memory
        return True

    def _last_of(self, segment: Segment, size: int) -> HeldSegment:
        """What is held of a segment whose next record, of that size, is about to be kept."""
        last = self.last
        if last is None or last.segment is not segment:
            # Whatever it had before is settled, and was in memory before the last restart.
            start = segment.done
            last = self._hold(segment, start, segment.size - size if start else 0)
        return last

    def _hold(self, segment: Segment, start: int, size: int) -> HeldSegment:
        self.last = held = HeldSegment(segment, start, size)
        self.held.append(held)
        if self.spilled is segment:
            self.spilled = None  # it is in memory now, and is not to be released
        return held

    def spill(self, segment: Segment) -> None:
        """An appended record is only on disk."""
        self.behind = True
        if (
            segment is not self.spilled
            and segment is not self.reading
            and (self.last is None or segment is not self.last.segment)
        ):
            # Not while its records may yet be kept in memory: it would be merged under them.
            is_arriving = any(place is self.spilled for place, _, _ in self.arriving or ())
            if self.spilled is not None and self.journal is not None and not is_arriving:
                self.journal.release(self.spilled)
            self.spilled = segment

    def unread(self) -> Segment | None:
        """The first segment that is not completely read."""
        assert self.journal is not None
        segments = self.journal.segments()
        last = self.last
        first = 0
        if last is not None:
            if last.loaded < last.segment.count:
                return last.segment
            first = bisect_right(segments, last.segment.key, key=attrgetter("key"))
        for place in range(first, len(segments)):
            segment = segments[place]
            if segment.done < segment.count:
                return segment
        return None

    def start_reading(self, segment: Segment) -> None:
        """The segment is going to be read."""
        assert self.journal is not None
        self.reading = segment
        self.has_large_next = False
        if self.spilled is segment:
            self.spilled = None
        self.arriving = [] if self.journal.segments()[-1] is segment else None
        self.arriving_size = 0

    def stop_reading(self) -> list[tuple[Segment, int, bytes]]:
        """What was appended since `start_reading`, if it is in memory."""
        arrived = self.arriving or []
        self.reading = None
        self.arriving = None
        return arrived

    def begin(self, segment: Segment, records: list[bytes]) -> tuple[int, int]:
        """The segment was read: the index of the first record to be kept in memory, and by how much
        the bytes of its records were underestimated."""
        last = self.last
        if last is not None and last.segment is segment:
            return last.loaded, 0
        done = segment.done
        last = self._hold(segment, done, sum(map(len, records[:done])))
        return done, segment.size - last.size - size_left(segment)

    def pop_waiting(self) -> tuple[bytes, HeldSegment, int]:
        """Take the oldest record in memory: itself, and where it is stored."""
        data = self.waiting.popleft()
        self.loaded -= len(data) + LOADED_OVERHEAD
        part = self.held[0]
        index = part.next
        if index == part.loaded or index < part.done or part.settled:
            while (index := part.first()) == part.loaded:
                self.held.popleft()
                part = self.held[0]
        part.next = index + 1
        return data, part, index

    def settle(self, part: HeldSegment, index: int) -> None:
        """A record of the journal needs to be sent no more."""
        self.stored -= 1
        if index != part.done:
            part.settled.add(index)
            return
        part.done = index + 1
        if part.settled:
            self._advance(part)
        assert self.journal is not None
        self.journal.settle(part.segment, part.done)

    def settled(self, part: HeldSegment, count: int) -> None:
        """The last so many records before `part.done` need to be sent no more."""
        self.stored -= count
        assert self.journal is not None
        self.journal.settle(part.segment, part.done)

    def _advance(self, part: HeldSegment) -> None:
        done = part.done
        while done in part.settled:
            part.settled.remove(done)
            done += 1
        part.done = done

    def empty(self, number: int) -> None:
        """Nothing up to this number is in the journal any more."""
        self._emptied = number

    def drop_unread(self, segment: Segment | None) -> tuple[int, int]:
        """Drop what is not in memory of the oldest segment of which something is not: the number of
        its records, and their bytes."""
        assert self.journal is not None
        self.has_large_next = False
        if segment is None:
            self.behind = False
            return 0, 0
        if self.reading is segment:
            self.stop_reading()
        last = self.last
        if last is not None and last.segment is segment:
            count, size = segment.count - last.loaded, segment.size - last.size
            last.settled.update(range(last.loaded, segment.count))
            last.loaded = segment.count
            last.size = segment.size
            self._advance(last)
            self.journal.settle(segment, last.done)
        else:
            count, size = segment.count - segment.done, size_left(segment)
            self.journal.drop(segment)
            if self.spilled is segment:
                self.spilled = None
        self.stored -= count
        self.behind = self.unread() is not None
        return count, size

    # --- the oldest -------------------------------------------------------------------------------

    def skip_gone(self) -> None:
        """Forget entries at the front that were replaced meanwhile."""
        while self.again and self.again[0].state == GONE:
            self.again.popleft()

    def first_number(self) -> int:
        """The number of the first record in `again` or `waiting`."""
        if self.again:
            return self.again[0].record.number
        return record_times(self.waiting[0])[0]

    def first_live_number(self) -> int | None:
        """The number of the first record in `latest` or `live` that can be handed out."""
        for value in self.latest.ready.values():
            if value.data is not None:
                return value.number
            break
        return record_times(self.live[0])[0] if self.live else None

    def oldest_stored(self) -> float | None:
        """When the oldest message was published, among those that can be dropped of `again` and
        of the journal."""
        self.skip_gone()
        if self.again:
            return self.again[0].record.stored_at
        if self.waiting:
            return record_times(self.waiting[0])[1]
        segment = self.unread() if self.behind else None
        return None if segment is None else segment.first_at

    def oldest_live(self) -> float | None:
        """When the first message of `latest` or `live` was published."""
        value = self.latest.oldest()
        if value is not None:
            return value.stored_at
        return record_times(self.live[0])[1] if self.live else None


def size_left(segment: Segment) -> int:
    """About the bytes of a segment's records that are not settled."""
    return segment.size * (segment.count - segment.done) // max(1, segment.count)
