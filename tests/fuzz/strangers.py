"""What strangers send who have no password: nothing of others is seen by them, or changed.

alice has left a session with messages that wait, and retained messages. The strangers know her
name, her client ids and her topics, and try everything else. When they are gone it is all still
there, down to the files.
"""

from __future__ import annotations

import asyncio
import hashlib
import random
import re
import secrets
import ssl
from pathlib import Path

from appliance_process import HOST
from codec import Found
from inputs import Source, chunks, damage
from raw_client import RawClient
from sessions import KINDS, Session, Siege, check_answer
from websockets.frames import Frame, Opcode

from appliance import certs
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import (
    V5,
    V311,
    Connack,
    Packet,
    Puback,
    Publish,
    Suback,
    Subscribe,
    Subscription,
)

LISTENERS = [
    {"bind": "127.0.0.1:0", "tls": True},
    {"bind": "127.0.0.1:0"},
    {"bind": "127.0.0.1:0", "protocol": "websocket"},
]

#: Beside "plain" and "tls": TLS with a certificate of another authority that says it is alice's,
#: what is no TLS on the port that has it, and WebSocket.
TRANSPORTS = ("plain", "plain", "tls", "foreign", "clear", "websocket")

#: The session of alice that waits, and another that she never had.
PHONE = "alice-phone"
CLIENT_IDS = (PHONE, PHONE, "canary", "", "f1")

#: Messages of each QoS that wait for it, and retained messages.
WAITING = 10
RETAINED = 5

UPGRADE = (
    b"GET /mqtt HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Protocol: mqtt\r\n\r\n"
)


class Strangers(Siege):
    """An appliance with something to steal and to spoil, and strangers without end."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory, listeners=LISTENERS, audit={"path": "audit.log"})
        self._directory = directory
        #: Part of all that is alice's: no stranger may ever read it.
        self._treasure = secrets.token_hex(16).encode()
        self._left: list[tuple[str, bytes]] = []
        certs.create_authority(directory / "elsewhere")
        certs.issue_client(directory / "elsewhere", "alice")
        self._foreign: ssl.SSLContext
        self._web_port = 0
        self._files: dict[Path, str] = {}

    def prepare(self) -> None:
        """alice leaves her things behind."""
        self._foreign = self.appliance.tls_context()
        alices = self._directory / "elsewhere/clients/alice"
        self._foreign.load_cert_chain(f"{alices}.crt", f"{alices}.key")
        [line] = self.appliance.wait_for_log(r"listening for WebSocket on \S+:\d+$")
        self._web_port = int(line.rpartition(":")[2])
        with RawClient(self.appliance, V5) as phone:
            _log_in(phone, PHONE)
            topics = [Subscription("r2d2/waiting/#", 2), Subscription("r2d2/kept/+", 0)]
            phone.send(Subscribe(1, topics))
            assert isinstance(phone.decode(phone.receive()), Suback)
            phone.kill()
        with RawClient(self.appliance, V5) as alice:
            _log_in(alice, "alice")
            for number in range(WAITING):
                self._left.append(("r2d2/waiting/x", self._treasure + b" %d" % number))
                alice.send(Publish(*self._left[-1], qos=1, packet_id=number + 1))
                assert isinstance(alice.decode(alice.receive()), Puback)
            for number in range(RETAINED):
                alice.send(Publish(*self._retained(number), qos=0, retain=True))
            alice.drain()
        self._files = self._fingerprints()

    def examine(self) -> None:
        """She finds it as she left it."""
        known = {PHONE, "alice", "canary"}
        log = self.appliance.log
        for client_id in re.findall(r"client '(.*)' \(user .*\) at \S+ connected", log):
            if client_id not in known:
                raise Found(f"{client_id!r} came in")
        if self._treasure.decode() in log:
            raise Found("a payload is in the log")
        if self._fingerprints() != self._files:
            raise Found("a file has changed")
        with RawClient(self.appliance, V5) as phone:
            if not _log_in(phone, PHONE).session_present:
                raise Found("alice's session is gone")
            found = _messages(phone)
            if found != self._left:
                raise Found(f"of alice's messages there are {found}")
            phone.send(Subscribe(2, [Subscription("r2d2/#", 0)]))
            wanted = [self._retained(number) for number in range(RETAINED)]
            kept = sorted(each for each in _messages(phone) if "_appliance" not in each[0])
            if kept != wanted:
                raise Found(f"of alice's retained messages there are {kept}")

    def _retained(self, number: int) -> tuple[str, bytes]:
        return f"r2d2/kept/{number}", self._treasure + b" kept %d" % number

    def _fingerprints(self) -> dict[Path, str]:
        files = [path for path in self._directory.rglob("*") if path.is_file()]
        return {
            path: hashlib.sha256(path.read_bytes()).hexdigest()
            for path in files
            if path.parent.name != "state" and not path.name.startswith("audit.log")
        }

    def make(self, rng: random.Random) -> Session:
        """Random bytes, or what a client could say who does not know the password."""
        version = rng.choice((V311, V5))
        transport = rng.choice(TRANSPORTS)
        source = Source(rng, rng.choice(("r2d2/waiting", "r2d2/kept", "$SYS")))
        user = rng.choice(("alice", "alice", "mallory", None, source.text(30)))
        connect = source.connect(version, rng.choice(CLIENT_IDS), user, source.binary())
        if user is not None and rng.random() < 0.1:
            connect.password = None
        if version == V5 and rng.random() < 0.1:
            connect.properties = {
                Property.AUTHENTICATION_METHOD: rng.choice(("SCRAM-SHA-256", "SCRAM-SHA-512", "x")),
                Property.AUTHENTICATION_DATA: b"n,,n=alice,r=" + rng.randbytes(9).hex().encode(),
            }
        packets = [source.packet(version, KINDS).encode(version) for _ in range(rng.randint(0, 9))]
        if rng.random() < 0.8:
            packets.insert(0, connect.encode())
        if packets and rng.random() < 0.5:
            index = rng.randrange(len(packets))
            packets[index] = damage(rng, packets[index], rng.choice(packets))
        if rng.random() < 0.1:
            packets = [rng.randbytes(rng.choice((1, 10, 100, 5000)))]
        if transport == "websocket":
            packets = _framed(rng, packets)
        data = b"".join(packets)
        if rng.random() < 0.2:
            data = data[: rng.randrange(len(data) + 1)]
        end = rng.choice(("close", "abort", "half", "linger"))
        return Session(version, transport, b"", chunks(rng, data), end, rng.random() < 0.9)

    async def open(self, transport: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """A connection."""
        if transport == "foreign":
            return await asyncio.open_connection(
                "127.0.0.1", self.appliance.port, ssl=self._foreign, server_hostname=HOST
            )
        if transport == "clear":
            return await asyncio.open_connection("127.0.0.1", self.appliance.port)
        if transport == "websocket":
            return await asyncio.open_connection("127.0.0.1", self._web_port)
        return await super().open(transport)

    def check(self, session: Session) -> None:
        """Nobody is let in, and nobody reads what is alice's."""
        if self._treasure in session.answer:
            raise Found("a stranger has read what is alice's", str(session).encode())
        if session.transport in ("clear", "websocket"):
            return
        check_answer(session)
        if session.answer[:1] == b"\x20" and session.answer[3:4] == b"\0":
            raise Found("a stranger was let in", str(session).encode())


def _framed(rng: random.Random, packets: list[bytes]) -> list[bytes]:
    """In frames of WebSocket, some of which are damaged, behind what comes first there."""
    frames = [UPGRADE]
    for packet in packets:
        others = [Opcode.TEXT, Opcode.CONT]
        if len(packet) <= 125:  # more is no frame of these
            others += [Opcode.PING, Opcode.CLOSE]
        opcode = Opcode.BINARY if rng.random() < 0.7 else rng.choice(others)
        frames.append(Frame(opcode, packet).serialize(mask=True))
    if rng.random() < 0.3:
        index = rng.randrange(len(frames))
        frames[index] = damage(rng, frames[index], rng.choice(frames))
    return frames


def _log_in(client: RawClient, client_id: str) -> Connack:
    properties = {Property.SESSION_EXPIRY_INTERVAL: 3600}
    answer = client.decode(client.connect(client_id, clean=False, properties=properties))
    if not isinstance(answer, Connack) or answer.reason_code:
        raise Found(f"alice, who has the password, is told {answer}")
    return answer


def _messages(client: RawClient) -> list[tuple[str, bytes]]:
    """What comes, each acknowledged."""
    found: list[tuple[str, bytes]] = []
    while packets := [each for each in client.drain() if isinstance(each, Publish)]:
        found += [(packet.topic, bytes(packet.payload)) for packet in packets]
        answers: list[Packet] = [Puback(each.packet_id) for each in packets if each.packet_id]
        client.send(*answers)
    return found
