"""Finds the ROS 2 that this process uses, a sourced one beside it, and how to use that instead.

Nothing of ROS is imported here: `appliance doctor` reports it without ROS, and the one file chooses
its ROS with it.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

#: The variable that selects the ROS of the one file: `system` (the sourced one) or `bundled` (its
#: own). Unset, the sourced one is used when it has types that the bundled one lacks, and both have
#: the same Python.
CHOICE = "ROS_FROM"

DEFAULT_RMW = "rmw_fastrtps_cpp"

#: rclpy's compiled module: `_rclpy_pybind11`, and in Rolling `_rclpy_nanobind`.
_EXTENSION = re.compile(r"_rclpy_\w+\.cpython-(\d)(\d+)(?:-(\w+))?")
_SITES = ("lib/python3*/site-packages", "local/lib/python3*/dist-packages")

#: The kind of computer that this Python loads libraries for, as their names have it.
_TAGS = map(re.compile(r"\.cpython-\d+-(\w+)").match, EXTENSION_SUFFIXES)
MACHINE = next((tag[1] for tag in _TAGS if tag), "")

PythonVersion = tuple[int, int]


@dataclass(frozen=True)
class Sourced:
    """A sourced ROS 2, from the environment: the Python version of its rclpy, the folder of its
    Python packages, its distribution where ROS_DISTRO names it, and the kind of computer that it
    is for, as in MACHINE."""

    python: PythonVersion
    site: Path
    distribution: str
    machine: str = MACHINE

    @property
    def fits(self) -> bool:
        """Whether this process can import it."""
        return self.python == sys.version_info[:2] and self.is_for_this_computer

    @property
    def is_for_this_computer(self) -> bool:
        """False for what was copied from another kind of computer."""
        return self.machine == MACHINE

    def __str__(self) -> str:
        name = f"ROS 2 {self.distribution}" if self.distribution else "the ROS 2"
        return f"{name} in {self.site} (Python {_dotted(self.python)})"


@dataclass(frozen=True)
class Installation:
    """The ROS 2 that is used.

    `source` is `sourced`, `bundled` (in the one file), `installed` (from PyPI) or `none`. `where`
    is the folder of its Python packages. `rmw` and `domain` are from the environment. `advice` is
    a sentence on what to do, empty when there is nothing to do.
    """

    source: Literal["sourced", "bundled", "installed", "none"]
    where: Path | None
    python: PythonVersion
    rmw: str
    domain: str
    sourced: Sourced | None
    advice: str

    def __str__(self) -> str:
        if self.source == "none":
            return "no ROS 2"
        name = str(self.sourced) if self.source == "sourced" else f"ROS 2, {self.source}"
        return f"{name}, {self.rmw}, domain {self.domain}"


def find(environment: Mapping[str, str] | None = None) -> Installation:
    """The ROS 2 that an import of rclpy finds in this process. Imports nothing."""
    environment = os.environ if environment is None else environment
    sourced = find_sourced(environment)
    spec = find_spec("rclpy")
    where = Path(spec.origin).parent.parent if spec is not None and spec.origin else None
    is_sourced = sourced is not None and where is not None and where.samefile(sourced.site)
    source: Literal["sourced", "bundled", "installed", "none"] = "installed"
    if where is None or (is_sourced and sourced is not None and not sourced.fits):
        source = "none"
    elif is_sourced:
        source = "sourced"
    elif is_frozen():
        source = "bundled"
    return Installation(
        source,
        where if source != "none" else None,
        sys.version_info[:2],
        environment.get("RMW_IMPLEMENTATION") or DEFAULT_RMW,
        environment.get("ROS_DOMAIN_ID") or "0",
        sourced,
        _advice(source, sourced, environment.get(CHOICE)),
    )


def find_sourced(environment: Mapping[str, str]) -> Sourced | None:
    """The first ROS 2 in PYTHONPATH or AMENT_PREFIX_PATH, which sourcing a setup file sets."""
    fitting: list[Sourced] = []
    others: list[Sourced] = []
    for site in _sites(environment):
        for extension in sorted(Path(site, "rclpy").glob("_rclpy_*.so")):
            if match := _EXTENSION.match(extension.name):
                python = int(match[1]), int(match[2])
                distribution = environment.get("ROS_DISTRO", "")
                found = Sourced(python, site, distribution, match[3] or MACHINE)
                (fitting if found.fits else others).append(found)
    return next(iter([*fitting, *others]), None)


def _sites(environment: Mapping[str, str]) -> Iterator[Path]:
    yield from map(Path, _paths(environment, "PYTHONPATH"))
    for prefix in map(Path, _paths(environment, "AMENT_PREFIX_PATH")):
        if not _is_own(prefix):
            for pattern in _SITES:
                yield from sorted(prefix.glob(pattern))


def is_wanted(environment: Mapping[str, str]) -> Sourced | None:
    """The sourced ROS, when the one file shall use it instead of its own; see CHOICE."""
    choice = environment.get(CHOICE, "")
    sourced = find_sourced(environment) if choice != "bundled" else None
    if sourced is None or not sourced.fits:
        return None
    prefixes = [Path(path) for path in _paths(environment, "AMENT_PREFIX_PATH")]
    others = {name for prefix in prefixes if not _is_own(prefix) for name in _interfaces(prefix)}
    return sourced if choice == "system" or others - set(_interfaces(Path(sys.prefix))) else None


def is_frozen() -> bool:
    """Whether this process runs from the one file."""
    return bool(getattr(sys, "frozen", False))


def _advice(source: str, sourced: Sourced | None, choice: str | None) -> str:
    if sourced is not None and not sourced.is_for_this_computer:
        return (
            f"{sourced} is for another kind of computer: {sourced.machine}, where this is "
            f"{MACHINE}. Install ROS on this computer, and source its setup file"
        )
    if sourced is not None and not sourced.fits:
        python = f"python{_dotted(sourced.python)}"
        fits = (
            f"{sourced} cannot be used by this appliance, which has Python "
            f"{_dotted(sys.version_info[:2])}. To use it, in the folder of the appliance's "
            f"sources: {python} -m venv --system-site-packages ~/appliance && "
            "~/appliance/bin/pip install ."
        )
        if source == "none" or choice == "system":
            return fits
        return (
            f"topics of all its message packages are bridged; should services and actions of "
            f"packages of your own be bridged too: {fits}"
        )
    if sourced is None and choice == "system":
        return f"{CHOICE} is system, and no ROS 2 is sourced: source its setup file first"
    if source == "none":
        return (
            "there is no ROS 2 here: rclpy cannot be imported. Source a ROS 2 setup file first, "
            "or, on x86-64 Linux, install the appliance with one: pip install '.[ros]' in the "
            "folder of its sources, or pip install 'FILE.whl[ros]' where it came as a wheel"
        )
    return ""


def _interfaces(prefix: Path) -> Iterator[str]:
    folder = prefix / "share/ament_index/resource_index/rosidl_interfaces"
    if folder.is_dir():
        yield from (entry.name for entry in folder.iterdir())


def _is_own(prefix: Path) -> bool:
    return prefix == Path(sys.prefix)


def _paths(environment: Mapping[str, str], variable: str) -> list[str]:
    return [path for path in environment.get(variable, "").split(os.pathsep) if path]


def _dotted(version: PythonVersion) -> str:
    return ".".join(map(str, version))
