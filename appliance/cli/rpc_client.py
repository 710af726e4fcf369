"""The RPC client of `appliance call`, `goal` and `param`, on top of the MQTT client.

Response topics are below `_reply/{client id}`, which works in both versions of MQTT and needs no
right to publish to other topics.
"""

from __future__ import annotations

import base64
import contextlib
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import orjson
import paho.mqtt.client as paho
from paho.mqtt.enums import MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from appliance.cli.mqtt_client import (
    ANSWER_TIMEOUT,
    ClientError,
    ConnectionSettings,
    MqttClient,
    RefusedError,
    lines_needed,
)

NO_MATCHING_SUBSCRIBERS = 0x10

#: Seconds between two checks of whether the user wants to stop.
STEP = 0.1

#: Seconds without a message after which all retained messages are assumed to have come.
QUIET = 0.5


class CallFailedError(ClientError):
    """The answer is an error; the message has its code and text."""


@dataclass(frozen=True)
class GoalOutcome:
    """The final status of a goal, `succeeded`, `canceled` or `aborted`, and its result as JSON."""

    status: str
    result: bytes


class RpcClient:
    """A connection for calls. Every failure is a ClientError; `close` ends it."""

    def __init__(self, target: ConnectionSettings) -> None:
        if not target.client_id:  # it has to be known: it is a level of the response topics
            target = replace(target, client_id=f"appliance-{secrets.token_hex(6)}")
        self._target = target
        self._is_v5 = target.version == MQTTProtocolVersion.MQTTv5
        self._received: list[paho.MQTTMessage] = []
        self._listening: set[str] = set()
        self._connection = MqttClient(target, self._received.append)

    def close(self) -> None:
        self._connection.close()

    def call(self, topic: str, payload: bytes, timeout: float) -> bytes:
        """Call with a JSON payload; returns the answer as JSON. Waits up to `timeout` seconds."""
        above = topic.rpartition("/")[0]
        replies = f"{above}/_reply/{self._target.client_id}"
        self._listen(f"{replies}/#", topic)
        token = secrets.token_hex(4)
        self._send(topic, token, payload, f"{replies}/{token}")

        def answer() -> paho.MQTTMessage | None:
            # Errors about the response topic itself are answered one level above it.
            return self._take(lambda to: to in (replies, f"{replies}/{token}"))

        message = self._wait_for(answer, timeout)
        if message is None:
            who = self._target.username or "this client"
            raise ClientError(
                f"no answer from {topic} within {timeout:g} s{self._version_hint()}. Through a "
                f"fleet's broker: is the robot online there, and may {who} read {replies}/#? "
                "mosquitto does not say that; the call may have been carried out"
            )
        value = decode(message)
        if isinstance(value, dict) and isinstance(value.get("error"), dict):
            error = value["error"]
            text = f"{error.get('code')}: {error.get('message')}"
            if error.get("code") == "bad_request" and not self._is_v5:
                text += "; MQTT 3.1.1 cannot say that this is JSON, where the route takes another"
            raise CallFailedError(text)
        return encode(value)

    def _listen(self, topic_filter: str, topic: str) -> None:
        if topic_filter in self._listening:
            return
        try:
            self._connection.subscribe([topic_filter], 1, retained=False)
        except RefusedError as error:
            raise error.advised(_as_ros_name(topic) or self._rights(topic)) from None
        self._listening.add(topic_filter)

    def _rights(self, topic: str) -> str:
        """Both that a caller needs, as either may be the first that is refused."""
        replies = f"{topic.rpartition('/')[0]}/_reply/%c"
        lines = [f"topic write {topic}/#", f"pattern read {replies}/#"]
        return lines_needed(self._target.username, lines)

    def _send(self, topic: str, token: str, payload: bytes, reply: str) -> None:
        properties = None
        if self._is_v5:
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
            properties.ResponseTopic = reply
            properties.CorrelationData = token.encode()
            properties.ContentType = "application/json"
        to = topic if self._is_v5 else f"{topic}/{token}"
        try:
            code: ReasonCode = self._connection.publish(to, payload, 1, False, properties)
        except RefusedError as error:
            raise error.advised(_as_ros_name(topic) or self._rights(topic)) from None
        if code.value == NO_MATCHING_SUBSCRIBERS:
            raise ClientError(
                f"nothing takes calls at {topic}: no route is for it, or it is not on the bus; "
                "`appliance routes` shows what is. Through a fleet's broker: the robot is offline, "
                f"or its link has no rule in `in` for this topic. {_as_ros_name(topic)}".rstrip()
            )

    def _version_hint(self) -> str:
        if self._is_v5:
            return ""
        return "; MQTT 3.1.1 cannot tell whether nothing takes the call, or it was not allowed"

    def _take(self, is_wanted: Callable[[str], bool]) -> paho.MQTTMessage | None:
        for message in self._received:
            if is_wanted(message.topic):
                self._received.remove(message)
                return message
        return None

    def _wait_for(
        self, find: Callable[[], paho.MQTTMessage | None], timeout: float | None
    ) -> paho.MQTTMessage | None:
        found: list[paho.MQTTMessage] = []

        def is_there() -> bool:
            message = find()
            found.extend([message] if message is not None else [])
            return bool(found)

        deadline = None if timeout is None else time.monotonic() + timeout
        return found[0] if self._connection.run(is_there, deadline, STEP) else None

    # Goals

    def goal(
        self,
        action: str,
        payload: bytes,
        *,
        accepted: Callable[[str], None],
        feedback: Callable[[bytes], None] | None,
        is_over: Callable[[], bool],
        timeout: float | None,
    ) -> GoalOutcome:
        """Send a goal to the action at that MQTT topic and follow it to its end.

        `accepted` is called with the goal's id, `feedback` with each feedback as JSON. When
        `is_over()` becomes true or `timeout` seconds have passed, the goal is cancelled. Raises
        CallFailedError when the goal or its cancellation is refused.
        """
        # Subscribe before the goal is sent, or the first feedback would be missed.
        topics = [f"{action}/_result/+"] + ([f"{action}/_feedback/+"] if feedback else [])
        try:
            self._connection.subscribe(topics, 1, retained=False)
        except RefusedError as error:
            advice = _as_ros_name(f"{action}/_goal")
            calls = [f"topic write {action}/{call}/#" for call in ("_goal", "_cancel")]
            lines = [f"topic read {action}/#", *calls]
            raise error.advised(advice or lines_needed(self._target.username, lines)) from None
        id_ = orjson.loads(self.call(f"{action}/_goal", payload, ANSWER_TIMEOUT))["goal_id"]
        accepted(id_)
        deadline = None if timeout is None else time.monotonic() + timeout
        is_cancelled = False
        result: paho.MQTTMessage | None = None

        def work() -> bool:
            nonlocal result
            batch, self._received[:] = self._received[:], []
            for message in batch:
                if message.topic == f"{action}/_result/{id_}":
                    result = message
                elif feedback is not None and message.topic == f"{action}/_feedback/{id_}":
                    feedback(shown(message))
            is_late = deadline is not None and time.monotonic() > deadline
            return result is not None or (not is_cancelled and (is_over() or is_late))

        try:
            self._connection.run(work, None, STEP)
            if result is None:
                is_cancelled = True
                self._cancel(action, id_)
                self._connection.run(work, time.monotonic() + ANSWER_TIMEOUT, STEP)
        except CallFailedError:
            raise
        except ClientError as error:
            where = f"{action}/_result/{id_}"
            raise ClientError(f"{error}; the goal may go on, its result is at {where}") from None
        if result is None:
            raise ClientError(f"goal {id_} is being cancelled, and there is no result yet")
        if content_type(result) in ("application/cdr", "application/x-ros1"):
            from appliance.ros.calls.goals import status_of
            from appliance.ros.payload.encodings.registry import RAW, named_encoding

            serialization = RAW[named_encoding(content_type(result)) or "cdr"]
            return GoalOutcome(status_of(bytes(result.payload), serialization), shown(result))
        value = decode(result)
        if "error" in value:
            raise CallFailedError(f"{value['error']['code']}: {value['error']['message']}")
        return GoalOutcome(value["status"], encode(value["result"]))

    def _cancel(self, action: str, id_: str) -> None:
        try:
            self.call(f"{action}/_cancel", orjson.dumps({"goal_id": id_}), ANSWER_TIMEOUT)
        except CallFailedError as error:
            if not str(error).startswith("unknown_goal"):  # it has ended meanwhile
                raise CallFailedError(f"goal {id_} goes on: {error}") from None

    # Parameters

    def parameters(self, topic_filter: str, timeout: float) -> dict[str, bytes]:
        """Retained values as JSON, by topic; waits up to `timeout` seconds for the first."""
        self._connection.subscribe([topic_filter], 1)
        self._connection.run(lambda: bool(self._received), time.monotonic() + timeout, STEP)
        if "+" in topic_filter:
            seen = 0
            while len(self._received) > seen:
                seen = len(self._received)
                self._connection.run(lambda: False, time.monotonic() + QUIET, STEP)
        return {m.topic: shown(m) for m in self._received if m.payload}


def _as_ros_name(topic: str) -> str:
    """A hint for a topic that lacks the robot, as if a ROS name had no slash; else ""."""
    name = topic.partition("/")[0]
    if "/_" not in topic or not topic.removeprefix(name).startswith("/_"):
        return ""
    return f"A ROS name begins with a slash; did you mean /{name}?"


def content_type(message: paho.MQTTMessage) -> str | None:
    """The content type of the message; None without one, as in MQTT 3.1.1."""
    value = getattr(message.properties, "ContentType", None)
    return value if isinstance(value, str) else None


def decode(message: paho.MQTTMessage) -> Any:
    """Decode JSON or CBOR. Raises ClientError."""
    named, payload = content_type(message), bytes(message.payload)
    if named != "application/cbor":
        try:
            return orjson.loads(payload)
        except orjson.JSONDecodeError:
            pass
    if named in (None, "application/cbor"):
        from appliance.ros.payload.encodings import cbor
        from appliance.ros.payload.fallback import ConversionError

        with contextlib.suppress(ConversionError):
            return cbor.loads(payload)
    raise ClientError(f"{message.topic} has something else than {named or 'JSON or CBOR'}")


def shown(message: paho.MQTTMessage) -> bytes:
    """The message as JSON, or a description when it cannot be decoded."""
    try:
        return encode(decode(message))
    except ClientError:
        kind = content_type(message) or "of an unknown encoding"
        return f"({kind}, {len(message.payload)} bytes)".encode()


def encode(value: Any) -> bytes:
    """One line of JSON; byte strings of CBOR become base64."""

    def to_base64(value: object) -> str:
        if isinstance(value, bytes):
            return base64.b64encode(value).decode()
        return str(value)

    return orjson.dumps(value, to_base64)
