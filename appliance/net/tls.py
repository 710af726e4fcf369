"""TLS for accepted connections, optimised for many connections with small messages; and for those
that the appliance makes itself.

asyncio and uvloop have TLS transports of their own. After each record they try to read another one,
which ends in an exception and costs as much as the record itself, and they have a read buffer for
each connection. Here an idle connection takes half the memory, and a message less CPU time.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import ssl
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, TypeAlias, cast

from async_timeout import timeout

from appliance.net.callbacks import FaultHandler, contained, contained_made
from appliance.net.layers import LayerScheduler, UpperLayer

Data: TypeAlias = "bytes | bytearray | memoryview"

#: The most bytes of plaintext in a record (RFC 8446, section 5.1): a read of this size never leaves
#: a part of a record behind.
RECORD_SIZE: Final = 16 * 1024

#: Bytes that OpenSSL is handed at once. Its buffers never shrink: those of each connection would
#: keep the size of its largest message.
PIECE: Final = 2 * RECORD_SIZE

#: Records of one connection that are read in a turn: a chunk may hold ten thousand of a byte each.
#: And the cost of a record, where a chunk has many.
RECORDS_A_TURN = 256
RECORD_COST = 1

#: A chunk of at most this many bytes is small, and may be read although others wait for a turn.
SMALL_CHUNK: Final = 4096

#: Seconds that a client has to read the last bytes before its connection is aborted.
CLOSE_TIMEOUT = 10.0

#: What `get_extra_info` returns beside what the TCP transport knows.
_TLS_INFO: dict[str, Callable[[ssl.SSLObject], object]] = {
    "ssl_object": lambda tls: tls,
    "sslcontext": lambda tls: tls.context,
    "peercert": lambda tls: tls.getpeercert(),
    "cipher": lambda tls: tls.cipher(),
    "compression": lambda tls: tls.compression(),
}

_NOTHING: Final = memoryview(b"")

#: The protocol of a connection that has ended.
_NOBODY: Final = asyncio.Protocol()


async def accept(
    connection: socket.socket,
    context: ssl.SSLContext,
    protocol: asyncio.Protocol,
    timeout: float,
    scheduler: LayerScheduler,
    linger: Callable[[socket.socket], None] = socket.socket.close,
) -> None:
    """Perform the server's handshake on an accepted connection and hand it to the protocol.

    Many records in one chunk are read in several turns, which `scheduler` gives.

    When this fails the connection is closed, and the protocol was not called. `linger` closes a
    socket on which an alert was written, so that it arrives: in TLS 1.3 the client may be sending
    already.

    Raises:
        asyncio.TimeoutError: no handshake within `timeout` seconds.
        ssl.SSLError: one side does not accept what the other has sent.
        OSError: the client is gone.
    """
    error = await TlsTransport(protocol, context, scheduler, linger).shake_hands(
        connection, timeout
    )
    if error is not None:
        try:
            raise error
        finally:
            # The exception refers to the frames that it has passed. A frame that refers to it would
            # be a cycle, which only the garbage collector frees; hence `with_traceback(None)`
            # below.
            del error


async def connect(
    connection: socket.socket,
    context: ssl.SSLContext,
    protocol: asyncio.Protocol,
    timeout: float,
    scheduler: LayerScheduler,
    server_name: str,
) -> None:
    """Perform the client's handshake on a connection that was made, as `accept` does the server's.

    `server_name` is whom the server's certificate has to be for; a name, not an IP address, is sent
    to it as well (SNI, RFC 6066, section 3).

    Raises:
        As `accept`.
    """
    transport = TlsTransport(protocol, context, scheduler, socket.socket.close, server_name)
    error = await transport.shake_hands(connection, timeout)
    if error is not None:
        try:
            raise error
        finally:
            del error  # as above


class TlsTransport:
    """A TLS connection: a protocol for its TCP connection, a transport for the protocol above.

    It is the server's side, or with a `server_name` the client's.

    The plaintext of one chunk is handed on in one chunk, unless it has too many records, and before
    the end of the connection, or a broken record behind it, takes effect. As in asyncio, there are
    no half-closed connections.

    It is not derived from `asyncio.Transport` and `asyncio.Protocol`, which makes it faster when
    compiled.
    """

    def __init__(
        self,
        protocol: asyncio.Protocol,
        context: ssl.SSLContext,
        scheduler: LayerScheduler,
        linger: Callable[[socket.socket], None] = socket.socket.close,
        server_name: str | None = None,
    ) -> None:
        self._entries = scheduler.entries
        self._loop = self._entries.loop
        #: Done when the handshake has ended; its result is why that failed, if it did.
        self._handshake: asyncio.Future[Exception | None] = self._loop.create_future()
        self._protocol = protocol
        self._linger = linger
        #: A copy of the socket, when an alert is the last that was written to it.
        self._connection: socket.socket | None = None
        self._scheduler = scheduler
        #: What OpenSSL was not given yet, and whether there or in OpenSSL is more to read.
        self._rest = _NOTHING
        self._buffered = 0  # its bytes, as reported to the protocol
        self._waits = False
        self._queued = False
        self._incoming = ssl.MemoryBIO()
        self._outgoing = ssl.MemoryBIO()
        self._is_client = server_name is not None
        self._tls = context.wrap_bio(
            self._incoming,
            self._outgoing,
            server_side=not self._is_client,
            server_hostname=server_name,
        )
        self._tcp: asyncio.Transport
        self._connected = False  # `connection_made` was called
        self._open = False  # connected, and not closing
        self._reading = True
        self._writable = True
        self._ended = False  # no record follows
        self._hung_up = False  # the client has closed the TCP connection
        self._cut = True  # OpenSSL may buffer the beginning of a record
        self._has_told_cut = False
        self._error: Exception | None = None
        self._deadline: asyncio.TimerHandle | None = None

    async def shake_hands(self, connection: socket.socket, patience: float) -> Exception | None:
        """Perform the handshake; returns why that failed, if it did, see `accept`."""
        protocol = cast(asyncio.Protocol, self)
        await self._loop.connect_accepted_socket(lambda: protocol, connection)
        try:
            async with timeout(patience):
                return await self._handshake
        except asyncio.TimeoutError:
            self.abort()
            return asyncio.TimeoutError(f"no handshake within {patience:g} s")
        except BaseException:
            self.abort()
            raise

    # --- the protocol of the TCP connection ----------------------------------------------------

    def fault(self, entry: str, error: Exception) -> None:
        """End this connection because an unexpected exception escaped while it was served."""
        if self._connected and self._protocol is not _NOBODY:
            cast(FaultHandler, self._protocol).fault(entry, error)
            return
        self._entries.faults.caught(entry, error)
        if not self._handshake.done():
            self._handshake.set_result(ConnectionAbortedError("a fault in the appliance"))
        if hasattr(self, "_tcp"):  # else `contained_made` aborts it
            self.abort()

    @contained_made("tls.made")
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The TCP connection is there; in TLS the client speaks first."""
        self._tcp = cast(asyncio.Transport, transport)
        if self._is_client:
            with contextlib.suppress(ssl.SSLWantReadError):
                self._tls.do_handshake()
            self._flush()

    def data_received(self, data: bytes) -> None:
        """Decrypt a chunk and hand it on, now or in a turn."""
        try:
            if not self._open:
                if not self._connected:
                    self._handshake_received(data)
            elif self._waits or self._scheduler.must_wait(
                cast(UpperLayer, self._protocol), is_small=len(data) <= SMALL_CHUNK
            ):
                self._rest = memoryview(bytes(self._rest) + data if self._rest else data)
                self._count_rest()
                self._wait()
            else:
                self._take(data)
        except Exception as error:
            self.fault("tls.chunk", error)

    def _take(self, data: Data) -> None:
        """Decrypt the records in the data and in OpenSSL's buffer, and hand them on."""
        parts: list[bytes] = []
        if len(data) <= PIECE:
            self._incoming.write(data)
            self._read(parts)
        else:
            view = memoryview(data)
            while view and not (self._waits or self._ended):
                self._incoming.write(view[:PIECE])
                view = view[PIECE:]
                self._read(parts)
            self._rest = view or _NOTHING  # an empty slice would keep the whole chunk alive
        if self._rest or self._buffered:
            self._count_rest()
        if len(parts) > 1:
            self._scheduler.count_cost(RECORD_COST * len(parts), cast(UpperLayer, self._protocol))
        if parts:
            self._protocol.data_received(parts[0] if len(parts) == 1 else b"".join(parts))
        if self._cut or self._has_told_cut:  # each time: what arrived may have completed it
            self._has_told_cut = self._cut
            cast(UpperLayer, self._protocol).partial_record(self._cut)
        if self._waits and not self._ended:
            self._wait()
        elif self._ended or self._outgoing.pending:
            self._react()

    def _read(self, parts: list[bytes]) -> None:
        """Append the plaintext of complete records. Sets `_ended` when no more can follow, `_waits`
        when these are enough for one turn."""
        try:
            # Not larger than needed: Python allocates a buffer of this size beforehand.
            size = RECORD_SIZE if self._cut else self._incoming.pending
            while part := self._tls.read(size):
                parts.append(part)
                if not self._incoming.pending:  # another read would only raise
                    self._cut = False
                    return
                if len(parts) >= RECORDS_A_TURN:
                    self._waits = True
                    return
            self._ended = True  # by a close_notify
        except ssl.SSLWantReadError:
            self._cut = True
        except ssl.SSLError as error:
            self._ended = True
            self._error = error.with_traceback(None)

    def _count_rest(self) -> None:
        """Report the memory of what OpenSSL was not given: of a chunk, all of it."""
        size = len(cast(bytes, self._rest.obj))
        if size != self._buffered:
            self._buffered = size
            cast(UpperLayer, self._protocol).count_buffered(size)

    def _wait(self) -> None:
        """Read nothing more until the next turn."""
        self._waits = True
        if not self._open:
            return
        self._tcp.pause_reading()
        cast(UpperLayer, self._protocol).input_paused()
        if self._reading and not self._queued:
            self._queued = True
            self._scheduler.queue_turn(self)

    def take_turn(self) -> None:
        """Continue: the others have had their turn."""
        self._queued = False
        if not (self._open and self._reading):
            return
        rest, self._rest = self._rest, _NOTHING
        self._waits = False
        self._take(rest)
        if self._waits or not self._open:
            return
        if self._hung_up:
            self._ended = True
            self._react()
        elif self._reading:
            cast(UpperLayer, self._protocol).input_resumed()
            self._tcp.resume_reading()

    def _react(self) -> None:
        """Send what reading has caused, such as an alert; close a connection that has ended."""
        if not self._open:
            return
        if not self._writable and self._outgoing.pending:
            # A client that makes OpenSSL answer again and again must read the answers.
            self.abort()
            return
        if not self._ended:
            self._flush()
            return
        if self._error is None:
            if not self._reading:  # data before the end is still being processed
                return
            self._protocol.eof_received()
        self.close()

    def _handshake_received(self, data: bytes) -> None:
        for start in range(0, len(data), PIECE):
            self._incoming.write(data[start : start + PIECE])
            try:
                self._tls.do_handshake()
            except ssl.SSLWantReadError:
                continue
            except ssl.SSLError as error:
                self._flush()  # the alert, which gives the client the reason
                self._connection = _copy(self._tcp)
                self._tcp.close()
                if not self._handshake.done():
                    self._handshake.set_result(error.with_traceback(None))
                return
            self._flush()
            self._connected = self._open = True
            if not self._handshake.done():
                self._handshake.set_result(None)
            self._protocol.connection_made(cast(asyncio.Transport, self))
            rest = data[start + PIECE :]
            if rest or self._incoming.pending:
                self.data_received(rest)
            return
        self._flush()

    @contained("tls.eof")
    def eof_received(self) -> bool:
        """The client has closed the TCP connection; some do so without close_notify.

        Returns True, which keeps the connection open, while there is more to read.
        """
        self._hung_up = True
        if self._waits and self._open:
            return True
        self._ended = True
        self._react()
        return False

    @contained("tls.lost")
    def connection_lost(self, exc: Exception | None) -> None:
        """The TCP connection is gone."""
        self._open = False
        if self._deadline is not None:
            self._deadline.cancel()
        if not self._handshake.done():
            error = ConnectionResetError("it hung up before the end of the handshake")
            self._handshake.set_result(exc or error)
        if self._connection is not None:
            self._linger(self._connection)
        protocol, self._protocol = self._protocol, _NOBODY
        if self._connected:
            protocol.connection_lost(exc or self._error)

    @contained("tls.pause")
    def pause_writing(self) -> None:
        """The client reads more slowly than it is written to."""
        self._writable = False
        self._protocol.pause_writing()

    @contained("tls.resume")
    def resume_writing(self) -> None:
        """The client has caught up."""
        self._writable = True
        self._protocol.resume_writing()

    # --- the transport of the client's protocol ------------------------------------------------

    def write(self, data: Data) -> None:
        """Write at once, without filling a record; ignored once the connection is closing."""
        if not self._open:
            return
        try:
            if len(data) <= PIECE:
                self._tls.write(data)
                self._tcp.write(self._outgoing.read())
            else:
                view, sealed = memoryview(data), []
                for start in range(0, len(view), PIECE):
                    self._tls.write(view[start : start + PIECE])
                    sealed.append(self._outgoing.read())
                self._tcp.write(b"".join(sealed))
        except ssl.SSLError as error:
            # The exception must not reach the publisher of the message.
            self._error = error.with_traceback(None)
            self.abort()

    def writelines(self, list_of_data: Iterable[Data]) -> None:
        """Write them in order."""
        self.write(b"".join(list_of_data))

    def _flush(self) -> None:
        if self._outgoing.pending:
            self._tcp.write(self._outgoing.read())

    def close(self) -> None:
        """Write what is buffered and a close_notify, then close.

        The client's close_notify is not waited for (RFC 8446, section 6.1).
        """
        if self._tcp.is_closing():
            return
        self._open = False
        self._deadline = self._entries.later("tls.cut", CLOSE_TIMEOUT, self._tcp.abort)
        with contextlib.suppress(ssl.SSLError):  # it wants the client's close_notify as well
            self._tls.unwrap()
        self._flush()
        self._tcp.close()

    def abort(self) -> None:
        """Close at once."""
        self._open = False
        self._tcp.abort()

    def is_closing(self) -> bool:
        """Whether the connection is closing or closed."""
        return self._tcp.is_closing()

    def pause_reading(self) -> None:
        """Hand on nothing until `resume_reading`."""
        self._reading = False
        self._tcp.pause_reading()

    def resume_reading(self) -> None:
        """Hand on what arrives again, including the end of the connection."""
        self._reading = True
        if self._waits and not self._ended:
            self._wait()
            return
        if not self._hung_up:
            self._tcp.resume_reading()
        if self._ended:
            self._entries.soon("tls.react", self._react, failed=self.abort)

    def is_reading(self) -> bool:
        """Whether what arrives is handed on."""
        return self._tcp.is_reading()

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """The encrypted bytes from which on the protocol has to pause, and to resume."""
        self._tcp.set_write_buffer_limits(high, low)

    def get_write_buffer_limits(self) -> tuple[int, int]:
        """The low and the high limit."""
        return self._tcp.get_write_buffer_limits()

    def get_write_buffer_size(self) -> int:
        """Encrypted bytes that the network has not taken yet."""
        return self._tcp.get_write_buffer_size()

    def can_write_eof(self) -> bool:
        """No: TLS closes in both directions."""
        return False

    def get_extra_info(self, name: str, default: object = None) -> object:
        """What the TCP transport knows, and what asyncio's TLS transports do."""
        if name in _TLS_INFO:
            return _TLS_INFO[name](self._tls)
        if name == "has_unread":  # received, not handed on; also a part of a record
            return self._waits or self._cut or len(self._rest) > 0
        return self._tcp.get_extra_info(name, default)

    def get_protocol(self) -> asyncio.BaseProtocol:
        """The protocol above."""
        return self._protocol

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        """Replace the protocol above."""
        self._protocol = cast(asyncio.Protocol, protocol)


def _copy(transport: asyncio.Transport) -> socket.socket | None:
    """A copy of the transport's socket, to be closed after it; None without a file descriptor."""
    with contextlib.suppress(OSError):
        connection = socket.socket(fileno=os.dup(transport.get_extra_info("socket").fileno()))
        connection.setblocking(False)
        return connection
    return None


def reason(error: BaseException) -> str:
    """What went wrong in a handshake, in words for the log."""
    detail = getattr(error, "reason", None) or str(error) or type(error).__name__
    text = str(detail).replace("_", " ").lower()
    if "unknown ca" in text or "bad certificate" in text or "certificate unknown" in text:
        return f"the client does not trust our certificate; does it have ca.crt? ({text})"
    if "http request" in text or "wrong version number" in text:
        return f"what it sent is not TLS; is it meant for the plain listener? ({text})"
    if "certificate verify failed" in text:
        why = getattr(error, "verify_message", "")
        where = "crl" if "revoked" in why else "ca"
        return f"the client's certificate is not accepted: {why or text} (broker.tls.{where})"
    if "peer did not return a certificate" in text:
        return f"it has no client certificate, and one is required ({text})"
    return text


def name_in(certificate: Mapping[str, Any] | None) -> str:
    """The common name of a certificate's subject, or else its first alternative name."""
    if not certificate:
        return ""
    for part in certificate.get("subject", ()):
        for key, value in part:
            if key == "commonName":
                return str(value)
    return next((str(value) for _, value in certificate.get("subjectAltName", ())), "")
