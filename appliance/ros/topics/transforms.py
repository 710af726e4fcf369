"""Static transforms of several nodes that latch on one topic, of which MQTT retains one message."""

from __future__ import annotations

from typing import Any

from appliance.ros.payload.converter import Converter

#: In ROS 2, and in ROS 1.
TYPES = frozenset({"tf2_msgs/msg/TFMessage", "tf2_msgs/TFMessage"})

#: Frames that are kept, of which the oldest go: a large robot has some hundred.
MOST = 1000


class StaticTransforms:
    """All transforms of a latched topic, the last of each frame.

    On ROS, who comes late is given what each publisher holds, as a message of its own. The last of
    these alone would be a tree with all other branches missing.
    """

    def __init__(self, converter: Converter) -> None:
        self._converter = converter
        self._latest: dict[str, Any] = {}

    def add(self, cdr: bytes) -> bytes:
        """The message with those of all before it. Raises ConversionError."""
        latest = self._latest.copy()
        for transform in self._converter.to_dict(cdr)["transforms"]:
            latest.pop(transform["child_frame_id"], None)
            latest[transform["child_frame_id"]] = transform
        while len(latest) > MOST:
            del latest[next(iter(latest))]
        together = self._converter.from_dict({"transforms": list(latest.values())})
        self._latest = latest
        return together
