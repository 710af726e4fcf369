"""Queues that a start leaves in the database are read while clients are served."""

from __future__ import annotations

import asyncio
import shutil
import sqlite3
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio
from broker.conftest import ALONE, Peer, check_accounts, lasting
from saboteur import Saboteur
from waiting import PATIENCE

from appliance.broker.limits import Limits
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.broker.session import FEW_READ, Session
from appliance.mqtt.packets import Publish, Subscribe, Subscription, Unsubscribe
from appliance.store import SqliteStore, StoreError, database, unread
from store.harness import Harness, difference, state

NAMES = ("one", "two", "three")

#: Messages for each of them.
COUNT = 300


@pytest.fixture(scope="module")
def left_behind(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a broker has stored: queues that nobody has read."""
    directory = tmp_path_factory.mktemp("left")

    async def leave() -> None:
        harness = Harness(directory).start()
        for name in NAMES:
            client = await harness.join(name, **lasting(5))
            client.send(Subscribe(1, [Subscription(f"{name}/#", 1), Subscription("all", 1)]))
            client.lose()
        inside = harness.broker.attach("_inside", InsideLink())
        for number in range(COUNT):
            for name in NAMES:
                topic = f"{name}/übel" if number % 7 == 0 else f"{name}/x"
                harness.broker.publish(Message(topic, b"%d" % number, 1), inside)
        harness.broker.publish(Message("all", b"of them", 1, retain=True), inside)
        await harness.written()
        await harness.stop()

    asyncio.run(leave())
    return directory


@pytest_asyncio.fixture
async def start(
    left_behind: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[Callable[..., Harness]]:
    """Starts brokers with what one has left behind; each leaves the queues unread."""
    shutil.copytree(left_behind, tmp_path / "first")
    monkeypatch.setattr(database, "AT_START", 100)
    started: list[Harness] = []

    def start(limits: Limits | None = None, **options: Any) -> Harness:
        harness = Harness(tmp_path / "first", limits, **options)
        if started:
            harness = started[-1].copy(tmp_path / f"copy{len(started)}")
            harness.limits = limits or harness.limits
            harness.options |= options
        harness.reads_all = False
        started.append(harness)
        return harness.start()

    yield start
    for harness in started:
        await harness.stop()


async def all_read(harness: Harness) -> None:
    async with asyncio.timeout(PATIENCE):
        while len(harness.store._unread or ()):  # noqa: ASYNC110
            await asyncio.sleep(0.001)


def fail(*_: object) -> object:
    raise sqlite3.OperationalError("disk I/O error")


def came_back(harness: Harness, name: str) -> Peer:
    """A client whose queue is not read yet: nothing is waited for."""
    client = harness.peer()
    client.say_connect(name, **lasting(5))
    client.client.accept(client.user)
    return client


def taken(client: Peer) -> list[bytes]:
    """What a client was sent, which it acknowledges."""
    got = []
    while messages := [each for each in client.received() if isinstance(each, Publish)]:
        client.acknowledge(*messages)
        got += [message.payload for message in messages]
    return got


def payloads(session: Session) -> list[bytes]:
    return [delivery[0].payload for delivery in session.queue]


def rows(harness: Harness, condition: str) -> int:
    with sqlite3.connect(harness.path) as connection:
        return int(connection.execute(f"SELECT count(*) FROM {condition}").fetchone()[0])


IN_ORDER = [b"%d" % number for number in range(COUNT)] + [b"of them"]


async def test_it_is_as_if_all_had_been_read_at_the_start(
    start: Callable[..., Harness], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    later = start()
    (held, *_) = sessions = [later.broker.sessions[name] for name in NAMES]
    assert held.gap is not None and not held.queue
    assert [session.waiting for session in sessions] == [COUNT + 1] * 3
    before = later.store.bytes, later.broker.accounting.queued_bytes
    stored = held.account.stored
    monkeypatch.setattr(database, "AT_START", 10**6)
    at_once = start()
    assert at_once.store.bytes == before[0]
    estimated, queued = before[1], at_once.broker.accounting.queued_bytes
    assert queued <= estimated < queued * 1.01  # what a character takes is not known before
    assert at_once.broker.sessions["one"].account.stored == stored
    await all_read(later)
    assert not difference(state(at_once.broker), state(later.broker))
    assert [payloads(session) for session in sessions] == [IN_ORDER] * 3
    assert (later.store.bytes, later.broker.accounting.queued_bytes) == (before[0], queued)
    assert held.account.stored == stored
    check_accounts(later.broker)
    assert len(later.store._messages) == len(at_once.store._messages) == 3 * COUNT + 1
    assert "3 sessions, 903 messages and 1 retained messages restored" in caplog.text
    assert "903 of the messages are read while clients are served" in caplog.text
    assert "903 messages of queues read in" in caplog.text


async def test_what_comes_meanwhile_is_behind_them_and_all_is_delivered(
    start: Callable[..., Harness],
) -> None:
    harness = start()
    publisher = await harness.join("publisher")
    client = came_back(harness, "two")
    publisher.send(Publish("two/x", b"new", 1, packet_id=1))
    harness.broker.flush()
    got = []
    async with asyncio.timeout(PATIENCE):
        while b"new" not in got:
            await asyncio.sleep(0.001)
            await harness.written()
            got += taken(client)
    assert got == [*IN_ORDER, b"new"]
    await all_read(harness)
    await harness.written()
    assert rows(harness, "message WHERE topic LIKE 'two/%'") == 0
    check_accounts(harness.broker)


async def test_the_queue_of_a_client_that_is_there_is_read_first(
    start: Callable[..., Harness], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unread, "MESSAGES_A_TURN", 1)
    harness = start()
    client = await harness.join("three", **lasting(5))
    waiting = {name: harness.broker.sessions[name].waiting for name in NAMES}
    async with asyncio.timeout(PATIENCE):
        while harness.broker.sessions["three"].waiting > COUNT - 20:
            taken(client)
            await asyncio.sleep(0.001)
            await harness.written()
    assert harness.broker.sessions["one"].gap is not None
    assert waiting["two"] == harness.broker.sessions["two"].waiting


async def test_a_session_that_ends_takes_its_rows_along(start: Callable[..., Harness]) -> None:
    harness = start()
    before = harness.store.bytes
    client = await harness.join("one")  # a clean start
    assert harness.broker.sessions["one"].gap is None
    client.lose()
    await harness.written()
    assert rows(harness, "message WHERE topic LIKE 'one/%'") == 0
    assert rows(harness, "owed") == 2 * (COUNT + 1)
    assert rows(harness, "message WHERE topic = 'all'") == 1
    assert harness.store.bytes < before
    await all_read(harness)
    check_accounts(harness.broker)
    other = harness.broker.sessions["two"]
    assert payloads(other) == IN_ORDER
    assert other.account.stored == sum(
        harness.store._messages.size(delivery[0])
        for session in harness.broker.sessions.values()
        for delivery in session.queue
    )


async def test_a_message_stays_for_those_that_have_not_read_it(
    start: Callable[..., Harness], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unread, "MESSAGES_A_TURN", 1)
    harness = start()
    publisher = await harness.join("publisher")
    publisher.send(Publish("all", b"", 0, True))  # it is no longer retained
    first, second, third = (harness.broker.sessions[name] for name in NAMES)
    first.read_all()
    harness.broker.delete(first, "")
    await harness.written()
    assert rows(harness, "message WHERE topic = 'all'") == 1
    second.read_all()
    harness.broker.delete(third, "")  # it has not read its own
    await harness.written()
    assert rows(harness, "message WHERE topic = 'all'") == 1
    assert payloads(second) == IN_ORDER
    harness.broker.delete(second, "")
    await harness.written()
    assert rows(harness, "message") == rows(harness, "owed") == 0
    assert harness.store.bytes == 0 == len(harness.store._messages)


async def test_a_client_gets_them_whose_session_ends_with_its_connection(
    start: Callable[..., Harness],
) -> None:
    harness = start()
    client = await harness.join("one", clean=False)
    assert not harness.broker.sessions["one"].expiry
    got = taken(client)
    assert got == IN_ORDER
    client.lose()
    await harness.written()
    assert rows(harness, "owed") == 2 * (COUNT + 1)


async def test_unread_messages_count(start: Callable[..., Harness]) -> None:
    limits = Limits(queue_messages=COUNT + 2, user=ALONE)
    harness = start(limits)
    publisher = await harness.join("publisher")
    publisher.send(Publish("one/x", b"fits", 1, packet_id=1))
    publisher.send(Publish("one/x", b"does not", 1, packet_id=2))
    session = harness.broker.sessions["one"]
    assert session.waiting == COUNT + 2
    assert harness.broker.counters.dropped["queue_full"] == 1
    assert f"{COUNT + 2} messages wait" in session.shortage(1)
    await all_read(harness)
    assert payloads(session) == [*IN_ORDER, b"fits"]
    check_accounts(harness.broker)


async def test_the_oldest_are_dropped(start: Callable[..., Harness]) -> None:
    limits = Limits(queue_messages=COUNT + 1, queue_full="drop-oldest", user=ALONE)
    harness = start(limits)
    inside = harness.broker.attach("_inside", InsideLink())
    session = harness.broker.sessions["one"]
    for number in range(3):
        harness.broker.publish(Message("one/x", b"new %d" % number, 1), inside)
    assert harness.broker.counters.dropped["queue_full"] == 3
    assert len(session.queue) == FEW_READ - 3
    assert session.gap is not None
    await all_read(harness)
    assert payloads(session) == [*IN_ORDER[3:], b"new 0", b"new 1", b"new 2"]
    await harness.written()
    assert rows(harness, "message WHERE topic LIKE 'one/%'") == COUNT
    check_accounts(harness.broker)


async def test_the_messages_of_a_group_are_passed_on(start: Callable[..., Harness]) -> None:
    harness = start()
    await all_read(harness)
    for name in ("member", "heir"):
        client = await harness.join(name, **lasting(5))
        client.send(Subscribe(1, [Subscription("$share/group/jobs", 1)]))
        client.lose()
    publisher = await harness.join("publisher")
    for number in range(20):
        publisher.send(Publish("jobs", b"job %d" % number, 1, packet_id=1))
    await harness.written()
    for leaves in (
        lambda again: again.broker.delete(again.broker.sessions["member"], ""),
        lambda again: again.broker.unsubscribe(
            again.broker.sessions["member"], "$share/group/jobs"
        ),
    ):
        again = start()
        assert again.broker.sessions["member"].gap is not None
        leaves(again)
        again.broker.flush()
        heir = again.broker.sessions["heir"]
        await all_read(again)
        assert sorted(payloads(heir)) == sorted(b"job %d" % number for number in range(20))
        check_accounts(again.broker)


async def test_what_was_not_read_is_there_after_a_kill(
    start: Callable[..., Harness], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unread, "MESSAGES_A_TURN", 1)
    harness = start()
    publisher = await harness.join("publisher")
    publisher.send(Publish("one/x", b"new", 1, packet_id=1))
    harness.broker.sessions["two"].read_on(10)
    await harness.written()
    assert any(session.gap for session in harness.broker.sessions.values())
    again = start()
    await all_read(again)
    assert payloads(again.broker.sessions["one"]) == [*IN_ORDER, b"new"]
    assert payloads(again.broker.sessions["two"]) == IN_ORDER


async def test_damaged_rows_are_left_out(
    start: Callable[..., Harness], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "first/state/store.db"
    with sqlite3.connect(path) as connection:
        keys = connection.execute("SELECT id, message FROM owed ORDER BY id").fetchall()
        owed = [key for key, _ in keys[:3]]
        messages = [message for _, message in keys[3:7]]
        for column, value, key in (
            ("qos", 9, owed[0]),
            ("subscription_ids", "[0", owed[1]),
            ("session", 999, owed[2]),
        ):
            connection.execute(f"UPDATE owed SET {column} = ? WHERE id = ?", (value, key))
        for column, value, key in (
            ("topic", "a/#", messages[0]),
            ("payload", "text", messages[1]),
            ("stored_at", "never", messages[2]),
        ):
            connection.execute(f"UPDATE message SET {column} = ? WHERE id = ?", (value, key))
        connection.execute("DELETE FROM message WHERE id = ?", (messages[3],))
        for key in (99998, 99999):
            connection.execute(
                "INSERT INTO message VALUES (?, 'nobody', 'x', 1, 0, NULL, NULL, NULL, 1.0)", (key,)
            )
    connection.close()
    harness = start()
    assert "1 rows of the store mean nothing" in caplog.text
    await all_read(harness)
    assert "6 rows of the store mean nothing" in caplog.text
    await harness.written()
    left = sum(len(session.queue) for session in harness.broker.sessions.values())
    assert left == 3 * (COUNT + 1) - 7 == rows(harness, "owed")
    check_accounts(harness.broker)
    assert rows(harness, "message WHERE topic = 'a/#'") == 0
    assert rows(harness, "message WHERE topic = 'nobody'") == 0


@pytest.mark.patches
async def test_what_cannot_be_read_is_left_for_the_next_start(
    start: Callable[..., Harness], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    harness = start()

    with monkeypatch.context() as context:
        context.setattr(unread.UnreadQueues, "_execute", fail)
        publisher = await harness.join("publisher")
        publisher.send(Publish("one/x", b"new", 1, packet_id=1))
        await all_read(harness)
    session = harness.broker.sessions["one"]
    assert payloads(session) == [b"new"]
    assert caplog.text.count("CANNOT BE READ: disk I/O error") == 1
    assert "903 messages of queues could not be read: they are left for the next start" in (
        caplog.text
    )
    check_accounts(harness.broker)
    await harness.written()
    again = start()
    await all_read(again)
    assert payloads(again.broker.sessions["one"]) == [*IN_ORDER, b"new"]


async def test_a_file_that_was_closed_is_opened_again(start: Callable[..., Harness]) -> None:
    harness = start()
    session = harness.broker.sessions["one"]
    session.read_on(5)
    queues = harness.store._unread
    assert queues is not None and queues._connection is not None
    queues._connection.close()
    session.read_all()
    assert payloads(session) == IN_ORDER


async def test_old_ones_are_dropped_when_they_were_read(start: Callable[..., Harness]) -> None:
    now = [2e9]
    harness = start(wall=lambda: now[0], boot=lambda: "another", age=60.0)
    session = harness.broker.sessions["one"]
    harness.store._drop_old()
    assert session.waiting == COUNT + 1
    await all_read(harness)
    assert len(session.queue) == COUNT + 1
    publisher = await harness.join("publisher")
    publisher.send(Publish("one/x", b"new", 1, packet_id=1))
    harness.store._clock.start(lambda: 1e6, harness.store._clock.stamp())
    harness.store._drop_old()
    assert not session.waiting


@pytest.mark.patches
async def test_a_turn_is_short(
    start: Callable[..., Harness], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unread, "BYTES_A_TURN", 2000)
    harness = start()
    session = harness.broker.sessions["one"]
    reads: list[int] = []
    read = unread.UnreadQueues.read

    def watched(self: unread.UnreadQueues, queue: unread.UnreadQueue, count: int) -> Any:
        found = read(self, queue, count)
        reads.append(len(found))
        return found

    monkeypatch.setattr(unread.UnreadQueues, "read", watched)
    await all_read(harness)
    assert session.waiting == COUNT + 1
    assert 5 < max(reads) < 20  # of messages of some 130 bytes
    assert sum(reads) == 3 * (COUNT + 1)


async def test_a_client_that_unsubscribes_meanwhile_gets_what_waited(
    start: Callable[..., Harness],
) -> None:
    harness = start()
    client = await harness.join("one", **lasting(5))
    client.send(Unsubscribe(2, ["one/#"]))
    harness.broker.flush()
    got = []
    async with asyncio.timeout(PATIENCE):
        while len(got) < COUNT + 1:
            await asyncio.sleep(0.001)
            await harness.written()
            got += taken(client)
    assert got == IN_ORDER


async def test_an_older_appliances_tables_are_read_at_once(
    start: Callable[..., Harness], tmp_path: Path
) -> None:
    path = tmp_path / "first/state/store.db"
    with sqlite3.connect(path) as connection:
        connection.execute("ALTER TABLE subscription DROP COLUMN max_rate")
        connection.execute("UPDATE about SET version = version - 1")
        (version,) = connection.execute("SELECT version FROM about").fetchone()
        connection.execute(f"PRAGMA user_version = {version}")
    connection.close()
    harness = start()
    assert payloads(harness.broker.sessions["one"]) == IN_ORDER


@pytest.mark.patches
@pytest.mark.parametrize("where", ["before", "behind"])
async def test_a_fault_of_a_turn_is_contained(
    start: Callable[..., Harness],
    monkeypatch: pytest.MonkeyPatch,
    escaped: list[str],
    where: str,
) -> None:
    """The entry "store.unread"."""
    saboteur = Saboteur(monkeypatch)
    harness = start()
    if where == "before":
        saboteur.arm("store.unread")
    else:
        saboteur.arm(behind="store.unread")
    await all_read(harness)
    assert harness.broker.faults.by_entry == {"store.unread": 1}
    escaped.clear()
    assert [payloads(harness.broker.sessions[name]) for name in NAMES] == [IN_ORDER] * 3
    check_accounts(harness.broker)


async def grouped(start: Callable[..., Harness]) -> Harness:
    """A broker whose queues are unread, with a group of which `one` is a member, and an heir."""
    harness = start()
    await all_read(harness)
    for name in ("one", "heir"):
        client = await harness.join(name, **lasting(5))
        client.send(Subscribe(9, [Subscription("$share/group/jobs", 1)]))
        client.lose()
    await harness.written()
    return start()


async def test_newer_messages_of_a_group_are_passed_on_too(start: Callable[..., Harness]) -> None:
    harness = await grouped(start)
    inside = harness.broker.attach("_inside", InsideLink())
    for number in range(20):
        harness.broker.publish(Message("jobs", b"job %d" % number, 1), inside)
    one, heir = harness.broker.sessions["one"], harness.broker.sessions["heir"]
    assert one.gap is not None and one.gap.newer and not one.gap.unread.is_shared
    harness.broker.delete(one, "")
    assert len(heir.queue) == 20


async def test_what_a_turn_sends_leaves_with_it(start: Callable[..., Harness]) -> None:
    harness = start()
    came_back(harness, "one")
    harness.broker.flush()
    queues = harness.store._unread
    assert queues is not None
    queues._turn()
    assert not harness.broker.unflushed
    assert len(harness.broker.sessions["one"].inflight) == Limits().inflight


async def test_a_damaged_key_does_not_have_keys_given_out_twice(
    start: Callable[..., Harness], tmp_path: Path
) -> None:
    with sqlite3.connect(tmp_path / "first/state/store.db") as connection:
        keys = [key for (key,) in connection.execute("SELECT id FROM owed ORDER BY id")]
        connection.execute("UPDATE owed SET message = ? WHERE id = ?", (1 << 60, keys[0]))
        connection.execute("UPDATE owed SET message = -5 WHERE id = ?", (keys[1],))
    connection.close()
    harness = start()
    assert next(harness.store._committer.keys) > keys[-1]
    await all_read(harness)
    assert sum(len(session.queue) for session in harness.broker.sessions.values()) == (
        3 * (COUNT + 1) - 2
    )


@pytest.mark.parametrize(
    ("table", "column", "value"),
    [
        ("message", "topic", "CAST(x'ff41' AS TEXT)"),
        ("owed", "share", "CAST(x'ff41' AS TEXT)"),
        ("owed", "subscription_ids", f"'{'[' * 100_000}'"),
    ],
)
async def test_a_row_that_no_decoder_takes_is_left_out_alone(
    start: Callable[..., Harness], tmp_path: Path, table: str, column: str, value: str
) -> None:
    with sqlite3.connect(tmp_path / "first/state/store.db") as connection:
        (last,) = connection.execute(
            "SELECT max(id) FROM message WHERE topic LIKE 'one/%'"
        ).fetchone()
        key = "id" if table == "message" else "message"
        connection.execute(f"UPDATE {table} SET {column} = {value} WHERE {key} = ?", (last,))
    connection.close()
    harness = start()
    await all_read(harness)
    assert not harness.broker.faults.count
    one = harness.broker.sessions["one"]
    assert one.gap is None
    assert payloads(one) == [*IN_ORDER[:-2], b"of them"]
    for session in list(harness.broker.sessions.values()):
        harness.broker.delete(session, "")
    harness.broker.publish(
        Message("all", b"", retain=True), harness.broker.attach("_", InsideLink())
    )
    await harness.written()
    assert rows(harness, "message") == rows(harness, "owed") == harness.store.bytes == 0


async def test_rows_of_a_session_that_is_not_there_take_their_messages_along(
    start: Callable[..., Harness], tmp_path: Path
) -> None:
    with sqlite3.connect(tmp_path / "first/state/store.db") as connection:
        connection.execute("DELETE FROM session WHERE client_id = 'one'")
    connection.close()
    harness = start()
    await all_read(harness)
    await harness.written()
    assert rows(harness, "message WHERE topic LIKE 'one/%'") == 0
    assert rows(harness, "owed") == 2 * (COUNT + 1)
    assert harness.store.bytes == sum(
        stored.size for stored in harness.store._messages._messages.values()
    )


@pytest.mark.patches
async def test_what_could_not_be_read_ends_with_its_session(
    start: Callable[..., Harness], monkeypatch: pytest.MonkeyPatch
) -> None:
    harness = start()

    with monkeypatch.context() as context:
        context.setattr(unread.UnreadQueues, "_execute", fail)
        await all_read(harness)
    harness.broker.delete(harness.broker.sessions["one"], "")
    await harness.written()
    assert rows(harness, "owed") == 2 * (COUNT + 1)
    assert rows(harness, "message WHERE topic LIKE 'one/%'") == 0


async def test_publishers_wait_for_a_queue_that_is_being_read(
    start: Callable[..., Harness], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As they do for one that is in memory; and the reader is not blamed for it."""
    monkeypatch.setattr(unread, "MESSAGES_A_TURN", 1)
    harness = start(Limits(queue_messages=COUNT + 50, user=ALONE))
    session = harness.broker.sessions["one"]
    came_back(harness, "one")
    assert session.congestion is not None
    session.queue.clear()
    session.inflight.clear()
    assert session.awaits_store
    session.congestion.resume()
    assert not session.congestion._has_unacknowledged


async def test_a_queue_with_a_gap_is_as_crowded_as_one_in_memory(
    start: Callable[..., Harness], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unread, "MESSAGES_A_TURN", 1)
    harness = start(Limits(queue_messages=2 * COUNT + 10, user=ALONE))
    session = harness.broker.sessions["one"]
    came_back(harness, "one")
    assert session.congestion is None
    inside = harness.broker.attach("_inside", InsideLink())
    for _ in range(10):
        harness.broker.publish(Message("one/x", b"new", 1), inside)
    assert session.gap is not None and session.congestion is not None


async def test_the_client_that_waits_longest_is_read_first(start: Callable[..., Harness]) -> None:
    harness = start()
    queues = harness.store._unread
    assert queues is not None
    for name in ("three", "two", "one", "three"):
        gap = harness.broker.sessions[name].gap
        assert gap is not None
        gap.unread.hurry()
    assert [queue.session.client_id for queue in queues._awaited] == [
        "three",
        "two",
        "one",
    ]
    await all_read(harness)
    assert not queues._awaited


async def test_a_start_that_fails_after_the_early_reading_changes_nothing(tmp_path: Path) -> None:
    harness = Harness(tmp_path / "first").start()
    await harness.join("one", **lasting(5))
    await harness.stop()
    data = bytearray(harness.path.read_bytes())
    data[4096:8192] = bytes(4096)
    harness.path.write_bytes(data)
    store = SqliteStore(harness.path)
    store.begin_opening()
    opening = store._database._opening
    assert opening is not None
    opening.join()
    assert harness.path.read_bytes() == data  # it was not set aside
    store.open()
    assert list(harness.path.parent.glob("store.db.damaged-*"))
    await store.close()


async def test_it_is_opened_early_and_only_once(tmp_path: Path) -> None:
    harness = Harness(tmp_path / "first").start()
    await harness.join("one", **lasting(5))
    await harness.stop()
    store = SqliteStore(harness.path)
    store.begin_opening()
    other = SqliteStore(harness.path)
    store.open()
    other.begin_opening()
    with pytest.raises(StoreError, match="in use"):
        other.open()
    await store.close()
    other.open()
    await other.close()
