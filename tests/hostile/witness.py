"""The healthy client beside an attack: a QoS 1 round trip every 20 ms, in a process of its own."""

from __future__ import annotations

import contextlib
import enum
import gc
import math
import multiprocessing
import socket
import ssl
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from appliance.mqtt.packets import V311, Connect, Puback, Publish, Subscribe, Subscription

#: Seconds from the begin of one round trip to that of the next.
INTERVAL = 0.02

#: Seconds after which the broker does not answer any more.
GIVE_UP = 5.0

CLIENT_ID = "healthy"
TOPIC = "r2d2/healthy/echo"
WARM_UP = 10

_spawn = multiprocessing.get_context("spawn")


class Over(enum.Enum):
    """What a connection is made over."""

    PLAIN = "plain"
    TLS = "TLS"
    WEBSOCKET = "ws"


@dataclass(frozen=True, slots=True)
class Target:
    """The broker, for processes that attack it and that live with it."""

    port: int
    plain_port: int
    ca: Path
    passwords: dict[str, str]
    web_port: int = 0
    http_port: int = 0

    def port_of(self, over: Over) -> int:
        ports = {Over.PLAIN: self.plain_port, Over.TLS: self.port, Over.WEBSOCKET: self.web_port}
        return ports[over]

    def context(self) -> ssl.SSLContext:
        """What a client that has the CA's certificate trusts."""
        return ssl.create_default_context(cafile=self.ca)


#: Asks for a WebSocket; what comes behind the end of the answer's head are frames.
UPGRADE = (
    b"GET /mqtt HTTP/1.1\r\nHost: robot\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Protocol: mqtt\r\n\r\n"
)
HEAD_END = b"\r\n\r\n"

#: Opcodes of RFC 6455, section 5.2.
CONTINUATION, TEXT, BINARY, PING, PONG = 0, 1, 2, 9, 10


def frame(payload: bytes, opcode: int = BINARY, *, last: bool = True) -> bytes:
    """A WebSocket frame of a client's, with a mask that changes nothing."""
    size = len(payload)
    head = bytes([opcode | (0x80 if last else 0)])
    if size < 126:
        head += bytes([0x80 | size])
    elif size < 65536:
        head += struct.pack(">BH", 0x80 | 126, size)
    else:
        head += struct.pack(">BQ", 0x80 | 127, size)
    return head + bytes(4) + payload


def take_frame(received: bytearray) -> tuple[int, bytes] | None:
    """Take the server's first frame out, if it is whole: its opcode and payload."""
    if len(received) < 2:
        return None
    size, begin = received[1], 2
    if size > 125:
        form, begin = (">H", 4) if size == 126 else (">Q", 10)
        if len(received) < begin:
            return None
        (size,) = struct.unpack_from(form, received, 2)
    if len(received) < begin + size:
        return None
    payload = bytes(received[begin : begin + size])
    opcode = received[0] & 15
    del received[: begin + size]
    return opcode, payload


@dataclass(frozen=True, slots=True)
class Report:
    """What the healthy client saw; seconds, sorted. `failure` is empty when nothing was lost."""

    round_trips: list[float]
    failure: str = ""

    @property
    def worst(self) -> float:
        return self.round_trips[-1] if self.round_trips else math.inf

    def percentile(self, part: float) -> float:
        if not self.round_trips:
            return math.inf
        return self.round_trips[min(int(part * len(self.round_trips)), len(self.round_trips) - 1)]


class ServingProcess:
    """A process that runs `serve`, and the pipe to it."""

    def __init__(self, serve: Callable[[Connection], None]) -> None:
        self._pipe, end = _spawn.Pipe()
        self._process = _spawn.Process(target=serve, args=(end,), daemon=True)
        self._process.start()
        end.close()

    def end(self) -> None:
        """Leave nothing running."""
        self._process.kill()
        self._process.join()
        self._pipe.close()


class Witness(ServingProcess):
    """The process; it measures from `begin` to `report`, and may do so again."""

    def __init__(self) -> None:
        super().__init__(_serve)

    def begin(self, target: Target, over: Over) -> None:
        """Connect; returns when round trips are being measured."""
        self._pipe.send((target, over))
        assert self._pipe.poll(4 * GIVE_UP), "the healthy client does not come to its begin"
        ready = self._pipe.recv()
        assert ready == "ready", ready

    def report(self) -> Report:
        self._pipe.send("stop")
        assert self._pipe.poll(4 * GIVE_UP), "the healthy client does not come to its end"
        report: Report = self._pipe.recv()
        return report


class _Stream:
    """A blocking connection, read by the size that is expected."""

    def __init__(self, target: Target, over: Over) -> None:
        self.socket = socket.create_connection(("localhost", target.port_of(over)), GIVE_UP)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._web = over is Over.WEBSOCKET
        if over is Over.TLS:
            self.socket = target.context().wrap_socket(self.socket, server_hostname="localhost")
        self._received = bytearray()  # of which nothing was taken out of its frames
        self._buffer = bytearray()
        if self._web:
            self.socket.sendall(UPGRADE)
            while HEAD_END not in self._received:
                self._received += self._receive()
            del self._received[: self._received.index(HEAD_END) + len(HEAD_END)]

    def close(self) -> None:
        self.socket.close()

    def send(self, data: bytes) -> None:
        self.socket.sendall(frame(data) if self._web else data)

    def _receive(self) -> bytes:
        data = self.socket.recv(65536)
        if not data:
            raise ConnectionError("the broker closed the healthy client's connection")
        return data

    def _receive_frames(self) -> bytes:
        self._received += self._receive()
        data = b""
        while (taken := take_frame(self._received)) is not None:
            data += taken[1]
        return data

    def log_in(self, password: str) -> None:
        """CONNECT, and SUBSCRIBE to its own topic."""
        connect = Connect(CLIENT_ID, version=V311, username="alice", password=password.encode())
        self.send(connect.encode())
        self.expect(b"\x20\x02\0\0")
        self.send(Subscribe(1, [Subscription(TOPIC, 1)]).encode(V311))
        self.expect(b"\x90\x03\0\x01\x01")

    def expect(self, expected: bytes) -> None:
        """Read so many bytes, which are these."""
        while len(self._buffer) < len(expected):
            self._buffer += self._receive_frames() if self._web else self._receive()
        got = bytes(self._buffer[: len(expected)])
        del self._buffer[: len(expected)]
        if got != expected:
            raise AssertionError(f"the healthy client got {got.hex()}, not {expected.hex()}")


def _serve(pipe: Connection) -> None:
    gc.freeze()
    gc.disable()  # it would be measured, too
    while True:
        pipe.send(_measure(*pipe.recv(), pipe))


def _measure(target: Target, over: Over, pipe: Connection) -> Report:
    """Round trips until something is asked for."""
    round_trips: list[float] = []
    failure = ""
    try:
        with contextlib.closing(_Stream(target, over)) as stream:
            stream.log_in(target.passwords["alice"])
            for number in range(WARM_UP):
                _round_trip(stream, number)
            pipe.send("ready")
            due = time.perf_counter()
            number = WARM_UP
            while not pipe.poll(max(0.0, due - time.perf_counter())):
                began = time.perf_counter()
                _round_trip(stream, number)
                took = time.perf_counter() - began
                number += 1
                # Those that should have begun meanwhile would have waited for the rest of it: else
                # a second of standstill would count as one bad sample among fifty good ones.
                while took > 0:
                    round_trips.append(took)
                    took -= INTERVAL
                due = max(due + INTERVAL, time.perf_counter())
    except Exception as error:
        failure = f"the healthy client broke off after {len(round_trips)} round trips: {error!r}"
        pipe.poll(None)
    pipe.recv()
    return Report(sorted(round_trips), failure)


def _round_trip(stream: _Stream, number: int) -> None:
    """Publish to itself; the broker's acknowledgement comes behind the message or before it."""
    packet_id = number % 65535 + 1
    message = Publish(TOPIC, b"%010d" % number, 1, packet_id=packet_id).encode(V311)
    stream.send(message)
    stream.expect(message + Puback(packet_id).encode(V311))
    stream.send(Puback(packet_id).encode(V311))
