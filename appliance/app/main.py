"""The composition root: builds the parts, starts them in order, stops them in reverse."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import gc
import logging
import os
import signal
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import asdict
from datetime import timedelta
from functools import partial
from importlib.metadata import version

import psutil
import uvloop

from appliance.access import AccessFileError, FileAccess, LoginPolicy, no_user
from appliance.app import status, wiring
from appliance.app.reload import Reload, ReloadError, ReloadParts
from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.ports import InsideLink
from appliance.broker.sys_topics import SysTopics
from appliance.certs import (
    CertificateError,
    TlsContexts,
    keep_server_certificate,
)
from appliance.certs.settings import tls_contexts
from appliance.config import (
    OPEN_WITH_SECRETS,
    Settings,
    is_open_with_secrets,
)
from appliance.config.plugins import PluginSettingsError
from appliance.host.clock import StepWatch
from appliance.host.watch import watch
from appliance.net.callbacks import Entries, contained_proxy
from appliance.net.listeners import Admission, Listeners
from appliance.ops.audit import Audit, AuditError
from appliance.ops.control import Control, ControlError
from appliance.ops.crash import CrashReports
from appliance.ops.sd_notify import Notifier
from appliance.ops.watchdog import Pulse
from appliance.ros import settings as ros_settings
from appliance.ros.bridge import Bridge
from appliance.ros.node import RosNode
from appliance.ros.ros1.node import Ros1Node
from appliance.ros.ros2 import discovery
from appliance.ros.ros2.node import Ros2Node
from appliance.store import MemoryStore, SessionStore, SqliteStore, StoreError

log = logging.getLogger(__name__)

#: Seconds between two ticks of the broker's clock, the grain of keep alive and expiry; fewer when
#: a will or a session falls due before, but never fewer than the second of these.
TICK = 1.0
SHORTEST_TICK = 0.01

#: Objects that are made before Python looks for garbage among them, some 0.2 ms of work; and how
#: often it has to have done so, in tens, before it looks through those that have grown old.
YOUNG_OBJECTS = 2000
NEVER = 1 << 30


#: What keeps the appliance from starting and a user can mend; each says what and how.
START_ERRORS = (
    AccessFileError,
    AuditError,
    CertificateError,
    OSError,
    PluginSettingsError,
    StoreError,
)

#: Seconds between two looks at the server's certificate, this computer's names and addresses, and
#: the certificates of who is connected; and after which the log is told again of what has run out
#: or does soon.
CERTIFICATE_CHECK = 300.0
CERTIFICATE_WARNING = 86400.0


#: Seconds until what runs beside everything else begins again, when it failed.
BESIDE_AGAIN = 5.0


class App:
    """The whole appliance, on the running event loop."""

    def __init__(
        self,
        settings: Settings,
        ros_arguments: Sequence[str] = (),
        notifier: Notifier | None = None,
        crashes: CrashReports | None = None,
    ) -> None:
        """Assign only; `start` reads files and opens ports. For the arguments see `run`."""
        self.settings = settings
        self._ros_arguments = ros_arguments
        self._notifier = notifier or Notifier()
        self._crashes = crashes
        self.addresses: list[tuple[str, int]] = []
        self.bridge: Bridge | None = None
        self.audit: Audit | None = None
        self._stack = contextlib.AsyncExitStack()
        self._stopping = asyncio.Event()
        #: A SIGHUP came during the start.
        self._reload_waits = asyncio.Event()
        self._certificates_due = asyncio.Event()
        self._status: status.Status | None = None

    async def start(self) -> None:
        """Start everything, or nothing.

        Raises:
            AccessFileError, CertificateError: a file is missing or wrong.
            AuditError: the audit log cannot be written.
            PluginSettingsError: one of broker.plugins cannot be loaded.
            StoreError: the store is in use, of a newer version, or cannot be read.
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
        if is_open_with_secrets(settings):
            log.warning("%s %s", settings.file, OPEN_WITH_SECRETS)
        tls = tls_contexts(broker_settings)
        access = FileAccess(
            *wiring.access_files(settings),
            settings.robot,
            broker_settings.anonymous,
            failed_logins=broker_settings.limits.failed_logins,
            max_wait=0.6 * broker_settings.limits.connect_timeout,
        )
        self._stack.callback(access.close)
        limits = broker_settings.limits
        store = self._open_store()
        self.broker = broker = Broker(
            access,
            store,
            limits.of_broker(),
            broker_settings.features(),
        )
        self._entries = Entries(loop, broker.faults)
        if self._crashes is not None:
            broker.faults.report = self._crashes.fault
            self._crashes.watch(loop, broker.faults)
        audit = broker_settings.audit
        if audit.path is not None:
            self.audit = Audit(audit.path, audit.size, audit.keep)
            broker.audit_log = contained_proxy("audit", broker.faults, self.audit)
            self._stack.callback(self.audit.close)
            self.audit.began()
            self._stack.callback(self.audit.ended)
        broker.tick(loop.time())
        store.restore(broker)

        async def listen() -> None:
            wanted = wiring.listener_settings(settings, tls)
            self.addresses = await listeners.start(wanted)

        plugins = wiring.plugins(settings, broker, access, listen, lambda: listeners.stop())
        login = LoginPolicy(
            access,
            tls.username if tls is not None else no_user,
            plugins.logins if plugins is not None else None,
        )
        self._listeners = listeners = Listeners(
            broker, login.authenticate, login.exchange, limits.build(Admission), tls
        )
        self._stack.push_async_callback(listeners.stop)
        self._inside = broker.attach("_appliance", InsideLink())
        self._start_clock(loop)
        if plugins is None:
            await listen()
            self._stack.push_async_callback(listeners.stop)
        else:  # they are notified before and after the listeners start, and stop
            await plugins.start()
            self._stack.push_async_callback(plugins.shutdown)
        self._start_bridge(loop)
        self._reload = Reload(
            ReloadParts(settings, access, tls, broker, listeners, self.bridge, self.audit)
        )
        self._status = status.Status(
            status.StatusParts(
                version("ros-mqtt-appliance"),
                broker,
                listeners,
                store,
                self.bridge,
                self._reload,
                tls.warnings if tls is not None else list,
                self._crashes.previous if self._crashes is not None else None,
            )
        )
        if tls is not None:
            self._beside(partial(self._keep_certificates, tls))
        if settings.file is not None:
            await self._open_to_commands()
        state = f"{settings.robot}/_appliance/state"
        self._publish(state, b"online", retain=True)
        self._stack.callback(self._publish, state, b"offline", retain=True)

    def _open_store(self) -> SessionStore:
        wanted = self.settings.broker.store
        store: SessionStore
        if wanted.durability == "off":
            store = MemoryStore()
        else:
            store = SqliteStore(wanted.path, wanted.durability, size=wanted.size, age=wanted.age)
        store.open()
        self._stack.push_async_callback(store.close)
        return store

    def _beside(self, work: Callable[[], Coroutine[object, object, None]]) -> None:
        """Run this beside everything else, until the stop; when it fails it begins again."""

        async def go_on() -> None:
            while True:
                try:
                    await work()
                except Exception as error:
                    self.broker.faults.caught("app.beside", error)
                await asyncio.sleep(BESIDE_AGAIN)

        task = self._entries.task("app.task", go_on())

        async def end() -> None:
            while not task.done():  # up to Python 3.11 `wait_for` may lose a cancellation
                task.cancel()
                await asyncio.wait({task}, timeout=1)

        self._stack.push_async_callback(end)

    async def _keep_certificates(self, tls: TlsContexts) -> None:
        """Renew the server's certificate when that is due, and tell of what has run out."""
        told: dict[str, float] = {}
        due = self._certificates_due
        loop = asyncio.get_running_loop()
        reason = ""
        while True:
            problems: list[str] = []
            try:
                reason = await asyncio.to_thread(keep_server_certificate, tls.files) or reason
                if reason:
                    await self._reload.renewed()
                    log.info("the server's certificate was renewed: %s", reason)
                    reason = ""
            except (CertificateError, OSError) as error:
                problems = [f"the server's certificate is not renewed: {error}"]
            except Exception as error:
                self.broker.faults.caught("app.certificates", error)
            now = loop.time()
            told = {text: at for text, at in told.items() if now - at < CERTIFICATE_WARNING}
            for text in (*problems, *tls.warnings()):
                if text not in told:
                    told[text] = now
                    log.warning("%s", text)
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(due.wait(), CERTIFICATE_CHECK)
            due.clear()
            # Clients' certificates run out, too.
            await self._listeners.check_certificates()

    def _start_bridge(self, loop: asyncio.AbstractEventLoop) -> None:
        """Join the bus in the background: MQTT answers before ROS is there, and without it."""
        settings = self.settings
        if settings.bridge.bus == "none":
            return
        bridge = settings.bridge
        arguments = (*bridge.ros_arguments, *self._ros_arguments)
        node: RosNode
        if bridge.bus == "ros1":
            node = Ros1Node(bridge.node, bridge.namespace, arguments)
        else:
            unheeded = discovery.use(bridge.discovery, os.environ)
            if unheeded:
                log.warning("%s", unheeded)
            node = Ros2Node(
                bridge.node, bridge.namespace, bridge.domain_id, arguments, bridge.use_sim_time
            )
        self.bridge = Bridge(
            node,
            self.broker,
            ros_settings.routes(settings),
            loop,
            settings.robot,
            ros_settings.call_routes(settings),
            diagnostics=bridge.diagnostics,
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
        steps = StepWatch(loop.time())
        run = self.broker.faults.run

        def look_at_clock(now: float) -> None:
            step = steps.look(now)
            if step:
                self._clock_was_set(step)

        def publish_sys() -> None:
            for topic, payload in sys_topics.update():
                run("clock.sys_topic", self._publish, topic, payload, True, otherwise=None)

        def tick() -> float:
            nonlocal next_sys
            now = loop.time()
            run("clock.step", look_at_clock, now, otherwise=None)
            due = run("clock.broker", self.broker.tick, now, otherwise=now + TICK)
            if self._status is not None:
                run("clock.status", self._status.tick, now, otherwise=None)
            if interval and now >= next_sys:
                next_sys = now + interval
                run("clock.sys", publish_sys, otherwise=None)
            return min(now + TICK, max(due, now + SHORTEST_TICK))

        self._stack.callback(self._entries.every("clock", TICK, tick).cancel)

    def _clock_was_set(self, step: float) -> None:
        """The wall clock says something else; only dates depend on it."""
        text = f"the computer's clock was set {'forward' if step > 0 else 'back'} by "
        text += f"{timedelta(seconds=round(abs(step)))}"
        log.warning("%s, or the computer slept: nothing expires by that", text)
        if self.audit is not None:
            self.audit.changed(text)
        self._certificates_due.set()
        self._listeners.scheduler.in_background(self._listeners.check_certificates())

    def _publish(self, topic: str, payload: bytes, retain: bool = False) -> None:
        self.broker.publish(Message(topic, payload, 0, retain), self._inside)
        self.broker.flush()

    async def stop(self) -> None:
        """Stop everything, in reverse order; may be called twice."""
        await self._stack.aclose()

    async def run(self) -> None:
        """Start, run until SIGTERM or SIGINT (or `request_stop`), stop."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self.request_stop)  # sets an event, and no more
        # It would end the process; the start goes on with the files that it has read.
        loop.add_signal_handler(signal.SIGHUP, self._reload_waits.set)
        await self.start()
        self._entries.signal("signal.reload", signal.SIGHUP, self._on_hangup)
        if self._reload_waits.is_set():
            self._on_hangup()
        # MQTT answers, and ROS may come when it likes: whoever waits for this waits no longer.
        assert self._status is not None
        pulse = Pulse(self.broker, self._listeners.scheduler, self._inside, loop.time)
        self._notifier.start(self._entries, self._status.line, pulse.is_alive)
        try:
            await self._stopping.wait()
            log.info("stopping")
            self._notifier.stopping()
        finally:
            await self.stop()

    async def reload(self) -> list[str]:
        """Take over all files as they are now; see `Reload.run`."""
        with self._notifier.reloading():
            return await self._reload.run()

    async def _try_reload(self) -> None:
        with contextlib.suppress(ReloadError):  # the log was told
            try:
                await self.reload()
            except (ReloadError, asyncio.CancelledError):
                raise
            except Exception as error:
                self.broker.faults.caught("app.reload", error)

    def _on_hangup(self) -> None:
        self._listeners.scheduler.in_background(self._try_reload())

    async def _answer_reload(self) -> list[str]:
        try:
            changed = await self.reload()
        except ReloadError as error:
            raise ControlError(f"nothing was reloaded: {error}") from None
        if not changed and self._reload.last_change:  # mostly by itself, before anybody could ask
            return [f"nothing has changed since the last reload, {self._reload.last_change}"]
        return changed

    async def _answer_routes(self) -> list[dict[str, object]]:
        bridge = self._bridge_that_runs()
        topics: list[dict[str, object]] = [asdict(topic) for topic in bridge.topics()]
        return topics + [dict(entry) for entry in bridge.calls.bridged()]

    async def _answer_skipped(self) -> list[dict[str, object]]:
        return [asdict(skip) for skip in self._bridge_that_runs().skips()]

    def _bridge_that_runs(self) -> Bridge:
        if self.bridge is None:
            raise ControlError("there is no bridge (bridge.bus is none)")
        if self.bridge.problem is not None:
            raise ControlError(f"there is no bridge to ROS: {self.bridge.problem}")
        return self.bridge

    async def _answer_status(self) -> dict[str, object]:
        assert self._status is not None
        return await self._status.tell()

    async def _open_to_commands(self) -> None:
        """Answer commands of this computer, and follow the files."""
        settings = self.settings
        settings.control.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        commands = {
            "reload": self._answer_reload,
            "routes": self._answer_routes,
            "status": self._answer_status,
            "skipped": self._answer_skipped,
        }
        control = Control(settings.control, commands, self.broker.faults)
        try:
            await control.start()
        except OSError as error:
            # MQTT does without, and a robot's disk that has errors is mounted read-only.
            if error.errno not in (errno.EROFS, errno.ENOSPC, errno.EDQUOT):
                raise
            log.error("`appliance status`, `reload` and `routes` are not answered: %s", error)
        self._stack.push_async_callback(control.stop)
        if settings.reload_on_change:
            self._beside(partial(watch, self._reload.files, self._try_reload))

    def request_stop(self) -> None:
        """Let `run` end."""
        self._stopping.set()


def run(settings: Settings, ros_arguments: Sequence[str] = ()) -> int:
    """Run the appliance until it is told to stop; returns the exit code of the command.

    `ros_arguments` are those that stood behind `--ros-args`; they come after the configuration's.
    """
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # until `App.run` knows it: it would end us
    _spare_the_old()
    notifier = Notifier.from_environment(os.environ)
    crashes = CrashReports(settings.crash_reports, settings)
    crashes.start()
    try:
        uvloop.run(App(settings, ros_arguments, notifier, crashes).run())
    except START_ERRORS:
        raise
    except Exception as error:
        crashes.crash(error)
        raise
    finally:
        crashes.stop()
        notifier.close()
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
