"""Profiles of Fast DDS, ROS 2's usual middleware: more shared memory, and fewer wake-ups."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping, MutableMapping
from pathlib import Path

from appliance.ros.ros2 import installation

#: The appliance's own profiles: `default` (the built-in transports with more shared memory) and
#: `local` (for nodes of this computer only: no socket is open to a network, and who is elsewhere
#: and says to be here is not heard); `udp` and `local_udp`, the same without shared memory;
#: `writers`, which leaves transports as they are. All have these times of reliable publishers (RTPS
#: 2.3, 8.4.7.1), which Fast DDS 2 and 3 name differently: neither reads a file for the other.
#:
#: - The heartbeat period, 500 ms: subscribers that have not acknowledged a message are told of it
#:   again. Fast DDS's own is 3 s; for so long a stop is lost that the network has lost. With 100 ms
#:   a link too narrow for its images had four times the packets, and each publisher of a subscriber
#:   that hangs sent ten a second.
#: - The NACK suppression, 4 ms: a request to repeat what was just sent is ignored, and subscribers
#:   ask 5 ms after they have noticed. Fast DDS's own is 0, and then each message wakes a thread for
#:   each subscriber, and waits for it: a third of what publishing 1,000 a second takes.
#:
#: The memory is the sender's, and resident: 4 MiB, room for three camera images, of which none fits
#: into Fast DDS's own 512 KiB: it is cut up, waits, and is lost (1 MB: 11.5 ms instead of 1.2 ms).
_FOLDER = Path(__file__).parent / "fastdds_profiles"

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

#: What only one version of Fast DDS knows, and what is said to readers of the file.
_VERSIONED = re.compile(r"<!--.*?-->\n|    <data_writer .*?</data_writer>\n", re.DOTALL)
_SEGMENT = re.compile(r"(?<=<segment_size>)\d+(?=</segment_size>)")


def profile(segment: int) -> str:
    """The text of a profile, with `segment` bytes of shared memory for a node that publishes.

    It is for each version of Fast DDS, so the times of publishers are not in it.
    """
    return _SEGMENT.sub(str(segment), _VERSIONED.sub("", file_of("default").read_text()))


def file_of(kind: str) -> Path:
    """The file of one of the profiles, for the Fast DDS that is installed."""
    return _FOLDER / f"{kind}_{2 if is_old() else 3}.xml"


def shares() -> Iterator[Path]:
    """The `share` folders of ROS's packages; that of the wheels is in the venv."""
    yield from (prefix / "share" for prefix in _prefixes())


def _prefixes() -> Iterator[Path]:
    """Where ROS is sourced, and last where this Python is, which may have ROS's wheels."""
    sourced = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    yield from map(Path, (*sourced, sys.prefix))


def is_old() -> bool:
    """Whether the Fast DDS of the ROS that is used is Fast RTPS (2), up to ROS 2 Jazzy.

    A wrong answer opens sockets to the network: a profile of the other version is not read.
    """
    *sourced, own = _prefixes()
    # Another one may be sourced that this Python cannot use, or wheels be beside one that it can.
    is_sourced = installation.find().source == "sourced"
    for prefix in (*sourced, own) if is_sourced else (own, *sourced):
        for name in ("fastrtps", "fastdds"):
            # The one file has of all this the library alone, beside itself.
            for place in (f"share/{name}", f"lib/lib{name}.so*", f"lib{name}.so*"):
                if next(prefix.glob(place), None) is not None:
                    return name == "fastrtps"
    return False


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
    """Make Fast DDS read our profile.

    Returns False without a change when the user has settings of Fast DDS: these take precedence.
    The profile for nodes of this computer only, with `is_local`, overrides them: any other profile
    would open sockets to the network. A profile has no transports where they would override what
    the environment says: `ROS_LOCALHOST_ONLY` on ROS 2 up to Jazzy (Kilted does not know it any
    more), and UDP alone since Fast DDS 3.
    """
    if not is_used(environment):
        return False
    is_udp = environment.get(_TRANSPORTS) == "UDPv4"
    kind = "udp" if is_udp else "default"
    if is_local:
        for name in VARIABLES:
            environment.pop(name, None)
        environment.update(dict.fromkeys(_SKIP_FILES, "1"))
        kind = "local_udp" if is_udp else "local"
    elif settings_of_user(environment):
        return False
    elif environment.get("ROS_LOCALHOST_ONLY", "0") not in ("", "0") if is_old() else is_udp:
        kind = "writers"
    environment[VARIABLES[1 if is_old() else 0]] = str(file_of(kind))
    return True


def is_local(environment: Mapping[str, str]) -> bool:
    """Whether Fast DDS reads our profile for nodes of this computer."""
    files = (Path(environment.get(variable, "")) for variable in VARIABLES)
    return any(file.parent == _FOLDER and file.name.startswith("local") for file in files)
