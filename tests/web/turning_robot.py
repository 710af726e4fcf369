"""A robot that turns on its place before a wall: `python turning_robot.py`, until it is ended.

Its scanner is mounted ahead and looks to the left. The wall is 2 m ahead of where the map begins.
It tells where it is by TF alone: its odometry is in another frame than its map.
"""

from __future__ import annotations

import math
import signal

import rclpy
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import LaserScan

from appliance.ros.payload.converter import compile_converter
from appliance.ros.ros2.node import describe, load_message

# Where there is no more than the definition of a type, its messages are bytes.
TFMessage = load_message("tf2_msgs/msg/TFMessage")
TF = compile_converter(describe(TFMessage, load_message))

WALL = 2.0  # m, the x of the wall in the map
SPEED = 0.8  # rad/s
INTERVAL = 0.05  # s, between two transforms
ODOM_X, ODOM_YAW = 0.5, 1.0  # where the frame odom is in the map
MOUNTED_X, MOUNTED_YAW = 0.3, math.pi / 2  # where the scanner is on the robot
RAYS = 360


class Robot(Node):
    def __init__(self):
        super().__init__("turning")
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.tf = self.create_publisher(TFMessage, "/tf", 100)
        self.odom = self.create_publisher(Odometry, "/turning/odom", 10)
        self.scan = self.create_publisher(LaserScan, "/turning/scan", 10)
        self.map = self.create_publisher(OccupancyGrid, "/turning/map", latched)
        self.static = self.create_publisher(TFMessage, "/tf_static", latched)
        mounted = self.transform("base_link", "laser", MOUNTED_X, MOUNTED_YAW)
        placed = self.transform("map", "odom", ODOM_X, ODOM_YAW)
        self.static.publish(TF.from_dict({"transforms": [mounted, placed]}))
        self.map.publish(self.grid())
        self.turned = 0.0
        self.create_timer(INTERVAL, self.move)
        self.create_timer(0.2, self.look)

    def heading(self):
        """Of the robot, in the frame odom: a computer that stands still turns nothing meanwhile."""
        return self.turned

    def transform(self, parent, child, x, yaw):
        stamp = self.get_clock().now().to_msg()
        return {
            "header": {
                "frame_id": parent,
                "stamp": {"sec": stamp.sec, "nanosec": stamp.nanosec},
            },
            "child_frame_id": child,
            "transform": {
                "translation": {"x": x},
                "rotation": {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)},
            },
        }

    def grid(self):
        """6 m by 6 m around the beginning, with the wall in it."""
        found = OccupancyGrid()
        found.header.frame_id = "map"
        found.info.resolution, found.info.width, found.info.height = 0.1, 60, 60
        found.info.origin.position.x = found.info.origin.position.y = -3.0
        wall = round((WALL + 3) / 0.1)
        found.data = [100 if at % 60 == wall else 0 for at in range(3600)]
        return found

    def move(self):
        self.turned = (self.turned + SPEED * INTERVAL) % math.tau
        heading = self.heading()
        turned = self.transform("odom", "base_link", 0.0, heading)
        self.tf.publish(TF.from_dict({"transforms": [turned]}))
        found = Odometry(child_frame_id="base_link")
        found.header.frame_id = "odom"
        found.header.stamp = self.get_clock().now().to_msg()
        found.pose.pose.orientation.z = math.sin(heading / 2)
        found.pose.pose.orientation.w = math.cos(heading / 2)
        self.odom.publish(found)

    def look(self):
        """Measure the wall, up to 3 m away."""
        found = LaserScan(range_min=0.05, range_max=3.0, angle_increment=math.tau / RAYS)
        found.header.frame_id = "laser"
        found.header.stamp = self.get_clock().now().to_msg()
        heading = self.heading() + ODOM_YAW
        ahead = WALL - ODOM_X - MOUNTED_X * math.cos(heading)
        for ray in range(RAYS):
            across = math.cos(heading + MOUNTED_YAW + ray * math.tau / RAYS)
            found.ranges.append(ahead / across if across > 0.05 else math.inf)
        self.scan.publish(found)


def main():
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    rclpy.init(args=[])
    rclpy.spin(Robot())


if __name__ == "__main__":
    main()
