"""MQTT 5.0, section 4.13: errors; what they end, and what they leave alone."""

from __future__ import annotations

import pytest
from broker.conftest import FakeAccess, lasting
from client_v5 import (
    Client,
    connack,
    connect,
    disconnect,
    is_closed,
    joined,
    packet,
    properties,
    publish,
    turned_away,
    wire,
)

from appliance.broker.broker import Broker
from appliance.broker.limits import Limits
from appliance.broker.values import Action
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Will
from appliance.mqtt.reason import ReasonCode

P = Property
statement = pytest.mark.statement

#: Packets of a client that is connected, with the reason that fits them best.
ERRORS = {
    "packet type 0": ("00 00", {0x81, 0x82}),
    "CONNECT again": (connect("c"), {0x82}),
    "CONNACK": ("20 03 00 00 00", {0x82}),
    "SUBACK": ("90 04 0001 00 00", {0x82}),
    "PINGRESP": ("d0 00", {0x82}),
    "AUTH": ("f0 06 18 04 15 0001 4d", {0x82}),
    "an acknowledgement that is too short": ("40 01 00", {0x81}),
    "reserved flags": ("61 02 0001", {0x81}),
    "QoS 3": ("36 07 0001 61 0001 00 78", {0x81}),
    "a string that is cut": ("30 03 0005 61", {0x81}),
    "a length of five bytes": ("30 ff ff ff ff 7f", {0x81}),
    "a SUBSCRIBE for nothing": ("82 03 0001 00", {0x82}),
    "an alias that was never given": (publish("", b"x", props=properties("23 0001")), {0x82, 0x94}),
    "an alias above the maximum": (publish("a", b"x", props=properties("23 0fff")), {0x94}),
}
errors = pytest.mark.parametrize(("data", "codes"), ERRORS.values(), ids=ERRORS)


@statement("5.0", "MQTT-4.13.1-1", "MQTT-4.13.2-1")
@errors
def test_an_error_ends_its_connection_and_no_other(
    broker: Broker, data: bytes | str, codes: set[int]
) -> None:
    other = joined(broker, "other")
    other.subscribe("#", 1)
    client = joined(broker, will=Will("w", b"gone"))
    heard = client.say(publish("a", b"1"), data, publish("a", b"2"), "c0 00")
    assert heard in {b"", *map(disconnect, codes)} and client.closed
    assert other.hear() == publish("a", b"1") + publish("w", b"gone")
    assert other.say("c0 00") == wire("d0 00") and not other.closed


@statement("5.0", "MQTT-4.13.1-1", "MQTT-3.1.2-23", "MQTT-4.4.0-1")
@errors
def test_an_error_leaves_a_session_that_is_kept(
    broker: Broker, data: bytes | str, codes: set[int]
) -> None:
    client = joined(broker, **lasting(5))
    client.subscribe("a", 1)
    joined(broker, "sender").publish("a", b"x", 1)
    assert client.hear() == publish("a", b"x", 1)
    client.say(data)
    assert client.closed
    assert joined(broker, **lasting(5)).hear() == publish("a", b"x", 1, dup=True)


@statement("5.0", "MQTT-4.13.2-1", "MQTT-3.14.4-2")
def test_a_client_that_reads_nothing_is_closed_all_the_same(broker: Broker) -> None:
    client = joined(broker)
    client.slow()
    client.send(wire("82 03 0001 00"))
    assert client.closed


@statement("5.0", "MQTT-4.13.2-1", "MQTT-3.1.2-24")
@pytest.mark.parametrize("limits", [Limits(topic_alias=0, inflight=65535)])  # a CONNACK of 5 bytes
def test_a_reason_that_is_too_large_is_not_told(broker: Broker) -> None:
    client = Client(broker)
    client.say(connect("c", props=properties("27 00000004")))
    client.client.refuse(ReasonCode.NOT_AUTHORIZED, "for a reason")
    broker.flush()
    assert client.hear() == b"" and client.closed


@statement("5.0", "MQTT-4.13.2-1")
def test_an_error_that_concerns_one_packet_ends_nothing(broker: Broker, access: FakeAccess) -> None:
    """Section 4.13.2: acknowledgements with 0x80 or above."""
    for action in (Action.PUBLISH, Action.SUBSCRIBE):
        access.deny("user", action, "no/#")
    client = joined(broker)
    assert client.say(publish("no/a", b"x", 1, 1)) == wire("40 03 0001 87")
    assert client.say(publish("no/a", b"x", 2, 2)) == wire("50 03 0002 87")
    assert client.say(packet(0x82, wire("0003 00 0004 6e6f2f61 00"))) == wire("90 04 0003 00 87")
    assert client.say("a2 09 0004 00 0004 6e6f2f61") == wire("b0 04 0004 00 11")
    assert client.say("c0 00") == wire("d0 00") and not client.closed


@statement("5.0", "MQTT-4.13.1-1", "MQTT-3.1.4-1", "MQTT-3.14.0-1")
@pytest.mark.parametrize(
    "data",
    [b"GET / HTTP/1.1\r\n\r\n", bytes.fromhex("160301"), b"\x10\xff\xff\xff\xff\x7f", b"\xff" * 9],
    ids=["HTTP", "TLS", "a CONNECT without end", "noise"],
)
def test_what_is_not_mqtt_is_turned_away(broker: Broker, data: bytes) -> None:
    client = Client(broker)
    assert turned_away(client, data) or (not client.say(bytes(100)) and client.closed)


@statement("5.0", "MQTT-3.1.4-1", "MQTT-3.2.2-8", "MQTT-4.13.1-1")
@pytest.mark.parametrize(
    ("props", "code"), [("21 0000", 0x82), ("11 00000001 11 00000001", 0x82), ("0a 00", 0x81)]
)
def test_what_is_wrong_in_connect_is_told_in_connack_if_at_all(
    broker: Broker, props: str, code: int
) -> None:
    client = Client(broker)
    assert client.say(connect("c", props=properties(props))) in (b"", connack(code))
    assert client.closed


@statement("5.0", "MQTT-4.13.1-1")
@pytest.mark.parametrize("size", [1, 2, 3, 5, 8])
def test_an_error_is_found_however_the_bytes_come(broker: Broker, size: int) -> None:
    watcher, client = joined(broker, "watcher"), joined(broker)
    watcher.subscribe("a")
    data = publish("a", b"1") + wire("c0 00") + wire("82 03 0001 00") + publish("a", b"2")
    heard = b"".join(client.say(data[at : at + size]) for at in range(0, len(data), size))
    assert heard == wire("d0 00") + disconnect(0x82) and client.closed
    assert watcher.hear() == publish("a", b"1")


@statement("5.0", "MQTT-4.13.1-1")
def test_nothing_at_all_is_no_error(broker: Broker) -> None:
    client = joined(broker)
    client.send(b"")
    assert client.say("c0 00") == wire("d0 00")
    assert not is_closed(client, 0x81, "c0")
