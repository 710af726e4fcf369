"""Fixtures on real ROS 2."""

from __future__ import annotations

import threading

import pytest
from ros2_harness import Harness, Peer


@pytest.fixture
async def harness():
    harness = Harness()
    yield harness
    await harness.bridge.stop()
    assert "ros" not in [thread.name for thread in threading.enumerate()]


@pytest.fixture
async def peer():
    peer = await Peer().start()
    yield peer
    await peer.stop()
