"""Minutes of a fleet's broker that does anything to a link: nothing is lost, and nobody waits.

For some seconds it does one thing, chosen at random: a misdeed of `hostile.py`, bytes that are not
what they should be, limits, late or strange acknowledgements. Meanwhile a local client publishes
what the link has to carry, and another one looks how soon it is answered. In the end the broker is
good: then all that was acknowledged here has to have come there, in order: in every other run it
never does what lets the link put a message off, and send others first.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from raw_client import RawClient
from waiting import until

from appliance.mqtt.codec import V5, Properties, Property
from appliance.mqtt.packets import Packet, Pingresp
from upstream import account
from upstream.device import HERE, THERE, ApplianceDevice
from upstream.fake_fleet import FakeFleet, Visit, accept, late, never, refuse, reversed_in
from upstream.hostile import SCENARIOS
from upstream.streams import Side, Source, running

W = TypeVar("W", str, Property)

#: What the local client's messages are there.
EVENTS = f"{THERE}events/one"

#: Messages a second that the local client publishes.
RATE = 100

#: Messages that come before it misbehaves.
FIRST = 20

#: Seconds in which a local client's ping is answered, whatever the fleet's broker does.
ANSWERED = 0.25

#: Seconds in which all has come once the broker is good, and its connection lasts.
DRAINED = 120.0

#: Seconds until it is asked how it is; that takes a process.
ASKING = 3.0

#: Bytes by which the appliance may grow after its first tenth.
GROWTH = 16 << 20

#: What a connection may be limited to.
LIMITS: dict[Property, tuple[Any, ...]] = {
    Property.RECEIVE_MAXIMUM: (1, 2, 65535),
    Property.MAXIMUM_PACKET_SIZE: (20, 60, 200, 2000),
    Property.TOPIC_ALIAS_MAXIMUM: (0, 1, 65535),
    Property.SERVER_KEEP_ALIVE: (1, 2, 65535),
    Property.MAXIMUM_QOS: (1,),  # with 0 it acknowledges nothing, and what is under way is lost
    Property.RETAIN_AVAILABLE: (0, 1),
    Property.WILDCARD_SUBSCRIPTION_AVAILABLE: (0, 1),
    Property.SUBSCRIPTION_IDENTIFIER_AVAILABLE: (0, 1),
    Property.ASSIGNED_CLIENT_IDENTIFIER: ("x" * 1000,),
    Property.SESSION_EXPIRY_INTERVAL: (1,),
}


#: Lets links dial again at once (sitecustomize.py).
HURRIED = Path(__file__).parent / "hurried"


@dataclass
class Report:
    """How a run went."""

    seed: int
    #: Whether `puts_off` is among what is done: then the order is not looked at.
    puts_off: bool = False
    seconds: float = 0.0
    steps: int = 0
    connections: int = 0
    acknowledged: int = 0
    received: int = 0
    set_aside: int = 0
    pings: list[float] = field(default_factory=list)
    memory: list[tuple[float, int]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        pings = sorted(self.pings) or [0.0]
        most = max((size for _, size in self.memory), default=0) / 2**20
        return (
            f"seed {self.seed}: {self.seconds:.0f} s, {self.steps} misdeeds on {self.connections}"
            f" connections, {self.acknowledged} acknowledged, {self.received} received,"
            f" {self.set_aside} set aside; a local ping takes"
            f" {pings[len(pings) * 99 // 100] * 1e3:.1f} ms (99 %), {pings[-1] * 1e3:.1f} ms at the"
            f" most; at most {most:.0f} MiB; {'some put off' if self.puts_off else 'in order'};"
            f" {len(self.problems)} problems"
        )


class HostileFleet:
    """The broker, a link of an appliance to it, and two local clients."""

    def __init__(
        self,
        directory: Path,
        seed: int,
        *,
        seconds: float = 300.0,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.directory = directory
        self.report = Report(seed)
        self.seconds = seconds
        self.random = random.Random(seed)
        self.say = say
        self.doing = "nothing yet"
        self.report.puts_off = self.random.random() < 0.5
        self.over = threading.Event()
        self.fleet: FakeFleet
        self.device: ApplianceDevice

    def run(self) -> Report:
        asyncio.run(self._run())
        return self.report

    async def _run(self) -> None:
        async with FakeFleet(seed=self.report.seed) as self.fleet:
            self.device = device = ApplianceDevice(self.directory / "device", self.fleet.port)
            device.process.environment["PYTHONPATH"] = str(HURRIED)
            await asyncio.to_thread(device.start)
            try:
                await self._try()
            finally:
                device.kill()

    async def _try(self) -> None:
        device = self.device
        here = Side(lambda: device.port, device.user, device.password)
        here.up.set()
        source = Source(here, "robot", f"{HERE}events/one", rate=RATE, window=1000)
        async with running(source):
            pinging = threading.Thread(target=self._ping)
            pinging.start()
            try:
                status = await self._tried(source)
            finally:
                self.over.set()
                await asyncio.to_thread(pinging.join)
        self._add_up(source, status)

    async def _tried(self, source: Source) -> dict[str, Any]:
        await until(lambda: len(self.fleet.published) > FIRST, "messages with a good broker")
        await self._misbehave()
        source.stopping = True
        self._be_good()
        return await self._drained(source)

    def _ping(self) -> None:
        """In a thread of its own: floods keep this process's event loop busy."""
        with RawClient(self.device.process, V5) as client:
            client.connect("canary", self.device.user)
            while not self.over.wait(0.01):
                began = time.monotonic()
                client.drain()
                took = time.monotonic() - began
                self.report.pings.append(took)
                if took > ANSWERED:
                    self.report.problems.append(f"a local ping took {took:.3f} s: {self.doing}")

    # What it does

    async def _misbehave(self) -> None:
        report, dice = self.report, self.random
        began = told = time.monotonic()
        ways = (self._misdeed, self._misdeed, self._garbled, self._limited, self._strange)
        while (now := time.monotonic()) - began < self.seconds:
            report.memory.append((now, self.device.memory()))
            self._be_good()
            self.doing = dice.choice(ways)()
            await asyncio.sleep(dice.uniform(0.5, 4.0))
            report.steps += 1
            report.problems += [f"{each}: {self.doing}" for each in self._faults()]
            if now - told > 60:
                told = now
                self.say(str(report))
        report.seconds = time.monotonic() - began

    def _be_good(self) -> None:
        """The next connection finds a good broker; those of now are reset."""
        fleet = self.fleet
        fleet.accept, fleet.greet = lambda visit: None, fleet.good_greeting
        fleet.grant, fleet.acknowledge = fleet.good_grant, accept
        fleet.pong = lambda visit: visit.send(Pingresp())
        fleet.handlers, fleet.limits, fleet.session_present = {}, {}, False
        fleet._misdeed = False  # type: ignore[attr-defined]
        self.report.connections += len(fleet.visits)
        for visit in fleet.visits:
            visit.fault = lambda text: None  # type: ignore[method-assign]  # by the limits of then
            visit.reset()
        fleet.visits.clear()
        fleet.faults.clear()
        self.doing = "it is good"

    def _faults(self) -> list[str]:
        """What the link did against its limits; in other cases it may have been misled."""
        return self.fleet.faults[:3] if self.doing.startswith("limits") else []

    def _misdeed(self) -> str:
        name = self.random.choice(self._allowed(SCENARIOS))
        SCENARIOS[name].prepare(self.fleet)
        return name

    def _garbled(self) -> str:
        """Some of what it says is not what it wanted to say; it acknowledges nothing."""
        dice = self.random
        share = dice.choice((0.02, 0.2, 1.0))

        def begin(visit: Visit) -> None:
            send = visit.send

            def garble(*packets: Packet | bytes) -> None:
                data = b"".join(
                    each if isinstance(each, bytes) else each.encode(visit.version)
                    for each in packets
                )
                send(garbled(data, dice) if dice.random() < share else data)

            visit.send = garble  # type: ignore[method-assign]
            visit.later(self._talk(visit))

        self.fleet.accept, self.fleet.acknowledge = begin, never
        return f"garbled, {share:.0%}"

    async def _talk(self, visit: Visit) -> None:
        dice = self.random
        await visit.ready.wait()
        while True:
            await asyncio.sleep(0.01)
            topics = ("cmd_vel", "mission/a", "x/_call", "y", "mission/" + "z/" * 50)
            properties: tuple[Properties | None, ...] = (
                None,
                {Property.RESPONSE_TOPIC: "a/b"},
                {Property.MESSAGE_EXPIRY_INTERVAL: 1},
                {Property.USER_PROPERTY: [("a", "b")] * 50},
            )
            visit.message(
                THERE + dice.choice(topics),
                dice.randbytes(dice.randrange(300)),
                dice.randrange(3),
                retain=dice.random() < 0.1,
                properties=dice.choice(properties),
            )

    def _limited(self) -> str:
        dice = self.random
        self.fleet.limits = {
            limit: dice.choice(LIMITS[limit])
            for limit in self._allowed(LIMITS)
            if dice.random() < 0.4
        }
        return f"limits {self.fleet.limits}"

    def _strange(self) -> str:
        dice = self.random
        ways = {
            "late acknowledgements": late(dice.uniform(0.0, 2.0)),
            "acknowledgements in reverse": reversed_in(dice.randrange(2, 90)),
            "quota exceeded": refuse(0x97),
            "a session that there is not": accept,
        }
        name = dice.choice(self._allowed(ways))
        self.fleet.acknowledge = ways[name]
        self.fleet.session_present = name.startswith("a session")
        return name

    def _allowed(self, ways: Iterable[W]) -> list[W]:
        """Those that may be chosen in this run."""
        return [each for each in ways if self.report.puts_off or not puts_off(each)]

    # What has come of it

    async def _drained(self, source: Source) -> dict[str, Any]:
        """The status when all has come, or nothing waits any more."""
        deadline = time.monotonic() + DRAINED
        while True:
            with contextlib.suppress(AssertionError):
                await until(lambda: not source.acknowledged - set(self._received()), "", ASKING)
            status = await asyncio.to_thread(self.device.status)
            assert status is not None
            if status["connected"] and not status["waiting"]:
                return status
            if time.monotonic() > deadline:
                self.report.problems.append(
                    f"after {DRAINED:g} s of a good broker {status['waiting']} messages wait:"
                    f" {status['problem']}"
                )
                return status

    def _received(self) -> list[int]:
        return [
            int(each.payload.split()[0]) for each in self.fleet.published if each.topic == EVENTS
        ]

    def _add_up(self, source: Source, status: dict[str, Any]) -> None:
        report = self.report
        numbers = self._received()
        report.connections += len(self.fleet.visits)
        report.acknowledged = len(source.acknowledged)
        report.received = len(numbers)
        # Upon which the broker has closed too often: kept elsewhere, and told.
        report.set_aside = status["set_aside"]
        if len(source.acknowledged - set(numbers)) > report.set_aside:
            report.problems += account.loss(EVENTS, source.acknowledged, numbers)
        if not report.puts_off:
            report.problems += account.order(EVENTS, numbers, report.connections)
        report.problems += account.inventions(EVENTS, source.sent, numbers)
        report.problems += account.growth(report.memory, GROWTH)
        if "Traceback" in self.device.log:
            report.problems.append(f"a fault: {self.device.log.partition('Traceback')[2][:2000]}")


def puts_off(way: str | Property) -> bool:
    """Whether it lets the link put a message off: it is too large for now, or is refused."""
    if isinstance(way, Property):
        return way is Property.MAXIMUM_PACKET_SIZE
    return way == "quota exceeded" or way.startswith("puback-code")


def garbled(data: bytes, dice: random.Random) -> bytes:
    """A byte is another one, missing or new, the end is missing, or something comes behind it."""
    place = dice.randrange(len(data) + 1)
    more = dice.randbytes(dice.randrange(1, 40))
    return dice.choice(
        (
            data[:place] + more[:1] + data[place + 1 :],
            data[:place] + data[place + 1 :],
            data[:place] + more[:8] + data[place:],
            data[:place],
            data + data,
            data + more,
            more,
        )
    )
