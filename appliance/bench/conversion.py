"""Measures conversion alone: a serialized sensor_msgs/Imu to JSON, repeatedly in one process::

    python -m appliance.bench.conversion ours
    python -m appliance.bench.conversion rclpy

`rclpy` does what a node without a converter does: deserialize, walk the fields, encode with `json`.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from importlib import import_module
from typing import Any

from appliance.bench.load import Result

TYPE = "sensor_msgs/msg/Imu"
CONVERSIONS_PER_CLOCK_READ = 100  # conversions between two reads of the clock

Convert = Callable[[bytes], str | bytes]


def sample() -> bytes:
    """A serialized message with a different value in each field."""
    from rclpy.serialization import serialize_message

    message = import_module("sensor_msgs.msg").Imu()
    message.header.frame_id = "imu_link"
    message.header.stamp.sec, message.header.stamp.nanosec = 1_700_000_000, 123_456_789
    for field, axes in (
        (message.orientation, "xyzw"),
        (message.angular_velocity, "xyz"),
        (message.linear_acceleration, "xyz"),
    ):
        for number, axis in enumerate(axes, 1):
            setattr(field, axis, number / 7)
    for name in ("orientation", "angular_velocity", "linear_acceleration"):
        setattr(message, f"{name}_covariance", [number / 13 for number in range(9)])
    cdr: bytes = serialize_message(message)
    return cdr


def ours() -> Convert:
    """The converter that the bridge uses."""
    from appliance.ros.payload.converter import Converters
    from appliance.ros.payload.definitions import load_description

    return Converters(load_description).get(TYPE).to_json


def rclpy() -> Convert:
    """What a node without a converter does."""
    from rclpy.serialization import deserialize_message

    imu = import_module("sensor_msgs.msg").Imu

    def walk(value: Any) -> Any:
        if isinstance(value, (float, int, str)):
            return value
        if hasattr(value, "tolist"):
            return value.tolist()
        return {name: walk(getattr(value, name)) for name in value._fields_and_field_types}

    return lambda cdr: json.dumps(walk(deserialize_message(cdr, imu)))


CONVERTERS = {"ours": ours, "rclpy": rclpy}


def measure(how: str, seconds: float) -> Result:
    """Convert for `seconds`."""
    cdr, convert = sample(), CONVERTERS[how]()
    count = 0
    convert(cdr)
    began, cpu = time.monotonic(), time.process_time()
    while time.monotonic() < began + seconds:
        for _ in range(CONVERSIONS_PER_CLOCK_READ):
            convert(cdr)
        count += CONVERSIONS_PER_CLOCK_READ
    elapsed, cpu = time.monotonic() - began, time.process_time() - cpu
    return Result(
        cell=f"conversion-{how}",
        tls=False,
        seconds=elapsed,
        messages=count,
        rate=count / elapsed,
        cpu_us=1e6 * cpu / count,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m appliance.bench.conversion", description="Serialized messages to JSON."
    )
    parser.add_argument("how", choices=CONVERTERS)
    parser.add_argument("--seconds", type=float, default=3.0)
    options = parser.parse_args(arguments)
    sys.stdout.write(json.dumps(asdict(measure(options.how, options.seconds))) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
