"""Tokens over a restart: what the file says, what ends them meanwhile, and files not to believe."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from access.test_tokens import Clock, enter, issue
from appliance.access import FileAccess, Passwords, TokenFile
from appliance.access.tokens import LIFETIME, MOST, MOST_OF_USER, PREFIX, Tokens

HOUR = 3600.0
BOOT = "5f6e"


class Restarts:
    """One start of the appliance after the other, by the same files."""

    def __init__(self, files: tuple[Path, Path], path: Path) -> None:
        self.files = files
        self.path = path
        self.clock = Clock()

    @contextmanager
    def start(self, boot: str = BOOT) -> Iterator[FileAccess]:
        access = FileAccess(*self.files, "r2d2")
        access.tokens = Tokens(self.clock)
        access.keep_tokens(TokenFile(self.path, boot))
        try:
            yield access
        finally:
            access.close()

    def change(self, act: Callable[[Passwords], object]) -> None:
        users = Passwords.load(self.files[0])
        act(users)
        users.save()

    def rewrite(self, act: Callable[[dict[str, Any]], object]) -> None:
        found = json.loads(self.path.read_text())
        act(found)
        self.path.write_text(json.dumps(found))


@pytest.fixture
def restarts(files: tuple[Path, Path], tmp_path: Path) -> Restarts:
    return Restarts(files, tmp_path / "tokens.json")


async def issued(restarts: Restarts) -> str:
    with restarts.start() as access:
        return await issue(access)


async def test_a_restart_ends_no_token(restarts: Restarts):
    token = await issued(restarts)
    text = restarts.path.read_text()
    assert token.removeprefix(PREFIX) not in text and "$argon2" not in text
    assert restarts.path.stat().st_mode & 0o777 == 0o600
    for _ in range(2):
        with restarts.start() as access:
            assert await enter(access, token) and await enter(access, token, None)
            assert not await enter(access, token, "bob")
    assert list(restarts.path.parent.glob(".tokens*")) == []


async def test_a_kill_ends_no_token(restarts: Restarts):
    """It is in the file when the user gets it, and is not when its end is answered."""
    with restarts.start() as access:
        token, other = await issue(access), await issue(access)
        with restarts.start() as later:
            assert await enter(later, token) and await enter(later, other)
        await access.end_token("alice", token.encode())
        with restarts.start() as later:
            assert not await enter(later, token) and await enter(later, other)
        await access.end_tokens("alice")
        with restarts.start() as later:
            assert not await enter(later, other)


@pytest.mark.parametrize(
    "act",
    [
        lambda users: users.set("alice", "anders"),
        lambda users: users.set("alice", "geheim"),  # the same password is another hash
        lambda users: users.remove("alice"),
        lambda users: (users.remove("alice"), users.set("alice", "anders")),
    ],
)
async def test_what_was_changed_meanwhile_ends_it(
    restarts: Restarts, act: Callable[[Passwords], object]
):
    token = await issued(restarts)
    restarts.change(act)
    with restarts.start() as access:
        assert not await enter(access, token) and len(access.tokens) == 0


async def test_what_a_reload_ended_stays_ended(restarts: Restarts):
    """Though the users file is the old one again."""
    users = restarts.files[0]
    before = users.read_text()
    with restarts.start() as access:
        token = await issue(access)
        restarts.change(lambda users: users.remove("alice"))
        access.reload()
    users.write_text(before)
    with restarts.start() as access:
        assert not await enter(access, token)


@pytest.mark.parametrize(("hours", "is_in"), [(0, True), (11.9, True), (12, False), (13, False)])
async def test_it_ends_with_its_time(
    restarts: Restarts, hours: float, is_in: bool, monkeypatch: pytest.MonkeyPatch
):
    """By no clock that anybody sets."""
    token = await issued(restarts)
    restarts.clock.now += hours * HOUR
    monkeypatch.setattr("time.time", lambda: 0.0)
    with restarts.start() as access:
        assert await enter(access, token) == is_in


async def test_another_start_of_the_computer_ends_it(restarts: Restarts):
    """Its clock begins anew, and would let tokens live for longer."""
    token = await issued(restarts)
    restarts.clock.now = 1.0
    with restarts.start("another") as access:
        assert not await enter(access, token)
    with restarts.start() as access:  # longer than a new one
        assert not await enter(access, token)


def first(value: object, at: int) -> Callable[[dict[str, Any]], object]:
    def replace(found: dict[str, Any]) -> None:
        found["tokens"][0][at] = value

    return replace


@pytest.mark.usefixtures("no_collection")
@pytest.mark.parametrize(
    "harm",
    [
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[:-9]),
        lambda path: path.write_bytes(os.urandom(1000)),
        lambda path: path.write_text("[" * 1_000_000),
        lambda path: path.write_text("[]"),
        lambda path: path.write_text(json.dumps({"boot": BOOT})),
        lambda path: path.write_text(json.dumps({"boot": BOOT, "tokens": {"a": 1}})),
        lambda path: path.write_bytes(path.read_bytes() + b" " * (4 << 20)),
        lambda path: path.chmod(0o620),
        lambda path: path.chmod(0o602),
        lambda path: path.rename(path.with_name("x")) and path.symlink_to(path.with_name("x")),
        lambda path: (path.unlink(), os.mkfifo(path)),
    ],
)
async def test_a_file_not_to_believe(
    restarts: Restarts, harm: Callable[[Path], object], caplog: pytest.LogCaptureFixture
):
    """It is left out, with a warning, and the next token replaces it."""
    token = await issued(restarts)
    harm(restarts.path)
    with restarts.start() as access:
        assert not await enter(access, token)
        assert f"{restarts.path} is not used, users sign in again" in caplog.text
        other = await issue(access)
    with restarts.start() as access:
        assert await enter(access, other) and not await enter(access, token)


@pytest.mark.parametrize(
    "act",
    [
        *(first(value, at) for at in range(4) for value in (None, 5, "", "x" * 64, [], {})),
        first(float("nan"), 3),
        first(float("inf"), 3),
        first(1000.0 + LIFETIME + 1, 3),
        first("0" * 64, 2),  # by somebody who does not know the hash of the password
        lambda found: found["tokens"][0].append(1),
        lambda found: found["tokens"].__setitem__(0, None),
        lambda found: found.update(boot=None),
    ],
)
async def test_a_token_not_to_believe(restarts: Restarts, act: Callable[[dict[str, Any]], object]):
    token = await issued(restarts)
    restarts.rewrite(act)
    with restarts.start() as access:
        assert not await enter(access, token)


async def test_no_file_has_more_than_there_may_be(restarts: Restarts):
    await issued(restarts)

    def more(found: dict[str, Any]) -> None:
        _, *rest = found["tokens"][0]
        found["tokens"] = [[f"{n:064x}", *rest] for n in range(MOST_OF_USER + 5)]
        others = [[f"{n:064x}", f"user {n}", *rest[1:]] for n in range(100, 100 + 2 * MOST)]
        found["tokens"] += others

    restarts.rewrite(more)
    tokens = Tokens(restarts.clock)
    tokens.restore(TokenFile(restarts.path, BOOT).read())
    assert len(tokens) == MOST
    assert sum(each.username == "alice" for each in tokens.all()) == MOST_OF_USER


async def test_a_file_that_cannot_be_written(restarts: Restarts, caplog: pytest.LogCaptureFixture):
    """The token is good until the restart, and the log says so once."""
    restarts.path.mkdir()
    with restarts.start() as access:
        for _ in range(2):
            assert await enter(access, await issue(access))
    assert caplog.text.count("users will sign in again after a restart") == 1
