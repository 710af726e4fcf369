"""Every entry raises an exception once, in an appliance under load: everything else continues.

The entries are found in the sources (`saboteur.all_entries`), so that none is missing. While one
after the other fails, clients of every kind continue their work: a round trip, a message of 300 KB,
a SUBSCRIBE with hundreds of filters, a will, a keep alive, `$SYS`. Each must succeed after each
fault, and a fault may end only a few connections. An entry fails twice, before its work and after
it; afterwards the accounting is right, and nothing is left of clients that are gone.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import struct
import time
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import AsyncMock, Mock

import pytest
import uvloop
import yaml
from amqtt.plugins.base import BasePlugin
from harness import Harness, Peer, check_scheduler, make_contexts
from saboteur import INLINE, SabotageError, Saboteur, all_entries, owner_of
from upstream import test_dial, test_uplink_contained
from waiting import PATIENCE, until

from appliance import config
from appliance.app import main as app_module
from appliance.app.main import App
from appliance.broker.values import Decision
from appliance.management.verbs import LOCAL
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import (
    Connack,
    Connect,
    Disconnect,
    Packet,
    Puback,
    Publish,
    Suback,
    Subscribe,
    Subscription,
    Unsuback,
    Unsubscribe,
    Will,
)
from appliance.mqtt.reason import ReasonCode
from appliance.net import connection as wire
from appliance.net import lingering, listeners, tls
from appliance.net.http import HttpResponse
from appliance.ops.control import ControlError, ask
from appliance.ops.crash import CrashReports
from appliance.ops.sd_notify import Notifier
from appliance.ros import bridge as bridge_module
from appliance.ros.bridge import Bridge, TopicSettings
from appliance.ros.calls.dispatcher import CallError
from appliance.ros.calls.routes import CallRoutes, ParameterSettings, ServiceSettings
from appliance.ros.node import FakeNode
from appliance.ros.topics.rules import CommandRules, OnSilence
from appliance.store import committer, sqlite
from appliance.web.site import WebSite

#: Attempts to pass an entry within PATIENCE: a fault may hit the client that tries.
ATTEMPTS = 3

#: Timeout of a client's step in seconds; then it reconnects.
STEP = 5.0

LARGE = bytes(300_000)
TWIST = "geometry_msgs/msg/Twist"
STRING = "std_msgs/msg/String"
TRIGGER = "std_srvs/srv/Trigger"
DONE = b"\0\1\0\0\1\0\0\0\1\0\0\0\0"


class Listening(BasePlugin):
    """A plugin that hears of clients."""

    async def on_broker_client_connected(self, **_: object) -> None:
        """As amqtt calls it."""


class Actor:
    """A client of the load: it repeats one thing, and reconnects when it is disconnected."""

    clean = True
    keep_alive = 0

    def __init__(self, site: Site, number: int = 0, kind: str = "plain") -> None:
        self.site = site
        self.kind = kind
        self.name = f"{type(self).__name__.lower()}-{kind}-{number}"
        self.done = 0
        self.losses = 0

    async def run(self) -> None:
        # Not until it is cancelled alone: up to Python 3.11 `wait_for` loses a cancellation that
        # comes with the result or the error of what it waits for.
        while not self.site.is_over:
            try:
                peer = await self.site.log_in(self.name, self.kind, keep_alive=self.keep_alive)
                try:
                    await asyncio.wait_for(self.begin(peer), STEP)
                    while not self.site.is_over:
                        await asyncio.wait_for(self.step(peer), STEP)
                        self.done += 1
                finally:
                    peer.hang_up()
            except (OSError, EOFError, AssertionError, asyncio.TimeoutError):
                self.losses += 1
                await asyncio.sleep(0.02)

    async def begin(self, peer: Peer) -> None:
        """Once a connection."""

    async def step(self, peer: Peer) -> None:
        """What it does."""

    async def wait_for(self, peer: Peer, kind: type[Packet]) -> Any:
        while True:
            packet = await peer.receive()
            assert not isinstance(packet, Disconnect), packet
            if isinstance(packet, kind):
                return packet


class Pinger(Actor):
    """A message to itself, and back."""

    payload = b"x"
    pause = 0.01

    async def begin(self, peer: Peer) -> None:
        await peer.send(Subscribe(1, [Subscription(f"load/{self.name}", 1)]))
        await self.wait_for(peer, Suback)

    async def step(self, peer: Peer) -> None:
        await peer.send(Publish(f"load/{self.name}", self.payload, 1, packet_id=7))
        back = await self.wait_for(peer, Publish)
        await peer.send(Puback(back.packet_id, 0))
        await asyncio.sleep(self.pause)


class Large(Pinger):
    """The same, with a message that takes several turns."""

    payload = LARGE
    pause = 0.1


class Subscriber(Actor):
    """Hundreds of filters in one packet, with a session that is stored."""

    async def step(self, peer: Peer) -> None:
        names = [f"load/{self.name}/{n}" for n in range(300)]
        await peer.send(Subscribe(1, [Subscription(name, 1) for name in names]))
        assert len((await self.wait_for(peer, Suback)).reason_codes) == 300
        await peer.send(Unsubscribe(2, names))
        await self.wait_for(peer, Unsuback)
        await asyncio.sleep(0.1)


class Rated(Actor):
    """A subscription with a rate: the last message comes, when it is its turn."""

    async def begin(self, peer: Peer) -> None:
        rate = {Property.USER_PROPERTY: [("max-rate", "50")]}
        await peer.send(Subscribe(1, [Subscription(f"load/{self.name}/+")], rate))
        await self.wait_for(peer, Suback)

    async def step(self, peer: Peer) -> None:
        for payload in (b"first", b"replaced", b"%d" % self.done):
            await peer.send(Publish(f"load/{self.name}/{self.done % 3}", payload))
        while (await self.wait_for(peer, Publish)).payload != b"%d" % self.done:
            pass
        await asyncio.sleep(0.01)


class Willing(Actor):
    """A client whose connection is cut, and its will."""

    async def begin(self, peer: Peer) -> None:
        await peer.send(Subscribe(1, [Subscription(f"will/{self.name}", 1)]))
        await self.wait_for(peer, Suback)

    async def step(self, peer: Peer) -> None:
        will = Will(f"will/{self.name}", b"w", 1)
        leaving = await self.site.log_in(f"{self.name}-leaving", self.kind, will=will)
        leaving.hang_up()
        back = await self.wait_for(peer, Publish)
        await peer.send(Puback(back.packet_id, 0))
        await asyncio.sleep(0.05)


class Silent(Actor):
    """It says nothing, and is disconnected for that."""

    async def step(self, peer: Peer) -> None:
        silent = await self.site.log_in(f"{self.name}-silent", self.kind, keep_alive=1)
        while not isinstance(packet := await silent.receive(), Disconnect):
            pass
        assert packet.reason_code == ReasonCode.KEEP_ALIVE_TIMEOUT
        await asyncio.sleep(0.4)  # longer than the farewell
        silent.hang_up()


class Sys(Actor):
    """`$SYS` goes on."""

    async def begin(self, peer: Peer) -> None:
        await peer.send(Subscribe(1, [Subscription("$SYS/broker/bytes/received", 0)]))

    async def step(self, peer: Peer) -> None:
        await self.wait_for(peer, Publish)


class Keeper(Actor):
    """A session that expires, and a retained message that does; both are stored."""

    async def step(self, peer: Peer) -> None:
        lasting = {Property.SESSION_EXPIRY_INTERVAL: 1}
        other = await self.site.log_in(f"{self.name}-{self.done % 3}", properties=lasting)
        await other.send(Subscribe(1, [Subscription(f"kept/{self.name}", 1)]))
        await self.wait_for(other, Suback)
        soon = {Property.MESSAGE_EXPIRY_INTERVAL: 1}
        await peer.send(
            Publish(f"kept/{self.name}/{self.done}", b"k", 1, True, False, 9, properties=soon)
        )
        await self.wait_for(peer, Puback)
        other.hang_up()
        await asyncio.sleep(0.3)


class Manager(Actor):
    """It asks who is connected, and is answered."""

    async def begin(self, peer: Peer) -> None:
        replies = f"$CONTROL/appliance/v1/clients/_reply/{self.name}/#"
        await peer.send(Subscribe(1, [Subscription(replies)]))
        await self.wait_for(peer, Suback)

    async def step(self, peer: Peer) -> None:
        call = f"$CONTROL/appliance/v1/clients/_call/{self.done}"
        await peer.send(Publish(call, b'{"limit": 5}'))
        assert (await self.wait_for(peer, Publish)).topic.endswith(f"/{self.done}")
        await asyncio.sleep(0.05)


class Site:
    """The appliance, its clients, and a bus of which the test has the other nodes in hand."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.server, self.client = make_contexts(directory / "certs")
        self.actors: list[Actor] = []
        self.hands: list[Peer] = []
        self.victims = 0
        self.readers: list[asyncio.Task[None]] = []
        self.is_over = False
        self.stack = contextlib.AsyncExitStack()

    async def start(self) -> None:
        loop = asyncio.get_running_loop()
        file = self.directory / "appliance.yaml"
        file.write_text(yaml.safe_dump(SETTINGS))
        (self.directory / "acl.conf").write_text(
            "topic #\ntopic read $SYS/#\ntopic readwrite $CONTROL/#\n"
        )
        (self.directory / "users.passwd").touch(0o600)
        settings = config.load(file)
        crashes = CrashReports(self.directory / "crashes", settings)
        crashes.start()
        self.stack.callback(crashes.stop)
        self.app = App(settings, crashes=crashes)
        await self.app.start()
        self.stack.push_async_callback(self.app.stop)
        self.broker = self.app.broker
        self.faults = self.broker.faults
        self.scheduler = self.app._listeners.scheduler
        self.app._entries.signal("signal.reload", signal.SIGHUP, self.app._on_hangup)
        self.stack.callback(loop.remove_signal_handler, signal.SIGHUP)
        notify = self.stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        notify.bind(str(self.directory / "notify"))
        notify.setblocking(False)
        self.notifier = Notifier(str(self.directory / "notify"), 0.4)
        self.notifier.start(self.app._entries, lambda: "fine", lambda: True)
        self.stack.callback(self.notifier.close)
        self._start_bridge(loop)
        self.broker.departures.append(lambda session: None)
        kinds: list[tuple[type[Actor], int, str]] = [
            (Pinger, 2, "plain"),
            (Pinger, 1, "tls"),
            (Pinger, 1, "websocket"),
            (Large, 1, "plain"),
            (Large, 1, "tls"),
            (Large, 1, "websocket"),
            (Subscriber, 2, "plain"),
            (Rated, 1, "plain"),
            (Willing, 1, "plain"),
            (Willing, 1, "tls"),
            (Silent, 8, "plain"),
            (Silent, 2, "tls"),
            (Sys, 1, "plain"),
            (Keeper, 2, "plain"),
            (Manager, 1, "plain"),
        ]
        for kind, count, how in kinds:
            for number in range(count):
                actor = kind(self, number, how)
                self.actors.append(actor)
                task = loop.create_task(actor.run())
                self.stack.callback(task.cancel)
                await asyncio.sleep(0.1)  # not all at once
        self.stack.callback(self._end)

    def _end(self) -> None:
        self.is_over = True

    def _start_bridge(self, loop: asyncio.AbstractEventLoop) -> None:
        from ros.call_harness import AllTypes

        self.node = FakeNode(types=AllTypes())
        rules = CommandRules(on_silence=OnSilence(0.1, disconnect=False))
        calls = CallRoutes(
            services=(
                ServiceSettings(("/srv/*",), "r2d2{ros}", timeout=0.2),
                ServiceSettings(("/given",), "r2d2{ros}", to="mqtt", type=TRIGGER, timeout=0.1),
            ),
            parameters=(ParameterSettings(("/n/*",), "r2d2{node}/_param"),),
        )
        routes = [
            TopicSettings("/up", "mqtt", "r2d2/up", type=STRING, encoding="cdr", keep=1000),
            TopicSettings("/cmd_vel", "ros", "r2d2/cmd_vel", type=TWIST, rules=rules),
            TopicSettings("/down", "ros", "r2d2/down", type=STRING, encoding="cdr"),
        ]
        self.bridge = Bridge(self.node, self.broker, routes, loop, "r2d2", calls, diagnostics=0.1)
        self.bridge.start()
        self.stack.push_async_callback(self.bridge.stop)
        self.up = self.node.add_publisher("/up", STRING)
        self.node.add_subscriber("/cmd_vel", TWIST)
        self.node.add_subscriber("/down", STRING)
        self.node.add_service("/srv/slow", TRIGGER, lambda request, respond: None)
        self.node.add_service("/srv/quick", TRIGGER, lambda request, respond: respond(DONE))

    async def log_in(self, name: str, kind: str = "plain", **options: Any) -> Peer:
        """A client that has logged in."""
        peer = await self.dial(kind)
        try:
            await peer.send(Connect(name, **options))
            connack = await asyncio.wait_for(peer.receive(), STEP)
            assert isinstance(connack, Connack) and not connack.reason_code, connack
        except BaseException:
            peer.hang_up()
            raise
        return peer

    async def dial(self, kind: str = "plain", receive_buffer: int = 0) -> Peer:
        host, port = self.app.addresses[("plain", "tls", "websocket", "web").index(kind)]
        secure = {"ssl": self.client, "server_hostname": "localhost"} if kind == "tls" else {}
        if receive_buffer:
            sock = socket.socket()
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
            sock.setblocking(False)
            await asyncio.get_running_loop().sock_connect(sock, (host, port))
            opened = asyncio.open_connection(sock=sock, **secure)
        else:
            # Not of a socket of ours: when the other side is fast to end the connection, uvloop
            # closes its descriptor, and the socket then closes that of somebody else.
            sock = None
            opened = asyncio.open_connection(host, port, **secure)
        try:
            reader, writer = await asyncio.wait_for(opened, STEP)
        finally:
            if sock is not None:
                sock.detach()  # it is uvloop's alone, for the same reason
        if kind == "websocket":
            return await Framed.upgrade(reader, writer)
        return Peer(reader, writer)

    def protocol(self, name: str) -> Any:
        """The server's end of the client's connection: not of one that it took over, and that is
        still closing."""
        for protocol in self.scheduler.connections:
            client = protocol._client
            session = client.session
            if session is not None and session.client_id == name and session.link is client.output:
                return protocol
        raise AssertionError(f"{name} is not connected")

    async def victim(self, kind: str = "plain", receive_buffer: int = 0) -> tuple[Peer, Any]:
        """A client that nothing but the test wants anything of; each time another one."""
        self.victims += 1
        name = f"victim-{self.victims}"
        peer = await self.dial(kind, receive_buffer)
        self.hands.append(peer)
        await peer.send(Connect(name))
        answer = await asyncio.wait_for(peer.receive(), STEP)
        assert isinstance(answer, Connack) and not answer.reason_code, answer
        return peer, self.protocol(name)

    def drain(self, peer: Peer) -> None:
        """Let the client read on."""

        async def read() -> None:
            with contextlib.suppress(OSError, EOFError, asyncio.TimeoutError):
                await peer.receive_rest()

        self.readers.append(asyncio.get_running_loop().create_task(read()))

    async def stranger(self, kind: str) -> Any:
        """The server's end of a connection on which nothing is sent."""
        peer = await self.dial(kind)
        self.hands.append(peer)
        address = peer.writer.get_extra_info("sockname")

        def ends() -> list[Any]:
            there = [each for each in self.scheduler.connections if each._transport is not None]
            return [e for e in there if e._transport.get_extra_info("peername") == address]

        await until(ends, "the server's end of the connection")
        return ends()[0]

    async def slow(self, kind: str = "plain") -> tuple[Peer, Any]:
        """One that has much to read, and does not."""
        peer, protocol = await self.victim(kind, receive_buffer=4096)
        peer.writer.transport.pause_reading()
        await peer.send(Subscribe(1, [Subscription("flood", 0)]))
        await until(lambda: protocol._client.session.subscriptions, "the victim's subscription")
        for _ in range(200):  # of no more than 32 KiB: larger ones would wait in the session
            self.app._publish("flood", bytes(30_000))
            await asyncio.sleep(0)
        return peer, protocol


class Framed(Peer):
    """A client whose packets go in WebSocket frames."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        inner = asyncio.StreamReader(limit=1 << 24)
        super().__init__(inner, writer)
        self._frames = reader
        self._task = asyncio.ensure_future(self._unpack())

    @classmethod
    async def upgrade(cls, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> Framed:
        writer.write(
            b"GET /mqtt HTTP/1.1\r\nHost: robot\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Protocol: mqtt\r\n\r\n"
        )
        await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), STEP)
        return cls(reader, writer)

    async def _unpack(self) -> None:
        try:
            while True:
                head = await self._frames.readexactly(2)
                size = head[1] & 0x7F
                if size >= 126:
                    size = int.from_bytes(
                        await self._frames.readexactly(2 if size == 126 else 8), "big"
                    )
                payload = await self._frames.readexactly(size)
                if head[0] & 0x0F == 8:
                    break
                self.reader.feed_data(payload)
        except (OSError, EOFError):
            pass
        self.reader.feed_eof()

    @staticmethod
    def frame(data: bytes) -> bytes:
        size = len(data)
        if size < 126:
            head = bytes((0x82, 0x80 | size))
        elif size < 1 << 16:
            head = b"\x82\xfe" + struct.pack(">H", size)
        else:
            head = b"\x82\xff" + struct.pack(">Q", size)
        return head + bytes(4) + data

    async def send(self, *packets: Packet | bytes) -> None:
        for packet in packets:
            data = packet if isinstance(packet, bytes) else packet.encode(5)
            self.writer.write(self.frame(data))
        await asyncio.wait_for(self.writer.drain(), STEP)

    def hang_up(self) -> None:
        self._task.cancel()
        super().hang_up()


SETTINGS = {
    "robot": "r2d2",
    "reload_on_change": False,
    "broker": {
        "listeners": [
            {"bind": "127.0.0.1:0"},
            {"bind": "127.0.0.1:0", "tls": True},
            {"bind": "127.0.0.1:0", "protocol": "websocket"},
            {"bind": "127.0.0.1:0", "protocol": "web"},
        ],
        "tls": {"certificate": "certs/server.crt", "key": "certs/server.key", "ca": "certs/ca.crt"},
        "anonymous": True,
        "sys_interval": "50 ms",
        "audit": {"path": "audit.log"},
        "plugins": {f"{__name__}.Listening": {}},
        "plugin_answers": {"keep": "200 ms"},
        "limits": {"connection_rate": 100_000, "connections_per_address": 1000},
    },
    "bridge": {"bus": "none"},
}


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is waited for comes soon."""
    for module, name, value in (
        (app_module, "TICK", 0.05),
        (app_module, "TASK_RESTART_DELAY", 0.05),
        (wire, "SLOW_AFTER", 0.05),
        (wire, "REVOKED_TIMEOUT", 0.05),
        (lingering, "TIMEOUT", 0.2),
        (listeners, "ACCEPT_PAUSE", 0.05),
        (listeners, "HANDSHAKE_STALL", 0.05),
        (committer, "LINGER", 0.05),
        (sqlite, "CLOCK_CHECK", 0.2),
        (committer, "RETRY", 0.05),
        (bridge_module, "METER_INTERVAL", 0.1),
        (bridge_module, "RETRY", 0.05),
        (bridge_module, "LONGEST_RETRY", 0.1),
    ):
        monkeypatch.setattr(module, name, value)


# --- what it takes to pass an entry --------------------------------------------------------------

Reach = Callable[[Site, pytest.MonkeyPatch], Awaitable[object]]
REACH: dict[str, Reach] = {}
#: Entries that are passed only when others have failed before.
FIRST: dict[str, tuple[str, ...]] = {
    "broker.abandon": ("flush",),
    "broker.end": ("connection.chunk",),
    "client.cut_off": ("connection.chunk", "broker.end"),
    "client.shut": ("connection.chunk", "broker.end"),
    "connection.flush": ("connection.chunk",),
    "listener.reopen": ("listener.accept",),
}


#: Work that does not end while the appliance runs.
ENDLESS = frozenset(("app.task",))


def reach(*names: str) -> Callable[[Reach], Reach]:
    def register(how: Reach) -> Reach:
        REACH.update(dict.fromkeys(names, how))
        return how

    return register


@reach("connection.slow", "connection.pause", "connection.resume")
async def _slow_timer(site: Site, patch: pytest.MonkeyPatch) -> None:
    peer, protocol = await site.slow()
    await until(lambda: protocol._slow_timer is not None or protocol._closing, "a slow client")
    await asyncio.sleep(0.1)
    peer.writer.transport.resume_reading()
    site.drain(peer)


@reach("tls.pause", "tls.resume")
async def _slow_tls(site: Site, patch: pytest.MonkeyPatch) -> None:
    peer, _ = await site.slow("tls")
    peer.writer.transport.resume_reading()
    site.drain(peer)


@reach("websocket.pause", "websocket.resume")
async def _slow_websocket(site: Site, patch: pytest.MonkeyPatch) -> None:
    peer, protocol = await site.victim("websocket", receive_buffer=4096)
    await peer.send(Subscribe(1, [Subscription("flood", 0)]))
    await until(lambda: protocol._client.session.subscriptions, "the victim's subscription")
    peer._task.cancel()
    for _ in range(200):
        site.app._publish("flood", bytes(30_000))
        await asyncio.sleep(0)
    await asyncio.sleep(0.1)
    peer._task = asyncio.ensure_future(peer._unpack())


@reach("websocket.eof", "websocket.lost", "tls.eof", "connection.eof")
async def _leaves(site: Site, patch: pytest.MonkeyPatch) -> None:
    for kind in ("plain", "tls", "websocket"):
        peer = await site.log_in(f"leaves-{kind}", kind)
        peer.writer.close()


@reach("tls.react")
async def _says_much_and_leaves(site: Site, patch: pytest.MonkeyPatch) -> None:
    _, protocol = await site.victim("tls")
    transport = protocol._transport
    transport.pause_reading()
    transport._ended = True  # as when all has come that will, and was not handed on yet
    transport.resume_reading()


@reach("connection.last_turn")
async def _asks_much_and_leaves(site: Site, patch: pytest.MonkeyPatch) -> None:
    peer, protocol = await site.victim()
    protocol._has_more = True  # as when it has more to do than there was time for
    peer.hang_up()


@reach("connection.cut")
async def _does_not_read_to_the_end(site: Site, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(wire, "CLOSE_TIMEOUT", 0.05)
    _, protocol = await site.slow()
    protocol._client.close(ReasonCode.ADMINISTRATIVE_ACTION, "the test says so")
    site.broker.flush()


@reach("tls.cut")
async def _does_not_read_to_the_end_of_tls(site: Site, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(tls, "CLOSE_TIMEOUT", 0.05)
    _, protocol = await site.slow("tls")
    protocol._transport.close()


@reach("connection.revoked")
async def _revoked(site: Site, patch: pytest.MonkeyPatch) -> None:
    _, protocol = await site.victim("tls")
    certificates = SimpleNamespace(refusal=lambda tls: "revoked", username=lambda tls: None)
    with pytest.MonkeyPatch.context() as checked:
        checked.setattr(site.scheduler, "certificates", certificates)
        protocol.check_certificate()


@reach("connection.certificate")
async def _checked(site: Site, patch: pytest.MonkeyPatch) -> None:
    await site.app._listeners.check_certificates()


@reach("connection.login_timeout")
async def _no_connect(site: Site, patch: pytest.MonkeyPatch) -> None:
    stranger = await site.stranger("plain")
    with pytest.MonkeyPatch.context() as hurried:
        hurried.setattr(site.scheduler, "connect_timeout", 0.05)
        stranger.limit_login()  # it alone: another client may take its time


@reach("connection.rested")
async def _rests(site: Site, patch: pytest.MonkeyPatch) -> None:
    _, protocol = await site.victim()
    protocol._rest(0.01)


@reach("connection.look")
async def _looks_whether_all_is_read(site: Site, patch: pytest.MonkeyPatch) -> None:
    _, protocol = await site.victim()
    protocol._schedule_look(0.01)


@reach("connection.abort")
async def _cannot_be_aborted(site: Site, patch: pytest.MonkeyPatch) -> None:
    _, protocol = await site.victim()
    own, protocol._transport = protocol._transport, Mock()
    protocol._transport.abort.side_effect = SabotageError
    protocol.abort()
    protocol._transport = own
    own.abort()


@reach("commit.abandon", "commit.go_on", "commit.resume")
async def _store_fails(site: Site, patch: pytest.MonkeyPatch) -> None:
    store: Any = site.broker.store
    peer, _ = await site.victim()
    with pytest.MonkeyPatch.context() as broken:

        def write(batch: object) -> None:
            raise OSError("no space left")

        broken.setattr(store._committer._writer, "_write", write)
        lasting = {Property.SESSION_EXPIRY_INTERVAL: 60}
        other = await site.dial()
        site.hands.append(other)
        await other.send(Connect("stored", properties=lasting))
        await until(lambda: store.failing, "the store to fail")
    await until(lambda: not store.failing, "the store to go on")
    del peer


@reach("flush.overflow")
async def _overflows(site: Site, patch: pytest.MonkeyPatch) -> None:
    _, protocol = await site.victim()
    site.broker.accounting.overflowed.append(protocol._client.session)
    site.broker.flush()


@reach("broker.guard")
async def _guarded(site: Site, patch: pytest.MonkeyPatch) -> None:
    guard = SimpleNamespace(decide=lambda session: Decision(True, ""), refused=lambda session: None)
    with pytest.MonkeyPatch.context() as guarded:
        guarded.setitem(site.broker.guards, "guarded", [guard])
        site.broker.guards_changed()
        peer, _ = await site.victim()
        await peer.send(Publish("guarded", b"x", 1, packet_id=3))
        assert (await peer.receive()).reason_code == ReasonCode.NOT_AUTHORIZED
    site.broker.guards_changed()


@reach("broker.rules")
async def _rules_change(site: Site, patch: pytest.MonkeyPatch) -> None:
    site.broker.rules_changed()  # which sessions inside the appliance are told


@reach("session.replay")
async def _retained(site: Site, patch: pytest.MonkeyPatch) -> None:
    site.app._publish("r/x", b"x", True)
    peer, _ = await site.victim()
    await peer.send(Subscribe(1, [Subscription("r/#", 1)]))


@reach("listener.stall", "listener.open")
async def _stalls(site: Site, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(listeners, "HANDSHAKES", 1)
    host, port = site.app.addresses[1]
    for _ in range(2):  # they never shake hands
        reader, writer = await asyncio.open_connection(host, port)
        site.hands.append(Peer(reader, writer))


@reach("app.beside", "app.task")
async def _beside(site: Site, patch: pytest.MonkeyPatch) -> None:
    begun = 0

    async def work() -> None:
        nonlocal begun
        begun += 1
        if begun == 1:
            raise SabotageError
        await asyncio.Event().wait()

    site.app._run_in_background(work)


@reach("websocket.made")
async def _websocket(site: Site, patch: pytest.MonkeyPatch) -> None:
    with contextlib.suppress(OSError, EOFError, asyncio.TimeoutError):
        site.hands.append(await site.dial("websocket"))


@reach("http.made", "http.chunk", "http.respond", "http.eof", "http.lost")
async def _browses(site: Site, patch: pytest.MonkeyPatch) -> None:
    peer = await site.dial("web")
    site.hands.append(peer)
    await peer.send(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
    if await peer.reader.read(1):
        peer.writer.close()


@reach("http.pause", "http.resume")
async def _browses_slowly(site: Site, patch: pytest.MonkeyPatch) -> None:
    peer = await site.dial("web", receive_buffer=4096)
    site.hands.append(peer)
    peer.writer.transport.pause_reading()
    large = HttpResponse(200, bytes(8 << 20))
    patch.setattr(WebSite, "respond", AsyncMock(return_value=large))
    faults = site.faults.count
    await peer.send(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
    # What the kernel takes differs by its settings; above this mark the appliance waits.
    await until(
        lambda: site.scheduler.output > wire.OUTPUT_LOW_WATER or site.faults.count > faults,
        "a slow reader",
    )
    peer.writer.transport.resume_reading()
    site.drain(peer)


@reach("http.timeout")
async def _browses_no_more(site: Site, patch: pytest.MonkeyPatch) -> None:
    (await site.stranger("web"))._transport._limit(0.05)


@reach("connection.wait")
async def _waits(site: Site, patch: pytest.MonkeyPatch) -> None:
    _, protocol = await site.victim()
    protocol.wait(0.01)


@reach("clock.full")
async def _fills(site: Site, patch: pytest.MonkeyPatch) -> None:
    _, protocol = await site.victim()
    site.broker.accounting.filled.append((protocol._client.session, "a limit"))


@reach("bridge.sweep")
async def _sweeps(site: Site, patch: pytest.MonkeyPatch) -> None:
    site.bridge._entries.soon("bridge.sweep", lambda: None)


@reach("connection.probe")
async def _probed(site: Site, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(wire, "PROBE_DURATION", 0.05)
    _, protocol = await site.victim()
    protocol.probe()


@reach("connection.withhold")
async def _withheld(site: Site, patch: pytest.MonkeyPatch) -> None:
    _, protocol = await site.victim()
    protocol.withhold(0.01)


@reach("app.certificates")
async def _renews(site: Site, patch: pytest.MonkeyPatch) -> None:
    site.app._certificates_due.set()


@reach("app.announce", "app.reload", "signal.reload")
async def _reloads(site: Site, patch: pytest.MonkeyPatch) -> None:
    os.kill(os.getpid(), signal.SIGHUP)


@reach("control.command", "control.connection")
async def _command(site: Site, patch: pytest.MonkeyPatch) -> None:
    with contextlib.suppress(ControlError):
        await asyncio.to_thread(ask, site.app.settings.control, "status", 5.0)


@reach("loop")
async def _loop(site: Site, patch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise SabotageError

    asyncio.get_running_loop().call_soon(fail)


@reach("bridge.post", "bridge.message", "bridge.drain")
async def _ros_message(site: Site, patch: pytest.MonkeyPatch) -> None:
    # Only a message that comes into an empty mailbox wakes the loop.
    await until(lambda: not site.bridge._mailbox._is_awake, "an empty mailbox")
    site.node.spin()
    for _ in range(200):
        site.up.publish(b"\0\1\0\0\2\0\0\0x\0\0\0")


@reach("bridge.join")
async def _bus_lost(site: Site, patch: pytest.MonkeyPatch) -> None:
    site.node.fail("the test says so")
    await until(lambda: site.node.running, "the bus to be joined again")


@reach("bridge.look", "calls.look")
async def _looks(site: Site, patch: pytest.MonkeyPatch) -> None:
    site.node.spin()


@reach("bridge.announcing")
async def _announces_many(site: Site, patch: pytest.MonkeyPatch) -> None:
    site.bridge._announcements._go_on(iter((None,)), site.bridge._session)


@reach("bridge.live")
async def _watches(site: Site, patch: pytest.MonkeyPatch) -> None:
    site.bridge._live._go_on(iter(()), [], site.bridge._session)


@reach("schemas.make")
async def _bridges_another_type(site: Site, patch: pytest.MonkeyPatch) -> None:
    schemas = site.bridge._schemas
    schemas.replace(())
    schemas.replace(("std_msgs/msg/String",))


@reach("management.change", "management.changed")
async def _manages(site: Site, patch: pytest.MonkeyPatch) -> None:
    with contextlib.suppress(SabotageError, CallError):
        await site.app._verbs.run(LOCAL, "disconnect", {"client": "nobody"})


@reach("actions.look")
async def _looks_at_actions(site: Site, patch: pytest.MonkeyPatch) -> None:
    topics = site.bridge.calls._actions.topics
    action, actions = Mock(ros="/act"), topics._actions
    action.poll_graph.side_effect = SabotageError
    topics.replace([action])
    topics.poll_graph()
    topics.replace(actions)


@reach("actions.task", "actions.end")
async def _action_task(site: Site, patch: pytest.MonkeyPatch) -> None:
    site.bridge.calls._actions._tasks.begin(asyncio.sleep(0))


@reach("bridge.receive")
async def _to_ros(site: Site, patch: pytest.MonkeyPatch) -> None:
    site.app._publish("r2d2/down", b"\0\1\0\0\2\0\0\0x\0\0\0")


@reach("commands.check", "commands.stop")
async def _drives(site: Site, patch: pytest.MonkeyPatch) -> None:
    site.app._publish("r2d2/cmd_vel", b'{"linear": {"x": 1.0}}')


@reach("commands.wait")
async def _first_command(site: Site, patch: pytest.MonkeyPatch) -> None:
    peer, _ = await site.victim()
    await peer.send(Publish("r2d2/cmd_vel", b'{"linear": {"x": 1.0}}', 1, packet_id=3))


@reach("turns.work", "turns.pause", "turns.next")
async def _large_to_ros(site: Site, patch: pytest.MonkeyPatch) -> None:
    text = bytes(5000)
    site.app._publish(
        "r2d2/down", b"\0\1\0\0" + (len(text) + 1).to_bytes(4, "little") + text + b"\0"
    )


@reach("plugins.line", "plugins.wake")
async def _asks_plugins(site: Site, patch: pytest.MonkeyPatch) -> None:
    access: Any = site.broker.access
    with pytest.MonkeyPatch.context() as asked:
        asked.setattr(access, "decide", lambda *question: Decision(False, "", pending=True))
        assert access.is_pending(("nobody", "asks", "this"), lambda: None)


@reach("calls.take", "calls.call", "calls.end", "calls.timeout", "calls.answer", "calls.handle")
async def _call(site: Site, patch: pytest.MonkeyPatch) -> None:
    peer, _ = await site.victim()
    for packet_id, name in enumerate(("slow", "quick"), 3):
        await peer.send(Publish(f"r2d2/srv/{name}/_call/1", b"{}", 1, packet_id=packet_id))


@reach("calls.follow", "parameters.read", "parameters.end")
async def _node_comes(site: Site, patch: pytest.MonkeyPatch) -> None:
    kind = "rcl_interfaces/srv/GetParameters"
    service = site.node.add_service("/n/get_parameters", kind, lambda *_: None)
    await asyncio.sleep(0.05)
    site.node.remote_services.remove(service)
    site.node.spin()


@reach("services.timeout")
async def _ros_asks(site: Site, patch: pytest.MonkeyPatch) -> None:
    site.broker.subscribe(site.app._inside, Subscription("r2d2/given/_request/+", 0))
    site.node.ask("/given", b"\0\1\0\0\0", lambda response: None)


@reach("scheduler.round")
async def _busy(site: Site, patch: pytest.MonkeyPatch) -> None:
    site.scheduler.is_busy()


#: Entries that MQTT load does not pass, and the tests that let them fail.
ELSEWHERE = {
    "bridge.announce": "ros/topics/test_commands.py",
    "bridge.picture": "ros/topics/test_pictures.py",
    "doctor.turn": "ops/test_doctor_links.py",
    **dict.fromkeys(
        (
            "ros.close",
            "ros.fault",
            "ros.listen",
            "ros.message",
            "ros.request",
            "ros.ring",
            "ros.take_back",
            "ros.task",
        ),
        "ros/ros2/test_ros2_contained.py",
    ),
    **dict.fromkeys(test_uplink_contained.ENTRIES, "upstream/test_uplink_contained.py"),
    **dict.fromkeys(test_dial.ENTRIES, "upstream/test_dial.py"),
    "upstream.return": "upstream/test_servers.py",
    "upstream.start": "upstream/test_reload_links.py",
    "reload.close": "app/test_inside.py",
    "stop.session": "test_containment.py",
    "store.read": "store/test_memory_backlogs.py",
    "store.unread": "store/test_unread.py",
}


#: Minutes of waiting for timers, of which two test workers have the half each.
PARTS = 2


@pytest.mark.patches
@pytest.mark.timeout(900)
@pytest.mark.filterwarnings("ignore:coroutine .* was never awaited")
@pytest.mark.parametrize("part", range(PARTS))
def test_every_entry_in_turn(tmp_path: Path, escaped: list[str], quick: None, part: int) -> None:
    only = os.environ.get("ENTRY")
    names = only.split(",") if only else sorted(all_entries() - ELSEWHERE.keys())
    with pytest.MonkeyPatch.context() as patch:
        saboteur = Saboteur(patch)
        uvloop.run(_in_turn(names[part::PARTS], tmp_path, saboteur))
    escaped.clear()


async def _in_turn(names: list[str], directory: Path, saboteur: Saboteur) -> None:
    site = Site(directory)
    problems: list[str] = []
    async with site.stack:
        await site.start()
        await _all_go_on(site, "at the beginning")
        await _all_right(site, "at the beginning")
        for name in names:
            began = time.monotonic()
            try:
                await asyncio.wait_for(_one(site, saboteur, name), 2 * PATIENCE)
                print(f"{name}: {time.monotonic() - began:.2f} s", flush=True)
            except (AssertionError, asyncio.TimeoutError, OSError, EOFError, Exception) as error:
                problems.append(f"{name}: {type(error).__name__}: {error}")
                print(problems[-1], flush=True)
        # The load's clients may all have disconnected while the bridge stops.
        peer = await site.log_in("connected-to-the-end")
        saboteur.arm("stop.session")
    peer.hang_up()
    assert site.faults.by_entry.get("stop.session") == 1
    assert not problems, "\n".join(problems)


async def _one(site: Site, saboteur: Saboteur, name: str) -> None:
    losses = sum(actor.losses for actor in site.actors)
    for behind in (False, True):
        if behind and name in ENDLESS:
            continue
        where = f"{'behind' if behind else 'before'} the work of {name}"
        await _strike(site, saboteur, name, behind=behind, where=where)
        others, saboteur.others = saboteur.others, []
        assert not others, f"faults that nobody injected, {where}:\n" + "\n".join(others)
    for peer in site.hands:
        peer.hang_up()
    site.hands.clear()
    await _all_go_on(site, f"after the faults in {name}")
    await _all_right(site, f"after the faults in {name}")
    others, saboteur.others = saboteur.others, []
    assert not others, f"faults that nobody injected, after {name}:\n" + "\n".join(others)
    lost = sum(actor.losses for actor in site.actors) - losses
    # One, as a rule; all that waited for the store when it failed; all of a host whose accepting
    # paused.
    assert lost <= 2 * (len(site.actors) if name.startswith(("commit.", "store.")) else 6), lost


async def _strike(site: Site, saboteur: Saboteur, name: str, *, behind: bool, where: str) -> None:
    """Let the entry fail once."""
    before = site.faults.by_entry.get(name, 0)
    first = FIRST.get(name, ())
    with pytest.MonkeyPatch.context() as patch:
        for left in reversed(range(ATTEMPTS)):
            if behind:
                saboteur.arm(*first, behind=name)
            else:
                saboteur.arm(name, *first)
            try:
                if name in REACH:
                    await REACH[name](site, patch)
                await until(
                    lambda: site.faults.by_entry.get(name, 0) > before,
                    f"a fault {where}: say in REACH how it is passed",
                    float(os.environ.get("REACH_TIME", PATIENCE)) / ATTEMPTS,
                )
            except (AssertionError, asyncio.TimeoutError, OSError, EOFError):
                # It may have struck who reaches for it; or somebody else, and it is not there yet.
                if not left and site.faults.by_entry.get(name, 0) <= before:
                    raise
            if site.faults.by_entry.get(name, 0) > before:
                break
    saboteur.arm()


async def _all_right(site: Site, when: str) -> None:
    end = time.monotonic() + float(os.environ.get("REACH_TIME", PATIENCE))
    while wrong := _wrong(site):
        assert time.monotonic() < end, f"{when}: {wrong}"
        await asyncio.sleep(0.01)


def _wrong(site: Site) -> str:
    """State that is left of a client that is gone, or a wrong sum; empty when all is right."""
    broker, scheduler = site.broker, site.scheduler
    try:
        check_scheduler(scheduler)
    except AssertionError as error:
        return f"accounts: {error}"
    there = {protocol._client for protocol in scheduler.connections}
    if not broker.clients <= there:
        return f"no connections any more: {[*map(str, broker.clients - there)]}"
    outputs = {client.output for client in there}
    linked = [each for each in broker.sessions.values() if each.identity and each.link is not None]
    if left := [str(each) for each in linked if each.link not in outputs]:
        return f"not connected any more: {left}"
    neighbours = site.app._listeners._addresses._known.values()
    guests = {guest for each in neighbours for guest in each.guests}
    if not guests <= scheduler.connections:
        return f"guests that are gone: {[*map(str, guests - scheduler.connections)]}"
    strangers = broker.accounting.accounts.strangers
    admitted = sum(sum(each.clients.values()) for each in neighbours)
    logged_in = sum(protocol.account is not strangers for protocol in scheduler.connections)
    if admitted != logged_in:
        return f"{admitted} connections are counted that have logged in, and there are {logged_in}"
    return ""


async def _all_go_on(site: Site, when: str) -> None:
    """Each client has done once more what it does, and the clock has advanced."""
    kinds: dict[type[Actor], int] = {}
    for actor in site.actors:
        kinds[type(actor)] = kinds.get(type(actor), 0) + actor.done
    ticked_at = site.broker.ticked_at

    def missing() -> list[str]:
        now: dict[type[Actor], int] = {}
        for actor in site.actors:
            now[type(actor)] = now.get(type(actor), 0) + actor.done
        left = [kind.__name__ for kind, done in kinds.items() if now[kind] <= done]
        return left + (["the clock"] if site.broker.ticked_at <= ticked_at else [])

    end = time.monotonic() + PATIENCE
    while missing():
        assert time.monotonic() < end, f"{when} these do not go on: {missing()}"
        await asyncio.sleep(0.01)


@pytest.mark.parametrize("run", [asyncio.run, uvloop.run], ids=["asyncio", "uvloop"])
@pytest.mark.parametrize(
    ("entry", "kind"),
    [
        ("connection.made", "plain"),
        ("connection.made", "tls"),
        ("connection.made", "websocket"),
        ("tls.made", "tls"),
        ("websocket.made", "websocket"),
    ],
)
def test_who_could_not_be_let_in_is_cut_off(
    tmp_path: Path,
    escaped: list[str],
    monkeypatch: pytest.MonkeyPatch,
    run: Callable[[Coroutine[Any, Any, None]], None],
    entry: str,
    kind: str,
) -> None:
    """What follows a fault at the beginning of a connection comes to nothing, not to a fault."""

    async def dial() -> None:
        harness = Harness(*make_contexts(tmp_path))
        await harness.start()
        faults = harness.broker.faults
        saboteur.arm(entry)
        host, port = harness.ports[("plain", "tls", "websocket").index(kind)]
        secure = {"ssl": harness.client_context, "server_hostname": "localhost"}
        with contextlib.suppress(OSError, EOFError):
            opened = asyncio.open_connection(host, port, **(secure if kind == "tls" else {}))
            reader, writer = await asyncio.wait_for(opened, PATIENCE)
            for _ in range(3):
                writer.write(b"GET /mqtt HTTP/1.1\r\n")
                await asyncio.wait_for(writer.drain(), PATIENCE)
            assert not await asyncio.wait_for(reader.read(1), PATIENCE)
        await until(lambda: faults.count, f"a fault in {entry}")
        await until(lambda: not harness.scheduler.connections, "the end of the connection")
        await harness.close()
        assert faults.by_entry == {entry: 1}
        assert not saboteur.others, saboteur.others

    saboteur = Saboteur(monkeypatch)
    run(dial())
    escaped.clear()


@pytest.mark.patches
async def test_who_a_fault_arose_with_is_told_at_once(
    tmp_path: Path, escaped: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """When nobody else says anything either, and so nothing else is written out."""
    harness = Harness(*make_contexts(tmp_path))
    await harness.start()
    saboteur = Saboteur(monkeypatch)
    for behind in ("", "connection.chunk"):
        peer = await harness.log_in("a")
        saboteur.arm(*([] if behind else ["connection.chunk"]), behind=behind)
        await peer.send(Publish("x", b"x", 1, packet_id=1))
        while not isinstance(told := await peer.receive(), Disconnect):
            pass
        assert told.reason_code == ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR
        assert not await peer.receive_rest()
    monkeypatch.undo()
    await harness.close()
    escaped.clear()


def test_a_round_of_turns_that_fails_is_followed_by_one(tmp_path: Path, escaped: list[str]) -> None:
    """Else each fault would let those with much to do have one round more in each of the loop's."""

    class Busy:
        faulty = False

        def take_turn(self) -> None:
            scheduler.queue_turn(self)
            if self.faulty:
                self.faulty = False
                raise SabotageError

        def fault(self, entry: str, error: Exception) -> None:
            raise error  # that is not to be, and no more than this is to come of it

    async def run() -> None:
        nonlocal scheduler
        harness = Harness(*make_contexts(tmp_path))
        scheduler = harness.scheduler
        scheduled = scheduler.entries.soon
        rounds = []

        def soon(entry: str, *args: Any, **more: Any) -> asyncio.Handle:
            handle = scheduled(entry, *args, **more)
            rounds.extend([handle] if entry == "scheduler.turns" else [])
            return handle

        scheduler.entries.soon = soon  # type: ignore[method-assign]
        members = [Busy() for _ in range(3)]
        for member in members:
            scheduler.queue_turn(member)
        for _ in range(5):
            members[1].faulty = True
            await until(lambda: not members[1].faulty, "a fault")
            await asyncio.sleep(0)
            begun = len(rounds)
            for _ in range(10):
                await asyncio.sleep(0)
            assert len(rounds) - begun == 10
        await harness.close()

    scheduler: Any = None
    asyncio.run(run())
    assert len(escaped) > 0
    escaped.clear()


def test_every_entry_is_let_fail_somewhere() -> None:
    names = all_entries()
    assert len(names) > 100
    assert not ELSEWHERE.keys() - names and not INLINE.keys() - names
    assert not REACH.keys() - names, REACH.keys() - names
    for place in INLINE.values():
        owner_of(*place[:3])
    here = Path(__file__).parent
    for name, file in ELSEWHERE.items():
        assert f'"{name}"' in (here / file).read_text(), f"{name} is not in {file}"
