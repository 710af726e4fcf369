"""Calls from the fleet to the robot and back: each is answered at its caller's own topic."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from waiting import until

from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Publish
from upstream import account
from upstream.client import MqttClient
from upstream.device import HERE, THERE
from upstream.peers import HOST, PASSWORD, USER
from upstream.relay import Relay
from upstream.trial import Trial

#: Calls of one caller that wait for their answers.
WINDOW = 50

ANSWER = b'{"ok": true}'

#: Seconds for all answers, behind the last call.
PATIENCE = 60.0

#: Seconds until the link has to be up.
CONNECTING = 60.0


@dataclass
class Report:
    """How a run went; `times` are round trips in seconds."""

    calls: int = 0
    answers: int = 0
    times: list[float] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        times = sorted(self.times) or [0.0]
        middle, late = times[len(times) // 2], times[len(times) * 99 // 100]
        return (
            f"{self.calls} calls, {self.answers} answers; round trip {middle * 1000:.1f} ms,"
            f" 99 % {late * 1000:.1f} ms; {len(self.problems)} problems"
        )


class Caller:
    """An operator with a topic for answers of its own."""

    def __init__(
        self, name: str, target: str = "reset/_call", payload: bytes = b"{}", window: int = WINDOW
    ) -> None:
        self.target, self.payload, self.window = target, payload, window
        self.payloads: list[bytes] = []
        self.topic = f"answers/{name}"
        self.name = name
        self.client: MqttClient
        self.calls: dict[str, float] = {}
        self.came: list[tuple[str, str]] = []
        self.times: list[float] = []

    async def connect(self, port: int) -> None:
        self.client = await MqttClient.dial(port, f"caller-{self.name}")
        await self.client.subscribe(self.topic)
        self.client.on_message = self._took

    def _took(self, message: Publish) -> None:
        data = (message.properties or {}).get(Property.CORRELATION_DATA, b"?")
        correlation = data.decode() if isinstance(data, bytes) else "?"
        self.came.append((message.topic, correlation))
        self.payloads.append(message.payload)
        if correlation in self.calls:
            self.times.append(time.monotonic() - self.calls[correlation])

    async def call(self, count: int) -> None:
        for number in range(count):
            deadline = time.monotonic() + PATIENCE
            while len(self.calls) - len(self.came) >= self.window:
                if time.monotonic() > deadline:
                    return  # what is missing is told in the end
                await asyncio.sleep(0.001)
            correlation = f"{self.name}-{number}"
            self.calls[correlation] = time.monotonic()
            properties = {
                Property.RESPONSE_TOPIC: self.topic,
                Property.CORRELATION_DATA: correlation.encode(),
            }
            topic = f"{THERE}{self.target}"
            self.client.publish(topic, self.payload, 1, properties=properties)


class Calls(Trial[Report]):
    """`callers` of our own with `count` calls in all, and `others` of mosquitto_rr."""

    delay = 0.005
    call_topic = "reset/_call"
    window = WINDOW

    def __init__(
        self,
        directory: Path,
        *,
        count: int = 10_000,
        callers: int = 5,
        others: int = 100,
        **common: Any,
    ) -> None:
        super().__init__(directory, Report(), **common)
        self.count = count
        self.callers = [
            Caller(f"operator{number}", self.call_topic, window=self.window)
            for number in range(callers)
        ]
        self.others = others

    async def carry_out(self, relay: Relay, fleet: int) -> None:
        robot = await self.serve()
        for caller in self.callers:
            await caller.connect(fleet)
        await self._wait_for_the_link(fleet)
        share = self.count // len(self.callers)
        self.say(f"{share} calls each from {len(self.callers)} callers")
        await asyncio.gather(*(caller.call(share) for caller in self.callers))
        with contextlib.suppress(AssertionError):  # what does not come is told in the end
            await until(self._complete, timeout=PATIENCE)
        await asyncio.sleep(0.5)  # more than was asked for
        await asyncio.to_thread(self._call_with_mosquitto, fleet)
        await self.call_more(fleet)
        for caller in self.callers:
            caller.client.abort()
        if robot is not None:
            robot.abort()
        self._add_up()

    async def serve(self) -> MqttClient | None:
        """Who answers the calls: a client of the robot's broker."""
        robot = await self.dial("service")
        await robot.subscribe(f"{HERE}+/_call")
        robot.on_message = lambda message: self._serve(robot, message)
        return robot

    async def call_more(self, fleet: int) -> None:
        """Other calls than these."""

    def is_answer(self, payload: bytes) -> bool:
        """Whether it is what a call is answered."""
        return payload == ANSWER

    def _complete(self) -> bool:
        return all(len(each.came) >= len(each.calls) for each in self.callers)

    @staticmethod
    def _serve(robot: MqttClient, message: Publish) -> None:
        """What a service of the robot does."""
        properties = message.properties or {}
        topic = properties.get(Property.RESPONSE_TOPIC)
        if isinstance(topic, str):
            correlation = properties.get(Property.CORRELATION_DATA)
            more = {} if correlation is None else {Property.CORRELATION_DATA: correlation}
            robot.publish(topic, ANSWER, 1, properties=more)

    async def _wait_for_the_link(self, port: int) -> None:
        robot = await self.dial("probe")
        await robot.subscribe(f"{HERE}cmd_vel")
        operator = await MqttClient.dial(port, "probe")
        deadline = time.monotonic() + CONNECTING
        while not robot.messages:
            assert time.monotonic() < deadline, f"the link is not up:\n{self.device.log[-2000:]}"
            await operator.publish(f"{THERE}cmd_vel", b"{}")
            await asyncio.sleep(0.1)
        robot.abort()
        operator.abort()

    def _call_with_mosquitto(self, port: int) -> None:
        program = shutil.which("mosquitto_rr")
        if program is None or not self.others:
            self.say("without mosquitto_rr: apt-get install mosquitto-clients")
            return
        self.say(f"{self.others} calls with mosquitto_rr")
        where = ["-h", HOST, "-p", str(port), "-u", USER, "-P", PASSWORD]
        what = ["-V", "5", "-t", f"{THERE}{self.call_topic}", "-m", "{}", "-W", "10"]
        for number in range(self.others):
            done = subprocess.run(
                [program, *where, *what, "-e", f"answers/rr/{number}"],
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
            )
            self.report.calls += 1
            if done.returncode or not self.is_answer(done.stdout.strip().encode()):
                self.report.problems.append(
                    f"mosquitto_rr {number}: {done.returncode} {done.stdout}{done.stderr}"
                )
                if len(self.report.problems) > 3:
                    return
            else:
                self.report.answers += 1

    def _add_up(self) -> None:
        report = self.report
        for caller in self.callers:
            report.calls += len(caller.calls)
            report.answers += len(caller.came)
            report.times += caller.times
            calls = dict.fromkeys(caller.calls, caller.topic)
            report.problems += account.answers(calls, caller.came, {caller.topic})
            wrong = [each for each in caller.payloads if not self.is_answer(each)]
            if wrong:
                report.problems.append(f"{len(wrong)} calls are answered {wrong[0][:100]!r}")
