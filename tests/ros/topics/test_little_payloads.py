"""A little payload for ROS that takes long to convert counts as what it takes."""

from __future__ import annotations

from dataclasses import replace

import pytest
from bridge_harness import Client, Harness, to_ros
from call_harness import AllTypes
from waiting import until

from appliance.ros.node import FakeNode
from appliance.ros.topics.rules import CommandRules

pytest.importorskip("rclpy")

POSES = "geometry_msgs/msg/PoseArray"

#: A kilobyte: each of them is filled with its defaults.
EMPTY = b'{"poses":[' + b",".join([b"{}"] * 330) + b"]}"


@pytest.mark.parametrize("rules", [None, CommandRules(exclusive=True)])
async def test_each_way_to_ros(rules: CommandRules | None) -> None:
    harness = Harness()
    harness.node = FakeNode(types=AllTypes())
    harness.start(replace(to_ros("/x", type=POSES), rules=rules))
    counters = harness.broker.counters
    try:
        sender = Client(harness.broker, "sender")
        await until(lambda: harness.routes(), "the route")
        costs = []
        for payload in (b"{}", EMPTY):
            begun = counters.cost
            for _ in range(5):
                sender.send("r2d2/x", payload)
            costs.append(counters.cost - begun)
        assert costs[1] > costs[0] + 5 * 25, "over a tenth of a millisecond each"
    finally:
        await harness.bridge.stop()
