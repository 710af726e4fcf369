"""Builds the one file and the deb in the root file system of an old Debian, for a release.

A program runs with the glibc that it was linked with, and with later ones. So they are built in a
root of Debian 11, with a Python that is built there from a later Debian's sources, and the broker
as machine code. apt verifies what comes from Debian, by its signatures, and pip what comes from
PyPI. The build itself has no network.

For another kind of computer everything is the same: its programs, Python among them, are emulated,
and the compiler, which is of this computer's kind, makes code for the other.
"""

from __future__ import annotations

import argparse
import fcntl
import functools
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from appliance.packaging import emulation, symbols

PROJECT = Path(__file__).resolve().parents[2]
PYTHON_RECIPE = Path(__file__).with_name("python.sh")
KEYRING = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
MIRROR = "http://deb.debian.org/debian"

#: Is beside a root whose libraries have no security updates.
OUTDATED = "without-security-updates"

#: Its glibc is `symbols.FLOOR`.
SUITE = "bullseye"
#: Suites in which security updates and sources of the same Debian are.
SOURCE_SUITES = ("bookworm", "trixie")
#: What Debian 11 has too old, or without updates: the newest of it in those suites is built.
SOURCES = ("openssl", "sqlite3", "python3.11")
PYTHON = "/usr/local/bin/python3.11"
SYSTEM_PATH = ("/usr/sbin", "/usr/bin", "/sbin", "/bin")

#: In the root: the tools, and the libraries that modules of Python and of wheels are linked with.
TOOL_PACKAGES = ("build-essential", "ca-certificates", "pkg-config", "quilt", "tcl", "xz-utils")
LIBRARIES = (
    *("libbz2-dev", "libexpat1-dev", "libffi-dev", "liblzma-dev", "libstdc++6", "uuid-dev"),
    "zlib1g-dev",
)
#: The compiler and its tools for another kind of computer, under their usual names.
CROSS_TOOLS = Path("/opt/cross")
#: `ldd` of the root knows the loader of its own kind only.
LDD = """\
#!/bin/sh
exec /lib/ld-linux-{machine}.so.1 --list "$@"
"""
#: The commands that this needs, and the packages of Debian which have them.
TOOLS = {
    "mmdebstrap": "mmdebstrap",
    "bwrap": "bubblewrap",
    "unshare": "util-linux",
    "apt-get": "apt",
    "dpkg-deb": "dpkg",
    "git": "git",
}

#: What pip fetches: what is in the one file, and what the builds of the wheel ask for (setup.py).
WHEELS = (".[ros,binary]", "mypy[mypyc]", "types-PyYAML", "setuptools", "setuptools-scm")

#: What pip in the root needs to reach PyPI as this computer does.
NETWORK_FILES = tuple(
    map(Path, ("/etc/resolv.conf", "/etc/hosts", "/etc/ssl/certs", "/etc/pip.conf"))
)
NETWORK_VARIABLES = re.compile(
    r"PIP_(?!NO_INDEX|FIND_LINKS)\w+|(https?|no|all)_proxy", re.IGNORECASE
)


class BuildError(Exception):
    """The build cannot go on; the message says why, and what to do."""


def remove(tree: Path) -> None:
    """Remove a folder with all that is in it. Raises BuildError if anything is mounted below it.

    Removing a root with, say, /dev mounted into it would empty the computer's own.
    """
    tree = tree.absolute()
    real = tree.resolve()
    mounted = [place for place in _mounts() if place == real or real in place.parents]
    if mounted:
        places = ", ".join(map(str, mounted))
        raise BuildError(f"{tree} is not removed, since something is mounted: umount {places}")
    if tree.is_symlink():
        raise BuildError(f"{tree} is not removed, since it is a link to {real}")
    if tree.exists():
        shutil.rmtree(tree)


def _mounts(table: str = "/proc/self/mountinfo") -> Iterator[Path]:
    for line in Path(table).read_text(errors="surrogateescape").splitlines():
        # Blanks and the like are there as their octal numbers (proc(5)).
        place = re.sub(r"\\([0-7]{3})", lambda found: chr(int(found[1], 8)), line.split(" ")[4])
        yield Path(place)


class Root:
    """The root and what goes with it, in a folder that is kept between builds."""

    def __init__(self, cache: Path, mirror: str, optimized: bool, machine: str) -> None:
        self._cache = cache
        self._mirror = mirror
        self._optimized = optimized
        self._machine = machine
        self._foreign = emulation.is_foreign(machine)
        self._root = cache / "root"
        self._local = cache / "local"
        self._sources = cache / "sources"
        self._wheels = cache / "wheels"
        #: Of the project's folder: with them the second build is a matter of minutes.
        self._kept = {".venv": cache / "venv", "build": cache / "build"}

    def build(self, out: Path) -> list[Path]:
        """Make what is missing, and then the one file and its deb. Returns the paths of both."""
        self._say("fetch the sources of Python and its libraries")
        versions = self._fetch_sources()
        of_debian = [SUITE, self._mirror, self._machine, *self._packages(), LDD]
        of_python = [*of_debian, *versions, f"{self._optimized}", PYTHON_RECIPE.read_text()]
        if (self._cache / OUTDATED).exists():
            remove(self._root)  # perhaps there are some now
        self._make(self._root, of_debian, self._make_root)
        self._make(self._local, of_python, self._make_python)
        source = self._copy_project()
        wanted = [(source / name).read_text() for name in ("pyproject.toml", "constraints.txt")]
        self._make(self._wheels, [*of_python, *wanted, *WHEELS], self._fetch_wheels)
        return self._build_project(source, out)

    def _make(self, folder: Path, parts: Sequence[str], make: Callable[[], None]) -> None:
        """Make the folder anew, unless it was made of the same and was finished."""
        recipe = "\n".join(parts)
        note = folder.with_name(f"{folder.name}.recipe")
        if note.exists() and note.read_text() == recipe and folder.exists():
            return
        note.unlink(missing_ok=True)
        remove(folder)
        folder.mkdir()
        make()
        note.write_text(recipe)

    def _fetch_sources(self) -> list[str]:
        """Fetch the newest of each source that the mirror has; returns their versions."""
        state = self._cache / "apt"
        (state / "lists/partial").mkdir(parents=True, exist_ok=True)
        remove(self._sources)
        self._sources.mkdir()
        places = [(self._mirror, suite) for suite in SOURCE_SUITES]
        places += [(f"{self._mirror}-security", f"{suite}-security") for suite in SOURCE_SUITES]
        lines = (f"deb-src [signed-by={KEYRING}] {place} {suite} main" for place, suite in places)
        (state / "sources.list").write_text("".join(f"{line}\n" for line in lines))
        settings = {
            "Dir::Etc::SourceList": state / "sources.list",
            "Dir::Etc::SourceParts": "/dev/null",
            "Dir::State::Lists": state / "lists",
            "Dir::Cache": state,
            "APT::Get::Only-Source": "true",
            "APT::Sandbox::User": "root",  # it writes into a folder of ours
            "APT::Update::Error-Mode": "any",  # else what cannot be reached is only warned of
        }
        options = [part for name, value in settings.items() for part in ("-o", f"{name}={value}")]
        _run("apt-get", "-qq", *options, "update")
        return [f"{name} {self._fetch_source(name, options)}" for name in SOURCES]

    def _fetch_source(self, name: str, options: list[str]) -> str:
        shown = _output("apt-cache", *options, "showsrc", name)
        versions: set[str] = set(re.findall(r"^Version: (\S+)$", shown, re.MULTILINE))
        if not versions:
            raise BuildError(f"{self._mirror} has no source of {name}: is it a mirror of Debian?")
        for version in sorted(versions, key=functools.cmp_to_key(_order), reverse=True):
            command = ("apt-get", "-qq", *options, "source", "--download-only", f"{name}={version}")
            if subprocess.run(command, cwd=self._sources, stdout=sys.stderr).returncode == 0:
                return version
            # A mirror can list what it does not have yet.
            self._say(f"{name} {version} could not be fetched; trying the version before")
        raise BuildError(f"no source of {name} could be fetched from {self._mirror}: see above")

    def _packages(self) -> list[str]:
        if not self._foreign:
            return [*TOOL_PACKAGES, *LIBRARIES]
        other = emulation.ARCHITECTURES[self._machine]
        compiler = f"gcc-{self._machine}-linux-gnu"
        return [*TOOL_PACKAGES, compiler, *(f"{each}:{other}" for each in LIBRARIES)]

    def _make_root(self) -> None:
        self._say(f"make the root of Debian's {SUITE}")
        kinds = dict.fromkeys((os.uname().machine, self._machine))
        architectures = ",".join(emulation.ARCHITECTURES[each] for each in kinds)
        suite = f"deb {self._mirror} {SUITE} main"
        security = f"deb {self._mirror}-security {SUITE}-security main"
        make = (
            # What it mounts is in a namespace of its own, and gone with it also if it is killed.
            *("unshare", "--mount", "--propagation", "private", "--pid", "--fork"),
            *("mmdebstrap", "--quiet", "--variant=minbase", f"--keyring={KEYRING}"),
            f"--architectures={architectures}",
            *('--aptopt=Acquire::Languages "none"', '--aptopt=APT::Install-Recommends "false"'),
            *(f"--include={','.join(self._packages())}", SUITE, self._root),
        )
        outdated = self._cache / OUTDATED
        outdated.unlink(missing_ok=True)
        try:
            _run(*make, suite, security)
        except BuildError:  # a mirror can list what it does not have
            self._say("trying without security updates, which could not be fetched: see above")
            outdated.touch()
            remove(self._root)
            _run(*make, suite)
        for file in NETWORK_FILES:  # it is read-only when these are mounted there
            place = self._root / file.relative_to("/")
            if not place.exists():
                place.touch()
        if self._foreign:
            self._make_cross_tools()

    def _make_cross_tools(self) -> None:
        tools = self._root / CROSS_TOOLS.relative_to("/")
        tools.mkdir(parents=True)
        start = f"{self._machine}-linux-gnu-"
        for tool in (self._root / "usr/bin").glob(f"{start}*"):
            (tools / tool.name.removeprefix(start)).symlink_to(f"/usr/bin/{tool.name}")
        (tools / "cc").symlink_to("gcc")
        (tools / "ldd").write_text(LDD.format(machine=self._machine))
        (tools / "ldd").chmod(0o755)

    def _make_python(self) -> None:
        if self._foreign:
            self._check_emulation()
        self._say("build Python and its libraries there")
        compiled = self._cache / "compile"
        remove(compiled)
        compiled.mkdir()
        binds: list[str | Path] = [
            *("--bind", self._local, "/usr/local", "--bind", compiled, "/mnt/compile"),
            *("--ro-bind", self._sources, "/mnt/sources"),
            *("--ro-bind", PYTHON_RECIPE, "/mnt/python.sh"),
        ]
        words = ["sh", "/mnt/python.sh", *(["optimized"] if self._optimized else [])]
        with (self._cache / "python.log").open("wb") as log:
            done = subprocess.run(self._inside(binds, words), stdout=log, stderr=log)
        if done.returncode:
            raise BuildError(f"Python could not be built; the reason is at the end of {log.name}")
        remove(compiled)

    def _check_emulation(self) -> None:
        try:
            _run(*self._inside([], ["ldd", f"/lib/{self._machine}-linux-gnu/libc.so.6"]))
        except BuildError:
            raise BuildError(
                f"programs for {self._machine} do not run here: that takes Linux 6.7 or later, or "
                "qemu as their interpreter for all users (binfmt_misc)"
            ) from None

    def _copy_project(self) -> Path:
        """The files of the project, without what is ignored by git."""
        source = self._cache / "source"
        remove(source)
        listed = _output("git", "-C", PROJECT, "ls-files", "-z", "-co", "--exclude-standard")
        for name in filter(None, listed.split("\0")):
            if (PROJECT / name).is_file():
                (source / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(PROJECT / name, source / name)
        for name in (*self._kept, "dist"):
            (source / name).mkdir()
        return source

    def _fetch_wheels(self) -> None:
        self._say("fetch the wheels")
        for kept in self._kept.values():  # made with the wheels and the Python before
            remove(kept)
        binds: list[str | Path] = []
        for file in NETWORK_FILES:
            binds += ["--ro-bind-try", file, file]
        binds += ["--ro-bind", self._cache / "source", "/mnt/source"]
        binds += ["--bind", self._wheels, "/mnt/wheels"]
        for name, value in os.environ.items():
            if NETWORK_VARIABLES.fullmatch(name):
                binds += ["--setenv", name, value]
        # `pip wheel`, not `pip download`: of some packages PyPI has only the sources.
        pip = (
            "/tmp/pip/bin/pip wheel -q --use-pep517 --disable-pip-version-check -c constraints.txt"
        )
        commands = (
            "cp -r /mnt/source /tmp/source",
            "cd /tmp/source",
            f"{PYTHON} -m venv /tmp/pip",
            f"{pip} -w /mnt/wheels {shlex.join(WHEELS)}",
            "rm /mnt/wheels/ros_mqtt_appliance-*",  # what is built is the folder itself
        )
        _run(*self._inside(binds, ["sh", "-c", " && ".join(commands)], network=True))

    def _build_project(self, source: Path, out: Path) -> list[Path]:
        self._say("build the one file and the deb")
        binds: list[str | Path] = ["--bind", source, "/mnt/source"]
        binds += ["--ro-bind", self._wheels, "/mnt/wheels"]
        for name, kept in self._kept.items():
            kept.mkdir(exist_ok=True)
            binds += ["--bind", kept, f"/mnt/source/{name}"]
        variables = {
            "PIP_NO_INDEX": "1",
            "PIP_FIND_LINKS": "/mnt/wheels",
            "SOURCE_DATE_EPOCH": _output("git", "-C", PROJECT, "log", "-1", "--format=%ct").strip(),
            "PYTHONHASHSEED": "0",  # the same sources give the same file
        }
        for name, value in variables.items():
            binds += ["--setenv", name, value]
        command = ["make", "-C", "/mnt/source", "deb", f"PYTHON={PYTHON}", "COMPILE=1"]
        _run(*self._inside(binds, command))
        out.mkdir(parents=True, exist_ok=True)
        made = [source / "dist/appliance", *(source / "dist").glob("*.deb")]
        for path in made:
            faults = list(symbols.examine(path).faults())
            if faults:
                raise BuildError("\n".join(faults))
        return [Path(shutil.copy2(path, out)) for path in made]

    def _inside(
        self, binds: Sequence[str | Path], command: Sequence[str], network: bool = False
    ) -> list[str | Path]:
        """A command for this in the root, with the Python of it and the tools."""
        tools = [f"{CROSS_TOOLS}"] if self._foreign else []
        path = [*tools, "/usr/local/bin", *SYSTEM_PATH]
        return [
            *sandbox(self._root, self._machine),
            *("--ro-bind", self._local, "/usr/local", "--tmpfs", "/mnt"),
            *(() if network else ("--unshare-net",)),
            *("--setenv", "PATH", ":".join(path)),
            *("--setenv", "MACHINE", self._machine),
            *("--setenv", "DEB_HOST_ARCH", emulation.ARCHITECTURES[self._machine]),
            *("--setenv", "LD_LIBRARY_PATH", "/usr/local/lib"),
            *binds,
            *command,
        ]

    def _say(self, what: str) -> None:
        print(f"{SUITE}: {what}", file=sys.stderr, flush=True)


def sandbox(root: Path, machine: str) -> list[str | Path]:
    """What to put before a command, and before more options of bwrap, to run it in that root.

    The root is read-only, and has an empty /tmp. Mounts are seen by nobody else and end with it.
    """
    return [
        *emulation.prefix(machine),
        *("bwrap", "--ro-bind", root, "/", "--dev", "/dev", "--proc", "/proc", "--tmpfs", "/tmp"),
        *("--unshare-pid", "--unshare-ipc", "--die-with-parent", "--clearenv"),
        *("--setenv", "PATH", ":".join(SYSTEM_PATH)),
        *("--setenv", "LC_ALL", "C.UTF-8", "--setenv", "HOME", "/tmp"),
    ]


def default_cache(machine: str) -> Path:
    """Where the root for that kind of computer is kept."""
    return PROJECT / f"build/oldest-{machine}"


def _order(one: str, other: str) -> int:
    """As Debian orders versions: -1, 0 or 1."""
    for relation, result in (("lt", -1), ("gt", 1)):
        if subprocess.run(["dpkg", "--compare-versions", one, relation, other]).returncode == 0:
            return result
    return 0


def _run(*command: str | Path) -> None:
    done = subprocess.run(command, stdout=sys.stderr)
    if done.returncode:
        raise BuildError(f"{command[0]} failed with {done.returncode}; see above")


def _output(*command: str | Path) -> str:
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise BuildError(f"{command[0]} failed with {done.returncode}; see above")
    return done.stdout


@contextmanager
def _alone(cache: Path) -> Iterator[None]:
    """Nobody else builds in that folder meanwhile. Raises BuildError if somebody does."""
    cache.mkdir(parents=True, exist_ok=True)
    with (cache / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BuildError(f"another build is using {cache}: wait for its end") from None
        yield


def check_computer(machine: str) -> None:
    """Raises BuildError if this computer lacks what a build for that kind of computer needs."""
    missing = {package for tool, package in TOOLS.items() if not shutil.which(tool)}
    missing.update(emulation.missing(machine))
    if not KEYRING.exists():
        missing.add("debian-archive-keyring")
    if missing:
        raise BuildError(f"install what this needs: apt install {' '.join(sorted(missing))}")
    if os.geteuid():
        raise BuildError("only root can make the root file system of another Debian: use sudo")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=PROJECT / "dist", help="default: dist")
    parser.add_argument(
        "--machine",
        choices=sorted(emulation.ARCHITECTURES),
        default=os.uname().machine,
        help="the kind of computer; default: this one; another is emulated",
    )
    parser.add_argument(
        "--cache",
        type=Path,
        help="where the root is kept for the next build; 2 GB; default: build/oldest-MACHINE",
    )
    parser.add_argument("--mirror", default=MIRROR, help=f"Debian's packages; default: {MIRROR}")
    parser.add_argument(
        "--optimized",
        action="store_true",
        help="build Python with PGO and LTO, which takes half an hour more",
    )
    options = parser.parse_args()
    os.umask(0o022)
    try:
        check_computer(options.machine)
        cache = (options.cache or default_cache(options.machine)).absolute()
        with _alone(cache):
            mirror = options.mirror.rstrip("/")
            root = Root(cache, mirror, options.optimized, options.machine)
            print(*root.build(options.out), sep="\n")
    except (BuildError, OSError, symbols.UnreadableError) as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
