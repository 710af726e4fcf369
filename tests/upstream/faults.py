"""Minutes of random faults of the line: no stall, no growth, and the state there is true."""

from __future__ import annotations

import asyncio
import random
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from appliance.mqtt.packets import Publish
from upstream import account
from upstream.account import State
from upstream.client import MqttClient
from upstream.device import HERE, THERE
from upstream.relay import Relay
from upstream.streams import Side, Sink, Source, running
from upstream.trial import Trial

#: Of the link (device.ApplianceDevice), in seconds.
KEEP_ALIVE = 5.0

#: Seconds behind the end of a fault until messages flow again: a backoff of a minute at the most.
STALL = 75.0

#: Seconds behind 1.5 keep alives: the computer is busy.
LENIENCE = 2.0

#: Seconds between two looks of a fleet's broker at who is silent. mosquitto 2.0 looks every sixth
#: second (src/keepalive.c): with a keep alive of 5 s its will comes after 7.2 to 13.0 s.
LOOKS = {"mosquitto": 6.0}

#: Bytes by which the device may grow after its first tenth.
GROWTH = 16 << 20

#: Messages a second from each side.
RATE = 100


#: A long one is silent for longer than any keep alive, a short one is not.
KINDS = (
    *("delay", "rate", "silence", "long silence", "one way"),
    *("reset", "close", "cut", "refuse", "forget"),
)


@dataclass
class Report:
    """How a run went."""

    seed: int
    seconds: float = 0.0
    faults: int = 0
    acknowledged: int = 0
    received: int = 0
    repeated: int = 0
    longest: float = 0.0
    memory: list[tuple[float, int]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        most = max((size for _, size in self.memory), default=0) / 2**20
        return (
            f"seed {self.seed}: {self.seconds:.0f} s, {self.faults} faults,"
            f" {self.acknowledged} acknowledged, {self.received} received, of these"
            f" {self.repeated} again; messages flow {self.longest:.1f} s behind a fault at the"
            f" latest; at most {most:.0f} MiB; {len(self.problems)} problems"
        )


class Faults(Trial[Report]):
    """One fault after the other, with a good line between them; then all is added up."""

    def __init__(
        self, directory: Path, seed: int, *, seconds: float = 600.0, **common: Any
    ) -> None:
        super().__init__(directory, Report(seed), **common)
        self.seconds = seconds
        self.random = random.Random(seed)
        self.states: list[State] = []
        #: Spans of time, and whether the line carried in them: for `account.truth`.
        self.carried: list[tuple[float, float, bool]] = []

    async def carry_out(self, relay: Relay, fleet: int) -> None:
        device = self.device
        here = Side(lambda: device.port, device.user, device.password)
        there = Side(lambda: fleet)
        outward = Sink(there, "fleet-sink", f"{THERE}events/#")
        inward = Sink(here, "robot-sink", f"{HERE}mission/#")
        sources = [
            Source(here, "robot-1", f"{HERE}events/one", rate=RATE, window=1000),
            Source(there, "fleet-1", f"{THERE}mission/one", rate=RATE, window=1000),
        ]
        watch = await MqttClient.dial(fleet, "watch")
        watch.on_message = self._took_state
        await watch.subscribe(f"{THERE}_appliance/state")
        here.up.set()
        there.up.set()
        self.pairs = [
            (sources[0], outward, f"{THERE}events/one"),
            (sources[1], inward, f"{HERE}mission/one"),
        ]
        async with running(outward, inward, *sources):
            await self._flows(time.monotonic())
            await self._disturb(relay)
            for source in sources:
                source.stopping = True
            await self._settle()
        watch.abort()
        self._add_up(relay)

    def _took_state(self, message: Publish) -> None:
        self.states.append(State(time.monotonic(), message.payload.decode()))

    async def _disturb(self, relay: Relay) -> None:
        began = time.monotonic()
        good = began
        dice = self.random
        while (now := time.monotonic()) - began < self.seconds:
            self.report.memory.append((now, self.device.memory()))
            await asyncio.sleep(dice.uniform(0.2, 2.0) if dice.random() < 0.7 else 8.0)
            self.carried.append((good, time.monotonic(), True))
            kind, dead = await self._fault(relay)
            self.report.faults += 1
            ended = time.monotonic()
            if dead is not None:
                self.carried.append((dead, ended, False))
            await self._flows(ended)
            # The link is back from here on, and says so.
            good = time.monotonic()
            took = good - ended
            self.report.longest = max(self.report.longest, took)
            self.say(f"{good - began:6.0f} s  {kind}: flows after {took:.1f} s")
        self.report.seconds = time.monotonic() - began

    async def _fault(self, relay: Relay) -> tuple[str, float | None]:
        """Its name, and since when nothing was carried; it has ended when this returns."""
        dice = self.random
        kind = dice.choice(KINDS)
        began = time.monotonic()
        dead: float | None = None
        if kind == "delay":
            relay.set(delay=dice.choice((0.05, 0.3, 1.0)))
            await asyncio.sleep(dice.uniform(1, 5))
        elif kind == "rate":
            relay.set(rate=dice.choice((20_000, 5_000)))
            await asyncio.sleep(dice.uniform(1, 5))
        elif kind in ("silence", "long silence", "one way"):
            way = dice.choice(("up", "down")) if kind == "one way" else None
            relay.silence(way)  # type: ignore[arg-type]
            await asyncio.sleep(dice.uniform(0.1, 4) if kind != "long silence" else 20)
            dead = began if kind == "long silence" else None
        elif kind == "reset":
            relay.reset()
        elif kind == "close":
            relay.close()
        elif kind == "cut":
            way = dice.choice(("up", "down"))
            relay.cut(dice.randrange(1, 50_000), way, reset=dice.random() < 0.5)  # type: ignore[arg-type]
            await asyncio.sleep(dice.uniform(0.5, 2))
        elif kind == "refuse":
            await relay.refuse()
            await asyncio.sleep(dice.uniform(0.5, 12))
            dead = began
            await relay.start()
        else:
            relay.forget()
        relay.release()
        relay.set(delay=0.0, rate=None)
        return kind, dead

    async def _flows(self, since: float) -> None:
        """Messages of now come through, both ways; a stall is a problem."""
        marks = [(source.sent, sink, topic) for source, sink, topic in self.pairs]
        for number, sink, topic in marks:
            while not (came := sink.received.get(topic)) or came[-1].number <= number:
                if time.monotonic() - since > STALL:
                    self.report.problems.append(f"{topic} STALLS: nothing for {STALL:g} s")
                    return
                await asyncio.sleep(0.01)

    async def _settle(self) -> None:
        count, since = -1, time.monotonic()
        while time.monotonic() - since < 3.0:
            await asyncio.sleep(0.05)
            now = sum(sink.count for _, sink, _ in self.pairs)
            missing = any(s.acknowledged - set(sink.numbers(t)) for s, sink, t in self.pairs)
            if now != count:
                count, since = now, time.monotonic()
            elif missing and time.monotonic() - since < 2.9:
                since = max(since, time.monotonic() - 2.5)
                if time.monotonic() - self.pairs[0][1].received[self.pairs[0][2]][-1].time > STALL:
                    return

    def _add_up(self, relay: Relay) -> None:
        report = self.report
        for source, sink, topic in self.pairs:
            numbers = sink.numbers(topic)
            first = numbers[0] if numbers else 1
            owed = {each for each in source.acknowledged if each >= first}
            report.acknowledged += len(source.acknowledged)
            report.received += len(numbers)
            report.repeated += account.repeated(numbers)
            report.problems += account.loss(topic, owed, numbers)
            report.problems += account.order(topic, numbers, relay.accepted)
        grace = 1.5 * KEEP_ALIVE + LOOKS.get(self.fleet_kind, 0.0) + LENIENCE
        report.problems += account.truth(self.states, self.carried, grace)
        report.problems += account.growth(report.memory, GROWTH)
