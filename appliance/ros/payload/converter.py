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

import math
import re
import time
from collections.abc import Callable, Iterable
from typing import Any

import orjson

from appliance.ros.payload import cbor
from appliance.ros.payload.codegen import (
    MISFIT,
    Binary,
    Checker,
    OverBudgetError,
    generate,
    generate_binary,
    generate_checker,
)
from appliance.ros.payload.cost import CAREFUL, ITEMS, too_much
from appliance.ros.payload.definitions import (
    PRIMITIVES,
    Bulk,
    Primitive,
    Sequence,
    String,
    TypeDescription,
    UnknownTypeError,
    WideString,
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

_INTEGER = re.compile(r"\s*([+-]?[0-9]{1,20})\s*\Z", re.ASCII)
_FLOAT = re.compile(
    r"\s*([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?|[+-]?inf(?:inity)?|nan)\s*\Z",
    re.ASCII | re.IGNORECASE,
)
_BOOLS = {"true": True, "false": False}

#: Bytes of a payload up to which fields may be left out, and what is wrong is named: that takes up
#: to a microsecond and a half a byte, all of it on the thread of the event loop.
LARGEST_LENIENT = 64 * 1024


#: What is wrong with a type that cannot go as `binary`.
NO_BINARY = "cannot go as binary: only a type with a field `data` of bytes, such as CompressedImage"

_OCTETS = frozenset(p for p in PRIMITIVES.values() if p.is_octet)

#: What pictures begin with; a WebP has its size between the two.
_IMAGES = ((b"\xff\xd8\xff", b"", "jpeg"), (b"\x89PNG", b"", "png"), (b"RIFF", b"WEBP", "webp"))


def image_format(data: bytes) -> str:
    """`jpeg`, `png` or `webp`, or nothing when the bytes are something else."""
    for start, later, name in _IMAGES:
        if data.startswith(start) and data.startswith(later, 8):
            return name
    return ""


class Converter:
    """Converts messages of one type. All methods raise ConversionError and nothing else.

    With `fields`, paths such as `pose.position`, the `to_` methods give these only. `has_text` and
    `has_binary` tell whether the type can go as these; `source` is the generated code, for reading.
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
        self._binary: Binary | None = None
        self._data: Binary | None = None
        self._checker: Checker | None = None
        self._has_float32_arrays = "read_float32" in self.source
        self._text_type = _text_type(description)

    @property
    def has_text(self) -> bool:
        return self._text_type is not None

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

    def checked(self, cdr: bytes, most: int = ITEMS) -> bytes:
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
            raise TooLargeError("", too_much(most)) from None
        except MISFIT:
            # Strings that are not UTF-8 take the careful way, which is ten times as long.
            decode(self.description, cdr, strict=True, most=most // CAREFUL)
        return cdr[:2] + b"\0\0" + cdr[4:] if self.description.wire.header else cdr

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

    def to_cbor(self, cdr: bytes) -> bytes:
        """The CBOR of a serialized message, in either byte order."""
        return cbor.dumps(self.to_cbor_value(cdr))

    def to_cbor_value(self, cdr: bytes) -> dict[str, Any]:
        """What `to_cbor` writes, as Python values that `cbor.dumps` takes."""
        if self._binary is None:
            self._binary = generate_binary(self.description, self._wanted)
        try:
            return self._binary.decode(cdr)
        except MISFIT:
            return self._decode_carefully(cdr, binary=True)

    def from_cbor(self, payload: bytes) -> bytes:
        """The serialized message, in little endian, of its CBOR."""
        return self.from_values(cbor.loads(payload, as_numbers=True), len(payload))

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

    @property
    def has_binary(self) -> bool:
        fields = {field.name: field.type for field in self.description.fields}
        data = fields.get("data")
        return isinstance(data, Sequence) and data.item in _OCTETS and data.bound is None

    def to_binary(self, cdr: bytes) -> bytes:
        """The bytes of the field `data`."""
        if not self.has_binary:
            raise ConversionError("", f"{self.description.name} {NO_BINARY}")
        if self._data is None:
            self._data = generate_binary(self.description, {"data": None})
        try:
            data = self._data.decode(cdr)["data"]
        except MISFIT:
            data = decode(self.description, cdr, binary=True)["data"]
        assert isinstance(data, bytes)
        return data

    def from_binary(self, payload: bytes) -> bytes:
        """The serialized message with these bytes as `data`, and as `format`, where there is one,
        what they begin like: `jpeg`, `png`."""
        if not self.has_binary:
            raise ConversionError("", f"{self.description.name} {NO_BINARY}")
        value: dict[str, object] = {"data": payload}
        if any(field.name == "format" for field in self.description.fields):
            value["format"] = image_format(payload)
        return self.from_dict(value)

    def to_text(self, cdr: bytes) -> bytes:
        """The text of a message whose only field is `data`: true and false, the digits of a
        number (nan, inf, -inf), the characters of a string."""
        self._text_field()
        data = self.to_dict(cdr)["data"]
        if isinstance(data, bool):
            return b"true" if data else b"false"
        return str(data).encode()

    def from_text(self, payload: bytes) -> bytes:
        """The serialized message of its text. White space around numbers and bools is ignored."""
        type_ = self._text_field()
        try:
            text = payload.decode()
        except UnicodeDecodeError:
            raise ConversionError("data", "not UTF-8") from None
        value = {"data": _parse(type_, text)}
        try:
            return self._encode(value)
        except MISFIT:
            return self.from_dict(value)

    def _text_field(self) -> Primitive | String | WideString:
        if self._text_type is None:
            raise ConversionError(
                "",
                f"{self.description.name} cannot go as text: only a type whose one field is "
                "`data`, a number, bool or string",
            )
        return self._text_type


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


def _text_type(description: TypeDescription) -> Primitive | String | WideString | None:
    if len(description.fields) != 1 or description.fields[0].name != "data":
        return None
    type_ = description.fields[0].type
    return type_ if isinstance(type_, (Primitive, String, WideString)) else None


def _parse(type_: Primitive | String | WideString, text: str) -> object:
    """The value of a text; what is not one is left as it is, for `accept` to refuse."""
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
    if math.isinf(value) and "inf" not in text.lower():  # it overflowed on the way
        raise ConversionError("data", f"{text.strip()[:40]} does not fit in {type_.name}")
    return value
