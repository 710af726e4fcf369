"""Actions: goals that MQTT clients send, and what becomes of them.

An action is made of services and topics, and is bridged as these: `/act/_action/send_goal`,
`cancel_goal` and `get_result`, `feedback` and `status`.

| topic under `r2d2/act` | what |
|---|---|
| `_goal` | a call with the goal's fields; its answer is `{"goal_id": …}` once it is accepted |
| `_cancel` | a call with `{"goal_id": …}`, `{"stamp": …}` for all up to then, or `{"all": true}` |
| `_feedback/{goal id}` | feedback of every goal, QoS 0: only the newest counts |
| `_result/{goal id}` | `{"status": "succeeded", "result": {…}}`, retained for `keep_result` |
| `_status` | all goals that the server knows of, retained |

A result that never comes is `{"status": "unknown", "error": {…}}`.

These are JSON, CBOR or ROS's own bytes, see goals.py.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import takewhile
from typing import Any, Literal

from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.mqtt.codec import Properties, Property
from appliance.net.callbacks import Entries
from appliance.ros.calls import goals
from appliance.ros.calls.dispatcher import (
    WITHOUT_RAW,
    Answer,
    Call,
    CallCounters,
    CallDispatcher,
    CallEndpoint,
    CallError,
    ConcurrencyLimiter,
    ErrorCode,
    Slot,
    error_payload,
)
from appliance.ros.calls.fair_cache import FairCache
from appliance.ros.calls.goals import ALL, CANCEL, STATUS
from appliance.ros.calls.requests import Key, Requests
from appliance.ros.calls.services import from_ros, to_request
from appliance.ros.mailbox import Lane, Mailbox
from appliance.ros.metrics import FlowCounters
from appliance.ros.node import BusError, Durability, QosProfile, RosNode, RosSubscription
from appliance.ros.patterns import assign, compile_pattern, refusals
from appliance.ros.payload.converter import ConversionError, Converters
from appliance.ros.payload.definitions import UnknownTypeError
from appliance.ros.payload.encodings.base import EncodingName
from appliance.ros.payload.encodings.registry import CONTENT_TYPE, RAW, VALUE_ENCODINGS
from appliance.ros.qos import BURST
from appliance.ros.skipped import Skipped, SkipReason

log = logging.getLogger(__name__)

SEND_GOAL = "/_action/send_goal"
GET_RESULT = "/_action/get_result"
CANCEL_GOAL = "/_action/cancel_goal"

#: By the numbers of action_msgs/srv/CancelGoal.
_NOT_CANCELLED: dict[int, tuple[ErrorCode, str]] = {
    1: ("rejected", "the action's server does not cancel it"),
    2: ("unknown_goal", "the action's server knows of no such goal"),
    3: ("unknown_goal", "the goal has ended already"),
}

#: Goals whose feedback waits for a busy broker, each with its newest.
LANES = 256

#: Results that one action keeps at a time, and bytes of them; the oldest of the user with most go
#: first.
RESULTS = 1000
RESULT_BYTES = 16 * 1024 * 1024

#: Goals of one action that were given up before they were accepted; so are these.
UNWANTED = 1000

#: Goals of all actions that have ended of which is known who sent them; and these.
ENDED = 10_000

#: Bytes of a call that cancels.
LARGEST_CANCEL = 1024

#: Seconds that a server which has just come has to say that it does not know a goal.
CHECK_TIME = 5.0

#: Seconds that servers have to take back goals when the appliance stops.
LAST_WORD = 1.0


@dataclass(frozen=True, slots=True)
class ActionSettings:
    """Actions, by names and patterns; what begins with `!` is left out.

    A `{ros}` in `mqtt` stands for the ROS name. `timeout` is for the acceptance of a goal and for
    its cancelling, `keep_result` is how long a result is retained, both in seconds. `encoding` is
    for what is published, and for calls that do not name another. `cancel` says whose goals those
    may cancel who may call `_cancel`.
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
class _Goal:
    """A goal under way that an MQTT client has sent."""

    id: bytes
    owner: Session
    slot: Slot
    result: asyncio.Future[tuple[str, bytes]]
    is_accepted: bool = False
    is_orphan: bool = False


@dataclass(eq=False, slots=True)
class _BackgroundTasks:
    """Tasks that nobody waits for, kept until they end."""

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
    """The routes of actions; for the loop's thread, where it does not say otherwise."""

    def __init__(
        self,
        dispatcher: CallDispatcher,
        requests: Requests,
        converters: Converters,
        node: RosNode,
        entries: Entries,
        post: Callable[..., None],
        mailbox: Mailbox,
    ) -> None:
        self._dispatcher = dispatcher
        self._requests = requests
        self._converters = converters
        self._node = node
        self._post = post
        self._mailbox = mailbox
        self._counters: dict[ActionSettings, CallCounters] = {}
        self._actions: dict[str, BridgedAction] = {}
        #: Those whose route has gone before their goals.
        self._past: list[BridgedAction] = []
        #: Actions that patterns speak of and do not take.
        self._refused: list[Skipped] = []
        self._tasks = _BackgroundTasks(entries)
        #: Of the goals under way.
        self.slots = ConcurrencyLimiter("goals")
        #: Who has sent a goal that has ended since, by its id.
        self.ended: FairCache[bytes, str] = FairCache(ENDED)

    def start(self) -> None:
        """Nothing is known of the bus yet."""
        for route in self._counters:
            self._dispatcher.clear(route.mqtt, "{ros}", "_status")

    def replace(self, routes: Sequence[ActionSettings]) -> None:
        """Have these routes from now on; one that was there before does not notice."""
        self._counters = {route: self._counters.get(route) or CallCounters() for route in routes}
        self.follow()

    def follow(self) -> None:
        """Offer what is on the bus now."""
        services = self._requests.services
        # Until all is found that it is made of, the result of a goal could not be asked for.
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
        self._past = [action for action in self._past if action.has_goals]
        for name, action in list(self._actions.items()):
            if wanted.get(name) != action.route:
                action.stop()
                del self._actions[name]
                self._past.append(action)
        for name, route in wanted.items():
            if name not in self._actions:
                self._actions[name] = BridgedAction(name, route, self._counters[route], self)
            fixed = route.type if route.type is not None and "*" not in route.type else None
            seen = found[name][0] if name in found else self._actions[name].type
            self._actions[name].type = fixed or seen
            self._actions[name].see(name in found)

    def keys(self) -> Iterable[Key]:
        """The services that a client should be ready for."""
        for action in self._actions.values():
            yield from action.keys()

    def owns(self, caller: Session, id_: bytes) -> bool:
        """Whether the goal is the caller's: as long as it is under way, and some time after."""
        for action in self._all():
            goal = action._goals.get(id_)
            if goal is not None:
                return _owner(goal.owner) == _owner(caller)
        return self.ended.get(id_) == _owner(caller)

    def departed(self, session: Session) -> None:
        """A client's connection has ended."""
        if session in self.slots:
            for action in self._all():
                action.departed(session)

    def server_came(self, ros: str) -> None:
        """Another server of that action has come."""
        for action in self._all():
            if action.ros == ros:
                action.check_goals()

    def _all(self) -> list[BridgedAction]:
        return [*self._actions.values(), *self._past]

    def status(self) -> list[tuple[ActionSettings, CallCounters, list[str]]]:
        """Each route, what it has counted, and the actions that it offers now."""
        return [
            (route, counters, [a.ros for a in self._actions.values() if a.route is route])
            for route, counters in self._counters.items()
        ]

    def bridged(self) -> list[dict[str, str]]:
        """Entries for `{robot}/_appliance/routes`."""
        return [
            {
                "ros": action.ros,
                "mqtt": action.base,
                "type": action.type or "",
                "direction": "action",
                "encoding": action.route.encoding,
            }
            for action in self._actions.values()
            if action.is_there
        ]

    def skips(self) -> list[Skipped]:
        """The actions that routes speak of and are not bridged."""
        skips = list(self._refused)
        for action in self._actions.values():
            type_name = action.type or ""
            problem = self._requests.problem(f"{action.ros}{SEND_GOAL}", f"{type_name}_SendGoal")
            if problem is not None:
                skips.append(Skipped(action.ros, "action", type_name, "problem", problem))
            elif not action.is_there:
                skips.append(
                    Skipped(action.ros, "action", type_name, "absent", "no node offers it")
                )
        return skips

    async def cancel_orphans(self) -> None:
        """The appliance stops, and with it every client's way to its goals: cancel those that
        are not to go on without them."""
        cancels = [
            action._cancel_quietly(goal.id, "the appliance stops")
            for action in self._all()
            if action.route.cancel_on_disconnect
            for goal in action._goals.values()
            if goal.is_accepted
        ]
        if cancels:
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(asyncio.gather(*cancels), LAST_WORD)

    async def stop(self) -> None:
        """The bus has been left: nothing is offered any more."""
        for action in self._actions.values():
            action.forget()
        self._actions.clear()
        self._past.clear()
        self._refused.clear()
        await self._tasks.stop()

    # The ROS thread

    def look(self) -> None:
        """Follow the actions' topics."""
        for action in list(self._actions.values()):
            try:
                action.look(self._node)
            except Exception as error:
                self._post(self._tasks.entries.faults.caught, "actions.look", error, action.ros)

    def lost(self) -> None:
        """The bus is gone, and with it all subscriptions."""
        for action in list(self._actions.values()):
            action.lost()


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
    """One action that MQTT clients may use."""

    def __init__(
        self, ros: str, route: ActionSettings, counters: CallCounters, routes: ActionRoutes
    ) -> None:
        self.ros = ros
        self.route = route
        self.base = route.mqtt.replace("{ros}", ros)
        self.type: str | None = None
        self.is_there = False
        #: Whether the status has to be asked for anew: a publisher that stayed says it only once.
        self._has_forgotten = False
        self._counters = counters
        self._routes = routes
        self._dispatcher = routes._dispatcher
        self._requests = routes._requests
        self._converters = routes._converters
        self._wire = routes._node.wire
        self._goals: dict[bytes, _Goal] = {}
        #: Goals that nobody waits for any more, should their server accept them yet.
        self._unwanted: FairCache[bytes, None] = FairCache(UNWANTED)
        #: Topics of results that are retained, and until when; they all have the same time.
        self._kept: FairCache[str, float] = FairCache(RESULTS, RESULT_BYTES)
        # The ROS thread's.
        self._subscriptions: list[RosSubscription] = []
        self._subscribed: str | None = None
        self._is_over = False
        self._servers = 0
        self._counted = FlowCounters()
        self._lanes: OrderedDict[bytes, Lane] = OrderedDict()
        self._status_lane = Lane(1, self._counted)
        self._endpoints = [
            CallEndpoint(
                f"{self.base}/{verb}",
                f"{ros} {verb[1:]}",
                route.timeout,
                counters,
                handle,
                route.encoding,
                (*WITHOUT_RAW, self._wire.encoding),
                LARGEST_CANCEL if verb == "_cancel" else None,
                verb == "_cancel",
            )
            for verb, handle in (("_goal", self._on_goal), ("_cancel", self._on_cancel))
        ]
        for endpoint in self._endpoints:
            self._dispatcher.register(endpoint)
        self._is_told = False

    def see(self, is_there: bool) -> None:
        """Whether the action is on the bus now."""
        if self.is_there and not is_there:
            self.forget()
            self._has_forgotten = True
        if not self._is_told or self.is_there != is_there:
            self._is_told = True
            if is_there:
                log.info("%s can be called at %s/_goal", self.ros, self.base)
            else:
                log.info("%s: no node offers it; it is called at %s/_goal", self.ros, self.base)
        self.is_there = is_there

    def keys(self) -> Iterable[Key]:
        """The services that it is made of."""
        if self.type is not None:
            yield f"{self.ros}{SEND_GOAL}", f"{self.type}_SendGoal"
            yield f"{self.ros}{GET_RESULT}", f"{self.type}_GetResult"
        yield f"{self.ros}{CANCEL_GOAL}", CANCEL

    # Goals

    def _on_goal(self, call: Call) -> Callable[[], Awaitable[Answer]]:
        type_name = self.type
        if type_name is None or not self.is_there:
            raise CallError("unavailable", f"there is no action {self.ros} on the bus")
        limits = self._dispatcher.limits
        self._routes.slots.check(call.caller, limits)
        goal_cdr = to_request(
            self._converters, f"{type_name}_Goal", call.payload, call.encoding, limits.input
        )
        return partial(self._send_goal, call, type_name, goal_cdr)

    async def _send_goal(self, call: Call, type_name: str, goal_cdr: bytes) -> Answer:
        routes = self._routes
        routes.slots.check(call.caller, self._dispatcher.limits)
        if self.route.cancel_on_disconnect and call.caller.link is None:
            raise CallError("rejected", "its client has gone, and so would its goal be cancelled")
        id_ = secrets.token_bytes(16)
        request = goals.with_id(goal_cdr, id_, self._wire)
        goal = _Goal(
            id_,
            call.caller,
            routes.slots.acquire(call.caller),
            asyncio.get_running_loop().create_future(),
        )
        self._goals[id_] = goal
        try:
            response = await self._requests.ask(
                f"{self.ros}{SEND_GOAL}", f"{type_name}_SendGoal", request
            )
            said = self._converters.get(f"{type_name}_SendGoal_Response").to_dict(response)
            if not said["accepted"]:
                raise CallError("rejected", f"{self.ros} does not accept the goal")
        except asyncio.CancelledError:
            # It may be accepted yet, and nobody would know of it: it is cancelled now, and once
            # more should it begin after that.
            self._give_up(goal)
            self._routes._tasks.begin(self._cancel_quietly(id_, "nobody waits for it any more"))
            raise
        except CallError as error:
            if error.code == "vanished":  # for a moment only, perhaps
                self._give_up(goal)
            else:
                self._forget(goal)
            raise
        except BaseException:
            self._forget(goal)
            raise
        goal.is_accepted = True
        self._routes._tasks.begin(self._follow_goal(goal, type_name))
        if goal.is_orphan:
            self._cancel_orphan(goal)
        return goals.accepted(self._converters, id_, said["stamp"], call.encoding)

    def _forget(self, goal: _Goal) -> None:
        if self._goals.pop(goal.id, None) is not None:
            self._routes.slots.release(goal.slot)
            if goal.is_accepted:
                self._routes.ended.put(goal.slot.user, goal.id, _owner(goal.owner))

    def _give_up(self, goal: _Goal) -> None:
        """Nobody waits for its acceptance any more: should it come, it is cancelled."""
        self._forget(goal)
        self._unwanted.put(goal.slot.user, goal.id, None)

    async def _follow_goal(self, goal: _Goal, type_name: str) -> None:
        """Wait for the result, as long as it takes, and publish it."""
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
            self._forget(goal)
        kind = "GetResult_Response" if encoding in RAW else "Result"
        about = [
            ("status", "ok" if status == "succeeded" else "error"),
            ("ros-type", f"{type_name}_{kind}"),
        ]
        properties: Properties = {
            Property.CONTENT_TYPE: CONTENT_TYPE[encoding],
            Property.USER_PROPERTY: about,
        }
        self._publish_result(goal, payload, properties)

    async def _ask_result(self, goal: _Goal, type_name: str) -> tuple[str, bytes]:
        """What became of the goal, and the response of `get_result`. Raises CallError."""
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
            # The server was there, and took the goal.
            raise CallError("vanished", f"{service} went away before it answered") from None
        status = goals.status_of(response, self._wire)
        if status == "unknown":
            text = f"the server of {self.ros} has come anew and does not know the goal"
            raise CallError("vanished", text)
        return status, response

    def _publish_result(self, goal: _Goal, payload: bytes, properties: Properties) -> None:
        keep = self.route.keep_result
        topic = f"{self.base}/_result/{goal.id.hex()}"
        until = self._dispatcher.now() + keep if keep > 0 else None
        self._dispatcher.publish(Message(topic, payload, 1, keep > 0, properties, until))
        if until is None:
            return
        now = self._dispatcher.now()
        for old in list(takewhile(lambda item: item[1] <= now, self._kept.items())):
            self._kept.remove(old[0])  # the broker has let go of it by itself
        for dropped, _ in self._kept.put(goal.slot.user, topic, until, len(payload)):
            self._dispatcher.publish(Message(dropped, b"", 0, True))

    @property
    def has_goals(self) -> bool:
        return bool(self._goals)

    def check_goals(self) -> None:
        """Another server has come: it may have taken the place of one that was ended."""
        type_name = self.type
        if type_name is None:
            return
        for goal in self._goals.values():
            if goal.is_accepted:
                self._routes._tasks.begin(self._check(goal, type_name))

    async def _check(self, goal: _Goal, type_name: str) -> None:
        # A server that works on the goal says nothing until it is done.
        try:
            await asyncio.wait_for(self._ask_result(goal, type_name), CHECK_TIME)
        except asyncio.TimeoutError:
            return
        except CallError as error:
            if error.code == "vanished" and not goal.result.done():
                goal.result.set_exception(error)

    # Cancelling

    def _on_cancel(self, call: Call) -> Callable[[], Awaitable[Answer]]:
        id_, stamp = goals.which(self._converters, call.payload, call.encoding)
        self._check_right(call.caller, id_)
        if not self.is_there:
            raise CallError("unavailable", f"there is no action {self.ros} on the bus")
        return partial(self._cancel_for, call, id_, stamp)

    async def _cancel_for(self, call: Call, id_: bytes, stamp: dict[str, int]) -> Answer:
        canceling, response = await self._cancel(id_, stamp)
        if call.encoding in RAW:
            return Answer(response, call.encoding, f"{CANCEL}_Response")
        return Answer(
            VALUE_ENCODINGS[call.encoding].dumps({"goals_canceling": canceling}), call.encoding
        )

    def _check_right(self, caller: Session, id_: bytes) -> None:
        """Raises CallError when the caller may cancel only its own goals, and this is another's."""
        right = f"{self.base}/_cancel_any"
        if self.route.cancel == "any" or self._routes.owns(caller, id_):
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
        """Cancel a goal, or ALL up to a time; returns the ids of those that are
        cancelling, and the response."""
        request = self._converters.get(f"{CANCEL}_Request").from_dict(
            {"goal_info": {"goal_id": {"uuid": id_}, "stamp": stamp or {}}}
        )
        response = await self._requests.ask(f"{self.ros}{CANCEL_GOAL}", CANCEL, request)
        said = self._converters.get(f"{CANCEL}_Response").to_dict(response)
        canceling = [goals.id_of(info["goal_id"]).hex() for info in said["goals_canceling"]]
        if said["return_code"] in _NOT_CANCELLED:
            code, text = _NOT_CANCELLED[said["return_code"]]
            raise CallError(code, text)
        if not canceling and id_ != ALL:
            # rclpy's server says nothing worse of a goal that it refuses to cancel.
            raise CallError("rejected", "the action's server does not cancel it")
        return canceling, response

    async def _cancel_quietly(self, id_: bytes, why: str) -> None:
        try:
            await asyncio.wait_for(self._cancel(id_), self.route.timeout)
        except CallError as error:
            if error.code != "unknown_goal":
                log.warning("goal %s of %s is not cancelled: %s", id_.hex(), self.ros, error)
        except asyncio.TimeoutError:
            log.warning("goal %s of %s is not cancelled: no answer", id_.hex(), self.ros)
        else:
            log.info("goal %s of %s is cancelled: %s", id_.hex(), self.ros, why)

    def _cancel_unwanted(self, ids: list[bytes]) -> None:
        for id_ in ids:
            if id_ in self._unwanted:
                self._unwanted.remove(id_)
                why = "it was accepted when nobody waited for it any more"
                self._routes._tasks.begin(self._cancel_quietly(id_, why))

    def departed(self, session: Session) -> None:
        """The client has gone."""
        if not self.route.cancel_on_disconnect:
            return
        for goal in self._goals.values():
            if goal.owner is session and not goal.is_orphan:
                goal.is_orphan = True
                if goal.is_accepted:
                    self._cancel_orphan(goal)

    def _cancel_orphan(self, goal: _Goal) -> None:
        why = f"{goal.owner} has gone"
        self._routes._tasks.begin(self._cancel_quietly(goal.id, why))

    def stop(self) -> None:
        """The route was removed. Goals go on, and their results are published."""
        for endpoint in self._endpoints:
            self._dispatcher.unregister(endpoint)
        self.forget()
        try:
            self._routes._node.call_soon(self._close)
        except BusError:
            self._is_over = True

    def forget(self) -> None:
        """What is shown of the bus is not so any more."""
        self._dispatcher.publish(Message(f"{self.base}/_status", b"", 0, True))

    # The ROS thread

    def look(self, node: RosNode) -> None:
        """Subscribe when the type is known; see whether servers have come."""
        type_name = self.type
        if self._is_over or type_name is None:
            return
        servers = node.count(f"{self.ros}/_action/status")[0]
        if servers > self._servers and self._subscribed is not None:
            self._routes._post(self._routes.server_came, self.ros)
        self._servers = servers
        is_old = self._has_forgotten and self.is_there
        if type_name == self._subscribed and not is_old:
            return
        self._has_forgotten = False
        self._close_subscriptions()
        self._subscribed = type_name
        latched = QosProfile(durability=Durability.TRANSIENT_LOCAL, depth=1)
        status, feedback = f"{self.ros}/_action/status", f"{self.ros}/_action/feedback"
        try:
            own = node.subscribe_raw(status, STATUS, latched, self._on_status)
            self._subscriptions.append(own)
            on_feedback = partial(self._on_feedback, f"{type_name}_Feedback")
            own = node.subscribe_raw(
                feedback, f"{type_name}_FeedbackMessage", QosProfile(depth=BURST), on_feedback
            )
            self._subscriptions.append(own)
        except (BusError, UnknownTypeError) as error:
            self._counters.last_error = str(error)
            self._routes._post(log.error, "%s has no feedback: %s", self.ros, error)

    def _close(self) -> None:
        self._is_over = True
        self._close_subscriptions()
        self._take_back_status()

    def _take_back_status(self) -> None:
        """Behind what waits in the mailbox, which would be retained for good."""
        nothing = Message(f"{self.base}/_status", b"", 0, True)
        self._routes._mailbox.put(self._status_lane, nothing)

    def _close_subscriptions(self) -> None:
        for own in self._subscriptions:
            own.destroy()
        self._subscriptions.clear()

    def lost(self) -> None:
        """The bus is gone, and with it the subscriptions."""
        self._subscriptions.clear()
        self._subscribed = None
        self._servers = 0
        self._take_back_status()

    def _on_status(self, cdr: bytes) -> None:
        try:
            payload = goals.statuses(self._converters, cdr, self.route.encoding)
            late = goals.going_on(self._converters, cdr) if self._unwanted else []
        except ConversionError as error:
            self._counters.last_error = str(error)
            return
        if any(id_ in self._unwanted for id_ in late):
            self._routes._post(self._cancel_unwanted, late)
        self._put(self._status_lane, f"{self.base}/_status", payload, STATUS, retain=True)

    def _on_feedback(self, type_name: str, cdr: bytes) -> None:
        id_, feedback = goals.split_id(cdr, self._wire)
        try:
            payload = from_ros(self._converters, type_name, feedback, self.route.encoding)
        except (ConversionError, UnknownTypeError) as error:
            self._counters.last_error = str(error)
            return
        lane = self._lanes.pop(id_, None) or Lane(1, self._counted)
        self._lanes[id_] = lane
        if len(self._lanes) > LANES:
            self._lanes.popitem(last=False)
        topic = f"{self.base}/_feedback/{id_.hex()}"
        self._put(lane, topic, payload, type_name)

    def _put(
        self, lane: Lane, topic: str, payload: bytes, type_name: str, *, retain: bool = False
    ) -> None:
        properties: Properties = {
            Property.CONTENT_TYPE: CONTENT_TYPE[self.route.encoding],
            Property.USER_PROPERTY: [("ros-type", type_name)],
        }
        message = Message(topic, payload, int(retain), retain, properties)
        self._routes._mailbox.put(lane, message)


def _owner(caller: Session) -> str:
    """Whose goals a client's are: its user's, on whichever client; without one, its own."""
    identity = caller.identity
    if identity is None or identity.username is None:
        return f"client {caller.client_id}"
    return f"user {identity.username}"
