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

from appliance.broker.ports import Limits
from appliance.mqtt.packets import Publish, Subscribe, Subscription
from appliance.store import SqliteStore, StoreError, schema
from appliance.store.database import lock
from appliance.store.inspection import summarise
from store.house import House, difference, state

NOBODY = pwd.getpwnam("nobody").pw_uid


@pytest_asyncio.fixture
async def house(tmp_path: Path) -> AsyncIterator[House]:
    """One with twenty sessions, thirty messages for each of them, and ten that are retained."""
    house = House(tmp_path / "first").start()
    for number in range(20):
        client = await house.join(f"client{number}", **lasting(5))
        client.send(Subscribe(1, [Subscription("a/#", 1)]))
        client.lose()
    publisher = await house.join("publisher")
    for number in range(30):
        payload = b"%d" % number + bytes(500)
        publisher.send(Publish(f"a/{number % 10}", payload, 1, True, packet_id=number + 1))
    publisher.lose()
    yield house
    await house.stop()


def messages(house: House) -> int:
    return sum(len(session.queue) for session in house.broker.sessions.values())


async def test_only_its_user_may_read_it(house: House) -> None:
    await house.written()
    directory = house.path.parent
    assert stat.S_IMODE(directory.stat().st_mode) == 0o700
    names = {path.name for path in directory.iterdir()}
    assert names == {"store.db", "store.db-wal", "store.db-shm", "store.db.lock"}
    assert {stat.S_IMODE(path.stat().st_mode) for path in directory.iterdir()} == {0o600}


async def test_one_appliance_has_it(house: House) -> None:
    with pytest.raises(StoreError, match=r"store\.db is in use by another appliance"):
        SqliteStore(house.path).open()


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
    house = House(open_folder).start()
    await house.stop()
    house.path.parent.chmod(mode)
    os.seteuid(NOBODY)
    try:
        with pytest.raises(StoreError) as caught:
            SqliteStore(house.path).open()
    finally:
        os.seteuid(0)
    text = str(caught.value)
    assert f"{house.path} belongs to root, and this runs as nobody" in text
    assert f"sudo chown nobody {house.path.parent} {house.path}*" in text


async def test_the_lock_is_let_go(house: House) -> None:
    await house.stop()
    second = House(house.path.parent.parent).start()
    await second.stop()


async def test_an_older_database_is_migrated(
    house: House, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    await house.written()
    before = state(house.broker)
    more = "ALTER TABLE session ADD COLUMN colour TEXT;\nCREATE TABLE more (id INTEGER);\n"
    monkeypatch.setattr(schema, "MIGRATIONS", (*schema.MIGRATIONS, more))
    twin = house.twin(tmp_path / "twin")
    assert not difference(before, state(twin.broker))
    await twin.join("new", **lasting(5))
    assert schema.version(sqlite3.connect(twin.path)) == len(schema.MIGRATIONS)
    await twin.stop()


@pytest.mark.parametrize("is_stopped", [True, False])
async def test_a_newer_version_that_does_not_start_leaves_it_to_the_older(
    house: House, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, is_stopped: bool
) -> None:
    """After a failed upgrade `appliance install` puts the version back that was there before."""
    await house.written()
    before = state(house.broker)
    with monkeypatch.context() as patch:
        patch.setattr(schema, "MIGRATIONS", (*schema.MIGRATIONS, "CREATE TABLE more (id INTEGER)"))
        newer = house.twin(tmp_path / "newer")
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


async def test_what_nobody_waits_for_is_written_at_the_stop(house: House, tmp_path: Path) -> None:
    """A retained message with QoS 0, for example, which comes just before it."""
    await house.written()
    twin = house.twin(tmp_path / "twin")
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
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    await house.stop()
    monkeypatch.setattr(schema, "MIGRATIONS", ())
    before = house.path.read_bytes()
    with pytest.raises(StoreError, match=r"newer appliance \(version 4 .* knows 0\)"):
        SqliteStore(house.path).open()
    assert house.path.read_bytes() == before


@pytest.mark.parametrize("harm", HARMS)
@pytest.mark.parametrize("seed", range(5))
async def test_it_always_starts(house: House, tmp_path: Path, harm: str, seed: int) -> None:
    await house.written()
    copy = House(tmp_path / "copy")
    twin = house.twin(tmp_path / "twin")
    copy.path.parent.mkdir(parents=True)
    for name in ("store.db", "store.db-wal"):
        (copy.path.parent / name).write_bytes((house.path.parent / name).read_bytes())
    await twin.stop()
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
    house: House, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    await house.written()
    expected = messages(house)
    await house.stop()  # all of it is in the database, nothing in the log
    data = bytearray(house.path.read_bytes())
    middle = len(data) // 2 // 4096 * 4096
    data[middle : middle + 4096] = bytes(4096)
    house.path.write_bytes(data)
    second = House(tmp_path / "first").start()
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


async def test_rows_without_sense_are_left_out(house: House, tmp_path: Path) -> None:
    await house.stop()
    with sqlite3.connect(house.path) as connection:
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
    second = House(tmp_path / "first").start()
    assert messages(second) == 20 * 30 - 1
    await second.written()
    await second.stop()
    with sqlite3.connect(house.path) as connection:
        for condition in (
            "owed WHERE qos = 7",
            "owed WHERE session = 99999",
            "message WHERE topic = 'a/+'",
        ):
            (count,) = connection.execute(f"SELECT count(*) FROM {condition}").fetchone()
            assert count == 0, condition
    connection.close()


async def test_what_is_too_much_for_it_is_refused(tmp_path: Path) -> None:
    house = House(tmp_path, Limits(user=ALONE), size=1 << 20).start()
    client = await house.join("client", **lasting(5))
    client.send(Subscribe(1, [Subscription("a", 1)]))
    client.lose()
    publisher = await house.join("publisher")
    publisher.received()
    codes = []
    for number in range(1, 31):
        publisher.send(Publish("a", bytes(50_000), 1, packet_id=number))
        await house.written()
        codes += [packet.reason_code for packet in publisher.received()]
    assert codes == [0] * 20 + [0x97] * 10
    await house.stop()


async def test_what_is_too_old_is_dropped(tmp_path: Path) -> None:
    clock, boot = 1_800_000_000.0, "one"
    house = House(tmp_path / "first", age=3600, wall=lambda: clock, boot=lambda: boot).start()
    client = await house.join("client", **lasting(5))
    client.send(Subscribe(1, [Subscription("a", 1)]))
    client.lose()
    publisher = await house.join("publisher")
    publisher.send(Publish("a", b"old", 1, packet_id=1))
    await house.written()
    clock, boot = clock + 3000, "two"  # as after a restart
    twin = house.twin(tmp_path / "twin")
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
    await house.stop()


def test_a_lock_is_for_one(tmp_path: Path) -> None:
    first = lock(tmp_path / "store.db")
    assert first is not None and lock(tmp_path / "store.db") is None
