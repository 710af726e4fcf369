"""A ROS domain that no other test run on this computer uses."""

from __future__ import annotations

import os

import pytest

DOMAIN = str(1 + os.getpid() % 101)  # above 101 the ports are those of outgoing connections


@pytest.fixture
def isolated_domain(monkeypatch):
    """A domain of this process alone, without Fast DDS profiles of the user."""
    monkeypatch.setenv("ROS_DOMAIN_ID", DOMAIN)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    for variable in ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE"):
        monkeypatch.setenv(variable, "")  # so that what a test sets is undone after it
        monkeypatch.delenv(variable)
