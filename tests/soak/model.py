"""What a correct broker may do, and must do, with what the clients sent: the oracle of the soak.

The model is told by the clients, in the order in which it happened, what they sent, what was
acknowledged to them and what they received. It knows nothing of how the broker works; where the
moment at which the broker did something cannot be known, it allows for every moment that it may
have been. From the standards it takes (sections 3.8.4, 4.3, 4.4 and 4.6 of both):

* a message that was acknowledged to its publisher is owed to every session whose subscription was
  acknowledged before the message was sent and not given up before its acknowledgement, with the
  lesser QoS of the two; QoS 0 is owed to nobody;
* what is owed has been received when the session is still there at the end, and when it ended, has
  been received before anything newer of the same publisher, topic and QoS;
* QoS 2 arrives once. QoS 1 arrives again with DUP, and once more each time that the publisher had
  to send it again. QoS 0 never arrives again;
* first arrivals are in the order of sending, by publisher, topic and QoS;
* nothing arrives that was not sent, not subscribed to or not allowed.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf

from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Publish, Subscription
from soak.records import Coverage, Grant, Group, Message, Owed, Replay, Session
from soak.rights import SHARE, Rights, matches


@dataclass(frozen=True)
class Violation:
    """What the broker did wrong, and all that is known about it."""

    kind: str
    text: str
    history: list[str]

    def __str__(self) -> str:
        return "\n".join([f"{self.kind}: {self.text}", *(f"    {line}" for line in self.history)])


class Model:
    """All messages, sessions and subscriptions of one soak, and what was wrong."""

    def __init__(
        self, rights: Mapping[str, Rights], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.rights = rights
        self.clock = clock
        self.began_at = clock()
        self.counts: Counter[str] = Counter()
        self.violations: list[Violation] = []
        #: When a message was delivered last, for who waits until it is quiet.
        self.delivered_at = self.began_at
        self._numbers: Counter[str] = Counter()
        self._messages: dict[tuple[str, int], Message] = {}
        self._sessions: dict[Session, None] = {}
        self._session_numbers: Counter[str] = Counter()
        #: Filters ever subscribed to, by topic; and those now held.
        self._filters: dict[str, None] = {}
        self._matching: dict[str, list[str]] = {}
        self._held: dict[str, dict[Coverage, None]] = {}
        #: By topic the messages that may be the retained one, oldest first.
        self._retained: dict[str, list[Message]] = {}
        self._cleared: set[str] = set()
        self._groups: dict[str, Group] = {}

    # --- what is wrong -------------------------------------------------------------------------

    def violation(
        self, kind: str, text: str, message: Message | None = None, session: Session | None = None
    ) -> None:
        """The broker did something that it must not do."""
        history: list[str] = []
        if message is not None:
            history.append(f"{message}, {message.outcome}, sent {message.sends} times:")
            history += self._story(message.events)
        if session is not None:
            history.append(f"session {session}:")
            history += self._story(session.events[-30:])
        self.counts[kind] += 1
        self.violations.append(Violation(kind, text, history))

    def _story(self, events: list[tuple[float, str]]) -> list[str]:
        return [f"  {when - self.began_at:9.4f} s  {what}" for when, what in events]

    # --- publishing ----------------------------------------------------------------------------

    def message(
        self,
        publisher: str,
        rights: Rights,
        topic: str,
        qos: int,
        *,
        retain: bool = False,
        size: int = 0,
        clears: bool = False,
        labelled: bool = False,
    ) -> Message:
        """A new message, not sent yet."""
        self._numbers[publisher] += 1
        number = self._numbers[publisher]
        permitted = rights.may_write(topic)
        message = Message(publisher, number, topic, qos, retain, size, clears, permitted, labelled)
        self._messages[publisher, number] = message
        return message

    def sent(self, message: Message, how: str = "") -> None:
        """All of its PUBLISH is about to be written, for the first time or again."""
        now = self.clock()
        message.sends += 1
        message.events.append((now, f"{message.publisher} sends it{how}"))
        if message.sent_at is None:
            message.sent_at = now
            self.counts[f"published {message.qos}"] += 1
            if message.qos and message.permitted and not message.clears:
                message.audience = [
                    (coverage, coverage.breaks)
                    for name in self._filters_of(message.topic)
                    for coverage in self._held.get(name, ())
                ]
            if message.retain and message.permitted:
                self._retained.setdefault(message.topic, []).append(message)
            if message.clears:
                self._cleared.add(message.topic)
                for session in self._sessions:
                    for key in [key for key in session.owed_retained if key[0] == message.topic]:
                        del session.owed_retained[key]

    def acknowledged(self, message: Message, how: str) -> None:
        """Its publisher has the broker's word for it."""
        now = self.clock()
        message.outcome = "acknowledged"
        message.closed_at = now
        message.events.append((now, f"{message.publisher} receives {how}"))
        self.counts[f"acknowledged {message.qos}"] += 1
        if not message.permitted:
            return
        self._supersede(message, now)
        assert message.sent_at is not None
        least: dict[Session, int] = {}
        shared: dict[str, int] = {}
        for coverage, breaks in message.audience:
            if not coverage.held or coverage.breaks != breaks:
                continue
            session = coverage.session
            if coverage.no_local and session.client == message.publisher:
                continue
            if session.ended or not session.rights.may_read(message.topic):
                continue
            qos = min(message.qos, coverage.least_qos(message.sent_at))
            if coverage.filter.startswith(SHARE):
                name = coverage.filter
                shared[name] = min(qos, shared.get(name, qos))
            else:
                least[session] = max(qos, least.get(session, 0))
        message.audience = []
        for session, qos in least.items():
            if qos and not session.live[message]:
                exact = self._possible_qos(session, message) == {qos}
                session.owed[message] = Owed(qos, exact)
        for name, qos in shared.items():
            group = self._groups[name]
            if qos and message not in group.received:
                group.owed[message] = qos

    def refused(self, message: Message, code: int, how: str) -> None:
        """The broker said that it did not take the message."""
        now = self.clock()
        message.outcome = f"refused with 0x{code:02X}"
        message.closed_at = now
        message.events.append((now, f"{message.publisher} receives {how} 0x{code:02X}"))
        message.audience = []
        self.counts[f"refused 0x{code:02X}"] += 1

    def closed(self, message: Message, why: str) -> None:
        """The broker has nothing to do with it any more; whether it ever had, nobody knows."""
        message.outcome = "closed"
        message.closed_at = self.clock()
        message.events.append((message.closed_at, f"{message.publisher}: {why}"))
        message.audience = []

    def _supersede(self, message: Message, now: float) -> None:
        if not message.retain:
            return
        candidates = self._retained[message.topic]
        for older in [other for other in candidates if other.number < message.number]:
            older.superseded_at = now
            candidates.remove(older)

    # --- sessions ------------------------------------------------------------------------------

    def begin(self, client: str, rights: Rights, *, as_published: bool = False) -> Session:
        """CONNACK without session present."""
        self._session_numbers[client] += 1
        session = Session(client, self._session_numbers[client], rights, as_published)
        self._sessions[session] = None
        return session

    def left(self, session: Session) -> None:
        """Its connection ended; the session may go on."""
        now = self.clock()
        for coverage in session.coverages.values():
            if coverage.filter in self._groups:
                self._groups[coverage.filter].left_at = now

    def give_up(self, session: Session) -> None:
        """The client is about to end it: nothing more is owed from now on."""
        for coverage in session.coverages.values():
            self._release(coverage)

    def end(self, session: Session) -> None:
        """It is gone; what it was owed must not have been passed over by anything newer."""
        now = self.clock()
        self.give_up(session)
        for coverage in session.coverages.values():
            for grant in coverage.grants:
                grant.gone_at = min(grant.gone_at, now)
            if coverage.filter in self._groups:
                self._groups[coverage.filter].lost_at = now
        for message, owed in session.owed.items():
            key = (message.publisher, message.topic, message.qos, owed.qos)
            newest = session.newest.get(key, 0)
            if owed.exact and newest > message.number:
                text = f"{session} was sent message {newest}, but never the {message} before it"
                self.violation("lost", text, message, session)
        self.counts["void"] += len(session.owed)
        session.ended = True
        session.owed.clear()
        session.owed_retained.clear()
        del self._sessions[session]

    # --- subscribing ---------------------------------------------------------------------------

    def subscribing(self, session: Session, subscription: Subscription) -> Grant:
        """A SUBSCRIBE is about to be written; but for the QoS, a filter's options never change."""
        topic_filter, qos = subscription.filter, subscription.qos
        retain_handling = subscription.retain_handling
        self._register(topic_filter)
        coverage = session.coverages.get(topic_filter)
        if coverage is None:
            coverage = Coverage(
                session, topic_filter, subscription.no_local, subscription.identifier
            )
            session.coverages[topic_filter] = coverage
        grant = Grant(qos, self.clock())
        is_new = not any(older.gone_at == inf for older in coverage.grants)
        if retain_handling == 0 or (retain_handling == 1 and not coverage.held):
            grant.replay = session.replays.setdefault(topic_filter, Replay())
            grant.replay.count += 1
        if retain_handling == 0 or (retain_handling == 1 and is_new):
            grant.retained = self._expected_retained(coverage, qos)
        coverage.grants.append(grant)
        if not qos:
            self._forget_retained(session, topic_filter)
        return grant

    def _expected_retained(self, coverage: Coverage, qos: int) -> list[Message]:
        """What is certainly retained under the filter, and may not get lost on the way."""
        session = coverage.session
        if not qos or coverage.no_local or coverage.filter.startswith(SHARE):
            return []
        return [
            candidates[0]
            for topic, candidates in self._retained.items()
            if len(candidates) == 1
            and candidates[0].outcome == "acknowledged"
            and not candidates[0].clears
            and candidates[0].qos
            and session.rights.may_read(topic)
            and matches(coverage.filter, topic)
        ]

    def subscribed(self, session: Session, topic_filter: str, grant: Grant) -> None:
        """SUBACK granted it: what was there before under the filter is replaced."""
        now = self.clock()
        coverage = session.coverages[topic_filter]
        if grant.replay is not None:
            grant.replay.sent_at = max(grant.replay.sent_at, grant.sent_at)
        for older in coverage.grants:
            if older is not grant and older.sent_at <= grant.sent_at:
                older.gone_at = min(older.gone_at, now)
        if not coverage.held and not grant.given_up:
            coverage.held = True
            self._held[topic_filter][coverage] = None
        if topic_filter.startswith(SHARE):
            group = self._groups.setdefault(topic_filter, Group())
            if coverage not in group.members:
                group.members.append(coverage)
        for message in grant.retained:
            candidates = self._retained[message.topic]
            if not any(candidate.clears for candidate in candidates) and not any(
                session.replayed[candidate] for candidate in candidates
            ):
                session.owed_retained[message.topic, topic_filter] = message

    def not_subscribed(self, session: Session, grant: Grant) -> None:
        """SUBACK refused it."""
        grant.gone_at = self.clock()

    def unsubscribing(self, session: Session, topic_filter: str) -> None:
        """An UNSUBSCRIBE is about to be written."""
        self._release(session.coverages[topic_filter])
        self._forget_retained(session, topic_filter)

    def unsubscribed(self, session: Session, topic_filter: str, sent_at: float) -> None:
        """UNSUBACK came for the UNSUBSCRIBE that was sent at that time."""
        now = self.clock()
        for grant in session.coverages[topic_filter].grants:
            if grant.sent_at <= sent_at:
                grant.gone_at = min(grant.gone_at, now)

    def holds(self, session: Session, topic_filter: str) -> bool:
        """Whether the broker certainly has the subscription."""
        coverage = session.coverages.get(topic_filter)
        return coverage is not None and coverage.held

    def _release(self, coverage: Coverage) -> None:
        coverage.breaks += 1
        for grant in coverage.grants:
            grant.given_up = True
        if coverage.held:
            coverage.held = False
            del self._held[coverage.filter][coverage]

    def _forget_retained(self, session: Session, topic_filter: str) -> None:
        for key in [key for key in session.owed_retained if key[1] == topic_filter]:
            del session.owed_retained[key]

    def _register(self, topic_filter: str) -> None:
        if topic_filter in self._filters:
            return
        self._filters[topic_filter] = None
        self._held[topic_filter] = {}
        for topic, filters in self._matching.items():
            if matches(topic_filter, topic):
                filters.append(topic_filter)

    def _filters_of(self, topic: str) -> list[str]:
        filters = self._matching.get(topic)
        if filters is None:
            filters = [name for name in self._filters if matches(name, topic)]
            self._matching[topic] = filters
        return filters

    # --- delivery ------------------------------------------------------------------------------

    def identify(self, session: Session, packet: Publish) -> Message | None:
        """The message that a received PUBLISH is; None for an empty one, or when there is none."""
        if not packet.payload:
            if packet.topic not in self._cleared:
                text = f"{session} received an empty message that nobody sent: {packet}"
                self.violation("invented", text, session=session)
            return None
        try:
            publisher, number, *_ = packet.payload.split(b"\n", 1)[0].decode().split(" ")
            message = self._messages[publisher, int(number)]
        except (KeyError, ValueError):
            text = f"{session} received what nobody sent: {packet} {packet.payload[:80]!r}"
            self.violation("invented", text, session=session)
            return None
        if packet.topic != message.topic or packet.payload != message.payload:
            text = f"{session} received {packet} with {packet.payload[:80]!r}"
            self.violation("changed", text, message, session)
        return message

    def delivered(
        self, session: Session, packet: Publish, message: Message, *, again: bool = False
    ) -> None:
        """A PUBLISH was received; `again` when it repeats one of an earlier connection."""
        now = self.delivered_at = self.clock()
        note = "".join(
            (
                f"{session} receives it, QoS {packet.qos}",
                f" id={packet.packet_id}" if packet.qos else "",
                " DUP" if packet.dup else "",
                " RETAIN" if packet.retain else "",
                " again" if again else "",
            )
        )
        message.events.append((now, note))
        if again:
            self.counts["delivered again"] += 1
            return
        self.counts[f"delivered {packet.qos}"] += 1
        if not message.permitted:
            self.violation("not permitted", f"{session} received it", message, session)
        elif message.sent_at is None:
            self.violation("invented", f"{session} received it before it was sent", message)
        elif not session.rights.may_read(message.topic):
            self.violation("not permitted", f"{session} may not read it", message, session)
        elif packet.retain and not session.as_published:
            self._check_replay(session, packet, message)
        elif packet.retain != (message.retain and session.as_published):
            # [MQTT-3.3.1-9], v5 [MQTT-3.3.1-12] and [MQTT-3.3.1-13]
            text = f"{session} received it with RETAIN {packet.retain:d}"
            self.violation("retain flag", text, message, session)
        elif matching := self._coverages(session, message):
            self._check_properties(session, packet, message, matching)
            if any(coverage.filter.startswith(SHARE) for coverage in matching):
                self._check_shared(session, packet, message, matching)
            else:
                self._check_live(session, packet, message)
        else:
            self.violation("not subscribed", f"{session} received it", message, session)

    def _coverages(self, session: Session, message: Message) -> list[Coverage]:
        """The session's subscriptions that the broker may have delivered it under."""
        return [
            coverage
            for name in self._filters_of(message.topic)
            if (coverage := session.coverages.get(name)) is not None
            and not (coverage.no_local and session.client == message.publisher)
            and self._grants(coverage, message)
        ]

    def _grants(self, coverage: Coverage, message: Message) -> list[Grant]:
        assert message.sent_at is not None
        return [
            grant
            for grant in coverage.grants
            if grant.sent_at <= message.closed_at and grant.gone_at >= message.sent_at
        ]

    def _possible_qos(self, session: Session, message: Message) -> set[int]:
        return {
            min(message.qos, grant.qos)
            for coverage in self._coverages(session, message)
            for grant in self._grants(coverage, message)
        }

    def _check_qos(self, session: Session, packet: Publish, message: Message) -> None:
        if packet.qos not in self._possible_qos(session, message):
            self.violation("QoS", f"{session} received it with QoS {packet.qos}", message, session)

    def _check_live(self, session: Session, packet: Publish, message: Message) -> None:
        self._check_qos(session, packet, message)
        owed = session.owed.pop(message, None)
        if owed is not None and packet.qos < owed.qos:
            text = f"{session} received it with QoS {packet.qos}, and is owed {owed.qos}"
            self.violation("QoS", text, message, session)
        session.live[message] += 1
        copies = session.live[message]
        # A QoS 1 message that its publisher had to send again is another one to the broker.
        if copies > (message.sends if message.qos == 1 else 1):
            text = f"{session} received it {copies} times with QoS {packet.qos}"
            self.violation("duplicate", text, message, session)
        if copies > 1:
            return
        key = (message.publisher, message.topic, message.qos, packet.qos)
        newest = session.newest.get(key, 0)
        if message.number > newest:
            session.newest[key] = message.number
        elif not (message.qos == 1 and message.sends > 1):
            text = f"{session} received it after message {newest}"
            self.violation("order", text, message, session)

    def _check_replay(self, session: Session, packet: Publish, message: Message) -> None:
        asked = [replay for name, replay in session.replays.items() if matches(name, message.topic)]
        session.replayed[message] += 1
        if not message.retain:
            text = f"{session} received it with RETAIN 1"
            self.violation("retain flag", text, message, session)
        elif not asked:
            text = f"{session} received it as retained, and had not asked for it"
            self.violation("not subscribed", text, message, session)
        # What is sent again was sent for a SUBSCRIBE of an earlier connection.
        elif not packet.dup and max(replay.sent_at for replay in asked) > message.superseded_at:
            text = f"{session} received it as retained after it had been replaced"
            self.violation("stale", text, message, session)
        elif session.replayed[message] > sum(replay.count for replay in asked):
            text = f"{session} received it as retained {session.replayed[message]} times"
            self.violation("duplicate", text, message, session)
        else:
            allowed = {
                min(message.qos, grant.qos)
                for name, coverage in session.coverages.items()
                if matches(name, message.topic)
                for grant in coverage.grants
            }
            if packet.qos not in allowed:
                text = f"{session} received it as retained with QoS {packet.qos}"
                self.violation("QoS", text, message, session)
        for key in [key for key in session.owed_retained if key[0] == message.topic]:
            del session.owed_retained[key]

    def _check_shared(
        self, session: Session, packet: Publish, message: Message, matching: list[Coverage]
    ) -> None:
        self._check_qos(session, packet, message)
        group = self._groups.setdefault(matching[0].filter, Group())
        group.owed.pop(message, None)
        received = group.received.setdefault(message, [])
        received.append((session, packet.qos))
        allowed = message.sends if message.qos == 1 else 1
        assert message.sent_at is not None
        # QoS 1 may go to another member when one has left without acknowledging it.
        again_allowed = packet.qos == 1 and group.left_at >= message.sent_at
        if len(received) > allowed and not again_allowed:
            who = ", ".join(f"{member} with QoS {qos}" for member, qos in received)
            text = f"the members of {matching[0].filter} received it more than once: {who}"
            self.violation("duplicate", text, message, session)

    def _check_properties(
        self, session: Session, packet: Publish, message: Message, matching: list[Coverage]
    ) -> None:
        if packet.properties is None:
            return
        pairs = packet.properties.get(Property.USER_PROPERTY)
        if pairs is not None and pairs != [("number", str(message.number))]:
            self.violation("changed", f"{session} received it with {pairs!r}", message, session)
        identifiers = packet.properties.get(Property.SUBSCRIPTION_IDENTIFIER, [])
        allowed = {coverage.identifier for coverage in matching}
        if not (isinstance(identifiers, list) and allowed.issuperset(identifiers)):
            text = f"{session} received it with the subscription identifiers {identifiers!r}"
            self.violation("identifier", text, message, session)

    # --- the end -------------------------------------------------------------------------------

    @property
    def owed(self) -> int:
        """How many deliveries are still to come."""
        sessions = sum(len(s.owed) + len(s.owed_retained) for s in self._sessions)
        return sessions + sum(len(group.owed) for group in self._groups.values())

    def finish(self) -> None:
        """All is quiet: what is owed now is lost."""
        for session in list(self._sessions):
            for message in session.owed:
                self.violation("lost", f"{session} never received it", message, session)
            for topic, topic_filter in session.owed_retained:
                message = session.owed_retained[topic, topic_filter]
                text = f"{session} subscribed to {topic_filter} and never received it"
                self.violation("lost retained", text, message, session)
        for name, group in self._groups.items():
            for message in group.owed:
                assert message.sent_at is not None
                if group.lost_at < message.sent_at:
                    self.violation("lost", f"no member of {name} received it", message)
