"""Examines the way to fleets' brokers: name, port, proxy, TLS and WebSocket of each server.

Nothing is logged in to and nothing is sent: a login would end the connection of the running link,
which has the same client id. What the files say, and which access rules are missing, `check` says.
"""

from __future__ import annotations

import asyncio
import ssl
import time
from collections.abc import Iterator
from typing import Any, Final

from async_timeout import timeout

from appliance.broker.accounts import Account
from appliance.broker.faults import Faults
from appliance.config import Settings
from appliance.config.urls import ServerUrl, parse_proxy
from appliance.net.callbacks import Entries
from appliance.net.layers import Schedulable, UpperLayer
from appliance.ops.finding import Finding
from appliance.upstream.credentials import read_credentials
from appliance.upstream.dial import dial
from appliance.upstream.dial_error import DialError
from appliance.upstream.limits import dialled_tls
from appliance.upstream.rules import UpstreamSettings
from appliance.upstream.settings import upstreams
from appliance.upstream.transport import Surroundings

#: Seconds for each step of a dial, and for all of it; all servers are dialled at once.
STEP_TIMEOUT: Final = 5.0
TIMEOUT: Final = 20.0

#: Days that a broker's certificate is valid below which it is told.
_SOON: Final = 14

_DAY: Final = 86400


def links(settings: Settings, running: dict[str, Any] | None) -> Iterator[Finding]:
    """Findings about each server of each link; `running` is the status of the running one."""
    found = upstreams(settings)
    if not found:
        return
    known = {each["name"]: each for each in (running or {}).get("upstreams", ())}
    results = asyncio.run(_dial_all(found))
    for link in found:
        subject = f"upstream {link.name}"
        if known.get(link.name, {}).get("connected"):
            text = f"the running link is connected to {known[link.name]['server']}"
            yield Finding("ok", subject, text)
        yield from _token(subject, link)
        outcomes = [results[link.name, server] for server in link.servers]
        is_reached = any(not isinstance(each, DialError) for each in outcomes)
        for server, outcome in zip(link.servers, outcomes, strict=True):
            if not isinstance(outcome, DialError):
                yield _reached(subject, server, outcome)
            else:
                text = f"{server}: at the step {outcome.step}: {outcome}"
                yield Finding("warning" if is_reached else "error", subject, text)


def _token(subject: str, link: UpstreamSettings) -> Iterator[Finding]:
    try:
        expires_at = read_credentials(link.login).expires_at
    except ValueError:
        return  # `check` says it
    if expires_at is not None and expires_at <= time.time():
        text = f"the token in {link.login.token_file} has expired by this computer's clock"
        yield Finding("error", subject, text, "put a new one there; is the clock right?")


def _reached(
    subject: str, server: ServerUrl, outcome: tuple[float, ssl.SSLObject | None]
) -> Finding:
    seconds, connection = outcome
    text = f"{server}: reached in {seconds * 1000:.0f} ms"
    if connection is None:
        return Finding("ok", subject, f"{text}; its login was not tried")
    certificate = connection.getpeercert() or {}
    until = str(certificate.get("notAfter", ""))
    text += f" with {connection.version()}, its certificate is valid until {until}"
    if until and ssl.cert_time_to_seconds(until) - time.time() < _SOON * _DAY:
        return Finding("warning", subject, text, "its owner has to renew it soon")
    return Finding("ok", subject, f"{text}; its login was not tried")


_Outcome = tuple[float, "ssl.SSLObject | None"]


async def _dial_all(
    found: list[UpstreamSettings],
) -> dict[tuple[str, ServerUrl], _Outcome | DialError]:
    """The outcome for each server of each link."""
    dialled = [(link, server) for link in found for server in link.servers]
    outcomes = await asyncio.gather(*(_dial(link, server) for link, server in dialled))
    return {
        (link.name, server): outcome
        for (link, server), outcome in zip(dialled, outcomes, strict=True)
    }


async def _dial(link: UpstreamSettings, server: ServerUrl) -> _Outcome | DialError:
    around = Surroundings(_Alone(), Account("doctor"), lambda size: None)
    began = time.monotonic()
    try:
        proxy = None if link.proxy is None else parse_proxy(link.proxy)
        tls = dialled_tls(link, server)
        async with timeout(TIMEOUT):
            transport = await dial(server, tls, proxy, around, STEP_TIMEOUT)
    except DialError as error:
        return error
    except asyncio.TimeoutError:
        return DialError("connection", f"it has not answered within {TIMEOUT:g} s")
    except (OSError, RuntimeError, ValueError) as error:
        return DialError("connection", str(error))
    seconds = time.monotonic() - began
    found = transport.info("ssl_object")
    transport.abort()
    return seconds, found if isinstance(found, ssl.SSLObject) else None


class _Alone:
    """A `LayerScheduler` for connections that share the process with nobody."""

    def __init__(self) -> None:
        self.entries = Entries(asyncio.get_running_loop(), Faults())

    def count_cost(self, cost: int, charged: UpperLayer) -> None:
        """See `LayerScheduler`."""

    def must_wait(self, charged: UpperLayer, *, is_small: bool) -> bool:
        """See `LayerScheduler`."""
        return False

    def queue_turn(self, member: Schedulable) -> None:
        """See `LayerScheduler`."""
        self.entries.soon("doctor.turn", member.take_turn)
