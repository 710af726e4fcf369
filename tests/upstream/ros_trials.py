"""Late commands and calls with the robot's side in ROS: rclpy in another process."""

from __future__ import annotations

import asyncio
import json
import os
import struct
import time
from pathlib import Path
from typing import Any

from appliance_process import ROBOT
from ros2_harness import TWIST, Peer
from ros_domain import DOMAIN
from waiting import until

from appliance.mqtt.packets import Publish
from upstream.account import Command
from upstream.calls import PATIENCE, Caller, Calls
from upstream.client import MqttClient
from upstream.device import IN, OUT, THERE, ApplianceDevice, Device
from upstream.late_commands import LATE, SLACK, LateCommands
from upstream.relay import Relay

#: `on_silence.after` of the route, and within what time the robot has to be told to stop.
AFTER = 0.3
STOPPED = 0.5

#: Calls of one caller that wait for an answer: the server of a ROS service queues ten in all.
WINDOW = 2

#: What the programs publish of the demo robot (tests/ros/robot.py), and a goal of two steps.
RESET, WALK = "turtle/reset", "turtle/walk"
GOAL = b'{"order": 2}'


class RosCommands(LateCommands):
    """Late commands with a subscription of rclpy, and a stop message when they stay away."""

    def __init__(self, directory: Path, *, version: str = "5", **common: Any) -> None:
        super().__init__(directory, **common)
        self._version = version
        #: When the robot was told to stop, while it moved: (the last command, the stop).
        self.stops: list[tuple[float, float]] = []

    def make_device(self, remote: int) -> Device:
        os.environ.setdefault("ROS_DOMAIN_ID", DOMAIN)
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        route = {
            "ros": "/cmd_vel",
            "to": "ros",
            "type": TWIST,
            "expire": f"{LATE} s",
            "on_silence": {"after": f"{AFTER} s"},
        }
        return ApplianceDevice(
            self.directory / "device",
            remote,
            link={
                "version": self._version,
                "in": [dict(rule) for rule in IN[:2]],
                "keep_alive": "60 s",
            },
            bridge={"topics": [route]},
        )

    async def carry_out(self, relay: Relay, fleet: int) -> None:
        peer = Peer()
        peer.received = self
        await peer.start("robot")
        try:
            await peer.do("subscribe", "/cmd_vel", TWIST)
            operator = await MqttClient.dial(fleet, "operator")
            await self._try(relay, operator)
            await until(lambda: self.stops and self.stops[-1][0] == self.report.came[-1].came)
            operator.abort()
        finally:
            await peer.stop()
        status = await asyncio.to_thread(self.device.status)
        assert status is not None
        dropped = status["dropped"].get(f"{THERE}cmd_vel", {})
        if not dropped.get("late"):  # the route would refuse some of them as well
            self.report.problems.append(f"the link has taken all that CAME: it dropped {dropped}")
        slow = [at - last for last, at in self.stops if at - last > STOPPED + SLACK]
        if slow:
            self.report.problems.append(
                f"{len(slow)} of {len(self.stops)} STOPS later than {STOPPED} s: {max(slow):.3f} s"
            )
        if len(self.stops) < self.rounds:
            self.report.problems.append(f"only {len(self.stops)} stops in {self.rounds} silences")
        self.say(
            f"{len(self.stops)} stops, the latest after"
            f" {max((at - last for last, at in self.stops), default=0.0) * 1000:.0f} ms"
        )

    def append(self, received: tuple[str, str]) -> None:
        """The node has received a message."""
        now = time.monotonic()
        came = self.report.came
        (number,) = struct.unpack_from("<d", bytes.fromhex(received[1]), 4)
        if number:
            came.append(Command(int(number), self._sent[int(number)], now))
        elif came and (not self.stops or self.stops[-1][0] < came[-1].came):
            self.stops.append((came[-1].came, now))

    def _payload(self, number: int) -> bytes:
        return b'{"linear": {"x": %d}}' % number


class RosCalls(Calls):
    """Calls of a ROS service, and goals of a ROS action, of the demo robot."""

    call_topic = f"{RESET}/_call"
    window = WINDOW

    def __init__(self, directory: Path, *, goals: int = 100, **common: Any) -> None:
        super().__init__(directory, **common)
        self.goals = goals
        self._results: dict[str, str] = {}

    def make_device(self, remote: int) -> Device:
        os.environ.setdefault("ROS_DOMAIN_ID", DOMAIN)
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        calls = [{"topic": f"{RESET}/_call"}, {"topic": f"{WALK}/_goal"}]
        return ApplianceDevice(
            self.directory / "device",
            remote,
            link={
                "out": [*map(dict, OUT), {"topic": f"{WALK}/_result/#", "keep": "all"}],
                "in": [IN[0], *calls],
                "keep_alive": "60 s",
            },
            bridge={
                "services": [{"ros": f"/{RESET}", "timeout": "60 s"}],
                "actions": [{"ros": f"/{WALK}", "timeout": "60 s"}],
            },
        )

    def is_answer(self, payload: bytes) -> bool:
        answer = json.loads(payload) if payload else {}
        return "message" in answer or "goal_id" in answer

    async def carry_out(self, relay: Relay, fleet: int) -> None:
        from robot_process import Robot

        robot = Robot()
        try:
            await asyncio.to_thread(robot.wait)
            await self._until_it_is_bridged()
            await super().carry_out(relay, fleet)
        finally:
            await asyncio.to_thread(robot.stop)

    async def serve(self) -> MqttClient | None:
        """The robot's services are in ROS."""
        return None

    async def _until_it_is_bridged(self) -> None:
        client = await self.dial("watcher")
        await client.subscribe(f"{ROBOT}/_appliance/routes")
        wanted = {f"/{RESET}", f"/{WALK}"}

        def bridged() -> bool:
            if not client.messages:
                return False
            routes = json.loads(client.messages[-1][1].payload)
            return wanted <= {each["ros"] for each in routes}

        await until(bridged, "the service and the action are bridged")
        client.abort()

    async def call_more(self, fleet: int) -> None:
        """Goals: each is accepted at its caller's own topic, and its result is published."""
        watcher = await MqttClient.dial(fleet, "watcher")
        await watcher.subscribe(f"{THERE}{WALK}/_result/+")
        watcher.on_message = self._took_result
        callers = [Caller(f"driver{number}", f"{WALK}/_goal", GOAL, 1) for number in range(5)]
        for caller in callers:
            await caller.connect(fleet)
        self.say(f"{self.goals} goals from {len(callers)} callers")
        await asyncio.gather(*(each.call(self.goals // len(callers)) for each in callers))
        await until(lambda: all(len(each.came) >= len(each.calls) for each in callers))
        accepted = {json.loads(payload)["goal_id"] for each in callers for payload in each.payloads}
        await until(lambda: accepted <= self._results.keys(), "the results", timeout=PATIENCE)
        failed = [each for each in accepted if self._results[each] != "succeeded"]
        if failed or len(accepted) != self.goals:
            self.report.problems.append(f"{len(accepted)} goals accepted, {len(failed)} failed")
        self.say(f"{len(accepted)} goals accepted and {len(accepted) - len(failed)} succeeded")
        self.callers += callers
        watcher.abort()

    def _took_result(self, message: Publish) -> None:
        goal = message.topic.rpartition("/")[2]
        if message.payload:
            self._results[goal] = json.loads(message.payload)["status"]
