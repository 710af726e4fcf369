"""Recognizes calls that a client queued while it had no connection and replays afterwards.

Commands that move a robot are checked more strictly, see topics/staleness.py.
"""

from __future__ import annotations

from dataclasses import dataclass

from appliance.broker.message import Message
from appliance.broker.session import Session

#: So many messages, each within so many seconds of the one before, are a queue that is emptied:
#: nobody calls that fast.
BURST_INTERVAL = 0.005
BURST_MESSAGES = 3

#: Seconds after which a replay is over, however fast its client goes on.
MAX_DURATION = 60.0


@dataclass(slots=True)
class _Replay:
    """The replay of one client: when it ends, at the latest too, and how fast it is."""

    until: float
    end: float
    last: float
    in_a_row: int = 1


class ReplayGuard:
    """Tracks the clients that have sent old messages, and until when their others count as old.

    A message that is sent again after a lost connection has an age. The messages that its client
    queued in the meantime follow it and look new. So after an old message, all of its client's
    count as old for the time that makes a message old, and longer while they come in bursts. What
    comes over a link is judged by its own age: behind it are many clients.
    """

    def __init__(self) -> None:
        self._replays: dict[Session, _Replay] = {}

    def is_old(
        self, message: Message, publisher: Session | None, max_age: float, now: float
    ) -> bool:
        """Whether the message is older than `max_age`, in seconds, or part of a replay."""
        is_old = message.age > max_age
        if publisher is None or message.is_dated:
            return is_old
        replay = self._replays.get(publisher)
        if replay is None:
            if is_old:
                self._replays[publisher] = _Replay(
                    now + max_age, now + max(MAX_DURATION, max_age), now
                )
            return is_old
        replay.in_a_row = replay.in_a_row + 1 if now - replay.last < BURST_INTERVAL else 1
        replay.last = now
        if is_old or replay.in_a_row >= BURST_MESSAGES:
            replay.until = max(replay.until, min(now + max_age, replay.end))
        if now >= replay.until and not is_old:
            del self._replays[publisher]
            return False
        return True

    def departed(self, session: Session) -> None:
        """Forget a client whose connection has ended: what it sends next tells its age again."""
        self._replays.pop(session, None)
