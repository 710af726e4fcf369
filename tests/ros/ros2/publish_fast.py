"""Publishes MESSAGES to a reliable subscriber in another process, some 4,000 a second.

It prints how often Fast DDS's thread for timers was woken meanwhile, and the seconds.

A program, because Fast DDS reads a profile once in a process, before its first participant.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from appliance.ros.ros2 import discovery, fastdds

MESSAGES = 2000
PAUSE = 0.0002  # seconds; without it a busy computer wakes the thread once for many
PATIENCE = 60.0


def main() -> None:
    if os.environ.pop("IS_LOCAL", ""):
        discovery.use("localhost", os.environ)
    else:
        fastdds.use_profile(os.environ)
    import rclpy
    from std_msgs.msg import String

    rclpy.init()
    node = rclpy.create_node("publisher" if sys.argv[1:] else "subscriber")
    if not sys.argv[1:]:
        node.create_subscription(String, "/fast", lambda _: None, 10)
        rclpy.spin(node)
        return
    publisher = node.create_publisher(String, "/fast", 10)
    listener = subprocess.Popen([sys.executable, __file__], env=chosen_anew())
    try:
        wait_for_subscriber(publisher)
        before, began = wakeups(), time.monotonic()
        for number in range(MESSAGES):
            publisher.publish(String(data=str(number)))
            time.sleep(PAUSE)
        print("woken", wakeups() - before, "in", round(time.monotonic() - began, 3))
    finally:
        listener.kill()
        listener.wait()


def wait_for_subscriber(publisher: Any) -> None:
    deadline = time.monotonic() + PATIENCE
    while not publisher.get_subscription_count():
        assert time.monotonic() < deadline, "no subscriber"
        time.sleep(0.01)
    time.sleep(1)  # both have found each other


def chosen_anew() -> dict[str, str]:
    """The environment for a process that chooses its profile: it would take this one's for the
    user's.
    """
    return {**os.environ, **dict.fromkeys(fastdds.VARIABLES, "")}


def wakeups() -> int:
    """How often a thread of Fast DDS for timers has waited for something to do."""
    total = 0
    for task in Path("/proc/self/task").iterdir():
        if (task / "comm").read_text().startswith("dds.ev"):
            lines = (task / "status").read_text().splitlines()
            total += int(next(line for line in lines if line.startswith("vol")).split()[1])
    return total


if __name__ == "__main__":
    main()
