"""Single messages through an encoding of topics; routes keep the functions that these make anew."""

from __future__ import annotations

from appliance.ros.payload.converter import Converter
from appliance.ros.payload.cost import DEFAULT_ITEMS
from appliance.ros.payload.encodings.registry import ENCODINGS


def encoded(encoding: str, converter: Converter, cdr: bytes) -> bytes:
    """The payload of a serialized message."""
    return ENCODINGS[encoding].encoder(converter)(cdr)


def decoded(encoding: str, converter: Converter, payload: bytes) -> bytes:
    """The serialized message of a payload."""
    return ENCODINGS[encoding].decoder(converter, DEFAULT_ITEMS)(payload)


def to_cbor(converter: Converter, cdr: bytes) -> bytes:
    return encoded("cbor", converter, cdr)


def from_cbor(converter: Converter, payload: bytes) -> bytes:
    return decoded("cbor", converter, payload)


def to_text(converter: Converter, cdr: bytes) -> bytes:
    return encoded("text", converter, cdr)


def from_text(converter: Converter, payload: bytes) -> bytes:
    return decoded("text", converter, payload)
