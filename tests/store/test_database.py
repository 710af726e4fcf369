"""The database itself: its versions, its modes, and what becomes of a damaged one."""

from __future__ import annotations

import os
import pwd
import random
import sqlite3
import stat
import tempfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
import pytest_asyncio
from broker.conftest import ALONE, check_accounts, lasting
from durability.harm import HARMS

from appliance.broker.limits import Limits
from appliance.mqtt.packets import Publish, Subscribe, Subscription
from appliance.store import SqliteStore, StoreError, schema
from appliance.store.database import lock
from appliance.store.inspection import summarise
from store.harness import Harness, difference, state

NOBODY = pwd.getpwnam("nobody").pw_uid


@pytest_asyncio.fixture
async def harness(tmp_path: Path) -> AsyncIterator[Harness]:
    """One with twenty sessions, thirty messages for each of them, and ten that are retained."""
    harness = Harness(tmp_path / "first").start()
    for number in range(20):
        client = await harness.join(f"client{number}", **lasting(5))
        client.send(Subscribe(1, [Subscription("a/#", 1)]))
        client.lose()
    publisher = await harness.join("publisher")
    for number in range(30):
        payload = b"%d" % number + bytes(500)
        publisher.send(Publish(f"a/{number % 10}", payload, 1, True, packet_id=number + 1))
    publisher.lose()
    yield harness
    await harness.stop()


def messages(harness: Harness) -> int:
    return sum(len(session.queue) for session in harness.broker.sessions.values())


async def test_only_its_user_may_read_it(harness: Harness) -> None:
    await harness.written()
    directory = harness.path.parent
    assert stat.S_IMODE(directory.stat().st_mode) == 0o700
    names = {path.name for path in directory.iterdir()}
    assert names == {"store.db", "store.db-wal", "store.db-shm", "store.db.lock"}
    assert {stat.S_IMODE(path.stat().st_mode) for path in directory.iterdir()} == {0o600}


async def test_one_appliance_has_it(harness: Harness) -> None:
    with pytest.raises(StoreError, match=r"store\.db is in use by another appliance"):
        SqliteStore(harness.path).open()


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """Pytest's own are for their user alone."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name)
        path.chmod(0o755)
        yield path


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may be somebody else")
@pytest.mark.parametrize("mode", [0o700, 0o755])
async def test_one_of_another_user_is_told(mode: int, open_folder: Path) -> None:
    """As after `sudo appliance run`, once."""
    harness = Harness(open_folder).start()
    await harness.stop()
    harness.path.parent.chmod(mode)
    os.seteuid(NOBODY)
    try:
        with pytest.raises(StoreError) as caught:
            SqliteStore(harness.path).open()
    finally:
        os.seteuid(0)
    text = str(caught.value)
    assert f"{harness.path} belongs to root, and this runs as nobody" in text
    assert f"sudo chown nobody {harness.path.parent} {harness.path}*" in text


async def test_the_lock_is_let_go(harness: Harness) -> None:
    await harness.stop()
    second = Harness(harness.path.parent.parent).start()
    await second.stop()


async def test_an_older_database_is_migrated(
    harness: Harness, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    await harness.written()
    before = state(harness.broker)
    more = "ALTER TABLE session ADD COLUMN colour TEXT;\nCREATE TABLE more (id INTEGER);\n"
    monkeypatch.setattr(schema, "MIGRATIONS", (*schema.MIGRATIONS, more))
    twin = harness.twin(tmp_path / "twin")
    assert not difference(before, state(twin.broker))
    await twin.join("new", **lasting(5))
    assert schema.version(sqlite3.connect(twin.path)) == len(schema.MIGRATIONS)
    await twin.stop()


@pytest.mark.parametrize("is_stopped", [True, False])
async def test_a_newer_version_that_does_not_start_leaves_it_to_the_older(
    harness: Harness, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, is_stopped: bool
) -> None:
    """After a failed upgrade `appliance install` puts the version back that was there before."""
    await harness.written()
    before = state(harness.broker)
    with monkeypatch.context() as patch:
        patch.setattr(schema, "MIGRATIONS", (*schema.MIGRATIONS, "CREATE TABLE more (id INTEGER)"))
        newer = harness.twin(tmp_path / "newer")
        if is_stopped:  # a port is taken, for example; else it is killed
            await newer.stop()
    older = newer.twin(tmp_path / "older")
    assert not difference(before, state(older.broker))
    await older.stop()
    await newer.stop()


async def test_a_new_one_can_be_looked_at_before_anything_is_written(tmp_path: Path) -> None:
    """By `appliance check` after a start that failed, say."""
    store = SqliteStore(tmp_path / "store.db")
    store.open()
    await store.close()
    assert summarise(store.path).sessions == []


async def test_a_lazy_change_is_committed_at_the_stop(harness: Harness, tmp_path: Path) -> None:
    """A retained message with QoS 0, for example, which comes just before it."""
    await harness.written()
    twin = harness.twin(tmp_path / "twin")
    peer = twin.peer()
    peer.say_connect("sensor")
    peer.client.accept(peer.user)
    peer.send(Publish("late", b"kept", 0, True))
    before = state(twin.broker)
    assert "late" in before["retained"]
    assert not twin.store.metrics.commits and not twin.store._committer._is_writing
    await twin.stop()
    again = twin.twin(tmp_path / "again")
    assert not difference(before, state(again.broker))
    await again.stop()


async def test_a_newer_database_is_left_alone(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    await harness.stop()
    monkeypatch.setattr(schema, "MIGRATIONS", ())
    before = harness.path.read_bytes()
    with pytest.raises(StoreError, match=r"newer appliance \(version 6 .* knows 0\)"):
        SqliteStore(harness.path).open()
    assert harness.path.read_bytes() == before


@pytest.mark.parametrize("harm", HARMS)
@pytest.mark.parametrize("seed", range(5))
async def test_it_always_starts(harness: Harness, tmp_path: Path, harm: str, seed: int) -> None:
    await harness.written()
    copy = harness.copy(tmp_path / "copy")
    HARMS[harm](copy.path, random.Random(seed))
    copy.start()
    # And what is there now is sound: it can be added to, and read again.
    client = await copy.join("new", **lasting(5))
    client.send(Subscribe(1, [Subscription("b", 1)]))
    client.lose()
    await copy.written()
    third = copy.twin(tmp_path / "third")
    assert set(third.broker.sessions) == set(copy.broker.sessions)
    assert messages(third) == messages(copy)
    await third.stop()
    await copy.stop()


async def test_what_can_be_read_of_a_damaged_one_is_saved(
    harness: Harness, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    await harness.written()
    expected = messages(harness)
    await harness.stop()  # all of it is in the database, nothing in the log
    data = bytearray(harness.path.read_bytes())
    middle = len(data) // 2 // 4096 * 4096
    data[middle : middle + 4096] = bytes(4096)
    harness.path.write_bytes(data)
    second = Harness(tmp_path / "first").start()
    assert 0 < messages(second) < expected + 1
    assert len(second.broker.sessions) > 10
    (aside,) = second.path.parent.glob("store.db.damaged-*")
    assert aside.read_bytes() == data
    assert "IS DAMAGED" in caplog.text and str(aside) in caplog.text
    await second.written()
    third = second.twin(tmp_path / "third")
    assert messages(third) == messages(second)
    await third.stop()
    await second.stop()


async def test_rows_without_sense_are_left_out(harness: Harness, tmp_path: Path) -> None:
    await harness.stop()
    with sqlite3.connect(harness.path) as connection:
        connection.execute("UPDATE owed SET qos = 7 WHERE id IN (SELECT id FROM owed LIMIT 1)")
        connection.execute(
            "INSERT INTO owed SELECT id + 1000000, 99999, message, qos, retain, "
            "subscription_ids, share, packet_id, sent FROM owed LIMIT 1"
        )
        connection.execute(
            "INSERT INTO message VALUES (8000000000000000000, 'a/+', 'x', 1, 0, "
            "NULL, NULL, NULL, 'never')"
        )
    connection.close()
    second = Harness(tmp_path / "first").start()
    assert messages(second) == 20 * 30 - 1
    await second.written()
    await second.stop()
    with sqlite3.connect(harness.path) as connection:
        for condition in (
            "owed WHERE qos = 7",
            "owed WHERE session = 99999",
            "message WHERE topic = 'a/+'",
        ):
            (count,) = connection.execute(f"SELECT count(*) FROM {condition}").fetchone()
            assert count == 0, condition
    connection.close()


async def test_what_is_too_much_for_it_is_refused(tmp_path: Path) -> None:
    harness = Harness(tmp_path, Limits(user=ALONE), size=1 << 20).start()
    client = await harness.join("client", **lasting(5))
    client.send(Subscribe(1, [Subscription("a", 1)]))
    client.lose()
    publisher = await harness.join("publisher")
    publisher.received()
    codes = []
    for number in range(1, 31):
        publisher.send(Publish("a", bytes(50_000), 1, packet_id=number))
        await harness.written()
        codes += [packet.reason_code for packet in publisher.received()]
    assert codes == [0] * 20 + [0x97] * 10
    await harness.stop()


async def test_what_is_too_old_is_dropped(tmp_path: Path) -> None:
    clock, boot = 1_800_000_000.0, "one"
    harness = Harness(tmp_path / "first", age=3600, wall=lambda: clock, boot=lambda: boot).start()
    client = await harness.join("client", **lasting(5))
    client.send(Subscribe(1, [Subscription("a", 1)]))
    client.lose()
    publisher = await harness.join("publisher")
    publisher.send(Publish("a", b"old", 1, packet_id=1))
    await harness.written()
    clock, boot = clock + 3000, "two"  # as after a restart
    twin = harness.twin(tmp_path / "twin")
    publisher = await twin.join("publisher")
    publisher.send(Publish("a", b"new", 1, packet_id=1))
    await twin.written()
    twin.store._drop_old()
    queue = twin.broker.sessions["client"].queue
    assert len(queue) == 2
    twin.store._clock.offset += 1000
    twin.store._drop_old()
    queue = twin.broker.sessions["client"].queue
    assert [delivery[0].payload for delivery in queue] == [b"new"]
    check_accounts(twin.broker)
    await twin.stop()
    await harness.stop()


def test_a_lock_is_for_one(tmp_path: Path) -> None:
    first = lock(tmp_path / "store.db")
    assert first is not None and lock(tmp_path / "store.db") is None
