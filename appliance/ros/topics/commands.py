"""From MQTT to ROS for what moves a robot: old commands expire, one client commands at a time, and
who falls silent or leaves is followed by a stop message.

All of it happens on the loop's thread, but for the look at the graph and what that sets up.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from appliance.broker.message import Message
from appliance.broker.ports import LOCAL_PEER, PublishRejection
from appliance.broker.session import Session
from appliance.mqtt.reason import ReasonCode
from appliance.ros.node import BusError, QosProfile, RosNode
from appliance.ros.payload.converter import ConversionError, Converter, Converters
from appliance.ros.payload.payloads import unpacked_size
from appliance.ros.topics.conversions import LITTLE, size_of
from appliance.ros.topics.flow import REPORT_INTERVAL, BridgeRoute, LogFunction
from appliance.ros.topics.lease import OVERTAKEN, Lease
from appliance.ros.topics.rules import CommandRules, FieldLimits
from appliance.ros.topics.staleness import (
    BEGINS,
    QUEUED,
    SENT_AT,
    CommandVerdict,
    said_age,
    sent_at,
)
from appliance.ros.topics.to_ros import RuleViolationError, ToRos, ToRosContext

#: Seconds until a stop message that ROS would not take is published again.
RETRY = 0.05

#: Looks at the graph from the first that finds a subscription until the stop message of the start:
#: the two ends have found each other by then.
LOOKS_TO_MATCH = 2

#: Seconds that the computer of a client that has fallen silent has to answer: two probes, of which
#: the first may come a second after the silence began. And between two looks whether it has.
ANSWERED = 2.5
LOOK_AGAIN = 0.1

#: What the system's clocks for that differ by, in seconds.
COARSE = 0.02

#: Seconds until it is looked again whether what a client has sent has been read.
READ_SOON = 0.01


#: Bytes of a payload up to which it may be a stop message: so many for each byte of the message in
#: CDR, names and digits and white space, and never less than the other.
STOP_BYTES = 64
STOP_SIZE = 16 * 1024


@dataclass(slots=True)
class _Waiting:
    """A first command, converted, that waits whether there is a queue behind it."""

    message: Message
    number: int
    cdr: bytes
    #: What of it is counted, in bytes.
    size: int
    came_at: float
    due: float
    timer: asyncio.TimerHandle


@dataclass(slots=True, eq=False)
class _Command:
    """A command that has come at `at`, and what is known of it before it is converted."""

    message: Message
    origin: Session | None
    #: Of `StalenessDetector`: which of two came first, on whatever topics.
    number: int
    at: float
    verdict: CommandVerdict
    #: Why it is not to be carried out, if it does not stop the robot.
    why: str
    #: What it was converted to, where that is known before its turn.
    cdr: bytes = b""
    #: What is said where its verdict refuses it.
    refusal: str = QUEUED
    #: Whether its client has ended its connection in good order since.
    has_left: bool = False
    #: Whether what it says of its age is wrong, and `why` says so.
    is_wrong: bool = False

    @property
    def is_to_come(self) -> bool:
        """Whether it is to be carried out, though its client has left."""
        return self.has_left and not self.why and self.verdict is CommandVerdict.CARRY_OUT


class _Stop:
    """The stop message of a route, for one type."""

    def __init__(self, converter: Converter, payload: str) -> None:
        """Raises ConversionError when the type has no such message."""
        self._converter = converter
        self._payload = payload.encode()
        self.example = self.cdr()
        self._says = self._said_by(self.example)

    def cdr(self) -> bytes:
        """The message, made anew: it may say "now"."""
        return self._converter.from_json(self._payload)

    def is_like(self, cdr: bytes) -> bool:
        """Whether a message says the same, at another time or in another frame."""
        if abs(len(cdr) - len(self.example)) > LITTLE:
            return False  # as long as no frame's name is
        try:
            return self._said_by(cdr) == self._says
        except ConversionError:  # of another type, from before a reload or of another route
            return False

    def _said_by(self, cdr: bytes) -> dict[str, object]:
        fields = self._converter.to_dict(cdr)
        return {name: value for name, value in fields.items() if name != "header"}


def check_rules(
    rules: CommandRules, converter: Converter
) -> tuple[FieldLimits | None, _Stop | None]:
    """The limits and the stop message of a route for messages of one type.

    Raises ConversionError for what the type has not, or cannot be.
    """
    limits = FieldLimits(rules, converter) if rules.clamp or rules.allow else None
    stop = None
    if rules.on_silence is not None:
        try:
            stop = _Stop(converter, rules.on_silence.publish)
        except ConversionError as error:
            raise ConversionError("on_silence.publish", str(error)) from None
    return limits, stop


class Commands(ToRos):
    """A flow to ROS with rules."""

    def __init__(
        self,
        route: BridgeRoute,
        ros: str,
        converters: Converters,
        log: LogFunction,
        around: ToRosContext,
    ) -> None:
        super().__init__(route, ros, converters, log, around)
        assert route.settings.rules is not None
        self.rules: CommandRules = route.settings.rules
        #: Both replaced as one by the ROS thread.
        self._limits: FieldLimits | None = None
        self._stop: _Stop | None = None
        #: Looks that have found a subscription, since there is this publisher.
        self._looks = 0
        #: Who sent the last command, and when.
        self._source: Session | None = None
        self._heard_at = -math.inf
        #: Whether something else than the stop message was published last.
        self._is_driven = False
        #: What those who are connected commanded last, and when, where it was something else; at
        #: infinity when they have fallen silent since.
        self._drivers: dict[Session, tuple[bytes, float]] = {}
        self._has_stopped = False
        self._arrivals = around.arrivals
        #: The lease that the route has joined.
        self._joined: Lease | None = None
        #: First commands of clients, see `StalenessDetector`.
        self._waiting: dict[Session, _Waiting] = {}
        #: Large commands that wait for their turn to be converted, and what is behind them.
        self._queued: dict[Session | None, deque[_Command]] = {}
        #: Who fell silent while it drove, and when its computer was asked for an answer.
        self._asked: dict[Session, float] = {}
        #: Whether a stop message is overdue, which ROS would not take.
        self._must_stop = False
        #: The number of the topic's retained message, where it came before there was anybody on ROS
        #: to have it.
        self._awaited: int | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._told: dict[str, float] = {}

    # The ROS thread

    def poll_graph(self, node: RosNode, thorough: bool) -> bool:
        has_changed = super().poll_graph(node, thorough)
        if self._looks < LOOKS_TO_MATCH and self._out is not None and node.count(self.ros)[1]:
            self._looks += 1
            if self._looks == LOOKS_TO_MATCH:
                self._around.post(self._begin)
        return has_changed

    def _open(self, node: RosNode, type_name: str, qos: QosProfile, type_hash: str | None) -> str:
        rules = self.rules
        converter = self._converters.get(type_name)
        self._limits, self._stop = check_rules(rules, converter)
        # Another publisher has not been found by anybody: as at the route's beginning, a stop
        # message that it sends now may be lost, and is sent again.
        self._looks = 0
        return super()._open(node, type_name, qos, type_hash)

    # The loop's thread

    def enter(self, before: ToRos | None) -> None:
        super().enter(before)
        self._around.broker.departures.append(self._departed)
        if isinstance(before, Commands):
            # What the network has of their commands, or a client that is away, is as old here.
            self._drivers = before._drivers
            self._arm()

    def leave(self) -> None:
        if self._is_left:
            return
        super().leave()
        for origin in list(self._waiting):
            self._give_up(origin, "the route ends")
        if self._is_driven:
            self._stop_now("the route ends")
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._around.broker.departures.remove(self._departed)
        self._part_with_lease()
        self._source = None

    def receive(
        self, message: Message, retain: bool, origin: Session | None, number: int
    ) -> PublishRejection | None:
        """What is known of a command when it comes is judged then; a large one is converted when it
        is its turn, and what is wrong with it is returned only if that is now.
        """
        if self._is_left or (retain and not self.rules.take_retained):
            return None
        command = self._judge(message, retain, origin, number)
        is_refused = command.why or command.verdict is CommandVerdict.REFUSE
        if is_refused and not self._may_stop(message):
            return self._refuse(command, command.why or command.refusal)
        is_kept = retain or (message.retain and self.rules.take_retained)
        if is_kept and (self._out is None or self._looks < LOOKS_TO_MATCH):
            self._awaited = number
            self._settle(origin)
            return None
        size = size_of(message.payload)
        if size <= LITTLE and origin not in self._queued:
            return self._finish(command)
        turns = self._around.turns
        if size <= LITTLE:
            return self._do_behind_its_own(command)
        if not turns.is_busy and not turns.waits(origin):
            return turns.now(partial(self._finish, command))
        return self._queue(command, size)

    def _judge(
        self, message: Message, retain: bool, origin: Session | None, number: int
    ) -> _Command:
        """What is to become of it, as far as that is known without a look into the payload."""
        # When it was received: what came in one chunk came at once, however long it takes.
        now = self._around.broker.now
        verdict = CommandVerdict.CARRY_OUT
        refusal = QUEUED
        try:
            why = self._old_by_itself(message) or self._old_by_its_way(message, retain, origin)
            is_proven = sent_at(message.properties) is not None
        except ValueError as error:  # unless it stops the robot, which is seen in its payload
            return _Command(message, origin, number, now, verdict, str(error), is_wrong=True)
        if origin is not None:
            if why and origin.link is not None:
                self._forget(origin, why)
                self._arrivals.is_old(origin, now)
            elif not why and not is_proven and self.rules.oldest < math.inf:
                verdict = self._arrivals.judge(origin, message.qos, self.rules.oldest, now, number)
                if verdict is CommandVerdict.REFUSE:
                    refusal = self._arrivals.why(origin)
            # What waits would be overtaken by it.
            self._forget(origin, why or refusal)
            if verdict is CommandVerdict.WAIT:
                self._arrivals.waits(origin, self)
        return _Command(message, origin, number, now, verdict, why, refusal=refusal)

    def _finish(self, command: _Command) -> PublishRejection | None:
        """Convert it and carry it out, if that is still to be; what the appliance itself fails in
        is told of as well."""
        try:
            return self._convert_and_carry_out(command)
        except Exception as error:
            return self.fault(command.message, error)
        finally:
            self._settle(command.origin)

    def _settle(self, origin: Session | None) -> None:
        """Something has become of a command: if it was a first one, the next one of its client is
        no queue with it, unless it waits here."""
        if origin is None or origin in self._waiting:
            return
        queue = self._queued.get(origin, ())
        if not any(one.verdict is CommandVerdict.WAIT and not one.why for one in queue):
            self._arrivals.waited(origin, self)

    def _convert_and_carry_out(self, command: _Command) -> PublishRejection | None:
        message, origin = command.message, command.origin
        if command.why and not self._is_late_stop(message, origin):
            return self._refuse(command, command.why)
        cdr = command.cdr or self._convert(message, origin)
        verdict = command.verdict
        if isinstance(cdr, PublishRejection):
            return cdr
        if verdict is not CommandVerdict.CARRY_OUT and self.stops(cdr):
            # Who says stop is heard at once, whatever comes with it.
            verdict = CommandVerdict.CARRY_OUT
        if origin is not None and verdict is CommandVerdict.REFUSE:
            return self._expire(message, command.refusal, origin)
        if origin is not None and verdict is CommandVerdict.WAIT:
            return self._let_wait(command, cdr, origin)
        return self._carry_out(message, cdr, origin, command.number)

    # Large commands, which wait for their turn to be converted

    def _queue(self, command: _Command, size: int) -> PublishRejection | None:
        message, origin = command.message, command.origin
        turns = self._around.turns
        if not turns.has_room(origin, size):
            if self._may_stop(message) and unpacked_size(message.payload) <= self._stop_size:
                # A stop is heard whoever fills the queue; the time it takes is its client's.
                cdr = turns.now(partial(self._convert, message, origin))
                if isinstance(cdr, PublishRejection):
                    return cdr
                if cdr is not None and self.stops(cdr):
                    command.cdr = cdr
                    return self._finish(command)
            self._settle(origin)
            why = "was refused: too much of its user waits to be converted"
            return self._fail_and_reject(message, why, ReasonCode.QUOTA_EXCEEDED)
        self._queued.setdefault(origin, deque()).append(command)
        turns.do(origin, size, partial(self._have_turn, command))
        return None

    def _do_behind_its_own(self, command: _Command) -> PublishRejection | None:
        """A small command whose client has large ones queued waits for these, unless it stops: then
        it is they that come too late."""
        message, origin = command.message, command.origin
        cdr = self._convert(message, origin)
        if isinstance(cdr, PublishRejection):
            return cdr
        command.cdr = cdr
        if self.stops(cdr):
            return self._finish(command)
        return self._queue(command, max(len(cdr), len(message.payload)))

    def _have_turn(self, command: _Command) -> None:
        """It is the turn of a command that was queued: is it still to be carried out?"""
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
            self._stop_behind(origin)
        self._settle(origin)

    def _stop_behind(self, origin: Session) -> None:
        """Its connection has ended: the robot is stopped behind the last of its commands."""
        queue = self._queued.get(origin, ())
        if origin is not self._source or any(one.is_to_come for one in queue):
            return
        self._source = None
        if self._is_driven:
            self._stop_now(f"{origin} has left")

    def _why_late(self, command: _Command) -> str:
        """Why a command that was new has become too old in the queue; empty when it has not."""
        if self._lease.is_overtaken(command.number, command.origin):
            return OVERTAKEN
        oldest = self.rules.oldest
        waited = self._around.entries.time() - command.at
        try:
            why = self._old_by_itself(command.message)
        except ValueError as error:  # the clock was set
            return str(error)
        if why or waited + command.message.age <= oldest:
            return why
        return f"it waited for its turn to be converted for {waited:.1f} s"

    def _drop_queued(self, origin: Session, why: str) -> None:
        """None of the client's commands that wait for their turn is carried out."""
        for command in self._queued.get(origin, ()):
            command.why = command.why or why

    def _may_stop(self, message: Message) -> bool:
        """Whether it can be the route's stop message, by its size."""
        return len(message.payload) <= self._stop_size

    @property
    def _stop_size(self) -> int:
        stop = self._stop
        return 0 if stop is None else max(STOP_SIZE, STOP_BYTES * len(stop.example))

    def announced(self, message: Message, session: Session) -> None:
        """How commands of QoS 2 come can be told now only, where they do not say how old they are
        themselves."""
        if self.rules.oldest == math.inf:
            return
        try:
            is_known = self._old_by_itself(message) or sent_at(message.properties) is not None
        except ValueError:
            return
        if not is_known:
            broker = self._around.broker
            number = broker.counters.messages_received
            self._arrivals.look(session, self.rules.oldest, broker.now, number)

    def inspect(self, message: Message, session: Session) -> PublishRejection | None:
        try:
            why = self._old_by_itself(message)
        except ValueError as error:
            if self._is_heard_late(message, session):
                return None
            return self._fail_and_reject(message, f"was refused: {error}")
        if not why:
            return super().inspect(message, session)
        if self._is_heard_late(message, session):
            return None
        return self._expire(message, why, session)

    def _is_heard_late(self, message: Message, session: Session) -> bool:
        """Whether it stops the robot, or may: a large one is looked at when it is its turn."""
        if size_of(message.payload) > LITTLE:
            return self._may_stop(message)
        return self._is_late_stop(message, session)

    def _carry_out(
        self, message: Message, cdr: bytes, origin: Session | None, number: int
    ) -> PublishRejection | None:
        rejection = self._publish(cdr, message, origin, number)
        if rejection is None:
            self._commanded(cdr, origin)
        return rejection

    # Old commands: see `StalenessDetector`

    def _old_by_itself(self, message: Message) -> str:
        """Why the message is too old, as it says; empty when it is not. ValueError: nonsense."""
        expires_at = message.expires_at
        if expires_at is not None and expires_at <= self._around.broker.now:
            return "its message expiry is over"
        oldest = self.rules.oldest
        if oldest == math.inf:
            return ""
        age = said_age(message.properties, time.time())
        if age is None or age <= oldest:
            return ""
        return f"it was sent {age:.1f} s before, by its {SENT_AT}"

    def _is_late_stop(self, message: Message, origin: Session | None) -> bool:
        """Whether a message that is too old stops the robot, and is carried out all the same.

        What MQTT itself has expired is delivered to nobody [MQTT-3.3.2-5], also not here.
        """
        out, expires_at = self._out, message.expires_at
        if out is None or self._stop is None:
            return False
        if expires_at is not None and expires_at <= self._around.broker.now:
            return False
        try:
            return self.stops(super()._read(out[0], message, origin))
        except ConversionError:
            return False

    def _old_by_its_way(self, message: Message, retain: bool, origin: Session | None) -> str:
        """Why a message that does not say so is too old; empty when that is not known."""
        rules = self.rules
        oldest = rules.oldest
        if oldest == math.inf or sent_at(message.properties) is not None:
            return ""
        # A will was handed over when its client connected. Without a Message Expiry Interval
        # nobody knows how old a retained message is.
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
        return self.reject(message, f"{'may be' if why == BEGINS else 'is too'} old: {why}")

    def _count_expired(self, why: str, origin: Session | None) -> None:
        if why == BEGINS:
            self._mention("begins", "%s: of %s: %s", origin, why, level=logging.INFO)
            return
        self.counters.expired += 1
        self.counters.last_error = f"a command was too old: {why}"
        self._mention("expired", "%s: a command of %s was not published: %s", origin, why)

    def _let_wait(self, command: _Command, cdr: bytes, origin: Session) -> PublishRejection | None:
        """Keep a first command until it is known whether others are behind it."""
        message = command.message
        accounting = self._around.broker.accounting
        size = message.size + len(cdr)
        if not accounting.fits(origin.account, size):
            return self._fail_and_reject(
                message, "was refused: there is no memory for it to wait in"
            )
        accounting.take(origin.account, size)
        due = command.at + self._arrivals.waiting_time(origin, self.rules.oldest)
        timer = self._wait_until(due, origin)
        waiting = _Waiting(message, command.number, cdr, size, command.at, due, timer)
        self._waiting[origin] = waiting
        return None

    def _wait_until(self, when: float, origin: Session) -> asyncio.TimerHandle:
        return self._around.entries.at(
            "commands.wait",
            when,
            self._has_waited,
            origin,
            served=origin,
            failed=lambda: self._give_up(origin, "it could not be carried out"),
        )

    def _wait_no_longer(self, origin: Session) -> _Waiting | None:
        waiting = self._waiting.pop(origin, None)
        if waiting is not None:
            waiting.timer.cancel()
            self._around.broker.accounting.take(origin.account, -waiting.size)
        return waiting

    def drop_waiting(self, origin: Session, why: str) -> None:
        """As `StalenessDetector` has it: what waits is of a queue."""
        self._forget(origin, why)

    def _forget(self, origin: Session, why: str) -> None:
        """A first command that waits is not carried out, if there is one."""
        if self._wait_no_longer(origin) is not None:
            self._count_expired(why, origin)
        for command in self._queued.get(origin, ()):
            if command.verdict is CommandVerdict.WAIT:
                command.why = command.why or why

    def _give_up(self, origin: Session, why: str) -> None:
        """What waits is dropped, and not for what came behind it: the next may be a first one."""
        self._forget(origin, why)
        self._settle(origin)

    def _has_waited(self, origin: Session) -> None:
        """Nothing has followed the first command, unless it has come and was not read yet."""
        now = self._around.entries.time()
        waiting = self._waiting[origin]
        self._around.broker.accounting.now = now
        peer = LOCAL_PEER if origin.link is None else origin.link.peer_status()
        # What comes with it may be something else than commands.
        if peer.has_unread or peer.flowing >= now - waiting.came_at:
            if now < waiting.due + self.rules.oldest:
                waiting.timer = self._wait_until(now + READ_SOON, origin)
            else:
                self._give_up(origin, "what came with it was read late")
            return
        self._arrivals.waited(origin, self)
        self._carry_out_waiting(origin)

    def _carry_out_waiting(self, origin: Session) -> None:
        waiting = self._wait_no_longer(origin)
        if waiting is None:
            return
        if self._lease.is_overtaken(waiting.number, origin):
            self._count_expired(OVERTAKEN, origin)
        elif self.decide(origin):
            self._carry_out(waiting.message, waiting.cdr, origin, waiting.number)
        else:
            self.counters.refused += 1

    def _read(
        self, convert: Callable[[bytes], bytes], message: Message, origin: Session | None
    ) -> bytes:
        cdr = super()._read(convert, message, origin)
        if self._limits is None:
            return cdr
        try:
            limited, has_changed = self._limits.apply(cdr)
        except ConversionError as error:
            if self.stops(cdr):
                return cdr
            raise RuleViolationError("", f"it is against the route's rules: {error}") from None
        if has_changed:
            if self.stops(cdr):  # clamped, it might move the robot
                return cdr
            self.counters.clamped += 1
            self._mention("clamped", "%s: numbers in a command of %s were clamped", origin)
        return limited

    def _commanded(self, cdr: bytes, origin: Session | None) -> None:
        now = self._around.entries.time()
        lease = self._lease
        self._heard_at = now
        self._source = origin
        self._is_driven = self._stop is not None and cdr != self._stop.example
        if origin is not None and origin.link is not None:
            self._asked.pop(origin, None)
            if self._is_driven:
                self._drivers[origin] = cdr, now
            else:
                self._drivers.pop(origin, None)
        self._has_stopped = True  # the stop message of the start would come late
        self._must_stop = False
        self._awaited = None
        is_free = self.rules.exclusive and lease.holder is None
        # Who stops does not command: a stop is let through from an old queue as well.
        if is_free and origin is not None and origin.link and not self.stops(cdr):
            lease.holder = origin
            self._around.broker.guards_changed()
            self._log(logging.INFO, "%s: %s commands now, alone", self, origin)
        if origin is lease.holder:
            lease.heard_at = now
        # Also when it waits for something later: a lease that began with zeros, or another's.
        if self._timer is None or self._first_due() < self._timer.when():
            self._arm()

    # Leases

    @property
    def commanding(self) -> str | None:
        holder = self._lease.holder if self.rules.exclusive else None
        return None if holder is None else holder.client_id

    @property
    def is_exclusive(self) -> bool:
        """As `Lease` has it: whether one client commands at a time."""
        return self.rules.exclusive

    def watch(self) -> None:
        """As `Lease` has it: look when its holder has been silent for too long."""
        self._arm()

    def _share_lease(self) -> None:
        self._part_with_lease()
        super()._share_lease()
        if not self._is_left:
            self._lease.join(self)
            self._joined = self._lease

    def _part_with_lease(self) -> None:
        joined, self._joined = self._joined, None
        if joined is not None:
            joined.part(self)
            self._around.broker.guards_changed()

    def _release(self, why: str) -> None:
        holder, self._lease.holder = self._lease.holder, None
        self._around.broker.guards_changed()
        self._log(logging.INFO, "%s: %s %s and commands no more", self, holder, why)

    # Silence

    def _departed(self, session: Session) -> None:
        if session.ended_well:
            # Nothing was behind it: `mosquitto_pub` and the like.
            self._carry_out_waiting(session)
            for command in self._queued.get(session, ()):
                command.has_left = True
                if command.verdict is CommandVerdict.WAIT:
                    command.verdict = CommandVerdict.CARRY_OUT
        else:
            self._forget(session, "its connection was lost")
            self._drop_queued(session, "its connection was lost")
        self._asked.pop(session, None)
        if self.rules.exclusive and session is self._lease.holder:
            self._release("has left")
        self._stop_behind(session)
        driven = self._drivers.pop(session, None)
        if driven is not None and not self._is_stop(driven[0]):
            # Its library may have queued what it commanded since, and marks none of it as old.
            self._arrivals.expect(session.client_id)

    def stops(self, cdr: bytes) -> bool:
        """Whether it is the route's stop message, or says the same."""
        stop = self._stop
        return stop is not None and (cdr == stop.example or stop.is_like(cdr))

    def _is_stop(self, cdr: bytes) -> bool:
        """Whether who said it last does not drive."""
        return self.rules.on_silence is None or self.stops(cdr)

    def _first_due(self) -> float:
        """When the silence since the last command, or of the lease's holder, is too long."""
        rules = self.rules
        due = math.inf
        if self._is_driven and rules.on_silence is not None:
            due = self._heard_at + rules.on_silence.after
        if rules.exclusive and self._lease.holder is not None:
            due = min(due, self._lease.heard_at + rules.lease)
        return due

    def _arm(self) -> None:
        """Look when something may be due, and not later."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        rules = self.rules
        due = self._first_due()
        if rules.on_silence is not None and rules.on_silence.disconnect:
            heard_at = min((at for _, at in self._drivers.values()), default=math.inf)
            due = min(due, heard_at + rules.on_silence.after)
        if self._asked:
            due = min(due, self._around.entries.time() + LOOK_AGAIN)
        if due < math.inf:
            entries = self._around.entries
            self._timer = entries.at(
                "commands.check",
                max(due, entries.time()),
                self._check,
                served=self,
                failed=self._check_later,
            )

    def _check(self) -> None:
        self._timer = None
        now = self._around.entries.time()
        silence = now - self._heard_at
        on_silence = self.rules.on_silence
        lease = self._lease
        is_over = (
            self.rules.exclusive
            and lease.holder is not None
            and now - lease.heard_at >= self.rules.lease
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
            self._ask_silent(min(silence, on_silence.after) if is_over else on_silence.after)
            self._disconnect_silent()
        if self._timer is None:
            self._arm()

    def _ask_silent(self, after: float) -> None:
        """Who drove and has said nothing for so long, also when others drive on: is it there?"""
        now = self._around.entries.time()
        for session, (cdr, at) in self._drivers.items():
            if at > now - after:
                continue
            self._drivers[session] = cdr, math.inf
            if not self._is_stop(cdr) and session.link is not None:
                self._asked[session] = now
                session.link.probe()

    def _disconnect_silent(self) -> None:
        """Disconnect whose computer does not answer: the network may have a heap of commands.

        They are old when they come, and nothing in them says so; on a new connection there are
        none of them. Where the computer answers, nothing is on its way.
        """
        now = self._around.entries.time()
        has_closed = False
        for session, asked in list(self._asked.items()):
            link = session.link
            if link is None or link.peer_status().silence + COARSE < now - asked:
                del self._asked[session]
            elif now - asked >= ANSWERED:
                del self._asked[session]
                has_closed = True
                session.close_link(
                    ReasonCode.ADMINISTRATIVE_ACTION,
                    f"it drove {self.ros} and fell silent, and its computer does not answer "
                    "(on_silence.disconnect)",
                )
        if has_closed:
            self._around.broker.flush()

    def _begin(self) -> None:
        """There is somebody on ROS to have a message."""
        if self._is_left:
            return
        if not self._has_stopped:
            # It is for what was before the route, and overtakes nothing that has come since.
            self._publish_stop("there is somebody to hear it")
        awaited, self._awaited = self._awaited, None
        if awaited is None:
            return
        if self._lease.is_overtaken(awaited, None):
            self._count_expired(OVERTAKEN, None)
            return
        # What is retained now: it may have been replaced, or taken back.
        message = self._around.broker.retained.get(self.mqtt)
        if message is not None:
            self.receive(message, True, None, awaited)

    def _stop_now(self, why: str) -> None:
        """Publish the stop message: nothing that has come until now is carried out any more."""
        self._lease.stop(self._arrivals.number + 1)
        self._publish_stop(why)

    def _publish_stop(self, why: str) -> None:
        """Publish the stop message now, or as soon as ROS takes it."""
        out, stop = self._out, self._stop
        if stop is None or (out is None and self._is_left):
            self._is_driven = False
            return
        if out is None:  # the publisher is being set up anew
            self._stop_later()
            return
        try:
            cdr = stop.cdr()
            if self.echo is not None:
                self.echo.sent(cdr)
            out[1].publish(cdr)
        except BusError as error:
            self._cannot_stop(error)
            return
        except Exception as error:  # whatever it is, the robot is to stop
            self._around.broker.faults.caught("commands.stop", error, self)
            self._cannot_stop(error)
            return
        self._is_driven = self._must_stop = False
        self._has_stopped = self._looks >= LOOKS_TO_MATCH
        self.counters.stops += 1
        self._mention("stopped", "%s: the stop message was published: %s", why)

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
        self._timer = self._around.entries.later(
            "commands.check", RETRY, self._check, served=self, failed=self._check_later
        )

    # The log

    def _mention(self, what: str, text: str, *args: object, level: int = logging.WARNING) -> None:
        """Log what may happen with every message once a minute."""
        now = self._around.entries.time()
        if now >= self._told.get(what, -math.inf):
            self._told[what] = now + REPORT_INTERVAL
            self._log(level, text, self, *args)
