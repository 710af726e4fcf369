"""The same with real systemd: a Debian in a container, and the service that its package made."""

from __future__ import annotations

import ctypes
import os
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import yaml
from appliance_process import ACL, ROBOT, BrokerProcess
from durability.ordeal import BROKER, Ordeal
from waiting import eventually

PACKAGES = "systemd,systemd-sysv,dbus,iproute2,init-system-helpers"
PASSWORD = "correct horse battery"
PATIENCE = 60.0
_NEW_NETWORK = 0x40000000  # CLONE_NEWNET of sched.h

#: Quicker than the unit's 20 s, so that a trial takes minutes.
DROP_IN = "[Service]\nWatchdogSec=2\nRestartSec=100ms\n"


def make_root(root: Path) -> None:
    """A minimal Debian with systemd, unless there is one."""
    if not (root / "usr/lib/systemd/systemd").exists():
        command = ["debootstrap", "--variant=minbase", f"--include={PACKAGES}", "bookworm", root]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


class Machine:
    """A container that has booted."""

    def __init__(self, init: int) -> None:
        self.init = init

    def run(self, *command: str | Path, check: bool = True) -> str:
        """What a command in there says."""
        enter = ["nsenter", "-t", str(self.init), "-m", "-u", "-i", "-n", "-p", "-C"]
        path = "PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
        done = subprocess.run(
            [*enter, "env", "-i", path, "HOME=/root", *command],
            capture_output=True,
            text=True,
            check=False,
        )
        if check and done.returncode:
            raise AssertionError(f"{command}: {done.stdout}{done.stderr}")
        return done.stdout.strip()

    def enter_network(self) -> None:
        """Let this thread, and threads that it starts, be in the container's network."""
        descriptor = os.open(f"/proc/{self.init}/ns/net", os.O_RDONLY)
        try:
            if ctypes.CDLL(None, use_errno=True).setns(descriptor, _NEW_NETWORK):
                raise OSError(ctypes.get_errno(), "setns")
        finally:
            os.close(descriptor)


@contextmanager
def booted(root: Path) -> Iterator[Machine]:
    """Boot it, and power it off."""
    options = ("-q", "--boot", "--register=no", "--keep-unit", "--private-network")
    nspawn = subprocess.Popen(
        ["systemd-nspawn", *options, "-M", "appliance-trial", "-D", root],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:

        def inits() -> list[int]:
            """The one in there; what nspawn starts before to prepare it has other names."""
            found = psutil.Process(nspawn.pid).children()
            return [child.pid for child in found if child.name() == "systemd"]

        eventually(inits, "systemd starts", PATIENCE)
        machine = Machine(inits()[0])
        up = ("running", "degraded")
        eventually(
            lambda: machine.run("systemctl", "is-system-running", check=False) in up,
            "it boots",
            PATIENCE,
        )
        machine.run("ip", "link", "set", "lo", "up")
        yield machine
        machine.run("systemctl", "poweroff", check=False)
        nspawn.wait(PATIENCE)
    finally:
        nspawn.terminate()
        nspawn.wait()


class Service(BrokerProcess):
    """The service in there, with alice as a user."""

    name = "the service"

    def __init__(self, directory: Path, machine: Machine, root: Path, package: Path) -> None:
        super().__init__(directory)
        self.machine = machine
        self.package = package
        self.port, self.plain_port = 8883, 1883
        self.passwords = {"alice": PASSWORD}
        home = root / "etc/appliance"
        self.ca = home / "certs/ca.crt"
        machine.run("dpkg", "--purge", "appliance", check=False)  # with the data of a trial before
        self.upgrade()
        settings = yaml.safe_load((home / "appliance.yaml").read_text())
        settings |= {"robot": ROBOT, "bridge": {"bus": "none"}}
        settings["broker"] = {**settings["broker"], **BROKER}
        (home / "appliance.yaml").write_text(yaml.safe_dump(settings))
        (home / "acl.conf").write_text(ACL)
        (root / "root/password").write_text(PASSWORD)
        machine.run("appliance", "user", "add", "alice", "--password-file", "/root/password")
        drop_in = root / "etc/systemd/system/appliance.service.d/trial.conf"
        drop_in.parent.mkdir(exist_ok=True)
        drop_in.write_text(DROP_IN)
        machine.run("systemctl", "daemon-reload")
        machine.run("systemctl", "restart", "appliance")
        self.main = self._main()

    def upgrade(self) -> None:
        """Install the package, which is there already but for the first time."""
        place = Path("/root", self.package.name)
        target = Path(f"/proc/{self.machine.init}/root", place.relative_to("/"))
        target.write_bytes(self.package.read_bytes())
        self.machine.run("dpkg", "-i", place)

    def signal(self, name: str) -> None:
        # To all of its processes: the single file's main one only waits for the one that works.
        self.machine.run("systemctl", "kill", "-s", name, "appliance")

    def start(self) -> None:
        """Wait until systemd has started another one, which is ready."""
        eventually(lambda: self._main() not in ("0", self.main), "it is back", PATIENCE)
        self.main = self._main()

    def _main(self) -> str:
        show = ("systemctl", "show", "appliance", "-p", "MainPID,ActiveState", "--value")
        main, _, state = self.machine.run(*show).partition("\n")
        return main if state == "active" else "0"

    @property
    def log(self) -> str:
        return self.machine.run("journalctl", "-u", "appliance", "-o", "cat", "--no-pager")

    def stop(self) -> None:
        self.machine.run("systemctl", "stop", "appliance")


class MachineTrial(Ordeal):
    """The service is killed, hung and upgraded under load, and systemd does the rest."""

    def __init__(self, directory: Path, seed: int, say: Callable[[str], None]) -> None:
        super().__init__(directory, seed, say=say)
        self.happened: Counter[str] = Counter()

    def run_with(self, service: Service, incidents: int) -> None:
        self.broker = service  # type: ignore[assignment]
        self._service = service
        self.run(incidents)

    def _start(self) -> None:
        if self.report.starts:
            began = time.monotonic()
            self._service.start()
            self.report.start_times.append(time.monotonic() - began)
        self.report.starts += 1

    def _kill(self) -> None:
        incident = ("killed", "hung", "upgraded")[self.report.kills % 3]
        if incident == "upgraded":
            self._service.upgrade()
        else:
            self._service.signal({"killed": "KILL", "hung": "STOP"}[incident])
        self.happened[incident] += 1
