"""The watchdog's sign of life: a message that went through a turn, and a clock that goes."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from harness import Harness, make_contexts
from waiting import until

from appliance.broker.link import InsideLink
from appliance.broker.session import Session
from appliance.mqtt.packets import Publish
from appliance.ops.watchdog import CLOCK_PATIENCE, Pulse


class Time:
    """The loop's clock, moved on by hand."""

    def __init__(self, harness: Harness) -> None:
        self.harness = harness
        self.now = asyncio.get_running_loop().time()

    def pass_by(self, seconds: float, *, tick: bool = True) -> None:
        self.now += seconds
        if tick:
            self.harness.broker.tick(self.now)

    def __call__(self) -> float:
        return self.now


@pytest.fixture
async def harness(tmp_path: Path) -> AsyncIterator[Harness]:
    harness = Harness(*make_contexts(tmp_path / "certs"))
    await harness.start()
    yield harness
    if "_appliance" in harness.broker.sessions:
        harness.broker.detach(harness.broker.sessions["_appliance"])
    await harness.close()


@pytest.fixture
async def clock(harness: Harness) -> Time:
    clock = Time(harness)
    clock.pass_by(0)
    return clock


@pytest.fixture
async def inside(harness: Harness) -> Session:
    return harness.broker.attach("_appliance", InsideLink())


@pytest.fixture
async def pulse(harness: Harness, clock: Time, inside: Session) -> Pulse:
    return Pulse(harness.broker, harness.scheduler, inside, clock)


async def lives(pulse: Pulse) -> bool:
    """Asked as the watchdog's timer does: the loop has turned meanwhile."""
    for _ in range(5):
        await asyncio.sleep(0)
    return pulse.is_alive()


async def test_it_is_there_when_nothing_happens(pulse: Pulse, clock: Time):
    assert not pulse.is_alive()  # none has gone through yet
    for _ in range(10):
        clock.pass_by(1)
        assert await lives(pulse)


async def test_and_under_load(harness: Harness, pulse: Pulse, clock: Time):
    """Large messages take turn after turn; it has its own in between."""
    peers = [await harness.log_in(f"c{n}") for n in range(10)]
    pulse.is_alive()
    for peer in peers:
        peer.writer.write(Publish("x", bytes(3_000_000)).encode(5))
    await until(lambda: harness.scheduler._turn_queue, "somebody's turn")
    clock.pass_by(1)
    await until(lambda: pulse._has_passed, "the message to go through")
    assert pulse.is_alive()


@pytest.mark.patches
async def test_not_when_no_turn_comes(harness: Harness, pulse: Pulse, clock: Time, caplog):
    pulse.is_alive()
    assert await lives(pulse)
    harness.scheduler._schedule_turns = lambda: None  # type: ignore[method-assign]
    assert await lives(pulse)  # the last one went through before that
    for _ in range(3):
        clock.pass_by(1)
        assert not await lives(pulse)
    told = [record for record in caplog.records if "no sign of life" in record.message]
    assert len(told) == 1 and "no message has gone through a turn" in told[0].message
    del harness.scheduler._schedule_turns
    harness.scheduler._schedule_turns()
    clock.pass_by(1)
    assert await lives(pulse)


async def test_not_when_the_clock_stands_still(pulse: Pulse, clock: Time, caplog):
    pulse.is_alive()
    assert await lives(pulse)
    clock.pass_by(CLOCK_PATIENCE + 0.1, tick=False)
    assert not await lives(pulse)
    assert "the broker's clock stands still" in caplog.text
    clock.pass_by(0)
    assert await lives(pulse)


@pytest.mark.patches
async def test_a_turn_that_fails_is_no_sign_of_life(
    harness: Harness, pulse: Pulse, clock: Time, monkeypatch: pytest.MonkeyPatch, escaped
):
    pulse.is_alive()
    assert await lives(pulse)
    with monkeypatch.context() as broken:
        broken.setattr(harness.broker, "publish", None)
        assert not await lives(pulse) or not await lives(pulse)
    assert harness.broker.faults.by_entry["connection.turn"] >= 1
    assert await lives(pulse) or await lives(pulse)
    escaped.clear()
