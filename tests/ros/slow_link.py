"""An image topic and a fast one, to a fast client and to one behind a slow link.

    python tests/ros/slow_link.py [--seconds 30] [--tls]

1 MB images at 30 Hz and a std_msgs/String at 1 kHz are bridged at once. One client reads as fast as
it can. The other is behind a relay that lets 10 Mbit/s through and holds next to nothing itself, as
a link does. Told are how old the texts are at either client, how old the images, and what was
dropped and counted.

The times of the sender are in the payloads, by the clock that all processes of a computer share.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import socket
import struct
import sys
import tempfile
import threading
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import yaml

TESTS = Path(__file__).parent.parent
sys.path[:0] = [str(TESTS), str(TESTS.parent)]

from appliance_process import HOST, ROBOT, ApplianceProcess  # noqa: E402

from appliance.host.environment import for_other_programs  # noqa: E402
from appliance.mqtt.packets import Connect, Subscribe, Subscription  # noqa: E402

IMAGE_SIZE = 1_000_000
IMAGE_RATE = 30
TEXT_RATE = 1000

#: Of the slow link, in bits a second, and what is on its way in it: 40 ms worth.
LINK = 10_000_000
IN_FLIGHT = LINK // 8 // 25

DROPPED = "$SYS/broker/publish/messages/dropped"

#: Seconds at the beginning that are not counted: connections warm up, ROS gets to know itself.
WARM_UP = 1.5


@dataclass
class Seen:
    """What a client has received: for each message its number, and its age in seconds.

    Numbers are those of the sender, who counts every message that it has sent.
    """

    texts: list[tuple[int, float]] = field(default_factory=list)
    images: list[tuple[int, float]] = field(default_factory=list)
    #: For each image, when its first byte and its last one came.
    spans: list[tuple[float, float]] = field(default_factory=list)
    #: Of all messages to all clients, as the broker has counted them.
    dropped: int = 0


# The sender, in a process of its own


def send(seconds: float) -> None:
    """Publish for so long; every message begins with its number and the time."""
    import rclpy
    from rclpy.node import Node
    from std_msgs.msg import String, UInt8MultiArray

    from appliance.ros.ros2 import fastdds

    fastdds.use_profile(os.environ)
    rclpy.init(args=[])
    node = Node("sender")
    texts = node.create_publisher(String, "/text", 100)
    images = node.create_publisher(UInt8MultiArray, "/image", 2)
    while not (texts.get_subscription_count() and images.get_subscription_count()):
        time.sleep(0.05)
    time.sleep(0.5)
    rest = bytes(IMAGE_SIZE - 16)
    start = time.monotonic()
    sent_texts = sent_images = 0
    while (elapsed := time.monotonic() - start) < seconds:
        while sent_texts < elapsed * TEXT_RATE:
            texts.publish(String(data=f"{sent_texts} {time.monotonic():.6f} ".ljust(64, "x")))
            sent_texts += 1
        if sent_images < elapsed * IMAGE_RATE:
            head = struct.pack("<qd", sent_images, time.monotonic())
            # Serialized by hand: rclpy takes longer for it than all the rest.
            images.publish(_image(head + rest))
            sent_images += 1
        time.sleep(0.0004)
    print(sent_texts, sent_images, flush=True)
    time.sleep(2.5)
    node.destroy_node()
    rclpy.try_shutdown()


def _image(data: bytes) -> bytes:
    """A serialized std_msgs/msg/UInt8MultiArray."""
    return b"\0\1\0\0" + struct.pack("<III", 0, 0, len(data)) + data


# The link


class Relay:
    """A TCP connection to the broker that lets no more than LINK bits a second through."""

    def __init__(self, port: int, rate: float | None) -> None:
        self._target = port
        self._rate = rate
        self._tasks: list[asyncio.Task] = []

    async def start(self) -> int:
        self._server = await asyncio.start_server(self._serve, HOST, 0, limit=IN_FLIGHT)
        return self._server.sockets[0].getsockname()[1]

    async def _serve(self, reader, writer) -> None:
        connection = socket.socket()
        # What has left the broker is on the link: there is no more room than that.
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, IN_FLIGHT // 2)
        connection.setblocking(False)
        await asyncio.get_running_loop().sock_connect(connection, ("127.0.0.1", self._target))
        up, down = await asyncio.open_connection(sock=connection, limit=IN_FLIGHT // 4)
        self._tasks = [
            asyncio.create_task(self._copy(reader, down, None)),
            asyncio.create_task(self._copy(up, writer, self._rate)),
        ]
        with contextlib.suppress(asyncio.CancelledError, ConnectionError):
            await asyncio.gather(*self._tasks)
        down.close()
        writer.close()

    async def _copy(self, reader, writer, rate) -> None:
        due = time.monotonic()
        while chunk := await reader.read(8192):
            if rate is not None:
                due = max(due, time.monotonic()) + len(chunk) * 8 / rate
                await asyncio.sleep(due - time.monotonic())
            writer.write(chunk)
            await writer.drain()

    async def stop(self) -> None:
        for task in self._tasks:
            task.cancel()
        self._server.close()
        await asyncio.sleep(0)


# The clients, in a process each: what one of them does is not to be measured at the other


def read(port: int, name: str, password: str) -> None:
    """Subscribe, note the age of everything until stdin ends, and write it to stdout.

    QoS 0, as telemetry is read.
    """
    connection = socket.create_connection((HOST, port))
    connect = Connect(client_id=name, username="alice", password=password.encode(), version=4)
    topics = (f"{ROBOT}/text", f"{ROBOT}/image", DROPPED)
    filters = [Subscription(topic, 0) for topic in topics]
    connection.sendall(connect.encode() + Subscribe(1, filters).encode(4))
    seen = Seen()

    def stop() -> None:
        sys.stdin.read()
        connection.shutdown(socket.SHUT_RDWR)

    threading.Thread(target=stop, daemon=True).start()
    buffer = memoryview(bytearray(4 * IMAGE_SIZE))
    begin = end = 0
    began = 0.0  # when the first byte of an incomplete packet came
    while True:
        if begin == end:
            begin = end = 0
        elif len(buffer) - end < 2 * IMAGE_SIZE:
            buffer[: end - begin] = bytes(buffer[begin:end])
            begin, end = 0, end - begin
        size = connection.recv_into(buffer[end:])
        if not size:
            break
        now = time.monotonic()
        end += size
        began = began or now
        while (packet := _packet(buffer[begin:end])) is not None:
            head, size = packet
            if buffer[begin] == 0x90:
                print("ready", flush=True)
            elif buffer[begin] & 0xF0 == 0x30:
                _note(seen, buffer[begin + head : begin + head + size], began, now)
            begin += head + size
            began = now if begin < end else 0.0
    print(json.dumps(asdict(seen)))


def _packet(data: memoryview) -> tuple[int, int] | None:
    """The sizes of the first packet's head and of its rest; None when it is not complete."""
    size = 0
    for index in range(1, min(5, len(data))):
        size |= (data[index] & 0x7F) << 7 * (index - 1)
        if data[index] < 0x80:
            return (index + 1, size) if len(data) >= index + 1 + size else None
    return None


def _note(seen: Seen, body: memoryview, began: float, now: float) -> None:
    length = int.from_bytes(body[:2], "big")
    payload = body[2 + length :]
    topic = bytes(body[2 : 2 + length]).decode()
    if topic == DROPPED:
        seen.dropped = int(bytes(payload))
    elif topic.endswith("/image"):
        number, sent = struct.unpack_from("<qd", payload, 16)
        seen.images.append((number, now - sent))
        seen.spans.append((began, now))
    else:
        number, sent = bytes(payload).split()[:2]
        seen.texts.append((int(number), now - float(sent)))


class Client:
    """`read` in a process of its own."""

    async def start(self, name: str, port: int, password: str) -> None:
        self._process = await asyncio.create_subprocess_exec(
            *(sys.executable, __file__, "--read", str(port), name, password),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            env=_environment(),
        )
        assert self._process.stdout is not None
        assert await asyncio.wait_for(self._process.stdout.readline(), 20) == b"ready\n"

    async def stop(self) -> Seen:
        output, _ = await asyncio.wait_for(self._process.communicate(b""), 20)
        return Seen(**json.loads(output))


def _environment() -> dict[str, str]:
    return for_other_programs() | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


# The figures


@dataclass
class Outcome:
    """Ages in seconds. `staleness` is how old an image was when its transfer began."""

    fast: Seen
    slow: Seen
    texts: int
    images: int

    def fast_texts(self) -> list[float]:
        return sorted(age for number, age in self.fast.texts if number > WARM_UP * TEXT_RATE)

    def slow_texts(self) -> list[float]:
        return sorted(age for number, age in self.slow.texts if number > WARM_UP * TEXT_RATE)

    def transfers(self) -> list[float]:
        return sorted(end - begin for begin, end in self.slow.spans[2:])

    def staleness(self) -> list[float]:
        return sorted(
            age - (end - begin)
            for (_, age), (begin, end) in zip(self.slow.images, self.slow.spans, strict=True)
        )[:-2]


def at(values: list[float], part: float) -> float:
    return values[min(len(values) - 1, int(len(values) * part))] if values else float("nan")


async def trial(directory: Path, seconds: float) -> Outcome:
    appliance = ApplianceProcess(directory, acl=f"user alice\ntopic {ROBOT}/#\ntopic read $SYS/#\n")
    settings = yaml.safe_load(appliance.config.read_text())
    settings["broker"]["sys_interval"] = "1 s"
    settings["bridge"] = {
        "topics": [
            {"ros": "/text", "to": "mqtt", "encoding": "text", "keep": 1000},
            {"ros": "/image", "to": "mqtt", "encoding": "cdr", "qos": 0},
        ]
    }
    appliance.config.write_text(yaml.safe_dump(settings))
    appliance.start()
    relay, fast, slow = Relay(appliance.plain_port, LINK), Client(), Client()
    try:
        password = appliance.passwords["alice"]
        await fast.start("fast", appliance.plain_port, password)
        await slow.start("slow", await relay.start(), password)
        sender = await asyncio.create_subprocess_exec(
            *(sys.executable, __file__, "--send", str(seconds)),
            stdout=asyncio.subprocess.PIPE,
            env=_environment(),
        )
        assert sender.stdout is not None
        texts, images = map(int, (await sender.stdout.readline()).split())
        await sender.wait()  # what is on its way arrives meanwhile
        seen = [await client.stop() for client in (fast, slow)]
    finally:
        await relay.stop()
        appliance.stop()
    return Outcome(*seen, texts, images)


def report(outcome: Outcome) -> None:
    fast, slow = outcome.fast_texts(), outcome.slow_texts()
    print(f"sent {outcome.texts} texts, {outcome.images} images")
    for name, seen, ages in (("fast", outcome.fast, fast), ("slow", outcome.slow, slow)):
        print(
            f"{name}: {len(seen.texts)} texts, {len(seen.images)} images; age of the texts p50 "
            f"{at(ages, 0.5) * 1e3:.2f}, p99 {at(ages, 0.99) * 1e3:.2f}, "
            f"most {at(ages, 1) * 1e3:.1f} ms"
        )
    print(f"dropped, as counted: {outcome.fast.dropped}")
    stale, transfers = outcome.staleness(), outcome.transfers()
    print(
        f"slow's images: begun at an age of p50 {at(stale, 0.5) * 1e3:.0f}, most "
        f"{at(stale, 1) * 1e3:.0f} ms; took p50 {at(transfers, 0.5) * 1e3:.0f}, most "
        f"{at(transfers, 1) * 1e3:.0f} ms"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--send", type=float, help=argparse.SUPPRESS)
    parser.add_argument("--read", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.send:
        send(arguments.send)
    elif arguments.read:
        read(int(arguments.read[0]), *arguments.read[1:])
    else:
        with tempfile.TemporaryDirectory() as directory:
            report(asyncio.run(trial(Path(directory), arguments.seconds)))
