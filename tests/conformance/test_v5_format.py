"""MQTT 5.0, chapters 1 and 2: strings, integers, flags, packet identifiers, properties."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from client_v5 import (
    ACCEPTED,
    CLEAN_START,
    USER_NAME,
    WILL,
    Client,
    connect,
    disconnect,
    field,
    is_closed,
    joined,
    packet,
    properties,
    publish,
    turned_away,
    wire,
)
from formats import ILL_FORMED, check_identifiers, packet_ids, packet_names, packets_of

from appliance.broker.broker import Broker

statement = pytest.mark.statement

# --- 1.5.4 strings

#: Packets around a string that is good or bad, as the only one in them that is tried.
IN_CONNECT: dict[str, Callable[[bytes], bytes]] = {
    "client id": lambda text: connect(field(text)),
    "will topic": lambda text: connect("c", b"\0" + field(text), "x", flags=CLEAN_START | WILL),
    "will content type": lambda text: connect(
        "c", properties(b"\x03" + field(text)), "w", "x", flags=CLEAN_START | WILL
    ),
    "user name": lambda text: connect("c", field(text), flags=CLEAN_START | USER_NAME),
    "user property of CONNECT": lambda text: connect(
        "c", props=properties(b"\x26" + field("name") + field(text))
    ),
    "authentication method": lambda text: connect("c", props=properties(b"\x15" + field(text))),
}
BEHIND_CONNECT: dict[str, Callable[[bytes], bytes]] = {
    "topic": lambda text: publish(text, b"x"),
    "topic, QoS 1": lambda text: publish(text, b"x", 1),
    "content type": lambda text: publish("a", props=properties(b"\x03" + field(text))),
    "response topic": lambda text: publish("a", props=properties(b"\x08" + field(text))),
    "name of a user property": lambda text: publish(
        "a", props=properties(b"\x26" + field(text) + field("value"))
    ),
    "value of a user property": lambda text: publish(
        "a", props=properties(b"\x26" + field("name") + field(text))
    ),
    "filter": lambda text: packet(0x82, b"\0\1\0", field(text), b"\0"),
    "second filter": lambda text: packet(0x82, b"\0\1\0", field("a"), b"\0", field(text), b"\0"),
    "filter to unsubscribe": lambda text: packet(0xA2, b"\0\1\0", field(text)),
    "reason string of PUBACK": lambda text: packet(
        0x40, b"\0\1\x80", properties(b"\x1f" + field(text))
    ),
    "reason string of DISCONNECT": lambda text: packet(
        0xE0, b"\x80", properties(b"\x1f" + field(text))
    ),
}
STRINGS = [
    pytest.param("client id", marks=statement("5.0", "MQTT-3.1.3-4")),
    pytest.param("will topic", marks=statement("5.0", "MQTT-3.1.3-11")),
    "will content type",
    pytest.param("user name", marks=statement("5.0", "MQTT-3.1.3-12")),
    pytest.param("user property of CONNECT", marks=statement("5.0", "MQTT-1.5.7-1")),
    "authentication method",
    pytest.param("topic", marks=statement("5.0", "MQTT-3.3.2-1")),
    pytest.param("topic, QoS 1", marks=statement("5.0", "MQTT-3.3.2-1")),
    pytest.param("content type", marks=statement("5.0", "MQTT-3.3.2-19")),
    pytest.param("response topic", marks=statement("5.0", "MQTT-3.3.2-13")),
    pytest.param("name of a user property", marks=statement("5.0", "MQTT-1.5.7-1")),
    pytest.param("value of a user property", marks=statement("5.0", "MQTT-1.5.7-1")),
    pytest.param("filter", marks=statement("5.0", "MQTT-3.8.3-1")),
    pytest.param("second filter", marks=statement("5.0", "MQTT-3.8.3-1")),
    pytest.param("filter to unsubscribe", marks=statement("5.0", "MQTT-3.10.3-1")),
    "reason string of PUBACK",
    "reason string of DISCONNECT",
]


def is_malformed(broker: Broker, where: str, text: bytes) -> bool:
    """Whether the connection ends upon this string, with the reason where there is a client."""
    if where in IN_CONNECT:
        return turned_away(Client(broker), IN_CONNECT[where](text))
    client = joined(broker)
    return client.say(BEHIND_CONNECT[where](text)) == disconnect(0x81) and client.closed


@statement("5.0", "MQTT-1.5.4-1")
@pytest.mark.parametrize("text", ILL_FORMED.values(), ids=ILL_FORMED)
@pytest.mark.parametrize("where", STRINGS)
def test_ill_formed_utf_8_is_malformed(broker: Broker, where: str, text: str) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("#")
    assert is_malformed(broker, where, bytes.fromhex(text))
    assert set(broker.sessions) == {"watcher"}
    assert watcher.hear() == b""


@statement("5.0", "MQTT-1.5.4-2")
@pytest.mark.parametrize("text", [b"\0", b"\0a", b"a\0b"])
@pytest.mark.parametrize(
    "where",
    [
        *IN_CONNECT,
        *[
            pytest.param(where, marks=statement("5.0", "MQTT-4.7.3-2"))
            if "topic" in where or "filter" in where
            else where
            for where in BEHIND_CONNECT
        ],
    ],
)
def test_u_0000_is_malformed(broker: Broker, where: str, text: bytes) -> None:
    assert is_malformed(broker, where, text)


@statement("5.0", "MQTT-1.5.4-1", "MQTT-1.5.7-1", "MQTT-3.3.2-1", "MQTT-3.8.3-1")
@pytest.mark.parametrize("text", ["é", "\U0010ffff", "\ud7ff", "\ue000", "€/日本"])
def test_well_formed_utf_8_is_passed_on(broker: Broker, text: str) -> None:
    receiver = joined(broker, f"of {text}")
    receiver.subscribe(text)
    sent = publish(text, b"x", props=properties(b"\x26" + field(text) + field(text)))
    assert joined(broker).say(sent) == b""
    assert receiver.hear() == sent


@statement("5.0", "MQTT-1.5.4-3")
def test_a_byte_order_mark_is_a_character_like_any_other(broker: Broker) -> None:
    marked, plain = joined(broker, "marked"), joined(broker, "plain")
    assert marked.say("82 0a 0001 00 0004 efbbbf61 00") == wire("90 04 0001 00 00")
    assert plain.say("82 07 0001 00 0001 61 00") == wire("90 04 0001 00 00")
    pair = "26 0004 61efbbbf 0003 efbbbf"
    sent = publish("\ufeffa", b"x", props=properties(pair))
    assert joined(broker).say(sent, publish("a", b"y")) == b""
    assert marked.hear() == sent
    assert plain.hear() == publish("a", b"y")


# --- 1.5.5 Variable Byte Integers


@statement("5.0", "MQTT-1.5.5-1")
@pytest.mark.parametrize(
    ("remaining", "length"),
    [(127, "7f"), (128, "80 01"), (16383, "ff 7f"), (16384, "80 80 01"), (2097152, "80 80 80 01")],
)
def test_the_length_of_what_is_sent_takes_as_few_bytes_as_it_needs(
    broker: Broker, remaining: int, length: str
) -> None:
    receiver = joined(broker, "receiver")
    receiver.subscribe("a", 1)
    payload = bytes(remaining - 6)
    joined(broker).publish("a", payload, 1)
    assert receiver.hear() == wire(f"32 {length} 0001 61 0001 00") + payload


@statement("5.0", "MQTT-1.5.5-1")
@pytest.mark.parametrize(
    ("identifier", "length"), [(127, "7f"), (128, "80 01"), (268435455, "ff ff ff 7f")]
)
def test_an_identifier_that_is_sent_takes_as_few_bytes_as_it_needs(
    broker: Broker, identifier: int, length: str
) -> None:
    receiver = joined(broker)
    told = properties(f"0b {length}")
    receiver.say(packet(0x82, b"\0\1", told, field("a"), b"\0"))
    joined(broker, "sender").publish("a", b"x")
    assert receiver.hear() == publish("a", b"x", props=told)


@statement("5.0", "MQTT-1.5.5-1")
@pytest.mark.parametrize(
    "data",
    [
        "c0 80 00",
        "c0 80 80 80 00",
        "c0 80 80 80 80 00",
        "c0 ff ff ff ff",
        "30 86 00 0001 61 00 7878",
        "30 07 0001 61 80 00 7878",
        "82 08 0001 80 00 0001 61 00",
        "82 0a 0001 03 0b 81 00 0001 61 00",
    ],
    ids=[
        "PINGREQ, two bytes for 0",
        "PINGREQ, four bytes for 0",
        "PINGREQ, five bytes",
        "PINGREQ, more than four bytes",
        "PUBLISH, remaining length",
        "PUBLISH, property length",
        "SUBSCRIBE, property length",
        "SUBSCRIBE, identifier",
    ],
)
def test_a_length_in_more_bytes_than_it_needs_is_malformed(broker: Broker, data: str) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("#")
    assert is_closed(joined(broker), 0x81, data)
    assert watcher.hear() == b""


# --- 2.1.3 flags

#: The flags of table 2-2.
PACKETS = packets_of(
    connect("c"), subscribe="82 07 0001 00 0001 61 00", unsubscribe="a2 06 0001 00 0001 61"
)


@statement("5.0", "MQTT-2.1.3-1")
@pytest.mark.parametrize("name", packet_names("5.0"))
def test_reserved_flags_are_malformed(broker: Broker, name: str) -> None:
    right, rest = PACKETS[name]
    for flags in set(range(16)) - {right & 0x0F}:
        first = bytes((right & 0xF0 | flags,))
        if name == "CONNECT":
            assert turned_away(Client(broker), first + rest)
        else:
            client = joined(broker)
            assert client.say(first + rest) == disconnect(0x81), f"{name} with {flags:04b}"
            assert client.closed
        assert broker.sessions == {}


@statement("5.0", "MQTT-2.1.3-1", "MQTT-2.2.2-1", "MQTT-3.2.2-1", "MQTT-3.6.1-1", "MQTT-4.3.1-1")
def test_what_the_server_sends_to_the_byte(broker: Broker) -> None:
    client = Client(broker)
    assert client.log_in(connect("c")) == ACCEPTED
    assert client.say("82 07 0001 00 0001 61 02") == wire("90 04 0001 00 02")
    assert client.say("32 06 0001 62 0002 00") == wire("40 03 0002 10")
    assert client.say("34 06 0001 62 0003 00") == wire("50 02 0003")
    assert client.say("62 02 0003") == wire("70 02 0003")
    assert client.say("c0 00") == wire("d0 00")
    sender = joined(broker, "other")
    sender.publish("a", b"", 2)
    assert client.hear() == wire("34 06 0001 61 0001 00")
    assert client.say("50 02 0001") == wire("62 02 0001")
    assert client.say("70 02 0001") == b""
    sender.publish("a", b"x", 0)
    assert client.hear() == wire("30 05 0001 61 00 78")
    assert client.say("a2 06 0004 00 0001 61") == wire("b0 04 0004 00 00")


# --- 2.2.1 packet identifiers


@statement("5.0", "MQTT-2.2.1-2", "MQTT-4.3.1-1")
def test_qos_0_has_no_packet_identifier(broker: Broker) -> None:
    client = joined(broker)
    client.subscribe("a", 2)
    # What stands where an identifier would be is the payload's, behind no properties.
    assert client.say("30 06 0001 61 00 0001") == wire("30 06 0001 61 00 0001")


@statement("5.0", "MQTT-2.2.1-3")
@pytest.mark.parametrize(
    ("without", "code"),
    [
        ("32 07 0001 61 0000 00 78", 0x82),
        ("34 07 0001 61 0000 00 78", 0x82),
        ("82 07 0000 00 0001 61 00", 0x81),  # the standard names no code; these are mosquitto's
        ("a2 06 0000 00 0001 61", 0x81),
    ],
    ids=["QoS 1", "QoS 2", "SUBSCRIBE", "UNSUBSCRIBE"],
)
def test_a_packet_identifier_of_0_is_an_error(broker: Broker, without: str, code: int) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("a")
    client = joined(broker)
    assert client.say(without) == disconnect(code) and client.closed
    assert watcher.hear() == b""


@statement("5.0", "MQTT-2.2.1-5", "MQTT-4.3.2-4", "MQTT-4.3.3-8", "MQTT-4.3.3-11")
@packet_ids
def test_acknowledgements_have_the_identifier_of_the_publish(
    broker: Broker, packet_id: str
) -> None:
    joined(broker, "watcher").subscribe("a")
    client = joined(broker)
    assert client.say(f"32 07 0001 61 {packet_id} 00 78") == wire(f"40 02 {packet_id}")
    assert client.say(f"34 07 0001 61 {packet_id} 00 78") == wire(f"50 02 {packet_id}")
    assert client.say(f"62 02 {packet_id}") == wire(f"70 02 {packet_id}")


@statement("5.0", "MQTT-2.2.1-5", "MQTT-4.3.3-4")
def test_pubrel_has_the_identifier_of_the_publish(broker: Broker) -> None:
    receiver, sender = joined(broker, "receiver"), joined(broker, "sender")
    receiver.subscribe("a", 2)
    for expected in range(1, 301):
        sender.publish("a", b"", 2)
        packet_id = expected.to_bytes(2, "big")
        assert receiver.hear() == wire("34 06 0001 61") + packet_id + b"\0"
        assert receiver.say(b"\x50\2" + packet_id) == b"\x62\2" + packet_id
        assert receiver.say(b"\x70\2" + packet_id) == b""


@statement("5.0", "MQTT-2.2.1-6", "MQTT-3.8.4-1", "MQTT-3.8.4-2", "MQTT-3.10.4-4", "MQTT-3.10.4-5")
@packet_ids
def test_suback_and_unsuback_have_the_identifier_of_what_they_answer(
    broker: Broker, packet_id: str
) -> None:
    client = joined(broker)
    assert client.say(f"82 07 {packet_id} 00 0001 61 01") == wire(f"90 04 {packet_id} 00 01")
    assert client.say(f"a2 06 {packet_id} 00 0001 61") == wire(f"b0 04 {packet_id} 00 00")


@statement("5.0", "MQTT-2.2.1-4", "MQTT-4.3.2-1", "MQTT-4.3.3-1")
def test_an_identifier_is_used_again_only_after_the_last_acknowledgement(broker: Broker) -> None:
    check_identifiers(joined(broker, "receiver"), joined(broker, "sender"))


# --- 2.2.2 properties


@statement("5.0", "MQTT-2.2.2-1")
@pytest.mark.parametrize(
    "data",
    [
        "30 03 0001 61",
        "32 05 0001 61 0001",
        "82 02 0001",
        "a2 02 0001",
        "82 06 0001 0001 61 00",
    ],
    ids=["PUBLISH", "PUBLISH, QoS 1", "SUBSCRIBE", "UNSUBSCRIBE", "SUBSCRIBE of 3.1.1"],
)
def test_a_packet_without_a_property_length_is_malformed(broker: Broker, data: str) -> None:
    client = joined(broker)
    assert client.say(data) == disconnect(0x81) and client.closed


@statement("5.0", "MQTT-4.13.1-1")
@pytest.mark.parametrize(
    ("props", "code"),
    [
        ("0a", 0x81),
        ("01", 0x81),
        ("02 000000", 0x81),
        ("09 0005 61", 0x81),
        ("11 00000001", 0x81),
        ("21 0014", 0x81),
        ("80 01 00", 0x81),
        ("01 00 01 00", 0x82),
        ("02 00000001 02 00000001", 0x82),
        ("08 0001 61 08 0001 61", 0x82),
        ("09 0000 09 0000", 0x82),
        ("03 0000 03 0000", 0x82),
        ("23 0001 23 0001", 0x82),
        ("01 02", 0x82),
    ],
    ids=[
        "no such property",
        "cut at its value",
        "cut in its value",
        "longer than the properties",
        "of CONNECT",
        "of CONNACK",
        "an identifier of two bytes",
        "two format indicators",
        "two expiry intervals",
        "two response topics",
        "two correlation data",
        "two content types",
        "two topic aliases",
        "a format that there is not",
    ],
)
def test_properties_of_publish_that_are_wrong(broker: Broker, props: str, code: int) -> None:
    """Section 2.2.2.2, and "it is a Protocol Error" in 3.3.2.3."""
    client = joined(broker)
    assert client.say(publish("a", props=properties(props))) == disconnect(code)
    assert client.closed
