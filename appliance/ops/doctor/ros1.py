"""Examines ROS 1: which one there is, whether its Master responds, and which nodes that knows."""

from __future__ import annotations

import ipaddress
import os
import socket
import sys
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

from appliance.ops.finding import Finding, Level
from appliance.ros.node import BusError
from appliance.ros.ros1.node import available, found, master_uri
from appliance.ros.ros1.peers import Master

NODE = "/appliance_doctor"

#: The node that runs whenever roscore does.
_ROSOUT = "/rosout"


def ros1(running: dict[str, Any] | None, *, is_needed: bool) -> Iterator[Finding]:
    """Findings about ROS 1. Without it the broker works alone: with routes that is an error."""
    missing: Level = "error" if is_needed else "warning"
    is_available, reason = available()
    if not is_available:
        what, _, advice = reason.partition(". ")
        yield Finding(missing, "ROS", what, advice)
    else:
        python = f"{sys.version_info[0]}.{sys.version_info[1]}"
        yield Finding("ok", "ROS", f"{found()} (Python {python})")
    uri = master_uri()
    source = "ROS_MASTER_URI" if os.environ.get("ROS_MASTER_URI") else "ROS_MASTER_URI is not set"
    yield _address(uri)
    master = Master(uri, NODE)
    try:
        graph = [dict(part) for part in master.call("getSystemState")]
    except (BusError, TypeError, ValueError) as error:
        advice = (
            "start roscore; if it is running, ROS_MASTER_URI is to say where: http://robot:11311"
        )
        yield Finding(missing, "ROS Master", f"it does not answer: {error} ({source})", advice)
        return
    yield Finding("ok", "ROS Master", f"{uri} answers ({source})")
    yield _nodes(graph, running)


def _address(uri: str) -> Finding:
    """A finding about the address that this computer announces to other nodes."""
    subject = "ROS network"
    variable = next((name for name in ("ROS_HOSTNAME", "ROS_IP") if os.environ.get(name)), "")
    own = os.environ[variable] if variable else socket.gethostname()
    text = f"other nodes are told to connect to {own} ({variable or 'the name of this computer'})"
    advice = "set ROS_IP to the address that other computers reach this one by"
    addresses = _resolve(own)
    if not addresses:
        return Finding("warning", subject, f"{text}, which has no address here", advice)
    master = _resolve(urlsplit(uri).hostname or "")
    is_far = bool(master) and not any(each.is_loopback for each in master)
    if is_far and all(each.is_loopback for each in addresses):
        problem = f"{text}, which other computers take for themselves; the Master is on one"
        return Finding("warning", subject, problem, advice)
    return Finding("ok", subject, text)


def _resolve(host: str) -> list[ipaddress.IPv4Address | ipaddress.IPv6Address]:
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return []
    return [ipaddress.ip_address(str(address[0]).partition("%")[0]) for *_, address in found]


def _nodes(graph: list[dict[str, list[str]]], running: dict[str, Any] | None) -> Finding:
    """A finding about the other nodes that the Master knows."""
    subject = "ROS nodes"
    nodes = {node for part in graph for nodes in part.values() for node in nodes}
    ours = None
    if running is not None and running["ros"].get("state") == "joined":
        ours = running["ros"]["node"]
    if ours is not None and ours not in nodes:
        text = f"the running appliance, {ours}, is not known to this Master"
        advice = "the same ROS_MASTER_URI here as it has; after a new start of the Master, a second"
        return Finding("error", subject, text, advice)
    others = sorted(nodes - {ours, _ROSOUT})
    if not others:
        none = "none" if ours is None else f"none but the running appliance ({ours})"
        advice = "start one (rostopic pub -r 1 /chatter std_msgs/String hello)"
        return Finding("warning", subject, f"the Master knows of {none}", advice)
    topics = graph[0].keys() | graph[1].keys()
    named = ", ".join(others[:5]) + (", …" if len(others) > 5 else "")
    return Finding("ok", subject, f"seen: {len(others)} ({named}), with {len(topics)} topics")
