"""Backpressure: a publisher that is faster than its readers waits for them, within limits.

When the queue of a connected reader (a receiver of the message) is full, a QoS 1 or 2 message
waits, and so do later packets of its publisher: they are acknowledged later, and the publisher's
connection is read later. So no message is lost between two clients that both keep reading. The
wait is limited by these rules; after it `queue_full` decides.

* Publishers wait for a reader as long as its queue drains within PATIENCE at the rate of its
  acknowledgements. Three times do not count: while the broker was busy; the share that a loaded
  computer gives to other programs than the reader; and while the reader has acknowledged everything
  it was sent, because its next messages wait for a commit of the store. A reader that does not read
  holds its publishers for PATIENCE, once, until its queue has been empty; one that reads too slowly
  holds them for little longer.
* All readers together hold a publisher for at most PUBLISHER_PATIENCE at a time, and in the long
  run for MESSAGE_PATIENCE per message: colluding readers can slow it to 100 messages a second, but
  no further. Time in which it waited for the disk or the computer, and not for a reader, counts by
  the factor LEAST_COUNTED: such waits are at most four times as long, down to 25 messages a second.
* Nothing else waits: neither other publishers, nor the publisher's earlier QoS 0 messages, nor its
  acknowledgements, so that two clients that publish to each other drain each other's queues.

Publishers of what a link to another broker keeps wait for the disk as well, see `DiskCongestion`.

Messages of the appliance itself (the bridge, wills, plugins) never wait.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from appliance.broker.accounting import Accounting, CongestedReader

#: Publishers wait for a reader if its full queue would drain within this time, in seconds.
PATIENCE = 0.25

#: Seconds that a publisher waits at most at a time, whatever the number of its readers, and seconds
#: that each of its messages adds to its allowance.
PUBLISHER_PATIENCE = 1.0
MESSAGE_PATIENCE = 0.01

#: Seconds after which a publisher that waits for the disk tries again though nobody has woken it.
LOOK_AGAIN = 1.0

#: The share that counts of the time in which a publisher waited for the computer: it limits the
#: wait for readers that are never found to be at fault.
LEAST_COUNTED = 0.25


class Waiting(Protocol):
    """A waiting publisher."""

    def proceed(self) -> None:
        """Try again, in a turn of its own."""


class Allowance:
    """Seconds that may be spent waiting; progress earns more.

    Once used up it is usable again when it is half full, or each message would wait a little.
    """

    __slots__ = ("_most", "left", "used_up")

    def __init__(self, most: float) -> None:
        self._most = self.left = most
        self.used_up = False

    def change(self, seconds: float) -> None:
        """Add seconds; negative: spend them."""
        self.left = min(max(self.left + seconds, 0.0), self._most)
        if not self.left:
            self.used_up = True
        elif 2 * self.left >= self._most:
            self.used_up = False


class PublisherAllowance(Allowance):
    """The allowance of a publisher, and the congestions that it waits for.

    It does not refer to the publisher, whose memory is to be free as soon as it has ended.
    """

    __slots__ = ("_reader_time", "_since", "awaited")

    def __init__(self) -> None:
        super().__init__(PUBLISHER_PATIENCE)
        self.awaited: Sequence[Congestion] = ()
        self._since = 0.0
        self._reader_time = 0.0  # the sum over the awaited congestions at that time

    def wait(self, publisher: Waiting, congestions: Sequence[Congestion], now: float) -> float:
        """Let it wait for these from now on, and for no others; returns the seconds that it may."""
        for congestion in self.awaited:
            if congestion not in congestions:
                congestion.forget(publisher)
        self.awaited = congestions
        self._since = now
        self._reader_time = sum(congestion.reader_time() for congestion in congestions)
        seconds = self.left
        for congestion in congestions:
            congestion.wait(publisher)
            seconds = min(seconds, congestion.left)
        return seconds

    def spend(self, now: float) -> None:
        """Count the time since `wait`, or since the last call."""
        if not self.awaited:
            return
        reader_time = sum(congestion.reader_time() for congestion in self.awaited)
        waited = now - self._since
        # The congestions overlap: together they count no more than the time that it waited.
        counted = min(max(reader_time - self._reader_time, waited * LEAST_COUNTED), waited)
        self.change(-counted)
        self._since, self._reader_time = now, reader_time

    def end_wait(self, publisher: Waiting) -> None:
        """A message need not wait, or not any longer."""
        if self.left < PUBLISHER_PATIENCE:
            self.change(MESSAGE_PATIENCE)
        if self.awaited:
            self.stop_waiting(publisher)

    def stop_waiting(self, publisher: Waiting) -> None:
        """Wait for nobody any more; may be called twice."""
        for congestion in self.awaited:
            congestion.forget(publisher)
        self.awaited = ()


class Congestion:
    """A connected reader's queue, from when it is more than half full until it is empty."""

    __slots__ = (
        "_a_byte",
        "_a_message",
        "_accounting",
        "_allowance",
        "_earned",
        "_has_unacknowledged",
        "_held_back",
        "_reader",
        "_reader_time",
        "_unwritten",
        "_updated_at",
        "_waiting",
        "awaited",
    )

    def __init__(self, reader: CongestedReader, accounting: Accounting) -> None:
        self._reader = reader
        self._accounting = accounting
        self._a_message = PATIENCE / accounting.limits.queue_messages
        self._a_byte = PATIENCE / accounting.limits.queue_bytes
        self._allowance = Allowance(PATIENCE)
        self._updated_at = accounting.client_time()
        self._earned = 0.0  # since `_updated_at`
        self._reader_time = 0.0
        #: Packet ids that wait for the flush, and for a batch of the store.
        self._unwritten: dict[int, None] = {}
        self._held_back: dict[int, int] = {}
        #: Whether the reader was sent messages that it has not acknowledged.
        self._has_unacknowledged = True
        #: The waiting publishers, in their order of arrival.
        self._waiting: dict[Waiting, None] = {}
        #: Whether publishers wait that were not yet woken.
        self.awaited = False
        accounting.congested[reader] = None

    def acknowledged(self, packet_id: int, size: int) -> None:
        """The reader has acknowledged a message of `size` bytes."""
        # `settled` is inlined, which saves a call for each message of a flood.
        self._unwritten.pop(packet_id, None)
        if self._held_back:
            self._held_back.pop(packet_id, None)
        by_size = size * self._a_byte
        self._earned += by_size if by_size > self._a_message else self._a_message
        if self._allowance.used_up and self._earned > PATIENCE / 2 and self.patience():
            self._accounting.congested[self._reader] = None

    @property
    def left(self) -> float:
        """Seconds that publishers might wait for it, as of the last update."""
        return self._allowance.left

    def sent(self, packet_id: int) -> None:
        """A message, or the PUBREL of one, goes to the reader with the next flush."""
        self._unwritten[packet_id] = None

    def settled(self, packet_id: int) -> None:
        """The reader need not acknowledge that packet id any more."""
        self._unwritten.pop(packet_id, None)
        self._held_back.pop(packet_id, None)

    def held_back(self, batch: int) -> None:
        """The messages sent since the last flush wait until this batch is committed."""
        self._held_back.update(dict.fromkeys(self._unwritten, batch))
        self._unwritten.clear()
        self._update_unacknowledged()

    def written(self, committed: int) -> None:
        """Sent messages were written, and those that waited for batches up to this one."""
        self._unwritten.clear()
        held_back = self._held_back
        while held_back and held_back[oldest := next(iter(held_back))] <= committed:
            del held_back[oldest]
        self._update_unacknowledged()

    def _update_unacknowledged(self) -> None:
        inflight = self._reader.inflight
        has_unacknowledged = len(self._held_back) < len(inflight) or not (
            inflight or self._reader.awaits_store
        )
        if has_unacknowledged is not self._has_unacknowledged:
            self._settle()
            self._has_unacknowledged = has_unacknowledged

    def _settle(self) -> None:
        """Account for the time up to now."""
        # Time in which the broker served others is not the reader's fault.
        now, idle = self._accounting.client_time(), 0.0
        if self._has_unacknowledged or self._accounting.failing:
            idle = now - self._updated_at
            self._reader_time += idle
        self._allowance.change(self._earned - idle)
        self._updated_at = now
        self._earned = 0.0

    def reader_time(self) -> float:
        """Seconds in all in which publishers waited for this reader, and not for the computer."""
        if self._reader in self._accounting.congested:
            self._settle()
        return self._reader_time

    def patience(self) -> float:
        """Seconds that publishers may wait for this reader from now on."""
        self._settle()
        allowance = self._allowance
        if not allowance.used_up:
            return allowance.left
        self._accounting.congested.pop(self._reader, None)
        return 0.0

    def wait(self, publisher: Waiting) -> None:
        """Add a waiting publisher; one that already waits keeps its place."""
        self._waiting[publisher] = None
        self.awaited = True

    def forget(self, publisher: Waiting) -> None:
        """Remove a publisher that does not wait any more."""
        self._waiting.pop(publisher, None)
        if not self._waiting:
            self.awaited = False

    def wake(self) -> None:
        """There is room again: let the waiting publishers try, in their order."""
        if self.awaited:
            self.awaited = False
            for publisher in self._waiting:
                publisher.proceed()

    def resume(self) -> None:
        """The reader has reconnected; what was left of its allowance still applies."""
        self._updated_at = self._accounting.client_time()
        self._earned = 0.0
        self._unwritten.clear()
        self._held_back.clear()
        self._has_unacknowledged = True
        self._update_unacknowledged()
        if not self._allowance.used_up:
            self._accounting.congested[self._reader] = None

    def end(self) -> None:
        """The queue is empty, or its reader disconnected: publishers no longer wait for it."""
        self._accounting.congested.pop(self._reader, None)
        self.wake()


class DiskCongestion:
    """More waits to be written for links to other brokers than may be in memory.

    A QoS 1 or 2 message for them waits, and so do later packets of its publisher, for as long as
    the disk takes. No patience ends that: a message is not acknowledged before it is stored, so
    that its publisher waits for the disk in any case.
    """

    __slots__ = ("_accounting", "_waiting")

    def __init__(self, accounting: Accounting) -> None:
        self._accounting = accounting
        #: The waiting publishers, in their order of arrival.
        self._waiting: dict[Waiting, None] = {}

    def begin(self) -> None:
        """Ask about messages from now on, until the next commit."""
        self._accounting.congested[self] = None

    def wait(self, publisher: Waiting) -> float:
        """Add a waiting publisher; returns the seconds after which it tries again anyway."""
        self._waiting[publisher] = None
        return LOOK_AGAIN

    def forget(self, publisher: Waiting) -> None:
        """Remove a publisher that does not wait any more."""
        self._waiting.pop(publisher, None)

    def wake(self) -> None:
        """Something was written, or cannot be: let the waiting publishers try, in their order."""
        self._accounting.congested.pop(self, None)
        while self._waiting:
            publisher = next(iter(self._waiting))
            del self._waiting[publisher]
            publisher.proceed()
