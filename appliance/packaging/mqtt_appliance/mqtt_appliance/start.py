"""Becomes the installed appliance: `ros2 run mqtt_appliance appliance -c FILE --ros-args …`.

The arguments are those of `appliance run`, with ROS's own behind `--ros-args`, as launch files add
them. The process is replaced, so that signals of `ros2 launch` and the exit code are the
appliance's own.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

#: The variable that names the command where it is in none of PLACES.
VARIABLE = "APPLIANCE_COMMAND"

#: Where the appliance's own ways of installing it put the command, behind the folders of PATH.
PLACES = (
    "/usr/bin/appliance",
    "/usr/local/bin/appliance",
    "/opt/appliance/bin/appliance",
    "~/appliance-venv/bin/appliance",
    "~/appliance/bin/appliance",
)

NOT_THERE = """\
mqtt_appliance: the appliance is not installed, and this package only starts it.
There is no command `appliance` in PATH, nor {places}.
Install it in the folder of its sources, which this package is from, in one of these ways:

  {python} -m venv --system-site-packages ~/appliance-venv && ~/appliance-venv/bin/pip install .
  make deb && sudo apt install ./dist/appliance_*.deb

Or say where it is: {variable}=/path/to/appliance"""


def find_command(environment: Mapping[str, str], own: Path) -> str | None:
    """The command of the installed appliance; `own` is this program, which has the same name.

    Raises ValueError when the one that is named by VARIABLE cannot be started.
    """
    named = environment.get(VARIABLE)
    if named:
        found = shutil.which(named, path=environment.get("PATH"))
        if found is None:
            raise ValueError(
                f"mqtt_appliance: {VARIABLE} is {named}, which is not a program that can be started"
            )
        return found
    folders = environment.get("PATH", "").split(os.pathsep)
    home = environment.get("HOME", "~")
    for place in (*(f"{folder}/appliance" for folder in folders if folder), *PLACES):
        found = shutil.which(place.replace("~", home, 1))
        if found is not None and Path(found).resolve() != own.resolve():
            return found
    return None


def main(arguments: list[str] | None = None) -> NoReturn:
    """Replace this process by the appliance; end with 127, as a shell does, where there is none."""
    given = sys.argv[1:] if arguments is None else arguments
    try:
        command = find_command(os.environ, Path(sys.argv[0]))
    except ValueError as error:
        sys.exit(str(error))
    if command is None:
        version = ".".join(map(str, sys.version_info[:2]))
        text = NOT_THERE.format(
            places=", ".join(PLACES), python=f"python{version}", variable=VARIABLE
        )
        print(text, file=sys.stderr)
        sys.exit(127)
    try:
        os.execv(command, [command, "run", *given])
    except OSError as error:  # of another kind of computer, or without its interpreter
        sys.exit(f"mqtt_appliance: {command} cannot be started: {error.strerror}")
