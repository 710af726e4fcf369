"""Publishes a message that is lost, and none behind it; prints after how many seconds it comes.

It runs in a network namespace of its own, whose loopback is off for a moment.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from typing import Any

from publish_fast import chosen_anew, wait_for_subscriber

from appliance.ros.ros2 import fastdds

TIMES = 3


def main() -> None:
    fastdds.use_profile(os.environ)
    import rclpy
    from std_msgs.msg import String

    rclpy.init()
    node = rclpy.create_node("publisher" if sys.argv[1:] else "subscriber")
    if not sys.argv[1:]:
        node.create_subscription(String, "/stop", came, 10)
        rclpy.spin(node)
        return
    publisher = node.create_publisher(String, "/stop", 10)
    listener = subprocess.Popen(
        [sys.executable, __file__], env=chosen_anew(), stdout=subprocess.PIPE
    )
    assert listener.stdout is not None
    try:
        wait_for_subscriber(publisher)
        for _ in range(TIMES):
            set_loopback("down")
            publisher.publish(String(data=str(time.time())))
            time.sleep(0.01)
            set_loopback("up")
            print("came after", listener.stdout.readline().decode().strip(), flush=True)
    finally:
        listener.kill()
        listener.wait()


def came(message: Any) -> None:
    print(round(time.time() - float(message.data), 3), flush=True)


def set_loopback(state: str) -> None:
    subprocess.run(["ip", "link", "set", "lo", state], check=True)


if __name__ == "__main__":
    main()
