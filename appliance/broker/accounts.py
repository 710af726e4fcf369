"""What each user holds of what all clients share, and how much that may be.

All anonymous clients are one user. What the appliance itself holds is in an account of its own,
which has no limits and takes nothing from those of the users.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from heapq import nlargest
from typing import TYPE_CHECKING

from appliance.broker.ports import Identity, Limits
from appliance.mqtt.codec import quote

if TYPE_CHECKING:
    from appliance.broker.session import Session

#: Accounts that there are before those are looked for that hold nothing any more.
ACCOUNTS = 64


class Account:
    """What one user holds."""

    __slots__ = (
        "absent",
        "bytes",
        "is_inside",
        "output",
        "present",
        "retained",
        "retained_bytes",
        "stored",
        "username",
    )

    def __init__(self, username: str | None, *, is_inside: bool = False) -> None:
        self.username = username
        self.is_inside = is_inside
        #: Its sessions whose clients are connected, in the order of their coming.
        self.present: dict[Session, None] = {}
        #: And those whose clients are not, in the order of their leaving.
        self.absent: dict[Session, None] = {}
        #: Its part of `Accounting.queued_bytes`, and of that what waits in the network.
        self.bytes = 0
        self.output = 0
        #: Retained messages that it was the last to publish, and their bytes.
        self.retained = 0
        self.retained_bytes = 0
        #: Bytes in the store, once for each session that a message is owed to.
        self.stored = 0

    def __str__(self) -> str:
        if self.is_inside:
            return "the appliance"
        return "the anonymous user" if self.username is None else f"user {quote(self.username)}"

    @property
    def connections(self) -> int:
        """Clients that are connected."""
        return len(self.present)

    @property
    def sessions(self) -> int:
        """Sessions, of connected clients and absent ones."""
        return len(self.present) + len(self.absent)

    @property
    def is_empty(self) -> bool:
        """Whether it holds nothing."""
        return not (self.present or self.absent or self.bytes or self.retained or self.stored)


@dataclass(frozen=True, slots=True)
class Quota:
    """How much one user may hold of the `whole`.

    It may hold what is `sure`, and more up to `most` as long as all together hold no more than is
    `lent`.
    """

    whole: int
    sure: int
    most: int
    lent: int

    @staticmethod
    def of(whole: int, own: int | None) -> Quota:
        """`own` is what the configuration says of a user.

        None: a quarter is sure, and while half of the whole is free a user may have more, so that
        a robot with a single user does without three quarters of nothing.
        """
        if own is None:
            return Quota(whole, -(-whole // 4), whole, whole // 2)
        return Quota(whole, min(own, whole), own, whole)

    @property
    def own(self) -> int:
        """What a user may hold when it is alone."""
        return max(self.sure, min(self.most, self.lent))

    def allows(self, held: int, total: int, size: int) -> bool:
        """Whether who holds so much of the total may have `size` more."""
        held += size
        total += size
        if total > self.whole:
            return False
        return held <= self.sure or (held <= self.most and total <= self.lent)

    def shortage(self, total: int, size: int, what: str, key: str, user_key: str) -> str:
        """Why `allows` says no to `size` more, in words: the keys say how much there is of it."""
        if total + size > self.whole:
            return f"there is no {what} left (broker.{key})"
        return f"its user's share of the {what} is full (broker.limits.user.{user_key})"

    def must_yield(self, most: int, held: int) -> bool:
        """Whether who holds `most` of what can be taken back gives one to who holds so many."""
        return most > self.sure > held


class Accounts:
    """The accounts of all users that hold anything, of those before their login, and our own."""

    def __init__(self) -> None:
        #: What parts of the appliance hold, plugins among them.
        self.inside = Account(None, is_inside=True)
        #: Clients that have not logged in: nobody knows yet whose they are.
        self.strangers = Account("(before the login)")
        #: Of all users.
        self.connections = 0
        self.sessions = 0
        self.retained = 0
        self.retained_bytes = 0
        self._users: dict[str | None, Account] = {}
        self._many = ACCOUNTS

    def __len__(self) -> int:
        return len(self._users)

    def of(self, identity: Identity | None) -> Account:
        """The account of who this is; None, and who nobody has logged in as yet, is inside."""
        if identity is None or type(identity) is not Identity:
            return self.inside
        return self.of_user(identity.username)

    def of_user(self, username: str | None) -> Account:
        """A user's account; None is for anonymous clients."""
        account = self._users.get(username)
        if account is None:
            if len(self._users) >= self._many:
                self._users = {
                    name: each for name, each in self._users.items() if not each.is_empty
                }
                # Each is looked at once for every two that come: the work stays in proportion.
                self._many = max(ACCOUNTS, 2 * len(self._users))
            account = self._users[username] = Account(username)
        return account

    def largest(self, held: Callable[[Account], int]) -> Account:
        """The user who holds most of something; there is at least one user."""
        return max(self._users.values(), key=held)

    def holders(self, held: Callable[[Account], int], count: int) -> list[tuple[str, int]]:
        """The `count` users who hold most of something, and how much that is; no zeros."""
        found = nlargest(count, self._users.values(), held)
        return [(str(account), held(account)) for account in found if held(account)]

    # --- sessions ------------------------------------------------------------------------------

    def came(self, session: Session) -> None:
        """A session's client has connected; the session may be new."""
        account = session.account
        is_new = session not in account.absent
        account.absent.pop(session, None)
        if session in account.present:  # it took over from itself
            return
        account.present[session] = None
        if not account.is_inside:
            self.connections += 1
            self.sessions += is_new

    def left(self, session: Session) -> None:
        """A session's client is gone, or has not come since the last run."""
        account = session.account
        is_new = session not in account.present
        if not is_new:
            del account.present[session]
        account.absent[session] = None
        if not account.is_inside:
            self.connections -= not is_new
            self.sessions += is_new

    def ended(self, session: Session) -> None:
        """A session is over."""
        account = session.account
        was_present, was_absent = session in account.present, session in account.absent
        account.present.pop(session, None)
        account.absent.pop(session, None)
        if not account.is_inside:
            self.connections -= was_present
            self.sessions -= was_present or was_absent

    def move(self, session: Session, account: Account) -> None:
        """A session has found its user."""
        was_present = session in session.account.present
        self.ended(session)
        session.account.bytes -= session.bytes
        session.account = account
        account.bytes += session.bytes
        if was_present:
            self.came(session)
        else:
            self.left(session)

    # --- retained messages ---------------------------------------------------------------------

    def retain(self, account: Account, messages: int, size: int) -> None:
        """So many retained messages and bytes more, or less, are the account's."""
        account.retained += messages
        account.retained_bytes += size
        if not account.is_inside:
            self.retained += messages
            self.retained_bytes += size


class Quotas:
    """What a user may hold, out of the limits in force: of what cannot be taken back no more than
    this, and of connections and sessions that much at any rate."""

    __slots__ = ("connections", "memory", "retained", "retained_bytes", "sessions", "stored")

    def __init__(self, limits: Limits, memory: int, stored: int) -> None:
        """`memory` and `stored` are what users may use of those in all, in bytes."""
        user = limits.user
        self.connections = Quota.of(limits.connections, user.connections)
        self.sessions = Quota.of(limits.sessions, user.sessions)
        self.memory = Quota.of(memory, user.memory)
        self.retained = Quota.of(limits.retained_messages, user.retained_messages)
        self.retained_bytes = Quota.of(limits.retained_bytes, user.retained_bytes)
        self.stored = Quota.of(stored, user.stored)
