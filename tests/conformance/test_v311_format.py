"""MQTT 3.1.1, chapters 1 and 2: strings, flags and packet identifiers."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from client_v311 import (
    ACCEPTED,
    CLEAN_SESSION,
    SESSION_PRESENT,
    USER_NAME,
    WILL,
    Client,
    connect,
    field,
    joined,
    packet,
    refused,
    wire,
)
from formats import ILL_FORMED, check_identifiers, packet_ids, packet_names, packets_of

from appliance.broker.broker import Broker

statement = pytest.mark.statement

# --- strings

#: Packets around a string that is good or bad, as the only one in them that is tried.
IN_CONNECT: dict[str, Callable[[bytes], bytes]] = {
    "client id": lambda text: connect(text),
    "will topic": lambda text: connect("c", text, "x", flags=CLEAN_SESSION | WILL),
    "user name": lambda text: connect("c", text, flags=CLEAN_SESSION | USER_NAME),
}
BEHIND_CONNECT: dict[str, Callable[[bytes], bytes]] = {
    "topic": lambda text: packet(0x30, field(text), b"payload"),
    "topic, QoS 1": lambda text: packet(0x32, field(text), b"\0\1", b"payload"),
    "filter": lambda text: packet(0x82, b"\0\1", field(text), b"\0"),
    "second filter": lambda text: packet(0x82, b"\0\1", field("a"), b"\0", field(text), b"\0"),
    "filter to unsubscribe": lambda text: packet(0xA2, b"\0\1", field(text)),
}
STRINGS = [
    pytest.param("client id", marks=statement("3.1.1", "MQTT-3.1.3-4")),
    pytest.param("will topic", marks=statement("3.1.1", "MQTT-3.1.3-10")),
    pytest.param("user name", marks=statement("3.1.1", "MQTT-3.1.3-11")),
    pytest.param("topic", marks=statement("3.1.1", "MQTT-3.3.2-1")),
    pytest.param("topic, QoS 1", marks=statement("3.1.1", "MQTT-3.3.2-1")),
    pytest.param("filter", marks=statement("3.1.1", "MQTT-3.8.3-1")),
    pytest.param("second filter", marks=statement("3.1.1", "MQTT-3.8.3-1")),
    pytest.param("filter to unsubscribe", marks=statement("3.1.1", "MQTT-3.10.3-1")),
]

MORE_ILL_FORMED = ILL_FORMED | {
    "three bytes for two": "e0 80 af",
    "a pair of surrogates": "ed a0 bd ed b8 80",
}


def is_refused(broker: Broker, where: str, text: bytes) -> bool:
    """Whether the connection is closed upon the string, without a CONNACK or another answer."""
    if where in IN_CONNECT:
        client = Client(broker)
        return refused(client, IN_CONNECT[where](text)) and client.transport.asked is None
    return refused(joined(broker), BEHIND_CONNECT[where](text))


@statement("3.1.1", "MQTT-1.5.3-1")
@pytest.mark.parametrize("text", MORE_ILL_FORMED.values(), ids=MORE_ILL_FORMED)
@pytest.mark.parametrize("where", STRINGS)
def test_ill_formed_utf_8_closes_the_connection(broker: Broker, where: str, text: str) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("#")
    assert is_refused(broker, where, bytes.fromhex(text))
    assert set(broker.sessions) == {"watcher"}
    assert watcher.hear() == b""


@statement("3.1.1", "MQTT-1.5.3-2")
@pytest.mark.parametrize(
    "where",
    [
        "client id",
        "will topic",
        "user name",
        *[
            pytest.param(where, marks=statement("3.1.1", "MQTT-4.7.3-2"))
            for where in BEHIND_CONNECT
        ],
    ],
)
@pytest.mark.parametrize("text", [b"\0", b"\0a", b"a\0b", b"a\0"])
def test_u_0000_closes_the_connection(broker: Broker, where: str, text: bytes) -> None:
    assert is_refused(broker, where, text)


@pytest.mark.parametrize("text", ["é", "\U0010fffd", "\ud7ff", "\ue000", "€/日本"])
@statement("3.1.1", "MQTT-1.5.3-1", "MQTT-3.3.2-1")
def test_well_formed_utf_8_is_passed_on(broker: Broker, text: str) -> None:
    receiver = joined(broker, "receiver")
    receiver.subscribe(text)
    sent = packet(0x30, field(text), b"payload")
    assert joined(broker).say(sent) == b""
    assert receiver.hear() == sent


@statement("3.1.1", "MQTT-1.5.3-3")
def test_a_byte_order_mark_is_a_character_like_any_other(broker: Broker) -> None:
    marked, plain = joined(broker, "marked"), joined(broker, "plain")
    assert marked.say("82 09 0001 0004 efbbbf61 00") == wire("90 03 0001 00")
    assert plain.say("82 06 0001 0001 61 00") == wire("90 03 0001 00")
    sent = wire("30 07 0004 efbbbf61 78")
    joined(broker).say(sent, "30 04 0001 61 79")
    assert marked.hear() == sent
    assert plain.hear() == wire("30 04 0001 61 79")


@statement("3.1.1", "MQTT-1.5.3-3", "MQTT-3.1.3-2")
def test_a_byte_order_mark_is_part_of_a_client_id(broker: Broker) -> None:
    joined(broker, "\ufeffc", clean=False).lose()
    assert Client(broker).log_in(connect("c", flags=0)) == ACCEPTED
    assert Client(broker).log_in(connect("\ufeffc", flags=0)) == SESSION_PRESENT


# --- flags of the fixed header

#: The flags of table 2.2.
PACKETS = packets_of(
    connect("c"), subscribe="82 06 0001 0001 61 00", unsubscribe="a2 05 0001 0001 61"
)


@statement("3.1.1", "MQTT-2.2.2-2")
@pytest.mark.parametrize("name", packet_names("3.1.1"))
def test_wrong_flags_close_the_connection(broker: Broker, name: str) -> None:
    right, rest = PACKETS[name]
    for flags in range(16):
        first = right & 0xF0 | flags
        client = Client(broker) if name == "CONNECT" else joined(broker)
        if first == right:
            client.say(bytes((first,)) + rest)
            assert client.closed == (name == "DISCONNECT")
        else:
            assert refused(client, bytes((first,)) + rest), f"{name} with the flags {flags:04b}"
            assert broker.sessions == {}
        client.lose()


@statement("3.1.1", "MQTT-2.2.2-1")
def test_the_server_sends_no_reserved_flags(broker: Broker) -> None:
    client = Client(broker)
    assert client.log_in(connect("c")) == wire("20 02 00 00")
    assert client.say("82 06 0001 0001 61 02") == wire("90 03 0001 02")
    assert client.say("32 05 0001 62 0002") == wire("40 02 0002")
    assert client.say("34 05 0001 62 0003") == wire("50 02 0003")
    assert client.say("62 02 0003") == wire("70 02 0003")
    assert client.say("c0 00") == wire("d0 00")
    joined(broker, "other").publish("a", b"", 2)
    assert client.hear() == wire("34 05 0001 61 0001")
    assert client.say("50 02 0001") == wire("62 02 0001")
    assert client.say("70 02 0001", "a2 05 0004 0001 61") == wire("b0 02 0004")


# --- packet identifiers


@statement("3.1.1", "MQTT-2.3.1-1")
@pytest.mark.parametrize(
    "without",
    [
        "32 06 0001 61 0000 78",
        "34 06 0001 61 0000 78",
        "82 06 0000 0001 61 00",
        "a2 05 0000 0001 61",
    ],
    ids=["QoS 1", "QoS 2", "SUBSCRIBE", "UNSUBSCRIBE"],
)
def test_a_packet_identifier_of_0_closes_the_connection(broker: Broker, without: str) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("a")
    assert refused(joined(broker), without)
    assert watcher.hear() == b""


@statement("3.1.1", "MQTT-2.3.1-5")
def test_qos_0_has_no_packet_identifier(broker: Broker) -> None:
    client = joined(broker)
    client.subscribe("a", 2)
    # What stands where an identifier would be is the payload, and goes out as it came.
    assert client.say("30 05 0001 61 0000") == wire("30 05 0001 61 0000")
    joined(broker, "other").publish("a", b"", 0)
    assert client.hear() == wire("30 03 0001 61")


@statement("3.1.1", "MQTT-2.3.1-6")
@packet_ids
def test_acknowledgements_have_the_identifier_of_the_publish(
    broker: Broker, packet_id: str
) -> None:
    client = joined(broker)
    assert client.say(f"32 06 0001 61 {packet_id} 78") == wire(f"40 02 {packet_id}")
    assert client.say(f"34 06 0001 61 {packet_id} 78") == wire(f"50 02 {packet_id}")
    assert client.say(f"62 02 {packet_id}") == wire(f"70 02 {packet_id}")


@statement("3.1.1", "MQTT-2.3.1-6", "MQTT-4.3.3-1")
def test_pubrel_has_the_identifier_of_the_publish(broker: Broker) -> None:
    receiver, sender = joined(broker, "receiver"), joined(broker, "sender")
    receiver.subscribe("a", 2)
    for _ in range(300):
        sender.publish("a", b"", 2)
        packet_id = receiver.hear()[-2:]
        assert receiver.say(b"\x50\2" + packet_id) == b"\x62\2" + packet_id
        receiver.say(b"\x70\2" + packet_id)


@statement("3.1.1", "MQTT-2.3.1-7", "MQTT-3.8.4-2", "MQTT-3.10.4-4")
@packet_ids
def test_suback_and_unsuback_have_the_identifier_of_what_they_answer(
    broker: Broker, packet_id: str
) -> None:
    client = joined(broker)
    assert client.say(f"82 06 {packet_id} 0001 61 01") == wire(f"90 03 {packet_id} 01")
    assert client.say(f"a2 05 {packet_id} 0001 61") == wire(f"b0 02 {packet_id}")


@statement("3.1.1", "MQTT-2.3.1-1", "MQTT-2.3.1-4", "MQTT-4.3.2-1", "MQTT-4.3.3-1")
def test_an_identifier_is_used_again_only_after_the_last_acknowledgement(broker: Broker) -> None:
    check_identifiers(joined(broker, "receiver"), joined(broker, "sender"))
