"""What plugins may not do to the appliance: take forever, or break it with an exception."""

from __future__ import annotations

import asyncio
import logging
import traceback
from collections.abc import Coroutine, Iterable
from typing import Any, TypeVar

from appliance.config.redaction import redacted

log = logging.getLogger(__name__)

#: Seconds that plugins get for an answer or for an event of the life cycle: less than the default
#: of `broker.limits.connect_timeout`, so that a client that they keep waiting is told.
PLUGIN_TIMEOUT = 8.0

#: Failures that are told apart, so that each is told once.
_FAILURES = 1000

_T = TypeVar("_T")


class PluginGuard:
    """Limits the time that plugins take, in seconds, and tells their failures.

    `secrets` are those of the plugins' settings: no failure is told with one of them in it.
    """

    def __init__(self, timeout: float = PLUGIN_TIMEOUT, secrets: Iterable[str] = ()) -> None:
        self.timeout = timeout
        self.secrets = list(secrets)
        self._logged: set[tuple[str, str]] = set()

    async def run(self, work: Coroutine[Any, Any, _T]) -> _T:
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

    def log_failure(self, what: str, error: BaseException, secrets: Iterable[str] = ()) -> None:
        """Log that `what` failed, with the traceback, the first time that it did so there.

        `secrets` are what the plugin was told and nobody else may read, such as a password.
        """
        hidden = [*self.secrets, *secrets]
        last = traceback.extract_tb(error.__traceback__)[-1:]
        failure = what, f"{type(error).__name__} {last}"
        if failure in self._logged or len(self._logged) >= _FAILURES:
            log.debug("%s failed again: %s", what, redacted(str(error), hidden))
        else:
            self._logged.add(failure)
            text = "".join(traceback.format_exception(error)).rstrip()
            log.error("%s failed; this is told once\n%s", what, redacted(text, hidden))


def plugin_name(plugin: object) -> str:
    """What a plugin is called in the log."""
    return type(plugin).__name__
