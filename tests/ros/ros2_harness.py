"""A bridge on a real ROS 2 node, and a peer node in another process."""

from __future__ import annotations

import asyncio
import json
import select
import struct
import sys
from pathlib import Path

from waiting import PATIENCE

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.host.environment import for_other_programs
from appliance.mqtt.packets import Subscription
from appliance.ros.bridge import Bridge, TopicSettings
from appliance.ros.ros2 import node as ros2
from appliance.store import MemoryStore

STRING, TWIST = "std_msgs/msg/String", "geometry_msgs/msg/Twist"
BYTES = "std_msgs/msg/UInt8MultiArray"
TF = "tf2_msgs/msg/TFMessage"
SET_BOOL = "std_srvs/srv/SetBool"


def string(text):
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<I", len(data)) + data


class Peer:
    """A node in another process (peer.py), and what it has received."""

    def __init__(self):
        self.received = []

    async def start(self, name="peer", **environment):
        self.process = await asyncio.create_subprocess_exec(
            sys.executable,
            str(Path(__file__).parent / "peer.py"),
            name,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            env=for_other_programs() | environment,
        )
        self._answers = asyncio.Queue()
        self._reader = asyncio.create_task(self._read())
        await self._answer()
        return self

    async def _read(self):
        async for line in self.process.stdout:
            kind, *rest = json.loads(line)
            if kind == "received":
                self.received.append(tuple(rest))
            else:
                self._answers.put_nowait(kind)
        self._answers.put_nowait("ended")

    async def _answer(self):
        assert await asyncio.wait_for(self._answers.get(), PATIENCE) == "ok"

    async def do(self, *command):
        self.process.stdin.write(json.dumps(command).encode() + b"\n")
        await self._answer()

    async def do_beside_a_busy_loop(self, *command):
        """`do`, while the event loop has other things to do from its begin to its end."""
        doing = asyncio.create_task(self.do(*command))
        await asyncio.sleep(0)  # now it is told
        pipe = self.process._transport.get_pipe_transport(1).get_extra_info("pipe")
        assert select.select([pipe], [], [], PATIENCE)[0], f"no answer to {command[0]}"
        await doing

    async def stop(self):
        self.process.stdin.close()
        try:
            await asyncio.wait_for(self.process.wait(), 10)
        except asyncio.TimeoutError:
            self.process.kill()
            await self.process.wait()
        await self._reader


class Harness:
    """Broker, bridge and an MQTT client, as in bridge_harness.py, on a real node."""

    writable = True
    epoch = 0

    def __init__(self):
        self.node = ros2.Ros2Node()
        self.broker = Broker(self, MemoryStore())
        self.received = []
        self.session = self.broker.attach("client", self)
        self.broker.subscribe(self.session, Subscription("r2d2/#", 1))

    def start(self, *routes):
        self.bridge = Bridge(self.node, self.broker, routes, asyncio.get_running_loop(), "r2d2")
        self.bridge.start()

    def publish(self, message, qos, packet_id, dup, retain, subscription_ids):
        self.received.append((message, qos))
        if qos:
            self.session.puback(packet_id)

    def send(self, topic, payload):
        self.broker.publish(Message(topic, payload), self.session)

    def payloads(self, topic):
        return [message.payload for message, _ in self.received if message.topic == topic]

    def bridged(self):
        return [topic for status in self.bridge.status() for topic in status.topics]


def route(ros, to, encoding="json", **kw):
    return TopicSettings(ros, to, "r2d2" + ros, encoding=encoding, **kw)
