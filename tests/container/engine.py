"""buildah and podman, with all that they keep, mount and start inside a folder and namespaces.

They run in namespaces of mounts, processes and, for containers, the network. One process holds
these, and they end with it: what a killed test leaves behind is a temporary folder, nothing else.
Nothing is pulled: the base of images is a Debian made by mmdebstrap, and Python's packages come out
of a folder that the tests' own pip has filled.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
from waiting import eventually

from appliance.packaging import image

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROJECT = Path(__file__).parents[2]
DOCKERFILE = PROJECT / "appliance/packaging/container/Dockerfile"

#: Debian's packages with these programs.
PROGRAMS = ("buildah", "podman", "runc", "mmdebstrap", "ip", "mosquitto_pub")
PACKAGES = "buildah podman runc mmdebstrap iproute2 mosquitto-clients"

BASE = "localhost/base"

#: What the base has, so that building an image installs little on top.
_IN_BASE = "python3,python3-venv,ca-certificates,tini"

#: Run in the new namespaces: private places for what podman keeps outside of its storage, a network
#: like a host's, and an end when the process that holds the other side of the pipe ends.
_HOLD = """
set -e
mkdir -p /var/lib/containers
mount --bind "$0" /var/lib/containers
mount -t tmpfs tmpfs /run
mount -t tmpfs tmpfs /dev/shm
ip link set lo up
ip link add network type veth peer name cable
ip address add 192.0.2.1/24 dev network
ip link set network up
ip link set cable up
echo ready
exec cat
"""

#: Prints "no" where overlays cannot be mounted.
_OVERLAY = """
cd "$0" && mkdir lower upper work merged
mount -t overlay -o lowerdir=lower,upperdir=upper,workdir=work overlay merged 2>&1 || echo no
"""

#: Of the containers, who may raise no limits here.
_LIMITS = ("--ulimit", "nofile=1024:1024", "--ulimit", "nproc=4096:4096")


def obstacle() -> str:
    """Why no container runs here; empty when one does."""
    missing = [program for program in PROGRAMS if shutil.which(program) is None]
    if missing:
        return f"needs {', '.join(missing)}: apt install {PACKAGES}"
    return "" if os.geteuid() == 0 else "needs root, for namespaces and mounts"


class FailedError(AssertionError):
    """A program ended with another exit code than was wanted; the text has its output."""


def run(command: Sequence[str | Path], *, code: int | None = 0, timeout: float = 300) -> str:
    """Its output, of both streams. Raises FailedError for another exit code; None allows any."""
    done = subprocess.run(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        timeout=timeout,
    )
    if code is not None and done.returncode != code:
        words = " ".join(map(str, command))
        raise FailedError(f"{words}\nended with {done.returncode}:\n{done.stdout}")
    return done.stdout


class Engine:
    """Images and containers; `engine` makes one and removes it."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._storage = directory / "storage"
        self._wheels = directory / "wheels"
        self._scratch = directory / "scratch"
        self._driver = "vfs"
        self._holder: subprocess.Popen[str] | None = None
        self._inside: psutil.Process | None = None

    def start(self) -> None:
        """Make the namespaces."""
        for folder in (self._storage, self._wheels, self._scratch):
            folder.mkdir()
        (self.directory / "pip.conf").write_text(
            "[global]\nno-index = true\nfind-links = /wheels\n"
        )
        self._holder = subprocess.Popen(
            [
                *("unshare", "--mount", "--propagation", "private", "--net"),
                *("--pid", "--fork", "--kill-child", "--mount-proc"),
                *("sh", "-c", _HOLD, self._storage),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._holder.stdout is not None
        if self._holder.stdout.readline() != "ready\n":
            raise FailedError("namespaces of their own cannot be made")
        (self._inside,) = psutil.Process(self._holder.pid).children()
        # Without overlays each layer and container is a copy, which takes its time.
        if "no" not in run(self.command("sh", "-c", _OVERLAY, self._scratch)):
            self._driver = "overlay"

    def close(self) -> None:
        """End everything, and remove the folder unless something is still mounted in it."""
        if self._holder is not None:
            try:
                if self._inside is not None:
                    self.podman("rm", "--all", "--force", "--time", "0")
            finally:
                self._holder.kill()  # and with it process 1 in there, which takes all others along
                self._holder.communicate()
                if self._inside is not None:
                    self._inside.wait(60)
        mounts = Path("/proc/self/mountinfo").read_text().splitlines()
        inside = [line for line in mounts if f" {self.directory}/" in line]
        if inside:
            raise FailedError(f"{self.directory} is left, as this is mounted in it: {inside}")
        shutil.rmtree(self.directory)

    def command(self, *words: str | Path, network: bool = True) -> list[str]:
        """The command line that runs it where the containers are, in their network by default."""
        kinds = ["--mount", "--pid", *(["--net"] if network else [])]
        assert self._inside is not None
        words = ("env", f"TMPDIR={self._scratch}", *words)
        return ["nsenter", "--target", f"{self._inside.pid}", *kinds, "--", *map(str, words)]

    def podman(self, *words: str | Path, code: int | None = 0) -> str:
        options = ("--storage-driver", self._driver, "--runtime", "runc", "--log-level", "fatal")
        return run(self.command("podman", *options, *words), code=code)

    def _buildah(self, *words: str | Path) -> str:
        options = ("--storage-driver", self._driver, "bud", "--isolation", "chroot")
        return run(self.command("buildah", *options, *words, network=False), timeout=1800)

    # --- images --------------------------------------------------------------------------------

    def prepare(self, extras: Sequence[str] = (), more: Sequence[str] = ()) -> None:
        """Make the base, and download what the appliance with these extras, and `more`, need."""
        context = self.directory / "base"
        context.mkdir()
        making = subprocess.Popen(
            [
                *("mmdebstrap", "--quiet", "--variant=minbase", f"--include={_IN_BASE}"),
                *(
                    "--dpkgopt=path-exclude=/usr/share/doc/*",
                    "--dpkgopt=path-exclude=/usr/share/man/*",
                ),
                *("--dpkgopt=path-exclude=/usr/share/locale/*", image.SUITE, context / "base.tar"),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        try:
            self._download(extras, more)
        finally:
            output, _ = making.communicate()
        if making.returncode:
            raise FailedError(f"mmdebstrap ended with {making.returncode}:\n{output}")
        (context / "Dockerfile").write_text("FROM scratch\nADD base.tar /\n")
        self._buildah("--tag", BASE, context)
        shutil.rmtree(context)

    def _download(self, extras: Sequence[str], more: Sequence[str]) -> None:
        what = f"{PROJECT}[{','.join(extras)}]" if extras else f"{PROJECT}"
        project = tomllib.loads((PROJECT / "pyproject.toml").read_text())
        image.fetch(
            [what, *project["build-system"]["requires"], *more],
            PROJECT / "constraints.txt",
            self._wheels,
            os.uname().machine,
            lambda *command, cwd: run(command, timeout=900),
        )

    def build(
        self, tag: str, context: Path = PROJECT, file: Path = DOCKERFILE, **given: str
    ) -> str:
        """Build an image on BASE; returns what was printed."""
        arguments = [f"--build-arg={name}={text}" for name, text in given.items()]
        arguments += [f"--build-arg=BASE={BASE}", f"--volume={self._wheels}:/wheels:ro"]
        arguments += [f"--volume={self.directory}/pip.conf:/etc/pip.conf:ro"]
        return self._buildah(
            *("--format", "docker", "--tag", tag, "--file", file, *arguments, context)
        )

    def inspect(self, name: str) -> dict[str, Any]:
        (found,) = json.loads(self.podman("inspect", name))
        return dict(found)

    # --- containers ----------------------------------------------------------------------------

    def run(self, *words: str | Path, code: int | None = 0) -> str:
        """Run a container, as closed as docs/container.md has it; `words` are those of `podman`."""
        closed = ("--network", "host", "--read-only", "--cap-drop", "ALL")
        return self.podman("run", *closed, *_LIMITS, *words, code=code)

    def wait_for(self, name: str, pattern: str, count: int = 1) -> None:
        """Return when so many lines of its log have the regular expression in them."""

        def is_there() -> bool:
            is_running = self.inspect(name)["State"]["Running"]
            log = self.podman("logs", name)
            if len(re.findall(pattern, log, re.MULTILINE)) >= count:
                return True
            assert is_running, log
            return False

        eventually(is_there, f"{pattern} in the log of {name}")

    def folder(self, volume: str) -> Path:
        """Where the files of a volume are."""
        inside = self.podman("volume", "inspect", "--format", "{{.Mountpoint}}", volume).strip()
        return self._storage / Path(inside).relative_to("/var/lib/containers")


@contextmanager
def engine() -> Iterator[Engine]:
    """One in a temporary folder, and nothing of it left behind."""
    made = Engine(Path(tempfile.mkdtemp(prefix="appliance-containers-")))
    try:
        made.start()
        yield made
    finally:
        made.close()
