"""A bounded cache that users share fairly: when it is full, the largest user loses its oldest."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Hashable, Iterator
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class _UserEntries(Generic[K, V]):
    """The entries of one user, the oldest first: values with their sizes."""

    def __init__(self) -> None:
        self.entries: OrderedDict[K, tuple[V, int]] = OrderedDict()
        self.size = 0


class FairCache(Generic[K, V]):
    """Values by keys, each of a user (None: all clients without one).

    Beyond `entries`, evict the oldest entry of the user with the most entries; beyond a total of
    `size`, that of the user with the largest sum of sizes.
    """

    def __init__(self, entries: int, size: float = math.inf) -> None:
        self._max_entries = entries
        self._max_size = size
        self._users: dict[str | None, _UserEntries[K, V]] = {}
        self._user_of: OrderedDict[K, str | None] = OrderedDict()
        self._size = 0

    def __len__(self) -> int:
        return len(self._user_of)

    def __contains__(self, key: K) -> bool:
        return key in self._user_of

    def __iter__(self) -> Iterator[K]:
        return iter(self._user_of)

    def get(self, key: K) -> V | None:
        """The value; None if there is none, or it was evicted."""
        if key not in self._user_of:
            return None
        return self._users[self._user_of[key]].entries[key][0]

    def put(self, user: str | None, key: K, value: V, size: int = 0) -> list[tuple[K, V]]:
        """Add or replace a value; returns the evicted keys and values."""
        self.remove(key)
        own = self._users.setdefault(user, _UserEntries())
        own.entries[key] = value, size
        own.size += size
        self._user_of[key] = user
        self._size += size
        evicted = []
        while len(self) > 1 and (len(self) > self._max_entries or self._size > self._max_size):
            by_size = self._size > self._max_size
            own = max(
                self._users.values(), key=lambda one: one.size if by_size else len(one.entries)
            )
            oldest, (old, _) = next(iter(own.entries.items()))
            evicted.append((oldest, old))
            self.remove(oldest)
        return evicted

    def remove(self, key: K) -> None:
        """Remove a value, if it is there."""
        if key not in self._user_of:
            return
        user = self._user_of.pop(key)
        own = self._users[user]
        _, size = own.entries.pop(key)
        own.size -= size
        self._size -= size
        if not own.entries:
            del self._users[user]

    def items(self) -> Iterator[tuple[K, V]]:
        """All keys and values, the oldest first."""
        for key, user in self._user_of.items():
            yield key, self._users[user].entries[key][0]
