"""The parts of the appliance that listeners for the web serve; imported only where there is one."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from dataclasses import dataclass

from appliance.access import FileAccess, LoginPolicy, is_token, no_user
from appliance.access.enrolments import Enrolments
from appliance.app.enrolment import EnrolmentParts, enrol
from appliance.app.metrics import Metrics, MetricsParts
from appliance.certs import TlsContexts
from appliance.management.phone_certificates import PhoneCertificates
from appliance.management.topics import topic_of
from appliance.management.verbs import Verbs
from appliance.net.listeners import Listeners
from appliance.ops.watchdog import Pulse
from appliance.ros.payload.cost import json_cost
from appliance.web.api import Api
from appliance.web.authority import ca_certificate
from appliance.web.console import Console
from appliance.web.health import PartState, healthz, readyz
from appliance.web.login import WebLogin
from appliance.web.metrics import metrics
from appliance.web.site import WebSite

#: Each of its addresses is this computer.
LOCALHOST = "localhost"


@dataclass(frozen=True, slots=True)
class WebParts(MetricsParts):
    """What the web is about: what the metrics are, and these."""

    robot: str
    tls: TlsContexts | None
    login: LoginPolicy
    pulse: Pulse
    listeners: Listeners
    access: FileAccess
    enrolments: Enrolments
    phones: PhoneCertificates
    verbs: Callable[[], Verbs | None]


def site(parts: WebParts) -> WebSite:
    """All that is served."""
    tls = parts.tls
    login = WebLogin(parts.broker, parts.login, asyncio.get_running_loop().time)
    return WebSite(
        {
            **Console(parts.robot).resources,
            "/healthz": healthz(parts.pulse.problem),
            "/readyz": readyz(lambda: _states(parts)),
            "/ca.crt": ca_certificate(tls.authority if tls is not None else bytes),
            "/metrics": metrics(login, Metrics(parts).render),
            **Api(parts.listeners.carry, is_token, topic_of, json_cost).resources,
            "/enrol": enrol(
                EnrolmentParts(
                    parts.broker,
                    parts.access,
                    login,
                    parts.enrolments,
                    parts.phones,
                    parts.verbs,
                    lambda: _mqtts_port(parts.listeners),
                )
            ),
        },
        _names(tls),
        tls.username if tls is not None else no_user,
    )


def _names(tls: TlsContexts | None) -> Callable[[], frozenset[str]]:
    """The names by which this server is known: of its certificate, or else of the computer."""
    if tls is not None:
        return lambda: tls.names | {LOCALHOST}
    host = socket.gethostname().lower()
    known = frozenset((LOCALHOST, host, f"{host.partition('.')[0]}.local"))
    return lambda: known


def _mqtts_port(listeners: Listeners) -> int | None:
    """The first port of MQTT over TLS, for apps; None where there is none."""
    for (_, port), (_, settings) in zip(listeners.addresses, listeners.sockets(), strict=True):
        if settings.protocol == "mqtt" and settings.context is not None and settings.path is None:
            return port
    return None


def _states(parts: WebParts) -> dict[str, PartState]:
    def state(is_ready: bool) -> PartState:
        return PartState.READY if is_ready else PartState.NOT_READY

    off, store, bridge, upstreams = PartState.OFF, parts.store, parts.bridge(), parts.upstreams()
    return {
        "mqtt": state(bool(parts.listeners.addresses)),
        "store": off if store.path is None else state(not store.failing),
        "ros": off if bridge is None else state(bridge.state == "joined"),
        "upstream": state(all(each.is_connected for each in upstreams)) if upstreams else off,
    }
