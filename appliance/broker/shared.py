"""Shared subscriptions (5.0 section 4.8.2): each message goes to one member of a group."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.mqtt.packets import Subscription

#: session, granted QoS, retain as published, subscription identifiers
Target: TypeAlias = "tuple[Session, int, bool, list[int] | None]"


#: Members that are checked for one message, if one of them can receive it.
MAXIMUM_CHECKED = 128


def as_target(session: Session, subscription: Subscription) -> Target:
    """A member of a group as the target of a message."""
    ids = [subscription.identifier] if subscription.identifier else None
    return session, subscription.qos, subscription.retain_as_published, ids


class Share:
    """One `$share/{group}/{filter}` and its members, in the order in which they subscribed."""

    def __init__(self, topic_filter: str) -> None:
        self.filter = topic_filter
        self.members: dict[Session, Subscription] = {}
        self._next = 0
        #: Members that the last `choose` checked.
        self.checked = 0

    def targets(self) -> list[Target]:
        """All members as targets of a message."""
        return [as_target(*member) for member in self.members.items()]

    def choose(
        self,
        members: list[Target],
        message: Message,
        may_receive: Callable[[Session, str], bool] | None = None,
        refusable: bool = True,
    ) -> Target | None:
        """Choose the member that gets the message, round robin; None when no member can take it.

        A member that can send the message immediately is preferred to one that would queue it, and
        a connected member to an absent one. Up to MAXIMUM_CHECKED members are checked, and more
        until one is found. `may_receive` is passed when `members` may contain some that must not
        receive the topic; then no more than MAXIMUM_CHECKED are checked.
        """
        best: Target | None = None
        best_rank = 0
        best_index = 0
        count = len(members)
        self.checked = count
        for offset in range(count):
            if offset >= MAXIMUM_CHECKED and (best is not None or may_receive is not None):
                self.checked = offset
                break
            index = (self._next + offset) % count
            session = members[index][0]
            qos = min(message.qos, members[index][1])
            if session.link is None:
                rank = 1 if qos and session.persistent else 0
            else:
                rank = 3 if session.ready else 2
            if (
                rank > best_rank
                and (not qos or session.has_room(message, refusable))
                and (may_receive is None or may_receive(session, message.topic))
            ):
                best, best_rank, best_index = members[index], rank, index
                if rank == 3:
                    self.checked = offset + 1
                    break
        if best is not None:
            self._next = (best_index + 1) % count
        return best
