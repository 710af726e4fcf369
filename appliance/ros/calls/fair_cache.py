"""A bounded table that many users share: when it is full, who has most in it loses the oldest."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Hashable, Iterator
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class _UserEntries(Generic[K, V]):
    """What one user has: values with their sizes, the oldest first."""

    def __init__(self) -> None:
        self.entries: OrderedDict[K, tuple[V, int]] = OrderedDict()
        self.size = 0


class FairCache(Generic[K, V]):
    """Values by keys, each of a user (None: of all without one). It has up to `entries` of them,
    and up to `size` in all of what `put` says each has."""

    def __init__(self, entries: int, size: float = math.inf) -> None:
        self._most = entries
        self._largest = size
        self._shares: dict[str | None, _UserEntries[K, V]] = {}
        self._user_of: OrderedDict[K, str | None] = OrderedDict()
        self._size = 0

    def __len__(self) -> int:
        return len(self._user_of)

    def __contains__(self, key: K) -> bool:
        return key in self._user_of

    def __iter__(self) -> Iterator[K]:
        return iter(self._user_of)

    def get(self, key: K) -> V | None:
        """The value; None if there is none, or no more."""
        if key not in self._user_of:
            return None
        return self._shares[self._user_of[key]].entries[key][0]

    def put(self, user: str | None, key: K, value: V, size: int = 0) -> list[tuple[K, V]]:
        """Add a value; returns what had to go for it."""
        self.remove(key)
        share = self._shares.setdefault(user, _UserEntries())
        share.entries[key] = value, size
        share.size += size
        self._user_of[key] = user
        self._size += size
        dropped = []
        while len(self) > 1 and (len(self) > self._most or self._size > self._largest):
            by_size = self._size > self._largest
            share = max(
                self._shares.values(), key=lambda one: one.size if by_size else len(one.entries)
            )
            oldest, (old, _) = next(iter(share.entries.items()))
            dropped.append((oldest, old))
            self.remove(oldest)
        return dropped

    def remove(self, key: K) -> None:
        """Take a value out, if it is there."""
        if key not in self._user_of:
            return
        user = self._user_of.pop(key)
        share = self._shares[user]
        _, size = share.entries.pop(key)
        share.size -= size
        self._size -= size
        if not share.entries:
            del self._shares[user]

    def items(self) -> Iterator[tuple[K, V]]:
        """All of them, the oldest first."""
        for key, user in self._user_of.items():
            yield key, self._shares[user].entries[key][0]
