"""The cost of a message for ROS before it is decoded, and that cheap messages are little work."""

from __future__ import annotations

import contextlib
import json
from array import array
from time import thread_time

import cbor2
import pytest
from encoded import from_cbor

pytest.importorskip("test_msgs.msg")
from hypothesis import given
from hypothesis import strategies as st

from appliance.ros.payload.arrays import Numbers
from appliance.ros.payload.converter import Converters
from appliance.ros.payload.cost import (
    CONTAINER_COST,
    TAG_COST,
    TEXT_BYTES_PER_ITEM,
    _walk_cbor,
    cbor_cost,
    json_cost,
)
from appliance.ros.payload.definitions import PRIMITIVES, load_description
from appliance.ros.payload.fallback import ConversionError, TooLargeError
from appliance.ros.payload.payloads import InputLimits, unpacker

MIB = (1 << 20) - 4096  # with what is around it
CONVERTERS = Converters(load_description)
SEQUENCES = "test_msgs/msg/UnboundedSequences"
MAP = "nav_msgs/msg/OccupancyGrid"

#: Seconds of work that a message may be: some ten times what it is on a computer without other
#: load, and less than any of the worst was without limits.
MOST = 0.2


def cost(value, text=lambda text: 0):
    """The same, by definition."""
    if isinstance(value, dict):
        names = sum(1 + text(name) for name in value)
        return CONTAINER_COST + names + sum(cost(item, text) for item in value.values())
    if isinstance(value, list):
        return CONTAINER_COST + sum(cost(item, text) for item in value)
    if isinstance(value, str):
        return CONTAINER_COST + text(value)
    if isinstance(value, bytes):
        return CONTAINER_COST
    if isinstance(value, cbor2.CBORTag):
        return TAG_COST + cost(value.value, text)
    return 1


def containers(value):
    if isinstance(value, dict):
        value = list(value.values())
    return 1 + sum(map(containers, value)) if isinstance(value, list) else 0


texts = st.text(max_size=20) | st.text('",:[]{}\\ab', max_size=20)
numbers = st.none() | st.booleans() | st.integers(-(2**64), 2**64 - 1) | st.floats()
plain = st.recursive(
    numbers | texts,
    lambda inner: st.lists(inner, max_size=40) | st.dictionaries(texts, inner, max_size=5),
    max_leaves=60,
)
for_cbor = st.recursive(
    plain
    | st.binary(max_size=40)
    | st.binary(max_size=9).map(lambda data: cbor2.CBORTag(64, data)),
    lambda inner: st.lists(inner, max_size=30),
    max_leaves=20,
)


@given(plain, st.integers(0, 2000))
def test_json_cost_counts_the_items(value, most):
    """Within 1 for each list and object: commas are counted, one less than there are values."""
    payload = json.dumps(value).encode()
    exactly, near = cost(value), containers(value) + 1
    found = json_cost(payload, most)
    assert (found <= most) or exactly + near > most
    assert (found > most) or exactly - near <= most


@given(for_cbor, st.integers(0, 2000))
def test_cbor_cost_counts_the_items(value, most):
    payload = cbor2.dumps(value)
    exactly = cost(value, lambda text: len(text.encode()) // TEXT_BYTES_PER_ITEM)
    assert _walk_cbor(payload, 1 << 40) == exactly
    found = cbor_cost(payload, most)
    assert (found <= most) == (exactly <= most) or len(payload) * (
        CONTAINER_COST + TAG_COST
    ) <= most


@pytest.mark.parametrize(
    ("payload", "exactly"),
    [
        (b"\x9f\x01\x02\xff", CONTAINER_COST + 2),
        (b"\xbf\x61a\x01\x61b\x9f\xff\xff", CONTAINER_COST + 2 + 1 + CONTAINER_COST),
        (b"\x5f\x41a\x41b\xff", 3 * CONTAINER_COST),  # bytes in pieces
        (b"\x7f\x61a\xff", 2 * CONTAINER_COST),
        (
            b"\x98\x20" + b"\xfb" + bytes(8) + b"\x00" * 31,
            CONTAINER_COST + 32,
        ),  # not all of one size
        (b"\x98\x20" + b"\x80" * 32, CONTAINER_COST + 32 * CONTAINER_COST),
        (b"\x83\x01\xd8\x40\x40\x02", CONTAINER_COST + 2 + TAG_COST + CONTAINER_COST),
        (b"\x9a" + b"\xff" * 4 + b"\x00", 0),  # more than there are: no CBOR
        (b"\x5b" + b"\xff" * 8, CONTAINER_COST),
        (b"\x1c", 0),
        (b"", 0),
    ],
)
def test_cbor_of_every_form(payload, exactly):
    try:
        found = _walk_cbor(payload, 10_000)
    except IndexError:
        found = 0
    assert found == exactly


def test_payloads_nested_too_deep_are_refused():
    unpack = unpacker(CONVERTERS.get(SEQUENCES), "cbor", "none", InputLimits())
    with pytest.raises(ConversionError, match="depth"):
        unpack(b"\x81" * 50_000 + b"\x00")


def whole(field, items):
    """A value with all fields, which generated code converts."""
    converter = CONVERTERS.get(SEQUENCES)
    return converter.to_dict(converter.from_dict({})) | {field: items}


def item(field):
    converter = CONVERTERS.get(SEQUENCES)
    return converter.to_dict(converter.from_dict({field: [{}]}))[field][0]


FIELDS = {
    "string_values": "",
    "float64_values": 1,
    "int32_values": 0,
    "constants_values": {},
    "basic_types_values": None,
}


def payloads():
    """Payloads of 1 MiB with all fields, and of 60 kB with missing ones, of each shape."""
    for field, of in FIELDS.items():
        one = item(field) if of is None else of
        for size, make in ((MIB, whole), (60_000, lambda name, items: {name: items})):
            count = size // (len(json.dumps(one)) + 2)
            text = json.dumps(make(field, [one] * count)).encode()
            yield f"json {field} {size}", "json", text
            yield f"cbor {field} {size}", "cbor", cbor2.dumps(make(field, [one] * count))
        yield f"json {{}} {field}", "json", b'{"%s": [' % field.encode() + b"{}," * 20_000 + b"{}]}"
    key = cbor2.dumps("string_values")
    for name, one in {
        "typed arrays": b"\xd8\x40\x40",
        "typed arrays to convert": b"\xd8\x54\x42\0\0",
        "lists": b"\x80",
        "objects": b"\xa0",
        "texts": b"\x60",
        "bytes": b"\x40",
        "numbers": b"\0",
    }.items():
        count = MIB // len(one)
        yield (
            f"cbor {name}",
            "cbor",
            b"\xa1" + key + b"\x9a" + count.to_bytes(4, "big") + one * count,
        )
        yield f"cbor endless {name}", "cbor", b"\xa1" + key + b"\x9f" + one * count + b"\xff"
    yield "cbor text in pieces", "cbor", b"\x7f" + b"\x61a" * (MIB // 2) + b"\xff"
    yield "cbor long texts", "cbor", cbor2.dumps({"string_values": ["Ж" * 7 * MIB]})
    yield "json lists", "json", b'{"string_values": [' + b"[]," * (MIB // 4) + b"[]]}"
    yield (
        "json commas in a text",
        "json",
        json.dumps(whole("string_values", ['",' * 200_000])).encode(),
    )
    encode = CONVERTERS.get(SEQUENCES)._encode
    for field in ("string_values", "constants_values", "basic_types_values"):
        one = "" if field == "string_values" else item(field)
        sizes = [len(encode(whole(field, [one] * count))) for count in (100, 200)]
        count = MIB * 100 // (sizes[1] - sizes[0])
        yield f"cdr {field}", "cdr", encode(whole(field, [one] * count))


PAYLOADS = {name: (encoding, payload) for name, encoding, payload in payloads()}


@pytest.mark.parametrize("name", PAYLOADS)
def test_the_costliest_payloads_are_converted_in_time(name):
    """1 MiB of the worst took 0.5 s of all others' time; typed arrays and decoded lists 0.7 s."""
    encoding, payload = PAYLOADS[name]
    unpack = unpacker(CONVERTERS.get(SEQUENCES), encoding, "none", InputLimits())
    took = []
    for _ in range(3):
        begun = thread_time()
        with contextlib.suppress(ConversionError):
            unpack(payload)
        took.append(thread_time() - begun)
    assert min(took) < MOST, f"{min(took):.3f} s of work"


@pytest.mark.parametrize(
    "name", [name for name in PAYLOADS if "60000" not in name and "pieces" not in name]
)
def test_payloads_over_the_limit_of_items_are_refused(name):
    encoding, payload = PAYLOADS[name]
    unpack = unpacker(CONVERTERS.get(SEQUENCES), encoding, "none", InputLimits())
    if name == "json commas in a text":
        unpack(payload)
        return
    with pytest.raises(TooLargeError, match=r"100000 \(bridge.limits.items\)"):
        unpack(payload)


def test_large_maps_pass_in_every_encoding_that_copies_them():
    cells = bytes(range(100)) * (4 * MIB // 100)
    converter = CONVERTERS.get(MAP)
    fields = converter.to_dict(converter.from_dict({}))
    expected = converter._encode(fields | {"data": Numbers(PRIMITIVES["int8"], cells)})
    as_cbor = cbor2.dumps(fields | {"data": cbor2.CBORTag(72, cells)})
    for encoding, payload in (("cbor", as_cbor), ("cdr", expected)):
        unpack = unpacker(converter, encoding, "none", InputLimits())
        begun = thread_time()
        assert unpack(payload) == expected
        assert thread_time() - begun < MOST


def test_typed_arrays_fill_fields_of_their_own_and_of_convertible_types():
    converter = CONVERTERS.get(SEQUENCES)
    tags = {"float64": (86, "d"), "float32": (85, "f"), "int16": (77, "h"), "uint8": (64, "B")}
    for name, (tag, code) in tags.items():
        data = array(code, [1, 2, 3]).tobytes()
        for field in ("float64", "float32", "int16", "uint8", "int64"):
            payload = cbor2.dumps({f"{field}_values": cbor2.CBORTag(tag, data)})
            full = cbor2.dumps(whole(f"{field}_values", cbor2.CBORTag(tag, data)))
            for each in (payload, full):
                if code in "fd" and "float" not in field:
                    with pytest.raises(ConversionError, match=f"{field}_values"):
                        from_cbor(converter, each)
                else:
                    expected = converter.from_dict({f"{field}_values": [1, 2, 3]})
                    assert from_cbor(converter, each) == expected, (name, field)


def test_the_defaults_of_missing_fields_count():
    """A few bytes can stand for a large message: 20,000 empty objects took 0.1 s."""
    converter = CONVERTERS.get(SEQUENCES)
    with pytest.raises(TooLargeError, match=r"bridge\.limits\.items"):
        converter.from_json(b'{"basic_types_values": [' + b"{}," * 20_000 + b"{}]}")
    converter.from_json(json.dumps({"basic_types_values": [{}] * 1000}).encode())


def test_the_limit_of_items_is_configured():
    many = json.dumps(whole("string_values", ["a"] * 20_000)).encode()
    cdr = CONVERTERS.get(SEQUENCES)._encode(whole("string_values", ["a"] * 20_000))
    for encoding, payload in (("json", many), ("cdr", cdr)):
        converter = CONVERTERS.get(SEQUENCES)
        assert unpacker(converter, encoding, "none", InputLimits(items=200_000))(payload) == cdr
        with pytest.raises(TooLargeError, match="than 100000"):
            unpacker(converter, encoding, "none", InputLimits())(payload)
