"""The order in which a login is decided; and that amqtt's frame is loaded for plugins only."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from appliance.access import FileAccess, LoginPolicy, Passwords
from appliance.broker.values import Identity, Refusal
from appliance.mqtt.packets import Connect
from appliance.mqtt.reason import ReasonCode

ADDRESS = "127.0.0.1:1"
TLS: Any = object()


class Plugins:
    """Plugins that admit `user`, or, with None, everybody as anonymous."""

    def __init__(self, user: str | None, authenticates: bool = True) -> None:
        self.user = user
        self.authenticates = authenticates
        self.calls: list[str] = []

    def connect_received(self, connect: Connect) -> None:
        self.calls.append("received")

    async def authenticate(
        self, connect: Connect, address: str, tls: object
    ) -> tuple[Identity | Refusal, object]:
        self.calls.append("asked")
        if self.user not in (None, connect.username):
            return Refusal(ReasonCode.NOT_AUTHORIZED, "no"), None
        return Identity(self.user, connect.client_id), "noted"

    def admitted(
        self, identity: Identity, connect: Connect, address: str, tls: object, noted: object
    ) -> None:
        self.calls.append(f"admitted {identity.username} {noted}")


@pytest.fixture
def files(tmp_path: Path) -> Iterator[FileAccess]:
    passwords = Passwords(tmp_path / "users.passwd")
    passwords.set("alice", "geheim")
    passwords.save()
    access = FileAccess(tmp_path / "users.passwd", None, "robot")
    yield access
    access.close()


def connect(username: str | None, password: bytes | None = None) -> Connect:
    return Connect("c", username=username, password=password)


async def login(policy: LoginPolicy, *who: Any, tls: Any = None, **more: Any) -> str | None:
    """The user that comes in, or "refused"."""
    answer = await policy.authenticate(connect(*who), ADDRESS, tls, **more)
    return answer.username if isinstance(answer, Identity) else "refused"


async def test_without_plugins_the_files_decide(files: FileAccess) -> None:
    policy = LoginPolicy(files)
    assert await login(policy, "alice", b"geheim") == "alice"
    assert await login(policy, "alice", b"wrong") == "refused"
    assert await login(policy, "bob", b"x") == "refused"
    assert await login(policy, None) == "refused"
    assert await login(policy, None, anonymous=True) is None
    assert policy.exchange("SCRAM-SHA-256", ADDRESS, None) is not None


async def test_a_certificate_decides_before_everything_else(files: FileAccess) -> None:
    plugins = Plugins("bob")
    policy = LoginPolicy(files, lambda tls: "carol", plugins)
    assert await login(policy, None, tls=TLS) == "carol"
    assert await login(policy, "carol", tls=TLS) == "carol"
    assert await login(policy, "alice", b"geheim", tls=TLS) == "refused"
    assert plugins.calls == ["received", "admitted carol None"] * 2 + ["received"]
    assert LoginPolicy(files, lambda tls: "carol").exchange("SCRAM-SHA-256", ADDRESS, TLS) is None

    def no_name(tls: object) -> str:
        raise ValueError("its certificate names no user")

    assert await login(LoginPolicy(files, no_name), "alice", b"geheim", tls=TLS) == "refused"
    assert LoginPolicy(files, no_name).exchange("SCRAM-SHA-256", ADDRESS, TLS) is None


async def test_plugins_decide_about_whom_the_files_do_not_know(files: FileAccess) -> None:
    plugins = Plugins("bob")
    policy = LoginPolicy(files, plugins=plugins)
    assert await login(policy, "alice", b"wrong") == "refused"
    assert plugins.calls == ["received"], "the users file has the last word about its users"
    assert await login(policy, "bob", b"x") == "bob"
    assert plugins.calls[1:] == ["received", "asked", "admitted bob noted"]
    assert await login(policy, "eve", b"x") == "refused"
    assert policy.exchange("SCRAM-SHA-256", ADDRESS, None) is None


async def test_a_listener_has_the_last_word_about_anonymous_clients(files: FileAccess) -> None:
    plugins = Plugins(None)
    policy = LoginPolicy(files, plugins=plugins)
    assert await login(policy, None) is None
    assert await login(policy, None, anonymous=False) == "refused"
    assert await login(policy, "bob", b"x", anonymous=False) == "refused"
    assert plugins.calls[-1] == "asked"


async def test_plugins_that_only_observe_decide_nothing(files: FileAccess) -> None:
    plugins = Plugins("bob", authenticates=False)
    policy = LoginPolicy(files, plugins=plugins)
    assert await login(policy, "bob", b"x") == "refused"
    assert await login(policy, "alice", b"geheim") == "alice"
    assert plugins.calls == ["received", "received", "admitted alice None"]
    assert policy.exchange("SCRAM-SHA-256", ADDRESS, None) is not None


def test_amqtt_is_loaded_for_plugins_only() -> None:
    code = (
        "import sys, appliance.app.main\n"
        "print(*sorted(m for m in sys.modules if m.startswith(('amqtt', 'appliance.plugins'))))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert cast(str, done.stdout).split() == []
