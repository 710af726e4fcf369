"""Connecting to brokers: what leads there, and what is said when it does not.

Real brokers and proxies where it is about them, and servers that do one thing wrong.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import os
import socket
import ssl
import struct
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path

import pytest
import uvloop
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from saboteur import Saboteur
from waiting import PATIENCE, until

from appliance.broker.accounts import Account
from appliance.broker.faults import Faults
from appliance.config.urls import ProxyUrl, ServerUrl, parse_server
from appliance.mqtt.codec import V5
from appliance.mqtt.packets import Connect, Publish
from appliance.net import lingering
from appliance.net.callbacks import Entries
from appliance.net.layers import Schedulable, UpperLayer
from appliance.upstream import dial as dial_module
from appliance.upstream.dial import dial
from appliance.upstream.dial_error import DialError
from appliance.upstream.rules import UpstreamTls
from appliance.upstream.transport import (
    SYSTEM_UNSENT,
    TURN,
    WRITE_PORTION,
    Surroundings,
    UpstreamTransport,
)
from upstream.peers import PASSWORD, USER, FleetMosquitto, Tinyproxy, free_ports

pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')

#: The entries that this lets fail; test_containment.py counts on it.
ENTRIES = (
    "dial.abandoned",
    "dial.step",
    "dial.thread",
    "upstream.chunk",
    "upstream.cut",
    "upstream.eof",
    "upstream.gather",
    "upstream.look",
    "upstream.lost",
    "upstream.made",
    "upstream.pause",
    "upstream.resume",
)


@pytest.fixture(params=[asyncio.DefaultEventLoopPolicy, uvloop.EventLoopPolicy])
def event_loop_policy(request):
    return request.param()


class LayerScheduler:
    """Whose turn it is: in the next round of the loop."""

    def __init__(self) -> None:
        self.entries = Entries(asyncio.get_running_loop(), Faults())
        self.cost = 0
        self.turns = 0

    def count_cost(self, cost: int, charged: UpperLayer) -> None:
        self.cost += cost

    def must_wait(self, charged: UpperLayer, *, is_small: bool) -> bool:
        return False

    def queue_turn(self, member: Schedulable) -> None:
        self.turns += 1
        self.entries.soon("test.turn", member.take_turn)


class Site:
    """The appliance around a connection, and what it has in memory."""

    def __init__(self) -> None:
        self.scheduler = LayerScheduler()
        self.charged = 0
        self.around = Surroundings(self.scheduler, Account("upstream"), self.charge, 1 << 20)

    def charge(self, size: int) -> None:
        self.charged += size

    async def dial(
        self,
        url: str,
        tls: UpstreamTls | None = None,
        proxy: ProxyUrl | None = None,
        timeout: float = 20.0,
    ) -> UpstreamTransport:
        server = parse_server(url)
        return await dial(server, tls or UpstreamTls(), proxy, self.around, timeout)

    async def refusal(self, url: str, *args: object, **more: object) -> DialError:
        with pytest.raises(DialError) as caught:
            await self.dial(url, *args, **more)  # type: ignore[arg-type]
        return caught.value


def files() -> set[str]:
    """What the process has open: sockets by their numbers in the system."""
    found = set()
    for path in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            found.add(str(path.readlink()))
    return {name for name in found if name.startswith("socket:")}


@pytest.fixture
async def site() -> AsyncIterator[Site]:
    """Afterwards nothing may be left: no socket, no task, no memory, no fault."""
    before = files()
    made = Site()
    yield made
    await until(lambda: not made.scheduler.entries._tasks)
    await until(lambda: len(files()) <= len(before), "sockets are closed", 10)
    assert made.charged == 0
    assert made.scheduler.entries.faults.by_entry == {}


class Owner:
    """The link above the connection."""

    def __init__(self, transport: UpstreamTransport) -> None:
        self.data = bytearray()
        self.sizes: list[int] = []
        self.reasons: list[str] = []
        self.writables = 0
        self.more = 0  # so many turns it wants
        self.busy = 0.0
        transport.begin(self)

    def received(self, data: bytes) -> bool:
        assert not self.reasons and data and type(data) is bytes
        self.data += data
        self.sizes.append(len(data))
        if self.busy:
            end = time.perf_counter() + self.busy
            while time.perf_counter() < end:
                pass
        return self.more > 0

    def proceed(self) -> bool:
        self.more -= 1
        return self.more > 0

    def writable(self) -> None:
        self.writables += 1

    def lost(self, reason: str) -> None:
        self.reasons.append(reason)


CONNECT = Connect(client_id="dial", version=V5, username=USER, password=PASSWORD.encode()).encode(
    V5
)


async def is_accepted(transport: UpstreamTransport) -> None:
    """A broker is at the other end: it answers a CONNECT."""
    owner = Owner(transport)
    transport.write([CONNECT[:5], CONNECT[5:]])
    await until(lambda: len(owner.data) >= 4)
    assert owner.data[0] == 0x20 and owner.data[3] == 0
    transport.write([bytes([0xE0, 0])])
    transport.close("the end")
    await until(lambda: owner.reasons)
    assert owner.reasons == ["the end"]


# --- real brokers and proxies --------------------------------------------------------------------


@pytest.fixture(scope="module")
def web(tmp_path_factory) -> Iterator[FleetMosquitto]:
    """mosquitto with WebSocket, plain and over TLS, on `web` ports."""
    directory = tmp_path_factory.mktemp("web")
    ports = free_ports(2)
    certificates = directory / "certs"
    options = (
        f"listener {ports[0]} 127.0.0.1\nprotocol websockets\n"
        f"listener {ports[1]} 127.0.0.1\nprotocol websockets\ncafile {certificates}/ca.crt\n"
        f"certfile {certificates}/server.crt\nkeyfile {certificates}/server.key"
    )
    broker = FleetMosquitto(directory, options=options)
    broker.web_ports = ports  # type: ignore[attr-defined]
    with broker:
        yield broker


@pytest.mark.parametrize("scheme", ["mqtt", "mqtts", "ws", "wss"])
async def test_mosquitto_is_connected_to(site, web, scheme):
    ports = {"mqtt": web.plain_port, "mqtts": web.port, "ws": web.web_ports[0]}
    tls = UpstreamTls(ca=web.directory / "certs/ca.crt")
    port = ports.get(scheme, web.web_ports[1])
    await is_accepted(await site.dial(f"{scheme}://localhost:{port}", tls))


@pytest.fixture(scope="module")
def proxy(tmp_path_factory) -> Iterator[Tinyproxy]:
    with Tinyproxy(tmp_path_factory.mktemp("proxy"), login=("alice", "secret")) as running:
        yield running


async def test_through_a_proxy(site, web, proxy):
    way = ProxyUrl("127.0.0.1", proxy.plain_port, "alice", "secret")
    tls = UpstreamTls(ca=web.directory / "certs/ca.crt")
    await is_accepted(await site.dial(f"mqtts://127.0.0.1:{web.port}", tls, way))
    await is_accepted(await site.dial(f"wss://127.0.0.1:{web.web_ports[1]}", tls, way))


async def test_a_proxy_that_refuses(site, web, proxy):
    url, port = f"mqtt://127.0.0.1:{web.plain_port}", proxy.plain_port
    error = await site.refusal(url, None, ProxyUrl("127.0.0.1", port))
    assert error.step == "proxy" and "wants a user and a password" in str(error)
    error = await site.refusal(url, None, ProxyUrl("127.0.0.1", port, "alice", "wrong"))
    assert error.step == "proxy" and "password" in str(error) and "wrong" not in str(error)
    (free,) = free_ports(1)
    way = ProxyUrl("127.0.0.1", port, "alice", "secret")
    error = await site.refusal(f"mqtt://127.0.0.1:{free}", None, way)
    assert error.step == "proxy" and f"127.0.0.1:{free}" in str(error)
    error = await site.refusal(url, None, ProxyUrl("127.0.0.1", free))
    assert error.step == "connection" and "is a proxy listening there?" in str(error)
    error = await site.refusal(url, None, ProxyUrl("127.0.0.1", web.web_ports[0]), 2.0)
    assert error.step == "proxy"


# --- servers that do one thing wrong -------------------------------------------------------------


class Server:
    """Accepts connections on loopback, and does this with each in a thread."""

    def __init__(self, serve: Callable[[socket.socket], None]) -> None:
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self._serve = serve
        #: With the descriptors, which TLS takes over from the sockets.
        self._open: list[tuple[socket.socket, int, threading.Thread]] = []
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection = self._listening.accept()[0]
                thread = threading.Thread(target=self._run, args=(connection,), daemon=True)
                self._open.append((connection, connection.fileno(), thread))
                self._threads.append(thread)
                thread.start()

    def _run(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError, ssl.SSLError):
            self._serve(connection)

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        self._threads[0].join(10)  # behind it no connection is added
        for _, descriptor, thread in self._open:
            if thread.is_alive():
                with (
                    contextlib.suppress(OSError),
                    socket.socket(fileno=os.dup(descriptor)) as same,
                ):
                    same.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(10)
            assert not thread.is_alive()
        for connection, _, _ in self._open:
            connection.close()


def never(connection: socket.socket) -> None:
    """Reads, and says nothing."""
    while connection.recv(65536):
        pass


def saying(answer: bytes) -> Callable[[socket.socket], None]:
    def serve(connection: socket.socket) -> None:
        connection.recv(65536)
        connection.sendall(answer)
        never(connection)

    return serve


def cutting(connection: socket.socket) -> None:
    """Closes at the first bytes."""
    connection.recv(1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()


@pytest.mark.parametrize(
    ("scheme", "step"), [("mqtts", "tls"), ("ws", "websocket"), ("wss", "tls")]
)
async def test_a_server_that_never_answers(site, tmp_path, scheme, step):
    tls = UpstreamTls(ca=certify(tmp_path, "ca", "x"))  # to read all of the system's takes a while
    with Server(never) as server:
        error = await site.refusal(f"{scheme}://127.0.0.1:{server.port}", tls, timeout=3.0)
    assert error.step == step and "does not answer" in str(error)


@pytest.mark.parametrize("scheme", ["mqtts", "ws", "wss"])
async def test_a_server_that_cuts_in_the_middle(site, scheme):
    with Server(cutting) as server:
        error = await site.refusal(f"{scheme}://127.0.0.1:{server.port}")
    assert "closed" in str(error)


async def test_a_black_hole(site):
    """A listener with a full backlog: the system drops what asks for a connection."""
    with socket.socket() as hole, contextlib.ExitStack() as filling:
        hole.bind(("127.0.0.1", 0))
        hole.listen(0)
        port = hole.getsockname()[1]
        for _ in range(4):
            connection = filling.enter_context(socket.socket())
            connection.setblocking(False)
            connection.connect_ex(("127.0.0.1", port))
        error = await site.refusal(f"mqtt://127.0.0.1:{port}", timeout=0.5)
    assert error.step == "connection" and "does not answer within 0.5 s" in str(error)


async def test_nobody_listens(site):
    (port,) = free_ports(1)
    for host in ("127.0.0.1", "localhost"):
        error = await site.refusal(f"mqtt://{host}:{port}")
        assert error.step == "connection"
        assert "is a broker listening there?" in str(error), error


@pytest.mark.parametrize(
    ("problem", "said"),
    [
        (socket.gaierror(socket.EAI_NONAME, "unknown"), "does not resolve: is it written right"),
        (socket.gaierror(socket.EAI_AGAIN, "again"), "connected to a network"),
        (socket.gaierror(socket.EAI_FAIL, "failure"), "does not resolve: failure"),
    ],
)
async def test_a_name_that_does_not_resolve(site, monkeypatch, problem, said):
    def getaddrinfo(*args: object, **more: object) -> None:
        raise problem

    monkeypatch.setattr(dial_module.socket, "getaddrinfo", getaddrinfo)
    error = await site.refusal("mqtt://nowhere.example")
    assert error.step == "name" and said in str(error) and "nowhere.example" in str(error)


async def test_a_dns_server_that_does_not_answer(site, monkeypatch):
    over = threading.Event()
    monkeypatch.setattr(dial_module.socket, "getaddrinfo", lambda *_, **__: over.wait(20) and [])
    began = time.monotonic()
    error = await site.refusal("mqtt://nowhere.example", timeout=0.2)
    assert error.step == "name" and "reach a DNS server" in str(error)
    assert time.monotonic() - began < 10
    over.set()


async def test_the_next_address_is_tried_while_one_does_not_answer(site, monkeypatch):
    """Happy Eyeballs: the first address is a black hole, the second one a server."""
    with Server(never) as server, socket.socket() as hole, contextlib.ExitStack() as filling:
        hole.bind(("127.0.0.2", 0))
        hole.listen(0)
        for _ in range(4):
            connection = filling.enter_context(socket.socket())
            connection.setblocking(False)
            connection.connect_ex(hole.getsockname())
        found = [
            (socket.AF_INET, socket.SOCK_STREAM, 6, "", address)
            for address in (hole.getsockname(), ("127.0.0.1", server.port))
        ]
        monkeypatch.setattr(dial_module.socket, "getaddrinfo", lambda *_, **__: found)
        transport = await site.dial("mqtt://two.example")
        assert transport.info("peername")[1] == server.port
        transport.abort()
        monkeypatch.undo()


@pytest.mark.parametrize("after", [0.0, 0.002, 0.01, 0.05])
@pytest.mark.parametrize("scheme", ["mqtt", "mqtts", "wss"])
async def test_a_dial_that_is_cancelled_leaves_nothing(site, web, scheme, after):
    ports = {"mqtt": web.plain_port, "mqtts": web.port, "wss": web.web_ports[1]}
    tls = UpstreamTls(ca=web.directory / "certs/ca.crt")
    for number in range(5):
        work = asyncio.ensure_future(site.dial(f"{scheme}://localhost:{ports[scheme]}", tls))
        await asyncio.sleep(after * (number + 1) / 5)
        work.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            (await work).abort()


# --- TLS -----------------------------------------------------------------------------------------

DAY = datetime.timedelta(days=1)


def certify(directory: Path, name: str, *names: str, begins: float = -1, ends: float = 1) -> Path:
    """A certificate that signs itself, with its key in the same file; times in days from now."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.timezone.utc)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now + begins * DAY)
        .not_valid_after(now + ends * DAY)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(n) for n in names]), False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), True)
        .sign(key, hashes.SHA256())
    )
    path = directory / f"{name}.pem"
    path.write_bytes(
        certificate.public_bytes(serialization.Encoding.PEM)
        + key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )
    return path


def speaking_tls(context: ssl.SSLContext, seen: list[str] | None = None) -> Callable[..., None]:
    def serve(connection: socket.socket) -> None:
        context.sni_callback = lambda sock, name, _: None if seen is None else seen.append(name)
        with context.wrap_socket(connection, server_side=True) as wrapped:
            if seen is not None:
                seen.append(str(wrapped.selected_alpn_protocol()))
            while wrapped.recv(65536):
                pass

    return serve


def server_side(path: Path) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(path)
    return context


@pytest.mark.parametrize(
    ("names", "begins", "ends", "trusted", "said"),
    [
        (["other.example", "b.example"], -1, 1, True, "is for other.example, b.example, not for"),
        ([], -1, 1, True, "has no name in it"),
        (["localhost"], -2, -1, True, "has expired; by this computer's clock it is 20"),
        (["localhost"], 1, 2, True, "is not valid yet"),
        (["localhost"], -1, 1, False, "no authority that this computer trusts"),
    ],
)
async def test_a_certificate_that_is_not_accepted(
    site, tmp_path, names, begins, ends, trusted, said
):
    path = certify(tmp_path, "server", *names, begins=begins, ends=ends)
    with Server(speaking_tls(server_side(path))) as server:
        tls = UpstreamTls(ca=path if trusted else None)
        error = await site.refusal(f"mqtts://localhost:{server.port}", tls)
    assert error.step == "tls" and said in str(error)


async def test_another_ca(site, tmp_path):
    path, other = certify(tmp_path, "server", "localhost"), certify(tmp_path, "other", "x")
    with Server(speaking_tls(server_side(path))) as server:
        error = await site.refusal(f"mqtts://localhost:{server.port}", UpstreamTls(ca=other))
    assert f"of no authority that {other} (tls.ca) has" in str(error)


async def test_the_server_name_and_alpn(site, tmp_path):
    path = certify(tmp_path, "server", "fleet.example")
    context, seen = server_side(path), []
    context.set_alpn_protocols(["mqtt"])
    with Server(speaking_tls(context, seen)) as server:
        tls = UpstreamTls(ca=path, server_name="fleet.example", alpn=("mqtt",))
        (await site.dial(f"mqtts://127.0.0.1:{server.port}", tls)).abort()
        await until(lambda: len(seen) == 2)
    assert seen == ["fleet.example", "mqtt"]


async def test_the_files_are_read_at_each_connection(site, tmp_path):
    path = certify(tmp_path, "server", "localhost")
    ca = tmp_path / "ca.pem"
    with Server(speaking_tls(server_side(path))) as server:
        url = f"mqtts://localhost:{server.port}"
        error = await site.refusal(url, UpstreamTls(ca=ca))
        assert error.step == "files" and f"{ca} (tls.ca) cannot be read" in str(error)
        ca.write_text("nonsense")
        error = await site.refusal(url, UpstreamTls(ca=ca))
        assert error.step == "files" and "no certificate in PEM format" in str(error)
        ca.write_bytes(path.read_bytes())
        (await site.dial(url, UpstreamTls(ca=ca))).abort()


async def test_a_client_certificate(site, tmp_path):
    path = certify(tmp_path, "server", "localhost")
    client, other = certify(tmp_path, "client", "me"), certify(tmp_path, "other", "me")
    context = server_side(path)
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(client)
    with Server(speaking_tls(context)) as server:
        url = f"mqtts://localhost:{server.port}"
        transport = await site.dial(url, UpstreamTls(ca=path, certificate=client, key=client))
        owner = Owner(transport)
        await asyncio.sleep(0.1)
        assert not owner.reasons
        transport.abort()
        # In TLS 1.3 the refusal comes after the handshake.
        reasons = []
        for tls in (
            UpstreamTls(ca=path),
            UpstreamTls(ca=path, certificate=other, key=other),
        ):
            owner = Owner(await site.dial(url, tls))
            await until(lambda owner=owner: owner.reasons)
            reasons += owner.reasons
        assert "may want a client certificate" in reasons[0]
        assert f"does not accept the certificate {other}" in reasons[1]
        error = await site.refusal(url, UpstreamTls(ca=path, certificate=client, key=other))
        assert error.step == "files" and "are not a certificate and its key" in str(error)


async def test_a_key_with_a_password_is_not_asked_for(site, tmp_path):
    path = certify(tmp_path, "client", "me")
    key = ec.generate_private_key(ec.SECP256R1())
    locked = tmp_path / "locked.pem"
    locked.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.BestAvailableEncryption(b"secret"),
        )
    )
    tls = UpstreamTls(ca=path, certificate=path, key=locked)
    error = await site.refusal("mqtts://localhost:1", tls)
    assert error.step == "files" and "encrypted with a password" in str(error)


async def test_what_is_not_tls(site, web):
    for port in (web.plain_port, web.web_ports[0]):
        error = await site.refusal(f"mqtts://localhost:{port}", timeout=5.0)
        assert error.step == "tls"
    with Server(saying(b"HTTP/1.1 400 Bad Request\r\n\r\n")) as server:
        error = await site.refusal(f"mqtts://localhost:{server.port}")
    assert "is not TLS; is the port one for mqtt:// or ws://?" in str(error)


async def test_tls_that_is_too_old(site, tmp_path):
    path = certify(tmp_path, "server", "localhost")
    context = server_side(path)
    context.set_ciphers("DEFAULT@SECLEVEL=0")
    with pytest.warns(DeprecationWarning):
        context.minimum_version = ssl.TLSVersion.TLSv1
        context.maximum_version = ssl.TLSVersion.TLSv1_1
    with Server(speaking_tls(context)) as server:
        error = await site.refusal(f"mqtts://localhost:{server.port}", UpstreamTls(ca=path))
    assert error.step == "tls" and "older ones are not safe" in str(error)


# --- WebSocket -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (b"HTTP/1.1 404 Not Found\r\n\r\n", "no WebSocket at /mqtt: is the path right?"),
        (b"HTTP/1.1 403 Forbidden\r\n\r\n", "does not allow a WebSocket"),
        (b"HTTP/1.1 301 x\r\nLocation: https://b.example/\r\n\r\n", "https://b.example/"),
        (b"HTTP/1.1 200 OK\r\n\r\n<html>", "has no WebSocket at /mqtt (HTTP 200 OK)"),
        (b"HTTP/1.1 503 Down\r\n\r\n", "does not reach its broker"),
        (b"\x20\x03\0\0\0", "is not HTTP"),
        (b"HTTP/1.1 101 Yes\r\n\r\n", "is not that of a WebSocket"),
        (b"HTTP/1.1 101 Yes\r\nUpgrade: websocket\r\n\r\n", "is not that of a WebSocket"),
        (b"HTTP/1.1 1x1 Yes\r\n\r\n", "is not HTTP 1.1"),
        (b"HTTP/1.1 200 OK\r\n" + b"x: " + b"y" * 20_000, "longer than 16384 bytes"),
    ],
)
async def test_an_answer_that_is_no_websocket(site, answer, said):
    with Server(saying(answer)) as server:
        error = await site.refusal(f"ws://127.0.0.1:{server.port}")
    assert error.step == "websocket" and said in str(error)


def accept_websocket(connection: socket.socket, behind: bytes = b"") -> None:
    """Answer the client's request, with these frames behind the answer."""
    from websockets.exceptions import InvalidHandshake
    from websockets.server import ServerProtocol

    protocol = ServerProtocol(subprotocols=["mqtt"])  # type: ignore[list-item]
    protocol.receive_data(connection.recv(65536))
    with contextlib.suppress(InvalidHandshake):
        protocol.send_response(protocol.accept(protocol.events_received()[0]))
    connection.sendall(b"".join(protocol.data_to_send()) + behind)


async def test_frames_come_as_bytes_and_empty_ones_not_at_all(site):
    def serve(connection: socket.socket) -> None:
        accept_websocket(connection)
        connection.recv(1)  # so late that each comes in a chunk of its own
        for frame in (b"\x82\x00", b"\x82\x02ab", b"\x82\x00", b"\x82\x01c"):
            connection.sendall(frame)
            time.sleep(0.02)
        never(connection)

    with Server(serve) as server:
        transport = await site.dial(f"ws://127.0.0.1:{server.port}")
        owner = Owner(transport)
        transport.write([b"?"])
        await until(lambda: owner.data == b"abc")
        assert owner.sizes == [2, 1] or owner.sizes == [3]
        transport.abort()
        await until(lambda: owner.reasons)


async def test_what_websocket_has_received_does_not_wait_for_a_gathering(site):
    """Frames come out of it in portions; each of them may ask for one."""
    frames = (b"\x82\x7e" + struct.pack(">H", 2000) + bytes(2000)) * 10

    def serve(connection: socket.socket) -> None:
        accept_websocket(connection)
        connection.recv(1)
        connection.sendall(frames)
        never(connection)

    class Gathering(Owner):
        def received(self, data: bytes) -> bool:
            transport.gather(60.0)  # longer than anything waits here
            return super().received(data)

    with Server(serve) as server:
        transport = await site.dial(f"ws://127.0.0.1:{server.port}")
        owner = Gathering(transport)
        transport.write([b"?"])
        await until(lambda: len(owner.data) == 20_000)
        assert len(owner.sizes) > 1
        transport.abort()
        await until(lambda: owner.reasons)


@pytest.mark.parametrize("bad", ["text", "large", "rsv", "masked", "close"])
async def test_frames_that_end_a_websocket(site, bad):
    frames = {
        "text": b"\x81\x01x",
        "large": b"\x82\x7f" + (1 << 40).to_bytes(8, "big"),
        "rsv": b"\xf2\x01x",
        "masked": b"\x82\x81\0\0\0\0x",
        "close": b"\x88\x09" + struct.pack(">H", 1008) + b"go away",
    }
    got = bytearray()

    def serve(connection: socket.socket) -> None:
        accept_websocket(connection, b"\x82\x02ab" + b"\x89\x04ping")
        while len(got) < 10:
            got.extend(connection.recv(65536))
        connection.sendall(frames[bad])
        never(connection)

    with Server(serve) as server:
        transport = await site.dial(f"ws://127.0.0.1:{server.port}")
        owner = Owner(transport)
        await until(lambda: owner.reasons)
    assert owner.data == b"ab"
    assert got[0] == 0x8A and got[1] == 0x84  # a pong, masked
    said = {"text": "text frame", "large": "too large", "close": "1008 go away"}
    assert said.get(bad, "not the WebSocket protocol") in owner.reasons[0]
    assert transport.was_closed == (bad == "close")


# --- the transport -------------------------------------------------------------------------------


async def test_a_flood_does_not_hold_the_loop(site):
    """64 KiB chunks of ten-byte packets, each of which takes ten microseconds."""
    packet = Publish("a/b", b"xyz").encode(V5)[:10]
    flood = packet * 20_000

    def serve(connection: socket.socket) -> None:
        connection.sendall(flood)
        never(connection)

    with Server(serve) as server:
        transport = await site.dial(f"mqtt://127.0.0.1:{server.port}")
        owner = Owner(transport)
        owner.busy = 0.002  # a portion
        rounds, holds = 0, []
        last = time.thread_time()
        while len(owner.data) < len(flood):
            await asyncio.sleep(0)
            now = time.thread_time()
            holds.append(now - last)
            last = now
            rounds += 1
        assert bytes(owner.data) == flood
        # A portion begins within the turn, and takes as long as it takes.
        assert sorted(holds)[-3] < TURN + owner.busy + 0.003, sorted(holds)[-5:]
        assert max(owner.sizes) <= 2048
        transport.abort()


async def test_what_came_before_the_end_arrives_before_it(site):
    flood = os.urandom(500_000)

    def serve(connection: socket.socket) -> None:
        connection.sendall(flood)
        connection.close()

    with Server(serve) as server:
        owner = Owner(await site.dial(f"mqtt://127.0.0.1:{server.port}"))
        owner.busy, owner.more = 0.0001, 3
        await until(lambda: owner.reasons)
    assert bytes(owner.data) == flood
    assert owner.reasons == ["the broker has closed the connection"]
    assert owner.more == 0


async def test_nothing_is_received_while_reading_is_paused(site):
    with Server(saying(bytes(5000))) as server:
        transport = await site.dial(f"mqtt://127.0.0.1:{server.port}")
        owner = Owner(transport)
        transport.pause_reading()
        transport.write([b"x"])
        await asyncio.sleep(0.1)
        assert not owner.data
        transport.resume_reading()
        await until(lambda: len(owner.data) == 5000)
        transport.abort("enough")
        await until(lambda: owner.reasons)
        assert owner.reasons == ["enough"]


@pytest.mark.parametrize("scheme", ["mqtt", "mqtts"])
@pytest.mark.parametrize("held", [False, True], ids=["", "held"])
async def test_what_comes_while_it_gathers_comes_at_once(site, tmp_path, scheme, held):
    path = certify(tmp_path, "server", "localhost")
    said = threading.Event()

    def serve(connection: socket.socket) -> None:
        if scheme == "mqtts":
            connection = server_side(path).wrap_socket(connection, server_side=True)
        connection.recv(1)
        connection.sendall(b"first")
        connection.recv(1)
        for _ in range(20):
            connection.sendall(b"x")
            time.sleep(0.001)
        said.set()
        never(connection)

    with Server(serve) as server:
        transport = await site.dial(f"{scheme}://localhost:{server.port}", UpstreamTls(ca=path))
        owner = Owner(transport)
        transport.write([b"?"])
        await until(lambda: owner.data == b"first")  # behind it TLS has nothing unread
        owner.sizes.clear()
        transport.gather(20.0)
        transport.write([b"?"])
        await until(said.is_set)
        await asyncio.sleep(0.05)
        assert not owner.sizes
        if held:
            transport.pause_reading()
        transport._gather_timer.cancel()
        transport._gathered()
        if held:
            await asyncio.sleep(0.05)
            assert not owner.sizes
            transport.gather(20.0)
            transport.resume_reading()
            await asyncio.sleep(0.05)
            assert not owner.sizes
            transport._gather_timer.cancel()
            transport._gathered()
        await until(lambda: len(owner.data) == 5 + 20)
        assert owner.sizes == [20]
        transport.gather(20.0)
        transport.abort("enough")
        await until(lambda: owner.reasons)
        assert transport._gather_timer.cancelled()


@pytest.mark.parametrize("scheme", ["mqtt", "mqtts"])
async def test_little_is_unsent_while_the_broker_does_not_read(site, tmp_path, scheme):
    """In the system beyond what is in flight, and here."""
    path = certify(tmp_path, "server", "localhost")
    reads = threading.Event()

    def serve(connection: socket.socket) -> None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        if scheme == "mqtts":
            connection = server_side(path).wrap_socket(connection, server_side=True)
        reads.wait(20)
        never(connection)

    with Server(serve) as server:
        url = f"{scheme}://localhost:{server.port}"
        transport = await site.dial(url, UpstreamTls(ca=path))
        owner = Owner(transport)
        written = 0
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline:
            if transport.writable:
                transport.write([bytes(WRITE_PORTION)])
                written += WRITE_PORTION
            before = owner.writables
            await asyncio.sleep(0.05)
            if not transport.writable and owner.writables == before:
                break
        assert not transport.writable
        number = transport.info("socket").fileno()
        import fcntl

        (unsent,) = struct.unpack("i", fcntl.ioctl(number, 0x894B, b"\0" * 4))  # SIOCOUTQNSD
        here = transport._transport.get_write_buffer_size()
        assert here <= WRITE_PORTION + 1024
        assert unsent + here <= 64 * 1024 + 1024, (unsent, here)
        assert unsent <= SYSTEM_UNSENT + WRITE_PORTION + 1024
        reads.set()
        await until(lambda: owner.writables, "the call that says so")
        assert transport.writable
        transport.abort()


async def test_a_close_that_the_broker_does_not_read_is_cut(site):
    stop = threading.Event()

    def serve(connection: socket.socket) -> None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stop.wait(20)

    with Server(serve) as server:
        transport = await site.dial(f"mqtt://127.0.0.1:{server.port}")
        owner = Owner(transport)
        transport.write([bytes(30_000_000)])
        transport.close("bye", timeout=0.2)
        transport.write([b"ignored"])
        await until(lambda: owner.reasons)
        assert owner.reasons == ["bye"]
        stop.set()


async def test_the_last_bytes_arrive_though_the_broker_sends(site, monkeypatch):
    """A DISCONNECT, or the broker would publish the will."""
    monkeypatch.setattr(lingering, "TIMEOUT", PATIENCE)
    got = bytearray()

    def serve(connection: socket.socket) -> None:
        connection.sendall(bytes(200_000))
        while data := connection.recv(65536):
            got.extend(data)
            time.sleep(0.01)
        connection.close()

    with Server(serve) as server:
        transport = await site.dial(f"mqtt://127.0.0.1:{server.port}")
        owner = Owner(transport)
        transport.pause_reading()
        last = os.urandom(100_000)
        transport.write([last])
        transport.close("bye")
        await until(lambda: owner.reasons)
        await until(lambda: len(got) == len(last), "the last bytes")
        await until(
            lambda: transport._lingering is None or transport._lingering._socket.fileno() < 0
        )


async def test_a_reset_and_an_end_before_begin(site):
    with Server(cutting) as server:
        transport = await site.dial(f"mqtt://127.0.0.1:{server.port}")
        owner = Owner(transport)
        transport.write([b"x"])
        await until(lambda: owner.reasons)
        assert "reset" in owner.reasons[0]
        transport = await site.dial(f"mqtt://127.0.0.1:{server.port}")
        transport.write([b"x"])
        await until(lambda: transport.lost_reason)
        owner = Owner(transport)
        await until(lambda: owner.reasons)
        assert "reset" in owner.reasons[0]


# --- faults --------------------------------------------------------------------------------------


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.patches
async def test_a_fault_ends_one_connection_alone(site, escaped, monkeypatch, entry, behind):
    """Each entry raises once, before its work or after it; nothing is left, the next dial works."""
    saboteur = Saboteur(monkeypatch)
    over = threading.Event()

    def serve(connection: socket.socket) -> None:
        connection.recv(1)
        connection.sendall(b"hello")
        over.wait(20 if entry == "upstream.cut" else 0.3)
        if entry == "upstream.eof":  # and it reads on: else what waits holds up the end for 30 s
            connection.shutdown(socket.SHUT_WR)
        never(connection)
        connection.shutdown(socket.SHUT_RDWR)

    async def all_of_it(server: Server) -> Owner | None:
        waiting = asyncio.ensure_future(site.dial(f"mqtt://localhost:{server.port}"))
        await asyncio.sleep(0)
        waiting.cancel()
        with contextlib.suppress(DialError, asyncio.CancelledError):
            (await waiting).abort()
        try:
            transport = await site.dial(f"mqtt://localhost:{server.port}")
        except (DialError, RuntimeError) as error:
            assert "a fault in the appliance" in str(error)
            return None
        owner = Owner(transport)
        if entry == "upstream.look":
            monkeypatch.setattr(
                transport, "_unsent", lambda: 0 if entry in faults.by_entry else SYSTEM_UNSENT
            )
        if entry == "upstream.gather":
            transport.gather(0.05)
        transport.write([bytes(10_000_000)])
        if entry == "upstream.cut":
            transport.close("cut", 0.1)
        elif entry != "upstream.eof":
            await until(lambda: owner.reasons or (owner.data and transport.writable))
            transport.close("the end")
        await until(lambda: owner.reasons)
        assert len(owner.reasons) == 1
        return owner

    faults = site.scheduler.entries.faults
    with Server(serve) as server:
        saboteur.arm(*([] if behind else [entry]), behind=entry if behind else "")
        await all_of_it(server)
        await until(lambda: faults.by_entry.get(entry) == 1)
        assert faults.by_entry == {entry: 1}
        assert not saboteur.others
        after = await all_of_it(server)
        assert after is not None
        assert faults.by_entry == {entry: 1}
        over.set()
    faults.by_entry.clear()
    escaped.clear()


def test_the_address_of_a_server_has_brackets():
    assert ServerUrl("mqtt", "::1", 1).authority == "[::1]:1"
