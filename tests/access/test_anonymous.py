"""Clients without a user name: their listener decides whether they are admitted."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
import yaml
from waiting import PATIENCE

from appliance import config
from appliance.access import Passwords
from appliance.app.main import App
from appliance.config import Settings
from appliance.mqtt.packets import Connect, Subscribe, Subscription
from appliance.ops.check import check

ACL = """\
topic read open/#

user ann
topic read #
"""
ANYBODY = "amqtt.plugins.authentication.AnonymousAuthPlugin"


def settings_of(directory: Path, **broker: Any) -> Settings:
    users = Passwords(directory / "users.passwd")
    users.set("ann", "secret")
    users.save()
    (directory / "acl.conf").write_text(ACL)
    file = directory / "appliance.yaml"
    file.write_text(yaml.safe_dump({"broker": broker, "bridge": {"bus": "none"}}))
    return config.load(file)


async def log_in(port: int, username: str | None) -> tuple[int, list[int]]:
    """The code of the CONNACK, and what is granted of two filters."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    password = b"secret" if username else None
    writer.write(Connect("", version=4, username=username, password=password).encode())
    filters = [Subscription("open/x"), Subscription("closed/x")]
    writer.write(Subscribe(1, filters).encode(4))
    try:
        answer = await asyncio.wait_for(reader.readexactly(4), PATIENCE)
        if answer[3]:
            return answer[3], []
        return 0, [*(await asyncio.wait_for(reader.readexactly(6), PATIENCE))[4:]]
    finally:
        writer.close()


@pytest.mark.parametrize("everywhere", [False, True])
async def test_a_listener_has_the_last_word(tmp_path: Path, everywhere: bool) -> None:
    listeners = [
        {"bind": "127.0.0.1:0"},
        {"bind": "127.0.0.1:0", "anonymous": True},
        {"bind": "127.0.0.1:0", "anonymous": False},
    ]
    app = App(settings_of(tmp_path, listeners=listeners, anonymous=everywhere))
    await app.start()
    try:
        silent, yes, no = (port for _, port in app.addresses)
        inside, refused = (0, [0, 0x80]), (5, [])
        assert await log_in(silent, None) == (inside if everywhere else refused)
        assert await log_in(yes, None) == inside
        assert await log_in(no, None) == refused
        for port in (silent, yes, no):
            assert await log_in(port, "ann") == (0, [0, 0])
        # And it may change its mind.
        for listener in listeners:
            listener.pop("anonymous", None)
        listeners[1]["anonymous"] = False
        settings_of(tmp_path, listeners=listeners, anonymous=everywhere)
        await app.reload()
        assert await log_in(yes, None) == refused
        assert await log_in(no, None) == (inside if everywhere else refused)
    finally:
        await app.stop()


async def test_a_plugin_does_not_let_in_whom_the_listener_does_not(tmp_path: Path) -> None:
    listeners = [{"bind": "127.0.0.1:0"}, {"bind": "127.0.0.1:0", "anonymous": False}]
    plugins = {ANYBODY: {"allow_anonymous": True}}
    app = App(settings_of(tmp_path, listeners=listeners, plugins=plugins))
    await app.start()
    try:
        open_to_all, closed = (port for _, port in app.addresses)
        for username in (None, "nobody"):
            assert await log_in(open_to_all, username) == (0, [0, 0x80])
            assert await log_in(closed, username) == (5, [])
        assert await log_in(closed, "ann") == (0, [0, 0])
    finally:
        await app.stop()


@pytest.mark.parametrize(
    ("listener", "told"),
    [
        ({"bind": "0.0.0.0:1"}, ["without TLS"]),
        ({"bind": "0.0.0.0:1", "anonymous": True}, ["anonymous and without TLS", "come in here"]),
        ({"bind": "127.0.0.1:1", "anonymous": True}, ["come in here"]),
        ({"bind": "127.0.0.1:1", "anonymous": False}, []),
        ({"bind": "unix:/tmp/x", "anonymous": True}, ["come in here"]),
        ({"bind": "unix:/tmp/x", "anonymous": "always"}, ["with any user name"]),
    ],
)
def test_check_says_so(tmp_path: Path, listener: dict[str, Any], told: list[str]) -> None:
    settings = settings_of(tmp_path, listeners=[listener])
    subject = f"listener {settings.broker.listeners[0].bind}"
    warnings = [f.text for f in check(settings) if (f.subject, f.level) == (subject, "warning")]
    for text in told:
        assert any(text in warning for warning in warnings), warnings
    assert told or not warnings


async def test_always_means_that_no_name_is_checked(tmp_path: Path) -> None:
    """And that nobody has a user's rights by saying to be one, not even with the password."""
    listeners = [{"bind": "127.0.0.1:0", "anonymous": "always"}, {"bind": "127.0.0.1:0"}]
    app = App(settings_of(tmp_path, listeners=listeners))
    await app.start()
    try:
        (always, other) = (port for _, port in app.addresses)
        for username in (None, "ann", "nobody", ""):
            assert await log_in(always, username) == (0, [0, 0x80])
        assert await log_in(other, "ann") == (0, [0, 0])
        assert await log_in(other, "nobody") == await log_in(other, None) == (5, [])
    finally:
        await app.stop()


def test_always_is_nothing_for_the_web(tmp_path: Path) -> None:
    with pytest.raises(config.ConfigError, match=r"must not be always for the web"):
        settings_of(tmp_path, listeners=[{"bind": ":1", "protocol": "web", "anonymous": "always"}])
