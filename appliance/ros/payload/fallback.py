"""The slow and exact conversion, which walks the description of a type.

Generated converters (codegen.py) accept only messages that are exactly as expected, and check just
enough to be sure of that. They leave all other messages to this module. It corrects what the
conventions allow (a missing field, `null`, `"now"`, a list for bytes, big-endian CDR, text that is
not UTF-8), and refuses the rest with a ConversionError that names the field.
"""

from __future__ import annotations

import json
import struct
from binascii import Error as Base64Error
from collections.abc import Callable
from difflib import get_close_matches
from math import inf, nan
from typing import Any

import pybase64

from appliance.ros.payload.arrays import Numbers
from appliance.ros.payload.cost import CONTAINER_COST, DEFAULT_ITEMS, cost_of, over_limit
from appliance.ros.payload.definitions import (
    TIME,
    Array,
    Field,
    FieldType,
    ItemType,
    Primitive,
    Selection,
    Sequence,
    Serialization,
    String,
    TypeDescription,
    WideString,
    least_size,
)

# How much of a wrong value an error message quotes.
_QUOTED = 40


class ConversionError(ValueError):
    """A message that cannot be converted.

    `path` names the field (`linear.x`, `poses[3].position`), and is empty for the message as a
    whole. `problem` says what is wrong with it.
    """

    def __init__(self, path: str, problem: str) -> None:
        super().__init__(f"{path}: {problem}" if path else problem)
        self.path = path
        self.problem = problem


class TooLargeError(ConversionError):
    """A message that exceeds a limit of size or cost."""


# --- CDR to values --------------------------------------------------------------------------


def decode(
    description: TypeDescription,
    cdr: bytes,
    *,
    binary: bool = False,
    strict: bool = False,
    most: float = inf,
) -> dict[str, Any]:
    """The value of a serialized message.

    uint8[], byte[] and char[] become base64, as in JSON; when `binary`, they become bytes, and
    other arrays of numbers, except bools, `Numbers`. Bytes after the message are ignored, as every
    DDS does: some senders pad at the end. Text that is not UTF-8 (or UTF-16) has U+FFFD in place of
    the wrong parts. When `strict`, text that is not UTF-16 is refused, as rclpy cannot read it, and
    so is a string beyond its bound. Raises ConversionError, and TooLargeError for a
    message that costs more than `most` (cost.py).
    """
    order = "<"
    if description.serialization.header:
        if len(cdr) < 4:
            raise ConversionError("", "truncated: not even CDR's header of four bytes")
        if cdr[0] != 0 or cdr[1] > 1:
            raise ConversionError("", f"not plain CDR: representation {cdr[0]:02x} {cdr[1]:02x}")
        order = "<" if cdr[1] else ">"
    budget = _Budget(most)
    return _CdrReader(cdr, description.serialization, order, binary, strict, budget).structure(
        description, ""
    )


def pick(value: Any, wanted: Selection) -> Any:
    """The selected fields of a message's value, or of each in a list."""
    if isinstance(value, list):
        return [pick(item, wanted) for item in value]
    return {
        name: inside if wanted[name] is None else pick(inside, wanted[name] or {})
        for name, inside in value.items()
        if name in wanted
    }


class _Budget:
    """The cost that is left for a message."""

    def __init__(self, most: float) -> None:
        self._most = self._left = most

    def spend(self, cost: int) -> None:
        """Raises TooLargeError when less than `cost` is left."""
        self._left -= cost
        if self._left < 0:
            raise TooLargeError("", over_limit(int(self._most)))


class _CdrReader:
    """A position in the bytes of one message."""

    def __init__(
        self,
        cdr: bytes,
        serialization: Serialization,
        order: str,
        binary: bool,
        strict: bool,
        budget: _Budget,
    ) -> None:
        self._cdr = cdr
        self._serialization = serialization
        self._order = order
        self._binary = binary
        self._strict = strict
        self._budget = budget
        self._position = len(serialization.header)

    def structure(self, description: TypeDescription, path: str) -> dict[str, Any]:
        if not description.fields:
            self._take(len(self._serialization.empty), path)
        return {
            field.name: self._value(field.type, _join(path, field.name))
            for field in description.fields
        }

    def _value(self, type_: FieldType, path: str) -> Any:
        if isinstance(type_, Primitive):
            return self._numbers(type_, 1, path)[0]
        if isinstance(type_, (String, WideString)):
            text = self._string(path) if isinstance(type_, String) else self._wide_string(path)
            if self._strict:
                _check_bound(type_, text, path)
            return text
        if isinstance(type_, Array):
            return self._items(type_.item, type_.length, path)
        if isinstance(type_, Sequence):
            count = self._count(least_size(type_.item), path)
            if type_.bound is not None and count > type_.bound:
                raise ConversionError(path, f"{count} items, at most {type_.bound} are allowed")
            return self._items(type_.item, count, path)
        return self.structure(type_, path)

    def _items(self, item: ItemType, count: int, path: str) -> Any:
        if isinstance(item, Primitive):
            if item.is_octet:
                octets = self._take(count, path)
                return octets if self._binary else pybase64.b64encode_as_string(octets)
            self._budget.spend(count)
            numbers = self._numbers(item, count, path)
            if self._binary and item.name != "bool":
                return Numbers(item, struct.pack(f"<{count}{item.code}", *numbers))
            return list(numbers)
        self._budget.spend(count * cost_of(item))
        return [self._value(item, f"{path}[{i}]") for i in range(count)]

    def _numbers(self, primitive: Primitive, count: int, path: str) -> tuple[Any, ...]:
        if not count:
            return ()  # nothing, and no padding either
        self._align(primitive.size)
        chunk = self._take(count * primitive.size, path)
        return struct.unpack(f"{self._order}{count}{primitive.code}", chunk)

    def _count(self, size: int, path: str) -> int:
        """The count of items that take at least `size` bytes each, or of a string's bytes."""
        self._align(4)
        (count,) = struct.unpack(f"{self._order}I", self._take(4, path))
        assert isinstance(count, int)
        left = len(self._cdr) - self._position
        if count * size > left:
            raise ConversionError(
                path, f"truncated: it announces {count} items, and {left} bytes are left"
            )
        return count

    def _string(self, path: str) -> str:
        # The count includes the final NUL. Some senders count 0 for an empty string, without NUL.
        chunk = self._take(self._count(1, path), path)
        return chunk.removesuffix(self._serialization.terminator).decode("utf-8", "replace")

    def _wide_string(self, path: str) -> str:
        # Every rmw writes 16-bit units, each in four bytes, without a final NUL.
        count = self._count(4, path)
        units = self._numbers(_UNIT, count, path)
        if any(unit > 0xFFFF for unit in units):
            raise ConversionError(path, "not UTF-16")
        text = struct.pack(f"<{count}H", *units)
        try:
            return text.decode("utf-16-le", "strict" if self._strict else "replace")
        except UnicodeDecodeError:
            raise ConversionError(path, "not UTF-16") from None

    def _align(self, size: int) -> None:
        # Alignment counts from the end of the header.
        past = self._position - len(self._serialization.header)
        self._position += -past % min(size, self._serialization.alignment)

    def _take(self, size: int, path: str) -> bytes:
        chunk = self._cdr[self._position : self._position + size]
        if len(chunk) < size:
            raise ConversionError(path, f"truncated: the message ends at byte {len(self._cdr)}")
        self._position += size
        return chunk


_UNIT = Primitive("uint32", "I", 4)


# --- JSON's values, checked -----------------------------------------------------------------


def accept(
    description: TypeDescription, value: object, now: Callable[[], int], most: float = DEFAULT_ITEMS
) -> dict[str, Any]:
    """`value` as a complete message: checked to the last item by the conventions' rules for input.

    The result has exactly the fields of the type: missing fields have their defaults, null becomes
    NaN, and uint8[], byte[] and char[] become bytes. `now` returns nanoseconds since the epoch.
    Raises ConversionError, and TooLargeError for a message that costs more than `most` (cost.py)
    with its defaults, which make a large message of a few bytes.
    """
    return _InputChecker(now, description.serialization, _Budget(most)).structure(
        description, value, ""
    )


class _InputChecker:
    def __init__(
        self, now: Callable[[], int], serialization: Serialization, budget: _Budget
    ) -> None:
        self._now = now
        self._serialization = serialization
        self._budget = budget

    def structure(self, description: TypeDescription, value: object, path: str) -> dict[str, Any]:
        if value == "now" and description.name == TIME:
            sec, nanosec = divmod(self._now(), 1_000_000_000)
            value = {"sec": sec, "nanosec": nanosec}
        if not isinstance(value, dict):
            raise ConversionError(path, f"expected an object, got {_show(value)}")
        self._budget.spend(CONTAINER_COST + len(description.fields))
        names = [field.name for field in description.fields]
        for name in value:
            if name not in names:
                raise ConversionError(_join(path, _quote(str(name))), _unknown(str(name), names))
        return {
            field.name: self._value(field.type, value[field.name], _join(path, field.name))
            if field.name in value
            else self._default(field)
            for field in description.fields
        }

    def _default(self, field: Field) -> Any:
        self._budget.spend(cost_of(field.type))
        return default(field)

    def _value(self, type_: FieldType, value: object, path: str) -> Any:
        if isinstance(type_, Primitive):
            return _number(type_, value, path)
        if isinstance(type_, (String, WideString)):
            return self._text(type_, value, path)
        if isinstance(type_, TypeDescription):
            return self.structure(type_, value, path)
        items = self._items(type_.item, value, path)
        if isinstance(type_, Array) and len(items) != type_.length:
            raise ConversionError(path, f"{len(items)} items, expected exactly {type_.length}")
        if isinstance(type_, Sequence) and type_.bound is not None and len(items) > type_.bound:
            raise ConversionError(path, f"{len(items)} items, at most {type_.bound} are allowed")
        return items

    def _items(self, item: ItemType, value: object, path: str) -> Any:
        if isinstance(item, Primitive) and item.is_octet:
            if isinstance(value, str):
                return _base64(value, path)
            if isinstance(value, (bytes, bytearray, memoryview)):
                return bytes(value)
            if isinstance(value, Numbers) and value.primitive.name == "uint8":
                return value.data
            value = value.listed() if isinstance(value, Numbers) else value
            if not isinstance(value, (list, tuple)):
                raise ConversionError(path, f"expected base64 or an array, got {_show(value)}")
            if _all_fit(item, value):
                return bytes(value)
            return bytes(_number(item, x, f"{path}[{i}]") for i, x in enumerate(value))
        value = value.listed() if isinstance(value, Numbers) else value
        if not isinstance(value, (list, tuple)):
            raise ConversionError(path, f"expected an array, got {_show(value)}")
        self._budget.spend(len(value) * (1 if isinstance(item, Primitive) else CONTAINER_COST))
        if isinstance(item, Primitive) and _all_fit(item, value):
            return list(value)
        return [self._value(item, x, f"{path}[{i}]") for i, x in enumerate(value)]

    def _text(self, type_: String | WideString, value: object, path: str) -> str:
        if not isinstance(value, str):
            raise ConversionError(path, f"expected a string, got {_show(value)}")
        _check_bound(type_, value, path)
        is_ended = isinstance(type_, String) and self._serialization.terminator
        if is_ended and "\0" in value:
            # Strings end at NUL in C and in rclpy: the characters behind it would be lost.
            raise ConversionError(path, "a ROS string cannot hold the character U+0000")
        return value


def default(field: Field) -> Any:
    """The value of a field that a message does not have."""
    return _zero(field.type) if field.default is None else field.default


def _zero(type_: FieldType) -> Any:
    if isinstance(type_, Primitive):
        return False if type_.name == "bool" else 0
    if isinstance(type_, (String, WideString)):
        return ""
    if isinstance(type_, TypeDescription):
        return {field.name: default(field) for field in type_.fields}
    length = type_.length if isinstance(type_, Array) else 0
    if isinstance(type_.item, Primitive) and type_.item.is_octet:
        return bytes(length)
    return [_zero(type_.item)] * length


def _all_fit(primitive: Primitive, values: list[Any] | tuple[Any, ...]) -> bool:
    """Whether all values are numbers of the right type and range: a fast check for the usual
    case."""
    if primitive.name == "bool" or not _NUMBERS[primitive.is_float].issuperset(map(type, values)):
        return False
    try:
        struct.pack(f"<{len(values)}{primitive.code}", *values)
    except (OverflowError, struct.error):
        return False
    return True


# The Python types of integers, and of floats.
_NUMBERS = (frozenset({int}), frozenset({int, float}))


def _number(primitive: Primitive, value: object, path: str) -> Any:
    if primitive.name == "bool":
        if isinstance(value, bool):
            return value
        raise ConversionError(path, f"expected true or false, got {_show(value)}")
    if value is None and primitive.is_float:
        return nan
    number: int | float
    try:
        if primitive.is_float and isinstance(value, (int, float)) and not isinstance(value, bool):
            number = float(value)
        elif isinstance(value, int) and not isinstance(value, bool) and not primitive.is_float:
            number = int(value)
        else:
            expected = "a number" if primitive.is_float else "an integer"
            raise ConversionError(path, f"expected {expected}, got {_show(value)}")
        struct.pack(f"<{primitive.code}", number)
    except (OverflowError, struct.error):
        raise ConversionError(path, f"{_show(value)} does not fit in {primitive.name}") from None
    return number


def _check_bound(type_: String | WideString, text: str, path: str) -> None:
    wide = isinstance(type_, WideString)
    try:
        size = len(text.encode("utf-16-le")) // 2 if wide else len(text.encode())
    except UnicodeEncodeError:
        raise ConversionError(path, "the string has half a surrogate pair in it") from None
    if type_.bound is not None and size > type_.bound:
        unit = "units of UTF-16" if wide else "bytes of UTF-8"
        raise ConversionError(path, f"{size} {unit}, at most {type_.bound} are allowed")


def _base64(value: str, path: str) -> bytes:
    try:
        return pybase64.b64decode(value, validate=True)
    except (Base64Error, ValueError):
        raise ConversionError(path, f"not base64: {_show(value)}") from None


def _unknown(name: str, names: list[str]) -> str:
    if close := get_close_matches(name[:_QUOTED], names, 1):
        return f"unknown field; did you mean {close[0]!r}?"
    return f"unknown field; there are {', '.join(names)}" if names else "unknown field"


def _show(value: object) -> str:
    """A value as error texts show it, in JSON's terms."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, str):
        return f'"{_quote(value)}"'
    if isinstance(value, int):
        # To write the digits of a huge integer would take longer than all else.
        return str(value) if value.bit_length() < 100 else "a huge integer"
    if isinstance(value, float):
        return str(value)
    if isinstance(value, dict):
        return "an object"
    return "an array" if isinstance(value, (list, tuple, Numbers)) else f"a {type(value).__name__}"


def _quote(text: str) -> str:
    """The beginning of a client's text, escaped for a line of the log."""
    start = text if len(text) <= _QUOTED else f"{text[:_QUOTED]}…"
    return start if start.isprintable() else json.dumps(start)[1:-1]


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
