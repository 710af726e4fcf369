"""Which topic filter ends the connection of a link is found, and left out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from waiting import until

from appliance.mqtt.packets import Disconnect, Publish, Subscribe
from appliance.mqtt.reason import ReasonCode
from appliance.upstream import unanswered as unanswered_module
from appliance.upstream import uplink
from appliance.upstream.status import warnings_of
from appliance.upstream.unanswered import (
    LEFT_OUT_FOR,
    LIVED,
    LONGEST_LEFT_OUT,
    UnansweredFilters,
)
from upstream.fake_fleet import FakeFleet, Visit, accept, refuse
from upstream.uplink_rig import Rig, hurry, running
from upstream.uplink_rig import event_loop_policy as event_loop_policy

pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')


def hurry_to_judge(monkeypatch: pytest.MonkeyPatch) -> None:
    """A connection has lived soon, so that what ends it is soon found."""
    hurry(monkeypatch)
    monkeypatch.setattr(uplink, "TICK", 0.05)
    monkeypatch.setattr(unanswered_module, "LIVED", 0.2)


class Connections:
    """Connections to a broker that closes at some filters."""

    def __init__(self, *filters: str) -> None:
        self.unanswered = UnansweredFilters()
        self.filters = filters
        self.closes = 0

    def connect(self, closes_at: Callable[[str], bool], now: float = 0.0) -> set[str] | None:
        """One that lives for long if it is not closed; what is subscribed to, None if closed."""
        one_by_one = self.unanswered.one_by_one
        asked = self.unanswered.ask(self.filters)
        answered: list[str] = []
        for batch in [[each] for each in asked] if one_by_one else [asked] if asked else []:
            if any(map(closes_at, batch)):
                return self.close(batch, now, answered, lived=False)
            answered += batch
        self.unanswered.answered(answered)
        missing = [each for each in self.filters if each not in answered]
        for each in self.unanswered.due(missing, LIVED, now):
            if closes_at(each):
                return self.close([each], now, answered, lived=True)
            answered.append(each)
            self.unanswered.answered(answered)
        return set(answered)

    def close(self, filters: list[str], now: float, answered: list[str], *, lived: bool) -> None:
        self.closes += 1
        self.unanswered.closed(filters, now, answered, lived=lived)


@pytest.mark.parametrize("bad", [{"a"}, {"c"}, {"b", "d"}, {"a", "b", "c"}, {"a", "b", "c", "d"}])
def test_filters_that_end_the_connection_are_found_and_others_are_not_left_out(
    bad: set[str],
) -> None:
    link = Connections("a", "b", "c", "d")
    while link.connect(lambda each: each in bad) is None:
        assert link.closes < 20
    assert link.connect(lambda each: each in bad) == set("abcd") - bad
    # Their time is over, and they are allowed now.
    assert link.connect(lambda each: False, LEFT_OUT_FOR - 1) == set("abcd") - bad
    assert link.connect(lambda each: False, LEFT_OUT_FOR) == set("abcd")
    assert not link.unanswered.one_by_one


def test_a_filter_that_is_alone_is_left_out_as_well_but_not_for_one_close() -> None:
    link = Connections("a")
    assert link.connect(lambda each: True) is None
    assert link.connect(lambda each: False) == {"a"}  # asked for at once
    while link.connect(lambda each: True) is None:
        assert link.closes < 7
    assert link.connect(lambda each: True) == set()


@pytest.mark.parametrize("closes", range(1, 12))
def test_closes_for_another_reason_leave_nothing_out(closes: int) -> None:
    """As of a broker that is starting: upon whatever it is asked first."""
    link = Connections("a", "b", "c")
    for _ in range(closes):
        for each in link.unanswered.ask(link.filters)[:1]:
            link.close([each], 0, [], lived=False)
    assert link.connect(lambda each: False) == {"a", "b", "c"}
    assert not link.unanswered.one_by_one


def test_a_filter_is_left_out_for_longer_each_time() -> None:
    link = Connections("a", "b")
    now = 0.0
    times = []
    while len(times) < 7:
        closes = link.closes
        if link.connect(lambda each: each == "a", now) is not None:
            before = now
            while not link.unanswered.due(["a"], LIVED, now):
                now += LEFT_OUT_FOR / 4
            times.append((now - before) / LEFT_OUT_FOR)
            assert link.closes == closes
    assert times == [1, 2, 4, 8, 16, 24, LONGEST_LEFT_OUT / LEFT_OUT_FOR]


@pytest.mark.parametrize("how", ["closes", "disconnects"])
async def test_a_link_works_without_a_filter_and_asks_for_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    hurry_to_judge(monkeypatch)
    monkeypatch.setattr(unanswered_module, "LEFT_OUT_FOR", 5.0)
    command, secret = "fleet/r2d2/cmd/#", "fleet/r2d2/secret/#"
    rules = [{"topic": "secret/#"}, {"topic": "cmd/#"}]
    async with FakeFleet() as fleet:
        is_allowed = False

        def grant(visit: Visit, packet: Subscribe) -> None:
            if secret in (each.filter for each in packet.subscriptions) and not is_allowed:
                (_disconnect if how == "disconnects" else Visit.close)(visit)
            else:
                fleet.good_grant(visit, packet)

        fleet.grant = grant
        async with running(Rig(tmp_path, fleet.port, **{"in": rules})) as rig:
            await until(lambda: rig.status().missing_filters == [secret])
            await until(lambda: rig.status().connected and command in fleet.visit.filters)
            visit = fleet.visit
            assert secret not in visit.filters and rig.status().problem is None
            (told,) = warnings_of(rig.status().as_json())
            assert secret in told
            is_allowed = True
            await until(lambda: not rig.status().missing_filters)
            await until(lambda: secret in visit.filters)
            await rig.drained()
            assert fleet.visit is visit and rig.status().connected
            states = [each.payload for each in visit.published if "state" in each.topic]
            assert states == [b"online"]  # not said again
            assert not list(warnings_of(rig.status().as_json()))


def _disconnect(visit: Visit) -> None:
    visit.send(Disconnect(ReasonCode.NOT_AUTHORIZED))
    visit.close()


@pytest.mark.parametrize("how", ["closes", "disconnects", "answers and closes"])
async def test_a_link_works_without_a_state_that_the_fleet_does_not_take_and_says_it_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, how: str
) -> None:
    hurry_to_judge(monkeypatch)
    monkeypatch.setattr(unanswered_module, "LEFT_OUT_FOR", 6.0)
    state, door = "fleet/r2d2/_appliance/state", "fleet/r2d2/events/door"
    async with FakeFleet() as fleet:
        is_allowed = False

        def acknowledge(visit: Visit, packet: Publish) -> None:
            if packet.topic != state or is_allowed:
                accept(visit, packet)
            elif how == "disconnects":
                _disconnect(visit)
            else:
                if how == "answers and closes":
                    refuse(ReasonCode.NOT_AUTHORIZED)(visit, packet)
                visit.close()

        fleet.acknowledge = acknowledge
        async with running(Rig(tmp_path, fleet.port)) as rig:
            await until(lambda: "ends the connection upon" in (rig.status().state_refusal or ""))
            publisher = await rig.client("publisher")
            await publisher.send(Publish("r2d2/events/door", b"x", 1, packet_id=1))
            await until(lambda: door in fleet.topics)
            await rig.drained()
            visit, closes = fleet.visit, len(fleet.visits)
            assert rig.status().connected and rig.status().problem is None
            (told,) = warnings_of(rig.status().as_json())
            assert "the fleet does not see that the robot is online" in told
            assert caplog.text.count("ends the connection upon") == 1
            assert closes < 9
            is_allowed = True
            await until(lambda: rig.status().state_refusal is None)
            assert fleet.visit is visit
            states = [each.payload for each in visit.published if each.topic == state]
            assert states == [b"online"]
            publisher.hang_up()
        assert fleet.published[-1].payload == b"offline"


async def test_closes_behind_a_state_that_the_fleet_takes_leave_nothing_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a broker that restarts again and again."""
    hurry_to_judge(monkeypatch)
    state = "fleet/r2d2/_appliance/state"
    async with FakeFleet() as fleet:

        def acknowledge(visit: Visit, packet: Publish) -> None:
            if fleet.topics.count(state) <= 3:
                visit.close()
            else:
                accept(visit, packet)

        fleet.acknowledge = acknowledge
        async with running(Rig(tmp_path, fleet.port)) as rig:
            await until(lambda: fleet.topics.count(state) == 4)
            await until(lambda: rig.uplink._state.is_settled and rig.status().connected)
            assert rig.status().state_refusal is None and len(fleet.visits) == 4


async def test_closes_between_connack_and_suback_leave_no_command_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hurry_to_judge(monkeypatch)
    async with FakeFleet() as fleet:

        def grant(visit: Visit, packet: Subscribe) -> None:
            if len(fleet.visits) <= 5:
                visit.close()
            else:
                fleet.good_grant(visit, packet)

        fleet.grant = grant
        async with running(Rig(tmp_path, fleet.port)) as rig:
            both = {"fleet/r2d2/cmd/#", "fleet/r2d2/_answers/+"}
            await until(lambda: len(fleet.visits) > 5 and set(fleet.visit.filters) == both)
            await until(lambda: rig.status().connected and not rig.status().missing_filters)
