"""A small robot to try the bridge with: `python -m appliance.cli.demo_robot`.

It follows `/cmd_vel` and stops when no command has come for a second. It publishes `/odom`,
`/battery`, `/scan`, `/chatter`, while somebody subscribes `/camera/image_raw`, and, latched, `/map`
and `/robot_description`. Its odometry is exact, so that the map is in the frame `odom`. The service
`/reset` (std_srvs/srv/Trigger) puts it back to its start. Units as in REP 103: m, rad, s, V.
SIGTERM and SIGINT stop it.
"""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
from importlib import import_module
from pathlib import Path
from time import monotonic
from typing import Any

from appliance.ros.payload.definitions import import_message
from appliance.ros.ros2 import fastdds
from appliance.ros.ros2.node import available

COMMAND_TIMEOUT = 1.0  # seconds
ODOMETRY_RATE = 20.0  # Hz
SCAN_RATE = 5.0  # Hz
ROOM = 4.0  # m, the side of the square room that the laser scanner and the camera see
CAMERA_RATE = 5.0  # Hz
SCAN_POINTS = 360
FULL, EMPTY = 12.6, 10.0  # V
FULL_CHARGE_LASTS = 3600.0  # seconds

TWIST = "geometry_msgs/msg/Twist"
ODOMETRY = "nav_msgs/msg/Odometry"
BATTERY = "sensor_msgs/msg/BatteryState"
SCAN = "sensor_msgs/msg/LaserScan"
IMAGE = "sensor_msgs/msg/Image"
GRID = "nav_msgs/msg/OccupancyGrid"
STRING = "std_msgs/msg/String"
TYPES = (TWIST, ODOMETRY, BATTERY, SCAN, IMAGE, GRID, STRING)

DESCRIPTION = """<robot name="demo">
  <link name="base_link">
    <visual><geometry><cylinder radius="0.2" length="0.1"/></geometry></visual>
  </link>
</robot>
"""


class Drive:
    """Position of a robot with two wheels, `x` and `y` in m and `heading` in rad, and its speed."""

    def __init__(self) -> None:
        self.x = self.y = self.heading = 0.0
        self.linear = self.angular = 0.0
        self._commanded_at = -math.inf

    def command(self, linear: float, angular: float, now: float) -> None:
        """Drive at `linear` m/s and `angular` rad/s; a value that is not finite stops the robot."""
        finite = math.isfinite(linear) and math.isfinite(angular)
        self.linear, self.angular = (linear, angular) if finite else (0.0, 0.0)
        self._commanded_at = now

    def advance(self, seconds: float, now: float) -> None:
        """Advance the simulation; without a command for COMMAND_TIMEOUT the robot stops."""
        if now - self._commanded_at > COMMAND_TIMEOUT:
            self.linear = self.angular = 0.0
        middle = self.heading + self.angular * seconds / 2
        self.x += self.linear * math.cos(middle) * seconds
        self.y += self.linear * math.sin(middle) * seconds
        heading = self.heading + self.angular * seconds
        self.heading = math.atan2(math.sin(heading), math.cos(heading))

    def scan(self) -> list[float]:
        """The distances in m to the walls of the room, counter-clockwise from straight ahead.

        The room moves along when the robot leaves it, so that walls are always in sight.
        """
        half = ROOM / 2
        x = (self.x + half) % ROOM - half
        y = (self.y + half) % ROOM - half
        distances = []
        for point in range(SCAN_POINTS):
            angle = self.heading + 2 * math.pi * point / SCAN_POINTS
            cos, sin = math.cos(angle), math.sin(angle)
            to_x = (math.copysign(half, cos) - x) / cos if abs(cos) > 1e-9 else math.inf
            to_y = (math.copysign(half, sin) - y) / sin if abs(sin) > 1e-9 else math.inf
            distances.append(min(to_x, to_y))
        return distances


class DemoRobot:
    """The ROS node; all callbacks run on the executor's thread."""

    def __init__(self, node: Any) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data

        from appliance.cli import demo_scene

        # Imported by name, because these packages have no types for mypy.
        self._types = {name: import_message(name) for name in TYPES}
        twist, odometry, battery, scan, image, grid, string = self._types.values()
        self._scene = demo_scene
        self._node = node
        self._drive = Drive()
        self._started = monotonic()
        self._moved_at = self._started
        self._count = 0
        self._odometry = node.create_publisher(odometry, "/odom", 10)
        self._battery = node.create_publisher(battery, "/battery", 10)
        self._scan = node.create_publisher(scan, "/scan", qos_profile_sensor_data)
        self._chatter = node.create_publisher(string, "/chatter", 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._description = node.create_publisher(string, "/robot_description", latched)
        self._description.publish(string(data=DESCRIPTION))
        self._camera = node.create_publisher(image, "/camera/image_raw", qos_profile_sensor_data)
        self._map = node.create_publisher(grid, "/map", latched)
        self._publish_map()
        node.create_subscription(twist, "/cmd_vel", self._on_command, 10)
        trigger = import_module("std_srvs.srv").Trigger
        node.create_service(trigger, "/reset", self._on_reset)
        node.create_timer(1 / ODOMETRY_RATE, self._publish_odometry)
        node.create_timer(1 / SCAN_RATE, self._publish_scan)
        node.create_timer(1 / CAMERA_RATE, self._publish_picture)
        node.create_timer(1.0, self._publish_battery_and_chatter)

    def _on_command(self, twist: Any) -> None:
        self._drive.command(twist.linear.x, twist.angular.z, monotonic())

    def _on_reset(self, request: Any, response: Any) -> Any:
        response.success = True
        response.message = f"was {math.hypot(self._drive.x, self._drive.y):.1f} m from its start"
        self._drive = Drive()
        return response

    def _new(self, type_name: str, frame: str) -> Any:
        message: Any = self._types[type_name]()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = frame
        return message

    def _publish_odometry(self) -> None:
        now = monotonic()
        drive = self._drive
        drive.advance(now - self._moved_at, now)
        self._moved_at = now
        message = self._new(ODOMETRY, "odom")
        message.child_frame_id = "base_link"
        message.pose.pose.position.x = drive.x
        message.pose.pose.position.y = drive.y
        message.pose.pose.orientation.z = math.sin(drive.heading / 2)
        message.pose.pose.orientation.w = math.cos(drive.heading / 2)
        message.twist.twist.linear.x = drive.linear
        message.twist.twist.angular.z = drive.angular
        self._odometry.publish(message)

    def _publish_scan(self) -> None:
        message = self._new(SCAN, "base_link")
        message.angle_increment = 2 * math.pi / SCAN_POINTS
        message.angle_max = 2 * math.pi - message.angle_increment
        message.scan_time = 1 / SCAN_RATE
        message.range_min = 0.05
        message.range_max = 2 * ROOM
        message.ranges = self._drive.scan()
        self._scan.publish(message)

    def _publish_picture(self) -> None:
        if not self._camera.get_subscription_count():
            return
        scene, drive = self._scene, self._drive
        message = self._new(IMAGE, "camera")
        message.width, message.height = scene.WIDTH, scene.HEIGHT
        message.encoding, message.step = "rgb8", 3 * scene.WIDTH
        message.data = scene.picture(ROOM, drive.x, drive.y, drive.heading, monotonic())
        self._camera.publish(message)

    def _publish_map(self) -> None:
        message = self._new(GRID, "odom")
        info, cells = message.info, self._scene.map_cells(ROOM)
        info.resolution = self._scene.RESOLUTION
        info.width = info.height = math.isqrt(len(cells))
        info.origin.position.x = info.origin.position.y = self._scene.map_corner(ROOM)
        message.data = cells
        self._map.publish(message)

    def _publish_battery_and_chatter(self) -> None:
        message = self._new(BATTERY, "base_link")
        charge = 1 - (monotonic() - self._started) % FULL_CHARGE_LASTS / FULL_CHARGE_LASTS
        message.voltage = EMPTY + charge * (FULL - EMPTY)
        message.percentage = charge
        message.present = True
        message.power_supply_status = message.POWER_SUPPLY_STATUS_DISCHARGING
        # Values that are not measured are NaN, as the message definition requires.
        message.current = message.charge = message.capacity = math.nan
        message.design_capacity = message.temperature = math.nan
        self._battery.publish(message)
        self._count += 1
        self._chatter.publish(self._types[STRING](data=f"Hello World: {self._count}"))


def main() -> int:
    """Run the robot until SIGTERM or SIGINT; returns the exit code."""
    is_available, reason = available()
    if not is_available:
        sys.stderr.write(f"{Path(__file__).stem}: {reason}\n")
        return 1
    fastdds.use_profile(os.environ)
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from rclpy.signals import SignalHandlerOptions

    stopping = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopping.set())
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = Node("demo_robot")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    DemoRobot(node)
    while not stopping.is_set():
        executor.spin_once(timeout_sec=0.2)
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
