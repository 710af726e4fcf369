"""Which server is dialled next, and when: pure, time is an argument in seconds of any clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

#: The bounds of the longest wait in seconds: after the first failure, and after many. All links of
#: a fleet are to be connected within a minute of their broker's return: some of it is for that.
SHORTEST, LONGEST = 1.0, 45.0

#: Seconds that a connection lasts to count as a success, after which waits are short again.
LASTED = 30.0

#: Seconds after which the first server is dialled again, if another one was taken.
RETURN_AFTER = 300.0

#: The longest time to the next return, when the ones before have failed.
LONGEST_RETURN = 3600.0

#: So many times in so many seconds another client took the client id over; then a wait of so many.
TAKEN_OVER, TAKEN_OVER_WITHIN = 3, 60.0
CONTESTED = 60.0


class Backoff:
    """Waits with full jitter between dials: a random part of a bound, which doubles each time.

    Thousands of links that are cut off together come back spread over the bound. Servers are tried
    in order; the bound grows when all of them have failed. `random` returns 0 to 1.
    """

    def __init__(self, servers: int, random: Callable[[], float]) -> None:
        self._servers = servers
        self._random = random
        #: The position of the server to dial next, or that is connected.
        self.server = 0
        self._failures = 0  # dials that failed, or connections that did not last, in a row
        self._left_first: float | None = None  # when the first server was given up
        self._return_after = RETURN_AFTER
        self._has_returned = False  # to the first server, on which no connection has lasted yet
        self._connected_at: float | None = None
        #: When another client took the client id over, and on which server at last.
        self._taken_over: deque[float] = deque(maxlen=TAKEN_OVER)
        self._taken_over_on = -1

    def connected(self, now: float) -> None:
        """The server has accepted the connection (CONNACK)."""
        self._connected_at = now
        if self.server == 0:
            self._left_first = None

    def failed(self, now: float) -> float:
        """The dial failed, or the connection ended; returns the seconds until the next dial."""
        connected_at, self._connected_at = self._connected_at, None
        if connected_at is None and self.server == self._taken_over_on:
            self._taken_over.clear()  # the server was away, which explains how connections ended
        if connected_at is not None and now - connected_at >= LASTED:
            self._failures = 0
            if self.server == 0:
                self._has_returned = False
                self._return_after = RETURN_AFTER
            wait = self._jitter()
        else:
            if self._has_returned and self.server == 0:
                self._has_returned = False
                self._return_after = min(2 * self._return_after, LONGEST_RETURN)
            wait = self._jitter()
            self._failures += 1
            self._next_server(now)
        self._return(now)
        return wait

    def _jitter(self) -> float:
        rounds = min(self._failures // self._servers, 16)
        return float(self._random() * min(SHORTEST * 2**rounds, LONGEST))

    def _next_server(self, now: float) -> None:
        if self.server == 0 and self._left_first is None:
            self._left_first = now
        self.server = (self.server + 1) % self._servers
        if self.server == 0:
            self._left_first = None

    def _return(self, now: float) -> None:
        if self.is_return_due(now):
            self.server = 0
            self._left_first = None

    def is_return_due(self, now: float) -> bool:
        """Whether the first server is to be tried again, as another one is used for long enough.

        Who is connected does it beside the connection, and tells it with `returned` or `stayed`.
        """
        return self._left_first is not None and now - self._left_first >= self._return_after

    @property
    def return_at(self) -> float | None:
        """When `is_return_due` will hold; None while the first server is used."""
        return None if self._left_first is None else self._left_first + self._return_after

    def returned(self, now: float) -> None:
        """The first server can be connected to again: it is used from now on.

        If it then accepts no connection that lasts, as a proxy whose broker is down, the next
        return comes after twice the time: each one interrupts a connection that works.
        """
        self.server = 0
        self._has_returned = True
        self._left_first = None
        self._connected_at = None

    def stayed(self, now: float) -> None:
        """The first server cannot be connected to yet: the next try is as long after."""
        self._left_first = now

    def taken_over(self, now: float) -> float:
        """Another client took the client id over (0x8E); returns the seconds until the next dial.

        It is CONTESTED when that happens again and again: two with the same client id would throw
        each other out for ever. Instead of `failed`.
        """
        self._connected_at = None
        self._took_over(now)
        return CONTESTED if self.is_contested(now) else self._random() * SHORTEST

    def closed(self, now: float) -> float:
        """The server has closed the connection for no reason that is known; instead of `failed`.

        Some servers tell nobody that another client took the client id over. If connections end in
        this way soon after their beginning, again and again, it is treated as that.
        """
        lasted = self._connected_at is not None and now - self._connected_at >= LASTED
        if not lasted:
            self._took_over(now)
        is_contested = not lasted and self.is_contested(now)
        wait = self.failed(now)
        return CONTESTED if is_contested else wait

    def _took_over(self, now: float) -> None:
        self._taken_over.append(now)
        self._taken_over_on = self.server

    def is_contested(self, now: float) -> bool:
        """Whether another client has taken the client id over three times within a minute."""
        taken = self._taken_over
        return len(taken) == TAKEN_OVER and now - taken[0] <= TAKEN_OVER_WITHIN

    def clock_was_set(self) -> None:
        """The wall clock was set, so that certificates may be valid now: dial at once."""
        self._failures = 0
