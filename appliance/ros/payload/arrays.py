"""Readers and writers of whole arrays and wide strings, which generated code calls.

Like generated code they accept only values of exactly the right types, and raise one of
`codegen.MISFIT` for others: the fallback then converts the message, or names what is wrong.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import nan
from typing import Any

import pybase64

from appliance.ros.payload.definitions import CDR, PRIMITIVES, Primitive

# Arrays of fewer numbers than this use a prepared Struct: numpy would take longer.
_FEW = 32

_BOOLS = frozenset({bool})
_INTEGERS = frozenset({int})
_NUMBERS = frozenset({int, float})
_NUMBERS_AND_NULL = frozenset({int, float, type(None)})


@dataclass(frozen=True, slots=True)
class Numbers:
    """An array of numbers in its serialized form, little endian."""

    primitive: Primitive
    data: bytes

    def listed(self) -> list[Any]:
        """The numbers."""
        return unpack_numbers(f"<{self.primitive.code}", self.data)


def unpack_numbers(code: str, data: bytes) -> list[Any]:
    """The numbers in `data`. `code` is a `struct` format: the byte order and one number.

    Raises ValueError when `data` ends within a number.
    """
    count, left = divmod(len(data), struct.calcsize(code))
    if left:
        raise ValueError
    return list(struct.unpack(f"{code[:-1]}{count}{code[-1]}", data))


def _octets(value: Any) -> bytes:
    """The bytes of uint8[], byte[] or char[]: base64 in JSON, bytes from `fallback.accept`."""
    if value.__class__ is str:
        return pybase64.b64decode(value, validate=True)
    if value.__class__ is bytes:
        return bytes(value)
    if value.__class__ is Numbers and value.primitive.name == "uint8":
        return bytes(value.data)
    raise TypeError


def _listed(value: Any) -> list[Any]:
    """The list of an array of numbers that is not a list already."""
    if isinstance(value, Numbers):
        return value.listed()
    raise TypeError


def _write_wide_string(value: str) -> bytes:
    units = value.encode("utf-16-le")
    return struct.pack(f"<{len(units) // 2}I", *memoryview(units).cast("H"))


def _read_wide_string(b: bytes, q: int, count: int) -> str:
    if q + count * 4 > len(b):
        raise IndexError
    units = struct.unpack_from(f"<{count}I", b, q)
    return struct.pack(f"<{count}H", *units).decode("utf-16-le")


def _writer(primitive: Primitive) -> Callable[[Any], bytes]:
    """The function that serializes a whole list of numbers."""
    code = primitive.code
    few = [struct.Struct(f"<{count}{code}").pack for count in range(_FEW)]
    types = _BOOLS if primitive.name == "bool" else _INTEGERS

    def write_floats(values: Any) -> bytes:
        if values.__class__ is not list:
            if values.__class__ is Numbers and values.primitive == primitive:
                return bytes(values.data)
            values = _listed(values)
        count = len(values)
        pack = few[count] if count < _FEW else struct.Struct(f"<{count}{code}").pack
        try:
            # conjugate returns a float unchanged and refuses other types: the cheapest check.
            return pack(*map(float.conjugate, values))
        except TypeError:
            if not _NUMBERS_AND_NULL.issuperset(map(type, values)):
                raise
        return pack(*[nan if x is None else x for x in values])

    def write_exactly(values: Any) -> bytes:
        if values.__class__ is not list:
            if values.__class__ is Numbers and values.primitive == primitive:
                return bytes(values.data)
            values = _listed(values)
        if not types.issuperset(map(type, values)):
            raise TypeError
        count = len(values)
        pack = few[count] if count < _FEW else struct.Struct(f"<{count}{code}").pack
        return pack(*values)

    return write_floats if primitive.is_float else write_exactly


def _reader(primitive: Primitive, with_numpy: bool) -> Callable[[bytes, int, int], Any]:
    """The function that reads `count` numbers at `q`. It raises IndexError or struct.error when the
    message ends before them."""
    code, size = primitive.code, primitive.size
    few = [struct.Struct(f"<{count}{code}").unpack_from for count in range(_FEW)]
    # float32 is always read by numpy, so that its digits do not depend on the length of the array.
    fewest = 1 if code == "f" else _FEW

    def read_octets(b: bytes, q: int, count: int) -> str:
        end = q + count
        if end > len(b):
            raise IndexError
        return pybase64.b64encode_as_string(b[q:end])

    def read_list(b: bytes, q: int, count: int) -> list[Any]:
        if count < _FEW:
            return list(few[count](b, q))
        if q + count * size > len(b):
            raise IndexError
        return list(struct.unpack_from(f"<{count}{code}", b, q))

    if primitive.is_octet:
        return read_octets
    frombuffer = _frombuffer() if with_numpy and primitive.name != "bool" else None
    if frombuffer is None:
        return read_list

    def read_array(b: bytes, q: int, count: int) -> Any:
        if count < fewest:
            return list(few[count](b, q))
        end = q + count * size
        if end > len(b):
            raise IndexError
        # numpy needs the numbers aligned in memory; those of a slice are.
        return frombuffer(b[q:end], code)

    return read_array


def _frombuffer() -> Callable[[bytes, str], Any] | None:
    """numpy's frombuffer; None without numpy, which every rclpy depends on, or on a big-endian
    machine. numpy is imported on first use, as the import takes longer than all else here."""
    if sys.byteorder != "little":
        return None
    try:
        from numpy import frombuffer
    except ImportError:
        return None
    return frombuffer


@cache
def readers(with_numpy: bool) -> dict[str, Any]:
    """The names that generated decoders call. Long arrays become numpy arrays when `with_numpy`,
    else lists."""
    return {
        "LITTLE_ENDIAN": CDR.header[:2],
        "base64": pybase64.b64encode_as_string,
        "read_wide_string": _read_wide_string,
        **{f"read_{p.name}": _reader(p, with_numpy) for p in PRIMITIVES.values()},
    }


def _unchanged(value: bytes) -> bytes:
    return value


def _binary_reader(primitive: Primitive) -> Callable[[bytes, int, int], Any]:
    """The function that copies `count` numbers at `q` without decoding them."""
    size = primitive.size

    def read_octets(b: bytes, q: int, count: int) -> bytes:
        end = q + count
        if end > len(b):
            raise IndexError
        return b[q:end]

    def read_numbers(b: bytes, q: int, count: int) -> Numbers:
        end = q + count * size
        if end > len(b):
            raise IndexError
        return Numbers(primitive, b[q:end])

    return read_octets if primitive.is_octet else read_numbers


def _inline_array(primitive: Primitive) -> Callable[..., Any]:
    """The function that makes an array of numbers that were read one by one."""
    code = primitive.code
    if primitive.name == "bool":
        return lambda *values: list(values)
    return lambda *values: Numbers(primitive, struct.pack(f"<{len(values)}{code}", *values))


@cache
def binary_readers() -> dict[str, Any]:
    """The names that generated decoders call which only copy arrays of numbers. Arrays of bools
    become lists."""
    bools = PRIMITIVES["bool"]
    return {
        "LITTLE_ENDIAN": CDR.header[:2],
        "base64": _unchanged,
        "read_wide_string": _read_wide_string,
        **{f"read_{p.name}": _binary_reader(p) for p in PRIMITIVES.values()},
        "read_bool": _reader(bools, with_numpy=False),
        **{f"numbers_{p.name}": _inline_array(p) for p in PRIMITIVES.values()},
    }


# The names that generated encoders call.
WRITERS: dict[str, Any] = {
    "HEADER": CDR.header,
    "ZEROS": bytes(8),
    "BOOLS": _BOOLS,
    "INTEGERS": _INTEGERS,
    "NUMBERS": _NUMBERS,
    "join": b"".join,
    "octets": _octets,
    "listed": _listed,
    "write_wide_string": _write_wide_string,
    **{f"write_{p.name}": _writer(p) for p in PRIMITIVES.values() if not p.is_octet},
}
