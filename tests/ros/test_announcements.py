"""What is bridged is announced in turns of the event loop, whatever happens meanwhile."""

from __future__ import annotations

import asyncio
import json

import pytest
from waiting import until

from appliance.ros import announcements

pytest.importorskip("std_msgs.msg")
from bridge_harness import STRING, Harness, to_ros

ROUTES = "r2d2/_appliance/routes"


@pytest.fixture
def short_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(announcements, "TURN", 4)


async def many(harness: Harness, count: int) -> None:
    """Bridge so many topics, which are announced already; nothing more is announced by itself."""
    harness.start(*(to_ros(f"/topic_{number}", type=STRING) for number in range(count)))
    harness.bridge._meter_timer.cancel()
    await until(lambda: len(names(harness)) == count, "what is bridged")
    harness.client.received.clear()


def names(harness: Harness) -> list[str]:
    return [route["ros"] for route in harness.routes()]


def errors(harness: Harness) -> list[list[int]]:
    """Of each announcement, the errors of all topics."""
    told = harness.client.payloads(ROUTES)
    return [[route["errors"] for route in json.loads(payload)] for payload in told]


def fail(harness: Harness, number: int) -> None:
    harness.client.send(f"r2d2/topic_{number}", b"no JSON")


@pytest.mark.usefixtures("short_turns")
async def test_others_have_a_turn_between_the_topics(harness: Harness) -> None:
    await many(harness, 14)
    fail(harness, 3)
    harness.bridge._announce()
    for _ in range(3):
        assert errors(harness) == []
        await asyncio.sleep(0)
    assert errors(harness) == [[0] * 3 + [1] + [0] * 10]


@pytest.mark.usefixtures("short_turns")
async def test_a_change_meanwhile_is_announced_next(harness: Harness) -> None:
    await many(harness, 14)
    fail(harness, 13)
    harness.bridge._announce()
    fail(harness, 0)  # whose entry is made
    for _ in range(5):
        harness.bridge._announce()
    await until(lambda: len(errors(harness)) == 2, "two announcements")
    await harness.settle()
    assert [sum(each) for each in errors(harness)] == [1, 2]


@pytest.mark.usefixtures("short_turns")
async def test_the_end_has_the_last_word(harness: Harness) -> None:
    await many(harness, 14)
    fail(harness, 0)
    harness.bridge._announce()
    await harness.bridge.stop()
    await harness.settle()
    assert harness.client.payloads(ROUTES)[-1] == b"[]"
    assert names(harness) == []


@pytest.mark.usefixtures("short_turns")
async def test_a_fault_in_a_later_turn_does_not_end_them(
    harness: Harness, monkeypatch: pytest.MonkeyPatch, escaped: list
) -> None:
    await many(harness, 14)
    fail(harness, 0)
    harness.bridge._announce()
    with monkeypatch.context() as broken:
        broken.setattr(announcements, "topic_status", lambda *_: 1 / 0)
        by_entry = harness.broker.faults.by_entry
        await until(lambda: by_entry.get("bridge.announcing") == 1, "a fault")
    harness.bridge._announce()
    await until(lambda: errors(harness), "the announcement")
    escaped.clear()
