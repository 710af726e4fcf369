"""What happens when a limit is reached: full queues, memory, turns, and rate-limited log lines."""

from __future__ import annotations

import logging
import random
from collections import deque
from collections.abc import Iterator
from itertools import product

import pytest

from appliance.broker.broker import ENDINGS_PER_TICK, Broker
from appliance.broker.counters import COST_PER_TURN
from appliance.broker.delivery import Delivery
from appliance.broker.limits import Features, Limits
from appliance.broker.message import Message
from appliance.broker.rate_limited_log import (
    BURST,
    INTERVAL,
    LINES_PER_TICK,
    LONGEST,
    RateLimitedLog,
)
from appliance.broker.session import REPLAYED_PER_TURN, subscription_size
from appliance.broker.values import Action
from appliance.mqtt.codec import Properties, Property
from appliance.mqtt.framing import UNAUTHENTICATED_PAIRS
from appliance.mqtt.packets import (
    MAXIMUM_FILTERS,
    Connack,
    Connect,
    Pingreq,
    Pingresp,
    Puback,
    Publish,
    Suback,
    Subscribe,
    Subscription,
    Unsuback,
    Unsubscribe,
    Will,
)
from appliance.mqtt.reason import ReasonCode

from .conftest import (
    ALONE,
    FakeAccess,
    Join,
    Peer,
    check_accounts,
    drops,
    lasting,
    waiting_bytes,
)

SMALL = {"queue_messages": 3, "inflight": 1}


def fill(publisher: Peer, count: int, qos: int = 1) -> list[int]:
    return [publisher.publish("a", b"%d" % number, qos) for number in range(count)]


# --- full queues of QoS 1 and 2


@pytest.mark.parametrize("limits", [Limits(**SMALL)])
@pytest.mark.parametrize("qos", [1, 2])
def test_refuse_tells_the_publisher_and_keeps_what_was_taken(join: Join, qos):
    subscriber = join("subscriber")
    subscriber.subscribe("a", qos)
    assert fill(join("publisher"), 6, qos) == [0, 0, 0, 0, 0x97, 0x97]
    assert [m.payload for m in subscriber.drain()] == [b"0", b"1", b"2", b"3"]


@pytest.mark.parametrize("limits", [Limits(**SMALL)])
def test_one_full_queue_does_not_keep_a_message_from_the_others(join: Join):
    """Nor is the publisher told, who would send it to them again: who is full misses it."""
    full, free = join("full"), join("free")
    for subscriber in (full, free):
        subscriber.subscribe("a", 2)
    publisher = join("publisher")
    for number in range(4):
        publisher.publish("a", b"%d" % number, 1)
        free.drain()
    assert publisher.publish("a", b"alarm", 1) == 0
    assert publisher.publish("a", b"once", 2) == 0
    assert [m.payload for m in free.drain()] == [b"alarm", b"once"]
    assert [m.payload for m in full.drain()] == [b"0", b"1", b"2", b"3"]


@pytest.mark.parametrize("limits", [Limits(**SMALL)])
@pytest.mark.parametrize("topic_filter", ["a", "$share/g/a"])
def test_what_pubrec_took_is_kept_though_the_queue_filled_meanwhile(
    join: Join, broker: Broker, topic_filter
):
    subscriber = join("subscriber")
    subscriber.subscribe(topic_filter, 2)
    promised = join("promised")
    promised.send(Publish("a", b"promised", 2, packet_id=1))
    assert promised.received()[0].reason_code == 0  # type: ignore[union-attr]
    assert fill(join("publisher"), 5)[-1] == 0x97
    dropped = dict(broker.counters.dropped)
    promised.send(bytes.fromhex("62 02 0001"))
    assert [m.payload for m in subscriber.drain()].count(b"promised") == 1
    assert broker.counters.dropped == dropped


def test_a_line_has_the_name_of_who_logs(caplog: pytest.LogCaptureFixture):
    limited = RateLimitedLog()
    for number in range(BURST + 1):
        limited.warning(logging.getLogger(__name__), 0.0, "key", "number %d", number)
    limited.tick(INTERVAL)
    assert {record.name for record in caplog.records} == {__name__}
    assert caplog.messages[-1] == f"1 more of this kind, the last: number {BURST}"


def test_of_suppressed_lines_little_is_kept_and_few_are_logged_at_once(caplog):
    limited = RateLimitedLog()
    log = logging.getLogger(__name__)
    for key in range(3 * LINES_PER_TICK):
        for _ in range(2):
            limited.warning(log, 0.0, key, "%s", "x" * 10_000, burst=1)
    assert all(len(entry.last) == LONGEST for entry in limited._entries.values())
    caplog.clear()
    for ticks in range(1, 4):
        limited.tick(INTERVAL)
        assert len(caplog.messages) == ticks * LINES_PER_TICK
    assert not limited._entries
    assert max(map(len, caplog.messages)) < LONGEST + 100


@pytest.mark.parametrize("limits", [Limits(queue_full="drop-oldest", **SMALL)])
@pytest.mark.parametrize("qos", [1, 2])
def test_drop_oldest_keeps_the_newest(join: Join, broker: Broker, store, qos):
    subscriber = join("subscriber", **lasting(5))
    subscriber.subscribe("a", qos)
    assert fill(join("publisher"), 8, qos) == [0] * 8
    assert sum(store.owed.values()) == 4
    assert [m.payload for m in subscriber.drain()] == [b"0", b"5", b"6", b"7"]
    assert broker.counters.publish_dropped == 4


class Watched(deque[Delivery]):
    """A queue that counts how often somebody has gone through it."""

    walks = 0

    def __iter__(self) -> Iterator[Delivery]:
        self.walks += 1
        return super().__iter__()


@pytest.mark.patches
@pytest.mark.parametrize("limits", [Limits(queue_full="drop-oldest", **SMALL)])
def test_a_message_that_takes_the_place_of_the_oldest_looks_at_no_other(join: Join):
    subscriber = join("subscriber", **lasting(5))
    subscriber.subscribe("a", 1)
    publisher = join("publisher")
    fill(publisher, 4)
    queue = subscriber.session.queue = Watched(subscriber.session.queue)
    fill(publisher, 50)
    assert len(queue) == SMALL["queue_messages"] and not queue.walks


@pytest.mark.parametrize(
    "limits", [Limits(queue_full="drop-oldest", queue_messages=8, queue_bytes=20_000, inflight=2)]
)
@pytest.mark.parametrize("seed", range(6))
def test_the_bytes_of_a_queue_are_those_of_its_messages(join: Join, broker: Broker, seed: int):
    """Whatever changes the queue: `check_accounts` adds them up anew after each step."""
    rng = random.Random(seed)
    publisher = join("publisher")
    peers: dict[str, Peer] = {}
    lengths = set()
    for _ in range(400):
        name = rng.choice("abc")
        peer = peers.get(name)
        if peer is None:
            peer = peers[name] = join(name, **lasting(5))
            for topic_filter in ("plain", "$share/g/shared"):
                broker.subscribe(peer.session, Subscription(topic_filter, rng.randint(1, 2)))
        session = peer.session
        match rng.randrange(12):
            case 0:
                peer.lose()
                del peers[name]
            case 1:
                broker.unsubscribe(session, "$share/g/shared")
                broker.subscribe(session, Subscription("$share/g/shared", 1))
            case 2:
                for packet_id, delivery in list(session.inflight.items()):
                    if delivery is None:
                        session.pubcomp(packet_id)
                    elif delivery[1] == 2:
                        session.pubrec(packet_id, 0)
                    else:
                        session.puback(packet_id)
            case 3:
                session.drop_queued(lambda message: bool(message.payload[:1] > b"t"))
            case 4:
                broker.tick(broker.now + 3)  # some expire
            case 5:
                peer.disconnect(0, {Property.SESSION_EXPIRY_INTERVAL: 0})
                del peers[name]
            case 6:
                waiting = [Delivery(Message("restored", bytes(50), 1), 1, False, None, None)]
                session.restore({}, waiting, {})
                broker.store.queued(session, waiting[0])
            case _:
                properties = {Property.MESSAGE_EXPIRY_INTERVAL: 5} if rng.random() < 0.3 else None
                payload = bytes([rng.randrange(256)]) * rng.choice((1, 500, 9000, 30_000))
                topic = rng.choice(("plain", "shared"))
                publisher.publish(topic, payload, rng.randint(1, 2), properties=properties)
        check_accounts(broker)
        lengths.add(len(session.queue))
    assert len(lengths) > 4


@pytest.mark.parametrize("limits", [Limits(queue_full="disconnect", **SMALL)])
@pytest.mark.parametrize("qos", [1, 2])
def test_disconnect_ends_the_connection_and_keeps_the_session(join: Join, qos):
    subscriber = join("subscriber", **lasting(5))
    subscriber.subscribe("a", qos)
    publisher = join("publisher")
    fill(publisher, 4, qos)
    assert not subscriber.transport.closed
    fill(publisher, 1, qos)
    assert subscriber.farewell() == ReasonCode.QUOTA_EXCEEDED
    back = join("subscriber", **lasting(5))
    assert [m.payload for m in back.drain()] == [b"0", b"1", b"2", b"3"]


@pytest.mark.parametrize("limits", [Limits(queue_full="disconnect", **SMALL)])
def test_a_chain_of_wills_behind_full_queues_comes_to_an_end(join: Join):
    """Each one's will is what overflows the next one's queue."""
    peers = [join(f"p{n}", will=Will(f"t/{n + 1}", b"will", 1), keep_alive=0) for n in range(200)]
    for number, peer in enumerate(peers):
        peer.subscribe(f"t/{number}", 1)
    publisher = join("publisher")
    for number in range(200):
        for _ in range(4):
            publisher.publish(f"t/{number}", b"x", 1)
    publisher.publish("t/0", b"x", 1)
    assert all(peer.transport.closed for peer in peers)


# --- QoS 0 for slow clients


@pytest.mark.parametrize("limits", [Limits(keep=3)])
def test_a_queue_of_n_keeps_the_newest_n_in_order(join: Join, broker: Broker):
    subscriber = join("subscriber")
    subscriber.subscribe("a")
    subscriber.slow()
    fill(join("publisher"), 8, 0)
    subscriber.fast()
    assert subscriber.payloads() == [b"5", b"6", b"7"]
    assert drops(broker) == {"queue_full": 5} and waiting_bytes(broker) == 0


# --- memory


@pytest.mark.parametrize("limits", [Limits(queue_bytes=100_000, subscriptions=10_000)])
def test_subscriptions_take_memory(join: Join):
    peer = join()
    deep = "/".join("x" * 1 for _ in range(100))
    codes = [peer.subscribe(f"{number}/{deep}") for number in range(5)]
    assert subscription_size(f"0/{deep}") > 30_000
    assert codes == [0, 0, 0x97, 0x97, 0x97]
    peer.unsubscribe(f"0/{deep}")
    assert peer.subscribe(f"9/{deep}") == 0


@pytest.mark.parametrize("limits", [Limits(memory=100_000, user=ALONE)])
def test_wills_take_memory(broker: Broker):
    codes = []
    for number in range(4):
        peer = Peer(broker)
        answer = peer.connect(f"c{number}", will=Will("w", bytes(40_000)))
        codes.append(answer.reason_code)
    assert codes == [0, 0, 0x97, 0x97]


@pytest.mark.parametrize("limits", [Limits(retained_bytes=200_000, user=ALONE)])
def test_levels_of_retained_topics_take_memory(join: Join):
    peer = join()
    deep = "/".join("x" for _ in range(150))
    codes = [peer.publish(f"{n}/{deep}", b"x", 1, retain=True) for n in range(6)]
    assert codes[:3] == [0x10] * 3 and codes[-1] == 0x97


@pytest.mark.parametrize("size", [10, 5000])
def test_a_message_that_waits_is_held_once(join: Join, size):
    subscriber = join("subscriber", version=4)
    subscriber.subscribe("a")
    subscriber.slow()
    join("publisher", version=4).publish("a", bytes(size))
    ((message, *_),) = subscriber.session.latest.values()
    assert (size < 1024) == bool(message.wire_head)
    assert message.encode_head(5, 0x30) == Publish("a", bytes(size)).encode(5)
    message.settle()
    subscriber.fast()
    assert subscriber.payloads() == [bytes(size)]


@pytest.mark.parametrize("limits", [Limits(topic_length=10)])
def test_long_topics(join: Join, broker: Broker):
    peer = join("peer")
    assert peer.publish("a" * 10, b"", 1) == ReasonCode.NO_MATCHING_SUBSCRIBERS
    assert peer.subscribe("ä" * 5) == 0
    peer.send(Publish("a" * 11, b"", 1, packet_id=7))
    assert peer.farewell() == ReasonCode.MALFORMED_PACKET
    subscriber = join("subscriber")
    subscriber.send(Subscribe(1, [Subscription("ä" * 6)]))
    assert subscriber.farewell() == ReasonCode.MALFORMED_PACKET
    testator = Peer(broker)
    testator.send(Connect("testator", will=Will("a" * 11, b"")))
    assert testator.received()[0].reason_code == ReasonCode.TOPIC_NAME_INVALID  # type: ignore[union-attr]


# --- turns


def take_turns(broker: Broker, peer: Peer, most: int = 1000) -> list[int]:
    """Give the peer its turns until it wants no more; returns the cost of each."""
    costs: list[int] = []
    while peer.transport.laters and len(costs) < most:
        peer.transport.laters -= 1
        begun = broker.counters.cost
        peer.client.send_on()
        broker.flush()
        costs.append(broker.counters.cost - begun)
    return costs


def test_many_retained_messages_come_in_turns(join: Join, broker: Broker):
    publisher = join("publisher")
    count = 3 * REPLAYED_PER_TURN + 5
    for number in range(count):
        publisher.publish(f"r/{number}", b"%d" % number, retain=True)
    subscriber = join("subscriber")
    subscriber.subscribe("r/#")
    heard = subscriber.payloads()
    assert 0.9 * REPLAYED_PER_TURN < len(heard) <= REPLAYED_PER_TURN
    take_turns(broker, subscriber)
    assert len(heard + subscriber.payloads()) == count


def test_what_may_not_be_seen_takes_turns_too(join: Join, broker: Broker, access: FakeAccess):
    access.deny("user", Action.RECEIVE, "r/+")
    publisher = join("publisher")
    for number in range(REPLAYED_PER_TURN + 5):
        publisher.publish(f"r/{number}", b"", 0)
        message = Message(f"r/{number}", b"x", retain=True)
        broker.retained.keep(message, broker.accounting.accounts.inside)
    subscriber = join("subscriber")
    subscriber.subscribe("r/#")
    assert subscriber.payloads() == [] and subscriber.transport.laters == 1
    for number in range(REPLAYED_PER_TURN + 5):
        broker.retained.delete(f"r/{number}")


def test_what_one_client_sends_takes_turns(join: Join, broker: Broker):
    """A chunk of thousands of packets is not worked on in one go."""
    subscriber, peer = join("subscriber"), join("peer")
    subscriber.subscribe("a")
    count = 3 * COST_PER_TURN
    peer.send(Publish("a", b"x").encode(5) * count)
    heard = len(subscriber.payloads())
    assert 0 < heard < count and peer.client.protocol.paused
    peer.send(Publish("a", b"last").encode(5))  # what comes meanwhile waits its turn
    take_turns(broker, peer)
    payloads = subscriber.payloads()
    assert heard + len(payloads) == count + 1 and payloads[-1] == b"last"


def test_a_search_that_passes_many_filters_ends_the_turn_though_none_matches(
    join: Join, broker: Broker
):
    stranger, peer = join("stranger"), join("peer")
    for levels in product("a+", repeat=11):
        name = "/".join([*levels, "end"])
        broker.router.join(stranger.session, Subscription(name, 0))
    begun = broker.counters.cost
    topics = ["/".join(["a"] * 11 + [f"new{number}"]) for number in range(3)]
    peer.send(*(Publish(topic, b"x") for topic in topics))
    assert peer.client.protocol.paused and peer.transport.laters  # the others have their turn
    assert broker.counters.publish_received == 1
    assert broker.counters.cost - begun > COST_PER_TURN
    assert len(take_turns(broker, peer)) >= 2
    assert broker.counters.publish_received == 3
    assert not peer.client.protocol.paused


@pytest.mark.parametrize("limits", [Limits(subscriptions=MAXIMUM_FILTERS)])
def test_a_packet_of_thousands_of_filters_takes_turns(
    join: Join, broker: Broker, access: FakeAccess
):
    """Its answers come in their order nevertheless, and what is retained behind them."""
    access.deny("user", Action.SUBSCRIBE, "f/7")
    publisher, peer = join("publisher"), join("peer")
    publisher.publish("f/1", b"kept", retain=True)
    filters = [f"f/{number}" for number in range(MAXIMUM_FILTERS)]
    wanted = [Subscription(name, 1) for name in filters]
    packets = Subscribe(1, wanted), Pingreq(), Subscribe(2, [Subscription("f/7", 0)])
    begun = broker.counters.cost
    peer.send(*packets)
    costs = [broker.counters.cost - begun, *take_turns(broker, peer, 30)]
    assert peer.received() == [] and 0 < len(peer.session.subscriptions) < MAXIMUM_FILTERS - 1
    publisher.publish("f/0", b"meanwhile")
    assert peer.payloads() == [b"meanwhile"]
    costs += take_turns(broker, peer)
    assert len(costs) > 80 and max(costs) < 1.5 * COST_PER_TURN
    answer, *rest = peer.received()
    assert isinstance(answer, Suback) and answer.packet_id == 1
    assert answer.reason_codes == [0x87 if name == "f/7" else 1 for name in filters]
    assert sorted(type(packet).__name__ for packet in rest) == ["Pingresp", "Publish", "Suback"]

    peer.send(Unsubscribe(3, filters), Pingreq())
    assert peer.received() == []
    assert len(take_turns(broker, peer)) > 20
    answer, pong = peer.received()
    assert isinstance(answer, Unsuback) and isinstance(pong, Pingresp)
    assert answer.reason_codes == [0x11 if name == "f/7" else 0 for name in filters]
    assert not peer.session.subscriptions


def test_a_wrong_filter_behind_thousands_leaves_them_without_effect(join: Join, broker: Broker):
    peer = join("peer", **lasting(5))
    filters = [f"f/{number}" for number in range(1000)]
    session = peer.session
    peer.send(Subscribe(1, [Subscription(name, 1) for name in (*filters, "a/#/b")]))
    take_turns(broker, peer)
    assert peer.farewell() == ReasonCode.MALFORMED_PACKET
    assert not session.subscriptions


@pytest.mark.parametrize("end", ["lost", "taken over"])
def test_who_goes_in_the_middle_of_a_long_packet_is_answered_nothing(
    join: Join, broker: Broker, end: str
):
    peer = join("peer", **lasting(5))
    peer.send(Subscribe(1, [Subscription(f"f/{number}", 1) for number in range(1000)]))
    take_turns(broker, peer, 6)
    assert 0 < len(peer.session.subscriptions) < 1000
    if end == "lost":
        peer.lose()
        assert peer.received() == []
    else:
        join("peer", **lasting(5))
        assert peer.farewell() == ReasonCode.SESSION_TAKEN_OVER
    assert take_turns(broker, peer) == [0]


@pytest.mark.parametrize("limits", [Limits(memory=200_000, user=ALONE)])
def test_what_has_come_in_is_counted(join: Join, broker: Broker):
    """Unfinished packets and topic aliases; who has too much of them is told, and goes"""
    peers = [join(f"p{n}") for n in range(3)]
    for peer in peers:
        peer.send(Publish("a", bytes(100_000)).encode(5)[:80_000])
    assert [peer.transport.closed for peer in peers] == [False, False, True]
    assert peers[2].farewell() == ReasonCode.QUOTA_EXCEEDED
    peers[0].send(bytes(20_100))
    peers[1].lose()
    assert broker.accounting.input_bytes < 200
    alias = {Property.TOPIC_ALIAS: 1}
    peers[0].transport.closed or peers[0].lose()
    aliased = join("aliased")
    aliased.publish("x" * 10_000, properties=alias)
    assert 10_000 < broker.accounting.input_bytes < 10_300
    aliased.publish("é" * 3_000 + "\U0001f916", properties=alias)
    assert 12_000 < broker.accounting.input_bytes < 12_300, "four bytes a character"
    aliased.publish("y", properties=alias)
    assert broker.accounting.input_bytes < 300


def user_properties(count: int) -> Properties:
    return {Property.USER_PROPERTY: [("", "")] * count}


@pytest.mark.parametrize("limits", [Limits(user_properties=100)])
def test_user_properties_are_refused_while_they_are_counted(join: Join, broker: Broker):
    """What is behind those that are too many is not looked at"""
    subscriber = join("subscriber")
    subscriber.subscribe("a", 1)
    for number, packet in enumerate(
        [
            Publish("a", b"", 1, packet_id=1, properties=user_properties(101)),
            Subscribe(1, [Subscription("a")], user_properties(101)),
            Unsubscribe(1, ["a"], user_properties(101)),
            Puback(1, 0, user_properties(101)),
        ]
    ):
        peer = join(f"peer-{number}")
        # The last one of them is no text.
        peer.send(packet.encode(5).replace(b"\x26\0\0\0\0" * 101, HUNDRED + b"\x26\0\1\xff\0\0"))
        assert peer.farewell() == ReasonCode.QUOTA_EXCEEDED, packet
    peer = join("peer")
    assert peer.publish("a", b"", 1, properties=user_properties(100)) == 0
    (message,) = subscriber.messages()
    assert message.properties == user_properties(100)


HUNDRED = b"\x26\0\0\0\0" * 100


def test_a_stranger_has_fewer_user_properties(broker: Broker):
    """Those of CONNECT and of its will together"""
    for more in (0, 1):
        peer = Peer(broker)
        will = Will("w", b"", properties=user_properties(UNAUTHENTICATED_PAIRS // 2))
        peer.say_connect(will=will, properties=user_properties(UNAUTHENTICATED_PAIRS // 2 + more))
        if more:
            assert peer.only(Connack).reason_code == ReasonCode.QUOTA_EXCEEDED  # type: ignore
            assert peer.transport.closed
        else:
            assert peer.transport.asked is not None


@pytest.mark.parametrize("limits", [Limits(user_properties=200)])
def test_the_cost_of_a_packet_is_that_of_its_parts(join: Join, broker: Broker):
    peer = join("peer")
    for packet in [
        Publish("a", b"", properties=user_properties(200)),
        Subscribe(1, [Subscription("a")], user_properties(200)),
    ]:
        before = broker.counters.cost
        peer.send(packet)
        assert 100 <= broker.counters.cost - before < 200, packet
    before = broker.counters.cost
    peer.send(Publish("a", b"", properties=user_properties(201)))
    assert broker.counters.cost - before >= 100, "what was done in vain"


def test_packets_of_countless_parts_are_refused(join: Join):
    second = join("second")
    second.send(Subscribe(1, [Subscription("a")] * (MAXIMUM_FILTERS + 1)))
    assert second.farewell() == ReasonCode.QUOTA_EXCEEDED
    third = join("third")
    deep = "/".join("x" for _ in range(200))
    third.send(Subscribe(1, [Subscription(f"{n}/{deep}") for n in range(150)]))
    assert third.farewell() == ReasonCode.QUOTA_EXCEEDED


def test_retained_messages_expire_by_themselves(join: Join, broker: Broker):
    publisher = join("publisher")
    for number in range(5):
        for seconds in (1, 10):
            publisher.publish(
                f"r/{number}",
                b"x",
                retain=True,
                properties={Property.MESSAGE_EXPIRY_INTERVAL: seconds},
            )
    publisher.publish("r/0", b"for ever", retain=True)
    broker.tick(broker.now + 2)
    assert len(broker.retained) == 5
    broker.tick(broker.now + 9)
    assert len(broker.retained) == 1
    publisher.publish("r/0", b"", retain=True)


@pytest.mark.parametrize(
    "limits", [Limits(memory=100_000, connections=5, queue_messages=100, user=ALONE)]
)
def test_who_holds_little_is_not_starved_by_who_holds_much(join: Join):
    greedy, modest = join("greedy"), join("modest")
    greedy.subscribe("g", 1)
    modest.subscribe("m", 1)
    publisher = join("publisher")
    while publisher.publish("g", bytes(5000), 1) == 0:
        pass
    assert publisher.publish("m", b"alarm", 1) == 0
    assert [message.payload for message in modest.drain()] == [b"alarm"]
    greedy.lose()


def test_thousands_that_fall_silent_end_in_turns(join: Join, broker: Broker):
    peers = [join(f"p{n}", keep_alive=10) for n in range(2 * ENDINGS_PER_TICK + 1)]
    for turn in (1, 2):
        assert broker.tick(1020.0) == 1020.0
        assert sum(peer.transport.closed for peer in peers) == turn * ENDINGS_PER_TICK
    assert broker.tick(1020.0) > 1020.0
    assert all(peer.transport.closed for peer in peers)


def test_thousands_of_sessions_expire_in_turns(join: Join, broker: Broker):
    for number in range(2 * ENDINGS_PER_TICK + 1):
        join(f"p{number}", **lasting(5, 60)).lose()
    turns = 1
    while broker.tick(1061.0) <= 1061.0:
        turns += 1
    assert turns == 3 and not broker.sessions


# --- the rate-limited log


def test_a_flood_is_told_as_a_number(join: Join, broker: Broker, access: FakeAccess, caplog):
    access.deny("user", Action.PUBLISH, "secret/#")
    peer = join()
    with caplog.at_level(logging.WARNING):
        for number in range(1000):
            peer.publish(f"secret/{number}", b"", 0)
        assert len(caplog.records) == BURST
        broker.tick(broker.now + INTERVAL)
    *_, last = (record.getMessage() for record in caplog.records)
    assert f"{1000 - BURST} more" in last and "'secret/999'" in last
    assert broker.counters.publish_refused == 1000


def test_different_clients_are_told_apart(join: Join, access: FakeAccess, caplog):
    access.deny("user", Action.PUBLISH, "secret/#")
    with caplog.at_level(logging.WARNING):
        for number in range(2 * BURST):
            join(f"c{number}").publish("secret", b"", 0)
    assert len([r for r in caplog.records if "may not publish" in r.getMessage()]) == 2 * BURST


def test_a_long_client_id_does_not_fill_the_log(broker: Broker, caplog):
    peer = Peer(broker)
    with caplog.at_level(logging.WARNING):
        peer.say_connect("x" * 60_000)
        peer.client.refuse(ReasonCode.NOT_AUTHORIZED, "wrong password")
    (record,) = caplog.records
    assert len(record.getMessage()) < 300


# --- what the operator switches on


def test_reasons_are_told_in_words_to_those_who_want_them(join: Join, broker, access: FakeAccess):
    broker.features = Features(reason_strings=True)
    access.deny("user", Action.PUBLISH, "secret")
    for wanted in (1, 0):
        peer = join(f"c{wanted}", properties={Property.REQUEST_PROBLEM_INFORMATION: wanted})
        peer.send(Publish("secret", b"", 1, packet_id=1))
        (answer,) = peer.received()
        assert answer.reason_code == 0x87
        assert bool(answer.properties) == bool(wanted)
    small = join("small", properties={Property.MAXIMUM_PACKET_SIZE: 30})
    small.send(Publish("secret", b"", 1, packet_id=1))
    (answer,) = small.received()
    assert answer.reason_code == 0x87 and not answer.properties


def test_a_suback_that_does_not_fit_ends_the_connection(join: Join):
    """[MQTT-3.1.2-24]"""
    peer = join(properties={Property.MAXIMUM_PACKET_SIZE: 20})
    peer.send(Subscribe(1, [Subscription(f"t/{n}", 0) for n in range(5)]))
    assert isinstance(peer.received()[0], Suback)
    peer.send(Subscribe(2, [Subscription(f"t/{n}", 0) for n in range(30)]))
    assert peer.farewell() == ReasonCode.PACKET_TOO_LARGE


@pytest.mark.parametrize("qos", [0, 1, 2])
def test_text_that_is_none_is_refused_when_checked(join: Join, broker: Broker, qos):
    broker.features = Features(check_payload_format=True)
    subscriber = join("subscriber")
    subscriber.subscribe("a")
    peer = join("peer")
    text = {Property.PAYLOAD_FORMAT_INDICATOR: 1}
    code = peer.publish("a", b"\xff", qos, properties=text)
    assert code == (0x99 if qos else 0)
    peer.publish("a", "ä".encode(), qos, properties=text)
    peer.publish("a", b"\xfe", qos, properties={Property.PAYLOAD_FORMAT_INDICATOR: 0})
    assert [m.payload for m in subscriber.messages()] == ["ä".encode(), b"\xfe"]
    late = Peer(broker)
    late.send(Connect("late", will=Will("w", b"\xff", properties=text)))
    assert late.received()[0].reason_code == 0x99  # type: ignore[union-attr]


def test_where_answers_may_go(join: Join, broker: Broker):
    """[MQTT-3.1.2-28]"""
    broker.features = Features(response_information="r/%u/%c")
    peer = Peer(broker)
    answer = peer.connect("id", properties={Property.REQUEST_RESPONSE_INFORMATION: 1})
    assert answer.properties is not None
    assert answer.properties[Property.RESPONSE_INFORMATION] == "r/user/id"
    unasked = Peer(broker).connect("other")
    assert Property.RESPONSE_INFORMATION not in (unasked.properties or {})


@pytest.mark.parametrize("limits", [Limits(keep_alive=60)])
@pytest.mark.parametrize("asked", [0, 61])
def test_a_keep_alive_over_the_limit(broker: Broker, version, asked):
    """5.0 is told another one; 3.1.1, which cannot be told, is refused, as by mosquitto."""
    peer = Peer(broker, version)
    answer = peer.connect("id", keep_alive=asked) if version == 5 else None
    if answer is not None:
        assert answer.properties is not None
        assert answer.properties[Property.SERVER_KEEP_ALIVE] == 60
        return
    peer.say_connect("id", keep_alive=asked)
    peer.let_in()
    assert bytes(peer.transport.written) == b"\x20\x02\x00\x02"


@pytest.mark.parametrize("policy", ["refuse", "drop-oldest", "disconnect"])
def test_an_absent_clients_full_queue_is_told_once(
    join: Join, broker: Broker, caplog: pytest.LogCaptureFixture, policy: str
):
    broker.use(Limits(queue_full=policy, **SMALL), broker.features)
    subscriber = join("subscriber", **lasting(5, 100_000))
    subscriber.subscribe("a", 1)
    subscriber.client.lost()
    broker.tick(broker.now + 3723)
    publisher = join("publisher")
    fill(publisher, 3)
    broker.tick(broker.now + 1)
    assert "queue is full" not in caplog.text
    fill(publisher, 8)
    broker.tick(broker.now + 1)
    (line,) = [each for each in caplog.messages if "queue is full" in each]
    assert "client 'subscriber'" in line and "away for 1:02:0" in line
    assert ("oldest are dropped" in line) is (policy == "drop-oldest")
    fill(publisher, 8)
    broker.tick(broker.now + 1)
    assert caplog.text.count("queue is full") == 1
    # At the next absence it is news again.
    join("subscriber", **lasting(5, 100_000)).client.lost()
    fill(publisher, 8)
    broker.tick(broker.now + 1)
    assert caplog.text.count("queue is full") == 2
