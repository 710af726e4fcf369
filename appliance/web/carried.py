"""A client of MQTT 5 for one request over HTTP: it logs in, publishes or calls, and leaves.

It is a client as any other, on a connection within this process. So the login, the access rules,
the limits of its user, the rules for commands and the audit log are those of MQTT.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterable
from dataclasses import replace
from types import TracebackType
from typing import Any, Final, TypeVar, cast

from async_timeout import timeout

from appliance.mqtt.codec import V5, Properties, Property, decode_varint
from appliance.mqtt.packets import (
    Connack,
    Connect,
    Disconnect,
    Packet,
    Puback,
    Publish,
    Suback,
    Subscribe,
    Subscription,
    decode_packet,
)
from appliance.mqtt.reason import ReasonCode

#: The most bytes of an answer.
LONGEST: Final = 4 * 1024 * 1024

#: Seconds that the broker has to take a message of QoS 0, behind which it closes the connection.
GOODBYE: Final = 5.0

P = TypeVar("P", bound=Packet)


class RefusedError(Exception):
    """A packet was refused: the reason code, and the broker's words, if it has any."""

    def __init__(self, code: int, words: str = "", *, login: bool = False) -> None:
        super().__init__(words)
        self.code = code
        self.login = login


class CarriedClient:
    """An asynchronous context manager; all methods raise RefusedError."""

    def __init__(self, end: socket.socket, username: str | None, password: bytes | None) -> None:
        """`end` is what `Listeners.carry` returned."""
        self._end = end
        self._connect = Connect(
            "",
            version=V5,
            username=username,
            password=password,
            properties={Property.MAXIMUM_PACKET_SIZE: LONGEST},
        )
        self._packet_ids = iter(range(1, 100))
        self._client_id = ""
        #: Whether anybody has subscribed to what was published last, with QoS 1.
        self.is_subscribed = False

    async def __aenter__(self) -> CarriedClient:
        """Log in."""
        self._reader, self._writer = await asyncio.open_connection(sock=self._end)
        try:
            await self._send(self._connect)
            connack = await self._next(Connack)
            if connack.reason_code:
                raise RefusedError(connack.reason_code, _words(connack.properties), login=True)
        except BaseException:
            self._writer.close()
            raise
        given = (connack.properties or {}).get(Property.ASSIGNED_CLIENT_IDENTIFIER)
        self._client_id = cast(str, given)
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave."""
        if not self._writer.is_closing():
            self._writer.write(Disconnect().encode(V5))
        self._writer.close()

    async def publish(self, message: Publish) -> None:
        """Publish a message with QoS 0 or 1; of QoS 0 nobody says that it was taken."""
        if message.qos:
            await self._send(replace(message, packet_id=next(self._packet_ids)))
            puback = await self._next(Puback)
            if puback.reason_code >= ReasonCode.UNSPECIFIED_ERROR:
                raise RefusedError(puback.reason_code, _words(puback.properties))
            self.is_subscribed = puback.reason_code != ReasonCode.NO_MATCHING_SUBSCRIBERS
            return
        await self._send(message, Disconnect())
        with contextlib.suppress(EOFError, asyncio.TimeoutError):
            async with timeout(GOODBYE):
                await self._next(Puback)  # none comes: to the end

    async def call(self, topic: str, payload: bytes, content_type: str) -> Publish:
        """The answer to a call of a service, an action or a verb; the caller limits the time."""
        reply = f"{topic.rpartition('/')[0]}/_reply/{self._client_id}/1"
        packet_id = next(self._packet_ids)
        await self._send(Subscribe(packet_id, [Subscription(reply, 1)]))
        suback = await self._next(Suback)
        if suback.reason_codes[0] >= ReasonCode.UNSPECIFIED_ERROR:
            rule = f"pattern read {topic.rpartition('/')[0]}/_reply/%c/#"
            raise RefusedError(suback.reason_codes[0], f"no right to read the answer: {rule}")
        properties: Properties = {
            Property.RESPONSE_TOPIC: reply,
            Property.CONTENT_TYPE: content_type,
        }
        await self.publish(Publish(topic, payload, 1, properties=properties))
        if not self.is_subscribed:
            raise RefusedError(ReasonCode.NO_MATCHING_SUBSCRIBERS, f"nothing is called at {topic}")
        return await self._next(Publish)

    async def _send(self, *packets: Packet) -> None:
        self._writer.write(b"".join(packet.encode(V5) for packet in packets))
        with contextlib.suppress(ConnectionError):  # what was sent before its end says why
            await self._writer.drain()

    async def _next(self, kind: type[P]) -> P:
        """The next packet of this kind. EOFError when the connection ends."""
        while True:
            packet = await self._receive()
            if isinstance(packet, kind):
                return packet
            if isinstance(packet, Disconnect):
                raise RefusedError(packet.reason_code, _words(packet.properties))

    async def _receive(self) -> Packet:
        try:
            header = await self._reader.readexactly(2)
            while header[-1] & 0x80:
                header += await self._reader.readexactly(1)
            length, _ = decode_varint(header, 1)
            body = await self._reader.readexactly(length)
        except ConnectionError:
            raise EOFError from None
        return decode_packet(header[0], body, V5)


def user_properties(packet: Publish) -> dict[str, str]:
    """The user properties of a message."""
    pairs = (packet.properties or {}).get(Property.USER_PROPERTY, ())
    return dict(cast("Iterable[tuple[str, str]]", pairs))


def _words(properties: Any) -> str:
    return str((properties or {}).get(Property.REASON_STRING, ""))
