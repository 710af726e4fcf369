"""Whom the bridge's node finds, and who finds it: `bridge.discovery`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from namespaces import has_namespaces
from ros_domain import DOMAIN
from waiting import until

from appliance.host.environment import for_other_programs
from appliance.ros.ros2 import discovery, fastdds
from appliance.ros.ros2.network_scope import NetworkScope, find_scope
from appliance.ros.ros2.node import LONGEST_INTERVAL, POLL_INTERVAL, interval_after

RANGE = discovery.RANGE


@pytest.fixture(autouse=True)
def newer_than_humble(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(discovery, "_knows_range", lambda: True)
    monkeypatch.setattr(fastdds, "is_old", lambda: False)


def test_localhost_is_a_profile_without_a_socket_on_the_network():
    environment = {}
    assert discovery.use("localhost", environment) == ""
    profile = Path(environment["FASTDDS_DEFAULT_PROFILES_FILE"]).read_text()
    assert "<address>127.0.0.1</address>" in profile and "FILTER_DIFFERENT_HOST" in profile
    assert "SHM" in profile
    assert discovery.is_local(environment)
    assert find_scope(environment) <= NetworkScope.THIS_COMPUTER
    before = dict(environment)
    assert discovery.use("localhost", environment) == ""  # the node is started anew
    assert environment == before


def test_the_service_of_a_user_of_its_own_has_no_shared_memory():
    environment = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
    discovery.use("localhost", environment)
    profile = Path(environment["FASTDDS_DEFAULT_PROFILES_FILE"]).read_text()
    assert "<address>127.0.0.1</address>" in profile and "SHM" not in profile


@pytest.mark.parametrize("is_old", [False, True])
@pytest.mark.parametrize(
    "given",
    [
        {"FASTDDS_DEFAULT_PROFILES_FILE": "/mine.xml"},
        {"FASTRTPS_DEFAULT_PROFILES_FILE": "/mine.xml"},
        {"FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA"},
    ],
)
def test_the_profile_overrides_the_users_and_reports_it(given, is_old, monkeypatch):
    """With that one, the bridge's sockets were open to the network."""
    monkeypatch.setattr(fastdds, "is_old", lambda: is_old)
    environment = dict(given)
    ((name, value),) = given.items()
    said = discovery.use("localhost", environment)
    assert f"so that {name}={value} is not heeded" in said
    assert discovery.is_local(environment)
    assert "/mine.xml" not in environment.values()
    used = "FASTRTPS" if is_old else "FASTDDS"
    profile = Path(environment[f"{used}_DEFAULT_PROFILES_FILE"]).read_text()
    assert "<address>127.0.0.1</address>" in profile


def test_the_profile_overrides_one_in_the_working_directory():
    Path("DEFAULT_FASTDDS_PROFILES.xml").touch()
    environment = {}
    said = discovery.use("localhost", environment)
    assert f"DEFAULT_FASTDDS_PROFILES.xml in {Path.cwd()} is not heeded" in said
    assert discovery.is_local(environment)
    assert environment["SKIP_DEFAULT_XML_FILE"] == "1"


def test_without_the_profile_localhost_is_the_variable_of_ros(monkeypatch):
    given = {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp", "FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA"}
    environment = dict(given)
    assert discovery.use("localhost", environment) == ""
    assert environment == {**given, RANGE: "LOCALHOST"}
    assert discovery.is_local(environment)
    monkeypatch.setattr(discovery, "_knows_range", lambda: False)
    environment = dict(given)
    discovery.use("localhost", environment)
    assert environment["ROS_LOCALHOST_ONLY"] == "1"  # as it is called in Humble


@pytest.mark.parametrize(
    ("wanted", "given", "told"),
    [
        ("localhost", {RANGE: "SUBNET"}, f"{RANGE}=SUBNET"),
        ("localhost", {RANGE: "OFF"}, f"{RANGE}=OFF"),
        ("localhost", {RANGE: "localhost"}, ""),
        ("localhost", {"ROS_STATIC_PEERS": "10.0.0.2"}, "ROS_STATIC_PEERS=10.0.0.2"),
        ("subnet", {RANGE: "LOCALHOST"}, f"{RANGE}=LOCALHOST"),
        ("subnet", {"ROS_STATIC_PEERS": "10.0.0.2"}, ""),
        ("environment", {RANGE: "OFF", "ROS_STATIC_PEERS": "10.0.0.2"}, ""),
    ],
)
def test_the_configuration_overrides_the_variables_and_reports_it(wanted, given, told):
    environment = dict(given)
    said = discovery.use(wanted, environment)
    assert told in said and bool(told) is bool(said)
    if said:
        assert f"bridge.discovery is {wanted}" in said and "discovery: environment" in said
    if wanted == "environment":
        assert environment == given
    else:
        assert discovery.is_local(environment) is (wanted == "localhost")


def test_what_kilted_does_not_know_makes_nothing_local(monkeypatch):
    """`doctor` called a bus local on which everybody on the network could publish."""
    assert not discovery.is_local({"ROS_LOCALHOST_ONLY": "1"})
    monkeypatch.setattr(fastdds, "is_old", lambda: True)  # Jazzy knows it
    assert discovery.is_local({"ROS_LOCALHOST_ONLY": "1"})


@pytest.mark.parametrize(
    ("enable", "strategy", "secured"),
    [("true", "Enforce", True), ("true", "Permissive", False), ("false", "Enforce", False)],
)
def test_only_enforced_security_is_security(enable, strategy, secured):
    environment = {"ROS_SECURITY_ENABLE": enable, "ROS_SECURITY_STRATEGY": strategy}
    assert discovery.is_secured(environment) is secured


def test_another_computer_of_the_network():
    pytest.importorskip("rclpy")
    if not has_namespaces():
        pytest.skip("needs root, iproute2 and network namespaces, for two computers")
    program = Path(__file__).parents[1] / "two_computers.py"
    environment = {
        name: value
        for name, value in for_other_programs().items()
        if not name.startswith("FASTDDS")
    }
    environment.pop(RANGE, None)
    environment["ROS_DOMAIN_ID"] = DOMAIN
    done = subprocess.run(
        ["unshare", "-n", sys.executable, str(program)],
        capture_output=True,
        text=True,
        env=environment,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    subnet, localhost = map(json.loads, done.stdout.splitlines())
    subnet["elsewhere"] = [name for name in subnet["elsewhere"] if name != "one without a name"]
    assert subnet == {"heard": ["far", "near"], "elsewhere": ["/far"], "open": True}
    assert localhost == {"heard": ["near"], "elsewhere": [], "open": False}


async def test_with_security_enforced_and_no_keys_nothing_is_joined(monkeypatch, tmp_path):
    pytest.importorskip("rclpy")
    from appliance.ros.ros2.node import Ros2Node

    monkeypatch.setenv("ROS_SECURITY_ENABLE", "true")
    monkeypatch.setenv("ROS_SECURITY_STRATEGY", "Enforce")
    monkeypatch.setenv("ROS_SECURITY_KEYSTORE", str(tmp_path))
    monkeypatch.setenv("ROS_DOMAIN_ID", DOMAIN)
    node, looks, failures = Ros2Node(arguments=("--enclave", "/appliance")), [], []
    node.start(lambda: looks.append(1), failures.append)
    try:
        await until(lambda: failures or looks, "the refusal")
    finally:
        node.stop()
    assert looks == []
    assert str(tmp_path / "enclaves/appliance") in failures[0] and "\n" not in failures[0]


def test_polls_are_rarer_where_they_take_long():
    assert interval_after(0.001) == interval_after(0.0) == POLL_INTERVAL
    assert interval_after(0.05) == pytest.approx(0.3)
    assert interval_after(0.08) + 0.08 < 1.0  # noticed within a second, with a thousand topics
    assert interval_after(10.0) == LONGEST_INTERVAL
