"""What is announced by multicast DNS: the listeners with TLS that the network reaches."""

from __future__ import annotations

import hashlib
import secrets
import ssl
from collections.abc import Iterable, Mapping
from typing import Final, Literal, NamedTuple

from appliance.config import Bind, Settings
from appliance.mdns.announcement import HTTPS, SECURE_MQTT, Announcement, Service

#: The environment variable that turns it off whatever the configuration says, as for tests.
VARIABLE: Final = "APPLIANCE_MDNS"

_KINDS: Final = {"mqtt": SECURE_MQTT, "web": HTTPS}


class Listening(NamedTuple):
    """A listener as it is open: with the address and the port that it has got."""

    bind: Bind
    tls: bool
    protocol: Literal["mqtt", "websocket", "web"]


def new_host() -> str:
    """The beginning of the host names of one run. They are not the computer's own, which another
    program announces, and which robots of one image often share."""
    return f"appliance-{secrets.token_hex(5)}"


def announcement(
    settings: Settings,
    listening: Iterable[Listening],
    authority: bytes,
    host: str,
    environment: Mapping[str, str],
) -> Announcement | str:
    """What is announced; a text is the reason why nothing is.

    `authority` is what clients have to trust, as PEM; empty where nobody has to be given it.
    """
    if not settings.broker.mdns:
        return "broker.mdns is false"
    if environment.get(VARIABLE) == "off":
        return f"{VARIABLE}=off in the environment"
    reached = [each for each in listening if not each.bind.loopback]
    if not reached:
        return "all listeners are for this computer only"
    hosts: dict[tuple[str, int], list[str]] = {}
    for each in reached:
        if each.tls and each.protocol in _KINDS:
            key = _KINDS[each.protocol], each.bind.port
            hosts.setdefault(key, []).append(each.bind.host.partition("%")[0])
    if not hosts:
        return "no listener that the network reaches has MQTT or the web over TLS"
    services = tuple(Service(kind, port, tuple(at)) for (kind, port), at in hosts.items())
    return Announcement(settings.robot, _fingerprint(authority), host, services)


def _fingerprint(pem: bytes) -> str:
    """The SHA-256 of the first certificate, as `appliance cert fingerprint` has it, without
    colons."""
    if not pem:
        return ""
    first, end, _ = pem.decode("ascii").partition(ssl.PEM_FOOTER)
    return hashlib.sha256(ssl.PEM_cert_to_DER_cert(first + end)).hexdigest().upper()
