"""Random configurations of mosquitto, as people write them, and random clients that try them."""

from __future__ import annotations

import base64
import hashlib
import random
import shutil
from dataclasses import dataclass, field
from pathlib import Path

from appliance import certs

ROBOT = "r2d2"
USERS = {"alice": "one", "bob": "two", "carol": "three", "c+d": "four", "e/f": "five"}

#: Who may show a certificate: of the CA, one that it has revoked, and one of another CA.
CERTIFICATES = ("alice", "robot-7", "bob", "foreign/alice")
REVOKED = "bob"

TOPICS = (
    *("a", "a/b", "a/b/c", "/a", "a//b", "b/a", "dev", "dev/alice/x", "dev/bob/x", "dev/c1/x"),
    *("dev-alice/x", "x-c1/a", "secret/a", "secret", "%u/x", f"{ROBOT}/a", "{robot}/a", "A/b"),
    *("dev/robot-7/x", "$SYS/own", "dev/secure-9/x", "with space/a", "dev/e/f/x"),
)
FILTERS = (
    *("#", "+", "+/#", "a/#", "a/+", "a/b", "+/b", "/a", "b/#", "dev/#", "dev/+/x", "secret/#"),
    *("$SYS/#", "{robot}/#", f"{ROBOT}/#", "with space/#", "dev/bob/x", "A/b"),
)
PATTERNS = (
    *("dev/%u/#", "dev/%c/#", "dev/%u/+", "dev-%u/x", "x-%c/a", "%u/#", "%c/#", "a/#", "#"),
    *("+/%u/x", "secret/#", "%u/%c", "dev/%u", "$SYS/#"),
)
CLIENT_IDS = ("c1", "alice", "secure-9", "x/y", "x+y", "", "robot-7", "#", "auto-1")


@dataclass(frozen=True)
class Login:
    """A client that logs in at one listener."""

    port: int
    tls: bool
    version: int
    client_id: str
    username: str | None
    password: str | None
    certificate: str | None

    def __str__(self) -> str:
        who = "anonymous" if self.username is None else f"{self.username!r}/{self.password!r}"
        shown = f" with the certificate of {self.certificate}" if self.certificate else ""
        version = {3: "3.1", 4: "3.1.1", 5: "5"}[self.version]
        return f"{who} as {self.client_id!r} at {self.port}, MQTT {version}{shown}"


@dataclass(frozen=True)
class Sent:
    """A message that a client publishes."""

    topic: str
    qos: int
    retain: bool
    size: int


@dataclass
class Case:
    """A configuration with its files, and what clients do."""

    files: dict[str, str] = field(default_factory=dict)
    logins: list[Login] = field(default_factory=list)
    #: By login: two filters with the QoS asked for.
    filters: list[list[tuple[str, int]]] = field(default_factory=list)
    sent: list[list[Sent]] = field(default_factory=list)
    wills: list[Sent | None] = field(default_factory=list)

    def write(self, directory: Path) -> Path:
        for name, text in self.files.items():
            path = directory / name
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
            path.chmod(0o600)
        return directory / "mosquitto.conf"


def make_certificates(directory: Path) -> None:
    """A CA with its clients, and one of another CA with a client of the same name."""
    names = certs.local_names()
    certs.create_authority(directory, "cell", *names)
    certs.issue_server(directory, *names)
    for name in CERTIFICATES[:3]:
        certs.issue_client(directory, name)
    shutil.copy(directory / "ca.crt", directory / "plain.crt")
    certs.revoke(directory, REVOKED)
    (directory / "plain").mkdir()  # no CRL lies beside it
    (directory / "plain.crt").rename(directory / "plain" / "ca.crt")
    (directory / "ca.crl").rename(directory / "revoked.pem")
    certs.create_authority(directory / "foreign", "other", *names)
    certs.issue_client(directory / "foreign", "alice")


def make(seed: int, ports: list[int], pki: Path) -> Case:
    """The case of that number; at most as many listeners as there are ports."""
    return _Maker(random.Random(seed), ports, pki).make()


class _Maker:
    def __init__(self, chance: random.Random, ports: list[int], pki: Path) -> None:
        self._chance = chance
        self._ports = ports
        self._pki = pki
        self._case = Case()
        self._secure: dict[int, bool] = {}

    def make(self) -> Case:
        self._configuration()
        self._clients()
        return self._case

    def _often(self, probability: float) -> bool:
        return self._chance.random() < probability

    # The configuration

    def _configuration(self) -> None:
        per_listener = self._often(0.4)
        lines = ["# made by chance", "user root", "log_dest stderr", "log_type all"]
        if per_listener:
            lines.append("per_listener_settings true")
        lines += self._general()
        ports = self._ports[: self._chance.choice((1, 1, 2, 3))]
        general, *_ = blocks = [self._security() for _ in range(1 + len(ports))]
        if not per_listener and self._often(0.2) and len(general) > 1:
            self._case.files["conf.d/rights.conf"] = "\n".join(general) + "\n"
            lines.append("include_dir conf.d")
        elif not per_listener or self._often(0.1):
            lines += general  # with settings by listener: for a listener that is none
        is_old = self._often(0.1) and not per_listener
        for index, port in enumerate(ports):
            if is_old and index == 0:
                lines += [f"port {port}", "bind_address 127.0.0.1"]
            else:
                lines.append(f"listener {port} 127.0.0.1")
            lines += self._listener(port)
            if per_listener:
                lines += blocks[1 + index]
        if self._often(0.15):
            lines += self._bridge()
        self._case.files["mosquitto.conf"] = "\n".join(lines) + "\n"

    def _general(self) -> list[str]:
        number = self._chance.randint
        lines = {
            f"max_packet_size {number(128, 400)}": 0.08,
            f"message_size_limit {number(20, 200)}": 0.12,
            "retain_available false": 0.12,
            f"clientid_prefixes {self._chance.choice(('c', 'secure-', 'auto-', 'a'))}": 0.12,
            f"max_keepalive {number(10, 100)}": 0.08,
            f"max_inflight_messages {number(0, 20)}": 0.1,
            f"max_queued_messages {number(100, 2000)}": 0.1,
            "allow_duplicate_messages false": 0.05,
            f"check_retain_source {self._chance.choice(('true', 'false'))}": 0.05,
            "persistence false": 0.2,
            "persistent_client_expiration 2d": 0.05,
            "upgrade_outgoing_qos true": 0.05,
            "queue_qos0_messages true": 0.05,
            "sys_interval 0": 0.1,
        }
        return [line for line, probability in lines.items() if self._often(probability)]

    def _security(self) -> list[str]:
        lines = []
        if self._often(0.7):
            lines.append(f"allow_anonymous {self._chance.choice(('true', 'false'))}")
        if self._often(0.55):
            lines.append(f"password_file {self._passwords()}")
        if self._often(0.6):
            lines.append(f"acl_file {self._rules()}")
        if self._often(0.1):
            lines.append("allow_zero_length_clientid false")
        if self._often(0.1):
            lines.append(f"auto_id_prefix {self._chance.choice(('auto-', 'c', 'secure-'))}")
        self._chance.shuffle(lines)
        return lines

    def _listener(self, port: int) -> list[str]:
        lines = []
        self._secure[port] = secure = self._often(0.45)
        if secure:
            lines += [f"certfile {self._pki}/server.crt", f"keyfile {self._pki}/server.key"]
            lines.append(f"cafile {self._pki}/{self._chance.choice(('', 'plain/'))}ca.crt")
            if self._often(0.6):
                lines.append("require_certificate true")
            if self._often(0.35):
                lines.append(f"use_identity_as_username {self._chance.choice(('true', 'true', 0))}")
            if self._often(0.12):
                lines.append("use_subject_as_username true")
            if self._often(0.3):
                lines.append(f"crlfile {self._pki}/revoked.pem")
        if self._often(0.15):
            lines.append(f"max_qos {self._chance.choice((0, 1, 2))}")
        if self._often(0.08):
            lines.append("use_username_as_clientid true")
        if self._often(0.05):
            lines.append("mount_point site/")
        if self._often(0.1):
            lines.append("max_connections 100")
        return lines

    def _bridge(self) -> list[str]:
        return [
            "connection far",
            "address 127.0.0.1:9",
            f"topic {self._chance.choice(TOPICS[:4])} {self._chance.choice(('in', 'out', 'both'))}",
            "remote_username far",
            "remote_password x",
            *(["local_username alice"] if self._often(0.5) else []),
        ]

    def _passwords(self) -> str:
        name = f"pw{self._chance.randint(1, 2)}"
        if name not in self._case.files:
            known = [user for user in USERS if self._often(0.75)]
            lines = ["# users", *(f"{user}:{_hash(USERS[user])}" for user in known)]
            if self._often(0.1) and known:
                user = self._chance.choice(known)  # a second line of a user
                lines.append(f"{user}:{_hash('other')}")
            if self._often(0.1):
                lines.append(f"mallory:{USERS['alice']}")  # a plain password
            self._case.files[name] = "\n".join(lines) + "\n"
        return name

    def _rules(self) -> str:
        name = f"acl{self._chance.randint(1, 2)}"
        if name not in self._case.files:
            lines = [self._rule() for _ in range(self._chance.choice((0, 0, 1, 2)))]
            users = [user for user in (*USERS, "robot-7", "eve") if self._often(0.4)]
            for user in users:
                lines += ["", f"user {user}"]
                lines += [self._rule() for _ in range(self._chance.choice((0, 1, 2, 3)))]
            if users and self._often(0.15):
                lines += [f"user {users[0]}", self._rule()]  # somebody a second time
            self._case.files[name] = "\n".join(lines) + "\n"
        return name

    def _rule(self) -> str:
        pattern = self._often(0.3)
        what = self._chance.choice(PATTERNS if pattern else FILTERS)
        rights = ("", "read ", "write ", "readwrite ", "readwrite ", "deny ")
        line = f"{'pattern' if pattern else 'topic'} {self._chance.choice(rights)}{what}"
        odd = self._chance.random()
        if odd < 0.03:
            return f"# {line}"
        if odd < 0.06:
            return f"{line}  "
        return line

    # The clients

    def _clients(self) -> None:
        ids = list(CLIENT_IDS)
        self._chance.shuffle(ids)
        for port, secure in self._secure.items():
            for _ in range(self._chance.randint(5, 8) if len(self._secure) < 3 else 5):
                client_id = ids.pop() if ids and self._often(0.6) else ""
                if not client_id and self._often(0.8):
                    client_id = f"c{len(self._case.logins) + 10}"
                self._login(port, secure, client_id)

    def _login(self, port: int, secure: bool, client_id: str) -> None:
        chance, case = self._chance, self._case
        username = chance.choice((None, None, *USERS, "alice", "bob", "eve", "mallory", ""))
        password = None if username is None else USERS.get(username, "one")
        if username is not None and self._often(0.2):
            password = chance.choice(("wrong", "other", "", None))
        shown = chance.choice((None, *CERTIFICATES, "alice", "robot-7")) if secure else None
        version = chance.choice((4, 5, 5, 5, 3)) if client_id else chance.choice((4, 5))
        case.logins.append(Login(port, secure, version, client_id, username, password, shown))
        case.filters.append([(chance.choice(FILTERS), chance.randint(0, 2)) for _ in range(2)])
        case.sent.append([self._sent(topic) for topic in TOPICS])
        case.wills.append(self._sent(chance.choice(TOPICS[:-4])) if self._often(0.1) else None)

    def _sent(self, topic: str) -> Sent:
        size = self._chance.choice((0, 0, 0, 150, 300))
        return Sent(topic, self._chance.choice((0, 1, 1, 2)), self._often(0.15), size)


def _hash(password: str) -> str:
    salt = b"saltsaltsalt"
    digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, 101)
    return f"$7$101${base64.b64encode(salt).decode()}${base64.b64encode(digest).decode()}"
