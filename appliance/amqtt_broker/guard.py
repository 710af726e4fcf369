"""What plugins may not do to the appliance: take forever, or break it with an exception."""

from __future__ import annotations

import asyncio
import logging
import traceback
from collections.abc import Coroutine
from typing import Any, TypeVar

log = logging.getLogger(__name__)

#: Seconds that plugins get for an answer or for an event of the life cycle: less than the default
#: of `broker.limits.connect_timeout`, so that a client that they keep waiting is told.
PLUGIN_TIMEOUT = 8.0

#: Failures that are told apart, so that each is told once.
_FAILURES = 1000

_T = TypeVar("_T")


class Guard:
    """Limits the time that plugins take, in seconds, and tells their failures."""

    def __init__(self, timeout: float = PLUGIN_TIMEOUT) -> None:
        self.timeout = timeout
        self._told: set[tuple[str, str]] = set()

    async def within(self, work: Coroutine[Any, Any, _T]) -> _T:
        """The result of the work.

        Raises:
            asyncio.TimeoutError: it took too long; it was cancelled, whether it heeds that or not.
        """
        task = asyncio.ensure_future(work)
        try:
            done, _ = await asyncio.wait({task}, timeout=self.timeout)
            if not done:
                raise asyncio.TimeoutError
            return task.result()
        finally:
            task.cancel()

    def tell(self, what: str, error: BaseException) -> None:
        """Log that `what` failed, with the traceback, the first time that it did so there."""
        last = traceback.extract_tb(error.__traceback__)[-1:]
        failure = what, f"{type(error).__name__} {last}"
        if failure in self._told or len(self._told) >= _FAILURES:
            log.debug("%s failed again: %s", what, error)
        else:
            self._told.add(failure)
            log.error("%s failed; this is told once", what, exc_info=error)


def name(plugin: object) -> str:
    """What a plugin is called in the log."""
    return type(plugin).__name__
