"""The broker: connect · publish · subscribe · unsubscribe · disconnect · tick(now).

Only one thread may call it. It does no I/O: messages go to `Link`s, and `flush` makes the network
clients write what they were sent while one received chunk was processed.
"""

from __future__ import annotations

import heapq
import itertools
import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import timedelta
from typing import Final, Protocol, TypeAlias

from appliance.broker.accounts import Account, AccountedSession
from appliance.broker.backpressure import Congestion, DiskCongestion
from appliance.broker.delivery import Delivery, PendingWill, UnreleasedPublish
from appliance.broker.faults import Faults
from appliance.broker.limits import Features, Limits
from appliance.broker.link import InsideLink, Link
from appliance.broker.message import DelayedMessage, HeaderCache, Message
from appliance.broker.ports import Access, AuditLog, Observer
from appliance.broker.rate_limited_log import RateLimitedLog
from appliance.broker.retained import RetainedMessages
from appliance.broker.routing import Fanout, Router
from appliance.broker.session import Session, SessionAccounting, subscription_size
from appliance.broker.shared import Heirs, Share, Target
from appliance.broker.store import Store
from appliance.broker.values import INSIDE, Action, Identity, PublishRejection
from appliance.mqtt.codec import quote
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ProtocolError, ReasonCode
from appliance.mqtt.topics import check_filter, parse_shared

log = logging.getLogger(__name__)

#: Seconds that a QoS 2 exchange may take before its message counts as delayed.
DELAYED_AFTER: Final = 0.1

#: Receivers that are checked for room for one unit of cost.
CHECKS_PER_COST_UNIT: Final = 4

#: Limits of one tick: connections, wills and sessions that it ends, and its cost, which is about
#: ten milliseconds of work.
ENDINGS_PER_TICK = 128
COST_PER_TICK = 2600


#: The cost of refusing a message, of holding a QoS 2 message until its PUBREL and releasing it, and
#: of creating or resuming a session.
REFUSAL_COST = 2
HELD_COST: Final = 3
CONNECT_COST = 50

#: The cost of ending a connection or a session, and of removing one of its subscriptions from the
#: tree; LEVELS_PER_COST_UNIT levels of the filter add one unit.
ENDING_COST = 10
LEAVING_COST = 3
LEVELS_PER_COST_UNIT = 4


class Ticking(Protocol):
    """A network client as the broker's clock and its store call it."""

    def tick(self, now: float) -> bool:
        """Check its keep alive; True when that ended the connection."""

    def resume(self) -> None:
        """The store works again: continue what waited for it."""

    def fault(self) -> None:
        """End the connection because an internal error occurred in it."""

    def cut_off(self) -> None:
        """Abort the connection because even `fault` failed; never raises."""


class Flushing(Protocol):
    """The output of a network client as the flush and the commits call it."""

    def flush(self) -> None:
        """Write the buffered packets."""

    def wait(self, committed: int) -> bool:
        """Hold the buffered packets back if they depend on a later batch than `committed`."""

    def release(self, committed: int) -> bool:
        """Write the packets whose batch is committed; True when others still wait."""

    def abandon(self) -> None:
        """Close the connection without writing the buffered packets."""


#: The receiver of a message: a session, or one member of a group.
Receiver: TypeAlias = "Session | Share"


def _has_all(account: Account, held: int, what: str) -> ProtocolError:
    text = f"{account} has {held} {what}, as many as a user may have (broker.limits.user.{what})"
    return ProtocolError(ReasonCode.QUOTA_EXCEEDED, text)


def _all_taken(account: Account, held: int, what: str, limit: int) -> ProtocolError:
    text = f"all {limit} {what} are in use (broker.limits.{what}); {account} has {held} of them"
    return ProtocolError(ReasonCode.QUOTA_EXCEEDED, text)


class Broker:
    """The sessions, subscriptions and retained messages of one broker."""

    def __init__(
        self,
        access: Access,
        store: Store,
        limits: Limits | None = None,
        features: Features | None = None,
    ) -> None:
        self.store = store
        self.limits = limits or Limits()
        self.features = features or Features()
        self.rate_limited_log = RateLimitedLog()
        #: When `tick` last finished.
        self.ticked_at = -math.inf
        #: Internal errors that were caught at an entry point.
        self.faults = Faults(self.rate_limited_log)
        self.accounting = SessionAccounting(self.limits, store, faults=self.faults)
        self.counters = self.accounting.counters
        self.disk = DiskCongestion(self.accounting)
        self.rates = self.accounting.rates
        self.sessions: dict[str, Session] = {}
        self.router = Router(access, self.accounting, self.sessions)
        self.accounting.may_still_receive = self.router.may_still_receive
        self.retained = RetainedMessages(
            self.accounting, self.rate_limited_log, self._retained_changed
        )
        self.header_cache = HeaderCache()
        self.observer: Observer | None = None
        #: By topic, the parts of the appliance that restrict who may publish to it. Their decisions
        #: are cached until `guards_changed`.
        self.guards = self.router.guards
        #: Called with each session whose connection has ended, before its will is published.
        self.departures: list[Callable[[Session], None]] = []
        #: Asked why a message to a topic would be lost now, although it is published here: the
        #: bridge to ROS may not be ready. Each returns an empty string when it would not.
        self.obstacles: list[Callable[[str], str]] = []
        self.audit_log: AuditLog | None = None
        #: Network clients with a connection in the state CONNECTED.
        self.clients: set[Ticking] = set()
        #: The outputs of network clients with bytes to write.
        self.unflushed: list[Flushing] = []
        #: The outputs whose packets wait for a commit, in the order in which they began to wait.
        self._waiting: dict[Flushing, None] = {}
        store.listen(self._committed)
        self._deadlines: list[tuple[float, int, Session]] = []
        self._order = itertools.count()

    @property
    def now(self) -> float:
        """Seconds of the clock that `tick` was last given."""
        return self.accounting.now

    @property
    def subscription_count(self) -> int:
        """Subscriptions of all sessions; a shared one counts once."""
        return len(self.router)

    @property
    def shared_subscription_count(self) -> int:
        """Shared subscriptions; the number of their members does not matter."""
        return len(self.router.shares)

    # --- sessions ------------------------------------------------------------------------------

    def connect(
        self,
        link: Link,
        identity: Identity,
        *,
        clean_start: bool,
        expiry: int,
        will: PendingWill | None,
    ) -> tuple[Session, bool]:
        """Create or resume an authenticated client's session; returns it and whether it existed.

        Raises:
            ProtocolError: 0x85, the client id belongs to a session of another user, or to one
                inside the appliance, which is left alone; 0x97, the user has reached its limit of
                connections or sessions, or there is no memory for the will.
        """
        self.counters.cost += CONNECT_COST
        account = self.accounting.accounts.of(identity)
        if will is not None and not self.accounting.fits(account, will.message.size):
            reason = f"no room for its will: {self.accounting.memory_shortage(will.message.size)}"
            raise ProtocolError(ReasonCode.QUOTA_EXCEEDED, reason)
        session = self.sessions.get(identity.client_id)
        if session is not None:
            owner = session.identity
            if session.is_inside:
                raise ProtocolError(
                    ReasonCode.CLIENT_IDENTIFIER_NOT_VALID,
                    f"client id {quote(identity.client_id)} is the appliance's own",
                )
            if owner is None or owner.username != identity.username:
                raise ProtocolError(
                    ReasonCode.CLIENT_IDENTIFIER_NOT_VALID,
                    f"client id {quote(identity.client_id)} belongs to {session}",
                )
        if not account.is_inside:
            self._make_room(account, session)
        if session is not None:
            if session.link is not None:  # [MQTT-3.1.4-3], v3.1.1 [MQTT-3.1.4-2]
                session.close_link(ReasonCode.SESSION_TAKEN_OVER, f"taken over by {identity}")
            if clean_start or not self._is_alive(session):  # [MQTT-3.1.2-4], 3.1.1 [MQTT-3.1.2-6]
                self._end(session)
        # A session that does not outlive its connection was ended by the take-over.
        session = self.sessions.get(identity.client_id)
        present = session is not None
        if session is None:
            session = Session(identity.client_id, identity, self.accounting)
            self.sessions[identity.client_id] = session
        session.link = link
        try:
            self.accounting.accounts.came(session)
            session.connected_at = self.now
            session.ends_at = None
            session.set_will(will)
            session.will_at = None  # [MQTT-3.1.3-9]: the will delay is over with the new connection
            session.expiry = expiry
            self.store.session_saved(session)
        except Exception:
            self.disconnect(session, link, publish_will=False)
            raise
        return session, present

    def _make_room(self, account: Account, session: Session | None) -> None:
        """Make room for a client of the account, and for its session if it has none.

        Free places go to any user, up to the user's configured limit. When there are none, sessions
        without a client are evicted first. A connection in use is evicted only for a user who has
        less than the share that each user is guaranteed, and from a user who has more than that.

        Raises:
            ProtocolError: 0x97, nothing may be evicted; nothing was changed.
        """
        needs_connection = session is None or session.link is None
        closing = self._connection_to_end(account) if needs_connection else None
        ending = self._session_to_end(account) if session is None else None
        if closing is not None:
            self._evict(closing, account, "connections")
            # Its session may have ended with it, so that no other one has to be evicted.
            ending = ending and self._session_to_end(account)
        if ending is not None:
            self._evict(ending, account, "sessions")
            found = self.sessions.get(ending.client_id)
            if found is not None and found is ending:
                self._end(found)

    def _connection_to_end(self, account: Account) -> AccountedSession | None:
        """The session whose connection is evicted for one of the account; None if there is room.

        Raises:
            ProtocolError: 0x97, none may be evicted.
        """
        accounts, own = self.accounting.accounts, self.limits.user.connections
        if own is not None and account.connections >= own:
            raise _has_all(account, account.connections, "connections")
        if accounts.connections < self.limits.connections:
            return None
        holder = accounts.largest(lambda each: each.connections)
        if self.accounting.quotas.connections.must_yield(holder.connections, account.connections):
            return next(reversed(holder.present))
        raise _all_taken(account, account.connections, "connections", self.limits.connections)

    def _session_to_end(self, account: Account) -> AccountedSession | None:
        """The session that is evicted for one of the account; None if there is room.

        It is the session whose client has been away for longest, of the user with the most
        sessions. If that user would be left with fewer than the account gets, it is one of the
        account's own sessions.

        Raises:
            ProtocolError: 0x97, none may be evicted.
        """
        accounts, own = self.accounting.accounts, self.limits.user.sessions
        has_all_of_its_own = own is not None and account.sessions >= own
        if not has_all_of_its_own and accounts.sessions < self.limits.sessions:
            return None
        holder = account
        if not has_all_of_its_own:
            most = accounts.largest(lambda each: each.sessions if each.absent else 0)
            if most.absent and most.sessions > account.sessions + 1:
                holder = most
        if holder.absent:
            return next(iter(holder.absent))
        if has_all_of_its_own:
            raise _has_all(account, account.sessions, "sessions")
        # With fewer sessions than connections allowed all may be in use.
        holder = accounts.largest(lambda each: each.connections)
        if self.accounting.quotas.sessions.must_yield(holder.sessions, account.sessions):
            return next(reversed(holder.present))
        raise _all_taken(account, account.sessions, "sessions", self.limits.sessions)

    def _evict(self, session: AccountedSession, account: Account, what: str) -> None:
        """End the connection of a session, if it has one, to make room for the account."""
        self.counters.evicted += 1
        holder = session.account
        key = ("taken back", what, holder.username)
        if holder is account:
            own = self.limits.user.sessions
            self.rate_limited_log.warning(
                log,
                self.now,
                key,
                "%s makes room for another session of its user: %s has %d sessions, there may be "
                "no more (broker.limits.%s), and this one's client has been away for longest",
                session,
                account,
                account.sessions,
                "sessions" if own is None or account.sessions < own else "user.sessions",
            )
        else:
            self.rate_limited_log.warning(
                log,
                self.now,
                key,
                "%s makes room for %s: broker.limits.%s is reached, and %s has most of it "
                "(broker.limits.user.%s bounds what a user may have)",
                session,
                account,
                what,
                holder,
                what,
            )
        session.close_link(
            ReasonCode.QUOTA_EXCEEDED,
            f"others need a place, and its user has most (broker.limits.{what})",
        )

    def claim(self, session: Session, identity: Identity) -> None:
        """Give a session its user, who was not known when a plugin created it."""
        session.identity = identity
        self.accounting.accounts.move(session, self.accounting.accounts.of(identity))
        self.store.session_saved(session)
        session.readable.clear()
        self.router.changed()

    def connected(self, session: Session) -> None:
        """CONNACK was sent: notify the observer, and send what is queued."""
        if self.observer is not None:
            self.observer.connected(session)
        session.unchecked = True
        session.resend()

    def attach(self, client_id: str, link: Link, identity: Identity | None = None) -> Session:
        """A session inside the appliance, which exists until `detach`.

        Without an identity it has all rights. With one, it has those of that user, and the messages
        that it retains are the user's. In neither case it counts against limits of the user, is
        evicted, or is stored; an `InsideLink` is told when the access rules change.

        Raises:
            ValueError: there is a session with this id inside already, or a client could take the
                id of the identity, which must be `client_id`.
        """
        if identity is not None and (
            not client_id.startswith(INSIDE) or identity.client_id != client_id
        ):
            raise ValueError(f"'{client_id}' cannot be the client id of {identity}")
        before = self.sessions.get(client_id)
        if before is not None:
            if before.is_inside:
                raise ValueError(f"there is a session '{client_id}' already")
            # An old version stored it, which allowed clients such an id; no client can resume it.
            log.warning("the session of %s is ended: its client id is the appliance's own", before)
            self._end(before)
        session = Session(client_id, identity, self.accounting, is_inside=True)
        session.link = link
        self.sessions[client_id] = session
        return session

    def detach(self, session: Session) -> None:
        """End a session made by `attach`."""
        session.link = None
        self._notify_departure(session)
        self._end(session)

    def disconnect(
        self, session: Session, link: Link, *, publish_will: bool, expiry: int | None = None
    ) -> None:
        """The connection behind `link` ended; does nothing if another one has taken over.

        An error in one step does not prevent the others: the client no longer counts as connected,
        and callbacks that depend on it, such as the stop of a robot, are called.
        """
        if session.link is not link:
            return
        self.counters.cost += ENDING_COST
        faults = self.faults
        session.link = None
        session.is_full_logged = False
        session.ended_well = not publish_will
        if expiry is not None:
            session.expiry = min(expiry, self.limits.session_expiry)
        faults.run("disconnect.transient", session.forget_transient, otherwise=None)
        faults.run("disconnect.hand_over", self._hand_over, session, otherwise=None)
        if self.observer is not None:
            faults.run("disconnect.observer", self.observer.disconnected, session, otherwise=None)
        self._notify_departure(session)
        if not publish_will:
            session.set_will(None)
        will = session.will
        if not session.persistent:
            self._end(session)
            return
        self.accounting.accounts.left(session)
        session.ends_at = self.now + session.expiry
        if will is not None and will.delay:
            session.will_at = self.now + will.delay
        self.schedule(session)
        if will is not None and not will.delay:
            self._publish_will(session)
        faults.run("disconnect.store", self.store.session_saved, session, otherwise=None)

    def delete(self, session: Session, why: str) -> None:
        """End a client's session, with its connection if it has one; its will is published."""
        session.close_link(ReasonCode.ADMINISTRATIVE_ACTION, why)
        if self.sessions.get(session.client_id) is session:  # it outlives its connection
            self._end(session)

    def _log_queue_full(self, session: Session, shortage: str) -> None:
        if session.ends_at is None:  # it is back, or has ended
            return
        away = timedelta(seconds=round(self.now - (session.ends_at - session.expiry)))
        policy = self.limits.queue_full
        what = "the oldest are dropped" if policy == "drop-oldest" else "more are dropped"
        log.warning(
            "%s has been away for %s, and its queue is full: %s; %d messages wait, %s "
            "(broker.limits.queue_full)",
            session,
            away,
            shortage,
            session.waiting,
            what,
        )

    def _notify_departure(self, session: Session) -> None:
        for departed in tuple(self.departures):
            self.faults.run("broker.departure", departed, session, otherwise=None)

    def _end(self, session: Session) -> None:
        """Delete a session; its will, if still due, is published [MQTT-3.1.2-10]."""
        if self.sessions.get(session.client_id) is session:
            del self.sessions[session.client_id]
        self.accounting.accounts.ended(session)
        self._publish_will(session)
        session.ends_at = None
        # Each step runs even if another one fails: nothing removes remains of a session later.
        faults = self.faults
        cost = ENDING_COST
        for topic_filter in session.subscriptions:
            self._leave(session, topic_filter)
            cost += LEAVING_COST + topic_filter.count("/") // LEVELS_PER_COST_UNIT
        self.counters.cost += cost
        faults.run("end.hand_over", self._hand_over_all, session, otherwise=None)
        for _ in range(2):  # as in `_leave`: nothing frees later what the session holds
            if faults.run("end.clear", _done, session.clear, otherwise=False):
                break
        faults.run("end.store", self.store.session_removed, session, otherwise=None)

    def _leave(self, session: Session, topic_filter: str) -> None:
        """Remove a subscription from the tree; retry once if that fails.

        Nothing removes it later, and a leftover would receive matching messages for ever.
        """
        for _ in range(2):
            leave = self.router.leave
            if self.faults.run("leave", _done, leave, session, topic_filter, otherwise=False):
                return

    def _hand_over(self, session: Session) -> None:
        """A client disconnected: pass its groups' messages on to members that are connected."""
        known = self.router.shares
        shares = {known[name] for name in session.subscriptions if name in known}
        if shares:
            session.hand_over(shares, self._giver(absent_too=False), sent=True)

    def _hand_over_all(self, session: Session) -> None:
        """A session ended: pass its groups' messages on to other members, absent ones included."""
        session.hand_over(None, self._giver(absent_too=True), sent=True)

    def _giver(self, *, absent_too: bool) -> Callable[[Delivery], bool]:
        """Return a function that delivers a message to another member; True if that succeeded."""
        heirs = Heirs(absent_too=absent_too)

        def give(delivery: Delivery) -> bool:
            message, _, _, _, share = delivery
            assert isinstance(share, Share)
            if self.accounting.has_expired(message):
                return True
            # Only candidates are checked against the rules: a group may have thousands of members.
            target = heirs.choose(share, message, self.router.may_receive)
            self.counters.cost += 1 + heirs.checked // CHECKS_PER_COST_UNIT
            return target is not None and self._deliver_shared(target, message, share)

        return give

    def _publish_will(self, session: Session) -> None:
        will = session.set_will(None)
        session.will_at = None
        if will is None:
            return
        try:
            self._publish_late(will, session)
        except ProtocolError as error:  # the limits are not what they were at its CONNECT
            self.counters.drop("forbidden")
            self.log_rate_limited(session, "its will cannot be published: %s", error)
        except Exception as error:
            self.counters.drop("fault")
            self.faults.caught("broker.will", error, session)

    def _publish_late(self, will: PendingWill, session: Session) -> None:
        """Publish a will; its expiry interval begins only now."""
        if will.expiry is not None:
            will.message.expires_at = self.now + will.expiry
        self.publish(will.message, session)

    def _is_alive(self, session: Session) -> bool:
        return session.ends_at is None or session.ends_at > self.now

    # --- limits and rules ----------------------------------------------------------------------

    @property
    def access(self) -> Access:
        """The access rules in force."""
        return self.router.access

    @access.setter
    def access(self, access: Access) -> None:
        self.router.access = access

    def may_receive(self, session: Session, topic: str) -> bool:
        """Whether the rules in force let the session receive the topic's messages."""
        return self.router.may_receive(session, topic)

    def route(self, session: Session, topic_wire: bytes) -> Fanout:
        """See `Router.route`."""
        return self.router.route(session, topic_wire)

    def use(self, limits: Limits, features: Features) -> None:
        """Apply other limits and features from now on.

        A client that holds more than they allow keeps it. What its CONNACK announced stays valid
        while it is connected.
        """
        self.limits = limits
        self.features = features
        self.accounting.use(limits)
        self.router.changed()  # topics may be too long now, or not any more

    def obstacle(self, topic: str) -> str:
        """Why a message to this topic would be lost now; empty when not. See `obstacles`."""
        for ask in self.obstacles:
            why = ask(topic)
            if why:
                return why
        return ""

    def guards_changed(self) -> None:
        """Guards were added or removed, or their decisions changed."""
        self.router.changed()

    def rules_changed(self) -> None:
        """The access rules changed: clear cached decisions, and check queued messages again."""
        self.router.changed()
        inside: list[InsideLink] = []
        for session in self.sessions.values():
            session.unchecked = True  # message by message, as they are sent
            if session.is_inside and isinstance(session.link, InsideLink):
                inside.append(session.link)
        for link in inside:
            self.faults.run("broker.rules", link.rules_changed, otherwise=None)

    # --- publishing ----------------------------------------------------------------------------

    def publish(self, message: Message, origin: Session) -> ReasonCode:
        """Deliver the message to every session that subscribed to its topic.

        Returns 0x00; 0x10 when there is no subscription; 0x87 when `origin` may not publish it,
        which is logged; 0x97 when no subscriber had room for it, or it could not be retained.

        Raises:
            ProtocolError: the topic is not valid.
        """
        route = self.router.route(origin, message.topic_wire)
        code = self.publish_to(route.targets, route, message, origin, refusable=False)
        message.rejection = None  # nobody is answered
        return code

    def publish_to(
        self,
        targets: list[Target],
        route: Fanout,
        message: Message,
        origin: Session,
        refusable: bool = True,
    ) -> ReasonCode:
        """Deliver the message to these targets of its route, which the caller has looked up.

        A message that is `refusable` came from a client that gets the reason code: while the
        store fails it is refused if it would have to be stored. Nobody would send another message
        again; it is queued in memory until the store works again.
        """
        if not route.allowed:
            self.refuse_publish(origin, route, message)
            return ReasonCode.NOT_AUTHORIZED
        if self.observer is not None:
            self.observer.published(origin, message)
        retain = message.retain
        # A call of the appliance is not retained: there may be a password in it.
        is_kept = retain and (origin.identity is None or route.topic[0] != "$")
        # If there is no room to retain it, connected subscribers still get it.
        is_accepted = not is_kept or self.retained.keep(message, self._owner(origin), refusable)
        published_qos = message.qos
        self.counters.cost += 1 + len(targets)
        taken = full = False
        store_fails = refusable and self.accounting.failing
        message.publisher = origin
        try:
            for session, qos, as_published, subscription_ids in targets:
                if qos > published_qos:
                    qos = published_qos
                try:
                    delivered = session.deliver(
                        message, qos, retain and as_published, subscription_ids, None, refusable
                    )
                except Exception as error:  # only this receiver misses the message
                    delivered = self._not_delivered(session, error)
                if delivered:
                    taken = True
                elif qos:
                    if store_fails and session.persistent:
                        is_accepted = (
                            False  # the publisher has to retry, whether or not others got it
                        )
                    else:
                        self._log_receiver_full(session, message)
                    full = True
            for share, members in route.shares:
                chosen = share.choose(members, message, None, refusable)
                self.counters.cost += 1 + share.checked // CHECKS_PER_COST_UNIT
                if chosen is not None and self._deliver_shared(chosen, message, share, refusable):
                    taken = True
                elif published_qos and (asked := next((m[0] for m in members if m[1]), None)):
                    if chosen is None:
                        self.counters.drop("queue_full")
                    if store_fails and any(m[1] and m[0].persistent for m in members):
                        is_accepted = False
                    else:
                        self._log_receiver_full(asked, message)
                    full = True
            if route.rated and self._offer(route, message):
                taken = True
        finally:
            message.publisher = None
        if not is_accepted or (full and not taken):
            return ReasonCode.QUOTA_EXCEEDED
        # A receiver without room misses the message, which is logged but not reported: the
        # publisher would send it again to all others, because of one tablet that is switched off.
        # 0x10 means that the topic has no subscription. The publisher does not learn that a
        # subscriber is absent or may not read the topic.
        return ReasonCode.SUCCESS if route.subscribed else ReasonCode.NO_MATCHING_SUBSCRIBERS

    def _offer(self, route: Fanout, message: Message) -> bool:
        """Offer the message to receivers that have asked for a rate; True if any will have it."""
        taken = False
        now = self.rates.clock()
        self.counters.cost += len(route.rated)
        for limit, as_published, subscription_ids in route.rated:
            retain = message.retain and as_published
            try:
                taken |= limit.offer(message, retain, subscription_ids, now)
            except Exception as error:
                self._not_delivered(limit.session, error)
        return taken

    def _owner(self, origin: Session) -> Account:
        """The account that what the session retains is counted for."""
        return self.accounting.accounts.of(origin.identity) if origin.is_inside else origin.account

    def _deliver_shared(
        self, target: Target, message: Message, share: Share, refusable: bool = True
    ) -> bool:
        """False when a QoS 1 or 2 message was dropped."""
        session, qos, as_published, subscription_ids = target
        qos = min(qos, message.qos)
        retain = message.retain and as_published
        try:
            delivered = session.deliver(message, qos, retain, subscription_ids, share, refusable)
            return delivered or not qos
        except Exception as error:
            return self._not_delivered(session, error)

    def _not_delivered(self, session: object, error: Exception) -> bool:
        self.counters.drop("fault")
        self.faults.caught("broker.delivery", error, session)
        return False

    def announce(self, message: Message, session: Session) -> None:
        """Notify the topic's guards of a QoS 2 message, which is held until its PUBREL."""
        for guard in self.guards.get(message.topic, ()):
            guard.announced(message, session)

    def inspect(self, message: Message, session: Session) -> PublishRejection | None:
        """Why a part of the appliance rejects a QoS 2 message, if so, before it is accepted."""
        for guard in self.guards.get(message.topic, ()):
            rejection = guard.inspect(message, session)
            if rejection is not None:
                return rejection
        return None

    def shortage(self, route: Fanout, message: Message, origin: Session) -> str:
        """Why a message found no room (0x97), as a text for its publisher."""
        if message.retain and message.payload:
            shortage = self.retained.shortage(message, self._owner(origin))
            if shortage:
                return f"no room to retain it: {shortage}"
        asked = (session for session, qos, _, _ in route.targets if qos)
        of_group = (member[0] for _, members in route.shares for member in members if member[1])
        reader = next(asked, None) or next(of_group, None)
        why = f": {reader.shortage(message.size)}" if reader is not None else ""
        return f"nobody who subscribed to its topic has room for it{why}"

    def without_room(self, route: Fanout, message: Message) -> tuple[frozenset[Receiver], bool]:
        """The receivers that have no room for a QoS 2 message now, and whether all have none.

        The message can be refused only for all receivers, in its PUBREC; so it is refused when none
        has room. When some have, it is delivered to these; the others miss it, which is counted and
        logged, so that one slow receiver does not keep it from the others.
        """
        self._count_checks(route)
        full: set[Receiver] = set()
        is_taken = False
        for session, qos, _, _ in route.targets:
            if qos and not session.has_room(message):
                full.add(session)
            else:  # with QoS 0 a connected client, or ROS, takes it
                is_taken |= bool(qos) or session.link is not None
        for share, members in route.shares:
            asked = [session for session, qos, _, _ in members if qos]
            if asked and not any(session.has_room(message) for session in asked):
                full.add(share)
            is_taken |= bool(asked) and share not in full
            is_taken |= any(not qos and session.link is not None for session, qos, _, _ in members)
        is_taken |= any(limit.session.link is not None for limit, _, _ in route.rated)
        return frozenset(full), bool(full) and not is_taken

    def congestions(self, route: Fanout, message: Message) -> list[Congestion]:
        """The congestions of receivers without room for a QoS 1 or 2 message that soon will have.

        The members of a group are among them only if no member has room.
        """
        size = message.size
        if len(route.targets) == 1 and not route.shares:  # the common case in a flood
            session, qos, _, _ = route.targets[0]
            congestion = session.congestion
            if congestion is None or not qos or session.link is None or not session.is_full(size):
                return []
            return [congestion] if congestion.patience() else []
        self._count_checks(route)
        full = [
            session
            for session, qos, _, _ in route.targets
            if qos and session.link is not None and session.is_full(size)
        ]
        for _, members in route.shares:
            asked = [session for session, qos, _, _ in members if qos and session.link is not None]
            if all(session.is_full(size) for session in asked):
                full += asked
        congestions = [session.congestion for session in full]
        return [each for each in congestions if each is not None and each.patience()]

    def must_wait_for_disk(self, route: Fanout, message: Message, origin: Session) -> bool:
        """Whether a QoS 1 or 2 message has to wait until more of what is stored is written.

        A publisher that waits is given to `disk`.
        """
        if self.disk not in self.accounting.congested:
            return False
        self._count_checks(route)
        for session, _, _, _ in route.targets:
            link = session.link
            if isinstance(link, InsideLink) and link.must_wait(message, origin.client_id):
                self.rate_limited_log.warning(
                    log,
                    self.now,
                    "disk",
                    "%s waits: more comes for %s than the disk takes",
                    origin,
                    session,
                )
                return True
        return False

    def _count_checks(self, route: Fanout) -> None:
        """Add the cost of checking each receiver of a route."""
        checks = len(route.targets) + len(route.rated)
        for _, members in route.shares:
            checks += len(members)
        self.counters.cost += checks // CHECKS_PER_COST_UNIT

    def must_store(self, route: Fanout, message: Message, origin: Session) -> bool:
        """Whether the message, of QoS 1 or 2, would be stored."""
        self._count_checks(route)
        return (
            message.retain
            or (message.qos == 2 and origin.persistent)
            or any(qos and session.persistent for session, qos, _, _ in route.targets)
            or any(qos and session.persistent for _, m in route.shares for session, qos, _, _ in m)
        )

    def release(self, held: UnreleasedPublish, origin: Session, age: float) -> None:
        """Publish a QoS 2 message at its PUBREL, to all receivers that had room at its PUBREC.

        `age` is in seconds since its arrival.
        """
        self.counters.cost += HELD_COST
        message, full, _ = held
        if age > DELAYED_AFTER:
            message = DelayedMessage(message, age + message.age)
        if self.accounting.has_expired(message):
            return
        try:
            route = self.router.route(origin, message.topic_wire)
        except ProtocolError as error:  # the limits are not what they were at its PUBREC
            self.counters.drop("forbidden")
            self.log_rate_limited(origin, "its message cannot be published: %s", error)
            return
        self._count_checks(route)
        targets: list[Target] = []
        for target in route.targets:
            session, qos, as_published, ids = target
            qos = min(qos, message.qos)
            if qos and route.allowed and session not in full and not session.has_room(message):
                retain = message.retain and as_published
                session.deliver_promised(Delivery(message, qos, retain, ids, None))
            else:
                targets.append(target)
        shares: list[tuple[Share, list[Target]]] = []
        for share, members in route.shares:
            asked = [member for member in members if member[1]] if route.allowed else []
            if asked and share not in full and not any(m[0].has_room(message) for m in asked):
                session, qos, as_published, ids = next((m for m in asked if m[0].link), asked[0])
                retain = message.retain and as_published
                qos = min(qos, message.qos)
                session.deliver_promised(Delivery(message, qos, retain, ids, share))
            else:
                shares.append((share, members))
        if route.shares:  # a copy of the route costs as much as all the rest
            route = replace(route, shares=shares)
        self.publish_to(targets, route, message, origin)

    def refuse_publish(self, session: Session, route: Fanout, message: Message) -> None:
        """Count and log that the session may not publish the message to the route's topic."""
        self.counters.publish_refused += 1
        self.counters.cost += REFUSAL_COST
        for guard in self.guards.get(route.topic, ()):
            guard.refused(session)
        if self.observer is not None:
            self.observer.refused(session, message)
        self._audit_denied(session, Action.PUBLISH, route.topic, route.reason)
        self.log_rate_limited(
            session, "may not publish to %s: %s", quote(route.topic), route.reason
        )

    def _audit_denied(self, session: Session, action: Action, topic: str, reason: str) -> None:
        if self.audit_log is not None and session.identity is not None:
            self.audit_log.denied(session, action, topic, reason)

    def log_rate_limited(self, session: Session, message: str, *args: object) -> None:
        """Log a client's mistake; repetitions are rate limited."""
        key = session.client_id, message
        self.rate_limited_log.warning(log, self.now, key, f"%s {message}", session, *args)

    def _log_receiver_full(self, session: Session, message: Message) -> None:
        if session.link is None:
            return  # an absent client's full queue is logged once, at the next tick
        self.log_rate_limited(
            session,
            "takes its messages too slowly, its queue is full: %s (it has %d messages, %d bytes)",
            session.shortage(message.size),
            session.waiting,
            session.bytes,
        )

    def _retained_changed(self, message: Message, owner: Account) -> None:
        self.store.retained(message, owner)
        if self.observer is not None:
            self.observer.retained(message)

    # --- subscribing ---------------------------------------------------------------------------

    def subscribe(self, session: Session, subscription: Subscription) -> tuple[ReasonCode, str]:
        """Subscribe; returns the code for SUBACK, the granted QoS or a failure, and its reason."""
        refusal = self._check_subscription(session, subscription)
        if refusal is not None:
            code, reason = refusal
            name = quote(subscription.filter)
            self._audit_denied(session, Action.SUBSCRIBE, subscription.filter, reason)
            self.log_rate_limited(session, "may not subscribe to %s: %s", name, reason)
            return code, reason
        topic_filter = subscription.filter
        if session.subscriptions.get(topic_filter) != subscription:
            try:
                session.subscribe(subscription)
                self.router.join(session, subscription)
            except Exception:
                # Undo both: a partial subscription would look complete at the next SUBSCRIBE.
                session.unsubscribe(topic_filter)
                self._leave(session, topic_filter)
                raise
        if session.persistent:
            self.store.subscribed(session, subscription)
        if self.observer is not None:
            self.observer.subscribed(session, subscription.filter, subscription.qos)
        return ReasonCode(subscription.qos), ""

    def _check_subscription(
        self, session: Session, subscription: Subscription
    ) -> tuple[ReasonCode, str] | None:
        topic_filter = subscription.filter
        try:
            check_filter(topic_filter)
            parse_shared(topic_filter)
        except ValueError as error:
            return ReasonCode.TOPIC_FILTER_INVALID, str(error)
        if session.identity is None:
            return None
        if topic_filter not in session.subscriptions and not session.is_inside:
            maximum = self.limits.subscriptions
            if len(session.subscriptions) >= maximum:
                reason = f"it has {maximum} subscriptions (broker.limits.subscriptions)"
                return ReasonCode.QUOTA_EXCEEDED, reason
            size = subscription_size(topic_filter)
            if not session.fits(size):
                return ReasonCode.QUOTA_EXCEEDED, f"no room for it: {session.shortage(size)}"
        decision = self.router.decide(session.identity, Action.SUBSCRIBE, topic_filter)
        if not decision:
            return ReasonCode.NOT_AUTHORIZED, decision.reason
        return None

    def send_retained(self, session: Session, subscription: Subscription, is_new: bool) -> None:
        """Send the retained messages that a subscription asks for."""
        self.replay_retained(session, subscription, is_new)
        session.pump()

    def replay_retained(self, session: Session, subscription: Subscription, is_new: bool) -> None:
        """Let the next `Session.pump` send the retained messages that a subscription asks for."""
        if parse_shared(subscription.filter) is not None:
            return  # there are none for shared subscriptions (5.0 section 4.8.2)
        handling = subscription.retain_handling
        if handling == 2 or (handling == 1 and not is_new):  # [MQTT-3.3.1-9..11]
            return
        self.begin_replay(session, subscription)

    def begin_replay(self, session: Session, subscription: Subscription) -> None:
        """Let the next `Session.pump` send the retained messages that match the subscription."""
        session.replay(subscription.filter, self._find_retained(session, subscription.filter))
        if session.persistent and subscription.qos:
            self.store.subscribed(session, subscription)

    def _find_retained(self, session: Session, topic_filter: str) -> Iterator[Delivery | None]:
        """The retained messages for a subscription, each checked when the client can take it.

        None stands for a message that is skipped, so that skipping many takes several turns, too.
        """
        for found in self.retained.find_in_steps(topic_filter):
            if found is None:
                yield None
                continue
            topic, message = found
            if message.expires_at is not None and message.expires_at <= self.now:
                self.retained.delete(topic)
                yield None
            elif not self.router.may_receive(session, topic):
                yield None
            else:
                subscription = session.subscriptions[topic_filter]
                ids = [subscription.identifier] if subscription.identifier else None
                limit = session.rate_limits.get(topic_filter)
                if limit is not None and not limit.offer_retained(message, ids, self.rates.clock()):
                    yield None
                    continue
                yield Delivery(message, min(message.qos, subscription.qos), True, ids, None)

    def unsubscribe(self, session: Session, topic_filter: str) -> ReasonCode:
        """Unsubscribe; returns 0x00, or 0x11 when there was no such subscription."""
        if not session.unsubscribe(topic_filter):
            return ReasonCode.NO_SUBSCRIPTION_EXISTED
        share = self.router.shares.get(topic_filter)
        self._leave(session, topic_filter)
        if share is not None:
            session.hand_over((share,), self._giver(absent_too=True), sent=False)
        if session.persistent:
            self.store.unsubscribed(session, topic_filter)
        if self.observer is not None:
            self.observer.unsubscribed(session, topic_filter)
        return ReasonCode.SUCCESS

    # --- time ----------------------------------------------------------------------------------

    def schedule(self, session: Session) -> None:
        """Schedule an absent client's will, and the end of its session, for `tick`."""
        for when in (session.ends_at, session.will_at):
            if when is not None:
                heapq.heappush(self._deadlines, (when, next(self._order), session))
        # Remove outdated entries, of clients that have reconnected, before they are due.
        if len(self._deadlines) > 4 * len(self.sessions) + 64:
            hold = {
                (when, session.client_id): (when, order, session)
                for when, order, session in self._deadlines
                if when in (session.ends_at, session.will_at)
            }
            self._deadlines = list(hold.values())
            heapq.heapify(self._deadlines)

    def tick(self, now: float) -> float:
        """Let time pass: keep alive, wills, sessions. `now` is in seconds and never goes back.

        Returns when the next will or session is due, infinity for never, and `now` when more is due
        than the cost limit of one tick allows: neither thousands of clients that time out together
        nor a hundred wills with many receivers stop the other clients. Between two ticks
        `accounting.now` may be advanced, so that timeouts which begin then are not too short.
        """
        faults = self.faults
        self.accounting.now = faults.now = now
        faults.run("clock.rate_limited_log", self.rate_limited_log.tick, now, otherwise=None)
        end = self.counters.cost + COST_PER_TICK
        expires_more = faults.run("clock.retained", self.retained.expire, now, otherwise=False)
        filled, self.accounting.filled = self.accounting.filled, []
        for session, shortage in filled:
            faults.run("clock.full", self._log_queue_full, session, shortage, otherwise=None)
        left = ENDINGS_PER_TICK
        for client in tuple(self.clients):
            try:
                left -= client.tick(now)
            except Exception as error:
                self.fault("clock.keep_alive", error, client)
                left -= 1
            if left <= 0 or self.counters.cost > end:
                self.flush()
                self.ticked_at = now
                return now
        while self._deadlines and self._deadlines[0][0] <= now:
            if left <= 0 or self.counters.cost > end:
                break
            left -= 1
            _, _, session = heapq.heappop(self._deadlines)
            # Entries are not removed early; an outdated one is skipped here.
            if session.link is not None or self.sessions.get(session.client_id) is not session:
                continue
            try:
                self._fall_due(session, now)
            except Exception as error:
                faults.caught("clock.session", error, session)
        self.flush()
        self.ticked_at = now
        if expires_more:
            return now
        return self._deadlines[0][0] if self._deadlines else math.inf

    def send_due(self) -> float:
        """Send what has waited for its turn because of a subscription's max-rate.

        Returns when to call this again, infinity for never; `RateSchedule.wake` says when earlier.
        When more is due than the cost limit of a tick allows, that is at once.
        """
        rates = self.rates
        now = rates.clock()
        self.accounting.now = max(now, self.now)
        end = self.counters.cost + COST_PER_TICK
        rates.sending(True)
        try:
            while self.counters.cost <= end:
                limit = rates.next_due(now)
                if limit is None:
                    break
                self.faults.run("clock.rate", limit.send_due, now, end, otherwise=None)
                limit.go_on(now)
        finally:
            rates.sending(False)
            self.flush()
        return rates.next_at

    def _fall_due(self, session: Session, now: float) -> None:
        """Publish an absent client's will, and end its session, if these are due."""
        if session.will_at is not None and session.will_at <= now:
            self._publish_will(session)
            self.store.session_saved(session)
        if session.ends_at is not None and session.ends_at <= now:
            log.info("%s: the session expired", session)
            self.counters.sessions_expired += 1
            self._end(session)

    # --- faults --------------------------------------------------------------------------------

    def fault(self, entry: str, error: Exception, client: Ticking) -> None:
        """Count an exception that was caught at an entry, and end the connection it occurred in."""
        self.faults.caught(entry, error, client)
        try:
            client.fault()
        except Exception as second:
            self.faults.caught("broker.end", second, client)
            client.cut_off()

    def _abandon(self, entry: str, error: Exception, output: Flushing) -> None:
        """Count an exception in an output, and close its connection without further output."""
        self.faults.caught(entry, error, output)
        self.faults.run("broker.abandon", output.abandon, otherwise=None)

    # --- output, and the commits that it waits for ---------------------------------------------

    def flush(self) -> None:
        """Write the packets that network clients were sent since the last flush.

        Packets that depend on uncommitted changes wait: an acknowledged message is stored.
        """
        overflowed = self.accounting.overflowed
        while overflowed:
            self.faults.run("flush.overflow", self._close_full, overflowed.pop(), otherwise=None)
        if not self.unflushed:
            # Only a part of the appliance has caused changes, such as a retained message of the
            # bridge that was queued: no later packet to a client depends on it.
            self.store.fresh = False
            return
        while self.unflushed:  # writing makes room for queued messages
            outputs = self.unflushed
            self.unflushed = []
            if self.store.staged:
                outputs = self._hold_back(outputs)
            for output in outputs:
                try:
                    output.flush()
                except Exception as error:
                    self._abandon("flush", error, output)
        self.header_cache.clear()

    def _close_full(self, session: Session) -> None:
        session.close_link(
            ReasonCode.QUOTA_EXCEEDED, "its queue is full (broker.limits.queue_full)"
        )

    def _hold_back(self, outputs: list[Flushing]) -> list[Flushing]:
        """Hold outputs back that depend on uncommitted changes; returns the others."""
        self.store.fresh = False
        committed = self.store.committed
        free: list[Flushing] = []
        for output in outputs:
            try:
                if output.wait(committed):
                    self._waiting[output] = None
                else:
                    free.append(output)
            except Exception as error:
                self._abandon("flush.wait", error, output)
        if self._waiting:
            self.faults.run("commit.hurry", self.store.hurry, otherwise=None)
        return free

    def _committed(self, succeeded: bool) -> None:
        waiting, self._waiting = self._waiting, {}
        faults = self.faults
        if succeeded:
            committed = self.store.committed
            for output in waiting:
                try:
                    if output.release(committed):
                        self._waiting[output] = None
                except Exception as error:
                    self._abandon("commit.release", error, output)
            if self.accounting.failing:
                self._recover()
        else:
            if not self.accounting.failing:
                self.accounting.failing = True
                for session in self.sessions.values():
                    session.hold_back()
            for output in waiting:
                faults.run("commit.abandon", output.abandon, otherwise=None)
        faults.run("commit.wake", self.disk.wake, otherwise=None)
        if self._waiting:
            self.faults.run("commit.hurry", self.store.hurry, otherwise=None)
        self.flush()

    def _recover(self) -> None:
        """The store works again: continue what waited for it."""
        self.accounting.failing = False
        for client in tuple(self.clients):
            try:
                client.resume()
            except Exception as error:
                self.fault("commit.resume", error, client)
        for session in tuple(self.sessions.values()):
            self.faults.run("commit.go_on", session.go_on, otherwise=None)

    def close(self, close: Callable[[Session], None]) -> None:
        """Stop: close each connection by `close`; publish no wills, and keep stored sessions."""
        for session in list(self.sessions.values()):
            if session.link is not None:
                session.set_will(None)
                if not session.is_inside:
                    self.faults.run("stop.session", close, session, otherwise=None)
        self.flush()


def _done(work: Callable[..., object], *args: object) -> bool:
    """Call `work`; returns True if it does not raise."""
    work(*args)
    return True
