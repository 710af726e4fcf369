"""Enrolments: one-time codes, each of which sets the password of one user once.

Whoever manages users begins one and shows the code, as a QR code, to the person whose phone it is.
That person chooses the password, which so nobody else learns. A code has no right of its own: it
does what the one who has begun it may do when it is used. As a token it ends with another password
or the removal of its user, and of the one who has begun it; and with the revocation of any
certificate, as who has begun it may have logged in by that one. Codes are in memory only, as HMACs
under a key of this process, so that neither the memory nor the time of a look-up tells one.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, TypeAlias

from appliance.access.tokens import since_start
from appliance.broker.values import Identity

#: Seconds for which a code can be used.
LIFETIME: Final = 600.0

#: The most codes of all users, of whom each has one at most; and the most that one has begun.
MOST: Final = 64
MOST_OF_MAKER: Final = 16

#: Random bytes of a code.
_RANDOM: Final = 24

#: The hash of a user's password; None for a user that is not in the users file.
HashOf: TypeAlias = Callable[[str], "str | None"]

_Stored: TypeAlias = "tuple[str | None, str | None]"


@dataclass(frozen=True, slots=True)
class Enrolment:
    """Whose password is set, and who has begun it, None for the control socket.

    `groups` are those of a user that is made with it; None for one that is there. With
    `with_certificate` its phone gets a key and certificate of its own as well.
    """

    username: str
    groups: tuple[str, ...] | None
    with_certificate: bool
    by: Identity | None
    ends_at: float
    #: The hashes of the passwords of both then, see `Enrolments._stored`.
    stored: _Stored
    #: `Enrolments.revocations` then.
    revocations: int


class Enrolments:
    """The codes that can be used now; belongs to the event loop."""

    def __init__(self, hash_of: HashOf, clock: Callable[[], float] = since_start) -> None:
        self._hash_of = hash_of
        self._clock = clock
        self._key = secrets.token_bytes(32)
        self._pending: dict[bytes, Enrolment] = {}
        #: How often certificates were revoked; codes of before are ended.
        self.revocations = 0

    def begin(
        self,
        username: str,
        groups: tuple[str, ...] | None,
        by: Identity | None,
        with_certificate: bool = False,
    ) -> str | None:
        """A new code in the place of an earlier one of this user; None when there are too many, of
        all or of those that `by` has begun."""
        now = self._clock()
        pending = {
            key: each
            for key, each in self._pending.items()
            if each.ends_at > now and each.username != username
        }
        if len(pending) >= MOST or (by is not None and _begun(pending, by) >= MOST_OF_MAKER):
            return None
        self._pending = pending
        code = secrets.token_urlsafe(_RANDOM)
        stored = self._stored(username, groups, by)
        self._pending[self._digest(code)] = Enrolment(
            username, groups, with_certificate, by, now + LIFETIME, stored, self.revocations
        )
        return code

    def take(self, code: str) -> Enrolment | None:
        """What the code is for; nobody finds it again. None for a code that is unknown or ended."""
        found = self._pending.pop(self._digest(code), None)
        if found is None or found.ends_at <= self._clock():
            return None
        stored = self._stored(found.username, found.groups, found.by)
        return found if found.stored == stored else None

    def put_back(self, code: str, enrolment: Enrolment) -> None:
        """Let the code be used, as nothing came of it; unless there is a later one of this user, or
        it was to end meanwhile."""
        is_ended = enrolment.by is not None and enrolment.revocations != self.revocations
        if not is_ended and all(
            each.username != enrolment.username for each in self._pending.values()
        ):
            self._pending[self._digest(code)] = enrolment

    def end_others(self) -> None:
        """End all codes but those that were begun on this computer: certificates were revoked."""
        self.revocations += 1
        self._pending = {key: each for key, each in self._pending.items() if each.by is None}

    def _digest(self, code: str) -> bytes:
        return hmac.digest(self._key, code.encode(), "sha256")

    def _stored(
        self, username: str, groups: tuple[str, ...] | None, by: Identity | None
    ) -> _Stored:
        """The hash of the user, if it is there already, and of the one who begins the enrolment."""
        maker = None if by is None else by.username
        return (
            self._hash_of(username) if groups is None else None,
            self._hash_of(maker) if maker is not None else None,
        )


def _begun(pending: Mapping[bytes, Enrolment], by: Identity) -> int:
    """How many of these the user has begun."""
    return sum(each.by is not None and each.by.username == by.username for each in pending.values())
