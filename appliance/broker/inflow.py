"""How what a client sends comes in: in one go, or with pauses; and what it waits for in here.

What a client has queued comes without a pause. Who says something now and then has pauses between,
in which all that it had to say is there, whole. So the end of such a pause is when what has come
since was said at the earliest; unless it had come before and was not read.

While a client is not read, what it says fills what the system keeps for it, and then it keeps the
rest back itself. That comes a round trip after it is read again, as fast as the network takes it.
So who had to keep something back has caught up when little has come for longer than that, and
nothing that came is left unread.
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

#: The smallest PUBLISH has so many bytes.
SHORTEST = 5


class Inflow:
    """What comes of PUBLISH and the like from one client; times in seconds of the broker's clock.

    Acknowledgements and pings are not meant: they say nothing about what it has queued.
    """

    __slots__ = (
        "_caught_up",
        "_held",
        "_held_since",
        "_is_kept_back",
        "_quiet_since",
        "_received",
        "_resumed",
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
        #: Whether it may have kept back what it had to say; since when little has come, 0 while
        #: that is not known, and the bytes that had come until then.
        self._is_kept_back = False
        self._quiet_since = 0.0
        self._received = 0

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
            self._held += now - self._held_since
            self._held_since = 0.0
            self._resumed = now

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
        self._is_kept_back |= full
        if unread or full:
            self._quiet_since = 0.0
            return PAUSE_BEHIND
        if not self._quiet_since or received - self._received > LITTLE:
            self._quiet_since, self._received = now, received
        left = self._quiet_since + 2 * round_trip + PAUSE_BEHIND - now
        if left > 0:
            return left
        self._has_caught_up()
        return 0.0

    def _has_caught_up(self) -> None:
        """Nothing that it had to say before is left to be read."""
        self._held = self._caught_up = self._quiet_since = 0.0
        self._is_kept_back = False

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
