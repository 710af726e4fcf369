"""Recognizes our own samples on a topic that is bridged both ways."""

from __future__ import annotations

import threading
from collections import deque
from time import monotonic

from appliance.ros.payload.definitions import CDR, Serialization

#: Seconds within which a sample of our own comes back; within one process it takes microseconds.
#: And the most samples that are remembered for that.
ECHO_TIME = 2.0
ECHO_SAMPLES = 1000


class EchoFilter:
    """Recognizes samples of our own publisher on a topic that is bridged both ways.

    They are recognized by their content: rclpy cannot ask the middleware to ignore local
    publishers, and its information on a message's sender is missing up to Jazzy and ends
    EventsExecutor in Kilted. If another node publishes the same content at the same time, its
    message may be taken for the echo and the echo for its message: on MQTT that is no difference.
    """

    def __init__(self, serialization: Serialization = CDR) -> None:
        self._header = len(serialization.header)
        #: In CDR, up to three bytes may have been added at the end.
        self._padding = 3 if serialization.header else 0
        self._lock = threading.Lock()
        self._sent: deque[tuple[float, bytes]] = deque(maxlen=ECHO_SAMPLES)

    def sent(self, cdr: bytes) -> None:
        """Remember a sample that is about to be published, without the header of CDR, in which DDS
        notes padding."""
        with self._lock:
            self._sent.append((monotonic() + ECHO_TIME, cdr[self._header :]))

    def is_own(self, cdr: bytes) -> bool:
        """Whether a received sample is one that was sent and has not come back yet."""
        if not self._sent:
            return False
        now = monotonic()
        with self._lock:
            while self._sent and self._sent[0][0] < now:
                self._sent.popleft()
            for index, (_, body) in enumerate(self._sent):
                more = len(cdr) - len(body) - self._header
                if 0 <= more <= self._padding and cdr.startswith(body, self._header):
                    del self._sent[index]
                    return True
        return False
