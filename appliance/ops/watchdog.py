"""Whether the broker works: what the watchdog is told depends on it."""

from __future__ import annotations

import logging
from collections.abc import Callable

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.net.scheduler import Scheduler

log = logging.getLogger(__name__)

#: Where the messages go; nobody subscribes, and nobody may publish there.
TOPIC = "$appliance/pulse"

#: Seconds that the broker's clock may stand still: it ticks once a second.
CLOCK_PATIENCE = 5.0


class Pulse:
    """Sends a message through a turn now and then, as a client's go, and looks at the clock.

    An event loop that turns is not enough: it also does so when no turn comes and no will is sent.
    `time` gives the seconds that `Broker.tick` is given.
    """

    def __init__(
        self, broker: Broker, scheduler: Scheduler, session: Session, time: Callable[[], float]
    ) -> None:
        self._broker = broker
        self._scheduler = scheduler
        self._session = session
        self._time = time
        #: Whether the last message is on its way, and whether one has gone through.
        self._is_sent = self._came_through = False
        #: What was last found to be wrong; None before it was asked for the first time.
        self._problem: str | None = None

    def is_there(self) -> bool:
        """Whether a message has gone through a turn since this was last asked, and the clock goes.

        Tells the log when it is not so any more.
        """
        problem = ""
        if self._time() - self._broker.ticked_at > CLOCK_PATIENCE:
            problem = "the broker's clock stands still"
        elif not self._came_through:
            problem = "no message has gone through a turn"
        if problem and self._problem not in (None, problem):
            log.error("no sign of life for the watchdog: %s", problem)
        self._problem = problem
        self._came_through = False
        if not self._is_sent:
            self._is_sent = True
            self._scheduler.queue_turn(self)
        return not problem

    def take_turn(self) -> None:
        """Its turn, as of any client that has much to do."""
        self._is_sent = False
        self._broker.publish(Message(TOPIC, b""), self._session)
        self._broker.flush()
        self._came_through = True

    def fault(self, entry: str, error: Exception) -> None:
        """The turn went wrong: the next message says whether that was all."""
        self._broker.faults.caught(entry, error, "the watchdog's message")
