"""Root file systems of other Debian releases and of other kinds of computers.

mmdebstrap unpacks the packages and configures none of them, which is enough for programs and takes
seconds. Nothing is ever mounted into a root: a program of this computer's kind runs in a mount
namespace of its own, and one of another kind under emulation, outside of the root.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

#: What apt on this computer has no mirror of Debian for: another distribution.
DEBIAN = "http://deb.debian.org/debian"
KEYS = Path("/usr/share/keyrings/debian-archive-keyring.gpg")

#: Run in a mount namespace of its own, which is gone with its last process.
ENTER = 'mount -t proc proc "$0/proc" && exec env -i "$@"'


def require(*programs: tuple[str, str]) -> None:
    """Skip the test when something of Debian is missing; a pair is a program and its package."""
    missing = [package for program, package in programs if shutil.which(program) is None]
    if not KEYS.exists():
        missing.append(KEYS.stem)
    if missing:
        pytest.skip(f"needs apt install {' '.join(missing)}")
    if os.geteuid() != 0:
        pytest.skip("needs root: what mmdebstrap makes as another user, that user cannot remove")


@contextmanager
def debian_root(path: Path, suite: str, *packages: str, architecture: str = "") -> Iterator[Path]:
    """A root with these packages and what they depend on; it is removed in the end."""
    # The packages of another kind of computer are not run here, so binfmt is not needed.
    other = [f"--architectures={architecture}", "--skip=check/qemu"] if architecture else []
    # Nor is it of interest how old the mirror's lists are, as those of a snapshot.
    old = "--aptopt=Acquire::Check-Valid-Until false"
    command = [
        *("mmdebstrap", "--quiet", "--variant=extract", old, *other),
        *(f"--include={','.join(packages)}", suite, path, mirror()),
    ]
    made = subprocess.run(command, capture_output=True, text=True, timeout=1200)
    try:
        assert made.returncode == 0, made.stderr
        yield path
    finally:
        remove(path)


def mirror() -> str:
    """The mirror of Debian that apt uses here."""
    command = ["apt-get", "indextargets", "--format", "$(REPO_URI)", "Origin: Debian"]
    uris = subprocess.run(command, capture_output=True, text=True).stdout.split()
    return next((uri for uri in uris if uri.rstrip("/").endswith("/debian")), DEBIAN)


def remove(path: Path) -> None:
    """Delete the tree; AssertionError if something is mounted in it, which would be deleted too."""
    inside = f"{path.resolve()}/"
    mounts = Path("/proc/self/mountinfo").read_text().splitlines()
    points = [line.split()[4] for line in mounts]
    mounted = [point for point in points if f"{point}/".startswith(inside)]
    assert not mounted, f"{mounted} is mounted in {path}: unmount it, then remove the root"
    shutil.rmtree(path, ignore_errors=True)


def inside(root: Path, *command: str, **environment: str) -> list[str]:
    """The command line that runs a program in a root, with this environment and no other."""
    (root / "proc").mkdir(exist_ok=True)
    given = [f"{name}={value}" for name, value in environment.items()]
    chroot = shutil.which("chroot", path=f"{os.environ['PATH']}:/usr/sbin")
    assert chroot is not None
    own = ("unshare", "--mount", "--propagation", "private", "sh", "-c", ENTER, str(root))
    return [*own, *given, chroot, str(root), *command]
