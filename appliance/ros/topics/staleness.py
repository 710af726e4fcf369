"""Decides whether a command is fresh, stale, or part of a queue that a client replays.

A stale command moves a robot that nobody steers any more. MQTT messages do not carry the time at
which they were made, and client libraries queue what is published without a connection and send it
later as if it were new. The age of a command is therefore inferred from the following evidence, in
this order:

| evidence                                               | conclusion and decision               |
|--------------------------------------------------------|---------------------------------------|
| user property `sent-at`, of clocks that agree          | its age: carried out at once, or      |
|                                                        | refused as stale                      |
| Message Expiry that is over, DUP, a late PUBREL,       | it is stale: refused, and the         |
| a will                                                 | commands behind it are a queue        |
| less than `oldest` after a command that was fresh      | it is fresh: carried out at once      |
| the first since CONNECT, or since a longer silence,    | unknown: held for as long as the next |
| and none behind it                                     | one of a queue would take, or until a |
|                                                        | DISCONNECT, then carried out          |
| the same, and others directly behind it                | a queue: none is carried out, neither |
|                                                        | the first nor the newest              |
| commands go on at the pace of somebody who steers      | a queue would come faster: carried    |
|                                                        | out from the third on                 |

What is left of a Message Expiry Interval proves nothing: it counts down in servers only, not in a
client's queue. A stale message that stops the robot is carried out all the same, see `Commands`;
it still proves that the commands behind it are a queue.

A client has one queue for all that it sends. So evidence holds for all of its topics, and there is
a gap between two commands only if none of its messages lie in between. If the appliance has not
read from a client for longer than `oldest`, or the computer has slept for as long, the evidence
begins anew, since the time at which the unread messages came is unknown. A command that comes in
parts is as old as its first byte.

A queue ends with a silence or with the pace of steering, never after a time: without `sent-at`, a
stream that is faster than `BURST` allows (125 Hz) is never carried out.

The pace of steering is two gaps in a row that are longer than `BURST`. A queue of QoS 1 may come
one message at a time, each after the acknowledgement of the one before; then the queue of a busy or
distant client has such a pace as well. To tell them apart, everything that is sent to the client is
withheld for a moment, acknowledgements included: a client that goes on does not wait for
acknowledgements, and has no such queue.

Without `sent-at` there is no way to know: the age of a single command; the age of a queue that a
slow network or a starved client spreads over gaps as long as those of steering; a delay that grows
little by little.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass, field
from datetime import datetime, timezone
from enum import Enum
from typing import Protocol

from appliance.broker.link import LOCAL_PEER, PeerStatus
from appliance.broker.session import Session
from appliance.host.clock import SleepWatch
from appliance.mqtt.codec import Properties, Property, quote

#: The user property with the time at which a command was made.
SENT_AT = "sent-at"

#: The accepted forms of it, for error texts.
_FORMS = "seconds since 1970 (1780000000.25) or RFC 3339 (2026-05-28T20:26:40.25Z)"

#: Larger numbers are not meant as seconds: the least of them is the year 5138.
_UNITS = ((1e17, "nanoseconds"), (1e14, "microseconds"), (1e11, "milliseconds"))

#: Seconds that a client's clock may be ahead of ours; a command may be older by as much than it
#: states.
AHEAD = 0.25

#: Seconds for which a first command is held, in addition to two round trips: Nagle's algorithm and
#: delayed acknowledgements delay the second message of a queue by 40 ms.
WAIT = 0.1

#: Messages with shorter gaps than this, in seconds, are a burst.
BURST = 0.008

#: Longer gaps in a row after which a client counts as one that steers.
STEADY = 2

#: Seconds for which acknowledgements are withheld, to see whether a client goes on without them:
#: more than lie between two of its commands. And the least time between two such attempts.
WITHHOLD = 0.15
TRY_AGAIN = 1.0

#: Why a command is not carried out: it is part of a queue; or it is one of the first two of what
#: may be a queue or a stream, which is usual and no reason for a warning.
QUEUED = "others came with it at once, as of a queue"
STREAM_BEGINS = "a stream is carried out from its third command on"

#: Clients that are remembered because they left while they drove; the oldest is evicted.
EXPECTED = 1000


class CommandVerdict(Enum):
    """What to do with a command."""

    CARRY_OUT = "carry out"
    #: Hold it until `StalenessDetector.waiting_time` is over, unless another comes.
    WAIT = "wait"
    REFUSE = "refuse"


@dataclass(slots=True)
class _Pace:
    """The evidence on one client since its connection or its last silence began."""

    last: float
    #: Whether the last command was its first one, or the second one of what may be a stream.
    is_first: bool = True
    begins_stream: bool = False
    #: The gap before the last command, and the longest gap since the beginning: for a route with a
    #: shorter `oldest`, that gap was a silence.
    gap: float = math.inf
    longest: float = 0.0
    #: Gaps in a row that are longer than `BURST`.
    steady: int = 0
    is_waiting: bool = False
    is_queue: bool = False
    is_known: bool = False
    #: Whether the last command may have been unread in the appliance for too long.
    was_delayed: bool = False
    #: The number and the verdict of the last command.
    number: int = -1
    verdict: CommandVerdict = CommandVerdict.CARRY_OUT
    #: The routes that hold a first command.
    holders: list[PendingCommands] = field(default_factory=list)
    withheld_until: float = -math.inf


class PendingCommands(Protocol):
    """A route that holds first commands."""

    def drop_pending(self, origin: Session, why: str) -> None:
        """Drop the command that is held for the session: it is part of a queue."""


class StalenessDetector:
    """Judges the commands of all clients to all topics as they come; times in seconds.

    A client has one queue for all topics: evidence from one route holds for the others.
    """

    def __init__(self) -> None:
        #: The number of the last message for ROS, of any client and for any route.
        self.number = 0
        self._paces: dict[Session, _Pace] = {}
        #: The same for commands of QoS 2, as they come and before they are released.
        self._unreleased: dict[Session, _Pace] = {}
        self._expected_replays: OrderedDict[str, None] = OrderedDict()
        #: A client that is awake sends, or queues, while the computer sleeps.
        self._sleep = SleepWatch()

    @property
    def slept(self) -> float:
        """Seconds in which the computer has slept since the start; no clock here counts them."""
        return self._sleep.seconds()

    def next_number(self) -> int:
        """Number a message for ROS that has come; the number is the same for all its routes."""
        self.number += 1
        return self.number

    def judge(
        self, origin: Session, qos: int, oldest: float, now: float, number: int = -1
    ) -> CommandVerdict:
        """Decide what to do with a command of unknown age that has come now.

        `number` identifies the message, which may have several routes; -1 when it is unknown.
        """
        now += self.slept
        pace = self._paces.get(origin)
        is_same = pace is not None and pace.number == number >= 0
        if pace is not None and pace.longest > oldest:
            # The evidence is from a route with a longer `oldest`: for this one it begins anew.
            gap = pace.gap if is_same else now - pace.last
            verdict = self._begin(origin, oldest, now)
            began = self._paces[origin]
            began.was_delayed = _is_delayed(origin, oldest)
            if began.was_delayed or gap < self.waiting_time(origin, oldest):
                began.is_queue, began.is_waiting = True, False
                verdict = CommandVerdict.REFUSE
        elif pace is not None and is_same and self._is_for_all(pace, origin, oldest):
            return pace.verdict
        else:
            verdict = self._judge(pace, origin, qos, oldest, now)
        pace = self._paces[origin]
        pace.number, pace.verdict = number, verdict
        if verdict is CommandVerdict.REFUSE:
            self._drop(pace, origin, self.refusal_reason(origin))
        return verdict

    def _is_for_all(self, pace: _Pace, origin: Session, oldest: float) -> bool:
        """Whether the verdict holds for a route with this `oldest`, too."""
        return pace.verdict is CommandVerdict.REFUSE or not _is_delayed(origin, oldest)

    def refusal_reason(self, origin: Session) -> str:
        """Why the last command that was judged was refused."""
        pace = self._paces.get(origin)
        return STREAM_BEGINS if pace is not None and pace.begins_stream else QUEUED

    def _judge(
        self, pace: _Pace | None, origin: Session, qos: int, oldest: float, now: float
    ) -> CommandVerdict:
        was_delayed = pace is not None and pace.was_delayed
        is_delayed = _is_delayed(origin, oldest)
        if pace is None or now - pace.last > oldest or (is_delayed and not was_delayed):
            verdict = self._begin(origin, oldest, now)
            pace = self._paces[origin]
            if is_delayed:  # whatever has come since, this one may be older
                pace.is_queue, pace.is_waiting, verdict = True, False, CommandVerdict.REFUSE
            pace.was_delayed = is_delayed
            return verdict
        gap = pace.gap = now - pace.last
        pace.longest = max(pace.longest, gap)
        pace.last = now
        pace.begins_stream = False
        if is_delayed:
            pace.is_queue, pace.is_waiting, pace.steady = True, False, 0
            return CommandVerdict.REFUSE
        pace.was_delayed = False
        if pace.is_known:
            return CommandVerdict.CARRY_OUT
        if qos < 2:
            self._time(pace, origin, qos, gap, now)
        else:
            unreleased = self._unreleased.get(origin)
            pace.steady = 0 if unreleased is None else unreleased.steady
        pace.begins_stream = pace.is_first and pace.steady > 0 and gap < WITHHOLD
        pace.is_first = False
        if pace.steady >= STEADY:
            pace.is_known = True
            pace.is_waiting = pace.is_queue = False
            return CommandVerdict.CARRY_OUT
        if pace.is_waiting or pace.is_queue or gap < self.waiting_time(origin, oldest):
            pace.is_queue, pace.is_waiting = True, False
            return CommandVerdict.REFUSE
        pace.is_waiting = True
        return CommandVerdict.WAIT

    def _time(self, pace: _Pace, origin: Session, qos: int, gap: float, now: float) -> None:
        """Count the gap if it is one of steering, and if the client does not wait for an answer."""
        # Other messages may have come in between, without a gap.
        is_steady = gap >= BURST and _peer_status(origin).flowing < gap
        pace.steady = pace.steady + 1 if is_steady else 0
        if qos and pace.steady and now > pace.withheld_until:
            # The client may have waited for an acknowledgement that it was sent meanwhile.
            pace.steady = 1
            self._withhold(pace, origin, now)
        if pace.steady >= STEADY and origin.link is not None:
            origin.link.withhold(0.0)

    def _begin(self, origin: Session, oldest: float, now: float) -> CommandVerdict:
        before = self._paces.get(origin)
        if before is not None:
            self._drop(before, origin, QUEUED)
        pace = self._paces[origin] = _Pace(now)
        if self._expected_replays and origin.client_id in self._expected_replays:
            del self._expected_replays[origin.client_id]
            # Most likely even a single command is from before the client left while driving.
            pace.is_queue = origin.age <= oldest
        pace.is_waiting = not pace.is_queue
        return CommandVerdict.WAIT if pace.is_waiting else CommandVerdict.REFUSE

    def _withhold(self, pace: _Pace, origin: Session, now: float) -> None:
        if origin.link is not None and now > pace.withheld_until + TRY_AGAIN:
            pace.withheld_until = now + WITHHOLD
            origin.link.withhold(WITHHOLD)

    def waiting_time(self, origin: Session, oldest: float) -> float:
        """Seconds to hold a first command: by then the next one of a queue would have come."""
        return min(WAIT + 2 * _peer_status(origin).round_trip, oldest)

    def observe_unreleased(
        self, origin: Session, oldest: float, now: float, number: int = -1
    ) -> None:
        """Record a command of QoS 2 that has come and is not released yet.

        Only now its pace can be measured, and whether it was unread for too long. `number`
        identifies the message, which may have several routes.
        """
        now += self.slept
        unreleased = self._unreleased.get(origin)
        if unreleased is None or not unreleased.number == number >= 0:
            self._observe(unreleased, origin, oldest, now)
            self._unreleased[origin].number = number
        if _is_delayed(origin, oldest):  # also if it is the first of its connection
            pace = self._paces.get(origin)
            is_known = pace is not None and pace.longest <= oldest
            self._judge(pace if is_known else None, origin, 2, oldest, now)

    def _observe(
        self, unreleased: _Pace | None, origin: Session, oldest: float, now: float
    ) -> None:
        if unreleased is None or max(now - unreleased.last, unreleased.longest) > oldest:
            # For a route with a longer `oldest` the stream may have gone on.
            self._unreleased[origin] = _Pace(now)
        else:
            gap, unreleased.last = now - unreleased.last, now
            unreleased.longest = max(unreleased.longest, gap)
            if unreleased.steady < STEADY or gap < BURST:
                self._time(unreleased, origin, 2, gap, now)
        pace = self._paces.get(origin)
        if pace is not None and pace.is_waiting:
            # Its release may be withheld for longer than the first one is held.
            pace.is_queue, pace.is_waiting = True, False
            begins_stream = self._unreleased[origin].steady > 0 and now - pace.last < WITHHOLD
            self._drop(pace, origin, STREAM_BEGINS if begins_stream else QUEUED)

    def mark_stale(self, origin: Session, now: float) -> None:
        """A command has come that is known to be stale: the next ones were queued behind it."""
        now += self.slept
        pace = self._paces.get(origin)
        if pace is not None:
            self._drop(pace, origin, "what came behind it is old")
        self._unreleased.pop(origin, None)
        self._paces[origin] = _Pace(now, is_queue=True)

    def add_pending(self, origin: Session, holder: PendingCommands) -> None:
        """The route holds a first command of the client."""
        self._paces[origin].holders.append(holder)

    def _drop(self, pace: _Pace, origin: Session, why: str) -> None:
        holders, pace.holders = pace.holders, []
        for holder in holders:
            holder.drop_pending(origin, why)

    def remove_pending(self, origin: Session, holder: PendingCommands) -> None:
        """The command that the route holds has none behind it, or is held no longer."""
        pace = self._paces.get(origin)
        if pace is not None:
            pace.holders = [other for other in pace.holders if other is not holder]
            pace.is_waiting = pace.is_waiting and bool(pace.holders)

    def expect_replay(self, client_id: str) -> None:
        """The client left while driving, and may have queued its commands since."""
        self._expected_replays[client_id] = None
        if len(self._expected_replays) > EXPECTED:
            self._expected_replays.popitem(last=False)

    def on_departed(self, session: Session) -> None:
        """The session's connection has ended: on the next one the evidence begins anew."""
        self._paces.pop(session, None)
        self._unreleased.pop(session, None)


def _peer_status(origin: Session) -> PeerStatus:
    return LOCAL_PEER if origin.link is None else origin.link.peer_status()


def _is_delayed(origin: Session, oldest: float) -> bool:
    """Whether what it sends now may have been unread in the appliance for too long."""
    return _peer_status(origin).held > oldest


def stated_age(properties: Properties | None, now: float) -> float | None:
    """The age of a message by its `sent-at`, in seconds; None without one. `now` is since 1970.

    Raises ValueError when it cannot be parsed, or is in the future.
    """
    made_at = sent_at(properties)
    if made_at is None:
        return None
    age = now - made_at
    if age < -AHEAD:
        ahead = f"its {SENT_AT} is {-age:.1f} s in the future"
        raise ValueError(f"{ahead}: set the clocks of the robot and its client")
    return age


def sent_at(properties: Properties | None) -> float | None:
    """When its client made the message, in seconds since 1970; None when that is not stated.

    The property is RFC 3339, or a number. Raises ValueError for anything else, and for two of them.
    """
    pairs = (properties or {}).get(Property.USER_PROPERTY)
    values = [
        str(pair[1])
        for pair in (pairs if isinstance(pairs, list) else ())
        if isinstance(pair, tuple) and pair[0] == SENT_AT
    ]
    if not values:
        return None
    if len(values) > 1:
        raise ValueError(f"it says {SENT_AT} {len(values)} times")
    problem = f"its {SENT_AT} is {quote(values[0][:40])}"
    try:
        seconds = _seconds(values[0])
    except (ValueError, OverflowError) as error:
        what = str(error) if isinstance(error, _NoZoneError) else f"it takes {_FORMS}"
        raise ValueError(f"{problem}: {what}") from None
    for limit, unit in _UNITS:
        if seconds >= limit:
            raise ValueError(f"{problem}: that looks like {unit}, and it is in seconds")
    return seconds


class _NoZoneError(ValueError):
    """A date and a time without a time zone."""


def _seconds(text: str) -> float:
    if not text.isascii() or len(text) > 40 or "_" in text:
        raise ValueError
    if text.replace(".", "", 1).isdigit():
        return float(text)
    # Python 3.10 takes three or six digits of a fraction only, and no Z.
    head, point, rest = text.upper().partition(".")
    if point:
        digits = len(rest) - len(rest.lstrip("0123456789"))
        if not digits:
            raise ValueError
        head, rest = f"{head}.{rest[:digits][:6]:0<6}", rest[digits:]
    elif head.endswith("Z"):
        head, rest = head[:-1], "Z"
    moment = datetime.fromisoformat(head + rest.replace("Z", "+00:00"))
    if moment.tzinfo is None and ":" in head:
        raise _NoZoneError("without its time zone: add Z for UTC, or such as +02:00")
    if moment.tzinfo is None or "T" not in text.upper().replace(" ", "T"):
        raise ValueError
    return moment.astimezone(timezone.utc).timestamp()
