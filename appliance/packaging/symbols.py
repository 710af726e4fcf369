"""What a released executable asks of the computer that it is to run on.

`python -m appliance.packaging.symbols dist/appliance dist/appliance_0.1.0_amd64.deb` examines the
executable and every library in it, and fails where one would not load: it needs a symbol of a later
glibc than `FLOOR`, or a library that is neither in the file nor a part of glibc.
"""

from __future__ import annotations

import argparse
import io
import re
import struct
import subprocess
import sys
import tarfile
import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from elftools.common.exceptions import ELFError
from elftools.construct import ConstructError
from elftools.elf.dynamic import DynamicSection
from elftools.elf.elffile import ELFFile
from elftools.elf.gnuversions import GNUVerNeedSection, GNUVerSymSection

Version = tuple[int, ...]

#: The glibc of Debian 11. Ubuntu 20.04 has it too, and every later system a later one.
FLOOR: Version = (2, 31)

_ELF = b"\x7fELF"
#: The section of the boot loader that PyInstaller puts everything else into.
_ARCHIVE = "pydata"
_NUMBERED = re.compile(r"GLIBC_(\d+(?:\.\d+)+)")
#: What glibc consists of, as far as programs ask for it by name.
_OF_GLIBC = re.compile(r"(lib(c|m|mvec|dl|pthread|rt|util|resolv)|ld-linux[\w-]*)\.so\.\d+")


class UnreadableError(Exception):
    """A file that is not what its name or its first bytes say; the message names it."""


@dataclass
class Needs:
    """What one executable or library asks for when it is loaded."""

    #: Versions of glibc's symbols, each with the symbols: `GLIBC_2.17` to `{"clock_gettime"}`.
    versions: dict[str, set[str]] = field(default_factory=dict)
    #: The libraries by their names, such as `libz.so.1`.
    libraries: set[str] = field(default_factory=set)


@dataclass
class Examined:
    """An executable or a package: what it and each library in it asks for, by their paths."""

    needs: dict[str, Needs]

    def faults(self, floor: Version = FLOOR) -> Iterator[str]:
        """What would not load on a computer that has this glibc and nothing else."""
        inside = {Path(name.rpartition(": ")[2]).name for name in self.needs}
        for name, each in self.needs.items():
            for version, symbols in sorted(each.versions.items()):
                number = _number(version)
                if number is None or number > floor:
                    examples = f" ({', '.join(sorted(symbols)[:3])})" if symbols else ""
                    yield f"{name} needs {version}{examples}, which glibc {_text(floor)} has not"
            for library in sorted(each.libraries - inside):
                if not _OF_GLIBC.fullmatch(library):
                    yield f"{name} needs {library}, which is neither beside it nor a part of glibc"

    def least_glibc(self) -> str:
        """The oldest glibc that all of it loads with, such as `2.31`."""
        versions = {version for each in self.needs.values() for version in each.versions}
        return _text(max(filter(None, map(_number, versions)), default=(2, 0)))


def examine(path: Path) -> Examined:
    """Read an executable, or a Debian package with one in it. Raises OSError, UnreadableError."""
    found = _in_package(path) if path.suffix == ".deb" else _in_executable(path, path.name)
    if not found:
        raise UnreadableError(f"{path} has no executable in it")
    return Examined(found)


def _in_package(path: Path) -> dict[str, Needs]:
    unpacked = subprocess.run(["dpkg-deb", "--fsys-tarfile", path], capture_output=True)
    if unpacked.returncode:
        raise UnreadableError(f"{path} is no Debian package: {unpacked.stderr.decode().strip()}")
    found: dict[str, Needs] = {}
    with (
        tarfile.open(fileobj=io.BytesIO(unpacked.stdout)) as archive,
        tempfile.NamedTemporaryFile() as executable,
    ):
        for member in archive:
            file = archive.extractfile(member) if member.isfile() else None
            content = file.read() if file else b""
            if content.startswith(_ELF):
                Path(executable.name).write_bytes(content)
                found |= _in_executable(Path(executable.name), f"{path.name}: {member.name}")
    return found


def _in_executable(path: Path, name: str) -> dict[str, Needs]:
    content = path.read_bytes()
    if not content.startswith(_ELF):
        raise UnreadableError(f"{path} is neither an executable nor a Debian package")
    found = {name: _needs(name, content)}
    if ELFFile(io.BytesIO(content)).get_section_by_name(_ARCHIVE):
        for inner, library in _unpacked(path, name):
            if library.startswith(_ELF):
                found[f"{name}: {inner}"] = _needs(f"{name}: {inner}", library)
    return found


def _unpacked(path: Path, name: str) -> Iterator[tuple[str, bytes]]:
    from PyInstaller.archive.readers import ArchiveReadError, CArchiveReader

    try:
        archive = CArchiveReader(str(path))
        for inner, (*_, kind) in archive.toc.items():
            if kind in "bx":  # libraries, and data, among which a library can be
                yield inner, archive.extract(inner)
    except (ArchiveReadError, OSError, ValueError, struct.error, zlib.error) as error:
        raise UnreadableError(f"what PyInstaller has put into {name} is broken: {error}") from None


def _needs(name: str, content: bytes) -> Needs:
    try:
        return _read(ELFFile(io.BytesIO(content)))
    # pyelftools raises what comes of what it reads.
    except (ELFError, ConstructError, AttributeError, LookupError, TypeError, ValueError) as error:
        why = f"{type(error).__name__} {error}".strip()
        raise UnreadableError(
            f"{name} begins as an executable and cannot be read as one ({why}); is it cut off?"
        ) from None


def _read(elf: ELFFile) -> Needs:
    if elf.get_section(elf.get_shstrndx())["sh_type"] != "SHT_STRTAB":
        raise ELFError("its sections have no names")  # and nothing would be found in them
    found = Needs()
    names: dict[int, str] = {}  # of the versions, by the index that symbols have
    for section in elf.iter_sections():
        if isinstance(section, GNUVerNeedSection):
            for _, versions in section.iter_versions():
                for version in versions:
                    if version.name.startswith("GLIBC_"):
                        names[version["vna_other"]] = version.name
                        found.versions[version.name] = set()
        elif isinstance(section, DynamicSection):
            found.libraries |= {vars(tag)["needed"] for tag in section.iter_tags("DT_NEEDED")}
    for section in elf.iter_sections():
        if isinstance(section, GNUVerSymSection):
            for symbol in section.iter_symbols():
                if symbol["ndx"] in names:
                    found.versions[names[symbol["ndx"]]].add(symbol.name)
    return found


def _number(version: str) -> Version | None:
    """2.17 of `GLIBC_2.17`. None for what has no number: `GLIBC_PRIVATE`, `GLIBC_ABI_DT_RELR`."""
    numbered = _NUMBERED.fullmatch(version)
    return tuple(map(int, numbered[1].split("."))) if numbered else None


def _text(version: Version) -> str:
    return ".".join(map(str, version))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("files", type=Path, nargs="+", help="executables and Debian packages")
    failed = False
    for path in parser.parse_args().files:
        try:
            examined = examine(path)
        except (OSError, UnreadableError) as error:
            parser.error(str(error))
        faults = list(examined.faults())
        failed |= bool(faults)
        print(*faults, sep="\n", end="\n" * bool(faults), file=sys.stderr)
        print(
            f"{path}: {len(examined.needs)} executables and libraries, "
            f"glibc {examined.least_glibc()} or later, {len(faults)} faults"
        )
    return failed


if __name__ == "__main__":
    sys.exit(main())
