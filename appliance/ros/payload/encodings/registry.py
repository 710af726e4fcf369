"""The registry of encodings: a new one is listed here."""

from __future__ import annotations

from appliance.ros.payload.definitions import Serialization
from appliance.ros.payload.encodings.base import Encoding, EncodingName, ValueEncoding
from appliance.ros.payload.encodings.binary import Binary
from appliance.ros.payload.encodings.cbor import Cbor
from appliance.ros.payload.encodings.cdr import Cdr
from appliance.ros.payload.encodings.json import Json
from appliance.ros.payload.encodings.picture import JPEG, PNG
from appliance.ros.payload.encodings.ros1 import Ros1
from appliance.ros.payload.encodings.text import Text

#: Every encoding by the name that the configuration has for it. The configuration is read without
#: anything of ROS, and lists the names once more, in `appliance.config.values.Encoding`;
#: tests/ros/payload/test_encodings.py holds the two equal.
ENCODINGS: dict[EncodingName, Encoding] = {
    encoding.name: encoding
    for encoding in (Json(), Cbor(), Text(), Cdr(), Ros1(), Binary(), JPEG, PNG)
}

#: Those of any value, not of ROS messages alone.
VALUE_ENCODINGS: dict[EncodingName, ValueEncoding] = {
    name: encoding for name, encoding in ENCODINGS.items() if isinstance(encoding, ValueEncoding)
}

#: ROS's own serialized bytes, of ROS 2 and of ROS 1.
RAW: dict[EncodingName, Serialization] = {
    name: encoding.serialization
    for name, encoding in ENCODINGS.items()
    if encoding.serialization is not None
}

#: The content type of each, which MQTT 5 clients are given.
CONTENT_TYPE: dict[EncodingName, str] = {
    name: encoding.content_type for name, encoding in ENCODINGS.items()
}

_BY_CONTENT_TYPE = {
    encoding.content_type: name for name, encoding in ENCODINGS.items() if encoding.can_call
}


def named_encoding(content_type: object) -> EncodingName | None:
    """The encoding of calls that a content type names, with or without parameters behind it."""
    if not isinstance(content_type, str):
        return None
    return _BY_CONTENT_TYPE.get(content_type.partition(";")[0].strip().lower())
