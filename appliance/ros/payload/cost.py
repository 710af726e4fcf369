"""How much work a message for ROS is, found out before it is decoded.

A few bytes can make much work: 1 MiB of nothing but empty texts, lists or typed arrays takes half a
second to convert. So what is in a payload is counted in one cheap pass, and weighed: a number, a
name, `true`, `false` and `null` are 1 each; a text, a list or an object 8; a typed array 24. Each 1
is some 0.1 µs of work. Strings of bytes and what is in a typed array are only copied, and weigh
nothing however long they are.
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

#: What a text, a list or an object weighs, and what is more with a tag on it, of a typed array.
CONTAINER_COST = 8
TAG_COST = 16

#: What a message may weigh if nothing else is said, see `bridge.limits.items`.
DEFAULT_ITEMS = 100_000

#: Bytes of a text in CBOR that weigh 1: they are read, searched and written.
TEXT_BYTES_PER_ITEM = 32

#: The careful way (careful.py) takes so many times as long as the fast one.
FALLBACK_FACTOR = 4

#: Lists and objects in one another: deeper than any message type.
MAX_DEPTH = 64


def over_limit(most: int) -> str:
    """What is wrong with a message that weighs more than `most`."""
    return f"it has more texts, lists, objects and numbers than {most} (bridge.limits.items)"


def cost_of(type_: FieldType) -> int:
    """What a value of that type weighs, with nothing in those of its arrays that may be empty."""
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
    """What a JSON text weighs; something above `most` when it is more than that."""
    if len(payload) * CONTAINER_COST <= most:
        return len(payload) * CONTAINER_COST  # it cannot be more
    weight = _weigh_marks(payload, payload.count(b'"') // 2)
    if weight <= most:
        return weight
    # At least so many of the quotes begin and end something, and no more of that are names.
    strings = (payload.count(b'"') - payload.count(rb"\"")) // 2
    weight = strings + (CONTAINER_COST - 1) * (strings - payload.count(b":"))
    if weight > most:
        return weight
    # What was counted may be names, or within texts, which are now taken out.
    parts = payload.replace(rb"\\", b"").replace(rb"\"", b"").split(b'"', 2 * most)
    outside = b"".join(parts[::2])
    names = outside.count(b":")
    return names + _weigh_marks(outside, max(len(parts) // 2 - names, 0))


def _weigh_marks(payload: bytes, texts: int) -> int:
    containers = payload.count(b"[") + payload.count(b"{")
    return payload.count(b",") + 1 + CONTAINER_COST * (containers + texts)


#: The bytes that one item of CBOR takes by its first byte, where that says all of it: numbers,
#: `true`, `false`, `null`; and what each weighs.
_SIZES = {
    **dict.fromkeys((*range(0x18), *range(0x20, 0x38), *range(0xE0, 0xF8)), 1),
    **dict.fromkeys((0x18, 0x38, 0xF8), 2),
    **dict.fromkeys((0x19, 0x39, 0xF9), 3),
    **dict.fromkeys((0x1A, 0x3A, 0xFA), 5),
    **dict.fromkeys((0x1B, 0x3B, 0xFB), 9),
}
_SINGLE = bytes(first for first, size in _SIZES.items() if size == 1)

#: The same with short strings, whose length is in their first byte; 0 for all else.
_SHORT = {first: 1 + (first & 0x1F) for first in (*range(0x40, 0x58), *range(0x60, 0x78))}
_STEPS = [_SIZES.get(first, _SHORT.get(first, 0)) for first in range(256)]
_WEIGHTS = [CONTAINER_COST if first in _SHORT else 1 for first in range(256)]

#: Items from which on it is tried whether all of them have the same size.
_MANY = 16

_BREAK = 0xFF

#: Items of what goes on until a break: an even number, as objects have, and never reached.
_ENDLESS = 1 << 62


def cbor_cost(payload: bytes, most: int) -> int:
    """What an item of CBOR weighs; something above `most` when it is more than that. Of what is no
    CBOR, or deeper than DEPTH, nothing: the decoder stops there, and says so."""
    if len(payload) * (CONTAINER_COST + TAG_COST) <= most:
        return len(payload) * (CONTAINER_COST + TAG_COST)
    try:
        return _walk_cbor(payload, most)
    except IndexError:  # it ends before its end, which the decoder will say
        return 0


def _walk_cbor(payload: bytes, most: int) -> int:
    steps, weights = _STEPS, _WEIGHTS
    weight = at = 0
    left = 1  # items to come in the innermost list or object, names included
    is_object = False
    outside: list[tuple[int, bool]] = []
    while weight <= most:
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
            weight += 1 if is_name else weights[first]
            continue
        if first == _BREAK:
            at += 1
            left = 0
            continue
        kind = first >> 5
        count, at = _argument(payload, at)
        if kind == 6:
            weight += TAG_COST
            left += 1  # what the tag is of
        elif kind > 3 or count == _ENDLESS:  # a list or an object; or a string in pieces
            weight += CONTAINER_COST
            outside.append((left, is_object))
            if len(outside) > MAX_DEPTH:
                return 0  # which the decoder will say
            is_object = kind == 5
            left = count * 2 if is_object and count != _ENDLESS else count
            if kind == 4 and _MANY <= left < _ENDLESS and (end := _end_of_same(payload, at, left)):
                weight += left
                left, at = 0, end
        else:  # a string
            at += count
            weight += 1 if is_name else CONTAINER_COST
            if kind == 3:
                weight += count // TEXT_BYTES_PER_ITEM
    return weight


def _argument(payload: bytes, at: int) -> tuple[int, int]:
    """The number in an item's head, and where what follows it begins; _ENDLESS when the item ends
    with a break, and beyond the payload when there is none."""
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
    """Where so many numbers end that take the same number of bytes each; 0 when they do not."""
    first = payload[at]
    size = _SIZES.get(first, 0)
    end = at + count * size
    if not size or end > len(payload):
        return 0
    if size == 1:
        return 0 if payload[at:end].translate(None, _SINGLE) else end
    return end if payload[at:end:size] == bytes([first]) * count else 0
