"""Shared subscriptions (5.0 section 4.8.2): each message goes to one member of a group."""

from __future__ import annotations

from typing import TypeAlias

from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.mqtt.packets import Subscription

#: session, granted QoS, retain as published, subscription identifiers
Target: TypeAlias = "tuple[Session, int, bool, list[int] | None]"


#: Members that are looked at for one message.
ASKED = 128


class Share:
    """One `$share/{group}/{filter}` and its members, in the order in which they came."""

    def __init__(self, topic_filter: str) -> None:
        self.filter = topic_filter
        self.members: dict[Session, Subscription] = {}
        self._turn = 0

    def choose(self, members: list[Target], message: Message) -> Target | None:
        """Who of these members gets the message; None when nobody can be given it.

        They take turns. A member that would have to queue the message is passed over as long as
        another can be sent it at once, and an absent one as long as any is there.
        """
        best: Target | None = None
        best_rank = 0
        best_index = 0
        count = len(members)
        for offset in range(min(count, ASKED)):
            index = (self._turn + offset) % count
            session = members[index][0]
            qos = min(message.qos, members[index][1])
            if session.link is None:
                rank = 1 if qos and session.persistent else 0
            else:
                rank = 3 if session.ready else 2
            if rank > best_rank and (not qos or session.has_room(message)):
                best, best_rank, best_index = members[index], rank, index
                if rank == 3:
                    break
        if best is not None:
            self._turn = (best_index + 1) % count
        return best
