"""Whole sessions, damaged and cut at random, against a live appliance over sockets.

Beside them a canary talks to itself with QoS 2: every message has to come once, in order and
unaltered. What the broker answers to the damaged ones has to be packets that a client can read.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import re
import ssl
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from appliance_process import ApplianceProcess
from codec import Found
from inputs import CLIENTS_OWN, Source, chunks, damage
from waiting import until

from appliance.mqtt.codec import PacketType, decode_varint
from appliance.mqtt.packets import (
    V5,
    V311,
    Connack,
    Connect,
    Packet,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
    Suback,
    Subscribe,
    Subscription,
    decode_packet,
)
from appliance.mqtt.reason import ProtocolError

USER = "mallory"
ACL = f"""\
user alice
topic readwrite {{robot}}/#

user {USER}
topic readwrite {{robot}}/fuzz/#
topic read {{robot}}/canary/#
topic read #
"""

#: So small that sessions and messages which the fuzzer leaves behind are few.
LIMITS = {
    "memory": "8 MiB",
    "queue_bytes": "1 MiB",
    "queue_messages": 50,
    "retained_messages": 100,
    "retained_bytes": "1 MiB",
    "sessions": 100,
    "packet_size": "1 MiB",
    "connect_timeout": "20 s",
    "connections_per_address": 1000,
    "connection_rate": 100_000,
}

#: Bytes that the process may grow by, from the first seconds to the end.
GROWTH = 48 << 20

#: Sessions at a time.
AT_A_TIME = 16

#: The last sessions, of which one did it.
REMEMBERED = 400

#: Seconds for what takes milliseconds.
PATIENCE = 10.0

KINDS = (*CLIENTS_OWN, *(PacketType.PUBLISH, PacketType.SUBSCRIBE) * 3)

#: What no line of the log may hold.
_WRONG = re.compile(r"Traceback|internal error|never retrieved|never awaited|Exception in")


class _InLog(Found):
    """The log tells what must not happen."""


@dataclass
class Session:
    """What is sent on one connection, in which pieces, and how it ends."""

    version: int
    #: "plain", "tls", or what `Siege.open` knows beside these.
    transport: str
    login: bytes
    pieces: list[bytes]
    end: str
    reads: bool
    answer: bytearray = field(default_factory=bytearray)

    def __str__(self) -> str:
        told = [f"version {self.version}", self.transport, f"end {self.end}"]
        told += [f"login {self.login.hex()}", *(piece.hex() for piece in self.pieces)]
        return "\n".join(told)


def make_session(rng: random.Random, password: bytes) -> Session:
    """Random bytes, or what a client could say, some of it damaged; before a login or behind."""
    version = rng.choice((V311, V5))
    source = Source(rng, "r2d2/fuzz")
    client_id = rng.choice(("f1", "f2", "f3", "f4", "", source.text(30)))
    connect = source.connect(version, client_id, USER, password).encode()
    packets = [source.packet(version, KINDS).encode(version) for _ in range(rng.randint(0, 12))]
    login = b""
    way = rng.random()
    if way < 0.1:
        data = rng.randbytes(rng.choice((1, 10, 100, 5000)))
    elif way < 0.2:
        data = damage(rng, connect) + b"".join(packets)
    else:
        if way < 0.8:
            login = connect
        else:
            packets.insert(0, connect)
        for _ in range(rng.choice((0, 1, 1, 2))):
            if packets:
                index = rng.randrange(len(packets))
                packets[index] = damage(rng, packets[index], rng.choice(packets))
        data = b"".join(packets)
        if rng.random() < 0.2:
            data = data[: rng.randrange(len(data) + 1)]
    end = rng.choice(("close", "close", "abort", "half", "linger"))
    pieces = chunks(rng, data)
    transport = "tls" if rng.random() < 0.3 else "plain"
    return Session(version, transport, login, pieces, end, rng.random() < 0.9)


class Canary:
    """A client that publishes numbered messages to itself and checks what comes."""

    TOPIC = "r2d2/canary/song"

    def __init__(self) -> None:
        self.sent = 0
        self.heard = 0
        self.released: set[int] = set()

    async def sing(self, port: int, password: bytes, until: asyncio.Event) -> None:
        """Until it is to stop, and all has come. Raises Found."""
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        try:
            connect = Connect("canary", version=V311, username="alice", password=password)
            writer.write(connect.encode())
            writer.write(Subscribe(1, [Subscription(self.TOPIC, 2)]).encode(V311))
            while not until.is_set() or self.heard < self.sent:
                if not until.is_set() and self.sent - self.heard < 10:
                    writer.write(self._message(self.sent).encode(V311))
                    self.sent += 1
                packet = await asyncio.wait_for(_read_packet(reader, V311), PATIENCE)
                if packet is None:
                    raise Found("the canary's connection was closed")
                writer.write(self._answer(packet))
        except (asyncio.TimeoutError, OSError) as error:
            raise Found(f"the canary hears nothing: {error!r}") from error
        finally:
            writer.close()

    def _message(self, number: int) -> Publish:
        payload = b"%d " % number + b"tweet " * (number % 50)
        return Publish(self.TOPIC, payload, 2, packet_id=number % 65535 + 1)

    def _answer(self, packet: Packet) -> bytes:
        if isinstance(packet, Publish):
            wanted = self._message(self.heard).payload
            if packet.payload != wanted or packet.topic != self.TOPIC or packet.dup:
                raise Found(f"the canary hears {packet.payload!r}, and not {wanted!r}")
            self.heard += 1
            assert packet.packet_id is not None
            return Pubrec(packet.packet_id).encode(V311)
        if isinstance(packet, Pubrec):
            return Pubrel(packet.packet_id).encode(V311)
        if isinstance(packet, Pubrel):
            return Pubcomp(packet.packet_id).encode(V311)
        if isinstance(packet, Pubcomp | Suback) or packet == Connack():
            return b""
        raise Found(f"the canary hears {packet}")


async def _read_packet(reader: asyncio.StreamReader, version: int) -> Packet | None:
    try:
        header = await reader.readexactly(2)
        while header[-1] & 0x80:
            header += await reader.readexactly(1)
        length, _ = decode_varint(header, 1)
        return decode_packet(header[0], await reader.readexactly(length), version)
    except asyncio.IncompleteReadError:
        return None


class Siege:
    """An appliance, and sessions without end against it."""

    def __init__(self, directory: Path, **broker: Any) -> None:
        self.appliance = ApplianceProcess(
            directory,
            users={USER: "knows the password"},
            acl=ACL,
            broker={"limits": LIMITS, **broker},
        )
        #: Bytes of memory soon after the start, and at the end.
        self.base = self.memory = 0
        self.count = 0
        self.last: deque[Session] = deque(maxlen=REMEMBERED)
        self.canary = Canary()
        self._context: ssl.SSLContext
        self._read_log = 0

    @property
    def resident(self) -> int:
        """Bytes of memory that the process has."""
        status = Path(f"/proc/{self.appliance.pid}/status").read_text()
        found = re.search(r"VmRSS:\s+(\d+) kB", status)
        return int(found[1]) * 1024 if found else 0

    def run(self, rng: random.Random, seconds: float) -> None:
        """Raises Found."""
        self.appliance.start()
        try:
            self._context = self.appliance.tls_context()
            self.prepare()
            asyncio.run(self._run(rng, seconds))
            self.examine()
        finally:
            try:
                self.appliance.stop()
            except AssertionError as error:
                raise Found(str(error)[-3000:], *self._remembered()) from error

    def prepare(self) -> None:
        """What is done before the first session."""

    def examine(self) -> None:
        """What is looked at behind the last. Raises Found."""

    def make(self, rng: random.Random) -> Session:
        """The next session."""
        return make_session(rng, self.appliance.passwords[USER].encode())

    async def open(self, transport: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """A connection."""
        appliance = self.appliance
        if transport == "plain":
            return await asyncio.open_connection("127.0.0.1", appliance.plain_port)
        return await asyncio.open_connection(
            "127.0.0.1", appliance.port, ssl=self._context, server_hostname="localhost"
        )

    def check(self, session: Session) -> None:
        """What was answered. Raises Found."""
        check_answer(session)

    async def _run(self, rng: random.Random, seconds: float) -> None:
        stop = asyncio.Event()
        password = self.appliance.passwords["alice"].encode()
        singing = asyncio.ensure_future(self.canary.sing(self.appliance.plain_port, password, stop))
        running: set[asyncio.Future[None]] = set()
        try:
            # Its login is not to wait behind a busy computer's first handshakes.
            await until(lambda: self.canary.heard or singing.done(), "the canary to sing")
            end = time.monotonic() + seconds
            warm = time.monotonic() + min(seconds / 4, 60.0)
            while time.monotonic() < end and not singing.done():
                while len(running) < AT_A_TIME:
                    self.count += 1
                    running.add(asyncio.ensure_future(self._play(self.make(rng))))
                done, running = await asyncio.wait(
                    running, return_when=asyncio.FIRST_COMPLETED, timeout=PATIENCE
                )
                for task in done:
                    task.result()
                self._look_into_log()
                if not self.base and time.monotonic() > warm:
                    self.base = self.resident
            await asyncio.gather(*running)
            stop.set()
            await singing
            self._look_into_log()
            self.memory = self.resident
            grown = self.memory - self.base
            if self.base and grown > GROWTH:
                raise Found(f"memory grew by {grown >> 20} MiB", *self._remembered())
        except _InLog as found:
            culprits = await self._narrow_down() or self._remembered()
            raise Found(str(found), *culprits) from found
        except Found as found:
            raise found if found.data else Found(str(found), *self._remembered()) from found
        finally:
            stop.set()  # up to Python 3.11, `wait_for` may swallow the cancelling
            for task in (*running, singing):
                task.cancel()
            await asyncio.gather(*running, singing, return_exceptions=True)

    def _remembered(self) -> list[bytes]:
        return [str(session).encode() for session in self.last]

    def _look_into_log(self) -> None:
        log = self.appliance.log
        new, self._read_log = log[self._read_log :], len(log)
        found = _WRONG.search(new)
        if found is not None:
            told = new[max(0, found.start() - 300) : found.start() + 1500]
            raise _InLog(f"in the log: {told}")

    async def _narrow_down(self) -> list[bytes]:
        """The latest session that does the same when it is played alone, if there is one."""
        for session in reversed(list(self.last)):
            with contextlib.suppress(Found):
                self._look_into_log()  # what was told before
            await self._play(session)
            await asyncio.sleep(0.05)
            try:
                self._look_into_log()
            except _InLog:
                return [str(session).encode()]
        return []

    async def _play(self, session: Session) -> None:
        """The session from its begin to its end, whatever the broker does."""
        self.last.append(session)
        try:
            async with _time_limit():
                reader, writer = await self.open(session.transport)
        except (OSError, asyncio.TimeoutError):
            return  # the one before, with the same id, is still being thrown out
        reading: asyncio.Future[None] | None = None
        try:
            async with _time_limit():
                if session.login:
                    writer.write(session.login)
                    session.answer += await reader.read(4096)
                if session.reads:
                    reading = asyncio.ensure_future(_read_all(reader, session.answer))
                for piece in session.pieces:
                    writer.write(piece)
                    await writer.drain()
                    await asyncio.sleep(0)
                if session.end == "half" and writer.can_write_eof():
                    writer.write_eof()
                if session.end != "abort":
                    await asyncio.sleep(0.05 if session.end == "linger" else 0.005)
        except (OSError, asyncio.TimeoutError):
            pass  # it was thrown out, as it should be
        finally:
            if session.end == "abort":
                writer.transport.abort()
            writer.close()
            with contextlib.suppress(OSError, asyncio.TimeoutError):
                await asyncio.wait_for(writer.wait_closed(), 1.0)
            if reading is not None:
                reading.cancel()
                await asyncio.gather(reading, return_exceptions=True)
        self.check(session)


async def _read_all(reader: asyncio.StreamReader, into: bytearray) -> None:
    with contextlib.suppress(OSError):
        while data := await reader.read(65536):
            into += data


@contextlib.asynccontextmanager
async def _time_limit():
    """asyncio.timeout is too new for some computers."""
    task = asyncio.current_task()
    assert task is not None
    expired = False

    def expire() -> None:
        nonlocal expired
        expired = True
        task.cancel()

    timer = asyncio.get_running_loop().call_later(PATIENCE, expire)
    try:
        yield
    except asyncio.CancelledError:
        if expired:
            raise asyncio.TimeoutError from None
        raise
    finally:
        timer.cancel()


def check_answer(session: Session) -> None:
    """All whole packets in it can be read, and may come from a server."""
    data = bytes(session.answer)
    version = session.version
    pos = 0
    while pos + 2 <= len(data):
        try:
            length, body = decode_varint(data, pos + 1)
        except ProtocolError:
            break
        if body + length > len(data):
            break
        try:
            packet = decode_packet(data[pos], data[body : body + length], version)
        except ProtocolError as error:
            try:  # in a damaged CONNECT it may have asked for the other version
                packet = decode_packet(data[pos], data[body : body + length], 9 - version)
            except ProtocolError:
                what = f"an answer that cannot be read: {error}: {data[pos : pos + 100].hex()}"
                raise Found(what, str(session).encode()) from None
        if packet.TYPE in (PacketType.CONNECT, PacketType.SUBSCRIBE, PacketType.UNSUBSCRIBE):
            raise Found(f"a server says {packet}", str(session).encode())
        pos = body + length
