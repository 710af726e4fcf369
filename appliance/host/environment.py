"""Environments: for programs that are started, and of the systemd service."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

LIBRARIES = "LD_LIBRARY_PATH"
#: Its value before the boot loader of the one-file build put its own libraries first.
ORIGINAL_LIBRARIES = f"{LIBRARIES}_ORIG"
_MARK = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"


def for_other_programs(environment: Mapping[str, str] | None = None) -> dict[str, str]:
    """This process's environment as it was before the ROS wheels, or the one-file build, changed
    it.

    They restart Python with an `LD_LIBRARY_PATH` that names their own libraries. Another program
    (mosquitto, the system's Python) that inherits it would load those in place of its own.
    """
    result = dict(os.environ if environment is None else environment)
    if result.pop(_MARK, None) is None:
        return result
    inside = Path(sys.prefix, "" if getattr(sys, "frozen", False) else "lib").resolve()
    paths = result.pop(LIBRARIES, "").split(os.pathsep)
    others = [path for path in paths if path and not Path(path).resolve().is_relative_to(inside)]
    if others:
        result[LIBRARIES] = os.pathsep.join(others)
    return result


def of_service(configuration: Path) -> dict[str, str]:
    """What systemd gives to the service with that configuration by EnvironmentFile= in its unit.

    Empty when it is not a service's configuration, or the file cannot be read.
    """
    *_, etc, folder, name = ("", "", *configuration.absolute().parts)
    if (etc, folder, name) != ("etc", "appliance", "appliance.yaml"):
        return {}
    lines: list[str] = []
    with suppress(OSError, UnicodeDecodeError):
        file = configuration.absolute().parents[1] / "default/appliance"
        lines = file.read_text(encoding="utf-8").replace("\\\n", "").splitlines()
    found = {}
    for line in map(str.strip, lines):
        name, is_set, value = line.partition("=")
        if is_set and line[0] not in "#;":
            with suppress(ValueError):  # a quote without an end
                found[name.strip()] = shlex.split(value)[0] if value[:1] in {"'", '"'} else value
    return found
