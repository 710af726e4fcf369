"""Tokens: what stands for a password for a while, and what ends that."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from access.conftest import count_checks
from access.test_login import ADDRESS, TLS, Plugins, connect
from appliance.access import FileAccess, LoginPolicy, Passwords, is_token
from appliance.access import tokens as tokens_module
from appliance.access.tokens import LIFETIME, MOST, MOST_OF_USER, PREFIX, Tokens
from appliance.broker.values import Identity, Refusal
from appliance.mqtt.reason import ReasonCode

UNKNOWN = PREFIX + "x" * 43


class Clock:
    """A clock that a test sets."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


async def issue(access: FileAccess, password: str = "geheim") -> str:
    found = await access.issue_token("alice", password.encode(), ADDRESS)
    assert isinstance(found, str)
    return found


async def enter(access: FileAccess, token: str, user: str | None = "alice", **more: Any) -> bool:
    """Whether it is let in, as its user."""
    policy = LoginPolicy(access, **more)
    who = await policy.authenticate(connect(user, token.encode()), ADDRESS)
    if isinstance(who, Refusal):
        assert who.code == ReasonCode.NOT_AUTHORIZED and token not in who.reason
        return False
    assert who == Identity("alice", "c")
    return True


@pytest.mark.parametrize(
    ("password", "is_one"),
    [
        (UNKNOWN, True),
        (UNKNOWN + "x", False),
        (UNKNOWN[:-1], False),
        (UNKNOWN[:-1] + "é", False),
        (UNKNOWN + "\n", False),
        (" " + UNKNOWN, False),
        (PREFIX, False),
        ("", False),
    ],
)
def test_the_form(password: str, is_one: bool):
    assert is_token(password.encode()) is is_one
    assert not is_token(None)


async def test_a_token_takes_the_place_of_the_password(access: FileAccess, monkeypatch: Any):
    token = await issue(access)
    assert is_token(token.encode())
    checks = count_checks(monkeypatch)
    assert await enter(access, token)
    assert await enter(access, token, None)  # HTTP's Bearer has no name
    assert not await enter(access, token, "bob")
    assert not await enter(access, token, "")
    assert not await enter(access, token[:-1] + ("A" if token[-1] != "A" else "B"))
    assert not checks
    assert await issue(access) != token


async def test_an_unknown_token_is_no_guess(access: FileAccess, monkeypatch: Any):
    """Pages that come again after a restart delay nobody who has a password."""
    checks = count_checks(monkeypatch)
    for _ in range(100):
        assert not await enter(access, UNKNOWN)
    assert not checks
    assert access.throttle.user_delay("alice") == access.throttle.address_delay(ADDRESS) == 0


async def test_no_token_makes_another_one(access: FileAccess):
    token = await issue(access)
    for password in (token, UNKNOWN, "wrong"):
        assert isinstance(await access.issue_token("alice", password.encode(), ADDRESS), Refusal)
    assert isinstance(await access.issue_token("bob", b"geheim", ADDRESS), Refusal)
    assert len(access.tokens) == access.tokens.issued == 1


async def test_it_ends_with_its_time(access: FileAccess):
    clock = Clock()
    access.tokens = Tokens(clock)
    token = await issue(access)
    clock.now += LIFETIME - 1
    assert await enter(access, token) and len(access.tokens) == 1
    clock.now += 1
    assert not await enter(access, token)
    assert len(access.tokens) == 0


def test_no_clock_that_is_set_back_makes_it_last(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tokens_module.time, "time", lambda: 0.0)
    begun = tokens_module.since_start()
    assert tokens_module.since_start() >= begun > 0


async def test_it_ends_with_the_password(access: FileAccess, files: tuple[Path, Path]):
    token = await issue(access)
    access.reload()
    assert await enter(access, token)  # nothing was changed
    users = Passwords.load(files[0])
    users.set("alice", "anders")
    users.save()
    assert await enter(access, token)  # it is in force with the reload
    access.reload()
    assert not await enter(access, token) and len(access.tokens) == 0
    users.set("alice", "geheim")  # the same password is another hash
    users.save()
    access.reload()
    assert not await enter(access, token)


async def test_it_ends_with_the_user(access: FileAccess, files: tuple[Path, Path]):
    token = await issue(access)
    users = Passwords.load(files[0])
    users.remove("alice")
    users.save()
    access.reload()
    assert not await enter(access, token)
    users.set("alice", "geheim")
    users.save()
    access.reload()
    assert not await enter(access, token)  # another one of that name


async def test_who_ends_it(access: FileAccess):
    token, other = await issue(access), await issue(access)
    assert not await access.end_token("bob", token.encode())
    assert not await access.end_token("alice", UNKNOWN.encode())
    assert await access.end_token("alice", token.encode())
    assert not await access.end_token("alice", token.encode())
    assert not await enter(access, token) and await enter(access, other)
    assert await access.end_tokens("bob") == 0 and await access.end_tokens("alice") == 1
    assert not await enter(access, other)


def test_the_most_of_a_user_and_of_all():
    tokens = Tokens()
    mine = [tokens.issue("alice", "hash") for _ in range(MOST_OF_USER + 1)]
    assert tokens.find(str(mine[0]).encode()) is None  # the oldest has made room
    assert all(tokens.find(str(each).encode()) for each in mine[1:])
    for number in range(MOST - MOST_OF_USER):
        assert tokens.issue(f"user {number}", "hash")
    assert len(tokens) == MOST
    assert tokens.issue("somebody", "hash") is None
    assert tokens.issue("alice", "hash") is not None  # in the place of her oldest


async def test_what_is_kept_tells_no_token(access: FileAccess):
    token = await issue(access)
    assert token.removeprefix(PREFIX) not in repr(vars(access.tokens))


async def test_a_certificate_decides_before_a_token(access: FileAccess):
    token = await issue(access)
    policy = LoginPolicy(access, lambda tls: "carol")
    who = await policy.authenticate(connect("carol", token.encode()), ADDRESS, TLS)
    assert who == Identity("carol", "c")
    assert isinstance(
        await policy.authenticate(connect("alice", token.encode()), ADDRESS, TLS), Refusal
    )


async def test_no_plugin_is_shown_a_token(access: FileAccess):
    plugins = Plugins(None)  # it lets everybody in
    assert await enter(access, await issue(access), plugins=plugins)
    assert not await enter(access, UNKNOWN, "somebody", plugins=plugins)
    assert "asked" not in plugins.calls


async def test_an_unknown_token_is_not_anonymous(files: tuple[Path, Path]):
    access = FileAccess(*files, "r2d2", anonymous=True)
    try:
        for anonymous in (None, True):
            policy = LoginPolicy(access)
            who = await policy.identify(None, UNKNOWN.encode(), ADDRESS, None, anonymous)
            assert isinstance(who, Refusal)
    finally:
        access.close()


def test_no_password_looks_like_a_token(tmp_path: Path):
    users = Passwords(tmp_path / "users.passwd")
    for password in (UNKNOWN, UNKNOWN.encode()):
        with pytest.raises(ValueError, match="token"):
            users.set("alice", password)
