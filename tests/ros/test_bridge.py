"""The bridge on a FakeNode and the real broker."""

from __future__ import annotations

import asyncio
import gc
import itertools
import json
import logging
import struct
import time
import weakref
from dataclasses import replace

import pytest
from waiting import until

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.mqtt.codec import Property
from appliance.ros.bridge import Bridge, BridgedTopic, TopicSettings
from appliance.ros.calls.routes import ParameterSettings
from appliance.ros.graph_follower import THOROUGH_POLL
from appliance.ros.mailbox import LARGE
from appliance.ros.node import BusError, Durability, FakeNode, Reliability
from appliance.ros.topics.echo import EchoFilter
from appliance.ros.topics.route import BridgeRoute
from appliance.ros.topics.rules import CommandRules, OnSilence
from appliance.store import MemoryStore

pytest.importorskip("std_msgs.msg")
from bridge_harness import (
    BEST_EFFORT,
    INT,
    LATCHED,
    STRING,
    TWIST,
    Harness,
    Rules,
    both,
    string,
    to_mqtt,
    to_ros,
)

from appliance.ros.payload.definitions import import_message

# ROS to MQTT


def carried(harness: Harness) -> list[tuple[Message, int]]:
    """What has come without what the appliance says of itself, which comes when it is ready."""
    return [each for each in harness.client.received if "/_appliance/" not in each[0].topic]


async def test_type_and_qos_come_from_the_publishers(harness):
    harness.start(to_mqtt("/chatter"))
    assert harness.node.subscriptions == []
    peer = harness.node.add_publisher("/chatter", STRING, type_hash="RIHS01_abc")
    peer.publish(string("hello"))
    await harness.settle()
    ((message, qos),) = carried(harness)
    assert (message.topic, message.payload, qos) == ("r2d2/chatter", b'{"data":"hello"}', 1)
    assert not message.retain
    assert message.properties == {
        Property.CONTENT_TYPE: "application/json",
        Property.USER_PROPERTY: [("ros-type", STRING), ("ros-type-hash", "RIHS01_abc")],
    }
    status = harness.status()
    assert (status.messages, status.bytes, status.errors) == (1, 16, 0)
    assert status.topics == (BridgedTopic("/chatter", "r2d2/chatter", STRING, "to_mqtt", "json"),)


@pytest.mark.parametrize(
    ("encoding", "payload", "content_type"),
    [
        ("json", b'{"data":"hi"}', "application/json"),
        ("text", b"hi", "text/plain"),
        ("cdr", string("hi"), "application/cdr"),
    ],
)
async def test_encodings(harness, encoding, payload, content_type):
    harness.start(to_mqtt("/chatter", encoding=encoding), to_ros("/say", encoding=encoding))
    listener = harness.node.add_subscriber("/say", STRING)
    harness.node.add_publisher("/chatter", STRING).publish(string("hi"))
    await harness.settle()
    ((message, _),) = carried(harness)
    assert message.payload == payload
    assert message.properties[Property.CONTENT_TYPE] == content_type
    harness.client.send("r2d2/say", payload)
    assert listener.received == [string("hi")]


async def test_best_effort_is_qos_0_and_transient_local_is_retained(harness):
    harness.start(to_mqtt("/fast"), to_mqtt("/map"))
    harness.node.add_publisher("/fast", STRING, BEST_EFFORT).publish(string("a"))
    latched = harness.node.add_publisher("/map", STRING, LATCHED)
    latched.publish(string("old"))
    latched.publish(string("new"))
    await harness.settle()
    assert [qos for m, qos in harness.client.received if m.topic == "r2d2/fast"] == [0]
    assert harness.broker.retained.get("r2d2/fast") is None
    assert harness.broker.retained.get("r2d2/map").payload == b'{"data":"new"}'


async def test_few_are_held_of_what_turns_out_to_be_large(harness):
    harness.start(to_mqtt("/text"), to_mqtt("/robot_description"))
    text = harness.node.add_publisher("/text", STRING)
    latched = harness.node.add_publisher("/robot_description", STRING, LATCHED)

    def depths():
        return {own.topic: own.endpoint.qos.depth for own in harness.node.subscriptions}

    def look():
        for _ in range(10):
            harness.node.spin()

    for peer in (text, latched):
        peer.publish(string("small"))
    look()
    assert depths() == {"/text": 1000, "/robot_description": 1000}
    for peer in (text, latched):
        peer.publish(string("x" * LARGE))
    look()
    # What is latched would come once more with a new subscription, and is not sent in bursts.
    assert depths() == {"/text": 10, "/robot_description": 1000}
    now = list(harness.node.subscriptions)
    text.publish(string("small"))
    look()
    await harness.settle()
    assert harness.node.subscriptions == now
    assert harness.client.payloads("r2d2/text")[-1] == b'{"data":"small"}'


async def test_of_what_is_late_the_newest_is_carried(harness):
    harness.node.takes_on_loop = True
    harness.start(to_mqtt("/a"), to_mqtt("/three", keep=3), to_mqtt("/map"))
    for topic, qos in (("/a", None), ("/three", None), ("/map", LATCHED)):
        harness.node.add_publisher(topic, STRING, qos)
    for own in harness.node.subscriptions:
        own.on_loop([(string(text), 0) for text in "xyz"], 1, True)
    every = [b'{"data":"x"}', b'{"data":"y"}', b'{"data":"z"}']
    assert harness.client.payloads("r2d2/a") == every[-1:]
    assert harness.client.payloads("r2d2/three") == harness.client.payloads("r2d2/map") == every
    assert sorted(status.dropped for status in harness.bridge.status()) == [1, 1, 3]


async def test_samples_from_before_the_bridge_arrive(harness):
    harness.node.add_publisher("/map", STRING, LATCHED).publish(string("early"))
    harness.start(to_mqtt("/map"))
    await harness.settle()
    assert harness.client.payloads("r2d2/map") == [b'{"data":"early"}']


async def test_the_route_may_say_qos_and_retain(harness):
    harness.start(to_mqtt("/a", qos=0, retain=True), to_mqtt("/map", qos=2, retain=False))
    harness.node.add_publisher("/a", STRING).publish(string("a"))
    harness.node.add_publisher("/map", STRING, LATCHED).publish(string("m"))
    await harness.settle()
    assert harness.broker.retained.get("r2d2/a").qos == 0
    assert harness.broker.retained.get("r2d2/map") is None
    assert [m.qos for m, _ in harness.client.received if m.topic == "r2d2/map"] == [2]


async def test_subscription_is_made_anew_when_publishers_change(harness, caplog):
    caplog.set_level(logging.INFO, "appliance.ros")
    harness.start(to_mqtt("/a", type=STRING))
    profiles = [harness.node.subscriptions[0].endpoint.qos]
    assert profiles == [replace(BEST_EFFORT, depth=1000)]  # matches whatever appears
    reliable = harness.node.add_publisher("/a", STRING)
    profiles.append(harness.node.subscriptions[0].endpoint.qos)
    best_effort = harness.node.add_publisher("/a", STRING, BEST_EFFORT)
    profiles.append(harness.node.subscriptions[0].endpoint.qos)
    reliable.remove()
    best_effort.remove()
    profiles.append(harness.node.subscriptions[0].endpoint.qos)  # kept, for their return
    assert [p.reliability.value for p in profiles] == [
        "best effort",
        "reliable",
        "best effort",
        "best effort",
    ]
    assert len(harness.node.subscriptions) == 1
    await harness.settle()
    lines = [r.getMessage() for r in caplog.records if "/a →" in r.getMessage()]
    assert len(lines) == 3
    assert "ROS reliable, volatile, depth 1000; MQTT QoS 1" in lines[1]


async def test_a_publisher_stays_when_a_subscriber_tells_the_hash_of_its_type(harness, caplog):
    caplog.set_level(logging.INFO, "appliance.ros")
    harness.start(to_ros("/a", type=STRING))
    [publisher] = harness.node.own_publishers
    qos = publisher.endpoint.qos
    harness.node.add_subscriber("/a", STRING, qos, type_hash="RIHS01_abc")
    await harness.settle()
    assert harness.node.own_publishers == [publisher]
    assert len([r for r in caplog.records if "→ /a: std_msgs" in r.getMessage()]) == 1


async def test_a_publisher_replaced_between_two_looks_is_found(harness):
    harness.start(to_mqtt("/a"))
    old = harness.node.add_publisher("/a", STRING)
    harness.node.remote_publishers.remove(old)
    harness.node.add_publisher("/a", STRING, BEST_EFFORT)
    for _ in range(20):
        harness.node.spin()
    assert harness.node.subscriptions[0].endpoint.qos.reliability is Reliability.BEST_EFFORT


async def test_type_changes_with_the_publishers(harness):
    harness.start(to_mqtt("/a"))
    old = harness.node.add_publisher("/a", STRING)
    await harness.settle()
    assert harness.routes()[0]["type"] == STRING
    old.remove()
    new = harness.node.add_publisher("/a", INT)
    harness.node.spin()
    new.publish(b"\0\1\0\0" + struct.pack("<i", 7))
    await harness.settle()
    (route,) = harness.routes()
    assert (
        route.items()
        >= {
            "ros": "/a",
            "mqtt": "r2d2/a",
            "type": INT,
            "direction": "to_mqtt",
            "encoding": "json",
        }.items()
    )
    assert harness.client.payloads("r2d2/a") == [b'{"data":7}']


async def test_of_two_types_one_is_carried_and_the_other_told(harness, caplog):
    harness.start(to_mqtt("/a", type=STRING))
    harness.node.add_publisher("/a", INT)
    harness.node.add_publisher("/a", STRING).publish(string("x"))
    await harness.settle()
    assert harness.client.payloads("r2d2/a") == [b'{"data":"x"}']
    assert [r.getMessage() for r in caplog.records] == [
        f"/a → r2d2/a carries {STRING}; the {INT} that is there too is left out"
    ]


async def test_unknown_type_is_told_once_and_harms_nothing_else(harness, caplog):
    harness.start(to_mqtt("/odd"), to_mqtt("/a"))
    harness.node.add_publisher("/odd", "odd_msgs/msg/Odd")
    harness.node.add_publisher("/odd", "odd_msgs/msg/Odd")
    harness.node.add_publisher("/a", STRING).publish(string("x"))
    for _ in range(30):
        harness.node.spin()
    await harness.settle()
    assert harness.client.payloads("r2d2/a") == [b'{"data":"x"}']
    errors = [r.getMessage() for r in caplog.records if r.levelno == logging.ERROR]
    assert len(errors) == 1
    assert "odd_msgs is not installed" in errors[0]
    assert "odd_msgs" in harness.bridge.status()[0].last_error


async def test_text_is_refused_for_other_types(harness, caplog):
    harness.start(to_mqtt("/a", encoding="text"), to_ros("/b", encoding="text", type=TWIST))
    harness.node.add_publisher("/a", TWIST)
    await harness.settle()
    assert [s.topics for s in harness.bridge.status()] == [(), ()]
    assert all("cannot go as text" in s.last_error for s in harness.bridge.status())


async def test_a_message_that_cannot_be_converted_is_counted_and_told_once(harness, caplog):
    harness.start(to_mqtt("/a"))
    peer = harness.node.add_publisher("/a", STRING)
    for _ in range(3):
        peer.publish(b"\0\1\0\0\xff\xff\xff\xff")
    peer.publish(string("good"))
    await harness.settle()
    assert harness.client.payloads("r2d2/a") == [b'{"data":"good"}']
    status = harness.status()
    assert (status.errors, status.messages) == (3, 1)
    assert "cannot be converted" in status.last_error
    assert len(caplog.records) == 1


async def test_rate_is_kept_before_conversion(harness, monkeypatch):
    now = 100.0
    monkeypatch.setattr("appliance.ros.topics.to_mqtt.monotonic", lambda: now)
    harness.start(to_mqtt("/a", rate=10, keep=1000))
    peer = harness.node.add_publisher("/a", STRING)
    for number in range(200):  # 5 s at 40 Hz, unevenly
        now = 100 + number / 40 + (0.004 if number % 3 else 0)
        peer.publish(string(str(number)))
    await harness.settle()
    status = harness.status()
    assert 50 <= status.messages <= 51
    assert status.throttled == 200 - status.messages


@pytest.mark.parametrize(("source", "least"), [(500, 500), (4000, 950)])
async def test_a_high_rate_is_kept_when_messages_come_in_lots(harness, monkeypatch, source, least):
    now = 100.0
    monkeypatch.setattr("appliance.ros.topics.to_mqtt.monotonic", lambda: now)
    harness.start(to_mqtt("/a", rate=1000, keep=10_000))
    peer = harness.node.add_publisher("/a", STRING)
    for lot in range(20):  # in a second
        now = 100 + lot / 20
        for _ in range(source // 20):
            peer.publish(string("x"))
    for _ in range(100):
        await harness.settle()
    status = harness.status()
    assert least <= status.messages <= 1050
    assert status.throttled == source - status.messages


async def test_the_last_message_of_a_burst_is_sent_when_the_rate_allows(harness, monkeypatch):
    now = 100.0
    monkeypatch.setattr("appliance.ros.topics.to_mqtt.monotonic", lambda: now)
    harness.start(to_mqtt("/a", encoding="text", rate=10), to_mqtt("/b", bytes_per_second=20))
    peer, other = (harness.node.add_publisher(name, STRING) for name in ("/a", "/b"))
    for number in range(10):
        peer.publish(string(str(number)))
        other.publish(string(str(number)))
    for elapsed, expected in ((0.05, [b"0"]), (0.15, [b"0", b"9"]), (5.0, [b"0", b"9"])):
        now = 100 + elapsed
        harness.node.spin()
        await harness.settle()
        assert harness.client.payloads("r2d2/a") == expected
    assert json.loads(harness.client.payloads("r2d2/b")[-1]) == {"data": "9"}
    assert [topic.throttled for topic in harness.bridge.topics()] == [8, 7]
    now = 105.01
    peer.publish(string("next"))  # nothing is saved up
    await harness.settle()
    assert harness.client.payloads("r2d2/a")[2:] == [b"next"]


async def test_what_is_held_back_is_not_lost_with_its_publisher_or_route(harness, monkeypatch):
    monkeypatch.setattr("appliance.ros.topics.to_mqtt.monotonic", lambda: 100.0)
    names = ("/gone/**", "/there", "/taken")
    routes = [to_mqtt(name, encoding="text", rate=1, keep=2) for name in names]
    bridge = harness.start(*routes)
    gone, there, taken = (
        harness.node.add_publisher(name, STRING) for name in ("/gone/a", "/there", "/taken")
    )
    harness.node.spin()
    for publisher in (gone, there, taken):
        publisher.publish(string("first"))
        publisher.publish(string("last"))
    harness.node.add_publisher(
        "/there", STRING, BEST_EFFORT
    )  # subscribed to anew: no reason to send
    gone.remove()
    bridge.replace(routes[:2])
    harness.node.spin()
    await harness.settle()
    assert harness.client.payloads("r2d2/gone/a") == [b"first", b"last"]
    assert harness.client.payloads("r2d2/taken") == [b"first", b"last"]
    assert harness.client.payloads("r2d2/there") == [b"first"]
    monkeypatch.setattr("appliance.ros.topics.to_mqtt.monotonic", lambda: 102.0)
    harness.node.spin()
    await harness.settle()
    assert harness.client.payloads("r2d2/there") == [b"first", b"last"]
    assert [status.throttled for status in bridge.status()] == [0, 0]


async def test_keep_latest_and_keep_n(harness):
    harness.start(to_mqtt("/a"), to_mqtt("/b", keep=3))
    a, b = harness.node.add_publisher("/a", STRING), harness.node.add_publisher("/b", STRING)
    for number in range(5):
        a.publish(string(str(number)))
        b.publish(string(str(number)))
    await harness.settle()
    assert harness.client.payloads("r2d2/a") == [b'{"data":"4"}']
    assert harness.client.payloads("r2d2/b") == [b'{"data":"%d"}' % n for n in (2, 3, 4)]
    assert [s.dropped for s in harness.bridge.status()] == [4, 2]


async def test_a_long_queue_does_not_hold_the_loop(harness):
    harness.start(to_mqtt("/a", keep=1000))
    peer = harness.node.add_publisher("/a", STRING)
    for number in range(500):
        peer.publish(string(str(number)))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert 0 < harness.status().messages < 500
    for _ in range(20):
        await asyncio.sleep(0)
    assert harness.client.payloads("r2d2/a")[-1] == b'{"data":"499"}'


async def test_patterns(harness):
    harness.start(to_mqtt("/camera/**", encoding="cdr"), to_mqtt("/camera/named", encoding="text"))
    image = harness.node.add_publisher("/camera/left/image", STRING)
    harness.node.add_publisher("/camera/named", STRING).publish(string("once"))
    harness.node.add_publisher("/camera/_hidden", STRING)
    harness.node.add_publisher("/lidar", STRING)
    harness.node.add_subscriber("/camera/wanted", STRING)
    image.publish(string("px"))
    await harness.settle()
    assert harness.client.payloads("r2d2/camera/left/image") == [string("px")]
    assert harness.client.payloads("r2d2/camera/named") == [b"once"]
    assert {row["ros"] for row in harness.routes()} == {"/camera/left/image", "/camera/named"}
    image.remove()
    harness.node.spin()
    harness.node.spin()
    await harness.settle()
    assert {row["ros"] for row in harness.routes()} == {"/camera/named"}
    harness.node.add_publisher("/camera/left/image", STRING).publish(string("again"))
    await harness.settle()
    assert harness.client.payloads("r2d2/camera/left/image")[-1] == string("again")
    harness.bridge.status()


def matches(route, *names, types=(STRING,)):
    return [name for name in names if BridgeRoute(route, "to_mqtt").matches(name, types)]


def test_what_patterns_match():
    assert matches(to_mqtt("/*/scan"), "/left/scan", "/left/front/scan") == ["/left/scan"]
    assert matches(to_mqtt("/**"), "/a/_x", "/_x/a", "/a/x", "/x") == ["/a/x", "/x"]
    assert matches(to_mqtt("/**/_x"), "/a/_x", "/a/_y") == ["/a/_x"]
    some = to_mqtt(("/camera/**", "/odom", "!/camera/*/raw", "!/camera/raw"))
    names = "/camera/raw", "/camera/left/raw", "/camera/left/image", "/odom", "/odometry"
    assert matches(some, *names) == ["/camera/left/image", "/odom"]


def test_what_is_left_out_is_so_in_hidden_names_too():
    route = BridgeRoute(to_mqtt(("/**", "/_debug/**", "!/**/raw")), "to_mqtt")
    assert route.matches("/_debug/state", [STRING])
    assert not route.matches("/_debug/raw", [STRING])
    shown = ParameterSettings(("/_debug/*", "!/**/secret"), "r2d2{node}").of("/_debug")
    assert shown is not None
    assert [name in shown for name in ("speed", "secret")] == [True, False]


def test_patterns_of_types():
    images = to_mqtt("/**", type="sensor_msgs/msg/*Image")
    assert matches(images, "/a", types=["std_msgs/msg/String", "sensor_msgs/msg/Image"])
    assert matches(images, "/a", types=["sensor_msgs/msg/CompressedImage"])
    assert not matches(images, "/a", types=["other_msgs/msg/Image"])
    assert not matches(to_mqtt("/**", type=STRING), "/a", types=[INT])
    assert to_mqtt("/a", type="std_msgs/msg/*").is_pattern


async def test_a_type_picks_topics_and_what_they_carry(harness):
    harness.start(to_mqtt("/**", type="std_msgs/msg/*"))
    harness.node.add_publisher("/moves", TWIST)
    both_types = harness.node.add_publisher("/both", STRING)
    harness.node.add_publisher("/both", TWIST)
    harness.node.spin()
    both_types.publish(string("x"))
    await harness.settle()
    assert [(row["ros"], row["type"]) for row in harness.routes()] == [("/both", STRING)]
    assert harness.client.payloads("r2d2/both") == [b'{"data":"x"}']
    both_types.remove()
    await harness.settle()
    assert harness.routes() == []
    harness.node.add_publisher("/both", INT)
    await harness.settle()
    assert [(row["ros"], row["type"]) for row in harness.routes()] == [("/both", INT)]


async def test_a_topic_whose_type_changes_goes_to_the_route_of_that_type(harness):
    harness.start(
        to_mqtt("/**", type=STRING), to_mqtt("/**", type=INT, mqtt="ints{ros}", encoding="text")
    )
    first = harness.node.add_publisher("/a", STRING)
    await harness.settle()
    assert [row["mqtt"] for row in harness.routes()] == ["r2d2/a"]
    first.remove()
    harness.node.add_publisher("/a", INT)
    harness.node.spin()
    await harness.settle()
    assert [row["mqtt"] for row in harness.routes()] == ["ints/a"]


async def test_a_pattern_to_ros_is_for_topics_that_are_subscribed_to(harness):
    harness.start(to_ros(("/**", "!/locked/*")))
    harness.node.add_publisher("/only_published", STRING)
    say = harness.node.add_subscriber("/say", STRING)
    locked = harness.node.add_subscriber("/locked/door", STRING)
    hidden = harness.node.add_subscriber("/_hidden", STRING)
    await harness.settle()
    assert set(harness.broker.sessions["_bridge"].subscriptions) == {"r2d2/say"}
    for topic in ("say", "locked/door", "_hidden", "only_published"):
        harness.client.send(f"r2d2/{topic}", b'{"data":"x"}')
    assert say.received == [string("x")]
    assert locked.received == hidden.received == []
    assert [publisher.topic for publisher in harness.node.own_publishers] == ["/say"]
    say.remove()
    await harness.settle()
    assert harness.broker.sessions["_bridge"].subscriptions == {}
    assert harness.node.own_publishers == harness.routes() == []
    harness.client.send("r2d2/say", b'{"data":"x"}')
    assert harness.status("to_ros").messages == 1
    say = harness.node.add_subscriber("/say", INT)
    await harness.settle()
    harness.client.send("r2d2/say", b'{"data":7}')
    assert len(say.received) == 1
    assert (harness.status("to_ros").messages, harness.status("to_ros").errors) == (2, 0)


async def test_a_pattern_both_ways_has_no_echo(harness):
    harness.start(both("/chat/**"))
    other = harness.node.add_publisher("/chat/a", STRING)
    listener = harness.node.add_subscriber("/chat/a", STRING)
    await harness.settle()
    harness.client.send("r2d2/chat/a", b'{"data":"from mqtt"}')
    other.publish(string("from ros"))
    await harness.settle()
    assert listener.received == [string("from mqtt"), string("from ros")]
    assert harness.client.payloads("r2d2/chat/a") == [
        b'{"data":"from mqtt"}',
        b'{"data":"from ros"}',
    ]
    other.remove()
    listener.remove()
    harness.node.spin()
    await harness.settle()
    assert harness.node.topics() == {}
    assert harness.routes() == []


async def test_a_name_goes_before_a_pattern_to_ros_too(harness):
    bridge = harness.start(to_ros("/a/**"), to_ros("/a/named", mqtt="named", type=STRING))
    listener = harness.node.add_subscriber("/a/named", STRING)
    await harness.settle()
    harness.client.send("r2d2/a/named", b'{"data":"1"}')
    harness.client.send("named", b'{"data":"2"}')
    bridge.replace([to_ros("/a/**")])
    harness.node.spin()
    await harness.settle()
    harness.client.send("r2d2/a/named", b'{"data":"3"}')
    harness.client.send("named", b'{"data":"4"}')
    assert listener.received == [string("2"), string("3")]
    bridge.replace([])
    harness.client.send("r2d2/a/named", b'{"data":"5"}')
    assert listener.received == [string("2"), string("3")]


async def test_what_topics_that_have_gone_counted_stays_counted(harness):
    harness.start(to_mqtt("/**"))
    for _ in range(3):
        publisher = harness.node.add_publisher("/a", STRING)
        publisher.publish(string("x"))
        publisher.remove()
        harness.node.spin()
        await harness.settle()
    assert (harness.status().messages, harness.status().bytes) == (3, 36)
    assert harness.status().topics == ()


async def test_figures_of_what_is_bridged(harness, monkeypatch):
    monkeypatch.setattr("appliance.ros.bridge.METER_INTERVAL", 0.01)
    monkeypatch.setattr("appliance.ros.bridge.METERS_TO_ANNOUNCE", 2)
    harness.start(to_mqtt("/a", keep=9))
    publisher = harness.node.add_publisher("/a", STRING)
    (subscription,) = harness.node.subscriptions
    began = time.monotonic()
    for _ in range(20):
        publisher.publish(string("x"))
        subscription.callback(string("x"), time.time_ns() - 30_000_000)
        await asyncio.sleep(0.005)
    (topic,) = harness.bridge.topics()
    assert (topic.messages, topic.size) == (40, 12)
    assert min(50, 20 / (time.monotonic() - began)) < topic.rate < 500
    assert 20 < topic.latency_ms.p50 < 50
    (row,) = harness.routes()
    assert row["messages"] > 0
    assert row["rate"] > 0
    assert row["latency_ms"]["p99"] > 20


# MQTT to ROS


async def test_a_command_reaches_ros(harness):
    harness.start(to_ros("/cmd_vel", type=TWIST))
    robot = harness.node.add_subscriber("/cmd_vel", TWIST)
    harness.client.send("r2d2/cmd_vel", b'{"linear":{"x":0.5}}', qos=1)
    assert robot.received == [b"\0\1\0\0" + struct.pack("<6d", 0.5, 0, 0, 0, 0, 0)]
    assert harness.status("to_ros").messages == 1
    await harness.settle()
    assert harness.routes()[0]["direction"] == "to_ros"


async def test_without_a_type_messages_are_refused_until_a_subscriber_tells(harness, caplog):
    harness.start(to_ros("/cmd_vel"))
    harness.client.send("r2d2/cmd_vel", b"{}")
    harness.client.send("r2d2/cmd_vel", b"{}")
    status = harness.status("to_ros")
    assert status.errors == 2
    assert "no node subscribes to /cmd_vel" in status.last_error
    robot = harness.node.add_subscriber("/cmd_vel", TWIST)
    harness.client.send("r2d2/cmd_vel", b"{}")
    assert len(robot.received) == 1
    await harness.settle()
    assert len([r for r in caplog.records if r.levelno == logging.WARNING]) == 1


@pytest.mark.parametrize(
    ("encoding", "payload"),
    [
        ("json", b'{"data": 5}'),
        ("json", b"nonsense"),
        ("json", b""),
        ("json", b'{"date": "x"}'),
        ("text", b"\xff"),
        ("cdr", b""),
        ("cdr", b"\0\1\0\0\xff\xff\xff\xff"),
    ],
)
async def test_wrong_payloads_never_reach_ros(harness, encoding, payload):
    harness.start(to_ros("/say", encoding=encoding))
    listener = harness.node.add_subscriber("/say", STRING)
    harness.client.send("r2d2/say", payload)
    assert listener.received == []
    assert harness.status("to_ros").errors == 1


async def test_retained_commands_do_not_reach_ros(harness):
    harness.client.send("r2d2/say", b'{"data":"old"}', retain=True)
    listener = harness.node.add_subscriber("/say", STRING)
    harness.start(to_ros("/say"))
    await harness.settle()
    assert listener.received == []
    harness.bridge._receive(Message("r2d2/say", b'{"data":"old"}'), True, None)
    assert listener.received == []


async def test_a_refusing_transport_is_counted(harness):
    harness.start(to_ros("/say", type=STRING))
    harness.node.own_publishers[0].error = "the transport is full"
    harness.client.send("r2d2/say", b'{"data":"x"}')
    assert "the transport is full" in harness.status("to_ros").last_error
    harness.node.own_publishers[0].error = None
    harness.client.send("r2d2/say", b'{"data":"x"}')
    assert (harness.status("to_ros").errors, harness.status("to_ros").messages) == (1, 1)


async def test_publisher_becomes_transient_local_where_a_subscriber_asks(harness):
    harness.start(to_ros("/map", type=STRING))
    assert harness.node.own_publishers[0].endpoint.qos.durability is Durability.VOLATILE
    listener = harness.node.add_subscriber("/map", STRING, LATCHED)
    (publisher,) = harness.node.own_publishers
    assert publisher.endpoint.qos.durability is Durability.TRANSIENT_LOCAL
    harness.client.send("r2d2/map", b'{"data":"x"}')
    assert len(listener.received) == 1


# Both ways


async def test_both_ways_without_an_echo(harness):
    harness.start(both("/chat"))
    other = harness.node.add_publisher("/chat", STRING)
    listener = harness.node.add_subscriber("/chat", STRING)
    harness.client.send("r2d2/chat", b'{"data":"from mqtt"}')
    other.publish(string("from ros"))
    await harness.settle()
    assert listener.received == [string("from mqtt"), string("from ros")]
    # What the client itself published comes back to it from the broker, once, as its own.
    assert harness.client.payloads("r2d2/chat") == [
        b'{"data":"from mqtt"}',
        b'{"data":"from ros"}',
    ]


async def test_two_routes_of_one_topic_have_no_echo_either(harness):
    harness.start(to_mqtt("/chat"), to_ros("/chat", type=STRING))
    harness.node.add_publisher("/chat", STRING)
    harness.client.send("r2d2/chat", b'{"data":"x"}')
    await harness.settle()
    assert len(harness.client.payloads("r2d2/chat")) == 1


async def test_a_set_point_on_another_mqtt_topic_is_seen_on_ros_topic(harness):
    harness.start(to_mqtt("/goal"), to_ros("/goal", mqtt="r2d2/goal/set", type=STRING))
    harness.node.add_publisher("/goal", STRING)
    harness.client.send("r2d2/goal/set", b'{"data":"x"}')
    await harness.settle()
    assert harness.client.payloads("r2d2/goal") == [b'{"data":"x"}']


async def test_both_ways_takes_the_type_from_a_publisher_too(harness):
    harness.start(both("/chat"))
    harness.node.add_publisher("/chat", STRING)
    assert [p.endpoint.type for p in harness.node.own_publishers] == [STRING]


def test_echo_knows_padding_and_forgets(monkeypatch):
    now = 0.0
    monkeypatch.setattr("appliance.ros.topics.echo.monotonic", lambda: now)
    echo = EchoFilter()
    sample = string("abcd")
    assert not echo.is_own(sample)
    echo.sent(sample)
    assert not echo.is_own(string("other"))
    assert not echo.is_own(sample + b"\0\0\0\0")
    assert echo.is_own(b"\0\1\0\3" + sample[4:] + b"\0\0\0")
    assert not echo.is_own(sample)
    echo.sent(sample)
    now = 10.0
    assert not echo.is_own(sample)


# Life


async def test_start_returns_before_ros_is_there_and_stop_may_come_twice(harness):
    harness.node.start = lambda poll, failed, loop: None
    harness.start(to_ros("/cmd_vel", type=TWIST))
    assert harness.routes() == []
    harness.client.send("r2d2/cmd_vel", b"{}")
    assert "ROS is not ready" in harness.status("to_ros").last_error
    await harness.bridge.stop()
    await harness.bridge.stop()


async def test_ros_missing_is_one_clear_line_and_tried_again(harness, caplog, monkeypatch):
    monkeypatch.setattr("appliance.ros.bridge.RETRY", 0.01)
    start, attempts = harness.node.start, []

    def fail(poll, failed, loop):
        attempts.append(asyncio.get_running_loop().time())
        if len(attempts) < 5:
            failed("there is no ROS 2 here")
        else:
            start(poll, failed, loop)

    harness.node.start = fail
    bridge = harness.start(to_mqtt("/a"), to_ros("/b"))
    await harness.settle()
    assert bridge.problem == "there is no ROS 2 here" and bridge.state == "waiting"
    await until(lambda: bridge.state == "joined")
    assert [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING] == [
        "there is no bridge to ROS: there is no ROS 2 here (it is tried again, at least every 60 s)"
    ]
    pauses = [later - earlier for earlier, later in itertools.pairwise(attempts)]
    assert all(pause > 0.009 * 2**number for number, pause in enumerate(pauses))
    assert bridge.problem is None


async def test_a_stop_ends_the_attempts(harness, monkeypatch):
    monkeypatch.setattr("appliance.ros.bridge.RETRY", 0.001)
    harness.node.start = lambda poll, failed, loop: failed("there is no ROS 2 here")
    await harness.start(to_mqtt("/a")).stop()
    harness.node.start = None
    await asyncio.sleep(0.01)


async def test_a_bus_that_comes_back_is_joined_again(harness, monkeypatch):
    monkeypatch.setattr("appliance.ros.bridge.RETRY", 0.001)
    node = harness.node
    bridge = harness.start(to_mqtt("/a"), to_mqtt("/many/*"), to_ros("/b", type=TWIST))
    peer, match = node.add_publisher("/a", STRING), node.add_publisher("/many/x", STRING)
    await harness.settle()
    assert len(harness.routes()) == 3
    start, tries = node.start, []
    node.start = lambda *args: tries.append(args)
    for _ in range(2):
        node.fail("the daemon died")
        await until(lambda: tries)
        assert bridge.state == "lost" and bridge.peers is None and harness.routes() == []
        start(*tries.pop())
        await until(lambda: bridge.state == "joined")
        node.spin()
        await harness.settle()
        assert len(harness.routes()) == 3
        harness.client.received.clear()
        for sender in (peer, match):
            sender.publish(string("again"))
        harness.client.send("r2d2/b", b"{}")
        await harness.settle()
        for topic in ("r2d2/a", "r2d2/many/x"):
            assert harness.client.payloads(topic) == [b'{"data":"again"}']
        assert harness.status("to_ros").errors == 0
    assert bridge.peers == 1


async def test_another_node_of_the_same_name_is_told_once(harness, caplog, monkeypatch):
    """Two bridges on one domain carried everything twice, and nothing said so."""
    monkeypatch.setattr("appliance.ros.graph_follower.NODE_COUNT_POLL", 1)
    monkeypatch.setattr("appliance.ros.bridge.TWIN_COUNTS", 3)
    harness.start(to_mqtt("/a"))
    name = harness.node.name

    async def look(names, times):
        monkeypatch.setattr(harness.node, "nodes", lambda: names)
        for _ in range(times):
            harness.node.spin()
            await harness.settle()

    await look([name, "/other"], 5)
    await look([name, name], 2)  # one that was killed and is started again
    await look([name], 1)
    assert "another node of this name" not in caplog.text
    await look([name, name], 6)
    assert caplog.text.count("another node of this name") == 1
    assert "bridge.domain_id" in caplog.text


async def test_when_the_node_ends_nothing_is_bridged(harness):
    bridge = harness.start(both("/chat", type=STRING))
    harness.node.fail("the daemon died")
    await harness.settle()
    assert harness.routes() == []
    assert all(status.topics == () for status in bridge.status())
    harness.client.send("r2d2/chat", b'{"data":"x"}')
    assert harness.status("to_ros").errors == 1


async def test_what_waits_at_the_stop_still_arrives(harness):
    harness.start(to_mqtt("/a"))
    harness.node.add_publisher("/a", STRING).publish(string("last"))
    await harness.bridge.stop()
    assert harness.client.payloads("r2d2/a") == [b'{"data":"last"}']
    assert harness.routes() == []
    assert "_bridge" not in harness.broker.sessions


async def test_the_same_route_twice_is_told_and_left_out(harness, caplog):
    harness.start(both("/a", type=STRING), both("/a", type=STRING))
    assert len(harness.node.subscriptions) == len(harness.node.own_publishers) == 1
    await harness.settle()
    assert len([r for r in caplog.records if "already" in r.getMessage()]) == 2


async def test_an_end_that_the_bus_refuses_for_now_is_tried_again(harness, caplog):
    subscribe = harness.node.subscribe_raw

    def refuse(*_, **__):
        raise BusError("known with another type")

    harness.node.subscribe_raw = refuse
    harness.start(to_mqtt("/a"))
    publisher = harness.node.add_publisher("/a", STRING)
    for _ in range(5):
        harness.node.spin()
    assert harness.status().last_error == "known with another type"
    harness.node.subscribe_raw = subscribe
    harness.node.spin()
    publisher.publish(string("x"))
    await harness.settle()
    assert harness.client.payloads("r2d2/a") == [b'{"data":"x"}']
    assert len([r for r in caplog.records if "another type" in r.getMessage()]) == 1


async def test_a_publisher_of_another_type_waits_until_the_old_one_has_gone(harness):
    harness.start(to_ros("/**"))
    old = harness.node.add_subscriber("/a", STRING)
    create, types = harness.node.create_publisher, []

    def note(topic, type_name, qos):
        types.append([own.endpoint.type for own in harness.node.own_publishers])
        return create(topic, type_name, qos)

    harness.node.create_publisher = note
    harness.node.remote_subscribers.remove(old)
    new = harness.node.add_subscriber("/a", INT)
    harness.node.spin()
    await harness.settle()
    harness.client.send("r2d2/a", b'{"data":7}')
    assert types == [[]]
    assert len(new.received) == 1


# Routes that change while they run


async def test_routes_are_replaced_and_those_that_stay_do_not_notice(harness):
    bridge = harness.start(to_mqtt("/stay"), to_mqtt("/go"), to_ros("/left", type=STRING))
    stay = harness.node.add_publisher("/stay", STRING)
    go = harness.node.add_publisher("/go", STRING)
    new = harness.node.add_publisher("/new", STRING)
    subscription = next(s for s in harness.node.subscriptions if s.topic == "/stay")
    stay.publish(string("1"))
    bridge.replace([to_mqtt("/stay"), to_mqtt("/new"), to_ros("/came", type=STRING)])
    harness.node.spin()
    await harness.settle()
    assert subscription in harness.node.subscriptions
    for publisher in (stay, go, new):
        publisher.publish(string("2"))
    await harness.settle()
    assert harness.client.payloads("r2d2/stay") == [b'{"data":"1"}', b'{"data":"2"}']
    assert harness.client.payloads("r2d2/go") == []
    assert harness.client.payloads("r2d2/new") == [b'{"data":"2"}']
    assert [p.topic for p in harness.node.own_publishers] == ["/came"]
    assert {route["ros"] for route in harness.routes()} == {"/stay", "/new", "/came"}
    harness.client.send("r2d2/left", b'{"data":"x"}')
    harness.client.send("r2d2/came", b'{"data":"y"}')
    counts = {s.settings.ros: s.messages for s in bridge.status()}
    assert counts == {"/stay": 2, "/new": 1, "/came": 1}
    assert set(harness.broker.sessions["_bridge"].subscriptions) == {"r2d2/came"}


async def test_a_route_with_other_settings_takes_the_place_of_the_one_before(harness):
    bridge = harness.start(to_mqtt("/a"))
    publisher = harness.node.add_publisher("/a", STRING)
    harness.node.spin()
    bridge.replace([to_mqtt("/a", mqtt="elsewhere/a", encoding="text")])
    harness.node.spin()
    harness.client.subscribe("elsewhere/#")
    publisher.publish(string("x"))
    await harness.settle()
    assert len(harness.node.subscriptions) == 1
    assert harness.client.payloads("r2d2/a") == []
    assert harness.client.payloads("elsewhere/a") == [b"x"]


async def test_a_pattern_gives_way_to_a_name_and_takes_over_again(harness):
    bridge = harness.start(to_mqtt("/cam/**"))
    publisher = harness.node.add_publisher("/cam/raw", STRING)
    harness.node.spin()
    bridge.replace([to_mqtt("/cam/**"), to_mqtt("/cam/raw", mqtt="named")])
    harness.node.spin()
    harness.client.subscribe("named")
    publisher.publish(string("1"))
    await harness.settle()
    bridge.replace([to_mqtt("/cam/**")])
    harness.node.spin()
    publisher.publish(string("2"))
    await harness.settle()
    assert harness.client.payloads("named") == [b'{"data":"1"}']
    assert harness.client.payloads("r2d2/cam/raw") == [b'{"data":"2"}']
    bridge.replace([])
    harness.node.spin()
    await harness.settle()
    assert harness.node.subscriptions == []
    assert harness.routes() == []


async def test_an_echo_is_known_also_when_one_way_came_later(harness):
    bridge = harness.start(to_mqtt("/a"))
    harness.node.add_publisher("/a", STRING)
    bridge.replace([both("/a", type=STRING)])
    harness.node.spin()
    harness.client.send("r2d2/a", b'{"data":"x"}')
    await harness.settle()
    assert harness.client.payloads("r2d2/a") == [b'{"data":"x"}']


async def test_a_flow_that_has_ended_is_freed_without_the_garbage_collector(harness, caplog):
    """The appliance never collects old objects: a cycle of references would stay for ever."""
    caplog.set_level(logging.ERROR)  # pytest's records have the flow that they are about
    bridge = harness.start(
        to_mqtt(("/sensor/**",)),
        to_ros(("/say/**",)),
        both("/both", type=STRING),
        to_ros("/cmd_vel", type=TWIST, rules=CommandRules(on_silence=OnSilence(0.1))),
    )
    sensor = harness.node.add_publisher("/sensor/a", STRING)
    harness.node.add_subscriber("/say/a", STRING)
    harness.node.add_subscriber("/cmd_vel", TWIST)
    harness.node.add_publisher("/both", STRING).publish(string("1"))
    sensor.publish(string("2"))
    harness.client.send("r2d2/cmd_vel", b'{"linear": {"x": 1.0}}')
    harness.client.send("r2d2/both", b'{"data": "3"}')
    await harness.settle()
    flows = [weakref.ref(flow) for flow in bridge.flows()]
    assert sorted(type(flow()).__name__ for flow in flows) == [
        *("Commands", "ToMqtt", "ToMqtt", "ToRos", "ToRos")
    ]
    gc.disable()
    try:
        harness.node.remote_publishers.clear()
        harness.node.remote_subscribers.clear()
        bridge.replace([])
        harness.node.spin()
        await harness.settle()
        alive = [str(flow()) for flow in flows if flow() is not None]
        assert not alive
    finally:
        gc.enable()


def test_a_closed_loop_is_no_error():
    loop = asyncio.new_event_loop()
    node = FakeNode(types={STRING: import_message(STRING)})
    bridge = Bridge(node, Broker(Rules(), MemoryStore()), [to_mqtt("/a")], loop, "r2d2")
    bridge.start()
    loop.close()
    node.add_publisher("/a", STRING).publish(string("late"))


async def test_what_is_taken_on_the_loops_thread_is_on_mqtt_at_once_and_behind_what_waits(harness):
    publisher = harness.node.add_publisher("/a", STRING)
    harness.start(to_mqtt("/a", keep=10, encoding="text"))
    publisher.publish(string("in the mailbox"))
    harness.node.takes_on_loop = True
    publisher.publish(string("behind it"))
    assert harness.client.payloads("r2d2/a") == []
    await harness.settle()
    publisher.publish(string("at once"))
    assert harness.client.payloads("r2d2/a") == [b"in the mailbox", b"behind it", b"at once"]
    assert harness.status().messages == 3


async def test_what_the_two_threads_count_is_added_up_and_logged_once(harness, caplog):
    harness.node.add_publisher("/a", STRING)
    harness.start(to_mqtt("/a"))
    (subscription,) = harness.node.subscriptions
    subscription.callback(b"no CDR")
    subscription.on_loop([(b"\0\1\0\0\1", 0), (string("x"), 0)], 2, False)
    subscription.lost = 3
    for _ in range(THOROUGH_POLL):
        harness.node.spin()
    await harness.settle()
    status = harness.status()
    counted = status.messages, status.errors, status.dropped, status.lost
    assert counted == (1, 2, 2, 3)
    assert caplog.text.count("a message cannot be converted") == 1
    (flow,) = harness.bridge.flows()
    assert (flow.counters.errors, flow.follower.counters.errors) == (1, 1)
    assert status.last_error == flow.counters.last_error
    subscription.callback(b"")
    assert harness.status().last_error == flow.follower.counters.last_error


async def test_what_there_was_no_room_for_on_ros_is_counted(harness):
    harness.node.add_publisher("/a", STRING)
    harness.start(to_mqtt("/a", encoding="text"))
    (subscription,) = harness.node.subscriptions
    subscription.on_loop([(string("x"), 0)], 3, False)
    assert harness.status().dropped == 3
    assert harness.client.payloads("r2d2/a") == [b"x"]


async def test_what_the_middleware_lost_is_counted_with_the_route(harness):
    harness.start(TopicSettings("/chatter", "mqtt", "r2d2/chatter"))
    harness.node.add_publisher("/chatter", STRING)
    await until(lambda: harness.node.subscriptions)
    harness.node.subscriptions[0].lost = 88
    for _ in range(THOROUGH_POLL):
        harness.node.spin()
    assert harness.bridge.status()[0].lost == 88
    assert harness.bridge.topics()[0].lost == 88
    subscription = harness.node.subscriptions[0]
    subscription.lost = 2
    harness.node.remote_publishers[0].remove()
    harness.node.add_publisher("/chatter", STRING, BEST_EFFORT)  # it is subscribed to anew
    await until(lambda: harness.node.subscriptions[0] is not subscription)
    assert harness.bridge.status()[0].lost == 90
