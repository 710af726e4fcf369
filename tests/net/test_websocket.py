"""MQTT over WebSocket with real sockets: the `websockets` library's client, paho, and raw bytes."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import itertools
import random
import ssl
import threading
import time
import tracemalloc
from collections.abc import AsyncIterator, Iterable
from typing import Any, cast

import paho.mqtt.client as paho
import pytest
from both_loops import event_loop_policy as event_loop_policy
from harness import Harness, Peer, PublishObserver, abort
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from waiting import PATIENCE, until
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.http11 import Response

from appliance.broker.limits import Limits
from appliance.broker.message import Message
from appliance.mqtt.codec import decode_varint
from appliance.mqtt.framing import MAXIMUM_CONTROL
from appliance.mqtt.packets import (
    Connack,
    Connect,
    Disconnect,
    Packet,
    Pingreq,
    Pingresp,
    Puback,
    Publish,
    Suback,
    Subscribe,
    Subscription,
    Will,
    decode_packet,
)
from appliance.mqtt.reason import ProtocolError, ReasonCode
from appliance.net.scheduler import COST_PER_ROUND
from appliance.net.websocket import FRAME_COST

# The way that is left to override it, and to have both loops, is too new for some computers.
pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')

MIB = 1 << 20


@pytest.fixture
async def harness(contexts) -> AsyncIterator[Harness]:
    harness = Harness(*contexts, Limits(packet_size=4 * MIB))
    harness.broker.tick(asyncio.get_running_loop().time())
    yield harness
    await harness.close()


def take_packet(received: bytes) -> tuple[Packet | None, bytes]:
    """The first packet, if it is complete, and what comes behind it."""
    try:
        length, body = decode_varint(received, 1)
    except ProtocolError:
        return None, received
    if len(received) < body + length:
        return None, received
    packet = decode_packet(received[0], received[body : body + length], 5)
    return packet, received[body + length :]


class WebSocketPeer:
    """A client that speaks through the `websockets` library."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self._unread = b""

    async def send(self, *packets: Packet | bytes) -> None:
        data = b"".join(p if isinstance(p, bytes) else p.encode(5) for p in packets)
        await asyncio.wait_for(self.connection.send(data), PATIENCE)

    async def receive(self) -> Packet:
        return await asyncio.wait_for(self._hear(), PATIENCE)

    async def _hear(self) -> Packet:
        while True:
            packet, self._unread = take_packet(self._unread)
            if packet is not None:
                return packet
            message = await self.connection.recv()
            assert isinstance(message, bytes)
            self._unread += message


async def talk(
    harness: Harness, tls: bool = False, path: str = "/mqtt", **options: Any
) -> WebSocketPeer:
    """A WebSocket connection to one of the listeners."""
    scheme, port = ("wss", harness.ports[3][1]) if tls else ("ws", harness.ports[2][1])
    options.setdefault("subprotocols", ["mqtt"])
    connection = await connect(
        f"{scheme}://localhost:{port}{path}",
        ssl=harness.client_context if tls else None,
        max_size=None,
        **options,
    )
    ws_peer = WebSocketPeer(connection)
    harness.peers.append(ws_peer)  # type: ignore[arg-type]
    ws_peer.hang_up = functools.partial(abort, connection.transport)  # type: ignore[attr-defined]
    return ws_peer


async def join(
    harness: Harness, client_id: str, tls: bool = False, **options: Any
) -> WebSocketPeer:
    ws_peer = await talk(harness, tls)
    await ws_peer.send(Connect(client_id, **options))
    assert isinstance(await ws_peer.receive(), Connack)
    return ws_peer


REQUEST = (
    b"GET /mqtt HTTP/1.1\r\nHost: robot\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Protocol: mqtt\r\n\r\n"
)


async def shake_hands(harness: Harness, tls: bool = False) -> Peer:
    """A connection that is upgraded, for frames by hand."""
    harness.ports[0:2] = harness.ports[2:4]
    peer = await harness.dial(tls)
    await peer.send(REQUEST)
    head = await asyncio.wait_for(peer.reader.readuntil(b"\r\n\r\n"), PATIENCE)
    assert head.startswith(b"HTTP/1.1 101 ")
    return peer


def frame(data: bytes, opcode: Opcode = Opcode.BINARY, *, fin: bool = True) -> bytes:
    return Frame(opcode, data, fin).serialize(mask=True)


async def receive_frame(peer: Peer) -> tuple[int, bytes]:
    """The next frame: its first byte and its payload."""

    async def read() -> tuple[int, bytes]:
        first, length = await peer.reader.readexactly(2)
        if length > 125:
            length = int.from_bytes(await peer.reader.readexactly(2 if length == 126 else 8))
        return first, await peer.reader.readexactly(length)

    return await asyncio.wait_for(read(), PATIENCE)


BINARY, CLOSE, PONG = 0x82, 0x88, 0x8A

both = pytest.mark.parametrize("tls", [False, True], ids=["ws", "wss"])


# --- opening -------------------------------------------------------------------------------------


@both
async def test_messages_between_websocket_and_tcp(harness: Harness, tls):
    await harness.start()
    ws_peer, peer = await join(harness, "web", tls), await harness.log_in("tcp")
    for client in (ws_peer, peer):
        await client.send(Subscribe(1, [Subscription("a", 2)]))
        assert await client.receive() == Suback(1, [2])
    for size in (0, 1, 125, 126, 65_535, 65_536, 3_000_000):
        for client in (ws_peer, peer):
            await client.send(Publish("a", bytes(size), 1, packet_id=7))
            heard = [await ws_peer.receive(), await peer.receive(), await client.receive()]
            sizes = [len(packet.payload) for packet in heard if isinstance(packet, Publish)]
            assert sizes == [size, size]
            assert Puback(7) in heard
            for receiver in (ws_peer, peer):
                await receiver.send(*(Puback(n) for n in range(1, 40)))


@pytest.mark.parametrize(
    ("offered", "chosen"),
    [
        (["mqtt"], "mqtt"),
        (["mqttv3.1"], "mqttv3.1"),
        (["mqttv3.1", "mqtt"], "mqttv3.1"),
        (["mqtt", "mqttv3.1"], "mqtt"),
        (["chat", "mqtt"], "mqtt"),
    ],
)
async def test_the_subprotocol_is_the_clients_choice(harness: Harness, offered, chosen):
    await harness.start()
    ws_peer = await talk(harness, subprotocols=offered)
    assert ws_peer.connection.subprotocol == chosen
    assert ws_peer.connection.response is not None
    assert "Sec-WebSocket-Extensions" not in ws_peer.connection.response.headers


async def _refusal(harness: Harness, **options: Any) -> Response:
    with pytest.raises(InvalidStatus) as refused:
        await talk(harness, **options)
    return refused.value.response


@pytest.mark.parametrize("offered", [None, ["chat"], ["MQTT"]])
async def test_without_a_subprotocol(harness: Harness, offered, caplog):  # [MQTT-6.0.0-3]
    await harness.start()
    response = await _refusal(harness, subprotocols=offered)
    assert response.status_code == 400
    assert b"offer the subprotocol mqtt or mqttv3.1" in (response.body or b"")
    assert "no WebSocket connection: offer the subprotocol" in caplog.text
    await until(lambda: not harness.scheduler.connections)


async def test_paths(harness: Harness, caplog):
    await harness.start()
    for path in ("/", "/mqtt/", "/other?x=/mqtt"):
        response = await _refusal(harness, path=path)
        assert response.status_code == 404
        assert b"MQTT over WebSocket is at /mqtt" in (response.body or b"")
    assert "'/': nothing is here" in caplog.text
    await talk(harness, path="/mqtt?token=1")


@pytest.mark.parametrize(
    ("request_", "status", "body"),
    [
        (b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n", b"404 Not Found", b"/mqtt"),
        (b"GET /mqtt HTTP/1.1\r\nHost: robot\r\n\r\n", b"426 ", b"You need a WebSocket client"),
        (b"POST /mqtt HTTP/1.1\r\nHost: robot\r\n\r\n", b"400 ", b"expected GET; got POST"),
        (b"GET /mqtt HTTP/1.0\r\n\r\n", b"400 ", b"expected HTTP/1.1"),
        (b"GET /mqtt\r\n\r\n", b"400 ", b"invalid HTTP request line"),
        (REQUEST.replace(b"n: 13", b"n: 12"), b"400 ", b"Sec-WebSocket-Version"),
        (REQUEST.replace(b"dGhl", b"?"), b"400 ", b"Sec-WebSocket-Key"),
        (
            REQUEST.replace(b"l: mqtt", b"l: " + b"a, " * 400 + b"mqtt"),
            b"400 ",
            b"Sec-WebSocket-Protocol and the like hold more than 1024 bytes",
        ),
        (
            REQUEST.replace(b"n: Upgrade", b"n: " + b"a, " * 2600 + b"Upgrade"),
            b"400 ",
            b"Connection and the like hold more than 1024 bytes",
        ),
        (b"GET /mqtt HTTP/1.1\r\nCookie: " + b"x" * 20_000, b"431 ", b"longer than 16384 bytes"),
        (
            b"GET /mqtt HTTP/1.1\r\n" + b"A: b\r\n" * 200 + b"\r\n",
            b"400 ",
            b"too many HTTP headers",
        ),
        (REQUEST.replace(b"Key: ", b"Key: \xff"), b"400 ", b"Sec-WebSocket-Key"),
        (REQUEST.replace(b"Version: ", b"Version: \xff"), b"400 ", b"what is not ASCII"),
        (REQUEST.replace(b"Upgrade: ", b"Upgrade: \xff"), b"400 ", b"what is not ASCII"),
        (REQUEST.replace(b"Protocol: ", b"Protocol: \xff"), b"400 ", b"what is not ASCII"),
        (REQUEST.replace(b"/mqtt", b"/\xff", 1), b"404 ", b"/mqtt"),
        (REQUEST.replace(b"Sec-WebSocket-Protocol", b"\xff"), b"400 ", b"invalid HTTP header"),
    ],
)
async def test_what_is_no_upgrade(harness: Harness, request_, status, body, caplog):
    await harness.start()
    harness.ports[0] = harness.ports[2]
    peer = await harness.dial()
    await peer.send(request_)
    answer = await peer.receive_rest()
    assert answer.startswith(b"HTTP/1.1 " + status)
    assert body in answer
    assert "no WebSocket connection: " in caplog.text
    await until(lambda: not harness.scheduler.connections)


@pytest.mark.parametrize("said", [Connect("lost").encode(), b"\x16\x03\x01\x02\0\x01\0\x01\xfc"])
async def test_what_is_no_http_is_closed_at_once(harness: Harness, said, caplog):
    await harness.start()
    harness.ports[0] = harness.ports[2]
    peer = await harness.dial()
    await peer.send(said)
    assert await peer.receive_rest() == b""
    assert "what it sent is not HTTP" in caplog.text


@both
async def test_the_time_to_connect_begins_before_http(harness: Harness, tls, caplog):
    await harness.start(connect_timeout=3.0)
    harness.ports[0:2] = harness.ports[2:4]
    silent, dripping = await harness.dial(tls), await harness.dial(tls)
    upgraded = await shake_hands(harness, tls)
    with contextlib.suppress(ConnectionError):
        for byte in itertools.cycle(REQUEST[:20]):
            await dripping.send(bytes((byte,)))
            await asyncio.sleep(0.02)
            if not harness.scheduler.connections:
                break
    for peer in (silent, dripping, upgraded):
        assert await peer.receive_rest() == b""
    assert caplog.text.count("no complete CONNECT within 3 s") == 3


# --- frames --------------------------------------------------------------------------------------


def _scattered(rng: random.Random, data: bytes, largest: int) -> Iterable[bytes]:
    position = 0
    while position < len(data):
        size = rng.randint(0, largest)
        yield data[position : position + size]
        position += size


@pytest.mark.parametrize("seed", range(3))
@both
async def test_packets_are_split_and_joined_at_will(harness: Harness, tls, seed):  # [MQTT-6.0.0-2]
    """Packets over frames, frames over segments, messages in fragments, pings in between."""
    rng = random.Random(seed)
    await harness.start()
    peer = await shake_hands(harness, tls)
    sizes = [rng.choice([0, 1, 50, 200, 5000, 70_000]) for _ in range(40)]
    packets: list[Packet] = [Connect("split"), Subscribe(1, [Subscription("#")])]
    packets += [Publish(f"a/{n}", bytes(size)) for n, size in enumerate(sizes)]
    data = b"".join(packet.encode(5) for packet in packets)
    largest = rng.choice([3, 40, 1000, 100_000]) if seed else 1
    frames: list[bytes] = []
    opcode = Opcode.BINARY
    for part in _scattered(rng, data[:5000] if largest < 50 else data, largest):
        fin = rng.random() < 0.5
        frames.append(frame(part, opcode, fin=fin))
        opcode = Opcode.BINARY if fin else Opcode.CONT
        if rng.random() < 0.1:
            frames.append(frame(b"?", Opcode.PING))
    if largest < 50:
        frames.append(frame(data[5000:], opcode))
    for segment in _scattered(rng, b"".join(frames), rng.choice([50, 3000, 200_000])):
        await peer.send(segment)
    unread, heard = b"", []
    while len(heard) < len(sizes) + 2:
        first, payload = await receive_frame(peer)
        if first == PONG:
            assert payload == b"?"
            continue
        assert first == BINARY
        unread += payload
        packet, unread = take_packet(unread)
        while packet is not None:
            heard.append(packet)
            packet, unread = take_packet(unread)
    assert [type(packet) for packet in heard[:2]] == [Connack, Suback]
    topics = [(p.topic, len(p.payload)) for p in heard[2:] if isinstance(p, Publish)]
    assert topics == [(f"a/{n}", size) for n, size in enumerate(sizes)]


async def test_a_text_frame_ends_the_connection(harness: Harness, caplog):  # [MQTT-6.0.0-1]
    """What came before it is done; what comes behind it is not."""
    await harness.start()
    watcher = await harness.log_in("watcher")
    await watcher.send(Subscribe(1, [Subscription("#")]))
    await watcher.receive()
    peer = await shake_hands(harness)
    text = frame(Publish("c", b"").encode(5), Opcode.TEXT)
    await peer.send(frame(Connect("text", will=Will("w", b"gone")).encode(5)))
    assert (await receive_frame(peer))[0] == BINARY
    before, behind = frame(Publish("a", b"").encode(5)), frame(Publish("b", b"").encode(5))
    await peer.send(before + text + behind)
    first, payload = await receive_frame(peer)
    assert (first, payload[:2]) == (CLOSE, (1003).to_bytes(2, "big"))
    assert await peer.receive_rest() == b""
    heard = [await watcher.receive() for _ in range(2)]
    assert [packet.topic for packet in heard if isinstance(packet, Publish)] == ["a", "w"]
    assert "not the WebSocket protocol: a text frame" in caplog.text


@pytest.mark.parametrize(
    ("data", "code"),
    [
        pytest.param(Frame(Opcode.BINARY, b"\xc0\0").serialize(mask=False), 1002, id="not masked"),
        pytest.param(b"\xc2" + frame(b"\xc0\0")[1:], 1002, id="a reserved bit"),
        pytest.param(b"\x83" + frame(b"\xc0\0")[1:], 1002, id="an unknown kind"),
        pytest.param(frame(b"\xc0\0", Opcode.CONT), 1002, id="more of nothing"),
        pytest.param(
            frame(b"\xc0", fin=False) + frame(b"\0"), 1002, id="a message inside a message"
        ),
        pytest.param(b"\x09\x80\0\0\0\0", 1002, id="a part of a ping"),
        pytest.param(b"\x89\xfe\x00\x7e" + bytes(4 + 126), 1002, id="a ping that is too long"),
        pytest.param(b"\x82\xff" + (1 << 62).to_bytes(8, "big") + bytes(4), 1009, id="too long"),
    ],
)
async def test_wrong_frames_end_the_connection(harness: Harness, data, code, caplog):
    await harness.start()
    peer = await shake_hands(harness)
    await peer.send(frame(Connect("wrong").encode(5)))
    assert (await receive_frame(peer))[0] == BINARY
    await peer.send(data)
    first, payload = await receive_frame(peer)
    assert (first, int.from_bytes(payload[:2], "big")) == (CLOSE, code)
    assert await peer.receive_rest() == b""
    assert "not the WebSocket protocol: " in caplog.text
    await until(lambda: not harness.broker.clients)


async def test_the_size_of_a_frame(harness: Harness):
    """A stranger's is bounded by what a CONNECT may take, a client's by the largest packet."""
    await harness.start()
    peer = await shake_hands(harness)
    await peer.send(b"\x82\xff" + (MAXIMUM_CONTROL + 1).to_bytes(8, "big") + bytes(4))
    first, payload = await receive_frame(peer)
    assert (first, payload[:2]) == (CLOSE, (1009).to_bytes(2, "big"))
    ws_peer = await join(harness, "large")
    # Fragments are no part of a whole here: together they may be larger than a packet.
    message = Publish("a", bytes(MIB)).encode(5)
    await ws_peer.connection.send(itertools.chain([message] * 6, [Pingreq().encode(5)]))
    assert isinstance(await ws_peer.receive(), Pingresp)
    assert harness.broker.counters.publish_received == 6
    await ws_peer.send(message * 3, Pingreq())
    assert isinstance(await ws_peer.receive(), Pingresp)
    with pytest.raises(ConnectionClosed) as closed:
        await ws_peer.connection.send(message * 5)
        await ws_peer.receive()
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009


async def test_an_announced_length_takes_no_memory(harness: Harness):
    await harness.start()
    talkers = [await join(harness, f"c{n}") for n in range(10)]
    tracemalloc.start()
    try:
        for ws_peer in talkers:
            ws_peer.connection.transport.write(
                b"\x82\xff" + (4 * MIB).to_bytes(8, "big") + bytes(4 + 100)
            )
        await asyncio.sleep(0.1)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(harness.scheduler.connections) == 10
    assert most < 4 * MIB


async def test_frames_that_are_not_complete_are_counted(contexts):
    """They take memory; when there is no more of it, a connection is closed."""
    harness = Harness(*contexts, Limits(packet_size=4 * MIB, memory=8 * MIB))
    await harness.start()
    accounting = harness.broker.accounting
    begun = b"\x82\xff" + (4 * MIB).to_bytes(8, "big") + bytes(4)
    try:
        talkers = [await join(harness, f"c{n}") for n in range(4)]
        before = accounting.queued_bytes
        talkers[0].connection.transport.write(begun + bytes(3 * MIB))
        await until(lambda: accounting.queued_bytes >= before + 3 * MIB)
        talkers[0].connection.transport.write(bytes(MIB))
        await until(lambda: accounting.queued_bytes < before + MIB)
        for ws_peer in talkers[1:]:
            ws_peer.connection.transport.write(begun + bytes(4 * MIB - 1))
        await until(lambda: len(harness.scheduler.connections) < 3)
        assert accounting.queued_bytes <= 8 * MIB
    finally:
        await harness.close()


async def test_pings_are_answered(harness: Harness):
    await harness.start()
    ws_peer = await join(harness, "ping")
    await asyncio.wait_for(await ws_peer.connection.ping(b"hello"), PATIENCE)
    peer = await shake_hands(harness)
    await peer.send(frame(b"1", Opcode.PING) + frame(b"", Opcode.PONG) + frame(b"2", Opcode.PING))
    assert await receive_frame(peer) == (PONG, b"1")
    assert await receive_frame(peer) == (PONG, b"2")


async def test_who_pings_and_does_not_read_is_bounded(harness: Harness):
    await harness.start()
    harness.ports[0] = harness.ports[2]
    peer = await harness.dial(receive_buffer=4096)
    await peer.send(REQUEST)
    await peer.send(frame(Connect("ping").encode(5)))
    await until(lambda: harness.broker.clients)
    protocol = harness.protocol("ping")
    pings = frame(bytes(125), Opcode.PING) * 2000
    for _ in range(40):
        await peer.send(pings)
    await peer.send(frame(b"last", Opcode.PING) + frame(Pingreq().encode(5)))
    assert protocol._output_size() < MIB
    await asyncio.wait_for(peer.reader.readuntil(b"\r\n\r\n"), PATIENCE)
    heard = [(0, b"")]
    while heard[-1] != (BINARY, Pingresp().encode(5)):
        heard.append(await receive_frame(peer))
    assert (PONG, b"last") in heard


@both
async def test_a_slow_reader_is_bounded(harness: Harness, tls):
    await harness.start()
    harness.ports[0:2] = harness.ports[2:4]
    slow = await harness.dial(tls, receive_buffer=4096)
    packets = Connect("slow").encode(5) + Subscribe(1, [Subscription("a")]).encode(5)
    await slow.send(REQUEST + frame(packets))
    await until(lambda: harness.broker.subscription_count)
    quick = await join(harness, "quick", tls)
    await quick.send(Subscribe(1, [Subscription("a")]))
    await quick.receive()
    publisher = await join(harness, "pub", tls)
    protocol = harness.protocol("slow")
    for n in range(50):
        await publisher.send(Publish("a", b"%02d" % n + bytes(MIB)), Pingreq())
        assert isinstance(await publisher.receive(), Pingresp)
        heard = await quick.receive()
        assert isinstance(heard, Publish) and heard.payload[:2] == b"%02d" % n
        assert protocol._output_size() < 4 * MIB


async def test_a_flood_of_empty_frames_leaves_others_their_turn(harness: Harness):
    await harness.start()
    peer = await shake_hands(harness)
    await peer.send(frame(Connect("flood").encode(5)))
    await receive_frame(peer)
    other = await join(harness, "other")
    peer.writer.write(frame(b"") * 400_000 + frame(Pingreq().encode(5)))
    end = asyncio.ensure_future(receive_frame(peer))
    answers = 0
    while not end.done():
        await other.send(Pingreq())
        assert isinstance(await other.receive(), Pingresp)
        answers += 1
    assert (await end)[0] == BINARY
    assert answers > 20


async def test_little_chunks_of_many_frames_take_turns(harness: Harness):
    """All in one round of the loop; what waits is counted for its user, and others do not wait."""
    await harness.start()
    crowd = [await join(harness, f"web-{n}", username="mallory") for n in range(30)]
    await join(harness, "alice", username="alice")
    ends = {name: harness.protocol(name) for name in ("alice", *(f"web-{n}" for n in range(30)))}
    alice: Any = ends.pop("alice")._transport
    accounting = harness.broker.accounting
    account = ends["web-0"].account
    await until(lambda: not harness.scheduler.is_busy())
    before, held, begun = accounting.queued_bytes, account.bytes, accounting.counters.cost
    chunk = frame(b"", Opcode.BINARY, fin=False) + frame(b"", Opcode.CONT, fin=False) * 339
    for end in ends.values():
        cast(Any, end._transport).data_received(chunk)
    cost = accounting.counters.cost - begun
    assert cost < 3 * 340 * FRAME_COST + COST_PER_ROUND, cost
    waiting = sum(bool(cast(Any, end._transport)._backlog) for end in ends.values())
    assert waiting >= 20
    assert accounting.queued_bytes - before >= waiting * len(chunk)
    assert account.bytes - held >= waiting * len(chunk)
    received = accounting.counters.messages_received
    alice.data_received(frame(Pingreq().encode(5)))
    assert accounting.counters.messages_received == received + 1
    await until(lambda: not any(cast(Any, end._transport)._backlog for end in ends.values()))
    await until(lambda: accounting.queued_bytes == before and account.bytes == held)
    assert len(crowd) == len(harness.scheduler.connections) - 1


async def test_what_waits_below_a_lost_connection_is_given_back(harness: Harness):
    await harness.start()
    peer = await shake_hands(harness, tls=True)
    await peer.send(frame(Connect("web", username="mallory").encode()))
    await receive_frame(peer)
    end = harness.protocol("web")
    before = harness.broker.accounting.queued_bytes
    cast(Any, end._transport).pause_reading()
    cast(Any, end._transport).data_received(frame(bytes(3000)))
    end.abort()
    assert harness.broker.accounting.queued_bytes >= before + 3000
    await until(lambda: harness.broker.accounting.queued_bytes == 0)


async def test_packets_behind_connect_wait_for_the_login(harness: Harness):
    harness.gate.clear()
    await harness.start()
    ws_peer = await talk(harness)
    await ws_peer.send(Connect("quick"), Subscribe(1, [Subscription("a")]))
    for _ in range(10):
        await ws_peer.send(Publish("a", bytes(10_000)))
    await until(lambda: harness.scheduler.tasks)
    assert not harness.broker.sessions
    harness.gate.set()
    kinds = [type(await ws_peer.receive()) for _ in range(12)]
    assert kinds == [Connack, Suback] + [Publish] * 10


# --- closing -------------------------------------------------------------------------------------


@both
async def test_the_last_packet_comes_before_the_close_frame(harness: Harness, tls):
    await harness.start()
    ws_peer = await join(harness, "same", tls)
    await harness.log_in("same")
    assert await ws_peer.receive() == Disconnect(ReasonCode.SESSION_TAKEN_OVER)
    with pytest.raises(ConnectionClosed) as closed:
        await ws_peer.receive()
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 1000
    assert closed.value.rcvd_then_sent


@both
async def test_a_client_that_closes(harness: Harness, tls):
    """With DISCONNECT its will is not sent, without it is."""
    await harness.start()
    watcher = await harness.log_in("watcher")
    await watcher.send(Subscribe(1, [Subscription("w/#")]))
    await watcher.receive()
    for client_id, last in (("polite", [Disconnect()]), ("rude", [])):
        ws_peer = await join(harness, client_id, tls, will=Will(f"w/{client_id}", b"gone"))
        await ws_peer.send(*last, b"")
        await asyncio.wait_for(ws_peer.connection.close(), PATIENCE)
        assert ws_peer.connection.close_code == 1000
    heard = await watcher.receive()
    assert isinstance(heard, Publish) and heard.topic == "w/rude"
    await until(lambda: len(harness.scheduler.connections) == 1)


async def test_what_was_said_before_the_close_frame_is_done(harness: Harness):
    await harness.start()
    peer = await shake_hands(harness)
    await peer.send(frame(Connect("brief", will=Will("w", b"gone")).encode(5)))
    await receive_frame(peer)
    data = Publish("a", bytes(100)).encode(5) * 2000 + Disconnect().encode(5)
    await peer.send(frame(data) + frame(b"", Opcode.CLOSE))
    assert await receive_frame(peer) == (CLOSE, b"")
    await until(lambda: not harness.scheduler.connections)
    assert harness.broker.counters.publish_received == 2000
    assert not harness.broker.sessions


@pytest.mark.parametrize("ends", [True, False], ids=["with DISCONNECT", "with its will"])
async def test_what_was_said_before_the_login_and_the_close_frame_is_done(harness: Harness, ends):
    """As over TCP: that it is gone already keeps a client neither out nor from being heard."""
    harness.gate.clear()
    await harness.start()
    watcher = await shake_hands(harness)
    peer = await shake_hands(harness)
    data = Connect("brief", will=Will("w", b"gone")).encode(5)
    data += Publish("a", b"kept", retain=True).encode(5) * 3
    data += Disconnect().encode(5) if ends else b""
    await peer.send(frame(data) + frame(b"", Opcode.CLOSE))
    await until(lambda: harness.scheduler.tasks)
    assert len(harness.scheduler.connections) == 2 and not harness.broker.sessions
    harness.gate.set()
    await until(lambda: len(harness.scheduler.connections) == 1)
    assert harness.broker.counters.publish_received == 3
    assert harness.broker.counters.connects == 1 and not harness.broker.sessions
    await watcher.send(frame(Connect("watcher").encode(5)))
    assert (await receive_frame(watcher))[0] == BINARY


async def test_who_closes_before_the_login_is_not_waited_for_longer_than_others(harness: Harness):
    harness.gate.clear()
    await harness.start(connect_timeout=3.0)
    peer = await shake_hands(harness)
    await peer.send(frame(Connect("brief").encode(5)) + frame(b"", Opcode.CLOSE))
    await until(lambda: not harness.scheduler.connections)
    harness.gate.set()
    assert harness.broker.counters.connects == 0


async def test_stop_with_open_clients(harness: Harness):
    await harness.start()
    talkers = [await join(harness, f"c{n}", tls=n == 1) for n in range(2)]
    await asyncio.wait_for(harness.listeners.stop(), PATIENCE)
    for ws_peer in talkers:
        assert await ws_peer.receive() == Disconnect(ReasonCode.SERVER_SHUTTING_DOWN)
        with pytest.raises(ConnectionClosed):
            await ws_peer.receive()


# --- paho ----------------------------------------------------------------------------------------


def _exchange_with_paho(harness: Harness, tls: bool, version: MQTTProtocolVersion) -> list[bytes]:
    """Publish to itself with QoS 0 to 2, and return what came back."""
    client = paho.Client(
        CallbackAPIVersion.VERSION2, f"paho-{version}", protocol=version, transport="websockets"
    )
    received: list[bytes] = []
    subscribed, done = threading.Event(), threading.Event()

    def on_message(_client: object, _data: object, message: paho.MQTTMessage) -> None:
        received.append(message.payload)
        if len(received) == 30:
            done.set()

    client.on_connect = lambda *_: client.subscribe("a/#", 2)
    client.on_subscribe = lambda *_: subscribed.set()
    client.on_message = on_message
    if tls:
        client.tls_set_context(harness.client_context)
    client.connect("localhost", harness.ports[2 + tls][1])
    client.loop_start()
    try:
        assert subscribed.wait(PATIENCE)
        sent = [client.publish(f"a/{n % 3}", b"%d" % n + bytes(n * 1000), n % 3) for n in range(30)]
        for info in sent:
            info.wait_for_publish(PATIENCE)
        assert done.wait(PATIENCE)
    finally:
        client.disconnect()
        client.loop_stop()
    return received


@pytest.mark.parametrize("version", [MQTTProtocolVersion.MQTTv311, MQTTProtocolVersion.MQTTv5])
@both
async def test_paho(harness: Harness, tls, version):
    await harness.start()
    received = await asyncio.to_thread(_exchange_with_paho, harness, tls, version)
    numbers = sorted(int(payload.rstrip(b"\0")) for payload in received)
    assert numbers == list(range(30))
    await until(lambda: not harness.scheduler.connections)


# --- how old what comes is -----------------------------------------------------------------------


async def open_by_hand(harness: Harness, tls: bool = False) -> Peer:
    """A client that has logged in, for frames by hand."""
    await harness.start()
    peer = await shake_hands(harness, tls)
    await peer.send(frame(Connect("a").encode(5)))
    assert (await receive_frame(peer))[0] == BINARY
    return peer


@pytest.mark.parametrize(("tls", "in_frames"), [(False, True), (True, True), (True, False)])
async def test_a_queue_that_waits_in_here_does_not_become_new(harness: Harness, tls, in_frames):
    """Of what was sent at once most waits above the socket, and that is not seen at the socket."""
    packet = Publish("x", b"go").encode(5)
    if in_frames:
        peer, packet = await open_by_hand(harness, tls), frame(packet)
    else:
        await harness.start()
        peer = await harness.log_in("a", tls=tls)
    wire = harness.protocol("a")
    held: list[float] = []

    def published(_: Message) -> None:
        held.append(wire.peer_status().held)
        if len(held) == 1:
            wire._rest(0.5)  # as when it publishes too fast

    PublishObserver(harness, published)
    if in_frames:
        peer.writer.write(packet * 400)
    else:
        for _ in range(1000):
            peer.writer.write(packet)  # a record each
    await until(lambda: len(held) == (400 if in_frames else 1000))
    late = [seconds for seconds in held if seconds > 0.4]
    assert late and held[-len(late) :] == late  # and none behind them is taken for new


class Busy:
    """Somebody who has much to do, for so many turns: each takes a round's cost."""

    def __init__(self, harness: Harness, turns: int) -> None:
        self.harness = harness
        self.left = turns
        harness.scheduler.queue_turn(self)

    def take_turn(self) -> None:
        time.sleep(0.006)
        self.harness.broker.counters.cost += COST_PER_ROUND + 1
        self.left -= 1
        if self.left > 0:
            self.harness.scheduler.queue_turn(self)

    def fault(self, entry: str, error: Exception) -> None:
        raise error


@pytest.mark.parametrize("size", [2, 17_000])
@pytest.mark.parametrize("busy", [False, True])
async def test_a_frame_in_two_segments_is_as_old_as_the_first(harness: Harness, busy, size):
    """Not as the last look at the clock, which may be a second ago; also when it has to wait."""
    peer = await open_by_hand(harness)
    wire, loop = harness.protocol("a"), asyncio.get_running_loop()
    ages: list[float] = []
    PublishObserver(harness, lambda message: ages.append(message.age))
    command = frame(Publish("x", bytes(size)).encode(5))
    begun = loop.time()
    harness.broker.accounting.now = begun - 60
    await peer.send(command[: len(command) // 2])
    await until(lambda: wire._frame_size)
    noticed = loop.time()
    await asyncio.sleep(0.3)
    least = loop.time() - noticed
    if busy:
        Busy(harness, 20)
    await peer.send(command[len(command) // 2 :])
    await until(lambda: ages)
    assert least <= ages[0] <= loop.time() - begun


@pytest.mark.parametrize("in_frames", [False, True])
async def test_a_record_in_two_segments_is_as_old_as_the_first(harness: Harness, in_frames):
    await harness.start()
    loop = asyncio.get_running_loop()
    reader, writer = await asyncio.open_connection(*harness.ports[3 if in_frames else 1][:2])
    coming, going = ssl.MemoryBIO(), ssl.MemoryBIO()
    sealed = harness.client_context.wrap_bio(coming, going, server_hostname="localhost")
    while True:
        try:
            sealed.do_handshake()
            break
        except ssl.SSLWantReadError:
            writer.write(going.read())
            coming.write(await asyncio.wait_for(reader.read(65536), PATIENCE))
    if in_frames:
        sealed.write(REQUEST)
    connect = Connect("a").encode(5)
    sealed.write(frame(connect) if in_frames else connect)
    writer.write(going.read())
    await until(lambda: any(wire._client.session for wire in harness.scheduler.connections))
    wire = harness.protocol("a")
    ages: list[float] = []
    PublishObserver(harness, lambda message: ages.append(message.age))
    command = Publish("x", bytes(200)).encode(5)
    command = frame(command) if in_frames else command
    begun = loop.time()
    sealed.write(command)
    record = going.read()
    writer.write(record[:100])
    await until(lambda: wire._is_record_cut)
    noticed = loop.time()
    await asyncio.sleep(0.3)
    least = loop.time() - noticed
    writer.write(record[100:])
    await until(lambda: ages)
    assert least <= ages[0] <= loop.time() - begun
    assert not wire._client.inflow.unfinished
    sealed.write(command)
    writer.write(going.read())
    await until(lambda: len(ages) == 2)
    assert ages[1] == 0
    writer.close()


@pytest.mark.parametrize(("tls", "in_frames"), [(False, True), (True, True), (True, False)])
async def test_what_waits_for_a_turn_below_is_held(harness: Harness, tls, in_frames):
    packet = Publish("x", bytes(5000)).encode(5)
    if in_frames:
        peer, packet = await open_by_hand(harness, tls), frame(packet)
    else:
        await harness.start()
        peer = await harness.log_in("a", tls=tls)
    wire, loop = harness.protocol("a"), asyncio.get_running_loop()
    held: list[float] = []
    waited: list[float] = []

    def published(_: Message) -> None:
        held.append(wire.peer_status().held)
        waited.append(loop.time() - begun)

    PublishObserver(harness, published)
    for _ in range(60):
        Busy(harness, 1)
    begun = loop.time()
    peer.writer.write(packet)
    await until(lambda: held)
    assert waited[0] / 2 < held[0] <= waited[0] + 0.1
    await until(lambda: not wire._client.inflow.is_behind)
    begun = loop.time()
    peer.writer.write(packet)
    await until(lambda: len(held) == 2)
    assert held[1] < 0.1


@pytest.mark.parametrize("behind", [0, 5])
async def test_a_ping_in_two_segments_makes_nothing_old(harness: Harness, behind):
    peer = await open_by_hand(harness)
    wire, loop = harness.protocol("a"), asyncio.get_running_loop()
    ages: list[float] = []
    PublishObserver(harness, lambda message: ages.append(message.age))
    ping = frame(b"abcd", Opcode.PING)
    await peer.send(ping[:3])
    await until(lambda: wire._frame_size)
    await asyncio.sleep(0.5)
    begun = loop.time()
    command = frame(Publish("x", b"go").encode(5))
    await peer.send(ping[3:] + command[:behind])
    assert await receive_frame(peer) == (PONG, b"abcd")
    assert behind or not wire._client.inflow.unfinished
    await peer.send(command[behind:])
    await until(lambda: ages)
    assert ages[0] <= loop.time() - begun


# --- memory --------------------------------------------------------------------------------------


ENDS = {
    "nothing": b"",
    "a part of a head": REQUEST[:-2],
    "no HTTP": b"\x10\x0c",
    "another path": REQUEST.replace(b"/mqtt", b"/"),
    "no request": b"GET /mqtt HTTP/1.1\r\n\r\n",
    "no frame": REQUEST,
    "a part of a frame": REQUEST + frame(Connect("a").encode(5))[:-2],
    "a part of a CONNECT": REQUEST + frame(Connect("a").encode(5)[:-2]),
    "a client": REQUEST + frame(Connect("a").encode(5)),
    "a client that leaves": REQUEST + frame(Connect("a").encode(5) + Disconnect(0).encode(5)),
    "a close frame": REQUEST + frame(b"\x03\xe8", Opcode.CLOSE),
    "a wrong frame": REQUEST + b"\xff\xff",
    "a text": REQUEST + frame(b"a", Opcode.TEXT),
    "too large": REQUEST + b"\x82\xff" + (1 << 40).to_bytes(8, "big") + bytes(4),
}


@both
@pytest.mark.parametrize("said", ENDS)
async def test_the_memory_of_a_connection_is_free_at_once(harness: Harness, tls, said):
    """However it ends, and not only when garbage is looked for, which is among the young alone."""
    await harness.start()
    harness.ports[0:2] = harness.ports[2:4]
    await harness.expect_free_memory(ENDS[said], tls)
