"""Commands of root, where the configuration, or a file that it names, belongs to another user."""

from __future__ import annotations

import builtins
import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from waiting import PATIENCE

from appliance import certs
from appliance.cli import main as cli
from appliance.host.owners import OwnerError, acting_as_caller, acting_for, owner_of

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="only root can be another user")

SERVICE = 64321  # a user that this computer does not know

VICTIM = "root:$argon2id$v=19$m=8,t=1,p=1$c2FsdHNhbHQ$AAAAAAAAAAAAAAAAAAAAAA\n"


@pytest.fixture
def folder() -> Iterator[Path]:
    """Where every user may look, which `tmp_path` is not."""
    path = Path(tempfile.mkdtemp(dir="/tmp"))
    path.chmod(0o755)
    yield path
    shutil.rmtree(path)


@pytest.fixture
def etc(folder: Path) -> Path:
    """A folder of root's, with a file that nobody else may write."""
    etc = folder / "etc"
    etc.mkdir()
    (etc / "shadow").write_text(VICTIM)
    (etc / "shadow").chmod(0o600)
    return etc


@pytest.fixture
def home(folder: Path) -> Path:
    """The service's folder, as `appliance init` fills it."""
    home = folder / "home"
    assert run("init", "--dir", str(home), "--robot", "r2d2") == 0
    give(home)
    return home


def audit(file: Path, log: str) -> None:
    """Turn on the audit log in a configuration that `init` has made."""
    line = f"\nbroker:\n  audit: {{path: {log}}}"
    file.write_text(file.read_text().replace("\nbroker:", line, 1))


def give(path: Path) -> None:
    for each in (path, *path.rglob("*")):
        os.chown(each, SERVICE, SERVICE, follow_symlinks=False)


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        cli.main(list(arguments))
    assert (os.geteuid(), os.getegid()) == (0, 0)
    return int(ended.value.code or 0)


def test_root_writes_as_the_owner_of_the_configuration(home: Path) -> None:
    password = home.parent / "password"
    password.write_text("secret\n")
    password.chmod(0o600)  # what root names on the command line is read as root
    where = ["-c", str(home / "appliance.yaml")]
    assert run("user", "add", "bob", *where, "--password-file", str(password)) == 0
    assert run("cert", "issue", "tablet", *where) == 0
    key = home.parent / "ca.key"
    (home / "certs/ca.key").rename(key)
    os.chown(key, 0, 0)
    assert run("cert", "revoke", "tablet", *where, "--ca-key", str(key)) == 0
    for path in home.rglob("*"):
        assert path.stat().st_uid == SERVICE, path


@pytest.mark.parametrize(
    "command",
    [
        "user add bob --generate",
        "user add bob --scram --generate",
        "user add bob --group viewers --generate",
        "user passwd operator --generate",
        "cert issue tablet --pkcs12 --bundle --generate",
        "cert renew all",
        "cert crl",
    ],
)
def test_what_is_loaded_late_is_found(home: Path, command: str) -> None:
    """In a process of its own: Python may be installed where only root can read."""
    appliance = [sys.executable, "-m", "appliance"]
    done = subprocess.run(
        [*appliance, *command.split(), "-c", str(home / "appliance.yaml")],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("fails", [False, True])
def test_modules_that_only_root_can_read_are_imported(
    home: Path, etc: Path, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    """As those are that the one file unpacks for root."""
    etc.chmod(0o700)
    (etc / "loaded_late.py").write_text("import os\nuser = os.geteuid()\n")
    (etc / "fails_late.py").write_text("raise ImportError('broken')\n")
    monkeypatch.syspath_prepend(str(etc))
    load = builtins.__import__
    with contextlib.suppress(ZeroDivisionError), acting_for(home):
        import loaded_late  # type: ignore[import-not-found]

        assert loaded_late.user == 0
        with pytest.raises(ImportError, match="broken"):
            import fails_late  # type: ignore[import-not-found]  # noqa: F401
        assert os.geteuid() == SERVICE
        with pytest.raises(PermissionError):
            (etc / "shadow").read_text()
        if fails:
            raise ZeroDivisionError
    assert os.geteuid() == 0 and builtins.__import__ is load
    monkeypatch.delitem(sys.modules, "loaded_late")


def test_links_lead_root_nowhere(home: Path, etc: Path) -> None:
    """The service's user puts them where root's next command writes."""
    where = ["-c", str(home / "appliance.yaml")]
    audit(home / "appliance.yaml", "audit.log")
    for name in ("users.passwd", "audit.log"):
        (home / name).unlink(missing_ok=True)
        (home / name).symlink_to(etc / "shadow")
    give(home)
    assert run("user", "add", "bob", *where, "--generate") == 1
    (home / "users.passwd").unlink()
    assert run("user", "add", "bob", *where, "--generate") == 0  # and the log stays without it
    shutil.rmtree(home / "certs/clients", ignore_errors=True)
    (home / "certs/clients").symlink_to(etc)
    assert run("cert", "issue", "tablet", *where) == 1
    (home / "state").mkdir()
    (home / "state/store.db.lock").symlink_to(etc / "lock")
    shutil.copy("/dev/null", home / "state/store.db")
    give(home)
    assert run("store", "prune", "--client", "x", *where) == 1
    assert run("init", "--dir", str(home)) == 0
    assert sorted(path.name for path in etc.iterdir()) == ["shadow"]
    assert (etc / "shadow").read_text() == VICTIM


def test_a_log_in_the_services_folder_is_written_as_its_user(folder: Path, etc: Path) -> None:
    """The configuration is root's; what lies under /var/lib is not."""
    state, robot = folder / "state", folder / "robot"
    state.mkdir()
    assert run("init", "--dir", str(robot), "--robot", "r2d2") == 0
    audit(robot / "appliance.yaml", f"{state}/logs/audit.log")
    (state / "logs").mkdir()
    log = state / "logs/audit.log"
    log.touch()
    give(state)
    where = ["-c", str(robot / "appliance.yaml")]
    assert run("user", "add", "ann", *where, "--generate") == 0
    assert '"user": "ann"' in log.read_text()
    log.unlink()
    log.symlink_to(etc / "shadow")
    assert run("user", "add", "bob", *where, "--generate") == 0
    log.unlink()
    log.parent.rmdir()
    log.parent.symlink_to(etc)  # a folder on the way will do as well
    (etc / "audit.log").write_text("")
    assert run("user", "add", "eve", *where, "--generate") == 0
    assert (etc / "audit.log").read_text() == ""
    assert (etc / "shadow").read_text() == VICTIM


def test_whose_a_path_is(folder: Path, etc: Path) -> None:
    assert owner_of(etc / "none") == owner_of(etc / "shadow") == 0
    (folder / "link").symlink_to(folder / "theirs")
    (folder / "theirs").mkdir()
    give(folder / "theirs")
    assert owner_of(folder / "link/x/y") == SERVICE
    etc.chmod(0o777)
    with pytest.raises(OwnerError, match="chmod go-w"):
        owner_of(etc / "shadow")
    with acting_for(folder / "theirs/x"):
        assert (os.geteuid(), os.getegid(), os.getgroups()) == (SERVICE, SERVICE, [])
        with pytest.raises(PermissionError):
            (etc / "shadow").read_text()
        with acting_as_caller():
            assert (etc / "shadow").read_text() == VICTIM
        assert os.geteuid() == SERVICE
        assert certs  # loaded while root: nothing is imported as another user
    assert (os.geteuid(), os.getegid()) == (0, 0)


def test_check_says_what_only_root_can_read(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    secret = home / "fleet.password"
    secret.touch(0o600)
    secret.write_text("hunter2")
    with (home / "appliance.yaml").open("a") as file:
        file.write(
            "\nupstreams: [{name: fleet, servers: [mqtts://a], "
            "login: {username: a, password_file: fleet.password}}]\n"
        )
    capsys.readouterr()
    assert run("check", "-c", str(home / "appliance.yaml")) == 1
    said = f"{secret}: it belongs to root; the appliance runs as {SERVICE} and cannot read it"
    assert said in capsys.readouterr().out
    give(secret)
    run("check", "-c", str(home / "appliance.yaml"))
    assert "cannot read it" not in capsys.readouterr().out
