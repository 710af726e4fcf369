"""ROS messages as MQTT payloads: JSON, CBOR, text, to and from ROS's own serialized bytes.

They are called `cdr` here, whatever they are: in ROS 1 they are not CDR (definitions.Wire).

    converters = Converters(load_description)
    twist = converters.get("geometry_msgs/msg/Twist")
    twist.to_json(cdr)      # b'{"linear":{"x":0.5,...
    twist.from_json(b'{"linear": {"x": 0.5}}')     # CDR

No message object is made on the way: code generated once a type (generate.py) goes straight from
one to the other, and the slow way (careful.py) takes over for what is not exactly as expected.
The encodings `cdr` and `ros1` need nothing from here.

JSON, beyond what the word says:

- uint8[], byte[] and char[] are base64; on input a list of numbers will do;
- NaN and infinities are null; null is NaN on input, so an infinity comes back as NaN;
- 64-bit integers are integers, which JavaScript reads as the nearest double;
- a missing field takes its default; an unknown one is an error; of duplicates the last counts;
- a builtin_interfaces/Time may be given as "now".

CBOR is the same with other words for bytes and arrays of numbers, see cbor.py; it has NaN and
infinities. And `binary` is a picture as it is: the bytes of the field `data`.
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

# orjson writes a float32 of a numpy array with the fewest digits that tell it from its neighbours.
# Readers of JSON take digits for a double, and a double for a float32 once more: of all float32
# there is one that this leads to its neighbour (each of the 2**31 was tried).
_TWICE_ROUNDED = b"7.038531e-26"

# Looked up once: these lines run for every message.
_dumps, _loads = orjson.dumps, orjson.loads
_NUMPY = orjson.OPT_SERIALIZE_NUMPY

#: Bytes of a payload up to which fields may be left out, and what is wrong is named: that takes up
#: to a microsecond and a half a byte, all of it on the thread of the event loop.
LARGEST_LENIENT = 64 * 1024


class Converter:
    """Converts messages of one type. All methods raise ConversionError and nothing else.

    With `fields`, paths such as `pose.position`, the `to_` methods give these only. `source` is the
    generated code, for reading.
    """

    def __init__(
        self, description: TypeDescription, now: Callable[[], int], fields: Iterable[str] = ()
    ) -> None:
        """Raises UnknownTypeError for a field that there is not."""
        self.description = description
        self._now = now
        self._wanted = select(description, fields) or None
        self._decode, self._decode_plain, self._encode, self.source = generate(
            description, self._wanted
        )
        #: Made when they are first needed: few routes do.
        self._binary: BinaryDecoder | None = None
        self._checker: Checker | None = None
        self._has_float32_arrays = "read_float32" in self.source

    def to_json(self, cdr: bytes) -> bytes:
        """The JSON of a serialized message, in either byte order."""
        try:
            payload = _dumps(self._decode(cdr), None, _NUMPY)
        except MISFIT:
            return _dumps(self._decode_carefully(cdr))
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
        """The serialized message, as it is safe to hand on: nodes end over one that cannot be read
        (rclpy's over text that is not UTF-16), and rclpy does not look.

        CDR's options become 0, which say how many bytes of padding are at its end: more than there
        are would end a node, too, and fewer are passed over. It may weigh `most` (weigh.py).
        """
        if self._checker is None:
            self._checker = generate_checker(self.description)
        try:
            self._checker.check(cdr, most)
        except OverBudgetError:
            raise TooLargeError("", over_limit(most)) from None
        except MISFIT:
            # Strings that are not UTF-8 take the careful way, which is ten times as long.
            decode(self.description, cdr, strict=True, most=most // FALLBACK_FACTOR)
        return cdr[:2] + b"\0\0" + cdr[4:] if self.description.serialization.header else cdr

    def to_dict(self, cdr: bytes) -> dict[str, Any]:
        """What `to_json` writes, as Python values: lists, floats (NaN among them), base64."""
        try:
            return self._decode_plain(cdr)
        except MISFIT:
            return self._decode_carefully(cdr)

    def from_dict(self, value: object) -> bytes:
        """The serialized message of Python values, by the same rules as JSON; bytes for uint8[]
        will do too."""
        return self._encode(accept(self.description, value, self._now))

    def to_binary_values(self, cdr: bytes) -> dict[str, Any]:
        """The fields with octets as bytes and other arrays of numbers, except bools, as
        `arrays.Numbers`: for encodings that have byte strings."""
        if self._binary is None:
            self._binary = generate_binary(self.description, self._wanted)
        try:
            return self._binary.decode(cdr)
        except MISFIT:
            return self._decode_carefully(cdr, binary=True)

    def from_values(self, value: object, size: int) -> bytes:
        """The serialized message of what a payload of so many bytes was; as `from_dict`, and fast
        for what has exactly the type's fields."""
        try:
            return self._encode(value)
        except MISFIT:
            if size > LARGEST_LENIENT:
                raise ConversionError(
                    "",
                    f"it has not exactly the fields of {self.description.name}; what is left out, "
                    f"or wrong, is looked for in up to {LARGEST_LENIENT} bytes only",
                ) from None
            return self.from_dict(value)

    def _decode_carefully(self, cdr: bytes, *, binary: bool = False) -> dict[str, Any]:
        value = decode(self.description, cdr, binary=binary)
        return value if self._wanted is None else pick(value, self._wanted)


def compile_converter(
    description: TypeDescription, now: Callable[[], int] = time.time_ns
) -> Converter:
    """The converter of a type. `now` gives nanoseconds since the epoch, for `"now"`."""
    return Converter(description, now)


class Converters:
    """A converter a type, compiled when it is first asked for.

    `load` gives the description of a type's name, or raises; so does `get` then.
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
            # Two threads may both come here: one converter is then as good as the other.
            converter = Converter(self._load(type_name), self._now, fields)
            self._converters[type_name, fields] = converter
        return converter

    def bulk(self, type_name: str) -> Bulk:
        """What can make messages of the type large; bytes, if it is not known."""
        known = self._bulk.get(type_name)
        if known is None:
            try:
                known = self._bulk[type_name] = bulk(self._load(type_name))
            except UnknownTypeError:  # it may be known later
                return Bulk.BYTES
        return known
