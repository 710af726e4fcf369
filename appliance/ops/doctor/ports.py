"""Examines the addresses of all listeners: whether they are free, or which program uses them."""

from __future__ import annotations

import ipaddress
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil

from appliance.config import Bind, Settings
from appliance.ops.finding import Finding

_UNPRIVILEGED = Path("/proc/sys/net/ipv4/ip_unprivileged_port_start")
_ANY = ("", "0.0.0.0", "::", "*")


def ports(settings: Settings, running: dict[str, Any] | None) -> Iterator[Finding]:
    """Findings about every listener; `running` is the status of the running appliance."""
    pid = None if running is None else int(running["pid"])
    listening = list(_listening())
    for listener in settings.broker.listeners:
        bind = listener.bind
        subject = f"port {bind}" if bind.path is None else str(bind)
        if bind.path is not None:
            yield _socket(subject, bind.path, running)
        elif bind.port == 0:
            yield Finding("ok", subject, "whichever is free")
        else:
            yield _port(subject, bind, listening, pid, _is_for_root(settings))


def _is_for_root(settings: Settings) -> bool:
    """Whether the appliance runs as root: a service's configuration belongs to its own user."""
    if os.geteuid() != 0:
        return False
    file = settings.file
    return file is None or not file.exists() or file.stat().st_uid == 0


def _port(
    subject: str,
    bind: Bind,
    listening: list[tuple[str, int, int | None]],
    pid: int | None,
    is_for_root: bool,
) -> Finding:
    holders = [
        holder
        for host, port, holder in listening
        if port == bind.port and (host == bind.host or host in _ANY or bind.host in _ANY)
    ]
    if pid is not None and pid in holders:
        return Finding("ok", subject, f"the running appliance (pid {pid}) listens there")
    if holders:
        return Finding("error", subject, f"taken by {_name(holders[0])}", _advice(bind, holders))
    if not _is_here(bind.host):
        return Finding(
            "error",
            subject,
            f"this computer does not have the address {bind.host} now",
            "bind 0.0.0.0, or start the appliance when the network is there",
        )
    lowest = int(_UNPRIVILEGED.read_text()) if _UNPRIVILEGED.exists() else 1024
    if bind.port < lowest and not is_for_root:
        return Finding(
            "warning",
            subject,
            f"free, and below {lowest}: only root may listen there",
            "systemctl edit appliance: AmbientCapabilities=CAP_NET_BIND_SERVICE, and the same in "
            "CapabilityBoundingSet=; or another port",
        )
    if pid is not None:
        return Finding(
            "warning",
            subject,
            "free, though an appliance is running: it has read another configuration, or this one "
            "with other environment variables",
            "appliance reload, or give this command the same variables; `appliance status` says "
            "where it listens",
        )
    return Finding("ok", subject, "free")


def _advice(bind: Bind, holders: list[int | None]) -> str:
    name = _process_name(holders[0])
    if name is None:
        return (
            f"on the host as root, ss -ltnp 'sport = :{bind.port}' says whose it is; stop that, or "
            "change broker.listeners"
        )
    if name == "mosquitto":
        return "systemctl disable --now mosquitto, or change broker.listeners"
    return "stop it, or change broker.listeners"


def _socket(subject: str, path: Path, running: dict[str, Any] | None) -> Finding:
    if running is not None and any(each["bind"] == subject for each in running["listeners"]):
        return Finding("ok", subject, f"the running appliance (pid {running['pid']}) listens there")
    folder = path.parent
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        advice = f"make it, and give it to the appliance's user: install -d {folder}"
        return Finding("error", subject, f"{folder} is no folder that can be written", advice)
    if path.exists() and not path.is_socket():
        return Finding("error", subject, "there is another file", "move it away")
    return Finding("ok", subject, "free")


def _listening() -> Iterator[tuple[str, int, int | None]]:
    """Host, port and pid of all listening TCP sockets; the pid is None for those of other users."""
    for connection in psutil.net_connections("tcp"):
        if connection.status == psutil.CONN_LISTEN:
            yield connection.laddr.ip, connection.laddr.port, connection.pid


def _is_here(host: str) -> bool:
    """Whether that is an address of this computer; host names are assumed to be."""
    if host in _ANY:
        return True
    try:
        wanted = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return True
    if wanted.is_loopback:
        return True
    here = (each.address for each in _addresses())
    return any(ipaddress.ip_address(address.partition("%")[0]) == wanted for address in here)


def _addresses() -> Iterator[Any]:
    for addresses in psutil.net_if_addrs().values():
        yield from (each for each in addresses if each.family in (socket.AF_INET, socket.AF_INET6))


def _name(pid: int | None) -> str:
    name = _process_name(pid)
    if name is None:
        return "a program of another user, or outside of this container"
    return f"{name} (pid {pid})"


def _process_name(pid: int | None) -> str | None:
    if pid is None:
        return None
    try:
        return str(psutil.Process(pid).name())
    except psutil.Error:
        return None
