"""What a route puts on MQTT and takes from it: an encoding, compressed or not, and what MQTT 5 says
about it in properties.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, TypeAlias

import orjson

from appliance.mqtt.codec import Properties, Property
from appliance.ros import cbor
from appliance.ros.careful import ConversionError
from appliance.ros.convert import NO_BINARY, Converter, image_format
from appliance.ros.definitions import CDR, PACKED, UnknownTypeError, Wire

Encoding: TypeAlias = Literal["json", "cbor", "text", "cdr", "ros1", "binary"]
CallEncoding: TypeAlias = Literal["json", "cbor", "cdr", "ros1"]
Compression: TypeAlias = Literal["none", "zstd"]

CONTENT_TYPE = {
    "json": "application/json",
    "cbor": "application/cbor",
    "text": "text/plain",
    "cdr": "application/cdr",
    "ros1": "application/x-ros1",
    "binary": "application/octet-stream",
}

#: ROS's own serialized bytes, of ROS 2 and of ROS 1.
RAW: dict[str, Wire] = {wire.encoding: wire for wire in (CDR, PACKED)}

_OF_CONTENT_TYPE: dict[str, CallEncoding] = {
    "application/json": "json",
    "application/cbor": "cbor",
    "application/cdr": "cdr",
    "application/x-ros1": "ros1",
}

#: What a user property is called that names the compression, MQTT having no property for it.
CONTENT_ENCODING = "content-encoding"

#: Where a frame of zstd begins (RFC 8878), and no message in any encoding does.
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

#: Bytes of history that a frame may refer to: what RFC 8878 asks of every decoder.
ZSTD_WINDOW = 8 * 1024 * 1024


def check(converter: Converter, encoding: Encoding, *, to_ros: bool) -> None:
    """Raises UnknownTypeError when messages of the type cannot go in that encoding."""
    name = converter.description.name
    if encoding == "text" and not converter.has_text:
        raise UnknownTypeError(
            f"{name} cannot go as text: only types with one field `data`, a number, bool or string"
        )
    if encoding == "binary" and not converter.has_binary:
        raise UnknownTypeError(f"{name} {NO_BINARY}")
    if encoding == "binary" and to_ros:
        others = {field.name for field in converter.description.fields}
        others -= {"data", "format", "header", "layout"}
        if others:
            raise UnknownTypeError(
                f"{name} cannot be made of binary: nothing would tell {', '.join(sorted(others))}"
            )


def packer(
    converter: Converter | None,
    encoding: Encoding,
    compression: Compression,
    about: list[tuple[str, str]],
) -> Callable[[bytes], tuple[bytes, Properties]]:
    """The function that makes payload and properties of a serialized message.

    `about` are user properties. `converter` may be None for those of RAW. It raises
    ConversionError.
    """
    if compression != "none":
        about = [*about, (CONTENT_ENCODING, compression)]
    properties: Properties = {
        Property.CONTENT_TYPE: CONTENT_TYPE[encoding],
        Property.USER_PROPERTY: about,
    }
    if converter is None:

        def pack(cdr: bytes) -> tuple[bytes, Properties]:
            return cdr, properties

    elif encoding == "binary":
        formats: dict[str, Properties] = {"": properties}
        binary = converter.to_binary

        def pack(cdr: bytes) -> tuple[bytes, Properties]:
            data = binary(cdr)
            kind = image_format(data)
            if kind not in formats:
                formats[kind] = {**properties, Property.CONTENT_TYPE: f"image/{kind}"}
            return data, formats[kind]

    else:
        ways = {"json": converter.to_json, "cbor": converter.to_cbor, "text": converter.to_text}
        convert = ways.get(encoding, bytes)

        def pack(cdr: bytes) -> tuple[bytes, Properties]:
            return convert(cdr), properties

    if compression == "none":
        return pack
    compress = _compressor()

    def pack_compressed(cdr: bytes) -> tuple[bytes, Properties]:
        payload, properties = pack(cdr)
        return compress(payload), properties

    return pack_compressed


def unpacker(
    converter: Converter, encoding: Encoding, compression: Compression, largest: int
) -> Callable[[bytes], bytes]:
    """The function that makes a serialized message of a payload, or raises ConversionError.

    They have at most `largest` bytes. With a compression, they may be compressed or not, and have
    no more when they are decompressed.
    """

    convert = {
        "json": converter.from_json,
        "cbor": converter.from_cbor,
        "text": converter.from_text,
        "binary": converter.from_binary,
        "cdr": converter.checked,
        "ros1": converter.checked,
    }[encoding]

    def unpack(payload: bytes) -> bytes:
        if len(payload) > largest:
            raise ConversionError("", too_large(len(payload), largest))
        return convert(payload)

    if compression == "none":
        return unpack
    decompress = _decompressor(largest)

    def unpack_compressed(payload: bytes) -> bytes:
        if payload.startswith(ZSTD_MAGIC):
            payload = decompress(payload)
        return unpack(payload)

    return unpack_compressed


def too_large(size: int, largest: int) -> str:
    """What is wrong with a payload for ROS that would hold up all others for too long."""
    return f"it has {size} bytes, at most {largest} are converted (bridge.limits.payload)"


def named_encoding(content_type: object) -> CallEncoding | None:
    """The encoding of calls that a content type names, with or without parameters behind it."""
    if not isinstance(content_type, str):
        return None
    return _OF_CONTENT_TYPE.get(content_type.partition(";")[0].strip().lower())


def dumps(value: object, encoding: CallEncoding) -> bytes:
    """JSON or CBOR of a value that is no ROS message; JSON where the encoding is one of
    RAW, which have no words for it."""
    return cbor.dumps(value) if encoding == "cbor" else orjson.dumps(value)


def loads(payload: bytes, encoding: CallEncoding) -> Any:
    """The value of JSON or CBOR. Raises ConversionError."""
    if encoding == "cbor":
        return cbor.loads(payload)
    try:
        return orjson.loads(payload)
    except orjson.JSONDecodeError as error:
        raise ConversionError("", f"not JSON: {error}") from None


def claim(properties: Properties, name: str) -> str | None:
    """The value of a user property; None when there is none of that name."""
    pairs = properties.get(Property.USER_PROPERTY)
    for pair in pairs if isinstance(pairs, list) else ():
        if isinstance(pair, tuple) and pair[0] == name:
            return str(pair[1])
    return None


def _compressor() -> Callable[[bytes], bytes]:
    # Imported when a route asks for it: that takes longer than all else.
    from zstandard import ZstdCompressor

    return ZstdCompressor().compress


def _decompressor(largest: int) -> Callable[[bytes], bytes]:
    from zstandard import ZstdDecompressor, ZstdError, frame_content_size

    decompressor = ZstdDecompressor(max_window_size=ZSTD_WINDOW)

    def decompress(payload: bytes) -> bytes:
        try:
            # A size that is told is made room for, whatever it is: it is looked at first.
            size = frame_content_size(payload)
            if size > largest:
                raise ConversionError("", too_large(size, largest))
            return decompressor.decompress(payload, max_output_size=largest, allow_extra_data=False)
        except ZstdError as error:
            problem = f"not zstd, or more than {largest} bytes of it: {error}"
            raise ConversionError("", problem) from None

    return decompress
