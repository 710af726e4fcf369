"""An image that rclpy publishes becomes a picture for MQTT."""

from __future__ import annotations

import io

import pytest
from images import IMAGE, image
from ros2_harness import route
from waiting import until

Image = pytest.importorskip("PIL.Image")


async def test_an_image_of_rclpy_is_a_jpeg_picture(harness, peer):
    harness.start(route("/camera/image_raw", "mqtt", "jpeg", max_width=160))
    await peer.do("advertise", "/camera/image_raw", IMAGE)
    await peer.do("matched", "/camera/image_raw")
    frame = image(bytes((10, 20, 200)) * 320 * 240, 320, 240, "bgr8")
    await peer.do("publish", "/camera/image_raw", frame.hex())
    await until(lambda: harness.payloads("r2d2/camera/image_raw"), "a picture")
    (payload,) = harness.payloads("r2d2/camera/image_raw")
    opened = Image.open(io.BytesIO(payload))
    assert (opened.format, opened.size) == ("JPEG", (160, 120))
    red, green, blue = opened.getpixel((80, 60))
    assert red > 190 and green < 30 and blue < 20
    assert [status.errors for status in harness.bridge.status()] == [0]
