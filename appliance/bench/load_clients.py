"""The clients of the load generator that send and count messages, and the flow between them."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, replace

from appliance.bench.client import LoadClient, LoadError, LoadTarget, publish_packet

RECEIVE_BYTES = 1 << 20
RING_BYTES = 8 << 20  # limit of a publisher's packets that are encoded beforehand
PUBACK, PUBREC, PUBREL, PUBCOMP = 0x40, 0x50, 0x62, 0x70  # first bytes; each packet has four
DUPLICATE = 0x08  # the flag of a PUBLISH that is sent again


@dataclass(frozen=True, slots=True)
class Load:
    """The load of one cell: the messages, their subscribers, and how many may be in flight."""

    qos: int = 0
    pairs: int = 1
    subscribers: int = 1  # of each publisher
    window: int = 1  # messages of one publisher neither delivered nor acknowledged
    batch: int = 1  # send only when this many fit into the window
    payload: int = 64  # bytes
    topics: int = 1  # of each publisher, in turn; the subscriber has one wildcard for all
    stored: bool = False  # the subscribers' sessions outlive their connections
    flood: int = 0  # messages in total, sent as fast as they are acknowledged, with a probe beside
    idle: int = 0  # connections that stay idle: measures memory, not messages


def topic_of(topic: str, load: Load, number: int) -> str:
    """The topic of a publisher's message with this number; all have the same length."""
    return topic if load.topics == 1 else f"{topic}/{number:06d}"


class MessageFlow:
    """The messages of one publisher: flow control by the window, and latencies."""

    def __init__(self, load: Load) -> None:
        self.load = load
        self.sent = 0
        self.acknowledged = 0
        self.deliveries = 0  # over all subscribers
        self.latencies: list[tuple[float, int]] = []  # seconds, and of how many deliveries
        self._marks: deque[tuple[int, float]] = (
            deque()
        )  # total deliveries when complete, and when sent
        self._publisher: LoadPublisher

    def start(self, publisher: LoadPublisher) -> None:
        """Send the first messages."""
        self._publisher = publisher
        self._send()

    def acknowledge(self, count: int) -> None:
        """Count messages that the broker has acknowledged."""
        self.acknowledged += count
        self._send()

    def deliver(self, count: int) -> None:
        """Count messages that have arrived at a subscriber."""
        now, done, marks = time.perf_counter(), self.deliveries, self._marks
        self.deliveries = end = done + count
        while done < end:
            if not marks:
                raise LoadError("the broker delivered more messages than were sent")
            due, sent_at = marks[0]
            taken = min(due, end)
            self.latencies.append((now - sent_at, taken - done))
            done = taken
            if done == due:
                marks.popleft()
        self._send()

    @property
    def missing(self) -> int:
        """Deliveries of sent messages that have not arrived."""
        return self.sent * self.load.subscribers - self.deliveries

    @property
    def in_flight(self) -> int:
        """Messages neither delivered to all subscribers nor, with QoS 1 and 2, acknowledged."""
        done = self.deliveries // self.load.subscribers
        if self.load.qos:
            done = min(done, self.acknowledged)
        return self.sent - done

    def stop(self) -> None:
        """Stop sending."""
        self.load = replace(self.load, window=0)

    def _send(self) -> None:
        room = self.load.window - self.in_flight
        if room >= self.load.batch:
            self.sent += room
            self._marks.append((self.sent * self.load.subscribers, time.perf_counter()))
            self._publisher.send(room)


class FloodFlow(MessageFlow):
    """The flow of a publisher that waits for acknowledgements, and not for the subscriber."""

    @property
    def in_flight(self) -> int:
        return self.sent - self.acknowledged

    @property
    def missing(self) -> int:
        return self.load.flood - self.deliveries

    def _send(self) -> None:
        room = min(self.load.window - self.in_flight, self.load.flood - self.sent)
        if room > 0:
            self.sent += room
            self._marks.append((self.sent, time.perf_counter()))
            self._publisher.send(room)


class LoadPublisher(LoadClient):
    """Sends packets out of a ring buffer of packets that are encoded beforehand."""

    def __init__(self, target: LoadTarget, client_id: str, flow: MessageFlow, topic: str) -> None:
        super().__init__(target, client_id)
        load = flow.load
        payload = bytes(index & 0x7F for index in range(load.payload))
        topics = [topic_of(topic, load, number) for number in range(load.topics)]
        self._flow = flow
        self._size = len(publish_packet(topics[0], payload, 1 if load.qos else None, qos=load.qos))
        # Twice the window: an identifier is free again long before its packet is sent again.
        count = min(max(2 * load.window, 64), max(2 * load.window, RING_BYTES // self._size), 65535)
        self._ring = memoryview(
            b"".join(
                publish_packet(
                    topics[index % load.topics],
                    payload,
                    1 + index if load.qos else None,
                    qos=load.qos,
                )
                for index in range(max(count, load.topics))
            )
        )
        self._position = 0
        self._unsent = 0
        self._answer = memoryview(bytearray(4 * 65536))
        self._answered = 0

    def send(self, count: int) -> None:
        """Send `count` messages, now or as soon as the socket accepts them."""
        if self._unsent:
            self._unsent += count * self._size
        else:
            self._unsent = count * self._size
            self.flush()

    def flush(self) -> None:
        while self._unsent:
            sent = self.write(self._ring[self._position : self._position + self._unsent])
            if not sent:
                return
            self._unsent -= sent
            self._position = (self._position + sent) % len(self._ring)

    def receive(self) -> None:
        before = self._answered // 4
        size = self.transport.recv_into(self._answer)
        if size and self._answered % 4 == 0 and self._answer[0] != PUBACK:
            raise LoadError(f"{self.client_id}: expected PUBACK, got {self._answer[0]:#x}")
        self._answered += size
        if count := self._answered // 4 - before:
            self._flow.acknowledge(count)


class LoadSubscriber(LoadClient):
    """Counts messages by their length, and acknowledges them with QoS 1."""

    def __init__(self, target: LoadTarget, client_id: str, flow: MessageFlow, topic: str) -> None:
        load = flow.load
        super().__init__(target, client_id, clean=not load.stored)
        example = publish_packet(
            topic_of(topic, load, 0), bytes(load.payload), 0 if load.qos else None
        )
        self._flow = flow
        self._qos = load.qos
        self._size = len(example)
        self._identifier = self._size - load.payload - 2
        self._buffer = memoryview(bytearray(max(RECEIVE_BYTES // load.subscribers, 2 * self._size)))
        self._filled = 0
        self._acknowledgements = memoryview(b"")

    def receive(self) -> None:
        buffer, size = self._buffer, self._size
        self._filled = filled = self._filled + self.transport.recv_into(buffer[self._filled :])
        count, rest = divmod(filled, size)
        if not count:
            return
        if buffer[0] & 0xF0 != 0x30:
            raise LoadError(f"{self.client_id}: expected PUBLISH, got {buffer[0]:#x}")
        end = count * size
        if self._qos:
            answer = bytearray(b"\x40\x02\0\0" * count)
            answer[2::4] = buffer[self._identifier : end : size]
            answer[3::4] = buffer[self._identifier + 1 : end : size]
            if self._acknowledgements:
                answer = bytearray(self._acknowledgements) + answer
            self._acknowledgements = memoryview(answer)
            self.flush()
        if rest:
            buffer[:rest] = bytes(buffer[end:filled])
        self._filled = rest
        self._flow.deliver(count)

    def flush(self) -> None:
        self._acknowledgements = self._acknowledgements[self.write(self._acknowledgements) :]


class ExactlyOncePublisher(LoadPublisher):
    """Sends with QoS 2: answers each PUBREC with a PUBREL; a PUBCOMP is the acknowledgement."""

    def __init__(self, target: LoadTarget, client_id: str, flow: MessageFlow, topic: str) -> None:
        super().__init__(target, client_id, flow, topic)
        self._outgoing = b""  # what the socket has not accepted: packets of both kinds, in order

    def send(self, count: int) -> None:
        while count:
            start = self._position
            end = min(start + count * self._size, len(self._ring))
            self._outgoing += self._ring[start:end]
            self._position = end % len(self._ring)
            count -= (end - start) // self._size
        self.flush()

    def flush(self) -> None:
        self._outgoing = self._outgoing[self.write(self._outgoing) :]

    def receive(self) -> None:
        answer = self._answer
        filled = self._answered + self.transport.recv_into(answer[self._answered :])
        whole = filled - filled % 4
        done = 0
        for start in range(0, whole, 4):
            if answer[start] == PUBREC:
                self._outgoing += b"\x62\x02" + answer[start + 2 : start + 4]
            elif answer[start] == PUBCOMP:
                done += 1
            else:
                what = f"expected PUBREC or PUBCOMP, got {answer[start]:#x}"
                raise LoadError(f"{self.client_id}: {what}")
        answer[: filled - whole] = bytes(answer[whole:filled])
        self._answered = filled - whole
        self.flush()
        if done:
            self._flow.acknowledge(done)


class ExactlyOnceSubscriber(LoadSubscriber):
    """Counts messages of QoS 2 when they arrive, and answers each PUBLISH and each PUBREL."""

    def receive(self) -> None:
        buffer, size, identifier = self._buffer, self._size, self._identifier
        filled = self._filled + self.transport.recv_into(buffer[self._filled :])
        position = count = 0
        answers = bytearray(self._acknowledgements)
        while filled - position >= 4:
            first = buffer[position]
            if first == PUBREL:
                answers += b"\x70\x02" + buffer[position + 2 : position + 4]
                position += 4
            elif first & ~DUPLICATE == 0x34:
                if filled - position < size:
                    break
                at = position + identifier
                answers += b"\x50\x02" + buffer[at : at + 2]
                position += size
                count += 1
            else:
                what = f"expected PUBLISH or PUBREL, got {first:#x}"
                raise LoadError(f"{self.client_id}: {what}")
        buffer[: filled - position] = bytes(buffer[position:filled])
        self._filled = filled - position
        self._acknowledgements = memoryview(answers)
        self.flush()
        if count:
            self._flow.deliver(count)
