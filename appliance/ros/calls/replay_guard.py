"""Which calls clients had queued while they had no connection, told from what they say now.

For commands that move a robot there is more at stake, and more is asked: see `arrivals`.
"""

from __future__ import annotations

from dataclasses import dataclass

from appliance.broker.message import Message
from appliance.broker.session import Session

#: Messages that follow each other within so many seconds, and how many of them in a row: nobody
#: commands like that, but a queue is emptied so.
BURST = 0.005
BURST_MESSAGES = 3

#: Seconds after which a backlog is over, however fast its client goes on.
LONGEST = 60.0


@dataclass(slots=True)
class _Replay:
    """A client that sends what it had queued, until some time, and how fast."""

    until: float
    end: float
    last: float
    in_a_row: int = 1


class ReplayGuard:
    """Who has sent old messages, and until when its others are taken for such.

    What is sent again after a lost connection tells how old it is. What its client queued in the
    meantime comes right behind it, and looks like new: so what comes within the time that makes a
    message old is taken for old, and what comes in bursts, for as long as these take.
    """

    def __init__(self) -> None:
        self._behind: dict[Session, _Replay] = {}

    def has(self, message: Message, origin: Session | None, oldest: float, now: float) -> bool:
        """Whether the message is older than `oldest`, in seconds, or comes behind such a one."""
        is_old = message.age > oldest
        if origin is None:
            return is_old
        behind = self._behind.get(origin)
        if behind is None:
            if is_old:
                self._behind[origin] = _Replay(now + oldest, now + max(LONGEST, oldest), now)
            return is_old
        behind.in_a_row = behind.in_a_row + 1 if now - behind.last < BURST else 1
        behind.last = now
        if is_old or behind.in_a_row >= BURST_MESSAGES:
            behind.until = max(behind.until, min(now + oldest, behind.end))
        if now >= behind.until and not is_old:
            del self._behind[origin]
            return False
        return True

    def departed(self, session: Session) -> None:
        """Its connection has ended: what it sends on the next one tells its own age."""
        self._behind.pop(session, None)
