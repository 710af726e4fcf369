"""The journals of links to other brokers: in the store's transactions, against a plain list."""

from __future__ import annotations

import asyncio
import random
import sqlite3
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio
from waiting import until

from appliance.broker.backlogs import NO_MESSAGE, SEGMENT_SIZE, Journal, RecordsLostError, Segment
from appliance.mqtt.codec import NO_PROPERTIES
from appliance.net.callbacks import Entries
from appliance.store import StoreError, committer
from appliance.store import journal as journal_module
from appliance.store.inspection import export, prune, prune_retained, prune_upstream, summarise
from appliance.store.journal import SMALL
from appliance.upstream.backlog import Backlog
from appliance.upstream.live_messages import LATEST_SIZE
from appliance.upstream.rules import BacklogLimits, OutRule
from store.harness import Harness


@pytest_asyncio.fixture
async def harness(tmp_path: Path) -> AsyncIterator[Harness]:
    harness = Harness(tmp_path / "first").start()
    yield harness
    await harness.stop()


LATEST_RULE = OutRule("#", "r/", "fleet/", "latest")


def opened(harness: Harness, link: str = "fleet", lane: int = 0) -> Journal:
    return harness.store.backlogs.journal(link, lane)


async def read(journal: Journal, segment: Segment) -> list[bytes] | Exception:
    outcome: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
    journal.read(segment, outcome.set_result)
    assert not outcome.done()
    return await asyncio.wait_for(outcome, 30)  # type: ignore[no-any-return]


async def unsettled(journal: Journal) -> list[bytes]:
    """All records that are not settled, in order."""
    found: list[bytes] = []
    place = 0
    while place < len(journal.segments()):  # those that are not held may be merged meanwhile
        segment = journal.segments()[place]
        records = await read(journal, segment)
        assert isinstance(records, list), records
        assert len(records) == segment.count
        assert sum(map(len, records)) == segment.size
        found += records[segment.done :]
        place += 1
    for segment in list(journal.segments()):
        journal.release(segment)
    return found


def keys(harness: Harness, table: str) -> list[int]:
    with sqlite3.connect(f"file:{harness.path}?mode=ro", uri=True) as connection:
        found = [key for (key,) in connection.execute(f"SELECT id FROM {table} ORDER BY id")]
    connection.close()
    return found


async def test_a_batch_is_a_segment(harness: Harness) -> None:
    journal = opened(harness)
    sizes = (10, 100, 1000)
    for number in range(5):
        for size in sizes:
            journal.append(bytes([number]) * size)
        await harness.written()
    assert [segment.count for segment in journal.segments()] == [3] * 5
    assert keys(harness, "segment") == keys(harness, "backlog")
    assert keys(harness, "segment") == [segment.key for segment in journal.segments()]
    assert await unsettled(journal) == [
        bytes([number]) * size for number in range(5) for size in sizes
    ]


async def test_much_of_which_nobody_waits_for_anything_is_written_at_once(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(committer, "LINGER", 1000.0)
    await harness.written()
    backlogs, journal = harness.store.backlogs, opened(harness)
    journal.append(bytes(1000), awaited=False)
    assert backlogs.unwritten == 1000
    for _ in range(3):
        journal.append(bytes(committer.LARGE // 2), awaited=False)
    backlogs.single("fleet").put(bytes(500), awaited=False)
    assert backlogs.unwritten == 1500 + 3 * committer.LARGE // 2
    await until(lambda: not backlogs.unwritten, "the commit")
    for _ in range(3):  # as much as this while it is written is written next
        journal.append(bytes(committer.LARGE // 2), awaited=False)
        harness.store._committer.commit()
        journal.append(bytes(committer.LARGE), awaited=False)
        assert backlogs.unwritten == 3 * committer.LARGE // 2
        await until(lambda: not backlogs.unwritten, "both commits")


async def test_neighbours_are_merged_that_come_one_by_one(harness: Harness) -> None:
    """As from a backlog: the last segment is released when the next one is there."""
    journal = opened(harness)
    last: Segment | None = None
    for number in range(60):
        segment = journal.append(bytes([number]) * 10_000)
        if last is not None:
            journal.release(last)
        last = segment
        await harness.written()
    await until(lambda: len(journal.segments()) < 25, "merges")
    assert await unsettled(journal) == [bytes([number]) * 10_000 for number in range(60)]


async def test_a_large_batch_is_several(harness: Harness) -> None:
    journal = opened(harness)
    records = [bytes([number]) * 50_000 for number in range(20)]
    records[10] = bytes(SEGMENT_SIZE * 3)
    for record in records:
        segment = journal.append(record)
        assert (await read(journal, segment))[segment.count - 1] == record  # type: ignore[index]
    await harness.written()
    segments = list(journal.segments())
    assert [segment.count for segment in segments] == [5, 5, 1, 5, 4]
    assert await unsettled(journal) == records
    with pytest.raises(AttributeError):
        segments[0].size = "x"  # type: ignore[assignment, attr-defined]
        segments[0].other = 1  # type: ignore[attr-defined]


async def test_a_record_waits_for_its_commit_and_sessions_do_not_wait_for_records(
    harness: Harness,
) -> None:
    store, journal = harness.store, opened(harness)
    await harness.written()
    store.fresh = False
    segment = journal.append(b"nobody waits", awaited=False)
    assert not store.fresh and not store.staged
    journal.append(b"somebody waits")
    assert store.fresh and store.staged
    assert await read(journal, segment) == [b"nobody waits", b"somebody waits"]
    before = store.batch
    await harness.written()
    assert store.committed >= before and not store.staged
    assert store.bytes == 0
    assert await read(journal, segment) == [b"nobody waits", b"somebody waits"]


async def test_what_nobody_waits_for_is_committed_soon(harness: Harness) -> None:
    journal = opened(harness)
    segment = journal.append(b"one", awaited=False)
    journal.append(b"two", awaited=False)
    await until(lambda: keys(harness, "backlog"), "the commit of the record")
    journal.settle(segment, 1)
    await until(lambda: _done(harness) == [1], "the commit of the settled record")
    journal.settle(segment, 2)
    await until(lambda: not keys(harness, "backlog"), "the deletion")
    assert not keys(harness, "segment") and not journal.segments()


def _done(harness: Harness) -> list[int]:
    with sqlite3.connect(f"file:{harness.path}?mode=ro", uri=True) as connection:
        found = [done for (done,) in connection.execute("SELECT done FROM segment ORDER BY id")]
    connection.close()
    return found


async def test_what_was_not_committed_leaves_no_trace(harness: Harness) -> None:
    journal = opened(harness)
    first = journal.append(bytes(SEGMENT_SIZE))
    second = journal.append(b"second")
    journal.settle(first, 1)
    journal.settle(second, 1)
    assert list(journal.segments()) == [second]  # it may still grow
    third = journal.append(b"third")
    assert third is second and third.done == 1 and third.count == 2
    journal.drop(third)
    journal.drop(third)
    assert await read(journal, third) == []
    fourth = journal.append(b"fourth")
    journal.settle(fourth, 1)
    await harness.written()
    assert not journal.segments()
    assert not keys(harness, "segment") and not keys(harness, "backlog")


async def test_a_failed_commit_keeps_what_waits(
    harness: Harness, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    journal = opened(harness)
    first = journal.append(b"first")
    await harness.written()
    with monkeypatch.context() as broken:
        _break(broken, harness)
        second = journal.append(b"second")
        harness.store.hurry()
        await until(lambda: harness.store.backlogs.failing, "the store to fail")
        third = journal.append(b"third")
        assert await read(journal, second) == [b"second"]
        journal.settle(first, 1)
        journal.drop(second)
        assert list(journal.segments()) == [third]
    await until(lambda: not harness.store.backlogs.failing, "the store to go on")
    assert keys(harness, "segment") == keys(harness, "backlog") == [third.key]
    twin = harness.twin(tmp_path / "twin")
    assert await unsettled(opened(twin)) == [b"third"]
    await twin.stop()


def _break(patch: pytest.MonkeyPatch, harness: Harness) -> None:
    def write(batch: object) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    patch.setattr(harness.store._committer._writer, "_write", write)


async def test_small_neighbours_are_merged(harness: Harness, tmp_path: Path) -> None:
    journal = opened(harness)
    other = opened(harness, "other")
    records = [bytes([number]) * 5000 for number in range(100)]
    for record in records:
        journal.release(journal.append(record))
        other.append(record)
        await harness.written()
    await until(lambda: len(journal.segments()) < 30, "the merges")
    await harness.written()
    assert max(segment.size for segment in journal.segments()) >= 3 * SMALL
    assert max(segment.size for segment in journal.segments()) <= SEGMENT_SIZE
    assert len(other.segments()) == 100  # they are held
    assert await unsettled(journal) == await unsettled(other) == records
    twin = harness.twin(tmp_path / "twin")
    assert len(opened(twin).segments()) == len(journal.segments())
    assert await unsettled(opened(twin)) == records
    # What was merged is settled and deleted like any other.
    merged = max(opened(twin).segments(), key=lambda segment: segment.size)
    opened(twin).settle(merged, 7)
    await twin.written()
    again = twin.twin(tmp_path / "again")
    assert [segment.done for segment in opened(again).segments() if segment.key == merged.key] == [
        7
    ]
    opened(again).settle(next(s for s in opened(again).segments() if s.done), merged.count)
    await again.written()
    assert keys(again, "backlog") == keys(again, "segment")
    assert merged.key not in keys(again, "backlog")
    await twin.stop()
    await again.stop()


async def test_what_is_being_sent_is_not_merged(harness: Harness) -> None:
    journal = opened(harness)
    for number in range(100):
        journal.release(journal.append(bytes([number]) * 5000))
        await harness.written()
        if number == 20:
            held = journal.segments()[-1]
            assert await read(journal, held) == [bytes([20]) * 5000]
    await until(lambda: len(journal.segments()) == 61, "the merge of those behind it")
    assert held in journal.segments()
    journal.settle(held, 1)
    assert held not in journal.segments()


async def test_a_damaged_segment_is_reported_and_skipped(
    harness: Harness, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    journal = opened(harness)
    for number in range(3):
        journal.append(b"%d" % number * 20_000)
        await harness.written()
    await harness.stop()
    _spoil(harness.path, b"1" * 1000, b"x" * 1000)
    second = Harness(tmp_path / "first").start()
    journal = opened(second)
    one, two, three = list(journal.segments())
    assert await read(journal, one) == [b"0" * 20_000]
    assert isinstance(await read(journal, two), RecordsLostError)
    assert "1 messages for fleet cannot be read and are lost (the checksum is wrong)" in caplog.text
    assert list(journal.segments()) == [one, three]
    journal.drop(two)
    assert await read(journal, three) == [b"2" * 20_000]
    await second.written()
    assert two.key in keys(second, "backlog")  # until the whole file has been checked
    await second.stop()
    caplog.clear()
    third = Harness(tmp_path / "first").start()
    assert "the whole file is being checked" in caplog.text
    assert len(await unsettled(opened(third))) == 2
    opened(third).append(b"more")
    await third.written()
    assert two.key not in keys(third, "backlog") + keys(third, "segment")
    caplog.clear()
    await third.stop()
    fourth = Harness(tmp_path / "first").start()
    assert not caplog.text
    assert len(await unsettled(opened(fourth))) == 3
    await fourth.stop()


def _spoil(path: Path, old: bytes, new: bytes) -> None:
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))


async def test_the_latest_records(harness: Harness, tmp_path: Path) -> None:
    latest = harness.store.backlogs.latest("fleet")
    first = latest.put(None, b"one")
    second = latest.put(None, b"two", awaited=False)
    aside = harness.store.backlogs.aside("fleet").put(None, b"poison")
    await harness.written()
    assert latest.put(first, b"three") == first
    latest.remove(second)
    latest.remove(second)
    await harness.written()
    assert latest.load() == [(first, b"three")]
    twin = harness.twin(tmp_path / "twin")
    backlogs = twin.store.backlogs
    assert backlogs.latest("fleet").load() == [(first, b"three")]
    assert backlogs.aside("fleet").load() == [(aside, b"poison")]
    backlogs.journal("other", 2).append(b"x")
    assert backlogs.waiting_links() == ["fleet", "other"]
    backlogs.forget("fleet")
    assert backlogs.waiting_links() == ["other"]
    await twin.written()
    assert not keys(twin, "latest")
    backlogs.forget("other")
    await twin.written()
    assert not keys(twin, "backlog") and not backlogs.waiting_links()
    await twin.stop()


async def test_a_fault_where_records_are_taken_is_contained(
    harness: Harness, escaped: list[str]
) -> None:
    journal = opened(harness)
    segment = journal.append(b"record")

    def fails(records: object) -> None:
        raise AssertionError(records)

    for fault in range(1, 10):
        journal.read(segment, fails)
        await until(lambda count=fault: harness.broker.faults.count == count, "the fault")
        await harness.written()
    assert harness.broker.faults.by_entry == {"store.read": 9}
    assert await read(journal, segment) == [b"record"]
    escaped.clear()


async def _all_written(harness: Harness) -> None:
    """`Harness.written`, also when the last commit has failed and will be tried again."""
    while harness.store.failing or not harness.store._committer.is_idle:
        await harness.written()
        await asyncio.sleep(0.001)


@pytest.mark.parametrize("is_committed", [True, False])
async def test_a_fault_before_records_are_taken_is_an_outcome(
    harness: Harness, escaped: list[str], monkeypatch: pytest.MonkeyPatch, is_committed: bool
) -> None:
    """Or what waits for the records would wait for ever."""
    journal = opened(harness)
    segment = journal.append(b"record")
    if is_committed:
        await harness.written()
    own, faults = Entries.run, harness.broker.faults

    def run(self: Entries, entry: str, *args: Any) -> None:
        if entry == "store.read" and not faults.count:

            def fails(*args: object) -> None:
                raise AssertionError(entry)

            own(self, entry, args[0], args[1], fails, ())
        else:
            own(self, entry, *args)

    monkeypatch.setattr(Entries, "run", run)
    outcomes = [await read(journal, segment) for _ in range(5)]
    assert isinstance(outcomes[0], RuntimeError)
    assert outcomes[1:] == [[b"record"]] * 4
    assert faults.by_entry == {"store.read": 1}
    assert harness.store.backlogs._reader is not None
    assert harness.store.backlogs._reader._running == 0
    escaped.clear()


async def _single(harness: Harness, key: int) -> list[bytes] | Exception:
    outcome: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
    harness.store.backlogs.single("fleet").read(key, outcome.set_result)
    assert not outcome.done()
    return await asyncio.wait_for(outcome, 30)  # type: ignore[no-any-return]


async def test_records_that_are_read_one_by_one(harness: Harness, tmp_path: Path) -> None:
    records = harness.store.backlogs.single("fleet")
    found = [records.put(bytes([number]) * 1000) for number in range(5)]
    assert await _single(harness, found[1]) == [b"\1" * 1000]  # not committed
    records.remove(found[0])
    await harness.written()
    assert not records._uncommitted
    records.remove(found[1])
    records.remove(found[1])
    for key in found[:2]:
        assert await _single(harness, key) == []
    assert await _single(harness, found[2]) == [b"\2" * 1000]
    later = records.put(b"x" * 1000, awaited=False)
    await harness.written()
    assert keys(harness, "backlog") == keys(harness, "segment") == [*found[2:], later]
    twin = harness.twin(tmp_path / "twin")  # as after a kill
    again = twin.store.backlogs.single("fleet")
    assert again.load() == [*found[2:], later]
    assert await _single(twin, found[3]) == [b"\3" * 1000]
    assert await _single(twin, later) == [b"x" * 1000]
    assert twin.store.backlogs.waiting_links() == ["fleet"]
    assert not twin.store.backlogs.journal("fleet", 0).segments()
    twin.store.backlogs.forget("fleet")
    await twin.written()
    assert not again.load() and not keys(twin, "backlog") and not keys(twin, "segment")
    await twin.stop()


async def test_a_damaged_record_that_is_read_by_itself_is_reported(
    harness: Harness, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    records = harness.store.backlogs.single("fleet")
    found = [records.put(text * 1000) for text in (b"1", b"2")]
    await harness.stop()
    _spoil(harness.path, b"1" * 1000, b"x" * 1000)
    again = Harness(tmp_path / "first").start()
    assert isinstance(await _single(again, found[0]), RecordsLostError)
    assert await _single(again, found[1]) == [b"2" * 1000]
    assert await _single(again, found[0]) == []
    assert again.store.backlogs.single("fleet").load() == found[1:]
    assert "IS DAMAGED: a message for fleet" in caplog.text
    await again.stop()


async def test_what_waits_is_shown_and_pruned(harness: Harness) -> None:
    for lane in range(2):
        for number in range(10):
            segment = opened(harness, lane=lane).append(bytes(number))
    opened(harness, lane=1).settle(segment, 3)
    harness.store.backlogs.latest("fleet").put(None, b"latest")
    harness.store.backlogs.latest("fleet").put(None, NO_MESSAGE)
    harness.store.backlogs.aside("fleet").put(None, b"poison")
    harness.store.backlogs.single("fleet").put(b"single")
    opened(harness, "other").append(b"x")
    await harness.written()
    shown = summarise(harness.path)
    waiting = [(each.link, each.lane, each.messages, each.size) for each in shown.backlogs]
    assert waiting == [
        *(("fleet", 0, 10, 45), ("fleet", 1, 7, 45), ("fleet", "latest", 1, 12)),
        *(("fleet", "set aside", 1, 6), ("other", 0, 1, 1)),
    ]
    dated = [each.oldest for each in shown.backlogs if isinstance(each.lane, int)]
    assert all(abs((each or 0) - time.time()) < 100 for each in dated)
    exported = [line for line in export(harness.path) if "upstream" in line]
    assert [(each["upstream"], each["messages"]) for each in exported] == [
        *(("fleet", 10), ("fleet", 7), ("fleet", 1), ("fleet", 1), ("other", 1))
    ]
    with pytest.raises(StoreError, match="stop the appliance"):
        prune_upstream(harness.path, "fleet")
    await harness.stop()
    assert prune_upstream(harness.path, "fleet") == 19
    with pytest.raises(StoreError, match="nothing waits for an upstream 'fleet'"):
        prune_upstream(harness.path, "fleet")
    harness.start()
    assert harness.store.backlogs.waiting_links() == ["other"]
    assert await unsettled(opened(harness, "other")) == [b"x"]


def backlog(harness: Harness, name: str) -> Backlog:
    """The backlog of a link, which has one rule."""
    backlogs = harness.store.backlogs
    now = backlogs.journal(name, 0).now()
    return Backlog(name, backlogs, [LATEST_RULE], BacklogLimits(), now, lambda: None)


async def drained(waiting: Backlog) -> dict[str, bytes]:
    """What waits, by topic."""
    found: dict[str, bytes] = {}

    def is_drained() -> bool:
        while (entry := waiting.next(1e9)) is not None:
            found[entry.record.topic] = entry.record.payload
            waiting.settle(entry)
        return not waiting.counts().waiting

    waiting.connected()
    await until(is_drained, "all to be read and handed out")
    return found


async def test_values_that_are_only_on_disk_are_shown_and_pruned(harness: Harness) -> None:
    """A state that memory has no room for is a row that says what it is, and another one."""
    size = LATEST_SIZE // 3
    values = {f"t{number}": b"%d" % number + bytes(size) for number in range(6)}
    for name in ("fleet", "other"):
        waiting = backlog(harness, name)
        for number in range(2):  # the second time in place of the first
            for topic, value in values.items():
                payload = value if number else bytes(size)
                waiting.offer(LATEST_RULE, topic, payload, 1, False, NO_PROPERTIES, None, 0.0)
                await harness.written()
        assert len(harness.store.backlogs.single(name).load()) == 4  # two are in memory
    shown = summarise(harness.path).backlogs
    assert [(each.link, each.lane, each.messages) for each in shown] == [
        *(("fleet", "latest", 6), ("other", "latest", 6))
    ]
    assert all(6 * size < each.size < 6 * size + 2000 for each in shown)
    await harness.stop()
    before = harness.path.stat().st_size
    assert prune(harness.path, None, []) == (0, 0) and not prune_retained(harness.path, ["#"])
    assert prune_upstream(harness.path, "fleet") == 6
    assert (
        keys(harness, "segment") == keys(harness, "backlog") and len(keys(harness, "backlog")) == 4
    )
    assert harness.path.stat().st_size < 0.6 * before
    harness.start()
    assert harness.store.backlogs.waiting_links() == ["other"]
    assert not await drained(backlog(harness, "fleet"))
    assert await drained(backlog(harness, "other")) == values


class Twin:
    """What a journal shall contain: records that are not settled, as a plain list."""

    def __init__(self) -> None:
        self.records: list[bytes] = []

    def before(self, journal: Journal, place: int) -> int:
        """Records before the segment with this place."""
        return sum(each.count - each.done for each in journal.segments()[:place])


@pytest.mark.parametrize("seed", range(12))
async def test_it_agrees_with_a_list(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(journal_module, "SMALL", 600)
    monkeypatch.setattr(journal_module, "MERGED", 1500)
    monkeypatch.setattr(journal_module, "SEGMENT_SIZE", 2100)
    monkeypatch.setattr(committer, "RETRY", 0.01)
    chance = random.Random(seed)
    starts = 0
    harness = Harness(tmp_path / "0").start()
    twins = {(link, lane): Twin() for link in "ab" for lane in range(2)}
    broken: pytest.MonkeyPatch | None = None
    for _ in range(400):
        link, lane = place = chance.choice(list(twins))
        twin, journal = twins[place], opened(harness, link, lane)
        segments = journal.segments()
        index = chance.randrange(len(segments)) if segments and chance.random() < 0.3 else 0
        action = chance.random()
        if action < 0.5:
            for _ in range(chance.randrange(1, 8)):
                record = chance.randbytes(chance.choice((0, 1, 20, 100, 500, 3000)))
                segment = journal.append(record, awaited=chance.random() < 0.5)
                assert segment is segments[-1]
                twin.records.append(record)
                if chance.random() < 0.8:
                    journal.release(segment)
        elif action < 0.62 and segments:
            segment = segments[index]
            done = chance.randint(segment.done, segment.count)
            start = twin.before(journal, index)
            del twin.records[start : start + done - segment.done]
            journal.settle(segment, done)
        elif action < 0.66 and segments:
            segment = segments[index]
            start = twin.before(journal, index)
            del twin.records[start : start + segment.count - segment.done]
            journal.drop(segment)
        elif action < 0.76 and segments:
            segment = segments[index]
            start = twin.before(journal, index)
            expected = twin.records[start : start + segment.count - segment.done]
            done, outcome = segment.done, await read(journal, segment)
            assert isinstance(outcome, list)
            assert outcome[done:] == expected
            if chance.random() < 0.8:
                journal.release(segment)
        elif action < 0.9:
            if broken is None:
                await _all_written(harness)
            else:
                harness.store.hurry()
                await asyncio.sleep(0)
        elif action < 0.94:
            if broken is None:
                broken = pytest.MonkeyPatch()
                _break(broken, harness)
            else:
                broken.undo()
                broken = None
        elif action < 0.98 and broken is None:
            await _all_written(harness)
            starts += 1
            killed, harness = harness, harness.twin(tmp_path / str(starts))
            await killed.stop()
        else:
            await asyncio.sleep(0.001)
    if broken is not None:
        broken.undo()
    await _all_written(harness)
    await harness.stop()
    harness = Harness(harness.path.parents[1]).start()
    for (link, lane), twin in twins.items():
        assert await unsettled(opened(harness, link, lane)) == twin.records
    assert keys(harness, "backlog") == keys(harness, "segment")
    total = sum(len(opened(harness, *place).segments()) for place in twins)
    assert total == len(keys(harness, "segment"))
    await harness.stop()
