"""The verbs about users: the users file, and who is in which group.

The files are changed by one thread at a time, as by `appliance user`, and are in force with the
answer. Hashing a password takes tens of milliseconds of that thread.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

from pydantic import Field

from appliance.access import AccessFileError, FileAccess, Passwords
from appliance.access import groups as acl_groups
from appliance.management.verb_thread import VerbThread
from appliance.management.verbs import Arguments, Caller, Verb
from appliance.ros.calls.dispatcher import CallError

#: Seconds for a change, with the reload behind it.
TIMEOUT: Final = 60.0

#: Characters of a password: a long one is no more work than a short one.
LONGEST_PASSWORD: Final = 1024
_LONGEST_NAME: Final = 256
_MOST_GROUPS: Final = 32

T = TypeVar("T")

UserName = Annotated[str, Field(min_length=1, max_length=_LONGEST_NAME)]
GroupNames = Annotated[list[Annotated[str, Field(max_length=64)]], Field(max_length=_MOST_GROUPS)]


@dataclass(eq=False)
class OneUser(Arguments):
    """A user by name."""

    user: UserName


@dataclass(eq=False)
class UserPassword(OneUser):
    """A user's new password; `scram` stores it for SCRAM, None as it is stored now."""

    password: Annotated[str, Field(min_length=1, max_length=LONGEST_PASSWORD)] = field(repr=False)
    scram: bool | None = None


@dataclass(eq=False)
class NewUser(UserPassword):
    """A new user, and its groups."""

    groups: GroupNames = field(default_factory=list)


@dataclass(eq=False)
class UserGroups(OneUser):
    """All groups of a user."""

    groups: GroupNames


class UserVerbs:
    """The verbs about users. Files are read and written in a thread."""

    def __init__(
        self,
        access: FileAccess,
        thread: VerbThread,
        reload: Callable[[], Awaitable[object]],
    ) -> None:
        """`reload` puts changed files in force."""
        self._access = access
        self._thread = thread
        self._reload = reload
        self._lock = asyncio.Lock()

    def verbs(self) -> Iterator[Verb[Any]]:
        """All of them."""
        yield Verb("users", Arguments, self._list)
        yield Verb("user_add", NewUser, self._add, TIMEOUT, "user added", _with_groups)
        yield Verb("user_remove", OneUser, self._remove, TIMEOUT, "user removed", _named)
        yield Verb("user_password", UserPassword, self._set, TIMEOUT, "password changed", _named)
        yield Verb("user_groups", UserGroups, self._join, TIMEOUT, "groups changed", _with_groups)

    async def _list(self, caller: Caller, _: Arguments) -> dict[str, Any]:
        rules = self._access.in_force

        def read() -> dict[str, Any]:
            users = Passwords.load(_there(rules.users_path))
            acl = rules.acl_path
            of = acl_groups.members(acl) if acl is not None else {}
            entries = [
                {"user": name, "kind": users.kind_of(name), "groups": of.get(name, [])}
                for name in users.users()
            ]
            return {"users": entries, "groups": acl_groups.groups(acl) if acl is not None else []}

        return await self._in_thread(caller, read)

    async def _add(self, caller: Caller, wanted: NewUser) -> dict[str, Any]:
        def add(users: Passwords) -> None:
            if wanted.user in users.users():
                raise CallError("rejected", f"there is a user {wanted.user!r} already")
            users.set(wanted.user, wanted.password, wanted.scram)
            # Before the user can log in: what an earlier one of this name was in is not its own.
            self._write_groups(wanted.user, wanted.groups)

        return await self._change(caller, wanted.user, add)

    async def _set(self, caller: Caller, wanted: UserPassword) -> dict[str, Any]:
        def set_password(users: Passwords) -> None:
            _known(users, wanted.user)
            users.set(wanted.user, wanted.password, wanted.scram)

        return await self._change(caller, wanted.user, set_password)

    async def _remove(self, caller: Caller, wanted: OneUser) -> dict[str, Any]:
        def remove(users: Passwords) -> None:
            _known(users, wanted.user)
            users.remove(wanted.user)
            # A client's certificate may still name the user, or a new one may have its name.
            self._write_groups(wanted.user, [])

        return await self._change(caller, wanted.user, remove)

    async def _join(self, caller: Caller, wanted: UserGroups) -> dict[str, Any]:
        def join(users: Passwords) -> None:
            _known(users, wanted.user)
            self._write_groups(wanted.user, wanted.groups)

        return await self._change(caller, wanted.user, join)

    def _write_groups(self, user: str, wanted: list[str]) -> None:
        rules = self._access.in_force
        if rules.acl_path is None:
            if wanted:
                raise CallError("rejected", "there is no ACL file, and so are no groups")
            return
        if wanted:
            acl_groups.join(rules.acl_path, rules.robot, user, wanted)
        else:
            acl_groups.leave(rules.acl_path, rules.robot, user)

    async def _change(
        self, caller: Caller, user: str, change: Callable[[Passwords], None]
    ) -> dict[str, Any]:
        path = self._access.in_force.users_path

        def run() -> None:
            users = Passwords.load(_there(path))
            change(users)
            users.save()

        async with self._lock:
            await self._in_thread(caller, run)
            await self._reload()
        return {"user": user}

    async def _in_thread(self, caller: Caller, work: Callable[[], T]) -> T:
        """The result of the work; what is wrong with a file or an argument is a CallError."""
        try:
            return await self._thread.run(caller.user, work)
        except AccessFileError as error:
            raise CallError("failed", str(error)) from None
        except ValueError as error:
            raise CallError("bad_request", str(error)) from None


def _there(path: Path | None) -> Path:
    if path is None:
        raise CallError("rejected", "there is no users file: a plugin knows the users")
    return path


def _known(users: Passwords, name: str) -> None:
    if name not in users.users():
        raise CallError("not_found", f"there is no user {name!r}")


def _named(wanted: OneUser) -> dict[str, Any]:
    return {"of": wanted.user}


def _with_groups(wanted: Any) -> dict[str, Any]:
    return {"of": wanted.user, "groups": ", ".join(wanted.groups)}
