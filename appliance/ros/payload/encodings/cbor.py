"""`cbor`: CBOR (RFC 8949) in JSON's shape, with byte strings and typed arrays (RFC 8746).

The bytes of a typed array are those of CDR, and are copied. Input may have plain arrays as well,
and typed arrays of any type and byte order that Python knows. Other tags are refused: none is
needed, and with references to values that came before, a few bytes could stand for gigabytes.
"""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from typing import Any

import cbor2

from appliance.ros.payload.arrays import Numbers, unpack_numbers
from appliance.ros.payload.converter import Converter
from appliance.ros.payload.cost import MAX_DEPTH, cbor_cost
from appliance.ros.payload.definitions import PRIMITIVES
from appliance.ros.payload.encodings.base import Decode, Encode, ValueEncoding
from appliance.ros.payload.fallback import ConversionError

#: Tags of typed arrays in little endian.
TAGS = {
    "uint16": 69,
    "uint32": 70,
    "uint64": 71,
    "int8": 72,
    "int16": 77,
    "int32": 78,
    "int64": 79,
    "float32": 85,
    "float64": 86,
}

#: `struct`'s code of each typed array.
_CODES = {
    64: "B",
    65: ">H",
    66: ">I",
    67: ">Q",
    68: "B",
    69: "<H",
    70: "<I",
    71: "<Q",
    72: "b",
    73: ">h",
    74: ">i",
    75: ">q",
    77: "<h",
    78: "<i",
    79: "<q",
    80: ">e",
    81: ">f",
    82: ">d",
    84: "<e",
    85: "<f",
    86: "<d",
}

#: The tags that cbor2 would convert to objects of Python.
_KNOWN = (0, 1, 2, 3, 4, 5, 25, 28, 29, 30, 35, 36, 37, 100, 256, 258, 260, 261, 1004, 43000)

#: The typed arrays whose bytes are those of ROS.
_AS_ON_ROS = {
    **{tag: PRIMITIVES[name] for name, tag in TAGS.items()},
    **dict.fromkeys((64, 68), PRIMITIVES["uint8"]),
}


def _encode_numbers(encoder: cbor2.CBOREncoder, value: Any) -> None:
    assert isinstance(value, Numbers)
    encoder.encode(cbor2.CBORTag(TAGS[value.primitive.name], value.data))


class Cbor(ValueEncoding):
    """CBOR: the fields of a message as a map, with NaN and infinities."""

    name = "cbor"
    content_type = "application/cbor"
    has_bytes = True

    def encoder(self, converter: Converter) -> Encode:
        to_values = converter.to_binary_values

        def encode(cdr: bytes) -> bytes:
            return cbor2.dumps(to_values(cdr), default=_encode_numbers)

        return encode

    def decoder(self, converter: Converter, items: int) -> Decode:
        from_values = converter.from_values

        def decode(payload: bytes) -> bytes:
            return from_values(loads(payload, as_numbers=True), len(payload))

        return decode

    def cost(self, payload: bytes, most: int) -> int:
        return cbor_cost(payload, most)

    def dumps(self, value: object) -> bytes:
        return cbor2.dumps(value, default=_encode_numbers)

    def loads(self, payload: bytes) -> Any:
        return loads(payload)

    def values(self, converter: Converter, cdr: bytes) -> dict[str, Any]:
        return converter.to_binary_values(cdr)


def _read_list(tag: cbor2.CBORTag, _: bool) -> list[Any]:
    code = _CODES.get(tag.tag)
    if code is None:
        raise ValueError(f"tag {tag.tag} is not allowed in a message")
    if not isinstance(tag.value, bytes):
        raise ValueError(f"the typed array of tag {tag.tag} is not a byte string")
    try:
        return unpack_numbers(code, tag.value)
    except ValueError:
        raise ValueError(f"the typed array of tag {tag.tag} ends within a number") from None


def _read_numbers(tag: cbor2.CBORTag, is_immutable: bool) -> Numbers | list[Any]:
    primitive = _AS_ON_ROS.get(tag.tag)
    data = tag.value
    if primitive is None or not isinstance(data, bytes) or len(data) % primitive.size:
        return _read_list(tag, is_immutable)
    return Numbers(primitive, data)


def _refuse(tag: int) -> Callable[..., object]:
    def refuse(*_: object) -> object:
        raise ValueError(f"tag {tag} is not allowed in a message")

    return refuse


_REFUSED = {tag: _refuse(tag) for tag in _KNOWN}


def loads(payload: bytes, *, as_numbers: bool = False) -> Any:
    """The value of CBOR. Raises ConversionError when the payload is not exactly one value.

    Typed arrays become lists; with `as_numbers` those whose bytes are ROS's become `Numbers`, which
    are copied without being read.
    """
    file = BytesIO(payload)
    decoder = cbor2.CBORDecoder(
        file,
        tag_hook=_read_numbers if as_numbers else _read_list,
        semantic_decoders=_REFUSED,
        max_depth=MAX_DEPTH,
        strict_hashable_types=True,
    )
    try:
        value = decoder.decode()
    except (cbor2.CBORDecodeError, ValueError, RecursionError) as error:
        raise ConversionError("", f"not CBOR: {error.__cause__ or error}") from None
    if file.tell() != len(payload):
        raise ConversionError("", f"not CBOR: something follows the message at {file.tell()}")
    return value
