"""A TCP relay between the appliance and a broker, whose line can be made bad while it runs.

In a test, in its event loop::

    async with Relay(broker_port) as relay:
        relay.set(delay=0.05, rate=125_000)  # each way
        relay.silence()  # no FIN, no RST: nothing passes any more
        relay.release()  # what was sent meanwhile arrives now, as TCP sends it again

`up` is the way to the broker, `down` the one from it; most methods take one of them. Where the
relay shall not share the test's loop, `RelayProcess` is the same in a process of its own, and
`python tests/upstream/relay.py --to 127.0.0.1:1883` is a relay by hand: commands are lines of
stdin, such as `set delay=0.05 rate=125000`, `silence way=down`, `release`, `reset`, `stats`.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import shlex
import signal
import socket
import struct
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal

#: Bytes that a way holds before its sender has to wait: what is on a line of 20 Mbit/s at 100 ms.
CAPACITY = 256 * 1024

#: Seconds of the rate that are passed on at once: small enough for a rate to be even.
SLICE = 0.01

#: The least that is passed on at once, in bytes: a slow line sends packets, too.
LEAST = 256

RESET = struct.pack("ii", 1, 0)  # SO_LINGER: close() sends RST

Ends = Literal["up", "down"]


@dataclass
class Way:
    """One direction: how it is just now, and what has passed."""

    delay: float = 0.0  # seconds
    rate: float | None = None  # bytes a second, None is as fast as it goes
    silent: bool = False
    cut: int | None = None  # bytes of a connection that may yet pass before it is cut
    reset: bool = True  # a cut is a RST, else a FIN
    passed: int = 0  # bytes, of all connections


class _End(asyncio.Protocol):
    """One of the two sockets of a connection."""

    transport: asyncio.Transport

    def __init__(self) -> None:
        self.out: _Pipe  # what comes from here
        self.into: _Pipe  # what goes there
        self.ended_at: list[float] = []
        self.open = False
        self.writable = True

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport  # type: ignore[assignment]
        self.open = True
        transport.set_write_buffer_limits(LEAST * 64)

    def data_received(self, data: bytes) -> None:
        self.out.feed(data)

    def eof_received(self) -> bool:
        self.out.feed(b"")
        return True

    def connection_lost(self, error: Exception | None) -> None:
        self.open = False
        self.ended_at.append(time.monotonic())
        if error is not None or not self.out.fin:
            self.out.feed(None)
        self.into.discard()

    def pause_writing(self) -> None:
        self.writable = False

    def resume_writing(self) -> None:
        self.writable = True
        self.into.run()

    def end(self, *, reset: bool) -> None:
        """Close it; nothing that waits in it is sent with `reset`."""
        if not self.open:
            return
        if reset:
            sock = self.transport.get_extra_info("socket")
            with contextlib.suppress(OSError):
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            self.transport.abort()
        else:
            self.transport.close()


class _Pipe:
    """What is on its way in one direction of one connection: (when it arrives, bytes).

    Empty bytes are a FIN, None is a RST.
    """

    def __init__(self, way: Way, source: _End, target: _End, capacity: int) -> None:
        self.way = way
        self.source = source
        self.target = target
        self.forgotten = False
        self.left = way.cut
        self.fin = False  # has passed
        self.ended = False
        self._capacity = capacity
        self._queue: deque[tuple[float, bytes | None]] = deque()
        self.size = 0
        self._free_at = 0.0
        self._paused = False
        self._timer: asyncio.TimerHandle | None = None
        self._loop = asyncio.get_running_loop()

    def feed(self, data: bytes | None) -> None:
        if self.ended:
            return
        self._queue.append((self._loop.time() + self.way.delay, data))
        self.size += len(data or b"")
        if self.size >= self._capacity and not self._paused and self.source.open:
            self._paused = True
            self.source.transport.pause_reading()
        self.run()

    def discard(self) -> None:
        """The target is gone: what was on its way there is lost."""
        self.ended = True
        self._queue.clear()
        self.size = 0
        self._stop_timer()
        self._go_on()

    def run(self) -> None:
        """Pass on what has arrived, and come back when more will have."""
        self._stop_timer()
        while self._queue and not (self.way.silent or self.forgotten):
            if not (self.target.open and self.target.writable):
                break
            if self.target.transport.is_closing():  # by an error in what was just written
                break
            due, data = self._queue[0]
            now = self._loop.time()
            due = max(due, self._free_at)
            if now < due:
                self._timer = self._loop.call_at(due, self.run)
                break
            if data is None:
                self._end(reset=True)
            elif data:
                self._pass(data, due, now)
            else:
                self._queue.popleft()
                self._pass_fin()
        self._go_on()

    def _pass(self, data: bytes, due: float, now: float) -> None:
        rate = self.way.rate
        most = len(data) if rate is None else max(LEAST, int(rate * SLICE))
        if self.left is not None:
            most = min(most, self.left)
            self.left -= min(most, len(data))
        part, rest = data[:most], data[most:]
        if rest:
            self._queue[0] = (self._queue[0][0], rest)
        else:
            self._queue.popleft()
        self.size -= len(part)
        self.way.passed += len(part)
        if rate is not None:
            # What a late timer has missed is made good, a pause of the sender is not.
            self._free_at = max(due, now - 5 * SLICE) + len(part) / rate
        self.target.transport.write(part)
        if self.left == 0:
            self.way.cut = self.left = None
            self._end(reset=self.way.reset)

    def _pass_fin(self) -> None:
        self.fin = True
        if self.target.out.fin:  # that was the other one
            self._end(reset=False)
            return
        try:
            self.target.transport.write_eof()
        except OSError:  # its peer has reset it, which the loop has not read yet
            self._end(reset=True)

    def _end(self, *, reset: bool) -> None:
        self.source.into.ended = self.ended = True
        self._queue.clear()
        self.size = 0
        self.target.end(reset=reset)
        self.source.end(reset=reset)

    def _go_on(self) -> None:
        if self._paused and self.size < self._capacity // 2 and self.source.open:
            self._paused = False
            self.source.transport.resume_reading()

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


class _Connection:
    """A client's connection, and the one to the broker that belongs to it."""

    def __init__(
        self, near: _End, far: _End, up: Way, down: Way, capacity: int, ended_at: list[float]
    ) -> None:
        near.ended_at = far.ended_at = ended_at
        self.near = near
        self.far = far
        self.up = near.out = far.into = _Pipe(up, near, far, capacity)
        self.down = far.out = near.into = _Pipe(down, far, near, capacity)

    @property
    def open(self) -> bool:
        return self.near.open or self.far.open

    @property
    def held(self) -> int:
        return self.up.size + self.down.size

    def run(self) -> None:
        self.up.run()
        self.down.run()

    def end(self, *, reset: bool) -> None:
        self.up.ended = self.down.ended = True
        self.near.end(reset=reset)
        self.far.end(reset=reset)


class Relay:
    """Listens on `port` of 127.0.0.1 once started, and connects to `target` for each connection.

    `capacity` is what a way holds in bytes, beside what the system's socket buffers hold;
    `socket_buffer` makes these small (bytes), as for a slow line that holds little.
    """

    def __init__(
        self,
        target: int | tuple[str, int],
        *,
        capacity: int = CAPACITY,
        socket_buffer: int | None = None,
    ) -> None:
        self.target = ("127.0.0.1", target) if isinstance(target, int) else target
        self.up = Way()
        self.down = Way()
        self.port = 0
        self.accepted = 0
        #: When a connection has ended, at either end; by `time.monotonic`, ascending.
        self.ended_at: list[float] = []
        self._capacity = capacity
        self._socket_buffer = socket_buffer
        self._connections: list[_Connection] = []
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._passable = asyncio.Event()
        self._passable.set()

    async def __aenter__(self) -> Relay:
        await self.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop()

    async def start(self) -> None:
        """Listen, on the same port as before."""
        if self._server is None:
            sock = socket.socket()
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if self._socket_buffer is not None:  # accepted sockets inherit it
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._socket_buffer)
            sock.bind(("127.0.0.1", self.port))
            loop = asyncio.get_running_loop()
            self._server = await loop.create_server(self._accept, sock=sock)
            self.port = sock.getsockname()[1] if not self.port else self.port

    async def stop(self) -> None:
        """Refuse connections, and end those that there are. `start` goes on."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self.reset()
        await asyncio.sleep(0)

    refuse = stop

    @property
    def connections(self) -> int:
        """How many there are now, forgotten ones included."""
        self._connections = [each for each in self._connections if each.open]
        return len(self._connections)

    @property
    def held(self) -> int:
        """Bytes on their way, in all connections."""
        return sum(each.held for each in self._connections)

    def set(self, way: Ends | None = None, **values: Any) -> None:
        """`delay` (seconds each way) and `rate` (bytes a second, None: no limit), from now on."""
        for each in self._ways(way):
            for name, value in values.items():
                if name not in ("delay", "rate"):
                    raise TypeError(f"a way has no {name}")
                setattr(each, name, value)
        self._run()

    def silence(self, way: Ends | None = None) -> None:
        """Nothing passes any more, FIN and RST included; both ways, or one.

        What is sent stays here, as far as it has room, and in the system's buffers. A new
        connection is accepted, as by a dead gateway, and reaches no broker while `up` is silent.
        """
        for each in self._ways(way):
            each.silent = True
        if self.up.silent:
            self._passable.clear()

    def release(self, way: Ends | None = None) -> None:
        """Everything passes again, and first what was sent meanwhile."""
        for each in self._ways(way):
            each.silent = False
        if not self.up.silent:
            self._passable.set()
        self._run()

    def forget(self) -> None:
        """The connections of now never hear anything again, as from a NAT that restarted."""
        for connection in self._connections:
            connection.up.forgotten = connection.down.forgotten = True

    def reset(self) -> None:
        """RST to both ends of all connections, at once."""
        for connection in self._connections:
            connection.end(reset=True)

    def close(self) -> None:
        """FIN to both ends of all connections, at once; what is on its way is lost."""
        for connection in self._connections:
            connection.end(reset=False)

    def cut(self, after: int, way: Ends | None = None, *, reset: bool = True) -> None:
        """A connection ends after so many more bytes (≥ 1) of its own that way, then no more.

        With both ways, whichever has had so many first. Holds for connections that come, too,
        until one was cut.
        """
        if after < 1:
            raise ValueError("a connection is cut after 1 byte or more")
        for each in self._ways(way):
            each.cut, each.reset = after, reset
        for connection in self._connections:
            for pipe in (connection.up, connection.down):
                if pipe.way.cut is not None:
                    pipe.left = pipe.way.cut

    def stats(self) -> dict[str, Any]:
        """What there is to see, for JSON."""
        return {
            "port": self.port,
            "accepted": self.accepted,
            "connections": self.connections,
            "held": self.held,
            "up": asdict(self.up),
            "down": asdict(self.down),
        }

    def _ways(self, way: Ends | None) -> list[Way]:
        return [self.up, self.down] if way is None else [getattr(self, way)]

    def _run(self) -> None:
        for connection in list(self._connections):
            connection.run()

    def _accept(self) -> _End:
        near = _Near(self)
        self.accepted += 1
        return near

    def _begin(self, near: _End) -> None:
        far = _End()
        connection = _Connection(near, far, self.up, self.down, self._capacity, self.ended_at)
        near.transport.pause_reading()  # until there is somebody to read for
        connection.up._paused = True
        self._connections = [each for each in self._connections if each.open]
        self._connections.append(connection)
        task = asyncio.create_task(self._connect(connection))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _connect(self, connection: _Connection) -> None:
        await self._passable.wait()
        sock = socket.socket()
        try:
            if self._socket_buffer is not None:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._socket_buffer)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.setblocking(False)
            loop = asyncio.get_running_loop()
            await loop.sock_connect(sock, self.target)
            await loop.create_connection(lambda: connection.far, sock=sock)
        except OSError:
            sock.close()
            connection.end(reset=True)
            return
        except BaseException:
            sock.close()
            raise
        if connection.near.open:
            connection.run()
        else:
            connection.far.end(reset=True)


class _Near(_End):
    """The client's end: with it a connection begins."""

    def __init__(self, relay: Relay) -> None:
        super().__init__()
        self._relay = relay

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        sock = transport.get_extra_info("socket")
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._relay._begin(self)


# In a process of its own

COMMANDS = {"set", "silence", "release", "forget", "reset", "close", "cut", "stats"}


class RelayProcess:
    """A `Relay` in a process of its own, for a test whose loop is busy or is measured.

    `tell("set", delay=0.05)` returns when that holds; with the statistics, as all commands do.
    """

    def __init__(self, target: int, **options: int) -> None:
        arguments = [f"--{name.replace('_', '-')}={value}" for name, value in options.items()]
        command = [sys.executable, __file__, "--to", f"127.0.0.1:{target}", *arguments]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.port: int = self._answer()["port"]

    @property
    def pid(self) -> int:
        return self._process.pid

    def tell(self, command: str, **values: Any) -> dict[str, Any]:
        assert self._process.stdin is not None
        words = [command, *(f"{name}={json.dumps(value)}" for name, value in values.items())]
        self._process.stdin.write(shlex.join(words) + "\n")
        self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise ChildProcessError("the relay has ended")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise ValueError(answer["error"])
        return answer

    def stop(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGKILL)
        self._process.wait()

    def __enter__(self) -> RelayProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def _words(line: list[str]) -> Iterator[tuple[str, Any]]:
    for word in line:
        name, _, value = word.partition("=")
        try:
            yield name, json.loads(value)
        except ValueError:
            yield name, value


def _obey(relay: Relay, line: str) -> dict[str, Any]:
    command, *words = shlex.split(line) or ["stats"]
    if command not in COMMANDS:
        return {"error": f"no such command: {command}; there are {', '.join(sorted(COMMANDS))}"}
    try:
        getattr(relay, command)(**dict(_words(words)))
    except (TypeError, ValueError) as error:
        return {"error": str(error)}
    return relay.stats()


async def _serve(options: argparse.Namespace) -> None:
    host, _, port = options.to.rpartition(":")
    relay = Relay((host, int(port)), capacity=options.capacity, socket_buffer=options.socket_buffer)
    relay.port = options.port
    async with relay:
        print(json.dumps(relay.stats()), flush=True)
        reader = asyncio.StreamReader()
        await asyncio.get_running_loop().connect_read_pipe(
            lambda: asyncio.StreamReaderProtocol(reader), sys.stdin
        )
        while line := await reader.readline():
            print(json.dumps(_obey(relay, line.decode())), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python tests/upstream/relay.py",
        description="A TCP relay whose line is made bad by commands on stdin: "
        + ", ".join(sorted(COMMANDS)),
    )
    parser.add_argument("--to", required=True, metavar="HOST:PORT")
    parser.add_argument("--port", type=int, default=0, help="to listen on (default: a free one)")
    parser.add_argument("--capacity", type=int, default=CAPACITY, help="bytes a way holds")
    parser.add_argument("--socket-buffer", type=int, help="SO_RCVBUF of its sockets, in bytes")
    options = parser.parse_args()
    with contextlib.suppress(KeyboardInterrupt):
        import uvloop

        uvloop.run(_serve(options))


if __name__ == "__main__":
    main()
