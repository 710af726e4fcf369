"""`appliance install` into an image, the unit as systemd reads it, and the Debian package."""

from __future__ import annotations

import errno
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from appliance.cli.install import install as install_command
from appliance.config import load
from appliance.ops.init import Credentials
from appliance.ops.install import InstallError, ServiceInstaller
from appliance.ops.unit import Unit
from appliance.packaging.symbols import examine

PROJECT = Path(__file__).resolve().parent.parent.parent
COMMAND = Path("usr/local/bin/appliance")
UNIT = Path("etc/systemd/system/appliance.service")
UID = 4321

as_root = pytest.mark.skipif(
    os.geteuid() != 0, reason="gives files to another user, as root only may"
)


@pytest.fixture
def image(tmp_path: Path) -> Path:
    """As much of a system as `useradd` wants."""
    root = tmp_path / "image"
    (root / "etc").mkdir(parents=True)
    for name in ("passwd", "group", "shadow", "gshadow"):
        (root / "etc" / name).touch()
    (root / "etc/passwd").write_text(f"robot:x:{UID}:{UID}::/home/robot:/bin/sh\n")
    (root / "etc/group").write_text(f"drivers:x:{UID}:\n")
    return root


def single_file(directory: Path, version: int = 1) -> Path:
    path = directory / f"appliance-{version}"
    path.write_text(f"#!/bin/sh\necho {version}\n")
    return path


def install(image: Path, source: Path, **options: object) -> dict[str, str]:
    """What was done, by the thing that it was done to."""
    steps = list(ServiceInstaller(Path("/", COMMAND), source, image, **options).install())  # type: ignore[arg-type]
    return {step.subject: step.verb for step in steps if not isinstance(step, Credentials)}


@as_root
def test_into_an_image_and_again(image: Path, tmp_path: Path) -> None:
    done = install(image, single_file(tmp_path), robot="r2d2")
    assert set(done.values()) == {"made"}
    uid = int(
        next(
            line.split(":")[2]
            for line in (image / "etc/passwd").read_text().splitlines()
            if line.startswith("appliance:")
        )
    )
    home = image / "etc/appliance"
    key = home / "certs/server.key"
    for path in (home, key, home / "users.passwd", home / "appliance.yaml"):
        assert path.stat().st_uid == uid, path
    assert stat.S_IMODE(home.stat().st_mode) == 0o750 and stat.S_IMODE(key.stat().st_mode) == 0o600
    assert (image / "var/lib/appliance").stat().st_uid == uid
    settings = load(home / "appliance.yaml")
    assert settings.robot == "r2d2"
    assert settings.broker.store.path == Path("/var/lib/appliance/store.db")
    assert settings.control == Path("/run/appliance/control.sock")
    assert settings.crash_reports == Path("/var/lib/appliance/crashes")
    enabled = image / "etc/systemd/system/multi-user.target.wants/appliance.service"
    assert enabled.readlink() == Path("/", UNIT)

    (home / "acl.conf").write_text("# mine\n")
    (image / "etc/default/appliance").write_text("ROS_DOMAIN_ID=7\n")
    before = {path: path.read_bytes() for path in home.rglob("*") if path.is_file()}
    done = install(image, single_file(tmp_path, 2))
    assert done.pop("/usr/local/bin/appliance") == "replaced"
    assert set(done.values()) == {"kept"}
    assert (image / COMMAND).read_text() == single_file(tmp_path, 2).read_text()
    assert os.access(image / COMMAND, os.X_OK)
    assert {path: path.read_bytes() for path in home.rglob("*") if path.is_file()} == before
    assert [path.name for path in (image / COMMAND).parent.iterdir()] == ["appliance"]

    done = install(image, single_file(tmp_path, 2), user="robot")
    assert done["/etc/systemd/system/appliance.service"] == "replaced"
    unit = (image / UNIT).read_text()
    assert "User=robot\nGroup=drivers\n" in unit and "FASTDDS_BUILTIN_TRANSPORTS" not in unit
    assert {path.stat().st_uid for path in before} == {UID}
    assert key.stat().st_uid == (image / "var/lib/appliance").stat().st_uid == UID
    install(image, single_file(tmp_path, 3))
    assert "User=robot" in (image / UNIT).read_text(), "an upgrade keeps the user"

    list(ServiceInstaller(Path("/", COMMAND), root=image).uninstall())
    assert not (image / COMMAND).exists() and not (image / UNIT).exists()
    assert not enabled.is_symlink()
    assert {path: path.read_bytes() for path in before} == before
    list(ServiceInstaller(Path("/", COMMAND), root=image).uninstall(purge=True))
    assert not home.exists() and not (image / "var/lib/appliance").exists()
    assert list(ServiceInstaller(Path("/", COMMAND), root=image).uninstall(purge=True)) == []


@as_root
def test_a_link_is_not_followed(image: Path, tmp_path: Path) -> None:
    """What the service's user has put into its folder must not make root give anything away."""
    secret = tmp_path / "shadow"
    secret.touch()
    home = image / "etc/appliance"
    home.mkdir()
    (home / "link").symlink_to(secret)
    os.link(secret, home / "hard")
    install(image, single_file(tmp_path))
    assert secret.stat().st_uid == os.geteuid()


@as_root
@pytest.mark.parametrize(
    "place", ["usr/local/bin", "etc/systemd/system", "etc/default", "run", "var/lib"]
)
def test_an_image_does_not_lead_out_of_itself(image: Path, tmp_path: Path, place: str) -> None:
    """A link in it with a path from the top means the image's own, and led to this computer's."""
    outside = tmp_path / "outside"
    outside.mkdir()
    (image / place).parent.mkdir(parents=True, exist_ok=True)
    (image / place).symlink_to(outside)
    with pytest.raises(InstallError, match=f"leads out of {image}, to {outside}"):
        install(image, single_file(tmp_path))
    assert list(outside.iterdir()) == [] and not (image / "etc/appliance").exists()


@as_root
@pytest.mark.parametrize("line", [b"\n", b"+\n", b"jos\xe9:x:1:1:Jos\xe9:/:\n"])
def test_odd_lines_in_a_list_of_users(image: Path, tmp_path: Path, line: bytes) -> None:
    for name in ("passwd", "group"):
        file = image / "etc" / name
        file.write_bytes(line + file.read_bytes())
    install(image, single_file(tmp_path), user="robot")
    assert "User=robot\nGroup=drivers\n" in (image / UNIT).read_text()


@as_root
def test_one_that_looks_as_another_ends(
    image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also when the first ends just between the steps of the second's look at its lock."""
    first, second = (ServiceInstaller(Path("/", COMMAND), root=image)._alone() for _ in range(2))
    first.__enter__()
    with pytest.raises(InstallError, match=r"another .* is at work"):
        install(image, single_file(tmp_path))

    def end_first(descriptor: int, how: int) -> None:
        monkeypatch.undo()
        first.__exit__(None, None, None)

    monkeypatch.setattr("fcntl.flock", end_first)
    with pytest.raises(InstallError, match=r"another .* is at work"), second:
        pass
    install(image, single_file(tmp_path))


@as_root
def test_root_makes_nothing_where_the_service_says(image: Path, tmp_path: Path) -> None:
    """The service may write its configuration, which must not lead an upgrade elsewhere."""
    install(image, single_file(tmp_path))
    home, outside = image / "etc/appliance", tmp_path / "cron.d"
    outside.mkdir()
    settings = yaml.safe_load((home / "appliance.yaml").read_text())
    settings["broker"] = {"acl": f"{outside}/acl", "users": f"{outside}/users"}
    (home / "appliance.yaml").write_text(yaml.safe_dump(settings))
    (home / "certs/server.crt").unlink()
    (home / "certs").rename(home / "before")
    (home / "certs").symlink_to(outside)
    install(image, single_file(tmp_path, 2))
    assert list(outside.iterdir()) == []
    (home / "appliance.yaml").unlink()
    with pytest.raises(InstallError, match=r"without an appliance\.yaml"):
        install(image, single_file(tmp_path, 3))


@as_root
def test_cut_off_while_it_hands_over(
    image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chown, left = os.chown, [3]

    def cut_off(*arguments: Any, **options: Any) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise OSError("the power went")
        chown(*arguments, **options)

    monkeypatch.setattr(os, "chown", cut_off)
    with pytest.raises(OSError, match="the power went"):
        install(image, single_file(tmp_path))
    monkeypatch.undo()
    install(image, single_file(tmp_path))
    home = image / "etc/appliance"
    assert {path.stat().st_uid for path in (home, *home.rglob("*"))} == {home.stat().st_uid}
    assert home.stat().st_uid != os.geteuid()


@as_root
def test_an_upgrade_of_the_package_keeps_the_user_of_the_units_changes(
    image: Path, tmp_path: Path
) -> None:
    """What README says: `systemctl edit` with another user, and its files handed to that."""

    def configure() -> None:
        list(ServiceInstaller(Path("/usr/bin/appliance"), root=image, packaged=True).install())

    configure()
    changes = image / "etc/systemd/system/appliance.service.d/override.conf"
    changes.parent.mkdir(parents=True)
    changes.write_text("[Service]\nUser=robot\nGroup=robot\n")
    folders = image / "etc/appliance", image / "var/lib/appliance"
    files = [path for folder in folders for path in (folder, *folder.rglob("*"))]
    for path in files:
        os.chown(path, UID, UID)
    configure()
    assert {path.stat().st_uid for path in files} == {UID}


@as_root
def test_a_folder_that_is_a_link(image: Path, tmp_path: Path) -> None:
    """A system that is mounted read-only has its configuration on another disk."""
    disk = image / "data"
    disk.mkdir()
    (image / "etc/appliance").symlink_to("../data")
    install(image, single_file(tmp_path))
    assert {path.stat().st_uid for path in (disk, *disk.rglob("*"))} == {disk.stat().st_uid}
    assert disk.stat().st_uid != os.geteuid()
    steps = list(ServiceInstaller(Path("/", COMMAND), root=image).uninstall(purge=True))
    assert [step.text for step in steps if step.subject == "/etc/appliance"] == [
        f"the link; configuration, users, certificates and keys stay in {disk}"
    ]
    assert (disk / "appliance.yaml").exists()

    (image / "etc/appliance").symlink_to(tmp_path)
    with pytest.raises(InstallError, match="leads out of"):
        install(image, single_file(tmp_path))


@as_root
def test_two_at_once(image: Path, tmp_path: Path) -> None:
    first = ServiceInstaller(Path("/", COMMAND), single_file(tmp_path), image).install()
    next(first)
    with pytest.raises(InstallError, match="another `appliance install` is at work"):
        install(image, single_file(tmp_path, 2))
    with pytest.raises(InstallError, match="another `appliance install` is at work"):
        list(ServiceInstaller(Path("/", COMMAND), root=image).uninstall())
    list(first)
    install(image, single_file(tmp_path, 2))


@as_root
def test_interrupted_it_is_as_before(
    image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C while the new version is started, which may not run at all."""
    install(image, single_file(tmp_path))

    def interrupted(self: ServiceInstaller) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ServiceInstaller, "_starts", True)
    monkeypatch.setattr(ServiceInstaller, "_restart", interrupted)
    with pytest.raises(KeyboardInterrupt):
        install(image, single_file(tmp_path, 2))
    assert (image / COMMAND).read_text() == single_file(tmp_path).read_text()
    assert [path.name for path in (image / COMMAND).parent.iterdir()] == ["appliance"]


@as_root
def test_interrupted_at_the_restart_the_version_before_is_started(
    image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """systemd goes on with what it was told, and would run a version that is not there any more."""
    install(image, single_file(tmp_path))
    restarted: list[str] = []

    def systemctl(self: ServiceInstaller, *arguments: str) -> None:
        if arguments[0] == "restart":
            restarted.append((image / COMMAND).read_text())
            if len(restarted) == 1:
                raise KeyboardInterrupt

    monkeypatch.setattr(ServiceInstaller, "_starts", True)
    monkeypatch.setattr(ServiceInstaller, "_systemctl", systemctl)
    with pytest.raises(KeyboardInterrupt):
        install(image, single_file(tmp_path, 2))
    assert restarted == [single_file(tmp_path, 2).read_text(), single_file(tmp_path).read_text()]


@as_root
def test_a_full_disk(image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is told of the file that could not be written, not of the one that was read."""
    install(image, single_file(tmp_path))

    def full(source: Path, target: Path) -> None:
        target.write_text("#!/b")
        raise OSError(28, "No space left on device", str(source))

    monkeypatch.setattr("shutil.copyfile", full)
    with pytest.raises(InstallError, match=f"{image / COMMAND} cannot be written: No space left"):
        install(image, single_file(tmp_path, 2))
    assert (image / COMMAND).read_text() == single_file(tmp_path).read_text()
    assert [path.name for path in (image / COMMAND).parent.iterdir()] == ["appliance"]


@as_root
def test_the_variables_are_not_for_everyone(image: Path, tmp_path: Path) -> None:
    install(image, single_file(tmp_path))
    assert not (image / "etc/default/appliance").stat().st_mode & 0o007


@pytest.mark.parametrize("setup", ["/nowhere/setup.sh", ""])
def test_it_starts_without_the_ros_that_it_had(tmp_path: Path, setup: str) -> None:
    lines = str(Unit(tmp_path / "appliance")).replace("\\\n", " ").splitlines()
    command = next(line for line in lines if line.startswith("ExecStart=")).partition("=")[2]
    (tmp_path / "appliance").write_text('#!/bin/sh\necho "ran $1"\n')
    (tmp_path / "appliance").chmod(0o755)
    done = subprocess.run(
        shlex.split(command.replace("$$", "$")),
        env={"ROS_SETUP": setup},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "ran run\n"
    assert done.stderr == (f"<4>ROS_SETUP cannot be read: {setup}\n" if setup else "")


def test_a_dry_run_changes_nothing(image: Path, tmp_path: Path) -> None:
    before = sorted(image.rglob("*"))
    done = install(image, single_file(tmp_path), dry_run=True)
    assert done["appliance"] == done["/etc/appliance"] == "made"
    assert sorted(image.rglob("*")) == before


@as_root
def test_for_several_robots_no_keys_are_made(image: Path, tmp_path: Path) -> None:
    install(image, single_file(tmp_path), initialise=False)
    assert (image / UNIT).exists() and not (image / "etc/appliance").exists()


def test_what_is_in_the_way_is_told(image: Path, tmp_path: Path) -> None:
    def error(*arguments: object, **options: object) -> str:
        with pytest.raises(InstallError) as raised:
            list(ServiceInstaller(*arguments, dry_run=True, **options).install())  # type: ignore[arg-type]
        return str(raised.value)

    file = single_file(tmp_path)
    assert "there is no user nobody-here" in error(
        Path("/", COMMAND), file, image, user="nobody-here"
    )
    assert "there is no directory" in error(Path("/", COMMAND), file, image / "none")
    assert "would not be there for the service" in error(Path("/tmp/venv/bin/appliance"))
    assert "use the single file" in error(Path("/opt/venv/bin/appliance"), None, image)
    packaged = image / "usr/lib/systemd/system/appliance.service"
    packaged.parent.mkdir(parents=True)
    packaged.touch()
    assert "apt upgrades and removes it" in error(Path("/", COMMAND), file, image)


def test_the_command_keeps_the_user_of_before(
    image: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (image / UNIT).parent.mkdir(parents=True)
    (image / UNIT).write_text("[Service]\nUser=robot\n")
    (image / "opt").mkdir()
    (image / "opt/appliance").touch()
    monkeypatch.setattr(sys, "argv", ["/opt/appliance"])
    install_command(dry_run=True, root=image)
    assert "\nUser=robot\nGroup=drivers\n" in capsys.readouterr().out


def run_script(image: Path, name: str, *arguments: str, fails: str = "") -> list[str]:
    """A script of the package with `image` in place of /; returns the commands that it called.

    `fails` is a program that does. Raises CalledProcessError when the script does.
    """
    called = image / "called"
    called.unlink(missing_ok=True)
    programs = image / "programs"
    programs.mkdir(exist_ok=True)
    text = (PROJECT / "appliance/packaging/debian" / name).read_text()
    for folder in ("/etc/", "/usr/", "/var/", "/run/"):
        text = text.replace(folder, f"{image}{folder}")
    for program in ("appliance", "deb-systemd-helper", "deb-systemd-invoke", "systemctl"):
        for place in (programs / program, image / "usr/bin" / program):
            place.parent.mkdir(parents=True, exist_ok=True)
            code = int(program == fails)
            place.write_text(f'#!/bin/sh\necho "$0 $@" >> {called}\nexit {code}\n')
            place.chmod(0o755)
    environment = {"PATH": f"{programs}:/usr/bin:/bin"}
    subprocess.run(["sh", "-c", text, name, *arguments], env=environment, check=True)
    lines = called.read_text().splitlines() if called.exists() else []
    return [line.removeprefix(f"{image}/") for line in lines]


@as_root
def test_a_disk_that_is_mounted_there_does_not_keep_it_from_being_purged(
    image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    programs, data = image / "programs", image / "var/lib/appliance"
    programs.mkdir()
    busy = f'#!/bin/sh\ncase "$*" in *{data}) exit 1;; esac\nexec /bin/rm "$@"\n'
    (programs / "rm").write_text(busy)
    (programs / "rm").chmod(0o755)
    for folder in (image / "etc/appliance", data):
        folder.mkdir(parents=True)
    run_script(image, "postrm", "purge")
    assert not (image / "etc/appliance").exists()

    install(image, single_file(tmp_path))
    (data / "store.db").touch()
    rmdir = os.rmdir

    def refuse(path: Any, **options: Any) -> None:
        if str(path) == str(data):
            raise OSError(errno.EBUSY, "Device or resource busy")
        rmdir(path, **options)

    monkeypatch.setattr(os, "rmdir", refuse)
    list(ServiceInstaller(Path("/", COMMAND), root=image).uninstall(purge=True))
    assert list(data.iterdir()) == [] and not (image / "etc/default/appliance").exists()


def test_the_package_runs_its_own_command(image: Path) -> None:
    """An older one that was installed by hand comes first in the PATH."""
    assert run_script(image, "postinst", "configure")[0] == "usr/bin/appliance install --packaged"
    called = run_script(image, "postinst", "abort-upgrade")
    assert called and not [line for line in called if "install --packaged" in line]


def test_an_upgrade_with_a_mistake_in_the_configuration_leaves_dpkg_whole(image: Path) -> None:
    (image / "run/systemd/system").mkdir(parents=True)
    restart = "programs/deb-systemd-invoke restart appliance.service"
    assert restart in run_script(image, "postinst", "configure", "0.1.0")
    called = run_script(image, "postinst", "configure", "0.1.0", fails="appliance")
    assert "programs/systemctl --system daemon-reload" in called
    assert restart not in called, "what runs is the version before, with what it has read"
    with pytest.raises(subprocess.CalledProcessError):
        run_script(image, "postinst", "configure", "", fails="appliance")


def test_to_purge_the_package_leaves_what_was_installed_by_hand_since(image: Path) -> None:
    folders = image / "etc/appliance", image / "var/lib/appliance"
    for folder in folders:
        folder.mkdir(parents=True)
    unit = image / UNIT
    unit.parent.mkdir(parents=True)
    unit.write_text("[Service]\n")
    run_script(image, "postrm", "purge")
    assert all(folder.exists() for folder in folders)
    unit.unlink()
    unit.symlink_to("/dev/null")  # the mask that the package's removal leaves
    run_script(image, "postrm", "remove")
    assert all(folder.exists() for folder in folders)
    run_script(image, "postrm", "purge")
    assert not any(folder.exists() for folder in folders)
    run_script(image, "postrm", "purge")


@as_root
def test_what_a_sourced_ros_says_is_taken_over(image: Path, tmp_path: Path) -> None:
    shell = {"ROS_DOMAIN_ID": "7", "ROS_DISTRO": "nowhere", "RMW_IMPLEMENTATION": "a\nb"}
    install(image, single_file(tmp_path), environment=shell)
    lines = (image / "etc/default/appliance").read_text().splitlines()
    assert [line for line in lines if line and line[0] != "#"] == ["ROS_DOMAIN_ID=7"]


def analyze(unit: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["systemd-analyze", *arguments, unit], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.mark.parametrize("user", ["appliance", "robot"])
def test_systemd_understands_the_unit(tmp_path: Path, user: str) -> None:
    command = tmp_path / "the 50% $HOME/appliance"
    command.parent.mkdir()
    command.write_text("#!/bin/sh\n")
    command.chmod(0o755)
    file = tmp_path / "appliance.service"
    file.write_text(str(Unit(command, user, user)))
    assert analyze(file, "verify") == ""
    rated = analyze(file, "security", "--offline=true")
    exposure = re.search(r"exposure level for appliance.service: ([\d.]+)", rated)
    assert exposure is not None and float(exposure[1]) < 3.0, rated


def test_the_debian_package(tmp_path: Path) -> None:
    program = Path(shutil.which("true") or "")
    built = subprocess.run(
        [
            sys.executable,
            "-m",
            "appliance.packaging.deb",
            program,
            "--directory",
            tmp_path,
        ],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        check=True,
    )
    package = Path(built.stdout.strip())
    assert re.fullmatch(r"appliance_[\w.~]+_\w+\.deb", package.name)
    subprocess.run(["dpkg-deb", "--raw-extract", package, tmp_path / "raw"], check=True)
    raw = tmp_path / "raw"
    least = examine(program).least_glibc()
    assert f"Depends: libc6 (>= {least})," in (raw / "DEBIAN/control").read_text()
    files = {str(path.relative_to(raw)) for path in raw.rglob("*") if path.is_file()}
    assert {"usr/bin/appliance", "usr/lib/systemd/system/appliance.service"} <= files
    assert not [name for name in files if name.startswith("etc/appliance") or ".key" in name]
    assert (raw / "DEBIAN/conffiles").read_text() == "/etc/default/appliance\n"
    unit = (raw / "usr/lib/systemd/system/appliance.service").read_text()
    assert '"/usr/bin/appliance" run --config /etc/appliance/appliance.yaml' in unit
    assert "NotifyAccess=all" in unit, "the single file runs in a child of the main process"
    for name in ("postinst", "prerm", "postrm"):
        subprocess.run(["sh", "-n", raw / "DEBIAN" / name], check=True)


@as_root
def test_a_dry_run_of_who_may_not_look(
    image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(image, single_file(tmp_path))
    exists = Path.exists

    def closed(path: Path) -> bool:
        if path.name == "appliance.yaml":
            raise PermissionError(13, "Permission denied", str(path))
        return exists(path)

    monkeypatch.setattr(Path, "exists", closed)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    done = install(image, single_file(tmp_path), dry_run=True)
    assert done["/etc/appliance"] == "kept"
