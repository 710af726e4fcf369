"""Dispatches calls of MQTT clients to endpoints, and answers each of them once.

A call is a message to a call topic such as `r2d2/reset/_call`. Its answer goes

- to the Response Topic of MQTT 5, with the call's Correlation Data; or
- for 3.1.1, where the caller appends a token of its choice as one more level,
  `r2d2/reset/_call/42`, to `r2d2/reset/_reply/{client id}/42`.

The appliance publishes the answer and may publish anywhere, so callers must not be able to misuse
it. A Response Topic must be one that the caller could publish to itself, or one below its own
`_reply/{client id}` that it may receive. A call that cannot be answered, for want of a Response
Topic or of the right to use it, is not carried out: the error goes to
`r2d2/reset/_reply/{client id}`, where the caller may find it, and to the log.

A call is JSON, CBOR or ROS's own bytes, as its content type says or else its route; its answer has
the same encoding. Both are converted in turn with those of others, see topics/conversions.py.

The calls under way are limited for each client, each user and in total. Calls that cancel goals
have slots of their own, which neither other calls nor other users can exhaust: a client can always
cancel the goals that it has sent. Everything here is for the event loop's thread.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, TypeAlias, TypeVar

from appliance.broker.broker import Broker
from appliance.broker.histogram import Histogram
from appliance.broker.link import ReceivingLink
from appliance.broker.message import Message
from appliance.broker.session import Session, publisher_of
from appliance.mqtt.codec import Property, encode_string, quote
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ProtocolError, ReasonCode
from appliance.net.callbacks import Entries
from appliance.ros.calls.replay_guard import ReplayGuard
from appliance.ros.payload.converter import TooLargeError
from appliance.ros.payload.encodings.base import EncodingName
from appliance.ros.payload.encodings.registry import (
    CONTENT_TYPE,
    ENCODINGS,
    VALUE_ENCODINGS,
    named_encoding,
)
from appliance.ros.payload.payloads import InputLimits
from appliance.ros.topics.conversions import LITTLE, ConversionQueue, user_of
from appliance.ros.topics.staleness import SENT_AT, stated_age

log = logging.getLogger(__name__)

CLIENT_ID = "_calls"

#: Why a call has failed; the message beside it has the details.
ErrorCode: TypeAlias = Literal[
    "bad_request",  # the payload, or the message, is not what the endpoint expects
    "expired",  # it was sent too long before it arrived
    "no_response_topic",  # there is no way to answer
    "not_authorized",  # the caller may not use that Response Topic, or not make that call
    "too_large",  # the payload is larger than what is converted
    "too_many",  # the caller, or all together, have too many calls under way
    "unavailable",  # there is no such service, action or node on the bus
    "vanished",  # there was, and it went away before it answered
    "timeout",  # no answer within the route's time
    "rejected",  # the node has refused
    "unknown_goal",  # the action's server knows of no such goal, or it has ended
    "unknown_type",  # the type is not installed here
    "ros_error",  # ROS itself refused, or is not there
    "not_found",  # the appliance knows no such client, user or certificate
    "failed",  # the appliance could not do it
    "stopping",  # the appliance stops
]


#: Encodings of calls that are no ROS messages; calls that are may be ROS's own bytes too.
WITHOUT_RAW: tuple[EncodingName, ...] = tuple(VALUE_ENCODINGS)

#: Seconds between two log lines about failed calls at the same topic.
REPORT_INTERVAL = 60.0


#: Bytes that take a microsecond or so to convert, and count as one unit of the broker's
#: `Counters.cost`: the scheduler lets a client that sends much wait for the others.
BYTES_PER_COST_UNIT = 16

#: The most bytes of a topic, as of every string in MQTT.
MAX_TOPIC_BYTES = 0xFFFF

#: The most payload bytes of all calls under way, and of those of one user.
MAX_BYTES = 64 * 1024 * 1024
MAX_USER_BYTES = MAX_BYTES // 4

T = TypeVar("T")
K = TypeVar("K")


class CallError(Exception):
    """A call has failed: `code` is for programs, the message for people."""

    def __init__(self, code: ErrorCode, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a call: a payload with its encoding, and its ROS type if it is a message."""

    payload: bytes
    encoding: EncodingName
    type: str | None = None


@dataclass(frozen=True, slots=True)
class CallLimits:
    """The most calls under way, and as many goals, of one client, in total, and of one user (None:
    a quarter of the total); and the limits on one call's payload."""

    client: int = 20
    total: int = 500
    user: int | None = None
    input: InputLimits = field(default_factory=InputLimits)
    #: Where these are set in appliance.yaml; empty for limits that are not.
    section: str = "bridge.limits"

    @property
    def share(self) -> int:
        """The most calls under way of one user."""
        return max(1, self.total // 4) if self.user is None else self.user


@dataclass(frozen=True, slots=True)
class Slot:
    """A slot that a client of this user has acquired."""

    client: Session
    user: str | None


class ConcurrencyLimiter:
    """Limits what is under way by client, by user and in total; `what` is its name, in the plural.

    With `ignore_total`, the slots of other users never exhaust those of a user.
    """

    def __init__(self, what: str, *, ignore_total: bool = False) -> None:
        self._what = what
        self._ignores_total = ignore_total
        self._clients: Counter[Session] = Counter()
        self._users: Counter[str | None] = Counter()
        self._total = 0

    def __contains__(self, client: Session) -> bool:
        return client in self._clients

    def __len__(self) -> int:
        return self._total

    def check(self, client: Session, limits: CallLimits) -> None:
        """Raises CallError when there is no slot left for the client."""
        if self._clients[client] >= limits.client:
            raise self._full(limits, limits.client, "this client", "calls_per_client")
        user = user_of(client)
        if self._users[user] >= limits.share:
            whose = "the clients without a user" if user is None else f"the user {quote(user)}"
            raise self._full(limits, limits.share, whose, "calls_per_user")
        if self._total >= limits.total and not self._ignores_total:
            raise self._full(limits, limits.total, "all clients", "calls")

    def _full(self, limits: CallLimits, count: int, whose: str, key: str) -> CallError:
        text = f"{count} {self._what} of {whose} are under way, as many as may be"
        return CallError("too_many", f"{text} ({limits.section}.{key})" if limits.section else text)

    def acquire(self, client: Session) -> Slot:
        """Acquire a slot that `check` has found to be free."""
        slot = Slot(client, user_of(client))
        self._total += 1
        self._clients[slot.client] += 1
        self._users[slot.user] += 1
        return slot

    def release(self, slot: Slot) -> None:
        """Release a slot."""
        self._total -= 1
        _subtract(self._clients, slot.client, 1)
        _subtract(self._users, slot.user, 1)


@dataclass(eq=False, slots=True)
class CallCounters:
    """What is counted of a route since its start; `errors` are by code."""

    calls: int = 0
    answers: int = 0
    under_way: int = 0
    errors: Counter[str] = field(default_factory=Counter)
    last_error: str | None = None
    #: How long calls took that had a slot, answered or not.
    duration: Histogram = field(default_factory=Histogram)


@dataclass(eq=False, slots=True)
class Call:
    """One call that can be answered.

    `topic` is without the token. `reply` is the answer as far as it is known beforehand: its topic,
    QoS and Correlation Data. `encoding` is that of the payload and of the answer;
    `encoding_note` ends the error of a payload whose content type was not understood.
    """

    caller: Session
    payload: bytes
    topic: str
    reply: Message
    encoding: EncodingName
    encoding_note: str = ""
    has_timed_out: bool = False
    begun_at: float = 0.0
    slot: Slot | None = None
    timer: asyncio.TimerHandle | None = None
    task: asyncio.Task[None] | None = None


#: Converts a call at once and returns a function that finds its answer. Both raise CallError.
Handler: TypeAlias = Callable[[Call], Callable[[], Awaitable[Answer]]]


@dataclass(eq=False, slots=True)
class CallEndpoint:
    """What is called under a topic, and its handler.

    `name` is for the log and for errors. `timeout` is in seconds. `encoding` is that of calls that
    name none, and `encodings` are those that are accepted. `max_bytes` limits the payload. Calls
    that cancel goals (`is_cancel`) have slots of their own. `fault` is the code of an answer that a
    fault has prevented.
    """

    topic: str
    name: str
    timeout: float
    counters: CallCounters
    handle: Handler
    encoding: EncodingName = "json"
    encodings: tuple[EncodingName, ...] = WITHOUT_RAW
    max_bytes: int | None = None
    is_cancel: bool = False
    fault: ErrorCode = "ros_error"


MessageHandler: TypeAlias = Callable[[Session, Message], None]


class CallDispatcher:
    """Receives calls from MQTT, dispatches them to endpoints and publishes the answers."""

    def __init__(
        self,
        broker: Broker,
        entries: Entries,
        conversions: ConversionQueue,
        client_id: str = CLIENT_ID,
    ) -> None:
        """`client_id` is that of its session inside the broker."""
        self.limits = CallLimits()
        self._client_id = client_id
        self.conversions = conversions
        self._replay_guard = ReplayGuard()
        self._broker = broker
        self._entries = entries
        self._loop = entries.loop
        self._session: Session | None = None
        #: The handlers of messages, by the identifier of the subscription that matched.
        self._handlers: dict[int, MessageHandler] = {}
        self._identifiers: dict[str, int] = {}
        self._last_identifier = 0
        #: By topic; the first is called, the others take its place once it is unregistered.
        self._endpoints: dict[str, list[CallEndpoint]] = {}
        self._slots = ConcurrencyLimiter("calls")
        self._cancel_slots = ConcurrencyLimiter("calls that cancel goals", ignore_total=True)
        self._calls: dict[Call, CallEndpoint] = {}
        self._bytes: Counter[str | None] = Counter()
        self._next_log: dict[str, float] = {}

    def start(self) -> None:
        """Subscribe to calls."""
        self._session = self._broker.attach(self._client_id, ReceivingLink(self._receive))
        self._broker.departures.append(self._replay_guard.departed)
        for topic_filter in self._identifiers:
            self._subscribe_session(topic_filter)

    async def stop(self) -> None:
        """Answer calls under way with `stopping`, and leave the broker; may be called twice."""
        for topic in list(self._endpoints):
            del self._endpoints[topic]
            self._unsubscribe_calls(topic)
        for call in list(self._calls):
            if call.task is None:  # it is queued to be converted
                self._reject(call, _stopping())
        tasks = [call.task for call in self._calls if call.task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await asyncio.sleep(0)  # lets the answers be published
        session, self._session = self._session, None
        if session is not None:
            self._broker.departures.remove(self._replay_guard.departed)
            self._broker.detach(session)

    # Topics

    def subscribe(self, topic_filter: str, handler: MessageHandler) -> None:
        """Call `handler` with each message that a client publishes there, and its session."""
        self._last_identifier += 1
        self._identifiers[topic_filter] = self._last_identifier
        self._handlers[self._last_identifier] = handler
        self._subscribe_session(topic_filter)

    def _subscribe_session(self, topic_filter: str) -> None:
        if self._session is not None:
            # QoS 0 loses nothing, as the link receives each message at once. Retained messages are
            # not sent: they may be old calls, which must not be carried out again.
            identifier = self._identifiers[topic_filter]
            subscription = Subscription(
                topic_filter, 0, no_local=True, retain_handling=2, identifier=identifier
            )
            self._broker.subscribe(self._session, subscription)

    def unsubscribe(self, topic_filter: str) -> None:
        """End a subscription."""
        del self._handlers[self._identifiers.pop(topic_filter)]
        if self._session is not None:
            self._broker.unsubscribe(self._session, topic_filter)

    def register(self, endpoint: CallEndpoint) -> None:
        """Dispatch calls at `endpoint.topic`, which may contain a `+`, to the endpoint."""
        endpoints = self._endpoints.setdefault(endpoint.topic, [])
        endpoints.append(endpoint)
        if len(endpoints) == 1:
            self._subscribe_calls(endpoint)
        else:
            text = "%s cannot be called: calls at %s are for %s"
            log.warning(text, endpoint.name, endpoint.topic, endpoints[0].name)

    def _subscribe_calls(self, endpoint: CallEndpoint) -> None:
        self.subscribe(
            endpoint.topic, lambda caller, message: self._dispatch(endpoint, caller, message, False)
        )
        self.subscribe(
            f"{endpoint.topic}/+",
            lambda caller, message: self._dispatch(endpoint, caller, message, True),
        )

    def unregister(self, endpoint: CallEndpoint) -> None:
        """End the dispatch of new calls to the endpoint; those under way are still answered."""
        endpoints = self._endpoints.get(endpoint.topic, [])
        if endpoint not in endpoints:
            return  # `stop` has removed all
        was_first = endpoints[0] is endpoint
        endpoints.remove(endpoint)
        if not endpoints:
            del self._endpoints[endpoint.topic]
            self._next_log.pop(endpoint.topic, None)
        if was_first:
            self._unsubscribe_calls(endpoint.topic)
            if endpoints:
                self._subscribe_calls(endpoints[0])

    def _unsubscribe_calls(self, topic: str) -> None:
        self.unsubscribe(topic)
        self.unsubscribe(f"{topic}/+")

    def _receive(self, message: Message, retain: bool, subscription_ids: list[int] | None) -> None:
        """Pass a message that a client has published to the handler of the subscription."""
        caller = publisher_of(message)
        if caller is None or not subscription_ids:
            return
        self._broker.counters.cost += len(message.payload) // BYTES_PER_COST_UNIT
        handler = self._handlers.get(subscription_ids[0])
        if handler is not None:
            handler(caller, message)

    def publish(self, message: Message) -> ReasonCode:
        """Publish as the appliance; returns 0x10 when there is no matching subscription."""
        if self._session is None:
            return ReasonCode.NO_MATCHING_SUBSCRIBERS
        code = self._broker.publish(message, self._session)
        self._broker.flush()
        return code

    def clear_retained(self, base: str, name: str, below: str) -> None:
        """Clear messages that a run that was killed has left retained.

        These are below `base`, in which `name` stands for any ROS name, and the rest of their topic
        matches the regular expression `below`.
        """
        start, _, end = base.partition(name)
        names = r"(/\w+)+" if name in base else ""
        left = re.compile(f"{re.escape(start)}{names}{re.escape(end)}/{below}")
        for topic, _ in list(self._broker.retained.find(f"{start}/#")):
            if left.fullmatch(topic):
                self.publish(Message(topic, b"", 0, True))

    def may_publish(self, caller: Session, topic: str) -> bool:
        """Whether the ACL in force lets the caller publish there."""
        try:
            return self._broker.route(caller, encode_string(topic)).allowed
        except ProtocolError:
            return False

    def now(self) -> float:
        """The time of the broker's clock, in seconds."""
        return self._broker.now

    # Calls

    def _dispatch(
        self, endpoint: CallEndpoint, caller: Session, message: Message, has_token: bool
    ) -> None:
        endpoint.counters.calls += 1
        topic, _, token = message.topic.rpartition("/") if has_token else (message.topic, "", "")
        own = f"{topic.rpartition('/')[0]}/_reply/{caller.client_id}"
        content_type = (message.properties or {}).get(Property.CONTENT_TYPE)
        named = named_encoding(content_type)
        encoding = named or endpoint.encoding
        try:
            reply = self._reply_for(caller, message, own, token)
        except CallError as error:
            fallback = Message(own, b"", 1) if _is_own_topic(caller, own) else None
            self._fail(endpoint, caller, fallback, encoding, error)
            return
        call = Call(caller, message.payload, topic, reply, encoding)
        if isinstance(content_type, str) and named is None:
            unknown = quote(content_type[:60])
            call.encoding_note = (
                f" (its content type {unknown} is unknown, it was read as {encoding})"
            )
        try:
            self._check_limits(endpoint, call, message)
        except CallError as error:
            self._fail(endpoint, caller, reply, encoding, error)
            return
        self._add(endpoint, call)
        self.conversions.do(caller, len(call.payload), partial(self._convert_call, endpoint, call))

    def _add(self, endpoint: CallEndpoint, call: Call) -> None:
        slots = self._cancel_slots if endpoint.is_cancel else self._slots
        call.slot = slots.acquire(call.caller)
        endpoint.counters.under_way += 1
        call.begun_at = self._loop.time()
        self._calls[call] = endpoint
        self._bytes[call.slot.user] += len(call.payload)
        call.timer = self._entries.later(
            "calls.timeout", endpoint.timeout, self._expire, call, served=endpoint.name
        )

    def _convert_call(self, endpoint: CallEndpoint, call: Call) -> None:
        """Convert a call, now that its turn has come, and start to find its answer."""
        if call not in self._calls:  # it has timed out
            return
        try:
            find_answer = endpoint.handle(call)
        except CallError as error:
            self._reject(call, error)
        except Exception as problem:  # a fault must not leave the caller without an answer
            self._entries.faults.caught("calls.take", problem, endpoint.name)
            self._reject(call, CallError(endpoint.fault, repr(problem)))
        else:
            call.task = self._entries.task(
                "calls.call", self._run(endpoint, call, find_answer), served=endpoint.name
            )
            self._entries.when_done("calls.end", call.task, self._remove, call)

    async def convert(self, caller: Session, size: int, work: Callable[[], T]) -> T:
        """The result of `work`, which converts `size` bytes, once it is the caller's turn."""
        done: asyncio.Future[T] = self._loop.create_future()

        def settle() -> None:
            if done.done():
                return
            try:
                done.set_result(work())
            except Exception as error:
                done.set_exception(error)

        self.conversions.do(caller, size, settle)
        return await done

    async def turn(self, caller: Session) -> None:
        """Wait until it is the caller's turn for a piece of other work. As of conversions, there is
        one piece per iteration of the event loop, and users take turns."""
        await self.convert(caller, LITTLE + 1, lambda: None)

    def _reply_for(self, caller: Session, message: Message, own: str, token: str) -> Message:
        """An empty answer with its topic and Correlation Data. Raises CallError."""
        properties = message.properties or {}
        topic = properties.get(Property.RESPONSE_TOPIC)
        correlation = properties.get(Property.CORRELATION_DATA)
        if not isinstance(topic, str):
            if not token:
                raise CallError(
                    "no_response_topic",
                    "there is no Response Topic, nor, for 3.1.1, a token as the topic's last "
                    f"level: publish to {message.topic}/TOKEN, and subscribe to {own}/TOKEN",
                )
            if not _is_level(caller.client_id):
                raise CallError(
                    "no_response_topic",
                    f"the client id {quote(caller.client_id)} cannot be a level of a topic",
                )
            topic = f"{own}/{token}"
            if not _is_own_topic(caller, topic):
                raise CallError("no_response_topic", "the topic of the answer would be too long")
        # A client `alice/1` has no topics of its own: `_reply/alice/1` is of the client `alice`.
        if _is_level(caller.client_id) and (topic == own or topic.startswith(f"{own}/")):
            if not self._broker.may_receive(caller, topic):
                raise CallError("not_authorized", f"the caller may not read {quote(topic)}")
        else:
            self._check_may_publish(caller, topic)
        echoed = {Property.CORRELATION_DATA: correlation} if correlation is not None else None
        return Message(topic, b"", max(1, message.qos), properties=echoed)

    def _check_may_publish(self, caller: Session, topic: str) -> None:
        try:
            route = self._broker.route(caller, encode_string(topic))
        except ProtocolError as error:
            raise CallError("bad_request", f"the Response Topic is not valid: {error}") from None
        if topic in self._broker.guards:
            # The answer would be published later, as a command of the appliance itself.
            raise CallError("not_authorized", f"{quote(topic)} is for commands, not for answers")
        if not route.allowed:
            raise CallError(
                "not_authorized",
                f"the caller may not publish to its Response Topic {quote(topic)}: {route.reason}",
            )

    def _check_limits(self, endpoint: CallEndpoint, call: Call, message: Message) -> None:
        """Raises CallError for a call that is not converted at all."""
        caller = call.caller
        if message.retain:
            raise CallError("bad_request", "a call must not be retained: it would be kept")
        self._check_age(endpoint, caller, message)
        size = len(call.payload)
        try:
            self.limits.input.check_size(size, ENCODINGS[call.encoding])
        except TooLargeError as error:
            raise CallError("too_large", str(error)) from None
        if endpoint.max_bytes is not None and size > endpoint.max_bytes:
            text = f"it has {size} bytes, {endpoint.name} takes {endpoint.max_bytes} at most"
            raise CallError("too_large", text)
        if endpoint.is_cancel:
            self._cancel_slots.check(caller, self.limits)
        else:
            self._slots.check(caller, self.limits)
            self._check_bytes(caller, size)
        if call.encoding not in endpoint.encodings:
            either = " or ".join(endpoint.encodings)
            text = f"a call of {endpoint.name} may be {either}, not {call.encoding}"
            raise CallError("bad_request", text)

    def _check_age(self, endpoint: CallEndpoint, caller: Session, message: Message) -> None:
        """Raises CallError for an old call: nobody waits for its answer, nor expects its effect.

        A call that cancels a goal stops an action, so it is carried out whatever age it claims,
        unless MQTT itself has expired it [MQTT-3.3.2-5].
        """
        is_expired = message.expires_at is not None and message.expires_at <= self._broker.now
        try:
            age = stated_age(message.properties, time.time())
        except ValueError as error:
            if not endpoint.is_cancel:
                raise CallError("bad_request", str(error)) from None
            age = 0.0
        if age is None:
            # Asked for cancels too, as each message tells the guard of the replay it is part of.
            is_old = self._replay_guard.is_old(message, caller, endpoint.timeout, self._loop.time())
            is_expired |= is_old and not endpoint.is_cancel
        elif age > endpoint.timeout and not endpoint.is_cancel:
            raise CallError("expired", f"it was sent {age:.1f} s before, by its {SENT_AT}")
        if is_expired:
            raise CallError("expired", "it was sent some time ago, before a connection was lost")

    def _check_bytes(self, caller: Session, size: int) -> None:
        own, total = self._bytes[user_of(caller)], self._bytes.total()
        if own and own + size > MAX_USER_BYTES:
            raise CallError("too_many", f"{own} bytes of calls of its user are under way")
        if total and total + size > MAX_BYTES:
            raise CallError("too_many", f"{total} bytes of calls of all clients are under way")

    async def _run(
        self, endpoint: CallEndpoint, call: Call, find_answer: Callable[[], Awaitable[Answer]]
    ) -> None:
        try:
            answer = await find_answer()
        except CallError as error:
            self._send_error(endpoint, call, error)
        except asyncio.CancelledError:
            self._send_error(endpoint, call, _ended(endpoint, call))
        except Exception as problem:  # a fault must not leave the caller without an answer
            self._entries.faults.caught("calls.handle", problem, endpoint.name)
            self._send_error(endpoint, call, CallError(endpoint.fault, repr(problem)))
        else:
            endpoint.counters.answers += 1
            user_properties = [("status", "ok")]
            if answer.type is not None:
                user_properties.append(("ros-type", answer.type))
            self._answer(call.reply, answer.payload, answer.encoding, user_properties)

    def _expire(self, call: Call) -> None:
        """Answer a call that has run into its timeout."""
        call.has_timed_out = True
        if call.task is not None:
            call.task.cancel()
        elif call in self._calls:  # it is still queued to be converted
            self._reject(call, _timeout(self._calls[call]))

    def _reject(self, call: Call, error: CallError) -> None:
        """Answer a call with an error before its handler has a task."""
        self._send_error(self._calls[call], call, error)
        self._remove(call)

    def _remove(self, call: Call) -> None:
        endpoint = self._calls.pop(call)
        if call.timer is not None:
            call.timer.cancel()
        endpoint.counters.under_way -= 1
        endpoint.counters.duration.observe(self._loop.time() - call.begun_at)
        assert call.slot is not None
        _subtract(self._bytes, call.slot.user, len(call.payload))
        (self._cancel_slots if endpoint.is_cancel else self._slots).release(call.slot)
        if call.task is not None and call.task.cancelled():  # before it has run
            self._send_error(endpoint, call, _ended(endpoint, call))

    def _send_error(self, endpoint: CallEndpoint, call: Call, error: CallError) -> None:
        if error.code == "bad_request" and call.encoding_note:
            error = CallError(error.code, f"{error}{call.encoding_note}")
        self._fail(endpoint, call.caller, call.reply, call.encoding, error)

    def _fail(
        self,
        endpoint: CallEndpoint,
        caller: Session,
        reply: Message | None,
        encoding: EncodingName,
        error: CallError,
    ) -> None:
        counters = endpoint.counters
        counters.errors[error.code] += 1
        counters.last_error = f"{error.code}: {error}"
        now = self._loop.time()
        if now >= self._next_log.get(endpoint.topic, 0.0):
            self._next_log[endpoint.topic] = now + REPORT_INTERVAL
            count = sum(counters.errors.values())
            text = "a call of %s by %s failed (%d so far): %s: %s"
            log.warning(text, endpoint.name, caller, count, error.code, error)
        if reply is not None:
            # In a later round of the loop: the caller's chunk is still being processed.
            user_properties = [("status", "error")]
            self._entries.soon(
                "calls.answer",
                self._answer,
                reply,
                *error_payload(error, encoding),
                user_properties,
            )

    def _answer(
        self,
        reply: Message,
        payload: bytes,
        encoding: EncodingName,
        user_properties: list[tuple[str, str]],
    ) -> None:
        properties = dict(reply.properties or {})
        properties[Property.CONTENT_TYPE] = CONTENT_TYPE[encoding]
        properties[Property.USER_PROPERTY] = user_properties
        self.publish(Message(reply.topic, payload, reply.qos, properties=properties))


def error_payload(
    error: CallError, encoding: EncodingName, **more: str
) -> tuple[bytes, EncodingName]:
    """The payload of an error, `{"error": {"code": …, "message": …}}`, and its encoding.

    ROS's own bytes cannot express an error: it is JSON then, which no CDR begins like.
    """
    details = {"code": error.code, "message": str(error)}
    readable = encoding if encoding in VALUE_ENCODINGS else "json"
    return VALUE_ENCODINGS[readable].dumps({**more, "error": details}), readable


def _is_level(client_id: str) -> bool:
    """Whether the id can be one level of a topic, as `_reply/{client id}` needs it."""
    return not set("/+#\0") & set(client_id)


def _is_own_topic(caller: Session, topic: str) -> bool:
    """Whether there can be such a topic: the caller's id, a level of it, may be any text."""
    return _is_level(caller.client_id) and len(topic.encode()) <= MAX_TOPIC_BYTES


def _subtract(counter: Counter[K], key: K, count: int) -> None:
    counter[key] -= count
    if not counter[key]:
        del counter[key]


def _timeout(endpoint: CallEndpoint) -> CallError:
    return CallError("timeout", f"no answer from {endpoint.name} within {endpoint.timeout:g} s")


def _ended(endpoint: CallEndpoint, call: Call) -> CallError:
    """Why a call's task was cancelled."""
    return _timeout(endpoint) if call.has_timed_out else _stopping()


def _stopping() -> CallError:
    return CallError("stopping", "the appliance stops")
