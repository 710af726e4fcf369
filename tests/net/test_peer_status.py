"""What is known about the computer of a client, on real sockets."""

from __future__ import annotations

import asyncio
import contextlib
import math
import socket
import time

import pytest
from harness import Harness, PublishObserver
from test_websocket import frame, receive_frame, shake_hands
from waiting import PATIENCE, until

from appliance.broker.inflow import PAUSE
from appliance.broker.link import LOCAL_PEER, PeerStatus
from appliance.mqtt.packets import Connect, Pingreq, Pingresp, Publish, Subscribe, Subscription
from appliance.net import connection as wire_module
from appliance.net.connection import LARGE_CHUNK, ClientConnection
from appliance.net.sockets import Probe, peer_status, receive_buffer

HOST = "127.0.0.1"

pytestmark = pytest.mark.skipif(not hasattr(socket, "TCP_INFO"), reason="only Linux tells")

__all__ = ["Harness"]


@pytest.fixture
async def harness(tmp_path_factory):
    from harness import make_contexts

    harness = Harness(*make_contexts(tmp_path_factory.mktemp("certs")))
    await harness.start()
    yield harness
    await harness.close()


@pytest.mark.parametrize("tls", [False, True])
async def test_a_probe_is_answered_by_the_computer_and_not_by_the_client(harness, tls):
    """The client itself reads nothing and says nothing."""
    await harness.log_in("a", tls=tls)
    wire = harness.protocol("a")
    begun = time.monotonic()
    while wire.peer_status().silence < 0.3:
        assert time.monotonic() < begun + 20, f"it is never silent: {wire.peer_status()}"
        await asyncio.sleep(0.05)
    asked = time.monotonic()
    wire.probe()
    while wire.peer_status().silence + 0.02 >= time.monotonic() - asked:
        assert time.monotonic() < asked + 20, f"there is no answer: {wire.peer_status()}"
        await asyncio.sleep(0.05)
    connection = wire._transport.get_extra_info("socket")
    wire._end_probe()
    assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) > 60
    assert 0 <= wire.peer_status().round_trip < 5


async def test_what_is_withheld_comes_in_its_order(harness):
    peer = await harness.log_in("a")
    wire = harness.protocol("a")
    wire.withhold(60)
    await peer.send(Pingreq(), Subscribe(1, [Subscription("x")]))
    await until_waiting(wire)
    wire.resume_writing()  # the network takes more, and that is no reason
    assert wire._waiting
    wire.withhold(0)
    assert isinstance(await peer.receive(), Pingresp)
    assert (await peer.receive()).packet_id == 1
    wire.withhold(0.01)
    await peer.send(Pingreq())
    assert isinstance(await peer.receive(), Pingresp)
    assert not wire._paused


async def test_who_leaves_or_is_closed_while_something_is_withheld(harness):
    gone, closed = await harness.log_in("gone"), await harness.log_in("closed")
    for name, peer in (("gone", gone), ("closed", closed)):
        wire = harness.protocol(name)
        wire.withhold(PATIENCE)
        await peer.send(Pingreq())
        await until_waiting(wire)
    wire.close()
    gone.writer.transport.abort()
    wire.withhold(0)  # as the end of that time does
    assert isinstance(await closed.receive(), Pingresp)
    with pytest.raises((asyncio.IncompleteReadError, ConnectionError)):
        await closed.receive()


async def until_waiting(wire):
    deadline = time.monotonic() + 20
    while not wire._waiting:
        assert time.monotonic() < deadline, "nothing was answered"
        await asyncio.sleep(0.005)


def test_bytes_that_nobody_has_read():
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(server.getsockname())
        far, _ = server.accept()
        with near, far:
            assert not peer_status(near).has_unread
            far.send(b"x")
            deadline = time.monotonic() + 20
            while not peer_status(near).has_unread:
                assert time.monotonic() < deadline, "the byte does not come"
        assert peer_status(near) == PeerStatus(silence=math.inf)  # it is closed
        Probe(near).end()


def test_a_unix_socket_is_on_this_computer():
    near, far = socket.socketpair()
    with near, far:
        assert peer_status(near) == LOCAL_PEER
        far.send(b"x")
        assert peer_status(near).has_unread
        Probe(near).end()


@pytest.mark.parametrize("in_a_frame", [False, True])
async def test_a_packet_is_as_old_as_its_first_byte(harness, in_a_frame):
    peer = await harness.log_in("a")
    heard = []
    PublishObserver(harness, lambda message: heard.append((message.payload, message.age)))
    packet, behind = (Publish("x", payload).encode(5) for payload in (b"late", b"new"))
    begun = time.monotonic()
    if in_a_frame:  # which is kept until it has come
        harness.protocol("a").count_partial_frame(9)
        harness.protocol("a").count_partial_frame(10)
        await asyncio.sleep(0.5)
        parts = [packet + behind, behind]
    else:
        parts = [packet[:3], packet[3:6], packet[6:] + behind, behind]
    for part in parts:
        peer.writer.write(part)
        if part == packet[:3]:  # it counts from when the first byte is read
            await until(lambda: harness.protocol("a")._client.inflow.unfinished)
        await asyncio.sleep(0.25)
        if in_a_frame:
            await until(lambda: heard)
            harness.protocol("a").count_partial_frame(0)
    took = time.monotonic() - begun
    await until(lambda: len(heard) >= 3)
    assert heard[0][0] == b"late" and 0.3 < heard[0][1] <= took
    # Behind it in the same chunk, or in one of its own.
    assert heard[1:] == [(b"new", 0.0)] * 2


async def test_what_was_not_read_for_a_time_is_told(harness):
    peer = await harness.log_in("a")
    wire = harness.protocol("a")
    held = []
    PublishObserver(harness, lambda message: held.append(wire.peer_status().held))
    await peer.send(Publish("x", b""))
    await until(lambda: len(held) == 1)
    wire._rest(0.3)
    await peer.send(Publish("x", b""))
    await until(lambda: len(held) == 2)
    await peer.send(Publish("x", b""))
    await until(lambda: len(held) == 3)
    assert held[0] < 0.2  # the login
    assert held[1] > 0.29
    assert held[2] == 0


async def test_what_has_come_and_was_not_read_is_told(harness):
    peer = await harness.log_in("a")
    wire = harness.protocol("a")
    assert not wire.peer_status().has_unread
    wire._rest(PATIENCE)
    await peer.send(Publish("x", b"1"))
    await until(lambda: wire.peer_status().has_unread, "bytes that the system holds")
    heard = []
    PublishObserver(harness, lambda message: heard.append(wire.peer_status().has_unread))
    wire._rest(0)
    await until(lambda: heard, "the message")
    assert heard == [False] and not wire.peer_status().has_unread
    # And what was read, and waits in here for its turn.
    wire._keep_backlog(Publish("x", b"2").encode(5), 0)
    assert wire.peer_status().has_unread
    wire._resume_input()
    await until(lambda: len(heard) == 2, "the message that waited")
    assert not wire.peer_status().has_unread


ROUND_TRIP = 0.1


class FarAway:
    """A network with a round trip, and room for one flight of bytes on their way to the broker."""

    FLIGHT = 32 * 1024

    async def start(self, target):
        self._target = target
        self._server = await asyncio.start_server(self._serve, HOST, 0, limit=self.FLIGHT)
        return self._server.sockets[0].getsockname()

    async def _serve(self, reader, writer):
        sock = socket.create_connection(self._target)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        up, down = await asyncio.open_connection(sock=sock)
        down.transport.set_write_buffer_limits(0)
        back = asyncio.create_task(self._copy(up, writer, 0))
        await self._copy(reader, down, ROUND_TRIP)
        await back
        self._server.close()

    async def _copy(self, reader, writer, delay):
        with contextlib.suppress(ConnectionError):
            while chunk := await reader.read(self.FLIGHT):
                await asyncio.sleep(delay)
                writer.write(chunk)
                await writer.drain()
        writer.close()


def stand_still_together(monkeypatch):
    """Give the loop a clock that stands still with the computer: flights keep their pace."""
    loop = asyncio.get_running_loop()
    real = loop.time
    seen = told = real()

    def clock():
        nonlocal seen, told
        at = real()
        told += min(at - seen, ROUND_TRIP / 2)
        seen = at
        return told

    monkeypatch.setattr(loop, "time", clock)


@pytest.mark.parametrize("tls", [False, True])
@pytest.mark.parametrize("websocket", [False, True])
async def test_what_a_far_client_kept_back_is_not_new(harness, monkeypatch, websocket, tls):
    """It says all at once, and is not read for a time; the last of it comes long behind that."""
    monkeypatch.setattr(
        wire_module,
        "receive_buffer",
        lambda sock: receive_buffer(sock)._replace(round_trip=ROUND_TRIP),
    )
    stand_still_together(monkeypatch)
    at = 2 * websocket + tls
    harness.ports[at] = await FarAway().start(harness.ports[at])
    if websocket:
        peer = await shake_hands(harness, tls)
        await peer.send(frame(Connect("a").encode(5)))
        await receive_frame(peer)
    else:
        peer = await harness.log_in("a", tls=tls)
    wire, held = harness.protocol("a"), []

    def published(_):
        held.append(wire.peer_status().held)
        if len(held) == 1:
            wire._rest(0.5)

    def send(packet: bytes, times: int = 1) -> None:
        for _ in range(times):
            peer.writer.write(frame(packet) if websocket else packet)

    PublishObserver(harness, published)
    send(Publish("x", bytes(1000)).encode(5), 700)
    await until(lambda: len(held) == 700)
    late = [seconds for seconds in held if seconds >= 0.5]
    assert len(late) > 350 and held[-len(late) :] == late
    await until(lambda: not wire._client.inflow.is_behind)
    send(Publish("x", b"new").encode(5))
    await until(lambda: len(held) == 701)
    assert held[-1] == 0


async def test_while_much_comes_the_system_is_not_asked_after_each_chunk(harness, monkeypatch):
    """Nor too rarely: whoever is behind is looked at again soon."""
    looks, chunks = [], []
    loop = asyncio.get_running_loop()

    def look(sock):
        looks.append(loop.time())
        return receive_buffer(sock)

    monkeypatch.setattr(wire_module, "receive_buffer", look)
    peer = await harness.log_in("a")
    wire = harness.protocol("a")
    PublishObserver(harness, lambda _: chunks.append(loop.time()))
    large = Publish("x", bytes(LARGE_CHUNK)).encode(5)
    wire._rest(0.01)
    began = loop.time()
    for _ in range(500):
        peer.writer.write(large)
        await peer.writer.drain()
    await until(lambda: len(chunks) == 500)
    took = loop.time() - began
    assert 1 <= len(looks) <= 3 + 2 * took / PAUSE
    await until(lambda: not wire._client.inflow.is_behind, "a look by itself")


async def test_who_streams_on_is_new_again_after_a_pause(harness):
    """What it had kept back comes faster than what it says from then on."""
    peer = await harness.log_in("a")
    wire, held = harness.protocol("a"), []
    PublishObserver(harness, lambda _: held.append(wire.peer_status().held))
    chunk = Publish("x", bytes(3000)).encode(5)

    async def stream():
        while True:
            peer.writer.write(chunk)
            await asyncio.sleep(0.004)

    streaming = asyncio.create_task(stream())
    try:
        await until(lambda: len(held) > 50)
        wire._rest(0.6)
        await until(lambda: any(each >= 0.6 for each in held))
        await until(lambda: held[-1] == 0, "that it has caught up, while it streams")
    finally:
        streaming.cancel()


@pytest.mark.patches
async def test_what_answers_connack_is_new_however_long_the_login_took(harness, monkeypatch):
    """The client is faster than the rest of what the broker does when it has answered."""
    answer_connect = ClientConnection._answer_connect

    def answer_and_be_slow(wire, who):
        began = time.monotonic()
        answer_connect(wire, who)
        PublishObserver(harness, lambda _: held.append(wire.peer_status().held))
        sock = wire._transport.get_extra_info("socket")
        deadline = time.monotonic() + PATIENCE
        while not receive_buffer(sock).unread:
            assert time.monotonic() < deadline, "no message behind CONNACK"
            time.sleep(0.001)
        took.append(time.monotonic() - began)

    monkeypatch.setattr(ClientConnection, "_answer_connect", answer_and_be_slow)
    held, took = [], []
    harness.gate.clear()

    def client() -> None:
        with socket.create_connection(harness.ports[0]) as sock:
            sock.sendall(Connect("a").encode(5))
            sock.recv(1000)
            sock.sendall(Publish("x", b"").encode(5))
            sock.recv(1000)

    talking = asyncio.create_task(asyncio.to_thread(client))
    await until(lambda: any(wire._logging_in for wire in harness.scheduler.connections))
    await asyncio.sleep(0.3)
    harness.gate.set()
    await until(lambda: held, "the message")
    assert held[0] < took[0] + 0.2
    (wire,) = harness.scheduler.connections
    wire.abort()
    await talking


CONNECT, SUBSCRIBE, COMMAND = (
    packet.encode(5)
    for packet in (Connect("a"), Subscribe(1, [Subscription("y")]), Publish("x", b"1"))
)


@pytest.mark.parametrize("others_talk", [False, True])
@pytest.mark.parametrize("websocket", [False, True])
@pytest.mark.parametrize(
    "parts",
    [
        (CONNECT + COMMAND,),
        (CONNECT + SUBSCRIBE + COMMAND,),
        (CONNECT + COMMAND[:3], COMMAND[3:]),
        (CONNECT, COMMAND),
    ],
    ids=["one chunk", "behind another packet", "in two parts", "two chunks"],
)
async def test_what_came_with_connect_is_as_old_as_the_login(
    harness, parts, websocket, others_talk
):
    """MQTT lets a client send on before it is answered."""
    held = []

    def published(_):
        (wire,) = harness.scheduler.connections
        held.append(wire.peer_status().held)

    PublishObserver(harness, published)
    harness.gate.clear()
    peer = await (shake_hands(harness) if websocket else harness.dial())
    for part in parts:
        await peer.send(frame(part) if websocket else part)
        await until(lambda: any(wire._logging_in for wire in harness.scheduler.connections))
    await asyncio.sleep(0.4)
    if others_talk:
        harness.broker.accounting.now = asyncio.get_running_loop().time()
    harness.gate.set()
    await until(lambda: held, "the message")
    assert held[0] >= 0.39


async def test_what_comes_long_behind_a_slow_login_is_new(harness):
    """Nobody asks before."""
    harness.gate.clear()
    peer = await harness.dial()
    await peer.send(Connect("a"))
    await until(lambda: any(wire._logging_in for wire in harness.scheduler.connections))
    (wire,) = harness.scheduler.connections
    await peer.send(Subscribe(1, [Subscription("y")]))
    await until(lambda: receive_buffer(wire._transport.get_extra_info("socket")).unread)
    await asyncio.sleep(0.1)
    harness.gate.set()
    await peer.receive()
    await peer.receive()
    held = []
    await until(lambda: not wire._client.inflow.is_behind, "a look by itself")
    PublishObserver(harness, lambda _: held.append(wire.peer_status().held))
    await peer.send(Publish("x", b""))
    await until(lambda: held)
    assert held == [0]
