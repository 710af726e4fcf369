"""Builds and checks all that a release publishes: `make release`.

It works on a clone of the last commit, so that nothing else gets in; docs/release.md says what is
made and how it is published.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
import venv
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from appliance.packaging import emulation, image, root, wheels

PROJECT = Path(__file__).resolve().parents[2]
WORK = PROJECT / "build/release"
#: What setuptools adds to an sdist.
GENERATED = ("PKG-INFO", "setup.cfg", "ros_mqtt_appliance.egg-info/")
CHECKSUMS = "SHA256SUMS"
#: Lines of a failed command that are shown; all of them are in the log.
SHOWN = 25


class ReleaseError(Exception):
    """The release cannot be made; the message says why, and what to do."""


class Release:
    """One release, made in an empty folder for work; `out` there has what is to be published."""

    def __init__(self, work: Path) -> None:
        self.out = work / "dist"
        self.out.mkdir()
        self._work = work
        self._source = work / "source"
        self._log = work / "release.log"
        self._started = time.monotonic()

    def make(self, pythons: Sequence[wheels.Python], machines: Sequence[str]) -> None:
        """Everything, one after the other; the first failure ends it."""
        native = os.uname().machine
        with self._step("the last commit, in a clone of its own"):
            version = self._clone()
            self._say(f"version {version}; all that is said on the way is in {self._log}")
        with self._step("sdist"):
            sdist = self._sdist()
        with self._step("pure wheel"):
            wheel = wheels.build_pure(sdist, self._work, self.out, self._run)
            self._try(wheel, Path(sys.executable), f"appliance {version}, pure Python")
        for machine in machines:
            for python in pythons:
                with self._step(f"wheel with machine code, {python.name} on {machine}"):
                    wheel = wheels.build_compiled(
                        python, machine, sdist, self._work, self.out, self._run
                    )
                    self._say(wheel.name)
                    if machine == native:
                        self._try(wheel, python.executable, f"appliance {version}, compiled")
        for machine in machines:
            with self._step(f"one file and Debian package for {machine}"):
                self._one_file(version, machine)
            with self._step(f"image of a container for {machine}"):
                self._image(version, machine)
            with self._step("bill of materials of the one file (CycloneDX)"):
                self._bill(version, machine)
        with self._step("checks"):
            self._check()
        with self._step(CHECKSUMS):
            self._checksums()

    # --- the parts -----------------------------------------------------------------------------
    def _clone(self) -> str:
        """Clone what is committed, and return its version."""
        git = ("git", "-C", PROJECT)
        if changed := self._run(*git, "status", "--porcelain", cwd=PROJECT).splitlines():
            names = ", ".join(line[3:] for line in changed[:5])
            raise ReleaseError(
                f"a release is made of what is committed, and this is not: {names}"
                f"{' and more' if changed[5:] else ''}. Commit it, or put it aside: git stash -u"
            )
        self._run("git", "clone", "-q", "--no-hardlinks", PROJECT, self._source, cwd=self._work)
        text = (self._source / "pyproject.toml").read_text()
        found = re.search(r'^version = "([^"]+)"', text, re.MULTILINE)
        if found is None:
            raise ReleaseError('pyproject.toml has no line `version = "…"`')
        tags = self._run(*git, "tag", "--points-at", "HEAD", cwd=PROJECT).split()
        if wrong := [tag for tag in tags if re.match(r"v\d", tag) and tag != f"v{found[1]}"]:
            raise ReleaseError(
                f"the tag {wrong[0]} is not for version {found[1]} of pyproject.toml"
            )
        return found[1]

    def _sdist(self) -> Path:
        build = (sys.executable, "-m", "build", "--sdist", "-o", self.out, self._source)
        self._run(*build, cwd=self._work)
        (sdist,) = self.out.glob("*.tar.gz")
        with tarfile.open(sdist) as archive:
            files = {each.name.partition("/")[2] for each in archive if each.isfile()}
        files = {name for name in files if not name.startswith(GENERATED)}
        listed = self._run("git", "-C", self._source, "ls-files", "-z", cwd=self._work)
        if different := sorted(files ^ ({*listed.split("\0")} - {""})):
            raise ReleaseError(f"the sdist and git differ in {', '.join(different[:5])}")
        self._say(f"{sdist.name}: {len(files)} files, those that git has")
        return sdist

    def _try(self, wheel: Path, python: Path, version: str) -> None:
        """Use the wheel once, in an environment that has nothing but what it asks for."""
        house = self._work / f"try-{wheel.name}"
        self._run(python, "-m", "venv", house / "venv", cwd=self._work)
        pip = (house / "venv/bin/python", "-m", "pip", "install", "--disable-pip-version-check")
        constraints = self._source / "constraints.txt"
        self._run(*pip, "-q", "-c", constraints, wheel, cwd=house)
        self._use(house / "venv/bin/appliance", house, version)

    def _use(
        self, command: Path, house: Path, version: str, within: Sequence[str | Path] = ()
    ) -> None:
        """Run the command of what was built, in a folder of its own; `within` runs it in a root."""
        told = self._run(*within, command, "--version", cwd=house).strip()
        if told != version:
            raise ReleaseError(f"{command} says that it is {told!r}, which ought to be {version!r}")
        self._run(*within, command, "init", "--robot", "r2d2", cwd=house)
        check = self._run(*within, command, "check", cwd=house)
        self._say(f"{told}; init; check: {check.strip().splitlines()[-1]}")

    def _one_file(self, version: str, machine: str) -> None:
        """Build both in an old Debian's root, for old systems, and use the one file there."""
        made = self._work / f"one-file-{machine}"
        # The root and its Python are kept for the next release.
        cache = root.default_cache(machine)
        options = ["--machine", machine, "--cache", str(cache), "--out", str(made)]
        if not emulation.is_foreign(machine):  # emulated, the profile alone would take hours
            options.append("--optimized")
        self._run(sys.executable, "-m", "appliance.packaging.root", *options, cwd=self._source)
        if (cache / root.OUTDATED).exists():
            self._say(f"without security updates of Debian's {root.SUITE}: the mirror has none")
        house = self._work / f"try-one-file-{machine}"
        house.mkdir()
        shutil.copy2(made / "appliance", house)
        # It sees that folder and the root, which has neither our Python nor our libraries.
        bind = ("--bind", house, "/tmp/try", "--chdir", "/tmp/try")
        within = (*root.sandbox(cache / "root", machine), *bind)
        self._use(Path("/tmp/try/appliance"), house, f"appliance {version}, compiled", within)
        (package,) = made.glob("*.deb")
        self._run("dpkg-deb", "--info", package, cwd=made)
        shutil.move(made / "appliance", self.out / f"appliance-{version}-linux-{machine}")
        shutil.move(package, self.out)

    def _image(self, version: str, machine: str) -> None:
        """Build the container's image of the wheel for its Python, and use it once."""
        (wheel,) = self.out.glob(f"*-cp{image.PYTHON.replace('.', '')}-*_{machine}.whl")
        built = image.Image(machine, version, self._work / f"image-{machine}", self._run)
        built.build(wheel, self._source)
        # A `.tar.gz` here is an sdist, to whoever takes files to an index.
        file = built.save(self.out / f"appliance-{version}-image-{machine}.tgz")
        self._use(
            Path("appliance"), self._work, f"appliance {version}, compiled", built.container()
        )
        self._say(file.name)
        root.remove(self._work / f"image-{machine}")  # several times as large

    def _bill(self, version: str, machine: str) -> None:
        """Of the packages in the environment of the build, whichever computer its Python is of."""
        environment = root.default_cache(machine) / "venv"
        found = sorted(environment.glob("lib/python3*/site-packages"))
        if not found:
            raise ReleaseError(f"{environment} is no environment of Python: see {self._log}")
        reader = self._work / f"bill-{machine}"
        venv.create(reader, with_pip=False)
        (site,) = reader.glob("lib/python3*/site-packages")
        (site / "packages.pth").write_text(f"{found[0]}\n")
        bill = self.out / f"appliance-{version}-linux-{machine}.cdx.json"
        options: list[str | Path] = ["--output-reproducible", "--mc-type", "application"]
        options += ["--of", "JSON", "-o", bill, "--pyproject", self._source / "pyproject.toml"]
        tool = (sys.executable, "-m", "cyclonedx_py", "environment")
        self._run(*tool, *options, reader / "bin/python", cwd=self._work)
        listed = bill.read_text().count('"bom-ref"')
        self._say(f"{bill.name}: {listed} components")

    def _check(self) -> None:
        """What an index and Debian have against it. Each tool's last line is shown."""
        distributions = [*self.out.glob("*.tar.gz"), *self.out.glob("*.whl")]
        module = (sys.executable, "-m")
        self._checked(*module, "twine", "check", "--strict", *distributions)
        settings = ("--config", self._source / "pyproject.toml")
        these = self.out.glob("*.whl")
        self._checked(*module, "check_wheel_contents", *settings, *these)
        as_root = ("--allow-root",) if os.geteuid() == 0 else ()
        lintian = ("lintian", *as_root, "--fail-on", "error,warning")
        self._checked(*lintian, *self.out.glob("*.deb"))

    def _checked(self, *command: str | Path) -> None:
        told = re.sub(r"\x1b\[[\d;]*m", "", self._run(*command, cwd=self._work)).strip()
        told = told or "nothing against it"
        name = Path(command[2] if command[0] == sys.executable else command[0]).name
        self._say(f"{name}: {told.splitlines()[-1].replace(f'{self.out}/', '')}")

    def _checksums(self) -> None:
        files = sorted(path for path in self.out.iterdir() if path.name != CHECKSUMS)
        lines = (f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}" for path in files)
        (self.out / CHECKSUMS).write_text("".join(f"{line}\n" for line in lines))
        self._run("sha256sum", "--check", "--strict", "--quiet", CHECKSUMS, cwd=self.out)
        for path in files:
            self._say(f"{path.stat().st_size / (1 << 20):8.2f} MiB  {path.name}")

    # --- how -----------------------------------------------------------------------------------
    @contextmanager
    def _step(self, what: str) -> Iterator[None]:
        self._print(what)
        started = time.monotonic()
        yield
        self._say(f"{time.monotonic() - started:.0f} s")

    def _print(self, text: str) -> None:
        minutes, seconds = divmod(int(time.monotonic() - self._started), 60)
        print(f"{minutes:3}:{seconds:02}  {text}", flush=True)

    def _say(self, text: str) -> None:
        print(f"        {text}", flush=True)

    def _run(self, *command: str | Path, cwd: Path, **variables: str) -> str:
        """Run it, with all that it says in the log; returns its standard output."""
        environment = {**os.environ, **variables}
        environment["PATH"] = f"{Path(sys.executable).parent}:{environment['PATH']}"
        environment.setdefault("SOURCE_DATE_EPOCH", self._moment())
        with self._log.open("a") as log:
            log.write(f"$ {' '.join(map(str, command))}\n")
            log.flush()
            begin = log.tell()
            try:
                done = subprocess.run(
                    command, cwd=cwd, env=environment, stdout=subprocess.PIPE, stderr=log, text=True
                )
            except FileNotFoundError as error:
                raise ReleaseError(f"{error.filename} is not installed here") from None
            log.write(done.stdout)
        if done.returncode:
            told = self._log.read_bytes()[begin:].decode(errors="replace").splitlines()
            last = "\n".join(f"    {line}" for line in told[-SHOWN:])
            name = Path(command[0]).name
            raise ReleaseError(
                f"`{name} {' '.join(map(str, command[1:4]))} …` failed with {done.returncode}; "
                f"{self._log} has all of it:\n{last}"
            )
        return done.stdout

    def _moment(self) -> str:
        """The time of the commit, so that the same sources give the same files."""
        git = ["git", "-C", str(PROJECT), "log", "-1", "--format=%ct"]
        told = subprocess.run(git, stdout=subprocess.PIPE, text=True, check=True)
        return told.stdout.strip()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=PROJECT / "dist", help="default: dist")
    parser.add_argument(
        "--python",
        action="append",
        default=[],
        metavar="COMMAND",
        help="a Python to make wheels with machine code for; default: each that is here",
    )
    parser.add_argument(
        "--machine",
        action="append",
        default=[],
        choices=sorted(emulation.ARCHITECTURES),
        help="and a kind of computer; default: this one, and others that there is a compiler for",
    )
    options = parser.parse_args()
    os.umask(0o022)
    native = os.uname().machine
    cross = [each for each, compiler in wheels.COMPILERS.items() if shutil.which(compiler)]
    machines = [*dict.fromkeys(options.machine)] or [
        native,
        *(each for each in cross if each != native),
    ]
    try:
        out: Path = options.out.absolute()
        if out.exists() and (here := sorted(each.name for each in out.iterdir())):
            raise ReleaseError(
                f"{out} has {', '.join(here[:5])}: it has to be empty, or another --out"
            )
        if missing := [each for each in ("lintian", "dpkg-deb", "make") if not shutil.which(each)]:
            raise ReleaseError(f"install what this needs: apt install {' '.join(missing)}")
        for machine in machines:
            wheels.check_compiler(machine)
            root.check_computer(machine)
        named = {(python := wheels.Python.at(each)).name: python for each in options.python}
        pythons = [*named.values()] or wheels.pythons_here()
        if not pythons:
            raise ReleaseError("no Python here has its headers: apt install python3-dev")
        image.check(python.name for python in pythons)
        if not (PROJECT / ".git").exists():
            raise ReleaseError(f"{PROJECT} is no clone: a release is made of a commit of git")
        root.remove(WORK)
        WORK.mkdir(parents=True)
        release = Release(WORK)
        release.make(pythons, machines)
        out.mkdir(parents=True, exist_ok=True)
        for path in release.out.iterdir():  # only now: there are all of them, or none
            shutil.move(path, out)
    except (ReleaseError, image.ImageError, wheels.WheelError, root.BuildError, OSError) as error:
        print(f"release: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
