"""The store that keeps nothing."""

from __future__ import annotations

from collections.abc import Callable

from appliance.broker.accounts import Account
from appliance.broker.message import Message
from appliance.broker.session import Delivery, Session, UnreleasedPublish
from appliance.mqtt.packets import Subscription


class MemoryStore:
    """The `Store` that keeps nothing beyond the broker's own memory, so that nothing is staged."""

    def __init__(self) -> None:
        self.staged = False
        self.fresh = False
        self.batch = 1
        self.committed = 0
        self.bytes = 0
        #: The broker's own limits are all there are.
        self.size = 1 << 62

    def listen(self, callback: Callable[[bool], None]) -> None:
        """There is nothing to tell."""

    def hurry(self) -> None:
        """Nothing is staged."""

    def session_saved(self, session: Session) -> None:
        """The broker has it."""

    def session_removed(self, session: Session) -> None:
        """The broker has forgotten it."""

    def subscribed(self, session: Session, subscription: Subscription) -> None:
        """The session has it."""

    def unsubscribed(self, session: Session, topic_filter: str) -> None:
        """The session has forgotten it."""

    def retained(self, message: Message, owner: Account) -> None:
        """The broker has it."""

    def queued(self, session: Session, delivery: Delivery) -> None:
        """The session has it."""

    def sent(self, session: Session, delivery: Delivery, packet_id: int) -> None:
        """The session knows."""

    def settled(self, session: Session, delivery: Delivery) -> None:
        """The session has forgotten it."""

    def recorded(self, session: Session, delivery: Delivery, packet_id: int) -> None:
        """The session knows."""

    def completed(self, session: Session, packet_id: int) -> None:
        """The session has forgotten it."""

    def held(self, session: Session, packet_id: int, held: UnreleasedPublish) -> None:
        """The session has it."""

    def unheld(self, session: Session, packet_id: int) -> None:
        """The session has forgotten it."""
