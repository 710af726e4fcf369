"""vda-5050-lib's master control client at the fleet's broker: what it tells of a vehicle.

The library has validators that its authors have made of the standard's schemas of 2.0, and applies
them to whatever comes and goes here; it drops what says another version than 2.0.0.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
from collections.abc import AsyncIterator, Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pytest
from waiting import until

from appliance.mqtt.packets import Publish
from upstream.client import MqttClient
from upstream.device import ApplianceDevice
from upstream.peers import HOST, PASSWORD, USER, FleetMosquitto

DIRECTORY = Path(__file__).parent / "vda5050"
THERE = "uagv/v2/acme/r2d2/"
CONNECTION = f"{THERE}connection"
HERE = "r2d2/vda5050/"

ORDER = {
    "orderId": "7",
    "orderUpdateId": 0,
    "nodes": [{"nodeId": "door", "sequenceId": 0, "released": True, "actions": []}],
    "edges": [],
}


@pytest.fixture(scope="session")
def _installed() -> None:
    """vda-5050-lib as package-lock.json has it, from the registry."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("there is no node and npm: apt-get install nodejs npm")
    if not (DIRECTORY / "node_modules/.package-lock.json").exists():  # npm writes it last
        command = ["npm", "ci", "--silent", "--no-audit", "--no-fund", "--ignore-scripts"]
        subprocess.run(command, cwd=DIRECTORY, check=True, timeout=120)


class Master:
    """The client, and what it prints."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.lines: list[dict[str, Any]] = []
        self._process = process

    async def read(self) -> None:
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            self.lines.append(json.loads(line))

    def send(self, topic: str, message: dict[str, Any]) -> None:
        """Send the vehicle a message, to which the client adds the header."""
        assert self._process.stdin is not None
        said = {"topic": topic, "serialNumber": "r2d2", "object": message}
        self._process.stdin.write(json.dumps(said).encode() + b"\n")

    @property
    def states(self) -> list[str]:
        """The states of the vehicle's connection that it told, in their order."""
        return [each["state"] for each in self.lines if "state" in each]

    async def sees(self, *states: str) -> None:
        await until(lambda: self.states == [*states], f"{states}")

    @property
    def errors(self) -> list[str]:
        return [each["error"] for each in self.lines if "error" in each]


@pytest.fixture
async def master(_installed: None, fleet: FleetMosquitto) -> AsyncIterator[Master]:
    """A master control client that begins with no vehicle."""
    options = {
        "url": f"mqtt://{HOST}:{fleet.plain_port}",
        "username": USER,
        "password": PASSWORD,
    }
    process = await asyncio.create_subprocess_exec(
        "node",
        "master.js",
        json.dumps(options),
        cwd=DIRECTORY,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    master = Master(process)
    reading = asyncio.create_task(master.read())
    try:
        await until(lambda: {"ready": True} in master.lines, "the client is ready")
        yield master
    finally:
        process.kill()
        await process.wait()
        await reading
        forgetful = await MqttClient.dial(fleet.plain_port)
        for topic in ("connection", "factsheet"):
            await forgetful.publish(THERE + topic, b"", retain=True)
        await forgetful.close()


@pytest.fixture
def device(tmp_path: Path, fleet: FleetMosquitto) -> Iterator[ApplianceDevice]:
    """An appliance in a process of its own, with a link by the profile; not started."""
    link = {
        "profile": {"vda5050": {"manufacturer": "acme", "version": "2.0"}},
        "keep_alive": "60 s",  # a killed one's end is seen by its connection
        "out": [],
        "in": [],
    }
    device = ApplianceDevice(tmp_path, fleet.plain_port, link=link)
    yield device
    device.kill()


def header(number: int = 0) -> dict[str, Any]:
    """What each message begins with, section 6.4 of VDA 5050 2.0."""
    now = datetime.now(timezone.utc).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    vehicle = {"manufacturer": "acme", "serialNumber": "r2d2"}
    return {"headerId": number, "timestamp": now, "version": "2.0.0", **vehicle}


def state(order: str) -> bytes:
    """The message of the topic `state`, as the robot's own node makes it."""
    message = {
        **header(),
        "orderId": order,
        "orderUpdateId": 0,
        "lastNodeId": "door",
        "lastNodeSequenceId": 0,
        "nodeStates": [],
        "edgeStates": [],
        "actionStates": [],
        "driving": False,
        "batteryState": {"batteryCharge": 80.0, "charging": False},
        "operatingMode": "AUTOMATIC",
        "errors": [],
        "safetyState": {"eStop": "NONE", "fieldViolation": False},
    }
    return json.dumps(message).encode()


async def test_it_sees_a_vehicle_online_commands_it_and_sees_it_offline(
    fleet: FleetMosquitto, master: Master, device: ApplianceDevice
) -> None:
    there = await MqttClient.dial(fleet.plain_port)
    await there.subscribe(f"{THERE}+")

    def said(topic: str) -> list[Publish]:
        return [packet for _, packet in there.messages if packet.topic == THERE + topic]

    await asyncio.to_thread(device.start)
    await master.sees("ONLINE")
    node = await MqttClient.dial(device.port, user=device.user, password=device.password)
    await node.subscribe(f"{HERE}order")
    master.send("order", ORDER)
    (order,) = await node.wait_for(1, "order")
    assert json.loads(order.payload)["orderId"] == "7"
    await until(lambda: said("order"), "the order there")
    assert order.payload == said("order")[0].payload

    await node.publish(f"{HERE}factsheet", b"{}")
    standing = state("7")
    await node.publish(f"{HERE}state", standing)
    await until(lambda: any(each.get("order") == "7" for each in master.lines), "the state")
    await until(lambda: said("state"), "the state there")
    assert [(packet.payload, packet.qos) for packet in said("state")] == [(standing, 0)]
    await until(lambda: said("factsheet"), "the factsheet")
    later = await MqttClient.dial(fleet.plain_port)
    await later.subscribe(f"{THERE}+")
    found = {packet.topic: packet for packet in await later.wait_for(2, "retained messages")}
    assert found[f"{THERE}factsheet"].payload == b"{}"
    assert json.loads(found[CONNECTION].payload)["connectionState"] == "ONLINE"

    await asyncio.to_thread(device.stop)
    await master.sees("ONLINE", "OFFLINE")
    await until(lambda: len(said("connection")) == 2, "both states of the connection")
    assert [packet.qos for packet in said("connection")] == [1, 1]
    assert {json.loads(packet.payload)["version"] for packet in said("connection")} == {"2.0.0"}
    assert not master.errors
    for client in (there, later, node):
        client.abort()


async def test_it_sees_the_connection_of_a_killed_vehicle_broken(
    master: Master, device: ApplianceDevice
) -> None:
    await asyncio.to_thread(device.start)
    await master.sees("ONLINE")
    device.kill()
    await master.sees("ONLINE", "CONNECTIONBROKEN")
    assert not master.errors


async def test_it_tells_of_what_is_not_valid(fleet: FleetMosquitto, master: Master) -> None:
    """So that no error in the tests above says something."""
    robot = await MqttClient.dial(fleet.plain_port, "r2d2")
    message = {**header(), "connectionState": "ASLEEP"}
    await robot.publish(CONNECTION, json.dumps(message).encode(), retain=True)
    await until(lambda: master.errors, "the connection is not valid")
    await robot.publish(f"{THERE}state", state("7").replace(b"AUTOMATIC", b"ASLEEP"))
    await until(lambda: len(master.errors) == 2, "the state is not valid")
    robot.abort()
