"""Settings as they are shown: what looks like a secret is masked."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from appliance.config.settings import Settings
from appliance.config.yaml_document import KeyPath

_SECRET_KEY = re.compile(r"(?i)pass(word|wd|phrase)?$|secret|token|credential|api_?key|private")


# As far as the last @ of a word: people also write passwords with a slash or an @ in them.
_URL_PASSWORD = re.compile(r"(?<=://)([^/\s:@]*):\S+(?=@)")


MASK = "********"

OPEN_WITH_SECRETS = (
    "has secrets in it, and every user of this computer can read it: close it with `chmod o=`, or "
    "take them from environment variables, ${NAME}"
)


def mask(path: KeyPath, value: Any) -> Any:
    """The value as it may be printed: masked when its key or its form says that it is a secret."""
    if isinstance(value, Mapping):
        return {key: mask((*path, key), inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [mask(path, inner) for inner in value]
    if _is_secret(path) and value:
        return MASK
    return _URL_PASSWORD.sub(rf"\1:{MASK}", value) if isinstance(value, str) else value


def _is_secret(path: KeyPath) -> bool:
    """Whether a key says so, or one above it that is no plugin's name: `tokens: {alice: …}`."""
    return any(
        isinstance(part, str) and "." not in part and _SECRET_KEY.search(part) for part in path
    )


def secrets_in(value: Any, path: KeyPath = ()) -> Iterator[str]:
    """All that `mask` hides in a value, to be kept out of what others say about it."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from secrets_in(inner, (*path, key))
    elif isinstance(value, (list, tuple)):
        for inner in value:
            yield from secrets_in(inner, path)
    elif _is_secret(path):
        if value:
            yield str(value)
    elif isinstance(value, str):
        for match in _URL_PASSWORD.finditer(value):
            secret = match[0].partition(":")[2]
            yield secret
            if "@" in secret:  # it may as well have ended there
                yield secret.partition("@")[0]


def is_open_with_secrets(settings: Settings) -> bool:
    """Whether every user of this computer can read secrets in the file of these settings."""
    if settings.file is None:
        return False
    try:
        if not settings.file.stat().st_mode & 0o004:
            return False
        text = settings.file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False
    # What an environment variable has put there is not in the file.
    return any(secret in text for secret in secrets_in(settings.broker.plugins))


def describe(settings: Settings) -> dict[str, Any]:
    """Every setting in force as plain values, in the form of appliance.yaml, secrets masked."""
    described: dict[str, Any] = mask((), settings.model_dump(mode="json"))
    return described
