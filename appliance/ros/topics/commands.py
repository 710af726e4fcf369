"""Carries commands that move a robot from MQTT to ROS, with the rules of a route.

Stale commands expire, one client at a time commands, and a stop message is published when that
client falls silent or leaves. All of it happens on the loop's thread; the ROS thread sets up what
depends on the type, see `CommandPublicationFollower`.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import deque
from dataclasses import dataclass
from functools import partial

from appliance.broker.link import LOCAL_PEER
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.broker.values import PublishRejection
from appliance.mqtt.reason import ReasonCode
from appliance.ros.node import BusError
from appliance.ros.payload.converter import ConversionError
from appliance.ros.payload.payloads import unpacked_size
from appliance.ros.topics.conversions import LITTLE, size_of
from appliance.ros.topics.flow import LOG_INTERVAL
from appliance.ros.topics.follower import RoutedTopic
from appliance.ros.topics.lease import OVERTAKEN, Lease
from appliance.ros.topics.publication import CommandPublicationFollower, Outlet
from appliance.ros.topics.rules import CommandRules
from appliance.ros.topics.staleness import (
    QUEUED,
    SENT_AT,
    STREAM_BEGINS,
    CommandVerdict,
    sent_at,
    stated_age,
)
from appliance.ros.topics.to_ros import RuleViolationError, ToRos, ToRosContext

#: Seconds until a stop message that ROS has not taken is published again.
RETRY = 0.05

#: Seconds within which the computer of a silent client has to answer: two probes, of which the
#: first may be sent a second after the silence began. And between two checks for the answer.
PROBE_TIMEOUT = 2.5
PROBE_INTERVAL = 0.1

#: The difference between the system's clocks for that, in seconds.
CLOCK_TOLERANCE = 0.02

#: Seconds until the next check whether everything that a client has sent has been read.
READ_INTERVAL = 0.01


#: The largest payload that may be a stop message: so many bytes for each byte of it in CDR, for
#: names, digits and white space, and never less than STOP_SIZE.
STOP_BYTES = 64
STOP_SIZE = 16 * 1024


@dataclass(slots=True)
class _PendingCommand:
    """A first command, converted, that is held until it is known whether a queue follows."""

    message: Message
    number: int
    cdr: bytes
    #: The bytes that are accounted for it.
    size: int
    came_at: float
    due: float
    timer: asyncio.TimerHandle
    #: See `StalenessDetector.slept`.
    slept: float


@dataclass(slots=True, eq=False)
class _Command:
    """A command that has come at `at`, and what is known of it before it is converted."""

    message: Message
    origin: Session | None
    #: See `StalenessDetector.number`: the order in which commands came, across all topics.
    number: int
    at: float
    #: See `StalenessDetector.slept`.
    slept: float
    verdict: CommandVerdict
    #: Why it must not be carried out, unless it stops the robot.
    why: str
    #: The command as CDR, if it was converted before it was queued.
    cdr: bytes = b""
    #: The reason to give if the verdict is to refuse it.
    refusal: str = QUEUED
    #: Whether its client has sent DISCONNECT since.
    has_left: bool = False
    #: Whether its `sent-at` is wrong; `why` says how.
    is_wrong: bool = False

    @property
    def is_to_come(self) -> bool:
        """Whether it is to be carried out although its client has left."""
        return self.has_left and not self.why and self.verdict is CommandVerdict.CARRY_OUT


class Commands(ToRos):
    """A flow to ROS with command rules."""

    _follower_type = CommandPublicationFollower

    def __init__(self, topic: RoutedTopic, context: ToRosContext) -> None:
        super().__init__(topic, context)
        assert self.settings.rules is not None
        self.rules: CommandRules = self.settings.rules
        #: The client that sent the last command, and when.
        self._source: Session | None = None
        self._commanded_at = -math.inf
        #: Whether the last published message was not the stop message.
        self._is_driven = False
        #: The last command of each connected client that was not the stop message, and its time:
        #: infinity if the client has fallen silent since.
        self._drivers: dict[Session, tuple[bytes, float]] = {}
        self._has_stopped = False
        self._staleness = context.staleness
        #: The lease that this route was added to.
        self._joined: Lease | None = None
        #: The first commands that are held, see `StalenessDetector`.
        self._pending: dict[Session, _PendingCommand] = {}
        #: Large commands that are queued for conversion, and smaller ones behind them.
        self._queued: dict[Session | None, deque[_Command]] = {}
        #: Clients that fell silent while they drove, and when their computer was probed.
        self._probed: dict[Session, float] = {}
        #: Whether a stop message is overdue because ROS has not taken it.
        self._must_stop = False
        #: The number of the topic's retained message, if it came before a subscription was there to
        #: receive it.
        self._awaited: int | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._logged: dict[str, float] = {}

    def enter(self, before: ToRos | None) -> None:
        super().enter(before)
        self._context.broker.departures.append(self._departed)
        if isinstance(before, Commands):
            # Their commands may still be in the network or in a client's queue, for this flow, too.
            self._drivers = before._drivers
            self._arm()

    def leave(self) -> None:
        if self._is_left:
            return
        super().leave()
        for origin in list(self._pending):
            self._abandon_pending(origin, "the route ends")
        if self._is_driven:
            self._stop_now("the route ends")
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._context.broker.departures.remove(self._departed)
        self._part_with_lease()
        self._source = None

    def receive(
        self, message: Message, retain: bool, origin: Session | None, number: int
    ) -> PublishRejection | None:
        """Judge a command as it comes. A large one is converted in its turn, and its rejection is
        returned only if that is now.
        """
        if self._is_left or (retain and not self.rules.take_retained):
            return None
        command = self._judge(message, retain, origin, number)
        is_refused = command.why or command.verdict is CommandVerdict.REFUSE
        if is_refused and not self._may_stop(message):
            return self._refuse(command, command.why or command.refusal)
        is_kept = retain or (message.retain and self.rules.take_retained)
        if is_kept:
            publication = self.follower.publication
            if publication.outlet is None or not publication.is_found:
                self._awaited = number
                self._settle(origin)
                return None
        size = size_of(message.payload)
        conversions = self._context.conversions
        if size <= LITTLE and origin not in self._queued:
            return conversions.little(partial(self._finish, command))
        if size <= LITTLE:
            return self._queue_behind_own(command)
        if not conversions.is_busy and not conversions.waits(origin):
            return conversions.now(partial(self._finish, command))
        return self._queue(command, size)

    def _judge(
        self, message: Message, retain: bool, origin: Session | None, number: int
    ) -> _Command:
        """Judge a command by everything but its payload."""
        # The time of the chunk: all messages in it came at once, however long they take.
        now, slept = self._context.broker.now, self._staleness.slept
        verdict = CommandVerdict.CARRY_OUT
        refusal = QUEUED
        try:
            why = self._old_by_itself(message) or self._old_by_delivery(message, retain, origin)
            is_proven = sent_at(message.properties) is not None
        except ValueError as error:  # refused, unless its payload stops the robot
            return _Command(message, origin, number, now, slept, verdict, str(error), is_wrong=True)
        if origin is not None:
            if why and origin.link is not None:
                self._drop_first(origin, why)
                self._staleness.mark_stale(origin, now)
            elif not why and not is_proven and self.rules.oldest < math.inf:
                verdict = self._staleness.judge(origin, message.qos, self.rules.oldest, now, number)
                if verdict is CommandVerdict.REFUSE:
                    refusal = self._staleness.refusal_reason(origin)
            # It would overtake a command that is held.
            self._drop_first(origin, why or refusal)
            if verdict is CommandVerdict.WAIT:
                self._staleness.add_pending(origin, self)
        return _Command(message, origin, number, now, slept, verdict, why, refusal=refusal)

    def _finish(self, command: _Command) -> PublishRejection | None:
        """Convert it and carry it out, if it still may be; a fault of the appliance is a rejection,
        too."""
        try:
            return self._convert_and_carry_out(command)
        except Exception as error:
            return self.fault(command.message, error)
        finally:
            self._settle(command.origin)

    def _settle(self, origin: Session | None) -> None:
        """A command is settled: if it was a first one, the next one of its client is no queue with
        it, unless one is held here."""
        if origin is None or origin in self._pending:
            return
        queue = self._queued.get(origin, ())
        if not any(one.verdict is CommandVerdict.WAIT and not one.why for one in queue):
            self._staleness.remove_pending(origin, self)

    def _convert_and_carry_out(self, command: _Command) -> PublishRejection | None:
        message, origin = command.message, command.origin
        if command.why and not self._is_late_stop(message, origin):
            return self._refuse(command, command.why)
        cdr = command.cdr or self._convert(message, origin)
        verdict = command.verdict
        if isinstance(cdr, PublishRejection):
            return cdr
        if verdict is not CommandVerdict.CARRY_OUT and self.is_stop_message(cdr):
            # A stop is carried out at once, whatever comes with it.
            verdict = CommandVerdict.CARRY_OUT
        if origin is not None and verdict is CommandVerdict.REFUSE:
            return self._expire(message, command.refusal, origin)
        if origin is not None and verdict is CommandVerdict.WAIT:
            return self._hold(command, cdr, origin)
        return self._carry_out(message, cdr, origin, command.number)

    # Large commands, which are queued for conversion

    def _queue(self, command: _Command, size: int) -> PublishRejection | None:
        message, origin = command.message, command.origin
        conversions = self._context.conversions
        if not conversions.has_room(origin, size):
            if self._may_stop(message) and unpacked_size(message.payload) <= self._stop_size:
                # A stop is carried out although the queue is full, at its client's expense.
                cdr = conversions.now(partial(self._convert, message, origin))
                if isinstance(cdr, PublishRejection):
                    return cdr
                if cdr is not None and self.is_stop_message(cdr):
                    command.cdr = cdr
                    return self._finish(command)
            self._settle(origin)
            why = "was refused: too much of its user waits to be converted"
            return self._fail_and_reject(message, why, ReasonCode.QUOTA_EXCEEDED)
        self._queued.setdefault(origin, deque()).append(command)
        conversions.do(origin, size, partial(self._convert_queued, command))
        return None

    def _queue_behind_own(self, command: _Command) -> PublishRejection | None:
        """Queue a small command behind the large ones of its client, unless it stops the robot:
        then it is the others that come too late."""
        message, origin = command.message, command.origin
        cdr = self._convert(message, origin)
        if isinstance(cdr, PublishRejection):
            return cdr
        command.cdr = cdr
        if self.is_stop_message(cdr):
            return self._finish(command)
        return self._queue(command, max(len(cdr), len(message.payload)))

    def _convert_queued(self, command: _Command) -> None:
        """Carry out a queued command in its turn, if it still may be."""
        message, origin = command.message, command.origin
        queue = self._queued[origin]
        queue.remove(command)
        if not queue:
            del self._queued[origin]
        command.why = command.why or self._why_late(command)
        if self._is_left:
            self._count_expired(command.why or "the route ends", origin)
        elif command.why and not self._may_stop(message):
            self._count_expired(command.why, origin)
        elif origin is not None and not self.decide(origin):
            self.counters.refused += 1
        else:
            self._finish(command)
        if command.has_left and origin is not None and origin.link is None:
            self._stop_after(origin)
        self._settle(origin)

    def _stop_after(self, origin: Session) -> None:
        """The client's connection has ended: stop the robot after the last of its commands."""
        queue = self._queued.get(origin, ())
        if origin is not self._source or any(one.is_to_come for one in queue):
            return
        self._source = None
        if self._is_driven:
            self._stop_now(f"{origin} has left")

    def _why_late(self, command: _Command) -> str:
        """Why a command has become stale in the queue; empty when it has not."""
        if self._lease.is_overtaken(command.number, command.origin):
            return OVERTAKEN
        oldest = self.rules.oldest
        waited = self._context.entries.time() - command.at + self._staleness.slept - command.slept
        try:
            why = self._old_by_itself(command.message)
        except ValueError as error:  # the clock was set
            return str(error)
        if why or waited + command.message.age <= oldest:
            return why
        return f"it waited for its turn to be converted for {waited:.1f} s"

    def _drop_queued(self, origin: Session, why: str) -> None:
        """Carry out none of the client's queued commands."""
        for command in self._queued.get(origin, ()):
            command.why = command.why or why

    def _may_stop(self, message: Message) -> bool:
        """Whether it may be the route's stop message, by its size."""
        return len(message.payload) <= self._stop_size

    @property
    def _stop_size(self) -> int:
        stop = self.follower.publication.stop
        return 0 if stop is None else max(STOP_SIZE, STOP_BYTES * len(stop.example))

    def announced(self, message: Message, session: Session) -> None:
        """Record the pace of commands of QoS 2 without `sent-at`: it can be measured only now."""
        if self.rules.oldest == math.inf:
            return
        try:
            is_known = self._old_by_itself(message) or sent_at(message.properties) is not None
        except ValueError:
            return
        if not is_known:
            broker = self._context.broker
            number = broker.counters.messages_received
            self._staleness.observe_unreleased(session, self.rules.oldest, broker.now, number)

    def inspect(self, message: Message, session: Session) -> PublishRejection | None:
        try:
            why = self._old_by_itself(message)
        except ValueError as error:
            if self._is_accepted_late(message, session):
                return None
            return self._fail_and_reject(message, f"was refused: {error}")
        if not why:
            return super().inspect(message, session)
        if self._is_accepted_late(message, session):
            return None
        return self._expire(message, why, session)

    def _is_accepted_late(self, message: Message, session: Session) -> bool:
        """Whether it stops the robot, or may: a large one is examined in its turn."""
        if size_of(message.payload) > LITTLE:
            return self._may_stop(message)
        return self._is_late_stop(message, session)

    def _carry_out(
        self, message: Message, cdr: bytes, origin: Session | None, number: int
    ) -> PublishRejection | None:
        rejection = self._publish(cdr, message, origin, number)
        if rejection is None:
            self._on_commanded(cdr, origin)
        return rejection

    # Stale commands: see `StalenessDetector`

    def _old_by_itself(self, message: Message) -> str:
        """Why the message is stale by its own properties, else empty. ValueError: invalid ones."""
        expires_at = message.expires_at
        if expires_at is not None and expires_at <= self._context.broker.now:
            return "its message expiry is over"
        oldest = self.rules.oldest
        if oldest == math.inf:
            return ""
        age = stated_age(message.properties, time.time())
        if age is None or age <= oldest:
            return ""
        return f"it was sent {age:.1f} s before, by its {SENT_AT}"

    def _is_late_stop(self, message: Message, origin: Session | None) -> bool:
        """Whether a stale message stops the robot, and is carried out all the same.

        A message whose expiry interval is over is delivered to nobody [MQTT-3.3.2-5], not here
        either.
        """
        publication, expires_at = self.follower.publication, message.expires_at
        outlet = publication.outlet
        if outlet is None or publication.stop is None:
            return False
        if expires_at is not None and expires_at <= self._context.broker.now:
            return False
        try:
            return self.is_stop_message(super()._read(outlet, message, origin))
        except ConversionError:
            return False

    def _old_by_delivery(self, message: Message, retain: bool, origin: Session | None) -> str:
        """Why a message is stale by the way it was delivered; empty when that is not known."""
        rules = self.rules
        oldest = rules.oldest
        if oldest == math.inf or sent_at(message.properties) is not None:
            return ""
        # A will was made when its client connected. The age of a retained message is unknown
        # without a Message Expiry Interval.
        is_will = origin is not None and origin.link is None
        is_unknown = retain and rules.expire is not None and message.expires_at is None
        is_old = is_will or is_unknown or message.age > oldest
        return "it was sent some time before" if is_old else ""

    def _refuse(self, command: _Command, why: str) -> PublishRejection:
        if command.is_wrong:
            return self._fail_and_reject(command.message, f"was refused: {why}")
        return self._expire(command.message, why, command.origin)

    def _expire(self, message: Message, why: str, origin: Session | None) -> PublishRejection:
        self._count_expired(why, origin)
        return self.reject(message, f"{'may be' if why == STREAM_BEGINS else 'is too'} old: {why}")

    def _count_expired(self, why: str, origin: Session | None) -> None:
        if why == STREAM_BEGINS:
            self._log_limited("begins", "%s: of %s: %s", origin, why, level=logging.INFO)
            return
        self.counters.expired += 1
        self.counters.note_error(f"a command was too old: {why}")
        self._log_limited("expired", "%s: a command of %s was not published: %s", origin, why)

    def _hold(self, command: _Command, cdr: bytes, origin: Session) -> PublishRejection | None:
        """Hold a first command until it is known whether others follow."""
        message = command.message
        accounting = self._context.broker.accounting
        size = message.size + len(cdr)
        if not accounting.fits(origin.account, size):
            return self._fail_and_reject(
                message, "was refused: there is no memory for it to wait in"
            )
        accounting.take(origin.account, size)
        due = command.at + self._staleness.waiting_time(origin, self.rules.oldest)
        timer = self._wait_until(due, origin)
        self._pending[origin] = _PendingCommand(
            message, command.number, cdr, size, command.at, due, timer, command.slept
        )
        return None

    def _wait_until(self, when: float, origin: Session) -> asyncio.TimerHandle:
        return self._context.entries.at(
            "commands.wait",
            when,
            self._on_hold_over,
            origin,
            served=origin,
            failed=lambda: self._abandon_pending(origin, "it could not be carried out"),
        )

    def _take_pending(self, origin: Session) -> _PendingCommand | None:
        waiting = self._pending.pop(origin, None)
        if waiting is not None:
            waiting.timer.cancel()
            self._context.broker.accounting.take(origin.account, -waiting.size)
        return waiting

    def drop_pending(self, origin: Session, why: str) -> None:
        """PendingCommands: the command that is held is part of a queue."""
        self._drop_first(origin, why)

    def _drop_first(self, origin: Session, why: str) -> None:
        """Drop the first command of the client that is held or queued, if there is one."""
        if self._take_pending(origin) is not None:
            self._count_expired(why, origin)
        for command in self._queued.get(origin, ()):
            if command.verdict is CommandVerdict.WAIT:
                command.why = command.why or why

    def _abandon_pending(self, origin: Session, why: str) -> None:
        """Drop what is held, though not as part of a queue: the next may be a first one."""
        self._drop_first(origin, why)
        self._settle(origin)

    def _on_hold_over(self, origin: Session) -> None:
        """Nothing has followed the first command, unless something has come and is unread."""
        now = self._context.entries.time()
        waiting = self._pending[origin]
        self._context.broker.accounting.now = now
        if self._staleness.slept != waiting.slept:
            self._abandon_pending(origin, "the computer has slept since it came")
            return
        peer = LOCAL_PEER if origin.link is None else origin.link.peer_status()
        # The unread messages need not be commands.
        if peer.has_unread or peer.flowing >= now - waiting.came_at:
            if now < waiting.due + self.rules.oldest:
                waiting.timer = self._wait_until(now + READ_INTERVAL, origin)
            else:
                self._abandon_pending(origin, "what came with it was read late")
            return
        self._staleness.remove_pending(origin, self)
        self._carry_out_pending(origin)

    def _carry_out_pending(self, origin: Session) -> None:
        waiting = self._take_pending(origin)
        if waiting is None:
            return
        if self._lease.is_overtaken(waiting.number, origin):
            self._count_expired(OVERTAKEN, origin)
        elif self.decide(origin):
            self._carry_out(waiting.message, waiting.cdr, origin, waiting.number)
        else:
            self.counters.refused += 1

    def _read(self, outlet: Outlet, message: Message, origin: Session | None) -> bytes:
        cdr = super()._read(outlet, message, origin)
        limits = outlet.limits
        if limits is None:
            return cdr
        try:
            limited, has_changed = limits.apply(cdr)
        except ConversionError as error:
            if self.is_stop_message(cdr):
                return cdr
            raise RuleViolationError("", f"it is against the route's rules: {error}") from None
        if has_changed:
            if self.is_stop_message(cdr):  # clamped, it might move the robot
                return cdr
            self.counters.clamped += 1
            self._log_limited("clamped", "%s: numbers in a command of %s were clamped", origin)
        return limited

    def _on_commanded(self, cdr: bytes, origin: Session | None) -> None:
        now = self._context.entries.time()
        lease = self._lease
        self._commanded_at = now
        self._source = origin
        stop = self.follower.publication.stop
        self._is_driven = stop is not None and cdr != stop.example
        if origin is not None and origin.link is not None:
            self._probed.pop(origin, None)
            if self._is_driven:
                self._drivers[origin] = cdr, now
            else:
                self._drivers.pop(origin, None)
        self._has_stopped = True  # it is too late for the initial stop message
        self._must_stop = False
        self._awaited = None
        is_free = self.rules.exclusive and lease.holder is None
        # A stop does not take the lease: it may come from a stale queue, too.
        if is_free and origin is not None and origin.link and not self.is_stop_message(cdr):
            lease.holder = origin
            self._context.broker.guards_changed()
            self._log(logging.INFO, "%s: %s commands now, alone", self, origin)
        if origin is lease.holder:
            lease.commanded_at = now
        # The timer may be set for something later: a lease that began with zeros, or another's.
        if self._timer is None or self._first_due() < self._timer.when():
            self._arm()

    # Leases

    @property
    def commanding(self) -> str | None:
        holder = self._lease.holder if self.rules.exclusive else None
        return None if holder is None else holder.client_id

    @property
    def is_exclusive(self) -> bool:
        """CommandRoute: whether only one client at a time may command."""
        return self.rules.exclusive

    def watch(self) -> None:
        """CommandRoute: watch for the lease's holder being silent for too long."""
        self._arm()

    def _share_lease(self) -> None:
        self._part_with_lease()
        super()._share_lease()
        if not self._is_left:
            self._lease.add_route(self)
            self._joined = self._lease

    def _part_with_lease(self) -> None:
        joined, self._joined = self._joined, None
        if joined is not None:
            joined.remove_route(self)
            self._context.broker.guards_changed()

    def _release(self, why: str) -> None:
        holder, self._lease.holder = self._lease.holder, None
        self._context.broker.guards_changed()
        self._log(logging.INFO, "%s: %s %s and commands no more", self, holder, why)

    # Silence

    def _departed(self, session: Session) -> None:
        if session.ended_well:
            # No queue is behind its last command: `mosquitto_pub` and the like.
            self._carry_out_pending(session)
            for command in self._queued.get(session, ()):
                command.has_left = True
                if command.verdict is CommandVerdict.WAIT:
                    command.verdict = CommandVerdict.CARRY_OUT
        else:
            self._drop_first(session, "its connection was lost")
            self._drop_queued(session, "its connection was lost")
        self._probed.pop(session, None)
        if self.rules.exclusive and session is self._lease.holder:
            self._release("has left")
        self._stop_after(session)
        driven = self._drivers.pop(session, None)
        if driven is not None and not self._is_at_rest(driven[0]):
            # Its library may have queued commands since, and marks none of them as stale.
            self._staleness.expect_replay(session.client_id)

    def is_stop_message(self, cdr: bytes) -> bool:
        """Whether it is the route's stop message, or equivalent to it."""
        stop = self.follower.publication.stop
        return stop is not None and (cdr == stop.example or stop.is_like(cdr))

    def _is_at_rest(self, cdr: bytes) -> bool:
        """Whether a client whose last command it was does not drive."""
        return self.rules.on_silence is None or self.is_stop_message(cdr)

    def _first_due(self) -> float:
        """When the silence since the last command, or of the lease's holder, becomes too long."""
        rules = self.rules
        due = math.inf
        if self._is_driven and rules.on_silence is not None:
            due = self._commanded_at + rules.on_silence.after
        if rules.exclusive and self._lease.holder is not None:
            due = min(due, self._lease.commanded_at + rules.lease)
        return due

    def _arm(self) -> None:
        """Set the timer to when the next check is due."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        rules = self.rules
        due = self._first_due()
        if rules.on_silence is not None and rules.on_silence.disconnect:
            commanded_at = min((at for _, at in self._drivers.values()), default=math.inf)
            due = min(due, commanded_at + rules.on_silence.after)
        if self._probed:
            due = min(due, self._context.entries.time() + PROBE_INTERVAL)
        if due < math.inf:
            entries = self._context.entries
            self._timer = entries.at(
                "commands.check",
                max(due, entries.time()),
                self._check,
                served=self,
                failed=self._check_later,
            )

    def _check(self) -> None:
        self._timer = None
        now = self._context.entries.time()
        silence = now - self._commanded_at
        on_silence = self.rules.on_silence
        lease = self._lease
        is_over = (
            self.rules.exclusive
            and lease.holder is not None
            and now - lease.commanded_at >= self.rules.lease
        )
        if is_over:
            self._release(f"was silent for {self.rules.lease:g} s")
        if self._is_driven and on_silence is not None:
            if self._must_stop:
                self._publish_stop("at last")
            elif is_over or silence >= on_silence.after:
                who = self._source or "a retained command"
                after = min(silence, on_silence.after)
                self._stop_now(f"{who} fell silent for {after:g} s")
        if on_silence is not None and on_silence.disconnect:
            self._probe_silent(min(silence, on_silence.after) if is_over else on_silence.after)
            self._disconnect_silent()
        if self._timer is None:
            self._arm()

    def _probe_silent(self, after: float) -> None:
        """Probe clients that drove and have been silent for so long, also if others drive on."""
        now = self._context.entries.time()
        for session, (cdr, at) in self._drivers.items():
            if at > now - after:
                continue
            self._drivers[session] = cdr, math.inf
            if not self._is_at_rest(cdr) and session.link is not None:
                self._probed[session] = now
                session.link.probe()

    def _disconnect_silent(self) -> None:
        """Disconnect clients whose computer does not answer: the network may hold their commands.

        Those are stale when they come, and nothing in them shows it; a new connection carries none
        of them. If the computer answers, nothing is on its way.
        """
        now = self._context.entries.time()
        has_closed = False
        for session, asked in list(self._probed.items()):
            link = session.link
            if link is None or link.peer_status().silence + CLOCK_TOLERANCE < now - asked:
                del self._probed[session]
            elif now - asked >= PROBE_TIMEOUT:
                del self._probed[session]
                has_closed = True
                session.close_link(
                    ReasonCode.ADMINISTRATIVE_ACTION,
                    f"it drove {self.ros} and fell silent, and its computer does not answer "
                    "(on_silence.disconnect)",
                )
        if has_closed:
            self._context.broker.flush()

    def on_found(self) -> None:
        if self._is_left:
            return
        if not self._has_stopped:
            # It stops what was before the route, and overtakes nothing that has come since.
            level = logging.WARNING if self._is_driven else logging.INFO
            self._publish_stop("there is somebody to hear it", level)
        awaited, self._awaited = self._awaited, None
        if awaited is None:
            return
        if self._lease.is_overtaken(awaited, None):
            self._count_expired(OVERTAKEN, None)
            return
        # The message that is retained now: it may have been replaced, or deleted.
        message = self._context.broker.retained.get(self.mqtt)
        if message is not None:
            self.receive(message, True, None, awaited)

    def _stop_now(self, why: str) -> None:
        """Publish the stop message; no command that has come until now is carried out any more."""
        self._lease.stop(self._staleness.number + 1)
        self._publish_stop(why)

    def _publish_stop(self, why: str, level: int = logging.WARNING) -> None:
        """Publish the stop message now, or as soon as ROS takes it."""
        publication = self.follower.publication
        outlet, stop = publication.outlet, publication.stop
        if stop is None or (outlet is None and self._is_left):
            self._is_driven = False
            return
        if outlet is None:  # the publisher is being set up anew
            self._stop_later()
            return
        try:
            cdr = stop.cdr()
            if publication.echo is not None:
                publication.echo.sent(cdr)
            outlet.publisher.publish(cdr)
        except BusError as error:
            self._cannot_stop(error)
            return
        except Exception as error:  # whatever has failed, the robot has to stop
            self._context.broker.faults.caught("commands.stop", error, self)
            self._cannot_stop(error)
            return
        self._is_driven = self._must_stop = False
        self._has_stopped = publication.is_found
        self.counters.stops += 1
        # Each level by itself: what is no news keeps no warning from the log.
        what = f"stopped at level {level}"
        self._log_limited(what, "%s: the stop message was published: %s", why, level=level)

    def _cannot_stop(self, error: Exception) -> None:
        self.fail(f"that stops could not be published: {error}")
        if not self._is_left:
            self._stop_later()

    def _stop_later(self) -> None:
        self._is_driven = self._must_stop = True
        if self._timer is not None:
            self._timer.cancel()
        self._check_later()

    def _check_later(self) -> None:
        self._timer = self._context.entries.later(
            "commands.check", RETRY, self._check, served=self, failed=self._check_later
        )

    # The log

    def _log_limited(
        self, what: str, text: str, *args: object, level: int = logging.WARNING
    ) -> None:
        """Log something that may happen with every message at most once a minute."""
        now = self._context.entries.time()
        if now >= self._logged.get(what, -math.inf):
            self._logged[what] = now + LOG_INTERVAL
            self._log(level, text, self, *args)
