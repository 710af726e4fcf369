"""An MQTT client for these tests: it does what it is told, and remembers what came.

One connection an object. It acknowledges what it receives, unless it is told not to.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import ssl
import time
from collections.abc import Callable
from typing import Any

from waiting import PATIENCE, until

from appliance.mqtt.codec import V5, Properties, Property
from appliance.mqtt.packets import (
    Connack,
    Connect,
    Disconnect,
    Packet,
    Pingreq,
    Pingresp,
    Puback,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
    Suback,
    Subscribe,
    Subscription,
    Unsuback,
    Will,
    decode_packet,
)
from upstream.peers import HOST, PASSWORD, USER

#: Bytes to the broker beyond which `drain` waits.
HIGH_WATER = 1 << 16


class GoneError(ConnectionError):
    """The connection has ended before the answer came."""


class MqttClient(asyncio.Protocol):
    """Connect with `dial`; `messages` are (time of arrival, PUBLISH) unless `on_message` is set."""

    def __init__(self, version: int = V5) -> None:
        self.version = version
        self.messages: list[tuple[float, Publish]] = []
        self.on_message: Callable[[Publish], None] | None = None
        self.acknowledges = True
        self.connack: Connack | None = None
        self.disconnect: Disconnect | None = None
        self.closed = asyncio.Event()
        self._transport: asyncio.Transport
        self._buffer = bytearray()
        self._ids = itertools.cycle(range(1, 65536))
        self._pending: dict[int, asyncio.Future[Any]] = {}
        self._connected: asyncio.Future[Connack] = asyncio.get_running_loop().create_future()
        self._pings: list[asyncio.Future[None]] = []
        self._unreleased: set[int] = set()
        self._writable = asyncio.Event()
        self._writable.set()

    @classmethod
    async def dial(
        cls,
        port: int,
        client_id: str = "",
        *,
        version: int = V5,
        user: str | None = USER,
        password: str | None = PASSWORD,
        clean: bool = True,
        keep_alive: int = 0,
        expiry: int | None = None,
        properties: Properties | None = None,
        will: Will | None = None,
        tls: ssl.SSLContext | None = None,
        server_name: str = "localhost",
        refused: bool = False,
    ) -> MqttClient:
        """Connect; AssertionError when refused, unless `refused` expects it. Raises OSError."""
        client = cls(version)
        loop = asyncio.get_running_loop()
        await loop.create_connection(
            lambda: client, HOST, port, ssl=tls, server_hostname=server_name if tls else None
        )
        properties = dict(properties or {})
        if expiry is not None:
            properties[Property.SESSION_EXPIRY_INTERVAL] = expiry
        secret = None if password is None else password.encode()
        connect = Connect(
            client_id, clean, keep_alive, version, user, secret, will,
            (properties or None) if version == V5 else None,
        )  # fmt: skip
        client._transport.write(connect.encode())
        try:
            connack = await asyncio.wait_for(asyncio.shield(client._connected), PATIENCE)
        except BaseException:
            client.abort()
            raise
        client.connack = connack
        assert refused or not connack.reason_code, connack
        return client

    # The loop calls

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport  # type: ignore[assignment]
        self._transport.set_write_buffer_limits(HIGH_WATER)

    def connection_lost(self, error: Exception | None) -> None:
        self.closed.set()
        self._writable.set()
        gone = GoneError(f"the connection has ended ({error or self.disconnect or 'FIN'})")
        for future in (*self._pending.values(), *self._pings, self._connected):
            if not future.done():
                future.set_exception(gone)
                future.exception()  # it need not be asked for
        self._pending.clear()

    def pause_writing(self) -> None:
        self._writable.clear()

    def resume_writing(self) -> None:
        self._writable.set()

    def data_received(self, data: bytes) -> None:
        buffer = self._buffer
        buffer += data
        pos = 0
        while (end := _packet_end(buffer, pos)) is not None and end[1] <= len(buffer):
            start, stop = end
            packet = decode_packet(buffer[pos], bytes(buffer[start:stop]), self.version)
            pos = stop
            self.took(packet)
        del buffer[:pos]

    def took(self, packet: Packet) -> None:
        """A packet came."""
        if isinstance(packet, Publish):
            self._took_message(packet)
        elif isinstance(packet, (Puback, Pubcomp)):
            self._settle(packet.packet_id, int(packet.reason_code))
        elif isinstance(packet, Pubrec):
            if packet.reason_code >= 0x80:
                self._settle(packet.packet_id, int(packet.reason_code))
            else:
                self.send(Pubrel(packet.packet_id))
        elif isinstance(packet, Pubrel):
            self._unreleased.discard(packet.packet_id)
            self.send(Pubcomp(packet.packet_id))
        elif isinstance(packet, (Suback, Unsuback)):
            self._settle(packet.packet_id, packet)
        elif isinstance(packet, Pingresp):
            asked = self._pings.pop(0)
            if not asked.done():  # nobody waits any more
                asked.set_result(None)
        elif isinstance(packet, Connack):
            self._connected.set_result(packet)
        elif isinstance(packet, Disconnect):
            self.disconnect = packet

    def _took_message(self, packet: Publish) -> None:
        new = packet.qos < 2 or packet.packet_id not in self._unreleased
        if new and self.on_message is not None:
            self.on_message(packet)
        elif new:
            self.messages.append((time.monotonic(), packet))
        if packet.packet_id is None or not self.acknowledges:
            return
        if packet.qos == 2:
            self._unreleased.add(packet.packet_id)
            self.send(Pubrec(packet.packet_id))
        else:
            self.send(Puback(packet.packet_id))

    def _settle(self, packet_id: int, result: object) -> None:
        future = self._pending.pop(packet_id, None)
        if future is not None and not future.done():
            future.set_result(result)

    # A test calls

    @property
    def connected(self) -> bool:
        return not self.closed.is_set()

    @property
    def waiting(self) -> int:
        """How many answers are waited for."""
        return len(self._pending)

    def send(self, packet: Packet | bytes) -> None:
        """Send it as it is."""
        if not self._transport.is_closing():
            data = packet if isinstance(packet, bytes) else packet.encode(self.version)
            self._transport.write(data)

    def publish(
        self,
        topic: str,
        payload: bytes = b"",
        qos: int = 1,
        *,
        retain: bool = False,
        properties: Properties | None = None,
    ) -> asyncio.Future[int]:
        """The reason code of PUBACK or PUBCOMP; of QoS 0, None at once. Raises GoneError."""
        packet_id = self._next_id() if qos else None
        future = asyncio.get_running_loop().create_future()
        if self.closed.is_set():
            future.set_exception(GoneError("the connection has ended"))
            future.exception()
            return future
        if packet_id is None:
            future.set_result(None)
        else:
            self._pending[packet_id] = future
        properties = properties if self.version == V5 else None
        self.send(Publish(topic, payload, qos, retain, False, packet_id, properties))
        return future

    async def drain(self) -> None:
        """Wait until most of what was sent has left."""
        await self._writable.wait()

    async def subscribe(
        self, *filters: str | Subscription, qos: int = 1, patience: float = PATIENCE
    ) -> Suback:
        """Subscribe; AssertionError when one is refused. Raises GoneError."""
        wanted = [Subscription(each, qos) if isinstance(each, str) else each for each in filters]
        packet_id = self._next_id()
        future = self._pending[packet_id] = asyncio.get_running_loop().create_future()
        self.send(Subscribe(packet_id, wanted))
        suback: Suback = await asyncio.wait_for(future, patience)
        assert max(suback.reason_codes) < 0x80, suback
        return suback

    async def ping(self) -> float:
        """Seconds until PINGRESP."""
        began = time.monotonic()
        future: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._pings.append(future)
        self.send(Pingreq())
        await asyncio.wait_for(future, PATIENCE)
        return time.monotonic() - began

    async def wait_for(self, count: int = 1, what: str = "messages") -> list[Publish]:
        """The messages, once there are `count`."""
        await until(lambda: len(self.messages) >= count, f"{count} {what}")
        return [packet for _, packet in self.messages]

    async def close(self) -> None:
        """DISCONNECT, and FIN."""
        self.send(Disconnect())
        self._transport.close()
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self.closed.wait(), PATIENCE)

    def abort(self) -> None:
        """Be gone without a word."""
        self._transport.abort()

    def _next_id(self) -> int:
        return next(each for each in self._ids if each not in self._pending)


def _packet_end(buffer: bytearray, pos: int) -> tuple[int, int] | None:
    """Where the body of the packet at `pos` begins and ends; None when too few bytes are there."""
    length = 0
    for index in range(pos + 1, min(pos + 5, len(buffer))):
        byte = buffer[index]
        length |= (byte & 0x7F) << 7 * (index - pos - 1)
        if byte < 0x80:
            return index + 1, index + 1 + length
    return None
