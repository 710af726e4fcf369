"""One soak: a broker in a process of its own, its clients, its memory, the accounts at the end."""

from __future__ import annotations

import asyncio
import gc
import re
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import uvloop
from appliance_process import ApplianceProcess

from appliance.mqtt.codec import V5
from appliance.mqtt.packets import Publish
from soak.actor import RIGHTS, Actor, Crowd
from soak.client import Client
from soak.model import Model
from soak.records import Message
from soak.rights import acl
from soak.wire import Profile, Target

#: As many as 200 clients from one address need; queues that never run full.
_LIMITS = {
    "connections_per_address": 2000,
    "connection_rate": 2000,
    "queue_messages": 1_000_000,
    "queue_bytes": "256 MiB",
    "memory": "1 GiB",
}

#: Seconds without a delivery, once everyone reads, after which what is owed does not come any more.
_STALLED = 20.0

#: Seconds without a delivery after which nothing more is expected.
_QUIET = 1.5

#: Wrong deliveries after which more of them tell nothing new.
_ENOUGH = 20

#: How much more memory than in the second quarter the last one may take, and bytes beyond that.
_GROWTH = 1.10
_GROWTH_BYTES = 8 << 20

#: Lines of the broker's log that have no place in it, whatever clients do.
_ALARMING = re.compile(r"Traceback|\bERROR\b|\bCRITICAL\b|Exception|never awaited", re.IGNORECASE)

_SYS = "$SYS/broker/"


@dataclass
class Report:
    """How a soak went; `memory` is (seconds, bytes) once a second, while clients were random."""

    seed: int
    seconds: float
    clients: int
    model: Model
    memory: list[tuple[float, int]] = field(default_factory=list)
    round_trips: list[float] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    #: The broker's share of a core.
    busy: float = 0.0

    @property
    def ok(self) -> bool:
        return not self.problems and not self.model.violations

    def quarter(self, number: int) -> float:
        """The median of the memory in that quarter of the time, 1 to 4, in bytes."""
        size = len(self.memory) / 4
        part = self.memory[int((number - 1) * size) : int(number * size)]
        return statistics.median(value for _, value in part)

    def check_memory(self) -> None:
        """Memory that grew without end is a problem; meaningful from some minutes on."""
        before, after = self.quarter(2), self.quarter(4)
        if after > before * _GROWTH + _GROWTH_BYTES:
            self.problems.append(
                f"memory grew from {before / 2**20:.1f} MiB in the second quarter "
                f"to {after / 2**20:.1f} MiB in the last"
            )

    def table(self) -> str:
        counts = self.model.counts
        memory = [value / 2**20 for _, value in self.memory] or [0.0]
        late = [(when, value) for when, value in self.memory if when >= min(60, self.seconds / 2)]
        slope = statistics.linear_regression(*zip(*late, strict=True)).slope if late[1:] else 0.0
        trips = sorted(self.round_trips) or [0.0]
        cuts = sum(counts[name] for name in counts if name.startswith("cut: "))
        lost = counts["lost"] + counts["lost retained"]
        accounted = ("lost", "lost retained", "duplicate", "order")
        others = sum(1 for wrong in self.model.violations if wrong.kind not in accounted)
        rows = [
            ("seed", self.seed),
            ("clients", self.clients),
            ("connects", f"{counts['connects']} ({counts['sessions continued']} continued)"),
            ("cuts", f"{counts['cuts']} ({cuts} inside a QoS exchange or behind a packet)"),
            ("take-overs", counts["take-overs"]),
            ("disconnects", counts["disconnects"]),
            ("published, QoS 0 / 1 / 2", _by_qos(counts, "published")),
            ("acknowledged, QoS 1 / 2", f"{counts['acknowledged 1']} / {counts['acknowledged 2']}"),
            ("refused", sum(counts[name] for name in counts if name.startswith("refused 0x"))),
            ("delivered, QoS 0 / 1 / 2", _by_qos(counts, "delivered")),
            ("delivered again, with DUP", counts["delivered again"]),
            ("owed to sessions that ended", counts["void"]),
            ("lost", lost),
            ("duplicated", counts["duplicate"]),
            ("out of order", counts["order"]),
            ("anything else wrong", others + len(self.problems)),
            ("round trip, median / 99 % / max", " / ".join(_ms(trips, p) for p in (50, 99, 100))),
            ("broker busy", f"{self.busy:.0%} of a core"),
            ("memory, first / median / max", _first_median_max(memory)),
            ("memory, slope after the start", f"{slope * 60 / 1024:+.0f} KiB a minute"),
        ]
        return "\n".join(f"{name:<34}{value}" for name, value in rows)


def _by_qos(counts: dict[str, int], what: str) -> str:
    return " / ".join(str(counts[f"{what} {qos}"]) for qos in range(3))


def _ms(values: list[float], percent: int) -> str:
    return f"{values[min(len(values) - 1, len(values) * percent // 100)] * 1000:.1f} ms"


def _first_median_max(memory: list[float]) -> str:
    return f"{memory[0]:.1f} / {statistics.median(memory):.1f} / {max(memory):.1f} MiB"


class _Observer(Client):
    """Reads `$SYS`, which is not in the model."""

    def __init__(self, model: Model, target: Target) -> None:
        super().__init__(model, target, Profile("observer", "observer", V5, False, 0), "observer")
        self.values: dict[str, str] = {}

    def identify(self, packet: Publish) -> Message | None:
        self.values[packet.topic.removeprefix(_SYS)] = packet.payload.decode()
        return None

    def number(self, name: str) -> int:
        return int(self.values[name])

    @property
    def complete(self) -> bool:
        """Whether `$SYS` was published twice, so that it counts itself."""
        name, own = "retained messages/count", ("clients/total", "subscriptions/count")
        if not all(each in self.values for each in (name, *own)):
            return False
        return self.number(name) >= len(self.values) and all(self.number(each) for each in own)

    @property
    def waiting(self) -> int:
        """Messages that wait in the broker for somebody."""
        return self.number("store/messages/count") - self.number("retained messages/count")


class Soak:
    """Builds all parts, runs them, and adds up."""

    def __init__(
        self,
        directory: Path,
        *,
        seconds: float,
        clients: int,
        rate: float,
        seed: int,
        shared: bool | None = None,
        say: Callable[[str], None] = print,
    ) -> None:
        """`rate` is of all messages published a second, `shared` None means if the broker can."""
        self.seconds = seconds
        self.shared = shared
        self.say = say
        self.model = Model(RIGHTS)
        self.report = Report(seed, seconds, clients, self.model)
        self.rate = rate
        passwords = {name: f"{name}'s password" for name in RIGHTS}
        self.broker = ApplianceProcess(
            directory,
            users=passwords,
            acl=acl(RIGHTS),
            broker={"limits": _LIMITS, "sys_interval": "1 s"},
        )
        self.actors: list[Actor] = []
        self._process: psutil.Process
        #: Exceptions in the soak itself.
        self._crashes: list[BaseException] = []

    def run(self) -> Report:
        """Run it all; the broker has ended when this returns."""
        self.broker.start()
        try:
            self._process = psutil.Process(self.broker.pid)
            uvloop.run(self._run())
            self._check_log()
        finally:
            gc.unfreeze()
            try:
                self.broker.stop()
            except AssertionError as error:
                self.report.problems.append(str(error)[:2000])
        return self.report

    async def _run(self) -> None:
        broker = self.broker
        model = self.model
        asyncio.get_running_loop().set_exception_handler(
            lambda _, context: self._crashes.append(context.get("exception") or Exception(context))
        )
        target = Target(
            broker.port, broker.plain_port, broker.tls_context(), dict(broker.passwords)
        )
        observer = _Observer(model, target)
        if not await observer.connect(clean=True, will_qos=None):
            return
        observer.outbox.subscribe({f"{_SYS}#": 0})
        await self._until(lambda: observer.complete, 60)
        at_first = dict(observer.values)
        crowd = Crowd(
            seed=self.report.seed,
            clients=self.report.clients,
            rate=self.rate / self.report.clients,
            shared=observer.shared_available if self.shared is None else self.shared,
        )
        self.actors = [Actor(crowd, model, target, number) for number in range(crowd.clients)]
        tasks = [asyncio.create_task(actor.run()) for actor in self.actors]
        await self._watch(tasks, observer)
        for actor in self.actors:
            actor.stopping = True
        if self._crashes:
            raise self._crashes[0]
        await self._drain(tasks, observer)
        model.finish()
        for actor in self.actors:
            self.report.round_trips += actor.client.round_trips
        if self.report.ok:
            await self._vanish(observer, at_first)

    async def _watch(self, tasks: list[asyncio.Task[None]], observer: _Observer) -> None:
        """Sample memory and tell how it goes, until the time is over or too much is wrong."""
        model = self.model
        began = time.monotonic()
        used = sum(self._process.cpu_times()[:2])
        told, told_wrong = 0.0, 0
        while (elapsed := time.monotonic() - began) < self.seconds:
            if self._process.status() == psutil.STATUS_ZOMBIE:
                raise ChildProcessError(f"the broker has ended:\n{self.broker.log[-2000:]}")
            if len(model.violations) >= _ENOUGH or self._crashes:
                break
            for task in tasks:
                if task.done():
                    task.result()
            self.report.memory.append((elapsed, self._process.memory_info().rss))
            if elapsed - told >= 10:
                told = elapsed
                observer.ping()
                gc.freeze()  # all that the model remembers would be looked through again and again
                self.say(self._progress(elapsed))
            for wrong in model.violations[told_wrong:]:
                self.say(f"{elapsed:6.0f} s  {wrong.kind}: {wrong.text}")
            told_wrong = len(model.violations)
            await asyncio.sleep(min(1, self.seconds - elapsed))
        self.report.seconds = time.monotonic() - began
        self.report.busy = (sum(self._process.cpu_times()[:2]) - used) / self.report.seconds

    def _progress(self, elapsed: float) -> str:
        counts = self.model.counts
        published = sum(counts[f"published {qos}"] for qos in range(3))
        delivered = sum(counts[f"delivered {qos}"] for qos in range(3))
        there = sum(actor.client.wire is not None for actor in self.actors)
        return (
            f"{elapsed:6.0f} s  {there} connected, {counts['connects']} connects, "
            f"{counts['cuts']} cuts, {counts['take-overs']} take-overs, {published} published, "
            f"{delivered} delivered, {self.model.owed} owed, "
            f"{len(self.model.violations)} violations, "
            f"{self.report.memory[-1][1] / 2**20:.1f} MiB"
        )

    async def _drain(self, tasks: list[asyncio.Task[None]], observer: _Observer) -> None:
        """Everyone connects and reads until all has come."""
        self.say("draining")
        await asyncio.gather(*tasks)
        await asyncio.gather(*(actor.settle() for actor in self.actors))
        model = self.model

        def quiet() -> bool:
            return (
                not model.owed
                and all(actor.client.outbox.empty for actor in self.actors)
                and model.clock() - model.delivered_at > _QUIET
                and not observer.waiting
            )

        while not quiet() and model.clock() - model.delivered_at < _STALLED:
            for client in (observer, *(actor.client for actor in self.actors)):
                if client.wire is not None:
                    client.ping()
            await self._until(quiet, 5)
        if not quiet():
            unsettled = sum(not actor.client.outbox.empty for actor in self.actors)
            self.report.problems.append(
                f"nothing comes for {_STALLED:g} s, and {model.owed} deliveries are owed, "
                f"{unsettled} clients wait for an acknowledgement, "
                f"{observer.waiting} messages wait in the broker by its $SYS"
            )

    async def _vanish(self, observer: _Observer, at_first: dict[str, str]) -> None:
        """When all sessions and retained messages are gone, the broker must know of none."""
        await asyncio.gather(*(actor.vanish() for actor in self.actors))
        names = ("clients/total", "subscriptions/count", "retained messages/count")

        def gone() -> bool:
            return all(observer.values[name] == at_first[name] for name in names)

        if not await self._until(gone, 60):
            left = ", ".join(
                f"{name} {observer.values[name]}, at first {at_first[name]}" for name in names
            )
            self.report.problems.append(f"something is left behind: {left}")

    async def _until(self, condition: Callable[[], bool], seconds: float) -> bool:
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                return False
            await asyncio.sleep(0.1)
        return True

    def _check_log(self) -> None:
        lines = self.broker.log.splitlines()
        alarming = [number for number, line in enumerate(lines) if _ALARMING.search(line)]
        if alarming:
            text = "\n    ".join(lines[alarming[0] :][:30])
            self.report.problems.append(
                f"the broker's log has {len(alarming)} lines like the first of these:\n    {text}"
            )
