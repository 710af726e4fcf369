"""The login throttle against brute force: after wrong passwords, further logins are delayed.

Nobody is locked out. The delay of an address does not affect other addresses, and the delay of a
user is at most `MAX_USER_DELAY`, however many clients guess its password, and from wherever. A
password that was right for the user before is not a guess, and is not throttled.
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

#: The delay in seconds after the first failure beyond the allowed ones; each further failure
#: doubles it, up to the second.
FIRST_DELAY: Final = 0.125
LONGEST_DELAY: Final = 4.0

#: The most seconds that a login waits because of others' failures for the same user.
MAX_USER_DELAY: Final = 2.0

#: Addresses, and users, whose failures are stored; the least recent failures are evicted.
MAX_ENTRIES: Final = 4096


@dataclass(slots=True)
class _Failures:
    """A leaky bucket of failures: it drains at the rate at which failures are allowed."""

    level: float = 0.0
    at: float = 0.0
    #: When the next guess may be checked, by its queue.
    free_at: dict[str, float] = field(default_factory=dict)


class LoginThrottle:
    """Computes how long a login has to wait before its password is checked.

    Guesses from one address are checked one after the other, and the more were wrong, the larger
    the gaps; `allowed` failures a minute cost nothing. Logins of one user are delayed too, but in
    parallel: whoever has the right password gets in, whatever others do meanwhile.
    """

    def __init__(self, allowed: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._allowed = allowed
        self._clock = clock
        self._key = secrets.token_bytes(16)
        self._networks: OrderedDict[bytes, _Failures] = OrderedDict()
        self._users: OrderedDict[bytes, _Failures] = OrderedDict()

    def reserve(self, address: str, queue: str = "", max_wait: float = math.inf) -> float | None:
        """Reserve the next check for this address; returns the seconds until it is due.

        None, and nothing is reserved, when that is more than `max_wait`. Different queues of an
        address do not delay each other.
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
        """The current delay between two guesses from this address, in seconds."""
        failures = self._networks.get(network_prefix(address))
        return self._delay(failures, self._clock()) if failures else 0.0

    def user_delay(self, username: str) -> float:
        """Seconds that a guess waits because of wrong ones for the same user."""
        failures = self._users.get(self._key_of(username))
        return min(MAX_USER_DELAY, self._delay(failures, self._clock())) if failures else 0.0

    def record_failure(self, address: str, username: str) -> None:
        """Count a wrong guess."""
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
        return min(LONGEST_DELAY, FIRST_DELAY * math.pow(2, min(excess, 16)))

    def _key_of(self, username: str) -> bytes:
        # A keyed hash: strangers' names can be long, or crafted to collide.
        return hashlib.blake2b(username.encode(), digest_size=16, key=self._key).digest()


class RecentKeys:
    """A set of the `size` keys that were added last."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._keys: OrderedDict[bytes, None] = OrderedDict()

    def add(self, key: bytes) -> None:
        """Add a key, or renew it."""
        self._keys[key] = None
        self._keys.move_to_end(key)
        if len(self._keys) > self._size:
            self._keys.popitem(last=False)

    def __contains__(self, key: bytes) -> bool:
        return key in self._keys

    def clear(self) -> None:
        """Remove all keys."""
        self._keys.clear()
