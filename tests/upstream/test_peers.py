"""Each of the real programs starts, speaks MQTT or leads to it, and leaves nothing behind."""

from __future__ import annotations

import asyncio
import base64
import ssl
from pathlib import Path

import psutil
import pytest
from waiting import until

from appliance.mqtt.codec import V5, V311
from upstream import peers
from upstream.client import MqttClient
from upstream.peers import (
    HOST,
    Ejabberd,
    FleetMosquitto,
    Haproxy,
    MosquittoBridge,
    Peer,
    RabbitMQ,
    Tinyproxy,
)


async def exchange(port: int, version: int, tls: ssl.SSLContext | None = None) -> None:
    """A message with QoS 1 from one client to another."""
    reader = await MqttClient.dial(port, "reader", version=version, tls=tls)
    writer = await MqttClient.dial(port, "writer", version=version, tls=tls)
    await reader.subscribe("a/#")
    assert await writer.publish("a/b", b"hello") in (0, 0x10)
    (message,) = await reader.wait_for()
    assert (message.topic, message.payload, message.qos) == ("a/b", b"hello", 1)
    await reader.close()
    await writer.close()


def gone(pids: list[int]) -> bool:
    return not any(psutil.pid_exists(pid) for pid in pids)


def family(peer: Peer) -> list[int]:
    return [peer.pid, *(child.pid for child in psutil.Process(peer.pid).children(recursive=True))]


async def test_mosquitto_plain_and_with_tls(fleet: FleetMosquitto) -> None:
    await exchange(fleet.plain_port, V311)
    await exchange(fleet.port, V5, fleet.tls_context())


async def test_mosquitto_keeps_ports_and_sessions_over_a_stop(tmp_path: Path) -> None:
    with FleetMosquitto(tmp_path) as broker:
        reader = await MqttClient.dial(broker.plain_port, "reader", clean=False, expiry=600)
        await reader.subscribe("a/#")
        reader.abort()
        writer = await MqttClient.dial(broker.plain_port, "writer")
        await writer.publish("a/b", b"kept")
        pids = family(broker)
        broker.stop()
        await until(lambda: gone(pids))
        broker.start()
        reader = await MqttClient.dial(broker.plain_port, "reader", clean=False, expiry=600)
        assert reader.connack is not None and reader.connack.session_present
        assert (await reader.wait_for())[0].payload == b"kept"
        reader.abort()


async def test_mosquittos_bridge_carries_both_ways(fleet: FleetMosquitto, tmp_path: Path) -> None:
    topics = ["# out 1 r2d2/ fleet/r2d2/", "cmd/# in 1 r2d2/ fleet/r2d2/"]
    with MosquittoBridge(tmp_path, fleet.plain_port, topics) as bridge:
        there = await MqttClient.dial(fleet.plain_port, "operator")
        here = await MqttClient.dial(bridge.plain_port, "node", user=None, password=None)
        await there.subscribe("fleet/r2d2/events/#")
        await here.subscribe("r2d2/cmd/#")
        here_ = here.publish("r2d2/events/1", b"out")
        await there.wait_for()
        await here_
        await until_arrives(there, "fleet/r2d2/cmd/go", here)
        assert there.messages[0][1].topic == "fleet/r2d2/events/1"
        assert here.messages[0][1].topic == "r2d2/cmd/go"
        here.abort()
        there.abort()


async def until_arrives(sender: MqttClient, topic: str, receiver: MqttClient) -> None:
    """Publish until it arrives: a bridge may not have subscribed yet."""
    while not receiver.messages:
        await sender.publish(topic, b"in")
        await asyncio.sleep(0.05)


async def test_rabbitmq(rabbitmq: RabbitMQ) -> None:
    await exchange(rabbitmq.plain_port, V311)


async def test_ejabberd(tmp_path: Path) -> None:
    with Ejabberd(tmp_path) as broker:
        await exchange(broker.plain_port, V5)
        await exchange(broker.plain_port, V311)
        context = ssl.create_default_context(cafile=str(broker.ca))
        await exchange(broker.port, V5, context)
        pids = family(broker)
    await until(lambda: gone(pids))


async def test_tinyproxy_leads_to_a_broker(fleet: FleetMosquitto, tmp_path: Path) -> None:
    with Tinyproxy(tmp_path, login=("user", "secret")) as proxy:
        for login, expected in ((b"user:secret", b"200"), (b"user:wrong", b"401")):
            reader, writer = await asyncio.open_connection(HOST, proxy.plain_port)
            basic = base64.b64encode(login)
            target = f"{HOST}:{fleet.plain_port}".encode()
            writer.write(
                b"CONNECT %s HTTP/1.1\r\nHost: %s\r\n" % (target, target)
                + b"Proxy-Authorization: Basic %s\r\n\r\n" % basic
            )
            line = await reader.readline()
            assert line.split()[1] == expected, line
            writer.close()


async def test_haproxy_leads_by_alpn(fleet: FleetMosquitto, tmp_path: Path) -> None:
    backends = {"x-amzn-mqtt-ca": fleet.plain_port, "http/1.1": 1}
    with Haproxy(tmp_path, backends) as proxy:
        context = ssl.create_default_context(cafile=str(proxy.ca))
        context.set_alpn_protocols(["x-amzn-mqtt-ca"])
        await exchange(proxy.port, V5, context)
        context.set_alpn_protocols(["http/1.1"])
        with pytest.raises(ConnectionError):
            await MqttClient.dial(proxy.port, "web", tls=context)


async def test_a_peer_that_does_not_start_is_cleaned_up(tmp_path: Path) -> None:
    broker = FleetMosquitto(tmp_path, options="no_such_option 1")
    with pytest.raises(AssertionError, match="no_such_option"), broker:
        pass
    assert broker._process is None


def test_what_is_not_installed_skips_and_names_its_package() -> None:
    with pytest.raises(pytest.skip.Exception, match="apt-get install nothing-like-it"):
        peers.needs("no-such-program", "nothing-like-it")


async def test_processes_end_when_the_block_fails(tmp_path: Path) -> None:
    broker = FleetMosquitto(tmp_path)
    with pytest.raises(ZeroDivisionError), broker:
        pids = family(broker)
        raise ZeroDivisionError
    await until(lambda: gone(pids))
