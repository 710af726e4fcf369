"""MQTT 5.0, section 3.3: PUBLISH."""

from __future__ import annotations

import pytest
from broker.conftest import lasting
from client_v5 import (
    disconnect,
    field,
    joined,
    packet,
    properties,
    publish,
    wire,
)

from appliance.broker.broker import Broker
from appliance.broker.limits import Features, Limits
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Publish, Subscribe, Subscription
from appliance.mqtt.topics import matches

P = Property
statement = pytest.mark.statement

QOS = pytest.mark.parametrize("qos", [0, 1, 2])

# --- 3.3.1.1 DUP


@statement("5.0", "MQTT-3.3.1-1", "MQTT-4.4.0-1")
@pytest.mark.parametrize("qos", [1, 2])
def test_what_is_sent_again_has_the_dup_flag(broker: Broker, qos: int) -> None:
    client = joined(broker, **lasting(5))
    client.subscribe("a", 2)
    joined(broker, "sender").publish("a", b"x", qos)
    assert client.hear() == publish("a", b"x", qos)
    for _ in range(3):
        client.lose()
        client = joined(broker, **lasting(5))
        assert client.hear() == publish("a", b"x", qos, dup=True)


@statement("5.0", "MQTT-3.3.1-2")
def test_qos_0_with_the_dup_flag_is_malformed(broker: Broker) -> None:
    client = joined(broker)
    client.subscribe("a")
    assert client.say(publish("a", b"x", dup=True)) == disconnect(0x81) and client.closed


@statement("5.0", "MQTT-3.3.1-2", "MQTT-3.3.1-3")
@pytest.mark.parametrize("granted", [0, 1, 2])
@pytest.mark.parametrize("qos", [1, 2])
def test_the_dup_flag_that_came_in_does_not_go_out(broker: Broker, qos: int, granted: int) -> None:
    client, sender = joined(broker), joined(broker, "sender")
    client.subscribe("a", granted)
    sender.say(publish("a", b"x", qos, 7, dup=True), "62 02 0007" if qos == 2 else "")
    assert client.hear() == publish("a", b"x", min(qos, granted))


# --- 3.3.1.2 QoS


@statement("5.0", "MQTT-3.3.1-4", "MQTT-4.13.1-1")
@pytest.mark.parametrize("first", ["36", "37", "3e", "3f"])
def test_both_qos_bits_are_malformed(broker: Broker, first: str) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("a")
    client = joined(broker)
    assert client.say(f"{first} 07 0001 61 0001 00 78") == disconnect(0x81) and client.closed
    assert watcher.hear() == b""


# --- 3.3.1.3 RETAIN


def retained(broker: Broker, topic_filter: str = "#") -> bytes:
    """What a new subscription of QoS 2 is sent."""
    client = joined(broker, "later")
    client.subscribe(topic_filter, 2)
    heard = client.hear()
    client.lose()
    return heard


@statement("5.0", "MQTT-3.3.1-5")
@QOS
def test_a_retained_message_is_kept_with_its_qos_and_replaced(broker: Broker, qos: int) -> None:
    sender = joined(broker, "sender")
    sender.publish("a", b"1", 2 - qos, retain=True)
    sender.publish("a", b"2", qos, retain=True)
    assert retained(broker) == publish("a", b"2", qos, retain=True)
    assert retained(broker) == publish("a", b"2", qos, retain=True)
    assert retained(broker, "b") == b""


@statement("5.0", "MQTT-3.3.1-5", "MQTT-3.3.2-17", "MQTT-3.3.2-20")
def test_a_retained_message_is_kept_with_its_properties(broker: Broker) -> None:
    told = properties("01 01", "03 0001 74", "26 0001 62 0001 32", "26 0001 61 0001 31")
    joined(broker, "sender").say(publish("a", b"x", retain=True, props=told))
    assert retained(broker) == publish("a", b"x", retain=True, props=told)


@statement("5.0", "MQTT-3.3.1-6", "MQTT-3.3.1-7")
@QOS
def test_an_empty_retained_message_is_delivered_and_clears_the_topic(
    broker: Broker, qos: int
) -> None:
    sender, watcher = joined(broker, "sender"), joined(broker, "watcher")
    sender.publish("a", b"1", retain=True)
    sender.publish("a/b", b"2", retain=True)
    watcher.subscribe("a", 2, retain_handling=2)
    sender.publish("a", b"", qos, retain=True)
    assert watcher.hear() == publish("a", b"", qos)
    assert retained(broker) == publish("a/b", b"2", retain=True)
    sender.publish("a", b"", qos, retain=True)  # where there is nothing to clear
    sender.publish("new", b"", qos, retain=True)
    assert retained(broker) == publish("a/b", b"2", retain=True)


@statement("5.0", "MQTT-3.3.1-8")
@pytest.mark.parametrize("payload", [b"live", b""])
@QOS
def test_a_message_without_retain_leaves_the_retained_one(
    broker: Broker, qos: int, payload: bytes
) -> None:
    sender = joined(broker, "sender")
    sender.publish("a", b"kept", retain=True)
    sender.publish("a", payload, qos)
    sender.publish("b", payload, qos)
    assert retained(broker) == publish("a", b"kept", retain=True)


@pytest.mark.parametrize(
    ("handling", "new", "again"),
    [
        pytest.param(0, True, True, marks=statement("5.0", "MQTT-3.3.1-9", "MQTT-3.8.4-4")),
        pytest.param(1, True, False, marks=statement("5.0", "MQTT-3.3.1-10")),
        pytest.param(2, False, False, marks=statement("5.0", "MQTT-3.3.1-11")),
    ],
)
def test_retain_handling(broker: Broker, handling: int, new: bool, again: bool) -> None:
    sender = joined(broker, "sender")
    for topic in ("a/1", "a/2", "b"):
        sender.publish(topic, b"x", retain=True)
    all_of_it = publish("a/1", b"x", retain=True) + publish("a/2", b"x", retain=True)
    client = joined(broker, **lasting(5))
    option = bytes((handling << 4,))
    subscribe = packet(0x82, b"\0\1\0", field("a/+"), option)
    suback = wire("90 04 0001 00 00")
    assert client.say(subscribe) == suback + (all_of_it if new else b"")
    assert client.say(subscribe) == suback + (all_of_it if again else b"")
    # Another filter is another subscription, and one that is gone is new when it comes back.
    other = packet(0x82, b"\0\1\0", field("a/#"), option)
    assert client.say(other) == suback + (all_of_it if new else b"")
    client.lose()
    client = joined(broker, **lasting(5))
    assert client.say(subscribe) == suback + (all_of_it if again else b"")
    client.say("a2 08 0002 00 0003 612f2b")
    assert client.say(subscribe) == suback + (all_of_it if new else b"")


@statement("5.0", "MQTT-3.3.1-9")
def test_many_retained_messages_all_come(broker: Broker) -> None:
    sender = joined(broker, "sender")
    for n in range(100):
        sender.publish(f"a/{n}", b"x", n % 3, retain=True)
    client = joined(broker)
    client.subscribe("a/#", 2)
    topics = sorted(message.topic for message in client.drain())
    assert topics == sorted(f"a/{n}" for n in range(100))


@statement("5.0", "MQTT-3.3.1-12", "MQTT-3.3.1-13")
@pytest.mark.parametrize("as_published", [0, 1])
@pytest.mark.parametrize("retain", [False, True])
@QOS
def test_retain_as_published(broker: Broker, qos: int, retain: bool, as_published: int) -> None:
    client, late = joined(broker), joined(broker, "late", **lasting(5))
    for one in (client, late):
        one.subscribe("a", 2, retain_as_published=as_published)
    late.lose()
    joined(broker, "sender").publish("a", b"x", qos, retain=retain)
    expected = publish("a", b"x", qos, retain=retain and bool(as_published))
    assert client.hear() == expected
    late = joined(broker, "late", **lasting(5))
    assert late.hear() == (expected if qos else b"")


@statement("5.0", "MQTT-3.3.1-12", "MQTT-3.3.1-9")
def test_what_comes_upon_subscribing_is_marked_as_retained(broker: Broker) -> None:
    """Section 3.3.1.3: with RETAIN 1, whatever Retain As Published says."""
    joined(broker, "sender").publish("a", b"x", retain=True)
    client = joined(broker)
    client.subscribe("a", retain_as_published=0)
    assert client.hear() == publish("a", b"x", retain=True)


# --- 3.3.2.1 topic


@statement("5.0", "MQTT-3.3.2-1", "MQTT-4.13.1-1")
@pytest.mark.parametrize("data", ["30 00", "30 01 00", "30 02 0001", "30 03 0005 61", "32 02 0000"])
def test_a_publish_without_a_whole_topic_is_malformed(broker: Broker, data: str) -> None:
    client = joined(broker)
    assert client.say(data) == disconnect(0x81) and client.closed


@statement("5.0", "MQTT-3.3.2-2", "MQTT-4.7.0-1")
@pytest.mark.parametrize("topic", ["#", "+", "a/#", "a/+/b", "a#", "a+", "+a", "#/a"])
@QOS
def test_a_topic_with_a_wildcard_ends_the_connection(broker: Broker, topic: str, qos: int) -> None:
    """With one of the codes that DISCONNECT has for this; the standard names none."""
    watcher = joined(broker, "watcher")
    watcher.subscribe("#")
    client = joined(broker)
    assert client.say(publish(topic, b"x", qos, retain=True)) in map(disconnect, (0x81, 0x82, 0x90))
    assert client.closed
    assert watcher.hear() == b"" and retained(broker) == b""


@statement("5.0", "MQTT-4.7.3-1", "MQTT-4.13.1-1")
@QOS
def test_an_empty_topic_without_an_alias_is_a_protocol_error(broker: Broker, qos: int) -> None:
    """Section 3.3.2.1."""
    client = joined(broker)
    assert client.say(publish("", b"x", qos)) in map(disconnect, (0x82, 0x90)) and client.closed


@statement("5.0", "MQTT-3.3.2-3")
def test_the_topic_of_what_is_delivered_matches_the_filter(broker: Broker) -> None:
    topics = ["a", "/a", "a/", "a/b", "a//b", "A", "a/b/c", "b", "$a", "é", " "]
    filters = [
        "a",
        "/a",
        "+",
        "#",
        "a/#",
        "a/+",
        "+/+",
        "/+",
        "+/",
        "a/+/b",
        "+/b/#",
        "é",
        " ",
        "A",
    ]
    clients = {topic_filter: joined(broker, f"of {topic_filter}") for topic_filter in filters}
    for topic_filter, client in clients.items():
        client.subscribe(topic_filter)
    sender = joined(broker, "sender")
    for topic in topics:
        sender.publish(topic, topic.encode())
    for topic_filter, client in clients.items():
        heard = client.messages()
        assert all(message.payload == message.topic.encode() for message in heard)
        expected = [topic for topic in topics if matches(topic_filter, topic) and topic != "$a"]
        assert [message.topic for message in heard] == expected


# --- 3.3.2.3.2 and others: what is passed on unaltered

PASSED_ON = {
    "payload format 0": "01 00",
    "payload format 1": "01 01",
    "content type": "03 0004 74657874",
    "empty content type": "03 0000",
    "response topic": "08 0003 612f62",
    "response topic with a $": "08 0002 2462",
    "correlation data": "09 0003 00ff80",
    "empty correlation data": "09 0000",
    "user properties": "26 0001 62 0000 26 0001 61 0001 31 26 0001 62 0001 31 26 0001 62 0000",
    "empty user property": "26 0000 0000",
    "all": "01 01 03 0001 74 08 0001 72 09 0001 aa 26 0001 62 0000 26 0001 61 0000",
}


@pytest.mark.parametrize(
    "told",
    [
        pytest.param(
            told,
            id=name,
            marks=[
                statement("5.0", statement_id)
                for part, statement_id in {
                    "payload format": "MQTT-3.3.2-4",
                    "response topic": "MQTT-3.3.2-15",
                    "correlation data": "MQTT-3.3.2-16",
                    "user propert": "MQTT-3.3.2-17",
                    "user properties": "MQTT-3.3.2-18",
                    "content type": "MQTT-3.3.2-20",
                }.items()
                if part in name
            ],
        )
        for name, told in PASSED_ON.items()
    ],
)
@QOS
def test_properties_are_passed_on_as_they_are(broker: Broker, told: str, qos: int) -> None:
    props = properties(told)
    first, second = joined(broker, "first"), joined(broker, "second")
    absent = joined(broker, "absent", **lasting(5))
    for client in (first, second, absent):
        client.subscribe("a", 2)
    absent.lose()
    sender = joined(broker, "sender")
    sender.say(publish("a", b"x", qos, 7, props=props), "62 02 0007" if qos == 2 else "")
    expected = publish("a", b"x", qos, props=props)
    assert first.hear() == second.hear() == expected
    absent = joined(broker, "absent", **lasting(5))
    assert absent.hear() == (expected if qos else b"")


@statement("5.0", "MQTT-3.3.2-14", "MQTT-4.13.1-1")
@pytest.mark.parametrize("topic", ["+", "#", "a/+", "a/#", "a#"])
def test_a_response_topic_with_a_wildcard_ends_the_connection(broker: Broker, topic: str) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("#")
    client = joined(broker)
    data = publish("a", b"x", props=properties(b"\x08" + field(topic)))
    assert client.say(data) in map(disconnect, (0x81, 0x82, 0x90)) and client.closed
    assert watcher.hear() == b""


@statement("5.0", "MQTT-3.3.2-4", "MQTT-3.4.2-1", "MQTT-3.5.2-1")
@QOS
def test_a_payload_that_is_not_in_its_format_is_refused_when_asked_to(
    broker: Broker, qos: int
) -> None:
    """Section 3.3.2.3.2: 0x99."""
    broker.features = Features(check_payload_format=True)
    watcher = joined(broker, "watcher")
    watcher.subscribe("a", 2)
    client = joined(broker)
    text, data = properties("01 01"), properties("01 00")
    bad = publish("a", b"\xff", qos, 1, props=text)
    if qos:
        first = "40" if qos == 1 else "50"
        assert client.say(bad) == wire(f"{first} 03 0001 99")
    else:
        assert client.say(bad) in (b"", disconnect(0x99))
        client = joined(broker)
    assert watcher.hear() == b""
    client.say(publish("a", "é".encode(), props=text), publish("a", b"\xff", props=data))
    expected = publish("a", "é".encode(), props=text) + publish("a", b"\xff", props=data)
    assert watcher.hear() == expected


@statement("5.0", "MQTT-3.3.2-4")
def test_a_payload_that_is_not_in_its_format_is_passed_on_when_not_asked_to(
    broker: Broker,
) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("a", 2)
    data = publish("a", b"\xff", props=properties("01 01"))
    assert joined(broker).say(data) == b""
    assert watcher.hear() == data


# --- 3.3.2.3.3 Message Expiry Interval


def expiring(seconds: int, qos: int = 1, *, retain: bool = False) -> bytes:
    props = properties(b"\x02" + seconds.to_bytes(4, "big"))
    return publish("a", b"x", qos, 1, props=props, retain=retain)


@statement("5.0", "MQTT-3.3.2-5", "MQTT-3.3.2-6")
@pytest.mark.parametrize(
    ("waited", "left"), [(0, 10), (3, 7), (9, 1), (10, None), (11, None), (1000, None)]
)
def test_a_queued_message_has_the_time_that_is_left_or_is_gone(
    broker: Broker, waited: int, left: int | None
) -> None:
    client = joined(broker, **lasting(5))
    client.subscribe("a", 1)
    client.lose()
    joined(broker, "sender").say(expiring(10))
    broker.tick(broker.now + waited)
    client = joined(broker, **lasting(5))
    assert client.hear() == (b"" if left is None else expiring(left))


@statement("5.0", "MQTT-3.3.2-5", "MQTT-3.3.2-6")
@pytest.mark.parametrize(("waited", "left"), [(0, 10), (3, 7), (9, 1), (10, None), (1000, None)])
def test_a_retained_message_has_the_time_that_is_left_or_is_gone(
    broker: Broker, waited: int, left: int | None
) -> None:
    joined(broker, "sender").say(expiring(10, retain=True))
    broker.tick(broker.now + waited)
    assert retained(broker) == (b"" if left is None else expiring(left, retain=True))


@statement("5.0", "MQTT-3.3.2-5")
def test_each_subscribers_copy_expires_by_itself(broker: Broker) -> None:
    busy = joined(broker, "busy", properties={P.RECEIVE_MAXIMUM: 1})
    idle = joined(broker, "idle")
    for client in (busy, idle):
        client.subscribe("#", 1)
    sender = joined(broker, "sender")
    sender.publish("first", b"1", 1)
    sender.say(expiring(10))
    assert (
        idle.hear() == publish("first", b"1", 1, 1) + expiring(10)[:5] + b"\0\2" + expiring(10)[7:]
    )
    assert busy.hear() == publish("first", b"1", 1, 1)
    broker.tick(broker.now + 11)
    assert busy.say("40 02 0001") == b""
    sender.publish("last", b"3", 1)
    (message,) = busy.messages()
    assert message.topic == "last"


@statement("5.0", "MQTT-3.3.2-5", "MQTT-3.3.2-6", "MQTT-4.3.3-13")
@pytest.mark.parametrize(("waited", "left"), [(3, 7), (11, None)])
def test_the_time_until_pubrel_counts(broker: Broker, waited: int, left: int | None) -> None:
    client, sender = joined(broker), joined(broker, "sender")
    client.subscribe("a", 2)
    assert sender.say(expiring(10, 2)) == wire("50 02 0001")
    broker.tick(broker.now + waited)
    assert sender.say("62 02 0001") == wire("70 02 0001")
    assert client.hear() == (b"" if left is None else expiring(left, 2))


@statement("5.0", "MQTT-3.3.2-6")
@QOS
def test_a_message_that_did_not_wait_has_its_whole_interval(broker: Broker, qos: int) -> None:
    client = joined(broker)
    client.subscribe("a", 2)
    said = [expiring(4294967295, qos), b"\x62\2\0\1" if qos == 2 else b""]
    joined(broker, "sender").say(*said)
    assert client.hear() == said[0]


@statement("5.0", "MQTT-3.3.2-6", "MQTT-3.3.2-5")
def test_without_an_interval_a_message_does_not_expire(broker: Broker) -> None:
    client = joined(broker, **lasting(5, 2_000_000))
    client.subscribe("a", 1)
    client.lose()
    joined(broker, "sender").publish("a", b"x", 1)
    broker.tick(broker.now + 500_000)
    assert joined(broker, **lasting(5)).hear() == publish("a", b"x", 1)


# --- 3.3.2.3.4 Topic Alias

ALIAS_1 = properties("23 0001")


@statement("5.0", "MQTT-3.3.2-12")
@pytest.mark.parametrize("limits", [Limits(), Limits(topic_alias=65535)], ids=["10", "65535"])
@QOS
def test_every_alias_up_to_the_maximum_is_taken(broker: Broker, limits: Limits, qos: int) -> None:
    watcher, client = joined(broker, "watcher"), joined(broker)
    watcher.subscribe("#")
    release = b"\x62\2\0\1" if qos == 2 else b""
    aliases = sorted({1, 2, limits.topic_alias // 2, limits.topic_alias})
    for alias in aliases:
        props = properties(b"\x23" + alias.to_bytes(2, "big"))
        client.say(publish(f"topic/{alias}", b"1", qos, props=props), release)
    for alias in aliases:
        props = properties(b"\x23" + alias.to_bytes(2, "big"))
        client.say(publish("", b"2", qos, props=props), release)
    heard = [publish(f"topic/{alias}", payload) for payload in (b"1", b"2") for alias in aliases]
    assert watcher.hear() == b"".join(heard)


@statement("5.0", "MQTT-3.3.2-12")
def test_an_alias_may_be_given_another_topic(broker: Broker) -> None:
    watcher, client = joined(broker, "watcher"), joined(broker)
    watcher.subscribe("#")
    client.say(
        publish("a", b"1", props=ALIAS_1),
        publish("b", b"2", props=ALIAS_1),
        publish("", b"3", props=ALIAS_1),
        publish("a", b"4"),
        publish("", b"5", props=ALIAS_1),
    )
    topics = "abbab"
    assert watcher.hear() == b"".join(
        publish(topic, b"%d" % n) for n, topic in enumerate(topics, 1)
    )


@statement("5.0", "MQTT-3.3.2-7")
def test_a_clients_alias_ends_with_its_connection(broker: Broker) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("#")
    client = joined(broker, **lasting(5))
    client.say(publish("a", b"1", props=ALIAS_1))
    assert watcher.hear() == publish("a", b"1")
    client.lose()
    again = joined(broker, **lasting(5))
    assert again.say(publish("", b"2", props=ALIAS_1)) in map(disconnect, (0x82, 0x94))
    assert again.closed
    assert watcher.hear() == b""


@statement("5.0", "MQTT-3.3.2-7")
def test_a_servers_alias_ends_with_its_connection(broker: Broker) -> None:
    kept = {P.TOPIC_ALIAS_MAXIMUM: 2, P.SESSION_EXPIRY_INTERVAL: 100}
    sender = joined(broker, "sender")
    client = joined(broker, clean=False, properties=kept)
    client.subscribe("a/long/topic", 1)
    for _ in range(2):
        sender.publish("a/long/topic", b"x")
        sender.publish("a/long/topic", b"x")
        first = publish("a/long/topic", b"x", props=ALIAS_1)
        assert client.hear() == first + publish("", b"x", props=ALIAS_1)
        client.lose()
        client = joined(broker, clean=False, properties=kept)
    client.lose()
    # What is sent again on another connection has its topic.
    client = joined(broker, clean=False, properties=kept)
    sender.publish("a/long/topic", b"y", 1)
    assert client.hear() == publish("a/long/topic", b"y", 1, props=ALIAS_1)
    client.lose()
    client = joined(broker, **lasting(5))
    assert client.hear() == publish("a/long/topic", b"y", 1, dup=True)


@statement("5.0", "MQTT-3.3.2-7")
def test_aliases_of_client_and_server_are_apart(broker: Broker) -> None:
    client = joined(broker, properties={P.TOPIC_ALIAS_MAXIMUM: 2})
    client.subscribe("a/long/topic")
    joined(broker, "sender").publish("a/long/topic", b"x")
    assert client.hear() == publish("a/long/topic", b"x", props=ALIAS_1)
    assert client.say(publish("", b"y", props=ALIAS_1)) in map(disconnect, (0x82, 0x94))


@statement("5.0", "MQTT-3.3.2-8")
@pytest.mark.parametrize("topic", ["a", ""])
def test_an_alias_of_0_is_refused(broker: Broker, topic: str) -> None:
    client = joined(broker)
    assert client.say(publish(topic, props=properties("23 0000"))) == disconnect(0x94)
    assert client.closed


# --- 3.3.4 actions


@statement("5.0", "MQTT-3.3.4-1")
@pytest.mark.parametrize(("qos", "answer"), [(0, ""), (1, "40 02 0007"), (2, "50 02 0007")])
def test_each_qos_has_its_answer(broker: Broker, qos: int, answer: str) -> None:
    joined(broker, "watcher").subscribe("a")
    assert joined(broker).say(publish("a", b"x", qos, 7)) == wire(answer)


@statement("5.0", "MQTT-3.3.4-1", "MQTT-3.4.2-1", "MQTT-3.5.2-1")
@pytest.mark.parametrize(("qos", "answer"), [(0, ""), (1, "40 03 0007 10"), (2, "50 02 0007")])
def test_who_publishes_for_nobody_is_told(broker: Broker, qos: int, answer: str) -> None:
    """Sections 3.4.2.1 and 3.5.2.1 allow it for both; for QoS 2 it may change until PUBREL."""
    assert joined(broker).say(publish("a", b"x", qos, 7)) == wire(answer)


@statement("5.0", "MQTT-3.3.4-2", "MQTT-3.8.4-8")
@pytest.mark.parametrize("granted", [(0, 1, 2), (2, 1, 0), (1, 0, 1), (0, 0, 0)])
@QOS
def test_of_overlapping_subscriptions_the_highest_qos_counts(
    broker: Broker, granted: tuple[int, ...], qos: int
) -> None:
    client = joined(broker)
    for topic_filter, of_filter in zip(("a/b", "a/+", "#"), granted, strict=True):
        client.subscribe(topic_filter, of_filter)
    joined(broker, "sender").publish("a/b", b"x", qos)
    assert client.hear() == publish("a/b", b"x", min(qos, max(granted)))


@statement("5.0", "MQTT-3.3.4-3", "MQTT-3.3.4-4")
@QOS
def test_a_message_brings_all_identifiers_that_matched(broker: Broker, qos: int) -> None:
    client = joined(broker)
    for topic_filter, identifier in (("a/b", 1), ("a/+", 200), ("#", 1), ("a/#", 0), ("b", 5)):
        given = {P.SUBSCRIPTION_IDENTIFIER: [identifier]} if identifier else None
        client.send(Subscribe(1, [Subscription(topic_filter, 2)], given))
    client.hear()
    joined(broker, "sender").publish("a/b", b"x", qos)
    (message,) = client.messages()
    assert (message.qos, message.payload) == (qos, b"x")
    assert message.properties is not None
    assert set(message.properties) == {P.SUBSCRIPTION_IDENTIFIER}
    assert set(message.properties[P.SUBSCRIPTION_IDENTIFIER]) == {1, 200}  # type: ignore[arg-type]


@statement("5.0", "MQTT-3.3.4-3")
def test_an_identifier_goes_with_its_subscription(broker: Broker) -> None:
    client, sender = joined(broker, **lasting(5)), joined(broker, "sender")
    sender.publish("a", b"r", retain=True)
    subscribe = packet(0x82, b"\0\1", properties("0b 07"), field("a"), b"\1")
    with_it = properties("0b 07")
    suback = wire("90 04 0001 00 01")
    assert client.say(subscribe) == suback + publish("a", b"r", retain=True, props=with_it)
    client.lose()
    sender.publish("a", b"x", 1)
    client = joined(broker, **lasting(5))
    assert client.hear() == publish("a", b"x", 1, props=with_it)
    client.say("82 07 0002 00 0001 61 21")  # again, and without one
    sender.publish("a", b"y")
    assert client.hear() == publish("a", b"y")


@statement("5.0", "MQTT-3.3.4-6")
@pytest.mark.parametrize("identifier", ["01", "80 01", "01 0b 02"])
def test_a_client_that_sends_an_identifier_breaks_the_protocol(
    broker: Broker, identifier: str
) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("a")
    client = joined(broker)
    data = publish("a", b"x", props=properties(f"0b {identifier}"))
    assert client.say(data) == disconnect(0x82) and client.closed
    assert watcher.hear() == b""


@statement("5.0", "MQTT-3.3.4-7")
@pytest.mark.parametrize("limits", [Limits(inflight=3)])
def test_more_than_the_receive_maximum_ends_the_connection(broker: Broker) -> None:
    """Section 3.3.4: 0x93."""
    joined(broker, "watcher").subscribe("a", 2)
    client = joined(broker)
    for packet_id in (1, 2, 3):
        assert client.say(publish("a", b"x", 2, packet_id))[:2] == b"\x50\2"
    assert client.say(publish("a", b"x", 2, 4)) == disconnect(0x93) and client.closed


@statement("5.0", "MQTT-3.3.4-7")
@pytest.mark.parametrize("limits", [Limits(inflight=3)])
def test_up_to_the_receive_maximum_all_is_well(broker: Broker) -> None:
    joined(broker, "watcher").subscribe("a")
    client = joined(broker)
    for packet_id in (1, 2, 3):
        client.say(publish("a", b"x", 2, packet_id))
    # Those that are acknowledged with an error, or to their end, and QoS 0 do not count.
    assert client.say(publish("a", b"x")) == b""
    assert client.say(publish("a", b"x", 2, 3, dup=True)) == wire("50 02 0003")
    for _ in range(10):
        assert client.say("62 02 0002") == wire("70 02 0002")
        assert client.say(publish("a", b"x", 2, 2)) == wire("50 02 0002")
    for packet_id in (1, 2, 3):
        assert client.say(wire("62 02") + packet_id.to_bytes(2, "big"))[0] == 0x70
    for _ in range(10):
        assert client.say(publish("a", b"x", 1, 7)) == wire("40 02 0007")


@statement("5.0", "MQTT-3.3.4-9", "MQTT-4.9.0-1", "MQTT-4.9.0-2")
@pytest.mark.parametrize("qos", [1, 2])
@pytest.mark.parametrize("maximum", [1, 2, 5])
def test_no_more_is_under_way_than_the_clients_receive_maximum(
    broker: Broker, maximum: int, qos: int
) -> None:
    client = joined(broker, properties={P.RECEIVE_MAXIMUM: maximum})
    client.subscribe("#", 2)
    sender = joined(broker, "sender")
    for n in range(12):
        sender.publish("a", b"%d" % n, qos)
    heard: list[Publish] = client.messages()
    assert len(heard) == maximum
    for n in range(12 - maximum):
        client.acknowledge(heard[n])
        more = client.messages()
        assert len(more) == 1, "one for the one that is done"
        heard += more
    client.acknowledge(*heard[12 - maximum :])
    assert [message.payload for message in heard] == [b"%d" % n for n in range(12)]
    assert client.hear() == b""


@statement("5.0", "MQTT-3.3.4-9", "MQTT-4.9.0-2")
def test_a_pubrec_is_not_the_end_of_a_message_under_way(broker: Broker) -> None:
    client = joined(broker, properties={P.RECEIVE_MAXIMUM: 1})
    client.subscribe("#", 2)
    sender = joined(broker, "sender")
    sender.publish("a", b"1", 2)
    sender.publish("a", b"2", 2)
    assert client.hear() == publish("a", b"1", 2, 1)
    assert client.say("50 02 0001") == wire("62 02 0001")
    assert client.say("70 02 0001") == publish("a", b"2", 2, 2)
    sender.publish("a", b"3", 1)
    # With an error it is.
    assert client.say("50 03 0002 80") == publish("a", b"3", 1, 3)
    sender.publish("a", b"4", 1)
    assert client.say("40 03 0003 80") == publish("a", b"4", 1, 4)


@statement("5.0", "MQTT-3.3.4-10", "MQTT-4.9.0-3")
@pytest.mark.parametrize("qos", [1, 2])
def test_a_full_window_holds_up_nothing_else(broker: Broker, qos: int) -> None:
    client = joined(broker, properties={P.RECEIVE_MAXIMUM: 1})
    client.subscribe("a", 2)
    joined(broker, "watcher").subscribe("b")
    sender = joined(broker, "sender")
    sender.publish("a", b"1", qos)
    sender.publish("a", b"2", qos)
    assert client.hear() == publish("a", b"1", qos, 1)
    assert client.say("c0 00") == wire("d0 00")
    assert client.say("82 07 0002 00 0001 63 00") == wire("90 04 0002 00 00")
    assert client.say("a2 06 0003 00 0001 63") == wire("b0 04 0003 00 00")
    assert client.say(publish("b", b"x", 1, 4)) == wire("40 02 0004")
    assert client.say(publish("b", b"x", 2, 5)) == wire("50 02 0005")
    assert client.say("62 02 0005") == wire("70 02 0005")
    if qos == 2:
        assert client.say("50 02 0001") == wire("62 02 0001")
        assert client.say("50 02 0001") == wire("62 02 0001")
