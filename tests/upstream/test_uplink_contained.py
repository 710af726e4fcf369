"""A fault in any callback of a link ends that callback or the connection, and the link goes on."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from saboteur import Saboteur
from waiting import until

from appliance.mqtt.packets import Publish
from appliance.upstream import channel, line, uplink
from upstream.fake_fleet import FakeFleet
from upstream.uplink_rig import Rig, hurry, running
from upstream.uplink_rig import event_loop_policy as event_loop_policy

pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')


async def publish(rig: Rig, payload: bytes) -> None:
    peer = await rig.client("publisher")
    await peer.send(Publish("r2d2/events/door", payload, 1, False, False, 1))
    await peer.receive()
    peer.hang_up()


async def _publish(rig: Rig, fleet: FakeFleet) -> None:
    await publish(rig, b"provoked")


async def _receive(rig: Rig, fleet: FakeFleet) -> None:
    fleet.visit.message("fleet/r2d2/cmd/go", b"x", 1)


async def _change_rules(rig: Rig, fleet: FakeFleet) -> None:
    rig.app.broker.rules_changed()


async def _reset(rig: Rig, fleet: FakeFleet) -> None:
    fleet.visit.reset()


async def _fail_the_task(rig: Rig, fleet: FakeFleet) -> None:
    """The next dial raises what nobody expects; its task ends."""
    line = rig.uplink._lines[0]
    line._attempt = _raise  # type: ignore[method-assign]
    fleet.visit.reset()
    await until(lambda: rig.app.broker.faults.by_entry.get("upstream.dial"))
    del line._attempt  # type: ignore[attr-defined]


async def _raise() -> float:
    raise ArithmeticError("nobody expected this")


async def _wait(rig: Rig, fleet: FakeFleet) -> None:
    """It comes by itself."""


Provoke = Callable[[Rig, FakeFleet], Awaitable[None]]

ENTRIES: dict[str, Provoke] = {
    "upstream.check": _wait,
    "upstream.clock": _wait,
    "upstream.dial": _fail_the_task,
    "upstream.offer": _change_rules,
    "upstream.ping": _wait,
    "upstream.restart": _fail_the_task,
    "upstream.send": _publish,
    "upstream.turn": _receive,
}


@pytest.mark.patches
@pytest.mark.parametrize("behind", [False, True], ids=["before", "behind"])
@pytest.mark.parametrize("name", ENTRIES)
async def test_the_link_goes_on(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    escaped: list[str],
    name: str,
    behind: bool,
) -> None:
    hurry(monkeypatch)
    for module, constant in (
        (uplink, "TICK"),
        (uplink, "AGAIN"),
        (line, "AGAIN"),
        (channel, "CHECK_INTERVAL"),
    ):
        monkeypatch.setattr(module, constant, 0.1)
    saboteur = Saboteur(monkeypatch)
    rules = [{"topic": "cmd/#", "late": "500 ms"}]
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port, **{"in": rules})) as rig:
        await fleet.visited()
        faults = rig.app.broker.faults
        if name == "upstream.dial":
            await ENTRIES[name](rig, fleet)  # the task never ends by itself
        else:
            if behind:
                saboteur.arm(behind=name)
            else:
                saboteur.arm(name)
            await ENTRIES[name](rig, fleet)
        await until(lambda: faults.by_entry.get(name), f"a fault in {name}")
        await publish(rig, b"afterwards")
        await rig.drained()
        await until(lambda: b"afterwards" in [each.payload for each in fleet.published])
        await until(lambda: rig.status().connected, "the link to be connected")
        packet_id = fleet.visit.message("fleet/r2d2/cmd/go", b"x", 1)
        await until(lambda: packet_id in [each for each, _ in fleet.visit.acknowledged])
    escaped.clear()
