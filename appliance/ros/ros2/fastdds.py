"""The profile with which Fast DDS, ROS 2's usual middleware, shares more memory between nodes."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping, MutableMapping
from pathlib import Path

_FOLDER = Path(__file__).parent
#: The appliance's own profile: the built-in transports, with room for a few images.
PROFILE = _FOLDER / "fastdds.xml"
#: The profiles by (is for nodes of this computer only, is for UDP without shared memory).
_PROFILES = {
    (False, False): PROFILE,
    (False, True): _FOLDER / "fastdds_udp.xml",
    (True, False): _FOLDER / "fastdds_local.xml",
    (True, True): _FOLDER / "fastdds_local_udp.xml",
}

#: The variables that name the profile to a node: now, and up to ROS 2 Jazzy (as Fast RTPS).
VARIABLES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
_FILES = ("DEFAULT_FASTDDS_PROFILES.xml", "DEFAULT_FASTRTPS_PROFILES.xml")
#: With these set, no profile in the working directory is read: up to Fast DDS 2, and since.
_SKIP_FILES = ("SKIP_DEFAULT_XML", "SKIP_DEFAULT_XML_FILE")
_TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"

#: The advice for messages that the middleware lost.
LOST_IN_ROS = (
    "ROS's middleware lost these on their way here, most often because images do not fit into the "
    "512 KiB of memory that a publisher shares by default; `appliance fastdds > fastdds.xml` makes "
    "the file that gives the nodes that publish them more, and says how"
)

_SEGMENT = re.compile(r"(?<=<segment_size>)\d+(?=</segment_size>)")


def profile(segment: int) -> str:
    """The text of the profile, with `segment` bytes of shared memory for a publishing node."""
    without_comment = re.sub(r"<!--.*?-->\n", "", PROFILE.read_text(), flags=re.DOTALL)
    return _SEGMENT.sub(str(segment), without_comment)


def shares() -> Iterator[Path]:
    """The `share` folders of ROS's packages; that of the wheels is in the venv."""
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    yield from (Path(prefix, "share") for prefix in (*prefixes, sys.prefix))


def is_old() -> bool:
    """Whether it is Fast RTPS, up to ROS 2 Jazzy. Fast DDS warns of the old variable."""
    return any((share / "fastrtps").is_dir() for share in shares())


def is_used(environment: Mapping[str, str]) -> bool:
    """Whether the middleware is Fast DDS."""
    return environment.get("RMW_IMPLEMENTATION", "rmw_fastrtps").startswith("rmw_fastrtps")


def settings_of_user(environment: Mapping[str, str]) -> list[str]:
    """The user's settings of Fast DDS: profiles, and transports without a profile of ours."""
    found = [f"{name}={environment[name]}" for name in VARIABLES if environment.get(name)]
    found += [f"{file} in {Path.cwd()}" for file in _FILES if Path(file).exists()]
    transports = environment.get(_TRANSPORTS)
    return found + ([f"{_TRANSPORTS}={transports}"] if transports not in (None, "UDPv4") else [])


def use_profile(environment: MutableMapping[str, str], *, is_local: bool = False) -> bool:
    """Make Fast DDS read our profile, which has room for images.

    Returns False without a change when the user has settings of Fast DDS: these take precedence.
    The profile for nodes of this computer only, with `is_local`, overrides them: any other profile
    would open sockets to the network. On ROS 2 up to Jazzy the transports of a profile would also
    override `ROS_LOCALHOST_ONLY`, which Kilted does not know any more.
    """
    is_udp = environment.get(_TRANSPORTS) == "UDPv4"
    if not is_used(environment) or (
        is_old() and environment.get("ROS_LOCALHOST_ONLY", "0") not in ("", "0")
    ):
        return False
    if is_local:
        for name in VARIABLES:
            environment.pop(name, None)
        environment.update(dict.fromkeys(_SKIP_FILES, "1"))
    elif (
        settings_of_user(environment)
        # Up to Humble, Fast DDS does not know the variable: the profile configures UDP there.
        or (is_udp and not is_old())
    ):
        return False
    environment[VARIABLES[1 if is_old() else 0]] = str(_PROFILES[is_local, is_udp])
    return True


def is_local(environment: Mapping[str, str]) -> bool:
    """Whether Fast DDS reads our profile for nodes of this computer."""
    ours = {str(path) for (local, _), path in _PROFILES.items() if local}
    return any(environment.get(variable) in ours for variable in VARIABLES)
