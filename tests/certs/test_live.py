"""Certificates of a running appliance: who they let in as whom, and what takes effect at once."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import socket
import ssl
import subprocess
import threading
import time
from collections.abc import Iterator
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import psutil
import pytest
from appliance_process import HOST, ApplianceProcess
from authorities import NOW, Company
from cryptography import x509
from raw_client import RawClient
from waiting import PATIENCE, eventually
from wall_clock import HOUR, WallClock
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import ClientConnection
from websockets.sync.client import connect as websocket
from websockets.typing import Subprotocol

from appliance import certs
from appliance.cli import main as cli
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import (
    Auth,
    Connack,
    Connect,
    Disconnect,
    Puback,
    Publish,
    Suback,
    Subscribe,
    Subscription,
)
from appliance.mqtt.reason import ReasonCode

ACL = """\
user alice
topic readwrite {robot}/#
topic read $SYS/#

user tablet
topic readwrite {robot}/tablet/#

user stranger
topic readwrite {robot}/#
"""

#: Seconds in which a change is to take effect.
PROMPT = 2.0


class Peer(RawClient):
    """A client of the TLS listener that may have a certificate."""

    def __init__(
        self, process: ApplianceProcess, certificate: str | None = None, port: int | None = None
    ) -> None:
        self.context = context_of(process, certificate)
        self.port = port or process.port
        super().__init__(process, 5, tls=True)

    def open(self, *, tls: bool) -> socket.socket:
        plain = socket.create_connection((HOST, self.port), PATIENCE)
        return self.context.wrap_socket(plain, server_hostname=HOST)

    def log_in(self, client_id: str, user: str | None = None, password: str | None = None) -> int:
        """The reason code of the CONNACK."""
        secret = None if password is None else password.encode()
        self.send(Connect(client_id, username=user, password=secret))
        answer = self.decode(self.receive())
        assert isinstance(answer, Connack)
        return answer.reason_code

    def subscribe(self, topic_filter: str) -> int:
        self.send(Subscribe(1, [Subscription(topic_filter, 1)]))
        answer = self.decode(self.receive())
        assert isinstance(answer, Suback)
        return answer.reason_codes[0]


def context_of(process: ApplianceProcess, certificate: str | None) -> ssl.SSLContext:
    context = process.tls_context()
    if certificate is not None:
        path = process.directory / "certs/clients" / certificate
        context.load_cert_chain(f"{path}.crt", f"{path}.key")
    return context


def is_reloadable(process: ApplianceProcess) -> bool:
    """Whether SIGHUP does not end it any more: it is the last thing that a start sets up."""
    [caught] = re.findall(r"SigCgt:\s*(\w+)", Path(f"/proc/{process.pid}/status").read_text())
    return bool(int(caught, 16) >> (signal.SIGHUP - 1) & 1)


def reload(process: ApplianceProcess, pattern: str = "reload: reloaded: ") -> None:
    eventually(lambda: is_reloadable(process), "the start is over")
    before = process.log.count(pattern)
    os.kill(process.pid, signal.SIGHUP)
    process.wait_for_log(pattern, before + 1)


def make(directory: Path, **tls: Any) -> ApplianceProcess:
    listeners = [
        {"bind": "127.0.0.1:0", "tls": True},
        {"bind": "127.0.0.1:0", "tls": True, "client_certificates": "required"},
        *(
            {
                "bind": "127.0.0.1:0",
                "tls": True,
                "client_certificates": "optional",
                "protocol": protocol,
            }
            for protocol in ("websocket", "web")
        ),
        {"bind": "127.0.0.1:0"},
    ]
    process = ApplianceProcess(
        directory, acl=ACL, broker={"listeners": listeners, "tls": tls or {"username_from": "none"}}
    )
    for name in ("tablet", "stranger"):
        certs.issue_client(directory / "certs", name)
    return process


@pytest.fixture
def process(tmp_path: Path) -> Iterator[ApplianceProcess]:
    with running(tmp_path) as process:
        yield process


@pytest.fixture(scope="module")
def unchanged(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ApplianceProcess]:
    """The same for all tests that change nothing about it."""
    with running(tmp_path_factory.mktemp("certs")) as process:
        yield process


@contextlib.contextmanager
def running(directory: Path) -> Iterator[ApplianceProcess]:
    process = make(directory, username_from="subject")
    process.start()
    try:
        process.port = _ports(process)[0]
        yield process
    finally:
        process.stop()


def _ports(process: ApplianceProcess) -> list[int]:
    """With TLS, with TLS and a certificate required, for WebSocket and the web with TLS, without
    TLS."""
    process.wait_for_log(r"listening ", 5)
    return [int(port) for port in re.findall(r"listening .*on \S+:(\d+)", process.log)]


# Who comes in


def test_a_certificate_is_a_login(unchanged: ApplianceProcess) -> None:
    with Peer(unchanged, "tablet") as peer:
        assert peer.log_in("a") == 0
        assert peer.subscribe("r2d2/tablet/#") == 1
        assert peer.subscribe("r2d2/other/#") == ReasonCode.NOT_AUTHORIZED
    unchanged.wait_for_log("client 'a' \\(user 'tablet'\\) at .* connected")
    with Peer(unchanged, "tablet") as peer:  # and may say so
        assert peer.log_in("a", "tablet", "whatever") == 0
    with Peer(unchanged, "tablet") as peer:
        assert peer.log_in("b", "alice", unchanged.passwords["alice"]) == ReasonCode.NOT_AUTHORIZED
    unchanged.wait_for_log("its certificate is of user 'tablet', and it says to be another one")
    with Peer(unchanged) as peer:  # who has none needs a password, as ever
        assert peer.log_in("c", "alice", unchanged.passwords["alice"]) == 0
    with Peer(unchanged) as peer:
        assert peer.log_in("d", "tablet") == ReasonCode.NOT_AUTHORIZED


UPGRADE = (
    "GET /mqtt HTTP/1.1\r\nHost: robot:1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Protocol: mqtt\r\n{}\r\n"
)


@pytest.mark.parametrize(
    ("certificate", "origins", "status"),
    [
        ("tablet", [], 101),
        ("tablet", ["https://robot:1"], 101),
        ("tablet", ["https://evil.example"], 403),
        ("tablet", ["http://robot:1"], 403),
        ("tablet", ["null"], 403),
        ("tablet", ["https://robot:1", "https://evil.example"], 403),
        (None, ["https://evil.example"], 101),  # whose page has to know a password
    ],
)
def test_a_page_of_another_site_cannot_use_a_browsers_certificate(
    unchanged: ApplianceProcess, certificate: str | None, origins: list[str], status: int
) -> None:
    """A listener for WebSocket alone; `tests/web` has the one for the web."""
    port = _ports(unchanged)[2]
    with socket.create_connection((HOST, port), PATIENCE) as plain:
        tls = context_of(unchanged, certificate).wrap_socket(plain, server_hostname=HOST)
        fields = "".join(f"Origin: {each}\r\n" for each in origins)
        tls.sendall(UPGRADE.format(fields).encode())
        assert tls.recv(4096).startswith(f"HTTP/1.1 {status} ".encode())


def test_a_session_of_the_certificates_user_is_no_one_elses(unchanged: ApplianceProcess) -> None:
    with Peer(unchanged, "tablet") as peer:
        assert peer.log_in("mine") == 0
        with Peer(unchanged, "stranger") as other:
            assert other.log_in("mine") not in (0,)
        peer.drain()


def test_enhanced_authentication_is_not_for_who_has_a_certificate(
    unchanged: ApplianceProcess,
) -> None:
    properties = {Property.AUTHENTICATION_METHOD: "SCRAM-SHA-256"}
    with Peer(unchanged, "tablet") as peer:
        peer.send(Connect("a", properties=dict(properties)))
        answer = peer.decode(peer.receive())
        assert isinstance(answer, Connack)
        assert answer.reason_code == ReasonCode.BAD_AUTHENTICATION_METHOD
    with Peer(unchanged) as peer:
        peer.send(Connect("a", properties=dict(properties)))
        assert isinstance(peer.decode(peer.receive()), Auth)


def test_a_listener_that_requires_certificates(unchanged: ApplianceProcess) -> None:
    port = _ports(unchanged)[1]
    with Peer(unchanged, "tablet", port) as peer:
        assert peer.log_in("a") == 0
    with pytest.raises((ssl.SSLError, ConnectionError)), Peer(unchanged, None, port) as peer:
        peer.log_in("b", "alice", unchanged.passwords["alice"])
    unchanged.wait_for_log("it has no client certificate, and one is required")


def test_a_certificate_of_someone_else(unchanged: ApplianceProcess) -> None:
    Company().issue(unchanged.directory / "certs/clients/foreign", "alice")
    with pytest.raises((ssl.SSLError, ConnectionError)), Peer(unchanged, "foreign") as peer:
        peer.log_in("a")
    unchanged.wait_for_log("the client's certificate is not accepted: unable to get local issuer")


@pytest.mark.skipif(shutil.which("mosquitto_sub") is None, reason="mosquitto-clients not installed")
def test_mosquittos_clients(unchanged: ApplianceProcess) -> None:
    clients = unchanged.directory / "certs/clients"
    common = ["-h", HOST, "-p", str(unchanged.port), "--cafile", str(unchanged.ca), "-V", "5"]
    certificate = ["--cert", f"{clients}/tablet.crt", "--key", f"{clients}/tablet.key"]
    listening = subprocess.Popen(
        ["mosquitto_sub", *common, *certificate, "-t", "r2d2/tablet/x", "-q", "1", "-C", "1"],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        unchanged.wait_for_log("user 'tablet'\\) at .* connected")
        publish = ["mosquitto_pub", *common, *certificate, "-q", "1", "-m", "hello"]
        deadline = time.monotonic() + PATIENCE
        while listening.poll() is None and time.monotonic() < deadline:
            subprocess.run([*publish, "-t", "r2d2/tablet/x"], check=True, timeout=PATIENCE)
        assert listening.communicate(timeout=PATIENCE)[0] == "hello\n"
    finally:
        listening.kill()
        listening.wait()


def test_our_own_client(unchanged: ApplianceProcess, capfdbinary) -> None:
    certs.write_bundle(unchanged.directory / "certs", "tablet")
    clients = unchanged.directory / "certs/clients"
    where = ["-H", HOST, "-p", str(unchanged.port), "--ca", str(unchanged.ca)]
    pair = ["--cert", f"{clients}/tablet.crt", "--key", f"{clients}/tablet.key"]

    def run(*arguments: str) -> tuple[int, bytes]:
        with pytest.raises(SystemExit) as ended:
            cli.main(list(arguments))
        return int(ended.value.code or 0), capfdbinary.readouterr().err

    bundle = ["--cert", f"{clients}/tablet.pem"]
    assert run("pub", "r2d2/tablet/x", "-m", "1", *where, *bundle) == (0, b"")
    assert run("pub", "r2d2/tablet/x", "-m", "1", *where, *pair) == (0, b"")
    code, error = run("pub", "r2d2/other", "-m", "1", *where, *pair)
    assert code == 1 and b"was refused: Not authorized" in error
    code, error = run("pub", "r2d2/tablet/x", "-m", "1", *where, *pair[:2])
    assert code == 1 and b"tablet.crt (without --key): no certificate with its key" in error


# What takes effect while it runs


@pytest.mark.timed
def test_revoked_while_connected(process: ApplianceProcess) -> None:
    with Peer(process, "tablet") as peer, Peer(process, "stranger") as other, Peer(process) as user:
        assert peer.log_in("a") == other.log_in("b") == 0
        assert user.log_in("c", "alice", process.passwords["alice"]) == 0
        resumable = peer.socket.session
        [entry] = certs.revoke(process.directory / "certs", "tablet")
        begun = time.monotonic()
        os.kill(process.pid, signal.SIGHUP)
        answer = peer.decode(peer.receive())
        assert answer == Disconnect(ReasonCode.NOT_AUTHORIZED)
        assert peer.receive() == b""
        assert time.monotonic() - begun < PROMPT
        process.wait_for_log(f"connection closed: its certificate {entry.serial_text} was revoked")
        assert other.drain() == user.drain() == []
        assert resumable is not None
        for number, session in enumerate((None, resumable), 1):
            plain = socket.create_connection((HOST, process.port), PATIENCE)
            with peer.context.wrap_socket(plain, server_hostname=HOST, session=session) as again:
                process.wait_for_log("no TLS connection: .*certificate revoked", number)
                for _ in range(2):  # in TLS 1.3 it does not know yet, and what it sends is no error
                    again.sendall(Connect("a").encode())
                with pytest.raises(ssl.SSLError, match=r"(?i)alert.certificate.revoked"):
                    again.recv(100)


@pytest.mark.parametrize("version", ["tls1_2", "tls1_3"])
@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_openssl_is_told_that_it_is_revoked_or_expired(
    process: ApplianceProcess, version: str
) -> None:
    directory = process.directory / "certs"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(certs.authority, "_now", lambda: NOW - certs.authority.CERTIFICATE_VALID * 2)
        patch.setattr(certs.authority, "out_of_time", lambda *_: "")
        certs.issue_client(directory, "old")
    certs.revoke(directory, "tablet")
    reload(process, "reload: reloaded: certificates")

    def ask(name: str) -> str:
        path = directory / "clients" / name
        where = ["-connect", f"{HOST}:{process.port}", f"-{version}", "-CAfile", str(process.ca)]
        pair = ["-cert", f"{path}.crt", "-key", f"{path}.key"]
        with subprocess.Popen(
            ["openssl", "s_client", *where, *pair, "-ign_eof"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
        ) as client:
            try:
                return client.communicate(timeout=PATIENCE)[0]
            finally:
                client.kill()

    assert "SSL alert number 44" in ask("tablet")
    assert "SSL alert number 45" in ask("old")


@pytest.mark.skipif(shutil.which("mosquitto_sub") is None, reason="mosquitto-clients not installed")
@pytest.mark.parametrize("version", ["tlsv1.2", "tlsv1.3"])
def test_mosquitto_says_that_it_is_revoked(process: ApplianceProcess, version: str) -> None:
    clients = process.directory / "certs/clients"
    certs.revoke(process.directory / "certs", "tablet")
    reload(process, "reload: reloaded: certificates")
    where = ["-h", HOST, "-p", str(process.port), "--cafile", str(process.ca)]
    where += ["--tls-version", version]
    pair = ["--cert", f"{clients}/tablet.crt", "--key", f"{clients}/tablet.key"]
    ended = subprocess.run(
        ["mosquitto_sub", *where, *pair, "-d", "-t", "r2d2/tablet/x", "-C", "1"],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert ended.returncode and "alert certificate revoked" in ended.stdout, ended


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_a_certificate_runs_out(tmp_path: Path, version: ssl.TLSVersion) -> None:
    """Who is connected goes, and comes back neither with it nor by resuming the TLS session."""
    process = make(tmp_path, username_from="subject")
    company = Company()
    process.ca.write_bytes(process.ca.read_bytes() + company.pem())
    elapsed = (datetime.now(timezone.utc) - NOW) / timedelta(days=1)  # NOW is when it was imported
    company.issue(tmp_path / "certs/clients/short", "tablet", days=elapsed + 1 / 24)
    clock = WallClock(tmp_path / "clock")
    process.environment = clock.environment
    process.start()
    try:
        process.port = _ports(process)[0]
        with Peer(process, "short") as peer:
            peer.context.maximum_version = version
            assert peer.log_in("a") == 0
        context = context_of(process, "short")
        context.maximum_version = version
        session: ssl.SSLSession | None = None

        def log_in() -> bytes:
            nonlocal session
            plain = socket.create_connection((HOST, process.port), PATIENCE)
            with context.wrap_socket(plain, server_hostname=HOST, session=session) as again:
                assert again.session_reused is (session is not None)
                again.sendall(Connect("b", clean_start=True).encode())
                answer = again.recv(100)
                session = again.session
                return answer

        for _ in range(3):
            assert log_in()[0] == 0x20
        with Peer(process, "short") as peer:
            assert peer.log_in("a") == 0
            clock.set(1.2 * HOUR)  # not so far that the TLS session has run out
            answer = peer.decode(peer.receive())
            assert answer == Disconnect(ReasonCode.NOT_AUTHORIZED)
        process.wait_for_log("connection closed: its certificate .* expired on ")
        for _ in range(3):
            assert log_in() == b""
        process.wait_for_log("no TLS connection: its certificate .* expired on ", 1)
    finally:
        process.stop()


@pytest.mark.timed
def test_revoked_while_it_does_not_read(process: ApplianceProcess) -> None:
    """It may have what was sent before, but not for long."""
    with Peer(process, "tablet") as peer, Peer(process, "stranger") as other:
        assert peer.log_in("a") == other.log_in("b") == 0
        assert peer.subscribe("r2d2/tablet/#") == 1
        for _ in range(40):
            other.send(Publish("r2d2/tablet/x", bytes(500_000), 0))
        other.drain()
        port = peer.socket.getsockname()[1]
        broker = psutil.Process(process.pid)

        def is_connected() -> bool:
            return any(c.raddr and c.raddr.port == port for c in broker.net_connections("tcp"))

        assert is_connected()
        certs.revoke(process.directory / "certs", "tablet")
        os.kill(process.pid, signal.SIGHUP)
        eventually(lambda: not is_connected(), "the connection is closed", PROMPT)
        other.drain()


def test_revoked_over_websocket(process: ApplianceProcess) -> None:
    url = f"wss://{HOST}:{_ports(process)[2]}/mqtt"
    context = context_of(process, "tablet")

    def dial() -> ClientConnection:
        return websocket(url, ssl=context, subprotocols=[Subprotocol("mqtt")], proxy=None)

    with dial() as connection:
        connection.send(Connect("a").encode())
        answer = connection.recv(PATIENCE)
        assert isinstance(answer, bytes) and (answer[0], answer[3]) == (0x20, ReasonCode.SUCCESS)
        certs.revoke(process.directory / "certs", "tablet")
        os.kill(process.pid, signal.SIGHUP)
        with pytest.raises(ConnectionClosed):
            while connection.recv(PATIENCE):
                pass
    with pytest.raises((ssl.SSLError, ConnectionError, EOFError, WebSocketException)), dial():
        pass


def test_revoked_over_http(process: ApplianceProcess) -> None:
    """Neither a connection that was kept goes on, nor a body that is on its way, nor a new one."""
    port, context = _ports(process)[3], context_of(process, "tablet")
    body = b'{"topic": "r2d2/tablet/x", "payload": 1}'
    post = (
        b"POST /api/v1/publish HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        b"Content-Length: %d\r\n\r\n" % len(body)
    )

    def dial() -> ssl.SSLSocket:
        plain = socket.create_connection((HOST, port), PATIENCE)
        return context.wrap_socket(plain, server_hostname=HOST)

    with dial() as kept, dial() as slow:
        kept.sendall(post + body)
        assert kept.recv(4096).startswith(b"HTTP/1.1 200 ")
        slow.sendall(post + body[:-1])
        process.wait_for_log(r"client '.*' \(user 'tablet'\) at .* connected", 2)
        certs.revoke(process.directory / "certs", "tablet")
        os.kill(process.pid, signal.SIGHUP)
        for each in (kept, slow):
            assert each.recv(4096) == b""
    with pytest.raises((ssl.SSLError, ConnectionError)), dial() as again:
        again.sendall(post + body)
        assert not again.recv(4096)
        raise ConnectionError  # in TLS 1.3 it may be told as late as this


def test_the_servers_certificate_is_replaced_under_load(process: ApplianceProcess) -> None:
    """Every message arrives, in order; nobody is disconnected; who comes then sees the new one."""
    directory = process.directory / "certs"
    received: list[int] = []
    acknowledged: list[int] = []
    stop = threading.Event()

    def listen(peer: Peer) -> None:
        while not received or received[-1] >= 0:
            message = peer.decode(peer.receive())
            assert isinstance(message, Publish) and message.packet_id
            peer.send(Puback(message.packet_id))
            received.append(int(message.payload))

    def publish(peer: Peer) -> None:
        number = 0
        while not stop.is_set():
            peer.send(Publish("r2d2/tablet/n", b"%d" % number, 1, packet_id=number % 60000 + 1))
            answer = peer.decode(peer.receive())
            assert isinstance(answer, Puback) and answer.reason_code == 0
            acknowledged.append(number)
            number += 1
        peer.send(Publish("r2d2/tablet/n", b"-1", 1, packet_id=60001))
        peer.receive()

    def serial() -> int:
        with Peer(process, "tablet") as newcomer:
            assert newcomer.log_in("new") == 0
            der = newcomer.socket.getpeercert(binary_form=True)  # type: ignore[attr-defined]
            return x509.load_der_x509_certificate(der).serial_number

    with Peer(process, "tablet") as subscriber, Peer(process, "stranger") as publisher:
        assert subscriber.log_in("sub") == publisher.log_in("pub") == 0
        assert subscriber.subscribe("r2d2/tablet/#") == 1
        threads = [
            threading.Thread(target=listen, args=(subscriber,)),
            threading.Thread(target=publish, args=(publisher,)),
        ]
        for thread in threads:
            thread.start()
        try:
            seen = {serial()}
            for _ in range(3):
                before = len(acknowledged)
                certs.renew(directory, "server")
                reload(process, "reload: reloaded: certificates")
                seen.add(serial())
                eventually(lambda b=before: len(acknowledged) > b + 20, "the load goes on")
        finally:
            stop.set()
            for thread in threads:
                thread.join(PATIENCE)
    assert len(seen) == 4
    assert received == [*acknowledged, -1]
    assert not any(thread.is_alive() for thread in threads)


def test_what_is_wrong_changes_nothing(process: ApplianceProcess) -> None:
    directory = process.directory / "certs"
    with Peer(process, "tablet") as peer:
        assert peer.log_in("a") == 0
        certs.revoke(directory, "tablet")
        (directory / "server.key").chmod(0o644)
        reload(process, "not reloaded, what was in force stays so: .*server.key is a private key")
        peer.drain()
        with Peer(process, "tablet") as another:
            assert another.log_in("b") == 0
        (directory / "server.key").chmod(0o600)
        os.kill(process.pid, signal.SIGHUP)
        assert isinstance(peer.decode(peer.receive()), Disconnect)


def test_another_authority_for_clients(process: ApplianceProcess) -> None:
    directory = process.directory / "certs"
    company = Company()
    company.issue(directory / "clients/alice", "alice")
    with Peer(process, "tablet") as peer, Peer(process) as user:
        assert peer.log_in("a") == 0
        assert user.log_in("c", "alice", process.passwords["alice"]) == 0
        own = process.ca.read_bytes()
        process.ca = process.directory / "own-ca.crt"
        process.ca.write_bytes(own)
        (directory / "ca.crt").write_bytes(company.pem())
        os.kill(process.pid, signal.SIGHUP)
        assert peer.decode(peer.receive()) == Disconnect(ReasonCode.NOT_AUTHORIZED)
        assert user.drain() == []
        with Peer(process, "alice") as newcomer:
            assert newcomer.log_in("d") == 0


# What is there at the start


def test_a_certificate_that_ends_is_renewed_at_the_start(tmp_path: Path) -> None:
    process = make(tmp_path)
    directory = tmp_path / "certs"
    names, addresses = certs.local_names()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            certs.authority, "_now", lambda: NOW - (certs.authority.CERTIFICATE_VALID * 2)
        )
        patch.setattr(certs.authority, "out_of_time", lambda *_: "")
        certs.issue_server(directory, names, addresses)
    [old] = certs.load_certificates(directory / "server.crt")
    assert old.not_valid_after_utc < NOW
    process.start()
    try:
        process.port = _ports(process)[0]
        process.wait_for_log("the server's certificate was renewed: it would have ended on ")
        with Peer(process) as peer:
            assert peer.log_in("a", "alice", process.passwords["alice"]) == 0
    finally:
        process.stop()


def test_what_runs_out_is_told(tmp_path: Path) -> None:
    process = make(tmp_path, client_certificates="required")
    names: list[x509.GeneralName] = [x509.DNSName("localhost")]
    company = Company()
    path = tmp_path / "certs/server"
    company.issue(path, "robot", server=True, alternatives=names, days=5)
    process.start()
    try:
        process.wait_for_log(r"server\.crt expires on .*; renew it")
        process.port, process.ca = _ports(process)[0], tmp_path / "company.crt"
        process.ca.write_bytes(company.pem())
        with Peer(process, "tablet") as peer:  # without `username_from` a password is needed, too
            assert peer.log_in("a") == ReasonCode.NOT_AUTHORIZED
        with Peer(process, "tablet") as peer:
            assert peer.log_in("a", "alice", process.passwords["alice"]) == 0
    finally:
        process.stop()
