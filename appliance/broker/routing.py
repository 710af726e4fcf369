"""Routing: which subscriptions match a topic, and what the access rules allow."""

from __future__ import annotations

from dataclasses import dataclass

from appliance.broker.accounting import Accounting
from appliance.broker.max_rate import RatedTarget, RateLimit
from appliance.broker.ports import Access, PendingDecisions, PublishGuard
from appliance.broker.session import Session
from appliance.broker.shared import Share, Target, as_target
from appliance.broker.values import AccessQuery, Action, Decision, Identity
from appliance.mqtt.codec import decode_string, text_size
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ProtocolError, ReasonCode
from appliance.mqtt.topics import SubscriptionTree, check_topic, parse_shared

#: The limit of cached routes per session; the cache is cleared above it, so that invented topics
#: cannot make it grow.
CACHED_ROUTES = 1024

#: The longest topic whose route is cached, in bytes.
CACHED_TOPIC = 512

#: The memory of a cache entry beside its topic, in bytes, and of each of its targets.
ROUTE_SIZE = 350
TARGET_SIZE = 96

#: The limit of the caches of all sessions, as a fraction of `limits.memory` and in addition to it.
CACHED_IN_ALL = 1 / 8

#: Pending decisions on one route that a message waits for at a time.
UNDECIDED = 16

#: The cost of looking up a route, see `Counters.cost`; each match adds one unit, and so do
#: VISITED_PER_COST_UNIT levels and nodes that the search visits.
ROUTE_COST = 20
VISITED_PER_COST_UNIT = 4

_ALLOWED = Decision(True, "the appliance itself")
_OF_OTHERS = Decision(False, "calls of the appliance are for itself alone")
_FAULT = Decision(False, "a fault in the appliance, see its log", pending=True)


@dataclass(slots=True)
class Fanout:
    """The route of one topic for one publishing session; valid until the epoch changes."""

    topic: str
    allowed: bool
    #: The rule that allowed or denied it.
    reason: str
    #: Whether it was a guard that denied it, not an access rule.
    is_guarded: bool
    targets: list[Target]
    #: Shared subscriptions, each with the members that may receive the topic.
    shares: list[tuple[Share, list[Target]]]
    #: Receivers that have asked for no more than a rate.
    rated: list[RatedTarget]
    #: Whether `targets` are all receivers: there are neither shares nor rates.
    is_plain: bool
    #: Whether the topic has any subscription, even of a client that may not receive it.
    subscribed: bool
    #: Decisions that are pending; a route with any is not cached.
    undecided: list[AccessQuery]


class Router:
    """Finds the route of a topic, and caches it in the publishing session until the epoch changes.

    `sessions` are all sessions by client id; they contain the caches.
    """

    def __init__(
        self, access: Access, accounting: Accounting, sessions: dict[str, Session]
    ) -> None:
        #: The access rules in force.
        self.access = access
        #: The rules if they may have to wait for a plugin's answer; None if they never do.
        self.pending_decisions: PendingDecisions | None = None
        #: The pending decisions of the route that is being looked up.
        self._undecided: list[AccessQuery] | None = None
        #: What topics begin with that only the appliance itself publishes, whatever the rules say.
        self.reserved: tuple[str, ...] = ("$",)
        #: Topics among these at which clients call the appliance, with a token as one more level or
        #: without. The access rules decide who may; nobody else receives what is published there.
        self.calls: frozenset[str] = frozenset()
        #: By topic, the parts of the appliance that restrict who may publish to it.
        self.guards: dict[str, list[PublishGuard]] = {}
        #: Incremented whenever a cached route may be outdated.
        self.epoch = 0
        #: Shared subscriptions by their whole filter.
        self.shares: dict[str, Share] = {}
        self._accounting = accounting
        self._counters = accounting.counters
        self._faults = accounting.faults
        self._sessions = sessions
        self._subscriptions: SubscriptionTree[tuple[Session, Subscription] | Share] = (
            SubscriptionTree()
        )
        #: Bytes that were added to the sessions' caches since these were last cleared.
        self._cached = 0

    def __len__(self) -> int:
        """Subscriptions of all sessions; a shared one counts once."""
        return len(self._subscriptions)

    def changed(self) -> None:
        """Invalidate all cached routes."""
        self.epoch += 1

    def join(self, session: Session, subscription: Subscription) -> None:
        """Add a subscription to the tree, or a member to its group."""
        self.epoch += 1
        topic_filter = subscription.filter
        shared = parse_shared(topic_filter)
        if shared is None:
            self._subscriptions.add(topic_filter, session, (session, subscription))
            return
        share = self.shares.get(topic_filter)
        if share is None:
            share = self.shares[topic_filter] = Share(topic_filter)
            self._subscriptions.add(shared[1], topic_filter, share)
        share.join(session, subscription)

    def leave(self, session: Session, topic_filter: str) -> None:
        """Remove a subscription from the tree, or a member from its group; may be called twice."""
        self.epoch += 1
        share = self.shares.get(topic_filter)
        if share is None:
            self._subscriptions.remove(topic_filter, session)
            return
        share.leave(session)
        if not share.members:
            _, inner = parse_shared(topic_filter) or ("", "")
            self._subscriptions.remove(inner, topic_filter)
            del self.shares[topic_filter]

    def route(self, session: Session, topic_wire: bytes) -> Fanout:
        """The route of the session's messages to the topic, looked up once in an epoch.

        Raises:
            ProtocolError: the topic is not valid; the connection has to end.
        """
        if session.epoch != self.epoch or len(session.routes) >= CACHED_ROUTES:
            session.routes.clear()
            session.epoch = self.epoch
        route: Fanout | None = session.routes.get(topic_wire)
        if route is None:
            route = self._find_route(session, topic_wire)
            if len(topic_wire) <= CACHED_TOPIC and not route.undecided:
                session.routes[topic_wire] = route
                self._count_cached(_route_size(route, topic_wire))
        return route

    def _count_cached(self, size: int) -> None:
        self._cached += size
        if self._cached > self._accounting.limits.memory * CACHED_IN_ALL:
            self._clear_caches()

    def _clear_caches(self) -> None:
        self._cached = 0
        for session in self._sessions.values():
            session.routes.clear()
            session.readable.clear()

    def _find_route(self, session: Session, topic_wire: bytes) -> Fanout:
        topic, _ = decode_string(topic_wire, 0)
        try:
            check_topic(topic)
        except ValueError as error:
            raise ProtocolError(ReasonCode.MALFORMED_PACKET, str(error)) from None
        undecided: list[AccessQuery] = []
        self._undecided = undecided
        try:
            route = self._decide_route(session, topic, undecided)
        finally:
            self._undecided = None
        # An alias of two bytes may stand for it, and each receiver is sent all of it.
        self._counters.cost += (len(topic_wire) + len(route.targets) * len(topic_wire) // 16) >> 8
        return route

    def _decide_route(self, session: Session, topic: str, undecided: list[AccessQuery]) -> Fanout:
        decision = self._may_publish(session, topic)
        is_guarded = False
        if decision and topic in self.guards:
            verdicts = [
                self._faults.run("broker.guard", guard.decide, session, otherwise=_FAULT)
                for guard in self.guards[topic]
            ]
            decision = next((verdict for verdict in verdicts if not verdict), decision)
            is_guarded = not decision
        self._counters.cost += ROUTE_COST
        matches = self._match(topic) if decision else []
        targets, shares, rated = self._targets(session, topic, matches)
        return Fanout(
            topic,
            decision.allowed,
            decision.reason,
            is_guarded,
            targets,
            shares,
            rated,
            not shares and not rated,
            bool(matches),
            undecided,
        )

    def _match(self, topic: str) -> list[tuple[Session, Subscription] | Share]:
        found = self._subscriptions.match(topic)
        self._counters.cost += len(found) + self._subscriptions.visited // VISITED_PER_COST_UNIT
        return found

    def _may_publish(self, session: Session, topic: str) -> Decision:
        if session.identity is None:
            return _ALLOWED
        excess = self.excess(topic)
        if excess:  # [MQTT-4.13.1-1]; as mosquitto does
            raise ProtocolError(ReasonCode.MALFORMED_PACKET, f"a topic with {excess}")
        return self.may_publish(session.identity, topic)

    def may_publish(self, identity: Identity, topic: str) -> Decision:
        """Whether the client may publish to the valid topic."""
        beginning = self.reserved_for(topic)
        if beginning:  # [MQTT-4.7.2-1]: for the server's own use
            return Decision(False, f"topics that begin with {beginning} are the broker's own")
        return self.decide(identity, Action.PUBLISH, topic)

    def reserved_for(self, topic: str) -> str:
        """What a topic begins with at which no client publishes, whatever the rules say; empty if
        the rules decide."""
        for beginning in self.reserved:
            if topic.startswith(beginning) and not self._is_call(topic):
                return beginning
        return ""

    def _is_call(self, topic: str) -> bool:
        return topic in self.calls or topic.rpartition("/")[0] in self.calls

    def decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        """The decision of the access rules; an exception in them denies."""
        if action is Action.RECEIVE and topic[0] == "$" and self._is_call(topic):
            return _OF_OTHERS  # there may be a password in it
        decision = self._faults.run(
            "broker.access", self.access.decide, identity, action, topic, otherwise=_FAULT
        )
        self._counters.cost += decision.cost
        undecided = self._undecided
        is_asked = self.pending_decisions is not None and decision is not _FAULT
        if decision.pending and is_asked and undecided is not None and len(undecided) < UNDECIDED:
            undecided.append((identity, action, topic))
        return decision

    def excess(self, topic: str) -> str:
        """Which limit the topic or filter exceeds; empty for none."""
        limits = self._accounting.limits
        if topic.count("/") >= limits.topic_levels:
            return f"more than {limits.topic_levels} levels (broker.limits.topic_levels)"
        if len(topic) > limits.topic_length // 4 and len(topic.encode()) > limits.topic_length:
            return f"more than {limits.topic_length} bytes (broker.limits.topic_length)"
        return ""

    def is_watched(self, topic: str) -> bool:
        """Whether a connected client that may read the topic has asked for it by its last level.

        Who has subscribed to `#` has not asked for it, but receives it as well.
        """
        ending = topic.rpartition("/")[2]
        for match in self._subscriptions.match(topic):
            members = match.members if isinstance(match, Share) else dict((match,))
            for session, subscription in members.items():
                is_named = subscription.filter.rpartition("/")[2] == ending
                if is_named and session.link is not None and self.may_receive(session, topic):
                    return True
        return False

    def _targets(
        self, origin: Session, topic: str, matches: list[tuple[Session, Subscription] | Share]
    ) -> tuple[list[Target], list[tuple[Share, list[Target]]], list[RatedTarget]]:
        """One target per session, however many of its subscriptions match [MQTT-3.3.5-1].

        Shared subscriptions are separate: a session gets a further copy for each group that chooses
        it (5.0 section 4.8.2).
        """
        merged: dict[str, Target] = {}
        shares: list[tuple[Share, list[Target]]] = []
        rated: list[tuple[Session, Subscription]] = []
        for match in matches:
            if isinstance(match, Share):
                shares.append((match, self._members(match, topic)))
                continue
            session, subscription = match
            if subscription.no_local and session is origin:  # [MQTT-3.8.3-3]
                continue
            if subscription.max_rate:
                rated.append((session, subscription))
                continue
            known = merged.get(session.client_id)
            receiver, qos, as_published, ids = known or (session, 0, False, None)
            if subscription.identifier:  # [MQTT-3.3.4-4]
                ids = [*(ids or []), subscription.identifier]
            merged[session.client_id] = (
                receiver,
                max(qos, subscription.qos),
                as_published or subscription.retain_as_published,
                ids,
            )
        limited = self._rated_targets(topic, rated, merged) if rated else []
        targets = [target for target in merged.values() if self.may_receive(target[0], topic)]
        return targets, shares, limited

    def _rated_targets(
        self,
        topic: str,
        rated: list[tuple[Session, Subscription]],
        merged: dict[str, Target],
    ) -> list[RatedTarget]:
        """The receivers of subscriptions with a rate, one target per session.

        The highest rate holds for all that match, and none where one of them has none: then the
        subscription's options are added to the target in `merged`.
        """
        found: dict[str, tuple[Session, RateLimit, bool, list[int] | None]] = {}
        for session, subscription in rated:
            name = session.client_id
            limit = session.rate_limits[subscription.filter]
            as_published = subscription.retain_as_published
            ids = [subscription.identifier] if subscription.identifier else None
            if name in merged:
                receiver, qos, other, more = merged[name]
                both = [*(more or []), *(ids or [])] or None
                merged[name] = (receiver, qos, other or as_published, both)
                continue
            if name in found:
                _, best, other, more = found[name]
                limit = best if best.rate >= limit.rate else limit
                as_published |= other
                ids = [*(more or []), *(ids or [])] or None
            found[name] = (session, limit, as_published, ids)
        return [
            (limit, as_published, ids)
            for session, limit, as_published, ids in found.values()
            if self.may_receive(session, topic)
        ]

    def _members(self, share: Share, topic: str) -> list[Target]:
        """The members of the group that may receive the topic.

        All are checked, so that a group gets the message if any member may receive it. The cost is
        counted for the publisher.
        """
        self._counters.cost += len(share.members)
        return [
            as_target(session, subscription)
            for session, subscription in share.members.items()
            if self.may_receive(session, topic)
        ]

    def may_receive(self, session: Session, topic: str) -> bool:
        """Whether the rules in force let the session receive the topic's messages."""
        if session.identity is None:
            return True
        # Cached apart from the routes, which every new subscription invalidates: otherwise the
        # rules would be evaluated again for all receivers of a topic.
        readable = session.readable
        if session.readable_epoch != self.access.epoch or len(readable) >= CACHED_ROUTES:
            readable.clear()
            session.readable_epoch = self.access.epoch
        allowed = readable.get(topic)
        if allowed is None:
            self._counters.cost += 1
            decision = self.decide(session.identity, Action.RECEIVE, topic)
            allowed = decision.allowed
            if len(topic) <= CACHED_TOPIC and not decision.pending:
                readable[topic] = allowed
                self._cached += TARGET_SIZE + text_size(topic)
        return allowed

    def may_still_receive(self, session: Session, topic: str) -> bool:
        """Whether a queued message may still be sent.

        It was allowed when it was queued, and stays so while a plugin's new decision is pending.
        """
        if session.identity is None or self.may_receive(session, topic):
            return True
        return self.decide(session.identity, Action.RECEIVE, topic).pending


def _route_size(route: Fanout, topic_wire: bytes) -> int:
    """The memory of a route in the cache of its session, in bytes."""
    size = ROUTE_SIZE + text_size(route.topic) + len(topic_wire)
    members = [target for _, members in route.shares for target in members]
    for _, _, _, ids in (*route.targets, *members):
        size += TARGET_SIZE + 8 * len(ids or ())
    for _, _, ids in route.rated:
        size += TARGET_SIZE + 8 * len(ids or ())
    return size
