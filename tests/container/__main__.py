"""The whole image, with ROS and machine code, from the command line; it takes minutes::

    python tests/container

Builds it without pulling anything, runs it as docs/container.md has it, with ROS nodes in a second
container, and prints the figures. The exit code is 1 when anything is not as it should be.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from container.engine import BASE, Engine, engine, obstacle
from container.trial import ROBOT, Container

IMAGE = "localhost/appliance"
MIB = 1 << 20

#: What compiling needs beside the appliance's own dependencies.
COMPILE_NEEDS = ("async-timeout>=5", "mypy[mypyc]>=2.4", "pydantic>=2.10", "types-PyYAML>=6.0.12")

#: A robot's node: says /chatter, and prints what is said on /said.
NODE = """
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("robot")
chatter = node.create_publisher(String, "/chatter", 10)
node.create_timer(0.2, lambda: chatter.publish(String(data="from ROS")))
node.create_subscription(String, "/said", lambda said: print(said.data, flush=True), 10)
rclpy.spin(node)
"""

TOPICS = """\
  topics:
    - {ros: /chatter, to: mqtt, encoding: text}
    - {ros: /said, to: ros, type: std_msgs/msg/String, encoding: text}
"""

#: How its ROS nodes are reached: options of the appliance's container, and of theirs.
WAYS = {
    "UDP, nodes of another user": ((), ("--user", "1234:1234")),
    "shared memory, nodes of its user": (
        ("--ipc", "host", "--env", "FASTDDS_BUILTIN_TRANSPORTS=DEFAULT"),
        ("--ipc", "host", "--env", "FASTDDS_BUILTIN_TRANSPORTS=DEFAULT"),
    ),
}


@contextmanager
def timed(what: str) -> Iterator[None]:
    before = time.monotonic()
    yield
    say(what, f"{time.monotonic() - before:.1f} s")


def say(what: str, figure: str) -> None:
    print(f"{what:<50}{figure}", flush=True)


def try_ros(podman: Engine, container: Container, robot: tuple[str, ...]) -> None:
    """A String each way between an MQTT client and a ROS node in another container."""
    podman.run(
        *("--detach", "--name", "robot", "--tmpfs", "/tmp", *robot, "--env", "ROS_LOG_DIR=/tmp"),
        *("--entrypoint", "/opt/appliance/bin/python", IMAGE, "-c", NODE),
    )
    try:
        topic = ("-t", f"{ROBOT}/chatter", "-C", "1", "-W", "60")
        with timed("  a String from ROS, from the node's start on"):
            heard = container.mosquitto("sub", *topic).strip()
        assert heard == "from ROS", heard
        container.engine.wait_for(container.name, "/said")
        with timed("  a String to ROS"):
            deadline = time.monotonic() + 60
            while "to ROS" not in podman.podman("logs", "robot"):
                assert time.monotonic() < deadline, podman.podman("logs", "robot") + container.log
                container.publish("said", "to ROS")
    finally:
        podman.podman("rm", "--force", "--time", "0", "robot")


def trial(podman: Engine) -> None:
    with timed("base, and Python's packages"):
        podman.prepare(("ros", "camera", "plugins"), COMPILE_NEEDS)
    with timed("the image is built, compiled"):
        podman.build(IMAGE)
    image, base = podman.inspect(IMAGE)["Size"], podman.inspect(BASE)["Size"]
    say("its size", f"{image / MIB:.0f} MiB, of which the base {base / MIB:.0f} MiB")
    version = podman.run("--rm", IMAGE, "--version").strip()
    assert version.endswith(", compiled"), version

    container = Container(podman, IMAGE)
    with timed("the first start, until MQTT answers"):
        container.start("--tmpfs", "/tmp")
    configuration = podman.folder("first-configuration")
    file, rules = configuration / "appliance.yaml", configuration / "acl.conf"
    assert "  topics: []\n" in file.read_text()
    file.write_text(file.read_text().replace("  topics: []\n", TOPICS))
    rules.write_text(f"{rules.read_text()}topic write {{robot}}/said\n")
    for way, (appliance, robot) in WAYS.items():
        container.remove()
        print(f"ROS by {way}", flush=True)
        with timed("  a start, until MQTT answers"):
            container.start("--tmpfs", "/tmp", *appliance)
        try_ros(podman, container, robot)
    with timed("the health check"):
        podman.podman("healthcheck", "run", container.name)
    kept = container.kept_through_a_kill(20)
    say("kept through SIGKILL and a start", f"{kept} of 20 messages")
    assert kept == 20
    memory = podman.podman("exec", container.name, "appliance", "status")
    say("memory", next(line for line in memory.splitlines() if line.startswith("memory"))[14:])
    say("SIGTERM until the container has ended", f"{container.stop():.1f} s")
    assert container.exit_code == 0, container.log


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python tests/container", description="Build the whole image, and try it."
    )
    parser.parse_args()
    if reason := obstacle():
        parser.error(reason)
    with engine() as podman:
        try:
            trial(podman)
        except AssertionError as error:
            print(error, file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
