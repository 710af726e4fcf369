"""The broker as amqtt's: its own plugins unchanged, and its own client, on our data path."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import ssl
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any, ClassVar

import amqtt.broker
import pytest
import yaml
from amqtt.broker import BrokerContext, RetainedApplicationMessage
from amqtt.client import MQTTClient
from amqtt.contexts import Action as AmqttAction
from amqtt.contexts import BaseContext, BrokerConfig
from amqtt.errors import BrokerError, ConnectError
from amqtt.mqtt.connect import ConnectPacket
from amqtt.mqtt.publish import PublishPacket
from amqtt.plugins.base import BaseAuthPlugin, BasePlugin, BaseTopicPlugin
from amqtt.session import ApplicationMessage
from amqtt.session import Session as AmqttSession
from argon2 import PasswordHasher
from transitions import MachineError
from waiting import PATIENCE, until

from appliance import certs
from appliance.access import AccessFileError, FileAccess, LoginPolicy, Passwords
from appliance.app.main import App
from appliance.broker import client as network_client
from appliance.broker.broker import Broker
from appliance.broker.counters import COST_PER_TURN
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.broker.values import Action, Decision, Identity, Refusal
from appliance.config import Settings, load
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Connect, Publish, Subscription, Will
from appliance.mqtt.reason import ReasonCode
from appliance.net.listeners import Admission, Listeners, ListenerSettings
from appliance.plugins import (
    ApplianceBroker,
    CachePolicy,
    PluginSettingsError,
    access,
    configuration,
    events,
    plugin_kinds,
)
from appliance.store import MemoryStore

FILE_AUTH = "amqtt.plugins.authentication.FileAuthPlugin"
ANONYMOUS = "amqtt.plugins.authentication.AnonymousAuthPlugin"
ACL = "amqtt.plugins.topic_checking.TopicAccessControlListPlugin"
TABOO = "amqtt.plugins.topic_checking.TopicTabooPlugin"
EVENT_LOGGER = "amqtt.plugins.logging_amqtt.EventLoggerPlugin"
PACKET_LOGGER = "amqtt.plugins.logging_amqtt.PacketLoggerPlugin"

#: Seconds that anything here may take; far more than it does.
#: Seconds that plugins get where a test waits for them in vain.
SHORT = 0.1

FAST = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)

Told = list[tuple[str, dict[str, Any]]]


# --- plugins -------------------------------------------------------------------------------------


class Recorder(BasePlugin[BrokerContext]):
    """Has a handler for every event, and keeps what it is told."""

    told: ClassVar[Told] = []
    contexts: ClassVar[list[BrokerContext]] = []

    def __init__(self, context: BrokerContext) -> None:
        super().__init__(context)
        self.contexts.append(context)

    async def close(self) -> None:
        self.told.append(("close", {}))


def _handler(event: str) -> Callable[..., Awaitable[None]]:
    async def handle(self: Recorder, **arguments: Any) -> None:
        self.told.append((event, arguments))

    return handle


for _event in [*amqtt.broker.BrokerEvents, "mqtt_packet_received", "mqtt_packet_sent"]:
    setattr(Recorder, f"on_{_event}", _handler(str(_event)))


class LifeCycle(BasePlugin[BrokerContext]):
    """Listens to nothing that clients do."""

    async def on_broker_pre_start(self) -> None:
        Recorder.told.append(("started", {}))


class Slow(BasePlugin[BrokerContext]):
    """Never gets done with an event."""

    async def on_broker_message_received(self, **arguments: Any) -> None:
        await asyncio.Event().wait()

    async def on_broker_pre_shutdown(self) -> None:
        await asyncio.Event().wait()


class Broken(BasePlugin[BrokerContext]):
    async def on_broker_client_connected(self, **arguments: Any) -> None:
        raise RuntimeError("the handler is broken")

    async def close(self) -> None:
        raise RuntimeError("cannot close")


class Login(BaseAuthPlugin):
    """Answers as configured."""

    seen: ClassVar[list[AmqttSession]] = []

    async def authenticate(self, *, session: AmqttSession) -> bool | None:
        self.seen.append(session)
        session.attributes["test.login"] = len(self.seen)
        answer = self.config.answer
        if answer == "raise":
            raise RuntimeError("no database")
        if answer == "hang":
            await asyncio.Event().wait()
        return {"yes": True, "no": False}.get(answer)

    @dataclass
    class Config:
        answer: str = "yes"


class Gate(BaseTopicPlugin):
    """A topic plugin that has to wait before it answers, and can change its mind."""

    asked: ClassVar[list[tuple[str | None, str | None, AmqttAction | None]]] = []
    answers: ClassVar[dict[str, Any]] = {}
    attributes: ClassVar[list[dict[str, Any]]] = []
    delay: ClassVar[float] = 0.0

    async def topic_filtering(
        self,
        *,
        session: AmqttSession | None = None,
        topic: str | None = None,
        action: AmqttAction | None = None,
    ) -> bool | None:
        assert session is not None
        task = asyncio.current_task()
        if self.config.waits:
            await asyncio.sleep(self.delay)
        if task is not None or not self.config.waits:
            self.asked.append((session.username, topic, action))
            self.attributes.append(session.attributes)
        answer = self.answers.get(topic or "", True)
        if isinstance(answer, Exception):
            raise answer
        if answer == "hang":
            await asyncio.Event().wait()
        return answer  # type: ignore[no-any-return]

    @dataclass
    class Config:
        waits: bool = True


class Unfinished(BasePlugin[BrokerContext]):
    """Cannot be made without its setting."""

    def __init__(self, context: BaseContext) -> None:
        super().__init__(context)
        raise ValueError("it wants a database")


class NotAPlugin:
    pass


def own(plugin: type) -> str:
    return f"{__name__}.{plugin.__name__}"


@pytest.fixture(autouse=True)
def _clean() -> Iterator[None]:
    kept: list[Any] = [
        Recorder.told,
        Recorder.contexts,
        Login.seen,
        Gate.asked,
        Gate.answers,
        Gate.attributes,
    ]
    for each in kept:
        each.clear()
    yield
    for each in kept:
        each.clear()


# --- the rig -------------------------------------------------------------------------------------


@dataclass
class Rig:
    """A broker that listens, and clients that are disconnected at the end."""

    frame: ApplianceBroker
    broker: Broker
    files: FileAccess
    login: LoginPolicy
    port: int = 0
    clients: list[MQTTClient] = field(default_factory=list)

    @property
    def context(self) -> BrokerContext:
        context = self.frame.plugins_manager.context
        assert isinstance(context, BrokerContext)
        return context

    async def connect(
        self, user: str = "", client_id: str = "", clean: bool = True, **config: Any
    ) -> MQTTClient:
        settings: dict[str, Any] = {"auto_reconnect": False, "plugins": {}, **config}
        client = MQTTClient(client_id=client_id or None, config=settings)
        at = f"{user}@" if user else ""
        connecting = client.connect(f"mqtt://{at}127.0.0.1:{self.port}", cleansession=clean)
        try:
            await asyncio.wait_for(connecting, PATIENCE)
        except ConnectError:
            handler = client._handler
            if handler is not None and handler.writer is not None:
                await handler.writer.close()  # amqtt's client leaves it open
            raise
        self.clients.append(client)
        return client


def lines(path: Path, *lines: str) -> Path:
    path.write_text("".join(line + "\n" for line in lines))
    return path


@contextlib.asynccontextmanager
async def running(
    plugins: dict[str, dict[str, Any]],
    *,
    users: Path | None = None,
    acl: Path | None = None,
    anonymous: bool = False,
    plugin_timeout: float = PATIENCE,
    answers: CachePolicy = CachePolicy(0.0, 0.0),  # noqa: B008 (it is frozen)
    secrets: Iterable[str] = (),
) -> AsyncIterator[Rig]:
    files = FileAccess(users, acl, "robot", anonymous)
    broker = Broker(files, MemoryStore())
    broker.tick(asyncio.get_running_loop().time())

    async def listen() -> None:
        [(_, rig.port)] = await listeners.start([ListenerSettings("127.0.0.1", 0, None)])

    config = configuration([("127.0.0.1:0", False)], 100, plugins)
    frame = ApplianceBroker(
        broker,
        files,
        config,
        listen,
        lambda: listeners.stop(),
        plugin_timeout,
        answers=answers,
        secrets=secrets,
    )
    login = LoginPolicy(files, plugins=frame.logins)
    listeners = Listeners(
        broker,
        login.authenticate,
        login.exchange,
        Admission(100, PATIENCE),
    )
    rig = Rig(frame, broker, files, login)
    try:
        await frame.start()
        yield rig
    finally:
        for client in rig.clients:
            with contextlib.suppress(Exception):  # amqtt's client, when the broker has gone
                await asyncio.wait_for(client.disconnect(), 1)
        if frame.transitions.state == "started":
            await frame.shutdown()
        await listeners.stop()
        files.close()


async def receive(client: MQTTClient) -> ApplicationMessage:
    message = await client.deliver_message(timeout_duration=PATIENCE)
    assert message is not None
    return message


async def nothing_more(client: MQTTClient, other: MQTTClient) -> None:
    """What `other` publishes now is the next that the client receives."""
    await other.publish("test/end", b"end", qos=1)
    assert (await receive(client)).topic == "test/end"


async def refused(connecting: Awaitable[object]) -> int | None:
    with pytest.raises(ConnectError) as error:
        await connecting
    return error.value.return_code


def told(event: str) -> list[dict[str, Any]]:
    return [arguments for name, arguments in Recorder.told if name == event]


def connect_of(user: str | None, password: bytes | None = None, **more: Any) -> Connect:
    return Connect("c1", username=user, password=password, **more)


@pytest.fixture
def amqtt_users(tmp_path: Path) -> dict[str, dict[str, Any]]:
    """amqtt's plugin with a password file as its documentation has it: bob and eve."""
    file = lines(
        tmp_path / "amqtt.passwd", f"bob:{FAST.hash('secret')}", f"eve:{FAST.hash('apple')}"
    )
    return {FILE_AUTH: {"password_file": str(file)}}


@pytest.fixture
def users(tmp_path: Path) -> Path:
    path = tmp_path / "users.passwd"
    path.touch()
    passwords = Passwords.load(path)
    passwords.set("ann", b"file")
    passwords.save()
    return path


OPEN: dict[str, dict[str, Any]] = {ANONYMOUS: {"allow_anonymous": True}}


# --- the data path under amqtt's client ----------------------------------------------------------


@pytest.mark.parametrize("qos", [0, 1, 2])
async def test_messages_go_both_ways(amqtt_users: dict[str, Any], qos: int) -> None:
    async with running(amqtt_users) as rig:
        bob, eve = await rig.connect("bob:secret"), await rig.connect("eve:apple")
        for client, other in ((bob, eve), (eve, bob)):
            await client.subscribe([("a/+", qos)])
            await other.publish("a/b", b"hello", qos=qos)
            message = await receive(client)
            assert (message.topic, message.data, message.qos) == ("a/b", b"hello", qos)
            await client.unsubscribe(["a/+"])


async def test_retained_and_will(amqtt_users: dict[str, Any]) -> None:
    async with running(amqtt_users) as rig:
        bob = await rig.connect(
            "bob:secret",
            will={"topic": "bob/state", "message": "gone", "qos": 1, "retain": False},
        )
        await bob.publish("a/kept", b"kept", qos=1, retain=True)
        eve = await rig.connect("eve:apple")
        await eve.subscribe([("a/#", 1), ("bob/#", 1)])
        message = await receive(eve)
        assert (message.topic, message.data, message.retain) == ("a/kept", b"kept", True)
        session = next(s for s in rig.broker.sessions.values() if s.will is not None)
        session.link.close(ReasonCode.UNSPECIFIED_ERROR, "pulled out")  # type: ignore[union-attr]
        rig.broker.flush()
        message = await receive(eve)
        assert (message.topic, message.data) == ("bob/state", b"gone")


async def test_a_session_is_continued(amqtt_users: dict[str, Any]) -> None:
    async with running({**amqtt_users, own(Recorder): {}}) as rig:
        bob = await rig.connect("bob:secret", "b1", clean=False)
        await bob.subscribe([("a/b", 1)])
        first = rig.context.get_session("b1")
        assert first is not None
        first.attributes["test.note"] = "x"
        await bob.disconnect()
        await until(lambda: first.transitions.state == "disconnected")
        eve = await rig.connect("eve:apple")
        await eve.publish("a/b", b"meanwhile", qos=1)
        bob = await rig.connect("bob:secret", "b1", clean=False)
        assert (await receive(bob)).data == b"meanwhile"
        second = rig.context.get_session("b1")
        assert second is not None
        assert (second.parent, second.attributes) == (1, {"test.note": "x"})


# --- logins --------------------------------------------------------------------------------------


async def test_file_auth_plugin(amqtt_users: dict[str, Any]) -> None:
    async with running(amqtt_users) as rig:
        assert rig.broker.observer is None  # the data path pays nothing for it
        await rig.connect("bob:secret")
        for user in ("bob:wrong", "ann:file", ""):
            assert await refused(rig.connect(user)) == 5, user
        assert [str(s.identity).split()[-1] for s in clients(rig)] == ["'bob')"]


def clients(rig: Rig) -> list[Any]:
    return [session for session in rig.broker.sessions.values() if session.identity is not None]


async def test_the_users_file_decides_about_its_users(
    amqtt_users: dict[str, Any], users: Path
) -> None:
    both = {**amqtt_users, own(Login): {"answer": "yes"}}
    async with running(both, users=users) as rig:
        who = await rig.login.authenticate(connect_of("ann", b"file"), "127.0.0.1:1")
        assert who == Identity("ann", "c1")
        assert Login.seen == []
        wrong = await rig.login.authenticate(connect_of("ann", b"x"), "127.0.0.1:1")
        assert isinstance(wrong, Refusal) and wrong.code == ReasonCode.NOT_AUTHORIZED
        assert Login.seen == []
        who = await rig.login.authenticate(connect_of("bob", b"secret"), "127.0.0.1:1")
        assert who == Identity("bob", "c1")


async def test_without_plugins_the_files_decide(users: Path) -> None:
    async with running({}, users=users) as rig:
        assert rig.broker.access is rig.files
        assert rig.broker.observer is None
        await rig.connect("ann:file")
        assert await refused(rig.connect("ann:wrong")) == 5
    async with running({own(LifeCycle): {}}, users=users) as rig:  # none that authenticates
        assert rig.broker.observer is None
        assert Recorder.told == [("started", {})]
        await rig.connect("ann:file")
        assert await refused(rig.connect("bob:secret")) == 5


@pytest.mark.parametrize(
    ("user", "anonymous", "answer", "admitted"),
    [
        (None, True, "no", True),
        (None, False, "no", False),
        (None, False, "none", False),
        (None, False, "yes", True),
        ("bob", True, "no", False),
        ("bob", False, "none", False),
    ],
)
async def test_who_answers(user: str | None, anonymous: bool, answer: str, admitted: bool) -> None:
    async with running({own(Login): {"answer": answer}}, anonymous=anonymous) as rig:
        who = await rig.login.authenticate(connect_of(user, b"x"), "127.0.0.1:1")
        if admitted:
            assert who == Identity(user, "c1")
        else:
            assert isinstance(who, Refusal) and who.code == ReasonCode.NOT_AUTHORIZED
            assert "Login" in who.reason


@pytest.mark.parametrize(
    ("settings", "user", "identity"),
    [
        # A name that nobody vouches for gets nobody's rights.
        ({"allow_anonymous": True}, "admin", Identity(None, "c1")),
        ({"allow_anonymous": True}, None, Identity(None, "c1")),
        ({"allow_anonymous": False}, "admin", Identity(None, "c1")),
        ({"allow_anonymous": False}, None, None),
    ],
)
async def test_anonymous_plugin(
    settings: dict[str, Any], user: str | None, identity: Identity | None
) -> None:
    async with running({ANONYMOUS: settings}) as rig:
        who = await rig.login.authenticate(connect_of(user, b"x"), "127.0.0.1:1")
        if identity is None:
            assert isinstance(who, Refusal) and who.code == ReasonCode.NOT_AUTHORIZED
        else:
            assert who == identity


async def test_a_password_beside_the_anonymous_plugin(amqtt_users: dict[str, Any]) -> None:
    async with running({**OPEN, **amqtt_users}) as rig:
        ask = rig.login.authenticate
        assert await ask(connect_of("bob", b"secret"), "127.0.0.1:1") == Identity("bob", "c1")
        assert await ask(connect_of(None), "127.0.0.1:1") == Identity(None, "c1")
        assert isinstance(await ask(connect_of("bob", b"no"), "127.0.0.1:1"), Refusal)


async def test_what_a_plugin_sees_of_a_login() -> None:
    async with running({own(Login): {}}) as rig:
        tls = ssl.SSLObject.__new__(ssl.SSLObject)
        tls.getpeercert = lambda binary_form=False: None  # type: ignore[method-assign]
        will = Will("bob/state", b"gone", 1, True)
        connect = connect_of("bob", b"secret", keep_alive=7, version=4, will=will)
        await rig.login.authenticate(connect, "[::1]:1234", tls)
        await rig.login.authenticate(
            connect_of("bob", None, properties={Property.SESSION_EXPIRY_INTERVAL: 9}), "[::1]:1"
        )
        seen, other = Login.seen
        assert (seen.client_id, seen.username, seen.password) == ("c1", "bob", "secret")
        assert (seen.remote_address, seen.remote_port, seen.ssl_object) == ("::1", 1234, tls)
        assert (seen.keep_alive, seen.clean_session, seen.is_anonymous) == (7, True, False)
        assert (seen.will_flag, seen.will_topic, seen.will_message) == (True, "bob/state", b"gone")
        assert (seen.will_qos, seen.will_retain) == (1, True)
        assert (other.clean_session, other.will_flag, other.password) == (False, False, None)


async def test_a_password_that_is_not_text() -> None:
    async with running({own(Login): {}}) as rig:
        who = await rig.login.authenticate(connect_of("bob", b"\xff"), "127.0.0.1:1")
        assert isinstance(who, Refusal) and "UTF-8" in who.reason


async def test_a_plugin_that_raises(caplog: pytest.LogCaptureFixture) -> None:
    async with running({own(Login): {"answer": "raise"}}) as rig:
        for _ in range(3):
            assert await refused(rig.connect("bob:secret")) == 3
    errors = [record for record in caplog.records if record.levelno == logging.ERROR]
    assert ["Traceback" in record.getMessage() for record in errors] == [True]
    assert "no database" in caplog.text


async def test_a_plugin_that_hangs() -> None:
    plugins = {own(Login): {"answer": "hang"}}
    async with running(plugins, plugin_timeout=SHORT) as rig:
        who = await rig.login.authenticate(connect_of("bob", b"x"), "127.0.0.1:1")
        assert isinstance(who, Refusal)
        assert who == Refusal(ReasonCode.SERVER_UNAVAILABLE, "Login said nothing within 0.1 s")
        assert await refused(rig.connect("bob:x")) == 3


async def test_a_wrong_password_touches_nothing(amqtt_users: dict[str, Any]) -> None:
    async with running({**amqtt_users, own(Recorder): {}}) as rig:
        bob = await rig.connect("bob:secret", "b1")
        await bob.subscribe([("test/end", 1)])
        session = rig.broker.sessions["b1"]
        assert await refused(rig.connect("bob:wrong", "b1")) == 5
        assert await refused(rig.connect("eve:apple", "b1")) == 2  # hers is another user's
        assert rig.broker.sessions["b1"] is session
        await nothing_more(bob, bob)
        assert [e["client_id"] for e in told("broker_client_connected")] == ["b1"]
        assert told("broker_client_disconnected") == []


# --- topics --------------------------------------------------------------------------------------


async def test_topic_acl_plugin(amqtt_users: dict[str, Any]) -> None:
    rules = {
        "publish_acl": {"bob": ["a/+"], "eve": ["test/end"]},
        "acl": {"bob": [], "eve": ["a/#", "test/end"]},
    }
    with pytest.warns(DeprecationWarning, match="acl"):
        running_broker = running({**amqtt_users, ACL: rules})
        rig = await running_broker.__aenter__()
    try:
        assert rig.broker.observer is None
        bob, eve = await rig.connect("bob:secret"), await rig.connect("eve:apple")
        assert await bob.subscribe([("a/b", 1)]) == [0x80]
        assert await eve.subscribe([("a/#", 1), ("c", 1), ("test/end", 1)]) == [1, 0x80, 1]
        await bob.publish("a/b/c", b"no", qos=1)
        await bob.publish("a/b", b"yes", qos=1)
        assert (await receive(eve)).data == b"yes"
        await nothing_more(eve, eve)
    finally:
        await running_broker.__aexit__(None, None, None)


async def test_files_and_plugins_must_both_allow(tmp_path: Path, users: Path) -> None:
    acl = lines(
        tmp_path / "acl.conf", "user ann", "topic a/#", "topic prohibited", "topic test/end"
    )
    async with running({TABOO: {}}, users=users, acl=acl) as rig:
        ann = await rig.connect("ann:file")
        codes = await ann.subscribe([("a/b", 0), ("b", 0), ("prohibited", 0), ("test/end", 0)])
        assert codes == [0, 0x80, 0x80, 0]
        for topic in ("b", "prohibited", "a/b"):
            await ann.publish(topic, b"x", qos=1)
        assert (await receive(ann)).topic == "a/b"
        decide = rig.broker.access.decide
        identity = Identity("ann", next(iter(clients(rig))).client_id)
        assert "TopicTabooPlugin" in decide(identity, Action.PUBLISH, "prohibited").reason
        assert "acl.conf" in decide(identity, Action.PUBLISH, "a/b").reason


async def test_what_a_topic_plugin_is_asked_for_the_first_time_waits_for_its_answer(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(Gate, "delay", 0.05)
    Gate.answers["no"] = False
    async with running({**OPEN, own(Gate): {}, own(Login): {}}) as rig:
        client = await rig.connect("bob:x", "b1")
        subscriptions = [("a", 1), ("no", 1), ("wild/#", 1), ("test/end", 1)]
        assert await client.subscribe(subscriptions) == [1, 0x80, 1, 1]
        assert "Gate has to wait" in caplog.text
        # Right away, each on a topic that nobody has asked about, and in their order.
        for topic in ("wild/1", "a", "wild/2"):
            await client.publish(topic, topic.encode(), qos=1)
        assert [(await receive(client)).data for _ in range(3)] == [b"wild/1", b"a", b"wild/2"]
        await nothing_more(client, client)
        assert all(seen == {"test.login": 1} for seen in Gate.attributes)


async def test_what_waits_for_a_plugin_keeps_nobody_else() -> None:
    Gate.answers["hang"] = "hang"
    async with running({**OPEN, own(Gate): {}}, plugin_timeout=5.0) as rig:
        ann, bob = await rig.connect("ann:x", "a1"), await rig.connect("bob:x", "b1")
        assert await ann.subscribe([("a", 1), ("test/end", 1)]) == [1, 1]
        hung = asyncio.create_task(bob.subscribe([("hang", 1), ("a", 1)]))
        await until(lambda: ("bob", "hang", AmqttAction.SUBSCRIBE) in Gate.asked)
        await ann.publish("a", b"meanwhile", qos=1)
        assert (await receive(ann)).data == b"meanwhile"
        assert not hung.done()
        codes = await hung  # it is refused when the plugin has had its time, and the rest goes on
        assert codes[0] == 0x80
        await bob.publish("a", b"behind", qos=1)
        assert (await receive(ann)).data == b"behind"


@pytest.mark.parametrize("strangers", [1, 4])
async def test_who_may_receive_it_holds_nobody_elses_message(strangers: int) -> None:
    """A new client that subscribes to all is asked about, for ever: who publishes goes on."""
    async with running({**OPEN, own(Gate): {}}, answers=CachePolicy(600.0, 600.0)) as rig:
        ann, bob = await rig.connect("ann:x", "a1"), await rig.connect("bob:x", "b1")
        await bob.subscribe([("x", 1)])
        # His own right is waited for, however long its answer takes; the right to read is it, too.
        await bob.publish("x", b"own", qos=1)
        await ann.publish("x", b"first", qos=1)
        newcomers = [await rig.connect("eve:x", f"e{n}") for n in range(strangers)]
        for eve in newcomers:
            await eve.subscribe([("#", 1)])
        Gate.answers["x"] = "hang"
        for n in range(4):
            await asyncio.wait_for(ann.publish("x", b"%d" % n, qos=1), PATIENCE / 2)
        asked = [query for query in rig.frame._access._asked if query[2] == "x"]
        newcomers_ids = {f"e{n}" for n in range(strangers)}
        assert {who.client_id for who, _, _ in asked} == newcomers_ids, "nothing is known yet"
        heard = [(await receive(bob)).data for _ in range(6)]
        assert heard == [b"own", b"first", b"0", b"1", b"2", b"3"]


async def test_who_may_receive_it_is_waited_for_for_a_moment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """So that a plugin that answers soon lets a new subscriber have the first message, too."""
    monkeypatch.setattr(network_client, "RIGHTS_PATIENCE", PATIENCE)
    monkeypatch.setattr(Gate, "delay", 0.02)
    async with running({**OPEN, own(Gate): {}}, answers=CachePolicy(600.0, 600.0)) as rig:
        ann, eve = await rig.connect("ann:x", "a1"), await rig.connect("eve:x", "e1")
        await eve.subscribe([("#", 1)])
        await ann.publish("x", b"first", qos=1)
        assert (await receive(eve)).data == b"first"


async def test_who_leaves_while_a_plugin_is_asked_is_forgotten() -> None:
    Gate.answers["hang"] = "hang"
    async with running({**OPEN, own(Gate): {}}, plugin_timeout=1.0) as rig:
        bob = await rig.connect("bob:x", "b1")
        hung = asyncio.create_task(bob.subscribe([("hang", 1)]))
        await until(lambda: ("bob", "hang", AmqttAction.SUBSCRIBE) in Gate.asked)
        rig.broker.sessions["b1"].close_link(ReasonCode.ADMINISTRATIVE_ACTION, "by the test")
        await until(lambda: not rig.broker.clients)
        await until(lambda: rig.frame._access._asked == {})
        assert rig.frame._access._waiting == {}
        hung.cancel()


async def test_more_questions_than_there_is_room_for_wait_in_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(access, "MAX_QUERIES", 2)
    monkeypatch.setattr(Gate, "delay", 0.02)
    async with running({**OPEN, own(Gate): {}}) as rig:
        several = [await rig.connect(f"user{n}:x", f"c{n}") for n in range(6)]
        codes = await asyncio.gather(*(each.subscribe([("a", 1)]) for each in several))
        assert codes == [[1]] * 6
        assert rig.frame._access._waiting_for_room == {}


async def test_one_user_leaves_room_for_the_questions_of_others() -> None:
    Gate.answers["hang"] = "hang"
    async with running({own(Gate): {}}, plugin_timeout=SHORT) as rig:
        decide, asked = rig.frame._access.decide, rig.frame._access._asked
        for number in range(access.MAX_QUERIES):
            decide(Identity("eve", f"e{number}"), Action.PUBLISH, "hang")
        assert len(asked) == access.MAX_USER_QUERIES
        decide(Identity("ann", "a1"), Action.PUBLISH, "hang")
        assert len(asked) == access.MAX_USER_QUERIES + 1
        await until(lambda: asked == {})


async def test_an_answer_in_the_background_that_turns_to_no(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with running({own(Gate): {}}) as rig:
        decide, asked = rig.frame._access.decide, rig.frame._access._asked
        me, epoch = Identity("bob", "b1"), rig.broker.router.epoch

        async def answered() -> Decision:
            await until(lambda: asked == {})
            return decide(me, Action.PUBLISH, "a")

        assert not decide(me, Action.PUBLISH, "a")
        assert not decide(me, Action.PUBLISH, "a")
        assert len(asked) == 1  # one question, however often it comes up
        assert await answered()
        assert rig.broker.router.epoch > epoch
        assert len(Gate.asked) == 1
        monkeypatch.setattr(CachePolicy, "topic_lifetime", lambda self, allowed: 0.0)
        Gate.answers["a"] = None
        assert decide(me, Action.PUBLISH, "a")  # holds while it is asked again
        assert "Gate" in (await answered()).reason
        Gate.answers["a"] = True
        assert not decide(me, Action.PUBLISH, "a")
        assert await answered()
        monkeypatch.setattr(access, "STALE_VERDICT_LIFETIME", 0.0)
        assert not await answered()  # too old to hold


@pytest.mark.parametrize("waits", [False, True])
async def test_what_the_rules_of_the_files_take_is_counted(
    monkeypatch: pytest.MonkeyPatch, waits: bool
) -> None:
    """Once for each time that they are asked, whatever the plugins say to it."""
    async with running({own(Gate): {"waits": waits}}) as rig:
        allowed = Decision(True, "by many rules", cost=300)
        monkeypatch.setattr(rig.files, "decide", lambda *question: allowed)
        me, counters = Identity("bob", "b1"), rig.broker.counters
        Gate.answers["no"] = False
        for topic in ("yes", "no") * 2:
            begun = counters.cost
            rig.broker.router.decide(me, Action.SUBSCRIBE, topic)
            assert counters.cost - begun == 300
            begun = counters.cost
            rig.frame._access.is_pending((me, Action.SUBSCRIBE, topic), lambda: None)
            assert counters.cost - begun == 300
            await until(lambda: rig.frame._access._asked == {})


async def test_questions_and_answers_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "MAX_QUERIES", 3)
    monkeypatch.setattr(access, "MAX_CLIENT_QUERIES", 2)
    async with running({own(Gate): {}}, answers=CachePolicy(size=2)) as rig:
        frame_access = rig.frame._access
        asked = [("bob", 0), ("bob", 1), ("bob", 2), ("eve", 0), ("eve", 1), ("ann", 0)]
        reasons = [
            frame_access.decide(Identity(user, user), Action.PUBLISH, f"{n}").reason
            for user, n in asked
        ]
        too_many = [False, False, True, False, True, True]
        assert ["too many" in reason for reason in reasons] == too_many
        await until(lambda: frame_access._asked == {})
        assert len(frame_access._verdicts) == 2


async def test_a_topic_plugin_that_hangs_or_raises(caplog: pytest.LogCaptureFixture) -> None:
    Gate.answers.update({"hang": "hang", "raise": RuntimeError("no database")})
    async with running({own(Gate): {}}, plugin_timeout=PATIENCE) as rig:
        frame_access = rig.frame._access
        me = Identity("bob", "b1")
        for topic in ("raise", "hang"):
            assert not frame_access.decide(me, Action.PUBLISH, topic)
            await until(lambda: frame_access._asked == {})
            rig.frame._guard.timeout = SHORT
        assert "nothing within" in frame_access.decide(me, Action.PUBLISH, "hang").reason
        assert "no database" in frame_access.decide(me, Action.PUBLISH, "raise").reason
    assert caplog.text.count("Traceback") == 1


async def test_a_plugin_that_raises_on_the_spot_is_asked_again_in_a_task() -> None:
    Gate.answers["raise"] = RuntimeError("no task")
    async with running({own(Gate): {"waits": False}}) as rig:
        frame_access = rig.frame._access
        me = Identity("bob", "b1")
        assert not frame_access.decide(me, Action.PUBLISH, "raise")
        assert frame_access.decide(me, Action.PUBLISH, "a")  # the others are still decided at once
        await until(lambda: frame_access._asked == {})
        assert "no task" in frame_access.decide(me, Action.PUBLISH, "raise").reason


async def test_plugins_may_change_their_mind(amqtt_users: dict[str, Any]) -> None:
    async with running({**amqtt_users, own(Gate): {"waits": False}}) as rig:
        bob = await rig.connect("bob:secret", "b1")
        await bob.subscribe([("a", 1), ("test/end", 1)])
        await bob.publish("a", b"1", qos=1)
        assert (await receive(bob)).data == b"1"
        Gate.answers["a"] = False
        epoch = rig.broker.access.epoch
        rig.frame._timer.cancel()  # type: ignore[union-attr]
        rig.frame._tick()  # in place of 10 s
        assert rig.broker.access.epoch > epoch
        await bob.publish("a", b"2", qos=1)
        await nothing_more(bob, bob)


# --- events --------------------------------------------------------------------------------------


async def test_every_event_with_its_arguments(amqtt_users: dict[str, Any]) -> None:
    async with running({**amqtt_users, own(Recorder): {}, EVENT_LOGGER: {}}) as rig:
        bob = await rig.connect("bob:secret", "b1")
        await bob.subscribe([("a/#", 1)])
        await bob.publish("a/b", b"x", qos=2)
        await bob.publish("a/c", b"kept", qos=1, retain=True)
        await bob.publish("a/c", b"", qos=1, retain=True)
        await bob.publish("nothing/kept", b"", retain=True)
        await bob.unsubscribe(["a/#"])
        await bob.disconnect()
        await until(lambda: bool(told("broker_client_disconnected")))
    names = [name for name, _ in Recorder.told]
    assert names[:2] == ["broker_pre_start", "broker_post_start"]
    assert names[-3:] == ["broker_pre_shutdown", "broker_post_shutdown", "close"]
    assert [told(name) for name in (*names[:2], *names[-3:])] == [[{}]] * 5

    [connected], [disconnected] = (
        told(f"broker_client_{what}") for what in ("connected", "disconnected")
    )
    session = connected["client_session"]
    assert connected == disconnected == {"client_id": "b1", "client_session": session}
    assert isinstance(session, AmqttSession)
    assert (session.client_id, session.username, session.password) == ("b1", "bob", "secret")
    assert (session.remote_address, session.transitions.state) == ("127.0.0.1", "disconnected")
    assert told("broker_client_subscribed") == [{"client_id": "b1", "topic": "a/#", "qos": 1}]
    assert told("broker_client_unsubscribed") == [{"client_id": "b1", "topic": "a/#"}]

    for event in ("broker_message_received", "broker_message_broadcast"):
        assert [set(arguments) for arguments in told(event)] == [{"client_id", "message"}] * 4
        messages = [arguments["message"] for arguments in told(event)]
        assert all(isinstance(message, ApplicationMessage) for message in messages)
        assert [(m.topic, m.data, m.qos, m.retain) for m in messages] == [
            ("a/b", b"x", 2, False),
            ("a/c", b"kept", 1, True),
            ("a/c", b"", 1, True),
            ("nothing/kept", b"", 0, True),
        ]
        assert [m.publish_packet.retain_flag for m in messages] == [False, True, True, True]

    kept, cleared = told("broker_retained_message")
    assert set(kept) == {"client_id", "retained_message"}
    assert (kept["client_id"], cleared["client_id"]) == (None, None)
    message = kept["retained_message"]
    assert isinstance(message, RetainedApplicationMessage)
    assert (message.topic, message.data, message.qos) == ("a/c", b"kept", 1)
    assert message.source_session is session
    assert cleared["retained_message"].data == b""

    connect, *publishes = told("mqtt_packet_received")
    assert set(connect) == {"packet"}
    assert isinstance(connect["packet"], ConnectPacket)
    assert connect["packet"].username == "bob"
    assert "secret" not in repr(connect["packet"])
    assert all(set(arguments) == {"packet", "session"} for arguments in publishes)
    assert [type(arguments["packet"]) for arguments in publishes] == [PublishPacket] * 4
    assert publishes[0]["packet"].topic_name == "a/b"
    assert publishes[0]["session"] is session
    assert told("mqtt_packet_sent") == []


async def test_a_message_that_is_not_allowed_is_received_and_not_broadcast(
    amqtt_users: dict[str, Any],
) -> None:
    async with running({**amqtt_users, own(Recorder): {}}) as rig:
        await rig.connect("bob:secret", "b1")
        bob = rig.clients[0]
        for qos in (0, 1, 2):
            await bob.publish("$no", b"x", qos=qos)
        await rig.frame.plugins_manager.wait_fired_events()
        topics = [arguments["message"].topic for arguments in told("broker_message_received")]
        assert topics == ["$no"] * 3
        assert told("broker_message_broadcast") == []


async def test_what_the_appliance_publishes_is_no_event(amqtt_users: dict[str, Any]) -> None:
    async with running({**amqtt_users, own(Recorder): {}}) as rig:
        await rig.context.broadcast_message("a", b"x")
        await rig.context.retain_message("b", b"x")
        rig.broker.publish(Message("$SYS/x", b"1", 0, True), rig.frame._inside)  # type: ignore[arg-type]
        # Nor what a part of it does as a user, such as a link to a fleet's broker.
        name = "_upstream.fleet"
        session = rig.broker.attach(name, InsideLink(), Identity("bob", name))
        assert not rig.broker.subscribe(session, Subscription("c"))[0]
        assert rig.broker.publish(Message("c", b"x"), session) == 0
        assert rig.broker.publish(Message("$no", b"x"), session) == ReasonCode.NOT_AUTHORIZED
        assert rig.context.get_session(name) is None and not list(rig.context.sessions)
        assert not rig.context.subscriptions
        with pytest.raises(BrokerError, match="no session"):
            await rig.context.add_subscription(name, "d", 0)
        assert told("broker_client_subscribed") == []
        await rig.frame.plugins_manager.wait_fired_events()
        assert told("broker_message_received") == []
        [arguments] = told("broker_retained_message")
        assert arguments["retained_message"].source_session is None


async def test_amqtts_packet_logger(
    amqtt_users: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "amqtt.broker.plugins")
    async with running({**amqtt_users, PACKET_LOGGER: {}, EVENT_LOGGER: {}}) as rig:
        bob = await rig.connect("bob:secret", "b1")
        await bob.publish("a/b", b"x", qos=1)
    assert "b1 <-in-- PublishPacket" in caplog.text
    assert "on_broker_message_received' EVENT FIRED" in caplog.text
    assert "secret" not in caplog.text


async def test_slow_plugins_lose_events_and_delay_nothing(
    amqtt_users: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(events, "MAX_EVENTS", 40)  # half of which is lent to one user
    async with running({**amqtt_users, own(Slow): {}}) as rig:
        bob = await rig.connect("bob:secret", "b1")
        rig.frame._guard.timeout = SHORT
        await bob.subscribe([("a", 1)])
        for _ in range(50):
            await bob.publish("a", b"x", qos=1)
            await receive(bob)
        assert len(rig.frame.plugins_manager._fired_events) == 20
    assert caplog.text.count("events were dropped") == 1
    assert "still work on broker_pre_shutdown after 0.1 s" in caplog.text
    assert rig.frame.transitions.state == "stopped"


async def test_events_are_bounded_in_bytes(
    amqtt_users: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "MAX_EVENT_BYTES", 2000)  # half of which is lent to one user
    async with running({**amqtt_users, own(Slow): {}}) as rig:
        bob = await rig.connect("bob:secret", "b1")
        rig.frame._guard.timeout = SHORT
        for _ in range(5):
            await bob.publish("a", bytes(400), qos=1)
        assert len(rig.frame.plugins_manager._fired_events) == 2


async def test_a_users_flood_leaves_the_events_of_others(
    amqtt_users: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "MAX_EVENTS", 40)
    both = {own(Slow): {}, own(Recorder): {}}
    async with running({**amqtt_users, **both}) as rig:
        eve = await rig.connect("eve:apple", "e1")
        await rig.frame.plugins_manager.wait_fired_events()
        Recorder.told.clear()
        await rig.connect("bob:secret", "b1")
        rig.frame._guard.timeout = SHORT
        bob = rig.broker.sessions["b1"]
        for number in range(100):  # before a task of a handler has had its turn
            rig.broker.publish(Message(f"{number}", b"x", retain=True), bob)
        await until(lambda: bool(told("broker_message_received")))
        # With five handlers for each, before half of what may wait for plugins is his.
        assert 3 <= len(told("broker_message_received")) <= 5
        await eve.disconnect()
        await until(
            lambda: "e1" in map(itemgetter("client_id"), told("broker_client_disconnected"))
        )
        assert rig.frame._events._pending_of  # those that the slow plugin has begun with
        for task in list(rig.frame.plugins_manager._fired_events):
            task.cancel()
        await until(lambda: not rig.frame._events._pending_of)
        assert (rig.frame._events._pending.events, rig.frame._events._pending.bytes) == (0, 0)


@pytest.mark.parametrize("allowed", [True, False])
async def test_the_events_of_a_message_are_counted_as_work(
    amqtt_users: dict[str, Any], tmp_path: Path, allowed: bool
) -> None:
    """amqtt's objects take ten times as long as the message, and each handler is a task."""
    acl = lines(tmp_path / "acl.conf", "pattern readwrite yes")
    topic = "yes" if allowed else "no"
    costs = {}
    for plugin in (Slow, Recorder, LifeCycle):
        plugins = {**amqtt_users, own(plugin): {}}
        async with running(plugins, acl=acl) as rig:
            await rig.connect("bob:secret", "b1")
            rig.frame._guard.timeout = SHORT
            bob = rig.broker.sessions["b1"]
            for retain in (False, True):
                rig.broker.publish(Message(topic, b"x", retain=retain), bob)  # finds the route
                begun = rig.broker.counters.cost
                rig.broker.publish(Message(topic, b"x", retain=retain), bob)
                costs[plugin, retain] = rig.broker.counters.cost - begun
            for task in list(rig.frame.plugins_manager._fired_events):
                task.cancel()
    added = {
        (kind, retain): costs[kind, retain] - costs[LifeCycle, retain] for kind, retain in costs
    }
    one = events.MESSAGE_COST + events.HANDLER_COST
    assert added[Slow, False] == added[Slow, True] == one
    handlers = 3 if allowed else 2  # received as a packet, as a message, broadcast
    several = events.MESSAGE_COST + handlers * events.HANDLER_COST
    assert added[Recorder, False] == several
    assert added[Recorder, True] == several + (one if allowed else 0)


@pytest.mark.parametrize("qos", [0, 1])
async def test_a_client_that_publishes_much_takes_turns_with_the_events_of_that(
    amqtt_users: dict[str, Any], qos: int
) -> None:
    async with running({**amqtt_users, own(Recorder): {}}) as rig:
        await rig.connect("bob:secret", "b1")
        client = rig.broker.sessions["b1"].link._client  # type: ignore[union-attr]
        client.receive(Publish("a", b"x", qos, packet_id=1 if qos else 0).encode(4) * 1000)
        per_message = events.MESSAGE_COST + 3 * events.HANDLER_COST
        begun = len(rig.frame.plugins_manager._fired_events) // 3
        assert 0 < begun <= COST_PER_TURN // per_message + 1
        await until(lambda: len(told("broker_message_received")) == 1000)


async def test_a_broken_handler_is_told_once(
    amqtt_users: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    async with running({**amqtt_users, own(Broken): {}}) as rig:
        for _ in range(3):
            await rig.connect("bob:secret")
        await rig.frame.plugins_manager.wait_fired_events()
    assert caplog.text.count("RuntimeError: the handler is broken") == 1
    assert caplog.text.count("RuntimeError: cannot close") == 1
    assert rig.frame.transitions.state == "stopped"


# --- BrokerContext -------------------------------------------------------------------------------


async def test_context_messages(amqtt_users: dict[str, Any]) -> None:
    async with running(amqtt_users) as rig:
        context = rig.context
        bob = await rig.connect("bob:secret", "b1")
        await bob.subscribe([("a", 2), ("test/end", 1)])
        for qos in (None, 1):  # None: what the subscription says
            await context.broadcast_message("a", b"x", qos)
            assert (await receive(bob)).qos == (2 if qos is None else qos)
        await context.retain_message("kept", bytearray(b"x"), 1)
        await nothing_more(bob, bob)  # retained, and not delivered
        retained = context.retained_messages
        assert (len(retained), list(retained)) == (1, ["kept"])
        assert (retained["kept"].data, retained["kept"].qos) == (b"x", 1)
        retained["other"] = RetainedApplicationMessage(None, "other", b"y", 0)
        await bob.subscribe([("other", 1)])
        assert (await receive(bob)).data == b"y"
        await context.retain_message("kept", b"")
        del retained["other"]
        assert (len(retained), "kept" in retained, len(rig.broker.retained)) == (0, False, 0)
        with pytest.raises(KeyError):
            del retained["other"]
        for sending in (context.broadcast_message("a/#", b""), context.retain_message("a/#", b"x")):
            with pytest.raises(BrokerError, match="a/#"):
                await sending


async def test_context_sessions(amqtt_users: dict[str, Any]) -> None:
    async with running(amqtt_users) as rig:
        context = rig.context
        bob = await rig.connect("bob:secret", "b1")
        await rig.connect("eve:apple", "e1")
        await bob.subscribe([("a/#", 1)])
        session = context.get_session("b1")
        assert session is not None
        assert {s.client_id for s in context.sessions} == {"b1", "e1"}
        assert (session.username, session.is_anonymous) == ("bob", False)
        assert (session.clean_session, session.remote_address) == (True, "127.0.0.1")
        assert (session.transitions.state, context.get_session("b1")) == ("connected", session)
        assert context.subscriptions == {"a/#": [(session, 1)]}
        assert context.get_session("_amqtt") is None  # our own are no clients
        assert context.get_session("nobody") is None
        await context.add_subscription("e1", "b", 2)
        assert context.subscriptions["b"] == [(context.get_session("e1"), 2)]
        await bob.disconnect()
        await until(lambda: context.get_session("b1") is None)
        rig.frame._views.purge()
        assert "b1" not in rig.frame._views._known


async def test_a_session_made_by_a_plugin_waits_for_its_client(
    amqtt_users: dict[str, Any], tmp_path: Path
) -> None:
    acl = lines(
        tmp_path / "acl.conf", "user bob", "topic a", "topic test/end", "user eve", "topic #"
    )
    async with running({**amqtt_users, own(Recorder): {}}, acl=acl) as rig:
        context = rig.context
        await context.add_subscription("b1", None, None)
        session = context.get_session("b1")
        assert session is not None and session.transitions.state == "disconnected"
        await context.add_subscription("b1", "a", 1)
        await context.add_subscription("b1", "b", 1)
        assert set(context.subscriptions) == {"a", "b"}
        eve = await rig.connect("eve:apple")
        for topic in ("a", "b"):
            await eve.publish(topic, b"queued", qos=1)
        assert await refused(rig.connect("bob:wrong", "b1", clean=False)) == 5
        bob = await rig.connect("bob:secret", "b1", clean=False)
        assert (await receive(bob)).topic == "a"
        await bob.subscribe([("test/end", 1)])
        await eve.publish("b", b"not his", qos=1)
        await eve.publish("a", b"his", qos=1)
        assert (await receive(bob)).data == b"his"
        assert await refused(rig.connect("eve:apple", "b1", clean=False)) == 2  # it has an owner
        # amqtt tells only what clients do
        assert [e["topic"] for e in told("broker_client_subscribed")] == ["test/end"]


async def test_no_session_can_be_made_for_a_client_of_our_own(amqtt_users: dict[str, Any]) -> None:
    async with running(amqtt_users) as rig:
        with pytest.raises(BrokerError, match="_amqtt"):
            await rig.context.add_subscription("_amqtt", "a", 1)


# --- life cycle ----------------------------------------------------------------------------------


async def test_life_cycle(amqtt_users: dict[str, Any]) -> None:
    async with running({**amqtt_users, own(Recorder): {}}) as rig:
        frame = rig.frame
        assert isinstance(frame, amqtt.broker.Broker)
        assert isinstance(frame.config, BrokerConfig)
        assert frame.listeners_config["127.0.0.1:0"].max_connections == 100
        assert frame.transitions.state == "started"
        with pytest.raises(BrokerError, match="can't be started"):
            await frame.start()
        bob = await rig.connect("bob:secret", "b1", clean=False)
        await bob.subscribe([("a", 1)])
        await bob.publish("kept", b"x", qos=1, retain=True)
        await frame.shutdown()
        assert frame.transitions.state == "stopped"
        assert (rig.broker.observer, rig.broker.access) == (None, rig.files)
        with pytest.raises(MachineError):
            await frame.shutdown()
        with pytest.raises(BrokerError, match="not running"):
            await rig.context.broadcast_message("a", b"x")
        await frame.start()  # as amqtt's, it can be started again; ours has kept its state
        assert "a" in rig.broker.sessions["b1"].subscriptions
        assert "kept" in rig.context.retained_messages
        await rig.connect("bob:secret", "b1", clean=False)
    assert len(told("broker_pre_start")) == len(told("broker_post_shutdown")) == 2


async def test_a_start_that_fails() -> None:
    files = FileAccess(None, None, "robot")
    broker = Broker(files, MemoryStore())

    async def listen() -> None:
        raise OSError("the port is taken")

    async def hang_up() -> None:
        raise AssertionError("it never listened")

    config = configuration([], 1, {own(Recorder): {}})
    frame = ApplianceBroker(broker, files, config, listen, hang_up)
    with pytest.raises(OSError, match="the port is taken"):
        await frame.start()
    assert frame.transitions.state == "not_started"
    assert [name for name, _ in Recorder.told] == ["broker_pre_start", "close"]
    assert (broker.sessions, broker.observer, broker.access) == ({}, None, files)
    with pytest.raises(BrokerError):
        await frame.start()
    files.close()


@pytest.mark.parametrize(
    ("plugins", "message"),
    [
        ({"no_such.Plugin": {}}, "no_such"),
        ({"amqtt.plugins.No": {}}, "amqtt.plugins.No"),
        ({own(NotAPlugin): {}}, "not a subclass"),
        ({own(Unfinished): {}}, "it wants a database"),
        ({FILE_AUTH: {"pasword_file": "x"}}, "pasword_file"),
        ({FILE_AUTH: {"password_file": "/nowhere/users"}}, "/nowhere/users"),
    ],
)
async def test_plugins_that_cannot_be_loaded(
    plugins: dict[str, dict[str, Any]], message: str
) -> None:
    with pytest.raises(PluginSettingsError, match=message) as error:
        async with running(plugins):
            pass
    assert "broker.plugins" in str(error.value)


def test_kinds_of_plugins() -> None:
    assert plugin_kinds([]) == (False, False)
    assert plugin_kinds([own(Recorder), FILE_AUTH]) == (True, False)
    assert plugin_kinds([TABOO, EVENT_LOGGER]) == (False, True)
    with pytest.raises(PluginSettingsError, match="no_such"):
        plugin_kinds(["no_such.Plugin"])


# --- in the appliance ----------------------------------------------------------------------------


def settings_of(directory: Path, plugins: dict[str, dict[str, Any]], **broker: Any) -> Settings:
    lines(directory / "acl.conf", "topic #", "pattern readwrite #")
    text = yaml.safe_dump(
        {
            "broker": {
                "listeners": [{"bind": "127.0.0.1:0", "tls": "tls" in broker}],
                "plugins": plugins,
                **broker,
            },
            "bridge": {"bus": "none"},
        }
    )
    return load(lines(directory / "appliance.yaml", text))


async def test_the_appliance_without_a_users_file(
    amqtt_users: dict[str, Any], tmp_path: Path
) -> None:
    app = App(settings_of(tmp_path, {**amqtt_users, own(Recorder): {}}))
    await app.start()
    try:
        client = MQTTClient(config={"auto_reconnect": False, "plugins": {}})
        uri = f"mqtt://bob:secret@127.0.0.1:{app.addresses[0][1]}"
        await asyncio.wait_for(client.connect(uri), PATIENCE)
        await client.subscribe([("+/_appliance/state", 1)])
        assert (await receive(client)).data == b"online"
        await app.reload()  # who is known to a plugin stays
        await client.publish("a", b"x", qos=1)
        await client.disconnect()
    finally:
        await app.stop()
    names = [name for name, _ in Recorder.told]
    assert names[:2] == ["broker_pre_start", "broker_post_start"]
    assert names[-3:] == ["broker_pre_shutdown", "broker_post_shutdown", "close"]
    assert len(told("broker_client_disconnected")) == 1


async def test_files_that_no_plugin_stands_for_are_needed(tmp_path: Path) -> None:
    with pytest.raises(AccessFileError, match=r"users\.passwd"):
        await App(settings_of(tmp_path, {own(Recorder): {}})).start()
    settings = settings_of(tmp_path, OPEN)
    settings.broker.acl.unlink()
    with pytest.raises(AccessFileError, match=r"acl\.conf"):
        await App(settings).start()


async def test_clients_of_a_unix_socket(tmp_path: Path) -> None:
    """With any plugin; and each is shown its own login, although all have the same address."""
    path = tmp_path / "mqtt.sock"
    plugins: dict[str, Any] = {own(Login): {}, own(Gate): {}, EVENT_LOGGER: {}}
    app = App(settings_of(tmp_path, plugins, listeners=[{"bind": f"unix:{path}"}]))
    await app.start()
    try:
        ends = [await asyncio.open_unix_connection(path) for _ in range(3)]
        for number, (_, writer) in enumerate(ends):
            writer.write(Connect(f"c{number}", username="bob", password=b"x").encode())
        for reader, _ in ends:
            answer = await asyncio.wait_for(reader.read(100), PATIENCE)
            assert answer[0] == 0x20 and answer[3] == 0, answer
        for _, writer in ends:
            writer.close()
    finally:
        await app.stop()
    assert {session.remote_address for session in Login.seen} == {f"unix:{path}"}
    assert len({session.remote_port for session in Login.seen}) == 3


async def test_plugins_see_the_tls_connection(tmp_path: Path) -> None:
    certs.create_authority(tmp_path)
    certs.issue_server(tmp_path, ["localhost"], [])
    names = {"certificate": "server.crt", "key": "server.key", "ca": "ca.crt"}
    app = App(settings_of(tmp_path, {own(Login): {}}, tls=names))
    await app.start()
    try:
        client = MQTTClient(config={"auto_reconnect": False, "plugins": {}})
        uri = f"mqtts://localhost:{app.addresses[0][1]}"
        connecting = client.connect(uri, cafile=str(tmp_path / "ca.crt"))
        await asyncio.wait_for(connecting, PATIENCE)
        await client.disconnect()
    finally:
        await app.stop()
    [session] = Login.seen
    assert session.ssl_object is not None
    assert session.ssl_object.version() in ("TLSv1.2", "TLSv1.3")
