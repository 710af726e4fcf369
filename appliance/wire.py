"""One network connection: an `asyncio.Protocol` that is a client's `Wire`."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import ssl
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine
from typing import TypeAlias, cast

from appliance.broker.broker import Broker
from appliance.broker.client import Client
from appliance.broker.ports import Exchange, Identity, Refusal
from appliance.mqtt.connection import MAXIMUM_CONTROL
from appliance.mqtt.packets import Connect
from appliance.websocket import WebSocket

#: Who sent this CONNECT, from this address, over this TLS connection, if it is one?
Authenticate: TypeAlias = Callable[
    [Connect, str, "ssl.SSLObject | None"], Awaitable["Identity | Refusal"]
]

#: Bytes that wait for a client from which on it counts as slow, and is sent no more until it has
#: read most of them: what a healthy one takes in one round of the event loop, with room to spare.
OUTPUT_HIGH_WATER = 1024 * 1024

#: The same while the output of all clients takes more than a quarter of `limits.memory`. Less than
#: this in a transport is not counted, so that writing costs nothing as long as clients read.
OUTPUT_LOW_WATER = 16 * 1024

#: Bytes that a transport is given in one go: of a large message it holds a part, not a copy.
WRITE_PORTION = 128 * 1024

#: Bytes that a TLS transport has handed to the connection under it before it begins to keep any.
TLS_BUFFER = 64 * 1024

#: Seconds that one client's bytes are worked on before others have their turn, and the bytes that
#: are never cut into smaller portions for it.
TURN = 0.001
SMALL_CHUNK = 4096

#: And the largest portion: of small messages, so many bytes may be some hundred milliseconds.
LARGEST_PORTION = 256 * 1024

#: A chunk this large means that more is waiting. The loop would read on without writing out, up to
#: 32 chunks in one go; reading is paused for the rest of the round, so that the receivers get
#: theirs before they count as slow.
LARGE_CHUNK = 128 * 1024

#: Seconds that a client may publish ahead of `limits.publish_rate`.
PUBLISH_BURST = 1.0

#: Seconds that a publisher is not read after each chunk while memory is short.
SHORT_OF_MEMORY_PAUSE = 0.05

#: Seconds that a client is slow before the log is told.
SLOW_AFTER = 1.0

#: Seconds that a client gets to read the last bytes before its connection is cut.
CLOSE_TIMEOUT = 10.0

#: Seconds that a closed connection is listened to, the bytes that may come, and how many
#: connections this is done for at a time.
FAREWELL_TIMEOUT = 2.0
FAREWELL_BYTES = 64 * 1024 * 1024
FAREWELLS = 256


class Network:
    """All connections, and what they share; `ended` is told of each that ends, once.

    `connect_timeout` is in seconds, `publish_rate` in messages a second from one client.
    """

    def __init__(
        self,
        broker: Broker,
        authenticate: Authenticate,
        exchange: Callable[[str], Exchange | None],
        ended: Callable[[ClientProtocol], None],
        *,
        connect_timeout: float,
        publish_rate: float,
    ) -> None:
        self.broker = broker
        self.authenticate = authenticate
        self.exchange = exchange
        self.connect_timeout = connect_timeout
        #: Seconds of a client's time that a message takes.
        self.publish_interval = 1 / publish_rate
        #: Bytes in which there are not more messages than may come at once; the smallest has five.
        self.largest_portion = int(min(max(5 * PUBLISH_BURST * publish_rate, 256), LARGEST_PORTION))
        #: `Ledger.queued_bytes` from which on publishers are slowed.
        self.short_of_memory = broker.limits.memory * 3 // 4
        self.open: set[ClientProtocol] = set()
        #: What runs in the background for a connection: TLS handshakes and logins.
        self.tasks: set[asyncio.Task[None]] = set()
        #: Bytes in the output of all clients, as far as they are counted.
        self.output = 0
        self._ended = ended
        self._farewells: set[_Farewell] = set()
        self._all_closed: asyncio.Event | None = None

    def in_background(self, work: Coroutine[object, object, None]) -> None:
        """Run a connection's handshake or login beside everything else."""
        task = asyncio.get_running_loop().create_task(work)
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)

    def closed(self, protocol: ClientProtocol) -> None:
        """A connection ended."""
        if protocol in self.open:
            self.open.discard(protocol)
            self._ended(protocol)
        self._tell_when_all_closed()

    def part(self, connection: socket.socket) -> None:
        """Close a connection whose last bytes are on their way, see `_Farewell`."""
        if len(self._farewells) < FAREWELLS:
            farewell = _Farewell(connection, self._parted)
            self._farewells.add(farewell)
            farewell.listen()
        else:
            connection.close()

    def _parted(self, farewell: _Farewell) -> None:
        self._farewells.discard(farewell)
        self._tell_when_all_closed()

    def _tell_when_all_closed(self) -> None:
        if self._all_closed is not None and not self.open and not self._farewells:
            self._all_closed.set()

    async def close(self, timeout: float) -> None:
        """Close everything; who does not read the last bytes in so many seconds is cut off."""
        for protocol in list(self.open):
            protocol.close()
        for task in list(self.tasks):
            task.cancel()
        if self.open or self._farewells:
            self._all_closed = asyncio.Event()
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._all_closed.wait(), timeout)
        for protocol in list(self.open):
            protocol.abort()
        for farewell in list(self._farewells):
            farewell.end()


class ClientProtocol(asyncio.Protocol):
    """One connection: bytes to the `Client`, and as its `Wire` bytes from it."""

    def __init__(self, network: Network, address: str, host: str) -> None:
        self.address = address
        #: The part of it that all connections of one computer share; empty for a Unix socket.
        self.host = host
        self._network = network
        self._broker = network.broker
        self._transport: asyncio.Transport | None = None
        self._loop = asyncio.get_running_loop()
        self._client = Client(self._broker, self)
        self._closing = False
        # Input: what was received and waits for its turn, and why it does.
        self._held = memoryview(b"")
        self._portion = min(4 * SMALL_CHUNK, network.largest_portion)
        self._published_until = 0.0  # what it published is paid for, at the rate allowed
        self._turn_comes = False
        self._resting = False
        self._choked = False
        self._logging_in = False
        # Output: the chunks that the transport was not given yet.
        self._waiting: deque[bytes | memoryview] = deque()
        self._waiting_size = 0
        self._paused = False
        self._hidden = 0  # bytes in a transport that asks for a pause, beside those that it tells
        self._counted = 0  # of its bytes in the ledger
        self._slow: asyncio.TimerHandle | None = None
        #: Bytes in the output from which on the client is not listened to.
        self._output_limit = 0
        #: The connection under the transport, to be closed after it.
        self._connection: socket.socket | None = None
        # Slow strangers: the whole way to the end of CONNECT has one time limit.
        self._timeout = self._loop.call_later(network.connect_timeout, self._too_late)

    # --- the connection ------------------------------------------------------------------------

    async def begin(
        self, connection: socket.socket, context: ssl.SSLContext | None, *, websocket: bool
    ) -> None:
        """Take over an accepted connection, with TLS through its handshake."""
        # Not left to asyncio's own server for one reason: when a handshake fails, that would
        # say nothing, and who it was and why is what the log is asked for.
        timeout = self._network.connect_timeout if context else None
        protocol: asyncio.Protocol = self
        if websocket:
            protocol = WebSocket(self, self._frame_limit, self._complain)
        try:
            if connection.family != socket.AF_UNIX:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                # A client without keep alive whose computer is gone is found out by the system.
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            await self._loop.connect_accepted_socket(
                lambda: protocol, connection, ssl=context, ssl_handshake_timeout=timeout
            )
        except (OSError, asyncio.TimeoutError) as error:
            self._complain(f"no {'TLS ' if context else ''}connection", _tls_reason(error))
            connection.close()
            self._forget()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The connection is there, its TLS handshake done."""
        self._transport = cast(asyncio.Transport, transport)
        self._transport.set_write_buffer_limits(high=OUTPUT_LOW_WATER)
        if transport.get_extra_info("ssl_object") is not None:
            self._hidden = TLS_BUFFER
        if self not in self._network.open:  # the handshake ended just after its time
            self._transport.abort()

    def _too_late(self) -> None:
        timeout = f"{self._network.connect_timeout:g} s"
        self._complain(f"no complete CONNECT within {timeout}", "broker.limits.connect_timeout")
        self.abort()

    def _complain(self, what: str, why: str) -> None:
        """Tell the log, unless it is a flood of the same from the same host."""
        now = self._loop.time()
        message = f"{self.address}: {what}: {why:.200}"
        self._broker.complaints.tell(now, (self.host, what), "%s", message)

    def _frame_limit(self) -> int:
        """The largest WebSocket frame, in bytes: a stranger's is not kept beyond a CONNECT."""
        if self._client.session is None:
            return MAXIMUM_CONTROL
        return self._broker.limits.packet_size + MAXIMUM_CONTROL

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection ended, whoever ended it."""
        self._forget()
        self._waiting.clear()
        self._waiting_size = 0
        self._paused = False
        self._count_output()
        if self._slow is not None:
            self._slow.cancel()
        self._broker.ledger.now = self._loop.time()
        if not self._closing:
            self._closing = True
            self._client.receive(bytes(self._held))  # what it said before it left
        self._client.lost()
        self._broker.flush()
        if self._connection is not None:
            self._network.part(self._connection)

    def _forget(self) -> None:
        self._network.closed(self)
        self._timeout.cancel()

    def abort(self) -> None:
        """Close at once."""
        # asyncio's own TLS transport, up to Python 3.11.2, cannot be aborted twice.
        if self._transport is not None:
            with contextlib.suppress(AttributeError):
                self._transport.abort()
        self._forget()

    # --- bytes in ------------------------------------------------------------------------------

    def data_received(self, data: bytes) -> None:
        """Hand the chunk to the client; then everyone is written to, once, what it caused."""
        if len(data) > self._portion:
            data = self._hold(data)
        broker = self._broker
        counters = broker.counters
        broker.ledger.now = now = self._loop.time()
        published = counters.publish_received
        self._client.receive(data)
        published = counters.publish_received - published
        if broker.unflushed:
            broker.flush()
        if published:
            # A client has as much time as there is; each message takes some of it.
            until = self._published_until
            until = (until if until > now else now) + published * self._network.publish_interval
            self._published_until = until
            if until > now + PUBLISH_BURST:
                self._rest(until - now - PUBLISH_BURST)
            elif broker.ledger.queued_bytes > self._network.short_of_memory:
                self._wait_for_memory()
        if len(data) > SMALL_CHUNK:
            self._size_portions(len(data), self._loop.time() - now)
        if not self._client.writable and self._output_size() > self._output_limit:
            # It asks on, and does not read the answers.
            self._choked = True
            self._pause_reading()

    def _hold(self, data: bytes) -> bytes:
        """Keep what is more than a portion for later; returns the portion."""
        chunk = memoryview(data)
        self._held = chunk[self._portion :]
        self._read_later()
        return bytes(chunk[: self._portion])

    def _size_portions(self, size: int, took: float) -> None:
        """Let the next portions be as large as is done in one turn; the last one took so long."""
        if took > TURN:
            self._portion = min(self._portion, max(SMALL_CHUNK, int(size * TURN / took)))
        elif size >= self._portion and took < TURN / 2:
            self._portion = min(2 * self._portion, self._network.largest_portion)
        if size >= LARGE_CHUNK:
            self._read_later()

    def _rest(self, seconds: float) -> None:
        """Read nothing for so long."""
        self._resting = True
        self._pause_reading()
        self._loop.call_later(seconds, self._rested)

    def _rested(self) -> None:
        self._resting = False
        self._read_on()

    def _wait_for_memory(self) -> None:
        # Not for longer: it may be this client that has to acknowledge what takes the memory.
        self._rest(SHORT_OF_MEMORY_PAUSE)
        ledger = self._broker.ledger
        self._broker.complaints.tell(
            ledger.now,
            "memory",
            "%s is slowed: %d bytes wait for clients, of the %d allowed (broker.limits.memory)",
            self._client,
            ledger.queued_bytes,
            ledger.memory,
        )

    def _read_later(self) -> None:
        """Let the others have their turn, then read on."""
        self._pause_reading()
        if not self._turn_comes:
            self._turn_comes = True
            self._loop.call_soon(self._read_on)

    def _pause_reading(self) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.pause_reading()

    def _read_on(self) -> None:
        self._turn_comes = False
        if self._choked or self._resting or self._logging_in or self._closing:
            return
        if self._transport is None or self._transport.is_closing():
            return
        if self._held:
            portion = bytes(self._held[: self._portion])
            self._held = self._held[self._portion :]
            self.data_received(portion)
            self._read_later()
        else:
            self._transport.resume_reading()

    # --- bytes out -----------------------------------------------------------------------------

    def _write_on(self) -> None:
        """Give the transport what waits, until it asks for a pause."""
        waiting = self._waiting
        assert self._transport is not None
        while waiting and not self._paused and not self._transport.is_closing():
            portion: list[bytes | memoryview] = []
            room = WRITE_PORTION
            while waiting and room:
                chunk = waiting.popleft()
                if len(chunk) > room:
                    view = memoryview(chunk)
                    waiting.appendleft(view[room:])
                    chunk = view[:room]
                portion.append(chunk)
                room -= len(chunk)
            self._waiting_size -= WRITE_PORTION - room
            self._transport.write(portion[0] if len(portion) == 1 else b"".join(portion))
        self._count_output()
        if self._closing and not waiting:
            self._close_transport()

    def _output_size(self) -> int:
        transport = self._transport
        return self._waiting_size + (0 if transport is None else transport.get_write_buffer_size())

    def _count_output(self) -> None:
        """Enter in the ledger what waits for this client, and tell it when that is too much."""
        size = self._waiting_size
        if self._paused and self._transport is not None:
            size += self._transport.get_write_buffer_size() + self._hidden
        network = self._network
        ledger = self._broker.ledger
        ledger.queued_bytes += size - self._counted
        network.output += size - self._counted
        self._counted = size
        plenty = network.output <= ledger.memory // 4
        limit = OUTPUT_HIGH_WATER if plenty else OUTPUT_LOW_WATER
        if size > limit and self._slow is None:
            self._client.writable = False
            # From here on its output grows by what it is answered only, and by no more than this.
            self._output_limit = size + limit
            self._slow = self._loop.call_later(SLOW_AFTER, self._tell_slow)

    def _tell_slow(self) -> None:
        self._broker.complaints.tell(
            self._loop.time(),
            "slow",
            "%s is slow: it does not read %d bytes, and is sent nothing more until it does",
            self._client,
            self._counted,
        )

    def pause_writing(self) -> None:
        """The client reads slower than it is written to."""
        self._paused = True
        self._count_output()

    def resume_writing(self) -> None:
        """It has caught up."""
        self._paused = False
        if self._transport is None:
            return
        self._write_on()
        if self._slow is None or self._paused or self._closing:
            return
        self._slow.cancel()
        self._slow = None
        self._choked = False
        self._client.resume_writing()
        self._broker.flush()
        self._read_on()

    # --- the client's Wire ---------------------------------------------------------------------

    def authenticate(self, connect: Connect) -> None:
        """Find out in the background who sent the CONNECT; read nothing more until then."""
        self._logging_in = True
        self._pause_reading()
        self._network.in_background(self._log_in(connect))

    async def _log_in(self, connect: Connect) -> None:
        tls = self._transport.get_extra_info("ssl_object") if self._transport else None
        who = await self._network.authenticate(connect, self.address, tls)
        self._logging_in = False
        if isinstance(who, Refusal):
            self._client.refuse(who.code, who.reason)
        else:
            self._client.accept(who.username)
        self._broker.flush()
        self._read_on()

    def exchange(self, method: str) -> Exchange | None:
        """Begin an enhanced authentication; None when the method is not offered."""
        return self._network.exchange(method)

    def accepted(self) -> None:
        """The client has logged in, and may be silent now."""
        self._timeout.cancel()

    def later(self) -> None:
        """Let the others have their turn, then send on."""
        self._loop.call_soon(self._send_on)

    def _send_on(self) -> None:
        self._broker.ledger.now = self._loop.time()
        self._client.send_on()
        self._broker.flush()

    def write(self, chunks: list[bytes]) -> None:
        """Write the chunks: joined when small; else, and to who is slow, in portions."""
        if self._paused or len(chunks[-1]) > WRITE_PORTION:
            self._write_later(chunks)
            return
        data = chunks[0] if len(chunks) == 1 else b"".join(chunks)
        if len(data) > WRITE_PORTION:
            self._write_later(chunks)
            return
        self._broker.counters.bytes_sent += len(data)
        if self._transport is not None:
            self._transport.write(data)

    def _write_later(self, chunks: list[bytes]) -> None:
        # Kept as they are, not joined: the payload in them is the same object for all receivers.
        size = sum(map(len, chunks))
        self._broker.counters.bytes_sent += size
        if self._transport is not None and not self._transport.is_closing():
            self._waiting += chunks
            self._waiting_size += size
            self._write_on()

    def close(self) -> None:
        """Write out what waits, then close."""
        if self._transport is None or self._closing:
            return
        self._closing = True
        self._timeout.cancel()
        self._timeout = self._loop.call_later(CLOSE_TIMEOUT, self._transport.abort)
        if self._waiting:
            self._pause_reading()
        else:
            self._close_transport()

    def _close_transport(self) -> None:
        assert self._transport is not None
        if self._connection is None and not self._transport.is_closing():
            # A transport closes its socket as soon as it has written: of that only a copy is left.
            with contextlib.suppress(OSError):
                file = os.dup(self._transport.get_extra_info("socket").fileno())
                self._connection = socket.socket(fileno=file)
                self._connection.setblocking(False)
        self._transport.close()


class _Farewell:
    """A connection after its last byte was written, until the other side has closed it as well.

    To close a socket that has unread input is to reset the connection, and that may take from the
    other side what it has not read yet: the reason why it was disconnected. So this side says that
    nothing more will come, and what still comes in is thrown away, for a while.
    """

    def __init__(self, connection: socket.socket, ended: Callable[[_Farewell], None]) -> None:
        self._socket = connection
        self._ended = ended
        self._left = FAREWELL_BYTES
        self._loop = asyncio.get_running_loop()
        self._timeout = self._loop.call_later(FAREWELL_TIMEOUT, self.end)

    def listen(self) -> None:
        """Begin; it ends by itself."""
        try:
            self._socket.shutdown(socket.SHUT_WR)
            self._loop.add_reader(self._socket, self._discard)
        except OSError:  # the other side was quicker
            self.end()

    def _discard(self) -> None:
        try:
            size = self._socket.recv_into(_SCRATCH)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            size = 0
        self._left -= size
        if not size or self._left < 0:
            self.end()

    def end(self) -> None:
        """Close it; may be called twice."""
        self._timeout.cancel()
        if self._socket.fileno() >= 0:
            self._loop.remove_reader(self._socket)
            self._socket.close()
        self._ended(self)


_SCRATCH = bytearray(256 * 1024)


def _tls_reason(error: BaseException) -> str:
    """What went wrong in a handshake, in words for the person who reads the log."""
    reason = getattr(error, "reason", None) or str(error) or type(error).__name__
    text = str(reason).replace("_", " ").lower()
    if "unknown ca" in text or "bad certificate" in text or "certificate unknown" in text:
        return f"the client does not trust our certificate; does it have ca.crt? ({text})"
    if "http request" in text or "wrong version number" in text:
        return f"what it sent is not TLS; is it meant for the plain listener? ({text})"
    if "peer did not return a certificate" in text:
        return f"it has no client certificate, and one is required ({text})"
    return text
