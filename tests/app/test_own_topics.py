"""What an earlier run has said of itself and nobody would take back, is taken back at the start."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import pytest

from appliance import config
from appliance.app.own_topics import orphaned_topics
from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.ports import Access
from appliance.ros import home_assistant
from appliance.store import MemoryStore

ENTITY = "homeassistant/sensor/r2d2/x/config"
TOPICS = ("r2d2/_appliance/state", "r2d2/_appliance/routes", "r2/_appliance/state", ENTITY)


@pytest.mark.parametrize(
    ("bus", "orphaned"),
    [
        # The bridge itself deletes what it no longer tells Home Assistant.
        ("ros2", {"r2/_appliance/state"}),
        ("none", {"r2/_appliance/state", "r2d2/_appliance/routes", ENTITY}),
    ],
)
def test_by_the_bus(tmp_path: Path, bus: str, orphaned: set[str]) -> None:
    file = tmp_path / "appliance.yaml"
    file.write_text(f"robot: r2d2\nbridge: {{bus: {bus}, home_assistant: true}}\n")
    broker = Broker(cast(Access, None), MemoryStore())
    inside = broker.accounting.accounts.inside
    alice = broker.accounting.accounts.of_user("alice")
    of_route = home_assistant._properties("r2d2/x")
    for topic in TOPICS:
        broker.retained.keep(Message(topic, b"{}", 1, True, of_route), inside)
    for topic in ("r2d2/_appliance/hers", "homeassistant/light/r2d2/x/config"):
        broker.retained.keep(Message(topic, b"{}", 1, True, of_route), alice)
    broker.retained.keep(Message("homeassistant/light/r2d2/y/config", b"{}", 1, True), inside)
    assert {*orphaned_topics(broker.retained, config.load(file))} == orphaned
