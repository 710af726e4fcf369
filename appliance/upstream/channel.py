"""One connection of a link, from CONNECT to its end: what ties protocol, transport and broker.

A link has one channel for what it sends and for what it receives online, and another one when it
has rules whose messages the fleet's broker keeps while the link is down.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final, Protocol

from appliance.broker.broker import Broker
from appliance.broker.link import PeerStatus
from appliance.host.clock import SleepWatch
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ReasonCode
from appliance.net.callbacks import Entries
from appliance.upstream.agreement import ConnectSettings, Ending
from appliance.upstream.in_session import InSession
from appliance.upstream.link import FleetConnection
from appliance.upstream.link_events import (
    Acknowledged,
    Arrived,
    Challenged,
    FleetEvent,
    Opened,
    Subscribed,
)
from appliance.upstream.rule_queue import Entry
from appliance.upstream.transport import UpstreamTransport

#: Seconds between two checks of the connection's times, at most: a message from the broker may
#: bring the next one nearer.
CHECK_INTERVAL: Final = 1.0

#: Seconds after a check in which nothing is checked anew: it asks the system, which costs more than
#: a message, and what it looks for takes seconds.
CHECKED_FOR: Final = 0.05

#: Bytes of answers that are written and not sent, from which on nothing more is read. Messages do
#: not count: while a large one leaves slowly, what comes is read.
MOST_UNSENT: Final = 1 << 20

#: The shortest interval of PINGREQs for commands, in seconds, whatever `late` says.
SHORTEST_PING: Final = 0.05


class ChannelOwner(Protocol):
    """The link that a channel belongs to."""

    broker: Broker
    entries: Entries

    def receive(self, channel: Channel) -> InSession:
        """The session here for what comes on the channel, which is up."""

    def opened(self, channel: Channel) -> None:
        """The broker has accepted the connection."""

    def subscribed(self, channel: Channel, results: list[tuple[Subscription, int]]) -> None:
        """The broker has answered all subscriptions; those that it refuses, with the reason.

        Called again when it has answered those of `Channel.subscribe`.
        """

    def acknowledged(self, entries: list[Entry | None], code: int, reason: str) -> None:
        """Messages that were sent on the channel are acknowledged, or refused (0x80 and above)."""

    def send_more(self, channel: Channel) -> None:
        """There may be room for messages on the channel."""

    def ended(self, channel: Channel, ending: Ending) -> None:
        """The connection has ended; called once."""


class Channel:
    """One connection; its transport calls it, and `owner` is told what happens.

    `subscriptions` are made when the broker has accepted the connection, `one_by_one` each only
    when the one before is answered; `late` is the least `late`
    of the rules on this connection in seconds, None without one. `is_kept`: the broker keeps the
    session when the connection ends.
    """

    def __init__(
        self,
        owner: ChannelOwner,
        settings: ConnectSettings,
        subscriptions: Sequence[Subscription],
        late: float | None,
        *,
        is_kept: bool,
        one_by_one: bool = False,
    ) -> None:
        self.is_kept = is_kept
        self.version = settings.version
        self.connection: FleetConnection[Entry | None] = FleetConnection(settings)
        #: When CONNECT was sent.
        self.connected_at = -math.inf
        self.inward: InSession | None = None
        self._owner = owner
        self._broker = owner.broker
        self._entries = owner.entries
        self._loop = owner.entries.loop
        self._unasked = deque(subscriptions)
        self._one_by_one = one_by_one
        #: The topic filters that the broker was asked for and has not answered yet, and those that
        #: it has answered.
        self.unanswered: list[str] = []
        self.answered: list[str] = []
        self._refused: list[tuple[Subscription, int]] = []
        self._transport: UpstreamTransport | None = None
        self._ping_interval = math.inf if late is None else max(late / 2, SHORTEST_PING)
        self._received_at = -math.inf
        self._sleep = SleepWatch()
        self._slept = 0.0
        #: Bytes that were written since the last message: all of them answers. Messages are written
        #: only when little is unsent, so that hardly any answers lie before that one.
        self._written_since = 0
        #: Why nothing is read now; empty while it is.
        self._holds: set[str] = set()
        self._timer: asyncio.TimerHandle | None = None
        self._checked_at = -math.inf
        self._ping_timer: asyncio.TimerHandle | None = None
        self._turn: asyncio.TimerHandle | None = None
        self._turn_at = 0.0
        self._has_ended = False
        #: Why the connection ends as soon as nothing is under way; empty while it stays.
        self._leaving = ""
        #: The broker has answered all subscriptions that it was asked for first.
        self.is_subscribed = False

    def __str__(self) -> str:
        return str(self.connection)

    @property
    def can_send(self) -> bool:
        """Whether the network takes more now."""
        return (
            not self._has_ended
            and self._transport is not None
            and not self._leaving
            and self._transport.writable
            and self.connection.granted is not None
        )

    def begin(self, transport: UpstreamTransport) -> None:
        """The connection is made: send CONNECT."""
        self._transport = transport
        transport.begin(self)
        self.connected_at = now = self._loop.time()
        self.connection.start(now)
        self.write(now)

    # --- TransportOwner ---------------------------------------------------------------------------

    def received(self, data: bytes) -> bool:
        """See `TransportOwner`."""
        if self._has_ended:
            return False
        self._received_at = now = self._loop.time()
        self._look_for_sleep(now)
        for event in self.connection.receive(data, now):
            self._handle(event, now)
            if self._has_ended:
                return False
        self._after(now)
        if self._written_since > MOST_UNSENT and not self._has_ended:
            assert self._transport is not None
            if self._transport.unsent > MOST_UNSENT:
                self._hold("unsent")  # it asks for answers that it does not read
        return False

    def proceed(self) -> bool:
        """See `TransportOwner`: all is done at once, as portions are small."""
        return False

    def writable(self) -> None:
        """See `TransportOwner`."""
        self._release("unsent")
        self.send_on()

    def lost(self, reason: str) -> None:
        """See `TransportOwner`."""
        was_closed = self._transport is not None and self._transport.was_closed
        self.connection.lost(reason, is_close=was_closed)
        self._finish()

    @property
    def client_id(self) -> str:
        """The client id there: the broker may have assigned another one."""
        granted = self.connection.granted
        return self.connection.settings.client_id if granted is None else granted.client_id

    def renew_login(self, data: bytes | None) -> None:
        """The login expires soon: authenticate again, or end the connection to log in anew."""
        if self._has_ended:
            return
        if self.connection.settings.method is None:
            # With the will: the robot is offline until the next connection says otherwise.
            self.close(ReasonCode.DISCONNECT_WITH_WILL_MESSAGE, "the token expires")
            return
        with contextlib.suppress(ValueError):  # one is under way
            self.connection.reauthenticate(data)
        self.write(self._loop.time())

    def gather(self, seconds: float) -> None:
        """Let what comes in so many seconds come at once, see `UpstreamTransport.gather`."""
        if self._transport is not None:
            self._transport.gather(seconds)

    def send_on(self) -> None:
        """There may be more to send, and room for it."""
        if not self._has_ended:
            self._after(self._loop.time())

    def _look_for_sleep(self, now: float) -> None:
        """Forget how old is what came and what comes now, if the computer has slept since."""
        slept = self._sleep.seconds()
        if slept != self._slept:
            self._slept = slept
            self.connection.woke(now)
            if self.inward is not None:
                self.inward.woke()

    # --- what comes -------------------------------------------------------------------------------

    def _handle(self, event: FleetEvent[Entry | None], now: float) -> None:
        if isinstance(event, Arrived):
            if self.inward is not None:
                self.inward.receive(event, now)
        elif isinstance(event, Acknowledged):
            self._owner.acknowledged(event.tokens, event.code, event.reason)
        elif isinstance(event, Opened):
            self._open()
        elif isinstance(event, Subscribed):
            self._refused += [each for each in event.results if each[1] >= 0x80]
            if event.complete:
                self.answered += self.unanswered
                self.unanswered = []
                self._subscribe_on()
        elif isinstance(event, Challenged):
            self.connection.close(
                ReasonCode.BAD_AUTHENTICATION_METHOD, "it asks for more than a token"
            )

    def _open(self) -> None:
        self.inward = self._owner.receive(self)
        self._owner.opened(self)
        self._subscribe_on()
        if self._ping_interval < math.inf:
            self._ping()

    def _subscribe_on(self) -> None:
        """Ask for all subscriptions, or for the next one; tell when all are answered."""
        while self._unasked:
            if self.connection.ended is not None:
                return  # DISCONNECT came with the last answer: it was not asked
            count = 1 if self._one_by_one else len(self._unasked)
            some = [self._unasked.popleft() for _ in range(count)]
            refused = self.connection.subscribe(some)
            self._refused += refused
            if len(refused) < count:
                self.unanswered = [each.filter for each in some]
                return  # the answers come
        refused, self._refused = self._refused, []
        self._owner.subscribed(self, refused)
        self.is_subscribed = True

    def subscribe(self, subscriptions: Sequence[Subscription]) -> None:
        """Ask for more, one by one, on a connection that `is_subscribed`; not while one is under
        way."""
        self._unasked.extend(subscriptions)
        self._one_by_one = True
        self._subscribe_on()
        self.write(self._loop.time())

    def _after(self, now: float) -> None:
        """At the end of a round: commit, send on, write, and look at the times again."""
        self._broker.flush()
        before = self.connection.waiting
        if self.connection.ended is None:
            self._owner.send_more(self)
        has_sent = self.connection.waiting > before
        if self._leaving and self.connection.ended is None and not self._is_under_way():
            self.connection.close(ReasonCode.SUCCESS, self._leaving)
        self.write(now)
        if has_sent:
            self._written_since = 0

    def write(self, now: float) -> None:
        """Write what the connection has collected; end if it has ended."""
        if self._has_ended or self._transport is None:
            return
        self._written_since += self.connection.waiting
        chunks = self.connection.take(now)
        if chunks:
            self._transport.write(chunks)
        if self.connection.ended is not None:
            self._finish()
        else:
            self._check_later(now)

    # --- times ------------------------------------------------------------------------------------

    def _check_later(self, now: float) -> None:
        assert self._transport is not None
        if self._timer is not None and now < self._checked_at + CHECKED_FOR:
            return
        self._checked_at = now
        due = self.connection.tick(now, self._transport.unsent, is_reading=not self._holds)
        if self.connection.ended is not None:
            self._finish()
            return
        if self.connection.waiting:  # a PINGREQ
            self._transport.write(self.connection.take(now))
        if self._timer is None:
            self._timer = self._later("upstream.check", min(due, now + CHECK_INTERVAL), self._check)

    def _check(self) -> None:
        self._timer = None
        self.write(self._loop.time())

    def _later(
        self, entry: str, when: float, callback: Callable[[], object]
    ) -> asyncio.TimerHandle:
        """Call it at that time; if it fails, the connection ends."""
        return self._entries.at(entry, when, callback, served=self, failed=self._give_up)

    def _give_up(self) -> None:
        code = ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR
        self.close(code, "a fault in the appliance; its log has it")

    def _ping(self) -> None:
        """Send a PINGREQ, whose answer bounds the age of what comes, and the next one later."""
        self._ping_timer = None
        if self._has_ended:
            return
        when = self._loop.time() + self._ping_interval
        self._ping_timer = self._later("upstream.ping", when, self._ping)
        self.connection.ping()
        self.write(self._loop.time())

    # --- the end ----------------------------------------------------------------------------------

    def leave(self, reason: str) -> None:
        """Send no more messages, and end the connection as soon as nothing is under way on it."""
        if not self._has_ended:
            self._leaving = reason
            self._after(self._loop.time())

    def _is_under_way(self) -> bool:
        """Whether either end owes the other an acknowledgement, or a message waits here."""
        connection = self.connection
        is_waiting = self.inward is not None and self.inward.waiting > 0
        return is_waiting or connection.inflight > 0 or connection.unacknowledged > 0

    def _finish(self) -> None:
        """The connection has ended: nothing more is received, acknowledged or sent on it."""
        if self._has_ended:
            return
        self._has_ended = True
        ending = self.connection.ended
        assert ending is not None
        try:
            if self.inward is not None:
                self.inward.detach()
            if self._transport is not None:
                chunks = self.connection.take(self._loop.time())
                if chunks:
                    self._transport.write(chunks)
                self._transport.close(ending.text)
        finally:
            for timer in (self._timer, self._ping_timer, self._turn):
                if timer is not None:
                    timer.cancel()
            # Nothing else would free a cycle of references, see `app/main.py`.
            self.inward = self._transport = None
            self._owner.ended(self, ending)
            self._broker.flush()

    # --- InConnection -----------------------------------------------------------------------------

    def acknowledge(self, packet_id: int, code: int) -> None:
        """See `InConnection`: it is written at the end of the round, or soon."""
        self.connection.acknowledge(packet_id, code)
        self.later(0)

    def later(self, seconds: float) -> None:
        """See `InConnection`."""
        when = self._loop.time() + seconds
        if self._turn is not None:
            if self._turn_at <= when:
                return
            self._turn.cancel()
        self._turn = self._later("upstream.turn", when, self._take_turn)
        self._turn_at = when

    def _take_turn(self) -> None:
        self._turn = None
        if self._has_ended:
            return
        now = self._loop.time()
        self._look_for_sleep(now)
        if self.inward is not None:
            self.inward.take_turn(now)
        if not self._has_ended:
            self._after(now)

    def pause_reading(self) -> None:
        """See `InConnection`."""
        self._hold("receivers")

    def resume_reading(self) -> None:
        """See `InConnection`."""
        self._release("receivers")

    def _hold(self, why: str) -> None:
        if self._transport is not None and not self._holds:
            self._transport.pause_reading()
        self._holds.add(why)

    def _release(self, why: str) -> None:
        if why in self._holds:
            self._holds.discard(why)
            if self._transport is not None and not self._holds:
                self._transport.resume_reading()

    def close(self, code: ReasonCode, reason: str) -> None:
        """See `InConnection`."""
        self.connection.close(code, reason)
        self._finish()

    def peer_status(self) -> PeerStatus:
        """See `InConnection`."""
        return PeerStatus(
            self.connection.round_trip or 0.0,
            self._loop.time() - self._received_at,
            self.inward is not None and self.inward.waiting > 0,
        )

    def probe(self) -> None:
        """See `InConnection`."""
        self.connection.ping()
        self.later(0)
