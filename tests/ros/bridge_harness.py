"""A FakeNode, the real broker and a bridge between them, and clients inside the process."""

from __future__ import annotations

import asyncio
import json
import struct

from appliance.broker.broker import Broker
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.mqtt.packets import Subscription
from appliance.ros.bridge import Bridge, TopicSettings
from appliance.ros.node import Durability, FakeNode, QosProfile, Reliability
from appliance.ros.payload.definitions import import_message
from appliance.store import MemoryStore

STRING, TWIST = "std_msgs/msg/String", "geometry_msgs/msg/Twist"
VECTOR, INT = "geometry_msgs/msg/Vector3", "std_msgs/msg/Int32"
BEST_EFFORT = QosProfile(Reliability.BEST_EFFORT)
LATCHED = QosProfile(durability=Durability.TRANSIENT_LOCAL, depth=1)


def string(text):
    """A serialized std_msgs/msg/String."""
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<I", len(data)) + data


class Rules:
    epoch = 0


class Client(InsideLink):
    """A session inside the appliance that keeps what it receives."""

    def __init__(self, broker, name="client"):
        self.broker = broker
        self.received = []
        self.session = broker.attach(name, self)

    def subscribe(self, topic, qos=1):
        self.broker.subscribe(self.session, Subscription(topic, qos))
        self.broker.send_retained(self.session, Subscription(topic, qos), True)

    def send(self, topic, payload, qos=0, retain=False):
        self.broker.publish(Message(topic, payload, qos, retain), self.session)

    def publish(self, message, qos, packet_id, dup, retain, subscription_ids):
        self.received.append((message, qos))
        if qos:
            self.session.puback(packet_id)

    def pubrel(self, packet_id):
        raise AssertionError

    def close(self, reason, message):
        raise AssertionError

    def payloads(self, topic):
        return [m.payload for m, _ in self.received if m.topic == topic]


class Harness:
    """Node, broker, bridge and a client that subscribes to all of the robot's."""

    def __init__(self):
        types = {name: import_message(name) for name in (STRING, TWIST, VECTOR, INT)}
        self.node = FakeNode(types=types)
        self.broker = Broker(Rules(), MemoryStore())
        self.client = Client(self.broker)
        self.client.subscribe("r2d2/#")

    def start(self, *routes):
        loop = asyncio.get_running_loop()
        self.bridge = Bridge(self.node, self.broker, routes, loop, "r2d2")
        self.bridge.start()
        return self.bridge

    async def settle(self):
        """Let everything that has been handed to the loop happen."""
        for _ in range(5):
            await asyncio.sleep(0)

    def routes(self):
        return json.loads(self.broker.retained.get("r2d2/_appliance/routes").payload)

    def status(self, direction="to_mqtt"):
        (status,) = [s for s in self.bridge.status() if s.direction == direction]
        return status


def to_mqtt(ros, **kw):
    return TopicSettings(ros, "mqtt", kw.pop("mqtt", "r2d2{ros}"), **kw)


def to_ros(ros, **kw):
    return TopicSettings(ros, "ros", kw.pop("mqtt", "r2d2{ros}"), **kw)


def both(ros, **kw):
    return TopicSettings(ros, "both", kw.pop("mqtt", "r2d2{ros}"), **kw)
