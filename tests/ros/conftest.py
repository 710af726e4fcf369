"""Fixtures of the bridge's tests: an isolated ROS domain, the demo robot, a FakeNode's bridge."""

from __future__ import annotations

import pytest
from bridge_harness import Harness
from robot_process import Robot
from ros_domain import DOMAIN, isolated_domain

__all__ = ["isolated_domain"]


@pytest.fixture(scope="module")
def domain():
    """`isolated_domain` for all tests of a module together."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", DOMAIN)
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield


@pytest.fixture(scope="module")
def robot(domain):
    robot = Robot()
    robot.wait()
    yield robot
    robot.stop()


@pytest.fixture
async def harness():
    """A bridge on a FakeNode; nothing of it is left on the node at the end."""
    harness = Harness()
    yield harness
    await harness.bridge.stop()
    assert harness.node.subscriptions == harness.node.own_publishers == []
