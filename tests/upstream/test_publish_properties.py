"""The properties of a message as it is sent, against those that the codec encodes."""

from __future__ import annotations

from datetime import datetime, timezone

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from appliance.mqtt.codec import (
    NO_PROPERTIES,
    Properties,
    Property,
    decode_varint,
    encode_properties,
    encode_property_list,
    encode_varint,
)
from appliance.upstream.publish_properties import PublishProperties, printable


def slow(
    published: bytes, expiry: int | None, number: int | None, published_at: float | None
) -> bytes:
    """The same with the codec and `datetime` alone."""
    more: Properties = {}
    pairs: list[tuple[str, str]] = []
    if expiry is not None:
        more[Property.MESSAGE_EXPIRY_INTERVAL] = expiry
    if number is not None:
        pairs.append(("id", f"{number:x}"))
    if published_at is not None:
        at = datetime.fromtimestamp(published_at, timezone.utc)
        pairs.append(("published-at", at.isoformat(timespec="milliseconds")))
    if pairs:
        more[Property.USER_PROPERTY] = pairs
    inside = published[decode_varint(published, 0)[1] :] + encode_property_list(more)
    return encode_varint(len(inside)) + inside


TIMES = st.floats(min_value=-1e9, max_value=1e10)
PROPERTIES = PublishProperties()  # one for all, as what it keeps is of another message


@given(
    st.sampled_from([0, 1, 60, 120, 130, 20_000]),
    st.none() | st.integers(0, 0xFFFF_FFFF),
    st.none() | st.integers(0, (1 << 64) - 1),
    st.none() | TIMES | TIMES.map(int) | st.integers(-(10**9), 10**10).map(lambda n: n + 0.9999996),
)
@example(0, None, None, 1_700_000_000.9995)
@example(0, None, None, 1_700_000_000.9999999)
@example(0, None, None, 1_699_999_999.9999999)
@example(0, None, None, -4.653)
@example(0, None, None, -1.0)
def test_fast_and_slow_are_the_same(
    size: int, expiry: int | None, number: int | None, published_at: float | None
) -> None:
    values: Properties = {Property.CONTENT_TYPE: "x" * size} if size else {}
    published = encode_properties(values)
    expected = slow(published, expiry, number, published_at)
    assert PROPERTIES.encode(published, expiry, number, published_at) == expected
    if published_at is not None:
        again = PROPERTIES.encode(published, expiry, number, published_at + 0.25)
        assert again == slow(published, expiry, number, published_at + 0.25)


@pytest.mark.parametrize("start", [-4.653, 0.0, 1_700_000_000.0, 1_699_999_999.999])
@pytest.mark.parametrize("step", [1.3e-7, 3.1e-5, 4.9e-4])
def test_times_that_follow_each_other(start: float, step: float) -> None:
    properties = PublishProperties()
    for place in range(1000):
        published = encode_properties({Property.CONTENT_TYPE: "x"} if place % 100 < 50 else {})
        expiry = 7 if place % 10 == 9 else None
        at = start - 3.01e-5 + place * step
        assert properties.encode(published, expiry, None, at) == slow(published, expiry, None, at)


def test_properties_that_hold_control_characters_are_left_out() -> None:
    good: Properties = {
        Property.CONTENT_TYPE: "text/plain",
        Property.CORRELATION_DATA: b"\x01\x7f",
        Property.USER_PROPERTY: [("a", "b"), ("ä", "")],
    }
    bad: Properties = {
        **good,
        Property.CONTENT_TYPE: "\x85",
        Property.USER_PROPERTY: [("a", "b"), ("c\x01", "d"), ("ä", ""), ("c", "\ufffe")],
    }
    assert printable(NO_PROPERTIES) == NO_PROPERTIES
    plain = {name: good[name] for name in good if name != Property.CONTENT_TYPE}
    for said, sent in ((good, good), (bad, plain), ({Property.CONTENT_TYPE: "\n"}, {})):
        assert printable(encode_properties(said)) == encode_properties(sent)
