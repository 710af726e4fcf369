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

#: Members of a list of ranks that take as long as looking at one.
LISTED_PER_CHECK = 8

#: Answers that a member may not receive a topic while messages are passed on, after which only
#: FEW_CHECKED members are asked about each message; the next one begins behind these.
MAXIMUM_FORBIDDEN = 4096
FEW_CHECKED = 32


def as_target(session: Session, subscription: Subscription) -> Target:
    """A member of a group as the target of a message."""
    ids = [subscription.identifier] if subscription.identifier else None
    return session, subscription.qos, subscription.retain_as_published, ids


class Share:
    """One `$share/{group}/{filter}` and its members, in the order in which they subscribed."""

    def __init__(self, topic_filter: str) -> None:
        self.filter = topic_filter
        self.members: dict[Session, Subscription] = {}
        #: The members whose subscription is of QoS 0.
        self.of_qos_0: set[Session] = set()
        self._next = 0
        #: Members that the last `choose` checked.
        self.checked = 0

    def join(self, session: Session, subscription: Subscription) -> None:
        """Add a member, or replace its subscription."""
        self.members[session] = subscription
        if subscription.qos:
            self.of_qos_0.discard(session)
        else:
            self.of_qos_0.add(session)

    def leave(self, session: Session) -> None:
        """Remove a member; does nothing if it is none."""
        self.members.pop(session, None)
        self.of_qos_0.discard(session)

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
    """The members of groups while messages that another one leaves are passed on to them.

    `choose` finds the one that `Share.choose` would find among up to MAXIMUM_CHECKED members. While
    messages are handed over no member gets room or becomes ready. So one that has refused a message
    is not asked again for any of about that size, in whichever group, and one that is not ready any
    more is looked for among the others: all messages together take members and messages, and not
    their product. A session is examined once, be it a member of a thousand groups.
    """

    __slots__ = ("_absent_too", "_forbidden", "_forbidden_count", "_groups", "_ranks", "checked")

    def __init__(self, *, absent_too: bool) -> None:
        self._absent_too = absent_too
        self._groups: dict[Share, _Group] = {}
        #: By size (0 for members with QoS 0, which need no room), the rank of each session when it
        #: was last looked at; 0 for one that has refused a message of that size.
        self._ranks: dict[int, dict[Session, int]] = {0: {}}
        #: By topic, those who may not receive it; and how many they are in all.
        self._forbidden: dict[str, set[Session]] = {}
        self._forbidden_count = 0
        #: Members that the last `choose` looked at.
        self.checked = 0

    def choose(
        self, share: Share, message: Message, may_receive: Callable[[Session, str], bool]
    ) -> Target | None:
        """The member that gets the message, round robin; None when no member can take it."""
        self.checked = 0
        group = self._groups.get(share)
        if group is None:
            group = self._groups[share] = _Group(share)
        # Four sizes from each power of two to the next: to tell all sizes apart would take as many
        # checks as there are sizes, for each member.
        shift = max(message.size.bit_length() - 3, 0)
        size = message.size >> shift << shift
        ranks = group.ranks.get(size)
        if ranks is None:
            ranks = group.ranks[size] = self._ranks_of(group, size)
        index = self._find(share, group, ranks, size, message, may_receive)
        if index < 0:
            return None
        share._next = (index + 1) % len(ranks)
        session = group.sessions[index]
        subscription = share.members.get(session)
        return as_target(session, subscription) if subscription is not None else None

    def _ranks_of(self, group: _Group, size: int) -> bytearray:
        """The rank of each member of the group, for messages of about this size."""
        known, of_qos_0 = self._ranks.setdefault(size, {}), self._ranks[0]
        self.checked += len(group.sessions) // LISTED_PER_CHECK
        try:
            if not group.of_qos_0:
                return bytearray(map(known.__getitem__, group.sessions))
            tables = (known, of_qos_0)
            return bytearray([tables[s in group.of_qos_0][s] for s in group.sessions])
        except KeyError:  # some are looked at for the first time
            for session in group.sessions:
                is_of_qos_0 = session in group.of_qos_0
                table = of_qos_0 if is_of_qos_0 else known
                if session not in table:
                    self.checked += 1
                    table[session] = _rank(session, 0 if is_of_qos_0 else 1)
            return self._ranks_of(group, size)

    def _find(
        self,
        share: Share,
        group: _Group,
        ranks: bytearray,
        size: int,
        message: Message,
        may_receive: Callable[[Session, str], bool],
    ) -> int:
        """The index of the member that gets the message; -1 when no member can take it."""
        forbidden = self._forbidden.setdefault(message.topic, set())
        table_of = self._ranks[0], self._ranks.setdefault(size, {})
        passed_over = 0
        begin = share._next % (len(ranks) or 1)
        for rank in (3, 2, 1) if self._absent_too else (3, 2):
            for start, end in ((begin, len(ranks)), (0, begin)):
                index = start - 1
                while (index := ranks.find(rank, index + 1, end)) >= 0:
                    session = group.sessions[index]
                    qos = 0 if session in group.of_qos_0 else 1
                    known = table_of[qos]
                    rank_known = known.get(session, rank)
                    if rank_known < rank:  # as it turned out in another group
                        ranks[index] = rank_known
                        continue
                    if session not in forbidden:
                        self.checked += 1
                        rank_now = _rank(session, qos)
                        if rank_now >= rank and qos and not session.has_room(message):
                            rank_now = 0
                        if rank_now < rank:
                            known[session] = ranks[index] = rank_now
                            continue
                        if may_receive(session, message.topic):
                            self.checked += passed_over // LISTED_PER_CHECK
                            return index
                        forbidden.add(session)
                        self._forbidden_count += 1
                    passed_over += 1
                    few = self._forbidden_count > MAXIMUM_FORBIDDEN
                    if passed_over >= (FEW_CHECKED if few else MAXIMUM_CHECKED):
                        if few:
                            share._next = (index + 1) % len(ranks)
                        self.checked += passed_over // LISTED_PER_CHECK
                        return -1
        self.checked += passed_over // LISTED_PER_CHECK
        return -1


class _Group:
    """The members of one group, as they are when the first message is passed on."""

    __slots__ = ("of_qos_0", "ranks", "sessions")

    def __init__(self, share: Share) -> None:
        self.sessions = list(share.members)
        self.of_qos_0 = share.of_qos_0
        #: By size, the rank of each member (see `_rank`); 0 for one that has no room.
        self.ranks: dict[int, bytearray] = {}


def _rank(session: Session, qos: int) -> int:
    """3 for one that can send a message of QoS 1 or 2, 2 if connected, 1 if it is kept, else 0."""
    if session.link is None:
        return 1 if qos and session.persistent else 0
    return 3 if session.ready else 2
