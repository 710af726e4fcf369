"""Brute force: who has tried wrong passwords waits longer and longer before the next is looked at.

Nobody is locked out by it. What slows an address slows no other one, and what slows a user slows it
by `MAX_USER_DELAY` at most, however many guess its password, and from wherever. The password that
was right for a user before is not a guess: it never comes here.
"""

from __future__ import annotations

import hashlib
import math
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from appliance.host.addresses import network_prefix

#: The first delay when failures are more than allowed; each one more doubles it, up to this.
FIRST_DELAY: Final = 0.125
LONGEST_DELAY: Final = 4.0

#: Seconds that a login waits at most because of failures of others for the same user.
MAX_USER_DELAY: Final = 2.0

#: Addresses, and users, that are remembered. Those that failed last are.
MAX_ENTRIES: Final = 4096


@dataclass(slots=True)
class _Failures:
    """How many failures count now: they are forgotten at the rate at which they are allowed."""

    level: float = 0.0
    at: float = 0.0
    #: When the next guess may be looked at, by the line in which it waits.
    free_at: dict[str, float] = field(default_factory=dict)


class LoginThrottle:
    """How long a login has to wait before its password is looked at.

    Of one address there is one guess after the other, the slower the more were wrong: `allowed` of
    them in a minute cost nothing. Logins of one user are held up too, but beside each other: one
    who has the right password comes through, whatever others do meanwhile.
    """

    def __init__(self, allowed: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._allowed = allowed
        self._clock = clock
        self._key = secrets.token_bytes(16)
        self._networks: OrderedDict[bytes, _Failures] = OrderedDict()
        self._users: OrderedDict[bytes, _Failures] = OrderedDict()

    def reserve(self, address: str, queue: str = "", max_wait: float = math.inf) -> float | None:
        """Seconds until the next guess from this address is due, and it is taken; or None.

        It is None, and nothing is taken, when that is longer than `max_wait`. Guesses in another
        `queue` are not in each other's way.
        """
        failures = self._networks.get(network_prefix(address))
        if failures is None:
            return 0.0
        now = self._clock()
        due = max(now, failures.free_at.get(queue, now))
        if due - now > max_wait:
            return None
        delay = self._delay(failures, now)
        if delay:
            failures.free_at[queue] = due + delay
        return due - now

    def address_delay(self, address: str) -> float:
        """Seconds between two guesses from this address, as things are."""
        failures = self._networks.get(network_prefix(address))
        return self._delay(failures, self._clock()) if failures else 0.0

    def user_delay(self, username: str) -> float:
        """Seconds that a guess waits because others were wrong about the same user."""
        failures = self._users.get(self._key_of(username))
        return min(MAX_USER_DELAY, self._delay(failures, self._clock())) if failures else 0.0

    def record_failure(self, address: str, username: str) -> None:
        """A guess was wrong."""
        now = self._clock()
        for known, key in (
            (self._networks, network_prefix(address)),
            (self._users, self._key_of(username)),
        ):
            failures = known.get(key)
            if failures is None:
                failures = known[key] = _Failures(at=now)
                if len(known) > MAX_ENTRIES:
                    known.popitem(last=False)
            known.move_to_end(key)
            failures.level = self._level(failures, now) + 1
            failures.at = now

    def _level(self, failures: _Failures, now: float) -> float:
        return max(0.0, failures.level - (now - failures.at) * self._allowed / 60)

    def _delay(self, failures: _Failures, now: float) -> float:
        excess = self._level(failures, now) - self._allowed
        if excess < 0:
            return 0.0
        return min(LONGEST_DELAY, FIRST_DELAY * math.exp2(min(excess, 16)))

    def _key_of(self, username: str) -> bytes:
        # Strangers' names are long, and are made to collide.
        return hashlib.blake2b(username.encode(), digest_size=16, key=self._key).digest()


class RecentKeys:
    """A set of the keys that were added last, `size` of them."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._keys: OrderedDict[bytes, None] = OrderedDict()

    def add(self, key: bytes) -> None:
        """Add a key, or count it as added now."""
        self._keys[key] = None
        self._keys.move_to_end(key)
        if len(self._keys) > self._size:
            self._keys.popitem(last=False)

    def __contains__(self, key: bytes) -> bool:
        return key in self._keys

    def clear(self) -> None:
        """Forget them all."""
        self._keys.clear()
