"""What tells most about a distribution of ROS 2, once more on Kilted; all else runs on Jazzy."""

from __future__ import annotations

import os
import re
import subprocess
import sys
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
    done = subprocess.run(
        ["make", "--no-print-directory", "test-kilted", f"PYTHON={sys.executable}", "WORKERS=2"],
        cwd=ROOT,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert done.returncode == 0, done.stdout[-6000:]
    passed = re.search(r"^(\d+) passed", done.stdout, re.MULTILINE)
    assert passed and int(passed[1]) > 100, done.stdout[-1000:]
