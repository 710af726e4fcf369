"""The TLS transport with real sockets, on both loops, and beside the loops' own."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import hashlib
import random
import shutil
import socket
import ssl
import weakref
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from both_loops import event_loop_policy as event_loop_policy
from examples import examples
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from waiting import PATIENCE, until

from appliance import certs
from appliance.broker.faults import Faults
from appliance.net import tls
from appliance.net.callbacks import Entries
from appliance.net.layers import Schedulable, UpperLayer
from appliance.net.sockets import receive_buffer
from appliance.net.tls import RECORD_SIZE, RECORDS_A_TURN, TlsTransport

# The way that is left to override it, and to have both loops, is too new for some computers.
pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')

MIB = 1 << 20
ALERT = 0x15  # the record's type (RFC 8446, section 5.1)


class LayerScheduler:
    """Whose turn it is: in the next round of the loop, and there is nobody else."""

    def __init__(self) -> None:
        self.entries = Entries(asyncio.get_running_loop(), Faults())
        self.cost = 0
        self.busy = False

    def count_cost(self, cost: int, charged: UpperLayer) -> None:
        self.cost += cost

    def must_wait(self, charged: UpperLayer, *, is_small: bool) -> bool:
        return self.busy and not is_small

    def queue_turn(self, member: Schedulable) -> None:
        asyncio.get_running_loop().call_soon(member.take_turn)


async def own(
    connection: socket.socket,
    context: ssl.SSLContext,
    protocol: asyncio.Protocol,
    timeout: float,
    scheduler: LayerScheduler | None = None,
) -> None:
    await tls.accept(connection, context, protocol, timeout, scheduler or LayerScheduler())


async def asyncios(
    connection: socket.socket,
    context: ssl.SSLContext,
    protocol: asyncio.Protocol,
    timeout: float,
) -> None:
    """The same with the loop's own transport."""
    await asyncio.get_running_loop().connect_accepted_socket(
        lambda: protocol, connection, ssl=context, ssl_handshake_timeout=timeout
    )


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("certs") / "certs"
    certs.create_authority(directory, "test")
    certs.issue_server(directory, ["localhost"], [])
    return directory


@pytest.fixture(scope="module")
def server(directory: Path) -> ssl.SSLContext:
    return certs.server_context(directory / "server.crt", directory / "server.key")


@pytest.fixture(params=[ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3], ids=["1.2", "1.3"])
def client(request: pytest.FixtureRequest, directory: Path) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=directory / "ca.crt")
    context.minimum_version = context.maximum_version = request.param
    return context


class Served(asyncio.Protocol):
    """The server's end of a connection: what it was told, in order, with joined data."""

    def __init__(self, on_data: Callable[[Served, bytes], object] | None = None) -> None:
        self.transport: Any = None
        self.heard: list[str] = []
        self.data = bytearray()
        self.chunks = 0
        self.set_aside = 0
        self.error: Exception | None = None
        self.lost = asyncio.Event()
        self.on_data = on_data or (lambda served, data: None)

    def count_buffered(self, size):
        self.set_aside = size

    def input_paused(self):
        pass

    def input_resumed(self):
        pass

    def partial_record(self, part):
        pass

    def connection_made(self, transport):
        self.transport = transport
        self.heard.append("made")

    def data_received(self, data):
        assert data and isinstance(data, bytes)
        if self.heard[-1] != "data":
            self.heard.append("data")
        self.data += data
        self.chunks += 1
        self.on_data(self, data)

    def eof_received(self):
        self.heard.append("eof")

    def connection_lost(self, exc):
        self.heard.append("lost")
        self.error = exc
        self.lost.set()

    def pause_writing(self):
        self.heard.append("pause")

    def resume_writing(self):
        self.heard.append("resume")

    async def ended(self) -> None:
        await asyncio.wait_for(self.lost.wait(), PATIENCE)


def echo(served: Served, data: bytes) -> None:
    served.transport.write(data)


class Peer:
    """The client's end: TLS in memory, so that a test has each byte on the wire in its hand."""

    def __init__(self, sock: socket.socket, context: ssl.SSLContext) -> None:
        self.sock = sock
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self.tls = context.wrap_bio(self._incoming, self._outgoing, server_hostname="localhost")
        self._loop = asyncio.get_running_loop()

    async def put(self, data: bytes) -> None:
        """Send bytes as they are."""
        await asyncio.wait_for(self._loop.sock_sendall(self.sock, data), PATIENCE)

    async def get(self) -> bytes:
        """Bytes as they come; none when the server has closed."""
        return await asyncio.wait_for(self._loop.sock_recv(self.sock, RECORD_SIZE), PATIENCE)

    def step(self) -> bytes:
        """What the handshake wants to send now; nothing more when it is done."""
        with contextlib.suppress(ssl.SSLWantReadError):
            self.tls.do_handshake()
        return self._outgoing.read()

    async def shake_hands(self, behind: bytes = b"") -> None:
        """The whole handshake, with application data right behind its last message."""
        while True:
            try:
                self.tls.do_handshake()
            except ssl.SSLWantReadError:
                await self.put(self._outgoing.read())
                self._incoming.write(await self.get())
            else:
                break
        last = self._outgoing.read()
        await self.put(last + (self.seal(behind) if behind else b""))

    def seal(self, data: bytes) -> bytes:
        """Data in records, as they go over the wire."""
        view, sealed = memoryview(data), b""
        for start in range(0, len(view), RECORD_SIZE):
            self.tls.write(view[start : start + RECORD_SIZE])
            sealed += self._outgoing.read()
        return sealed

    def seal_end(self) -> bytes:
        """close_notify, as it goes over the wire."""
        with contextlib.suppress(ssl.SSLWantReadError):
            self.tls.unwrap()
        return self._outgoing.read()

    async def send(self, data: bytes) -> None:
        view = memoryview(data)
        for start in range(0, len(view), RECORD_SIZE):
            await self.put(self.seal(view[start : start + RECORD_SIZE]))  # type: ignore[arg-type]

    async def receive(self, size: int, *, rude: bool = False) -> bytes:
        """So many bytes of data, fewer when it ends before them, with close_notify or `rude`."""
        data = bytearray()
        while len(data) < size:
            try:
                part = self.tls.read(min(size - len(data), 65536))
            except ssl.SSLWantReadError:
                received = await self.get()
                if not received and rude:
                    break
                if not received:
                    raise EOFError(f"no close_notify after {len(data)} bytes") from None
                self._incoming.write(received)
            except ssl.SSLZeroReturnError:  # after a close_notify of its own
                break
            else:
                if not part:
                    break
                data += part
        return bytes(data)

    async def receive_rest(self) -> bytes:
        """Everything up to close_notify."""
        return await self.receive(1 << 62)

    async def receive_raw_rest(self) -> bytes:
        """The bytes up to the end of the TCP connection."""
        raw = b""
        with contextlib.suppress(ConnectionError):
            while data := await self.get():
                raw += data
        return raw

    def reset(self) -> None:
        """End the TCP connection the rude way."""
        self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        self.sock.close()


class Harness:
    """A listening socket; the connections made to it end with the test."""

    def __init__(self, server: ssl.SSLContext, client: ssl.SSLContext) -> None:
        self.server, self.client = server, client
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._listening.setblocking(False)
        self._stack = contextlib.ExitStack()
        self._stack.callback(self._listening.close)
        self.all: list[Served] = []

    async def dial(self, receive_buffer: int = 0) -> tuple[Peer, socket.socket]:
        """A TCP connection: the client's end, and the server's, accepted."""
        loop = asyncio.get_running_loop()
        sock = socket.socket()
        self._stack.callback(sock.close)
        if receive_buffer:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        sock.setblocking(False)
        await loop.sock_connect(sock, self._listening.getsockname())
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        accepted, _ = await loop.sock_accept(self._listening)
        accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._stack.callback(accepted.close)
        return Peer(sock, self.client), accepted

    async def log_in(
        self,
        on_data: Callable[[Served, bytes], object] | None = None,
        *,
        behind: bytes = b"",
        receive_buffer: int = 0,
        accept: Any = own,
    ) -> tuple[Peer, Served]:
        """A connection after its handshake."""
        peer, accepted = await self.dial(receive_buffer)
        served = Served(on_data)
        self.all.append(served)
        shaking = asyncio.ensure_future(peer.shake_hands(behind))
        await accept(accepted, self.server, served, PATIENCE)
        await shaking
        return peer, served

    async def close(self) -> None:
        for served in self.all:
            if served.transport is not None and not served.lost.is_set():
                served.transport.abort()
                await served.ended()
        self._stack.close()


@pytest.fixture
async def harness(server: ssl.SSLContext, client: ssl.SSLContext) -> AsyncIterator[Harness]:
    harness = Harness(server, client)
    yield harness
    await harness.close()


async def scheduler(count: int = 5) -> None:
    """Let the loop have seen what is there."""
    for _ in range(count):
        await asyncio.sleep(0)


def noise(size: int, seed: int = 1) -> bytes:
    return random.Random(seed).randbytes(size)


# --- data --------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, RECORD_SIZE, RECORD_SIZE + 1, tls.PIECE + 1, 3 * MIB + 7])
async def test_what_is_said_comes_back(harness: Harness, size):
    peer, served = await harness.log_in(echo)
    data = noise(size)
    speaking = asyncio.ensure_future(peer.send(data))
    assert await peer.receive(size) == data
    await speaking
    assert served.data == data
    served.transport.close()
    assert await peer.receive_rest() == b""
    peer.sock.close()
    await served.ended()
    assert served.error is None
    assert [word for word in served.heard if word in {"made", "eof", "lost"}] == ["made", "lost"]


async def test_all_kinds_of_bytes_are_written(harness: Harness):
    peer, served = await harness.log_in()
    kept = bytearray(b"bytearray,")
    served.transport.write(b"")
    served.transport.write(kept)
    kept[:] = b"overwritten"  # the transport must have its own
    served.transport.write(memoryview(b"_memoryview,")[1:])
    served.transport.writelines([b"lines ", b"", bytearray(b"of "), memoryview(b"both")])
    large = bytearray(noise(100_000))
    served.transport.write(large)
    expected = b"bytearray,memoryview,lines of both" + bytes(large)
    large[:] = bytes(100_000)
    assert await peer.receive(len(expected)) == expected


@pytest.mark.parametrize("size", [1, 5 * RECORD_SIZE])
async def test_data_right_behind_the_handshake(harness: Harness, size):
    """It is in the same chunk as the last message of the handshake."""
    behind = noise(size)
    _, served = await harness.log_in(behind=behind)
    await until(lambda: len(served.data) == len(behind))
    assert served.data == behind


async def test_a_chunk_of_many_records_is_handed_on_as_one(harness: Harness):
    """Who is written to because of it is then written to once."""
    peer, served = await harness.log_in()
    await peer.put(b"".join(peer.seal(b"message %d" % n) for n in range(50)))
    await until(lambda: served.data.endswith(b"message 49"))
    assert served.chunks == 1


async def log_in_on(harness: Harness, scheduler: LayerScheduler) -> tuple[Peer, Served]:
    """Both ends of a connection over our transport, which takes its turns by this scheduler."""
    served = Served()
    peer, accepted = await harness.dial()
    harness.all.append(served)
    shaking = asyncio.ensure_future(peer.shake_hands())
    await own(accepted, harness.server, served, PATIENCE, scheduler)
    await shaking
    return peer, served


async def test_many_records_in_one_chunk_take_turns(harness: Harness):
    """Some of them at a time, whatever they hold, and what ends the connection behind them all."""
    scheduler = LayerScheduler()
    peer, served = await log_in_on(harness, scheduler)
    text = noise(5000)
    await peer.put(b"".join(peer.seal(text[n : n + 1]) for n in range(len(text))))
    peer.sock.shutdown(socket.SHUT_WR)
    await served.ended()
    assert bytes(served.data) == text
    assert served.chunks >= len(text) / RECORDS_A_TURN
    assert scheduler.cost >= len(text)


async def test_while_others_have_to_be_served_a_chunk_waits(harness: Harness):
    scheduler = LayerScheduler()
    peer, served = await log_in_on(harness, scheduler)
    queued: list[Schedulable] = []
    scheduler.busy, scheduler.queue_turn = True, queued.append  # type: ignore[method-assign]
    await peer.put(peer.seal(b"little"))
    await until(lambda: served.data == b"little")
    await peer.put(peer.seal(bytes(8000)) * 1)
    await until(lambda: queued)
    assert served.data == b"little"
    assert served.set_aside > 8000
    served.transport.pause_reading()
    queued.pop().take_turn()
    assert served.data == b"little", "who has paused reading is handed nothing"
    served.transport.resume_reading()
    queued.pop().take_turn()
    await until(lambda: len(served.data) == 8006 or queued)
    while queued:
        queued.pop().take_turn()
    await until(lambda: len(served.data) == 8006)
    assert served.set_aside == 0


async def test_what_the_protocol_can_ask(harness: Harness):
    peer, served = await harness.log_in()
    ask = served.transport.get_extra_info
    assert ask("ssl_object").version() == harness.client.maximum_version.name.replace("v1_", "v1.")
    assert ask("sslcontext") is harness.server
    assert ask("cipher") == ask("ssl_object").cipher()
    assert ask("compression") is None and ask("peercert") is None
    assert ask("peername") == peer.sock.getsockname()
    assert ask("socket").fileno() >= 0
    assert ask("nothing", "default") == "default"
    assert not served.transport.can_write_eof()
    served.transport.set_write_buffer_limits(high=1000, low=10)
    assert served.transport.get_write_buffer_limits() == (10, 1000)
    other = Served()
    served.transport.set_protocol(other)
    assert served.transport.get_protocol() is other
    other.heard.append("made")
    await peer.send(b"for the other")
    await until(lambda: other.data)
    assert not served.data
    served.transport.set_protocol(served)


# --- slow readers ------------------------------------------------------------------------------


async def test_a_large_transfer_to_a_slow_reader_is_bounded(harness: Harness):
    """Whoever heeds pause_writing holds no more than the limit and what it wrote in one go."""
    peer, served = await harness.log_in(receive_buffer=8192)
    served.transport.set_write_buffer_limits(high=256 * 1024)
    piece, pieces, most = noise(64 * 1024), 200, 0

    async def write_all() -> None:
        nonlocal most
        for _ in range(pieces):
            await until(lambda: served.heard[-1] != "pause")
            served.transport.write(piece)
            most = max(most, served.transport.get_write_buffer_size())
        served.transport.close()

    writing = asyncio.ensure_future(write_all())
    await until(lambda: served.heard[-1] == "pause")
    digest = hashlib.sha256()
    size = 0
    while data := await peer.receive(100_000):
        digest.update(data)
        size += len(data)
    await writing
    assert size == pieces * len(piece)
    assert digest.digest() == hashlib.sha256(piece * pieces).digest()
    assert served.heard.count("pause") == served.heard.count("resume") > 1
    assert 0 < most < 256 * 1024 + 2 * len(piece)


async def test_who_does_not_want_to_read_is_not_sent_more(harness: Harness):
    """A pause holds from one chunk to the next, and the sender is held up by the network."""

    def pause(served: Served, data: bytes) -> None:
        served.transport.pause_reading()

    peer, served = await harness.log_in(pause)
    data = noise(12 * MIB)
    sealed = peer.seal(data)
    speaking = asyncio.ensure_future(peer.put(sealed))
    await until(lambda: served.data)
    assert not served.transport.is_reading()
    size = len(served.data)
    await asyncio.sleep(0.1)
    assert len(served.data) == size
    assert not speaking.done()
    while len(served.data) < len(data):
        chunks = served.chunks
        served.transport.resume_reading()
        assert served.transport.is_reading()
        await until(lambda: served.chunks > chunks)  # noqa: B023
        assert served.chunks == chunks + 1
    await speaking
    assert served.data == data


async def test_a_connection_keeps_nothing_of_the_largest_message(harness: Harness):
    """OpenSSL's buffers never shrink, so they must not have grown."""
    clients = [await harness.log_in() for _ in range(30)]
    large = noise(MIB)

    async def exchange(peer: Peer, served: Served) -> None:
        served.transport.write(large)
        assert await peer.receive(MIB) == large
        await peer.put(peer.seal(large))
        await until(lambda: len(served.data) == MIB)
        served.data.clear()

    await exchange(*clients[0])  # what is kept once for all
    before = psutil.Process().memory_info().rss
    for peer, served in clients:
        await exchange(peer, served)
    # It would be more than 1 MiB each for what is written, and 300 KiB, a chunk, for what is read.
    assert psutil.Process().memory_info().rss - before < len(clients) * 200 * 1024


async def test_who_makes_openssl_answer_must_read_the_answers(harness: Harness):
    """An answer that OpenSSL gives by itself, here an alert, does not pile up."""
    peer, served = await harness.log_in(receive_buffer=8192)
    served.transport.write(noise(8 * MIB))
    await until(lambda: served.heard[-1] == "pause")
    await peer.put(b"\x17\x03\x03\x00\x20" + bytes(32))
    await served.ended()
    assert not served.data


# --- the handshake -----------------------------------------------------------------------------


async def refused(harness: Harness, accepted: socket.socket, timeout: float = PATIENCE) -> Any:
    """What `accept` raises; the protocol must not have heard of the connection."""
    served = Served()
    with pytest.raises((OSError, asyncio.TimeoutError)) as caught:
        await own(accepted, harness.server, served, timeout)
    accepted.close()
    assert not served.heard
    return caught.value


@pytest.mark.parametrize("garbage", [b"GET / HTTP/1.1\r\n\r\n", b"\x10\x0c\0\4MQTT", bytes(70000)])
async def test_what_is_not_tls_is_refused(harness: Harness, garbage):
    peer, accepted = await harness.dial()
    await peer.put(garbage)
    error = await refused(harness, accepted)
    assert isinstance(error, ssl.SSLError) and error.reason
    await peer.receive_raw_rest()


async def test_the_reason_of_a_failed_handshake_is_told(harness: Harness, server, directory):
    """To the client with an alert, and to the caller of `accept`."""
    harness.server = certs.server_context(
        directory / "server.crt", directory / "server.key", directory / "ca.crt", "required"
    )
    peer, accepted = await harness.dial()
    shaking = asyncio.ensure_future(peer.shake_hands())
    error = await refused(harness, accepted)
    assert error.reason == "PEER_DID_NOT_RETURN_A_CERTIFICATE"
    with pytest.raises(ssl.SSLError, match=r"(?i)certificate.required|handshake.failure"):
        await shaking
        await peer.receive(1)


async def test_a_client_that_does_not_trust_the_certificate(harness: Harness):
    harness.client = ssl.create_default_context()
    peer, accepted = await harness.dial()

    async def try_it() -> None:
        with contextlib.suppress(ssl.SSLCertVerificationError):
            await peer.shake_hands()
        await peer.put(peer._outgoing.read())

    shaking = asyncio.ensure_future(try_it())
    error = await refused(harness, accepted)
    assert "UNKNOWN_CA" in error.reason
    await shaking


async def test_an_old_version_is_refused(harness: Harness):
    with pytest.warns(DeprecationWarning):
        harness.client.minimum_version = ssl.TLSVersion.TLSv1
        harness.client.maximum_version = ssl.TLSVersion.TLSv1_1
    harness.client.set_ciphers("ALL:@SECLEVEL=0")
    peer, accepted = await harness.dial()
    await peer.put(peer.step())
    error = await refused(harness, accepted)
    assert error.reason == "UNSUPPORTED_PROTOCOL"
    assert (await peer.receive_raw_rest())[0] == ALERT


@pytest.mark.parametrize("reset", [False, True], ids=["closed", "reset"])
@pytest.mark.parametrize("part", [0.0, 0.01, 0.5, 1.0])
async def test_a_handshake_that_is_cut_off(harness: Harness, part, reset):
    peer, accepted = await harness.dial()
    hello = peer.step()
    served = Served()
    accepting = asyncio.ensure_future(own(accepted, harness.server, served, PATIENCE))
    await peer.put(hello[: int(part * len(hello))])
    await scheduler()
    if reset:
        peer.reset()
    else:
        peer.sock.close()
    with pytest.raises(ConnectionError):
        await accepting
    assert not served.heard


@pytest.mark.parametrize("part", [0.0, 0.5, 1.0])
async def test_a_handshake_that_never_ends(harness: Harness, part):
    peer, accepted = await harness.dial()
    hello = peer.step()
    await peer.put(hello[: int(part * len(hello))])
    error = await refused(harness, accepted, 0.05)
    assert isinstance(error, asyncio.TimeoutError) and str(error) == "no handshake within 0.05 s"
    await peer.receive_raw_rest()


async def test_accepting_can_be_cancelled(harness: Harness):
    peer, accepted = await harness.dial()
    served = Served()
    accepting = asyncio.ensure_future(own(accepted, harness.server, served, PATIENCE))
    await peer.put(peer.step())
    await peer.get()
    accepting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await accepting
    accepted.close()
    await peer.receive_raw_rest()
    assert not served.heard


# --- the end -----------------------------------------------------------------------------------


async def test_the_client_says_goodbye(harness: Harness):
    """close_notify is answered with close_notify; what was said before it counts."""
    peer, served = await harness.log_in(echo)
    await peer.put(peer.seal(b"last words") + peer.seal_end() + b"not TLS any more")
    await served.ended()
    assert served.heard == ["made", "data", "eof", "lost"]
    assert served.data == b"last words" and served.error is None
    await peer.receive_rest()
    assert await peer.receive_raw_rest() == b""


async def test_who_has_paused_reading_hears_of_the_goodbye_later(harness: Harness):
    """As over TCP: what was said before it may take time to answer, a login for one."""
    peer, served = await harness.log_in(lambda served, data: served.transport.pause_reading())
    await peer.put(peer.seal(b"last words") + peer.seal_end())
    await until(lambda: served.data)
    await scheduler(20)
    assert served.heard == ["made", "data"] and not served.transport.is_closing()
    served.transport.write(b"heard")
    served.transport.resume_reading()
    await served.ended()
    assert served.heard == ["made", "data", "eof", "lost"] and served.error is None
    assert await peer.receive_rest() == b"heard"


@pytest.mark.parametrize("part", [0.0, 0.5])
async def test_a_connection_that_is_closed_without_goodbye(harness: Harness, part):
    """At the end of a record or in its middle: whole records count, and are still answered."""
    peer, served = await harness.log_in(echo)
    whole, record = peer.seal(b"whole"), peer.seal(b"half a record")
    await peer.put(whole + record[: int(part * len(record))])
    peer.sock.shutdown(socket.SHUT_WR)
    assert await peer.receive_rest() == b"whole"
    await served.ended()
    assert served.heard == ["made", "data", "eof", "lost"]
    assert served.error is None


async def test_a_connection_that_is_reset(harness: Harness):
    peer, served = await harness.log_in()
    whole, record = peer.seal(b"whole"), peer.seal(b"half a record")
    await peer.put(whole + record[:10])
    await until(lambda: served.data)
    peer.reset()
    await served.ended()
    assert served.heard == ["made", "data", "lost"]
    assert isinstance(served.error, ConnectionError)
    served.transport.write(b"into the void")
    served.transport.close()
    served.transport.abort()


@pytest.mark.parametrize("kind", ["garbage", "flipped"])
@pytest.mark.parametrize("apart", [False, True], ids=["at once", "apart"])
async def test_a_broken_record_ends_the_connection(harness: Harness, kind, apart):
    """With an alert, and after what came before it."""
    peer, served = await harness.log_in()
    good, record = peer.seal(b"good"), peer.seal(b"bad")
    bad = b"GET / HTTP/1.1\r\n" if kind == "garbage" else record[:-1] + bytes([record[-1] ^ 1])
    if apart:
        await peer.put(good)
        await until(lambda: served.data)
        await peer.put(bad)
    else:
        await peer.put(good + bad)
    await served.ended()
    assert served.heard == ["made", "data", "lost"]
    assert served.data == b"good"
    assert isinstance(served.error, ssl.SSLError)
    with pytest.raises(ssl.SSLError, match=r"(?i)alert"):
        await peer.receive_rest()


async def test_a_close_writes_out_what_waits(harness: Harness):
    peer, served = await harness.log_in(receive_buffer=8192)
    data = noise(4 * MIB)
    served.transport.write(data)
    assert served.transport.get_write_buffer_size() > 0
    served.transport.close()
    assert served.transport.is_closing() and not served.transport.is_reading()
    served.transport.write(b"too late")
    served.transport.close()
    served.transport.resume_reading()
    assert await peer.receive_rest() == data
    await served.ended()
    assert served.error is None


@pytest.mark.parametrize("half", [False, True], ids=["open", "half"])
async def test_who_does_not_read_the_last_bytes_is_cut_off(harness: Harness, monkeypatch, half):
    """Whether it was closed here or is at the end of its sending: it may not stay for ever."""
    monkeypatch.setattr(tls, "CLOSE_TIMEOUT", 0.1)
    peer, served = await harness.log_in(receive_buffer=8192)
    served.transport.write(bytes(4 * MIB))
    if half:
        peer.sock.shutdown(socket.SHUT_WR)
    else:
        served.transport.close()
    await served.ended()


async def test_an_abort_drops_what_waits(harness: Harness):
    peer, served = await harness.log_in(receive_buffer=8192)
    served.transport.write(bytes(4 * MIB))
    served.transport.abort()
    served.transport.abort()
    assert served.transport.is_closing()
    await served.ended()
    served.transport.abort()
    served.transport.close()
    assert served.heard.count("lost") == 1
    with pytest.raises((EOFError, ConnectionError)):
        await peer.receive_rest()


@pytest.mark.parametrize("end", ["close", "abort"])
async def test_the_protocol_ends_it_while_it_is_told_something(harness: Harness, end):
    """Nothing more is handed on, not even the end that is in the same chunk."""
    peer, served = await harness.log_in(lambda served, data: getattr(served.transport, end)())
    await peer.put(peer.seal(b"quit") + peer.seal_end())
    await until(lambda: served.data)
    peer.sock.close()
    await served.ended()
    assert served.data == b"quit"
    assert [word for word in served.heard if word not in {"made", "data"}] == ["lost"]


async def test_a_failing_write_ends_its_own_connection_only(harness: Harness, monkeypatch):
    _, served = await harness.log_in()

    class Broken:
        def write(self, data):
            raise ssl.SSLError(1, "the test says so")

    monkeypatch.setattr(served.transport, "_tls", Broken())
    served.transport.write(b"x")
    await served.ended()
    assert isinstance(served.error, ssl.SSLError)


ENDS = ["hung up", "never", "not TLS", "cancelled", "goodbye", "eof", "reset", "broken"]


@pytest.mark.parametrize("end", [*ENDS, "closed", "closed unread", "aborted"])
async def test_the_memory_of_a_connection_is_free_at_once(harness: Harness, monkeypatch, end):
    """However it ends, not only when garbage is looked for, which may never find it."""
    both_ends: list[weakref.ref[object]] = []

    class Watched(TlsTransport):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            both_ends.append(weakref.ref(self))

    monkeypatch.setattr(tls, "TlsTransport", Watched)
    peer, accepted = await harness.dial(receive_buffer=8192)

    async def serve(timeout: float) -> None:
        served = Served()
        both_ends.append(weakref.ref(served))
        with contextlib.suppress(OSError, asyncio.TimeoutError):
            await own(accepted, harness.server, served, timeout)
            if end.startswith("closed"):
                served.transport.write(bytes(4 * MIB if end == "closed unread" else 10))
                served.transport.close()
            elif end == "aborted":
                served.transport.abort()
            await served.ended()
            served.transport = None

    gc.disable()
    try:
        serving = asyncio.ensure_future(serve(0.05 if end == "never" else PATIENCE))
        await scheduler()
        if end == "not TLS":
            await peer.put(b"GET / HTTP/1.1\r\n\r\n")
        elif end == "cancelled":
            serving.cancel()
        elif end != "hung up" and end != "never":
            await peer.shake_hands()
        if end == "goodbye":
            await peer.put(peer.seal_end())
        elif end == "eof":
            peer.sock.shutdown(socket.SHUT_WR)
        elif end == "broken":
            await peer.put(b"\x17\x03\x03\x00\x20" + bytes(32))
        elif end in {"hung up", "reset", "closed unread"}:
            await scheduler()
            peer.reset()
        with contextlib.suppress(asyncio.CancelledError):
            await serving
        del serving
        accepted.close()
        await until(lambda: not any(end() for end in both_ends))
    finally:
        gc.enable()


# --- what OpenSSL does besides -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("version", "command"), [("-tls1_3", "K"), ("-tls1_3", "k"), ("-tls1_2", "R")]
)
async def test_new_keys_and_a_refused_renegotiation(server, directory, version, command):
    """openssl s_client asks for new keys with K (of both) and k, for a renegotiation with R."""
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("needs the openssl command")
    listening = socket.create_server(("127.0.0.1", 0))
    listening.setblocking(False)
    port = listening.getsockname()[1]
    process = await asyncio.create_subprocess_exec(
        *(openssl, "s_client", version, "-quiet", "-no_ign_eof"),
        *("-connect", f"127.0.0.1:{port}", "-CAfile", str(directory / "ca.crt")),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )
    assert process.stdin is not None and process.stdout is not None
    served = Served(echo)
    try:
        accepted, _ = await asyncio.get_running_loop().sock_accept(listening)
        await own(accepted, server, served, PATIENCE)
        process.stdin.write(b"before\n")
        assert await asyncio.wait_for(process.stdout.readline(), PATIENCE) == b"before\n"
        sock = served.transport.get_extra_info("socket")
        before = receive_buffer(sock).received
        process.stdin.write(command.encode() + b"\n")
        if command == "R":
            await served.ended()  # it does not want to stay without
            assert isinstance(served.error, ssl.SSLError)
        else:
            # A command is one only when it comes alone.
            await until(lambda: receive_buffer(sock).received > before, "the new keys")
            process.stdin.write(b"behind\n")
            assert await asyncio.wait_for(process.stdout.readline(), PATIENCE) == b"behind\n"
            process.stdin.write(b"Q\n")
            await served.ended()
            assert served.heard[-2:] == ["eof", "lost"]
    finally:
        listening.close()
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
        await process.wait()


# --- the same as its twins ---------------------------------------------------------------------

CUTS = st.lists(st.integers(1, 400) | st.integers(1, 60_000), max_size=40)
MESSAGES = st.lists(st.integers(0, 300) | st.sampled_from([16_000, 40_000]), max_size=12)


def chunks_of(data: bytes, cuts: list[int]) -> list[bytes]:
    """The data cut into pieces of these sizes, and the rest in one."""
    pieces, start = [], 0
    for cut in cuts:
        if start >= len(data):
            break
        pieces.append(data[start : start + cut])
        start += cut
    return [piece for piece in [*pieces, data[start:]] if piece]


@examples(25, suppress_health_check=[*HealthCheck])
@given(sizes=MESSAGES, cuts=CUTS, end=st.sampled_from(["notify", "half", "cut"]))
def test_the_same_as_asyncios_own_transport(server, client, sizes, cuts, end):
    """The same records in the same chunks: the same data and answers."""

    async def converse(accept: Any) -> tuple[bytes, bytes]:
        harness = Harness(server, client)
        peer, served = await harness.log_in(echo, accept=accept)
        sealed = b"".join(peer.seal(noise(size, n)) for n, size in enumerate(sizes) if size)
        if end == "cut":
            sealed = sealed[:-3]
        if end == "notify":
            sealed += peer.seal_end()

        async def speak() -> None:
            for chunk in chunks_of(sealed, cuts):
                await peer.put(chunk)
                await scheduler(2)
            if end != "notify":
                peer.sock.shutdown(socket.SHUT_WR)

        speaking = asyncio.ensure_future(speak())
        answer = await peer.receive(MIB, rude=True)  # asyncio is, to those who are
        await peer.receive_raw_rest()
        await speaking
        await served.ended()
        await harness.close()
        if accept is own:  # asyncio's transport tells less, depending on its version
            told = [word for word in served.heard if word in {"made", "eof", "lost"}]
            assert told == ["made", "eof", "lost"] and served.error is None
        return bytes(served.data), answer

    loop = asyncio.SelectorEventLoop()
    try:
        ours = loop.run_until_complete(converse(own))
        assert ours == loop.run_until_complete(converse(asyncios))
    finally:
        loop.close()


class Network:
    """A TCP transport that takes everything, and says what became of it."""

    def __init__(self) -> None:
        self.sent = bytearray()
        self.closing = False

    def write(self, data: bytes) -> None:
        self.sent += data

    def is_closing(self) -> bool:
        return self.closing

    def close(self) -> None:
        self.closing = True

    abort = write_eof = resume_reading = close


@examples(60, suppress_health_check=[*HealthCheck])
@given(
    sizes=MESSAGES,
    cuts=CUTS,
    hello_cuts=CUTS,
    flip=st.none() | st.floats(0, 1, exclude_max=True),
)
async def test_any_split_of_the_bytes_says_the_same(server, client, sizes, cuts, hello_cuts, flip):
    """Handshake included; a flipped bit ends it where it is, whatever was in the same chunk."""
    seen = []
    for split in (False, True):
        served, network = Served(), Network()
        transport = TlsTransport(served, server, LayerScheduler())
        transport.connection_made(network)  # type: ignore[arg-type]
        with socket.socket() as unused:
            peer = Peer(unused, client)
        while hello := peer.step():
            for chunk in chunks_of(hello, hello_cuts) if split else [hello]:
                transport.data_received(chunk)
            peer._incoming.write(bytes(network.sent))
            network.sent.clear()
        assert served.heard == ["made"]
        transport.write(b"")
        assert not network.sent
        records = [peer.seal(noise(size, n)) for n, size in enumerate(sizes) if size]
        sealed = bytearray(b"".join(records) + peer.seal_end())
        if flip is not None:
            sealed[int(flip * len(sealed))] ^= 1
        for chunk in chunks_of(bytes(sealed), cuts if split else []):
            transport.data_received(chunk)
        broken = transport._error is not None
        if flip is None:
            whole = b"".join(noise(size, n) for n, size in enumerate(sizes))
            assert served.data == whole and not broken
            assert served.heard[-1] == "eof" and network.closing
        transport.connection_lost(None)
        seen.append((bytes(served.data), broken, "eof" in served.heard, type(served.error)))
    assert seen[0] == seen[1]
