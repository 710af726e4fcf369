"""The verbs as MQTT calls: `$CONTROL/appliance/v1/VERB/_call`, by mosquitto's convention.

A call is made and answered as one of a ROS service, see `ros/calls/dispatcher.py`, which needs no
ROS for it. The access rules decide who may write a verb's topic; without a rule nobody may.

However many calls come at once, one of them works in an iteration of the event loop, and users take
turns. Calls of ROS, and so what cancels a goal, have a dispatcher and a queue of their own.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, Final

from appliance.broker.broker import Broker
from appliance.broker.output import Output
from appliance.broker.session import Session
from appliance.management.topics import topic_of
from appliance.management.verbs import LONGEST_ANSWER, Caller, Verbs
from appliance.net.callbacks import Entries
from appliance.ros.calls.dispatcher import (
    Answer,
    Call,
    CallCounters,
    CallDispatcher,
    CallEndpoint,
    CallError,
    CallLimits,
)
from appliance.ros.payload.encodings.registry import VALUE_ENCODINGS
from appliance.ros.payload.fallback import ConversionError
from appliance.ros.payload.payloads import InputLimits
from appliance.ros.topics.conversions import ConversionQueue

CLIENT_ID: Final = "_control"

#: The most bytes of a call.
LONGEST: Final = 64 * 1024

#: The most work that the values of a call may be (`ros/payload/cost.py`), a millisecond: everybody
#: waits while they are checked. 200 questions about rights are half of it.
MOST_VALUES: Final = 10_000

#: The endpoints limit the size, as these are no messages for ROS.
_ANY_SIZE: Final = 1 << 28

#: The most calls under way of one client, of one user, and of all: people make them.
LIMITS: Final = CallLimits(
    client=5,
    total=50,
    user=10,
    input=InputLimits(payload=_ANY_SIZE, packet=_ANY_SIZE),
    section="",
)

#: The cost of a call, see `Counters.cost`: a millisecond.
COST: Final = 250


class ManagementCalls:
    """Answers the verbs over MQTT; belongs to the event loop's thread."""

    def __init__(self, broker: Broker, entries: Entries, verbs: Verbs) -> None:
        self._broker = broker
        self._verbs = verbs
        conversions = ConversionQueue(entries, broker.accounting)
        self._dispatcher = CallDispatcher(broker, entries, conversions, CLIENT_ID)
        self._dispatcher.limits = LIMITS

    def start(self) -> None:
        """Take calls."""
        for name, verb in self._verbs.by_name.items():
            self._dispatcher.register(
                CallEndpoint(
                    topic_of(name),
                    name,
                    verb.timeout,
                    CallCounters(),
                    partial(self._handle, name),
                    max_bytes=LONGEST,
                    fault="failed",
                )
            )
        self._broker.router.calls = frozenset(map(topic_of, self._verbs.by_name))
        self._dispatcher.start()
        self._broker.guards_changed()

    async def stop(self) -> None:
        """Answer calls under way with `stopping`; may be called twice."""
        await self._dispatcher.stop()

    def _handle(self, name: str, call: Call) -> Callable[[], Awaitable[Answer]]:
        self._broker.counters.cost += COST
        caller = self._caller(call.caller)
        given = _decoded(call)

        async def answer() -> Answer:
            await caller.turn()
            result = await self._verbs.run(caller, name, given)
            await caller.turn()
            payload = VALUE_ENCODINGS[call.encoding].dumps(result)
            if len(payload) > LONGEST_ANSWER:
                text = f"the answer has {len(payload)} bytes, {LONGEST_ANSWER} at most are sent"
                raise CallError("too_large", text)
            return Answer(payload, call.encoding)

        return answer

    def _caller(self, session: Session) -> Caller:
        if session.identity is None:
            # A part of the appliance publishes what a client has asked it to, such as an answer.
            raise CallError("not_authorized", "only clients manage the appliance")
        link = session.link
        address = link.transport.address if isinstance(link, Output) else ""
        return Caller(session.identity, address, partial(self._dispatcher.turn, session))


def _decoded(call: Call) -> Any:
    if not call.payload:
        return {}
    encoding = VALUE_ENCODINGS[call.encoding]
    if encoding.cost(call.payload, MOST_VALUES) > MOST_VALUES:
        raise CallError("too_large", "the call has too many values")
    try:
        return encoding.loads(call.payload)
    except ConversionError as error:
        raise CallError("bad_request", str(error)) from None
