"""`appliance demo`: runs the appliance with a demo robot, and prints commands to drive it."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import importlib.util
import shlex
import signal
import socket
import sys
from asyncio.subprocess import Process
from pathlib import Path

import typer
import uvloop

from appliance.access import Passwords
from appliance.app.main import App
from appliance.config import Bind, Settings
from appliance.ops.control import ControlError, ask
from appliance.ops.init import PASSWORD_FILE
from appliance.ros.ros2.installation import is_frozen

RESET = "/reset"  # a service of the demo robot that the demo's configuration bridges
STOP_TIMEOUT = 5.0  # seconds until the robot is killed
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class DemoError(Exception):
    """The demo cannot start; the message says why and what to do."""


def run(settings: Settings) -> int:
    """Run broker, bridge and demo robot until SIGINT or SIGTERM; returns the exit code."""
    if not any(listener.is_mqtts for listener in settings.broker.listeners):
        raise DemoError("the demo needs a listener with tls: true")
    with contextlib.suppress(ControlError):
        pid = ask(settings.control, "status")["pid"]
        raise DemoError(f"this demo runs already, as process {pid}; Ctrl-C in its terminal ends it")
    for listener in settings.broker.listeners:
        if listener.bind.path is None:
            _check_free(listener.bind)
    uvloop.run(_main(settings))
    return 0


async def _main(settings: Settings) -> None:
    await Demo(settings).run()


class Demo(App):
    """The appliance with a demo robot that starts and stops with it."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self._robot: Process | None = None
        self._watching: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Start everything, then print instructions. Raises what App.start raises."""
        await super().start()
        self._robot = await _start_robot(self.settings)
        if self._robot is not None:
            self._watching = asyncio.create_task(_watch(self._robot))
        for listener, (host, port) in zip(
            self.settings.broker.listeners, self.addresses, strict=True
        ):
            if listener.is_mqtts:
                here = "localhost" if host in ("", "0.0.0.0", "::", "127.0.0.1") else host
                _say(instructions(self.settings, here, port))
                break

    async def stop(self) -> None:
        """Stop the robot, then the appliance; may be called twice."""
        if self._watching is not None:
            self._watching.cancel()
        if self._robot is not None:
            await _stop(self._robot)
        await super().stop()


def _check_free(bind: Bind) -> None:
    family = socket.AF_INET6 if ":" in bind.host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((bind.host, bind.port))
        except OSError as error:
            raise DemoError(
                f"{bind} cannot be used: {(error.strerror or str(error)).lower()}. Another broker "
                "may run there; choose other ports: make run PORT=9883 PLAIN_PORT=9884"
            ) from None


async def _start_robot(settings: Settings) -> Process | None:
    if settings.bridge.bus != "ros2":
        return None
    if importlib.util.find_spec("rclpy") is None:
        _say(
            "There is no ROS 2 here (its packages on PyPI are for Linux on x86-64), so there is no "
            "demo robot: the broker runs alone."
        )
        return None
    libc = ctypes.CDLL(None)  # loaded before the fork: after it nothing may be loaded
    return await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "appliance.cli.demo_robot",
        # The robot must end when this process is killed.
        preexec_fn=lambda: libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM),
    )


async def _watch(robot: Process) -> None:
    code = await robot.wait()
    _say(f"The demo robot ended (exit code {code}); the broker runs on without it.")


async def _stop(robot: Process) -> None:
    with contextlib.suppress(ProcessLookupError):
        robot.terminate()
    try:
        await asyncio.wait_for(robot.wait(), STOP_TIMEOUT)
    except asyncio.TimeoutError:
        robot.kill()
        await robot.wait()


def instructions(settings: Settings, host: str, port: int) -> str:
    """Commands for another terminal to see and drive the robot."""
    directory = (settings.file or Path("appliance.yaml")).parent
    user = next(iter(Passwords.load(settings.broker.users).users()), "USER")
    password = directory / PASSWORD_FILE
    shown = f'"$(cat {_quoted(password)})"' if password.exists() else "PASSWORD"
    login = (
        f"-h {host} -p {port} --cafile {_quoted(settings.broker.tls.ca)} "
        f"-u {shlex.quote(user)} -P {shown}"
    )
    python = Path(sys.executable)
    command = _quoted(python if is_frozen() else python.parent / "appliance")
    options = f"-c {_quoted(settings.file or Path('appliance.yaml'))} -u {shlex.quote(user)}"
    if port != 8883:  # the other terminal does not have this one's APPLIANCE_PORT
        options += f" -p {port}"
    options += f" --password-file {_quoted(password)}" if password.exists() else ""
    robot = settings.robot
    twist = '\'{"linear": {"x": 0.5}, "angular": {"z": 0.3}}\''
    call = ""
    if any(RESET in route.names for route in settings.bridge.services):
        call = (
            f"put it back to its start, by a service of ROS:\n  {command} call {options} {RESET}\n"
        )
    return f"""
Ready. In another terminal, in this folder:

see the robot:
  mosquitto_sub {login} -v -t '{robot}/odom'
drive it:
  mosquitto_pub {login} -t '{robot}/cmd_vel' -m {twist}

the same with this project's own command:
  {command} sub {options} -v '{robot}/odom'
  {command} pub {options} '{robot}/cmd_vel' -m {twist}
{call}
Ctrl-C here ends everything.
"""


def _quoted(path: Path) -> str:
    """The path relative to the current directory, quoted for a shell."""
    try:
        path = path.absolute().relative_to(Path.cwd())
    except ValueError:
        path = path.absolute()
    return shlex.quote(str(path))


def _say(text: str) -> None:
    typer.echo(text)
    sys.stdout.flush()
