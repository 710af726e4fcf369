"""Calls: what MQTT clients ask of the bridge, and how they are answered.

A call is a message to a call topic such as `r2d2/reset/_call`. Where its answer goes is said by

- the Response Topic of MQTT 5; the Correlation Data goes back with the answer; or
- a token of the caller's choice as one more level, `r2d2/reset/_call/42`, which is how 3.1.1 does
  it: the answer is on `r2d2/reset/_reply/{client id}/42`.

The appliance publishes the answer, and may publish anywhere; so it does not let itself be used. A
Response Topic is one that the caller could have published to itself, or one below its own
`_reply/{client id}`, which it must be allowed to receive. What cannot be answered, for the want of
a way back or because the caller may not use it, is not carried out: the error is on
`r2d2/reset/_reply/{client id}`, for who looks for it there, and in the log.

A call may be JSON, CBOR or ROS's own bytes, as its content type says, else as the route does; its
answer is the same. Both are converted when it is their turn, see conversions.py.

How many are under way is bounded for each client, each user and all together. Cancelling has slots
of its own, which nothing else takes and no other user: who has sent a goal can always stop it.
Everything here is for the event loop's thread.
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
from appliance.broker.message import Message
from appliance.broker.ports import InsideLink
from appliance.broker.session import Session
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
from appliance.ros.topics.conversions import ConversionQueue, user_of
from appliance.ros.topics.staleness import SENT_AT, said_age

log = logging.getLogger(__name__)

CLIENT_ID = "_calls"

#: What can go wrong with a call; the message beside it has the particulars.
ErrorCode: TypeAlias = Literal[
    "bad_request",  # the payload, or the message, is not what the call takes
    "expired",  # it was sent long before it came
    "no_response_topic",  # there is no way to answer
    "not_authorized",  # the caller may not have the answer there, or not ask for that
    "too_large",  # the payload is larger than what is converted
    "too_many",  # the caller, or all together, have too many calls under way
    "unavailable",  # there is no such service, action or node on the bus now
    "vanished",  # there was, and it went away before it answered
    "timeout",  # no answer within the route's time
    "rejected",  # the node said no
    "unknown_goal",  # the action's server knows of no such goal, or it has ended
    "unknown_type",  # the type is not installed here
    "ros_error",  # ROS itself refused, or is not there
    "stopping",  # the appliance stops
]


#: Encodings of a call that has other values than ROS messages in it; of such, ROS's own bytes too.
WITHOUT_RAW: tuple[EncodingName, ...] = tuple(VALUE_ENCODINGS)

#: Seconds between two lines in the log about the same route's errors.
REPORT_INTERVAL = 60.0


#: Bytes that are converted in a microsecond or so, and count for that in the broker's
#: `Counters.cost`: who sends much then waits for the others.
BYTES_PER_COST_UNIT = 16

#: Bytes of a topic, as of every string in MQTT.
LONGEST_TOPIC = 0xFFFF

#: Bytes of payload of all calls under way, and of those of one user.
TOTAL_BYTES = 64 * 1024 * 1024
USER_BYTES = TOTAL_BYTES // 4

T = TypeVar("T")
K = TypeVar("K")


class CallError(Exception):
    """A call that fails: the code for programs, and the message for people."""

    def __init__(self, code: ErrorCode, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a call: its payload, how that is encoded, and the ROS type of it, if any."""

    payload: bytes
    encoding: EncodingName
    type: str | None = None


@dataclass(frozen=True, slots=True)
class CallLimits:
    """Calls under way, and as many goals: of one client, of all together, and of one user (None: a
    quarter of these); and what one call may be."""

    client: int = 20
    total: int = 500
    user: int | None = None
    input: InputLimits = field(default_factory=InputLimits)

    @property
    def share(self) -> int:
        """What one user may have under way."""
        return max(1, self.total // 4) if self.user is None else self.user


@dataclass(frozen=True, slots=True)
class Slot:
    """A slot that is taken: by this client, of this user."""

    client: Session
    user: str | None


class ConcurrencyLimiter:
    """Places for what is under way: `what` says what that is, in the plural.

    Where a slot is `sure`, what other users have never keeps it from anybody.
    """

    def __init__(self, what: str, *, ignore_total: bool = False) -> None:
        self._what = what
        self._ignores_total = ignore_total
        self._clients: Counter[Session] = Counter()
        self._users: Counter[str | None] = Counter()
        self._total = 0

    def __contains__(self, client: Session) -> bool:
        return client in self._clients

    def check(self, client: Session, limits: CallLimits) -> None:
        """Raises CallError when there is no slot left for the client."""
        if self._clients[client] >= limits.client:
            raise self._full(limits.client, "this client", "calls_per_client")
        user = user_of(client)
        if self._users[user] >= limits.share:
            whose = "the clients without a user" if user is None else f"the user {quote(user)}"
            raise self._full(limits.share, whose, "calls_per_user")
        if self._total >= limits.total and not self._ignores_total:
            raise self._full(limits.total, "all clients", "calls")

    def _full(self, count: int, whose: str, key: str) -> CallError:
        return CallError(
            "too_many",
            f"{count} {self._what} of {whose} are under way, as many as may be "
            f"(bridge.limits.{key})",
        )

    def acquire(self, client: Session) -> Slot:
        """Take a slot, which `check` has found."""
        slot = Slot(client, user_of(client))
        self._total += 1
        self._clients[slot.client] += 1
        self._users[slot.user] += 1
        return slot

    def release(self, slot: Slot) -> None:
        """It is free again."""
        self._total -= 1
        _take_off(self._clients, slot.client, 1)
        _take_off(self._users, slot.user, 1)


@dataclass(eq=False, slots=True)
class CallCounters:
    """What a route counts from its start; `errors` are by code."""

    calls: int = 0
    answers: int = 0
    under_way: int = 0
    errors: Counter[str] = field(default_factory=Counter)
    last_error: str | None = None


@dataclass(eq=False, slots=True)
class Call:
    """One call that can be answered.

    `topic` is without the token. `reply` is the answer as far as it is known beforehand: its topic,
    QoS and Correlation Data. `encoding` is the payload's, and will be the answer's; `doubt` says
    why it may be another.
    """

    caller: Session
    payload: bytes
    topic: str
    reply: Message
    encoding: EncodingName
    doubt: str = ""
    is_late: bool = False
    slot: Slot | None = None
    timer: asyncio.TimerHandle | None = None
    task: asyncio.Task[None] | None = None


#: Takes in what a call asks for, at once, and gives what finds the answer. Both raise CallError.
Handler: TypeAlias = Callable[[Call], Callable[[], Awaitable[Answer]]]


@dataclass(eq=False, slots=True)
class CallEndpoint:
    """What can be called under a topic, and how it is handled.

    `name` is what the log calls it. `timeout` is in seconds. `encoding` is for what names none, and
    `encodings` are those that it takes, with `largest` bytes at most if that is said. What cancels
    (`is_cancel`) has slots of its own.
    """

    topic: str
    name: str
    timeout: float
    counters: CallCounters
    handle: Handler
    encoding: EncodingName = "json"
    encodings: tuple[EncodingName, ...] = WITHOUT_RAW
    largest: int | None = None
    is_cancel: bool = False


MessageHandler: TypeAlias = Callable[[Session, Message], None]


class _Link(InsideLink):
    """The link of the dispatcher's session: calls, and what `listen` subscribed to."""

    def __init__(self, receive: Callable[[Session, Message, int], None]) -> None:
        self._receive = receive

    def publish(
        self,
        message: Message,
        qos: int,
        packet_id: int,
        dup: bool,
        retain: bool,
        subscription_ids: list[int] | None,
    ) -> None:
        """A message to one of the topics that were asked for."""
        if message.publisher is not None and subscription_ids:
            self._receive(message.publisher, message, subscription_ids[0])


class CallDispatcher:
    """Takes calls from MQTT, has them handled, and answers each of them once."""

    def __init__(self, broker: Broker, entries: Entries, conversions: ConversionQueue) -> None:
        self.limits = CallLimits()
        self.conversions = conversions
        self._replay_guard = ReplayGuard()
        self._broker = broker
        self._entries = entries
        self._loop = entries.loop
        self._session: Session | None = None
        #: Who gets what comes, by the identifier of the subscription it came through.
        self._receivers: dict[int, MessageHandler] = {}
        self._identifiers: dict[str, int] = {}
        self._last_identifier = 0
        #: By topic, the first of those that were offered there; the others wait for it to go.
        self._endpoints: dict[str, list[CallEndpoint]] = {}
        self._slots = ConcurrencyLimiter("calls")
        self._cancel_slots = ConcurrencyLimiter("calls that cancel goals", ignore_total=True)
        self._calls: dict[Call, CallEndpoint] = {}
        self._bytes: Counter[str | None] = Counter()
        self._report_at: dict[str, float] = {}

    def start(self) -> None:
        """Let calls come in."""
        self._session = self._broker.attach(CLIENT_ID, _Link(self.receive))
        self._broker.departures.append(self._replay_guard.departed)
        for topic_filter in self._identifiers:
            self._subscribe(topic_filter)

    async def stop(self) -> None:
        """Answer what is under way with `stopping`, and leave the broker; may be called twice."""
        for topic in list(self._endpoints):
            del self._endpoints[topic]
            self._ignore_calls(topic)
        for call in list(self._calls):
            if call.task is None:  # it waits for its turn
                self._end(call, _stopping())
        tasks = [call.task for call in self._calls if call.task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await asyncio.sleep(0)  # the answers go out
        session, self._session = self._session, None
        if session is not None:
            self._broker.departures.remove(self._replay_guard.departed)
            self._broker.detach(session)

    # Topics

    def listen(self, topic_filter: str, receive: MessageHandler) -> None:
        """Hand what clients publish there to `receive`, with the session that published it."""
        self._last_identifier += 1
        self._identifiers[topic_filter] = self._last_identifier
        self._receivers[self._last_identifier] = receive
        self._subscribe(topic_filter)

    def _subscribe(self, topic_filter: str) -> None:
        if self._session is not None:
            # QoS 0 loses nothing here, as the link takes each message at once. A retained message
            # may be an old call: it is not carried out again.
            identifier = self._identifiers[topic_filter]
            subscription = Subscription(
                topic_filter, 0, no_local=True, retain_handling=2, identifier=identifier
            )
            self._broker.subscribe(self._session, subscription)

    def ignore(self, topic_filter: str) -> None:
        """Listen there no longer."""
        del self._receivers[self._identifiers.pop(topic_filter)]
        if self._session is not None:
            self._broker.unsubscribe(self._session, topic_filter)

    def register(self, endpoint: CallEndpoint) -> None:
        """Let `endpoint.topic`, which may have a `+` in it, be called."""
        endpoints = self._endpoints.setdefault(endpoint.topic, [])
        endpoints.append(endpoint)
        if len(endpoints) == 1:
            self._listen_for(endpoint)
        else:
            text = "%s cannot be called: calls at %s are for %s"
            log.warning(text, endpoint.name, endpoint.topic, endpoints[0].name)

    def _listen_for(self, endpoint: CallEndpoint) -> None:
        self.listen(
            endpoint.topic, lambda caller, message: self._take(endpoint, caller, message, False)
        )
        self.listen(
            f"{endpoint.topic}/+",
            lambda caller, message: self._take(endpoint, caller, message, True),
        )

    def unregister(self, endpoint: CallEndpoint) -> None:
        """Offer it no longer; calls under way have their answers yet."""
        endpoints = self._endpoints.get(endpoint.topic, [])
        if endpoint not in endpoints:
            return  # `stop` has withdrawn all
        was_first = endpoints[0] is endpoint
        endpoints.remove(endpoint)
        if not endpoints:
            del self._endpoints[endpoint.topic]
            self._report_at.pop(endpoint.topic, None)
        if was_first:
            self._ignore_calls(endpoint.topic)
            if endpoints:
                self._listen_for(endpoints[0])

    def _ignore_calls(self, topic: str) -> None:
        self.ignore(topic)
        self.ignore(f"{topic}/+")

    def receive(self, origin: Session, message: Message, identifier: int) -> None:
        """A message came through the subscription with that identifier."""
        self._broker.counters.cost += len(message.payload) // BYTES_PER_COST_UNIT
        receive = self._receivers.get(identifier)
        if receive is not None:
            receive(origin, message)

    def publish(self, message: Message) -> ReasonCode:
        """Publish as the appliance; 0x10 when nobody has subscribed."""
        if self._session is None:
            return ReasonCode.NO_MATCHING_SUBSCRIBERS
        code = self._broker.publish(message, self._session)
        self._broker.flush()
        return code

    def clear_retained(self, base: str, name: str, below: str) -> None:
        """Take back what was left retained by a run that was killed.

        That is what is below `base`, where `name` stands for any ROS name, and there matches the
        regular expression `below`.
        """
        start, _, end = base.partition(name)
        names = r"(/\w+)+" if name in base else ""
        left = re.compile(f"{re.escape(start)}{names}{re.escape(end)}/{below}")
        for topic, _ in list(self._broker.retained.find(f"{start}/#")):
            if left.fullmatch(topic):
                self.publish(Message(topic, b"", 0, True))

    def may_publish(self, caller: Session, topic: str) -> bool:
        """Whether the rules in force let the caller publish there."""
        try:
            return self._broker.route(caller, encode_string(topic)).allowed
        except ProtocolError:
            return False

    def now(self) -> float:
        """Seconds of the broker's clock."""
        return self._broker.now

    # Calls

    def _take(
        self, endpoint: CallEndpoint, caller: Session, message: Message, has_token: bool
    ) -> None:
        endpoint.counters.calls += 1
        topic, _, token = message.topic.rpartition("/") if has_token else (message.topic, "", "")
        own = f"{topic.rpartition('/')[0]}/_reply/{caller.client_id}"
        said = (message.properties or {}).get(Property.CONTENT_TYPE)
        named = named_encoding(said)
        encoding = named or endpoint.encoding
        try:
            reply = self._way_back(caller, message, own, token)
        except CallError as error:
            fallback = Message(own, b"", 1) if _is_own_topic(caller, own) else None
            self._fail(endpoint, caller, fallback, encoding, error)
            return
        call = Call(caller, message.payload, topic, reply, encoding)
        if isinstance(said, str) and named is None:
            call.doubt = f" (it says to be {quote(said[:60])}, and was read as {encoding})"
        try:
            self._admit(endpoint, call, message)
        except CallError as error:
            self._fail(endpoint, caller, reply, encoding, error)
            return
        self._enter(endpoint, call)
        self.conversions.do(caller, len(call.payload), partial(self._begin, endpoint, call))

    def _enter(self, endpoint: CallEndpoint, call: Call) -> None:
        slots = self._cancel_slots if endpoint.is_cancel else self._slots
        call.slot = slots.acquire(call.caller)
        endpoint.counters.under_way += 1
        self._calls[call] = endpoint
        self._bytes[call.slot.user] += len(call.payload)
        call.timer = self._entries.later(
            "calls.timeout", endpoint.timeout, self._expire, call, served=endpoint.name
        )

    def _begin(self, endpoint: CallEndpoint, call: Call) -> None:
        """It is the call's turn to be converted."""
        if call not in self._calls:  # it was given up
            return
        try:
            find = endpoint.handle(call)
        except CallError as error:
            self._end(call, error)
        except Exception as problem:  # a fault in here must not leave the caller without an answer
            self._entries.faults.caught("calls.take", problem, endpoint.name)
            self._end(call, CallError("ros_error", repr(problem)))
        else:
            call.task = self._entries.task(
                "calls.call", self._run(endpoint, call, find), served=endpoint.name
            )
            self._entries.when_done("calls.end", call.task, self._leave, call)

    async def convert(self, caller: Session, size: int, work: Callable[[], T]) -> T:
        """What `work` gives, which converts so many bytes, when it is the caller's turn."""
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

    def _way_back(self, caller: Session, message: Message, own: str, token: str) -> Message:
        """An empty answer with its topic and correlation. Raises CallError."""
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
        # What is below the id of a client `alice/1` belongs to the client `alice`.
        if _is_level(caller.client_id) and (topic == own or topic.startswith(f"{own}/")):
            if not self._broker.may_receive(caller, topic):
                raise CallError("not_authorized", f"the caller may not read {quote(topic)}")
        else:
            self._check_may_publish(caller, topic)
        sent_back = {Property.CORRELATION_DATA: correlation} if correlation is not None else None
        return Message(topic, b"", max(1, message.qos), properties=sent_back)

    def _check_may_publish(self, caller: Session, topic: str) -> None:
        try:
            route = self._broker.route(caller, encode_string(topic))
        except ProtocolError as error:
            raise CallError("bad_request", f"the Response Topic is not valid: {error}") from None
        if topic in self._broker.guards:
            # The answer would come some time later, and as the appliance's own message.
            raise CallError("not_authorized", f"{quote(topic)} is for commands, not for answers")
        if not route.allowed:
            raise CallError(
                "not_authorized",
                f"the caller may not publish to its Response Topic {quote(topic)}: {route.reason}",
            )

    def _admit(self, endpoint: CallEndpoint, call: Call, message: Message) -> None:
        """Raises CallError for a call that is not even looked at."""
        caller = call.caller
        if message.retain:
            raise CallError("bad_request", "a call must not be retained: it would be kept")
        self._check_age(endpoint, caller, message)
        size = len(call.payload)
        try:
            self.limits.input.check_size(size, ENCODINGS[call.encoding])
        except TooLargeError as error:
            raise CallError("too_large", str(error)) from None
        if endpoint.largest is not None and size > endpoint.largest:
            text = f"it has {size} bytes, {endpoint.name} takes {endpoint.largest} at most"
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
        """Nobody waits for the answer of an old call any more, and what it would do nobody expects.

        To cancel is how an action is stopped: that is done whatever it says of its age, and only
        not where MQTT itself has expired it [MQTT-3.3.2-5].
        """
        is_over = message.expires_at is not None and message.expires_at <= self._broker.now
        try:
            age = said_age(message.properties, time.time())
        except ValueError as error:
            if not endpoint.is_cancel:
                raise CallError("bad_request", str(error)) from None
            age = 0.0
        if age is None:
            # Asked also where it does not matter: what comes behind an old one is as old.
            is_old = self._replay_guard.has(message, caller, endpoint.timeout, self._loop.time())
            is_over |= is_old and not endpoint.is_cancel
        elif age > endpoint.timeout and not endpoint.is_cancel:
            raise CallError("expired", f"it was sent {age:.1f} s before, by its {SENT_AT}")
        if is_over:
            raise CallError("expired", "it was sent some time ago, before a connection was lost")

    def _check_bytes(self, caller: Session, size: int) -> None:
        own, total = self._bytes[user_of(caller)], self._bytes.total()
        if own and own + size > USER_BYTES:
            raise CallError("too_many", f"{own} bytes of calls of its user are under way")
        if total and total + size > TOTAL_BYTES:
            raise CallError("too_many", f"{total} bytes of calls of all clients are under way")

    async def _run(
        self, endpoint: CallEndpoint, call: Call, find: Callable[[], Awaitable[Answer]]
    ) -> None:
        try:
            answer = await find()
        except CallError as error:
            self._tell(endpoint, call, error)
        except asyncio.CancelledError:
            self._tell(endpoint, call, _too_late(endpoint) if call.is_late else _stopping())
        except Exception as problem:  # a fault in here must not leave the caller without an answer
            self._entries.faults.caught("calls.handle", problem, endpoint.name)
            self._tell(endpoint, call, CallError("ros_error", repr(problem)))
        else:
            endpoint.counters.answers += 1
            about = [("status", "ok")]
            if answer.type is not None:
                about.append(("ros-type", answer.type))
            self._answer(call.reply, answer.payload, answer.encoding, about)

    def _expire(self, call: Call) -> None:
        """Its time is over."""
        call.is_late = True
        if call.task is not None:
            call.task.cancel()
        elif call in self._calls:  # it waits for its turn yet
            self._end(call, _too_late(self._calls[call]))

    def _end(self, call: Call, error: CallError) -> None:
        """It fails before anybody was asked."""
        self._tell(self._calls[call], call, error)
        self._leave(call)

    def _leave(self, call: Call) -> None:
        endpoint = self._calls.pop(call)
        if call.timer is not None:
            call.timer.cancel()
        endpoint.counters.under_way -= 1
        assert call.slot is not None
        _take_off(self._bytes, call.slot.user, len(call.payload))
        (self._cancel_slots if endpoint.is_cancel else self._slots).release(call.slot)
        if call.task is not None and call.task.cancelled():  # before it had begun
            self._tell(endpoint, call, _too_late(endpoint) if call.is_late else _stopping())

    def _tell(self, endpoint: CallEndpoint, call: Call, error: CallError) -> None:
        if error.code == "bad_request" and call.doubt:
            error = CallError(error.code, f"{error}{call.doubt}")
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
        if now >= self._report_at.get(endpoint.topic, 0.0):
            self._report_at[endpoint.topic] = now + REPORT_INTERVAL
            count = sum(counters.errors.values())
            text = "a call of %s by %s failed (%d so far): %s: %s"
            log.warning(text, endpoint.name, caller, count, error.code, error)
        if reply is not None:
            # In a turn of its own: the caller's chunk is still being worked on.
            about = [("status", "error")]
            self._entries.soon(
                "calls.answer", self._answer, reply, *error_payload(error, encoding), about
            )

    def _answer(
        self, reply: Message, payload: bytes, encoding: EncodingName, about: list[tuple[str, str]]
    ) -> None:
        properties = dict(reply.properties or {})
        properties[Property.CONTENT_TYPE] = CONTENT_TYPE[encoding]
        properties[Property.USER_PROPERTY] = about
        self.publish(Message(reply.topic, payload, reply.qos, properties=properties))


def error_payload(
    error: CallError, encoding: EncodingName, **more: str
) -> tuple[bytes, EncodingName]:
    """An error as every answer has it, `{"error": {"code": …, "message": …}}`, and its encoding.

    ROS's own bytes have no words for it: that is JSON then, which no CDR begins like.
    """
    about = {"code": error.code, "message": str(error)}
    readable = encoding if encoding in VALUE_ENCODINGS else "json"
    return VALUE_ENCODINGS[readable].dumps({**more, "error": about}), readable


def _is_level(client_id: str) -> bool:
    """Whether the id can be one level of a topic, as `_reply/{client id}` needs it."""
    return not set("/+#\0") & set(client_id)


def _is_own_topic(caller: Session, topic: str) -> bool:
    """Whether there can be such a topic with the caller's id, which may be any text, in it."""
    return _is_level(caller.client_id) and len(topic.encode()) <= LONGEST_TOPIC


def _take_off(counter: Counter[K], key: K, count: int) -> None:
    counter[key] -= count
    if not counter[key]:
        del counter[key]


def _too_late(endpoint: CallEndpoint) -> CallError:
    return CallError("timeout", f"no answer from {endpoint.name} within {endpoint.timeout:g} s")


def _stopping() -> CallError:
    return CallError("stopping", "the appliance stops")
