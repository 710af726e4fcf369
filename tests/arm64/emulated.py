"""arm64 under emulation: Debian's Python with ROS 1, and the appliance with its libraries.

qemu runs a program of arm64 as a process of this computer. Its files are looked for in the root
first and then here, so that it shares the network and the folders of the tests.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from pages import PROJECT

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

QEMU = "qemu-aarch64-static"
SUITE = "bookworm"
PYTHON = "3.11"  # of that release
ROS1 = ("python3-rosmaster", "python3-rospy", "python3-std-msgs")


class Emulated:
    """The Python of a root, and what it finds: the appliance's source and its libraries."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.libraries = root / "libraries"
        self.python = [QEMU, "-L", str(root), str(root / f"usr/bin/python{PYTHON}")]
        self.environment = {
            "PYTHONPATH": f"{PROJECT}{os.pathsep}{self.libraries}",
            # Compiled once, and nowhere but here.
            "PYTHONPYCACHEPREFIX": str(root / "pycache"),
            "PYTHONDONTWRITEBYTECODE": "",
            # Those of this computer's ROS are of another kind.
            "LD_LIBRARY_PATH": "",
        }

    def install(self) -> None:
        """The appliance's libraries in the tested versions, as wheels for arm64."""
        project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
        glibc = [f"--platform=manylinux_2_{minor}_aarch64" for minor in (17, 28, 34)]
        command = [
            *(sys.executable, "-m", "pip", "install", "--quiet", "--target", self.libraries),
            *("--only-binary=:all:", "--implementation=cp", f"--python-version={PYTHON}", *glibc),
            *("--no-compile", "-c", PROJECT / "constraints.txt", *project["dependencies"]),
        ]
        done = subprocess.run(command, capture_output=True, text=True, timeout=1200)
        assert done.returncode == 0, done.stderr

    def run(self, *arguments: str | Path, code: int = 0) -> str:
        """What `python arguments…` prints there."""
        done = subprocess.run(
            [*self.python, *arguments],
            env={**os.environ, **self.environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=240,
        )
        assert done.returncode == code, done.stdout
        return done.stdout

    def size(self) -> int:
        """Bytes on the disk of Python, ROS 1 and the libraries, without what was compiled since."""
        files = (path for path in self.root.rglob("*") if path.is_file() and not path.is_symlink())
        compiled = self.root / "pycache"
        return sum(path.stat().st_size for path in files if compiled not in path.parents)
