"""ROS 1's actions, seen as ROS 2's.

actionlib makes an action `/act` of five topics: `goal` and `cancel` to its server, `status`,
`feedback` and `result` from it. Everybody else here knows ROS 2's `/act/_action/…`: the services
send_goal, cancel_goal and get_result, the topics status and feedback (actions.py). In ROS 1 a value
follows the other without padding, so that what is inside a message is cut out of it and put into
another as it stands; a goal's id is text there and 16 bytes here.

Everything but the functions at the end is for the ROS thread.
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

#: Results that are kept for who asks late, of one action.
MAX_RESULTS = 100

#: Messages of status without a goal, after which its server does not know it.
MAX_MISSED = 3

#: By the numbers of actionlib_msgs/GoalStatus, those of action_msgs/msg/GoalStatus: pending is
#: accepted, rejected is aborted, recalled is canceled, lost is unknown.
_STATES = (1, 2, 5, 4, 6, 6, 3, 3, 5, 0)
_REJECTED = 5
_CANCELING = frozenset({2, 6, 7, 8})
_ENDED = frozenset({2, 3, 4, 5, 8, 9})

# The numbers of action_msgs/srv/CancelGoal.
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
    """The description of what an action is made of in ROS 2, `pkg/action/Name_Goal` and so on; None
    for other types. `load` gives those of ROS 1, `pkg/msg/NameGoal`."""
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

    `types` are those of all topics, `published` those that somebody publishes.
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
    """The services that these actions have in ROS 2."""
    found = {}
    for name, type_name in actions.items():
        found[f"{name}{HIDDEN}send_goal"] = [f"{type_name}_SendGoal"]
        found[f"{name}{HIDDEN}get_result"] = [f"{type_name}_GetResult"]
        found[f"{name}{HIDDEN}cancel_goal"] = [CANCEL]
    return found


class ActionPublisher(Protocol):
    """A publisher that knows who is connected."""

    def reaches(self, nodes: Iterable[str]) -> bool:
        """Whether one of these nodes is."""

    def publish(self, cdr: bytes) -> None:
        """Publish a serialized message. Raises BusError."""

    def destroy(self) -> None:
        """End it."""


class ActionBus(Protocol):
    """What is needed of the node."""

    def now(self) -> int:
        """Nanoseconds since the epoch."""

    def call_soon(self, callback: Callable[[], None]) -> None:
        """Call it on the ROS thread."""

    def action_type(self, action: str) -> str | None:
        """The type `pkg/action/Name` of an action, None when it has no server."""

    def action_servers(self, action: str) -> list[str]:
        """The nodes that serve an action."""

    def describe(self, type_name: str) -> TypeDescription:
        """What a type is made of."""

    def subscribe_raw(
        self, topic: str, type_name: str, qos: QosProfile, callback: Callable[..., None]
    ) -> RosSubscription:
        """Call `callback` with each message."""

    def create_publisher(self, topic: str, type_name: str, qos: QosProfile) -> ActionPublisher:
        """Make a publisher of serialized messages."""


class ActionClients:
    """The clients of actions, as clients of ROS 2's three services, and their two topics."""

    def __init__(self, bus: ActionBus) -> None:
        self._bus = bus
        self._servers: dict[str, _ActionServer] = {}

    def create_client(self, service: str, type_name: str) -> ActionClient:
        """A client of `/act/_action/send_goal` and its like. Raises BusError, UnknownTypeError."""
        name, _, verb = service.partition(HIDDEN)
        server = self._servers.get(name)
        if server is None:
            action = self._bus.action_type(name)
            if action is None:
                raise BusError(f"{name} has no server")
            server = self._servers[name] = _ActionServer(self._bus, name, action)
        server.clients += 1
        ways = {
            "send_goal": server.send_goal,
            "get_result": server.get_result,
            "cancel_goal": server.cancel,
        }
        return ActionClient(self, server, ways[verb])

    def release(self, server: _ActionServer) -> None:
        """A client has ended."""
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
                told = _if_readable(to_status, data)
                if told is not None and told != last:  # actionlib says it five times a second
                    last = told
                    callback(told)

            return self._bus.subscribe_raw(f"{name}/status", _STATUS, _QOS, on_status)

        def on_feedback(data: bytes) -> None:
            told = _if_readable(to_feedback, data)
            if told is not None:
                callback(told)

        message_type = f"{_message(type_name.removesuffix('_FeedbackMessage'))}ActionFeedback"
        return self._bus.subscribe_raw(f"{name}/feedback", message_type, _QOS, on_feedback)


class ActionClient:
    """A RosClient."""

    def __init__(
        self,
        actions: ActionClients,
        server: _ActionServer,
        ask: Callable[[bytes, Callable[[bytes], None]], Callable[[], None]],
    ) -> None:
        self._actions = actions
        self._server = server
        self._ask = ask
        self._is_over = False

    def is_ready(self) -> bool:
        return self._server.is_ready()

    def call(self, request: bytes, done: Callable[[bytes | BusError], None]) -> Callable[[], None]:
        def finish(response: bytes) -> None:
            if not self._is_over:
                done(response)

        return self._ask(request, finish)

    def destroy(self) -> None:
        self._is_over = True
        self._actions.release(self._server)


_QOS = QosProfile(depth=10)
_STATUS = "actionlib_msgs/msg/GoalStatusArray"

# A call is asked for a response, given its goal, when something has come from the server: the
# response, or None to go on waiting.
_FindResponse = Callable[["_PendingCall"], bytes | None]


@dataclass(eq=False, slots=True)
class _PendingCall:
    """A call under way; `missed` counts messages of status without its goal."""

    goal: str
    look: _FindResponse
    done: Callable[[bytes], None]
    missed: int = 0


@dataclass(eq=False, slots=True)
class _Results:
    """The newest results, by goal: the number of its status, and the message."""

    kept: OrderedDict[str, tuple[int, bytes]] = field(default_factory=OrderedDict)

    def add(self, goal: str, status: int, result: bytes) -> None:
        self.kept[goal] = status, result
        if len(self.kept) > MAX_RESULTS:
            self.kept.popitem(last=False)


class _ActionServer:
    """An action's server, as it is seen from here."""

    def __init__(self, bus: ActionBus, name: str, type_name: str) -> None:
        self.name = name
        self.clients = 0
        self._bus = bus
        message = _message(type_name)
        self._no_result = compile_converter(bus.describe(f"{message}Result")).from_dict({})
        #: Of each goal that the server tells of: the number of its status, and its stamp.
        self._goals: dict[str, tuple[int, bytes]] | None = None
        self._ids: dict[bytes, str] = {}
        self._results = _Results()
        self._calls: list[_PendingCall] = []
        self._parts: list[Any] = []
        try:
            for topic, kind, handle in (
                ("status", _STATUS, self._on_status),
                ("result", f"{message}ActionResult", self._on_result),
            ):
                soon = partial(self._soon, handle)
                self._parts.append(bus.subscribe_raw(f"{name}/{topic}", kind, _QOS, soon))
            for topic, kind in (
                ("goal", f"{message}ActionGoal"),
                ("cancel", "actionlib_msgs/msg/GoalID"),
            ):
                self._parts.append(bus.create_publisher(f"{name}/{topic}", kind, _QOS))
        except BaseException:
            self.close()
            raise
        self._goal: ActionPublisher = self._parts[2]
        self._cancel: ActionPublisher = self._parts[3]

    def close(self) -> None:
        """End it."""
        for part in self._parts:
            part.destroy()

    def is_ready(self) -> bool:
        """Whether the server is connected: a goal before that would be lost."""
        servers = self._bus.action_servers(self.name)
        return (
            self._goals is not None
            and self._goal.reaches(servers)
            and self._cancel.reaches(servers)
        )

    def _soon(self, handle: Callable[[bytes], None], data: bytes) -> None:
        self._bus.call_soon(partial(handle, data))

    # What is asked

    def send_goal(self, request: bytes, done: Callable[[bytes], None]) -> Callable[[], None]:
        """A goal: its id in 16 bytes, then itself."""
        id_, goal = request[:16].hex(), request[16:]
        stamp = _stamp(self._bus.now())
        self._goal.publish(struct.pack("<I", 0) + stamp + _text("") + stamp + _text(id_) + goal)

        def look(call: _PendingCall) -> bytes | None:
            status = self._status(call.goal)
            return None if status is None else struct.pack("<?", status != _REJECTED) + stamp

        return self._begin(_PendingCall(id_, look, done))

    def get_result(self, request: bytes, done: Callable[[bytes], None]) -> Callable[[], None]:
        """The result of a goal, when it has ended; that the server does not know it, when it keeps
        telling of others only."""

        def look(call: _PendingCall) -> bytes | None:
            ended = self._results.kept.get(call.goal)
            if ended is not None:
                return struct.pack("<b", _state(ended[0])) + ended[1]
            return struct.pack("<b", 0) + self._no_result if call.missed >= MAX_MISSED else None

        return self._begin(_PendingCall(self._text_of(request[:16]), look, done))

    def cancel(self, request: bytes, done: Callable[[bytes], None]) -> Callable[[], None]:
        """Cancel a goal; or for 16 zeros all up to a time, all there are for the time 0. It is
        answered when the server tells that it does."""
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

        def look(call: _PendingCall) -> bytes | None:
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

        return self._begin(_PendingCall(id_, look, done), is_new=True)

    def _begin(self, call: _PendingCall, *, is_new: bool = False) -> Callable[[], None]:
        """Wait for the server; what it has said already counts, unless the question `is_new`."""
        self._calls.append(call)
        if not is_new:
            self._bus.call_soon(partial(self._settle, [call]))

        def give_up() -> None:
            if call in self._calls:
                self._calls.remove(call)

        return give_up

    def _settle(self, calls: list[_PendingCall]) -> None:
        for call in calls:
            response = call.look(call) if call in self._calls else None
            if response is not None:
                self._calls.remove(call)
                call.done(response)

    def _status(self, goal: str) -> int | None:
        ended = self._results.kept.get(goal)
        if ended is not None:
            return ended[0]
        known = (self._goals or {}).get(goal)
        return None if known is None else known[0]

    def _text_of(self, id_: bytes) -> str:
        return self._ids.get(id_, id_.hex())

    # What the server says

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
        told = _if_readable(read_goal_message, data)
        if told is not None:
            self._results.add(*told)
            self._settle(list(self._calls))


# The messages


class _Cursor:
    """A position in a message. What is not there raises struct.error or IndexError."""

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
        """Pass a std_msgs/Header."""
        self.take(12)
        self.text()

    def status(self) -> tuple[str, int, bytes]:
        """A actionlib_msgs/GoalStatus: the goal's id, the number, the stamp of the goal."""
        stamp = self.take(8)
        goal, status = self.text(), self.number("B")
        self.text()
        return goal, status, stamp


def read_status(data: bytes) -> list[tuple[str, int, bytes]]:
    """What an actionlib_msgs/GoalStatusArray says of each goal: id, status, stamp."""
    cursor = _Cursor(data)
    cursor.header()
    return [cursor.status() for _ in range(cursor.number("I"))]


def read_goal_message(data: bytes) -> tuple[str, int, bytes]:
    """What a feedback or result is of, the goal's status, and the message inside."""
    cursor = _Cursor(data)
    cursor.header()
    goal, status, _ = cursor.status()
    return goal, status, data[cursor.position :]


def to_status(data: bytes) -> bytes:
    """An action_msgs/msg/GoalStatusArray of an actionlib_msgs/GoalStatusArray."""
    goals = read_status(data)
    return struct.pack("<I", len(goals)) + b"".join(
        _uuid(goal) + stamp + struct.pack("<b", _state(status)) for goal, status, stamp in goals
    )


def to_feedback(data: bytes) -> bytes:
    """A `Name_FeedbackMessage` of a `NameActionFeedback`."""
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
    """The 16 bytes that stand for a goal's id: those of our own goals are its digits."""
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
    """Whether a time is not after another, 0 of which means always."""
    return not any(until) or struct.unpack("<II", stamp) <= struct.unpack("<II", until)


def _message(type_name: str) -> str:
    """`pkg/msg/Name` of `pkg/action/Name`."""
    return type_name.replace("/action/", "/msg/", 1)
