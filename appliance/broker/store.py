"""What the broker needs of a store, and what a store uses of a session."""

from __future__ import annotations

from collections.abc import Callable, Collection, Container, Mapping
from typing import Protocol

from appliance.broker.accounts import Account
from appliance.broker.delivery import Delivery, PendingWill, UnreleasedPublish
from appliance.broker.message import Message
from appliance.broker.values import Identity
from appliance.mqtt.packets import Subscription


class SessionState(Protocol):
    """What a store uses of a session."""

    @property
    def client_id(self) -> str:
        """The client id, unique among sessions."""

    @property
    def identity(self) -> Identity | None:
        """Its client's identity; None for a session of the appliance that has all rights."""

    @property
    def account(self) -> Account:
        """The account that what is stored for it is counted for."""

    @property
    def link(self) -> object | None:
        """Its connection; None while its client is absent."""

    @property
    def expiry(self) -> int:
        """Seconds for which it outlives its connection."""

    @property
    def ends_at(self) -> float | None:
        """When it ends, in seconds of the broker's clock, if its client stays absent."""

    @property
    def will(self) -> PendingWill | None:
        """Its will."""

    @property
    def will_at(self) -> float | None:
        """When its will is published, in seconds of the broker's clock."""

    @property
    def subscriptions(self) -> Mapping[str, Subscription]:
        """By filter."""

    @property
    def replays(self) -> Container[str]:
        """The filters whose retained messages are still being sent."""

    @property
    def inflight(self) -> Mapping[int, Delivery | None]:
        """By packet id, in the order sent; None after PUBREC."""

    @property
    def queue(self) -> Collection[Delivery]:
        """Messages that were not sent yet, without those that `Unread` has."""

    @property
    def received(self) -> Mapping[int, UnreleasedPublish]:
        """QoS 2 messages from its client that wait for PUBREL, by packet id."""

    def read_all(self) -> None:
        """Have the rest of its queue read."""

    def drop_queued(self, is_old: Callable[[Message], bool]) -> int:
        """Drop queued messages that are too old; returns their number."""


class Unread(Protocol):
    """Messages of a session's queue that the store has not read since the start."""

    @property
    def count(self) -> int:
        """How many are left."""

    @property
    def bytes(self) -> int:
        """About as many bytes as the session counts for those that are left."""

    @property
    def is_shared(self) -> bool:
        """Whether any was for the session as a member of a group."""

    def read(self, count: int) -> list[Delivery]:
        """Read the oldest ones, up to so many.

        There are fewer where a row is damaged. `count` is less afterwards in any case: what cannot
        be read now is left to the next start.
        """

    def hurry(self) -> None:
        """Its client waits: have the session read on before others."""


class Store(Protocol):
    """Persistence of sessions and retained messages across restarts.

    Each method stages a change. Changes are committed in batches, which are numbered from 1. A
    packet that acknowledges a change is sent only when the change's batch is committed.
    """

    #: True while a change that a packet may depend on is not committed, or while a packet waits
    #: for a batch, whatever that contains.
    staged: bool

    #: True when such a change was staged since this was last set to False.
    fresh: bool

    #: The batch that changes are staged in now, and the last one that is committed.
    batch: int
    committed: int

    #: Bytes of the stored messages, and their limit.
    bytes: int
    size: int

    def listen(self, callback: Callable[[bool], None]) -> None:
        """Call back after each batch: with True when it is committed, with False when that failed.

        A failed batch is retried, together with what is staged meanwhile, until it succeeds. Until
        then `staged` is False although nothing is stored.
        """

    def hurry(self) -> None:
        """Commit soon: packets wait for it."""

    def session_saved(self, session: SessionState) -> None:
        """The session was created, or its owner, its expiry or its will changed."""

    def session_removed(self, session: SessionState) -> None:
        """The session ended, with everything that belongs to it."""

    def subscribed(self, session: SessionState, subscription: Subscription) -> None:
        """A subscription was added or replaced, or its replay of retained messages changed."""

    def unsubscribed(self, session: SessionState, topic_filter: str) -> None:
        """A subscription was removed."""

    def retained(self, message: Message, owner: Account) -> None:
        """The message was retained; one with an empty payload deleted its topic's message.

        `owner` is the account of the publisher.
        """

    def queued(self, session: SessionState, delivery: Delivery) -> None:
        """A QoS 1 or 2 message was queued for the session."""

    def sent(self, session: SessionState, delivery: Delivery, packet_id: int) -> None:
        """A message was sent under that packet id, whether it was queued before or not."""

    def settled(self, session: SessionState, delivery: Delivery) -> None:
        """A queued or sent message was acknowledged, expired or dropped."""

    def recorded(self, session: SessionState, delivery: Delivery, packet_id: int) -> None:
        """PUBREC arrived for a QoS 2 message: only its PUBREL is left to be sent."""

    def completed(self, session: SessionState, packet_id: int) -> None:
        """PUBCOMP arrived."""

    def held(self, session: SessionState, packet_id: int, held: UnreleasedPublish) -> None:
        """A QoS 2 message from the session's client waits for its PUBREL."""

    def unheld(self, session: SessionState, packet_id: int) -> None:
        """It does not wait any more."""
