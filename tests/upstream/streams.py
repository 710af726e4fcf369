"""Numbered messages from one side of a link to the other, and what has come of them."""

from __future__ import annotations

import asyncio
import contextlib
import random
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field

from appliance.mqtt.codec import V5, V311
from appliance.mqtt.packets import Publish
from upstream.account import Receipt
from upstream.client import GoneError, MqttClient
from upstream.peers import PASSWORD, USER

#: What ends a connection when the broker ends.
GONE = (OSError, EOFError, asyncio.TimeoutError, GoneError, AssertionError)

#: Seconds for CONNACK and SUBACK, of a broker that has just been started again.
ANSWER = 30.0


@dataclass
class Side:
    """A broker: the port may be another one after each start."""

    port: Callable[[], int]
    user: str | None = USER
    password: str | None = PASSWORD
    version: int = V5
    up: asyncio.Event = field(default_factory=asyncio.Event)


class Member:
    """A client that connects over and over."""

    def __init__(self, side: Side, name: str, *, keeps: bool = False) -> None:
        self.side = side
        self.name = name
        self.keeps = keeps
        self.client: MqttClient | None = None
        self.connects = 0

    @property
    def connected(self) -> bool:
        return self.client is not None and self.client.connected

    async def run(self) -> None:
        while True:
            await self.side.up.wait()
            with contextlib.suppress(*GONE):
                await self._visit()
            if self.client is not None and self.client.connected:
                self.client.abort()
            await asyncio.sleep(0.02)

    async def _visit(self) -> None:
        side = self.side
        dial = MqttClient.dial(
            side.port(),
            self.name,
            version=side.version,
            user=side.user,
            password=side.password,
            clean=not self.keeps,
            expiry=3600 if self.keeps and side.version == V5 else None,
            keep_alive=10,
        )
        self.client = client = await asyncio.wait_for(dial, ANSWER)
        for _, message in client.messages:  # those that came right behind CONNACK
            self.took(message)
        client.on_message = self.took
        self.connects += 1
        await self.began(client)
        alive = asyncio.create_task(self._ping(client))
        try:
            await client.closed.wait()
        finally:
            alive.cancel()

    async def _ping(self, client: MqttClient) -> None:
        """Without it the broker ends a connection on which only QoS 0 comes."""
        while True:
            await asyncio.sleep(3)
            with contextlib.suppress(*GONE):
                await client.ping()

    async def began(self, client: MqttClient) -> None:
        """It is connected."""

    def took(self, message: Publish) -> None:
        """A message came."""


@contextlib.asynccontextmanager
async def running(*members: Member) -> AsyncIterator[None]:
    tasks = [asyncio.create_task(each.run()) for each in members]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


class Source(Member):
    """Publishes 1, 2, 3, … with QoS 1 or 2 on a topic; what it does not know of is not sent again.

    `window` are unacknowledged at a time; `rate` a second at most. It waits while `crowded`.
    """

    def __init__(
        self,
        side: Side,
        name: str,
        topic: str,
        *,
        qos: int = 1,
        window: int = 10,
        rate: float | None = None,
        sizes: tuple[int, ...] = (10, 100, 1000),
        crowded: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(side, name)
        self.topic = topic
        self.qos = qos
        self.window = window
        self.rate = rate
        self.sizes = sizes
        self.crowded = crowded
        self.sent = 0
        self.acknowledged: set[int] = set()
        self.refused: dict[int, int] = {}
        self.stopping = False
        self._random = random.Random(name)

    @property
    def idle(self) -> bool:
        return self.stopping and (self.client is None or not self.client.waiting)

    async def began(self, client: MqttClient) -> None:
        work = asyncio.create_task(self._publish(client))
        client.closed_task = work  # type: ignore[attr-defined]

    async def _publish(self, client: MqttClient) -> None:
        due = time.monotonic()
        while client.connected and not self.stopping:
            if client.waiting >= self.window or self.crowded():
                await asyncio.sleep(0.002)
                continue
            if self.rate is not None:
                due = max(due + 1 / self.rate, time.monotonic() - 0.1)
                await asyncio.sleep(due - time.monotonic())
            self.sent += 1
            number = self.sent
            padding = b"x" * self._random.choice(self.sizes)
            future = client.publish(self.topic, b"%d %s" % (number, padding), self.qos)
            future.add_done_callback(lambda done, number=number: self._outcome(number, done))
            await asyncio.sleep(0)

    def _outcome(self, number: int, done: asyncio.Future[int]) -> None:
        if done.cancelled() or done.exception() is not None:
            return
        code = done.result()
        if code >= 0x80:
            self.refused[number] = code
        else:
            self.acknowledged.add(number)


class Sink(Member):
    """Remembers what comes on some topics, by topic; its session outlives its connections."""

    def __init__(self, side: Side, name: str, *filters: str) -> None:
        super().__init__(side, name, keeps=True)
        self.filters = filters
        self.subscribed = asyncio.Event()
        self.received: dict[str, list[Receipt]] = {}
        self.payloads: dict[str, list[bytes]] = {}
        self.count = 0
        self.flagged = 0  # with DUP: the fleet's broker has sent them again, not the link
        #: Topics of which the payloads are kept as they are.
        self.verbatim: tuple[str, ...] = ()

    async def began(self, client: MqttClient) -> None:
        await client.subscribe(*self.filters, patience=ANSWER)
        self.subscribed.set()

    def took(self, message: Publish) -> None:
        self.count += 1
        self.flagged += message.dup
        if message.topic.startswith(self.verbatim) and self.verbatim:
            self.payloads.setdefault(message.topic, []).append(message.payload)
            return
        number = int(message.payload.split(b" ", 1)[0])
        self.received.setdefault(message.topic, []).append(Receipt(time.monotonic(), number))

    def numbers(self, topic: str) -> list[int]:
        return [receipt.number for receipt in self.received.get(topic, ())]


def version_of(broker: object) -> int:
    """RabbitMQ 3.10 speaks 3.1.1 only."""
    return V311 if "Rabbit" in type(broker).__name__ else V5
