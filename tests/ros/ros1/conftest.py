"""One Master, one appliance and one robot for all tests with ROS 1; they clean up behind them."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator

import pytest
from ros1_world import Node, Python, Ros1Appliance, Run, World
from waiting import PATIENCE

BRIDGE = {
    "ros_arguments": ["/greet:=/elsewhere/greet"],
    "topics": [
        {"ros": ["/chatter", "/robot/*", "/many"], "to": "mqtt", "keep": 10000},
        {"ros": "/hear", "to": "ros", "type": "std_msgs/msg/String"},
        {"ros": "/both", "to": "both", "encoding": "ros1", "type": "std_msgs/msg/String"},
        {"ros": "/raw/*", "to": "mqtt", "encoding": "ros1"},
        {"ros": "/stamped", "to": "ros", "type": "geometry_msgs/msg/PointStamped"},
        {
            "ros": "/cmd_vel",
            "to": "ros",
            "type": "geometry_msgs/msg/Twist",
            "clamp": {"linear.x": [-0.5, 0.5]},
            "exclusive": True,
            "lease": "60 s",
            "on_silence": {"after": "300 ms", "publish": {}},
        },
    ],
    "services": [
        {"ros": ["/robot/*", "/greet", "/elsewhere/*"]},
        {"ros": "/robot/sleep", "timeout": "300 ms"},
        {
            "ros": "/ask_human",
            "to": "mqtt",
            "type": "std_srvs/srv/SetBool",
            "timeout": "5 s",
            "on_error": {"success": False, "message": "nobody"},
        },
        {"ros": "/ask_nobody", "to": "mqtt", "type": "std_srvs/srv/SetBool", "timeout": "300 ms"},
    ],
    "actions": ["/robot/*"],
    "parameters": [
        {"ros": ["/arm/*", "!/arm/secret", "/speed", "/arm/absent"]},
        {"ros": "/camera/*", "encoding": "cbor"},
    ],
    "limits": {"payload": "64 KiB"},
}


@pytest.fixture(scope="package")
def python(tmp_path_factory: pytest.TempPathFactory) -> Python:
    return Python(tmp_path_factory.mktemp("python"))


@pytest.fixture(scope="package")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    world = World(tmp_path_factory.mktemp("ros1"))
    yield world
    world.kill()


@pytest.fixture(scope="package")
def appliance(
    python: Python, world: World, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Ros1Appliance]:
    """It is there before the Master is."""
    process = Ros1Appliance(tmp_path_factory.mktemp("appliance"), python, world, BRIDGE)
    with process.running():
        process.wait_for_log("waiting for the ROS Master: .*refused")
        world.start()
        process.wait_for_log("on ROS as /appliance", timeout=2 * PATIENCE)
        yield process


@pytest.fixture(scope="package")
def robot(world: World, appliance: Ros1Appliance) -> Iterator[Node]:
    node = Node(world)
    try:
        assert node.hear() == ["ok", "ready"]
        for name in ("switch", "work"):
            appliance.wait_for_log(f"/robot/{name} can be called")
        yield node
    finally:
        node.stop()


@pytest.fixture
def run(appliance: Ros1Appliance) -> Run:
    def run(*arguments: str, **environment: str) -> tuple[int, str]:
        """A command's exit code and what it says."""
        login = {"APPLIANCE_PASSWORD": appliance.passwords["alice"]}
        done = subprocess.run(
            [appliance.python, "-m", "appliance", *arguments, "-c", appliance.config],
            env={**os.environ, **appliance.environment, **login, **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=2 * PATIENCE,
            check=False,
        )
        return done.returncode, done.stdout

    return run
