"""Quotas of users: whatever one user holds, the others have their share."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from appliance.broker.accounts import ACCOUNTS, Quota
from appliance.broker.broker import Broker
from appliance.broker.limits import Features, Limits, UserLimits
from appliance.broker.message import Message
from appliance.broker.values import Action, Identity
from appliance.mqtt.codec import Property
from appliance.mqtt.connect import Connack
from appliance.mqtt.packets import (
    Packet,
    Puback,
    Publish,
    Pubrec,
    Pubrel,
    Suback,
    Subscribe,
    Subscription,
    Will,
)
from appliance.mqtt.reason import ReasonCode

from .conftest import FakeAccess, FakeStore, Join, Peer, lasting

FULL = ReasonCode.QUOTA_EXCEEDED


class Caller(Peer):
    """A client that may be refused: `code` says whether it was."""

    code = 0


def try_to_connect(
    broker: Broker, client_id: str, user: str | None, version: int = 5, **options: object
) -> Caller:
    caller = Caller(broker, version)
    caller.code = caller.connect(client_id, user=user, **options).reason_code
    return caller


def leave_sessions(broker: Broker, user: str | None, count: int, first: int = 0) -> list[int]:
    """So many sessions without a client, and the answers to their CONNECTs."""
    codes = []
    for number in range(first, first + count):
        peer = try_to_connect(broker, f"{user}-{number}", user, **lasting(5))
        codes.append(peer.code)
        peer.lose()
        broker.tick(broker.now + 1)
    return codes


# --- the arithmetic


@pytest.mark.parametrize(
    ("whole", "own", "held", "total", "size", "allowed"),
    [
        (100, None, 0, 75, 25, True),  # a quarter is sure
        (100, None, 0, 76, 25, False),  # as long as there is any
        (100, None, 0, 0, 50, True),  # more is lent, up to the half
        (100, None, 0, 0, 51, False),
        (100, None, 20, 60, 5, True),
        (100, None, 20, 60, 6, False),
        (100, 60, 0, 0, 60, True),  # a configured one is all there is
        (100, 60, 0, 0, 61, False),
        (100, 60, 30, 70, 30, True),
        (100, 60, 30, 71, 30, False),
        (100, 1000, 0, 0, 100, True),
        (100, 1000, 0, 0, 101, False),
        (100, 0, 0, 0, 1, False),
        (1, None, 0, 0, 1, True),
        (0, None, 0, 0, 1, False),
    ],
)
def test_what_a_user_may_hold(whole, own, held, total, size, allowed):
    assert Quota.of(whole, own).allows(held, total, size) is allowed


def test_accounts_that_hold_nothing_are_forgotten(broker: Broker):
    accounts = broker.accounting.accounts
    keeper = try_to_connect(broker, "keeper", "keeper")
    for number in range(5 * ACCOUNTS):
        try_to_connect(broker, "visitor", f"user-{number}").lose()
        assert len(accounts) <= 2 * ACCOUNTS
    assert accounts.of(Identity("keeper", "x")) is keeper.session.account


# --- sessions


@pytest.mark.parametrize("limits", [Limits(sessions=8)])
def test_a_user_alone_may_have_all_sessions(broker: Broker):
    assert leave_sessions(broker, "mallory", 8) == [0] * 8
    assert len(broker.sessions) == 8


def own_limit(sessions: int) -> Limits:
    return Limits(user=UserLimits(sessions=sessions))


@pytest.mark.parametrize("version", [4, 5])
@pytest.mark.parametrize(
    ("limits", "key"),
    [(Limits(sessions=4), "broker.limits.sessions"), (own_limit(4), "broker.limits.user.sessions")],
)
def test_no_user_is_kept_out_by_absent_sessions_of_its_own(
    broker: Broker, store: FakeStore, version: int, key: str, caplog: pytest.LogCaptureFixture
):
    leave_sessions(broker, "alice", 4)
    peer = try_to_connect(broker, "alice-stops-the-robot", "alice", version=version)
    assert peer.code == 0
    assert "alice-0" not in broker.sessions and "alice-0" not in store.sessions
    assert {"alice-1", "alice-2", "alice-3"} <= set(broker.sessions)
    assert "client 'alice-0' (user 'alice') makes room for another session of its" in caplog.text
    assert f"there may be no more ({key})" in caplog.text
    assert broker.counters.evicted == 1


@pytest.mark.parametrize("limits", [Limits(sessions=8)])
def test_on_a_tie_the_oldest_absent_session_of_the_user_itself_goes(broker: Broker):
    leave_sessions(broker, "alice", 4)
    leave_sessions(broker, "bob", 4)
    for user, other in (("alice", "bob"), ("bob", "alice")):
        peer = try_to_connect(broker, f"{user}-new", user)
        assert peer.code == 0
        assert f"{user}-0" not in broker.sessions
        assert f"{other}-3" in broker.sessions
    kept = {user: [name for name in broker.sessions if name.startswith(user)]
            for user in ("alice", "bob")}  # fmt: skip
    assert {user: len(names) for user, names in kept.items()} == {"alice": 4, "bob": 4}


@pytest.mark.parametrize("limits", [Limits(sessions=3), own_limit(3)])
def test_a_user_whose_sessions_are_all_in_use_is_refused(broker: Broker, join: Join):
    crowd = [join(f"m-{number}", user="mallory") for number in range(3)]
    refused = try_to_connect(broker, "one-more", "mallory")
    assert refused.code == FULL
    assert not any(peer.transport.closed for peer in crowd)


@pytest.mark.parametrize("limits", [Limits(sessions=8)])
def test_another_user_takes_the_place_of_the_session_whose_client_left_first(
    broker: Broker, store: FakeStore, caplog: pytest.LogCaptureFixture
):
    leave_sessions(broker, "mallory", 8)
    back = try_to_connect(broker, "mallory-0", "mallory", **lasting(5))  # not the oldest any more
    back.lose()
    alice = try_to_connect(broker, "alice", "alice", **lasting(5))
    assert alice.code == 0
    assert "mallory-1" not in broker.sessions and "mallory-0" in broker.sessions
    assert "mallory-1" not in store.sessions and "alice" in store.sessions
    assert "client 'mallory-1' (user 'mallory') makes room for user 'alice'" in caplog.text
    assert "broker.limits.user.sessions" in caplog.text
    assert broker.counters.evicted == 1


@pytest.mark.parametrize("limits", [Limits(sessions=8)])
def test_who_has_most_makes_room_and_nobody_else(broker: Broker):
    leave_sessions(broker, "bob", 2)
    leave_sessions(broker, "mallory", 6)
    assert leave_sessions(broker, "alice", 3) == [0] * 3
    kept = {user: len([name for name in broker.sessions if name.startswith(user)])
            for user in ("alice", "bob", "mallory")}  # fmt: skip
    assert kept == {"alice": 3, "bob": 2, "mallory": 3}
    # All have as much as each other: one more takes the place of one of the same user.
    assert leave_sessions(broker, "alice", 1, first=3) == [0]
    assert leave_sessions(broker, "mallory", 1, first=6) == [0]
    assert leave_sessions(broker, "bob", 1, first=2) == [0]  # 3 are no more than it would have
    kept = {user: len([name for name in broker.sessions if name.startswith(user)])
            for user in ("alice", "bob", "mallory")}  # fmt: skip
    assert kept == {"alice": 3, "bob": 2, "mallory": 3}
    assert leave_sessions(broker, None, 1) == [0]


@pytest.mark.parametrize("limits", [Limits(sessions=4)])
def test_the_will_of_a_session_that_makes_room_is_published(broker: Broker, join: Join):
    watcher = join("watcher", user="bob")
    watcher.subscribe("will", 1)
    will = Will("will", b"gone", 1, properties={Property.WILL_DELAY_INTERVAL: 60})
    for number in range(3):
        peer = try_to_connect(broker, f"m-{number}", "mallory", will=will, **lasting(5))
        peer.lose()
    assert watcher.payloads() == []
    assert leave_sessions(broker, "alice", 1) == [0]
    assert watcher.payloads() == [b"gone"]


@pytest.mark.parametrize("limits", [Limits(sessions=4)])
def test_a_session_in_use_makes_room_only_when_there_is_no_other(broker: Broker, join: Join):
    first, second, third = (join(f"m-{number}", user="mallory") for number in range(3))
    leave_sessions(broker, "mallory", 1)
    assert leave_sessions(broker, "alice", 1) == [0]
    assert "mallory-0" not in broker.sessions
    assert not any(peer.transport.closed for peer in (first, second, third))
    bob = try_to_connect(broker, "bob", "bob")
    assert bob.code == 0
    assert third.farewell() == FULL  # the newest
    assert not first.transport.closed and not second.transport.closed


@pytest.mark.parametrize("limits", [Limits(sessions=8)])
def test_who_comes_back_needs_no_room(broker: Broker):
    leave_sessions(broker, "alice", 1)
    leave_sessions(broker, "mallory", 7)
    for clean in (False, True):
        options = lasting(5) | {"clean": clean}
        peer = try_to_connect(broker, "mallory-0", "mallory", **options)
        assert peer.code == 0
        again = try_to_connect(broker, "mallory-0", "mallory", **options)
        assert again.code == 0
        assert len(broker.sessions) == 8
        again.lose()


@pytest.mark.parametrize("version", [4, 5])
@pytest.mark.parametrize("limits", [Limits(user=UserLimits(sessions=2))])
def test_a_configured_number_of_sessions_is_the_most(
    broker: Broker, version: int, caplog: pytest.LogCaptureFixture
):
    for number in range(2):
        try_to_connect(broker, f"m-{number}", "mallory")
    peer = try_to_connect(broker, "third", "mallory", version=version)
    # 3.1.1 table 3.1 has no quota
    assert peer.code == (FULL if version == 5 else ReasonCode.SERVER_UNAVAILABLE)
    assert "user 'mallory' has 2 sessions" in caplog.text
    assert "broker.limits.user.sessions" in caplog.text
    assert leave_sessions(broker, "alice", 2) == [0, 0]


def test_a_refused_connect_changes_nothing(broker: Broker):
    limits = Limits(user=UserLimits(connections=1))
    broker.use(limits, Features())
    try_to_connect(broker, "present", "mallory")
    other = try_to_connect(broker, "absent", "alice", **lasting(5))
    other.lose()
    other = try_to_connect(broker, "second", "alice")
    before = broker.sessions["absent"]
    refused = try_to_connect(broker, "absent", "alice", clean=True)
    assert refused.code == FULL
    assert broker.sessions["absent"] is before and before.persistent
    assert not other.transport.closed


# --- connections


@pytest.mark.parametrize("limits", [Limits(connections=4)])
def test_the_newest_connection_of_who_has_most_makes_room(broker: Broker, join: Join, caplog):
    crowd = [join(f"m-{number}", user="mallory", **lasting(5)) for number in range(4)]
    alice = try_to_connect(broker, "alice", "alice")
    assert alice.code == 0
    assert crowd[3].farewell() == FULL
    assert not any(peer.transport.closed for peer in crowd[:3])
    assert "m-3" in broker.sessions, "its session goes on without it"
    assert "broker.limits.user.connections" in caplog.text
    again = try_to_connect(broker, "m-3", "mallory")
    assert again.code == FULL
    assert not alice.transport.closed
    crowd[0].lose()
    again = try_to_connect(broker, "m-3", "mallory")
    assert again.code == 0


def connect_many(broker: Broker, user: str, count: int) -> list[Caller]:
    callers = [try_to_connect(broker, f"{user}-{number}", user) for number in range(count)]
    return [caller for caller in callers if caller.code == 0]


@pytest.mark.parametrize(
    "limits", [Limits(connections=16, sessions=100), Limits(connections=100, sessions=16)]
)
def test_small_users_end_no_connection_beyond_their_sure_share(broker: Broker):
    fleet = connect_many(broker, "fleet", 10)
    small = [peer for user in ("low", "low2") for peer in connect_many(broker, user, 10)]
    # The first got what was free; the second its quarter, which the fleet had beyond its own.
    ended = [peer for peer in fleet if peer.transport.closed]
    assert len(ended) <= 4
    by_user = {user: len([p for p in small if p.session.identity.username == user
                          and not p.transport.closed]) for user in ("low", "low2")}  # fmt: skip
    assert by_user["low2"] == 4
    assert by_user["low"] + len(fleet) - len(ended) == 12
    assert by_user["low"] >= 4


@pytest.mark.parametrize(
    "limits", [Limits(connections=16, sessions=100), Limits(connections=100, sessions=16)]
)
def test_who_has_its_sure_share_takes_no_connection_of_who_has_more(broker: Broker):
    small = connect_many(broker, "low", 4)
    fleet = connect_many(broker, "fleet", 12)
    refused = try_to_connect(broker, "low-more", "low")
    assert refused.code == FULL
    assert not any(peer.transport.closed for peer in small + fleet)
    alice = try_to_connect(broker, "alice", "alice")
    assert alice.code == 0
    assert [peer.transport.closed for peer in fleet] == [False] * 11 + [True]
    assert not any(peer.transport.closed for peer in small)


@pytest.mark.parametrize("limits", [Limits(connections=16, user=UserLimits(connections=10))])
def test_who_keeps_within_a_configured_number_loses_no_connection(broker: Broker):
    fleet = connect_many(broker, "fleet", 10)
    assert len(connect_many(broker, "low", 10)) == 6
    assert connect_many(broker, "low2", 10) == []
    assert not any(peer.transport.closed for peer in fleet)


@pytest.mark.parametrize("limits", [Limits(connections=4, sessions=4)])
def test_who_is_refused_for_its_session_ends_no_connection(broker: Broker, join: Join):
    """It would have a connection of who has most, and there is no session for it."""
    alice = try_to_connect(broker, "alice", "alice", **lasting(5))
    crowd = connect_many(broker, "mallory", 3)
    alice.lose()
    late = try_to_connect(broker, "late", "mallory")
    assert late.code == FULL
    broker.use(Limits(connections=3, sessions=4, user=UserLimits(sessions=0)), Features())
    refused = try_to_connect(broker, "bob", "bob")
    assert refused.code == FULL
    assert not any(peer.transport.closed for peer in crowd)
    assert broker.counters.evicted == 0


@pytest.mark.parametrize("limits", [Limits(connections=2)])
def test_a_take_over_needs_no_connection_more(broker: Broker, join: Join):
    join("a", user="alice")
    join("b", user="bob")
    join("a", user="alice")
    assert broker.counters.evicted == 0


@pytest.mark.parametrize("version", [4, 5])
@pytest.mark.parametrize("limits", [Limits(user=UserLimits(connections=2))])
def test_a_configured_number_of_connections_is_the_most(
    broker: Broker, join: Join, version, caplog
):
    join("a", user="mallory")
    join("b", user="mallory")
    refused = try_to_connect(broker, "c", "mallory", version=version)
    assert refused.code == (FULL if version == 5 else ReasonCode.SERVER_UNAVAILABLE)
    assert "broker.limits.user.connections" in caplog.text
    join("d", user=None)  # anonymous ones are a user of their own
    join("e", user=None)
    refused = try_to_connect(broker, "f", None)
    assert refused.code == FULL


# --- memory


def hoard(broker: Broker, user: str, clients: int) -> None:
    """Absent sessions that fill the memory, as far as they may."""
    for number in range(clients):
        peer = try_to_connect(broker, f"{user}-{number}", user, **lasting(5))
        if peer.code == 0:
            peer.subscribe("flood", 1)
            peer.lose()
    publisher = try_to_connect(broker, f"{user}-source", user)
    for _ in range(200):
        publisher.publish("flood", bytes(2000), 1)
    publisher.lose()


@pytest.mark.parametrize("limits", [Limits(memory=1 << 20, connections=100)])
def test_memory_is_shared(broker: Broker, join: Join, store: FakeStore):
    hoard(broker, "mallory", 20)
    accounting = broker.accounting
    held = accounting.accounts.of_user("mallory").bytes
    assert 0.45 * accounting.memory < held <= 0.5 * accounting.memory, (
        "half is lent to who is alone"
    )
    absent = join("alice-absent", user="alice", **lasting(5))
    absent.subscribe("news", 1)
    absent.lose()
    alice = join("alice", user="alice")
    share = accounting.memory // 4
    while accounting.accounts.of_user("alice").bytes + 4000 < share:
        assert alice.publish("news", bytes(1000), 1) == 0
    assert alice.subscribe("x/y", 1) == 1
    mallory = join("m", user="mallory")
    deep = "/".join("x" * 200)
    assert mallory.subscribe(deep, 0) == FULL
    with_will = try_to_connect(broker, "w", "mallory", will=Will("will", bytes(20_000), 1))
    assert with_will.code == FULL


@pytest.mark.parametrize("limits", [Limits(memory=1 << 20, user=UserLimits(memory=100_000))])
def test_a_configured_memory_is_the_most(broker: Broker):
    hoard(broker, "mallory", 5)
    assert 90_000 < broker.accounting.accounts.of_user("mallory").bytes <= 100_000


@pytest.mark.parametrize("limits", [Limits(memory=1 << 20, connections=1)])
def test_unfinished_packets_are_the_users(broker: Broker, join: Join):
    peer = join("mallory", user="mallory")
    account = peer.session.account
    peer.send(Publish("t", bytes(300_000)).encode(5)[:200_000])
    assert account.bytes == 200_000
    peer.lose()
    assert account.bytes == 0


# --- retained messages


@pytest.mark.parametrize("limits", [Limits(retained_messages=40)])
def test_retained_messages_are_shared(broker: Broker, join: Join, caplog):
    mallory = join("mallory", user="mallory")
    codes = [mallory.publish(f"m/{n}", b"x", 1, retain=True) for n in range(30)]
    assert codes.count(FULL) == 10, "half is lent"
    assert "user 'mallory' has 20 retained messages" in caplog.text
    assert "broker.limits.user.retained_messages" in caplog.text
    alice, bob = join("alice", user="alice"), join("bob", user="bob")
    for peer, name in ((alice, "a"), (bob, "b")):
        codes = [peer.publish(f"{name}/{n}", b"x", 1, retain=True) for n in range(11)]
        assert codes.count(FULL) == 1, "a quarter is sure"
    assert mallory.publish("m/0", b"y", 1, retain=True) != FULL  # no growth
    assert mallory.publish("m/1", b"yyy", 1, retain=True) == FULL


@pytest.mark.parametrize("limits", [Limits(retained_bytes=100_000)])
def test_retained_bytes_are_shared(broker: Broker, join: Join):
    mallory = join("mallory", user="mallory")
    codes = [mallory.publish(f"m/{n}", bytes(8000), 1, retain=True) for n in range(12)]
    assert codes.count(FULL) == 7
    alice = join("alice", user="alice")
    assert [alice.publish(f"a/{n}", bytes(10_000), 1, retain=True) for n in range(3)].count(
        FULL
    ) == 1


def test_a_retained_message_is_in_the_account_of_its_last_publisher(broker: Broker, join: Join):
    accounts = broker.accounting.accounts
    alice, mallory = join("alice", user="alice"), join("mallory", user="mallory")
    alice.publish("t", b"x", 0, retain=True)
    mallory.publish("t", b"xyz", 0, retain=True)
    assert (accounts.of_user("alice").retained, accounts.of_user("mallory").retained) == (0, 1)
    inside = broker.attach("inside", FakeLink())
    broker.publish(Message("t", b"inside", retain=True), inside)
    assert (accounts.of_user("mallory").retained, accounts.inside.retained) == (0, 1)
    alice.publish("t", b"", 0, retain=True)
    assert accounts.inside.retained == accounts.inside.retained_bytes == 0
    broker.detach(inside)


@pytest.mark.parametrize("limits", [Limits(retained_messages=4)])
def test_the_appliance_itself_retains_whatever_users_have(broker: Broker, join: Join):
    for user in ("mallory", "eve", "trudy"):
        peer = join(user, user=user)
        for number in range(4):
            peer.publish(f"{user}/{number}", b"x", 0, retain=True)
    assert broker.accounting.accounts.retained == 4
    inside = broker.attach("inside", FakeLink())
    for number in range(4):
        broker.publish(Message(f"state/{number}", b"online", retain=True), inside)
        assert broker.retained.get(f"state/{number}") is not None
    # Nor does what it has take anything from them.
    peer.publish("trudy/0", b"", 0, retain=True)
    peer.publish("mallory/0", b"", 0, retain=True)
    assert join("alice", user="alice").publish("a", b"x", 1, retain=True) != FULL
    broker.detach(inside)


# --- what is stored


def test_the_store_is_shared(broker: Broker, store: FakeStore, join: Join):
    store.size = 1_000_000
    broker.use(broker.limits, Features())
    for user in ("mallory", "alice"):
        peer = join(user, user=user, **lasting(5))
        peer.subscribe(user, 1)
        peer.lose()
    publisher = join("publisher", user="carol")
    store.bytes = 600_000  # as the real store would have counted
    broker.accounting.accounts.of_user("mallory").stored = 500_000
    assert publisher.publish("mallory", bytes(1000), 1) == FULL
    assert publisher.publish("alice", bytes(1000), 1) == 0
    broker.accounting.accounts.of_user("alice").stored = 250_000
    assert publisher.publish("alice", bytes(1000), 1) == FULL
    assert join("eve", user="eve").publish("e", bytes(1000), 1, retain=True) != FULL
    store.bytes = 1_000_000
    assert join("eve", user="eve").publish("f", bytes(1000), 1, retain=True) == FULL
    for user in ("mallory", "alice"):
        broker.accounting.accounts.of_user(user).stored = 0


# --- what is told: whose share is full, and which key says how much it is


def words(packet: Packet) -> str:
    properties = getattr(packet, "properties", None) or {}
    return str(properties.get(Property.REASON_STRING, ""))


def answer(peer: Peer, packet: Packet) -> Packet:
    """What a packet is answered with; what else comes is passed over."""
    peer.send(packet)
    return next(p for p in peer.received() if isinstance(p, Puback | Pubrec | Suback))


def refused_words(broker: Broker, user: str, limits: Limits, **options: object) -> str:
    broker.use(limits, Features(reason_strings=True))
    caller = Caller(broker)
    connack = caller.connect("refused", user=user, **options)
    assert connack.reason_code == FULL
    return words(connack)


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        (
            Limits(connections=2),
            "all 2 connections are in use (broker.limits.connections); user 'a' has 2 of them",
        ),
        (
            Limits(sessions=2),
            "all 2 sessions are in use (broker.limits.sessions); user 'a' has 2 of them",
        ),
        (
            Limits(user=UserLimits(connections=2)),
            "user 'a' has 2 connections, as many as a user may have "
            "(broker.limits.user.connections)",
        ),
        (
            own_limit(2),
            "user 'a' has 2 sessions, as many as a user may have (broker.limits.user.sessions)",
        ),
    ],
)
def test_a_refused_connect_says_which_share_is_full(
    broker: Broker, join: Join, limits: Limits, expected: str, caplog: pytest.LogCaptureFixture
):
    join("one", user="a")
    join("two", user="a")
    assert refused_words(broker, "a", limits) == expected
    assert expected in caplog.text


def test_a_refused_will_says_which_share_is_full(broker: Broker):
    will = Will("will", bytes(20_000), 1)
    limits = Limits(user=UserLimits(memory=10_000))
    said = refused_words(broker, "a", limits, will=will)
    assert said == (
        "no room for its will: its user's share of the memory is full (broker.limits.user.memory)"
    )


def test_no_words_unless_they_are_configured_nor_where_they_do_not_fit(broker: Broker, join: Join):
    join("one", user="a")
    limits = Limits(connections=1)
    small = {Property.MAXIMUM_PACKET_SIZE: 20}
    assert refused_words(broker, "a", limits, properties=small) == ""
    broker.use(limits, Features())
    assert words(Caller(broker).connect("refused", user="a")) == ""


def test_who_may_not_come_in_is_not_told_why(broker: Broker):
    """Nor who is known here: that is for the log alone."""
    broker.use(Limits(), Features(reason_strings=True))
    peer = Peer(broker)
    peer.say_connect("c")
    peer.client.refuse(ReasonCode.NOT_AUTHORIZED, "a wrong password for user 'root'")
    broker.flush()
    assert words(peer.only(Connack)) == ""
    assert try_to_connect(broker, "of-alice", "alice").code == 0
    connack = Peer(broker).connect("of-alice", user="mallory")
    assert connack.reason_code == ReasonCode.CLIENT_IDENTIFIER_NOT_VALID
    assert words(connack) == ""


@pytest.mark.parametrize("qos", [1, 2])
@pytest.mark.parametrize(
    ("limits", "key"),
    [
        (Limits(queue_messages=1), "broker.limits.queue_messages"),
        (Limits(queue_bytes=3000), "broker.limits.queue_bytes"),
        (Limits(user=UserLimits(memory=3000)), "broker.limits.user.memory"),
        (Limits(user=UserLimits(stored=1500)), "broker.limits.user.stored"),
        (Limits(memory=3400, user=UserLimits(memory=10**9)), "broker.limits.memory"),
    ],
)
def test_a_refused_message_says_whose_queue_has_no_room(
    broker: Broker,
    store: FakeStore,
    join: Join,
    qos: int,
    limits: Limits,
    key: str,
    caplog: pytest.LogCaptureFixture,
):
    broker.features = Features(reason_strings=True)
    absent = join("absent", user="bob", **lasting(5))
    absent.subscribe("t", 2)
    absent.lose()
    publisher = join("publisher", user="alice")
    store.size = 1_000_000
    broker.use(limits, broker.features)
    bob = broker.accounting.accounts.of_user("bob")
    for number in range(1, 6):
        got = answer(publisher, Publish("t", bytes(1000), qos, packet_id=number))
        if got.reason_code:
            break
        if qos == 2:
            publisher.send(Pubrel(number))
        bob.stored += 1000  # as the real store would have counted
    assert got.reason_code == FULL
    assert words(got).startswith("nobody who subscribed to its topic has room for it: ")
    assert f"({key})" in words(got)
    assert "bob" not in words(got), "it is not the publisher's matter who subscribed"
    if qos == 1:
        broker.tick(broker.now + 1)
        assert "client 'absent' (user 'bob') has been away" in caplog.text
        assert f"({key})" in caplog.text
    bob.stored = 0


@pytest.mark.parametrize("qos", [1, 2])
def test_a_message_that_cannot_be_retained_says_whose_share_is_full(
    broker: Broker, join: Join, qos: int, caplog: pytest.LogCaptureFixture
):
    broker.use(Limits(retained_messages=4), Features(reason_strings=True))
    peer = join("m", user="mallory")
    for number in range(3):
        got = answer(peer, Publish(f"m/{number}", b"x", 1, True, packet_id=1))
    assert got.reason_code == FULL
    reason = (
        "its user's share of the room for retained messages is full "
        "(broker.limits.user.retained_messages)"
    )
    assert words(got) == f"no room to retain it: {reason}"
    assert f"no room to retain 'm/2': {reason}; user 'mallory' has 2 " in caplog.text
    for user in ("eve", "trudy"):
        assert join(user, user=user).publish(f"{user}/0", b"x", 1, retain=True) != FULL
    got = answer(peer, Publish("m/9", b"x", 1, True, packet_id=1))
    assert "there is no room for retained messages left (broker.limits.retained_messages)" in (
        words(got)
    )


def test_a_refused_subscription_says_which_share_is_full(broker: Broker, join: Join, access):
    broker.use(Limits(subscriptions=1), Features(reason_strings=True))
    access.deny("user", Action.SUBSCRIBE, "no/#")
    peer = join("m")
    filters = [Subscription("a"), Subscription("b"), Subscription("no/x")]
    got = answer(peer, Subscribe(1, filters))
    assert isinstance(got, Suback) and got.reason_codes[:2] == [0, FULL]
    assert words(got) == "'b': it has 1 subscriptions (broker.limits.subscriptions)"
    broker.use(Limits(user=UserLimits(memory=10)), broker.features)
    deep = "/".join("x" * 200)
    got = answer(peer, Subscribe(1, [Subscription(deep)]))
    assert words(got).endswith(
        ": no room for it: its user's share of the memory is full (broker.limits.user.memory)"
    )
    broker.use(broker.limits, Features())
    silent = join("silent")
    assert words(answer(silent, Subscribe(1, [Subscription("no/x")]))) == ""


# --- reload


def test_a_reload_takes_nothing_from_who_holds_more(broker: Broker, join: Join):
    peers = [join(f"m-{number}", user="mallory") for number in range(4)]
    for number in range(4):
        peers[0].publish(f"r/{number}", b"x", 0, retain=True)
    user = UserLimits(connections=2, sessions=2, retained_messages=2)
    broker.use(Limits(user=user), Features())
    assert not any(peer.transport.closed for peer in peers)
    assert len(broker.retained) == 4
    refused = try_to_connect(broker, "m-5", "mallory")
    assert refused.code == FULL
    assert peers[0].publish("r/0", b"y", 1, retain=True) != FULL
    assert peers[0].publish("r/5", b"y", 1, retain=True) == FULL


def test_a_session_that_a_plugin_made_is_in_the_account_of_who_takes_it_over(broker: Broker):
    class Unclaimed(Identity):
        """As of amqtt's plugins."""

    link, accounts = FakeLink(), broker.accounting.accounts
    session, _ = broker.connect(
        link, Unclaimed(None, "theirs"), clean_start=False, expiry=60, will=None
    )
    broker.disconnect(session, link, publish_will=False)
    assert session.account is accounts.inside and accounts.sessions == 0
    broker.claim(session, Identity("alice", "theirs"))
    assert session.account is accounts.of_user("alice") and accounts.sessions == 1
    peer = try_to_connect(broker, "theirs", "alice", clean=False)
    assert peer.session is session and accounts.connections == 1


# --- whatever mallory does


class FakeLink:
    """Of a part of the appliance; it takes everything."""

    writable = True

    def publish(self, *args: object) -> None:
        """It is not kept."""

    def mirror(self, packet: bytes, version: int, payload_size: int) -> bool:
        return False

    def pubrel(self, packet_id: int) -> None:
        """It is not kept."""

    def is_behind(self) -> bool:
        return False

    def later(self) -> None:
        """There is nothing to go on with."""

    def close(self, reason: ReasonCode, message: str) -> None:
        """There is no connection."""


SMALL = Limits(
    connections=8,
    sessions=16,
    memory=128 * 1024,
    queue_bytes=64 * 1024,
    retained_messages=16,
    retained_bytes=64 * 1024,
    subscriptions=50,
)


class Mallory:
    """Does what comes to its mind, with as many clients as it gets."""

    def __init__(self, broker: Broker, chance: random.Random) -> None:
        self.broker = broker
        self.chance = chance
        self.peers: list[Peer] = []

    def act(self) -> None:
        actions: list[Callable[[], None]] = [self.come, self.come, self.go, self.listen, self.say]
        self.chance.choice(actions)()
        self.peers = [peer for peer in self.peers if not peer.transport.closed]

    def come(self) -> None:
        number = self.chance.randrange(200)
        options = lasting(5) if self.chance.random() < 0.7 else {}
        will = Will("m/will", bytes(self.chance.choice((10, 20_000))), 1)
        options |= {"will": will if self.chance.random() < 0.3 else None}
        peer = try_to_connect(self.broker, f"m-{number}", "mallory", **options)
        if peer.code == 0:
            self.peers.append(peer)

    def go(self) -> None:
        if self.peers:
            self.peers.pop(self.chance.randrange(len(self.peers))).lose()

    def listen(self) -> None:
        if self.peers:
            peer = self.chance.choice(self.peers)
            number = self.chance.randrange(30)
            levels = "/x" * self.chance.choice((0, 20))
            wanted = Subscription(self.chance.choice((f"m/{number}{levels}", "m/#")), 1)
            peer.send(Subscribe(1, [wanted]))
            peer.received()

    def say(self) -> None:
        if self.peers:
            peer = self.chance.choice(self.peers)
            size = self.chance.choice((0, 10, 1000, 20_000))
            topic = f"m/{self.chance.randrange(60)}"
            retain = self.chance.random() < 0.5
            message = Publish(topic, bytes(size), 1, retain, packet_id=1).encode(5)
            if self.chance.random() < 0.2:
                message = message[:-1]  # the rest never comes: what does is taken for it
            peer.send(message)
            peer.received()


@pytest.mark.parametrize("limits", [SMALL])
@pytest.mark.parametrize("seed", range(25))
def test_whatever_mallory_does_alice_has_her_share(broker: Broker, access: FakeAccess, seed: int):
    """Sessions, connections, subscriptions, queues and retained messages, within her quarter."""
    access.deny("mallory", Action.PUBLISH, "alice/#")
    chance = random.Random(seed)
    mallory = Mallory(broker, chance)
    kept: dict[str, bytes] = {}
    owed: list[bytes] = []
    absent = try_to_connect(broker, "alice-absent", "alice", **lasting(5))
    absent.subscribe("alice/queue", 1)
    absent.lose()
    for turn in range(150):
        for _ in range(chance.randrange(8)):
            mallory.act()
        alice = try_to_connect(broker, f"alice-{turn % 2}", "alice")
        assert alice.code == 0, turn
        topic = f"alice/{chance.randrange(3)}"
        kept[topic] = b"%d" % turn
        assert alice.publish(topic, kept[topic], 1, retain=True) < 0x80, turn
        assert alice.subscribe(f"alice/+/{turn % 5}", 1) == 1, turn
        owed.append(bytes(chance.randrange(1000)))
        assert alice.publish("alice/queue", owed[-1], 1) == 0, turn
        assert not alice.transport.closed, turn
        if chance.random() < 0.5:
            alice.lose()
        else:
            alice.disconnect()
        if len(owed) == 10:
            back = try_to_connect(broker, "alice-absent", "alice", **lasting(5))
            assert [message.payload for message in back.drain()] == owed
            owed.clear()
            back.lose()
        found = {t: m.payload for t, m in broker.retained.find("alice/#")}
        assert found == kept, turn
        broker.tick(broker.now + 1)
    assert broker.sessions["alice-absent"].persistent
    used = broker.accounting.accounts.of_user("mallory")
    assert broker.counters.evicted or used.sessions < 12, "mallory has tried hard"


@pytest.mark.parametrize("limits", [Limits(memory=64 * 1024, connections=4, sessions=10_000)])
def test_sessions_that_come_and_go_do_not_outgrow_the_memory(broker: Broker):
    """What is set apart for connected clients is not had anew by each that leaves again."""
    for number in range(300):
        peer = try_to_connect(broker, f"m-{number}", "mallory", **lasting(5))
        peer.send(Subscribe(1, [Subscription("a/b", 0)]))
        peer.lose()
    assert broker.accounting.queued_bytes <= broker.limits.memory
