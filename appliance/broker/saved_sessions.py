"""Sessions as the store has kept them, and how the broker takes them up again."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from appliance.broker.accounts import Account
from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.ports import Identity
from appliance.broker.session import Delivery, PendingWill, Session, UnreleasedPublish
from appliance.mqtt.packets import Subscription


@dataclass(slots=True)
class PendingDelivery:
    """A QoS 1 or 2 message that a session is to be sent; `share` is the filter of its group."""

    message: Message
    qos: int
    retain: bool
    subscription_ids: list[int] | None
    share: str | None


@dataclass(slots=True)
class SavedSession:
    """A session and all that belongs to it; times are in seconds of the broker's clock.

    `ends_at` is None for one whose client was connected.
    """

    identity: Identity
    expiry: int
    ends_at: float | None
    will: PendingWill | None
    will_at: float | None
    subscriptions: list[Subscription] = field(default_factory=list)
    #: Those of them whose retained messages were not all sent.
    replaying: list[Subscription] = field(default_factory=list)
    #: By packet id, in the order sent; None where only PUBREL is left.
    inflight: dict[int, PendingDelivery | None] = field(default_factory=dict)
    queue: list[PendingDelivery] = field(default_factory=list)
    #: QoS 2 messages that wait for PUBREL, with the sessions and groups that had no room for them.
    received: dict[int, tuple[Message, list[str], list[str]]] = field(default_factory=dict)
    #: What the broker made of it.
    session: Session | None = None


def restore(
    broker: Broker, kept: list[SavedSession], retained: list[tuple[Message, Account]]
) -> None:
    """Take up the sessions and retained messages of the last run, before anybody connects.

    A client that was connected when that ended counts as gone since now: so do the time that
    its session is kept, and the delay of its will. A session that was not to outlive its
    connection is there for its will alone, which the next tick publishes (3.1.1 section
    3.1.2.5, 5.0 section 3.1.2.5).
    """
    for entry in kept:
        session = Session(entry.identity.client_id, entry.identity, broker.accounting)
        entry.session = broker.sessions[session.client_id] = session
        session.expiry = entry.expiry
        session.set_will(entry.will)
        session.ends_at = entry.ends_at
        session.will_at = entry.will_at
        if session.ends_at is None:
            session.ends_at = broker.now + session.expiry
            if entry.will is not None:
                session.will_at = broker.now + min(entry.will.delay, session.expiry)
        broker.schedule(session)
        for subscription in entry.subscriptions:
            session.subscribe(subscription)
            broker.router.join(session, subscription)
    for entry in sorted(kept, key=_left_at):
        assert entry.session is not None
        broker.accounting.accounts.left(entry.session)
    for entry in kept:  # what is owed names sessions and groups, all of which are there now
        _restore_owed(broker, entry)
    broker.retained.restore(retained)
    for entry in kept:
        assert entry.session is not None
        for subscription in entry.replaying:  # from the beginning: what was sent is not known
            broker.begin_replay(entry.session, subscription)


def _left_at(entry: SavedSession) -> float:
    # Who was still there then has left last.
    return math.inf if entry.ends_at is None else entry.ends_at - entry.expiry


def _restore_owed(broker: Broker, entry: SavedSession) -> None:
    def delivery(owed: PendingDelivery) -> Delivery:
        share = broker.router.shares.get(owed.share) if owed.share is not None else None
        return Delivery(owed.message, owed.qos, owed.retain, owed.subscription_ids, share)

    assert entry.session is not None
    entry.session.restore(
        {
            packet_id: delivery(owed) if owed is not None else None
            for packet_id, owed in entry.inflight.items()
        },
        [delivery(owed) for owed in entry.queue],
        {
            packet_id: UnreleasedPublish(
                message,
                frozenset(
                    receiver
                    for receiver in (
                        *(broker.sessions.get(name) for name in sessions),
                        *(broker.router.shares.get(name) for name in shares),
                    )
                    if receiver is not None
                ),
            )
            for packet_id, (message, sessions, shares) in entry.received.items()
        },
    )
