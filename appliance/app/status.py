"""The state of the running appliance, for `appliance status`, `appliance doctor` and systemd."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import psutil

from appliance import certs
from appliance.app.reload import Reload
from appliance.broker.accounts import Account
from appliance.broker.broker import Broker
from appliance.broker.meter import Meter
from appliance.certs.settings import tls_files
from appliance.config import Settings, about_size, format_duration
from appliance.host.clock import RELEASED, is_unset
from appliance.management.verb_thread import VerbThread
from appliance.mdns.process import AnnouncerProcess
from appliance.net.listeners import Listeners
from appliance.ros.bridge import Bridge
from appliance.ros.status import RouteStatus
from appliance.ros.topics.flow import bridged
from appliance.store import SessionStore
from appliance.upstream.status import warnings_of as upstream_warnings

if TYPE_CHECKING:
    from appliance.app.links import Links

#: The part of a limit from which on its use is reported, with the users that hold most of it.
NEARLY_FULL = 0.8

#: How many of these users are reported.
HOLDERS = 3


@dataclass(slots=True)
class StatusParts:
    """The parts whose state is reported."""

    version: str
    broker: Broker
    listeners: Listeners
    store: SessionStore
    bridge: Bridge | None
    links: Links
    reload: Reload
    warnings: Callable[[], list[str]]
    announcer: AnnouncerProcess
    thread: VerbThread
    #: The crash report of the last run, if it crashed.
    crash: Path | None = None


class Status:
    """Measures message rates and reports the state of all parts; runs on the event loop."""

    def __init__(self, parts: StatusParts) -> None:
        self._parts = parts
        self._loop = asyncio.get_running_loop()
        self._started_at = self._loop.time()
        self._process = psutil.Process()
        self._received, self._sent = Meter(), Meter()

    def tick(self, now: float) -> None:
        """Update the rates; called about once a second."""
        counters = self._parts.broker.counters
        self._received.tick(now, counters.publish_received, counters.publish_bytes_received)
        self._sent.tick(now, counters.publish_sent, counters.publish_bytes_sent)

    def line(self) -> str:
        """A one-line summary for `systemctl status`."""
        bridge = self._parts.bridge
        if bridge is None:
            ros = "without ROS"
        elif bridge.state != "joined" and (problem := bridge.problem or bridge.obstacle):
            ros = f"no ROS: {problem}"
        elif bridge.state == "joined":
            ros = f"on ROS as {bridge.node_name}, {_count(bridge.count_topics(), 'topic')} bridged"
        else:
            ros = "joining ROS"
        text = f"{_count(len(self._parts.broker.clients), 'client')}, {ros}"
        if self._parts.crash is not None:
            text += f"; began after a crash, see {self._parts.crash}"
        return text

    async def report(self, user: str | None) -> dict[str, Any]:
        """The full state as JSON values, which the user asks for; sizes in bytes, times in
        seconds."""
        parts = self._parts
        settings = parts.reload.settings
        ros, routes = self._ros(settings), self._routes()
        report: dict[str, Any] = {
            "version": parts.version,
            "pid": os.getpid(),
            "robot": settings.robot,
            "configuration": str(settings.file),
            "since": self._date(self._started_at),
            "uptime": round(self._loop.time() - self._started_at),
            "listeners": self._listeners(),
            **self._clients(),
            "messages": self._messages(),
            "store": self._store(),
            "memory": self._memory(),
            "short": list(self._short()),
            "ros": ros,
            "routes": routes,
            "mdns": parts.announcer.status(),
            "upstreams": [uplink.status().as_json() for uplink in parts.links.running],
            "reload": self._reload(),
            "errors": self._errors(),
        }
        # In a thread: a revocation list may be long.
        found = await parts.thread.run(user, partial(endings, settings))
        report["certificates"] = [
            {
                "what": each.what,
                "file": str(each.file),
                "ends": each.ends.isoformat(),
                "days": each.days,
            }
            for each in found
        ]
        report["warnings"] = list(self._warnings(report))
        return report

    def _date(self, moment: float) -> str:
        """The date of a time of the loop's clock, by the wall clock as it is set now."""
        date = datetime.fromtimestamp(time.time() - self._loop.time() + moment, timezone.utc)
        return date.isoformat(timespec="seconds")

    def _listeners(self) -> list[dict[str, Any]]:
        return [
            {
                "bind": address,
                "tls": settings.context is not None,
                "protocol": settings.protocol,
            }
            for address, settings in self._parts.listeners.sockets()
        ]

    def _clients(self) -> dict[str, Any]:
        broker = self._parts.broker
        known = [session for session in broker.sessions.values() if not session.is_inside]
        inside = (each for each in broker.sessions.values() if each.is_inside)
        own = sum(len(each.subscriptions) for each in inside)
        return {
            "clients": len(broker.clients),
            "sessions": len(known),
            "subscriptions": broker.subscription_count - own,
            "retained": len(broker.retained),
            "waiting": sum(session.waiting + len(session.inflight) for session in known),
        }

    def _messages(self) -> dict[str, Any]:
        counters = self._parts.broker.counters
        return {
            "received": counters.publish_received,
            "received_a_second": round(self._received.rates[0], 1),
            "sent": counters.publish_sent,
            "sent_a_second": round(self._sent.rates[0], 1),
            **self._ros_rates(),
            "dropped": counters.publish_dropped,
            "refused": counters.publish_refused,
        }

    def _ros_rates(self) -> dict[str, float]:
        """Rates of the bridge; the other metrics are those of network clients."""
        flows = self._parts.bridge.flows() if self._parts.bridge is not None else []
        rates = {"to_mqtt": 0.0, "to_ros": 0.0}
        for topic, flow in bridged(flows):
            rates[topic.direction] += flow.meter.rates[0]
        return {
            "from_ros_a_second": round(rates["to_mqtt"], 1),
            "to_ros_a_second": round(rates["to_ros"], 1),
        }

    def _store(self) -> dict[str, Any] | None:
        store = self._parts.store
        if store.path is None:
            return None
        return {
            "path": str(store.path),
            "bytes": store.bytes,
            "limit": store.size,
            "failing": store.failing,
        }

    def _memory(self) -> dict[str, Any]:
        accounting = self._parts.broker.accounting
        return {
            "process": self._process.memory_info().rss,
            "queued": accounting.queued_bytes,
            "limit": accounting.memory,
        }

    def _short(self) -> Iterator[dict[str, Any]]:
        """The limits that are nearly reached, by all or by one user, and by whom."""
        broker = self._parts.broker
        accounting, limits, own = broker.accounting, broker.limits, broker.limits.user
        accounts, quotas, store = accounting.accounts, accounting.quotas, broker.store
        usages: list[tuple[str, int, int, int | None, Callable[[Account], int]]] = [
            (
                "connections",
                accounts.connections,
                limits.connections,
                own.connections,
                _CONNECTIONS,
            ),
            ("sessions", accounts.sessions, limits.sessions, own.sessions, _SESSIONS),
            ("memory", accounting.queued_bytes, accounting.memory, quotas.memory.own, _MEMORY),
            (
                "retained_messages",
                accounts.retained,
                limits.retained_messages,
                quotas.retained.own,
                _RETAINED,
            ),
            (
                "retained_bytes",
                accounts.retained_bytes,
                limits.retained_bytes,
                quotas.retained_bytes.own,
                _RETAINED_BYTES,
            ),
            ("stored", store.bytes, store.size, quotas.stored.own, _STORED),
        ]
        for what, used, limit, most, held in usages:
            holders = accounts.holders(held, HOLDERS)
            is_short = limit and used >= NEARLY_FULL * limit
            if holders and most:
                is_short = is_short or holders[0][1] >= NEARLY_FULL * most
            if is_short:
                yield {
                    "what": what,
                    "used": used,
                    "limit": limit,
                    "of_user": most,
                    "holders": [{"user": name, "held": size} for name, size in holders],
                }

    def _ros(self, settings: Settings) -> dict[str, Any]:
        bridge = self._parts.bridge
        if bridge is None:
            return {"bus": "none"}
        return {
            "bus": settings.bridge.bus,
            "state": bridge.state,
            "node": bridge.node_name,
            "nodes_seen": bridge.peers,
            "problem": bridge.problem or bridge.obstacle,
        }

    def _routes(self) -> dict[str, Any]:
        bridge = self._parts.bridge
        if bridge is None:
            return {"count": 0, "bridged": 0, "sick": []}
        topics, calls = bridge.status(), bridge.calls.status()
        sick = [
            {"route": name_of(route), "problem": problem, "lost": route.lost}
            for route in topics
            if (problem := problem_of(route))
        ]
        sick += [
            {
                "route": topic_shown(call.settings.names, call.settings.mqtt),
                "problem": call.counters.last_error,
                "lost": 0,
            }
            for call in calls
            if call.counters.last_error and not call.names
        ]
        bridged = bridge.count_topics() + len(bridge.calls.bridged())
        return {"count": len(topics) + len(calls), "bridged": bridged, "sick": sick}

    def _errors(self) -> dict[str, Any]:
        faults = self._parts.broker.faults
        return {
            "count": faults.count,
            "by_entry": dict(faults.by_entry),
            "last": faults.last,
            "report": faults.reported,
        }

    def _reload(self) -> dict[str, Any] | None:
        last = self._parts.reload.outcome
        if last is None:
            return None
        return {"at": self._date(last.at), "done": last.done, "text": last.text}

    def _warnings(self, report: dict[str, Any]) -> Iterator[str]:
        if is_unset():
            yield (
                f"the computer's clock says {datetime.now(timezone.utc):%Y-%m-%d}, which is before "
                f"{RELEASED:%Y-%m-%d}: it is not set"
            )
        yield from self._parts.warnings()
        if report["store"] is not None and report["store"]["failing"]:
            yield f"{report['store']['path']} cannot be written; see the log"
        for short in report["short"]:
            yield _shortage(short)
        problem = report["ros"].get("problem")
        if problem and report["ros"]["state"] == "joined":
            yield f"ROS: {problem}"
        elif problem:
            yield f"there is no bridge to ROS: {problem}"
        if report["mdns"]["problem"]:
            yield f"mDNS: {report['mdns']['problem']}"
        for upstream in report["upstreams"]:
            for text in upstream_warnings(upstream):
                yield f"upstream {upstream['name']}: {text}"
        for name in self._parts.links.left_behind:
            yield (
                f"messages wait for the upstream {name!r}, which is not in the file: give a link "
                f"that name and they are sent, or stop the appliance and: appliance store prune "
                f"--upstream {name}"
            )
        if self._parts.crash is not None:
            yield f"the last run crashed, see {self._parts.crash}"
        errors = report["errors"]
        if errors["count"]:
            crash_report = errors["report"]
            yield (
                f"faults of the appliance since its start: {errors['count']}, each ended what it "
                f"arose with and nothing else; the last: {errors['last']}"
                + (f"; please send us the report {crash_report}" if crash_report else "")
            )
        if report["reload"] is not None and not report["reload"]["done"]:
            yield f"the last reload took nothing over: {report['reload']['text']}"


def endings(settings: Settings) -> list[certs.Expiry]:
    """When what TLS uses expires; empty without TLS. It reads files: not for the event loop."""
    if not any(listener.tls for listener in settings.broker.listeners):
        return []
    try:
        return certs.expiries(tls_files(settings.broker))
    except certs.CertificateError:  # the loaded ones stay in use; the next reload reports it
        return []


#: An account's share of each limited resource.
_CONNECTIONS: Callable[[Account], int] = attrgetter("connections")
_SESSIONS: Callable[[Account], int] = attrgetter("sessions")
_MEMORY: Callable[[Account], int] = attrgetter("bytes")
_RETAINED: Callable[[Account], int] = attrgetter("retained")
_RETAINED_BYTES: Callable[[Account], int] = attrgetter("retained_bytes")
_STORED: Callable[[Account], int] = attrgetter("stored")

#: Seconds for which a message that could not be carried is a problem of its route.
_RECENT: Final = 600

#: The resources that are measured in bytes.
_SIZES = ("memory", "retained_bytes", "stored")


def _shortage(short: dict[str, Any]) -> str:
    """A warning about a limit that is nearly reached, and who holds most of it."""
    what = short["what"]

    def amount(number: int) -> str:
        return about_size(number) if what in _SIZES else str(number)

    whole = "broker.store.size" if what == "stored" else f"broker.limits.{what}"
    text = f"{amount(short['used'])} of {amount(short['limit'])} {what} in use ({whole}"
    if short["of_user"] is not None:
        text += f"; one user may have {amount(short['of_user'])}: broker.limits.user.{what}"
    most = ", ".join(f"{each['user']} {amount(each['held'])}" for each in short["holders"])
    return f"{text}){f', most of it: {most}' if most else ''}"


def name_of(route: RouteStatus) -> str:
    """A route as `appliance routes` shows it."""
    arrow = "→" if route.direction == "to_mqtt" else "←"
    settings = route.settings
    names = ", ".join(settings.names)
    return f"{names} {arrow} {topic_shown(settings.names, settings.mqtt)}"


def topic_shown(names: Iterable[str], template: str) -> str:
    """The MQTT topics of a route with these names; patterns stay patterns."""
    wanted = [name for name in names if not name.startswith("!")]
    topics = [
        template.replace("{ros}", name).replace("{node}", name.rpartition("/")[0])
        for name in wanted
    ]
    return ", ".join(dict.fromkeys(topics))


def problem_of(route: RouteStatus) -> str | None:
    """A route's problem; None when it has none."""
    if not route.topics and route.last_error is not None:
        return f"not bridged: {route.last_error}"
    found = []
    ago = time.monotonic() - route.last_error_at
    if route.errors and ago < _RECENT:
        told = f"the last {format_duration(max(1, round(ago)))} ago: {route.last_error}"
        found.append(f"messages that could not be carried: {route.errors} ({told})")
    if route.lost:
        found.append(f"messages that ROS's middleware lost on their way here: {route.lost}")
    if route.dropped:
        found.append(f"messages dropped: {route.dropped}")
    return ", ".join(found) or None


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
