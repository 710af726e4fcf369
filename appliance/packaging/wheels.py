"""The wheels of a release, built from its sdist: the pure one, and those with machine code.

Machine code is for one Python and one kind of computer. That for arm64 is cross-compiled: Python's
headers are the same there, but for what `_FOR_ARM64` undoes.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from appliance.packaging import emulation

#: The machine of an ELF file, two bytes at offset 18.
_MACHINES = {"x86_64": 62, "aarch64": 183}
#: The compiler of another kind of computer, as Debian calls it: apt install gcc-aarch64-linux-gnu.
COMPILERS = {"aarch64": "aarch64-linux-gnu-gcc"}
#: Pythons that the appliance runs with; `requires-python` of pyproject.toml is the least.
_VERSIONS = ("3.10", "3.11", "3.12", "3.13", "3.14")

#: All that differs between the pyconfig.h of x86-64 and of arm64, and concerns a compiler. pyenv
#: has one pyconfig.h; in Debian it includes that of the computer, by the path that this file has.
_FOR_ARM64 = """\
#include "{native}"
#undef HAVE_GCC_ASM_FOR_X64
#undef HAVE_GCC_ASM_FOR_X87
"""

#: What a Python says of itself. In Debian its pyconfig.h is another for each kind of computer.
_ASK = """
import json, pathlib, sys, sysconfig
name = f"python{sys.version_info[0]}.{sys.version_info[1]}"
folder = f"{sysconfig.get_config_var('MULTIARCH')}/{name}"
header = pathlib.Path(sysconfig.get_path("include"), "pyconfig.h")
text = header.read_text() if header.exists() else ""
if f"<{folder}/" in text:
    header = pathlib.Path("/usr/include", folder, "pyconfig.h")
found = str(header) if header.exists() else ""
suffix = sysconfig.get_config_var("EXT_SUFFIX")
print(json.dumps([name, sys.executable, found, suffix, sys.implementation.name]))
"""


class WheelError(Exception):
    """A wheel cannot be built, or is not what was asked for; the message says why."""


@dataclass(frozen=True)
class Python:
    """One that machine code is made for, such as `python3.11`; `header` is its pyconfig.h."""

    name: str
    executable: Path
    header: Path
    suffix: str

    @classmethod
    def at(cls, command: str | Path) -> Python:
        """Raises WheelError if the appliance does not run with it, or nothing compiles for it."""
        try:
            told = subprocess.run(
                [command, "-c", _ASK], capture_output=True, text=True, timeout=60, check=False
            )
            name, executable, header, suffix, kind = json.loads(told.stdout)
        except (OSError, subprocess.SubprocessError) as error:
            raise WheelError(f"{command} is no Python that runs ({error})") from None
        except ValueError:
            reason = (told.stderr.strip() or f"it ended with {told.returncode}").splitlines()[0]
            raise WheelError(f"{command} is no Python that runs ({reason})") from None
        if kind != "cpython" or name.removeprefix("python") not in _VERSIONS:
            least, most = _VERSIONS[0], _VERSIONS[-1]
            raise WheelError(f"{command} is {kind}'s {name}; it takes CPython {least} to {most}")
        if not header:
            raise WheelError(f"{command} lacks its headers: apt install {name}-dev")
        return cls(name, Path(executable), Path(header), suffix)


def pythons_here() -> list[Python]:
    """One of each version: this one, those in PATH, and those of pyenv."""
    found: dict[str, Python] = {}
    root = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    of_pyenv = sorted(root.glob("versions/3.*/bin/python3"), reverse=True)
    in_path = [f"python{each}" for each in _VERSIONS]
    for command in [sys.executable, *in_path, *map(str, of_pyenv)]:
        try:
            python = Python.at(command)
        except WheelError:
            continue  # not installed, or a shim of one that is not
        found.setdefault(python.name, python)
    return [found[name] for name in sorted(found, key=lambda name: int(name.partition(".")[2]))]


def check_compiler(machine: str) -> None:
    """Raises WheelError unless there is a compiler for it, with the headers of its C library."""
    if machine == os.uname().machine:
        compiler, package, library = "cc", "gcc", "libc6-dev"
    else:
        compiler, package = COMPILERS.get(machine, ""), f"gcc-{machine}-linux-gnu"
        library = f"libc6-dev-{emulation.ARCHITECTURES[machine]}-cross"
    if not compiler or not shutil.which(compiler):
        raise WheelError(f"there is no compiler for {machine} here: apt install {package}")
    command = [compiler, "-E", "-"]
    source = b"#include <limits.h>\n"
    if subprocess.run(command, input=source, capture_output=True, check=False).returncode:
        raise WheelError(f"{compiler} does not find the C library's headers: apt install {library}")


def unpack(sdist: Path, directory: Path) -> Path:
    """The folder of the sources, which is for one build: it leaves files behind for the next."""
    with tarfile.open(sdist) as archive:
        # Python 3.11.2, Debian 12's, has no filters; the archive is our own.
        archive.extraction_filter = getattr(tarfile, "data_filter", lambda member, _: member)
        archive.extractall(directory)
    (source,) = directory.iterdir()
    return source


def environment(python: Python, machine: str, directory: Path) -> dict[str, str]:
    """The variables for machine code; those for another kind of computer need a folder."""
    variables = {"APPLIANCE_COMPILE": "1"}
    native = os.uname().machine
    if machine == native:
        return variables
    folder = f"{machine}-linux-gnu/{python.name}"
    header = directory / folder / "pyconfig.h"
    header.parent.mkdir(parents=True)
    header.write_text(_FOR_ARM64.format(native=python.header))
    # Told to setuptools alone: pip has to fetch what compiles for this computer.
    settings = directory / "setup.cfg"
    settings.write_text(f"[bdist_wheel]\nplat_name = linux_{machine}\n")
    compiler = COMPILERS[machine]
    return {
        **variables,
        "CC": compiler,
        "LDSHARED": f"{compiler} -shared",
        "CFLAGS": f"-I{directory} -include {header}",
        "SETUPTOOLS_EXT_SUFFIX": python.suffix.replace(native, machine),
        "DIST_EXTRA_CONFIG": f"{settings}",
    }


def faults(wheel: Path, machine: str) -> Iterator[str]:
    """What a wheel with machine code lacks of it; nothing is wrong where there is nothing."""
    with zipfile.ZipFile(wheel) as archive:
        libraries = [name for name in archive.namelist() if name.endswith(".so")]
        heads = {name: archive.read(name)[:20] for name in libraries}
        modules = {*archive.namelist()}
    if not any("/broker/" in name for name in libraries):
        yield f"{wheel.name} has no machine code of the broker"
    for name, head in heads.items():
        if head[:4] != b"\x7fELF" or int.from_bytes(head[18:20], "little") != _MACHINES[machine]:
            yield f"{wheel.name}: {name} is not for {machine}"
        pure = re.sub(r"\.[^/]*$", ".py", name)
        if "__mypyc" not in name and pure not in modules:
            yield f"{wheel.name}: {pure} is missing, the fallback of {name}"


#: Runs a command in a folder with these variables, and raises if it fails.
Run = Callable[..., str]


def build_pure(sdist: Path, work: Path, out: Path, run: Run) -> Path:
    """The wheel for every Python and computer, in `out`."""
    wheel = _build(Path(sys.executable), {}, sdist, work, run)
    return wheel.replace(out / wheel.name)


def build_compiled(
    python: Python, machine: str, sdist: Path, work: Path, out: Path, run: Run
) -> Path:
    """A wheel with machine code, in `out`. Raises WheelError if it is not what it ought to be."""
    headers = Path(tempfile.mkdtemp(prefix="headers-", dir=work))
    variables = environment(python, machine, headers)
    wheel = _build(python.executable, variables, sdist, work, run)
    if found := list(faults(wheel, machine)):
        raise WheelError("\n".join(found))
    repaired = Path(tempfile.mkdtemp(prefix="repaired-", dir=work))
    run(sys.executable, "-m", "auditwheel", "repair", "-w", repaired, wheel, cwd=work)
    (wheel,) = repaired.glob("*.whl")
    if "manylinux" not in wheel.name:
        raise WheelError(f"{wheel.name} has no tag of manylinux: no index would take it")
    return wheel.replace(out / wheel.name)


def _build(executable: Path, variables: dict[str, str], sdist: Path, work: Path, run: Run) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="wheel-", dir=work))
    source = unpack(sdist, folder / "source")
    # Of a build's own environment too, to which `-c` does not apply.
    variables = {**variables, "PIP_CONSTRAINT": str(source / "constraints.txt")}
    # By a Python that has nothing installed: the build has to ask for what it needs.
    run(executable, "-m", "venv", folder / "venv", cwd=folder)
    pip = (folder / "venv/bin/python", "-m", "pip", "wheel", "--disable-pip-version-check")
    run(*pip, "--no-deps", "--use-pep517", "-w", folder, source, cwd=folder, **variables)
    (wheel,) = folder.glob("*.whl")
    return wheel
