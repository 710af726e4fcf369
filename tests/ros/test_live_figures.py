"""Figures once a second, for who has asked for them and for nobody else."""

from __future__ import annotations

import json

import pytest
from waiting import until

from appliance.broker.values import Decision
from appliance.ros import live
from appliance.ros.bridge import Bridge

pytest.importorskip("std_msgs.msg")
from bridge_harness import STRING, Client, Harness, string, to_mqtt, to_ros

TOPIC = "r2d2/_appliance/live"


def look(harness: Harness) -> None:
    bridge: Bridge = harness.bridge
    bridge._meter()


async def bridged(harness: Harness, count: int) -> None:
    await until(lambda: len(harness.bridge.topics()) == count, "what is bridged")
    harness.bridge._meter_timer.cancel()  # it is looked at by hand


def told(client: Client) -> list[dict]:
    return [json.loads(payload) for payload in client.payloads(TOPIC)]


async def test_figures_of_what_is_bridged(harness: Harness) -> None:
    harness.start(to_mqtt("/chatter"), to_ros("/say", type=STRING))
    publisher = harness.node.add_publisher("/chatter", STRING)
    await bridged(harness, 2)
    watcher = Client(harness.broker, "watcher")
    watcher.subscribe(TOPIC)
    for _ in range(3):
        publisher.publish(string("hello"))
    watcher.send("r2d2/say", b'{"data": 5}')
    await harness.settle()
    look(harness)
    await until(lambda: told(watcher), "the figures")
    figures = told(watcher)[-1]
    assert figures["omitted"] == 0 and figures["time"] > 1e9
    by_topic = {(each["mqtt"], each["direction"]): each for each in figures["routes"]}
    chatter = by_topic["r2d2/chatter", "to_mqtt"]
    assert chatter["rate"] >= 0 and chatter["errors"] == chatter["lost"] == chatter["dropped"] == 0
    assert by_topic["r2d2/say", "to_ros"]["errors"] == 1
    listed = {(each["mqtt"], each["direction"]): each for each in json.loads(_routes(harness))}
    for key, each in by_topic.items():
        assert each.keys() - {"byte_rate"} <= listed[key].keys()
    assert harness.broker.retained.get(TOPIC) is None


def _routes(harness: Harness) -> bytes:
    harness.bridge._announce()
    return harness.broker.retained.get("r2d2/_appliance/routes").payload


async def test_nobody_looks(harness: Harness) -> None:
    """Neither a subscription to everything, nor one that has ended, nor one of who may not read."""
    harness.start(to_mqtt("/chatter"))
    harness.node.add_publisher("/chatter", STRING)
    await bridged(harness, 1)
    away = Client(harness.broker, "away")
    away.subscribe(TOPIC)
    away.session.link = None
    look(harness)
    await harness.settle()
    assert told(harness.client) == []
    watcher = Client(harness.broker, "watcher")
    watcher.subscribe("+/_appliance/live")
    look(harness)
    await until(lambda: told(harness.client), "what others have asked for")
    seen = len(told(watcher))
    harness.broker.unsubscribe(watcher.session, "+/_appliance/live")
    watcher.subscribe("$share/group/r2d2/_appliance/live")
    look(harness)
    await until(lambda: len(told(watcher)) > seen, "a member of a group looks")
    harness.broker.unsubscribe(watcher.session, "$share/group/r2d2/_appliance/live")
    before = len(told(harness.client))
    look(harness)
    await harness.settle()
    assert len(told(harness.client)) == before


@pytest.mark.patches
async def test_who_may_not_read_does_not_start_them(harness: Harness, monkeypatch) -> None:
    harness.start(to_mqtt("/chatter"))
    harness.node.add_publisher("/chatter", STRING)
    await bridged(harness, 1)
    watcher = Client(harness.broker, "watcher")
    watcher.subscribe(TOPIC)
    router = harness.broker.router
    monkeypatch.setattr(type(router), "decide", lambda *_: Decision(False, "no rule"), raising=True)
    monkeypatch.setattr(watcher.session, "identity", object())
    assert not router.is_watched(TOPIC)


async def test_many_topics_are_collected_in_turns(harness: Harness, monkeypatch) -> None:
    monkeypatch.setattr(live, "TURN", 4)
    monkeypatch.setattr(live, "MOST_TOPICS", 12)
    harness.start(*(to_mqtt(f"/topic_{number}") for number in range(14)))
    for number in range(14):
        harness.node.add_publisher(f"/topic_{number}", STRING)
    await bridged(harness, 14)
    watcher = Client(harness.broker, "watcher")
    watcher.subscribe(TOPIC)
    look(harness)
    look(harness)  # while the first ones are collected
    await until(lambda: told(watcher), "the figures")
    await harness.settle()
    (figures,) = told(watcher)
    assert len(figures["routes"]) == 12 and figures["omitted"] == 2


async def test_a_fault_does_not_end_them(harness: Harness, monkeypatch, escaped) -> None:
    harness.start(to_mqtt("/chatter"))
    harness.node.add_publisher("/chatter", STRING)
    await bridged(harness, 1)
    watcher = Client(harness.broker, "watcher")
    watcher.subscribe(TOPIC)
    with monkeypatch.context() as broken:
        broken.setattr(live, "_figures", lambda *_: 1 / 0)
        look(harness)
        by_entry = harness.broker.faults.by_entry
        await until(lambda: by_entry.get("bridge.live") == 1, "a fault")
    look(harness)
    await until(lambda: told(watcher), "the figures")
    escaped.clear()
