"""The connection to a broker, above TCP, TLS and WebSocket: bytes, flow control, and its end.

What arrives is handed to the owner in small portions and for a short time in each round of the
event loop, so that a broker that floods delays nobody else. What is sent waits here and in the
system only in small amounts, so that what is urgent overtakes what is not.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import socket
import ssl
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol, cast

from appliance.broker.accounts import Account
from appliance.net.callbacks import contained, contained_made
from appliance.net.layers import LayerScheduler
from appliance.net.lingering import LingeringClose

#: Bytes that the owner is handed at once: of the smallest packets some 200.
PORTION: Final = 2048

#: Seconds of a turn after which no further portion is handed on.
TURN: Final = 0.002

#: The most bytes to write at a time, apart from a larger packet; and the unsent bytes in the system
#: from which on nothing is written. So at most 16 + 24 KiB are unsent there, and what it did not
#: take, at most 24 KiB, waits here.
WRITE_PORTION: Final = 24 * 1024
SYSTEM_UNSENT: Final = 16 * 1024

#: Seconds between two looks at how much is unsent. TCP_NOTSENT_LOWAT alone would tell without
#: them, but Linux fills a segment that it has begun, of up to 64 KiB, beyond that limit.
LOOK_AGAIN: Final = 0.002

#: Seconds that `close` waits for the last bytes to be taken.
CLOSE_TIMEOUT: Final = 5.0

#: Seconds of silence before TCP probes the other end, between two probes, and how many of them are
#: unanswered until the connection counts as broken; and the seconds that what was sent may stay
#: unacknowledged (RFC 5482).
_KEEP_ALIVE: Final = {"TCP_KEEPIDLE": 15, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 3}
_USER_TIMEOUT: Final = 30.0

#: Of Linux, where Python has no name for it.
_NOTSENT_LOWAT: Final = getattr(socket, "TCP_NOTSENT_LOWAT", 25)
_OUTQNSD: Final = 0x894B  # SIOCOUTQNSD

_NOTHING: Final = memoryview(b"")


class TransportOwner(Protocol):
    """What a connection to a broker is for: the link."""

    def received(self, data: bytes) -> bool:
        """Take received bytes; returns whether there is more to do, by `proceed` in a later turn.

        Until it has been done no more bytes come.
        """

    def proceed(self) -> bool:
        """Continue with what was received; returns whether there is still more to do."""

    def writable(self) -> None:
        """What was written is on its way: `UpstreamTransport.writable` holds again."""

    def lost(self, reason: str) -> None:
        """The connection has ended, from either side; called once, and nothing after it."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What a connection to a broker needs of the appliance.

    Its work takes turns with that of all clients, as that of the user's `account`; `charge` adds to
    the memory that the account has in use, in bytes. `frame_limit` is the largest WebSocket frame.
    """

    scheduler: LayerScheduler
    account: Account
    charge: Callable[[int], None]
    frame_limit: int = 1 << 20


def tune(connection: socket.socket) -> None:
    """Set the options of a connected TCP socket, as far as the system has them."""
    connection.setblocking(False)
    options = [
        (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
        (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
        (socket.IPPROTO_TCP, _NOTSENT_LOWAT, SYSTEM_UNSENT),
        (socket.IPPROTO_TCP, getattr(socket, "TCP_USER_TIMEOUT", 18), int(_USER_TIMEOUT * 1000)),
    ]
    for name, value in _KEEP_ALIVE.items():
        options.append((socket.IPPROTO_TCP, getattr(socket, name), value))
    for level, option, value in options:
        with contextlib.suppress(OSError):
            connection.setsockopt(level, option, value)


class UpstreamTransport:
    """A connection to a broker: an `asyncio.Protocol`, and the transport of the link that owns it.

    `begin` says who owns it; what arrives earlier waits.
    """

    def __init__(self, surroundings: Surroundings, peer: str) -> None:
        #: The broker, for the log.
        self.peer = peer
        self._scheduler = surroundings.scheduler
        self._entries = surroundings.scheduler.entries
        self._account = surroundings.account
        self._charge = surroundings.charge
        self._frame_limit = surroundings.frame_limit
        self._charged: dict[str, int] = {}
        self._transport: asyncio.Transport | None = None
        self._owner: TransportOwner | None = None
        self._backlog = _NOTHING  # received, and not handed on
        self._more = False  # the owner has more to do
        self._queued = False
        self._held = False  # the owner has paused reading
        self._write_paused = False
        self._is_closing = False
        self._is_lost = False
        self._is_over = False  # the owner knows
        self._reason = ""
        #: The other end has closed the connection (FIN), and not this one.
        self.was_closed = False
        #: The words for an error that ended the connection.
        self.explain: Callable[[BaseException], str] = str
        self._copy: socket.socket | None = None
        self._cut: asyncio.TimerHandle | None = None
        self._look_timer: asyncio.TimerHandle | None = None
        self._gather_timer: asyncio.TimerHandle | None = None
        #: The descriptor of the socket, which costs as much to ask for as the system call on it.
        self._descriptor = -1
        self._lingering: LingeringClose | None = None

    def __str__(self) -> str:
        return self.peer

    def begin(self, owner: TransportOwner) -> None:
        """Hand everything to this owner from now on; it is called in a later round at first."""
        self._owner = owner
        self._queue()

    # --- for the layers below ------------------------------------------------------------------

    @property
    def account(self) -> Account:
        """The account of the link's user."""
        return self._account

    def fault(self, entry: str, error: Exception) -> None:
        """End this connection because an unexpected exception escaped while it was served."""
        self._entries.faults.caught(entry, error, self)
        self._reason = self._reason or "a fault in the appliance; its log has it"
        self.abort()
        # It may have been the end itself in which it occurred.
        self._release()
        self._end_soon()

    def count_buffered(self, size: int) -> None:
        """TLS and WebSocket buffer so many bytes."""
        self._count("below", size)

    def count_partial_frame(self, size: int) -> None:
        """So many bytes of an incomplete WebSocket frame are buffered."""
        self._count("frame", size)

    def _count(self, what: str, size: int) -> None:
        grown = size - self._charged.get(what, 0)
        if grown:
            self._charged[what] = size
            self._charge(grown)

    def input_paused(self) -> None:
        """Received bytes wait below."""

    def input_resumed(self) -> None:
        """Nothing waits below any more."""

    def partial_record(self, part: bool) -> None:
        """Whether TLS buffers the beginning of a record."""

    def frame_limit(self) -> int:
        """The largest WebSocket frame, in bytes."""
        return self._frame_limit

    def log_refusal(self, what: str, why: str) -> None:
        """Keep why a layer below ends the connection, for the owner."""
        self._reason = self._reason or f"{what}: {why:.200}"

    @contained_made("upstream.made")
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The connection is there."""
        self._transport = cast(asyncio.Transport, transport)
        with contextlib.suppress(AttributeError):  # no socket
            self._descriptor = transport.get_extra_info("socket").fileno()
        # What the system does not take at once pauses writing.
        self._transport.set_write_buffer_limits(high=0)
        if self._is_closing:  # given up meanwhile
            self._transport.abort()

    # --- bytes in ------------------------------------------------------------------------------

    @contained("upstream.chunk")
    def data_received(self, data: bytes) -> None:
        """Hand the chunk on, now or in turns."""
        if not data:  # an empty WebSocket frame
            return
        is_small = len(data) <= PORTION
        waits = self._backlog or self._queued or self._held or self._owner is None
        if is_small and not waits and not self._scheduler.must_wait(self, is_small=True):
            # As below, without the parts that a chunk of one portion does not need.
            assert self._owner is not None
            self._more = self._owner.received(data)
            if self._more:
                self._take_later()
            return
        self._backlog = memoryview(bytes(self._backlog) + data if self._backlog else data)
        if waits or self._scheduler.must_wait(self, is_small=is_small):
            self._take_later()
        else:
            self._take()
        self._count_backlog()

    def _take(self) -> None:
        """Hand portions on until the turn is over; reading is paused while there are more."""
        owner = self._owner
        end = self._entries.time() + TURN
        while owner is not None and not (self._held or self._is_over):
            if self._more:
                self._more = owner.proceed()
            elif self._backlog:
                portion = bytes(self._backlog[:PORTION])
                # An empty slice would keep the whole chunk alive.
                self._backlog = self._backlog[PORTION:] or _NOTHING
                self._more = owner.received(portion)
            else:
                return
            if self._more or (self._backlog and self._entries.time() >= end):
                self._take_later()
                return

    def _take_later(self) -> None:
        if self._transport is not None and not self._is_lost:
            self._transport.pause_reading()
        if self._owner is not None and not self._held:
            self._queue()

    def _queue(self) -> None:
        if not self._queued:
            self._queued = True
            self._scheduler.queue_turn(self)

    def take_turn(self) -> None:
        """Continue: the others have had their turn."""
        self._queued = False
        self._take()
        self._count_backlog()
        if self._is_lost and not (self._backlog or self._more or self._held):
            self._end()
        else:
            self._read_on()

    def _read_on(self) -> None:
        """Receive again, if nothing speaks against it."""
        waits = self._backlog or self._more or self._held or self._gather_timer is not None
        if not (waits or self._is_closing) and self._transport is not None:
            self._transport.resume_reading()

    def _count_backlog(self) -> None:
        """Account for the memory of what was not handed on: of a chunk, all of it."""
        self._count("here", len(cast(bytes, self._backlog.obj)))

    def pause_reading(self) -> None:
        """Receive nothing until `resume_reading`, apart from the end of the connection."""
        self._held = True
        if self._transport is not None and not self._is_lost:
            self._transport.pause_reading()

    def resume_reading(self) -> None:
        """Receive again, in a later round."""
        if self._held:
            self._held = False
            self._queue()

    def gather(self, seconds: float) -> None:
        """Receive nothing for so long: what comes meanwhile is then received at once, for the cost
        of one round of the event loop.

        Not while TLS or WebSocket have more to hand on, which would wait as well.
        """
        if self._gather_timer is not None or self._transport is None or self._is_closing:
            return
        if not self._transport.get_extra_info("has_unread"):
            self._gather_timer = self._entries.later(
                "upstream.gather", seconds, self._gathered, served=self, failed=self.abort
            )
            self._transport.pause_reading()

    def _gathered(self) -> None:
        self._gather_timer = None
        self._read_on()

    # --- bytes out -----------------------------------------------------------------------------

    @property
    def writable(self) -> bool:
        """Whether to write more now; if not, `TransportOwner.writable` says when."""
        if self._write_paused or self._is_closing or self._transport is None:
            return False
        if self._unsent() < SYSTEM_UNSENT:
            return True
        if self._look_timer is None:
            self._look_timer = self._entries.later(
                "upstream.look", LOOK_AGAIN, self._look, served=self, failed=self.abort
            )
        return False

    @property
    def unsent(self) -> int:
        """Bytes that were written and never sent: here, and in the system."""
        if self._transport is None:
            return 0
        return self._transport.get_write_buffer_size() + self._unsent()

    def _unsent(self) -> int:
        """Bytes in the system that were never sent; 0 where it does not tell."""
        assert self._transport is not None
        if self._descriptor < 0 or self._transport.is_closing():  # it may be another's by now
            return 0
        try:
            (size,) = struct.unpack("i", fcntl.ioctl(self._descriptor, _OUTQNSD, b"\0\0\0\0"))
        except OSError:
            return 0
        return int(size)

    def _look(self) -> None:
        self._look_timer = None
        if self.writable and self._owner is not None:
            self._owner.writable()

    def write(self, parts: list[bytes]) -> None:
        """Send them, once a round and at most WRITE_PORTION at a time unless one part is larger.

        Ignored once the connection is closing.
        """
        if self._transport is not None and not self._is_closing and parts:
            self._transport.write(parts[0] if len(parts) == 1 else b"".join(parts))

    @contained("upstream.pause")
    def pause_writing(self) -> None:
        """The system takes no more."""
        self._write_paused = True

    @contained("upstream.resume")
    def resume_writing(self) -> None:
        """It has taken all."""
        self._write_paused = False
        if self._owner is not None and self.writable:
            self._owner.writable()

    # --- the end -------------------------------------------------------------------------------

    def close(self, reason: str = "", timeout: float = CLOSE_TIMEOUT) -> None:
        """Send what is written, such as a DISCONNECT, and close; abort after `timeout` seconds.

        The owner receives nothing more but `lost`, with this reason.
        """
        if self._is_closing:
            return
        self._is_closing = True
        self._reason = self._reason or reason
        self._forget_input()
        if self._transport is None:
            self._end_soon()
            return
        with contextlib.suppress(OSError, AttributeError):
            number = os.dup(self._transport.get_extra_info("socket").fileno())
            self._copy = socket.socket(fileno=number)
            self._copy.setblocking(False)
        self._cut = self._entries.later(
            "upstream.cut", timeout, self._abort, served=self, failed=self._abort
        )
        self._transport.close()

    def abort(self, reason: str = "") -> None:
        """Close at once; what was written may be lost."""
        self._is_closing = True
        self._reason = self._reason or reason
        self._forget_input()
        self._abort()

    def _abort(self) -> None:
        copy, self._copy = self._copy, None
        if copy is not None:
            copy.close()
        if self._transport is not None:
            self._transport.abort()
        else:
            self._end_soon()

    def _forget_input(self) -> None:
        self._backlog = _NOTHING
        self._more = False
        self._count_backlog()

    @contained("upstream.eof")
    def eof_received(self) -> None:
        """The broker sends nothing more; the transport closes itself."""

    @contained("upstream.lost")
    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended, from either side; the owner gets what came before its end."""
        self._is_lost = True
        self._is_closing = True
        self._transport = None
        copy, self._copy = self._copy, None
        if copy is not None:
            # The broker may be sending: closing would reset the connection, and lose what was
            # written last.
            self._lingering = LingeringClose(copy, lambda _: None, self._entries)
            self._lingering.listen()
        if not self._reason:
            self._reason = self._why(exc)
            self.was_closed = exc is None
        if self._held or self._owner is None:
            self._forget_input()
        self._release()
        self._end_soon()

    def _release(self) -> None:
        for timer in (self._cut, self._look_timer, self._gather_timer):
            if timer is not None:
                timer.cancel()
        self._count("below", 0)
        self._count("frame", 0)

    def _why(self, error: Exception | None) -> str:
        if error is None:
            return "the broker has closed the connection"
        if isinstance(error, ConnectionResetError):
            return "the connection was reset, by the broker or on the way"
        if isinstance(error, TimeoutError):
            return f"the broker's computer did not answer for {_USER_TIMEOUT:g} s"
        if isinstance(error, ssl.SSLError):
            return self.explain(error)
        if isinstance(error, BrokenPipeError):
            return "the broker has closed the connection while it was written to"
        return f"the network: {getattr(error, 'strerror', None) or error}"

    def _end_soon(self) -> None:
        self._is_lost = True
        self._held = False
        if self._owner is not None:
            self._queue()

    def _end(self) -> None:
        """Tell the owner, once."""
        owner = self._owner
        if owner is not None and not self._is_over:
            self._is_over = True
            self._owner = None
            owner.lost(self._reason)

    @property
    def lost_reason(self) -> str:
        """Why the connection has ended; empty while it has not."""
        return self._reason if self._is_lost else ""

    def info(self, name: str) -> object:
        """What the transport below knows, such as `ssl_object`, `socket` and `peername`."""
        return None if self._transport is None else self._transport.get_extra_info(name)
