"""Chapter 6 of both versions: packets in WebSocket frames, which are written here byte by byte."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
from collections.abc import AsyncIterator, Awaitable, Callable

import pytest
from harness import abort
from waiting import PATIENCE

from appliance.broker.broker import Broker
from appliance.broker.values import Identity
from appliance.mqtt.packets import Connect, Pingreq, Publish, Subscribe, Subscription
from appliance.net.listeners import Admission, Listeners, ListenerSettings

KEY = base64.b64encode(bytes(range(16))).decode()
ACCEPT = base64.b64encode(
    hashlib.sha1(f"{KEY}258EAFA5-E914-47DA-95CA-C5AB0DC85B11".encode()).digest()
).decode()

CONTINUATION, TEXT, BINARY, CLOSE, PING, PONG = 0, 1, 2, 8, 9, 10


def statement(name: str) -> Callable[[Callable[..., object]], Callable[..., object]]:
    """The two versions have the same statements under the same numbers."""

    def mark(test: Callable[..., object]) -> Callable[..., object]:
        for version in ("3.1.1", "5.0"):
            test = pytest.mark.statement(version, name)(test)
        return test

    return mark


def frame(opcode: int, payload: bytes, *, last: bool = True) -> bytes:
    """A frame as a client sends it, masked (RFC 6455, section 5.2)."""
    size = len(payload)
    if size < 126:
        length = bytes((0x80 | size,))
    elif size < 65536:
        length = b"\xfe" + size.to_bytes(2, "big")
    else:
        length = b"\xff" + size.to_bytes(8, "big")
    mask = b"\x01\x02\x03\x04"
    masked = bytes(byte ^ mask[index % 4] for index, byte in enumerate(payload))
    return bytes((last << 7 | opcode,)) + length + mask + masked


class Peer:
    """The client's end of a connection."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        self._heard = b""

    async def ask(self, *subprotocols: str) -> dict[str, str]:
        """The HTTP request; returns the answer's headers, and its first line as ""."""
        lines = ["GET /mqtt HTTP/1.1", "Host: localhost", "Upgrade: websocket"]
        lines += ["Connection: Upgrade", f"Sec-WebSocket-Key: {KEY}", "Sec-WebSocket-Version: 13"]
        if subprotocols:
            lines.append(f"Sec-WebSocket-Protocol: {', '.join(subprotocols)}")
        self.send("\r\n".join([*lines, "", ""]).encode())
        answer = await asyncio.wait_for(self._reader.readuntil(b"\r\n\r\n"), PATIENCE)
        first, *headers = answer.decode().split("\r\n")[:-2]
        pairs = (header.partition(": ") for header in headers)
        return {"": first} | {name.lower(): value for name, _, value in pairs}

    def send(self, data: bytes) -> None:
        self._writer.write(data)

    async def receive(self, size: int) -> bytes:
        """So many bytes of MQTT, out of as many frames as it takes; all of them are binary."""
        while len(self._heard) < size:
            opcode, payload = await self.receive_frame()
            assert opcode == BINARY
            self._heard += payload
        heard, self._heard = self._heard[:size], self._heard[size:]
        return heard

    async def receive_frame(self) -> tuple[int, bytes]:
        """Opcode and payload of the next frame, which is a whole message and not masked."""
        return await asyncio.wait_for(self._hear_frame(), PATIENCE)

    async def _hear_frame(self) -> tuple[int, bytes]:
        first, size = await self._reader.readexactly(2)
        assert first & 0xF0 == 0x80 and size < 0x80
        if size > 125:
            size = int.from_bytes(await self._reader.readexactly(2 if size == 126 else 8), "big")
        return first & 0x0F, await self._reader.readexactly(size)

    async def is_hung_up(self) -> bool:
        """Whether the connection ends without another packet of MQTT."""
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                opcode, _ = await self.receive_frame()
                if opcode == BINARY:
                    return False
        return True

    async def log_in(self, version: int) -> None:
        assert (await self.ask("mqtt"))[""].split()[1] == "101"
        self.send(frame(BINARY, Connect("c", version=version).encode()))
        await self.hear_connack()

    async def hear_connack(self) -> None:
        first, size = await self.receive(2)
        assert first == 0x20
        assert (await self.receive(size))[:2] == b"\0\0"


Dial = Callable[[], Awaitable[Peer]]


@pytest.fixture
async def dial(broker: Broker) -> AsyncIterator[Dial]:
    """Makes connections to a listener for WebSocket, that nothing was said on yet."""

    async def let_in(connect: Connect, *_: object) -> Identity:
        return Identity(connect.username, connect.client_id)

    listeners = Listeners(
        broker, let_in, lambda method, address, tls, again: None, Admission(10, PATIENCE)
    )
    settings = ListenerSettings("127.0.0.1", 0, None, protocol="websocket")
    ((host, port),) = await listeners.start([settings])
    async with contextlib.AsyncExitStack() as stack:

        async def dial() -> Peer:
            reader, writer = await asyncio.open_connection(host, port)
            stack.callback(abort, writer.transport)
            return Peer(reader, writer)

        yield dial
    await listeners.stop()


@statement("MQTT-6.0.0-4")
@pytest.mark.parametrize("offered", [["mqtt"], ["graphql-ws", "mqtt"], ["mqtt", "graphql-ws"]])
async def test_the_subprotocol_is_mqtt(dial: Dial, offered: list[str]) -> None:
    answer = await (await dial()).ask(*offered)
    assert answer[""].startswith("HTTP/1.1 101 ")
    assert answer["sec-websocket-protocol"] == "mqtt"
    assert answer["sec-websocket-accept"] == ACCEPT


@statement("MQTT-6.0.0-4")
@pytest.mark.parametrize("offered", [[], ["graphql-ws"], ["MQTT"], ["mqtt5"]])
async def test_without_that_subprotocol_there_is_no_mqtt(
    broker: Broker, dial: Dial, offered: list[str]
) -> None:
    peer = await dial()
    assert not (await peer.ask(*offered))[""].startswith("HTTP/1.1 101 ")
    assert broker.sessions == {}


@statement("MQTT-6.0.0-1")
async def test_packets_come_in_binary_frames(dial: Dial, version: int) -> None:
    peer = await dial()
    await peer.log_in(version)
    peer.send(frame(BINARY, Subscribe(1, [Subscription("a")]).encode(version)))
    assert (await peer.receive(5))[:1] == b"\x90"
    if version == 5:
        await peer.receive(1)
    for size in (0, 100, 200, 70_000):
        message = Publish("a", bytes(size)).encode(version)
        peer.send(frame(BINARY, message))
        assert await peer.receive(len(message)) == message


@statement("MQTT-6.0.0-1")
@pytest.mark.parametrize("payload", ["", "\N{BULLET}", "a packet"])
@pytest.mark.parametrize("logged_in", [True, False])
async def test_a_text_frame_closes_the_connection(
    broker: Broker, dial: Dial, version: int, payload: str, logged_in: bool
) -> None:
    peer = await dial()
    if logged_in:
        await peer.log_in(version)
    else:
        await peer.ask("mqtt")
    data = payload.encode()
    if payload == "a packet":
        data = Publish("a", b"x", retain=True).encode(version)  # UTF-8, as it happens
    peer.send(frame(TEXT, data) + frame(BINARY, Pingreq().encode(version)))
    assert await peer.is_hung_up()
    assert len(broker.retained) == 0
    assert broker.clients == set()


@statement("MQTT-6.0.0-2")
async def test_one_frame_may_hold_many_packets(dial: Dial, version: int) -> None:
    peer = await dial()
    await peer.ask("mqtt")
    pings = Pingreq().encode(version) * 1000
    peer.send(frame(BINARY, Connect("c", version=version).encode() + pings))
    await peer.hear_connack()
    assert await peer.receive(2000) == b"\xd0\0" * 1000


@statement("MQTT-6.0.0-2")
@pytest.mark.parametrize("size", [1, 2, 3, 7])
@pytest.mark.parametrize("fragments", [False, True], ids=["messages", "fragments"])
async def test_packets_may_be_cut_over_frames(
    dial: Dial, version: int, size: int, fragments: bool
) -> None:
    """As messages of their own, or as the fragments of one."""
    peer = await dial()
    await peer.ask("mqtt")
    message = Publish("a", bytes(range(256))).encode(version)
    data = Connect("c", version=version).encode()
    data += Subscribe(1, [Subscription("a")]).encode(version) + message + Pingreq().encode(version)
    pieces = [data[start : start + size] for start in range(0, len(data), size)]
    for index, piece in enumerate(pieces):
        opcode = BINARY if index == 0 or not fragments else CONTINUATION
        peer.send(frame(opcode, piece, last=not fragments or index == len(pieces) - 1))
    await peer.hear_connack()
    assert (await peer.receive(5 if version == 4 else 6))[:1] == b"\x90"
    assert await peer.receive(len(message)) == message
    assert await peer.receive(2) == b"\xd0\0"


@statement("MQTT-6.0.0-2")
async def test_control_frames_in_the_middle_of_a_packet(dial: Dial, version: int) -> None:
    peer = await dial()
    await peer.log_in(version)
    peer.send(frame(BINARY, b"\xc0") + frame(PING, b"there?") + frame(BINARY, b"\0"))
    frames = [await peer.receive_frame(), await peer.receive_frame()]
    assert sorted(frames) == [(BINARY, b"\xd0\0"), (PONG, b"there?")]
