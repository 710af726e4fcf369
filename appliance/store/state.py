"""What the broker polls of its store."""

from __future__ import annotations


class StoreState:
    """The attributes of the port `Store`, which says what each stands for.

    The broker reads them for every message. So they are plain attributes of the store itself, and
    whatever changes them (`Committer`, `StoredMessages`) is given the store as its `StoreState`.
    """

    def __init__(self, size: int) -> None:
        self.staged = False
        self.fresh = False
        self.batch = 1
        self.committed = 0
        self.bytes = 0
        self.size = size
