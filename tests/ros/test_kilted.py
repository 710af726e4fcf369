"""What tells most about a distribution of ROS 2, once more on Kilted; all else runs on Jazzy."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from appliance.host.environment import for_other_programs

ROOT = Path(__file__).parents[2]

#: What this run of pytest, and the `make` that started it, say to programs that they start.
OF_THIS_RUN = ("PYTEST_", "MAKE", "MFLAGS")


@pytest.mark.timeout(1800)  # beside others, with its packages from PyPI the first time
@pytest.mark.skipif("ROS_DISTRO" in os.environ, reason="a ROS is sourced: that one is tested")
def test_what_is_run_on_kilted_passes() -> None:
    environment = for_other_programs()
    for name in [name for name in environment if name.startswith(OF_THIS_RUN)]:
        del environment[name]
    command = ["make", "--no-print-directory", "test-kilted", f"PYTHON={sys.executable}"]
    # A group of its own, so that its workers end with it if this test is ended.
    making = subprocess.Popen(
        [*command, "WORKERS=2"],
        cwd=ROOT,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    try:
        told, _ = making.communicate()
    finally:
        with suppress(ProcessLookupError):
            os.killpg(making.pid, signal.SIGKILL)
        making.wait()
    assert making.returncode == 0, told[-6000:]
    passed = re.search(r"^(\d+) passed", told, re.MULTILINE)
    assert passed and int(passed[1]) > 100, told[-1000:]
    (found,) = ROOT.glob(".venv-kilted/lib/python3*/site-packages/ros_rclpy-*.dist-info")
    assert found.name.startswith("ros_rclpy-9."), found  # Jazzy's is 7
