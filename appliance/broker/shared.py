"""Shared subscriptions (5.0 section 4.8.2): each message goes to one member of a group."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.mqtt.packets import Subscription

#: session, granted QoS, retain as published, subscription identifiers
Target: TypeAlias = "tuple[Session, int, bool, list[int] | None]"


#: Members that are looked at for one message, where that is enough to find one for it.
ASKED = 128


def as_target(session: Session, subscription: Subscription) -> Target:
    """A member of a group as a receiver of a message."""
    ids = [subscription.identifier] if subscription.identifier else None
    return session, subscription.qos, subscription.retain_as_published, ids


class Share:
    """One `$share/{group}/{filter}` and its members, in the order in which they came."""

    def __init__(self, topic_filter: str) -> None:
        self.filter = topic_filter
        self.members: dict[Session, Subscription] = {}
        self._turn = 0
        #: Members that the last `choose` looked at.
        self.looked = 0

    def targets(self) -> list[Target]:
        """All members, as receivers of a message."""
        return [as_target(*member) for member in self.members.items()]

    def choose(
        self,
        members: list[Target],
        message: Message,
        may_receive: Callable[[Session, str], bool] | None = None,
        refusable: bool = True,
    ) -> Target | None:
        """Who of these members gets the message; None when nobody can be given it.

        They take turns. A member that would have to queue the message is passed over as long as
        another can be sent it at once, and an absent one as long as any is there: so many are
        looked at, and on until one is found. `may_receive` is asked where the members are not only
        those that may receive the topic; then no more than so many are looked at.
        """
        best: Target | None = None
        best_rank = 0
        best_index = 0
        count = len(members)
        self.looked = count
        for offset in range(count):
            if offset >= ASKED and (best is not None or may_receive is not None):
                self.looked = offset
                break
            index = (self._turn + offset) % count
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
                    self.looked = offset + 1
                    break
        if best is not None:
            self._turn = (best_index + 1) % count
        return best
