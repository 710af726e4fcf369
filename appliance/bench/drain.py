"""The load of a link: messages that wait while the fleet's broker is away, and how they drain.

One process publishes to the device, whose link carries the messages, and receives them at the
fleet's broker. That is away while its process is stopped (SIGSTOP): its connections stay, and it
answers nothing. So nothing is measured of how long a link waits before it dials again.

For each line on its standard input the program lets messages wait, answers, lets them drain at the
next line, and answers with a `Result`::

    python -m appliance.bench.drain --port 1883 --pid "$(pidof device)" --fleet-port 1884 \
        --fleet-pid "$(pidof mosquitto)" --messages 100000
"""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path

from appliance.bench.client import LoadClient, LoadError, LoadTarget, publish_packet, reporting
from appliance.bench.load import Result, cpu_seconds, percentile, pin
from appliance.bench.load_clients import RECEIVE_BYTES
from appliance.bench.probe import print_answer

PAYLOAD_BYTES = 100
NUMBER_BYTES = 8  # the first of the payload
FLOOD_WINDOW = 1000  # messages published to the device and not acknowledged
HIGH_SECONDS = 0.02  # between two messages of the high lane
STALL_SECONDS = 60.0  # without a message: a link that has timed out dials again in this time
HERE = "bench/link/"  # topics of the device; its link carries them
THERE = "bench/fleet/link/"  # the same at the fleet's broker
EVENTS = "events"
HIGH = "high"
EVENT_PACKET_ID = b"\xff\xff"  # the place of it in the packet that all are copied from


class Publisher(LoadClient):
    """Publishes with QoS 1 to the device, and counts the acknowledgements."""

    def __init__(self, target: LoadTarget, client_id: str) -> None:
        super().__init__(target, client_id)
        self.acknowledged = 0
        self._answer = memoryview(bytearray(1 << 16))
        self._filled = 0
        self._unsent = memoryview(b"")

    def publish(self, packets: bytes) -> None:
        """Send these packets, now or as soon as the socket accepts them."""
        self._unsent = memoryview(bytes(self._unsent) + packets)
        self.flush()

    def flush(self) -> None:
        self._unsent = self._unsent[self.write(self._unsent) :]

    def receive(self) -> None:
        self._filled += self.transport.recv_into(self._answer[self._filled :])
        count, rest = divmod(self._filled, 4)
        if count and self._answer[0] != 0x40:
            raise LoadError(f"{self.client_id}: expected PUBACK, got {self._answer[0]:#x}")
        self.acknowledged += count
        self._answer[:rest] = bytes(self._answer[4 * count : self._filled])
        self._filled = rest


class Receiver(LoadClient):
    """Takes packets of one length from the fleet's broker, and hands on their numbers.

    The number is at the beginning of the payload, which is at the end of the packet.
    """

    def __init__(
        self, target: LoadTarget, name: str, topic: str, arrived: Callable[[list[bytes]], None]
    ) -> None:
        super().__init__(target, f"bench-{name}-{os.getpid()}")
        self._arrived = arrived
        self._size = 0  # as soon as the first has come: a broker may add nothing to it, or more
        self._buffer = memoryview(bytearray(RECEIVE_BYTES))
        self._filled = 0
        self.wait_connected()
        self.subscribe(topic, 0)
        # As it was published: without packet identifier.
        self._size = len(publish_packet(topic, bytes(PAYLOAD_BYTES)))

    def flush(self) -> None:
        """Do nothing: what a subscriber sends is never sent in parts."""

    def receive(self) -> None:
        buffer, size = self._buffer, self._size
        self._filled += self.transport.recv_into(buffer[self._filled :])
        count, rest = divmod(self._filled, size)
        if not count:
            return
        if buffer[0] & 0xF0 != 0x30:
            raise LoadError(f"{self.client_id}: expected PUBLISH, got {buffer[0]:#x}")
        end = count * size
        data = bytes(buffer[:end])
        start = size - PAYLOAD_BYTES
        if rest:
            buffer[:rest] = bytes(buffer[end : self._filled])
        self._filled = rest
        self._arrived([data[at : at + NUMBER_BYTES] for at in range(start, end, size)])


class Events:
    """The messages that drain, as they arrive: by number, as a link may send one twice."""

    def __init__(self) -> None:
        self.count = 0
        self._base = 0
        self._seen = bytearray()

    def expect(self, base: int, count: int) -> None:
        """From now on the messages with the numbers from `base` on."""
        self.count, self._base = 0, base
        self._seen = bytearray(count)

    def arrived(self, numbers: list[bytes]) -> None:
        """Note those that have not come before."""
        seen, base = self._seen, self._base
        for number in numbers:
            place = int(number) - base
            if 0 <= place < len(seen) and not seen[place]:
                seen[place] = 1
                self.count += 1


class Latencies:
    """The seconds that messages of the high lane took, by number."""

    def __init__(self) -> None:
        self.sent: dict[bytes, float] = {}
        self.samples: list[tuple[float, int]] = []

    def arrived(self, numbers: list[bytes]) -> None:
        """Note how long they were under way."""
        now = time.perf_counter()
        for number in numbers:
            sent_at = self.sent.pop(number, None)
            if sent_at is not None:
                self.samples.append((now - sent_at, 1))


class Drain:
    """The device, its link, the fleet's broker, and the clients of both."""

    def __init__(
        self,
        device: LoadTarget,
        fleet: LoadTarget,
        messages: int,
        window: int,
    ) -> None:
        self._device, self._fleet = device, fleet
        self._messages, self._window = messages, window
        self._poll = select.epoll()
        self._table: dict[int, Callable[[int], None]] = {}
        self._next = 0
        self._events = Events()
        self._high = Latencies()
        run = os.getpid()
        self._receivers = [
            Receiver(fleet, "events", THERE + EVENTS, self._events.arrived),
            Receiver(fleet, "high", THERE + HIGH, self._high.arrived),
        ]
        self._publisher = Publisher(device, f"bench-flood-{run}")
        self._urgent = Publisher(device, f"bench-high-{run}")
        for publisher in (self._publisher, self._urgent):
            publisher.wait_connected()
        self._clients = [*self._receivers, self._publisher, self._urgent]
        for client in self._clients:
            client.attach(self._poll, self._table)
        packet = publish_packet(HERE + EVENTS, bytes(PAYLOAD_BYTES), 0xFFFF)
        self._head = packet[: -PAYLOAD_BYTES - 2]
        self._tail = bytes(PAYLOAD_BYTES - NUMBER_BYTES)

    def close(self) -> None:
        """Close every connection."""
        for client in self._clients:
            client.close()
        self._poll.close()

    def wait_for_link(self) -> None:
        """Publish until something arrives: the link is up. Raises LoadError."""
        until = time.perf_counter() + STALL_SECONDS
        while not self._events.count:
            self._events.expect(self._next, 1)
            self._publish(1)
            again = time.perf_counter() + 0.2
            while time.perf_counter() < again and not self._events.count:
                self._serve(0.05)
            if again > until:
                raise LoadError(f"the link is not up after {STALL_SECONDS:g} s")

    def _publish(self, count: int) -> None:
        """Publish the next messages."""
        head, tail, first = self._head, self._tail, self._next
        self._next = last = first + count
        self._publisher.publish(
            b"".join(
                [
                    b"%b%b%08d%b" % (head, (number % 65535 + 1).to_bytes(2, "big"), number, tail)
                    for number in range(first, last)
                ]
            )
        )

    def _serve(self, seconds: float) -> None:
        for descriptor, event in self._poll.poll(seconds):
            self._table[descriptor](event)

    @contextlib.contextmanager
    def away(self) -> Iterator[None]:
        """The fleet's broker is away."""
        for pid in self._fleet.pids:
            os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            for pid in self._fleet.pids:
                os.kill(pid, signal.SIGCONT)

    def fill(self) -> float:
        """Publish all messages; returns when, in seconds, the device has acknowledged them."""
        self._events.expect(self._next, self._messages)
        began = moved = time.perf_counter()
        publisher, before = self._publisher, self._publisher.acknowledged
        left = self._messages
        seen = 0
        while (done := publisher.acknowledged - before) < self._messages:
            now = time.perf_counter()
            if done != seen:
                seen, moved = done, now
            elif now - moved > STALL_SECONDS:
                raise LoadError(f"the device has acknowledged {done} of {self._messages}")
            room = min(left, FLOOD_WINDOW - (self._messages - left - done))
            if room > 0:
                left -= room
                self._publish(room)
            self._serve(0.1)
        return time.perf_counter() - began

    def drain(self) -> Result:
        """Wait until all have arrived, with messages of the high lane meanwhile.

        The time begins when as many have arrived as the window has: these were under way before.
        """
        events, high = self._events, self._high
        high.samples.clear()
        high.sent.clear()
        skipped = 0
        began = cpu = 0.0
        moved = time.perf_counter()
        due = 0.0
        seen = 0
        while events.count < self._messages:
            now = time.perf_counter()
            if events.count != seen:
                seen, moved = events.count, now
                if not skipped and seen >= min(self._window, self._messages - 1):
                    skipped, began, cpu = seen, now, cpu_seconds(self._device.pids)
            elif now - moved > STALL_SECONDS:
                break
            if skipped and now >= due:
                due = now + HIGH_SECONDS
                self._send_high()
            self._serve(HIGH_SECONDS)
        elapsed = time.perf_counter() - began
        cpu = cpu_seconds(self._device.pids) - cpu
        until = time.perf_counter() + STALL_SECONDS
        while high.sent and time.perf_counter() < until:
            self._serve(HIGH_SECONDS)
        if not skipped:
            raise LoadError(f"{events.count} of {self._messages} messages arrive")
        counted = events.count - skipped
        return Result(
            "drain",
            tls=False,
            seconds=elapsed,
            messages=events.count,
            lost=self._messages - events.count + len(high.sent),
            rate=counted / elapsed,
            cpu_us=1e6 * cpu / counted,
            p50_us=1e6 * percentile(high.samples, 0.50),
            p99_us=1e6 * percentile(high.samples, 0.99),
            broker_busy=cpu / elapsed,
        )

    def _send_high(self) -> None:
        number = b"%08d" % self._next
        self._next += 1
        self._high.sent[number] = time.perf_counter()
        payload = number + self._tail
        self._urgent.publish(publish_packet(HERE + HIGH, payload, self._next % 65535 + 1))


def serve(drain: Drain) -> None:
    """Fill and drain for each pair of lines, until the input ends."""
    drain.wait_for_link()
    print_answer({"ready": True})
    while sys.stdin.readline():
        with drain.away():
            print_answer({"filled": drain.fill()})
            if not sys.stdin.readline():
                return
        print_answer(asdict(drain.drain()))


def pin_both(device: Sequence[int], others: Sequence[int]) -> None:
    """The device on one core, and all else, which is not measured, on another."""
    if pin(device):
        for pid in others:
            for task in Path(f"/proc/{pid}/task").iterdir():
                os.sched_setaffinity(int(task.name), os.sched_getaffinity(0))


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m appliance.bench.drain", description="Let messages of a link wait and drain."
    )
    LoadTarget.add_options(parser)
    parser.add_argument("--fleet-port", type=int, required=True)
    parser.add_argument("--fleet-pid", type=int, required=True)
    parser.add_argument("--messages", type=int, default=100_000)
    parser.add_argument("--window", type=int, default=1000, help="that of the link")
    parser.add_argument("--beside", type=int, action="append", default=[], metavar="PID")
    options = parser.parse_args(arguments)
    with reporting("drain"):
        device = LoadTarget.of(options)
        fleet = replace(device, port=options.fleet_port, pids=(options.fleet_pid,))
        pin_both(device.pids, [options.fleet_pid, *options.beside])
        with closing(Drain(device, fleet, options.messages, options.window)) as drain:
            serve(drain)
    return 0


if __name__ == "__main__":
    sys.exit(main())
