"""Which nodes of ROS 2 are discovered: `bridge.discovery` as variables of ROS and Fast DDS.

ROS is not encrypted unless SROS 2 is set up: every node that is discovered can read and command.
"""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from typing import Literal, TypeAlias

from appliance.ros.ros2 import fastdds, installation

#: Discover nodes of this computer, of the network, or as the environment says.
Discovery: TypeAlias = Literal["localhost", "subnet", "environment"]

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
#: Its predecessor in ROS 2 Humble. Jazzy knows both, Kilted only the new one.
LOCALHOST_ONLY = "ROS_LOCALHOST_ONLY"
#: Variables that name nodes to discover beyond the range.
PEERS = ("ROS_STATIC_PEERS", "ROS_DISCOVERY_SERVER")

#: The risk of an open bus, and what to do, for `check` and `doctor`.
OPEN = (
    "ROS 2 neither encrypts nor authenticates: everybody on this network can read all topics and "
    "publish commands, past the users, rules and leases of MQTT"
)
OPEN_ADVICE = (
    "where all nodes are on this computer: bridge.discovery: localhost; else a network of the "
    "robot's own, or SROS 2 (docs/security.md)"
)

#: The effect of two nodes with one name, and what to do, for the log and `doctor`.
TWIN = (
    "another node of this name is on the bus: two bridges there carry everything twice, and each "
    "has leases and stop messages of its own"
)
TWIN_ADVICE = (
    "give each a bridge.domain_id of its own, or, where both are meant, a bridge.node; one that "
    "was killed is seen for 20 s more"
)

OPEN_ROS1 = (
    "ROS 1 neither encrypts nor authenticates: everybody who reaches this computer and the Master "
    "can publish commands, past the users, rules and leases of MQTT; keep ROS on a network of its "
    "own"
)

_SECURITY = ("ROS_SECURITY_ENABLE", "ROS_SECURITY_STRATEGY")


def use(discovery: Discovery, environment: MutableMapping[str, str]) -> str:
    """Set the variables, before the node joins the bus.

    Returns one line about the settings that this overrides; empty when there are none. With Fast
    DDS, localhost is a profile of the appliance's own, which takes precedence over a profile of the
    user: with ROS's variable, the sockets would still be open to the network, and nodes of another
    user of this computer would be discovered while no messages of theirs arrive. Without Fast DDS,
    localhost is that variable.
    """
    if discovery == "environment" or fastdds.is_local(environment):
        return ""
    overridden = [f"{name}={environment[name]}" for name in _overridden(discovery, environment)]
    if discovery == "localhost" and fastdds.is_used(environment):
        overridden += fastdds.settings_of_user(environment)
    if discovery == "subnet":
        environment[RANGE] = "SUBNET"
        environment.pop(LOCALHOST_ONLY, None)
    else:
        for name in (*PEERS, LOCALHOST_ONLY):
            environment.pop(name, None)
        if fastdds.use_profile(environment, is_local=True):
            environment[RANGE] = "SUBNET"  # LOCALHOST would override the profile's transports
        else:
            environment[RANGE] = "LOCALHOST"
            if not _knows_range():
                environment[LOCALHOST_ONLY] = "1"
    if not overridden:
        return ""
    return (
        f"bridge.discovery is {discovery}, so that {', '.join(overridden)} is not heeded; "
        "with `discovery: environment` the variables decide"
    )


def _overridden(discovery: Discovery, environment: Mapping[str, str]) -> list[str]:
    wanted = "LOCALHOST" if discovery == "localhost" else "SUBNET"
    found = [RANGE] if environment.get(RANGE, wanted).upper() not in ("", wanted) else []
    if discovery == "localhost":
        return found + [name for name in PEERS if environment.get(name)]
    return found + ([LOCALHOST_ONLY] if _is_localhost_only(environment) else [])


def is_local(environment: Mapping[str, str]) -> bool:
    """Whether only nodes of this computer are discovered, according to the environment."""
    if any(environment.get(name) for name in PEERS):
        return False
    return (
        fastdds.is_local(environment)
        or environment.get(RANGE, "").upper() in ("LOCALHOST", "OFF")
        or _is_localhost_only(environment)
    )


def is_secured(environment: Mapping[str, str]) -> bool:
    """Whether SROS 2 is on and refuses nodes without keys."""
    enabled, strategy = (environment.get(name, "") for name in _SECURITY)
    return enabled.lower() == "true" and strategy == "Enforce"


def _is_localhost_only(environment: Mapping[str, str]) -> bool:
    is_set = environment.get(LOCALHOST_ONLY, "0") not in ("", "0")
    return is_set and (fastdds.is_old() or not _knows_range())


def _knows_range() -> bool:
    """Whether ROS 2 is newer than Humble: Iron added the module that is looked for."""
    where = installation.find().where
    return where is None or (where / "rclpy" / "event_handler.py").exists()
