"""The listeners with real sockets: TCP and TLS, on asyncio's loop and on uvloop's."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import ssl
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
import uvloop

from appliance import certs, wire
from appliance.broker.broker import Broker
from appliance.broker.ports import Action, Decision, Identity, Limits, Refusal
from appliance.listeners import Listeners, ListenerSettings
from appliance.mqtt.codec import decode_varint
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
from appliance.mqtt.reason import ReasonCode
from appliance.store import MemoryStore
from appliance.wire import ClientProtocol, Network

# The way that is left to override it, and to have both loops, is too new for some computers.
pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')

PATIENCE = 10.0  # seconds for what takes milliseconds
MIB = 1 << 20


@pytest.fixture(
    scope="module",
    params=[asyncio.DefaultEventLoopPolicy(), uvloop.EventLoopPolicy()],
    ids=["asyncio", "uvloop"],
)
def event_loop_policy(request: pytest.FixtureRequest) -> asyncio.AbstractEventLoopPolicy:
    return request.param  # type: ignore[no-any-return]


class AllAllowed:
    epoch = 0

    def decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        return Decision(True, "everything is")


@pytest.fixture(scope="module")
def contexts(tmp_path_factory: pytest.TempPathFactory) -> tuple[ssl.SSLContext, ssl.SSLContext]:
    """The server's and the client's settings for TLS."""
    directory: Path = tmp_path_factory.mktemp("certs") / "certs"
    certs.create_authority(directory, "test")
    certs.issue_server(directory, ["localhost"], [])
    server = certs.server_context(directory / "server.crt", directory / "server.key")
    return server, ssl.create_default_context(cafile=directory / "ca.crt")


class House:
    """A broker with its listeners, one plain and one with TLS."""

    def __init__(self, context: ssl.SSLContext, client_context: ssl.SSLContext) -> None:
        self.broker = Broker(AllAllowed(), MemoryStore(), Limits())
        self.client_context = client_context
        self.context = context
        self.gate = asyncio.Event()  # logins wait for it
        self.gate.set()
        self.refused: set[str] = set()
        self.listeners = self.make()

    def make(self, connections: int = 100, connect_timeout: float = PATIENCE) -> Listeners:
        self.listeners = Listeners(
            self.broker,
            self._ask,
            lambda method: None,
            connections=connections,
            connect_timeout=connect_timeout,
        )
        return self.listeners

    @property
    def network(self) -> Network:
        return self.listeners.network

    async def _ask(
        self, connect: Connect, address: str, tls: ssl.SSLObject | None
    ) -> Identity | Refusal:
        await self.gate.wait()
        if connect.client_id in self.refused:
            return Refusal(ReasonCode.NOT_AUTHORIZED, "the test says so")
        return Identity(connect.username, connect.client_id)

    async def start(self, connections: int = 100, connect_timeout: float = PATIENCE) -> None:
        self.make(connections, connect_timeout)
        self.ports = await self.listeners.start(
            [
                ListenerSettings("127.0.0.1", 0, None),
                ListenerSettings("127.0.0.1", 0, self.context),
            ]
        )

    async def dial(self, tls: bool = False, receive_buffer: int = 0) -> Caller:
        """A connection to one of the listeners."""
        sock = socket.socket()
        if receive_buffer:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        sock.setblocking(False)
        await asyncio.get_running_loop().sock_connect(sock, self.ports[tls])
        reader, writer = await asyncio.open_connection(
            sock=sock,
            ssl=self.client_context if tls else None,
            server_hostname="localhost" if tls else None,
        )
        return Caller(reader, writer)

    async def join(self, client_id: str, *, tls: bool = False, receive_buffer: int = 0) -> Caller:
        """A client that has logged in."""
        caller = await self.dial(tls, receive_buffer)
        await caller.say(Connect(client_id))
        assert isinstance(await caller.hear(), Connack)
        return caller

    def protocol(self, client_id: str) -> ClientProtocol:
        """The server's end of a client's connection."""
        for protocol in self.network.open:
            session = protocol._client.session
            if session is not None and session.client_id == client_id:
                return protocol
        raise AssertionError(f"{client_id} is not connected")


class Caller:
    """A client's end of a connection."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    async def say(self, *packets: Packet | bytes) -> None:
        self.writer.write(b"".join(p if isinstance(p, bytes) else p.encode(5) for p in packets))
        await asyncio.wait_for(self.writer.drain(), PATIENCE)

    async def hear(self) -> Packet:
        """The next packet; IncompleteReadError or ConnectionError when there is none."""
        return await asyncio.wait_for(self._hear(), PATIENCE)

    async def _hear(self) -> Packet:
        header = await self.reader.readexactly(2)
        while header[-1] & 0x80:
            header += await self.reader.readexactly(1)
        length, _ = decode_varint(header, 1)
        return decode_packet(header[0], await self.reader.readexactly(length), 5)

    async def hear_the_end(self) -> bytes:
        """What comes until the connection ends."""
        with contextlib.suppress(ConnectionError):
            return await asyncio.wait_for(self.reader.read(-1), PATIENCE)
        return b""

    def hang_up(self) -> None:
        self.writer.transport.abort()


@pytest.fixture
async def house(contexts) -> AsyncIterator[House]:
    house = House(*contexts)
    house.broker.tick(asyncio.get_running_loop().time())
    yield house
    await house.listeners.stop()
    assert not house.network.open
    assert not house.broker.clients
    assert house.broker.ledger.queued_bytes == 0


async def until(condition: Callable[[], object]) -> None:
    """Wait for what is about to happen."""

    async def wait() -> None:
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.002)

    await asyncio.wait_for(wait(), PATIENCE)


both = pytest.mark.parametrize("tls", [False, True], ids=["tcp", "tls"])


@both
async def test_a_message_goes_from_one_client_to_another(house: House, tls):
    await house.start()
    subscriber, publisher = await house.join("sub", tls=tls), await house.join("pub", tls=not tls)
    await subscriber.say(Subscribe(1, [Subscription("a", 1)]))
    assert await subscriber.hear() == Suback(1, [1])
    for size in (0, 1, 10_000, 3_000_000):
        message = Publish("a", bytes(size), 1, packet_id=1 + size)
        message.packet_id = 7
        await publisher.say(message)
        assert await publisher.hear() == Puback(7)
        heard = await subscriber.hear()
        assert isinstance(heard, Publish) and len(heard.payload) == size
        await subscriber.say(Puback(heard.packet_id or 0))


@both
async def test_bytes_that_drip(house: House, tls):
    """Each byte a segment and a TLS record of its own."""
    await house.start()
    caller = await house.dial(tls)
    packets = [Connect("drip"), Subscribe(1, [Subscription("a")]), Publish("a", b"x" * 200)]
    for byte in b"".join(packet.encode(5) for packet in packets):
        await caller.say(bytes((byte,)))
        await asyncio.sleep(0)
    kinds = [type(await caller.hear()) for _ in range(3)]
    assert kinds == [Connack, Suback, Publish]


@both
async def test_packets_behind_connect_wait_for_the_login(house: House, tls):
    house.gate.clear()
    await house.start()
    caller = await house.dial(tls)
    await caller.say(Connect("quick"), Subscribe(1, [Subscription("a")]), Publish("a", b"x"))
    await until(lambda: house.network.tasks)
    await caller.say(Pingreq())
    assert not house.broker.sessions
    house.gate.set()
    kinds = [type(await caller.hear()) for _ in range(4)]
    assert kinds == [Connack, Suback, Publish, Pingresp]


async def test_packets_right_behind_the_tls_handshake(house: House):
    """The client's last flight of the handshake and its CONNECT in one segment."""
    await house.start()
    loop = asyncio.get_running_loop()
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    tls = house.client_context.wrap_bio(incoming, outgoing, server_hostname="localhost")
    with socket.socket() as sock:
        sock.setblocking(False)
        await loop.sock_connect(sock, house.ports[1])
        while True:
            try:
                tls.do_handshake()
                break
            except ssl.SSLWantReadError:
                await loop.sock_sendall(sock, outgoing.read())
                incoming.write(await asyncio.wait_for(loop.sock_recv(sock, 65536), PATIENCE))
        tls.write(Connect("quick").encode() + Subscribe(1, [Subscription("a")]).encode(5))
        tls.write(Publish("a", b"x").encode(5) + Disconnect().encode(5))
        await loop.sock_sendall(sock, outgoing.read())
        heard = b""
        with contextlib.suppress(ssl.SSLZeroReturnError):
            while True:
                try:
                    data = tls.read(65536)
                    heard += data
                    if not data:
                        break
                except ssl.SSLWantReadError:
                    data = await asyncio.wait_for(loop.sock_recv(sock, 65536), PATIENCE)
                    if not data:
                        break
                    incoming.write(data)
    assert [byte for byte in (0x20, 0x90, 0x30) if bytes((byte,)) in heard] == [0x20, 0x90, 0x30]
    assert heard.endswith(Publish("a", b"x").encode(5))


@both
async def test_a_refused_client_hears_why(house: House, tls):
    house.refused.add("bad")
    await house.start()
    caller = await house.dial(tls)
    await caller.say(Connect("bad"), Publish("a", b"x", retain=True))
    assert await caller.hear() == Connack(False, ReasonCode.NOT_AUTHORIZED)
    assert await caller.hear_the_end() == b""
    assert len(house.broker.retained) == 0
    await until(lambda: not house.network.open)


@pytest.mark.parametrize("said", [b"", b"\x10", b"\x10\x20\x00\x04MQTT"])
@both
async def test_who_does_not_connect_in_time_is_cut_off(house: House, tls, said, caplog):
    await house.start(connect_timeout=0.2)
    caller = await house.dial(tls)
    await caller.say(said)
    assert await caller.hear_the_end() == b""
    await until(lambda: not house.network.open)
    assert "no complete CONNECT within 0.2 s" in caplog.text


async def test_who_does_not_shake_hands_in_time_is_cut_off(house: House):
    await house.start(connect_timeout=0.2)
    house.ports[0] = house.ports[1]
    caller = await house.dial()  # and not a byte of TLS
    assert await caller.hear_the_end() == b""
    await until(lambda: not house.network.open and not house.network.tasks)


async def test_what_is_not_tls_is_told_in_the_log(house: House, caplog):
    await house.start()
    house.ports[0] = house.ports[1]
    caller = await house.dial()
    await caller.say(Connect("plain"))
    await caller.hear_the_end()
    await until(lambda: not house.network.open)
    assert "not TLS" in caplog.text
    assert not house.broker.sessions


async def test_a_slow_login_is_part_of_the_time_to_connect(house: House):
    house.gate.clear()
    await house.start(connect_timeout=0.2)
    caller = await house.dial()
    await caller.say(Connect("slow"))
    assert await caller.hear_the_end() == b""
    house.gate.set()
    await until(lambda: not house.network.tasks)
    assert not house.broker.sessions


@both
async def test_connections_over_the_limit_are_refused(house: House, tls, caplog):
    await house.start(connections=2)
    first, second = await house.join("1", tls=tls), await house.join("2", tls=tls)
    for _ in range(20):
        with pytest.raises((OSError, asyncio.IncompleteReadError)):
            await house.join("3", tls=tls)
    assert len(house.network.open) == 2
    assert house.broker.counters.connections_refused == 20
    assert 1 <= caplog.text.count("broker.limits.connections") < 10  # not once each
    first.hang_up()
    await until(lambda: len(house.network.open) == 1)
    third = await house.join("3", tls=tls)
    for caller in (second, third):
        await caller.say(Pingreq())
        assert isinstance(await caller.hear(), Pingresp)


@both
async def test_a_slow_reader_is_bounded_and_delays_nobody(house: House, tls):
    """Rule 3 of the design: 100 MB for someone who does not read."""
    await house.start()
    slow = await house.join("slow", tls=tls, receive_buffer=8192)
    quick = await house.join("quick", tls=tls)
    for caller in (slow, quick):
        await caller.say(Subscribe(1, [Subscription("a")]))
        await caller.hear()
    publisher = await house.join("pub")
    protocol = house.protocol("slow")
    largest = 0
    for n in range(100):
        await publisher.say(Publish("a", b"%04d" % n + bytes(MIB)), Pingreq())
        assert isinstance(await publisher.hear(), Pingresp)
        heard = await quick.hear()
        assert isinstance(heard, Publish) and heard.payload[:4] == b"%04d" % n
        largest = max(largest, protocol._output_size())
    assert largest < 4 * MIB
    assert len(protocol._client.session.latest) == 1  # type: ignore[union-attr]
    numbers = []
    while not numbers or numbers[-1] != 99:
        heard = await slow.hear()
        assert isinstance(heard, Publish)
        numbers.append(int(heard.payload[:4]))
    assert numbers == sorted(set(numbers)) and len(numbers) < 30


@both
async def test_who_asks_and_does_not_read_the_answers_is_bounded(house: House, tls, monkeypatch):
    """Rule 3: it is not listened to until it reads."""
    monkeypatch.setattr(wire, "OUTPUT_HIGH_WATER", 65536)
    await house.start()
    caller = await house.join("mute", tls=tls)
    protocol = house.protocol("mute")
    assert protocol._transport is not None
    for end in (protocol._transport, caller.writer):  # little in the system's buffers
        sock = end.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 65536)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    chunk = Pingreq().encode(5) * 8192
    said = 0
    with contextlib.suppress(asyncio.TimeoutError):
        while said < 1000:
            caller.writer.write(chunk)
            said += 1
            await asyncio.wait_for(caller.writer.drain(), 0.5)
    assert said < 1000, "it was listened to all the time"
    assert protocol._output_size() < MIB
    answers = await asyncio.wait_for(caller.reader.readexactly(said * len(chunk)), PATIENCE)
    assert answers == Pingresp().encode(5) * (said * 8192)
    await caller.say(Subscribe(1, [Subscription("a")]))
    assert isinstance(await caller.hear(), Suback)


@both
async def test_retained_messages_wait_for_a_slow_reader(house: House, tls):
    """Rule 3: a small chunk of SUBSCRIBEs asks for a thousand times a megabyte."""
    await house.start()
    publisher = await house.join("pub")
    for n in range(20):
        await publisher.say(Publish(f"a/{n}", bytes(MIB), 0, retain=True))
    await publisher.say(Pingreq())
    await publisher.hear()
    greedy = await house.join("greedy", tls=tls, receive_buffer=8192)
    await greedy.say(*[Subscribe(1, [Subscription("a/#")])] * 1000)
    for _ in range(50):
        await publisher.say(Pingreq())
        await publisher.hear()
        assert house.protocol("greedy")._output_size() < 6 * MIB
    heard = []
    while len(heard) < 20:
        packet = await greedy.hear()
        if isinstance(packet, Publish):
            heard.append(packet.topic)
    assert len(set(heard)) > 15


async def test_a_stranger_is_not_listened_to_during_the_login(house: House):
    """Rule 3: nothing is buffered for who has not logged in, however large the chunks are."""
    house.gate.clear()
    await house.start()
    caller = await house.dial()
    await until(lambda: house.network.open and any(p._transport for p in house.network.open))
    (protocol,) = house.network.open
    assert protocol._transport is not None
    # One large chunk, as a fast network gives it: after these, reading is paused in any case.
    protocol.data_received(Connect("flood").encode() + bytes(MIB))
    caller.writer.write(bytes(100 * MIB))
    for _ in range(50):
        await asyncio.sleep(0)
        assert not protocol._transport.is_reading()
    assert protocol._client.connection.buffered <= MIB
    caller.hang_up()
    house.gate.set()
    await until(lambda: not house.network.open)


@both
async def test_a_client_that_has_no_more_to_say(house: House, tls):
    """Half closed: what it said is done, then the connection ends, and the will is due."""
    await house.start()
    watcher = await house.join("watcher")
    await watcher.say(Subscribe(1, [Subscription("#")]))
    await watcher.hear()
    caller = await house.dial(tls)
    await caller.say(
        Connect("brief", will=Will("w", b"gone")), Publish("a", b"x"), Publish("b", b"y" * MIB)
    )
    if tls:
        caller.writer.close()
    else:
        caller.writer.write_eof()
        assert isinstance(await caller.hear(), Connack)
        assert await caller.hear_the_end() == b""
    heard = [await watcher.hear() for _ in range(3)]
    assert [packet.topic for packet in heard] == ["a", "b", "w"]  # type: ignore[union-attr]
    await until(lambda: len(house.network.open) == 1)


@both
async def test_a_connection_that_breaks(house: House, tls):
    """A reset, at any moment, is a lost connection and nothing else."""
    await house.start()
    watcher = await house.join("watcher")
    await watcher.say(Subscribe(1, [Subscription("w/#")]))
    await watcher.hear()
    for n, packets in enumerate([[], [Subscribe(1, [Subscription("#")])], [b"\x30\x7f\x00"]]):
        caller = await house.dial(tls)
        await caller.say(Connect(f"c{n}", will=Will(f"w/{n}", b"gone")))
        await caller.hear()
        await caller.say(*packets)
        caller.writer.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0"
        )
        caller.hang_up()
        heard = await watcher.hear()
        assert isinstance(heard, Publish) and heard.topic == f"w/{n}"
    await until(lambda: len(house.network.open) == 1)


async def test_who_does_not_read_the_last_bytes_is_cut_off(house: House, monkeypatch):
    """A closed connection does not stay because its output cannot be written."""
    monkeypatch.setattr(wire, "CLOSE_TIMEOUT", 0.2)
    await house.start()
    caller = await house.join("deaf", receive_buffer=8192)
    await caller.say(Subscribe(1, [Subscription("a")]))
    await caller.hear()
    publisher = await house.join("pub")
    for _ in range(10):
        await publisher.say(Publish("a", bytes(MIB)))
    await until(lambda: not house.protocol("deaf")._client.writable)
    await caller.say(b"\0\0")
    await until(lambda: len(house.network.open) == 1)


@both
async def test_stop_with_open_clients(house: House, tls):
    await house.start()
    callers = [await house.join(f"c{n}", tls=tls) for n in range(3)]
    silent = await house.dial(tls)
    deaf = await house.join("deaf", tls=tls, receive_buffer=8192)
    await deaf.say(Subscribe(1, [Subscription("a")]))
    await deaf.hear()
    for _ in range(10):
        await callers[0].say(Publish("a", bytes(MIB)))
    await callers[0].say(Pingreq())  # all of it has been read, or a reset would be the answer
    assert isinstance(await callers[0].hear(), Pingresp)
    assert not house.protocol("deaf")._client.writable
    await asyncio.wait_for(house.listeners.stop(), PATIENCE)
    for caller in callers:
        assert await caller.hear() == Disconnect(ReasonCode.SERVER_SHUTTING_DOWN)
        assert await caller.hear_the_end() == b""
    assert await silent.hear_the_end() == b""
    assert not house.network.open and not house.network.tasks
    with pytest.raises(OSError):
        await house.dial()
    await house.listeners.stop()  # again


async def test_stop_during_a_login(house: House):
    house.gate.clear()
    await house.start()
    caller = await house.dial()
    await caller.say(Connect("late"))
    await until(lambda: house.network.tasks)
    await asyncio.wait_for(house.listeners.stop(), PATIENCE)
    assert await caller.hear_the_end() == b""
    assert not house.broker.sessions


async def test_an_address_in_use(house: House):
    """Nothing is left listening, and the message names the key."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=rf"127\.0\.0\.1:{port} \(broker\.listeners\)"):
            await house.listeners.start(
                [ListenerSettings("127.0.0.1", 0, None), ListenerSettings("127.0.0.1", port, None)]
            )
    assert not house.listeners._doors


async def test_every_address(house: House):
    """An empty host listens on IPv4, and on IPv6 where there is any."""
    ((host, port),) = await house.listeners.start([ListenerSettings("", 0, None)])
    assert host == ""
    house.ports = [("127.0.0.1", port)]
    await house.join("four")
    if socket.has_dualstack_ipv6():
        with contextlib.suppress(OSError):  # no loopback address of IPv6 on this computer
            reader, writer = await asyncio.open_connection("::1", port)
            caller = Caller(reader, writer)
            await caller.say(Connect("six"))
            assert isinstance(await caller.hear(), Connack)


async def test_a_take_over_by_the_network(house: House, caplog):
    caplog.set_level(logging.INFO)
    await house.start()
    first = await house.join("same")
    second = await house.join("same", tls=True)
    assert await first.hear() == Disconnect(ReasonCode.SESSION_TAKEN_OVER)
    assert await first.hear_the_end() == b""
    await second.say(Pingreq())
    assert isinstance(await second.hear(), Pingresp)
