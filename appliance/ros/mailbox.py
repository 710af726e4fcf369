"""A bounded queue of messages from the ROS thread to the event loop's thread.

When it is full the oldest messages are dropped; small messages overtake large ones of other topics.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from appliance.broker.message import Message
from appliance.ros.metrics import FlowCounters

#: The limits of the whole queue: enough for a loop that is busy for a second at 10 kHz on the bus.
MAX_MESSAGES = 10_000
MAX_BYTES = 64 * 1024 * 1024

#: A payload with more bytes is large: an image or a map, not a state or a command.
LARGE = 32 * 1024

#: A batch ends when it has reached so many bytes: a millisecond or two of work.
TAKEN_BYTES = 1024 * 1024


@dataclass(eq=False, slots=True)
class Lane:
    """The queued messages of one topic; if there are more than `depth`, the oldest is dropped.

    `timed` is one of them and the time at which it was published, in nanoseconds since the epoch.
    `counters` are for the receiver.
    """

    depth: int
    counters: FlowCounters
    timed: tuple[Message, int] | None = None
    waiting: deque[Message] = field(default_factory=deque)
    #: The queue of lanes that it is in, if any.
    queue: deque[Lane] | None = None
    #: Messages that were dropped, on either thread: counted under the mailbox's lock.
    dropped: int = 0


class Mailbox:
    """Lanes of messages between two threads.

    `wake` is called on the sender's thread when a message comes, once until the receiver has found
    the mailbox empty again.
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
        #: The lanes with messages, in turn: those whose next message is small, and those whose next
        #: message is large.
        self._small: deque[Lane] = deque()
        self._large: deque[Lane] = deque()
        self._messages = 0
        self._bytes = 0
        self._is_awake = False

    def put(self, lane: Lane, message: Message) -> None:
        """Queue a message. Without room the oldest message of its lane is dropped and counted, or
        the oldest one of the lane whose turn it is, large ones first. A single message always has
        room."""
        with self._lock:
            waiting = lane.waiting
            if len(waiting) >= lane.depth:
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
        """Take up to `limit` messages, one of each lane in turn; True if there are more.

        All small messages go before the large ones. Large ones are taken only until the batch has
        reached TAKEN_BYTES, so that messages that come meanwhile are not delayed for long.
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

    def take_of(self, lane: Lane) -> list[Message]:
        """Take all messages of a lane, which has ended."""
        with self._lock:
            taken = list(lane.waiting)
            lane.waiting.clear()
            self._messages -= len(taken)
            self._bytes -= sum(len(message.payload) for message in taken)
            self._place(lane)
            return taken

    def _place(self, lane: Lane) -> None:
        """Queue a lane by the size of its next message; it keeps its turn if already there."""
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
        lane.dropped += 1
