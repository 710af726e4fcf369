"""The profiles of Fast DDS, with the one that is installed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from lose_last import TIMES
from namespaces import has_namespaces
from publish_fast import MESSAGES
from ros_domain import DOMAIN

from appliance.host.environment import for_other_programs
from appliance.ros.ros2 import fastdds, installation

SUPPRESSION = 0.004  # seconds, as in the profiles
EMPTY = '<dds xmlns="http://www.eprosima.com"><profiles/></dds>'


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"ROS_LOCALHOST_ONLY": "1"},
        {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"},
        {"IS_LOCAL": "1"},
        {"IS_LOCAL": "1", "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"},
    ],
    ids=["default", "localhost only", "udp", "local", "local udp"],
)
def test_a_message_wakes_no_thread_for_timers(given):
    wakeups, seconds, said = published(given)
    assert wakeups < 50 + 4 * seconds / SUPPRESSION
    assert "XMLPARSER" not in said


def test_without_the_profile_each_message_wakes_one(tmp_path):
    profile = tmp_path / "mine.xml"
    profile.write_text(EMPTY)
    wakeups, _, _ = published(dict.fromkeys(fastdds.VARIABLES, str(profile)))
    assert wakeups > MESSAGES / 2


def test_the_times():
    """500 ms: see fastdds.py. 4 ms: Fast DDS's subscribers ask after 5, and must not be ignored."""
    for file in fastdds.file_of("default").parent.iterdir():
        times = re.findall(r"<sec>(\d+)</sec><nanosec>(\d+)</nanosec>", file.read_text())
        assert times == [("0", "500000000"), ("0", "4000000")]


@pytest.mark.parametrize(
    ("sourced", "own", "is_sourced", "is_old"),
    [
        ("fastdds", "fastrtps", True, False),  # Kilted, beside Jazzy's wheels
        ("fastrtps", "fastdds", True, True),
        ("fastrtps", "fastdds", False, False),  # of another Python, so that the wheels are used
        ("fastdds", "fastrtps", False, True),
        ("", "fastrtps", False, True),
        ("fastdds", "", True, False),
        ("", "", False, False),
    ],
)
def test_the_version_is_that_of_the_ros_that_is_used(
    sourced, own, is_sourced, is_old, tmp_path, monkeypatch
):
    """A profile for the other version is not read: the sockets would be open to the network."""
    for where, name in (("sourced", sourced), ("own", own)):
        (tmp_path / where / "share" / name).mkdir(parents=True)
    found = SimpleNamespace(source="sourced" if is_sourced else "installed")
    monkeypatch.setattr(installation, "find", lambda: found)
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "own"))
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "sourced"))
    assert fastdds.is_old() is is_old


@pytest.mark.parametrize(
    ("file", "is_old"),
    [
        ("libfastrtps.so.2.14", True),  # as in the one file
        ("libfastdds.so.3.2", False),
        ("lib/libfastrtps.so", True),
        ("lib/libfastdds.so.3.2.2", False),
    ],
)
def test_the_version_is_that_of_the_library(file, is_old, tmp_path, monkeypatch):
    """The one file has no `share/fastrtps`: its sockets were open to the network."""
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).touch()
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    assert fastdds.is_old() is is_old


def test_both_versions_of_a_profile_say_the_same():
    folder = fastdds.file_of("default").parent
    new = {
        "heartbeatPeriod": "heartbeat_period",
        "nackSupressionDuration": "nack_supression_duration",
    }
    for file in folder.glob("*_3.xml"):
        old = file.with_name(file.name.replace("_3", "_2")).read_text()
        for name in new:
            old = re.sub(rf"\b{name}\b", new[name], old)
        assert old.replace("Fast DDS 2", "Fast DDS 3") == file.read_text()
    assert len(list(folder.iterdir())) == 9  # Fast DDS 3 needs no profile for UDP


def test_a_lost_message_is_repeated_soon_though_none_follows():
    """With Fast DDS's own times it came after 0.5 to 3.0 s: for so long a robot had driven on."""
    if not has_namespaces():
        pytest.skip("needs root, iproute2 and network namespaces, for a network that loses")
    network = ("unshare", "-n", "sh", "-c", 'ip link set lo up && exec "$0" "$@"')
    given = {
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
        # LOCALHOST would add shared memory; the network is a loopback alone anyway.
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
    }
    said = run("lose_last.py", given, *network)
    waits = [float(wait) for wait in re.findall(r"came after (\S+)", said)]
    assert len(waits) == TIMES
    assert min(waits) > 0.05, "none was lost"
    assert sorted(waits)[TIMES // 2] < 0.9, waits


def published(given: dict[str, str]) -> tuple[int, float, str]:
    """How often a thread for timers was woken, in how many seconds, and all that was said."""
    said = run("publish_fast.py", given)
    found = re.search(r"woken (\d+) in (\S+)", said)
    assert found, said
    return int(found[1]), float(found[2]), said


def run(program: str, given: dict[str, str], *within: str) -> str:
    """All that the program says, in a process of its own."""
    pytest.importorskip("rclpy")
    environment = {
        **for_other_programs(),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": DOMAIN,
        "PYTHONPATH": os.pathsep.join(sys.path),
        **given,
    }
    done = subprocess.run(
        [*within, sys.executable, str(Path(__file__).parent / program), "publish"],
        capture_output=True,
        text=True,
        env=environment,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr
