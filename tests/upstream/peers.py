"""Real brokers and proxies, each with its own folder and its own ports of loopback.

Each is a context manager, and ends all its processes by their ids when the block ends, whatever
happened in it::

    with RabbitMQ(tmp_path) as fleet:
        ...  # fleet.plain_port, USER, PASSWORD

`stop` and `start` again keep the ports and the data; `kill` is SIGKILL. A program that is not
installed skips the test, and names the package; in CI that is a failure (tests/conftest.py).
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import psutil
import pytest
from appliance_process import BrokerProcess, free_ports

from appliance import certs

#: Of every broker here. mosquitto has more users if it is told so.
USER = "fleet"
PASSWORD = "fleet's password"

HOST = "127.0.0.1"

#: Seconds until a program has started. RabbitMQ takes 15 on a busy computer, and a cluster 40.
STARTING = 120.0

#: Seconds in which a program that was told to end ends; then it is killed.
ENDING = 15.0

_PATH = f"{os.environ.get('PATH', os.defpath)}:/usr/sbin:/usr/local/sbin:/usr/lib/rabbitmq/bin"

P = TypeVar("P", bound="Peer")


def needs(program: str, package: str) -> str:
    """The path of a program; skips the test when it is not installed."""
    path = shutil.which(program, path=_PATH)
    if path is None:
        pytest.skip(f"there is no {program}: apt-get install {package}")
    return path


class Peer(BrokerProcess):
    """A program of others, with what it logs in `log`; its ports stay the same."""

    #: What its log says when it can be connected to.
    ready: str

    def __init__(self, directory: Path) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        super().__init__(directory)
        self.passwords = {USER: PASSWORD}
        self.starting_took = 0.0

    def __enter__(self: P) -> P:
        try:
            self.start()
        except BaseException:
            self.kill()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def command(self) -> list[str | Path]:
        raise NotImplementedError

    def start(self) -> None:
        """Start it, and return when it can be connected to."""
        began = time.monotonic()
        before = len(re.findall(self.ready, self.log))
        self._run(self.command())
        try:
            self.wait_for_log(self.ready, before + 1, STARTING)
        except AssertionError:
            self.kill()
            raise
        self.starting_took = time.monotonic() - began

    def stop(self) -> None:
        """End it; may be called twice. How it ends is its own business."""
        self._end(signal.SIGTERM)

    def kill(self) -> None:
        """End it at once, as the computer's memory or power would."""
        self._end(signal.SIGKILL)

    def _end(self, how: signal.Signals) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        children = _family(process.pid)
        process.send_signal(how)
        try:
            process.wait(ENDING)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        for child in children:
            _kill(child)
        psutil.wait_procs(children, ENDING)
        if self._reader is not None:
            self._reader.join(ENDING)

    def memory(self) -> int:
        """Bytes that its processes have in memory now."""
        return sum(process.memory_info().rss for process in _family(self.pid, itself=True))


def _family(pid: int, *, itself: bool = False) -> list[psutil.Process]:
    try:
        process = psutil.Process(pid)
        return [*([process] if itself else []), *process.children(recursive=True)]
    except psutil.NoSuchProcess:
        return []


def _kill(process: psutil.Process) -> None:
    try:
        process.kill()
    except psutil.NoSuchProcess:  # psutil knows a process by its start time, too
        return


def make_certificates(directory: Path) -> None:
    """A CA and a server's certificate for localhost and 127.0.0.1, in `directory`."""
    names, addresses = certs.local_names()
    certs.create_authority(directory, "fleet", names, addresses)
    certs.issue_server(directory, names, addresses)


class FleetMosquitto(Peer):
    """mosquitto as a fleet's broker: a TLS port, a plain one, everything allowed to `users`.

    `options` are more lines of mosquitto.conf, `acl` takes the place of "everything". Its queues
    have no limit. It keeps what it has when it is stopped; when it is killed, what it has saved
    since: it acknowledges before it has stored.
    """

    name = "mosquitto"
    ready = r"mosquitto version \S+ running"

    def __init__(
        self,
        directory: Path,
        *,
        users: Mapping[str, str] | None = None,
        acl: str | None = None,
        options: str = "max_inflight_messages 1000\nmax_queued_messages 0",
    ) -> None:
        self._program = needs("mosquitto", "mosquitto")
        super().__init__(directory)
        self.passwords |= users or {}
        self.port, self.plain_port = free_ports(2)
        make_certificates(directory / "certs")
        lines = [f"user {user}\ntopic readwrite #\ntopic read $SYS/#" for user in self.passwords]
        (directory / "acl.conf").write_text(acl if acl is not None else "\n".join(lines) + "\n")
        write_mosquitto_passwords(directory / "users.passwd", self.passwords)
        self._options = options

    def command(self) -> list[str | Path]:
        certificates = self.directory / "certs"
        root = "user root\n" if os.geteuid() == 0 else ""  # else it cannot read the key
        (self.directory / "mosquitto.conf").write_text(
            f"{root}allow_anonymous false\npassword_file {self.directory}/users.passwd\n"
            f"acl_file {self.directory}/acl.conf\nset_tcp_nodelay true\n{self._options}\n"
            f"persistence true\npersistence_location {self.directory}/\n"
            f"listener {self.plain_port} {HOST}\nlistener {self.port} {HOST}\n"
            f"cafile {certificates}/ca.crt\ncertfile {certificates}/server.crt\n"
            f"keyfile {certificates}/server.key\n"
        )
        return [self._program, "-c", self.directory / "mosquitto.conf"]


def write_mosquitto_passwords(path: Path, users: Mapping[str, str]) -> None:
    """mosquitto's file of users, with its own hash; few rounds, as nobody attacks it here."""
    lines = []
    for user, password in users.items():
        salt = os.urandom(12)
        digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, 101)
        encoded = "$".join(base64.b64encode(part).decode() for part in (salt, digest))
        lines.append(f"{user}:$7$101${encoded}\n")
    path.touch(0o600)
    path.write_text("".join(lines))


class MosquittoBridge(Peer):
    """The rival: mosquitto on the robot, with a bridge to the fleet's broker at `remote`.

    Anonymous clients of `plain_port` may do everything. `topics` are lines of its configuration,
    such as `# out 1 r2d2/ fleet/r2d2/` and `cmd/# in 1 r2d2/ fleet/r2d2/`. Its queue has no limit,
    and its window is `window`.
    """

    name = "mosquitto's bridge"
    ready = r"mosquitto version \S+ running"

    def __init__(
        self,
        directory: Path,
        remote: int,
        topics: Sequence[str],
        *,
        window: int = 1000,
        version: str = "mqttv50",
        options: str = "",
    ) -> None:
        self._program = needs("mosquitto", "mosquitto")
        super().__init__(directory)
        (self.plain_port,) = free_ports(1)
        self.remote = remote
        self._topics = topics
        self._window = window
        self._version = version
        self._options = options

    def command(self) -> list[str | Path]:
        root = "user root\n" if os.geteuid() == 0 else ""
        topics = "".join(f"topic {topic}\n" for topic in self._topics)
        (self.directory / "mosquitto.conf").write_text(
            f"{root}per_listener_settings false\nallow_anonymous true\nset_tcp_nodelay true\n"
            f"persistence true\npersistence_location {self.directory}/\nautosave_interval 1\n"
            f"max_queued_messages 0\nmax_inflight_messages {self._window}\n{self._options}\n"
            f"listener {self.plain_port} {HOST}\n"
            f"connection fleet\naddress {HOST}:{self.remote}\n"
            f"bridge_protocol_version {self._version}\ncleansession false\n"
            f"remote_username {USER}\nremote_password {PASSWORD}\nremote_clientid r2d2\n"
            f"notifications false\ntry_private false\nkeepalive_interval 5\nrestart_timeout 1\n"
            f"{topics}"
        )
        return [self._program, "-c", self.directory / "mosquitto.conf"]


class Erlang:
    """What the nodes of a folder share: epmd on its own port, the cookie in `home`."""

    def __init__(self, directory: Path) -> None:
        self.home = directory / "home"
        self.home.mkdir(parents=True, exist_ok=True)
        # RabbitMQ's cookie file has to be its own user's, and nobody else's.
        cookie = self.home / ".erlang.cookie"
        if not cookie.exists():
            cookie.write_text(base64.b32encode(os.urandom(15)).decode())
            cookie.chmod(0o400)
        (self.port,) = free_ports(1)
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        if self._process is not None:
            return
        epmd = needs("epmd", "erlang-base")
        self._process = subprocess.Popen(
            [epmd, "-port", str(self.port), "-address", HOST],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=self.environment(),
        )
        _wait_for_port(self.port, lambda: self._process is not None and not self._process.poll())

    def stop(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()

    def environment(self) -> dict[str, str]:
        return {
            "HOME": str(self.home),
            "ERL_EPMD_PORT": str(self.port),
            "ERL_EPMD_ADDRESS": HOST,
            "ERL_CRASH_DUMP_SECONDS": "0",
        }


def _wait_for_port(port: int, alive: Callable[[], bool]) -> None:
    deadline = time.monotonic() + STARTING
    while True:
        try:
            socket.create_connection((HOST, port), 5).close()
            return
        except OSError:
            assert alive() and time.monotonic() < deadline, f"nothing listens on port {port}"
            time.sleep(0.02)


#: For an Erlang node beside others on two cores: no busy waiting, one scheduler.
_MODEST = "+sbwt none +sbwtdcpu none +sbwtdio none +S 1:1 +SDio 2"


class RabbitMQ(Peer):
    """One node of RabbitMQ with its plugin rabbitmq_mqtt: MQTT 3.1.1 only, a plain port.

    `peers` are the names of all nodes of its cluster, itself included. `options` are more lines of
    rabbitmq.conf. Every queue is mirrored to all nodes, so that one may be lost.
    """

    name = "RabbitMQ"
    ready = r"Server startup complete"

    def __init__(
        self,
        directory: Path,
        node: str = "fleet1",
        *,
        peers: Sequence[str] = (),
        erlang: Erlang | None = None,
        options: str = "",
    ) -> None:
        self._program = needs("rabbitmq-server", "rabbitmq-server")
        super().__init__(directory)
        self.node = f"{node}@localhost"
        self._peers = [f"{peer}@localhost" for peer in peers]
        self.erlang = erlang or Erlang(directory)
        self._owns_erlang = erlang is None
        self.plain_port, self._distribution = free_ports(2)
        (directory / "rabbitmq.conf").write_text(self._settings() + options + "\n")
        (directory / "enabled_plugins").write_text("[rabbitmq_mqtt].\n")
        (directory / "definitions.json").write_text(json.dumps(_DEFINITIONS))
        self.environment = self._make_environment()

    def _settings(self) -> str:
        discovery = "".join(
            f"cluster_formation.classic_config.nodes.{number} = {peer}\n"
            for number, peer in enumerate(self._peers, 1)
        )
        return (
            f"listeners.tcp = none\nmqtt.listeners.tcp.1 = {HOST}:{self.plain_port}\n"
            "mqtt.allow_anonymous = false\nmqtt.vhost = /\nmqtt.prefetch = 1000\n"
            "mqtt.tcp_listen_options.nodelay = true\n"
            f"load_definitions = {self.directory}/definitions.json\n"
            "log.console = true\nlog.console.level = info\nlog.console.use_colors = off\n"
            "log.file = false\ndisk_free_limit.absolute = 50MB\n"
            f"cluster_formation.target_cluster_size_hint = {max(1, len(self._peers))}\n"
            f"cluster_partition_handling = ignore\nnet_ticktime = 5\n{discovery}"
        )

    def _make_environment(self) -> dict[str, str]:
        folder = str(self.directory)
        return self.erlang.environment() | {
            "RABBITMQ_NODENAME": self.node,
            "RABBITMQ_MNESIA_BASE": f"{folder}/mnesia",
            "RABBITMQ_LOG_BASE": f"{folder}/log",
            "RABBITMQ_CONFIG_FILE": f"{folder}/rabbitmq",
            "RABBITMQ_ADVANCED_CONFIG_FILE": f"{folder}/advanced",
            "RABBITMQ_CONF_ENV_FILE": f"{folder}/none",
            "RABBITMQ_ENABLED_PLUGINS_FILE": f"{folder}/enabled_plugins",
            "RABBITMQ_DIST_PORT": str(self._distribution),
            "RABBITMQ_ALLOW_INPUT": "1",  # erl itself, without a shell around it
            "RABBITMQ_SERVER_ADDITIONAL_ERL_ARGS": "-noinput -kernel inet_dist_use_interface"
            f" {{127,0,0,1}} {_MODEST}",
            "LANG": "C.UTF-8",
        }

    def command(self) -> list[str | Path]:
        # The wrapper in /usr/sbin would become the system's user, whose folder this is not.
        return ["/usr/lib/rabbitmq/bin/rabbitmq-server"]

    def start(self) -> None:
        self.erlang.start()
        super().start()

    def _end(self, how: signal.Signals) -> None:
        super()._end(how)
        if self._owns_erlang:
            self.erlang.stop()


#: May publish below `fleet/r2d2/events/`, but not `secret`, nor to the state of the link, and
#: subscribe to `fleet/r2d2/cmd/#`. In topics RabbitMQ has a dot for a slash.
LIMITED = "limited"

_DEFINITIONS = {
    "users": [{"name": user, "password": PASSWORD, "tags": ""} for user in (USER, LIMITED)],
    "vhosts": [{"name": "/"}],
    "permissions": [
        {"user": user, "vhost": "/", "configure": ".*", "write": ".*", "read": ".*"}
        for user in (USER, LIMITED)
    ],
    "topic_permissions": [
        {
            "user": LIMITED,
            "vhost": "/",
            "exchange": "amq.topic",
            "write": r"^fleet\.r2d2\.events\.(?!secret)",
            "read": r"^fleet\.r2d2\.cmd\.",
        }
    ],
    "policies": [
        {
            "vhost": "/",
            "name": "all",
            "pattern": ".*",
            "apply-to": "queues",
            "definition": {"ha-mode": "all", "ha-sync-mode": "automatic"},
            "priority": 0,
        }
    ],
}


class RabbitCluster:
    """Three nodes of RabbitMQ that are one broker; `nodes` are as `RabbitMQ`."""

    def __init__(self, directory: Path, size: int = 3) -> None:
        needs("rabbitmq-server", "rabbitmq-server")
        names = [f"fleet{number}" for number in range(1, size + 1)]
        self.erlang = Erlang(directory)
        self.nodes = [
            RabbitMQ(directory / name, name, peers=names, erlang=self.erlang) for name in names
        ]
        self.starting_took = 0.0

    def __enter__(self) -> RabbitCluster:
        began = time.monotonic()
        try:
            # Each joins when the one before has: of two at a time the plugin refuses one now and
            # then (`cluster_change_not_permitted`), waits 100 s, and a node's restart then hangs.
            for node in self.nodes:
                node.start()
        except BaseException:
            self.__exit__()
            raise
        self.starting_took = time.monotonic() - began
        return self

    def __exit__(self, *_: object) -> None:
        for node in reversed(self.nodes):
            node.kill()
        self.erlang.stop()

    def memory(self) -> int:
        return sum(node.memory() for node in self.nodes)


class Ejabberd(Peer):
    """ejabberd with mod_mqtt, a second implementation of MQTT 5, on a plain port and a TLS port.

    `web_port` is MQTT over WebSocket (`/mqtt`), plain. A user name there is `USER` or
    `fleet@localhost`. It runs as this user and without Erlang's distribution.
    """

    name = "ejabberd"
    ready = r"^the users are registered"

    def __init__(self, directory: Path, *, options: str = "max_queue: 100000") -> None:
        needs("ejabberdctl", "ejabberd")
        self._program = needs("erl", "erlang-base")
        super().__init__(directory)
        self.plain_port, self.port, self.web_port = free_ports(3)
        make_certificates(directory / "certs")
        chain = [(directory / "certs" / name).read_text() for name in ("server.key", "server.crt")]
        pem = directory / "certs/server.pem"
        pem.touch(0o600)
        pem.write_text("".join(chain))
        (directory / "ejabberd.yml").write_text(
            f"loglevel: info\nhosts: [localhost]\nauth_method: internal\n"
            f"certfiles: [{pem}]\nlisten:\n"
            f"  - {{port: {self.plain_port}, ip: '{HOST}', module: mod_mqtt}}\n"
            f"  - {{port: {self.port}, ip: '{HOST}', module: mod_mqtt, tls: true}}\n"
            f"  - port: {self.web_port}\n    ip: '{HOST}'\n    module: ejabberd_http\n"
            "    request_handlers: {/mqtt: mod_mqtt}\n"
            f"modules:\n  mod_mqtt: {{session_expiry: 1 hour, {options}}}\n"
        )
        self.environment = {
            "HOME": str(directory),
            "ERL_LIBS": "/usr/lib/x86_64-linux-gnu",
            "EJABBERD_CONFIG_PATH": str(directory / "ejabberd.yml"),
            "EJABBERD_LOG_PATH": str(directory / "ejabberd.log"),
            "ERL_CRASH_DUMP_SECONDS": "0",
        }

    def command(self) -> list[str | Path]:
        user, host, password = (f'<<"{name}">>' for name in (USER, "localhost", PASSWORD))
        # After it was killed, it knows them only when their table is loaded.
        register = (
            f"Register = fun() -> ejabberd_auth:try_register({user}, {host}, {password}) end,"
            f"Knows = fun() -> ejabberd_auth:check_password({user}, <<>>, {host}, {password}) end,"
            "Pause = fun() -> timer:sleep(50) end,"
            "Wait = fun Again() -> Register(), Knows() orelse begin Pause(), Again() end end,"
            'Wait(), io:format("the users are registered~n").'
        )
        folder = f'"{self.directory}/spool"'
        start = ["-mnesia", "dir", folder, "-s", "ejabberd", "-eval", register]
        return [self._program, "-noinput", *_MODEST.split(), *start]

    def start(self) -> None:
        super().start()
        process = self._process
        # It may listen a little after that, when it reads what it had stored.
        _wait_for_port(self.plain_port, lambda: process is not None and process.poll() is None)


class Tinyproxy(Peer):
    """An HTTP proxy whose CONNECT leads to any port; with `login`, only for (user, password)."""

    name = "tinyproxy"
    ready = r"Accepting connections"

    def __init__(self, directory: Path, *, login: tuple[str, str] | None = None) -> None:
        self._program = needs("tinyproxy", "tinyproxy")
        super().__init__(directory)
        (self.plain_port,) = free_ports(1)
        self._login = login

    def command(self) -> list[str | Path]:
        config = self.directory / "tinyproxy.conf"
        login = "BasicAuth {} {}\n".format(*self._login) if self._login else ""
        config.write_text(
            f"Port {self.plain_port}\nListen {HOST}\nTimeout 600\nMaxClients 100\n"
            f"LogLevel Info\n{login}"
        )
        return [self._program, "-d", "-c", config]


class Haproxy(Peer):
    """haproxy with TLS on one port, which ALPN leads to one of `backends`, by protocol to a port.

    As `{"x-amzn-mqtt-ca": mqtt_port, "http/1.1": web_port}`. What asks for none of them gets
    nothing: the connection is closed after the handshake.
    """

    name = "haproxy"
    ready = r"Loading success|New worker|it listens"

    def __init__(self, directory: Path, backends: Mapping[str, int]) -> None:
        self._program = needs("haproxy", "haproxy")
        super().__init__(directory)
        (self.port,) = free_ports(1)
        self._backends = dict(backends)
        make_certificates(directory / "certs")
        chain = [(directory / "certs" / name).read_text() for name in ("server.crt", "server.key")]
        pem = directory / "certs/server.pem"
        pem.touch(0o600)
        pem.write_text("".join(chain))

    def command(self) -> list[str | Path]:
        config = self.directory / "haproxy.cfg"
        uses = "".join(
            f"  use_backend b{number} if {{ ssl_fc_alpn {name} }}\n"
            for number, name in enumerate(self._backends)
        )
        servers = "".join(
            f"backend b{number}\n  server s {HOST}:{port}\n"
            for number, port in enumerate(self._backends.values())
        )
        config.write_text(
            "global\n  maxconn 1000\n  log stdout format raw local0\n"
            "defaults\n  mode tcp\n  log global\n  option tcplog\n"
            "  timeout connect 5s\n  timeout client 10m\n  timeout server 10m\n"
            f"frontend fleet\n  bind {HOST}:{self.port} ssl crt {self.directory}/certs/server.pem"
            f" alpn {','.join(self._backends)}\n{uses}{servers}"
        )
        return [self._program, "-f", config]

    def start(self) -> None:
        began = time.monotonic()
        self._run(self.command())
        process = self._process
        try:
            _wait_for_port(self.port, lambda: process is not None and process.poll() is None)
        except AssertionError:
            log = self.log
            self.kill()
            raise AssertionError(f"haproxy does not start:\n{log}") from None
        self.starting_took = time.monotonic() - began
