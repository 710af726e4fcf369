"""The healthy client beside an attack: a QoS 1 round trip every 20 ms, in a process of its own."""

from __future__ import annotations

import contextlib
import gc
import math
import multiprocessing
import socket
import ssl
import time
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


@dataclass(frozen=True, slots=True)
class Target:
    """The broker, for processes that attack it and that live with it."""

    port: int
    plain_port: int
    ca: Path
    passwords: dict[str, str]

    def context(self) -> ssl.SSLContext:
        """What a client that has the CA's certificate trusts."""
        return ssl.create_default_context(cafile=self.ca)


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


class Witness:
    """The process; it measures from `begin` to `report`, and may do so again."""

    def __init__(self) -> None:
        self._pipe, end = _spawn.Pipe()
        self._process = _spawn.Process(target=_serve, args=(end,), daemon=True)
        self._process.start()
        end.close()

    def begin(self, target: Target, *, tls: bool) -> None:
        """Connect; returns when round trips are being measured."""
        self._pipe.send((target, tls))
        assert self._pipe.poll(4 * GIVE_UP), "the healthy client does not come to its begin"
        ready = self._pipe.recv()
        assert ready == "ready", ready

    def report(self) -> Report:
        self._pipe.send("stop")
        assert self._pipe.poll(4 * GIVE_UP), "the healthy client does not come to its end"
        report: Report = self._pipe.recv()
        return report

    def end(self) -> None:
        """Leave nothing running."""
        self._process.kill()
        self._process.join()
        self._pipe.close()


class _Stream:
    """A blocking connection, read by the size that is expected."""

    def __init__(self, target: Target, *, tls: bool) -> None:
        port = target.port if tls else target.plain_port
        self.socket = socket.create_connection(("localhost", port), GIVE_UP)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if tls:
            self.socket = target.context().wrap_socket(self.socket, server_hostname="localhost")
        self._buffer = bytearray()

    def close(self) -> None:
        self.socket.close()

    def log_in(self, password: str) -> None:
        """CONNECT, and SUBSCRIBE to its own topic."""
        connect = Connect(CLIENT_ID, version=V311, username="alice", password=password.encode())
        self.socket.sendall(connect.encode())
        self.expect(b"\x20\x02\0\0")
        self.socket.sendall(Subscribe(1, [Subscription(TOPIC, 1)]).encode(V311))
        self.expect(b"\x90\x03\0\x01\x01")

    def expect(self, expected: bytes) -> None:
        """Read so many bytes, which are these."""
        while len(self._buffer) < len(expected):
            data = self.socket.recv(65536)
            if not data:
                raise ConnectionError("the broker closed the healthy client's connection")
            self._buffer += data
        got = bytes(self._buffer[: len(expected)])
        del self._buffer[: len(expected)]
        if got != expected:
            raise AssertionError(f"the healthy client got {got.hex()}, not {expected.hex()}")


def _serve(pipe: Connection) -> None:
    gc.freeze()
    gc.disable()  # it would be measured, too
    while True:
        pipe.send(_measure(*pipe.recv(), pipe))


def _measure(target: Target, tls: bool, pipe: Connection) -> Report:
    """Round trips until something is asked for."""
    round_trips: list[float] = []
    failure = ""
    try:
        with contextlib.closing(_Stream(target, tls=tls)) as stream:
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
    stream.socket.sendall(message)
    stream.expect(message + Puback(packet_id).encode(V311))
    stream.socket.sendall(Puback(packet_id).encode(V311))
