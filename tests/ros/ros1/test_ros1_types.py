"""What ROS 1 says of types and goals, read without ROS; and what is no definition at all."""

from __future__ import annotations

import json
import struct

import pytest
from encoded import from_text, to_text

from appliance.ros.bridge import Bridge  # noqa: F401  (it knows all modules that it needs)
from appliance.ros.calls.goals import STATES
from appliance.ros.node import BusError
from appliance.ros.payload.converter import ConversionError, compile_converter
from appliance.ros.payload.definitions import PACKED, UnknownTypeError
from appliance.ros.ros1.actions import describe_action, find_actions, to_feedback, to_status
from appliance.ros.ros1.peers import parse_header
from appliance.ros.ros1.types import describe, full_name, installed, ros1_name
from appliance.ros.topics.echo import EchoFilter

RULE = "\n" + "=" * 80 + "\n"
STAMPED = f"""\
# a comment
Header header   # another
string NAME=has # in it
int32 LEAST = -1
Point[] points
byte level
char letter
char[] letters
duration[2] waits
{RULE}MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
{RULE}MSG: pkg/Point
float64 x
bool ok
"""


def converter(text: str, now: int = 5_000_000_007):
    return compile_converter(describe("pkg/msg/It", text), lambda: now)


def test_a_definition_with_every_kind_of_field() -> None:
    it = converter(STAMPED)
    given = {
        "header": {"seq": 1, "stamp": "now", "frame_id": "é"},
        "points": [{"x": 0.5, "ok": True}],
        "level": -2,
        "letter": 255,
        "letters": "AP8=",
        "waits": [{"sec": -1, "nanosec": 2}, {}],
    }
    data = it.from_json(json.dumps(given).encode())
    assert data == struct.pack(
        "<IIII2sId?bBI2siiii",
        1,
        5,
        7,
        2,
        "é".encode(),
        1,
        0.5,
        True,
        -2,
        255,
        2,
        b"\0\xff",
        -1,
        2,
        0,
        0,
    )
    given["header"]["stamp"] = {"sec": 5, "nanosec": 7}  # type: ignore[index]
    given["waits"][1] = {"sec": 0, "nanosec": 0}  # type: ignore[index]
    assert json.loads(it.to_json(data)) == given
    assert it.to_json(data + b"more") == it.to_json(data)
    for size in range(len(data)):
        with pytest.raises(ConversionError, match="truncated"):
            it.to_json(data[:size])


def test_strings_may_have_any_character_and_have_no_terminator() -> None:
    it = converter("string data")
    assert from_text(it, b"a\0b") == b"\x03\0\0\0a\0b"
    assert it.to_json(b"\x03\0\0\0a\0b") == b'{"data":"a\\u0000b"}'
    assert to_text(it, b"\x02\0\0\0a\0") == b"a\0"
    assert it.to_json(b"\x01\0\0\0\xff") == '{"data":"\ufffd"}'.encode()
    with pytest.raises(ConversionError, match="truncated"):
        it.checked(b"\xff\xff\xff\xff")


def test_a_message_without_fields() -> None:
    it = converter("")
    assert it.from_json(b"{}") == b"" and it.to_json(b"") == b"{}"
    inside = converter(f"Nothing a\nuint8 b\n{RULE}MSG: pkg/Nothing\n")
    assert inside.from_json(b'{"b": 3}') == b"\3"
    assert inside.to_json(b"\3") == b'{"a":{},"b":3}'


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("int8", "has the line 'int8'"),
        ("int8 a-b", "has the line"),
        ("int8 _hidden", "has the line"),
        ("int8[-1] a", "has the line"),
        ("int8[0] a", "an array of nothing"),
        ("Other a", "does not define pkg/Other"),
        ("It a", "does not define pkg/It"),
        (f"A a\n{RULE}MSG: pkg/A\nA a\n", "pkg/A contains itself"),
        (f"Nothing[] a\n{RULE}MSG: pkg/Nothing\n", "an array of nothing"),
        (f"Nothing[999999999] a\n{RULE}MSG: pkg/Nothing\n", "an array of nothing"),
        ("uint8[999999999] a", "its smallest message has 999999999 B"),
        ("\n".join(f"int8 a{i}" for i in range(5_001)), "more than 5000 fields"),
        ("#" * ((1 << 20) + 1), "has 1048577 characters"),
        (
            "A0 a\n"
            + "".join(f"{RULE}MSG: pkg/A{i}\nA{i + 1} a\nA{i + 1} b\n" for i in range(15))
            + f"{RULE}MSG: pkg/A15\nint8 a\n",
            "more than 5000 fields",
        ),
        (
            "A0 a\n"
            + "".join(f"{RULE}MSG: pkg/A{i}\nA{i + 1} a\n" for i in range(500))
            + f"{RULE}MSG: pkg/A500\nint8 a\n",
            "too deep",
        ),
    ],
)
def test_malformed_definitions_are_refused(text: str, problem: str) -> None:
    with pytest.raises(UnknownTypeError, match=problem):
        describe("pkg/msg/It", text)


def test_names() -> None:
    assert ros1_name("std_msgs/msg/String") == ros1_name("std_msgs/String") == "std_msgs/String"
    assert full_name("std_srvs/Trigger", "srv") == "std_srvs/srv/Trigger"
    for name in ("no_such_package/msg/It", "a/b/c/d", "../etc/passwd", "os/msg/path"):
        with pytest.raises(UnknownTypeError):
            installed(name)


@pytest.mark.parametrize("data", [b"\1", b"\xff\xff\xff\xff", b"\2\0\0\0ab", b"\3\0\0\0a=b\1"])
def test_malformed_headers_are_refused(data: bytes) -> None:
    with pytest.raises(BusError):
        parse_header(data)
    assert parse_header(b"\5\0\0\0a=b=c\2\0\0\0d=") == {"a": "b=c", "d": ""}


def test_an_echo_is_recognized_by_all_of_its_bytes() -> None:
    echo = EchoFilter(PACKED)
    echo.sent(b"\1\2\3\4")
    assert not echo.is_own(b"\0\2\3\4") and not echo.is_own(b"\1\2\3\4\0")
    assert echo.is_own(b"\1\2\3\4") and not echo.is_own(b"\1\2\3\4")


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def test_actions_of_ros_1_as_those_of_ros_2() -> None:
    found = find_actions(
        {"/a/result": "pkg/msg/GoActionResult", "/b/result": "pkg/msg/Go", "/c": "x/msg/Y"},
        ["/a/result", "/b/result", "/c", "/d/result"],
    )
    assert found == {"/a": "pkg/action/Go"}

    header = bytes(12) + text("map")
    own = "0123456789abcdef" * 2
    goals = [(own, 1), ("/client-1-2.3", 3), ("x", 99)]
    status = header + struct.pack("<I", len(goals))
    for name, state in goals:
        status += struct.pack("<II", 7, 8) + text(name) + struct.pack("<B", state) + text("why")

    def load(name: str):
        return describe(name, "int32 x")

    def as_dict(kind: str, data: bytes):
        description = describe_action(kind, load)
        assert description is not None
        return compile_converter(description).to_dict(data)

    told = as_dict("action_msgs/msg/GoalStatusArray", to_status(status))["status_list"]
    assert [STATES[one["status"]] for one in told] == ["executing", "succeeded", "unknown"]
    ids = [one["goal_info"]["goal_id"]["uuid"] for one in told]
    assert ids[0] == "ASNFZ4mrze8BI0VniavN7w==" and len(set(ids)) == 3
    assert told[0]["goal_info"]["stamp"] == {"sec": 7, "nanosec": 8}

    one = struct.pack("<II", 7, 8) + text(own) + b"\1" + text("")
    feedback = as_dict("pkg/action/Go_FeedbackMessage", to_feedback(header + one + b"\5\0\0\0"))
    assert feedback == {"goal_id": {"uuid": ids[0]}, "feedback": {"x": 5}}
    for size in range(len(status)):
        with pytest.raises((struct.error, IndexError)):
            to_status(status[:size])
    with pytest.raises((struct.error, IndexError)):
        to_status(header + b"\xff\xff\xff\xff")
    assert describe_action("pkg/msg/Go", load) is None
    with pytest.raises(UnknownTypeError):
        describe_action("pkg/action/Go_Other", load)
