"""A bridge with a route that has command rules, and clients that drive."""

from __future__ import annotations

import asyncio
import math
import struct
import time
from unittest import mock

from bridge_harness import TWIST, Harness

from appliance.broker.client import ClientHandler as NetworkClient
from appliance.broker.link import PeerStatus
from appliance.broker.values import Decision
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import (
    Connect,
    Disconnect,
    Publish,
)
from appliance.ros.bridge import TopicSettings
from appliance.ros.payload.definitions import import_message

FLOAT = "std_msgs/msg/Float32"
TOPIC = "r2d2/cmd_vel"
GO = b'{"linear":{"x":0.5}}'
AFTER = 0.1


def twist(x=0.0, z=0.0):
    return b"\0\1\0\0" + struct.pack("<6d", x, 0, 0, 0, 0, z)


STOP = twist()


class AllAllowed:
    epoch = 0

    def decide(self, identity, action, topic):
        return Decision(True, "everything is")


class All(dict):
    """All types that are installed."""

    def __contains__(self, name):
        return True

    def __getitem__(self, name):
        return import_message(name)


class Wire:
    """A network client's connection; what is written to it can be read as packets."""

    address = "192.0.2.1:4000"

    def __init__(self):
        self.written = b""
        self.closed = False
        self.connection = PeerStatus(silence=math.inf)
        self.probed = False
        self.withheld = []
        self.asks_for_turn = False

    def authenticate(self, connect):
        pass

    def now(self):
        return time.monotonic()

    def holds(self, size):
        """Of a packet that is not whole."""

    def admit(self, account):
        return ""

    def later(self):
        self.asks_for_turn = True

    def peer_status(self):
        return self.connection

    def probe(self):
        self.probed = True

    def withhold(self, seconds):
        self.withheld.append(seconds)

    def write(self, chunks):
        self.written += b"".join(chunks)

    def close(self):
        self.closed = True

    abort = close


def moment():
    """The loop's time, the same until it goes on: a pause of the test is none of its clients'."""
    loop = asyncio.get_running_loop()
    if not hasattr(loop, "moment_of_test"):
        loop.moment_of_test = loop.time()
        loop.call_soon(delattr, loop, "moment_of_test")
    return loop.moment_of_test


class Driver:
    """A client with a connection, as the network's clients have it."""

    def __init__(self, broker, name, version=5, clean=True, expiry=0, will=None):
        self.broker = broker
        self.version = version
        self.wire = Wire()
        self.client = NetworkClient(broker, self.wire)
        properties = {Property.SESSION_EXPIRY_INTERVAL: expiry} if expiry else None
        self.say(
            Connect(name, clean_start=clean, will=will, properties=properties, version=version)
        )
        self.client.accept("user")
        broker.flush()
        self.wire.written = b""

    def say(self, *packets, at=None):
        """Have these received, now or at another time of the loop's clock."""
        # As a connection does it, once for all that it has received.
        self.broker.accounting.now = moment() if at is None else at
        self.client.receive(b"".join(packet.encode(self.version) for packet in packets))
        while self.wire.asks_for_turn:  # a conversion has taken its turn, on a busy computer
            self.wire.asks_for_turn = False
            self.client.send_on()
        self.broker.flush()

    def drive(self, payload=GO, qos=0, **kw):
        self.say(Publish(TOPIC, payload, qos=qos, packet_id=7 if qos else None, **kw))

    def steer(self, payload=GO, qos=0, properties=None, **kw):
        """Say when it was made, so that it is known to be new."""
        now = time.time()
        said = {**(properties or {}), Property.USER_PROPERTY: [("sent-at", str(now))]}
        with mock.patch("time.time", return_value=now):  # a pause of the test is none of its own
            self.drive(payload, qos, properties=said, **kw)

    def leave(self):
        self.say(Disconnect())

    def cut(self):
        self.client.lost()
        self.broker.flush()

    @property
    def code(self):
        """The reason code of the PUBACK that came last."""
        assert self.wire.written[0] == 0x40
        return self.wire.written[4] if self.wire.written[1] > 2 else 0


class CommandHarness(Harness):
    def start(self, rules, **kw):
        settings = TopicSettings(
            "/cmd_vel",
            "ros",
            "r2d2{ros}",
            kw.pop("type", TWIST),
            compression=kw.pop("compression", "none"),
            rules=rules,
        )
        bridge = super().start(settings)
        self.robot = self.node.add_subscriber("/cmd_vel", kw.pop("found", TWIST))
        return bridge

    def counters(self):
        return self.status("to_ros")

    @property
    def commands(self):
        (flow,) = self.bridge._to_ros.values()
        return flow
