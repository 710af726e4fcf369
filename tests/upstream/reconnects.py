"""Many links at once: their broker is killed and started, and all are online within a minute.

They are in one appliance, which is as good as many: what is tried is what the links do to a broker
that has just started, all at once.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from appliance_process import ApplianceProcess
from waiting import eventually, until

from upstream.client import MqttClient
from upstream.device import ACL, LIMITS, LINK_USER, links
from upstream.kills import Fleet, make_fleet
from upstream.peers import HOST, PASSWORD, USER, RabbitMQ
from upstream.streams import version_of

#: Seconds from the broker's start until the last link is online.
LIMIT = 60.0

#: Seconds for what has no limit of its own.
PATIENCE = 120.0

#: Seconds between two looks at how many are online.
LOOK = 0.5


@dataclass
class Report:
    """How a run went; `took` are seconds from each start of the broker to the last link online."""

    links: int
    took: list[float] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        times = ", ".join(f"{each:.1f} s" for each in self.took)
        return f"{self.links} links, all online after {times}; {len(self.problems)} problems"


class Reconnects:
    """`links` links to one broker, which is killed and started `rounds` times."""

    def __init__(
        self,
        directory: Path,
        *,
        links: int = 200,
        rounds: int = 3,
        fleet: Fleet = "rabbitmq",
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.report = Report(links)
        self.rounds = rounds
        self.say = say
        self.fleet = make_fleet(fleet, directory / "fleet")
        self.process = ApplianceProcess(directory / "robot", acl=ACL, broker={"limits": LIMITS})
        secret = directory / "fleet.password"
        secret.touch(0o600)
        secret.write_text(PASSWORD)
        self._secret = secret

    def run(self) -> Report:
        """Everything has ended when this returns."""
        self.fleet.start()
        try:
            self._write_links()
            self.process.start()
            eventually(self.process.is_answering, "it listens on its control socket, too")
            asyncio.run(self._run())
        finally:
            self.process.stop()
            self.fleet.kill()
        return self.report

    def _write_links(self) -> None:
        settings = yaml.safe_load(self.process.config.read_text())
        common: dict[str, Any] = {
            "servers": [f"mqtt://{HOST}:{self.fleet.plain_port}"],
            "user": LINK_USER,
            "login": {"username": USER, "password_file": str(self._secret)},
            "out": [{"topic": "events/#"}],
            "in": [{"topic": "cmd_vel"}],
            "kind": "rabbitmq" if isinstance(self.fleet, RabbitMQ) else "generic",
        }
        settings["upstreams"] = [
            common | {"name": name, "client_id": name, "prefix": f"fleet/{name}/"}
            for name in (f"robot-{number}" for number in range(self.report.links))
        ]
        self.process.config.write_text(yaml.safe_dump(settings))

    async def _run(self) -> None:
        await self._until_online("at first", 0.0, time.monotonic())
        for number in range(1, self.rounds + 1):
            killed_at = time.monotonic()
            await asyncio.to_thread(self.fleet.kill)
            await asyncio.to_thread(self.fleet.start)
            await self._until_online(f"round {number}", killed_at, time.monotonic())
        await self._carry()

    def _online(self) -> list[float]:
        """When each link that is online has connected, by `time.monotonic`.

        It is online when all that it has sent is acknowledged: its state as well.
        """
        found = links(self.process.config)
        now = time.monotonic()
        online = [each for each in found if each["connected"] and not each["inflight"]]
        return [now - each["since"] for each in online]

    async def _until_online(self, what: str, killed_at: float, started_at: float) -> None:
        online: list[float] = []
        while len(online) < self.report.links and time.monotonic() < started_at + PATIENCE:
            # Those that have not noticed yet are not counted.
            online = [each for each in await asyncio.to_thread(self._online) if each > killed_at]
            await asyncio.sleep(LOOK)
        took = max(0.0, max(online, default=started_at + PATIENCE) - started_at)
        text = f"{what}: {len(online)} links are online, the last {took:.1f} s after the start"
        self.say(text)
        self.report.took.append(took)
        if took > LIMIT or len(online) < self.report.links:
            self.report.problems.append(text)

    async def _carry(self) -> None:
        """Each link carries a message."""
        there = await MqttClient.dial(
            self.fleet.plain_port, "watch", version=version_of(self.fleet)
        )
        await there.subscribe("fleet/+/events/#")
        user, password = "alice", self.process.passwords["alice"]
        here = await MqttClient.dial(self.process.plain_port, "node", user=user, password=password)
        await here.publish("r2d2/events/door", b"open")
        wanted = {f"fleet/robot-{number}/events/door" for number in range(self.report.links)}

        def missing() -> set[str]:
            return wanted - {packet.topic for _, packet in there.messages}

        try:
            await until(lambda: not missing(), "a message of each link", PATIENCE)
        except AssertionError:
            self.report.problems.append(f"{len(missing())} links carry nothing")
        for client in (there, here):
            client.abort()
