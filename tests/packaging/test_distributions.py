"""The sdist is the repository, and the wheel the appliance: from whatever they are built."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("setuptools_scm", reason="pip install setuptools-scm")

PROJECT = Path(__file__).parents[2]

#: What setuptools adds to an sdist.
GENERATED = ("PKG-INFO", "setup.cfg", "ros_mqtt_appliance.egg-info/")

#: As pip and build call it, in this environment instead of in one that is made for it.
BUILD = "import sys; from setuptools import build_meta; build_meta.{}(sys.argv[1])"


def output_of(*command: str | Path, cwd: Path, **environment: str) -> str:
    done = subprocess.run(
        command,
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def build(what: str, source: Path, directory: Path) -> Path:
    output_of(sys.executable, "-c", BUILD.format(f"build_{what}"), directory, cwd=source)
    (made,) = directory.glob("*.whl" if what == "wheel" else "*.tar.gz")
    return made


def tracked(clone: Path) -> set[str]:
    return {*output_of("git", "ls-files", "-z", cwd=clone).split("\0")} - {""}


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clone with what is changed here, and with what lies about in a folder that is worked in."""
    if not (PROJECT / ".git").exists():
        pytest.skip("what git tracks is known in a clone only")
    folder = tmp_path_factory.mktemp("clone") / "source"
    output_of("git", "clone", "-q", "--no-hardlinks", PROJECT, folder, cwd=PROJECT)
    for name in tracked(PROJECT) | tracked(folder):
        here, there = PROJECT / name, folder / name
        there.unlink(missing_ok=True)
        if here.exists():
            there.parent.mkdir(parents=True, exist_ok=True)
            there.write_bytes(here.read_bytes())
            there.chmod(here.stat().st_mode)
    output_of("git", "add", "--all", cwd=folder)
    for name in ("notes.txt", "certs/ca.key", "appliance/notes.xml", "dist/old.whl"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("not for others\n")
    return folder


@pytest.fixture(scope="module")
def sdist(clone: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("sdist", clone, tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def unpacked(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unpacked")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder)
    (found,) = folder.iterdir()
    return found


@pytest.fixture(scope="module")
def wheel(unpacked: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("wheel", unpacked, tmp_path_factory.mktemp("wheel"))


def contents(wheel: Path) -> dict[str, str]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: hashlib.sha256(archive.read(name)).hexdigest() for name in archive.namelist()}


def test_the_sdist_is_what_git_tracks(sdist: Path, clone: Path) -> None:
    with tarfile.open(sdist) as archive:
        files = {each.name.partition("/")[2] for each in archive.getmembers() if each.isfile()}
        (script,) = (each for each in archive.getmembers() if each.name.endswith("/.ci/run"))
    assert {name for name in files if not name.startswith(GENERATED)} == tracked(clone)
    assert {"Makefile", "constraints.txt", "appliance.yaml", "tests/conftest.py"} <= files
    assert script.mode & 0o111, "a script that cannot be run"


def test_an_sdist_of_an_sdist_is_the_same(unpacked: Path, clone: Path, tmp_path: Path) -> None:
    """As a distribution makes one, without git."""
    again = build("sdist", unpacked, tmp_path)
    with tarfile.open(again) as archive:
        files = {each.name.partition("/")[2] for each in archive.getmembers() if each.isfile()}
    assert {name for name in files if not name.startswith(GENERATED)} == tracked(clone)


def test_the_wheel_is_the_appliance_alone(wheel: Path, clone: Path) -> None:
    names = {name for name in contents(wheel) if ".dist-info/" not in name}
    ours = {name for name in tracked(clone) if name.startswith("appliance/")}
    ours = {name for name in ours if not name.startswith("appliance/packaging/")}
    assert names == ours


def test_a_wheel_is_the_same_from_wherever_it_is_built(
    wheel: Path, clone: Path, tmp_path: Path
) -> None:
    assert contents(wheel) == contents(build("wheel", clone, tmp_path))


def test_the_wheel_runs_in_a_clean_environment(wheel: Path, tmp_path: Path) -> None:
    environment = tmp_path / "venv"
    venv.create(environment, with_pip=False)
    pip = (sys.executable, "-m", "pip", "--python", environment / "bin/python", "install", "-q")
    constraints = ("-c", PROJECT / "constraints.txt")
    output_of(*pip, "--disable-pip-version-check", *constraints, wheel, cwd=tmp_path)
    command = environment / "bin/appliance"
    version = wheel.name.split("-")[1]
    told = output_of(command, "--version", cwd=tmp_path)
    assert told == f"appliance {version}, pure Python\n"
    assert "user operator" in output_of(command, "init", "--robot", "r2d2", cwd=tmp_path)
    config = tmp_path / "appliance.yaml"
    told = output_of(command, "check", "-c", config, cwd=tmp_path, PATH="/usr/bin:/bin")
    assert "no ROS" in told or "bridge" in told


def test_the_version_is_in_one_place(clone: Path) -> None:
    """Files that a release would forget; pages show what one version printed."""
    from importlib.metadata import version

    ours = version("ros-mqtt-appliance")
    names = [name for name in tracked(clone) if name.endswith((".py", ".toml", ".xml", ".spec"))]
    names = [name for name in names if not name.startswith("tests/")]
    found = [name for name in sorted(names) if f'"{ours}"' in (clone / name).read_text()]
    assert found == ["pyproject.toml"]


@pytest.mark.parametrize(
    ("asked", "reason"),
    [
        ("1", "mypyc is not here"),
        ("yes", "APPLIANCE_COMPILE is 1 for machine code, or 0, and not 'yes'"),
    ],
)
def test_a_build_without_the_machine_code_that_was_asked_for_fails(
    asked: str, reason: str, unpacked: Path, tmp_path: Path
) -> None:
    """In an environment that has setuptools, and nothing that compiles."""
    (tmp_path / "mypyc").mkdir()
    (tmp_path / "mypyc/__init__.py").write_text("raise ImportError('none here')\n")
    done = subprocess.run(
        [sys.executable, "-c", BUILD.format("build_wheel"), tmp_path],
        cwd=unpacked,
        env={**os.environ, "APPLIANCE_COMPILE": asked, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode != 0 and reason in done.stderr, done.stdout + done.stderr
    assert [*tmp_path.glob("*.whl")] == []
