"""A harness: listeners and a broker in the event loop of a test, and clients on raw sockets."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import socket
import ssl
from collections.abc import Callable
from pathlib import Path

import h11
from broker.conftest import check_accounts
from waiting import PATIENCE, until
from websockets.protocol import Protocol as FrameProtocol

from appliance import certs
from appliance.broker.broker import Broker
from appliance.broker.limits import Limits
from appliance.broker.message import Message
from appliance.broker.ports import Observer
from appliance.broker.session import Session
from appliance.broker.values import Action, Decision, Identity, Refusal
from appliance.mqtt.codec import decode_varint
from appliance.mqtt.packets import Connack, Connect, Packet, decode_packet
from appliance.mqtt.reason import ReasonCode
from appliance.net.connection import ClientConnection
from appliance.net.layers import MiddleLayer
from appliance.net.listeners import Admission, Listeners, ListenerSettings
from appliance.net.scheduler import Scheduler
from appliance.store import MemoryStore


def make_contexts(directory: Path) -> tuple[ssl.SSLContext, ssl.SSLContext]:
    """The TLS contexts of server and client."""
    certs.create_authority(directory, "test")
    certs.issue_server(directory, ["localhost"], [])
    server = certs.server_context(directory / "server.crt", directory / "server.key")
    return server, ssl.create_default_context(cafile=directory / "ca.crt")


class AllAllowed:
    epoch = 0

    def decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        return Decision(True, "everything is")


class Harness:
    """A broker with four listeners: plain and with TLS, and both of these for WebSocket."""

    def __init__(
        self, context: ssl.SSLContext, client_context: ssl.SSLContext, limits: Limits | None = None
    ) -> None:
        self.broker = Broker(AllAllowed(), MemoryStore(), limits or Limits())
        self.client_context = client_context
        self.context = context
        self.gate = asyncio.Event()  # logins wait until it is set
        self.gate.set()
        self.refused: set[str] = set()
        self.peers: list[Peer] = []
        self.raw_sockets: list[socket.socket] = []
        self.listeners = self.make()

    def make(
        self, connections: int = 100, connect_timeout: float = PATIENCE, **limits: float
    ) -> Listeners:
        self.listeners = Listeners(
            self.broker,
            self._ask,
            lambda method, address, tls, again: None,
            Admission(connections, connect_timeout, **limits),
        )
        return self.listeners

    @property
    def scheduler(self) -> Scheduler:
        return self.listeners.scheduler

    async def _ask(
        self,
        connect: Connect,
        address: str,
        tls: ssl.SSLObject | None,
        anonymous: bool | None,
    ) -> Identity | Refusal:
        await self.gate.wait()
        if connect.client_id in self.refused:
            return Refusal(ReasonCode.NOT_AUTHORIZED, "the test says so")
        return Identity(connect.username, connect.client_id)

    async def start(
        self, connections: int = 100, connect_timeout: float = PATIENCE, **limits: float
    ) -> None:
        self.make(connections, connect_timeout, **limits)
        self.ports = await self.listeners.start(
            [
                ListenerSettings("127.0.0.1", 0, None),
                ListenerSettings("127.0.0.1", 0, lambda: self.context),
                ListenerSettings("127.0.0.1", 0, None, "websocket"),
                ListenerSettings("127.0.0.1", 0, lambda: self.context, "websocket"),
            ]
        )

    async def dial(self, tls: bool = False, receive_buffer: int = 0) -> Peer:
        """A connection to one of the listeners."""
        sock = socket.socket()
        if receive_buffer:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        sock.setblocking(False)
        await asyncio.get_running_loop().sock_connect(sock, self.ports[tls])
        reader, writer = await asyncio.open_connection(
            sock=sock,
            ssl=self.client_context if tls else None,
            server_hostname="localhost" if tls else None,
        )
        peer = Peer(reader, writer)
        self.peers.append(peer)
        return peer

    async def expect_free_memory(self, said: bytes, tls: bool) -> None:
        """However a client leaves that has said this, nothing of its connection is in memory: not
        only when garbage is looked for, which is among young objects alone."""
        gc.collect()
        gc.freeze()  # what is there already is not looked at again and again
        before = len(_layers())
        gc.disable()
        logging.disable()  # pytest keeps the records, with what is in them
        try:
            peer = await self.dial(tls)
            await until(lambda: len(_layers()) > before, "a connection")
            await peer.send(said)
            with contextlib.suppress(TimeoutError, asyncio.TimeoutError, OSError):
                await asyncio.wait_for(peer.reader.read(), 0.1)
            peer.hang_up()
            await until(lambda: len(_layers()) <= before, "free memory")
        finally:
            logging.disable(logging.NOTSET)
            gc.enable()

    async def log_in(self, client_id: str, *, tls: bool = False, receive_buffer: int = 0) -> Peer:
        """A client that has logged in."""
        peer = await self.dial(tls, receive_buffer)
        await peer.send(Connect(client_id))
        assert isinstance(await peer.receive(), Connack)
        return peer

    async def close(self) -> None:
        """Close everything, and check that nothing is left of the connections."""
        for peer in self.peers:
            peer.hang_up()
        for raw_socket in self.raw_sockets:
            raw_socket.close()
        await self.listeners.stop()
        assert not self.scheduler.connections
        assert not self.broker.clients
        assert self.broker.accounting.queued_bytes == 0
        assert self.scheduler.output == 0
        check_scheduler(self.scheduler)

    def protocol(self, client_id: str) -> ClientConnection:
        """The server's side of a client's connection."""
        for protocol in self.scheduler.connections:
            session = protocol._client.session
            if session is not None and session.client_id == client_id:
                return protocol
        raise AssertionError(f"{client_id} is not connected")


def check_scheduler(scheduler: Scheduler) -> None:
    """`check_accounts`, including the input and output that the connections buffer."""
    strangers = scheduler.broker.accounting.accounts.strangers
    accounts = {strangers} | {protocol.account for protocol in scheduler.connections}
    accounts |= {session.account for session in scheduler.broker.sessions.values()}
    wires = {account: account.output for account in accounts}
    total = scheduler.output
    for protocol in scheduler.connections:
        held = protocol._backlog_size + protocol._frame_size + protocol._below_size
        total += held
        wires[protocol.account] += held
        if protocol.account is strangers:
            wires[strangers] += protocol._client._held
    assert strangers.bytes == wires[strangers]
    check_accounts(scheduler.broker, wires=total, wires_of=wires)


def _layers() -> list[object]:
    """Of all connections: their layers, and what the libraries keep for these."""
    kinds = (ClientConnection, MiddleLayer, FrameProtocol, h11.Connection)
    return [each for each in gc.get_objects() if isinstance(each, kinds)]


def abort(transport: asyncio.WriteTransport) -> None:
    """Close it at once; asyncio's raises if it has closed itself after its last bytes."""
    with contextlib.suppress(AttributeError):
        transport.abort()


class Peer:
    """The client's side of a connection."""

    def __init__(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, version: int = 5
    ) -> None:
        self.reader = reader
        self.writer = writer
        self.version = version

    async def send(self, *packets: Packet | bytes) -> None:
        data = (p if isinstance(p, bytes) else p.encode(self.version) for p in packets)
        self.writer.write(b"".join(data))
        await asyncio.wait_for(self.writer.drain(), PATIENCE)

    async def receive(self) -> Packet:
        """The next packet; IncompleteReadError or ConnectionError when there is none."""
        return await asyncio.wait_for(self._hear(), PATIENCE)

    async def _hear(self) -> Packet:
        header = await self.reader.readexactly(2)
        while header[-1] & 0x80:
            header += await self.reader.readexactly(1)
        length, _ = decode_varint(header, 1)
        return decode_packet(header[0], await self.reader.readexactly(length), self.version)

    async def receive_rest(self) -> bytes:
        """All bytes until the connection ends."""
        with contextlib.suppress(ConnectionError):
            return await asyncio.wait_for(self.reader.read(-1), PATIENCE)
        return b""

    def hang_up(self) -> None:
        abort(self.writer.transport)


class PublishObserver(Observer):
    """Calls a function for each published message."""

    def __init__(self, harness: Harness, published: Callable[[Message], None]) -> None:
        harness.broker.observer = self
        self._published = published

    def published(self, session: Session, message: Message) -> None:
        self._published(message)
