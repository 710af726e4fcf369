"""What an encoding is: one way to write a ROS message in an MQTT payload.

To add one, subclass `Encoding` in a module of its own and list it in registry.py; the test of the
registry then names the line of the configuration that lets users choose it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

from appliance.mqtt.codec import Properties
from appliance.ros.payload.converter import Converter
from appliance.ros.payload.definitions import Serialization

EncodingName: TypeAlias = str
"""What the configuration calls an encoding: `json`."""

Encode: TypeAlias = Callable[[bytes], bytes]
Decode: TypeAlias = Callable[[bytes], bytes]
Pack: TypeAlias = Callable[[bytes], tuple[bytes, Properties]]


@dataclass(frozen=True, slots=True)
class PictureOptions:
    """How pictures are made of images: JPEG's quality, 1 to 95, and the width that they may have,
    in pixels."""

    quality: int = 80
    max_width: int | None = None


class Encoding(ABC):
    """One way to write a ROS message in an MQTT payload.

    An encoding has no state. `encoder` and `decoder` are called once a route and return the
    function that runs for every message, so that this needs no lookups.
    """

    #: What the configuration calls it.
    name: EncodingName
    #: The Content Type of MQTT 5.
    content_type: str
    #: Whether payloads are characters: each byte is then work, and `bridge.limits.payload` limits
    #: the size. Other payloads are mostly copied; `broker.limits.packet_size` limits these.
    is_text = False
    #: Whether a message takes milliseconds: it is converted on a thread, `topics/off_loop.py`.
    is_slow = False
    #: How ROS serializes the payload, where the payload is ROS's own bytes. No converter is needed
    #: for these on the way to MQTT, so that types without a known definition can go.
    serialization: Serialization | None = None

    @property
    def can_call(self) -> bool:
        """Whether calls of services and actions may use it."""
        return self.serialization is not None

    def with_picture(self, options: PictureOptions) -> Encoding:
        """The same with other options, where these mean something to it."""
        return self

    def check(self, converter: Converter, *, to_ros: bool) -> None:  # noqa: B027 - most take any
        """Raises UnknownTypeError when messages of the type cannot go in this encoding."""

    @abstractmethod
    def encoder(self, converter: Converter) -> Encode:
        """The function that makes a payload of a serialized message. It raises ConversionError."""

    @abstractmethod
    def decoder(self, converter: Converter, items: int) -> Decode:
        """The function that makes a serialized message of a payload. It raises ConversionError.

        `items` is the cost that is allowed (cost.py), for what `cost` cannot see beforehand.
        """

    def cost(self, payload: bytes, most: int) -> int:
        """What decoding the payload costs (cost.py), as far as can be seen before; any number
        above `most` when it is more than that."""
        return 0

    def packer(self, converter: Converter | None, properties: Properties) -> Pack:
        """The function that makes payload and properties of a serialized message."""
        assert converter is not None
        encode = self.encoder(converter)

        def pack(cdr: bytes) -> tuple[bytes, Properties]:
            return encode(cdr), properties

        return pack


class ValueEncoding(Encoding):
    """An encoding of any value, not of ROS messages alone: JSON and CBOR.

    Some of a message's fields can go in it, and what calls and parameters have beside messages.
    """

    #: Whether it has byte strings, where JSON has base64.
    has_bytes = False

    @property
    def can_call(self) -> bool:
        return True

    @abstractmethod
    def dumps(self, value: object) -> bytes:
        """The payload of a value."""

    @abstractmethod
    def loads(self, payload: bytes) -> Any:
        """The value of a payload. Raises ConversionError."""

    @abstractmethod
    def values(self, converter: Converter, cdr: bytes) -> dict[str, Any]:
        """The fields of a serialized message, as values that `dumps` takes. Raises
        ConversionError."""


class SerializedEncoding(Encoding):
    """ROS's own bytes, which pass as they are: on the way to ROS they are checked."""

    serialization: Serialization

    def encoder(self, converter: Converter) -> Encode:
        return bytes

    def decoder(self, converter: Converter, items: int) -> Decode:
        def decode(payload: bytes) -> bytes:
            return converter.checked(payload, items)

        return decode

    def packer(self, converter: Converter | None, properties: Properties) -> Pack:
        def pack(cdr: bytes) -> tuple[bytes, Properties]:
            return cdr, properties

        return pack
