"""Reload: apply changed files while everything runs, either all of them or none."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Final, cast

from pydantic import BaseModel

from appliance import config
from appliance.access import AccessFileError, Changes, FileAccess, Rules
from appliance.access.enrolments import Enrolments
from appliance.app import wiring
from appliance.app.links import Links
from appliance.broker.broker import Broker
from appliance.broker.link import Link
from appliance.broker.session import Session
from appliance.certs import CertificateError, LoadedTls, TlsContexts
from appliance.certs.settings import tls_files, tls_policies
from appliance.config import ConfigError, Settings
from appliance.mqtt.reason import ReasonCode
from appliance.net.listeners import Admission, Listeners
from appliance.ops import logs
from appliance.ops.audit import Audit
from appliance.ros import settings as ros_settings
from appliance.ros.bridge import Bridge

log = logging.getLogger(__name__)

#: Keys that take effect at the start only.
NEEDS_RESTART: Final = (
    "robot",
    "control",
    "reload_on_change",
    "crash_reports",
    "broker.store",
    "broker.plugins",
    "broker.plugin_answers",
    "broker.audit",
    "broker.sys_interval",
    "broker.limits.connect_timeout",
    "broker.limits.failed_logins",
    "bridge.bus",
    "bridge.discovery",
    "bridge.node",
    "bridge.namespace",
    "bridge.domain_id",
    "bridge.ros_arguments",
    "bridge.use_sim_time",
    "bridge.diagnostics",
)


class ReloadError(Exception):
    """Nothing was applied; the text has every reason."""


@dataclass(slots=True)
class ReloadParts:
    """The parts that a reload changes."""

    settings: Settings
    access: FileAccess
    tls: TlsContexts | None
    broker: Broker
    listeners: Listeners
    bridge: Bridge | None
    audit: Audit | None
    links: Links
    enrolments: Enrolments
    #: Announces on the network what is in force now.
    announce: Callable[[], None]


@dataclass(frozen=True, slots=True)
class ReloadOutcome:
    """The result of a reload: its time by the loop's clock, whether it succeeded, and the text."""

    at: float
    done: bool
    text: str


@dataclass(frozen=True, slots=True)
class _LoadedFiles:
    """The content of all files, checked but not applied yet."""

    settings: Settings
    rules: Rules
    tls: LoadedTls | None


class Reload:
    """Runs reloads one after the other, on the event loop's thread."""

    def __init__(self, parts: ReloadParts) -> None:
        self._parts = parts
        self._lock = asyncio.Lock()
        #: The outcome of the last reload; None before the first.
        self.outcome: ReloadOutcome | None = None
        #: What the last reload that changed anything has changed, and when; empty before it.
        self.last_change = ""

    @property
    def settings(self) -> Settings:
        """The settings in force."""
        return self._parts.settings

    def files(self) -> set[Path]:
        """All files that a reload reads."""
        parts = self._parts
        found = set(parts.access.in_force.files)
        if parts.settings.file is not None:
            found.add(parts.settings.file)
        if parts.tls is not None:
            files = parts.tls.files
            paths = (files.certificate, files.key, files.ca, files.revocations)
            found |= {path for path in paths if path is not None}
        return found

    async def run(self) -> list[str]:
        """Apply the files as they are now; returns a list of what has changed.

        Raises:
            ReloadError: a file is wrong; the settings in force stay as they are.
        """
        async with self._lock:
            try:
                changed = await self._run()
            except ReloadError as error:
                self._ended(False, str(error))
                reason = str(error).replace("\n", "; ")
                log.error("not reloaded, what was in force stays so: %s", reason)
                if self._parts.audit is not None:
                    self._parts.audit.changed("nothing: the files cannot be used", error=str(error))
                raise
            text = ", ".join(changed) or "nothing has changed"
            if changed:
                self.last_change = f"which was at {datetime.now():%H:%M:%S}: {text}"
            self._ended(True, text)
            log.info("reloaded: %s", text)
            return changed

    def _ended(self, done: bool, text: str) -> None:
        self.outcome = ReloadOutcome(asyncio.get_running_loop().time(), done, text)

    async def renewed(self) -> None:
        """Apply the server's renewed certificate.

        Raises:
            CertificateError: this or another certificate file cannot be used.
        """
        async with self._lock:
            tls = self._parts.tls
            if tls is not None:
                self._take_certificates(tls, await asyncio.to_thread(tls.prepare))
                self._parts.announce()

    async def _run(self) -> list[str]:
        parts = self._parts
        try:
            # In a thread: long files take time, and logins must not wait for that.
            read = await asyncio.to_thread(_read, parts)
        except (ConfigError, AccessFileError, CertificateError) as error:
            raise ReloadError(str(error)) from None
        before, settings = parts.settings, read.settings
        wanted = wiring.listener_settings(settings, parts.tls)
        try:
            doors = parts.listeners.prepare(wanted)
        except OSError as error:
            raise ReloadError(str(error)) from None
        # Nothing below can fail.
        parts.settings = settings
        changed = [*_differences(before, settings)]
        limits = settings.broker.limits
        parts.broker.use(limits.of_broker(), settings.broker.features())
        parts.listeners.take(doors, wanted, limits.build(Admission))
        if parts.tls is not None and read.tls is not None:
            changed += self._take_certificates(parts.tls, read.tls)
        rights = parts.access.adopt(read.rules)
        changed += _of_users(rights)
        # Begins when others have a turn, which is below: the new rules are in force by then.
        closing = self._close_removed(rights.users_removed)
        if parts.bridge is not None:
            parts.bridge.tell_home_assistant(settings.bridge.home_assistant)
            parts.bridge.replace(ros_settings.routes(settings))
            parts.bridge.calls.replace(ros_settings.call_routes(settings))
            parts.bridge.clean_up_retained()
        if before.log != settings.log:
            logs.setup(settings.log.level, settings.log.levels, settings.log.format)
        parts.broker.rules_changed()
        parts.broker.flush()
        # Links that the routes change are among them: how late a command may be depends on these.
        changed += await parts.links.replace(settings)
        parts.announce()
        if parts.audit is not None and changed:
            parts.audit.changed(", ".join(changed), **asdict(rights))
        if closing is not None:  # which goes on if the caller is gone, who may be one of them
            await asyncio.wait({closing})
        return changed

    def _take_certificates(self, tls: TlsContexts, loaded: LoadedTls) -> list[str]:
        """Use them for new connections, and check those of connected clients against them."""
        before = tls.trust
        if not tls.take(loaded):
            return []
        if before != loaded.trust:
            self._parts.enrolments.end_others()
        listeners = self._parts.listeners
        listeners.scheduler.in_background(listeners.check_certificates())
        return ["certificates"]

    def _close_removed(self, names: list[str]) -> asyncio.Task[None] | None:
        """Close the connections of removed users, in the background: a user may have thousands.

        Only those that there are now, with those whose login began by the old files: who logs in
        from now on may do so by the new ones, such as by a certificate.
        """
        parts, removed = self._parts, set(names)
        if not removed:
            return None
        for connection in list(parts.listeners.scheduler.connections):
            connection.users_removed(removed)
        # Plugins may know users that the file has not, so only those count that it had. And a
        # session inside the appliance has not logged in: the rules alone decide about it.
        connected = [
            (session, session.link)
            for session in parts.broker.sessions.values()
            if session.identity is not None
            and session.identity.username in removed
            and not session.is_inside
            and session.link is not None
        ]

        def close(each: tuple[Session, Link]) -> None:
            session, link = each
            if session.link is link:
                reason = ReasonCode.ADMINISTRATIVE_ACTION, "the user was removed"
                parts.broker.faults.run("reload.close", link.close, *reason, otherwise=None)

        scheduler = parts.listeners.scheduler
        return scheduler.in_background(scheduler.in_pieces(connected, close))


def _of_users(changes: Changes) -> list[str]:
    """What has changed of users and rules, in words."""
    words = {
        "users_added": "new users: ",
        "users_removed": "users removed: ",
        "passwords_changed": "new passwords of: ",
    }
    changed = [
        text + ", ".join(names)
        for field, text in words.items()
        if (names := getattr(changes, field))
    ]
    return changed + (["access rules"] if changes.rules_changed else [])


def _read(parts: ReloadParts) -> _LoadedFiles:
    """Load and check all files; raises the error of the first that is wrong."""
    before = parts.settings
    settings = before if before.file is None else config.load(before.file)
    fixed = [
        f"{path} can only change with a restart"
        for path in _differences(before, settings)
        if path.startswith(NEEDS_RESTART)
    ]
    policies = tls_policies(settings.broker)
    if bool(policies) is not (parts.tls is not None):
        fixed.append("the first listener with TLS, and the last, can only change with a restart")
    if fixed:
        raise ReloadError("; ".join(fixed))
    rules = Rules.read(*wiring.access_files(settings), settings.robot, settings.broker.anonymous)
    tls = None
    if parts.tls is not None:
        broker = settings.broker
        tls = parts.tls.prepare(tls_files(broker), policies, broker.tls.username_from)
    return _LoadedFiles(settings, rules, tls)


def _differences(before: BaseModel, after: BaseModel, path: str = "") -> Iterator[str]:
    """The keys whose values differ."""
    for name in type(before).model_fields:
        old, new = getattr(before, name), getattr(after, name)
        if isinstance(old, BaseModel):
            yield from _differences(old, cast(BaseModel, new), f"{path}{name}.")
        elif old != new:
            yield path + name
