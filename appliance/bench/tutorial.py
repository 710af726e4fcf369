"""The classic tutorial node: rclpy and paho-mqtt, copying `std_msgs/String` both ways.

It is what a user would write without an appliance, in the way of tutorials: the default executor,
typed messages, one callback a direction. The benchmark runs it beside mosquitto.
"""

from __future__ import annotations

import os
import sys
from typing import Any

import paho.mqtt.client as mqtt
import rclpy
from paho.mqtt.enums import CallbackAPIVersion
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import String  # type: ignore[import-untyped, unused-ignore]

ROS_TO_MQTT = ("chatter", "bench/chatter")
MQTT_TO_ROS = ("bench/command", "command")


class Tutorial:
    """The node, its MQTT client, and the two callbacks that copy."""

    def __init__(self, port: int, username: str, password: str, queue: int) -> None:
        self.node = rclpy.create_node("mqtt_bridge")
        self.publisher = self.node.create_publisher(String, MQTT_TO_ROS[1], queue)
        self.node.create_subscription(String, ROS_TO_MQTT[0], self.on_ros, queue)
        self.client = mqtt.Client(CallbackAPIVersion.VERSION2)
        self.client.username_pw_set(username, password)
        self.client.on_connect = self.on_connect
        self.client.on_message = self.on_mqtt
        self.client.connect("127.0.0.1", port)
        self.client.loop_start()

    def on_connect(self, client: mqtt.Client, *_: Any) -> None:
        """Subscribe again at every connection."""
        client.subscribe(MQTT_TO_ROS[0])

    def on_ros(self, message: Any) -> None:
        """Copy to MQTT."""
        self.client.publish(ROS_TO_MQTT[1], message.data)

    def on_mqtt(self, _client: mqtt.Client, _userdata: object, message: mqtt.MQTTMessage) -> None:
        """Copy to ROS."""
        self.publisher.publish(String(data=message.payload.decode()))


def main() -> None:
    """Run until a signal comes: `python -m appliance.bench.tutorial PORT USER VARIABLE DEPTH`."""
    port, username, variable, queue = sys.argv[1:]
    rclpy.init()
    tutorial = Tutorial(int(port), username, os.environ[variable], int(queue))
    try:
        rclpy.spin(tutorial.node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        tutorial.client.loop_stop()
        tutorial.node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
