"""Clients that go on where they were when the broker comes back, and remember what was promised."""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections import Counter
from dataclasses import dataclass, field

from appliance_process import HOST, ApplianceProcess

from appliance.mqtt.codec import Property
from appliance.mqtt.packets import (
    Connack,
    Connect,
    Packet,
    Puback,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
    Suback,
    Subscribe,
    Subscription,
    decode_packet,
)

#: Seconds for an answer, on a computer that is busy.
PATIENCE = 30.0

#: Messages that may wait for one subscriber: as many as its session holds easily, for it to be
#: killed quickly and often.
MOST_WAITING = 20_000

#: Seconds until publishers that wait look again.
PAUSE = 0.1

#: What ends a connection when the broker ends.
GONE = (OSError, EOFError, asyncio.TimeoutError)

USER = "alice"


@dataclass
class World:
    """What all clients share: the broker, and what is wrong."""

    broker: ApplianceProcess
    #: Set while the broker runs; clients then connect.
    up: asyncio.Event = field(default_factory=asyncio.Event)
    #: Publishers send nothing new any more.
    stopping: bool = False
    #: Sessions may be gone, as the store was damaged.
    forgetful: bool = False
    problems: list[str] = field(default_factory=list)
    refused: Counter[int] = field(default_factory=Counter)
    publishers: list[Publisher] = field(default_factory=list)
    subscribers: list[Subscriber] = field(default_factory=list)

    def number(self, payload: bytes) -> int:
        """That of a message; 0 when a bit of it flipped in a damaged store."""
        try:
            return int(payload.split(b" ", 1)[0])
        except ValueError:
            if not self.forgetful:
                raise
            return 0

    @property
    def crowded(self) -> bool:
        """Whether so much waits for a subscriber that publishers had better wait, too."""
        sent = sum(publisher.sent for publisher in self.publishers if not publisher.retain)
        taken = min((len(subscriber.received) for subscriber in self.subscribers), default=sent)
        return sent - taken > MOST_WAITING and not self.forgetful


class Client:
    """One client id with a session that outlives its connections."""

    def __init__(self, world: World, client_id: str, version: int, *, tls: bool) -> None:
        self.world = world
        self.client_id = client_id
        self.version = version
        self.tls = tls
        self.connected = False
        self._known = False  # a CONNACK has come: the session must be there from now on
        self._writer: asyncio.StreamWriter | None = None
        self.random = random.Random(client_id)

    async def run(self) -> None:
        """Connect, over and over, until cancelled."""
        while True:
            await self.world.up.wait()
            with contextlib.suppress(*GONE):
                await self._converse()
            self.connected = False
            await asyncio.sleep(0.02)

    async def _converse(self) -> None:
        broker = self.world.broker
        port = broker.port if self.tls else broker.plain_port
        context = broker.tls_context() if self.tls else None
        reader, self._writer = await asyncio.wait_for(
            asyncio.open_connection(
                "127.0.0.1", port, ssl=context, server_hostname=HOST if self.tls else None
            ),
            PATIENCE,
        )
        try:
            properties = {Property.SESSION_EXPIRY_INTERVAL: 3600} if self.version == 5 else None
            password = broker.passwords[USER].encode()
            connect = Connect(
                self.client_id, False, 0, self.version, USER, password, None, properties
            )
            self._writer.write(connect.encode())
            answer = await asyncio.wait_for(self._read(reader), PATIENCE)
            assert isinstance(answer, Connack) and not answer.reason_code, answer
            if self._known and not answer.session_present:
                if not self.world.forgetful:
                    self.world.problems.append(f"{self.client_id}: its session is gone")
                self.forget()
            self._known = True
            self.connected = True
            self.began(new=not answer.session_present)
            while True:
                self.took(await self._read(reader))
        finally:
            self._writer.close()

    async def _read(self, reader: asyncio.StreamReader) -> Packet:
        head = await reader.readexactly(2)
        length, shift = head[1] & 0x7F, 7
        while head[-1] & 0x80:
            head += await reader.readexactly(1)
            length |= (head[-1] & 0x7F) << shift
            shift += 7
        return decode_packet(head[0], await reader.readexactly(length), self.version)

    def send(self, packet: Packet) -> None:
        assert self._writer is not None
        if not self._writer.transport.is_closing():
            self._writer.write(packet.encode(self.version))

    def leave(self) -> None:
        """Be gone without a word."""
        if self._writer is not None:
            self._writer.transport.abort()

    def began(self, *, new: bool) -> None:
        """The session is there."""

    def forget(self) -> None:
        """The session is gone, and what it knew."""

    def took(self, packet: Packet) -> None:
        """A packet came."""


class Publisher(Client):
    """Publishes numbered messages, so many at a time; `acknowledged` are the numbers that were."""

    def __init__(
        self,
        world: World,
        client_id: str,
        version: int,
        qos: int,
        *,
        tls: bool,
        retain: bool = False,
        window: int = 10,
        pause: float = 0.0,
    ) -> None:
        super().__init__(world, client_id, version, tls=tls)
        self.qos = qos
        self.retain = retain
        self.window = window
        self.pause = pause
        self.sent = 0
        self.acknowledged: set[int] = set()
        self.declined: set[int] = set()
        self._unfinished: dict[int, int] = {}  # by packet id, in the order sent
        self._released: dict[int, int] = {}
        self._packet_id = 0
        self._waits = False

    @property
    def idle(self) -> bool:
        return self.connected and not self._unfinished and not self._released

    def topic(self, number: int) -> str:
        if self.retain:
            return f"r2d2/kept/{self.client_id}/{number % 5}"
        return f"r2d2/sent/{self.qos}/{self.client_id}"

    def _packet(self, packet_id: int, number: int, *, dup: bool) -> Publish:
        payload = b"%d " % number + b"x" * self.random.choice((0, 10, 100, 2000))
        return Publish(self.topic(number), payload, self.qos, self.retain, dup, packet_id)

    def began(self, *, new: bool) -> None:
        for packet_id, number in self._unfinished.items():
            self.send(self._packet(packet_id, number, dup=True))
        for packet_id in self._released:
            self.send(Pubrel(packet_id))
        self._fill()

    def forget(self) -> None:
        # What was on its way is sent anew, under ids of its own; nobody can say whether it came.
        self._unfinished.clear()
        self._released.clear()

    def _fill(self) -> None:
        if self.world.crowded:
            if not self._waits:
                self._waits = True
                asyncio.get_running_loop().call_later(PAUSE, self._fill_again)
            return
        busy = self._unfinished.keys() | self._released.keys()
        while self.connected and not self.world.stopping and len(busy) < self.window:
            self._packet_id = self._packet_id % 65535 + 1
            if self._packet_id in busy:
                continue
            busy.add(self._packet_id)
            self.sent += 1
            self._unfinished[self._packet_id] = self.sent
            self.send(self._packet(self._packet_id, self.sent, dup=False))

    def _fill_again(self) -> None:
        self._waits = False
        self._fill()

    def took(self, packet: Packet) -> None:
        if isinstance(packet, Puback) or (
            isinstance(packet, Pubrec) and packet.reason_code >= 0x80
        ):
            self._outcome(self._unfinished.pop(packet.packet_id), packet.reason_code)
        elif isinstance(packet, Pubrec):
            number = self._unfinished.pop(packet.packet_id, None)
            if number is not None:
                self._released[packet.packet_id] = number
            self.send(Pubrel(packet.packet_id))
            return
        elif isinstance(packet, Pubcomp):
            number = self._released.pop(packet.packet_id, None)
            if number is not None:
                self._outcome(number, 0)
        if self.pause:
            asyncio.get_running_loop().call_later(self.pause, self._fill)
        else:
            self._fill()

    def _outcome(self, number: int, code: int) -> None:
        if code >= 0x80:
            self.world.refused[code] += 1
            self.declined.add(number)
        else:
            self.acknowledged.add(number)


class Subscriber(Client):
    """Counts what comes, by publisher and number; `leaves` lets it be absent now and then."""

    def __init__(
        self, world: World, client_id: str, version: int, *, tls: bool, leaves: bool = False
    ) -> None:
        super().__init__(world, client_id, version, tls=tls)
        self.leaves = leaves
        self.subscribed = asyncio.Event()
        self.received: Counter[tuple[str, int]] = Counter()
        self.latest: dict[str, int] = {}
        self.events = 0
        self._unreleased: set[int] = set()

    def began(self, *, new: bool) -> None:
        if not self.subscribed.is_set() or new:
            wanted = [Subscription("r2d2/sent/1/+", 1), Subscription("r2d2/sent/2/+", 2)]
            self.send(Subscribe(1, wanted))
        if self.leaves:
            delay = self.random.uniform(0.05, 0.5)
            asyncio.get_running_loop().call_later(delay, self.leave)

    def forget(self) -> None:
        self._unreleased.clear()

    def took(self, packet: Packet) -> None:
        self.events += 1
        if isinstance(packet, Suback):
            assert max(packet.reason_codes) < 0x80
            self.subscribed.set()
        elif isinstance(packet, Publish):
            self._took_message(packet)
        elif isinstance(packet, Pubrel):
            self._unreleased.discard(packet.packet_id)
            self.send(Pubcomp(packet.packet_id))

    def _took_message(self, packet: Publish) -> None:
        publisher = packet.topic.rpartition("/")[2]
        number = self.world.number(packet.payload)
        assert packet.packet_id is not None
        if packet.qos == 1:
            self._count(publisher, number, packet)
            self.send(Puback(packet.packet_id))
            return
        if packet.packet_id not in self._unreleased:
            self._unreleased.add(packet.packet_id)
            self._count(publisher, number, packet)
        self.send(Pubrec(packet.packet_id))

    def _count(self, publisher: str, number: int, packet: Publish) -> None:
        self.received[publisher, number] += 1
        first = self.received[publisher, number] == 1
        # An older state of a damaged store has other messages under the packet ids that are known
        # here: what was taken for a repetition then may come for the first time later.
        ordered = packet.qos == 2 and not self.world.forgetful
        if first and ordered and number < self.latest.get(publisher, 0):
            text = f"{self.client_id}: {number} of {publisher} after {self.latest[publisher]}"
            self.world.problems.append(text)
        if first:
            self.latest[publisher] = number
