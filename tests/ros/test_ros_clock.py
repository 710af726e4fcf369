"""The wall clock is set while the bridge runs; and what `status` and `doctor` see of real ROS 2."""

from __future__ import annotations

import asyncio
import json
import time

import pytest

pytest.importorskip("rclpy")
from appliance_process import ROBOT, ApplianceProcess
from raw_client import RawClient
from test_ros2 import STRING, TWIST, Peer, domain, string, until
from wall_clock import HOUR, YEAR, WallClock

from appliance import config
from appliance.control import ask
from appliance.doctor.ros import ros
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Publish, Subscribe, Subscription

__all__ = ["domain"]  # a fixture for all tests here

ACL = f"user alice\ntopic readwrite {ROBOT}/#\n"
BRIDGE = {
    "topics": [
        {"ros": "/a", "to": "mqtt", "encoding": "text", "keep": 1000},
        {
            "ros": "/cmd_vel",
            "to": "ros",
            "type": TWIST,
            "expire": "5 s",
            "on_silence": {"after": "5 s", "publish": {}},
        },
    ]
}
COMMAND = json.dumps({"linear": {"x": 1.0}}).encode()
STOP = "00" * 48  # the numbers of a Twist, behind the four bytes of the header


async def test_a_clock_that_is_set_stops_no_robot_and_loses_nothing(tmp_path):
    clock = WallClock(tmp_path / "clock")
    appliance = ApplianceProcess(tmp_path / "house", acl=ACL, bridge=BRIDGE)
    appliance.environment = clock.environment
    await asyncio.to_thread(appliance.start)
    peer = await Peer().start()
    try:
        with RawClient(appliance, 5) as client:
            await drive(clock, appliance, peer, client)
    finally:
        await peer.stop()
        await asyncio.to_thread(appliance.stop)


async def drive(clock, appliance, peer, client):
    client.connect("driver", keep_alive=5)
    client.send(Subscribe(1, [Subscription(f"{ROBOT}/a", 0)]))
    client.receive()
    await peer.do("advertise", "/a", STRING)
    await peer.do("subscribe", "/cmd_vel", TWIST)
    await peer.do("matched", "/a")
    expiry = {Property.MESSAGE_EXPIRY_INTERVAL: 5}
    command = Publish(f"{ROBOT}/cmd_vel", COMMAND, properties=expiry)

    def moves():
        client.send(command)
        return any(not cdr.endswith(STOP) for _, cdr in peer.received)

    await until(moves, "the first command")
    await asyncio.sleep(0.1)
    peer.received.clear()
    client.drain()
    sent, told = 0, []
    # Not beyond 2038, where Fast DDS publishes nothing any more: its seconds have 32 bits.
    for ahead in (HOUR, -HOUR, 11 * YEAR, -56 * YEAR):
        clock.set(ahead)
        began = time.monotonic()
        while time.monotonic() - began < 1.3:
            sent += 1
            client.send(command)
            await peer.do("publish", "/a", string(f"{sent:04d}").hex())
            told += [packet.payload for packet in client.drain() if isinstance(packet, Publish)]
            await asyncio.sleep(0.08)

    def all_told():
        told.extend(packet.payload for packet in client.drain() if isinstance(packet, Publish))
        client.send(command)
        return len(told) == sent

    await until(all_told, "all from ROS")
    assert told == [f"{number:04d}".encode() for number in range(1, sent + 1)]
    await until(lambda: len(peer.received) >= sent, "all commands")
    assert not [cdr for _, cdr in peer.received if cdr.endswith(STOP)]
    assert len(appliance.wait_for_log("clock was set", 4)) == 4

    status = await asyncio.to_thread(ask, appliance.directory / "state/control.sock", "status")
    assert status["ros"]["state"] == "joined" and status["ros"]["nodes_seen"] == 1
    assert status["routes"] == {"count": 2, "bridged": 2, "sick": []}
    routes = await asyncio.to_thread(ask, appliance.directory / "state/control.sock", "routes")
    [latency] = [route["latency_ms"] for route in routes if route["ros"] == "/a"]
    assert latency["p50"] < 1000
    found = await asyncio.to_thread(lambda: list(ros(config.load(appliance.config), status)))
    [nodes] = [finding for finding in found if finding.subject == "ROS nodes"]
    assert nodes.level == "ok" and nodes.text.startswith("seen: 1 (/peer)")
