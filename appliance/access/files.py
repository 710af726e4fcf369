"""Access by the users file and the ACL file: passwords are checked in threads, topics at once."""

from __future__ import annotations

import asyncio
import hmac
import logging
import os
import secrets
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from appliance.access.acl import Acl
from appliance.access.hashing import HashingPool, QueueFullError
from appliance.access.passwords import Passwords
from appliance.access.problems import AccessFileError, FileProblem
from appliance.access.scram import METHOD, ScramExchange, Verifier
from appliance.access.throttle import LoginThrottle, RecentKeys
from appliance.access.token_file import TokenFile
from appliance.access.tokens import Token, Tokens, is_token
from appliance.broker.limits import Anonymous
from appliance.broker.ports import Exchange
from appliance.broker.values import Action, Decision, Identity, Refusal
from appliance.host.addresses import network_prefix
from appliance.mqtt.codec import quote
from appliance.mqtt.reason import ReasonCode

_log = logging.getLogger(__name__)

# Logins that wait for a thread, some 20 ms of CPU each. More would wait longer than clients do.
_MAX_WAITING: Final = 64

# Seconds that a login may be delayed after failures from its address: less than clients wait.
_MAX_WAIT: Final = 6.0

# Logins that are known to be wrong, some 150 bytes each, and logins that were rejected unchecked. A
# flood has many of the second kind, and the one that matters may be among them.
_MAX_KNOWN_WRONG: Final = 1024
_MAX_UNCHECKED: Final = 16_384

# Logins with a password known to be wrong whose refusals are delayed at a time.
_MAX_DELAYED_REPEATS: Final = 64

#: Failed logins a minute, from one address or of one user, that are not throttled.
FAILED_LOGINS: Final = 30

_EVERYTHING: Final = Decision(True, "no ACL file: everything is allowed")
_NO_MANAGEMENT: Final = Decision(False, "no ACL file: nobody may manage the appliance")

#: Topics of calls of the appliance itself begin so.
_CONTROL: Final = "$CONTROL/"

_NO_TOKEN: Final = Refusal(
    ReasonCode.NOT_AUTHORIZED, "its token is unknown here, has ended, or is another user's"
)
_TOO_MANY_TOKENS: Final = Refusal(
    ReasonCode.QUOTA_EXCEEDED, "too many users are signed in: no token is left"
)
_STOPPING: Final = Refusal(ReasonCode.SERVER_SHUTTING_DOWN, "the appliance is stopping")
_TOO_MANY: Final = Refusal(ReasonCode.SERVER_BUSY, "too many passwords wait to be checked")
_TRY_LATER: Final = Refusal(
    ReasonCode.SERVER_BUSY,
    "too many logins from its address were wrong, it has to come again "
    "(broker.limits.failed_logins)",
)


@dataclass(frozen=True, slots=True)
class Rules:
    """The content of both files, read and checked as a whole; not in force before `adopt`."""

    users_path: Path | None
    acl_path: Path | None
    robot: str
    anonymous: bool
    passwords: Passwords
    acl: Acl | None

    @classmethod
    def read(cls, users: Path | None, acl: Path | None, robot: str, anonymous: bool) -> Rules:
        """Read both files; AccessFileError lists all errors in either."""
        passwords, rules = Passwords(Path()), None
        problems: list[FileProblem] = []
        if users is not None:
            try:
                passwords = Passwords.load(users)
            except AccessFileError as error:
                problems += error.problems
        if acl is not None:
            try:
                rules = Acl.load(acl, robot)
            except AccessFileError as error:
                problems += error.problems
        if problems:
            raise AccessFileError(problems)
        return cls(users, acl, robot, anonymous, passwords, rules)

    @property
    def files(self) -> frozenset[Path]:
        """The files that were read, included ones too."""
        named = {path for path in (self.users_path, self.acl_path) if path is not None}
        return frozenset(named) | (self.acl.files if self.acl else frozenset())


@dataclass(frozen=True, slots=True)
class Changes:
    """What a reload has changed; users by name, sorted."""

    users_added: list[str]
    users_removed: list[str]
    passwords_changed: list[str]
    rules_changed: bool

    @classmethod
    def between(cls, before: Rules, after: Rules) -> Changes:
        """The differences between two states of the files."""
        old, new = before.passwords, after.passwords
        known, now = set(old.users()), set(new.users())
        return cls(
            sorted(now - known),
            sorted(known - now),
            sorted(name for name in known & now if old.hash_of(name) != new.hash_of(name)),
            (before.acl.rules if before.acl else None) != (after.acl.rules if after.acl else None),
        )


class FileAccess:
    """The `Access` port on a users file and an ACL file; all methods belong to the event loop.

    Passwords are checked in threads. A verified login is cached until the user's hash changes, as
    an HMAC under a key of this process: when all clients reconnect at once nothing is hashed again,
    however many users there are, and nobody who guesses delays them.

    Other logins are guesses until they are checked, see `LoginThrottle`. When the next guess of an
    address would wait too long, it is answered with 0x89 Server busy, and nothing is hashed. A
    login that comes again with the same password waits in a queue of its own, because a guesser
    tries other passwords. A password that is known to be wrong is not a guess when it comes again,
    but a device with a wrong configuration: it delays nobody else, and is not hashed again.
    """

    def __init__(
        self,
        users: Path | None,
        acl: Path | None,
        robot: str,
        anonymous: bool = False,
        max_waiting: int = _MAX_WAITING,
        failed_logins: int = FAILED_LOGINS,
        max_wait: float = _MAX_WAIT,
    ) -> None:
        """Read both files; AccessFileError lists all errors in either.

        Without a users file no user has a password here. Without an ACL file every client may do
        everything, as in mosquitto. `failed_logins` a minute of an address, or of a user, are not
        throttled; a login that would wait for more than `max_wait` seconds is rejected.
        """
        self.epoch = 0
        self._in_force = rules = Rules.read(users, acl, robot, anonymous)
        self._passwords, self._acl = rules.passwords, rules.acl
        if acl is None:
            _log.warning("no ACL file: whoever is let in may read and write every topic")
        self._key = secrets.token_bytes(32)
        #: By user name: the login that was verified, and against which hash.
        self._verified: dict[str, tuple[bytes, str]] = {}
        self._known_wrong = RecentKeys(_MAX_KNOWN_WRONG)
        self._unchecked = RecentKeys(_MAX_UNCHECKED)
        self._delayed_repeats = 0
        #: Checks in progress, by address and login.
        self._checking: dict[tuple[bytes, bytes], asyncio.Task[str | Refusal | None]] = {}
        self._closed = False
        self._max_wait = max_wait
        self.throttle = LoginThrottle(failed_logins)
        self.tokens = Tokens()
        self._token_file: TokenFile | None = None
        # Of two cores one is left to the event loop.
        workers = min(2, max(1, (os.cpu_count() or 1) // 2))
        self._hashing: HashingPool[str | None] = HashingPool(workers, max_waiting)

    @property
    def in_force(self) -> Rules:
        """The content of both files that is in force."""
        return self._in_force

    def reload(self) -> Changes:
        """Read both files again; on AccessFileError nothing changes."""
        before = self._in_force
        return self.adopt(
            Rules.read(before.users_path, before.acl_path, before.robot, before.anonymous)
        )

    def adopt(self, rules: Rules) -> Changes:
        """Put files that were read into force; returns the changes. It does not fail."""
        before, self._in_force = self._in_force, rules
        self._passwords, self._acl = rules.passwords, rules.acl
        self._checking.clear()  # They check the old hashes: nobody may join them now.
        self._known_wrong.clear()
        self._verified = {
            username: (login, stored)
            for username, (login, stored) in self._verified.items()
            if stored == self._passwords.hash_of(username)
        }
        ended = self.tokens.end_outdated(self._passwords.hash_of)
        if ended:
            _log.info(
                "%d tokens of users with another password, or removed ones, have ended", ended
            )
            self._save_tokens()
        self.epoch += 1
        return Changes.between(before, rules)

    def close(self) -> None:
        """Stop the threads; logins that wait are refused. May be called twice."""
        self._closed = True
        self._hashing.close()  # A hash takes some 20 ms.
        if self._token_file is not None:
            self._token_file.close()

    def users(self) -> list[str]:
        """The names of all users, sorted."""
        return self._passwords.users()

    def knows(self, username: str | None) -> bool:
        """Whether the users file has a line for this user."""
        return username is not None and self._passwords.hash_of(username) is not None

    def exchange(self, method: str, address: str, again: str | None = None) -> Exchange | None:
        """Begin an enhanced authentication; None when the method is not offered.

        SCRAM-SHA-256 is offered where there is a users file. Each step uses the users that are in
        force then, so a reload between two steps is noticed.

        It counts as a guess from the address. `again` is the user of a client that has logged in
        and authenticates again: others' guesses must not throw it out, and it can guess nobody's
        password but its own.
        """
        if method != METHOD or self._in_force.users_path is None:
            return None

        def verifier_of(username: str) -> Verifier:
            return self._passwords.verifier(username)

        if again is not None:
            return ScramExchange(verifier_of, only=again)
        throttle = self.throttle
        return ScramExchange(
            verifier_of,
            admits=lambda: throttle.reserve(address, METHOD, max_wait=0.0) is not None,
            failed=lambda username: throttle.record_failure(address, username),
        )

    def decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        """Whether the rules in force let the client do this; see `Acl.decide`."""
        if self._acl is None:
            is_call = action is Action.PUBLISH and topic.startswith(_CONTROL)
            return _NO_MANAGEMENT if is_call else _EVERYTHING
        return self._acl.decide(identity, action, topic)

    @property
    def acl(self) -> Acl | None:
        """The rules in force; None without an ACL file."""
        return self._acl

    async def authenticate(
        self,
        username: str | None,
        password: bytes | None,
        client_id: str,
        address: str,
        anonymous: Anonymous = None,
    ) -> Identity | Refusal:
        """Who the client is, or why it is refused; `address` matters for the throttle only.

        `anonymous` is whether its listener admits clients without a user name, None where it does
        not say.
        """
        if username is None:
            if self._in_force.anonymous if anonymous is None else anonymous:
                return Identity(None, client_id)
            return Refusal(ReasonCode.NOT_AUTHORIZED, "no user name, and anonymous is off")
        if password is None:
            return Refusal(ReasonCode.NOT_AUTHORIZED, f"no password for user {quote(username)}")
        login = self._login(username, password)
        while True:
            passwords = self._passwords
            stored = passwords.hash_of(username)
            if stored is not None and self._verified.get(username) == (login, stored):
                return Identity(username, client_id)
            if self._closed:
                return _STOPPING
            if login in self._known_wrong:
                await self._delay_repeat(address, username)
                right: str | Refusal | None = None
            else:
                where = network_prefix(address)
                check = self._checking.get((where, login))
                if check is None:
                    turn = self._reserve(address, login)
                    if turn is None:
                        return _TRY_LATER
                    check = self._begin_check((where, login), address, username, password, turn)
                # Not awaited directly: a client that leaves must not cancel the check for others.
                await asyncio.wait([check])
                if check.cancelled():
                    return _STOPPING
                right = check.result()
            if isinstance(right, Refusal):
                return right
            if right is not None and right == self._passwords.hash_of(username):
                self._verified[username] = login, right
            if self._passwords is not passwords:
                continue  # Reloaded meanwhile: the result is about the old users.
            if right is not None:
                return Identity(username, client_id)
            what = "unknown user" if stored is None else "wrong password for user"
            return Refusal(ReasonCode.NOT_AUTHORIZED, f"{what} {quote(username)}")

    def by_token(self, username: str | None, token: bytes, client_id: str) -> Identity | Refusal:
        """Who the client is by its token, see `is_token`; the user name may be left out."""
        found = self._valid(token)
        if found is None or username not in (None, found.username):
            return _NO_TOKEN
        return Identity(found.username, client_id)

    def _valid(self, token: bytes) -> Token | None:
        found = self.tokens.find(token)
        if found is not None and found.is_of(self._passwords.hash_of(found.username)):
            return found
        return None

    def keep_tokens(self, file: TokenFile) -> None:
        """Have the tokens of the file in force, of users whose password is the same, and save
        there those that are in force from now on."""
        self.tokens.restore(file.read())
        self.tokens.end_outdated(self._passwords.hash_of)
        self._token_file = file

    async def _tokens_saved(self) -> None:
        """Save the tokens, and return when a restart finds them as they are now."""
        saving = self._save_tokens()
        if saving is not None:
            # A caller that gives up must not take it back.
            await asyncio.shield(asyncio.wrap_future(saving))

    def _save_tokens(self) -> Future[None] | None:
        file = None if self._closed else self._token_file
        return None if file is None else file.save(self.tokens.all())

    async def issue_token(self, username: str, password: bytes, address: str) -> str | Refusal:
        """A token of the user for its password, which is checked as at a login.

        For a token there is none: no token would ever end.
        """
        if is_token(password):
            return _NO_TOKEN
        who = await self.authenticate(username, password, "", address)
        if isinstance(who, Refusal):
            return who
        stored = self._passwords.hash_of(username)
        assert stored is not None  # `authenticate` has just found it
        issued = self.tokens.issue(username, stored)
        if issued is None:
            return _TOO_MANY_TOKENS
        await self._tokens_saved()
        return issued

    async def end_token(self, username: str, token: bytes) -> bool:
        """End a token of this user; returns whether there was one."""
        found = self.tokens.find(token)
        if found is None or found.username != username:
            return False
        self.tokens.end(token)
        await self._tokens_saved()
        return True

    async def end_tokens(self, username: str) -> int:
        """End all tokens of this user; returns how many."""
        ended = self.tokens.end_all_of(username)
        if ended:
            await self._tokens_saved()
        return ended

    def _reserve(self, address: str, login: bytes) -> float | None:
        """Reserve a check for the login; returns the seconds until then, None when too many."""
        again = "again" if login in self._unchecked else ""
        turn = self.throttle.reserve(address, again, self._max_wait)
        if turn is None:
            self._unchecked.add(login)
        return turn

    def _begin_check(
        self,
        key: tuple[bytes, bytes],
        address: str,
        username: str,
        password: bytes,
        turn: float,
    ) -> asyncio.Task[str | Refusal | None]:
        check = asyncio.get_running_loop().create_task(
            self._check(key, address, username, password, turn)
        )
        self._checking[key] = check

        def forget(check: asyncio.Task[str | Refusal | None]) -> None:
            if self._checking.get(key) is check:
                del self._checking[key]

        check.add_done_callback(forget)
        return check

    async def _check(
        self, key: tuple[bytes, bytes], address: str, username: str, password: bytes, turn: float
    ) -> str | Refusal | None:
        """Check the password after the delay; returns the hash that it matches, None for none."""
        queue, login = key
        delay = max(turn, self.throttle.user_delay(username))
        if delay:
            await asyncio.sleep(delay)
        passwords = self._passwords
        try:
            right = await self._hashing.run(
                queue, partial(passwords.verified_hash, username, password)
            )
        except QueueFullError:
            self._unchecked.add(login)
            return _TOO_MANY
        if right is None:
            self.throttle.record_failure(address, username)
            if self._passwords is passwords:
                self._known_wrong.add(login)
        return right

    async def _delay_repeat(self, address: str, username: str) -> None:
        """Delay the answer to a login that is known to be wrong, as long as that to a guess."""
        if self._delayed_repeats >= _MAX_DELAYED_REPEATS:
            return
        delay = max(self.throttle.user_delay(username), self.throttle.address_delay(address))
        if delay:
            self._delayed_repeats += 1
            try:
                await asyncio.sleep(delay)
            finally:
                self._delayed_repeats -= 1

    def _login(self, username: str, password: bytes) -> bytes:
        name = username.encode()
        return hmac.digest(self._key, len(name).to_bytes(4, "big") + name + password, "sha256")
