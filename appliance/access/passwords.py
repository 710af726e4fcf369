"""The users file: one `user:hash` a line, as in mosquitto's password file."""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import logging
import os
import re
import stat
import threading
import unicodedata
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

import argon2
from argon2.exceptions import InvalidHashError, VerificationError

from appliance.access import scram
from appliance.access.problems import AccessFileError, FileProblem, read_text
from appliance.access.rewriting import locked, replacing
from appliance.access.tokens import is_token

_log = logging.getLogger(__name__)

# OWASP's parameters for argon2id (Password Storage Cheat Sheet): a robot's computer is small, and
# each password that is being hashed takes this memory.
_MEMORY_KIB: Final = 19 * 1024
_PASSES: Final = 2
_LANES: Final = 1
_HASHER: Final = argon2.PasswordHasher(_PASSES, _MEMORY_KIB, _LANES)

# Checked for an unknown user, so that it takes as long as a known one. No known password hashes to
# 32 zero bytes.
_DECOY: Final = (
    f"$argon2id$v=19$m={_MEMORY_KIB},t={_PASSES},p={_LANES}$" + "A" * 22 + "$" + "A" * 43
)

# Limits on the cost of a stored hash: a typing error in the file could otherwise make one login
# take all memory, or minutes, so that nobody could reach the robot.
_MAX_MEMORY_KIB: Final = 1024 * 1024
_MAX_PASSES: Final = 64
_MAX_LANES: Final = 16
_MAX_ITERATIONS: Final = 10_000_000

_ARGON2ID: Final = re.compile(
    r"\$argon2id\$v=19\$m=(\d{1,9}),t=(\d{1,9}),p=(\d{1,9})"
    r"\$[A-Za-z0-9+/]{11,}\$[A-Za-z0-9+/]{16,}"
)
_SHA512_SIZE: Final = 64
_SCRAM: Final = f"{scram.METHOD}$"
_KINDS: Final = {
    "$argon2id$": "argon2id",
    _SCRAM: scram.METHOD,
    "$7$": "PBKDF2-SHA512",
    "$6$": "SHA-512",
}


def check_username(username: str) -> None:
    """Raise a ValueError that says why `username` cannot be in the users file."""
    if not username:
        raise ValueError("a user name must not be empty")
    scram.check_length(username)
    if ":" in username:
        raise ValueError("a user name must not hold ':', which ends it in the users file")
    if username[0] == "#":
        raise ValueError("a user name must not begin with '#', which begins a comment")
    if username[0] == "\ufeff":
        raise ValueError("a user name must not begin with a byte order mark, which nobody sees")
    if username != username.strip():
        raise ValueError("a user name must not begin or end with a space")
    if any(unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") for c in username):
        raise ValueError("a user name must not hold control characters or line ends")


def check_password(stored: str, password: bytes) -> bool:
    """Whether `password` matches `stored`, a hash of any supported kind."""
    if stored.startswith("$argon2id$"):
        try:
            return _HASHER.verify(stored, password)
        except (VerificationError, InvalidHashError):
            return False
    if stored.startswith(_SCRAM):
        return scram.Verifier.decode(stored).check(password)
    if stored.startswith("$7$"):
        _, _, iterations, salt, digest = stored.split("$")
        made = hashlib.pbkdf2_hmac("sha512", password, base64.b64decode(salt), int(iterations))
    else:
        _, _, salt, digest = stored.split("$")
        made = hashlib.sha512(password + base64.b64decode(salt)).digest()
    return hmac.compare_digest(made, base64.b64decode(digest))


class Passwords:
    """The users and their password hashes, as read from a users file and changed since.

    `set` and `remove` change the memory. `save` applies these changes, and no others, to the file,
    so that what another process has written meanwhile is preserved. Any thread may verify.
    """

    def __init__(self, path: Path) -> None:
        """Create it without users; the file at `path` is neither read nor written."""
        self.path = path
        self._hashes: dict[str, str] = {}
        self._changes: dict[str, str | None] = {}
        self._verifiers: dict[str, scram.Verifier] = {}
        # Iterations and salt sizes of the verifiers, for decoys that look like them.
        self._shapes: set[tuple[int, int]] = set()
        self._rehashing = threading.Lock()

    @classmethod
    def load(cls, path: Path) -> Passwords:
        """Load the file at `path`; AccessFileError lists every line with an error."""
        self = cls(path)
        text = read_text(path, "add a first user with: appliance user add NAME")
        self._hashes = _parse(path, text)
        self._read_verifiers()
        with suppress(OSError):
            if path.stat().st_mode & 0o007:
                _log.warning(
                    "%s is open to every user of this computer; close it with: chmod o= %s",
                    path,
                    path,
                )
        return self

    def users(self) -> list[str]:
        """The names of all users, sorted."""
        return sorted(self._hashes)

    def first(self) -> str | None:
        """The user of the first line, whom `init` has made; None when there is none."""
        return next(iter(self._hashes), None)

    def hash_of(self, username: str) -> str | None:
        """The hash of a user's password; None when there is no such user."""
        return self._hashes.get(username)

    def kind_of(self, username: str) -> str:
        """The kind of a user's hash, in a word; KeyError when there is no such user."""
        stored = self._hashes[username]
        return next(kind for start, kind in _KINDS.items() if stored.startswith(start))

    def verifier(self, username: str) -> scram.Verifier:
        """The SCRAM-SHA-256 verifier of a user.

        For an unknown user, and for one with another kind of hash, it is a decoy that cannot be
        distinguished from a real one, and that no proof fits.
        """
        reason = f"unknown user {username!r}"
        if username in self._hashes:
            reason = (
                f"the password of user {username!r} is not stored for {scram.METHOD}; set it with: "
                f"appliance user passwd {username} --scram"
            )
        # Made for everyone, so that the time does not reveal who is a user.
        decoy = scram.decoy(username, self._shapes, reason)
        return self._verifiers.get(username, decoy)

    def verify(self, username: str, password: bytes) -> bool:
        """Whether this is a user and its password; see `verified_hash`."""
        return self.verified_hash(username, password) is not None

    def verified_hash(self, username: str, password: bytes) -> str | None:
        """The user's hash if this is its password, else None.

        Takes tens of milliseconds of CPU, as long for an unknown user as for a wrong password. A
        hash of mosquitto's is then replaced by argon2id in memory and in the file. If the file
        cannot be written, that is logged, and the login succeeds all the same.
        """
        stored = self._hashes.get(username)
        is_argon2id = stored is not None and stored.startswith("$argon2id$")
        is_scram = username in self._verifiers
        if stored is None or not check_password(stored, password):
            # The time must not reveal whether the user exists: each wrong password costs one hash
            # of each slow kind that the file has (mosquitto's are quick).
            if not is_argon2id:
                check_password(_DECOY, password)
            if self._shapes and not is_scram:
                check_password(self.verifier(username).encode(), password)
            return None
        if is_argon2id or is_scram:
            return stored
        return self._rehash(username, stored, password)

    def set(self, username: str, password: str | bytes, for_scram: bool | None = None) -> None:
        """Add a user or change its password; ValueError says what is wrong with either.

        `for_scram` stores the password for SCRAM-SHA-256, False as argon2id; None means as it is
        stored now, and argon2id for a new user.
        """
        check_username(username)
        if not password:
            raise ValueError("a password must not be empty")
        if is_token(password.encode() if isinstance(password, str) else password):
            raise ValueError("a password must not look like a token, which it would be taken for")
        if for_scram is None:
            for_scram = username in self._verifiers
        stored = _scram_hash(username, password) if for_scram else _HASHER.hash(password)
        self._changes[username] = self._hashes[username] = stored
        self._read_verifiers()

    def remove(self, username: str) -> None:
        """Remove a user; KeyError when there is no such user."""
        del self._hashes[username]
        self._changes[username] = None
        self._read_verifiers()

    def save(self) -> None:
        """Apply the changes to the file, atomically and synced to disk.

        A new file has mode 0600; an existing one keeps its owner, its comments and its group's
        right to read. AccessFileError when it cannot be written.
        """
        try:
            _rewrite(self.path, self._changes)
        except OSError as error:
            message = (
                f"cannot be written ({error.strerror}); use the user that owns the file and its "
                "directory"
            )
            raise AccessFileError([FileProblem(self.path, 0, 0, message)]) from error
        self._changes.clear()

    def _read_verifiers(self) -> None:
        self._verifiers = {
            username: scram.Verifier.decode(stored)
            for username, stored in self._hashes.items()
            if stored.startswith(_SCRAM)
        }
        self._shapes = {(each.iterations, len(each.salt)) for each in self._verifiers.values()}

    def _rehash(self, username: str, old: str, password: bytes) -> str:
        new = _HASHER.hash(password)
        with self._rehashing:
            current = self._hashes.get(username, old)
            if current != old:  # Another thread was quicker.
                return current
            self._hashes[username] = new
            try:
                _rewrite(self.path, {username: new}, only_if=old)
            except (OSError, AccessFileError) as error:
                _log.warning("the new hash of user %r is not saved: %s", username, error)
            else:
                _log.info("the password of user %r is stored as argon2id from now on", username)
        return new


def _scram_hash(username: str, password: str | bytes) -> str:
    prepared = scram.prepared_name(username)
    if prepared != username:
        raise ValueError(
            f"a user of {scram.METHOD} has to be named as clients send it, {prepared!r}"
        )
    return scram.Verifier.of(password).encode()


def _parse(path: Path, text: str) -> dict[str, str]:
    hashes: dict[str, str] = {}
    lines: dict[str, int] = {}
    problems: list[FileProblem] = []
    for number, line in enumerate(text.split("\n"), 1):
        entry = _entry(line)
        if entry is None:
            continue
        username, colon, stored = entry
        try:
            if not colon:
                raise ValueError("not user:hash; add users with: appliance user add NAME")
            check_username(username)
        except ValueError as error:
            problems.append(FileProblem(path, number, 1, str(error)))
            continue
        if username in lines:
            message = f"user {username!r} is in line {lines[username]} already; remove one of them"
            problems.append(FileProblem(path, number, 1, message))
            continue
        lines[username] = number
        try:
            check_hash(stored, username)
        except ValueError as error:
            problems.append(FileProblem(path, number, len(username) + 2, str(error)))
        else:
            hashes[username] = stored
    if problems:
        raise AccessFileError(problems)
    return hashes


def _entry(line: str) -> tuple[str, str, str] | None:
    """The user, colon and hash of a line; None for an empty line and a comment."""
    line = line.rstrip(" \t\r")
    if not line or line[0] == "#":
        return None
    return line.partition(":")


def check_hash(stored: str, username: str) -> None:
    """Raise a ValueError that says why the hash is not supported, without showing it."""
    advice = f"set a password with: appliance user passwd {username}"
    argon2id = _ARGON2ID.fullmatch(stored)
    if argon2id:
        memory, passes, lanes = map(int, argon2id.groups())
        if memory > _MAX_MEMORY_KIB or passes > _MAX_PASSES or lanes > _MAX_LANES:
            raise ValueError(f"this hash costs more than one login may; {advice}")
        if memory < 8 * lanes or not passes or not lanes:
            raise ValueError(f"not a valid argon2id hash; {advice}")
    elif stored.startswith("$7$"):
        match = re.fullmatch(r"\$7\$(\d{1,9})\$([^$]+)\$([^$]+)", stored)
        if not match or not int(match[1]) or not _is_digest(match[2], match[3]):
            raise ValueError(f"not a valid $7$ hash of mosquitto's (PBKDF2-SHA512); {advice}")
        if int(match[1]) > _MAX_ITERATIONS:
            raise ValueError(f"this hash costs more than one login may; {advice}")
    elif stored.startswith("$6$"):
        match = re.fullmatch(r"\$6\$([^$]+)\$([^$]+)", stored)
        if not match or not _is_digest(match[1], match[2]):
            raise ValueError(f"not a valid $6$ hash of mosquitto's (salted SHA-512); {advice}")
    elif stored.startswith(_SCRAM):
        try:
            scram.Verifier.decode(stored)
        except ValueError as error:
            raise ValueError(f"{error}; {advice} --scram") from None
    elif stored.startswith("$argon2id$"):
        raise ValueError(f"not a valid argon2id hash; {advice}")
    elif stored.startswith(("$", "SCRAM-")):
        raise ValueError(
            f"a kind of hash that is not read here ($argon2id$, {_SCRAM}, $7$, $6$); {advice}"
        )
    elif stored:
        raise ValueError(f"a plain password is not accepted; {advice}")
    else:
        raise ValueError(f"the user has no password; {advice}")


def _is_digest(salt: str, digest: str) -> bool:
    try:
        base64.b64decode(salt, validate=True)
        return len(base64.b64decode(digest, validate=True)) == _SHA512_SIZE
    except binascii.Error:
        return False


def _rewrite(path: Path, changes: Mapping[str, str | None], only_if: str | None = None) -> None:
    """Replace, add and (None) remove users in the file; all other lines stay as they are.

    With `only_if`, a user is replaced only if its hash still is that one.
    """
    path = path.resolve()  # Of a symbolic link the file is replaced, not the link.
    with locked(path.parent):
        try:
            status = path.stat()
        except FileNotFoundError:
            status, text = None, ""
        else:
            text = read_text(path, "add it again")
            _parse(path, text)
        left = dict(changes) if only_if is None else {}
        lines: list[str] = []
        for line in text.split("\n"):
            entry = _entry(line)
            if entry is None or entry[0] not in changes or only_if not in (None, entry[2]):
                lines.append(line)
                continue
            stored = changes[entry[0]]
            left.pop(entry[0], None)
            if stored is not None:
                lines.append(f"{entry[0]}:{stored}")
        if lines[-1] == "":
            lines.pop()
        lines += [f"{user}:{stored}" for user, stored in left.items() if stored is not None]
        with replacing(path, "".join(f"{line}\n" for line in lines)) as draft:
            if status is not None:
                # root may have changed a password: the appliance's user must still read the file.
                with suppress(PermissionError):
                    os.chown(draft, status.st_uid, status.st_gid)
                    draft.chmod(0o600 | stat.S_IMODE(status.st_mode) & 0o040)
