"""Sessions as the store has kept them, for `Broker.restore`."""

from __future__ import annotations

from dataclasses import dataclass, field

from appliance.broker.message import Message
from appliance.broker.ports import Identity
from appliance.broker.session import PendingWill, Session
from appliance.mqtt.packets import Subscription


@dataclass(slots=True)
class Owed:
    """A QoS 1 or 2 message that a session is to be sent; `share` is the filter of its group."""

    message: Message
    qos: int
    retain: bool
    subscription_ids: list[int] | None
    share: str | None


@dataclass(slots=True)
class Kept:
    """A session and all that belongs to it; times are in seconds of the broker's clock.

    `ends_at` is None for one whose client was connected.
    """

    identity: Identity
    expiry: int
    ends_at: float | None
    will: PendingWill | None
    will_at: float | None
    subscriptions: list[Subscription] = field(default_factory=list)
    #: By packet id, in the order sent; None where only PUBREL is left.
    inflight: dict[int, Owed | None] = field(default_factory=dict)
    queue: list[Owed] = field(default_factory=list)
    #: QoS 2 messages that wait for PUBREL, with the sessions and groups that had no room for them.
    received: dict[int, tuple[Message, list[str], list[str]]] = field(default_factory=dict)
    #: What the broker made of it.
    session: Session | None = None
