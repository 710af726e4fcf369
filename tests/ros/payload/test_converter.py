"""The rules of the conventions, one by one, on types described by hand: no ROS is needed."""

from __future__ import annotations

import base64
import json
import math
import random
import struct
import sys

import orjson
import pytest
from encoded import from_text, to_text

from appliance.ros.payload.codegen import generate
from appliance.ros.payload.converter import (
    LARGEST_LENIENT,
    ConversionError,
    Converter,
    Converters,
    compile_converter,
)
from appliance.ros.payload.cost import DEFAULT_ITEMS
from appliance.ros.payload.definitions import (
    PRIMITIVES,
    TIME,
    Array,
    Bulk,
    Field,
    Sequence,
    String,
    TypeDescription,
    UnknownTypeError,
    WideString,
    describe,
    import_message,
    load_description,
)
from appliance.ros.payload.encodings.registry import ENCODINGS

FLOAT64 = PRIMITIVES["float64"]
FLOAT32 = PRIMITIVES["float32"]
UINT8 = PRIMITIVES["uint8"]

VECTOR3 = TypeDescription(
    "geometry_msgs/msg/Vector3", tuple(Field(name, FLOAT64, 0.0) for name in "xyz")
)
TWIST = TypeDescription(
    "geometry_msgs/msg/Twist", (Field("linear", VECTOR3), Field("angular", VECTOR3))
)
STAMP = TypeDescription(
    TIME, (Field("sec", PRIMITIVES["int32"]), Field("nanosec", PRIMITIVES["uint32"]))
)
HEADER = TypeDescription(
    "std_msgs/msg/Header", (Field("stamp", STAMP), Field("frame_id", String()))
)
HEADER_BYTES = b"\x00\x01\x00\x00"
EMPTY = TypeDescription("std_msgs/msg/Empty", ())


def of(*types, name: str = "data", default=None) -> Converter:
    """A converter of a type with these fields: `data`, or `a`, `b`, … where there are several."""
    names = [name] if len(types) == 1 else "abcdefgh"[: len(types)]
    fields = (Field(n, t, default) for n, t in zip(names, types, strict=True))
    return compile_converter(TypeDescription("demo_msgs/msg/Demo", tuple(fields)))


def cdr(text: str) -> bytes:
    """Annotated hex: what follows `#` in a line is for the reader."""
    return bytes.fromhex("".join(line.partition("#")[0] for line in text.splitlines()))


def refusal(converter: Converter, payload: bytes | str) -> str:
    with pytest.raises(ConversionError) as caught:
        converter.from_json(payload.encode() if isinstance(payload, str) else payload)
    return str(caught.value)


# --- CDR, byte by byte ----------------------------------------------------------------------

GOLDEN = [
    (
        of(String()),
        {"data": "hé"},
        """00 01 00 00           # little endian
           04 00 00 00           # bytes, with the NUL
           68 c3 a9 00""",
    ),
    (
        of(String(), FLOAT64, UINT8, PRIMITIVES["uint16"]),
        {"a": "abcd", "b": 1.0, "c": 7, "d": 0x1234},
        """00 01 00 00
           05 00 00 00 61 62 63 64 00
           00 00 00 00 00 00 00  # to 16 from the header's end
           00 00 00 00 00 00 f0 3f
           07
           00                    # to 2
           34 12""",
    ),
    (
        of(Sequence(FLOAT64), UINT8, Sequence(FLOAT64)),
        {"a": [], "b": 1, "c": [2.0]},
        """00 01 00 00
           00 00 00 00           # an empty sequence is not aligned
           01 00 00 00
           01 00 00 00
           00 00 00 00           # to 8
           00 00 00 00 00 00 00 40""",
    ),
    (
        of(WideString(), UINT8),
        {"a": "é😀", "b": 1},
        """00 01 00 00
           03 00 00 00           # units of UTF-16, each in four bytes, no NUL
           e9 00 00 00 3d d8 00 00 00 de 00 00
           01""",
    ),
    (
        of(Sequence(String()), Sequence(VECTOR3)),
        {"a": ["", "x"], "b": [{"x": 0.0, "y": 0.0, "z": 1.0}]},
        """00 01 00 00
           02 00 00 00
           01 00 00 00 00
           00 00 00              # to 4
           02 00 00 00 78 00
           00 00                 # to 4
           01 00 00 00
           00 00 00 00 00 00 00 00  00 00 00 00 00 00 00 00  00 00 00 00 00 00 f0 3f""",
    ),
    (
        of(EMPTY, PRIMITIVES["bool"], PRIMITIVES["int64"]),
        {"a": {}, "b": True, "c": -(2**63)},
        """00 01 00 00
           00                    # no structure without a byte
           01
           00 00 00 00 00 00     # to 8
           00 00 00 00 00 00 00 80""",
    ),
    (
        of(Array(UINT8, 3), Sequence(PRIMITIVES["byte"]), Array(PRIMITIVES["char"], 1)),
        {"a": "AQID", "b": "/w==", "c": "AA=="},
        """00 01 00 00
           01 02 03
           00                    # to 4
           01 00 00 00 ff
           00""",
    ),
]


@pytest.mark.parametrize(("converter", "value", "text"), GOLDEN)
def test_golden(converter: Converter, value, text: str) -> None:
    message = cdr(text)
    assert orjson.loads(converter.to_json(message)) == value
    assert converter.to_dict(message) == value
    assert converter.from_json(json.dumps(value).encode()) == message
    assert converter.from_dict(value) == message
    # Some senders pad at the end.
    assert converter.to_dict(message + b"\x55\xaa\x55") == value
    # One byte less, whichever it is, is an error, and so is another representation.
    for size in range(len(message)):
        with pytest.raises(ConversionError, match="truncated"):
            converter.to_json(message[:size])
    for representation in (b"\x00\x03", b"\x00\x07", b"\x01\x00", b"\xff\xff"):
        with pytest.raises(ConversionError, match="not plain CDR"):
            converter.to_json(representation + message[2:])


def test_big_endian() -> None:
    converter = of(String(), FLOAT32, Sequence(PRIMITIVES["int16"]), WideString())
    message = cdr(
        """00 00 00 00
           00 00 00 02 61 00
           00 00
           3f 80 00 00
           00 00 00 02  00 01 ff fe
           00 00 00 01  00 00 00 62"""
    )
    value = {"a": "a", "b": 1.0, "c": [1, -2], "d": "b"}
    assert orjson.loads(converter.to_json(message)) == converter.to_dict(message) == value


@pytest.mark.parametrize("count", ["ff ff ff ff", "00 00 00 80", "05 00 00 00"])
@pytest.mark.parametrize(
    "type_",
    [
        *(Sequence(t) for t in (UINT8, FLOAT64, FLOAT32, PRIMITIVES["bool"], String())),
        *(Sequence(t) for t in (VECTOR3, HEADER, EMPTY, WideString())),
        String(),
        WideString(),
    ],
)
def test_a_false_count_is_refused(type_, count: str) -> None:
    with pytest.raises(ConversionError, match=r"^data: truncated: it announces"):
        of(type_).to_json(cdr(f"00 01 00 00 {count} 00 00 00 00"))


def test_more_items_than_allowed() -> None:
    for type_ in (UINT8, PRIMITIVES["int32"], String(), EMPTY):
        many = of(Sequence(type_)).from_json(b'{"data":[%b]}' % _three(type_))
        with pytest.raises(ConversionError, match="data: 3 items, at most 2 are allowed"):
            of(Sequence(type_, 2)).to_json(many)
        assert of(Sequence(type_, 3)).to_json(many)


def _three(type_) -> bytes:
    return b'"","",""' if isinstance(type_, String) else b"{},{},{}" if type_ is EMPTY else b"1,2,3"


def test_strings_that_are_not_well_formed() -> None:
    converter = of(String())
    # Without NUL; without anything; not UTF-8: as rclpy reads them.
    assert converter.to_json(cdr("00 01 00 00 03 00 00 00 61 62 63")) == b'{"data":"abc"}'
    assert converter.to_json(cdr("00 01 00 00 00 00 00 00")) == b'{"data":""}'
    assert converter.to_dict(cdr("00 01 00 00 03 00 00 00 61 ff 00")) == {"data": "a\ufffd"}
    # Half a surrogate pair, and no UTF-16 at all.
    wide = of(WideString())
    assert wide.to_dict(cdr("00 01 00 00 01 00 00 00 00 d8 00 00")) == {"data": "\ufffd"}
    with pytest.raises(ConversionError, match="data: not UTF-16"):
        wide.to_json(cdr("00 01 00 00 01 00 00 00 00 00 01 00"))


# --- any type at all ------------------------------------------------------------------------


def random_type(rng: random.Random, depth: int = 0):
    kind = rng.choice(("primitive", "primitive", "string", "wide", "array", "sequence", "nested"))
    if depth < 3 and kind == "nested":
        return random_description(rng, depth + 1)
    if depth < 3 and kind in ("array", "sequence"):
        item = random_type(rng, depth + 1)
        while isinstance(item, (Array, Sequence)):
            item = random_type(rng, depth + 1)
        return Array(item, rng.choice((1, 2, 3, 70))) if kind == "array" else Sequence(item)
    if kind in ("string", "wide"):
        return String() if kind == "string" else WideString()
    return rng.choice(list(PRIMITIVES.values()))


def random_description(rng: random.Random, depth: int = 0) -> TypeDescription:
    count = rng.choice((0, 1, 2, 3, 5))
    fields = (Field(f"f{i}", random_type(rng, depth)) for i in range(count))
    return TypeDescription("demo_msgs/msg/Random", tuple(fields))


def random_value(type_, rng: random.Random):
    if isinstance(type_, TypeDescription):
        return {field.name: random_value(field.type, rng) for field in type_.fields}
    if isinstance(type_, (Array, Sequence)):
        count = type_.length if isinstance(type_, Array) else rng.choice((0, 1, 2, 5, 40))
        if type_.item in OCTETS:
            return base64.b64encode(rng.randbytes(count)).decode()
        return [random_value(type_.item, rng) for _ in range(count)]
    if isinstance(type_, (String, WideString)):
        return "日" * rng.randint(0, 1) + "x" * rng.randint(0, 8)
    return (
        rng.random() < 0.5
        if type_.name == "bool"
        else rng.randint(0, 100) * (0.5 if type_.is_float else 1)
    )


def write(type_, value, body: bytearray, order: str) -> None:
    """CDR by the standard, one number after the other."""

    def number(code: str, value) -> None:
        body.extend(bytes(-len(body) % struct.calcsize(f"<{code}")))
        body.extend(struct.pack(order + code, value))

    if isinstance(type_, TypeDescription):
        for field in type_.fields:
            write(field.type, value[field.name], body, order)
        body.extend(b"" if type_.fields else b"\0")
    elif isinstance(type_, (Array, Sequence)):
        items = base64.b64decode(value) if type_.item in OCTETS else value
        if isinstance(type_, Sequence):
            number("I", len(items))
        for item in items:
            write(type_.item, item, body, order)
    elif isinstance(type_, String):
        number("I", len(value.encode()) + 1)
        body.extend(value.encode() + b"\0")
    elif isinstance(type_, WideString):
        number("I", len(value))
        for letter in value:
            number("I", ord(letter))
    else:
        number(type_.code, value)


OCTETS = [PRIMITIVES[name] for name in ("uint8", "byte", "char")]


def test_random_types() -> None:
    """Alignment behind every kind of field, in loops inside of loops: more than ROS has types."""
    rng = random.Random(7)
    for _ in range(400):
        description = random_description(rng)
        converter = compile_converter(description)
        generated = generate(description)
        for _ in range(3):
            value = random_value(description, rng)
            little, big = bytearray(), bytearray()
            write(description, value, little, "<")
            write(description, value, big, ">")
            message = HEADER_BYTES + bytes(little)
            assert generated.encode(value) == message
            assert generated.decode_plain(message) == value
            assert orjson.loads(converter.to_json(message)) == value
            assert converter.from_json(orjson.dumps(value)) == message
            assert converter.to_dict(bytes(4) + bytes(big)) == value


# --- JSON: what is taken --------------------------------------------------------------------


def test_missing_fields_take_their_defaults() -> None:
    converter = compile_converter(TWIST)
    assert converter.from_json(b"{}") == HEADER_BYTES + bytes(48)
    assert converter.to_dict(converter.from_json(b'{"linear":{"y":0.5}}'))["linear"] == {
        "x": 0.0,
        "y": 0.5,
        "z": 0.0,
    }
    declared = of(Sequence(PRIMITIVES["int32"]), default=[1, 2])
    assert declared.to_dict(declared.from_json(b"{}")) == {"data": [1, 2]}
    octets = of(Array(UINT8, 2))
    assert octets.from_json(b"{}") == HEADER_BYTES + bytes(2)


def test_null_is_nan_and_infinity_does_not_come_back() -> None:
    """Equality after a round trip, said precisely: inf → null → NaN."""
    for type_, code in ((FLOAT32, "f"), (FLOAT64, "d")):
        one, many = of(type_), of(Sequence(type_))
        for number in (math.nan, math.inf, -math.inf):
            message = HEADER_BYTES + struct.pack(f"<{code}", number)
            assert one.to_json(message) == b'{"data":null}'
            assert math.isnan(one.to_dict(one.from_json(b'{"data":null}'))["data"])
            message = one.from_dict({"data": number})
            assert struct.unpack(code, message[4:]) == pytest.approx((number,), nan_ok=True)
        # In arrays too, short and long ones.
        for count in (1, 5, 100):
            message = many.from_dict({"data": [1.0] * count + [math.inf]})
            payload = many.to_json(message)
            assert orjson.loads(payload) == {"data": [1.0] * count + [None]}
            again = many.to_dict(many.from_json(payload))["data"]
            assert again[:-1] == [1.0] * count
            assert math.isnan(again[-1])


def test_now() -> None:
    converters = Converters({"std_msgs/msg/Header": HEADER}.__getitem__, now=lambda: 12_000_000_034)
    converter = converters.get("std_msgs/msg/Header")
    message = converter.from_json(b'{"stamp":"now","frame_id":"map"}')
    assert converter.to_dict(message) == {"stamp": {"sec": 12, "nanosec": 34}, "frame_id": "map"}
    # Only a time is now: and one that ROS has no room for is an error like any other.
    assert refusal(compile_converter(TWIST), '{"linear":"now"}') == (
        'linear: expected an object, got "now"'
    )
    late = compile_converter(HEADER, now=lambda: 2**31 * 10**9)
    assert refusal(late, '{"stamp":"now"}') == "stamp.sec: 2147483648 does not fit in int32"


def test_bytes_as_base64_or_list() -> None:
    for type_ in (Sequence(UINT8), Array(UINT8, 3), Sequence(PRIMITIVES["byte"], 3)):
        converter = of(type_)
        message = converter.from_json(b'{"data":"AP+A"}')
        assert message.endswith(b"\x00\xff\x80")
        assert converter.from_json(b'{"data":[0,255,128]}') == message
        assert converter.from_dict({"data": b"\x00\xff\x80"}) == message
        assert converter.to_json(message) == b'{"data":"AP+A"}'
    signed = of(Sequence(PRIMITIVES["int8"]))
    assert signed.to_json(signed.from_json(b'{"data":[-1]}')) == b'{"data":[-1]}'


def test_integers_of_64_bits() -> None:
    for name, number in (("int64", -(2**63)), ("int64", 2**63 - 1), ("uint64", 2**64 - 1)):
        converter = of(PRIMITIVES[name], Sequence(PRIMITIVES[name]))
        payload = b'{"a":%d,"b":[%d]}' % (number, number)
        assert converter.to_json(converter.from_json(payload)) == payload


def test_floats_take_integers() -> None:
    converter = of(FLOAT64, Sequence(FLOAT32), Array(FLOAT64, 2))
    assert converter.to_json(converter.from_json(b'{"a":1,"b":[2,3.5],"c":[4,5]}')) == (
        b'{"a":1.0,"b":[2.0,3.5],"c":[4.0,5.0]}'
    )


def test_float32_arrays_are_short_and_exact() -> None:
    converter = of(Sequence(FLOAT32))
    assert converter.to_json(converter.from_json(b'{"data":[0.8]}')) == b'{"data":[0.8]}'
    # The one float32 whose shortest digits, read as a double, lead to its neighbour.
    for bits in (0x15AE43FD, 0x95AE43FD):
        message = HEADER_BYTES + struct.pack("<II", 1, bits)
        assert converter.from_json(converter.to_json(message)) == message


def test_duplicates_and_the_order_of_fields() -> None:
    converter = of(PRIMITIVES["int32"], String())
    expected = converter.from_dict({"a": 2, "b": "x"})
    assert converter.from_json(b'{"b":"x","a":1,"a":2}') == expected


# --- JSON: what is refused ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("payload", "problem"),
    [
        ('{"linear":{"x":"a string"}}', 'linear.x: expected a number, got "a string"'),
        ('{"linear":{"x":true}}', "linear.x: expected a number, got true"),
        ('{"linear":{"x":[]}}', "linear.x: expected a number, got an array"),
        ('{"linear":[1,2,3]}', "linear: expected an object, got an array"),
        ('{"linear":{"vx":1}}', "linear.vx: unknown field; did you mean 'x'?"),
        ('{"lineal":{}}', "lineal: unknown field; did you mean 'linear'?"),
        ('{"q":1}', "q: unknown field; there are linear, angular"),
        (
            '{"linear":{"x":1,"y":2,"z":3,"w":4},"angular":{"x":1,"y":2,"z":3}}',
            "linear.w: unknown field; there are x, y, z",
        ),
        ("[]", "expected an object, got an array"),
        ("null", "expected an object, got null"),
        ("5", "expected an object, got 5"),
        ('{"a\\n\\u0000":1}', "a\\n\\u0000: unknown field; there are linear, angular"),
    ],
)
def test_a_refusal_names_the_field(payload: str, problem: str) -> None:
    assert refusal(compile_converter(TWIST), payload) == problem


@pytest.mark.parametrize(
    ("type_", "value", "problem"),
    [
        (PRIMITIVES["bool"], "1", "expected true or false, got 1"),
        (PRIMITIVES["bool"], "null", "expected true or false, got null"),
        (PRIMITIVES["int32"], "1.0", "expected an integer, got 1.0"),
        (PRIMITIVES["int32"], "true", "expected an integer, got true"),
        (PRIMITIVES["int32"], "2147483648", "2147483648 does not fit in int32"),
        (PRIMITIVES["uint8"], "-1", "-1 does not fit in uint8"),
        (PRIMITIVES["uint64"], "-1", "-1 does not fit in uint64"),
        (PRIMITIVES["uint64"], "1" + "0" * 50, "expected an integer, got 1e+50"),
        (FLOAT32, "1e39", "1e+39 does not fit in float32"),
        (FLOAT64, '"NaN"', 'expected a number, got "NaN"'),
        (FLOAT64, "{}", "expected a number, got an object"),
        (Sequence(FLOAT32), "[0,1e39]", "[1]: 1e+39 does not fit in float32"),
        (Sequence(FLOAT64), "[0.0,false]", "[1]: expected a number, got false"),
        (Sequence(FLOAT64), '""', 'expected an array, got ""'),
        (Sequence(FLOAT64), "{}", "expected an array, got an object"),
        (Sequence(PRIMITIVES["int16"], 2), "[1,2,3]", "3 items, at most 2 are allowed"),
        (Sequence(PRIMITIVES["bool"]), "[1]", "[0]: expected true or false, got 1"),
        (Sequence(PRIMITIVES["int16"]), "[true]", "[0]: expected an integer, got true"),
        (Array(FLOAT64, 3), "[1,2]", "2 items, expected exactly 3"),
        (Array(FLOAT64, 100), "[]", "0 items, expected exactly 100"),
        (Array(FLOAT64, 2), "[true,1]", "[0]: expected a number, got true"),
        (Array(VECTOR3, 1), "[]", "0 items, expected exactly 1"),
        (Array(VECTOR3, 1), '[{"x":""}]', '[0].x: expected a number, got ""'),
        (Array(UINT8, 3), '"AQI="', "2 items, expected exactly 3"),
        (Sequence(UINT8), '"AQI"', 'not base64: "AQI"'),
        (Sequence(UINT8), '"A Q I ="', 'not base64: "A Q I ="'),
        (Sequence(UINT8), '"é"', 'not base64: "é"'),
        (Sequence(UINT8), "[1,256]", "[1]: 256 does not fit in uint8"),
        (Sequence(UINT8), "1", "expected base64 or an array, got 1"),
        (Sequence(UINT8, 1), '"AQI="', "2 items, at most 1 are allowed"),
        (String(), "1", "expected a string, got 1"),
        (String(), '"a\\u0000b"', "a ROS string cannot hold the character U+0000"),
        (String(3), '"éé"', "4 bytes of UTF-8, at most 3 are allowed"),
        (WideString(1), '"😀"', "2 units of UTF-16, at most 1 are allowed"),
        (WideString(), "[]", "expected a string, got an array"),
        (Sequence(String(2)), '["","abc"]', "[1]: 3 bytes of UTF-8, at most 2 are allowed"),
        (EMPTY, "[]", "expected an object, got an array"),
        (EMPTY, '{"x":1}', ".x: unknown field"),
    ],
)
def test_types_ranges_and_bounds(type_, value: str, problem: str) -> None:
    separator = "" if problem.startswith(("[", ".")) else ": "
    assert refusal(of(type_), f'{{"data":{value}}}') == f"data{separator}{problem}"


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{",
        b'{"data":NaN}',
        b'{"data":Infinity}',
        b'{"data":1e999}',
        b'{"data":"\\ud800"}',
        b'{"data":"\xff"}',
        b'{"data":' + b"[" * 100_000,
        b"\x00",
        b"\xef\xbb\xbf{}",
    ],
)
def test_not_json(payload: bytes) -> None:
    for type_ in (String(), FLOAT64, Sequence(FLOAT64), VECTOR3):
        assert refusal(of(type_), payload).startswith("not JSON: ")


def test_hostile_json_is_quoted_short() -> None:
    assert len(refusal(of(FLOAT64), '{"data":"' + "x" * 10**6 + '"}')) < 200
    assert len(refusal(of(FLOAT64), '{"' + "x" * 10**6 + '":1}')) < 200
    assert "expected a number, got an array" in refusal(
        of(FLOAT64), '{"data":' + "[" * 900 + "]" * 900 + "}"
    )


def test_python_values_beyond_json() -> None:
    for type_, value in (
        (PRIMITIVES["int32"], 10**5000),
        (FLOAT64, 10**400),
        (String(), "\ud800"),
        (WideString(), "\udfff"),
        (FLOAT64, object()),
        (Sequence(UINT8), "\ud800"),
    ):
        with pytest.raises(ConversionError, match=r"^data: "):
            of(type_).from_dict({"data": value})
    with pytest.raises(ConversionError, match="unknown field"):
        of(FLOAT64).from_dict({1: 2})


# --- text -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("type_", "text", "value"),
    [
        (PRIMITIVES["bool"], b"true", True),
        (PRIMITIVES["bool"], b"false", False),
        (PRIMITIVES["int32"], b"-5", -5),
        (PRIMITIVES["uint64"], b"18446744073709551615", 2**64 - 1),
        (FLOAT64, b"0.5", 0.5),
        (FLOAT64, b"inf", math.inf),
        (FLOAT64, b"-inf", -math.inf),
        (String(), " é\n".encode(), " é\n"),
        (WideString(), "é😀".encode(), "é😀"),
    ],
)
def test_text(type_, text: bytes, value) -> None:
    converter = of(type_)
    message = from_text(converter, text)
    assert converter.to_dict(message) == {"data": value}
    assert to_text(converter, message) == text


def test_text_as_people_type_it() -> None:
    for type_, text, value in (
        (FLOAT64, b" 21.50\r\n", 21.5),
        (FLOAT32, b"5", 5.0),
        (FLOAT64, b".5", 0.5),
        (FLOAT64, b"-1E3", -1000.0),
        (PRIMITIVES["int8"], b"+007\n", 7),
        (PRIMITIVES["bool"], b"true\n", True),
    ):
        assert of(type_).to_dict(from_text(of(type_), text)) == {"data": value}
    nan = of(FLOAT32)
    assert math.isnan(nan.to_dict(from_text(nan, b"NaN"))["data"])
    assert to_text(nan, from_text(nan, b"nan")) == b"nan"


@pytest.mark.parametrize(
    ("type_", "text", "problem"),
    [
        (PRIMITIVES["bool"], b"1", 'data: expected true or false, got "1"'),
        (PRIMITIVES["int32"], b"1.5", 'data: expected an integer, got "1.5"'),
        (PRIMITIVES["int32"], b"1_0", 'data: expected an integer, got "1_0"'),
        (PRIMITIVES["int32"], "٣".encode(), 'data: expected an integer, got "٣"'),
        (PRIMITIVES["int8"], b"128", "data: 128 does not fit in int8"),
        (PRIMITIVES["int8"], b"9" * 5000, f'data: expected an integer, got "{"9" * 40}…"'),
        (FLOAT64, b"1_0.0", 'data: expected a number, got "1_0.0"'),
        (FLOAT64, b"", 'data: expected a number, got ""'),
        (FLOAT32, b"1e39", "data: 1e+39 does not fit in float32"),
        (FLOAT32, b"1e400", "data: 1e400 does not fit in float32"),
        (PRIMITIVES["float64"], b"-1e400 ", "data: -1e400 does not fit in float64"),
        (FLOAT64, b"\xff", "data: not UTF-8"),
        (String(), b"\xff", "data: not UTF-8"),
        (String(), b"\x00", "data: a ROS string cannot hold the character U+0000"),
    ],
)
def test_text_refused(type_, text: bytes, problem: str) -> None:
    with pytest.raises(ConversionError) as caught:
        from_text(of(type_), text)
    assert str(caught.value) == problem


def test_only_a_lone_data_field_goes_as_text() -> None:
    for converter in (
        compile_converter(TWIST),
        of(Sequence(FLOAT64)),
        of(VECTOR3),
        of(FLOAT64, name="value"),
        compile_converter(EMPTY),
    ):
        text = ENCODINGS["text"]
        with pytest.raises(UnknownTypeError, match="cannot go as text"):
            text.encoder(converter)
        with pytest.raises(UnknownTypeError, match="cannot go as text"):
            text.decoder(converter, DEFAULT_ITEMS)


# --- descriptions ---------------------------------------------------------------------------


def test_a_converter_is_compiled_once() -> None:
    loaded = []

    def load(name: str) -> TypeDescription:
        loaded.append(name)
        return TWIST

    converters = Converters(load)
    assert converters.get("geometry_msgs/msg/Twist") is converters.get("geometry_msgs/msg/Twist")
    assert loaded == ["geometry_msgs/msg/Twist"]
    assert "def encode(message):" in converters.get("geometry_msgs/msg/Twist").source


@pytest.mark.parametrize("name", ["", "1a", "a b", "a'", "a\n", "a\nb", "_a", "é", "a.b"])
def test_a_field_whose_name_is_no_identifier(name: str) -> None:
    """Names become part of generated code: nothing but a name may."""
    with pytest.raises(UnknownTypeError):
        Field(name, FLOAT64)


@pytest.mark.parametrize(
    "name", ["class", "q", "b", "w", "message", "HEADER", "join", "len", "def", "R_1", "None"]
)
def test_field_names_that_mean_something_in_python(name: str) -> None:
    converter = compile_converter(
        TypeDescription(
            "demo_msgs/msg/Names",
            (
                Field(name, String()),
                Field("list", Sequence(TypeDescription("a/msg/B", (Field(name, String()),)))),
            ),
        )
    )
    payload = orjson.dumps({name: "x", "list": [{name: "y"}]})
    assert converter.to_json(converter.from_json(payload)) == payload


@pytest.mark.parametrize(
    "name",
    ["", "x", "no_such_package/msg/X", "../msg/X", "os/path", "json/msg/X", "a/b/c/d", "a/msg/X\n"],
)
def test_an_unknown_type(name: str) -> None:
    with pytest.raises(UnknownTypeError):
        import_message(name)


def test_a_field_that_ros_cannot_carry() -> None:
    class BasicType:
        typename = "wchar"

    class Odd:
        SLOT_TYPES = (BasicType(),)

        @classmethod
        def get_fields_and_field_types(cls):
            return {"letter": "wchar"}

    Odd.__module__ = "demo_msgs.msg._odd"
    with pytest.raises(UnknownTypeError, match=r"demo_msgs/msg/Odd\.letter has the type wchar"):
        describe(Odd, import_message)


# What is large, and what is handed on


def test_checked_cdr_has_no_options():
    converter = Converters(load_description).get("std_msgs/msg/Float64")
    value = struct.pack("<d", 1.5)
    assert converter.checked(b"\0\1\0\3" + value) == b"\0\1\0\0" + value
    with pytest.raises(ConversionError):
        converter.checked(b"\0\1\0\0" + value[:7])


def test_a_large_payload_must_be_exact():
    """What is left out costs so much time that there is a bound."""
    converter = Converters(load_description).get("geometry_msgs/msg/PoseArray")
    pose = converter.to_dict(converter.from_json(b'{"poses":[{}]}'))["poses"][0]
    many = orjson.dumps({"header": {"frame_id": "a", "stamp": {}}, "poses": [{}] * 100})
    assert len(converter.to_dict(converter.from_json(many))["poses"]) == 100
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    exact = orjson.dumps({"header": header, "poses": [pose] * 3100})
    assert len(exact) > LARGEST_LENIENT
    assert len(converter.to_dict(converter.from_json(exact))["poses"]) == 3100
    with pytest.raises(ConversionError, match="does not have exactly the fields of"):
        converter.from_json(b'{"poses":[' + b"{}," * 100_000 + b"{}]}")


def test_checked_cdr_has_no_text_that_rclpy_cannot_read():
    converter = Converters(load_description).get("test_msgs/msg/WStrings")
    cdr = converter.from_json(b'{"wstring_value": "ab"}')
    lone = cdr.replace(b"b\0\0\0", b"\x00\xd8\0\0", 1)
    assert converter.to_dict(lone)["wstring_value"] == "a\ufffd"
    with pytest.raises(ConversionError, match="wstring_value: not UTF-16"):
        converter.checked(lone)


def test_checked_cdr_has_no_text_beyond_its_bound():
    converters = Converters(load_description)
    cdr = b"\0\1\0\0" + struct.pack("<I24s", 24, b"x" * 23)
    bounded = compile_converter(TypeDescription("a/msg/B", (Field("data", String(22)),)))
    assert bounded.to_dict(cdr) == {"data": "x" * 23}
    with pytest.raises(ConversionError, match="data: 23 bytes of UTF-8, at most 22"):
        bounded.checked(cdr)
    assert converters.get("std_msgs/msg/String").checked(cdr) == cdr


@pytest.mark.parametrize(
    ("bulk", "types"),
    [
        (Bulk.NOTHING, ["std_msgs/String", "sensor_msgs/Imu", "geometry_msgs/PoseArray"]),
        (Bulk.NUMBERS, ["sensor_msgs/JointState", "sensor_msgs/Joy", "sensor_msgs/LaserScan"]),
        (Bulk.NUMBERS, ["trajectory_msgs/JointTrajectory"]),  # in what is in it
        (Bulk.BYTES, ["sensor_msgs/Image", "nav_msgs/OccupancyGrid", "absent_msgs/Absent"]),
        (Bulk.BYTES, ["visualization_msgs/MarkerArray"]),  # as well
    ],
)
def test_what_can_make_messages_large(bulk, types):
    converters = Converters(load_description)
    assert {converters.bulk(name.replace("/", "/msg/")) for name in types} == {bulk}


def test_a_type_name_imports_only_message_packages(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "broken_msgs" / "msg").mkdir(parents=True)
    (tmp_path / "broken_msgs" / "msg" / "__init__.py").write_text("1 / 0")
    with pytest.raises(UnknownTypeError, match="broken_msgs is broken: ZeroDivisionError"):
        import_message("broken_msgs/msg/A")
    with pytest.raises(UnknownTypeError, match="this is not a package of messages"):
        import_message("this/msg/A")
    assert "this" not in sys.modules
