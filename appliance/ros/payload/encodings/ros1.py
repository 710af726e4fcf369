"""`ros1`: ROS 1's own serialized bytes."""

from __future__ import annotations

from appliance.ros.payload.definitions import PACKED
from appliance.ros.payload.encodings.base import SerializedEncoding


class Ros1(SerializedEncoding):
    """ROS 1's own bytes, as any ROS 1 node reads them."""

    name = "ros1"
    content_type = "application/x-ros1"
    serialization = PACKED
