"""How old a command is: what is known of it, from which evidence, and what is decided.

A command that is carried out late moves a robot that nobody steers any more. MQTT messages do not
say when they were made, and client libraries queue what is published without a connection and send
it later as if it were new. So a command's age is taken from these, in this order:

| what is seen                                           | what that proves, and what is decided |
|--------------------------------------------------------|---------------------------------------|
| user property `sent-at`, of clocks that agree          | its age: carried out at once, or old  |
| Message Expiry that is over, DUP, a PUBREL that comes  | it is old: refused, and what comes    |
| late, a will                                           | behind it is a queue                  |
| a command less than `oldest` after one that was new    | it is younger: carried out at once    |
| the first since CONNECT, or since a longer silence,    | nothing: it waits for as long as the  |
| and none behind it                                     | next of a queue takes, or until a     |
|                                                        | DISCONNECT, and is carried out        |
| the same, and others behind it at once                 | a queue: none is carried out, neither |
|                                                        | the first nor the newest              |
| they go on at the pace of somebody who steers          | a queue would come faster: carried    |
|                                                        | out from the third on                 |

A Message Expiry Interval that is left proves nothing: it counts down in servers only, not in a
client's queue. A message that stops the robot is carried out though it is old, see
`Commands`, and shows all the same that what comes behind it is a queue.

A client has one queue for all that it sends: what is known of it holds for all its topics, and two
commands have a pause between them only when all of its messages have one. What the appliance has
not read for longer than `oldest` is a new beginning; of what came since, the appliance cannot tell
when. A command that comes in parts is as old as its first byte.

A queue ends by a silence or by that pace, never by a time: a stream that is faster than `BURST`
allows (125 Hz) is never carried out without `sent-at`.

The pace of somebody who steers is two gaps in a row that are no burst. A queue of QoS 1 may come
one by one, each behind the acknowledgement of the one before, and a busy or distant client then
has a pace as well. So what the client is sent is withheld for a moment, acknowledgements included:
who still goes on does not wait for these, and has no such queue.

Not to be known without `sent-at`: the age of a single command; of a queue that a slow network or
a starved client spreads over gaps as long as those of steering; and a delay that grows little by
little.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass, field
from datetime import datetime, timezone
from enum import Enum
from typing import Protocol

from appliance.broker.ports import LOCAL_PEER, PeerStatus
from appliance.broker.session import Session
from appliance.mqtt.codec import Properties, Property, quote

#: The user property that says when a command was made.
SENT_AT = "sent-at"

#: What it may look like.
_FORMS = "seconds since 1970 (1780000000.25) or RFC 3339 (2026-05-28T20:26:40.25Z)"

#: Numbers from which on it is no second that anybody means: the year 5138, and thousands of it.
_UNITS = ((1e17, "nanoseconds"), (1e14, "microseconds"), (1e11, "milliseconds"))

#: Seconds that a client's clock may be ahead of ours; a command may be older by as much.
AHEAD = 0.25

#: Seconds that the first command waits for another behind it, beside two round trips: Nagle's
#: algorithm and delayed acknowledgements keep the second of a queue back for 40 ms.
WAIT = 0.1

#: Seconds between two messages from which on it is no burst.
BURST = 0.008

#: Such gaps in a row until a client counts as one that steers.
STEADY = 2

#: Seconds that a client's acknowledgements are withheld, to see whether it goes on without them:
#: more than there are between two of its commands. And from one such try to the next.
WITHHELD = 0.15
TRY_AGAIN = 1.0

#: Why a command is not carried out: it is of a queue; or one of the first two of what may be one,
#: or a stream, which is as usual, and no reason to warn of anything.
QUEUED = "others came with it at once, as of a queue"
BEGINS = "a stream is carried out from its third command on"

#: Clients of which is known that they left while they drove.
EXPECTED = 1000


class CommandVerdict(Enum):
    """What to do with a command."""

    CARRY_OUT = "carry out"
    #: Until `StalenessDetector.waiting_time` is over, unless another comes.
    WAIT = "wait"
    REFUSE = "refuse"


@dataclass(slots=True)
class _Pace:
    """How the commands of one client come, since its connection or its last silence began."""

    last: float
    #: Whether the command that came last was its first; or the second of what may be a stream.
    is_first: bool = True
    begins: bool = False
    #: Before what came last, and the longest since the beginning: for a route whose `oldest` is
    #: shorter, that was a silence.
    gap: float = math.inf
    longest: float = 0.0
    #: Gaps in a row that are no burst.
    steady: int = 0
    is_waiting: bool = False
    is_queue: bool = False
    is_known: bool = False
    #: Whether what came last may have waited in here for too long.
    was_held: bool = False
    #: Of the message that came last.
    number: int = -1
    verdict: CommandVerdict = CommandVerdict.CARRY_OUT
    #: Where a first command waits.
    holders: list[PendingCommands] = field(default_factory=list)
    withheld_until: float = -math.inf


class PendingCommands(Protocol):
    """A route that lets first commands wait."""

    def drop_waiting(self, origin: Session, why: str) -> None:
        """What waits of the session is not carried out: it is of a queue."""


class StalenessDetector:
    """The commands of all clients to all topics, as they come; times in seconds.

    A client has one queue for all topics: what is known of it by one route holds for the others.
    """

    def __init__(self) -> None:
        #: Of the message for ROS that came last, of all clients' and whatever route it has.
        self.number = 0
        self._paces: dict[Session, _Pace] = {}
        #: Of those of QoS 2, how they come, before they are released.
        self._coming: dict[Session, _Pace] = {}
        self._expected: OrderedDict[str, None] = OrderedDict()

    def count(self) -> int:
        """A message for ROS has come; returns its number, which is one for all its routes."""
        self.number += 1
        return self.number

    def judge(
        self, origin: Session, qos: int, oldest: float, now: float, number: int = -1
    ) -> CommandVerdict:
        """What to do with a command of unknown age that has come now.

        `number` is the message's, which may have several routes; -1 when it is not known.
        """
        pace = self._paces.get(origin)
        is_same = pace is not None and pace.number == number >= 0
        if pace is not None and pace.longest > oldest:
            # Known by a route with a longer `oldest` only: for this one it begins.
            gap = pace.gap if is_same else now - pace.last
            verdict = self._begin(origin, oldest, now)
            began = self._paces[origin]
            began.was_held = _is_held(origin, oldest)
            if began.was_held or gap < self.waiting_time(origin, oldest):
                began.is_queue, began.is_waiting = True, False
                verdict = CommandVerdict.REFUSE
        elif pace is not None and is_same and self._is_for_all(pace, origin, oldest):
            return pace.verdict
        else:
            verdict = self._judge(pace, origin, qos, oldest, now)
        pace = self._paces[origin]
        pace.number, pace.verdict = number, verdict
        if verdict is CommandVerdict.REFUSE:
            self._drop(pace, origin, self.why(origin))
        return verdict

    def _is_for_all(self, pace: _Pace, origin: Session, oldest: float) -> bool:
        """Whether the verdict holds for a route with that `oldest`, too."""
        return pace.verdict is CommandVerdict.REFUSE or not _is_held(origin, oldest)

    def why(self, origin: Session) -> str:
        """Why its command was refused that was judged last."""
        pace = self._paces.get(origin)
        return BEGINS if pace is not None and pace.begins else QUEUED

    def _judge(
        self, pace: _Pace | None, origin: Session, qos: int, oldest: float, now: float
    ) -> CommandVerdict:
        was_held = pace is not None and pace.was_held
        is_held = _is_held(origin, oldest)
        if pace is None or now - pace.last > oldest or (is_held and not was_held):
            verdict = self._begin(origin, oldest, now)
            pace = self._paces[origin]
            if is_held:  # whatever it has said since, this may be older
                pace.is_queue, pace.is_waiting, verdict = True, False, CommandVerdict.REFUSE
            pace.was_held = is_held
            return verdict
        gap = pace.gap = now - pace.last
        pace.longest = max(pace.longest, gap)
        pace.last = now
        pace.begins = False
        if is_held:
            pace.is_queue, pace.is_waiting, pace.steady = True, False, 0
            return CommandVerdict.REFUSE
        pace.was_held = False
        if pace.is_known:
            return CommandVerdict.CARRY_OUT
        if qos < 2:
            self._time(pace, origin, qos, gap, now)
        else:
            coming = self._coming.get(origin)
            pace.steady = 0 if coming is None else coming.steady
        pace.begins = pace.is_first and pace.steady > 0 and gap < WITHHELD
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
        """Does it come at the pace of somebody who steers, and does not wait for an answer?"""
        # Other messages may come between the two, and all of them without a pause.
        is_steady = gap >= BURST and _peer_status(origin).flowing < gap
        pace.steady = pace.steady + 1 if is_steady else 0
        if qos and pace.steady and now > pace.withheld_until:
            # It may have waited for what it was sent meanwhile.
            pace.steady = 1
            self._withhold(pace, origin, now)
        if pace.steady >= STEADY and origin.link is not None:
            origin.link.withhold(0.0)

    def _begin(self, origin: Session, oldest: float, now: float) -> CommandVerdict:
        before = self._paces.get(origin)
        if before is not None:
            self._drop(before, origin, QUEUED)
        pace = self._paces[origin] = _Pace(now)
        if self._expected and origin.client_id in self._expected:
            del self._expected[origin.client_id]
            # Of who left in the midst of driving even a single one is from then, most likely.
            pace.is_queue = origin.age <= oldest
        pace.is_waiting = not pace.is_queue
        return CommandVerdict.WAIT if pace.is_waiting else CommandVerdict.REFUSE

    def _withhold(self, pace: _Pace, origin: Session, now: float) -> None:
        if origin.link is not None and now > pace.withheld_until + TRY_AGAIN:
            pace.withheld_until = now + WITHHELD
            origin.link.withhold(WITHHELD)

    def waiting_time(self, origin: Session, oldest: float) -> float:
        """Seconds that a first command waits: until then the next of a queue would have come."""
        return min(WAIT + 2 * _peer_status(origin).round_trip, oldest)

    def look(self, origin: Session, oldest: float, now: float, number: int = -1) -> None:
        """A command of QoS 2 has come that is not released yet: only now its pace can be told, and
        whether it was held in here. The number is its own, once for all its routes."""
        coming = self._coming.get(origin)
        if coming is None or not coming.number == number >= 0:
            self._come(coming, origin, oldest, now)
            self._coming[origin].number = number
        if _is_held(origin, oldest):  # also where it is the first of its connection
            pace = self._paces.get(origin)
            is_known = pace is not None and pace.longest <= oldest
            self._judge(pace if is_known else None, origin, 2, oldest, now)

    def _come(self, coming: _Pace | None, origin: Session, oldest: float, now: float) -> None:
        if coming is None or max(now - coming.last, coming.longest) > oldest:
            # For a route with a longer `oldest` it may have gone on.
            self._coming[origin] = _Pace(now)
        else:
            gap, coming.last = now - coming.last, now
            coming.longest = max(coming.longest, gap)
            if coming.steady < STEADY or gap < BURST:
                self._time(coming, origin, 2, gap, now)
        pace = self._paces.get(origin)
        if pace is not None and pace.is_waiting:
            # Its release may be withheld for longer than the first one waits.
            pace.is_queue, pace.is_waiting = True, False
            begins = self._coming[origin].steady > 0 and now - pace.last < WITHHELD
            self._drop(pace, origin, BEGINS if begins else QUEUED)

    def is_old(self, origin: Session, now: float) -> None:
        """A command has come that is known to be old: the next ones were queued behind it."""
        pace = self._paces.get(origin)
        if pace is not None:
            self._drop(pace, origin, "what came behind it is old")
        self._coming.pop(origin, None)
        self._paces[origin] = _Pace(now, is_queue=True)

    def waits(self, origin: Session, holder: PendingCommands) -> None:
        """A first command waits there."""
        self._paces[origin].holders.append(holder)

    def _drop(self, pace: _Pace, origin: Session, why: str) -> None:
        holders, pace.holders = pace.holders, []
        for holder in holders:
            holder.drop_waiting(origin, why)

    def waited(self, origin: Session, holder: PendingCommands) -> None:
        """The command that waits there has none behind it, or waits no longer."""
        pace = self._paces.get(origin)
        if pace is not None:
            pace.holders = [other for other in pace.holders if other is not holder]
            pace.is_waiting = pace.is_waiting and bool(pace.holders)

    def expect(self, client_id: str) -> None:
        """The client left in the midst of driving, and may have queued what it commanded since."""
        self._expected[client_id] = None
        if len(self._expected) > EXPECTED:
            self._expected.popitem(last=False)

    def departed(self, session: Session) -> None:
        """Its connection has ended: the next one is a beginning."""
        self._paces.pop(session, None)
        self._coming.pop(session, None)


def _peer_status(origin: Session) -> PeerStatus:
    return LOCAL_PEER if origin.link is None else origin.link.peer_status()


def _is_held(origin: Session, oldest: float) -> bool:
    """Whether what it sends now may have been in here for too long, before it was read."""
    return _peer_status(origin).held > oldest


def said_age(properties: Properties | None, now: float) -> float | None:
    """How old a message is by its `sent-at`, in seconds, `now` being since 1970; None when it says
    nothing.

    ValueError: what it says is nonsense, or in the future.
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
    """When its client made the message, in seconds since 1970; None when it does not say.

    That is RFC 3339, or a number. ValueError: it is neither, or there are two of them.
    """
    pairs = (properties or {}).get(Property.USER_PROPERTY)
    said = [
        str(pair[1])
        for pair in (pairs if isinstance(pairs, list) else ())
        if isinstance(pair, tuple) and pair[0] == SENT_AT
    ]
    if not said:
        return None
    if len(said) > 1:
        raise ValueError(f"it says {SENT_AT} {len(said)} times")
    problem = f"its {SENT_AT} is {quote(said[0][:40])}"
    try:
        seconds = _seconds(said[0])
    except (ValueError, OverflowError) as error:
        what = str(error) if isinstance(error, _NoZoneError) else f"it takes {_FORMS}"
        raise ValueError(f"{problem}: {what}") from None
    for limit, unit in _UNITS:
        if seconds >= limit:
            raise ValueError(f"{problem}: that looks like {unit}, and it is in seconds")
    return seconds


class _NoZoneError(ValueError):
    """A date and a time that could be anywhere."""


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
