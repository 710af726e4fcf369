"""The robot that the pages' examples command: `python page_robot.py`, until its input ends.

It has what the commands of README and docs/ name: the topic `/odom`, the services `/reset` and
`/arm/grip`, the action `/navigate_to_pose` and the node `/controller` with its parameter
`max_speed`. The action is a Fibonacci, as the packages of ROS on PyPI have none of navigation.
"""

from __future__ import annotations

import os
import sys
import threading

import rclpy
from nav_msgs.msg import Odometry
from rclpy.action import ActionServer
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool, Trigger
from test_msgs.action import Fibonacci


def on_reset(request, response):
    response.success = True
    return response


def on_grip(request, response):
    response.success = request.data
    response.message = "closed" if request.data else "open"
    return response


def on_goal(goal):
    goal.publish_feedback(Fibonacci.Feedback(sequence=[0, 1]))
    goal.succeed()
    return Fibonacci.Result(sequence=[0, 1, 1])


def main():
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = Node("controller")
    node.declare_parameter("max_speed", 0.5)
    node.create_service(Trigger, "/reset", on_reset)
    node.create_service(SetBool, "/arm/grip", on_grip)
    action = ActionServer(node, Fibonacci, "/navigate_to_pose", on_goal)
    odometry = node.create_publisher(Odometry, "/odom", 10)
    node.create_timer(0.1, lambda: odometry.publish(Odometry()))
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    os.write(1, b'["ok", "ready"]\n')
    sys.stdin.read()
    del action
    os._exit(0)


if __name__ == "__main__":
    main()
