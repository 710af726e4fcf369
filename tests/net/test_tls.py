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
import uvloop
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from waiting import PATIENCE, until

from appliance import certs
from appliance.broker.faults import Faults
from appliance.net import tls
from appliance.net.callbacks import Entries
from appliance.net.tls import RECORD_SIZE, RECORDS_A_TURN, TlsTransport
from appliance.net.turns import Charged, Turn

# The way that is left to override it, and to have both loops, is too new for some computers.
pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')

MIB = 1 << 20
ALERT = 0x15  # the record's type (RFC 8446, section 5.1)


class Turns:
    """Whose turn it is: in the next round of the loop, and there is nobody else."""

    def __init__(self) -> None:
        self.entries = Entries(asyncio.get_running_loop(), Faults())
        self.cost = 0
        self.busy = False

    def count(self, cost: int, charged: Charged) -> None:
        self.cost += cost

    def has_to_wait(self, charged: Charged, *, is_little: bool) -> bool:
        return self.busy and not is_little

    def queue_turn(self, member: Turn) -> None:
        asyncio.get_running_loop().call_soon(member.take_turn)


async def own(
    connection: socket.socket,
    context: ssl.SSLContext,
    protocol: asyncio.Protocol,
    timeout: float,
    turns: Turns | None = None,
) -> None:
    await tls.accept(connection, context, protocol, timeout, turns or Turns())


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


@pytest.fixture(
    scope="module",
    params=[asyncio.DefaultEventLoopPolicy(), uvloop.EventLoopPolicy()],
    ids=["asyncio", "uvloop"],
)
def event_loop_policy(request: pytest.FixtureRequest) -> asyncio.AbstractEventLoopPolicy:
    return request.param  # type: ignore[no-any-return]


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

    def set_apart(self, size):
        self.set_aside = size

    def is_not_read(self):
        pass

    def is_read(self):
        pass

    def has_part(self, part):
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


class Caller:
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

    async def say(self, data: bytes) -> None:
        view = memoryview(data)
        for start in range(0, len(view), RECORD_SIZE):
            await self.put(self.seal(view[start : start + RECORD_SIZE]))  # type: ignore[arg-type]

    async def hear(self, size: int, *, rude: bool = False) -> bytes:
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

    async def hear_the_end(self) -> bytes:
        """Everything up to close_notify."""
        return await self.hear(1 << 62)

    async def hear_raw_end(self) -> bytes:
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


class House:
    """A listening socket; the connections made to it end with the test."""

    def __init__(self, server: ssl.SSLContext, client: ssl.SSLContext) -> None:
        self.server, self.client = server, client
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._listening.setblocking(False)
        self._stack = contextlib.ExitStack()
        self._stack.callback(self._listening.close)
        self.all: list[Served] = []

    async def dial(self, receive_buffer: int = 0) -> tuple[Caller, socket.socket]:
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
        return Caller(sock, self.client), accepted

    async def join(
        self,
        on_data: Callable[[Served, bytes], object] | None = None,
        *,
        behind: bytes = b"",
        receive_buffer: int = 0,
        accept: Any = own,
    ) -> tuple[Caller, Served]:
        """A connection after its handshake."""
        caller, accepted = await self.dial(receive_buffer)
        served = Served(on_data)
        self.all.append(served)
        shaking = asyncio.ensure_future(caller.shake_hands(behind))
        await accept(accepted, self.server, served, PATIENCE)
        await shaking
        return caller, served

    async def close(self) -> None:
        for served in self.all:
            if served.transport is not None and not served.lost.is_set():
                served.transport.abort()
                await served.ended()
        self._stack.close()


@pytest.fixture
async def house(server: ssl.SSLContext, client: ssl.SSLContext) -> AsyncIterator[House]:
    house = House(server, client)
    yield house
    await house.close()


async def turns(count: int = 5) -> None:
    """Let the loop have seen what is there."""
    for _ in range(count):
        await asyncio.sleep(0)


def noise(size: int, seed: int = 1) -> bytes:
    return random.Random(seed).randbytes(size)


# --- data --------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, RECORD_SIZE, RECORD_SIZE + 1, tls.PIECE + 1, 3 * MIB + 7])
async def test_what_is_said_comes_back(house: House, size):
    caller, served = await house.join(echo)
    data = noise(size)
    speaking = asyncio.ensure_future(caller.say(data))
    assert await caller.hear(size) == data
    await speaking
    assert served.data == data
    served.transport.close()
    assert await caller.hear_the_end() == b""
    caller.sock.close()
    await served.ended()
    assert served.error is None
    assert [word for word in served.heard if word in {"made", "eof", "lost"}] == ["made", "lost"]


async def test_all_kinds_of_bytes_are_written(house: House):
    caller, served = await house.join()
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
    assert await caller.hear(len(expected)) == expected


@pytest.mark.parametrize("size", [1, 5 * RECORD_SIZE])
async def test_data_right_behind_the_handshake(house: House, size):
    """It is in the same chunk as the last message of the handshake."""
    behind = noise(size)
    _, served = await house.join(behind=behind)
    await until(lambda: len(served.data) == len(behind))
    assert served.data == behind


async def test_a_chunk_of_many_records_is_handed_on_as_one(house: House):
    """Who is written to because of it is then written to once."""
    caller, served = await house.join()
    await caller.put(b"".join(caller.seal(b"message %d" % n) for n in range(50)))
    await until(lambda: served.data.endswith(b"message 49"))
    assert served.chunks == 1


async def test_many_records_in_one_chunk_take_turns(house: House):
    """Some of them at a time, whatever they hold, and what ends the connection behind them all."""
    turns = Turns()
    served = Served()
    caller, accepted = await house.dial()
    house.all.append(served)
    shaking = asyncio.ensure_future(caller.shake_hands())
    await own(accepted, house.server, served, PATIENCE, turns)
    await shaking
    text = noise(5000)
    await caller.put(b"".join(caller.seal(text[n : n + 1]) for n in range(len(text))))
    caller.sock.shutdown(socket.SHUT_WR)
    await served.ended()
    assert bytes(served.data) == text
    assert served.chunks >= len(text) / RECORDS_A_TURN
    assert turns.cost >= len(text)


async def test_while_others_have_to_be_served_a_chunk_waits(house: House):
    turns = Turns()
    served = Served()
    caller, accepted = await house.dial()
    house.all.append(served)
    shaking = asyncio.ensure_future(caller.shake_hands())
    await own(accepted, house.server, served, PATIENCE, turns)
    await shaking
    queued: list[Turn] = []
    turns.busy, turns.queue_turn = True, queued.append  # type: ignore[method-assign]
    await caller.put(caller.seal(b"little"))
    await until(lambda: served.data == b"little")
    await caller.put(caller.seal(bytes(8000)) * 1)
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


async def test_what_the_protocol_can_ask(house: House):
    caller, served = await house.join()
    ask = served.transport.get_extra_info
    assert ask("ssl_object").version() == house.client.maximum_version.name.replace("v1_", "v1.")
    assert ask("sslcontext") is house.server
    assert ask("cipher") == ask("ssl_object").cipher()
    assert ask("compression") is None and ask("peercert") is None
    assert ask("peername") == caller.sock.getsockname()
    assert ask("socket").fileno() >= 0
    assert ask("nothing", "default") == "default"
    assert not served.transport.can_write_eof()
    served.transport.set_write_buffer_limits(high=1000, low=10)
    assert served.transport.get_write_buffer_limits() == (10, 1000)
    other = Served()
    served.transport.set_protocol(other)
    assert served.transport.get_protocol() is other
    other.heard.append("made")
    await caller.say(b"for the other")
    await until(lambda: other.data)
    assert not served.data
    served.transport.set_protocol(served)


# --- slow readers ------------------------------------------------------------------------------


async def test_a_large_transfer_to_a_slow_reader_is_bounded(house: House):
    """Whoever heeds pause_writing holds no more than the limit and what it wrote in one go."""
    caller, served = await house.join(receive_buffer=8192)
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
    while data := await caller.hear(100_000):
        digest.update(data)
        size += len(data)
    await writing
    assert size == pieces * len(piece)
    assert digest.digest() == hashlib.sha256(piece * pieces).digest()
    assert served.heard.count("pause") == served.heard.count("resume") > 1
    assert 0 < most < 256 * 1024 + 2 * len(piece)


async def test_who_does_not_want_to_read_is_not_sent_more(house: House):
    """A pause holds from one chunk to the next, and the sender is held up by the network."""

    def pause(served: Served, data: bytes) -> None:
        served.transport.pause_reading()

    caller, served = await house.join(pause)
    data = noise(12 * MIB)
    sealed = caller.seal(data)
    speaking = asyncio.ensure_future(caller.put(sealed))
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


async def test_a_connection_keeps_nothing_of_the_largest_message(house: House):
    """OpenSSL's buffers never shrink, so they must not have grown."""
    clients = [await house.join() for _ in range(30)]
    large = noise(MIB)

    async def exchange(caller: Caller, served: Served) -> None:
        served.transport.write(large)
        assert await caller.hear(MIB) == large
        await caller.put(caller.seal(large))
        await until(lambda: len(served.data) == MIB)
        served.data.clear()

    await exchange(*clients[0])  # what is kept once for all
    before = psutil.Process().memory_info().rss
    for caller, served in clients:
        await exchange(caller, served)
    # It would be more than 1 MiB each for what is written, and 300 KiB, a chunk, for what is read.
    assert psutil.Process().memory_info().rss - before < len(clients) * 200 * 1024


async def test_who_makes_openssl_answer_must_read_the_answers(house: House):
    """An answer that OpenSSL gives by itself, here an alert, does not pile up."""
    caller, served = await house.join(receive_buffer=8192)
    served.transport.write(noise(8 * MIB))
    await until(lambda: served.heard[-1] == "pause")
    await caller.put(b"\x17\x03\x03\x00\x20" + bytes(32))
    await served.ended()
    assert not served.data


# --- the handshake -----------------------------------------------------------------------------


async def refused(house: House, accepted: socket.socket, timeout: float = PATIENCE) -> Any:
    """What `accept` raises; the protocol must not have heard of the connection."""
    served = Served()
    with pytest.raises((OSError, asyncio.TimeoutError)) as caught:
        await own(accepted, house.server, served, timeout)
    accepted.close()
    assert not served.heard
    return caught.value


@pytest.mark.parametrize("garbage", [b"GET / HTTP/1.1\r\n\r\n", b"\x10\x0c\0\4MQTT", bytes(70000)])
async def test_what_is_not_tls_is_refused(house: House, garbage):
    caller, accepted = await house.dial()
    await caller.put(garbage)
    error = await refused(house, accepted)
    assert isinstance(error, ssl.SSLError) and error.reason
    await caller.hear_raw_end()


async def test_the_reason_of_a_failed_handshake_is_told(house: House, server, directory):
    """To the client with an alert, and to the caller of `accept`."""
    house.server = certs.server_context(
        directory / "server.crt", directory / "server.key", directory / "ca.crt", "required"
    )
    caller, accepted = await house.dial()
    shaking = asyncio.ensure_future(caller.shake_hands())
    error = await refused(house, accepted)
    assert error.reason == "PEER_DID_NOT_RETURN_A_CERTIFICATE"
    with pytest.raises(ssl.SSLError, match=r"(?i)certificate.required|handshake.failure"):
        await shaking
        await caller.hear(1)


async def test_a_client_that_does_not_trust_the_certificate(house: House):
    house.client = ssl.create_default_context()
    caller, accepted = await house.dial()

    async def try_it() -> None:
        with contextlib.suppress(ssl.SSLCertVerificationError):
            await caller.shake_hands()
        await caller.put(caller._outgoing.read())

    shaking = asyncio.ensure_future(try_it())
    error = await refused(house, accepted)
    assert "UNKNOWN_CA" in error.reason
    await shaking


async def test_an_old_version_is_refused(house: House):
    with pytest.warns(DeprecationWarning):
        house.client.minimum_version = ssl.TLSVersion.TLSv1
        house.client.maximum_version = ssl.TLSVersion.TLSv1_1
    house.client.set_ciphers("ALL:@SECLEVEL=0")
    caller, accepted = await house.dial()
    await caller.put(caller.step())
    error = await refused(house, accepted)
    assert error.reason == "UNSUPPORTED_PROTOCOL"
    assert (await caller.hear_raw_end())[0] == ALERT


@pytest.mark.parametrize("reset", [False, True], ids=["closed", "reset"])
@pytest.mark.parametrize("part", [0.0, 0.01, 0.5, 1.0])
async def test_a_handshake_that_is_cut_off(house: House, part, reset):
    caller, accepted = await house.dial()
    hello = caller.step()
    served = Served()
    accepting = asyncio.ensure_future(own(accepted, house.server, served, PATIENCE))
    await caller.put(hello[: int(part * len(hello))])
    await turns()
    if reset:
        caller.reset()
    else:
        caller.sock.close()
    with pytest.raises(ConnectionError):
        await accepting
    assert not served.heard


@pytest.mark.parametrize("part", [0.0, 0.5, 1.0])
async def test_a_handshake_that_never_ends(house: House, part):
    caller, accepted = await house.dial()
    hello = caller.step()
    await caller.put(hello[: int(part * len(hello))])
    error = await refused(house, accepted, 0.05)
    assert isinstance(error, asyncio.TimeoutError) and str(error) == "no handshake within 0.05 s"
    await caller.hear_raw_end()


async def test_accepting_can_be_cancelled(house: House):
    caller, accepted = await house.dial()
    served = Served()
    accepting = asyncio.ensure_future(own(accepted, house.server, served, PATIENCE))
    await caller.put(caller.step())
    await caller.get()
    accepting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await accepting
    accepted.close()
    await caller.hear_raw_end()
    assert not served.heard


# --- the end -----------------------------------------------------------------------------------


async def test_the_client_says_goodbye(house: House):
    """close_notify is answered with close_notify; what was said before it counts."""
    caller, served = await house.join(echo)
    await caller.put(caller.seal(b"last words") + caller.seal_end() + b"not TLS any more")
    await served.ended()
    assert served.heard == ["made", "data", "eof", "lost"]
    assert served.data == b"last words" and served.error is None
    await caller.hear_the_end()
    assert await caller.hear_raw_end() == b""


async def test_who_has_paused_reading_hears_of_the_goodbye_later(house: House):
    """As over TCP: what was said before it may take time to answer, a login for one."""
    caller, served = await house.join(lambda served, data: served.transport.pause_reading())
    await caller.put(caller.seal(b"last words") + caller.seal_end())
    await until(lambda: served.data)
    await turns(20)
    assert served.heard == ["made", "data"] and not served.transport.is_closing()
    served.transport.write(b"heard")
    served.transport.resume_reading()
    await served.ended()
    assert served.heard == ["made", "data", "eof", "lost"] and served.error is None
    assert await caller.hear_the_end() == b"heard"


@pytest.mark.parametrize("part", [0.0, 0.5])
async def test_a_connection_that_is_closed_without_goodbye(house: House, part):
    """At the end of a record or in its middle: whole records count, and are still answered."""
    caller, served = await house.join(echo)
    whole, record = caller.seal(b"whole"), caller.seal(b"half a record")
    await caller.put(whole + record[: int(part * len(record))])
    caller.sock.shutdown(socket.SHUT_WR)
    assert await caller.hear_the_end() == b"whole"
    await served.ended()
    assert served.heard == ["made", "data", "eof", "lost"]
    assert served.error is None


async def test_a_connection_that_is_reset(house: House):
    caller, served = await house.join()
    whole, record = caller.seal(b"whole"), caller.seal(b"half a record")
    await caller.put(whole + record[:10])
    await until(lambda: served.data)
    caller.reset()
    await served.ended()
    assert served.heard == ["made", "data", "lost"]
    assert isinstance(served.error, ConnectionError)
    served.transport.write(b"into the void")
    served.transport.close()
    served.transport.abort()


@pytest.mark.parametrize("kind", ["garbage", "flipped"])
@pytest.mark.parametrize("apart", [False, True], ids=["at once", "apart"])
async def test_a_broken_record_ends_the_connection(house: House, kind, apart):
    """With an alert, and after what came before it."""
    caller, served = await house.join()
    good, record = caller.seal(b"good"), caller.seal(b"bad")
    bad = b"GET / HTTP/1.1\r\n" if kind == "garbage" else record[:-1] + bytes([record[-1] ^ 1])
    if apart:
        await caller.put(good)
        await until(lambda: served.data)
        await caller.put(bad)
    else:
        await caller.put(good + bad)
    await served.ended()
    assert served.heard == ["made", "data", "lost"]
    assert served.data == b"good"
    assert isinstance(served.error, ssl.SSLError)
    with pytest.raises(ssl.SSLError, match=r"(?i)alert"):
        await caller.hear_the_end()


async def test_a_close_writes_out_what_waits(house: House):
    caller, served = await house.join(receive_buffer=8192)
    data = noise(4 * MIB)
    served.transport.write(data)
    assert served.transport.get_write_buffer_size() > 0
    served.transport.close()
    assert served.transport.is_closing() and not served.transport.is_reading()
    served.transport.write(b"too late")
    served.transport.close()
    served.transport.resume_reading()
    assert await caller.hear_the_end() == data
    await served.ended()
    assert served.error is None


@pytest.mark.parametrize("half", [False, True], ids=["open", "half"])
async def test_who_does_not_read_the_last_bytes_is_cut_off(house: House, monkeypatch, half):
    """Whether it was closed here or is at the end of its sending: it may not stay for ever."""
    monkeypatch.setattr(tls, "CLOSE_TIMEOUT", 0.1)
    caller, served = await house.join(receive_buffer=8192)
    served.transport.write(bytes(4 * MIB))
    if half:
        caller.sock.shutdown(socket.SHUT_WR)
    else:
        served.transport.close()
    await served.ended()


async def test_an_abort_drops_what_waits(house: House):
    caller, served = await house.join(receive_buffer=8192)
    served.transport.write(bytes(4 * MIB))
    served.transport.abort()
    served.transport.abort()
    assert served.transport.is_closing()
    await served.ended()
    served.transport.abort()
    served.transport.close()
    assert served.heard.count("lost") == 1
    with pytest.raises((EOFError, ConnectionError)):
        await caller.hear_the_end()


@pytest.mark.parametrize("end", ["close", "abort"])
async def test_the_protocol_ends_it_while_it_is_told_something(house: House, end):
    """Nothing more is handed on, not even the end that is in the same chunk."""
    caller, served = await house.join(lambda served, data: getattr(served.transport, end)())
    await caller.put(caller.seal(b"quit") + caller.seal_end())
    await until(lambda: served.data)
    caller.sock.close()
    await served.ended()
    assert served.data == b"quit"
    assert [word for word in served.heard if word not in {"made", "data"}] == ["lost"]


async def test_a_failing_write_ends_its_own_connection_only(house: House, monkeypatch):
    _, served = await house.join()

    class Broken:
        def write(self, data):
            raise ssl.SSLError(1, "the test says so")

    monkeypatch.setattr(served.transport, "_tls", Broken())
    served.transport.write(b"x")
    await served.ended()
    assert isinstance(served.error, ssl.SSLError)


ENDS = ["hung up", "never", "not TLS", "cancelled", "goodbye", "eof", "reset", "broken"]


@pytest.mark.parametrize("end", [*ENDS, "closed", "closed unread", "aborted"])
async def test_the_memory_of_a_connection_is_free_at_once(house: House, monkeypatch, end):
    """However it ends, not only when garbage is looked for, which may never find it."""
    both_ends: list[weakref.ref[object]] = []

    class Watched(TlsTransport):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            both_ends.append(weakref.ref(self))

    monkeypatch.setattr(tls, "TlsTransport", Watched)
    caller, accepted = await house.dial(receive_buffer=8192)

    async def serve(timeout: float) -> None:
        served = Served()
        both_ends.append(weakref.ref(served))
        with contextlib.suppress(OSError, asyncio.TimeoutError):
            await own(accepted, house.server, served, timeout)
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
        await turns()
        if end == "not TLS":
            await caller.put(b"GET / HTTP/1.1\r\n\r\n")
        elif end == "cancelled":
            serving.cancel()
        elif end != "hung up" and end != "never":
            await caller.shake_hands()
        if end == "goodbye":
            await caller.put(caller.seal_end())
        elif end == "eof":
            caller.sock.shutdown(socket.SHUT_WR)
        elif end == "broken":
            await caller.put(b"\x17\x03\x03\x00\x20" + bytes(32))
        elif end in {"hung up", "reset", "closed unread"}:
            await turns()
            caller.reset()
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
        process.stdin.write(command.encode() + b"\n")
        if command == "R":
            await served.ended()  # it does not want to stay without
            assert isinstance(served.error, ssl.SSLError)
        else:
            await asyncio.sleep(0.05)  # a command is one only when it comes alone
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


@settings(max_examples=25, deadline=None, suppress_health_check=[*HealthCheck])
@given(sizes=MESSAGES, cuts=CUTS, end=st.sampled_from(["notify", "half", "cut"]))
def test_the_same_as_asyncios_own_transport(server, client, sizes, cuts, end):
    """The same records in the same chunks: the same data and answers."""

    async def converse(accept: Any) -> tuple[bytes, bytes]:
        house = House(server, client)
        caller, served = await house.join(echo, accept=accept)
        sealed = b"".join(caller.seal(noise(size, n)) for n, size in enumerate(sizes) if size)
        if end == "cut":
            sealed = sealed[:-3]
        if end == "notify":
            sealed += caller.seal_end()

        async def speak() -> None:
            for chunk in chunks_of(sealed, cuts):
                await caller.put(chunk)
                await turns(2)
            if end != "notify":
                caller.sock.shutdown(socket.SHUT_WR)

        speaking = asyncio.ensure_future(speak())
        answer = await caller.hear(MIB, rude=True)  # asyncio is, to those who are
        await caller.hear_raw_end()
        await speaking
        await served.ended()
        await house.close()
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


@settings(max_examples=60, deadline=None, suppress_health_check=[*HealthCheck])
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
        transport = TlsTransport(served, server, Turns())
        transport.connection_made(network)  # type: ignore[arg-type]
        with socket.socket() as unused:
            caller = Caller(unused, client)
        while hello := caller.step():
            for chunk in chunks_of(hello, hello_cuts) if split else [hello]:
                transport.data_received(chunk)
            caller._incoming.write(bytes(network.sent))
            network.sent.clear()
        assert served.heard == ["made"]
        transport.write(b"")
        assert not network.sent
        records = [caller.seal(noise(size, n)) for n, size in enumerate(sizes) if size]
        sealed = bytearray(b"".join(records) + caller.seal_end())
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
