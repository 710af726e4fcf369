"""What plugins may not do to the appliance: take forever, or break it with an exception."""

from __future__ import annotations

import asyncio
import json
import logging
import re
import traceback
from collections.abc import Coroutine, Iterable
from typing import Any, TypeVar

log = logging.getLogger(__name__)

#: Seconds that plugins get for an answer or for an event of the life cycle: less than the default
#: of `broker.limits.connect_timeout`, so that a client that they keep waiting is told.
PLUGIN_TIMEOUT = 8.0

#: Failures that are told apart, so that each is told once.
_FAILURES = 1000

#: Characters: what is shorter is in every text.
_SHORT_SECRET = 4

_T = TypeVar("_T")


class Guard:
    """Limits the time that plugins take, in seconds, and tells their failures.

    `secrets` are those of the plugins' settings: no failure is told with one of them in it.
    """

    def __init__(self, timeout: float = PLUGIN_TIMEOUT, secrets: Iterable[str] = ()) -> None:
        self.timeout = timeout
        self.secrets = list(secrets)
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

    def tell(self, what: str, error: BaseException, secrets: Iterable[str] = ()) -> None:
        """Log that `what` failed, with the traceback, the first time that it did so there.

        `secrets` are what the plugin was told and nobody else may read, such as a password.
        """
        hidden = [*self.secrets, *secrets]
        last = traceback.extract_tb(error.__traceback__)[-1:]
        failure = what, f"{type(error).__name__} {last}"
        if failure in self._told or len(self._told) >= _FAILURES:
            log.debug("%s failed again: %s", what, redacted(str(error), hidden))
        else:
            self._told.add(failure)
            told = "".join(traceback.format_exception(error)).rstrip()
            log.error("%s failed; this is told once\n%s", what, redacted(told, hidden))


def redacted(text: str, secrets: Iterable[str]) -> str:
    """The text without the secrets, also as they stand in an address, in JSON or in a `repr`.

    With one that is too short to be told from other text nothing is left.
    """
    for secret in sorted(filter(None, set(secrets)), key=len, reverse=True):
        form = re.compile("".join(map(_form, secret)), re.IGNORECASE)
        if len(secret) < _SHORT_SECRET and form.search(text):
            return "(not shown: it may hold a secret)"
        text = form.sub("********", text)
    return text


def _form(char: str) -> str:
    """What a character may have become on its way into a message; each in its own way."""
    encoded = "".join(f"%{byte:02x}" for byte in char.encode("utf-8", "surrogatepass"))
    forms = {char, encoded, json.dumps(char)[1:-1], repr(char)[1:-1], ascii(char)[1:-1]}
    if char == " ":
        forms.add("+")
    return f"(?:{'|'.join(map(re.escape, sorted(forms, key=len, reverse=True)))})"


def name(plugin: object) -> str:
    """What a plugin is called in the log."""
    return type(plugin).__name__
