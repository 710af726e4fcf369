"""What is put on MQTT and taken from it: encodings, compression, fields, schemas, properties."""

from __future__ import annotations

import json
import struct

import cbor2
import pytest

from appliance.broker.message import Message
from appliance.mqtt.codec import Property
from appliance.ros.payload.fallback import ConversionError

pytest.importorskip("sensor_msgs.msg")
import zstandard
from bridge_harness import STRING, TWIST, Harness, both, string, to_mqtt, to_ros
from encoded import decoded, encoded, from_cbor, to_cbor

from appliance.ros.payload.converter import Converters
from appliance.ros.payload.definitions import (
    UnknownTypeError,
    import_message,
    load_description,
    select,
)
from appliance.ros.payload.encodings.registry import ENCODINGS
from appliance.ros.payload.payloads import InputLimits, packer, unpacker
from appliance.ros.payload.schema import json_schema

CONVERTERS = Converters(load_description)
PICTURE, IMAGE = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"
ODOMETRY, JOINTS = "nav_msgs/msg/Odometry", "sensor_msgs/msg/JointState"
ODOMETRY_PARTS = ("PoseWithCovariance", "Pose", "Point", "Quaternion", "TwistWithCovariance")
JPEG = b"\xff\xd8\xff\xe0" + bytes(range(256))


@pytest.fixture
async def harness():
    harness = Harness()
    parts = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    parts += tuple(f"geometry_msgs/msg/{name}" for name in ODOMETRY_PARTS)
    for name in (PICTURE, IMAGE, ODOMETRY, JOINTS, *parts):
        harness.node.types[name] = import_message(name)
    yield harness
    await harness.bridge.stop()


def properties_of(message):
    return dict(message.properties[Property.USER_PROPERTY])


# CBOR


def test_arrays_of_numbers_are_typed_arrays_and_bytes_are_bytes():
    joints = CONVERTERS.get(JOINTS)
    payload = to_cbor(joints, joints.from_json(b'{"name": ["a"], "position": [1.5, -2]}'))
    value = cbor2.loads(payload)
    assert value["name"] == ["a"]
    assert value["position"] == cbor2.CBORTag(86, struct.pack("<2d", 1.5, -2))
    picture = CONVERTERS.get(PICTURE)
    assert cbor2.loads(to_cbor(picture, decoded("binary", picture, JPEG)))["data"] == JPEG


@pytest.mark.parametrize(
    ("tag", "code"),
    [
        *[(64, "4B"), (65, ">4H"), (69, "<4H"), (71, "<4Q"), (72, "4b"), (74, ">4i"), (75, ">4q")],
        *[(77, "<4h"), (81, ">4f"), (82, ">4d"), (84, "<4e"), (85, "<4f"), (86, "<4d")],
    ],
)
def test_typed_arrays_of_any_kind_are_taken(tag, code):
    joints = CONVERTERS.get(JOINTS)
    payload = cbor2.dumps({"position": cbor2.CBORTag(tag, struct.pack(code, 0, 1, 2, 100))})
    assert joints.to_dict(from_cbor(joints, payload))["position"] == [0, 1, 2, 100]


@pytest.mark.parametrize(
    ("payload", "problem"),
    [
        (b"", "not CBOR"),
        (b"\xa0\x00", "something follows the message at 1"),
        (b"\xa1", "not CBOR"),
        (b"\x9b" + b"\xff" * 8, "not CBOR"),
        (b"\x5b\x7f" + b"\xff" * 7, "not CBOR"),
        (b"\x81" * 5000 + b"\x00", "nesting"),
        (b"\xa1\x01\x02", "map key"),
        (b"\xd8\x1c\xa0", "tag 28"),  # a value to be referred to
        (b"\xd9\x01\x00\xa0", "tag 25"),  # text to be referred to
        (b"\xc2\x41\x01", "tag 2 "),
        (b"\xd8\x63\x01", "tag 99"),
        (cbor2.dumps({"position": cbor2.CBORTag(86, b"123")}), "ends within a number"),
        (cbor2.dumps({"position": cbor2.CBORTag(86, [1])}), "not a byte string"),
    ],
)
def test_malformed_cbor_is_refused(payload, problem):
    with pytest.raises(ConversionError, match=problem):
        from_cbor(CONVERTERS.get(JOINTS), payload)


@pytest.mark.parametrize(
    ("value", "path"),
    [
        ({"twist": {"twist": {"linear": {"x": "fast"}}}}, "twist.twist.linear.x"),
        ({"header": {"stamp": {"sec": 2**31}}}, "header.stamp.sec"),
        ({"header": {"stamp": {"nanosec": 1.5}}}, "header.stamp.nanosec"),
        ({"header": {"frame": ""}}, "header.frame"),
        ({"pose": {"covariance": [0.0] * 35}}, "pose.covariance"),
        ({"pose": {"covariance": [0.0] * 35 + ["x"]}}, "pose.covariance[35]"),
        ({"pose": {"covariance": cbor2.CBORTag(86, bytes(8 * 37))}}, "pose.covariance"),
        ({"pose": {"covariance": bytes(36)}}, "pose.covariance"),
        ({"child_frame_id": b"bytes"}, "child_frame_id"),
        ({"child_frame_id": cbor2.undefined}, "child_frame_id"),
        ([], ""),
    ],
)
def test_wrong_cbor_is_refused_with_the_path_of_the_field(value, path):
    with pytest.raises(ConversionError) as caught:
        from_cbor(CONVERTERS.get(ODOMETRY), cbor2.dumps(value))
    assert caught.value.path == path


def test_cbor_does_not_allocate_more_than_it_is_given():
    """Ten levels of references, each to ten of the level below, would be 10^10 items."""
    level = cbor2.dumps([1] * 10)
    for _ in range(9):
        level = b"\xd8\x1c\x8a" + level + b"\xd8\x1d\x00" * 9
    with pytest.raises(ConversionError):
        ENCODINGS["cbor"].loads(level)


# fields


@pytest.mark.parametrize("path", ["speed", "pose.pose.positions", "pose.covariance.x", "pose."])
def test_an_unknown_field_is_refused_with_the_known_ones(path):
    with pytest.raises(UnknownTypeError, match="has no field"):
        select(load_description(ODOMETRY), [path])


async def test_some_fields_of_a_topic(harness):
    harness.start(to_mqtt("/odom", fields=("pose.pose.position", "header.stamp")))
    peer = harness.node.add_publisher("/odom", ODOMETRY)
    peer.publish(CONVERTERS.get(ODOMETRY).from_json(b'{"child_frame_id": "base"}'))
    await harness.settle()
    (payload,) = harness.client.payloads("r2d2/odom")
    assert json.loads(payload) == {
        "header": {"stamp": {"sec": 0, "nanosec": 0}},
        "pose": {"pose": {"position": {"x": 0, "y": 0, "z": 0}}},
    }


async def test_a_wrong_field_leaves_the_topic_unbridged_and_says_why(harness):
    harness.start(to_mqtt("/odom", fields=("speed",)))
    harness.node.add_publisher("/odom", ODOMETRY)
    await harness.settle()
    assert "no 'speed', there are header, child_frame_id" in harness.status().last_error
    assert harness.routes() == []


# pictures


async def test_a_picture_is_its_bytes_with_its_content_type(harness):
    harness.start(both("/camera", type=PICTURE, encoding="binary", keep=2))
    peer = harness.node.add_publisher("/camera", PICTURE)
    other = harness.node.add_subscriber("/camera", PICTURE)
    peer.publish(CONVERTERS.get(PICTURE).from_dict({"format": "jpeg", "data": JPEG}))
    peer.publish(CONVERTERS.get(PICTURE).from_dict({"format": "??", "data": b"else"}))
    await harness.settle()
    first, second = [m for m, _ in harness.client.received if m.topic == "r2d2/camera"]
    assert first.payload == JPEG
    assert first.properties[Property.CONTENT_TYPE] == "image/jpeg"
    assert second.properties[Property.CONTENT_TYPE] == "application/octet-stream"

    other.received.clear()
    harness.client.send("r2d2/camera", JPEG)
    (cdr,) = other.received
    value = CONVERTERS.get(PICTURE).to_dict(cdr)
    assert value["format"] == "jpeg"
    assert encoded("binary", CONVERTERS.get(PICTURE), cdr) == JPEG


async def test_a_raw_image_cannot_be_made_of_its_bytes(harness):
    harness.start(to_ros("/image", type=IMAGE, encoding="binary"))
    await harness.settle()
    assert "binary, which lacks encoding, height" in harness.status("to_ros").last_error


# zstd


async def test_compressed_both_ways(harness):
    harness.start(both("/chatter", type=STRING, compression="zstd"))
    peer = harness.node.add_publisher("/chatter", STRING)
    other = harness.node.add_subscriber("/chatter", STRING)
    peer.publish(string("a" * 1000))
    await harness.settle()
    (message,) = [m for m, _ in harness.client.received if m.topic == "r2d2/chatter"]
    assert len(message.payload) < 100
    assert json.loads(zstandard.decompress(message.payload)) == {"data": "a" * 1000}
    assert properties_of(message)["content-encoding"] == "zstd"

    other.received.clear()
    harness.client.send("r2d2/chatter", zstandard.compress(b'{"data": "small"}'))
    harness.client.send("r2d2/chatter", b'{"data": "plain"}')
    assert other.received == [string("small"), string("plain")]


@pytest.mark.parametrize("has_size", [True, False])
def test_a_decompression_bomb_is_refused(has_size):
    bomb = zstandard.ZstdCompressor(write_content_size=has_size).compress(bytes(50_000_000))
    assert len(bomb) < 5000
    unpack = unpacker(CONVERTERS.get(STRING), "json", "zstd", InputLimits(1_000_000))
    with pytest.raises(ConversionError, match="1000000"):
        unpack(bomb)


@pytest.mark.parametrize(
    "payload",
    [
        b"\x28\xb5\x2f\xfd",
        zstandard.compress(b'{"data": "x"}')[:-3],
        zstandard.compress(b'{"data": "x"}') + b"more",
        zstandard.compress(b"not json"),
        b"\x28\xb5\x2f\xfd" + b"\xff" * 40,
    ],
)
def test_malformed_zstd_is_refused(payload):
    with pytest.raises(ConversionError):
        unpacker(CONVERTERS.get(STRING), "json", "zstd", InputLimits(1000))(payload)


@pytest.mark.parametrize("encoding", ["json", "cbor", "text", "cdr"])
def test_every_encoding_can_be_compressed(encoding):
    converter = CONVERTERS.get(STRING)
    pack = packer(converter, encoding, "zstd", [("ros-type", STRING)])
    payload, properties = pack(string("x" * 100))
    assert properties[Property.USER_PROPERTY] == [
        ("ros-type", STRING),
        ("content-encoding", "zstd"),
    ]
    assert unpacker(converter, encoding, "zstd", InputLimits(1000))(payload) == string("x" * 100)


# what MQTT 5 says about a payload


@pytest.mark.parametrize(
    ("payload", "properties", "problem"),
    [
        (b"{}", {Property.USER_PROPERTY: [("ros-type", TWIST)]}, f"says to be '{TWIST}'"),
        (b"{}", {Property.USER_PROPERTY: [("ros-type", "x\n" * 999)]}, "x\\n'…, /chatter carries"),
        (b"\xa0", {Property.CONTENT_TYPE: "application/cbor"}, "the route takes json"),
    ],
)
async def test_a_payload_of_another_declared_type_does_not_reach_ros(
    harness, payload, properties, problem
):
    harness.start(to_ros("/chatter", type=STRING))
    peer = harness.node.add_subscriber("/chatter", STRING)
    harness.broker.publish(
        Message("r2d2/chatter", payload, properties=properties), harness.client.session
    )
    assert peer.received == []
    assert problem in harness.status("to_ros").last_error


# schemas


def test_the_schema_has_the_constants_of_each_type():
    schema = json_schema(CONVERTERS.get("diagnostic_msgs/msg/DiagnosticArray").description)
    status = schema["$defs"]["diagnostic_msgs/msg/DiagnosticStatus"]
    assert status["x-constants"] == {"OK": 0, "WARN": 1, "ERROR": 2, "STALE": 3}
    assert "x-constants" not in schema


def test_the_schema_of_every_field():
    jsonschema = pytest.importorskip("jsonschema")
    converter = CONVERTERS.get("test_msgs/msg/MultiNested")
    schema = json_schema(converter.description)
    jsonschema.Draft202012Validator.check_schema(schema)
    validate = jsonschema.Draft202012Validator(schema).validate
    validate(json.loads(converter.to_json(converter.from_json(b"{}"))))
    validate({})
    for wrong in ({"nope": 1}, {"array_of_arrays": []}, {"array_of_arrays": 1}):
        with pytest.raises(jsonschema.ValidationError):
            validate(wrong)


@pytest.mark.parametrize(
    ("type_name", "value"),
    [
        (ODOMETRY, {"header": {"stamp": "now"}}),
        ("builtin_interfaces/msg/Time", "now"),
        ("builtin_interfaces/msg/Duration", "now"),
        (ODOMETRY, {"header": {"stamp": {"sec": 2**31}}}),
        (ODOMETRY, {"pose": {"covariance": [None] * 36}}),
        (ODOMETRY, {"pose": {"covariance": [0] * 35}}),
        (PICTURE, {"data": "AAAA"}),
        (PICTURE, {"data": [0, 255]}),
        (PICTURE, {"data": [256]}),
        (STRING, {"data": 1}),
        ("test_msgs/msg/BoundedPlainSequences", {"bool_values": [True] * 4}),
        ("test_msgs/msg/BoundedPlainSequences", {"bool_values": [True] * 3}),
    ],
)
def test_a_schema_agrees_with_what_the_converter_accepts(type_name, value):
    jsonschema = pytest.importorskip("jsonschema")
    converter = CONVERTERS.get(type_name)
    is_valid = jsonschema.Draft202012Validator(json_schema(converter.description)).is_valid(value)
    try:
        converter.from_json(json.dumps(value).encode())
    except ConversionError:
        assert not is_valid
    else:
        assert is_valid


@pytest.mark.parametrize("name", ["routes", "skipped"])
async def test_json_of_the_bridge_has_its_content_type(harness, name):
    harness.start(to_ros("/chatter", type=STRING))
    await harness.settle()
    message = harness.broker.retained.get(f"r2d2/_appliance/{name}")
    assert message.properties == {Property.CONTENT_TYPE: "application/json"}


# the budget


async def test_bytes_per_second_are_limited(harness, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("appliance.ros.topics.to_mqtt.monotonic", lambda: now[0])
    harness.start(to_mqtt("/chatter", encoding="cdr", bytes_per_second=10_000, keep=1000))
    peer = harness.node.add_publisher("/chatter", STRING)
    text = string("x" * 991)  # a thousand bytes
    for _ in range(500):  # five seconds of 100 Hz
        peer.publish(text)
        now[0] += 0.01
    await harness.settle()
    # What was saved before the first, and what came in since; one may have been too large.
    assert 59 <= len(harness.client.payloads("r2d2/chatter")) <= 61
    assert harness.status().throttled == 500 - len(harness.client.payloads("r2d2/chatter"))


def test_payloads_over_the_size_limit_are_not_converted():
    text = unpacker(CONVERTERS.get(STRING), "json", "none", InputLimits(100))
    assert text(b'{"data": "x"}' + b" " * 87) == string("x")
    with pytest.raises(ConversionError, match=r"it has 101 bytes, at most 100 .*limits.payload"):
        text(b'{"data": "x"}' + b" " * 88)
    small = zstandard.compress(b'{"data": "x"}' + b" " * 88)
    with pytest.raises(ConversionError, match="it has 101 bytes"):
        unpacker(CONVERTERS.get(STRING), "json", "zstd", InputLimits(100))(small)


async def test_a_slow_conversion_ends_the_turn_of_its_sender(harness):
    """However few bytes it is: others are served in between."""
    harness.start(both("/chatter", type=STRING, compression="zstd"))
    counters = harness.broker.counters
    before = counters.cost
    harness.client.send("r2d2/chatter", b'{"data": "x"}')
    little = counters.cost - before
    payload = b'{"data": "' + b"x" * 1_000_000 + b'"}'
    harness.client.send("r2d2/chatter", zstandard.compress(payload))
    assert counters.cost - before - little > 200 > little
