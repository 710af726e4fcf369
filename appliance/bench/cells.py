"""The cells of the comparison: the load of each, its brokers, and its goals."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

from appliance.bench import peers
from appliance.bench.load import Result
from appliance.bench.peers import PASSWORD_VARIABLE, Peer, PeerError, Server, Site
from appliance.ros.ros2 import fastdds

GRACE_SECONDS = 90.0  # for a run to connect and settle, beyond the time that it measures
PACE = 1000.0  # messages a second of the bridge's cells
IMAGE_PACE = 30.0  # the same of images
PACES = [
    round(2000 * 1.5**step) for step in range(9)
]  # up to 51,258, which is near the sender's limit
PACE_SECONDS = 2.0
BACKLOG_US = 50_000.0  # of median latency: a queue is growing, and will lose messages
LOSS = 0.001  # counted as none: a computer with other work stalls for longer than a queue holds


class Side(Protocol):
    """One broker with the load that a cell drives it with."""

    @property
    def name(self) -> str:
        """The name of the broker."""

    def measure(self, seconds: float) -> Result:
        """Run the cell once."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One row of the report.

    `goals` are minimum ratios of mosquitto's figures to ours, set for mosquitto 2.1. `at_least` and
    `at_most` are goals of our own figures.
    """

    other: ClassVar[str | None] = None  # what is measured in mosquitto's place, where it is not

    name: str
    title: str
    goals: Mapping[str, float] = field(default_factory=dict)
    at_least: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    at_most: Mapping[str, float] = field(default_factory=dict, kw_only=True)

    @property
    def once(self) -> bool:
        """Whether one round is enough.

        The memory of a connection is measured once a process, before that has freed any.
        """
        return "memory_kib" in self.goals

    def missing(self) -> str | None:
        """What this computer lacks to run the cell."""
        return None

    def ours(self, site: Site) -> contextlib.AbstractContextManager[Side]:
        """Run this appliance."""
        raise NotImplementedError

    def peer(self, site: Site, peer: Peer) -> contextlib.AbstractContextManager[Side]:
        """Run mosquitto, with what else the cell needs."""
        raise NotImplementedError

    def note(self, site: Site) -> str | None:
        """What to report beside the figures, once the cell has ended."""
        return None


@dataclass(frozen=True, slots=True)
class LoadSide:
    """A broker driven by the load generator."""

    server: Server
    load: str
    tls: bool

    @property
    def name(self) -> str:
        """The name of the broker."""
        return self.server.name

    def measure(self, seconds: float) -> Result:
        """Run the load generator once."""
        return run_measuring(
            ["load", self.load, *self.server.arguments(self.tls)], self.server.site, seconds
        )


@dataclass(frozen=True, slots=True)
class LoadCell(Cell):
    """A broker alone, driven by `appliance.bench.load`."""

    load: str = ""
    tls: bool = False

    @contextlib.contextmanager
    def ours(self, site: Site) -> Iterator[Side]:
        with peers.appliance(site, [], os.environ) as server:
            yield LoadSide(server, self.load, self.tls)

    @contextlib.contextmanager
    def peer(self, site: Site, peer: Peer) -> Iterator[Side]:
        with peers.mosquitto(peer, site) as server:
            yield LoadSide(server, self.load, self.tls)


@dataclass(frozen=True, slots=True)
class FloodCell(LoadCell):
    """A publisher that is faster than its subscriber; both brokers with their default queues."""

    @contextlib.contextmanager
    def ours(self, site: Site) -> Iterator[Side]:
        with peers.appliance(site, [], os.environ, default_queues=True) as server:
            yield LoadSide(server, self.load, self.tls)

    @contextlib.contextmanager
    def peer(self, site: Site, peer: Peer) -> Iterator[Side]:
        with peers.mosquitto(peer, site, default_queues=True) as server:
            yield LoadSide(server, self.load, self.tls)


@dataclass(frozen=True, slots=True)
class StoreCell(LoadCell):
    """This broker storing every message, against itself without a store."""

    other = "appliance without its store"

    @contextlib.contextmanager
    def ours(self, site: Site) -> Iterator[Side]:
        with peers.appliance(site, [], os.environ, "power") as server:
            yield LoadSide(server, self.load, self.tls)

    @contextlib.contextmanager
    def peer(self, site: Site, peer: Peer) -> Iterator[Side]:
        with peers.appliance(site, [], os.environ) as server:
            yield LoadSide(server, self.load, self.tls)

    def note(self, site: Site) -> str | None:
        """How many messages each commit had, out of the log."""
        logs = [log.read_text(errors="replace") for log in site.directory.glob("*/log")]
        found = re.search(r"\d+ commits of .*", "\n".join(logs))
        return f"{found[0]}; in the peer's column: without the store" if found else None


@dataclass(frozen=True, slots=True)
class BridgeSide:
    """A broker with a bridge, between a sender and a receiver."""

    server: Server
    send: Sequence[str]
    receive: Sequence[str]
    environment: Mapping[str, str]
    maximum: bool = False
    pace: float = PACE

    @property
    def name(self) -> str:
        """The name of the broker."""
        return self.server.name

    def measure(self, seconds: float) -> Result:
        """Run at the usual pace, or at rising ones up to the highest without loss."""
        if not self.maximum:
            return self._measure(seconds, self.pace)
        best: Result | None = None
        for pace in PACES:
            result = self._measure(min(seconds, PACE_SECONDS), pace)
            late = result.p50_us is None or result.p50_us > BACKLOG_US
            behind = result.rate is None or result.rate < 0.95 * pace
            if late or behind or result.lost > LOSS * (result.messages + result.lost):
                break
            best = dataclasses.replace(result, lost=0)
        if best is None:
            raise PeerError(f"loses messages at {PACES[0]} a second")
        return best

    def _measure(self, seconds: float, pace: float) -> Result:
        """Run a sender and a receiver, until the receiver has measured."""
        site, options = self.server.site, self.server.arguments()
        sending = [*self.send, *options, "--rate", str(pace), "--seconds", str(GRACE_SECONDS)]
        command = [sys.executable, "-m", "appliance.bench.ends", *sending]
        environment = {**self.environment, PASSWORD_VARIABLE: site.password}
        with peers.running("the sender", command, environment, site.directory / "sender.log"):
            return run_measuring(["ends", *self.receive, *options], site, seconds, environment)


@dataclass(frozen=True, slots=True)
class RosCell(Cell):
    """A cell of the bridge, which needs ROS 2."""

    def missing(self) -> str | None:
        for module in ("rclpy", "std_msgs", "sensor_msgs"):
            if importlib.util.find_spec(module) is None:
                return f"needs ROS 2: no Python module {module}; source it, or install .[ros]"
        return None


@dataclass(frozen=True, slots=True)
class BridgeCell(RosCell):
    """Paced std_msgs/String through the bridge, against the tutorial node with mosquitto."""

    send: Sequence[str] = ()
    receive: Sequence[str] = ()
    maximum: bool = False  # measure the highest rate without loss instead of the usual one

    @property
    def once(self) -> bool:
        """The search for the highest rate is a series of runs by itself."""
        return self.maximum

    @property
    def queue(self) -> int:
        """Depth of the bridge's queues: ten as in tutorials, or enough not to limit the rate."""
        return 1000 if self.maximum else 10

    @contextlib.contextmanager
    def ours(self, site: Site) -> Iterator[Side]:
        # Like the tutorial node: the plain text, QoS 0, and the same depth of queues.
        route = {"type": "std_msgs/msg/String", "encoding": "text", "keep": self.queue}
        to_mqtt = {"ros": "/chatter", "to": "mqtt", "qos": 0, **route}
        to_ros = {"ros": "/command", "to": "ros", **route}
        environment = ros_environment(0)
        with peers.appliance(site, [to_mqtt, to_ros], environment) as server:
            yield BridgeSide(server, self.send, self.receive, environment, self.maximum)

    @contextlib.contextmanager
    def peer(self, site: Site, peer: Peer) -> Iterator[Side]:
        environment = {**ros_environment(1), PASSWORD_VARIABLE: site.password}
        with peers.mosquitto(peer, site) as server:
            argv = [sys.executable, "-m", "appliance.bench.tutorial"]
            argv += [str(server.port), peers.USER, PASSWORD_VARIABLE, str(self.queue)]
            log = site.directory / "tutorial.log"
            with peers.running("the tutorial node", argv, environment, log) as node:
                both = dataclasses.replace(server, pids=(*server.pids, node.pid))
                yield BridgeSide(both, self.send, self.receive, environment, self.maximum)


@dataclass(frozen=True, slots=True)
class ListeningSide:
    """A bare raw subscription of rclpy, whose callback does nothing."""

    site: Site
    send: Sequence[str]
    environment: Mapping[str, str]

    @property
    def name(self) -> str:
        """The name of the broker."""
        return "rclpy"

    def measure(self, seconds: float) -> Result:
        """Run a sender, until the subscription has measured itself."""
        sending = [*self.send, "--rate", str(IMAGE_PACE), "--seconds", str(GRACE_SECONDS)]
        command = [sys.executable, "-m", "appliance.bench.ends", *sending]
        with peers.running(
            "the sender", command, self.environment, self.site.directory / "sender.log"
        ):
            listening = ["ends", "ros-listen", "--topic", CAMERA, "--image"]
            return run_measuring(listening, self.site, seconds, self.environment)


@dataclass(frozen=True, slots=True)
class ImageCell(RosCell):
    """Images of 1 MB as CDR to one MQTT client, against a subscription that does nothing."""

    other = "rclpy"

    @contextlib.contextmanager
    def ours(self, site: Site) -> Iterator[Side]:
        route = {"ros": f"/{CAMERA}", "to": "mqtt", "encoding": "cdr", "qos": 0}
        environment = image_environment(0)
        receive = ("mqtt-receive", "--topic", f"bench/{CAMERA}")
        with peers.appliance(site, [route], environment) as server:
            yield BridgeSide(server, SEND_IMAGES, receive, environment, pace=IMAGE_PACE)

    @contextlib.contextmanager
    def peer(self, site: Site, peer: Peer) -> Iterator[Side]:
        yield ListeningSide(site, SEND_IMAGES, image_environment(1))

    def note(self, site: Site) -> str | None:
        """What the peer's column has."""
        return "in the peer's column: a raw subscription of rclpy that does nothing"


@dataclass(frozen=True, slots=True)
class ConversionSide:
    """One way to convert to JSON, alone in a process."""

    name: str
    site: Site
    how: str

    def measure(self, seconds: float) -> Result:
        """Convert for `seconds`."""
        return run_measuring(["conversion", self.how], self.site, seconds)


@dataclass(frozen=True, slots=True)
class ConversionCell(RosCell):
    """The conversion of a message to JSON, against rclpy's deserialization and `json`."""

    other = "rclpy"

    @contextlib.contextmanager
    def ours(self, site: Site) -> Iterator[Side]:
        yield ConversionSide("appliance", site, "ours")

    @contextlib.contextmanager
    def peer(self, site: Site, peer: Peer) -> Iterator[Side]:
        yield ConversionSide("rclpy", site, "rclpy")

    def note(self, site: Site) -> str | None:
        """What the peer's column has."""
        return "in the peer's column: rclpy's deserialize, its fields walked, json"


def ros_environment(number: int) -> dict[str, str]:
    """An environment whose ROS is limited to this computer, with a domain for each number."""
    # The ports of domains above 101 are among Linux's ephemeral ports.
    domain = 2 + (2 * os.getpid() + number) % 98
    return {
        **os.environ,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOCALHOST_ONLY": "1",  # Humble's name for it
        "ROS_DOMAIN_ID": str(domain),
    }


def image_environment(number: int) -> dict[str, str]:
    """The same, with a profile that passes images through shared memory, for senders too."""
    return {
        **ros_environment(number),
        **dict.fromkeys(fastdds.VARIABLES, str(fastdds.file_of("default"))),
    }


def run_measuring(
    arguments: Sequence[str],
    site: Site,
    seconds: float,
    environment: Mapping[str, str] = os.environ,
) -> Result:
    """Run a program of this package in a process of its own; its result. Raises PeerError."""
    module, *options = arguments
    command = [sys.executable, "-m", f"appliance.bench.{module}", *options]
    if module == "load":
        command.append("--json")
    try:
        done = subprocess.run(
            [*command, "--seconds", str(seconds)],
            capture_output=True,
            text=True,
            timeout=3 * seconds + GRACE_SECONDS,
            env={**environment, PASSWORD_VARIABLE: site.password},
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise PeerError(f"no result after {3 * seconds + GRACE_SECONDS:g} s") from None
    if done.returncode:
        raise PeerError(done.stderr.strip().rpartition("\n")[2] or f"exit {done.returncode}")
    return Result(**json.loads(done.stdout))


CPU = "cpu_us"  # the figure that varies least, and counts
FIVEFOLD = {CPU: 5.0, "p50_us": 2.0, "p99_us": 2.0}
THREEFOLD = {CPU: 3.0, "p50_us": 2.0, "p99_us": 2.0}
TO_MQTT = (("ros-send", "--topic", "chatter"), ("mqtt-receive", "--topic", "bench/chatter"))
TO_ROS = (("mqtt-send", "--topic", "bench/command"), ("ros-receive", "--topic", "command"))
CAMERA = "camera"
SEND_IMAGES = ("ros-send", "--topic", CAMERA, "--image")
# The broker alone, the comparison that README's and the pages' words about its speed rest on. The
# goals are ratios of CPU time to that of mosquitto 2.1, built with optimisation.
BROKER: tuple[Cell, ...] = (
    LoadCell("qos0-pair", "QoS 0, one pair, one at a time", {CPU: 1.0}, "qos0-pair"),
    LoadCell("qos0-pipelined", "QoS 0, one pair, pipelined", {CPU: 2.0}, "qos0-pipelined"),
    LoadCell("qos1-inflight50", "QoS 1, one pair, 50 in flight", {CPU: 2.0}, "qos1-inflight50"),
    LoadCell("qos1-50pairs", "QoS 1, 50 pairs, one at a time each", {CPU: 1.0}, "qos1-50pairs"),
    LoadCell("qos0-fanout50", "QoS 0, one to 50 subscribers", {CPU: 1.0}, "qos0-fanout50"),
    LoadCell("qos1-100k", "QoS 1, 100 KB payload", {CPU: 1.0}, "qos1-100k"),
    LoadCell("qos2-inflight20", "QoS 2, one pair, 20 in flight", {CPU: 1.5}, "qos2-inflight20"),
    LoadCell("qos0-pair-tls", "TLS: QoS 0, one at a time", {CPU: 1.0}, "qos0-pair", True),
    LoadCell("qos1-50pairs-tls", "TLS: QoS 1, 50 pairs", {CPU: 1.0}, "qos1-50pairs", True),
    LoadCell(
        "qos1-inflight50-tls", "TLS: QoS 1, 50 in flight", {CPU: 2.0}, "qos1-inflight50", True
    ),
)
CELLS: tuple[Cell, ...] = (
    *BROKER,
    StoreCell("qos1-stored", "QoS 1, 50 in flight, stored", {"rate": 0.5}, "qos1-stored"),
    FloodCell("flood", "QoS 1, faster than the subscriber", {"rate": 2.0}, "flood"),
    LoadCell("idle-tls", "memory an idle TLS connection", {"memory_kib": 0.25}, "idle", True),
    BridgeCell("ros-to-mqtt", "ROS → MQTT, String at 1 kHz", FIVEFOLD, *TO_MQTT),
    BridgeCell("mqtt-to-ros", "MQTT → ROS, String at 1 kHz", THREEFOLD, *TO_ROS),
    BridgeCell("ros-to-mqtt-max", "ROS → MQTT, highest rate", {"rate": 6.0}, *TO_MQTT, True),
    BridgeCell("mqtt-to-ros-max", "MQTT → ROS, highest rate", {"rate": 3.0}, *TO_ROS, True),
    ConversionCell("imu-json", "sensor_msgs/Imu to JSON, alone", {CPU: 8.0}),
    ImageCell("image-cdr", "ROS → MQTT, 1 MB Image as CDR at 30 Hz", {CPU: 0.77}),
)
