"""MQTT 3.1.1, chapters 3.8 to 3.11 and 4.7: SUBSCRIBE, UNSUBSCRIBE, topic names and filters."""

from __future__ import annotations

import pytest
from broker.conftest import FakeAccess
from client_v311 import Client, field, joined, packet, refused, wire

from appliance.broker.broker import Broker
from appliance.broker.limits import Limits
from appliance.broker.message import Message
from appliance.broker.values import Action

statement = pytest.mark.statement


def subscribe(*filters: tuple[str, int], packet_id: int = 1) -> bytes:
    parts = [field(name) + bytes((qos,)) for name, qos in filters]
    return packet(0x82, packet_id.to_bytes(2, "big"), *parts)


def unsubscribe(*filters: str, packet_id: int = 1) -> bytes:
    return packet(0xA2, packet_id.to_bytes(2, "big"), *map(field, filters))


# --- SUBSCRIBE


@statement("3.1.1", "MQTT-3.8.3-3", "MQTT-4.8.0-1")
@pytest.mark.parametrize("data", ["82 02 0001", "82 01 00", "82 00", "82 04 0001 0001"])
def test_subscribe_without_a_filter_closes_the_connection(broker: Broker, data: str) -> None:
    assert refused(joined(broker), data)


@statement("3.1.1", "MQTT-3.8.3-3")
@pytest.mark.parametrize("data", ["82 05 0001 0001 61", "82 09 0001 0001 61 00 0001 62"])
def test_a_filter_without_its_qos_closes_the_connection(broker: Broker, data: str) -> None:
    assert refused(joined(broker), data)
    assert broker.subscription_count == 0


@statement("3.1.1", "MQTT-3-8.3-4")
def test_what_is_no_requested_qos_closes_the_connection(broker: Broker) -> None:
    for byte in range(256):
        client = joined(broker)
        if byte < 3:
            assert client.say(subscribe(("a", byte))) == wire(f"90 03 0001 {byte:02x}")
            client.lose()
        else:
            assert refused(client, subscribe(("a", byte))), f"{byte:08b}"
            assert refused(joined(broker), subscribe(("a", 0), ("b", byte))), f"{byte:08b}"
        assert broker.subscription_count == 0


@statement("3.1.1", "MQTT-3.8.4-1", "MQTT-3.8.4-2", "MQTT-3.8.4-5", "MQTT-3.9.3-2")
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_subscribe_is_answered_with_the_qos_that_was_granted(broker: Broker, qos: int) -> None:
    client = joined(broker)
    assert client.say(subscribe(("a/#", qos), packet_id=0x0A0B)) == wire(f"90 03 0a0b {qos:02x}")
    joined(broker, "publisher").publish("a", b"", 2)
    (message,) = client.drain()
    assert message.qos == qos


@statement("3.1.1", "MQTT-3.8.4-4", "MQTT-3.8.4-5", "MQTT-3.9.3-1")
def test_several_filters_have_one_suback_in_their_order(broker: Broker, access: FakeAccess) -> None:
    access.deny("user", Action.SUBSCRIBE, "secret/#")
    client = joined(broker)
    filters = [("a", 2), ("secret/x", 1), ("b", 0), ("c", 1), ("a", 1)]
    assert client.say(subscribe(*filters)) == wire("90 07 0001 02 80 00 01 01")
    publisher = joined(broker, "publisher")
    for topic in ("a", "secret/x", "b", "c"):
        publisher.publish(topic, b"", 2)
    assert [(message.topic, message.qos) for message in client.drain()] == [
        ("a", 1),
        ("b", 0),
        ("c", 1),
    ]


@statement("3.1.1", "MQTT-3.8.4-4", "MQTT-3.3.1-6")
def test_several_filters_bring_retained_messages_each(broker: Broker) -> None:
    publisher = joined(broker, "publisher")
    publisher.publish("a/b", b"x", retain=True)
    client = joined(broker)
    client.send(subscribe(("a/+", 0), ("a/b", 0), ("c", 0)))
    assert client.hear() == wire("90 05 0001 00 00 00") + 2 * wire("31 06 0003 612f62 78")


@statement("3.1.1", "MQTT-3.9.3-2", "MQTT-3.8.4-5")
@pytest.mark.parametrize("limits", [Limits(subscriptions=1)])
@pytest.mark.parametrize("name", ["denied", "second"])
def test_every_failure_is_0x80(broker: Broker, access: FakeAccess, name: str) -> None:
    access.deny("user", Action.SUBSCRIBE, "denied")
    client = joined(broker)
    assert client.say(subscribe(("a", 1))) == wire("90 03 0001 01")
    assert client.say(subscribe((name, 1), packet_id=2)) == wire("90 03 0002 80")
    assert broker.subscription_count == 1 and not client.closed


@statement("3.1.1", "MQTT-3.8.4-3")
def test_a_subscription_made_again_replaces_the_first(broker: Broker) -> None:
    client, publisher = joined(broker), joined(broker, "publisher")
    for qos in (2, 0, 1):
        client.subscribe("a/+", qos)
        publisher.publish("a/b", b"", 2)
        assert [message.qos for message in client.drain()] == [qos]
    client.unsubscribe("a/+")
    publisher.publish("a/b", b"", 2)
    assert client.hear() == b""


@statement("3.1.1", "MQTT-3.8.4-3", "MQTT-3.3.1-6", "MQTT-3.3.1-8")
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_retained_messages_come_again_with_the_subscription(broker: Broker, qos: int) -> None:
    joined(broker, "publisher").publish("a", b"x", qos, retain=True)
    client = joined(broker)
    for _ in range(3):
        client.subscribe("a", 2)
        (message,) = client.drain()
        assert (message.payload, message.qos, message.retain) == (b"x", qos, True)


@statement("3.1.1", "MQTT-3.8.4-3")
def test_subscribing_again_does_not_interrupt_the_flow(broker: Broker) -> None:
    client, publisher = joined(broker), joined(broker, "publisher")
    client.subscribe("a", 1)
    for number in range(100):
        publisher.publish("a", b"%d" % number, 1)  # more than may be in flight: some wait
        if number in (10, 50):
            client.send(subscribe(("a", 1)))
    received = []
    while packets := client.received():
        received += [packet.payload for packet in packets if hasattr(packet, "payload")]
        client.acknowledge(*packets)
    assert received == [b"%d" % number for number in range(100)]


@statement("3.1.1", "MQTT-3.8.4-6")
@pytest.mark.parametrize("granted", [0, 1, 2])
@pytest.mark.parametrize("sent", [0, 1, 2])
def test_a_message_comes_with_the_lower_qos(broker: Broker, sent: int, granted: int) -> None:
    client, publisher = joined(broker), joined(broker, "publisher")
    publisher.publish("a/kept", b"x", sent, retain=True)
    client.subscribe("a/+", granted)
    publisher.publish("a/live", b"x", sent)
    received = [(message.topic, message.qos) for message in client.drain()]
    assert received == [("a/kept", min(sent, granted)), ("a/live", min(sent, granted))]


# --- UNSUBSCRIBE


@statement("3.1.1", "MQTT-3.10.3-2", "MQTT-4.8.0-1")
@pytest.mark.parametrize("data", ["a2 02 0001", "a2 01 00", "a2 00"])
def test_unsubscribe_without_a_filter_closes_the_connection(broker: Broker, data: str) -> None:
    assert refused(joined(broker), data)


@statement("3.1.1", "MQTT-3.10.3-1", "MQTT-3.10.4-6", "MQTT-3.10.4-4")
def test_several_filters_have_one_unsuback(broker: Broker) -> None:
    client, publisher = joined(broker), joined(broker, "publisher")
    client.say(subscribe(("a", 0), ("b", 0), ("c", 0)))
    assert client.say(unsubscribe("a", "never", "c", packet_id=0x0A0B)) == wire("b0 02 0a0b")
    for topic in ("a", "b", "c"):
        publisher.publish(topic, b"")
    assert client.hear() == wire("30 03 0001 62")


@statement("3.1.1", "MQTT-3.10.3-1")
@pytest.mark.parametrize("data", ["a2 04 0001 0002", "a2 06 0001 0001 61 00"])
def test_filters_that_do_not_fit_the_packet_close_the_connection(broker: Broker, data: str) -> None:
    assert refused(joined(broker), data)


@statement("3.1.1", "MQTT-3.10.4-1")
@pytest.mark.parametrize(
    "other", ["a/+", "+/b", "#", "a/#", "A/b", "a/b/", "/a/b", "a/b ", "a", "a/bb"]
)
def test_only_the_very_same_filter_is_deleted(broker: Broker, other: str) -> None:
    client, publisher = joined(broker), joined(broker, "publisher")
    client.subscribe("a/b")
    assert client.say(unsubscribe(other)) == wire("b0 02 0001")
    publisher.publish("a/b", b"x")
    assert client.hear() == wire("30 06 0003 612f62 78")


@statement("3.1.1", "MQTT-3.10.4-1")
@pytest.mark.parametrize("name", ["a/+", "+/b", "#", "a/#", "a/b"])
def test_the_same_filter_is_deleted_wildcards_and_all(broker: Broker, name: str) -> None:
    client, publisher = joined(broker), joined(broker, "publisher")
    client.subscribe(name)
    client.say(unsubscribe(name))
    publisher.publish("a/b", b"x")
    assert client.hear() == b""


@statement("3.1.1", "MQTT-3.10.4-2")
def test_nothing_new_is_added_for_a_deleted_subscription(broker: Broker) -> None:
    client, publisher = joined(broker, "c", clean=False), joined(broker, "publisher")
    client.subscribe("a", 1)
    client.say(unsubscribe("a"))
    publisher.publish("a", b"x", 1)
    client.lose()
    publisher.publish("a", b"y", 1)
    assert joined(broker, "c", clean=False).hear() == b""


@statement("3.1.1", "MQTT-3.10.4-3")
def test_what_was_begun_to_be_delivered_is_completed(broker: Broker) -> None:
    client, publisher = joined(broker, "c", clean=False), joined(broker, "publisher")
    client.subscribe("a", 2)
    publisher.publish("a", b"x", 1)
    publisher.publish("a", b"y", 2)
    assert client.hear() == wire("32 06 0001 61 0001 78 34 06 0001 61 0002 79")
    client.say(unsubscribe("a"))
    client.lose()
    client = joined(broker, "c", clean=False)
    assert client.hear() == wire("3a 06 0001 61 0001 78 3c 06 0001 61 0002 79")
    assert client.say("40 02 0001", "50 02 0002") == wire("62 02 0002")
    assert client.say("70 02 0002") == b""


@statement("3.1.1", "MQTT-3.10.4-5")
@pytest.mark.parametrize("name", ["a", "a/b/#", "+"])
def test_unsuback_comes_when_nothing_is_deleted(broker: Broker, name: str) -> None:
    assert joined(broker).say(unsubscribe(name, packet_id=7)) == wire("b0 02 0007")


# --- topic names and filters


def is_no_filter(broker: Broker, name: str) -> bool:
    """Whether SUBSCRIBE fails: with 0x80 or, as a protocol violation, with the connection."""
    client = joined(broker)
    heard = client.say(subscribe((name, 1)))
    assert broker.subscription_count == 0
    client.lose()
    return heard == wire("90 03 0001 80") or (heard == b"" and client.closed)


@pytest.mark.parametrize(
    "name",
    [
        *[
            pytest.param(name, marks=statement("3.1.1", "MQTT-4.7.1-2"))
            for name in ("a#", "#a", "##", "#/", "a/#/b", "#/a", "a/b#", "a/#/", "+#")
        ],
        *[
            pytest.param(name, marks=statement("3.1.1", "MQTT-4.7.1-3"))
            for name in ("a+", "+a", "++", "a/b+", "a/+b/c", "+a/b", "a/+#", "sport+")
        ],
        pytest.param("", marks=statement("3.1.1", "MQTT-4.7.3-1")),
    ],
)
def test_what_is_no_filter(broker: Broker, name: str) -> None:
    assert is_no_filter(broker, name)


#: From sections 4.7.1.2, 4.7.1.3 and 4.7.3: a filter, topics that it matches, topics it does not.
MATCHES = [
    (
        "MQTT-4.7.1-2",
        "sport/tennis/player1/#",
        [
            "sport/tennis/player1",
            "sport/tennis/player1/ranking",
            "sport/tennis/player1/score/wimbledon",
        ],
        ["sport/tennis", "sport/tennis/player2", "sport/tennis/player10"],
    ),
    ("MQTT-4.7.1-2", "sport/#", ["sport", "sport/", "sport/a/b"], ["sports", "/sport"]),
    ("MQTT-4.7.1-2", "#", ["a", "/", "a/b/c", "/a"], []),
    ("MQTT-4.7.1-3", "sport/tennis/+", ["sport/tennis/player1"], ["sport/tennis/player1/ranking"]),
    ("MQTT-4.7.1-3", "sport/+", ["sport/", "sport/a"], ["sport", "sport/a/b"]),
    ("MQTT-4.7.1-3", "+", ["finance"], ["/finance", "finance/"]),
    ("MQTT-4.7.1-3", "+/+", ["/finance", "finance/", "/", "a/b"], ["finance", "/finance/"]),
    ("MQTT-4.7.1-3", "/+", ["/finance", "/"], ["finance", "finance/"]),
    ("MQTT-4.7.1-3", "+/tennis/#", ["sport/tennis", "/tennis/x"], ["sport/tennisx", "tennis"]),
    ("MQTT-4.7.1-3", "sport/+/player1", ["sport/tennis/player1"], ["sport/player1"]),
    ("MQTT-4.7.3-1", "/", ["/"], ["a", "//"]),
    ("MQTT-4.7.3-1", "a", ["a"], ["b", "aa", "a/"]),
]


@pytest.mark.parametrize(
    ("name", "matching", "other"),
    [
        pytest.param(
            *row, marks=statement("3.1.1", number, "MQTT-3.3.2-3", "MQTT-4.7.1-1"), id=row[0]
        )
        for number, *row in MATCHES
    ],
)
def test_which_topics_a_filter_matches(
    broker: Broker, name: str, matching: list[str], other: list[str]
) -> None:
    publisher, live = joined(broker, "publisher"), joined(broker, "live")
    live.subscribe(name)
    for topic in (*matching, *other):
        publisher.publish(topic, b"x", retain=True)
    assert [message.topic for message in live.messages()] == matching
    late = joined(broker, "late")
    late.subscribe(name)
    assert sorted(message.topic for message in late.messages()) == sorted(matching)


class Outside:
    """The end of a session inside the appliance, which may publish what no client may."""

    writable = True

    def publish(self, *_: object) -> None: ...

    def mirror(self, *_: object) -> bool:
        return False

    def pubrel(self, packet_id: int) -> None: ...

    def close(self, *_: object) -> None: ...


@statement("3.1.1", "MQTT-4.7.2-1")
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("#", []),
        ("+/monitor/Clients", []),
        ("+/#", []),
        ("+/+/+", []),
        ("$SYS/#", ["$SYS", "$SYS/monitor/Clients"]),
        ("$SYS/monitor/+", ["$SYS/monitor/Clients"]),
        ("$SYS/monitor/Clients", ["$SYS/monitor/Clients"]),
    ],
)
def test_wildcards_first_do_not_match_dollar_topics(
    broker: Broker, name: str, expected: list[str]
) -> None:
    live = joined(broker, "live")
    live.subscribe(name)
    inside = broker.attach("inside", Outside())
    for topic in ("$SYS", "$SYS/monitor/Clients"):
        broker.publish(Message(topic, b"x", retain=True), inside)
    broker.flush()
    assert [message.topic for message in live.messages()] == expected
    late = joined(broker, "late")
    late.subscribe(name)
    assert sorted(message.topic for message in late.messages()) == expected


@statement("3.1.1", "MQTT-4.7.3-1")
@pytest.mark.parametrize("data", ["30 03 0000 78", "32 05 0000 0001 78", "34 05 0000 0001 78"])
def test_an_empty_topic_closes_the_connection(broker: Broker, data: str) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("#")
    assert refused(joined(broker), data)
    assert watcher.hear() == b""


@statement("3.1.1", "MQTT-4.7.3-3")
@pytest.mark.parametrize("character", ["a", "é", "€"])
def test_topics_and_filters_may_be_65535_bytes_long(broker: Broker, character: str) -> None:
    """More bytes than that, the two bytes of a length cannot say."""
    size = len(character.encode())
    topic = character * (65535 // size) + "b" * (65535 % size)
    client = joined(broker)
    assert client.say(subscribe((topic, 0))) == wire("90 03 0001 00")
    sent = packet(0x30, field(topic), b"x")
    assert client.say(sent) == sent
    assert client.say(unsubscribe(topic)) == wire("b0 02 0001")
    assert client.say(sent) == b""


@statement("3.1.1", "MQTT-4.7.3-4")
def test_topics_are_compared_as_they_are(broker: Broker) -> None:
    names = [
        "a",
        "A",
        "a ",
        " a",
        "a/",
        "/a",
        "a//b",
        "a/b",
        "a/./b",
        "a/../b",
        "%61",
        "\u00e9",  # é in one character
        "e\u0301",  # and in two
        "\u212b",  # Ångström, which is normalized to the next
        "\u00c5",
        "\uff41",  # a, in full width
        "a\u200b",  # and with nothing to see behind it
        "a\ufeff",
        "\U000e0080",  # no character that Unicode knows
    ]
    readers: dict[str, Client] = {}
    for number, name in enumerate(names):
        readers[name] = joined(broker, f"reader {number}")
        readers[name].subscribe(name)
    publisher = joined(broker, "publisher")
    for name in names:
        publisher.publish(name, name.encode())
    for name, reader in readers.items():
        assert reader.hear() == packet(0x30, field(name), name.encode())
