"""`binary`: the bytes of a message's field `data` and nothing else, such as a JPEG picture."""

from __future__ import annotations

from appliance.mqtt.codec import Properties, Property
from appliance.ros.payload.codegen import MISFIT, generate_binary
from appliance.ros.payload.converter import Converter
from appliance.ros.payload.definitions import (
    PRIMITIVES,
    Sequence,
    TypeDescription,
    UnknownTypeError,
)
from appliance.ros.payload.encodings.base import Decode, Encode, Encoding, Pack
from appliance.ros.payload.fallback import decode as decode_slowly

_OCTETS = frozenset(p for p in PRIMITIVES.values() if p.is_octet)

#: What pictures begin with; a WebP has its size between the two.
_IMAGES = ((b"\xff\xd8\xff", b"", "jpeg"), (b"\x89PNG", b"", "png"), (b"RIFF", b"WEBP", "webp"))

#: Fields that a message for ROS may have beside `data`: they are derived from it, or stay empty.
_OPTIONAL = frozenset({"data", "format", "header", "layout"})


def image_format(data: bytes) -> str:
    """`jpeg`, `png` or `webp`; empty for other bytes."""
    for start, later, name in _IMAGES:
        if data.startswith(start) and data.startswith(later, 8):
            return name
    return ""


class Binary(Encoding):
    """The bytes of the field `data`, for types that have one, such as CompressedImage.

    The content type is the picture's (`image/jpeg`), where it is one.
    """

    name = "binary"
    content_type = "application/octet-stream"

    def check(self, converter: Converter, *, to_ros: bool) -> None:
        _check_data(converter.description)
        others = {field.name for field in converter.description.fields} - _OPTIONAL
        if to_ros and others:
            raise UnknownTypeError(
                f"{converter.description.name} cannot be built from binary, which lacks "
                f"{', '.join(sorted(others))}"
            )

    def encoder(self, converter: Converter) -> Encode:
        description = converter.description
        _check_data(description)
        read = generate_binary(description, {"data": None}).decode

        def encode(cdr: bytes) -> bytes:
            try:
                data = read(cdr)["data"]
            except MISFIT:
                data = decode_slowly(description, cdr, binary=True)["data"]
            assert isinstance(data, bytes)
            return data

        return encode

    def decoder(self, converter: Converter, items: int) -> Decode:
        """`format`, where the type has that field, becomes what the bytes begin like: `jpeg`."""
        description = converter.description
        _check_data(description)
        has_format = any(field.name == "format" for field in description.fields)

        def decode(payload: bytes) -> bytes:
            value: dict[str, object] = {"data": payload}
            if has_format:
                value["format"] = image_format(payload)
            return converter.from_dict(value)

        return decode

    def packer(self, converter: Converter | None, properties: Properties) -> Pack:
        assert converter is not None
        encode = self.encoder(converter)
        by_format: dict[str, Properties] = {"": properties}

        def pack(cdr: bytes) -> tuple[bytes, Properties]:
            data = encode(cdr)
            kind = image_format(data)
            if kind not in by_format:
                by_format[kind] = {**properties, Property.CONTENT_TYPE: f"image/{kind}"}
            return data, by_format[kind]

        return pack


def _check_data(description: TypeDescription) -> None:
    types = {field.name: field.type for field in description.fields}
    data = types.get("data")
    if not (isinstance(data, Sequence) and data.item in _OCTETS and data.bound is None):
        raise UnknownTypeError(
            f"{description.name} cannot go as binary: only a type with a field `data` of bytes, "
            "such as CompressedImage"
        )
