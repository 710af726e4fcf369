"""A domain of its own and the demo robot, for the modules that drive it."""

from __future__ import annotations

import os

import pytest
from robot_process import Robot


@pytest.fixture(scope="module")
def domain():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield


@pytest.fixture(scope="module")
def robot(domain):
    robot = Robot()
    robot.wait()
    yield robot
    robot.stop()
