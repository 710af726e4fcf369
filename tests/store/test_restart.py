"""What was there is there again: every field, after every sequence of events."""

from __future__ import annotations

import asyncio
import contextlib
import random
import shutil
import sqlite3
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import pytest_asyncio
from broker.conftest import Peer, check_accounts, lasting
from broker.test_broker import FakeLink

from appliance.broker.broker import Broker
from appliance.broker.limits import Limits
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.mqtt.codec import Properties, Property
from appliance.mqtt.packets import (
    Disconnect,
    Puback,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
    Subscribe,
    Subscription,
    Unsubscribe,
    Will,
)
from appliance.mqtt.reason import ReasonCode
from appliance.store import database
from appliance.store.inspection import summarise
from store.harness import Harness, difference, state

#: By a clock that is right.
YEAR_2030 = 1_900_000_000.0


@pytest.fixture(params=[database.AT_START, -1], ids=["at once", "later"], autouse=True)
def at_start(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Queues are read at the start, and are left to be read later."""
    monkeypatch.setattr(database, "AT_START", request.param)


@pytest_asyncio.fixture
async def harness(tmp_path: Path) -> AsyncIterator[Harness]:
    harness = Harness(tmp_path / "first", Limits(inflight=4)).start()
    yield harness
    await harness.stop()


async def restarted(harness: Harness, directory: Path) -> Harness:
    await harness.written()
    return harness.twin(directory)


PROPERTIES: Properties = {
    Property.MESSAGE_EXPIRY_INTERVAL: 1000,
    Property.CONTENT_TYPE: "text/plain",
    Property.CORRELATION_DATA: b"\0\1",
    Property.PAYLOAD_FORMAT_INDICATOR: 1,
    Property.RESPONSE_TOPIC: "answer",
    Property.USER_PROPERTY: [("a", "b"), ("a", "c")],
}


async def test_every_field_comes_back(harness: Harness, tmp_path: Path) -> None:
    will = Will("will", b"gone", 1, True, {Property.WILL_DELAY_INTERVAL: 60, **PROPERTIES})
    client = await harness.join("client", will=will, **lasting(5, 1000))
    options = Subscription("a/+", 2, True, True, 2)
    client.send(Subscribe(1, [options], {Property.SUBSCRIPTION_IDENTIFIER: [7]}))
    client.send(Subscribe(2, [Subscription("$share/group/b", 1)]))
    publisher = await harness.join("publisher", **lasting(5))
    for number in range(3):
        for qos in (1, 2):
            packet_id = 10 * number + qos
            publisher.send(
                Publish("a/x", b"%d" % number, qos, True, False, packet_id, dict(PROPERTIES))
            )
            publisher.send(Pubrel(packet_id))
    publisher.send(Publish("b", b"shared", 1, packet_id=90))
    publisher.send(Publish("a/y", b"unreleased", 2, packet_id=91, properties=dict(PROPERTIES)))
    await harness.written()
    messages = [packet for packet in client.received() if isinstance(packet, Publish)]
    assert [message.qos for message in messages] == [1, 2, 1, 2]
    client.send(Puback(messages[0].packet_id), Pubrec(messages[1].packet_id))
    client.lose()
    before = state(harness.broker)
    session = before["sessions"]["client"]
    assert [each is None for _, each in session["inflight"]].count(True) == 1
    assert session["will_at"] is not None and session["queue"]
    assert before["sessions"]["publisher"]["received"]
    twin = await restarted(harness, tmp_path / "twin")
    after = state(twin.broker)
    assert not difference(before["sessions"].pop("client"), after["sessions"].pop("client"))
    # Its client was connected, and counts as gone since now.
    assert after["sessions"]["publisher"].pop("ends_at") is not None
    assert before["sessions"]["publisher"].pop("ends_at") is None
    assert not difference(before, after)
    check_accounts(twin.broker)
    await twin.stop()


async def _replaying(harness: Harness) -> tuple[set[str], Peer]:
    """Topics of more retained messages than may be in flight, and a client that they go to."""
    topics = [f"a/{number}" for number in range(10)]
    publisher = await harness.join("publisher")
    for number, topic in enumerate(topics, 1):
        publisher.send(Publish(topic, b"x", 1, retain=True, packet_id=number))
    client = await harness.join("client", **lasting(5))
    client.send(Subscribe(1, [Subscription("a/#", 1)]))
    return {*topics}, client


async def test_retained_messages_that_were_not_sent_yet_are_sent_behind_the_restart(
    harness: Harness, tmp_path: Path
) -> None:
    """The client has its SUBACK and will find its session: it does not subscribe again."""
    topics, client = await _replaying(harness)
    await harness.written()
    sent = [packet for packet in client.received() if isinstance(packet, Publish)]
    assert len(sent) == harness.limits.inflight
    client.send(Puback(sent[0].packet_id))
    twin = await restarted(harness, tmp_path / "twin")
    again = await twin.join("client", **lasting(5))
    assert await _acknowledge_all(twin, again) == topics
    # That was all of them: behind another restart there is nothing left to be sent.
    third = await restarted(twin, tmp_path / "third")
    again = await third.join("client", **lasting(5))
    assert not await _acknowledge_all(third, again)
    await third.stop()
    await twin.stop()


async def test_what_was_asked_for_first_is_sent_behind_the_restart_whatever_was_asked_then(
    harness: Harness, tmp_path: Path
) -> None:
    """It would be sent without a restart: who asks for nothing more takes nothing back."""
    topics, client = await _replaying(harness)
    client.send(Subscribe(2, [Subscription("a/#", 1, retain_handling=2)]))
    await harness.written()
    twin = await restarted(harness, tmp_path / "twin")
    again = await twin.join("client", **lasting(5))
    assert await _acknowledge_all(twin, again) == topics
    assert await _acknowledge_all(harness, client) == topics
    await twin.stop()


async def _acknowledge_all(harness: Harness, client: Peer) -> set[str]:
    """Topics of all that the client is sent."""
    topics: set[str] = set()
    while messages := [p for p in client.received() if isinstance(p, Publish)]:
        topics |= {message.topic for message in messages}
        client.send(*(Puback(message.packet_id) for message in messages if message.packet_id))
        await harness.written()
    return topics


async def test_a_store_of_before_replays_were_in_it(tmp_path: Path) -> None:
    harness = Harness(tmp_path / "first").start()
    client = await harness.join("client", **lasting(5))
    client.send(Subscribe(1, [Subscription("a", 1)]))
    await harness.stop()
    with contextlib.closing(sqlite3.connect(harness.path)) as connection:
        for column in ("replaying", "max_rate"):
            connection.execute(f"ALTER TABLE subscription DROP COLUMN {column}")
        connection.execute("UPDATE about SET version = 2")
        connection.execute("PRAGMA user_version = 2")
        connection.commit()
    assert [session.subscriptions for session in summarise(harness.path).sessions] == [1]
    twin = harness.twin(tmp_path / "twin")
    assert [*twin.broker.sessions["client"].subscriptions] == ["a"]
    await twin.stop()


@pytest.mark.parametrize("version", [4, 5])
async def test_what_was_in_flight_comes_again_with_its_id(
    harness: Harness, tmp_path: Path, version: int
) -> None:
    """[MQTT-4.4.0-1], [MQTT-3.3.1-1]: with DUP, in its order, and nothing before its turn."""
    client = await harness.join("client", version, **lasting(version))
    client.send(Subscribe(1, [Subscription("a", 2)]))
    publisher = await harness.join("publisher")
    for number in range(6):
        publisher.publish("a", b"%d" % number, 0)
        publisher.send(Publish("a", b"%d" % number, 1 + number % 2, packet_id=number + 1))
        publisher.send(Pubrel(number + 1))
    await harness.written()
    sent = [p for p in client.received() if isinstance(p, Publish) and p.qos]
    client.send(Pubrec(sent[1].packet_id))
    twin = await restarted(harness, tmp_path / "twin")
    again = await twin.join("client", version, **lasting(version))
    _, released, *rest = again.received()
    assert isinstance(released, Pubrel) and released.packet_id == sent[1].packet_id
    expected = [(p.packet_id, p.payload, p.qos, True) for p in (sent[0], *sent[2:])]
    assert [(p.packet_id, p.payload, p.qos, p.dup) for p in rest] == expected  # type: ignore[attr-defined]
    for packet in rest:
        assert isinstance(packet, Publish) and packet.packet_id
        again.send(*[(Puback if packet.qos == 1 else Pubrec)(packet.packet_id)])
        if packet.qos == 2:
            again.send(Pubcomp(packet.packet_id))
    again.send(Pubcomp(released.packet_id))
    await twin.written()
    others = [p for p in again.received() if isinstance(p, Publish)]
    assert [(p.payload, p.dup) for p in others] == [(b"4", False), (b"5", False)]
    await twin.stop()


async def test_a_qos_2_message_is_released_after_the_restart_once(
    harness: Harness, tmp_path: Path
) -> None:
    subscriber = await harness.join("subscriber", **lasting(5))
    subscriber.send(Subscribe(1, [Subscription("a", 2)]))
    publisher = await harness.join("publisher", **lasting(5))
    publisher.send(Publish("a", b"x", 2, packet_id=5))
    twin = await restarted(harness, tmp_path / "twin")
    publisher = await twin.join("publisher", **lasting(5))
    publisher.received()
    publisher.send(Publish("a", b"x", 2, False, True, 5))
    publisher.only(Pubrec)
    publisher.send(Pubrel(5), Pubrel(5))
    await twin.written()
    assert [type(packet) for packet in publisher.received()] == [Pubcomp, Pubcomp]
    assert len(twin.broker.sessions["subscriber"].queue) == 1
    await twin.stop()


async def test_a_will_is_published_after_a_crash(harness: Harness, tmp_path: Path) -> None:
    """5.0 section 3.1.2.5: a server that failed may do so after its restart; its delay counts."""
    watcher = await harness.join("watcher", **lasting(5))
    watcher.send(Subscribe(1, [Subscription("will/+", 1)]))
    await harness.join("lasting", will=Will("will/now", b"", 1), **lasting(5))
    delayed = Will("will/late", b"", 1, properties={Property.WILL_DELAY_INTERVAL: 60})
    await harness.join("delayed", will=delayed, **lasting(5))
    await harness.join("clean", will=Will("will/clean", b"", 1))
    twin = await restarted(harness, tmp_path / "twin")
    queue = twin.broker.sessions["watcher"].queue
    twin.tick()
    assert {delivery[0].topic for delivery in queue} == {"will/now", "will/clean"}
    assert set(twin.broker.sessions) == {"watcher", "lasting", "delayed"}
    twin.tick(30)
    assert len(queue) == 2
    twin.tick(61)
    assert len(queue) == 3
    third = await restarted(twin, tmp_path / "third")
    third.tick(200)
    assert len(third.broker.sessions["watcher"].queue) == 3, "each of them once"
    await third.stop()
    await twin.stop()


async def test_a_clean_stop_saves_sessions_without_wills(harness: Harness, tmp_path: Path) -> None:
    watcher = await harness.join("watcher", **lasting(5))
    watcher.send(Subscribe(1, [Subscription("will", 1)]))
    await harness.join("client", will=Will("will", b"", 1), **lasting(5))
    harness.broker.close(lambda session: session.close_link(ReasonCode.SERVER_SHUTTING_DOWN, ""))
    twin = await restarted(harness, tmp_path / "twin")
    twin.tick(1)
    assert set(twin.broker.sessions) == {"watcher", "client"}
    assert not twin.broker.sessions["watcher"].queue
    assert twin.broker.sessions["client"].will is None
    await twin.stop()


async def test_times_are_those_of_the_wall_clock(tmp_path: Path) -> None:
    """What expired while the robot was switched off is gone."""
    clock, boot = 1_800_000_000.0, "one"
    harness = Harness(tmp_path / "first", wall=lambda: clock, boot=lambda: boot).start()
    for name, seconds in (("short", 100), ("long", 1000)):
        client = await harness.join(name, **lasting(5, seconds))
        client.send(Subscribe(1, [Subscription("a", 1)]))
        client.lose()
    expiry = {Property.MESSAGE_EXPIRY_INTERVAL: 200}
    publisher = await harness.join("publisher")
    publisher.send(Publish("a", b"short", 1, True, packet_id=1, properties=dict(expiry)))
    publisher.send(Publish("a", b"long", 1, packet_id=2))
    await harness.written()
    clock, boot = clock + 300, "other"
    twin = harness.twin(tmp_path / "twin")
    twin.tick()
    assert set(twin.broker.sessions) == {"long"}
    assert not len(twin.broker.retained)
    client = await twin.join("long", **lasting(5))
    payloads = [p.payload for p in client.received() if isinstance(p, Publish)]
    assert payloads == [b"long"]
    await twin.stop()
    await harness.stop()


@pytest.mark.parametrize(
    ("before", "after", "boots", "expired"),
    [
        pytest.param(YEAR_2030, YEAR_2030 + 3600, ("one", "one"), False, id="set while it ran"),
        pytest.param(YEAR_2030, 1000.0, ("one", "one"), False, id="set back while it ran"),
        pytest.param(YEAR_2030, 1000.0, ("one", "two"), False, id="started in 1970"),
        pytest.param(1000.0, YEAR_2030, ("one", "two"), False, id="was in 1970"),
        pytest.param(YEAR_2030, YEAR_2030 + 3600, ("", ""), True, id="who knows"),
        pytest.param(YEAR_2030, YEAR_2030 + 3600, ("one", "two"), True, id="was switched off"),
    ],
)
async def test_nothing_expires_early_by_a_wrong_clock(
    tmp_path: Path, before: float, after: float, boots: tuple[str, str], expired: bool
) -> None:
    """The store's time goes on with the time that the computer was on, and known to be off."""
    clock, boot = before, boots[0]
    harness = Harness(tmp_path / "first", wall=lambda: clock, boot=lambda: boot).start()
    client = await harness.join("client", **lasting(5, 100))
    client.lose()
    await harness.written()
    clock, boot = after, boots[1]
    twin = harness.twin(tmp_path / "twin")
    twin.tick()
    assert ("client" in twin.broker.sessions) is not expired
    twin.tick(ahead=101)  # nor too late, as far as it was on
    assert "client" not in twin.broker.sessions
    await twin.stop()
    await harness.stop()


async def test_the_clock_is_set_after_the_boot(tmp_path: Path) -> None:
    """A robot without a clock of its own learns the time from the network, later; that is no time
    that has passed, also when the power fails right after it."""
    clock, boot = 1000.0, "one"
    began = time.monotonic()
    harness = Harness(tmp_path / "first", wall=lambda: clock, boot=lambda: boot).start()
    client = await harness.join("client", **lasting(5, 100))
    client.lose()
    await harness.written()
    clock = YEAR_2030
    harness.store._check_clock()
    took = time.monotonic() - began  # of the 100 s, while the clock was not set
    await harness.written()
    boot, clock = "two", clock + 50
    twin = harness.twin(tmp_path / "twin")
    twin.tick()
    assert "client" in twin.broker.sessions
    [session] = summarise(twin.path).sessions
    assert session.ends_at == pytest.approx(YEAR_2030 + 100, abs=1 + took)
    twin.tick(ahead=51)
    assert "client" not in twin.broker.sessions
    await twin.stop()
    await harness.stop()


async def test_a_store_of_before_there_was_a_clock_in_it(tmp_path: Path) -> None:
    harness = Harness(tmp_path / "first").start()
    client = await harness.join("client", **lasting(5, 100))
    client.lose()
    await harness.written()
    await harness.stop()
    with contextlib.closing(sqlite3.connect(harness.path)) as connection:
        connection.execute("DROP TABLE clock")
        connection.execute("UPDATE about SET version = 1")
        connection.execute("PRAGMA user_version = 1")
        connection.commit()
    assert [session.client_id for session in summarise(harness.path).sessions] == ["client"]
    twin = harness.twin(tmp_path / "twin")
    twin.tick()
    assert "client" in twin.broker.sessions
    await twin.stop()


async def test_nothing_is_written_for_who_is_not_stored(harness: Harness) -> None:
    await harness.written()
    commits = harness.store.metrics.commits
    client = await harness.join("client")
    client.send(Subscribe(1, [Subscription("#", 2)]))
    client.received()
    publisher = await harness.join("publisher", 4)
    publisher.received()
    publisher.publish("a", qos=1)
    publisher.publish("a", qos=2)
    publisher.publish("$SYS/x", qos=0, retain=True)
    assert len(client.drain()) == 2
    assert not harness.store._committer.open and not harness.store.staged
    assert harness.store.metrics.commits == commits


async def test_nothing_passes_what_waits_for_a_batch_in_which_there_is_nothing(
    harness: Harness,
) -> None:
    """[MQTT-4.6.0-6]: a client may be held to depend on more than it does."""
    store, broker = harness.store, harness.broker
    client, inside = await harness.join("client"), broker.attach("inside", FakeLink())
    client.send(Subscribe(1, [Subscription("a", 1)]))
    client.received()
    for number in range(harness.limits.inflight + 1):
        broker.publish(Message("a", b"%d" % number, 1), inside)
    broker.flush()
    sent = client.messages()
    await harness.written()
    broker.publish(Message("b", b"x", 1, True), inside)
    store.hurry()  # and the batch is closed that this is in
    client.send(*(Puback(message.packet_id) for message in sent))
    assert client.received() == []
    batch = store.batch
    for _ in range(1000):
        if store.committed >= batch - 1:
            break
        await asyncio.sleep(0)
    broker.publish(Message("a", b"last", 1), inside)
    broker.flush()
    await harness.written()
    assert client.payloads() == [b"4", b"last"]


async def test_a_payload_is_stored_once(harness: Harness) -> None:
    for number in range(20):
        client = await harness.join(f"client{number}", **lasting(5))
        client.send(Subscribe(1, [Subscription("a", 1)]))
        client.lose()
    publisher = await harness.join("publisher")
    publisher.send(Publish("a", bytes(100_000), 1, True, packet_id=1))
    await harness.written()
    size = harness.path.stat().st_size + harness.path.with_name("store.db-wal").stat().st_size
    assert size < 1_000_000
    assert len(harness.store._messages) == 1


async def test_nothing_is_left_when_all_is_settled(harness: Harness, tmp_path: Path) -> None:
    client = await harness.join("client", **lasting(5))
    client.send(Subscribe(1, [Subscription("a", 2)]))
    await harness.written()
    client.received()
    publisher = await harness.join("publisher", **lasting(5))
    for number in range(1, 9):
        publisher.send(Publish("a", b"x", 1 + number % 2, packet_id=number), Pubrel(number))
    for _ in range(40):
        await harness.written()
        for packet in client.received():
            if isinstance(packet, Publish):
                answer = Puback if packet.qos == 1 else Pubrec
                client.send(answer(packet.packet_id))
            elif isinstance(packet, Pubrel):
                client.send(Pubcomp(packet.packet_id))
    assert not harness.store._messages and harness.store.bytes == 0
    twin = await restarted(harness, tmp_path / "twin")
    contents = state(twin.broker)["sessions"]
    assert not contents["client"]["inflight"] and not contents["client"]["queue"]
    await twin.stop()


class Chaos:
    """Random clients that do what clients do, right or wrong, to one broker."""

    NAMES = ("a", "b", "c", "d")
    TOPICS = ("t/1", "t/2", "u")
    FILTERS = ("t/+", "#", "u", "$share/g/t/#", "$share/g/u", "t/1")

    def __init__(self, harness: Harness, seed: int) -> None:
        self.harness = harness
        self.dice = random.Random(seed)
        self.peers: dict[str, Peer] = {}
        self.unanswered: dict[str, list[Publish | Pubrel]] = {}

    async def step(self) -> None:
        dice = self.dice
        name = dice.choice(self.NAMES)
        peer = self.peers.get(name)
        if peer is None or peer.transport.closed:
            await self._connect(name)
            return
        self._listen(name, peer)
        action = dice.choice(
            [self._publish] * 5
            + [self._answer] * 5
            + [self._subscribe, self._subscribe, self._unsubscribe, self._leave, self._lose]
        )
        action(name, peer)

    async def _connect(self, name: str) -> None:
        dice = self.dice
        version = dice.choice((4, 5))
        options = lasting(version, dice.choice((50, 5000)))
        if dice.random() < 0.2:
            options = {}
        if dice.random() < 0.3:
            delay = {Property.WILL_DELAY_INTERVAL: 100} if version == 5 else None
            options["will"] = Will(dice.choice(self.TOPICS), b"will", 1, False, delay)
        self.unanswered[name] = []
        self.peers[name] = await self.harness.join(name, version, **options)

    def _listen(self, name: str, peer: Peer) -> None:
        for packet in peer.received():
            if isinstance(packet, Publish | Pubrel) and getattr(packet, "qos", 1):
                self.unanswered[name].append(packet)

    def _publish(self, name: str, peer: Peer) -> None:
        dice = self.dice
        qos = dice.choice((0, 1, 1, 2))
        payload = b"%d" % dice.randrange(10**6) if dice.random() < 0.9 else b""
        properties = dict(PROPERTIES) if peer.version == 5 and dice.random() < 0.3 else None
        number = dice.randrange(1, 5) if qos else None
        topic = dice.choice(self.TOPICS)
        retain = dice.random() < 0.3
        peer.send(Publish(topic, payload, qos, retain, False, number, properties))
        if qos == 2 and dice.random() < 0.7 and not peer.transport.closed:
            peer.send(Pubrel(number))  # type: ignore[arg-type]

    def _answer(self, name: str, peer: Peer) -> None:
        waiting = self.unanswered[name]
        while waiting and not peer.transport.closed:
            packet = waiting.pop(0)
            if isinstance(packet, Pubrel):
                peer.send(Pubcomp(packet.packet_id))
            else:
                assert packet.packet_id is not None
                peer.send((Puback if packet.qos == 1 else Pubrec)(packet.packet_id))
            if self.dice.random() < 0.3:
                return

    def _subscribe(self, name: str, peer: Peer) -> None:
        dice = self.dice
        topic_filter = dice.choice(self.FILTERS)
        subscription = Subscription(topic_filter, dice.randrange(3))
        properties: Properties | None = None
        if peer.version == 5:
            subscription.retain_handling = dice.randrange(3)
            subscription.retain_as_published = dice.random() < 0.5
            subscription.no_local = dice.random() < 0.3 and not topic_filter.startswith("$")
            if dice.random() < 0.5:
                properties = {Property.SUBSCRIPTION_IDENTIFIER: [dice.randrange(1, 300)]}
            elif dice.random() < 0.3:
                properties = {Property.USER_PROPERTY: [("max-rate", "0.5")]}
        peer.send(Subscribe(1, [subscription], properties))

    def _unsubscribe(self, name: str, peer: Peer) -> None:
        peer.send(Unsubscribe(1, [self.dice.choice(self.FILTERS)]))

    def _leave(self, name: str, peer: Peer) -> None:
        if self.dice.random() < 0.5:
            peer.send(Disconnect())

    def _lose(self, name: str, peer: Peer) -> None:
        peer.lose()


@pytest.mark.parametrize("seed", range(6))
async def test_whatever_happens_is_there_again(tmp_path: Path, seed: int) -> None:
    harness = Harness(tmp_path / "first", Limits(inflight=3, queue_messages=8)).start()
    chaos = Chaos(harness, seed)
    for number in range(6):
        for _ in range(60):
            await chaos.step()
            if chaos.dice.random() < 0.1:
                await asyncio.sleep(0)
        await harness.written()
        before = state(harness.broker)
        twin = harness.twin(tmp_path / f"twin{number}")
        after = state(twin.broker)
        for name, session in before["sessions"].items():
            if session["ends_at"] is None:  # it was connected
                for entry in (session, after["sessions"][name]):
                    entry["ends_at"] = entry["will_at"] = None
        assert not difference(before, after)
        check_accounts(twin.broker)
        assert twin.store.bytes == harness.store.bytes
        await twin.stop()
    await harness.stop()


async def test_owners_are_known_after_a_restart(harness: Harness, tmp_path: Path) -> None:
    for user in ("alice", "mallory", None):
        for number in range(2):
            peer = await harness.join(f"{user}-{number}", user=user, **lasting(5))
            peer.send(Subscribe(1, [Subscription(f"{user}/queue", 1)]))
            peer.send(Publish(f"{user}/{number}", b"retained", 1, True, packet_id=1))
            peer.lose()
    publisher = await harness.join("publisher", user="alice")
    for user in ("alice", "mallory", None):
        publisher.send(Publish(f"{user}/queue", b"owed", 1, packet_id=1))
    inside = harness.broker.attach("inside", InsideLink())
    harness.broker.publish(Message("state", b"online", 1, True), inside)
    publisher.lose()
    harness.broker.flush()
    await harness.written()

    def figures(broker: Broker) -> dict[str, tuple[object, ...]]:
        accounts = broker.accounting.accounts
        users = [accounts.of_user(user) for user in ("alice", "mallory", None)]
        return {
            str(each): (
                [session.client_id for session in each.absent],
                each.bytes,
                each.retained,
                each.retained_bytes,
                each.stored,
            )
            for each in (*users, accounts.inside)
        }

    before = figures(harness.broker)
    assert before["the appliance"][2] == 1
    assert before["user 'mallory'"][0] == ["mallory-0", "mallory-1"]
    assert before["user 'mallory'"][2] == 2 and before["user 'mallory'"][4]
    again = harness.twin(tmp_path / "again")
    assert figures(again.broker) == before
    check_accounts(again.broker)
    await again.stop()


async def test_a_store_of_an_older_appliance_does_not_say_whose_a_message_is(
    harness: Harness, tmp_path: Path
) -> None:
    peer = await harness.join("peer", user="alice")
    peer.send(Publish("t", b"kept", 1, True, packet_id=1))
    await harness.written()
    older = tmp_path / "older"
    older.mkdir()
    (older / "state").mkdir()
    await harness.stop()
    shutil.copyfile(harness.path, older / "state/store.db")
    with contextlib.closing(sqlite3.connect(older / "state/store.db")) as database:
        for column in ("username", "inside"):
            database.execute(f"ALTER TABLE retained DROP COLUMN {column}")
        database.execute("ALTER TABLE subscription DROP COLUMN max_rate")
        database.execute("UPDATE about SET version = 3")
        database.execute("PRAGMA user_version = 3")
        database.commit()
    again = Harness(older, harness.limits, **harness.options).start()
    message = again.broker.retained.get("t")
    assert message is not None and message.payload == b"kept"
    assert again.broker.accounting.accounts.of_user(None).retained == 1
    await again.written()
    await again.stop()
