"""Every message type of ROS 1, against genpy: `python ros1_all_types.py [SEED [MUTATIONS]]`.

It runs where rospy is, and prints how many types and messages agreed; what did not is an
AssertionError. genpy makes the bytes from its own message objects, and `plain` walks these slowly
and plainly.
"""

from __future__ import annotations

import base64
import contextlib
import importlib
import json
import math
import pkgutil
import random
import re
import struct
import sys
import zlib
from io import BytesIO
from pathlib import Path

import genpy
import rospy

from appliance.ros.payload.codegen import MISFIT
from appliance.ros.payload.converter import ConversionError, Converters
from appliance.ros.payload.cost import DEFAULT_ITEMS
from appliance.ros.payload.encodings.cbor import Cbor
from appliance.ros.payload.fallback import decode as fallback_decode
from appliance.ros.payload.schema import json_schema
from appliance.ros.ros1.types import describe, full_name, installed

CBOR = Cbor()

VARIANTS = ("default", "smallest", "largest", "random 1", "random 2")

CODES = {
    "bool": "?",
    "byte": "b",
    "int8": "b",
    "uint8": "B",
    "char": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}


def classes():
    """Every message class, and both halves of every service, of the installed packages."""
    home = Path(rospy.__file__).parent.parent
    for module in pkgutil.iter_modules([str(home)]):
        for kind in ("msg", "srv"):
            if not (home / module.name / kind / "__init__.py").exists():
                continue
            package = importlib.import_module(f"{module.name}.{kind}")
            for name, found in sorted(vars(package).items()):
                if not isinstance(found, type) or not hasattr(found, "_md5sum"):
                    continue
                if kind == "msg":
                    yield full_name(found._type), found
                elif hasattr(found, "_request_class"):
                    yield f"{module.name}/srv/{name}_Request", found._request_class
                    yield f"{module.name}/srv/{name}_Response", found._response_class


def split(slot):
    """The type of an item, and how many there are: None for one, -1 for any number."""
    match = re.fullmatch(r"([^\[]+)(?:\[(\d*)\])?", slot)
    assert match is not None
    item, count = match.groups()
    return item, None if count is None else int(count) if count else -1


def fill(message, variant, rng):
    if variant != "default":
        for name, slot in zip(message.__slots__, message._slot_types, strict=True):
            setattr(message, name, value_of(slot, variant, rng))
    return message


def value_of(slot, variant, rng):
    item, count = split(slot)
    if count is None:
        return one_of(item, variant, rng)
    if count < 0:
        most = 80 if item in CODES and rng.random() < 0.2 else 5
        count = {"smallest": 0, "largest": most}.get(variant, rng.randint(0, most))
    values = [one_of(item, variant, rng) for _ in range(count)]
    return bytes(values) if item in ("uint8", "char") else values


def one_of(item, variant, rng):
    if item == "string":
        count = {"smallest": 0, "largest": 20}.get(variant, rng.randint(0, 9))
        return "".join(rng.choice('aZ0 "\\/\n\x7fé\u2028日😀\0') for _ in range(count))
    if item in ("time", "duration"):
        least, most = (0, 2**32 - 1) if item == "time" else (-(2**31), 2**31 - 1)
        secs = {"smallest": least, "largest": most}.get(variant, rng.randint(least, most))
        nanosec = {"smallest": 0, "largest": 999999999}.get(variant, rng.randrange(10**9))
        return (genpy.Time if item == "time" else genpy.Duration)(secs, nanosec)
    if item not in CODES:
        return fill(genpy.message.get_message_class(item)(), variant, rng)
    code = CODES[item]
    if code == "?":
        return {"smallest": False, "largest": True}.get(variant, rng.random() < 0.5)
    if code in "fd":
        largest = 3.4028234663852886e38 if code == "f" else sys.float_info.max
        special = [0.0, -0.0, 1.0, 0.1, math.nan, math.inf, -math.inf, largest, 2.0**-149, math.pi]
        number = rng.choice(special) if rng.random() < 0.4 else rng.uniform(-1e3, 1e3)
        number = {"smallest": -largest, "largest": largest}.get(variant, number)
        return struct.unpack(code, struct.pack(code, number))[0]
    bits = struct.calcsize(f"<{code}") * 8
    least, most = (0, 2**bits - 1) if code.isupper() else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    some = rng.choice([least, most, 0, 1, rng.randint(least, most)])
    return {"smallest": least, "largest": most}.get(variant, some)


def plain(slot, value):
    """What JSON has of a value, by the conventions."""
    item, count = split(slot)
    if count is not None and item in ("uint8", "char"):
        return base64.b64encode(bytes(value)).decode()
    if count is not None:
        return [plain(item, one) for one in value]
    if item in ("time", "duration"):
        return {"sec": value.secs, "nanosec": value.nsecs}
    if item == "float32" and math.isfinite(value):
        return struct.unpack("f", struct.pack("f", value))[0]
    return value if item in CODES or item == "string" else whole(value)


def whole(message):
    return {
        name: plain(slot, getattr(message, name))
        for name, slot in zip(message.__slots__, message._slot_types, strict=True)
    }


def serialized(message):
    buffer = BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


def same(a, b, *, exact):
    """Equal, NaN too. In JSON, infinities are null; float32 has fewer digits, but is the same."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k], exact=exact) for k in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(same(x, y, exact=exact) for x, y in zip(a, b, strict=True))
    if isinstance(b, float) and not math.isfinite(b):
        return a is None or (exact and (a == b or (math.isnan(a) and math.isnan(b))))
    if isinstance(b, float) and not exact:
        return math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-45)
    return type(a) is type(b) and a == b


def finite(value):
    if isinstance(value, dict):
        return all(map(finite, value.values()))
    if isinstance(value, list):
        return all(map(finite, value))
    return not isinstance(value, float) or not math.isinf(value)


def takes(convert, data):
    try:
        return convert(data)
    except (ConversionError, *MISFIT):
        return None


def mutate(data, rng):
    data = bytearray(data)
    for _ in range(rng.randint(1, 3)):
        if not data:
            break
        place = rng.randrange(len(data))
        kind = rng.randrange(4)
        if kind == 0:
            del data[place:]
        elif kind == 1:
            data[place] ^= 1 << rng.randrange(8)
        elif kind == 2:
            data[place : place + 4] = rng.choice(
                [b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f"]
            )
        else:
            data[place:place] = rng.randbytes(rng.randint(1, 9))
    return bytes(data)


def check(name, message_class, seed, mutations):
    converters = Converters(lambda wanted: describe(wanted, installed(wanted).text))
    converter = converters.get(name)
    json_schema(converter.description)
    decode = converter._decode
    to_cbor, from_cbor = CBOR.encoder(converter), CBOR.decoder(converter, DEFAULT_ITEMS)
    rng = random.Random(zlib.crc32(f"{name} {seed}".encode()))
    checked = 0
    for variant in VARIANTS:
        message = fill(message_class(), variant, rng)
        data, expected = serialized(message), whole(message)
        decode(data)  # the fast way takes it
        assert same(converter.to_dict(data), expected, exact=True), (name, variant)
        assert same(fallback_decode(converter.description, data), expected, exact=True), name
        assert same(json.loads(converter.to_json(data)), expected, exact=False), (name, variant)
        back = converter.from_json(converter.to_json(data))
        if finite(expected):
            assert same(whole(message_class().deserialize(back)), expected, exact=True), name
        assert len(back) == len(data), (name, variant)
        assert len(from_cbor(to_cbor(data))) == len(data), (name, variant)
        if "nan" not in repr(expected):  # of which there are many
            assert converter.from_dict(expected) == data, (name, variant)
            assert from_cbor(to_cbor(data)) == data, (name, variant)
            assert CBOR.loads(to_cbor(data)) is not None
        assert converter.checked(data) == data
        if variant == "default":
            assert converter.from_json(b"{}") == data, name
        checked += 1
        for _ in range(mutations):
            bad = mutate(data, rng)
            mine = takes(converter.to_dict, bad)
            theirs = None
            with contextlib.suppress(genpy.DeserializationError):
                theirs = message_class().deserialize(bad)
            # genpy takes a string that is cut off, and puts in order a time with too many
            # nanoseconds: what it writes is then something else, or nothing.
            is_exact = False
            with contextlib.suppress(genpy.SerializationError):
                is_exact = theirs is not None and bad.startswith(serialized(theirs))
            assert mine is not None or not is_exact, (name, bad.hex())
            assert theirs is not None or mine is None, (name, bad.hex(), mine)
            if mine is not None:
                assert takes(converter.to_json, bad) and takes(to_cbor, bad)
                assert not is_exact or same(mine, whole(theirs), exact=True), (name, bad.hex())
            fast = takes(decode, bad)
            assert fast is None or mine is not None, (name, bad.hex())
            checked += 1
    return checked


if __name__ == "__main__":
    seed = sys.argv[1] if len(sys.argv) > 1 else "0"
    mutations = int(sys.argv[2]) if len(sys.argv) > 2 else 4
    counts = {name: check(name, found, seed, mutations) for name, found in classes()}
    packages = {name.partition("/")[0] for name in counts}
    print(f"{len(packages)} packages, {len(counts)} types, {sum(counts.values())} messages")
