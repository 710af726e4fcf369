"""Actions that MQTT clients use: goals, their cancelling and their results, on the loop's thread.

A ROS action is made of services and topics and is bridged as these: `/act/_action/send_goal`,
`cancel_goal` and `get_result` here, `feedback` and `status` in action_topics.py.

| topic under `r2d2/act` | content |
|---|---|
| `_goal` | a call with the goal's fields; its answer is `{"goal_id": …}` once it is accepted |
| `_cancel` | a call with `{"goal_id": …}`, `{"stamp": …}` for all up to then, or `{"all": true}` |
| `_feedback/{goal id}` | feedback of every goal, QoS 0: only the newest counts |
| `_result/{goal id}` | `{"status": "succeeded", "result": {…}}`, retained for `keep_result` |
| `_status` | all goals that the server knows of, retained |

A goal whose result never comes gets `{"status": "unknown", "error": {…}}`.

Payloads are JSON, CBOR or ROS's own bytes, see goals.py.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import takewhile
from typing import Any, Literal

from async_timeout import timeout

from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.mqtt.codec import Properties, Property
from appliance.net.callbacks import Entries
from appliance.ros.calls import goals
from appliance.ros.calls.action_topics import ActionSnapshot, ActionSubscriptions, ActionTopics
from appliance.ros.calls.context import CallContext
from appliance.ros.calls.dispatcher import (
    WITHOUT_RAW,
    Answer,
    Call,
    CallCounters,
    CallEndpoint,
    CallError,
    ConcurrencyLimiter,
    ErrorCode,
    Slot,
    error_payload,
)
from appliance.ros.calls.fair_cache import FairCache
from appliance.ros.calls.goals import ALL, CANCEL
from appliance.ros.calls.serialization import to_request
from appliance.ros.calls.service_clients import Key
from appliance.ros.mailbox import Mailbox
from appliance.ros.node import BusError
from appliance.ros.patterns import assign, compile_pattern, refusals
from appliance.ros.payload.converter import ConversionError
from appliance.ros.payload.encodings.base import EncodingName
from appliance.ros.payload.encodings.registry import CONTENT_TYPE, RAW, VALUE_ENCODINGS
from appliance.ros.skipped import Skipped, SkipReason

log = logging.getLogger(__name__)

SEND_GOAL = "/_action/send_goal"
GET_RESULT = "/_action/get_result"
CANCEL_GOAL = "/_action/cancel_goal"

#: By the return codes of action_msgs/srv/CancelGoal.
_NOT_CANCELLED: dict[int, tuple[ErrorCode, str]] = {
    1: ("rejected", "the action's server does not cancel it"),
    2: ("unknown_goal", "the action's server knows of no such goal"),
    3: ("unknown_goal", "the goal has ended already"),
}

#: Results of one action that are retained at a time, and their bytes; beyond these the oldest of
#: the user with the most is cleared.
MAX_RESULTS = 1000
MAX_RESULT_BYTES = 16 * 1024 * 1024

#: Goals of one action that were given up before they were accepted and are remembered, as their
#: server may accept them yet.
MAX_ABANDONED = 1000

#: Ended goals, of all actions, whose owner is remembered.
MAX_ENDED = 10_000

#: Bytes of a call that cancels.
MAX_CANCEL_BYTES = 1024

#: Seconds in which a server that has just joined must say that it does not know a goal.
CHECK_TIMEOUT = 5.0

#: Seconds that servers have to cancel goals when the appliance stops.
STOP_TIMEOUT = 1.0


@dataclass(frozen=True, slots=True)
class ActionSettings:
    """Actions, by names and patterns; what begins with `!` is left out.

    A `{ros}` in `mqtt` stands for the ROS name. `timeout` is for the acceptance of a goal and for
    its cancelling, `keep_result` is how long a result is retained, both in seconds. `encoding` is
    for what is published, and for calls that do not name another. `cancel` says whose goals a
    client may cancel that has the right to call `_cancel`.
    """

    names: tuple[str, ...]
    mqtt: str
    type: str | None = None
    timeout: float = 5.0
    encoding: EncodingName = "json"
    keep_result: float = 60.0
    cancel: Literal["own", "any"] = "own"
    cancel_on_disconnect: bool = False


@dataclass(eq=False, slots=True)
class Goal:
    """A goal under way that an MQTT client has sent.

    `result` is set when its outcome is known otherwise than by the answer of `get_result`.
    """

    id: bytes
    owner: Session
    slot: Slot
    result: asyncio.Future[tuple[str, bytes]]
    is_accepted: bool = False
    is_orphan: bool = False


class GoalRegistry:
    """The goals of all actions: the limit on those under way, and who owns which."""

    def __init__(self) -> None:
        self.slots = ConcurrencyLimiter("goals")
        #: The owners of goals that have ended, by the goal's id.
        self.ended: FairCache[bytes, str] = FairCache(MAX_ENDED)
        self._running: dict[bytes, Goal] = {}

    def begin(self, owner: Session) -> Goal:
        """Make a goal with a new id; a slot has been found to be free."""
        id_ = secrets.token_bytes(16)
        result = asyncio.get_running_loop().create_future()
        goal = self._running[id_] = Goal(id_, owner, self.slots.acquire(owner), result)
        return goal

    def end(self, goal: Goal) -> None:
        """Release the goal's slot, and remember the owner of one that was accepted."""
        del self._running[goal.id]
        self.slots.release(goal.slot)
        if goal.is_accepted:
            self.ended.put(goal.slot.user, goal.id, _owner(goal.owner))

    def owns(self, caller: Session, id_: bytes) -> bool:
        """Whether the goal is the caller's: as long as it is under way, and some time after."""
        goal = self._running.get(id_)
        if goal is not None:
            return _owner(goal.owner) == _owner(caller)
        return self.ended.get(id_) == _owner(caller)


@dataclass(eq=False, slots=True)
class _BackgroundTasks:
    """Tasks that nobody awaits, referenced until they end."""

    entries: Entries
    running: set[asyncio.Task[None]] = field(default_factory=set)

    def begin(self, work: Coroutine[Any, Any, None]) -> None:
        task = self.entries.task("actions.task", work)
        self.running.add(task)
        self.entries.when_done("actions.end", task, self.running.discard, task)

    async def stop(self) -> None:
        for task in self.running:
            task.cancel()
        await asyncio.gather(*self.running, return_exceptions=True)


class ActionRoutes:
    """The routes of actions; for the loop's thread, and `topics` for the ROS thread."""

    def __init__(self, context: CallContext, mailbox: Mailbox) -> None:
        self._context = context
        self._requests = context.requests
        self._mailbox = mailbox
        self.topics = ActionTopics(context.entries.faults, context.post)
        self.goals = GoalRegistry()
        self._counters: dict[ActionSettings, CallCounters] = {}
        self._actions: dict[str, BridgedAction] = {}
        #: Those whose route was removed before their goals have ended.
        self._removed: list[BridgedAction] = []
        #: Actions on the bus that a pattern names and does not take.
        self._refused: list[Skipped] = []
        self._tasks = _BackgroundTasks(context.entries)

    def start(self) -> None:
        """Clear what another run has left retained: nothing is known of the bus yet."""
        for route in self._counters:
            self._context.dispatcher.clear_retained(route.mqtt, "{ros}", "_status")

    def replace(self, routes: Sequence[ActionSettings]) -> None:
        """Use these routes from now on; one that was there before goes on without a break."""
        self._counters = {route: self._counters.get(route) or CallCounters() for route in routes}
        self.follow()

    def follow(self) -> None:
        """Bridge the actions that are on the bus now."""
        services = self._requests.services
        # Only whole actions: without `get_result` nobody could ask for the result of a goal.
        found = {
            name: [min(types)]
            for service in services
            if service.endswith(SEND_GOAL)
            and (name := service.removesuffix(SEND_GOAL))
            and (types := _types(name, services))
        }
        routes = list(self._counters)

        def misfit(route: ActionSettings, name: str) -> tuple[SkipReason, str] | None:
            return _misfit(route, found[name][0])

        wanted = assign(routes, found, lambda route, name: misfit(route, name) is None)
        self._refused = refusals(routes, found, wanted, "action", misfit)
        self._removed = [action for action in self._removed if action.has_goals]
        for name, action in list(self._actions.items()):
            if wanted.get(name) != action.route:
                action.stop()
                del self._actions[name]
                self._removed.append(action)
        for name, route in wanted.items():
            if name not in self._actions:
                self._actions[name] = self._new_action(name, route)
            action = self._actions[name]
            fixed = route.type if route.type is not None and "*" not in route.type else None
            seen = found[name][0] if name in found else action.type
            action.set_state(fixed or seen, name in found)
        self.topics.replace(action.subscriptions for action in self._actions.values())

    def _new_action(self, ros: str, route: ActionSettings) -> BridgedAction:
        return BridgedAction(
            ros,
            route,
            self._counters[route],
            self._context,
            self._mailbox,
            self.goals,
            self._tasks,
            partial(self._server_joined, ros),
        )

    def keys(self) -> Iterable[Key]:
        """The services that need a client that is ready."""
        for action in self._actions.values():
            yield from action.keys()

    def departed(self, session: Session) -> None:
        """A client's connection has ended."""
        if session in self.goals.slots:
            for action in self._all():
                action.departed(session)

    def _server_joined(self, ros: str) -> None:
        for action in self._all():
            if action.ros == ros:
                action.check_goals()

    def _all(self) -> list[BridgedAction]:
        return [*self._actions.values(), *self._removed]

    def status(self) -> list[tuple[ActionSettings, CallCounters, list[str]]]:
        """Each route, its counters, and the actions that it bridges now."""
        return [
            (route, counters, [a.ros for a in self._actions.values() if a.route is route])
            for route, counters in self._counters.items()
        ]

    def bridged(self) -> list[dict[str, Any]]:
        """Entries for `{robot}/_appliance/routes`."""
        return [
            {
                "ros": action.ros,
                "mqtt": action.base,
                "type": action.type or "",
                "direction": "action",
                "encoding": action.route.encoding,
                "timeout": action.route.timeout,
                "cancel": action.route.cancel,
            }
            for action in self._actions.values()
            if action.is_available
        ]

    def skips(self) -> list[Skipped]:
        """The actions that a route names and that are not bridged."""
        skips = list(self._refused)
        for action in self._actions.values():
            type_name = action.type or ""
            problem = self._requests.problem(f"{action.ros}{SEND_GOAL}", f"{type_name}_SendGoal")
            if problem is not None:
                skips.append(Skipped(action.ros, "action", type_name, "problem", problem))
            elif not action.is_available:
                skips.append(
                    Skipped(action.ros, "action", type_name, "absent", "no node offers it")
                )
        return skips

    async def cancel_orphans(self) -> None:
        """Cancel the goals that are to end with their client: as the appliance stops, no client can
        reach them any more."""
        cancels = [cancel for action in self._all() for cancel in action.orphan_cancels()]
        if cancels:
            with contextlib.suppress(asyncio.TimeoutError):
                async with timeout(STOP_TIMEOUT):
                    await asyncio.gather(*cancels)

    async def stop(self) -> None:
        """Clear what is retained, once the bus has been left."""
        for action in self._actions.values():
            action.clear_status()
        self._actions.clear()
        self._removed.clear()
        self._refused.clear()
        self.topics.replace(())
        await self._tasks.stop()


def _types(name: str, services: Mapping[str, Sequence[str]]) -> set[str]:
    """The types that an action has on the bus, with all of the services that it is made of."""
    if CANCEL not in services.get(f"{name}{CANCEL_GOAL}", ()):
        return set()
    goals_of, results_of = (
        {
            found.removesuffix(suffix)
            for found in services.get(service, ())
            if found.endswith(suffix)
        }
        for service, suffix in (
            (f"{name}{SEND_GOAL}", "_SendGoal"),
            (f"{name}{GET_RESULT}", "_GetResult"),
        )
    )
    return goals_of & results_of


def _misfit(route: ActionSettings, type_name: str) -> tuple[SkipReason, str] | None:
    """Why a pattern of the route does not take an action of that type; None when it does."""
    if route.type is None or compile_pattern(route.type).fullmatch(type_name):
        return None
    return "other_type", f"the route takes {route.type}"


class BridgedAction:
    """One action that MQTT clients may use; for the loop's thread."""

    def __init__(
        self,
        ros: str,
        route: ActionSettings,
        counters: CallCounters,
        context: CallContext,
        mailbox: Mailbox,
        registry: GoalRegistry,
        tasks: _BackgroundTasks,
        server_joined: Callable[[], None],
    ) -> None:
        self.ros = ros
        self.route = route
        self.base = route.mqtt.replace("{ros}", ros)
        self.type: str | None = None
        self.is_available = False
        #: Called when another server of the action has appeared on the bus.
        self.server_joined = server_joined
        self._counters = counters
        self._dispatcher = context.dispatcher
        self._requests = context.requests
        self._converters = converters = context.converters
        self._node = node = context.node
        self._serialization = node.serialization
        self._registry = registry
        self._tasks = tasks
        self._goals: dict[bytes, Goal] = {}
        #: Goals whose sender waits no longer, to be cancelled should their server accept them yet.
        self._abandoned: FairCache[bytes, None] = FairCache(MAX_ABANDONED)
        #: Topics of retained results, and until when; they all have the same time.
        self._results: FairCache[str, float] = FairCache(MAX_RESULTS, MAX_RESULT_BYTES)
        self._status_clears = 0
        #: Set by `stop`, and never unset.
        self._is_removed = False
        self._is_logged = False
        #: The ROS thread's side.
        self.subscriptions = ActionSubscriptions(
            ros, self.base, route.encoding, node, converters, mailbox, self, context.post
        )
        self._endpoints = [
            CallEndpoint(
                f"{self.base}/{verb}",
                f"{ros} {verb[1:]}",
                route.timeout,
                counters,
                handler,
                route.encoding,
                (*WITHOUT_RAW, self._serialization.encoding),
                MAX_CANCEL_BYTES if verb == "_cancel" else None,
                verb == "_cancel",
            )
            for verb, handler in (("_goal", self._on_goal), ("_cancel", self._on_cancel))
        ]
        for endpoint in self._endpoints:
            self._dispatcher.register(endpoint)

    def set_state(self, type_name: str | None, is_available: bool) -> None:
        """Take over the action's type, and whether it is on the bus now."""
        if self.is_available and not is_available:
            self.clear_status()
            self._status_clears += 1
        if not self._is_logged or self.is_available != is_available:
            self._is_logged = True
            if is_available:
                log.info("%s can be called at %s/_goal", self.ros, self.base)
            else:
                log.info("%s: no node offers it; it is called at %s/_goal", self.ros, self.base)
        self.type = type_name
        self.is_available = is_available
        self._update_subscriptions()

    def _update_subscriptions(self) -> None:
        self.subscriptions.update(
            ActionSnapshot(
                self.type,
                self.is_available,
                self._status_clears,
                frozenset(self._abandoned),
                self._is_removed,
            )
        )

    def topic_failed(self, problem: str) -> None:
        """A topic cannot be subscribed to, or a message cannot be converted."""
        self._counters.last_error = problem

    def keys(self) -> Iterable[Key]:
        """The services that it is made of."""
        if self.type is not None:
            yield f"{self.ros}{SEND_GOAL}", f"{self.type}_SendGoal"
            yield f"{self.ros}{GET_RESULT}", f"{self.type}_GetResult"
        yield f"{self.ros}{CANCEL_GOAL}", CANCEL

    # Goals

    def _on_goal(self, call: Call) -> Callable[[], Awaitable[Answer]]:
        type_name = self.type
        if type_name is None or not self.is_available:
            raise CallError("unavailable", f"there is no action {self.ros} on the bus")
        limits = self._dispatcher.limits
        self._registry.slots.check(call.caller, limits)
        goal_cdr = to_request(
            self._converters, f"{type_name}_Goal", call.payload, call.encoding, limits.input
        )
        return partial(self._send_goal, call, type_name, goal_cdr)

    async def _send_goal(self, call: Call, type_name: str, goal_cdr: bytes) -> Answer:
        self._registry.slots.check(call.caller, self._dispatcher.limits)
        if self.route.cancel_on_disconnect and call.caller.link is None:
            raise CallError("rejected", "its client has gone, and so would its goal be cancelled")
        goal = self._registry.begin(call.caller)
        self._goals[goal.id] = goal
        request = goals.with_id(goal_cdr, goal.id, self._serialization)
        try:
            cdr = await self._requests.ask(
                f"{self.ros}{SEND_GOAL}", f"{type_name}_SendGoal", request
            )
            response = self._converters.get(f"{type_name}_SendGoal_Response").to_dict(cdr)
            if not response["accepted"]:
                raise CallError("rejected", f"{self.ros} does not accept the goal")
        except asyncio.CancelledError:
            # Its server may accept it yet, and no client would know of it: cancel it now, and once
            # more should it begin after that.
            self._abandon(goal)
            self._tasks.begin(self._cancel_quietly(goal.id, "nobody waits for it any more"))
            raise
        except CallError as error:
            if error.code == "vanished":  # for a moment only, perhaps
                self._abandon(goal)
            else:
                self._end(goal)
            raise
        except BaseException:
            self._end(goal)
            raise
        goal.is_accepted = True
        self._tasks.begin(self._follow_goal(goal, type_name))
        if goal.is_orphan:
            self._cancel_orphan(goal)
        return goals.accepted(self._converters, goal.id, response["stamp"], call.encoding)

    def _end(self, goal: Goal) -> None:
        if self._goals.pop(goal.id, None) is not None:
            self._registry.end(goal)

    def _abandon(self, goal: Goal) -> None:
        """End a goal that may be accepted yet: then it is cancelled."""
        self._end(goal)
        self._abandoned.put(goal.slot.user, goal.id, None)
        self._update_subscriptions()

    async def _follow_goal(self, goal: Goal, type_name: str) -> None:
        """Await the result, as long as it takes, and publish it."""
        asking = asyncio.ensure_future(self._ask_result(goal, type_name))
        try:
            await asyncio.wait({asking, goal.result}, return_when=asyncio.FIRST_COMPLETED)
            status, cdr = goal.result.result() if goal.result.done() else asking.result()
            encoding = self.route.encoding
            read = partial(goals.result, self._converters, type_name, cdr, encoding)
            try:
                payload = await self._dispatcher.convert(goal.owner, len(cdr), read)
            except ConversionError as problem:
                raise CallError("ros_error", f"the result cannot be read: {problem}") from None
        except CallError as error:
            self._counters.errors[error.code] += 1
            self._counters.last_error = f"{error.code}: {error}"
            log.warning("goal %s of %s has no result: %s", goal.id.hex(), self.ros, error)
            status = "unknown"
            payload, encoding = error_payload(error, self.route.encoding, status=status)
        finally:
            asking.cancel()
            self._end(goal)
        kind = "GetResult_Response" if encoding in RAW else "Result"
        user_properties = [
            ("status", "ok" if status == "succeeded" else "error"),
            ("ros-type", f"{type_name}_{kind}"),
        ]
        properties: Properties = {
            Property.CONTENT_TYPE: CONTENT_TYPE[encoding],
            Property.USER_PROPERTY: user_properties,
        }
        self._publish_result(goal, payload, properties)

    async def _ask_result(self, goal: Goal, type_name: str) -> tuple[str, bytes]:
        """The goal's final status, and the response of `get_result`. Raises CallError."""
        converter = self._converters.get(f"{type_name}_GetResult_Request")
        service = f"{self.ros}{GET_RESULT}"
        try:
            response = await self._requests.ask(
                service,
                f"{type_name}_GetResult",
                converter.from_dict({"goal_id": {"uuid": goal.id}}),
            )
        except CallError as error:
            if error.code != "unavailable":
                raise
            # The server was there, as it has accepted the goal.
            raise CallError("vanished", f"{service} went away before it answered") from None
        status = goals.status_of(response, self._serialization)
        if status == "unknown":
            text = f"the server of {self.ros} was restarted and does not know the goal"
            raise CallError("vanished", text)
        return status, response

    def _publish_result(self, goal: Goal, payload: bytes, properties: Properties) -> None:
        keep = self.route.keep_result
        topic = f"{self.base}/_result/{goal.id.hex()}"
        now = self._dispatcher.now()
        expires_at = now + keep if keep > 0 else None
        self._dispatcher.publish(Message(topic, payload, 1, keep > 0, properties, expires_at))
        if expires_at is None:
            return
        for expired in list(takewhile(lambda item: item[1] <= now, self._results.items())):
            self._results.remove(expired[0])  # the broker has removed it by itself
        for evicted, _ in self._results.put(goal.slot.user, topic, expires_at, len(payload)):
            self._dispatcher.publish(Message(evicted, b"", 0, True))

    @property
    def has_goals(self) -> bool:
        """Whether a goal is under way."""
        return bool(self._goals)

    def check_goals(self) -> None:
        """Ask whether the goals are still known: a server that has just joined may have replaced
        one that was ended."""
        type_name = self.type
        if type_name is None:
            return
        for goal in self._goals.values():
            if goal.is_accepted:
                self._tasks.begin(self._check(goal, type_name))

    async def _check(self, goal: Goal, type_name: str) -> None:
        # A server that works on the goal does not answer until it is done.
        try:
            async with timeout(CHECK_TIMEOUT):
                await self._ask_result(goal, type_name)
        except asyncio.TimeoutError:
            return
        except CallError as error:
            if error.code == "vanished" and not goal.result.done():
                goal.result.set_exception(error)

    # Cancelling

    def _on_cancel(self, call: Call) -> Callable[[], Awaitable[Answer]]:
        limits = self._dispatcher.limits.input
        id_, stamp = goals.which(self._converters, call.payload, call.encoding, limits)
        self._check_right(call.caller, id_)
        if not self.is_available:
            raise CallError("unavailable", f"there is no action {self.ros} on the bus")
        return partial(self._cancel_for, call, id_, stamp)

    async def _cancel_for(self, call: Call, id_: bytes, stamp: dict[str, int]) -> Answer:
        canceling, response = await self._cancel(id_, stamp)
        if call.encoding in RAW:
            return Answer(response, call.encoding, f"{CANCEL}_Response")
        payload = VALUE_ENCODINGS[call.encoding].dumps({"goals_canceling": canceling})
        return Answer(payload, call.encoding)

    def _check_right(self, caller: Session, id_: bytes) -> None:
        """Raises CallError when the caller may cancel only its own goals, and this is another's."""
        right = f"{self.base}/_cancel_any"
        if self.route.cancel == "any" or self._registry.owns(caller, id_):
            return
        if not self._dispatcher.may_publish(caller, right):
            what = f"goal {id_.hex()} is" if id_ != ALL else "these goals may be"
            raise CallError(
                "not_authorized",
                f"{what} another's; to cancel those as well takes the right to write to {right}, "
                "or cancel: any in the route",
            )

    async def _cancel(
        self, id_: bytes, stamp: dict[str, int] | None = None
    ) -> tuple[list[str], bytes]:
        """Cancel a goal, or ALL up to a time.

        Returns the ids of the goals that are being cancelled, and the response. Raises CallError.
        """
        request = self._converters.get(f"{CANCEL}_Request").from_dict(
            {"goal_info": {"goal_id": {"uuid": id_}, "stamp": stamp or {}}}
        )
        cdr = await self._requests.ask(f"{self.ros}{CANCEL_GOAL}", CANCEL, request)
        response = self._converters.get(f"{CANCEL}_Response").to_dict(cdr)
        canceling = [goals.id_of(info["goal_id"]).hex() for info in response["goals_canceling"]]
        if response["return_code"] in _NOT_CANCELLED:
            code, text = _NOT_CANCELLED[response["return_code"]]
            raise CallError(code, text)
        if not canceling and id_ != ALL:
            # rclpy's server has no other answer for a goal that it refuses to cancel.
            raise CallError("rejected", "the action's server does not cancel it")
        return canceling, cdr

    async def _cancel_quietly(self, id_: bytes, why: str) -> None:
        """Cancel a goal for no caller: how that ends goes to the log."""
        try:
            async with timeout(self.route.timeout):
                await self._cancel(id_)
        except CallError as error:
            if error.code != "unknown_goal":
                log.warning("goal %s of %s is not cancelled: %s", id_.hex(), self.ros, error)
        except asyncio.TimeoutError:
            log.warning("goal %s of %s is not cancelled: no answer", id_.hex(), self.ros)
        else:
            log.info("goal %s of %s is cancelled: %s", id_.hex(), self.ros, why)

    def goals_running(self, ids: list[bytes]) -> None:
        """Cancel the abandoned goals among those that the status says are running."""
        for id_ in ids:
            if id_ in self._abandoned:
                self._abandoned.remove(id_)
                why = "it was accepted when nobody waited for it any more"
                self._tasks.begin(self._cancel_quietly(id_, why))
        self._update_subscriptions()

    def departed(self, session: Session) -> None:
        """Cancel the goals of a client whose connection has ended, where the route says so."""
        if not self.route.cancel_on_disconnect:
            return
        for goal in self._goals.values():
            if goal.owner is session and not goal.is_orphan:
                goal.is_orphan = True
                if goal.is_accepted:
                    self._cancel_orphan(goal)

    def _cancel_orphan(self, goal: Goal) -> None:
        self._tasks.begin(self._cancel_quietly(goal.id, f"{goal.owner} has gone"))

    def orphan_cancels(self) -> list[Coroutine[Any, Any, None]]:
        """What cancels the goals that may not outlive the appliance."""
        if not self.route.cancel_on_disconnect:
            return []
        return [
            self._cancel_quietly(goal.id, "the appliance stops")
            for goal in self._goals.values()
            if goal.is_accepted
        ]

    def stop(self) -> None:
        """Remove what the route has set up. Goals go on, and their results are published."""
        for endpoint in self._endpoints:
            self._dispatcher.unregister(endpoint)
        self.clear_status()
        self._is_removed = True
        self._update_subscriptions()
        with contextlib.suppress(BusError):  # without a bus there are no subscriptions either
            self._node.call_soon(self.subscriptions.close)

    def clear_status(self) -> None:
        """Clear the retained status, which is true no more."""
        self._dispatcher.publish(Message(f"{self.base}/_status", b"", 0, True))


def _owner(caller: Session) -> str:
    """The owner of a client's goals: its user, on whichever client; without one, the client."""
    identity = caller.identity
    if identity is None or identity.username is None:
        return f"client {caller.client_id}"
    return f"user {identity.username}"
