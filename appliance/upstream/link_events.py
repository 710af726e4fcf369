"""What a connection to a fleet's broker tells its owner."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, TypeAlias, TypeVar

from appliance.mqtt.codec import Properties
from appliance.mqtt.packets import Subscription
from appliance.upstream.agreement import Granted

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Opened:
    """The broker has accepted the connection."""

    granted: Granted


@dataclass(frozen=True, slots=True)
class Challenged:
    """The broker needs more to authenticate the client (AUTH with 0x18): `answer` it."""

    data: bytes | None = field(repr=False)
    reason: str


@dataclass(frozen=True, slots=True)
class Reauthenticated:
    """The broker has authenticated the client again."""

    data: bytes | None = field(repr=False)


@dataclass(slots=True)
class Acknowledged(Generic[T]):
    """Messages were acknowledged with this reason code, 0x80 or above if they were refused."""

    tokens: list[T]
    code: int
    reason: str = ""


@dataclass(slots=True)
class Arrived:
    """A message from the broker; with QoS 1 and 2 `packet_id` has to be acknowledged.

    `properties` are those but the User Properties; `properties_wire` has all that may be passed on,
    encoded, see `CheckedProperties`. `not_before` is a time of this computer before which it did
    not leave the broker, nor, with QoS 1, was published there; minus infinity if there is none.
    With a `flaw` it cannot be used, and is to be refused.
    """

    topic: str
    payload: bytes = field(repr=False)
    qos: int
    retain: bool
    dup: bool
    packet_id: int
    properties: Properties | None
    properties_wire: bytes
    not_before: float
    flaw: str = ""


@dataclass(slots=True)
class Subscribed:
    """The broker's answers to subscriptions; `complete` if it owes no more of these answers."""

    results: list[tuple[Subscription, int]]
    complete: bool
    reason: str = ""


@dataclass(slots=True)
class Unsubscribed:
    """The broker's answers to the end of subscriptions; of 3.1.1 they are 0."""

    results: list[tuple[str, int]]
    reason: str = ""


FleetEvent: TypeAlias = (
    "Opened | Challenged | Reauthenticated | Acknowledged[T] | Arrived | Subscribed | Unsubscribed"
)
