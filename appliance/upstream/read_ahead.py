"""The next records of a link's journals, which are in memory before they are sent.

All rules together have `LOADED_SIZE` of them; the others are on disk alone.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import Final

from appliance.broker.backlogs import RecordsLostError, Segment
from appliance.upstream.backlog_counts import Tally
from appliance.upstream.rule_queue import (
    LOADED_OVERHEAD,
    READ_AGAIN,
    HeldSegment,
    RuleQueue,
)

log = logging.getLogger(__name__)

KIB: Final = 1024
MIB: Final = 1024 * KIB

#: Bytes of memory of the records that were read, and those that a rule has at least, however many
#: rules there are. What is not `Final` here tests replace, also in the compiled build.
LOADED_SIZE = 5 * MIB // 4
LOADED_SHARE = 32 * KIB

#: Messages of a rule that wait to be tried again (0x97); with more, no other of that rule is sent
#: until one is due. Other rules go on: the fleet's broker may refuse one user's topics only.
MOST_LATER = 100


class ReadAhead:
    """Reads the journals of a link's rules, as far as there is memory.

    `lost` is told of a segment that cannot be read any more, `wake` is called when one was read.
    """

    def __init__(
        self,
        name: str,
        tally: Tally,
        lost: Callable[[RuleQueue, Segment], None],
        wake: Callable[[], None],
    ) -> None:
        self._name = name
        self._tally = tally
        self._lost = lost
        self._wake = wake
        #: Bytes of read records that each rule may have in memory.
        self._share = LOADED_SIZE
        #: The rule that has a record in memory which exceeds its share.
        self._oversized: RuleQueue | None = None

    def divide(self, rules: int) -> None:
        """Give so many rules the same share of the memory."""
        self._share = max(LOADED_SHARE, LOADED_SIZE // max(1, rules))

    def is_due(self, queue: RuleQueue) -> bool:
        """Whether more of the rule's journal is to be read: less than half of its share is left."""
        return queue.behind and queue.reading is None and 2 * queue.loaded <= self._share

    def appended(self, queue: RuleQueue, segment: Segment, data: bytes) -> None:
        """Keep the last record of the segment in memory, if there is some and nothing before it is
        on disk alone."""
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

    def pop(self, queue: RuleQueue) -> tuple[bytes, HeldSegment, int]:
        """Take the oldest record in memory: itself, and where it is stored."""
        popped = queue.pop_waiting()
        self.has_taken(queue)
        return popped

    def has_taken(self, queue: RuleQueue) -> None:
        """Records were taken out of the rule's queue."""
        if self._oversized is queue:
            self._oversized = None

    def read(self, queue: RuleQueue, now: float) -> None:
        """Read the next segment of a rule's journal, if there is memory for it."""
        if queue.read_failed:
            queue.read_failed = False
            queue.read_at = now + READ_AGAIN
        if queue.read_at > now:
            return
        if queue.has_large_next and (queue.waiting or not self._may_exceed()):
            return
        segment = queue.unread()
        if segment is None:
            queue.behind = False
            return
        if segment.size > self._share and segment.count == 1 and not self._may_exceed():
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
            self._lost(queue, segment)
        elif isinstance(outcome, Exception):
            if not queue.read_at:
                log.warning("backlog of %s: cannot be read: %s", self._name, outcome)
            queue.read_failed = True
        else:
            queue.read_at = 0.0
            self._keep(queue, segment, outcome, arrived)
        self._wake()

    def _keep(
        self,
        queue: RuleQueue,
        segment: Segment,
        records: list[bytes],
        arrived: list[tuple[Segment, int, bytes]],
    ) -> None:
        """Keep of a segment what the memory allows, and what was appended while it was read."""
        first, underestimated = queue.begin(segment, records)
        self._tally.add(queue, 0, underestimated)
        if not queue.keep_rest(segment, records, first, self._share):
            for kept, data in enumerate(records[first:]):
                if not self._has_memory(queue, len(data)):
                    queue.has_large_next = not kept
                    return
                queue.keep(segment, data)
        for place, index, data in arrived:
            if place is segment and index < len(records):
                continue
            if not self._has_memory(queue, len(data)):
                return
            queue.keep(place, data)
        queue.behind = queue.unread() is not None

    def _has_memory(self, queue: RuleQueue, size: int) -> bool:
        """Whether a record of this size may be read now."""
        if queue.loaded + size + LOADED_OVERHEAD <= self._share:
            return True
        if queue.waiting or not self._may_exceed():
            return False
        self._oversized = queue
        return True

    def _may_exceed(self) -> bool:
        """Whether a rule may have a record in memory that exceeds its share.

        One has: the others wait until that is sent, unless its rule is itself made to wait.
        """
        owner = self._oversized
        return (
            owner is None
            or not owner.passes
            or owner.later >= MOST_LATER
            or owner.bucket is not None
        )
