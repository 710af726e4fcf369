"""The broker and the bridge to ROS 1 on arm64, emulated; ROS 2 is not, as no rclpy for it is here.

mosquitto's clients are this computer's own. With `-s` or `--junit-xml` the figures are seen; times
are those of an emulated processor, from a fifth to a twentieth of a real one.
"""

from __future__ import annotations

import json
import os
import re
import socket
import statistics
import subprocess
import sysconfig
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import paho.mqtt.client as paho
import psutil
import pytest
from appliance_process import HOST, ROBOT
from arm64.emulated import PYTHON, QEMU, ROS1, SUITE, Emulated
from debian_root import debian_root, require
from installed_appliance import START, InstalledAppliance, messages, next_line, subscribed
from pages import PROJECT
from waiting import PATIENCE, eventually

from appliance.packaging import emulation

MIB = 1 << 20
VERSIONS = {"3.1.1": "311", "5.0": "5"}
CONNECT = bytes.fromhex("10 10 0004 4d515454 05 02 003c 00 0003 616263")
#: Messages whose way is measured, one after the other.
ROUNDS = 50

#: What has code that is compiled for one kind of computer.
COMPILED = (
    "_argon2_cffi_bindings",
    "cbor2",
    "cryptography.hazmat.bindings._rust",
    "orjson",
    "psutil",
    "pybase64._pybase64",
    "pydantic_core",
    "uvloop",
    "watchfiles",
    "websockets.speedups",
    "yaml._yaml",
    "zstandard.backend_c",
)


#: The appliance, and the libraries of the tests' own environment.
FROM_HERE = (str(PROJECT), sysconfig.get_path("platlib"))


@pytest.fixture(scope="module")
def arm64(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulated]:
    """One for all tests: Debian's Python and ROS 1 for arm64, and the appliance's libraries."""
    require(
        ("mmdebstrap", "mmdebstrap"),
        (QEMU, "qemu-user-static"),
        ("mosquitto_sub", "mosquitto-clients"),
    )
    path = tmp_path_factory.mktemp("arm64") / "root"
    with debian_root(path, SUITE, "python3", *ROS1, architecture="arm64") as root:
        emulated = Emulated(root)
        emulated.install()
        yield emulated


@pytest.fixture(scope="module")
def appliance(
    arm64: Emulated, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[InstalledAppliance]:
    process = install(tmp_path_factory.mktemp("appliance"), arm64, {"bus": "none"})
    process.start()
    yield process
    process.stop()


def install(directory: Path, arm64: Emulated, bridge: dict[str, object]) -> InstalledAppliance:
    command = [*arm64.python, "-m", "appliance"]
    return InstalledAppliance(directory, command, bridge, environment=arm64.environment)


def test_everything_compiled_is_for_arm64(arm64: Emulated) -> None:
    imports = f"import importlib, platform, sys; [importlib.import_module(m) for m in {COMPILED}]"
    loaded = "[m.__file__ for m in sys.modules.values() if getattr(m, '__file__', None)]"
    machine, *files = arm64.run(
        "-c", f"{imports}; print(platform.machine(), *{loaded}, sep='\\n')"
    ).splitlines()
    assert machine == "aarch64"
    libraries = [file for file in files if file.endswith(".so")]
    assert len(libraries) >= len(COMPILED)
    for library in libraries:
        assert Path(library).is_relative_to(arm64.root)
        assert Path(library).read_bytes()[18:20] == b"\xb7\0"  # e_machine of ELF: AArch64


def test_programs_that_start_others(arm64: Emulated) -> None:
    """What builds the one file for arm64 here: Linux itself calls qemu, for each program."""
    linux = tuple(map(int, re.findall(r"\d+", os.uname().release)[:2]))
    if linux < (6, 7):
        pytest.skip("needs Linux 6.7, which has rules for each user namespace (binfmt_misc)")
    before = rules()
    ask = "import platform; print(platform.machine())"
    start = f"import subprocess, sys; {ask}; subprocess.run([sys.executable, '-c', {ask!r}])"
    done = subprocess.run(
        [*emulation.prefix("aarch64"), arm64.root / f"usr/bin/python{PYTHON}", "-uc", start],
        env={**os.environ, **arm64.environment, "QEMU_LD_PREFIX": str(arm64.root)},
        capture_output=True,
        text=True,
        timeout=START,
    )
    assert done.stdout == "aarch64\naarch64\n", done.stderr
    assert rules() == before, "the rest of the computer is as it was"


def rules() -> set[str]:
    """Whom Linux calls for programs of other kinds."""
    return {each.name for each in Path("/proc/sys/fs/binfmt_misc").glob("*")}


@pytest.mark.parametrize("qos", ["0", "1", "2"])
@pytest.mark.parametrize("version", VERSIONS)
def test_a_message_over_tls(appliance: InstalledAppliance, version: str, qos: str) -> None:
    options = ["-V", VERSIONS[version], "-q", qos]
    text = f"MQTT {version} with QoS {qos}"
    with subscribed(
        appliance.mosquitto("sub", "-t", f"{ROBOT}/smoke", *options, "-C", "1")
    ) as listener:
        appliance.publish(f"{ROBOT}/smoke", text, *options)
        assert messages(listener) == [text]


@pytest.mark.parametrize("version", VERSIONS)
def test_a_wrong_password_is_refused(appliance: InstalledAppliance, version: str) -> None:
    options = ["-V", VERSIONS[version], "-t", f"{ROBOT}/smoke", "-m", "no"]
    done = subprocess.run(
        appliance.mosquitto("pub", *options, password="wrong"),
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE,
    )
    assert done.returncode != 0
    assert "not authorised" in (done.stdout + done.stderr).lower().replace(
        "authorized", "authorised"
    )
    appliance.wait_for_log("alice.*password")


def test_a_retained_message_outlives_a_crash(appliance: InstalledAppliance) -> None:
    appliance.publish(f"{ROBOT}/note", "kept", "-q", "1", "-r")
    appliance.kill()
    appliance.start()
    listener = subprocess.run(
        appliance.mosquitto("sub", "-t", f"{ROBOT}/note", "-C", "1", "-W", "60", "-F", "%r %p"),
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE,
    )
    assert listener.stdout == "1 kept\n", listener.stderr


def test_strings_of_ros_1_both_ways(arm64: Emulated, tmp_path: Path) -> None:
    """The Master (which `roscore` starts), a robot and the appliance: all of them on arm64."""
    with socket.create_server((HOST, 0)) as free:
        port = free.getsockname()[1]
    ros = {
        "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
        "ROS_HOSTNAME": "127.0.0.1",
        "ROS_LOG_DIR": str(tmp_path / "log"),
    }
    topics = [
        {"ros": "/chatter", "to": "mqtt"},
        {"ros": "/hear", "to": "ros", "type": "std_msgs/msg/String"},
    ]
    master = [str(arm64.root / "usr/bin/rosmaster"), "--core", "-p", str(port)]
    house = install(tmp_path / "house", arm64, {"bus": "ros1", "topics": topics})
    house.environment |= ros
    robot_script = str(PROJECT / "tests/arm64/string_robot.py")
    with running(arm64, ros, *master), running(arm64, ros, robot_script) as robot:
        try:
            house.start()
            house.wait_for_log("on ROS as /appliance", timeout=START)
            said = subprocess.run(
                house.mosquitto("sub", "-t", f"{ROBOT}/chatter", "-C", "1", "-W", "100"),
                capture_output=True,
                text=True,
                timeout=2 * PATIENCE,
            )
            assert json.loads(said.stdout) == {"data": "from the robot"}, house.log

            told = '{"data": "from MQTT"}'
            heard = next_line(robot, lambda: house.publish(f"{ROBOT}/hear", told))
            assert heard == "from MQTT", house.log
        finally:
            house.stop()


@contextmanager
def running(
    arm64: Emulated, environment: dict[str, str], *arguments: str
) -> Iterator[subprocess.Popen[str]]:
    """A Python program on arm64, killed in the end."""
    process = subprocess.Popen(
        [*arm64.python, "-u", *arguments],
        env={**os.environ, **arm64.environment, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def test_libraries_of_a_pc_are_told_from_its_own(arm64: Emulated) -> None:
    """An environment that was copied to the robot from a computer of another kind."""
    done = subprocess.run(
        [*arm64.python, "-m", "appliance", "init", "--dir", str(arm64.root / "none")],
        env={**os.environ, **arm64.environment, "PYTHONPATH": os.pathsep.join(FROM_HERE)},
        capture_output=True,
        text=True,
        timeout=START,
    )
    assert done.returncode == 1
    assert "is compiled for x86-64, and" in done.stderr
    assert "is for arm64. An environment works only" in done.stderr
    assert "Traceback" not in done.stderr


def test_figures(
    arm64: Emulated,
    appliance: InstalledAppliance,
    record_property: Callable[[str, object], None],
) -> None:
    """What it takes; of the times only that they are within a test's patience."""
    appliance.stop()
    before = time.monotonic()
    appliance.start()
    eventually(lambda: answers(appliance), "an answer to CONNECT")
    process = psutil.Process(appliance.pid)
    figures = {
        "start to the first CONNECT answered, s": time.monotonic() - before,
        "CPU time of that, s": sum(process.cpu_times()[:2]),
    }
    figures["one message's way, ms"] = 1000 * one_way(appliance)
    figures["resident memory with the emulator, MiB"] = process.memory_info().rss / MIB
    figures["on the disk, MiB"] = arm64.size() / MIB
    for name, value in figures.items():
        record_property(name, round(value, 1))
        print(f"arm64, {name}: {value:.1f}")
    assert figures["on the disk, MiB"] < 250
    assert figures["resident memory with the emulator, MiB"] < 400


def answers(appliance: InstalledAppliance) -> bool:
    """Whether a CONNECT without a password is answered with CONNACK, be it a refusal."""
    with appliance.open(tls=True) as connection:
        connection.settimeout(PATIENCE)
        connection.sendall(CONNECT)
        return connection.recv(1) == b"\x20"


def one_way(appliance: InstalledAppliance) -> float:
    """Seconds from one client to another, over TLS with QoS 0; the median of some."""
    came = threading.Event()
    ready = threading.Event()
    client = paho.Client(paho.CallbackAPIVersion.VERSION2, "measuring", protocol=paho.MQTTv5)
    client.username_pw_set("alice", appliance.passwords["alice"])
    client.tls_set_context(appliance.tls_context())
    client.on_connect = lambda *_: client.subscribe(f"{ROBOT}/way")
    client.on_subscribe = lambda *_: ready.set()
    client.on_message = lambda *_: came.set()
    client.connect(HOST, appliance.port)
    client.loop_start()
    try:
        assert ready.wait(2 * PATIENCE)
        took = []
        for _ in range(ROUNDS):
            came.clear()
            sent = time.perf_counter()
            client.publish(f"{ROBOT}/way", b"x" * 100)
            assert came.wait(2 * PATIENCE)
            took.append(time.perf_counter() - sent)
        return statistics.median(took)
    finally:
        client.disconnect()
        client.loop_stop()
