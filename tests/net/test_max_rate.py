"""A rate for a subscription, over sockets and with the event loop's timer."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from both_loops import event_loop_policy
from harness import Harness, make_contexts

from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Publish, Suback, Subscribe, Subscription
from appliance.mqtt.reason import ReasonCode
from appliance.net.connection import WRITE_PORTION

__all__ = ["event_loop_policy"]

JPEG = {Property.CONTENT_TYPE: "image/jpeg"}  # with properties a message is encoded for each
RATE = {Property.USER_PROPERTY: [("max-rate", "10")]}


@pytest.fixture
async def harness(tmp_path: Path) -> AsyncIterator[Harness]:
    harness = Harness(*make_contexts(tmp_path / "certs"))
    harness.broker.tick(asyncio.get_running_loop().time())
    await harness.start()
    yield harness
    await harness.close()


async def test_a_viewer_gets_the_newest_of_each_topic_and_the_last(harness: Harness) -> None:
    viewer, publisher = await harness.log_in("viewer"), await harness.log_in("publisher")
    bad = {Property.USER_PROPERTY: [("max-rate", "often")]}
    await viewer.send(Subscribe(1, [Subscription("t/#")], bad))
    refused = await viewer.receive()
    assert isinstance(refused, Suback) and refused.properties is not None
    assert refused.reason_codes == [ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR]
    assert "'often'" in str(refused.properties[Property.REASON_STRING])
    await viewer.send(Subscribe(2, [Subscription("t/#", 2)], RATE))
    assert (await viewer.receive()).reason_codes == [0]  # type: ignore[union-attr]

    began = time.monotonic()
    for number in range(100):  # of four topics, each 25 times in a quarter of a second or more
        await publisher.send(Publish(f"t/{number % 4}", b"%d" % number))
        await asyncio.sleep(0.0025)
    last = {b"96", b"97", b"98", b"99"}
    came: list[bytes] = []
    while not last <= set(came):
        packet = await viewer.receive()
        assert isinstance(packet, Publish) and packet.qos == 0
        came.append(packet.payload)
    took = time.monotonic() - began
    assert {int(payload) for payload in came[:4]} == {0, 1, 2, 3}  # each first one at once
    assert len(came) <= 4 * (2 + took / 0.1)
    assert harness.broker.counters.publish_throttled + len(came) == 100
    assert harness.broker.faults.count == 0


@pytest.mark.parametrize("rate", ["1000", None])
async def test_pictures_for_a_viewer_that_does_not_read(harness: Harness, rate: str | None) -> None:
    """One picture is on its way to it, and one waits; the other viewer gets all of them."""
    stalled, viewer, publisher = [
        await harness.log_in(name) for name in ("stalled", "viewer", "publisher")
    ]
    fast = {Property.USER_PROPERTY: [("max-rate", rate)]} if rate else None
    for each in (viewer, stalled):
        await each.send(Subscribe(1, [Subscription("camera")], fast))
        await each.receive()
    size, most = 1_000_000, 0
    for number in range(90):
        picture = b"%04d" % number + bytes(size)
        await publisher.send(Publish("camera", picture, properties=JPEG))
        packet = await viewer.receive()
        assert isinstance(packet, Publish) and packet.payload == picture
        most = max(most, harness.broker.accounting.queued_bytes)
    assert size < most <= 2 * size + WRITE_PORTION
