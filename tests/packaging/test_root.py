"""The build for old systems: what it refuses and what it keeps.

The build itself is no test: it takes too long for CI.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from appliance.packaging import emulation, root
from appliance.packaging.root import BuildError, Root, remove

HERE = os.uname().machine
OTHER = "aarch64" if HERE == "x86_64" else "x86_64"

as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount: run it as root")

#: In a mount namespace of its own: mounts at the first argument, and removes the second.
MOUNTED = """
import subprocess, sys
from pathlib import Path
from appliance.packaging.root import BuildError, remove
subprocess.run(["mount", "-t", "tmpfs", "none", sys.argv[1]], check=True)
Path(sys.argv[1], "precious").touch()
try:
    remove(Path(sys.argv[2]))
except BuildError as error:
    print(error)
print(Path(sys.argv[1], "precious").exists())
"""


def fails(*command: str | Path) -> None:
    raise BuildError(f"{command[0]} failed with 1; see above")


def told(*options: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "appliance.packaging.root", *options]
    env = {**os.environ, **environment}
    return subprocess.run(command, capture_output=True, text=True, env=env)


def test_a_tree_is_removed_and_what_its_links_lead_to_stays(tmp_path: Path) -> None:
    tree, elsewhere = tmp_path / "tree", tmp_path / "elsewhere"
    (tree / "in/there").mkdir(parents=True)
    elsewhere.mkdir()
    (elsewhere / "precious").touch()
    (tree / "in/link").symlink_to(elsewhere)
    remove(tree)
    remove(tree)  # there is none any more
    assert not tree.exists() and (elsewhere / "precious").exists()


@as_root
@pytest.mark.parametrize("mounted", ["tree", "tree/in/dev", "tree/in/a folder\twith\\blanks"])
def test_a_tree_with_something_mounted_below_is_not_removed(tmp_path: Path, mounted: str) -> None:
    place = tmp_path / mounted
    place.mkdir(parents=True)
    (tmp_path / "tree/other").touch()
    link = tmp_path / "link"
    link.symlink_to(tmp_path)
    for tree in (tmp_path / "tree", link / "tree"):
        enter = ["unshare", "--mount", "--propagation", "private", sys.executable, "-c", MOUNTED]
        done = subprocess.run([*enter, place, tree], capture_output=True, text=True, check=True)
        assert done.stdout.endswith("True\n"), done.stdout
        assert f"something is mounted: umount {place}" in done.stdout
        assert (tmp_path / "tree/other").exists(), "nothing of it is removed"


def test_a_link_is_not_removed(tmp_path: Path) -> None:
    (tmp_path / "precious").mkdir()
    (tmp_path / "root").symlink_to(tmp_path / "precious")
    with pytest.raises(BuildError, match="it is a link to"):
        remove(tmp_path / "root")
    assert (tmp_path / "precious").exists()


def test_what_is_made_is_kept_until_it_is_made_of_something_else(tmp_path: Path) -> None:
    kept, made = Root(tmp_path, root.MIRROR, False, HERE), tmp_path / "made"
    runs: list[str] = []

    def make() -> None:
        assert not list(made.iterdir()), "what was left of another is gone"
        runs.append("made")
        (made / "file").touch()

    def fail() -> None:
        make()
        raise BuildError("cut off")

    kept._make(made, ["one"], make)
    kept._make(made, ["one"], make)
    assert len(runs) == 1
    with pytest.raises(BuildError):
        kept._make(made, ["two"], fail)
    kept._make(made, ["one"], make)
    assert len(runs) == 3, "what was cut off in between is made again"
    remove(made)
    kept._make(made, ["one"], make)
    assert len(runs) == 4, "what somebody has removed is made again"


@pytest.fixture
def mirror(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Root]:
    """A computer whose apt lists these versions of each source and can fetch the last of them."""

    def make(*versions: str) -> Root:
        commands = tmp_path / "bin"
        commands.mkdir()
        shown = "".join(f"Package: each\\nVersion: {version}\\n\\n" for version in versions)
        scripts = {
            "apt-get": f'case "$*" in *={versions[-1] if versions else ""}) touch fetched ;; '
            '*" source "*) exit 100 ;; esac',
            "apt-cache": f"printf '{shown}'",
        }
        for name, script in scripts.items():
            (commands / name).write_text(f"#!/bin/sh\n{script}\n")
            (commands / name).chmod(0o755)
        monkeypatch.setenv("PATH", f"{commands}:{os.environ['PATH']}")
        (tmp_path / "cache").mkdir()
        return Root(tmp_path / "cache", root.MIRROR, False, HERE)

    return make


def test_the_newest_source_that_can_be_fetched(
    mirror: Callable[..., Root], capfd: pytest.CaptureFixture[str]
) -> None:
    found = mirror("3.5.10-1", "3.5.9-1~deb13u1", "3.5.9-1", "3.0.2-1", "3.5.7-1")._fetch_sources()
    assert found == [f"{name} 3.5.7-1" for name in root.SOURCES]
    tried = [line.split()[2] for line in capfd.readouterr().err.splitlines() if "openssl 3" in line]
    assert tried == ["3.5.10-1", "3.5.9-1", "3.5.9-1~deb13u1"], "in Debian's order"


def test_a_mirror_without_the_sources(mirror: Callable[..., Root]) -> None:
    with pytest.raises(BuildError, match="has no source of openssl: is it a mirror of Debian"):
        mirror()._fetch_sources()


@pytest.mark.skipif(not root.KEYRING.exists(), reason="apt install debian-archive-keyring")
def test_a_mirror_that_cannot_be_reached(tmp_path: Path) -> None:
    with pytest.raises(BuildError, match="apt-get failed with 100"):
        Root(tmp_path, "http://127.0.0.1:9/debian", False, HERE)._fetch_sources()


@pytest.mark.skipif(not root.KEYRING.exists(), reason="apt install debian-archive-keyring")
def test_a_mirror_that_nobody_has_signed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for place in ("debian/dists/{}", "debian-security/dists/{}-security"):
        for suite in root.SOURCE_SUITES:
            folder = tmp_path / place.format(suite)
            (folder / "main/source").mkdir(parents=True)
            (folder / "main/source/Sources").write_text("Package: openssl\nVersion: 9\n")
            (folder / "Release").write_text(f"Suite: {suite}\nCodename: {suite}\n")
    with pytest.raises(BuildError, match="apt-get failed with 100"):
        Root(tmp_path, f"file://{tmp_path}/debian", False, HERE)._fetch_sources()
    assert "is not signed" in capfd.readouterr().err


def test_a_computer_without_the_tools(tmp_path: Path) -> None:
    done = told("--cache", tmp_path / "cache", PATH="/nowhere")
    assert done.returncode == 1
    assert "apt install apt bubblewrap dpkg git mmdebstrap util-linux" in done.stderr
    assert not (tmp_path / "cache").exists()


def test_somebody_who_is_not_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(root, "TOOLS", {})
    monkeypatch.setattr(root, "KEYRING", Path(__file__))
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(BuildError, match="use sudo"):
        root.check_computer(HERE)


def test_a_computer_that_emulates_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(emulation, "RULES", tmp_path)
    with pytest.raises(BuildError, match=r"apt install.* qemu-user-static"):
        root.check_computer(OTHER)
    assert emulation.missing(HERE) == []


def test_programs_of_another_kind_that_do_not_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """An old Linux without qemu as the interpreter: the root is there, and nothing of it runs."""
    other = Root(tmp_path, root.MIRROR, False, OTHER)
    monkeypatch.setattr(root, "_run", fails)
    with pytest.raises(BuildError, match=f"programs for {OTHER} do not run here: that takes Linux"):
        other._make_python()


def test_a_root_without_the_security_updates_is_made_again_and_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a mirror that lists them and does not have them."""
    made: list[tuple[str, ...]] = []

    def run(*command: str | Path) -> None:
        assert not (tmp_path / "root").exists()
        (tmp_path / "root/etc").mkdir(parents=True)
        (tmp_path / "root/etc/ssl").mkdir()
        made.append(tuple(map(str, command)))
        if any("security" in each for each in made[-1]):
            raise BuildError("mmdebstrap failed with 25")

    monkeypatch.setattr(root, "_run", run)
    Root(tmp_path, root.MIRROR, False, HERE)._make_root()
    assert len(made) == 2 and made[1] == made[0][:-1]
    assert "without security updates, which could not be fetched" in capsys.readouterr().err
    assert (tmp_path / root.OUTDATED).exists(), "so that a release says it each time"
    shutil.rmtree(tmp_path / "root")
    monkeypatch.setattr(root, "_run", lambda *_: (tmp_path / "root/etc/ssl").mkdir(parents=True))
    Root(tmp_path, root.MIRROR, False, HERE)._make_root()
    assert not (tmp_path / root.OUTDATED).exists()


def test_the_tools_for_another_kind_have_their_usual_names(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made = tmp_path / "root"
    (made / "usr/bin").mkdir(parents=True)
    for name in (f"{OTHER}-linux-gnu-gcc", f"{OTHER}-linux-gnu-strip", "gcc"):
        (made / "usr/bin" / name).touch()
    other = Root(tmp_path, root.MIRROR, False, OTHER)
    other._make_cross_tools()
    tools = {each.name: each for each in (made / "opt/cross").iterdir()}
    assert sorted(tools) == ["cc", "gcc", "ldd", "strip"]
    assert tools["gcc"].readlink() == Path(f"/usr/bin/{OTHER}-linux-gnu-gcc")
    assert f"/lib/ld-linux-{OTHER}.so.1 --list" in tools["ldd"].read_text()
    command = [*map(str, other._inside([], ["gcc"]))]
    path = command[len(command) - command[::-1].index("PATH")]
    assert path.startswith("/opt/cross:/usr/local/bin:")
    assert "zlib1g-dev:arm64" in other._packages() or OTHER != "aarch64"


def test_two_builds_in_one_folder(tmp_path: Path) -> None:
    with (tmp_path / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(BuildError, match="another build is using"), root._alone(tmp_path):
            pass
    with root._alone(tmp_path):
        pass


def test_the_copy_of_the_project_is_what_git_would_take(tmp_path: Path) -> None:
    copy = Root(tmp_path, root.MIRROR, False, HERE)._copy_project()
    assert (copy / "appliance/packaging/root.py").read_bytes() == Path(root.__file__).read_bytes()
    assert not list(copy.rglob("__pycache__")) and not list((copy / ".venv").iterdir())


@pytest.mark.skipif(os.geteuid() != 0, reason="root alone maps all users")
def test_a_namespace_that_cannot_be_made_is_a_failure(tmp_path: Path) -> None:
    """And nothing waits for it: neither what is left behind nor who reads the output."""
    (tmp_path / "unshare").write_text("#!/bin/sh\necho not permitted >&2; exit 1\n")
    (tmp_path / "unshare").chmod(0o755)
    other = next(each for each in emulation.ARCHITECTURES if each != os.uname().machine)
    done = subprocess.run(
        [*emulation.prefix(other), "true"],
        env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        timeout=30,
    )
    assert (done.returncode, done.stderr) == (1, "not permitted\n")


@pytest.mark.skipif(os.geteuid() != 0, reason="root alone maps all users")
def test_in_its_namespace_there_are_all_users(tmp_path: Path) -> None:
    other = next(each for each in emulation.ARCHITECTURES if each != os.uname().machine)
    if not (emulation.RULES / f"qemu-{other}.conf").exists():
        pytest.skip("needs qemu's rules: apt install qemu-user-static")
    script = "chown 8883:33 x && stat -c %u:%g x && exit 7"
    (tmp_path / "x").touch()
    command = [*emulation.prefix(other), "sh", "-c", script]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stdout) == (7, "8883:33\n"), done.stderr
    assert (tmp_path / "x").stat().st_uid == 8883
