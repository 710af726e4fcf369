"""The cost of a message for ROS: how much work it is, estimated before it is decoded.

A few bytes can be much work: 1 MiB of nothing but empty texts, lists or typed arrays takes half a
second to convert. So one cheap pass counts what is in a payload. A number, a name, `true`, `false`
and `null` cost 1 each, a text, a list or an object 8, a typed array 24. A cost of 1 is about 0.1 µs
of work. Byte strings and the items of typed arrays are only copied, and cost nothing however many
they are.
"""

from __future__ import annotations

from appliance.ros.payload.definitions import (
    Array,
    FieldType,
    Primitive,
    Sequence,
    String,
    TypeDescription,
    WideString,
)

#: The cost of a text, a list or an object, and what the tag of a typed array adds to it.
CONTAINER_COST = 8
TAG_COST = 16

#: The cost that a message may have by default; `bridge.limits.items` configures it.
DEFAULT_ITEMS = 100_000

#: Bytes of a text in CBOR that cost 1, as they are read, searched and written.
TEXT_BYTES_PER_ITEM = 32

#: The fallback (fallback.py) takes so many times as long as generated code.
FALLBACK_FACTOR = 4

#: The deepest nesting of lists and objects: deeper than any message type.
MAX_DEPTH = 64


def over_limit(most: int) -> str:
    """The error text for a message that costs more than `most`."""
    return f"it has more texts, lists, objects and numbers than {most} (bridge.limits.items)"


def cost_of(type_: FieldType) -> int:
    """The least cost of a value of that type: its variable-length arrays are empty."""
    if isinstance(type_, Primitive):
        return 1
    if isinstance(type_, (String, WideString, Sequence)):
        return CONTAINER_COST
    if isinstance(type_, TypeDescription):
        return CONTAINER_COST + sum(cost_of(field.type) for field in type_.fields)
    if isinstance(type_.item, Primitive):
        return CONTAINER_COST + (0 if type_.item.is_octet else type_.length)
    assert isinstance(type_, Array)
    return CONTAINER_COST + type_.length * cost_of(type_.item)


def json_cost(payload: bytes, most: int) -> int:
    """The cost of a JSON text, or any number above `most` when it costs more than that."""
    if len(payload) * CONTAINER_COST <= most:
        return len(payload) * CONTAINER_COST  # an upper bound
    cost = _count_marks(payload, payload.count(b'"') // 2)
    if cost <= most:
        return cost
    # At least so many pairs of quotes are strings, and at most one a colon of these is a name.
    strings = (payload.count(b'"') - payload.count(rb"\"")) // 2
    cost = strings + (CONTAINER_COST - 1) * (strings - payload.count(b":"))
    if cost > most:
        return cost
    # Some of what was counted may be names, or characters within texts. Now remove the texts.
    parts = payload.replace(rb"\\", b"").replace(rb"\"", b"").split(b'"', most + 2)
    if len(parts) > most + 2:
        return most + 1  # a text is a name, which a value follows, or costs more than these two
    outside = b"".join(parts[::2])
    names = outside.count(b":")
    return names + _count_marks(outside, max(len(parts) // 2 - names, 0))


def _count_marks(payload: bytes, texts: int) -> int:
    containers = payload.count(b"[") + payload.count(b"{")
    return payload.count(b",") + 1 + CONTAINER_COST * (containers + texts)


#: The size of an item of CBOR by its first byte, for items of a fixed size: numbers, `true`,
#: `false`, `null`. Each costs 1.
_SIZES = {
    **dict.fromkeys((*range(0x18), *range(0x20, 0x38), *range(0xE0, 0xF8)), 1),
    **dict.fromkeys((0x18, 0x38, 0xF8), 2),
    **dict.fromkeys((0x19, 0x39, 0xF9), 3),
    **dict.fromkeys((0x1A, 0x3A, 0xFA), 5),
    **dict.fromkeys((0x1B, 0x3B, 0xFB), 9),
}
_SINGLE = bytes(first for first, size in _SIZES.items() if size == 1)

#: The same with short strings, whose first byte has the length; 0 for all other items.
_SHORT = {first: 1 + (first & 0x1F) for first in (*range(0x40, 0x58), *range(0x60, 0x78))}
_STEPS = [_SIZES.get(first, _SHORT.get(first, 0)) for first in range(256)]
_COSTS = [CONTAINER_COST if first in _SHORT else 1 for first in range(256)]

#: Items of a list from which on it is worth to try whether all of them have the same size.
_MANY = 16

_BREAK = 0xFF

#: The item count of a list or object that ends with a break: even, as an object has names and
#: values, and too large to be reached.
_ENDLESS = 1 << 62


def cbor_cost(payload: bytes, most: int) -> int:
    """The cost of an item of CBOR, or any number above `most` when it costs more than that.

    0 for bytes that are no CBOR, or nested deeper than MAX_DEPTH: the decoder reports these.
    """
    if len(payload) * (CONTAINER_COST + TAG_COST) <= most:
        return len(payload) * (CONTAINER_COST + TAG_COST)
    try:
        return _walk_cbor(payload, most)
    except IndexError:  # truncated, which the decoder reports
        return 0


def _walk_cbor(payload: bytes, most: int) -> int:
    steps, costs = _STEPS, _COSTS
    cost = at = 0
    left = 1  # items that are left in the innermost list or object, names included
    is_object = False
    outside: list[tuple[int, bool]] = []
    while cost <= most:
        if not left:
            if not outside:
                break
            left, is_object = outside.pop()
            continue
        first = payload[at]
        left -= 1
        is_name = is_object and left & 1
        step = steps[first]
        if step:
            at += step
            cost += 1 if is_name else costs[first]
            continue
        if first == _BREAK:
            at += 1
            left = 0
            continue
        kind = first >> 5
        count, at = _argument(payload, at)
        if kind == 6:
            cost += TAG_COST
            left += 1  # the tagged item
        elif kind > 3 or count == _ENDLESS:  # a list or an object; or a string in chunks
            cost += CONTAINER_COST
            outside.append((left, is_object))
            if len(outside) > MAX_DEPTH:
                return 0  # which the decoder reports
            is_object = kind == 5
            left = count * 2 if is_object and count != _ENDLESS else count
            if kind == 4 and _MANY <= left < _ENDLESS and (end := _end_of_same(payload, at, left)):
                cost += left
                left, at = 0, end
        else:  # a string
            at += count
            cost += 1 if is_name else CONTAINER_COST
            if kind == 3:
                cost += count // TEXT_BYTES_PER_ITEM
    return cost


def _argument(payload: bytes, at: int) -> tuple[int, int]:
    """The argument of an item's head, and the position behind the head.

    The argument is _ENDLESS when the item ends with a break. The position is beyond the payload
    when the head is truncated.
    """
    low = payload[at] & 0x1F
    if low < 24:
        return low, at + 1
    if low == 31:
        return _ENDLESS, at + 1
    if low > 27 or payload[at] >> 5 in (0, 1, 7):
        raise IndexError  # no CBOR
    end = at + 1 + (1 << low - 24)
    return int.from_bytes(payload[at + 1 : end], "big"), end


def _end_of_same(payload: bytes, at: int, count: int) -> int:
    """The position behind `count` numbers of one size; 0 when their sizes differ."""
    first = payload[at]
    size = _SIZES.get(first, 0)
    end = at + count * size
    if not size or end > len(payload):
        return 0
    if size == 1:
        return 0 if payload[at:end].translate(None, _SINGLE) else end
    return end if payload[at:end:size] == bytes([first]) * count else 0
