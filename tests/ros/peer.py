"""Another node on the bus, in a process of its own: `python peer.py NAME`, driven through stdin.

A line is a JSON list: a method of Peer and its arguments. A line on stdout is a JSON list too:
`["ok"]` for each command, and `["received", topic, hex]` for each message, of which the bytes are
given as they are up to 10000, else as their number.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from importlib import import_module

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import SetBool


def load(type_name):
    package, _, name = type_name.split("/")
    try:
        return getattr(import_module(f"{package}.msg"), name)
    except ImportError:  # there is no more than its definition
        return import_module("appliance.ros.ros2.node").load_message(type_name)


def profile(reliability, durability):
    return QoSProfile(
        depth=100,
        reliability=ReliabilityPolicy[reliability.upper()],
        durability=DurabilityPolicy[durability.upper()],
    )


def say(*line):
    # Two threads come here, and sys.stdout is not made for that.
    os.write(1, json.dumps(line).encode() + b"\n")


class Peer:
    def __init__(self, node):
        self.node = node
        self.publishers = {}

    def advertise(self, topic, type_name, reliability="reliable", durability="volatile"):
        qos = profile(reliability, durability)
        self.publishers[topic] = self.node.create_publisher(load(type_name), topic, qos)

    def vanish(self, topic):
        self.node.destroy_publisher(self.publishers.pop(topic))

    def matched(self, topic, count=1):
        """Wait until the publisher has its subscribers."""
        deadline = time.monotonic() + 60
        while self.publishers[topic].get_subscription_count() < count:
            if time.monotonic() > deadline:
                raise TimeoutError(f"nobody subscribes to {topic}")
            time.sleep(0.01)

    def publish(self, topic, cdr, count=1, rate=100):
        for _ in range(count):
            self.publishers[topic].publish(bytes.fromhex(cdr))
            if count > 1:
                time.sleep(1 / rate)

    def publish_image(self, topic, size, count, rate):
        message = load("std_msgs/msg/UInt8MultiArray")(data=b"x" * size)
        for _ in range(count):
            self.publishers[topic].publish(message)
            time.sleep(1 / rate)

    def publish_times(self, topic, count, rate):
        """Vectors with the time in their last field."""
        begun = time.monotonic()
        for number in range(count):
            self.publishers[topic].publish(load("geometry_msgs/msg/Vector3")(z=time.time()))
            time.sleep(max(0, begun + number / rate - time.monotonic()))

    def subscribe(self, topic, type_name, reliability="reliable", durability="volatile"):
        def received(cdr):
            say("received", topic, cdr.hex() if len(cdr) <= 10_000 else len(cdr))

        qos = profile(reliability, durability)
        self.node.create_subscription(load(type_name), topic, received, qos, raw=True)

    def gather(self, service, count):
        """Offer a std_srvs/srv/SetBool that answers when so many have asked, and all at once."""
        asked = []

        def answer(response, header):
            asked.append((response, header))
            if len(asked) == count:
                time.sleep(0.1)  # whoever has asked waits by now
                for response, header in asked:
                    send(response, header)

        own = self.node.create_service(
            SetBool, service, self._echo, qos_profile=QoSProfile(depth=count)
        )
        send, own.send_response = own.send_response, answer

    def _echo(self, request, response):
        response.success = request.data
        return response

    def ask(self, service, count):
        """Call a std_srvs/srv/SetBool so often in one go; each answer is told as received."""
        client = self.node.create_client(SetBool, service, qos_profile=QoSProfile(depth=count))
        if not client.wait_for_service(60):
            raise TimeoutError(f"there is no {service}")
        for _ in range(count):
            future = client.call_async(SetBool.Request())
            future.add_done_callback(lambda done: say("received", service, done.result().message))


def main():
    rclpy.init(args=[])
    node = Node(sys.argv[1])
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    peer = Peer(node)
    say("ok")
    try:
        for line in sys.stdin:
            name, *args = json.loads(line)
            getattr(peer, name)(*args)
            say("ok")
    finally:
        executor.shutdown()
        thread.join()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
