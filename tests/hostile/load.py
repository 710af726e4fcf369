"""The attacker's tools: connections that never block it, and the process that it runs in.

The process has a low priority. Otherwise it would take CPU time from the broker on this computer,
which a client on the network cannot do.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import math
import os
import socket
import struct
import traceback
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any, cast

import uvloop
from witness import HEAD_END, PONG, UPGRADE, Over, ServingProcess, Target, frame, take_frame

from appliance.mqtt.packets import V5, V311, Connect, Packet

#: The attacker: it has a valid password, and may read and write everything under the robot.
USER = "mallory"

#: Timeout in seconds for steps that take milliseconds on an idle broker.
PATIENCE = 15.0

#: Longest round trip of the healthy client, in seconds.
ROUND_TRIP = 0.5

#: Seconds that an attack may overrun.
LATEST = 1.0

#: Seconds between two looks at the clock while work is waited for.
LOOK = 0.05

#: Connections that are opened concurrently.
AT_A_TIME = 32


class Line(asyncio.Protocol):
    """One connection; `received` counts bytes, `first` has the answer to a login."""

    def __init__(self, sock: socket.socket) -> None:
        self.socket = sock
        self.transport: asyncio.Transport
        self.received = 0
        self.first = bytearray()
        self._expected = 0
        self._room = asyncio.Event()
        self._room.set()
        self._came = asyncio.Event()
        self.closed = asyncio.Event()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        self.transport.set_write_buffer_limits(high=256 * 1024)

    def data_received(self, data: bytes) -> None:
        self.received += len(data)
        if len(self.first) < 64:
            self.first += data[:64]
        if self.received >= self._expected:
            self._came.set()

    def connection_lost(self, exc: Exception | None) -> None:
        self.closed.set()
        self._room.set()
        self._came.set()

    def pause_writing(self) -> None:
        self._room.clear()

    def resume_writing(self) -> None:
        self._room.set()

    @property
    def open(self) -> bool:
        return not self.closed.is_set() and not self.transport.is_closing()

    def send_nowait(self, *packets: bytes) -> None:
        """Send without backpressure; does nothing when the broker has closed."""
        if self.open:
            self.write(packets[0] if len(packets) == 1 else b"".join(packets))

    def write(self, data: bytes) -> None:
        """Write bytes of MQTT to the transport."""
        self.transport.write(data)

    async def send(self, data: bytes) -> None:
        """Send as fast as the broker reads."""
        self.send_nowait(data)
        await self._room.wait()

    async def push(self, data: bytes) -> None:
        """Send raw bytes, without WebSocket frames around them, as fast as the broker reads."""
        if self.open:
            self.transport.write(data)
        await self._room.wait()

    async def receive(self, count: int) -> bool:
        """Wait until `count` bytes have come in all; False when the broker closed before."""
        self._expected = count
        if self.received < count and not self.closed.is_set():
            self._came.clear()
            await asyncio.wait_for(self._came.wait(), PATIENCE)
        return self.received >= count

    def stop_reading(self) -> None:
        """Stop reading from the socket."""
        if self.open:
            self.transport.pause_reading()

    def abort(self) -> None:
        """Reset the connection, without DISCONNECT."""
        with contextlib.suppress(OSError):
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.transport.abort()

    def half_close(self) -> None:
        """Send a FIN and keep the connection."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_WR)


class WebLine(Line):
    """A connection over WebSocket: each write is one frame, and payloads of frames are received."""

    def __init__(self, sock: socket.socket) -> None:
        super().__init__(sock)
        #: Set when the answer to the upgrade request has come.
        self.upgraded = asyncio.Event()
        self.pongs = 0
        self._frames = bytearray()

    def data_received(self, data: bytes) -> None:
        self._frames += data
        if not self.upgraded.is_set():
            end = self._frames.find(HEAD_END)
            if end < 0:
                return
            del self._frames[: end + len(HEAD_END)]
            self.upgraded.set()
        while (taken := take_frame(self._frames)) is not None:
            opcode, payload = taken
            self.pongs += opcode == PONG
            if opcode < 8:
                super().data_received(payload)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.upgraded.set()

    def write(self, data: bytes) -> None:
        self.transport.write(frame(data))

    async def upgrade(self) -> None:
        """Request the WebSocket upgrade and wait for the answer."""
        self.transport.write(UPGRADE)
        await asyncio.wait_for(self.upgraded.wait(), PATIENCE)
        if not self.open:
            raise ConnectionError("no WebSocket connection")


#: By default connections alternate between these two.
BOTH = (Over.TLS, Over.PLAIN)


class Load:
    """One attack on one broker for `seconds`; its connections alternate between `ways`.

    The time counts from the first connection, and again from the first login: on a busy computer it
    takes seconds to make up what is sent, and to hash the first password, and an attack that is
    over before it begins shows nothing. Each of these may take `PATIENCE`.
    """

    def __init__(self, target: Target, ways: tuple[Over, ...], seconds: float) -> None:
        self.target = target
        self.ways = ways
        self.seconds = seconds
        #: How often each thing was done, for the report.
        self.counts: Counter[str] = Counter()
        self.lines: set[Line] = set()
        self._context = target.context()
        self._next_way = itertools.cycle(ways)
        self._loop = asyncio.get_running_loop()
        self._connected = self._joined = False
        self._end = 0.0
        self._lasts(PATIENCE)

    def _lasts(self, seconds: float) -> None:
        self._end = self._loop.time() + seconds

    @property
    def on(self) -> bool:
        """Whether the attack goes on."""
        return self._loop.time() < self._end

    def within(self, part: float) -> bool:
        """Whether less than that part of the time has passed."""
        return self._loop.time() < self._end - (1 - part) * self.seconds

    async def rounds(self, pause: float = 0.0) -> AsyncIterator[int]:
        """Count rounds until the time is over, `pause` seconds apart."""
        number = 0
        while self.on:
            yield number
            number += 1
            await asyncio.sleep(pause)

    async def raw(
        self, over: Over | None = None, *, receive_buffer: int = 0, port: int = 0
    ) -> socket.socket:
        """A TCP connection to one of the listeners; nothing has been sent on it."""
        if not self._connected:
            self._connected = True
            self._lasts(self.seconds)
        port = port or self.target.port_of(over or next(self._next_way))
        sock = socket.socket()
        try:
            sock.setblocking(False)
            if receive_buffer:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
            await asyncio.wait_for(self._loop.sock_connect(sock, ("127.0.0.1", port)), PATIENCE)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except BaseException:
            sock.close()
            raise
        self.counts["connections"] += 1
        return sock

    async def dial(self, over: Over | None = None, *, receive_buffer: int = 0) -> Line:
        """A connection whose TLS or WebSocket handshake is done.

        Raises:
            OSError: the broker does not accept it.
        """
        over = over or next(self._next_way)
        sock = await self.raw(over, receive_buffer=receive_buffer)
        kind = WebLine if over is Over.WEBSOCKET else Line
        secure = over is Over.TLS
        _, line = await self._loop.create_connection(
            lambda: kind(sock),
            sock=sock,
            ssl=self._context if secure else None,
            server_hostname="localhost" if secure else None,
            ssl_handshake_timeout=PATIENCE if secure else None,
        )
        self.lines.add(line)
        if isinstance(line, WebLine):
            await line.upgrade()
        return line

    async def http(self) -> Line:
        """A connection to the listener for the web, without TLS."""
        sock = await self.raw(port=self.target.http_port)
        _, line = await self._loop.create_connection(lambda: Line(sock), sock=sock)
        self.lines.add(line)
        return line

    async def join(
        self,
        client_id: str,
        *,
        version: int = V5,
        receive_buffer: int = 0,
        packet: bytes = b"",
        **fields: Any,
    ) -> Line:
        """A client that has logged in, with `packet` as its CONNECT if there is one.

        Raises:
            OSError: the broker does not accept it.
        """
        line = await self.dial(receive_buffer=receive_buffer)
        first = not self._joined
        if first:
            self._joined = True
            self._lasts(PATIENCE)
        try:
            line.send_nowait(packet or self.connect_packet(client_id, version=version, **fields))
            if not await line.receive(4) or line.first[3]:
                raise ConnectionError(f"'{client_id}' is not let in: {line.first.hex()}")
        finally:
            if first:
                self._lasts(self.seconds)
        self.counts["logins"] += 1
        return line

    def connect_packet(self, client_id: str, *, version: int = V5, **fields: Any) -> bytes:
        """A CONNECT with the attacker's right password, unless `fields` say otherwise."""
        password = self.target.passwords[USER].encode()
        values = {"username": USER, "password": password, "version": version} | fields
        return Connect(client_id, **values).encode()

    async def crowd(
        self, count: int, make: Callable[[int], Awaitable[Line]], part: float = 0.6
    ) -> list[Line]:
        """`count` connections made by `make(number)`, or as many as `part` of the time allows."""
        numbers = iter(range(count))
        made: list[Line] = []

        async def worker() -> None:
            for number in numbers:
                if not self.within(part):
                    return
                try:
                    made.append(await make(number))
                except (OSError, asyncio.TimeoutError):
                    self.counts["connections refused"] += 1
                    await asyncio.sleep(0.01)

        await asyncio.gather(*(worker() for _ in range(min(AT_A_TIME, count))))
        self.counts["crowd"] = max(self.counts["crowd"], len(made))
        return made

    async def together(self, *work: Coroutine[Any, Any, None]) -> None:
        """Run all of these concurrently until the time is over."""
        tasks = [asyncio.ensure_future(one) for one in work]
        done = await self.finish(tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for task in done:
            error = None if task.cancelled() else task.exception()
            if error is not None and not isinstance(error, OSError):
                raise error

    async def finish(
        self, tasks: list[asyncio.Task[None]], overrun: float = 0.0
    ) -> set[asyncio.Task[None]]:
        """Wait until all are done or the time and `overrun` are over; returns those done.

        The end is looked for again and again, because it moves (see the class).
        """
        waiting = set(tasks)
        while waiting and (left := self._end + overrun - self._loop.time()) > 0:
            _, waiting = await asyncio.wait(waiting, timeout=min(left, LOOK))
        return set(tasks) - waiting

    async def flood(self, line: Line, data: bytes, count: int, what: str) -> None:
        """Send `data`, which counts as `count` of `what`, repeatedly until the time is over."""
        while self.on and line.open:
            await line.send(data)
            self.counts[what] += count
            await asyncio.sleep(0)

    def leave(self) -> None:
        """Reset all connections at once."""
        for line in self.lines:
            line.abort()


@dataclass(frozen=True, slots=True)
class Attack:
    """`run` is the attack, `log_pattern` matches the log line that must name the client behind it.

    `limits` are keys of `broker.limits`, on top of `server.LIMITS`. An attack takes at least
    `at_least` seconds to have an effect, and `logged_after` seconds until the log can mention it,
    because buffers on the way have to fill first. `short`: it is worth a second in CI, where all
    run. `p99` and `worst` bound the healthy client's round trips, in seconds. `over` is the one
    transport that it is for; None for all.
    """

    name: str
    what: str
    run: Callable[[Load], Awaitable[None]]
    log_pattern: str
    limits: dict[str, Any] = field(default_factory=dict)
    at_least: float = 0.0
    short: bool = True
    logged_after: float = 0.0
    p99: float = math.inf
    worst: float = ROUND_TRIP
    over: Over | None = None


def encode(version: int, *packets: Packet) -> bytes:
    """The packets as one chunk."""
    return b"".join(packet.encode(version) for packet in packets)


def encode5(*packets: Packet) -> bytes:
    return encode(V5, *packets)


def encode4(*packets: Packet) -> bytes:
    return encode(V311, *packets)


class Attacker(ServingProcess):
    """The attacker's process; it runs one attack after the other."""

    def __init__(self) -> None:
        super().__init__(_serve)

    def attack(
        self, name: str, target: Target, ways: tuple[Over, ...], seconds: float
    ) -> tuple[Counter[str], str]:
        """Run an attack to its end; returns its counts and, if it failed, why."""
        self._pipe.send((name, target, ways, seconds))
        assert self._pipe.poll(seconds + 10 * PATIENCE), "the attack does not come to its end"
        counts, failure = self._pipe.recv()
        return counts, failure


def yield_to_all() -> None:
    """Let others go before this process: attackers have computers of their own, but not here."""
    if os.nice(0) < 10:
        os.nice(10)
    else:  # all have the lowest priority; below it is only this
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def _serve(pipe: Connection) -> None:
    from attacks import ATTACKS

    yield_to_all()
    logging.disable(logging.CRITICAL)  # asyncio logs each of these connections that end badly
    while True:
        name, target, ways, seconds = pipe.recv()
        pipe.send(uvloop.run(_run_attack(ATTACKS[name], target, ways, seconds)))


async def _run_attack(
    attack: Attack, target: Target, ways: tuple[Over, ...], seconds: float
) -> tuple[Counter[str], str]:
    load = Load(target, ways, seconds)
    failure = ""
    task = asyncio.ensure_future(attack.run(load))
    # The broker may neither answer nor read; the attack ends anyway.
    if not await load.finish([task], LATEST):
        load.counts["broken off"] = 1
        task.cancel()
    try:
        await task
    except asyncio.CancelledError:
        pass
    except Exception:
        failure = traceback.format_exc()
    load.leave()
    await asyncio.sleep(0.05)  # for the transports to close
    return load.counts, failure
