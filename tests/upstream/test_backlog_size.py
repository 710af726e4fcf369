"""The memory and the time that a backlog takes."""

from __future__ import annotations

import gc
import time
import tracemalloc
from collections import deque
from collections.abc import Callable

import pytest

from appliance.store.memory_backlogs import MemoryBacklogs
from appliance.upstream.backlog import Backlog
from upstream.test_backlog import Link, rule

MIB = 1 << 20


def allocated() -> int:
    """Bytes of memory that the backlog has allocated; the journals in the tests hold nothing."""
    gc.collect()
    own = [tracemalloc.Filter(True, "*/appliance/upstream/*")]
    taken = tracemalloc.take_snapshot().filter_traces(own)
    return sum(each.size for each in taken.statistics("filename"))


@pytest.mark.parametrize("size", [10, 1_000, 100_000])
def test_little_of_what_waits_is_in_memory(size: int) -> None:
    link = Link(rule("a"), rule("b", priority="low"), size=1 << 40)
    for number in range(min(12_000, 12 * MIB // size)):
        link.offer(bytes(size), f"t{number}", of=number % 2)
    link.backlogs.commit()
    link.restart()
    tracemalloc.start()
    try:
        flying = len(link.take())
        taken = allocated()
    finally:
        tracemalloc.stop()
    assert flying > 5_000 or flying * size > 2 * MIB or (size == 1_000 and flying > 1_500)
    assert taken < 4.5 * MIB, taken


def test_the_latest_of_many_topics_are_bounded() -> None:
    link = Link(rule(), online=False)
    tracemalloc.start()
    try:
        for number in range(20_000):
            link.offer(bytes(300), f"fleet/state/{number}", qos=0, user="user")
        taken = allocated()
    finally:
        tracemalloc.stop()
    # Of most of them the topic alone is in memory.
    stored = link.backlogs.single_records.rows.values()
    assert len(stored) > 10_000
    assert taken - sum(map(len, stored)) < 11 * MIB, taken
    assert link.counts().waiting == 20_000


@pytest.mark.timed
def test_a_message_costs_little() -> None:
    """Offered, handed out and settled, as a multiple of what plain Python does meanwhile."""
    rounds: deque[Callable[[], None]] = deque()
    link = Link()
    now = link.backlogs.time
    backlogs = MemoryBacklogs(rounds.append, lambda: now)
    backlog = Backlog("f", backlogs, link.rules, link.limits, now, link.wake)
    payload = bytes(200)

    def batch() -> None:
        for _ in range(1000):
            backlog.offer(link.rules[0], "fleet/r/t", payload, 1, False, b"\0", None, now)
        entries = []
        while (entry := backlog.next(now)) is not None:
            entries.append(entry)
        assert len(entries) == 1000
        for entry in entries:
            backlog.settle(entry)

    def plain() -> None:
        for number in range(1000):
            for _ in range(100):
                number += 1

    def best(work: Callable[[], None]) -> float:
        times = []
        for _ in range(20):
            began = time.process_time()
            work()
            times.append(time.process_time() - began)
        return min(times)

    assert best(batch) < 8 * best(plain)
