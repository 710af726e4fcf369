"""An interface package of one's own, built here, is bridged both ways: nothing names it but the
environment, as a workspace's does.
"""

from __future__ import annotations

import json
import queue
import sys

import paho.mqtt.client as mqtt
import pytest
import yaml
from waiting import until

pytest.importorskip("rclpy")
from appliance_process import HOST, ROBOT, ApplianceProcess
from ros2_harness import Peer
from rover_workspace import DRIVE, VALUE, build_workspace

pytestmark = pytest.mark.usefixtures("isolated_domain")


@pytest.fixture
def workspace(tmp_path):
    return build_workspace(tmp_path)


@pytest.fixture
def appliance(tmp_path, workspace, monkeypatch):
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{workspace}:{sys.prefix}")
    (tmp_path / "home").mkdir()
    appliance = ApplianceProcess(tmp_path / "home", acl=f"user alice\ntopic {ROBOT}/#\n")
    settings = yaml.safe_load(appliance.config.read_text())
    settings["bridge"] = {
        "topics": [{"ros": "/state", "to": "mqtt"}, {"ros": "/drive", "to": "ros", "type": DRIVE}]
    }
    appliance.config.write_text(yaml.safe_dump(settings))
    appliance.start()
    yield appliance
    appliance.stop()


@pytest.fixture
def client(appliance):
    client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
    client.username_pw_set("alice", appliance.passwords["alice"])
    client.received = queue.Queue()
    client.on_message = lambda _, __, message: client.received.put(message)
    client.on_connect = lambda *_: client.subscribe(f"{ROBOT}/#")
    client.connect(HOST, appliance.plain_port)
    client.loop_start()
    yield client
    client.disconnect()
    client.loop_stop()


def next_on(client, topic):
    while True:
        message = client.received.get(timeout=60)
        if message.topic == topic:
            return message


async def test_both_ways(workspace, client, appliance):
    peer = Peer()
    site = next(workspace.glob("lib/python*/site-packages"))
    await peer.start("rover", PYTHONPATH=str(site))
    try:
        await peer.do("subscribe", "/drive", DRIVE)
        await peer.do("advertise", "/state", DRIVE)
        await peer.do("matched", "/state")
        schema = json.loads(next_on(client, f"{ROBOT}/_appliance/schema/rover_msgs/Drive").payload)
        assert schema["properties"]["mode"] == {
            "type": "string",
            "maxLength": 16,
            "default": "idle",
        }

        wrong = {"wheels": [{"side": 1}, {"side": 256}]}
        client.publish(f"{ROBOT}/drive", json.dumps(wrong))
        appliance.wait_for_log(r"wheels\[1\]\.side: 256 does not fit in uint8")
        client.publish(f"{ROBOT}/drive", json.dumps(VALUE))
        await until(lambda: peer.received, "the message on /drive")
        topic, cdr = peer.received[0]
        assert topic == "/drive"

        await peer.do("publish", "/state", cdr)  # what ROS has received goes back
        message = next_on(client, f"{ROBOT}/state")
        assert json.loads(message.payload) == VALUE
        properties = dict(message.properties.UserProperty)
        assert properties["ros-type"] == DRIVE
        assert properties["ros-type-hash"].startswith("RIHS01_")
    finally:
        await peer.stop()
