"""`make release` in parts, and the workflow of the forge: the whole of it takes half an hour."""

from __future__ import annotations

import gzip
import io
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from appliance.packaging import emulation, image, release, wheels

PROJECT = Path(__file__).parents[2]
WORKFLOW = PROJECT / ".github/workflows/checks-and-release.yaml"

#: The first bytes of a library for that machine.
X86_64 = b"\x7fELF\x02\x01\x01" + bytes(9) + b"\x03\x00" + b"\x3e\x00"
ARM64 = X86_64[:-2] + b"\xb7\x00"


def git(*arguments: str, cwd: Path) -> str:
    author = ["-c", "user.name=A", "-c", "user.email=a@b.invalid"]
    command = ["git", *author, *arguments]
    return subprocess.run(command, cwd=cwd, check=True, capture_output=True, text=True).stdout


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with one commit, in the place of ours."""
    project = tmp_path / "project"
    project.mkdir()
    (project / "pyproject.toml").write_text('[project]\nname = "x"\nversion = "1.2.3"  # here\n')
    (project / "README.md").write_text("A robot.\n")
    git("init", "-q", cwd=project)
    git("add", "--all", cwd=project)
    git("commit", "-q", "-m", "All", cwd=project)
    monkeypatch.setattr(release, "PROJECT", project)
    return project


@pytest.fixture
def made(project: Path, tmp_path: Path) -> release.Release:
    (tmp_path / "work").mkdir()
    return release.Release(tmp_path / "work")


def test_what_is_committed_is_released(project: Path, made: release.Release) -> None:
    git("tag", "v1.2.3", cwd=project)
    git("tag", "nightly", cwd=project)
    assert made._clone() == "1.2.3"
    assert (made._source / "README.md").read_text() == "A robot.\n"


def test_what_is_not_committed_is_named(project: Path, made: release.Release) -> None:
    for name in "abcdefg":
        (project / name).touch()
    with pytest.raises(release.ReleaseError, match=r"this is not: a, b, c, d, e and more\. Commit"):
        made._clone()


@pytest.mark.parametrize("tag", ["v1.2.4", "v1.2.3-rc1", "v2"])
def test_a_tag_of_another_version_is_refused(
    project: Path, made: release.Release, tag: str
) -> None:
    git("tag", tag, cwd=project)
    with pytest.raises(release.ReleaseError, match=re.escape(f"{tag} is not for version 1.2.3")):
        made._clone()


@pytest.mark.parametrize(
    ("files", "reason"),
    [
        (["README.md", "pyproject.toml", "PKG-INFO", "setup.cfg"], ""),
        (["README.md", "pyproject.toml", "ca.key"], "differ in ca.key"),
        (["README.md"], "differ in pyproject.toml"),
    ],
)
def test_an_sdist_that_is_not_the_repository_is_refused(
    files: list[str],
    reason: str,
    made: release.Release,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    made._clone()
    run = made._run

    def build(*command: str | Path, cwd: Path, **variables: str) -> str:
        if "build" not in command:
            return run(*command, cwd=cwd, **variables)
        with tarfile.open(made.out / "x-1.2.3.tar.gz", "w:gz") as archive:
            for name in files:
                archive.addfile(tarfile.TarInfo(f"x-1.2.3/{name}"), io.BytesIO())
        return ""

    monkeypatch.setattr(made, "_run", build)
    if reason:
        with pytest.raises(release.ReleaseError, match=reason):
            made._sdist()
    else:
        made._sdist()
        assert "2 files, those that git has" in capsys.readouterr().out


def test_a_command_that_fails_is_shown_with_its_last_lines(made: release.Release) -> None:
    made._run("echo", f"{'×' * 5000} from a step before", cwd=made._work)
    script = "for n in $(seq 100); do echo line $n; done; echo why >&2; exit 3"
    with pytest.raises(release.ReleaseError) as raised:
        made._run("sh", "-c", script, cwd=made._work)
    told = str(raised.value)
    assert "failed with 3" in told and "line 100" in told and "why" in told
    assert "line 1\n" not in told and "from a step before" not in told
    assert "line 1\n" in made._log.read_text() and "from a step before" in made._log.read_text()


def test_a_check_that_finds_something_ends_the_release(
    made: release.Release, capsys: pytest.CaptureFixture[str]
) -> None:
    made._checked("echo", f"{made.out}/x.whl: \x1b[32mOK\x1b[0m")
    assert capsys.readouterr().out.strip() == "echo: x.whl: OK"
    made._checked("true")
    assert capsys.readouterr().out.strip() == "true: nothing against it"
    with pytest.raises(release.ReleaseError, match="failed with 1"):
        made._checked("false")
    with pytest.raises(release.ReleaseError, match="no-such-program is not installed here"):
        made._checked("no-such-program")


def test_the_checksums_are_those_of_all_files(made: release.Release) -> None:
    (made.out / "a.whl").write_bytes(b"a")
    (made.out / "b c.deb").write_bytes(b"b")
    made._checksums()
    check = ["sha256sum", "--check", "SHA256SUMS"]
    done = subprocess.run(check, cwd=made.out, capture_output=True, text=True, check=True)
    assert done.stdout == "a.whl: OK\nb c.deb: OK\n"


def run_release(*options: str | Path, path: str = os.environ["PATH"]) -> str:
    """What is said when nothing can be made."""
    done = subprocess.run(
        [sys.executable, "-m", "appliance.packaging.release", *options],
        cwd=PROJECT,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode != 0 and done.stdout == ""
    return done.stderr


def test_what_is_in_the_way_is_said_at_once(tmp_path: Path) -> None:
    (tmp_path / "precious").touch()
    assert f"{tmp_path} has precious: it has to be empty" in run_release("--out", tmp_path)
    assert (tmp_path / "precious").exists()
    out = ("--out", tmp_path / "dist")
    told = run_release(*out, path=str(tmp_path))
    assert "apt install lintian dpkg-deb make" in told
    assert "is no Python that runs" in run_release(*out, "--python", "/bin/true")
    other = "x86_64" if os.uname().machine == "aarch64" else "aarch64"
    tools = tmp_path / "tools"
    tools.mkdir()
    for tool in ("lintian", "dpkg-deb", "make"):
        (tools / tool).symlink_to("/bin/true")
    told = run_release(*out, "--machine", other, path=str(tools))
    assert f"there is no compiler for {other} here" in told


def wheel_of(directory: Path, **files: bytes) -> Path:
    wheel = directory / "x-1-cp311-cp311-linux_x86_64.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return wheel


def test_a_wheel_with_machine_code_has_it(tmp_path: Path) -> None:
    broker = "appliance/broker/broker"
    library = f"{broker}.cpython-311-x86_64-linux-gnu.so"
    shared = "appliance__mypyc.cpython-311-x86_64-linux-gnu.so"
    good = {library: X86_64, shared: X86_64, f"{broker}.py": b""}
    for files, wanted in (
        (good, ""),
        ({f"{broker}.py": b""}, "has no machine code of the broker"),
        ({shared: X86_64}, "has no machine code of the broker"),
        ({**good, library: ARM64}, f"{library} is not for x86_64"),
        ({**good, shared: b"#!/bin/sh\n"}, f"{shared} is not for x86_64"),
        ({library: X86_64, shared: X86_64}, f"{broker}.py is missing"),
    ):
        found = list(wheels.faults(wheel_of(tmp_path, **files), "x86_64"))
        assert len(found) == bool(wanted) and all(wanted in each for each in found), files.keys()


def test_pythons_that_are_none_of_ours(tmp_path: Path) -> None:
    def claims(name: str, kind: str = "cpython", header: str = "/h") -> Path:
        python = tmp_path / "python"
        python.write_text(f"""#!/bin/sh\necho '["{name}", "/p", "{header}", ".so", "{kind}"]'\n""")
        python.chmod(0o755)
        return python

    assert wheels.Python.at(claims("python3.12")).name == "python3.12"
    for python, reason in (
        (("python3.9",), "takes CPython 3.10 to 3.14"),
        (("python3.11", "pypy"), "pypy's python3.11"),
        (("python3.11", "cpython", ""), "lacks its headers: apt install python3.11-dev"),
    ):
        with pytest.raises(wheels.WheelError, match=re.escape(reason)):
            wheels.Python.at(claims(*python))
    shim = tmp_path / "shim"
    shim.write_text("#!/bin/sh\necho 'pyenv: python3.12: command not found' >&2; exit 127\n")
    shim.chmod(0o755)
    reasons = {
        shim: r"shim is no Python that runs \(pyenv: python3.12: command not found\)$",
        "/bin/false": r"is no Python that runs \(it ended with 1\)$",
        tmp_path / "none": "is no Python that runs .*No such file",
        tmp_path: "is no Python that runs .*denied",
    }
    for command, reason in reasons.items():
        with pytest.raises(wheels.WheelError, match=reason):
            wheels.Python.at(command)
    here = [python.name for python in wheels.pythons_here()]
    assert f"python3.{sys.version_info[1]}" in here and len(here) == len({*here})


def test_the_headers_for_arm64_are_those_of_here_without_what_is_of_x86_64(tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("needs a C compiler: apt install gcc libc6-dev")
    python = wheels.Python.at(sys.executable)
    variables = wheels.environment(python, "aarch64", tmp_path)
    if os.uname().machine == "aarch64":
        assert variables == {"APPLIANCE_COMPILE": "1"}
        return
    assert variables["SETUPTOOLS_EXT_SUFFIX"].endswith("-aarch64-linux-gnu.so")
    # As Python.h includes it, afterwards: first seen, first taken.
    source = f'#include "{python.header}"\n'
    command = [compiler, *variables["CFLAGS"].split(), "-E", "-dM", "-"]
    done = subprocess.run(command, input=source, capture_output=True, text=True, check=True)
    assert "#define SIZEOF_LONG 8\n" in done.stdout
    assert "HAVE_GCC_ASM_FOR_X" not in done.stdout
    assert "HAVE_GCC_ASM_FOR_X64 1" in python.header.read_text()


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_the_image_is_made_of_the_wheel_for_its_python(
    machine: str, made: release.Release, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which commands are run; that they do it is seen in a release, which takes minutes."""
    made._clone()
    ran: list[list[str]] = []
    run = made._run

    def record(*command: str | Path, cwd: Path, **variables: str) -> str:
        words = [str(word) for word in command]
        if words[0] == "git":
            return run(*command, cwd=cwd, **variables)
        before = emulation.prefix(machine)
        if words[: len(before)] == before:
            words = words[len(before) :]
        ran.append(words)
        if "mmdebstrap" in words:
            Path(words[-1]).touch()
        if "push" in words:
            Path(words[-1].split(":")[1]).write_bytes(b"the image")
        return {"--version": "appliance 1.2.3, compiled\n", "from": "c\n"}.get(words[-1], "c\n")

    monkeypatch.setattr(made, "_run", record)
    names = [f"x-1.2.3-cp{python}-cp{python}-manylinux_2_17_{machine}.whl" for python in (311, 312)]
    other = "x-1.2.3-cp311-cp311-manylinux_2_17_riscv64.whl"
    for name in (*names, other, "x-1.2.3-py3-none-any.whl"):
        (made.out / name).touch()
    made._image("1.2.3", machine)
    packed = (made.out / f"appliance-1.2.3-image-{machine}.tgz").read_bytes()
    assert gzip.decompress(packed) == b"the image"
    (fetch,) = (words for words in ran if "download" in words)
    assert fetch[-1] == f"{made.out}/{names[0]}[{image.EXTRAS[machine]}]"
    assert f"--platform=manylinux_2_17_{machine}" in fetch and "--python-version=3.11" in fetch
    (base,) = (words for words in ran if "mmdebstrap" in words)
    assert f"--architectures={emulation.ARCHITECTURES[machine]}" in base
    *_, build = (words for words in ran if "bud" in words)
    assert f"--build-arg=WHEEL=/wheels/{names[0]}" in build
    moment = git("log", "-1", "--format=%ct", cwd=made._source).strip()
    assert f"--timestamp={moment}" in build
    used = [
        words[words.index("--") + 1 :] for words in ran if "--isolation" in words and "--" in words
    ]
    assert used == [
        ["appliance", *each] for each in (["--version"], ["init", "--robot", "r2d2"], ["check"])
    ]


def test_a_compiler_has_its_c_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiler = tmp_path / "aarch64-linux-gnu-gcc"
    compiler.write_text("#!/bin/sh\nexit 1\n")
    monkeypatch.setenv("PATH", str(tmp_path))
    here = SimpleNamespace(machine="x86_64")
    monkeypatch.setattr(os, "uname", lambda: here)
    with pytest.raises(wheels.WheelError, match="apt install gcc-aarch64-linux-gnu"):
        wheels.check_compiler("aarch64")
    compiler.chmod(0o755)
    with pytest.raises(wheels.WheelError, match="headers: apt install libc6-dev-arm64-cross"):
        wheels.check_compiler("aarch64")
    compiler.write_text("#!/bin/sh\n")
    wheels.check_compiler("aarch64")
    here.machine = "aarch64"  # for itself its own is used; for x86-64 there is none
    with pytest.raises(wheels.WheelError, match=r"no compiler for aarch64 here: apt install gcc$"):
        wheels.check_compiler("aarch64")
    with pytest.raises(wheels.WheelError, match="no compiler for x86_64 here"):
        wheels.check_compiler("x86_64")


def test_an_image_needs_a_wheel_and_its_tools(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda tool: f"/bin/{tool}")
    image.check(["python3.12", "python3.11"])
    with pytest.raises(image.ImageError, match=r"for Python 3\.11, .*--python python3\.11"):
        image.check(["python3.12"])
    monkeypatch.setattr(shutil, "which", lambda tool: None)
    with pytest.raises(image.ImageError, match="apt install mmdebstrap buildah"):
        image.check(["python3.11"])


def test_the_workflow_is_one(tmp_path: Path) -> None:
    schema = ["check_jsonschema", "--builtin-schema", "vendor.github-workflows", str(WORKFLOW)]
    valid = subprocess.run([sys.executable, "-m", *schema], capture_output=True, text=True)
    assert valid.returncode == 0, valid.stdout + valid.stderr
    zizmor = [Path(sys.executable).with_name("zizmor"), "--offline", "--no-progress", WORKFLOW]
    safe = subprocess.run(zizmor, capture_output=True, text=True)
    assert safe.returncode == 0, safe.stdout + safe.stderr


def test_what_the_workflow_runs_is_there() -> None:
    workflow: dict[Any, Any] = yaml.safe_load(WORKFLOW.read_text())
    scripts = [
        step["run"] for job in workflow["jobs"].values() for step in job["steps"] if "run" in step
    ]
    for script in scripts:
        subprocess.run(["bash", "-n"], input=script, text=True, check=True)
    together = "\n".join(scripts)
    assert "bash .ci/run" in together and (PROJECT / ".ci/run").exists()
    targets = set(re.findall(r"\bmake ([a-z]+) ", together))
    assert targets == {"release"} and "\nrelease:" in (PROJECT / "Makefile").read_text()
    options = subprocess.run(
        [sys.executable, "-m", "appliance.packaging.release", "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert set(re.findall(r"--[a-z]+(?= \$)", together)) - {"--repo", "--title"} <= {
        *re.findall(r"--[a-z]+", options.stdout)
    }
    machines = [
        each["machine"] for each in workflow["jobs"]["build"]["strategy"]["matrix"]["include"]
    ]
    assert all(machine in options.stdout for machine in machines)
    # Only the job that publishes there has the identity that PyPI trusts, and no other rights.
    with_identity = {
        name: job["permissions"]
        for name, job in workflow["jobs"].items()
        if "id-token" in job["permissions"]
    }
    assert with_identity == {"pypi": {"id-token": "write"}} and workflow["permissions"] == {}
    assert "secrets." not in WORKFLOW.read_text()


@pytest.mark.parametrize("has_filters", [True, False], ids=["with filters", "as Debian 12's"])
def test_an_archive_of_sources_is_unpacked(has_filters, tmp_path, monkeypatch):
    """A release on Debian 12 had failed: its Python 3.11.2 knows no filters."""
    if not has_filters:
        monkeypatch.delattr(tarfile, "data_filter", raising=False)
    (tmp_path / "appliance-1").mkdir()
    (tmp_path / "appliance-1/setup.py").write_text("x = 1\n")
    with tarfile.open(tmp_path / "sdist.tar.gz", "w:gz") as archive:
        archive.add(tmp_path / "appliance-1", "appliance-1")
    source = wheels.unpack(tmp_path / "sdist.tar.gz", tmp_path / "unpacked")
    assert (source / "setup.py").read_text() == "x = 1\n"
