"""Every installed message type, against rclpy and against a naive reading of the same message.

The oracle has two halves. rclpy makes the bytes from its own message objects. And below, `write`
and `plain` walk these objects field by field, slowly and plainly, by the standard: rclpy leaves
whatever was in memory in the padding, so its bytes cannot be compared as they are; `write`'s can.
"""

from __future__ import annotations

import base64
import contextlib
import json
import math
import os
import random
import struct
import sys
import zlib
from pathlib import Path

import orjson
import pytest
from encoded import from_cbor, to_cbor

pytest.importorskip("rclpy", reason="needs ROS 2: the extra `ros`")

import cbor2
import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

from appliance.ros.payload import converter as convert
from appliance.ros.payload.codegen import generate
from appliance.ros.payload.converter import ConversionError, Converters
from appliance.ros.payload.definitions import import_message, load_description
from appliance.ros.payload.fallback import decode as fallback_decode

CONVERTERS = Converters(load_description, now=lambda: 1_700_000_000_123_456_789)
VARIANTS = ("default", "smallest", "largest", "random 1", "random 2", "random 3")

CODES = {
    "boolean": "?",
    "octet": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float": "f",
    "double": "d",
}


def installed_types() -> list[str]:
    """Every message, and every part of every service and action, of the installed packages."""
    prefixes = os.environ.get("AMENT_PREFIX_PATH", sys.prefix).split(os.pathsep)
    names = set()
    for prefix in prefixes:
        for index in Path(prefix, "share/ament_index/resource_index/rosidl_interfaces").glob("*"):
            for line in index.read_text().split():
                kind, _, type_name = line.partition("/")
                name = f"{index.name}/{kind}/{type_name.partition('.')[0]}"
                calls = {"msg": [""], "srv": ["_Request", "_Response", "_Event"]}
                parts = calls.get(kind) or [
                    *("_Goal", "_Result", "_Feedback", "_FeedbackMessage"),
                    *(f"_SendGoal{part}" for part in calls["srv"]),
                    *(f"_GetResult{part}" for part in calls["srv"]),
                ]
                names |= {name + part for part in parts}
    return sorted(names)


TYPES = installed_types()


def slots(message):
    return zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True)


def is_octets(slot) -> bool:
    return getattr(slot, "typename", None) in ("octet", "uint8")


# --- random messages ------------------------------------------------------------------------


def fill(message, variant: str, rng: random.Random):
    if variant != "default":
        for name, slot in slots(message):
            setattr(message, name, value_of(slot, variant, rng))
    return message


def value_of(slot, variant: str, rng: random.Random):
    kind = type(slot).__name__
    if kind == "Array":
        return [value_of(slot.value_type, variant, rng) for _ in range(slot.size)]
    if kind in ("BoundedSequence", "UnboundedSequence"):
        most = min(getattr(slot, "maximum_size", 3), 40)
        if type(slot.value_type).__name__ == "BasicType" and rng.random() < 0.2:
            most = min(getattr(slot, "maximum_size", 80), 80)  # so long that numpy is used
        count = {"smallest": 0, "largest": most}.get(variant, rng.randint(0, most))
        return [value_of(slot.value_type, variant, rng) for _ in range(count)]
    if kind == "NamespacedType":
        return fill(import_message("/".join(slot.namespaced_name()))(), variant, rng)
    if kind.endswith("String"):
        letters = 'aZ0 "\\/\n\x7fé\u2028日😀' + ("\0" if kind.endswith("WString") else "")
        count = {"smallest": 0, "largest": 20}.get(variant, rng.randint(0, 9))
        text = "".join(rng.choice(letters) for _ in range(count))
        if kind == "BoundedString":
            text = text.encode()[: slot.maximum_size].decode(errors="ignore")
        return text[: slot.maximum_size // 2] if kind == "BoundedWString" else text
    code = CODES[slot.typename]
    if slot.typename == "boolean":
        return {"smallest": False, "largest": True}.get(variant, rng.random() < 0.5)
    if code in "fd":
        largest = 3.4028234663852886e38 if code == "f" else sys.float_info.max
        special = [0.0, -0.0, 1.0, 0.1, math.nan, math.inf, -math.inf, largest, -largest]
        special += [2.0**-149, 2.0**-126, math.pi]
        number = rng.choice(special) if rng.random() < 0.4 else rng.uniform(-1e3, 1e3)
        number = {"smallest": -largest, "largest": largest}.get(variant, number)
        return struct.unpack(code, struct.pack(code, number))[0]
    bits = struct.calcsize(f"<{code}") * 8
    least, most = (0, 2**bits - 1) if code.isupper() else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    some = rng.choice([least, most, 0, 1, rng.randint(least, most)])
    number = {"smallest": least, "largest": most}.get(variant, some)
    return bytes([number]) if slot.typename == "octet" else number


# --- the naive way --------------------------------------------------------------------------


class Writer:
    """CDR, one value after the other; `padding` has the indices that hold nothing."""

    def __init__(self, order: str, nan_for_inf: bool) -> None:
        self.order = order
        self.nan_for_inf = nan_for_inf
        self.body = bytearray()
        self.padding: list[int] = []

    def number(self, code: str, value) -> None:
        size = struct.calcsize(f"<{code}")
        while len(self.body) % size:
            self.padding.append(4 + len(self.body))
            self.body.append(0)
        if code in "fd" and self.nan_for_inf and math.isinf(value):
            value = math.nan
        self.body += struct.pack(self.order + code, value)

    def structure(self, message) -> None:
        names = message.get_fields_and_field_types()
        if not names:
            self.body.append(0)
        for name, slot in slots(message):
            self.value(slot, getattr(message, name))

    def value(self, slot, value) -> None:
        kind = type(slot).__name__
        if kind in ("BoundedSequence", "UnboundedSequence"):
            self.number("I", len(value))
        if kind in ("BoundedSequence", "UnboundedSequence", "Array"):
            for item in value:
                self.value(slot.value_type, item)
        elif kind == "NamespacedType":
            self.structure(value)
        elif kind in ("UnboundedWString", "BoundedWString"):
            units = value.encode("utf-16-le")
            self.number("I", len(units) // 2)
            for i in range(0, len(units), 2):
                self.number("I", int.from_bytes(units[i : i + 2], "little"))
        elif kind in ("UnboundedString", "BoundedString"):
            self.number("I", len(value.encode()) + 1)
            self.body += value.encode() + b"\0"
        else:
            self.number(CODES[slot.typename], ord(value) if isinstance(value, bytes) else value)


def write(message, order: str = "<", nan_for_inf: bool = False) -> bytes:
    writer = Writer(order, nan_for_inf)
    writer.structure(message)
    return bytes([0, order == "<", 0, 0]) + bytes(writer.body)


def blank_padding(cdr: bytes, message) -> bytes:
    """rclpy's bytes without what is left to chance: the padding, and what follows the message."""
    writer = Writer("<", False)
    writer.structure(message)
    mended = bytearray(cdr[: 4 + len(writer.body)])
    for index in writer.padding:
        mended[index] = 0
    return bytes(mended)


def plain(message, in_json: bool = False):
    """What a message is in JSON, by the conventions. Floats as they are, or as JSON has them."""
    return {
        name: plain_value(slot, getattr(message, name), in_json) for name, slot in slots(message)
    }


def plain_value(slot, value, in_json: bool):
    kind = type(slot).__name__
    if kind in ("BoundedSequence", "UnboundedSequence", "Array"):
        item = slot.value_type
        if is_octets(item):
            octets = (x if isinstance(x, bytes) else bytes([x]) for x in value)
            return base64.b64encode(b"".join(octets)).decode()
        if in_json and getattr(item, "typename", None) == "float":
            # No more digits than tell a float32 from its neighbours.
            return [float(str(np.float32(x))) if math.isfinite(x) else None for x in value]
        return [plain_value(item, x, in_json) for x in value]
    if kind == "NamespacedType":
        return plain(value, in_json)
    if kind == "BasicType" and CODES[slot.typename] in "fd":
        return float(value) if math.isfinite(value) or not in_json else None
    if kind == "BasicType" and slot.typename != "boolean":
        return ord(value) if isinstance(value, bytes) else int(value)
    return value


def in_cbor(message):
    """What a message is in CBOR, by the conventions, as cbor2 reads it with its own defaults."""
    return {name: cbor_value(slot, getattr(message, name)) for name, slot in slots(message)}


#: RFC 8746, typed arrays in little endian.
CBOR_TAGS = {
    "uint16": 69,
    "uint32": 70,
    "uint64": 71,
    "int8": 72,
    "int16": 77,
    "int32": 78,
    "int64": 79,
    "float": 85,
    "double": 86,
}


def cbor_value(slot, value):
    kind = type(slot).__name__
    if kind in ("BoundedSequence", "UnboundedSequence", "Array"):
        item = slot.value_type
        if is_octets(item):
            return b"".join(x if isinstance(x, bytes) else bytes([x]) for x in value)
        name = getattr(item, "typename", None)
        if name in CBOR_TAGS:
            packed = b"".join(struct.pack("<" + CODES[name], x) for x in value)
            return cbor2.CBORTag(CBOR_TAGS[name], packed)
        return [cbor_value(item, x) for x in value]
    return in_cbor(value) if kind == "NamespacedType" else plain_value(slot, value, False)


def same(a, b) -> bool:
    """Equal to the last type and item, NaN being equal to itself."""
    if isinstance(a, float) and isinstance(b, float):
        return a == b or (math.isnan(a) and math.isnan(b))
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


# --- the tests ------------------------------------------------------------------------------


def messages(name: str):
    message_class = import_message(name)
    for variant in VARIANTS:
        yield fill(
            message_class(), variant, random.Random(zlib.crc32(f"{name} {variant}".encode()))
        )


def test_there_are_many_types() -> None:
    print(f"{len(TYPES)} types, {sum('/msg/' in name for name in TYPES)} of them messages")
    assert len(TYPES) >= 150
    assert "test_msgs/msg/WStrings" in TYPES
    assert "test_msgs/action/Fibonacci_Goal" in TYPES


@pytest.mark.parametrize("name", TYPES)
def test_round_trip(name: str) -> None:
    converter = CONVERTERS.get(name)
    for message in messages(name):
        cdr = serialize_message(message)
        expected = write(message)
        assert blank_padding(cdr, message) == expected, "the oracle's halves do not agree"

        # ROS to JSON: the slow twin agrees.
        payload = converter.to_json(cdr)
        assert same(json.loads(payload), plain(message, in_json=True))
        twin = plain(message)
        assert same(converter.to_dict(cdr), twin)
        assert same(fallback_decode(converter.description, cdr), twin)

        # JSON to ROS: the same bytes. null was NaN or infinity: it comes back as NaN.
        finite = write(message, nan_for_inf=True)
        assert converter.from_json(payload) == finite
        assert write(deserialize_message(finite, type(message))) == finite
        # Without the detour through null, infinities are kept too.
        assert converter.from_dict(converter.to_dict(cdr)) == expected

        # The other byte order.
        assert same(converter.to_dict(write(message, ">")), twin)


@pytest.mark.parametrize("name", TYPES)
def test_round_trip_in_cbor(name: str) -> None:
    converter = CONVERTERS.get(name)
    for message in messages(name):
        cdr = write(message)
        payload = to_cbor(converter, cdr)
        assert same(cbor2.loads(payload), in_cbor(message))
        assert from_cbor(converter, payload) == cdr  # NaN and infinities included
        assert to_cbor(converter, write(message, ">")) == payload
        # As a client writes it that knows nothing of typed arrays.
        assert from_cbor(converter, cbor2.dumps(plain(message))) == cdr


@pytest.mark.parametrize("name", TYPES)
def test_some_fields(name: str) -> None:
    """Whatever is left out: what is not comes as it would with all the others."""
    rng = random.Random(name)
    paths = list(field_paths(CONVERTERS.get(name).description))
    for message in messages(name) if paths else ():
        fields = tuple(rng.sample(paths, min(len(paths), rng.randint(1, 3))))
        converter = CONVERTERS.get(name, fields)
        expected = picked(plain(message, in_json=True), fields)
        assert same(json.loads(converter.to_json(write(message))), expected)
        for order in "<>":
            cdr = write(message, order)
            assert same(converter.to_dict(cdr), picked(plain(message), fields))
            assert same(cbor2.loads(to_cbor(converter, cdr)), picked(in_cbor(message), fields))


def field_paths(description, prefix=""):
    for field in description.fields:
        yield prefix + field.name
        inside = getattr(field.type, "item", field.type)
        if hasattr(inside, "fields"):
            yield from field_paths(inside, f"{prefix}{field.name}.")


def picked(value, paths):
    """The naive way: every path by itself, and what was found put together."""
    if isinstance(value, list):
        return [picked(item, paths) for item in value]
    found = {}
    for name, inside in value.items():
        rests = [path.partition(".")[2] for path in paths if path.partition(".")[0] == name]
        if rests:
            found[name] = inside if "" in rests else picked(inside, rests)
    return found


@pytest.mark.parametrize("name", TYPES)
def test_the_generated_code_needs_no_help(name: str) -> None:
    """All messages but the odd ones go the fast way: without this, no other test would notice."""
    generated = generate(CONVERTERS.get(name).description)
    for message in messages(name):
        cdr = write(message, nan_for_inf=True)
        value = generated.decode_plain(cdr)
        assert same(value, plain(deserialize_message(cdr, type(message))))
        if b"NaN" not in json.dumps(value).encode():
            assert generated.encode(value) == cdr
        assert orjson.dumps(generated.decode(cdr), option=orjson.OPT_SERIALIZE_NUMPY)


@pytest.mark.parametrize("name", TYPES)
def test_missing_fields_take_their_defaults(name: str) -> None:
    assert CONVERTERS.get(name).from_json(b"{}") == write(import_message(name)())


@pytest.mark.parametrize("name", TYPES)
def test_mutated_cdr(name: str) -> None:
    """Whatever the bytes: a ConversionError, or what the fallback reads."""
    converter = CONVERTERS.get(name)
    rng = random.Random(name)
    for message in messages(name):
        cdr = write(message)
        for _ in range(8):
            mutant = mutated(cdr, rng)
            try:
                expected = fallback_decode(converter.description, mutant)
            except ConversionError:
                with pytest.raises(ConversionError):
                    converter.to_json(mutant)
                with pytest.raises(ConversionError):
                    to_cbor(converter, mutant)
                continue
            cbor2.loads(to_cbor(converter, mutant))
            assert same(converter.to_dict(mutant), expected)
            orjson.loads(converter.to_json(mutant))


def mutated(data: bytes, rng: random.Random) -> bytes:
    mutant = bytearray(data)
    for _ in range(rng.choice((1, 1, 3))):
        at = rng.randrange(len(mutant) + 1)
        change = rng.randrange(5)
        if change == 0:
            del mutant[at:]
        elif change == 1:
            mutant[at:at] = rng.randbytes(rng.randint(1, 8))
        elif change == 2:
            mutant[at : at + 4] = rng.choice((b"\xff" * 4, bytes(4), b"\x00\x00\x00\x80"))
        else:
            mutant[at : at + 1] = rng.randbytes(1)
    return bytes(mutant)


JUNK = (
    *(None, True, False, 0, 1, -1, 1.0, 0.5, -0.0, 1e39, 1e308, 2**31, 2**32, 2**63, -(2**63) - 1),
    *("", "now", "x", "a\0b", "====", "AAAA", "é" * 30, [], [None], [True], [0], [1.5], [[]]),
    *([0.0] * 9, [1] * 16, ["x"], {}, {"x": 0}, [{}], {"sec": 1}, math.nan, math.inf),
)


def spoiled(value, rng: random.Random):
    """The same value with one thing in it changed."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        if rng.random() < 0.15:
            without = {k: v for k, v in value.items() if k != key}
            return rng.choice((without, without | {key + "x": 1}, value | {key + "x": 1}))
        return value | {key: spoiled(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.8:
        at = rng.randrange(len(value))
        return [*value[:at], spoiled(value[at], rng), *value[at + 1 :]]
    return rng.choice(JUNK)


@pytest.mark.parametrize("name", TYPES)
def test_mutated_json_and_cbor(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fast way takes nothing that the fallback refuses, and writes the same bytes."""
    monkeypatch.setattr(convert, "LARGEST_LENIENT", 1 << 30)
    converter = CONVERTERS.get(name)
    rng = random.Random(name)
    for message in messages(name):
        value = converter.to_dict(write(message, nan_for_inf=True))
        for _ in range(8):
            payload = json.dumps(spoiled(value, rng)).encode()
            # What JSON has no words for is refused as a whole.
            if b"NaN" in payload or b"Infinity" in payload:
                payload = payload.replace(b"NaN", b"null").replace(b"-Infinity", b"null")
                payload = payload.replace(b"Infinity", b"null")
            try:
                expected = converter.from_dict(orjson.loads(payload))
            except ConversionError:
                with pytest.raises(ConversionError):
                    converter.from_json(payload)
            else:
                assert converter.from_json(payload) == expected
                deserialize_message(expected, type(message))
            spoilt = cbor2.dumps(spoiled(value, rng))
            try:
                expected = converter.from_dict(cbor2.loads(spoilt))
            except ConversionError as error:
                with pytest.raises(ConversionError) as caught:
                    from_cbor(converter, spoilt)
                assert caught.value.path == error.path
            else:
                assert from_cbor(converter, spoilt) == expected
                deserialize_message(expected, type(message))
        for _ in range(3):
            mutant = mutated(converter.to_json(write(message)), rng)
            with contextlib.suppress(ConversionError):
                deserialize_message(converter.from_json(mutant), type(message))
            mutant = mutated(to_cbor(converter, write(message)), rng)
            with contextlib.suppress(ConversionError):
                deserialize_message(from_cbor(converter, mutant), type(message))
