"""From MQTT to ROS for what moves a robot: old commands expire, one client commands at a time, and
who falls silent or leaves is followed by a stop message.

All of it happens on the loop's thread, but for the look at the graph and what that sets up.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.ports import Decision
from appliance.broker.session import Session
from appliance.entries import Entries
from appliance.mqtt.reason import ReasonCode
from appliance.ros.backlog import Backlog
from appliance.ros.convert import ConversionError, Converter, Converters
from appliance.ros.flows import REPORT_INTERVAL, Route, Tell
from appliance.ros.node import BusError, QosProfile, RosNode
from appliance.ros.rules import CommandRules, FieldLimits
from appliance.ros.to_ros import ToRos

#: Seconds until a stop message that ROS would not take is published again.
RETRY = 0.05

#: Looks at the graph from the first that finds a subscription until the stop message of the start:
#: the two ends have found each other by then.
LOOKS_TO_MATCH = 2

_FREE = Decision(True, "nobody commands it")


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What commands need beside a flow: the loop, a way to it from any thread, and the broker."""

    entries: Entries
    post: Callable[..., None]
    broker: Broker


class _Stop:
    """The stop message of a route, for one type."""

    def __init__(self, converter: Converter, payload: str) -> None:
        """Raises ConversionError when the type has no such message."""
        self._converter = converter
        self._payload = payload.encode()
        self.example = self.cdr()

    def cdr(self) -> bytes:
        """The message, made anew: it may say "now"."""
        return self._converter.from_json(self._payload)

    def is_like(self, cdr: bytes) -> bool:
        """Whether a message says the same, at another time or in another frame."""
        try:
            one, other = (self._converter.to_dict(message) for message in (cdr, self.example))
        except ConversionError:  # of another type, from before a reload
            return False
        return all(one[name] == other[name] for name in one if name != "header")


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
        route: Route,
        ros: str,
        converters: Converters,
        tell: Tell,
        around: Surroundings,
    ) -> None:
        super().__init__(route, ros, converters, tell)
        assert route.settings.rules is not None
        self.rules: CommandRules = route.settings.rules
        self._around = around
        #: Both replaced as one by the ROS thread.
        self._limits: FieldLimits | None = None
        self._stop: _Stop | None = None
        #: Looks that have found a subscription, since there is this publisher.
        self._looks = 0
        #: Who may command alone, None while nobody does.
        self._holder: Session | None = None
        #: Who sent the last command, and when.
        self._source: Session | None = None
        self._heard_at = -math.inf
        #: Whether something else than the stop message was published last.
        self._is_driven = False
        #: What those who are connected commanded last, and when, where it was something else; at
        #: infinity when they have fallen silent since.
        self._drivers: dict[Session, tuple[bytes, float]] = {}
        self._has_stopped = False
        self._backlog = Backlog()
        #: Whether a stop message is overdue, which ROS would not take.
        self._must_stop = False
        #: Whether the topic had a retained message before there was anybody on ROS to have it.
        self._is_awaited = False
        self._timer: asyncio.TimerHandle | None = None
        self._is_left = True
        self._told: dict[str, float] = {}

    # The ROS thread

    def look(self, node: RosNode, thorough: bool) -> bool:
        has_changed = super().look(node, thorough)
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
        broker = self._around.broker
        self._is_left = False
        broker.departures.append(self._departed)
        # Also when anybody may command: the topic is then known as one that no answer goes to.
        broker.guards.setdefault(self.mqtt, []).append(self)
        broker.guards_changed()
        if isinstance(before, Commands):
            # What the network has of their commands, or a client that is away, is as old here.
            self._drivers, self._backlog = before._drivers, before._backlog
            self._arm()
        if self.rules.on_silence is not None:
            # Of the time before, of another run even, nothing is known. Who drove then and is away
            # may come back with what it had queued.
            for session in broker.sessions.values():
                if session.identity is not None and session.link is None:
                    self._backlog.expect(session.client_id)

    def leave(self) -> None:
        if self._is_left:
            return
        self._is_left = True
        if self._is_driven:
            self._publish_stop("the route ends")
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        broker = self._around.broker
        broker.departures.remove(self._departed)
        guards = broker.guards[self.mqtt]
        guards.remove(self)
        if not guards:
            del broker.guards[self.mqtt]
        broker.guards_changed()
        self._holder = self._source = None

    def receive(self, message: Message, retain: bool, origin: Session | None) -> None:
        if self._is_left or not self._is_in_time(message, retain, origin):
            return
        out = self._out
        is_kept = retain or (message.retain and self.rules.take_retained)
        if is_kept and (out is None or self._looks < LOOKS_TO_MATCH):
            self._is_awaited = True
            return
        if out is None:
            self.fail(f"was refused: {self._why_not()}")
            return
        cdr = self._publish(*out, message, origin)
        if cdr is not None:
            self._commanded(cdr, origin)

    def _is_in_time(self, message: Message, retain: bool, origin: Session | None) -> bool:
        rules = self.rules
        if retain and not rules.take_retained:
            return False
        expires_at = message.expires_at
        if expires_at is not None and expires_at <= self._around.broker.now:
            return self._count_expired("its message expiry is over", origin)
        # Without a Message Expiry Interval nobody knows how old a retained message is. A will was
        # handed over when its client connected.
        is_will = origin is not None and origin.link is None
        if is_will:
            is_old = rules.oldest < math.inf
        else:
            is_old = self._backlog.has(message, origin, rules.oldest, self._around.entries.time())
        if is_old or (retain and rules.expire is not None and expires_at is None):
            return self._count_expired("it was sent some time before", origin)
        return True

    def _count_expired(self, why: str, origin: Session | None) -> bool:
        self.counters.expired += 1
        self._mention("expired", "%s: a command of %s was not published: %s", origin, why)
        return False

    def _read(
        self, convert: Callable[[bytes], bytes], message: Message, origin: Session | None
    ) -> bytes:
        cdr = super()._read(convert, message, origin)
        if self._limits is None:
            return cdr
        try:
            limited, has_changed = self._limits.apply(cdr)
        except ConversionError as error:
            self.counters.refused += 1
            raise ConversionError("", f"it is against the route's rules: {error}") from None
        if has_changed:
            self.counters.clamped += 1
            self._mention("clamped", "%s: numbers in a command of %s were clamped", origin)
        return limited

    def _commanded(self, cdr: bytes, origin: Session | None) -> None:
        now = self._around.entries.time()
        self._heard_at = now
        self._source = origin
        self._is_driven = self._stop is not None and cdr != self._stop.example
        if origin is not None and origin.link is not None:
            if self._is_driven:
                self._drivers[origin] = cdr, now
            else:
                self._drivers.pop(origin, None)
        self._has_stopped = True  # the stop message of the start would come late
        self._must_stop = False
        self._is_awaited = False
        if self.rules.exclusive and self._holder is None and origin is not None and origin.link:
            self._holder = origin
            self._around.broker.guards_changed()
            self._tell(logging.INFO, "%s: %s commands now, alone", self, origin)
        if self._timer is None and (self._is_driven or self._holder is not None):
            self._arm()

    # Leases

    @property
    def commanding(self) -> str | None:
        holder = self._holder
        return None if holder is None else holder.client_id

    def decide(self, session: Session) -> Decision:
        """Whether the session may publish a command now: a Guard of the broker's."""
        holder = self._holder
        # What the bridge itself publishes there is what it heard on ROS.
        if holder is None or session is holder or session.link_for is not None:
            return _FREE
        return Decision(False, f"{holder} commands {self.ros}, and the route is exclusive")

    def refused(self, session: Session) -> None:
        """A message of the session was refused, by this guard or another."""
        if not self.decide(session):
            self.counters.refused += 1

    def _release(self, why: str) -> None:
        holder, self._holder = self._holder, None
        self._around.broker.guards_changed()
        self._tell(logging.INFO, "%s: %s %s and commands no more", self, holder, why)

    # Silence

    def _departed(self, session: Session) -> None:
        self._backlog.departed(session)
        if session is self._holder:
            self._release("has left")
        if session is self._source:
            self._source = None
            if self._is_driven:
                self._publish_stop(f"{session} has left")
        driven = self._drivers.pop(session, None)
        if driven is not None and not self._is_stop(driven[0]):
            # Its library may have queued what it commanded since, and marks none of it as old.
            self._backlog.expect(session.client_id)

    def _is_stop(self, cdr: bytes) -> bool:
        if self.rules.on_silence is None:
            return True
        return self._stop is not None and self._stop.is_like(cdr)

    def _arm(self) -> None:
        rules = self.rules
        due = math.inf
        if self._is_driven and rules.on_silence is not None:
            due = self._heard_at + rules.on_silence.after
        if self._holder is not None:
            due = min(due, self._heard_at + rules.lease)
        if rules.on_silence is not None and rules.on_silence.disconnect:
            heard_at = min((at for _, at in self._drivers.values()), default=math.inf)
            due = min(due, heard_at + rules.on_silence.after)
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
        silence = self._around.entries.time() - self._heard_at
        on_silence = self.rules.on_silence
        is_over = self._holder is not None and silence >= self.rules.lease
        if is_over:
            self._release(f"was silent for {self.rules.lease:g} s")
        if self._is_driven and on_silence is not None:
            if self._must_stop:
                self._publish_stop("at last")
            elif is_over or silence >= on_silence.after:
                who = self._source or "a retained command"
                after = min(silence, on_silence.after)
                self._publish_stop(f"{who} fell silent for {after:g} s")
        if on_silence is not None and on_silence.disconnect:
            self._disconnect_silent(min(silence, on_silence.after) if is_over else on_silence.after)
        if self._timer is None:
            self._arm()

    def _disconnect_silent(self, after: float) -> None:
        """Disconnect who drove and has said nothing for so long, also when others drive on."""
        latest = self._around.entries.time() - after
        silent = [(who, cdr) for who, (cdr, at) in self._drivers.items() if at <= latest]
        for session, cdr in silent:
            self._drivers[session] = cdr, math.inf
            if self._is_stop(cdr):
                continue
            # The network may have it, and a heap of its commands on their way: they are old when
            # they come, and nothing in them says so. On a new connection there are none of them.
            session.close_link(
                ReasonCode.ADMINISTRATIVE_ACTION,
                f"it drove {self.ros} and fell silent (on_silence.disconnect)",
            )
        if silent:
            self._around.broker.flush()

    def _begin(self) -> None:
        """There is somebody on ROS to have a message."""
        if self._is_left:
            return
        if not self._has_stopped:
            self._publish_stop("there is somebody to hear it")
        if self._is_awaited:
            self._is_awaited = False
            # What is retained now: it may have been replaced, or taken back.
            message = self._around.broker.retained.get(self.mqtt)
            if message is not None:
                self.receive(message, True, None)

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

    def _mention(self, what: str, text: str, *args: object) -> None:
        """Log what may happen with every message once a minute."""
        now = self._around.entries.time()
        if now >= self._told.get(what, -math.inf):
            self._told[what] = now + REPORT_INTERVAL
            self._tell(logging.WARNING, text, self, *args)
