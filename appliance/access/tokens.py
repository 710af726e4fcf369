"""Tokens: a user stays signed in for a while without its password.

A token takes the place of the password in a login of its user, and has no right of its own. It ends
with its time, with another password of the user or its removal, and with the computer's start, as
its time is by a clock that begins there. Kept is the SHA-256 of its random bits alone, and of the
hash of the password: neither the memory, nor the file (`token_file.py`), nor the time of a look-up
tells a token.

A password of this form is always taken for a token. So one that has ended costs no hash, and is no
guess that delays others; and no plugin is shown it.
"""

from __future__ import annotations

import hashlib
import re
import secrets
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

#: What each begins with, so that people and programs that look for secrets recognize it.
PREFIX: Final = "appliance-token-"

#: Random bytes of a token, and how they are written.
_RANDOM: Final = 32
_FORM: Final = re.compile(re.escape(PREFIX.encode()) + rb"[A-Za-z0-9_-]{43}")

#: Seconds until a token ends: a working day, and a night's sleep behind it.
LIFETIME: Final = 12 * 3600.0

#: The most tokens of one user, whose oldest makes room, and of all.
MOST_OF_USER: Final = 16
MOST: Final = 1024


def is_token(password: bytes | None) -> bool:
    """Whether it has the form of a token, known or not."""
    return password is not None and _FORM.fullmatch(password) is not None


def since_start() -> float:
    """Seconds since the computer was started, those in which it slept too.

    The wall clock may be set back, and the monotonic clock stands still in sleep.
    """
    return time.clock_gettime(time.CLOCK_BOOTTIME)


@dataclass(frozen=True, slots=True)
class Token:
    """What is known of a token: its digest, its user, that of the hash of the user's password then,
    and its end, see `since_start`."""

    digest: str
    username: str
    password: str
    ends_at: float

    def is_of(self, stored: str | None) -> bool:
        """Whether the user's password still has the hash that it had."""
        return stored is not None and self.password == digest_of(stored.encode())


def digest_of(secret: bytes) -> str:
    """What is kept of a secret that nobody can guess."""
    return hashlib.sha256(secret).hexdigest()


class Tokens:
    """The tokens in force, and how many were issued; belongs to the event loop."""

    def __init__(self, clock: Callable[[], float] = since_start) -> None:
        self._clock = clock
        #: By their digests, the oldest first.
        self._known: dict[str, Token] = {}
        self.issued = 0

    def __len__(self) -> int:
        """How many are in force."""
        self._expire()
        return len(self._known)

    def all(self) -> list[Token]:
        """Those in force, the oldest first."""
        self._expire()
        return list(self._known.values())

    def restore(self, tokens: Iterable[Token]) -> None:
        """Have these in force again, as many as there may be, where they have not ended meanwhile.

        What would last longer than a new one is none of ours.
        """
        latest = self._clock() + LIFETIME
        for token in tokens:
            if token.ends_at <= latest:
                self._add(token)
        self._expire()

    def issue(self, username: str, stored: str) -> str | None:
        """A new token of the user, whose password has this hash; None when there are too many."""
        self._expire()
        text = PREFIX + secrets.token_urlsafe(_RANDOM)
        ends_at = self._clock() + LIFETIME
        token = Token(digest_of(text.encode()), username, digest_of(stored.encode()), ends_at)
        if not self._add(token):
            return None
        self.issued += 1
        return text

    def _add(self, token: Token) -> bool:
        own = [key for key, each in self._known.items() if each.username == token.username]
        if len(own) >= MOST_OF_USER:
            del self._known[own[0]]
        elif len(self._known) >= MOST:
            return False
        self._known[token.digest] = token
        return True

    def find(self, text: bytes) -> Token | None:
        """The token, if it is in force; its user's password may have changed since."""
        token = self._known.get(digest_of(text))
        return token if token is not None and token.ends_at > self._clock() else None

    def end(self, text: bytes) -> None:
        """End a token; does nothing if there is none."""
        self._known.pop(digest_of(text), None)

    def end_all_of(self, username: str) -> int:
        """End all tokens of a user; returns how many."""
        return self._keep(lambda token: token.username != username)

    def end_outdated(self, hash_of: Callable[[str], str | None]) -> int:
        """End those whose user is gone or has another password; returns how many."""
        return self._keep(lambda token: token.is_of(hash_of(token.username)))

    def _expire(self) -> None:
        now = self._clock()
        self._keep(lambda token: token.ends_at > now)

    def _keep(self, is_kept: Callable[[Token], bool]) -> int:
        before = len(self._known)
        self._known = {key: token for key, token in self._known.items() if is_kept(token)}
        return before - len(self._known)
