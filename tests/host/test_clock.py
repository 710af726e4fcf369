"""The wall clock is set while the appliance runs: nobody is disconnected, nothing expires early."""

from __future__ import annotations

import time
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from appliance_process import ROBOT, ApplianceProcess
from raw_client import RawClient
from waiting import PATIENCE, eventually
from wall_clock import HOUR, YEAR, WallClock

from appliance.host import clock
from appliance.host.clock import RELEASED, SHORTEST_SLEEP, SleepWatch, StepWatch, is_unset
from appliance.mqtt.codec import Properties, Property
from appliance.mqtt.packets import (
    Connack,
    Disconnect,
    Publish,
    Subscribe,
    Subscription,
    Will,
)
from appliance.mqtt.reason import ReasonCode

INBOX, WILLS = f"{ROBOT}/inbox", f"{ROBOT}/wills"
#: Nobody has a password: to check one takes longer than all the rest.
ACL = f"topic readwrite {ROBOT}/#\n"

SET = "the computer's clock was set"


def lasting(seconds: int) -> dict[str, Any]:
    return {"clean": False, "properties": {Property.SESSION_EXPIRY_INTERVAL: seconds}}


def expiring(payload: bytes, seconds: int, **fields: Any) -> Publish:
    interval: Properties = {Property.MESSAGE_EXPIRY_INTERVAL: seconds}
    return Publish(INBOX, payload, 1, properties=interval, **fields)


def left(publish: Publish) -> int:
    assert publish.properties is not None
    value = publish.properties[Property.MESSAGE_EXPIRY_INTERVAL]
    assert isinstance(value, int)
    return value


def test_the_clock_is_set_while_it_runs(tmp_path: Path) -> None:
    clock = WallClock(tmp_path / "clock")
    process = ApplianceProcess(
        tmp_path / "house", acl=ACL, broker={"audit": {"path": "audit.jsonl"}, "anonymous": True}
    )
    process.environment = clock.environment
    process.start()
    clients: list[RawClient] = []

    def join(client_id: str, version: int = 5, **fields: Any) -> RawClient:
        client = RawClient(process, version)
        clients.append(client)
        connack = client.decode(client.connect(client_id, None, **fields))
        assert isinstance(connack, Connack) and connack.reason_code == 0
        return client

    try:
        for name, seconds in (("long", 1000), ("short", 4)):
            sleeper = join(name, **lasting(seconds))
            sleeper.send(Subscribe(1, [Subscription(INBOX, 1)]))
            sleeper.receive()
            sleeper.send(Disconnect())
        began = time.monotonic()
        old, new = join("old", 4, keep_alive=60), join("new", 5, keep_alive=60)
        old.send(Subscribe(1, [Subscription(WILLS, 1)]))
        old.receive()
        new.send(expiring(b"for long", 600, packet_id=1), expiring(b"not for long", 2, packet_id=2))
        new.send(expiring(b"kept", 600, packet_id=3, retain=True))
        new.drain()
        taken = time.monotonic()
        will = Will(WILLS, b"gone", 1, properties={Property.WILL_DELAY_INTERVAL: 3})
        mortal = join("mortal", 5, will=will, **lasting(60))
        died = time.monotonic()
        mortal.kill()

        wills: list[float] = []

        def listen() -> None:
            wills.extend(time.monotonic() for got in old.drain() if isinstance(got, Publish))

        for number, ahead in enumerate((HOUR, -HOUR, 30 * YEAR, -56 * YEAR), 1):
            heard = time.monotonic()
            silent = join("silent", 5, keep_alive=2)
            clock.set(ahead)
            while process.log.count(SET) < number:  # it looks once a second
                assert time.monotonic() - heard < PATIENCE, process.log
                listen()
                new.drain()
                time.sleep(0.1)
        told = process.wait_for_log(SET, 4)
        assert "forward by 1:00:00" in told[0] and "back by 2:00:00" in told[1]
        # Who is silent is disconnected, and not before its time.
        told_why = silent.decode(silent.receive())
        assert told_why == Disconnect(ReasonCode.KEEP_ALIVE_TIMEOUT)
        assert 3 <= time.monotonic() - heard < 3 + PATIENCE
        eventually(lambda: wills or listen(), "the will")
        assert len(wills) == 1 and 3 <= wills[0] - died < 3 + PATIENCE
        assert "clock was set forward by 1:00:00" in (tmp_path / "house/audit.jsonl").read_text()

        # And through a restart, by a clock that says something else again.
        process.stop()
        clock.set(HOUR)
        process.start()
        elapsed = time.monotonic() - began
        assert elapsed > 4  # the short session's time
        with RawClient(process, 5) as client:
            connack = client.decode(client.connect("short", None, **lasting(4)))
            assert isinstance(connack, Connack) and not connack.session_present
        with RawClient(process, 5) as client:
            read_at = time.monotonic()
            connack = client.decode(client.connect("long", None, **lasting(1000)))
            assert isinstance(connack, Connack) and connack.session_present
            owed = [got for got in client.drain() if isinstance(got, Publish)]
            client.send(Subscribe(1, [Subscription(INBOX, 0)]))
            [retained] = [got for got in client.drain() if isinstance(got, Publish)]
        assert [publish.payload for publish in owed] == [b"for long", b"kept"]
        assert retained.payload == b"kept"
        for publish in (*owed, retained):
            assert 598 - (time.monotonic() - began) <= left(publish) <= 602 - (read_at - taken)
    finally:
        for client in clients:
            client.socket.close()
        process.stop()


def test_a_step_is_told_from_a_nudge() -> None:
    walls = iter([1000.0, 1001.0, 1003.5, 4604.5, 1.0, 2.0])
    watch = StepWatch(10.0, lambda: next(walls))
    steps = [watch.look(now) for now in (11.0, 12.0, 13.0, 14.0, 15.0)]
    assert steps == [0.0, 0.0, 3600.0, -4604.5, 0.0]


def test_a_clock_that_was_never_set() -> None:
    assert is_unset(RELEASED - timedelta(seconds=1)) and not is_unset(RELEASED)
    assert not is_unset()


def test_sleep_is_what_the_monotonic_clock_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    started = [50.0]
    monkeypatch.setattr(clock.time, "clock_gettime", lambda which: started[0])
    monkeypatch.setattr(clock.time, "monotonic", lambda: 30.0)
    watch = SleepWatch()
    assert watch.seconds() == 0
    # Between its two readings of the clocks the thread may have lost the processor.
    for step in (-5.0, SHORTEST_SLEEP / 2, 0.0):
        started[0] = 50.0 + step
        assert watch.seconds() == 0
    started[0] = 70.0
    assert watch.seconds() == 20
    started[0] = 65.0
    assert watch.seconds() == 20


def test_a_first_reading_that_is_held_up_is_no_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
    readings = iter([49.9, 50.0, 50.0, 49.0, 50.0, 50.0, 50.0])
    monkeypatch.setattr(clock, "_asleep", lambda: next(readings))
    watch = SleepWatch()
    assert watch.seconds() == watch.seconds() == 0


def test_no_sleep_is_seen_while_the_computer_is_awake() -> None:
    watch = SleepWatch()
    assert not any(watch.seconds() for _ in range(20_000))
