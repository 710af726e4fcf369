"""The local side of what a link sends: a session here that hands messages to the link's backlog.

It exists as long as the link is configured, connected or not. Its subscriptions have QoS 0 and its
link takes each message within `Broker.publish_to`: the backlog stages it there, and so the
publisher is acknowledged when it is stored. The session has the rights of the link's user; only the
topics that stand for Response Topics at the fleet belong to a session of the link itself, which
needs no rights for them.

Retained messages that are here when the session is attached, or when a rule of access lets it
subscribe, are offered once, in turns; their changes come as messages.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from appliance.broker.accounts import Account
from appliance.broker.broker import Broker
from appliance.broker.link import InsideLink, ReceivingLink
from appliance.broker.message import Message
from appliance.broker.session import Session, publisher_of
from appliance.broker.values import Action, Identity, PublishRejection
from appliance.mqtt.codec import (
    MAXIMUM_PAIRS,
    V5,
    Properties,
    Property,
    encode_properties,
    encode_string,
)
from appliance.mqtt.framing import cost_of
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ProtocolError, ReasonCode
from appliance.upstream.answers import Answers
from appliance.upstream.loops import with_via
from appliance.upstream.publish_properties import LARGEST_KEPT, printable
from appliance.upstream.rules import LinkRules, OutRule, UpstreamSettings
from appliance.upstream.sessions import (
    answers_client_id,
    in_client_id,
    kept_client_id,
    out_client_id,
)

#: The cost of mapping a message and storing it, see `Counters.cost`; and of changing its Response
#: Topic, for which its properties are decoded.
OFFER_COST = 2
REQUEST_COST = 5

_RESPONSE_TOPIC = bytes((Property.RESPONSE_TOPIC,))


class Offers(Protocol):
    """Takes what is to be sent: the link's backlog."""

    @property
    def is_behind_disk(self) -> bool:
        """Whether `must_wait` may be true of some message."""

    def must_wait(
        self, rule: OutRule, topic: str, qos: int, retain: bool, size: int, user: str | None
    ) -> bool:
        """Whether the publisher of such a message, of QoS 1 or 2 and so many bytes, should wait
        until more of what is stored is written."""

    def offer(
        self,
        rule: OutRule,
        topic: str,
        payload: bytes,
        qos: int,
        retain: bool,
        properties_wire: bytes,
        expires_at: float | None,
        now: float,
        *,
        is_acknowledged: bool = True,
        user: str | None = None,
    ) -> str | None:
        """Take a message for the topic there; returns None, or why it is refused (0x97).

        Times are in seconds of the clock of the backlogs. A message of QoS 1 or 2 that nobody is
        acknowledged for, and that is not retained here, may be dropped where the disk is too slow.
        `user` has published it, see `UserShares`.
        """

    @property
    def work(self) -> int:
        """The work of all that was dropped to make room, see `Counters.cost`."""

    @property
    def is_owing(self) -> bool:
        """Whether `drop_more` has something to do."""

    def drop_more(self) -> None:
        """Drop more of what is too old or displaced, a part."""


@dataclass(slots=True)
class OutCounters:
    """What is counted of a link's out session since the start."""

    offered: int = 0
    #: Because the backlog is full, or the store fails.
    refused: int = 0
    #: Requests that go out without the Response Topic, which their publisher may not use.
    unanswerable: int = 0


class OutSession:
    """Subscribes to the `out` rules of one link, and offers what matches to its backlog.

    `clock` returns the time of the backlogs' clock. `later` schedules a call of `take_turn` in a
    later turn. After `attach` and `take_turn` `Broker.flush` is to be called.
    """

    def __init__(
        self,
        broker: Broker,
        settings: UpstreamSettings,
        rules: LinkRules,
        answers: Answers,
        backlog: Offers,
        clock: Callable[[], float],
        later: Callable[[], None],
    ) -> None:
        self.counters = OutCounters()
        #: The version of MQTT that the link speaks there.
        self.version = settings.version
        #: The filters that the access rules do not let it subscribe to, with the reason.
        self.denied: dict[str, str] = {}
        self._broker = broker
        self._settings = settings
        self._rules = rules
        self._answers = answers
        self._backlog = backlog
        self._clock = clock
        self._later = later
        name = settings.name
        self._identity = Identity(settings.user, out_client_id(name))
        #: What these sessions publish comes from there, and is not sent back.
        self._own = frozenset((in_client_id(name), kept_client_id(name), answers_client_id(name)))
        self._filters = rules.out_filters
        self._session: Session | None = None
        self._answering: Session | None = None
        #: Whether filters that are not subscribed to are asked about in the next turn.
        self._must_ask = False
        #: The properties that were looked at last, and what of them is sent.
        self._looked_at = self._found = b""
        #: The work of the backlog that is counted as the broker's.
        self._counted = backlog.work

    def attach(self) -> None:
        """Subscribe here, and begin to offer the retained messages."""
        self._session = self._broker.attach(
            self._identity.client_id, _OutLink(self), self._identity
        )
        self._answering = self._broker.attach(
            answers_client_id(self._settings.name), _AnswersLink(self)
        )
        wanted = Subscription(self._rules.answers.local_filter, 0, retain_handling=2)
        self._broker.subscribe(self._answering, wanted)
        self._subscribe(self._session)

    def detach(self) -> None:
        """Take nothing more; may be called twice."""
        for session in (self._session, self._answering):
            if session is not None:
                self._broker.detach(session)
        self._session = self._answering = None

    @property
    def answering(self) -> Session | None:
        """The link's own session, which publishes answers from there; None when not attached."""
        return self._answering

    def take_turn(self) -> None:
        """Continue with the retained messages, with filters whose rights were not decided, and with
        what the backlog drops."""
        session = self._session
        if session is None:
            return
        backlog = self._backlog
        if backlog.is_owing:
            backlog.drop_more()
            self.has_dropped()
        if self._must_ask:
            self._subscribe(session)
        session.take_turn()

    def has_dropped(self) -> None:
        """Count what the backlog has dropped; let it go on in a later turn if there is more."""
        work = self._backlog.work
        self._broker.counters.cost += work - self._counted
        self._counted = work
        if self._session is not None and self._backlog.is_owing:
            self._later()

    # --- subscriptions -------------------------------------------------------------------------

    def rules_changed(self) -> None:
        """The access rules have changed: ask anew what may be subscribed to."""
        session = self._session
        if session is None:
            return
        for name in list(session.subscriptions):
            decision = self._broker.router.decide(self._identity, Action.SUBSCRIBE, name)
            if not decision and not decision.pending:
                self._broker.unsubscribe(session, name)
        self._ask_later()  # the rules may change while another client is served

    def _ask_later(self) -> None:
        self._must_ask = True
        self._later()

    def _subscribe(self, session: Session) -> None:
        """Subscribe to the filters that are not subscribed to, if the access rules allow it."""
        self._must_ask = False
        for number, name in enumerate(self._filters, 1):
            if name in session.subscriptions or self._is_undecided(name):
                continue
            if name in self.denied:
                decision = self._broker.router.decide(self._identity, Action.SUBSCRIBE, name)
                if (
                    not decision and not decision.pending
                ):  # still, which needs no other line in the log
                    self.denied[name] = decision.reason
                    continue
            # The identifier tells by which filter a retained message was found.
            wanted = Subscription(name, 0, retain_as_published=True, identifier=number)
            code, reason = self._broker.subscribe(session, wanted)
            if code <= ReasonCode.GRANTED_QOS_2:
                self.denied.pop(name, None)
                self._broker.send_retained(session, wanted, True)
            else:
                self.denied[name] = reason

    def _is_undecided(self, name: str) -> bool:
        """Whether a plugin has not decided yet; it is asked about again when it has."""
        pending = self._broker.router.pending_decisions
        query = self._identity, Action.SUBSCRIBE, name
        return pending is not None and pending.is_pending(query, self._ask_later)

    # --- messages ------------------------------------------------------------------------------

    def must_wait(self, message: Message, client_id: str) -> bool:
        """Whether that client's message of QoS 1 or 2 has to wait for the disk."""
        found = self._rules.out(message.topic) if client_id not in self._own else None
        return found is not None and self._must_wait(*found, message, client_id)

    def must_wait_to_answer(self, message: Message, client_id: str) -> bool:
        """Whether that client's answer to a request from there has to wait for the disk."""
        rule = self._rules.answers
        return client_id not in self._own and self._must_wait(rule, "", message, client_id)

    def _must_wait(self, rule: OutRule, topic: str, message: Message, client_id: str) -> bool:
        session = self._broker.sessions.get(client_id)
        user = None if session is None else _user_of(session.account)
        retain = message.retain if rule.retain is None else rule.retain
        return self._backlog.must_wait(rule, topic, message.qos, retain, message.size, user)

    def take(self, message: Message, retain: bool, subscription_ids: list[int] | None) -> None:
        """Offer a message that one of the filters matches."""
        publisher = message.publisher
        if publisher is not None and publisher.client_id in self._own:
            return
        found = self._rules.out(message.topic)
        if found is None:
            return
        rule, topic = found
        # A retained message is found by each filter that matches it, and offered once.
        is_found_again = (
            publisher is None
            and subscription_ids is not None
            and self._filters[subscription_ids[0] - 1] != rule.local_filter
        )
        if not is_found_again:
            self._offer(rule, topic, message)

    def take_answer(
        self, message: Message, retain: bool, subscription_ids: list[int] | None
    ) -> None:
        """Offer an answer to a request from there."""
        publisher = message.publisher
        if publisher is not None and publisher.client_id in self._own:
            return  # a loop: what came from there is no answer to it
        topic = self._answers.for_answer_out(message.topic, self._broker.now)
        if topic is not None:
            self._offer(self._rules.answers, topic, message)

    def _offer(self, rule: OutRule, topic: str, message: Message) -> None:
        """Hand the message to the backlog; its publisher is told if that does not take it."""
        broker, backlog = self._broker, self._backlog
        broker.counters.cost += OFFER_COST
        now = self._clock()
        expires_at = message.expires_at
        if expires_at is not None:
            expires_at += now - broker.now
            if expires_at <= now:
                return
        retain = message.retain if rule.retain is None else rule.retain
        try:
            topic, properties = self._properties(topic, message)
            refusal = backlog.offer(
                rule,
                topic,
                message.payload,
                message.qos,  # how it waits; the rule's `qos` is about how it is sent
                retain,
                properties,
                expires_at,
                now,
                is_acknowledged=_is_acknowledged(publisher_of(message)),
                user=self._user(message),
            )
            self.has_dropped()
            if backlog.is_behind_disk:
                broker.disk.begin()
        except Exception:
            # The broker contains the fault. What is not in the backlog is not acknowledged.
            message.rejection = PublishRejection(
                ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR, "a fault in the appliance, see its log"
            )
            raise
        if refusal is None:
            self.counters.offered += 1
        else:
            self.counters.refused += 1
            if message.publisher is not None:
                reason = f"upstream '{self._settings.name}': {refusal}"
                message.rejection = PublishRejection(ReasonCode.QUOTA_EXCEEDED, reason)

    def _user(self, message: Message) -> str | None:
        """Who has published it, see `UserShares`."""
        publisher = publisher_of(message)
        if publisher is not None:
            return _user_of(publisher.account)
        retained = self._broker.retained
        if retained.get(message.topic) is None:
            return None
        return _user_of(retained.owner(message.topic))

    def _properties(self, topic: str, message: Message) -> tuple[str, bytes]:
        """The topic and the encoded properties there."""
        wire = message.properties_wire
        if _RESPONSE_TOPIC in wire:  # most messages have none, and nothing has to be decoded
            properties = message.properties or {}
            wanted = properties.get(Property.RESPONSE_TOPIC)
            if isinstance(wanted, str):
                self._broker.counters.cost += REQUEST_COST
                publisher = publisher_of(message)
                topic, properties = self._request(topic, wanted, publisher, properties)
                wire = encode_properties(properties)
        return topic, with_via(self._printable(wire), self._settings.robot)

    def _printable(self, wire: bytes) -> bytes:
        """`printable`; most messages have none, or the same as the one before."""
        if len(wire) == 1:
            return wire
        if wire == self._looked_at:
            return self._found
        self._broker.counters.cost += cost_of(MAXIMUM_PAIRS, len(wire))
        found = printable(wire)
        if len(wire) <= LARGEST_KEPT:
            self._looked_at, self._found = wire, found
        return found

    def _request(
        self, topic: str, wanted: str, publisher: Session | None, properties: Properties
    ) -> tuple[str, Properties]:
        """The topic and properties there of a request: its answer comes to the link."""
        now = self._broker.now
        response_topic: str | None = None
        if publisher is not None and self._may_be_answered(publisher, wanted):
            user = publisher.account.username
            if self.version == V5:
                response_topic = self._answers.for_request_out(wanted, now, user)
            else:
                called = self._answers.for_call_out(topic, wanted, now, user)
                if called is not None:
                    return called, properties
        properties = dict(properties)
        if response_topic is None:
            self.counters.unanswerable += 1
            del properties[Property.RESPONSE_TOPIC]
        else:
            properties[Property.RESPONSE_TOPIC] = response_topic
        return topic, properties

    def _may_be_answered(self, publisher: Session, topic: str) -> bool:
        """Whether the requester may publish to its Response Topic, where the answer will be.

        A topic with a guard is one of commands to ROS: no answer may be one.
        """
        if topic in self._broker.guards:
            return False
        try:
            return self._broker.route(publisher, encode_string(topic)).allowed
        except (ProtocolError, ValueError):
            return False


def _user_of(account: Account) -> str | None:
    """The user of an account, see `UserShares`; all anonymous clients are one."""
    return None if account.is_inside else account.username or ""


def _is_acknowledged(publisher: Session | None) -> bool:
    """Whether somebody is acknowledged for what the session publishes with QoS 1 or 2; without a
    session it is a retained message, and somebody was."""
    if publisher is None:
        return True
    link = publisher.link
    return link.acknowledges if isinstance(link, InsideLink) else True


class _AnswersLink(ReceivingLink):
    """The link of the session that takes the answers to requests from there, and publishes what
    comes as answers to requests from here."""

    acknowledges = True

    def __init__(self, owner: OutSession) -> None:
        super().__init__(owner.take_answer)
        self._owner = owner

    def must_wait(self, message: Message, client_id: str) -> bool:
        """Wait with answers, too."""
        return self._owner.must_wait_to_answer(message, client_id)


class _OutLink(ReceivingLink):
    """The link of the session that subscribes to the filters of the rules."""

    def __init__(self, owner: OutSession) -> None:
        super().__init__(owner.take)
        self._owner = owner

    def must_wait(self, message: Message, client_id: str) -> bool:
        """Wait with what would be in memory beyond the limit, because the disk is too slow."""
        return self._owner.must_wait(message, client_id)

    def later(self) -> None:
        """There are more retained messages than one turn may offer."""
        self._owner._later()

    def rules_changed(self) -> None:
        """Ask anew what may be subscribed to."""
        self._owner.rules_changed()
