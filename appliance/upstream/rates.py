"""Rates: how many messages and bytes a second a link may send."""

from __future__ import annotations

from typing import Final

#: Seconds of its rate that a bucket saves while nothing is sent, so that a timer that is late costs
#: nothing. In any second the rate is exceeded by this part of it at most.
SAVED: Final = 0.05


class TokenBucket:
    """Lets `rate` units a second pass; `now` is in seconds of any steady clock.

    What is larger than the bucket passes when it is not empty, and is waited for afterwards.
    """

    __slots__ = ("_at", "_most", "_tokens", "rate")

    def __init__(self, rate: float, now: float) -> None:
        self.rate = rate
        self._most = max(1.0, rate * SAVED)
        self._tokens = self._most
        self._at = now

    def due(self, now: float) -> float:
        """When the next unit may pass: `now`, or later."""
        if now > self._at:
            self._tokens = min(self._most, self._tokens + (now - self._at) * self.rate)
            self._at = now
        missing = min(1.0, self._most) - self._tokens
        return self._at + missing / self.rate if missing > 1e-6 else now

    def take(self, amount: float) -> None:
        """Count units that pass now."""
        self._tokens -= amount
