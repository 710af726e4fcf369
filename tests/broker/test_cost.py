"""Work is counted as cost, so that an expensive client yields its turn to the others."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import ClassVar

import pytest

from appliance.broker import output
from appliance.broker.broker import (
    CHECKS_PER_COST_UNIT,
    COST_PER_TICK,
    HELD_COST,
    LEVELS_PER_COST_UNIT,
    Broker,
)
from appliance.broker.counters import COST_PER_TURN
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.broker.session import REPLAYED_PER_TURN, Replay
from appliance.broker.shared import MAXIMUM_CHECKED
from appliance.broker.subscribing import ASKED_AT_ONCE, LONG_FILTER
from appliance.broker.values import AccessQuery, Action, Decision, Identity
from appliance.mqtt import framing
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Publish, Pubrel, Suback, Subscribe, Subscription, Will
from appliance.mqtt.reason import ReasonCode
from appliance.mqtt.topics import STEP

from .conftest import FakeAccess, Join, Peer, lasting


def cost_of(broker: Broker, peer: Peer, *packets: Publish | Pubrel) -> int:
    """What these packets add, their topic being known already."""
    begun = broker.counters.cost
    peer.send(*packets)
    return broker.counters.cost - begun


def test_messages_of_qos_2_that_are_never_released_take_turns(join: Join, broker: Broker):
    """3.1.1, which knows no limit of these"""
    peer = join("peer", version=4)
    count = 2 * COST_PER_TURN
    peer.send(*(Publish("a", b"", 2, packet_id=number + 1) for number in range(count)))
    held = len(peer.session.received)
    assert 0 < held <= COST_PER_TURN and peer.client.protocol.paused
    while peer.transport.laters:
        peer.go_on()
    assert len(peer.session.received) == count


@pytest.mark.parametrize("shared", [False, True], ids=["plain", "shared"])
def test_to_ask_many_readers_for_room_costs_with_qos_2(join: Join, broker: Broker, shared: bool):
    readers = 40 * CHECKS_PER_COST_UNIT
    for number in range(readers):
        join(f"reader{number}").subscribe("$share/g/a" if shared else "a", 2)
    peer = join("peer")
    peer.publish("a", b"first", 2)  # which finds the route
    message, release = Publish("a", b"", 2, packet_id=7), Pubrel(7)
    assert cost_of(broker, peer, message) >= HELD_COST + readers // CHECKS_PER_COST_UNIT
    assert cost_of(broker, peer, message) >= HELD_COST, "sent again"
    given = 1 if shared else readers
    assert cost_of(broker, peer, release) >= HELD_COST + readers // CHECKS_PER_COST_UNIT + given


def test_the_members_of_a_group_cost_where_they_are_visited(join: Join, broker: Broker):
    count = 300
    for number in range(count):
        member = join(f"member{number}", **lasting(5))
        member.subscribe("$share/g/t/#", 1)
        member.lose()
    peer = join("peer")
    assert cost_of(broker, peer, Publish("t/1", b"", 0)) >= count, "each may be allowed the topic"
    # Nobody is there, so as many are looked at as ever are for one message.
    assert cost_of(broker, peer, Publish("t/1", b"", 0)) >= MAXIMUM_CHECKED // CHECKS_PER_COST_UNIT


def test_what_a_member_leaves_is_offered_to_few_of_many(
    join: Join, broker: Broker, access: FakeAccess, monkeypatch: pytest.MonkeyPatch
):
    """And only those that it would go to are asked whether they may receive it, topic by topic."""
    leaving = join("leaving", **lasting(5))
    leaving.subscribe("$share/g/t/#", 1)
    publisher = join("publisher")
    count = 20
    for number in range(count):
        assert publisher.publish(f"t/{number}", b"x", 1) == 0
    for number in range(2 * MAXIMUM_CHECKED):
        member = join(f"member{number}", **lasting(5))
        member.subscribe("$share/g/t/#", 1)
        member.lose()
    asked: list[str] = []
    decide = access.decide
    monkeypatch.setattr(access, "decide", lambda *a: (asked.append(a[2]), decide(*a))[1])
    begun = broker.counters.cost
    join("leaving")  # anew: its session ends
    assert broker.counters.cost - begun >= count + 2 * MAXIMUM_CHECKED // CHECKS_PER_COST_UNIT
    assert len(asked) == count
    heard = [message for n in range(30) for message in join(f"member{n}", **lasting(5)).drain()]
    assert len(heard) == count


@pytest.mark.patches
def test_to_leave_many_groups_takes_one_look_at_what_waits(
    join: Join, broker: Broker, monkeypatch: pytest.MonkeyPatch
):
    peer = join("peer", **lasting(5))
    for number in range(50):
        peer.subscribe(f"$share/g/{number}", 1)
    passes = []
    hand_over = type(peer.session).hand_over
    monkeypatch.setattr(
        type(peer.session),
        "hand_over",
        lambda *a, **options: (passes.append(a), hand_over(*a, **options)),
    )
    peer.lose()
    assert len(passes) == 1


def costly_topic(broker: Broker, listener: Peer, topic: str) -> None:
    """Let a search for who hears the topic pass a thousand filters."""
    levels = topic.split("/")
    for wild in product((False, True), repeat=9):
        name = "/".join(
            "+" if is_wild else level for is_wild, level in zip(wild, levels, strict=True)
        )
        broker.router.join(listener.session, Subscription(f"{name}/end", 0))


@pytest.mark.parametrize("end", ["delay", "keep alive", "session"])
def test_wills_that_are_due_at_once_come_in_several_ticks(join: Join, broker: Broker, end: str):
    watcher = join("watcher", keep_alive=0)
    watcher.subscribe("#")
    topic = "/".join("abcdefghi")
    costly_topic(broker, watcher, topic)
    count = 30
    properties = {Property.WILL_DELAY_INTERVAL: 0 if end == "keep alive" else 10}
    expiry = {"delay": 60, "keep alive": 0, "session": 10}[end]
    for number in range(count):
        will = Will(f"{topic}/{number}", b"gone", properties=properties)
        peer = join(f"p{number}", will=will, keep_alive=10, **lasting(5, expiry))
        if end != "keep alive":
            peer.lose()
    watcher.received()
    now = broker.now + 16
    heard: list[int] = []
    while not heard or sum(heard) < count:
        begun = broker.counters.cost
        due = broker.tick(now)
        assert broker.counters.cost - begun < COST_PER_TICK + 500
        heard.append(len(watcher.payloads()))
        assert heard[-1] and (due <= now) == (sum(heard) < count)
    assert len(heard) > 2


def test_retained_messages_that_expire_at_once_go_in_several_ticks(join: Join, broker: Broker):
    peer = join("peer")
    count = 100
    expiry = {Property.MESSAGE_EXPIRY_INTERVAL: 10}
    for number in range(count):
        topic = f"{number}/" + "/".join("x" * 150)
        peer.publish(topic, b"x", retain=True, properties=expiry)
    left: list[int] = []
    while not left or left[-1]:
        due = broker.tick(1011.0)
        left.append(len(broker.retained))
        assert (due <= 1011.0) == bool(left[-1])
    assert 3 < len(left) < 20


def test_a_session_with_many_deep_filters_costs_at_its_end(join: Join, broker: Broker):
    peer = join("peer")
    deep = "/".join("x" * 100)
    for number in range(20):
        peer.subscribe(f"{number}/{deep}")
    begun = broker.counters.cost
    peer.lose()
    assert broker.counters.cost - begun > 20 * 100 // LEVELS_PER_COST_UNIT


def test_a_long_topic_behind_an_alias_costs_what_it_takes(join: Join, broker: Broker):
    """Eight bytes stand for 64 KB, which are looked up, and sent to each reader."""
    for number in range(19):
        join(f"reader{number}").subscribe("#", 0)
    peer = join("peer")
    costs = []
    for topic in ("a" * 100, "a" * 60_000):
        peer.send(Publish(topic, b"", 0, properties={Property.TOPIC_ALIAS: 1}))
        again = Publish("", b"", 0, properties={Property.TOPIC_ALIAS: 1})
        costs.append(cost_of(broker, peer, again))
    assert costs[1] - costs[0] >= (60_000 + 19 * 60_000 // 16) >> 8


@pytest.mark.patches
def test_an_alias_is_checked_where_it_is_given(join: Join, monkeypatch: pytest.MonkeyPatch):
    checked = []
    monkeypatch.setattr(framing, "check_topic", checked.append)
    peer = join("peer")
    peer.send(Publish("a/b", b"", 0, properties={Property.TOPIC_ALIAS: 1}))
    for _ in range(10):
        peer.send(Publish("", b"", 0, properties={Property.TOPIC_ALIAS: 1}))
    assert checked == ["a/b"]


class ManyRules(FakeAccess):
    """Takes long to decide about any filter. It is asked so often before a decision is there."""

    COST = 300
    timeout = 5.0

    def __init__(self) -> None:
        super().__init__()
        self.asked = 0

    def decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        self.asked += 1
        return Decision(False, "many rules", cost=self.COST)

    def is_pending(self, question: AccessQuery, wake: Callable[[], None]) -> bool:
        self.broker.counters.cost += self.decide(*question).cost
        return False

    broker: Broker


@pytest.mark.parametrize("is_asked_first", [False, True])
def test_the_rules_that_are_looked_at_end_the_turn_of_a_subscribe(
    join: Join, broker: Broker, is_asked_first: bool
):
    """Whether a plugin might have to be waited for or not."""
    peer = join("peer")
    access = ManyRules()
    broker.router.access = access
    access.broker = broker
    if is_asked_first:
        broker.router.pending_decisions = access
    filters = [f"+/secret/{number}" for number in range(40)]
    asked: list[int] = []
    costs: list[int] = []
    peer.transport.laters = 1
    while peer.transport.laters:
        begun, before = broker.counters.cost, access.asked
        if not asked:
            peer.transport.laters = 0
            peer.send(Subscribe(1, [Subscription(name, 0) for name in filters]))
        else:
            peer.go_on()
        asked.append(access.asked - before)
        costs.append(broker.counters.cost - begun)
        broker.counters.cost += 10 * COST_PER_TURN  # others have their turns
    assert sum(asked) == len(filters) * (2 if is_asked_first else 1)
    at_once = ASKED_AT_ONCE if is_asked_first else 1
    assert max(costs) < COST_PER_TURN + at_once * (ManyRules.COST + 50)
    assert min(asked[1:-1]) >= 3, "each turn is used"
    assert peer.only(Suback).reason_codes == [ReasonCode.NOT_AUTHORIZED] * len(filters)


@pytest.mark.parametrize("beginning", ["", "$share/g/"])
def test_long_filters_cost_what_they_take(join: Join, broker: Broker, beginning: str):
    peer = join("peer")
    costs = []
    for length in (10, 60_000):
        begun = broker.counters.cost
        peer.subscribe(beginning + "a" * length, 0)
        peer.unsubscribe(beginning + "a" * length)
        costs.append(broker.counters.cost - begun)
    assert costs[1] - costs[0] >= 4 * (60_000 // LONG_FILTER)


@pytest.mark.patches
def test_a_thousand_identifiers_are_encoded_once_for_a_route(
    join: Join, broker: Broker, monkeypatch: pytest.MonkeyPatch
):
    encoded = []
    encode = output.encode_property_list
    monkeypatch.setattr(output, "encode_property_list", lambda p: encoded.append(p) or encode(p))
    # Its limit is compared with each message, of which none is sent.
    reader = join("reader", properties={Property.MAXIMUM_PACKET_SIZE: 200})
    filters = ["/".join(each) for each in product("a+", repeat=9)]
    for number, name in enumerate(filters, 1):
        reader.subscribe(name, properties={Property.SUBSCRIPTION_IDENTIFIER: [number]})
    peer = join("peer")
    topic = "/".join("a" * 9)
    costs = [cost_of(broker, peer, Publish(topic, b"x", 0)) for _ in range(5)]
    assert len(encoded) == 1 and len(encoded[0][Property.SUBSCRIPTION_IDENTIFIER]) == len(filters)
    assert costs[0] >= len(filters) >> 3 and costs[1] < costs[0]


def test_what_is_encoded_for_one_reader_shares_the_payload(join: Join):
    """Of large messages with an expiry, an alias or an identifier."""
    payload, count = b"x" * 1_000_000, 3
    written: list[bytes] = []
    for number in range(count):
        reader = join(f"reader{number}", properties={Property.TOPIC_ALIAS_MAXIMUM: 1})
        reader.subscribe("t", 0, properties={Property.SUBSCRIPTION_IDENTIFIER: [7]})
        reader.transport.write = written.extend  # type: ignore[method-assign]
    join("peer").send(Publish("t", payload, 0, properties={Property.MESSAGE_EXPIRY_INTERVAL: 9}))
    large = [chunk for chunk in written if len(chunk) > 1000]
    assert large == [payload] * count and len({*map(id, large)}) == 1


class Watched(dict[str, Replay]):
    """Replays that count how many of them are looked at."""

    looked = 0

    def items(self):  # type: ignore[override]
        for item in super().items():
            self.looked += 1
            yield item


def test_a_search_for_retained_messages_costs_though_none_is_found(join: Join, broker: Broker):
    inside = broker.accounting.accounts.inside
    nodes = 2 * 5000  # that it visits
    for number in range(nodes // 2):
        broker.retained.keep(Message(f"w/{number}/a/x", b"x", retain=True), inside)
    peer = join("peer")
    begun = broker.counters.cost
    peer.subscribe("w/+/a/none")
    assert peer.transport.laters, "it goes on in a later turn"
    first = broker.counters.cost - begun
    assert 2 * REPLAYED_PER_TURN <= first < 2.5 * COST_PER_TURN
    while peer.transport.laters:
        peer.go_on()
    assert peer.payloads() == []
    assert broker.counters.cost - begun >= 2 * (nodes // STEP)


@pytest.mark.patches
@pytest.mark.parametrize("qos", [1, 2])
def test_an_acknowledgement_looks_only_at_the_replay_that_it_makes_room_for(
    join: Join, broker: Broker, qos: int
):
    publisher, peer = join("publisher"), join("peer")
    count = 200
    filters = [f"t/{number}" for number in range(count)]
    for name in filters:
        publisher.publish(name, b"x", 2, retain=True)
    peer.send(Subscribe(1, [Subscription(name, qos) for name in filters]))
    while peer.transport.laters:
        peer.go_on()
    session = peer.session
    heard = [packet for packet in peer.received() if isinstance(packet, Publish)]
    assert len(heard) == session.window < count // 4
    replays = session.replays = Watched(session.replays)
    topics = [packet.topic for packet in heard]
    while heard:
        replays.looked = 0
        begun = broker.counters.cost
        peer.acknowledge(heard.pop(0))
        # The one that is at its end, the one that has a message, and the one where the walk stops.
        assert replays.looked <= 3
        assert broker.counters.cost - begun <= 10
        if peer.transport.laters:  # it has been sent as many as may be in a turn
            peer.go_on()
        came = peer.messages()
        assert len(came) == (len(topics) < count)
        heard += came
        topics += [packet.topic for packet in came]
    assert not session.replays and not session.inflight
    assert topics == filters, "in their order"


def test_replays_of_qos_0_do_not_wait_for_the_window(join: Join):
    """Nor does one whose subscription has been replaced by one of QoS 0."""
    publisher = join("publisher")
    for topic in ("a/1", "a/2", "a/3", "b/1", "b/2", "c"):
        publisher.publish(topic, b"x", 1, retain=True)
    peer = join("peer", properties={Property.RECEIVE_MAXIMUM: 1})
    wanted = [Subscription("a/+", 1), Subscription("b/+", 0), Subscription("c", 1)]
    peer.send(Subscribe(1, wanted))
    sent = [packet for packet in peer.received() if isinstance(packet, Publish)]
    assert [packet.topic for packet in sent] == ["a/1", "b/1", "b/2"]
    peer.send(Subscribe(2, [Subscription("a/+", 0, retain_handling=2)]))
    again = [packet for packet in peer.received() if isinstance(packet, Publish)]
    assert [(packet.topic, packet.qos) for packet in again] == [("a/2", 0), ("a/3", 0)]
    peer.acknowledge(sent[0])
    assert [packet.topic for packet in peer.drain()] == ["c"]
    assert not peer.session.replays and not peer.session.replays_of_qos_0


def test_a_retained_message_that_waits_for_the_network_is_looked_up_once(
    join: Join, broker: Broker
):
    """However often it is tried: otherwise each try made the search for the next one deeper."""
    message = Message("map", bytes(40_000), retain=True)
    broker.retained.keep(message, broker.accounting.accounts.inside)
    peer = join("peer")
    peer.transport.behind = True
    peer.subscribe("map")
    left = peer.session.replays_left
    for _ in range(1000):
        peer.session.pump()
    assert peer.session.replays_left == left > 0
    assert peer.payloads() == []
    peer.transport.behind = False
    peer.client.output.caught_up()
    broker.flush()
    assert peer.payloads() == [message.payload]
    assert not peer.session.replays


def test_a_session_inside_that_acknowledges_at_once_gets_all_that_is_retained(
    join: Join, broker: Broker
):
    peer = join("peer")
    for number in range(50):
        peer.publish(f"kept/{number}", b"x", 1, retain=True)

    class Prompt(InsideLink):
        received: ClassVar[list[str]] = []

        def publish(self, message, qos, packet_id, *_):  # type: ignore[no-untyped-def]
            self.received.append(message.topic)
            inside.puback(packet_id)

    link = Prompt()
    inside = broker.attach("inside", link)
    for name in ("kept/#", "kept/+"):
        broker.subscribe(inside, Subscription(name, 1))
        broker.send_retained(inside, Subscription(name, 1), True)
    while inside.replays:
        inside.take_turn()
    assert sorted(link.received) == sorted(2 * [f"kept/{number}" for number in range(50)])
    for name in ("kept/#", "kept/+"):
        broker.unsubscribe(inside, name)
