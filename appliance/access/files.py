"""Access by the users file and the ACL file: logins off the event loop, decisions on it."""

from __future__ import annotations

import asyncio
import hmac
import logging
import os
import secrets
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from appliance.broker.ports import Action, Decision, Exchange, Identity, Refusal
from appliance.mqtt.codec import quote
from appliance.mqtt.reason import ReasonCode

from .acl import Acl
from .passwords import Passwords
from .problems import AccessFileError, Problem
from .scram import METHOD, ScramExchange

_log = logging.getLogger(__name__)

# Logins that wait for a worker. More would wait longer than clients do, some 20 ms of CPU each.
_MAX_WAITING: Final = 64

_EVERYTHING: Final = Decision(True, "no ACL file: everything is allowed")


class FileAccess:
    """The `Access` port on a users file and an ACL file; all methods are the event loop's.

    Passwords are checked by threads of its own. The password that was right for a user is
    remembered, as an HMAC under a key that only this process has ever had, until the user's hash
    changes: when all clients come back at once, nothing is hashed again, however many users.
    """

    def __init__(
        self,
        users: Path | None,
        acl: Path | None,
        robot: str,
        anonymous: bool = False,
        max_waiting: int = _MAX_WAITING,
    ) -> None:
        """Reads both files; AccessFileError names all that is wrong with either.

        Without a users file nobody has a password here. Without an ACL file whoever came in may
        do everything, as in mosquitto.
        """
        self.epoch = 0
        self._users_path = users
        self._acl_path = acl
        self._robot = robot
        self._anonymous = anonymous
        self._passwords, self._acl = self._load()
        if acl is None:
            _log.warning("no ACL file: whoever is let in may read and write every topic")
        self._key = secrets.token_bytes(32)
        #: By user name: the login that was right, and the hash that it was right for.
        self._remembered: dict[str, tuple[bytes, str]] = {}
        self._checking: dict[bytes, asyncio.Future[str | None]] = {}
        self._busy = 0
        self._closed = False
        # One of two cores stays with the event loop.
        workers = min(2, max(1, (os.cpu_count() or 1) // 2))
        self._max_checking = workers + max_waiting
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="password")

    def reload(self) -> None:
        """Reads both files again. AccessFileError leaves what was in force in force."""
        self._passwords, self._acl = self._load()
        self._checking.clear()  # They are about the old hashes, and are not joined any more.
        self._remembered = {
            username: (login, stored)
            for username, (login, stored) in self._remembered.items()
            if stored == self._passwords.hash_of(username)
        }
        self.epoch += 1

    def close(self) -> None:
        """Stops the threads; logins that wait are refused. May be called twice."""
        self._closed = True
        self._pool.shutdown(wait=True, cancel_futures=True)  # A hash takes some 20 ms.

    def users(self) -> list[str]:
        """The names of all users, sorted."""
        return self._passwords.users()

    def exchange(self, method: str) -> Exchange | None:
        """Begins an enhanced authentication; None when the method is not offered.

        SCRAM-SHA-256 is, where there is a users file. The exchange knows the users as they are at
        each of its steps, a reload between them included. amqtt's plugins are not asked: they
        judge a user name and a password, and here is no password to show them.
        """
        if method != METHOD or self._users_path is None:
            return None
        return ScramExchange(lambda username: self._passwords.verifier(username))

    def decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        """Whether the rules in force let the client do this; see `Acl.decide`."""
        if self._acl is None:
            return _EVERYTHING
        return self._acl.decide(identity, action, topic)

    async def authenticate(
        self, username: str | None, password: bytes | None, client_id: str, address: str
    ) -> Identity | Refusal:
        """Who the client is, or why it is refused. `address` makes no difference here."""
        if username is None:
            if self._anonymous:
                return Identity(None, client_id)
            return Refusal(ReasonCode.NOT_AUTHORIZED, "no user name, and anonymous is off")
        if password is None:
            return Refusal(ReasonCode.NOT_AUTHORIZED, f"no password for user {quote(username)}")
        login = self._login(username, password)
        while True:
            passwords = self._passwords
            stored = passwords.hash_of(username)
            if stored is not None and self._remembered.get(username) == (login, stored):
                return Identity(username, client_id)
            check = self._checking.get(login) or self._check(login, username, password)
            if check is None:
                if self._closed:
                    return Refusal(ReasonCode.SERVER_SHUTTING_DOWN, "the appliance is stopping")
                return Refusal(ReasonCode.SERVER_BUSY, "too many passwords wait to be checked")
            # Not the check itself is awaited: one that leaves must not cancel it for others.
            await asyncio.wait([check])
            if check.cancelled():
                return Refusal(ReasonCode.SERVER_SHUTTING_DOWN, "the appliance is stopping")
            right = check.result()
            if right is not None and right == self._passwords.hash_of(username):
                self._remembered[username] = login, right
            if self._passwords is not passwords:
                continue  # Reloaded meanwhile: what was found is about a user of before.
            if right is not None:
                return Identity(username, client_id)
            what = "unknown user" if stored is None else "wrong password for user"
            return Refusal(ReasonCode.NOT_AUTHORIZED, f"{what} {quote(username)}")

    def _check(
        self, login: bytes, username: str, password: bytes
    ) -> asyncio.Future[str | None] | None:
        """Has a thread check the password; None when too many wait already, or after `close`."""
        if self._closed or self._busy >= self._max_checking:
            return None
        loop = asyncio.get_running_loop()
        verify = self._passwords.verified_hash
        check = loop.run_in_executor(self._pool, verify, username, password)
        self._busy += 1
        self._checking[login] = check
        check.add_done_callback(lambda check: self._checked(login, check))
        return check

    def _checked(self, login: bytes, check: asyncio.Future[str | None]) -> None:
        self._busy -= 1
        if self._checking.get(login) is check:
            del self._checking[login]

    def _login(self, username: str, password: bytes) -> bytes:
        name = username.encode()
        return hmac.digest(self._key, len(name).to_bytes(4, "big") + name + password, "sha256")

    def _load(self) -> tuple[Passwords, Acl | None]:
        passwords, acl = Passwords(Path()), None
        problems: list[Problem] = []
        if self._users_path is not None:
            try:
                passwords = Passwords.load(self._users_path)
            except AccessFileError as error:
                problems += error.problems
        if self._acl_path is not None:
            try:
                acl = Acl.load(self._acl_path, self._robot)
            except AccessFileError as error:
                problems += error.problems
        if problems:
            raise AccessFileError(problems)
        return passwords, acl
