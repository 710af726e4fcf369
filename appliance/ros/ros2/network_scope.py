"""Which nodes this computer can reach: a DDS participant never notices new network interfaces.

A participant that starts at boot before there is a network never discovers nodes on other
computers, and none on this one either when not even the loopback was up.
"""

from __future__ import annotations

import ctypes
import ipaddress
import os
import re
import socket
from collections.abc import Mapping
from contextlib import suppress
from enum import IntEnum
from pathlib import Path

import psutil

from appliance.ros.ros2 import discovery

#: The library of Fast DDS among the mapped files: its name up to ROS 2 Jazzy, and since.
_FAST_DDS = re.compile(r"(/\S+/lib(?:fastrtps|fastdds)\.so\S*)$", re.MULTILINE)


class NetworkScope(IntEnum):
    """Which nodes can be reached."""

    NOBODY = 0
    THIS_COMPUTER = 1
    NETWORK = 2


def find_scope(environment: Mapping[str, str] | None = None) -> NetworkScope:
    """The present scope, limited to what discovery is configured for."""
    environment = os.environ if environment is None else environment
    found = NetworkScope.NOBODY
    states = psutil.net_if_stats()
    for name, addresses in psutil.net_if_addrs().items():
        if name not in states or not states[name].isup:
            continue
        for address in addresses:
            if address.family != socket.AF_INET:
                continue
            is_loopback = ipaddress.IPv4Address(address.address).is_loopback
            found = max(found, NetworkScope.THIS_COMPUTER if is_loopback else NetworkScope.NETWORK)
    return min(found, NetworkScope.THIS_COMPUTER) if discovery.is_local(environment) else found


def refresh_fast_dds() -> None:
    """Make Fast DDS, where it is loaded already, read the network interfaces again.

    It reads them once a process and caches them for later participants. It exports the function
    that refreshes the cache to C++ only, and ROS does not pass it on (ros2/rmw#344).
    """
    with suppress(OSError):
        for path in set(_FAST_DDS.findall(Path("/proc/self/maps").read_text())):
            with suppress(AttributeError):  # this version does not cache them
                ctypes.CDLL(path)._ZN8eprosima10SystemInfo17update_interfacesEv()
