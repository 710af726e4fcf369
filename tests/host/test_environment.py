"""The environment that other programs inherit."""

from __future__ import annotations

import sys
from pathlib import Path

from appliance import config
from appliance.host.environment import for_other_programs, of_service


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


def test_the_services_configuration_is_read_with_its_variables(tmp_path: Path) -> None:
    """`appliance install` again, `status` and `doctor` in a shell that has none of them."""
    file, variables = tmp_path / "etc/appliance/appliance.yaml", tmp_path / "etc/default/appliance"
    file.parent.mkdir(parents=True)
    variables.parent.mkdir()
    file.write_text("robot: ${FLEET_NAME}\n")
    assert of_service(file) == {}
    variables.write_text(
        "# FLEET_NAME=no\n; A=no\nnothing\nFLEET_NAME=r2d2\nB='b c' \nC=c d\nD=d\\\ne\nE=\"e\n"
    )
    assert of_service(file) == {"FLEET_NAME": "r2d2", "B": "b c", "C": "c d", "D": "de"}
    assert config.load(file).robot == "r2d2"
    variables.write_bytes(b"\xff=")
    assert of_service(file) == {}
    assert of_service(tmp_path / "appliance.yaml") == of_service(Path("appliance.yaml")) == {}
