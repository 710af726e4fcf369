"""A short run of old_commands.py, which has a table of all clients and of what may happen."""

from __future__ import annotations

import shutil

import pytest

pytest.importorskip("rclpy")
from appliance_process import MOSQUITTO
from old_commands import HERE, mosquitto_pub, run

pytestmark = [pytest.mark.timed, pytest.mark.usefixtures("isolated_domain")]

has_mqttjs = shutil.which("node") and (HERE.parent / "interop/mqttjs/node_modules/mqtt").exists()
KINDS = ["paho", *(["mqttjs"] if has_mqttjs else []), *(["bridge"] if MOSQUITTO else [])]


@pytest.mark.timeout(300)
@pytest.mark.parametrize("scenario", ["never_seen", "restart_by_sigkill", "single"])
async def test_no_old_command_moves_the_robot(scenario):
    """Of QoS 1 all libraries have a queue; what is new is carried out."""
    outcomes = await run(scenario, KINDS, versions=["3.1.1"], qualities=[1])
    assert [outcome for outcome in outcomes if outcome.problem] == []


@pytest.mark.skipif(shutil.which("mosquitto_pub") is None, reason="there is no mosquitto_pub")
async def test_a_command_between_connect_and_disconnect():
    assert (await mosquitto_pub("5", 1)).problem == ""
