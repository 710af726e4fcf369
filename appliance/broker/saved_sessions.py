"""Stored sessions, and how the broker restores them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import cast

from appliance.broker.accounts import Account
from appliance.broker.broker import Broker
from appliance.broker.delivery import Delivery, PendingWill, UnreleasedPublish
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.broker.store import Unread
from appliance.broker.values import Identity
from appliance.mqtt.packets import Subscription


@dataclass(slots=True)
class PendingDelivery:
    """A stored QoS 1 or 2 message for a session; `share` is the filter of its group, if any."""

    message: Message
    qos: int
    retain: bool
    subscription_ids: list[int] | None
    share: str | None


@dataclass(slots=True)
class SavedSession:
    """A stored session and its state; times are in seconds of the broker's clock.

    `ends_at` is None if the client was connected.
    """

    identity: Identity
    expiry: int
    ends_at: float | None
    will: PendingWill | None
    will_at: float | None
    subscriptions: list[Subscription] = field(default_factory=list)
    #: Those whose replay of retained messages was not finished.
    replaying: list[Subscription] = field(default_factory=list)
    #: By packet id, in the order sent; None where only PUBREL is left to be sent.
    inflight: dict[int, PendingDelivery | None] = field(default_factory=dict)
    queue: list[PendingDelivery] = field(default_factory=list)
    #: The queue, if it is read later.
    unread: Unread | None = None
    #: QoS 2 messages that wait for PUBREL, with the sessions and groups without room for them.
    received: dict[int, tuple[Message, list[str], list[str]]] = field(default_factory=dict)
    #: The restored session.
    session: Session | None = None


def restore(
    broker: Broker, saved: list[SavedSession], retained: list[tuple[Message, Account]]
) -> None:
    """Restore the sessions and retained messages of the last run, before any client connects.

    A client that was connected at the end of that run counts as disconnected now: its session
    expiry and its will delay begin now. A session that does not outlive its connection is restored
    for its will only, which the next tick publishes (3.1.1 section 3.1.2.5, 5.0 section 3.1.2.5).
    """
    for entry in saved:
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
    for entry in sorted(saved, key=_left_at):
        assert entry.session is not None
        broker.accounting.accounts.left(entry.session)
    for entry in saved:  # deliveries refer to sessions and groups, all of which exist now
        _restore_deliveries(broker, entry)
    broker.retained.restore(retained)
    for entry in saved:
        assert entry.session is not None
        for subscription in entry.replaying:  # from the beginning: what was sent is unknown
            broker.begin_replay(entry.session, subscription)


def _left_at(entry: SavedSession) -> float:
    # Clients that were connected at the end have left last.
    return math.inf if entry.ends_at is None else entry.ends_at - entry.expiry


def _restore_deliveries(broker: Broker, entry: SavedSession) -> None:
    def delivery(pending: PendingDelivery) -> Delivery:
        share = broker.router.shares.get(pending.share) if pending.share is not None else None
        ids = pending.subscription_ids
        return cast(Delivery, (pending.message, pending.qos, pending.retain, ids, share))

    assert entry.session is not None
    entry.session.restore(
        {
            packet_id: delivery(pending) if pending is not None else None
            for packet_id, pending in entry.inflight.items()
        },
        [delivery(pending) for pending in entry.queue],
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
        entry.unread,
    )
