"""Which ROS is found, and what is said of one that cannot be used; nothing of it is imported."""

from __future__ import annotations

import sys

import pytest

from appliance.ros.ros2 import installation
from appliance.ros.ros2.installation import find, find_sourced, is_wanted

HERE = sys.version_info[:2]
OTHER = (3, 99)


def source(
    folder,
    python=HERE,
    packages=("std_msgs",),
    distribution="jazzy",
    module="_rclpy_pybind11",
    machine=installation.MACHINE,
):
    """A distribution's folder, and the environment after its setup file was sourced."""
    version = f"{python[0]}.{python[1]}"
    site = folder / f"lib/python{version}/site-packages"
    (site / "rclpy").mkdir(parents=True)
    (site / "rclpy/__init__.py").touch()
    tag = f"cpython-{version.replace('.', '')}-{machine}-linux-gnu"
    (site / f"rclpy/{module}.{tag}.so").touch()
    index = folder / "share/ament_index/resource_index/rosidl_interfaces"
    index.mkdir(parents=True)
    for package in packages:
        (index / package).touch()
    return {"AMENT_PREFIX_PATH": str(folder), "PYTHONPATH": str(site), "ROS_DISTRO": distribution}


@pytest.fixture
def inside(tmp_path, monkeypatch):
    """What the one file is unpacked to, with std_msgs in it."""
    source(tmp_path / "inside")
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "inside"))
    monkeypatch.setattr(sys, "frozen", True, raising=False)


def test_a_sourced_ros_is_found_by_pythonpath_or_by_its_prefix(tmp_path):
    environment = source(tmp_path / "jazzy")
    by_path = find_sourced(environment)
    assert by_path is not None
    assert by_path.fits
    assert str(by_path).startswith(f"ROS 2 jazzy in {tmp_path}/jazzy/lib")
    del environment["PYTHONPATH"]
    assert find_sourced(environment) == by_path
    assert find_sourced({"AMENT_PREFIX_PATH": f":{tmp_path}/nothing", "PYTHONPATH": ""}) is None


def test_rolling_has_another_name_for_the_compiled_module(tmp_path):
    found = find_sourced(source(tmp_path / "rolling", OTHER, module="_rclpy_nanobind"))
    assert found is not None
    assert found.python == OTHER


def test_the_sourced_ros_of_the_same_python_is_preferred(tmp_path):
    other, fitting = source(tmp_path / "other", OTHER), source(tmp_path / "fitting")
    both = {"AMENT_PREFIX_PATH": ":".join(e["AMENT_PREFIX_PATH"] for e in (other, fitting))}
    found = find_sourced(both)
    assert found is not None
    assert found.python == HERE


def test_the_one_file_uses_a_sourced_ros_that_has_more_types(tmp_path, inside):
    same = source(tmp_path / "same")
    more = source(tmp_path / "more", packages=("std_msgs", "rover_msgs"))
    assert is_wanted(same) is None
    assert is_wanted(same | {"ROS_FROM": "system"})
    assert is_wanted(more)
    assert is_wanted(more | {"ROS_FROM": "bundled"}) is None
    other = source(tmp_path / "other", OTHER, packages=("rover_msgs",))
    assert is_wanted(other | {"ROS_FROM": "system"}) is None


def test_what_to_do_about_another_python(tmp_path, monkeypatch):
    environment = source(tmp_path / "jazzy", OTHER)
    monkeypatch.setattr(sys, "path", [environment["PYTHONPATH"]])
    monkeypatch.setattr(installation, "find_spec", lambda name: None)
    found = find(environment)
    assert (found.source, found.where) == ("none", None)
    assert f"cannot be used by this appliance, which has Python {HERE[0]}.{HERE[1]}" in found.advice
    assert "python3.99 -m venv --system-site-packages" in found.advice


def test_what_to_do_about_a_ros_of_another_kind_of_computer(tmp_path, monkeypatch):
    other = "aarch64" if installation.MACHINE == "x86_64" else "x86_64"
    environment = source(tmp_path / "jazzy", machine=other)
    monkeypatch.setattr(sys, "path", [environment["PYTHONPATH"]])
    monkeypatch.setattr(installation, "find_spec", lambda name: None)
    found = find(environment)
    assert found.source == "none"
    assert f"is for another kind of computer: {other}, where this is" in found.advice
    fitting = source(tmp_path / "fitting")
    both = {"AMENT_PREFIX_PATH": f"{tmp_path}/jazzy:{fitting['AMENT_PREFIX_PATH']}"}
    preferred = find_sourced(both)
    assert preferred is not None
    assert preferred.fits


def test_what_to_do_where_there_is_none(monkeypatch):
    monkeypatch.setattr(installation, "find_spec", lambda name: None)
    assert "Source a ROS 2 setup file first" in find({}).advice
    assert "no ROS 2 is sourced" in find({"ROS_FROM": "system"}).advice
    found = find({"ROS_DOMAIN_ID": "7", "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"})
    assert (found.domain, found.rmw, str(found)) == ("7", "rmw_cyclonedds_cpp", "no ROS 2")
