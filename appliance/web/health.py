"""`/healthz` and `/readyz`, for whoever watches the process: no login, and no versions."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Mapping
from enum import Enum

from appliance.net.http import HttpRequest, HttpResponse, text
from appliance.web.site import Resource


class PartState(Enum):
    """Of a part of the appliance; one that is not configured is OFF, and nobody waits for it."""

    READY = "ready"
    NOT_READY = "not ready"
    OFF = "off"


def healthz(problem: Callable[[], Awaitable[str]]) -> Resource:
    """200 while the event loop does real work: `problem` is why it does not, or empty."""

    async def respond(request: HttpRequest) -> HttpResponse:
        found = await problem()
        return text(503, found) if found else text(200, "ok")

    return Resource(respond)


def readyz(parts: Callable[[], Mapping[str, PartState]]) -> Resource:
    """200 when all parts are ready, or off; else 503. The body names each, as JSON."""

    async def respond(request: HttpRequest) -> HttpResponse:
        states = parts()
        body = json.dumps({name: state.value for name, state in states.items()})
        is_ready = PartState.NOT_READY not in states.values()
        return HttpResponse(200 if is_ready else 503, f"{body}\n".encode(), "application/json")

    return Resource(respond)
