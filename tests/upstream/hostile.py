"""What a fleet's broker may do to a link, by name: against the standard, or to be a nuisance.

::

    @pytest.mark.parametrize("name", SCENARIOS)
    async def test_the_link_survives(name: str) -> None:
        async with FakeFleet() as fleet:
            scenario = SCENARIOS[name]
            scenario.prepare(fleet)
            ...  # the link connects, subscribes to one filter at least, and publishes
            await scenario.outcome(fleet)  # it ended the connection, or stayed, as it should

Scenarios are only for the first connection; a link that comes again finds a good broker.
"""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Literal

from waiting import PATIENCE, until

from appliance.mqtt.codec import Property, encode_string, encode_varint
from appliance.mqtt.packets import (
    Auth,
    Connack,
    Connect,
    Disconnect,
    PacketType,
    Pingreq,
    Pingresp,
    Puback,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
    Suback,
    Subscribe,
    Subscription,
    Unsuback,
    Unsubscribe,
)
from upstream.fake_fleet import FakeFleet, Visit, accept, never

#: What the link has to do: end the connection by itself; go on with it; end it, or lose it, and
#: come again later; either of them.
Duty = Literal["ends", "stays", "returns", "either"]

#: When something is done: when the connection is there, in place of CONNACK, behind it, in place of
#: SUBACK, behind it, or in place of the first PUBACK.
Moment = Literal["accept", "connack", "connected", "suback", "subscribed", "puback", "ping"]

#: Of a flood.
MANY = 100_000

#: Seconds of a flood without a number.
FLOOD = 2.0

#: Seconds in which a link that stays would have gone.
MOMENT = 0.5

#: The name of the property that says which robots a message has passed.
VIA = "appliance-via"

Act = Callable[[Visit], "Awaitable[None] | None"]


@dataclass(frozen=True)
class Scenario:
    """One misdeed; `slow` is for those that take more than a second."""

    name: str
    moment: Moment
    duty: Duty
    act: Act
    slow: bool = False

    @property
    def text(self) -> str:
        return (self.act.__doc__ or self.name).strip()

    def prepare(self, fleet: FakeFleet) -> None:
        """The fleet does it on its first connection."""

        def once(visit: Visit) -> bool:
            if visit is not fleet.visits[0] or getattr(fleet, "_misdeed", False):
                return False
            fleet._misdeed = True  # type: ignore[attr-defined]
            work = self.act(visit)
            if work is not None:
                visit.later(work)
            return True

        _PREPARE[self.moment](fleet, once)

    def done(self, fleet: FakeFleet) -> bool:
        """Whether it has been done, or begun."""
        return getattr(fleet, "_misdeed", False)

    async def outcome(self, fleet: FakeFleet, patience: float = PATIENCE) -> None:
        """AssertionError when the link does not do its duty."""
        await until(lambda: self.done(fleet), f"{self.name} begins", patience)
        visit = fleet.visits[0]
        if self.duty in ("ends", "returns"):
            gone = lambda: visit.ended or visit.writer.transport.is_closing()  # noqa: E731
            await until(gone, f"the link ends the connection: {self.text}", patience)
        elif self.duty == "stays":
            await asyncio.sleep(MOMENT)
            assert not visit.ended, f"the link has ended the connection: {self.text}"
        if self.duty == "returns":
            await until(lambda: len(fleet.visits) > 1, "the link connects again", patience)
        assert not fleet.errors, fleet.errors


Once = Callable[[Visit], bool]


def _at_accept(fleet: FakeFleet, once: Once) -> None:
    fleet.accept = once  # type: ignore[assignment]


def _at_connack(fleet: FakeFleet, once: Once) -> None:
    fleet.greet = lambda visit: once(visit) or fleet.good_greeting(visit)  # type: ignore[assignment]


def _after_connack(fleet: FakeFleet, once: Once) -> None:
    def greet(visit: Visit) -> None:
        fleet.good_greeting(visit)
        once(visit)

    fleet.greet = greet


def _at_suback(fleet: FakeFleet, once: Once) -> None:
    def grant(visit: Visit, packet: Subscribe) -> None:
        visit.subscribe = packet  # type: ignore[attr-defined]
        if not once(visit):
            fleet.good_grant(visit, packet)

    fleet.grant = grant


def _after_suback(fleet: FakeFleet, once: Once) -> None:
    def grant(visit: Visit, packet: Subscribe) -> None:
        fleet.good_grant(visit, packet)
        once(visit)

    fleet.grant = grant


def _at_puback(fleet: FakeFleet, once: Once) -> None:
    def answer(visit: Visit, packet: Publish) -> None:
        visit.publish = packet  # type: ignore[attr-defined]
        if not packet.qos or not once(visit):
            accept(visit, packet)

    fleet.acknowledge = answer


def _at_ping(fleet: FakeFleet, once: Once) -> None:
    fleet.pong = lambda visit: once(visit) or visit.send(Pingresp())  # type: ignore[assignment]


_PREPARE: dict[Moment, Callable[[FakeFleet, Once], None]] = {
    "accept": _at_accept,
    "connack": _at_connack,
    "connected": _after_connack,
    "suback": _at_suback,
    "subscribed": _after_suback,
    "puback": _at_puback,
    "ping": _at_ping,
}

SCENARIOS: dict[str, Scenario] = {}


def scenario(moment: Moment, duty: Duty, *, slow: bool = False) -> Callable[[Act], Act]:
    """The function is one; its name with hyphens is the scenario's."""

    def register(act: Act) -> Act:
        name = act.__name__.strip("_").replace("_", "-")  # type: ignore[attr-defined]
        assert name not in SCENARIOS, name
        SCENARIOS[name] = Scenario(name, moment, duty, act, slow)
        return act

    return register


def variants(
    moment: Moment, duty: Duty, name: str, values: dict[str, object], *, slow: bool = False
) -> Callable[[Callable[[Visit, object], Awaitable[None] | None]], None]:
    """As `scenario`, one for each of the values."""

    def register(act: Callable[[Visit, object], Awaitable[None] | None]) -> None:
        for label, value in values.items():

            def one(visit: Visit, value: object = value) -> Awaitable[None] | None:
                return act(visit, value)

            one.__doc__ = f"{(act.__doc__ or name).strip()} ({label})"
            full = f"{name}-{label}"
            assert full not in SCENARIOS, full
            SCENARIOS[full] = Scenario(full, moment, duty, one, slow)

    return register


def packet(first: int, body: bytes) -> bytes:
    """A packet from its parts, as wrong as they are."""
    return bytes((first,)) + encode_varint(len(body)) + body


def raw_publish(flags: int, topic: bytes, rest: bytes = b"\0payload") -> bytes:
    """PUBLISH with a topic that may be anything; `rest` begins with the properties."""
    return packet(0x30 | flags, struct.pack(">H", len(topic)) + topic + rest)


# Before CONNACK, and CONNACK itself


@scenario("accept", "returns")
def fin_at_once(visit: Visit) -> None:
    """The connection is closed before anything is said."""
    visit.close()


@scenario("accept", "returns")
def rst_at_once(visit: Visit) -> None:
    """The connection is reset before anything is said."""
    visit.reset()


@scenario("connack", "returns")
def fin_in_place_of_connack(visit: Visit) -> None:
    """The connection is closed after CONNECT."""
    visit.close()


@scenario("connack", "ends", slow=True)
def connack_never(visit: Visit) -> None:
    """CONNACK never comes."""


@variants(
    "connack",
    "ends",
    "in-place-of-connack",
    {
        "publish": Publish("a", b"x"),
        "puback": Puback(1),
        "suback": Suback(1, [0]),
        "pingresp": Pingresp(),
        "disconnect": Disconnect(0x89),
        "auth": Auth(0x18, {Property.AUTHENTICATION_METHOD: "x"}),
        "connect": Connect("me"),
        "http": b"HTTP/1.1 400 Bad Request\r\nServer: nginx\r\n\r\n",
        "tls-alert": b"\x15\x03\x01\x00\x02\x02\x28",
        "zeros": bytes(100),
        "ff": b"\xff" * 100,
        "length-of-five-bytes": b"\x20\xff\xff\xff\xff\x01",
        "huge-length": b"\x20\xff\xff\xff\x7f" + bytes(100),
        "flags": b"\x21\x03\x00\x00\x00",
        "reserved-acknowledge-flag": b"\x20\x03\x02\x00\x00",
        "empty": b"\x20\x00",
        "unknown-reason": b"\x20\x03\x00\x7f\x00",
        "error-with-session": b"\x20\x03\x01\x87\x00",
        "trailing-bytes": b"\x20\x05\x00\x00\x00\x00\x00",
    },
)
def _in_place_of_connack(visit: Visit, sent: object) -> None:
    """Something else comes in place of CONNACK."""
    visit.send(sent)  # type: ignore[arg-type]


@variants(
    "connack",
    "ends",
    "connack-property",
    {
        "receive-maximum-0": b"\x21\x00\x00",
        "maximum-packet-size-0": b"\x27\x00\x00\x00\x00",
        "maximum-qos-2": b"\x24\x02",
        "retain-available-2": b"\x25\x02",
        "twice": b"\x21\x00\x01\x21\x00\x01",
        "not-of-connack": b"\x23\x00\x01",
        "unknown": b"\x7f\x00",
        "cut": b"\x21\x00",
        "not-utf-8": b"\x1f\x00\x02\xc3\x28",
        "data-without-method": b"\x16\x00\x01x",
    },
)
def _connack_property(visit: Visit, properties: object) -> None:
    """CONNACK has a wrong property."""
    assert isinstance(properties, bytes)
    body = b"\0\0" + encode_varint(len(properties)) + properties
    visit.send(packet(PacketType.CONNACK << 4, body))


@variants(
    "connack",
    "returns",
    "refused",
    {
        hex(code): code
        for code in (0x80, 0x81, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8A, 0x8C, 0x90, 0x95, 0x97, 0x9D)
    },
    slow=True,
)
def _refused(visit: Visit, code: object) -> None:
    """CONNACK refuses with a reason code; a link comes again, later."""
    visit.send(Connack(False, int(code), {Property.REASON_STRING: "no"}))  # type: ignore[call-overload]
    visit.close()


@scenario("connack", "ends")
def session_present_after_a_clean_start(visit: Visit) -> None:
    """CONNACK says that a session is there, which CONNECT has ended."""
    visit.send(Connack(True, 0))


@scenario("connack", "either")
def connack_with_a_long_reason(visit: Visit) -> None:
    """CONNACK has 64 KiB of reason, and 5,000 user properties."""
    many = [("x" * 10, "y" * 10)] * 5000
    properties = {Property.REASON_STRING: "x" * 65535, Property.USER_PROPERTY: many}
    visit.send(Connack(False, 0, properties))


@scenario("connack", "stays")
async def byte_by_byte(visit: Visit) -> None:
    """A good CONNACK, a byte at a time."""
    data = Connack(False, 0, dict(visit.fleet.limits) or None).encode(visit.version)
    for index in range(len(data)):
        visit.send(data[index : index + 1])
        await asyncio.sleep(0.002)


# Behind CONNACK


@scenario("connack", "returns")
def disconnect_in_one_segment_with_connack(visit: Visit) -> None:
    """DISCONNECT comes in the same segment as CONNACK: what is asked then has no connection."""
    visit.send(Connack(False, 0), Disconnect(0x8B))
    visit.close()


@scenario("suback", "returns")
def fin_in_place_of_suback(visit: Visit) -> None:
    """The connection is closed after SUBSCRIBE."""
    visit.close()


@scenario("connected", "ends")
def connack_twice(visit: Visit) -> None:
    """CONNACK comes once more."""
    visit.send(Connack(False, 0))


@variants(
    "connected",
    "ends",
    "a-client-sends",
    {
        "connect": Connect("me"),
        "subscribe": Subscribe(1, [Subscription("#", 1)]),
        "unsubscribe": Unsubscribe(1, ["#"]),
        "pingreq": Pingreq(),
    },
)
def _client_packet(visit: Visit, sent: object) -> None:
    """The fleet sends what only clients send."""
    visit.send(sent)  # type: ignore[arg-type]


@variants(
    "subscribed",
    "ends",
    "bytes",
    {
        "type-0": b"\x00\x00",
        "length-of-five-bytes": b"\x30\xff\xff\xff\xff\x01",
        "puback-of-one-byte": b"\x40\x01\x00",
        "puback-flags": b"\x41\x02\x00\x01",
        "puback-reason": b"\x40\x03\x00\x01\x7f",
        "puback-id-0": b"\x40\x02\x00\x00",
        "pingresp-with-a-body": b"\xd0\x01\x00",
        "qos-3": raw_publish(0x06, b"a", b"\0\1\0x"),
        "dup-with-qos-0": raw_publish(0x08, b"a"),
        "id-0": raw_publish(0x02, b"a", b"\0\0\0x"),
        "topic-empty": raw_publish(0, b""),
        "topic-longer-than-the-packet": packet(0x30, b"\xff\xffabc"),
        "properties-longer-than-the-packet": raw_publish(0, b"a", b"\x7fx"),
        "alias-0": raw_publish(0, b"a", b"\x03\x23\x00\x00x"),
        "alias-never-set": raw_publish(0, b"", b"\x03\x23\x00\x01x"),
        "alias-too-high": raw_publish(0, b"a", b"\x03\x23\xff\xffx"),
        "subscription-identifier-0": raw_publish(0, b"a", b"\x02\x0b\x00x"),
        "garbage": bytes(range(0x31, 0x100)) * 4,
    },
)
def _bytes(visit: Visit, sent: object) -> None:
    """Bytes that are no packet of MQTT, or a malformed one."""
    visit.send(sent)  # type: ignore[arg-type]


@variants(
    "subscribed",
    "stays",
    "unusable",
    {
        "response-topic-wildcard": raw_publish(0, b"a", b"\x06\x08\x00\x03a/#x"),
        "response-topic-empty": raw_publish(2, b"a", b"\0\7\x03\x08\x00\x00x"),
        "many-user-properties": Publish(
            "a", b"x", 1, packet_id=7, properties={Property.USER_PROPERTY: [("a", "b")] * 1100}
        ),
        "topic-not-utf-8": raw_publish(0, b"\xc3\x28"),
        "topic-with-nul": raw_publish(0, b"a\0b"),
        "topic-with-surrogate": raw_publish(0, b"\xed\xa0\x80"),
        "topic-wildcard": raw_publish(0, b"a/#"),
        "topic-plus": raw_publish(0, b"a/+/b"),
        "payload-format-2": raw_publish(0, b"a", b"\x02\x01\x02x"),
        "topic-with-control-characters": raw_publish(0, b"a\x85b".decode("latin1").encode()),
        "aliased-topic-with-nul": raw_publish(0, b"a\0b", b"\x03\x23\0\1x")
        + raw_publish(0, b"", b"\x03\x23\0\1x"),
        "user-property-not-utf-8": raw_publish(0, b"a", b"\x07\x26\0\1\xff\0\1bx"),
        "content-type-with-nul": raw_publish(0, b"a", b"\x04\x03\0\1\0x"),
    },
)
def _unusable(visit: Visit, sent: object) -> None:
    """A message that a publisher may have made so: the broker passes it on as it is."""
    visit.send(sent)  # type: ignore[arg-type]


@variants(
    "subscribed",
    "ends",
    "unknown-id",
    {
        "puback": Puback(54321),
        "suback": Suback(54321, [0]),
        "unsuback": Unsuback(54321, [0]),
        "pubrec": Pubrec(54321),
        "pubcomp": Pubcomp(54321),
    },
)
def _unknown_id(visit: Visit, sent: object) -> None:
    """An answer to what was not asked."""
    visit.send(sent)  # type: ignore[arg-type]


@scenario("subscribed", "either")
def pubrel_of_an_unknown_id(visit: Visit) -> None:
    """PUBREL without a message: PUBCOMP with 0x92 answers it, or the connection ends."""
    visit.send(Pubrel(54321))


@scenario("subscribed", "either")
def pingresp_unasked(visit: Visit) -> None:
    """PINGRESP without PINGREQ, 100 times; it must not count as an answer to a later one."""
    visit.send(*[Pingresp()] * 100)


@scenario("subscribed", "ends")
def auth_unasked(visit: Visit) -> None:
    """AUTH in a connection without an authentication method."""
    visit.send(Auth(0x18, {Property.AUTHENTICATION_METHOD: "x"}))


@scenario("subscribed", "ends", slow=True)
def half_a_packet(visit: Visit) -> None:
    """A packet begins, and nothing follows any more."""
    visit.send(raw_publish(0, b"a", b"\0" + bytes(1000))[:20])
    visit.fleet.pong = lambda other: None if other is visit else other.send(Pingresp())


@variants(
    "subscribed",
    "returns",
    "disconnect",
    {hex(c): c for c in (0x00, 0x04, 0x82, 0x87, 0x89, 0x8B, 0x8D, 0x8E, 0x93, 0x97, 0x98, 0x9D)},
    slow=True,
)
def _disconnect(visit: Visit, code: object) -> None:
    """DISCONNECT with a reason code; a link comes again."""
    visit.send(Disconnect(int(code)))  # type: ignore[call-overload]
    visit.close()


@scenario("subscribed", "ends")
def packets_after_disconnect(visit: Visit) -> None:
    """DISCONNECT, and messages behind it, which count no more."""
    visit.send(Disconnect(0x8B), Publish(visit.topic(), b"late"))


# SUBACK


@scenario("suback", "ends", slow=True)
def suback_never(visit: Visit) -> None:
    """SUBACK never comes."""


@variants("suback", "ends", "suback-length", {"0": 0, "1-more": 1, "1000-more": 1000})
def _suback_length(visit: Visit, more: object) -> None:
    """SUBACK has another number of reason codes than SUBSCRIBE had filters."""
    asked: Subscribe = visit.subscribe  # type: ignore[attr-defined]
    count = len(asked.subscriptions) + int(more) if more else 0  # type: ignore[call-overload]
    visit.send(Suback(asked.packet_id, [0] * count))


@variants("suback", "ends", "suback-code", {"0x03": 3, "0x7f": 0x7F, "0xff": 0xFF})
def _suback_code(visit: Visit, code: object) -> None:
    """SUBACK has a reason code that is none."""
    asked: Subscribe = visit.subscribe  # type: ignore[attr-defined]
    codes = bytes([int(code)] * len(asked.subscriptions))  # type: ignore[call-overload]
    body = struct.pack(">H", asked.packet_id) + b"\0" + codes
    visit.send(packet(PacketType.SUBACK << 4, body))


@variants(
    "suback", "either", "suback-refused", {hex(c): c for c in (0x80, 0x87, 0x8F, 0x97, 0x9E, 0xA2)}
)
def _suback_refused(visit: Visit, code: object) -> None:
    """SUBACK refuses; the link says so, and goes on with the rest."""
    asked: Subscribe = visit.subscribe  # type: ignore[attr-defined]
    visit.send(Suback(asked.packet_id, [int(code)] * len(asked.subscriptions)))  # type: ignore[call-overload]


@scenario("suback", "stays")
def suback_of_less(visit: Visit) -> None:
    """SUBACK grants QoS 0 only."""
    asked: Subscribe = visit.subscribe  # type: ignore[attr-defined]
    visit.send(Suback(asked.packet_id, [0] * len(asked.subscriptions)))


@scenario("suback", "stays")
def messages_before_suback(visit: Visit) -> None:
    """Messages come before SUBACK, as the standard allows."""
    asked: Subscribe = visit.subscribe  # type: ignore[attr-defined]
    for number in range(10):
        visit.message(visit.topic(number), b"early")
    visit.fleet.good_grant(visit, asked)


# Messages from there


@variants(
    "subscribed",
    "either",
    "topic",
    {
        "$SYS": "$SYS/broker/uptime",
        "$CONTROL": "$CONTROL/appliance/v1/stop/_call",
        "$share": "$share/a/b",
        "not-subscribed": "somebody/else",
        "prefix-only": "fleet/r2d2",
        "slashes": "/" * 1000,
        "levels": "/".join(["x"] * 30_000),
        "dots": "fleet/r2d2/../../x",
        "hidden": "fleet/r2d2/_appliance/state",
        "answer-to-an-unknown-token": "fleet/r2d2/_answers/00000000000000000000000000000000",
        "answer-to-no-token": "fleet/r2d2/_answers/",
        "control-characters": "fleet/r2d2/a\x01b",
    },
)
def _topic(visit: Visit, topic: object) -> None:
    """A message with a topic that must not reach the robot's clients as it is."""
    visit.message(str(topic), b"x")


@scenario("subscribed", "either")
def more_than_the_receive_maximum(visit: Visit) -> None:
    """More QoS 1 messages than the link takes unacknowledged, in one go; it may have acknowledged
    the first of them when it reads the last."""
    assert visit.connect is not None
    limit = (visit.connect.properties or {}).get(Property.RECEIVE_MAXIMUM, 65535)
    assert isinstance(limit, int)
    topic = encode_string(visit.topic())
    one = len(topic) + 3
    head = bytes((0x32,)) + encode_varint(one) + topic
    data = b"".join(head + struct.pack(">H", number) + b"\0" for number in range(1, limit + 1))
    # All ids are in use, and one more message has none: the ids of the first come again.
    visit.send(data + b"".join(head + struct.pack(">H", n) + b"\0" for n in range(1, 100)))


@scenario("subscribed", "ends")
def larger_than_the_maximum_packet_size(visit: Visit) -> None:
    """A length beyond what CONNECT has allowed, and the bytes, as long as they are taken."""
    assert visit.connect is not None
    limit = (visit.connect.properties or {}).get(Property.MAXIMUM_PACKET_SIZE, 1 << 24)
    assert isinstance(limit, int)
    length = min(limit + 1, 268_435_455)
    visit.send(b"\x30" + encode_varint(length) + b"\0\1a\0")

    async def go_on() -> None:
        for _ in range(length >> 16):
            visit.send(bytes(1 << 16))
            await visit.drain()

    visit.later(go_on())


@variants("subscribed", "either", "message", {"user-properties": 9000, "identifiers": 5000})
def _message_with_many(visit: Visit, count: object) -> None:
    """A message with thousands of user properties or subscription identifiers."""
    assert isinstance(count, int)
    properties: dict[Property, object] = {Property.USER_PROPERTY: [("a", "b")] * count}
    if count == 5000:
        properties = {Property.SUBSCRIPTION_IDENTIFIER: [1] * count}
    visit.message(visit.topic(), b"x", properties=properties)  # type: ignore[arg-type]


@variants(
    "subscribed",
    "stays",
    "response-topic",
    {
        "$SYS": "$SYS/a",
        "$CONTROL": "$CONTROL/appliance/v1/stop/_call",
        "own-prefix": "fleet/r2d2/cmd/x",
        "long": "x" * 65535,
    },
)
def _response_topic(visit: Visit, topic: object) -> None:
    """A call whose answer would go where none may go."""
    properties = {Property.RESPONSE_TOPIC: str(topic), Property.CORRELATION_DATA: b"1"}
    visit.message(visit.topic(), b"{}", properties=properties)  # type: ignore[arg-type]


@scenario("subscribed", "stays", slow=True)
async def many_response_topics(visit: Visit) -> None:
    """20,000 calls, each with an answer's topic of its own: only so many tokens are kept."""
    for number in range(20_000):
        visit.message(
            visit.topic(), b"{}", 0, properties={Property.RESPONSE_TOPIC: f"answers/{number}"}
        )
        if not number % 500:
            await visit.drain()


@variants("subscribed", "stays", "via", {"own-name": 1, "9-robots": 9, "100-robots": 100})
def _via(visit: Visit, count: object) -> None:
    """A message that has passed this robot already, or too many others."""
    assert isinstance(count, int)
    names = ["r2d2"] if count == 1 else [f"robot{number}" for number in range(count)]
    pairs = [(VIA, name) for name in names]
    visit.message(visit.topic(), b"x", properties={Property.USER_PROPERTY: pairs})
    joined = [(VIA, ",".join(names))]
    visit.message(visit.topic(), b"x", properties={Property.USER_PROPERTY: joined})


@scenario("subscribed", "stays")
def expired_and_duplicated_commands(visit: Visit) -> None:
    """Messages with an expiry of 0, and with DUP."""
    visit.message(visit.topic(), b"old", properties={Property.MESSAGE_EXPIRY_INTERVAL: 0})
    visit.message(visit.topic(), b"again", dup=True)


@scenario("subscribed", "either")
def the_same_id_twice(visit: Visit) -> None:
    """Two QoS 1 messages with one packet id, without DUP and without an acknowledgement between."""
    one = Publish(visit.topic(), b"1", 1, packet_id=7)
    visit.sent[7] = one
    visit.send(one, one)


@scenario("subscribed", "either")
def qos_2(visit: Visit) -> None:
    """A message with QoS 2, which the link has not asked for."""
    visit.message(visit.topic(), b"x", 2)


@scenario("subscribed", "stays", slow=True)
async def retained_100000(visit: Visit) -> None:
    """100,000 retained messages at once, of as many topics."""
    for number in range(MANY):
        topic = f"{visit.topic(0)}/{number}" if "#" in visit.filters[0] else visit.topic(0)
        visit.message(topic, b"x" * 20, 0, retain=True)
        if not number % 1000:
            await visit.drain()


@scenario("subscribed", "either", slow=True)
async def flood(visit: Visit) -> None:
    """QoS 0 messages for some seconds, as fast as they are taken."""
    data = Publish(visit.topic(), b"x" * 50).encode(visit.version) * 1000
    until_then = time.monotonic() + FLOOD
    while time.monotonic() < until_then:
        visit.send(data)
        await visit.drain()
        await asyncio.sleep(0)


@scenario("subscribed", "either", slow=True)
async def flood_of_large_messages(visit: Visit) -> None:
    """QoS 0 messages of 60 KB for some seconds, as fast as they are taken."""
    data = Publish(visit.topic(), bytes(60_000)).encode(visit.version) * 10
    until_then = time.monotonic() + FLOOD
    while time.monotonic() < until_then:
        visit.send(data)
        await visit.drain()
        await asyncio.sleep(0)


@scenario("subscribed", "either", slow=True)
async def flood_of_empty_packets(visit: Visit) -> None:
    """PINGRESP of two bytes for some seconds, as fast as they are taken."""
    data = Pingresp().encode(visit.version) * 10_000
    until_then = time.monotonic() + FLOOD
    while time.monotonic() < until_then:
        visit.send(data)
        await visit.drain()
        await asyncio.sleep(0)


@scenario("subscribed", "stays", slow=True)
async def qos_1_in_full_windows(visit: Visit) -> None:
    """20,000 messages with QoS 1, as many unacknowledged as the link allows."""
    assert visit.connect is not None
    limit = (visit.connect.properties or {}).get(Property.RECEIVE_MAXIMUM, 1000)
    assert isinstance(limit, int)
    for number in range(20_000):
        await until(lambda: len(visit.sent) < limit, "the link acknowledges")
        visit.message(visit.topic(), b"%d" % number)


# What it does not do


@scenario("subscribed", "ends", slow=True)
def never_reads(visit: Visit) -> None:
    """The fleet reads nothing any more, and keeps the connection."""
    visit.reading.clear()
    visit.reader._transport.pause_reading()  # type: ignore[attr-defined]


@scenario("subscribed", "stays", slow=True)
async def reads_slowly(visit: Visit) -> None:
    """The fleet reads for 10 ms of each 100, for two seconds."""
    for _ in range(20):
        visit.reading.clear()
        await asyncio.sleep(0.09)
        visit.reading.set()
        await asyncio.sleep(0.01)


@scenario("subscribed", "ends", slow=True)
def pingresp_never(visit: Visit) -> None:
    """PINGREQ is not answered any more."""
    visit.fleet.pong = lambda other: None if other is visit else other.send(Pingresp())


# The link's own messages


@scenario("puback", "ends", slow=True)
def puback_never(visit: Visit) -> None:
    """PUBACK never comes: after 30 s the connection ends, and the message is sent again."""


@variants(
    "puback",
    "either",
    "puback-code",
    {hex(c): c for c in (0x10, 0x80, 0x83, 0x87, 0x90, 0x91, 0x97, 0x99)},
)
def _puback_code(visit: Visit, code: object) -> None:
    """PUBACK has a reason code; what follows is not blocked."""
    publish: Publish = visit.publish  # type: ignore[attr-defined]
    assert publish.packet_id is not None
    visit.acknowledge(publish.packet_id, int(code))  # type: ignore[call-overload]


@scenario("puback", "ends")
def puback_twice(visit: Visit) -> None:
    """PUBACK comes once more, for an id that is free again."""
    publish: Publish = visit.publish  # type: ignore[attr-defined]
    assert publish.packet_id is not None
    visit.fleet.acknowledge = never
    visit.acknowledge(publish.packet_id)
    visit.acknowledge(publish.packet_id)


@variants("puback", "ends", "in-place-of-puback", {"pubrec": Pubrec, "pubcomp": Pubcomp})
def _in_place_of_puback(visit: Visit, kind: object) -> None:
    """The answer to a QoS 1 message is that to one of QoS 2."""
    publish: Publish = visit.publish  # type: ignore[attr-defined]
    visit.send(kind(publish.packet_id))  # type: ignore[operator]


@scenario("puback", "returns")
def fin_in_place_of_puback(visit: Visit) -> None:
    """The connection is closed at the first message; later it is taken."""
    visit.close()


@scenario("puback", "returns")
def rst_in_place_of_puback(visit: Visit) -> None:
    """The connection is reset at the first message; later it is taken."""
    visit.reset()
