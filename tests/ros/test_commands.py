"""What holds for commands on their way to ROS, on a FakeNode and the real broker."""

from __future__ import annotations

import asyncio
import logging
import math
import struct
import time

import pytest
from waiting import until

from appliance.broker.broker import Broker
from appliance.broker.client import Client as NetworkClient
from appliance.broker.message import Late, Message
from appliance.broker.ports import Decision
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Connect, Disconnect, Publish, Pubrel, Will
from appliance.ros.backlog import EXPECTED, Backlog
from appliance.ros.bridge import RouteSettings
from appliance.ros.calls import Answer, CallCounters, Offer
from appliance.ros.careful import ConversionError
from appliance.ros.convert import Converter
from appliance.ros.node import Durability, Endpoint, FakePeer, QosProfile
from appliance.ros.rules import CommandRules, FieldLimits, OnSilence
from appliance.store import MemoryStore

pytest.importorskip("geometry_msgs.msg")
from test_bridge import INT, STRING, TWIST, Client, House

from appliance.ros.definitions import import_message, load_description

FLOAT = "std_msgs/msg/Float32"
TOPIC = "r2d2/cmd_vel"
GO = b'{"linear":{"x":0.5}}'
AFTER = 0.1


def twist(x=0.0, z=0.0):
    return b"\0\1\0\0" + struct.pack("<6d", x, 0, 0, 0, 0, z)


STOP = twist()


class AllAllowed:
    epoch = 0

    def decide(self, identity, action, topic):
        return Decision(True, "everything is")


class All(dict):
    """All types that are installed."""

    def __contains__(self, name):
        return True

    def __getitem__(self, name):
        return import_message(name)


class Wire:
    """A network client's connection; what is written to it can be read as packets."""

    address = "192.0.2.1:4000"

    def __init__(self):
        self.written = b""
        self.closed = False

    def authenticate(self, connect):
        pass

    def now(self):
        return time.monotonic()

    def accepted(self, account):
        pass

    def later(self):
        pass

    def write(self, chunks):
        self.written += b"".join(chunks)

    def close(self):
        self.closed = True

    abort = close


class Driver:
    """A client with a connection, as the network's clients have it."""

    def __init__(self, broker, name, version=5, clean=True, expiry=0, will=None):
        self.broker = broker
        self.version = version
        self.wire = Wire()
        self.client = NetworkClient(broker, self.wire)
        properties = {Property.SESSION_EXPIRY_INTERVAL: expiry} if expiry else None
        self.say(
            Connect(name, clean_start=clean, will=will, properties=properties, version=version)
        )
        self.client.accept("user")
        broker.flush()
        self.wire.written = b""

    def say(self, *packets):
        self.client.receive(b"".join(packet.encode(self.version) for packet in packets))
        self.broker.flush()

    def drive(self, payload=GO, qos=0, **kw):
        self.say(Publish(TOPIC, payload, qos=qos, packet_id=7 if qos else None, **kw))

    def cut(self):
        self.client.lost()
        self.broker.flush()

    @property
    def code(self):
        """The reason code of the PUBACK that came last."""
        assert self.wire.written[0] == 0x40
        return self.wire.written[4] if self.wire.written[1] > 2 else 0


class CommandHouse(House):
    def start(self, rules, **kw):
        settings = RouteSettings("/cmd_vel", "ros", "r2d2{ros}", kw.pop("type", TWIST), rules=rules)
        bridge = super().start(settings)
        self.robot = self.node.add_subscriber("/cmd_vel", kw.pop("found", TWIST))
        return bridge

    def counters(self):
        return self.status("to_ros")


@pytest.fixture
async def house():
    house = CommandHouse()
    house.broker = Broker(AllAllowed(), MemoryStore())
    house.client = Client(house.broker)
    yield house
    await house.bridge.stop()
    assert house.broker.departures == []
    assert house.broker.guards == {}


# Old commands


async def test_message_expiry(house):
    house.start(CommandRules(expire=0.5))
    driver = Driver(house.broker, "a")
    driver.drive(properties={Property.MESSAGE_EXPIRY_INTERVAL: 1})
    driver.drive(properties={Property.MESSAGE_EXPIRY_INTERVAL: 0})
    assert house.robot.received == [twist(0.5)]
    assert house.counters().expired == 1
    assert [topic.expired for topic in house.bridge.topics()] == [1]


async def test_what_is_sent_again_is_old(house):
    house.start(CommandRules(expire=0.1))
    driver = Driver(house.broker, "a")
    driver.drive(qos=1, dup=True)
    driver.drive(qos=1, dup=True, properties={Property.CONTENT_TYPE: "application/json"})
    assert house.robot.received == []
    assert house.counters().expired == 2
    # And so is what comes right behind it: its client had it in a queue.
    driver.drive(b'{"linear":{"x":9}}', qos=1)
    assert house.robot.received == []
    Driver(house.broker, "b").drive(b'{"linear":{"x":1}}')
    await asyncio.sleep(0.1)
    driver.drive(qos=1)
    assert house.robot.received == [twist(1), twist(0.5)]


async def test_without_expire_all_is_published(house):
    house.start(CommandRules(exclusive=True))
    Driver(house.broker, "a").drive(qos=1, dup=True)
    assert house.robot.received == [twist(0.5)]


async def test_a_qos_2_command_is_as_old_as_its_publish(house):
    house.start(CommandRules(expire=0.15))
    driver = Driver(house.broker, "a", expiry=100)
    driver.drive(qos=2)
    driver.say(Pubrel(7))
    assert house.robot.received == [twist(0.5)]
    driver.drive(b'{"linear":{"x":2}}', qos=2)
    await asyncio.sleep(0.16)
    driver.say(Pubrel(7))
    assert len(house.robot.received) == 1
    await asyncio.sleep(0.16)
    driver.drive(b'{"linear":{"x":3}}', qos=2)
    driver.cut()
    again = Driver(house.broker, "a", clean=False, expiry=100)
    again.say(Pubrel(7))
    assert len(house.robot.received) == 1
    assert house.counters().expired == 2


async def test_what_two_clients_had_queued_is_old_of_both(house):
    house.start(CommandRules(expire=0.5))
    a, b = Driver(house.broker, "a"), Driver(house.broker, "b")
    for driver in (a, b):
        driver.drive(qos=1, dup=True)
    for driver in (a, b):
        driver.drive()
    assert house.robot.received == []
    assert house.counters().expired == 4
    a.cut()
    Driver(house.broker, "a").drive()
    assert house.robot.received == [twist(0.5)]


async def test_a_will_is_as_old_as_its_connection(house):
    house.start(CommandRules(expire=0.5))
    driver = Driver(house.broker, "a", will=Will(TOPIC, GO))
    driver.cut()
    assert house.robot.received == []
    assert house.counters().expired == 1


async def test_retained_commands_only_where_asked_for(house):
    house.client.send(TOPIC, GO, retain=True)
    house.start(CommandRules(expire=0.5))
    house.node.spin()
    await house.settle()
    assert house.robot.received == []
    house.bridge.replace(
        [RouteSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=CommandRules(take_retained=True))]
    )
    for _ in range(3):
        house.node.spin()
        await house.settle()
    assert house.robot.received == [twist(0.5)]


async def test_a_retained_command_of_unknown_age_is_old_where_commands_expire(house):
    house.client.send(TOPIC, GO, retain=True)
    house.start(CommandRules(expire=0.5, take_retained=True))
    for _ in range(3):
        house.node.spin()
        await house.settle()
    assert house.robot.received == []
    assert house.counters().expired == 1


async def test_late_messages_are_as_others_to_other_clients(house):
    house.start(CommandRules(expire=0.5))
    house.client.subscribe("r2d2/#")
    driver = Driver(house.broker, "a")
    properties = {Property.USER_PROPERTY: [("a", "b")]}
    driver.drive(qos=1, dup=True, properties=properties)
    message, qos = house.client.received[-1]
    assert isinstance(message, Late)
    assert (message.payload, message.properties, qos) == (GO, properties, 1)


# One at a time


async def test_one_client_at_a_time(house, caplog):
    caplog.set_level(logging.INFO)
    house.start(CommandRules(exclusive=True, lease=0.1))
    a, b = Driver(house.broker, "a"), Driver(house.broker, "b")
    old = Driver(house.broker, "old", version=4)
    a.drive(qos=1)
    assert a.code == 0
    b.drive(b'{"linear":{"x":9}}', qos=1)
    assert b.code == 0x87
    old.drive(b'{"linear":{"x":9}}')  # 3.1.1 and QoS 0 cannot be told
    assert house.robot.received == [twist(0.5)]
    assert house.counters().refused == 2
    (topic,) = house.bridge.topics()
    assert (topic.messages, topic.refused, topic.errors) == (1, 2, 0)
    assert "client 'a' (user 'user') commands /cmd_vel, and the route is exclusive" in caplog.text
    # For as long as it goes on.
    for _ in range(4):
        await asyncio.sleep(0.05)
        a.drive()
        b.drive(b'{"linear":{"x":9}}')
    assert set(house.robot.received) == {twist(0.5)}
    await until(lambda: "was silent for 0.1 s and commands no more" in caplog.text)
    b.wire.written = b""
    b.drive(b'{"linear":{"x":0.2}}', qos=1)
    assert b.code == 0
    assert house.robot.received[-1] == twist(0.2)
    a.wire.written = b""
    a.drive(qos=1)
    assert a.code == 0x87


async def test_a_lease_ends_with_the_connection(house):
    house.start(CommandRules(exclusive=True, lease=60))
    a, b = Driver(house.broker, "a", expiry=100), Driver(house.broker, "b")
    a.drive()
    b.drive(b"{}", qos=1)
    assert b.code == 0x87
    a.cut()
    b.wire.written = b""
    b.drive(b"{}", qos=1)
    assert b.code == 0
    assert house.robot.received == [twist(0.5), STOP]


async def test_refused_commands_reach_nobody_else(house):
    house.start(CommandRules(exclusive=True))
    house.client.subscribe(TOPIC)
    a, b = Driver(house.broker, "a"), Driver(house.broker, "b")
    a.drive()
    b.drive(b"nobody sees it", qos=1)
    assert house.client.payloads(TOPIC) == [GO]


async def test_a_qos_2_command_whose_lease_was_lost_meanwhile(house):
    house.start(CommandRules(exclusive=True))
    a, b = Driver(house.broker, "a"), Driver(house.broker, "b")
    a.drive(qos=2)
    b.drive(b'{"linear":{"x":9}}')
    a.say(Pubrel(7))
    assert house.robot.received == [twist(9)]


async def test_what_ros_says_on_a_topic_of_both_ways_needs_no_lease(house):
    rules = CommandRules(exclusive=True)
    super(CommandHouse, house).start(RouteSettings("/cmd_vel", "both", TOPIC, TWIST, rules=rules))
    house.client.subscribe(TOPIC)
    other = house.node.add_publisher("/cmd_vel", TWIST)
    Driver(house.broker, "a").drive()
    other.publish(twist(0.25))
    await house.settle()
    assert [p for p in house.client.payloads(TOPIC) if b"0.25" in p]


# Silence


@pytest.mark.timed
async def test_the_stop_message_follows_silence_in_time(house, caplog):
    house.start(CommandRules(on_silence=OnSilence(AFTER)))
    driver = Driver(house.broker, "a")
    for _ in range(5):
        driver.drive()
        last = time.monotonic()
        await asyncio.sleep(AFTER / 2)
    assert house.robot.received == [twist(0.5)] * 5
    await until(lambda: house.robot.received[-1] == STOP)
    assert AFTER <= time.monotonic() - last < AFTER + 0.05
    await asyncio.sleep(2 * AFTER)
    assert len(house.robot.received) == 6  # once
    assert house.counters().stops == 1
    assert "fell silent for 0.1 s" in caplog.text


async def test_who_drives_and_falls_silent_is_disconnected(house):
    """The network may have its commands yet, which are old by then."""
    house.start(CommandRules(on_silence=OnSilence(AFTER)))
    driver = Driver(house.broker, "a")
    driver.drive()
    await until(lambda: driver.wire.closed)
    assert driver.wire.written == Disconnect(0x98).encode(5)
    driver.drive()
    assert house.robot.received == [twist(0.5), STOP]
    driver = Driver(house.broker, "a")
    driver.drive()  # what it had queued, perhaps
    assert house.robot.received == [twist(0.5), STOP]
    await asyncio.sleep(AFTER + 0.02)
    driver.drive()
    assert house.robot.received[-1] == twist(0.5)


@pytest.mark.parametrize("other_drives_on", [True, False])
async def test_of_two_who_drive_each_that_falls_silent_is_disconnected(house, other_drives_on):
    house.start(CommandRules(on_silence=OnSilence(AFTER)))
    a, b = Driver(house.broker, "a"), Driver(house.broker, "b")
    a.drive()
    b.drive()

    def is_over():
        if other_drives_on:
            b.drive()
        return a.wire.closed

    await until(is_over)
    if not other_drives_on:
        await until(lambda: b.wire.closed)
    before = len(house.robot.received)
    Driver(house.broker, "a").drive()  # what it had queued, perhaps
    assert len(house.robot.received) == before


@pytest.mark.parametrize("stops_itself", [True, False])
async def test_who_has_stopped_or_may_be_silent_stays(house, stops_itself):
    house.start(CommandRules(on_silence=OnSilence(AFTER, disconnect=stops_itself)))
    driver = Driver(house.broker, "a")
    driver.drive()
    if stops_itself:
        driver.drive(b"{}")
    await asyncio.sleep(2 * AFTER)
    assert not driver.wire.closed
    assert house.robot.received[-1] == STOP


async def test_a_stop_message_at_another_time_is_one_too(house):
    stamped = "geometry_msgs/msg/TwistStamped"
    house.node.types = All()
    rules = CommandRules(on_silence=OnSilence(AFTER, '{"header": {"stamp": "now"}}'))
    house.start(rules, type=stamped, found=stamped)
    driver = Driver(house.broker, "a")
    driver.drive(b'{"header":{"stamp":{"sec":5},"frame_id":"base"}}')
    await until(lambda: house.counters().stops)
    assert not driver.wire.closed
    seconds = struct.unpack_from("<i", house.robot.received[-1], 4)[0]
    assert abs(seconds - time.time()) < 5


@pytest.mark.parametrize("expiry", [0, 100])
async def test_the_stop_message_follows_a_lost_connection_at_once(house, expiry):
    house.start(CommandRules(on_silence=OnSilence(60), expire=1))
    driver = Driver(house.broker, "a", expiry=expiry, will=Will(TOPIC, GO))
    driver.drive()
    driver.cut()
    assert house.robot.received == [twist(0.5), STOP]


async def test_who_leaves_without_having_driven_stops_nobody(house):
    house.start(CommandRules(on_silence=OnSilence(60)))
    a, b = Driver(house.broker, "a"), Driver(house.broker, "b")
    b.drive()
    a.drive()
    b.cut()
    assert house.robot.received == [twist(0.5)] * 2
    a.say(Disconnect())
    assert house.robot.received[-1] == STOP


async def test_a_lost_lease_stops_as_well(house):
    house.start(CommandRules(exclusive=True, lease=AFTER, on_silence=OnSilence(60)))
    Driver(house.broker, "a").drive()
    await until(lambda: house.robot.received[-1] == STOP)


async def test_once_at_the_start(house):
    house.start(CommandRules(on_silence=OnSilence(60)))
    house.node.spin()
    await house.settle()
    assert house.robot.received == [STOP]
    for _ in range(5):
        house.node.spin()
        await house.settle()
    assert house.robot.received == [STOP]
    assert house.counters().stops == 1


async def test_a_command_that_is_there_first_is_not_stopped_by_the_start(house):
    house.start(CommandRules(on_silence=OnSilence(60)))
    Driver(house.broker, "a").drive()
    for _ in range(5):
        house.node.spin()
        await house.settle()
    assert house.robot.received == [twist(0.5)]


async def test_the_end_of_the_route_or_the_bridge_stops_who_is_driven(house):
    rules = CommandRules(on_silence=OnSilence(60))
    bridge = house.start(rules)
    told = len(house.broker.departures)
    Driver(house.broker, "a").drive()
    bridge.replace([RouteSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=CommandRules(expire=1))])
    assert house.robot.received == [twist(0.5), STOP]
    assert len(house.broker.departures) == told
    house.node.spin()
    bridge.replace([RouteSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=rules)])
    house.node.spin()
    Driver(house.broker, "b").drive()
    await bridge.stop()
    assert house.robot.received == [twist(0.5), STOP, twist(0.5), STOP]


async def test_who_fell_silent_is_disconnected_though_its_route_has_changed(house):
    bridge = house.start(CommandRules(on_silence=OnSilence(AFTER)))
    stalled, gone = Driver(house.broker, "a"), Driver(house.broker, "b")
    gone.drive()
    gone.cut()
    stalled.drive()
    rules = CommandRules(on_silence=OnSilence(2 * AFTER))
    bridge.replace([RouteSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=rules)])
    await until(lambda: stalled.wire.closed)
    before = len(house.robot.received)
    for name in ("a", "b"):
        Driver(house.broker, name).drive()  # what they had queued, perhaps
    assert len(house.robot.received) == before


async def test_a_lease_and_a_driver_survive_a_reload(house):
    rules = CommandRules(exclusive=True, on_silence=OnSilence(60))
    settings = RouteSettings("/cmd_vel", "ros", "r2d2{ros}", TWIST, rules=rules)
    bridge = house.start(rules)
    a, b = Driver(house.broker, "a"), Driver(house.broker, "b")
    a.drive()
    bridge.replace([settings, RouteSettings("/new", "mqtt", "r2d2{ros}")])
    house.node.spin()
    b.drive(qos=1)
    assert b.code == 0x87
    assert house.robot.received == [twist(0.5)]
    a.cut()
    assert house.robot.received == [twist(0.5), STOP]


async def test_a_stop_message_that_ros_does_not_take_is_tried_until_it_does(house):
    house.start(CommandRules(on_silence=OnSilence(60)))
    driver = Driver(house.broker, "a")
    driver.drive()
    (publisher,) = house.node.own_publishers
    publisher.error = "the transport is full"
    driver.cut()
    await asyncio.sleep(0.12)
    assert house.robot.received == [twist(0.5)]
    publisher.error = None
    await until(lambda: house.robot.received[-1] == STOP)


async def test_a_stop_message_that_is_due_while_its_publisher_is_set_up_anew(house):
    bridge = house.start(CommandRules(on_silence=OnSilence(60)))
    driver = Driver(house.broker, "a")
    driver.drive()
    (commands,) = bridge._to_ros.values()
    away, commands._out = commands._out, None
    driver.cut()
    await asyncio.sleep(0.06)
    assert house.robot.received == [twist(0.5)]
    commands._out = away
    await until(lambda: house.robot.received[-1] == STOP)


async def test_when_ros_is_lost_there_is_nobody_to_be_stopped(house):
    house.start(CommandRules(on_silence=OnSilence(AFTER)))
    driver = Driver(house.broker, "a")
    driver.drive()
    house.node.fail("gone")
    await asyncio.sleep(2 * AFTER)
    assert house.robot.received == [twist(0.5)]


@pytest.mark.parametrize(
    ("stop", "problem"),
    [
        ('{"linear":{"q":1}}', "linear.q: unknown field"),
        (f'{{"linear":{{"x":{10**400}}}}}', "not JSON: number is infinity"),
    ],
)
async def test_a_stop_message_that_the_type_has_not_is_told(house, caplog, stop, problem):
    house.start(CommandRules(on_silence=OnSilence(1, stop)))
    await house.settle()
    assert f"on_silence.publish: {problem}" in caplog.text
    Driver(house.broker, "a").drive()
    assert house.robot.received == []


# Fields


async def test_numbers_are_clamped(house, caplog):
    rules = CommandRules(clamp=(("linear.x", -0.5, 1.0), ("angular.z", 0.0, 0.0)))
    house.start(rules)
    driver = Driver(house.broker, "a")
    for x in (0.25, 7, -7, 1e308):
        driver.drive(b'{"linear":{"x":%r},"angular":{"z":1}}' % x)
    assert house.robot.received == [twist(x) for x in (0.25, 1.0, -0.5, 1.0)]
    counters = house.counters()
    assert (counters.clamped, counters.messages, counters.refused) == (4, 4, 0)
    await house.settle()
    assert len([r for r in caplog.records if "clamped" in r.getMessage()]) == 1


@pytest.mark.parametrize("x", [b"null", b"1e999"])
async def test_no_number_at_all_is_refused_where_it_is_clamped(house, x):
    house.start(CommandRules(clamp=(("linear.x", -0.5, 1.0),)))
    Driver(house.broker, "a").drive(b'{"linear":{"x":%s}}' % x)
    assert house.robot.received == []
    assert house.counters().errors == 1


async def test_cdr_is_clamped_as_well(house):
    rules = CommandRules(clamp=(("linear.x", -0.5, 1.0),))
    settings = RouteSettings("/cmd_vel", "ros", TOPIC, TWIST, encoding="cdr", rules=rules)
    super(CommandHouse, house).start(settings)
    robot = house.node.add_subscriber("/cmd_vel", TWIST)
    driver = Driver(house.broker, "a")
    driver.drive(twist(3, 1))
    driver.drive(twist(float("inf")))
    driver.drive(twist(float("nan")))
    assert robot.received == [twist(1, 1)]
    assert house.counters().refused == 2


async def test_only_some_values_are_allowed(house):
    house.start(CommandRules(allow=(("data", ("auto", "manual")),)), type=STRING, found=STRING)
    driver = Driver(house.broker, "a")
    driver.drive(b'{"data":"auto"}')
    driver.drive(b'{"data":"kill"}')
    assert len(house.robot.received) == 1
    assert house.counters().refused == 1
    assert "'kill' is not allowed, only auto, manual" in house.counters().last_error


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


async def test_no_answer_to_a_call_is_a_command(house):
    """It would come late, as the appliance's own, and outlive the client that asked for it."""
    house.start(CommandRules(on_silence=OnSilence(AFTER)))
    board = house.bridge.calls.board

    async def slow(call):
        return Answer(GO)

    offer = Offer("r2d2/slow/_call", "slow", 1.0, CallCounters(), slow)
    board.offer(offer)
    driver = Driver(house.broker, "a")
    properties = {Property.RESPONSE_TOPIC: TOPIC}
    driver.say(Publish("r2d2/slow/_call", b"", properties=properties))
    await asyncio.sleep(0.02)
    board.withdraw(offer)
    assert house.robot.received == []


class TestBacklog:
    """On times of its own."""

    NEW = Message(TOPIC, GO)

    def begin(self):
        backlog = Backlog()
        assert backlog.has(Late(self.NEW, math.inf), self, 0.5, 100.0)
        return backlog

    def test_it_takes_longer_than_a_command_may(self):
        """Bursts of it, as the acknowledgements let them through, over a slow network."""
        backlog, now = self.begin(), 100.0
        for burst in range(20):
            now = 100.0 + 0.4 * burst
            assert all(backlog.has(self.NEW, self, 0.5, now + 0.001 * n) for n in range(5))
        # Commands as they are made, of which one or the other pair comes together.
        assert backlog.has(self.NEW, self, 0.5, now + 0.4)
        assert backlog.has(self.NEW, self, 0.5, now + 0.401)
        assert not backlog.has(self.NEW, self, 0.5, now + 0.52)
        assert not backlog.has(self.NEW, self, 0.5, now + 0.521)

    def test_who_is_always_fast_is_heard_again(self):
        backlog = self.begin()
        times = [100.0 + 0.002 * n for n in range(40_000)]
        heard = next(now for now in times if not backlog.has(self.NEW, self, 0.5, now))
        assert 150 < heard < 161

    def test_clients_whose_return_is_expected_are_bounded(self):
        backlog = Backlog()
        for number in range(2 * EXPECTED):
            backlog.expect(str(number))
        assert len(backlog._expected) == EXPECTED


async def test_what_a_driver_had_queued_that_comes_back_unmarked(house):
    """Libraries queue what is said without a connection, and send it as if it were new."""
    house.start(CommandRules(on_silence=OnSilence(AFTER)))
    driver = Driver(house.broker, "a")
    driver.drive()
    driver.cut()
    assert house.robot.received == [twist(0.5), STOP]
    driver = Driver(house.broker, "a")
    for _ in range(50):
        driver.drive(qos=1)
    assert house.robot.received == [twist(0.5), STOP]
    await asyncio.sleep(1.2 * AFTER)
    driver.drive(b"{}")  # it stops by itself, and is trusted when it comes back
    assert house.robot.received == [twist(0.5), STOP, STOP]
    driver.cut()
    Driver(house.broker, "a").drive()
    assert house.robot.received == [twist(0.5), STOP, STOP, twist(0.5)]


async def test_a_stop_message_that_may_have_been_lost_is_published_again(house):
    """A publisher that was made anew has not found the robot yet: what it sends goes nowhere."""
    house.start(CommandRules(on_silence=OnSilence(AFTER)))
    house.node.spin()
    driver = Driver(house.broker, "a")
    driver.drive()
    latched = QosProfile(durability=Durability.TRANSIENT_LOCAL)
    house.node.add_subscriber("/cmd_vel", TWIST, latched)  # for which the publisher is made anew
    house.robot.received.clear()
    driver.cut()
    assert house.robot.received == [STOP]
    for _ in range(3):
        house.node.spin()
        await asyncio.sleep(0.01)
    assert house.robot.received == [STOP, STOP]


async def test_retained_commands_of_more_topics_than_one_turn_is_for(house):
    """A network client goes on in its next turn; the bridge has to be given one."""
    rules = CommandRules(take_retained=True)
    names = [f"/arm/joint_{number}" for number in range(300)]
    for name in names:
        house.client.send(f"r2d2{name}", GO, retain=True)
    robots = [FakePeer(house.node, name, Endpoint("/robot", TWIST, QosProfile())) for name in names]
    house.node.remote_subscribers += robots
    House.start(
        house, *(RouteSettings(name, "ros", "r2d2{ros}", TWIST, rules=rules) for name in names)
    )
    for _ in range(3):
        house.node.spin()
        await house.settle()
    assert [robot.received for robot in robots] == [[twist(0.5)]] * 300
    house.client.send(f"r2d2{names[-1]}", b"{}")  # nothing is left that others would wait behind
    assert robots[-1].received == [twist(0.5), STOP]


@pytest.mark.parametrize(("low", "high"), [(1e-50, 1.0), (-1.0, -1e-50)])
def test_a_bound_that_is_next_to_zero(low, high):
    converter = Converter(load_description("std_msgs/msg/Float32"), time.time_ns)
    limits = FieldLimits(CommandRules(clamp=(("data", low, high),)), converter)
    for number in (0.0, -0.0, -5.0, 5.0, 1e-45, -1e-45):
        limited, _ = limits.apply(converter.from_dict({"data": number}))
        assert low <= converter.to_dict(limited)["data"] <= high


@pytest.mark.parametrize("now", [b"", b'{"linear":{"x":0.1}}'])
async def test_a_retained_command_that_is_taken_back_before_the_robot_is_there(house, now):
    house.client.send(TOPIC, GO, retain=True)
    rules = CommandRules(take_retained=True)
    House.start(house, RouteSettings("/cmd_vel", "ros", TOPIC, TWIST, rules=rules))
    await house.settle()
    house.client.send(TOPIC, now, retain=True)
    robot = house.node.add_subscriber("/cmd_vel", TWIST)
    robot.received.clear()
    for _ in range(3):
        house.node.spin()
        await house.settle()
    assert robot.received == ([twist(0.1)] if now else [])


async def test_what_a_driver_had_queued_while_the_appliance_was_away(house):
    away = Driver(house.broker, "a", clean=False, expiry=60)
    away.cut()
    house.start(CommandRules(on_silence=OnSilence(AFTER)))
    driver = Driver(house.broker, "a", clean=False, expiry=60)
    for _ in range(50):
        driver.drive(qos=1)
    assert house.robot.received == []
    Driver(house.broker, "b").drive()
    assert house.robot.received == [twist(0.5)]
