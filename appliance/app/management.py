"""All verbs of the appliance, and those that ask its parts how they are."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import orjson

from appliance.access import FileAccess
from appliance.access.enrolments import Enrolments
from appliance.app.reload import Reload, ReloadError
from appliance.app.status import Status
from appliance.broker.broker import Broker
from appliance.certs.settings import authority_directory
from appliance.management.certificates import CertificateVerbs
from appliance.management.clients import ClientVerbs
from appliance.management.enrolment import EnrolmentVerb
from appliance.management.examination import DoctorVerb
from appliance.management.phone_certificates import PhoneCertificates
from appliance.management.records import RecordVerbs
from appliance.management.rights import RightsVerbs
from appliance.management.tokens import TokenVerbs
from appliance.management.users import UserVerbs
from appliance.management.verb_thread import VerbThread
from appliance.management.verbs import LONGEST_ANSWER, Arguments, Caller, Verb, Verbs
from appliance.net.callbacks import Entries
from appliance.ops.audit import Audit
from appliance.ros.announcements import TURN
from appliance.ros.bridge import Bridge
from appliance.ros.calls.dispatcher import CallError
from appliance.ros.status import topic_status
from appliance.ros.topics.flow import bridged

if TYPE_CHECKING:
    from collections.abc import Sequence

    from appliance.upstream.uplink import Uplink

#: Seconds that a reload has: with many users and rules it reads long files.
RELOAD_TIMEOUT = 60.0


@dataclass(frozen=True, slots=True)
class ManagementParts:
    """The parts that the verbs are about. `reload` applies the files as they are now."""

    broker: Broker
    entries: Entries
    access: FileAccess
    enrolments: Enrolments
    phones: PhoneCertificates
    bridge: Bridge | None
    upstreams: Sequence[Uplink]
    status: Status
    outcome: Reload
    reload: Callable[[], Awaitable[list[str]]]
    audit: Audit | None
    thread: VerbThread


def verbs(parts: ManagementParts) -> Verbs:
    """All of them."""
    reload, thread = parts.outcome, parts.thread

    def directory() -> Path | None:
        return authority_directory(reload.settings.broker)

    async def take_over() -> None:
        try:
            await parts.reload()
        except ReloadError as error:
            raise CallError("failed", f"it is in the file, and not in force: {error}") from None

    found = [
        *ApplianceVerbs(parts).verbs(),
        *ClientVerbs(parts.broker).verbs(),
        *RightsVerbs(parts.broker, parts.access, thread).verbs(),
        *UserVerbs(parts.access, thread, take_over).verbs(),
        *TokenVerbs(parts.broker, parts.access).verbs(),
        *EnrolmentVerb(parts.broker, parts.access, parts.enrolments, parts.phones, thread).verbs(),
        *CertificateVerbs(directory, thread, take_over).verbs(),
        # Its path changes with a restart only.
        *RecordVerbs(reload.settings.broker.audit.path, thread).verbs(),
    ]
    if reload.settings.file is not None:
        found += DoctorVerb(reload.settings.file).verbs()
    note = parts.audit.changed if parts.audit is not None else None
    return Verbs(found, parts.entries, thread, note)


class ApplianceVerbs:
    """The verbs about the appliance as a whole."""

    def __init__(self, parts: ManagementParts) -> None:
        self._parts = parts

    def verbs(self) -> Iterator[Verb[Any]]:
        """All of them."""
        yield Verb("status", Arguments, self._status)
        yield Verb("routes", Arguments, self._routes)
        yield Verb("skipped", Arguments, self._skipped)
        yield Verb("upstream", Arguments, self._upstream)
        yield Verb("reload", Arguments, self._reload, RELOAD_TIMEOUT, changes="reload")

    async def _status(self, caller: Caller, _: Arguments) -> dict[str, object]:
        return await self._parts.status.report(caller.user)

    async def _routes(self, caller: Caller, _: Arguments) -> list[Any]:
        bridge = self._running_bridge()
        # Which topics there are is decided now; only their entries are made later.
        topics = (topic_status(topic, flow) for topic, flow in list(bridged(bridge.flows())))
        return await _listed(caller, chain(topics, bridge.calls.bridged()))

    async def _skipped(self, caller: Caller, _: Arguments) -> list[Any]:
        return await _listed(caller, self._running_bridge().skips())

    async def _upstream(self, caller: Caller, _: Arguments) -> list[dict[str, object]]:
        uplinks = self._parts.upstreams
        return [{**uplink.status().as_json(), "aside": uplink.aside()} for uplink in uplinks]

    async def _reload(self, caller: Caller, _: Arguments) -> list[str]:
        try:
            changed = await self._parts.reload()
        except ReloadError as error:
            raise CallError("rejected", f"nothing was reloaded: {error}") from None
        last = self._parts.outcome.last_change
        if not changed and last:  # the file watcher was probably faster
            return [f"nothing has changed since the last reload, {last}"]
        return changed

    def _running_bridge(self) -> Bridge:
        bridge = self._parts.bridge
        if bridge is None:
            raise CallError("unavailable", "there is no bridge (bridge.bus is none)")
        if bridge.problem is not None:
            raise CallError("unavailable", f"there is no bridge to ROS: {bridge.problem}")
        return bridge


async def _listed(caller: Caller, entries: Iterable[object]) -> list[Any]:
    """The entries as JSON values, made in several turns: a robot may have thousands.

    Raises CallError as soon as they are more than a client is sent. On the control socket there is
    no limit.
    """
    listed: list[Any] = []
    size = 0
    for entry in entries:
        if listed and not len(listed) % TURN:
            await caller.turn()
        payload = orjson.dumps(entry)
        size += len(payload) + 1
        if size > LONGEST_ANSWER and caller.identity is not None:
            text = f"the answer has more than {LONGEST_ANSWER} bytes, which are the most"
            raise CallError("too_large", text)
        listed.append(orjson.loads(payload))
    return listed
