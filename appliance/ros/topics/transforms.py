"""Merges the static transforms of several nodes, since MQTT retains one message per topic."""

from __future__ import annotations

from typing import Any

from appliance.ros.payload.converter import Converter

#: The message type in ROS 2, and in ROS 1.
TYPES = frozenset({"tf2_msgs/msg/TFMessage", "tf2_msgs/TFMessage"})

#: Frames that are stored; the oldest are evicted. A large robot has some hundred.
MAX_FRAMES = 1000


class StaticTransforms:
    """The latest transform of each frame of a latched topic.

    On ROS, a late subscriber receives the latched message of every publisher. The last of these
    alone would be a tree with all other branches missing.
    """

    def __init__(self, converter: Converter) -> None:
        self._converter = converter
        self._latest: dict[str, Any] = {}

    def add(self, cdr: bytes) -> bytes:
        """Merge a message with all earlier ones. Raises ConversionError."""
        latest = self._latest.copy()
        for transform in self._converter.to_dict(cdr)["transforms"]:
            latest.pop(transform["child_frame_id"], None)
            latest[transform["child_frame_id"]] = transform
        while len(latest) > MAX_FRAMES:
            del latest[next(iter(latest))]
        together = self._converter.from_dict({"transforms": list(latest.values())})
        self._latest = latest
        return together
