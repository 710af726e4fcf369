"""The environment that other programs are started with."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

_MARK = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"


def for_other_programs(environment: Mapping[str, str] | None = None) -> dict[str, str]:
    """This process's environment as it was before the ROS wheels changed it.

    The wheels restart Python with an `LD_LIBRARY_PATH` that names their own libraries. Another
    program (mosquitto, a system's Python) that inherits it would load those in place of its own.
    """
    result = dict(os.environ if environment is None else environment)
    if result.pop(_MARK, None) is None:
        return result
    wheels = Path(sys.prefix, "lib").resolve()
    paths = result.pop("LD_LIBRARY_PATH", "").split(os.pathsep)
    kept = [path for path in paths if path and not Path(path).resolve().is_relative_to(wheels)]
    if kept:
        result["LD_LIBRARY_PATH"] = os.pathsep.join(kept)
    return result
