"""Who answers an HTTP request: by its path, once its Host is one of ours.

Another site's page can send a browser here by any name that it has a DNS server for (DNS
rebinding), but not by a name of our certificate or by an address; so other hosts are refused.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Awaitable, Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Final
from urllib.parse import urlsplit

from appliance.mqtt.codec import quote
from appliance.net.http import HttpRequest, HttpResponse, text
from appliance.net.origin import REFUSAL, CertificateUser, is_foreign, misuses_certificate
from appliance.net.websocket import PATH

#: The methods of what can only be looked at.
LOOK: Final = ("GET", "HEAD")


@dataclass(frozen=True, slots=True)
class Resource:
    """What is at a path: its answer, and the methods that it has."""

    respond: Callable[[HttpRequest], Awaitable[HttpResponse]]
    methods: tuple[str, ...] = LOOK
    takes_body: bool = False


class WebSite:
    """The `HttpSite` of all listeners for the web.

    A path of `resources` that ends in `/` stands for all below it that have no entry. `names` are
    those of the server's certificate, in lower case; `*.` stands for one label. `certificate_user`
    is the user that a client's certificate names; a browser shows that on its own, whichever page
    asks it to.
    """

    def __init__(
        self,
        resources: Mapping[str, Resource],
        names: Callable[[], Collection[str]],
        certificate_user: CertificateUser,
    ) -> None:
        self._resources = {PATH: Resource(_needs_upgrade, ("GET",)), **resources}
        self._names = names
        self._certificate_user = certificate_user

    async def respond(self, request: HttpRequest) -> HttpResponse:
        """Answer a request; see `HttpSite`."""
        refusal = self._misdirected(request)
        if refusal is not None:
            return refusal
        resource = self._at(request.path)
        if resource is None:
            return text(404, "nothing is here")
        if request.method not in resource.methods:
            allowed = ", ".join(resource.methods)
            return text(405, f"use one of: {allowed}", ("Allow", allowed))
        if request.method not in LOOK and is_foreign(
            _origins(request), request.host, tls=request.tls is not None
        ):
            return text(403, "a page of another site may not change anything here")
        return await resource.respond(request)

    def takes_body(self, request: HttpRequest) -> bool:
        """Whether the request may have a body; see `HttpSite`."""
        resource = self._at(request.path)
        return resource is not None and resource.takes_body and request.method not in LOOK

    def _at(self, path: str) -> Resource | None:
        first = path[1:].partition("/")[0]
        return self._resources.get(path) or self._resources.get(f"/{first}/")

    def objection(self, request: HttpRequest) -> HttpResponse | None:
        """Why the request may not become a WebSocket; see `HttpSite`."""
        return self._misdirected(request) or self._foreign(request)

    def _misdirected(self, request: HttpRequest) -> HttpResponse | None:
        host = _host_of(request.host)
        if host and (_is_address(host) or is_named(host, self._names())):
            return None
        return text(421, f"{quote(host)[:80]} is not a name of this server's certificate")

    def _foreign(self, request: HttpRequest) -> HttpResponse | None:
        """Refuse another site's page where the browser logs in by itself, by its certificate."""
        user = self._certificate_user
        if not misuses_certificate(_origins(request), request.host, request.tls, user):
            return None
        return text(403, REFUSAL)


def _origins(request: HttpRequest) -> list[str]:
    return [value for name, value in request.headers if name == "origin"]


def is_named(host: str, names: Collection[str]) -> bool:
    """Whether the host is one of the names (RFC 6125, section 6.4)."""
    return host in names or f"*.{host.partition('.')[2]}" in names


def _host_of(authority: str) -> str:
    """The host of an authority, in lower case; empty if it is none."""
    try:
        parts = urlsplit(f"//{authority}")
        _ = parts.port  # ValueError for what is not a number
    except ValueError:
        return ""
    if parts.netloc != authority or "@" in authority or parts.path or parts.query:
        return ""
    return (parts.hostname or "").rstrip(".")


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return False
    return True


async def _needs_upgrade(request: HttpRequest) -> HttpResponse:
    headers = (("Upgrade", "websocket"), ("Connection", "Upgrade"))
    return text(426, "MQTT over WebSocket is here", *headers)
