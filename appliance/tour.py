"""`appliance demo`: the appliance beside a demo robot, and what to type to see and drive it."""

from __future__ import annotations

import ctypes
import importlib.util
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import typer

from appliance import app
from appliance.access import Passwords
from appliance.config import Bind, Settings
from appliance.environment import for_other_programs
from appliance.init import PASSWORD_FILE

START_TIMEOUT = 30.0  # seconds until the broker takes connections
STOP_TIMEOUT = 5.0  # seconds that the robot has to end by itself
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class TourError(Exception):
    """The demo cannot start; the message says why and what to do."""


def run(settings: Settings) -> int:
    """Runs broker, bridge and demo robot until SIGINT or SIGTERM; returns the exit code."""
    secure = [listener.bind for listener in settings.broker.listeners if listener.tls]
    if not secure:
        raise TourError("the demo needs a listener with tls: true")
    for listener in settings.broker.listeners:
        _check_free(listener.bind)
    robot = _start_robot(settings)
    threading.Thread(target=_announce, args=(settings, secure[0], robot), daemon=True).start()
    try:
        return app.run(settings)
    finally:
        if robot is not None:
            _stop(robot)


def _check_free(bind: Bind) -> None:
    family = socket.AF_INET6 if ":" in bind.host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((bind.host, bind.port))
        except OSError as error:
            raise TourError(
                f"{bind} cannot be used: {(error.strerror or str(error)).lower()}. Another broker "
                "may run there; choose other ports: make run PORT=9883 PLAIN_PORT=9884"
            ) from None


def _start_robot(settings: Settings) -> subprocess.Popen[bytes] | None:
    if settings.bridge.bus == "none":
        return None
    if importlib.util.find_spec("rclpy") is None:
        _say(
            "There is no ROS 2 here (its packages on PyPI are for Linux on x86-64), so there is no "
            "demo robot: the broker runs alone."
        )
        return None
    libc = ctypes.CDLL(None)  # before the fork: nothing may be loaded after it
    return subprocess.Popen(
        [sys.executable, "-m", "appliance.demo"],
        env=for_other_programs(),
        # The robot must not drive on when this process is killed.
        preexec_fn=lambda: libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM),
    )


def _stop(robot: subprocess.Popen[bytes]) -> None:
    robot.terminate()
    try:
        robot.wait(STOP_TIMEOUT)
    except subprocess.TimeoutExpired:
        robot.kill()
        robot.wait()


def _announce(settings: Settings, secure: Bind, robot: subprocess.Popen[bytes] | None) -> None:
    """Waits until clients can connect, then says how; runs in a thread of its own."""
    host = secure.host if secure.host not in ("", "0.0.0.0", "::") else "localhost"
    deadline = time.monotonic() + START_TIMEOUT
    while time.monotonic() < deadline:
        try:
            socket.create_connection((host, secure.port), timeout=1).close()
            break
        except OSError:
            time.sleep(0.05)
    else:
        return
    if robot is not None:
        code = robot.poll()
        if code is not None:
            _say(f"The demo robot ended (exit code {code}); the broker runs without it.")
    _say(instructions(settings, host, secure.port))


def instructions(settings: Settings, host: str, port: int) -> str:
    """What to type in another terminal to see and drive the robot."""
    directory = (settings.file or Path("appliance.yaml")).parent
    user = next(iter(Passwords.load(settings.broker.users).users()), "USER")
    password = directory / PASSWORD_FILE
    shown = f'"$(cat {_quoted(password)})"' if password.exists() else "PASSWORD"
    login = (
        f"-h {host} -p {port} --cafile {_quoted(settings.broker.tls.ca)} "
        f"-u {shlex.quote(user)} -P {shown}"
    )
    command = _quoted(Path(sys.executable).parent / "appliance")
    options = f"-c {_quoted(settings.file or Path('appliance.yaml'))} -u {shlex.quote(user)}"
    options += f" --password-file {_quoted(password)}" if password.exists() else ""
    robot = settings.robot
    twist = '\'{"linear": {"x": 0.5}, "angular": {"z": 0.3}}\''
    return f"""
Ready. In another terminal, in this folder:

see the robot:
  mosquitto_sub {login} -v -t '{robot}/odom'
drive it:
  mosquitto_pub {login} -t '{robot}/cmd_vel' -m {twist}

the same with this project's own command:
  {command} sub {options} -v '{robot}/odom'
  {command} pub {options} '{robot}/cmd_vel' -m {twist}

Ctrl-C here ends everything.
"""


def _quoted(path: Path) -> str:
    """The path as it is typed in the current folder."""
    try:
        path = path.absolute().relative_to(Path.cwd())
    except ValueError:
        path = path.absolute()
    return shlex.quote(str(path))


def _say(text: str) -> None:
    typer.echo(text)
    sys.stdout.flush()
