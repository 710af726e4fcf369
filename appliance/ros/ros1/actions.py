"""Presents the actions of ROS 1 as those of ROS 2.

An action `/act` of actionlib has five topics: `goal` and `cancel` to its server, `status`,
`feedback` and `result` from it. The rest of the bridge uses ROS 2's `/act/_action/…`: the services
send_goal, cancel_goal and get_result, and the topics status and feedback (calls/actions.py). ROS 1
serializes without padding, so that an inner message is cut out of one message and put into another
unchanged. The id of a goal is text in ROS 1 and 16 bytes here.

Everything except the functions at the end is for the ROS thread.
"""

from __future__ import annotations

import hashlib
import logging
import re
import struct
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

from appliance.ros.node import BusError, QosProfile, RosSubscription
from appliance.ros.payload.converter import compile_converter
from appliance.ros.payload.definitions import (
    PACKED,
    PRIMITIVES,
    Array,
    Field,
    FieldType,
    Sequence,
    TypeDescription,
    UnknownTypeError,
)
from appliance.ros.ros1.types import STAMP

log = logging.getLogger(__name__)

HIDDEN = "/_action/"
CANCEL = "action_msgs/srv/CancelGoal"
STATUS = "action_msgs/msg/GoalStatusArray"

#: Results of an action that are cached, for clients that ask for theirs late.
MAX_RESULTS = 100

#: After so many status messages without a goal, its server does not know the goal.
MAX_MISSED = 3

#: The status of action_msgs/msg/GoalStatus by that of actionlib_msgs/GoalStatus: pending becomes
#: accepted, rejected aborted, recalled canceled, lost unknown.
_STATES = (1, 2, 5, 4, 6, 6, 3, 3, 5, 0)
_REJECTED = 5
_CANCELING = frozenset({2, 6, 7, 8})
_ENDED = frozenset({2, 3, 4, 5, 8, 9})

# Return codes of action_msgs/srv/CancelGoal.
_NONE, _UNKNOWN_GOAL, _GOAL_ENDED = 0, 2, 3


def _type(name: str, **fields: FieldType) -> TypeDescription:
    every = tuple(Field(field_name, type_) for field_name, type_ in fields.items())
    return TypeDescription(name, every, PACKED)


_INT8 = PRIMITIVES["int8"]
_UUID = _type("unique_identifier_msgs/msg/UUID", uuid=Array(PRIMITIVES["uint8"], 16))
_INFO = _type("action_msgs/msg/GoalInfo", goal_id=_UUID, stamp=STAMP)
_GOAL_STATUS = _type("action_msgs/msg/GoalStatus", goal_info=_INFO, status=_INT8)
_KNOWN = {
    type_.name: type_
    for type_ in (
        _INFO,
        _type(STATUS, status_list=Sequence(_GOAL_STATUS)),
        _type(f"{CANCEL}_Request", goal_info=_INFO),
        _type(f"{CANCEL}_Response", return_code=_INT8, goals_canceling=Sequence(_INFO)),
    )
}


def describe_action(name: str, load: Callable[[str], TypeDescription]) -> TypeDescription | None:
    """The description of a part of an action in ROS 2, such as `pkg/action/Name_Goal`; None for
    other types. `load` returns those of ROS 1, `pkg/msg/NameGoal`."""
    if name in _KNOWN:
        return _KNOWN[name]
    package, slash, rest = name.partition("/action/")
    if not slash:
        return None
    action, _, part = rest.partition("_")
    inside = f"{package}/msg/{action}"
    if part in ("Goal", "Result", "Feedback"):
        return load(f"{inside}{part}")
    if part == "SendGoal_Request":
        return _type(name, goal_id=_UUID, goal=load(f"{inside}Goal"))
    if part == "SendGoal_Response":
        return _type(name, accepted=PRIMITIVES["bool"], stamp=STAMP)
    if part == "GetResult_Request":
        return _type(name, goal_id=_UUID)
    if part == "GetResult_Response":
        return _type(name, status=_INT8, result=load(f"{inside}Result"))
    if part == "FeedbackMessage":
        return _type(name, goal_id=_UUID, feedback=load(f"{inside}Feedback"))
    raise UnknownTypeError(f"no {name}: an action has no such part")


def find_actions(types: dict[str, str], published: Iterable[str]) -> dict[str, str]:
    """The types `pkg/action/Name` of the actions that have a server, by their names.

    `types` are the types of all topics, `published` the topics that have a publisher.
    """
    found = {}
    for topic in published:
        name, is_result, _ = topic.rpartition("/result")
        type_name = types.get(topic, "")
        if is_result and topic.endswith("/result") and type_name.endswith("ActionResult"):
            package, _, message = type_name.partition("/msg/")
            found[name] = f"{package}/action/{message.removesuffix('ActionResult')}"
    return found


def services_of(actions: dict[str, str]) -> dict[str, list[str]]:
    """The services that these actions have in ROS 2, with their types."""
    found = {}
    for name, type_name in actions.items():
        found[f"{name}{HIDDEN}send_goal"] = [f"{type_name}_SendGoal"]
        found[f"{name}{HIDDEN}get_result"] = [f"{type_name}_GetResult"]
        found[f"{name}{HIDDEN}cancel_goal"] = [CANCEL]
    return found


class ActionPublisher(Protocol):
    """A publisher that knows which nodes are connected to it."""

    def reaches(self, nodes: Iterable[str]) -> bool:
        """Whether one of these nodes is connected."""

    def publish(self, cdr: bytes) -> None:
        """Publish a serialized message. Raises BusError."""

    def destroy(self) -> None:
        """End it."""


class ActionBus(Protocol):
    """The part of the node that actions use."""

    def now(self) -> int:
        """Nanoseconds since the epoch."""

    def call_soon(self, callback: Callable[[], None]) -> None:
        """Call `callback` on the ROS thread."""

    def action_type(self, action: str) -> str | None:
        """The type `pkg/action/Name` of an action; None when it has no server."""

    def action_servers(self, action: str) -> list[str]:
        """The nodes that serve an action."""

    def describe(self, type_name: str) -> TypeDescription:
        """The description of a type."""

    def subscribe_raw(
        self, topic: str, type_name: str, qos: QosProfile, callback: Callable[..., None]
    ) -> RosSubscription:
        """Call `callback` with each message."""

    def create_publisher(self, topic: str, type_name: str, qos: QosProfile) -> ActionPublisher:
        """Create a publisher of serialized messages."""


class ActionClients:
    """Clients of actions, presented as clients of ROS 2's three services, and the two topics."""

    def __init__(self, bus: ActionBus) -> None:
        self._bus = bus
        self._servers: dict[str, _ActionServer] = {}

    def create_client(self, service: str, type_name: str) -> ActionClient:
        """A client of `/act/_action/send_goal`, `cancel_goal` or `get_result`. Raises BusError,
        UnknownTypeError."""
        name, _, verb = service.partition(HIDDEN)
        server = self._servers.get(name)
        if server is None:
            action = self._bus.action_type(name)
            if action is None:
                raise BusError(f"{name} has no server")
            server = self._servers[name] = _ActionServer(self._bus, name, action)
        server.clients += 1
        methods = {
            "send_goal": server.send_goal,
            "get_result": server.get_result,
            "cancel_goal": server.cancel,
        }
        return ActionClient(self, server, methods[verb])

    def release(self, server: _ActionServer) -> None:
        """Release the server of a client that was destroyed."""
        server.clients -= 1
        if not server.clients:
            server.close()
            del self._servers[server.name]

    def subscribe(
        self, topic: str, type_name: str, callback: Callable[..., None]
    ) -> RosSubscription:
        """A subscription of `/act/_action/status` or `feedback`."""
        name, _, kind = topic.partition(HIDDEN)
        if kind == "status":
            last = b""

            def on_status(data: bytes) -> None:
                nonlocal last
                status = _if_readable(to_status, data)
                if status is not None and status != last:  # actionlib repeats it 5 times a second
                    last = status
                    callback(status)

            return self._bus.subscribe_raw(f"{name}/status", _STATUS, _QOS, on_status)

        def on_feedback(data: bytes) -> None:
            feedback = _if_readable(to_feedback, data)
            if feedback is not None:
                callback(feedback)

        message_type = f"{_message(type_name.removesuffix('_FeedbackMessage'))}ActionFeedback"
        return self._bus.subscribe_raw(f"{name}/feedback", message_type, _QOS, on_feedback)


class ActionClient:
    """A RosClient of one of the three services of an action."""

    def __init__(
        self,
        actions: ActionClients,
        server: _ActionServer,
        send: Callable[[bytes, Callable[[bytes], None]], Callable[[], None]],
    ) -> None:
        self._actions = actions
        self._server = server
        self._send = send
        self._is_over = False

    def is_ready(self) -> bool:
        return self._server.is_ready()

    def call(self, request: bytes, done: Callable[[bytes | BusError], None]) -> Callable[[], None]:
        def finish(response: bytes) -> None:
            if not self._is_over:
                done(response)

        return self._send(request, finish)

    def destroy(self) -> None:
        self._is_over = True
        self._actions.release(self._server)


_QOS = QosProfile(depth=10)
_STATUS = "actionlib_msgs/msg/GoalStatusArray"

# Called for a pending call when a message of the server has arrived. Returns the response of the
# call, or None to go on waiting.
_FindResponse = Callable[["_PendingCall"], bytes | None]


@dataclass(eq=False, slots=True)
class _PendingCall:
    """A call that waits for its response. `missed` counts status messages without its goal."""

    goal: str
    find_response: _FindResponse
    done: Callable[[bytes], None]
    missed: int = 0


@dataclass(eq=False, slots=True)
class _Results:
    """A cache of the newest results: the final status and the message of each goal."""

    by_goal: OrderedDict[str, tuple[int, bytes]] = field(default_factory=OrderedDict)

    def add(self, goal: str, status: int, result: bytes) -> None:
        self.by_goal[goal] = status, result
        if len(self.by_goal) > MAX_RESULTS:
            self.by_goal.popitem(last=False)


class _ActionServer:
    """The server of an action, as its messages show it."""

    def __init__(self, bus: ActionBus, name: str, type_name: str) -> None:
        self.name = name
        self.clients = 0
        self._bus = bus
        message = _message(type_name)
        self._no_result = compile_converter(bus.describe(f"{message}Result")).from_dict({})
        #: The status and the stamp of each goal that the server reports.
        self._goals: dict[str, tuple[int, bytes]] | None = None
        self._ids: dict[bytes, str] = {}
        self._results = _Results()
        self._calls: list[_PendingCall] = []
        self._endpoints: list[Any] = []
        try:
            for topic, kind, handle in (
                ("status", _STATUS, self._on_status),
                ("result", f"{message}ActionResult", self._on_result),
            ):
                callback = partial(self._handle_soon, handle)
                self._endpoints.append(bus.subscribe_raw(f"{name}/{topic}", kind, _QOS, callback))
            for topic, kind in (
                ("goal", f"{message}ActionGoal"),
                ("cancel", "actionlib_msgs/msg/GoalID"),
            ):
                self._endpoints.append(bus.create_publisher(f"{name}/{topic}", kind, _QOS))
        except BaseException:
            self.close()
            raise
        self._goal: ActionPublisher = self._endpoints[2]
        self._cancel: ActionPublisher = self._endpoints[3]

    def close(self) -> None:
        """Destroy the endpoints."""
        for endpoint in self._endpoints:
            endpoint.destroy()

    def is_ready(self) -> bool:
        """Whether the server is connected; a goal that is sent before would be lost."""
        servers = self._bus.action_servers(self.name)
        return (
            self._goals is not None
            and self._goal.reaches(servers)
            and self._cancel.reaches(servers)
        )

    def _handle_soon(self, handle: Callable[[bytes], None], data: bytes) -> None:
        self._bus.call_soon(partial(handle, data))

    # Calls

    def send_goal(self, request: bytes, done: Callable[[bytes], None]) -> Callable[[], None]:
        """Send a goal. The request is the id of the goal in 16 bytes, then the goal."""
        id_, goal = request[:16].hex(), request[16:]
        stamp = _stamp(self._bus.now())
        self._goal.publish(struct.pack("<I", 0) + stamp + _text("") + stamp + _text(id_) + goal)

        def find_response(call: _PendingCall) -> bytes | None:
            status = self._status(call.goal)
            return None if status is None else struct.pack("<?", status != _REJECTED) + stamp

        return self._begin(_PendingCall(id_, find_response, done))

    def get_result(self, request: bytes, done: Callable[[bytes], None]) -> Callable[[], None]:
        """Respond with the result of a goal once it has ended, or with the status unknown once the
        server has reported only other goals MAX_MISSED times."""

        def find_response(call: _PendingCall) -> bytes | None:
            ended = self._results.by_goal.get(call.goal)
            if ended is not None:
                return struct.pack("<b", _state(ended[0])) + ended[1]
            return struct.pack("<b", 0) + self._no_result if call.missed >= MAX_MISSED else None

        return self._begin(_PendingCall(self._text_of(request[:16]), find_response, done))

    def cancel(self, request: bytes, done: Callable[[bytes], None]) -> Callable[[], None]:
        """Cancel a goal; with 16 zeros for the id, all goals up to a time, and with the time 0 all
        goals. Responds when the server reports that it cancels them."""
        is_all = not any(request[:16])
        id_ = "" if is_all else self._text_of(request[:16])
        status = None if is_all else self._status(id_)
        if not is_all and (status is None or status in _ENDED):
            code = _UNKNOWN_GOAL if status is None else _GOAL_ENDED
            self._bus.call_soon(partial(done, struct.pack("<bI", code, 0)))
            return lambda: None
        until = request[16:24] if is_all else bytes(8)
        self._cancel.publish(until + _text(id_))
        is_meant = partial(_is_until, until)
        before = {goal for goal, (state, _) in (self._goals or {}).items() if state in _ENDED}

        def find_response(call: _PendingCall) -> bytes | None:
            goals = self._goals or {}
            if is_all:
                wanted = [
                    goal
                    for goal, (state, _) in goals.items()
                    if state in _CANCELING and goal not in before
                ]
                left = [state for state, stamp in goals.values() if is_meant(stamp)]
                if not wanted and any(state not in _ENDED for state in left):
                    return None
            else:
                now = self._status(id_)
                if now in _ENDED - _CANCELING or now is None:
                    return struct.pack("<bI", _GOAL_ENDED, 0)
                if now not in _CANCELING:
                    return None
                wanted = [id_]
            infos = (_uuid(goal) + goals.get(goal, (0, bytes(8)))[1] for goal in wanted)
            return struct.pack("<bI", _NONE, len(wanted)) + b"".join(infos)

        return self._begin(_PendingCall(id_, find_response, done), is_new=True)

    def _begin(self, call: _PendingCall, *, is_new: bool = False) -> Callable[[], None]:
        """Wait for the response. Past messages of the server count, unless the call `is_new`."""
        self._calls.append(call)
        if not is_new:
            self._bus.call_soon(partial(self._settle, [call]))

        def give_up() -> None:
            if call in self._calls:
                self._calls.remove(call)

        return give_up

    def _settle(self, calls: list[_PendingCall]) -> None:
        for call in calls:
            response = call.find_response(call) if call in self._calls else None
            if response is not None:
                self._calls.remove(call)
                call.done(response)

    def _status(self, goal: str) -> int | None:
        ended = self._results.by_goal.get(goal)
        if ended is not None:
            return ended[0]
        known = (self._goals or {}).get(goal)
        return None if known is None else known[0]

    def _text_of(self, id_: bytes) -> str:
        return self._ids.get(id_, id_.hex())

    # Messages of the server

    def _on_status(self, data: bytes) -> None:
        goals = _if_readable(read_status, data)
        if goals is None:
            return
        self._goals = {goal: (status, stamp) for goal, status, stamp in goals}
        self._ids = {_uuid(goal): goal for goal in self._goals}
        for call in self._calls:
            call.missed = 0 if call.goal in self._goals else call.missed + 1
        self._settle(list(self._calls))

    def _on_result(self, data: bytes) -> None:
        result = _if_readable(read_goal_message, data)
        if result is not None:
            self._results.add(*result)
            self._settle(list(self._calls))


# The messages


class _Cursor:
    """A position in a message. Reading beyond the end raises struct.error or IndexError."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.position = 0

    def number(self, code: str) -> int:
        (value,) = struct.unpack_from(f"<{code}", self.data, self.position)
        self.position += struct.calcsize(f"<{code}")
        assert isinstance(value, int)
        return value

    def take(self, size: int) -> bytes:
        end = self.position + size
        if end > len(self.data):
            raise IndexError("the message is cut off")
        found = self.data[self.position : end]
        self.position = end
        return found

    def text(self) -> str:
        return self.take(self.number("I")).decode(errors="replace")

    def header(self) -> None:
        """Skip a std_msgs/Header."""
        self.take(12)
        self.text()

    def status(self) -> tuple[str, int, bytes]:
        """The goal's id, the status and the goal's stamp of an actionlib_msgs/GoalStatus."""
        stamp = self.take(8)
        goal, status = self.text(), self.number("B")
        self.text()
        return goal, status, stamp


def read_status(data: bytes) -> list[tuple[str, int, bytes]]:
    """The id, status and stamp of each goal in an actionlib_msgs/GoalStatusArray."""
    cursor = _Cursor(data)
    cursor.header()
    return [cursor.status() for _ in range(cursor.number("I"))]


def read_goal_message(data: bytes) -> tuple[str, int, bytes]:
    """The id and the status of the goal of a feedback or result, and the inner message."""
    cursor = _Cursor(data)
    cursor.header()
    goal, status, _ = cursor.status()
    return goal, status, data[cursor.position :]


def to_status(data: bytes) -> bytes:
    """Convert an actionlib_msgs/GoalStatusArray to an action_msgs/msg/GoalStatusArray."""
    goals = read_status(data)
    return struct.pack("<I", len(goals)) + b"".join(
        _uuid(goal) + stamp + struct.pack("<b", _state(status)) for goal, status, stamp in goals
    )


def to_feedback(data: bytes) -> bytes:
    """Convert a `NameActionFeedback` to a `Name_FeedbackMessage`."""
    goal, _, feedback = read_goal_message(data)
    return _uuid(goal) + feedback


def _if_readable(read: Callable[[bytes], Any], data: bytes) -> Any:
    try:
        return read(data)
    except (struct.error, IndexError) as error:
        log.debug("a message of an action cannot be read: %s", error)
        return None


def _state(status: int) -> int:
    return _STATES[status] if status < len(_STATES) else 0


def _uuid(goal: str) -> bytes:
    """The 16 bytes for the id of a goal. The ids of the bridge's own goals are their hex digits."""
    if re.fullmatch(r"[0-9a-f]{32}", goal):
        return bytes.fromhex(goal)
    return hashlib.blake2b(goal.encode(), digest_size=16).digest()


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _stamp(nanoseconds: int) -> bytes:
    seconds, rest = divmod(nanoseconds, 1_000_000_000)
    return struct.pack("<II", seconds & 0xFFFFFFFF, rest)


def _is_until(until: bytes, stamp: bytes) -> bool:
    """Whether `stamp` is not after `until`, where 0 means always."""
    return not any(until) or struct.unpack("<II", stamp) <= struct.unpack("<II", until)


def _message(type_name: str) -> str:
    """`pkg/msg/Name` of `pkg/action/Name`."""
    return type_name.replace("/action/", "/msg/", 1)
