"""Settings for output: values that look like secrets are masked."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from appliance.config.settings import Settings
from appliance.config.yaml_document import KeyPath

# The name of a file with a secret in it is none.
_SECRET_KEY = re.compile(
    r"(?i)(?!.*_file$)(.*pass(word|wd|phrase)?$|.*(secret|token|credential|api_?key|private))"
)


# Up to the last @ of a word, because passwords may contain a slash or an @.
_URL_PASSWORD = re.compile(r"(?<=://)([^/\s:@]*):\S+(?=@)")


MASK = "********"

OPEN_WITH_SECRETS = (
    "has secrets in it, and every user of this computer can read it: close it with `chmod o=`, or "
    "take them from environment variables, ${NAME}"
)


def mask(path: KeyPath, value: Any) -> Any:
    """The value for output: masked when its key or its form marks it as a secret."""
    if isinstance(value, Mapping):
        return {key: mask((*path, key), inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [mask(path, inner) for inner in value]
    if _is_secret(path) and value:
        return MASK
    return _URL_PASSWORD.sub(rf"\1:{MASK}", value) if isinstance(value, str) else value


def _is_secret(path: KeyPath) -> bool:
    """Whether a key of the path names a secret: `tokens: {alice: …}`; plugins' names do not."""
    return any(
        isinstance(part, str) and "." not in part and _SECRET_KEY.match(part) for part in path
    )


def secrets_in(value: Any, path: KeyPath = ()) -> Iterator[str]:
    """All secrets that `mask` hides in a value, to remove them from other texts such as errors."""
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
            if "@" in secret:  # the password may end at the first @ as well
                yield secret.partition("@")[0]


def is_open_with_secrets(settings: Settings) -> bool:
    """Whether the settings file has secrets and is readable by every user of this computer."""
    if settings.file is None:
        return False
    try:
        if not settings.file.stat().st_mode & 0o004:
            return False
        text = settings.file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False
    # Secrets from environment variables are not in the file.
    return any(secret in text for secret in secrets_of(settings))


def secrets_of(settings: Settings) -> Iterator[str]:
    """All secrets of the settings: of plugins, and the passwords of proxies."""
    yield from secrets_in(settings.broker.plugins)
    yield from secrets_in([upstream.proxy for upstream in settings.upstreams])


def describe(settings: Settings) -> dict[str, Any]:
    """All settings as plain values, structured as in appliance.yaml, with secrets masked."""
    described: dict[str, Any] = mask((), settings.model_dump(mode="json", by_alias=True))
    return described
