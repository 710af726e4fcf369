"""What a route puts on MQTT and takes from it: an encoding, compressed or not, and what MQTT 5 says
about it in properties.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeAlias

import orjson

from appliance.mqtt.codec import Properties, Property
from appliance.ros.payload import cbor
from appliance.ros.payload.converter import NO_BINARY, Converter, image_format
from appliance.ros.payload.cost import ITEMS, too_much, weigh_cbor, weigh_json
from appliance.ros.payload.definitions import CDR, PACKED, Serialization, UnknownTypeError
from appliance.ros.payload.fallback import ConversionError, TooLargeError

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
RAW: dict[str, Serialization] = {wire.encoding: wire for wire in (CDR, PACKED)}

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


@dataclass(frozen=True, slots=True)
class InputLimits:
    """What one message for ROS may be, as all others wait while it is converted.

    `payload` are bytes of JSON and of text, where each byte is work; `packet` of what else there
    is, which is mostly copied. `items` is what it may weigh (weigh.py).
    """

    payload: int = 1024 * 1024
    packet: int = 16 * 1024 * 1024
    items: int = ITEMS

    def largest(self, encoding: Encoding) -> int:
        """Bytes that a payload in that encoding may have, decompressed."""
        return min(self.payload, self.packet) if encoding in ("json", "text") else self.packet

    def check_size(self, size: int, encoding: Encoding) -> None:
        """Raises TooLargeError for a payload of more bytes than are converted."""
        largest = self.largest(encoding)
        if size > largest:
            key = "broker.limits.packet_size" if largest == self.packet else "bridge.limits.payload"
            raise TooLargeError("", f"it has {size} bytes, at most {largest} are converted ({key})")

    def check(self, payload: bytes, encoding: Encoding) -> None:
        """Raises TooLargeError for a payload that is more work than it may be: what ROS's own bytes
        are is seen only when these are read."""
        self.check_size(len(payload), encoding)
        items = self.items
        if encoding == "json" and weigh_json(payload, items) > items:
            raise TooLargeError("", too_much(items))
        if encoding == "cbor" and weigh_cbor(payload, items) > items:
            raise TooLargeError("", too_much(items))


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
    converter: Converter, encoding: Encoding, compression: Compression, limits: InputLimits
) -> Callable[[bytes], bytes]:
    """The function that makes a serialized message of a payload, or raises ConversionError.

    With a compression, payloads may be compressed or not, and are measured decompressed.
    """
    checked = partial(converter.checked, most=limits.items)
    ways: dict[Encoding, Callable[[bytes], bytes]] = {
        "json": converter.from_json,
        "cbor": converter.from_cbor,
        "text": converter.from_text,
        "binary": converter.from_binary,
        "cdr": checked,
        "ros1": checked,
    }
    convert = ways[encoding]

    def unpack(payload: bytes) -> bytes:
        limits.check(payload, encoding)
        return convert(payload)

    if compression == "none":
        return unpack
    decompress = _decompressor(limits, encoding)

    def unpack_compressed(payload: bytes) -> bytes:
        if payload.startswith(ZSTD_MAGIC):
            payload = decompress(payload)
        return unpack(payload)

    return unpack_compressed


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


def unpacked_size(payload: bytes) -> float:
    """Bytes of the payload when it is decompressed, if it was compressed; infinity when unknown."""
    if not payload.startswith(ZSTD_MAGIC):
        return len(payload)
    from zstandard import ZstdError, frame_content_size

    try:
        size = frame_content_size(payload)
    except ZstdError:
        return math.inf
    return size if size >= 0 else math.inf


def _decompressor(limits: InputLimits, encoding: Encoding) -> Callable[[bytes], bytes]:
    from zstandard import ZstdDecompressor, ZstdError, frame_content_size

    largest = limits.largest(encoding)
    decompressor = ZstdDecompressor(max_window_size=ZSTD_WINDOW)

    def decompress(payload: bytes) -> bytes:
        try:
            # A size that is told is made room for, whatever it is: it is looked at first.
            limits.check_size(frame_content_size(payload), encoding)
            return decompressor.decompress(payload, max_output_size=largest, allow_extra_data=False)
        except ZstdError as error:
            problem = f"not zstd, or more than {largest} bytes of it: {error}"
            raise ConversionError("", problem) from None

    return decompress
