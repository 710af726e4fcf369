"""MQTT 5.0, sections 3.8 to 3.11: SUBSCRIBE, SUBACK, UNSUBSCRIBE, UNSUBACK."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from broker.conftest import FakeAccess, lasting
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
from appliance.broker.limits import Limits
from appliance.broker.values import Action
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Publish

P = Property
statement = pytest.mark.statement


def subscribe(*filters: tuple[str, int], packet_id: int = 1, props: bytes = b"\0") -> bytes:
    """SUBSCRIBE to these filters, each with its byte of options."""
    pairs = [field(name) + bytes((options,)) for name, options in filters]
    return packet(0x82, packet_id.to_bytes(2, "big"), props, *pairs)


def unsubscribe(*filters: str, packet_id: int = 1) -> bytes:
    return packet(0xA2, packet_id.to_bytes(2, "big"), b"\0", *map(field, filters))


def suback(*codes: int, packet_id: int = 1) -> bytes:
    return packet(0x90, packet_id.to_bytes(2, "big"), b"\0", bytes(codes))


def unsuback(*codes: int, packet_id: int = 1) -> bytes:
    return packet(0xB0, packet_id.to_bytes(2, "big"), b"\0", bytes(codes))


# --- 3.8 SUBSCRIBE


@statement("5.0", "MQTT-3.8.3-2", "MQTT-4.13.1-1")
@pytest.mark.parametrize("props", [b"\0", properties("0b 01")], ids=["plain", "with an identifier"])
def test_subscribe_needs_a_filter(broker: Broker, props: bytes) -> None:
    client = joined(broker)
    assert client.say(subscribe(props=props)) == disconnect(0x82) and client.closed


@statement("5.0", "MQTT-3.8.3-2", "MQTT-3.8.3-1", "MQTT-4.13.1-1")
@pytest.mark.parametrize(
    "data",
    [
        packet(0x82, b"\0\1\0", field("a")),
        packet(0x82, b"\0\1\0", b"\0\5a\0"),
        packet(0x82, b"\0\1\0", field("a") + b"\0", b"\0"),
        packet(0x82, b"\0\1"),
        packet(0x82, b"\0"),
        packet(0x82),
        packet(0x82, b"\0\1", properties("0b 01", "23 0001"), field("a") + b"\0"),
    ],
    ids=[
        "no options",
        "a filter longer than the packet",
        "a byte too many",
        "cut behind the identifier",
        "cut in the identifier",
        "empty",
        "a property of PUBLISH",
    ],
)
def test_a_subscribe_that_cannot_be_read_is_malformed(broker: Broker, data: bytes) -> None:
    client = joined(broker)
    assert client.say(data) == disconnect(0x81) and client.closed


@statement("5.0", "MQTT-4.13.1-1", "MQTT-3.8.4-7")
@pytest.mark.parametrize("options", [0x03, 0x30, 0x33])
def test_a_qos_or_retain_handling_of_3_breaks_the_protocol(broker: Broker, options: int) -> None:
    """Section 3.8.3.1."""
    client = joined(broker)
    assert client.say(subscribe(("a", options))) == disconnect(0x82) and client.closed


@statement("5.0", "MQTT-4.13.1-1")
@pytest.mark.parametrize("identifiers", ["0b 00", "0b 01 0b 02"])
def test_subscription_identifiers_that_are_wrong(broker: Broker, identifiers: str) -> None:
    """Section 3.8.2.1.2."""
    client = joined(broker)
    data = subscribe(("a", 0), props=properties(identifiers))
    assert client.say(data) == disconnect(0x82) and client.closed


@statement("5.0", "MQTT-3.8.3-5", "MQTT-4.13.1-1")
@pytest.mark.parametrize("options", [0x40, 0x80, 0xC0, 0xC2])
@pytest.mark.parametrize("place", [0, 1])
def test_reserved_option_bits_are_malformed(broker: Broker, options: int, place: int) -> None:
    client = joined(broker)
    filters = [("a", 0), ("b", 0)]
    filters[place] = ("c", options)
    assert client.say(subscribe(*filters)) == disconnect(0x81) and client.closed


@statement("5.0", "MQTT-3.8.3-3")
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_no_local(broker: Broker, qos: int) -> None:
    client, other = joined(broker, "one", **lasting(5)), joined(broker, "other")
    client.say(subscribe(("a", 0x04 | 2)))
    client.publish("a", b"own", qos)
    assert client.hear() == b""
    other.publish("a", b"another's", qos)
    assert client.hear() == publish("a", b"another's", qos)
    # The same client identifier on a new connection is the same client.
    client.lose()
    client = joined(broker, "one", **lasting(5))
    client.hear()
    client.publish("a", b"own", qos)
    assert client.hear() == b""
    client.say(subscribe(("a", 0)))
    client.publish("a", b"own", qos)
    assert client.hear() == publish("a", b"own")


@statement("5.0", "MQTT-3.8.3-3")
def test_no_local_is_a_matter_of_each_subscription(broker: Broker) -> None:
    client = joined(broker)
    client.say(subscribe(("a/#", 0x04 | 2), ("a/b", 1)))
    client.publish("a/b", b"x", 2)
    assert client.hear() == publish("a/b", b"x", 1)


@statement("5.0", "MQTT-3.8.3-4")
@pytest.mark.parametrize("filters", [[("$share/g/a", 0x04)], [("a", 0), ("$share/g/a", 0x06)]])
def test_no_local_on_a_shared_subscription_breaks_the_protocol(
    broker: Broker, filters: list[tuple[str, int]]
) -> None:
    client = joined(broker)
    assert client.say(subscribe(*filters)) == disconnect(0x82) and client.closed


@statement("5.0", "MQTT-3.8.4-3", "MQTT-3.8.4-2")
def test_the_same_filter_again_replaces_the_subscription(broker: Broker) -> None:
    client, sender = joined(broker), joined(broker, "sender")
    for options, props, sent in (
        (0x20, b"\0", publish("a", b"x")),
        (0x22, b"\0", publish("a", b"x", 1, 1)),
        (0x21, properties("0b 05"), publish("a", b"x", 1, 2, props=properties("0b 05"))),
        (0x20, properties("0b 06"), publish("a", b"x", props=properties("0b 06"))),
        (0x28, b"\0", publish("a", b"x", retain=True)),
        (0x20, b"\0", publish("a", b"x")),
    ):
        assert client.say(subscribe(("a", options), props=props)) == suback(options & 3)
        sender.publish("a", b"x", 1, retain=True)
        assert client.hear() == sent, f"once, and as the options {options:02x} say"


@statement("5.0", "MQTT-3.8.4-4")
@pytest.mark.parametrize("options", [0, 1, 2])
def test_replacing_a_subscription_loses_no_message(broker: Broker, options: int) -> None:
    client = joined(broker, properties={P.RECEIVE_MAXIMUM: 1})
    client.subscribe("a", 2)
    sender = joined(broker, "sender")
    for n in range(1, 4):
        sender.publish("a", b"%d" % n, 1)
    assert client.hear() == publish("a", b"1", 1, 1)
    assert client.say(subscribe(("a", options))) == suback(options)
    assert client.say("40 02 0001") == publish("a", b"2", 1, 2)
    assert client.say("40 02 0002") == publish("a", b"3", 1, 3)


Filters = Sequence[tuple[str, int]]


@statement("5.0", "MQTT-3.8.4-5", "MQTT-3.8.4-6", "MQTT-3.8.4-1", "MQTT-3.9.3-1")
@pytest.mark.parametrize(
    "filters",
    [
        [("a", 0), ("b", 1), ("c/#", 2)],
        [("a", 2), ("a", 0)],
        [("a", 0), ("+", 1), ("a", 2), ("#", 0)],
        [("b", 0x20), ("a", 0x11), ("a", 0x11), ("no/a", 1)],
    ],
)
def test_several_filters_are_as_several_subscribes(
    broker: Broker, access: FakeAccess, filters: Filters
) -> None:
    access.deny("user", Action.SUBSCRIBE, "no/#")
    sender = joined(broker, "sender")
    for topic in ("a", "b", "c/d"):
        sender.publish(topic, b"kept", 1, retain=True)

    def heard(messages: list[Publish]) -> list[tuple[str, bytes, int, bool]]:
        return sorted((one.topic, one.payload, one.qos, one.retain) for one in messages)

    together, apart = joined(broker, "together"), joined(broker, "apart")
    codes: list[int] = []
    kept: list[Publish] = []
    for one in filters:
        apart.send(subscribe(one))
        answer, *behind = apart.received()
        codes += answer.reason_codes  # type: ignore[union-attr]
        kept += behind  # type: ignore[arg-type]
    together.send(subscribe(*filters, packet_id=7))
    answer, *behind = together.received()
    assert answer.encode(5) == suback(*codes, packet_id=7), "one answer, and before anything else"
    # With which QoS, when a filter is there twice, is a matter of when they are sent.
    assert sorted((m.topic, m.payload) for m in behind) == sorted(
        (m.topic, m.payload) for m in kept
    )
    for topic in ("a", "b", "c/d"):
        sender.publish(topic, b"live", 2)
    assert heard(together.messages()) == heard(apart.messages())


@statement("5.0", "MQTT-3.8.4-5")
def test_the_last_of_the_same_filters_counts(broker: Broker) -> None:
    client = joined(broker)
    assert client.say(subscribe(("a", 2), ("a", 0), ("a", 1))) == suback(2, 0, 1)
    joined(broker, "sender").publish("a", b"x", 2)
    assert client.hear() == publish("a", b"x", 1)


@statement("5.0", "MQTT-3.8.4-8", "MQTT-3.8.4-7")
@pytest.mark.parametrize("granted", [0, 1, 2])
@pytest.mark.parametrize("qos", [0, 1, 2])
@pytest.mark.parametrize("retain", [False, True], ids=["live", "retained"])
def test_the_lower_qos_counts(broker: Broker, qos: int, granted: int, retain: bool) -> None:
    client, sender = joined(broker), joined(broker, "sender")
    if retain:
        sender.publish("a", b"x", qos, retain=True)
    heard = client.say(subscribe(("a", granted)))
    if not retain:
        sender.publish("a", b"x", qos)
        heard += client.hear()
    assert heard == suback(granted) + publish("a", b"x", min(qos, granted), retain=retain)


# --- 3.9 SUBACK


@statement("5.0", "MQTT-3.9.3-1", "MQTT-3.9.3-2", "MQTT-3.8.4-6", "MQTT-3.8.4-7")
def test_suback_has_a_code_for_each_filter_in_their_order(
    broker: Broker, access: FakeAccess
) -> None:
    access.deny("user", Action.SUBSCRIBE, "no/#")
    client = joined(broker)
    data = subscribe(("a", 2), ("no/a", 1), ("b", 0), ("c", 1), ("no/b", 0), ("d", 2))
    assert client.say(data) == suback(2, 0x87, 0, 1, 0x87, 2)
    assert set(client.session.subscriptions) == {"a", "b", "c", "d"}


@statement("5.0", "MQTT-3.9.3-2", "MQTT-3.8.4-7")
@pytest.mark.parametrize("limits", [Limits(subscriptions=2)])
def test_a_subscription_too_many_is_refused(broker: Broker) -> None:
    client = joined(broker)
    assert client.say(subscribe(("a", 0), ("b", 0), ("c", 0), ("a", 1))) == suback(0, 0, 0x97, 1)


@statement("5.0", "MQTT-3.9.3-2", "MQTT-4.13.2-1")
def test_a_refused_subscription_leaves_the_connection_as_it_is(
    broker: Broker, access: FakeAccess
) -> None:
    access.deny("user", Action.SUBSCRIBE, "no/#")
    client = joined(broker)
    assert client.say(subscribe(("no/a", 0)), "c0 00") == suback(0x87) + wire("d0 00")
    joined(broker, "sender").publish("no/a", b"x")
    assert client.hear() == b""


# --- 3.10 UNSUBSCRIBE


@statement("5.0", "MQTT-3.10.3-2", "MQTT-4.13.1-1")
def test_unsubscribe_needs_a_filter(broker: Broker) -> None:
    client = joined(broker)
    assert client.say(unsubscribe()) == disconnect(0x82) and client.closed


@statement("5.0", "MQTT-3.10.3-1", "MQTT-4.13.1-1")
@pytest.mark.parametrize(
    "data",
    [
        packet(0xA2, b"\0\1\0", b"\0\5a"),
        packet(0xA2, b"\0\1\0", field("a"), b"\0"),
        packet(0xA2, b"\0"),
        packet(0xA2, b"\0\1", properties("0b 01"), field("a")),
    ],
    ids=["a filter longer than the packet", "a byte too many", "cut", "a property of SUBSCRIBE"],
)
def test_an_unsubscribe_that_cannot_be_read_is_malformed(broker: Broker, data: bytes) -> None:
    client = joined(broker)
    assert client.say(data) == disconnect(0x81) and client.closed


@statement("5.0", "MQTT-3.10.4-1", "MQTT-3.11.3-2", "MQTT-3.10.4-5", "MQTT-4.7.3-4")
@pytest.mark.parametrize(
    ("topic_filter", "others", "topic"),
    [
        ("a/+", ["a/#", "a/b", "a/+/", "/a/+", "A/+", "a/", "a", "+/b", "+"], "a/b"),
        ("a/b", ["a/+", "a/B", "a/b/", "#"], "a/b"),
        ("é", ["e\u0301", "É", "e"], "é"),
        ("a//b", ["a/b", "a/+/b"], "a//b"),
    ],
)
def test_filters_are_compared_character_by_character(
    broker: Broker, topic_filter: str, others: list[str], topic: str
) -> None:
    client, sender = joined(broker), joined(broker, "sender")
    client.subscribe(topic_filter)
    assert client.say(unsubscribe(*others)) == unsuback(*[0x11] * len(others))
    sender.publish(topic, b"1")
    assert client.hear() == publish(topic, b"1")
    assert client.say(unsubscribe(topic_filter)) == unsuback(0)
    sender.publish(topic, b"2")
    assert client.hear() == b""


@statement("5.0", "MQTT-3.10.4-2", "MQTT-3.10.4-4")
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_after_unsubscribe_no_new_messages_come(broker: Broker, qos: int) -> None:
    client, sender = joined(broker, **lasting(5)), joined(broker, "sender")
    client.say(subscribe(("a", qos), ("b", qos)))
    assert client.say(unsubscribe("a")) == unsuback(0)
    assert sender.publish("a", b"x", 1) == 0x10
    client.lose()
    sender.publish("a", b"x", 2)
    client = joined(broker, **lasting(5))
    assert client.hear() == b""
    sender.publish("b", b"x")
    assert client.hear() == publish("b", b"x")


@statement("5.0", "MQTT-3.10.4-3")
@pytest.mark.parametrize("reconnect", [False, True])
def test_what_was_being_sent_is_brought_to_its_end(broker: Broker, reconnect: bool) -> None:
    client, sender = joined(broker, **lasting(5)), joined(broker, "sender")
    client.subscribe("a", 2)
    for qos, payload in ((1, b"1"), (2, b"2"), (2, b"3")):
        sender.publish("a", payload, qos)
    client.hear()
    assert client.say("50 02 0003") == wire("62 02 0003")
    assert client.say(unsubscribe("a")) == unsuback(0)
    if reconnect:
        client.lose()
        client = joined(broker, **lasting(5))
        again = {packet.encode(5) for packet in client.received()}
        assert again == {
            publish("a", b"1", 1, 1, dup=True),
            publish("a", b"2", 2, 2, dup=True),
            wire("62 02 0003"),
        }
    assert client.say("50 02 0002") == wire("62 02 0002")
    assert client.say("40 02 0001", "70 02 0002", "70 02 0003") == b""
    assert client.session.inflight == {}


@statement("5.0", "MQTT-3.10.4-6", "MQTT-3.11.3-1", "MQTT-3.11.3-2", "MQTT-3.10.4-4")
def test_several_filters_are_as_several_unsubscribes(broker: Broker) -> None:
    client, sender = joined(broker), joined(broker, "sender")
    client.say(subscribe(("a", 0), ("b", 0), ("c", 0)))
    data = unsubscribe("x", "a", "a", "c", "c/#", packet_id=0x0203)
    assert client.say(data) == unsuback(0x11, 0, 0x11, 0, 0x11, packet_id=0x0203)
    for topic in ("a", "b", "c"):
        sender.publish(topic, b"x")
    assert client.hear() == publish("b", b"x")


@statement("5.0", "MQTT-3.10.4-5", "MQTT-3.10.4-4", "MQTT-3.11.3-2")
def test_unsubscribing_from_nothing_is_answered(broker: Broker) -> None:
    client = joined(broker)
    assert client.say(unsubscribe("a", packet_id=0xFFFF)) == unsuback(0x11, packet_id=0xFFFF)
