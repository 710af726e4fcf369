"""Subscriptions on ROS 2 whose messages the event loop's thread takes itself.

An executor wakes two threads a message, its own and then the loop's, and at a thousand messages a
second waking costs more than all else. Here the middleware's thread calls `eventfd_write`, as the C
library has it, for each message: no interpreter and none of its locks, and the loop waits for the
file descriptor as for any other.
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

#: What the loop's thread takes before it lets others have their turn: a millisecond of work.
BATCH = 64
BATCH_BYTES = 2 * LARGE

#: Seconds in which there is always more than a batch until it is no burst any more: the loop cannot
#: keep up, and what it takes gets ever older.
BEHIND_AFTER = 0.5

#: So many small messages in a row it takes until a topic with a large one is thought small again.
SMALL_IN_A_ROW = 16

#: How many messages of a subscription are timed first, and of how many one is then.
FIRST_TIMED = 100
ONE_TIMED_OF = 16

_SET_CALLBACK = "rcl_subscription_set_on_new_message_callback"


class UnavailableError(Exception):
    """Subscriptions cannot be taken from here; the message says why."""


class Doorbell:
    """A file descriptor that is readable when a subscription has new messages."""

    def __init__(self, pointer: int) -> None:
        """For the `rcl_subscription_t` there. Raises UnavailableError."""
        # With 32 bits, eventfd_write does not take its arguments the way a callback is given them.
        if ctypes.sizeof(ctypes.c_void_p) < 8:
            raise UnavailableError("not on a computer with 32 bits")
        try:
            # rclpy has loaded it; another copy would not know the subscription.
            rcl = ctypes.CDLL("librcl.so", os.RTLD_NOW | os.RTLD_NOLOAD)
            self._set_callback = getattr(rcl, _SET_CALLBACK)
            ring = ctypes.cast(ctypes.CDLL(None).eventfd_write, ctypes.c_void_p)
            self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        except (OSError, AttributeError) as error:
            raise UnavailableError(str(error)) from error
        self._set_callback.argtypes = [ctypes.c_void_p] * 3
        if self._set_callback(pointer, ring, self.fd):
            os.close(self.fd)
            raise UnavailableError("this middleware does not tell of new messages")

    def rings(self) -> int:
        """How many messages have come since it was last asked."""
        try:
            return os.eventfd_read(self.fd)
        except BlockingIOError:
            return 0

    def ring(self) -> None:
        """As if one had come."""
        os.eventfd_write(self.fd, 1)

    def silence(self, pointer: int) -> None:
        """It does not ring any more. The middleware waits here for a thread that is just ringing,
        so that `close` may follow, which must come before the subscription's end."""
        self._set_callback(pointer, None, None)

    def close(self) -> None:
        """After `silence`, when nobody waits for it any more."""
        os.close(self.fd)


class Losses(Protocol):
    """What the middleware lost of a subscription's messages. For the ROS thread."""

    def take(self) -> int:
        """How many since it was asked last."""

    def destroy(self) -> None:
        """Before the subscription's own end."""


class LoopSubscription:
    """A subscription that no executor knows; a RosSubscription.

    Large messages, and those right behind them, are left to the ROS thread: on the loop's they
    would be in everybody's way. That they are there is noticed on the loop's all the same.
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
        """`handle` is rclpy's own, which becomes this one's to destroy. `call_soon` leads to the
        ROS thread, where `callback` is called, and this is. Raises UnavailableError."""
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
        #: Messages that the doorbell rang for and that have not been taken; fewer than none when
        #: some were taken before it rang for them.
        self._owed = 0
        self._lost = 0
        #: How many small messages are missing until the topic is thought small.
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
        # If the loop's thread is taking messages at this moment, it happens when that is done.
        self._handle.destroy_when_not_in_use()
        try:
            self._entries.from_thread("ros.close", self._close)
        except RuntimeError:  # the loop is closed, and waits for nothing any more
            self._doorbell.close()

    def take_lost(self) -> int:
        return 0 if self._is_ended else self._losses.take()

    # The loop's thread

    def _listen(self) -> None:
        if not self._is_ended:
            self._entries.reader("ros.ring", self._doorbell.fd, self._ring, failed=self._quiet)

    def _quiet(self) -> None:
        """What rang is not taken now, or it would ring for ever: it is when it rings again."""
        self._owed += self._doorbell.rings()

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
            # Not by a callback of the loop's: with what comes meanwhile there would be two turns a
            # round, then three, and one that is left when the ROS thread has been given the rest.
            self._owed -= 1
            self._doorbell.ring()
        lost, self._lost = self._lost, 0
        self._on_loop(batch, lost, is_late)

    def _hand_over(self, batch: list[tuple[bytes, int]]) -> None:
        """Let the ROS thread have these messages and what there is more; until it is done, the
        subscription is its own."""
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
                self._call_soon(lambda: self._take_large([]))  # others have their turn before
            else:
                lost, self._lost = self._lost, 0
                with suppress(RuntimeError):  # the loop is closed
                    self._entries.from_thread(
                        "ros.take_back", self._take_back, lost, failed=self._listen
                    )

    # The one that has the subscription

    def _take(self) -> tuple[list[tuple[bytes, int]], bool]:
        """Up to a batch of what there is, and whether that may not be all."""
        batch: list[tuple[bytes, int]] = []
        size = 0
        self._owed += self._doorbell.rings()
        take, message_class = self._take_message, self._message_class
        try:
            with self._handle:
                while len(batch) < BATCH and size < BATCH_BYTES:
                    taken = take(message_class, True)
                    if taken is None:
                        # What rang and is not there had to make room.
                        self._lost += max(self._owed, 0)
                        self._owed = min(self._owed, 0)
                        return batch, False
                    cdr, info = taken
                    self._owed -= 1
                    size += len(cdr)
                    if len(cdr) > LARGE:
                        self._large_for = SMALL_IN_A_ROW
                    elif self._large_for:
                        self._large_for -= 1
                    self._until_timed -= 1
                    batch.append((cdr, 0 if self._until_timed else self._published_at(info)))
        except RuntimeError:  # rclpy's InvalidHandle: it has been destroyed just now
            return batch, False
        return batch, True

    def _published_at(self, info: Any) -> int:
        self._timed += 1
        self._until_timed = 1 if self._timed < FIRST_TIMED else ONE_TIMED_OF
        return published_at(info, self._since)


def published_at(info: Any, since: int) -> int:
    """When rclpy says that a message was published, in nanoseconds since the epoch; 0 for what was
    published before `since`, and kept for late subscribers.

    `since` is of the clock that only counts: the other one may have been set meanwhile.
    """
    at = int(info["source_timestamp"])
    return at if time.time_ns() - at < time.monotonic_ns() - since else 0
