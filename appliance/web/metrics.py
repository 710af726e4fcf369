"""`/metrics`: for who may read `$SYS/metrics`."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from appliance.net.http import HttpRequest, HttpResponse
from appliance.web.exposition import CONTENT_TYPE
from appliance.web.login import WebLogin
from appliance.web.site import Resource

#: The topic whose right to read it is needed. Nothing is published to it.
TOPIC = "$SYS/metrics"


def metrics(login: WebLogin, render: Callable[[], Awaitable[bytes]]) -> Resource:
    """What `render` returns, for who may read it."""

    async def respond(request: HttpRequest) -> HttpResponse:
        refusal = await login.may_read(request, TOPIC)
        if refusal is not None:
            return refusal
        return HttpResponse(200, await render(), CONTENT_TYPE)

    return Resource(respond)
