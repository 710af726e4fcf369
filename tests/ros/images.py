"""Images of sensor_msgs, serialized, as a camera's driver publishes them."""

from __future__ import annotations

import struct

from appliance.ros.payload.converter import Converter, compile_converter
from appliance.ros.payload.definitions import describe, import_message

IMAGE = "sensor_msgs/msg/Image"


def converter_of(name: str = IMAGE) -> Converter:
    return compile_converter(describe(import_message(name), import_message))


def image(
    data: bytes,
    width: int,
    height: int,
    encoding: str = "rgb8",
    step: int | None = None,
    *,
    big: bool = False,
) -> bytes:
    """A serialized sensor_msgs/msg/Image, written by hand: rclpy would refuse some."""
    name = encoding.encode() + b"\0"
    cdr = struct.pack("<iII", 1, 2, 4) + b"cam\0"  # the header
    cdr += struct.pack("<III", height, width, len(name)) + name + bytes((big,))
    cdr += bytes(-len(cdr) % 4)
    cdr += struct.pack("<II", len(data) // height if step is None else step, len(data)) + data
    return b"\0\1\0\0" + cdr
