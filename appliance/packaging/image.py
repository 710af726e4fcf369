"""Builds the image of a container, as a file for a release: `gunzip --stdout FILE | docker load`.

The Dockerfile is the one that users have. What it installs is a wheel of the release with machine
code; nothing is pulled: its base is a Debian made by mmdebstrap, and pip's packages are fetched
before, as wheels, by this computer's pip. For another kind of computer its programs are emulated.
"""

from __future__ import annotations

import gzip
import shutil
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from appliance.packaging import emulation
from appliance.packaging.wheels import Run

#: The base, and its Python.
SUITE = "bookworm"
PYTHON = "3.11"
#: What `docker images` calls it.
NAME = "ros-mqtt-appliance"
#: There are wheels of ROS 2 for x86-64 alone.
EXTRAS = {"x86_64": "ros,camera,plugins", "aarch64": "camera,plugins"}
#: glibc of the base is 2.36; pip takes a wheel by the names of all that it runs with.
PLATFORMS = ("manylinux2014", "manylinux_2_17", "manylinux_2_28", "manylinux_2_34", "linux")
#: Packages for every computer of which PyPI has only the sources: wheels are made of them here.
SOURCES = ("empy",)
#: The commands that this needs, and the packages of Debian which have them.
TOOLS = {"mmdebstrap": "mmdebstrap", "buildah": "buildah"}
_DOCKERFILE = "appliance/packaging/container/Dockerfile"
#: Of the packages in the base, these paths are of no use in a container.
_LEFT_OUT = ("doc", "man", "locale")
_PIP = "[global]\nno-index = true\nfind-links = /wheels\n"


class ImageError(Exception):
    """The image cannot be built; the message says why, and what to do."""


def check(pythons: Iterable[str]) -> None:
    """Raises ImageError if tools are missing, or if there is to be no wheel for its Python."""
    if missing := [package for tool, package in TOOLS.items() if not shutil.which(tool)]:
        raise ImageError(f"install what this needs: apt install {' '.join(missing)}")
    if f"python{PYTHON}" not in pythons:
        raise ImageError(
            f"the image needs a wheel for Python {PYTHON}, which Debian's {SUITE} has: install it "
            f"with its headers, or name it: --python python{PYTHON}"
        )


def fetch(what: Sequence[str], constraints: Path, folder: Path, machine: str, run: Run) -> None:
    """Fetch these packages, and all that they need, for the base's Python on that computer."""
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    run(*pip, "wheel", "-q", "--no-deps", "-c", constraints, "-w", folder, *SOURCES, cwd=folder)
    run(
        *(*pip, "download", "-q", "--only-binary=:all:", "--implementation=cp"),
        *(f"--platform={each}_{machine}" for each in PLATFORMS),
        *(f"--python-version={PYTHON}", "-c", constraints, "-f", folder, "-d", folder, *what),
        cwd=folder,
    )


class Image:
    """One that is built in a folder of its own; `run` is told what to run there."""

    def __init__(self, machine: str, version: str, folder: Path, run: Run) -> None:
        self._machine = machine
        self._name = f"localhost/{NAME}:{version}"
        self._folder = folder
        self._run = run
        folder.mkdir()
        for name in ("storage", "state", "scratch", "wheels", "context"):
            (folder / name).mkdir()

    def build(self, wheel: Path, source: Path) -> None:
        """Build it of that wheel, which is for Python 3.11, with the project's Dockerfile."""
        fetch(
            [f"{wheel}[{EXTRAS[self._machine]}]"],
            source / "constraints.txt",
            self._folder / "wheels",
            self._machine,
            self._run,
        )
        context = self._folder / "context"
        base = context / "base.tar"
        self._within(
            # Device nodes cannot be unpacked in a user namespace, and containers get their own.
            *("mmdebstrap", "--quiet", "--variant=minbase", "--skip=check/qemu,output/dev"),
            *(f"--dpkgopt=path-exclude=/usr/share/{each}/*" for each in _LEFT_OUT),
            f"--architectures={emulation.ARCHITECTURES[self._machine]}",
            *("--include=python3,python3-venv", SUITE, base),
        )
        (context / "Dockerfile").write_text(f"FROM scratch\nADD {base.name} /\n")
        self._bud("localhost/base", context)
        base.unlink()
        pip = self._folder / "pip.conf"
        pip.write_text(_PIP)
        given = {
            "BASE": "localhost/base",
            "EXTRAS": EXTRAS[self._machine],
            "WHEEL": f"/wheels/{wheel.name}",
        }
        moment = self._run("git", "-C", source, "log", "-1", "--format=%ct", cwd=source).strip()
        self._bud(
            *(self._name, source, "--file", source / _DOCKERFILE, f"--timestamp={moment}"),
            *(f"--volume={self._folder}/wheels:/wheels:ro", f"--volume={pip}:/etc/pip.conf:ro"),
            *(f"--build-arg={name}={text}" for name, text in given.items()),
        )

    def save(self, file: Path) -> Path:
        """Write it to that file, compressed."""
        archive = self._folder / "image.tar"
        short = self._name.removeprefix("localhost/")
        self._buildah("push", "--quiet", self._name, f"docker-archive:{archive}:{short}")
        # Without the time and the name, so that the same image gives the same file.
        with (
            archive.open("rb") as raw,
            file.open("wb") as packed,
            gzip.GzipFile("", "wb", 6, packed, mtime=0) as target,
        ):
            shutil.copyfileobj(raw, target, 1 << 20)
        archive.unlink()
        return file

    def container(self) -> list[str | Path]:
        """What to put before a command to run it in a container of this image."""
        name = self._buildah("from", self._name).split()[-1]
        return [*self._prefix(), *self._words("run", "--isolation", "chroot", name, "--")]

    # --- how -----------------------------------------------------------------------------------
    def _bud(self, tag: str, context: Path, *options: str | Path) -> None:
        kind = ("--isolation", "chroot", "--format", "docker")
        self._buildah("bud", *kind, "--tag", tag, *options, context)

    def _buildah(self, *words: str | Path) -> str:
        return self._within(*self._words(*words))

    def _words(self, *words: str | Path) -> list[str | Path]:
        places = ("--root", self._folder / "storage", "--runroot", self._folder / "state")
        scratch = f"TMPDIR={self._folder / 'scratch'}"
        return ["env", scratch, "buildah", "--storage-driver", "vfs", *places, *words]

    def _within(self, *words: str | Path) -> str:
        return self._run(*self._prefix(), *words, cwd=self._folder)

    def _prefix(self) -> list[str]:
        """What is mounted is in a namespace of its own, and gone with it."""
        own = ["unshare", "--mount", "--propagation", "private", "--pid", "--kill-child"]
        return emulation.prefix(self._machine) or [*own, "--mount-proc"]
