"""What is said of an environment of another computer, or of another Python, in place of a
traceback."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import pytest
from pages import PROJECT

from appliance.host.libraries import MACHINES, explain, machine_of

OURS = machine_of(Path(sys.executable))
OTHER = "arm64" if OURS == "x86-64" else "x86-64"
SUFFIX = EXTENSION_SUFFIXES[0]
PYTHON = f"{sys.version_info[0]}.{sys.version_info[1]}"
OTHER_PYTHON = SUFFIX.replace(f"cpython-{PYTHON.replace('.', '')}", "cpython-399")
OTHER_COMPUTER = SUFFIX.replace("x86_64", "riscv64").replace("aarch64", "riscv64")


def header(machine: str | None) -> bytes:
    """The beginning of a library for 64 bits, little endian."""
    number = next(number for number, name in MACHINES.items() if name == machine)
    return b"\x7fELF\2\1\1".ljust(16, b"\0") + b"\3\0" + number.to_bytes(2, "little")


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """`python -m appliance` with a folder of libraries before all others."""
    return subprocess.run(
        [sys.executable, "-m", "appliance", *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(PROJECT)])},
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        (f"_pydantic_core{SUFFIX}", header(OTHER), f"is compiled for {OTHER}, and"),
        (f"_pydantic_core{OTHER_COMPUTER}", header("RISC-V"), "is compiled for RISC-V, and"),
        (f"_pydantic_core{OTHER_PYTHON}", header(OURS), "is compiled for Python 3.99, and this is"),
        (f"_pydantic_core{SUFFIX}", b"", "is damaged"),
        (f"_pydantic_core{SUFFIX}", b"<html>not found</html>" * 99, "is damaged"),
        (f"_pydantic_core{SUFFIX}", header(OURS), "file too short"),
    ],
    ids=["machine", "named", "python", "empty", "page", "cut off"],
)
def test_a_library_that_cannot_be_loaded(
    tmp_path: Path, name: str, content: bytes, said: str
) -> None:
    package = tmp_path / "pydantic_core"
    package.mkdir()
    (package / "__init__.py").write_text("from pydantic_core._pydantic_core import __version__\n")
    (package / name).write_bytes(content)
    done = run(tmp_path, "init", "--dir", str(tmp_path / "house"))
    assert done.returncode == 1
    assert done.stderr.startswith("appliance: ")
    assert f"{package / name}" in done.stderr
    assert said in done.stderr
    assert "python3 -m venv ~/appliance-venv && ~/appliance-venv/bin/pip install ." in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "house").exists()


def test_a_package_that_is_not_installed() -> None:
    done = subprocess.run(
        [sys.executable, "-S", "-m", "appliance", "--version"],  # without its site-packages
        cwd=PROJECT,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1
    assert f"the package typer is not installed for {sys.executable}" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_package_for_several_pythons_is_not_blamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "several"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / f"fast{SUFFIX}").write_bytes(header(OURS))
    (package / f"fast{OTHER_PYTHON}").write_bytes(header(OURS))
    monkeypatch.syspath_prepend(tmp_path)
    assert explain(ModuleNotFoundError("no", name="several.other")) is None
    (package / f"fast{SUFFIX}").unlink()
    assert "is compiled for Python 3.99" in str(
        explain(ModuleNotFoundError("no", name="several.fast"))
    )


def test_other_errors_keep_their_traceback() -> None:
    for error in (
        ImportError("cannot import name 'absent' from 'appliance'", name="appliance"),
        ModuleNotFoundError("No module named 'appliance.absent'", name="appliance.absent"),
        ImportError("a plugin says no"),
    ):
        assert explain(error) is None


@pytest.mark.parametrize(
    ("content", "machine"),
    [
        (header("arm64"), "arm64"),
        (
            b"\x7fELF\2\2\1".ljust(18, b"\0") + b"\0\x15",
            "another kind of computer (ELF machine 21)",
        ),
        (header("arm64")[:-1], None),
        (b"#!/bin/sh\n" * 9, None),
    ],
)
def test_the_kind_of_computer_of_a_file(
    tmp_path: Path, content: bytes, machine: str | None
) -> None:
    file = tmp_path / "file"
    file.write_bytes(content)
    assert machine_of(file) == machine
    assert machine_of(tmp_path) is None
    assert machine_of(tmp_path / "absent") is None


def test_a_python_that_is_too_old() -> None:
    """As Python 3.9 would run it; that it can read it is asked of its grammar."""
    source = (PROJECT / "appliance/__init__.py").read_text()
    ast.parse(source, feature_version=(3, 4))
    program = f"import sys; sys.version_info = (3, 9, 2); exec({source!r})"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 1
    assert "needs Python 3.10 or later" in done.stderr
    assert "is Python 3.9. Use a newer one" in done.stderr
    assert "Traceback" not in done.stderr
