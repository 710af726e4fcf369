"""The appliance with a link, in this process, and a local client of it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
import uvloop
import yaml
from harness import Peer
from waiting import until

from appliance import config
from appliance.app import main as app_module
from appliance.app.main import App
from appliance.mqtt.packets import Connack, Connect
from appliance.upstream import backoff
from appliance.upstream.status import LinkStatus
from appliance.upstream.uplink import Uplink

ACL = "topic readwrite #\ntopic read $SYS/#\nuser upstream\ntopic readwrite {robot}/#\n"


@pytest.fixture(scope="session")
def event_loop_policy() -> asyncio.AbstractEventLoopPolicy:
    """The event loop that the appliance runs on."""
    return uvloop.EventLoopPolicy()


class Rig:
    """An appliance whose link dials `port`; `links` take the place of that link."""

    def __init__(
        self, directory: Path, port: int, *, links: Sequence[Any] = (), **link: Any
    ) -> None:
        self.directory = directory
        directory.mkdir(exist_ok=True, parents=True)
        (directory / "acl.conf").write_text(ACL)
        (directory / "users.passwd").touch(0o600)
        section: dict[str, Any] = {
            "name": "fleet",
            "servers": [f"mqtt://127.0.0.1:{port}"],
            "out": [{"topic": "events/#"}, {"topic": "state/#", "keep": "latest"}],
            "in": [{"topic": "cmd/#", "late": "10 s"}],
        }
        section.update(link)
        settings = {
            "robot": "r2d2",
            "reload_on_change": False,
            "broker": {"listeners": [{"bind": "127.0.0.1:0"}], "anonymous": True},
            "bridge": {"bus": "none"},
            "upstreams": list(links) or [section],
        }
        self.file = directory / "appliance.yaml"
        self.file.write_text(yaml.safe_dump(settings))
        self.app: App

    async def start(self) -> None:
        """Start the appliance, with what an earlier one has left in the directory."""
        self.app = App(config.load(self.file))
        await self.app.start()

    @property
    def uplink(self) -> Uplink:
        return self.app.upstreams[0]

    def status(self) -> LinkStatus:
        return self.uplink.status()

    async def connected(self) -> None:
        await until(lambda: self.status().connected, "the link to be connected")

    async def drained(self) -> None:
        await until(lambda: not self.status().waiting, "nothing to wait for the fleet")

    async def client(self, name: str = "client", **options: Any) -> Peer:
        """A local client that has logged in."""
        host, port = self.app.addresses[0]
        peer = Peer(*await asyncio.open_connection(host, port))
        await peer.send(Connect(name, **options))
        assert isinstance(await peer.receive(), Connack)
        return peer


@asynccontextmanager
async def running(rig: Rig) -> AsyncIterator[Rig]:
    """The appliance, while it runs."""
    await rig.start()
    try:
        yield rig
    finally:
        await rig.app.stop()


def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dial again soon."""
    monkeypatch.setattr(backoff, "SHORTEST", 0.05)
    monkeypatch.setattr(backoff, "LONGEST", 0.1)
    monkeypatch.setattr(backoff, "CONTESTED", 0.1)
    monkeypatch.setattr(app_module, "TICK", 0.1)
