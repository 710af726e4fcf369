"""The fake fleet is a good broker unless it is told otherwise, and sees what a link does wrong."""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import AsyncIterator

import pytest
from waiting import PATIENCE, until

from appliance.mqtt.codec import V5, V311, Property
from appliance.mqtt.packets import (
    Connack,
    Connect,
    Disconnect,
    Pingreq,
    Puback,
    Publish,
    Pubrel,
    Subscribe,
    Subscription,
    decode_packet,
)
from upstream import fake_fleet, hostile
from upstream.client import GoneError, MqttClient
from upstream.fake_fleet import FakeFleet, close_at, late, never, refuse, refuse_topic, reversed_in
from upstream.hostile import SCENARIOS


@pytest.fixture
async def fleet() -> AsyncIterator[FakeFleet]:
    async with FakeFleet() as made:
        yield made
    assert not made.errors, made.errors


async def test_it_is_a_good_broker(fleet: FakeFleet) -> None:
    link = await MqttClient.dial(fleet.port, "r2d2", keep_alive=30)
    await link.subscribe("cmd/#", "+/x")
    assert await link.publish("events/1", b"one") == 0
    assert await link.publish("events/2", b"two", 2) == 0
    assert link.publish("events/3", b"three", 0).result() is None
    await link.ping()
    visit = await fleet.visited()
    assert visit.topic(0) == "cmd/x0" and visit.topic(1) == "x1/x"
    visit.message(visit.topic(), b"go")
    visit.message(visit.topic(), b"go", 2)
    await link.wait_for(2)
    await until(lambda: not visit.sent)
    await link.close()
    await until(lambda: visit.ended == "FIN")
    assert fleet.topics == ["events/1", "events/2", "events/3"]
    assert len(visit.pings) == 1 and visit.disconnect is not None and not visit.unacknowledged
    assert not fleet.faults


@pytest.mark.parametrize("version", [V311, V5])
async def test_limits_are_granted_and_watched(version: int) -> None:
    limits = {
        Property.RECEIVE_MAXIMUM: 2,
        Property.MAXIMUM_QOS: 1,
        Property.RETAIN_AVAILABLE: 0,
        Property.MAXIMUM_PACKET_SIZE: 100,
        Property.WILDCARD_SUBSCRIPTION_AVAILABLE: 0,
        Property.SUBSCRIPTION_IDENTIFIER_AVAILABLE: 0,
        Property.SHARED_SUBSCRIPTION_AVAILABLE: 0,
    }
    async with FakeFleet(limits=limits) as fleet:
        fleet.acknowledge = never
        link = await MqttClient.dial(fleet.port, "r2d2", version=version)
        assert link.connack is not None
        assert link.connack.properties == (limits if version == V5 else None)
        identifier = {Property.SUBSCRIPTION_IDENTIFIER: [3]} if version == V5 else None
        link.send(Subscribe(9, [Subscription("$share/g/a/#")], identifier))
        link.publish("a", b"1")
        link.publish("a", b"2")
        link.publish("a", b"3")
        link.publish("a", b"4", 2)
        link.publish("a", b"5", 0, retain=True)
        link.publish("a", bytes(200), 0)
        link.publish("a", b"6", 0, properties={Property.TOPIC_ALIAS: 1})
        await until(lambda: len(fleet.published) == 7)
        link.abort()
    expected = ["a wildcard: $share/g/a/#", "a shared subscription: $share/g/a/#"]
    expected += ["a subscription identifier", *["more than 2 messages in flight"] * 2, "QoS 2"]
    expected += ["a retained message", "a packet of 207 bytes, and 100 are allowed"]
    expected += ["the topic alias 1"]
    assert sorted(fleet.faults) == sorted(expected if version == V5 else [])


@pytest.mark.parametrize(
    ("sent", "fault"),
    [
        ([Connect("again")], "CONNECT twice"),
        ([Connack()], "a client does not send CONNACK"),
        ([Disconnect(), Pingreq()], "PINGREQ after DISCONNECT"),
        ([Puback(5)], "PUBACK for the packet id 5"),
        ([Publish("a", b"1", 1, packet_id=3)] * 2, "the packet id 3 is in use"),
        ([Publish("a", b"1", 1, False, True, 4)], "DUP on a message that was not sent before"),
        ([b"\x00\x00"], "PROTOCOL_ERROR"),
        ([b"\x30\xff\xff\xff\xff\x01"], "five bytes"),
        ([b"\x32\x00"], "MALFORMED_PACKET"),
        ([Publish("a/+", b"1")], "the topic 'a/\\+'"),
    ],
)
async def test_it_sees_what_a_link_does_wrong(fleet: FakeFleet, sent: list, fault: str) -> None:

    fleet.acknowledge = never
    link = await MqttClient.dial(fleet.port, "r2d2")
    link.send(b"".join(p if isinstance(p, bytes) else p.encode(V5) for p in sent))
    await until(lambda: any(re.search(fault, each) for each in fleet.faults), fault)
    link.abort()


async def test_a_packet_before_connect_and_half_of_one(fleet: FakeFleet) -> None:
    _, writer = await asyncio.open_connection("127.0.0.1", fleet.port)
    writer.write(Pingreq().encode(V5) + b"\x30\x10abc")
    await until(lambda: fleet.visits and fleet.visits[0].pings)
    writer.close()
    await until(lambda: len(fleet.faults) == 2)
    assert "before CONNECT" in fleet.faults[0] and "within a packet" in fleet.faults[1]


async def test_keep_alive_is_watched(monkeypatch: pytest.MonkeyPatch, fleet: FakeFleet) -> None:
    monkeypatch.setattr(fake_fleet, "LENIENCE", 0.1)
    fleet.limits = {Property.SERVER_KEEP_ALIVE: 1}
    link = await MqttClient.dial(fleet.port, "r2d2", keep_alive=600)
    await until(lambda: fleet.faults)
    assert "a keep alive of 1 s" in fleet.faults[0]
    link.abort()


async def test_versions_are_refused_as_brokers_do(fleet: FakeFleet) -> None:
    fleet.versions = (V311,)
    link = await MqttClient.dial(fleet.port, refused=True)
    assert link.connack is not None and link.connack.reason_code == 0x84
    fleet.refuses_version = "close"
    with pytest.raises(GoneError):
        await MqttClient.dial(fleet.port)
    fleet.refuses_version = "3.1.1"
    reader, writer = await asyncio.open_connection("127.0.0.1", fleet.port)
    writer.write(Connect("r2d2").encode())
    answer = await asyncio.wait_for(reader.read(), PATIENCE)
    assert decode_packet(answer[0], answer[2:], V311).reason_code == 0x84  # type: ignore[union-attr]
    writer.close()
    link = await MqttClient.dial(fleet.port, version=V311)
    link.abort()


async def test_ways_of_acknowledging(fleet: FakeFleet) -> None:
    link = await MqttClient.dial(fleet.port, "r2d2")
    fleet.acknowledge = refuse(0x97, times=1)
    assert [await link.publish("a"), await link.publish("a")] == [0x97, 0]
    fleet.acknowledge = refuse_topic("bad", 0x90)
    assert [await link.publish("bad"), await link.publish("good")] == [0x90, 0]
    fleet.acknowledge = late(0.05)
    assert await link.publish("a") == 0
    fleet.acknowledge = reversed_in(3)
    order: list[int] = []
    futures = [link.publish("a", b"%d" % number) for number in range(3)]
    for number, future in enumerate(futures):
        future.add_done_callback(lambda _, number=number: order.append(number))
    await asyncio.gather(*futures)
    assert order == [2, 1, 0]
    fleet.acknowledge = close_at("poison", times=1)
    with pytest.raises(GoneError):
        await link.publish("poison")
    link = await MqttClient.dial(fleet.port, "r2d2")
    assert await link.publish("poison") == 0
    assert fleet.visit.writer.get_extra_info("peername") and len(fleet.visits) == 2
    link.abort()


async def test_stopped_and_started_on_the_same_port(fleet: FakeFleet) -> None:
    port = fleet.port
    link = await MqttClient.dial(port, "r2d2")
    await fleet.stop()
    await asyncio.wait_for(link.closed.wait(), PATIENCE)
    with pytest.raises(ConnectionRefusedError):
        await MqttClient.dial(port)
    await fleet.start()
    link = await MqttClient.dial(port, "r2d2")
    link.abort()


async def be_a_patient_link(port: int, done) -> None:
    """Do what a link does, whatever comes, and read all of it."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    properties = {Property.RECEIVE_MAXIMUM: 100, Property.MAXIMUM_PACKET_SIZE: 1 << 20}
    writer.write(Connect("r2d2", keep_alive=30, properties=properties).encode())
    read = asyncio.create_task(reader.read(10))
    await asyncio.wait([read], timeout=0.05)
    with contextlib.suppress(ConnectionError):
        subscribe = Subscribe(1, [Subscription("fleet/r2d2/cmd/#", 1)])
        publish = Publish("fleet/r2d2/event", b"x", 1, packet_id=2)
        writer.write(b"".join(each.encode(V5) for each in (subscribe, publish, Pingreq())))
        await until(done)
        for packet_id in range(1, 300):
            writer.write(Puback(packet_id).encode(V5) + Pubrel(packet_id).encode(V5))
        await writer.drain()
        await read
        while await asyncio.wait_for(reader.read(1 << 20), 0.3):
            pass
    writer.close()


@pytest.mark.parametrize("name", SCENARIOS)
async def test_each_misdeed_happens(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hostile, "FLOOD", 0.05)
    monkeypatch.setattr(hostile, "MANY", 2000)
    scenario = SCENARIOS[name]
    async with FakeFleet() as fleet:
        scenario.prepare(fleet)
        with contextlib.suppress(asyncio.TimeoutError, ConnectionError):
            await be_a_patient_link(fleet.port, lambda: scenario.done(fleet))
        assert scenario.done(fleet) and scenario.text.endswith((".", ")"))
    assert not fleet.errors, fleet.errors


async def test_a_link_that_does_not_do_its_duty_is_told(fleet: FakeFleet) -> None:
    scenario = SCENARIOS["connack-twice"]
    scenario.prepare(fleet)
    _, writer = await asyncio.open_connection("127.0.0.1", fleet.port)
    writer.write(Connect("r2d2").encode())
    await until(lambda: scenario.done(fleet), "the misdeed")
    with pytest.raises(AssertionError, match="CONNACK comes once more"):
        await scenario.outcome(fleet, patience=0.3)
    writer.close()
    await scenario.outcome(fleet)
