"""What holds for commands on their way to ROS, on a FakeNode and the real broker."""

from __future__ import annotations

import asyncio
import logging
import math
import struct
import time
from dataclasses import replace
from itertools import count, pairwise

import pytest
from waiting import until
from zstandard import ZstdCompressor

from appliance.broker.accounting import Accounting
from appliance.broker.broker import Broker
from appliance.broker.link import PeerStatus
from appliance.broker.message import DelayedMessage, Message
from appliance.broker.values import Action, Decision
from appliance.host import clock
from appliance.mqtt.codec import Property, decode_varint
from appliance.mqtt.packets import (
    Disconnect,
    Puback,
    Publish,
    Pubrel,
    Subscribe,
    Subscription,
    Will,
    decode_packet,
)
from appliance.ros.bridge import TopicSettings
from appliance.ros.calls.dispatcher import Answer, CallCounters, CallEndpoint
from appliance.ros.calls.replay_guard import ReplayGuard
from appliance.ros.node import BusError, Durability, Endpoint, FakePeer, QosProfile
from appliance.ros.payload.converter import Converter
from appliance.ros.payload.fallback import ConversionError
from appliance.ros.payload.payloads import ZSTD_MAGIC
from appliance.ros.topics import commands, conversions, lease
from appliance.ros.topics.commands import Commands
from appliance.ros.topics.conversions import LITTLE
from appliance.ros.topics.lease import REPEATED
from appliance.ros.topics.rules import CommandRules, FieldLimits, OnSilence
from appliance.ros.topics.staleness import (
    EXPECTED,
    STEADY,
    WAIT,
    WITHHOLD,
    CommandVerdict,
    StalenessDetector,
    sent_at,
)
from appliance.store import MemoryStore

pytest.importorskip("geometry_msgs.msg")
from bridge_harness import INT, STRING, TWIST, Client, Harness
from command_harness import (
    AFTER,
    FLOAT,
    GO,
    STOP,
    TOPIC,
    All,
    AllAllowed,
    CommandHarness,
    Driver,
    Wire,
    twist,
)

from appliance.ros.payload.definitions import load_description


@pytest.fixture
async def harness():
    harness = CommandHarness()
    harness.broker = Broker(AllAllowed(), MemoryStore())
    harness.client = Client(harness.broker)
    yield harness
    await harness.bridge.stop()
    assert harness.broker.departures == []
    assert harness.broker.guards == {}


# Old commands


async def test_message_expiry(harness):
    harness.start(CommandRules(expire=0.5))
    driver = Driver(harness.broker, "a")
    driver.steer(properties={Property.MESSAGE_EXPIRY_INTERVAL: 1})
    driver.steer(properties={Property.MESSAGE_EXPIRY_INTERVAL: 0})
    assert harness.robot.received == [twist(0.5)]
    assert harness.counters().expired == 1
    assert [topic.expired for topic in harness.bridge.topics()] == [1]


async def test_what_is_sent_again_is_old(harness):
    harness.start(CommandRules(expire=1.0))
    driver = Driver(harness.broker, "a")
    driver.drive(qos=1, dup=True)
    driver.drive(qos=1, dup=True, properties={Property.CONTENT_TYPE: "application/json"})
    assert harness.robot.received == []
    assert harness.counters().expired == 2
    # And so is what comes right behind it: its client had it in a queue.
    driver.drive(b'{"linear":{"x":9}}', qos=1)
    assert harness.robot.received == []
    Driver(harness.broker, "b").steer(b'{"linear":{"x":1}}')
    await asyncio.sleep(1.01)
    driver.drive(qos=1)
    await until(lambda: harness.robot.received == [twist(1), twist(0.5)])


class Asks(AllAllowed):
    """As a topic plugin that asks over HTTP: it has no answer yet, and then allows all."""

    timeout = 60.0

    def __init__(self, action):
        self.action = action
        self.has_answered = False

    def decide(self, identity, action, topic):
        if action is self.action and not self.has_answered:
            return Decision(False, "asked", pending=True)
        return super().decide(identity, action, topic)

    def is_pending(self, query, wake):
        return not self.has_answered


def asks(harness, action):
    """Install a plugin that has to ask; returns a function that answers after some seconds."""
    plugin = Asks(action)
    harness.broker.access = plugin
    harness.broker.router.pending_decisions = plugin

    def answer(driver, seconds):
        plugin.has_answered = True
        harness.broker.router.changed()
        harness.broker.accounting.now += seconds
        driver.client.send_on()
        harness.broker.flush()

    return answer


@pytest.mark.parametrize("expiry", [None, 5])
@pytest.mark.parametrize(("seconds", "is_old"), [(0.0, False), (1.5, True)])
@pytest.mark.parametrize("qos", [0, 1, 2])
async def test_a_command_that_waited_for_a_plugin_is_as_old_as_the_wait(
    harness, expiry, seconds, is_old, qos
):
    harness.start(CommandRules(expire=0.2))
    answer = asks(harness, Action.PUBLISH)
    driver = Driver(harness.broker, "a")
    properties = {Property.MESSAGE_EXPIRY_INTERVAL: expiry} if expiry else None
    driver.drive(qos=qos, properties=properties)
    answer(driver, seconds)
    if qos == 2:
        driver.say(Pubrel(7))
    if not is_old:
        await until(lambda: harness.robot.received == [twist(0.5)])
    else:
        await asyncio.sleep(0.3)  # which a command that comes alone waits at most
        assert harness.robot.received == []
        assert harness.counters().expired == 1


async def test_a_command_behind_what_waited_for_a_plugin_is_as_old_as_the_wait(harness):
    harness.start(CommandRules(expire=0.2))
    answer = asks(harness, Action.SUBSCRIBE)
    driver = Driver(harness.broker, "a")
    driver.say(Subscribe(1, [Subscription("x", 0)]))
    driver.drive()
    answer(driver, 1.5)
    assert harness.counters().expired == 1
    await asyncio.sleep(0.3)
    driver.steer(b'{"linear":{"x":1}}')
    await until(lambda: harness.robot.received == [twist(1)])


async def test_a_message_expires_while_it_waits_for_a_plugin(harness):
    """[MQTT-3.3.2-5]: the interval begins when it comes."""
    harness.start(CommandRules())
    harness.client.subscribe("x")
    answer = asks(harness, Action.PUBLISH)
    driver = Driver(harness.broker, "a")
    properties = {Property.MESSAGE_EXPIRY_INTERVAL: 1}
    driver.say(Publish("x", b"", qos=1, packet_id=7, properties=properties))
    answer(driver, 1.5)
    assert harness.client.received == []
    assert driver.wire.written == Puback(7).encode(5)


async def test_a_qos_2_command_that_waited_before_its_pubrec_and_after_it(harness):
    harness.start(CommandRules(expire=0.5))
    answer = asks(harness, Action.PUBLISH)
    driver = Driver(harness.broker, "a")
    driver.drive(qos=2)
    answer(driver, 1.5)
    await asyncio.sleep(0.15)  # which alone is old, too, but not too old
    driver.say(Pubrel(7))
    assert harness.counters().expired == 1


async def test_without_expire_all_is_published(harness):
    harness.start(CommandRules(exclusive=True))
    Driver(harness.broker, "a").drive(qos=1, dup=True)
    assert harness.robot.received == [twist(0.5)]


async def test_a_qos_2_command_is_as_old_as_its_publish(harness):
    harness.start(CommandRules(expire=0.15))
    driver = Driver(harness.broker, "a", expiry=100)
    driver.drive(qos=2)
    driver.say(Pubrel(7))
    await until(lambda: harness.robot.received == [twist(0.5)])
    driver.drive(b'{"linear":{"x":2}}', qos=2)
    await asyncio.sleep(0.16)
    driver.say(Pubrel(7))
    assert harness.counters().expired == 1
    await asyncio.sleep(0.16)
    driver.drive(b'{"linear":{"x":3}}', qos=2)
    driver.cut()
    again = Driver(harness.broker, "a", clean=False, expiry=100)
    again.say(Pubrel(7))
    assert harness.counters().expired == 2
    assert len(harness.robot.received) == 1


async def test_what_two_clients_had_queued_is_old_of_both(harness):
    harness.start(CommandRules(expire=0.5))
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    # At one moment, however long it takes here: a pause would be that of a stream that begins.
    harness.broker.accounting.now = asyncio.get_running_loop().time()
    for driver in (a, b):
        driver.client.receive(Publish(TOPIC, GO, qos=1, packet_id=7, dup=True).encode(5))
    for driver in (a, b):
        driver.client.receive(Publish(TOPIC, GO).encode(5))
    assert harness.robot.received == []
    assert harness.counters().expired == 4
    a.cut()
    Driver(harness.broker, "a").drive()
    await until(lambda: harness.robot.received == [twist(0.5)])


async def test_a_will_is_as_old_as_its_connection(harness):
    harness.start(CommandRules(expire=0.5))
    driver = Driver(harness.broker, "a", will=Will(TOPIC, GO))
    driver.cut()
    assert harness.robot.received == []
    assert harness.counters().expired == 1


async def test_retained_commands_only_where_asked_for(harness):
    harness.client.send(TOPIC, GO, retain=True)
    harness.start(CommandRules(expire=0.5))
    harness.node.spin()
    await harness.settle()
    assert harness.robot.received == []
    harness.bridge.replace(
        [TopicSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=CommandRules(take_retained=True))]
    )
    for _ in range(3):
        harness.node.spin()
        await harness.settle()
    assert harness.robot.received == [twist(0.5)]


async def test_a_retained_command_of_unknown_age_is_old_where_commands_expire(harness):
    harness.client.send(TOPIC, GO, retain=True)
    harness.start(CommandRules(expire=0.5, take_retained=True))
    for _ in range(3):
        harness.node.spin()
        await harness.settle()
    assert harness.robot.received == []
    assert harness.counters().expired == 1


async def test_late_messages_are_as_others_to_other_clients(harness):
    harness.start(CommandRules(expire=0.5))
    harness.client.subscribe("r2d2/#")
    driver = Driver(harness.broker, "a")
    properties = {Property.USER_PROPERTY: [("a", "b")]}
    driver.drive(qos=1, dup=True, properties=properties)
    message, qos = harness.client.received[-1]
    assert isinstance(message, DelayedMessage)
    assert (message.payload, message.properties, qos) == (GO, properties, 1)


# One at a time


async def test_one_client_at_a_time(harness, caplog):
    caplog.set_level(logging.INFO)
    harness.start(CommandRules(exclusive=True, lease=0.1))
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    old = Driver(harness.broker, "old", version=4)
    a.drive(qos=1)
    assert a.code == 0
    b.drive(b'{"linear":{"x":9}}', qos=1)
    assert b.code == 0x87
    old.drive(b'{"linear":{"x":9}}')  # 3.1.1 and QoS 0 cannot be told
    assert harness.robot.received == [twist(0.5)]
    assert harness.counters().refused == 2
    (topic,) = harness.bridge.topics()
    assert (topic.messages, topic.refused, topic.errors) == (1, 2, 0)
    assert "client 'a' (user 'user') commands /cmd_vel, and the route is exclusive" in caplog.text
    # For as long as it goes on.
    for _ in range(4):
        await asyncio.sleep(0.05)
        a.drive()
        b.drive(b'{"linear":{"x":9}}')
    assert set(harness.robot.received) == {twist(0.5)}
    # On a busy computer it may have ended before, and have been taken again.
    await until(lambda: harness.commands.commanding is None, "the end of the lease")
    # What is logged is handed to the loop, behind what it is about.
    told = "was silent for 0.1 s and commands no more"
    await until(lambda: told in caplog.text, "a line about it")
    b.wire.written = b""
    b.drive(b'{"linear":{"x":0.2}}', qos=1)
    assert b.code == 0
    assert harness.robot.received[-1] == twist(0.2)
    a.wire.written = b""
    a.drive(qos=1)
    assert a.code == 0x87


@pytest.mark.parametrize("qos", [1, 2])
@pytest.mark.parametrize("command", [Driver.drive, Driver.steer])
async def test_who_is_refused_for_a_lease_is_told_who_holds_it(harness, qos, command):
    harness.start(CommandRules(exclusive=True, lease=60))
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    a.drive()
    command(b, qos=qos)
    packet = decode(b.wire.written)
    assert packet.reason_code == 0x87
    assert "client 'a'" in packet.properties[Property.REASON_STRING]
    assert "/cmd_vel, and the route is exclusive" in packet.properties[Property.REASON_STRING]


@pytest.mark.parametrize("qos", [1, 2])
async def test_who_may_not_command_is_not_told_who_does(harness, monkeypatch, qos):
    harness.start(CommandRules(exclusive=True, lease=60))
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    a.drive()

    def decide(identity, action, topic):
        return Decision(identity.client_id != "b", "no rule lets it")

    monkeypatch.setattr(harness.broker.access, "decide", decide)
    harness.broker.router.changed()
    b.drive(qos=qos)
    packet = decode(b.wire.written)
    assert packet.reason_code == 0x87
    assert "'a'" not in str(packet.properties)


async def test_who_commands_is_announced_soon(harness):
    bridge = harness.start(CommandRules(exclusive=True, lease=60))
    bridge._meter_timer.cancel()  # which announces every 10 s
    await until(lambda: harness.bridge.topics())

    def commanding():
        return [route.get("rules", {}).get("commanding") for route in harness.routes()]

    await until(lambda: commanding() == [None], "the first announcement")
    a = Driver(harness.broker, "a")
    a.drive()
    a.leave()
    b = Driver(harness.broker, "b")
    b.drive()
    await until(lambda: commanding() == ["b"], "who commands")
    routes = harness.client.payloads("r2d2/_appliance/routes")
    assert not any(b'"commanding":"a"' in payload for payload in routes), "one of two changes"
    b.cut()
    await until(lambda: commanding() == [None], "that nobody does")


async def test_who_commands_is_announced_after_a_fault_too(harness, monkeypatch, escaped):
    harness.start(CommandRules(exclusive=True, lease=60))
    a = Driver(harness.broker, "a")
    await until(lambda: harness.routes())
    faults = harness.broker.faults
    with monkeypatch.context() as broken:
        broken.setattr(harness.bridge, "_announce", lambda: 1 / 0)
        a.drive()
        await until(lambda: faults.by_entry.get("bridge.announce") == 1, "a fault")
    a.cut()
    Driver(harness.broker, "b").drive()
    await until(lambda: harness.routes()[0]["rules"].get("commanding") == "b", "who commands")
    escaped.clear()


async def test_a_lease_ends_with_the_connection(harness):
    harness.start(CommandRules(exclusive=True, lease=60))
    a, b = Driver(harness.broker, "a", expiry=100), Driver(harness.broker, "b")
    a.drive()
    b.drive(b"{}", qos=1)
    assert b.code == 0x87
    a.cut()
    b.wire.written = b""
    b.drive(b"{}", qos=1)
    assert b.code == 0
    assert harness.robot.received == [twist(0.5), STOP]


async def test_refused_commands_reach_nobody_else(harness):
    harness.start(CommandRules(exclusive=True))
    harness.client.subscribe(TOPIC)
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    a.drive()
    b.drive(b"nobody sees it", qos=1)
    assert harness.client.payloads(TOPIC) == [GO]


async def test_a_qos_2_command_whose_lease_was_lost_meanwhile(harness):
    harness.start(CommandRules(exclusive=True))
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    a.drive(qos=2)
    b.drive(b'{"linear":{"x":9}}')
    a.say(Pubrel(7))
    assert harness.robot.received == [twist(9)]


async def test_what_ros_says_on_a_topic_of_both_ways_needs_no_lease(harness):
    rules = CommandRules(exclusive=True)
    Harness.start(harness, TopicSettings("/cmd_vel", "both", TOPIC, TWIST, rules=rules))
    harness.client.subscribe(TOPIC)
    other = harness.node.add_publisher("/cmd_vel", TWIST)
    Driver(harness.broker, "a").drive()
    other.publish(twist(0.25))
    await harness.settle()
    assert [p for p in harness.client.payloads(TOPIC) if b"0.25" in p]


# Silence


@pytest.mark.timed
async def test_the_stop_message_follows_silence_in_time(harness, caplog):
    harness.start(CommandRules(on_silence=OnSilence(AFTER)))
    driver = Driver(harness.broker, "a")
    for _ in range(5):
        driver.steer()
        last = time.monotonic()
        await asyncio.sleep(AFTER / 2)
    assert harness.robot.received == [twist(0.5)] * 5
    await until(lambda: harness.robot.received[-1] == STOP)
    assert AFTER <= time.monotonic() - last < AFTER + 0.05
    await asyncio.sleep(2 * AFTER)
    assert len(harness.robot.received) == 6  # once
    assert harness.counters().stops == 1
    assert "fell silent for 0.1 s" in caplog.text


@pytest.mark.parametrize("disconnect", [True, False])
async def test_who_rests_before_it_drives_is_stopped_as_early(harness, disconnect):
    """Who holds the lease rests: the timer waits for the lease's end, which is long after."""
    rules = CommandRules(exclusive=True, lease=600, on_silence=OnSilence(AFTER, "{}", disconnect))
    harness.start(rules)
    driver, flow = Driver(harness.broker, "a"), harness.commands
    driver.wire.connection = PeerStatus(silence=0.0)
    driver.steer()
    driver.steer(b"{}")
    await until(lambda: flow._timer.when() > flow._commanded_at + 500)
    driver.steer()
    await until(lambda: harness.counters().stops == 1)
    assert harness.robot.received == [twist(0.5), STOP, twist(0.5), STOP]
    assert flow.commanding == "a"


async def test_a_lease_that_ends_before_the_silence_is_too_long_is_seen_in_time(harness):
    """The timer was set for a command that nobody has the lease for: a retained one."""
    harness.start(CommandRules(exclusive=True, lease=AFTER, on_silence=OnSilence(600)))
    harness.commands._on_commanded(twist(0.5), None)
    driver = Driver(harness.broker, "a")
    driver.steer()
    assert harness.commands.commanding == "a"
    await until(lambda: harness.commands.commanding is None)


@pytest.mark.parametrize("lease", [AFTER / 2, 600])
async def test_the_timer_is_for_what_is_due_first(harness, lease):
    rules = CommandRules(exclusive=True, lease=lease, on_silence=OnSilence(AFTER, "{}", False))
    harness.start(rules)
    driver = Driver(harness.broker, "a")
    driver.steer()
    flow = harness.commands
    assert flow._timer.when() == flow._commanded_at + min(lease, AFTER)
    # Steady driving sets no timer for each command.
    timer = flow._timer
    driver.steer()
    assert flow._timer is timer


@pytest.fixture
def impatient(monkeypatch):
    """Who is asked for an answer has less time for it."""
    monkeypatch.setattr(commands, "PROBE_TIMEOUT", 0.3)
    monkeypatch.setattr(commands, "PROBE_INTERVAL", 0.02)


async def test_who_falls_silent_with_its_connection_is_disconnected(harness, impatient):
    """The network may have its commands yet, which are old by then."""
    harness.start(CommandRules(on_silence=OnSilence(AFTER)))
    driver = Driver(harness.broker, "a")
    driver.steer()
    await until(lambda: driver.wire.closed)
    assert driver.wire.probed
    assert driver.wire.written == Disconnect(0x98).encode(5)
    driver.drive()
    assert harness.robot.received == [twist(0.5), STOP]
    driver = Driver(harness.broker, "a")
    driver.drive()  # what it had queued, perhaps
    assert harness.counters().expired == 1
    await asyncio.sleep(AFTER + 0.02)
    driver.drive()
    await until(lambda: harness.robot.received[2:3] == [twist(0.5)])  # and soon is stopped again


async def test_who_is_silent_on_a_connection_that_lives_gets_the_stop_message_and_stays(
    harness, impatient
):
    """A button, Node-RED, the bridge of a mosquitto: they have nothing to say for now."""
    harness.start(CommandRules(on_silence=OnSilence(AFTER)))
    driver = Driver(harness.broker, "a")

    class Answering(Wire):
        def probe(self):
            super().probe()
            self.connection = PeerStatus(silence=0.0)

    driver.wire.__class__ = Answering
    for round_ in range(1, 4):
        driver.wire.connection = PeerStatus(silence=math.inf)
        driver.drive()
        await until(lambda: driver.wire.probed)
        driver.wire.probed = False
        await until(lambda: not harness.commands._probed)
        await asyncio.sleep(0.4)
        assert harness.robot.received == [twist(0.5), STOP] * round_
    assert not driver.wire.closed
    assert harness.counters().expired == 0


async def test_who_answered_before_it_was_asked_is_asked(harness, impatient):
    """That its computer lived when it fell silent says nothing of now."""
    harness.start(CommandRules(on_silence=OnSilence(AFTER)))
    driver = Driver(harness.broker, "a")
    begun = time.monotonic()

    class Wire(type(driver.wire)):
        def peer_status(self):
            return PeerStatus(silence=time.monotonic() - begun)

    driver.wire.__class__ = Wire
    driver.steer()
    await until(lambda: driver.wire.closed)


@pytest.mark.parametrize("other_drives_on", [True, False])
async def test_of_two_who_drive_each_that_falls_silent_is_disconnected(
    harness, impatient, other_drives_on
):
    harness.start(CommandRules(on_silence=OnSilence(AFTER)))
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    a.steer()
    b.steer()

    def is_over():
        if other_drives_on:
            b.steer()
        return a.wire.closed

    await until(is_over)
    if not other_drives_on:
        await until(lambda: b.wire.closed)
    expired = harness.counters().expired
    Driver(harness.broker, "a").drive()  # what it had queued, perhaps
    assert harness.counters().expired == expired + 1


@pytest.mark.parametrize("stops_itself", [True, False])
async def test_who_has_stopped_or_may_be_silent_stays(harness, stops_itself):
    harness.start(CommandRules(on_silence=OnSilence(AFTER, disconnect=stops_itself)))
    driver = Driver(harness.broker, "a")
    driver.steer()
    if stops_itself:
        driver.steer(b"{}")
    await asyncio.sleep(2 * AFTER)
    assert not driver.wire.closed
    assert harness.robot.received[-1] == STOP


async def test_a_stop_message_at_another_time_is_one_too(harness):
    stamped = "geometry_msgs/msg/TwistStamped"
    harness.node.types = All()
    rules = CommandRules(on_silence=OnSilence(AFTER, '{"header": {"stamp": "now"}}'))
    harness.start(rules, type=stamped, found=stamped)
    driver = Driver(harness.broker, "a")
    driver.drive(b'{"header":{"stamp":{"sec":5},"frame_id":"base"}}')
    await until(lambda: harness.counters().stops)
    assert not driver.wire.closed
    seconds = struct.unpack_from("<i", harness.robot.received[-1], 4)[0]
    assert abs(seconds - time.time()) < 5


@pytest.mark.parametrize("expiry", [0, 100])
async def test_the_stop_message_follows_a_lost_connection_at_once(harness, expiry):
    harness.start(CommandRules(on_silence=OnSilence(60), expire=1))
    driver = Driver(harness.broker, "a", expiry=expiry, will=Will(TOPIC, GO))
    driver.steer()
    driver.cut()
    assert harness.robot.received == [twist(0.5), STOP]


async def test_who_leaves_without_having_driven_stops_nobody(harness):
    harness.start(CommandRules(on_silence=OnSilence(60)))
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    b.steer()
    a.steer()
    b.cut()
    assert harness.robot.received == [twist(0.5)] * 2
    a.say(Disconnect())
    assert harness.robot.received[-1] == STOP


async def test_a_lost_lease_stops_as_well(harness):
    harness.start(CommandRules(exclusive=True, lease=AFTER, on_silence=OnSilence(60)))
    Driver(harness.broker, "a").steer()
    await until(lambda: harness.robot.received[-1] == STOP)


async def test_once_at_the_start(harness):
    harness.start(CommandRules(on_silence=OnSilence(60)))
    harness.node.spin()
    await harness.settle()
    assert harness.robot.received == [STOP]
    for _ in range(5):
        harness.node.spin()
        await harness.settle()
    assert harness.robot.received == [STOP]
    assert harness.counters().stops == 1


async def test_a_command_that_is_there_first_is_not_stopped_by_the_start(harness):
    harness.start(CommandRules(on_silence=OnSilence(60)))
    Driver(harness.broker, "a").steer()
    for _ in range(5):
        harness.node.spin()
        await harness.settle()
    assert harness.robot.received == [twist(0.5)]


async def test_the_end_of_the_route_or_the_bridge_stops_who_is_driven(harness):
    rules = CommandRules(on_silence=OnSilence(60))
    bridge = harness.start(rules)
    told = len(harness.broker.departures)
    Driver(harness.broker, "a").steer()
    bridge.replace([TopicSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=CommandRules(expire=1))])
    assert harness.robot.received == [twist(0.5), STOP]
    assert len(harness.broker.departures) == told
    harness.node.spin()
    bridge.replace([TopicSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=rules)])
    harness.node.spin()
    Driver(harness.broker, "b").steer()
    await bridge.stop()
    assert harness.robot.received == [twist(0.5), STOP, twist(0.5), STOP]


async def test_who_fell_silent_is_disconnected_though_its_route_has_changed(harness, impatient):
    bridge = harness.start(CommandRules(on_silence=OnSilence(AFTER)))
    stalled, gone = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    gone.steer()
    gone.cut()
    stalled.steer()
    rules = CommandRules(on_silence=OnSilence(2 * AFTER))
    bridge.replace([TopicSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=rules)])
    await until(lambda: stalled.wire.closed)
    harness.node.spin()
    expired = harness.counters().expired
    for name in ("a", "b"):
        Driver(harness.broker, name).drive()  # what they had queued, perhaps
    assert harness.counters().expired == expired + 2


async def test_a_lease_and_a_driver_survive_a_reload(harness):
    rules = CommandRules(exclusive=True, on_silence=OnSilence(60))
    settings = TopicSettings("/cmd_vel", "ros", "r2d2{ros}", TWIST, rules=rules)
    bridge = harness.start(rules)
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    a.steer()
    bridge.replace([settings, TopicSettings("/new", "mqtt", "r2d2{ros}")])
    harness.node.spin()
    b.steer(qos=1)
    assert b.code == 0x87
    assert harness.robot.received == [twist(0.5)]
    a.cut()
    assert harness.robot.received == [twist(0.5), STOP]


async def test_a_stop_message_that_ros_does_not_take_is_tried_until_it_does(harness):
    harness.start(CommandRules(on_silence=OnSilence(60)))
    driver = Driver(harness.broker, "a")
    driver.steer()
    (publisher,) = harness.node.own_publishers
    publisher.error = "the transport is full"
    driver.cut()
    await asyncio.sleep(0.12)
    assert harness.robot.received == [twist(0.5)]
    publisher.error = None
    await until(lambda: harness.robot.received[-1] == STOP)


async def test_a_stop_message_that_is_due_while_its_publisher_is_set_up_anew(harness):
    bridge = harness.start(CommandRules(on_silence=OnSilence(60)))
    driver = Driver(harness.broker, "a")
    driver.steer()
    (commands,) = bridge._to_ros.values()
    follower = commands.follower
    publication = follower.publication
    follower.publication = replace(publication, outlet=None)
    driver.cut()
    await asyncio.sleep(0.06)
    assert harness.robot.received == [twist(0.5)]
    follower.publication = publication
    await until(lambda: harness.robot.received[-1] == STOP)


async def test_when_ros_is_lost_there_is_nobody_to_be_stopped(harness):
    harness.start(CommandRules(on_silence=OnSilence(AFTER)))
    driver = Driver(harness.broker, "a")
    driver.steer()
    harness.node.fail("gone")
    await asyncio.sleep(2 * AFTER)
    assert harness.robot.received == [twist(0.5)]


@pytest.mark.parametrize(
    ("stop", "problem"),
    [
        ('{"linear":{"q":1}}', "linear.q: unknown field"),
        (f'{{"linear":{{"x":{10**400}}}}}', "not JSON: number is infinity"),
    ],
)
async def test_a_stop_message_that_the_type_has_not_is_told(harness, caplog, stop, problem):
    harness.start(CommandRules(on_silence=OnSilence(1, stop)))
    await harness.settle()
    assert f"on_silence.publish: {problem}" in caplog.text
    Driver(harness.broker, "a").drive()
    assert harness.robot.received == []


# Fields


async def test_numbers_are_clamped(harness, caplog):
    rules = CommandRules(clamp=(("linear.x", -0.5, 1.0), ("angular.z", 0.0, 0.0)))
    harness.start(rules)
    driver = Driver(harness.broker, "a")
    for x in (0.25, 7, -7, 1e308):
        driver.drive(b'{"linear":{"x":%r},"angular":{"z":1}}' % x)
    assert harness.robot.received == [twist(x) for x in (0.25, 1.0, -0.5, 1.0)]
    counters = harness.counters()
    assert (counters.clamped, counters.messages, counters.refused) == (4, 4, 0)
    await harness.settle()
    assert len([r for r in caplog.records if "clamped" in r.getMessage()]) == 1


@pytest.mark.parametrize(("x", "refused"), [(b"null", 1), (b"1e999", 0)])
async def test_no_number_at_all_is_refused_where_it_is_clamped(harness, x, refused):
    harness.start(CommandRules(clamp=(("linear.x", -0.5, 1.0),)))
    Driver(harness.broker, "a").drive(b'{"linear":{"x":%s}}' % x)
    assert harness.robot.received == []
    assert (harness.counters().refused, harness.counters().errors) == (refused, 1 - refused)


async def test_cdr_is_clamped_as_well(harness):
    rules = CommandRules(clamp=(("linear.x", -0.5, 1.0),))
    settings = TopicSettings("/cmd_vel", "ros", TOPIC, TWIST, encoding="cdr", rules=rules)
    super(CommandHarness, harness).start(settings)
    robot = harness.node.add_subscriber("/cmd_vel", TWIST)
    driver = Driver(harness.broker, "a")
    driver.drive(twist(3, 1))
    driver.drive(twist(float("inf")))
    driver.drive(twist(float("nan")))
    assert robot.received == [twist(1, 1)]
    assert (harness.counters().refused, harness.counters().errors) == (2, 0)


async def test_only_some_values_are_allowed(harness):
    harness.start(CommandRules(allow=(("data", ("auto", "manual")),)), type=STRING, found=STRING)
    driver = Driver(harness.broker, "a")
    driver.drive(b'{"data":"auto"}')
    driver.drive(b'{"data":"kill"}')
    assert len(harness.robot.received) == 1
    # Each is counted once: what breaks a rule is no error.
    assert (harness.counters().refused, harness.counters().errors) == (1, 0)
    assert "'kill' is not allowed, only auto, manual" in harness.counters().last_error


@pytest.mark.parametrize("qos", [0, 2])
@pytest.mark.parametrize(
    "limit", [{"clamp": (("linear.x", 0.1, 0.5),)}, {"allow": (("linear.x", (0.1, 0.5)),)}]
)
async def test_the_stop_message_is_published_as_it_is(harness, limit, qos):
    """Neither clamped, which would make it a movement, nor refused."""
    harness.start(CommandRules(on_silence=OnSilence(60), **limit))
    driver = Driver(harness.broker, "a")
    driver.steer()
    driver.drive(b"{}", qos)
    if qos:
        driver.say(Pubrel(7))
    assert harness.robot.received == [twist(0.5), STOP]
    counters = harness.counters()
    assert (counters.clamped, counters.refused, counters.errors) == (0, 0, 0)
    # What only looks like it where it is limited is limited.
    driver.steer(b'{"angular":{"z":1}}')
    assert harness.robot.received[2:] == ([twist(0.1, 1)] if "clamp" in limit else [])


def limits(type_name, **kw):
    return FieldLimits(CommandRules(**kw), Converter(load_description(type_name), time.time_ns))


def test_a_float32_never_gets_over_its_limit():
    joy = "sensor_msgs/msg/Joy"
    converter = Converter(load_description(joy), time.time_ns)
    for low, high in ((-0.1, 0.1), (-0.7, -0.3), (0.3, 0.7), (-1e-50, 1e-50)):
        clamped, has_changed = limits(joy, clamp=(("axes", low, high),)).apply(
            converter.from_dict({"axes": [-5, 0.1, 5, 0.3]})
        )
        assert has_changed
        assert all(low <= x <= high for x in converter.to_dict(clamped)["axes"])


def test_limits_reach_into_arrays_of_messages():
    path = "geometry_msgs/msg/PoseArray"
    converter = Converter(load_description(path), time.time_ns)
    cdr = converter.from_dict({"poses": [{"position": {"x": 1}}, {"position": {"x": 9}}]})
    clamped, _ = limits(path, clamp=(("poses.position.x", 0, 2),)).apply(cdr)
    assert [p["position"]["x"] for p in converter.to_dict(clamped)["poses"]] == [1, 2]
    with pytest.raises(ConversionError, match=r"poses\[1\]\.position\.x: '9\.0' is not allowed"):
        limits(path, allow=(("poses.position.x", (1,)),)).apply(cdr)


@pytest.mark.parametrize(
    ("type_name", "rules", "problem"),
    [
        (TWIST, {"clamp": (("linear.q", 0, 1),)}, r"clamp\.linear\.q: .* has no field 'q'"),
        (TWIST, {"clamp": (("linear", 0, 1),)}, "is a message of its own"),
        (TWIST, {"clamp": (("linear.x.y", 0, 1),)}, "has no fields"),
        (STRING, {"clamp": (("data", 0, 1),)}, "is not a number"),
        (INT, {"clamp": (("data", 0.2, 0.8),)}, "no int32 is between"),
        (INT, {"allow": (("data", (1.5,)),)}, "1.5 is not an integer"),
        (INT, {"allow": (("data", (True,)),)}, "True is not an integer"),
        (STRING, {"allow": (("data", (1,)),)}, "1 is not a string"),
        (FLOAT, {"allow": (("data", (1, 1e39)),)}, r"a float32 cannot be 1, 1e\+39"),
        (FLOAT, {"allow": (("data", (10**400,)),)}, "a float32 cannot be 10000"),
        ("std_msgs/msg/UInt8MultiArray", {"clamp": (("data", 0, 1),)}, "is bytes"),
    ],
)
def test_limits_that_a_type_cannot_have(type_name, rules, problem):
    with pytest.raises(ConversionError, match=problem):
        limits(type_name, **rules)


async def test_no_answer_to_a_call_is_a_command(harness):
    """It would come late, as the appliance's own, and outlive the client that asked for it."""
    harness.start(CommandRules(on_silence=OnSilence(AFTER)))
    dispatcher = harness.bridge.calls.dispatcher

    async def slow():
        return Answer(GO)

    endpoint = CallEndpoint("r2d2/slow/_call", "slow", 1.0, CallCounters(), lambda call: slow)
    dispatcher.register(endpoint)
    driver = Driver(harness.broker, "a")
    properties = {Property.RESPONSE_TOPIC: TOPIC}
    driver.say(Publish("r2d2/slow/_call", b"", properties=properties))
    await asyncio.sleep(0.02)
    dispatcher.unregister(endpoint)
    assert harness.robot.received == []


class TestBacklog:
    """On times of its own."""

    NEW = Message(TOPIC, GO)

    def begin(self):
        guard = ReplayGuard()
        assert guard.is_old(DelayedMessage(self.NEW, math.inf), self, 0.5, 100.0)
        return guard

    def test_it_takes_longer_than_a_command_may(self):
        """Bursts of it, as the acknowledgements let them through, over a slow network."""
        guard, now = self.begin(), 100.0
        for burst in range(20):
            now = 100.0 + 0.4 * burst
            assert all(guard.is_old(self.NEW, self, 0.5, now + 0.001 * n) for n in range(5))
        # Commands as they are made, of which one or the other pair comes together.
        assert guard.is_old(self.NEW, self, 0.5, now + 0.4)
        assert guard.is_old(self.NEW, self, 0.5, now + 0.401)
        assert not guard.is_old(self.NEW, self, 0.5, now + 0.52)
        assert not guard.is_old(self.NEW, self, 0.5, now + 0.521)

    def test_who_is_always_fast_is_heard_again(self):
        guard = self.begin()
        times = [100.0 + 0.002 * n for n in range(40_000)]
        heard = next(now for now in times if not guard.is_old(self.NEW, self, 0.5, now))
        assert 150 < heard < 161


async def test_what_a_driver_had_queued_that_comes_back_unmarked(harness):
    """Libraries queue what is said without a connection, and send it as if it were new."""
    harness.start(CommandRules(on_silence=OnSilence(AFTER)))
    driver = Driver(harness.broker, "a")
    driver.steer()
    driver.cut()
    assert harness.robot.received == [twist(0.5), STOP]
    driver = Driver(harness.broker, "a")
    driver.say(*[Publish(TOPIC, GO, qos=1, packet_id=7)] * 50)
    assert harness.counters().expired == 50
    await asyncio.sleep(1.2 * AFTER)
    driver.drive(b"{}")  # it stops by itself, and is trusted when it comes back
    assert harness.robot.received == [twist(0.5), STOP, STOP]
    driver.cut()
    Driver(harness.broker, "a").drive()
    # Soon it is stopped again.
    await until(lambda: harness.robot.received[:4] == [twist(0.5), STOP, STOP, twist(0.5)])


async def test_a_stop_message_that_may_have_been_lost_is_published_again(harness):
    """A publisher that was made anew has not found the robot yet: what it sends goes nowhere."""
    harness.start(CommandRules(on_silence=OnSilence(AFTER)))
    harness.node.spin()
    driver = Driver(harness.broker, "a")
    driver.steer()
    latched = QosProfile(durability=Durability.TRANSIENT_LOCAL)
    harness.node.add_subscriber("/cmd_vel", TWIST, latched)  # for which the publisher is made anew
    harness.robot.received.clear()
    driver.cut()
    assert harness.robot.received == [STOP]
    for _ in range(3):
        harness.node.spin()
        await asyncio.sleep(0.01)
    assert harness.robot.received == [STOP, STOP]


async def test_retained_commands_of_more_topics_than_one_turn_is_for(harness):
    """A network client goes on in its next turn; the bridge has to be given one."""
    rules = CommandRules(take_retained=True)
    names = [f"/arm/joint_{number}" for number in range(300)]
    for name in names:
        harness.client.send(f"r2d2{name}", GO, retain=True)
    robots = [
        FakePeer(harness.node, name, Endpoint("/robot", TWIST, QosProfile())) for name in names
    ]
    harness.node.remote_subscribers += robots
    Harness.start(
        harness, *(TopicSettings(name, "ros", "r2d2{ros}", TWIST, rules=rules) for name in names)
    )
    for _ in range(3):
        harness.node.spin()
        await harness.settle()
    assert [robot.received for robot in robots] == [[twist(0.5)]] * 300
    harness.client.send(f"r2d2{names[-1]}", b"{}")  # nothing is left that others would wait behind
    assert robots[-1].received == [twist(0.5), STOP]


@pytest.mark.parametrize(("low", "high"), [(1e-50, 1.0), (-1.0, -1e-50)])
def test_a_bound_that_is_next_to_zero(low, high):
    converter = Converter(load_description("std_msgs/msg/Float32"), time.time_ns)
    limits = FieldLimits(CommandRules(clamp=(("data", low, high),)), converter)
    for number in (0.0, -0.0, -5.0, 5.0, 1e-45, -1e-45):
        limited, _ = limits.apply(converter.from_dict({"data": number}))
        assert low <= converter.to_dict(limited)["data"] <= high


@pytest.mark.parametrize("now", [b"", b'{"linear":{"x":0.1}}'])
async def test_a_retained_command_that_is_taken_back_before_the_robot_is_there(harness, now):
    harness.client.send(TOPIC, GO, retain=True)
    rules = CommandRules(take_retained=True)
    Harness.start(harness, TopicSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=rules))
    await harness.settle()
    harness.client.send(TOPIC, now, retain=True)
    robot = harness.node.add_subscriber("/cmd_vel", TWIST)
    robot.received.clear()
    for _ in range(3):
        harness.node.spin()
        await harness.settle()
    assert robot.received == ([twist(0.1)] if now else [])


async def test_what_a_driver_had_queued_while_the_appliance_was_away(harness):
    away = Driver(harness.broker, "a", clean=False, expiry=60)
    away.cut()
    harness.start(CommandRules(on_silence=OnSilence(AFTER)))
    driver = Driver(harness.broker, "a", clean=False, expiry=60)
    driver.say(*[Publish(TOPIC, GO, qos=1, packet_id=7)] * 50)
    assert harness.counters().expired == 50
    Driver(harness.broker, "b").steer()
    assert harness.robot.received == [twist(0.5)]


# Arrivals: on times of their own


class FarLink:
    """A link whose round trip and time are the test's, and that remembers what it withholds."""

    def __init__(self, round_trip=0.0):
        self.round_trip = round_trip
        self.withheld = []
        self.flowing = self.held = 0.0

    def peer_status(self):
        return PeerStatus(self.round_trip, flowing=self.flowing, held=self.held)

    def withhold(self, seconds):
        self.withheld.append(seconds)


class Sender:
    """A client whose commands come when the test says; `moved` are those that move the robot."""

    OLDEST = 0.5

    def __init__(self, qos=0, round_trip=0.0, client_id="a"):
        self.link = FarLink(round_trip)
        self.client_id = client_id
        self.age = 0.0
        self.qos = qos
        self.staleness = StalenessDetector()
        self.now = 100.0
        self.moved = []
        self.held = None
        self.due = 0.0

    def _pass_to(self, now):
        if self.held is not None and now >= self.due:
            self.staleness.remove_pending(self, self)
            self.moved.append(self.held)
            self.held = None
        self.now = now

    def say(self, after, what=None):
        """A command so many seconds after the one before."""
        self._pass_to(self.now + after)
        what = self.now if what is None else what
        if self.qos == 2:
            self.staleness.observe_unreleased(self, self.OLDEST, self.now)
        verdict = self.staleness.judge(self, self.qos, self.OLDEST, self.now)
        self.held = None
        if verdict is CommandVerdict.CARRY_OUT:
            self.moved.append(what)
        elif verdict is CommandVerdict.WAIT:
            self.held = what
            self.due = self.now + self.staleness.waiting_time(self, self.OLDEST)
        return verdict

    def rest(self, seconds):
        self._pass_to(self.now + seconds)


@pytest.mark.parametrize("qos", [0, 1, 2])
class TestArrivals:
    @pytest.mark.parametrize("gaps", [[0], [0.0005] * 60, [0.002] * 9, [0.03, 0.0001, 0.0001]])
    @pytest.mark.parametrize("silence", [0, 12])
    def test_none_of_a_queue_is_carried_out(self, qos, gaps, silence):
        sender = Sender(qos)
        if silence:
            sender.say(0)
            sender.rest(silence)
            sender.moved.clear()
        for gap in (0, *gaps):
            sender.say(gap)
        sender.rest(60)
        assert sender.moved == []

    def test_nor_when_it_comes_in_bursts_of_a_distant_network(self, qos):
        sender = Sender(qos, 0.15)
        for _ in range(5):
            sender.say(0.16)
            for _ in range(20):
                sender.say(0.0002)
        sender.rest(1)
        assert sender.moved == []

    def test_a_queue_whose_second_is_a_round_trip_behind_the_first(self, qos):
        """Nagle's algorithm sends no second small packet before the first is acknowledged."""
        sender = Sender(qos, 0.18)
        sender.say(0)
        sender.say(0.18 + 0.04)
        for _ in range(20):
            sender.say(0)
        sender.rest(1)
        assert sender.moved == []

    def test_a_single_one_is_carried_out(self, qos):
        sender = Sender(qos)
        sender.say(0, "go")
        sender.rest(WAIT - 0.001)
        assert sender.moved == []
        sender.rest(0.001)
        assert sender.moved == ["go"]

    def test_each_of_a_button_that_is_pressed_now_and_then(self, qos):
        sender = Sender(qos)
        for gap in (0, 0.3, 0.4, 1, 12, 0.2, 3600):
            sender.say(gap)
        sender.rest(1)
        assert len(sender.moved) == 7

    @pytest.mark.parametrize("rate", [10, 20, 25, 50])
    def test_who_steers_is_heard_from_the_third_on(self, qos, rate):
        sender = Sender(qos)
        numbers = range(1, 40)
        for number in numbers:
            sender.say(1 / rate, number)
        assert sender.moved[-37:] == list(numbers)[2:]
        # And on, after a pause that is none.
        sender.say(sender.OLDEST - 0.01, "on")
        sender.say(0.0001, "more")
        assert sender.moved[-2:] == ["on", "more"]

    def test_what_was_queued_before_and_what_is_made_now(self, qos):
        sender = Sender(qos)
        for _ in range(50):
            sender.say(0.001, "old")
        for _ in range(5):
            sender.say(0.05, "new")
        assert sender.moved == ["new"] * 4

    def test_a_pause_in_the_middle_of_a_queue(self, qos):
        sender = Sender(qos)
        for gap in (0, 0.001, 0.001, 0.3, 0.001, 0.001, 0.4, 0.001):
            sender.say(gap)
        sender.rest(1)
        assert sender.moved == []

    def test_the_end_of_a_queue_behind_a_pause(self, qos):
        sender = Sender(qos)
        for gap in (0, 0.001, 0.001, 0.3):
            sender.say(gap)
        sender.rest(1)
        assert sender.moved == []

    def test_a_queue_is_none_the_less_for_being_long(self, qos):
        """It ends by a silence, or by the pace of somebody who steers, not by a time."""
        sender = Sender(qos)
        for _ in range(60_000):
            sender.say(0.002)
        assert sender.moved == []
        for _ in range(5):
            sender.say(0.05, "new")
        assert sender.moved == ["new"] * 4

    def test_a_long_queue_behind_what_is_known_to_be_old(self, qos):
        sender = Sender(qos)
        sender.staleness.mark_stale(sender, sender.now)
        for _ in range(60_000):
            sender.say(0.002)
        assert sender.moved == []
        sender.rest(sender.OLDEST + 0.1)
        sender.say(0, "new")
        sender.rest(1)
        assert sender.moved == ["new"]

    def test_a_queue_with_other_messages_between_its_commands(self, qos):
        """As large as pictures, they take their time, in which there is no pause."""
        sender = Sender(qos)
        for _ in range(100):
            sender.link.flowing += 0.09
            sender.say(0.09)
        sender.rest(1)
        assert sender.moved == []
        for _ in range(5):
            sender.link.flowing = 0.03
            sender.say(0.09, "new")
        assert sender.moved[-3:] == ["new"] * 3

    @pytest.mark.parametrize("steered", [False, True])
    def test_what_was_not_read_for_a_time_is_a_new_beginning(self, qos, steered):
        sender = Sender(qos)
        for _ in range(10 * steered):
            sender.say(0.05)
        sender.moved.clear()
        sender.link.held = 3.0
        for gap in (3.0 if steered else 0.0, 0, 0, *[0.05] * 20):
            sender.say(gap)
        sender.rest(0.3)
        assert sender.moved == []
        sender.link.held = 0.0
        for _ in range(4):
            sender.say(0.05, "new")
        assert sender.moved[-2:] == ["new"] * 2

    def test_a_single_one_that_was_not_read_for_a_time(self, qos):
        """The system knows when the last byte came, and that may be of something else."""
        sender = Sender(qos)
        sender.link.held = 3.0
        sender.say(0)
        sender.rest(1)
        assert sender.moved == []
        sender.link.held = 0.0
        sender.say(0, "new")
        sender.rest(1)
        assert sender.moved == ["new"]

    def test_who_is_not_read_for_less_than_a_command_may_take_steers_on(self, qos):
        sender = Sender(qos)
        for _ in range(10):
            sender.say(0.05)
        sender.link.held = sender.OLDEST
        sender.say(0, "new")
        assert sender.moved[-1] == "new"


@pytest.mark.parametrize("qos", [1, 2])
def test_a_queue_that_comes_one_by_one_has_a_pace_of_its_own(qos):
    """As MQTT.js sends it, each behind the acknowledgement of the one before: it is withheld."""
    sender = Sender(qos)
    think = 0.05  # of a busy client, on a busy computer
    for _ in range(40):
        withheld = sum(sender.link.withheld[-1:])
        sender.link.withheld.clear()
        sender.say(think + withheld)
    assert sender.moved == []
    # While commands that are made now do not wait for that.
    for _ in range(40):
        sender.say(0.05, "new")
    assert sender.moved[-15:] == ["new"] * 15
    assert sender.link.withheld[-1] == 0  # and are acknowledged at once again


def test_the_flush_of_a_queue_is_slowed_by_little():
    sender = Sender(1)
    withheld = 0.0
    begun = sender.now
    for _ in range(200):
        now = sum(sender.link.withheld)
        sender.link.withheld.clear()
        sender.say(0.02 + now)
        withheld += now
    assert sender.moved == []
    assert withheld < 0.2 * (sender.now - begun)
    assert WITHHOLD > 0.1  # what is made at 10 Hz comes within it
    assert STEADY == 2


def test_who_left_while_it_drove():
    sender = Sender()
    sender.staleness.expect_replay("a")
    sender.say(0, "old")
    sender.rest(0.4)
    sender.staleness.on_departed(sender)
    sender.staleness.expect_replay("a")
    sender.age = 12
    sender.say(0, "new")
    sender.rest(1)
    assert sender.moved == ["new"]


@pytest.mark.parametrize("qos", [0, 1, 2])
def test_what_came_while_the_computer_slept_is_a_queue(qos, monkeypatch):
    """The clock stands still in sleep: no silence is seen, but the client has sent all the time."""
    slept = [7.0]
    monkeypatch.setattr(clock, "_asleep", lambda: slept[0])
    sender = Sender(qos)
    for _ in range(20):
        sender.say(0.05)
    assert len(sender.moved) > 10
    sender.moved.clear()
    slept[0] += 20
    for _ in range(50):
        sender.say(0.0005, "old")
    sender.rest(1)
    assert not sender.moved
    slept[0] += 20
    sender.say(0.05, "alone")
    sender.rest(1)
    assert sender.moved == ["alone"]


async def test_a_command_that_waits_while_the_computer_sleeps_is_old(harness, monkeypatch):
    slept = [7.0]
    monkeypatch.setattr(clock, "_asleep", lambda: slept[0])
    harness.start(CommandRules(expire=0.5))
    driver = Driver(harness.broker, "a")
    driver.drive()
    slept[0] += 3600
    await until(lambda: harness.counters().expired == 1, "it to be dropped")
    assert "the computer has slept since it came" in harness.bridge.status()[0].last_error
    await asyncio.sleep(0.2)
    assert harness.robot.received == []
    driver.drive()
    await until(lambda: harness.robot.received == [twist(0.5)], "the next one")


async def test_a_large_command_that_waits_while_the_computer_sleeps_is_old(harness, monkeypatch):
    slept = [7.0]
    monkeypatch.setattr(clock, "_asleep", lambda: slept[0])
    harness.start(CommandRules(expire=30.0))
    make_busy(harness)
    driver = Driver(harness.broker, "a")
    driver.drive(large(0.5, 20_000), qos=1)
    slept[0] += 3600
    await until(lambda: harness.counters().expired == 1, "it to be dropped")
    assert "waited for its turn to be converted for 3600" in harness.bridge.status()[0].last_error
    assert harness.robot.received == []


def test_clients_whose_return_is_expected_are_bounded():
    staleness = StalenessDetector()
    for number in range(2 * EXPECTED):
        staleness.expect_replay(str(number))
    assert len(staleness._expected_replays) == EXPECTED


def said(*texts):
    return {Property.USER_PROPERTY: [("a", "b"), *(("sent-at", text) for text in texts)]}


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("1780000000", 1780000000.0),
        ("1780000000.25", 1780000000.25),
        ("2026-05-28T20:26:40Z", 1780000000.0),
        ("2026-05-28T20:26:40.5Z", 1780000000.5),
        ("2026-05-28t22:26:40.123456789+02:00", 1780000000.123456),
        ("2026-05-28 15:26:40.1-05:00", 1780000000.1),
    ],
)
def test_sent_at(text, seconds):
    assert sent_at(said(text)) == pytest.approx(seconds, abs=1e-5)


@pytest.mark.parametrize(
    "text",
    [
        *("", "now", "-5", "nan", "inf", "1e9", "0x5", "1_000", "1.2.3", ".", "\u0661", "9" * 41),
        *("2026-05-28", "2026-05-28T20:26:40", "2026-05-28T20:26:40.Z", "2026-13-28T20:26:40Z"),
        *("9999-12-31T23:59:59-23:59", "2026-05-28T20:26:40ZZ", "20260528T202640Z\n"),
    ],
)
def test_sent_at_of_another_form(text):
    with pytest.raises(ValueError, match="its sent-at is"):
        sent_at(said(text))


@pytest.mark.parametrize(
    ("text", "advice"),
    [
        ("1780000000250", "'1780000000250': that looks like milliseconds, and it is in seconds"),
        ("1780000000250.5", "that looks like milliseconds"),
        ("1780000000250000", "that looks like microseconds"),
        ("1780000000250000000", "that looks like nanoseconds"),
        ("2026-05-28T20:26:40", "without its time zone: .*Z for UTC, or such as \\+02:00"),
        ("2026-05-28T20:26:40.5", "without its time zone"),
        ("yesterday", "seconds since 1970 .1780000000.25. or RFC 3339 .2026-05-28T20:26:40.25Z."),
        ("2026-05-28", "seconds since 1970 .1780000000.25. or RFC 3339"),
        ("9" * 41, "seconds since 1970 .1780000000.25. or RFC 3339"),
    ],
)
def test_a_wrong_sent_at_is_told_with_what_is_right(text, advice):
    with pytest.raises(ValueError, match=f"its sent-at is .*{advice}"):
        sent_at(said(text))


def test_sent_at_is_said_once_or_not_at_all():
    assert sent_at(None) is sent_at({}) is sent_at(said()) is None
    with pytest.raises(ValueError, match="it says sent-at 2 times"):
        sent_at(said("1780000000", "1780000000"))


# The same on the broker


@pytest.mark.parametrize("qos", [0, 1])
@pytest.mark.parametrize("version", [4, 5])
@pytest.mark.parametrize("rules", [CommandRules(expire=0.5), None])
async def test_a_queue_behind_connect(harness, version, qos, rules):
    harness.start(rules or CommandRules(on_silence=OnSilence(0.5)))
    driver = Driver(harness.broker, "never seen", version)
    commands = [Publish(TOPIC, GO, qos=qos, packet_id=n if qos else None) for n in (1, 2, 3)]
    driver.say(*commands)  # all that there is in one segment
    await until(lambda: harness.counters().expired == 3)
    await asyncio.sleep(0.2)
    assert harness.robot.received == []
    (topic,) = harness.bridge.topics()
    assert topic.last_error == "a command was too old: others came with it at once, as of a queue"


async def test_what_came_at_once_is_a_queue_however_long_it_takes(harness, monkeypatch):
    """On a busy computer, a turn of the loop may be as long as the time between two commands."""
    harness.start(CommandRules(expire=0.5))
    convert = harness.commands._convert

    def slowly(message, origin):
        time.sleep(0.02)
        return convert(message, origin)

    monkeypatch.setattr(harness.commands, "_convert", slowly)
    Driver(harness.broker, "a").say(*[Publish(TOPIC, GO)] * 5)
    await asyncio.sleep(0.2)
    assert harness.robot.received == []


@pytest.mark.parametrize("client", ["a", "b"])
async def test_a_client_id_that_is_taken_over(harness, client):
    """The connection is another: what waits of the first is not carried out, and it begins anew."""
    harness.start(CommandRules(expire=0.5))
    first = Driver(harness.broker, "a", clean=False, expiry=60)
    first.drive(b'{"linear":{"x":9}}')
    other = Driver(harness.broker, client, clean=False, expiry=60)
    other.say(*[Publish(TOPIC, GO)] * 3)
    await asyncio.sleep(0.3)
    assert harness.robot.received == ([] if client == "a" else [twist(9)])


@pytest.mark.parametrize("qos", [0, 1, 2])
@pytest.mark.parametrize("version", [4, 5])
@pytest.mark.parametrize("leaves", [False, True])
async def test_a_single_command_behind_connect(harness, version, qos, leaves):
    harness.start(CommandRules(expire=0.5))
    driver = Driver(harness.broker, "never seen", version)
    before = harness.broker.accounting.queued_bytes
    driver.drive(qos=qos)
    if qos == 2:
        driver.say(Pubrel(7))
    if leaves:  # as mosquitto_pub does
        driver.leave()
        assert harness.robot.received == [twist(0.5)]
    await until(lambda: harness.robot.received == [twist(0.5)])
    assert harness.broker.accounting.queued_bytes == before


async def test_a_single_command_and_a_cut(harness):
    """It may have been the first of a queue."""
    harness.start(CommandRules(expire=0.5))
    before = harness.broker.accounting.queued_bytes
    driver = Driver(harness.broker, "a")
    driver.drive()
    driver.cut()
    await asyncio.sleep(0.2)
    assert harness.robot.received == []
    assert harness.counters().expired == 1
    assert harness.broker.accounting.queued_bytes == before
    assert harness.commands._staleness._paces == {}


def start_two(harness, mqtt="r2d2/arm"):
    """Two routes to ROS; gives what the second's node receives."""
    rules = CommandRules(expire=60.0)
    routes = [
        TopicSettings(ros, "ros", topic, TWIST, rules=rules)
        for ros, topic in (("/cmd_vel", TOPIC), ("/arm", mqtt))
    ]
    Harness.start(harness, *routes)
    harness.robot = harness.node.add_subscriber("/cmd_vel", TWIST)
    return harness.node.add_subscriber("/arm", TWIST)


@pytest.mark.parametrize("count", [1, 60])
async def test_what_is_known_of_a_client_holds_for_all_topics(harness, count):
    """It has one queue for them."""
    arm = start_two(harness)
    await harness.settle()
    driver = Driver(harness.broker, "a")
    driver.say(*[Publish(TOPIC, GO)] * count, Publish("r2d2/arm", GO))
    await asyncio.sleep(0.3)
    assert harness.robot.received == arm.received == []
    for _ in range(5):
        await asyncio.sleep(0.05)
        driver.drive()
    assert harness.robot.received == [twist(0.5)] * 4
    driver.say(Publish("r2d2/arm", GO))
    assert arm.received == [twist(0.5)]


async def test_a_command_to_two_ros_topics_is_one(harness):
    arm = start_two(harness, TOPIC)
    await harness.settle()
    driver = Driver(harness.broker, "a")
    driver.drive()
    await until(lambda: harness.robot.received == arm.received == [twist(0.5)])
    await asyncio.sleep(0.5)
    driver.say(*[Publish(TOPIC, GO)] * 2)
    await asyncio.sleep(0.3)
    assert harness.robot.received == arm.received == [twist(0.5)]


@pytest.mark.parametrize("qos", [0, 1, 2])
async def test_who_drives_and_was_not_read_for_a_time(harness, qos):
    """Of QoS 2, that is known when the command comes, and not when it is released."""
    harness.start(CommandRules(expire=0.5))
    driver = Driver(harness.broker, "a")
    driver.wire.connection = PeerStatus()
    begun = asyncio.get_running_loop().time()
    for number in range(5):
        at = begun + 0.06 * number
        driver.say(Publish(TOPIC, GO, qos=qos, packet_id=7 if qos else None), at=at)
        if qos == 2:
            driver.say(Pubrel(7), at=at)
    await asyncio.sleep(0.3)
    assert harness.robot.received
    harness.robot.received.clear()
    driver.wire.connection = PeerStatus(held=3.0)
    commands = [Publish(TOPIC, GO, qos=qos, packet_id=n if qos else None) for n in (1, 2)]
    driver.say(*commands)
    driver.wire.connection = PeerStatus()
    if qos == 2:
        driver.say(Pubrel(1), Pubrel(2))
    await asyncio.sleep(0.3)
    assert harness.robot.received == []


async def test_a_qos_2_command_is_not_single_when_another_comes_that_is_released_late(harness):
    """Its PUBREC is withheld, to see whether its client waits for that."""
    harness.start(CommandRules(expire=0.5))
    driver = Driver(harness.broker, "a")
    begun = asyncio.get_running_loop().time()
    driver.say(Publish(TOPIC, GO, qos=2, packet_id=7), at=begun)
    driver.say(Pubrel(7), at=begun)
    driver.say(Publish(TOPIC, GO, qos=2, packet_id=8), at=begun + 0.05)
    await asyncio.sleep(0.3)
    assert harness.robot.received == []
    driver.say(Pubrel(8))
    await asyncio.sleep(0.3)
    assert harness.robot.received == []


@pytest.mark.parametrize("qos", [0, 1, 2])
async def test_a_stream_that_begins_is_no_reason_to_warn(harness, caplog, qos):
    harness.start(CommandRules(expire=5))
    caplog.set_level(logging.INFO)
    driver = Driver(harness.broker, "a")
    driver.wire.connection = PeerStatus()
    begun = asyncio.get_running_loop().time()
    for number in range(5):
        at = begun + 0.02 * number
        driver.say(Publish(TOPIC, GO, qos=qos, packet_id=number + 1 if qos else None), at=at)
        if qos == 2:
            driver.say(Pubrel(number + 1), at=at)
    await asyncio.sleep(0.1)
    assert harness.robot.received == [twist(0.5)] * 3
    assert harness.counters().expired == 0
    assert harness.counters().last_error is None
    assert "a stream is carried out from its third command on" in caplog.text
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    driver.say(*[Publish(TOPIC, GO)] * 3)  # it is known
    other = Driver(harness.broker, "b")
    other.say(*[Publish(TOPIC, GO)] * 3)  # and this is a queue
    assert harness.counters().expired == 3


@pytest.mark.parametrize("pauses", [False, True])
async def test_a_command_with_something_else_behind_it(harness, pauses):
    """A first command waits for what else there is, and that may be a picture."""
    harness.start(CommandRules(expire=60.0 if pauses else 0.3))
    driver = Driver(harness.broker, "a")
    driver.wire.connection = PeerStatus(flowing=60.0)
    driver.drive()
    await asyncio.sleep(0.2)
    assert harness.robot.received == []
    if pauses:
        driver.wire.connection = PeerStatus(flowing=0.05)
        await until(lambda: harness.robot.received == [twist(0.5)])
    else:
        await until(lambda: harness.counters().expired == 1)
        assert harness.robot.received == []


async def test_the_stop_message_is_heard_at_once_whatever_comes_with_it(harness):
    harness.start(CommandRules(on_silence=OnSilence(0.5)))
    driver = Driver(harness.broker, "a")
    driver.drive(b"{}")
    assert harness.robot.received == [STOP]
    driver.drive()
    driver.drive()
    driver.drive(b"{}")
    assert harness.robot.received == [STOP, STOP]
    await asyncio.sleep(0.2)
    assert harness.robot.received == [STOP, STOP]


def made(seconds_ago):
    return {Property.USER_PROPERTY: [("sent-at", str(time.time() - seconds_ago))]}


@pytest.mark.parametrize("qos", [1, 2])
@pytest.mark.parametrize("padding", [b"", b" " * 5000])
@pytest.mark.parametrize("way", ["dup", "sent-at"])
async def test_an_old_stop_message_is_carried_out(harness, way, padding, qos):
    harness.start(CommandRules(on_silence=OnSilence(60), expire=0.5))
    driver = Driver(harness.broker, "a")
    old = {"dup": True} if way == "dup" else {"properties": made(61)}
    driver.steer()
    driver.drive(b"{}" + padding, qos=qos, **old)
    assert decode(driver.wire.written).reason_code == 0
    if qos == 2:
        driver.say(Pubrel(7))
    if not padding:
        assert harness.robot.received == [twist(0.5), STOP]
    # A large one was converted for its PUBREC, and is again when it is its turn.
    await until(lambda: harness.robot.received == [twist(0.5), STOP])
    assert harness.counters().expired == 0
    # It shows a queue all the same: another command that comes with it is old.
    driver.drive(GO)
    assert harness.robot.received == [twist(0.5), STOP]


async def test_a_stop_message_that_waited_behind_a_slow_reader_is_carried_out(harness):
    harness.start(CommandRules(on_silence=OnSilence(60), expire=0.5))
    driver = Driver(harness.broker, "a")
    driver.steer()
    late = DelayedMessage(Message(TOPIC, b"{}", 1), 5.0)
    assert harness.commands.receive(late, False, driver.client.session, 9) is None
    assert harness.robot.received == [twist(0.5), STOP]
    late = DelayedMessage(Message(TOPIC, GO, 1), 5.0)
    assert harness.commands.receive(late, False, driver.client.session, 9) is not None
    assert harness.robot.received == [twist(0.5), STOP]


async def test_a_will_that_stops_the_robot(harness):
    harness.start(CommandRules(on_silence=OnSilence(60), expire=0.5))
    gone = Driver(harness.broker, "gone", will=Will(TOPIC, b"{}"))
    Driver(harness.broker, "a").steer()
    gone.cut()
    assert harness.robot.received == [twist(0.5), STOP]


async def test_a_stop_message_that_mqtt_has_expired_is_not_carried_out(harness):
    harness.start(CommandRules(on_silence=OnSilence(60), expire=0.5))
    driver = Driver(harness.broker, "a")
    driver.drive(b"{}", qos=1, properties={Property.MESSAGE_EXPIRY_INTERVAL: 0})
    assert driver.code == 0x83
    assert harness.robot.received == []


async def test_what_waits_is_not_carried_out_behind_a_stop(harness):
    harness.start(CommandRules(on_silence=OnSilence(0.5)))
    driver = Driver(harness.broker, "a")
    driver.drive()
    driver.drive(b"{}")
    await asyncio.sleep(0.2)
    assert harness.robot.received == [STOP]


async def test_what_has_come_and_was_not_read_is_behind_it(harness):
    """The loop was busy: its timers are early, and its clients late."""
    harness.start(CommandRules(expire=60.0))
    driver = Driver(harness.broker, "a")
    driver.wire.connection = PeerStatus(has_unread=True)
    driver.drive()
    await asyncio.sleep(0.2)
    driver.drive()
    driver.wire.connection = PeerStatus()
    await asyncio.sleep(0.2)
    assert harness.robot.received == []
    assert harness.counters().expired == 2


async def test_what_waits_for_ever_behind_it(harness):
    harness.start(CommandRules(expire=0.15))
    driver = Driver(harness.broker, "a")
    driver.wire.connection = PeerStatus(has_unread=True)
    driver.drive()
    await until(lambda: harness.counters().expired == 1)
    assert harness.robot.received == []


async def test_what_waits_takes_memory_that_is_counted(harness, monkeypatch):
    harness.start(CommandRules(expire=0.5))
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    accounting, account = harness.broker.accounting, a.client.session.account
    before, own = accounting.queued_bytes, account.bytes
    a.drive()
    assert accounting.queued_bytes >= before + len(GO) + len(twist())
    assert account.bytes - own == accounting.queued_bytes - before
    with monkeypatch.context() as patch:
        patch.setattr(Accounting, "fits", lambda *_: False)
        b.drive()
    await until(lambda: harness.robot.received == [twist(0.5)])
    assert (accounting.queued_bytes, account.bytes) == (before, own)
    assert "no memory" in harness.counters().last_error


# Large commands are converted one a turn


def large(x, size=20_000):
    return b'{"linear":{"x":%g}}' % x + b" " * size


#: Of anybody: from here on what is large waits for its turn.
ANOTHER = large(0.25)


def code(driver, payload, **kw):
    """The reason code of its PUBACK."""
    driver.wire.written = b""
    driver.drive(payload, qos=1, **kw)
    return driver.code


def make_busy(harness):
    other = Driver(harness.broker, "somebody else")
    other.steer(ANOTHER)
    assert harness.robot.received.pop() == twist(0.25)
    return other


async def test_large_commands_of_many_are_converted_one_a_turn(harness, monkeypatch):
    harness.start(CommandRules(expire=5.0, clamp=(("linear.x", -1, 1),)))
    drivers = [Driver(harness.broker, f"driver {number}") for number in range(10)]
    for number, driver in enumerate(drivers):
        driver.steer(large(number / 10), qos=1)
        driver.steer(large(5), qos=1)
    assert harness.robot.received == [twist(0)]
    seen = []

    def look():
        seen.append(len(harness.robot.received))
        if seen[-1] < 20:
            asyncio.get_running_loop().call_soon(look)

    look()
    await until(lambda: seen[-1] == 20)
    assert max(b - a for a, b in pairwise(seen)) == 1
    # Users and clients take turns, and what one client sends stays in its order.
    assert [one for one in harness.robot.received if one != twist(1)] == [
        twist(number / 10) for number in range(10)
    ]
    assert harness.robot.received[-9:] == [twist(1)] * 9
    assert harness.counters().clamped == 10


async def test_a_stop_message_does_not_wait_behind_conversions(harness):
    harness.start(CommandRules(expire=5.0, on_silence=OnSilence(5.0)))
    make_busy(harness)
    driver, other = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    for x in (0.1, 0.2, 0.3):
        driver.steer(large(x))
        other.steer(large(x))
    assert harness.robot.received == []
    other.drive(b"{}")
    assert harness.robot.received == [STOP]
    # What was said before has been overtaken: also what others said, who drive the same robot. It
    # would be set in motion again by a command that is older than the stop.
    await until(lambda: harness.counters().expired == 6)
    assert harness.robot.received == [STOP]
    driver.steer(large(0.4))
    await until(lambda: harness.robot.received == [STOP, twist(0.4)])


async def test_a_small_command_does_not_overtake_a_large_one(harness):
    harness.start(CommandRules(expire=5.0))
    make_busy(harness)
    driver = Driver(harness.broker, "a")
    driver.steer(large(0.1))
    driver.steer(GO)
    assert harness.robot.received == []
    assert code(driver, b"[]", properties=made(0)) == 0x99
    await until(lambda: harness.robot.received == [twist(0.1), twist(0.5)])


async def test_a_command_is_as_old_as_its_wait_for_its_turn(harness, monkeypatch):
    harness.start(CommandRules(expire=0.2, on_silence=OnSilence(5.0)))
    make_busy(harness)
    driver = Driver(harness.broker, "a")
    driver.steer(large(0.1))
    driver.drive(large(0.1), properties={Property.MESSAGE_EXPIRY_INTERVAL: 60})
    driver.steer(large(0, 10_000))
    busy_until = time.monotonic() + 0.25
    while time.monotonic() < busy_until:  # the loop has no time for them
        pass
    await until(lambda: harness.robot.received == [STOP])  # which is carried out all the same
    assert harness.counters().expired == 2


async def test_what_need_not_be_converted_is_not(harness, monkeypatch):
    harness.start(CommandRules(expire=0.5, on_silence=OnSilence(5.0)))
    driver = Driver(harness.broker, "a")
    monkeypatch.setattr(harness.commands, "_read", lambda *_: pytest.fail("it was converted"))
    huge = large(0.5, 50_000)
    assert code(driver, huge, dup=True) == 0x83
    assert code(driver, huge) == 0x83  # behind an old one: a queue
    assert harness.counters().expired == 2


async def test_who_has_the_lease_when_it_is_its_turn(harness):
    harness.start(CommandRules(expire=5.0, exclusive=True))
    other = make_busy(harness)
    other.leave()
    driver, late = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    late.steer(large(0.1))
    driver.steer(GO)
    await until(lambda: harness.counters().refused == 1)
    assert harness.robot.received == [twist(0.5)]


@pytest.mark.parametrize("proven", [True, False])
async def test_who_leaves_before_its_turn(harness, proven):
    harness.start(CommandRules(expire=5.0, on_silence=OnSilence(5.0)))
    make_busy(harness)
    driver, lost = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    if proven:
        driver.steer(large(0.1))
    else:  # the first of its connection
        driver.drive(large(0.1))
    lost.steer(large(0.2))
    driver.leave()
    lost.cut()
    await until(lambda: harness.robot.received == [twist(0.1), STOP])
    await until(lambda: harness.counters().expired == 1)
    assert harness.commands._queued == {}


async def test_a_large_queue_behind_connect(harness):
    """The first of it waits for its turn when the others come."""
    harness.start(CommandRules(expire=0.5))
    make_busy(harness)
    driver = Driver(harness.broker, "a")
    driver.drive(large(0.1))
    driver.drive(large(0.2))
    await until(lambda: harness.counters().expired == 2)
    single = Driver(harness.broker, "b")
    await until(lambda: not harness.bridge._conversions.is_busy)
    make_busy(harness)
    single.drive(large(0.3))
    await until(lambda: harness.robot.received == [twist(0.3)])


@pytest.mark.parametrize("packed", [False, True], ids=["plain", "zstd"])
@pytest.mark.parametrize("has_own", [False, True], ids=["", "behind its own"])
async def test_a_stop_is_heard_whoever_has_filled_the_queue(harness, has_own, packed):
    harness.start(CommandRules(expire=5.0, on_silence=OnSilence(5.0)), compression="zstd")
    make_busy(harness)
    loader, driver = Driver(harness.broker, "loader"), Driver(harness.broker, "a")
    if has_own:
        driver.steer(large(0.2))
    turns = harness.bridge._conversions
    session = loader.client.session
    for size in (1_000_000, 50_000, 1100):
        while turns.has_room(session, size + 100):
            assert code(loader, large(0.1, size), properties=made(0)) == 0
    assert code(loader, large(0.1, 1100), properties=made(0)) == 0x97
    stop = b"{}" + b" " * 5000
    assert code(driver, large(0.3, 5000), properties=made(0)) == 0x97, "it drives"
    assert code(driver, b"[]" + b" " * 5000) == 0x99
    assert harness.robot.received == []
    errors = harness.counters().errors
    assert code(driver, ZstdCompressor().compress(stop) if packed else stop) == 0
    assert harness.robot.received == [STOP]
    assert harness.counters().errors == errors
    # What it said before has been overtaken, and what the other had said.
    waiting = sum(map(len, harness.commands._queued.values()))
    await until(lambda: harness.counters().expired == waiting)
    assert harness.robot.received == [STOP]


async def test_what_may_become_large_is_not_converted_out_of_turn(harness, monkeypatch):
    """A few bytes of zstd may be megabytes; so may those that do not say how much they are."""
    harness.start(CommandRules(expire=5.0, on_silence=OnSilence(5.0)), compression="zstd")
    make_busy(harness)
    driver = Driver(harness.broker, "a")
    monkeypatch.setattr(harness.bridge._conversions, "has_room", lambda *_: False)
    monkeypatch.setattr(harness.commands, "_read", lambda *_: pytest.fail("it was converted"))
    huge = b"{}" + b" " * 1_000_000
    silent = ZstdCompressor(write_content_size=False).compress(b"{}")
    for payload in (huge, ZstdCompressor().compress(huge), silent, ZSTD_MAGIC + b"\xff"):
        assert code(driver, payload, properties=made(0)) == 0x97


async def test_large_commands_that_wait_are_bounded_and_end_with_their_route(harness):
    bridge = harness.start(CommandRules(expire=5.0))
    make_busy(harness)
    driver = Driver(harness.broker, "a")
    account = driver.client.session.account
    before = account.bytes
    codes = [code(driver, large(0.1, 1_000_000), properties=made(0)) for _ in range(20)]
    assert codes == [0] * 16 + [0x97] * 4
    bridge.replace([])
    await until(lambda: account.bytes <= before)
    assert harness.robot.received == []


async def test_a_fault_in_the_conversion_of_a_large_command(harness, monkeypatch, escaped):
    harness.start(CommandRules(expire=5.0))
    faults = harness.broker.faults.count

    def fail(*_):
        raise RuntimeError("on purpose")

    monkeypatch.setattr(harness.commands, "_convert", fail)
    driver = Driver(harness.broker, "a")
    assert code(driver, large(0.1), properties=made(0)) == 0x83
    Driver(harness.broker, "b").steer(large(0.1))
    await until(lambda: harness.counters().errors == 2)
    assert harness.broker.faults.count == faults + 2
    escaped.clear()


async def test_what_waits_does_not_outlive_its_route(harness):
    bridge = harness.start(CommandRules(expire=0.5))
    Driver(harness.broker, "a").drive()
    bridge.replace([])
    await asyncio.sleep(0.2)
    assert harness.robot.received == []
    assert harness.broker.accounting.queued_bytes == 0


async def test_who_commands_meanwhile_has_the_lease(harness):
    harness.start(CommandRules(expire=0.5, exclusive=True))
    Driver(harness.broker, "a").drive()
    Driver(harness.broker, "b").steer(b'{"linear":{"x":1}}')
    await until(lambda: harness.counters().refused == 1)
    assert harness.robot.received == [twist(1)]


async def test_who_stops_takes_no_free_lease(harness):
    """An old queue that ends with a stop, above all."""
    harness.start(CommandRules(exclusive=True, on_silence=OnSilence(60)))
    queue, other = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    queue.say(*[Publish(TOPIC, GO)] * 3, Publish(TOPIC, b"{}"))
    assert harness.robot.received == [STOP]
    assert harness.commands.commanding is None
    other.steer()
    assert harness.robot.received == [STOP, twist(0.5)]
    assert harness.commands.commanding == "b"


async def test_who_has_the_lease_keeps_it_with_a_stop(harness):
    harness.start(CommandRules(exclusive=True, lease=60, on_silence=OnSilence(60)))
    driver = Driver(harness.broker, "a")
    driver.steer()
    before = harness.commands._lease.commanded_at
    await asyncio.sleep(0.001)
    driver.steer(b"{}")
    assert harness.robot.received == [twist(0.5), STOP]
    assert harness.commands.commanding == "a"
    assert harness.commands._lease.commanded_at > before


async def test_sent_at_tells_a_new_one_from_an_old_one_in_any_burst(harness):
    harness.start(CommandRules(expire=0.5))
    driver = Driver(harness.broker, "a")

    def say(age, dup=False):
        made = {Property.USER_PROPERTY: [("sent-at", str(time.time() - age))]}
        driver.wire.written = b""
        driver.drive(qos=1, dup=dup, properties=made)
        return driver.code

    assert [say(age) for age in (3, 0.1, 3, 3, 0, -0.1)] == [0x83, 0, 0x83, 0x83, 0, 0]
    assert harness.robot.received == [twist(0.5)] * 3
    assert say(0.1, dup=True) == 0
    assert say(-1) == 0x83
    assert "in the future: set the clocks" in harness.counters().last_error
    driver.drive(qos=2, properties=said("yesterday"))
    assert driver.wire.written.endswith(b"(1780000000.25) or RFC 3339 (2026-05-28T20:26:40.25Z)")


async def test_a_message_expiry_that_is_left_proves_nothing(harness):
    harness.start(CommandRules(expire=0.5))
    driver = Driver(harness.broker, "a")
    command = Publish(TOPIC, GO, properties={Property.MESSAGE_EXPIRY_INTERVAL: 1})
    driver.say(command, command, command)
    await asyncio.sleep(0.2)
    assert harness.robot.received == []


# What the client is told


@pytest.mark.parametrize("rules", [None, CommandRules(expire=0.5)])
@pytest.mark.parametrize("qos", [1, 2])
@pytest.mark.parametrize(
    ("payload", "code", "reason"),
    [
        (b"{", 0x99, "cannot be converted: not JSON"),
        (b'{"linear":{"q":1}}', 0x99, "linear.q: unknown field"),
        (b'{"%s":1}' % (b"x" * 60_000), 0x99, "unknown field"),
        (b"", 0x99, "cannot be converted"),
    ],
)
async def test_a_payload_that_ros_cannot_have(harness, rules, qos, payload, code, reason):
    harness.start(rules)
    driver = Driver(harness.broker, "a")
    driver.drive(payload, qos=qos)
    packet = decode(driver.wire.written)
    assert packet.reason_code == code
    assert reason in packet.properties[Property.REASON_STRING]
    assert len(packet.properties[Property.REASON_STRING]) <= 500
    if qos == 2:  # it is done with
        driver.wire.written = b""
        driver.say(Pubrel(7))
        assert driver.wire.written[4] == 0x92
    assert harness.robot.received == []
    assert harness.counters().errors == 1
    assert reason in harness.bridge.topics()[0].last_error
    old = Driver(harness.broker, "old", version=4)
    old.drive(payload, qos=qos)
    assert len(old.wire.written) == 4
    # A good one is acknowledged as ever.
    driver = Driver(harness.broker, "b")
    driver.drive(qos=qos)
    assert decode(driver.wire.written).reason_code == 0


async def test_a_conversion_that_takes_all_of_its_turn(harness, monkeypatch):
    """What the client has sent behind the large payload is done in its next turn."""
    clock = count()
    monkeypatch.setattr(conversions, "thread_time", lambda: 0.01 * next(clock))
    harness.start(CommandRules(expire=0.5))
    driver = Driver(harness.broker, "a")
    driver.drive(b"{" + b" " * LITTLE, qos=2)
    assert decode(driver.wire.written).reason_code == 0x99
    driver.wire.written = b""
    driver.say(Pubrel(7))
    assert driver.wire.written[4] == 0x92


def decode(data):
    """The one packet that was written."""
    size, begin = decode_varint(data, 1)
    assert len(data) == begin + size
    return decode_packet(data[0], data[begin:], 5)


@pytest.mark.parametrize(("payload", "code"), [(b'{"linear":{"x":5}}', 0x83), (GO, 0)])
async def test_against_the_rules_is_another_code(harness, payload, code):
    harness.start(CommandRules(allow=(("linear.x", (0.5,)),)))
    driver = Driver(harness.broker, "a")
    driver.drive(payload, qos=1)
    assert driver.code == code


async def test_who_does_not_want_to_know_why(harness):
    harness.start(None)
    driver = Driver(harness.broker, "a")
    driver.client.output.may_explain = False
    driver.drive(b"{", qos=1)
    assert driver.wire.written == bytes((0x40, 3, 0, 7, 0x99))


# One driver for a ROS topic


@pytest.mark.parametrize("other", [None, CommandRules(), CommandRules(exclusive=True)])
@pytest.mark.parametrize("remapped", [False, True])
async def test_two_routes_to_one_ros_topic_have_one_driver(harness, other, remapped):
    ros = "/other" if remapped else "/cmd_vel"
    if remapped:
        harness.node.remapped["/other"] = "/cmd_vel"
    exclusive = CommandRules(exclusive=True)
    Harness.start(
        harness,
        TopicSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=exclusive),
        TopicSettings(ros, "ros", "r2d2/joy", TWIST, rules=other),
    )
    for name in {"/cmd_vel", ros}:
        harness.node.add_subscriber(name, TWIST)
    await harness.settle()
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")

    def joy(driver):
        driver.wire.written = b""
        driver.say(Publish("r2d2/joy", GO, qos=1, packet_id=7))
        return driver.code

    a.drive(qos=1)
    assert a.code == 0
    assert [joy(b), joy(a)] == [0x87, 0]
    a.cut()
    assert joy(b) == 0
    a = Driver(harness.broker, "a")
    a.drive(qos=1)
    is_taken = other is not None and other.exclusive
    assert a.code == (0x87 if is_taken else 0)
    assert joy(b) == (0 if is_taken else 0x87)


@pytest.mark.parametrize("stays", [0, 1])
async def test_a_lease_survives_the_end_of_another_route_to_the_topic(harness, stays):
    """Also of the one that its holder drove through; what is left sees to its end."""
    rules = CommandRules(exclusive=True, lease=60)
    routes = [
        TopicSettings("/cmd_vel", "ros", topic, TWIST, rules=rules) for topic in (TOPIC, "r2d2/joy")
    ]
    bridge = Harness.start(harness, *routes)
    harness.node.add_subscriber("/cmd_vel", TWIST)
    await harness.settle()
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    a.drive(qos=1)
    bridge.replace([routes[stays]])

    def say(driver):
        driver.wire.written = b""
        topic = routes[stays].mqtt
        driver.say(Publish(topic, GO, qos=1, packet_id=7))
        return driver.code

    assert [say(b), say(a)] == [0x87, 0]
    assert harness.commands._timer is not None
    bridge.replace([])
    bridge.replace(routes)
    harness.node.spin()
    assert say(b) == 0


# A stop overtakes what has come before it

RULES = CommandRules(expire=5.0, on_silence=OnSilence(60.0))


def start_beside(harness, rules=RULES, ros="/cmd_vel", own=RULES):
    """A route for driving, and another topic whose messages go to the same robot."""
    harness.node.remapped["/other"] = "/cmd_vel"
    bridge = Harness.start(
        harness,
        TopicSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=own),
        TopicSettings(ros, "ros", "r2d2/stop", TWIST, rules=rules),
    )
    harness.robot = harness.node.add_subscriber("/cmd_vel", TWIST)
    if ros != "/cmd_vel":
        harness.node.add_subscriber(ros, TWIST).received = harness.robot.received
    return bridge


def total(harness, counter):
    return sum(getattr(status, counter) for status in harness.bridge.status())


def stop_beside(driver, payload=b"{}", **kw):
    driver.say(Publish("r2d2/stop", payload, **kw))


@pytest.mark.parametrize("who", ["a", "b"])
@pytest.mark.parametrize("size", [0, 20_000])
@pytest.mark.parametrize(
    ("rules", "ros"),
    [(RULES, "/cmd_vel"), (RULES, "/other"), (CommandRules(), "/cmd_vel"), (None, "/cmd_vel")],
    ids=["its rules", "by another name", "without a stop message", "no rules"],
)
async def test_a_stop_on_another_topic_overtakes_what_has_come(harness, rules, ros, size, who):
    start_beside(harness, rules, ros)
    for _ in range(3):
        harness.node.spin()
    await harness.settle()
    harness.robot.received.clear()  # the stop messages of the start
    if size:
        make_busy(harness)
    drivers = {name: Driver(harness.broker, name) for name in "ab"}
    # On a busy computer a first command may be held for long enough before the stop has its turn.
    drivers["a"].wire.connection = PeerStatus(has_unread=True)
    drivers["a"].drive(large(0.5, size), qos=1)
    assert drivers["a"].code == 0
    stop_beside(drivers[who], properties=made(0))
    if size and who == "a" and rules is None:
        # Without rules nothing is known of a stop before its turn, behind the large one.
        await until(lambda: harness.robot.received)
    assert harness.robot.received == [STOP]
    drivers["a"].wire.connection = PeerStatus()
    await until(lambda: total(harness, "expired") == 1)
    assert harness.robot.received == [STOP]
    assert "a stop came after it" in harness.bridge.status()[0].last_error
    # What comes behind the stop is carried out.
    drivers["a"].steer(large(0.7, size))
    await until(lambda: harness.robot.received == [STOP, twist(0.7)])


async def test_a_stop_overtakes_what_waits_on_a_route_without_rules(harness):
    start_beside(harness, rules=None)
    make_busy(harness)
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    stop_beside(a, large(0.5))
    b.drive(b"{}")
    await until(lambda: total(harness, "expired") == 1)
    stop_beside(a, large(0.7))
    await until(lambda: harness.robot.received == [STOP, twist(0.7)])


@pytest.mark.parametrize("expiry", [0, 60])
async def test_a_stop_overtakes_what_came_on_an_earlier_connection(harness, expiry):
    harness.start(RULES)
    make_busy(harness)
    driver = Driver(harness.broker, "a", clean=not expiry, expiry=expiry)
    driver.steer(large(0.5))
    driver.leave()
    driver = Driver(harness.broker, "a", clean=not expiry, expiry=expiry)
    driver.drive(b"{}")
    await until(lambda: harness.counters().expired == 1)
    assert harness.robot.received == [STOP]


async def test_what_came_behind_a_large_stop_is_carried_out(harness):
    """Which waits for its turn itself: their order is that of their coming."""
    harness.start(RULES)
    make_busy(harness)
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    b.steer(large(0.1))
    a.drive(large(0))
    b.steer(large(0.3))
    await until(lambda: twist(0.3) in harness.robot.received)
    assert harness.robot.received in ([twist(0.1), STOP, twist(0.3)], [STOP, twist(0.3)])


async def test_a_stop_of_who_does_not_have_the_lease_overtakes_nothing(harness):
    harness.start(CommandRules(exclusive=True, expire=5.0, on_silence=OnSilence(60.0)))
    make_busy(harness).leave()
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    harness.robot.received.clear()
    a.drive(large(0))  # it waits for its turn, and is not its client's to say then
    b.steer()
    b.steer(large(0.2))
    a.drive(b"{}", qos=1)
    assert a.code == 0x87
    await until(lambda: harness.robot.received == [twist(0.5), twist(0.2)])
    assert harness.counters().refused == 2


@pytest.mark.parametrize("why", ["expired", "wrong"])
async def test_a_stop_that_is_refused_overtakes_nothing(harness, why):
    harness.start(RULES)
    make_busy(harness)
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    a.steer(large(0.1))
    over = {Property.MESSAGE_EXPIRY_INTERVAL: 0} if why == "expired" else None
    b.drive(b"{}" if over else b"{]", qos=1, properties=over)
    assert decode(b.wire.written).reason_code == (0x83 if over else 0x99)
    await until(lambda: harness.robot.received == [twist(0.1)])


@pytest.mark.parametrize("cause", ["left", "lost", "silent", "reload"])
async def test_the_bridges_own_stop_overtakes_what_has_come(harness, cause):
    rules = CommandRules(expire=5.0, on_silence=OnSilence(AFTER))
    bridge = start_beside(harness, rules, own=RULES)
    make_busy(harness)
    source, other = Driver(harness.broker, "source"), Driver(harness.broker, "other")
    stop_beside(source, GO, properties=made(0))
    if cause == "silent":
        other.wire.connection = PeerStatus(has_unread=True)  # until the silence is too long
    other.drive(GO)
    if cause == "left":
        source.leave()
    elif cause == "lost":
        source.cut()
    elif cause == "reload":
        bridge.replace([TopicSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=RULES)])
    await until(lambda: harness.robot.received == [twist(0.5), STOP])
    other.wire.connection = PeerStatus()
    await until(lambda: total(harness, "expired") == 1)
    assert harness.robot.received == [twist(0.5), STOP]


async def test_a_stop_that_ros_does_not_take_overtakes_what_has_come(harness, monkeypatch):
    harness.start(RULES)
    make_busy(harness)
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    a.steer(large(0.1))
    publisher = harness.commands.follower.publication.outlet.publisher

    def fail(cdr):
        raise BusError("on purpose")

    with monkeypatch.context() as patch:
        patch.setattr(type(publisher), "publish", lambda _, cdr: fail(cdr))
        b.drive(b"{}", qos=1)
    assert b.code == 0x83
    await until(lambda: harness.counters().expired == 1)
    assert harness.robot.received == []


async def test_the_stop_of_the_start_overtakes_nothing(harness):
    """It is for what was before."""
    start_beside(harness)
    Driver(harness.broker, "a").drive()
    for _ in range(3):
        harness.node.spin()
    await until(lambda: harness.robot.received == [STOP, STOP, twist(0.5)])


@pytest.mark.parametrize("stops", [True, False])
async def test_a_stop_overtakes_a_retained_command_that_is_awaited(harness, stops):
    rules = CommandRules(take_retained=True, on_silence=OnSilence(60.0))
    start_beside(harness, own=rules)
    a, b = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    a.drive(retain=True)
    if stops:
        stop_beside(b)
    harness.robot.received.clear()
    for _ in range(3):
        harness.node.spin()
    await harness.settle()
    assert (twist(0.5) in harness.robot.received) is not stops


@pytest.mark.parametrize("size", [0, 2000])
@pytest.mark.parametrize(
    "off", ["36 s ahead", "a minute ahead", "an hour ahead", "milliseconds", "no zone"]
)
@pytest.mark.parametrize("qos", [0, 1, 2])
async def test_a_stop_whose_sent_at_is_wrong_is_carried_out(harness, qos, off, size):
    harness.start(CommandRules(expire=60, on_silence=OnSilence(60.0)))
    driver, other = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    other.steer()
    now = time.time()
    text = {
        "36 s ahead": str(now + 36),  # by less than `expire`
        "a minute ahead": str(now + 60),
        "an hour ahead": str(now + 3600),
        "milliseconds": str(int(now * 1000)),
        "no zone": "2026-05-28T20:26:40",
    }[off]
    for payload in (b"{}", GO):
        driver.drive(payload + b" " * size, qos=qos, properties=said(text))
        if qos == 2:
            driver.say(Pubrel(7))
    await until(lambda: harness.robot.received == [twist(0.5), STOP])
    await until(lambda: harness.counters().errors == 1)  # what is no stop is refused as before
    assert "sent-at" in harness.counters().last_error


@pytest.mark.parametrize("presses", [0, 4])
def test_what_is_known_by_a_long_expire_is_not_known_by_a_short_one(presses):
    """A route of lights that takes commands of 10 s, and one that drives, of 0.5 s."""
    sender = Sender()
    lights = 10.0
    for _ in range(presses):
        sender.now += 1.2
        sender.staleness.judge(sender, 0, lights, sender.now)
    for _ in range(6):
        sender.say(0.05)
    assert sender.moved
    sender.moved.clear()
    sender.now += 3
    sender.staleness.judge(sender, 0, lights, sender.now)
    for _ in range(20):
        sender.say(0, "old")
    sender.rest(1)
    assert sender.moved == []


async def test_a_route_that_cannot_convert_the_first_of_a_queue_lets_no_other_carry_it_out(harness):
    rules = CommandRules(expire=0.5)
    Harness.start(
        harness,
        TopicSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=rules),
        TopicSettings("/number", "ros", TOPIC, INT, rules=rules),
        TopicSettings("/lamp", "ros", "r2d2/lamp", TWIST, rules=rules),
    )
    robot = harness.node.add_subscriber("/cmd_vel", TWIST)
    driver = Driver(harness.broker, "a")
    driver.say(Publish(TOPIC, GO), *[Publish("r2d2/lamp", GO)] * 5)
    await asyncio.sleep(0.3)  # longer than a first command waits
    assert robot.received == []


def test_a_qos_2_command_of_two_routes_is_looked_at_once():
    sender = Sender(2)
    verdicts = []
    for number in range(6):
        sender.now += 0.05
        for _ in range(2):
            sender.staleness.observe_unreleased(sender, sender.OLDEST, sender.now, number)
        verdicts.append(sender.staleness.judge(sender, 2, sender.OLDEST, sender.now, number))
    assert verdicts[2:] == [CommandVerdict.CARRY_OUT] * 4


@pytest.mark.parametrize("pace", [0, 0.05])
async def test_each_message_of_a_plugin_is_a_command_of_its_own(harness, pace):
    """It comes from inside: no packet from the network tells one from another."""
    harness.start(CommandRules(expire=0.5))
    begun = asyncio.get_running_loop().time()
    for number in range(6):
        harness.broker.accounting.now = begun + number * pace
        harness.client.send(TOPIC, GO)
    assert len(harness.robot.received) == (4 if pace else 0)
    await asyncio.sleep(0.2)  # longer than a first command waits
    assert len(harness.robot.received) == (4 if pace else 0)


FRESH = CommandRules(expire=60.0)


@pytest.mark.parametrize(
    "way", ["reload", "late", "overtaken", "turn, reload", "turn, overtaken", "fault", "kept"]
)
async def test_a_single_command_behind_one_that_was_dropped(harness, monkeypatch, escaped, way):
    """What waits no longer is nothing that the next one would be a queue with."""
    rules = CommandRules(
        expire=60.0, on_silence=OnSilence(60.0), take_retained=way == "kept", exclusive=False
    )
    bridge = start_beside(harness, own=rules)
    for _ in range(3 * (way != "kept")):
        harness.node.spin()
    await harness.settle()
    harness.robot.received.clear()
    if way.startswith("turn"):
        make_busy(harness)
    driver, other = Driver(harness.broker, "a"), Driver(harness.broker, "b")
    if way == "late":  # by the rule of a route with a short expire
        bridge.replace(
            [
                TopicSettings("/lamp", "ros", "r2d2/lamp", TWIST, rules=CommandRules(expire=0.15)),
                TopicSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=rules),
            ]
        )
        lamp = harness.node.add_subscriber("/lamp", TWIST)
        await harness.settle()
        driver.wire.connection = PeerStatus(has_unread=True)
        driver.say(Publish("r2d2/lamp", GO))
        await until(lambda: total(harness, "expired") == 1)
        assert lamp.received == []
        driver.wire.connection = PeerStatus()
    elif way == "fault":
        with monkeypatch.context() as patch:
            patch.setattr(Commands, "_read", lambda *_: 1 / 0)
            driver.drive()
    else:
        driver.drive(large(0.1) if way.startswith("turn") else GO, retain=way == "kept")
    if way.endswith("reload"):
        bridge.replace([TopicSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=FRESH)])
        harness.node.spin()
        await until(lambda: not bridge._conversions.is_busy)
    elif way.endswith("overtaken"):
        stop_beside(other, properties=made(0))
        await until(lambda: total(harness, "expired") == 1)
    await asyncio.sleep(0.3)  # no burst
    harness.robot.received.clear()
    driver.drive(b'{"linear":{"x":0.9}}')
    await until(lambda: harness.robot.received == [twist(0.9)], timeout=3)
    escaped.clear()


async def test_who_left_before_its_turn_and_is_back_is_not_stopped(harness):
    harness.start(RULES)
    make_busy(harness)
    driver = Driver(harness.broker, "a", clean=False, expiry=60)
    driver.steer(large(0.1))
    driver.leave()
    driver = Driver(harness.broker, "a", clean=False, expiry=60)
    driver.steer(large(0.2))
    await until(lambda: len(harness.robot.received) == 2)
    assert harness.robot.received == [twist(0.1), twist(0.2)]
    driver.leave()
    assert harness.robot.received == [twist(0.1), twist(0.2), STOP]


@pytest.mark.parametrize("version", [4, 5])
@pytest.mark.parametrize("size", [0, 5000])
@pytest.mark.parametrize(
    ("what", "counter"), [("against", "refused"), ("bad", "errors"), ("old", "expired")]
)
async def test_a_qos_2_command_that_is_refused_is_counted_once(
    harness, version, size, what, counter
):
    """3.1.1 cannot refuse at its PUBREC: the exchange goes on, and it is refused in the end."""
    harness.start(CommandRules(expire=0.5, allow=(("linear.z", (0.0,)),)))
    driver = Driver(harness.broker, "a", version=version)
    if what == "old":
        driver.drive(b'{"linear":{"x":1}}' + b" " * size, qos=2, dup=True)
    else:
        payload = b'{"linear":{"z":1}}' if what == "against" else b"{]"
        driver.drive(payload + b" " * size, qos=2)
    driver.say(Pubrel(7))
    await until(lambda: getattr(harness.counters(), counter))
    await until(lambda: not harness.bridge._conversions.is_busy)
    counters = harness.counters()
    assert (counters.refused, counters.errors, counters.expired) == tuple(
        int(name == counter) for name in ("refused", "errors", "expired")
    )
    assert harness.robot.received == []


@pytest.mark.parametrize("lights", [0, 1])
def test_the_pace_of_qos_2_of_a_long_expire_is_not_that_of_a_short_one(lights):
    """Old commands that come one by one behind a stall, each when the one before is answered."""
    sender = Sender(2)
    for _ in range(6):
        sender.say(0.05)
    assert sender.moved
    sender.moved.clear()
    sender.now += 3
    for _ in range(lights):
        sender.staleness.observe_unreleased(sender, 10.0, sender.now)
        sender.staleness.judge(sender, 2, 10.0, sender.now)
    for _ in range(40):
        withheld = sum(sender.link.withheld)
        sender.link.withheld.clear()
        sender.say(0.05 + withheld, "old")
    sender.rest(1)
    assert sender.moved == []


class Stick:
    """A client that repeats its stop, as a joystick does that nobody touches."""

    def __init__(self, harness, name):
        self.driver = Driver(harness.broker, name)

    def say(self, times=1):
        for _ in range(times):
            self.driver.drive(b"{}")


@pytest.mark.parametrize("sticks", [1, 2])
@pytest.mark.parametrize("size", [0, 20_000])
async def test_an_idle_stick_overtakes_no_command_of_others(harness, size, sticks, monkeypatch):
    monkeypatch.setattr(lease, "REPEAT_WITHIN", math.inf)
    harness.start(RULES)
    idle = [Stick(harness, f"stick {number}") for number in range(sticks)]
    for one in idle:
        one.say(REPEATED)
    for number in range(3):
        driver = Driver(harness.broker, f"driver {number}")
        await until(lambda: not harness.bridge._conversions.is_busy)
        if size:
            make_busy(harness)
            for one in idle:  # what moved the robot came before
                one.say()
        harness.robot.received.clear()
        driver.drive(large(0.5, size), qos=1)
        assert (driver.code, twist(0.5) in harness.robot.received) == (0, False)
        for one in idle:
            one.say(2)
        await until(lambda: twist(0.5) in harness.robot.received)
        for one in idle:  # it does not lock either way: the robot is stopped again
            one.say()
        assert harness.robot.received[-1] == STOP
    assert harness.counters().expired == 0


async def test_an_idle_stick_overtakes_its_own_commands(harness):
    harness.start(RULES)
    stick = Stick(harness, "stick")
    stick.say(REPEATED)
    make_busy(harness)
    stick.say()
    stick.driver.steer(large(0.5))
    stick.driver.steer(large(0.6))
    harness.robot.received.clear()
    stick.say()
    await until(lambda: harness.counters().expired == 2)
    assert harness.robot.received == [STOP]


@pytest.mark.parametrize("before", ["nothing", "a pause", "a few", "a command", "movement"])
async def test_a_stop_that_is_not_only_repeated_overtakes(harness, monkeypatch, before):
    """Also where the robot stands, and a stick says so all the time."""
    harness.start(RULES)
    idle, stopper = Stick(harness, "stick"), Stick(harness, "emergency stop")
    other, driver = Driver(harness.broker, "other"), Driver(harness.broker, "driver")
    idle.say(REPEATED)
    if before == "a pause":
        stopper.say(REPEATED)
        with monkeypatch.context() as patch:
            patch.setattr(lease, "REPEAT_WITHIN", -1.0)
            stopper.say()
    elif before == "a few":
        stopper.say(REPEATED - 2)
    elif before == "a command":
        stopper.say(REPEATED)
        stopper.driver.steer()
        idle.say()
    elif before == "movement":
        stopper.say(REPEATED)
    driver.drive()
    if before == "movement":
        other.steer(b'{"linear":{"x":0.7}}')
    else:
        idle.say()
    harness.robot.received.clear()
    stopper.say()
    await until(lambda: harness.counters().expired == 1)
    assert harness.robot.received == [STOP]


def test_what_is_known_of_stops_is_bounded(monkeypatch):
    monkeypatch.setattr(lease, "MAX_CLIENTS", 2)
    shared = lease.Lease("/cmd_vel")
    shared.add_route(AnyStops())
    clients = [Sender(client_id=name) for name in "abc"]
    number = 0
    for client in clients:
        for _ in range(REPEATED + 1):
            number += 1
            shared.on_published(STOP, number, client, 0.0)
    assert len(shared._stops) == 2
    # What is forgotten has overtaken what came before it all the same.
    assert shared.is_overtaken(REPEATED, clients[0])
    assert not shared.is_overtaken(number, clients[2])
    assert shared.is_overtaken(number - 1, clients[2])


class AnyStops:
    """A route that takes all for a stop."""

    is_exclusive = False

    def watch(self):
        """It has nothing to look at."""

    def is_stop_message(self, cdr):
        return True


async def test_who_leaves_with_a_queue_is_followed_by_the_stop_behind_its_last(harness):
    harness.start(RULES)
    make_busy(harness)
    driver = Driver(harness.broker, "a")
    for x in (0.1, 0.2, 0.3):
        driver.steer(large(x))
    driver.leave()
    await until(lambda: STOP in harness.robot.received)
    assert harness.robot.received == [twist(0.1), twist(0.2), twist(0.3), STOP]
    assert harness.counters().expired == 0


async def test_who_drove_and_leaves_with_a_queue_is_followed_by_the_stop_behind_its_last(harness):
    harness.start(RULES)
    driver = Driver(harness.broker, "a")
    driver.steer(large(0.1))
    for x in (0.2, 0.3):
        driver.steer(large(x))
    driver.leave()
    await until(lambda: STOP in harness.robot.received)
    assert harness.robot.received == [twist(0.1), twist(0.2), twist(0.3), STOP]


@pytest.mark.parametrize("way", ["leave", "cut"])
async def test_who_drove_and_is_gone_is_followed_by_the_stop_at_once(harness, way):
    """Where nothing of its queue is carried out, nothing is waited for."""
    harness.start(RULES)
    driver = Driver(harness.broker, "a")
    driver.steer(large(0.1))
    driver.drive(large(0.2, 5000), properties=made(0 if way == "cut" else 60))
    getattr(driver, way)()
    assert harness.robot.received == [twist(0.1), STOP]


@pytest.mark.parametrize("last", ["old", "wrong"])
async def test_who_leaves_is_followed_by_a_stop_though_its_last_is_not_carried_out(harness, last):
    harness.start(RULES)
    make_busy(harness)
    driver = Driver(harness.broker, "a")
    driver.steer(large(0.1))
    if last == "old":
        driver.steer(large(0.2), properties={Property.MESSAGE_EXPIRY_INTERVAL: 1})
        (queue,) = harness.commands._queued.values()
        queue[-1].message.expires_at = -math.inf
    else:
        driver.steer(b"[]" + b" " * 20_000)
    driver.leave()
    await until(lambda: STOP in harness.robot.received)
    assert harness.robot.received == [twist(0.1), STOP]


@pytest.mark.parametrize("qos", [0, 1, 2])
async def test_the_first_command_of_a_connection_that_was_not_read_for_a_time(harness, qos):
    harness.start(CommandRules(expire=0.5))
    driver = Driver(harness.broker, "a")
    driver.wire.connection = PeerStatus(held=1.2)
    driver.say(Publish(TOPIC, GO, qos=qos, packet_id=7 if qos else None))
    driver.wire.connection = PeerStatus()
    if qos == 2:
        driver.say(Pubrel(7))
    await until(lambda: harness.counters().expired == 1)
    await asyncio.sleep(0.3)  # longer than a first command waits
    assert harness.robot.received == []


@pytest.mark.parametrize("qos", [0, 1, 2])
def test_what_was_held_is_old_also_for_the_route_with_the_shorter_expire(qos):
    """A client that switches lights each 1.2 s, then nothing it sends is read for a time."""
    sender = Sender(qos)
    lights = 10.0
    for _ in range(4):
        sender.now += 1.2
        sender.staleness.judge(sender, qos, lights, sender.now)
    sender.link.held = 3.0
    sender.now += 0.4
    if qos == 2:
        sender.staleness.observe_unreleased(sender, sender.OLDEST, sender.now, 1)
        sender.link.held = 0.0
        sender.now += 0.2  # until its PUBREL
    verdict = sender.staleness.judge(sender, qos, sender.OLDEST, sender.now, 1)
    assert verdict is CommandVerdict.REFUSE


@pytest.mark.parametrize("first", ["the lights", "the robot"])
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_what_was_held_is_old_for_one_of_two_routes(qos, first):
    """One message that two routes take, of which one has a long `expire`."""
    sender = Sender(qos)
    order = [10.0, sender.OLDEST][:: 1 if first == "the lights" else -1]
    sender.link.held = 3.0
    if qos == 2:
        for oldest in order:
            sender.staleness.observe_unreleased(sender, oldest, sender.now, 1)
        sender.link.held = 0.0
        sender.now += 0.05
    verdicts = {
        oldest: sender.staleness.judge(sender, qos, oldest, sender.now, 1) for oldest in order
    }
    assert verdicts[sender.OLDEST] is CommandVerdict.REFUSE


def test_a_qos_2_command_that_was_held_behind_others_that_were():
    """It is old for a route with a short `expire` also when its PUBREL was not held any more."""
    sender = Sender(2)
    lights = 2.0
    sender.link.held = 3.0
    for _ in range(3):
        sender.now += 1.2
        sender.staleness.judge(sender, 0, lights, sender.now)
    sender.now += 0.4
    sender.staleness.observe_unreleased(sender, sender.OLDEST, sender.now, 1)
    sender.link.held = 0.0
    sender.now += 0.2
    verdict = sender.staleness.judge(sender, 2, sender.OLDEST, sender.now, 1)
    assert verdict is CommandVerdict.REFUSE
