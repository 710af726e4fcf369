"""The fleet is away for hours: the newest are kept, memory does not grow, the start is quick."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from upstream import account
from upstream.client import MqttClient
from upstream.device import HERE, THERE, ApplianceDevice, BridgeDevice, Device, count
from upstream.relay import Relay
from upstream.streams import Side, Sink, running
from upstream.trial import Trial

#: How much the device may grow, in bytes.
GROWTH = 64 << 20

#: Seconds longer than with an empty backlog until a local CONNECT is answered.
START = 1.0

#: Topics of which only the latest counts; every fifth of them is deleted at the end.
LATEST = 50

#: Seconds without anything new after which nothing more comes.
STALLED = 90.0
QUIET = 3.0

#: Unacknowledged messages of the publisher.
WINDOW = 500


@dataclass
class Report:
    """How a run went; times are in seconds."""

    published: int = 0
    received: int = 0
    dropped: int | None = None
    publishing: float = 0.0
    draining: float = 0.0
    starts: list[float] = field(default_factory=list)
    memory: list[tuple[float, int]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        most = max((size for _, size in self.memory), default=0) / 2**20
        starts = " and ".join(f"{each:.2f}" for each in self.starts)
        return (
            f"{self.published} published in {self.publishing:.0f} s, {self.received} received in"
            f" {self.draining:.0f} s, {self.dropped} dropped by its own account; at most"
            f" {most:.0f} MiB; CONNECT answered {starts or '-'} s after the start (empty and full);"
            f" {len(self.problems)} problems"
        )


class Outage(Trial[Report]):
    """Publishes while the fleet is away, then lets it come back.

    `size` is the backlog's (as appliance.yaml has it); with `restarts` the device is killed with
    all that waiting, and has to answer a local CONNECT as quickly as when it was empty.
    """

    def __init__(
        self,
        directory: Path,
        *,
        messages: int = 2_880_000,
        payload: int = 100,
        size: str = "64 MiB",
        rate: float | None = None,
        restarts: bool = False,
        queue: int = 0,
        **common: Any,
    ) -> None:
        super().__init__(directory, Report(), **common)
        self.messages = messages
        self.payload = payload
        self.size = size
        self.rate = rate
        self.restarts = restarts
        self.queue = queue

    async def carry_out(self, relay: Relay, fleet: int) -> None:
        there = Side(lambda: fleet)
        sink = Sink(there, "fleet-sink", f"{THERE}events/#", f"{THERE}state/#")
        sink.verbatim = (f"{THERE}state/",)
        there.up.set()
        async with running(sink):
            await self._try(relay, sink)

    def make_device(self, remote: int) -> Device:
        if self.kind == "mosquitto":
            options = f"max_queued_messages {self.queue}"
            return BridgeDevice(self.directory / "device", remote, options=options)
        link: dict[str, Any] = {"backlog": {"size": self.size}}
        return ApplianceDevice(self.directory / "device", remote, link=link)

    async def _start(self) -> float:
        """Seconds until a local CONNECT is answered."""
        began = time.monotonic()
        await asyncio.to_thread(self.device.start)
        client = await self.dial("first")
        took = time.monotonic() - began
        client.abort()
        return took

    async def _try(self, relay: Relay, sink: Sink) -> None:
        await asyncio.wait_for(sink.subscribed.wait(), 60)
        robot = await self.dial("robot")
        topic = f"{THERE}events/probe"
        while not sink.received.get(topic):  # the link is up
            await robot.publish(f"{HERE}events/probe", b"1 ")
            await asyncio.sleep(0.1)
        robot.abort()
        if self.restarts:
            await asyncio.to_thread(self.device.kill)
            self.report.starts.append(await self._start())
        await relay.refuse()
        await asyncio.sleep(1)  # until nothing is in flight any more
        before = self._dropped() or 0
        robot = await self.dial("robot")
        latest = await self._publish(robot)
        robot.abort()
        counted = 0
        if self.restarts:
            counted, before = (self._dropped() or 0) - before, 0  # it counts from its start on
            await asyncio.to_thread(self.device.kill)
            self.report.starts.append(await self._start())
            first, second = self.report.starts
            if second > first + START:
                self.report.problems.append(
                    f"CONNECT is answered {second:.2f} s after the start, {first:.2f} s when empty"
                )
        self.say(f"the fleet is back: {self._status()}")
        began = time.monotonic()
        await relay.start()
        await self._drain(sink)
        self.report.draining = time.monotonic() - began
        dropped = self._dropped()
        self._add_up(sink, latest, None if dropped is None else counted + dropped - before)

    def _status(self) -> dict[str, Any] | None:
        return self.device.status()

    def _dropped(self) -> int | None:
        """By its own account, of the rule that keeps all: others replace older messages."""
        status = self._status()
        if status is None:
            return None
        return count(status["dropped"], f"{HERE}events/#") or 0

    async def _publish(self, robot: MqttClient) -> dict[str, list[bytes]]:
        report = self.report
        latest: dict[str, list[bytes]] = {}
        pending: deque[asyncio.Future[int]] = deque()
        began = told = time.monotonic()
        padding = b"x" * max(0, self.payload - 10)
        for number in range(1, self.messages + 1):
            pending.append(robot.publish(f"{HERE}events/flood", b"%d %s" % (number, padding)))
            if not number % 100:
                name = f"state/{number // 100 % LATEST}"
                payload = b"%d" % number
                retained = number // 100 % LATEST < 10
                pending.append(robot.publish(HERE + name, payload, 1, retain=retained))
                latest.setdefault(THERE + name, []).append(payload)
            while len(pending) >= WINDOW:
                await self._outcome(pending.popleft())
            if self.rate is not None:
                await asyncio.sleep(max(0.0, began + number / self.rate - time.monotonic()))
            now = time.monotonic()
            if now - told >= 1:
                told = now
                report.memory.append((now, self.device.memory()))
                if len(report.memory) % 10 == 0:
                    self.say(
                        f"{number} published, {number / (now - began):.0f} a second,"
                        f" {report.memory[-1][1] / 2**20:.0f} MiB"
                    )
        for name in list(latest)[::5]:  # deletions go through as well
            here = HERE + name.removeprefix(THERE)
            pending.append(robot.publish(here, b"", 1, retain=True))
            latest[name].append(b"")
        while pending:
            await self._outcome(pending.popleft())
        report.published = self.messages
        report.publishing = time.monotonic() - began
        report.memory.append((time.monotonic(), self.device.memory()))
        return latest

    async def _outcome(self, future: asyncio.Future[int]) -> None:
        code = await future
        if code >= 0x80:
            self.report.problems.append(f"the publisher is refused with {code:#x}")
            assert len(self.report.problems) < 20, self.report.problems

    async def _drain(self, sink: Sink) -> None:
        topic = f"{THERE}events/flood"
        seen, since = -1, time.monotonic()
        while True:
            await asyncio.sleep(0.1)
            now = time.monotonic()
            if sink.count != seen:
                seen, since = sink.count, now
            came = sink.received.get(topic, [])
            complete = bool(came) and came[-1].number == self.messages
            if now - since > (QUIET if complete else STALLED):
                return

    def _add_up(self, sink: Sink, latest: dict[str, list[bytes]], dropped: int | None) -> None:
        report = self.report
        topic = f"{THERE}events/flood"
        numbers = sink.numbers(topic)
        report.received = len(numbers)
        report.dropped = dropped
        report.problems += account.newest_kept(topic, report.published, numbers, dropped)
        report.problems += account.order(topic, numbers, 0)
        report.problems += account.latest_only(latest, sink.payloads)
        report.problems += account.growth(report.memory, GROWTH)
