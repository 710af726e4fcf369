"""Where the ROS thread leaves messages for the event loop's thread: bounded, the newest kept, and
small ones taken before large ones.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from appliance.broker.message import Message
from appliance.ros.metrics import FlowCounters

#: The most that waits in all: a loop that was busy for a second with 10 kHz on the bus.
MAX_MESSAGES = 10_000
MAX_BYTES = 64 * 1024 * 1024

#: A payload of more bytes is large: an image or a map, not a state or a command.
LARGE = 32 * 1024

#: Bytes that are taken in one go, if that is more than one message: a millisecond or two of work.
TAKEN_BYTES = 1024 * 1024


@dataclass(eq=False, slots=True)
class Lane:
    """The messages of one topic that wait; of more than `keep` the oldest is dropped.

    `timed` is one of which it is known when it was published, in nanoseconds since the epoch.
    """

    keep: int
    counters: FlowCounters
    timed: tuple[Message, int] | None = None
    waiting: deque[Message] = field(default_factory=deque)
    #: Where it waits for its turn, if it does.
    queue: deque[Lane] | None = None


class Mailbox:
    """Lanes of messages between two threads.

    `wake` is called on the sender's thread when there is something to take and it has not been
    called since the mailbox was last found empty.
    """

    def __init__(
        self,
        wake: Callable[[], None],
        max_messages: int = MAX_MESSAGES,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        self._wake = wake
        self._max_messages = max_messages
        self._max_bytes = max_bytes
        self._lock = threading.Lock()
        #: The lanes with something waiting, the one whose turn it is first: those whose next
        #: message is small, and those where it is large.
        self._small: deque[Lane] = deque()
        self._large: deque[Lane] = deque()
        self._messages = 0
        self._bytes = 0
        self._is_awake = False

    def put(self, lane: Lane, message: Message) -> None:
        """Leave a message. When there is no room the oldest of the lane, or of the lane whose turn
        it is, large ones before small ones, is dropped and counted; one message alone always has
        room."""
        with self._lock:
            waiting = lane.waiting
            if len(waiting) >= lane.keep:
                self._drop(lane)
            waiting.append(message)
            self._place(lane)
            self._messages += 1
            self._bytes += len(message.payload)
            while self._messages > 1 and (
                self._messages > self._max_messages or self._bytes > self._max_bytes
            ):
                first = (self._large or self._small)[0]
                self._drop(first)
                self._place(first)
            if self._is_awake:
                return
            self._is_awake = True
        self._wake()

    def take(self, limit: int) -> tuple[list[tuple[Lane, Message]], bool]:
        """Up to `limit` messages, one of each lane in turn, and whether that is not all.

        All that are small go before those that are large. These are taken one by one, as long as
        there is not much already, so that what comes meanwhile waits for little.
        """
        taken: list[tuple[Lane, Message]] = []
        size = 0
        with self._lock:
            while len(taken) < limit and size < TAKEN_BYTES:
                ready = self._small or self._large
                if not ready:
                    break
                lane = ready.popleft()
                lane.queue = None
                message = lane.waiting.popleft()
                self._messages -= 1
                self._bytes -= len(message.payload)
                size += len(message.payload)
                taken.append((lane, message))
                self._place(lane)
            is_all = not (self._small or self._large)
            if is_all:
                self._is_awake = False
        return taken, not is_all

    def _place(self, lane: Lane) -> None:
        """Let a lane have its turn among those of its kind; it stays where it is, if it can."""
        wanted = None
        if lane.waiting:
            wanted = self._large if len(lane.waiting[0].payload) > LARGE else self._small
        if lane.queue is wanted:
            return
        if lane.queue is not None:
            lane.queue.remove(lane)
        if wanted is not None:
            wanted.append(lane)
        lane.queue = wanted

    def _drop(self, lane: Lane) -> None:
        message = lane.waiting.popleft()
        self._messages -= 1
        self._bytes -= len(message.payload)
        lane.counters.dropped += 1
