"""Shared subscriptions (5.0 section 4.8.2): each message goes to one member of a group."""

from __future__ import annotations

from bisect import bisect_left, insort
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
            rank = _rank(session, qos)
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


class Heirs:
    """The members of a group while messages that another one leaves are passed on to them.

    `choose` finds the one that `Share.choose` would find among up to MAXIMUM_CHECKED members. While
    messages are handed over no member gets room or becomes ready. So one that has refused a message
    is not asked again for any of about that size, and one that is not ready any more is looked for
    among the others: all messages together take members and messages, and not their product.
    """

    __slots__ = ("_by_size", "_members", "_share", "checked")

    def __init__(self, share: Share, members: list[Target]) -> None:
        self._share = share
        self._members = members
        #: By size, the indexes of members that may have room, by their rank (see `_rank`), sorted.
        self._by_size: dict[int, list[list[int]]] = {}
        #: Members that the last `choose` looked at.
        self.checked = 0

    def choose(
        self, message: Message, may_receive: Callable[[Session, str], bool]
    ) -> Target | None:
        """The member that gets the message, round robin; None when no member can take it."""
        # Four sizes from each power of two to the next: to tell all sizes apart would take as many
        # checks as there are sizes, for each member.
        shift = max(message.size.bit_length() - 3, 0)
        size = message.size >> shift << shift
        self.checked = 0
        ranked = self._by_size.get(size)
        if ranked is None:
            ranked = self._by_size[size] = [[], [], [], []]
            for index, member in enumerate(self._members):
                ranked[_rank(member[0], member[1])].append(index)
            self.checked = len(self._members)
        share = self._share
        count = len(self._members)
        forbidden = 0
        for rank in (3, 2, 1):
            candidates = ranked[rank]
            position = bisect_left(candidates, share._next % count) if candidates else 0
            for _ in range(len(candidates)):
                self.checked += 1
                position %= len(candidates)
                index = candidates[position]
                member = self._members[index]
                session = member[0]
                rank_now = _rank(member[0], member[1])
                if rank_now < rank:
                    del candidates[position]
                    insort(ranked[rank_now], index)
                elif member[1] and not session.has_room(message):
                    del candidates[position]
                elif may_receive(session, message.topic):
                    share._next = (index + 1) % count
                    return member
                else:
                    position += 1
                    forbidden += 1
                    if forbidden >= MAXIMUM_CHECKED:
                        return None
        return None


def _rank(session: Session, qos: int) -> int:
    """3 for one that can send a message of QoS 1 or 2, 2 if connected, 1 if it is kept, else 0."""
    if session.link is None:
        return 1 if qos and session.persistent else 0
    return 3 if session.ready else 2
