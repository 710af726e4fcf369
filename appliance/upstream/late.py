"""How old a message from the fleet may be, and whether it is too old to be taken.

A PUBLISH does not say when it was published. But a server answers in order: what comes after the
answer to a PINGREQ left the server after that PINGREQ was sent. So it is at most as old as the
PINGREQ, if it left the server at once when it was published, and that is not so for

- a message of QoS 1 that waits there because too many are unacknowledged (`LEAST_WINDOW`): an
  answered PINGREQ tells its age only if so many cannot have been, see `Freshness`;
- a retained message, a message that is sent again (DUP), and what a session there has kept while
  the link was down: these are of unknown age;
- what comes after this computer has slept, up to the answer to a PINGREQ that it sends then.

A PINGREQ every `late`/2 is enough for a limit of `late`. What a client of the fleet itself holds
back before the fleet's broker has it cannot be seen here.
"""

from __future__ import annotations

import math
from collections import deque
from enum import Enum
from typing import Final, NamedTuple

#: The fewest messages of QoS 1 that a broker has in flight before it lets others wait: RabbitMQ and
#: HiveMQ have 10 by default, mosquitto 20, EMQX 32, AWS IoT 100.
LEAST_WINDOW: Final = 10


class Verdict(Enum):
    """What is done with a message that came; the text is for the status."""

    TAKE = "taken"
    EXPIRED = "expired"
    REPEATED = "sent again"
    LATE = "late"
    RETAINED = "retained"
    REFUSED = "refused"  # here: by the access rules, by a route to ROS, or for want of room


def judge(
    *,
    now: float,
    arrived_at: float,
    left_after: float,
    late: float | None,
    expiry: float | None,
    dup: bool,
    retain: bool,
) -> Verdict:
    """Decide about a message that is about to be published here; times are in seconds.

    It left the fleet's broker after `left_after`, see `Freshness.left_after`, and had `expiry` to
    live when it arrived (None: for ever). `late` is the rule's limit, None for none. A retained
    message is a state and no command: it is taken, and known to be of unknown age. Where a route to
    ROS takes its topic, `InSession` drops it.
    """
    if expiry is not None and now >= arrived_at + expiry:
        return Verdict.EXPIRED
    if late is None or retain:
        return Verdict.TAKE
    if dup:
        return Verdict.REPEATED
    # Not `<=`, so that a time that is not a number is late.
    return Verdict.TAKE if now - left_after <= late else Verdict.LATE


def greatest_age(*, now: float, left_after: float, dup: bool, retain: bool) -> float:
    """How old a message is at most, in seconds; infinity when that is unknown."""
    return math.inf if dup or retain else max(0.0, now - left_after)


class _Ping(NamedTuple):
    """An unanswered PINGREQ: how much had come and was unacknowledged when it went out."""

    received: int
    unacknowledged: int


class Freshness:
    """Since when, at the earliest, what comes now can have left the fleet's broker.

    It belongs to one connection, and is told what is sent and received on it in that order; times
    are in seconds of one clock.
    """

    def __init__(self) -> None:
        self._left_after = self._sent_after = -math.inf
        self._pings: deque[_Ping] = deque()
        #: Messages of QoS 1 that were received, and how many of these are not acknowledged.
        self._received = 0
        self._unacknowledged = 0
        #: What was sent before this time tells nothing: the computer has slept since.
        self._awake_since = -math.inf

    def session_began(self, asked_at: float) -> None:
        """The broker has made a new session, for a CONNECT of that time: nothing waits in it."""
        if asked_at >= self._awake_since:
            self._left_after = self._sent_after = asked_at

    def woke(self, now: float) -> None:
        """The computer has slept, and the clock stood still: nothing is known any more."""
        self._awake_since = now
        self._left_after = self._sent_after = -math.inf

    def ping_sent(self) -> None:
        """A PINGREQ goes out, behind all acknowledgements so far."""
        self._pings.append(_Ping(self._received, self._unacknowledged))

    def ping_answered(self, sent_at: float) -> None:
        """The PINGRESP to the oldest unanswered PINGREQ has come, which was sent at that time."""
        ping = self._pings.popleft()
        if sent_at < self._awake_since:
            return
        self._left_after = sent_at
        # So many can have been in flight at most when the broker answered it. If that is less than
        # its window, no message waited for the acknowledgement of another one then.
        if ping.unacknowledged + self._received - ping.received < LEAST_WINDOW:
            self._sent_after = sent_at

    def message_received(self) -> None:
        """A PUBLISH of QoS 1 or 2 has come."""
        self._received += 1
        self._unacknowledged += 1

    def message_acknowledged(self) -> None:
        """Its acknowledgement goes out."""
        self._unacknowledged -= 1

    def left_after(self, qos: int) -> float:
        """A message of this QoS that comes now was published at the fleet after this time; minus
        infinity when that is unknown."""
        return self._sent_after if qos else self._left_after
