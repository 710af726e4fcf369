"""A fleet's broker that can be told to do anything, and that looks at how a link treats it.

A good broker for one client, as far as a link can see, on our own codec::

    async with FakeFleet(limits={Property.RECEIVE_MAXIMUM: 20}) as fleet:
        fleet.acknowledge = refuse(0x97)
        ...  # a link connects to fleet.port
        assert not fleet.faults  # what it did against the standard, or against these limits
        fleet.published  # what came, in order

`hostile.py` has what brokers do wrong, by name.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import random
import socket
import struct
import time
from collections.abc import Awaitable, Callable
from typing import Literal

from harness import abort
from waiting import until

from appliance.mqtt.codec import V5, V311, PacketType, Properties, Property, decode_varint
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
    Unsuback,
    Unsubscribe,
    decode_packet,
)
from appliance.mqtt.reason import ProtocolError, ReasonCode
from appliance.mqtt.topics import check_topic

#: How much longer than 1.5 keep alives a link may be silent on a busy computer, in seconds.
LENIENCE = 2.0

RST = struct.pack("ii", 1, 0)


class Visit:
    """One connection of a link; what it has sent, and what was sent to it."""

    def __init__(
        self, fleet: FakeFleet, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self.fleet = fleet
        self.reader = reader
        self.writer = writer
        self.began = time.monotonic()
        self.version = V5
        self.connect: Connect | None = None
        self.filters: list[str] = []
        self.published: list[Publish] = []
        #: Packet ids that were neither acknowledged nor refused yet, in their order.
        self.unacknowledged: list[int] = []
        #: Packet ids of the fleet's own messages that the link has not acknowledged.
        self.sent: dict[int, Publish] = {}
        self.acknowledged: list[tuple[int, int]] = []
        self.pings: list[float] = []
        self.disconnect: Disconnect | None = None
        #: How the link has ended the connection; empty while it has not.
        self.ended: Literal["", "FIN", "RST"] = ""
        self.reading = asyncio.Event()
        self.reading.set()
        self.ready = asyncio.Event()  # its subscriptions are granted, or it has none
        self.heard = self.began
        self._aliases: dict[int, str] = {}
        self._ids = itertools.cycle(range(1, 65536))
        self._tasks: set[asyncio.Task[None]] = set()

    # To the link

    def send(self, *packets: Packet | bytes) -> None:
        """Send them as they are."""
        if not self.writer.transport.is_closing():
            self.writer.write(
                b"".join(p if isinstance(p, bytes) else p.encode(self.version) for p in packets)
            )

    async def drain(self) -> None:
        with contextlib.suppress(ConnectionError):
            await self.writer.drain()

    def message(
        self,
        topic: str,
        payload: bytes = b"",
        qos: int = 1,
        *,
        retain: bool = False,
        dup: bool = False,
        properties: Properties | None = None,
    ) -> int:
        """Send a message; its packet id, 0 for QoS 0."""
        packet_id = next(each for each in self._ids if each not in self.sent) if qos else None
        packet = Publish(topic, payload, qos, retain, dup, packet_id, properties)
        if packet_id is not None:
            self.sent[packet_id] = packet
        self.send(packet)
        return packet_id or 0

    def topic(self, number: int = 0) -> str:
        """A topic that the link has subscribed to."""
        assert self.filters, "the link has no subscription"
        wanted = self.filters[number % len(self.filters)]
        return wanted.replace("+", f"x{number}").replace("#", f"x{number}")

    def acknowledge(self, packet_id: int, code: int = 0) -> None:
        """PUBACK; twice or for an unknown id if it is told to."""
        with contextlib.suppress(ValueError):
            self.unacknowledged.remove(packet_id)
        self.send(Puback(packet_id, code))

    def close(self) -> None:
        """FIN."""
        self.writer.close()

    def reset(self) -> None:
        """RST."""
        sock = self.writer.get_extra_info("socket")
        with contextlib.suppress(OSError, AttributeError, ValueError):  # uvloop's, closed
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RST)
        abort(self.writer.transport)

    def later(self, work: Awaitable[None]) -> None:
        """Do that beside what else is done on this connection, as long as it lasts."""

        async def contained() -> None:
            try:
                await work
            except (ConnectionError, asyncio.CancelledError):
                pass
            except Exception as error:
                self.fleet.errors.append(error)

        task = asyncio.create_task(contained())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # From the link

    async def run(self) -> None:
        watch = asyncio.create_task(self._watch())
        try:
            while not self.ended:
                await self.reading.wait()
                await self._take()
        except asyncio.IncompleteReadError as error:
            self.ended = "FIN"
            if error.partial:
                self.fault(f"the connection ends within a packet: {error.partial[:20]!r}")
        except ConnectionError:
            self.ended = "RST"
        except ProtocolError as error:
            self.fault(f"{error.code.name}: {error}")
            self.close()
        finally:
            for task in (watch, *self._tasks):
                task.cancel()
            self.writer.close()

    async def _take(self) -> None:
        head = await self.reader.readexactly(2)
        while head[-1] & 0x80:
            if len(head) == 5:
                raise ProtocolError(ReasonCode.MALFORMED_PACKET, "a length of five bytes")
            head += await self.reader.readexactly(1)
        length, _ = decode_varint(head, 1)
        body = await self.reader.readexactly(length)
        self.heard = time.monotonic()
        most = self.fleet.limits.get(Property.MAXIMUM_PACKET_SIZE)
        is_told = head[0] >> 4 != PacketType.CONNECT  # which CONNACK comes after
        if is_told and self.version == V5 and isinstance(most, int) and len(head) + length > most:
            self.fault(f"a packet of {len(head) + length} bytes, and {most} are allowed")
        packet = decode_packet(head[0], body, self.version)
        self.fleet.packets.append(packet)
        if self.connect is None and not isinstance(packet, Connect):
            self.fault(f"{packet} before CONNECT")
        if self.disconnect is not None:
            self.fault(f"{packet} after DISCONNECT")
        handler = self.fleet.handlers.get(type(packet), _HANDLERS.get(type(packet)))
        if handler is None:
            self.fault(f"a client does not send {packet}")
        else:
            handler(self, packet)

    def fault(self, text: str) -> None:
        """The link has done something that it must not."""
        self.fleet.faults.append(text)

    async def _watch(self) -> None:
        """Whether it keeps its keep alive, or the one that CONNACK has said."""
        while True:
            await asyncio.sleep(0.1)
            if self.connect is None:
                continue
            limit = self.fleet.limits.get(Property.SERVER_KEEP_ALIVE)
            if not isinstance(limit, int) or self.version != V5:
                limit = self.connect.keep_alive
            silent = time.monotonic() - self.heard
            if limit and self.reading.is_set() and silent > 1.5 * limit + LENIENCE:
                self.fault(f"silent for {silent:.1f} s with a keep alive of {limit} s")
                return

    def on_connect(self, packet: Connect) -> None:
        if self.connect is not None:
            self.fault("CONNECT twice")
        self.connect = packet
        if packet.version not in self.fleet.versions:
            self._refuse_version(packet.version)
            return
        self.version = packet.version
        self.fleet.connects.append(packet)
        self.fleet.greet(self)

    def _refuse_version(self, version: int) -> None:
        how = self.fleet.refuses_version
        if how == "its version":
            self.version = version
            self.send(Connack(False, ReasonCode.UNSUPPORTED_PROTOCOL_VERSION))
        elif how == "3.1.1":
            self.send(b"\x20\x02\x00\x01")
        self.close()

    def on_publish(self, packet: Publish) -> None:
        self._check_publish(packet)
        self.published.append(packet)
        self.fleet.published.append(packet)
        if packet.packet_id is not None:
            self.unacknowledged.append(packet.packet_id)
        self.fleet.acknowledge(self, packet)

    def _check_publish(self, packet: Publish) -> None:
        limits = self.fleet.limits if self.version == V5 else {}
        if packet.packet_id is not None and packet.packet_id in self.unacknowledged:
            self.fault(f"the packet id {packet.packet_id} is in use")
        if packet.dup and not any(each.payload == packet.payload for each in self.fleet.published):
            self.fault("DUP on a message that was not sent before")
        window: int = limits.get(Property.RECEIVE_MAXIMUM, 65535)  # type: ignore[assignment]
        if packet.qos and len(self.unacknowledged) >= window:
            self.fault(f"more than {window} messages in flight")
        if packet.qos > limits.get(Property.MAXIMUM_QOS, 2):  # type: ignore[operator]
            self.fault(f"QoS {packet.qos}")
        if packet.retain and not limits.get(Property.RETAIN_AVAILABLE, 1):
            self.fault("a retained message")
        properties = packet.properties or {}
        alias = properties.get(Property.TOPIC_ALIAS)
        topic = packet.topic
        if isinstance(alias, int):
            if not 0 < alias <= limits.get(Property.TOPIC_ALIAS_MAXIMUM, 0):  # type: ignore[operator]
                self.fault(f"the topic alias {alias}")
            topic = topic or self._aliases.get(alias, "")
            self._aliases[alias] = topic
            packet.topic = topic
        if Property.SUBSCRIPTION_IDENTIFIER in properties:
            self.fault("a subscription identifier in PUBLISH")
        try:
            check_topic(topic)
        except ValueError as error:
            self.fault(f"the topic {topic!r}: {error}")

    def on_subscribe(self, packet: Subscribe) -> None:
        limits = self.fleet.limits if self.version == V5 else {}
        for each in packet.subscriptions:
            wild = "+" in each.filter or "#" in each.filter
            if wild and not limits.get(Property.WILDCARD_SUBSCRIPTION_AVAILABLE, 1):
                self.fault(f"a wildcard: {each.filter}")
            shared = each.filter.startswith("$share/")
            if shared and not limits.get(Property.SHARED_SUBSCRIPTION_AVAILABLE, 1):
                self.fault(f"a shared subscription: {each.filter}")
        identifier = Property.SUBSCRIPTION_IDENTIFIER in (packet.properties or {})
        if identifier and not limits.get(Property.SUBSCRIPTION_IDENTIFIER_AVAILABLE, 1):
            self.fault("a subscription identifier")
        if self.fleet.filters_a_packet and len(packet.subscriptions) > self.fleet.filters_a_packet:
            self.fault(f"{len(packet.subscriptions)} filters in one SUBSCRIBE")
        self.filters += [each.filter for each in packet.subscriptions]
        self.fleet.grant(self, packet)
        self.ready.set()

    def on_unsubscribe(self, packet: Unsubscribe) -> None:
        self.filters = [each for each in self.filters if each not in packet.filters]
        self.send(Unsuback(packet.packet_id, [0] * len(packet.filters)))

    def on_puback(self, packet: Puback) -> None:
        if self.sent.pop(packet.packet_id, None) is None:
            self.fault(f"PUBACK for the packet id {packet.packet_id}, which is not in use")
        self.acknowledged.append((packet.packet_id, int(packet.reason_code)))

    def on_pubrec(self, packet: Pubrec) -> None:
        if packet.packet_id not in self.sent:
            self.fault(f"PUBREC for the packet id {packet.packet_id}, which is not in use")
        if packet.reason_code >= 0x80:
            self.sent.pop(packet.packet_id, None)
            self.acknowledged.append((packet.packet_id, int(packet.reason_code)))
        else:
            self.send(Pubrel(packet.packet_id))

    def on_pubcomp(self, packet: Pubcomp) -> None:
        self.sent.pop(packet.packet_id, None)
        self.acknowledged.append((packet.packet_id, int(packet.reason_code)))

    def on_pubrel(self, packet: Pubrel) -> None:
        self.send(Pubcomp(packet.packet_id))

    def on_ping(self, _packet: Pingreq) -> None:
        self.pings.append(time.monotonic())
        self.fleet.pong(self)

    def on_disconnect(self, packet: Disconnect) -> None:
        self.disconnect = packet


#: Of each packet of a link. `FakeFleet.handlers` takes the place of some.
_HANDLERS: dict[type, Callable[[Visit, Packet], None]] = {
    Connect: Visit.on_connect,  # type: ignore[dict-item]
    Publish: Visit.on_publish,  # type: ignore[dict-item]
    Subscribe: Visit.on_subscribe,  # type: ignore[dict-item]
    Unsubscribe: Visit.on_unsubscribe,  # type: ignore[dict-item]
    Puback: Visit.on_puback,  # type: ignore[dict-item]
    Pubrec: Visit.on_pubrec,  # type: ignore[dict-item]
    Pubrel: Visit.on_pubrel,  # type: ignore[dict-item]
    Pubcomp: Visit.on_pubcomp,  # type: ignore[dict-item]
    Pingreq: Visit.on_ping,  # type: ignore[dict-item]
    Disconnect: Visit.on_disconnect,  # type: ignore[dict-item]
}


# How messages are answered: for `FakeFleet.acknowledge`

Answer = Callable[[Visit, Publish], None]


def accept(visit: Visit, packet: Publish) -> None:
    """At once, as a good broker does."""
    if packet.qos == 1:
        assert packet.packet_id is not None
        visit.acknowledge(packet.packet_id)
    elif packet.packet_id is not None:
        visit.unacknowledged.remove(packet.packet_id)
        visit.send(Pubrec(packet.packet_id))


def never(visit: Visit, packet: Publish) -> None:
    """Not at all."""


def refuse(code: int, times: int | None = None) -> Answer:
    """With that reason code; only the first so many times, if that is given."""
    left = itertools.count() if times is None else iter(range(times))

    def answer(visit: Visit, packet: Publish) -> None:
        if packet.qos == 1 and next(left, None) is not None:
            assert packet.packet_id is not None
            visit.acknowledge(packet.packet_id, code)
        else:
            accept(visit, packet)

    return answer


def refuse_topic(topic: str, code: int) -> Answer:
    """Messages with that topic, with that reason code."""

    def answer(visit: Visit, packet: Publish) -> None:
        (refuse(code) if packet.topic == topic else accept)(visit, packet)

    return answer


def late(seconds: float) -> Answer:
    """After so long."""

    def answer(visit: Visit, packet: Publish) -> None:
        async def wait() -> None:
            await asyncio.sleep(seconds)
            accept(visit, packet)

        visit.later(wait())

    return answer


def reversed_in(count: int) -> Answer:
    """So many at a time, the last one first."""
    held: list[Publish] = []

    def answer(visit: Visit, packet: Publish) -> None:
        held.append(packet)
        if len(held) >= count:
            for each in reversed(held):
                accept(visit, each)
            held.clear()

    return answer


def close_at(*topics: str, times: int | None = None) -> Answer:
    """The connection ends at a message with one of the topics, unanswered: it is poisonous."""
    left = itertools.count() if times is None else iter(range(times))

    def answer(visit: Visit, packet: Publish) -> None:
        if packet.topic in topics and next(left, None) is not None:
            visit.close()
        else:
            accept(visit, packet)

    return answer


class FakeFleet:
    """The server; all of its behaviour may be changed while it runs."""

    def __init__(
        self,
        *,
        limits: Properties | None = None,
        versions: tuple[int, ...] = (V311, V5),
        seed: int = 0,
    ) -> None:
        #: The properties of CONNACK, which the link is held to.
        self.limits: Properties = dict(limits or {})
        self.versions = versions
        #: How another version is refused: as that version does, as 3.1.1 does, or by a close.
        self.refuses_version: Literal["its version", "3.1.1", "close"] = "its version"
        #: More filters than that in one SUBSCRIBE are a fault (AWS IoT: 8).
        self.filters_a_packet: int | None = None
        self.session_present = False
        self.reason_code = 0
        #: Called with each connection, CONNECT, SUBSCRIBE, PINGREQ and PUBLISH.
        self.accept: Callable[[Visit], None] = lambda visit: None
        self.greet: Callable[[Visit], None] = self.good_greeting
        self.grant: Callable[[Visit, Subscribe], None] = self.good_grant
        self.pong: Callable[[Visit], None] = lambda visit: visit.send(Pingresp())
        self.acknowledge: Answer = accept
        self.handlers: dict[type, Callable[[Visit, Packet], None]] = {}
        self.random = random.Random(seed)
        self.port = 0
        self.visits: list[Visit] = []
        self.connects: list[Connect] = []
        self.packets: list[Packet] = []
        self.published: list[Publish] = []
        #: What links have done wrong.
        self.faults: list[str] = []
        #: What went wrong here.
        self.errors: list[Exception] = []
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    def good_greeting(self, visit: Visit) -> None:
        """CONNACK with the limits."""
        visit.send(Connack(self.session_present, self.reason_code, dict(self.limits) or None))
        if self.reason_code:
            visit.close()

    def good_grant(self, visit: Visit, packet: Subscribe) -> None:
        """What was asked for."""
        visit.send(Suback(packet.packet_id, [each.qos for each in packet.subscriptions]))

    async def start(self) -> None:
        """Listen, on the same port as before."""
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", self.port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        """Refuse connections, and reset those that there are."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
        for visit in self.visits:
            visit.reset()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def __aenter__(self) -> FakeFleet:
        await self.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        visit = Visit(self, reader, writer)
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        self.visits.append(visit)
        try:
            self.accept(visit)
            await visit.run()
        except asyncio.CancelledError:
            pass  # `stop`; asyncio would report it
        except Exception as error:
            self.errors.append(error)
        finally:
            self._tasks.discard(task)

    @property
    def visit(self) -> Visit:
        """The latest connection."""
        return self.visits[-1]

    @property
    def topics(self) -> list[str]:
        """Of all that was published, in order."""
        return [packet.topic for packet in self.published]

    async def visited(self, count: int = 1) -> Visit:
        """The link's connection, once it has been granted its subscriptions so often."""

        def ready() -> list[Visit]:
            return [visit for visit in self.visits if visit.ready.is_set()]

        await until(lambda: len(ready()) >= count, f"{count} connections with subscriptions")
        return ready()[count - 1]
