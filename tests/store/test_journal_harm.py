"""Backlogs after kills and on damaged files: what is intact is there, in order."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import sqlite3
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from broker.conftest import lasting
from durability.harm import HARMS
from waiting import until

from appliance.broker.backlogs import RecordsLostError
from store.harness import Harness
from store.test_journal import keys, opened, read, unsettled

PAGE = 4096


def _record(number: int) -> bytes:
    """Records of different sizes, some of which take many pages."""
    return b"%08d " % number * random.Random(number).choice((1, 20, 300, 3000))


async def _filled(directory: Path, batches: int = 40) -> Harness:
    """One with sessions and a backlog, stopped: all is in the database, nothing in its log."""
    harness = Harness(directory).start()
    for number in range(10):
        (await harness.join(f"client{number}", **lasting(5))).lose()
    journal = opened(harness)
    for number in range(0, 3 * batches, 3):
        for each in range(3):
            journal.append(_record(number + each))
        await harness.written()
    journal.settle(journal.segments()[0], 2)
    await harness.stop()
    return harness


@contextlib.contextmanager
def _database(path: Path) -> Iterator[sqlite3.Connection]:
    with contextlib.closing(sqlite3.connect(path)) as connection:
        yield connection


def _root(path: Path, table: str) -> int:
    with _database(path) as connection:
        query = "SELECT rootpage FROM sqlite_master WHERE name = ?"
        (page,) = connection.execute(query, (table,)).fetchone()
    return int(page)


def _wipe(path: Path, page: int) -> None:
    with path.open("r+b") as file:
        file.seek((page - 1) * PAGE)
        file.write(bytes(PAGE))


def _page_of(path: Path, text: bytes) -> int:
    """The number of a page in the middle of where the text is again and again."""
    data = path.read_bytes()
    middle = (data.index(text) + data.rindex(text)) // 2
    assert data[middle : middle + PAGE].count(text) > 300
    return middle // PAGE + 1


async def test_a_damaged_database_keeps_its_backlog(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    harness = await _filled(tmp_path)
    _wipe(harness.path, _root(harness.path, "session"))
    before = harness.path.read_bytes()
    harness.start()
    (aside,) = harness.path.parent.glob("store.db.damaged-*")
    assert aside.read_bytes() == before and "IS DAMAGED" in caplog.text
    expected = [_record(number) for number in range(2, 120)]
    assert await unsettled(opened(harness)) == expected
    segment = opened(harness).append(b"new")
    assert segment.key > max(each.key for each in opened(harness).segments()[:-1])
    opened(harness).drop(opened(harness).segments()[0])
    await harness.written()
    twin = harness.twin(tmp_path / "twin")
    assert await unsettled(opened(twin)) == [*expected[1:], b"new"]
    assert keys(twin, "segment") == keys(twin, "backlog")
    assert {path.suffix for path in harness.path.parent.iterdir()} >= {".db", ".lock"}
    assert not list(harness.path.parent.glob("*salvaged*"))
    await twin.stop()
    await harness.stop()


async def test_of_a_backlog_without_its_index_the_records_are_enough(tmp_path: Path) -> None:
    """It is sent again from its beginning."""
    harness = await _filled(tmp_path)
    _wipe(harness.path, _root(harness.path, "segment"))
    harness.start()
    assert await unsettled(opened(harness)) == [_record(number) for number in range(120)]
    await harness.stop()


async def _with_a_wiped_page(directory: Path) -> tuple[Harness, int]:
    """Started, and the number of a record that cannot be read."""
    harness = await _filled(directory)
    large = next(n for n in range(30, 120) if len(_record(n)) > 20_000)
    _wipe(harness.path, _page_of(harness.path, b"%08d " % large))
    return harness.start(), large


async def test_a_wiped_page_costs_one_segment(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    harness, large = await _with_a_wiped_page(tmp_path)
    assert "DAMAGED" not in caplog.text  # nobody has read it yet
    journal = opened(harness)
    damaged = journal.segments()[large // 3]
    outcome = await read(journal, damaged)
    assert isinstance(outcome, RecordsLostError)
    expected = [_record(n) for n in range(2, 120) if n // 3 != large // 3]
    assert await unsettled(journal) == expected
    journal.append(b"new")
    await harness.written()
    assert not harness.store.failing
    await harness.stop()
    # The start notices, and makes a new database of what is intact.
    caplog.clear()
    harness.start()
    assert "IS DAMAGED" in caplog.text and len(harness.broker.sessions) == 10
    assert await unsettled(opened(harness)) == [*expected, b"new"]
    await harness.written()
    with _database(harness.path) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    await harness.stop()
    caplog.clear()
    harness.start()
    assert "DAMAGED" not in caplog.text
    await harness.stop()


async def test_damaged_records_that_are_dropped_unread_do_not_stop_the_store(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    harness, large = await _with_a_wiped_page(tmp_path)
    journal = opened(harness)
    for segment in list(journal.segments())[: large // 3 + 3]:
        journal.drop(segment)
    journal.append(b"new")
    await harness.written()
    assert not harness.store.failing and "CANNOT BE WRITTEN" not in caplog.text
    expected = [*(_record(n) for n in range((large // 3 + 3) * 3, 120)), b"new"]
    assert await unsettled(journal) == expected
    await harness.stop()
    caplog.clear()
    harness.start()
    assert "the whole file is being checked" in caplog.text
    assert await unsettled(opened(harness)) == expected
    await harness.written()
    with _database(harness.path) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    assert keys(harness, "backlog") == keys(harness, "segment")
    await harness.stop()


async def test_where_new_records_go_is_checked_at_the_start(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    harness = await _filled(tmp_path)
    _wipe(harness.path, _root(harness.path, "backlog"))
    harness.start()
    assert "such as 40 segments of backlogs" in caplog.text
    assert await unsettled(opened(harness)) == []
    opened(harness).append(b"new")
    await harness.written()
    assert not harness.store.failing and len(harness.broker.sessions) == 10
    await harness.stop()


@pytest.mark.parametrize("harm", HARMS)
@pytest.mark.parametrize("seed", range(3))
async def test_whatever_was_damaged_the_rest_is_in_order(
    tmp_path: Path, harm: str, seed: int
) -> None:
    harness = await _filled(tmp_path)
    harness.start()
    for number in range(120, 180):
        opened(harness).append(_record(number))
        await harness.written()
    copy = harness.copy(tmp_path / "copy")
    await harness.stop()
    HARMS[harm](copy.path, random.Random(seed))
    copy.start()
    journal = opened(copy)
    found: list[int] = []
    place = 0
    while place < len(journal.segments()):
        segment = journal.segments()[place]
        outcome = await read(journal, segment)
        assert isinstance(outcome, list | RecordsLostError), outcome
        if isinstance(outcome, list):
            place += 1
            for record in outcome[segment.done :]:
                found.append(int(record[:8]))
                assert record == _record(found[-1])
    assert found == sorted(set(found))
    journal.append(b"new")
    await copy.written()
    assert not copy.store.failing
    before = await unsettled(journal)
    await copy.stop()
    copy.start()
    assert await unsettled(opened(copy)) == before and before[-1] == b"new"
    await copy.stop()


#: Appends numbers in batches of different sizes and settles some; each line of its output is what
#: is committed: the number of appended records, and that of the settled ones before.
CHILD = """
import asyncio, random, sys
from pathlib import Path
from broker.conftest import FakeAccess
from appliance.broker.broker import Broker
from appliance.store import SqliteStore

async def run(path, number):
    store = SqliteStore(Path(path), "process")
    store.open()
    store.restore(Broker(FakeAccess(), store))
    journal = store.backlogs.journal("fleet", 0)
    chance = random.Random(number)
    while True:
        for _ in range(chance.choice((1, 1, 1, 3, 30))):
            held = journal.append(b"%08d" % number * chance.choice((1, 10, 300)))
            journal.release(held)
            number += 1
        if len(journal.segments()) > 60:
            segment = journal.segments()[0]
            journal.settle(segment, min(segment.count, segment.done + chance.randint(1, 40)))
        settled = number - sum(each.count - each.done for each in journal.segments())
        batch = store.batch
        store.hurry()
        while store.committed < batch:
            await asyncio.sleep(0)
        print(number, settled, flush=True)

asyncio.run(run(sys.argv[1], int(sys.argv[2])))
"""


async def test_what_was_committed_survives_a_kill(tmp_path: Path) -> None:
    chance = random.Random(5)
    harness = Harness(tmp_path)
    appended = settled = 0
    tests = str(Path(__file__).parents[1])
    for _ in range(3):
        output = tmp_path / "output"
        with output.open("wb") as file:
            child = await asyncio.create_subprocess_exec(
                *(sys.executable, "-c", CHILD, str(harness.path), str(appended)),
                env={**os.environ, "PYTHONPATH": tests},
                stdout=file,
            )
        try:
            for _ in range(chance.randrange(5, 60)):
                before = output.stat().st_size
                await until(lambda before=before: output.stat().st_size > before, "a commit")  # noqa: B023
        finally:
            child.kill()
            await child.wait()
        last = output.read_bytes().rpartition(b"\n")[0].rpartition(b"\n")[2]
        appended, settled = map(int, last.split())
        harness.start()
        found = [int(record[:8]) for record in await unsettled(opened(harness))]
        assert found == list(range(found[0], found[0] + len(found)))
        assert found[0] >= settled, "what was settled with what is committed does not come again"
        assert found[-1] >= appended - 1
        assert keys(harness, "backlog") == keys(harness, "segment")
        appended = found[-1] + 1
        await harness.stop()
