"""Explains why a library cannot be imported: it is missing, or compiled for another computer.

Nothing outside of Python's standard library is imported here: it may be what is broken.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import find_spec
from pathlib import Path

#: The names of `e_machine` in the header of an ELF file.
MACHINES = {3: "32-bit x86", 40: "32-bit ARM", 62: "x86-64", 183: "arm64", 243: "RISC-V"}

#: Bytes of that header up to and with `e_machine`.
_HEADER = 20

_PYTHON = re.compile(r"\.cpython-(\d)(\d+)")

_ADVICE = (
    "An environment works only with the Python and the kind of computer that it was made with. "
    "Make it here, in the folder of the appliance's sources: "
    "python3 -m venv ~/appliance-venv && ~/appliance-venv/bin/pip install ."
)


def explain(error: ImportError) -> str | None:
    """What is wrong with the environment and what to do about it; None when the error is of
    another kind."""
    name = (error.name or "").partition(".")[0]
    if error.path and error.path.endswith(".so"):
        wrong = _wrong_with(Path(error.path))
        # Else it is cut off, or wants a newer Linux; the loader has named the file.
        return f"{error.path} {wrong}. {_ADVICE}" if wrong else f"{error}. {_ADVICE}"
    for file in _unfit(name):
        if (wrong := _wrong_with(file)) is not None:
            return f"{file} {wrong}. {_ADVICE}"
    is_absent = isinstance(error, ModuleNotFoundError) and name not in ("", *sys.modules)
    if is_absent and find_spec(name) is None:
        return f"the package {name} is not installed for {_this_python()}. {_ADVICE}"
    return None


def machine_of(file: Path) -> str | None:
    """The kind of computer that a program or library is compiled for; None if it is neither."""
    try:
        with file.open("rb") as opened:
            header = opened.read(_HEADER)
    except OSError:
        return None
    if len(header) < _HEADER or not header.startswith(b"\x7fELF"):
        return None
    number = int.from_bytes(header[18:20], "little" if header[5] == 1 else "big")
    return MACHINES.get(number, f"another kind of computer (ELF machine {number})")


def _unfit(name: str) -> Iterator[Path]:
    """Compiled modules of that package which this Python does not take for its own; a module that
    is there for several Pythons, this one among them, is not meant."""
    for folder in map(Path, sys.path if name else ()):
        files = [*folder.glob(f"{name}.*so"), *(folder / name).rglob("*.so")]
        fitting = {file.with_name(_module(file)) for file in files if _fits(file)}
        yield from sorted(file for file in files if file.with_name(_module(file)) not in fitting)


def _module(file: Path) -> str:
    return file.name.partition(".")[0]


def _fits(file: Path) -> bool:
    return file.name.removeprefix(_module(file)) in EXTENSION_SUFFIXES and _wrong_with(file) is None


def _wrong_with(file: Path) -> str | None:
    machine, here = machine_of(file), machine_of(Path(sys.executable))
    if machine is None:
        return "is damaged: it is not a library of Linux, or only the beginning of one"
    if here is not None and machine != here:
        return f"is compiled for {machine}, and {_this_python()} is for {here}"
    python = _PYTHON.search(file.name)
    if python is not None and (int(python[1]), int(python[2])) != sys.version_info[:2]:
        return f"is compiled for Python {python[1]}.{python[2]}, and this is {_this_python()}"
    return None


def _this_python() -> str:
    return f"{sys.executable} (Python {sys.version_info[0]}.{sys.version_info[1]})"
