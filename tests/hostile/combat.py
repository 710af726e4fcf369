"""What an attacker has at hand: connections that never block it, and bytes made beforehand.

An attack runs in a process of its own, at a low priority: on this computer it would else take the
broker's processor, which a client on the network cannot.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import math
import multiprocessing
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
from witness import HEAD_END, PONG, UPGRADE, Over, Target, frame, take_frame

from appliance.mqtt.packets import V5, V311, Connect, Packet

#: Who attacks, with a right password and the right to read and write everything under the robot.
USER = "mallory"

#: Seconds for what takes milliseconds when nothing is attacked.
PATIENCE = 15.0

#: Seconds that the healthy client may have to wait for its own message.
ROUND_TRIP = 0.5

#: Seconds that an attack may end later than it should.
LATEST = 1.0

#: Connections that are opened at a time.
AT_A_TIME = 32

_spawn = multiprocessing.get_context("spawn")


class Line(asyncio.Protocol):
    """One connection; `received` counts what came, of which only a login's answer is kept."""

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

    def say(self, *packets: bytes) -> None:
        """Send, without a care for how much waits; nothing when the broker has closed."""
        if self.open:
            self.write(packets[0] if len(packets) == 1 else b"".join(packets))

    def write(self, data: bytes) -> None:
        """Send so many bytes of MQTT."""
        self.transport.write(data)

    async def send(self, data: bytes) -> None:
        """Send as fast as the broker reads."""
        self.say(data)
        await self._room.wait()

    async def push(self, data: bytes) -> None:
        """Send the bytes as they are, whatever is below MQTT, as fast as the broker reads."""
        if self.open:
            self.transport.write(data)
        await self._room.wait()

    async def hear(self, count: int) -> bool:
        """Wait until so many bytes came in all; False when the broker closed before."""
        self._expected = count
        if self.received < count and not self.closed.is_set():
            self._came.clear()
            await asyncio.wait_for(self._came.wait(), PATIENCE)
        return self.received >= count

    def deaf(self) -> None:
        """Read nothing more."""
        if self.open:
            self.transport.pause_reading()

    def hang_up(self) -> None:
        """Be gone without a word."""
        with contextlib.suppress(OSError):
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.transport.abort()

    def half_close(self) -> None:
        """Say on the network that nothing more comes, and stay."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_WR)


class WebLine(Line):
    """One over WebSocket: what is said goes out in one frame, and what frames hold is received."""

    def __init__(self, sock: socket.socket) -> None:
        super().__init__(sock)
        #: The answer to the request is there.
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
        """Ask for the WebSocket, and wait for it."""
        self.transport.write(UPGRADE)
        await asyncio.wait_for(self.upgraded.wait(), PATIENCE)
        if not self.open:
            raise ConnectionError("no WebSocket connection")


#: What every other connection is made over where nothing else is said.
BOTH = (Over.TLS, Over.PLAIN)


class Fight:
    """One attack on one broker, for so many seconds.

    Its connections are made over each of `ways` in turn.
    """

    def __init__(self, target: Target, ways: tuple[Over, ...], seconds: float) -> None:
        self.target = target
        self.ways = ways
        self.seconds = seconds
        #: What was done how often, for the report.
        self.counts: Counter[str] = Counter()
        self.lines: set[Line] = set()
        self._context = target.context()
        self._next_way = itertools.cycle(ways)
        self._loop = asyncio.get_running_loop()
        self._end = self._loop.time() + seconds

    @property
    def on(self) -> bool:
        """Whether the attack goes on."""
        return self._loop.time() < self._end

    def within(self, part: float) -> bool:
        """Whether that part of the time is not over yet."""
        return self._loop.time() < self._end - (1 - part) * self.seconds

    async def rounds(self, pause: float = 0.0) -> AsyncIterator[int]:
        """Count until the time is over, with so many seconds between the rounds."""
        number = 0
        while self.on:
            yield number
            number += 1
            await asyncio.sleep(pause)

    async def raw(self, over: Over | None = None, *, receive_buffer: int = 0) -> socket.socket:
        """A TCP connection to one of the listeners, with nothing said on it."""
        port = self.target.port_of(over or next(self._next_way))
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
        """A connection with its handshake, be it of TLS or WebSocket, done.

        Raises:
            OSError: the broker does not take it.
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

    async def join(
        self,
        client_id: str,
        *,
        version: int = V5,
        receive_buffer: int = 0,
        packet: bytes = b"",
        **fields: Any,
    ) -> Line:
        """A client that has logged in, with this CONNECT if there is one.

        Raises:
            OSError: the broker does not take it.
        """
        line = await self.dial(receive_buffer=receive_buffer)
        line.say(packet or self.connect_packet(client_id, version=version, **fields))
        if not await line.hear(4) or line.first[3]:
            raise ConnectionError(f"'{client_id}' is not let in: {line.first.hex()}")
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
        """So many connections made by `make(number)`, or those that part of the time allows."""
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
        """Run all of it until the time is over."""
        tasks = [asyncio.ensure_future(one) for one in work]
        left = max(0.0, self._end - self._loop.time())
        done, _ = await asyncio.wait(tasks, timeout=left)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for task in done:
            error = None if task.cancelled() else task.exception()
            if error is not None and not isinstance(error, OSError):
                raise error

    async def flood(self, line: Line, data: bytes, count: int, what: str) -> None:
        """Send `data`, which is `count` of `what`, again and again until the time is over."""
        while self.on and line.open:
            await line.send(data)
            self.counts[what] += count
            await asyncio.sleep(0)

    def leave(self) -> None:
        """Drop all connections at once."""
        for line in self.lines:
            line.hang_up()


@dataclass(frozen=True, slots=True)
class Attack:
    """`run` is what is done, `says` what the log must say about who did it.

    `limits` are of `broker.limits`, beside those of `arena.LIMITS`; with less time than `at_least`
    (seconds) nothing comes of it, and with less than `said_after` too little for the log to tell:
    the buffers on the way take that long to fill. `short` is whether it is worth a second in CI,
    beside the others. `p99` is what 99 of 100 round trips of the healthy client may take, and
    `worst` what the longest may, in seconds. `over` is what it is for, when not for everything.
    """

    name: str
    what: str
    run: Callable[[Fight], Awaitable[None]]
    says: str
    limits: dict[str, Any] = field(default_factory=dict)
    at_least: float = 0.0
    short: bool = True
    said_after: float = 0.0
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


class Attacker:
    """The process that attacks, one thing after the other."""

    def __init__(self) -> None:
        self._pipe, end = _spawn.Pipe()
        self._process = _spawn.Process(target=_serve, args=(end,), daemon=True)
        self._process.start()
        end.close()

    def attack(
        self, name: str, target: Target, ways: tuple[Over, ...], seconds: float
    ) -> tuple[Counter[str], str]:
        """What was done how often, and what went wrong, when the attack is over."""
        self._pipe.send((name, target, ways, seconds))
        assert self._pipe.poll(seconds + 3 * PATIENCE), "the attack does not come to its end"
        counts, failure = self._pipe.recv()
        return counts, failure

    def end(self) -> None:
        """Leave nothing running."""
        self._process.kill()
        self._process.join()
        self._pipe.close()


def _serve(pipe: Connection) -> None:
    from attacks import ATTACKS

    os.nice(10)
    logging.disable(logging.CRITICAL)  # asyncio's, of connections that end in every way there is
    while True:
        name, target, ways, seconds = pipe.recv()
        pipe.send(uvloop.run(_fight(ATTACKS[name], target, ways, seconds)))


async def _fight(
    attack: Attack, target: Target, ways: tuple[Over, ...], seconds: float
) -> tuple[Counter[str], str]:
    fight = Fight(target, ways, seconds)
    failure = ""
    try:
        # What the broker does not answer, or does not take, is not waited for.
        await asyncio.wait_for(attack.run(fight), seconds + LATEST)
    except asyncio.TimeoutError:
        fight.counts["broken off"] = 1
    except Exception:
        failure = traceback.format_exc()
    fight.leave()
    await asyncio.sleep(0.05)  # for the transports to close
    return fight.counts, failure
