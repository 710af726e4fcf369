"""The converter of one message type: ROS's serialized bytes to values and JSON, and back.

The serialized bytes are called `cdr` here on both buses, though those of ROS 1 are not CDR
(definitions.Serialization).

    converters = Converters(load_description)
    twist = converters.get("geometry_msgs/msg/Twist")
    twist.to_json(cdr)      # b'{"linear":{"x":0.5,...
    twist.from_json(b'{"linear": {"x": 0.5}}')     # CDR

No message object is created on the way. Code that is generated once a type (codegen.py) converts
directly, and the slow way (fallback.py) takes over when a message is not exactly as expected. The
other encodings (encodings/) are built on the methods of the converter.

The rules of JSON, beyond its specification:

- uint8[], byte[] and char[] are base64; input may also be a list of numbers;
- NaN and infinities are null; null is NaN on input, so an infinity comes back as NaN;
- 64-bit integers are integers, which JavaScript reads as the nearest double;
- a missing field takes its default; an unknown one is an error; of duplicates the last counts;
- a builtin_interfaces/Time may be given as "now".
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

import orjson

from appliance.ros.payload.codegen import (
    MISFIT,
    BinaryDecoder,
    Checker,
    OverBudgetError,
    generate,
    generate_binary,
    generate_checker,
)
from appliance.ros.payload.cost import DEFAULT_ITEMS, FALLBACK_FACTOR, over_limit
from appliance.ros.payload.definitions import (
    Bulk,
    TypeDescription,
    UnknownTypeError,
    bulk,
    select,
)
from appliance.ros.payload.fallback import ConversionError, TooLargeError, accept, decode, pick

__all__ = ["ConversionError", "Converter", "Converters", "TooLargeError", "compile_converter"]

# orjson writes a float32 of a numpy array with the fewest digits that distinguish it from its
# neighbours. Readers of JSON convert digits to a double and then to a float32. For one float32
# these two roundings give its neighbour (each of the 2**31 was tried).
_TWICE_ROUNDED = b"7.038531e-26"

# Looked up once, as they are called for every message.
_dumps, _loads = orjson.dumps, orjson.loads
_NUMPY = orjson.OPT_SERIALIZE_NUMPY

#: Bytes of a payload up to which fields may be missing and errors name the field. Both take the
#: fallback, which needs up to 1.5 µs a byte, all of it on the thread of the event loop.
LARGEST_LENIENT = 64 * 1024


class Converter:
    """Converts messages of one type. All methods raise ConversionError and nothing else.

    With `fields`, paths such as `pose.position`, the `to_` methods return only these. `source` is
    the generated code, for people to read.
    """

    def __init__(
        self, description: TypeDescription, now: Callable[[], int], fields: Iterable[str] = ()
    ) -> None:
        """Raises UnknownTypeError for a field that the type does not have."""
        self.description = description
        self._now = now
        self._wanted = select(description, fields) or None
        self._decode, self._decode_plain, self._encode, self.source = generate(
            description, self._wanted
        )
        #: Generated on first use: few routes need them.
        self._binary: BinaryDecoder | None = None
        self._checker: Checker | None = None
        self._has_float32_arrays = "read_float32" in self.source

    def to_json(self, cdr: bytes) -> bytes:
        """The JSON of a serialized message, in either byte order."""
        try:
            payload = _dumps(self._decode(cdr), None, _NUMPY)
        except MISFIT:
            return _dumps(self._decode_slowly(cdr))
        if self._has_float32_arrays and _TWICE_ROUNDED in payload:
            return _dumps(self._decode_plain(cdr))
        return payload

    def from_json(self, payload: bytes) -> bytes:
        """The serialized message, in little endian, of its JSON."""
        try:
            value = _loads(payload)
        except orjson.JSONDecodeError as error:
            raise ConversionError("", f"not JSON: {error}") from None
        return self.from_values(value, len(payload))

    def checked(self, cdr: bytes, most: int = DEFAULT_ITEMS) -> bytes:
        """The serialized message, checked so that it is safe to publish.

        rclpy publishes bytes unchecked, and a message that cannot be read crashes the nodes that
        receive it (those of rclpy also over text that is not UTF-16). CDR's options say how many
        bytes of padding are at the end; they become 0, as a count beyond the message would crash a
        node, too, and readers ignore the padding. The message may cost up to `most` (cost.py).
        """
        if self._checker is None:
            self._checker = generate_checker(self.description)
        try:
            self._checker.check(cdr, most)
        except OverBudgetError:
            raise TooLargeError("", over_limit(most)) from None
        except MISFIT:
            # Strings that are not UTF-8 take the fallback, which is ten times as slow.
            decode(self.description, cdr, strict=True, most=most // FALLBACK_FACTOR)
        return cdr[:2] + b"\0\0" + cdr[4:] if self.description.serialization.header else cdr

    def to_dict(self, cdr: bytes) -> dict[str, Any]:
        """What `to_json` writes, as Python values: lists, floats (NaN among them), base64."""
        try:
            return self._decode_plain(cdr)
        except MISFIT:
            return self._decode_slowly(cdr)

    def from_dict(self, value: object) -> bytes:
        """The serialized message of Python values, by the rules of JSON; uint8[] may also be given
        as bytes."""
        return self._encode(accept(self.description, value, self._now))

    def to_binary_values(self, cdr: bytes) -> dict[str, Any]:
        """The fields with octets as bytes and other arrays of numbers, except bools, as
        `arrays.Numbers`: for encodings that have byte strings."""
        if self._binary is None:
            self._binary = generate_binary(self.description, self._wanted)
        try:
            return self._binary.decode(cdr)
        except MISFIT:
            return self._decode_slowly(cdr, binary=True)

    def from_values(self, value: object, size: int) -> bytes:
        """The serialized message of the values that a payload of `size` bytes had.

        As `from_dict`, but fast when the values have exactly the fields of the type. Raises
        ConversionError when they have not and the payload is larger than LARGEST_LENIENT.
        """
        try:
            return self._encode(value)
        except MISFIT:
            if size > LARGEST_LENIENT:
                raise ConversionError(
                    "",
                    f"it does not have exactly the fields of {self.description.name}; missing "
                    f"fields are filled in, and wrong ones named, in up to {LARGEST_LENIENT} bytes",
                ) from None
            return self.from_dict(value)

    def _decode_slowly(self, cdr: bytes, *, binary: bool = False) -> dict[str, Any]:
        value = decode(self.description, cdr, binary=binary)
        return value if self._wanted is None else pick(value, self._wanted)


def compile_converter(
    description: TypeDescription, now: Callable[[], int] = time.time_ns
) -> Converter:
    """The converter of a type. `now` gives nanoseconds since the epoch, for `"now"`."""
    return Converter(description, now)


class Converters:
    """A cache of converters, each compiled when it is first requested.

    `load` returns the description of a type by its name. What it raises, `get` raises.
    """

    def __init__(
        self, load: Callable[[str], TypeDescription], now: Callable[[], int] = time.time_ns
    ) -> None:
        self._load = load
        self._now = now
        self._converters: dict[tuple[str, tuple[str, ...]], Converter] = {}
        self._bulk: dict[str, Bulk] = {}

    def get(self, type_name: str, fields: tuple[str, ...] = ()) -> Converter:
        """The converter of a type by its name, `std_msgs/msg/String`, or of some of its fields."""
        converter = self._converters.get((type_name, fields))
        if converter is None:
            # Two threads may both get here; their converters are interchangeable.
            converter = Converter(self._load(type_name), self._now, fields)
            self._converters[type_name, fields] = converter
        return converter

    def bulk(self, type_name: str) -> Bulk:
        """What can make messages of the type large; BYTES when the type is not known."""
        known = self._bulk.get(type_name)
        if known is None:
            try:
                known = self._bulk[type_name] = bulk(self._load(type_name))
            except UnknownTypeError:  # not cached: the type may become known later
                return Bulk.BYTES
        return known
