"""MQTT payloads of a route: encoding, compression, size limits, and the properties of MQTT 5."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from appliance.mqtt.codec import Properties, Property
from appliance.ros.payload.converter import Converter
from appliance.ros.payload.cost import DEFAULT_ITEMS, over_limit
from appliance.ros.payload.encodings.base import Encoding, EncodingName, PictureOptions
from appliance.ros.payload.encodings.registry import ENCODINGS
from appliance.ros.payload.fallback import ConversionError, TooLargeError

Compression: TypeAlias = Literal["none", "zstd"]

#: The user property that names the compression, for which MQTT 5 has no property of its own.
CONTENT_ENCODING = "content-encoding"

#: The first bytes of a zstd frame (RFC 8878). No message in any encoding begins with these.
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

#: Bytes of history that a zstd frame may refer to: RFC 8878 asks this of every decoder.
ZSTD_WINDOW = 8 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class InputLimits:
    """Limits of one message for ROS: all others wait while it is converted.

    `payload` limits the bytes of text encodings such as JSON, where each byte is work; `packet`
    limits the bytes of the others, which are mostly copied. `items` limits the cost (cost.py).
    """

    payload: int = 1024 * 1024
    packet: int = 16 * 1024 * 1024
    items: int = DEFAULT_ITEMS

    def largest(self, encoding: Encoding) -> int:
        """Bytes that a payload in that encoding may have, decompressed."""
        return min(self.payload, self.packet) if encoding.is_text else self.packet

    def check_size(self, size: int, encoding: Encoding) -> None:
        """Raises TooLargeError for a payload of more bytes than are converted."""
        largest = self.largest(encoding)
        if size > largest:
            key = "broker.limits.packet_size" if largest == self.packet else "bridge.limits.payload"
            raise TooLargeError("", f"it has {size} bytes, at most {largest} are converted ({key})")

    def check(self, payload: bytes, encoding: Encoding) -> None:
        """Raises TooLargeError for a payload that costs more than it may, as far as the encoding
        sees that before it decodes the payload."""
        self.check_size(len(payload), encoding)
        if encoding.cost(payload, self.items) > self.items:
            raise TooLargeError("", over_limit(self.items))


def packer(
    converter: Converter | None,
    encoding: EncodingName,
    compression: Compression,
    about: list[tuple[str, str]],
    picture: PictureOptions = PictureOptions(),  # noqa: B008 - it is frozen
) -> Callable[[bytes], tuple[bytes, Properties]]:
    """The function that makes payload and properties of a serialized message.

    `about` are user properties. `converter` may be None for encodings of ROS's own bytes. The
    function raises ConversionError.
    """
    if compression != "none":
        about = [*about, (CONTENT_ENCODING, compression)]
    properties: Properties = {
        Property.CONTENT_TYPE: ENCODINGS[encoding].content_type,
        Property.USER_PROPERTY: about,
    }
    pack = ENCODINGS[encoding].with_picture(picture).packer(converter, properties)
    if compression == "none":
        return pack
    compress = _compressor()

    def pack_compressed(cdr: bytes) -> tuple[bytes, Properties]:
        payload, properties = pack(cdr)
        return compress(payload), properties

    return pack_compressed


def unpacker(
    converter: Converter, encoding: EncodingName, compression: Compression, limits: InputLimits
) -> Callable[[bytes], bytes]:
    """The function that makes a serialized message of a payload, or raises ConversionError.

    With a compression, payloads may be compressed or not, and are measured decompressed.
    """
    described = ENCODINGS[encoding]
    decode = described.decoder(converter, limits.items)

    def unpack(payload: bytes) -> bytes:
        limits.check(payload, described)
        return decode(payload)

    if compression == "none":
        return unpack
    decompress = _decompressor(limits, described)

    def unpack_compressed(payload: bytes) -> bytes:
        if payload.startswith(ZSTD_MAGIC):
            payload = decompress(payload)
        return unpack(payload)

    return unpack_compressed


def user_property(properties: Properties, name: str) -> str | None:
    """The value of a user property; None when there is none of that name."""
    pairs = properties.get(Property.USER_PROPERTY)
    for pair in pairs if isinstance(pairs, list) else ():
        if isinstance(pair, tuple) and pair[0] == name:
            return str(pair[1])
    return None


def _compressor() -> Callable[[bytes], bytes]:
    # Imported when a route compresses: the import takes longer than all else here.
    from zstandard import ZstdCompressor

    return ZstdCompressor().compress


def unpacked_size(payload: bytes) -> float:
    """Bytes of the payload after decompression, where it is compressed; infinity when unknown."""
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
            # zstandard allocates the size that the frame announces, so that is checked first.
            limits.check_size(frame_content_size(payload), encoding)
            return decompressor.decompress(payload, max_output_size=largest, allow_extra_data=False)
        except ZstdError as error:
            problem = f"not zstd, or more than {largest} bytes of it: {error}"
            raise ConversionError("", problem) from None

    return decompress
