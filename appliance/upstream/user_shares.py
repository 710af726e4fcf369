"""What each user has of something that all users of a link share: no user takes it from others."""

from __future__ import annotations

from typing import Final

#: The part of the whole that a user has in any case, as of what the broker itself limits
#: (docs/security.md): only who has more has to yield. And the part up to which all may take more.
SHARE: Final = 1 / 4
LENT: Final = 1 / 2


class UserShares:
    """Bytes of `whole`, by user.

    None is for what is of no user: of the appliance itself, or from before the last start. It has
    no share, and never has to yield.
    """

    def __init__(self, whole: int) -> None:
        self._whole = whole
        self._held: dict[str, int] = {}
        #: Who has more than a share.
        self._over: set[str] = set()

    def resize(self, whole: int) -> None:
        """All share this from now on."""
        self._whole = whole
        self._over = {user for user, held in self._held.items() if held > SHARE * whole}

    def count(self, user: str | None, size: int) -> None:
        """The user has so many bytes more; negative: fewer."""
        if user is None:
            return
        held = self._held.get(user, 0) + size
        if held:
            self._held[user] = held
        else:
            del self._held[user]
        if held > SHARE * self._whole:
            self._over.add(user)
        else:
            self._over.discard(user)

    def allows(self, user: str | None, size: int, total: int) -> bool:
        """Whether the user may have so many bytes more, with which all have `total`."""
        if total > self._whole:
            return False
        own = 0 if user is None else self._held.get(user, 0) + size
        return own <= SHARE * self._whole or total <= LENT * self._whole

    def largest(self) -> list[str]:
        """Who has more than a share, the one with the most first: three at most."""
        return sorted(self._over, key=self._held.__getitem__, reverse=True) if self._over else []
