"""The load generator: one process that drives one broker with the load of a cell, and measures it.

Works against any MQTT 3.1.1 broker::

    python -m appliance.bench.load qos1-inflight50 --port 1883 --pid "$(pidof mosquitto)" --json

The generator must never limit the figures. So packets are encoded before the clock starts, all of a
cell have one size, received packets are counted by their length, and packet identifiers are copied
from a received chunk into the acknowledgements by slices that step from packet to packet. With QoS
2 packets of two sizes come mixed, and each is looked at.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import select
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from appliance.bench.client import (
    LoadClient,
    LoadError,
    LoadTarget,
    allow_files,
    publish_packet,
    reporting,
)
from appliance.bench.load_clients import (
    ExactlyOncePublisher,
    ExactlyOnceSubscriber,
    FloodFlow,
    Load,
    LoadPublisher,
    LoadSubscriber,
    MessageFlow,
)

STALL_SECONDS = 3.0  # without a delivery: the broker has lost messages, or has stalled
RUN_SECONDS = 3.0  # of a run, unless said otherwise
DRAIN_SECONDS = 2.0  # for messages in flight after the last was sent
WARM_UP_SECONDS = 0.3
LOOK_SECONDS = 0.1  # between two looks whether anything was delivered
PROBE_SECONDS = 0.002  # between two round trips of the probe beside a flood
CPUCLOCK_SCHED = 2  # clock_getcpuclockid(3): nanoseconds of all threads of a process

CELLS: dict[str, Load] = {
    "qos0-pair": Load(),
    "qos0-pipelined": Load(window=4096, batch=1024),
    "qos1-inflight50": Load(qos=1, window=50),
    "qos1-stored": Load(qos=1, window=50, stored=True),
    "qos1-50pairs": Load(qos=1, pairs=50),
    "qos0-fanout50": Load(subscribers=50),
    "qos0-topics": Load(window=200, batch=100, topics=10_000),
    "qos1-100k": Load(qos=1, payload=100_000, window=10),
    "qos2-inflight20": Load(qos=2, window=20),
    "flood": Load(qos=1, window=50, flood=200_000),
    "idle": Load(idle=500),
}


@dataclass(frozen=True, slots=True)
class Result:
    """The result of one run. None: does not apply to the cell, or no process was given."""

    cell: str
    tls: bool
    seconds: float
    messages: int = 0  # delivered
    lost: int = 0
    rate: float | None = None  # delivered messages a second
    cpu_us: float | None = None  # the broker's CPU time a delivered message, µs
    p50_us: float | None = None  # latency from sent to received, µs
    p99_us: float | None = None
    beside_us: float | None = None  # 99th percentile of a probe's round trips beside the load, µs
    broker_busy: float | None = None  # CPU time / time; 1.0 is one core
    generator_busy: float | None = None
    memory_kib: float | None = None  # the broker's resident memory a connection, KiB


class ProbeClient(LoadClient):
    """Measures round trips beside a load: publishes to itself, with a pause between messages."""

    def __init__(self, target: LoadTarget, client_id: str) -> None:
        super().__init__(target, client_id)
        self.latencies: list[tuple[float, int]] = []
        self._topic = f"bench/beside/{os.getpid()}"
        self._packet = publish_packet(self._topic, bytes(64))
        self._buffer = memoryview(bytearray(len(self._packet)))
        self._filled = 0
        self._sent_at = 0.0
        self._next = 0.0

    def subscribed(self) -> None:
        """Wait for the CONNACK, and subscribe."""
        self.wait_connected()
        self.subscribe(self._topic, 0)

    def tick(self, now: float) -> None:
        """Begin the next round trip when its time has come."""
        if now >= self._next:
            self._next = math.inf
            self._sent_at = now
            self.write(self._packet)

    def receive(self) -> None:
        self._filled += self.transport.recv_into(self._buffer[self._filled :])
        if self._filled == len(self._packet):
            self._filled = 0
            now = time.perf_counter()
            self.latencies.append((now - self._sent_at, 1))
            self._next = now + PROBE_SECONDS

    def flush(self) -> None:
        """Do nothing: a packet of this size is never sent in parts."""


# --- Runs ---


def cpu_seconds(pids: Iterable[int]) -> float:
    """CPU time of these processes so far, of all their threads, ended ones included."""
    return sum(time.clock_gettime((~pid << 3) | CPUCLOCK_SCHED) for pid in pids)


def resident_kib(pids: Iterable[int]) -> int:
    """Resident memory of these processes, KiB."""
    return sum(
        int(line.split()[1])
        for pid in pids
        for line in Path(f"/proc/{pid}/status").read_text().splitlines()
        if line.startswith("VmRSS:")
    )


def pin(pids: Iterable[int]) -> bool:
    """Pin this process to one core and the broker to another; False if there is only one."""
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        return False
    os.sched_setaffinity(0, cores[:1])
    for pid in pids:
        for task in Path(f"/proc/{pid}/task").iterdir():
            os.sched_setaffinity(int(task.name), cores[1:2])
    return True


def percentile(weighted: Iterable[tuple[float, int]], part: float) -> float:
    """The value that a `part` (0 to 1) of the weighted samples does not exceed."""
    samples = sorted(weighted)
    left = part * sum(weight for _, weight in samples)
    for value, weight in samples:
        left -= weight
        if left <= 0:
            return value
    raise LoadError("nothing was delivered while measuring")


class LoadRun:
    """One run of a cell: its clients, and the loop that serves them."""

    def __init__(self, target: LoadTarget, load: Load, spin: bool) -> None:
        self._target = target
        self._poll_timeout = 0.0 if spin else 0.1
        self._poll = select.epoll()
        self._events: dict[int, Callable[[int], None]] = {}
        self._clients: list[LoadClient] = []
        self._publishers: list[LoadPublisher] = []
        self._subscribers: list[tuple[LoadSubscriber, str]] = []
        self.flows: list[MessageFlow] = []
        self._load = load
        self.arrived_at = 0.0  # when the last message of a flood arrived

    def open(self) -> None:
        """Connect all clients, and subscribe."""
        run = f"bench-{os.getpid()}"
        exactly_once = self._load.qos == 2
        subscriber_class = ExactlyOnceSubscriber if exactly_once else LoadSubscriber
        publisher_class = ExactlyOncePublisher if exactly_once else LoadPublisher
        for pair in range(self._load.pairs):
            topic = f"bench/load/{pair:02d}"
            flow = FloodFlow(self._load) if self._load.flood else MessageFlow(self._load)
            self.flows.append(flow)
            for number in range(self._load.subscribers):
                subscriber = subscriber_class(self._target, f"{run}-s{pair}-{number}", flow, topic)
                self._subscribers.append((subscriber, topic))
                self._clients.append(subscriber)
            publisher = publisher_class(self._target, f"{run}-p{pair}", flow, topic)
            self._publishers.append(publisher)
            self._clients.append(publisher)
        # Wait only now: checking a password takes time, and a broker may check several at once.
        for client in self._clients:
            client.wait_connected()
        for subscriber, topic in self._subscribers:
            wanted = topic if self._load.topics == 1 else f"{topic}/+"
            subscriber.subscribe(wanted, self._load.qos)
        for client in self._clients:
            client.attach(self._poll, self._events)

    def start(self) -> None:
        """Send the first messages."""
        for flow, publisher in zip(self.flows, self._publishers, strict=True):
            flow.start(publisher)

    def serve(self, until: float, drained: bool = False) -> None:
        """Serve the connections until a time of `perf_counter`, or until all is `drained`."""
        poll, events, clock = self._poll.poll, self._events, time.perf_counter
        timeout = self._poll_timeout
        progress, seen = clock(), self.deliveries
        while (now := clock()) < until:
            if drained and not any(flow.in_flight for flow in self.flows):
                return
            for descriptor, event in poll(timeout):
                events[descriptor](event)
            if now - progress > STALL_SECONDS / 2:
                if self.deliveries == seen and now - progress > STALL_SECONDS:
                    missing = sum(flow.in_flight for flow in self.flows)
                    raise LoadError(
                        f"nothing arrives: {missing} messages are in flight"
                        f" after {seen} deliveries (lost, or the broker has stalled)"
                    )
                if self.deliveries != seen:
                    progress, seen = now, self.deliveries

    def serve_until_more(self, deliveries: int) -> None:
        """Serve the connections until there are more deliveries than these.

        A computer that is busy with something else may have no time for one in the time that is
        measured, which is then longer. Raises LoadError after STALL_SECONDS more.
        """
        until = time.perf_counter() + STALL_SECONDS
        while self.deliveries == deliveries:
            if time.perf_counter() > until:
                raise LoadError("nothing was delivered while measuring")
            self.serve(time.perf_counter() + LOOK_SECONDS)

    @property
    def deliveries(self) -> int:
        """Messages delivered so far, over all subscribers."""
        return sum(flow.deliveries for flow in self.flows)

    def add(self, client: LoadClient) -> None:
        """Serve another connection."""
        client.attach(self._poll, self._events)

    def serve_until_delivered(self, probe: ProbeClient) -> None:
        """Serve the connections until all messages are acknowledged and delivered, or none is.

        Lost messages never arrive: then the end is known only after STALL_SECONDS.
        """
        poll, events, clock = self._poll.poll, self._events, time.perf_counter
        timeout = min(self._poll_timeout, PROBE_SECONDS)
        seen = 0
        self.arrived_at = clock()
        while any(flow.in_flight or flow.missing for flow in self.flows):
            for descriptor, event in poll(timeout):
                events[descriptor](event)
            now = clock()
            probe.tick(now)
            if (progress := sum(flow.acknowledged + flow.deliveries for flow in self.flows)) > seen:
                seen, self.arrived_at = progress, now
            elif now - self.arrived_at > STALL_SECONDS:
                return

    def reset_latencies(self) -> None:
        """Exclude the warm-up from the figures."""
        for flow in self.flows:
            flow.latencies = []

    def latencies(self) -> list[tuple[float, int]]:
        """Latencies since the warm-up: seconds, and of how many deliveries."""
        return [sample for flow in self.flows for sample in flow.latencies]

    def drain(self) -> int:
        """Stop sending and wait for messages in flight; returns the deliveries that are lost."""
        for flow in self.flows:
            flow.stop()
        self.serve(time.perf_counter() + DRAIN_SECONDS, drained=True)
        return sum(flow.missing for flow in self.flows)

    def close(self) -> None:
        """Close every connection."""
        for client in self._clients:
            client.close()
        self._poll.close()


def run_messages(cell: str, target: LoadTarget, load: Load, seconds: float, spin: bool) -> Result:
    """Drive a broker with messages for `seconds`, after a short warm-up.

    With `spin` the loop never sleeps, which takes a core of its own: to wake a sleeping process
    costs the process that writes to it, here the broker, more than a message does.
    """
    run = LoadRun(target, load, spin)
    try:
        run.open()
        run.start()
        run.serve(time.perf_counter() + WARM_UP_SECONDS)
        run.reset_latencies()
        before, generator, cpu = run.deliveries, time.process_time(), cpu_seconds(target.pids)
        began = time.perf_counter()
        run.serve(began + seconds)
        run.serve_until_more(before)
        elapsed = time.perf_counter() - began
        cpu, generator = cpu_seconds(target.pids) - cpu, time.process_time() - generator
        messages, latencies = run.deliveries - before, run.latencies()
        lost = run.drain()
    finally:
        run.close()
    return Result(
        cell=cell,
        tls=target.tls is not None,
        seconds=elapsed,
        messages=messages,
        lost=lost,
        rate=messages / elapsed,
        cpu_us=1e6 * cpu / messages if target.pids and messages else None,
        p50_us=1e6 * percentile(latencies, 0.50),
        p99_us=1e6 * percentile(latencies, 0.99),
        broker_busy=cpu / elapsed if target.pids else None,
        generator_busy=generator / elapsed,
    )


def run_flood(cell: str, target: LoadTarget, load: Load, seconds: float, spin: bool) -> Result:
    """Send a number of messages as fast as they are acknowledged, and count the deliveries.

    The cell's number is for a run of RUN_SECONDS; longer runs send more.
    """
    load = replace(load, flood=max(round(load.flood * seconds / RUN_SECONDS), load.window))
    run = LoadRun(target, load, spin)
    probe: ProbeClient | None = None
    try:
        probe = ProbeClient(target, f"bench-{os.getpid()}-beside")
        probe.subscribed()
        run.open()
        run.add(probe)
        generator, cpu = time.process_time(), cpu_seconds(target.pids)
        began = time.perf_counter()
        run.start()
        run.serve_until_delivered(probe)
        elapsed = run.arrived_at - began
        cpu, generator = cpu_seconds(target.pids) - cpu, time.process_time() - generator
    finally:
        run.close()
        if probe is not None:
            probe.close()
    messages = run.deliveries
    return Result(
        cell=cell,
        tls=target.tls is not None,
        seconds=elapsed,
        messages=messages,
        lost=sum(flow.missing for flow in run.flows),
        rate=messages / elapsed,
        cpu_us=1e6 * cpu / messages if target.pids and messages else None,
        p50_us=1e6 * percentile(run.latencies(), 0.50),
        p99_us=1e6 * percentile(run.latencies(), 0.99),
        beside_us=1e6 * percentile(probe.latencies, 0.99),
        broker_busy=cpu / elapsed if target.pids else None,
        generator_busy=generator / elapsed,
    )


def run_idle(cell: str, target: LoadTarget, load: Load, seconds: float) -> Result:
    """Open connections that stay idle, and measure the memory of each in a new broker."""
    if not target.pids:
        raise LoadError("the idle cell measures memory: give the broker's process with --pid")
    allow_files(2 * load.idle + 100)
    clients: list[LoadClient] = []
    try:
        # The first connections also pay for what is allocated once.
        _open_idle(target, "warm", max(load.idle // 10, 10), clients)
        before = _settled_kib(target.pids, seconds / 2)
        _open_idle(target, "idle", load.idle, clients)
        after = _settled_kib(target.pids, seconds / 2)
    finally:
        for client in clients:
            client.close()
    memory = (after - before) / load.idle
    return Result(cell, target.tls is not None, seconds, memory_kib=memory)


def _open_idle(target: LoadTarget, name: str, count: int, clients: list[LoadClient]) -> None:
    opened = []
    for number in range(count):
        client = LoadClient(target, f"bench-{os.getpid()}-{name}{number}")
        clients.append(client)
        opened.append(client)
    for client in opened:
        client.wait_connected()


def _settled_kib(pids: Sequence[int], seconds: float) -> float:
    """The median of resident memory over `seconds`, as an allocator releases memory late."""
    until, samples = time.monotonic() + seconds, [resident_kib(pids)]
    while time.monotonic() < until:
        time.sleep(0.1)
        samples.append(resident_kib(pids))
    return statistics.median(samples)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m appliance.bench.load",
        description="Drive an MQTT broker with one cell's load and measure it.",
    )
    parser.add_argument("cell", choices=CELLS, metavar="CELL", help=", ".join(CELLS))
    LoadTarget.add_options(parser)
    parser.add_argument("--seconds", type=float, default=RUN_SECONDS, help="time to measure")
    parser.add_argument("--no-pin", action="store_true", help="do not pin the processes to cores")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    tuning = parser.add_argument_group("to change the cell")
    tuning.add_argument("--window", type=int, help="messages in flight, each publisher")
    tuning.add_argument("--batch", type=int, help="send only when so many fit in the window")
    tuning.add_argument("--payload", type=int, help="bytes")
    tuning.add_argument("--pairs", type=int, help="publishers, each with its subscribers")
    tuning.add_argument("--subscribers", type=int, help="of each publisher")
    tuning.add_argument("--idle", type=int, help="connections of the idle cell")
    options = parser.parse_args(arguments)

    changes = {
        name: value
        for name in ("window", "batch", "payload", "pairs", "subscribers", "idle")
        if (value := getattr(options, name)) is not None
    }
    if any(value < 1 for value in changes.values()) or options.seconds <= 0:
        parser.error("numbers must be greater than 0")
    load = replace(CELLS[options.cell], **changes)
    if load.batch > load.window:
        parser.error("a batch larger than the window would never be sent")
    with reporting(options.cell):
        target = LoadTarget.of(options)
        spin = not options.no_pin and pin(target.pids)
        if load.idle:
            result = run_idle(options.cell, target, load, options.seconds)
        elif load.flood:
            result = run_flood(options.cell, target, load, options.seconds, spin)
        else:
            result = run_messages(options.cell, target, load, options.seconds, spin)
    sys.stdout.write((json.dumps(asdict(result)) if options.json else describe(result)) + "\n")
    return 0


def describe(result: Result) -> str:
    """A result as one line."""

    def shown(name: str, value: float | None, unit: str) -> str:
        return "" if value is None else f"  {name} {value:,.1f}{unit}"

    return (
        f"{result.cell}{' TLS' if result.tls else ''}:"
        + shown("CPU", result.cpu_us, " µs/message")
        + shown("rate", result.rate, "/s")
        + shown("p50", result.p50_us, " µs")
        + shown("p99", result.p99_us, " µs")
        + shown("memory", result.memory_kib, " KiB/connection")
        + shown("busy: broker", result.broker_busy and 100 * result.broker_busy, " %")
        + shown("generator", result.generator_busy and 100 * result.generator_busy, " %")
        + (f"  lost {result.lost}" if result.lost else "")
    )


if __name__ == "__main__":
    sys.exit(main())
