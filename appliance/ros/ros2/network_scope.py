"""How far this computer can be heard: a DDS participant stays with the network that it began with.

One that begins at the boot, before there is a network, hears nothing of other computers for ever,
and of this one neither when not even the loopback was up.
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

#: Where Fast DDS is loaded from: the library's name up to ROS 2 Jazzy, and since.
_FAST_DDS = re.compile(r"(/\S+/lib(?:fastrtps|fastdds)\.so\S*)$", re.MULTILINE)


class NetworkScope(IntEnum):
    """Who can be heard."""

    NOBODY = 0
    THIS_COMPUTER = 1
    NETWORK = 2


def find_scope(environment: Mapping[str, str] | None = None) -> NetworkScope:
    """What there is now, as far as ROS may use it."""
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
    """Let Fast DDS, where it is loaded already, look for the networks that there are now.

    It looks once a process, and for a participant that is made later remembers what it saw. What
    makes it look again it offers to C++ only, and ROS does not pass it on (ros2/rmw#344).
    """
    with suppress(OSError):
        for path in set(_FAST_DDS.findall(Path("/proc/self/maps").read_text())):
            with suppress(AttributeError):  # it does not remember
                ctypes.CDLL(path)._ZN8eprosima10SystemInfo17update_interfacesEv()
