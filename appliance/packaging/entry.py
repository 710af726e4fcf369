"""Entry point of the single executable: sets up ROS's environment and runs the command.

`appliance -m appliance.cli.demo_robot …` runs another module, like Python's own option: programs
that are started from within use `sys.executable`, which is the single executable.

What is in it as machine code is used as such, unless `APPLIANCE_PURE=1` says not to.
"""

from __future__ import annotations

import fcntl
import importlib
import os
import runpy
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.machinery import EXTENSION_SUFFIXES, ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path

from appliance.host.environment import LIBRARIES, ORIGINAL_LIBRARIES
from appliance.ros.ros2 import installation

INSIDE = sys.prefix  # the directory that the executable is unpacked to
PREFIXES = "AMENT_PREFIX_PATH"
PURE = "APPLIANCE_PURE"
MACHINE_CODE = "appliance__mypyc"  # the library with the code of all compiled modules, see setup.py
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def main() -> None:
    use_ros()
    lock_unpacked_files()
    end_with_the_boot_loader()
    use_machine_code()
    if sys.argv[1:2] == ["-m"] and sys.argv[2:]:
        module = sys.argv[2]
        del sys.argv[1:3]
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    else:
        from appliance.cli.main import main as run

        run()


def end_with_the_boot_loader() -> None:
    """End this process when its boot loader is killed, which waits for it to clean up."""
    import ctypes  # needs a library that is found only in the environment of use_ros

    parent = os.getppid()
    try:
        is_boot_loader = Path(f"/proc/{parent}/exe").samefile(sys.executable)
    except OSError:
        return
    if is_boot_loader:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:
            sys.exit(1)


def lock_unpacked_files() -> None:
    """Lock the directory: systemd-tmpfiles skips locked directories when it cleans /tmp."""
    with suppress(OSError):  # a file system without locks
        fcntl.flock(os.open(INSIDE, os.O_RDONLY | os.O_DIRECTORY), fcntl.LOCK_SH)


def use_machine_code() -> None:
    """Import the compiled modules in the file, if there are any, in place of the pure ones."""
    if os.environ.get(PURE) == "1" or not _compiled(MACHINE_CODE).exists():
        return
    sys.meta_path.insert(0, CompiledModules)
    try:
        importlib.import_module(MACHINE_CODE)
    except ImportError as error:
        sys.meta_path.remove(CompiledModules)
        print(
            f"appliance: running without its machine code, which does not load: {error}",
            file=sys.stderr,
        )


class CompiledModules:
    """Finds compiled modules; the boot loader's own finder prefers the pure ones."""

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: object = None
    ) -> ModuleSpec | None:
        if name != MACHINE_CODE and not name.startswith("appliance."):
            return None
        library = _compiled(name)
        return spec_from_file_location(name, library) if library.exists() else None


def _compiled(module: str) -> Path:
    return Path(INSIDE, *module.split(".")).with_suffix(EXTENSION_SUFFIXES[0])


def use_ros() -> None:
    """Set the search paths: the bundled ROS before the sourced one, or the other way round."""
    environment = os.environ
    prefixes = [path for path in _paths(PREFIXES) if path != INSIDE]
    libraries = _paths(ORIGINAL_LIBRARIES)
    python = _paths("PYTHONPATH")
    environment[PREFIXES] = os.pathsep.join(prefixes)
    sourced = installation.is_wanted(environment)
    if sourced is None:
        prefixes.insert(0, INSIDE)
        libraries.insert(0, INSIDE)
        sys.path += python
    else:
        libraries.append(INSIDE)
        sys.path[:0] = [*python, str(sourced.site)]
        # A distribution's ROS imports modules of its Python, such as numpy, that this one may lack.
        version = f"/usr/lib/python{sys.version_info[0]}.{sys.version_info[1]}"
        sys.path += [version, f"{version}/lib-dynload", "/usr/lib/python3/dist-packages"]
    environment["_ROS_WHEELS_BOOTSTRAP_COMPLETE"] = "1"
    environment[PREFIXES] = os.pathsep.join(prefixes)
    if not os.access(environment.get("HOME", ""), os.W_OK):  # where ROS writes its logs
        environment.setdefault("ROS_LOG_DIR", f"{INSIDE}/log")
    if _paths(LIBRARIES) != libraries:  # the variable is read only when a program starts
        environment[LIBRARIES] = os.pathsep.join(libraries)
        os.execv(sys.executable, [sys.executable, *sys.argv[1:]])


def _paths(variable: str) -> list[str]:
    return [path for path in os.environ.get(variable, "").split(os.pathsep) if path]


if __name__ == "__main__":
    main()
