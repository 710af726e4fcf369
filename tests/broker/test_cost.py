"""Work is counted as cost, so that an expensive client yields its turn to the others."""

from __future__ import annotations

from itertools import product

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
from appliance.broker.shared import MAXIMUM_CHECKED
from appliance.broker.subscribing import LONG_FILTER
from appliance.mqtt import framing
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Publish, Pubrel, Subscription, Will

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
    assert broker.counters.cost - begun >= count * MAXIMUM_CHECKED // CHECKS_PER_COST_UNIT
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


def test_an_alias_is_checked_where_it_is_given(join: Join, monkeypatch: pytest.MonkeyPatch):
    checked = []
    monkeypatch.setattr(framing, "check_topic", checked.append)
    peer = join("peer")
    peer.send(Publish("a/b", b"", 0, properties={Property.TOPIC_ALIAS: 1}))
    for _ in range(10):
        peer.send(Publish("", b"", 0, properties={Property.TOPIC_ALIAS: 1}))
    assert checked == ["a/b"]


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
