"""Topics come, change and go; `python tests/ros/churn.py --minutes 5` does it for longer."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from pathlib import Path

import pytest

from appliance.host.environment import for_other_programs

pytestmark = [pytest.mark.timed, pytest.mark.usefixtures("isolated_domain")]

pytest.importorskip("rclpy")

#: Seconds until a route follows: the most for half of them, and for all.
MEDIAN, WORST = 1.0, float(os.environ.get("CHURN_PATIENCE", "5"))


async def test_routes_follow_topics_that_come_change_and_go():
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, str(Path(__file__).parent / "churn.py")),
        *("--minutes", "0.1", "--topics", "40"),
        stdout=asyncio.subprocess.PIPE,
        env=for_other_programs(),
    )
    try:
        out, _ = await asyncio.wait_for(process.communicate(), 60)
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    result = json.loads(out.splitlines()[-1])
    print(result)
    assert process.returncode == 0
    assert result["lost"] == []
    assert result["changes"] > 60
    assert result["median"] < MEDIAN
    assert result["worst"] < WORST
