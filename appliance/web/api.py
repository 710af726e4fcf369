"""`/api/v1/…`: publish and call over HTTP, for programs that do not speak MQTT.

Who asks logs in as to MQTT, before its body is read, and is a client of MQTT for that one request
(`carried.py`). `status` and `routes` are calls of the verbs of these names.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import contextlib
import socket
import ssl
from collections.abc import Callable
from typing import Any, Final, TypeAlias

import orjson
from async_timeout import timeout

from appliance.broker.limits import Terms
from appliance.mqtt.codec import Properties, Property, reason_name
from appliance.mqtt.packets import Publish
from appliance.mqtt.reason import ProtocolError, ReasonCode
from appliance.mqtt.topics import check_topic
from appliance.net.http import RETRY_AFTER, HttpError, HttpRequest, HttpResponse
from appliance.net.layers import UpperLayer
from appliance.web.carried import CarriedClient, RefusedError, user_properties
from appliance.web.login import credentials
from appliance.web.site import Resource

PATH: Final = "/api/v1"

#: The most bytes of a body: larger messages are for MQTT, which takes them in portions.
LONGEST: Final = 1024 * 1024

#: The most bytes of an error that is an answer to a call, if its code is to be the status.
LONGEST_ERROR: Final = 16 * 1024

#: The most bytes of the topic of a call: that of its answer is longer by the ids in it.
LONGEST_CALLED: Final = 0xFFFF - 128

#: The most work that the values of a body may be, in the unit of `Cost`: of lists and objects a few
#: bytes are as much as a hundred of text, and everybody waits while they are read.
MOST_VALUES: Final = 100_000

#: Seconds for a call, and the most that may be asked for.
TIMEOUT: Final = 10.0
LONGEST_TIMEOUT: Final = 60.0

#: Seconds for all of a request: the login, which may be throttled, the body, and a call.
LONGEST_ANSWER: Final = 90.0

JSON: Final = "application/json"

#: What a reason code is over HTTP; others from 0x80 on are 400.
_STATUS: Final = {
    ReasonCode.NO_MATCHING_SUBSCRIBERS: 404,
    ReasonCode.UNSPECIFIED_ERROR: 500,
    ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR: 409,
    ReasonCode.NOT_AUTHORIZED: 403,
    ReasonCode.SERVER_UNAVAILABLE: 503,
    ReasonCode.SERVER_BUSY: 503,
    ReasonCode.SERVER_SHUTTING_DOWN: 503,
    ReasonCode.PACKET_TOO_LARGE: 413,
    ReasonCode.QUOTA_EXCEEDED: 503,
    ReasonCode.ADMINISTRATIVE_ACTION: 503,
    ReasonCode.CONNECTION_RATE_EXCEEDED: 503,
}

#: The same for the errors of calls; others are 502.
_CALL_STATUS: Final = {
    "bad_request": 400,
    "no_response_topic": 400,
    "not_authorized": 403,
    "not_found": 404,
    "unknown_goal": 404,
    "unknown_type": 404,
    "expired": 409,
    "rejected": 409,
    "too_large": 413,
    "too_many": 429,
    "unavailable": 503,
    "vanished": 503,
    "stopping": 503,
    "timeout": 504,
}

#: What is wrong with a body, in the words of calls; others are `bad_request`.
_BODY_ERRORS: Final = {408: "timeout", 413: "too_large", 503: "unavailable"}

#: Both ends of a new connection: `Listeners.carry`.
Carry: TypeAlias = Callable[
    [str, str, "ssl.SSLObject | None", Terms], "tuple[socket.socket, UpperLayer] | None"
]

#: The work of a JSON text by its values, or any number above the most that it may be: a number is
#: 1, some 0.1 µs, a text, a list or an object is 8.
Cost: TypeAlias = Callable[[bytes, int], int]


class Api:
    """The resources below `/api/v1`."""

    def __init__(
        self,
        carry: Carry,
        is_token: Callable[[bytes], bool],
        topic_of: Callable[[str], str],
        cost: Cost,
    ) -> None:
        """`topic_of` is where a verb is called."""
        self._cost = cost
        self._carry = carry
        self._is_token = is_token
        self._topic_of = topic_of

    @property
    def resources(self) -> dict[str, Resource]:
        """What is there, by its path."""
        return {
            f"{PATH}/status": Resource(self._verb("status")),
            f"{PATH}/routes": Resource(self._verb("routes")),
            f"{PATH}/publish": Resource(self._publish, ("POST",), takes_body=True),
            f"{PATH}/call": Resource(self._call, ("POST",), takes_body=True),
        }

    def _verb(self, name: str) -> Callable[[HttpRequest], Any]:
        async def respond(request: HttpRequest) -> HttpResponse:
            async def ask(client: CarriedClient) -> HttpResponse:
                return await _called(client, self._topic_of(name), b"", TIMEOUT)

            return await self._carried(request, ask)

        return respond

    async def _publish(self, request: HttpRequest) -> HttpResponse:
        async def publish(client: CarriedClient) -> HttpResponse:
            message = _message(await self._body(request))
            await client.publish(message)
            if not message.qos:
                return _json(202, {"code": 0, "reason": "sent"})
            code = ReasonCode.SUCCESS if client.is_subscribed else ReasonCode(0x10)
            return _json(200, {"code": int(code), "reason": reason_name(code)})

        return await self._carried(request, publish)

    async def _call(self, request: HttpRequest) -> HttpResponse:
        async def call(client: CarriedClient) -> HttpResponse:
            wanted = await self._body(request)
            topic = _topic(wanted, LONGEST_CALLED)
            timeout = _take(wanted, "timeout", (int, float), TIMEOUT)
            payload = _as_json(wanted.pop("payload", {}))
            _no_more(wanted)
            if not 0 < timeout <= LONGEST_TIMEOUT:
                raise HttpError(400, f"timeout: up to {LONGEST_TIMEOUT:g} s")
            return await _called(client, topic, payload, timeout)

        return await self._carried(request, call)

    async def _body(self, request: HttpRequest) -> dict[str, Any]:
        """The body, an object in JSON. Raises HttpError."""
        content_type = (request.get("content-type") or "").partition(";")[0].strip().lower()
        if content_type != JSON:
            raise HttpError(415, f"the body is {JSON}, and its Content-Type says so")
        body = await request.body(LONGEST)
        request.allow(2 * LONGEST_ANSWER)
        if self._cost(body, MOST_VALUES) > MOST_VALUES:
            raise HttpError(413, "the body has too many values; base64, or MQTT, takes more")
        try:
            found = orjson.loads(body)
        except ValueError as error:
            raise HttpError(400, f"the body is not JSON: {str(error)[:200]}") from None
        if not isinstance(found, dict):
            raise HttpError(400, "the body is an object in JSON")
        return found

    async def _carried(
        self, request: HttpRequest, work: Callable[[CarriedClient], Any]
    ) -> HttpResponse:
        """The answer of `work`, which is done as the client of MQTT that the sender is."""
        try:
            username, password = credentials(request)
        except ValueError as error:
            return _error(401, "login", str(error))
        if username is None and password is not None and not self._is_token(password):
            return _error(401, "login", "this is no token")  # and nobody either, if that is enough
        ends = self._carry(request.address, request.peer, request.tls, request.terms)
        if ends is None:
            return _error(503, "busy", "the limits allow no more connections now")
        own, other = ends

        async def carried() -> HttpResponse:
            async with CarriedClient(own, username, password) as client:
                request.charge(other)
                response: HttpResponse = await work(client)
                return response

        request.allow(2 * LONGEST_ANSWER)
        try:
            async with timeout(LONGEST_ANSWER):
                return await carried()
        except asyncio.TimeoutError:
            return _error(504, "timeout", f"not done within {LONGEST_ANSWER:g} s")
        except RefusedError as error:
            return _refused(error)
        except HttpError as error:
            return _error(error.status, _BODY_ERRORS.get(error.status, "bad_request"), str(error))
        except EOFError:
            return _error(503, "busy", "the connection has ended")


async def _called(
    client: CarriedClient, topic: str, payload: bytes, patience: float
) -> HttpResponse:
    try:
        async with timeout(patience):
            answer = await client.call(topic, payload, JSON)
    except asyncio.TimeoutError:
        return _error(504, "timeout", f"no answer from {topic} within {patience:g} s")
    if user_properties(answer).get("status") != "error":
        return HttpResponse(200, answer.payload, JSON)
    return HttpResponse(_status_of(answer.payload), answer.payload, JSON)


def _status_of(error: bytes) -> int:
    """The status for an answer that says what went wrong. Whoever may answer has written it."""
    code = None
    if len(error) <= LONGEST_ERROR:  # everybody waits while it is read
        with contextlib.suppress(ValueError, LookupError, TypeError):
            code = orjson.loads(error)["error"]["code"]
    return _CALL_STATUS.get(code, 502) if isinstance(code, str) else 502


def _message(wanted: dict[str, Any]) -> Publish:
    """The message of a body. Raises HttpError."""
    topic = _topic(wanted)
    qos = _take(wanted, "qos", int, 1)
    retain = _take(wanted, "retain", bool, False)
    expiry = _take(wanted, "expiry", int, None)
    content_type = _take(wanted, "content_type", str, None)
    sent_at = _take(wanted, "sent_at", (str, int, float), None)
    if qos not in (0, 1):
        raise HttpError(400, "qos: 0 or 1")
    if ("payload" in wanted) is ("base64" in wanted):
        raise HttpError(400, "either payload, which is sent as JSON, or base64, for bytes")
    if "payload" in wanted:
        payload = _as_json(wanted.pop("payload"))
        content_type = content_type or JSON
    else:
        try:
            payload = base64.b64decode(_take(wanted, "base64", str, ""), validate=True)
        except (binascii.Error, ValueError):
            raise HttpError(400, "base64: this is not base64") from None
    _no_more(wanted)
    properties: Properties = {}
    if content_type is not None:
        properties[Property.CONTENT_TYPE] = _text("content_type", content_type)
    if expiry is not None:
        if not 0 <= expiry < 1 << 32:
            raise HttpError(400, "expiry: seconds, from 0 on")
        properties[Property.MESSAGE_EXPIRY_INTERVAL] = expiry
    if sent_at is not None:
        properties[Property.USER_PROPERTY] = [("sent-at", _text("sent_at", str(sent_at)))]
    return Publish(topic, payload, qos, retain, properties=properties or None)


def _as_json(payload: object) -> bytes:
    """The payload as it is sent. Raises HttpError."""
    try:
        return orjson.dumps(payload)
    except TypeError as error:  # orjson reads what is nested more deeply than it writes
        raise HttpError(400, f"payload: {error}") from None


def _topic(wanted: dict[str, Any], longest: int = 0xFFFF) -> str:
    topic: str = _take(wanted, "topic", str, "")
    try:
        check_topic(topic)
        if len(topic.encode()) > longest:
            raise HttpError(400, f"topic: at most {longest} bytes")
    except (ProtocolError, ValueError) as error:
        raise HttpError(400, f"topic: {str(error)[:200]}") from None
    return topic


def _text(name: str, value: str) -> str:
    if len(value) > 256 or "\0" in value:
        raise HttpError(400, f"{name}: up to 256 characters")
    return value


def _take(wanted: dict[str, Any], name: str, kind: Any, default: Any) -> Any:
    """A value of this kind, which is removed. Raises HttpError."""
    value = wanted.pop(name, default)
    is_number = kind is not bool and isinstance(value, bool)  # which Python takes for a number
    if value is not default and (is_number or not isinstance(value, kind)):
        raise HttpError(400, f"{name}: not a value of the right kind")
    return value


def _no_more(wanted: dict[str, Any]) -> None:
    if wanted:
        raise HttpError(400, f"nobody knows the key {next(iter(wanted))[:100]!r}")


def _refused(error: RefusedError) -> HttpResponse:
    """What MQTT has refused."""
    try:
        code = ReasonCode(error.code)
    except ValueError:
        code = ReasonCode.UNSPECIFIED_ERROR
    status = _STATUS.get(code, 400)
    if error.login and status in (400, 403):
        status = 401
    return _error(status, reason_name(code), str(error) or reason_name(code), code=int(code))


def _error(status: int, name: str, message: str, **more: int) -> HttpResponse:
    """An error in the form of calls, with MQTT's reason code where there is one."""
    headers = (("Retry-After", str(RETRY_AFTER)),) if status in (429, 503) else ()
    return _json(status, {"error": {"code": name, "message": message}, **more}, headers)


def _json(status: int, value: object, headers: tuple[tuple[str, str], ...] = ()) -> HttpResponse:
    return HttpResponse(status, orjson.dumps(value), JSON, headers)
