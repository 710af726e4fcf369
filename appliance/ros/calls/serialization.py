"""Payloads of calls to serialized ROS messages and back."""

from __future__ import annotations

from appliance.ros.calls.dispatcher import CallError
from appliance.ros.payload.converter import ConversionError, Converters, TooLargeError
from appliance.ros.payload.definitions import UnknownTypeError
from appliance.ros.payload.encodings.base import EncodingName
from appliance.ros.payload.encodings.registry import ENCODINGS, RAW
from appliance.ros.payload.payloads import InputLimits


def to_request(
    converters: Converters,
    type_name: str,
    payload: bytes,
    encoding: EncodingName,
    limits: InputLimits,
) -> bytes:
    """Serialize the message of a payload; an empty payload stands for every field's default.

    Raises CallError: bad_request, which names the field; too_large, unknown_type.
    """
    try:
        converter = converters.get(type_name)
        if not payload:
            return converter.from_dict({})
        described = ENCODINGS[encoding]
        limits.check(payload, described)
        return described.decoder(converter, limits.items)(payload)
    except TooLargeError as error:
        raise CallError("too_large", str(error)) from None
    except ConversionError as error:
        raise CallError("bad_request", str(error)) from None
    except UnknownTypeError as error:
        raise CallError("unknown_type", str(error)) from None


def from_ros(converters: Converters, type_name: str, cdr: bytes, encoding: EncodingName) -> bytes:
    """The payload of a serialized message. Raises ConversionError, UnknownTypeError."""
    if encoding in RAW:
        return cdr
    return ENCODINGS[encoding].encoder(converters.get(type_name))(cdr)
