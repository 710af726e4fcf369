"""File owners: a command of root changes another user's files as that user, not as root.

The service's user can replace files in its folders, and files that appliance.yaml names, by links
to anything. A command that root gives would follow them. Acting as that user, it can do no more
than the user could.
"""

from __future__ import annotations

import builtins
import contextlib
import os
import pwd
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_ROOT = 0


class OwnerError(Exception):
    """Root does not write there; the message says why and what to do."""


def owner_of(path: Path) -> int:
    """The id of the user who controls what is found under that path; root's if nobody else does.

    Raises:
        OwnerError: everybody controls it, or every member of a group.
    """
    path = path.absolute()
    for folder in reversed(path.parents):
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            found = folder.stat()
            if found.st_uid != _ROOT:
                return found.st_uid
            by_group = found.st_mode & stat.S_IWGRP and found.st_gid != _ROOT
            if (by_group or found.st_mode & stat.S_IWOTH) and not found.st_mode & stat.S_ISVTX:
                raise OwnerError(
                    f"others than root can replace what is in {folder} (mode "
                    f"{stat.S_IMODE(found.st_mode):04o}), so root does not write there: use the "
                    f"appliance's user, or close it with: chmod go-w {folder}"
                )
    with contextlib.suppress(OSError):
        return path.lstat().st_uid
    return _ROOT


@contextlib.contextmanager
def acting_for(*paths: Path | None) -> Iterator[None]:
    """As root, act as the first other user who controls one of these paths; else change nothing.

    Raises:
        OwnerError: see `owner_of`.
    """
    uid = os.geteuid()
    if uid == _ROOT:
        owners = (owner_of(path) for path in paths if path is not None)
        uid = next((owner for owner in owners if owner != _ROOT), _ROOT)
    if uid == os.geteuid():
        yield
        return
    try:
        user = pwd.getpwuid(uid)
    except KeyError:  # of a container, or of a disk from elsewhere
        group, groups = uid, []
    else:
        group, groups = user.pw_gid, os.getgrouplist(user.pw_name, user.pw_gid)
    with _importing_as_caller(), _being(uid, group, groups):
        yield


@contextlib.contextmanager
def _importing_as_caller() -> Iterator[None]:
    """Within it what is imported is read by the caller: Python may be where only root can read, as
    what the one file has unpacked is."""
    load = builtins.__import__

    def load_as_caller(*arguments: Any, **named: Any) -> Any:
        with acting_as_caller():
            return load(*arguments, **named)

    builtins.__import__ = load_as_caller
    try:
        yield
    finally:
        builtins.__import__ = load


@contextlib.contextmanager
def acting_as_caller() -> Iterator[None]:
    """Within `acting_for`, act as the caller again: for files named on the command line."""
    with _being(os.getuid(), os.getgid(), [os.getgid()]):
        yield


@contextlib.contextmanager
def _being(uid: int, group: int, groups: list[int]) -> Iterator[None]:
    before = os.geteuid(), os.getegid(), os.getgroups()
    if uid == before[0]:
        yield
        return
    _become(uid, group, groups)
    try:
        yield
    finally:
        _become(*before)


def _become(uid: int, group: int, groups: list[int]) -> None:
    if os.geteuid() != _ROOT:
        os.seteuid(_ROOT)  # only root changes groups
    os.setgroups(groups)
    os.setegid(group)
    os.seteuid(uid)
