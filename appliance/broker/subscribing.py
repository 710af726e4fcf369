"""SUBSCRIBE and UNSUBSCRIBE: a packet may have thousands of filters and is processed in steps.

Other clients have their turns between the steps. The packet's own client is not read meanwhile, so
that its answers keep their order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Final, TypeAlias

from appliance.broker.broker import Broker
from appliance.broker.counters import COST_PER_TURN
from appliance.broker.max_rate import max_rate
from appliance.broker.output import in_words
from appliance.broker.session import Session
from appliance.broker.values import AccessQuery, Action
from appliance.mqtt.codec import Properties, Property, quote
from appliance.mqtt.packets import (
    MAX_RATE,
    Packet,
    Suback,
    Subscribe,
    Subscription,
    Unsuback,
    Unsubscribe,
)
from appliance.mqtt.reason import ProtocolError, ReasonCode
from appliance.mqtt.topics import check_filter, parse_shared

#: The limit of levels in all filters of one SUBSCRIBE or UNSUBSCRIBE.
MAXIMUM_LEVELS = 20_000

#: The cost of adding or removing a subscription; each level of its filter adds one. The access
#: rules add what their decision takes, see `Decision.cost`.
SUBSCRIBE_COST = 20

#: The cost of checking a filter, and of looking up its retained messages.
CHECK_COST = 3
RETAINED_COST = 3


#: A filter costs one more for so many bytes, each time that it is gone through.
LONG_FILTER = 256

#: Filters whose pending decisions are requested at a time.
ASKED_AT_ONCE = 4


class AwaitingDecision:
    """Yielded instead of an answer: the work continues when a pending decision has been made."""


AWAITING_DECISION: Final = AwaitingDecision()
Step: TypeAlias = "Packet | AwaitingDecision | None"


def answers(
    broker: Broker,
    questions: Callable[[], list[AccessQuery]],
    wake: Callable[[], None],
    until: float,
) -> Iterator[Step]:
    """Wait for pending decisions, but no longer than `until`.

    `questions` returns the current queries, which a decision may change.
    """
    asked = broker.router.pending_decisions
    while asked is not None and broker.now < until:
        waiting = [question for question in questions() if asked.is_pending(question, wake)]
        if not waiting:
            return
        yield AWAITING_DECISION


def subscribe(
    broker: Broker,
    session: Session,
    packet: Subscribe,
    wake: Callable[[], None],
    *,
    max_qos: int = 2,
    explains: bool = False,
    may_explain: bool = False,
) -> Iterator[Step]:
    """Process the packet; yields its SUBACK, and None where other clients should have a turn.

    No more than `max_qos` is granted, and nothing refused for asking for more [MQTT-3.2.2-10].
    If a decision is pending, `wake` is called when the work can continue. With `explains` the
    SUBACK contains the reason of the first refusal; with `may_explain` what is wrong with its
    max-rate, which is the client's own.

    Raises:
        ProtocolError: a filter is invalid, or there are too many; then none has any effect.
    """
    turn = _Turn(broker)
    subscriptions = packet.subscriptions
    yield from _check(broker, [subscription.filter for subscription in subscriptions], turn)
    asked = broker.router.pending_decisions
    if asked is not None:
        until = broker.now + asked.timeout
        for start in range(0, len(subscriptions), ASKED_AT_ONCE):
            questions = _questions(session, subscriptions[start : start + ASKED_AT_ONCE])
            for step in answers(broker, lambda asking=questions: asking, wake, until):  # type: ignore[misc]
                yield step
                turn.begin()
            yield from turn.spend(0)
    identifiers = (packet.properties or {}).get(Property.SUBSCRIPTION_IDENTIFIER)
    identifier = identifiers[0] if isinstance(identifiers, list) else 0
    rate, problem = _rate(packet.properties)
    codes: list[int] = []
    words: Properties | None = None
    granted: list[tuple[Subscription, bool]] = []
    for subscription in subscriptions:
        if isinstance(identifier, int):
            subscription.identifier = identifier
        refusal = problem
        if rate and not problem:
            subscription.max_rate = rate
            subscription.qos = 0  # what is replaced cannot be acknowledged
            if parse_shared(subscription.filter) is not None:
                refusal = f"a shared subscription cannot have a {MAX_RATE}"
        if refusal:
            codes.append(ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR)
            name = quote(subscription.filter)
            broker.log_rate_limited(session, "cannot subscribe to %s: %s", name, refusal)
            if may_explain and words is None:
                words = in_words(f"{name}: {refusal}")
            yield from turn.spend(CHECK_COST)
            continue
        subscription.qos = min(subscription.qos, max_qos)
        is_new = subscription.filter not in session.subscriptions
        code, reason = broker.subscribe(session, subscription)
        codes.append(code)
        if code <= ReasonCode.GRANTED_QOS_2:
            granted.append((subscription, is_new))
        elif explains and words is None:  # SUBACK has one string: that of the first refusal
            words = in_words(f"{quote(subscription.filter)}: {reason}")
        yield from turn.spend(_cost(subscription.filter))
    yield Suback(packet.packet_id, codes, words)  # [MQTT-3.8.4-1], [MQTT-3.8.4-6]
    for subscription, is_new in granted:
        cost = RETAINED_COST
        if subscription.filter in session.replays:  # it is in the packet twice: replay it twice
            cost += len(session.replays) // 10
            session.pump()
        broker.replay_retained(session, subscription, is_new)
        yield from turn.spend(cost)
    session.pump()


def _rate(properties: Properties | None) -> tuple[float, str]:
    """The max-rate of the packet, 0.0 for none, and what is wrong with it, empty for nothing."""
    try:
        return max_rate(properties), ""
    except ValueError as error:
        return 0.0, str(error)


def _questions(session: Session, subscriptions: Sequence[Subscription]) -> list[AccessQuery]:
    """The access queries of subscriptions: to subscribe and, for a filter that is a topic, to
    receive its retained message."""
    if session.identity is None:
        return []
    found: list[AccessQuery] = []
    for subscription in subscriptions:
        topic_filter = subscription.filter
        found.append((session.identity, Action.SUBSCRIBE, topic_filter))
        if "+" not in topic_filter and "#" not in topic_filter and topic_filter[:7] != "$share/":
            found.append((session.identity, Action.RECEIVE, topic_filter))
    return found


def unsubscribe(broker: Broker, session: Session, packet: Unsubscribe) -> Iterator[Step]:
    """Process the packet; yields its UNSUBACK, and None as `subscribe` does.

    Raises:
        ProtocolError: a filter is invalid, or there are too many; then none has any effect.
    """
    turn = _Turn(broker)
    yield from _check(broker, packet.filters, turn)
    codes: list[int] = []
    for name in packet.filters:
        codes.append(broker.unsubscribe(session, name))
        yield from turn.spend(_cost(name))
    yield Unsuback(packet.packet_id, codes)  # [MQTT-3.10.4-4], [MQTT-3.11.3-1]


def _cost(name: str) -> int:
    """The cost of adding or removing a subscription with this filter."""
    return SUBSCRIBE_COST + name.count("/") + len(name) // LONG_FILTER


class _Turn:
    """A turn ends when its cost is used up: by what is spent here, and by all that the work on a
    filter adds elsewhere, such as the rules that are looked at."""

    def __init__(self, broker: Broker) -> None:
        self._counters = broker.counters
        self.begin()

    def begin(self) -> None:
        """A turn begins; others have had theirs."""
        self._end = self._counters.cost + COST_PER_TURN

    def spend(self, cost: int) -> Iterator[None]:
        """Add cost; yields when the turn is over, and then the next one begins."""
        self._counters.cost += cost
        if self._counters.cost >= self._end:
            yield None
            self.begin()


def _check(broker: Broker, filters: Sequence[str], turn: _Turn) -> Iterator[None]:
    """Raises a ProtocolError if a filter is invalid, or the levels are too many; in steps."""
    if sum(name.count("/") + 1 for name in filters) > MAXIMUM_LEVELS:
        raise ProtocolError(
            ReasonCode.QUOTA_EXCEEDED, f"more than {MAXIMUM_LEVELS} levels in one packet"
        )
    for name in filters:
        _check_filter(broker, name)
        yield from turn.spend(CHECK_COST + len(name) // LONG_FILTER)


def _check_filter(broker: Broker, topic_filter: str) -> None:
    """Raises a ProtocolError if it is not a valid topic filter, shared or not (section 4.7)."""
    try:
        check_filter(topic_filter)
    except ValueError as error:
        raise ProtocolError(ReasonCode.MALFORMED_PACKET, str(error)) from None
    try:
        shared = parse_shared(topic_filter)
    except ValueError as error:
        raise ProtocolError(ReasonCode.PROTOCOL_ERROR, str(error)) from None
    excess = broker.router.excess(shared[1] if shared else topic_filter)
    if excess:
        raise ProtocolError(ReasonCode.MALFORMED_PACKET, f"a topic filter with {excess}")
