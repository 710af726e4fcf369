"""Where the ROS thread leaves messages for the event loop's thread: bounded, the newest kept."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from appliance.broker.message import Message
from appliance.ros.figures import Counters

#: The most that waits in all: a loop that was busy for a second with 10 kHz on the bus.
MAX_MESSAGES = 10_000
MAX_BYTES = 64 * 1024 * 1024


@dataclass(eq=False, slots=True)
class Lane:
    """The messages of one topic that wait; of more than `keep` the oldest is dropped.

    `timed` is one of which it is known when it was published, in nanoseconds since the epoch.
    """

    keep: int
    counters: Counters
    timed: tuple[Message, int] | None = None
    waiting: deque[Message] = field(default_factory=deque)


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
        #: The lanes with something waiting, the one whose turn it is first.
        self._ready: deque[Lane] = deque()
        self._messages = 0
        self._bytes = 0
        self._is_awake = False

    def put(self, lane: Lane, message: Message) -> None:
        """Leave a message. When there is no room the oldest of the lane, or of the lane whose turn
        it is, is dropped and counted; one message alone always has room."""
        with self._lock:
            waiting = lane.waiting
            if not waiting:
                self._ready.append(lane)
            elif len(waiting) >= lane.keep:
                self._drop(lane)
            waiting.append(message)
            self._messages += 1
            self._bytes += len(message.payload)
            while self._messages > 1 and (
                self._messages > self._max_messages or self._bytes > self._max_bytes
            ):
                first = self._ready[0]
                self._drop(first)
                if not first.waiting:
                    self._ready.popleft()
            if self._is_awake:
                return
            self._is_awake = True
        self._wake()

    def take(self, limit: int) -> list[tuple[Lane, Message]]:
        """Up to `limit` messages, one of each lane in turn; fewer only when that is all."""
        taken: list[tuple[Lane, Message]] = []
        ready = self._ready
        with self._lock:
            while ready and len(taken) < limit:
                lane = ready.popleft()
                message = lane.waiting.popleft()
                self._messages -= 1
                self._bytes -= len(message.payload)
                taken.append((lane, message))
                if lane.waiting:
                    ready.append(lane)
            if len(taken) < limit:
                self._is_awake = False
        return taken

    def _drop(self, lane: Lane) -> None:
        message = lane.waiting.popleft()
        self._messages -= 1
        self._bytes -= len(message.payload)
        lane.counters.dropped += 1
