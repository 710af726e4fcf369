"""Which server a link is connected to, and how often it dials: with brokers that obey the test."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from saboteur import Saboteur
from waiting import until

from appliance.mqtt.codec import V5, V311
from appliance.mqtt.packets import Publish
from appliance.upstream import backoff, limits, line
from upstream.fake_fleet import FakeFleet, Visit, accept, late, never
from upstream.uplink_rig import Rig, hurry, running
from upstream.uplink_rig import event_loop_policy as event_loop_policy

pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')

DOOR = "fleet/r2d2/events/door"
STATE = "fleet/r2d2/_appliance/state"


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch)
    monkeypatch.setattr(backoff, "RETURN_AFTER", 0.2)


def payloads(fleet: FakeFleet, topic: str) -> list[bytes]:
    return [each.payload for each in fleet.published if each.topic == topic]


def closing(visit: Visit) -> None:
    """In place of CONNACK."""
    visit.close()


@contextlib.asynccontextmanager
async def on_the_second(
    directory: Path, **link: Any
) -> AsyncIterator[tuple[FakeFleet, FakeFleet, Rig]]:
    """A link to two servers whose first one is down, connected to the second."""
    async with FakeFleet() as first, FakeFleet() as second:
        await first.stop()
        servers = [f"mqtt://127.0.0.1:{fleet.port}" for fleet in (first, second)]
        async with running(Rig(directory, 0, servers=servers, **link)) as rig:
            await until(lambda: payloads(second, STATE) == [b"online"])
            yield first, second, rig


async def test_the_link_goes_back_to_the_first_server_without_loss_or_repetition(
    tmp_path: Path,
) -> None:
    async with on_the_second(tmp_path) as (first, second, rig):
        second.acknowledge = late(0.05)  # some messages are always under way
        peer = await rig.client("publisher")
        number = 0
        while not payloads(first, DOOR):
            number += 1
            await peer.send(Publish("r2d2/events/door", b"%d" % number, 1, packet_id=number))
            await peer.receive()
            if number == 50:
                tries = rig.status().attempts + 2
                await until(lambda: rig.status().attempts >= tries, "two dials")  # noqa: B023
                assert rig.status().connected and len(second.visits) == 1
                assert rig.status().server.endswith(str(second.port))
                await first.start()
        peer.hang_up()
        await rig.drained()
        sent = [b"%d" % each for each in range(1, number + 1)]
        assert payloads(second, DOOR) + payloads(first, DOOR) == sent
        # The second one is told; it may not be of the same cluster.
        assert payloads(second, STATE) == [b"online", b"offline"]
        assert second.visit.disconnect is not None and not second.visit.disconnect.reason_code
        await until(lambda: payloads(first, STATE) == [b"online"])
        await until(lambda: rig.status().connected)
        assert rig.status().server.endswith(str(first.port))
        assert len(second.visits) == len(first.visits) == 1
        assert not first.faults and not second.faults


async def test_what_the_second_server_does_not_acknowledge_goes_to_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(line, "LEAVING", 0.2)
    async with on_the_second(tmp_path) as (first, second, rig):
        second.acknowledge = never
        peer = await rig.client("publisher")
        await peer.send(Publish("r2d2/events/door", b"1", 1, packet_id=1))
        await peer.receive()
        await until(lambda: payloads(second, DOOR))
        packet_id = second.visit.message("fleet/r2d2/cmd/go", b"x", 1)
        await first.start()
        await until(lambda: payloads(first, DOOR) == [b"1"])
        assert (packet_id, 0) in second.visit.acknowledged
        await rig.drained()
        peer.hang_up()


async def test_a_first_server_that_accepts_no_connection_is_left_again(tmp_path: Path) -> None:
    async with on_the_second(tmp_path) as (first, second, rig):
        first.greet = closing
        await first.start()
        await second.visited(2)
        assert first.visits
        await until(lambda: rig.status().connected)


async def test_a_connection_to_the_first_server_that_ends_unused_says_nothing_of_mqtt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a server that closes idle connections, while the link waits for acknowledgements."""
    monkeypatch.setattr(line, "LEAVING", 0.5)
    async with on_the_second(tmp_path) as (first, second, rig):
        second.acknowledge = never
        peer = await rig.client("publisher")
        await peer.send(Publish("r2d2/events/door", b"1", 1, packet_id=1))
        await peer.receive()
        await until(lambda: payloads(second, DOOR))

        def close_idle(visit: Visit) -> None:
            if len(first.visits) <= 2:
                visit.close()

        first.accept = close_idle
        await first.start()
        await until(lambda: rig.status().connected and first.connects)
        assert {each.version for each in first.connects} == {V5}
        assert any(visit.connect is None for visit in first.visits)
        peer.hang_up()


@pytest.mark.patches
async def test_a_fault_in_the_dial_beside_a_connection_leaves_the_connection_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, escaped: list[str]
) -> None:
    saboteur = Saboteur(monkeypatch)
    async with on_the_second(tmp_path) as (first, second, rig):
        saboteur.arm("upstream.return")
        await until(lambda: rig.app.broker.faults.by_entry.get("upstream.return"))
        assert rig.status().connected and len(second.visits) == 1
        await first.start()
        await until(lambda: payloads(first, STATE) == [b"online"])
    escaped.clear()


async def test_a_stop_while_the_first_server_is_dialled_leaves_nothing_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(line, "LEAVING", 60.0)
    async with on_the_second(tmp_path) as (first, second, _):
        second.acknowledge = never
        await first.start()
        await until(lambda: payloads(second, STATE) == [b"online", b"offline"])
        await until(lambda: first.visits)
    await until(lambda: first.visit.ended)
    assert not first.connects


async def test_a_server_that_closes_upon_mqtt_5_is_spoken_to_in_3_1_1(tmp_path: Path) -> None:
    """As RabbitMQ 3.10 does."""
    async with FakeFleet(versions=(V311,)) as fleet:
        fleet.refuses_version = "close"
        async with running(Rig(tmp_path, fleet.port)) as rig:
            await fleet.visited()
            assert rig.status().version == "3.1.1" and len(fleet.visits) == 3
            fleet.visit.reset()
            await fleet.visited(2)
            await until(lambda: rig.status().connected)
            assert rig.status().version == "3.1.1" and len(fleet.visits) == 5


async def test_closes_for_other_reasons_do_not_end_in_3_1_1(tmp_path: Path) -> None:
    async with FakeFleet() as fleet:

        def greet(visit: Visit) -> None:
            (closing if len(fleet.connects) <= 3 else fleet.good_greeting)(visit)

        fleet.greet = greet
        async with running(Rig(tmp_path, fleet.port)) as rig:
            await until(lambda: rig.status().problem)
            await fleet.visited()
            await until(lambda: rig.status().connected)
            assert [each.version for each in fleet.connects] == [V5, V5, V311, V5]


@pytest.mark.parametrize("end", ["refuses", "resets"])
async def test_a_try_of_3_1_1_that_fails_is_not_for_ever(tmp_path: Path, end: str) -> None:
    async with FakeFleet(versions=(V5,)) as fleet:
        fleet.refuses_version = "3.1.1"
        ends = 0

        def greet(visit: Visit) -> None:
            if len(fleet.connects) <= 2:
                visit.close()
            else:
                fleet.good_greeting(visit)

        def reset(visit: Visit) -> None:
            nonlocal ends
            if len(fleet.visits) == 3:
                ends += 1
                visit.reset()

        fleet.greet = greet
        if end == "resets":
            fleet.accept = reset
        async with running(Rig(tmp_path, fleet.port)) as rig:
            await fleet.visited()
            await until(lambda: rig.status().connected)
            assert len(fleet.visits) == 4 and rig.status().version == "5"
            assert ends == (end == "resets")


async def test_a_login_that_needs_mqtt_5_is_not_tried_with_3_1_1(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("secret")
    (tmp_path / "token").chmod(0o600)
    login = {"token_file": str(tmp_path / "token"), "method": "OAUTH2-JWT"}
    async with FakeFleet() as fleet:
        fleet.greet = closing
        async with running(Rig(tmp_path, fleet.port, login=login)) as rig:
            await until(lambda: len(fleet.connects) > 5)
            assert {each.version for each in fleet.connects} == {V5}
            fleet.versions = ()
            await until(lambda: "login.method needs it" in (rig.status().problem or ""))


async def test_rules_that_need_mqtt_5_are_not_tried_with_3_1_1(tmp_path: Path) -> None:
    both = [{"topic": "cmd/#"}]
    async with FakeFleet() as fleet:
        fleet.greet = closing
        async with running(Rig(tmp_path, fleet.port, **{"in": both, "out": both})):
            await until(lambda: len(fleet.connects) > 5)
        assert {each.version for each in fleet.connects} == {V5}


async def test_closes_without_a_reason_name_the_client_id(tmp_path: Path) -> None:
    """mosquitto 2.0 closes when another client takes the client id over, and says no reason."""
    async with FakeFleet() as fleet:

        def close_when_online(visit: Visit, packet: Publish) -> None:
            accept(visit, packet)
            if packet.topic == STATE:
                asyncio.get_running_loop().call_later(0.1, visit.close)

        fleet.acknowledge = close_when_online
        async with running(Rig(tmp_path, fleet.port)) as rig:
            await until(lambda: "client id 'r2d2' as well?" in (rig.status().problem or ""))
            assert len(fleet.visits) >= backoff.TAKEN_OVER
            fleet.acknowledge = accept
            await until(lambda: rig.status().connected)


async def test_closes_on_a_message_are_no_takeovers(tmp_path: Path) -> None:
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        await until(lambda: payloads(fleet, STATE))

        def close_at_door(visit: Visit, packet: Publish) -> None:
            if packet.topic == DOOR:
                visit.close()
            else:
                accept(visit, packet)

        fleet.acknowledge = close_at_door
        problems = set()
        peer = await rig.client("publisher")
        await peer.send(Publish("r2d2/events/door", b"poison", 1, packet_id=1))
        await peer.receive()

        def is_set_aside() -> bool:
            problems.add(rig.status().problem)
            return rig.status().set_aside == 1

        await until(is_set_aside)
        assert not any("client id" in (each or "") for each in problems), problems
        peer.hang_up()


async def test_between_two_connects_is_the_time_that_the_broker_asks_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """AWS IoT Core allows one a second."""
    monkeypatch.setitem(limits.KINDS, "generic", limits.FleetLimits(connect_interval=0.3))
    async with FakeFleet() as fleet:
        fleet.greet = closing
        async with running(Rig(tmp_path, fleet.port)) as rig:
            for count in range(1, 6):
                await until(lambda: len(fleet.visits) >= count)  # noqa: B023
                rig.uplink.clock_was_set()
        times = [visit.began for visit in fleet.visits]
        assert all(later - before > 0.29 for before, later in pairwise(times)), times


async def test_a_will_that_the_broker_does_not_take_is_replaced(tmp_path: Path) -> None:
    async with FakeFleet() as fleet:

        def greet(visit: Visit) -> None:
            assert visit.connect is not None and visit.connect.will is not None
            fleet.reason_code = 0x9B if visit.connect.will.qos else 0
            if visit.connect.will.retain:
                fleet.reason_code = 0x9A
            fleet.good_greeting(visit)

        fleet.greet = greet
        async with running(Rig(tmp_path, fleet.port)) as rig:
            await fleet.visited()
            await until(lambda: rig.status().connected)
            assert len(fleet.connects) == 3 and {each.version for each in fleet.connects} == {V5}
