"""What all tries of the link begin and end with: a fleet's broker, a line to it, a device."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

from upstream.client import MqttClient
from upstream.device import Device
from upstream.kills import Fleet, make_device, make_fleet
from upstream.relay import Relay

Report = TypeVar("Report")


class Trial(Generic[Report]):
    """Builds all three, tries what its class is about, and ends them."""

    #: Of the line, in seconds one way.
    delay = 0.0

    def __init__(
        self,
        directory: Path,
        report: Report,
        *,
        device: str = "appliance",
        fleet: Fleet = "mosquitto",
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.directory = directory
        self.report = report
        self.kind, self.fleet_kind = device, fleet
        self.say = say
        self.device: Device

    def run(self) -> Report:
        fleet = make_fleet(self.fleet_kind, self.directory / "fleet")
        fleet.start()
        try:
            asyncio.run(self._run(fleet.plain_port))
        finally:
            if hasattr(self, "device"):
                self.device.kill()
            fleet.stop()
        return self.report

    async def _run(self, fleet: int) -> None:
        async with Relay(fleet) as relay:
            relay.set(delay=self.delay)
            self.device = self.make_device(relay.port)
            await asyncio.to_thread(self.device.start)
            await self.carry_out(relay, fleet)

    def make_device(self, remote: int) -> Device:
        """It connects to the port `remote`; it is not started."""
        return make_device(self.kind, self.directory / "device", remote, self.fleet_kind, 100)

    async def dial(self, name: str) -> MqttClient:
        """A local client of the device."""
        device = self.device
        return await MqttClient.dial(device.port, name, user=device.user, password=device.password)

    async def carry_out(self, relay: Relay, fleet: int) -> None:
        """What is tried; `fleet` is the port of the fleet's broker without the line."""
        raise NotImplementedError
