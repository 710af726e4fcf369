"""A reload of `upstreams`: links end, begin and change, and nothing that waits is lost."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path
from typing import Any

import pytest
import yaml
from waiting import until

from appliance import config
from appliance.app.reload import ReloadError
from appliance.mqtt.packets import Publish
from appliance.upstream.backlog import Backlog
from appliance.upstream.status import warnings_of
from appliance.upstream.uplink import Uplink
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


async def test_what_waits_for_a_link_that_has_another_name_now_is_told(tmp_path: Path) -> None:
    async def told(rig: Rig) -> list[str]:
        assert rig.app._status is not None
        warnings = (await rig.app._status.report(None))["warnings"]
        return [each for each in warnings if "not in the file" in each]

    async with FakeFleet() as fleet:
        rig = Rig(tmp_path, fleet.port)
        (link,) = yaml.safe_load(rig.file.read_text())["upstreams"]
        async with running(rig):
            await rig.connected()
            await publish(rig, "r2d2/events/door", b"sent")
            await until(lambda: payloads(fleet, "fleet/r2d2/events/door") == [b"sent"])
            await rig.drained()
            assert await reload(rig, {**link, "name": "central"}) and not await told(rig)
            await reload(rig, link)
            await rig.connected()
            await fleet.stop()
            await publish(rig, "r2d2/events/door", b"waits")
            await reload(rig, {**link, "name": "central"})
            (text,) = await told(rig)
            assert "messages wait for the upstream 'fleet'" in text
            assert text.endswith("appliance store prune --upstream fleet")
        async with running(rig):  # at a start as well
            assert await told(rig) == [text]
            await reload(rig)
            assert await told(rig) == [text]
            await fleet.start()
            await reload(rig, link)
            doors = [b"sent", b"waits"]
            await until(lambda: payloads(fleet, "fleet/r2d2/events/door") == doors)
            assert not await told(rig)


async def test_what_is_said_of_a_link_ends_when_it_is_removed_before_a_start(
    tmp_path: Path,
) -> None:
    async with FakeFleet() as fleet:
        rig = Rig(tmp_path, fleet.port)
        settings = yaml.safe_load(rig.file.read_text())
        link = settings["upstreams"][0]
        settings["upstreams"] += [{**link, "name": "second", "client_id": "second"}]
        rig.file.write_text(yaml.safe_dump(settings))
        topic = "r2d2/_appliance/upstream/{}".format
        async with running(rig):
            await rig.connected()
            await publish(rig, "other/_appliance/state", b"of a user", retain=True)
            assert rig.app.broker.retained.get(topic("second")) is not None
        settings["upstreams"] = [link]
        rig.file.write_text(yaml.safe_dump(settings))
        async with running(rig):
            retained = rig.app.broker.retained
            assert retained.get(topic("fleet")) is not None
            assert retained.get(topic("second")) is None
        # Nor does a robot of another name say anything.
        rig.file.write_text(yaml.safe_dump({**settings, "robot": "c3po"}))
        async with running(rig):
            retained = rig.app.broker.retained
            found = sorted(each for each, _ in retained.find("+/_appliance/#"))
            assert found == [
                "c3po/_appliance/state",
                "c3po/_appliance/upstream/fleet",
                "other/_appliance/state",
            ]


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


@pytest.mark.parametrize("failing", [False, pytest.param(True, marks=pytest.mark.patches)])
async def test_a_reload_loses_what_cannot_be_stored_and_the_link_before_is_freed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: bool
) -> None:
    async with FakeFleet() as fleet:
        rig = Rig(tmp_path, fleet.port)
        (link,) = yaml.safe_load(rig.file.read_text())["upstreams"]
        async with running(rig):
            await rig.connected()
            await fleet.stop()
            await publish(rig, "r2d2/events/door", b"1", b"2")
            peer = await rig.client("publisher")
            for number in range(3):
                await peer.send(Publish(f"r2d2/state/{number}", b"x", 0))
            await until(lambda: rig.status().waiting == 5)
            gc.collect()
            gc.disable()
            try:
                before = weakref.ref(rig.uplink)
                answers = rig.uplink._answers
                if failing:  # as while nothing can be written
                    monkeypatch.setattr(Backlog, "store", lambda _: None)
                await reload(rig, {**link, "keep_alive": "20 s"})
                await until(lambda: before() is None, "the link before to be freed")
            finally:
                gc.enable()
            assert rig.status().waiting == (2 if failing else 5)
            assert rig.status().forgotten == (3 if failing else 0)
            told = any("lost" in each for each in warnings_of(rig.status().as_json()))
            assert told is failing
            assert rig.uplink._answers is answers
            state = "$SYS/broker/connection/{}/state".format
            assert rig.app.broker.retained.get(state("r2d2")) is not None
            await reload(rig, {**link, "client_id": "other"})
            assert rig.app.broker.retained.get(state("r2d2")) is None
            assert rig.app.broker.retained.get(state("other")) is not None
            assert rig.app.broker.retained.get("r2d2/_appliance/upstream/fleet") is not None
            peer.hang_up()


async def test_a_stop_within_a_reload_is_a_stop(tmp_path: Path) -> None:
    async with FakeFleet() as fleet:
        rig = Rig(tmp_path, fleet.port)
        (link,) = yaml.safe_load(rig.file.read_text())["upstreams"]
        await rig.start()
        a, b, c = ({**link, "name": each, "client_id": each} for each in "abc")
        await reload(rig, a, b)
        data = yaml.safe_load(rig.file.read_text())
        rig.file.write_text(yaml.safe_dump({**data, "upstreams": [c]}))
        links = rig.app._links
        reloading = rig.app._entries.loop.create_task(links.replace(config.load(rig.file)))
        await rig.app.stop()
        await reloading
        assert "c" not in [each.settings.name for each in links.running]


@pytest.mark.patches
async def test_a_link_that_cannot_start_keeps_no_other_one_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, escaped: list[str]
) -> None:
    async with FakeFleet() as fleet:
        rig = Rig(tmp_path, fleet.port)
        (link,) = yaml.safe_load(rig.file.read_text())["upstreams"]
        async with running(rig):
            start = Uplink.start

            def failing(self: Uplink) -> None:
                if self.settings.name == "bad":
                    raise RuntimeError("bad")
                start(self)

            monkeypatch.setattr(Uplink, "start", failing)
            bad, good = ({**link, "name": each, "client_id": each} for each in ("bad", "good"))
            await reload(rig, bad, good)
            await until(lambda: [each.settings.name for each in rig.app.upstreams] == ["good"])
            assert rig.app.broker.faults.by_entry.pop("upstream.start") == 1
    escaped.clear()
