"""A reload of `upstreams`: links end, begin and change, and nothing that waits is lost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from waiting import until

from appliance.app.reload import ReloadError
from upstream.fake_fleet import FakeFleet
from upstream.test_uplink import event_loop_policy, payloads, publish
from upstream.uplink_rig import Rig, running

__all__ = ["event_loop_policy"]


async def reload(rig: Rig, *links: dict[str, Any]) -> list[str]:
    settings = yaml.safe_load(rig.file.read_text())
    settings["upstreams"] = list(links)
    rig.file.write_text(yaml.safe_dump(settings))
    return await rig.app.reload()


async def test_links_are_reloaded(tmp_path: Path) -> None:
    door = "fleet/r2d2/events/door"
    async with FakeFleet() as fleet, FakeFleet() as other:
        rig = Rig(tmp_path, fleet.port)
        (link,) = yaml.safe_load(rig.file.read_text())["upstreams"]
        async with running(rig):
            await rig.connected()
            first = rig.uplink
            # A section that is wrong changes nothing.
            with pytest.raises(ReloadError):
                await reload(rig, {**link, "out": [{"topic": "a/#/b"}]})
            assert rig.app.upstreams == [first] and rig.status().connected
            assert await reload(rig, link) == []
            assert rig.app.upstreams == [first]
            # What waits goes to the server that the link has now.
            await fleet.stop()
            sent = [str(number).encode() for number in range(200)]
            await publish(rig, "r2d2/events/door", *sent)
            moved = {**link, "servers": [f"mqtt://127.0.0.1:{other.port}"]}
            changed = await reload(rig, moved)
            assert "upstream 'fleet' is started anew" in changed
            await until(lambda: payloads(other, door)[-1:] == sent[-1:])
            assert list(dict.fromkeys(payloads(other, door))) == sent
            await publish(rig, "r2d2/events/door", b"more")
            await rig.drained()
            assert payloads(other, door)[-1] == b"more"
            # One is added, and one removed: its topics are not retained any more.
            await fleet.start()
            added = {**link, "name": "second", "client_id": "second"}
            assert "upstream 'second' is new" in await reload(rig, moved, added)
            await until(lambda: rig.app.upstreams[1].status().connected)
            assert "upstream 'fleet' is removed" in await reload(rig, added)
            assert [each.settings.name for each in rig.app.upstreams] == ["second"]
            await until(lambda: other.visit.disconnect is not None)
            assert payloads(other, "fleet/r2d2/_appliance/state")[-1] == b"offline"
            retained = rig.app.broker.retained
            assert retained.get("r2d2/_appliance/upstream/fleet") is None
            assert retained.get("r2d2/_appliance/upstream/second") is not None


async def test_what_is_published_while_a_link_is_reloaded_is_not_lost(tmp_path: Path) -> None:
    door = "fleet/r2d2/events/door"
    async with FakeFleet() as fleet:
        rig = Rig(tmp_path, fleet.port)
        (link,) = yaml.safe_load(rig.file.read_text())["upstreams"]
        async with running(rig):
            await rig.connected()
            sent = []
            for turn in range(5):
                batch = [f"{turn} {number}".encode() for number in range(100)]
                sent += batch
                waiting = rig.app._entries.loop.create_task(
                    publish(rig, "r2d2/events/door", *batch)
                )
                await reload(rig, {**link, "keep_alive": f"{30 + turn} s"})
                await waiting
            await rig.drained()
            await until(lambda: set(payloads(fleet, door)) == set(sent))
            assert list(dict.fromkeys(payloads(fleet, door))) == sent
            assert not fleet.faults
