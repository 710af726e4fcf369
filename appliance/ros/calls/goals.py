"""Converts an action's messages for MQTT: goals, feedback, results, status, and cancels.

In JSON and CBOR a goal's id is 32 hex digits and its status a word. In ROS's own bytes they are the
messages of ROS 2, on ROS 1 serialized as there (ros1/actions.py): the answers to a goal and to
`_cancel` are `action_msgs/msg/GoalInfo`, which `_cancel` also takes, and
`action_msgs/srv/CancelGoal_Response`; a result is the whole response of `get_result`, and the
status is `action_msgs/msg/GoalStatusArray`.
"""

from __future__ import annotations

import base64
import binascii
from typing import Any

from appliance.ros.calls.dispatcher import Answer, CallError
from appliance.ros.payload.converter import ConversionError, Converters
from appliance.ros.payload.definitions import Serialization
from appliance.ros.payload.encodings.base import EncodingName
from appliance.ros.payload.encodings.registry import RAW, VALUE_ENCODINGS
from appliance.ros.payload.fallback import TooLargeError
from appliance.ros.payload.payloads import InputLimits

CANCEL = "action_msgs/srv/CancelGoal"
GOAL_INFO = "action_msgs/msg/GoalInfo"
STATUS = "action_msgs/msg/GoalStatusArray"

#: The id that stands for all goals.
ALL = bytes(16)

#: By the numbers of action_msgs/msg/GoalStatus.
STATES = ("unknown", "accepted", "executing", "canceling", "succeeded", "canceled", "aborted")

#: The numbers of the states of a goal that runs: accepted and executing.
_RUNNING = (1, 2)

_WHICH = (
    'say which goal: {"goal_id": "…"}, the 32 hex digits of its id; {"stamp": {"sec": …, '
    '"nanosec": …}} for all that were accepted until then; or {"all": true}'
)


# The 16 bytes of an id come first and are twice the largest alignment, so the message behind them
# has the alignment that it has by itself.


def with_id(goal: bytes, id_: bytes, serialization: Serialization) -> bytes:
    """The serialized request of `send_goal`, of a serialized goal and its id."""
    start = len(serialization.header)
    return goal[:start] + id_ + goal[start:]


def split_id(cdr: bytes, serialization: Serialization) -> tuple[bytes, bytes]:
    """The goal's id and the serialized feedback, out of a message with both."""
    start = len(serialization.header)
    return cdr[start : start + 16], cdr[:start] + cdr[start + 16 :]


def id_of(uuid: dict[str, str]) -> bytes:
    """The bytes of a `unique_identifier_msgs/msg/UUID`, as converters give it."""
    return base64.b64decode(uuid["uuid"])


def accepted(
    converters: Converters, id_: bytes, stamp: dict[str, int], encoding: EncodingName
) -> Answer:
    """The answer to a goal that was accepted."""
    if encoding in RAW:
        info = {"goal_id": {"uuid": id_}, "stamp": stamp}
        return Answer(converters.get(GOAL_INFO).from_dict(info), encoding, GOAL_INFO)
    value = {"goal_id": id_.hex(), "stamp": stamp}
    return Answer(VALUE_ENCODINGS[encoding].dumps(value), encoding)


def status_of(result: bytes, serialization: Serialization) -> str:
    """The status in a response of `get_result`."""
    start = len(serialization.header)
    return _state(result[start] if len(result) > start else 0)


def result(converters: Converters, action: str, cdr: bytes, encoding: EncodingName) -> bytes:
    """The payload of a response of `get_result`. Raises ConversionError."""
    if encoding in RAW:
        return cdr
    converter = converters.get(f"{action}_GetResult_Response")
    values = VALUE_ENCODINGS[encoding]
    response = values.values(converter, cdr)
    status = status_of(cdr, converter.description.serialization)
    return values.dumps({"status": status, "result": response["result"]})


def statuses(converters: Converters, cdr: bytes, encoding: EncodingName) -> bytes:
    """The payload of a server's status message. Raises ConversionError."""
    if encoding in RAW:
        return cdr
    goals: list[dict[str, Any]] = [
        {
            "goal_id": id_of(one["goal_info"]["goal_id"]).hex(),
            "status": _state(one["status"]),
            "stamp": one["goal_info"]["stamp"],
        }
        for one in converters.get(STATUS).to_dict(cdr)["status_list"]
    ]
    return VALUE_ENCODINGS[encoding].dumps(goals)


def running(converters: Converters, cdr: bytes) -> list[bytes]:
    """The ids of the running goals in a server's status message. Raises ConversionError."""
    return [
        id_of(one["goal_info"]["goal_id"])
        for one in converters.get(STATUS).to_dict(cdr)["status_list"]
        if one["status"] in _RUNNING
    ]


def which(
    converters: Converters, payload: bytes, encoding: EncodingName, limits: InputLimits
) -> tuple[bytes, dict[str, int]]:
    """The goals that a call of `_cancel` names: the id of one; or ALL with a time, for those that
    were accepted up to then, and with the time 0 for all. Raises CallError.

    With an id and a time ROS cancels that goal and all before it. Here that goal alone is
    cancelled: a client that sends back the answer to its goal means no other.
    """
    info = converters.get(GOAL_INFO)
    try:
        if encoding in RAW:
            goal_info = info.to_dict(payload)
            id_: object = id_of(goal_info["goal_id"])
        else:
            limits.check(payload, VALUE_ENCODINGS[encoding])
            value = VALUE_ENCODINGS[encoding].loads(payload)
            if value == {"all": True}:
                value = {"stamp": {}}
            if not isinstance(value, dict) or not value or value.keys() - {"goal_id", "stamp"}:
                raise CallError("bad_request", _WHICH)
            id_ = value.get("goal_id", ALL)
            if isinstance(id_, str):
                id_ = binascii.unhexlify(id_.replace("-", ""))
            goal_info = info.to_dict(info.from_dict({"stamp": value.get("stamp", {})}))
    except TooLargeError as error:
        raise CallError("too_large", str(error)) from None
    except ConversionError as error:
        raise CallError("bad_request", str(error)) from None
    except ValueError:
        raise CallError("bad_request", f"goal_id: {_WHICH}") from None
    if not isinstance(id_, bytes) or len(id_) != len(ALL):
        raise CallError("bad_request", f"goal_id: {_WHICH}")
    return id_, goal_info["stamp"] if id_ == ALL else {}


def _state(number: int) -> str:
    return STATES[number] if 0 <= number < len(STATES) else "unknown"
