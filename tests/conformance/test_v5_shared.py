"""MQTT 5.0, section 4.8.2: shared subscriptions."""

from __future__ import annotations

from collections import Counter

import pytest
from broker.conftest import lasting
from client_v5 import (
    ACCEPTED,
    Client,
    connect,
    disconnect,
    field,
    joined,
    packet,
    properties,
    publish,
    wire,
)

from appliance.broker.broker import Broker
from appliance.broker.limits import Limits
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Publish

P = Property
statement = pytest.mark.statement

QOS = pytest.mark.parametrize("qos", [0, 1, 2])


def members(
    broker: Broker, count: int, topic_filter: str = "$share/g/a", qos: int = 2, **options: object
) -> list[Client]:
    """Clients m0, m1, … that share a subscription."""
    clients = []
    for n in range(count):
        client = joined(broker, f"m{n}", **options)
        assert client.subscribe(topic_filter, qos) == qos
        clients.append(client)
    return clients


def chosen(clients: list[Client]) -> tuple[Client, list[Client]]:
    """Who of them was sent something, that is not heard yet; and the others."""
    (one,) = [client for client in clients if client.transport.written]
    return one, [client for client in clients if client is not one]


# --- the filter


@statement("5.0", "MQTT-4.8.2-1", "MQTT-4.8.2-2")
@pytest.mark.parametrize(
    "bad",
    [
        "$share/",
        "$share//",
        "$share//a",
        "$share/g",
        "$share/g/",
        "$share/+/a",
        "$share/#/a",
        "$share/g+/a",
        "$share/g#/a",
        "$share/#",
        "$share/g/a#",
        "$share/g/a+/b",
        "$share/g/#/a",
    ],
)
def test_shared_filters_that_are_none(broker: Broker, bad: str) -> None:
    """The SUBACK says so, or the connection is closed: the standard does not say which."""
    client = joined(broker)
    heard = client.say(packet(0x82, b"\0\1\0", field(bad), b"\0"))
    if client.closed:
        assert heard in (b"", *map(disconnect, (0x81, 0x82, 0x8F)))
    else:
        assert heard[:5] == wire("90 04 0001 00") and heard[5] >= 0x80
        assert client.session.subscriptions == {}
    for topic in ("a", "g/a"):
        assert joined(broker, "sender").publish(topic, b"x", 1) == 0x10


@statement("5.0", "MQTT-4.8.2-1", "MQTT-4.8.2-2", "MQTT-3.3.2-3")
@pytest.mark.parametrize(
    ("topic_filter", "topics", "others"),
    [
        ("$share/g/a", ["a"], ["g/a", "/a", "a/b"]),
        ("$share/consumer1//finance", ["/finance"], ["finance"]),
        ("$share/consumer1/sport/tennis/+", ["sport/tennis/a"], ["sport/tennis", "sport"]),
        ("$share/g/#", ["a", "a/b", "/"], []),
        ("$share/é x/a", ["a"], ["x/a"]),
        ("$share/$share/a", ["a"], ["$share/a"]),
        ("$share/g//", ["/"], ["", "a"]),
    ],
)
def test_the_group_is_left_out_of_the_match(
    broker: Broker, topic_filter: str, topics: list[str], others: list[str]
) -> None:
    (client,) = members(broker, 1, topic_filter)
    sender = joined(broker, "sender")
    for topic in (*topics, *others):
        if topic:
            sender.publish(topic, b"x")
    assert [message.topic for message in client.messages()] == topics


@statement("5.0", "MQTT-4.8.2-1")
@pytest.mark.parametrize("topic_filter", ["$SHARE/g/a", "share/g/a", "$shared/g/a", "a/$share/g"])
def test_what_only_looks_like_a_shared_filter(broker: Broker, topic_filter: str) -> None:
    client = joined(broker)
    client.say(packet(0x82, b"\0\1\0", field(topic_filter), b"\0"))
    assert joined(broker, "sender").publish("a", b"x", 1) == 0x10
    assert b"\x78" not in client.hear()


@statement("5.0", "MQTT-3.8.3-4")
def test_shared_subscriptions_are_announced_by_saying_nothing(broker: Broker) -> None:
    """Section 3.2.2.3.13; and No Local on one is refused, as test_v5_subscriptions.py has it."""
    assert Client(broker).log_in(connect("c")) == ACCEPTED


# --- one of them gets the message


@statement("5.0", "MQTT-4.8.2-3", "MQTT-4.5.0-1")
@QOS
@pytest.mark.parametrize("count", [1, 2, 5])
def test_each_message_goes_to_one_member_and_all_have_their_share(
    broker: Broker, count: int, qos: int
) -> None:
    clients = members(broker, count)
    sender = joined(broker, "sender")
    for n in range(10 * count):
        assert sender.publish("a", b"%d" % n, qos) == 0
    heard = [client.drain() for client in clients]
    assert [len(messages) for messages in heard] == [10] * count
    payloads = [message.payload for messages in heard for message in messages]
    assert Counter(payloads) == Counter(b"%d" % n for n in range(10 * count))


@statement("5.0", "MQTT-4.8.2-3", "MQTT-3.8.4-8")
@QOS
def test_each_member_has_the_qos_that_it_was_granted(broker: Broker, qos: int) -> None:
    clients = []
    for granted in (0, 1, 2):
        client = joined(broker, f"m{granted}")
        assert client.subscribe("$share/g/a", granted) == granted
        clients.append(client)
    sender = joined(broker, "sender")
    for _ in range(9):
        sender.publish("a", b"x", qos)
    for granted, client in enumerate(clients):
        heard = client.drain()
        assert len(heard) == 3
        assert {message.qos for message in heard} == {min(qos, granted)}


@statement("5.0", "MQTT-4.8.2-3", "MQTT-3.3.4-3", "MQTT-3.3.1-13")
def test_each_member_has_its_own_options(broker: Broker) -> None:
    plain, other = joined(broker, "plain"), joined(broker, "other")
    plain.subscribe("$share/g/a")
    other.say(packet(0x82, b"\0\1", properties("0b 07"), field("$share/g/a"), b"\x08"))
    sender = joined(broker, "sender")
    for _ in range(2):
        sender.publish("a", b"x", retain=True)
    assert plain.hear() == publish("a", b"x")
    assert other.hear() == publish("a", b"x", retain=True, props=properties("0b 07"))


@statement("5.0", "MQTT-4.8.2-3", "MQTT-3.3.4-5")
def test_a_client_with_both_kinds_may_get_both_copies(broker: Broker) -> None:
    """One as a member, and one for its other subscriptions together."""
    client = joined(broker)
    for topic_filter, identifier, qos in (("$share/g/a", 1, 1), ("a", 2, 0), ("#", 3, 2)):
        told = properties(bytes((0x0B, identifier)))
        client.say(packet(0x82, b"\0\1", told, field(topic_filter), bytes((qos,))))
    joined(broker, "sender").publish("a", b"x", 2)
    heard = {}
    for message in client.drain():
        assert message.properties is not None
        identifiers = message.properties[P.SUBSCRIPTION_IDENTIFIER]
        heard[tuple(sorted(identifiers))] = message.qos  # type: ignore[arg-type, type-var]
    assert heard == {(1,): 1, (2, 3): 2}


@statement("5.0", "MQTT-4.8.2-3")
def test_groups_and_plain_subscriptions_are_independent(broker: Broker) -> None:
    one, two = members(broker, 2, "$share/one/a"), []
    for n in range(3):
        client = joined(broker, f"n{n}")
        client.subscribe("$share/two/+", 1)
        two.append(client)
    plain = [joined(broker, f"p{n}") for n in range(2)]
    for client in plain:
        client.subscribe("a")
    sender = joined(broker, "sender")
    for _ in range(6):
        sender.publish("a", b"x", 1)
    assert [len(client.drain()) for client in one] == [3, 3]
    assert [len(client.drain()) for client in two] == [2, 2, 2]
    assert [len(client.drain()) for client in plain] == [6, 6]


@statement("5.0", "MQTT-4.8.2-1", "MQTT-3.3.1-9")
@pytest.mark.parametrize("handling", [0, 1, 2])
def test_a_shared_subscription_brings_no_retained_messages(broker: Broker, handling: int) -> None:
    sender = joined(broker, "sender")
    sender.publish("a", b"kept", retain=True)
    client = joined(broker)
    for _ in range(2):
        client.subscribe("$share/g/a", retain_handling=handling)
        assert client.hear() == b""
    sender.publish("a", b"live")
    assert client.hear() == publish("a", b"live")


# --- joining and leaving


@statement("5.0", "MQTT-4.8.2-3", "MQTT-3.10.4-1", "MQTT-3.11.3-2")
def test_subscribing_twice_is_leaving_once(broker: Broker) -> None:
    one, two = members(broker, 2)
    assert one.subscribe("$share/g/a", 0) == 0
    sender = joined(broker, "sender")
    for _ in range(6):
        sender.publish("a", b"x", 1)
    assert [message.qos for message in one.drain()] == [0] * 3
    assert [message.qos for message in two.drain()] == [1] * 3
    assert list(one.unsubscribe("a").reason_codes) == [0x11]
    assert list(one.unsubscribe("$share/h/a").reason_codes) == [0x11]
    assert list(one.unsubscribe("$share/g/a").reason_codes) == [0]
    assert list(one.unsubscribe("$share/g/a").reason_codes) == [0x11]
    for _ in range(4):
        sender.publish("a", b"x", 1)
    assert one.drain() == [] and len(two.drain()) == 4
    two.unsubscribe("$share/g/a")
    assert sender.publish("a", b"x", 1) == 0x10


@statement("5.0", "MQTT-4.8.2-3", "MQTT-3.10.4-3")
@pytest.mark.parametrize("qos", [1, 2])
def test_who_unsubscribes_keeps_what_was_being_sent_and_others_get_the_rest(
    broker: Broker, qos: int
) -> None:
    (one,) = members(broker, 1, properties={P.RECEIVE_MAXIMUM: 1})
    sender = joined(broker, "sender")
    for n in range(3):
        sender.publish("a", b"%d" % n, qos)
    assert one.hear() == publish("a", b"0", qos, 1)
    two = joined(broker, "two")
    two.subscribe("$share/g/a", 2)
    one.unsubscribe("$share/g/a")
    assert [message.payload for message in two.drain()] == [b"1", b"2"]
    (first,) = [Publish("a", b"0", qos, packet_id=1)]
    one.acknowledge(first)
    assert one.hear() == b"" and one.session.inflight == {}


@statement("5.0", "MQTT-4.8.2-3", "MQTT-4.5.0-1")
@pytest.mark.parametrize("qos", [1, 2])
def test_those_who_are_there_come_before_those_who_are_not(broker: Broker, qos: int) -> None:
    one, two, three = members(broker, 3, **lasting(5, 100))
    one.lose()
    three.lose()
    sender = joined(broker, "sender")
    for n in range(6):
        assert sender.publish("a", b"%d" % n, qos) == 0
    assert [message.payload for message in two.drain()] == [b"%d" % n for n in range(6)]
    two.lose()
    # Nobody is there: one of them has it when it comes back.
    assert sender.publish("a", b"later", qos) == 0
    heard = [message for n in range(3) for message in joined(broker, f"m{n}", **lasting(5)).drain()]
    assert [message.payload for message in heard] == [b"later"]


@statement("5.0", "MQTT-4.8.2-3", "MQTT-4.9.0-2")
def test_a_member_that_is_busy_is_passed_over(broker: Broker) -> None:
    (one,) = members(broker, 1, properties={P.RECEIVE_MAXIMUM: 1})
    two = joined(broker, "two")
    two.subscribe("$share/g/a", 2)
    sender = joined(broker, "sender")
    for n in range(8):
        sender.publish("a", b"%d" % n, 1)
    assert len(one.messages()) == 1
    assert len(two.messages()) == 7


# --- with messages on their way


@statement("5.0", "MQTT-4.8.2-4", "MQTT-4.4.0-1")
@pytest.mark.parametrize("after", ["PUBLISH", "PUBREC"])
def test_qos_2_on_its_way_waits_for_its_member(broker: Broker, after: str) -> None:
    clients = members(broker, 3, **lasting(5, 100))
    joined(broker, "sender").publish("a", b"x", 2)
    one, others = chosen(clients)
    name = one.session.client_id
    assert one.hear() == publish("a", b"x", 2, 1)
    if after == "PUBREC":
        assert one.say("50 02 0001") == wire("62 02 0001")
    one.lose()
    broker.tick(broker.now + 50)
    assert [client.hear() for client in others] == [b"", b""]
    one = joined(broker, name, **lasting(5, 100))
    if after == "PUBLISH":
        assert one.hear() == publish("a", b"x", 2, 1, dup=True)
        assert one.say("50 02 0001") == wire("62 02 0001")
    else:
        assert one.hear() == wire("62 02 0001")
    assert one.say("70 02 0001") == b""
    assert [client.hear() for client in others] == [b"", b""]


@statement("5.0", "MQTT-4.8.2-5")
@pytest.mark.parametrize("after", ["PUBLISH", "PUBREC"])
@pytest.mark.parametrize("end", ["expired", "with its connection", "clean start", "DISCONNECT"])
def test_qos_2_on_its_way_to_a_session_that_ends_goes_to_no_other(
    broker: Broker, end: str, after: str
) -> None:
    clients = members(broker, 3, **lasting(5, 0 if end == "with its connection" else 100))
    joined(broker, "sender").publish("a", b"x", 2)
    one, others = chosen(clients)
    name = one.session.client_id
    one.hear()
    if after == "PUBREC":
        one.say("50 02 0001")
    if end == "DISCONNECT":
        one.say("e0 07 00 05 11 00000000")
    else:
        one.lose()
    if end == "expired":
        broker.tick(broker.now + 100)
    again = joined(broker, name, clean=end == "clean start")
    broker.tick(broker.now + 1)
    assert [client.hear() for client in (again, *others)] == [b"", b"", b""]


@statement("5.0", "MQTT-4.8.2-6", "MQTT-4.4.0-2")
@pytest.mark.parametrize("code", ["80", "87", "97"])
@pytest.mark.parametrize(("qos", "first"), [(1, "40"), (2, "50")])
def test_what_a_member_refuses_goes_to_no_other(
    broker: Broker, qos: int, first: str, code: str
) -> None:
    clients = members(broker, 3, **lasting(5, 100))
    joined(broker, "sender").publish("a", b"x", qos)
    one, others = chosen(clients)
    name = one.session.client_id
    one.hear()
    assert one.say(f"{first} 03 0001 {code}") == b""
    one.lose()
    again = joined(broker, name, **lasting(5, 100))
    broker.tick(broker.now + 1)
    assert [client.hear() for client in (again, *others)] == [b"", b"", b""]


@statement("5.0", "MQTT-4.8.2-3", "MQTT-4.5.0-1")
@pytest.mark.parametrize("kept", [0, 100], ids=["session ends", "session is kept"])
def test_qos_1_on_its_way_goes_to_another_when_its_member_is_gone(
    broker: Broker, kept: int
) -> None:
    """It should when the session ends, and it may as soon as the connection is lost."""
    clients = members(broker, 2, **lasting(5, kept))
    joined(broker, "sender").publish("a", b"x", 1)
    one, (other,) = chosen(clients)
    assert one.hear() == publish("a", b"x", 1, 1)
    one.lose()
    broker.tick(broker.now + kept)
    (message,) = other.drain()
    assert (message.payload, message.qos, message.dup) == (b"x", 1, False)


@statement("5.0", "MQTT-4.8.2-3", "MQTT-4.5.0-1")
@pytest.mark.parametrize("qos", [1, 2])
@pytest.mark.parametrize("kept", [0, 100], ids=["session ends", "session is kept"])
def test_what_waits_for_a_member_goes_to_another_when_it_is_gone(
    broker: Broker, kept: int, qos: int
) -> None:
    few: dict[str, object] = {
        "clean": False,
        "properties": {P.RECEIVE_MAXIMUM: 1, P.SESSION_EXPIRY_INTERVAL: kept},
    }
    one, two = members(broker, 2, **few)
    sender = joined(broker, "sender")
    for n in range(6):
        assert sender.publish("a", b"%d" % n, qos) == 0
    (first,) = one.messages()
    one.lose()
    broker.tick(broker.now + kept)
    heard = {message.payload for message in two.drain()}
    expected = {b"%d" % n for n in range(6)}
    # QoS 2 that was on its way to the member is its own, and ends with it.
    assert heard == (expected - {first.payload} if qos == 2 else expected)


@statement("5.0", "MQTT-3.3.2-5", "MQTT-4.8.2-3")
@pytest.mark.parametrize(("waited", "comes"), [(5, True), (50, False)])
def test_what_expires_while_it_waits_goes_to_no_other(
    broker: Broker, waited: int, comes: bool
) -> None:
    (one,) = members(broker, 1, **lasting(5, 100))
    one.lose()
    data = publish("a", b"x", 1, props=properties("02 0000000a"))  # 10 s
    assert joined(broker, "sender").say(data) == wire("40 02 0001")
    other = joined(broker, "other")
    other.subscribe("$share/g/a", 1)
    broker.tick(broker.now + waited)
    joined(broker, "m0", clean=True)
    assert [message.payload for message in other.drain()] == [b"x"] * comes


@statement("5.0", "MQTT-4.8.2-3")
def test_what_nobody_is_left_to_get_is_deleted(broker: Broker) -> None:
    """The shared subscription ends with its last member, and so do its undelivered messages."""
    (one,) = members(broker, 1, **lasting(5, 100))
    one.lose()
    sender = joined(broker, "sender")
    assert sender.publish("a", b"x", 1) == 0
    broker.tick(broker.now + 100)
    (one,) = members(broker, 1)
    assert one.hear() == b""


@statement("5.0", "MQTT-4.8.2-3", "MQTT-3.1.2-5")
def test_a_session_that_goes_on_is_still_a_member(broker: Broker) -> None:
    one, two = members(broker, 2, **lasting(5, 100))
    one.lose()
    one = joined(broker, "m0", **lasting(5, 100))
    sender = joined(broker, "sender")
    for _ in range(4):
        sender.publish("a", b"x", 1)
    assert len(one.drain()) == len(two.drain()) == 2


@statement("5.0", "MQTT-3.1.2-25", "MQTT-3.1.2-24")
def test_a_message_too_large_for_one_member(broker: Broker) -> None:
    """Section 3.1.2.11.4 leaves it to the server; the member that cannot take it is not sent it."""
    small, large = joined(broker, "s", properties={P.MAXIMUM_PACKET_SIZE: 20}), joined(broker, "l")
    for client in (small, large):
        client.subscribe("$share/g/a", 1)
    sender = joined(broker, "sender")
    for _ in range(4):
        assert sender.publish("a", bytes(100), 1) == 0
    assert small.hear() == b""
    assert {message.payload for message in large.drain()} == {bytes(100)}


@statement("5.0", "MQTT-4.6.0-5", "MQTT-4.8.2-3")
@pytest.mark.parametrize("limits", [Limits(inflight=2)])
def test_one_member_gets_its_messages_in_order(broker: Broker) -> None:
    clients = members(broker, 3)
    sender = joined(broker, "sender")
    for n in range(30):
        sender.publish("a", b"%02d" % n, 1)
    for client in clients:
        payloads = [message.payload for message in client.drain()]
        assert len(payloads) == 10 and payloads == sorted(payloads)
