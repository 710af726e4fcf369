"""Accounts: what each user holds of the shared resources, and the user's quotas.

All anonymous clients are one user. The appliance itself has an account of its own, which has no
limits and does not reduce those of the users.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from heapq import nlargest
from typing import Protocol

from appliance.broker.limits import Limits
from appliance.broker.values import Identity
from appliance.mqtt.codec import quote
from appliance.mqtt.reason import ReasonCode

#: Empty accounts are removed when the number of accounts exceeds this.
ACCOUNTS = 64


class AccountedSession(Protocol):
    """A session, as its account knows it."""

    #: The account of its user.
    account: Account

    @property
    def client_id(self) -> str:
        """Its client id."""

    @property
    def bytes(self) -> int:
        """Its share of `Account.bytes`, without `topic_bytes`."""

    @property
    def topic_bytes(self) -> int:
        """Its share of `Account.topic_bytes`."""

    def close_link(self, reason: ReasonCode, message: str) -> None:
        """End its connection, if it has one."""


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
        "topic_bytes",
        "username",
    )

    def __init__(self, username: str | None, *, is_inside: bool = False) -> None:
        self.username = username
        self.is_inside = is_inside
        #: Its sessions whose clients are connected, in the order of connecting.
        self.present: dict[AccountedSession, None] = {}
        #: Its sessions whose clients are absent, in the order of leaving.
        self.absent: dict[AccountedSession, None] = {}
        #: Its share of `Accounting.queued_bytes`, and the part of that in output buffers.
        self.bytes = 0
        self.output = 0
        #: The part of `bytes` that are topics which the rates of subscriptions know.
        self.topic_bytes = 0
        #: Retained messages that it was the last to publish, and their bytes.
        self.retained = 0
        self.retained_bytes = 0
        #: Bytes in the store, counted for each session that a message is stored for.
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
    """How much one user may hold of a resource with the limit `whole`.

    A user may hold `sure` in any case, and more, up to `most`, as long as all users together hold
    no more than `lent`.
    """

    whole: int
    sure: int
    most: int
    lent: int

    @staticmethod
    def of(whole: int, own: int | None) -> Quota:
        """`own` is the configured limit of a user.

        If it is None, a quarter is sure, and a user may hold more while half of the whole is free,
        so that a robot with a single user can use more than that quarter.
        """
        if own is None:
            return Quota(whole, -(-whole // 4), whole, whole // 2)
        return Quota(whole, min(own, whole), own, whole)

    @property
    def own(self) -> int:
        """What a user may hold if it is the only one."""
        return max(self.sure, min(self.most, self.lent))

    def allows(self, held: int, total: int, size: int) -> bool:
        """Whether a user that holds `held` of `total` may take `size` more."""
        held += size
        total += size
        if total > self.whole:
            return False
        return held <= self.sure or (held <= self.most and total <= self.lent)

    def shortage(self, total: int, size: int, what: str, key: str, user_key: str) -> str:
        """Why `allows` returned False, as a text with the configuration key of the limit."""
        if total + size > self.whole:
            return f"there is no {what} left (broker.{key})"
        return f"its user's share of the {what} is full (broker.limits.user.{user_key})"

    def must_yield(self, most: int, held: int) -> bool:
        """Whether the largest holder loses a connection or session to a user that holds `held`."""
        return most > self.sure > held


class Accounts:
    """The accounts of users, of clients before their login, and of the appliance itself."""

    def __init__(self) -> None:
        #: The account of the appliance's own sessions, plugins included.
        self.inside = Account(None, is_inside=True)
        #: The account of clients that have not logged in.
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
        """The account of an identity; None, and a plugin's placeholder, belong to `inside`."""
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
                # The threshold doubles, so that the work per new account is constant on average.
                self._many = max(ACCOUNTS, 2 * len(self._users))
            account = self._users[username] = Account(username)
        return account

    def largest(self, held: Callable[[Account], int]) -> Account:
        """The user that holds the most; there must be at least one user."""
        return max(self._users.values(), key=held)

    def holders(self, held: Callable[[Account], int], count: int) -> list[tuple[str, int]]:
        """The `count` users that hold the most, with the amounts; without zeros."""
        found = nlargest(count, self._users.values(), held)
        return [(str(account), held(account)) for account in found if held(account)]

    # --- sessions ------------------------------------------------------------------------------

    def came(self, session: AccountedSession) -> None:
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

    def left(self, session: AccountedSession) -> None:
        """A session's client has disconnected, or was absent since the last run."""
        account = session.account
        is_new = session not in account.present
        if not is_new:
            del account.present[session]
        account.absent[session] = None
        if not account.is_inside:
            self.connections -= not is_new
            self.sessions += is_new

    def ended(self, session: AccountedSession) -> None:
        """A session ended."""
        account = session.account
        was_present, was_absent = session in account.present, session in account.absent
        account.present.pop(session, None)
        account.absent.pop(session, None)
        if not account.is_inside:
            self.connections -= was_present
            self.sessions -= was_present or was_absent

    def move(self, session: AccountedSession, account: Account) -> None:
        """Move a session to the account of its user."""
        was_present = session in session.account.present
        self.ended(session)
        session.account.bytes -= session.bytes + session.topic_bytes
        session.account.topic_bytes -= session.topic_bytes
        session.account = account
        account.bytes += session.bytes + session.topic_bytes
        account.topic_bytes += session.topic_bytes
        if was_present:
            self.came(session)
        else:
            self.left(session)

    # --- retained messages ---------------------------------------------------------------------

    def retain(self, account: Account, messages: int, size: int) -> None:
        """Count more retained messages and bytes for the account; negative: fewer."""
        account.retained += messages
        account.retained_bytes += size
        if not account.is_inside:
            self.retained += messages
            self.retained_bytes += size


class Quotas:
    """The quotas of a user under the limits in force.

    Memory, retained messages and the store cannot be taken back from a user: their quotas are upper
    limits. Connections and sessions can: their quotas are what each user is guaranteed.
    """

    __slots__ = ("connections", "memory", "retained", "retained_bytes", "sessions", "stored")

    def __init__(self, limits: Limits, memory: int, stored: int) -> None:
        """`memory` and `stored` are what all users together may use of these, in bytes."""
        user = limits.user
        self.connections = Quota.of(limits.connections, user.connections)
        self.sessions = Quota.of(limits.sessions, user.sessions)
        self.memory = Quota.of(memory, user.memory)
        self.retained = Quota.of(limits.retained_messages, user.retained_messages)
        self.retained_bytes = Quota.of(limits.retained_bytes, user.retained_bytes)
        self.stored = Quota.of(stored, user.stored)
