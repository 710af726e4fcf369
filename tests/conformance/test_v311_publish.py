"""MQTT 3.1.1, chapters 3.3 and 4.3: PUBLISH, retained messages and the three QoS."""

from __future__ import annotations

import pytest
from broker.conftest import FakeAccess
from client_v311 import SESSION_PRESENT, Client, connect, field, joined, owed, packet, refused, wire

from appliance.broker.broker import Broker
from appliance.broker.values import Action

statement = pytest.mark.statement

# --- flags


@statement("3.1.1", "MQTT-3.3.1-1", "MQTT-4.4.0-1")
@pytest.mark.parametrize("qos", [1, 2])
def test_what_is_sent_again_has_dup(broker: Broker, qos: int) -> None:
    client = joined(broker, "c", clean=False)
    client.subscribe("a", qos)
    joined(broker, "other").publish("a", b"x", qos)
    assert client.hear() == wire(f"3{2 * qos} 06 0001 61 0001 78")
    for _ in range(2):
        client.lose()
        client = Client(broker)
        assert client.log_in(connect("c", flags=0)) == SESSION_PRESENT + wire(
            f"3{8 + 2 * qos:x} 06 0001 61 0001 78"
        )


@statement("3.1.1", "MQTT-3.3.1-2")
@pytest.mark.parametrize("retain", [0, 1])
def test_dup_with_qos_0_closes_the_connection(broker: Broker, retain: int) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("a")
    assert refused(joined(broker), bytes((0x38 | retain,)) + wire("04 0001 61 78"))
    assert watcher.hear() == b"" and len(broker.retained) == 0


@statement("3.1.1", "MQTT-3.3.1-2", "MQTT-3.3.1-3", "MQTT-4.3.1-1")
@statement("3.1.1", "MQTT-4.3.2-1", "MQTT-4.3.3-1")
@pytest.mark.parametrize("granted", [0, 1, 2])
@pytest.mark.parametrize("sent", [1, 2])
def test_dup_is_not_passed_on(broker: Broker, sent: int, granted: int) -> None:
    receiver, sender = joined(broker, "receiver"), joined(broker, "sender")
    receiver.subscribe("a", granted)
    sender.say(packet(0x38 | sent << 1, field("a"), b"\0\7", b"x"))
    if sent == 2:
        assert sender.say("62 02 0007") == wire("70 02 0007")
    qos = min(sent, granted)
    packet_id = b"\0\1" if qos else b""
    assert receiver.hear() == packet(0x30 | qos << 1, field("a"), packet_id, b"x")


@statement("3.1.1", "MQTT-3.3.1-4", "MQTT-4.8.0-1")
@pytest.mark.parametrize("first", [0x36, 0x37, 0x3E, 0x3F])
def test_qos_3_closes_the_connection(broker: Broker, first: int) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("#", 2)
    assert refused(joined(broker), bytes((first,)) + wire("06 0001 61 0001 78"))
    assert watcher.hear() == b"" and len(broker.retained) == 0


# --- retained messages


def retained(broker: Broker, topic_filter: str = "#") -> bytes:
    """The PUBLISH packets of a new subscription with QoS 2."""
    reader = joined(broker, "reader")
    assert reader.subscribe(topic_filter, 2) == 2
    heard = reader.hear()
    reader.disconnect()
    return heard


@statement("3.1.1", "MQTT-3.3.1-5", "MQTT-3.3.1-8")
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_a_retained_message_is_stored_with_its_qos(broker: Broker, qos: int) -> None:
    joined(broker).publish("a", b"x", qos, retain=True)
    kept = packet(0x31 | qos << 1, field("a"), b"\0\1" if qos else b"", b"x")
    assert retained(broker) == kept
    assert retained(broker, "a") == kept
    assert retained(broker, "+") == kept
    assert retained(broker, "b") == b""


@statement("3.1.1", "MQTT-3.3.1-6", "MQTT-3.3.1-8")
def test_a_new_subscription_gets_the_last_of_each_topic(broker: Broker) -> None:
    client = joined(broker)
    for payload in (b"1", b"2"):
        for topic in ("a", "a/b", "a/c", "d"):
            client.publish(topic, topic.encode() + payload, retain=True)
    reader = joined(broker, "reader")
    reader.subscribe("a/#")
    kept = [(message.topic, message.payload, message.retain) for message in reader.messages()]
    assert sorted(kept) == [("a", b"a2", True), ("a/b", b"a/b2", True), ("a/c", b"a/c2", True)]


@statement("3.1.1", "MQTT-3.3.1-7")
def test_a_retained_message_of_qos_0_discards_the_one_before(broker: Broker) -> None:
    client = joined(broker)
    for qos in (2, 1, 0):
        client.publish("a", b"old", qos, retain=True)
        client.publish("a", b"new", 0, retain=True)
        assert retained(broker) == wire("31 06 0001 61 6e6577")


@statement("3.1.1", "MQTT-3.3.1-8", "MQTT-3.3.1-9")
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_retain_tells_stored_messages_from_live_ones(broker: Broker, qos: int) -> None:
    subscriber, client = joined(broker, "subscriber"), joined(broker)
    subscriber.subscribe("a", 2)
    client.publish("a", b"x", qos, retain=True)
    (message,) = subscriber.drain()
    assert not message.retain
    client.publish("a", b"y", qos)
    (message,) = subscriber.drain()
    assert not message.retain
    subscriber.subscribe("a", 2)
    (message,) = subscriber.drain()
    assert (message.payload, message.retain) == (b"x", True)


@statement("3.1.1", "MQTT-3.3.1-9")
def test_what_waits_for_an_absent_client_is_no_retained_message(broker: Broker) -> None:
    client = joined(broker, "c", clean=False)
    client.subscribe("a", 1)
    client.lose()
    joined(broker, "other").publish("a", b"x", 1, retain=True)
    client = Client(broker)
    assert client.log_in(connect("c", flags=0)) == SESSION_PRESENT + wire("32 06 0001 61 0001 78")


@statement("3.1.1", "MQTT-3.3.1-10", "MQTT-3.3.1-11")
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_an_empty_retained_message_removes_and_is_delivered(broker: Broker, qos: int) -> None:
    subscriber, client = joined(broker, "subscriber"), joined(broker)
    subscriber.subscribe("a", 2)
    for there in (True, False):
        if there:
            client.publish("a", b"kept", retain=True)
            subscriber.hear()
        client.publish("a", b"", qos, retain=True)
        (message,) = subscriber.drain()
        assert (message.payload, message.qos, message.retain) == (b"", qos, False)
        assert retained(broker) == b""


@statement("3.1.1", "MQTT-3.3.1-12")
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_a_message_without_retain_changes_nothing_stored(broker: Broker, qos: int) -> None:
    client = joined(broker)
    client.publish("a", b"passing", qos)
    assert retained(broker) == b""
    client.publish("a", b"kept", retain=True)
    client.publish("a", b"passing", qos)
    client.publish("a", b"", qos)
    assert retained(broker) == wire("31 07 0001 61 6b657074")


# --- topic names


@statement("3.1.1", "MQTT-3.3.2-1")
@pytest.mark.parametrize("data", ["30 00", "30 01 00", "30 02 0002", "30 03 0002 61"])
def test_a_publish_without_a_whole_topic_closes_the_connection(broker: Broker, data: str) -> None:
    assert refused(joined(broker), data)


@statement("3.1.1", "MQTT-3.3.2-2", "MQTT-4.7.1-1")
@pytest.mark.parametrize("topic", ["+", "#", "a/+", "a/#", "a+", "#a", "+/a", "a/+/b", "a/#/b"])
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_wildcards_in_a_topic_close_the_connection(broker: Broker, topic: str, qos: int) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("#")
    packet_id = b"\0\1" if qos else b""
    assert refused(joined(broker), packet(0x31 | qos << 1, field(topic), packet_id, b"x"))
    assert watcher.hear() == b"" and len(broker.retained) == 0


@statement("3.1.1", "MQTT-3.3.2-3")
def test_the_topic_that_is_sent_is_the_one_that_was_published(broker: Broker) -> None:
    filters = ["#", "+", "a/#", "a/+", "a/b", "/+"]
    readers = {name: joined(broker, name) for name in filters}
    for name, reader in readers.items():
        reader.subscribe(name)
    client = joined(broker)
    for topic in ("a", "a/b", "a/b/c", "/a", "/"):
        client.publish(topic)
    heard = {name: [m.topic for m in reader.messages()] for name, reader in readers.items()}
    assert heard == {
        "#": ["a", "a/b", "a/b/c", "/a", "/"],
        "+": ["a"],
        "a/#": ["a", "a/b", "a/b/c"],
        "a/+": ["a/b"],
        "a/b": ["a/b"],
        "/+": ["/a", "/"],
    }


# --- answers


@statement("3.1.1", "MQTT-3.3.4-1")
@pytest.mark.parametrize("flags", [0, 1], ids=["", "retain"])
@pytest.mark.parametrize("subscribed", [True, False])
def test_the_answer_is_that_of_the_qos(broker: Broker, flags: int, subscribed: bool) -> None:
    if subscribed:
        joined(broker, "subscriber").subscribe("a", 2)
    client = joined(broker)
    assert client.say(bytes((0x30 | flags,)) + wire("04 0001 61 78")) == b""
    assert client.say(bytes((0x32 | flags,)) + wire("06 0001 61 0102 78")) == wire("40 02 0102")
    assert client.say(bytes((0x34 | flags,)) + wire("06 0001 61 0102 78")) == wire("50 02 0102")


@statement("3.1.1", "MQTT-3.3.5-1")
@pytest.mark.parametrize(
    "filters",
    [
        {"a/#": 0, "a/b": 2, "+/b": 1},
        {"a/#": 2, "a/b": 0, "+/b": 1},
        {"a/#": 1, "a/b": 1, "+/b": 2},
    ],
)
def test_overlapping_subscriptions_give_the_highest_qos(
    broker: Broker, filters: dict[str, int]
) -> None:
    subscriber, client = joined(broker, "subscriber"), joined(broker)
    for topic_filter, qos in filters.items():
        subscriber.subscribe(topic_filter, qos)
    for qos in (0, 1, 2):
        client.publish("a/b", b"x", qos)
        assert max(message.qos for message in subscriber.drain()) == qos


@statement("3.1.1", "MQTT-3.3.5-2")
@pytest.mark.parametrize("retain", [0, 1])
def test_what_is_not_authorized_is_acknowledged_and_goes_nowhere(
    broker: Broker, access: FakeAccess, retain: int
) -> None:
    access.deny("user", Action.PUBLISH, "a")
    watcher = joined(broker, "watcher", user="other")
    watcher.subscribe("#", 2)
    client = joined(broker)
    assert client.say(bytes((0x30 | retain,)) + wire("04 0001 61 78")) == b""
    assert client.say(bytes((0x32 | retain,)) + wire("06 0001 61 0001 78")) == wire("40 02 0001")
    assert client.say(bytes((0x34 | retain,)) + wire("06 0001 61 0002 78")) == wire("50 02 0002")
    assert client.say("62 02 0002") == wire("70 02 0002")
    assert not client.closed
    assert watcher.hear() == b"" and retained(broker) == b""


# --- QoS 0


@statement("3.1.1", "MQTT-4.3.1-1")
def test_qos_0_is_sent_once_and_not_again(broker: Broker) -> None:
    client = joined(broker, "c", clean=False)
    client.subscribe("a", 0)
    joined(broker, "other").publish("a", b"x", 0)
    assert client.hear() == wire("30 04 0001 61 78")
    client.lose()
    assert Client(broker).log_in(connect("c", flags=0)) == SESSION_PRESENT


# --- QoS 1


@statement("3.1.1", "MQTT-4.3.2-1")
def test_qos_1_is_unacknowledged_until_puback(broker: Broker) -> None:
    client, sender = joined(broker, "c", clean=False), joined(broker, "sender")
    client.subscribe("a", 1)
    for payload in (b"1", b"2", b"3"):
        sender.publish("a", payload, 1)
    assert client.hear() == wire(
        "32 06 0001 61 0001 31  32 06 0001 61 0002 32  32 06 0001 61 0003 33"
    )
    assert client.say("40 02 0002") == b""
    client.lose()
    client = Client(broker)
    assert client.log_in(connect("c", flags=0)) == SESSION_PRESENT + wire(
        "3a 06 0001 61 0001 31  3a 06 0001 61 0003 33"
    )
    assert client.say("40 02 0001", "40 02 0003") == b""
    client.lose()
    assert Client(broker).log_in(connect("c", flags=0)) == SESSION_PRESENT


@statement("3.1.1", "MQTT-4.3.2-2", "MQTT-3.3.1-3")
@pytest.mark.parametrize("again", ["32", "3a"], ids=["new", "DUP"])
def test_after_puback_the_same_identifier_is_a_new_message(broker: Broker, again: str) -> None:
    watcher, client = joined(broker, "watcher"), joined(broker)
    watcher.subscribe("a", 1)
    assert client.say("32 06 0001 61 0009 78") == wire("40 02 0009")
    assert watcher.hear() == wire("32 06 0001 61 0001 78")
    assert client.say(f"{again} 06 0001 61 0009 78") == wire("40 02 0009")
    assert watcher.hear() == wire("32 06 0001 61 0002 78")


@statement("3.1.1", "MQTT-4.3.2-2")
@pytest.mark.parametrize("clean", [True, False])
def test_dup_on_what_was_never_seen_is_a_message(broker: Broker, clean: bool) -> None:
    watcher, client = joined(broker, "watcher"), joined(broker, clean=clean)
    watcher.subscribe("a", 1)
    assert client.say("3a 06 0001 61 0009 78") == wire("40 02 0009")
    assert watcher.hear() == wire("32 06 0001 61 0001 78")


# --- QoS 2


@statement("3.1.1", "MQTT-4.3.3-1")
def test_qos_2_to_a_client_step_by_step(broker: Broker) -> None:
    client, sender = joined(broker, "c", clean=False), joined(broker, "sender")
    client.subscribe("a", 2)
    sender.publish("a", b"x", 2)
    assert client.hear() == wire("34 06 0001 61 0001 78")

    def come_back() -> bytes:
        nonlocal client
        client.lose()
        client = Client(broker)
        heard = client.log_in(connect("c", flags=0))
        assert heard.startswith(SESSION_PRESENT)
        return heard[4:]

    assert come_back() == wire("3c 06 0001 61 0001 78"), "PUBLISH again before PUBREC"
    assert client.say("50 02 0001") == wire("62 02 0001")
    assert come_back() == wire("62 02 0001"), "PUBREL, and not PUBLISH, after PUBREC"
    assert client.say("50 02 0001") == wire("62 02 0001")
    assert come_back() == wire("62 02 0001")
    assert client.say("70 02 0001") == b""
    assert come_back() == b"", "nothing after PUBCOMP"


@statement("3.1.1", "MQTT-4.3.3-1", "MQTT-2.3.1-6")
def test_each_pubrec_has_its_pubrel(broker: Broker) -> None:
    client = owed(joined(broker), 3)
    for packet_id in ("0002", "0001", "0003", "0001"):
        assert client.say(f"50 02 {packet_id}") == wire(f"62 02 {packet_id}")


@statement("3.1.1", "MQTT-4.3.3-2")
@pytest.mark.parametrize("reconnects", [False, True])
def test_qos_2_from_a_client_step_by_step(broker: Broker, reconnects: bool) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("a", 2)
    client = joined(broker, "c", clean=False)
    told: list[bytes] = []

    def say(*packets: str) -> bytes:
        nonlocal client
        if reconnects:
            client.lose()
            client = Client(broker)
            assert client.log_in(connect("c", flags=0)) == SESSION_PRESENT
        heard = client.say(*packets)
        told.extend(message.payload for message in watcher.drain())
        return heard

    assert say("34 06 0001 61 0009 31") == wire("50 02 0009")
    for again in ("3c 06 0001 61 0009 31", "34 06 0001 61 0009 31"):
        assert say(again) == wire("50 02 0009"), "acknowledged again"
    assert say("62 02 0009") == wire("70 02 0009")
    assert told == [b"1"]
    assert say("62 02 0009") == wire("70 02 0009"), "PUBCOMP was lost"
    assert told == [b"1"]
    assert say("3c 06 0001 61 0009 32") == wire("50 02 0009"), "the identifier is free again"
    assert say("62 02 0009") == wire("70 02 0009")
    assert told == [b"1", b"2"]


@statement("3.1.1", "MQTT-4.3.3-2")
def test_identifiers_of_both_directions_are_apart(broker: Broker) -> None:
    client = joined(broker)
    client.subscribe("a", 2)
    # Its own message comes back with the identifier 1, which is in use the other way as well.
    assert client.say("34 06 0001 61 0001 78") == wire("50 02 0001")
    heard = client.say("62 02 0001")
    assert len(heard) == 12
    assert wire("70 02 0001") in heard and wire("34 06 0001 61 0001 78") in heard
    assert client.say("34 06 0001 61 0001 79", "50 02 0001") == wire("50 02 0001 62 02 0001")
    heard = client.say("70 02 0001", "62 02 0001")
    assert len(heard) == 12
    assert wire("70 02 0001") in heard and wire("34 06 0001 61 0002 79") in heard
