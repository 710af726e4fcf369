"""A node of ROS 2: publishes strings on /chatter and prints those that it hears on /hear."""

import rclpy
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("strings")
publisher = node.create_publisher(String, "/chatter", 1)
node.create_subscription(String, "/hear", lambda message: print(message.data, flush=True), 1)
node.create_timer(0.2, lambda: publisher.publish(String(data="from the robot")))
rclpy.spin(node)
