"""The composition root: builds the parts, starts them in order, stops them in reverse."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import gc
import logging
import os
import signal
import sys
from collections.abc import Callable, Coroutine, Sequence
from datetime import timedelta
from functools import partial
from importlib.metadata import version
from typing import TYPE_CHECKING

import psutil
import uvloop
from async_timeout import timeout

from appliance.access import AccessFileError, FileAccess, LoginPolicy, TokenFile, no_user
from appliance.access.enrolments import Enrolments
from appliance.app import management, status, wiring
from appliance.app.links import Links
from appliance.app.own_topics import orphaned_topics
from appliance.app.reload import Reload, ReloadError, ReloadParts
from appliance.app.stores import store_of
from appliance.broker.broker import Broker
from appliance.broker.histogram import Histogram
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.broker.sys_topics import SysTopics
from appliance.certs import (
    CertificateError,
    TlsContexts,
    keep_server_certificate,
)
from appliance.certs.settings import tls_contexts
from appliance.config import (
    OPEN_WITH_SECRETS,
    Bind,
    Settings,
    is_open_with_secrets,
)
from appliance.config.plugins import PluginSettingsError
from appliance.host.clock import StepWatch
from appliance.host.watch import watch
from appliance.management.mqtt_calls import ManagementCalls
from appliance.management.phone_certificates import PhoneCertificates
from appliance.management.verb_thread import VerbThread
from appliance.management.verbs import Verbs
from appliance.mdns import settings as mdns_settings
from appliance.mdns.process import AnnouncerProcess
from appliance.net.callbacks import Entries, contained_proxy
from appliance.net.listeners import Admission, Listeners
from appliance.ops.audit import Audit, AuditError
from appliance.ops.control import Control
from appliance.ops.crash import CrashReports
from appliance.ops.sd_notify import Notifier
from appliance.ops.watchdog import Pulse
from appliance.ros import settings as ros_settings
from appliance.ros.bridge import Bridge
from appliance.ros.node import RosNode
from appliance.ros.ros1.node import Ros1Node
from appliance.ros.ros2 import discovery
from appliance.ros.ros2.node import Ros2Node
from appliance.store import SessionStore, StoreError
from appliance.store.clock import boot_id

if TYPE_CHECKING:
    from appliance.net.http import HttpSite
    from appliance.upstream.uplink import Uplink

log = logging.getLogger(__name__)

#: Seconds between two ticks of the broker's clock: the resolution of keep alive and expiry. A will
#: or a session that is due sooner shortens one, but not below SHORTEST_TICK.
TICK = 1.0
SHORTEST_TICK = 0.01

#: Thresholds of Python's garbage collector: new objects per collection of the youngest generation,
#: which takes some 0.2 ms, and a threshold that the oldest generation never reaches.
YOUNG_OBJECTS = 2000
NEVER = 1 << 30

#: Seconds after which a thread that computes gives the interpreter to one that waits for it: the
#: event loop waits for that at each of its iterations. Python's own are 5 ms.
SWITCH_INTERVAL = 0.001

#: Errors that prevent the start and that a user can fix; each message says how.
START_ERRORS = (
    AccessFileError,
    AuditError,
    CertificateError,
    OSError,
    PluginSettingsError,
    StoreError,
)

#: Seconds between two checks of the server's certificate, this computer's names and addresses, and
#: the certificates of connected clients; and between two warnings in the log about the same
#: certificate that has expired or will soon.
CERTIFICATE_CHECK = 300.0
CERTIFICATE_WARNING = 86400.0

#: Seconds until a background task is restarted after it failed.
TASK_RESTART_DELAY = 5.0


class App:
    """The whole appliance; it runs on the current event loop."""

    def __init__(
        self,
        settings: Settings,
        ros_arguments: Sequence[str] = (),
        notifier: Notifier | None = None,
        crashes: CrashReports | None = None,
        store: SessionStore | None = None,
    ) -> None:
        """Assign only; `start` reads files and opens ports. For the arguments see `run`."""
        self.settings = settings
        self._ros_arguments = ros_arguments
        self._opening = store
        self._notifier = notifier or Notifier()
        self._crashes = crashes
        self.addresses: list[tuple[str, int]] = []
        self.bridge: Bridge | None = None
        self.upstreams: list[Uplink] = []
        self.audit: Audit | None = None
        self._stack = contextlib.AsyncExitStack()
        self._stopping = asyncio.Event()
        #: Set when a SIGHUP came during the start, before a reload was possible.
        self._reload_requested = asyncio.Event()
        self._certificates_due = asyncio.Event()
        self._status: status.Status | None = None
        self._verbs: Verbs | None = None
        self._announcer = AnnouncerProcess()
        self._announced_host = mdns_settings.new_host()
        #: How late the clock's ticks are, and so everything else on the loop.
        self._lag = Histogram()

    async def start(self) -> None:
        """Start all parts; when one fails, stop those that run.

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
        self._keep_tokens(access)
        self.broker = broker = Broker(
            access,
            store,
            limits.of_broker(),
            broker_settings.features(),
        )
        broker.router.reserved += (f"{settings.robot}/_appliance/",)
        self._entries = Entries(loop, broker.faults)
        self._verb_thread = VerbThread()
        self._stack.push_async_callback(self._verb_thread.close)
        # Its program starts with the first announcement, which is made when all listeners are open,
        # and says farewell while the other parts stop.
        self._run_in_background(self._announcer.run)
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
            broker, login.authenticate, login.exchange, limits.build(Admission), tls, self._site
        )
        self._stack.push_async_callback(listeners.stop)
        self._inside = broker.attach("_appliance", InsideLink())
        self._pulse = Pulse(broker, listeners.scheduler, self._inside, loop.time)
        self._tls, self._store = tls, store
        self._login, self._access = login, access
        self._enrolments = Enrolments(lambda user: access.in_force.passwords.hash_of(user))
        self._phones = PhoneCertificates(lambda: self._reload.settings.broker, self._verb_thread)
        self._start_clock(loop)
        # Before the listeners start, and stopped after them: whatever a client is acknowledged is
        # offered to the links.
        self._start_upstreams(store)
        for topic in orphaned_topics(broker.retained, settings):  # the links tell of it, too
            self._publish(topic, b"", retain=True)
        if plugins is None:
            await listen()
            self._stack.push_async_callback(listeners.stop)
        else:  # they are notified before and after the listeners start, and stop
            await plugins.start()
            self._stack.push_async_callback(plugins.shutdown)
        self._start_bridge(loop)
        self._reload = Reload(
            ReloadParts(
                settings,
                access,
                tls,
                broker,
                listeners,
                self.bridge,
                self.audit,
                self._links,
                self._enrolments,
                self._announce,
            )
        )
        self._status = status.Status(
            status.StatusParts(
                version("ros-mqtt-appliance"),
                broker,
                listeners,
                store,
                self.bridge,
                self._links,
                self._reload,
                tls.warnings if tls is not None else list,
                self._announcer,
                self._verb_thread,
                self._crashes.previous if self._crashes is not None else None,
            )
        )
        self._start_management()
        if tls is not None:
            self._run_in_background(partial(self._renew_certificates, tls))
        if settings.file is not None:
            await self._open_control_socket()
        state = f"{settings.robot}/_appliance/state"
        self._publish(state, b"online", retain=True)
        self._stack.callback(self._publish, state, b"offline", retain=True)
        self._announce()
        self._stack.callback(self._announcer.announce, "the appliance is stopping")

    def _open_store(self) -> SessionStore:
        store, self._opening = self._opening or store_of(self.settings.broker.store), None
        store.open()
        self._stack.push_async_callback(store.close)
        return store

    def _keep_tokens(self, access: FileAccess) -> None:
        """Beside the store, where there is one, and where a boot of the computer has an id."""
        stored, boot = self.settings.broker.store, boot_id()
        if stored.durability != "off" and boot:
            access.keep_tokens(TokenFile(stored.path.with_name("tokens.json"), boot))

    def _run_in_background(self, work: Callable[[], Coroutine[object, object, None]]) -> None:
        """Run a task until the appliance stops; a failed task is reported and restarted."""

        async def restart_forever() -> None:
            while True:
                try:
                    await work()
                except Exception as error:
                    self.broker.faults.caught("app.beside", error)
                await asyncio.sleep(TASK_RESTART_DELAY)

        task = self._entries.task("app.task", restart_forever())

        async def end() -> None:
            while not task.done():  # a library can lose a cancellation
                task.cancel()
                await asyncio.wait({task}, timeout=1)

        self._stack.push_async_callback(end)

    async def _renew_certificates(self, tls: TlsContexts) -> None:
        """Renew the server's certificate when it is due, and warn of certificates that expire."""
        logged_at: dict[str, float] = {}
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
            logged_at = {
                text: at for text, at in logged_at.items() if now - at < CERTIFICATE_WARNING
            }
            for text in (*problems, *tls.warnings()):
                if text not in logged_at:
                    logged_at[text] = now
                    log.warning("%s", text)
            with contextlib.suppress(asyncio.TimeoutError):
                async with timeout(CERTIFICATE_CHECK):
                    await due.wait()
            due.clear()
            # Clients' certificates expire, too.
            await self._listeners.check_certificates()

    def _site(self) -> HttpSite:
        """What listeners for the web serve. Nothing of it is imported where there is none."""
        from appliance.app.web import WebParts, site

        return site(
            WebParts(
                version("ros-mqtt-appliance"),
                self.broker,
                self._store,
                lambda: self.bridge,
                lambda: self.upstreams,
                lambda: self._reload if self._status is not None else None,
                self._lag,
                self._access.tokens,
                self.settings.robot,
                self._tls,
                self._login,
                self._pulse,
                self._listeners,
                self._access,
                self._enrolments,
                self._phones,
                lambda: self._verbs,
            )
        )

    def _start_bridge(self, loop: asyncio.AbstractEventLoop) -> None:
        """Join the ROS bus in the background: MQTT does not wait for ROS."""
        settings = self.settings
        if settings.bridge.bus == "none":
            return
        bridge = settings.bridge
        arguments = (*bridge.ros_arguments, *self._ros_arguments)
        node: RosNode
        if bridge.bus == "ros1":
            node = Ros1Node(bridge.node, bridge.namespace, arguments)
        else:
            warning = discovery.use(bridge.discovery, os.environ)
            if warning:
                log.warning("%s", warning)
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
            home_assistant=bridge.home_assistant,
        )
        self._stack.push_async_callback(self.bridge.stop)
        self.bridge.start()

    def _start_upstreams(self, store: SessionStore) -> None:
        """Connect to the fleets' brokers in the background."""
        self._links = Links(self.broker, self._entries, store.backlogs, self._listeners.scheduler)
        self.upstreams = self._links.running
        self._stack.push_async_callback(self._links.stop)
        self._links.start(self.settings)

    def _start_management(self) -> None:
        """Answer what the appliance is asked over MQTT, and prepare that for the control socket."""
        assert self._status is not None
        self._verbs = management.verbs(
            management.ManagementParts(
                self.broker,
                self._entries,
                self._access,
                self._enrolments,
                self._phones,
                self.bridge,
                self.upstreams,
                self._status,
                self._reload,
                self.reload,
                self.audit,
                self._verb_thread,
            )
        )
        self._stack.push_async_callback(self._verbs.stop)
        calls = ManagementCalls(self.broker, self._entries, self._verbs)
        calls.start()
        self._stack.push_async_callback(calls.stop)

    def _announce(self) -> None:
        """Announce on the network what is in force now."""
        self.broker.faults.run("app.announce", self._announce_listeners, otherwise=None)

    def _announce_listeners(self) -> None:
        listening = [
            mdns_settings.Listening(Bind(host, port), each.context is not None, each.protocol)
            for host, port, each in self._listeners.bound()
        ]
        authority = self._tls.authority() if self._tls is not None else b""
        settings, host = self._reload.settings, self._announced_host
        self._announcer.announce(
            mdns_settings.announcement(settings, listening, authority, host, os.environ)
        )

    def _start_clock(self, loop: asyncio.AbstractEventLoop) -> None:
        """Tick every TICK seconds; publish `$SYS` every `broker.sys_interval`."""
        process = psutil.Process()
        sys_topics = SysTopics(
            self.broker, version("ros-mqtt-appliance"), lambda: process.memory_info().rss
        )
        interval = self.settings.broker.sys_interval
        next_sys = loop.time() + min(interval, TICK)
        steps = StepWatch(loop.time())
        run = self.broker.faults.run

        def check_clock(now: float) -> None:
            step = steps.look(now)
            if step:
                self._clock_was_set(step)

        def publish_sys() -> None:
            for topic, payload in sys_topics.update():
                run("clock.sys_topic", self._publish, topic, payload, True, otherwise=None)

        expected = loop.time() + TICK

        def tick() -> float:
            nonlocal next_sys, expected
            now = loop.time()
            self._lag.observe(now - expected)
            run("clock.step", check_clock, now, otherwise=None)
            due = run("clock.broker", self.broker.tick, now, otherwise=now + TICK)
            if self._status is not None:
                run("clock.status", self._status.tick, now, otherwise=None)
            if interval and now >= next_sys:
                next_sys = now + interval
                run("clock.sys", publish_sys, otherwise=None)
            expected = min(now + TICK, max(due, now + SHORTEST_TICK))
            return expected

        self._stack.callback(self._entries.every("clock", TICK, tick).cancel)

    def _clock_was_set(self, step: float) -> None:
        """The wall clock was set: only dates depend on it, so certificates are checked again."""
        text = f"the computer's clock was set {'forward' if step > 0 else 'back'} by "
        text += f"{timedelta(seconds=round(abs(step)))}"
        log.warning("%s, or the computer slept: nothing expires by that", text)
        for uplink in self.upstreams:
            uplink.clock_was_set()
        if self.audit is not None:
            self.audit.changed(text)
        self._certificates_due.set()
        self._listeners.scheduler.in_background(self._listeners.check_certificates())

    def _publish(self, topic: str, payload: bytes, retain: bool = False) -> None:
        self.broker.publish(Message(topic, payload, 0, retain), self._inside)
        self.broker.flush()

    async def stop(self) -> None:
        """Stop all parts in reverse order; may be called twice."""
        await self._stack.aclose()

    async def run(self) -> None:
        """Start, run until SIGTERM or SIGINT (or `request_stop`), stop."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self.request_stop)  # it only sets an event
        # Unhandled, SIGHUP would end the process. The start goes on with the files it has read; the
        # reload follows.
        loop.add_signal_handler(signal.SIGHUP, self._reload_requested.set)
        await self.start()
        _collect_from_now_on()
        self._entries.signal("signal.reload", signal.SIGHUP, self._on_hangup)
        if self._reload_requested.is_set():
            self._on_hangup()
        # Report readiness now that MQTT answers: the bridge joins ROS whenever ROS is there.
        assert self._status is not None
        self._notifier.start(self._entries, self._status.line, self._pulse.is_alive)
        try:
            await self._stopping.wait()
            log.info("stopping")
            self._notifier.stopping()
        finally:
            await self.stop()

    async def reload(self) -> list[str]:
        """Apply the files as they are now; see `Reload.run`."""
        with self._notifier.reloading():
            return await self._reload.run()

    async def _try_reload(self) -> None:
        with contextlib.suppress(ReloadError):  # it was logged
            try:
                await self.reload()
            except (ReloadError, asyncio.CancelledError):
                raise
            except Exception as error:
                self.broker.faults.caught("app.reload", error)

    def _on_hangup(self) -> None:
        self._listeners.scheduler.in_background(self._try_reload())

    async def _open_control_socket(self) -> None:
        """Answer commands such as `appliance status`, and watch the files for changes."""
        settings = self.settings
        settings.control.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        assert self._verbs is not None
        control = Control(settings.control, self._verbs.commands, self.broker.faults)
        try:
            await control.start()
        except OSError as error:
            # Go on without it: a robot's disk with errors is mounted read-only.
            if error.errno not in (errno.EROFS, errno.ENOSPC, errno.EDQUOT):
                raise
            log.error("`appliance status`, `reload` and `routes` are not answered: %s", error)
        self._stack.push_async_callback(control.stop)
        if settings.reload_on_change:
            read_at = settings.read_at
            self._run_in_background(partial(watch, self._reload.files, self._try_reload, read_at))

    def request_stop(self) -> None:
        """Make `run` return."""
        self._stopping.set()


def run(
    settings: Settings, ros_arguments: Sequence[str] = (), store: SessionStore | None = None
) -> int:
    """Run the appliance until a signal stops it; returns the exit code of the command.

    `ros_arguments` are those behind `--ros-args`; they come after those of the configuration.
    `store` is that of the settings, if it is being opened already.
    """
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # until `App.run` handles it: it would end us
    _tune_garbage_collector()
    sys.setswitchinterval(SWITCH_INTERVAL)
    notifier = Notifier.from_environment(os.environ)
    crashes = CrashReports(settings.crash_reports, settings)
    crashes.start()
    try:
        uvloop.run(App(settings, ros_arguments, notifier, crashes, store).run())
    except START_ERRORS:
        raise
    except Exception as error:
        crashes.crash(error)
        raise
    finally:
        gc.enable()
        crashes.stop()
        notifier.close()
    return 0


def _tune_garbage_collector() -> None:
    """Let Python collect young objects only, and nothing before `_collect_from_now_on`.

    A full collection traverses all sessions, subscriptions and retained messages, which stops the
    loop for 0.1 s and more, and is due whenever their number has grown by a quarter. Sessions and
    the like are no reference cycles, and are freed without it; cycles are in tasks and exceptions,
    which are young.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(YOUNG_OBJECTS, 10, NEVER)
    gc.disable()


def _collect_from_now_on() -> None:
    """After the start: what that has made is there to stay, and is never traversed.

    With 400,000 stored messages, collections took a tenth of the start, and the next one would
    have to traverse all of them.
    """
    gc.freeze()
    gc.enable()
