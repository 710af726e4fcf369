"""Whom nodes of ROS 2 find: `bridge.discovery`, and ROS's and Fast DDS's own words for it.

ROS is not encrypted, unless SROS 2 is set up: who can be found can read and command.
"""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from typing import Literal, TypeAlias

from appliance.ros.ros2 import fastdds, installation

#: Nodes of this computer, of the network, or what the environment says, as of every ROS node.
Discovery: TypeAlias = Literal["localhost", "subnet", "environment"]

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
#: What it was called in ROS 2 Humble; Jazzy knows both, Kilted the new one only.
LOCALHOST_ONLY = "ROS_LOCALHOST_ONLY"
#: Whom to find beyond the range.
PEERS = ("ROS_STATIC_PEERS", "ROS_DISCOVERY_SERVER")

#: What an open bus means, and what to do, for `check` and `doctor`.
OPEN = (
    "ROS 2 is neither encrypted nor asks who comes: whoever is on this network can read all topics "
    "and publish commands, past the users, rules and leases of MQTT"
)
OPEN_ADVICE = (
    "where all nodes are on this computer: bridge.discovery: localhost; else a network of the "
    "robot's own, or SROS 2 (docs/security.md)"
)

#: What two nodes of one name mean, and what to do, for the log and `doctor`.
TWIN = (
    "another node of this name is on the bus: two bridges there carry everything twice, and each "
    "has leases and stop messages of its own"
)
TWIN_ADVICE = (
    "give each a bridge.domain_id of its own, or, where both are meant, a bridge.node; one that "
    "was killed is seen for 20 s more"
)

OPEN_ROS1 = (
    "ROS 1 is neither encrypted nor asks who comes: who reaches this computer and the Master can "
    "publish commands, past the users, rules and leases of MQTT; keep ROS on a network of its own"
)

_SECURITY = ("ROS_SECURITY_ENABLE", "ROS_SECURITY_STRATEGY")


def use(discovery: Discovery, environment: MutableMapping[str, str]) -> str:
    """Set the variables, before the node joins; returns what they said against it, a line, or "".

    With Fast DDS localhost is a profile of ours: with ROS's own variable its sockets are open to
    the network all the same, and nodes of another user of this computer are found while nothing
    arrives from them. It goes before a profile of the user's. Without Fast DDS it is that variable.
    """
    if discovery == "environment" or fastdds.is_local(environment):
        return ""
    against = [f"{name}={environment[name]}" for name in _against(discovery, environment)]
    if discovery == "localhost" and fastdds.is_used(environment):
        against += fastdds.settings_of_user(environment)
    if discovery == "subnet":
        environment[RANGE] = "SUBNET"
        environment.pop(LOCALHOST_ONLY, None)
    else:
        for name in (*PEERS, LOCALHOST_ONLY):
            environment.pop(name, None)
        if fastdds.use_profile(environment, is_local=True):
            environment[RANGE] = "SUBNET"  # it would undo the profile's transports
        else:
            environment[RANGE] = "LOCALHOST"
            if not _knows_range():
                environment[LOCALHOST_ONLY] = "1"
    if not against:
        return ""
    return (
        f"bridge.discovery is {discovery}, so that {', '.join(against)} is not heeded; "
        "with `discovery: environment` the variables decide"
    )


def _against(discovery: Discovery, environment: Mapping[str, str]) -> list[str]:
    wanted = "LOCALHOST" if discovery == "localhost" else "SUBNET"
    found = [RANGE] if environment.get(RANGE, wanted).upper() not in ("", wanted) else []
    if discovery == "localhost":
        return found + [name for name in PEERS if environment.get(name)]
    return found + ([LOCALHOST_ONLY] if _says_localhost_only(environment) else [])


def is_local(environment: Mapping[str, str]) -> bool:
    """Whether nodes of this computer only are found, as far as the environment tells."""
    if any(environment.get(name) for name in PEERS):
        return False
    return (
        fastdds.is_local(environment)
        or environment.get(RANGE, "").upper() in ("LOCALHOST", "OFF")
        or _says_localhost_only(environment)
    )


def is_secured(environment: Mapping[str, str]) -> bool:
    """Whether SROS 2 is on and lets nobody in who has no keys."""
    enabled, strategy = (environment.get(name, "") for name in _SECURITY)
    return enabled.lower() == "true" and strategy == "Enforce"


def _says_localhost_only(environment: Mapping[str, str]) -> bool:
    said = environment.get(LOCALHOST_ONLY, "0") not in ("", "0")
    return said and (fastdds.is_old() or not _knows_range())


def _knows_range() -> bool:
    """Whether it is newer than ROS 2 Humble; told by a module that came with it."""
    where = installation.find().where
    return where is None or (where / "rclpy" / "event_handler.py").exists()
