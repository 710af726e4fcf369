"""The relay does what it says; the one in a process of its own runs on uvloop."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import AsyncIterator, Callable, Iterator

import pytest
from waiting import PATIENCE, until

from upstream.relay import CAPACITY, RESET, Relay, RelayProcess


class Server:
    """Keeps what it is sent; `writers` are its connections, oldest first."""

    def __init__(self) -> None:
        self.received = bytearray()
        self.readers: list[asyncio.StreamReader] = []
        self.writers: list[asyncio.StreamWriter] = []
        self.ends: list[str] = []
        self.reading = asyncio.Event()
        self.reading.set()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writers.append(writer)
        try:
            while True:
                await self.reading.wait()
                if not (data := await reader.read(65536)):
                    break
                self.received += data
            self.ends.append("FIN")
        except ConnectionResetError:
            self.ends.append("RST")
        finally:
            writer.close()


@pytest.fixture
async def server() -> AsyncIterator[Server]:
    made = Server()
    listening = await asyncio.start_server(made.serve, "127.0.0.1", 0)
    made.port = listening.sockets[0].getsockname()[1]
    yield made
    listening.close()
    for writer in made.writers:
        writer.transport.abort()
    await asyncio.sleep(0)


@pytest.fixture
async def relay(server: Server) -> AsyncIterator[Relay]:
    async with Relay(server.port) as made:
        yield made


class Client:
    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self.received = bytearray()
        self.end = ""
        self.task = asyncio.create_task(self._read())

    async def _read(self) -> None:
        try:
            while data := await self.reader.read(65536):
                self.received += data
            self.end = "FIN"
        except ConnectionResetError:
            self.end = "RST"


@pytest.fixture
async def dial(relay: Relay, server: Server) -> AsyncIterator[Callable]:
    clients: list[Client] = []

    async def make(*, reaches: bool = True) -> Client:
        there = len(server.writers)
        client = Client(*await asyncio.open_connection("127.0.0.1", relay.port))
        clients.append(client)
        if reaches:
            await until(lambda: len(server.writers) > there, "the server is connected")
        return client

    yield make
    for client in clients:
        client.task.cancel()
        client.writer.transport.abort()


async def test_bytes_pass_both_ways_and_so_does_a_fin(relay, server, dial) -> None:
    client = await dial()
    data = bytes(range(256)) * 20_000
    client.writer.write(data)
    server.writers[0].write(data)
    await until(lambda: server.received == data and client.received == data)
    client.writer.write_eof()
    await until(lambda: server.ends == ["FIN"] and client.end == "FIN")
    await until(lambda: relay.connections == 0)
    assert (relay.up.passed, relay.down.passed) == (len(data), len(data))


async def test_delay_is_each_way(relay, server, dial) -> None:
    client = await dial()
    relay.set(delay=0.1)
    began = time.monotonic()
    client.writer.write(b"there")
    await until(lambda: server.received == b"there")
    half = time.monotonic() - began
    server.writers[0].write(b"back")
    await until(lambda: client.received == b"back")
    assert half >= 0.1 and time.monotonic() - began >= 0.2
    relay.set("down", delay=0.0)
    assert (relay.up.delay, relay.down.delay) == (0.1, 0.0)


async def test_rate_is_kept(relay, server, dial) -> None:
    client = await dial()
    relay.set("up", rate=100_000)
    began = time.monotonic()
    client.writer.write(bytes(50_000))
    await until(lambda: len(server.received) == 50_000)
    assert time.monotonic() - began >= 0.4
    relay.set(rate=None)
    client.writer.write(bytes(5_000_000))
    await until(lambda: len(server.received) == 5_050_000)


async def test_silence_says_nothing_not_even_the_end(relay, server, dial) -> None:
    client = await dial()
    relay.silence()
    client.writer.write(b"lost?")
    client.writer.write_eof()
    server.writers[0].write(b"me too")
    await asyncio.sleep(0.1)
    assert not server.received and not client.received and not server.ends
    relay.release()
    await until(lambda: server.received == b"lost?" and client.received == b"me too")
    await until(lambda: server.ends == ["FIN"])


@pytest.mark.parametrize("way", ["up", "down"])
async def test_silence_of_one_direction(relay, server, dial, way) -> None:
    client = await dial()
    relay.silence(way)
    client.writer.write(b"up")
    server.writers[0].write(b"down")
    if way == "up":
        await until(lambda: client.received == b"down")
        assert not server.received
    else:
        await until(lambda: server.received == b"up")
        assert not client.received
    relay.release(way)
    await until(lambda: client.received == b"down" and server.received == b"up")


async def test_a_new_connection_reaches_nobody_while_silent(relay, server, dial) -> None:
    relay.silence()
    client = await dial(reaches=False)
    client.writer.write(b"hello")
    await asyncio.sleep(0.05)
    assert not server.writers and not client.end
    relay.release()
    await until(lambda: server.received == b"hello")


async def test_reset_is_a_rst_on_both_sides(relay, server, dial) -> None:
    client = await dial()
    relay.reset()
    began = time.monotonic()
    await until(lambda: client.end == "RST" and server.ends == ["RST"])
    assert relay.connections == 0
    assert all(began - 1 < when <= time.monotonic() for when in relay.ended_at)
    assert len(relay.ended_at) == 2
    again = await dial()
    again.writer.write(b"works")
    await until(lambda: server.received == b"works")


@pytest.mark.parametrize("fin", [False, True], ids=["", "after a FIN"])
async def test_a_rst_of_one_side_reaches_the_other(relay, server, dial, fin) -> None:
    client = await dial()
    if fin:
        server.writers[0].write_eof()
        await until(lambda: client.end == "FIN" and relay.down.passed == 0)
    raw = server.writers[0].get_extra_info("socket")
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
    server.writers[0].transport.abort()
    if fin:  # asyncio does not look at what comes after a FIN
        client.writer.write(b"x")
    await until(lambda: relay.connections == 0)
    await until(lambda: fin or client.end == "RST")


async def test_a_rst_is_not_heard_of_while_silent(relay, server, dial) -> None:
    client = await dial()
    relay.silence()
    client.writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
    client.writer.transport.abort()
    await asyncio.sleep(0.1)
    assert not server.ends and relay.connections == 1
    relay.release()
    await until(lambda: server.ends == ["RST"] and relay.connections == 0)


async def test_close_is_a_fin_on_both_sides(relay, server, dial) -> None:
    client = await dial()
    relay.close()
    await until(lambda: client.end == "FIN" and server.ends == ["FIN"])


@pytest.mark.parametrize("reset", [True, False])
@pytest.mark.parametrize("way", ["up", "down"])
async def test_it_is_cut_after_exactly_so_many_bytes(relay, server, dial, way, reset) -> None:
    client = await dial()
    relay.cut(1234, way, reset=reset)
    sender = client.writer if way == "up" else server.writers[0]
    taken = server.received if way == "up" else client.received
    for _ in range(10):
        sender.write(bytes(1000))
    await until(lambda: client.end and server.ends)
    assert len(taken) <= 1234 and getattr(relay, way).passed == 1234
    if not reset:
        assert len(taken) == 1234
    again = await dial()
    again.writer.write(bytes(5000))  # only one is cut
    await until(lambda: relay.up.passed >= 5000)


async def test_refused_and_accepted_again_on_the_same_port(relay, server, dial) -> None:
    client = await dial()
    port = relay.port
    await relay.refuse()
    await until(lambda: client.end == "RST")
    with pytest.raises(ConnectionRefusedError):
        await asyncio.open_connection("127.0.0.1", port)
    await relay.start()
    assert relay.port == port
    await dial()


async def test_a_broker_that_is_not_there_is_a_rst(dial, relay, server) -> None:
    relay.target = ("127.0.0.1", 1)
    client = await dial(reaches=False)
    await until(lambda: client.end == "RST")
    assert relay.connections == 0


async def test_forgotten_connections_stay_silent_and_others_do_not(relay, server, dial) -> None:
    old = await dial()
    relay.forget()
    old.writer.write(b"x")
    relay.release()
    new = await dial()
    new.writer.write(b"new")
    await until(lambda: server.received == b"new")
    assert not old.end and relay.connections == 2


async def test_what_it_holds_is_bounded(relay, server, dial) -> None:
    client = await dial()
    relay.silence()
    for _ in range(64):
        client.writer.write(bytes(1 << 20))
    with contextlib.suppress(asyncio.TimeoutError):
        await asyncio.wait_for(client.writer.drain(), 0.3)
    await until(lambda: relay.held >= relay._capacity)
    assert relay.held <= relay._capacity + (256 << 10)
    relay.release()
    await until(lambda: len(server.received) == 64 << 20)
    assert relay.held == 0


@pytest.fixture
def apart(server: Server) -> Iterator[RelayProcess]:
    with RelayProcess(server.port, capacity=100_000) as made:
        yield made


async def test_in_a_process_of_its_own(server, apart) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", apart.port)
    assert apart.tell("set", delay=0.05, rate=None)["up"]["delay"] == 0.05
    assert apart.tell("silence", way="up")["up"]["silent"]
    writer.write(b"hello")
    await asyncio.sleep(0.1)
    assert not server.received
    stats = apart.tell("release")
    assert not stats["up"]["silent"] and stats["accepted"] == 1
    await until(lambda: server.received == b"hello")
    with pytest.raises(ValueError, match="no such command"):
        apart.tell("dance")
    with pytest.raises(ValueError, match="has no speed"):
        apart.tell("set", speed=1)
    apart.tell("reset")
    with pytest.raises(ConnectionResetError):
        await asyncio.wait_for(reader.read(), PATIENCE)
    writer.close()


async def test_a_reset_that_is_behind_a_fin_is_passed_on(relay, server, dial) -> None:
    """Both ends give up during a silence, and the one that the relay does not read with a RST."""
    client = await dial()
    relay.silence()
    server.writers[0].write(bytes(2 * CAPACITY))
    await until(lambda: relay.held >= CAPACITY)  # it reads no more of it
    client.writer.write_eof()
    near = next(iter(relay._connections)).up
    await until(lambda: len(near._queue) == 1)
    sock = server.writers[0].get_extra_info("socket")
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
    server.writers[0].transport.abort()
    await asyncio.sleep(0)  # closed, and the relay has not read anything since
    relay.release()
    await until(lambda: relay.connections == 0)
    await until(lambda: client.end == "RST")
