"""Messages that the fleet's broker had no room for (0x97): they are sent again after a while."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from typing import Final

from appliance.upstream.rule_queue import ENTRY_OVERHEAD, LATER, Entry

#: Seconds until a message is tried again; doubled each time up to the second value.
FIRST_RETRY: Final = 1.0
LONGEST_RETRY: Final = 60.0


class Retries:
    """The messages of a link that are to be tried again, each at its time.

    An entry is here while its `state` is LATER.
    """

    def __init__(self) -> None:
        #: When, number, entry; with entries that are not here any more.
        self._heap: list[tuple[float, int, Entry]] = []
        self.count = 0
        #: Bytes of their memory.
        self.size = 0

    def __iter__(self) -> Iterator[Entry]:
        return (entry for _, _, entry in self._heap if entry.state == LATER)

    def add(self, entry: Entry, now: float) -> None:
        """It is tried again after a time that grows with its attempts."""
        entry.state = LATER
        self._count(entry, 1)
        delay = min(LONGEST_RETRY, FIRST_RETRY * 2 ** min(entry.attempts - 1, 10))
        heapq.heappush(self._heap, (now + delay, entry.record.number, entry))

    def remove(self, entry: Entry) -> None:
        """It is not to be tried again; the caller sets its state."""
        self._count(entry, -1)

    def pop(self, now: float) -> Entry | None:
        """Take one that is to be tried now; the caller sets its state."""
        due = self.due()
        if due is None or due > now:
            return None
        entry = heapq.heappop(self._heap)[2]
        self._count(entry, -1)
        return entry

    def due(self) -> float | None:
        """When the first one is to be tried again; None without any."""
        heap = self._heap
        while heap and heap[0][2].state != LATER:
            heapq.heappop(heap)
        return heap[0][0] if heap else None

    def _count(self, entry: Entry, count: int) -> None:
        self.count += count
        self.size += count * (entry.size + ENTRY_OVERHEAD)
        entry.queue.later += count
