"""MQTT 5.0 on the wire of a running appliance: transports, and connections that are closed."""

from __future__ import annotations

import time

import pytest
from client_v5 import Dial, connack, connect, disconnect, properties, publish, wire
from raw_client import RawClient
from waiting import PATIENCE

from appliance.mqtt.packets import Puback, Publish, Subscribe, Subscription, Will

statement = pytest.mark.statement


@pytest.fixture
def version() -> int:
    return 5


def joined(dial: Dial, client_id: str, user: str = "alice", **fields: object) -> RawClient:
    client = dial()
    assert client.connect(client_id, user, **fields)[:4] == wire("20 09 00 00")  # type: ignore[arg-type]
    return client


# --- 4.2 the transport


@statement("5.0", "MQTT-4.2.0-1", "MQTT-4.6.0-5")
def test_what_is_sent_arrives_whole_and_in_order(dial: Dial, name: str, topic: str) -> None:
    receiver, sender = joined(dial, f"{name}-receiver"), joined(dial, f"{name}-sender")
    receiver.send(Subscribe(1, [Subscription(topic, 1)]))
    assert receiver.receive() == wire("90 04 0001 00 01")
    sizes = [0, 1, 3_000_000, 127, 128, 16_384, 700_000, 5]
    for n, size in enumerate(sizes, 1):
        payload = bytes([n]) * size
        sender.send(Publish(topic, payload, 1, packet_id=n))
        packet = receiver.decode(receiver.receive())
        assert isinstance(packet, Publish) and packet.packet_id is not None
        assert packet.payload == payload
        receiver.send(Puback(packet.packet_id))
        assert sender.receive() == bytes((0x40, 2, 0, n))


@statement("5.0", "MQTT-4.2.0-1")
def test_bytes_may_come_one_by_one_or_all_together(dial: Dial, name: str, topic: str) -> None:
    client = dial()
    data = client.connect_packet(name)
    data += Subscribe(1, [Subscription(topic)]).encode(5) + publish(topic, b"x") + wire("c0 00")
    for byte in data:
        client.socket.sendall(bytes((byte,)))
    assert client.receive()[:4] == wire("20 09 00 00")
    assert client.receive() == wire("90 04 0001 00 00")
    assert client.receive() == publish(topic, b"x")
    assert client.receive() == wire("d0 00")
    client.socket.sendall(publish(topic, b"y") * 500 + wire("c0 00"))
    for _ in range(500):
        assert client.receive() == publish(topic, b"y")
    assert client.receive() == wire("d0 00")


# --- connections that are closed


@statement("5.0", "MQTT-3.1.0-1", "MQTT-3.1.4-1", "MQTT-3.14.0-1", "MQTT-4.13.1-1")
@pytest.mark.parametrize(
    "first", ["c0 00", "e0 00", "30 05 0001 61 00 78", "10 00", "f0 00", "00 00"]
)
def test_what_is_no_connect_is_hung_up_upon(dial: Dial, first: str) -> None:
    client = dial()
    client.socket.sendall(wire(first))
    assert client.receive() == b""


@statement("5.0", "MQTT-3.1.4-2", "MQTT-3.1.4-6", "MQTT-3.2.2-7", "MQTT-4.13.2-1")
def test_a_wrong_password_is_refused_and_hung_up_upon(dial: Dial, name: str) -> None:
    client = dial()
    client.socket.sendall(client.connect_packet(name, "alice", "wrong") + wire("c0 00"))
    assert client.receive() == connack(0x87)
    assert client.receive() == b""


@statement("5.0", "MQTT-4.12.0-1", "MQTT-4.13.2-1")
def test_an_unknown_method_is_refused_and_hung_up_upon(dial: Dial, name: str) -> None:
    client = dial()
    client.socket.sendall(connect(name, props=properties("15 0004 4e4f4e45")))
    assert client.receive() in (connack(0x8C), connack(0x87))
    assert client.receive() == b""


@statement("5.0", "MQTT-3.1.0-2", "MQTT-3.14.4-2", "MQTT-4.13.1-1", "MQTT-4.13.2-1")
@pytest.mark.parametrize(
    ("data", "code"),
    [
        (connect("again"), 0x82),
        (wire("82 03 0001 00"), 0x82),
        (wire("82 02 0001"), 0x81),
        (publish("a", props=properties("23 0fff")), 0x94),
    ],
    ids=["a second CONNECT", "a protocol error", "a malformed packet", "an alias too high"],
)
def test_an_error_is_told_and_hung_up_upon(dial: Dial, name: str, data: bytes, code: int) -> None:
    client = joined(dial, name)
    client.socket.sendall(data + wire("c0 00"))
    assert client.receive() == disconnect(code)
    assert client.receive() == b""


@statement("5.0", "MQTT-3.1.4-3", "MQTT-4.13.2-1")
def test_who_is_taken_over_is_told_and_hung_up_upon(dial: Dial, name: str) -> None:
    before = joined(dial, name)
    now = joined(dial, name)
    assert before.receive() == disconnect(0x8E)
    assert before.receive() == b""
    now.drain()


@statement("5.0", "MQTT-3.14.4-3", "MQTT-3.14.4-1")
def test_after_disconnect_the_server_closes_and_publishes_no_will(
    dial: Dial, name: str, topic: str
) -> None:
    watcher = joined(dial, f"{name}-watcher", "bob")
    watcher.send(Subscribe(1, [Subscription(topic)]))
    assert watcher.receive() == wire("90 04 0001 00 00")
    client = joined(dial, name, will=Will(topic, b"gone"))
    client.socket.sendall(publish(topic, b"x") + wire("e0 00") + publish(topic, b"y"))
    assert client.receive() == b""
    assert watcher.receive() == publish(topic, b"x")
    assert watcher.drain() == []


@statement("5.0", "MQTT-3.1.2-22", "MQTT-3.1.2-8")
def test_one_and_a_half_keep_alive_of_silence(dial: Dial, name: str, topic: str) -> None:
    watcher = joined(dial, f"{name}-watcher", "bob")
    watcher.send(Subscribe(1, [Subscription(topic)]))
    assert watcher.receive() == wire("90 04 0001 00 00")
    began = time.monotonic()
    client = joined(dial, name, keep_alive=1, will=Will(topic, b"gone"))
    assert client.receive() == disconnect(0x8D)
    assert client.receive() == b""
    assert 1.4 < time.monotonic() - began < PATIENCE
    assert watcher.receive() == publish(topic, b"gone")
