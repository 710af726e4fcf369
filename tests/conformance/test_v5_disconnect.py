"""MQTT 5.0, sections 3.12 to 3.14: PINGREQ, PINGRESP, DISCONNECT."""

from __future__ import annotations

import pytest
from broker.conftest import lasting
from client_v5 import (
    ACCEPTED,
    CLEAN_START,
    SESSION_PRESENT,
    WILL,
    Client,
    connect,
    disconnect,
    is_closed,
    joined,
    properties,
    publish,
    wire,
)

from appliance.broker.broker import Broker
from appliance.broker.limits import Features, Limits
from appliance.mqtt.packets import Will
from appliance.mqtt.reason import ReasonCode

statement = pytest.mark.statement

# --- 3.12


@statement("5.0", "MQTT-3.12.4-1")
@pytest.mark.parametrize("count", [1, 3])
def test_pingreq_is_answered(broker: Broker, count: int) -> None:
    assert joined(broker).say(*["c0 00"] * count) == wire("d0 00") * count


@statement("5.0", "MQTT-4.13.1-1")
@pytest.mark.parametrize("data", ["c0 01 00", "c0 02 00 00"])
def test_a_pingreq_with_something_in_it_is_malformed(broker: Broker, data: str) -> None:
    assert is_closed(joined(broker), 0x81, data)


@statement("5.0", "MQTT-4.13.1-1")
@pytest.mark.parametrize(
    "data",
    ["20 03 00 00 00", "90 04 0001 00 00", "b0 04 0001 00 00", "d0 00"],
    ids=["CONNACK", "SUBACK", "UNSUBACK", "PINGRESP"],
)
def test_what_only_a_server_sends_breaks_the_protocol(broker: Broker, data: str) -> None:
    client = joined(broker)
    assert client.say(data) == disconnect(0x82) and client.closed


# --- 3.14 a client's DISCONNECT

CODES = {0x00, 0x04, *range(0x80, 0x84), 0x90, *range(0x93, 0x9A)}
#: Codes that section 3.14.2.1 gives to the server alone.
SERVERS = {0x87, 0x89, 0x8B, 0x8D, 0x8E, 0x8F, *range(0x9A, 0xA3)}


@statement("5.0", "MQTT-3.14.2-1", "MQTT-3.14.4-3")
def test_the_reason_codes_of_disconnect(broker: Broker) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("w")
    for code in set(range(256)) - SERVERS:
        client = Client(broker)
        client.log_in(connect("c", b"\0", "w", "gone", flags=CLEAN_START | WILL))
        heard = client.say(bytes((0xE0, 1, code)))
        assert client.closed
        # 0x8C is in the table of section 2.4 for DISCONNECT, and not in that of 3.14.2.1.
        if code in CODES or code == 0x8C:
            assert heard == b"", f"0x{code:02x}"
        else:
            assert heard in (b"", disconnect(0x81), disconnect(0x82)), f"0x{code:02x}"
        assert watcher.hear() == (publish("w", b"gone") if code else b"")


@statement("5.0", "MQTT-3.14.4-1", "MQTT-3.14.4-2", "MQTT-3.14.4-3")
@pytest.mark.parametrize("goodbye", ["e0 00", "e0 01 00", "e0 02 00 00", "e0 01 04", "e0 01 80"])
def test_behind_disconnect_nothing_is_done(broker: Broker, goodbye: str) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("#")
    client = joined(broker)
    heard = client.say(publish("a", b"1"), goodbye, publish("a", b"2"), "c0 00", connect("c"))
    assert heard == b"" and client.closed
    assert client.say(publish("a", b"3")) == b""
    assert watcher.hear() == publish("a", b"1")


@statement("5.0", "MQTT-4.13.1-1")
@pytest.mark.parametrize(
    ("data", "code"),
    [
        ("e0 02 00 05", 0x81),
        ("e0 03 00 00 00", 0x81),
        ("e0 04 00 02 2100", 0x81),
        ("e0 07 00 05 21 0005 21 00", 0x81),
        ("e0 0c 00 0a 11 00000000 11 00000000", 0x82),
        ("e0 08 00 06 1f 0000 1f 0000", 0x82),
    ],
    ids=[
        "properties longer than the packet",
        "a byte too many",
        "cut in a property",
        "a property of CONNECT",
        "two expiry intervals",
        "two reason strings",
    ],
)
def test_a_disconnect_that_is_wrong(broker: Broker, data: str, code: int) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("w")
    client = joined(broker, will=Will("w", b"gone"), **lasting(5))
    assert is_closed(client, code, data)
    assert watcher.hear() == publish("w", b"gone"), "this was no normal disconnection"


@statement("5.0", "MQTT-3.1.2-23", "MQTT-4.1.0-2")
@pytest.mark.parametrize(
    ("interval", "kept_until"), [(0, 0), (10, 10), (200, 200), (0xFFFFFFFF, 1000)]
)
@pytest.mark.parametrize("limits", [Limits(session_expiry=1000)])
def test_disconnect_may_change_the_expiry(broker: Broker, interval: int, kept_until: int) -> None:
    """Section 3.14.2.2.2."""

    def leave() -> None:
        client = joined(broker, **lasting(5, 100))
        told = properties(b"\x11" + interval.to_bytes(4, "big"))
        assert client.say(bytes((0xE0, 1 + len(told), 0)) + told) == b"" and client.closed

    for wait, answer in ((kept_until - 1, SESSION_PRESENT), (kept_until, ACCEPTED)):
        leave()
        if wait >= 0:
            broker.tick(broker.now + wait)
            client = Client(broker)
            assert client.log_in(connect("client", flags=0)) == answer
            client.lose()


@statement("5.0", "MQTT-4.13.1-1")
@pytest.mark.parametrize("given", [b"\0", properties("11 00000000")], ids=["absent", "0"])
def test_an_expiry_in_disconnect_needs_one_in_connect(broker: Broker, given: bytes) -> None:
    """Section 3.14.2.2.2: a Protocol Error, when it was 0."""
    client = Client(broker)
    client.log_in(connect("c", props=given))
    assert client.say("e0 07 00 05 11 00000001") == disconnect(0x82) and client.closed
    client = Client(broker)
    client.log_in(connect("c", props=given))
    assert client.say("e0 07 00 05 11 00000000") == b"" and client.closed


# --- 3.14 the server's DISCONNECT


@statement(
    "5.0",
    "MQTT-3.14.2-1",
    "MQTT-3.14.2-2",
    "MQTT-3.14.4-1",
    "MQTT-3.14.4-2",
    "MQTT-4.13.2-1",
)
@pytest.mark.parametrize("words", [False, True], ids=["plain", "with reason strings"])
def test_a_server_says_why_and_closes(broker: Broker, words: bool) -> None:
    broker.features = Features(reason_strings=words)
    heard: list[Client] = []
    for data in (
        wire("82 02 0001"),
        wire("82 03 0001 00"),
        publish("a", props=properties("23 0063")),
    ):
        client = joined(broker, "c", **lasting(5))
        client.send(data, wire("c0 00"))
        heard.append(client)
    silent = joined(broker, "silent", keep_alive=1, **lasting(5))
    broker.tick(broker.now + 2)
    heard.append(silent)
    robbed = joined(broker, "robbed", **lasting(5))
    joined(broker, "robbed", **lasting(5))
    heard.append(robbed)
    stopped = joined(broker, "stopped", **lasting(5))
    stopped.session.close_link(ReasonCode.SERVER_SHUTTING_DOWN, "stopping")
    broker.flush()
    heard.append(stopped)
    codes = []
    for client in heard:
        assert client.closed
        data = client.hear()
        assert data[0] == 0xE0 and data[1] == len(data) - 2, "one packet, and the last"
        codes.append(data[2])
        if words:
            assert data[3:5] in (b"", bytes((len(data) - 4, 0x1F))), "a reason string, or nothing"
        else:
            assert data == disconnect(data[2])
    assert codes == [0x81, 0x82, 0x94, 0x8D, 0x8E, 0x8B]


@statement("5.0", "MQTT-3.14.4-1", "MQTT-3.14.4-2")
def test_behind_a_servers_disconnect_nothing_is_sent_or_done(broker: Broker) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("#")
    client = joined(broker)
    client.subscribe("a")
    assert client.say("c0 00", "82 02 0001", publish("b", b"x"), "c0 00") == wire("d0 00 e0 01 81")
    joined(broker, "sender").publish("a", b"x")
    assert client.hear() == b""
    assert watcher.hear() == publish("a", b"x")
