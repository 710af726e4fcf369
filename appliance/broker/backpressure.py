"""Backpressure: a publisher that is faster than its readers waits for them, within limits.

When a QoS 1 or 2 message finds the queue of a connected reader full, it waits, and what its
publisher sends behind it: both are acknowledged later, and the publisher is read later. So nothing
is lost between two clients that both read. Rules say for how long; then `queue_full` decides.

* A reader is waited for as long as its queue drains within PATIENCE at the pace of its
  acknowledgements; the time in which the broker was busy does not count, nor the part of the rest
  that a loaded computer gives to other programs than the reader, nor that in which the reader has
  acknowledged all it was given, as what it is sent next waits for a commit of the store. Who reads
  nothing holds its publishers for PATIENCE, once, until its queue was empty; who reads too slowly,
  for little longer.
* A publisher is held by all its readers together for no more than PUBLISHER_PATIENCE at once, and
  in the long run MESSAGE_PATIENCE a message: readers that conspire slow it to 100 messages a
  second, and no further. Of the time in which none of them was waited for, but the disk or the
  computer, LEAST_COUNTED counts: so four times as long, and to 25 messages a second, at the most.
* Nobody else waits: other publishers, a publisher's messages of QoS 0 that came before, and what a
  publisher acknowledges meanwhile, so that two that publish to each other drain each other's queue.

What the appliance publishes itself (the bridge, wills, plugins) never waits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from appliance.broker.accounting import Accounting
    from appliance.broker.session import Session

#: Seconds in which a full queue has to drain for its reader to be waited for.
PATIENCE = 0.25

#: Seconds that a publisher waits at most at once, whatever the number of its readers, and that each
#: of its messages gives back.
PUBLISHER_PATIENCE = 1.0
MESSAGE_PATIENCE = 0.01

#: The part that counts of a publisher's time while it was the computer that was waited for: so
#: nobody waits without end for readers that are found to be never at fault.
LEAST_COUNTED = 0.25


class Waiting(Protocol):
    """A publisher that waits."""

    def proceed(self) -> None:
        """Try again in a turn of its own."""


class Allowance:
    """Seconds that may be waited: spent by waiting, earned by what gets on.

    Once used up it has to be half full again, so that nobody waits a little for every message.
    """

    __slots__ = ("_most", "left", "used_up")

    def __init__(self, most: float) -> None:
        self._most = self.left = most
        self.used_up = False

    def change(self, seconds: float) -> None:
        """Earn so many seconds, or, below zero, spend them."""
        self.left = min(max(self.left + seconds, 0.0), self._most)
        if not self.left:
            self.used_up = True
        elif 2 * self.left >= self._most:
            self.used_up = False


class Congestion:
    """A connected reader's queue, from when it is more than half full until it is empty."""

    __slots__ = (
        "_a_byte",
        "_a_message",
        "_accounting",
        "_allowance",
        "_dawdled",
        "_earned",
        "_held_back",
        "_is_owed",
        "_looked_at",
        "_session",
        "_unwritten",
        "_waiting",
        "awaited",
    )

    def __init__(self, session: Session, accounting: Accounting) -> None:
        self._session = session
        self._accounting = accounting
        self._a_message = PATIENCE / accounting.limits.queue_messages
        self._a_byte = PATIENCE / accounting.limits.queue_bytes
        self._allowance = Allowance(PATIENCE)
        self._looked_at = accounting.spare()
        self._earned = 0.0  # since it was looked at
        self._dawdled = 0.0
        #: Packet ids that wait for the flush, and for a batch of the store.
        self._unwritten: dict[int, None] = {}
        self._held_back: dict[int, int] = {}
        #: Whether there is something that the reader has been given and not acknowledged.
        self._is_owed = True
        #: Those who wait, in the order in which they came.
        self._waiting: dict[Waiting, None] = {}
        #: Whether somebody waits for room and was not told yet that there is some.
        self.awaited = False
        accounting.congested[session] = None

    def acknowledged(self, packet_id: int, size: int) -> None:
        """The reader has a message of so many bytes."""
        self.settled(packet_id)
        by_size = size * self._a_byte
        self._earned += by_size if by_size > self._a_message else self._a_message
        if self._allowance.used_up and self._earned > PATIENCE / 2 and self.patience():
            self._accounting.congested[self._session] = None

    @property
    def left(self) -> float:
        """Seconds that publishers might wait for it when it was looked at last."""
        return self._allowance.left

    def sent(self, packet_id: int) -> None:
        """A message, or the PUBREL of one, goes to the reader with the next flush."""
        self._unwritten[packet_id] = None

    def settled(self, packet_id: int) -> None:
        """The reader owes nothing for what was sent under that id."""
        self._unwritten.pop(packet_id, None)
        self._held_back.pop(packet_id, None)

    def held_back(self, batch: int) -> None:
        """What was sent since the last flush waits until this batch is committed."""
        self._held_back.update(dict.fromkeys(self._unwritten, batch))
        self._unwritten.clear()
        self._look_what_is_owed()

    def written(self, committed: int) -> None:
        """What was sent has gone out, and what waited for batches up to this one."""
        self._unwritten.clear()
        held_back = self._held_back
        while held_back and held_back[oldest := next(iter(held_back))] <= committed:
            del held_back[oldest]
        self._look_what_is_owed()

    def _look_what_is_owed(self) -> None:
        inflight = self._session.inflight
        is_owed = len(self._held_back) < len(inflight) or not inflight
        if is_owed is not self._is_owed:
            self._settle()
            self._is_owed = is_owed

    def _settle(self) -> None:
        """Take account of the time up to now."""
        # The reader is not to blame for the time in which the broker had others to serve.
        now, idle = self._accounting.spare(), 0.0
        if self._is_owed or self._accounting.failing:
            idle = now - self._looked_at
            self._dawdled += idle
        self._allowance.change(self._earned - idle)
        self._looked_at = now
        self._earned = 0.0

    def dawdled(self) -> float:
        """Seconds since the beginning in which it was the reader that was waited for."""
        if self._session in self._accounting.congested:
            self._settle()
        return self._dawdled

    def patience(self) -> float:
        """Seconds that publishers may wait for this reader from now on."""
        self._settle()
        allowance = self._allowance
        if not allowance.used_up:
            return allowance.left
        self._accounting.congested.pop(self._session, None)
        return 0.0

    def wait(self, publisher: Waiting) -> None:
        """Let a publisher wait, or go on waiting in its place, for `wake`."""
        self._waiting[publisher] = None
        self.awaited = True

    def forget(self, publisher: Waiting) -> None:
        """It does not wait any more."""
        self._waiting.pop(publisher, None)
        if not self._waiting:
            self.awaited = False

    def wake(self) -> None:
        """There is room again: let those who wait try, in their order."""
        if self.awaited:
            self.awaited = False
            for publisher in self._waiting:
                publisher.proceed()

    def resume(self) -> None:
        """The reader has come back, to what is left of the patience with it."""
        self._looked_at = self._accounting.spare()
        self._earned = 0.0
        self._unwritten.clear()
        self._held_back.clear()
        self._is_owed = True
        if not self._allowance.used_up:
            self._accounting.congested[self._session] = None

    def end(self) -> None:
        """The queue is empty, or its reader gone: nobody waits for it."""
        self._accounting.congested.pop(self._session, None)
        self.wake()
