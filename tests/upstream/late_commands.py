"""Commands from the fleet over a line that is silent for a while: none that is old arrives."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from appliance.mqtt.packets import Publish
from upstream import account
from upstream.account import Command
from upstream.client import MqttClient
from upstream.device import HERE, THERE
from upstream.relay import Relay
from upstream.streams import Side, Sink, running
from upstream.trial import Trial

#: Of Twist, a second.
RATE = 20

#: Of the device's rule for cmd_vel, in seconds (device.IN).
LATE = 0.5

#: Seconds from the link to the robot's client, and of two processes that tell the time apart.
SLACK = 0.25

#: Sent while the line is away.
OFFLINE = 1000

#: Seconds of a good line before each silence.
STEADY = 3.0

#: Seconds until both ends know that the line is away, or back.
SETTLING = 2.0

#: Seconds for a link to come back.
RETURN = 120.0


@dataclass
class Report:
    """How a run went."""

    sent: int = 0
    came: list[Command] = field(default_factory=list)
    #: Of the longest time without a command while they were sent over a good line.
    gap: float = 0.0
    problems: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        oldest = max((each.came - each.sent for each in self.came), default=0.0)
        return (
            f"{self.sent} commands sent, {len(self.came)} came, the oldest after"
            f" {oldest * 1000:.0f} ms; {len(self.problems)} problems"
        )


class LateCommands(Trial[Report]):
    """Twists at 20 Hz with QoS 0 and 1, silences of the line, and 1,000 commands while it is away.

    The robot's client stands for ROS: what it gets, a route to ROS gets.
    """

    delay = 0.02

    def __init__(
        self, directory: Path, *, silence: float = 10.0, rounds: int = 3, **common: Any
    ) -> None:
        super().__init__(directory, Report(), **common)
        self.silence = silence
        self.rounds = rounds
        self._sent: dict[int, float] = {}
        #: From when to when nothing was sent that may come.
        self._silences: list[tuple[float, float]] = []

    async def carry_out(self, relay: Relay, fleet: int) -> None:
        device = self.device
        here = Side(lambda: device.port, device.user, device.password)
        robot = Sink(here, "robot", f"{HERE}cmd_vel")
        robot.took = self._took  # type: ignore[method-assign]
        here.up.set()
        async with running(robot):
            await asyncio.wait_for(robot.subscribed.wait(), 60)
            operator = await MqttClient.dial(fleet, "operator")
            await self._try(relay, operator)
            operator.abort()

    def _took(self, message: Publish) -> None:
        number = int(message.payload.split(b" ", 1)[0])
        self.report.came.append(Command(number, self._sent[number], time.monotonic()))

    def _send(self, operator: MqttClient) -> None:
        self.report.sent += 1
        number = self.report.sent
        self._sent[number] = time.monotonic()
        operator.publish(f"{THERE}cmd_vel", self._payload(number), number % 2)

    def _payload(self, number: int) -> bytes:
        return b"%d {}" % number

    async def _drive(self, operator: MqttClient, seconds: float) -> None:
        for _ in range(int(seconds * RATE)):
            self._send(operator)
            await asyncio.sleep(1 / RATE)

    async def _drive_until_it_comes(self, operator: MqttClient, what: str) -> None:
        there = len(self.report.came)
        deadline = time.monotonic() + RETURN
        while len(self.report.came) == there:
            if time.monotonic() > deadline:
                raise AssertionError(f"{what}: nothing comes within {RETURN:g} s")
            await self._drive(operator, 0.5)

    async def _try(self, relay: Relay, operator: MqttClient) -> None:
        await self._drive_until_it_comes(operator, "at the start")
        for number in range(self.rounds):
            await self._drive(operator, STEADY)
            way = ("down", None, "up")[number % 3]
            self.say(f"silent ({way or 'both ways'}) for {self.silence:g} s")
            relay.silence(way)  # type: ignore[arg-type]
            began = time.monotonic()
            await self._drive(operator, self.silence)
            if way != "up":  # what was sent comes behind it, and is at least so old
                self._silences.append((began, time.monotonic() - LATE))
            relay.release()
            await self._drive(operator, 1)
            await self._drive_until_it_comes(operator, "after the silence")
        self.say(f"{OFFLINE} commands while the line is away")
        await self._drive(operator, 1)
        await asyncio.sleep(SETTLING)
        await relay.refuse()
        await asyncio.sleep(SETTLING)  # the fleet's broker knows it by then
        first = self.report.sent + 1
        for _ in range(OFFLINE):
            self._send(operator)
        last = self.report.sent
        await operator.ping()
        await relay.start()
        await self._drive_until_it_comes(operator, "after the outage")
        await asyncio.sleep(SETTLING)
        report = self.report
        report.problems += account.lateness(report.came, LATE, SLACK)
        offline = [each.number for each in report.came if first <= each.number <= last]
        if offline:
            text = f"{len(offline)} of {OFFLINE} sent while the link was away CAME:"
            report.problems.append(f"{text} {account.spans(offline)}")
        silent = [
            each.number
            for each in report.came
            if any(begin < each.sent < end for begin, end in self._silences)
        ]
        if silent:
            report.problems.append(f"sent in a silence, and CAME: {account.spans(silent)}")
        if len(report.came) < report.sent / 10:
            report.problems.append(f"only {len(report.came)} of {report.sent} came at all")
