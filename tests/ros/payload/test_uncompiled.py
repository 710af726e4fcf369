"""Types read from their definitions, against the same types as their packages were compiled."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from appliance.ros.payload import uncompiled
from appliance.ros.payload.definitions import UnknownTypeError, describe, load_description
from appliance.ros.ros2.node import load_message

INSTALLED = sorted(
    Path(sys.prefix).glob("share/*/msg/*.msg"), key=lambda path: (path.parts[-3], path.stem)
)


@pytest.fixture
def workspace(tmp_path, monkeypatch):
    """Writes definitions of the package rover_msgs that nothing but AMENT_PREFIX_PATH names."""
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    load_message.cache_clear()

    def write(**definitions):
        folder = tmp_path / "share/rover_msgs/msg"
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in definitions.items():
            (folder / f"{name}.msg").write_bytes(text.encode() if isinstance(text, str) else text)

    yield write
    load_message.cache_clear()


def test_every_installed_definition_is_read_as_it_was_compiled():
    assert len(INSTALLED) > 100
    for definition in INSTALLED:
        name = f"{definition.parts[-3]}/msg/{definition.stem}"
        try:
            compiled = load_description(name)
        except UnknownTypeError:
            continue  # it has a field that rclpy cannot carry
        read = uncompiled.message_class(name, definition, load_message)
        assert describe(read, load_message) == compiled
        assert read.SUPPORT.capsule is type(read)._TYPE_SUPPORT


def test_nested_types_come_from_definitions_or_packages(workspace):
    workspace(
        Wheel="uint8 LEFT=1\nuint8 side\n",
        Drive="std_msgs/Header header\nWheel[<=4] wheels\nstring mode 'idle'\n",
    )
    read = describe(load_message("rover_msgs/msg/Drive"), load_message)
    header, wheels, mode = read.fields
    assert header.type == load_description("std_msgs/msg/Header")
    assert (wheels.type.bound, wheels.type.item.name) == (4, "rover_msgs/msg/Wheel")
    assert mode.default == "idle"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("uint8", "Bad.msg cannot be read"),
        ("uint8 9lives", "Bad.msg cannot be read"),
        ("uint8 x 256", "Bad.msg cannot be read"),
        ("wat x", "Bad.msg cannot be read"),
        ("Wat x", "no rover_msgs/msg/Wat: the package rover_msgs is not"),
        ("nowhere_msgs/Nothing x", "nowhere_msgs is not installed here"),
        ("Bad[] parts", "Bad.msg contains itself"),
        (b"\xff\xfe\x00", "Bad.msg cannot be read"),
        ("uint8[99999999999999999999] x", "x has 9+ items, the most is"),
    ],
)
def test_a_bad_definition_is_refused_with_the_file(workspace, text, problem):
    workspace(Bad=text)
    with pytest.raises(UnknownTypeError, match=problem):
        load_message("rover_msgs/msg/Bad")


@pytest.mark.parametrize("name", ["rover_msgs/msg/../../x", "../msg/Bad", "rover_msgs/msg/", "x"])
def test_a_name_is_no_path(workspace, name):
    workspace(Bad="uint8 x")
    assert uncompiled.find_definition(name) is None


def test_calls_need_compiled_support_and_say_so(workspace, tmp_path):
    folder = tmp_path / "share/rover_msgs/srv"
    folder.mkdir(parents=True)
    (folder / "Park.srv").write_text("---\nbool parked\n")
    with pytest.raises(
        UnknownTypeError, match=r"rover_msgs is not installed.*Park\.srv is not eno"
    ):
        load_message("rover_msgs/srv/Park_Request")
