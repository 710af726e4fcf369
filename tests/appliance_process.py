"""Brokers in processes of their own: the appliance as `appliance init` sets it up, and mosquitto.

Both have a TLS port and a plain one on loopback, the same users and the same access rules, so that
a test can be run against one and the other.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from waiting import PATIENCE

from appliance import certs, config
from appliance.access import Passwords
from appliance.bench.peers import free_ports as free_ports
from appliance.ops.control import NotRunningError, ask
from appliance.ops.init import Credentials, initialise

ROBOT = "r2d2"
HOST = "localhost"

#: For interop tests: what alice publishes under r2d2/ she and bob can read.
ACL = """\
user alice
topic readwrite {robot}/#
topic read $SYS/#

user bob
topic readwrite {robot}/#
"""

MOSQUITTO = shutil.which(
    "mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin"
)


class BrokerProcess:
    """A broker's process, its ports, its users with their passwords, and what it logs.

    `start` returns when it can be connected to; `stop` ends it, may be called twice, and raises
    AssertionError when it did not end by itself or with another exit code than 0.
    """

    name: str
    #: What its environment has beside that of the tests.
    environment: Mapping[str, str] = {}

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.ca = directory / "certs/ca.crt"
        self.passwords: dict[str, str] = {}
        #: What its environment has beside this process's.
        self.environment: dict[str, str] = {}
        self.port = 0
        self.plain_port = 0
        self._process: subprocess.Popen[str] | None = None
        self._reader: threading.Thread | None = None
        self._lines: list[str] = []
        self._ended = False
        self._changed = threading.Condition()

    def start(self) -> None:
        raise NotImplementedError

    def _run(self, arguments: list[str | Path]) -> None:
        self._ended = False
        more = {"PYTHONUNBUFFERED": "1", "NO_COLOR": "1"}
        environment = {**os.environ, **more, **self.environment}
        self._process = subprocess.Popen(
            arguments,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=environment,
        )
        self._reader = threading.Thread(target=self._read, args=(self._process,), daemon=True)
        self._reader.start()

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        with process.stdout:
            for line in process.stdout:
                with self._changed:
                    self._lines.append(line.rstrip("\n"))
                    self._changed.notify_all()
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    @property
    def log(self) -> str:
        """All that was logged so far."""
        with self._changed:
            return "\n".join(self._lines)

    def wait_for_log(self, pattern: str, count: int = 1, timeout: float = PATIENCE) -> list[str]:
        """Returns `count` lines that the regular expression is found in, when they are there."""
        found: list[str] = []

        def enough() -> bool:
            found[:] = [line for line in self._lines if re.search(pattern, line)]
            return len(found) >= count or self._ended

        with self._changed:
            self._changed.wait_for(enough, timeout)
        assert len(found) >= count, f"{pattern!r} is not {count} times in the log:\n{self.log}"
        return found

    def stop(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        process.send_signal(signal.SIGTERM)
        try:
            code = process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise AssertionError(f"{self.name} did not end on SIGTERM:\n{self.log}") from None
        finally:
            assert self._reader is not None
            self._reader.join(PATIENCE)
        assert code == 0, f"{self.name} ended with {code}:\n{self.log}"

    def kill(self) -> None:
        """As a crash ends it, with nothing done behind it."""
        process, self._process = self._process, None
        assert process is not None
        assert self._reader is not None
        process.kill()
        process.wait()
        self._reader.join(PATIENCE)

    def tls_context(self) -> ssl.SSLContext:
        """What a client that has the CA's certificate trusts."""
        return ssl.create_default_context(cafile=str(self.ca))

    def open(self, *, tls: bool) -> socket.socket:
        """A new connection, with nothing sent on it."""
        port = self.port if tls else self.plain_port
        connection = socket.create_connection((HOST, port), PATIENCE)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if not tls:
            return connection
        return self.tls_context().wrap_socket(connection, server_hostname=HOST)


class ApplianceProcess(BrokerProcess):
    """`appliance run` in a directory that `appliance init` has filled.

    alice is the user that init makes; `users` are more, by name and password. `acl` takes the
    place of init's rules, and `broker` goes into appliance.yaml beside the listeners. Without
    `bridge` there is no ROS bus. Changed files are left alone until it is told to reload, so that a
    test knows when that is.
    """

    name = "appliance"
    python = sys.executable

    def __init__(
        self,
        directory: Path,
        *,
        users: Mapping[str, str] | None = None,
        acl: str | None = None,
        broker: Mapping[str, Any] | None = None,
        bridge: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(directory)
        self.config = directory / "appliance.yaml"
        *_, credentials = initialise(directory, robot=ROBOT, user="alice")
        assert isinstance(credentials, Credentials)
        self.passwords = {credentials.user: credentials.password, **(users or {})}
        if users:
            stored = Passwords.load(directory / "users.passwd")
            for user, password in users.items():
                stored.set(user, password)
            stored.save()
        if acl is not None:
            (directory / "acl.conf").write_text(acl)
        settings = yaml.safe_load(self.config.read_text())
        listeners = [{"bind": "127.0.0.1:0", "tls": True}, {"bind": "127.0.0.1:0"}]
        settings["broker"] = {"listeners": listeners, **(broker or {})}
        settings["bridge"] = dict(bridge or {"bus": "none"})
        settings["reload_on_change"] = False
        self.config.write_text(yaml.safe_dump(settings))

    def start(self) -> None:
        """Start it; the ports are those that the system gave it."""
        listening = r"listening on \S+:(\d+)$"
        before = len(re.findall(listening, self.log, re.MULTILINE))
        self._run([self.python, "-m", "appliance", "run", "-c", self.config])
        try:
            self.wait_for_log(listening, before + 2)
        except AssertionError:
            self.stop()
            raise
        ports = re.findall(listening, self.log, re.MULTILINE)
        self.port, self.plain_port = map(int, ports[-2:])

    def is_answering(self) -> bool:
        """Whether it listens on its control socket, too, which comes last at its start."""
        try:
            return bool(ask(config.load_control(self.config).control, "status"))
        except NotRunningError:
            return False


class MosquittoProcess(BrokerProcess):
    """mosquitto as Debian has it, with certificates of our own CA."""

    name = "mosquitto"

    def __init__(self, directory: Path, users: Mapping[str, str], acl: str) -> None:
        super().__init__(directory)
        self.passwords = dict(users)
        names, addresses = certs.local_names()
        certs.create_authority(directory / "certs", "mosquitto", names, addresses)
        certs.issue_server(directory / "certs", names, addresses)
        (directory / "acl.conf").write_text(acl.replace("{robot}", ROBOT))
        passwords = directory / "users.passwd"
        passwords.touch(0o600)
        for user, password in users.items():
            subprocess.run(["mosquitto_passwd", "-b", passwords, user, password], check=True)

    def start(self) -> None:
        """Start it on ports that were free a moment ago."""
        assert MOSQUITTO is not None
        self.port, self.plain_port = free_ports(2)
        root = "user root\n" if os.geteuid() == 0 else ""  # else it cannot read the key
        (self.directory / "mosquitto.conf").write_text(
            f"{root}allow_anonymous false\npassword_file {self.directory}/users.passwd\n"
            f"acl_file {self.directory}/acl.conf\nset_tcp_nodelay true\n"
            f"listener {self.plain_port} 127.0.0.1\nlistener {self.port} 127.0.0.1\n"
            f"cafile {self.ca}\ncertfile {self.directory}/certs/server.crt\n"
            f"keyfile {self.directory}/certs/server.key\n"
        )
        self._run([MOSQUITTO, "-c", self.directory / "mosquitto.conf"])
        try:
            self.wait_for_log(r"mosquitto version \S+ running")
        except AssertionError:
            self.stop()
            raise
