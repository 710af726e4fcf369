"""The link of a session of the bridge: what is subscribed to comes as calls of a function."""

from __future__ import annotations

from collections.abc import Callable

from appliance.broker.message import Message
from appliance.broker.ports import InsideLink


class ReceivingLink(InsideLink):
    """Calls `receive` with each message, whether it is a retained one, and the identifiers of the
    subscriptions that it matches."""

    def __init__(self, receive: Callable[[Message, bool, list[int] | None], None]) -> None:
        self._receive = receive

    def publish(
        self,
        message: Message,
        qos: int,
        packet_id: int,
        dup: bool,
        retain: bool,
        subscription_ids: list[int] | None,
    ) -> None:
        self._receive(message, retain, subscription_ids)
