"""Routes with `encoding: jpeg`: a thread converts, the newest only; and what goes wrong there."""

from __future__ import annotations

import asyncio
import io
import threading
import time
from collections.abc import AsyncIterator

import pytest
from both_loops import event_loop_policy
from bridge_harness import LATCHED, Harness, to_mqtt
from call_harness import AllTypes
from images import IMAGE, image
from waiting import until

from appliance.mqtt.codec import Property
from appliance.ros.payload.encodings import picture
from appliance.ros.payload.encodings.picture import Picture
from appliance.ros.topics.off_loop import TopicConversions

Image = pytest.importorskip("PIL.Image")

__all__ = ["event_loop_policy"]

FRAME = image(bytes(48 * 32 * 3), 48, 32)


@pytest.fixture
async def harness() -> AsyncIterator[Harness]:
    harness = Harness()
    harness.node.types = AllTypes()
    yield harness
    await harness.bridge.stop()


class Gate:
    """Pictures whose conversion waits until the test lets one through."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.began: list[int] = []
        self._go = threading.Semaphore(0)
        monkeypatch.setattr(Picture, "_jpeg", self._convert)

    def _convert(self, image: dict[str, object]) -> bytes:
        self.began.append(len(image["data"]))  # type: ignore[arg-type]
        assert self._go.acquire(timeout=30)
        return b"picture of %d bytes" % self.began[-1]

    def open(self, count: int = 1) -> None:
        self._go.release(count)


async def test_a_picture_of_an_image(harness: Harness) -> None:
    harness.start(to_mqtt("/image", encoding="jpeg", max_width=24, retain=True))
    camera = harness.node.add_publisher("/image", IMAGE)
    camera.publish(FRAME)
    await until(lambda: harness.client.payloads("r2d2/image"), "a picture")
    ((message, qos),) = [each for each in harness.client.received if each[0].topic == "r2d2/image"]
    opened = Image.open(io.BytesIO(message.payload))
    assert (opened.format, opened.size, qos, message.retain) == ("JPEG", (24, 16), 1, True)
    assert message.properties[Property.CONTENT_TYPE] == "image/jpeg"
    assert ("ros-type", IMAGE) in message.properties[Property.USER_PROPERTY]


async def test_while_one_is_converted_the_newest_of_the_others_waits(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = Gate(monkeypatch)
    harness.start(to_mqtt("/image", encoding="jpeg"))
    camera = harness.node.add_publisher("/image", IMAGE)
    for width in range(1, 7):
        camera.publish(image(bytes(3 * width), width, 1))
    await until(lambda: gate.began == [3], "the first")
    other = asyncio.get_running_loop().time()
    await asyncio.sleep(0)  # the loop goes on meanwhile
    assert asyncio.get_running_loop().time() - other < 10
    gate.open(2)
    await until(lambda: len(harness.client.payloads("r2d2/image")) == 2, "the last")
    assert harness.client.payloads("r2d2/image") == [b"picture of 3 bytes", b"picture of 18 bytes"]
    counters = harness.status()
    assert (counters.messages, counters.throttled, counters.errors) == (2, 4, 0)


@pytest.mark.parametrize("rate", [None, 0.01])
async def test_a_route_that_is_removed_publishes_no_picture_any_more(
    harness: Harness, monkeypatch: pytest.MonkeyPatch, rate: float | None
) -> None:
    gate = Gate(monkeypatch)
    harness.start(to_mqtt("/image", encoding="jpeg", retain=True, rate=rate))
    (route,) = harness.bridge._routes
    camera = harness.node.add_publisher("/image", IMAGE)
    for _ in range(3):
        camera.publish(FRAME)
    await until(lambda: gate.began, "a conversion")
    gate.open(3)
    harness.bridge.replace([to_mqtt("/image", encoding="binary")])
    harness.node.spin()
    await until(lambda: route.past.throttled == 3, "the end of the route")
    other = to_mqtt("/other", encoding="jpeg")
    harness.bridge.replace([other])
    harness.node.spin()
    harness.node.add_publisher("/other", IMAGE).publish(FRAME)
    await until(lambda: harness.client.payloads("r2d2/other"), "the thread has gone on")
    assert harness.client.payloads("r2d2/image") == []
    assert (route.past.messages, route.past.errors) == (0, 0)


async def test_a_picture_in_the_mailbox_is_counted_and_taken_back_with_its_route(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    harness.start(to_mqtt("/image", encoding="jpeg", retain=True))
    (route,) = harness.bridge._routes
    (flow,) = harness.bridge.flows()
    monkeypatch.setattr(harness.bridge, "_wake", lambda: None)
    monkeypatch.setattr(harness.bridge._mailbox, "_wake", lambda: None)  # the loop is busy
    harness.node.add_publisher("/image", IMAGE).publish(FRAME)
    await until(lambda: flow._lane.waiting, "a picture")
    harness.bridge.replace([])
    harness.node.spin()
    await until(lambda: route.past.messages == 1, "the end of the route")
    await until(lambda: harness.client.payloads("r2d2/image")[-1:] == [b""], "the cleanup")
    assert harness.broker.retained.get("r2d2/image") is None


async def test_a_flow_that_opens_again_makes_pictures_again(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = Gate(monkeypatch)
    harness.start(to_mqtt("/image", encoding="jpeg"))
    camera = harness.node.add_publisher("/image", IMAGE)
    camera.publish(FRAME)
    await until(lambda: gate.began, "a conversion")
    (flow,) = harness.bridge.flows()
    flow.follower.reset("a fault")
    harness.node.spin()
    camera.publish(image(bytes(3), 1, 1))
    gate.open(2)
    await until(lambda: harness.client.payloads("r2d2/image"), "a picture")
    assert harness.client.payloads("r2d2/image") == [b"picture of 3 bytes"]
    assert harness.status().throttled == 1


async def test_one_camera_does_not_wait_for_another(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = Gate(monkeypatch)
    harness.start(to_mqtt("/left", encoding="jpeg"), to_mqtt("/right", encoding="jpeg"))
    left, right = (harness.node.add_publisher(name, IMAGE) for name in ("/left", "/right"))
    left.publish(image(bytes(3), 1, 1))
    right.publish(image(bytes(6), 2, 1))
    await until(lambda: sorted(gate.began) == [3, 6], "both at a time")
    gate.open(2)
    await until(lambda: harness.client.payloads("r2d2/right"), "a picture")


async def test_what_cannot_be_converted_is_counted_and_the_next_one_comes(
    harness: Harness, monkeypatch: pytest.MonkeyPatch, escaped: list[str]
) -> None:
    harness.start(to_mqtt("/image", encoding="jpeg"))
    camera = harness.node.add_publisher("/image", IMAGE)
    camera.publish(image(bytes(4), 2, 2, "bayer_rggb8"))
    await until(lambda: harness.status().errors == 1, "a refusal")
    assert "bayer_rggb8" in harness.status().last_error
    with monkeypatch.context() as broken:
        broken.setattr(picture, "check_image", lambda image: 1 / 0)
        camera.publish(FRAME)
        await until(lambda: harness.status().errors == 2, "a fault")
    faults = harness.broker.faults
    await until(lambda: faults.by_entry == {"bridge.picture": 1}, "that it is reported")
    camera.publish(FRAME)
    await until(lambda: harness.client.payloads("r2d2/image"), "a picture")
    escaped.clear()


async def test_after_a_fault_at_the_entry_the_next_one_is_converted(
    harness: Harness, monkeypatch: pytest.MonkeyPatch, escaped: list[str]
) -> None:
    harness.start(to_mqtt("/image", encoding="jpeg"))
    camera = harness.node.add_publisher("/image", IMAGE)
    with monkeypatch.context() as broken:
        broken.setattr(TopicConversions, "_converted", lambda self, *_: 1 / 0)
        camera.publish(FRAME)
        faults = harness.broker.faults
        await until(lambda: faults.by_entry == {"bridge.picture": 1}, "a fault")
    camera.publish(FRAME)
    await until(lambda: harness.client.payloads("r2d2/image"), "a picture")
    escaped.clear()


async def test_the_last_image_of_a_rate_limit_comes_too(harness: Harness) -> None:
    harness.start(to_mqtt("/image", encoding="png", rate=20))
    camera = harness.node.add_publisher("/image", IMAGE, LATCHED)
    began = time.monotonic()
    for width in range(1, 5):
        camera.publish(image(bytes(3 * width), width, 1))

    def widths() -> list[int]:
        harness.node.spin()  # the poll of the graph, which sends what the rate limit kept
        payloads = harness.client.payloads("r2d2/image")
        return [Image.open(io.BytesIO(payload)).width for payload in payloads]

    await until(lambda: widths()[-1:] == [4], "the last")
    assert widths()[0] == 1 and time.monotonic() - began > 0.04


async def test_a_stop_does_not_wait_for_a_picture(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = Gate(monkeypatch)
    harness.start(to_mqtt("/image", encoding="jpeg"))
    camera = harness.node.add_publisher("/image", IMAGE)
    camera.publish(FRAME)
    camera.publish(FRAME)
    await until(lambda: gate.began, "a conversion")
    await harness.bridge.stop()
    gate.open()
    assert harness.broker.faults.count == 0
