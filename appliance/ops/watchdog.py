"""The health check behind systemd's watchdog and `/healthz`: whether the broker still delivers."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from async_timeout import timeout

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.net.scheduler import Scheduler

log = logging.getLogger(__name__)

#: The topic of the check's messages, which nobody may subscribe or publish to.
TOPIC = "$appliance/pulse"

#: Seconds after which the broker's clock has stopped: it ticks once a second.
CLOCK_PATIENCE = 5.0

#: Seconds that a turn may take to come for who asks at `/healthz`.
TURN_PATIENCE = 3.0

_CLOCK = "the broker's clock stands still"
_TURN = "no message has gone through a turn"


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
        #: Set in that turn; all who ask before it wait for the same one.
        self._turn: asyncio.Event | None = None
        #: What the last call found, empty for nothing; None before the first call.
        self._problem: str | None = None

    def is_alive(self) -> bool:
        """Whether the clock ticks and a message was published in a turn since the last call.

        A new problem is logged.
        """
        problem = ""
        if self._is_clock_late():
            problem = _CLOCK
        elif not self._has_passed:
            problem = _TURN
        if problem and self._problem not in (None, problem):
            log.error("no sign of life for the watchdog: %s", problem)
        self._problem = problem
        self._has_passed = False
        self._queue()
        return not problem

    async def problem(self) -> str:
        """The same, now: a message goes through a turn. Returns what is wrong, empty for nothing.

        It does not change what `is_alive` finds.
        """
        if self._is_clock_late():
            return _CLOCK
        if self._turn is None:
            self._turn = asyncio.Event()
        turn = self._turn
        self._queue()
        try:
            async with timeout(TURN_PATIENCE):
                await turn.wait()
        except asyncio.TimeoutError:
            return _TURN
        return ""

    def _is_clock_late(self) -> bool:
        return self._time() - self._broker.ticked_at > CLOCK_PATIENCE

    def _queue(self) -> None:
        if not self._is_queued:
            self._is_queued = True
            self._scheduler.queue_turn(self)

    def take_turn(self) -> None:
        """See `scheduler`: a turn as that of any client with work to do."""
        self._is_queued = False
        self._broker.publish(Message(TOPIC, b""), self._session)
        self._broker.flush()
        self._has_passed = True
        if self._turn is not None:
            self._turn.set()
            self._turn = None

    def fault(self, entry: str, error: Exception) -> None:
        """Count the fault; the next turn shows whether it was the only one."""
        self._broker.faults.caught(entry, error, "the watchdog's message")
