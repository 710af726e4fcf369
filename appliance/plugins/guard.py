"""Limits plugins: a time limit for each call, and exceptions that are logged, not raised."""

from __future__ import annotations

import asyncio
import logging
import traceback
from collections.abc import Coroutine, Iterable
from typing import Any, TypeVar

from appliance.config.redaction import redacted

log = logging.getLogger(__name__)

#: Seconds that plugins have for an answer or for a life-cycle event: less than the default of
#: `broker.limits.connect_timeout`, so that a client gets an answer when they hang.
PLUGIN_TIMEOUT = 8.0

#: Different failures that are logged with a traceback, once each.
_FAILURES = 1000

_T = TypeVar("_T")


class PluginGuard:
    """Limits the time of plugins, in seconds, and logs their failures.

    `secrets` are those of the plugins' settings, which are masked in the log.
    """

    def __init__(self, timeout: float = PLUGIN_TIMEOUT, secrets: Iterable[str] = ()) -> None:
        self.timeout = timeout
        self.secrets = list(secrets)
        self._logged: set[tuple[str, str]] = set()

    async def run(self, work: Coroutine[Any, Any, _T]) -> _T:
        """Await the work and return its result.

        Raises:
            asyncio.TimeoutError: it took too long. It was cancelled, but may ignore that.
        """
        task = asyncio.ensure_future(work)
        try:
            done, _ = await asyncio.wait({task}, timeout=self.timeout)
            if not done:
                raise asyncio.TimeoutError
            return task.result()
        finally:
            task.cancel()

    def log_failure(self, what: str, error: BaseException, secrets: Iterable[str] = ()) -> None:
        """Log that `what` failed; with the traceback at the first time for each place.

        `secrets` are further strings to mask, such as the client's password.
        """
        hidden = [*self.secrets, *secrets]
        last = traceback.extract_tb(error.__traceback__)[-1:]
        failure = what, f"{type(error).__name__} {last}"
        if failure in self._logged or len(self._logged) >= _FAILURES:
            log.debug("%s failed again: %s", what, redacted(str(error), hidden))
        else:
            self._logged.add(failure)
            text = "".join(traceback.format_exception(error)).rstrip()
            log.error("%s failed; this is logged once\n%s", what, redacted(text, hidden))


def plugin_name(plugin: object) -> str:
    """The name of a plugin in the log."""
    return type(plugin).__name__
