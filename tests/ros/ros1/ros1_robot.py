"""A node of ROS 1, driven through its input: `python ros1_robot.py`, in the system's Python.

| what | type | |
|---|---|---|
| `/robot/switch` | std_srvs/SetBool | says the contrary |
| `/robot/sleep` | std_srvs/Trigger | never answers |
| `/robot/greet` | std_srvs/Trigger | |
| `/elsewhere/greet` | std_srvs/Trigger | which the bridge calls `/greet` |
| `/robot/rest` | std_srvs/Empty | |
| `/robot/fail` | std_srvs/SetBool | fails |
| `/robot/map` | std_msgs/String | latched |
| `/robot/own` | own_msgs/Own | a type that is installed nowhere |
| `/robot/work` | actionlib/TestAction | so many steps; -1 fails |

A line on its input is a JSON list: a method of Robot and its arguments; `["ok", what it returned]`
is the answer.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from importlib import import_module
from io import BytesIO

import actionlib
import genpy.dynamic
import rospy
from actionlib.msg import TestAction, TestFeedback, TestResult
from std_msgs.msg import String
from std_srvs.srv import Empty, SetBool, SetBoolResponse, Trigger

STEP = 0.05
OWN = "string name\nuint8[] data\nown_msgs/Part[] parts\n" + "=" * 80 + "\n"
OWN += "MSG: own_msgs/Part\nint8 A=1 # a constant\ntime at\nfloat32[2] pair\n"


def say(*line):
    os.write(1, json.dumps(line).encode() + b"\n")


class Robot:
    def __init__(self):
        self.received = {}
        self.publishers = {}
        rospy.Service("/robot/switch", SetBool, lambda asked: SetBoolResponse(not asked.data, "so"))
        rospy.Service("/robot/greet", Trigger, lambda asked: (True, "hello"))
        rospy.Service("/elsewhere/greet", Trigger, lambda asked: (True, "hello, whoever"))
        rospy.Service("/robot/rest", Empty, lambda asked: ())
        rospy.Service("/robot/fail", SetBool, lambda asked: None)
        rospy.Service("/robot/sleep", Trigger, lambda asked: threading.Event().wait())
        self.map = rospy.Publisher("/robot/map", String, latch=True, queue_size=1)
        self.map.publish("a map")
        own = genpy.dynamic.generate_dynamic("own_msgs/Own", OWN)
        self.own = rospy.Publisher("/robot/own", own["own_msgs/Own"], latch=True, queue_size=1)
        part = own["own_msgs/Part"](rospy.Time(1, 2), [0.5, 1.5])
        self.own.publish("mine", b"\1\2", [part])
        self.server = actionlib.SimpleActionServer(
            "/robot/work", TestAction, self.work, auto_start=False
        )
        self.server.start()

    def work(self, goal):
        for step in range(goal.goal):
            if self.server.is_preempt_requested():
                self.server.set_preempted(TestResult(step))
                return
            self.server.publish_feedback(TestFeedback(step))
            time.sleep(STEP)
        if goal.goal < 0:
            self.server.set_aborted(TestResult(goal.goal))
        else:
            self.server.set_succeeded(TestResult(goal.goal))

    def hear(self, topic, type_name):
        """Keep what comes on a topic."""
        package, _, name = type_name.partition("/")
        kind = getattr(import_module(f"{package}.msg"), name)
        self.received[topic] = []
        rospy.Subscriber(topic, kind, self.received[topic].append)

    def heard(self, topic):
        """What has come, as YAML."""
        return [str(message) for message in self.received[topic]]

    def publish(self, topic, type_name, *values):
        """Publish once somebody is connected."""
        package, _, name = type_name.partition("/")
        kind = getattr(import_module(f"{package}.msg"), name)
        if topic not in self.publishers:
            self.publishers[topic] = rospy.Publisher(topic, kind, queue_size=5000)
        self.connected(topic)
        self.publishers[topic].publish(*values)

    def connected(self, topic):
        deadline = time.monotonic() + 60
        while not self.publishers[topic].get_num_connections():
            if time.monotonic() > deadline:
                raise TimeoutError(f"nobody subscribes to {topic}")
            time.sleep(0.01)

    def burst(self, topic, count):
        """Publish many strings as fast as it goes."""
        for number in range(count):
            self.publishers[topic].publish(str(number))

    def ask(self, service, value):
        """Call a SetBool."""
        rospy.wait_for_service(service, 60)
        answer = rospy.ServiceProxy(service, SetBool)(value)
        return [answer.success, answer.message]

    def bytes(self, topic, type_name, text):
        """The bytes of a std_msgs/String."""
        buffer = BytesIO()
        String(text).serialize(buffer)
        return buffer.getvalue().hex()


if __name__ == "__main__":
    rospy.init_node("robot", disable_signals=True)
    robot = Robot()
    say("ok", "ready")
    for line in sys.stdin:
        method, *arguments = json.loads(line)
        try:
            say("ok", getattr(robot, method)(*arguments))
        except Exception as error:
            say("error", f"{type(error).__name__}: {error}")
    os._exit(0)
