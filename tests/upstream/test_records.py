"""Records of a backlog: their bytes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.upstream.records import Record, record_times

#: A record of every field, and its bytes.
EXAMPLE = Record(
    number=0x0102030405060708,
    rule="a/#",
    topic="r/ä",
    payload=b"\x00\xff",
    qos=2,
    retain=True,
    stored_at=1.5,
    expires_at=2.0,
    properties_wire=b"\x02\x01\x01",
)
BYTES = bytes.fromhex(
    "01"  # version
    "0102030405060708"  # number
    "3ff8000000000000"  # stored at 1.5
    "4000000000000000"  # expires at 2.0
    "06"  # QoS 2, retain
    "0003 0004 00000003 00000002"  # lengths of rule, topic, properties, payload
    "612f23"  # a/#
    "722fc3a4"  # r/ä
    "020101"  # properties: Payload Format Indicator 1
    "00ff"
)

TIMES = st.floats(allow_nan=False, allow_infinity=False)

RECORDS = st.builds(
    Record,
    number=st.integers(0, 2**64 - 1),
    rule=st.text(max_size=20),
    topic=st.text(min_size=1, max_size=20),
    payload=st.binary(max_size=100),
    qos=st.integers(0, 2),
    retain=st.booleans(),
    stored_at=TIMES,
    expires_at=st.none() | TIMES,
    properties_wire=st.binary(min_size=1, max_size=20),
)


def test_the_layout_is_stable() -> None:
    """What one version stores the next one reads."""
    assert EXAMPLE.encode() == BYTES
    assert Record.decode(BYTES) == EXAMPLE
    assert record_times(BYTES) == (EXAMPLE.number, 1.5, 2.0)


@given(RECORDS)
def test_what_was_encoded_is_decoded(record: Record) -> None:
    data = record.encode()
    assert Record.decode(data) == record
    expires = math.inf if record.expires_at is None else record.expires_at
    assert record_times(data) == (record.number, record.stored_at, expires)


@given(RECORDS, st.data())
def test_a_cut_or_longer_record_is_none(record: Record, data: st.DataObject) -> None:
    encoded = record.encode()
    cut = data.draw(st.integers(0, len(encoded) - 1))
    for wrong in (encoded[:cut], encoded + b"\0"):
        with pytest.raises(ValueError):
            Record.decode(wrong)


@given(st.binary(max_size=80))
def test_any_bytes_are_a_record_or_an_error(data: bytes) -> None:
    for wrong in (data, BYTES[:1] + data, BYTES[:40] + data):
        try:
            record = Record.decode(wrong)
        except ValueError:
            continue
        assert record.encode() == wrong


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (0, "00"),  # another version
        (0, "02"),
        (9, "7ff8000000000000"),  # stored at NaN
        (9, "7ff0000000000000"),  # stored at infinity
        (17, "7ff8000000000000"),  # expires at NaN
        (17, "fff0000000000000"),  # expires at minus infinity
        (25, "03"),  # QoS 3
        (25, "07"),
        (25, "08"),  # an unknown flag
        (25, "85"),
        (38, "ff"),  # a rule that is not UTF-8
        (44, "ff"),  # a topic that is not UTF-8
        (26, "0007 0000"),  # no topic
        (28, "0007 00000000"),  # no properties
    ],
)
def test_invalid_fields(place: int, value: str) -> None:
    wrong = bytearray(BYTES)
    new = bytes.fromhex(value)
    wrong[place : place + len(new)] = new
    with pytest.raises(ValueError):
        Record.decode(bytes(wrong))
