"""MQTT 5.0, section 4.7: topic names and topic filters."""

from __future__ import annotations

import pytest
from client_v5 import Client, disconnect, field, joined, packet, publish, wire

from appliance.broker.broker import Broker
from appliance.broker.message import Message

statement = pytest.mark.statement


def subscribe(topic_filter: bytes | str) -> bytes:
    return packet(0x82, b"\0\1\0", field(topic_filter), b"\0")


def is_refused(client: Client, topic_filter: bytes | str) -> bool:
    """Whether the filter is not subscribed to: the SUBACK says so, or the connection is closed.

    The standard does not say which of them a filter gets that is none.
    """
    heard = client.say(subscribe(topic_filter))
    if client.closed:
        return heard in (b"", *map(disconnect, (0x81, 0x82, 0x8F)))
    return heard[:5] == wire("90 04 0001 00") and heard[5] >= 0x80


MATCHES = {
    "sport/tennis/player1/#": (
        ["sport/tennis/player1", "sport/tennis/player1/ranking", "sport/tennis/player1/a/b"],
        ["sport/tennis", "sport/tennis/player2", "sport/tennis/player12", "Sport/tennis/player1"],
    ),
    "sport/#": (["sport", "sport/", "sport/a"], ["sports", "a/sport", "/sport"]),
    "#": (["a", "/", "/a", "a/", "a/b/c", "//", " "], ["$SYS", "$SYS/b"]),
    "+": (["a", " ", "a b"], ["/", "/a", "a/", "a/b", "$SYS"]),
    "+/tennis/#": (
        ["a/tennis", "/tennis", "a/tennis/b/c"],
        ["tennis", "a/b/tennis", "$SYS/tennis"],
    ),
    "sport/tennis/+": (["sport/tennis/a", "sport/tennis/"], ["sport/tennis", "sport/tennis/a/b"]),
    "sport/+": (["sport/", "sport/a"], ["sport", "sport/a/b"]),
    "sport/+/player1": (["sport/a/player1", "sport//player1"], ["sport/player1", "sport/a/b"]),
    "+/+": (["/finance", "a/b", "/", "a/"], ["finance", "a/b/c", "$SYS/b"]),
    "/+": (["/finance", "/"], ["finance", "/a/b", "a/b"]),
    "+/+/+": (["//", "a//b"], ["/", "a/b"]),
    "/": (["/"], ["//", "a/"]),
    "/#": (["/", "/a", "/a/b", "//"], ["a", "a/b"]),
    "a/+/#": (["a/b", "a/", "a/b/c"], ["a", "b/c"]),
    "ACCOUNTS": (["ACCOUNTS"], ["Accounts", "accounts"]),
    "Accounts payable": (["Accounts payable"], ["Accounts", "Accounts  payable"]),
    "finance": (["finance"], ["/finance", "finance/"]),
}


@statement("5.0", "MQTT-4.7.1-1", "MQTT-4.7.1-2", "MQTT-4.7.2-1", "MQTT-4.7.3-4", "MQTT-3.3.2-3")
@pytest.mark.parametrize("retain", [False, True], ids=["live", "retained"])
@pytest.mark.parametrize("topic_filter", MATCHES)
def test_what_a_filter_matches(broker: Broker, topic_filter: str, retain: bool) -> None:
    yes, no = MATCHES[topic_filter]
    inside = broker.attach("inside", Client(broker).client)  # who may publish under $SYS
    client = joined(broker)
    if not retain:
        assert client.subscribe(topic_filter) == 0
    for topic in (*yes, *no):
        broker.publish(Message(topic, b"x", 0, retain), inside)
    broker.flush()
    if retain:
        assert client.subscribe(topic_filter) == 0
    assert sorted(message.topic for message in client.messages()) == sorted(yes)
    broker.detach(inside)


@statement("5.0", "MQTT-4.7.1-1")
@pytest.mark.parametrize(
    "bad", ["sport/tennis#", "sport/tennis/#/ranking", "#/", "##", "a/#b", "#a"]
)
def test_where_a_multi_level_wildcard_may_not_be(broker: Broker, bad: str) -> None:
    client = joined(broker)
    assert is_refused(client, bad)
    if not client.closed:
        assert client.session.subscriptions == {}


@statement("5.0", "MQTT-4.7.1-2")
@pytest.mark.parametrize("bad", ["sport+", "+sport", "sport/+a", "sport/a+/b", "++", "a/++", "+#"])
def test_where_a_single_level_wildcard_may_not_be(broker: Broker, bad: str) -> None:
    client = joined(broker)
    assert is_refused(client, bad)
    if not client.closed:
        assert client.session.subscriptions == {}


@statement("5.0", "MQTT-4.7.3-1")
def test_a_filter_has_at_least_one_character(broker: Broker) -> None:
    assert is_refused(joined(broker), "")


@statement("5.0", "MQTT-4.7.2-1")
@pytest.mark.parametrize("topic", ["$SYS/broker", "$SYS", "$a/b", "$", "$share/g/a"])
def test_clients_do_not_exchange_messages_under_a_dollar(broker: Broker, topic: str) -> None:
    """Section 4.7.2: the server should prevent it."""
    watcher = joined(broker, "watcher")
    for topic_filter in ("#", "+", "+/#", "+/+", "$SYS/#", "$a/#", "$"):
        watcher.subscribe(topic_filter)
    client = joined(broker)
    assert client.say(publish(topic, b"x", 1, retain=True))[:2] == wire("40 03")
    client.say(publish(topic, b"x", retain=True))
    assert watcher.hear() == b""
    later = joined(broker, "later")
    if not topic.startswith("$share"):
        later.subscribe(topic)
    assert later.hear() == b""


@statement("5.0", "MQTT-4.7.3-3")
@pytest.mark.parametrize("character", ["a", "é"])
def test_topics_and_filters_may_be_as_long_as_a_string(broker: Broker, character: str) -> None:
    size = len(character.encode())
    topic = character * (65535 // size) + "a" * (65535 % size)
    assert len(topic.encode()) == 65535
    client = joined(broker)
    assert client.say(subscribe(topic)) == wire("90 04 0001 00 00")
    sent = publish(topic, b"x")
    assert joined(broker, "sender").say(sent) == b""
    assert client.hear() == sent


@statement("5.0", "MQTT-4.7.3-4")
def test_nothing_is_normalized(broker: Broker) -> None:
    alike = ["é", "e\u0301", "É", "ﬁ", "fi", "\ufeffa", "a", " a", "a ", "a//b", "a/b", "a/./b"]
    alike += ["Å", "\u212b", "A\u030a", "\u200ba", "a\u00ad", "\ue000", "\U000e0001"]
    clients = [joined(broker, f"of {n}") for n in range(len(alike))]
    for client, topic in zip(clients, alike, strict=True):
        assert client.subscribe(topic) == 0
    sender = joined(broker, "sender")
    for topic in alike:
        sender.publish(topic, b"x")
    for client, topic in zip(clients, alike, strict=True):
        assert client.hear() == publish(topic, b"x")
