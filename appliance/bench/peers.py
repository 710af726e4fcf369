"""The brokers that are compared: this appliance and one mosquitto or more, with equal settings.

All have a password file, the same ACL in force, one TCP and one TLS listener on 127.0.0.1 with the
same certificate, no persistence, and the same inflight window. Defaults of mosquitto that are good
for its figures stay (set_tcp_nodelay false takes 15 % off its QoS 1 in flight). All files are in
one directory that the caller removes.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import os
import random
import re
import secrets
import shutil
import socket
import ssl
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from ipaddress import ip_address
from pathlib import Path

import yaml

from appliance import certs
from appliance.access import Passwords
from appliance.bench.client import LoadClient, LoadError, LoadTarget
from appliance.host.environment import for_other_programs

USER = "bench"
PASSWORD_VARIABLE = "APPLIANCE_BENCH_PASSWORD"
ACL = f"""\
# In force on both brokers.
topic read $SYS/broker/uptime
user {USER}
topic readwrite bench/#
pattern readwrite clients/%c/#
"""
INFLIGHT = 100  # of each subscriber; mosquitto's default of 20 would limit the load
LIMITS: dict[str, object] = {  # of this broker; mosquitto has none such, or does not reach it here
    "connections": 10_000,
    "connections_per_address": 10_000,
    "connection_rate": 1_000_000,
    "publish_rate": 1_000_000_000,
    "subscriptions": 100_000,
    "retained_messages": 1_000_000,
    "retained_bytes": "1 GiB",
    "memory": "1 GiB",
}
EXTRA_PATHS = ("/usr/sbin", "/usr/local/sbin", "/opt/homebrew/sbin")  # often not in a user's PATH
OLDEST = (2, 0, 0)  # before it password files had no PBKDF2
_VERSION = re.compile(r"^mosquitto version (\d+)\.(\d+)(?:\.(\d+))?\S*", re.MULTILINE)
START_SECONDS = 60.0
STOP_SECONDS = 10.0
_NOT_OUTGOING = range(20_000, 32_768)  # ports below `net.ipv4.ip_local_port_range` of Linux


class PeerError(Exception):
    """A process could not be started, or has ended; the text says why."""


@dataclass(frozen=True, slots=True)
class Site:
    """What the brokers of one comparison share: a directory with certificates, and a user."""

    directory: Path
    password: str = field(default_factory=lambda: secrets.token_urlsafe(12), repr=False)

    @property
    def ca(self) -> Path:
        """The CA that signed the certificate of both brokers."""
        return self.directory / "ca.crt"

    def prepare(self) -> None:
        """Make the certificates."""
        certs.create_authority(self.directory)
        certs.issue_server(self.directory, ["localhost"], [ip_address("127.0.0.1")])


@dataclass(frozen=True, slots=True)
class Server:
    """A running broker, with the processes that belong to it."""

    name: str
    site: Site
    port: int
    tls_port: int
    pids: tuple[int, ...]

    def target(self, tls: bool) -> LoadTarget:
        """Where and how a client connects."""
        return LoadTarget(
            port=self.tls_port if tls else self.port,
            tls=ssl.create_default_context(cafile=self.site.ca) if tls else None,
            username=USER,
            password=self.site.password.encode(),
            pids=self.pids,
        )

    def arguments(self, tls: bool = False) -> list[str]:
        """The same as options of the load's programs."""
        shown = ["--user", USER, "--password-env", PASSWORD_VARIABLE]
        shown += ["--port", str(self.tls_port if tls else self.port)]
        shown += ["--tls", "--ca", str(self.site.ca)] if tls else []
        return shown + [option for pid in self.pids for option in ("--pid", str(pid))]


@dataclass(frozen=True, slots=True)
class Peer:
    """A mosquitto to compare with."""

    command: str
    version: tuple[int, int, int]
    name: str  # that nothing else of the run has, such as `mosquitto 2.1.2`


def find_peer(command: str | None = None) -> Peer:
    """A mosquitto by its path, or by its name in PATH; None is the one that is installed.

    Raises PeerError: it is not there, not executable, not mosquitto, or too old.
    """
    path = os.pathsep.join((os.environ.get("PATH", os.defpath), *EXTRA_PATHS))
    wanted = command or "mosquitto"
    found = shutil.which(wanted, path=path)
    if found is None:
        raise PeerError(_why_not_found(wanted))
    try:
        done = subprocess.run(
            [found, "-h"],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=STOP_SECONDS,
            env=for_other_programs(),
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise PeerError(
            f"{found} does not answer -h within {STOP_SECONDS:g} s: is it mosquitto?"
        ) from None
    except OSError as error:
        raise PeerError(f"{found} cannot be run: {error.strerror}") from None
    told = _VERSION.search(done.stdout)
    if told is None:
        said = (done.stderr.strip() or done.stdout.strip()).partition("\n")[0] or "nothing"
        raise PeerError(
            f"{found} is not mosquitto, or does not start: asked with -h for its version it"
            f" answers: {said[:200]}"
        )
    version = (int(told[1]), int(told[2]), int(told[3] or 0))
    if version < OLDEST:
        wanted = ".".join(map(str, OLDEST[:2]))
        raise PeerError(
            f"{found} is mosquitto {told[0].split()[-1]}, which is too old: it does not know the"
            f" passwords of {wanted}; name one of {wanted} or later"
        )
    return Peer(found, version, told[0].replace(" version", ""))


def _why_not_found(command: str) -> str:
    """Why there is no such program."""
    if os.sep not in command:
        there = "a file of this folder needs ./ before it" if Path(command).is_file() else ""
        return f"{command} is not among the installed programs" + (there and f"; {there}")
    if Path(command).is_dir():
        return f"{command} is a directory: name the program in it"
    if Path(command).exists():
        return f"{command} is not executable: chmod +x it, or name the program itself"
    return f"{command} is not there"


def find_peers(commands: Sequence[str]) -> list[Peer]:
    """Each of them, with names that differ. Raises PeerError."""
    found: list[Peer] = []
    for command in commands:
        peer = find_peer(command)
        if any(Path(peer.command).samefile(each.command) for each in found):
            raise PeerError(f"{peer.command} is given twice")
        found.append(peer)
    names = [each.name for each in found]
    return [
        replace(each, name=f"{each.name} ({each.command})") if names.count(each.name) > 1 else each
        for each in found
    ]


@contextlib.contextmanager
def mosquitto(
    peer: Peer,
    site: Site,
    *,
    default_queues: bool = False,
    window: int = INFLIGHT,
    bridge: str = "",
) -> Iterator[Server]:
    """Run mosquitto with its default queue and window or larger ones, and stop it in the end.

    `bridge` is added to its configuration. Raises PeerError.
    """
    queues = f"max_inflight_messages {window}\nmax_queued_messages 0"
    directory = Path(tempfile.mkdtemp(prefix="mosquitto-", dir=site.directory))
    (directory / "acl").write_text(ACL)
    salt = secrets.token_bytes(12)
    digest = hashlib.pbkdf2_hmac("sha512", site.password.encode(), salt, 101)
    encoded = [base64.b64encode(part).decode() for part in (salt, digest)]
    passwords = directory / "passwords"
    passwords.write_text(f"{USER}:$7$101${'$'.join(encoded)}\n")
    passwords.chmod(0o600)
    port, tls_port = free_ports(2)
    (directory / "mosquitto.conf").write_text(
        ("user root\n" if os.geteuid() == 0 else "")  # it could not read the directory otherwise
        + f"""\
per_listener_settings false
allow_anonymous false
password_file {passwords}
acl_file {directory / "acl"}
persistence false
log_dest stderr
log_type error
log_type warning
{"" if default_queues else queues}
listener {port} 127.0.0.1
listener {tls_port} 127.0.0.1
certfile {site.directory / "server.crt"}
keyfile {site.directory / "server.key"}
{bridge}
"""
    )
    argv = [peer.command, "-c", str(directory / "mosquitto.conf")]
    with running(peer.name, argv, for_other_programs(), directory / "log") as process:
        server = Server(peer.name, site, port, tls_port, (process.pid,))
        wait_for(server, process, directory / "log")
        yield server


@contextlib.contextmanager
def appliance(
    site: Site,
    routes: Sequence[Mapping[str, object]],
    environment: Mapping[str, str],
    durability: str = "off",
    *,
    default_queues: bool = False,
    upstreams: Sequence[Mapping[str, object]] = (),
) -> Iterator[Server]:
    """Run this appliance, with a bridge when there are routes, and stop it in the end.

    Its limits are raised, but for those of a client's queue where these are to be the default ones.
    Links log in at the fleet's broker with the password file `fleet.password`. Raises PeerError.
    """
    directory = Path(tempfile.mkdtemp(prefix="appliance-", dir=site.directory))
    passwords = Passwords(directory / "users.passwd")
    passwords.set(USER, site.password)
    passwords.save()
    (directory / "acl.conf").write_text(ACL)
    login = directory / "fleet.password"
    login.write_text(site.password)
    login.chmod(0o600)
    port, tls_port = free_ports(2)
    settings = {
        "robot": "bench",
        "broker": {
            "listeners": [
                {"bind": f"127.0.0.1:{port}"},
                {"bind": f"127.0.0.1:{tls_port}", "tls": True},
            ],
            "users": "users.passwd",
            "acl": "acl.conf",
            "tls": {
                "certificate": str(site.directory / "server.crt"),
                "key": str(site.directory / "server.key"),
                "ca": str(site.ca),
                "client_certificates": "off",
            },
            "limits": LIMITS if default_queues else {"inflight": INFLIGHT, **LIMITS},
            "store": {"durability": durability},
        },
        "bridge": {"bus": "ros2" if routes else "none", "topics": [dict(item) for item in routes]},
        "upstreams": [dict(each) for each in upstreams],
        "log": {"level": "warning", "levels": {"appliance.store": "info"}},
    }
    file = directory / "appliance.yaml"
    file.write_text(yaml.safe_dump(settings, sort_keys=False))
    argv = [sys.executable, "-m", "appliance", "run", "--config", str(file)]
    with running("appliance run", argv, environment, directory / "log") as process:
        server = Server("appliance", site, port, tls_port, (process.pid,))
        wait_for(server, process, directory / "log")
        yield server


@contextlib.contextmanager
def running(
    name: str,
    argv: Sequence[str],
    environment: Mapping[str, str],
    log: Path,
    talks: bool = False,
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a program whose output goes to `log`, and stop it in the end. Raises PeerError.

    With `talks` its input and output are pipes, and only its errors go to `log`.
    """
    with log.open("wb") as output:
        try:
            process = subprocess.Popen(
                argv,
                stdin=subprocess.PIPE if talks else subprocess.DEVNULL,
                stdout=subprocess.PIPE if talks else output,
                stderr=output,
                env=environment,
            )
        except OSError as error:
            raise PeerError(f"{name} does not start: {error}") from error

    def ended() -> str:
        return f"{name} ended with {process.returncode}: {last_lines(log)}"

    try:
        yield process
    except PeerError as error:
        if process.poll() is not None:
            raise PeerError(f"{error}; {ended()}") from error
        raise
    else:
        if process.poll() is not None:
            raise PeerError(ended())
    finally:
        stop(process)
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()


def stop(process: subprocess.Popen[bytes]) -> None:
    """Terminate a process, and kill it when that does not end it."""
    if process.poll() is None:
        process.terminate()
    try:
        process.wait(STOP_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def wait_for(server: Server, process: subprocess.Popen[bytes], log: Path) -> None:
    """Wait until the user can connect to both listeners. Raises PeerError."""
    until = time.monotonic() + START_SECONDS
    missing = [False, True]
    while missing:
        try:
            with contextlib.closing(LoadClient(server.target(missing[0]), "bench-ready")) as client:
                client.wait_connected()
            missing.pop(0)
        except (OSError, LoadError) as error:
            if process.poll() is not None:
                raise PeerError(f"{server.name} does not start") from error
            if time.monotonic() > until:
                problem = f"{server.name} does not answer within {START_SECONDS:g} s ({error})"
                raise PeerError(f"{problem}: {last_lines(log)}") from error
            time.sleep(0.05)


def last_lines(log: Path) -> str:
    """The last lines of a program's output, as one line."""
    lines = log.read_text(errors="replace").strip().splitlines()
    return " | ".join(lines[-3:]) or "it printed nothing"


def free_ports(count: int) -> list[int]:
    """Ports of 127.0.0.1 that were free just now, for programs that accept no port 0.

    Where port 0 leads, outgoing connections of other programs lead as well, also before the port is
    used: Linux takes both from 32768 on. These are below.
    """
    ports: list[int] = []
    with contextlib.ExitStack() as stack:
        for port in random.sample(_NOT_OUTGOING, len(_NOT_OUTGOING)):
            if len(ports) == count:
                break
            each = stack.enter_context(socket.socket())
            with contextlib.suppress(OSError):
                each.bind(("127.0.0.1", port))
                ports.append(port)
    return ports
