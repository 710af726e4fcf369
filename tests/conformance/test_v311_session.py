"""MQTT 3.1.1, chapters 4.1 and 4.4 to 4.8: state, sending again, order, errors."""

from __future__ import annotations

import pytest
from broker.conftest import FakeStore
from client_v311 import (
    ACCEPTED,
    SESSION_PRESENT,
    Client,
    connect,
    joined,
    owed,
    packet,
    refused,
    wire,
)

from appliance.broker.broker import Broker
from appliance.broker.limits import Limits
from appliance.mqtt.packets import Puback, Publish, Will

statement = pytest.mark.statement

DAY = 24 * 3600


def back(broker: Broker, client: Client) -> Client:
    """The same client on a new connection, which it has not heard anything of yet."""
    client.lose()
    again = Client(broker)
    again.say(connect("c", flags=0))
    again.let_in()
    return again


# --- the state of a session


@statement("3.1.1", "MQTT-4.1.0-1", "MQTT-4.4.0-1")
@pytest.mark.parametrize("hours", [0, 1, 24])
def test_all_state_is_there_when_the_client_comes_back(broker: Broker, hours: int) -> None:
    watcher, publisher = joined(broker, "watcher"), joined(broker, "publisher")
    watcher.subscribe("from/c", 2)
    client = joined(broker, "c", clean=False)
    client.subscribe("a", 2)
    publisher.publish("a", b"1", 1)  # sent, and not acknowledged
    publisher.publish("a", b"2", 2)
    publisher.publish("a", b"3", 2)
    client.say("50 02 0003")  # PUBREL was sent, and not acknowledged
    assert client.say("34 0b 0006 66726f6d2f63 0009 34") == wire("50 02 0009")  # not released
    client.lose()
    publisher.publish("a", b"5", 1)  # not sent
    broker.tick(broker.now + hours * 3600)
    client = Client(broker)
    heard = client.log_in(connect("c", flags=0))
    assert heard.startswith(SESSION_PRESENT)
    for expected in (
        "3a 06 0001 61 0001 31",
        "3c 06 0001 61 0002 32",
        "62 02 0003",
        "32 06 0001 61 0004 35",
    ):
        assert heard.count(wire(expected)) == 1, expected
    assert len(heard) == 4 + 3 * 8 + 4
    assert client.say("62 02 0009") == wire("70 02 0009")
    assert [message.payload for message in watcher.drain()] == [b"4"]
    publisher.publish("a", b"6", 0)
    assert client.hear() == wire("30 04 0001 61 36"), "it is still subscribed"


@statement("3.1.1", "MQTT-4.1.0-2", "MQTT-4.1.0-1")
@pytest.mark.parametrize("limits", [Limits(session_expiry=3600)])
@pytest.mark.parametrize("clean", [True, False])
def test_a_session_lasts_as_long_as_its_connection(broker: Broker, clean: bool) -> None:
    client = joined(broker, "c", clean=clean)
    client.subscribe("a", 1)
    joined(broker, "publisher").publish("a", b"x", 1)
    assert client.hear() == wire("32 06 0001 61 0001 78")
    for _ in range(3):
        broker.tick(broker.now + 30 * DAY)
    publisher = joined(broker, "later")
    publisher.publish("a", b"y", 1)
    assert client.hear() == wire("32 06 0001 61 0002 79"), "1 is still in use"
    assert client.say("c0 00") == wire("d0 00")


@statement("3.1.1", "MQTT-4.5.0-1")
@pytest.mark.parametrize("qos", [1, 2])
def test_a_message_reaches_all_sessions_that_match(broker: Broker, qos: int) -> None:
    filters = {"one": "a/b", "two": "a/+", "three": "#", "four": "b"}
    for name, topic_filter in filters.items():
        for state in ("there", "away"):
            client = joined(broker, f"{name} {state}", clean=False)
            client.subscribe(topic_filter, qos)
            if state == "away":
                client.lose()
    joined(broker, "publisher").publish("a/b", b"x", qos)
    for name in filters:
        for state in ("there", "away"):
            client = joined(broker, f"{name} {state}", clean=False)
            payloads = [message.payload for message in client.drain()]
            assert payloads == ([] if name == "four" else [b"x"]), (name, state)


# --- sending again


@statement("3.1.1", "MQTT-4.4.0-1", "MQTT-4.3.2-1", "MQTT-4.3.3-1")
def test_nothing_is_sent_again_on_the_same_connection(broker: Broker) -> None:
    """Section 4.4 asks for it after a reconnect, and only then."""
    client, publisher = joined(broker), joined(broker, "publisher")
    client.subscribe("a", 2)
    for qos in (1, 2, 2):
        publisher.publish("a", b"x", qos)
    client.hear()
    client.say("50 02 0003")
    for _ in range(100):
        broker.tick(broker.now + 3600)
    assert client.hear() == b""
    assert client.say("50 02 0002", "70 02 0003", "70 02 0002", "40 02 0001") == wire("62 02 0002")


@statement("3.1.1", "MQTT-4.4.0-1", "MQTT-3.3.1-1")
def test_what_is_lost_again_is_sent_again(broker: Broker) -> None:
    client, publisher = joined(broker, "c", clean=False), joined(broker, "publisher")
    client.subscribe("a", 2)
    publisher.publish("a", b"1", 1)
    publisher.publish("a", b"2", 2)
    for _ in range(5):
        client = back(broker, client)
        assert client.hear() == SESSION_PRESENT + wire(
            "3a 06 0001 61 0001 31 3c 06 0001 61 0002 32"
        )
    client.say("40 02 0001", "50 02 0002", "70 02 0002")
    assert back(broker, client).hear() == SESSION_PRESENT


# --- order


@statement("3.1.1", "MQTT-4.6.0-1", "MQTT-4.6.0-6")
def test_messages_are_sent_again_in_their_order(broker: Broker) -> None:
    client, publisher = joined(broker, "c", clean=False), joined(broker, "publisher")
    client.subscribe("#", 2)
    for number in range(12):
        publisher.publish("ab"[number % 2], b"%d" % number, 1 + number % 3 % 2)
    first = client.messages()
    assert [message.payload for message in first] == [b"%d" % number for number in range(12)]
    # Some are done, out of order; the rest keeps its own.
    for index in (7, 2, 4):
        message = first[index]
        kind = 0x40 if message.qos == 1 else 0x50
        assert message.packet_id is not None
        client.say(bytes((kind, 2)) + message.packet_id.to_bytes(2, "big"))
    for _ in range(2):
        client = back(broker, client)
        again = [packet for packet in client.received() if isinstance(packet, Publish)]
        left = [message for index, message in enumerate(first) if index not in (7, 2, 4)]
        assert [(m.packet_id, m.payload) for m in again] == [(m.packet_id, m.payload) for m in left]
        assert all(message.dup for message in again)


@statement("3.1.1", "MQTT-4.6.0-2", "MQTT-4.6.0-3", "MQTT-4.6.0-6")
def test_acknowledgements_come_in_the_order_of_the_messages(broker: Broker) -> None:
    client = joined(broker)
    ids = [7, 3, 65535, 1, 2]
    data = [
        packet(0x32 if number % 2 else 0x34, b"\0\1a", packet_id.to_bytes(2, "big"))
        for number, packet_id in enumerate(ids)
    ]
    assert client.say(*data) == wire("50 02 0007 40 02 0003 50 02 ffff 40 02 0001 50 02 0002")


@statement("3.1.1", "MQTT-4.6.0-4", "MQTT-4.6.0-6")
def test_pubrel_comes_in_the_order_of_pubrec(broker: Broker) -> None:
    client = owed(joined(broker), 4)
    assert client.say("50 02 0003", "50 02 0001", "50 02 0004", "50 02 0002") == wire(
        "62 02 0003 62 02 0001 62 02 0004 62 02 0002"
    )


@statement("3.1.1", "MQTT-4.6.0-5", "MQTT-4.6.0-6")
@pytest.mark.parametrize("sent", [0, 1, 2])
@pytest.mark.parametrize("topic", ["a", "b/c"])
def test_each_topic_and_qos_keeps_its_order(broker: Broker, topic: str, sent: int) -> None:
    """Through a full window, from two publishers, and to subscribers of each QoS."""
    subscribers = []
    for granted in (0, 1, 2):
        subscribers.append(joined(broker, f"subscriber {granted}"))
        subscribers[-1].subscribe("#", granted)
    publishers = [joined(broker, name) for name in ("one", "two")]
    for number in range(60):
        for publisher in publishers:
            name = publisher.session.client_id
            publisher.publish(topic, f"{name} {number}".encode(), sent)
    for granted, subscriber in enumerate(subscribers):
        messages = subscriber.drain()
        assert {message.qos for message in messages} == {min(sent, granted)}
        for name in ("one", "two"):
            numbers = [m.payload for m in messages if m.payload.startswith(name.encode())]
            assert numbers == [f"{name} {number}".encode() for number in range(60)]


@statement("3.1.1", "MQTT-4.6.0-6")
def test_order_is_kept_over_a_reconnect(broker: Broker) -> None:
    client, publisher = joined(broker, "c", clean=False), joined(broker, "publisher")
    client.subscribe("a", 1)
    for number in range(30):
        publisher.publish("a", b"%d" % number, 1)
    client.send(*[Puback(m.packet_id) for m in client.messages()[:10] if m.packet_id])
    client.hear()
    client.lose()
    for number in range(30, 60):
        publisher.publish("a", b"%d" % number, 1)
    client = joined(broker, "c", clean=False)
    publisher.publish("a", b"60", 1)
    payloads = [message.payload for message in client.drain()]
    assert payloads == [b"%d" % number for number in range(10, 61)]


@statement("3.1.1", "MQTT-4.6.0-6")
def test_qos_2_is_ordered_by_its_pubrel(broker: Broker) -> None:
    """What is released first is delivered first; section 4.6 has PUBREL in the order of PUBREC."""
    watcher, client = joined(broker, "watcher"), joined(broker)
    watcher.subscribe("a", 2)
    for number in range(1, 4):
        client.say(f"34 06 0001 61 000{number} 3{number}")
    assert watcher.hear() == b""
    assert client.say("62 02 0001", "62 02 0002", "62 02 0003") == wire(
        "70 02 0001 70 02 0002 70 02 0003"
    )
    assert [message.payload for message in watcher.drain()] == [b"1", b"2", b"3"]


# --- errors


@statement("3.1.1", "MQTT-4.8.0-1")
@pytest.mark.parametrize(
    "data",
    [
        "00 00",
        "f0 00",
        "20 02 00 00",
        "90 03 0001 00",
        "b0 02 0001",
        "d0 00",
        "40 00",
        "40 01 00",
        "40 02 0000",
        "40 03 0001 00",
        "50 03 0001 00",
        "62 03 0001 00",
        "70 03 0001 00",
        "32 03 0001 61",
        "32 04 0001 61 00",
        "c0 01 00",
        "e0 01 00",
        "30 ff ff ff ff 7f",
        "c0 80 80 80 80 00",
    ],
    ids=[
        "type 0",
        "type 15",
        "CONNACK",
        "SUBACK",
        "UNSUBACK",
        "PINGRESP",
        "PUBACK, empty",
        "PUBACK, half an id",
        "PUBACK, id 0",
        "PUBACK, too long",
        "PUBREC, too long",
        "PUBREL, too long",
        "PUBCOMP, too long",
        "PUBLISH, no id",
        "PUBLISH, half an id",
        "PINGREQ, too long",
        "DISCONNECT, too long",
        "PUBLISH, a length of five bytes",
        "PINGREQ, a length of five bytes",
    ],
)
def test_a_violation_closes_that_connection_and_no_other(broker: Broker, data: str) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("w")
    client = joined(broker, "c", will=Will("w", b"gone"))
    assert client.say("c0 00") == wire("d0 00")
    assert refused(client, data, "c0 00", "30 04 0001 77 78")
    assert watcher.hear() == wire("30 07 0001 77 676f6e65"), "the will, and nothing else"
    assert watcher.say("c0 00") == wire("d0 00")
    assert set(broker.sessions) == {"watcher"}


@statement("3.1.1", "MQTT-4.8.0-2")
@pytest.mark.parametrize(
    "data",
    ["32 06 0001 61 0001 78", "34 06 0001 61 0001 78", "82 06 0001 0001 62 00"],
    ids=["QoS 1", "QoS 2", "SUBSCRIBE"],
)
def test_what_cannot_be_kept_closes_the_connection(
    broker: Broker, store: FakeStore, data: str
) -> None:
    """The disk is full, say: there is no acknowledgement, and the client will send it again."""
    client = joined(broker, "c", clean=False)
    client.say("82 06 0001 0001 61 01")
    store.holding = True
    assert client.say(data) == b"" and not client.closed
    store.commit(kept=False)
    assert client.closed and client.hear() == b""
    assert Client(broker).log_in(connect("d")) == ACCEPTED


# --- DISCONNECT and PINGREQ


@statement("3.1.1", "MQTT-3.12.4-1")
def test_pingreq_is_answered(broker: Broker) -> None:
    client = joined(broker)
    assert client.say("c0 00") == wire("d0 00")
    assert client.say("c0 00 c0 00") == wire("d0 00 d0 00")


@statement("3.1.1", "MQTT-3.14.4-3", "MQTT-3.1.2-10")
@pytest.mark.parametrize("clean", [True, False])
def test_disconnect_discards_the_will(broker: Broker, clean: bool) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("w")
    client = joined(broker, "c", clean=clean, will=Will("w", b"gone", retain=True))
    assert refused(client, "e0 00")
    client.lose()
    broker.tick(broker.now + 30 * DAY)
    assert watcher.hear() == b"" and len(broker.retained) == 0


@statement("3.1.1", "MQTT-3.14.1-1")
@pytest.mark.parametrize("flags", range(1, 16))
def test_disconnect_with_reserved_bits_is_none(broker: Broker, flags: int) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("w")
    client = joined(broker, "c", will=Will("w", b"gone"))
    assert refused(client, bytes((0xE0 | flags, 0)))
    assert watcher.hear() == wire("30 07 0001 77 676f6e65"), "the will is not discarded"


@statement("3.1.1", "MQTT-3.14.4-2")
@pytest.mark.parametrize("together", [True, False])
def test_what_comes_behind_disconnect_has_no_effect(broker: Broker, together: bool) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("#", 2)
    client = joined(broker, "c", clean=False)
    behind = ["31 04 0001 61 78", "32 06 0001 61 0001 78", "82 06 0001 0001 61 00", "c0 00"]
    if together:
        assert refused(client, "e0 00", *behind)
    else:
        assert refused(client, "e0 00")
        assert client.say(*behind) == b""
    assert watcher.hear() == b""
    assert len(broker.retained) == 0 and broker.subscription_count == 1
