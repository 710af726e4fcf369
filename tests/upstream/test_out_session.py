"""What is published here is offered to a link's backlog, as the access rules and its rules say."""

from __future__ import annotations

from pathlib import Path

import pytest
from broker.conftest import FakeStore, Peer, lasting

from appliance.broker.broker import Broker
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.broker.session import REPLAYED_PER_TURN
from appliance.broker.values import Identity
from appliance.mqtt.codec import V5, V311, Property
from appliance.mqtt.packets import Pingreq, Pingresp, Puback, Publish, Pubrec, Subscription
from appliance.mqtt.reason import ReasonCode

from .local_rig import ACL, Rig, user_properties


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig(tmp_path)


def test_what_the_rules_carry_is_offered_as_it_is_there(rig: Rig) -> None:
    rig.begin()
    peer = rig.join()
    said = {
        Property.CONTENT_TYPE: "text/plain",
        Property.MESSAGE_EXPIRY_INTERVAL: 60,
        Property.USER_PROPERTY: [("a", "b")],
    }
    assert peer.publish("r2/events/door", b"open", 1, properties=said) == 0
    assert peer.publish("r2/map", b"new", 0, retain=True) == 0
    assert peer.publish("r2/else", b"not", 1) == ReasonCode.NO_MATCHING_SUBSCRIBERS
    door, map_ = rig.backlog.offers
    assert (door.topic, door.payload, door.qos, door.retain) == (
        "fleet/r2/events/door",
        b"open",
        1,
        False,
    )
    assert (door.rule.topic, door.expires_in) == ("events/#", 60.0)
    assert door.properties == {
        Property.CONTENT_TYPE: "text/plain",
        Property.USER_PROPERTY: [("a", "b"), ("appliance-via", "r2")],
    }
    assert (map_.topic, map_.qos, map_.retain, map_.rule.keep) == (
        "fleet/r2/map",
        0,
        True,
        "latest",
    )
    assert map_.expires_in is None
    assert [door.user, map_.user] == ["user", "user"]
    assert rig.out.counters.offered == 2


def test_how_a_message_waits_is_up_to_its_publishers_qos_and_the_rules_retain(
    tmp_path: Path,
) -> None:
    out = "[{topic: a, qos: 0}, {topic: b, qos: 1, retain: true}, {topic: c, retain: false}]"
    rig = Rig(tmp_path, keys=f"user: upstream, out: {out}")
    rig.begin()
    peer = rig.join()
    for topic in "abc":
        peer.publish(f"r2/{topic}", b"x", 0)
        peer.publish(f"r2/{topic}", b"x", 2, retain=True)
    assert [(each.topic[9:], each.qos, each.retain) for each in rig.backlog.offers] == [
        ("a", 0, False),
        ("a", 2, True),
        ("b", 0, True),
        ("b", 2, True),
        ("c", 0, False),
        ("c", 2, False),
    ]


def test_the_access_rules_hold_for_it(rig: Rig) -> None:
    rig.reload(ACL.replace("{robot}/secret/#", "{robot}/events/secret/#"))
    rig.begin()
    peer = rig.join()
    for topic in ("r2/events/secret/x", "r2/events/x"):
        peer.publish(topic, b"x", 1)
    assert rig.backlog.taken() == [("fleet/r2/events/x", b"x")]


def test_narrowed_rights_end_what_is_offered_and_wider_ones_begin_it(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    none = "user upstream\ntopic write {robot}/#\n\nuser user\ntopic readwrite #\n"
    rig.reload(none)
    rig.join("first").publish("r2/map", b"old", 1, retain=True)
    rig.begin()
    assert set(rig.out.denied) == {"r2/events/#", "r2/map"} and not rig.backlog.taken()
    assert "no rule lets user 'upstream'" in rig.out.denied["r2/map"]
    rig.reload(ACL)
    rig.turn()
    assert not rig.out.denied
    assert rig.backlog.taken() == [("fleet/r2/map", b"old")]  # what is retained meanwhile
    peer = rig.join()
    peer.publish("r2/events/x", b"1", 1)
    assert rig.backlog.taken() == [("fleet/r2/events/x", b"1")]
    rig.reload(none)
    peer.publish("r2/events/x", b"2", 1)
    assert not rig.backlog.taken()  # at once, and not only from the next turn on
    rig.turn()
    assert set(rig.out.denied) == {"r2/events/#", "r2/map"}
    peer.publish("r2/events/x", b"3", 1)
    assert not rig.backlog.taken() and not rig.turns
    assert rig.broker.subscription_count == 1  # for answers
    # What is refused as before is in the log already.
    said: list[object] = []
    monkeypatch.setattr(Broker, "log_rate_limited", lambda *args: said.append(args))
    rig.reload(none)
    rig.turn()
    assert set(rig.out.denied) == {"r2/events/#", "r2/map"} and not said


def test_retained_messages_are_offered_once_in_turns(rig: Rig) -> None:
    peer = rig.join()
    topics = {f"r2/events/{number}" for number in range(REPLAYED_PER_TURN + 100)}
    for topic in topics | {"r2/map", "r2/else"}:
        peer.publish(topic, topic.encode(), 1, retain=True)
    rig.begin()
    first = len(rig.backlog.offers)
    assert 0 < first <= REPLAYED_PER_TURN
    peer.publish("r2/events/0", b"newer", 1, retain=True)
    while rig.turns:
        rig.turn()
    offered = rig.backlog.offers
    assert all(each.retain and each.qos == 1 and each.user == "user" for each in offered)
    latest = {each.topic: each.payload for each in offered}
    assert latest.pop("fleet/r2/events/0") == b"newer"
    wanted = {f"fleet/{topic}": topic.encode() for topic in topics | {"r2/map"}}
    del wanted["fleet/r2/events/0"]
    assert latest == wanted
    assert len(offered) in (len(topics) + 1, len(topics) + 2)
    rig.backlog.offers.clear()
    peer.publish("r2/map", b"", 1, retain=True)  # a deletion is a message
    assert rig.backlog.taken() == [("fleet/r2/map", b"")]


def test_a_retained_message_that_two_rules_match_is_offered_by_the_first(tmp_path: Path) -> None:
    keys = 'user: upstream, out: [{topic: "a/+"}, {topic: "a/#", keep: all}], in: []'
    rig = Rig(tmp_path, keys=keys)
    peer = rig.join()
    for topic in ("r2/a/b", "r2/a/b/c"):
        peer.publish(topic, b"x", 1, retain=True)
    rig.begin()
    assert [(each.topic, each.rule.topic) for each in rig.backlog.offers] == [
        ("fleet/r2/a/b", "a/+"),
        ("fleet/r2/a/b/c", "a/#"),
    ]
    rig.backlog.offers.clear()
    peer.publish("r2/a/b", b"y", 1)
    assert rig.backlog.taken() == [("fleet/r2/a/b", b"y")]


def test_a_hundred_thousand_retained_messages_stop_nobody(rig: Rig) -> None:
    inside = rig.broker.attach("_bridge", InsideLink())
    for number in range(20_000):
        rig.broker.publish(Message(f"r2/events/{number}", b"x", 1, True), inside)
    counters = rig.broker.counters
    before = counters.cost
    rig.begin()
    turns, most = 0, counters.cost - before
    while rig.turns:
        before = counters.cost
        rig.turn()
        most = max(most, counters.cost - before)
        turns += 1
    assert turns >= 20_000 // REPLAYED_PER_TURN and most < 10_000
    assert rig.out.counters.offered == 20_000


def test_what_a_message_displaces_is_counted_and_goes_in_turns(rig: Rig) -> None:
    rig.begin()
    peer = rig.join()
    counters, backlog = rig.broker.counters, rig.backlog
    before = counters.cost
    peer.publish("r2/events/a", b"x", 1)
    assert counters.cost - before < 100 and not rig.turns
    backlog.displaced, backlog.pieces = 700, 3
    before = counters.cost
    peer.publish("r2/events/a", b"x", 1)
    assert 700 <= counters.cost - before < 800
    for _ in range(3):
        before = counters.cost
        rig.turn()
        assert counters.cost - before == 100
    assert not rig.turns


def test_what_comes_from_there_is_not_sent_back(tmp_path: Path) -> None:
    keys = 'user: upstream, out: [{topic: "#"}], in: [{topic: "mission/#"}]'
    rig = Rig(tmp_path, keys=keys)
    rig.begin()
    fleet = rig.connect()
    assert fleet.send("fleet/r2/mission/1") == 0
    assert fleet.send("fleet/r2/mission/1", retain=True) == 0
    assert rig.counters.delivered == 2
    assert not rig.backlog.taken()
    rig.join().publish("r2/mission/1", b"mine", 1)
    assert rig.backlog.taken() == [("fleet/r2/mission/1", b"mine")]


def test_a_full_backlog_refuses(rig: Rig) -> None:
    rig.begin()
    peer = rig.join()
    rig.backlog.is_full = True
    assert peer.publish("r2/events/x", b"x", 1) == ReasonCode.QUOTA_EXCEEDED
    assert peer.publish("r2/events/x", b"x", 0) == 0
    assert rig.out.counters.refused == 2 and not peer.transport.closed
    rig.backlog.is_full = False
    assert peer.publish("r2/events/x", b"x", 1) == 0


def test_a_fault_is_no_acknowledgement(rig: Rig, escaped: list[str]) -> None:
    rig.begin()
    rig.backlog.fault = RuntimeError("by the test")
    peer = rig.join()
    code = peer.publish("r2/events/x", b"x", 1)
    assert code == ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR
    assert rig.broker.faults.by_entry == {"broker.delivery": 1}
    escaped.clear()


def test_the_publisher_waits_for_the_commit(rig: Rig) -> None:
    store = rig.store
    assert isinstance(store, FakeStore)
    rig.begin()
    rig.backlog.staged = store._stage
    peer = rig.join()
    store.holding = True
    peer.send(Publish("r2/events/x", b"x", 1, packet_id=7))
    assert not peer.received()
    store.commit()
    assert isinstance(peer.only(Puback), Puback)


@pytest.mark.parametrize("version", [V311, V5])
def test_publishers_wait_while_the_disk_is_behind(rig: Rig, version: int) -> None:
    """Nobody else does, and what waits is acknowledged when it is stored."""
    store = rig.store
    assert isinstance(store, FakeStore)
    rig.begin()
    rig.backlog.staged = store._stage
    flood, other = Peer(rig.broker, version), rig.join("other")
    flood.connect("flood", user="user")
    rig.backlog.is_behind_disk = store.holding = True
    for number in range(1, 4):
        flood.send(Publish("r2/events/x", b"%d" % number, 1, packet_id=number))
    flood.send(Publish("r2/events/x", b"4", 2, packet_id=4))
    assert rig.backlog.taken() == [("fleet/r2/events/x", b"1")]  # which showed that it is behind
    flood.send(Pingreq())  # which is read nevertheless
    assert other.publish("r2/else", b"x", 1) in (0, ReasonCode.NO_MATCHING_SUBSCRIBERS)
    assert other.publish("r2/events/x", b"other", 0) == 0
    assert rig.backlog.taken() == [("fleet/r2/events/x", b"other")]
    inside = rig.broker.attach("_bridge", InsideLink())
    rig.broker.publish(Message("r2/events/x", b"ROS", 1), inside)
    assert [(each.is_acknowledged, each.user) for each in rig.backlog.offers] == [(False, None)]
    store.commit()  # too little was written: each commit lets one pass, to see how it is now
    store.holding = True
    rig.backlog.taken()
    flood.go_on()
    assert rig.backlog.taken() == [("fleet/r2/events/x", b"2")]
    puback, pingresp = flood.received()
    assert isinstance(puback, Puback) and puback.packet_id == 1
    assert isinstance(pingresp, Pingresp)
    rig.backlog.is_behind_disk = False
    store.commit()
    flood.go_on()
    assert [payload for _, payload in rig.backlog.taken()] == [b"3"]
    answers = flood.received()
    assert [(type(each), each.packet_id) for each in answers] == [
        (Puback, 2),
        (Puback, 3),
        (Pubrec, 4),
    ]
    assert not rig.broker.accounting.congested


def test_who_waits_for_a_disk_that_fails_is_refused(rig: Rig) -> None:
    store = rig.store
    assert isinstance(store, FakeStore)
    rig.begin()
    rig.backlog.staged = store._stage
    peers = [Peer(rig.broker, version) for version in (V311, V5)]
    for number, peer in enumerate(peers):
        peer.connect(f"peer {number}", user="user")
    rig.backlog.is_behind_disk = True
    assert peers[1].publish("r2/events/x", b"1", 1) == 0
    for peer in peers:
        peer.send(Publish("r2/events/x", b"2", 1, packet_id=7))
    rig.backlog.is_behind_disk = False
    rig.backlog.is_full = True  # as it is then
    store.commit(kept=False)
    for peer in peers:
        peer.go_on()
    assert peers[0].transport.closed and not peers[0].received()
    assert peers[1].only(Puback).reason_code == ReasonCode.QUOTA_EXCEEDED
    assert [payload for _, payload in rig.backlog.taken()] == [b"1"]


def test_what_a_client_leaves_behind_while_the_disk_is_behind_is_not_taken(rig: Rig) -> None:
    """It was not acknowledged. A flood of clients that come and go takes no memory."""
    rig.begin()
    peer = rig.join()
    rig.backlog.is_behind_disk = True
    for number in range(3):
        peer.send(Publish("r2/events/x", b"%d" % number, 1, packet_id=1 + number))
    peer.client.hurry()
    peer.client.lost()
    rig.broker.flush()
    assert [payload for _, payload in rig.backlog.taken()] == [b"0"]
    assert rig.broker.counters.publish_dropped == 2
    assert not rig.broker.disk._waiting


def test_what_comes_from_one_fleet_waits_for_the_disk_of_another_link(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.begin()
    fleet = rig.connect()
    name = "_upstream.other"
    other = rig.broker.attach(name, OtherLink(), Identity("upstream", name))
    rig.broker.subscribe(other, Subscription("r2/mission/#", 0))
    rig.broker.disk.begin()
    assert fleet.send("fleet/r2/mission/1") == -1 and not rig.counters.delivered
    rig.store._tell(True)  # type: ignore[attr-defined]
    fleet.turn()
    assert fleet.connection.codes() == [(1, 0)] and rig.counters.delivered == 1


class OtherLink(InsideLink):
    """The link of another link's session, while the disk is behind."""

    def must_wait(self, message: Message, client_id: str) -> bool:
        return client_id == "_upstream_in.fleet"


def test_an_expired_message_is_not_offered(rig: Rig) -> None:
    rig.begin()
    inside = rig.broker.attach("_bridge", InsideLink())
    for expires_at in (rig.now - 1, rig.now, rig.now + 1):
        rig.broker.publish(Message("r2/events/x", b"x", 1, expires_at=expires_at), inside)
    assert [each.expires_in for each in rig.backlog.offers] == [1.0]


# --- answers -----------------------------------------------------------------------------------


def test_a_request_that_goes_out_is_answered_here(rig: Rig) -> None:
    rig.begin()
    peer = rig.join()
    peer.subscribe("answers/me")
    said = {Property.RESPONSE_TOPIC: "answers/me", Property.CORRELATION_DATA: b"7"}
    assert peer.publish("r2/events/ask", b"?", 1, properties=said) == 0
    (asked,) = rig.backlog.offers
    response_topic = asked.properties[Property.RESPONSE_TOPIC]
    assert isinstance(response_topic, str)
    assert response_topic.startswith("fleet/r2/_answers/")
    assert asked.properties[Property.CORRELATION_DATA] == b"7"
    fleet = rig.connect()
    # The user of the link may not publish there; the requester may.
    correlation = {Property.CORRELATION_DATA: b"7"}
    assert fleet.send(response_topic, b"yes", properties=correlation) == 0
    (answer,) = peer.messages()
    assert (answer.topic, answer.payload) == ("answers/me", b"yes")
    assert (answer.properties or {})[Property.CORRELATION_DATA] == b"7"
    assert fleet.send("fleet/r2/_answers/guessed", b"no") == 0
    assert not peer.messages() and rig.counters.unexpected_answers == 1


def test_a_requester_cannot_have_answered_where_it_may_not_publish(rig: Rig) -> None:
    """The answer would be a message of the appliance: a command to ROS, or to another's topic."""
    rig.reload(ACL.replace("readwrite #", "readwrite r2/#"))
    rig.begin()
    rig.broker.guards["r2/cmd_vel"] = []
    peer = rig.join()
    for topic in ("others/x", "r2/cmd_vel", "$SYS/x"):
        properties = {Property.RESPONSE_TOPIC: topic, Property.CONTENT_TYPE: "a"}
        assert peer.publish("r2/events/ask", b"?", 1, properties=properties) == 0
    assert len(rig.backlog.offers) == 3
    for asked in rig.backlog.offers:
        assert Property.RESPONSE_TOPIC not in asked.properties
        assert asked.properties[Property.CONTENT_TYPE] == "a"
        assert user_properties(asked.properties) == [("appliance-via", "r2")]
    assert rig.out.counters.unanswerable == 3 and not len(rig.answers)


def test_an_answer_is_not_given_where_a_route_to_ros_has_come_since(rig: Rig) -> None:
    rig.begin()
    peer = rig.join()
    peer.subscribe("r2/cmd_vel")
    peer.publish("r2/events/ask", properties={Property.RESPONSE_TOPIC: "r2/cmd_vel"})
    (asked,) = rig.backlog.offers
    rig.broker.guards["r2/cmd_vel"] = []
    response_topic = asked.properties[Property.RESPONSE_TOPIC]
    assert isinstance(response_topic, str)
    assert rig.connect().send(response_topic, b"go") == 0
    assert not peer.messages()


def test_an_answer_to_a_request_from_there_goes_first(rig: Rig) -> None:
    rig.begin()
    peer = rig.join()
    peer.subscribe("r2/calls/#")
    fleet = rig.connect()
    said = {Property.RESPONSE_TOPIC: "answers/alice", Property.CORRELATION_DATA: b"9"}
    assert fleet.send("fleet/r2/calls/reset", b"?", properties=said) == 0
    (request,) = peer.messages()
    here = (request.properties or {})[Property.RESPONSE_TOPIC]
    assert isinstance(here, str) and here.startswith("r2/_upstream/fleet/")
    assert (request.properties or {})[Property.CORRELATION_DATA] == b"9"
    correlation = {Property.CORRELATION_DATA: b"9"}
    assert peer.publish(here, b"done", 1, properties=correlation) == 0
    (answer,) = rig.backlog.offers
    assert (answer.topic, answer.payload) == ("answers/alice", b"done")
    assert answer.properties[Property.CORRELATION_DATA] == b"9"
    assert answer.rule.lane == 0 and answer.rule.kept(0, False) == "all"
    assert peer.publish("r2/_upstream/fleet/guessed", b"no", 1) == 0
    assert len(rig.backlog.offers) == 1


def test_with_3_1_1_a_call_that_goes_out_gets_a_token_in_its_topic(tmp_path: Path) -> None:
    keys = 'user: upstream, version: "3.1.1", out: [{topic: "arm/#"}], in: []'
    rig = Rig(tmp_path, keys=keys)
    assert rig.out.version == V311
    rig.begin()
    peer = rig.join()
    peer.subscribe("answers/me")
    properties = {Property.RESPONSE_TOPIC: "answers/me"}
    peer.publish("r2/arm/reset/_call", b"?", properties=properties)
    (asked,) = rig.backlog.offers
    called, _, token = asked.topic.rpartition("/")
    assert called == "fleet/r2/arm/reset/_call"
    fleet = rig.connect(V311)
    assert fleet.send(f"fleet/r2/arm/reset/_reply/{token}", b"yes") == 0
    assert peer.payloads() == [b"yes"]


def test_it_may_end_and_begin_again(rig: Rig) -> None:
    rig.begin()
    rig.out.detach()
    rig.out.detach()
    rig.out.take_turn()
    rig.out.rules_changed()
    assert not rig.broker.sessions and not rig.broker.subscription_count
    rig.join("stored", **lasting(5)).publish("r2/events/x", b"x", 1)
    assert not rig.backlog.offers
    rig.out.attach()
    rig.join().publish("r2/events/x", b"y", 1)
    assert rig.backlog.taken() == [("fleet/r2/events/x", b"y")]
