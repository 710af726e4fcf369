"""`appliance install` and `uninstall`: the appliance as a service, of this computer or an image."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import pwd
import shutil
import stat
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

from appliance import config
from appliance.host.environment import for_other_programs
from appliance.ops.init import Credentials, InitStep, initialise, robot_name
from appliance.ops.unit import CONFIGURATION, DATA, ENVIRONMENT, NAME, OWN_USER, VARIABLES, Unit

#: The paths of the single file and of an administrator's unit, and those of the Debian package.
COMMAND = Path("/usr/local/bin/appliance")
UNIT_FILE = Path("/etc/systemd/system", NAME)
PACKAGED_COMMAND = Path("/usr/bin/appliance")
PACKAGED_UNIT = Path("/usr/lib/systemd/system", NAME)
_ENABLED = Path("/etc/systemd/system/multi-user.target.wants", NAME)

_LOCK = Path("/run/appliance-install.lock")

#: Seconds for systemd to start the service, which may have a large store to read, and to stop it.
PATIENCE = 330.0

#: Variables of a shell with a sourced ROS that the service should have as well.
_TAKEN_OVER = (
    "ROS_DOMAIN_ID",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_LOCALHOST_ONLY",
    "RMW_IMPLEMENTATION",
)

#: Where commands such as `appliance reload` reach the service.
_CONTROL = Path("/run/appliance/control.sock")

#: The line by which the unit of a single file is recognised.
_SINGLE_FILE = "NotifyAccess=all"

Verb = Literal["made", "replaced", "kept", "removed", "done"]


class InstallError(Exception):
    """The installation is not possible; the text says why, and what to do."""


@dataclass(frozen=True, slots=True)
class InstallStep:
    """One change that was made or, with `dry_run`, would be made."""

    verb: Verb
    subject: str
    text: str


class _Account(NamedTuple):
    uid: int
    gid: int
    group: str


@dataclass
class ServiceInstaller:
    """Installs the appliance as a service below `root`, and removes it.

    `source` is the single file to install as the command; without it the command is `command`,
    which stays where it is. The default user is the one of an earlier installation, or the
    service's own. With `packaged` the command and the unit belong to the Debian package, which
    alone starts the service. `environment` has the variables of a sourced ROS.
    """

    command: Path
    source: Path | None = None
    root: Path = Path("/")
    user: str = ""
    robot: str | None = None
    initialise: bool = True
    start: bool = True
    packaged: bool = False
    dry_run: bool = False
    environment: dict[str, str] = field(default_factory=for_other_programs)
    _undo: list[Callable[[], None]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.root = self.root.resolve()
        self.user = self.user or self._user_before() or OWN_USER

    def install(self) -> Iterator[InstallStep | Credentials]:
        """Install everything, or replace the older version by this one.

        Raises:
            InstallError: something is in the way.
            InitError, ConfigError, AccessFileError, CertificateError: what is in CONFIGURATION.
            OSError: a file cannot be written.
        """
        self._check()
        if self.source is None and not self.packaged:
            self._check_command()
        with self._alone():
            try:
                yield from self._install()
            except BaseException:  # including Ctrl-C and a closed standard output
                self._put_back()
                raise
            finally:
                for path in (COMMAND, UNIT_FILE):
                    if self._starts:
                        _before(self._at(path)).unlink(missing_ok=True)

    def uninstall(self, *, purge: bool = False) -> Iterator[InstallStep]:
        """Remove the service and the command; with `purge` also what they have written.

        Raises:
            InstallError: something is in the way.
        """
        self._check()
        with self._alone():
            yield from self._uninstall(purge)

    def _uninstall(self, purge: bool) -> Iterator[InstallStep]:
        if self._lives_here and self._at(UNIT_FILE).exists():
            yield self._step("done", "systemctl", "the service is stopped", self._disable)
        for path in self._put_before():
            yield self._step("removed", str(path), "part of the service", self._at(path).unlink)
        if self._lives_here:
            self._systemctl("daemon-reload")
        for path, text in (
            (CONFIGURATION, "configuration, users, certificates and keys"),
            (DATA, "sessions, messages, reports of crashes"),
            (ENVIRONMENT, "environment variables"),
        ):
            place = self._at(path)
            if not place.exists():
                continue
            if not purge:
                yield InstallStep("kept", str(path), f"{text}; --purge removes it")
            else:
                if place.is_symlink():
                    text = f"the link; {text} stay in {place.resolve()}"
                yield self._step("removed", str(path), text, partial(_remove, place))
        if purge and self._account() is not None and self.user == OWN_USER:
            remove = partial(self._run, "userdel", *self._prefix, OWN_USER)
            yield self._step("removed", OWN_USER, "the service's user", remove)

    def _install(self) -> Iterator[InstallStep | Credentials]:
        yield from self._install_command()
        account = self._account()
        if account is None:
            yield self._add_user()
            account = self._account()
        if account is not None and self._lives_here and not self.dry_run:
            self._try_as(account)
        yield from self._configuration(account)
        yield from self._data(account)
        if not self.packaged:
            yield from self._variables()
            yield from self._unit(account)
            yield from self._start()

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """Lock against a second installation, which would write the same files."""
        if self.dry_run:
            yield
            return
        lock = self._at(_LOCK)
        lock.parent.mkdir(parents=True, exist_ok=True)
        is_alone = False
        descriptor = os.open(lock, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # An installation that has just ended has removed this file, and a third may have
                # created its own.
                is_alone = os.fstat(descriptor).st_nlink > 0
            if not is_alone:
                raise InstallError("another `appliance install` is at work; wait for its end")
            yield
            lock.unlink(missing_ok=True)
        finally:
            os.close(descriptor)

    def _put_back(self) -> None:
        """Restore the files of the earlier installation."""
        for undo in reversed(self._undo):
            undo()
        self._undo.clear()

    def _user_before(self) -> str:
        """The user in the unit of an earlier installation, or in its drop-ins."""
        unit = self._at(UNIT_FILE)
        files = [] if self.packaged else [unit]
        files += sorted(unit.with_name(f"{unit.name}.d").glob("*.conf"))
        user = ""
        for file in files:
            with contextlib.suppress(OSError):
                lines = file.read_text().splitlines()
                named = [line.partition("=")[2].strip() for line in lines if line[:5] == "User="]
                user = named[-1] if named else user
        return user

    def _put_before(self) -> list[Path]:
        """The files of an earlier installation, without a command that was not installed by it."""
        found = []
        with contextlib.suppress(OSError):
            unit = self._at(UNIT_FILE).read_text()
            found = [COMMAND] if _SINGLE_FILE in unit.splitlines() else []
        found = [_ENABLED, *found, UNIT_FILE]
        return [path for path in found if self._at(path).is_symlink() or self._at(path).exists()]

    # --- checks before anything is changed -----------------------------------------------------

    @property
    def _lives_here(self) -> bool:
        """Whether the target is the running system, and systemd runs it."""
        return self.root == Path("/") and Path("/run/systemd/system").is_dir()

    @property
    def _starts(self) -> bool:
        return self.start and self._lives_here and not self.packaged

    def _at(self, path: Path) -> Path:
        return self.root / path.relative_to("/")

    def _check(self) -> None:
        if os.geteuid() and not self.dry_run:
            raise InstallError("this needs root (sudo); --dry-run only shows it")
        if not self.root.is_dir():
            raise InstallError(f"there is no directory {self.root}")
        files = (COMMAND, UNIT_FILE, _ENABLED, ENVIRONMENT, _LOCK)
        for path in (CONFIGURATION, DATA, *(file.parent for file in files)):
            target = self._at(path).resolve()
            if not target.is_relative_to(self.root):
                raise InstallError(f"{self._at(path)} leads out of {self.root}, to {target}")
        if self._at(PACKAGED_UNIT).exists() and not self.packaged:
            raise InstallError(
                "the Debian package is installed here, and looks after the same files: "
                "apt upgrades and removes it"
            )

    def _check_command(self) -> None:
        for folder in ("/tmp", "/var/tmp", "/dev", "/run"):
            if self.command.is_relative_to(folder):
                raise InstallError(
                    f"{self.command} would not be there for the service, or after a restart: "
                    "install the appliance elsewhere, for example in /opt/appliance"
                )
        if not self._at(self.command).exists():
            raise InstallError(
                f"{self.command} is not in {self.root}: use the single file (dist/appliance), or "
                "install the appliance in there and run this in a chroot"
            )

    def _try_as(self, account: _Account) -> None:
        """Run the command as the service's user, before systemd fails to do so again and again."""
        try:
            tried = subprocess.run(
                [self._command, "--version"],
                user=account.uid,
                group=account.gid,
                extra_groups=[],
                cwd="/",
                env={"PATH": "/usr/bin:/bin"},
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
            )
            output = tried.stderr.strip().rpartition("\n")[2] or f"exit code {tried.returncode}"
            reason = output if tried.returncode else ""
        except (OSError, subprocess.TimeoutExpired) as error:
            reason = str(error)
        if reason:
            raise InstallError(
                f"the user {self.user} cannot run {self._command} ({reason}): install the "
                "appliance where everyone may read it, such as in /opt, or name another user"
            )

    # --- the parts -----------------------------------------------------------------------------
    @property
    def _command(self) -> Path:
        if self.packaged:
            return PACKAGED_COMMAND
        return self.command if self.source is None else COMMAND

    def _install_command(self) -> Iterator[InstallStep]:
        if self.packaged:
            # A unit that was installed by hand would override the package's.
            by_hand = self._at(UNIT_FILE)
            if by_hand.is_file() and not by_hand.is_symlink():  # a link would be a mask
                for path in self._put_before():
                    unlink = self._at(path).unlink
                    yield self._step("removed", str(path), "it is the package's now", unlink)
            return
        if self.source is None:
            yield InstallStep("kept", str(self.command), "the command, where it is")
            return
        place = self._at(COMMAND)
        if place.exists() and (place.samefile(self.source) or _same(place, self.source)):
            yield InstallStep("kept", str(COMMAND), "the command, which is this version")
            return
        verb: Verb = "replaced" if place.exists() else "made"
        put = partial(self._put, COMMAND, self.source, 0o755)
        yield self._step(verb, str(COMMAND), "the command", put)

    def _account(self) -> _Account | None:
        """The service's user; None when it does not exist yet."""
        if self.root == Path("/"):
            with contextlib.suppress(KeyError):
                found = pwd.getpwnam(self.user)
                return _Account(found.pw_uid, found.pw_gid, _group(Path("/"), found.pw_gid))
            return None
        with contextlib.suppress(FileNotFoundError):
            for name, uid, gid in _entries(self._at(Path("/etc/passwd")), 2, 3):
                if name == self.user:
                    return _Account(int(uid), int(gid), _group(self.root, int(gid)))
        return None

    @property
    def _prefix(self) -> Sequence[str]:
        return () if self.root == Path("/") else ("--prefix", str(self.root.absolute()))

    def _add_user(self) -> InstallStep:
        if self.user != OWN_USER:
            raise InstallError(f"there is no user {self.user}")
        options = ("--system", "--user-group", "--no-create-home", "--home-dir", str(DATA))
        shell = ("--shell", "/usr/sbin/nologin", "--comment", "MQTT broker of this robot")
        return self._step(
            "made",
            self.user,
            "a user for the service alone",
            lambda: self._run("useradd", *self._prefix, *options, *shell, self.user),
        )

    def _configuration(self, account: _Account | None) -> Iterator[InstallStep | Credentials]:
        place = self._at(CONFIGURATION)
        if not self.initialise:
            return
        if self.dry_run:
            # A user who only wants to see the steps may not be allowed to read the folder.
            is_there = os.access(place, os.X_OK) and (place / "appliance.yaml").exists()
            verb: Verb = "kept" if is_there or self._is_of_another(place) else "made"
            text = "configuration, certificates, first user and access rules; what is there stays"
            yield InstallStep(verb, str(CONFIGURATION), text)
            return
        assert account is not None
        place.mkdir(mode=0o750, parents=True, exist_ok=True)
        before = place.stat().st_uid
        if self._is_of_another(place):
            yield self._configuration_of_another(place)
            _hand_over(place, account, before)
            return
        for step in initialise(place, robot=self.robot, data=DATA, control=_CONTROL):
            if isinstance(step, InitStep):
                shown = "/" / step.path.relative_to(self.root)
                yield InstallStep("made" if step.made else "kept", str(shown), step.text)
            elif isinstance(step, Credentials):
                yield step
        _hand_over(place, account, before)

    def _is_of_another(self, place: Path) -> bool:
        """Whether it exists and belongs to another user than root, as an installation leaves it."""
        return place.exists() and place.stat().st_uid != 0

    def _configuration_of_another(self, place: Path) -> InstallStep:
        """The step that keeps an earlier installation's folder, in which root creates nothing.

        Its user could have root write elsewhere, by links and by the paths in appliance.yaml.
        """
        file = place / "appliance.yaml"
        if not file.exists():
            raise InstallError(
                f"{CONFIGURATION} is there, of another user and without an appliance.yaml: put it "
                "back, or move the folder away, and everything in it is made anew"
            )
        settings = config.load(file)
        if self.robot and settings.robot != robot_name(self.robot):
            raise InstallError(f"{file} has robot: {settings.robot}; change it there")
        text = "configuration, certificates, users and access rules"
        return InstallStep("kept", str(CONFIGURATION), text)

    def _data(self, account: _Account | None) -> Iterator[InstallStep]:
        place = self._at(DATA)
        text = "for sessions, messages and reports of crashes"
        verb: Verb = "kept" if place.exists() else "made"

        def make() -> None:
            assert account is not None
            place.mkdir(mode=0o750, parents=True, exist_ok=True)
            _hand_over(place, account, place.stat().st_uid)

        yield self._step(verb, str(DATA), text, make)

    def _variables(self) -> Iterator[InstallStep]:
        if self._at(ENVIRONMENT).exists():
            yield InstallStep("kept", str(ENVIRONMENT), "environment variables of the service")
            return
        taken = [
            f"{name}={value}\n"
            for name in _TAKEN_OVER
            if (value := self.environment.get(name)) and "\n" not in value
        ]
        setup = Path("/opt/ros", self.environment.get("ROS_DISTRO", ""), "setup.sh")
        if "ROS_DISTRO" in self.environment and setup.exists():
            taken.insert(0, f"ROS_SETUP={setup}\n")
        text = VARIABLES.format(settings="".join(taken))
        say = "environment variables of the service" + (
            f", with {', '.join(line.partition('=')[0] for line in taken)} of this shell"
            if taken
            else ""
        )
        yield self._step(
            "made", str(ENVIRONMENT), say, partial(self._put, ENVIRONMENT, text, 0o640)
        )

    def unit(self, account: _Account | None = None) -> Unit:
        """The systemd unit for this computer."""
        account = account or self._account()
        homes = ("/home", "/root", "/run/user")
        behind = any(
            path.is_relative_to(home)
            for path in (self._command, self._command.resolve())
            for home in homes
        )
        return Unit(
            self._command,
            self.user,
            account.group if account else self.user,
            single_file=self.source is not None,
            # A user's own ROS workspaces are in its home, as its programs are.
            behind_home=behind or self.user != OWN_USER,
            systemd=systemd_version(),
        )

    def _unit(self, account: _Account | None) -> Iterator[InstallStep]:
        place, text = self._at(UNIT_FILE), str(self.unit(account))
        if place.exists() and place.read_text() == text:
            yield InstallStep("kept", str(UNIT_FILE), "systemd's unit")
        else:
            verb: Verb = "replaced" if place.exists() else "made"
            put = partial(self._put, UNIT_FILE, text, 0o644)
            yield self._step(verb, str(UNIT_FILE), "systemd's unit", put)
        enabled = self._at(_ENABLED)
        if not enabled.is_symlink():

            def enable() -> None:
                enabled.parent.mkdir(parents=True, exist_ok=True)
                enabled.symlink_to(UNIT_FILE)

            yield self._step("made", str(_ENABLED), "it starts when the computer does", enable)

    def _start(self) -> Iterator[InstallStep]:
        if not self._starts:
            if self.root == Path("/"):
                yield InstallStep("kept", NAME, "not started: systemctl restart appliance")
            return
        yield self._step("done", "systemctl", "the service runs, and answers", self._restart)

    def _restart(self) -> None:
        try:
            self._systemctl("daemon-reload")
            self._systemctl("restart", NAME)
        except (InstallError, KeyboardInterrupt) as error:
            if not self._undo:
                raise
            # systemd may still be starting the newer version, which Ctrl-C does not end.
            self._put_back()
            self._systemctl("daemon-reload")
            self._systemctl("restart", NAME)
            if isinstance(error, KeyboardInterrupt):
                raise
            raise InstallError(f"{error}\nThe version that was there before runs again.") from None

    def _disable(self) -> None:
        self._systemctl("disable", "--now", NAME)

    # --- how -----------------------------------------------------------------------------------
    def _step(self, verb: Verb, subject: str, text: str, do: Callable[[], object]) -> InstallStep:
        if not self.dry_run:
            do()
        return InstallStep(verb, subject, text)

    def _put(self, path: Path, content: Path | str, mode: int) -> None:
        """Write the file whole or leave it as it was, even in a crash."""
        place = self._at(path)
        place.parent.mkdir(parents=True, exist_ok=True)
        draft = place.with_name(f".{place.name}.new")
        draft.unlink(missing_ok=True)
        try:
            if isinstance(content, Path):
                shutil.copyfile(content, draft)
            else:
                draft.write_text(content)
            draft.chmod(mode)
            with draft.open("rb") as file:
                os.fsync(file.fileno())
            if place.exists() and self._starts:
                before = _before(place)
                before.unlink(missing_ok=True)
                os.link(place, before)
                self._undo.append(partial(os.replace, before, place))
            draft.replace(place)
        except OSError as error:
            text = f"{place} cannot be written: {error.strerror}; it is as it was before"
            raise InstallError(text) from None
        finally:
            draft.unlink(missing_ok=True)
        _sync(place.parent)

    def _systemctl(self, *arguments: str) -> None:
        if not self.dry_run:
            self._run("systemctl", *arguments, hint="; journalctl -u appliance -n 20 says why")

    def _run(self, *command: str, hint: str = "") -> None:
        try:
            ended = subprocess.run(
                command,
                env=for_other_programs(),
                capture_output=True,
                text=True,
                timeout=PATIENCE,
                check=False,
            )
        except FileNotFoundError:
            raise InstallError(f"there is no {command[0]} on this computer") from None
        except subprocess.TimeoutExpired:
            raise InstallError(f"`{' '.join(command)}` does not end{hint}") from None
        if ended.returncode:
            output = (ended.stderr or ended.stdout).strip() or f"exit code {ended.returncode}"
            raise InstallError(f"`{' '.join(command)}` failed: {output}{hint}")


def systemd_version() -> int:
    """The release of this computer's systemd, 0 when there is none."""
    try:
        output = subprocess.run(
            ["systemctl", "--version"],
            env=for_other_programs(),
            capture_output=True,
            text=True,
            check=False,
        ).stdout
    except OSError:
        return 0
    words = output.split()
    return int(words[1]) if len(words) > 1 and words[1].isdecimal() else 0


def _before(place: Path) -> Path:
    return place.with_name(f".{place.name}.before")


def _group(root: Path, gid: int) -> str:
    with contextlib.suppress(FileNotFoundError):
        for name, number in _entries(root / "etc/group", 2):
            if number == str(gid):
                return name
    return str(gid)


def _entries(file: Path, *fields: int) -> Iterator[list[str]]:
    """Names and these fields of the lines of passwd(5) or group(5). A line may be empty or `+` for
    NIS, and comments may have any encoding."""
    for line in file.read_text(encoding="utf-8", errors="surrogateescape").splitlines():
        parts = line.split(":")
        if len(parts) > max(fields):
            yield [parts[0], *(parts[number] for number in fields)]


def _same(one: Path, other: Path) -> bool:
    if one.stat().st_size != other.stat().st_size:
        return False
    with one.open("rb") as first, other.open("rb") as second:
        while chunk := first.read(1 << 20):
            if chunk != second.read(1 << 20):
                return False
    return True


def _hand_over(tree: Path, account: _Account, owner: int) -> None:
    """Change the owner of the files of `owner` in there to the service's user."""
    # By descriptors and never through a link, because the service's user can change the folder
    # meanwhile. The folder itself comes last: its owner says whether this was completed.
    for _, directories, files, descriptor in os.fwalk(tree.resolve(), topdown=False):
        for name in (*directories, *files, "."):
            status = os.stat(name, dir_fd=descriptor, follow_symlinks=False)
            if status.st_uid == owner and (stat.S_ISDIR(status.st_mode) or status.st_nlink == 1):
                os.chown(name, account.uid, account.gid, dir_fd=descriptor, follow_symlinks=False)


def _remove(place: Path) -> None:
    if place.is_dir() and not place.is_symlink():
        try:
            shutil.rmtree(place)
        except OSError as error:  # a mount point cannot be removed, only what is in it
            if error.errno != errno.EBUSY or any(place.iterdir()):
                raise
    else:
        place.unlink()


def _sync(directory: Path) -> None:
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
