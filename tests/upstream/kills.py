"""The device is killed at random under load, or both ends are; then all is added up."""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from appliance_process import ApplianceProcess

from upstream import account
from upstream.device import HERE, IN, THERE, ApplianceDevice, BridgeDevice, Device
from upstream.peers import HOST, PASSWORD, USER, Ejabberd, FleetMosquitto, RabbitMQ
from upstream.relay import Relay
from upstream.streams import Member, Side, Sink, Source, version_of

#: Messages of a stream that may be on their way: enough to have a backlog, few enough to drain.
MOST_WAITING = 5000

#: Seconds without anything new after which nothing more is expected.
QUIET = 2.0

#: Seconds between two lines that say what is missing.
PROGRESS = 10.0

#: Seconds without anything new after which what is missing is lost: two backoffs of a minute.
STALLED = 130.0

#: Seconds until the first message has come through.
CONNECTING = 120.0

#: Seconds until mosquitto is started once more because its bridge does not begin: it was seen to
#: stay silent for all of CONNECTING.
SILENT = 30.0

FLEETS = ("mosquitto", "rabbitmq", "appliance", "ejabberd")
Fleet = Literal["mosquitto", "rabbitmq", "appliance", "ejabberd"]


class ApplianceFleet(ApplianceProcess):
    """A second appliance as the fleet's broker."""

    def __init__(self, directory: Path) -> None:
        acl = f"user {USER}\ntopic readwrite #\n"
        limits = {"queue_messages": 1_000_000, "queue_bytes": "256 MiB", "memory": "512 MiB"}
        super().__init__(directory, users={USER: PASSWORD}, acl=acl, broker={"limits": limits})

    def kill(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            assert self._reader is not None
            self._reader.join()


def make_fleet(kind: Fleet, directory: Path) -> Any:
    """A broker with `start`, `stop`, `kill` and `plain_port`, not started."""
    kinds: dict[str, Callable[[Path], Any]] = {
        "mosquitto": FleetMosquitto,
        "rabbitmq": RabbitMQ,
        "appliance": ApplianceFleet,
        "ejabberd": Ejabberd,
    }
    return kinds[kind](directory)


def make_device(kind: str, directory: Path, remote: int, fleet: Fleet, window: int) -> Device:
    """The appliance, or mosquitto with its bridge."""
    if kind.startswith("mosquitto"):
        version = "mqttv311" if kind.endswith("311") else "mqttv50"
        return BridgeDevice(directory, remote, window=window, version=version)
    link: dict[str, Any] = {}
    if fleet == "rabbitmq":
        # In 3.1.1 what is received must not overlap with what is sent: no `+/_call`.
        link = {"kind": "rabbitmq", "version": "3.1.1", "in": [dict(rule) for rule in IN[:2]]}
    return ApplianceDevice(directory, remote, window=window, link=link)


#: Who is killed; with `nobody` only the line is cut.
Victims = Literal["device", "both", "nobody"]


@dataclass
class Report:
    """How a run went."""

    seed: int
    kills: int = 0
    cuts: int = 0
    sent: int = 0
    acknowledged: int = 0
    refused: int = 0
    received: int = 0
    repeated: int = 0
    problems: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return (
            f"seed {self.seed}: {self.kills} kills, {self.cuts} cuts, {self.sent} sent,"
            f" {self.acknowledged} acknowledged, {self.refused} refused, {self.received} received,"
            f" of these {self.repeated} again; {len(self.problems)} problems"
        )


class Kills:
    """Builds all parts, runs them, and adds up. `victims` is who is killed."""

    def __init__(
        self,
        directory: Path,
        seed: int,
        *,
        device: str = "appliance",
        fleet: Fleet = "mosquitto",
        victims: Victims = "device",
        window: int = 100,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.report = Report(seed)
        self.random = random.Random(seed)
        self.say = say
        self.victims = victims
        self.fleet = make_fleet(fleet, directory / "fleet")
        self.device_kind, self.fleet_kind, self.window = device, fleet, window
        self.directory = directory
        self.device: Device
        #: When somebody was killed.
        self.killed_at: list[float] = []

    def run(self, kills: int) -> Report:
        """Kill so many times; everything has ended when this returns."""
        self.fleet.start()
        try:
            asyncio.run(self._run(kills))
        finally:
            if hasattr(self, "device"):
                self.device.kill()
            self.fleet.kill()
        if hasattr(self, "device"):
            for line in self.device.log.splitlines():
                if "Traceback" in line or "Exception" in line:
                    self.report.problems.append(line)
        return self.report

    async def _run(self, kills: int) -> None:
        async with Relay(self.fleet.plain_port) as relay:
            relay.set(delay=0.005)
            self.relay = relay
            self.device = make_device(
                self.device_kind,
                self.directory / "device",
                relay.port,
                self.fleet_kind,
                self.window,
            )
            await asyncio.to_thread(self.device.start)
            self._make_clients()
            tasks = [asyncio.create_task(each.run()) for each in self.members]
            try:
                await self._begin()
                for number in range(kills):
                    await self._disturb()
                    if not (number + 1) % 25:
                        self.say(self._progress())
                await self._settle()
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
            for task in tasks:
                if not task.cancelled() and (error := task.exception()) is not None:
                    self.report.problems.append(f"a client failed: {error!r}")
        self._add_up()

    def _make_clients(self) -> None:
        device = self.device
        self.here = here = Side(lambda: device.port, device.user, device.password)
        self.there = there = Side(lambda: self.fleet.plain_port, version=version_of(self.fleet))
        self.sources: list[tuple[Source, Sink, str]] = []
        self.there_sink = Sink(there, "fleet-sink", f"{THERE}events/#", f"{THERE}alarms/#")
        self.here_sink = Sink(here, "robot-sink", f"{HERE}mission/#")

        def add(side: Side, name: str, topic: str, sink: Sink, arrives: str, **more: Any) -> None:
            source = Source(side, name, topic, **more)
            source.crowded = lambda: (
                source.sent - len(sink.received.get(arrives, ())) > MOST_WAITING
            )
            self.sources.append((source, sink, arrives))

        for name, topic, more in (
            ("robot-1", "events/one", {}),
            ("robot-2", "events/two/qos2", {"qos": 2}),
            ("robot-3", "alarms/three", {"rate": 50}),
        ):
            add(here, name, HERE + topic, self.there_sink, THERE + topic, **more)
        for name, topic, more in (
            ("fleet-1", "mission/one", {"rate": 200}),
            ("fleet-2", "mission/two", {"rate": 20}),
        ):
            add(there, name, THERE + topic, self.here_sink, HERE + topic, **more)
        self.members: list[Member] = [self.there_sink, self.here_sink]
        self.members += [source for source, _, _ in self.sources]
        here.up.set()
        there.up.set()

    async def _begin(self) -> None:
        await self._until(self.there_sink.subscribed.is_set, "the fleet's sink subscribes")
        await self._until(self.here_sink.subscribed.is_set, "the robot's sink subscribes")
        if isinstance(self.device, BridgeDevice):
            try:
                await self._until(self._all_flow, "all streams flow", SILENT)
            except AssertionError as error:
                self.say(str(error))
                await asyncio.to_thread(self.device.restart)
        await self._until(self._all_flow, "all streams flow")
        # What was published before the link had subscribed there was for nobody.
        self.first = {
            source.name: sink.received[topic][0].number for source, sink, topic in self.sources
        }
        self.say("all streams flow")

    def _all_flow(self) -> bool:
        return all(sink.received.get(topic) for _, sink, topic in self.sources)

    async def _disturb(self) -> None:
        dice = self.random
        await asyncio.sleep(dice.choice((0.05, 0.3, 1.0, 2.0)) * dice.random())
        if self.victims == "nobody" or dice.random() < 0.3:
            await self._cut()
        if self.victims == "nobody":
            return
        both = self.victims == "both"
        who = dice.choice(("device", "fleet", "both")) if both else "device"
        work = []
        if who in ("device", "both"):
            self.here.up.clear()
            work.append(asyncio.to_thread(self._restart_device))
        if who in ("fleet", "both"):
            self.there.up.clear()
            work.append(asyncio.to_thread(self._restart_fleet))
        self.killed_at.append(time.monotonic())
        await asyncio.gather(*work)
        self.report.kills += 1
        # An appliance has another port after each start.
        self.relay.target = (HOST, self.fleet.plain_port)
        self.here.up.set()
        self.there.up.set()
        await self._until(
            lambda: all(each.connected for each in self.members), "all clients come back"
        )

    async def _cut(self) -> None:
        """Something on the line, before the kill."""
        dice, relay = self.random, self.relay
        self.report.cuts += 1
        how = dice.randrange(4)
        if how == 0:
            relay.reset()
        elif how == 1:
            relay.cut(dice.randrange(1, 20_000), dice.choice(("up", "down")))
        elif how == 2:
            relay.silence(dice.choice(("up", "down", None)))
            await asyncio.sleep(dice.random())
            relay.release()
        else:
            await relay.refuse()
            await asyncio.sleep(dice.random() * 0.5)
            await relay.start()
        await asyncio.sleep(dice.random())

    def _restart_device(self) -> None:
        self.device.kill()
        self.device.start()

    def _restart_fleet(self) -> None:
        self.fleet.kill()
        self.fleet.start()

    def _progress(self) -> str:
        acknowledged = sum(len(source.acknowledged) for source, _, _ in self.sources)
        received = self.there_sink.count + self.here_sink.count
        return f"{self.report.kills} kills, {acknowledged} acknowledged, {received} received"

    async def _settle(self) -> None:
        """Publish nothing new, and wait until all that is on its way has come."""
        self.say("draining")
        for source, _, _ in self.sources:
            source.stopping = True
        await self._until(lambda: all(s.idle for s, _, _ in self.sources), "exchanges end")
        count, since = -1, time.monotonic()
        told_at = since
        while True:
            await asyncio.sleep(0.05)
            now = time.monotonic()
            if now - told_at > PROGRESS:
                told_at = now
                self.say(f"still missing: {self._shortages()}")
            if self.there_sink.count + self.here_sink.count != count:
                count, since = self.there_sink.count + self.here_sink.count, now
            elif now - since > QUIET and (not self._missing() or now - since > STALLED):
                return

    def _missing(self) -> bool:
        return any(
            self._owed(source) - set(sink.numbers(topic)) for source, sink, topic in self.sources
        )

    def _shortages(self) -> str:
        """By topic, how many acknowledged messages have not arrived."""
        missing = {
            topic: sorted(self._owed(source) - set(sink.numbers(topic)))
            for source, sink, topic in self.sources
        }
        return ", ".join(
            f"{topic}: {len(numbers)} from {numbers[0]} to {numbers[-1]}"
            for topic, numbers in missing.items()
            if numbers
        )

    def _owed(self, source: Source) -> set[int]:
        return {each for each in source.acknowledged if each >= self.first[source.name]}

    async def _until(
        self, condition: Callable[[], object], what: str, patience: float = CONNECTING
    ) -> None:
        deadline = time.monotonic() + patience
        while not condition():
            if time.monotonic() > deadline:
                raise AssertionError(f"not within {patience:g} s: {what}\n{self._state()}")
            await asyncio.sleep(0.005)

    def _state(self) -> str:
        """Who is connected, what has come, and what both brokers log."""
        members = [
            f"{each.name}: connected {each.connected}, {each.connects} times"
            for each in self.members
        ]
        streams = [
            f"{source.name}: {source.sent} sent, {len(source.acknowledged)} acknowledged,"
            f" {len(sink.numbers(topic))} received"
            for source, sink, topic in self.sources
        ]
        logs = [
            line
            for broker in (self.device, self.fleet)
            for line in broker.log.splitlines()[-200:]
            if "Saving in-memory database" not in line
        ]
        return "\n".join([*members, *streams, *logs])

    def _add_up(self) -> None:
        report = self.report
        for source, sink, topic in self.sources:
            numbers = sink.numbers(topic)
            report.sent += source.sent
            report.acknowledged += len(source.acknowledged)
            report.refused += len(source.refused)
            report.received += len(numbers)
            report.repeated += account.repeated(numbers)
            report.problems += account.loss(topic, self._owed(source), numbers)
            report.problems += account.inventions(topic, source.sent, numbers)
            # The fleet's broker sends again as well, when its client comes back.
            again = self.relay.accepted + sink.connects
            report.problems += account.order(topic, numbers, again)
            if sink is self.there_sink:
                # A killed broker may have forgotten as much of what its client has acknowledged.
                forgetful = 2 if self.victims == "both" else 1
                report.problems += account.repetition(
                    topic,
                    sink.received.get(topic, []),
                    sorted(self.killed_at + self.relay.ended_at),
                    self.window * forgetful,
                    self.device.linger * forgetful + 0.5,
                )
