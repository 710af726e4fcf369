"""Topics that come, change and go in random order, and whether the bridge's routes follow.

    python tests/ros/churn.py --minutes 5

A real appliance with a route of a pattern each way, and here a ROS node and an MQTT client. A topic
appears, or its publishers are replaced by others of another QoS or another type, or it vanishes.
Each time it is measured how long it takes until the routes topic says so and, of topics to MQTT, a
message arrives as it should. Prints one line of JSON a minute, and one with the result at the end.
Exits with 1 when a route did not follow.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import ssl
import statistics
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import paho.mqtt.client as paho
import psutil
import yaml

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from ros_domain import DOMAIN

    os.environ.setdefault("ROS_DOMAIN_ID", DOMAIN)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

import rclpy
from appliance_process import HOST, ROBOT, ApplianceProcess
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Bool, Float64, Int32, String

TYPES = {f"std_msgs/msg/{kind.__name__}": kind for kind in (String, Int32, Float64, Bool)}

#: Reliability, durability, and the MQTT QoS that they become.
QOS = (
    ("RELIABLE", "VOLATILE", 1),
    ("RELIABLE", "TRANSIENT_LOCAL", 1),
    ("BEST_EFFORT", "VOLATILE", 0),
)

#: Seconds after which a route counts as one that did not follow.
LOST = 30.0

PUBLISH_INTERVAL = 0.05


@dataclass(eq=False)
class Slot:
    """A topic that comes and goes, and what was last done to it."""

    ros: str
    to_mqtt: bool
    type: str | None = None
    qos: int = 0
    ends: list[Any] = field(default_factory=list)
    what: str = ""
    #: When something was done that the routes have not followed yet.
    since: float | None = None
    published_at: float = 0.0


class Churn:
    """The node, the client, and what is waited for."""

    def __init__(self, node: Node, client: paho.Client, topics: int, seed: int) -> None:
        self.node = node
        self.client = client
        self.dice = random.Random(seed)
        self.slots = [
            Slot(f"/churn/{'out' if number % 5 else 'in'}/t{number}", bool(number % 5))
            for number in range(topics)
        ]
        self.took: dict[str, list[float]] = {}
        self.lost: list[str] = []
        self._lock = threading.Lock()
        #: What the routes topic said last, by ROS topic: type.
        self._routes: dict[str, str] = {}
        #: QoS of the last message of each topic that came since something was done to it.
        self._arrived: dict[str, int] = {}
        client.on_message = self._on_message

    def _on_message(self, _client: Any, _userdata: Any, message: paho.MQTTMessage) -> None:
        with self._lock:
            if message.topic.endswith("/_appliance/routes"):
                self._routes = {row["ros"]: row["type"] for row in json.loads(message.payload)}
            elif not message.retain:
                self._arrived[message.topic.removeprefix(ROBOT)] = message.qos

    # What is done to topics

    def disturb(self) -> None:
        """Do something to one of the topics that the routes have followed."""
        slot = self.dice.choice(self.slots)
        if slot.since is not None:
            return
        if slot.type is None:
            self._change(slot, "appear")
        else:
            self._change(slot, self.dice.choice(("vanish", "vanish", "qos", "qos", "type")))

    def clear(self) -> None:
        """Let all topics vanish."""
        for slot in self.slots:
            if slot.type is not None:
                self._change(slot, "vanish")

    def _change(self, slot: Slot, what: str) -> None:
        dice = self.dice
        for end in slot.ends:
            destroy = (
                self.node.destroy_publisher if slot.to_mqtt else self.node.destroy_subscription
            )
            destroy(end)
        slot.ends.clear()
        others = [name for name in TYPES if name != slot.type]
        slot.type = {
            "appear": dice.choice(others),
            "type": dice.choice(others),
            "vanish": None,
        }.get(what, slot.type)
        if slot.type is not None:
            choices = [qos for qos in QOS if what != "qos" or qos[2] != slot.qos]
            reliability, durability, slot.qos = dice.choice(choices)
            profile = QoSProfile(
                depth=10,
                reliability=ReliabilityPolicy[reliability],
                durability=DurabilityPolicy[durability],
            )
            for _ in range(dice.choice((1, 1, 2))):
                kind = TYPES[slot.type]
                slot.ends.append(
                    self.node.create_publisher(kind, slot.ros, profile)
                    if slot.to_mqtt
                    else self.node.create_subscription(kind, slot.ros, lambda _: None, profile)
                )
        with self._lock:
            self._arrived.pop(slot.ros, None)
        slot.what = what
        slot.since = time.monotonic()

    # Whether the routes follow

    def watch(self) -> bool:
        """Note which routes have followed; True when all have."""
        now = time.monotonic()
        waiting = [slot for slot in self.slots if slot.since is not None]
        for slot in waiting:
            assert slot.since is not None
            if slot.to_mqtt and slot.ends and now - slot.published_at > PUBLISH_INTERVAL:
                slot.published_at = now
                slot.ends[0].publish(TYPES[slot.type or ""]())
            if self._has_followed(slot):
                self.took.setdefault(slot.what, []).append(now - slot.since)
                slot.since = None
            elif now - slot.since > LOST:
                self.lost.append(f"{slot.ros}: {slot.what}, {slot.type}")
                slot.since = None
        return not waiting

    def _has_followed(self, slot: Slot) -> bool:
        with self._lock:
            if self._routes.get(slot.ros) != slot.type:
                return False
            # Of best effort publishers that replace reliable ones the QoS tells that they are seen.
            return not slot.ends or not slot.to_mqtt or self._arrived.get(slot.ros) == slot.qos

    def result(self) -> dict[str, Any]:
        """How long it took, in seconds, by what was done."""
        every = [seconds for took in self.took.values() for seconds in took]
        return {
            "changes": len(every),
            "median": round(statistics.median(every), 3),
            "p99": round(sorted(every)[int(len(every) * 0.99)], 3),
            "worst": round(max(every), 3),
            "worst_by_change": {what: round(max(took), 3) for what, took in self.took.items()},
            "lost": self.lost,
        }


def run(seconds: float, topics: int, rate: float, seed: int) -> int:
    """Disturb `rate` topics a second for so long; returns the exit code."""
    with tempfile.TemporaryDirectory() as directory:
        appliance = ApplianceProcess(Path(directory), acl=f"user alice\ntopic {ROBOT}/#\n")
        settings = yaml.safe_load(appliance.config.read_text())
        settings["bridge"] = {
            "topics": [
                {"ros": "/churn/out/**", "to": "mqtt"},
                {"ros": "/churn/in/**", "to": "ros", "on_silence": {"after": "1 s"}},
            ]
        }
        appliance.config.write_text(yaml.safe_dump(settings))
        context = Context()
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
        node = Node("churn", context=context, enable_rosout=False, start_parameter_services=False)
        client = paho.Client(paho.CallbackAPIVersion.VERSION2, "churn")
        appliance.start()
        try:
            client.username_pw_set("alice", appliance.passwords["alice"])
            client.tls_set_context(ssl.create_default_context(cafile=str(appliance.ca)))
            client.on_connect = lambda *_: client.subscribe(f"{ROBOT}/#", 2)
            client.connect(HOST, appliance.port)
            client.loop_start()
            return _run(Churn(node, client, topics, seed), appliance.pid, seconds, rate)
        except BaseException:
            print(appliance.log, file=sys.stderr)
            raise
        finally:
            client.loop_stop()
            client.disconnect()
            appliance.stop()
            node.destroy_node()
            rclpy.try_shutdown(context=context)


def _run(churn: Churn, pid: int, seconds: float, rate: float) -> int:
    process = psutil.Process(pid)
    memory: list[float] = []

    def tell_memory() -> None:
        memory.append(round(process.memory_info().rss / 1e6, 1))
        now = round(time.monotonic() - began)
        print(json.dumps({"second": now, "rss_mb": memory[-1]}), flush=True)

    began = time.monotonic()
    tell_memory()
    next_change, next_memory = began, began + min(60.0, seconds / 4)
    while (now := time.monotonic()) < began + seconds:
        churn.watch()
        if now >= next_change:
            next_change += 1 / rate
            churn.disturb()
        if now >= next_memory:
            next_memory += min(60.0, seconds / 4)
            tell_memory()
        time.sleep(0.005)
    while not churn.watch():
        time.sleep(0.005)
    churn.clear()
    while not churn.watch():
        time.sleep(0.005)
    tell_memory()
    cpu = process.cpu_times()
    used = (cpu.user + cpu.system) / (time.monotonic() - began)
    print(json.dumps(churn.result() | {"rss_mb": memory, "cpu": round(used, 2)}), flush=True)
    return 1 if churn.lost else 0


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--topics", type=int, default=300)
    parser.add_argument("--rate", type=float, default=20.0, help="changes a second")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    return run(given.minutes * 60, given.topics, given.rate, given.seed)


if __name__ == "__main__":
    sys.exit(main())
