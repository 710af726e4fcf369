"""The scheduler of all network connections: whose turn it is, and how much output is buffered.

A *round* is one iteration of the event loop. Work is measured as cost (`Counters.cost`), not as
time, so that no clock has to be read for each message. When a round's cost is used up, connections
with much input wait for a turn; small chunks are still served, up to a limit for each user.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import socket
import ssl
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterable
from functools import partial
from typing import Protocol, TypeAlias, TypeVar

from async_timeout import timeout

from appliance.broker.accounts import Account
from appliance.broker.broker import Broker
from appliance.broker.counters import COST_PER_TURN
from appliance.broker.limits import Anonymous
from appliance.broker.ports import Exchange
from appliance.broker.values import Identity, Refusal
from appliance.host.clock import SpareClock
from appliance.mqtt.packets import Connect
from appliance.net.callbacks import Entries
from appliance.net.layers import Schedulable, UpperLayer
from appliance.net.lingering import LingeringClose

T = TypeVar("T")

#: The most messages of one client between two checks of its rate and of the memory in use.
FEW_MESSAGES = 64

#: The most bytes that a client decodes at once: of a large WebSocket frame, a part.
LARGEST_PORTION = 256 * 1024

#: The cost of all clients in one round of the event loop, see `Counters.cost`: some six
#: milliseconds. And the cost of each user beyond that, with small chunks: a client that sends
#: little does not wait for those that send much, or are many.
COST_PER_ROUND = 1500
COST_BEYOND_ROUND = 100

#: Cost after which the start of the round is taken anew.
COST_BETWEEN_CHECKS = 300

#: Seconds by which a client may exceed `limits.publish_rate` in a burst.
PUBLISH_BURST = 1.0

#: The shortest time until messages are sent that wait because of a max-rate, and the time until
#: that is tried again after a fault; in seconds.
SHORTEST_WAIT = 0.001
AFTER_FAULT = 0.1

#: The most lingering closes at a time; further connections are closed at once.
LINGERING_CLOSES = 256

#: Finds out who sent a CONNECT: its address, its TLS connection if it has one, and whether its
#: listener admits clients without a user name.
Authenticate: TypeAlias = Callable[
    [Connect, str, "ssl.SSLObject | None", Anonymous], Awaitable["Identity | Refusal"]
]

#: Begins an enhanced authentication by this method from an address; None when it is not offered.
#: The last is the user of a client that has logged in and authenticates again.
BeginExchange: TypeAlias = Callable[
    [str, str, "ssl.SSLObject | None", "str | None"], "Exchange | None"
]


class CertificatePolicy(Protocol):
    """Decides whether the certificate of a client is accepted."""

    def refusal(self, tls: ssl.SSLObject) -> str:
        """Why the certificate is not, or no longer, accepted; empty when it is."""

    def username(self, tls: ssl.SSLObject) -> str | None:
        """The user that the certificate names, None for none. ValueError refuses the client."""


class ScheduledConnection(Schedulable, Protocol):
    """A connection as the scheduler and the listeners see it."""

    #: The host part of the client's address; empty for a Unix socket.
    host: str
    #: The user that has logged in, or the account of strangers.
    account: Account

    def check_certificate(self) -> None:
        """Close the connection if the client's certificate is not, or no longer, accepted."""

    def close(self) -> None:
        """Write what is queued, then close."""

    def abort(self) -> None:
        """Close at once."""

    def users_removed(self, names: Collection[str]) -> None:
        """Close the connection if its login is under way, or decided for one of these users."""

    def make_room(self) -> None:
        """Close at once, to make room for another connection."""


class AdmissionPolicy(Protocol):
    """Limits how many connections an address may have."""

    def admit(self, member: ScheduledConnection, account: Account) -> str:
        """Count the connection as one of this user; or return why the limits refuse it."""

    def closing(self, member: ScheduledConnection) -> None:
        """The connection writes its last bytes, and no longer counts as its user's."""

    def ended(self, member: ScheduledConnection) -> None:
        """The connection has ended; called once."""


class Scheduler:
    """All connections, their turns, and the memory that their output takes.

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
        self._spare = broker.accounting.client_time = SpareClock()
        self.certificates = certificates
        self.authenticate = authenticate
        self.exchange = exchange
        self.entries = Entries(asyncio.get_running_loop(), broker.faults)
        #: The timer for messages that wait because of a subscription's max-rate, and its time.
        self._rate_timer: asyncio.TimerHandle | None = None
        self._rate_time = math.inf
        broker.rates.clock = self.entries.time
        broker.rates.wake = self._send_rated_at
        self.use(connect_timeout, publish_rate)
        self.connections: set[ScheduledConnection] = set()
        #: Background tasks of connections: TLS handshakes and logins.
        self.tasks: set[asyncio.Task[None]] = set()
        #: Bytes of output that wait for all clients, as far as they are counted.
        self.output = 0
        self.admission_policy = admission_policy
        #: How many clients a large chunk waits for, by its id and the id of an account (0: in all).
        self._shared: dict[tuple[int, int], int] = {}
        #: What waits for a turn, served round-robin, with all other work in between.
        self._turn_queue: deque[Schedulable] = deque()
        #: The value of `Counters.cost` beyond which `is_round_over` has to be asked.
        self.checkpoint = 0
        self._next_turns: asyncio.Handle | None = None
        self._round_begun = False
        #: The cost of each account since the round was used up.
        self._excess: dict[Account, int] = {}
        self._lingering: set[LingeringClose] = set()
        self._all_closed: asyncio.Event | None = None

    def use(self, connect_timeout: float, publish_rate: float) -> None:
        """Apply these limits, and those that the broker has now, from now on."""
        self.connect_timeout = connect_timeout
        self.publish_rate = min(publish_rate, 1e12)  # infinity times 0 s is NaN
        #: Messages of a client between two checks of its rate.
        self.check_every = int(min(max(publish_rate, 1), FEW_MESSAGES))
        #: Bytes that cannot hold more messages than a burst allows: the smallest takes five.
        self.portion = int(min(max(5 * PUBLISH_BURST * publish_rate, 256), LARGEST_PORTION))
        #: `Accounting.queued_bytes` from which on publishers are throttled.
        self.high_memory = self.broker.limits.memory * 3 // 4
        #: Bytes of output of all clients from which on each of them may have less.
        self.high_output = self.broker.limits.memory // 4

    def is_busy(self) -> bool:
        """Whether this round's cost is used up, or others wait for a turn already.

        A connection with much input then waits as well.
        """
        return self.is_round_over() or bool(self._turn_queue)

    def is_round_over(self) -> bool:
        """Whether this round's cost is used up.

        A connection with little input asks when `Counters.cost` is beyond `checkpoint`.
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
        """Whether the account has cost left beyond the round, for small chunks."""
        return self._excess.get(account, 0) < COST_BEYOND_ROUND

    def count_excess(self, account: Account, cost: int) -> None:
        """Add what was done for a client of the account beyond the round."""
        self._excess[account] = self._excess.get(account, 0) + cost

    def count_cost(self, cost: int, charged: UpperLayer) -> None:
        """Add to `Counters.cost` what was done for this connection."""
        counters = self.broker.counters
        counters.cost += cost
        if self._round_begun and counters.cost > self.checkpoint:
            self.count_excess(charged.account, cost)

    def must_wait(self, charged: UpperLayer, *, is_small: bool) -> bool:
        """Whether a chunk has to wait for a turn, see `LayerScheduler`."""
        if not is_small:
            return self.is_busy()
        if self.broker.counters.cost <= self.checkpoint or not self.is_round_over():
            return False
        return not self.may_exceed_round(charged.account)

    def queue_turn(self, member: Schedulable) -> None:
        """Call `take_turn` once, when it is the member's turn."""
        self._turn_queue.append(member)
        if len(self._turn_queue) == 1:
            self._schedule_turns()

    def _schedule_turns(self) -> None:
        """Run the turns in the next round, once, even if a fault has scheduled them before."""
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
                    # Only now: `queue_turn` schedules when it finds the queue empty.
                    self._turn_queue.popleft()
                if self.broker.counters.cost > end:
                    break
        finally:
            if self._turn_queue:
                self._schedule_turns()

    def in_background(self, work: Coroutine[object, object, None]) -> asyncio.Task[None]:
        """Run a connection's handshake or login, or work for many, as a background task."""
        task = self.entries.task("scheduler.background", work)
        self.tasks.add(task)
        self.entries.when_done("scheduler.background_end", task, self.tasks.discard, task)
        return task

    async def in_pieces(self, items: Iterable[T], work: Callable[[T], object]) -> None:
        """Do the work, which catches its own faults, for each item; clients go on in between.

        When an item's turn comes much may have changed: the work has to look at it again.
        """
        counters = self.broker.counters
        end = counters.cost + COST_PER_TURN
        for item in items:
            work(item)
            counters.cost += 1
            if counters.cost > end:
                self.broker.flush()
                await asyncio.sleep(0)
                end = counters.cost + COST_PER_TURN
        self.broker.flush()

    def count_output(self, account: Account, size: int) -> None:
        """Add bytes (or subtract, if negative) that wait to be read by a client of the account."""
        self._count_in_all(size)
        self._count_for(account, size)

    def _count_in_all(self, size: int) -> None:
        self.output += size
        self.broker.accounting.queued_bytes += size

    def _count_for(self, account: Account, size: int) -> None:
        account.output += size
        account.bytes += size

    def has_room(self, account: Account, size: int) -> bool:
        """Whether so much more may wait for a client of the account. A little always may."""
        accounting = self.broker.accounting
        return size <= accounting.reserve or accounting.fits(account, size)

    def take(self, account: Account, size: int) -> None:
        """Count so many more bytes (fewer, if negative) that wait for a client of the account."""
        self.broker.accounting.take(account, size)

    def is_output_high(self, account: Account) -> bool:
        """Whether so much output waits that the account's clients may have less.

        Accounts with less than an average share are not restricted.
        """
        return (
            self.output > self.high_output
            and account.output * len(self.broker.accounting.accounts) > self.high_output
        )

    def share(self, account: Account, chunk: bytes) -> None:
        """Count a large chunk that waits for a client of the account.

        However many clients wait for it, it is counted once in all, and once for each account.
        """
        for key, count in self._sharers(account, chunk):
            clients = self._shared.get(key, 0)
            if not clients:
                count(len(chunk))
            self._shared[key] = clients + 1

    def unshare(self, account: Account, chunk: bytes) -> None:
        """One client of the account less waits for the chunk."""
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
        """A connection writes its last bytes; one that has ended already is ignored."""
        if member in self.connections:
            self.admission_policy.closing(member)

    def closed(self, member: ScheduledConnection) -> None:
        """A connection has ended."""
        if member in self.connections:
            self.connections.discard(member)
            self.admission_policy.ended(member)
        self._signal_when_all_closed()

    def linger(self, connection: socket.socket) -> None:
        """Close a socket whose last bytes are on their way, see `LingeringClose`."""
        if len(self._lingering) < LINGERING_CLOSES:
            lingering = LingeringClose(connection, self._lingering_ended, self.entries)
            self._lingering.add(lingering)
            lingering.listen()
        else:
            connection.close()

    def _lingering_ended(self, lingering: LingeringClose) -> None:
        self._lingering.discard(lingering)
        self._signal_when_all_closed()

    def _send_rated_at(self, when: float) -> None:
        """Call `_send_rated` at this time at the latest."""
        if when >= self._rate_time:
            return
        if self._rate_timer is not None:
            self._rate_timer.cancel()
        self._rate_time = when
        # uvloop's timers are precise to a millisecond, and would come too early otherwise.
        when = max(when, self.entries.time() + SHORTEST_WAIT)
        self._rate_timer = self.entries.at(
            "scheduler.rates", when, self._send_rated, failed=self._send_rated_again
        )

    def _send_rated(self) -> None:
        """Send what has waited because of a subscription's max-rate."""
        due = self.broker.send_due()
        self._rate_time = math.inf
        if due < math.inf:
            self._send_rated_at(due)

    def _send_rated_again(self) -> None:
        """A fault came in between."""
        self._rate_time = math.inf
        self._send_rated_at(self.entries.time() + AFTER_FAULT)

    def _signal_when_all_closed(self) -> None:
        if self._all_closed is not None and not self.connections and not self._lingering:
            self._all_closed.set()

    async def close(self, patience: float) -> None:
        """Close all connections; abort those that are not read to the end in so many seconds."""
        for member in list(self.connections):
            member.close()
        for task in list(self.tasks):
            task.cancel()
        if self.connections or self._lingering:
            self._all_closed = asyncio.Event()
            with contextlib.suppress(asyncio.TimeoutError):
                async with timeout(patience):
                    await self._all_closed.wait()
        for member in list(self.connections):
            member.abort()
        for lingering in list(self._lingering):
            lingering.end()
        self._spare.close()
        if self._rate_timer is not None:  # nobody is left who waits
            self._rate_timer.cancel()
            self._rate_time = math.inf
