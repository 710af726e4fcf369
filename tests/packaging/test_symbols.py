"""What a released executable needs is read out of it: of libraries that are made here for that."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("PyInstaller")
from PyInstaller.archive.writers import CArchiveWriter

from appliance.packaging.symbols import FLOOR, UnreadableError, examine

Library = Callable[..., Path]


@pytest.fixture
def library(tmp_path: Path) -> Library:
    """Makes a library that needs a symbol of that version of a C library made up for it."""
    if not (shutil.which("cc") and shutil.which("objcopy")):
        pytest.skip("needs a C compiler and binutils: apt install gcc libc6-dev binutils")

    def make(name: str, version: str = "GLIBC_2.31", of: str = "libc.so.6") -> Path:
        (tmp_path / "of.c").write_text("int later(void) { return 1; }\n")
        (tmp_path / "of.map").write_text(f"{version} {{ later; }};\n")
        (tmp_path / "uses.c").write_text("int later(void); int uses(void) { return later(); }\n")
        shared = ("cc", "-shared", "-fPIC", "-nostdlib", "-o")
        versions = ("-Wl,--version-script=of.map", f"-Wl,-soname,{of}")
        for command in (
            [*shared, "of.so", "of.c", *versions],
            [*shared, name, "uses.c", "of.so", f"-Wl,-soname,{name}"],
        ):
            subprocess.run(command, cwd=tmp_path, check=True)
        return tmp_path / name

    return make


def one_file(directory: Path, *libraries: Path) -> Path:
    """As PyInstaller makes it: a program, and in a section of it the libraries."""
    archive, program = directory / "archive", directory / "appliance"
    entries = [(each.name, str(each), True, "b") for each in libraries]
    CArchiveWriter(str(archive), entries, "libpython3.11.so.1.0")
    shutil.copy(examined_program(directory), program)
    subprocess.run(["objcopy", "--add-section", f"pydata={archive}", program], check=True)
    return program


def examined_program(directory: Path) -> Path:
    """An executable that needs no library, so that nothing is found in it."""
    (directory / "main.c").write_text("int main(void) { return 0; }\n")
    program = directory / "main"
    subprocess.run(["cc", "-static", "-o", program, directory / "main.c"], check=True)
    return program


def package(directory: Path, *files: Path) -> Path:
    root = directory / "raw"
    (root / "DEBIAN").mkdir(parents=True)
    (root / "DEBIAN/control").write_text(
        "Package: appliance\nVersion: 1\nArchitecture: all\nMaintainer: m <m@localhost>\n"
        "Description: for a test\n"
    )
    (root / "usr/bin").mkdir(parents=True)
    for file in files:
        shutil.copy(file, root / "usr/bin")
    made = directory / "appliance_1_all.deb"
    subprocess.run(["dpkg-deb", "-Znone", "--build", root, made], check=True, capture_output=True)
    return made


def test_what_the_floor_has_is_no_fault(library: Library) -> None:
    examined = examine(library("libours.so.1", "GLIBC_2.31"))
    assert list(examined.faults()) == []
    assert examined.least_glibc() == "2.31"


@pytest.mark.parametrize("version", ["GLIBC_2.32", "GLIBC_2.100", "GLIBC_2.31.1", "GLIBC_3.0"])
def test_a_symbol_of_a_later_glibc(library: Library, version: str) -> None:
    examined = examine(library("libours.so.1", version))
    (fault,) = examined.faults()
    assert fault == f"libours.so.1 needs {version} (later), which glibc 2.31 has not"
    assert list(examined.faults(floor=(9,))) == []
    assert examined.least_glibc() == version.removeprefix("GLIBC_")


@pytest.mark.parametrize("version", ["GLIBC_PRIVATE", "GLIBC_ABI_DT_RELR"])
def test_what_is_of_one_glibc_only_or_has_no_number(library: Library, version: str) -> None:
    (fault,) = examine(library("libours.so.1", version)).faults(floor=(9,))
    assert version in fault


def test_a_library_that_is_not_there(library: Library, tmp_path: Path) -> None:
    ours, other = library("libours.so.1", "OTHER_9", "libother.so.2"), library("libother.so.2")
    (fault,) = examine(ours).faults()
    assert "libours.so.1 needs libother.so.2, which is neither beside it" in fault
    assert list(examine(one_file(tmp_path, ours, other)).faults()) == []


def test_libraries_within_the_one_file_and_its_package(library: Library, tmp_path: Path) -> None:
    harmless, late = library("libgood.so.1"), library("liblate.so.1", "GLIBC_2.36")
    made = one_file(tmp_path, harmless, late)
    (fault,) = examine(made).faults()
    assert fault.startswith("appliance: liblate.so.1 needs GLIBC_2.36 (later)")
    (fault,) = examine(package(tmp_path, made)).faults()
    assert "usr/bin/appliance: liblate.so.1 needs GLIBC_2.36 (later)" in fault


def test_what_is_cut_off(library: Library, tmp_path: Path) -> None:
    made = one_file(tmp_path, library("libours.so.1"))
    whole = made.read_bytes()
    archive = (tmp_path / "archive").read_bytes()
    parts = [whole[: len(whole) * part // 100] for part in range(1, 100)]
    broken = [part + bytes(len(whole) - len(part)) for part in parts[::10]]
    broken.append(whole.replace(archive, bytes(len(archive))))
    broken.append(whole.replace(archive[:20], bytes(20)))
    for content in parts + broken:
        made.write_bytes(content)
        with pytest.raises(UnreadableError, match=r"appliance"):
            examine(made)


def test_what_is_neither_executable_nor_package(tmp_path: Path) -> None:
    for name, content in {
        "script": b"#!/bin/sh\n",
        "empty": b"",
        "wrong.deb": b"!<arch>\n",
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UnreadableError, match=name):
            examine(tmp_path / name)
    script = tmp_path / "script"
    with pytest.raises(UnreadableError, match="has no executable in it"):
        examine(package(tmp_path, script))


def test_the_command(library: Library, tmp_path: Path) -> None:
    def told(*files: Path) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "appliance.packaging.symbols", *files]
        return subprocess.run(command, capture_output=True, text=True)

    good, late = library("libgood.so.1"), library("liblate.so.1", "GLIBC_2.36")
    fine = told(good)
    assert (fine.returncode, fine.stderr) == (0, "")
    assert fine.stdout == f"{good}: 1 executables and libraries, glibc 2.31 or later, 0 faults\n"
    failed = told(late, good)
    assert failed.returncode == 1
    assert failed.stderr == "liblate.so.1 needs GLIBC_2.36 (later), which glibc 2.31 has not\n"
    absent = told(tmp_path / "absent")
    assert absent.returncode == 2 and "absent" in absent.stderr


def test_the_floor_is_that_of_debian_11() -> None:
    assert FLOOR == (2, 31)
