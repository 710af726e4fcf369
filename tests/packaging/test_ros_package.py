"""The ROS package `mqtt_appliance`: built by colcon in a workspace of its own, and run from there.

`ros2` and `launch` are in no package index: the launch files are read with stand-ins of launch's
classes, which take what launch's do (ros2/launch and ros2/launch_ros, Humble to Rolling).
"""

from __future__ import annotations

import importlib.util
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from appliance_process import ApplianceProcess
from ros_domain import isolated_domain
from waiting import PATIENCE, until

from appliance.host.environment import for_other_programs

__all__ = ["isolated_domain"]  # a fixture

PROJECT = Path(__file__).parent.parent.parent
PACKAGE = PROJECT / "appliance/packaging/mqtt_appliance"
COLCON = shutil.which("colcon")
DEBIAN_PYTHON = "/usr/bin/python3"
#: Programs of other kinds, beside which there is no command `appliance`.
PATH = "/usr/bin:/bin"

needs_colcon = pytest.mark.skipif(
    COLCON is None,
    reason="colcon is not installed: apt install colcon python3-colcon-ros and the other packages "
    "that .ci/run names",
)


def load(path, name):
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


start = load(PACKAGE / "mqtt_appliance/start.py", "mqtt_appliance_start")


# Built by colcon


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """A workspace whose `src` has the whole repository, as cloned, and what colcon says of it."""
    workspace = tmp_path_factory.mktemp("workspace")
    left_out = shutil.ignore_patterns(".*", "node_modules", "__pycache__", "build", "dist", "run")
    shutil.copytree(PROJECT, workspace / "src/ros-mqtt-appliance", ignore=left_out)
    return workspace


def colcon(workspace, *arguments):
    done = subprocess.run(
        [COLCON, *arguments],
        cwd=workspace,
        env={**for_other_programs(), "PATH": PATH},
        capture_output=True,
        text=True,
        timeout=4 * PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout, done.stderr


@pytest.fixture(scope="module")
def executable(workspace):
    colcon(workspace, "build")
    return workspace / "install/mqtt_appliance/lib/mqtt_appliance/appliance"


def run(executable, *arguments, **environment):
    """What the executable does where the workspace is sourced, and no more than it is there."""
    workspace = executable.parents[4]
    line = '. install/setup.sh && exec "$0" "$@"'
    return subprocess.run(
        ["/bin/sh", "-c", line, executable, *arguments],
        cwd=workspace,
        env={"PATH": PATH, "HOME": "/nonexistent", **environment},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )


@needs_colcon
def test_colcon_finds_the_package_and_nothing_else(workspace):
    out, err = colcon(workspace, "list")
    (line,) = out.splitlines()
    assert line.split() == [
        "mqtt_appliance",
        "src/ros-mqtt-appliance/appliance/packaging/mqtt_appliance",
        "(ros.ament_python)",
    ]
    assert "ERROR" not in err
    # Of the repository's root, which has a setup.py that colcon would read, no more than that.
    assert len(err.splitlines()) <= 1, err


@needs_colcon
def test_what_is_installed(executable):
    share = executable.parents[2] / "share"
    assert (share / "ament_index/resource_index/packages/mqtt_appliance").is_file()
    assert (share / "mqtt_appliance/package.xml").is_file()
    launch_files = {path.name for path in (share / "mqtt_appliance/launch").iterdir()}
    assert launch_files == {"appliance.launch.py", "appliance.launch.yaml"}
    assert os.access(executable, os.X_OK)


@needs_colcon
def test_without_the_appliance_it_says_how_to_install_it(executable):
    done = run(executable)
    assert done.returncode == 127
    assert "the appliance is not installed" in done.stderr
    assert "pip install ." in done.stderr and "make deb" in done.stderr
    assert "pip install ros-mqtt-appliance" not in done.stderr
    assert "Traceback" not in done.stderr
    wrong = run(executable, APPLIANCE_COMMAND="/nowhere/appliance")
    assert wrong.returncode == 1
    assert "APPLIANCE_COMMAND is /nowhere/appliance, which is not a program" in wrong.stderr


@needs_colcon
def test_another_kind_of_program_is_named(executable, tmp_path):
    other = tmp_path / "appliance"
    other.write_bytes(b"\x7fELF of another kind of computer")
    other.chmod(0o755)
    done = run(executable, APPLIANCE_COMMAND=str(other))
    assert done.returncode == 1
    assert f"{other} cannot be started: Exec format error" in done.stderr
    assert "Traceback" not in done.stderr


class Launched(ApplianceProcess):
    """The appliance as `ros2 run` and `ros2 launch` start it from the workspace."""

    def __init__(self, directory, executable, *arguments, **more):
        super().__init__(directory, **more)
        self._command = [executable, "-c", self.config, *arguments]

    def _run(self, arguments):
        super()._run(self._command)


@needs_colcon
async def test_a_node_with_name_namespace_remapping_and_parameters(
    executable, tmp_path, isolated_domain
):
    pytest.importorskip("rclpy")
    from robot_client import V5, Client
    from ros2_harness import STRING, Peer, string

    parameters = tmp_path / "parameters.yaml"
    parameters.write_text("/**:\n  ros__parameters:\n    use_sim_time: true\n")
    topics = [
        {"ros": "/y/talk", "to": "mqtt"},
        {"ros": "/time", "to": "ros", "type": "builtin_interfaces/msg/Time"},
    ]
    names = ["-r", "__node:=x", "-r", "__ns:=/y", "-r", "talk:=spoken"]
    launched = Launched(
        tmp_path / "appliance",
        executable,
        *("--log-level", "info", "--ros-args", *names, "--params-file", parameters, "-p", "a:=1"),
        bridge={"topics": topics},
        acl="user alice\ntopic readwrite r3d3/#\ntopic readwrite answers/#\n",
    )
    command = Path(sys.executable).with_name("appliance")
    launched.environment = {"APPLIANCE_COMMAND": str(command), "APPLIANCE_ROBOT": "r3d3"}
    (site,) = executable.parents[1].glob("python3*/site-packages")
    launched.environment["PYTHONPATH"] = str(site)
    peer = await Peer().start()
    try:
        await peer.do("advertise", "/y/spoken", STRING)
        await peer.do("subscribe", "/time", "builtin_interfaces/msg/Time")
        launched.start()
        launched.wait_for_log("on ROS as /y/x")
        await peer.do("matched", "/y/spoken")
        launched.wait_for_log("r3d3/time → /time: builtin_interfaces/msg/Time")
        client = Client(launched, V5)
        client.subscribe("r3d3/y/talk")
        await peer.do("publish", "/y/spoken", string("hello").hex())
        assert client.next("r3d3/y/talk") == {"data": "hello"}

        def arrives():
            client.publish("r3d3/time", "now")
            return peer.received

        await until(arrives, "the time")
        client.leave()
        # The simulation's, of which nothing has come: so the file of parameters was read.
        assert peer.received[0] == ("/time", (b"\0\1\0\0" + bytes(8)).hex())
    finally:
        await peer.stop()
        launched.stop()  # by SIGTERM, with exit code 0: it is the appliance itself
    assert launched.log.count("on ROS as") == 1


# What it is found with


def test_the_command_is_found(tmp_path):
    def command(folder):
        (tmp_path / folder).mkdir(parents=True)
        path = tmp_path / folder / "appliance"
        path.write_text("#!/bin/sh\n")
        path.chmod(0o755)
        return path

    own, first, second = command("own"), command("first"), command("second")
    at_home, named = command("home/appliance/bin"), command("named")
    (tmp_path / "none/appliance").mkdir(parents=True)  # a folder of that name is no command
    paths = [str(tmp_path / name) for name in ("none", "own", "first", "second")]
    environment = {"PATH": os.pathsep.join(["", *paths]), "HOME": str(tmp_path / "home")}
    assert start.find_command(environment, own) == str(first)
    first.chmod(0o644)
    assert start.find_command(environment, own) == str(second)
    assert start.find_command({**environment, start.VARIABLE: str(named)}, own) == str(named)
    beside = {**environment, "PATH": str(tmp_path / "none")}
    if not any(Path(place).exists() for place in start.PLACES):  # this computer has none
        assert start.find_command(beside, own) == str(at_home)
        first_there = command("home/appliance-venv/bin")
        assert start.find_command(beside, own) == str(first_there)
        assert start.find_command({"PATH": ""}, own) is None
    with pytest.raises(ValueError, match="is no-such-command, which is not a program"):
        start.find_command({**environment, start.VARIABLE: "no-such-command"}, own)


# The package's own files


def test_the_manifest_is_valid():
    if not Path("/usr/lib/python3/dist-packages/catkin_pkg").is_dir():
        pytest.skip("catkin_pkg is not installed: apt install python3-catkin-pkg")
    lines = (
        "import sys; from catkin_pkg.package import parse_package; warnings = [];"
        "found = parse_package(sys.argv[1], warnings=warnings); found.validate(warnings=warnings);"
        "print(found.name, found.version, found.get_build_type(), warnings)"
    )
    done = subprocess.run(
        [DEBIAN_PYTHON, "-c", lines, PACKAGE],
        env=for_other_programs(),
        capture_output=True,
        text=True,
        check=True,
    )
    project = (PROJECT / "pyproject.toml").read_text()
    (version,) = re.findall(r'^version = "([^"]+)"', project, re.MULTILINE)
    assert done.stdout.strip() == f"mqtt_appliance {version} ament_python []"


class Substitution:
    """A stand-in of launch's: `LaunchConfiguration` (`var`) or `EnvironmentVariable` (`env`)."""

    def __init__(self, kind, name, default=None):
        self.kind, self.name, self.default = kind, name, default

    def __str__(self):
        return f"$({' '.join([self.kind, self.name, *filter(None, [self.default])])})"


class Described:
    """What a launch file has made of launch's classes, as the text of its YAML twin."""

    def __init__(self):
        self.arguments = {}
        self.nodes = []

    def argument(self, name, *, default_value=None, description=None, choices=None):
        assert name not in self.arguments and description and choices is None
        self.arguments[name] = (str(default_value), description)

    def node(
        self,
        *,
        executable,
        package=None,
        name=None,
        namespace=None,
        exec_name=None,
        parameters=None,
        remappings=None,
        ros_arguments=None,
        arguments=None,
        output="log",
        additional_env=None,
    ):
        assert (name, namespace, parameters, remappings, ros_arguments, exec_name) == (None,) * 6
        environment = {key: str(value) for key, value in additional_env.items()}
        arguments = " ".join(map(str, arguments))
        self.nodes.append((package, executable, output, arguments, environment))


def described_by_python(monkeypatch):
    described = Described()
    modules = {
        "launch": {"LaunchDescription": list},
        "launch.actions": {"DeclareLaunchArgument": described.argument},
        "launch.substitutions": {
            "EnvironmentVariable": lambda name, *, default_value=None: Substitution(
                "env", name, default_value
            ),
            "LaunchConfiguration": lambda name, *, default=None: Substitution("var", name, default),
        },
        "launch_ros": {},
        "launch_ros.actions": {"Node": described.node},
    }
    for name, values in modules.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)
    names = runpy.run_path(str(PACKAGE / "launch/appliance.launch.py"))
    assert len(names["generate_launch_description"]()) == 4
    return described


def described_by_yaml():
    described = Described()
    content = yaml.safe_load((PACKAGE / "launch/appliance.launch.yaml").read_text())
    assert list(content) == ["launch"]
    for entity in content["launch"]:
        ((kind, of),) = entity.items()
        if kind == "arg":
            assert of.keys() == {"name", "default", "description"}
            described.argument(
                of["name"], default_value=of["default"], description=of["description"]
            )
            continue
        assert kind == "node" and of.keys() == {"pkg", "exec", "output", "args", "env"}
        for variable in of["env"]:
            assert variable.keys() == {"name", "value"}
        described.node(
            package=of["pkg"],
            executable=of["exec"],
            output=of["output"],
            arguments=of["args"].split(" ", 1),
            additional_env={variable["name"]: variable["value"] for variable in of["env"]},
        )
    return described


def test_both_launch_files_start_the_same(monkeypatch):
    by_python, by_yaml = described_by_python(monkeypatch), described_by_yaml()
    assert by_python.arguments == by_yaml.arguments
    assert by_python.nodes == by_yaml.nodes
    assert by_yaml.arguments.keys() == {"config", "robot", "domain"}
    assert by_yaml.arguments["domain"][0] == "$(env ROS_DOMAIN_ID 0)"
    (node,) = by_yaml.nodes
    assert node == (
        "mqtt_appliance",
        "appliance",
        "screen",
        "--config $(var config)",
        {"APPLIANCE_ROBOT": "$(var robot)", "ROS_DOMAIN_ID": "$(var domain)"},
    )
