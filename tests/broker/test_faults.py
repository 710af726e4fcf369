"""An internal error ends only what it occurred in: the broker, without a network."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any
from unittest.mock import Mock

import pytest

from appliance.broker.backpressure import PublisherAllowance
from appliance.broker.broker import Broker
from appliance.broker.faults import PLACES, Faults
from appliance.broker.limits import Features, Limits
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.broker.output import LONGEST_REASON
from appliance.broker.session import Session
from appliance.broker.values import Decision, Identity
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import (
    Connack,
    Disconnect,
    Pubcomp,
    Publish,
    Pubrel,
    Subscribe,
    Subscription,
    Unsuback,
    Unsubscribe,
    Will,
)
from appliance.mqtt.reason import ReasonCode
from broker.conftest import FakeAccess, FakeStore, Peer, check_accounts, drops

FAULT = ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR


class BrokenError(Exception):
    """What nobody expected."""


def fail(*args: object, **kwargs: object) -> None:
    raise BrokenError("on purpose")


class BrokenStore(FakeStore):
    """Fails in one of its methods, for one session or topic."""

    def __init__(self) -> None:
        super().__init__()
        self.fails: tuple[str, str] = ("", "")

    def _check(self, method: str, whose: str) -> None:
        if self.fails == (method, whose):
            raise BrokenError(method)

    def session_removed(self, session):
        self._check("session_removed", session.client_id)
        super().session_removed(session)

    def retained(self, message, owner):
        self._check("retained", message.topic)
        super().retained(message, owner)

    def sent(self, session, delivery, packet_id):
        self._check("sent", session.client_id)
        super().sent(session, delivery, packet_id)


@pytest.fixture
def store() -> BrokenStore:
    return BrokenStore()


@pytest.fixture
def broker(access: FakeAccess, store: BrokenStore) -> Broker:
    broker = Broker(access, store, Limits(), Features())
    broker.tick(1000.0)
    return broker


@pytest.fixture
def other(broker: Broker) -> Peer:
    """A client that has nothing to do with what fails."""
    peer = Peer(broker)
    peer.connect("other")
    peer.subscribe("other/#", 1)
    return peer


def goes_on(broker: Broker, other: Peer) -> None:
    """The other client is served as ever, and the clock goes on."""
    assert other.publish("other/x", b"1", 1) == 0
    assert broker.tick(broker.now + 1) >= broker.now
    assert not other.transport.closed


def join(broker: Broker, name: str, version: int = 5, **options: object) -> Peer:
    peer = Peer(broker, version)
    peer.connect(name, **options)
    peer.received()
    return peer


# --- faults in what is outside -------------------------------------------------------------------


def test_who_cannot_be_written_to_is_abandoned_and_the_others_are_not(broker, escaped):
    names = ["a", "b", "c"]
    peers = {name: join(broker, name) for name in names}
    for peer in peers.values():
        peer.subscribe("t")
    peers["b"].transport.write = fail
    sender = join(broker, "sender")
    sender.publish("t", b"x")
    assert peers["a"].payloads() == peers["c"].payloads() == [b"x"]
    assert peers["b"].transport.closed and broker.faults.by_entry == {"flush": 1}
    assert len(broker.clients) == 3
    escaped.clear()


@pytest.mark.parametrize("kept", [True, False])
def test_a_commit_goes_on_with_the_next_output(broker, store, escaped, kept):
    peers = [join(broker, f"c{n}", properties={Property.SESSION_EXPIRY_INTERVAL: 9}) for n in "abc"]
    store.holding = True
    for peer in peers:
        peer.send(Subscribe(1, [Subscription("t", 1)]))
        assert not peer.received()
    if kept:
        peers[1].transport.write = fail
    else:
        peers[1].transport.close = fail
    store.commit(kept)
    assert 1 <= broker.faults.count <= 3
    if kept:
        assert all(peers[n].received() for n in (0, 2)) and peers[1].transport.closed
    else:
        assert peers[0].transport.closed and peers[2].transport.closed
    escaped.clear()


def test_a_part_of_the_appliance_that_fails_misses_its_message_alone(broker, other, escaped):
    class Ear(InsideLink):
        publish = fail

    inside = broker.attach("_part", Ear())
    broker.subscribe(inside, Subscription("other/x", 0))
    sender = join(broker, "sender")
    assert sender.publish("other/x", b"1", 1) == 0
    assert b"1" in other.payloads()
    assert broker.faults.by_entry == {"broker.delivery": 1}
    assert not sender.transport.closed
    escaped.clear()


@pytest.mark.parametrize("entry", ["access", "guard"])
def test_who_cannot_be_asked_has_not_allowed_it(broker, access, other, escaped, entry):
    class Guard:
        decide = fail
        refused = staticmethod(lambda session: None)

    if entry == "guard":
        broker.guards["drive"] = [Guard()]
        broker.guards_changed()
    else:
        access.decide = fail
        access.epoch += 1
        broker.rules_changed()
    sender = join(broker, "sender")
    assert sender.publish("drive", b"go", 1) == ReasonCode.NOT_AUTHORIZED
    assert not sender.transport.closed and broker.faults.by_entry[f"broker.{entry}"]
    escaped.clear()


def test_a_departure_that_fails_keeps_nobody_from_hearing_of_it(broker, other, escaped):
    heard = []
    broker.departures += [fail, heard.append]
    peer = join(broker, "gone")
    peer.client.lost()
    assert [session.client_id for session in heard] == ["gone"]
    assert broker.faults.by_entry == {"broker.departure": 1}
    goes_on(broker, other)
    escaped.clear()


# --- the clock -----------------------------------------------------------------------------------


def test_one_keep_alive_will_session_and_retained_message_that_fail(broker, store, other, escaped):
    """Of three of each the second fails; the clock goes on with the third, and then with time."""
    watcher = join(broker, "watcher")
    watcher.subscribe("will/#")
    for n in "abc":
        silent = join(broker, f"silent-{n}", keep_alive=10)
        if n == "b":
            silent.transport.write = fail
        willing = join(
            broker,
            f"willing-{n}",
            will=Will(f"will/{n}", b"w", properties={Property.WILL_DELAY_INTERVAL: 5}),
            properties={Property.SESSION_EXPIRY_INTERVAL: 60},
        )
        willing.client.lost()
        join(broker, f"gone-{n}", properties={Property.SESSION_EXPIRY_INTERVAL: 5}).client.lost()
        other.publish(
            f"kept/{n}", b"k", retain=True, properties={Property.MESSAGE_EXPIRY_INTERVAL: 5}
        )
    store.fails = "session_removed", "gone-b"
    broker.tick(1006.0)
    assert [m.topic for m in watcher.messages()] == ["will/a", "will/b", "will/c"]
    assert not any(f"gone-{n}" in broker.sessions for n in "abc")
    assert broker.faults.by_entry == {"end.store": 1}
    assert not any(broker.retained.get(f"kept/{n}") for n in "abc")
    escaped.clear()
    broker.tick(1030.0)
    assert not any(client.session.client_id.startswith("silent") for client in broker.clients)
    escaped.clear()
    goes_on(broker, other)


def test_a_retained_message_that_cannot_be_deleted(broker, store, other, escaped):
    for n in "abc":
        other.publish(
            f"kept/{n}", b"k", retain=True, properties={Property.MESSAGE_EXPIRY_INTERVAL: 5}
        )
    store.fails = "retained", "kept/b"
    broker.tick(1006.0)
    assert not any(broker.retained.get(f"kept/{n}") for n in "abc")
    assert broker.faults.by_entry == {"clock.expiry": 1}
    escaped.clear()


# --- what strangers did --------------------------------------------------------------------------


def test_a_will_whose_topic_is_no_longer_allowed(broker, other):
    """It is 30 levels deep, and `topic_levels` was lowered since: it is not published."""
    deep = "/".join("abc"[n % 3] for n in range(30))
    peer = join(
        broker,
        "deep",
        will=Will(deep, b"w", properties={Property.WILL_DELAY_INTERVAL: 5}),
        properties={Property.SESSION_EXPIRY_INTERVAL: 60},
    )
    peer.client.lost()
    broker.use(Limits(topic_levels=20), Features())
    assert broker.tick(1006.0) == pytest.approx(1060.0)
    assert broker.counters.publish_dropped == 1
    goes_on(broker, other)


def test_a_qos_2_message_whose_topic_is_no_longer_allowed(broker, other):
    deep = "/".join("abc"[n % 3] for n in range(30))
    peer = join(broker, "deep")
    peer.send(Publish(deep, b"x", 2, False, False, 7))
    peer.received()
    broker.use(Limits(topic_levels=20), Features())
    peer.send(Pubrel(7))
    assert peer.only(Pubcomp).packet_id == 7
    assert not peer.transport.closed and drops(broker) == {"forbidden": 1}


@pytest.mark.parametrize("qos", [1, 2])
def test_a_reason_string_is_never_too_long(broker, access, qos):
    broker.use(Limits(), Features(reason_strings=True))
    topic = "ä" * 32750
    access.decide = lambda *_: Decision(False, f"it is {topic}{topic}")
    access.epoch += 1
    peer = join(broker, "explained")
    peer.send(Publish(topic, b"x", qos, False, False, 7))
    (answer,) = peer.received()
    assert answer.reason_code == ReasonCode.NOT_AUTHORIZED
    assert len(answer.properties[Property.REASON_STRING]) == LONGEST_REASON
    peer.client.close(ReasonCode.ADMINISTRATIVE_ACTION, "x" * 100_000 + "\ud800\0")
    broker.flush()
    assert len(peer.only(Disconnect).properties[Property.REASON_STRING]) == LONGEST_REASON


@pytest.mark.parametrize("ahead", [0, 8, 1e9, math.inf])
@pytest.mark.parametrize("qos", [0, 1])
def test_an_expiry_beyond_what_a_packet_can_say(broker, ahead, qos):
    """As of a restored message, when the computer's clock has gone back."""
    message = Message(
        "t",
        b"x",
        qos,
        True,
        {Property.MESSAGE_EXPIRY_INTERVAL: 0xFFFF_FFFF},
        1000.0 + 0xFFFF_FFFF + ahead,
    )
    broker.retained.restore([(message, broker.accounting.accounts.inside)])
    peer = join(broker, "late")
    peer.send(Subscribe(1, [Subscription("t", 1)]))
    publish = peer.received()[-1]
    assert isinstance(publish, Publish)
    assert publish.properties[Property.MESSAGE_EXPIRY_INTERVAL] == 0xFFFF_FFFF


@pytest.mark.parametrize("version", [4, 5])
@pytest.mark.parametrize("size", [1024, 1025, 65535])
def test_the_longest_client_id(broker, version, size):
    peer = Peer(broker, version)
    peer.say_connect("ä" * (size // 2) + "x" * (size % 2))
    if size <= 1024:
        assert peer.transport.asked is not None
        return
    # 0x85, and 2 in 3.1.1; nobody was asked who it is, and nothing of it is kept.
    if version == 4:
        assert bytes(peer.transport.written) == bytes((0x20, 2, 0, 2))
    else:
        assert peer.only(Connack).reason_code == ReasonCode.CLIENT_IDENTIFIER_NOT_VALID
    assert peer.transport.closed and peer.transport.asked is None and not broker.sessions


def test_response_information_is_left_out_where_it_is_too_long(broker):
    broker.use(Limits(), Features(response_information="%u%u"))
    peer = Peer(broker)
    asked = {Property.REQUEST_RESPONSE_INFORMATION: 1}
    connack = peer.connect("c", user="u" * 40_000, properties=asked)
    assert Property.RESPONSE_INFORMATION not in connack.properties
    peer = Peer(broker)
    connack = peer.connect("d", user="me", properties=asked)
    assert connack.properties[Property.RESPONSE_INFORMATION] == "meme"


# --- how faults are told -------------------------------------------------------------------------


def raising(place: Callable[[], None]) -> Exception:
    try:
        place()
    except Exception as error:
        return error
    raise AssertionError


def test_a_place_is_reported_once_and_a_flood_is_not_logged(escaped, caplog):
    faults = Faults()
    reported: list[str] = []

    def report(error: BaseException, what: str) -> str:
        reported.append(what)
        return "/state/crashes/fault-1.txt"

    faults.report = report
    for _ in range(1000):
        faults.caught("entry", raising(fail), "client 'x'")
    assert reported == ["a fault in the appliance (entry) while it served client 'x'"]
    assert faults.count == faults.by_entry["entry"] == 1000
    assert faults.reported == "/state/crashes/fault-1.txt"
    ended = "BrokenError: on purpose; that alone is ended, all else goes on"
    assert f"{ended}. The report is /state" in caplog.text
    assert len(caplog.records) == 6
    faults.caught("another", raising(fail))
    assert len(reported) == 2
    escaped.clear()


def test_of_very_many_places_few_are_remembered(escaped, caplog):
    faults = Faults()
    for n in range(10 * PLACES):
        faults.caught(f"entry {n}", raising(fail))
    assert faults.count == 10 * PLACES and len(faults._places) == PLACES
    escaped.clear()


def test_to_tell_of_a_fault_is_none(escaped):
    class Nameless:
        __str__ = fail  # type: ignore[assignment]

    faults = Faults()
    faults.caught("entry", raising(fail), Nameless())
    faults.report = fail  # type: ignore[assignment]
    faults.caught("another", BrokenError("x" * 10_000_000))
    assert faults.count == 2 and len(faults.last) < 1000
    assert faults.run("third", fail, otherwise=7) == 7
    escaped.clear()


# --- faults at the beginning and at the end of a connection --------------------------------------


def once(monkeypatch: pytest.MonkeyPatch, owner: object, name: str) -> None:
    """Let a method fail the first time that it is called."""
    own = getattr(owner, name)

    def failing(*args: Any, **more: Any) -> Any:
        monkeypatch.setattr(owner, name, own)
        raise BrokenError(name)

    monkeypatch.setattr(owner, name, failing)


#: What the end of a connection consists of: the object and its method.
PARTS: list[tuple[Callable[[Broker, Peer], object], str]] = [
    (lambda broker, peer: Session, "forget_transient"),
    (lambda broker, peer: broker, "_hand_over"),
    (lambda broker, peer: broker.observer, "disconnected"),
    (lambda broker, peer: broker.audit_log, "disconnected"),
    (lambda broker, peer: broker, "_publish_late"),
    (lambda broker, peer: broker.store, "session_saved"),
    (lambda broker, peer: broker.store, "session_removed"),
    (lambda broker, peer: broker.router, "leave"),
    (lambda broker, peer: PublisherAllowance, "stop_waiting"),
    (lambda broker, peer: peer.client.protocol, "close"),
    (lambda broker, peer: peer.client.output, "end"),
]


@pytest.mark.patches
@pytest.mark.parametrize("others", [0, 1])
def test_an_ended_session_is_no_member_of_its_group(broker, other, monkeypatch, escaped, others):
    """Whatever fails: what the group has goes to who is there, and not to it again."""
    member = Peer(broker, 4)
    member.connect("member", clean=False)
    member.subscribe("$share/g/t", 1)
    member.slow()
    second = Peer(broker, 4)
    for number in range(30):
        other.publish("t", b"%d" % number, 1)
    if others:
        second.connect("second")
        second.subscribe("$share/g/t", 1)
    leave, calls = broker.router.leave, []

    def fails_once(router, session, topic_filter):
        calls.append(topic_filter)
        if len(calls) == 1:
            fail()
        leave(session, topic_filter)

    monkeypatch.setattr(type(broker.router), "leave", fails_once)
    session = member.session
    member.lose()
    Peer(broker, 4).connect("member", clean=True)  # ends the one before
    assert calls == ["$share/g/t"] * 2
    assert all(session not in share.members for share in broker.router.shares.values())
    assert not session.queue and not session.inflight
    other.publish("t", b"after", 1)
    assert not session.queue
    if others:
        waiting = len(second.session.inflight) + len(second.session.queue)
        assert waiting == 31, "what was left, and what came then"
    assert escaped
    escaped.clear()


def comes_back(broker, other, properties):
    """The client `a` is let in again, and nothing is left of what went wrong."""
    again = join(broker, "a", properties=properties)
    assert again.session.link is again.client.output
    goes_on(broker, other)
    check_accounts(broker)


@pytest.mark.patches
@pytest.mark.parametrize("expiry", [0, 60])
@pytest.mark.parametrize("leaves", [False, True], ids=["lost", "disconnects"])
@pytest.mark.parametrize(("whose", "name"), PARTS, ids=[name for _, name in PARTS])
def test_an_end_comes_to_its_end(broker, other, monkeypatch, escaped, whose, name, leaves, expiry):
    broker.observer, broker.audit_log = Mock(), Mock()
    departed: list[str] = []
    broker.departures.append(lambda session: departed.append(session.client_id))
    keeps = {Property.SESSION_EXPIRY_INTERVAL: expiry}
    other.subscribe("will", 1)
    peer = join(broker, "a", properties=keeps, will=Will("will", b"w", 1))
    peer.subscribe("x", 1)
    account, subscriptions = peer.session.account, len(broker.router)
    once(monkeypatch, whose(broker, peer), name)
    if leaves:
        try:
            peer.send(Disconnect())
        except BrokenError as error:  # as the wire does it
            broker.fault("connection.chunk", error, peer.client)
    else:
        try:
            peer.lose()
        except BrokenError as error:
            broker.fault("connection.lost", error, peer.client)
    broker.flush()
    assert peer.transport.closed, "at once, not when the wire's patience is over"
    assert len(broker.router) == subscriptions - (0 if expiry else 1)
    assert peer.client not in broker.clients
    assert account.connections == (1 if account is other.session.account else 0)
    assert departed == ["a"]
    session = broker.sessions.get("a")
    if expiry:
        assert session is not None and session.link is None and session.ends_at is not None
    else:
        assert session is None and not broker.router.shares
    assert peer.client._held == 0
    wills = [each for each in other.received() if isinstance(each, Publish)]
    if name != "_publish_late":
        assert len(wills) == (0 if leaves else 1)
    monkeypatch.undo()
    comes_back(broker, other, keeps)
    escaped.clear()


@pytest.mark.patches
@pytest.mark.parametrize("done", [False, True], ids=["before", "behind"])
@pytest.mark.parametrize("topic_filter", ["t", "$share/g/t"])
@pytest.mark.parametrize("what", ["join", "leave"])
def test_a_subscription_is_there_or_it_is_not(
    broker, other, monkeypatch, escaped, what, topic_filter, done
):
    """Not for the client alone, nor in the tree alone: from there nobody would take it."""
    keeps = {Property.SESSION_EXPIRY_INTERVAL: 60}
    peer, before = join(broker, "a", properties=keeps), len(broker.router)
    if what == "leave":
        peer.subscribe(topic_filter, 1)
    own, calls = getattr(broker.router, what), []

    def fails_once(*args: Any) -> None:
        calls.append(args)
        if done or len(calls) > 1:
            own(*args)
        if len(calls) == 1:
            fail()

    monkeypatch.setattr(broker.router, what, fails_once)
    try:
        if what == "join":
            peer.client.receive(Subscribe(1, [Subscription(topic_filter, 1)]).encode(5))
        else:
            peer.client.receive(Unsubscribe(1, [topic_filter]).encode(5))
    except BrokenError as error:
        broker.fault("connection.chunk", error, peer.client)
    broker.flush()
    monkeypatch.undo()
    session = broker.sessions["a"]
    assert not session.subscriptions and not broker.router.shares
    assert len(broker.router) == before
    other.publish("t", b"not for it", 1)
    assert not session.queue and not session.inflight
    if what == "leave":
        assert peer.only(Unsuback).reason_codes == [ReasonCode.SUCCESS]
    again = join(broker, "a", properties=keeps)
    again.subscribe(topic_filter, 1)
    other.publish("t", b"for it", 1)
    assert again.payloads() == [b"for it"]
    check_accounts(broker)
    escaped.clear()


@pytest.mark.patches
@pytest.mark.parametrize("done", [False, True], ids=["before", "behind"])
def test_what_an_ended_session_held_is_given_back(broker, other, monkeypatch, escaped, done):
    keeps = {Property.SESSION_EXPIRY_INTERVAL: 60}
    peer = join(broker, "a", properties=keeps)
    peer.subscribe("t", 1)
    session = peer.client.session
    peer.lose()
    other.publish("t", bytes(1000), 1)
    assert session.bytes > 1000
    own, calls = Session.clear, []

    def fails_once(self: Session) -> None:
        calls.append(self)
        if done or len(calls) > 1:
            own(self)
        if len(calls) == 1:
            fail()

    monkeypatch.setattr(Session, "clear", fails_once)
    join(broker, "a", clean=True)
    assert calls == [session, session] and not session.bytes
    check_accounts(broker)
    escaped.clear()


@pytest.mark.patches
@pytest.mark.parametrize("present", [False, True])
@pytest.mark.parametrize("name", ["session_saved", "reconnected", "set_will", "open", "accept"])
def test_a_fault_at_the_end_of_a_login_leaves_nobody_connected(
    broker, other, monkeypatch, escaped, name, present
):
    keeps = {Property.SESSION_EXPIRY_INTERVAL: 60}
    if present:
        join(broker, "a", properties=keeps).lose()
    peer = Peer(broker)
    peer.say_connect("a", properties=keeps, will=Will("other/will", b"w", 1))
    owner = {
        "session_saved": broker.store,
        "reconnected": Session,
        "set_will": Session,
        "open": peer.client.output,
        "accept": peer.client.protocol,
    }[name]
    once(monkeypatch, owner, name)
    try:
        peer.client.accept("user")
    except BrokenError as error:
        broker.fault("connection.turn", error, peer.client)
    broker.flush()
    assert peer.only(Connack).reason_code == FAULT
    assert peer.transport.closed and peer.client not in broker.clients
    session = broker.sessions.get("a")
    assert session is None or session.link is None
    assert not [each for each in other.received() if isinstance(each, Publish)]
    monkeypatch.undo()
    comes_back(broker, other, keeps)
    escaped.clear()


def test_who_waits_for_no_commit_is_written_to_when_the_store_cannot_be_hurried(
    broker, store, other, escaped
):
    keeper = join(broker, "keeper", properties={Property.SESSION_EXPIRY_INTERVAL: 60})
    other.subscribe("free", 0)
    store.holding = True
    store.hurry = fail
    keeper.client.receive(
        Subscribe(1, [Subscription("x", 1)]).encode(5) + Publish("free", b"1").encode(5)
    )
    broker.flush()
    assert other.payloads() == [b"1"] and not keeper.received()
    store.commit()
    assert keeper.received()
    assert set(broker.faults.by_entry) == {"commit.hurry"}
    escaped.clear()


def test_the_bytes_of_a_session_go_with_it_to_its_user(broker):
    """As of one that was made for a plugin before anybody had logged in."""
    accounts = broker.accounting.accounts
    session = broker.attach("claimed", InsideLink())
    broker.subscribe(session, Subscription("a/long/filter", 1))
    held = session.bytes
    before = accounts.inside.bytes
    assert held
    broker.claim(session, Identity("user", "claimed"))
    assert accounts.of_user("user").bytes == held
    assert accounts.inside.bytes == before - held
