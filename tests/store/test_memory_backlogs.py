"""The backlogs of links to other brokers in memory, for `durability: off`."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable

from broker.conftest import FakeAccess
from waiting import until

from appliance.broker.backlogs import NO_MESSAGE, SEGMENT_SIZE, Backlogs, Segment
from appliance.broker.broker import Broker
from appliance.store import MemoryStore
from appliance.store.memory_backlogs import MemoryBacklogs


class Memory:
    """Backlogs whose event loop's rounds are run by hand."""

    def __init__(self) -> None:
        self.time = 0.0
        self.rounds: deque[Callable[[], None]] = deque()
        self.backlogs: Backlogs = MemoryBacklogs(self.rounds.append, lambda: self.time)

    def read(self, segment: Segment) -> list[bytes]:
        found: list[object] = []
        self.backlogs.journal("fleet", 0).read(segment, found.append)
        assert not found
        self.rounds.popleft()()
        (records,) = found
        assert isinstance(records, list)
        return records


def test_records_are_read_in_order() -> None:
    memory = Memory()
    journal = memory.backlogs.journal("fleet", 0)
    records = [bytes([number % 256]) * 1000 for number in range(600)]
    for record in records:
        segment = journal.append(record)
        assert memory.read(segment)[segment.count - 1] == record
        memory.time += 1
    segments = journal.segments()
    assert [record for each in segments for record in memory.read(each)] == records
    assert [each.count for each in segments] == [262, 262, 76]
    assert all(each.size == 1000 * each.count <= SEGMENT_SIZE for each in segments)
    assert [(each.first_at, each.last_at) for each in segments] == [
        (0, 261),
        (262, 523),
        (524, 599),
    ]
    assert [each.key for each in segments] == sorted({each.key for each in segments})
    assert memory.backlogs.journal("fleet", 0) is journal


def test_what_is_settled_goes() -> None:
    memory = Memory()
    journal = memory.backlogs.journal("fleet", 0)
    first = journal.append(bytes(SEGMENT_SIZE))
    journal.settle(first, 1)
    assert list(journal.segments()) == [first]  # it may still grow
    second = journal.append(b"second")
    assert list(journal.segments()) == [second]
    third = journal.append(bytes(SEGMENT_SIZE))
    journal.settle(second, 1)
    assert list(journal.segments()) == [third]
    journal.drop(third)
    journal.drop(third)
    journal.settle(third, 1)
    assert not journal.segments() and not memory.read(third)


def test_a_record_may_be_large() -> None:
    journal = Memory().backlogs.journal("fleet", 0)
    sizes = (1, SEGMENT_SIZE + 1, 1)
    segments = [journal.append(bytes(size)) for size in sizes]
    assert [each.size for each in segments] == list(sizes)


def test_lanes_and_links_are_apart() -> None:
    memory = Memory()
    backlogs = memory.backlogs
    for link in ("b", "a"):
        for lane in (0, 1):
            backlogs.journal(link, lane).append(f"{link}{lane}".encode())
    key = backlogs.latest("c").put(None, b"one")
    backlogs.aside("d").put(None, b"two")
    assert backlogs.latest("c").put(key, b"three") == key
    assert backlogs.latest("c").load() == [(key, b"three")]
    assert backlogs.waiting_links() == ["a", "b", "c"]  # what is set aside is not sent
    backlogs.forget("a")
    backlogs.forget("d")
    assert backlogs.waiting_links() == ["b", "c"] and not backlogs.aside("d").load()
    backlogs.latest("c").remove(key)
    backlogs.latest("c").remove(key)
    assert backlogs.waiting_links() == ["b"]
    assert not backlogs.failing
    single = backlogs.single("e")
    one, two = single.put(b"one"), single.put(b"two")
    assert single.load() == [one, two] and backlogs.waiting_links() == ["b", "e"]
    read: list[object] = []
    single.read(two, read.append)
    single.remove(one)
    single.read(one, read.append)
    while memory.rounds:
        memory.rounds.popleft()()
    assert read == [[b"two"], []]
    backlogs.forget("e")
    assert backlogs.waiting_links() == ["b"]
    for lane in (0, 1):
        journal = backlogs.journal("b", lane)
        journal.settle(journal.segments()[0], 1)
    backlogs.latest("b").put(None, NO_MESSAGE + b"{}")
    assert not backlogs.waiting_links()


async def test_a_fault_of_the_reader_is_contained(escaped: list[str]) -> None:
    """The entry "store.read"."""
    store = MemoryStore()
    store.open()
    broker = Broker(FakeAccess(), store)
    store.restore(broker)
    journal = store.backlogs.journal("fleet", 0)
    segment = journal.append(b"record")
    assert journal.now() > 1e9

    def fails(records: list[bytes] | Exception) -> None:
        raise AssertionError(records)

    journal.read(segment, fails)
    await until(lambda: broker.faults.count, "the fault")
    assert broker.faults.by_entry == {"store.read": 1}
    escaped.clear()
    read: asyncio.Future[object] = asyncio.get_running_loop().create_future()
    journal.read(segment, read.set_result)
    assert await read == [b"record"]
    await store.close()
