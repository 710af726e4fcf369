"""How what a client sends comes in: in one go, or with pauses; and what it waits for in here.

What a client has queued comes without a pause. Who says something now and then has pauses between,
in which all that it had to say is there, whole. So the end of such a pause is when what has come
since was said at the earliest; unless it had come before and was not read.

While a client is not read, what it says fills what the system keeps for it, and then it keeps the
rest back itself. That comes a round trip after it is read again, as fast as the network takes it.
So who had to keep something back has caught up when little has come for longer than that, and
nothing that came is left unread. Little is also what is far less than came in such a time before:
who streams has a pace of its own, and catches up at that of the network. Where the two are nearly
the same nothing shows the end; then it has had the time that catching up takes.
"""

from __future__ import annotations

import math

#: Seconds without a byte that are a pause, beside the time that a slow network takes for those that
#: come next: seconds a byte, of 10 Mbit/s.
PAUSE = 0.004
A_BYTE = 0.8e-6

#: The same behind a time, longer than this, in which it was not read: what came then has its turn
#: soon.
PAUSE_BEHIND = 0.02

#: Bytes that are little, in two round trips and that pause: who has something to catch up with
#: sends several full packets of the network in one.
LITTLE = 4096

#: The same as a part of the most that came in such a time since it was read again.
FAR_LESS = 1 / 4

#: Seconds in which a client makes up for one in which it was not read, at the most: its network
#: takes at least 1.2 times what it has to say.
CATCHING_UP = 5.0

#: Beside this, so many times the two round trips and that pause: TCP begins slowly.
FLIGHTS = 10

#: Seconds from one look to the next, at the most.
RARELY = 1.0

#: The smallest PUBLISH has so many bytes.
SHORTEST = 5


class Inflow:
    """What comes of PUBLISH and the like from one client; times in seconds of the broker's clock.

    Acknowledgements and pings are not meant: they say nothing about what it has queued.
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
        #: Whether somebody has asked for how long it has come without a pause: it costs a little.
        self.is_watched = False
        #: Since when it has come without a pause, and when the last of it came.
        self.began = 0.0
        self.last = 0.0
        #: When the packet that is not whole began to come; 0 when there is none.
        self.unfinished = 0.0
        #: Seconds that it was not read since it had last been read to the end; and since when it is
        #: not, 0 while it is.
        self._held = 0.0
        self._held_since = 0.0
        self._resumed = -math.inf
        self._caught_up = 0.0
        #: Whether it may have kept something back, and when it has caught up at the latest.
        self._is_kept_back = False
        self._caught_up_by = 0.0
        #: Since when it is measured how much comes, 0 for not; the bytes that had come until then;
        #: whether it may have kept something back since; and the most that came, in bytes a second.
        self._measured_since = 0.0
        self._received = 0
        self._was_full = False
        self._most = 0.0
        #: Of the last look, the bytes that had come; and the seconds to the next one, at least.
        self._seen = 0
        self._interval = PAUSE_BEHIND

    def came(self, data: bytes, now: float) -> None:
        """A chunk has come."""
        # Acknowledgements and pings; and nothing, when what came before is gone on with.
        if len(data) < SHORTEST or (not self.unfinished and _acknowledges(data)):
            return
        gap = now - max(self.last, self._resumed)
        is_held = self._held_since and now - self._held_since > PAUSE  # and not since it came
        is_behind = self._resumed > self.last and self._held > PAUSE_BEHIND
        pause = PAUSE_BEHIND if is_behind else PAUSE
        if gap > pause + len(data) * A_BYTE and not self.unfinished and not is_held:
            self.began = now
        self.last = now

    def not_read(self, now: float) -> None:
        """It is not read from now on."""
        if not self._held_since:
            self._held_since = now
            if self._caught_up and now > self._caught_up:
                self._has_caught_up()
            self._caught_up = 0.0

    def read(self, now: float) -> None:
        """It is read again."""
        if self._held_since:
            pause = now - self._held_since
            self._held += pause
            self._held_since = 0.0
            self._resumed = now
            self._caught_up_by = max(self._caught_up_by, now) + CATCHING_UP * pause
            if pause > PAUSE_BEHIND:  # what comes now is not the pace of either
                self._measured_since = 0.0
                self._interval = PAUSE_BEHIND

    def look(
        self, now: float, *, unread: bool, full: bool, received: int, round_trip: float
    ) -> float:
        """See whether it has caught up; returns after how many seconds to look again, 0 for not.

        `unread`: something that has come is not read; `full`: so much that it may keep the rest
        back. `received`: the bytes that have come, in all.
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
        # Nobody has asked; or nothing comes: it has said a part of something, and not the rest.
        seconds = max(seconds, self._interval)
        self._interval = min(2 * self._interval, RARELY)
        return seconds

    def _measure(self, now: float, received: int) -> bool:
        """Whether little has come since the last time, and it could send all that it had to say."""
        came = received - self._received
        pace = came / (now - self._measured_since)
        is_little = not self._was_full and (came <= LITTLE or pace <= FAR_LESS * self._most)
        self._most = max(self._most, pace)
        self._measured_since, self._received, self._was_full = now, received, False
        return is_little

    def _has_caught_up(self) -> None:
        """Nothing that it had to say before is left to be read."""
        self._held = self._caught_up = self._caught_up_by = self._measured_since = self._most = 0.0
        self._is_kept_back = self._was_full = False
        self._interval = PAUSE_BEHIND

    @property
    def is_behind(self) -> bool:
        """Whether it was not read for long enough to matter."""
        return self._held > PAUSE

    def held(self, now: float, *, has_unread: bool) -> float:
        """Seconds that what comes now may have waited in here, at the most."""
        if self._held_since:
            return self._held + now - self._held_since
        if self._caught_up and now > self._caught_up:
            self._has_caught_up()
        if self._held and not (has_unread or self._is_kept_back or self._caught_up):
            self._caught_up = now  # with what has come until now
        return self._held

    def flowing(self, now: float) -> float:
        """For how many seconds it has come without a pause; 0 when there is one.

        It is known since this was asked for the first time.
        """
        if not self.is_watched:
            self.is_watched = True
            self.began = self.last = now
        if now - self.last > PAUSE and not self.unfinished:
            return 0.0
        return now - self.began


def _acknowledges(data: bytes) -> bool:
    """Whether it is nothing but acknowledgements without reason codes."""
    return (
        data[0] & 0xC0 == 0x40  # PUBACK, PUBREC, PUBREL, PUBCOMP
        and not len(data) & 3
        and data[1] == 2
        and data[-4] & 0xC0 == 0x40
        and data[-3] == 2
    )
