"""What clients had queued while they had no connection, told from what they say now."""

from __future__ import annotations

from appliance.broker.message import Message
from appliance.broker.session import Session


class Backlog:
    """Who has sent old messages, and until when its others are taken for such.

    What is sent again after a lost connection tells how old it is. What its client queued in the
    meantime comes right behind it, and looks like new.
    """

    def __init__(self) -> None:
        self._until: dict[Session, float] = {}

    def has(self, message: Message, origin: Session | None, oldest: float, now: float) -> bool:
        """Whether the message is older than `oldest`, in seconds, or comes behind such a one."""
        if message.age > oldest:
            if origin is not None:
                self._until[origin] = now + oldest
            return True
        until = self._until.get(origin) if origin is not None else None
        if until is None or origin is None:
            return False
        if now >= until:
            del self._until[origin]
            return False
        return True

    def departed(self, session: Session) -> None:
        """Its connection has ended: what it sends on the next one tells its own age."""
        self._until.pop(session, None)
