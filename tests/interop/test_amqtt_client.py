"""amqtt's client, MQTT 3.1.1, through TLS."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest
from amqtt.client import MQTTClient
from amqtt.errors import ConnectError
from appliance_process import HOST, ApplianceProcess
from waiting import PATIENCE

QOS = [0, 1, 2]


@contextlib.asynccontextmanager
async def connected(
    appliance: ApplianceProcess,
    client_id: str | None = None,
    *,
    password: str | None = None,
    clean: bool = True,
    will: dict[str, Any] | None = None,
) -> AsyncIterator[MQTTClient]:
    config: dict[str, Any] = {"auto_reconnect": False, "plugins": {}}
    if will is not None:
        config["will"] = will
    client = MQTTClient(client_id, config)
    password = password or appliance.passwords["alice"]
    uri = f"mqtts://alice:{password}@{HOST}:{appliance.port}/"
    await client.connect(uri, cleansession=clean, cafile=str(appliance.ca))
    try:
        yield client
    finally:
        await client.disconnect()


async def receive(client: MQTTClient) -> tuple[str, str, int | None, bool]:
    """topic, payload, QoS, retain of the next message."""
    message = await client.deliver_message(PATIENCE)
    assert message is not None
    assert message.data is not None
    return message.topic, message.data.decode(), message.qos, message.retain


@pytest.mark.statement("3.1.1", "MQTT-7.0.0-2")
@pytest.mark.parametrize("qos", QOS)
async def test_publish_and_subscribe(appliance: ApplianceProcess, topic: str, qos: int) -> None:
    async with connected(appliance) as sender, connected(appliance) as receiver:
        assert await receiver.subscribe([(f"{topic}/+", qos)]) == [qos]
        for number in range(30):
            await sender.publish(f"{topic}/a", str(number).encode(), qos)
            assert await receive(receiver) == (f"{topic}/a", str(number), qos, False)
        await receiver.unsubscribe([f"{topic}/+"])
        await receiver.subscribe([(f"{topic}/b", qos)])
        await sender.publish(f"{topic}/a", b"unheard", qos)
        await sender.publish(f"{topic}/b", b"heard", qos)
        assert await receive(receiver) == (f"{topic}/b", "heard", qos, False)


@pytest.mark.parametrize("qos", QOS)
async def test_retained(appliance: ApplianceProcess, topic: str, qos: int) -> None:
    async with connected(appliance) as sender:
        await sender.publish(topic, b"retained", qos, retain=True)
        await sender.publish(f"{topic}/end", b"", 1)  # answered when QoS 0, too, is there
        async with connected(appliance) as late:
            await late.subscribe([(topic, qos)])
            assert await receive(late) == (topic, "retained", qos, True)
        await sender.publish(topic, b"", max(qos, 1), retain=True)
        async with connected(appliance) as late:
            await late.subscribe([(topic, qos)])
            await sender.publish(topic, b"live", qos)
            assert await receive(late) == (topic, "live", qos, False)


@pytest.mark.parametrize("qos", QOS)
async def test_will(appliance: ApplianceProcess, topic: str, qos: int) -> None:
    will = {"topic": f"{topic}/will", "message": "gone", "qos": qos, "retain": False}
    async with connected(appliance) as watcher:
        await watcher.subscribe([(f"{topic}/#", qos)])
        with contextlib.suppress(ConnectError):  # it ends without its DISCONNECT
            async with connected(appliance, will=will) as dying:
                assert dying._handler and dying._handler.writer
                dying._handler.writer._writer.transport.abort()
                assert await receive(watcher) == (f"{topic}/will", "gone", qos, False)
        async with connected(appliance, will=will):
            pass  # this one takes leave
        await watcher.publish(f"{topic}/end", b"end", qos)
        assert await receive(watcher) == (f"{topic}/end", "end", qos, False)


@pytest.mark.parametrize("qos", [1, 2])
async def test_a_session_is_continued(appliance: ApplianceProcess, topic: str, qos: int) -> None:
    name = topic[-12:]
    async with connected(appliance, name, clean=False) as client:
        await client.subscribe([(topic, qos)])
    async with connected(appliance) as sender:
        await sender.publish(topic, b"meanwhile", qos)
    async with connected(appliance, name, clean=False) as client:
        assert await receive(client) == (topic, "meanwhile", qos, False)


async def test_a_wrong_password(appliance: ApplianceProcess) -> None:
    with pytest.raises(ConnectError) as refused:
        async with connected(appliance, password="wrong"):
            pass
    assert refused.value.return_code == 5
