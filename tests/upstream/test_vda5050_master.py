"""vda-5050-lib's master control client at the fleet's broker: what it tells of a vehicle."""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
from collections.abc import AsyncIterator, Callable
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pytest
from waiting import until

from appliance.mqtt.packets import Will
from upstream.client import MqttClient
from upstream.peers import HOST, PASSWORD, USER, FleetMosquitto

DIRECTORY = Path(__file__).parent / "vda5050"
CONNECTION = "uagv/v2/acme/r2d2/connection"


@pytest.fixture(scope="session")
def _installed() -> None:
    """vda-5050-lib as package-lock.json has it, from the registry."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("there is no node and npm: apt-get install nodejs npm")
    if not (DIRECTORY / "node_modules/.package-lock.json").exists():  # npm writes it last
        command = ["npm", "ci", "--silent", "--no-audit", "--no-fund", "--ignore-scripts"]
        subprocess.run(command, cwd=DIRECTORY, check=True, timeout=120)


@pytest.fixture
async def told(_installed: None, fleet: FleetMosquitto) -> AsyncIterator[list[dict[str, Any]]]:
    """What a master control client prints."""
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
    lines: list[dict[str, Any]] = []

    async def read() -> None:
        assert process.stdout is not None
        async for line in process.stdout:
            lines.append(json.loads(line))

    reading = asyncio.create_task(read())
    try:
        await until(lambda: {"ready": True} in lines, "the client is ready")
        yield lines
    finally:
        process.kill()
        await process.wait()
        await reading


def connection(state: str, number: int) -> bytes:
    """The message of the topic `connection`, section 6.13 of VDA 5050 2.0."""
    now = datetime.now(timezone.utc).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    header = {"headerId": number, "timestamp": now, "version": "2.0.0"}
    vehicle = {"manufacturer": "acme", "serialNumber": "r2d2"}
    return json.dumps({**header, **vehicle, "connectionState": state}).encode()


async def test_it_sees_online_offline_and_a_broken_connection(
    fleet: FleetMosquitto, told: list[dict[str, Any]]
) -> None:
    will = Will(CONNECTION, connection("CONNECTIONBROKEN", 0), 1, True)
    robot = await MqttClient.dial(fleet.plain_port, "r2d2", will=will)

    def seen(state: str) -> Callable[[], bool]:
        return lambda: any(each.get("state") == state for each in told)

    await robot.publish(CONNECTION, connection("ONLINE", 1), retain=True)
    await until(seen("ONLINE"))
    await robot.publish(CONNECTION, connection("OFFLINE", 2), retain=True)
    await until(seen("OFFLINE"))
    await robot.publish(CONNECTION, connection("ONLINE", 3), retain=True)
    robot.abort()  # without DISCONNECT: the will
    await until(seen("CONNECTIONBROKEN"))
    robot = await MqttClient.dial(fleet.plain_port, "r2d2")
    before = len(told)
    await robot.publish(CONNECTION, connection("ASLEEP", 4), retain=True)
    await until(lambda: any("error" in each for each in told[before:]), "it is not valid")
    await robot.publish(CONNECTION, b"", retain=True)
    robot.abort()
