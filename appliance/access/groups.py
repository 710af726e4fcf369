"""Who is in which group: the lines `include groups/NAME.conf` below `user` in the ACL file."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final

from appliance.access.acl import Acl
from appliance.access.passwords import check_username
from appliance.access.problems import AccessFileError, FileProblem, read_text
from appliance.access.rewriting import locked, replacing

#: The folder of the groups' files, beside the ACL file.
FOLDER: Final = "groups"

_INCLUDE: Final = re.compile(r" *include +groups/([A-Za-z0-9_-]{1,64})\.conf[ \t]*")
_USER: Final = re.compile(r" *user +(.*?)[ \t\r]*")
_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")

_ADVICE: Final = "make it, as `appliance init` does"


def groups(acl: Path) -> list[str]:
    """The names of all groups, sorted: the files beside the ACL file."""
    files = (acl.parent / FOLDER).glob("*.conf")
    return sorted(file.stem for file in files if _NAME.fullmatch(file.stem))


def members(acl: Path) -> dict[str, list[str]]:
    """The groups of each user who is in any, in the order of the file.

    Raises:
        AccessFileError: the file cannot be read.
    """
    found: dict[str, list[str]] = {}
    user: str | None = None
    for line in read_text(acl, _ADVICE).split("\n"):
        if named := _USER.fullmatch(line):
            user = named[1]
        elif user is not None and (included := _INCLUDE.fullmatch(line)):
            found.setdefault(user, []).append(included[1])
    return found


def join(acl: Path, robot: str, user: str, wanted: Iterable[str]) -> None:
    """Let the user be in these groups and in no others; all else in the file stays.

    The file is replaced atomically, and only by one that can be read.

    Raises:
        AccessFileError: it cannot be read or written.
        ValueError: there is no such group, or the name cannot be a user's.
    """
    check_username(user)
    path = acl.resolve()  # of a symbolic link the file is replaced, not the link
    wanted, known = list(dict.fromkeys(wanted)), groups(path)
    for name in wanted:
        if name not in known:
            raise ValueError(f"there is no group {name!r}; there are {', '.join(known)}")
    try:
        with locked(path.parent):
            status = path.stat()
            text = _with_groups(read_text(path, _ADVICE), user, wanted)
            with replacing(path, text) as draft:
                with suppress(PermissionError):
                    os.chown(draft, status.st_uid, status.st_gid)
                draft.chmod(stat.S_IMODE(status.st_mode))
                Acl.load(draft, robot)
    except OSError as error:
        text = f"cannot be written ({error.strerror}); use the user that owns the file"
        raise AccessFileError([FileProblem(path, 0, 0, text)]) from error


def leave(acl: Path, robot: str, user: str) -> None:
    """Take the user out of all groups; the file is left alone where it is in none.

    Raises:
        AccessFileError: the file cannot be read or written.
    """
    if user in members(acl):
        join(acl, robot, user, ())


def own_rules(acl: Path, user: str) -> list[int]:
    """The lines of the rules that the user has beside its groups.

    Raises:
        AccessFileError: the file cannot be read.
    """
    found: list[int] = []
    current: str | None = None
    for number, line in enumerate(read_text(acl, _ADVICE).split("\n"), 1):
        if named := _USER.fullmatch(line):
            current = named[1]
        elif current == user and line.strip().startswith("topic "):
            found.append(number)
    return found


def _with_groups(text: str, user: str, wanted: list[str]) -> str:
    """The rules with these groups for the user, at its first `user` line or at the end."""
    lines = [f"include {FOLDER}/{name}.conf" for name in wanted]
    kept: list[str] = []
    current: str | None = None
    for line in text.rstrip("\n").split("\n"):
        if named := _USER.fullmatch(line):
            current = named[1]
        elif current == user and _INCLUDE.fullmatch(line):
            continue
        kept.append(line)
        if named and current == user:
            kept += lines
            lines = []
    if lines:
        kept += ["", f"user {user}", *lines]
    return "\n".join(kept) + "\n"
