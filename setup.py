"""Compiles the broker to machine code when it is asked to: `APPLIANCE_COMPILE=1 pip install .`.

Everything else about the package is in pyproject.toml. Without the variable nothing is compiled,
and no compiler is needed; with it pip fetches mypyc for the build, and a C compiler and Python's
headers must be there. What is compiled takes 10 to 75 % less of the CPU time.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from setuptools import Extension, setup

# Not on the way of a message, and left as they are: mypyc takes the `TYPE` of the packet classes
# for a field of the dataclass; values and the links inside the appliance are subclassed where
# nothing is compiled; and each use of a compiled Protocol first asks whether the object is
# compiled, too, which what implements these is not.
INTERPRETED = {
    Path("appliance/broker/backlogs.py"),
    Path("appliance/broker/limits.py"),
    Path("appliance/broker/link.py"),
    Path("appliance/broker/ports.py"),
    Path("appliance/broker/store.py"),
    Path("appliance/broker/values.py"),
    Path("appliance/mqtt/connect.py"),
    Path("appliance/mqtt/packets.py"),
}

# Of the store: what runs for every message that is stored, and for every row at the start.
STORE = ("loader", "messages", "rows", "unread")

# Of the link to a fleet's broker: what runs for every message of its backlog, and what that calls.
UPSTREAM = (
    "backlog",
    "backlog_counts",
    "channel",
    "disk_room",
    "eviction",
    "latest_values",
    "late",
    "link",
    "live_messages",
    "publish_properties",
    "rates",
    "read_ahead",
    "receipts",
    "records",
    "retries",
    "rule_queue",
    "rule_queues",
    "sender",
    "user_shares",
)


#: What mypy has to see beside the compiled modules, to know the types of all that these import.
COMPILE_NEEDS = ["async-timeout>=5", "mypy[mypyc]>=2.4", "pydantic>=2.10", "types-PyYAML>=6.0.12"]

#: Commands of setuptools that compile nothing: pip asks for what the build needs, then for the
#: metadata, each in a run of its own; an sdist is the sources.
WITHOUT_COMPILING = {"egg_info", "dist_info", "sdist"}


def extensions() -> list[Extension]:
    """The data path: what is pure and typed, and runs for every message."""
    try:
        from mypyc.build import mypycify
    except ImportError as error:
        needs = " ".join(f"'{need}'" for need in COMPILE_NEEDS)
        sys.exit(
            f"setup.py: APPLIANCE_COMPILE=1, and mypyc is not here ({error}): build without "
            f"--no-build-isolation, or install what compiling needs: pip install {needs}"
        )
    modules = {*Path("appliance/mqtt").glob("*.py"), *Path("appliance/broker").glob("*.py")}
    modules |= {Path(f"appliance/net/{name}.py") for name in ("connection", "scheduler", "tls")}
    modules |= {Path(f"appliance/store/{name}.py") for name in STORE}
    modules |= {Path(f"appliance/upstream/{name}.py") for name in UPSTREAM}
    modules = {module for module in modules if module.name != "__init__.py"} - INTERPRETED
    level = os.environ.get("APPLIANCE_OPTIMIZE", "3")
    if level not in ("0", "1", "2", "3"):
        sys.exit(f"setup.py: APPLIANCE_OPTIMIZE is the C compiler's -O, 0 to 3, and not {level!r}")
    compiled = mypycify(sorted(map(str, modules)), opt_level=level, group_name="appliance")
    # In a generated file of 40 MB gcc looks two minutes for indentation that could mislead.
    options = ["-Wno-misleading-indentation"]
    if level == "0":  # for who looks whether it works, not how fast it is: two minutes less
        options += ["-g0", "-DNDEBUG"]
    for extension in compiled:
        extension.extra_compile_args = [*extension.extra_compile_args, *options]
    return compiled


def is_compiled() -> bool:
    """Whether machine code was asked for. An answer that is not understood is not a no."""
    asked = os.environ.get("APPLIANCE_COMPILE", "")
    if asked not in ("", "0", "1"):
        sys.exit(f"setup.py: APPLIANCE_COMPILE is 1 for machine code, or 0, and not {asked!r}")
    return asked == "1"


if not is_compiled():
    setup()
elif WITHOUT_COMPILING.intersection(sys.argv):
    setup(setup_requires=COMPILE_NEEDS)
else:
    setup(ext_modules=extensions())
