"""One network connection of a client, which can be cut anywhere, and who is on either end of it."""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
import ssl
import struct
from dataclasses import dataclass
from typing import Protocol, cast

from appliance_process import HOST

from appliance.mqtt.packets import Packet, Publish
from appliance.mqtt.reason import ReasonCode
from soak.model import Model
from soak.records import Message, Session
from soak.rights import Rights


@dataclass(frozen=True)
class Target:
    """Where the broker is, and who may log in."""

    port: int
    plain_port: int
    context: ssl.SSLContext
    passwords: dict[str, str]


@dataclass(frozen=True)
class Profile:
    """What stays the same about a client for all of its life."""

    client_id: str
    user: str
    version: int
    tls: bool
    #: Seconds that its session outlives its connections; 0 for not at all.
    expiry: float
    receive_maximum: int = 65535
    #: Topic aliases that the broker may use towards it.
    aliases: int = 0
    #: Seconds until it acknowledges what it received.
    ack_delay: float = 0.0
    #: All its subscriptions have Retain As Published, and want no retained messages.
    as_published: bool = False
    #: How often it declines a message that it acknowledges (MQTT 5).
    declines: float = 0.0
    #: Bytes of its receive buffer; 0 for what the system gives.
    receive_buffer: int = 0


class Speaker(Protocol):
    """The client, as its two halves see it."""

    model: Model
    profile: Profile
    rights: Rights
    random: random.Random
    session: Session | None

    def send(self, packet: Packet) -> None:
        """Write a packet."""

    def cut_inside(self, packet: Packet) -> None:
        """Write the beginning of a packet, then be gone."""

    def spring(self, stage: str) -> bool:
        """The trap, when it is set for this moment; whether the client is gone at once."""

    def identify(self, packet: Publish) -> Message | None:
        """The model's message; None for an empty one, and for what is not in the model."""

    def note(self, what: str) -> None:
        """Write it into the session's history."""

    def wrong(self, kind: str, text: str, message: Message | None = None) -> None:
        """The broker did something that it must not do."""


class Owner(Protocol):
    """Who is told what comes in."""

    def received(self, wire: Wire, data: bytes) -> None:
        """A whole packet."""

    def lost(self, wire: Wire) -> None:
        """The connection ended, whoever ended it."""


class Wire(asyncio.Protocol):
    """One network connection; packets go to its owner as they are complete."""

    def __init__(self, owner: Owner) -> None:
        self.owner = owner
        self.paused = False
        #: How often it was paused.
        self.pauses = 0
        #: Why the broker says that it ends the connection, and the error that it ended with.
        self.reason: ReasonCode | None = None
        self.error: Exception | None = None
        self.closed = asyncio.Event()
        self._transport: asyncio.Transport | None = None
        self._broken_off = False
        self._buffer = bytearray()

    async def open(self, target: Target, profile: Profile) -> None:
        loop = asyncio.get_running_loop()
        sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if profile.receive_buffer:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, profile.receive_buffer)
            port = target.port if profile.tls else target.plain_port
            await loop.sock_connect(sock, ("127.0.0.1", port))
            await loop.create_connection(
                lambda: self,
                sock=sock,
                ssl=target.context if profile.tls else None,
                server_hostname=HOST if profile.tls else None,
            )
        except BaseException:
            sock.close()
            raise

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)

    def data_received(self, data: bytes) -> None:
        buffer = self._buffer
        buffer += data
        while (size := _packet_size(buffer)) and len(buffer) >= size:
            packet = bytes(buffer[:size])
            del buffer[:size]
            self.owner.received(self, packet)

    def connection_lost(self, exc: Exception | None) -> None:
        self._read_rest()
        self.error = exc
        self._transport = None
        self.closed.set()
        self.owner.lost(self)

    def _read_rest(self) -> None:
        """uvloop's TLS drops what came while reading was paused, when the end is behind it; and
        so just after reading was resumed."""
        assert self._transport is not None
        tls: ssl.SSLObject | None = self._transport.get_extra_info("ssl_object")
        with contextlib.suppress(ssl.SSLError):
            while tls is not None and (data := tls.read(65536)):
                self.data_received(data)

    def write(self, data: bytes) -> None:
        if self._transport is not None and not self._broken_off:
            self._transport.write(data)

    def break_off(self, data: bytes, size: int) -> None:
        """Write that many bytes of a packet, and nothing more ever."""
        self.write(data[:size])
        self._broken_off = True

    def pause(self) -> None:
        """Read nothing until `resume`."""
        if not self.paused and self._transport is not None and not self._transport.is_closing():
            self.paused = True
            self.pauses += 1
            self._transport.pause_reading()

    def resume(self) -> None:
        if self.paused and self._transport is not None and not self._transport.is_closing():
            self.paused = False
            self._transport.resume_reading()

    def cut(self, *, reset: bool) -> None:
        """Be gone at once, with what was not written yet; `reset` says so with a TCP reset."""
        if self._transport is None:
            return
        if reset:
            sock = self._transport.get_extra_info("socket")
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._transport.abort()


def _packet_size(data: bytearray) -> int:
    """Bytes of the packet that begins here; 0 when there are too few to tell."""
    length = 0
    for index, byte in enumerate(data[1:5]):
        length |= (byte & 0x7F) << 7 * index
        if byte < 0x80:
            return 2 + index + length
    return 0
