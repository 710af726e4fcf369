"""What `/metrics` says: the counters of all parts. Labels come from the configuration alone."""

from __future__ import annotations

import asyncio
import resource
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import psutil

from appliance import certs
from appliance.access.tokens import Tokens
from appliance.app.reload import Reload
from appliance.app.status import endings
from appliance.broker.broker import Broker
from appliance.broker.histogram import Histogram
from appliance.mqtt.codec import reason_name
from appliance.ros.bridge import Bridge
from appliance.ros.calls.routes import ActionSettings, CallStatus, ServiceSettings
from appliance.ros.status import RouteTotal
from appliance.store import SessionStore
from appliance.web.exposition import Exposition, labels

if TYPE_CHECKING:
    from appliance.upstream.status import LinkStatus
    from appliance.upstream.uplink import Uplink

#: Seconds for which the dates of certificates are cached: a revocation list may be long.
CERTIFICATES_CACHED: Final = 60.0

#: Bytes of metrics that cost about as much as a message, see `Counters.cost`.
BYTES_PER_COST_UNIT: Final = 512

#: The counters of routes, by their attribute of `FlowCounters`, and what they count.
_ROUTES: Final = (
    ("messages", "Messages that the route has carried."),
    ("bytes", "Payload bytes of these on MQTT."),
    ("dropped", "Messages that waited here and made room for newer ones."),
    ("lost", "Messages that ROS's middleware lost on their way here."),
    ("throttled", "Messages beyond the route's rate or byte budget."),
    ("skipped", "Messages that a slow client was not sent, counted for each."),
    ("errors", "Messages that could not be converted or published."),
    ("expired", "Commands that came too late."),
    ("refused", "Commands that the route's rules forbid."),
    ("clamped", "Commands that were carried with other numbers."),
    ("stops", "Stop messages that the route has published by itself."),
)


@dataclass(frozen=True, slots=True)
class MetricsParts:
    """The parts whose counters are shown. The bridge, links and reloads begin after the listeners.

    Until `reload` returns one, the appliance starts.
    """

    version: str
    broker: Broker
    store: SessionStore
    bridge: Callable[[], Bridge | None]
    upstreams: Callable[[], Sequence[Uplink]]
    reload: Callable[[], Reload | None]
    lag: Histogram
    tokens: Tokens


class Metrics:
    """Renders the metrics of all parts; runs on the event loop, but for the certificates."""

    def __init__(self, parts: MetricsParts) -> None:
        self._parts = parts
        self._loop = asyncio.get_running_loop()
        self._process = psutil.Process()
        self._expiries: list[certs.Expiry] = []
        self._expiries_until = 0.0

    async def render(self) -> bytes:
        """All metrics as they are now."""
        reload = self._parts.reload()
        if reload is not None and self._loop.time() >= self._expiries_until:
            self._expiries = await asyncio.to_thread(endings, reload.settings)
            self._expiries_until = self._loop.time() + CERTIFICATES_CACHED
        found = Exposition()
        bridge, links = self._parts.bridge(), self._parts.upstreams()
        states = [link.status() for link in links]
        routes = bridge.totals() if bridge is not None else []
        await asyncio.sleep(0)  # others have their turn between the two halves of the work
        self._broker(found)
        self._sources(found, routes, states)
        self._bridge(found, bridge, routes)
        self._store(found)
        _upstreams(found, states)
        self._others(found, reload)
        text = bytes(found)
        self._parts.broker.counters.cost += len(text) // BYTES_PER_COST_UNIT
        return text

    def _broker(self, found: Exposition) -> None:
        broker = self._parts.broker
        counters, accounting = broker.counters, broker.accounting
        connected = len(broker.clients)
        sessions = sum(1 for session in broker.sessions.values() if not session.is_inside)
        found.family(
            "gauge",
            "build_info",
            "The version that runs.",
            [(labels(version=self._parts.version), 1)],
        )
        found.gauge("clients", "MQTT clients that are connected.", connected)
        found.family(
            "gauge",
            "sessions",
            "MQTT sessions, of clients that are connected and absent.",
            [('state="connected"', connected), ('state="disconnected"', sessions - connected)],
        )
        found.gauge("subscriptions", "Subscriptions.", broker.subscription_count)
        found.counter("connects_total", "Logins that succeeded.", counters.connects)
        refusals = [(labels(reason=reason_name(c)), n) for c, n in counters.refusals.items()]
        found.family(
            "counter",
            "connects_refused_total",
            "Connections that were refused: by the limits, or their CONNECT with this code.",
            [('reason="limits"', counters.connections_refused), *refusals],
        )
        found.counter(
            "logins_failed_total",
            "Logins with a wrong password or without the right to come in, over HTTP too.",
            counters.logins_failed,
        )
        tokens = self._parts.tokens
        found.gauge(
            "tokens", "Tokens that are in force, with which users stay signed in.", len(tokens)
        )
        found.counter("tokens_issued_total", "Tokens that were issued.", tokens.issued)
        for name, received, sent, about in (
            ("packets", counters.messages_received, counters.messages_sent, "MQTT packets"),
            (
                "message_bytes",
                counters.publish_bytes_received,
                counters.publish_bytes_sent,
                "Payload bytes of MQTT messages",
            ),
            (
                "network_bytes",
                counters.bytes_received,
                counters.bytes_sent,
                "Bytes of MQTT, without TLS and WebSocket",
            ),
        ):
            found.counter(f"{name}_received_total", f"{about} from clients.", received)
            found.counter(f"{name}_sent_total", f"{about} to clients.", sent)
        found.counter("messages_sent_total", "Messages to clients.", counters.publish_sent)
        found.family(
            "counter",
            "messages_dropped_total",
            "Messages that were not sent to a client, or not retained, by why.",
            [(labels(reason=reason), n) for reason, n in counters.dropped.items()],
        )
        found.counter(
            "messages_throttled_total",
            "Messages in whose place a client with a max-rate was sent a newer one.",
            counters.publish_throttled,
        )
        found.counter(
            "messages_refused_total",
            "Messages that their publisher had no right to, or that were wrong.",
            counters.publish_refused,
        )
        found.gauge("retained_messages", "Retained messages.", len(broker.retained))
        found.gauge("retained_bytes", "Their payloads together.", broker.retained.bytes)
        found.gauge("queued_bytes", "Bytes that wait for clients.", accounting.queued_bytes)
        found.gauge("memory_limit_bytes", "The most of these.", accounting.memory)
        found.histograms(
            "loop_lag_seconds",
            "How late a timer of the event loop was, once a second.",
            [("", self._parts.lag)],
        )
        found.counter(
            "errors_total", "Faults of the appliance, each contained.", broker.faults.count
        )

    def _bridge(self, found: Exposition, bridge: Bridge | None, routes: list[RouteTotal]) -> None:
        found.gauge(
            "ros_joined",
            "Whether the bridge is on the ROS bus.",
            int(bridge is not None and bridge.state == "joined"),
        )
        if bridge is None:
            return
        if bridge.peers is not None:
            found.gauge("ros_nodes", "Other nodes on the ROS bus.", bridge.peers)
        names = _route_labels(routes)
        named = list(zip(names, routes, strict=True))
        found.family(
            "gauge",
            "route_topics",
            "Topics that the route bridges now.",
            [(name, route.topics) for name, route in named],
        )
        for attribute, about in _ROUTES:
            values = [getattr(route.counters, attribute) for route in routes]
            found.counters(f"route_{attribute}_total", about, names, values)
        found.histograms(
            "route_latency_seconds",
            "From the publisher on ROS to the broker, of a sample of the messages.",
            [
                (name, route.counters.latency)
                for name, route in named
                if route.direction == "to_mqtt"
            ],
        )
        _calls(found, bridge.calls.status(), bridge.calls.goals)

    def _sources(
        self, found: Exposition, routes: list[RouteTotal], links: list[LinkStatus]
    ) -> None:
        """Messages that have come to the broker, by where from."""
        counters = self._parts.broker.counters
        carried = sum(route.counters.messages for route in routes if route.direction == "to_mqtt")
        found.family(
            "counter",
            "messages_received_total",
            "Messages that have come: from clients, from ROS, from fleets' brokers.",
            [
                ('source="client"', counters.publish_received),
                ('source="ros"', carried),
                ('source="upstream"', sum(link.received for link in links)),
            ],
        )

    def _store(self, found: Exposition) -> None:
        store = self._parts.store
        metrics = store.metrics
        if metrics is None:
            return
        begun = metrics.begun_at
        lag = 0.0 if begun is None else max(0.0, self._loop.time() - begun)
        found.counter("store_commits_total", "Commits.", metrics.commits)
        found.histograms(
            "store_commit_seconds",
            "How long a commit took, with the attempts that failed.",
            [("", metrics.duration)],
        )
        found.gauge("store_lag_seconds", "For how long the commit in progress is going on.", lag)
        found.gauge("store_bytes", "Bytes of messages in the store.", store.bytes)
        found.gauge("store_limit_bytes", "The most of these.", store.size)
        found.gauge("store_failing", "Whether nothing can be stored now.", int(store.failing))

    def _others(self, found: Exposition, reload: Reload | None) -> None:
        ends: dict[str, float] = {}
        for each in self._expiries:  # the first that ends of each kind
            ends[each.what] = min(each.ends.timestamp(), ends.get(each.what, float("inf")))
        found.family(
            "gauge",
            "certificate_expiry_timestamp_seconds",
            "When the server's certificate, the CA's and the revocation list expire.",
            [(labels(what=what), end) for what, end in ends.items()],
        )
        process = self._process
        outcome = reload.outcome if reload is not None else None
        started = process.create_time()
        at = started if outcome is None else time.time() - self._loop.time() + outcome.at
        found.gauge(
            "reload_success",
            "Whether the last reload has applied the files.",
            int(outcome is None or outcome.done),
        )
        found.gauge("reload_timestamp_seconds", "When that was; at first the start.", at)
        with process.oneshot():
            memory, spent = process.memory_info(), process.cpu_times()
        values: tuple[tuple[Literal["gauge", "counter"], str, str, float], ...] = (
            ("counter", "cpu_seconds_total", "CPU time, in seconds.", spent.user + spent.system),
            ("gauge", "resident_memory_bytes", "Resident memory.", memory.rss),
            ("gauge", "virtual_memory_bytes", "Virtual memory.", memory.vms),
            ("gauge", "start_time_seconds", "When the process was started.", started),
            ("gauge", "open_fds", "Open files.", process.num_fds()),
            ("gauge", "max_fds", "The most of these.", _most_files()),
        )
        for kind, name, about, number in values:
            found.family(kind, name, about, [("", number)], prefix="process_")


def _upstreams(found: Exposition, states: list[LinkStatus]) -> None:
    links = [(labels(upstream=link.name), link) for link in states]
    if not links:
        return
    kinds: tuple[
        tuple[Literal["gauge", "counter"], str, str, Callable[[LinkStatus], float]], ...
    ] = (
        (
            "gauge",
            "connected",
            "Whether the link is connected.",
            lambda link: int(link.connected),
        ),
        (
            "gauge",
            "backlog_messages",
            "Messages that wait for the fleet's broker.",
            lambda link: link.waiting,
        ),
        ("gauge", "backlog_bytes", "Their bytes.", lambda link: link.waiting_bytes),
        (
            "gauge",
            "backlog_age_seconds",
            "The age of the oldest of these.",
            lambda link: link.oldest or 0.0,
        ),
        ("counter", "sent_total", "Messages that it has sent.", lambda link: link.sent),
        (
            "counter",
            "received_total",
            "Messages that have come over it.",
            lambda link: link.received,
        ),
    )
    for kind, name, about, value in kinds:
        samples = [(named, value(link)) for named, link in links]
        found.family(kind, f"upstream_{name}", about, samples)
    found.family(
        "counter",
        "upstream_dropped_total",
        "Messages that were dropped, both ways, by rule and reason.",
        [
            (labels(upstream=link.name, rule=rule, reason=reason), count)
            for _, link in links
            for rule, reasons in link.dropped.items()
            for reason, count in reasons.items()
        ],
    )


def _calls(found: Exposition, calls: list[CallStatus], goals: int) -> None:
    outcomes: Counter[tuple[str, str]] = Counter()
    durations = {kind: Histogram() for kind in ("service", "action", "parameter")}
    for call in calls:
        kind = _kind_of(call)
        outcomes[kind, "answered"] += call.counters.answers
        outcomes.update({(kind, code): n for code, n in call.counters.errors.items()})
        durations[kind].add(call.counters.duration)
    found.family(
        "counter",
        "calls_total",
        "Calls that have ended: answered, or with this error.",
        [(labels(kind=kind, outcome=outcome), n) for (kind, outcome), n in outcomes.items()],
    )
    found.histograms(
        "call_seconds",
        "How long calls from MQTT took.",
        [(labels(kind=kind), histogram) for kind, histogram in durations.items()],
    )
    found.gauge("goals", "Goals of MQTT clients that are under way.", goals)


def _kind_of(call: CallStatus) -> str:
    if isinstance(call.settings, ServiceSettings):
        return "service"
    return "action" if isinstance(call.settings, ActionSettings) else "parameter"


def _route_labels(routes: list[RouteTotal]) -> tuple[str, ...]:
    """The labels of each route: its names on ROS, and its MQTT topic where that is another one.

    Of several that would be called the same, the later ones have a number.
    """
    found: list[str] = []
    seen: Counter[str] = Counter()
    for route in routes:
        settings = route.settings
        name = ", ".join(settings.names)
        if not settings.mqtt.endswith("{ros}"):
            name = f"{name} {settings.mqtt}"
        seen[f"{name} {route.direction}"] += 1
        number = seen[f"{name} {route.direction}"]
        name = name if number == 1 else f"{name} ({number})"
        found.append(labels(route=name, direction=route.direction))
    return tuple(found)


def _most_files() -> float:
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return float("inf") if soft == resource.RLIM_INFINITY else soft
