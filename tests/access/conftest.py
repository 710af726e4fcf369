"""Users files and ACL files, and the access that they decide."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.access import FileAccess, Passwords, check_password
from appliance.access import passwords as passwords_module


def write(path: Path, text: str) -> Path:
    """Write a file that nobody else may read."""
    path.write_text(text)
    path.chmod(0o600)
    return path


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """The users, alice with the password "geheim", and what she may do."""
    users = Passwords(tmp_path / "users.passwd")
    users.set("alice", "geheim")
    users.save()
    acl = write(tmp_path / "acl.conf", "user alice\ntopic read a/#\n")
    return users.path, acl


@pytest.fixture
def access(files: tuple[Path, Path]) -> Iterator[FileAccess]:
    access = FileAccess(*files, "r2d2")
    yield access
    access.close()


def count_checks(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The stored passwords that others are checked against from now on: each costs a hash."""
    checks: list[str] = []

    def check(stored: str, password: bytes) -> bool:
        checks.append(stored)
        return check_password(stored, password)

    monkeypatch.setattr(passwords_module, "check_password", check)
    return checks
