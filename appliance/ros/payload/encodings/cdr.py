"""`cdr`: ROS 2's own serialized bytes."""

from __future__ import annotations

from appliance.ros.payload.definitions import CDR
from appliance.ros.payload.encodings.base import SerializedEncoding


class Cdr(SerializedEncoding):
    """ROS 2's own bytes, as any ROS 2 node reads them."""

    name = "cdr"
    content_type = "application/cdr"
    serialization = CDR
