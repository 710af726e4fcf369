"""The link with real brokers of others: what each can carry, both ways, and their ends."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from appliance_process import free_ports
from harness import Peer
from waiting import until

from appliance.mqtt.codec import V5, V311, Properties, Property
from appliance.mqtt.packets import Puback, Pubcomp, Publish, Pubrec, Pubrel, Suback, Subscribe
from appliance.mqtt.packets import Subscription as Filter
from appliance.upstream import backoff, unanswered
from upstream.client import MqttClient
from upstream.peers import (
    HOST,
    LIMITED,
    PASSWORD,
    USER,
    Ejabberd,
    FleetMosquitto,
    RabbitCluster,
    RabbitMQ,
)
from upstream.uplink_rig import Rig, hurry, running
from upstream.uplink_rig import event_loop_policy as event_loop_policy

pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')

RULES = [{"topic": "cmd/#"}, {"topic": "mode"}, {"topic": "reset/_call/#"}]


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch)


def link(
    directory: Path, *ports: int, user: str = USER, password: str = PASSWORD, **more: Any
) -> Rig:
    """An appliance with a link to brokers at these ports."""
    secret = directory / "fleet.password"
    secret.touch(0o600)
    secret.write_text(password)
    section: dict[str, Any] = {
        "servers": [f"mqtt://{HOST}:{port}" for port in ports],
        "login": {"username": user, "password_file": str(secret)},
        "in": RULES,
    }
    return Rig(directory / "here", 0, **(section | more))


async def publish(
    rig: Rig, topic: str, payload: bytes, qos: int = 1, *, retain: bool = False
) -> None:
    """As a local client; it is acknowledged when this returns."""
    peer = await rig.client("publisher")
    await peer.send(Publish(topic, payload, qos, retain, False, 1 if qos else None))
    if qos:
        answer = await peer.receive()
        if qos == 2:
            await peer.send(Pubrel(1))
            answer = await peer.receive()
        assert isinstance(answer, Puback | Pubcomp) and answer.reason_code < 0x80
    peer.hang_up()


async def local(rig: Rig, *filters: str) -> Peer:
    peer = await rig.client("reader")
    await peer.send(Subscribe(1, [Filter(each, 2) for each in filters]))
    assert isinstance(await peer.receive(), Suback)
    return peer


async def next_message(peer: Peer) -> Publish:
    """The next one, acknowledged."""
    while True:
        packet = await peer.receive()
        if isinstance(packet, Publish):
            if packet.qos == 2:
                await peer.send(Pubrec(packet.packet_id or 0))
            elif packet.qos:
                await peer.send(Puback(packet.packet_id or 0))
            return packet
        if isinstance(packet, Pubrel):
            await peer.send(Pubcomp(packet.packet_id))


def came(client: MqttClient, topic: str) -> list[bytes]:
    return [packet.payload for _, packet in client.messages if packet.topic == topic]


@contextlib.asynccontextmanager
async def operator(port: int, version: int, name: str = "operator") -> AsyncIterator[MqttClient]:
    client = await MqttClient.dial(port, name, version=version)
    try:
        yield client
    finally:
        client.abort()


async def carries_both_ways(rig: Rig, port: int, version: int) -> None:
    """Each QoS, retained messages and a call, by a client there that speaks `version`."""
    async with operator(port, version) as there:
        await there.subscribe("fleet/r2d2/#", "answers/#")
        await publish_retained_there(there)
        async with running(rig):
            await until(lambda: came(there, "fleet/r2d2/_appliance/state") == [b"online"])
            await _goes_out(rig, there, port, version)
            await _comes_in(rig, there)
            await _is_called(rig, there, version)
            assert not rig.status().set_aside and not rig.status().refused_filters
        await until(lambda: came(there, "fleet/r2d2/_appliance/state") == [b"online", b"offline"])


async def publish_retained_there(there: MqttClient) -> None:
    await there.publish("fleet/r2d2/mode", b"manual", retain=True)


async def _goes_out(rig: Rig, there: MqttClient, port: int, version: int) -> None:
    for qos in (0, 1, 2):
        await publish(rig, f"r2d2/events/{qos}", b"out", qos)
    await publish(rig, "r2d2/state/battery", b"80", retain=True)
    for topic in ("events/0", "events/1", "events/2", "state/battery"):
        await until(lambda: came(there, f"fleet/r2d2/{topic}"), topic)  # noqa: B023
    async with operator(port, version, "late") as late:
        await late.subscribe("fleet/r2d2/state/battery")
        (message,) = await late.wait_for()
        assert message.payload == b"80" and message.retain


async def _comes_in(rig: Rig, there: MqttClient) -> None:
    await until(lambda: rig.app.broker.retained.get("r2d2/mode"), "the retained message")
    here = await local(rig, "r2d2/cmd/#")
    for qos in (0, 1, 2):
        await there.publish(f"fleet/r2d2/cmd/{qos}", b"in", qos)
        message = await asyncio.wait_for(next_message(here), 30)
        assert (message.topic, message.payload) == (f"r2d2/cmd/{qos}", b"in")
    here.hang_up()


async def _is_called(rig: Rig, there: MqttClient, version: int) -> None:
    service = await local(rig, "r2d2/reset/_call/#")
    properties: Properties | None = None
    call, answer = "fleet/r2d2/reset/_call/42", "fleet/r2d2/reset/_reply/42"
    if version == V5:
        call, answer = "fleet/r2d2/reset/_call", "answers/operator"
        properties = {Property.RESPONSE_TOPIC: answer, Property.CORRELATION_DATA: b"7"}
    await there.publish(call, b"?", properties=properties)
    request = await asyncio.wait_for(next_message(service), 30)
    where = (request.properties or {})[Property.RESPONSE_TOPIC]
    assert isinstance(where, str)
    await service.send(Publish(where, b"!", 1, False, False, 9))
    await until(lambda: came(there, answer) == [b"!"])
    service.hang_up()


@pytest.mark.parametrize("version", ["5", "3.1.1"])
async def test_rabbitmq(rabbitmq: RabbitMQ, tmp_path: Path, version: str) -> None:
    """3.10 speaks 3.1.1 only, and closes the connection upon a CONNECT of version 5."""
    rig = link(tmp_path, rabbitmq.plain_port, kind="rabbitmq", version=version)
    await carries_both_ways(rig, rabbitmq.plain_port, V311)


def is_subscribed(rig: Rig) -> bool:
    """Whether the fleet's broker has answered the SUBSCRIBE of the present connection."""
    channel = rig.uplink._lines[0].channel
    return channel is not None and channel.is_subscribed


async def test_what_rabbitmq_does_not_allow(
    rabbitmq: RabbitMQ, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It closes the connection, and says why nowhere but in its log."""
    monkeypatch.setattr(unanswered, "LIVED", 0.5)
    kind = {"kind": "rabbitmq", "version": "3.1.1"}
    async with running(link(tmp_path, rabbitmq.plain_port, password="no", **kind)) as rig:
        await until(lambda: "Bad user name or password" in (rig.status().problem or ""))
    rules = {"in": [{"topic": "other/#"}, {"topic": "cmd/#"}]}
    async with (
        running(link(tmp_path, rabbitmq.plain_port, user=LIMITED, **kind, **rules)) as rig,
        operator(rabbitmq.plain_port, V311) as there,
    ):
        await there.subscribe("fleet/r2d2/events/#")
        await until(lambda: "fleet/r2d2/other/#" in (rig.status().problem or ""))
        await until(lambda: rig.status().missing_filters == ["fleet/r2d2/other/#"])
        await until(lambda: "_appliance/state" in (rig.status().state_refusal or ""))
        await until(lambda: is_subscribed(rig), "the other filter to be granted")
        here = await local(rig, "r2d2/cmd/#")
        await there.publish("fleet/r2d2/cmd/go", b"in")
        assert (await asyncio.wait_for(next_message(here), 30)).payload == b"in"
        here.hang_up()
        await publish(rig, "r2d2/events/secret", b"x")
        await publish(rig, "r2d2/events/door", b"y")
        await until(lambda: came(there, "fleet/r2d2/events/door"))
        await rig.drained()
        assert [each["topic"] for each in rig.uplink.aside()] == ["fleet/r2d2/events/secret"]
        assert not came(there, "fleet/r2d2/events/secret")


async def test_ejabberd(tmp_path: Path) -> None:
    """A second implementation of MQTT 5, which also ends and comes back."""
    with Ejabberd(tmp_path / "ejabberd") as broker:
        port = broker.plain_port
        await carries_both_ways(link(tmp_path, port), port, V5)
        async with running(link(tmp_path, port, password="no")) as rig:
            await until(lambda: "Not authorized" in (rig.status().problem or ""))
        async with running(link(tmp_path, port)) as rig:
            await until(lambda: rig.status().connected)
            await asyncio.to_thread(broker.kill)
            await until(lambda: not rig.status().connected)
            sent = [b"%d" % number for number in range(20)]
            for payload in sent:
                await publish(rig, "r2d2/events/door", payload)
            await asyncio.to_thread(broker.start)
            async with operator(port, V5) as there:
                await there.subscribe("fleet/r2d2/events/#")
                await until(lambda: came(there, "fleet/r2d2/events/door")[-1:] == sent[-1:])
                await rig.drained()


@pytest.mark.timeout(300)
async def test_a_cluster_of_rabbitmq_whose_first_node_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The link goes on with the second, and back to the first when it is there again."""
    monkeypatch.setattr(backoff, "RETURN_AFTER", 1.0)
    with RabbitCluster(tmp_path / "cluster") as cluster:
        first, second, third = cluster.nodes
        ports = [node.plain_port for node in cluster.nodes]
        rig = link(tmp_path, *ports, kind="rabbitmq", version="3.1.1")
        async with running(rig), operator(third.plain_port, V311) as there:
            await there.subscribe("fleet/r2d2/#")
            await until(lambda: rig.status().connected)
            assert rig.status().server.endswith(str(first.plain_port))
            sent = 0
            is_over = False  # a cancellation may be lost in `wait_for` before Python 3.12

            async def work() -> None:
                nonlocal sent
                while not is_over:
                    await publish(rig, "r2d2/events/door", b"%d" % (sent + 1))
                    sent += 1
                    await asyncio.sleep(0.02)

            working = asyncio.ensure_future(work())
            await until(lambda: came(there, "fleet/r2d2/events/door"))
            await asyncio.to_thread(first.kill)
            await until(lambda: rig.status().server.endswith(str(second.plain_port)))
            await until(lambda: rig.status().connected)
            await asyncio.to_thread(first.start)
            await until(lambda: rig.status().server.endswith(str(first.plain_port)))
            await until(lambda: rig.status().connected)
            is_over = True
            await working
            await rig.drained()

            def arrived() -> list[int]:
                return [int(each) for each in came(there, "fleet/r2d2/events/door")]

            # A node acknowledges before another one of the cluster has sent to its own client.
            await until(lambda: not set(range(1, sent + 1)) - set(arrived()), "all of them")
            numbers = arrived()
            assert list(dict.fromkeys(numbers)) == sorted(set(numbers))


async def test_mosquitto_over_websocket(tmp_path: Path) -> None:
    (port,) = free_ports(1)
    options = f"max_queued_messages 0\nlistener {port} {HOST}\nprotocol websockets"
    with FleetMosquitto(tmp_path / "mosquitto", options=options) as fleet:
        rig = link(tmp_path, servers=[f"ws://{HOST}:{port}/mqtt"])
        await carries_both_ways(rig, fleet.plain_port, V5)


async def test_mosquitto_twice_and_another_client_with_the_client_id(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Back to the first one when it is up; and mosquitto 2.0 does not say who is taken over."""
    monkeypatch.setattr(backoff, "RETURN_AFTER", 0.3)
    with FleetMosquitto(tmp_path / "first") as first, FleetMosquitto(tmp_path / "second") as second:
        ports = [first.plain_port, second.plain_port]
        await asyncio.to_thread(first.kill)
        async with running(link(tmp_path, *ports)) as rig:
            await until(lambda: rig.status().connected)
            assert rig.status().server.endswith(str(second.plain_port))
            async with operator(second.plain_port, V5) as there:
                await there.subscribe("fleet/r2d2/#")
                await there.wait_for(1)
                await publish(rig, "r2d2/events/door", b"1")
                await rig.drained()
                await asyncio.to_thread(first.start)
                states = "fleet/r2d2/_appliance/state"
                await until(lambda: came(there, states) == [b"online", b"offline"])
                assert came(there, "fleet/r2d2/events/door") == [b"1"]
            await until(lambda: rig.status().server.endswith(str(first.plain_port)))

            async with operator(first.plain_port, V5) as there:
                await there.subscribe(states)

                is_told = asyncio.Event()  # see `is_over` above

                def is_online(times: int) -> bool:
                    return came(there, states).count(b"online") >= times

                async def take_over() -> None:
                    """As often as the link is online: all that it asked for is answered."""
                    for times in itertools.count(1):
                        await until(lambda: is_told.is_set() or is_online(times))  # noqa: B023
                        if is_told.is_set():
                            return
                        async with operator(first.plain_port, V5, "r2d2") as other:
                            await until(lambda: is_told.is_set() or other.closed.is_set())

                taking = asyncio.ensure_future(take_over())
                await until(lambda: "client id 'r2d2' as well?" in (rig.status().problem or ""))
                is_told.set()
                await taking
