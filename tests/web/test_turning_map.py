"""The page Map with transforms: a robot that turns before a wall, by TF alone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from appliance_process import ApplianceProcess
from ros_domain import DOMAIN
from visits import DESKTOP, PHONE, Visit
from waiting import PATIENCE, eventually

#: m, where the wall is in the map, see turning_robot.py.
WALL = 2.0

pytest.importorskip("rclpy")
pytest.importorskip("playwright.sync_api")

#: What the canvas shows of the scan: how many pixels, from which x to which, and those of a metre.
RED = """() => {
    const canvas = document.querySelector('canvas')
    const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height)
    const found = { count: 0, left: canvas.width, right: 0 }
    for (let at = 0; at < data.length; at += 4) {
        if (data[at] < 200 || data[at + 1] > 60 || data[at + 2] > 60) continue
        const x = (at / 4) % canvas.width
        found.count += 1
        found.left = Math.min(found.left, x)
        found.right = Math.max(found.right, x)
    }
    const { width, height } = canvas
    return { ...found, width, metre: 0.92 * Math.min(width, height) / 6 }
}"""


@pytest.fixture(scope="module")
def bridge() -> dict[str, Any]:
    return {
        "discovery": "localhost",
        "topics": [{"ros": name, "to": "mqtt"} for name in ("/turning/*", "/tf", "/tf_static")],
    }


@pytest.fixture(scope="module", autouse=True)
def definition(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What ROS on PyPI lacks: the type of TF, for the appliance and for the robot."""
    prefix = tmp_path_factory.mktemp("tf")
    folder = prefix / "share/tf2_msgs/msg"
    folder.mkdir(parents=True)
    (folder / "TFMessage.msg").write_text("geometry_msgs/TransformStamped[] transforms\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AMENT_PREFIX_PATH", f"{prefix}:{sys.prefix}")
        yield


@pytest.fixture(scope="module")
def robot(appliance: ApplianceProcess) -> Iterator[subprocess.Popen[bytes]]:
    bus = {"ROS_DOMAIN_ID": DOMAIN, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    program = Path(__file__).parent / "turning_robot.py"
    process = subprocess.Popen([sys.executable, str(program)], env={**os.environ, **bus})
    yield process
    process.send_signal(signal.SIGCONT)
    process.terminate()
    process.wait(PATIENCE)


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("phone", PHONE),
        ("desktop", DESKTOP),
        ("phone-dark", {**PHONE, "color_scheme": "dark"}),
        ("desktop-dark", {**DESKTOP, "color_scheme": "dark"}),
    ],
)
def test_the_scan_stays_on_the_wall(
    visit: Callable[..., Visit],
    robot: subprocess.Popen[bytes],
    kind: str,
    options: dict[str, Any],
) -> None:
    """Its points are on the wall of the map, whichever way the robot looks."""
    visited = visit(**options)
    page = visited.sign_in(page="Map")
    page.wait_for_selector("dd:text-is('60 × 60, 0.1 m')")
    page.wait_for_selector("dd:text-is('0.50, 0.00 m')")  # by TF: it is at 0, 0 of its odometry
    page.wait_for_selector(".notice", state="detached")
    page.click("text='Show all'")
    headings: set[str] = set()
    heading = page.locator("dt:text-is('Heading') + dd")

    def looks() -> bool:
        found = page.evaluate(RED)
        if found["count"] == 0:
            return False
        # From the cell of the wall, 0.1 m wide; a point is 3 pixels wide, or 6 on a sharp screen.
        wall = found["width"] / 2 + WALL * found["metre"]
        near = 0.1 * found["metre"] + 6
        assert wall - near < found["left"] <= found["right"] < wall + near, (found, headings)
        headings.add(heading.inner_text())
        return len(headings) >= 8

    eventually(looks, "the robot looks in many directions")
    visited.look(f"{kind}-map-tf")
