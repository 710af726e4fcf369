"""The latest messages of the topics of one rule that wait: at most one of each topic."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Iterator


class LatestValue:
    """What waits as the latest message of a topic.

    `size` is the bytes of its record, `data`, which is None while it is only on disk: `single` is
    then the key of it there. `key` is that of the row in the table of latest records, if it has
    one. It may be handed out when no record waits in the rule's journal up to the number `after`.
    `user` has published it, see `UserShares`.
    """

    __slots__ = (
        "after",
        "data",
        "expires_at",
        "is_read",
        "key",
        "number",
        "qos",
        "single",
        "size",
        "stored_at",
        "topic",
        "user",
    )

    def __init__(
        self,
        topic: str,
        number: int,
        qos: int,
        size: int,
        stored_at: float,
        expires_at: float,
        user: str | None = None,
    ) -> None:
        self.topic = topic
        self.number = number
        self.qos = qos
        self.size = size
        self.stored_at = stored_at
        self.expires_at = expires_at
        self.user = user
        self.after = 0
        self.data: bytes | None = None
        self.key: int | None = None
        self.single: int | None = None
        #: Whether it is being read from disk, or was.
        self.is_read = False


class LatestValues:
    """The values of a rule, by topic.

    Those that may be handed out are `ready`, in the order in which their topics began to wait; the
    others are `blocked`.
    """

    def __init__(self) -> None:
        self.ready: OrderedDict[str, LatestValue] = OrderedDict()
        self.blocked: OrderedDict[str, LatestValue] = OrderedDict()
        #: Those of each user by topic, in the order in which these became the user's.
        self._of_user: dict[str, OrderedDict[str, LatestValue]] = {}

    def __len__(self) -> int:
        return len(self.ready) + len(self.blocked)

    def __contains__(self, topic: str) -> bool:
        return topic in self.ready or topic in self.blocked

    def __iter__(self) -> Iterator[LatestValue]:
        yield from self.ready.values()
        yield from self.blocked.values()

    def get(self, topic: str) -> LatestValue | None:
        """The topic's value."""
        return self.ready.get(topic) or self.blocked.get(topic)

    def put(self, value: LatestValue) -> None:
        """It waits, in the place of the topic's value before, if that is still there."""
        before = self.get(value.topic)
        if before is not None and before.user != value.user:
            self._disown(before)
        if value.user is not None:
            self._of_user.setdefault(value.user, OrderedDict())[value.topic] = value
        if value.after:
            self.ready.pop(value.topic, None)
            self.blocked.pop(value.topic, None)
            self.blocked[value.topic] = value
        else:
            self.blocked.pop(value.topic, None)
            self.ready[value.topic] = value

    def pop(self, value: LatestValue) -> None:
        """It waits no more."""
        values = self.ready if value.topic in self.ready else self.blocked
        del values[value.topic]
        self._disown(value)

    def _disown(self, value: LatestValue) -> None:
        if value.user is None:
            return
        own = self._of_user[value.user]
        del own[value.topic]
        if not own:
            del self._of_user[value.user]

    def unblock(self, number: float) -> None:
        """The first record of the journal that waits has this number."""
        blocked = self.blocked
        while blocked:
            topic, value = next(iter(blocked.items()))
            if value.after >= number:
                break
            del blocked[topic]
            value.after = 0
            self.ready[topic] = value

    def oldest(self) -> LatestValue | None:
        """The first one of those that are ready or of the others, whichever is older."""
        firsts = [next(iter(each.values())) for each in (self.ready, self.blocked) if each]
        return min(firsts, key=lambda each: each.number, default=None)

    def oldest_of(self, user: str) -> LatestValue | None:
        """The user's one whose topic has waited for longest."""
        own = self._of_user.get(user)
        return next(iter(own.values())) if own else None

    def fill(self, values: Iterable[LatestValue]) -> None:
        """Put what was stored, in the order of publishing."""
        for value in sorted(values, key=lambda each: each.number):
            self.put(value)
