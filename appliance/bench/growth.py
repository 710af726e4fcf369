"""What must not grow with the broker's state: the cost of a publish, and the length of stalls.

The figures are absolute, or those of a broker with much state divided by its own with little, so
that each broker is judged by itself. A stall is one client's longest round trip while others cause
much work.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from appliance.bench import peers
from appliance.bench.cells import run_measuring
from appliance.bench.client import (
    LoadClient,
    LoadError,
    allow_files,
    publish_packet,
    subscribe_packet,
)
from appliance.bench.crowd import CONNECT_SECONDS
from appliance.bench.load import cpu_seconds, resident_kib
from appliance.bench.load_clients import Load, LoadSubscriber, MessageFlow
from appliance.bench.peers import PASSWORD_VARIABLE, Peer, PeerError, Server, Site, last_lines

StartBroker: TypeAlias = (
    "Callable[[], AbstractContextManager[Server]]"  # starts another broker at each call
)
Progress: TypeAlias = "Callable[[str], object]"
Figures: TypeAlias = "dict[str, float]"

RUN_SECONDS = 0.5  # the longest that one run measures, as there are many
RUNS = 3
MAX_RATIO = 1.15  # up to which two figures count as the same, on a computer with other work
MAX_STALL_MS = 50.0
MAX_CROWD_STALL_MS = 500.0  # while thousands of TLS clients connect or leave at once
FILTERS_A_PACKET = 100
FILTERS_A_CLIENT = 800
PACKETS_A_WINDOW = 1000
RETAINED_BYTES = 64
ANSWER_SECONDS = 20.0
LEAVE_SECONDS = 10.0
SETTLE_SECONDS = 1.0


@dataclass(frozen=True, slots=True)
class Statement:
    """One line of the report: a figure, and the maximum that is its goal.

    `note` is printed behind it; names in braces stand for other figures of the same cell.
    """

    figure: str
    title: str
    unit: str = ""
    most: float | None = None
    note: str = ""

    def reached(self, figures: Mapping[str, float] | None) -> bool | None:
        """Whether the goal is reached; None when there is no goal, or no figure."""
        if self.most is None or figures is None or self.figure not in figures:
            return None
        return figures[self.figure] <= self.most


@dataclass(frozen=True, slots=True)
class GrowthCell:
    """Statements that are measured on the same brokers; `size` is the amount of state."""

    name: str
    title: str
    size: int
    statements: tuple[Statement, ...]

    def missing(self) -> str | None:
        """What this computer lacks to run the cell."""
        return None

    def measure(self, start: StartBroker, seconds: float, progress: Progress) -> Figures:
        """The figures of one broker. Raises PeerError, LoadError, OSError."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class GrowthRow:
    """The result of one cell on all brokers, of peers by name; absent where it did not run."""

    cell: GrowthCell
    ours: Figures | None = None
    peers: Mapping[str, Figures] = field(default_factory=dict)
    problem: str | None = None
    missing: str | None = None

    @property
    def reached(self) -> bool | None:
        """Whether all goals are reached; None when a figure is missing."""
        goals = [each for each in self.cell.statements if each.most is not None]
        verdicts = [each.reached(self.ours) for each in goals]
        return None if None in verdicts else all(verdicts)


# --- The same publish, with little and with much state ---


def publish_costs(
    little: Server, much: Server, loads: Sequence[str], seconds: float, progress: Progress
) -> Figures:
    """CPU µs a message of each load on both brokers in turn, and the ratio of much to little."""
    figures: Figures = {}
    for load in loads:
        costs: dict[str, list[float]] = {"little": [], "much": []}
        for run in range(RUNS):
            progress(f"{load}, {run + 1} of {RUNS}")
            for name, server in (("little", little), ("much", much)):
                arguments = ["load", load, *server.arguments()]
                result = run_measuring(arguments, server.site, min(seconds, RUN_SECONDS))
                if result.lost or result.cpu_us is None:
                    raise PeerError(f"{load}: {result.lost} messages were lost")
                costs[name].append(result.cpu_us)
        for name, values in costs.items():
            figures[f"{load}-{name}-us"] = statistics.median(values)
        figures[load] = figures[f"{load}-much-us"] / figures[f"{load}-little-us"]
    return figures


def same_cost(load: str, title: str, little: str) -> Statement:
    """The statement that a publish costs the same as with little state."""
    note = f"{{{load}-little-us:.1f}} → {{{load}-much-us:.1f}} µs"
    return Statement(load, f"CPU of a publish ÷ with {little}: {title}", "×", MAX_RATIO, note)


PUBLISHES = (
    ("qos0-pair", "QoS 0, one at a time"),
    ("qos1-inflight50", "QoS 1, 50 in flight"),
)
TOPICS = ("qos0-topics", "QoS 0, 10,000 topics in turn")


@dataclass(frozen=True, slots=True)
class SubscriptionCell(GrowthCell):
    """The cost of a publish with 10 and with many subscriptions to other topics."""

    def measure(self, start: StartBroker, seconds: float, progress: Progress) -> Figures:
        with start() as little, start() as much, contextlib.ExitStack() as stack:
            progress(f"{self.size:,} subscriptions")
            subscribe(stack, little, 10)
            with probing(much) as probe:
                time.sleep(SETTLE_SECONDS)
                quiet = probe.ask()["longest"]
                cpu = cpu_seconds(much.pids)
                subscribe(stack, much, self.size)
                cpu = cpu_seconds(much.pids) - cpu
                subscribing = probe.ask()["longest"]
            loads = [name for name, _ in (*PUBLISHES, TOPICS)]
            return {
                **publish_costs(little, much, loads, seconds, progress),
                "quiet-ms": 1e3 * quiet,
                "subscribing-ms": 1e3 * subscribing,
                "subscribe-us": 1e6 * cpu / self.size,
            }


def subscribe(stack: contextlib.ExitStack, server: Server, count: int) -> None:
    """Make `count` subscriptions, of clients that stay connected until the stack is closed."""
    for first in range(0, count, FILTERS_A_CLIENT):
        filters = [
            other_filter(each) for each in range(first, min(first + FILTERS_A_CLIENT, count))
        ]
        client = LoadClient(server.target(tls=False), f"bench-other-{first}")
        stack.callback(client.close)
        client.wait_connected()
        for start in range(0, len(filters), FILTERS_A_PACKET):
            some = filters[start : start + FILTERS_A_PACKET]
            client.write(subscribe_packet(some, 0))
            answer = client.expect(0x90, 4 + len(some))
            if any(answer[4:]):
                raise LoadError(f"subscriptions refused: {answer[4:].hex(' ')}")


def other_filter(number: int) -> str:
    """One of many filters that match no published topic; three of ten have wildcards."""
    robot, thing = divmod(number, 100)
    match number % 10:
        case 0:
            return f"bench/+/robot{robot:05d}/{thing:02d}/state"
        case 1:
            return f"bench/other/robot{robot:05d}/{thing:02d}/+/state"
        case 2:
            return f"bench/other/robot{robot:05d}/{thing:02d}/#"
        case _:
            return f"bench/other/robot{robot:05d}/{thing:02d}/state"


# --- Retained messages ---


@dataclass(frozen=True, slots=True)
class RetainedCell(GrowthCell):
    """The cost of a publish with none and with many retained messages; and of sending them all."""

    def measure(self, start: StartBroker, seconds: float, progress: Progress) -> Figures:
        with start() as little, start() as much:
            progress(f"{self.size:,} retained messages")
            retain(much, self.size)
            loads = [name for name, _ in PUBLISHES]
            figures = publish_costs(little, much, loads, seconds, progress)
            with probing(much) as probe:
                for qos in (0, 1):
                    progress(f"all of them, with QoS {qos}")
                    time.sleep(SETTLE_SECONDS)
                    figures[f"quiet-qos{qos}-ms"] = 1e3 * probe.ask()["longest"]
                    cpu, began = cpu_seconds(much.pids), time.perf_counter()
                    received = receive_retained(much, qos, self.size)
                    figures[f"all-qos{qos}-s"] = time.perf_counter() - began
                    figures[f"stop-qos{qos}-ms"] = 1e3 * probe.ask()["longest"]
                    cpu = cpu_seconds(much.pids) - cpu
                    figures[f"all-qos{qos}-us"] = 1e6 * cpu / self.size
                    figures[f"missing-qos{qos}"] = self.size - received
            return figures


def retained_topic(number: int) -> str:
    """One of many topics with a retained message, all of the same length."""
    return f"bench/kept/robot{number // 100:05d}/{number % 100:02d}"


def retain(server: Server, count: int) -> None:
    """Publish `count` retained messages."""
    with contextlib.closing(LoadClient(server.target(tls=False), "bench-retain")) as client:
        client.wait_connected()
        for first in range(0, count, PACKETS_A_WINDOW):
            numbers = range(first, min(first + PACKETS_A_WINDOW, count))
            packets = [
                publish_packet(
                    retained_topic(each), bytes(RETAINED_BYTES), 1 + each - first, retain=True
                )
                for each in numbers
            ]
            client.socket.sendall(b"".join(packets))
            client.expect(0x40, 4 * len(packets))


class _DeliveryCounter(MessageFlow):
    """Counts deliveries of messages that were sent before."""

    def deliver(self, count: int) -> None:
        self.deliveries += count


def receive_retained(server: Server, qos: int, count: int) -> int:
    """Subscribe to the retained messages; returns how many arrived, `count` if none is lost."""
    tally = _DeliveryCounter(Load(qos=qos, payload=RETAINED_BYTES))
    poll, events = select.epoll(), dict[int, Callable[[int], None]]()
    client = LoadSubscriber(server.target(tls=False), f"bench-all-{qos}", tally, retained_topic(0))
    with poll, contextlib.closing(client):
        client.wait_connected()
        client.subscribe("bench/kept/#", qos)
        client.attach(poll, events)
        while tally.deliveries < count:
            ready = poll.poll(ANSWER_SECONDS)
            if not ready:
                break
            for descriptor, event in ready:
                events[descriptor](event)
    return tally.deliveries


# --- Clients ---


@dataclass(frozen=True, slots=True)
class ClientCell(GrowthCell):
    """Many clients that connect over TLS at once, stay, and leave at once."""

    def missing(self) -> str | None:
        files = 2 * self.size
        return None if allow_files(files) else f"needs {files} open files (ulimit -Hn)"

    def measure(self, start: StartBroker, seconds: float, progress: Progress) -> Figures:
        with start() as server, probing(server) as probe, crowd(server, self.size) as clients:
            time.sleep(SETTLE_SECONDS)
            files, memory = open_files(server.pids), resident_kib(server.pids)
            quiet = probe.ask()["longest"]
            cpu = cpu_seconds(server.pids)
            progress(f"{self.size:,} clients connect")
            came = clients.ask(2 * CONNECT_SECONDS)
            cpu = cpu_seconds(server.pids) - cpu
            connecting = probe.ask()["longest"]
            progress(f"{self.size:,} clients stay")
            time.sleep(max(SETTLE_SECONDS, seconds))
            memory = resident_kib(server.pids) - memory
            probe.ask()
            progress(f"{self.size:,} clients leave")
            stayed = clients.ask()
            until = time.monotonic() + LEAVE_SECONDS
            while open_files(server.pids) > files and time.monotonic() < until:
                time.sleep(0.05)
            leaving = probe.ask()["longest"]
        if not stayed["stayed"]:
            raise PeerError(f"nobody could connect: {came['problems']}")
        return {
            "failed": came["failed"],
            "timed-out": came["timed_out"],
            "left-alone": self.size - came["failed"] - stayed["stayed"],
            "all-s": came["seconds"],
            "connack-p50-s": came["p50"],
            "connack-p99-s": came["p99"],
            "connect-us": 1e6 * cpu / self.size,
            "quiet-ms": 1e3 * quiet,
            "connecting-ms": 1e3 * connecting,
            "memory-kib": memory / stayed["stayed"],
            "leaving-ms": 1e3 * leaving,
        }


def open_files(pids: Sequence[int]) -> int:
    """The number of files that these processes have open."""
    return sum(1 for pid in pids for _ in Path(f"/proc/{pid}/fd").iterdir())


# --- Subprocesses that answer ---


class Subprocess:
    """A program of this package in its own process, which answers lines with lines of JSON."""

    def __init__(self, name: str, process: subprocess.Popen[bytes], log: Path) -> None:
        self._name, self._process, self._log = name, process, log
        self._received = b""

    def ask(self, seconds: float = ANSWER_SECONDS) -> dict[str, Any]:
        """Ask for an answer. Raises PeerError when none arrives within `seconds`."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # `answer` reports it
        return self.answer(seconds)

    def answer(self, seconds: float = ANSWER_SECONDS) -> dict[str, Any]:
        """Its next answer. Raises PeerError as `ask` does."""
        output, until = self._process.stdout, time.monotonic() + seconds
        assert output is not None
        while b"\n" not in self._received:
            left = max(until - time.monotonic(), 0)
            if not select.select([output], [], [], left)[0]:
                raise PeerError(f"{self._name} does not answer within {seconds:g} s")
            data = os.read(output.fileno(), 65536)
            if not data:
                raise PeerError(f"{self._name} ended: {last_lines(self._log)}")
            self._received += data
        line, _, self._received = self._received.partition(b"\n")
        answer: dict[str, Any] = json.loads(line)
        return answer


@contextlib.contextmanager
def program(
    name: str, server: Server, tls: bool, options: Sequence[str] = ()
) -> Iterator[Subprocess]:
    """Run one of this package's programs against a broker."""
    site = server.site
    command = [sys.executable, "-m", f"appliance.bench.{name}", *server.arguments(tls), *options]
    environment = {**os.environ, PASSWORD_VARIABLE: site.password}
    log = site.directory / f"{name}.log"
    with peers.running(f"the {name}", command, environment, log, talks=True) as process:
        running = Subprocess(f"the {name}", process, log)
        running.answer()
        yield running


def probing(server: Server) -> AbstractContextManager[Subprocess]:
    """A bystander's round trips: asked for, since it was asked before."""
    return program("probe", server, tls=False)


def crowd(server: Server, count: int) -> AbstractContextManager[Subprocess]:
    """Run clients that connect when asked, and leave when asked again."""
    return program("crowd", server, tls=True, options=["--clients", str(count)])


# --- All of them ---

MANY_ENTRIES = 100_000
CROWD_SIZE = 5000
QUIET_NOTE = "before: {quiet-ms:.1f}"
GROWTH: tuple[GrowthCell, ...] = (
    SubscriptionCell(
        "growth-subscriptions",
        f"{MANY_ENTRIES:,} subscriptions to other topics",
        MANY_ENTRIES,
        (
            *(same_cost(*each, "10") for each in (*PUBLISHES, TOPICS)),
            Statement(
                "subscribing-ms",
                "another's longest round trip while they are made",
                "ms",
                MAX_STALL_MS,
                QUIET_NOTE,
            ),
            Statement("subscribe-us", "CPU of a subscription", "µs"),
        ),
    ),
    RetainedCell(
        "growth-retained",
        f"{MANY_ENTRIES:,} retained messages",
        MANY_ENTRIES,
        (
            *(same_cost(*each, "none") for each in PUBLISHES),
            *(
                statement
                for qos in (0, 1)
                for statement in (
                    Statement(
                        f"stop-qos{qos}-ms",
                        f"another's longest round trip while QoS {qos} gets them all",
                        "ms",
                        MAX_STALL_MS,
                        f"before: {{quiet-qos{qos}-ms:.1f}}",
                    ),
                    Statement(
                        f"all-qos{qos}-s",
                        "until all are there",
                        "s",
                        None,
                        f"{{all-qos{qos}-us:.1f}} µs CPU each",
                    ),
                    Statement(f"missing-qos{qos}", "missing", "", 0),
                )
            ),
        ),
    ),
    ClientCell(
        "growth-clients",
        f"{CROWD_SIZE:,} clients connect over TLS at once, stay, and leave at once",
        CROWD_SIZE,
        (
            Statement(
                "failed",
                f"not connected within {CONNECT_SECONDS:g} s",
                "",
                0,
                "timed out: {timed-out:.0f}",
            ),
            Statement("left-alone", "not connected any more at the end", "", 0),
            Statement(
                "all-s", "until all are connected", "s", None, "{connect-us:.0f} µs CPU each"
            ),
            Statement("connack-p50-s", "from TCP to CONNACK, p50", "s"),
            Statement("connack-p99-s", "p99", "s"),
            Statement(
                "connecting-ms",
                "another's longest round trip meanwhile",
                "ms",
                MAX_CROWD_STALL_MS,
                QUIET_NOTE,
            ),
            Statement("memory-kib", "memory of a connection", "KiB"),
            Statement(
                "leaving-ms",
                "another's longest round trip while they leave",
                "ms",
                MAX_CROWD_STALL_MS,
            ),
        ),
    ),
)


def grow(
    cell: GrowthCell,
    others: Sequence[Peer],
    seconds: float,
    progress: Progress = lambda text: None,
) -> GrowthRow:
    """Measure one cell on this broker, and on the peers if there are some."""
    if missing := cell.missing():
        return GrowthRow(cell, missing=missing)
    measured: dict[str, Figures] = {}
    problems: list[str] = []
    with tempfile.TemporaryDirectory(prefix="appliance-bench-") as directory:
        site = Site(Path(directory))
        site.prepare()
        starts: dict[str, StartBroker] = {
            "appliance": lambda: peers.appliance(site, [], os.environ)
        }
        for peer in others:
            starts[peer.name] = partial(peers.mosquitto, peer, site)
        for name, start in starts.items():
            try:
                measured[name] = cell.measure(start, seconds, _named(name, progress))
            except (PeerError, LoadError, OSError) as error:
                problems.append(f"{name}: {error}")
    ours = measured.pop("appliance", None)
    return GrowthRow(cell, ours, measured, "; ".join(problems) or None)


def _named(name: str, progress: Progress) -> Progress:
    return lambda text: progress(f"{name}: {text}")
