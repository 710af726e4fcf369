"""ROS 1 for tests: its Python, its Master, its commands and nodes, and an appliance on it.

rospy is the system's Python's. What the appliance needs is what the tests run with: the packages of
their environment are linked into a folder that the system's Python looks in, which does as long as
both have the same version; else a virtual environment is made.
"""

from __future__ import annotations

import json
import os
import queue
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import Distribution, distribution
from pathlib import Path
from typing import Any, cast
from xmlrpc.client import ServerProxy

import paho.mqtt.client as paho
import psutil
from appliance_process import ACL, ApplianceProcess
from packaging.requirements import Requirement
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from waiting import PATIENCE, eventually

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

import appliance
from appliance.host.environment import for_other_programs

SYSTEM_PYTHON = "/usr/bin/python3"
#: Runs a command of the appliance's: its exit code, and what it says.
Run = Callable[..., "tuple[int, str]"]

HERE = Path(__file__).parent
ROOT = Path(appliance.__file__).parent.parent
PROJECT = Path(__file__).parents[3]


def is_installed() -> bool:
    return shutil.which("roscore") is not None and Path(SYSTEM_PYTHON).exists()


class Python:
    """The interpreter that has rospy, and how it finds the appliance."""

    def __init__(self, directory: Path) -> None:
        self.executable = SYSTEM_PYTHON
        self.path = str(ROOT)
        version = subprocess.check_output([SYSTEM_PYTHON, "--version"], text=True)
        if version.split()[1].split(".")[:2] == [str(number) for number in sys.version_info[:2]]:
            packages = directory / "packages"
            packages.mkdir()
            link_packages(packages)
            self.path += os.pathsep + str(packages)
            return
        home = directory / "venv"
        subprocess.run([SYSTEM_PYTHON, "-m", "venv", "--system-site-packages", home], check=True)
        self.executable = str(home / "bin/python")
        pip = [self.executable, "-m", "pip", "install", "-q", "--use-pep517"]
        subprocess.run([*pip, "-c", PROJECT / "constraints.txt", PROJECT], check=True)


def link_packages(folder: Path) -> None:
    """Link all that the appliance needs, without the ROS 2 that is beside it."""
    own = distribution("ros-mqtt-appliance")
    for file in own.files or ():
        if file.parts[0].endswith(".dist-info"):  # it tells its version
            link(own, file.parts[0], folder)
    # What was installed may be older than what is here.
    todo = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]["dependencies"]
    done = set()
    while todo:
        requirement = Requirement(todo.pop())
        name = re.sub(r"[-_.]+", "-", requirement.name).lower()
        if name in done or not is_wanted(requirement):
            continue
        done.add(name)
        found = distribution(name)
        for top in {file.parts[0] for file in found.files or ()}:
            if not top.endswith((".pth", "__pycache__")) and top not in ("..", "/"):
                link(found, top, folder)
        todo += found.requires or ()


def is_wanted(requirement: Requirement) -> bool:
    return requirement.marker is None or requirement.marker.evaluate({"extra": ""})


def link(found: Distribution, top: str, folder: Path) -> None:
    target, place = Path(str(found.locate_file(top))), folder / top
    if target.exists() and not place.exists():
        place.symlink_to(target)


class World:
    """A Master on a port of its own, to be started and killed, and what is run beside it."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.environment = {
            "ROS_HOSTNAME": "127.0.0.1",
            "ROS_LOG_DIR": str(directory / "log"),
            "PYTHONUNBUFFERED": "1",
        }
        self._choose_port()
        self._has_answered = False
        self._master: subprocess.Popen[bytes] | None = None

    def _choose_port(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.environment["ROS_MASTER_URI"] = f"http://127.0.0.1:{self.port}"

    @property
    def for_ros(self) -> dict[str, str]:
        """The environment of ROS's own commands."""
        environment = for_other_programs() | self.environment
        environment.pop("PYTHONPATH", None)
        return environment

    def start(self) -> None:
        """`roscore`, which starts the Master and rosout; later on the same port again."""
        for _ in range(5):
            master = self._launch()
            eventually(
                lambda: master.poll() is not None or self._answers(),  # noqa: B023
                "the Master is there, or could not be started",
                2 * PATIENCE,
            )
            if master.poll() is None:
                self._has_answered = True
                return
            self._master = None
            if not self._has_answered:  # another program has taken the port since
                self._choose_port()
        raise AssertionError("the Master could not be started")

    def _launch(self) -> subprocess.Popen[bytes]:
        self._master = subprocess.Popen(
            ["roscore", "-p", str(self.port)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=self.for_ros,
        )
        return self._master

    def _answers(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def kill(self) -> None:
        """End the Master without a word, and rosout with it."""
        master, self._master = self._master, None
        if master is not None:
            # It gives what it starts sessions of their own.
            family = psutil.Process(master.pid).children(recursive=True)
            for process in (*family, master):
                process.kill()
            master.wait()
            psutil.wait_procs(family, PATIENCE)

    def run(self, *command: str, check: bool = True) -> str:
        """The output of one of ROS's commands; AssertionError when it fails."""
        done = subprocess.run(
            command,
            env=self.for_ros,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=2 * PATIENCE,
        )
        assert not check or done.returncode == 0, done.stdout
        return done.stdout

    def graph(self) -> list[dict[str, list[str]]]:
        """Publishers, subscribers and servers, as the Master knows them."""
        return [dict(part) for part in self.ask("getSystemState")]

    def ask(self, method: str, *arguments: object) -> Any:
        """What the Master answers; AssertionError when it fails."""
        master = ServerProxy(self.environment["ROS_MASTER_URI"])
        answer = cast("list[Any]", getattr(master, method)("/test", *arguments))
        assert answer[0] == 1, answer
        return answer[2]

    def begin(self, *command: str) -> subprocess.Popen[str]:
        """One of ROS's commands, running; `end` it."""
        return subprocess.Popen(
            command,
            env=self.for_ros,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )


def end(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.communicate()


def output(process: subprocess.Popen[str], again: Callable[[], object]) -> str:
    """What it writes until it ends, while something is done again: it does not tell when it has
    subscribed."""
    deadline = time.monotonic() + 2 * PATIENCE
    while process.poll() is None:
        assert time.monotonic() < deadline, f"{process.args} does not end"
        again()
        time.sleep(0.1)
    return process.communicate()[0]


class Node:
    """ros1_robot.py in a process of its own: what it is told to do is a line of JSON."""

    def __init__(self, world: World) -> None:
        self._lines: queue.Queue[list[object]] = queue.Queue()
        self.process = subprocess.Popen(
            [SYSTEM_PYTHON, str(HERE / "ros1_robot.py")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=world.for_ros,
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(json.loads(line))

    def hear(self) -> list[object]:
        """The next line that it says."""
        return self._lines.get(timeout=2 * PATIENCE)

    def do(self, *command: object) -> object:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()
        word, value = self.hear()
        assert word == "ok", value
        return value

    def stop(self) -> None:
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()


class Ros1Appliance(ApplianceProcess):
    """The appliance on ROS 1, in the system's Python."""

    def __init__(
        self, directory: Path, python: Python, world: World, bridge: Mapping[str, object]
    ) -> None:
        super().__init__(directory, acl=ACL, bridge={"bus": "ros1", **bridge})
        self.python = python.executable
        self.environment = world.environment | {"PYTHONPATH": python.path, "LD_LIBRARY_PATH": ""}

    @contextmanager
    def running(self) -> Iterator[None]:
        """Start it, and stop it in the end; what it has logged is printed."""
        self.start()
        try:
            yield
        finally:
            self.stop()
            print(self.log)


class Mqtt:
    """An MQTT 5 client, and what it has received."""

    def __init__(self, appliance: Ros1Appliance, *topics: str) -> None:
        self.name = f"test-{uuid.uuid4().hex[:6]}"
        self.received: list[paho.MQTTMessage] = []
        self._changed = threading.Condition()
        self.paho = paho.Client(paho.CallbackAPIVersion.VERSION2, self.name, protocol=paho.MQTTv5)
        self.paho.username_pw_set("alice", appliance.passwords["alice"])
        self.paho.on_message = self._on_message
        ready = threading.Event()
        self.paho.on_connect = lambda *_: self.paho.subscribe(
            [(topic, 1) for topic in (*topics, f"r2d2/+/+/_reply/{self.name}/#")]
        )
        self.paho.on_subscribe = lambda *_: ready.set()
        self.paho.connect("127.0.0.1", appliance.plain_port)
        self.paho.loop_start()
        assert ready.wait(PATIENCE)

    def __enter__(self) -> Mqtt:
        return self

    def __exit__(self, *_: object) -> None:
        self.paho.disconnect()
        self.paho.loop_stop()

    def _on_message(self, client: object, userdata: object, message: paho.MQTTMessage) -> None:
        with self._changed:
            self.received.append(message)
            self._changed.notify_all()

    def until(self, condition: Callable[[paho.MQTTMessage], object]) -> paho.MQTTMessage:
        """The first message that this holds for."""
        found: list[paho.MQTTMessage] = []

        def is_there() -> bool:
            found[:] = [message for message in self.received if condition(message)]
            return bool(found)

        with self._changed:
            self._changed.wait_for(is_there, PATIENCE)
        assert found, [(m.topic, m.payload) for m in self.received]
        return found[0]

    def next(self, topic: str, payload: object = ...) -> paho.MQTTMessage:
        """The first message on a topic, or with a payload, which is taken away."""

        def fits(message: paho.MQTTMessage) -> bool:
            return message.topic == topic and (
                payload is ... or (json.loads(message.payload or "null") == payload)
            )

        message = self.until(fits)
        self.received.remove(message)
        return message

    def call(self, topic: str, value: object, kind: str = "_call") -> object:
        """The answer to a call, both in JSON."""
        return json.loads(self.ask(f"{topic}/{kind}", json.dumps(value).encode()).payload)

    def ask(self, topic: str, payload: bytes, content_type: str = "") -> paho.MQTTMessage:
        """The answer to a call."""
        properties = Properties(PacketTypes.PUBLISH)
        if content_type:
            properties.ContentType = content_type
        token = uuid.uuid4().hex[:6].encode()
        base = topic.rpartition("/")[0]
        properties.ResponseTopic = f"{base}/_reply/{self.name}/answer"
        properties.CorrelationData = token
        self.paho.subscribe(properties.ResponseTopic, 1)
        self.paho.publish(topic, payload, 1, properties=properties)
        return self.until(
            lambda m: m.topic == properties.ResponseTopic and m.properties.CorrelationData == token
        )
