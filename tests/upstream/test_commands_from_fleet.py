"""A robot that a fleet drives over a link: late commands do not reach ROS, and it stops in time.

The bridge, its routes and the broker are the real ones, on a FakeNode.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from functools import partial
from pathlib import Path

import pytest
from waiting import until

from appliance.mqtt.reason import ReasonCode
from appliance.ros import bridge
from appliance.ros.bridge import TopicSettings
from appliance.ros.topics.rules import CommandRules, OnSilence
from appliance.upstream.in_session import LOOK_INTERVAL
from appliance.upstream.late import LEAST_WINDOW, Verdict
from appliance.upstream.readiness import GIVES_UP, PATIENCE

pytest.importorskip("geometry_msgs.msg")
from bridge_harness import TWIST, Harness
from command_harness import AFTER, GO, STOP, CommandHarness, twist

from .local_rig import Fleet, Rig

KEYS = """\
user: upstream, out: [], in: [{topic: cmd_vel, late: 500 ms}, {topic: "reset/#"},
{topic: "mission/#", offline: keep}]"""
TOPIC = "fleet/r2d2/cmd_vel"


class Robot(CommandHarness):
    """A robot with a route for commands, and a link to a fleet."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.loop = asyncio.get_running_loop()
        self.rig = Rig(folder, acl="user upstream\ntopic readwrite #\n", keys=KEYS, robot="r2d2")
        self.broker = self.rig.broker
        self.rig.now = self.loop.time()
        self.broker.tick(self.rig.now)
        self.rig.begin()

    def join(self) -> Fleet:
        self.rig.now = self.loop.time()
        return self.rig.connect()

    def say(self, fleet: Fleet, payload: bytes = GO, qos: int = 0, topic: str = TOPIC) -> int:
        """A command that has come over the connection just now."""
        self.rig.now = self.loop.time()
        return fleet.send(topic, payload, qos)

    async def drive(self, fleet: Fleet, seconds: float, qos: int = 0) -> None:
        """Steer at 20 Hz, with a PINGREQ each time that is answered at once."""
        end = self.loop.time() + seconds
        while self.loop.time() < end:
            self.rig.now = self.loop.time()
            fleet.ping()
            self.say(fleet, qos=qos)
            await asyncio.sleep(0.05)


@pytest.fixture
async def robot(tmp_path: Path) -> AsyncIterator[Robot]:
    robot = Robot(tmp_path)
    yield robot
    await robot.bridge.stop()
    assert not robot.broker.guards


@pytest.mark.parametrize("qos", [0, 1])
async def test_the_robot_stops_when_the_link_ends(robot: Robot, qos: int) -> None:
    robot.start(CommandRules(expire=0.5, on_silence=OnSilence(60.0)))
    fleet = robot.join()
    received = robot.robot.received
    while not received:
        await robot.drive(fleet, 0.2, qos)
    assert set(received) == {twist(0.5)}
    fleet.session.detach()
    assert received[-1] == STOP and robot.counters().stops == 1  # at once
    # And what was on its way behind it does not start it again.
    robot.say(fleet)
    assert received[-1] == STOP


async def test_the_robot_stops_when_the_fleet_falls_silent(robot: Robot) -> None:
    robot.start(CommandRules(expire=0.5, on_silence=OnSilence(AFTER)))
    fleet = robot.join()
    while twist(0.5) not in robot.robot.received:
        await robot.drive(fleet, 0.2)
    await until(lambda: robot.robot.received[-1] == STOP, "the robot to stop")
    assert robot.counters().stops and not fleet.connection.closed


@pytest.mark.parametrize("qos", [0, 1])
async def test_a_thousand_late_commands_never_reach_ros(robot: Robot, qos: int) -> None:
    """A network that was silent for ten seconds, and then hands over all that it has held."""
    robot.start(CommandRules(expire=0.5, on_silence=OnSilence(AFTER)))
    fleet = robot.join()
    while not robot.robot.received:
        await robot.drive(fleet, 0.2, qos)
    await until(lambda: robot.robot.received[-1] == STOP, "the robot to stop")
    robot.rig.now = robot.loop.time()
    fleet.ask()  # is lost in the silence, and answered after it
    await asyncio.sleep(0.6)  # as ten seconds: longer than `late`
    expired = robot.counters().expired
    received = list(robot.robot.received)  # a command that was held has been carried out by now
    for number in range(1000):
        if number == LEAST_WINDOW:  # what was in flight when the network fell silent, and the rest
            fleet.answer()
        robot.say(fleet, qos=qos)
        while fleet.connection.turn_in is not None:
            fleet.turn()
    assert robot.robot.received == received
    late = robot.rig.counters.dropped["fleet/r2d2/cmd_vel", Verdict.LATE]
    assert late == 1000 and robot.counters().expired == expired
    # Then there is a new PINGREQ, and somebody steers again.
    while twist(0.5) not in robot.robot.received[len(received) :]:
        await robot.drive(fleet, 0.2, qos)


async def test_a_command_is_judged_again_by_its_route(robot: Robot) -> None:
    """By a route that is stricter than the rule: with the greatest age that it can have."""
    robot.start(CommandRules(expire=0.1))
    robot.rig.now = robot.loop.time() - 0.2
    fleet = robot.rig.connect()
    robot.say(fleet)
    await asyncio.sleep(0.3)
    assert robot.robot.received == [] and robot.counters().expired == 1


async def test_a_retained_command_of_the_fleet_is_dropped(robot: Robot) -> None:
    """It does not reach ROS, and no local subscriber takes it for a new one."""
    peer = robot.rig.join("other", user="upstream")
    peer.subscribe("r2d2/cmd_vel")
    for rules in (None, CommandRules(), CommandRules(expire=0.5)):
        robot.start(rules)
        fleet = robot.join()
        assert fleet.send(TOPIC, GO, 1, retain=True) == 0
        await robot.settle()
        assert robot.robot.received == [] and peer.received() == []
        assert robot.broker.retained.get("r2d2/cmd_vel") is None
        fleet.session.detach()
        await robot.bridge.stop()
    assert robot.rig.counters.dropped["fleet/r2d2/cmd_vel", Verdict.RETAINED] == 3


async def test_a_route_that_asks_for_retained_commands_gets_them(robot: Robot) -> None:
    robot.start(CommandRules(take_retained=True))
    for _ in range(3):  # until the two ends have found each other
        robot.node.spin()
    fleet = robot.join()
    assert fleet.send(TOPIC, GO, 1, retain=True) == 0
    await until(lambda: twist(0.5) in robot.robot.received, "the command")
    kept = robot.broker.retained.get("r2d2/cmd_vel")
    assert kept is not None and kept.payload == GO
    fleet.send(TOPIC, b"", 1, retain=True)
    assert robot.broker.retained.get("r2d2/cmd_vel") is None


MISSION = "fleet/r2d2/mission/go"


@pytest.mark.parametrize("ros", ["/mission/go", "/mission/*"])
async def test_a_kept_mission_waits_for_ros(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, ros: str
) -> None:
    """It came while the robot's nodes were starting: nothing that is acknowledged is lost."""
    route = TopicSettings(ros, "ros", "r2d2{ros}", TWIST if ros == "/mission/go" else None)
    start = robot.node.start
    begin: list[Callable[[], None]] = []
    monkeypatch.setattr(robot.node, "start", lambda *how: begin.append(partial(start, *how)))
    Harness.start(robot, route)
    robot.rig.now = robot.loop.time()
    fleet = robot.rig.connect(is_kept=True)
    missions = [fleet.put(topic, GO) for topic in (MISSION, MISSION, "fleet/r2d2/mission/other")]
    fleet.turn(LOOK_INTERVAL)
    assert fleet.connection.codes() == [] and fleet.connection.turn_in == LOOK_INTERVAL
    assert fleet.session.waiting == 3
    begin[0]()
    node = robot.node.add_subscriber("/mission/go", TWIST)
    await until(lambda: not robot.broker.obstacle("r2d2/mission/go"), "the subscription")
    assert node.received == []
    fleet.turn(LOOK_INTERVAL)
    if ros == "/mission/*":  # what else is there may yet be found
        assert fleet.session.waiting == 1
        monkeypatch.setattr(bridge, "DISCOVERY", 0.0)
        fleet.turn(LOOK_INTERVAL)
    assert node.received == [twist(0.5)] * 2
    assert fleet.connection.codes() == [(each, 0) for each in missions]


async def test_a_mission_for_a_node_that_is_not_there_waits_in_vain_once(
    robot: Robot, caplog: pytest.LogCaptureFixture
) -> None:
    Harness.start(robot, TopicSettings("/mission/go", "ros", "r2d2{ros}", TWIST))
    robot.rig.now = robot.loop.time()
    fleet = robot.rig.connect(is_kept=True)
    first = fleet.put(MISSION, GO)
    fleet.turn(PATIENCE - 1)
    assert fleet.connection.codes() == []
    fleet.turn(1)
    assert fleet.connection.codes() == [(first, 0)]
    assert fleet.send(MISSION, GO) == 0  # at once
    assert "waits for ROS (no node has subscribed to /mission/go)" in caplog.text
    assert GIVES_UP in caplog.text
    # With a node, and without it again: that it comes back is likely.
    node = robot.node.add_subscriber("/mission/go", TWIST)
    assert fleet.send(MISSION, GO) == 0 and node.received == [twist(0.5)]
    node.remove()
    fleet.put(MISSION, GO)
    fleet.turn(LOOK_INTERVAL)
    assert fleet.connection.codes() == [] and fleet.session.waiting == 1


async def test_the_fleet_holds_the_lease_and_loses_it_with_the_link(robot: Robot) -> None:
    robot.start(CommandRules(exclusive=True, lease=600, on_silence=OnSilence(600.0)))
    fleet = robot.join()
    peer = robot.rig.join("other", user="upstream")
    while not robot.robot.received:
        await robot.drive(fleet, 0.2)
    assert robot.counters().commanding == (("/cmd_vel", "_upstream_in.fleet"),)
    assert peer.publish("r2d2/cmd_vel", GO, 1) == 0x87
    fleet.session.detach()
    assert robot.counters().commanding == ()
    assert peer.publish("r2d2/cmd_vel", GO, 1) == 0


async def test_a_fleet_that_does_not_answer_any_more_is_disconnected(robot: Robot) -> None:
    """What it has on its way is late when it comes, and nothing in it shows that."""
    robot.start(CommandRules(on_silence=OnSilence(AFTER, "{}", disconnect=True)))
    fleet = robot.join()
    while not robot.robot.received:
        await robot.drive(fleet, 0.2)
    # A late wake-up of `drive` may have been a silence, too, with a probe that a command forgets.
    robot.rig.now = robot.loop.time()
    fleet.ping()
    robot.say(fleet)
    probes = fleet.connection.probes
    fleet.connection.silence = 60.0
    await until(lambda: bool(fleet.connection.closed), "the end of the connection")
    assert fleet.connection.probes == probes + 1
    assert [code for code, _ in fleet.connection.closed] == [ReasonCode.ADMINISTRATIVE_ACTION]
