"""State that clients can make the broker hold, in the shapes with most memory per byte sent.

Each shape fills one kind of state in a broker of its own until a limit refuses more.
`python tests/memory` runs each in its own process and prints by how much memory grew.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

from broker.conftest import FakeAccess, Peer, lasting

from appliance.broker.broker import Broker
from appliance.broker.limits import Limits, UserLimits
from appliance.mqtt.codec import Properties, Property
from appliance.mqtt.packets import Connack, Publish, Will
from appliance.store import MemoryStore

MIB = 1 << 20

#: How much more the process may grow than the limits allow.
MOST = 1.5

#: Small, so that a shape is full within seconds; what nothing here is to be stopped by is not.
LIMITS: dict[str, Any] = {
    "memory": 8 * MIB,
    "user": UserLimits(
        memory=8 * MIB, retained_messages=10_000_000, retained_bytes=4 * MIB, stored=1 << 40
    ),
    "queue_bytes": 8 * MIB,
    "queue_messages": 10_000_000,
    "retained_bytes": 4 * MIB,
    "retained_messages": 10_000_000,
    "subscriptions": 1_000_000,
    "sessions": 10_000_000,
    "connections": 1000,
    "packet_size": 2 * MIB,
}

#: One character that makes each of the others in a string take four bytes.
WIDE = "\U0001f916"

Fill = Callable[["Filling"], None]
SHAPES: dict[str, tuple[Fill, dict[str, int]]] = {}


def shape(**limits: int) -> Callable[[Fill], Fill]:
    def enter(fill: Fill) -> Fill:
        SHAPES[fill.__name__.replace("_", "-")] = fill, limits
        return fill

    return enter


class Filling:
    """A broker, and ways to fill it."""

    def __init__(self, limits: dict[str, int]) -> None:
        self.limits = Limits(**(LIMITS | limits))
        self.broker = Broker(FakeAccess(), MemoryStore(), self.limits)
        self.broker.tick(1000.0)
        self.peers: list[Peer] = []

    @property
    def counted(self) -> int:
        return self.broker.accounting.queued_bytes + self.broker.retained.bytes

    def join(self, client_id: str, version: int = 5, **options: object) -> Peer:
        peer = Peer(self.broker, version)
        assert peer.connect(client_id, **options).reason_code == 0
        return peer

    def absent(self, topic_filter: str, client_id: str = "absent") -> None:
        """A session that waits for everything that this filter matches."""
        peer = self.join(client_id, **lasting(5))
        assert peer.subscribe(topic_filter, 2) == 2
        peer.lose()

    def publish(
        self,
        topic: Callable[[int], str],
        payload: bytes = b"",
        properties: Properties | None = None,
        retain: bool = False,
    ) -> None:
        """Until there is no room."""
        peer = self.join("publisher")
        for number in count():
            packet = Publish(topic(number), payload, 1, retain, False, 1, properties)
            peer.client.receive(packet.encode(5))
            self.broker.flush()
            answer = bytes(peer.transport.written)
            peer.transport.written.clear()
            if answer[-1] == 0x97:
                break


def resident() -> int:
    """Bytes of memory of this process."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096


def run(name: str) -> tuple[int, int, int]:
    """By how much memory grew, what of it is counted, and what the limits allow; in bytes."""
    fill, limits = SHAPES[name]
    warm = Filling({})
    warm.absent("#")
    warm.join("first").publish("a", b"x", 1, retain=True)
    filling = Filling(limits)
    before = resident()
    fill(filling)
    grown = resident() - before
    return grown, filling.counted, filling.limits.memory + filling.limits.retained_bytes


# --- queues


@shape()
def tiny_messages(filling: Filling) -> None:
    """Empty ones, to one topic of one character."""
    filling.absent("#")
    filling.publish(lambda number: "a")


@shape()
def tiny_messages_to_ever_new_topics(filling: Filling) -> None:
    filling.absent("#")
    filling.publish(lambda number: f"a/{number}")


@shape()
def messages_with_wide_topics(filling: Filling) -> None:
    """Of 16 KB, four bytes a character."""
    filling.absent("#")
    filling.publish(lambda number: f"{number}{WIDE}" + "x" * 16_000)


@shape()
def messages_with_user_properties(filling: Filling) -> None:
    filling.absent("#")
    filling.publish(lambda number: "a", properties={Property.USER_PROPERTY: [("", "")] * 1000})


@shape()
def messages_with_wide_properties(filling: Filling) -> None:
    filling.absent("#")
    pairs = [(WIDE, "x" * 30)] * 500
    wide = {Property.USER_PROPERTY: pairs, Property.CONTENT_TYPE: WIDE + "x" * 10_000}
    filling.publish(lambda number: "a", properties=wide)


@shape()
def messages_of_a_kilobyte(filling: Filling) -> None:
    filling.absent("#")
    filling.publish(lambda number: "a/b/c", bytes(1000))


@shape()
def messages_that_went_to_all_kinds_of_receivers(filling: Filling) -> None:
    """Which are encoded for each of them."""
    filling.absent("#")
    readers = []
    for version in (4, 5):
        for qos in (0, 1, 2):
            reader = filling.join(f"r{version}{qos}", version)
            reader.subscribe("#", qos)
            readers.append(reader)
    peer = filling.join("publisher")
    topic = "x" * 2000
    while filling.counted < filling.limits.memory * 6 // 7 * 0.98:
        if peer.publish(topic, bytes(900), 1):
            break
        for reader in readers:
            reader.drain()


@shape(inflight=65535)
def messages_under_way(filling: Filling) -> None:
    """Sent and not acknowledged."""
    peers = [filling.join(f"silent{number}") for number in range(10)]
    for number, peer in enumerate(peers):
        peer.subscribe("#" if not number else f"p{number}/#", 1)
    publisher = filling.join("publisher")
    for number in count():
        topic = f"p{number % 10}/x"
        packet = Publish(topic, b"", 1, packet_id=1).encode(5)
        publisher.client.receive(packet)
        filling.broker.flush()
        answer = bytes(publisher.transport.written)
        publisher.transport.written.clear()
        for peer in peers:
            peer.transport.written.clear()
        if answer[-1] == 0x97:
            break


@shape()
def newest_of_each_topic(filling: Filling) -> None:
    """QoS 0 for a client that does not read."""
    reader = filling.join("slow")
    reader.subscribe("#", 0)
    reader.slow()
    peer = filling.join("publisher")
    for number in count():
        peer.client.receive(Publish(f"{number}{WIDE}" + "x" * 200, b"").encode(5))
        if filling.broker.counters.publish_dropped:
            break


@shape()
def qos_2_that_is_never_released(filling: Filling) -> None:
    """With many receivers that had no room."""
    for number in range(300):
        peer = filling.join(f"full{number}", **lasting(5))
        peer.subscribe("#", 2)
        peer.lose()
    peer = filling.join("filler")
    while peer.publish("a", bytes(30_000), 1) == 0:
        pass
    for number in range(200):
        peer = filling.join(f"holder{number}", 4)
        for packet_id in range(1, 2000):
            peer.client.receive(Publish("a", b"", 2, packet_id=packet_id).encode(4))
            if peer.transport.closed:
                break
        filling.broker.flush()


# --- retained messages


@shape()
def retained(filling: Filling) -> None:
    filling.publish(lambda number: f"{number}", b"x", retain=True)


@shape()
def retained_deep(filling: Filling) -> None:
    filling.publish(lambda number: f"{number}" + "/a" * 199, b"x", retain=True)


@shape()
def retained_wide(filling: Filling) -> None:
    filling.publish(lambda number: f"a/{number}{WIDE}" + "x" * 5000, b"x", retain=True)


@shape()
def retained_wide_levels(filling: Filling) -> None:
    filling.publish(lambda number: f"{number}" + f"/{WIDE}xxx" * 150, b"x", retain=True)


@shape()
def retained_with_properties(filling: Filling) -> None:
    pairs = [("", "")] * 900
    filling.publish(lambda n: f"a{n}", b"x", {Property.USER_PROPERTY: pairs}, retain=True)


@shape(retained_bytes=4 * MIB)
def retained_and_replaced(filling: Filling) -> None:
    """With a time to live that is not over yet."""
    peer = filling.join("publisher")
    ttl = {Property.MESSAGE_EXPIRY_INTERVAL: 10_000}
    for number in range(200):
        peer.publish("a", bytes([number]) * MIB, retain=True, properties=ttl)


# --- sessions


@shape(sessions=2_500)
def sessions(filling: Filling) -> None:
    """With ids as long as they may be."""
    for number in range(2_500):
        peer = Peer(filling.broker)
        peer.say_connect(f"{number:05d}{WIDE}" + "x" * 1000, **lasting(5))  # type: ignore[arg-type]
        peer.let_in()
        (answer,) = peer.received()
        if not isinstance(answer, Connack) or answer.reason_code:
            break
        peer.lose()


def _subscribe(filling: Filling, filters: Iterator[str]) -> None:
    for number in count():
        peer = filling.join(f"s{number}", **lasting(5))
        for _ in range(200):
            if peer.subscribe(next(filters)):
                return
        peer.lose()


@shape()
def subscriptions(filling: Filling) -> None:
    _subscribe(filling, (f"{number}" for number in count()))


@shape()
def subscriptions_deep(filling: Filling) -> None:
    _subscribe(filling, (f"{number}" + "/a" * 190 for number in count()))


@shape()
def subscriptions_wide(filling: Filling) -> None:
    _subscribe(filling, (f"a/{number}{WIDE}" + "x" * 5000 for number in count()))


@shape()
def subscriptions_shared(filling: Filling) -> None:
    _subscribe(filling, (f"$share/{number}/{number}" for number in count()))


@shape()
def subscriptions_of_all_to_one(filling: Filling) -> None:
    _subscribe(filling, (f"{number % 200}/a" for number in count()))


@shape()
def wills(filling: Filling) -> None:
    pairs = {Property.USER_PROPERTY: [("", "")] * 60, Property.WILL_DELAY_INTERVAL: 1000}
    for number in count():
        peer = Peer(filling.broker)
        will = Will(f"{number}{WIDE}" + "x" * 3000, b"", properties=pairs)  # type: ignore[arg-type]
        peer.say_connect(f"{number}", will=will, **lasting(5))  # type: ignore[arg-type]
        peer.let_in()
        (answer,) = peer.received()
        if not isinstance(answer, Connack) or answer.reason_code:
            break
        peer.lose()


# --- connections


@shape()
def logins_that_wait(filling: Filling) -> None:
    """The largest CONNECT, of which nobody knows yet who sent it."""
    for number in range(200):
        peer = Peer(filling.broker)
        pairs = {Property.USER_PROPERTY: [("", WIDE + "x" * 1000)] * 32}
        will = Will("a", bytes(30_000), properties=pairs)  # type: ignore[arg-type]
        peer.say_connect(f"{number}", will=will, properties=pairs)  # type: ignore[arg-type]
        filling.peers.append(peer)


@shape(memory=2 * MIB)
def unfinished_packets(filling: Filling) -> None:
    """In chunks of two bytes."""
    packet = Publish("a", bytes(1_500_000)).encode(5)
    for number in range(4):
        peer = filling.join(f"{number}")
        filling.peers.append(peer)
        for start in range(0, 1_000_000, 2):
            peer.client.receive(packet[start : start + 2])
            if peer.transport.closed:
                return


@shape()
def topic_aliases(filling: Filling) -> None:
    """In both directions."""
    told = {Property.TOPIC_ALIAS_MAXIMUM: 10}
    for number in range(400):
        peer = filling.join(f"{number}", properties=told)
        filling.peers.append(peer)
        peer.subscribe(f"{number}/#")
        for alias in range(1, 11):
            topic = f"{number}/{alias}{WIDE}" + "x" * 10_000
            peer.send(Publish(topic, b"", properties={Property.TOPIC_ALIAS: alias}))
            peer.transport.written.clear()
            if peer.transport.closed:
                break


@shape()
def routes(filling: Filling) -> None:
    """Publishers to a thousand topics each, and those who may read them."""
    everybody = filling.join("everybody")
    everybody.subscribe("#")
    for number in range(100):
        peer = filling.join(f"{number}")
        filling.peers.append(peer)
        for index in range(1000):
            topic = f"{number}/{index}{WIDE}" + "x" * 450
            peer.client.receive(Publish(topic, b"", retain=False).encode(5))
        filling.broker.flush()
        everybody.transport.written.clear()


@shape(subscriptions=100_000)
def routes_with_identifiers(filling: Filling) -> None:
    """One client with all filters that match one topic, each with an identifier."""
    levels = 8
    everybody = filling.join("everybody")
    for bits in range(1 << levels):
        text = "a" + "".join("/+" if bits >> level & 1 else "/a" for level in range(levels))
        everybody.subscribe(f"{text}/+", properties={Property.SUBSCRIPTION_IDENTIFIER: [bits + 1]})
    for number in range(12):
        peer = filling.join(f"{number}")
        filling.peers.append(peer)
        for index in range(1000):
            topic = "a" + "/a" * levels + f"/{index}"
            peer.client.receive(Publish(topic, b"").encode(5))
            if not index % 20:
                filling.broker.flush()
                everybody.transport.written.clear()
