"""MQTT 5.0, section 3.2: CONNACK."""

from __future__ import annotations

import pytest
from broker.conftest import lasting
from client_v5 import (
    ACCEPTED,
    CLEAN_START,
    SESSION_PRESENT,
    Client,
    connack,
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
from appliance.broker.limits import Features, Limits
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import decode_packet
from appliance.mqtt.reason import ReasonCode

P = Property
statement = pytest.mark.statement

# --- 3.2.0


@statement("5.0", "MQTT-3.2.0-1", "MQTT-3.2.2-3")
def test_connack_is_the_first_packet_to_a_session_that_goes_on(broker: Broker) -> None:
    client = joined(broker, "c", **lasting(5))
    client.subscribe("a", 2)
    client.lose()
    joined(broker, "sender").publish("a", b"x", 2)
    again = Client(broker)
    again.say(connect("c", flags=0))
    joined(broker, "other").publish("a", b"y", 1)
    assert again.hear() == b""  # and nothing before it is known who that is
    again.user = "user"
    again.let_in()
    assert again.hear() == SESSION_PRESENT + publish("a", b"x", 2, 1) + publish("a", b"y", 1, 2)


@statement("5.0", "MQTT-3.2.0-2")
def test_there_is_one_connack(broker: Broker) -> None:
    client = Client(broker)
    assert client.log_in(connect("c")) == ACCEPTED
    client.let_in()
    assert client.hear() == b""
    assert client.say(connect("c")) == disconnect(0x82)
    client.let_in()
    assert client.hear() == b""


@statement("5.0", "MQTT-3.2.0-2", "MQTT-3.2.2-7", "MQTT-3.14.4-1")
def test_behind_a_refusal_there_is_nothing(broker: Broker) -> None:
    client = Client(broker)
    client.say(connect("c"))
    client.client.refuse(ReasonCode.QUOTA_EXCEEDED, "for a reason")
    broker.flush()
    assert client.hear() == connack(0x97) and client.closed
    client.let_in()
    assert client.say(connect("c"), "c0 00") == b""
    assert broker.sessions == {}


# --- 3.2.2.1 flags


@statement("5.0", "MQTT-3.2.2-1", "MQTT-3.2.2-2", "MQTT-3.2.2-3")
@pytest.mark.parametrize("clean", [True, False], ids=["clean start", "no clean start"])
@pytest.mark.parametrize("before", ["none", "kept", "ended", "expired"])
def test_session_present(broker: Broker, clean: bool, before: str) -> None:
    if before != "none":
        client = joined(broker, "c", **lasting(5, 0 if before == "ended" else 100))
        client.lose()
    if before == "expired":
        broker.tick(broker.now + 100)
    answer = Client(broker).log_in(connect("c", flags=CLEAN_START if clean else 0))
    assert answer == (SESSION_PRESENT if before == "kept" and not clean else ACCEPTED)


@statement("5.0", "MQTT-3.2.2-3", "MQTT-3.1.4-3", "MQTT-4.1.0-2")
@pytest.mark.parametrize(("seconds", "answer"), [(0, ACCEPTED), (100, SESSION_PRESENT)])
def test_a_session_that_ends_with_its_connection_is_not_taken_over(
    broker: Broker, seconds: int, answer: bytes
) -> None:
    """Section 3.1.4: with an expiry interval of 0 it ends at the take-over."""
    before = joined(broker, "c", **lasting(5, seconds))
    before.subscribe("a")
    client = Client(broker)
    assert client.log_in(connect("c", flags=0)) == answer
    assert before.hear() == disconnect(0x8E)
    joined(broker, "sender").publish("a", b"x")
    assert client.hear() == (publish("a", b"x") if seconds else b"")


# --- 3.2.2.2 reason codes


@statement("5.0", "MQTT-3.2.2-6", "MQTT-3.2.2-7", "MQTT-3.2.2-8", "MQTT-4.13.2-1")
@pytest.mark.parametrize(
    "code",
    [
        *(0x80, 0x83, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8A, 0x8C),
        *(0x95, 0x97, 0x99, 0x9C, 0x9D, 0x9F),
    ],
)
def test_a_refusal_has_its_reason_and_no_session(broker: Broker, code: int) -> None:
    before = joined(broker, "c", **lasting(5))
    before.lose()
    client = Client(broker)
    client.say(connect("c", flags=0))
    client.client.refuse(ReasonCode(code), "for a reason")
    broker.flush()
    assert client.hear() == connack(code) and client.closed


@statement("5.0", "MQTT-3.2.2-8", "MQTT-3.2.2-6", "MQTT-3.2.2-7")
@pytest.mark.parametrize("limits", [Limits(sessions=1)])
def test_a_server_that_is_full_says_so(broker: Broker) -> None:
    joined(broker, "first")
    client = Client(broker)
    assert client.log_in(connect("second")) == connack(0x97) and client.closed


# --- 3.2.2.3 properties


def says(answer: bytes, expected: bytes) -> bool:
    """Whether both are the same CONNACK, in whatever order their properties are."""
    assert answer[0] == 0x20 and answer[1] == len(answer) - 2
    return decode_packet(0x20, answer[2:], 5) == decode_packet(0x20, expected[2:], 5)


@pytest.mark.parametrize(
    ("limits", "asked", "told"),
    [
        (Limits(), {}, "22 000a 21 0014"),
        (Limits(topic_alias=0), {}, "21 0014"),
        (Limits(topic_alias=65535, inflight=1), {}, "22 ffff 21 0001"),
        (Limits(inflight=65535), {}, "22 000a"),
        (Limits(packet_size=1000), {}, "22 000a 27 000003e8 21 0014"),
        (Limits(keep_alive=30), {"keep_alive": 60}, "13 001e 22 000a 21 0014"),
        (Limits(keep_alive=30), {"keep_alive": 0}, "13 001e 22 000a 21 0014"),
        (Limits(keep_alive=30), {"keep_alive": 30}, "22 000a 21 0014"),
        (Limits(session_expiry=9), {"props": "11 0000000a"}, "22 000a 11 00000009 21 0014"),
        (Limits(session_expiry=9), {"props": "11 00000009"}, "22 000a 21 0014"),
    ],
    ids=[
        "defaults",
        "no aliases",
        "all aliases",
        "the largest Receive Maximum",
        "packet size",
        "keep alive",
        "keep alive instead of none",
        "keep alive as asked",
        "session expiry",
        "session expiry as asked",
    ],
)
@statement("5.0", "MQTT-3.2.0-1", "MQTT-3.2.2-22")
def test_what_is_other_than_asked_or_assumed_is_told(
    broker: Broker, asked: dict[str, object], told: str
) -> None:
    options = {**asked, "props": properties(asked.get("props", ""))}
    answer = Client(broker).log_in(connect("c", **options))  # type: ignore[arg-type]
    assert says(answer, packet(0x20, b"\0\0", properties(told)))


@statement("5.0", "MQTT-3.2.2-16")
def test_an_assigned_identifier_is_no_other_sessions(broker: Broker) -> None:
    joined(broker, "absent", **lasting(5)).lose()
    names = {"absent"}
    for _ in range(50):
        client = Client(broker)
        answer = client.connect("")
        assert answer.properties is not None
        name = answer.properties[P.ASSIGNED_CLIENT_IDENTIFIER]
        assert isinstance(name, str) and name not in names
        names.add(name)
    assert set(broker.sessions) == names


@statement("5.0", "MQTT-3.2.2-15")
@pytest.mark.parametrize("limits", [Limits(packet_size=1000)])
@pytest.mark.parametrize("cut", [3, 20, 1001], ids=["header", "beginning", "whole"])
def test_a_packet_larger_than_the_maximum_is_refused(broker: Broker, cut: int) -> None:
    """Section 3.2.2.3.6: 0x95; and no more than its header is needed for that."""
    watcher = joined(broker, "watcher")
    watcher.subscribe("a")
    client = joined(broker)
    assert client.say(publish("a", bytes(993))) == b""
    assert watcher.hear() == publish("a", bytes(993))
    assert client.say(publish("a", bytes(994))[:cut]) == disconnect(0x95) and client.closed
    assert watcher.hear() == b""


@statement("5.0", "MQTT-3.2.2-17", "MQTT-3.3.2-9")
@pytest.mark.parametrize("limits", [Limits(topic_alias=3)])
@pytest.mark.parametrize("alias", ["0004", "000a", "ffff"])
@pytest.mark.parametrize("topic", ["a", ""])
def test_an_alias_above_the_maximum_is_refused(broker: Broker, alias: str, topic: str) -> None:
    """Section 3.3.2.3.4: 0x94."""
    watcher = joined(broker, "watcher")
    watcher.subscribe("a")
    client = joined(broker)
    data = publish(topic, b"x", props=properties(f"23 {alias}"))
    assert client.say(data) == disconnect(0x94) and client.closed
    assert watcher.hear() == b""


@statement("5.0", "MQTT-3.2.2-18")
@pytest.mark.parametrize("limits", [Limits(topic_alias=0)])
def test_without_a_maximum_every_alias_is_refused(broker: Broker) -> None:
    client = Client(broker)
    assert client.log_in(connect("c")) == wire("20 06 00 00 03 21 0014")
    assert client.say(publish("a", props=properties("23 0001"))) == disconnect(0x94)
    assert client.closed


@statement("5.0", "MQTT-3.2.2-19", "MQTT-3.2.2-20")
def test_a_refusal_too_large_for_the_client_has_no_words(broker: Broker) -> None:
    broker.features = Features(reason_strings=True)
    client = Client(broker)
    client.say(connect("c", props=properties("27 00000005")))
    client.client.refuse(ReasonCode.NOT_AUTHORIZED, "for a reason")
    broker.flush()
    assert client.hear() == connack(0x87) and client.closed


@statement("5.0", "MQTT-3.2.2-22", "MQTT-3.1.2-22")
@pytest.mark.parametrize("limits", [Limits(keep_alive=100)])
@pytest.mark.parametrize(
    ("asked", "answer", "counts"),
    [(10, ACCEPTED, 10), (500, wire("20 0c 00 00 09 13 0064 22 000a 21 0014"), 100)],
    ids=["the client's", "the server's"],
)
def test_the_keep_alive_that_counts(broker: Broker, asked: int, answer: bytes, counts: int) -> None:
    client = Client(broker)
    assert says(client.log_in(connect("c", keep_alive=asked)), answer)
    broker.tick(broker.now + 1.5 * counts - 1)
    assert not client.closed
    broker.tick(broker.now + 2)
    assert client.hear() == disconnect(0x8D) and client.closed


@statement("5.0", "MQTT-3.2.2-20", "MQTT-3.1.2-29")
def test_connack_has_no_user_properties_and_no_method_unasked(broker: Broker) -> None:
    broker.features = Features(reason_strings=True)
    said = b"\x26" + field("a") + field("b")
    assert Client(broker).log_in(connect("c", props=properties(said))) == ACCEPTED
