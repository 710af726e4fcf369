"""MQTT connections of the load generator: raw sockets and as much of MQTT 3.1.1 as it needs.

It does not use `appliance.mqtt`, so as not to share a mistake with the code that it measures.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import resource
import select
import socket
import ssl
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

CONNECT_SECONDS = 60.0  # five hundred TLS handshakes and password checks on a small computer
RECORDS_BYTES = 1 << 18  # TLS records taken in one system call
RECORDS = memoryview(bytearray(RECORDS_BYTES))  # shared: allocating one a call costs more than TLS


class LoadError(Exception):
    """The broker could not be driven; the text says why."""


@contextlib.contextmanager
def reporting(name: str) -> Iterator[None]:
    """For a program: what fails is told on standard error, and the exit status is 1."""
    try:
        yield
    except (LoadError, OSError) as error:
        sys.stderr.write(f"{name}: {error}\n")
        sys.exit(1)


@dataclass(frozen=True, slots=True)
class LoadTarget:
    """The broker to drive: its address, credentials and processes."""

    host: str = "127.0.0.1"
    port: int = 1883
    tls: ssl.SSLContext | None = None
    username: str | None = None
    password: bytes | None = None
    pids: tuple[int, ...] = ()  # the processes whose CPU time and memory are the broker's

    @staticmethod
    def add_options(parser: argparse.ArgumentParser) -> None:
        """Add a target's options to a command line."""
        parser.add_argument("--host", default="127.0.0.1")
        parser.add_argument("--port", type=int, help="default: 1883, with TLS 8883")
        parser.add_argument("--tls", action="store_true", help="connect over TLS")
        parser.add_argument("--ca", metavar="FILE", help="the CA of the broker's certificate")
        parser.add_argument("--user", help="user name")
        parser.add_argument("--password-env", metavar="NAME", help="variable with the password")
        parser.add_argument(
            "--pid", type=int, action="append", default=[], help="the broker's process; repeatable"
        )

    @classmethod
    def of(cls, options: argparse.Namespace) -> LoadTarget:
        """The target that the options describe. Raises LoadError, OSError."""
        password = os.environ.get(options.password_env) if options.password_env else None
        if options.password_env and password is None:
            raise LoadError(f"there is no variable {options.password_env}")
        return cls(
            host=options.host,
            port=options.port or (8883 if options.tls else 1883),
            tls=ssl.create_default_context(cafile=options.ca) if options.tls else None,
            username=options.user,
            password=password.encode() if password is not None else None,
            pids=tuple(options.pid),
        )


def allow_files(count: int) -> bool:
    """Raise the limit of open files, for child processes too; False when that is denied."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = hard == resource.RLIM_INFINITY or hard >= count
    if soft != resource.RLIM_INFINITY and soft < count:
        resource.setrlimit(resource.RLIMIT_NOFILE, (count if allowed else hard, hard))
    return allowed


def field(data: bytes) -> bytes:
    """`data` with its length in two bytes before it (section 1.5.3)."""
    return len(data).to_bytes(2, "big") + data


def packet(first_byte: int, body: bytes) -> bytes:
    """A whole packet: first byte, remaining length (section 2.2.3), body."""
    length, head = len(body), bytearray([first_byte])
    while True:
        length, low = length >> 7, length & 0x7F
        head.append(low | 0x80 if length else low)
        if not length:
            return bytes(head) + body


def connect_packet(
    client_id: str, username: str | None, password: bytes | None, clean: bool = True
) -> bytes:
    """CONNECT without keep alive (section 3.1)."""
    flags, body = 0x02 if clean else 0, field(client_id.encode())
    if username is not None:
        flags, body = flags | 0x80, body + field(username.encode())
    if password is not None:
        flags, body = flags | 0x40, body + field(password)
    return packet(0x10, field(b"MQTT") + bytes([4, flags, 0, 0]) + body)


def publish_packet(
    topic: str,
    payload: bytes,
    packet_id: int | None = None,
    retain: bool = False,
    *,
    qos: int = 1,
) -> bytes:
    """PUBLISH with QoS 1 or another, or QoS 0 without a packet identifier (section 3.3)."""
    if packet_id is None:
        return packet(0x30 | retain, field(topic.encode()) + payload)
    first = 0x30 | qos << 1 | retain
    return packet(first, field(topic.encode()) + packet_id.to_bytes(2, "big") + payload)


def subscribe_packet(filters: Sequence[str], qos: int) -> bytes:
    """SUBSCRIBE to all the filters (section 3.8)."""
    return packet(0x82, b"\0\1" + b"".join(field(each.encode()) + bytes([qos]) for each in filters))


class TcpStream:
    """A TCP connection."""

    has_unsent = False  # bytes were accepted that the socket has not sent yet
    has_more = False  # bytes have arrived that were not returned yet

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection

    def send(self, data: memoryview) -> int:
        """Send what the socket accepts; returns the number of bytes."""
        try:
            return self._socket.send(data) if data else 0
        except BlockingIOError:
            return 0

    def recv_into(self, buffer: memoryview) -> int:
        """Receive; returns the number of bytes, 0 when there is nothing yet."""
        try:
            size = self._socket.recv_into(buffer)
        except BlockingIOError:
            return 0
        if not size:
            raise LoadError("the broker closed a connection")
        return size


class TlsStream:
    """A TLS connection that reads many records a system call; SSLSocket takes two for each."""

    def __init__(self, connection: socket.socket, context: ssl.SSLContext, host: str) -> None:
        self._socket = connection
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._incoming, self._outgoing, server_hostname=host)
        # With a buffer it returns the number of bytes, which its declared type does not know.
        self._read = cast("Callable[[int, memoryview], int]", cast(Any, self._tls.read))
        self._sealed = memoryview(b"")
        self.has_more = False
        while True:
            try:
                self._tls.do_handshake()
            except ssl.SSLWantReadError:
                connection.sendall(self._outgoing.read())
                self._incoming.write(connection.recv(RECORDS_BYTES))
            else:
                break
        connection.sendall(self._outgoing.read())

    @property
    def has_unsent(self) -> bool:
        """Whether bytes were accepted that the socket has not sent yet."""
        return bool(self._sealed)

    def send(self, data: memoryview) -> int:
        """Send one record at most; returns the number of bytes accepted."""
        taken = 0
        if not self._sealed and data:
            taken = self._tls.write(data[:RECORDS_BYTES])
            self._sealed = memoryview(self._outgoing.read())
        with contextlib.suppress(BlockingIOError):
            while self._sealed:
                self._sealed = self._sealed[self._socket.send(self._sealed) :]
        return taken

    def recv_into(self, buffer: memoryview) -> int:
        """Receive; returns the number of bytes, 0 when there is nothing yet."""
        if not self.has_more:
            try:
                received = self._socket.recv_into(RECORDS)
            except BlockingIOError:
                return 0
            if not received:
                raise LoadError("the broker closed a connection")
            self._incoming.write(RECORDS[:received])
        size, room = 0, len(buffer)
        try:
            while size < room:
                size += self._read(room - size, buffer[size:])
        except ssl.SSLWantReadError:
            self.has_more = False
        else:
            self.has_more = True
        return size


class LoadClient:
    """One MQTT connection: it blocks while it is set up, and is non-blocking once attached."""

    def __init__(self, target: LoadTarget, client_id: str, *, clean: bool = True) -> None:
        self.client_id = client_id
        self.socket = socket.create_connection((target.host, target.port), CONNECT_SECONDS)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.transport: TcpStream | TlsStream = (
            TcpStream(self.socket)
            if target.tls is None
            else TlsStream(self.socket, target.tls, target.host)
        )
        self._watch: Callable[[bool], None] = lambda wanted: None
        self._waiting = False
        self.write(connect_packet(client_id, target.username, target.password, clean))

    def wait_connected(self) -> None:
        """Wait for the CONNACK."""
        if (code := self.expect(0x20, 4)[3]) != 0:
            raise LoadError(f"{self.client_id}: the broker refuses the connection, code {code}")

    def subscribe(self, topic: str, qos: int) -> None:
        """Subscribe, and wait for the SUBACK."""
        self.write(subscribe_packet([topic], qos))
        if (code := self.expect(0x90, 5)[4]) != qos:
            raise LoadError(f"{self.client_id}: subscription to {topic} answered with {code:#x}")

    def expect(self, first_byte: int, size: int) -> bytes:
        """Wait for a packet of this length and type."""
        answer, filled = memoryview(bytearray(size)), 0
        while filled < size:
            filled += self.transport.recv_into(answer[filled:])
        if answer[0] != first_byte:
            raise LoadError(f"{self.client_id}: expected {first_byte:#x}, got {answer.hex()}")
        return bytes(answer)

    def attach(self, poll: select.epoll, events: dict[int, Callable[[int], None]]) -> None:
        """Register the connection with a loop that calls `ready` for its events."""
        self.socket.setblocking(False)
        descriptor = self.socket.fileno()
        events[descriptor] = self.ready
        poll.register(descriptor, select.EPOLLIN)
        self._watch = lambda wanted: poll.modify(
            descriptor, select.EPOLLIN | select.EPOLLOUT if wanted else select.EPOLLIN
        )

    def ready(self, event: int) -> None:
        """Handle an event of epoll."""
        if event & select.EPOLLOUT:
            self.write(b"")
            self.flush()
        if event & ~select.EPOLLOUT:
            self.receive()
            while self.transport.has_more:
                self.receive()

    def receive(self) -> None:
        """Receive what has arrived."""
        raise NotImplementedError

    def flush(self) -> None:
        """Send what the connection did not accept before."""
        raise NotImplementedError

    def write(self, data: bytes | memoryview) -> int:
        """Send what the connection accepts; returns the number of bytes."""
        taken = self.transport.send(memoryview(data))
        if (full := taken < len(data) or self.transport.has_unsent) != self._waiting:
            self._waiting = full
            self._watch(full)
        return taken

    def close(self) -> None:
        """Close the connection in any state."""
        with contextlib.suppress(OSError):
            self.socket.close()
