"""amqtt's own plugins: JWT, HTTP, SQL, LDAP; their time limits, and what of them is cached."""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from aiohttp import web
from test_amqtt import Login, connect_of, own, running
from waiting import PATIENCE, until

from appliance.broker.values import Action, Decision, Identity, Refusal
from appliance.config import secrets_in
from appliance.mqtt.packets import Connect
from appliance.mqtt.reason import ReasonCode
from appliance.plugins import CachePolicy, PluginSettingsError
from appliance.plugins import logins as logins_module

pytest.importorskip("sqlalchemy", reason="amqtt.contrib needs SQLAlchemy: pip install sqlalchemy")

SECRET = "a key of thirty-two bytes at least, for HS256"
PASSWORD = "näme & päss/word?"
HOST = "127.0.0.1:1"


@pytest.fixture(autouse=True)
def _clean() -> Iterator[None]:
    Login.seen.clear()
    yield
    Login.seen.clear()


async def decided(rig: Any, who: Identity, action: Action, topic: str) -> Decision:
    """What is decided when the plugins have had the time to answer."""
    decision = rig.frame._access.decide(who, action, topic)
    await until(lambda: rig.frame._access._asked == {})
    if decision.pending:
        decision = rig.frame._access.decide(who, action, topic)
    assert isinstance(decision, Decision)
    return decision


def code_of(answer: Identity | Refusal) -> ReasonCode:
    return answer.code if isinstance(answer, Refusal) else ReasonCode.SUCCESS


async def check_only_bob(rig: Any) -> None:
    """Only bob is let in, and with his right password."""
    assert await rig.login.authenticate(bob(), HOST) == Identity("bob", "c1")
    for wrong in (bob(password="wrong"), connect_of("eve", b"x")):
        answer = await rig.login.authenticate(wrong, HOST)
        assert code_of(answer) == ReasonCode.NOT_AUTHORIZED


# --- JWT -----------------------------------------------------------------------------------------


async def test_jwt() -> None:
    jwt = pytest.importorskip("jwt")
    key = {"secret_key": SECRET}
    plugins = {
        "amqtt.contrib.jwt.UserAuthJwtPlugin": {**key, "user_claim": "sub"},
        "amqtt.contrib.jwt.TopicAuthJwtPlugin": {
            **key,
            "publish_claim": "pub",
            "subscribe_claim": "sub_topics",
            "receive_claim": "sub_topics",
        },
    }

    def token(key: str = SECRET, **claims: Any) -> bytes:
        payload = {"sub": "bob", "pub": ["a/#"], "sub_topics": ["b/+"], **claims}
        return bytes(jwt.encode(payload, key, algorithm="HS256"), "ascii")

    async with running(plugins) as rig:
        client = await rig.connect(f"bob:{token().decode()}", "b1")
        assert await client.subscribe([("b/c", 1), ("a/x", 1)]) == [1, 0x80]
        for wrong in (
            token(key=SECRET[::-1]),
            token(sub="alice"),
            token(exp=int(time.time()) - 10),
            b"no token",
        ):
            answer = await rig.login.authenticate(connect_of("bob", wrong), HOST)
            assert code_of(answer) == ReasonCode.NOT_AUTHORIZED
        bob = Identity("bob", "b1")
        assert await decided(rig, bob, Action.PUBLISH, "a/x")
        assert not await decided(rig, bob, Action.PUBLISH, "b/c")
        assert await decided(rig, bob, Action.RECEIVE, "b/c")
        assert not await decided(rig, bob, Action.SUBSCRIBE, "#")


# --- HTTP ----------------------------------------------------------------------------------------


class Backend:
    """An HTTP server that says who may do what, and can hang."""

    def __init__(self) -> None:
        self.port = 0
        self.asked: list[dict[str, Any]] = []
        self.passwords = {"bob": PASSWORD}
        self.readable = {"b/c"}
        self.hangs = asyncio.Event()
        self.answer: Callable[[bool], web.Response] = lambda ok: web.json_response({"ok": ok})

    async def user(self, request: web.Request) -> web.Response:
        if request.content_type != "application/json":  # a form, in the address of a GET
            return self.answer(True)
        asked = await request.json()
        self.asked.append(asked)
        if asked["username"] == "slow":
            await self.hangs.wait()
        return self.answer(self.passwords.get(asked["username"]) == asked["password"])

    async def acl(self, request: web.Request) -> web.Response:
        asked = await request.json()
        return web.json_response({"ok": asked["topic"] in self.readable})

    def plugins(self, **settings: Any) -> dict[str, dict[str, Any]]:
        where = {"host": "127.0.0.1", "port": self.port, **settings}
        return {"amqtt.contrib.http.UserAuthHttpPlugin": where}

    @property
    def logins(self) -> list[str]:
        return [asked["username"] for asked in self.asked]


@pytest.fixture
async def backend() -> AsyncIterator[Backend]:
    backend = Backend()
    app = web.Application()
    for method in ("GET", "POST"):
        app.router.add_route(method, "/user", backend.user)
        app.router.add_route(method, "/acl", backend.acl)
    runner = web.AppRunner(app, shutdown_timeout=0.1)
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0)
    await site.start()
    backend.port = runner.addresses[0][1]
    yield backend
    backend.hangs.set()
    await runner.cleanup()


def bob(client_id: str = "c1", password: str = PASSWORD) -> Connect:
    return Connect(client_id, username="bob", password=password.encode())


async def test_http(backend: Backend) -> None:
    topics = {"amqtt.contrib.http.TopicAuthHttpPlugin": next(iter(backend.plugins().values()))}
    async with running(backend.plugins() | topics) as rig:
        assert await rig.login.authenticate(bob(), HOST) == Identity("bob", "c1")
        assert backend.asked[-1] == {"username": "bob", "password": PASSWORD, "client_id": "c1"}
        wrong = await rig.login.authenticate(bob(password="wrong"), HOST)
        assert wrong == Refusal(ReasonCode.NOT_AUTHORIZED, "refused by UserAuthHttpPlugin")
        who = Identity("bob", "c1")
        assert await decided(rig, who, Action.RECEIVE, "b/c")
        assert not await decided(rig, who, Action.PUBLISH, "a")


@pytest.mark.timed
async def test_a_server_that_hangs_holds_up_nobody_else(backend: Backend, tmp_path: Path) -> None:
    async with running(backend.plugins(), plugin_timeout=0.5) as rig:
        slow = [
            asyncio.ensure_future(
                rig.login.authenticate(connect_of("slow", b"%d" % n), f"10.0.0.{n}:1")
            )
            for n in range(20)
        ]
        await until(lambda: backend.logins.count("slow") == 20)
        began = time.monotonic()
        assert await rig.login.authenticate(bob(), HOST) == Identity("bob", "c1")
        assert time.monotonic() - began < 0.4
        answers = await asyncio.gather(*slow)
        assert {code_of(answer) for answer in answers} == {ReasonCode.SERVER_UNAVAILABLE}
        assert time.monotonic() - began < 2
        # That is not remembered, and no guess.
        backend.hangs.set()
        answer = await rig.login.authenticate(connect_of("slow", b"1"), "10.0.0.1:1")
        assert code_of(answer) == ReasonCode.NOT_AUTHORIZED


async def test_so_many_at_once_and_no_more(
    backend: Backend, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logins_module, "MAX_LOGINS", 3)
    async with running(backend.plugins(), plugin_timeout=5.0) as rig:
        asks = asyncio.gather(
            *(
                rig.login.authenticate(connect_of("slow", b"%d" % n), f"10.0.0.{n}:1")
                for n in range(10)
            )
        )
        await until(lambda: len(backend.asked) >= 3)
        assert len(backend.asked) == 3
        answers = await asks
        assert {code_of(answer) for answer in answers} == {ReasonCode.SERVER_UNAVAILABLE}


async def test_answers_hold_for_a_while_a_no_shorter_and_none_across_a_reload(
    backend: Backend, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = asyncio.get_running_loop()
    clock, ahead = loop.time, 0.0
    monkeypatch.setattr(loop, "time", lambda: clock() + ahead)
    users = tmp_path / "users.passwd"
    users.touch(0o600)
    async with running(backend.plugins(), users=users, answers=CachePolicy(600, 200)) as rig:

        async def ask(password: str = PASSWORD, client_id: str = "c1") -> ReasonCode:
            return code_of(await rig.login.authenticate(bob(client_id, password), HOST))

        for _ in range(3):
            assert await ask() == ReasonCode.SUCCESS
            assert await ask("wrong") == ReasonCode.NOT_AUTHORIZED
        assert len(backend.asked) == 2
        assert await ask(client_id="c2") == ReasonCode.SUCCESS  # which is another question
        assert len(backend.asked) == 3
        backend.passwords["bob"] = "wrong"
        ahead += 250
        assert await ask() == ReasonCode.SUCCESS  # held
        assert await ask("wrong") == ReasonCode.SUCCESS  # the no has ended
        rig.files.reload()
        assert await ask() == ReasonCode.NOT_AUTHORIZED
        ahead += 650
        backend.passwords["bob"] = PASSWORD
        assert await ask("wrong") == ReasonCode.NOT_AUTHORIZED  # the yes has ended


async def test_what_is_kept_is_bounded_and_holds_no_password(backend: Backend) -> None:
    async with running(backend.plugins(), answers=CachePolicy(60, 60, size=10)) as rig:
        asks = [rig.login.authenticate(bob(f"c{number}"), HOST) for number in range(30)]
        await asyncio.gather(*asks)
        logins = rig.frame.logins
        assert len(logins._known) == 10 and not logins._asking
        assert PASSWORD not in repr(logins._known)


async def test_the_same_login_many_times_at_once_is_one_question(backend: Backend) -> None:
    async with running(backend.plugins()) as rig:
        answers = await asyncio.gather(*(rig.login.authenticate(bob(), HOST) for _ in range(50)))
        assert set(answers) == {Identity("bob", "c1")}
        assert len(backend.asked) == 1


async def test_wrong_passwords_for_plugins_are_guesses_too(backend: Backend) -> None:
    async with running(backend.plugins()) as rig:
        rig.files.throttle._allowed = 5
        answers = [
            await rig.login.authenticate(bob(password=str(number)), f"{HOST}{number}")
            for number in range(8)
        ]
        assert [code_of(answer) for answer in answers[:5]] == [ReasonCode.NOT_AUTHORIZED] * 5
        while rig.files.throttle.reserve(HOST, logins_module.QUEUE, max_wait=60.0) is not None:
            pass
        asked = len(backend.asked)
        assert code_of(await rig.login.authenticate(bob(), HOST)) == ReasonCode.SERVER_BUSY
        assert len(backend.asked) == asked
        assert code_of(await rig.login.authenticate(bob(), "10.0.0.9:1")) == ReasonCode.SUCCESS


async def test_what_plugins_noted_of_a_login_is_there_again() -> None:
    async with running({own(Login): {}}, answers=CachePolicy()) as rig:
        for client_id in ("c1", "c1"):
            connect = bob(client_id)
            assert isinstance(await rig.login.authenticate(connect, HOST), Identity)
        first = Login.seen
        assert len(first) == 1
        view = rig.frame._views._logins.get(HOST)
        assert view is None or view.attributes == {"test.login": 1}


@pytest.mark.parametrize("mode", ["GET", "POST"])
async def test_a_password_is_in_no_error(
    backend: Backend, mode: str, caplog: pytest.LogCaptureFixture
) -> None:
    """aiohttp's errors name the address that was asked, and a password may be a part of it."""
    settings = {"request_method": mode.lower(), "params_mode": "form"}
    caplog.set_level("DEBUG", logger="appliance")
    backend.answer = lambda ok: web.Response(text="<html>", content_type="text/html")

    async with running(backend.plugins(**settings)) as rig:
        answer = await rig.login.authenticate(bob(), HOST)
        assert code_of(answer) == ReasonCode.SERVER_UNAVAILABLE
        assert isinstance(answer, Refusal)
    for text in (answer.reason, caplog.text):
        assert "ContentTypeError" in text
        assert PASSWORD not in text
        assert "word%3F" not in text and "ss/word" not in text and "ss%2Fword" not in text


def test_secrets_of_plugin_settings_are_found() -> None:
    plugins = {"x.Y": {"secret_key": SECRET, "connection": f"sqlite://me:{SECRET}@h", "port": 1}}
    assert set(secrets_in(plugins)) == {SECRET}


async def test_a_setting_that_is_wrong_is_told_without_its_secret() -> None:
    plugins = {"amqtt.contrib.jwt.UserAuthJwtPlugin": {"secret_key": [SECRET], "user_claim": 5}}
    pytest.importorskip("jwt")
    with pytest.raises(PluginSettingsError) as caught:
        async with running(plugins, secrets=secrets_in(plugins)):
            pass
    assert "UserAuthJwtPlugin" in str(caught.value)
    assert SECRET not in str(caught.value)
    assert caught.value.__cause__ is None


# --- SQL -----------------------------------------------------------------------------------------


async def test_sql(tmp_path: Path) -> None:
    pytest.importorskip("aiosqlite", reason="the test's database: pip install aiosqlite")
    from amqtt.contexts import Action as AmqttAction
    from amqtt.contrib.auth_db.managers import TopicManager, UserManager

    connection = f"sqlite+aiosqlite:///{tmp_path}/users.db"
    settings = {"connection": connection, "sync_schema": True}
    plugins: dict[str, dict[str, Any]] = {
        "amqtt.contrib.auth_db.UserAuthDBPlugin": {**settings, "hash_schemes": ["argon2"]},
        "amqtt.contrib.auth_db.TopicAuthDBPlugin": settings,
    }
    async with running(plugins) as rig:
        async with UserManager(connection) as users, TopicManager(connection) as topics:
            await users.create_user_auth("bob", PASSWORD)
            await topics.create_topic_auth("bob")
            await topics.add_allowed_topic("bob", "a/b", AmqttAction.PUBLISH)
        await check_only_bob(rig)
        assert await decided(rig, Identity("bob", "c1"), Action.PUBLISH, "a/b")
        assert not await decided(rig, Identity("bob", "c1"), Action.PUBLISH, "a/c")


# --- LDAP ----------------------------------------------------------------------------------------


class Directory:
    """python-ldap as far as amqtt uses it: what it calls waits, and gives nobody else a turn."""

    def __init__(self) -> None:
        self.gate = threading.Event()
        self.gate.set()
        self.searches = 0
        self.threads: set[int] = set()

    def initialize(self, server: str) -> Directory:
        return self

    def simple_bind_s(self, dn: str, password: str) -> None:
        if dn.startswith("cn=bob") and password != PASSWORD:
            raise InvalidCredentialsError

    def search_s(
        self, base: str, scope: int, wanted: str, attributes: list[str]
    ) -> list[tuple[str, dict[str, list[bytes]]]]:
        self.searches += 1
        self.threads.add(threading.get_ident())
        self.gate.wait(10)
        if wanted != "(uid=bob)":
            return []
        return [("cn=bob", {"pub": [b"a/#"], "sub": [b"b/#"]})]


class LdapError(Exception):
    pass


class InvalidCredentialsError(LdapError):
    pass


@pytest.fixture
def directory(monkeypatch: pytest.MonkeyPatch) -> Iterator[Directory]:
    directory = Directory()
    ldap: Any = ModuleType("ldap")
    ldap.initialize = directory.initialize
    ldap.VERSION3, ldap.SCOPE_SUBTREE = 3, 2
    ldap.LDAPError, ldap.INVALID_CREDENTIALS = LdapError, InvalidCredentialsError
    monkeypatch.setitem(sys.modules, "ldap", ldap)
    monkeypatch.delitem(sys.modules, "amqtt.contrib.ldap", raising=False)
    yield directory
    directory.gate.set()
    sys.modules.pop("amqtt.contrib.ldap", None)


LDAP = {
    "server": "ldap://localhost",
    "base_dn": "dc=robot",
    "user_attribute": "uid",
    "bind_dn": "cn=reader",
    "bind_password": "x",
}


async def test_ldap(directory: Directory) -> None:
    attributes = {
        "publish_attribute": "pub",
        "subscribe_attribute": "sub",
        "receive_attribute": "sub",
    }
    plugins = {
        "amqtt.contrib.ldap.UserAuthLdapPlugin": LDAP,
        "amqtt.contrib.ldap.TopicAuthLdapPlugin": LDAP | attributes,
    }
    async with running(plugins) as rig:
        await check_only_bob(rig)
        assert await decided(rig, Identity("bob", "c1"), Action.PUBLISH, "a/b")
        assert not await decided(rig, Identity("bob", "c1"), Action.PUBLISH, "b/c")
        assert threading.get_ident() not in directory.threads


async def test_a_directory_that_hangs_does_not_stop_the_loop(directory: Directory) -> None:
    plugins = {"amqtt.contrib.ldap.UserAuthLdapPlugin": LDAP, own(Login): {}}
    async with running(plugins, plugin_timeout=5.0) as rig:
        directory.gate.clear()
        asks = asyncio.gather(
            *(rig.login.authenticate(bob(f"c{number}"), HOST) for number in range(10))
        )
        rounds = 0  # of the loop, which goes on while the directory does not
        while not asks.done():
            await asyncio.sleep(0.005)
            rounds += 1
        assert rounds > 3
        assert {code_of(answer) for answer in await asks} == {ReasonCode.SERVER_UNAVAILABLE}
        await until(lambda: directory.searches >= 1)
        assert directory.searches == 1
        directory.gate.set()
        rig.frame._guard.timeout = PATIENCE
        assert await rig.login.authenticate(bob(), HOST) == Identity("bob", "c1")
        # Those who had stopped waiting are not asked about any more.
        assert directory.searches == 2


async def test_amqtts_password_file_is_hashed_in_a_thread(tmp_path: Path) -> None:
    from pwdlib.hashers.argon2 import Argon2Hasher

    path = tmp_path / "passwords"
    path.write_text(f"bob:{Argon2Hasher().hash(PASSWORD)}\n", encoding="utf-8")
    name = "amqtt.plugins.authentication.FileAuthPlugin"
    async with running({name: {"password_file": str(path)}}) as rig:
        threads: list[str] = []
        [plugin] = rig.frame.plugins_manager._auth_plugins
        authenticate = plugin.authenticate

        async def noted(**arguments: Any) -> Any:
            threads.append(threading.current_thread().name)
            return await authenticate(**arguments)

        plugin.authenticate = noted  # type: ignore[method-assign]
        assert await rig.login.authenticate(bob(), HOST) == Identity("bob", "c1")
        assert threads == ["FileAuthPlugin"]
