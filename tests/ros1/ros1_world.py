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
from collections.abc import Mapping
from importlib.metadata import Distribution, distribution
from pathlib import Path
from typing import cast
from xmlrpc.client import ServerProxy

import psutil
from appliance_process import ACL, PATIENCE, ApplianceProcess, eventually
from packaging.requirements import Requirement

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

import appliance
from appliance.environment import for_other_programs

SYSTEM_PYTHON = "/usr/bin/python3"
HERE = Path(__file__).parent
ROOT = Path(appliance.__file__).parent.parent


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
        subprocess.run([*pip, "-c", ROOT / "constraints.txt", ROOT], check=True)


def link_packages(folder: Path) -> None:
    """Link all that the appliance needs, without the ROS 2 that is beside it."""
    own = distribution("ros-mqtt-appliance")
    for file in own.files or ():
        if file.parts[0].endswith(".dist-info"):  # it tells its version
            link(own, file.parts[0], folder)
    # What was installed may be older than what is here.
    todo = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
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
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.directory = directory
        self.environment = {
            "ROS_MASTER_URI": f"http://127.0.0.1:{self.port}",
            "ROS_HOSTNAME": "127.0.0.1",
            "ROS_LOG_DIR": str(directory / "log"),
            "PYTHONUNBUFFERED": "1",
        }
        self._master: subprocess.Popen[bytes] | None = None

    @property
    def for_ros(self) -> dict[str, str]:
        """The environment of ROS's own commands."""
        environment = for_other_programs() | self.environment
        environment.pop("PYTHONPATH", None)
        return environment

    def start(self) -> None:
        """`roscore`, which starts the Master and rosout."""
        self._master = subprocess.Popen(
            ["roscore", "-p", str(self.port)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=self.for_ros,
        )
        eventually(self._answers, "the Master is there", 2 * PATIENCE)

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
        master = ServerProxy(self.environment["ROS_MASTER_URI"])
        _, _, state = cast(
            "list[list[list[tuple[str, list[str]]]]]", master.getSystemState("/test")
        )
        return [dict(part) for part in state]

    def shut_down(self, node: str) -> None:
        """What `rosnode kill` does, and the Master when another node takes the name."""
        master = ServerProxy(self.environment["ROS_MASTER_URI"])
        _, _, uri = cast("list[str]", master.lookupNode("/test", node))
        ServerProxy(uri).shutdown("/test", "the test says so")

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
