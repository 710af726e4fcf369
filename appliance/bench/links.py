"""The cells of a link to a fleet's broker, beside mosquitto as a bridge with the same window.

Each device has a mosquitto of its own as the fleet's broker. While that is away messages wait: the
appliance stores them, mosquitto has them in memory. Then they drain, over loopback or with the
round trip of a mobile network.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from appliance.bench import peers
from appliance.bench.cells import Cell, Side
from appliance.bench.drain import HERE, HIGH, THERE
from appliance.bench.growth import Subprocess, probing, program
from appliance.bench.load import Result
from appliance.bench.peers import USER, Peer, Server, Site

WINDOW = 1000  # the appliance's default; for mosquitto its max_inflight_messages
MESSAGES = 100_000
LEAST_MESSAGES = 2 * WINDOW  # the first window is not measured
ROUND_TRIP = 0.1  # of a mobile network, seconds
LEAST_RATE = 1000.0  # messages a second, below which a run is given up
GRACE_SECONDS = 120.0  # for a link to dial again, beyond that
USED = 0.95  # the part of window ÷ round trip that is to be reached
HIGH_SECONDS = 0.05  # that the high lane may take beside two round trips
BESIDE_SECONDS = 0.005  # the same of another client's round trip


@dataclass(frozen=True, slots=True)
class LinkSide:
    """A device with a link to a fleet's broker that is stopped and goes on."""

    server: Server
    drain: Subprocess
    probe: Subprocess
    seconds: float  # that filling or draining may take

    @property
    def name(self) -> str:
        """The name of the device."""
        return self.server.name

    def measure(self, seconds: float) -> Result:
        """Let the messages wait, and drain them; `seconds` does not matter."""
        self.drain.ask(self.seconds)
        self.probe.ask()
        result = Result(**self.drain.ask(self.seconds))
        return replace(result, beside_us=1e6 * self.probe.ask()["p99"])


@dataclass(frozen=True, slots=True)
class LinkCell(Cell):
    """How messages drain that waited while the fleet's broker was away."""

    round_trip: float = 0.0  # seconds
    messages: int = MESSAGES
    fleet: Peer | None = None  # the mosquitto that is the fleet's broker

    def missing(self) -> str | None:
        """The fleet's broker."""
        return None if self.fleet else "needs mosquitto as the fleet's broker"

    def note(self, site: Site) -> str | None:
        """What the window allows."""
        if not self.round_trip:
            return None
        most = WINDOW / self.round_trip
        return f"{WINDOW:,} ÷ round trip is {most:,.0f}/s: who is faster exceeds its window"

    @contextlib.contextmanager
    def ours(self, site: Site) -> Iterator[Side]:
        with self._fleet(site) as (fleet, port, pids):
            link = {
                "name": "fleet",
                "servers": [f"mqtt://127.0.0.1:{port}"],
                "user": USER,
                "prefix": THERE.removesuffix("link/"),
                "login": {"username": USER, "password_file": "fleet.password"},
                "window": WINDOW,
                "backlog": {"size": "4 GiB"},
                "out": [{"topic": f"link/{HIGH}", "priority": "high"}, {"topic": "link/#"}],
            }
            with (
                peers.appliance(site, [], os.environ, "power", upstreams=[link]) as server,
                self._side(server, fleet, pids) as side,
            ):
                yield side

    @contextlib.contextmanager
    def peer(self, site: Site, peer: Peer) -> Iterator[Side]:
        with self._fleet(site) as (fleet, port, pids):
            bridge = f"""\
connection fleet
address 127.0.0.1:{port}
bridge_protocol_version mqttv50
cleansession false
notifications false
remote_username {USER}
remote_password {site.password}
topic # out 1 {HERE} {THERE}
"""
            with (
                peers.mosquitto(peer, site, window=WINDOW, bridge=bridge) as server,
                self._side(server, fleet, pids) as side,
            ):
                yield side

    @contextlib.contextmanager
    def _fleet(self, site: Site) -> Iterator[tuple[Server, int, Sequence[int]]]:
        """The fleet's broker, the port where a link finds it, and the relay's process if any."""
        assert self.fleet is not None
        with peers.mosquitto(self.fleet, site, window=WINDOW) as fleet:
            if not self.round_trip:
                yield fleet, fleet.port, ()
                return
            command = [sys.executable, "-m", "appliance.bench.delay", "--to", str(fleet.port)]
            command += ["--round-trip", str(self.round_trip)]
            log = site.directory / f"delay-{fleet.port}.log"
            with peers.running("the relay", command, os.environ, log, talks=True) as process:
                port = Subprocess("the relay", process, log).answer()["port"]
                yield fleet, port, (process.pid,)

    @contextlib.contextmanager
    def _side(self, server: Server, fleet: Server, beside: Sequence[int]) -> Iterator[Side]:
        options = ["--fleet-port", str(fleet.port), "--fleet-pid", str(fleet.pids[0])]
        options += ["--messages", str(self.messages), "--window", str(WINDOW)]
        options += [option for pid in beside for option in ("--beside", str(pid))]
        with program("drain", server, False, options) as drain, probing(server) as probe:
            seconds = GRACE_SECONDS + self.messages / LEAST_RATE
            yield LinkSide(server, drain, probe, seconds)


def _cell(name: str, title: str, round_trip: float) -> LinkCell:
    goals = {"cpu_us": 1 / 1.5}
    if not round_trip:  # otherwise the window limits us, and not mosquitto
        goals["rate"] = 1.0
    return LinkCell(
        name,
        title,
        goals,
        at_least={"rate": USED * WINDOW / round_trip} if round_trip else {},
        at_most={
            "p99_us": 1e6 * (2 * round_trip + HIGH_SECONDS),
            "beside_us": 1e6 * BESIDE_SECONDS,
        },
        round_trip=round_trip,
    )


LINKS: tuple[LinkCell, ...] = (
    _cell("upstream", "link: what waited drains", 0.0),
    _cell("upstream-100ms", "link: the same, 100 ms round trip", ROUND_TRIP),
)
