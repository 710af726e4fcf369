"""A link as a whole: the appliance in this process, and a fleet's broker that obeys the test."""

from __future__ import annotations

import asyncio
import json
import math
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from harness import Peer
from waiting import until

from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.host import clock
from appliance.mqtt.codec import V311, Properties, Property
from appliance.mqtt.packets import (
    Connack,
    Disconnect,
    Pingresp,
    Puback,
    Publish,
    Suback,
    Subscribe,
    Subscription,
)
from appliance.mqtt.reason import ReasonCode
from appliance.upstream import channel as channel_module
from appliance.upstream import disk_room
from appliance.upstream.refusals import reason_words
from appliance.upstream.sender import WITHOUT_PROGRESS
from appliance.upstream.status import warnings_of
from appliance.upstream.uplink import GATHER, LEAST_GATHERED
from upstream.fake_fleet import FakeFleet, Visit, accept, close_at, never, refuse, refuse_topic
from upstream.hostile import SCENARIOS
from upstream.relay import Relay
from upstream.uplink_rig import Rig, hurry, running
from upstream.uplink_rig import event_loop_policy as event_loop_policy

pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch)


#: Rules with a state of QoS 0, and a topic of it there.
LATEST_STATE = [{"topic": "events/#"}, {"topic": "state/#", "keep": "latest", "qos": 0}]
ODOM = "fleet/r2d2/state/odom"


async def publish(rig: Rig, topic: str, *payloads: bytes, qos: int = 1, retain: bool = False):
    """Publish them as a local client; they are acknowledged when this returns."""
    peer = await rig.client("publisher")
    for number, payload in enumerate(payloads, 1):
        await peer.send(Publish(topic, payload, qos, retain, False, number if qos else None))
    codes = [(await peer.receive()).reason_code for _ in payloads] if qos else []
    peer.hang_up()
    return codes


@asynccontextmanager
async def steady(rig: Rig, *topics: str) -> AsyncIterator[None]:
    """Somebody publishes to them with QoS 0 all the time."""
    peer = await rig.client("steady")

    async def go_on() -> None:
        while True:
            await peer.send(*[Publish(topic, b"x", 0) for topic in topics])
            await asyncio.sleep(0.01)

    going = asyncio.create_task(go_on())
    try:
        yield
    finally:
        going.cancel()
        peer.hang_up()


def payloads(fleet: FakeFleet, topic: str) -> list[bytes]:
    return [each.payload for each in fleet.published if each.topic == topic]


async def test_what_is_acknowledged_here_arrives_there_once_and_in_order(tmp_path: Path) -> None:
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        await fleet.visited()
        sent = [b"%d" % number for number in range(300)]
        assert await publish(rig, "r2d2/events/door", *sent) == [0] * 300
        await until(lambda: len(payloads(fleet, "fleet/r2d2/events/door")) == 300)
        assert payloads(fleet, "fleet/r2d2/events/door") == sent
        await rig.drained()
        assert not fleet.faults


@pytest.mark.parametrize("window", [LEAST_GATHERED, LEAST_GATHERED - 1])
async def test_while_a_large_window_is_full_acknowledgements_are_gathered(
    tmp_path: Path, window: int
) -> None:
    """A small one is filled again at each of them: there the round trip limits the rate."""
    async with (
        FakeFleet(limits={Property.RECEIVE_MAXIMUM: window}) as fleet,
        running(Rig(tmp_path, fleet.port)) as rig,
    ):
        await fleet.visited()
        await until(lambda: fleet.published and not rig.status().inflight, "the state to be there")
        transport = rig.uplink._lines[0].channel._transport
        gathered: list[float] = []
        gather = transport.gather

        def noting(seconds: float) -> None:
            gathered.append(seconds)
            gather(seconds)

        transport.gather = noting
        fleet.acknowledge = never
        sent = [b"%d" % number for number in range(window + 100)]
        assert await publish(rig, "r2d2/events/door", *sent[:window]) == [0] * window
        await until(lambda: len(fleet.published) == window + 1)  # and the state
        assert bool(gathered) == (window == LEAST_GATHERED)
        await publish(rig, "r2d2/events/door", *sent[window:])
        assert not rig.uplink._lines[0].channel.connection.room
        fleet.acknowledge = accept
        for packet_id in list(fleet.visit.unacknowledged):
            fleet.visit.acknowledge(packet_id)
            await fleet.visit.drain()
        await rig.drained()
        assert payloads(fleet, "fleet/r2d2/events/door") == sent
        assert set(gathered) <= {GATHER}
        assert not fleet.faults


async def test_what_waits_survives_restarts_of_both(tmp_path: Path) -> None:
    async with FakeFleet() as fleet:
        await fleet.stop()
        sent = [b"%d" % number for number in range(500)]
        for part in (sent[:200], sent[200:]):
            async with running(Rig(tmp_path, fleet.port)) as rig:
                await publish(rig, "r2d2/events/door", *part)
                if part[0] == b"0":  # in memory
                    peer = await rig.client("state")
                    await peer.send(Publish("r2d2/state/battery", b"99", 0))
                    await until(lambda: rig.status().waiting == 201)
                    peer.hang_up()
                assert rig.status().problem and not rig.status().connected
        await fleet.start()
        async with running(Rig(tmp_path, fleet.port)) as rig:
            await until(lambda: len(payloads(fleet, "fleet/r2d2/events/door")) == 500)
            await rig.drained()
    assert payloads(fleet, "fleet/r2d2/events/door") == sent
    assert payloads(fleet, "fleet/r2d2/state/battery") == [b"99"]


async def test_what_is_not_acknowledged_there_is_sent_again_on_the_next_connection(
    tmp_path: Path,
) -> None:
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        visit = await fleet.visited()
        await until(lambda: payloads(fleet, "fleet/r2d2/_appliance/state"))
        fleet.acknowledge = never
        await publish(rig, "r2d2/events/door", b"1", b"2", b"3")
        await until(lambda: len(payloads(fleet, "fleet/r2d2/events/door")) == 3)
        fleet.acknowledge = accept
        visit.reset()
        await until(lambda: len(payloads(fleet, "fleet/r2d2/events/door")) == 6)
        assert payloads(fleet, "fleet/r2d2/events/door") == [b"1", b"2", b"3"] * 2
        await rig.drained()


async def test_of_a_state_the_latest_is_sent_after_an_outage_deletions_included(
    tmp_path: Path,
) -> None:
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        visit = await fleet.visited()
        await publish(rig, "r2d2/state/gone", b"there", retain=True)
        await until(lambda: payloads(fleet, "fleet/r2d2/state/gone"))
        await fleet.stop()
        await until(lambda: not rig.status().connected)
        await publish(rig, "r2d2/state/battery", *[b"%d" % n for n in range(100)], retain=True)
        await publish(rig, "r2d2/state/gone", b"", retain=True)
        await fleet.start()
        await fleet.visited(2)
        await until(lambda: payloads(fleet, "fleet/r2d2/state/battery"))
        await rig.drained()
        assert payloads(fleet, "fleet/r2d2/state/battery") == [b"99"]
        assert payloads(fleet, "fleet/r2d2/state/gone") == [b"there", b""]
        assert all(each.retain for each in fleet.published)
        del visit


async def test_online_and_offline_are_said_there_and_here(tmp_path: Path) -> None:
    async with FakeFleet() as fleet:
        async with running(Rig(tmp_path, fleet.port)) as rig:
            await until(lambda: payloads(fleet, "fleet/r2d2/_appliance/state") == [b"online"])
            will = fleet.connects[0].will
            assert will is not None
            assert (will.topic, will.payload, will.qos, will.retain) == (
                "fleet/r2d2/_appliance/state",
                b"offline",
                1,
                True,
            )
            retained = rig.app.broker.retained.get("r2d2/_appliance/upstream/fleet")
            assert retained is not None and b'"connected":true' in retained.payload
            state = rig.app.broker.retained.get("$SYS/broker/connection/r2d2/state")
            assert state is not None and state.payload == b"1"
        assert payloads(fleet, "fleet/r2d2/_appliance/state") == [b"online", b"offline"]
        assert fleet.visit.disconnect is not None


async def test_what_the_access_rules_do_not_let_in_is_told(tmp_path: Path) -> None:
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        await rig.connected()
        acl = tmp_path / "acl.conf"
        acl.write_text(acl.read_text() + "user upstream\ntopic deny {robot}/cmd/#\n")
        await rig.app.reload()
        (await fleet.visited()).message("fleet/r2d2/cmd/1", b"go")
        await until(lambda: rig.status().refused)
        status = rig.status().as_json()
        (text,) = warnings_of(status)
        assert text.startswith("the access rules do not let it publish here what comes on ")
        assert "fleet/r2d2/cmd/#: " in text and "acl.conf:" in text
        assert status["dropped"]["fleet/r2d2/cmd/#"] == {"refused": 1}


@pytest.mark.parametrize("qos", [0, 1, 2])
@pytest.mark.parametrize(
    ("topic", "bad"),
    [
        ("fleet/r2d2/cmd/1", {Property.RESPONSE_TOPIC: "a/+/x"}),
        ("fleet/r2d2/cmd/\x01", {}),
        ("fleet/r2d2/cmd/\x01", {Property.CONTENT_TYPE: "text/plain"}),
    ],
)
async def test_what_a_strangers_message_holds_ends_no_link(
    tmp_path: Path, qos: int, topic: str, bad: Properties
) -> None:
    """Retained, or kept in a session there, it would end each connection."""
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        await rig.connected()
        visit = await fleet.visited()
        for _ in range(3):
            visit.message(topic, b"bad", qos, properties=bad, retain=True)
        visit.message("fleet/r2d2/cmd/1", b"good", qos)
        await until(lambda: rig.status().delivered == 1)
        await until(lambda: not visit.sent)
        assert (rig.status().refused, rig.status().connections) == (3, 1)
        dropped = rig.status().dropped.get("fleet/r2d2/cmd/#")
        assert dropped == (None if "\x01" in topic else {"refused": 3})  # no rule carries that
        codes = [code for _, code in visit.acknowledged]
        assert codes == ([0x80] * 3 + [0] if qos else []) and not fleet.faults


async def test_a_refused_state_is_told_until_the_fleet_takes_it(tmp_path: Path) -> None:
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        fleet.acknowledge = refuse(0x87, times=1)
        await until(lambda: rig.status().state_refusal)
        (text,) = warnings_of(rig.status().as_json())
        assert "0x87 Not authorized; the fleet does not see that the robot is online" in text
        fleet.acknowledge = accept
        fleet.visit.close()
        await until(lambda: rig.status().state_refusal is None)


async def test_a_fleet_that_closes_behind_a_refused_state_has_no_other_client(
    tmp_path: Path,
) -> None:
    def refuse_and_close(visit: Visit, packet: Publish) -> None:
        assert packet.packet_id is not None
        visit.acknowledge(packet.packet_id, 0x87)
        visit.close()

    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        fleet.acknowledge = refuse_and_close
        await until(lambda: rig.status().connections > 4)
        assert "another client" not in str(rig.status().problem)


async def test_a_fleet_that_takes_only_smaller_packets_than_the_state_gets_the_rest(
    tmp_path: Path,
) -> None:
    profile = {"vda5050": {"manufacturer": "acme", "version": "3.0"}}
    there = "vda5050/v3/acme/r2d2/"
    async with FakeFleet(limits={Property.MAXIMUM_PACKET_SIZE: 150}) as fleet:
        rig = Rig(tmp_path, fleet.port, profile=profile, out=[], **{"in": []})
        async with running(rig):
            await publish(rig, "r2d2/vda5050/factsheet", b"{}")
            await until(lambda: f"{there}factsheet" in fleet.topics, "what is smaller")
            refusal = rig.status().state_refusal
            assert refusal is not None and "has to take larger packets" in refusal
            assert f"{there}connection" not in fleet.topics and not fleet.faults


async def test_a_link_by_vda5050_says_so_in_its_messages(tmp_path: Path) -> None:
    profile = {"vda5050": {"manufacturer": "acme", "version": "3.0"}}
    there = "vda5050/v3/acme/r2d2/"
    async with FakeFleet() as fleet:
        rig = Rig(tmp_path, fleet.port, profile=profile, out=[], **{"in": []})
        async with running(rig):
            await until(lambda: payloads(fleet, f"{there}connection"))
            await publish(rig, "r2d2/vda5050/factsheet", b"{}")
            await until(lambda: f"{there}factsheet" in fleet.topics, "the factsheet")
            wanted = set(fleet.visit.filters)
        will = fleet.connects[0].will
        assert will is not None and (will.topic, will.qos, will.retain) == (
            f"{there}connection",
            1,
            True,
        )
        said = [json.loads(each) for each in (will.payload, *payloads(fleet, will.topic))]
        assert [each["connectionState"] for each in said] == [
            "CONNECTION_BROKEN",
            "ONLINE",
            "OFFLINE",
        ]
        assert [each["headerId"] for each in said] == [0, 1, 2]
        sent = [(each.topic, each.qos, each.retain) for each in fleet.published]
        assert sent == [
            (f"{there}connection", 1, True),
            (f"{there}factsheet", 0, True),
            (f"{there}connection", 1, True),
        ]
        names = ("order", "instantActions", "zoneSet", "responses", "_answers/+")
        assert wanted == {there + each for each in names}


async def test_a_message_from_there_is_published_here_and_then_acknowledged(
    tmp_path: Path,
) -> None:
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        visit = await fleet.visited()
        peer = await rig.client("reader")
        await peer.send(Subscribe(1, [Subscription("r2d2/cmd/#", 1)]))
        assert isinstance(await peer.receive(), Suback)
        packet_id = visit.message("fleet/r2d2/cmd/go", b"fast", 1)
        got = await peer.receive()
        assert (got.topic, got.payload, got.qos) == ("r2d2/cmd/go", b"fast", 1)
        await peer.send(Puback(got.packet_id))
        await until(lambda: (packet_id, 0) in visit.acknowledged, "PUBACK to the fleet")
        assert rig.status().came == {"fleet/r2d2/cmd/#": 1}
        peer.hang_up()


@pytest.mark.patches
async def test_what_the_fleet_held_while_the_computer_slept_is_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until the fleet answers a PINGREQ that was sent after the sleep."""
    slept = [0.0]
    monkeypatch.setattr(clock, "_asleep", lambda: slept[0])
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        visit = await fleet.visited()
        await rig.connected()
        robot = await rig.client("robot")
        await robot.send(Subscribe(1, [Subscription("r2d2/cmd/#", 0)]))
        assert isinstance(await robot.receive(), Suback)
        visit.send(Publish("fleet/r2d2/cmd/go", b"before", 0))
        assert (await robot.receive()).payload == b"before"
        asked: list[Visit] = []
        fleet.pong = asked.append
        slept[0] += 20
        visit.send(Publish("fleet/r2d2/cmd/go", b"old", 0))
        await until(lambda: asked, "a PINGREQ at once")
        await until(lambda: rig.status().dropped.get("fleet/r2d2/cmd/#") == {"late": 1})
        for each in asked:
            each.send(Pingresp())
        visit.send(Publish("fleet/r2d2/cmd/go", b"new", 0))
        assert (await robot.receive()).payload == b"new"
        robot.hang_up()


async def test_a_request_from_there_is_answered_at_its_own_topic(tmp_path: Path) -> None:
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        visit = await fleet.visited()
        peer = await rig.client("service")
        await peer.send(Subscribe(1, [Subscription("r2d2/cmd/#", 1)]))
        assert isinstance(await peer.receive(), Suback)
        asked = {Property.RESPONSE_TOPIC: "answers/alice", Property.CORRELATION_DATA: b"7"}
        visit.message("fleet/r2d2/cmd/call", b"?", 1, properties=asked)
        got = await peer.receive()
        topic = got.properties[Property.RESPONSE_TOPIC]
        assert topic.startswith("r2d2/_upstream/fleet/")
        answer = {Property.CORRELATION_DATA: got.properties[Property.CORRELATION_DATA]}
        await peer.send(Publish(topic, b"!", 1, False, False, 5, answer))
        await until(lambda: "answers/alice" in fleet.topics, "the answer")
        packet = next(each for each in fleet.published if each.topic == "answers/alice")
        assert packet.payload == b"!"
        assert packet.properties[Property.CORRELATION_DATA] == b"7"
        peer.hang_up()


@pytest.mark.parametrize("code", [0x87, 0x90, 0x95, 0x99])
async def test_what_the_fleet_never_takes_is_set_aside_and_blocks_nothing(
    tmp_path: Path, code: int
) -> None:
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        fleet.acknowledge = refuse_topic("fleet/r2d2/events/bad", code)
        await fleet.visited()
        await publish(rig, "r2d2/events/bad", b"poison")
        await publish(rig, "r2d2/events/good", b"1", b"2")
        await rig.drained()
        assert payloads(fleet, "fleet/r2d2/events/good")[-2:] == [b"1", b"2"]
        assert rig.status().set_aside == 1
        (aside,) = rig.uplink.aside()
        assert aside["topic"] == "fleet/r2d2/events/bad"
        words = reason_words(code) if code != 0x95 else "0x95"  # PUBACK has no such code
        assert words in str(aside["reason"])
        advice = "let this client write 'fleet/r2d2/events/bad' there"
        assert (advice in str(aside["reason"])) is (code == 0x87)


async def test_who_disconnects_with_connack_has_refused_no_subscription(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with FakeFleet() as fleet:

        def greet(visit: Visit) -> None:
            visit.send(Connack(False, 0), Disconnect(ReasonCode.SERVER_SHUTTING_DOWN))
            visit.close()

        fleet.greet = greet
        async with running(Rig(tmp_path, fleet.port)) as rig:
            await until(lambda: rig.status().connections > 1 and rig.status().problem)
            assert rig.status().refused_filters == []
            assert "Server shutting down" in str(rig.status().problem)
            assert "refuses the subscription" not in caplog.text
            assert not any(isinstance(each, Subscribe) for each in fleet.packets)


async def test_what_the_fleet_has_no_room_for_is_tried_again(tmp_path: Path) -> None:
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        await until(lambda: payloads(fleet, "fleet/r2d2/_appliance/state"))
        fleet.acknowledge = refuse(0x97, times=2)
        await publish(rig, "r2d2/events/door", b"1")
        await until(lambda: payloads(fleet, "fleet/r2d2/events/door") == [b"1"] * 3)
        await rig.drained()
        assert rig.status().set_aside == 0


async def test_the_fleet_that_closes_on_a_message_sent_alone_three_times_gets_it_no_more(
    tmp_path: Path,
) -> None:
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        fleet.acknowledge = close_at("fleet/r2d2/events/bad")
        await fleet.visited()
        await publish(rig, "r2d2/events/first", b"1")
        await publish(rig, "r2d2/events/bad", b"poison")
        await publish(rig, "r2d2/events/last", b"2")
        await rig.drained()
        assert payloads(fleet, "fleet/r2d2/events/last")[-1:] == [b"2"]
        assert [each["topic"] for each in rig.uplink.aside()] == ["fleet/r2d2/events/bad"]


async def test_a_poisonous_message_that_overtakes_another_one_blocks_nothing_either(
    tmp_path: Path,
) -> None:
    """It comes while the first is sent again, alone."""
    rules = [{"topic": "alarms/#", "priority": "high"}, {"topic": "events/#"}]
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port, out=rules)) as rig:
        bad = "fleet/r2d2/events/bad", "fleet/r2d2/alarms/bad"
        fleet.acknowledge = close_at(*bad)
        await fleet.visited()
        await publish(rig, "r2d2/events/bad", b"poison")
        await until(lambda: fleet.topics.count(bad[0]) > WITHOUT_PROGRESS, "it sent alone")
        await publish(rig, "r2d2/alarms/bad", b"poison")
        await publish(rig, "r2d2/alarms/good", b"1")
        await rig.drained()
        assert payloads(fleet, "fleet/r2d2/alarms/good") == [b"1"]
        assert {each["topic"] for each in rig.uplink.aside()} == set(bad)


async def test_whoever_is_in_flight_is_not_blamed_for_a_message_with_qos_0(tmp_path: Path) -> None:
    """The fleet closes upon a topic with QoS 0, whose newest value waits at each connection."""
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port, out=LATEST_STATE)) as rig:
        await fleet.visited()
        await rig.connected()
        fleet.acknowledge = close_at(ODOM)
        sent = [b"%d" % number for number in range(30)]
        async with steady(rig, "r2d2/state/odom"):
            await publish(rig, "r2d2/events/door", *sent)
            await until(lambda: rig.uplink.aside(), "it to be told")
        await rig.drained()
        assert {each["topic"] for each in rig.uplink.aside()} == {ODOM}
        assert set(payloads(fleet, "fleet/r2d2/events/door")) == set(sent)


async def test_a_topic_with_qos_0_upon_which_the_fleet_closes_is_found_and_left_out(
    tmp_path: Path,
) -> None:
    """Nothing else is under way when it closes, and the next value comes after each reconnect."""
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port, out=LATEST_STATE)) as rig:
        await fleet.visited()
        await rig.connected()
        fleet.acknowledge = close_at(ODOM)
        async with steady(rig, "r2d2/state/odom", "r2d2/state/battery"):
            await until(lambda: "closed upon" in str(rig.status().dropped), "it to be left out")
            assert [each["topic"] for each in rig.uplink.aside()] == [ODOM]
            visits = len(fleet.visits)
            await publish(rig, "r2d2/events/door", *[b"%d" % number for number in range(300)])
            door, battery = "fleet/r2d2/events/door", "fleet/r2d2/state/battery"
            await until(lambda: len(payloads(fleet, door)) == 300, "the events")
            came = len(payloads(fleet, battery))
            await until(lambda: len(payloads(fleet, battery)) > came + 5, "another topic")
            assert len(fleet.visits) == visits


async def test_while_a_large_message_leaves_slowly_the_link_is_read(tmp_path: Path) -> None:
    """Or it would end for want of answers that it does not read, and begin the message again."""
    rules = [{"topic": "mission/#", "late": "5 min"}]
    async with (
        FakeFleet() as fleet,
        Relay(fleet.port) as relay,
        running(Rig(tmp_path, relay.port, **{"in": rules})) as rig,
    ):
        visit = await fleet.visited()
        await publish(rig, "r2d2/events/door", b"")
        await rig.drained()
        relay.silence("up")
        await publish(rig, "r2d2/events/map", bytes(12_000_000))  # more than the system takes
        for count in range(1, 6):
            visit.send(Publish("fleet/r2d2/mission/go", b"", 0))
            await until(lambda count=count: rig.status().delivered == count, "a command")
        assert not payloads(fleet, "fleet/r2d2/events/map")
        relay.release()
        await until(lambda: payloads(fleet, "fleet/r2d2/events/map"), "the map")
        await rig.drained()
        assert len(fleet.visits) == 1


@pytest.mark.patches
async def test_answers_that_the_fleet_does_not_read_end_the_reading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where a large message lies before them; it has no part in what is allowed."""
    monkeypatch.setattr(channel_module, "MOST_UNSENT", 64 << 10)
    async with (
        FakeFleet() as fleet,
        Relay(fleet.port) as relay,
        running(Rig(tmp_path, relay.port)) as rig,
    ):
        visit = await fleet.visited()
        await publish(rig, "r2d2/events/door", b"")
        await rig.drained()
        relay.silence("up")
        await publish(rig, "r2d2/events/map", bytes(12_000_000))  # more than the system takes
        came = rig.status().received
        for number in range(60_000):
            visit.send(Publish("fleet/r2d2/nobody", b"", 1, False, False, number + 1))
        seen: list[int] = []
        while len(seen) < 2 or seen[-1] > seen[-2]:
            seen.append(rig.status().received - came)
            await asyncio.sleep(1)
        # With four bytes for each of them.
        assert (64 << 10) / 4 < seen[-1] < (64 << 10) / 4 + 2000
        assert len(fleet.visits) == 1
        relay.release()
        await until(lambda: rig.status().received - came == 60_000, "the rest")
        await rig.drained()


@pytest.mark.parametrize(
    "limits",
    [
        {Property.RECEIVE_MAXIMUM: 1},
        {Property.MAXIMUM_QOS: 0},
        {Property.MAXIMUM_QOS: 1, Property.RETAIN_AVAILABLE: 0},
        {Property.SERVER_KEEP_ALIVE: 1},
        {Property.MAXIMUM_PACKET_SIZE: 200},
        {Property.WILDCARD_SUBSCRIPTION_AVAILABLE: 0},
        {Property.SUBSCRIPTION_IDENTIFIER_AVAILABLE: 0},
        {Property.TOPIC_ALIAS_MAXIMUM: 3},
    ],
    ids=str,
)
async def test_limits_of_connack_hold(tmp_path: Path, limits: dict[Property, object]) -> None:
    async with FakeFleet(limits=limits) as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        await until(lambda: rig.status().connected)
        await publish(rig, "r2d2/events/door", *[b"%d" % n for n in range(20)], b"x" * 300)
        await publish(rig, "r2d2/state/battery", b"1", retain=True)
        await until(lambda: rig.status().waiting == rig.status().too_large)
        assert rig.status().too_large == (Property.MAXIMUM_PACKET_SIZE in limits)
        assert not fleet.faults
        assert payloads(fleet, "fleet/r2d2/events/door")[:20] == [b"%d" % n for n in range(20)]


async def test_a_fleet_that_knows_3_1_1_alone_is_spoken_to_in_it(tmp_path: Path) -> None:
    async with FakeFleet(versions=(V311,)) as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        await rig.connected()
        assert rig.status().version == "3.1.1"
        await publish(rig, "r2d2/events/door", b"1")
        await rig.drained()
        assert payloads(fleet, "fleet/r2d2/events/door") == [b"1"]
        assert [each.version for each in fleet.connects][-1] == V311
        assert not fleet.faults


async def test_rules_that_would_go_in_a_circle_are_not_carried_in_3_1_1(tmp_path: Path) -> None:
    both = [{"topic": "cmd/#"}]
    rig = Rig(tmp_path, 0, **{"in": both, "out": both})
    async with FakeFleet(versions=(V311,)) as fleet:
        rig = Rig(tmp_path, fleet.port, **{"in": both, "out": both})
        async with running(rig):
            await until(lambda: "circle" in (rig.status().problem or ""))
            assert not rig.status().connected


async def test_it_goes_on_when_the_client_id_is_taken_over(tmp_path: Path) -> None:
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        for count in range(1, 4):
            visit = await fleet.visited(count)
            visit.send(Disconnect(ReasonCode.SESSION_TAKEN_OVER))
        await until(
            lambda: "another client has the client id 'r2d2'" in (rig.status().problem or "")
        )


async def test_rules_with_offline_keep_have_a_session_that_the_fleet_keeps(tmp_path: Path) -> None:
    rules = [{"topic": "cmd/#"}, {"topic": "mission/#", "offline": "keep"}]
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port, **{"in": rules})):
        await fleet.visited(2)
        by_id = {each.client_id: each for each in fleet.connects}
        assert set(by_id) == {"r2d2", "r2d2-keep"}
        assert by_id["r2d2"].clean_start and not by_id["r2d2-keep"].clean_start
        assert by_id["r2d2-keep"].properties[Property.SESSION_EXPIRY_INTERVAL] > 0
        assert by_id["r2d2-keep"].will is None
        filters = {visit.connect.client_id: visit.filters for visit in fleet.visits}
        assert "fleet/r2d2/mission/#" in filters["r2d2-keep"]
        assert "fleet/r2d2/mission/#" not in filters["r2d2"]


@pytest.mark.patches
async def test_a_silent_fleet_is_noticed_though_most_rounds_check_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(channel_module, "CHECKED_FOR", math.inf)  # the timer alone checks
    scenario = SCENARIOS["pingresp-never"]
    async with FakeFleet() as fleet:
        scenario.prepare(fleet)
        async with running(Rig(tmp_path, fleet.port, keep_alive="1 s")) as rig:
            await publish(rig, "r2d2/events/door", *[b"%d" % number for number in range(100)])
            await scenario.outcome(fleet)
            await until(lambda: len(fleet.visits) > 1, "another connection")


async def test_high_goes_before_what_waits(tmp_path: Path) -> None:
    out = [{"topic": "events/#"}, {"topic": "alarms/#", "priority": "high"}]
    async with FakeFleet() as fleet:
        await fleet.stop()
        async with running(Rig(tmp_path, fleet.port, out=out, window=10)) as rig:
            await publish(rig, "r2d2/events/door", *[bytes(1000) for _ in range(500)])
            await publish(rig, "r2d2/alarms/fire", b"fire")
            await fleet.start()
            await until(lambda: "fleet/r2d2/alarms/fire" in fleet.topics)
            assert fleet.topics.index("fleet/r2d2/alarms/fire") < 20
            await rig.drained()


async def test_a_full_backlog_says_no_where_it_should(tmp_path: Path) -> None:
    full = {"size": "1 MiB", "when_full": "refuse"}
    async with FakeFleet() as fleet:
        await fleet.stop()
        async with running(Rig(tmp_path, fleet.port, backlog=full)) as rig:
            codes = await publish(rig, "r2d2/events/door", *[bytes(50_000) for _ in range(50)])
            taken = codes.count(0)
            assert 15 < taken < 22 and codes[taken:] == [0x97] * (50 - taken)
            await fleet.start()
            await rig.drained()
            assert len(payloads(fleet, "fleet/r2d2/events/door")) == taken


@pytest.mark.patches
async def test_while_the_disk_stands_still_memory_is_bounded_and_nothing_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A client does not wait for PUBACK, and a node of ROS publishes as well."""
    limit, size, count = 400_000, 10_000, 300
    monkeypatch.setattr(disk_room, "UNWRITTEN_FROM_ROS", (limit // 2,) * 3)
    monkeypatch.setattr(disk_room, "UNWRITTEN_AWAITED", (limit,) * 3)
    topic, from_ros = "r2d2/events/door", "r2d2/events/ros"
    is_released = threading.Event()
    async with FakeFleet() as fleet:
        await fleet.stop()
        async with running(Rig(tmp_path, fleet.port)) as rig:
            broker = rig.app.broker
            store: Any = broker.store
            writer = store._committer._writer
            write = writer._write
            monkeypatch.setattr(writer, "_write", lambda b: (is_released.wait(), write(b)))
            flood, other = await rig.client("flood"), await rig.client("other")
            sending = asyncio.ensure_future(
                flood.send(
                    *(
                        Publish(topic, b"%d" % number + bytes(size), 1, False, False, number)
                        for number in range(1, count + 1)
                    )
                )
            )
            try:
                await until(lambda: broker.disk._waiting, "the publisher to wait")
                node = broker.attach("_node", InsideLink())
                broker.publish(Message(from_ros, b"x", 1), node)
                await other.send(Publish("r2d2/local", b"x", 1, packet_id=1))
                assert isinstance(await other.receive(), Puback)  # nobody else waits
                assert limit <= store.backlogs.unwritten < limit + 2 * size
                assert rig.status().waiting < limit // size + 2
            finally:
                is_released.set()
            await sending
            answers = [await flood.receive() for _ in range(count)]
            assert [(each.packet_id, each.reason_code) for each in answers] == [
                (number, 0) for number in range(1, count + 1)
            ]
            await fleet.start()
            await rig.drained()
            numbers = [int(each[:-size]) for each in payloads(fleet, f"fleet/{topic}")]
            assert numbers == list(range(1, count + 1))
            assert not payloads(fleet, f"fleet/{from_ros}")  # nobody was acknowledged for it
            assert rig.status().dropped == {"r2d2/events/#": {"disk": 1}}


async def _work(peer: Peer, is_over: asyncio.Event) -> None:
    """A local client sends itself messages, and has each back within ten seconds."""
    number = 0
    while not is_over.is_set():
        number += 1
        await peer.send(Publish("local", b"x", 1, packet_id=number))
        for _ in range(2):
            got = await asyncio.wait_for(peer.receive(), 10)
            if isinstance(got, Publish):
                await peer.send(Puback(got.packet_id))
        await asyncio.sleep(0.05)


@pytest.mark.parametrize(
    "name", [name for name, scenario in SCENARIOS.items() if not scenario.slow]
)
async def test_whatever_the_fleet_does_harms_nobody_else(tmp_path: Path, name: str) -> None:
    scenario = SCENARIOS[name]
    async with FakeFleet() as fleet:
        scenario.prepare(fleet)
        keep_alive = "1 s" if scenario.moment == "ping" else "30 s"
        async with running(Rig(tmp_path, fleet.port, keep_alive=keep_alive)) as rig:
            peer = await rig.client("local")
            await peer.send(Subscribe(1, [Subscription("local", 1)]))
            assert isinstance(await peer.receive(), Suback)

            working = asyncio.ensure_future(_work(peer, is_over := asyncio.Event()))
            try:
                await publish(rig, "r2d2/events/door", b"1", b"2", b"3")
                await scenario.outcome(fleet)
                fleet.acknowledge = accept  # some never do
                assert not rig.app.broker.faults.count, rig.app.broker.faults.last
            finally:
                is_over.set()
                await working
                peer.hang_up()
            if scenario.duty != "stays":
                await rig.drained()
                assert set(payloads(fleet, "fleet/r2d2/events/door")) == {b"1", b"2", b"3"}
            assert not fleet.errors


async def test_a_small_limit_for_a_while_loses_nothing(tmp_path: Path) -> None:
    async with FakeFleet() as fleet, running(Rig(tmp_path, fleet.port)) as rig:
        await fleet.visited()
        await fleet.stop()
        fleet.limits = {Property.MAXIMUM_PACKET_SIZE: 300}
        await fleet.start()
        await fleet.visited(2)
        large = [str(number).encode().ljust(500) for number in range(20)]
        await publish(rig, "r2d2/events/door", *large, b"small")
        await until(lambda: payloads(fleet, "fleet/r2d2/events/door") == [b"small"])
        await until(lambda: rig.status().waiting == 20, "its acknowledgement")
        assert rig.status().too_large == 20
        assert not rig.status().set_aside
        await fleet.stop()
        fleet.limits = {}
        await fleet.start()
        await until(lambda: payloads(fleet, "fleet/r2d2/events/door") == [b"small", *large])
        await rig.drained()
        assert not fleet.faults
