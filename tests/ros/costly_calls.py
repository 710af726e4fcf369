"""python tests/ros/costly_calls.py [--seconds 10] [--only NAME …]

Sends the most costly calls and commands that a client can make, over 20 connections at once, beside
a healthy client. Prints the healthy client's round trips, and how many messages were converted or
rejected as too large, which shows that the costly part was reached. The exit code is 1 when a round
trip took too long. Needs rclpy; nothing has to run.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import fnmatch
import json
import math
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
sys.path.insert(0, str(HERE.parent / "hostile"))

import cbor2  # noqa: E402
import zstandard  # noqa: E402
from appliance_process import ApplianceProcess  # noqa: E402
from load import yield_to_all  # noqa: E402
from witness import Over, Report, Target, Witness  # noqa: E402

from appliance.mqtt.codec import Property  # noqa: E402
from appliance.mqtt.packets import (  # noqa: E402
    V5,
    Connect,
    Publish,
    Pubrel,
    Subscribe,
    Subscription,
)

CONNECTIONS = 20
USER = "mallory"
MIB = (1 << 20) - 4096

#: What the healthy client's round trips may take, in seconds.
P99 = 0.05
WORST = 0.25

BRIDGE = {
    "bus": "ros2",
    "topics": [
        {
            "ros": f"/costly/{encoding}",
            "to": "ros",
            "type": "test_msgs/msg/UnboundedSequences",
            "encoding": encoding.removesuffix("_zstd"),
            "compression": "zstd" if encoding.endswith("zstd") else "none",
        }
        for encoding in ("json", "cbor", "cdr", "json_zstd")
    ]
    + [
        {
            "ros": f"/costly/ruled/{encoding}",
            "to": "ros",
            "type": "test_msgs/msg/UnboundedSequences",
            "encoding": encoding,
            "expire": "500 ms",
            "on_silence": {"after": "500 ms"},
            "clamp": {"float64_values": [-1, 1]},
        }
        for encoding in ("json", "cdr")
    ]
    + [
        {"ros": "/costly/path", "to": "ros", "type": "nav_msgs/msg/Path"},
        {"ros": "/costly/ruled/path", "to": "ros", "type": "nav_msgs/msg/Path", "expire": "500 ms"},
    ],
    "services": [{"ros": "/costly", "type": "rcl_interfaces/srv/SetParameters"}],
}
ACL = f"""\
user alice
topic readwrite r2d2/#

user {USER}
topic write r2d2/costly/#
topic readwrite answers/#
"""


@dataclass(frozen=True, slots=True)
class Shape:
    """One kind of message. A call's answer is counted by its code; of commands it is counted how
    many were acknowledged. `expected` are the codes that say that it was looked into."""

    topic: str
    make: Callable[[], bytes]
    content_type: str = ""
    qos: int = 1
    expected: tuple[str, ...] = ()
    #: Messages of a connection under way.
    window: int = 2
    #: Messages of a QoS 2 connection that are released in one go.
    released: int = 10
    #: Whether they say that they are new, so that a route with rules carries them out.
    is_dated: bool = False


def cbor_of(item: bytes, size: int = MIB) -> bytes:
    """`{"parameters": [...]}` with nothing but this."""
    count = size // len(item)
    return b"\xa1" + cbor2.dumps("parameters") + b"\x9a" + count.to_bytes(4, "big") + item * count


def json_of(item: bytes, size: int = MIB, name: bytes = b"parameters") -> bytes:
    return b'{"' + name + b'": [' + item + (b"," + item) * (size // (len(item) + 1)) + b"]}"


def texts(count: int) -> list[str]:
    return ["a"] * count


def parameters(count: int) -> bytes:
    """A request that is right to the last field, with so many texts in it."""
    value = {
        "type": 9,
        **{f"{name}_value": zero for name, zero in _VALUES.items()},
        "string_array_value": texts(count),
    }
    return cbor2.dumps({"parameters": [{"name": "a", "value": value}]})


_VALUES: dict[str, object] = {
    "bool": False,
    "integer": 0,
    "double": 0.0,
    "string": "",
    "byte_array": b"",
    "bool_array": [],
    "integer_array": [],
    "double_array": [],
}


def sequences(count: int) -> dict[str, object]:
    """A message that is right to the last field, with so many texts in it."""
    from appliance.ros.payload.converter import compile_converter
    from appliance.ros.payload.definitions import load_description

    converter = compile_converter(load_description("test_msgs/msg/UnboundedSequences"))
    return converter.to_dict(converter.from_dict({})) | {"string_values": texts(count)}


def sequences_cdr(count: int) -> bytes:
    from appliance.ros.payload.converter import compile_converter
    from appliance.ros.payload.definitions import load_description

    converter = compile_converter(load_description("test_msgs/msg/UnboundedSequences"))
    return converter.from_values(sequences(count), 0)


def sequences_json(count: int) -> bytes:
    return json.dumps(sequences(count), separators=(",", ":")).encode()


def little_path() -> bytes:
    """A kilobyte, in which each element of a list is filled with its defaults."""
    return json_of(b"{}", 990, b"poses")


#: Texts that make a message as much work as it may be, and far too much.
JUST = 11_000
FAR = 100_000

CBOR, JSON = "application/cbor", "application/json"
CALL = "r2d2/costly/_call"
#: The service is not there: it is asked for when the call has been converted.
CONVERTED = ("unavailable",)
WEIGHED = ("too_large",)

SHAPES = {
    # The same bytes for nobody: what they cost without the bridge, and this computer without load.
    "nothing": Shape("answers/nobody", lambda: b"", window=0),
    "bytes-for-nobody": Shape("answers/nobody", lambda: bytes(MIB)),
    "call-cbor-typed-arrays": Shape(CALL, lambda: cbor_of(b"\xd8\x40\x40"), CBOR, 1, WEIGHED),
    "call-cbor-lists": Shape(CALL, lambda: cbor_of(b"\x80"), CBOR, 1, WEIGHED),
    "call-cbor-numbers": Shape(CALL, lambda: cbor_of(b"\x18\xff"), CBOR, 1, WEIGHED),
    "call-cbor-some-arrays": Shape(
        CALL, lambda: cbor_of(b"\xd8\x40\x40", 12_000), CBOR, 1, ("bad_request",), 10
    ),
    "call-cbor-texts": Shape(CALL, lambda: parameters(JUST), CBOR, 1, CONVERTED, 10),
    "call-json-texts": Shape(CALL, lambda: json_of(b'""'), JSON, 1, WEIGHED),
    "call-json-left-out": Shape(
        CALL, lambda: json_of(b"{}", 60_000), JSON, 1, (*WEIGHED, "bad_request"), 10
    ),
    "call-little": Shape(CALL, lambda: json_of(b"{}", 990), JSON, 1, CONVERTED, 250),
    "command-little": Shape("r2d2/costly/path", little_path, window=250),
    "ruled-little": Shape("r2d2/costly/ruled/path", little_path, window=250, is_dated=True),
    "released-little": Shape("r2d2/costly/path", little_path, qos=2),
    "command-json": Shape("r2d2/costly/json", lambda: sequences_json(JUST), window=10),
    "command-json-far": Shape("r2d2/costly/json", lambda: sequences_json(FAR)),
    "command-cdr": Shape("r2d2/costly/cdr", lambda: sequences_cdr(JUST), window=10),
    "command-cdr-far": Shape("r2d2/costly/cdr", lambda: sequences_cdr(FAR)),
    "command-cbor": Shape("r2d2/costly/cbor", lambda: cbor2.dumps(sequences(JUST)), window=10),
    "command-zstd": Shape(
        "r2d2/costly/json_zstd", lambda: zstandard.compress(sequences_json(JUST)), window=10
    ),
    "command-zstd-bomb": Shape(
        "r2d2/costly/json_zstd", lambda: zstandard.compress(json_of(b'""')), window=10
    ),
    "ruled-json": Shape(
        "r2d2/costly/ruled/json", lambda: sequences_json(JUST), window=10, is_dated=True
    ),
    "ruled-json-far": Shape("r2d2/costly/ruled/json", lambda: sequences_json(FAR), is_dated=True),
    "ruled-cdr": Shape(
        "r2d2/costly/ruled/cdr", lambda: sequences_cdr(JUST), window=10, is_dated=True
    ),
    "ruled-queue": Shape("r2d2/costly/ruled/json", lambda: sequences_json(JUST), window=10),
    "ruled-released": Shape(
        "r2d2/costly/ruled/json", lambda: sequences_json(JUST), qos=2, is_dated=True
    ),
    "command-released": Shape("r2d2/costly/json", lambda: sequences_json(JUST), qos=2),
}


class CostlyClient(asyncio.Protocol):
    """A connection that sends as fast as it is answered."""

    def __init__(self, name: str, shape: Shape, payload: bytes, counts: Counter[str]) -> None:
        self._name = name
        self._shape = shape
        self._payload = payload
        self._counts = counts
        self._packet_id = 0
        self._buffer = bytearray()
        self._held: list[int] = []

    def begin(self, password: bytes) -> None:
        self._transport.write(
            Connect(self._name, version=V5, username=USER, password=password).encode()
            + Subscribe(1, [Subscription(f"answers/{self._name}", 0)]).encode(V5)
        )

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        self._buffer += data
        while (packet := self._packet()) is not None:
            self._take(*packet)

    def _packet(self) -> tuple[int, bytes] | None:
        buffer = self._buffer
        length = shift = 0
        for at in range(1, min(5, len(buffer))):
            length |= (buffer[at] & 127) << shift
            shift += 7
            if buffer[at] < 128:
                end = at + 1 + length
                if len(buffer) < end:
                    return None
                packet = buffer[0], bytes(buffer[at + 1 : end])
                del buffer[:end]
                return packet
        return None

    def _take(self, first: int, body: bytes) -> None:
        kind = first >> 4
        if kind == 9:  # SUBACK
            for _ in range(self._shape.window if self._shape.qos < 2 else self._shape.released):
                self._send()
        elif kind == 3:
            found = [name for name in CODES if name.encode() in body]
            self._counts[found[0] if found else "another answer"] += 1
            self._send()
        elif kind == 4:
            if not self._shape.content_type:
                self._counts["acknowledged"] += 1
                self._send()
        elif kind == 5:  # PUBREC: all are released at once
            self._held.append(int.from_bytes(body[:2], "big"))
            if len(self._held) == self._shape.released:
                self._transport.write(b"".join(Pubrel(one).encode(V5) for one in self._held))
        elif kind == 7:
            self._counts["released"] += 1
            self._held.pop()
            if not self._held:
                for _ in range(self._shape.released):
                    self._send()
        elif kind == 14:
            self._counts[f"disconnected {body[:1].hex()}"] += 1

    def _send(self) -> None:
        shape = self._shape
        self._packet_id = self._packet_id % 65535 + 1
        properties = None
        if shape.content_type:
            properties = {
                Property.CONTENT_TYPE: shape.content_type,
                Property.RESPONSE_TOPIC: f"answers/{self._name}",
            }
        elif shape.is_dated:
            properties = {Property.USER_PROPERTY: [("sent-at", str(time.time()))]}
        packet = Publish(
            shape.topic,
            self._payload,
            shape.qos,
            packet_id=self._packet_id,
            properties=properties,
        )
        self._transport.write(packet.encode(V5))
        self._counts["sent"] += 1


CODES = ("too_large", "too_many", "bad_request", "unavailable", "timeout", "expired", "ros_error")


async def _attack(name: str, target: Target, seconds: float) -> Counter[str]:
    shape = SHAPES[name]
    payload = shape.make()
    counts: Counter[str] = Counter()
    loop = asyncio.get_running_loop()
    lines = []
    for number in range(CONNECTIONS):
        transport, line = await loop.create_connection(
            lambda number=number: CostlyClient(f"m{number}", shape, payload, counts),  # type: ignore[misc]
            "127.0.0.1",
            target.plain_port,
        )
        lines.append((transport, line))
    for _, line in lines:
        line.begin(target.passwords[USER].encode())
    await asyncio.sleep(seconds)
    for transport, _ in lines:
        transport.abort()
    return counts


def _serve(pipe: multiprocessing.connection.Connection) -> None:
    yield_to_all()
    while True:
        pipe.send(asyncio.run(_attack(*pipe.recv())))


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one attack did."""

    name: str
    seen: Report
    counts: Counter[str]
    #: What routes say that they have published and refused, of commands.
    published: int
    refused: int

    @property
    def reached(self) -> float:
        """How often the costly part was reached."""
        shape = SHAPES[self.name]
        if shape.topic == "answers/nobody":
            return math.inf
        if shape.expected:
            return sum(self.counts[code] for code in shape.expected)
        return self.published + self.refused


@contextlib.contextmanager
def attacked_server(directory: Path) -> Iterator[Callable[[str, float], Outcome]]:
    """An appliance, and the function that attacks it."""
    spawn = multiprocessing.get_context("spawn")
    appliance = ApplianceProcess(
        directory, users={USER: "knows the password"}, acl=ACL, bridge=BRIDGE
    )
    appliance.start()
    witness = Witness()
    pipe, end = spawn.Pipe()
    attacker = spawn.Process(target=_serve, args=(end,), daemon=True)
    attacker.start()
    target = Target(appliance.port, appliance.plain_port, appliance.ca, dict(appliance.passwords))

    def attack(name: str, seconds: float) -> Outcome:
        before = _routes(appliance)
        witness.begin(target, Over.PLAIN)
        pipe.send((name, target, seconds))
        assert pipe.poll(seconds + 60), f"{name} does not come to its end"
        counts = pipe.recv()
        seen = witness.report()
        after = _routes(appliance)
        return Outcome(name, seen, counts, after[0] - before[0], after[1] - before[1])

    try:
        appliance.wait_for_log("on ROS as")
        yield attack
    finally:
        attacker.kill()
        attacker.join()
        witness.end()
        appliance.stop()


def _routes(appliance: ApplianceProcess) -> tuple[int, int]:
    """Messages that went to ROS, and that failed, so far."""
    said = subprocess.run(
        [sys.executable, "-m", "appliance", "routes", "--json", "-c", appliance.config],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    routes = [json.loads(line) for line in said.stdout.splitlines()]
    routes = [route for route in routes if "/costly/" in str(route)]
    refused = ("errors", "expired")
    return (
        sum(route.get("messages") or 0 for route in routes),
        sum(route.get(what) or 0 for route in routes for what in refused),
    )


def problems(
    outcome: Outcome, p99: float = P99, worst: float = WORST, least: int = CONNECTIONS
) -> list[str]:
    """What is wrong with it, when the costly part has to be reached so often."""
    found = []
    seen = outcome.seen
    if seen.failure:
        found.append(seen.failure)
    if seen.percentile(0.99) > p99:
        found.append(f"p99 of a round trip: {seen.percentile(0.99) * 1000:.0f} ms")
    if seen.worst > worst:
        found.append(f"a round trip took {seen.worst * 1000:.0f} ms")
    if outcome.reached < least:
        found.append(f"the costly part was reached {outcome.reached} times, not {least}")
    return found


def main() -> int:
    parser = argparse.ArgumentParser("python tests/ros/costly_calls.py", description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each kind of message")
    parser.add_argument("--only", action="append", metavar="NAME", help="may hold * and ?")
    arguments = parser.parse_args()
    wanted = arguments.only or ["*"]
    failed = 0
    print(f"{'message':<24} {'p50':>7} {'p99':>7} {'max':>7} ms  what became of them")
    with tempfile.TemporaryDirectory() as directory, attacked_server(Path(directory)) as attack:
        for name in SHAPES:
            if not any(fnmatch.fnmatch(name, one) for one in wanted):
                continue
            outcome = attack(name, arguments.seconds)
            seen = outcome.seen
            times = [seen.percentile(0.5), seen.percentile(0.99), seen.worst]
            said = ", ".join(f"{count} {what}" for what, count in sorted(outcome.counts.items()))
            found = problems(outcome)
            print(
                f"{name:<24} "
                + " ".join(f"{one * 1000:7.1f}" for one in times)
                + f"     {said}; routes: {outcome.published} published, {outcome.refused} refused"
                + (f"  FAILED: {'; '.join(found)}" if found else ""),
                flush=True,
            )
            failed += bool(found)
            time.sleep(0.5)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
