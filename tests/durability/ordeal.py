"""The broker is killed at random moments under load, and started again; then all is added up."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from appliance_process import ACL, ApplianceProcess
from raw_client import RawClient

from appliance.mqtt.packets import Publish, Subscribe, Subscription
from durability.clients import Client, Publisher, Subscriber, World

#: Queues that never run full: a refusal for that is not what is tried here.
BROKER = {
    "limits": {"queue_messages": 1_000_000, "queue_bytes": "256 MiB", "memory": "512 MiB"},
    "sys_interval": "1 s",
}

#: Seconds without anything new after which nothing more is expected.
QUIET = 1.0


@dataclass
class Report:
    seed: int
    kills: int = 0
    starts: int = 0
    sent: int = 0
    acknowledged: int = 0
    delivered: int = 0
    repeated: int = 0
    refused: int = 0
    #: Seconds from the start of the process to its listening.
    start_times: list[float] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        slowest = max(self.start_times, default=0.0)
        return (
            f"seed {self.seed}: {self.kills} kills, {self.starts} starts (slowest {slowest:.1f} s),"
            f" {self.sent} sent, {self.acknowledged} acknowledged, {self.refused} refused,"
            f" {self.delivered} delivered, of these {self.repeated} again (QoS 1);"
            f" {len(self.problems)} problems"
        )


#: Does something to the store's files between a kill and the next start.
Harm = Callable[[Path, random.Random], None]


class Ordeal:
    """Builds broker and clients, runs them, and adds up."""

    #: The fewest messages that are acknowledged until the end, on however slow a computer.
    least = 0

    def __init__(
        self,
        directory: Path,
        seed: int,
        *,
        harm: Harm | None = None,
        store: dict[str, object] | None = None,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.report = Report(seed)
        self.random = random.Random(seed)
        self.harm = harm
        self.say = say
        broker = {**BROKER, "store": store} if store else BROKER
        self.broker = ApplianceProcess(directory, acl=ACL, broker=broker)
        self.world: World

    @property
    def publishers(self) -> list[Publisher]:
        return self.world.publishers

    @property
    def subscribers(self) -> list[Subscriber]:
        return self.world.subscribers

    @property
    def _acknowledged(self) -> int:
        return sum(len(each.acknowledged) for each in self.publishers)

    @property
    def store(self) -> Path:
        return self.broker.directory / "state/store.db"

    def run(self, kills: int) -> Report:
        """Kill it so many times; the broker has ended when this returns."""
        self._start()
        try:
            asyncio.run(self._run(kills))
            self.broker.stop()
        finally:
            if self.broker._process is not None:
                self._kill()
        for line in self.broker.log.splitlines():
            if "Traceback" in line or "Exception" in line:
                self.report.problems.append(line)
        return self.report

    def _start(self) -> None:
        began = time.monotonic()
        self.broker.start()
        self.report.starts += 1
        self.report.start_times.append(time.monotonic() - began)

    def _kill(self) -> None:
        process = self.broker._process
        assert process is not None and self.broker._reader is not None
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        self.broker._reader.join()
        self.broker._process = None

    def _make_clients(self) -> list[Client]:
        world = self.world
        for number, (version, qos) in enumerate(((4, 1), (5, 1), (4, 2), (5, 2))):
            name = f"publisher{number}"
            self.world.publishers.append(Publisher(world, name, version, qos, tls=number in (1, 2)))
        for version in (4, 5):
            name = f"keeper{version}"
            self.world.publishers.append(
                Publisher(world, name, version, 1, tls=version == 4, retain=True, window=2)
            )
        for number, version in enumerate((4, 5, 5)):
            self.world.subscribers.append(
                Subscriber(
                    world, f"subscriber{number}", version, tls=number == 0, leaves=number == 2
                )
            )
        return [*self.subscribers, *self.publishers]

    async def _run(self, kills: int) -> None:
        self.world = world = World(self.broker, forgetful=self.harm is not None)
        tasks = []
        clients = self._make_clients()
        try:
            world.up.set()
            tasks += [asyncio.create_task(client.run()) for client in self.subscribers]
            for subscriber in self.subscribers:
                await asyncio.wait_for(subscriber.subscribed.wait(), 30)
            tasks += [asyncio.create_task(client.run()) for client in self.publishers]
            for number in range(kills):
                await asyncio.sleep(self.random.choice((0.02, 0.1, 0.5)) * self.random.random())
                await self._until(
                    lambda: sum(client.connected for client in clients) >= 4, "clients come back"
                )
                await asyncio.sleep(0.5 * self.random.random())
                world.up.clear()
                await asyncio.to_thread(self._kill)
                self.report.kills += 1
                if self.harm is not None:
                    self.harm(self.store, self.random)
                await asyncio.to_thread(self._start)
                world.up.set()
                if (number + 1) % 25 == 0:
                    self.say(f"{number + 1} kills, {self._acknowledged} acknowledged")
            await self._until(lambda: self._acknowledged > self.least, "enough is acknowledged")
            await self.settle()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        for task in tasks:
            if not task.cancelled() and (error := task.exception()) is not None:
                self.report.problems.append(f"a client failed: {error!r}")
        self.add_up()

    async def settle(self) -> None:
        """Publish nothing new, and wait until all that is on its way has come."""
        world = self.world
        world.stopping = True
        for subscriber in self.subscribers:
            subscriber.leaves = False
        await self._until(lambda: all(p.idle for p in self.publishers), "exchanges end")
        await self._until(lambda: all(s.connected for s in self.subscribers), "subscribers come")
        # A disk that is busy with something else lets everybody wait, sometimes for seconds.
        with contextlib.suppress(AssertionError):  # what does not come is told by `add_up`
            await self._until(lambda: not self._is_incomplete(), "everything comes")
        events, since = -1, time.monotonic()
        while time.monotonic() - since < QUIET:
            await asyncio.sleep(0.05)
            now = sum(subscriber.events for subscriber in self.subscribers)
            if now != events or not all(s.connected for s in self.subscribers):
                events, since = now, time.monotonic()
        await asyncio.to_thread(self._check_retained)

    def _is_incomplete(self) -> bool:
        """Whether something is on its way yet that was acknowledged; not known of damaged files."""
        return not self.world.forgetful and any(
            self._missing(publisher, subscriber)
            for publisher in self.publishers
            if not publisher.retain
            for subscriber in self.subscribers
        )

    @staticmethod
    def _missing(publisher: Publisher, subscriber: Subscriber) -> list[int]:
        name, received = publisher.client_id, subscriber.received
        return sorted(number for number in publisher.acknowledged if not received[name, number])

    async def _until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + 60
        while not condition():
            if time.monotonic() > deadline:
                raise AssertionError(f"not within 60 s: {what}\n{self.broker.log[-3000:]}")
            await asyncio.sleep(0.005)

    def _check_retained(self) -> None:
        found: dict[str, int] = {}
        with RawClient(self.broker, 4) as client:
            client.connect("late")
            client.send(Subscribe(1, [Subscription("r2d2/kept/#", 0)]))
            for packet in client.drain():
                if isinstance(packet, Publish):
                    found[packet.topic] = self.world.number(packet.payload)
        for publisher in self.publishers:
            if not publisher.retain or self.world.forgetful:
                continue
            for slot in range(5):
                numbers = {n for n in range(1, publisher.sent + 1) if n % 5 == slot}
                last = max(numbers & publisher.acknowledged, default=0)
                number = found.get(publisher.topic(slot), 0)
                if number < last or number not in numbers | {0}:
                    text = f"{publisher.topic(slot)}: {number} is retained, {last} acknowledged"
                    self.report.problems.append(text)

    def add_up(self) -> None:
        report, world = self.report, self.world
        report.problems += world.problems
        report.refused = sum(world.refused.values())
        for publisher in self.publishers:
            report.sent += publisher.sent
            report.acknowledged += len(publisher.acknowledged)
            if publisher.retain or world.forgetful:
                continue
            for subscriber in self.subscribers:
                self._compare(publisher, subscriber)

    def _compare(self, publisher: Publisher, subscriber: Subscriber) -> None:
        problems = self.report.problems
        name = publisher.client_id
        twice = []
        for number in range(1, publisher.sent + 1):
            count = subscriber.received[name, number]
            self.report.delivered += count
            if publisher.qos == 2 and count > 1:
                twice.append(number)
            if publisher.qos == 2 and count and number in publisher.declined:
                problems.append(f"{subscriber.client_id}: {number} of {name} was refused")
            self.report.repeated += max(0, count - 1)
        if lost := self._missing(publisher, subscriber):
            problems.append(f"{subscriber.client_id}: {name}: LOST {lost[:20]} ({len(lost)})")
        if twice:
            problems.append(f"{subscriber.client_id}: {name}: TWICE {twice[:20]} ({len(twice)})")
