"""A ROS domain that no other test run on this computer uses."""

from __future__ import annotations

import os
import socket

import pytest

#: Above it the ports are those of outgoing connections.
LAST = 101


def claim() -> tuple[str, socket.socket]:
    """A domain, and what keeps it for this process until it ends, however it does."""
    for offset in range(LAST):
        number = 1 + (os.getpid() + offset) % LAST
        held = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            held.bind(f"\0appliance-tests-ros-domain-{number}")
        except OSError:  # another worker's, or another run's
            held.close()
        else:
            return str(number), held
    raise RuntimeError(f"each ROS domain from 1 to {LAST} is used by a test run on this computer")


DOMAIN, _HELD = claim()


@pytest.fixture
def isolated_domain(monkeypatch):
    """A domain of this process alone, without Fast DDS profiles of the user."""
    monkeypatch.setenv("ROS_DOMAIN_ID", DOMAIN)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    for variable in ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE"):
        monkeypatch.setenv(variable, "")  # so that what a test sets is undone after it
        monkeypatch.delenv(variable)
