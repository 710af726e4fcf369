"""A small robot to be driven through the appliance: `python robot.py`, until its input ends.

| what | type | |
|---|---|---|
| `/turtle/reset` | std_srvs/srv/Trigger | back to the start; refused while it walks |
| `/turtle/pen` | std_srvs/srv/SetBool | |
| `/turtle/think` | std_srvs/srv/Trigger | never answers |
| `/turtle/ask_human` | std_srvs/srv/SetBool | is called by the robot, when it is told to `ask` |
| `/turtle/walk` | test_msgs/action/Fibonacci | `order` steps with feedback, see `Turtle.on_walk` |
| `/turtle` | parameters | see `Turtle` |
| `/cmd_vel` | geometry_msgs/msg/Twist | what it was told last is in the answer of reset |

A line on its input is a JSON list: a method of Turtle and its arguments. One on its output is a
list, too: `["ok", what it returned]`, `["asked", service]`, `["walked", steps, of so many]`.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import Twist
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool, Trigger
from test_msgs.action import Fibonacci

STEP = 0.05  # seconds
MOST_STEPS = 5000
UNSTOPPABLE, DOOMED = 113, 99


def say(*line):
    os.write(1, json.dumps(line).encode() + b"\n")


class Turtle:
    def __init__(self, node):
        self.node = node
        self.walking = 0
        self.velocity = None
        self.group = ReentrantCallbackGroup()
        self._declare()
        node.create_subscription(Twist, "/cmd_vel", self.on_velocity, 10)
        self.services = {}
        for name, kind, callback in (
            ("reset", Trigger, self.on_reset),
            ("pen", SetBool, self.on_pen),
        ):
            node.create_service(kind, f"/turtle/{name}", callback, callback_group=self.group)
        self.offer("think")
        self.action = ActionServer(
            self.node,
            Fibonacci,
            "/turtle/walk",
            self.on_walk,
            goal_callback=self.on_goal,
            cancel_callback=self.on_cancel,
            callback_group=self.group,
        )

    def _declare(self):
        for name, value, about in (
            (
                "speed",
                0.5,
                {"floating_point_range": [FloatingPointRange(from_value=0.0, to_value=2.0)]},
            ),
            ("steps", 10, {"integer_range": [IntegerRange(from_value=1, to_value=100, step=1)]}),
            ("mode", "calm", {}),
            ("serial", "T-800", {"read_only": True}),
            ("gains", [1.0, 0.5], {}),
        ):
            self.node.declare_parameter(name, value, ParameterDescriptor(**about))
        self.node.add_on_set_parameters_callback(self.on_parameters)

    def on_parameters(self, parameters):
        for parameter in parameters:
            if parameter.name == "mode" and parameter.value not in ("calm", "wild"):
                reason = f"there is no mode {parameter.value}"
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def on_velocity(self, message):
        self.velocity = message.linear.x

    def on_reset(self, request, response):
        response.success = not self.walking
        response.message = f"cmd_vel {self.velocity}" if response.success else "it walks"
        return response

    def on_pen(self, request, response):
        response.success = True
        response.message = "down" if request.data else "up"
        return response

    def on_goal(self, goal):
        fits = 0 <= goal.order <= MOST_STEPS
        return GoalResponse.ACCEPT if fits else GoalResponse.REJECT

    def on_cancel(self, goal):
        stays = goal.request.order == UNSTOPPABLE
        return CancelResponse.REJECT if stays else CancelResponse.ACCEPT

    def on_walk(self, goal):
        """0 to 5000 steps, others are refused; 113 cannot be cancelled, 99 is aborted after two."""
        self.walking += 1
        done = 0
        try:
            sequence = [0, 1]
            for done in range(1, goal.request.order + 1):
                time.sleep(STEP)
                if goal.is_cancel_requested:
                    goal.canceled()
                    break
                sequence.append((sequence[-1] + sequence[-2]) % 2**31)
                goal.publish_feedback(Fibonacci.Feedback(sequence=sequence[-3:]))
                if goal.request.order == DOOMED and done == 2:
                    goal.abort()
                    break
            else:
                goal.succeed()
            return Fibonacci.Result(sequence=sequence)
        finally:
            self.walking -= 1
            say("walked", done, goal.request.order)

    # What it is told

    def set(self, name, value):
        """Change a parameter of its own, as a node does; null takes its value away."""
        self.node.set_parameters([Parameter(name, value=value)])

    def followed(self):
        """Wait until somebody subscribes to the feedback of goals."""
        deadline = time.monotonic() + 60
        while not self.node.count_subscribers("/turtle/walk/_action/feedback"):
            if time.monotonic() > deadline:
                raise TimeoutError("nobody subscribes to the feedback")
            time.sleep(0.01)

    def declare(self, name, value):
        self.node.declare_parameter(name, value, ParameterDescriptor(dynamic_typing=True))

    def offer(self, name):
        """Offer /turtle/NAME, which never answers."""

        async def on_request(request, response):
            say("asked", name)
            await rclpy.task.Future()

        self.services[name] = self.node.create_service(
            Trigger, f"/turtle/{name}", on_request, callback_group=self.group
        )

    def vanish(self, name):
        """End the service /turtle/NAME, with what it has not answered."""
        self.node.destroy_service(self.services.pop(name))

    def end_walks(self):
        """There is no such action any more, whoever walks."""
        self.action.destroy()

    def ask(self, data):
        """Call /turtle/ask_human, and wait for it."""
        client = self.node.create_client(SetBool, "/turtle/ask_human", callback_group=self.group)
        try:
            if not client.wait_for_service(60):
                return "there is no such service"
            future = client.call_async(SetBool.Request(data=data))
            done = threading.Event()
            future.add_done_callback(lambda _: done.set())
            if not done.wait(60):
                client.remove_pending_request(future)
                return "no answer"
            return [future.result().success, future.result().message]
        finally:
            self.node.destroy_client(client)


def main():
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = Node("turtle")
    turtle = Turtle(node)
    executor = MultiThreadedExecutor(8)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    say("ok", "ready")
    for line in sys.stdin:
        name, *args = json.loads(line)
        say("ok", getattr(turtle, name)(*args))
    os._exit(0)  # walks that are under way are not waited for


if __name__ == "__main__":
    main()
