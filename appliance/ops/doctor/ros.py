"""Examines ROS: which ROS there is, and whether its nodes can be discovered from here."""

from __future__ import annotations

import os
import shutil
import socket
import threading
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

from appliance.config import Settings
from appliance.host.environment import of_service
from appliance.ops.doctor.ros1 import ros1
from appliance.ops.finding import Finding
from appliance.ros.ros2 import discovery, fastdds, installation
from appliance.ros.ros2.discovery import OPEN, OPEN_ADVICE, TWIN, TWIN_ADVICE
from appliance.ros.ros2.node import Ros2Node, available

#: Seconds for discovering other nodes: most are found in a tenth of a second, some take three.
PATIENCE = 5.0
#: Seconds to continue after the first node was found, to find the others.
LEAST_PATIENCE = 1.0

#: Where Fast DDS exchanges messages between nodes of one computer, and the free bytes it needs.
SHARED_MEMORY = Path("/dev/shm")
LEAST_SHARED_MEMORY = 40 << 20

#: The multicast group of DDS discovery, and seconds to wait for a datagram to arrive.
MULTICAST = "239.255.0.1"
MULTICAST_PATIENCE = 0.5

NODE = "appliance_doctor"

#: Environment variables that affect discovery.
_DISCOVERY = (
    "RMW_IMPLEMENTATION",
    "ROS_DOMAIN_ID",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_LOCALHOST_ONLY",
    "ROS_STATIC_PEERS",
    "ROS_DISCOVERY_SERVER",
    "FASTDDS_BUILTIN_TRANSPORTS",
    *fastdds.VARIABLES,
    "CYCLONEDDS_URI",
)

#: Topics that every node has.
_OF_EVERY_NODE = {"/parameter_events", "/rosout"}

_MIB = 1 << 20


def ros(settings: Settings, running: dict[str, Any] | None) -> Iterator[Finding]:
    """Which ROS there is, how its nodes find each other here, and which are seen."""
    if settings.bridge.bus == "none":
        yield Finding("ok", "ROS", "bridge.bus is none")
        return
    if settings.bridge.bus == "ros1":
        yield from ros1(running, is_needed=_has_routes(settings))
        return
    adopted = adopt_environment(settings, running)
    if adopted:
        text = f"as the appliance has it: {', '.join(adopted)}"
        yield Finding("ok", "ROS environment", text)
    ignored = discovery.use(settings.bridge.discovery, os.environ)
    if ignored:
        yield Finding("warning", "ROS environment", ignored)
    yield which_ros(is_needed=_has_routes(settings))
    yield from _discovery(settings)
    yield from shared_memory()
    yield from _networks()
    is_available, _ = available()
    if is_available:
        yield from _discover(settings, running)


def adopt_environment(settings: Settings, running: dict[str, Any] | None) -> list[str]:
    """Set the variables that affect discovery as the appliance has them; returns what differed.

    A root shell has neither the service's variables nor, after `sudo`, those of the user.
    """
    theirs: dict[str, str] = {}
    if running is None:
        theirs = of_service(settings.file) if settings.file is not None else {}
    else:
        with suppress(OSError):
            lines = Path(f"/proc/{running['pid']}/environ").read_bytes().split(b"\0")
            theirs = dict(os.fsdecode(line).partition("=")[::2] for line in lines if line)
    adopted = []
    for name in _DISCOVERY if theirs else ():
        value = theirs.get(name)
        if value != os.environ.get(name) and (value is not None or running is not None):
            adopted.append(f"{name}={value}" if value is not None else f"no {name}")
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
    return adopted


def _has_routes(settings: Settings) -> bool:
    bridge = settings.bridge
    return bool(bridge.topics or bridge.services or bridge.actions or bridge.parameters)


def which_ros(is_needed: bool) -> Finding:
    """Which ROS 2 is used, and from where; without one the broker works alone."""
    is_available, reason = available()
    if not is_available:
        what, _, advice = reason.partition(". ")
        return Finding("error" if is_needed else "warning", "ROS", what, advice)
    found = installation.find()
    python = ".".join(map(str, found.python))
    text = (
        str(found.sourced)
        if found.source == "sourced"
        else f"ROS 2 in {found.where}, {found.source} (Python {python})"
    )
    return Finding("warning" if found.advice else "ok", "ROS", text, found.advice)


def _discovery(settings: Settings) -> Iterator[Finding]:
    """Findings about discovery, from settings and environment variables."""
    environment = os.environ
    rmw = environment.get("RMW_IMPLEMENTATION") or "rmw_fastrtps_cpp"
    domain = settings.bridge.domain_id
    source = "bridge.domain_id" if domain is not None else "ROS_DOMAIN_ID"
    number = str(domain) if domain is not None else environment.get("ROS_DOMAIN_ID") or "0"
    text = f"{rmw}, domain {number} ({source}), {_range(environment)}"
    if not number.isdigit() or int(number) > 232:
        yield Finding("error", "ROS network", text, "a domain is a number from 0 to 232")
    elif int(number) > 101:
        advice = "a domain up to 101: the ports of others may be taken by outgoing connections"
        yield Finding("warning", "ROS network", text, advice)
    else:
        yield Finding("ok", "ROS network", text)
    if not (discovery.is_local(environment) or discovery.is_secured(environment)):
        yield Finding("warning", "ROS network", OPEN, OPEN_ADVICE)


def _range(environment: Mapping[str, str]) -> str:
    if environment.get(discovery.RANGE, "").upper() == "OFF":
        return f"no nodes are looked for ({discovery.RANGE})"
    if discovery.is_local(environment):
        return "nodes of this computer only"
    peers = environment.get("ROS_STATIC_PEERS") or environment.get("ROS_DISCOVERY_SERVER")
    return "nodes of the network" + (f", and {peers}" if peers else "")


def shared_memory(folder: Path = SHARED_MEMORY) -> Iterator[Finding]:
    """Whether nodes of this computer can exchange large messages."""
    advice = "mount -t tmpfs -o size=256m tmpfs /dev/shm; in a container: --shm-size=256m"
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        text = f"{folder} cannot be written: messages go over the network's loopback"
        yield Finding("warning", "shared memory", text, advice)
        return
    free = shutil.disk_usage(folder).free
    text = f"{folder}: {free // _MIB} MiB free"
    if free < LEAST_SHARED_MEMORY:
        yield Finding("warning", "shared memory", f"{text}, a node may want 32", advice)
    else:
        yield Finding("ok", "shared memory", text)


def _networks() -> Iterator[Finding]:
    """Findings about networks: whether they carry the multicast of DDS discovery."""
    states = psutil.net_if_stats()
    up = [name for name in states if states[name].isup]
    if "lo" in states and "lo" not in up:
        text = "the loopback (lo) is down: not even nodes of this computer are seen"
        yield Finding("error", "network", text, "ip link set lo up")
    working: list[str] = []
    broken: list[str] = []
    for name, addresses in psutil.net_if_addrs().items():
        hosts = [each.address for each in addresses if each.family == socket.AF_INET]
        if name in up and name != "lo" and hosts:
            (working if _carries_multicast(hosts[0]) else broken).append(f"{name} ({hosts[0]})")
    if working:
        yield Finding("ok", "network", f"multicast works on {', '.join(working)}")
    if broken:
        text = f"no multicast on {', '.join(broken)}: nodes there are not found"
        advice = f"allow UDP to {MULTICAST} in the firewall; ip link set DEVICE multicast on"
        yield Finding("warning", "network", text, advice)
    if not working and not broken:
        text = "there is none but this computer's own: nodes of others are not seen"
        yield Finding("ok", "network", text)


def _carries_multicast(address: str) -> bool:
    """Whether a multicast datagram on that interface comes back; nothing leaves this computer."""
    own = socket.inet_aton(address)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        suppress(OSError),
    ):
        receiver.bind(("", 0))
        group = socket.inet_aton(MULTICAST) + own
        receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        receiver.settimeout(MULTICAST_PATIENCE)
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, own)
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        sender.sendto(b"appliance doctor", (MULTICAST, receiver.getsockname()[1]))
        return receiver.recv(64) == b"appliance doctor"
    return False


def _discover(settings: Settings, running: dict[str, Any] | None) -> Iterator[Finding]:
    """Join as a node for a moment, and report which other nodes it discovers."""
    bridge = settings.bridge
    node = Ros2Node(NODE, bridge.namespace, bridge.domain_id)
    ours = None
    if running is not None and running["ros"].get("state") == "joined":
        ours = running["ros"]["node"]
    seen = _Discovered(node, ours)
    node.start(seen.update, seen.failed)
    try:
        seen.wait()
    finally:
        node.stop()
    subject = "ROS nodes"
    if seen.problem:
        yield Finding("error", subject, f"ROS cannot be joined: {seen.problem}")
        return
    if ours is not None and ours not in seen.nodes:
        text = f"the running appliance, {ours}, is not seen: nodes do not find each other here"
        advice = "the same RMW_IMPLEMENTATION, ROS_DOMAIN_ID and discovery range for all of them"
        yield Finding("error", subject, text, advice)
        return
    if seen.has_twin:
        yield Finding("warning", subject, f"{ours}: {TWIN}", TWIN_ADVICE)
    others = sorted(seen.nodes - {ours or ""})
    if not others:
        advice = (
            "start one (ros2 run demo_nodes_cpp talker); if it is running, compare "
            "RMW_IMPLEMENTATION, ROS_DOMAIN_ID and discovery range with its"
        )
        none = "none" if ours is None else f"none but the running appliance ({ours})"
        yield Finding("warning", subject, f"{none} was seen within {PATIENCE:g} s", advice)
        return
    named = ", ".join(others[:5]) + (", …" if len(others) > 5 else "")
    text = f"seen: {len(others)} ({named}), with {len(seen.topics)} topics"
    yield Finding("ok", subject, text)
    if seen.elsewhere and not discovery.is_secured(os.environ):
        named = ", ".join(sorted(seen.elsewhere)[:5]) + (", …" if len(seen.elsewhere) > 5 else "")
        text = f"on other computers or in containers: {len(seen.elsewhere)} ({named}); {OPEN}"
        yield Finding("warning", subject, text, OPEN_ADVICE)


class _Discovered:
    """What a node has discovered; `update` and `failed` are called on its thread."""

    def __init__(self, node: Ros2Node, ours: str | None) -> None:
        """`ours` is the running appliance's node, for which `wait` waits as well as for others."""
        self.nodes: set[str] = set()
        self.topics: set[str] = set()
        #: Nodes on other computers or in containers.
        self.elsewhere: set[str] = set()
        #: Whether another node has the name of the running appliance's.
        self.has_twin = False
        self.problem = ""
        self._node = node
        self._ours = ours
        self._is_done = threading.Event()

    def update(self) -> None:
        names = self._node.nodes()
        self.nodes = {name for name in names if name != self._node.name}
        self.has_twin = self._ours is not None and names.count(self._ours) > 1
        self.topics = set(self._node.topics()) - _OF_EVERY_NODE
        self.elsewhere = self._node.elsewhere()
        if self.nodes - {self._ours} and (self._ours is None or self._ours in self.nodes):
            self._is_done.set()

    def failed(self, reason: str) -> None:
        self.problem = reason
        self._is_done.set()

    def wait(self) -> None:
        """Wait until a node was discovered, and a while longer for the others."""
        if self._is_done.wait(PATIENCE) and not self.problem:
            threading.Event().wait(LEAST_PATIENCE)
