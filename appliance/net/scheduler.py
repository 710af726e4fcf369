"""All network connections together: whose turn it is, and what their output takes in all."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine
from functools import partial
from typing import Protocol, TypeAlias

from appliance.broker.accounts import Account
from appliance.broker.broker import Broker
from appliance.broker.ports import Exchange, Identity, Refusal
from appliance.host.clock import SpareClock
from appliance.mqtt.packets import Connect
from appliance.net.callbacks import Entries
from appliance.net.layers import Schedulable, UpperLayer
from appliance.net.lingering import LingeringClose

#: Messages that are few: after more than these it is checked whether who sends them has to wait.
FEW_MESSAGES = 64

#: Bytes that a client is handed in one go: of a large WebSocket frame, a part.
LARGEST_PORTION = 256 * 1024

#: What all clients may cause in one round of the event loop, see `Counters.cost`: some six
#: milliseconds. And what each user may cause beyond that with little chunks: who sends little does
#: not wait for who sends much, or are many.
COST_PER_ROUND = 1500
COST_BEYOND_ROUND = 100

#: Cost after which the start of the round is taken anew.
COST_BETWEEN_CHECKS = 300

#: Seconds that a client may publish ahead of `limits.publish_rate`.
PUBLISH_BURST = 1.0

#: Closed connections that are listened to at a time, see `LingeringClose`.
LINGERING_CLOSES = 256

#: Who sent this CONNECT, from this address, over this TLS connection, if it is one; and does its
#: listener let in who gives no user name (None: as everywhere)?
Authenticate: TypeAlias = Callable[
    [Connect, str, "ssl.SSLObject | None", "bool | None"], Awaitable["Identity | Refusal"]
]

#: Begins an enhanced authentication by this method; None when it is not offered. There is no
#: address of a client that has logged in and authenticates again.
BeginExchange: TypeAlias = Callable[[str, "str | None", "ssl.SSLObject | None"], "Exchange | None"]


class CertificatePolicy(Protocol):
    """What is to be known of a client's certificate, of a connection with TLS."""

    def refusal(self, tls: ssl.SSLObject) -> str:
        """Why the client is not, or no longer, let in with it; empty when it is."""


class ScheduledConnection(Schedulable, Protocol):
    """One of the connections."""

    #: What all connections of one computer share; empty for a Unix socket.
    host: str
    #: The user it has logged in as, or that of strangers.
    account: Account

    def check_certificate(self) -> None:
        """Close the connection when the client's certificate is not, or no longer, accepted."""

    def close(self) -> None:
        """Write out what waits, then close."""

    def abort(self) -> None:
        """Close at once."""

    def make_room(self) -> None:
        """Close at once, for somebody else: it has not logged in, or is closing anyway."""


class AdmissionPolicy(Protocol):
    """Who lets connections in, and knows how many may be there."""

    def admit(self, member: ScheduledConnection, account: Account) -> str:
        """A connection logs in as that user: why it may not, or nothing."""

    def closing(self, member: ScheduledConnection) -> None:
        """It is told its last bytes."""

    def ended(self, member: ScheduledConnection) -> None:
        """It has ended, once."""


class Scheduler:
    """All connections, and what they share; the doorkeeper is told what becomes of each.

    `connect_timeout` is in seconds, `publish_rate` in messages a second from one client.
    """

    def __init__(
        self,
        broker: Broker,
        authenticate: Authenticate,
        exchange: BeginExchange,
        admission_policy: AdmissionPolicy,
        *,
        connect_timeout: float,
        publish_rate: float,
        certificates: CertificatePolicy | None = None,
    ) -> None:
        self.broker = broker
        self._spare = broker.accounting.spare = SpareClock()
        self.certificates = certificates
        self.authenticate = authenticate
        self.exchange = exchange
        self.entries = Entries(asyncio.get_running_loop(), broker.faults)
        self.use(connect_timeout, publish_rate)
        self.connections: set[ScheduledConnection] = set()
        #: What runs in the background for a connection: TLS handshakes and logins.
        self.tasks: set[asyncio.Task[None]] = set()
        #: Bytes in the output of all clients, as far as they are counted.
        self.output = 0
        self.admission_policy = admission_policy
        #: For how many clients a large chunk waits, by its id: in all, and of each account.
        self._shared: dict[tuple[int, int], int] = {}
        #: Who has more to do than there was time for; in turn, with all others in between.
        self._turn_queue: deque[Schedulable] = deque()
        #: `Counters.cost` from which on it is to be asked whether the round is over.
        self.checkpoint = 0
        self._next_turns: asyncio.Handle | None = None
        self._round_begun = False
        #: What each account has caused beyond the end of the round.
        self._excess: dict[Account, int] = {}
        self._lingering: set[LingeringClose] = set()
        self._all_closed: asyncio.Event | None = None

    def use(self, connect_timeout: float, publish_rate: float) -> None:
        """Let these limits hold from now on, and those that the broker has now."""
        self.connect_timeout = connect_timeout
        self.publish_rate = min(publish_rate, 1e12)  # infinity times no time is no number
        #: Messages of a client after which it is checked.
        self.check_every = int(min(max(publish_rate, 1), FEW_MESSAGES))
        #: Bytes that hold no more messages than may come at once: the smallest one takes five.
        self.portion = int(min(max(5 * PUBLISH_BURST * publish_rate, 256), LARGEST_PORTION))
        #: `Accounting.queued_bytes` from which on publishers are slowed.
        self.high_memory = self.broker.limits.memory * 3 // 4
        #: Bytes in the output of all clients from which on less is allowed to each of them.
        self.high_output = self.broker.limits.memory // 4

    def is_busy(self) -> bool:
        """Whether as much was done in this round of the event loop as one round is for, or others
        wait for the next one.

        Who sends much then waits, too.
        """
        return self.is_round_over() or bool(self._turn_queue)

    def is_round_over(self) -> bool:
        """Whether as much was done in this round of the event loop as one round is for.

        To be asked when `Counters.cost` is beyond the `checkpoint`, by who sends little.
        """
        cost = self.broker.counters.cost
        if not self._round_begun:
            self._round_begun = True
            self.checkpoint = cost + COST_PER_ROUND
            self.entries.soon("scheduler.round", self._new_round, failed=self._new_round)
        return cost > self.checkpoint

    def _new_round(self) -> None:
        self._round_begun = False
        self.checkpoint = self.broker.counters.cost + COST_BETWEEN_CHECKS
        self._excess.clear()

    def may_exceed_round(self, account: Account) -> bool:
        """Whether its clients have sent little since the round is over."""
        return self._excess.get(account, 0) < COST_BEYOND_ROUND

    def count_excess(self, account: Account, cost: int) -> None:
        """So much was done for one of them nevertheless."""
        self._excess[account] = self._excess.get(account, 0) + cost

    def count_cost(self, cost: int, charged: UpperLayer) -> None:
        """So much was done for it, see `Counters.cost`."""
        counters = self.broker.counters
        counters.cost += cost
        if self._round_begun and counters.cost > self.checkpoint:
            self.count_excess(charged.account, cost)

    def must_wait(self, charged: UpperLayer, *, is_small: bool) -> bool:
        """Whether a chunk is to be taken apart in a turn, see `LayerScheduler`."""
        if not is_small:
            return self.is_busy()
        if self.broker.counters.cost <= self.checkpoint or not self.is_round_over():
            return False
        return not self.may_exceed_round(charged.account)

    def queue_turn(self, member: Schedulable) -> None:
        """Call `take_turn` when it is the member's."""
        self._turn_queue.append(member)
        if len(self._turn_queue) == 1:
            self._schedule_turns()

    def _schedule_turns(self) -> None:
        """Run them in the next round, once: also when a fault comes after they were scheduled."""
        if self._next_turns is not None:
            self._next_turns.cancel()
        self._next_turns = self.entries.soon(
            "scheduler.turns", self._run_turns, failed=self._schedule_turns
        )

    def _run_turns(self) -> None:
        end = self.broker.counters.cost + COST_PER_ROUND
        left = len(self._turn_queue)
        try:
            while left:
                left -= 1
                member = self._turn_queue[0]
                try:
                    member.take_turn()
                except Exception as error:
                    member.fault("connection.turn", error)
                finally:
                    # After its turn, so that no entry meanwhile is the first, to be scheduled.
                    self._turn_queue.popleft()
                if self.broker.counters.cost > end:
                    break
        finally:
            if self._turn_queue:
                self._schedule_turns()

    def in_background(self, work: Coroutine[object, object, None]) -> None:
        """Run a connection's handshake or login beside everything else."""
        task = self.entries.task("scheduler.background", work)
        self.tasks.add(task)
        self.entries.when_done("scheduler.background_end", task, self.tasks.discard, task)

    def count_output(self, account: Account, size: int) -> None:
        """So many bytes more, or less, wait to be read by a client of the account."""
        self._count_in_all(size)
        self._count_for(account, size)

    def _count_in_all(self, size: int) -> None:
        self.output += size
        self.broker.accounting.queued_bytes += size

    def _count_for(self, account: Account, size: int) -> None:
        account.output += size
        account.bytes += size

    def is_output_high(self, account: Account) -> bool:
        """Whether so much output waits that less is allowed to the account's clients.

        Those of a user with less than most have of it are not the reason.
        """
        return (
            self.output > self.high_output
            and account.output * len(self.broker.accounting.accounts) > self.high_output
        )

    def share(self, account: Account, chunk: bytes) -> None:
        """Count a large chunk that waits for a client of the account.

        It is counted once for however many it waits, and once for each account of these.
        """
        for key, count in self._sharers(account, chunk):
            clients = self._shared.get(key, 0)
            if not clients:
                count(len(chunk))
            self._shared[key] = clients + 1

    def unshare(self, account: Account, chunk: bytes) -> None:
        """It waits for one client of the account less."""
        for key, count in self._sharers(account, chunk):
            clients = self._shared.pop(key) - 1
            if clients:
                self._shared[key] = clients
            else:
                count(-len(chunk))

    def _sharers(
        self, account: Account, chunk: bytes
    ) -> tuple[tuple[tuple[int, int], Callable[[int], None]], ...]:
        return (
            ((id(chunk), 0), self._count_in_all),
            ((id(chunk), id(account)), partial(self._count_for, account)),
        )

    def closing(self, member: ScheduledConnection) -> None:
        """A connection is told its last bytes; one that has ended is nobody's guest any more."""
        if member in self.connections:
            self.admission_policy.closing(member)

    def closed(self, member: ScheduledConnection) -> None:
        """A connection ended."""
        if member in self.connections:
            self.connections.discard(member)
            self.admission_policy.ended(member)
        self._tell_when_all_closed()

    def linger(self, connection: socket.socket) -> None:
        """Close a connection whose last bytes are on their way, see `LingeringClose`."""
        if len(self._lingering) < LINGERING_CLOSES:
            lingering = LingeringClose(connection, self._lingering_ended, self.entries)
            self._lingering.add(lingering)
            lingering.listen()
        else:
            connection.close()

    def _lingering_ended(self, lingering: LingeringClose) -> None:
        self._lingering.discard(lingering)
        self._tell_when_all_closed()

    def _tell_when_all_closed(self) -> None:
        if self._all_closed is not None and not self.connections and not self._lingering:
            self._all_closed.set()

    async def close(self, timeout: float) -> None:
        """Close everything; who does not read the last bytes in so many seconds is cut off."""
        for member in list(self.connections):
            member.close()
        for task in list(self.tasks):
            task.cancel()
        if self.connections or self._lingering:
            self._all_closed = asyncio.Event()
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._all_closed.wait(), timeout)
        for member in list(self.connections):
            member.abort()
        for lingering in list(self._lingering):
            lingering.end()
        self._spare.close()
