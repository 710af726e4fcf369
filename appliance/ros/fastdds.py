"""The file by which Fast DDS, ROS 2's usual middleware, shares more memory between nodes."""

from __future__ import annotations

import re
from pathlib import Path

#: Ours: the built-in transports with room for a few images; and without shared memory.
PROFILE = Path(__file__).parent.parent / "fastdds.xml"
UDP_PROFILE = PROFILE.with_name("fastdds_udp.xml")

#: What names the file to a node, and what did up to ROS 2 Jazzy, when it was called Fast RTPS.
VARIABLES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")

#: What to do about messages that the middleware lost on their way here.
LOST_IN_ROS = (
    "ROS's middleware lost these on their way here, most often because images do not fit into the "
    "512 KiB of memory that a publisher shares by default; `appliance fastdds > fastdds.xml` makes "
    "the file that gives the nodes that publish them more, and says how"
)

_SEGMENT = re.compile(r"(?<=<segment_size>)\d+(?=</segment_size>)")


def profile(segment: int) -> str:
    """The file's text, with so many bytes of memory for what a node publishes."""
    without_comment = re.sub(r"<!--.*?-->\n", "", PROFILE.read_text(), flags=re.DOTALL)
    return _SEGMENT.sub(str(segment), without_comment)
