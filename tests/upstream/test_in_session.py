"""What comes from the fleet is published here, judged and acknowledged in order."""

from __future__ import annotations

from pathlib import Path

import pytest
from broker.conftest import FakeStore, Peer, lasting
from waiting import until

from appliance.broker.client import PACKET_COST
from appliance.broker.counters import COST_PER_TURN
from appliance.broker.limits import Features, Limits
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.broker.values import Action, Decision, Identity, PublishRejection
from appliance.mqtt.codec import V5, V311, Property
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ReasonCode
from appliance.store import SqliteStore
from appliance.upstream import in_session
from appliance.upstream.late import LEAST_WINDOW, Verdict
from appliance.upstream.rules import LinkRules

from .local_rig import ACL, Fleet, Rig, user_properties

FULL = ReasonCode.QUOTA_EXCEEDED


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    rig = Rig(tmp_path)
    rig.begin()
    return rig


class Ear(InsideLink):
    """A part of the appliance that takes messages, such as the bridge."""

    def __init__(self) -> None:
        self.came: list[tuple[Message, bool, Session | None]] = []
        self.rejection: PublishRejection | None = None

    def publish(
        self,
        message: Message,
        qos: int,
        packet_id: int,
        dup: bool,
        retain: bool,
        subscription_ids: list[int] | None,
    ) -> None:
        self.came.append((message, retain, message.publisher))
        message.rejection = self.rejection


def hear(rig: Rig, topic: str = "r2/#") -> Ear:
    ear = Ear()
    session = rig.broker.attach("_bridge", ear)
    rig.broker.subscribe(session, Subscription(topic, 0))
    return ear


def test_what_the_rules_carry_is_published_as_the_links_user(rig: Rig) -> None:
    peer = rig.join()
    peer.subscribe("r2/#", 1)
    fleet = rig.connect()
    said = {
        Property.CONTENT_TYPE: "text/plain",
        Property.MESSAGE_EXPIRY_INTERVAL: 60,
        Property.USER_PROPERTY: [("a", "b"), ("appliance-via", "r9")],
    }
    assert fleet.send("fleet/r2/cmd_vel", b"go", properties=said) == 0
    (message,) = peer.drain()
    assert (message.topic, message.payload, message.qos) == ("r2/cmd_vel", b"go", 1)
    assert (message.properties or {})[Property.MESSAGE_EXPIRY_INTERVAL] == 60
    assert (message.properties or {})[Property.CONTENT_TYPE] == "text/plain"
    assert user_properties(message.properties) == [("a", "b"), ("appliance-via", "r9")]
    assert fleet.send("fleet/r2/cmd_vel", b"go on", qos=0) == -1
    assert peer.payloads() == [b"go on"]
    # 0x10 in a PUBACK is a server's: nobody subscribed to this one.
    peer.unsubscribe("r2/#")
    assert fleet.send("fleet/r2/cmd_vel", b"alone") == 0
    assert (rig.counters.received, rig.counters.delivered) == (3, 3)


def test_what_no_rule_carries_is_not_published(rig: Rig) -> None:
    peer = rig.join()
    peer.subscribe("#")
    fleet = rig.connect()
    for topic in ("fleet/r2/else", "fleet/r3/cmd_vel", "cmd_vel", "$SYS/x", "fleet/r2/"):
        assert fleet.send(topic) == 0
    assert not peer.messages() and rig.counters.uncarried == 5


def test_the_access_rules_refuse(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    """Which is told by the rule that carries it, until they do not any more."""
    peer = rig.join()
    peer.subscribe("#")
    fleet, secret = rig.connect(), "fleet/r2/secret/#"
    assert fleet.send("fleet/r2/secret/x") == ReasonCode.NOT_AUTHORIZED
    assert not peer.messages() and rig.counters.refused == 1
    assert "'_upstream_in.fleet' (user 'upstream') may not publish to 'r2/secret/x'" in caplog.text
    assert rig.counters.dropped == {(secret, Verdict.REFUSED): 1}
    assert list(rig.counters.denied) == [secret] and "acl.conf:" in rig.counters.denied[secret]
    assert fleet.send("fleet/r2/cmd_vel") == 0 and rig.counters.denied  # another rule
    rig.reload(ACL.replace("topic deny {robot}/secret/#", ""))
    assert fleet.send("fleet/r2/secret/x") == 0
    assert not rig.counters.denied and rig.counters.refused == 1


@pytest.mark.parametrize("limits", [Limits(topic_levels=4), Limits(topic_length=20)])
def test_a_topic_that_is_too_long_here_is_refused_alone(tmp_path: Path, limits: Limits) -> None:
    rig = Rig(tmp_path, limits=limits)
    rig.begin()
    fleet = rig.connect()
    assert fleet.send("fleet/r2/mission/a/b/c/d/e/f/g/h") == ReasonCode.TOPIC_NAME_INVALID
    assert fleet.send("fleet/r2/mission/a") == 0
    assert not fleet.connection.closed


def test_text_that_is_none_is_refused(tmp_path: Path) -> None:
    rig = Rig(tmp_path, features=Features(check_payload_format=True))
    rig.begin()
    fleet = rig.connect()
    said = {Property.PAYLOAD_FORMAT_INDICATOR: 1}
    for payload, code in ((b"\xff", ReasonCode.PAYLOAD_FORMAT_INVALID), (b"x", 0)):
        assert fleet.send("fleet/r2/cmd_vel", payload, properties=said) == code


@pytest.mark.parametrize(
    ("said", "sent"),
    [
        (ReasonCode.PAYLOAD_FORMAT_INVALID, ReasonCode.PAYLOAD_FORMAT_INVALID),
        (ReasonCode.NOT_AUTHORIZED, ReasonCode.NOT_AUTHORIZED),
        # Not one of those that PUBACK may have.
        (ReasonCode.ADMINISTRATIVE_ACTION, ReasonCode.UNSPECIFIED_ERROR),
    ],
)
def test_what_ros_cannot_use_is_refused(rig: Rig, said: ReasonCode, sent: ReasonCode) -> None:
    ear = hear(rig)
    ear.rejection = PublishRejection(said, "by the test")
    assert rig.connect().send("fleet/r2/cmd_vel") == sent
    assert rig.counters.refused == 1 and not rig.counters.denied
    assert rig.counters.dropped == {("fleet/r2/cmd_vel", Verdict.REFUSED): 1}


def test_circles_are_dropped(rig: Rig) -> None:
    peer = rig.join()
    peer.subscribe("r2/#")
    fleet = rig.connect()
    mine = [("appliance-via", "r9"), ("appliance-via", "r2")]
    long = [("appliance-via", f"r{number}") for number in range(10, 19)]
    for pairs in (mine, long):
        assert fleet.send("fleet/r2/cmd_vel", properties={Property.USER_PROPERTY: pairs}) == 0
    assert not peer.messages() and rig.counters.circles == 2
    fleet.send("fleet/r2/cmd_vel", properties={Property.USER_PROPERTY: long[1:]})
    assert len(peer.messages()) == 1


# --- late commands -----------------------------------------------------------------------------


def dropped(rig: Rig) -> dict[tuple[str, str], int]:
    return {
        (name[9:], verdict.name): count for (name, verdict), count in rig.counters.dropped.items()
    }


def test_late_expired_and_repeated_commands_are_dropped_and_counted(rig: Rig) -> None:
    ear = hear(rig)
    fleet = rig.connect()
    assert fleet.send("fleet/r2/cmd_vel", b"in time") == 0
    rig.now += 0.6
    for qos in (0, 1):
        fleet.send("fleet/r2/cmd_vel", b"late", qos=qos)
    assert fleet.send("fleet/r2/calls/x", b"in time") == 0  # another rule, another limit
    fleet.ping()
    rig.now += 0.2
    assert fleet.send("fleet/r2/cmd_vel", b"in time again") == 0
    assert fleet.send("fleet/r2/cmd_vel", b"again", dup=True) == 0
    expired = {Property.MESSAGE_EXPIRY_INTERVAL: 0}
    assert fleet.send("fleet/r2/calls/x", b"expired", properties=expired) == 0
    assert [message.payload for message, _, _ in ear.came] == [
        b"in time",
        b"in time",
        b"in time again",
    ]
    assert [round(message.age, 3) for message, _, _ in ear.came] == [0.0, 0.6, 0.2]
    assert dropped(rig) == {
        ("cmd_vel", "LATE"): 2,
        ("cmd_vel", "REPEATED"): 1,
        ("calls/#", "EXPIRED"): 1,
    }


def test_what_is_retained_there_does_not_come_by_a_rule_that_drops_it(tmp_path: Path) -> None:
    rig = Rig(tmp_path, keys="user: upstream, in: [{topic: order, retained: drop}, {topic: map}]")
    rig.begin()
    ear = hear(rig)
    fleet = rig.connect()
    for qos in (0, 1):
        fleet.send("fleet/r2/order", b"old", qos=qos, retain=True)
        fleet.send("fleet/r2/map", b"state", qos=qos, retain=True)
        fleet.send("fleet/r2/order", b"new", qos=qos)
    assert [message.payload for message, _, _ in ear.came] == [b"state", b"new"] * 2
    assert dropped(rig) == {("order", "RETAINED"): 2}
    assert not rig.broker.retained.get("r2/order")


def test_rules_that_keep_what_came_offline_take_it_and_tell_that_its_age_is_unknown(
    rig: Rig,
) -> None:
    ear = hear(rig)
    fleet = rig.connect(is_kept=True)
    assert fleet.send("fleet/r2/mission/1", dup=True) == 0
    assert fleet.send("fleet/r2/mission/2") == 0
    fleet.ping()
    assert fleet.send("fleet/r2/mission/3") == 0
    # A rule that does not keep does not take it from there: nobody knows how old it is.
    assert [message.age for message, _, _ in ear.came] == [float("inf"), float("inf"), 0.0]
    rig.now += 1
    assert fleet.send("fleet/r2/cmd_vel") == 0
    assert len(ear.came) == 3
    assert {publisher.client_id for _, _, publisher in ear.came if publisher} == {
        "_upstream_kept.fleet"
    }


def test_a_thousand_commands_that_are_late_reach_nobody(rig: Rig) -> None:
    """As after a silence of the network, where a broker with a window sends the rest last."""
    ear = hear(rig)
    fleet = rig.connect()
    sent_at = rig.now
    rig.now += 10
    fleet.ask(sent_at + 9.9)  # answered behind what was in flight
    for number in range(1000):
        if number == LEAST_WINDOW:
            fleet.answer()
        fleet.put("fleet/r2/cmd_vel", qos=1)
        rig.broker.flush()
    fleet.ask()
    for _ in range(1000):
        fleet.put("fleet/r2/cmd_vel", qos=1)
    assert not ear.came
    while fleet.connection.turn_in is not None:
        fleet.turn()
    assert not ear.came and dropped(rig) == {("cmd_vel", "LATE"): 2000}
    assert len(fleet.connection.codes()) == 2000
    fleet.answer()
    fleet.ping()
    fleet.send("fleet/r2/cmd_vel")
    assert len(ear.came) == 1


def test_what_waits_here_gets_older(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    ear = hear(rig)
    fleet = rig.connect()
    monkeypatch.setattr(in_session, "COST_PER_TURN", -1)
    fleet.put("fleet/r2/cmd_vel")
    fleet.put("fleet/r2/calls/x")
    assert not ear.came
    monkeypatch.undo()
    fleet.turn(0.6)
    assert [(message.topic, message.age) for message, _, _ in ear.came] == [
        ("r2/calls/x", pytest.approx(0.6))
    ]


def test_a_retained_message_is_a_state_and_no_command(rig: Rig) -> None:
    """The bridge gets it as one that was retained before; others as every retained message."""
    ear = hear(rig)
    peer = rig.join()
    peer.subscribe("r2/#", retain_as_published=True)
    plain = rig.join("plain")
    plain.subscribe("r2/#")
    fleet = rig.connect()
    rig.now += 60
    assert fleet.send("fleet/r2/cmd_vel", b"state", retain=True) == 0
    ((message, retain, _),) = ear.came
    assert retain and message.age == float("inf")
    assert [packet.retain for packet in (*peer.messages(), *plain.messages())] == [True, False]
    kept = rig.broker.retained.get("r2/cmd_vel")
    assert kept is not None and kept.payload == b"state"
    assert rig.broker.retained.owner("r2/cmd_vel").username == "upstream"
    assert fleet.send("fleet/r2/cmd_vel", b"", retain=True) == 0
    assert rig.broker.retained.get("r2/cmd_vel") is None


# --- acknowledgements --------------------------------------------------------------------------


@pytest.fixture
def store(rig: Rig) -> FakeStore:
    """Messages on r2/mission/# are stored here, for a reader whose session outlives it."""
    assert isinstance(rig.store, FakeStore)
    rig.join("reader", **lasting(5)).subscribe("r2/mission/#", 1)
    return rig.store


def test_acknowledgements_wait_for_their_commit_in_order(rig: Rig, store: FakeStore) -> None:
    fleet = rig.connect()
    store.holding = True
    ids = [
        fleet.put(f"fleet/r2/{topic}")
        for topic in ("calls/1", "mission/1", "calls/2", "secret/x", "mission/2")
    ]
    rig.broker.flush()
    assert not fleet.connection.acknowledged
    store.batch += 1  # the first batch is being written
    ids += [fleet.put("fleet/r2/calls/3"), fleet.put("fleet/r2/mission/3")]
    rig.broker.flush()
    store.committed = 1
    store._tell(True)
    codes = [0, 0, 0, ReasonCode.NOT_AUTHORIZED, 0]
    assert fleet.connection.codes() == list(zip(ids[:5], codes, strict=True))
    store.commit()
    assert fleet.connection.codes() == [(ids[5], 0), (ids[6], 0)]


def test_what_depends_on_nothing_stored_is_acknowledged_at_once(rig: Rig, store: FakeStore) -> None:
    fleet = rig.connect()
    store.holding = True
    publisher = rig.join("other")
    publisher.publish("r2/mission/x", b"x", 0)
    assert fleet.send("fleet/r2/calls/1") == 0


def test_a_commit_that_fails_ends_the_connection_unacknowledged(rig: Rig, store: FakeStore) -> None:
    fleet = rig.connect()
    store.holding = True
    assert fleet.send("fleet/r2/mission/1") == -1
    store.commit(kept=False)
    assert [code for code, _ in fleet.connection.closed] == [ReasonCode.UNSPECIFIED_ERROR]
    assert not fleet.connection.acknowledged
    assert fleet.send("fleet/r2/mission/2") == -1  # what was read since is nobody's
    store.commit()
    assert not fleet.connection.acknowledged


@pytest.mark.parametrize(
    ("version", "is_kept", "code"),
    [(V5, False, FULL), (V5, True, None), (V311, False, None)],
)
def test_while_the_store_fails_nothing_is_acknowledged_that_is_not_stored(
    rig: Rig, store: FakeStore, version: int, is_kept: bool, code: int | None
) -> None:
    ear = hear(rig, "r2/cmd_vel")
    store.holding = True
    store._stage()
    store.commit(kept=False)
    fleet = rig.connect(version, is_kept=is_kept)
    if not is_kept:
        assert fleet.send("fleet/r2/cmd_vel") == 0 and len(ear.came) == 1  # it needs no store
    assert fleet.send("fleet/r2/mission/1") == (-1 if code is None else code)
    assert bool(fleet.connection.closed) is (code is None)


def test_nothing_is_acknowledged_on_another_connection(rig: Rig, store: FakeStore) -> None:
    first = rig.connect()
    store.holding = True
    first.put("fleet/r2/mission/1")
    rig.broker.flush()
    first.put("fleet/r2/mission/2")
    first.session.detach()
    second = rig.connect()
    rig.broker.flush()
    store.commit()
    assert not first.connection.acknowledged and not second.connection.acknowledged
    assert rig.broker.accounting.input_bytes == 0


async def test_a_real_store_holds_acknowledgements_back(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "store.db", "power")
    store.open()
    rig = Rig(tmp_path, store=store)
    store.restore(rig.broker)
    rig.begin()
    link = InsideLink()
    reader, _ = rig.broker.connect(
        link, Identity("user", "reader"), clean_start=False, expiry=3600, will=None
    )
    assert rig.broker.subscribe(reader, Subscription("r2/mission/#", 1))[0] == 1
    rig.broker.disconnect(reader, link, publish_will=False)
    rig.broker.flush()
    fleet = rig.connect()
    ids = [fleet.put(f"fleet/r2/mission/{number}") for number in range(100)]
    rig.broker.flush()
    while fleet.connection.turn_in is not None:
        fleet.turn()
    assert not fleet.connection.acknowledged
    await until(lambda: len(fleet.connection.acknowledged) == 100)
    assert fleet.connection.codes() == [(packet_id, 0) for packet_id in ids]
    assert not store.failing and store.committed >= 1

    def fail(_: object) -> None:
        raise OSError("no space left")

    with pytest.MonkeyPatch.context() as broken:
        broken.setattr(store._committer._writer, "_write", fail)
        fleet.put("fleet/r2/mission/lost")
        rig.broker.flush()
        await until(lambda: bool(fleet.connection.closed))
        assert not fleet.connection.acknowledged
    await until(lambda: not store.failing)
    assert not fleet.connection.acknowledged
    await store.close()


# --- receivers without room --------------------------------------------------------------------


@pytest.fixture
def small(tmp_path: Path) -> Rig:
    """With little room for messages that wait."""
    rig = Rig(tmp_path, limits=Limits(queue_messages=10, inflight=5))
    rig.begin()
    return rig


def crowded(rig: Rig) -> tuple[Peer, Fleet, int]:
    """A reader that does not read, for whom one message waits; the last is how many did not."""
    reader = rig.join("reader")
    reader.subscribe("r2/mission/#", 1)
    fleet = rig.connect()
    return reader, fleet, crowd(rig, fleet)


def crowd(rig: Rig, fleet: Fleet) -> int:
    """Send until one waits; returns how many did not."""
    for number in range(100):
        fleet.put("fleet/r2/mission/x", b"%d" % number)
        rig.broker.flush()
        if fleet.session.waiting:
            return number
    raise AssertionError("none waits")


def test_a_message_waits_for_its_receivers_and_others_behind_it(small: Rig) -> None:
    rig = small
    other = rig.join("other")
    other.subscribe("r2/calls/#")
    reader, fleet, count = crowded(rig)
    fleet.put("fleet/r2/calls/1", b"behind")
    rig.broker.flush()
    assert fleet.session.waiting == 2 and not other.messages()
    assert [packet_id for packet_id, _ in fleet.connection.codes()] == list(range(1, count + 1))
    assert fleet.connection.turn_in is not None and fleet.connection.turn_in > 0
    assert rig.broker.accounting.input_bytes > 0
    read = [message.payload for message in reader.drain()]
    assert fleet.connection.turn_in == 0  # it was woken: there is room
    fleet.turn()
    assert not fleet.session.waiting and rig.broker.accounting.input_bytes == 0
    read += [message.payload for message in reader.drain()]
    assert read == [b"%d" % number for number in range(count + 1)]
    assert other.payloads() == [b"behind"]
    codes = fleet.connection.codes()
    assert codes == [(count + 1, 0), (count + 2, 0)]


def test_a_receiver_that_does_not_read_is_waited_for_for_a_moment(small: Rig) -> None:
    _, fleet, count = crowded(small)
    fleet.connection.codes()
    waited = 0.0
    while fleet.session.waiting:
        assert fleet.connection.turn_in is not None
        waited += fleet.connection.turn_in
        fleet.turn(fleet.connection.turn_in)
        assert waited < 5
    assert fleet.connection.codes() == [(count + 1, FULL)]
    assert small.counters.refused == 1
    assert fleet.send("fleet/r2/mission/x") == FULL  # nobody waits for it again


def test_too_much_that_waits_is_not_read_and_then_refused(
    small: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(in_session, "WAITING_MESSAGES", 20)
    rig = small
    reader, fleet, count = crowded(rig)
    for _ in range(60):  # as in a chunk that has been read already
        fleet.put("fleet/r2/calls/1", b"x" * 1000, qos=1)
        fleet.put("fleet/r2/calls/1", b"x" * 1000, qos=0)
    assert fleet.connection.is_paused
    assert rig.broker.accounting.input_bytes < 41 * 2000 + 60 * 700
    fleet.connection.codes()
    reader.drain()
    while fleet.connection.turn_in is not None:
        fleet.turn()
    assert not fleet.connection.is_paused and not fleet.session.waiting
    assert rig.broker.accounting.input_bytes == 0
    codes = fleet.connection.codes()
    assert [packet_id for packet_id, _ in codes] == list(range(count + 1, count + 62))  # in order
    assert [code for _, code in codes] == [0] * 21 + [FULL] * 40


def test_bytes_that_wait_are_limited_as_well(small: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(in_session, "WAITING_BYTES", 100_000)
    rig = small
    reader, fleet, _ = crowded(rig)
    for _ in range(100):
        fleet.put("fleet/r2/calls/1", bytes(10_000))
    assert fleet.connection.is_paused and rig.broker.accounting.input_bytes < 300_000
    fleet.session.detach()
    fleet.session.detach()
    assert rig.broker.accounting.input_bytes == 0
    reader.drain()  # wakes nobody


@pytest.mark.parametrize("topic", ["fleet/r2/mission/" + "/" * 60_000, "fleet/" + "x" * 60_000])
def test_a_long_topic_costs_what_it_takes(rig: Rig, topic: str) -> None:
    """An alias of two bytes may stand for it: a portion of 2 KiB has some 250 of them."""
    fleet = rig.connect()
    counters = rig.broker.counters
    before = counters.cost
    for _ in range(250):
        fleet.put(topic, qos=0)
    assert counters.cost - before < 250 * PACKET_COST + 2 * COST_PER_TURN
    assert fleet.session.waiting > 100  # what is more than may wait is refused
    while fleet.connection.turn_in is not None:
        before = counters.cost
        fleet.turn()
        assert counters.cost - before < 2 * COST_PER_TURN
    assert rig.counters.received == 250 == rig.counters.refused + rig.counters.uncarried


@pytest.mark.patches
def test_a_topic_with_too_many_levels_is_looked_at_no_further(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To split 60,000 levels takes a millisecond each time."""
    fleet = rig.connect()
    searched: list[str] = []
    monkeypatch.setattr(LinkRules, "inward", lambda _, topic: searched.append(topic))
    most = rig.broker.limits.topic_levels
    refused = fleet.send("fleet/r2/mission/" + "/" * most)
    assert refused == ReasonCode.TOPIC_NAME_INVALID and not searched
    assert fleet.send("fleet/r2/mission" + "/x" * (most - 1)) == 0
    assert len(searched) == 1


def test_what_waits_while_the_computer_sleeps_is_of_unknown_age(small: Rig) -> None:
    rig = small
    reader, fleet, _ = crowded(rig)
    fleet.put("fleet/r2/calls/1", b"before")
    assert fleet.session.waiting
    fleet.session.woke()
    reader.drain()
    while fleet.connection.turn_in is not None:
        fleet.turn()
    assert b"before" not in reader.payloads()
    assert rig.counters.dropped["fleet/r2/calls/#", Verdict.LATE] == 1


def test_a_flood_takes_several_turns(rig: Rig) -> None:
    fleet = rig.connect()
    counters = rig.broker.counters
    before = counters.cost
    for _ in range(1900):
        fleet.put("fleet/r2/mission/x")
    assert counters.cost - before < 10_000 and fleet.session.waiting
    turns = 0
    while fleet.connection.turn_in is not None:
        assert fleet.connection.turn_in == 0
        before = counters.cost
        fleet.turn()
        assert counters.cost - before < 1100
        turns += 1
    assert turns > 1 and rig.counters.delivered == 1900
    assert len(fleet.connection.codes()) == 1900


# --- rights, and the end -----------------------------------------------------------------------


class Plugins:
    """Topic plugins that have not answered yet."""

    timeout = 5.0

    def __init__(self, rig: Rig, action: Action) -> None:
        self.rig = rig
        self.action = action
        self.answer: bool | None = None
        self.wakes: list[object] = []
        self.epoch = 0

    def decide(self, identity: object, action: Action, topic: str) -> Decision:
        if action is not self.action or self.answer:
            return Decision(True, "")
        return Decision(False, "by the plugin", pending=self.answer is None)

    def is_pending(self, query: object, wake: object) -> bool:
        self.wakes.append(wake)
        return self.answer is None

    def decided(self, answer: bool) -> None:
        self.answer = answer
        self.epoch += 1
        self.rig.broker.router.changed()
        for wake in self.wakes:
            wake()  # type: ignore[operator]


@pytest.mark.parametrize(("answer", "code"), [(True, 0), (False, ReasonCode.NOT_AUTHORIZED)])
def test_a_decision_of_a_plugin_is_waited_for(rig: Rig, answer: bool, code: int) -> None:
    plugins = Plugins(rig, Action.PUBLISH)
    rig.broker.access = rig.broker.router.pending_decisions = plugins
    fleet = rig.connect()
    assert fleet.send("fleet/r2/cmd_vel") == -1
    assert fleet.send("fleet/r2/calls/1") == -1
    assert fleet.connection.turn_in == plugins.timeout
    plugins.decided(answer)
    assert fleet.connection.turn_in == 0
    fleet.turn()
    assert fleet.connection.codes() == [(1, code), (2, code)]


def test_a_plugin_that_does_not_decide_in_time_is_a_refusal(rig: Rig) -> None:
    plugins = Plugins(rig, Action.PUBLISH)
    rig.broker.access = rig.broker.router.pending_decisions = plugins
    fleet = rig.connect()
    assert fleet.send("fleet/r2/calls/1") == -1
    fleet.turn(plugins.timeout)
    assert fleet.connection.codes() == [(1, ReasonCode.NOT_AUTHORIZED)]


def test_who_may_receive_it_is_waited_for_for_a_moment(rig: Rig) -> None:
    peer = rig.join()
    peer.subscribe("r2/#")
    plugins = Plugins(rig, Action.RECEIVE)
    rig.broker.access = rig.broker.router.pending_decisions = plugins
    fleet = rig.connect()
    assert fleet.send("fleet/r2/calls/1") == -1
    assert fleet.connection.turn_in is not None and fleet.connection.turn_in < 0.1
    fleet.turn(0.1)
    assert fleet.connection.codes() == [(1, 0)] and not peer.messages()


def test_a_filter_that_a_plugin_has_to_decide_about_is_subscribed_to_then(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    plugins = Plugins(rig, Action.SUBSCRIBE)
    rig.broker.access = rig.broker.router.pending_decisions = plugins
    rig.begin()
    assert not rig.out.denied and rig.broker.subscription_count == 1
    plugins.decided(True)
    rig.turn()
    assert rig.broker.subscription_count == 3


def test_the_end_of_the_connection_is_a_departure(rig: Rig) -> None:
    departed: list[str] = []
    rig.broker.departures.append(lambda session: departed.append(session.client_id))
    fleet = rig.connect()
    assert "_upstream_in.fleet" in rig.broker.sessions
    fleet.session.detach()
    assert departed == ["_upstream_in.fleet"] and fleet.send("fleet/r2/cmd_vel") == -1
    assert "_upstream_in.fleet" not in rig.broker.sessions
    fleet.session.take_turn(rig.now)
    rig.connect()


def test_who_asks_about_its_client_asks_about_the_fleets_broker(rig: Rig) -> None:
    ear = hear(rig)
    fleet = rig.connect()
    fleet.send("fleet/r2/cmd_vel")
    publisher = ear.came[0][2]
    assert publisher is not None and publisher.link is not None
    assert publisher.link.peer_status().round_trip == 0.05
    publisher.link.probe()
    publisher.close_link(ReasonCode.ADMINISTRATIVE_ACTION, "by the test")
    assert (fleet.connection.probes, fleet.connection.closed) == (
        1,
        [(ReasonCode.ADMINISTRATIVE_ACTION, "by the test")],
    )


def test_a_response_topic_that_cannot_be_answered_is_left_out(rig: Rig) -> None:
    peer = rig.join()
    peer.subscribe("r2/#")
    fleet = rig.connect()
    said = {Property.RESPONSE_TOPIC: "$SYS/x", Property.CONTENT_TYPE: "a"}
    assert fleet.send("fleet/r2/calls/1", properties=said) == 0
    (message,) = peer.messages()
    assert Property.RESPONSE_TOPIC not in (message.properties or {})
    assert (message.properties or {})[Property.CONTENT_TYPE] == "a"


def test_a_call_of_3_1_1_gets_a_response_topic(rig: Rig) -> None:
    peer = rig.join()
    peer.subscribe("r2/#")
    fleet = rig.connect(V311)
    assert fleet.send("fleet/r2/calls/reset/_call/42") == 0
    (message,) = peer.messages()
    here = (message.properties or {})[Property.RESPONSE_TOPIC]
    assert isinstance(here, str)
    assert peer.publish(here, b"done", 1) == 0
    assert rig.backlog.taken() == [("fleet/r2/calls/reset/_reply/42", b"done")]


def test_narrowed_rules_hold_for_what_comes(rig: Rig) -> None:
    fleet = rig.connect()
    assert fleet.send("fleet/r2/cmd_vel") == 0
    rig.reload(ACL.replace("readwrite {robot}", "read {robot}"))
    assert fleet.send("fleet/r2/cmd_vel") == ReasonCode.NOT_AUTHORIZED


def test_the_two_connections_are_two_sessions(rig: Rig) -> None:
    rig.connect()
    rig.connect(is_kept=True)
    assert {"_upstream_in.fleet", "_upstream_kept.fleet"} <= rig.broker.sessions.keys()
    with pytest.raises(ValueError, match="already"):
        rig.connect()
