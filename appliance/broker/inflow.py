"""The age of received messages, estimated from the pauses in a client's input.

MQTT messages have no timestamp, but a robot must not carry out commands that were queued somewhere
for seconds. A client with a queue sends it without a pause. A client that sends now and then pauses
in between, when everything it sent has arrived completely. So messages were sent no earlier than
the end of the last pause, unless they had arrived before it and were not read.

While a connection is not read, its input first fills the system's buffer, then the client itself
holds the rest back. That arrives one round trip after reading resumes, at the speed of the network.
So a client that may have held input back has caught up when, for longer than a round trip, little
has arrived and nothing is left unread. "Little" also means far less than in an equal time before:
a streaming client has its own rate, and catches up at the rate of the network. Where the two rates
are nearly equal, the end cannot be detected; then the longest time that catching up takes applies.
"""

from __future__ import annotations

import math

#: The shortest pause, in seconds; to this is added the time in which a slow network, of 10 Mbit/s,
#: transfers the next chunk: SECONDS_PER_BYTE seconds per byte.
PAUSE = 0.004
SECONDS_PER_BYTE = 0.8e-6

#: The shortest pause after the connection was not read for longer than this: buffered input then
#: arrives soon.
PAUSE_BEHIND = 0.02

#: At most this number of bytes in two round trips and PAUSE_BEHIND are "little": a client that
#: catches up sends several full network packets in that time.
LITTLE = 4096

#: "Little" as a fraction of the highest rate since reading resumed.
FAR_LESS = 1 / 4

#: The longest time, in seconds, to catch up with one second in which the connection was not read:
#: the network is assumed to have at least 1.2 times the client's rate.
CATCHING_UP = 5.0

#: To this is added FLIGHTS times two round trips and PAUSE_BEHIND: TCP starts slowly.
FLIGHTS = 10

#: The longest interval between two calls of `check`, in seconds.
RARELY = 1.0

#: The size of the smallest PUBLISH, in bytes.
SHORTEST = 5


class Inflow:
    """Tracks the input of one client; times are in seconds of the broker's clock.

    Acknowledgements and pings are ignored: they tell nothing about a queue of the client.
    """

    __slots__ = (
        "_caught_up",
        "_caught_up_by",
        "_held",
        "_held_since",
        "_interval",
        "_is_kept_back",
        "_measured_since",
        "_most",
        "_received",
        "_resumed",
        "_seen",
        "_was_full",
        "began",
        "is_watched",
        "last",
        "unfinished",
    )

    def __init__(self) -> None:
        #: Whether `flowing` was called, so that pauses are tracked, which costs a little.
        self.is_watched = False
        #: Since when input has arrived without a pause, and when the last of it arrived.
        self.began = 0.0
        self.last = 0.0
        #: When the first bytes of the partial packet arrived; 0 when there is none.
        self.unfinished = 0.0
        #: Seconds without reading since the client last had caught up; and since when the
        #: connection is not read, 0 while it is.
        self._held = 0.0
        self._held_since = 0.0
        self._resumed = -math.inf
        self._caught_up = 0.0
        #: Whether the client may have held input back, and when it has caught up at the latest.
        self._is_kept_back = False
        self._caught_up_by = 0.0
        #: The rate measurement: its start, 0 for none; the bytes received until then; whether the
        #: client may have held input back since; and the highest rate, in bytes a second.
        self._measured_since = 0.0
        self._received = 0
        self._was_full = False
        self._most = 0.0
        #: The bytes received until the last `check`, and the least seconds until the next.
        self._seen = 0
        self._interval = PAUSE_BEHIND

    def chunk_received(self, data: bytes, now: float) -> None:
        """A chunk has arrived."""
        # Ignore acknowledgements, pings, and the empty chunk that continues with buffered input.
        if len(data) < SHORTEST or (not self.unfinished and _acknowledges(data)):
            return
        gap = now - max(self.last, self._resumed)
        is_held = self._held_since and now - self._held_since > PAUSE  # not since this chunk
        is_behind = self._resumed > self.last and self._held > PAUSE_BEHIND
        pause = PAUSE_BEHIND if is_behind else PAUSE
        if gap > pause + len(data) * SECONDS_PER_BYTE and not self.unfinished and not is_held:
            self.began = now
        self.last = now

    def reading_paused(self, now: float) -> None:
        """The connection is not read from now on."""
        if not self._held_since:
            self._held_since = now
            if self._caught_up and now > self._caught_up:
                self._has_caught_up()
            self._caught_up = 0.0

    def reading_resumed(self, now: float) -> None:
        """The connection is read again."""
        if self._held_since:
            pause = now - self._held_since
            self._held += pause
            self._held_since = 0.0
            self._resumed = now
            self._caught_up_by = max(self._caught_up_by, now) + CATCHING_UP * pause
            if pause > PAUSE_BEHIND:  # the rate now is neither the client's nor the network's
                self._measured_since = 0.0
                self._interval = PAUSE_BEHIND

    def check(
        self, now: float, *, unread: bool, full: bool, received: int, round_trip: float
    ) -> float:
        """Check whether the client has caught up; returns seconds until the next check, or 0.

        `unread`: the system has unread input; `full`: so much that the client may hold input back.
        `received`: the bytes received in all.
        """
        if self._held_since or not self._held:
            return 0.0
        if not (unread or full or self._is_kept_back):
            self._has_caught_up()
            return 0.0
        span = 2 * round_trip + PAUSE_BEHIND
        if full:
            self._is_kept_back = self._was_full = True
            by = now + CATCHING_UP * self._held + FLIGHTS * span
            self._caught_up_by = max(self._caught_up_by, by)
        if not self._measured_since:
            self._measured_since, self._received = now, received
        left = self._measured_since + span - now
        is_little = left <= 0 and self._measure(now, received)
        if not (unread or full) and (is_little or now >= self._caught_up_by):
            self._has_caught_up()
            return 0.0
        seconds = left if left > 0 and not (unread or full) else PAUSE_BEHIND
        if self.is_watched and received != self._seen:
            self._interval = PAUSE_BEHIND
            self._seen = received
            return seconds
        # `flowing` is not used, or nothing arrives: a part of a packet is there, and not the rest.
        seconds = max(seconds, self._interval)
        self._interval = min(2 * self._interval, RARELY)
        return seconds

    def _measure(self, now: float, received: int) -> bool:
        """Whether little has arrived since the last call although the client could send freely."""
        came = received - self._received
        pace = came / (now - self._measured_since)
        is_little = not self._was_full and (came <= LITTLE or pace <= FAR_LESS * self._most)
        self._most = max(self._most, pace)
        self._measured_since, self._received, self._was_full = now, received, False
        return is_little

    def _has_caught_up(self) -> None:
        """All input that the client had held back has been read."""
        self._held = self._caught_up = self._caught_up_by = self._measured_since = self._most = 0.0
        self._is_kept_back = self._was_full = False
        self._interval = PAUSE_BEHIND

    @property
    def is_behind(self) -> bool:
        """Whether the connection was not read for a relevant time."""
        return self._held > PAUSE

    def held(self, now: float, *, has_unread: bool) -> float:
        """The longest time, in seconds, that input arriving now may have waited unread."""
        if self._held_since:
            return self._held + now - self._held_since
        if self._caught_up and now > self._caught_up:
            self._has_caught_up()
        if self._held and not (has_unread or self._is_kept_back or self._caught_up):
            self._caught_up = now  # with the input received until now
        return self._held

    def flowing(self, now: float) -> float:
        """Seconds for which input has arrived without a pause; 0 during a pause.

        It is tracked from the first call on.
        """
        if not self.is_watched:
            self.is_watched = True
            self.began = self.last = now
        if now - self.last > PAUSE and not self.unfinished:
            return 0.0
        return now - self.began


def _acknowledges(data: bytes) -> bool:
    """Whether `data` consists of acknowledgements without reason codes."""
    return (
        data[0] & 0xC0 == 0x40  # PUBACK, PUBREC, PUBREL, PUBCOMP
        and not len(data) & 3
        and data[1] == 2
        and data[-4] & 0xC0 == 0x40
        and data[-3] == 2
    )
