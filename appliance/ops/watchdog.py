"""The health check behind systemd's watchdog: whether the broker still delivers messages."""

from __future__ import annotations

import logging
from collections.abc import Callable

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.net.scheduler import Scheduler

log = logging.getLogger(__name__)

#: The topic of the check's messages, which nobody may subscribe or publish to.
TOPIC = "$appliance/pulse"

#: Seconds after which the broker's clock has stopped: it ticks once a second.
CLOCK_PATIENCE = 5.0


class Pulse:
    """Publishes a message in a turn of the scheduler now and then, and checks the broker's clock.

    That the event loop runs is not enough: it also does when the scheduler gives no turns and no
    will is published. `time` is the clock that `Broker.tick` is called with.
    """

    def __init__(
        self, broker: Broker, scheduler: Scheduler, session: Session, time: Callable[[], float]
    ) -> None:
        self._broker = broker
        self._scheduler = scheduler
        self._session = session
        self._time = time
        #: Whether a turn is queued, and whether one has come since the last call of `is_alive`.
        self._is_queued = self._has_passed = False
        #: What the last call found, empty for nothing; None before the first call.
        self._problem: str | None = None

    def is_alive(self) -> bool:
        """Whether the clock ticks and a message was published in a turn since the last call.

        A new problem is logged.
        """
        problem = ""
        if self._time() - self._broker.ticked_at > CLOCK_PATIENCE:
            problem = "the broker's clock stands still"
        elif not self._has_passed:
            problem = "no message has gone through a turn"
        if problem and self._problem not in (None, problem):
            log.error("no sign of life for the watchdog: %s", problem)
        self._problem = problem
        self._has_passed = False
        if not self._is_queued:
            self._is_queued = True
            self._scheduler.queue_turn(self)
        return not problem

    def take_turn(self) -> None:
        """See `scheduler`: a turn as that of any client with work to do."""
        self._is_queued = False
        self._broker.publish(Message(TOPIC, b""), self._session)
        self._broker.flush()
        self._has_passed = True

    def fault(self, entry: str, error: Exception) -> None:
        """Count the fault; the next turn shows whether it was the only one."""
        self._broker.faults.caught(entry, error, "the watchdog's message")
