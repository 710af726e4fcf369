"""The network: TCP and TLS on the event loop, one `asyncio.Protocol` object a client."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import ssl
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import dataclass
from typing import TypeAlias, cast

from appliance.broker.broker import Broker
from appliance.broker.client import Client
from appliance.broker.ports import Exchange, Identity, Refusal
from appliance.mqtt.connection import State
from appliance.mqtt.packets import Connect
from appliance.mqtt.reason import ReasonCode

log = logging.getLogger(__name__)

#: Who sent this CONNECT, from this address, over this TLS connection, if it is one?
Authenticate: TypeAlias = Callable[
    [Connect, str, "ssl.SSLObject | None"], Awaitable["Identity | Refusal"]
]

#: Bytes that wait in a connection's output before its client counts as slow: what a healthy one
#: takes in one round of the event loop, with room to spare.
OUTPUT_HIGH_WATER = 1024 * 1024

#: A chunk this large means that more is waiting. The loop would read on without writing out, up to
#: 32 chunks in one go; reading is paused for the rest of the round, so that the receivers get
#: theirs before they count as slow.
LARGE_CHUNK = 128 * 1024

#: Connections that wait to be accepted, and that are accepted in one go.
BACKLOG = 1024

#: Seconds until connections are accepted again after the system refused one.
ACCEPT_PAUSE = 0.5

#: Seconds that a client gets to read the last bytes before its connection is cut.
CLOSE_TIMEOUT = 10.0

#: Seconds that clients get at the stop to read what was written to them.
STOP_TIMEOUT = 1.0

#: Seconds between two log lines about connections over the limit.
REFUSAL_LOG_INTERVAL = 10.0


@dataclass(frozen=True, slots=True)
class ListenerSettings:
    """Where a listener listens; `context` is None for plain TCP."""

    host: str
    port: int
    context: ssl.SSLContext | None


class Listeners:
    """All listening sockets, and the connections made to them."""

    def __init__(
        self,
        broker: Broker,
        authenticate: Authenticate,
        exchange: Callable[[str], Exchange | None],
        *,
        connections: int,
        connect_timeout: float,
    ) -> None:
        self.broker = broker
        self.authenticate = authenticate
        self.exchange = exchange
        self.connections = connections
        self.connect_timeout = connect_timeout
        self.open: set[ClientProtocol] = set()
        #: What runs in the background for a connection: TLS handshakes and logins.
        self.tasks: set[asyncio.Task[None]] = set()
        self._sockets: list[socket.socket] = []
        self._told_full_at = float("-inf")
        self._all_closed: asyncio.Event | None = None

    async def start(self, settings: list[ListenerSettings]) -> list[tuple[str, int]]:
        """Listen; returns the addresses, with the port that the system chose where it was 0.

        Raises:
            OSError: an address cannot be listened on; nothing is left listening.
        """
        addresses: list[tuple[str, int]] = []
        try:
            for listener in settings:
                sock = _listen(listener.host, listener.port)
                self._sockets.append(sock)
                addresses.append((listener.host, sock.getsockname()[1]))
                self._accept_from(sock, listener.context)
        except BaseException:
            await self.stop()
            raise
        return addresses

    def _accept_from(self, sock: socket.socket, context: ssl.SSLContext | None) -> None:
        """Accept what comes to the socket, until it is closed."""
        loop = asyncio.get_running_loop()

        def accept() -> None:
            for _ in range(BACKLOG):
                try:
                    connection, peer = sock.accept()
                except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                    return
                except OSError as error:
                    # Out of file descriptors, most likely: it passes, and asking on would spin.
                    log.error("no connection can be accepted: %s", error)
                    loop.remove_reader(sock)
                    loop.call_later(ACCEPT_PAUSE, resume)
                    return
                self._admit(connection, peer, context)

        def resume() -> None:
            if sock in self._sockets:
                loop.add_reader(sock, accept)

        resume()

    def _admit(
        self, connection: socket.socket, peer: tuple[str, int], context: ssl.SSLContext | None
    ) -> None:
        """Begin a new connection, or refuse it when there are as many as allowed."""
        self.broker.counters.sockets += 1
        address = f"[{peer[0]}]:{peer[1]}" if ":" in peer[0] else f"{peer[0]}:{peer[1]}"
        if len(self.open) < self.connections:
            protocol = ClientProtocol(self, address)
            self.open.add(protocol)
            self.in_background(protocol.begin(connection, context))
            return
        connection.close()
        now = asyncio.get_running_loop().time()
        if now - self._told_full_at >= REFUSAL_LOG_INTERVAL:
            self._told_full_at = now
            log.warning(
                "%s refused: %d connections are open, as many as allowed "
                "(broker.limits.connections)",
                address,
                self.connections,
            )

    def in_background(self, work: Coroutine[object, object, None]) -> None:
        """Run a connection's handshake or login beside everything else."""
        task = asyncio.get_running_loop().create_task(work)
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)

    async def stop(self) -> None:
        """Listen no more and close what is open; may be called twice."""
        loop = asyncio.get_running_loop()
        sockets, self._sockets = self._sockets, []
        for sock in sockets:
            loop.remove_reader(sock)
            sock.close()
        self.broker.close(
            lambda session: session.close_link(ReasonCode.SERVER_SHUTTING_DOWN, "shutting down")
        )
        for protocol in list(self.open):
            protocol.close()
        for task in list(self.tasks):
            task.cancel()
        if self.open:
            # Who reads gets the last bytes; who does not is not waited for longer than this.
            self._all_closed = asyncio.Event()
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._all_closed.wait(), STOP_TIMEOUT)
        for protocol in list(self.open):
            protocol.abort()

    def closed(self, protocol: ClientProtocol) -> None:
        """A connection ended."""
        self.open.discard(protocol)
        if not self.open and self._all_closed is not None:
            self._all_closed.set()


class ClientProtocol(asyncio.Protocol):
    """One connection: bytes to the `Client`, and as its `Wire` bytes from it."""

    def __init__(self, listeners: Listeners, address: str) -> None:
        self.address = address
        self._listeners = listeners
        self._broker = listeners.broker
        self._transport: asyncio.Transport | None = None
        self._loop = asyncio.get_running_loop()
        self._client = Client(self._broker, self)
        #: Bytes in the output from which on the client is not listened to.
        self._output_limit = 0
        self._choked = False
        # Slow strangers: the whole way to the end of CONNECT has one time limit.
        self._timeout = self._loop.call_later(listeners.connect_timeout, self._too_late)

    # --- the connection ------------------------------------------------------------------------

    async def begin(self, connection: socket.socket, context: ssl.SSLContext | None) -> None:
        """Take over an accepted connection, with TLS through its handshake."""
        # Not left to asyncio's own server for one reason: when a handshake fails, that would
        # say nothing, and who it was and why is what the log is asked for.
        timeout = self._listeners.connect_timeout if context else None
        try:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            # A client without keep alive whose computer is gone is found out by the system.
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            await self._loop.connect_accepted_socket(
                lambda: self, connection, ssl=context, ssl_handshake_timeout=timeout
            )
        except (OSError, asyncio.TimeoutError) as error:
            log.warning("%s: no TLS connection: %s", self.address, _tls_reason(error))
            connection.close()
            self._forget()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The connection is there, its TLS handshake done."""
        self._transport = cast(asyncio.Transport, transport)
        self._transport.set_write_buffer_limits(high=OUTPUT_HIGH_WATER)
        if self not in self._listeners.open:  # the handshake ended just after its time
            self._transport.abort()

    def _too_late(self) -> None:
        log.warning(
            "%s: no complete CONNECT within %g s (broker.limits.connect_timeout)",
            self.address,
            self._listeners.connect_timeout,
        )
        self.abort()

    def data_received(self, data: bytes) -> None:
        """Hand the chunk to the client; then everyone is written to, once, what it caused."""
        broker = self._broker
        broker.ledger.now = self._loop.time()
        self._client.receive(data)
        if broker.unflushed:
            broker.flush()
        if len(data) >= LARGE_CHUNK:
            self._pause_reading()
            self._loop.call_soon(self._read_on)
        if not self._client.writable and self._output_size() > self._output_limit:
            # It asks on, and does not read the answers.
            self._choked = True
            self._pause_reading()

    def _output_size(self) -> int:
        transport = self._transport
        return 0 if transport is None else transport.get_write_buffer_size()

    def _pause_reading(self) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.pause_reading()

    def _read_on(self) -> None:
        if self._choked or self._client.connection.state is State.AUTHENTICATING:
            return
        if self._transport is not None and not self._transport.is_closing():
            self._transport.resume_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection ended, whoever ended it."""
        self._forget()
        self._broker.ledger.now = self._loop.time()
        self._client.lost()
        self._broker.flush()

    def pause_writing(self) -> None:
        """The client reads slower than it is written to."""
        self._client.writable = False
        # From here on its output grows by what it is answered only, and by no more than this.
        self._output_limit = self._output_size() + OUTPUT_HIGH_WATER

    def resume_writing(self) -> None:
        """It has caught up."""
        if self._transport is not None and not self._transport.is_closing():
            self._choked = False
            self._client.resume_writing()
            self._broker.flush()
            self._read_on()

    def _forget(self) -> None:
        self._listeners.closed(self)
        self._timeout.cancel()

    def abort(self) -> None:
        """Close at once."""
        # asyncio's own TLS transport, up to Python 3.11.2, cannot be aborted twice.
        if self._transport is not None:
            with contextlib.suppress(AttributeError):
                self._transport.abort()
        self._forget()

    # --- the client's Wire ---------------------------------------------------------------------

    def authenticate(self, connect: Connect) -> None:
        """Find out in the background who sent the CONNECT; read nothing more until then."""
        self._pause_reading()
        self._listeners.in_background(self._log_in(connect))

    async def _log_in(self, connect: Connect) -> None:
        tls = self._transport.get_extra_info("ssl_object") if self._transport else None
        who = await self._listeners.authenticate(connect, self.address, tls)
        if isinstance(who, Refusal):
            self._client.refuse(who.code, who.reason)
        else:
            self._client.accept(who.username)
        self._broker.flush()
        self._read_on()

    def exchange(self, method: str) -> Exchange | None:
        """Begin an enhanced authentication; None when the method is not offered."""
        return self._listeners.exchange(method)

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
        """Write the chunks, joined when small."""
        data = chunks[0] if len(chunks) == 1 else b"".join(chunks)
        self._broker.counters.bytes_sent += len(data)
        if self._transport is not None:
            self._transport.write(data)

    def close(self) -> None:
        """Write out what waits, then close."""
        if self._transport is not None:
            self._transport.close()
            self._timeout.cancel()
            self._timeout = self._loop.call_later(CLOSE_TIMEOUT, self._transport.abort)


def _listen(host: str, port: int) -> socket.socket:
    """A listening socket; an empty host is every address, IPv6 ones too where there are any."""
    everywhere = not host
    dualstack = everywhere and socket.has_dualstack_ipv6()
    family = socket.AF_INET6 if ":" in host or dualstack else socket.AF_INET
    try:
        sock = socket.create_server(
            (host, port), family=family, backlog=BACKLOG, dualstack_ipv6=dualstack
        )
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(
            error.errno, f"cannot listen on {host or '*'}:{port} (broker.listeners): {reason}"
        ) from None
    sock.setblocking(False)
    return sock


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
