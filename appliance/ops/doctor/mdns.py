"""Examines what keeps the appliance from being found by multicast DNS."""

from __future__ import annotations

import contextlib
import errno
import socket
from collections.abc import Iterator
from typing import Any

from appliance.config import Settings
from appliance.host.interfaces import links, multicast_interfaces
from appliance.ops.finding import Finding

_SUBJECT = "mDNS"
_PORT = 5353


def mdns(settings: Settings, running: dict[str, Any] | None) -> Iterator[Finding]:
    """Findings about the announcing of the running appliance, and what it needs."""
    status = None if running is None else running.get("mdns")
    if status is not None and status["state"] == "off":
        yield Finding("ok", _SUBJECT, f"nothing is announced: {status['reason']}")
        return
    if status is not None and status["name"]:
        text = f"announced as {status['name']!r} on {'; '.join(status['links'])}"
        yield Finding("ok", _SUBJECT, text)
    if not settings.broker.mdns or all(each.bind.loopback for each in settings.broker.listeners):
        return
    if not multicast_interfaces():
        text = "no interface is connected that has an address and multicast: nobody can find it"
        advice = "ip address says which there are; connect one, or set broker.mdns to false"
        yield Finding("warning", _SUBJECT, text, advice)
    elif _is_kept_to_itself():
        text = f"another program keeps UDP port {_PORT} to itself"
        advice = "of avahi, set disallow-other-stacks=no in /etc/avahi/avahi-daemon.conf"
        yield Finding("warning", _SUBJECT, text, advice)
    elif status is None:
        there = "; ".join(map(str, links(multicast_interfaces())))
        yield Finding("ok", _SUBJECT, f"can be announced on {there}")


def _is_kept_to_itself() -> bool:
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind(("224.0.0.251", _PORT))  # the group's address: it takes nobody's packets
        except OSError as error:
            return error.errno == errno.EADDRINUSE
    return False
