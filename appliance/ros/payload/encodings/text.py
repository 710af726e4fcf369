"""`text`: the one field `data` of a message, as people write it: `true`, `42`, `hello`."""

from __future__ import annotations

import math
import re

from appliance.ros.payload.converter import Converter
from appliance.ros.payload.definitions import (
    Primitive,
    String,
    TypeDescription,
    UnknownTypeError,
    WideString,
)
from appliance.ros.payload.encodings.base import Decode, Encode, Encoding
from appliance.ros.payload.fallback import ConversionError

_INTEGER = re.compile(r"\s*([+-]?[0-9]{1,20})\s*\Z", re.ASCII)
_FLOAT = re.compile(
    r"\s*([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?|[+-]?inf(?:inity)?|nan)\s*\Z",
    re.ASCII | re.IGNORECASE,
)
_BOOLS = {"true": True, "false": False}


class Text(Encoding):
    """Plain text, for types with the one field `data`: `true` and `false`, the digits of a number
    (`nan`, `inf`, `-inf`), the characters of a string."""

    name = "text"
    content_type = "text/plain"
    is_text = True

    def check(self, converter: Converter, *, to_ros: bool) -> None:
        _data_type(converter.description)

    def encoder(self, converter: Converter) -> Encode:
        _data_type(converter.description)
        to_dict = converter.to_dict

        def encode(cdr: bytes) -> bytes:
            data = to_dict(cdr)["data"]
            if isinstance(data, bool):
                return b"true" if data else b"false"
            return str(data).encode()

        return encode

    def decoder(self, converter: Converter, items: int) -> Decode:
        """White space around numbers and bools is ignored."""
        type_ = _data_type(converter.description)
        from_values = converter.from_values

        def decode(payload: bytes) -> bytes:
            try:
                text = payload.decode()
            except UnicodeDecodeError:
                raise ConversionError("data", "not UTF-8") from None
            # No field can be missing, so that the size, which limits the search for one, is 0.
            return from_values({"data": _parse(type_, text)}, 0)

        return decode


def _data_type(description: TypeDescription) -> Primitive | String | WideString:
    """The type of the one field. Raises UnknownTypeError when the message has another shape."""
    fields = description.fields
    if len(fields) == 1 and fields[0].name == "data":
        type_ = fields[0].type
        if isinstance(type_, (Primitive, String, WideString)):
            return type_
    raise UnknownTypeError(
        f"{description.name} cannot go as text: only types with one field `data`, a number, bool "
        "or string"
    )


def _parse(type_: Primitive | String | WideString, text: str) -> object:
    """The value of a text. Text of another type is returned as it is: the converter refuses it, and
    names what it expected."""
    if not isinstance(type_, Primitive):
        return text
    if type_.name == "bool":
        return _BOOLS.get(text.strip(), text)
    match = (_FLOAT if type_.is_float else _INTEGER).match(text)
    if match is None:
        return text
    if not type_.is_float:
        return int(match.group(1))
    value = float(match.group(1))
    if math.isinf(value) and "inf" not in text.lower():  # the digits overflowed a double
        raise ConversionError("data", f"{text.strip()[:40]} does not fit in {type_.name}")
    return value
