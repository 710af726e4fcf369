"""The local side of what a link receives: a session here that publishes what the fleet sends.

It exists while a connection is up, with the rights of the link's user. When it ends, `departures`
are told, so that a robot that the fleet drives stops. What comes is mapped to the topics here, and
dropped if it goes in a circle, has expired or may be too old (`late`). The rest is published with
the greatest age that it can have, by which routes to ROS judge it again.

Messages are acknowledged on their connection only, in the order in which they came, after the
commit that they depend on. A message whose receivers have no room waits, and with it all that comes
behind it, as with a client here; acknowledgements of what the link sends do not wait. So does one
that the fleet's broker has kept while ROS is not ready for it (`readiness.py`). When too much
waits, the connection is not read; what comes all the same is refused (0x97).
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple, Protocol

from appliance.broker.backpressure import PublisherAllowance
from appliance.broker.broker import Broker
from appliance.broker.client import PACKET_COST, RECHECK, RIGHTS_PATIENCE
from appliance.broker.counters import COST_PER_TURN
from appliance.broker.handshake import is_text
from appliance.broker.link import InsideLink, PeerStatus
from appliance.broker.message import OVERHEAD, DatedMessage, Message
from appliance.broker.output import CANNOT_KEEP
from appliance.broker.routing import Fanout
from appliance.broker.session import Session
from appliance.broker.values import Identity
from appliance.mqtt.codec import (
    NO_PROPERTIES,
    V5,
    PacketType,
    Property,
    decode_properties,
    encode_properties,
    quote,
    text_size,
)
from appliance.mqtt.reason import ProtocolError, ReasonCode
from appliance.upstream.acknowledgements import Acknowledgements
from appliance.upstream.answers import Answers, reply_topic
from appliance.upstream.late import Verdict, greatest_age, judge
from appliance.upstream.link_events import Arrived
from appliance.upstream.loops import circle
from appliance.upstream.readiness import Readiness
from appliance.upstream.rules import InRule, LinkRules, UpstreamSettings
from appliance.upstream.sessions import in_client_id, kept_client_id

#: The connection is not read while so many messages, or bytes of these, wait here. With twice as
#: much, what was read of a chunk all the same is refused.
WAITING_MESSAGES: Final = 1000
WAITING_BYTES: Final = 4 << 20

#: Seconds between two looks whether ROS is ready for a kept message that waits for it.
LOOK_INTERVAL: Final = 0.25

#: The cost of decoding the properties of a request to change its Response Topic.
REQUEST_COST: Final = 5

#: The cost of what is done with a topic: one for each 64 characters of it.
TOPIC_SHIFT: Final = 6

#: The reason codes that a client may put into PUBACK (5.0 section 3.4.2.1); 0x10 is a server's.
_OF_CLIENTS: Final = frozenset((0x00, 0x80, 0x83, 0x87, 0x90, 0x91, 0x97, 0x99))


class InConnection(Protocol):
    """A connection to the fleet's broker, as the session needs it."""

    #: The version of MQTT that is spoken on it.
    version: int

    def acknowledge(self, packet_id: int, code: int) -> None:
        """Send a PUBACK; in MQTT 3.1.1, without the code."""

    def later(self, seconds: float) -> None:
        """Call `InSession.take_turn` in a later turn, after so many seconds at the latest.

        An earlier time that was asked for stays.
        """

    def pause_reading(self) -> None:
        """Read nothing until `resume_reading`."""

    def resume_reading(self) -> None:
        """Read on."""

    def close(self, code: ReasonCode, reason: str) -> None:
        """End the connection; `InSession.detach` is called before anything else is done."""

    def peer_status(self) -> PeerStatus:
        """The state of the connection to the fleet's broker."""

    def probe(self) -> None:
        """Make the broker answer within two seconds, if it can be reached."""


@dataclass(slots=True)
class InCounters:
    """What came from the fleet since the start."""

    received: int = 0
    delivered: int = 0
    #: Because of the access rules, a lack of room, or what a route to ROS said.
    refused: int = 0
    #: What had been here before, what no rule carries, and answers that nobody waits for.
    circles: int = 0
    uncarried: int = 0
    unexpected_answers: int = 0
    #: By the filter of their rule, there, those that were dealt with; and dropped ones, with why.
    came: Counter[str] = field(default_factory=Counter)
    dropped: Counter[tuple[str, Verdict]] = field(default_factory=Counter)
    #: By the same filters, why the access rules let nothing through that came last.
    denied: dict[str, str] = field(default_factory=dict)


class _Came(NamedTuple):
    """A message as it came, and when."""

    packet: Arrived
    at: float
    #: Whether it is refused, in its turn: acknowledgements keep the order.
    is_refused: bool = False

    @property
    def size(self) -> int:
        """The bytes that are counted while it waits."""
        packet = self.packet
        return (
            text_size(packet.topic) + len(packet.payload) + len(packet.properties_wire) + OVERHEAD
        )


class InSession:
    """Publishes here what comes on one connection; made when that is up, `detach`ed when it ends.

    After `receive` and `take_turn`, `Broker.flush` is to be called; several may be in between.
    """

    def __init__(
        self,
        broker: Broker,
        settings: UpstreamSettings,
        rules: LinkRules,
        answers: Answers,
        answering: Session,
        connection: InConnection,
        counters: InCounters,
        readiness: Readiness,
        *,
        is_kept: bool = False,
    ) -> None:
        """`answering` is `OutSession.answering`, `readiness` the link's. `is_kept`: the session
        there outlives its connections."""
        self._broker = broker
        self._settings = settings
        self._rules = rules
        self._answers = answers
        self._answering = answering
        self._connection = connection
        self._counters = counters
        self._is_kept = is_kept
        name = settings.name
        client_id = kept_client_id(name) if is_kept else in_client_id(name)
        identity = Identity(settings.user, client_id)
        self._session = broker.attach(client_id, _InLink(connection), identity)
        self._acknowledgements = Acknowledgements(broker, self)
        self._is_detached = False
        #: What waits, the first of it for receivers or decisions, or for this session's turn.
        self._waiting: deque[_Came] = deque()
        self._waiting_bytes = 0
        self._is_paused = False
        #: The time and the cost at which this turn ends.
        self._turn_at = -1.0
        self._turn_ends = 0
        #: Since when the first one waits for decisions; None when it does not.
        self._undecided_since: float | None = None
        self._allowance = PublisherAllowance()
        self._readiness = readiness
        #: The most levels that a topic there may have beside those that one here may.
        prefixes = [settings.answers_there, *(rule.remote_prefix for rule in settings.inward)]
        self._prefixed = max(prefix.count("/") for prefix in prefixes)

    def __str__(self) -> str:
        return str(self._session)

    @property
    def waiting(self) -> int:
        """Messages that wait here."""
        return len(self._waiting)

    def detach(self) -> None:
        """The connection has ended: drop what waits, unacknowledged; may be called twice."""
        if self._is_detached:
            return
        self._is_detached = True
        self._acknowledgements.close()
        self._allowance.stop_waiting(self)
        self._broker.disk.forget(self)
        self._waiting.clear()
        self._count(-self._waiting_bytes)
        self._broker.detach(self._session)

    # --- input, and turns ----------------------------------------------------------------------

    def receive(self, packet: Arrived, now: float) -> None:
        """A message has come on the connection."""
        if self._is_detached:
            return
        self._begin_turn(now)
        self._counters.received += 1
        self._broker.counters.cost += PACKET_COST
        came = _Came(packet, now)
        if not self._waiting and not self._is_turn_over and self._publish(came):
            return
        if self._is_detached:
            return
        if len(self._waiting) >= 2 * WAITING_MESSAGES or self._waiting_bytes >= 2 * WAITING_BYTES:
            if not packet.qos:
                self._counters.refused += 1
                return
            # No more of these come than the Receive Maximum of the link allows.
            rest = replace(packet, payload=b"", properties=None, properties_wire=NO_PROPERTIES)
            came = _Came(rest, now, is_refused=True)
        if not self._waiting and self._is_turn_over:
            self._connection.later(0)
        self._waiting.append(came)
        self._count(came.size)
        if not self._is_paused and self._has_much:
            self._is_paused = True
            self._connection.pause_reading()

    @property
    def _has_much(self) -> bool:
        return len(self._waiting) >= WAITING_MESSAGES or self._waiting_bytes >= WAITING_BYTES

    def take_turn(self, now: float) -> None:
        """Publish what waits, as far as it need not wait longer."""
        if self._is_detached:
            return
        self._turn_at = -1.0
        self._begin_turn(now)
        self._allowance.spend(now)
        while self._waiting:
            if self._is_turn_over:
                self._connection.later(0)
                return
            came = self._waiting[0]
            if not self._publish(came) or self._is_detached:
                return
            self._waiting.popleft()
            self._count(-came.size)
        if self._is_paused:
            self._is_paused = False
            self._connection.resume_reading()

    def woke(self) -> None:
        """The computer has slept: what waits is of unknown age."""
        for came in self._waiting:
            came.packet.not_before = -math.inf

    def proceed(self) -> None:
        """Waiting: a receiver that the first message waits for has room again."""
        self._connection.later(0)

    def _wake(self) -> None:
        """A pending decision that the first message waits for has been made."""
        if not self._is_detached:
            self._connection.later(0)

    def _begin_turn(self, now: float) -> None:
        accounting = self._broker.accounting
        accounting.now = now
        if now != self._turn_at:  # another chunk, or a turn that was asked for
            self._turn_at = now
            self._turn_ends = accounting.counters.cost + COST_PER_TURN

    @property
    def _is_turn_over(self) -> bool:
        return self._broker.counters.cost > self._turn_ends

    def _count(self, size: int) -> None:
        """Count the memory of messages that wait."""
        self._waiting_bytes += size
        accounting = self._broker.accounting
        accounting.take(self._session.account, size)
        accounting.input_bytes += size

    # --- what is done with a message -----------------------------------------------------------

    def _publish(self, came: _Came) -> bool:
        """Publish it, or drop or refuse it; False if it has to wait."""
        packet = came.packet
        # It is split and checked again at each step, and an alias of two bytes may stand for it.
        self._broker.counters.cost += len(packet.topic) >> TOPIC_SHIFT
        if packet.topic.count("/") >= self._broker.limits.topic_levels + self._prefixed:
            self._refuse(packet, ReasonCode.TOPIC_NAME_INVALID, "its topic has too many levels")
            return True
        if came.is_refused or packet.flaw:
            self._refuse_unread(came)
            return True
        answers_there = self._settings.answers_there
        if packet.topic.startswith(answers_there) or "/_reply/" in packet.topic:
            topic = self._answers.for_answer_in(packet.topic, self._broker.now)
            if topic is not None:
                return self._publish_answer(came, topic)
            if packet.topic.startswith(answers_there):
                self._counters.unexpected_answers += 1
                self._acknowledge(packet, ReasonCode.SUCCESS)
                return True
        found = self._rules.inward(packet.topic)
        if found is None:
            self._counters.uncarried += 1
            self._acknowledge(packet, ReasonCode.SUCCESS)
            return True
        rule, topic = found
        why = circle(packet.properties_wire, self._settings.robot)
        if why:
            self._counters.circles += 1
            self._broker.log_rate_limited(
                self._session, "drops a message for %s: %s", quote(topic), why
            )
            self._acknowledge(packet, ReasonCode.SUCCESS)
            return True
        if self._is_dropped(came, rule, topic):
            self._counters.came[rule.remote_filter] += 1
            return True
        if self._is_kept and self._waits_for_ros(topic):
            return False
        message = self._message(came, topic)
        refused = self._counters.refused
        is_dealt_with = self._deliver(came, message, self._session, rule)
        self._counters.came[rule.remote_filter] += is_dealt_with
        if self._counters.refused > refused:
            self._counters.dropped[rule.remote_filter, Verdict.REFUSED] += 1
        return is_dealt_with

    def _refuse_unread(self, came: _Came) -> None:
        """Refuse what has no room or is flawed, whatever rule carries it."""
        packet = came.packet
        found = self._rules.inward(packet.topic)
        if found is not None:
            name = found[0].remote_filter
            self._counters.came[name] += 1
            self._counters.dropped[name, Verdict.REFUSED] += 1
        if came.is_refused:
            reason = "too much waits for its receivers here"
            self._refuse(packet, ReasonCode.QUOTA_EXCEEDED, reason)
        else:
            self._refuse(packet, ReasonCode.UNSPECIFIED_ERROR, packet.flaw)

    def _is_dropped(self, came: _Came, rule: InRule, topic: str) -> bool:
        packet = came.packet
        expiry = (packet.properties or {}).get(Property.MESSAGE_EXPIRY_INTERVAL)
        verdict = judge(
            now=self._broker.now,
            arrived_at=came.at,
            left_after=packet.not_before,
            late=None if rule.offline == "keep" else rule.late,
            expiry=expiry if isinstance(expiry, int) else None,
            dup=packet.dup,
            retain=packet.retain,
        )
        if packet.retain and (rule.retained == "drop" or self._is_command(packet, topic)):
            verdict = Verdict.RETAINED
        if verdict is Verdict.TAKE:
            return False
        self._counters.dropped[rule.remote_filter, verdict] += 1
        self._broker.log_rate_limited(
            self._session,
            "drops a message for %s: %s (it may be %.3g s old)",
            quote(topic),
            verdict.value,
            self._broker.now - packet.not_before,
        )
        self._acknowledge(packet, ReasonCode.SUCCESS)
        return True

    def _is_command(self, packet: Arrived, topic: str) -> bool:
        """Whether a retained message is a command of unknown age: a local subscriber would get it
        as a new one. A route may ask for it, and what deletes a retained message is no command."""
        guards = self._broker.guards.get(topic)
        if not guards or not packet.payload:
            return False
        return not any(guard.takes_retained for guard in guards)

    def _message(self, came: _Came, topic: str) -> Message:
        """The message here: with its greatest age, and a Response Topic of ours if it has one."""
        packet, now = came.packet, self._broker.now
        values = packet.properties or {}
        wire = packet.properties_wire
        wanted = values.get(Property.RESPONSE_TOPIC)
        if wanted is not None or reply_topic(packet.topic) is not None:
            self._broker.counters.cost += REQUEST_COST
            text = wanted if isinstance(wanted, str) else None
            response_topic = self._answers.for_request_in(packet.topic, text, now)
            properties = decode_properties(wire, 0, len(wire), PacketType.PUBLISH)[0] or {}
            properties.pop(Property.RESPONSE_TOPIC, None)
            if response_topic is not None:
                properties[Property.RESPONSE_TOPIC] = response_topic
            wire = encode_properties(properties)
        interval = values.get(Property.MESSAGE_EXPIRY_INTERVAL)
        expires_at = came.at + interval if isinstance(interval, int) else None
        message = Message(
            topic,
            packet.payload,
            packet.qos,
            packet.retain,
            expires_at=expires_at,
            properties_wire=wire,
        )
        age = greatest_age(
            now=now, left_after=packet.not_before, dup=packet.dup, retain=packet.retain
        )
        return DatedMessage(message, age)

    def _publish_answer(self, came: _Came, topic: str) -> bool:
        """Publish an answer where a requester here waits for it, who may publish there itself."""
        packet = came.packet
        if topic in self._broker.guards:  # of a route to ROS that has come since
            self._counters.unexpected_answers += 1
            self._acknowledge(packet, ReasonCode.SUCCESS)
            return True
        message = Message(topic, packet.payload, packet.qos, properties_wire=packet.properties_wire)
        return self._deliver(came, message, self._answering)

    def _deliver(
        self, came: _Came, message: Message, origin: Session, rule: InRule | None = None
    ) -> bool:
        """Publish it as a session; False if it has to wait for its receivers or for decisions.

        `rule` is the one that carries it, if it is no answer.
        """
        packet, broker = came.packet, self._broker
        try:
            route = broker.route(origin, message.topic_wire)
        except (ProtocolError, ValueError) as error:  # it is too long here, or has too many levels
            self._refuse(packet, ReasonCode.TOPIC_NAME_INVALID, str(error))
            return True
        if route.undecided and self._waits_for_decisions(route):
            return False
        self._undecided_since = None
        if route.allowed and packet.qos and self._waits_for_receivers(route, message, origin):
            return False
        checks = broker.features.check_payload_format
        if checks and route.allowed and not is_text(packet.payload, packet.properties):
            reason = "the payload is marked as UTF-8 text and is not"
            self._refuse(packet, ReasonCode.PAYLOAD_FORMAT_INVALID, reason)
            return True
        targets = route.targets
        if packet.retain:
            # It may be an old one: a route to ROS gets it as one that was retained before.
            targets = [
                (session, qos, as_published or session.is_inside, ids)
                for session, qos, as_published, ids in targets
            ]
        code: int = broker.publish_to(targets, route, message, origin)
        if message.rejection is not None:
            code, message.rejection = message.rejection.code, None
        if rule is not None and not route.is_guarded:
            self._note_right(rule, None if route.allowed else route.reason)
        if code >= 0x80:
            self._counters.refused += 1
            self._acknowledge_refusal(packet, code)
        else:
            self._counters.delivered += 1
            self._acknowledge(packet, ReasonCode.SUCCESS)
        return True

    def _note_right(self, rule: InRule, denial: str | None) -> None:
        """Whether the access rules let the link publish what a rule carries; for the status."""
        if denial is not None:
            self._counters.denied[rule.remote_filter] = denial
        elif self._counters.denied:
            self._counters.denied.pop(rule.remote_filter, None)

    # --- waiting -------------------------------------------------------------------------------

    def _waits_for_decisions(self, route: Fanout) -> bool:
        """Whether a plugin has still to decide; receivers are waited for for a moment only."""
        pending = self._broker.router.pending_decisions
        if pending is None:
            return False
        now = self._broker.now
        if self._undecided_since is None:
            self._undecided_since = now
        own = [query for query in route.undecided if query[0].client_id == self._session.client_id]
        patience = pending.timeout if own else RIGHTS_PATIENCE
        left = self._undecided_since + patience - now
        if left <= 0:
            return False
        if not [each for each in route.undecided if pending.is_pending(each, self._wake)]:
            return False
        self._connection.later(max(left, RECHECK))
        return True

    def _waits_for_ros(self, topic: str) -> bool:
        """Whether ROS does not take messages to this topic yet, but soon may."""
        broker = self._broker
        why = broker.obstacle(topic)
        waits, news = self._readiness.judge(topic, why, broker.now)
        if news:
            broker.log_rate_limited(self._session, "%s: %s (%s)", quote(topic), news, why)
        if waits:
            self._connection.later(LOOK_INTERVAL)
        return waits

    def _waits_for_receivers(self, route: Fanout, message: Message, origin: Session) -> bool:
        """Whether receivers have no room now, but soon will, or the disk is behind: see
        `broker.backpressure`."""
        broker, allowance = self._broker, self._allowance
        congestions = broker.congestions(route, message) if broker.accounting.congested else []
        if congestions and not allowance.used_up:
            self._connection.later(max(allowance.wait(self, congestions, broker.now), RECHECK))
            return True
        allowance.end_wait(self)
        if not broker.must_wait_for_disk(route, message, origin):
            return False
        self._connection.later(broker.disk.wait(self))
        return True

    # --- acknowledgements ----------------------------------------------------------------------

    def _refuse(self, packet: Arrived, code: ReasonCode, reason: str) -> None:
        self._counters.refused += 1
        self._broker.log_rate_limited(
            self._session, "may not publish what came on %s: %s", quote(packet.topic), reason
        )
        self._acknowledge_refusal(packet, code)

    def _acknowledge_refusal(self, packet: Arrived, code: int) -> None:
        is_failing = code == ReasonCode.QUOTA_EXCEEDED and self._broker.accounting.failing
        if is_failing and packet.qos and (self._is_kept or self._connection.version != V5):
            # A session that is kept there sends it again; and 3.1.1 cannot refuse.
            self._close(ReasonCode.QUOTA_EXCEEDED, CANNOT_KEEP)
            return
        self._acknowledge(packet, code if code in _OF_CLIENTS else ReasonCode.UNSPECIFIED_ERROR)

    def _acknowledge(self, packet: Arrived, code: int) -> None:
        if packet.qos:
            self._acknowledgements.add(packet.packet_id, code)

    def acknowledge(self, packet_id: int, code: int) -> None:
        """AckLink: send a PUBACK, whose turn has come."""
        self._connection.acknowledge(packet_id, code)

    def abandon(self) -> None:
        """AckLink: what was to be acknowledged could not be stored, or a fault kept it back."""
        is_failing = self._broker.accounting.failing
        fault = "a fault in the appliance; its log has it"
        self._close(ReasonCode.UNSPECIFIED_ERROR, CANNOT_KEEP if is_failing else fault)

    def _close(self, code: ReasonCode, reason: str) -> None:
        self._acknowledgements.close()
        self._connection.close(code, reason)


class _InLink(InsideLink):
    """The link of the session: who asks how its client is, asks about the fleet's broker."""

    acknowledges = True

    def __init__(self, connection: InConnection) -> None:
        self._connection = connection

    def peer_status(self) -> PeerStatus:
        """The state of the connection to the fleet's broker."""
        return self._connection.peer_status()

    def probe(self) -> None:
        """Make the fleet's broker answer, if it can be reached."""
        self._connection.probe()

    def close(self, reason: ReasonCode, message: str) -> None:
        """End the connection."""
        self._connection.close(reason, message)
