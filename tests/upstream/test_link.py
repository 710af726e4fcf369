"""A connection to a fleet's broker: against a broker that errs, our own, and mosquitto."""

from __future__ import annotations

import math
import random
import socket
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from appliance_process import MOSQUITTO, MosquittoProcess
from broker.conftest import FakeAccess, Peer
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from waiting import PATIENCE as TEST_PATIENCE

from appliance.broker.broker import Broker
from appliance.broker.limits import Limits
from appliance.broker.values import Action
from appliance.mqtt.codec import (
    V5,
    V311,
    Properties,
    Property,
    PropertyValue,
    decode_properties,
    encode_properties,
    encode_string,
    encode_varint,
)
from appliance.mqtt.connection import ServerProtocol
from appliance.mqtt.packets import (
    Auth,
    Connack,
    Connect,
    Disconnect,
    Packet,
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
    Will,
)
from appliance.mqtt.reason import ReasonCode
from appliance.store import MemoryStore
from appliance.upstream.agreement import ConnectSettings, EndedBy
from appliance.upstream.late import LEAST_WINDOW
from appliance.upstream.link import (
    CACHED,
    LONGEST_CACHED,
    MAXIMUM_PINGS,
    PATIENCE,
    FleetConnection,
)
from appliance.upstream.link_events import (
    Acknowledged,
    Arrived,
    Challenged,
    FleetEvent,
    Opened,
    Reauthenticated,
    Subscribed,
    Unsubscribed,
)

VERSIONS = [4, 5]


class Fake:
    """A broker that says what the test says; what the client sends is decoded by `ServerProtocol`.

    `now` is the time at both ends.
    """

    def __init__(self, version: int = 5, **fields) -> None:
        self.version = version
        self.now = 100.0
        self.link: FleetConnection[str] = FleetConnection(
            ConnectSettings("robot", version, **fields)
        )
        self.protocol = ServerProtocol(1 << 28, 0)
        self.events: list[FleetEvent[str]] = []

    def start(self) -> Connect:
        self.link.start(self.now)
        (connect,) = self.sent()
        assert isinstance(connect, Connect)
        return connect

    def open(self, **properties: PropertyValue) -> Fake:
        """CONNECT, and a CONNACK with these properties (by their names in lower case)."""
        self.start()
        held = {Property[name.upper()]: value for name, value in properties.items()}
        if self.link.settings.method is not None:
            held[Property.AUTHENTICATION_METHOD] = self.link.settings.method
        self.say(Connack(properties=held or None))
        (opened,) = self.heard()
        assert isinstance(opened, Opened)
        self.protocol.accept()
        return self

    def say(self, *packets: Packet | bytes) -> None:
        data = b"".join(
            each if isinstance(each, bytes) else each.encode(self.version) for each in packets
        )
        self.events += self.link.receive(data, self.now)

    def heard(self) -> list[FleetEvent[str]]:
        events, self.events = self.events, []
        return events

    def sent(self) -> list[Packet]:
        """The packets that the client has sent since this was last asked."""
        data = b"".join(self.link.take(self.now))
        found: list[Packet] = []
        for event in self.protocol.receive_data(data):
            if isinstance(event, int):
                kinds = {4: Puback, 5: Pubrec, 6: Pubrel, 7: Pubcomp}
                found.append(kinds[event >> 16](event & 0xFFFF))
            elif isinstance(event, tuple):
                first, topic, packet_id, payload, _ = event
                found.append(
                    Publish(
                        topic[2:].decode(),
                        payload,
                        first >> 1 & 3,
                        bool(first & 1),
                        first >= 0x38,
                        packet_id or None,
                    )
                )
            else:
                found.append(event)
        assert not self.protocol.has_unparsed
        return found

    def tick(self, seconds: float = 0.0, unsent: int = 0) -> float:
        """Let time pass; in how many seconds the next tick is due."""
        self.now += seconds
        return self.link.tick(self.now, unsent) - self.now

    def ending(self) -> tuple[EndedBy, int, str]:
        ended = self.link.ended
        assert ended is not None
        return ended.by, ended.code, ended.text

    def check_failed(self, code: ReasonCode, text: str) -> None:
        """The client has ended the connection, and says so in version 5 only."""
        by, found, words = self.ending()
        assert (by, found) == (EndedBy.US, code), words
        assert text in words
        sent = self.sent()
        if self.version == 5:
            assert [type(packet) for packet in sent] == [Disconnect]
            assert sent[0].reason_code == code  # type: ignore[union-attr]
        else:
            assert sent == []  # a DISCONNECT would remove the will
        assert self.link.room == 0
        assert self.link.receive(Pingresp().encode(5) * 9, self.now) == []
        assert self.link.tick(self.now) == math.inf


# --- CONNECT and CONNACK


@pytest.mark.parametrize("version", VERSIONS)
def test_connect_asks_for_what_the_settings_say(version):
    will = Will("fleet/r/state", b"offline", 1, True)
    fake = Fake(
        version,
        clean_start=False,
        session_expiry=3600,
        keep_alive=45,
        username="u",
        password=b"p",
        will=will,
        method="m",
        authentication_data=b"first",
        receive_maximum=20,
        maximum_packet_size=1 << 20,
        topic_alias_maximum=7,
    )
    connect = fake.start()
    expected: Properties | None = None
    if version == 5:
        expected = {
            Property.SESSION_EXPIRY_INTERVAL: 3600,
            Property.RECEIVE_MAXIMUM: 20,
            Property.MAXIMUM_PACKET_SIZE: 1 << 20,
            Property.TOPIC_ALIAS_MAXIMUM: 7,
            Property.AUTHENTICATION_METHOD: "m",
            Property.AUTHENTICATION_DATA: b"first",
        }
    assert connect == Connect("robot", False, 45, version, "u", b"p", will, expected)
    assert "first" not in repr(fake.link.settings) and "b'p'" not in repr(fake.link.settings)


def test_what_connack_grants():
    fake = Fake(window=1000, keep_alive=30, session_expiry=60).open(
        receive_maximum=20,
        maximum_qos=1,
        retain_available=0,
        maximum_packet_size=128 * 1024,
        assigned_client_identifier="given",
        topic_alias_maximum=3,
        server_keep_alive=1200,
        session_expiry_interval=0,
        wildcard_subscription_available=0,
        subscription_identifier_available=0,
        shared_subscription_available=0,
        reason_string="welcome",
        response_information="ignored",
        server_reference="other",
    )
    granted = fake.link.granted
    assert granted is not None
    assert granted.client_id == "given"
    assert (granted.window, granted.receive_maximum, granted.maximum_qos) == (20, 20, 1)
    assert (granted.retain, granted.maximum_packet_size) == (False, 131072)
    assert (granted.topic_alias_maximum, granted.keep_alive, granted.session_expiry) == (3, 1200, 0)
    assert (granted.wildcards, granted.identifiers, granted.shared) == (False, False, False)
    assert (granted.reason, granted.server_reference) == ("welcome", "other")
    assert fake.link.room == 20


@pytest.mark.parametrize("version", VERSIONS)
def test_what_is_granted_when_connack_says_nothing(version):
    fake = Fake(version, window=1000, keep_alive=30).open()
    granted = fake.link.granted
    assert granted is not None
    assert (granted.client_id, granted.window, granted.keep_alive) == ("robot", 1000, 30)
    assert (granted.maximum_qos, granted.retain, granted.maximum_packet_size) == (2, True, None)
    assert (granted.wildcards, granted.identifiers) == (True, version == 5)


def test_a_session_that_is_still_there():
    fake = Fake(clean_start=False, session_expiry=60)
    fake.start()
    fake.say(Connack(session_present=True))
    (opened,) = fake.heard()
    assert isinstance(opened, Opened) and opened.granted.session_present


@pytest.mark.parametrize(
    ("wire", "refuses_version", "words"),
    [
        (Connack(reason_code=0x84).encode(5), True, "0x84 Unsupported protocol version"),
        (b"\x20\x02\x00\x01", True, "0x84 Unsupported protocol version"),  # a server of 3.1.1
        (Connack(reason_code=0x87).encode(5), False, "0x87 Not authorized"),
        (
            Connack(
                reason_code=0x9D,
                properties={Property.SERVER_REFERENCE: "b", Property.REASON_STRING: "moved\n"},
            ).encode(5),
            False,
            "0x9d Server moved, 'moved\\n', go to 'b'",
        ),
    ],
)
def test_a_refused_connection(wire, refuses_version, words):
    fake = Fake()
    fake.start()
    fake.say(wire)
    ended = fake.link.ended
    assert ended is not None
    assert (ended.by, ended.refused, ended.is_new) == (EndedBy.BROKER, True, True)
    assert ended.refuses_version is refuses_version
    assert ended.server_reference == ("b" if "go to" in words else None)
    assert ended.text == f"the broker refuses the connection: {words}"
    assert fake.heard() == [] and fake.sent() == []


def test_a_connection_that_is_lost_before_connack_says_so():
    fake = Fake()
    fake.start()
    fake.say(b"\x20")
    fake.link.lost("connection reset")
    ended = fake.link.ended
    assert ended is not None
    assert (ended.by, ended.is_new, ended.refused) == (EndedBy.NETWORK, True, False)
    assert ended.text == "connection reset, inside a packet"
    fake.link.lost("again")
    fake.link.close()
    assert fake.link.ended is ended and fake.sent() == []


def test_no_connack():
    fake = Fake()
    fake.start()
    assert fake.tick() == PATIENCE
    fake.tick(PATIENCE - 0.1)
    assert fake.link.ended is None
    fake.tick(0.2)
    assert fake.ending()[2] == "no CONNACK within 30 s"


def test_connack_before_connect_and_twice():
    early: FleetConnection[str] = FleetConnection(ConnectSettings("robot"))
    assert early.receive(Connack().encode(5), 0.0) == []
    assert early.ended is not None and early.ended.code == ReasonCode.PROTOCOL_ERROR
    fake = Fake().open()
    fake.say(Connack())
    fake.check_failed(ReasonCode.PROTOCOL_ERROR, "a CONNACK may not come after CONNACK")


def test_receive_maximum_0():
    fake = Fake()
    fake.start()
    fake.say(Connack(properties={Property.RECEIVE_MAXIMUM: 0}))
    fake.check_failed(ReasonCode.PROTOCOL_ERROR, "RECEIVE_MAXIMUM must not be 0")


# --- authentication


@pytest.mark.statement("5.0", "MQTT-4.12.0-3")
def test_authentication_and_authentication_again():
    fake = Fake(method="m", authentication_data=b"1", keep_alive=600)
    fake.start()
    held = {Property.AUTHENTICATION_METHOD: "m", Property.AUTHENTICATION_DATA: b"2"}
    fake.say(Auth(0x18, held))
    assert fake.heard() == [Challenged(b"2", "")]
    fake.link.answer(b"3")
    three = {Property.AUTHENTICATION_METHOD: "m", Property.AUTHENTICATION_DATA: b"3"}
    assert fake.sent() == [Auth(0x18, three)]
    fake.say(Connack(properties=held))
    (opened,) = fake.heard()
    assert isinstance(opened, Opened) and opened.granted.authentication_data == b"2"
    fake.protocol.accept()
    fake.link.reauthenticate(b"3")
    assert fake.sent() == [Auth(0x19, three)]
    with pytest.raises(ValueError):
        fake.link.reauthenticate(b"3")
    fake.say(Auth(0x18, held), Auth(0, held))
    assert fake.heard() == [Challenged(b"2", ""), Reauthenticated(b"2")]
    fake.link.reauthenticate(b"3")
    fake.sent()
    fake.tick()
    fake.tick(PATIENCE)
    assert fake.ending()[2] == "no AUTH within 30 s"


@pytest.mark.statement("5.0", "MQTT-4.12.0-7")
def test_no_auth_without_a_method():
    for fake in (Fake().open(), Fake(4, method="m").open()):
        with pytest.raises(ValueError):
            fake.link.answer(b"")
        with pytest.raises(ValueError):
            fake.link.reauthenticate(b"")
        assert fake.sent() == []


# --- publishing


def encoded(properties: Properties) -> bytes:
    return encode_properties(properties)


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("qos", [0, 1])
@pytest.mark.parametrize("retain", [False, True])
@pytest.mark.parametrize("size", [0, 100, 130, 20_000])
def test_what_is_published_is_what_the_codec_encodes(version, qos, retain, size):
    fake = Fake(version).open()
    held: Properties = {
        Property.MESSAGE_EXPIRY_INTERVAL: 10,
        Property.USER_PROPERTY: [("id", "1"), ("id", "2")],
    }
    payload = bytes(size)
    for n in range(1, 3):
        assert fake.link.publish("t", "a/é", payload, qos, retain, encoded(held)) == 0
        expected = Publish("a/é", payload, qos, retain, False, n if qos else None, held)
        assert fake.link.waiting == len(expected.encode(version))
        assert fake.link.held == fake.link.waiting
        assert b"".join(fake.link.take(0.0)) == expected.encode(version)
    assert fake.link.inflight == 2 * qos


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["a", "b/c", "é" * 70]),
            st.integers(0, 300),
            st.booleans(),
            st.booleans(),
        ),
        max_size=12,
    ),
    st.sampled_from(VERSIONS),
)
@examples(60)
def test_any_messages_are_encoded_as_by_the_codec(messages, version):
    fake = Fake(version).open()
    packet_id = 0
    for topic, size, at_least_once, retain in messages:
        packet_id += at_least_once
        assert fake.link.publish("t", topic, bytes(size), int(at_least_once), retain) == 0
        expected = Publish(
            topic, bytes(size), int(at_least_once), retain, False, packet_id * at_least_once or None
        )
        assert b"".join(fake.link.take(0.0)) == expected.encode(version)


def test_tokens_come_back_with_their_codes():
    fake = Fake().open()
    for n in range(6):
        fake.link.publish(f"token {n}", "a", b"")
    assert [packet.packet_id for packet in fake.sent()] == [1, 2, 3, 4, 5, 6]  # type: ignore[union-attr]
    assert fake.link.unsettled() == [f"token {n}" for n in range(6)]
    full = Puback(4, 0x97, {Property.REASON_STRING: "full"})
    fake.say(Puback(1), Puback(3), Puback(2, 0x10), full, Puback(6))
    assert fake.heard() == [
        Acknowledged(["token 0", "token 2"], 0),
        Acknowledged(["token 1"], 0x10),
        Acknowledged(["token 3"], 0x97, "full"),
        Acknowledged(["token 5"], 0),
    ]
    assert fake.link.unsettled() == ["token 4"]


@pytest.mark.statement("5.0", "MQTT-3.3.4-7", "MQTT-3.3.4-8")
def test_no_more_than_the_window_is_under_way():
    fake = Fake().open(receive_maximum=3)
    for n in range(3):
        assert fake.link.room == 3 - n
        assert fake.link.publish("t", "a", b"") == 0
    assert fake.link.room == 0
    assert fake.link.publish("t", "a", b"") == ReasonCode.RECEIVE_MAXIMUM_EXCEEDED
    assert fake.link.publish("t", "a", b"", qos=0) == 0  # other packets are not held back
    fake.link.subscribe([Subscription("a")])
    fake.link.ping()
    kinds = [type(packet) for packet in fake.sent()]
    assert kinds == [Publish] * 4 + [Subscribe, Pingreq]
    fake.say(Puback(2, 0x97))
    assert fake.link.room == 1
    assert fake.link.publish("t", "a", b"") == 0


def test_the_window_is_ours_if_that_is_less():
    assert Fake(window=5).open(receive_maximum=20).link.room == 5


def test_packet_identifiers_are_free_ones():
    """[MQTT-2.3.1-2] v5 [MQTT-2.2.1-3]"""
    fake = Fake(window=65_535).open()
    fake.link._last_id = 65_533
    for n in range(3):
        fake.link.publish(str(n), "a", b"")
    fake.link.subscribe([Subscription("a")])
    found = fake.sent()
    assert [packet.packet_id for packet in found] == [65_534, 65_535, 1, 2]  # type: ignore[union-attr]
    fake.link._last_id = 65_533
    fake.link.publish("3", "a", b"")
    fake.link.unsubscribe(["a"])
    assert [packet.packet_id for packet in fake.sent()] == [3, 4]  # type: ignore[union-attr]
    fake.say(Puback(3))
    fake.link.publish("4", "a", b"")  # not the one that was free last
    assert [packet.packet_id for packet in fake.sent()] == [5]  # type: ignore[union-attr]


def test_nothing_is_published_before_connack_or_after_the_end():
    fake = Fake()
    fake.start()
    refused = ReasonCode.RECEIVE_MAXIMUM_EXCEEDED
    assert [fake.link.publish("t", "a", b"", qos) for qos in (0, 1)] == [refused] * 2
    fake = Fake().open()
    fake.link.close()
    assert [type(packet) for packet in fake.sent()] == [Disconnect]
    assert [fake.link.publish("t", "a", b"", qos) for qos in (0, 1)] == [refused] * 2
    fake.link.ping()
    fake.link.unsubscribe(["a"])
    assert fake.link.subscribe([Subscription("a")]) == [
        (Subscription("a"), ReasonCode.UNSPECIFIED_ERROR)
    ]
    assert fake.sent() == []


def test_qos_2_is_not_sent():
    with pytest.raises(ValueError):
        Fake().open().link.publish("t", "a", b"", 2)


@pytest.mark.statement("5.0", "MQTT-3.2.2-15")
@pytest.mark.parametrize("limit", [20, 128, 129, 130, 131, 132, 16_385, 16_386, 16_387, 16_388])
def test_maximum_packet_size_is_that_of_the_whole_packet(limit):
    fake = Fake().open(maximum_packet_size=limit)
    largest = 0
    for size in range(max(0, limit - 20), limit):
        whole = len(Publish("a", bytes(size), 1, packet_id=1).encode(5))
        code = fake.link.publish("t", "a", bytes(size))
        assert code == (0 if whole <= limit else ReasonCode.PACKET_TOO_LARGE)
        largest = max(largest, whole) if code == 0 else largest
    assert limit - 1 <= largest <= limit
    assert all(len(wire) <= limit for wire in fake.link.take(0.0))


@pytest.mark.statement("5.0", "MQTT-3.2.2-14", "MQTT-3.2.2-11")
def test_retain_and_qos_that_the_broker_does_not_have():
    fake = Fake().open(retain_available=0)
    assert fake.link.publish("t", "a", b"", 1, True) == ReasonCode.RETAIN_NOT_SUPPORTED
    assert fake.link.publish("t", "a", b"", 1, False) == 0
    fake = Fake().open(maximum_qos=0)
    assert fake.link.publish("t", "a", b"", 1) == ReasonCode.QOS_NOT_SUPPORTED
    assert fake.link.publish("t", "a", b"", 0, True) == 0
    assert len(fake.sent()) == 1


@pytest.mark.parametrize("version", VERSIONS)
def test_unknown_identifiers_end_the_connection(version):
    for packet in (Puback(7), Pubrec(7), Pubcomp(7), Suback(7, [0]), Unsuback(7, [0])):
        fake = Fake(version).open()
        fake.say(packet)
        fake.check_failed(ReasonCode.PROTOCOL_ERROR, f"a {packet.TYPE.name} for 7")
    for packet in (Pubrec(1), Suback(1, [0])):  # of another packet than the one that was sent
        fake = Fake(version).open()
        fake.link.publish("t", "a", b"")
        fake.sent()
        fake.say(packet)
        fake.check_failed(ReasonCode.PROTOCOL_ERROR, f"a {packet.TYPE.name} for 1")
    fake = Fake(version).open()
    fake.link.publish("t", "a", b"")
    fake.sent()
    fake.say(Puback(1), Puback(1))
    assert fake.heard() == [Acknowledged(["t"], 0)]  # what came before counts
    fake.check_failed(ReasonCode.PROTOCOL_ERROR, "a PUBACK for 1")


# --- subscribing


def test_subscriptions_in_batches():
    fake = Fake(filters_per_packet=8).open()
    wanted = [Subscription(f"cmd/{n}", 1, no_local=True) for n in range(10)]
    other = [Subscription("other", 1, identifier=5)]
    assert fake.link.subscribe([*wanted, *other]) == []
    first, second, third = fake.sent()
    assert isinstance(first, Subscribe) and first.subscriptions == wanted[:8]
    assert isinstance(second, Subscribe) and second.subscriptions == wanted[8:]
    assert isinstance(third, Subscribe)
    assert third.properties == {Property.SUBSCRIPTION_IDENTIFIER: [5]}
    fake.say(Suback(2, [1, 0x87], {Property.REASON_STRING: "no"}))
    assert fake.heard() == [
        Subscribed([(wanted[8], 1), (wanted[9], 0x87)], complete=False, reason="no")
    ]
    fake.say(Suback(1, [0] * 8), Suback(3, [1]))
    assert fake.heard() == [
        Subscribed([(each, 0) for each in wanted[:8]], complete=False),
        Subscribed([(other[0], 1)], complete=True),
    ]


def test_subscriptions_that_the_broker_does_not_have():
    fake = Fake().open(
        wildcard_subscription_available=0,
        shared_subscription_available=0,
        subscription_identifier_available=0,
        maximum_packet_size=100,
    )
    refusals = [
        (Subscription("a/#"), ReasonCode.WILDCARD_SUBSCRIPTIONS_NOT_SUPPORTED),
        (Subscription("+/a"), ReasonCode.WILDCARD_SUBSCRIPTIONS_NOT_SUPPORTED),
        (Subscription("$share/g/a"), ReasonCode.SHARED_SUBSCRIPTIONS_NOT_SUPPORTED),
        (Subscription("$share/g"), ReasonCode.TOPIC_FILTER_INVALID),
        (Subscription("a", identifier=1), ReasonCode.SUBSCRIPTION_IDENTIFIERS_NOT_SUPPORTED),
        (Subscription("a" * 100), ReasonCode.PACKET_TOO_LARGE),
    ]
    good = [Subscription("b" * 30), Subscription("c" * 30), Subscription("d" * 30)]
    assert fake.link.subscribe([*(each for each, _ in refusals), *good]) == refusals
    wires = fake.link.take(0.0)
    assert len(wires) == 2 and all(len(wire) <= 100 for wire in wires)


@pytest.mark.parametrize("version", VERSIONS)
def test_unsubscribing(version):
    fake = Fake(version, filters_per_packet=2).open()
    fake.link.unsubscribe(["a", "b", "c"])
    first, second = fake.sent()
    assert isinstance(first, Unsubscribe) and list(first.filters) == ["a", "b"]
    assert isinstance(second, Unsubscribe) and list(second.filters) == ["c"]
    fake.say(Unsuback(1, [0, 0x11]), Unsuback(2, [0]))
    code = 0x11 if version == 5 else 0
    assert fake.heard() == [Unsubscribed([("a", 0), ("b", code)]), Unsubscribed([("c", 0)])]


@pytest.mark.parametrize("codes", [[1], [1, 1, 1]])
def test_an_answer_of_another_length(codes):
    """v5 [MQTT-3.8.4-6] [MQTT-3.11.3-1]"""
    fake = Fake().open()
    fake.link.subscribe([Subscription("a", 1), Subscription("b", 1)])
    fake.sent()
    fake.say(Suback(1, codes))
    fake.check_failed(ReasonCode.PROTOCOL_ERROR, f"{len(codes)} reason codes for 2 filters")
    fake = Fake().open()
    fake.link.unsubscribe(["a", "b"])
    fake.sent()
    fake.say(Unsuback(1, [0] * len(codes)))
    fake.check_failed(ReasonCode.PROTOCOL_ERROR, f"{len(codes)} reason codes for 2 filters")


def test_an_answer_of_another_kind():
    fake = Fake().open()
    fake.link.subscribe([Subscription("a", 1)])
    fake.sent()
    fake.say(Unsuback(1, [0]))
    fake.check_failed(ReasonCode.PROTOCOL_ERROR, "UNSUBACK for 1")


# --- receiving


def test_messages_arrive_with_what_they_have():
    fake = Fake().open()
    held: Properties = {
        Property.CONTENT_TYPE: "application/json",
        Property.USER_PROPERTY: [("appliance-via", "r2d2")],
        Property.SUBSCRIPTION_IDENTIFIER: [3],
    }
    fake.say(
        Publish("a", b"0", 0, True),
        Publish("b", b"1", 1, packet_id=9, dup=True),
        Publish("c", b"2", 1, packet_id=10, properties=held),
    )
    plain, duplicate, full = fake.heard()
    assert plain == Arrived("a", b"0", 0, True, False, 0, None, b"\0", 100.0)
    assert duplicate == Arrived("b", b"1", 1, False, True, 9, None, b"\0", 100.0)
    assert isinstance(full, Arrived) and full.properties is not None
    assert full.properties[Property.SUBSCRIPTION_IDENTIFIER] == [3]
    passed_on, _ = decode_properties(
        full.properties_wire, 0, len(full.properties_wire), PacketType.PUBLISH
    )
    assert passed_on is not None
    assert passed_on[Property.USER_PROPERTY] == [("appliance-via", "r2d2")]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.statement("5.0", "MQTT-4.5.0-2", "MQTT-4.6.0-2")
def test_acknowledgements_leave_in_the_order_of_arrival(version):
    fake = Fake(version).open()
    for n in (5, 3, 9, 4):
        fake.say(Publish("a", b"", 1, packet_id=n))
    assert fake.link.unacknowledged == 4
    fake.link.acknowledge(9)
    fake.link.acknowledge(3, 0x87)
    assert fake.sent() == []
    fake.link.acknowledge(5)
    refusal = 0x87 if version == 5 else 0
    assert fake.sent() == [Puback(5), Puback(3, refusal), Puback(9)]
    fake.link.acknowledge(4)
    assert fake.sent() == [Puback(4)]
    for unknown in (4, 77):
        with pytest.raises(ValueError):
            fake.link.acknowledge(unknown)
    fake.say(Publish("a", b"", 1, packet_id=5))  # the identifier is free again
    with pytest.raises(ValueError):
        fake.link.acknowledge(5, 0x8F)
    fake.link.acknowledge(5)
    assert fake.link.unacknowledged == 0


def test_nothing_is_acknowledged_after_the_end():
    fake = Fake().open()
    fake.say(Publish("a", b"", 1, packet_id=1))
    fake.link.lost("gone")
    fake.link.acknowledge(1)
    assert fake.sent() == []


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.statement("5.0", "MQTT-4.6.0-3")
def test_qos_2_arrives_once(version):
    """[MQTT-4.3.3-2] v5 [MQTT-4.3.3-8] to [MQTT-4.3.3-12]"""
    fake = Fake(version).open()
    message = Publish("a", b"x", 2, packet_id=1)
    again = Publish("a", b"x", 2, dup=True, packet_id=1)
    fake.say(Publish("a", b"", 1, packet_id=2), message, again)
    assert len(fake.heard()) == 2
    fake.link.acknowledge(1)
    assert fake.sent() == []  # the QoS 1 message came first
    fake.link.acknowledge(2)
    assert fake.sent() == [Puback(2), Pubrec(1)]
    fake.say(again)
    assert fake.heard() == []
    assert fake.sent() == [Pubrec(1)]
    assert fake.link.unacknowledged == 1
    fake.say(Pubrel(1))
    assert fake.sent() == [Pubcomp(1)]
    fake.say(Pubrel(1))  # of which nothing is known any more
    assert fake.sent() == [Pubcomp(1, 0x92 if version == 5 else 0)]
    fake.say(message)
    assert len(fake.heard()) == 1 and fake.link.unacknowledged == 1


def test_a_refused_qos_2_message_is_over():
    """v5 section 4.3.3: its identifier is free after PUBREC with 0x80 or above"""
    fake = Fake().open()
    fake.say(Publish("a", b"x", 2, packet_id=1))
    fake.link.acknowledge(1, 0x97)
    assert fake.sent() == [Pubrec(1, 0x97)]
    assert fake.link.unacknowledged == 0
    fake.say(Publish("a", b"y", 2, packet_id=1))
    assert len(fake.heard()) == 2


@pytest.mark.parametrize(
    "packets",
    [
        [Publish("a", b"", 1, packet_id=1), Publish("a", b"", 1, packet_id=1)],
        [Publish("a", b"", 1, packet_id=1), Publish("a", b"", 2, packet_id=1)],
        [Publish("a", b"", 2, packet_id=1), Publish("a", b"", 1, packet_id=1)],
    ],
)
@pytest.mark.parametrize("version", VERSIONS)
def test_an_identifier_in_use(packets, version):
    """[MQTT-2.3.1-4] v5 [MQTT-2.2.1-4]"""
    fake = Fake(version).open()
    fake.say(*packets)
    assert len(fake.heard()) == 1
    fake.check_failed(ReasonCode.PROTOCOL_ERROR, "the packet identifier 1, which is in use")


def test_a_message_that_3_1_1_sends_again_arrives_once():
    fake = Fake(4).open()
    fake.say(
        Publish("a", b"", 1, packet_id=1),
        Publish("a", b"", 1, dup=True, packet_id=1),
    )
    assert len(fake.heard()) == 1 and fake.link.ended is None
    fake.link.acknowledge(1)
    assert fake.sent() == [Puback(1)]
    fake = Fake(5).open()
    fake.say(
        Publish("a", b"", 1, packet_id=1),
        Publish("a", b"", 1, dup=True, packet_id=1),
    )
    fake.check_failed(ReasonCode.PROTOCOL_ERROR, "which is in use")


def test_pubrel_before_its_pubrec():
    fake = Fake().open()
    fake.say(Publish("a", b"", 2, packet_id=1), Pubrel(1))
    fake.check_failed(ReasonCode.PROTOCOL_ERROR, "PUBREL for 1 before its PUBREC")


def test_a_broker_that_sends_more_than_we_allow():
    """v5 [MQTT-3.3.4-9]"""
    fake = Fake(receive_maximum=3).open()
    fake.say(Publish("a", b"", 2, packet_id=1), Publish("a", b"", 1, packet_id=2))
    fake.link.acknowledge(1)
    fake.say(Publish("a", b"", 1, packet_id=3), Publish("a", b"", 0))
    assert len(fake.heard()) == 4 and fake.link.ended is None
    fake.sent()
    fake.say(Publish("a", b"", 1, packet_id=4))
    fake.check_failed(ReasonCode.RECEIVE_MAXIMUM_EXCEEDED, "more than 3 messages")


@pytest.mark.parametrize(
    ("wire", "code", "text"),
    [
        (b"\x30\x04\x00\x00\x00x", ReasonCode.PROTOCOL_ERROR, "without a topic"),
        (b"\x30\xff\xff\xff\xff", ReasonCode.MALFORMED_PACKET, "four bytes"),
        (b"\x30\xff\xff\xff\x7f", ReasonCode.PACKET_TOO_LARGE, "more than the limit"),
        (
            Publish("a", b"", properties={Property.TOPIC_ALIAS: 33}).encode(5),
            ReasonCode.TOPIC_ALIAS_INVALID,
            "topic alias 33",
        ),
        (b"\x00\x00", ReasonCode.PROTOCOL_ERROR, "packet type 0"),
        (Subscribe(1, [Subscription("a")]).encode(5), ReasonCode.PROTOCOL_ERROR, "SUBSCRIBE"),
        (Pingresp().encode(5), ReasonCode.PROTOCOL_ERROR, "without a PINGREQ"),
    ],
)
def test_wrong_bytes_end_the_connection_with_the_reason(wire, code, text):
    fake = Fake().open()
    fake.say(Publish("first", b"x"), wire, Publish("last", b"x"))
    (first,) = fake.heard()
    assert isinstance(first, Arrived) and first.topic == "first"
    fake.check_failed(code, text)


@pytest.mark.parametrize(
    ("topic", "flaw"),
    [
        (b"a/#", "+ or #"),
        (b"a\0", "U+0000"),
        (b"\x7f", "control"),
        (b"\xff", "UTF-8"),
        (b"\0\xa0", "UTF-8"),
    ],
)
@pytest.mark.parametrize("version", [V311, V5])
def test_a_topic_that_its_publisher_has_made_so_ends_nothing(topic, flaw, version):
    """[MQTT-1.5.3-1] excepted: the broker may pass on what it was sent"""
    fake = Fake(version=version).open()
    wire = struct.pack(">H", len(topic)) + topic + (b"\0x" if version == V5 else b"x")
    for _ in range(2):  # it is not remembered as a good one
        fake.say(bytes((0x30, len(wire))) + wire)
    if flaw == "UTF-8" and version == V311:
        fake.check_failed(ReasonCode.MALFORMED_PACKET, flaw)
        return
    fake.say(Publish("last", b"x"))
    *heard, last = fake.heard()
    assert [flaw in each.flaw for each in heard] == [True, True]
    assert last.topic == "last" and not last.flaw and fake.link.ended is None


def test_a_disconnect_is_no_larger_than_the_broker_takes():
    """v5 [MQTT-3.14.2-3]"""
    fake = Fake().open(maximum_packet_size=20)
    fake.say(b"\x00\x00")
    (wire,) = fake.link.take(0.0)
    assert wire == Disconnect(0x82).encode(5)
    fake = Fake().open()
    fake.say(b"\x00\x00")
    (packet,) = fake.sent()
    assert isinstance(packet, Disconnect)
    assert packet.properties == {Property.REASON_STRING: "packet type 0 is reserved"}


# --- the end


def test_the_broker_disconnects():
    fake = Fake().open()
    held: Properties = {Property.SERVER_REFERENCE: "b:1883", Property.REASON_STRING: "full"}
    fake.say(Publish("a", b"x"), Disconnect(0x9C, held), Publish("b", b"x"))
    assert len(fake.heard()) == 1
    ended = fake.link.ended
    assert ended is not None
    assert (ended.by, ended.code, ended.is_new) == (EndedBy.BROKER, 0x9C, False)
    assert ended.server_reference == "b:1883"
    assert ended.text == "the broker disconnects: 0x9c Use another server, 'full', go to 'b:1883'"
    assert fake.sent() == []


@pytest.mark.parametrize("version", VERSIONS)
def test_we_disconnect(version):
    """3.1.1 [MQTT-3.14.4-3]: every DISCONNECT removes the will"""
    fake = Fake(version).open()
    fake.link.close(text="stopped")
    assert fake.sent() == [Disconnect()]
    assert fake.ending() == (EndedBy.US, 0, "stopped")
    fake = Fake(version).open()
    fake.link.close(ReasonCode.DISCONNECT_WITH_WILL_MESSAGE)
    assert fake.sent() == ([Disconnect(4)] if version == 5 else [])
    never: FleetConnection[str] = FleetConnection(ConnectSettings("robot"))
    never.close()
    assert never.take(0.0) == []


# --- time


@pytest.mark.statement("5.0", "MQTT-3.1.2-20")
def test_pings_of_a_quiet_connection():
    fake = Fake(keep_alive=10).open()
    assert fake.tick() == pytest.approx(9)
    assert fake.tick(8.9) == pytest.approx(0.1)
    assert fake.sent() == []
    fake.tick(0.1)
    assert fake.sent() == [Pingreq()]
    assert fake.tick(2) == pytest.approx(3)
    fake.say(Pingresp())
    assert fake.link.round_trip == pytest.approx(2)
    # What is sent counts, and what is not received as well.
    for _ in range(4):
        fake.link.publish("t", "a", b"", 0)
        fake.tick(2)
        assert [type(packet) for packet in fake.sent()] == [Publish]
    fake.tick(2)
    assert fake.sent() == [Pingreq()]


def test_what_is_received_is_no_reason_not_to_ping():
    """[MQTT-3.1.2-23] v5 [MQTT-3.1.2-20]: the broker counts what it is sent"""
    fake = Fake(keep_alive=10).open()
    for _ in range(5):
        fake.say(Publish("a", b""))
        fake.tick(2)
    assert fake.sent() == [Pingreq()]


@pytest.mark.statement("5.0", "MQTT-3.1.2-21", "MQTT-3.2.2-21")
def test_the_keep_alive_is_the_servers():
    fake = Fake(keep_alive=1000).open(server_keep_alive=20)
    fake.tick(17.9)
    assert fake.sent() == []
    fake.tick(0.2)
    assert fake.sent() == [Pingreq()]
    fake = Fake(keep_alive=0).open()
    assert fake.tick(10_000) == math.inf
    assert fake.sent() == []
    fake = Fake(keep_alive=10).open(server_keep_alive=0)  # we look whether it is there all the same
    fake.tick(10)
    assert fake.sent() == [Pingreq()]


def test_a_silent_broker_is_noticed_within_one_and_a_half_keep_alives():
    fake = Fake(keep_alive=10).open()
    begin = fake.now
    due = fake.tick()
    while fake.link.ended is None:
        due = fake.tick(min(due, 1.0))
        fake.sent()
    assert 10 < fake.now - begin < 15
    assert fake.ending()[0] is EndedBy.NETWORK
    assert "no PINGRESP" in fake.ending()[2]
    assert due == math.inf and fake.sent() == []


def test_a_process_that_was_held_up_does_not_blame_the_broker():
    fake = Fake(keep_alive=10).open()
    fake.tick()
    fake.tick(9)
    fake.sent()
    fake.tick(0.5)
    fake.tick(60)  # suspended; the answer waits in the socket
    assert fake.link.ended is None
    fake.say(Pingresp())
    fake.tick(1)
    assert fake.link.ended is None
    fake.link.publish("t", "a", bytes(1000))
    fake.link.take(fake.now)
    fake.tick(0, 500)
    fake.tick(60, 500)
    assert fake.link.ended is None


def test_several_pings_bound_the_age_of_what_arrives():
    fake = Fake(keep_alive=60).open()  # CONNECT was sent at 100
    message = Publish("cmd_vel", b"")

    def not_before() -> float:
        fake.say(message)
        (arrived,) = fake.heard()
        assert isinstance(arrived, Arrived)
        return arrived.not_before

    assert not_before() == 100.0
    for at in (100.25, 100.5, 100.75):
        fake.now = at
        fake.link.ping()
        fake.sent()
    fake.now = 101.0
    assert not_before() == 100.0
    fake.say(Pingresp(), message, Pingresp(), message)
    first, second = fake.heard()
    assert isinstance(first, Arrived) and isinstance(second, Arrived)
    assert (first.not_before, second.not_before) == (100.25, 100.5)
    assert fake.link.not_before == 100.5
    assert fake.link.round_trip == 0.5
    fake.now = 102.0
    fake.link.ping()  # counts from when it is sent
    fake.now = 103.0
    fake.sent()
    fake.say(Pingresp(), Pingresp())
    assert not_before() == 103.0


def test_a_ping_bounds_the_age_of_messages_that_wait_for_acknowledgements_only_if_none_can():
    """A broker that has as many in flight as it may sends the rest behind its PINGRESP."""
    fake = Fake().open()
    fake.now = 101.0
    fake.link.ping()
    fake.sent()
    some = [Publish("a", b"", 1, packet_id=number) for number in range(1, LEAST_WINDOW + 1)]
    fake.say(*some, Pingresp(), Publish("a", b"", 1, packet_id=99), Publish("a", b""))
    *_, one, none = fake.heard()
    assert isinstance(one, Arrived) and isinstance(none, Arrived)
    assert (one.not_before, none.not_before) == (100.0, 101.0)
    for message in (*some, one):
        fake.link.acknowledge(message.packet_id or 0)
    fake.now = 102.0
    fake.link.ping()
    fake.sent()
    fake.say(Pingresp(), Publish("a", b"", 1, packet_id=1))
    (one,) = fake.heard()
    assert isinstance(one, Arrived) and one.not_before == 102.0


def test_what_a_kept_session_held_is_of_unknown_age():
    fake = Fake(clean_start=False, session_expiry=100)
    fake.start()
    fake.say(Connack(True), Publish("a", b"", 1, packet_id=1), Publish("a", b""))
    _, one, none = fake.heard()
    assert isinstance(one, Arrived) and isinstance(none, Arrived)
    assert one.not_before == none.not_before == -math.inf


def test_a_pingresp_for_a_ping_that_was_not_sent_yet():
    fake = Fake().open()
    fake.link.ping()
    fake.say(Pingresp())
    assert fake.ending()[1] == ReasonCode.PROTOCOL_ERROR


def test_pings_that_are_never_answered_are_bounded():
    fake = Fake(keep_alive=60).open()
    for _ in range(MAXIMUM_PINGS + 5):
        fake.link.ping()
    assert len(fake.sent()) == MAXIMUM_PINGS
    fake.tick()
    for _ in range(int(PATIENCE)):  # it is not silent
        assert fake.link.ended is None
        fake.say(Publish("a", b""))
        fake.tick(1)
    assert fake.ending()[0] is EndedBy.NETWORK


def test_pings_behind_a_large_message_that_leaves_slowly_are_not_missed():
    """One every 50 ms, and a map that takes two minutes: all of them leave together, after it."""
    fake = Fake(keep_alive=60).open()
    size = 12_000_000
    fake.link.publish("t", "map", bytes(size))
    fake.link.take(fake.now)
    for left in range(size, 0, -size // 240):
        for _ in range(10):
            fake.link.ping()
        fake.link.take(fake.now)
        fake.tick(0.5, left)
        assert fake.link.ended is None
    fake.tick(0.5)
    assert fake.link.ended is None
    fake.say(*[Pingresp()] * MAXIMUM_PINGS)
    fake.tick(1)
    assert fake.link.ended is None


@pytest.mark.parametrize("what", ["PUBACK", "SUBACK", "UNSUBACK"])
def test_an_answer_that_does_not_come_ends_the_connection(what):
    fake = Fake(keep_alive=60).open()
    asks: dict[str, Callable[[], object]] = {
        "PUBACK": lambda: fake.link.publish("t", "a", b""),
        "SUBACK": lambda: fake.link.subscribe([Subscription("a")]),
        "UNSUBACK": lambda: fake.link.unsubscribe(["a"]),
    }
    asks[what]()
    fake.sent()
    if what == "PUBACK":
        fake.now += 10
        fake.link.publish("later", "a", b"")  # is answered; the oldest is not
        fake.sent()
        fake.say(Puback(2))
        fake.now -= 10
    assert fake.tick() == PATIENCE
    fake.tick(PATIENCE - 0.01)
    assert fake.link.ended is None
    fake.tick(0.02)
    assert fake.ending() == (EndedBy.NETWORK, 0x80, f"no {what} within 30 s")
    assert fake.link.unsettled() == (["t"] if what == "PUBACK" else [])


def test_an_answer_is_awaited_from_when_the_packet_has_left():
    """A slow network takes its time; nothing is missing while bytes move."""
    fake = Fake(keep_alive=600).open()
    fake.link.publish("t", "a", bytes(1000))
    size = sum(map(len, fake.link.take(fake.now)))
    for unsent in range(size, 0, -100):
        fake.tick(20, unsent)
        assert fake.link.ended is None
    fake.tick(20)
    fake.tick(29)
    assert fake.link.ended is None or "PUBACK" in fake.ending()[2]
    fake.tick(31)
    assert fake.ending()[2] == "no PUBACK within 30 s"


def test_a_broker_that_never_reads():
    fake = Fake(keep_alive=600).open()
    fake.link.publish("t", "a", bytes(1000), 0)
    fake.link.take(fake.now)
    for _ in range(29):
        fake.tick(1, 500)
    assert fake.link.ended is None
    fake.tick(1, 400)
    for _ in range(29):
        fake.tick(1, 400)
    assert fake.link.ended is None
    fake.tick(2, 400)
    assert fake.ending()[2] == "the broker has read nothing for 30 s"


# --- any bytes


@st.composite
def server_streams(draw) -> list[bytes]:
    packets: list[Packet] = [
        Publish("a", b"x"),
        Publish("a", b"x", 1, packet_id=draw(st.integers(1, 3))),
        Publish("a", b"x", 2, packet_id=draw(st.integers(1, 3))),
        Publish("b", b"x", properties={Property.TOPIC_ALIAS: 1}),
        Puback(draw(st.integers(1, 3)), draw(st.sampled_from([0, 0x10, 0x97]))),
        Pubrel(draw(st.integers(1, 3))),
        Suback(draw(st.integers(1, 4)), [0]),
        Pingresp(),
        Disconnect(0x8B),
        Connack(),
    ]
    chosen = draw(st.lists(st.sampled_from(packets), max_size=8))
    data = bytearray(b"".join(packet.encode(5) for packet in chosen))
    for place, byte in draw(st.lists(st.tuples(st.integers(0), st.integers(0, 255)), max_size=2)):
        if data:
            data[place % len(data)] = byte
    cut = draw(st.integers(0, len(data)))
    return [bytes(data[:cut]), bytes(data[cut:])]


@given(server_streams(), st.sampled_from(VERSIONS), st.booleans())
@examples(400)
def test_any_bytes_only_end_the_connection(chunks, version, opened):
    fake = Fake(version)
    if opened:
        fake.open()
        fake.link.publish("t", "a", b"")
        fake.link.publish("u", "a", b"")
        fake.link.subscribe([Subscription("a")])
        fake.link.ping()
    else:
        fake.start()
    fake.link.take(fake.now)
    for chunk in chunks:
        fake.say(chunk)
        for event in fake.heard():
            if isinstance(event, Arrived) and event.packet_id and fake.link.ended is None:
                fake.link.acknowledge(event.packet_id)
    fake.tick(1)
    if fake.link.ended is not None and fake.link.ended.by is EndedBy.US:
        last = b"".join(fake.link.take(fake.now))
        assert version == 4 or b"\xe0" in last
    assert fake.link.held < 1 << 16


def test_random_damage_ends_connections_only():
    """As above, over longer streams; the seed is fixed."""
    chance = random.Random(14)
    whole = b"".join(
        Publish("a/b", b"x" * n, n % 3, packet_id=n + 1 if n % 3 else None).encode(5)
        for n in range(40)
    )
    for _ in range(300):
        data = bytearray(whole)
        for _ in range(chance.randrange(1, 5)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        fake = Fake().open()
        start = 0
        while start < len(data):
            size = chance.randrange(1, 200)
            fake.say(bytes(data[start : start + size]))
            start += size
        assert len(fake.heard()) <= 40 * 3


def test_topics_are_cached_within_bounds():
    fake = Fake().open()
    for n in range(CACHED + 10):
        topic = f"{n}/" + "x" * (LONGEST_CACHED if n % 2 else 1)
        fake.link.publish("t", topic, b"", 0)
        fake.say(Publish(topic, b"x"))
    assert [event.topic for event in fake.heard()] == [  # type: ignore[union-attr]
        packet.topic  # type: ignore[union-attr]
        for packet in fake.sent()
    ]
    for cache in (fake.link._topics, fake.link._heard):
        assert len(cache) <= CACHED
        assert all(len(key) <= LONGEST_CACHED for key in cache)


def test_a_large_packet_is_refused_before_it_is_buffered():
    fake = Fake(maximum_packet_size=1000).open()
    fake.say(b"\x30" + encode_varint(100_000) + encode_string("a"))
    fake.check_failed(ReasonCode.PACKET_TOO_LARGE, "limit of 1000")
    assert fake.link.held == 0


# --- our own broker at the other end


class Own:
    """The link and our own broker's handler, bytes to and fro."""

    def __init__(self, version: int, limits: Limits | None = None, **fields) -> None:
        self.access = FakeAccess()
        self.broker = Broker(self.access, MemoryStore(), limits or Limits())
        self.peer = Peer(self.broker, version)
        self.link: FleetConnection[str] = FleetConnection(
            ConnectSettings("robot", version, username="user", password=b"secret", **fields)
        )
        self.link.start(0.0)
        self.events: list[FleetEvent[str]] = []
        self.exchange()
        assert self.peer.transport.asked is not None
        self.peer.client.accept("user")
        self.broker.flush()
        self.exchange()

    def exchange(self) -> None:
        while True:
            data = b"".join(self.link.take(0.0))
            if data:
                self.peer.client.receive(data)
                self.broker.flush()
            answer = bytes(self.peer.transport.written)
            self.peer.transport.written.clear()
            if not data and not answer:
                return
            # Byte by byte: any split is the same.
            for n in range(len(answer)):
                self.events += self.link.receive(answer[n : n + 1], 0.0)

    def heard(self) -> list[FleetEvent[str]]:
        events, self.events = self.events, []
        return events


@pytest.mark.parametrize("version", VERSIONS)
def test_against_our_own_broker(version):
    own = Own(version, receive_maximum=10)
    (opened,) = own.heard()
    assert isinstance(opened, Opened)
    wanted = [Subscription(f"in/{n}", 1) for n in range(3)] + [Subscription("in/#", 2)]
    assert own.link.subscribe(wanted) == []
    own.exchange()
    (subscribed,) = own.heard()
    assert isinstance(subscribed, Subscribed) and subscribed.complete
    assert [code for _, code in subscribed.results] == [1, 1, 1, 2]
    other = Peer(own.broker, version)
    other.connect("other")
    other.subscribe("out/#", 1)
    own.access.deny("user", Action.PUBLISH, "out/denied")
    for n in range(5):
        assert own.link.publish(f"token {n}", f"out/{n}", b"x" * n, n % 2) == 0
    assert own.link.publish("denied", "out/denied", b"") == 0
    own.exchange()
    found = [each for each in own.heard() if isinstance(each, Acknowledged)]
    denied = ReasonCode.NOT_AUTHORIZED if version == 5 else 0
    assert [(token, each.code) for each in found for token in each.tokens] == [
        ("token 1", 0),
        ("token 3", 0),
        ("denied", denied),
    ]
    assert len(other.messages()) == 5
    for qos in (0, 1, 2):
        other.publish("in/9", b"%d" % qos, qos)
    own.exchange()
    arrived = [each for each in own.heard() if isinstance(each, Arrived)]
    assert [(each.payload, each.qos) for each in arrived] == [(b"0", 0), (b"1", 1), (b"2", 2)]
    for each in reversed(arrived):
        if each.packet_id:
            own.link.acknowledge(each.packet_id)
    own.link.ping()
    own.exchange()
    assert own.link.unacknowledged == 0  # PUBREL and PUBCOMP as well
    assert own.link.round_trip == 0.0
    own.link.unsubscribe(["in/#"])
    own.exchange()
    assert own.heard() == [Unsubscribed([("in/#", 0)])]
    own.link.close()
    own.exchange()
    assert own.peer.transport.closed


def test_our_own_broker_s_limits_are_met():
    own = Own(5, Limits(packet_size=2000, keep_alive=20, inflight=7))
    granted = own.link.granted
    assert granted is not None
    assert granted.maximum_packet_size == 2000
    assert granted.keep_alive == 20
    sent = 0
    while own.link.room:
        assert own.link.publish("t", "a", bytes(1900)) == 0
        sent += 1
    assert sent == granted.window
    assert own.link.publish("t", "a", bytes(2000)) == ReasonCode.PACKET_TOO_LARGE
    own.exchange()
    assert own.link.inflight == 0 and own.link.ended is None


def test_our_own_broker_answers_what_the_link_does_wrong():
    own = Own(5)
    own.peer.client.receive(Connect("again").encode())
    own.broker.flush()
    own.exchange()
    assert own.link.ended is not None
    assert own.link.ended.by is EndedBy.BROKER
    assert own.link.ended.code == ReasonCode.PROTOCOL_ERROR


# --- mosquitto at the other end


@pytest.fixture(scope="module")
def mosquitto(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MosquittoProcess]:
    if MOSQUITTO is None:
        pytest.skip("there is no mosquitto: apt-get install mosquitto")
    directory: Path = tmp_path_factory.mktemp("mosquitto")
    process = MosquittoProcess(directory, {"fleet": "secret"}, "user fleet\ntopic readwrite #\n")
    process.start()
    yield process
    process.stop()


class Real:
    """The link over a plain socket."""

    def __init__(self, port: int, settings: ConnectSettings) -> None:
        self.link: FleetConnection[int] = FleetConnection(settings)
        self.socket = socket.create_connection(("127.0.0.1", port), TEST_PATIENCE)
        self.events: list[FleetEvent[int]] = []
        self.link.start(0.0)

    def until(self, condition: Callable[[], bool]) -> None:
        """Exchange bytes until the condition holds."""
        while True:
            self.socket.sendall(b"".join(self.link.take(0.0)))
            if condition():
                return
            data = self.socket.recv(65536)
            if not data:
                self.link.lost("closed")
            self.events += self.link.receive(data, 0.0)
            assert data or condition(), self.link.ended

    def of(self, kind: type) -> list:
        return [event for event in self.events if isinstance(event, kind)]


@pytest.mark.parametrize("version", VERSIONS)
def test_against_mosquitto(mosquitto: MosquittoProcess, version: int) -> None:
    wanted = ConnectSettings(
        f"robot{version}", version, username="fleet", password=b"secret", window=50, keep_alive=30
    )
    real = Real(mosquitto.plain_port, wanted)
    with real.socket:
        real.until(lambda: real.link.granted is not None)
        assert real.link.granted is not None
        assert real.link.granted.window == (20 if version == 5 else 50)  # its max_inflight_messages
        real.link.subscribe([Subscription(f"echo{version}/+/#", 2), Subscription("other", 1)])
        real.until(lambda: bool(real.of(Subscribed)))
        assert [code for _, code in real.of(Subscribed)[0].results] == [2, 1]
        wire = encode_properties({Property.USER_PROPERTY: [("id", "1")]})
        published = acknowledged = 0
        while acknowledged < 500:
            while real.link.room and published < 500:
                topic = f"echo{version}/{published % 3}" if published % 2 else "nobody"
                assert real.link.publish(published, topic, b"%d" % published, 1, False, wire) == 0
                published += 1
            before = acknowledged

            def more(before: int = before) -> bool:
                return sum(len(each.tokens) for each in real.of(Acknowledged)) > before

            real.until(more)
            for arrived in real.of(Arrived):
                if arrived.packet_id:
                    real.link.acknowledge(arrived.packet_id)
                    arrived.packet_id = 0
            acknowledged = sum(len(each.tokens) for each in real.of(Acknowledged))
        tokens = [token for each in real.of(Acknowledged) for token in each.tokens]
        assert sorted(tokens) == list(range(500))
        codes = {each.code for each in real.of(Acknowledged)}
        assert codes == ({0, 0x10} if version == 5 else {0})
        real.until(lambda: len(real.of(Arrived)) == 250)
        payloads = [arrived.payload for arrived in real.of(Arrived)]
        for n in range(3):  # in order for each topic
            topic = f"echo{version}/{n}"
            numbers = [int(each.payload) for each in real.of(Arrived) if each.topic == topic]
            assert numbers == sorted(numbers)
        assert len(set(payloads)) == 250
        real.link.ping()
        real.until(lambda: real.link.round_trip is not None)
        real.link.close()
        real.until(lambda: real.link.waiting == 0)
        assert real.socket.recv(10) == b""


@pytest.mark.parametrize("version", VERSIONS)
def test_mosquitto_refuses_a_wrong_password(mosquitto: MosquittoProcess, version: int) -> None:
    real = Real(mosquitto.plain_port, ConnectSettings("r", version, username="fleet", password=b""))
    with real.socket:
        real.until(lambda: real.link.ended is not None)
    assert real.link.ended is not None
    assert (real.link.ended.by, real.link.ended.refused) == (EndedBy.BROKER, True)
    assert "Not authorized" in real.link.ended.text
