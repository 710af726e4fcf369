"""`/ca.crt`: the CA's certificate, for who is to trust this server."""

from __future__ import annotations

import ipaddress
from collections.abc import Callable

from appliance.net.http import HttpRequest, HttpResponse, text
from appliance.web.site import Resource

CONTENT_TYPE = "application/x-x509-ca-cert"


def ca_certificate(pem: Callable[[], bytes]) -> Resource:
    """The certificate that `pem` returns (empty for none), over TLS and to this computer alone.

    On another way somebody could put another CA in its place, which the client would trust then.
    """

    async def respond(request: HttpRequest) -> HttpResponse:
        if request.tls is None and not is_local(request.peer):
            return text(403, "ask over TLS: on the way here it could be replaced")
        certificate = pem()
        if not certificate:
            return text(404, "there is no CA here")
        name = ("Content-Disposition", 'attachment; filename="ca.crt"')
        return HttpResponse(200, certificate, CONTENT_TYPE, (name,))

    return Resource(respond)


def is_local(peer: str) -> bool:
    """Whether that is this computer: a Unix socket, or loopback."""
    if not peer:
        return True
    address = ipaddress.ip_address(peer.partition("%")[0])
    mapped = getattr(address, "ipv4_mapped", None)
    return (mapped or address).is_loopback
