"""Test runs beside each other have different ROS domains: on one of their own two would meet."""

from __future__ import annotations

import os
import subprocess
import sys

from ros_domain import DOMAIN, LAST

#: Another process that would like to have this one's.
ANOTHER = """
import os
os.getpid = lambda: {wanted} - 1
from ros_domain import DOMAIN
print(DOMAIN)
"""


def test_a_domain_is_one_run_s_alone():
    found = subprocess.run(
        [sys.executable, "-c", ANOTHER.format(wanted=DOMAIN)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        check=True,
    )
    assert 1 <= int(found.stdout) <= LAST and found.stdout.strip() != DOMAIN
