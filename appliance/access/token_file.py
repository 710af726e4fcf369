"""The file by which tokens outlast a restart of the appliance, though not one of the computer.

It has no token, only what recognizes one (`tokens.py`). To forge one, somebody would have to write
the file and to know the hash of a password as well; a file that others may write is not believed.
"""

from __future__ import annotations

import json
import logging
import os
import re
import stat
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import astuple
from math import isfinite
from pathlib import Path
from typing import Any, Final

from appliance.access.rewriting import replacing
from appliance.access.tokens import Token

_log = logging.getLogger(__name__)

#: Bytes of a file that is read: as many tokens as there may be, of users with long names.
_LARGEST: Final = 4 << 20

_DIGEST: Final = re.compile("[0-9a-f]{64}")


class TokenFile:
    """The file at `path`, for this boot of the computer, of which `boot` is the id."""

    def __init__(self, path: Path, boot: str) -> None:
        self._path = path
        self._boot = boot
        self._fails = False
        # One thread, so that what was saved last is what stays.
        self._thread = ThreadPoolExecutor(1, "tokens")

    def read(self) -> list[Token]:
        """The tokens in the file; none, and a warning, where it cannot be believed."""
        try:
            found = json.loads(_read_own(self._path))
            return [_token(each) for each in found["tokens"]] if found["boot"] == self._boot else []
        except FileNotFoundError:
            return []
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            why = f"{type(error).__name__}: {error}"
            _log.warning("%s is not used, users sign in again: %s", self._path, why)
            return []

    def save(self, tokens: list[Token]) -> Future[None]:
        """Have these in the file, soon and in a thread; the future never fails."""
        return self._thread.submit(self._write, tokens)

    def close(self) -> None:
        """Return when all is saved."""
        self._thread.shutdown()

    def _write(self, tokens: list[Token]) -> None:
        content = json.dumps({"boot": self._boot, "tokens": [astuple(each) for each in tokens]})
        try:
            with replacing(self._path, content):
                pass
            self._fails = False
        except OSError as error:
            if not self._fails:
                _log.warning("users will sign in again after a restart: %s", error)
            self._fails = True
            self._remove()

    def _remove(self) -> None:
        """In an old file would be tokens that have ended."""
        try:
            self._path.unlink(missing_ok=True)
        except OSError as error:
            _log.warning("tokens that have ended are valid again after a restart: %s", error)


def _read_own(path: Path) -> bytes:
    """The content of a file that nobody else may write. Raises OSError, ValueError."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise ValueError("it is no file")
        if status.st_uid != os.geteuid():
            raise ValueError("it belongs to another user")
        if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise ValueError("others may write it")
        if status.st_size > _LARGEST:
            raise ValueError(f"it has {status.st_size} bytes")
        return file.read(_LARGEST)


def _token(value: Any) -> Token:
    """A token of the file. Raises ValueError, TypeError."""
    digest, username, password, ends_at = value
    if not (_DIGEST.fullmatch(digest) and _DIGEST.fullmatch(password)):
        raise ValueError("a digest is wrong")
    if not (isinstance(username, str) and isinstance(ends_at, float) and isfinite(ends_at)):
        raise ValueError("a token is wrong")
    return Token(digest, username, password, ends_at)
