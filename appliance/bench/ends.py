"""The two ends of a bridge: a paced sender and a measuring receiver, on ROS or on MQTT.

The sender puts the time and a number into each text, from which the receiver computes the latency
and what was lost::

    python -m appliance.bench.ends mqtt-receive --port 1883 --topic bench/chatter --pid PID
    python -m appliance.bench.ends ros-send --topic chatter --rate 1000

With `--image` the text ends an image's bytes. `ros-listen` is a bare subscription: the receiver and
the measured process in one.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import asdict
from importlib import import_module
from typing import Any

from appliance.bench.client import LoadClient, LoadError, LoadTarget, publish_packet, reporting
from appliance.bench.load import Result, cpu_seconds, percentile, pin

TEXT_BYTES = 64
IMAGE_BYTES = 1_000_000
FIRST_SECONDS = 30.0  # for discovery, on a computer that has other work
SETTLE_SECONDS = 1.0  # after the first message, for what was queued at the start
RECEIVE_BYTES = 1 << 21
QUEUE = 1000  # depth of the ROS ends, which must not lose messages themselves
IMAGE_QUEUE = 10  # the same for images


def text(number: int) -> str:
    """The text of a message: the time at which it is sent, and its number."""
    return f"{time.monotonic_ns():020d} {number:010d}".ljust(TEXT_BYTES)


class LatencyMeter:
    """Measures latency, loss, and the CPU time of everything between the two ends."""

    def __init__(self, cell: str, pids: Sequence[int], seconds: float) -> None:
        self._cell, self._pids, self._seconds = cell, pids, seconds
        self._latencies: list[tuple[float, int]] = []
        self._first = self._last = 0
        self._starts = self._ends = 0.0  # the measurement, in seconds of the monotonic clock
        self._began = self._elapsed = 0.0
        self._cpu = 0.0

    @property
    def complete(self) -> bool:
        """Whether the measurement is over."""
        return self._elapsed > 0

    def add(self, data: str | bytes) -> None:
        """Count a message that has arrived."""
        now = time.monotonic_ns() * 1e-9
        if self.complete:
            return
        if not self._starts:
            self._starts = now + SETTLE_SECONDS
        if now < self._starts:
            return
        number = int(data[21:31])
        if not self._began:
            self._first, self._began = number, now
            self._cpu = cpu_seconds(self._pids)
        elif now >= self._began + self._seconds:
            self._elapsed = now - self._began
            self._cpu = cpu_seconds(self._pids) - self._cpu
            return
        self._last = max(self._last, number)
        self._latencies.append((now - int(data[:20]) * 1e-9, 1))

    def result(self) -> Result:
        """The measurement. Raises LoadError when it was not completed."""
        if not self.complete:
            raise LoadError("nothing comes through" if not self._starts else "it stopped flowing")
        messages = len(self._latencies)
        return Result(
            cell=self._cell,
            tls=False,
            seconds=self._elapsed,
            messages=messages,
            lost=self._last - self._first + 1 - messages,
            rate=messages / self._elapsed,
            cpu_us=1e6 * self._cpu / messages if self._pids else None,
            p50_us=1e6 * percentile(self._latencies, 0.50),
            p99_us=1e6 * percentile(self._latencies, 0.99),
            broker_busy=self._cpu / self._elapsed if self._pids else None,
        )


def paced(rate: float, seconds: float, send: Callable[[str], object]) -> None:
    """Send `rate` texts a second for `seconds`; late ones are sent as soon as possible."""
    began = time.monotonic()
    for number in range(int(rate * seconds)):
        if (wait := began + number / rate - time.monotonic()) > 0:
            time.sleep(wait)
        send(text(number))


# --- MQTT ---


def mqtt_send(target: LoadTarget, topic: str, rate: float, seconds: float) -> None:
    """Publish with QoS 0."""
    with closing(LoadClient(target, f"bench-send-{os.getpid()}")) as client:
        client.wait_connected()
        paced(rate, seconds, lambda data: client.write(publish_packet(topic, data.encode())))


def mqtt_receive(target: LoadTarget, topic: str, meter: LatencyMeter, seconds: float) -> None:
    """Subscribe with QoS 0 and measure."""
    buffer, filled, size = memoryview(bytearray(RECEIVE_BYTES)), 0, 0
    with closing(LoadClient(target, f"bench-receive-{os.getpid()}")) as client:
        client.wait_connected()
        client.subscribe(topic, 0)
        client.socket.settimeout(FIRST_SECONDS)
        until = time.monotonic() + FIRST_SECONDS + SETTLE_SECONDS + 2 * seconds
        while not meter.complete and time.monotonic() < until:
            try:
                filled += client.transport.recv_into(buffer[filled:])
            except TimeoutError:
                return  # the meter reports that nothing comes through
            if not size and filled >= 5:  # a PUBLISH and its length; all have the same
                size = packet_size(buffer)
            whole = filled - filled % size if size else 0
            for end in range(size, whole + 1, size or 1):
                meter.add(bytes(buffer[end - TEXT_BYTES : end]))
            buffer[: filled - whole] = bytes(buffer[whole:filled])
            filled -= whole


def packet_size(head: memoryview) -> int:
    """The size of the packet with this fixed header, in bytes (MQTT 3.1.1, section 2.2.3)."""
    length = 0
    for position in range(1, 5):
        length |= (head[position] & 0x7F) << 7 * (position - 1)
        if not head[position] & 0x80:
            return 1 + position + length
    raise LoadError("what arrives is no MQTT")


# --- ROS ---


def texts() -> tuple[Any, int, Callable[[str], Any]]:
    """The message type of texts, the queue's depth, and a function from a text to its message."""
    string = import_module("std_msgs.msg").String
    return string, QUEUE, lambda data: string(data=data)


def images() -> tuple[Any, int, Callable[[str], Any]]:
    """The same for serialized images, which end with the text."""
    from rclpy.serialization import serialize_message

    image = import_module("sensor_msgs.msg").Image
    pixels = bytes(IMAGE_BYTES - TEXT_BYTES)
    cdr = serialize_message(image(encoding="mono8", data=pixels + bytes(TEXT_BYTES)))
    return image, IMAGE_QUEUE, lambda data: cdr[:-TEXT_BYTES] + data.encode()


def ros_send(topic: str, rate: float, seconds: float, is_image: bool) -> None:
    """Publish std_msgs/String, or serialized sensor_msgs/Image."""
    import rclpy

    refusal = import_module("rclpy.impl.implementation_singleton").rclpy_implementation.RCLError
    rclpy.init()
    node = rclpy.create_node("bench_send")
    message_type, queue, make = images() if is_image else texts()
    publisher = node.create_publisher(message_type, topic, queue)

    def send(data: str) -> None:
        if not rclpy.ok():  # a signal came
            raise KeyboardInterrupt
        with suppress(refusal):  # for want of time or space; the receiver counts it as lost
            publisher.publish(make(data))

    try:
        paced(rate, seconds, send)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def ros_receive(topic: str, meter: LatencyMeter, seconds: float, is_image: bool) -> None:
    """Subscribe to std_msgs/String, or to serialized sensor_msgs/Image, and measure."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.task import Future

    rclpy.init()
    node = rclpy.create_node("bench_receive")
    try:  # from Jazzy on; costs a fifth of the other, and that cost is part of the latency
        executor: Any = import_module("rclpy.experimental").EventsExecutor()
    except ImportError:
        executor = SingleThreadedExecutor()
    complete: Any = Future(executor=executor)

    def receive(message: Any) -> None:
        meter.add(message[-TEXT_BYTES:] if is_image else message.data)
        if meter.complete and not complete.done():
            complete.set_result(None)

    message_type, queue, _ = images() if is_image else texts()
    node.create_subscription(message_type, topic, receive, queue, raw=is_image)
    executor.add_node(node)
    try:
        executor.spin_until_future_complete(
            complete, timeout_sec=FIRST_SECONDS + SETTLE_SECONDS + 2 * seconds
        )
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


ROLES = ("mqtt-send", "mqtt-receive", "ros-send", "ros-receive", "ros-listen")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m appliance.bench.ends", description="One end of a bridge."
    )
    parser.add_argument("role", choices=ROLES)
    parser.add_argument("--topic", required=True)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=1883)
    parser.add_argument("--user", help="user name")
    parser.add_argument("--password-env", metavar="NAME", help="variable that holds the password")
    parser.add_argument("--image", action="store_true", help="images of 1 MB, on ROS's side")
    parser.add_argument("--rate", type=float, default=1000.0, help="messages a second")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument(
        "--pid", type=int, action="append", default=[], help="what is between; repeatable"
    )
    options = parser.parse_args(arguments)

    password = os.environ[options.password_env].encode() if options.password_env else None
    target = LoadTarget(options.host, options.port, None, options.user, password)
    pids = [os.getpid()] if options.role == "ros-listen" else options.pid
    meter = LatencyMeter(options.role, pids, options.seconds)
    pin(pids)  # both ends on one core, what is between on another
    with reporting(options.role):
        if options.role == "mqtt-send":
            mqtt_send(target, options.topic, options.rate, options.seconds)
        elif options.role == "ros-send":
            ros_send(options.topic, options.rate, options.seconds, options.image)
        else:
            if options.role == "mqtt-receive":
                mqtt_receive(target, options.topic, meter, options.seconds)
            else:
                ros_receive(options.topic, meter, options.seconds, options.image)
            sys.stdout.write(json.dumps(asdict(meter.result())) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
