"""Computers in network namespaces of their own, joined by cables: what they multicast stays there.

::

    with Network() as network:
        robot, laptop = network.computer(), network.computer()
        network.connect(robot, "eth0", "192.0.2.1/24", laptop, "eth0", "192.0.2.2/24")

A namespace lives as long as the process that holds it; with its end the cables go as well.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from waiting import eventually

#: The avahi-daemon's, and D-Bus's, which avahi-browse asks it over.
AVAHI = """\
[server]
host-name={name}
use-ipv4=yes
use-ipv6=yes
enable-dbus=yes
allow-interfaces={interfaces}
[publish]
publish-workstation=no
"""
DBUS = """\
<busconfig><type>system</type><listen>unix:path={socket}</listen><auth>EXTERNAL</auth>
<policy context="default"><allow user="*"/><allow own="*"/><allow send_destination="*"/>
<allow receive_sender="*"/></policy></busconfig>
"""


class Computer:
    """A network namespace, and a mount namespace with a `/run` of its own."""

    def __init__(self) -> None:
        # In it `cat` waits for the end of its input, which comes when the test ends, however.
        command = "mount -t tmpfs tmpfs /run && ip link set lo up && echo ready && exec cat"
        self._holder = subprocess.Popen(
            ["unshare", "--net", "--mount", "sh", "-c", command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._holder.stdout is not None and self._holder.stderr is not None
        self._running: list[subprocess.Popen[Any]] = []
        self.pid = self._holder.pid
        if self._holder.stdout.readline() != "ready\n":
            reason = self._holder.stderr.read().strip()
            self.close()
            pytest.skip(f"no namespaces may be made here, as root may: {reason}")

    def command(self, *command: str | Path) -> list[str | Path]:
        """The command line that runs this one there."""
        return ["nsenter", "-t", str(self.pid), "-n", "-m", "--", *command]

    def run(self, *command: str | Path, code: int = 0) -> str:
        """What a command prints there, which has to end with that code."""
        done = subprocess.run(self.command(*command), capture_output=True, text=True, timeout=30)
        assert done.returncode == code, f"{command}: {done.returncode} {done.stdout} {done.stderr}"
        return done.stdout

    def start(self, *command: str | Path, **options: Any) -> subprocess.Popen[Any]:
        """A program that runs there until the computer is closed, or the test is killed."""
        bound = ("setpriv", "--pdeathsig", "KILL", *command)
        process = subprocess.Popen(self.command(*bound), **options)
        self._running.append(process)
        return process

    def start_avahi(self, folder: Path, interfaces: str = "eth0", name: str = "judge") -> None:
        """Avahi, which `avahi-browse` in there then asks."""
        socket = folder / "dbus"
        for file, text in (
            ("dbus.conf", DBUS.format(socket=socket)),
            ("avahi.conf", AVAHI.format(name=name, interfaces=interfaces)),
        ):
            (folder / file).write_text(text)
        self.bus = f"DBUS_SYSTEM_BUS_ADDRESS=unix:path={socket}"
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.start("dbus-daemon", f"--config-file={folder}/dbus.conf", "--nofork", **quiet)
        eventually(socket.exists, "the bus")
        daemon = ("avahi-daemon", "-f", folder / "avahi.conf", "--no-drop-root", "--no-chroot")
        self.start("env", self.bus, *daemon, **quiet)
        self.eventually_runs("env", self.bus, "avahi-browse", "-t", "_none._tcp")

    def eventually_runs(self, *command: str | Path) -> None:
        eventually(
            lambda: not subprocess.run(self.command(*command), capture_output=True).returncode,
            f"{command}",
        )

    def browse(self, kind: str = "_secure-mqtt._tcp") -> list[list[str]]:
        """The services that avahi finds: interface, protocol, name, kind, domain, host, address,
        port, texts."""
        output = self.run("env", self.bus, "avahi-browse", "-rptk", kind)
        # Blanks and the like are `\032`, in decimal.
        plain = re.sub(r"\\(\d{3})", lambda match: chr(int(match[1])), output)
        return [line.split(";", 9)[1:] for line in plain.splitlines() if line.startswith("=")]

    def close(self) -> None:
        for process in reversed(self._running):
            process.terminate()
        for process in self._running:
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            for file in (process.stdin, process.stdout, process.stderr):
                if file is not None:
                    file.close()
        self._running.clear()
        with contextlib.suppress(BrokenPipeError):
            self._holder.communicate(timeout=10)


class Network:
    """Computers and cables; `close` ends all that runs there."""

    def __init__(self) -> None:
        missing = [
            package
            for program, package in (
                ("ip", "iproute2"),
                ("avahi-daemon", "avahi-daemon"),
                ("avahi-browse", "avahi-utils"),
                ("dbus-daemon", "dbus"),
            )
            if shutil.which(program, path=f"{os.environ['PATH']}:/usr/sbin:/sbin") is None
        ]
        if missing:
            pytest.skip(f"apt install {' '.join(missing)}")
        self._computers: list[Computer] = []
        self._cables = 0

    def __enter__(self) -> Network:
        return self

    def __exit__(self, *_: object) -> None:
        for computer in self._computers:
            computer.close()

    def computer(self) -> Computer:
        computer = Computer()
        self._computers.append(computer)
        return computer

    def switch(self, name: str = "lan0") -> Computer:
        """A computer that only passes on what comes on its ports."""
        switch = self.computer()
        switch.run("ip", "link", "add", name, "type", "bridge", "mcast_snooping", "0")
        switch.run("ip", "link", "set", name, "up")
        return switch

    def connect(
        self, one: Computer, name: str, address: str, other: Computer, its: str, its_address: str
    ) -> None:
        """A cable between two computers, with the names and addresses of its ends; an address that
        names a bridge (`lan0`) makes that end a port of it."""
        ends = (one, name, address), (other, its, its_address)
        # Made there and not here: it never exists in the machine's own network.
        peer = ("peer", "name", its, "netns", str(other.pid))
        one.run("ip", "link", "add", name, "type", "veth", *peer)
        for computer, interface, where in ends:
            if "/" in where:
                # Without the seconds in which an address is looked for on the network (DAD).
                computer.run("ip", "address", "add", where, "dev", interface)
            else:
                computer.run("ip", "link", "set", interface, "master", where)
            computer.run("ip", "link", "set", interface, "up")
