"""How long a message that the fleet's broker has kept waits for ROS."""

from __future__ import annotations

from pathlib import Path

import pytest
from waiting import until

from appliance.upstream import in_session, readiness
from appliance.upstream.readiness import FORGOTTEN, GIVES_UP, PATIENCE, WAITS, Readiness
from upstream.fake_fleet import FakeFleet, Visit
from upstream.uplink_rig import Rig, hurry, running
from upstream.uplink_rig import event_loop_policy as event_loop_policy

pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')

WHY = "no node"


def test_ten_topics_without_a_node_wait_together_not_one_after_the_other() -> None:
    judge = Readiness().judge
    assert judge("t0", WHY, 0) == (True, WAITS)
    assert judge("t0", WHY, PATIENCE - 1) == (True, "")
    for number in range(10):
        assert judge(f"t{number}", WHY, PATIENCE) == (False, GIVES_UP)
        assert judge(f"t{number}", WHY, PATIENCE) == (False, "")
    assert judge("later", WHY, 2 * PATIENCE) == (True, WAITS)
    assert judge("later", "", 2 * PATIENCE + 1) == (False, "")
    # A node that is started anew is waited for.
    assert judge("later", WHY, 4 * PATIENCE) == (True, WAITS)
    assert judge("t0", "", 4 * PATIENCE) == (False, "")
    assert judge("t0", WHY, 6 * PATIENCE) == (True, WAITS)


def test_the_end_of_a_connection_does_not_begin_the_wait_anew() -> None:
    judge = Readiness().judge
    assert judge("t", WHY, 0)[0]
    assert judge("t", WHY, PATIENCE - 10)[0]
    assert judge("t", WHY, PATIENCE + 10) == (False, GIVES_UP)
    judge = Readiness().judge
    assert judge("t", WHY, 0)[0] and judge("t", WHY, FORGOTTEN)[0]


async def test_a_connection_that_is_not_read_while_ros_is_waited_for_lives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hurry(monkeypatch)
    monkeypatch.setattr(readiness, "PATIENCE", 3.0)
    monkeypatch.setattr(in_session, "WAITING_MESSAGES", 5)
    rules = [{"topic": "mission/#", "offline": "keep"}]
    async with FakeFleet() as fleet:

        def grant(visit: Visit, packet: object) -> None:
            fleet.good_grant(visit, packet)  # type: ignore[arg-type]
            if visit.connect is not None and visit.connect.client_id == "r2d2-keep":
                for number in range(8):
                    visit.message("fleet/r2d2/mission/go", b"%d" % number)

        fleet.grant = grant
        rig = Rig(tmp_path, fleet.port, keep_alive="1 s", **{"in": rules})
        async with running(rig):
            rig.app.broker.obstacles.append(lambda topic: WHY if "mission" in topic else "")
            await until(lambda: rig.status().held_back >= 5)
            await until(lambda: rig.status().delivered == 8)
            names = [each.client_id for each in fleet.connects]
            assert names.count("r2d2-keep") == 1
            assert not fleet.faults
