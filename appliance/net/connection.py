"""One network connection: an `asyncio.Protocol` that is the `Transport` of its client.

Input goes from `data_received` to `ClientHandler.receive`, in portions when there is much of it, or
others wait. Output is handed to the transport at once, or queued here while the
client reads too slowly.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import os
import socket
import ssl
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Final, cast

from appliance.broker.accounts import Account
from appliance.broker.client import ClientHandler
from appliance.broker.inflow import PAUSE, PAUSE_BEHIND
from appliance.broker.limits import USUAL_TERMS, Terms
from appliance.broker.link import LOCAL_PEER, PeerStatus
from appliance.broker.ports import Exchange
from appliance.broker.values import Identity, Refusal, TlsInfo
from appliance.mqtt.framing import MAXIMUM_CONTROL
from appliance.mqtt.packets import Connect
from appliance.mqtt.reason import ProtocolError, ReasonCode
from appliance.net import lingering, tls
from appliance.net.callbacks import contained, contained_made
from appliance.net.scheduler import PUBLISH_BURST, Scheduler
from appliance.net.sockets import Probe, peer_status, receive_buffer

log = logging.getLogger(__name__)

#: Bytes of output from which on a client counts as slow, and is sent no more until it has read
#: them. A healthy client reads less than this in one round of the event loop.
OUTPUT_HIGH_WATER = 1024 * 1024

#: The same while the output of all clients takes more than a quarter of `limits.memory`. Less than
#: this in a transport is not counted, so that writing costs nothing while clients read.
OUTPUT_LOW_WATER = 16 * 1024

#: Bytes that the system buffers, beside those in flight, for a client that is sent large messages
#: of QoS 0.
SYSTEM_OUTPUT = 128 * 1024

#: The most bytes that a transport is given at once: of a large message it holds a part, not a copy.
WRITE_PORTION: Final = 512 * 1024

#: Bytes of a payload from which on it is not joined with its header, nor with other packets.
LARGE_PAYLOAD: Final = 4 * 1024

#: A chunk this large means that more is waiting. The loop would read up to 32 such chunks before it
#: writes; reading is paused for the rest of the round, so that the receivers are written to before
#: they count as slow.
LARGE_CHUNK: Final = 128 * 1024

#: A chunk of at most this many bytes is small; a client that sends more may have to wait for a
#: turn.
SMALL_CHUNK = 16 * 1024

#: Turns that a client takes without a second's rest before that is logged.
MANY_TURNS = 200

#: Seconds that a publisher is not read after each check while memory is short.
SHORT_OF_MEMORY_PAUSE = 0.05

#: Seconds that a client is slow before that is logged.
SLOW_AFTER = 1.0

#: Seconds that a client has to read the last bytes before its connection is aborted.
CLOSE_TIMEOUT = 10.0

#: Seconds that a client's computer is probed with TCP keep-alives.
PROBE_DURATION = 3.0

#: The same for a client whose certificate was revoked.
REVOKED_TIMEOUT = 1.0

#: The cost of checking a client's certificate, which takes 0.2 ms at most.
CERTIFICATE_COST = 50


_NOTHING = memoryview(b"")


class ClientConnection:
    """One connection: hands received bytes to its `ClientHandler`, and is the `Transport` of that.

    It is an `asyncio.Protocol` without being derived from it, which makes it faster when compiled.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        address: str,
        host: str,
        terms: Terms = USUAL_TERMS,
        outer_tls: ssl.SSLObject | None = None,
    ) -> None:
        """`outer_tls` is the TLS of a connection that this one is carried by."""
        self.address = address
        self._outer_tls = outer_tls
        #: Those of its listener.
        self.terms = terms
        #: The host part of `address`; empty for a Unix socket.
        self.host = host
        #: The account that is charged for what is buffered here; that of strangers until the login.
        self.account = scheduler.broker.accounting.accounts.strangers
        #: The accepted socket, until there is a transport for it.
        self._accepted: socket.socket | None = None
        self._scheduler = scheduler
        self._broker = scheduler.broker
        self._accounting = scheduler.broker.accounting
        self._counters = scheduler.broker.counters
        self._transport: asyncio.Transport | None = None
        self._entries = scheduler.entries
        self._loop = scheduler.entries.loop
        self._client = ClientHandler(self._broker, self, terms)
        self._closing = False
        self._is_lost = False
        # Input: what was received and waits, and the reasons why it waits.
        self._backlog = _NOTHING
        self._backlog_size = 0  # bytes of the chunk that it is the rest of, in the accounting
        self._frame_size = 0  # bytes of an incomplete WebSocket frame
        self._is_record_cut = False  # TLS buffers an incomplete record
        self._below_size = 0  # bytes that TLS and WebSocket have not decoded
        self._has_more = False  # the client has more to do in its next turn
        self._turn_queued = False
        self._in_turn = False
        self._turns_taken = 0  # without a second's rest
        self._turned_at = 0.0
        self._rest_timer: asyncio.TimerHandle | None = None
        self._look_timer: asyncio.TimerHandle | None = (
            None  # for the next look whether it has caught up
        )
        self._look_at = 0.0
        self._looked_at = -math.inf  # the last look
        self._input_blocked = False
        self._logging_in = False
        self._login_result: Identity | Refusal | None = None  # the client has not been told yet
        self._stopped = False  # nothing is read until the client's next turn
        self._wait_timer: asyncio.TimerHandle | None = (
            None  # for that turn, if it does not come earlier
        )
        # The rate at which it publishes.
        self._small_chunk = min(SMALL_CHUNK, scheduler.portion)
        self._countdown = scheduler.check_every  # of messages, to the next check
        self._checked_at = self._loop.time()
        self._allowed = PUBLISH_BURST * scheduler.publish_rate  # messages, at the last check
        # Output: what the transport was not given yet, and how much of it is accounted.
        self._waiting: deque[bytes] = deque()
        self._waiting_size = 0  # bytes that are left of them
        self._begun = 0  # bytes of the first chunk that the transport has
        self._unshared = 0  # bytes of chunks that wait for this client only
        self._paused = False
        self._withheld: asyncio.TimerHandle | None = (
            None  # output is held back until then, on purpose
        )
        self._counted = 0  # bytes in the accounting
        self._slow_timer: asyncio.TimerHandle | None = None
        self._is_system_limited = False
        self._probe: Probe | None = None
        self._reported_behind = False  # the client is to be told when it has caught up
        #: Bytes of output from which on nothing is read from the client.
        self._output_limit = 0
        #: A copy of the transport's socket, which outlives it for a lingering close.
        self._connection: socket.socket | None = None
        # One time limit for the whole way to a complete CONNECT, against slow strangers.
        self._timeout = self._login_timer()

    def __str__(self) -> str:
        return str(self._client)

    # --- the connection ------------------------------------------------------------------------

    async def begin(
        self,
        connection: socket.socket,
        context: ssl.SSLContext | None,
        layer: Callable[[ClientConnection], asyncio.Protocol] | None = None,
    ) -> None:
        """Take over an accepted connection, with TLS through its handshake.

        `layer` makes what is between this and TCP or TLS, such as a WebSocket.
        """
        # asyncio's own server would not report a failed handshake, and the log has to say whose it
        # was and why it failed.
        scheduler = self._scheduler
        self._accepted = connection
        try:
            protocol = cast(asyncio.Protocol, self) if layer is None else layer(self)
            if connection.family != socket.AF_UNIX:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                # Detects that the computer of a client without keep alive is gone.
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            if context is None:
                await self._loop.connect_accepted_socket(lambda: protocol, connection)
            else:
                timeout = scheduler.connect_timeout
                await tls.accept(
                    connection, context, protocol, timeout, scheduler, scheduler.linger
                )
        except (OSError, asyncio.TimeoutError) as error:
            if self in self._scheduler.connections:  # else it was aborted to make room
                self.log_refusal(f"no {'TLS ' if context else ''}connection", tls.reason(error))
            connection.close()
            self._forget()
        except Exception as error:
            self._broker.faults.caught("connection.begin", error, self)
            self.abort()  # the transport may exist, and nobody else knows it
            if self._transport is None:
                connection.close()
        finally:
            self._accepted = None

    def fault(self, entry: str, error: Exception) -> None:
        """End this connection because an unexpected exception escaped while it was served."""
        broker, client = self._broker, self._client
        broker.fault(entry, error, client)
        broker.faults.run("connection.flush", broker.flush, otherwise=None)
        if self._transport is None:
            client.cut_off()
            self._forget()
        elif not self._closing:
            # Its last bytes wait for a commit, or even the flush has failed.
            self._cut_after(CLOSE_TIMEOUT)

    @contained_made("connection.made")
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The connection is there, its TLS handshake done."""
        self._transport = cast(asyncio.Transport, transport)
        self._transport.set_write_buffer_limits(high=OUTPUT_LOW_WATER)
        if self not in self._scheduler.connections:  # the handshake ended after its time limit
            self._transport.abort()
        else:
            self.check_certificate()

    @property
    def _tls(self) -> ssl.SSLObject | None:
        """The TLS of the connection, if it has any."""
        if self._transport is None or self._outer_tls is not None:
            return self._outer_tls
        return cast("ssl.SSLObject | None", self._transport.get_extra_info("ssl_object"))

    def check_certificate(self) -> None:
        """Close the connection if the client's certificate is not, or no longer, accepted.

        A client that has logged in is sent the reason, and has a second to read it.
        """
        certificates, tls_object = self._scheduler.certificates, self._tls
        if certificates is None or tls_object is None or self._closing:
            return
        self._broker.counters.cost += CERTIFICATE_COST
        reason = certificates.refusal(tls_object)
        if not reason:
            return
        if self._client.session is None:
            self.log_refusal("no TLS connection", reason)
            self._client.output.abandon()
        else:
            self._client.close(ReasonCode.NOT_AUTHORIZED, reason)
        self._broker.flush()
        self._entries.later("connection.revoked", REVOKED_TIMEOUT, self.abort, served=self)

    def _login_timer(self) -> asyncio.TimerHandle:
        return self._entries.later(
            "connection.login_timeout",
            self._scheduler.connect_timeout,
            self._too_late,
            served=self,
            failed=self.abort,
        )

    def suspend_login_limit(self) -> None:
        """It may be no MQTT client at all: the layer below limits the time."""
        self._timeout.cancel()

    def limit_login(self) -> None:
        """It is an MQTT client: a complete CONNECT has to come in time from now on."""
        self._timeout.cancel()
        self._timeout = self._login_timer()

    def _too_late(self) -> None:
        timeout = f"{self._scheduler.connect_timeout:g} s"
        self.log_refusal(f"no complete CONNECT within {timeout}", "broker.limits.connect_timeout")
        self.abort()

    def log_refusal(self, what: str, why: str) -> None:
        """Log why the connection is refused or ended, at a limited rate for each host and kind."""
        now = self._loop.time()
        message = f"{self.address}: {what}: {why:.200}"
        self._broker.rate_limited_log.warning(log, now, (self.host, what), "%s", message)
        if self._broker.audit_log is not None:
            self._broker.audit_log.refused(self.address, f"{what}: {why}")

    @contained("connection.eof")
    def eof_received(self) -> None:
        """The client sends nothing more; the transport closes itself."""

    @contained("connection.lost")
    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended, from either side."""
        self._is_lost = True
        self._forget()
        while self._waiting:
            self._take_waiting(self._waiting_size)
        self._paused = False
        if self._withheld is not None:
            self._withheld.cancel()
            self._withheld = None
        self._count_output()
        if self._slow_timer is not None:
            self._slow_timer.cancel()
        self._accounting.now = self._loop.time()
        if self._wait_timer is not None:
            self._wait_timer.cancel()
        if self._look_timer is not None:
            self._look_timer.cancel()
        if not self._closing:
            self._closing = True
            held, self._backlog = bytes(self._backlog), _NOTHING
            try:
                self._client.hurry()
                self._client.receive(held)
            except Exception as error:
                self._broker.fault("connection.last_chunk", error, self._client)
        self._transport = None
        self.count_partial_frame(0)
        self._release_backlog()
        self._accounting.take(self.account, -self._below_size)
        self._below_size = 0
        if self._connection is not None:
            self._scheduler.linger(self._connection)
        if self._scheduler.is_busy():
            self._leave_later()
        else:
            self._leave()

    def _leave_later(self) -> None:
        """End the client in a later turn."""
        if not self._turn_queued:
            self._turn_queued = True
            self._scheduler.queue_turn(self)

    def _leave(self) -> None:
        """Finish what the client sent before it left, in as many turns as needed, then end it."""
        if self._has_more:
            self._has_more = False
            try:
                self._client.send_on()
            except Exception as error:
                self._broker.fault("connection.last_turn", error, self._client)
            self._broker.flush()
            self._leave_later()
        else:
            self._client.lost()
            self._broker.flush()
            # The client and its transport refer to each other. Breaking the cycle frees both, and
            # the TLS connection, now and not at the next garbage collection.
            self._client.let_go(_ClosedTransport(self.address))

    def _forget(self) -> None:
        self._scheduler.closed(self)
        self._timeout.cancel()

    def abort(self) -> None:
        """Close at once."""
        if self._transport is not None:
            try:
                self._transport.abort()
            except Exception as error:
                self._broker.faults.caught("connection.abort", error, self)
        self._forget()

    def _cut_after(self, seconds: float) -> None:
        """Abort the connection after so many seconds, whether or not the client has read all."""
        self._timeout.cancel()
        self._timeout = self._entries.later(
            "connection.cut", seconds, self.abort, served=self, failed=self.abort
        )

    def make_room(self) -> None:
        """Close at once to make room: it has not logged in, or is closing anyway."""
        if not self._closing:
            self.log_refusal("makes room for others", "it has not logged in (broker.limits)")
        if self._transport is None and self._accepted is not None:
            with contextlib.suppress(OSError):  # this makes the handshake fail
                self._accepted.shutdown(socket.SHUT_RDWR)
        self.abort()

    # --- bytes in ------------------------------------------------------------------------------

    def data_received(self, data: bytes) -> None:
        """Hand the chunk to the client, then flush once what it has caused for all clients."""
        try:
            counters = self._counters
            if (
                len(data) > self._small_chunk or counters.cost > self._scheduler.checkpoint
            ) and not self._in_turn:
                data = self._receive_in_turn(data)
                if not data:
                    return
            self._accounting.now = self._loop.time()
            published = counters.publish_received
            self._client.receive(data)
            published -= counters.publish_received
            if self._broker.unflushed:
                self._broker.flush()
            if published:  # a negative number
                self._countdown += published
                if self._countdown <= 0:
                    self._check_publisher()
            if self._slow_timer is not None and self._output_size() > self._output_limit:
                # It goes on sending requests without reading the answers.
                self._input_blocked = True
                self._pause_reading()
        except Exception as error:
            self.fault("connection.chunk", error)

    def _receive_in_turn(self, data: bytes) -> bytes:
        """Make a client that sends much wait if necessary; returns what is to be received now."""
        scheduler, account = self._scheduler, self.account
        if len(data) <= self._small_chunk:
            if not scheduler.is_round_over():
                return data
            if scheduler.may_exceed_round(account):
                begun = self._counters.cost
                self._take_portion(data)
                scheduler.count_excess(account, self._counters.cost - begun)
            else:
                self._keep_backlog(data, 0)
                self._resume_input_later()
            return b""
        self._check_memory()
        portion = 0 if scheduler.is_busy() else scheduler.portion
        if len(data) >= LARGE_CHUNK or len(data) > portion:
            self._resume_input_later()
        if len(data) <= portion:
            return data  # compiled, a slice of all of it would be a copy
        self._keep_backlog(data, portion)
        return data[:portion]

    def _check_publisher(self) -> None:
        """Throttle a publisher that exceeds its own rate, or the memory of all."""
        scheduler = self._scheduler
        rate = scheduler.publish_rate
        now = self._accounting.now
        # A token bucket: it fills with time, and is emptied by what was published since the last
        # check.
        allowed = min(self._allowed + (now - self._checked_at) * rate, PUBLISH_BURST * rate)
        self._allowed = allowed - (scheduler.check_every - self._countdown)
        self._countdown = scheduler.check_every
        self._checked_at = now
        if self._allowed < 0:
            self._rest(-self._allowed / rate)
        else:
            self._check_memory()

    def _check_memory(self) -> None:
        if self._accounting.queued_bytes > self._scheduler.high_memory and self._rest_timer is None:
            # No longer: it may be this client's acknowledgements that would free the memory.
            self._rest(SHORT_OF_MEMORY_PAUSE)
            self._broker.rate_limited_log.warning(
                log,
                self._accounting.now,
                "memory",
                "%s is slowed: %d bytes are in use, of the %d allowed (broker.limits.memory)",
                self._client,
                self._accounting.queued_bytes,
                self._broker.limits.memory,
            )

    def _rest(self, seconds: float) -> None:
        """Read nothing for so many seconds."""
        if self._rest_timer is not None:
            self._rest_timer.cancel()
        self._rest_timer = self._entries.later(
            "connection.rested", seconds, self._rested, served=self, failed=self.abort
        )
        self._pause_reading()

    def _rested(self) -> None:
        self._rest_timer = None
        if self._scheduler.is_busy():
            self._resume_input_later()
        else:
            self._resume_input()

    def _resume_input_later(self) -> None:
        """Read on in a later turn, when the others had theirs."""
        self._pause_reading()
        if not self._turn_queued:
            self._turn_queued = True
            self._scheduler.queue_turn(self)

    def take_turn(self) -> None:
        """Continue: the others have had their turn."""
        self._turn_queued = False
        if self._is_lost:
            self._leave()
        else:
            self._resume_input()

    def _pause_reading(self) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self.input_paused()
            self._transport.pause_reading()

    def _resume_input(self) -> None:
        """Continue with what waits, in order, unless there is another reason to wait."""
        if (
            self._turn_queued
            or self._rest_timer
            or self._input_blocked
            or self._logging_in
            or self._closing
        ):
            return
        if self._transport is None or self._transport.is_closing():
            return
        if self._login_result is not None:
            who, self._login_result = self._login_result, None
            self._accounting.now = self._loop.time()
            # What the client sends because of the answer is not older than the answer. Once that
            # is written, it cannot be distinguished from what has come during the login: so check
            # now whether anything has, unless some of it is buffered here already.
            if not (self._client.protocol.has_unparsed or self._backlog):
                self._looked_at = -math.inf
                self.input_resumed()
                self.input_paused()
            self._answer_connect(who)
            self._resume_input()
        elif self._has_more:
            self._continue_client()
        elif self._stopped:
            return
        elif self._backlog:
            portion = bytes(self._backlog[: self._scheduler.portion])
            self._backlog = self._backlog[self._scheduler.portion :]
            if not self._backlog:  # an empty slice would keep the whole chunk alive
                self._release_backlog()
            self._take_portion(portion)
            self._resume_input_later()
        else:
            self.input_resumed()
            self._transport.resume_reading()

    def input_paused(self) -> None:
        """Received bytes wait, here or in a layer below."""
        self._client.inflow.reading_paused(self._loop.time())

    def input_resumed(self) -> None:
        """Nothing that was received waits any more."""
        inflow, now = self._client.inflow, self._loop.time()
        inflow.reading_resumed(now)
        if inflow.is_behind:
            # While much comes that is after each chunk, and to ask the system each time takes as
            # long as to pass on 30 KB. What is kept back between two looks is young enough.
            if now - self._looked_at > PAUSE:
                self._check_caught_up()
            else:
                self._schedule_look(PAUSE)

    def _check_caught_up(self) -> None:
        """Check, now and later, whether all is read that came while reading was paused."""
        if self._transport is None:
            return
        known = receive_buffer(self._transport.get_extra_info("socket"))
        if self._transport.get_extra_info("has_unread"):
            known = known._replace(unread=True)
        inflow, now = self._client.inflow, self._loop.time()
        seconds = inflow.check(now, **known._asdict())
        if seconds:  # else it has caught up, or is not read again
            self._looked_at = now
            self._schedule_look(seconds)

    def _schedule_look(self, seconds: float) -> None:
        """Check again after so many seconds, or earlier."""
        looks_at = self._loop.time() + seconds
        if self._look_timer is not None:
            if self._look_at <= looks_at:
                return
            self._look_timer.cancel()
        self._look_at = looks_at
        self._look_timer = self._entries.later(
            "connection.look", seconds, self._look_again, served=self
        )

    def _look_again(self) -> None:
        self._look_timer = None
        self._check_caught_up()

    def _keep_backlog(self, data: bytes, begin: int) -> None:
        """Keep a chunk from that byte on; all of it takes memory until its last byte is used."""
        self._backlog = memoryview(data)[begin:]
        self._accounting.take(self.account, len(data) - self._backlog_size)
        self._backlog_size = len(data)

    def _release_backlog(self) -> None:
        self._backlog = _NOTHING
        self._accounting.take(self.account, -self._backlog_size)
        self._backlog_size = 0

    def _take_portion(self, data: bytes) -> None:
        """Receive a portion that need not wait for a turn, or had one."""
        self._in_turn = True
        self.data_received(data)  # which never raises
        self._in_turn = False

    def _continue_client(self) -> None:
        self._has_more = self._stopped = False
        self._accounting.now = self._loop.time()
        published = self._counters.publish_received
        self._client.send_on()
        self._countdown -= self._counters.publish_received - published
        self._broker.flush()
        if self._countdown <= 0:
            self._check_publisher()
        self._resume_input()

    def frame_limit(self) -> int:
        """The largest WebSocket frame, in bytes: a stranger's may be as large as a CONNECT."""
        if self._client.session is None:
            return MAXIMUM_CONTROL
        return self._client.protocol.maximum_packet_size + MAXIMUM_CONTROL

    def count_buffered(self, size: int) -> None:
        """Account for what TLS and WebSocket buffer: at most what the loop reads at once, each."""
        if not self._is_lost:
            self._accounting.take(self.account, size - self._below_size)
            self._below_size = size

    def count_partial_frame(self, size: int) -> None:
        """Account for an incomplete WebSocket frame; close when there is no memory for it."""
        accounting = self._accounting
        grown = size - self._frame_size
        if size or self._frame_size:
            self._note_partial_input(size > 0 or self._is_record_cut)
        self._frame_size = size
        accounting.take(self.account, grown)
        if grown > 0 and size > accounting.reserve and not accounting.fits(self.account, 0):
            reason = (
                f"no memory for {size} bytes of a WebSocket frame "
                "(broker.limits.memory, broker.limits.user.memory)"
            )
            self._client.fail(ProtocolError(ReasonCode.QUOTA_EXCEEDED, reason))
            self._broker.flush()

    def partial_record(self, part: bool) -> None:
        """Whether TLS buffers the beginning of a record."""
        self._is_record_cut = part
        self._note_partial_input(part or self._frame_size > 0)

    def _note_partial_input(self, is_kept: bool) -> None:
        """Record since when an incomplete record or frame is buffered: its content is as old."""
        inflow, protocol = self._client.inflow, self._client.protocol
        if is_kept:
            inflow.unfinished = inflow.unfinished or self._loop.time()
        elif not (protocol.unfinished or protocol.paused or self._backlog):
            inflow.unfinished = 0.0  # its content is processed, or it was a ping

    # --- bytes out -----------------------------------------------------------------------------

    def _write_on(self) -> None:
        """Give the transport the queued output, until it asks for a pause."""
        assert self._transport is not None
        while self._waiting and not self._paused and not self._transport.is_closing():
            portion = [self._take_waiting(WRITE_PORTION)]
            room = WRITE_PORTION - len(portion[0])
            while self._waiting and room:
                portion.append(self._take_waiting(room))
                room -= len(portion[-1])
            self._transport.write(portion[0] if len(portion) == 1 else b"".join(portion))
        self._count_output()
        if self._closing and not self._waiting:
            self._close_transport()

    def _take_waiting(self, most: int) -> bytes | memoryview:
        """Take the rest of the first queued chunk, or at most so many bytes of it."""
        chunk, begun = self._waiting[0], self._begun
        left = len(chunk) - begun
        if left > most:
            self._begun += most
            self._waiting_size -= most
            return memoryview(chunk)[begun : self._begun]
        self._waiting.popleft()
        self._waiting_size -= left
        self._begun = 0
        if len(chunk) > WRITE_PORTION:
            self._scheduler.unshare(self.account, chunk)
        else:
            self._unshared -= len(chunk)
        return memoryview(chunk)[begun:] if begun else chunk

    def _output_size(self) -> int:
        transport = self._transport
        return self._waiting_size + (0 if transport is None else transport.get_write_buffer_size())

    def _count_output(self) -> None:
        """Account for the output that waits, and stop sending when that is too much."""
        scheduler = self._scheduler
        counted = self._unshared
        if self._paused and self._transport is not None:
            counted += self._transport.get_write_buffer_size()
        scheduler.count_output(self.account, counted - self._counted)
        self._counted = counted
        limit = OUTPUT_LOW_WATER if scheduler.is_output_high(self.account) else OUTPUT_HIGH_WATER
        size = self._output_size()
        if size > limit and self._slow_timer is None:
            self._client.output.writable = False
            # From here on its output grows only by answers, and by no more than `limit`.
            self._output_limit = size + limit
            self._slow_timer = self._entries.later("connection.slow", SLOW_AFTER, self._log_slow)

    def _log_slow(self) -> None:
        self._broker.rate_limited_log.warning(
            log,
            self._loop.time(),
            "slow",
            "%s is slow: it does not read %d bytes, and is sent nothing more until it does",
            self._client,
            self._output_size(),
        )

    @contained("connection.pause")
    def pause_writing(self) -> None:
        """The client reads more slowly than it is written to."""
        self._paused = True
        self._count_output()

    @contained("connection.resume")
    def resume_writing(self) -> None:
        """It has caught up."""
        if self._withheld is not None:
            return
        self._paused = False
        if self._transport is None:
            return
        self._write_on()
        if self._paused or self._closing:
            return
        if self._slow_timer is None:
            if self._reported_behind:
                self._reported_behind = False
                self._client.output.caught_up()
                self._broker.flush()
            return
        self._slow_timer.cancel()
        self._slow_timer = None
        self._reported_behind = False
        self._input_blocked = False
        self._client.output.resume_writing()
        self._broker.flush()
        self._resume_input()

    # --- the client's transport ----------------------------------------------------------------

    def users_removed(self, names: Collection[str]) -> None:
        """See `ScheduledConnection`. Who it is becomes known at the end only, so a login that is
        under way counts as one of theirs."""
        who = self._login_result
        if self._logging_in or (isinstance(who, Identity) and who.username in names):
            self.close()

    def authenticate(self, connect: Connect) -> None:
        """Authenticate the CONNECT in the background; nothing more is read until then."""
        self._logging_in = True
        self._pause_reading()
        self._scheduler.in_background(self._log_in(connect))

    async def _log_in(self, connect: Connect) -> None:
        try:
            self._login_result = await self._scheduler.authenticate(
                connect, self.address, self._tls, self.terms.anonymous
            )
            self._logging_in = False
            if self._scheduler.is_busy():  # crowds reconnect at once when a network is back
                self._resume_input_later()
            else:
                self._resume_input()
        except Exception as error:
            self.fault("connection.login", error)

    def _answer_connect(self, who: Identity | Refusal) -> None:
        if isinstance(who, Refusal):
            self._client.refuse(who.code, who.reason)
        else:
            self._client.accept(who.username)
        self._broker.flush()

    def exchange(self, method: str) -> Exchange | None:
        """Begin an enhanced authentication; None when the method is not offered."""
        session = self._client.session
        again = session.identity.username if session is not None and session.identity else None
        return self._scheduler.exchange(method, self.address, self._tls, again)

    def now(self) -> float:
        """Seconds of the event loop's clock."""
        return self._loop.time()

    def admit(self, account: Account) -> str:
        """Admit the client as this user and end its time limit; or return why it is refused."""
        refusal = self._scheduler.admission_policy.admit(self, account)
        if refusal:
            return refusal
        self._timeout.cancel()
        self._scheduler.count_output(self.account, -self._counted)
        self._scheduler.count_output(account, self._counted)
        waits = self._frame_size + self._below_size + self._backlog_size
        self._accounting.take(self.account, -waits)
        self._accounting.take(account, waits)
        self.account = account
        return ""

    def holds(self, size: int) -> None:
        """A large packet is incomplete: its last chunk, however small, does not count as small."""
        self._small_chunk = 0 if size > SMALL_CHUNK else min(SMALL_CHUNK, self._scheduler.portion)

    def tls_info(self) -> TlsInfo:
        """The version of TLS, and the name in the client's certificate."""
        peer = self._tls
        if peer is None:
            return TlsInfo()
        return TlsInfo(peer.version() or "", tls.name_in(peer.getpeercert()))

    def later(self) -> None:
        """Continue the client in a later turn; nothing is read before that."""
        self._has_more = True
        self._resume_input_later()
        now = self._accounting.now
        if now - self._turned_at > 1.0:  # it was idle
            self._turns_taken = 0
        self._turned_at = now
        self._turns_taken += 1
        if self._turns_taken == MANY_TURNS:
            self._turns_taken = 0
            self._broker.rate_limited_log.warning(
                log,
                self._accounting.now,
                "turns",
                "%s asks for more than there is time for, and is read later",
                self._client,
            )

    def stop_reading(self) -> None:
        """Read nothing more until the client's next turn."""
        self._stopped = True
        self._pause_reading()

    def wait(self, seconds: float) -> None:
        """Give the client a turn after so many seconds."""
        if self._wait_timer is not None:
            self._wait_timer.cancel()
        self._wait_timer = self._entries.later(
            "connection.wait", seconds, self.proceed, served=self, failed=self.abort
        )

    def proceed(self) -> None:
        """Give the client a turn when the others had theirs."""
        if self._wait_timer is not None:
            self._wait_timer.cancel()
            self._wait_timer = None
        self._has_more = True
        self._resume_input_later()

    def write(self, chunks: list[bytes]) -> None:
        """Write the chunks, joined if they are small; to a slow client in portions."""
        if not self._paused:
            if len(chunks[-1]) > LARGE_PAYLOAD and len(chunks) > 1:
                size = sum(map(len, chunks))
                if len(chunks) * LARGE_PAYLOAD < size <= WRITE_PORTION:
                    # Not joined, which copies them: the system takes them one after the other.
                    self._counters.bytes_sent += size
                    if self._transport is not None:
                        self._transport.writelines(chunks)
                    return
            data = chunks[0] if len(chunks) == 1 else b"".join(chunks)
            size = len(data)
            if size <= WRITE_PORTION:
                self._counters.bytes_sent += size
                if self._transport is not None:
                    self._transport.write(data)
                return
        self._write_later(chunks)

    def _write_later(self, chunks: list[bytes]) -> None:
        if len(chunks[-1]) <= WRITE_PORTION:  # a large payload is shared by all its receivers
            chunks = [b"".join(chunks)]
        self._counters.bytes_sent += sum(map(len, chunks))
        if self._transport is None or self._transport.is_closing():
            return
        for chunk in chunks:
            self._waiting.append(chunk)
            self._waiting_size += len(chunk)
            if len(chunk) > WRITE_PORTION:
                self._scheduler.share(self.account, chunk)
            else:
                self._unshared += len(chunk)
        self._write_on()

    def is_behind(self) -> bool:
        """Whether the transport has asked for a pause."""
        if not self._is_system_limited:
            self._limit_system_output()
        self._reported_behind |= self._paused
        return self._paused

    def _limit_system_output(self) -> None:
        """Limit what the system buffers: nothing can overtake that, and for a slow client it is
        megabytes, seconds' worth."""
        self._is_system_limited = True
        if self._transport is None:
            return
        connection = self._transport.get_extra_info("socket")
        if connection.family != socket.AF_UNIX and hasattr(socket, "TCP_NOTSENT_LOWAT"):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, SYSTEM_OUTPUT)

    def peer_status(self) -> PeerStatus:
        """How the computer at the other end answers."""
        if self._transport is None:
            return LOCAL_PEER
        known = peer_status(self._transport.get_extra_info("socket"))
        has_unread = known.has_unread or bool(self._backlog) or self._has_more
        has_unread = has_unread or bool(self._transport.get_extra_info("has_unread"))
        now = self._accounting.now  # of the chunk that is being taken in, if one is
        inflow = self._client.inflow
        held = inflow.held(now, has_unread=has_unread)
        flowing = inflow.flowing(now)
        if held:
            self._schedule_look(PAUSE_BEHIND)
        return replace(known, has_unread=has_unread, flowing=flowing, held=held)

    def probe(self) -> None:
        """Make it answer within two seconds, if it can."""
        if self._transport is not None and self._probe is None:
            self._probe = Probe(self._transport.get_extra_info("socket"))
            self._entries.later("connection.probe", PROBE_DURATION, self._end_probe, served=self)

    def _end_probe(self) -> None:
        probe, self._probe = self._probe, None
        if probe is not None and self._transport is not None:
            probe.end()

    def withhold(self, seconds: float) -> None:
        """Write nothing for so many seconds; 0 ends that."""
        if self._withheld is not None:
            self._withheld.cancel()
            self._withheld = None
        if self._transport is None or self._transport.is_closing():
            return
        if seconds:
            self._paused = True
            self._withheld = self._entries.later(
                "connection.withhold", seconds, self.withhold, 0.0, served=self, failed=self.abort
            )
        elif self._paused and self._transport.get_write_buffer_size() <= OUTPUT_LOW_WATER:
            self.resume_writing()

    def close(self) -> None:
        """Write what is queued, then close."""
        if self._transport is None or self._closing:
            return
        self._closing = True
        self._cut_after(CLOSE_TIMEOUT)
        self._scheduler.closing(self)
        if self._waiting:
            self._pause_reading()
        else:
            self._close_transport()

    def _close_transport(self) -> None:
        assert self._transport is not None
        if not self._transport.get_write_buffer_size():
            self._cut_after(lingering.TIMEOUT)
        if self._connection is None and not self._transport.is_closing():
            # A transport closes its socket as soon as it has written; only a copy stays open.
            with contextlib.suppress(OSError):
                file = os.dup(self._transport.get_extra_info("socket").fileno())
                self._connection = socket.socket(fileno=file)
                self._connection.setblocking(False)
        self._transport.close()


class _ClosedTransport:
    """The transport of a client whose connection has ended: it does nothing."""

    def __init__(self, address: str) -> None:
        self.address = address

    def authenticate(self, connect: Connect) -> None:
        """Nobody waits for it."""

    def exchange(self, method: str) -> Exchange | None:
        """There is none to be had."""
        return None

    def now(self) -> float:
        """No time passes."""
        return 0.0

    def admit(self, account: Account) -> str:
        """Nobody waits for it."""
        return ""

    def holds(self, size: int) -> None:
        """Nothing more comes."""

    def tls_info(self) -> TlsInfo:
        """Nothing is left to be secured."""
        return TlsInfo()

    def later(self) -> None:
        """There is nothing to go on with."""

    def stop_reading(self) -> None:
        """There is nothing to be read."""

    def wait(self, seconds: float) -> None:
        """No time passes."""

    def proceed(self) -> None:
        """There is nothing to go on with."""

    def write(self, chunks: list[bytes]) -> None:
        """Nobody reads it."""

    def is_behind(self) -> bool:
        """Nothing waits for anybody."""
        return False

    def peer_status(self) -> PeerStatus:
        """Nobody is at the other end."""
        return PeerStatus(silence=math.inf)

    def probe(self) -> None:
        """Nobody would answer."""

    def withhold(self, seconds: float) -> None:
        """Nothing is written anyway."""

    def close(self) -> None:
        """It is closed."""

    def abort(self) -> None:
        """It is closed."""
