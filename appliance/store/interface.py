"""What a store must do: what the broker calls, and a life from `open` to `close`."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from appliance.broker.backlogs import Backlogs
from appliance.broker.broker import Broker
from appliance.broker.store import Store
from appliance.store.committer import CommitMetrics


class SessionStore(Store, Protocol):
    """Stores sessions and retained messages; the event loop's thread alone calls it.

    `open` comes first, then a broker is created with the store, and `restore` fills it before
    clients connect. `close` ends every store that was opened, restored or not.
    """

    @property
    def path(self) -> Path | None:
        """Where sessions and messages are stored; None when they end with the process."""

    @property
    def failing(self) -> bool:
        """Whether nothing can be stored now."""

    @property
    def metrics(self) -> CommitMetrics | None:
        """What was committed since the start; None when nothing is."""

    @property
    def backlogs(self) -> Backlogs:
        """The backlogs of links to other brokers, from `restore` on."""

    def begin_opening(self) -> None:
        """Begin what `open` does in a thread; `open` then waits for it."""

    def open(self) -> None:
        """Lock and read what the last run has stored.

        Raises:
            StoreError: it is in use, of a newer version, or cannot be read.
        """

    def restore(self, broker: Broker) -> None:
        """Give the broker what was stored, on the event loop."""

    async def close(self) -> None:
        """Commit what is staged and release everything; may be called twice."""
