"""The composition root: builds the parts, starts them in order, stops them in reverse."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gc
import json
import logging
import os
import signal
import ssl
from importlib.metadata import version

import psutil
import uvloop

from appliance.access import AccessFileError, FileAccess
from appliance.amqtt_broker import ApplianceBroker, configuration, plugin_kinds
from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.ports import Features, Limits
from appliance.broker.sys_topics import SysTopics
from appliance.certs import ClientCertificates, server_context
from appliance.config import Listener, Settings, TopicRoute
from appliance.listeners import Admission, Listeners, ListenerSettings
from appliance.mqtt.reason import ReasonCode
from appliance.ros.bridge import Bridge, RouteSettings
from appliance.ros.ros2 import Ros2Node, use_fastdds_profile
from appliance.ros.rules import CommandRules, OnSilence
from appliance.store import MemoryStore

log = logging.getLogger(__name__)

#: Seconds between two ticks of the broker's clock, the grain of keep alive and expiry; fewer when
#: a will or a session falls due before, but never fewer than the second of these.
TICK = 1.0
SHORTEST_TICK = 0.01

#: Objects that are made before Python looks for garbage among them, some 0.2 ms of work; and how
#: often it has to have done so, in tens, before it looks through those that have grown old.
YOUNG_OBJECTS = 2000
NEVER = 1 << 30


class App:
    """The whole appliance, on the running event loop."""

    def __init__(self, settings: Settings) -> None:
        """Assign only; `start` reads files and opens ports."""
        self.settings = settings
        self.addresses: list[tuple[str, int]] = []
        self.bridge: Bridge | None = None
        self._stack = contextlib.AsyncExitStack()
        self._stopping = asyncio.Event()

    async def start(self) -> None:
        """Start everything, or nothing.

        Raises:
            AccessFileError, CertificateError: a file is missing or wrong.
            PluginSettingsError: one of broker.plugins cannot be loaded.
            OSError: a port cannot be listened on.
        """
        try:
            await self._start()
        except BaseException:
            await self.stop()
            raise

    async def _start(self) -> None:
        loop = asyncio.get_running_loop()
        settings = self.settings
        broker_settings = settings.broker
        users, acl = broker_settings.users, broker_settings.acl
        # A file may be missing where plugins do its work, and only there.
        authenticating, ruling = plugin_kinds(broker_settings.plugins)
        self._access = access = FileAccess(
            None if authenticating and not users.exists() else users,
            None if ruling and not acl.exists() else acl,
            settings.robot,
            broker_settings.anonymous,
        )
        self._stack.callback(access.close)
        limits = broker_settings.limits
        self.broker = broker = Broker(
            access, MemoryStore(), _broker_limits(settings), _features(settings)
        )
        broker.tick(loop.time())

        async def listen() -> None:
            wanted = self._listener_settings()
            self.addresses = await listeners.start(wanted)
            for (host, port), listener in zip(self.addresses, wanted, strict=True):
                kind = " for WebSocket" if listener.protocol == "websocket" else ""
                where = host if listener.path else f"{host or '*'}:{port}"
                log.info("listening%s on %s", kind, where)

        config = configuration(
            [(str(listener.bind), listener.tls) for listener in broker_settings.listeners],
            limits.connections,
            broker_settings.plugins,
        )
        # In less than the listeners' time limit, so that a client is told when plugins hang.
        plugin_timeout = 0.8 * limits.connect_timeout
        frame = ApplianceBroker(
            broker, access, config, listen, lambda: listeners.stop(), plugin_timeout
        )
        listeners = Listeners(
            broker,
            frame.authenticate,
            # It would pass by plugins that refuse clients.
            access.exchange if not authenticating else lambda method: None,
            _admission(settings),
        )
        self._stack.push_async_callback(listeners.stop)
        self._inside = broker.attach("_appliance", _Deaf())
        self._start_clock(loop)
        await frame.start()
        self._stack.push_async_callback(frame.shutdown)
        self._start_bridge(loop)
        state = f"{settings.robot}/_appliance/state"
        self._publish(state, b"online", retain=True)
        self._stack.callback(self._publish, state, b"offline", retain=True)

    def _listener_settings(self) -> list[ListenerSettings]:
        tls = self.settings.broker.tls

        @functools.cache
        def context(asked_for: ClientCertificates) -> ssl.SSLContext:
            return server_context(tls.certificate, tls.key, tls.ca, asked_for)

        def context_of(listener: Listener) -> ssl.SSLContext | None:
            if not listener.tls:
                return None
            asked_for = tls.client_certificates
            # Asked for a certificate that it does not have, a browser gives a WebSocket up.
            if listener.protocol == "websocket" and asked_for == "optional":
                asked_for = "none"
            return context(asked_for)

        return [
            ListenerSettings(
                listener.bind.host,
                listener.bind.port,
                context_of(listener),
                listener.protocol,
                listener.bind.path,
                listener.mode,
            )
            for listener in self.settings.broker.listeners
        ]

    def _start_bridge(self, loop: asyncio.AbstractEventLoop) -> None:
        """Join the bus in the background: MQTT answers before ROS is there, and without it."""
        settings = self.settings
        if settings.bridge.bus == "none":
            return
        bridge = settings.bridge
        use_fastdds_profile(os.environ)
        self.bridge = Bridge(
            Ros2Node(bridge.node, bridge.namespace, bridge.domain_id),
            self.broker,
            [_route_settings(route, settings.robot) for route in bridge.topics],
            loop,
            settings.robot,
        )
        self._stack.push_async_callback(self.bridge.stop)
        self.bridge.start()

    def _start_clock(self, loop: asyncio.AbstractEventLoop) -> None:
        """Tick once a second; publish `$SYS` every `broker.sys_interval`."""
        process = psutil.Process()
        sys_topics = SysTopics(
            self.broker, version("ros-mqtt-appliance"), lambda: process.memory_info().rss
        )
        interval = self.settings.broker.sys_interval
        next_sys = loop.time() + min(interval, TICK)
        timer: asyncio.TimerHandle

        def tick() -> None:
            nonlocal timer, next_sys
            now = loop.time()
            due = self.broker.tick(now)
            if interval and now >= next_sys:
                next_sys = now + interval
                for topic, payload in sys_topics.update():
                    self._publish(topic, payload, retain=True)
            timer = loop.call_at(min(now + TICK, max(due, now + SHORTEST_TICK)), tick)

        timer = loop.call_later(TICK, tick)
        self._stack.callback(lambda: timer.cancel())

    def _publish(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        self.broker.publish(Message(topic, payload, 0, retain), self._inside)
        self.broker.flush()

    async def stop(self) -> None:
        """Stop everything, in reverse order; may be called twice."""
        await self._stack.aclose()

    async def run(self) -> None:
        """Start, run until SIGTERM or SIGINT (or `request_stop`), stop."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self.request_stop)
        await self.start()
        loop.add_signal_handler(signal.SIGHUP, self.reload)
        try:
            await self._stopping.wait()
            log.info("stopping")
        finally:
            await self.stop()

    def reload(self) -> None:
        """Take over the users and ACL files as they are now; a wrong one changes nothing."""
        users = set(self._access.users())
        try:
            self._access.reload()
        except AccessFileError as error:
            log.error("not reloaded, what was in force stays so: %s", error)
            return
        removed = users - set(self._access.users())  # others are known to plugins
        for session in list(self.broker.sessions.values()):
            if session.identity and session.identity.username in removed:
                session.close_link(ReasonCode.ADMINISTRATIVE_ACTION, "the user was removed")
        self.broker.rules_changed()
        self.broker.flush()
        log.info("users and access rules reloaded")

    def request_stop(self) -> None:
        """Let `run` end."""
        self._stopping.set()


class _Deaf:
    """The link of the session that the appliance itself publishes with: it receives nothing."""

    writable = True

    def publish(self, *_: object) -> None:
        """It subscribes to nothing, so this is not called."""

    def mirror(self, packet: bytes, version: int, payload_size: int) -> bool:
        """Nor is this."""
        return False

    def pubrel(self, packet_id: int) -> None:
        """Nor is this."""

    def later(self) -> None:
        """Nor is this."""

    def close(self, reason: object, message: str) -> None:
        """There is no connection to close."""


def _broker_limits(settings: Settings) -> Limits:
    limits = settings.broker.limits
    return Limits(
        connections=limits.connections,
        packet_size=limits.packet_size,
        memory=limits.memory,
        queue_messages=limits.queue_messages,
        queue_bytes=limits.queue_bytes,
        queue_full=limits.queue_full,
        keep=0 if limits.keep == "latest" else limits.keep,
        inflight=limits.inflight,
        sessions=limits.sessions,
        subscriptions=limits.subscriptions,
        topic_length=limits.topic_length,
        topic_levels=limits.topic_levels,
        retained_messages=limits.retained_messages,
        retained_bytes=limits.retained_bytes,
        session_expiry=round(limits.session_expiry),
        topic_alias=limits.topic_alias,
        keep_alive=round(limits.keep_alive),
    )


def _admission(settings: Settings) -> Admission:
    limits = settings.broker.limits
    return Admission(
        limits.connections,
        limits.connect_timeout,
        limits.connections_per_address,
        limits.connection_rate,
        limits.publish_rate,
    )


def _features(settings: Settings) -> Features:
    return Features(
        check_payload_format=settings.broker.check_payload_format,
        reason_strings=settings.broker.reason_strings,
        response_information=settings.broker.response_information or "",
    )


def _route_settings(route: TopicRoute, robot: str) -> RouteSettings:
    return RouteSettings(
        ros=route.ros,
        to=route.to,
        mqtt=route.topic(robot),
        type=route.type,
        encoding=route.encoding,
        rate=route.rate,
        qos=route.qos,
        retain=route.retain,
        keep=route.keep,
        rules=_command_rules(route) if route.command_keys else None,
    )


def _command_rules(route: TopicRoute) -> CommandRules:
    silence = route.on_silence
    return CommandRules(
        expire=route.expire,
        take_retained=route.take_retained,
        exclusive=route.exclusive,
        lease=route.lease,
        on_silence=OnSilence(silence.after, json.dumps(silence.publish), silence.disconnect)
        if silence
        else None,
        clamp=tuple((path, low, high) for path, (low, high) in route.clamp.items()),
        allow=tuple((path, tuple(values)) for path, values in route.allow.items()),
    )


def run(settings: Settings) -> int:
    """Run the appliance until it is told to stop; returns the exit code of the command."""
    _spare_the_old()
    uvloop.run(_main(settings))
    return 0


def _spare_the_old() -> None:
    """Let Python look for garbage among young objects only.

    To look through all sessions, subscriptions and retained messages stops everything for a tenth
    of a second and more, each time that there are a quarter more of them. None of these needs it:
    what ends here is let go by who holds it. Garbage that does dies young, in tasks and exceptions.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(YOUNG_OBJECTS, 10, NEVER)


async def _main(settings: Settings) -> None:
    await App(settings).run()
