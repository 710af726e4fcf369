"""Catches exceptions on the threads of ROS, and counts them as faults on the loop's thread."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from appliance.net.callbacks import Entries

log = logging.getLogger(__name__)


class FaultContainment:
    """Contains the exceptions of callbacks on a node's own threads.

    `_entries` are those of the event loop, or None without one.
    """

    def __init__(self) -> None:
        self._entries: Entries | None = None

    def _contained(self, entry: str, callback: Callable[..., None]) -> Callable[..., None]:
        """Wrap a callback so that its exceptions end nothing else."""

        def run(*args: Any) -> None:
            try:
                callback(*args)
            except Exception as error:  # it would end the thread, or the whole process
                self._report_fault(entry, error)

        return run

    def _report_fault(self, entry: str, error: Exception) -> None:
        """Count, on the loop's thread, what was caught on this one."""
        entries = self._entries
        with suppress(RuntimeError):  # the loop is closed: nobody can receive it
            if entries is not None:
                entries.from_thread("ros.fault", entries.faults.caught, entry, error)
                return
        log.error("a fault on the ROS thread (%s)", entry, exc_info=error)
