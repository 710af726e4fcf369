"""The registry of encodings, what the configuration knows of it, and what it takes to add one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

import pytest

from appliance.config import values
from appliance.config.reading import loads
from appliance.mqtt.codec import Property
from appliance.ros.payload.converter import ConversionError, Converter, compile_converter
from appliance.ros.payload.definitions import (
    CDR,
    PACKED,
    PRIMITIVES,
    Field,
    TypeDescription,
    UnknownTypeError,
)
from appliance.ros.payload.encodings import registry
from appliance.ros.payload.encodings.base import Decode, Encode, Encoding
from appliance.ros.payload.encodings.registry import CONTENT_TYPE, ENCODINGS, named_encoding
from appliance.ros.payload.payloads import InputLimits, packer, unpacker

FLOAT = compile_converter(
    TypeDescription("std_msgs/msg/Float64", (Field("data", PRIMITIVES["float64"]),))
)


class Digits(Encoding):
    """ROS's own bytes as hexadecimal digits: all that a new encoding needs."""

    name = "digits"
    content_type = "text/x-digits"
    is_text = True

    def encoder(self, converter: Converter) -> Encode:
        return lambda cdr: cdr.hex().encode()

    def decoder(self, converter: Converter, items: int) -> Decode:
        def decode(payload: bytes) -> bytes:
            try:
                cdr = bytes.fromhex(payload.decode())
            except ValueError:
                raise ConversionError("", "not hexadecimal digits") from None
            return converter.checked(cdr, items)

        return decode


def test_the_configuration_lists_the_encodings_that_there_are() -> None:
    """The configuration may not import the registry, and so lists the names once more."""
    for kind, registered in (
        ("Encoding", set(ENCODINGS)),
        ("CallEncoding", {name for name, each in ENCODINGS.items() if each.can_call}),
        ("ValueEncoding", set(registry.VALUE_ENCODINGS)),
    ):
        listed = set(get_args(getattr(values, kind)))
        assert listed == registered, f"change appliance.config.values.{kind}"


def test_the_configuration_knows_which_bus_has_which_bytes() -> None:
    assert registry.RAW == {"cdr": CDR, "ros1": PACKED}
    assert all(wire.encoding == name for name, wire in registry.RAW.items())
    for bus, own in (("ros2", "cdr"), ("ros1", "ros1")):
        text = f"bridge: {{bus: {bus}, topics: [{{ros: /a, to: mqtt, encoding: {own}}}]}}"
        assert loads(text, Path("appliance.yaml"), {}).bridge.topics[0].encoding == own


def test_content_types_are_distinct_and_name_their_encoding() -> None:
    assert len(set(CONTENT_TYPE.values())) == len(ENCODINGS)
    for name, encoding in ENCODINGS.items():
        named = named_encoding(f"{encoding.content_type.upper()}; charset=utf-8")
        assert named == (name if encoding.can_call else None)


def test_an_encoding_that_is_registered_carries_topics(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ENCODINGS, "digits", Digits())
    cdr = FLOAT.from_dict({"data": 0.5})
    payload, properties = packer(FLOAT, "digits", "none", [])(cdr)
    assert payload == cdr.hex().encode()
    assert properties[Property.CONTENT_TYPE] == "text/x-digits"
    for compression in ("none", "zstd"):
        payload, _ = packer(FLOAT, "digits", compression, [])(cdr)
        assert unpacker(FLOAT, "digits", compression, InputLimits())(payload) == cdr
    read = unpacker(FLOAT, "digits", "none", InputLimits(payload=40))
    for wrong, problem in ((b"0g", "not hexa"), (b"00010000", "truncated"), (b"0" * 41, "at most")):
        with pytest.raises(ConversionError, match=problem):
            read(wrong)


@pytest.mark.parametrize("name", ["text", "binary"])
def test_types_that_an_encoding_cannot_carry_are_refused_when_the_route_opens(name: str) -> None:
    fields = (Field("x", PRIMITIVES["float64"]),)
    converter = compile_converter(TypeDescription("a/msg/Point", fields))
    for make in (
        lambda: ENCODINGS[name].check(converter, to_ros=False),
        lambda: packer(converter, name, "none", []),
        lambda: unpacker(converter, name, "none", InputLimits()),
    ):
        with pytest.raises(UnknownTypeError, match=f"cannot go as {name}"):
            make()


def test_values_of_both_kinds_come_back() -> None:
    for encoding in registry.VALUE_ENCODINGS.values():
        value = encoding.values(FLOAT, FLOAT.from_json(b'{"data": 0.5}'))
        assert encoding.loads(encoding.dumps(value)) == {"data": 0.5}
        with pytest.raises(ConversionError, match="not "):
            encoding.loads(b"")
    assert json.loads(registry.VALUE_ENCODINGS["json"].dumps([1])) == [1]
