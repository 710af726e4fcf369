"""The store for `broker.store.durability: off`: sessions and messages end with the process."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from appliance.broker.accounts import Account
from appliance.broker.broker import Broker
from appliance.broker.delivery import Delivery, UnreleasedPublish
from appliance.broker.message import Message
from appliance.broker.store import SessionState
from appliance.mqtt.packets import Subscription
from appliance.net.callbacks import Entries
from appliance.store.clock import StoreClock, boot_id
from appliance.store.memory_backlogs import MemoryBacklogs
from appliance.store.state import StoreState


class MemoryStore(StoreState):
    """A `SessionStore` that stores nothing: the broker has all in memory, and nothing is staged."""

    path = None
    failing = False
    metrics = None
    backlogs: MemoryBacklogs

    def __init__(self) -> None:
        super().__init__(size=1 << 62)  # only the broker's own limits apply

    def begin_opening(self) -> None:
        """See `SessionStore`; there is nothing to read."""

    def open(self) -> None:
        """See `SessionStore`; there is nothing to read."""

    def restore(self, broker: Broker) -> None:
        """See `SessionStore`; nothing was stored."""
        loop = asyncio.get_running_loop()
        clock = StoreClock(time.time, boot_id)
        clock.start(loop.time, None)
        entries = Entries(loop, broker.faults)
        self.backlogs = MemoryBacklogs(
            lambda callback: entries.soon("store.read", callback), clock.now
        )

    async def close(self) -> None:
        """See `SessionStore`; there is nothing to release."""

    def listen(self, callback: Callable[[bool], None]) -> None:
        """See `Store`; no batch is ever committed."""

    def hurry(self) -> None:
        """See `Store`."""

    def session_saved(self, session: SessionState) -> None:
        """See `Store`."""

    def session_removed(self, session: SessionState) -> None:
        """See `Store`."""

    def subscribed(self, session: SessionState, subscription: Subscription) -> None:
        """See `Store`."""

    def unsubscribed(self, session: SessionState, topic_filter: str) -> None:
        """See `Store`."""

    def retained(self, message: Message, owner: Account) -> None:
        """See `Store`."""

    def queued(self, session: SessionState, delivery: Delivery) -> None:
        """See `Store`."""

    def sent(self, session: SessionState, delivery: Delivery, packet_id: int) -> None:
        """See `Store`."""

    def settled(self, session: SessionState, delivery: Delivery) -> None:
        """See `Store`."""

    def recorded(self, session: SessionState, delivery: Delivery, packet_id: int) -> None:
        """See `Store`."""

    def completed(self, session: SessionState, packet_id: int) -> None:
        """See `Store`."""

    def held(self, session: SessionState, packet_id: int, held: UnreleasedPublish) -> None:
        """See `Store`."""

    def unheld(self, session: SessionState, packet_id: int) -> None:
        """See `Store`."""
