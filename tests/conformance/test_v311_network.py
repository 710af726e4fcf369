"""MQTT 3.1.1 on the wire of a running appliance: connections that close, silence, transports."""

from __future__ import annotations

import time

import pytest
from client_v311 import CLEAN_SESSION, PASSWORD, USER_NAME, Dial, connect, field, packet, wire
from raw_client import RawClient
from waiting import PATIENCE

from appliance.mqtt.packets import Publish, Subscribe, Subscription, Will

statement = pytest.mark.statement


@pytest.fixture
def version() -> int:
    return 4


def say(client: RawClient, *packets: bytes | str) -> None:
    client.socket.sendall(b"".join(map(wire, packets)))


def joined(dial: Dial, client_id: str, **fields: object) -> RawClient:
    """alice, who was let in."""
    client = dial()
    assert client.connect(client_id, **fields) == wire("20 02 00 00")  # type: ignore[arg-type]
    return client


def as_alice(client: RawClient, client_id: str, *fields: str, level: int = 4) -> bytes:
    """CONNECT of alice with her password."""
    flags = CLEAN_SESSION | USER_NAME | PASSWORD
    return connect(
        client_id, *fields, "alice", client.broker.passwords["alice"], flags=flags, level=level
    )


# --- connections that close


@statement("3.1.1", "MQTT-3.1.0-1", "MQTT-3.1.4-1", "MQTT-4.8.0-1")
@pytest.mark.parametrize(
    "first",
    ["c0 00", "e0 00", "30 04 0001 61 78", "10 00", "11 0c 0004 4d515454 04 02 0000 0000", "00 00"],
)
def test_what_is_no_connect_is_hung_up_upon(dial: Dial, first: str) -> None:
    client = dial()
    say(client, first)
    assert client.receive() == b""


@statement("3.1.1", "MQTT-3.1.2-3", "MQTT-3.1.4-1")
def test_the_reserved_connect_flag_is_hung_up_upon(dial: Dial, name: str) -> None:
    client = dial()
    say(client, as_alice(client, name).replace(b"\4\xc2", b"\4\xc3", 1))
    assert client.receive() == b""


@statement("3.1.1", "MQTT-2.2.2-2", "MQTT-3.1.0-2", "MQTT-3.3.1-4", "MQTT-4.8.0-1")
@pytest.mark.parametrize(
    "wrong",
    ["c1 00", "36 06 0001 61 0001 78", "60 02 0001", "80 06 0001 0001 61 00", "CONNECT", "d0 00"],
)
def test_a_violation_is_hung_up_upon(dial: Dial, name: str, wrong: str) -> None:
    client = joined(dial, name)
    say(client, "c0 00")
    assert client.receive() == wire("d0 00")
    say(client, as_alice(client, name) if wrong == "CONNECT" else wrong)
    assert client.receive() == b""


@statement("3.1.1", "MQTT-3.1.2-2", "MQTT-3.2.2-5")
def test_an_unsupported_level_is_told_and_hung_up_upon(dial: Dial, name: str) -> None:
    client = dial()
    say(client, as_alice(client, name, level=6))
    assert client.receive() == wire("20 02 00 01")
    assert client.receive() == b""


@statement("3.1.1", "MQTT-3.1.3-8", "MQTT-3.2.2-5")
def test_no_client_id_for_a_stored_session_is_told_and_hung_up_upon(dial: Dial) -> None:
    client = dial()
    assert client.connect("", clean=False) == wire("20 02 00 02")
    assert client.receive() == b""


@statement("3.1.1", "MQTT-3.1.4-2")
def test_the_connection_that_is_taken_over_is_hung_up(dial: Dial, name: str) -> None:
    first = joined(dial, name)
    second = joined(dial, name)
    assert first.receive() == b""
    say(second, "c0 00")
    assert second.receive() == wire("d0 00")


@statement("3.1.1", "MQTT-3.14.4-3")
def test_disconnect_is_hung_up_upon_without_the_will(dial: Dial, name: str, topic: str) -> None:
    watcher = joined(dial, f"watcher-{name}")
    watcher.send(Subscribe(1, [Subscription(topic)]))
    assert watcher.receive() == wire("90 03 0001 00")
    client = joined(dial, name, will=Will(topic, b"gone"))
    say(client, "e0 00")
    assert client.receive() == b""
    assert watcher.drain() == []


# --- silence


@statement("3.1.1", "MQTT-3.1.2-24", "MQTT-3.1.2-8")
def test_who_is_silent_is_hung_up_upon(dial: Dial, name: str, topic: str) -> None:
    watcher = joined(dial, f"watcher-{name}")
    watcher.send(Subscribe(1, [Subscription(topic)]))
    assert watcher.receive() == wire("90 03 0001 00")
    before = time.monotonic()
    client = joined(dial, name, keep_alive=1, will=Will(topic, b"gone"))
    assert client.receive() == b""
    assert 1.4 < time.monotonic() - before < PATIENCE
    assert watcher.receive() == packet(0x30, field(topic), b"gone")


# --- transports


@statement("3.1.1", "MQTT-7.1.1-1")
def test_the_stream_is_ordered_and_lossless_both_ways(dial: Dial, name: str, topic: str) -> None:
    client = joined(dial, name)
    client.send(Subscribe(1, [Subscription(topic)]))
    assert client.receive() == wire("90 03 0001 00")
    sizes = [0, 1, 126, 127, 128, 16_383, 16_384, 100_000, 300_000, 5] * 3
    messages = [bytes((number,)) * size for number, size in enumerate(sizes)]
    for start in range(0, len(messages), 10):
        batch = messages[start : start + 10]
        client.send(*[Publish(topic, payload) for payload in batch])
        for payload in batch:
            assert client.receive() == packet(0x30, field(topic), payload)


@statement("3.1.1", "MQTT-7.1.1-1")
def test_packets_may_come_byte_by_byte(dial: Dial, name: str, topic: str) -> None:
    client = dial()
    data = as_alice(client, name)
    data += packet(0x82, b"\0\1", field(topic), b"\1") + packet(0x32, field(topic), b"\0\2", b"x")
    for byte in data:
        client.socket.sendall(bytes((byte,)))
    assert client.receive() == wire("20 02 00 00")
    assert client.receive() == wire("90 03 0001 01")
    assert sorted([client.receive(), client.receive()]) == [
        packet(0x32, field(topic), b"\0\1", b"x"),
        wire("40 02 0002"),
    ]
