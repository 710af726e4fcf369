"""The command `appliance`.

Imports are inside the commands, so that `--help` and `pub` start fast.
Exit codes: 0 success, 1 refused or failed (the reason is on standard error), 2 wrong usage.
"""

from __future__ import annotations

import os
import sys
from typing import Annotated, NoReturn

import typer

from appliance.cli.access import acl_app, user_app
from appliance.cli.calls import call, goal, param_app
from appliance.cli.certs import cert_app
from appliance.cli.client import pub, sub
from appliance.cli.clients import clients_app
from appliance.cli.console import CommandError
from appliance.cli.doctor import doctor
from appliance.cli.enrol import user_enrol
from appliance.cli.fastdds import fastdds
from appliance.cli.find import find
from appliance.cli.import_mosquitto import import_mosquitto
from appliance.cli.install import install, uninstall
from appliance.cli.log import log
from appliance.cli.routes import routes
from appliance.cli.running import bench, check, demo, init, reload, run
from appliance.cli.status import status
from appliance.cli.store import store_app
from appliance.cli.top import top
from appliance.cli.upstream import upstream

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="The robot's MQTT broker, with the bridge to ROS inside it.",
)
# In this order in the help.
SETTING_UP = (init, run, check, reload)
LOOKING = (find, status, top, doctor, log, routes, upstream)
USING = (pub, sub, call, goal)
for command in (*SETTING_UP, *LOOKING, *USING, demo, fastdds, install, uninstall, bench):
    app.command()(command)
app.command("import")(import_mosquitto)
user_app.command("enrol")(user_enrol)
GROUPS = {
    "clients": clients_app,
    "param": param_app,
    "user": user_app,
    "acl": acl_app,
    "cert": cert_app,
    "store": store_app,
}
for name, group in GROUPS.items():
    app.add_typer(group, name=name)


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command and exit with its code; errors that users can fix have no traceback."""
    _open_standard_streams()
    given = sys.argv[1:] if arguments is None else arguments
    given, ros_arguments = _split_ros_arguments(given)
    try:
        app(args=given, prog_name="appliance", obj=ros_arguments)
    except CommandError as error:
        typer.secho(f"appliance: {error}", fg="red", err=True)
    except BrokenPipeError:  # `appliance sub … | head`: the reader has closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except KeyboardInterrupt:
        sys.exit(130)
    except OSError as error:
        what = error.strerror or str(error)
        what = f"{error.filename}: {what}" if error.filename else what
        typer.secho(f"appliance: {what}", fg="red", err=True)
    sys.exit(1)


def _open_standard_streams() -> None:
    """Open missing ones, so that no file gets their descriptors, which C libraries write to."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            os.dup2(os.open(os.devnull, os.O_RDWR), number)
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))


def _split_ros_arguments(arguments: list[str]) -> tuple[list[str], list[str]]:
    """The command's arguments, and those between `--ros-args` and `--`, which ROS tools add."""
    ours: list[str] = []
    ros: list[str] = []
    to = ours
    for argument in arguments:
        if argument == "--ros-args":
            to = ros
        elif argument == "--" and to is ros:
            to = ours
        else:
            to.append(argument)
    return ours, ros


def _version(wanted: bool) -> None:
    if wanted:
        from appliance.host.build import build

        typer.echo(build())
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options of `appliance` itself."""
