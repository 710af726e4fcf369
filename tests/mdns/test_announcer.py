"""The announcing program's decisions: names, rivals and links, without a network."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from ipaddress import ip_interface
from typing import Any, ClassVar

import pytest
from waiting import until

from appliance.host.interfaces import Interface, Link
from appliance.mdns import announcer
from appliance.mdns.announcement import SECURE_MQTT, Announcement, Service
from appliance.mdns.announcer import NAMES, PATIENCE, Announcer, LinkAnnouncer

WANTED = Announcement("r2d2", "", "appliance-5", (Service(SECURE_MQTT, 8883, ("",)),))
LINK = Link((Interface("eth0", 2, (ip_interface("192.0.2.1/24"),)),))
OTHER = Link((Interface("eth0", 2, (ip_interface("192.0.2.9/24"),)),))


class FakeLink:
    """A link on which `rivals` says who has a name."""

    rivals: ClassVar[Callable[[str], str]] = staticmethod(lambda name: "")
    made: ClassVar[list[FakeLink]] = []

    def __init__(self, wanted: Announcement, link: Link) -> None:
        self.link = link
        self.probed: list[str] = []
        self.announced = self.closed = ""
        self.repeated = 0
        self.made.append(self)

    async def start(self) -> None: ...

    def probe(self, name: str) -> None:
        self.probed.append(name)

    def rival(self, name: str) -> str:
        return type(self).rivals(name)

    async def announce(self, name: str) -> None:
        self.announced = name

    def repeat(self, name: str) -> None:
        self.repeated += 1

    async def close(self, name: str) -> None:
        self.closed = name


class Run:
    """An announcer that runs, and what it has told."""

    def __init__(self) -> None:
        self.lines = asyncio.StreamReader()
        self.told: list[dict[str, Any]] = []
        self.links = [LINK]
        self.task = asyncio.create_task(Announcer(self.lines, self.told.append).run())
        self.lines.feed_data(WANTED.to_line())

    @property
    def name(self) -> str:
        return self.told[-1]["name"] if self.told else ""

    async def end(self) -> None:
        self.lines.feed_eof()
        await asyncio.wait_for(self.task, 10)


@pytest.fixture
async def run(monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.setattr(announcer, "LinkAnnouncer", FakeLink)
    monkeypatch.setattr(announcer, "PROBE_INTERVAL", 0.0)
    monkeypatch.setattr(announcer, "POLL", 0.005)
    monkeypatch.setattr(FakeLink, "rivals", staticmethod(lambda name: ""))
    monkeypatch.setattr(FakeLink, "made", [])
    run = Run()
    monkeypatch.setattr(announcer, "_links", lambda wanted: run.links)
    return run


async def test_a_free_name(run: Run) -> None:
    await until(lambda: run.name)
    assert run.told == [{"name": "r2d2", "links": ["eth0: 192.0.2.1"], "problem": ""}]
    (link,) = FakeLink.made
    assert link.probed == ["r2d2"] * 3 and link.announced == "r2d2"
    await run.end()
    assert link.closed == "r2d2" and len(run.told) == 1


async def test_a_name_that_another_has(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    taken = {"r2d2": "a", "r2d2 (2)": "b"}
    monkeypatch.setattr(FakeLink, "rivals", staticmethod(lambda name: taken.get(name, "")))
    await until(lambda: run.name)
    assert run.name == "r2d2 (3)"
    await run.end()


async def test_somebody_claims_every_name(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """It goes on under a name of its own, and says so."""
    monkeypatch.setattr(FakeLink, "rivals", staticmethod(lambda name: "zombie"))
    await until(lambda: run.name)
    assert run.name == "r2d2 appliance-5" and "claims every name" in run.told[-1]["problem"]
    (link,) = FakeLink.made
    assert len(link.probed) == NAMES and link.announced == "r2d2 appliance-5"
    await until(lambda: link.repeated > 2 * PATIENCE)
    assert len(FakeLink.made) == 1  # the name is kept, whoever claims it
    await run.end()


@pytest.mark.parametrize("rival", ["appliance-9-0.local.", "appliance-1-0.local."])
async def test_a_rival_comes_later(run: Run, monkeypatch: pytest.MonkeyPatch, rival: str) -> None:
    """As when two networks become one. The one whose host name is greater keeps the name; and who
    should give way and does not gets it in the end."""
    await until(lambda: run.name)
    taken = {"r2d2": rival}
    monkeypatch.setattr(FakeLink, "rivals", staticmethod(lambda name: taken.get(name, "")))
    await until(lambda: run.name == "r2d2 (2)")
    repeated = FakeLink.made[0].repeated
    assert repeated == (0 if rival > WANTED.host else PATIENCE)
    await run.end()


async def test_a_rival_that_gives_way(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    await until(lambda: run.name)
    left = [2]

    def rivals(name: str) -> str:
        left[0] -= 1
        return "appliance-1-0.local." if left[0] > 0 else ""

    monkeypatch.setattr(FakeLink, "rivals", staticmethod(rivals))
    await until(lambda: left[0] < -3)
    assert run.name == "r2d2" and FakeLink.made[0].repeated == 1
    await run.end()


async def test_addresses_change(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    taken = {"r2d2": "zombie"}
    monkeypatch.setattr(FakeLink, "rivals", staticmethod(lambda name: taken.get(name, "")))
    await until(lambda: run.name == "r2d2 (2)")
    taken.clear()
    run.links = []
    await until(lambda: not run.name)
    assert run.told[-1] == {"name": "", "links": [], "problem": ""}
    run.links = [OTHER]
    # On another network the first name may be free.
    await until(lambda: run.name == "r2d2")
    assert run.told[-1]["links"] == ["eth0: 192.0.2.9"]
    assert all(link.closed for link in FakeLink.made[:-1])
    await run.end()


async def test_an_interface_that_has_just_gone(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    failing = [True]

    async def start(self: FakeLink) -> None:
        if failing:
            failing.pop()
            raise OSError(19, "No such device")

    monkeypatch.setattr(FakeLink, "start", start)
    await until(lambda: run.name)
    assert "No such device" in run.told[0]["problem"] and not run.told[0]["name"]
    assert run.told[1]["problem"] == ""
    await run.end()


async def test_another_announcement(run: Run) -> None:
    await until(lambda: run.name)
    run.lines.feed_data(Announcement("c3po", "", "h", WANTED.services).to_line())
    await until(lambda: run.name == "c3po")
    assert FakeLink.made[0].closed == "r2d2"
    await run.end()


def test_the_services_on_a_link() -> None:
    """A second port of one kind has another name, and each service a host with its addresses."""
    services = (
        Service(SECURE_MQTT, 8883, ("0.0.0.0",)),
        Service(SECURE_MQTT, 8884, ("192.0.2.1",)),
        Service("_https._tcp.local.", 8443, ("203.0.113.7",)),  # on another link
    )
    link = LinkAnnouncer.__new__(LinkAnnouncer)  # without its sockets
    link.link = LINK
    link._wanted = Announcement("r2d2", "AB", "h", services)
    found = [(each.name, each.port, each.server) for each in link.services("r" * 63)]
    assert found == [
        (f"{'r' * 63}.{SECURE_MQTT}", 8883, "h-0.local."),
        (f"{'r' * 58} 8884.{SECURE_MQTT}", 8884, "h-1.local."),
    ]
