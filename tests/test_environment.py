"""What other programs inherit."""

from __future__ import annotations

import sys
from pathlib import Path

from appliance.environment import for_other_programs


def test_what_the_ros_wheels_added_is_taken_away() -> None:
    wheels = Path(sys.prefix, "lib")
    environment = {
        "HOME": "/home/r2",
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
        "LD_LIBRARY_PATH": f"{wheels}:/opt/own/lib:{wheels}/python3/site-packages/ros_x.libs",
    }
    assert for_other_programs(environment) == {
        "HOME": "/home/r2",
        "LD_LIBRARY_PATH": "/opt/own/lib",
    }
    environment["LD_LIBRARY_PATH"] = str(wheels)
    assert for_other_programs(environment) == {"HOME": "/home/r2"}


def test_a_sourced_ros_is_left_alone() -> None:
    environment = {"LD_LIBRARY_PATH": f"{sys.prefix}/lib:/opt/ros/jazzy/lib"}
    assert for_other_programs(environment) == environment
