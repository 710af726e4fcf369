"""Where sessions and retained messages are kept. In this version: in memory, for one run."""

from __future__ import annotations

from collections.abc import Callable

from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.mqtt.packets import Subscription


class MemoryStore:
    """The `Store` that keeps nothing beyond the broker's own memory, so that nothing is staged."""

    staged = False

    def after_commit(self, callback: Callable[[bool], None]) -> None:
        """Nothing is staged: call back at once."""
        callback(True)

    def session_saved(self, session: Session) -> None:
        """The broker has it."""

    def session_removed(self, session: Session) -> None:
        """The broker has forgotten it."""

    def subscribed(self, session: Session, subscription: Subscription) -> None:
        """The session has it."""

    def unsubscribed(self, session: Session, topic_filter: str) -> None:
        """The session has forgotten it."""

    def retained(self, message: Message) -> None:
        """The broker has it."""

    def queued(self, session: Session, message: Message, qos: int) -> None:
        """The session has it."""

    def settled(self, session: Session, message: Message) -> None:
        """The session has forgotten it."""
