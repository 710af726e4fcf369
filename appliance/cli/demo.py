"""`appliance demo`: runs the appliance with a demo robot, and prints commands to drive it."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import importlib.util
import os
import shlex
import signal
import socket
import sys
from asyncio.subprocess import Process
from pathlib import Path

import typer
import uvloop
from async_timeout import timeout

from appliance.access import Passwords
from appliance.app.main import App
from appliance.config import Bind, Settings
from appliance.host.addresses import own_address
from appliance.ops.control import ControlError, ask
from appliance.ops.init import PASSWORD_FILE
from appliance.ros.ros2.installation import is_frozen

RESET = "/reset"  # a service of the demo robot that the demo's configuration bridges
STOP_TIMEOUT = 5.0  # seconds until the robot is killed
_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_ANY = ("", "0.0.0.0", "::")  # hosts of a listener on all addresses
#: Options that drive, with QoS 0 in both commands. A single command moves nothing, as the stop
#: message follows when its client leaves.
DRIVE = """-m '{"linear": {"x": 0.5}, "angular": {"z": 0.3}}' --repeat 40 --repeat-delay 0.05"""


class DemoError(Exception):
    """The demo cannot start; the message says why and what to do."""


def run(settings: Settings) -> int:
    """Run broker, bridge and demo robot until SIGINT or SIGTERM; returns the exit code."""
    if not any(listener.is_mqtts for listener in settings.broker.listeners):
        raise DemoError("the demo needs a listener with tls: true")
    if not any(route.is_pattern or route.ros == "/odom" for route in settings.bridge.topics):
        raise DemoError(
            f"{settings.file} has no route for the demo robot's topics, such as /odom: in a folder "
            "of its own, `appliance init --demo` writes a configuration that has"
        )
    with contextlib.suppress(ControlError):
        pid = ask(settings.control, "status")["pid"]
        raise DemoError(f"this demo runs already, as process {pid}; Ctrl-C in its terminal ends it")
    for listener in settings.broker.listeners:
        if listener.bind.path is None:
            _check_free(listener.bind, settings.file)
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
        listening = list(zip(self.settings.broker.listeners, self.addresses, strict=True))
        mqtts = next(address for listener, address in listening if listener.is_mqtts)
        web = [address for listener, address in listening if listener.is_web_over_tls]
        _say(instructions(self.settings, mqtts, *web[:1], has_robot=self._robot is not None))

    async def stop(self) -> None:
        """Stop the robot, then the appliance; may be called twice."""
        if self._watching is not None:
            self._watching.cancel()
        if self._robot is not None:
            await _stop(self._robot)
        await super().stop()


def _check_free(bind: Bind, file: Path | None) -> None:
    family = socket.AF_INET6 if ":" in bind.host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((bind.host, bind.port))
        except OSError as error:
            others = f"other ports in broker.listeners of {file}"
            if "APPLIANCE_PLAIN_PORT" in os.environ:  # as the Makefile sets it
                others = "other ports: make run PORT=9883 PLAIN_PORT=9884 WEB_PORT=9443"
            raise DemoError(
                f"{bind} cannot be used: {(error.strerror or str(error)).lower()}. Another program "
                f"may run there: stop it, or choose {others}"
            ) from None


async def _start_robot(settings: Settings) -> Process | None:
    if settings.bridge.bus != "ros2":
        return None
    if importlib.util.find_spec("rclpy") is None:
        _say(
            "There is no ROS 2 here, so there is no demo robot: the broker runs alone. Source a "
            "ROS 2, or, on x86-64 Linux, install the appliance with its extra [ros]."
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
        async with timeout(STOP_TIMEOUT):
            await robot.wait()
    except asyncio.TimeoutError:
        robot.kill()
        await robot.wait()


def instructions(
    settings: Settings,
    mqtts: tuple[str, int],
    web: tuple[str, int] | None = None,
    *,
    has_robot: bool = True,
) -> str:
    """How to see and drive the robot: in a browser, and with commands in another terminal.

    `mqtts` and `web` are the hosts and ports of listeners with TLS. Without a robot nobody says
    anything but the other terminals.
    """
    (host, port), robot = mqtts, settings.robot
    directory = (settings.file or Path("appliance.yaml")).parent
    user = Passwords.load(settings.broker.users).first() or "USER"
    password = directory / PASSWORD_FILE
    shown = f'"$(cat {_quoted(password)})"' if password.exists() else "PASSWORD"
    login = (
        f"-h {_here(host)} -p {port} --cafile {_quoted(settings.broker.tls.ca)} "
        f"-u {shlex.quote(user)} -P {shown}"
    )
    python = Path(sys.executable)
    command = _quoted(python if is_frozen() else python.parent / "appliance")
    options = f"-c {_quoted(settings.file or Path('appliance.yaml'))} -u {shlex.quote(user)}"
    if port != 8883:  # the other terminal does not have this one's APPLIANCE_PORT
        options += f" -p {port}"
    options += f" --password-file {_quoted(password)}" if password.exists() else ""
    see, drive, call = (
        "see the robot",
        "drive it, for two seconds; it stops when no command follows",
        "",
    )
    if not has_robot:
        see, drive = "see what is published there", "publish to it, as who drives a robot would"
    elif any(RESET in route.names for route in settings.bridge.services):
        call = (
            f"put it back to its start, by a service of ROS:\n  {command} call {options} {RESET}\n"
        )
    topic = f"{robot}/odom" if has_robot else f"{robot}/#"
    console = _console(web, user, password)
    if console and has_robot:
        console += f" Topics has the\nodometry, {robot}/odom, and Drive moves the robot."
    return f"""
Ready.{console}

In another terminal, in this folder:

{see}:
  mosquitto_sub {login} -v -t '{topic}'
{drive}:
  mosquitto_pub {login} -t '{robot}/cmd_vel' {DRIVE}

the same with this project's own command:
  {command} sub {options} -v '{topic}'
  {command} pub {options} '{robot}/cmd_vel' -q 0 {DRIVE}
{call}
Ctrl-C here ends everything.
"""


def _console(web: tuple[str, int] | None, user: str, password: Path) -> str:
    """Where the console is, and how to sign in; empty without a listener for the web."""
    if web is None:
        return ""
    host, port = web
    elsewhere = own_address() if host in _ANY else None
    phone = "" if elsewhere is None else f"  https://{elsewhere}:{port}/  (from a phone)\n"
    kept = f"; its password is in {_quoted(password)}" if password.exists() else ""
    return f""" In a browser:

  https://{_here(host)}:{port}/
{phone}
Sign in as {user}{kept}.
The certificate is this robot's own, so the browser asks whether to trust it."""


def _here(host: str) -> str:
    """The host to connect to from this computer."""
    return "localhost" if host in (*_ANY, "127.0.0.1") else host


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
