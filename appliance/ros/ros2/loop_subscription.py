"""Subscriptions on ROS 2 whose messages the event loop's thread takes itself.

An executor wakes two threads for each message, its own and then the loop's, and at a thousand
messages a second these wake-ups cost more than everything else. Here the thread of the middleware
calls the C library's `eventfd_write` for each message, without the interpreter or its lock, and the
loop waits for that file descriptor as for any other.
"""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

from appliance.net.callbacks import Entries
from appliance.ros.mailbox import LARGE
from appliance.ros.node import BusError, TakeBatch

#: The most messages and bytes that the loop's thread takes before other callbacks run: about 1 ms.
BATCH = 64
BATCH_BYTES = 2 * LARGE

#: After so many seconds with always more than a batch it is not a burst any more: the loop cannot
#: keep up, and the messages that it takes get ever older.
BEHIND_AFTER = 0.5

#: After so many small messages in a row, a topic that had a large one counts as small again.
SMALL_IN_A_ROW = 16

#: The first messages of a subscription are all timed; then one of ONE_TIMED_OF is.
FIRST_TIMED = 100
ONE_TIMED_OF = 16

_SET_CALLBACK = "rcl_subscription_set_on_new_message_callback"


class UnavailableError(Exception):
    """The loop's thread cannot take messages itself here; the error text says why."""


class Doorbell:
    """A file descriptor that is readable when a subscription has new messages."""

    def __init__(self, pointer: int) -> None:
        """`pointer` is the address of the `rcl_subscription_t`. Raises UnavailableError."""
        # On 32 bits, the callback's arguments are not passed as eventfd_write expects them.
        if ctypes.sizeof(ctypes.c_void_p) < 8:
            raise UnavailableError("not on a computer with 32 bits")
        try:
            # The copy that rclpy has loaded; another one would not know the subscription.
            rcl = ctypes.CDLL("librcl.so", os.RTLD_NOW | os.RTLD_NOLOAD)
            self._set_callback = getattr(rcl, _SET_CALLBACK)
            ring = ctypes.cast(ctypes.CDLL(None).eventfd_write, ctypes.c_void_p)
            self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        except (OSError, AttributeError) as error:
            raise UnavailableError(str(error)) from error
        self._set_callback.argtypes = [ctypes.c_void_p] * 3
        if self._set_callback(pointer, ring, self.fd):
            os.close(self.fd)
            raise UnavailableError("this middleware does not notify of new messages")

    def rings(self) -> int:
        """The number of messages that have arrived since the last call."""
        try:
            return os.eventfd_read(self.fd)
        except BlockingIOError:
            return 0

    def ring(self) -> None:
        """Make the descriptor readable, as if a message had arrived."""
        os.eventfd_write(self.fd, 1)

    def silence(self, pointer: int) -> None:
        """Remove the callback. The middleware waits here for a thread that is just in it, so that
        `close` may follow. Must be called before the subscription is destroyed."""
        self._set_callback(pointer, None, None)

    def close(self) -> None:
        """Close the descriptor. Call `silence` first, and remove the descriptor from the loop."""
        os.close(self.fd)


class Losses(Protocol):
    """Counts the messages of a subscription that the middleware lost. For the ROS thread."""

    def take(self) -> int:
        """The number of messages lost since the last call."""

    def destroy(self) -> None:
        """Destroy it. Must be called before the subscription is destroyed."""


class LoopSubscription:
    """A RosSubscription without an executor.

    Large messages, and those right behind them, are handed over to the ROS thread: on the loop's
    thread they would delay everything else. The loop's thread is still the one that is notified.
    """

    def __init__(
        self,
        handle: Any,
        message_class: type[Any],
        entries: Entries,
        call_soon: Callable[[Callable[[], None]], None],
        callback: Callable[..., None],
        on_loop: TakeBatch,
        losses: Losses,
    ) -> None:
        """Called on the ROS thread. Raises UnavailableError.

        `handle` is rclpy's own; this object destroys it. `call_soon` calls on the ROS thread, where
        `callback` takes large messages.
        """
        self._handle = handle
        self._take_message = handle.take_message
        self._message_class = message_class
        self._entries = entries
        self._loop = entries.loop
        self._call_soon = call_soon
        self._callback = callback
        self._on_loop = on_loop
        self._losses = losses
        self._since = time.monotonic_ns()
        self._until_timed = 1
        self._timed = 0
        #: Messages that were notified and not taken yet. Negative when messages were taken before
        #: their notification.
        self._notified = 0
        self._lost = 0
        #: Small messages in a row that are missing until the topic counts as small; 0 when it does.
        self._large_for = 0
        #: Since when there has always been more than a batch, by the loop's clock; else None.
        self._behind_since: float | None = None
        self._is_ended = False
        with handle:
            self._doorbell = Doorbell(handle.pointer)
        entries.from_thread("ros.listen", self._listen, failed=self._listen)

    def destroy(self) -> None:
        if self._is_ended:
            return
        self._is_ended = True
        self._losses.destroy()
        with self._handle:
            self._doorbell.silence(self._handle.pointer)
        # When the loop's thread is just taking messages, the handle is destroyed after that.
        self._handle.destroy_when_not_in_use()
        try:
            self._entries.from_thread("ros.close", self._close)
        except RuntimeError:  # the loop is closed, and does not use the descriptor any more
            self._doorbell.close()

    def take_lost(self) -> int:
        return 0 if self._is_ended else self._losses.take()

    # The loop's thread

    def _listen(self) -> None:
        if not self._is_ended:
            self._entries.reader("ros.ring", self._doorbell.fd, self._ring, failed=self._drain)

    def _drain(self) -> None:
        """Reset the descriptor, or the loop would be called forever. The messages are taken at the
        next notification."""
        self._notified += self._doorbell.rings()

    def _close(self) -> None:
        self._loop.remove_reader(self._doorbell.fd)
        self._doorbell.close()

    def _ring(self) -> None:
        if self._is_ended:
            return
        if self._large_for:
            self._hand_over([])
            return
        batch, has_more = self._take()
        if self._large_for:
            self._hand_over(batch)
            return
        is_late = False
        if not has_more:
            self._behind_since = None
        else:
            now = self._loop.time()
            if self._behind_since is None:
                self._behind_since = now
            is_late = now > self._behind_since + BEHIND_AFTER
            # Not by a callback of the loop's: with new notifications there would be two calls an
            # iteration, then three, and a stray one once the ROS thread has the subscription.
            self._notified -= 1
            self._doorbell.ring()
        lost, self._lost = self._lost, 0
        self._on_loop(batch, lost, is_late)

    def _hand_over(self, batch: list[tuple[bytes, int]]) -> None:
        """Hand these messages and the subscription over to the ROS thread, until that has taken all
        messages."""
        self._loop.remove_reader(self._doorbell.fd)
        with suppress(BusError):  # the bus is gone
            self._call_soon(lambda: self._take_large(batch))

    def _take_back(self, lost: int) -> None:
        if self._is_ended:
            return
        if lost:
            self._on_loop([], lost, False)
        self._listen()

    # The ROS thread

    def _take_large(self, batch: list[tuple[bytes, int]]) -> None:
        if self._is_ended:
            return
        has_more = False
        try:
            for message in batch:
                self._callback(*message)
            batch, has_more = self._take()
            for message in batch:
                self._callback(*message)
        finally:
            if has_more:
                self._call_soon(lambda: self._take_large([]))  # behind other callbacks
            else:
                lost, self._lost = self._lost, 0
                with suppress(RuntimeError):  # the loop is closed
                    self._entries.from_thread(
                        "ros.take_back", self._take_back, lost, failed=self._listen
                    )

    # The thread that has the subscription

    def _take(self) -> tuple[list[tuple[bytes, int]], bool]:
        """Take up to a batch of messages. Returns these and whether there may be more."""
        batch: list[tuple[bytes, int]] = []
        size = 0
        self._notified += self._doorbell.rings()
        take, message_class = self._take_message, self._message_class
        try:
            with self._handle:
                while len(batch) < BATCH and size < BATCH_BYTES:
                    taken = take(message_class, True)
                    if taken is None:
                        # Messages that were notified and are gone were dropped by the queue.
                        self._lost += max(self._notified, 0)
                        self._notified = min(self._notified, 0)
                        return batch, False
                    cdr, info = taken
                    self._notified -= 1
                    size += len(cdr)
                    if len(cdr) > LARGE:
                        self._large_for = SMALL_IN_A_ROW
                    elif self._large_for:
                        self._large_for -= 1
                    self._until_timed -= 1
                    batch.append((cdr, 0 if self._until_timed else self._published_at(info)))
        except RuntimeError:  # rclpy's InvalidHandle: the subscription was destroyed meanwhile
            return batch, False
        return batch, True

    def _published_at(self, info: Any) -> int:
        self._timed += 1
        self._until_timed = 1 if self._timed < FIRST_TIMED else ONE_TIMED_OF
        return published_at(info, self._since)


def published_at(info: Any, since: int) -> int:
    """When a message was published, in nanoseconds since the epoch.

    0 for messages that were published before `since`, which durability brings to late subscribers.
    `since` is of the monotonic clock, as the wall clock may have been set meanwhile.
    """
    at = int(info["source_timestamp"])
    return at if time.time_ns() - at < time.monotonic_ns() - since else 0
