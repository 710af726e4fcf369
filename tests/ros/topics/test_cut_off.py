"""Clients are cut off while they drive: a real appliance, ROS and TLS, in a process each."""

from __future__ import annotations

import asyncio
import os
import struct
import sys
import time
from pathlib import Path

import pytest
import yaml
from waiting import until

from appliance.host.environment import for_other_programs

pytest.importorskip("rclpy")
from appliance_process import ROBOT, ApplianceProcess
from ros2_harness import TWIST, Peer
from upstream.relay import Relay

pytestmark = [pytest.mark.timed, pytest.mark.usefixtures("isolated_domain")]

AFTER = 0.3

#: What the stop message may take beyond it, and what a busy computer may add to that.
TOLERANCE = 0.05
PATIENCE = float(os.environ.get("CUT_OFF_PATIENCE", "0.25"))


class Times(list):
    """A list that knows when each item came."""

    def __init__(self):
        super().__init__()
        self.at = []

    def append(self, item):
        self.at.append(time.monotonic())
        super().append(item)


EXPIRE = 0.5


def number(received):
    """The command's number; 0 for the stop message."""
    return struct.unpack_from("<d", bytes.fromhex(received[1]), 4)[0]


def made_at(received):
    """When the command was made."""
    return struct.unpack_from("<2d", bytes.fromhex(received[1]), 4)[1]


class Robot:
    """The appliance, and a node on ROS that subscribes to /cmd_vel."""

    def __init__(self, directory):
        self.appliance = ApplianceProcess(directory, acl=f"user alice\ntopic {ROBOT}/#\n")
        config = self.appliance.config
        settings = yaml.safe_load(config.read_text())
        route = {
            "ros": "/cmd_vel",
            "to": "ros",
            "type": TWIST,
            "exclusive": True,
            "expire": f"{EXPIRE * 1000:.0f} ms",
            "on_silence": {"after": f"{AFTER * 1000:.0f} ms"},
        }
        settings["bridge"] = {"topics": [route]}
        config.write_text(yaml.safe_dump(settings))
        self.peer = Peer()
        self.peer.received = Times()

    async def start(self):
        self.appliance.start()
        await self.peer.start("robot")
        await self.peer.do("subscribe", "/cmd_vel", TWIST)
        await until(lambda: self.numbers() == [0], "the stop message of the start")

    async def stop(self):
        await self.peer.stop()
        self.appliance.stop()

    def numbers(self):
        return [number(received) for received in self.peer.received]

    async def stopped_after(self, moment):
        """Seconds from the last command, or that moment if it is later, to the stop message."""
        await until(lambda: self.numbers()[-1] == 0, "the stop message")
        at = self.peer.received.at
        await asyncio.sleep(0.2)
        assert self.numbers()[-1] == 0
        last = max(i for i, value in enumerate(self.numbers()) if value)
        return at[last + 1] - max(at[last], moment)


@pytest.fixture
async def robot(tmp_path):
    robot = Robot(tmp_path)
    try:
        await robot.start()
        yield robot
    finally:
        await robot.stop()


class Driver:
    """driver.py"""

    def __init__(self, robot, port, version, qos):
        appliance = robot.appliance
        password = appliance.passwords["alice"]
        self.arguments = [str(port), str(appliance.ca), "alice", password, version, qos]

    async def start(self):
        self.process = await asyncio.create_subprocess_exec(
            sys.executable,
            str(Path(__file__).parents[1] / "driver.py"),
            *self.arguments,
            env=for_other_programs(),
        )

    async def kill(self):
        if self.process.returncode is None:
            self.process.kill()
        await self.process.wait()


@pytest.mark.parametrize(("version", "qos"), [("5", "0"), ("3.1.1", "1")])
async def test_a_client_whose_network_is_gone_for_a_while_and_that_is_killed_then(
    robot, version, qos
):
    async with Relay(robot.appliance.port) as network:
        driver = Driver(robot, network.port, version, qos)
        await driver.start()
        try:
            await until(lambda: len(robot.numbers()) > 10, "commands")
            network.silence()
            cut = time.monotonic()
            last = max(robot.numbers())
            took = await robot.stopped_after(cut - 1)
            print(f"{version}: the stop message came {took * 1000:.0f} ms after the last command")
            assert AFTER - 0.1 < took < AFTER + TOLERANCE + PATIENCE
            await asyncio.sleep(1)
            network.release()
            # The network's computer has answered all the time: the connection is the same.
            flowing = time.monotonic()
            await until(
                lambda: made_at(robot.peer.received[-1]) > flowing, "commands that were made since"
            )
            await asyncio.sleep(0.3)
        finally:
            killed = time.monotonic()
            await driver.kill()
        moved = [n for n in robot.numbers() if n]
        assert max(moved) > last + 20, "the driver has sent nothing while it was cut off"
        ages = [
            at - made_at(command)
            for command, at in zip(robot.peer.received, robot.peer.received.at, strict=True)
            if number(command)
        ]
        print(f"{version}: the oldest command that moved it was {max(ages) * 1000:.0f} ms old")
        assert max(ages) < EXPIRE + PATIENCE
        assert moved == sorted(set(moved))
        took = await robot.stopped_after(killed)
        print(f"{version}: the stop message came {took * 1000:.0f} ms after the kill")
        assert took < AFTER + TOLERANCE + PATIENCE
