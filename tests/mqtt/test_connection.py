"""Framing, limits, packet orders and aliases; the short forms against the full decoder."""

from __future__ import annotations

import itertools
import random
import sys
from collections.abc import Iterable

import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from test_properties import binaries, connects, packets, publishes, topics

from appliance.mqtt.client_protocol import ClientProtocol, read_topic
from appliance.mqtt.codec import Property, decode_properties, decode_string, encode_varint
from appliance.mqtt.connection import ServerProtocol
from appliance.mqtt.framing import LARGE_PACKET, MAXIMUM_CONNECT, MAXIMUM_CONTROL, Event, State
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
    UnusablePublish,
    decode_packet,
)
from appliance.mqtt.reason import ContentError, ProtocolError, ReasonCode
from appliance.mqtt.topics import check_topic

SIZE = 100_000
ALIASES = 10
ACKNOWLEDGEMENTS = {cls.TYPE: cls for cls in (Puback, Pubrec, Pubrel, Pubcomp)}


def connected(version: int, size: int = SIZE) -> ServerProtocol:
    """A connection whose client has logged in."""
    connection = ServerProtocol(size, ALIASES)
    properties = {Property.AUTHENTICATION_METHOD: "m"} if version == 5 else None
    packet = Connect("client", version=version, properties=properties)  # type: ignore[arg-type]
    (connect,) = connection.receive_data(packet.encode())
    assert isinstance(connect, Connect)
    assert connection.state is State.AUTHENTICATING
    connection.accept()
    return connection


def as_packet(event: Event, version: int) -> Packet:
    """What an event says, as the packet that it stands for."""
    if isinstance(event, int):
        kind = ACKNOWLEDGEMENTS[PacketType(event >> 16 & 0xFF)]
        return kind(event & 0xFFFF, ReasonCode(event >> 24))
    if not isinstance(event, tuple):
        return with_pairs(event)
    first, topic_wire, packet_id, payload, head = event
    topic, pos = decode_string(topic_wire, 0)
    assert pos == len(topic_wire)
    try:
        check_topic(topic)
    except ValueError as error:
        raise ProtocolError(ReasonCode.MALFORMED_PACKET, str(error)) from error
    packet = Publish(
        topic, payload, first >> 1 & 3, bool(first & 1), first >= 0x38, packet_id or None
    )
    wire = packet.encode(version)
    tail = len(payload) + (3 if version == 5 else 2) if packet_id else 0
    assert head == wire[: len(wire) - tail], "the head is not what would be encoded"
    return packet


def flawed_packet(event: Event, version: int) -> Packet | None:
    """What a client makes of a topic that cannot be used, which a server does not take."""
    if not isinstance(event, tuple):
        return None
    first, topic_wire, packet_id, _, _ = event
    topic, flaw = read_topic(topic_wire, version)
    if not flaw:
        return None
    qos, dup = first >> 1 & 3, first >= 0x38
    return UnusablePublish(topic, b"", qos, bool(first & 1), dup, packet_id or None, flaw=flaw)


#: What is of one connection, or is counted down, and so is not passed on.
OWN = Property.TOPIC_ALIAS, Property.MESSAGE_EXPIRY_INTERVAL, Property.SUBSCRIPTION_IDENTIFIER


def with_pairs(packet: Packet) -> Packet:
    """A message with the User Properties that it passes on, which nobody has looked at."""
    if isinstance(packet, Publish) and packet.properties is not None:
        wire, values = packet.passed_on, packet.properties
        passed_on = decode_properties(wire, 0, len(wire), PacketType.PUBLISH)[0] or {}
        packet.properties = passed_on | {name: values[name] for name in OWN if name in values}
        assert Property.USER_PROPERTY not in values and not set(OWN) & set(passed_on)
        assert all(packet.properties[name] == value for name, value in values.items())
    return packet


def without_pairs(packet: Packet) -> Packet:
    """Of other packets the User Properties are of no use to anybody."""
    if not isinstance(packet, Publish):
        parts = [packet, packet.will] if isinstance(packet, Connect) else [packet]
        for part in parts:
            properties = getattr(part, "properties", None)
            if part is not None and properties is not None:
                part.properties = {  # type: ignore[union-attr]
                    name: value
                    for name, value in properties.items()
                    if name is not Property.USER_PROPERTY
                } or None
    return packet


def said(
    connection: ServerProtocol | ClientProtocol, chunks: Iterable[bytes]
) -> list[Packet | ReasonCode]:
    """All that the connection makes of the chunks, and the error that ended it."""
    found: list[Packet | ReasonCode] = []
    try:
        for chunk in chunks:
            for event in connection.receive_data(chunk):
                is_client = isinstance(connection, ClientProtocol)
                flawed = flawed_packet(event, connection.version) if is_client else None
                found.append(flawed or as_packet(event, connection.version))
    except ProtocolError as error:
        found.append(error.code)
        connection.close()  # as its owner does, for a topic that is not valid
    return found


def said_slowly(data: bytes, version: int) -> list[Packet | ReasonCode]:
    """What `said` is to find, by nothing but the standard's words and the full decoder."""
    found: list[Packet | ReasonCode] = []
    aliases: dict[int, str] = {}
    try:
        while data:
            if data[0] < 0x10:
                raise ProtocolError(ReasonCode.PROTOCOL_ERROR, "reserved")
            if len(data) < 2:
                break
            digits = []
            for byte in data[1:5]:
                digits.append(byte)
                if byte < 0x80:
                    break
            if digits[-1] >= 0x80:
                if len(digits) == 4:
                    raise ProtocolError(ReasonCode.MALFORMED_PACKET, "five digits")
                break
            if len(digits) > 1 and not digits[-1]:
                raise ProtocolError(ReasonCode.MALFORMED_PACKET, "a digit too many")
            length = sum((digit & 0x7F) << 7 * place for place, digit in enumerate(digits))
            if length > 125 or len(data) >= 1 + len(digits) + length:
                check_order(data[0], version)
                if 1 + len(digits) + length > SIZE:
                    raise ProtocolError(ReasonCode.PACKET_TOO_LARGE, "too large")
            first, data = data[0], data[1 + len(digits) :]
            if len(data) < length:
                break
            packet = without_pairs(decode_packet(first, data[:length], version))
            if isinstance(packet, Publish):
                resolve(packet, aliases)
            found.append(packet)
            data = data[length:]
    except ProtocolError as error:
        found.append(error.code)
    return found


def check_order(first: int, version: int) -> None:
    """What a client may say once it is connected."""
    kind = first >> 4
    if kind in (9, 11, 13) and first & 15:
        raise ProtocolError(ReasonCode.MALFORMED_PACKET, "flags")
    if kind in (1, 2, 9, 11, 13) or (kind == 15 and version == 4):
        raise ProtocolError(ReasonCode.PROTOCOL_ERROR, "not now")


def resolve(packet: Publish, aliases: dict[int, str]) -> None:
    properties = packet.properties or {}
    if Property.SUBSCRIPTION_IDENTIFIER in properties:
        raise ProtocolError(ReasonCode.PROTOCOL_ERROR, "from a client")
    alias = properties.pop(Property.TOPIC_ALIAS, None)
    if isinstance(alias, int):
        if alias > ALIASES:
            raise ProtocolError(ReasonCode.TOPIC_ALIAS_INVALID, "too many")
        if not packet.topic and alias not in aliases:
            raise ProtocolError(ReasonCode.PROTOCOL_ERROR, "never said")
        packet.topic = packet.topic or aliases[alias]
        aliases[alias] = packet.topic
    try:
        check_topic(packet.topic)
    except ValueError as error:
        raise ContentError(ReasonCode.MALFORMED_PACKET, str(error)) from error


def split_at(data: bytes, cuts: Iterable[int]) -> list[bytes]:
    places = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[start:end] for start, end in itertools.pairwise(places)]


def same(found: list[Packet | ReasonCode], expected: list[Packet | ReasonCode]) -> bool:
    """Equal; properties that were emptied by an alias are as good as none."""
    for packet in (*found, *expected):
        if isinstance(packet, Publish):
            packet.properties = packet.properties or None
    return found == expected


versions = st.sampled_from([4, 5])
some_cuts = st.lists(st.integers(0), max_size=12)
some_damage = st.lists(st.tuples(st.integers(0), st.integers(0, 255)), min_size=1, max_size=4)


def check_splits(connected, said_slowly, conversation, cuts) -> None:
    """Whole, cut somewhere and byte by byte, it is what the full decoder says."""
    version, wires = conversation
    data = b"".join(wires)
    expected = said_slowly(data, version)
    for chunks in ([data], split_at(data, cuts), [data[n : n + 1] for n in range(len(data))]):
        assert same(said(connected(version), chunks), expected)


def check_damage(connected, said_slowly, conversation, damage, cuts) -> None:
    """With some bytes damaged as well."""
    version, wires = conversation
    data = bytearray(b"".join(wires) or b"\xd0\0")
    for place, byte in damage:
        data[place % len(data)] = byte
    check_splits(connected, said_slowly, (version, [bytes(data)]), cuts)


@st.composite
def conversations(draw) -> tuple[int, list[bytes]]:
    """A version and packets, some of them the same several times, as most clients' are."""
    version = draw(versions)
    wires = []
    for packet in draw(st.lists(packets(version) | publishes(version), min_size=1, max_size=6)):
        wires += [packet.encode(version)] * draw(st.integers(1, 3))
    return version, draw(st.permutations(wires))


@given(conversations(), some_cuts)
@examples(300)
def test_any_split_gives_the_same_events_as_the_full_decoder(conversation, cuts):
    check_splits(connected, said_slowly, conversation, cuts)


@given(conversations(), some_damage, some_cuts)
@examples(500)
def test_damaged_bytes_are_refused_as_by_the_full_decoder(conversation, damage, cuts):
    check_damage(connected, said_slowly, conversation, damage, cuts)


@st.composite
def large_messages(draw) -> tuple[int, bytes]:
    """A version and messages, large ones among them, that no two bytes of are alike for long."""
    version = draw(versions)
    wires = []
    for packet in draw(st.lists(publishes(version), min_size=1, max_size=4)):
        size = draw(st.sampled_from([0, 100, LARGE_PACKET, 2 * LARGE_PACKET, 5 * LARGE_PACKET]))
        packet.payload = random.Random(draw(st.integers(0, 9))).randbytes(size)
        packet.properties = packet.properties if draw(st.booleans()) else None
        wires += [packet.encode(version)] * draw(st.integers(1, 2))
    return version, b"".join(wires)


@given(large_messages(), some_cuts, some_damage, st.booleans())
@examples(300)
def test_a_large_message_that_came_in_pieces_is_what_the_full_decoder_says(
    messages, cuts, damage, is_damaged
):
    """It is not joined before its payload is cut out: a second way, with this slow twin."""
    version, wire = messages
    data = bytearray(wire)
    if is_damaged:
        for place, byte in damage:
            data[place % min(len(data), 40)] = byte  # of the first header, most likely
    expected = said_slowly(bytes(data), version)
    for chunks in (split_at(bytes(data), cuts), split_at(bytes(data), range(0, len(data), 5000))):
        assert same(said(connected(version), chunks), expected)


@given(versions, publishes(4), st.integers(0), st.integers(0, 255))
@examples(500)
def test_a_damaged_publish_between_two_whole_ones(version, packet, place, byte):
    """What is recognised by its head is looked at as closely as the first of its kind."""
    wire = packet.encode(version)
    damaged = bytearray(wire)
    damaged[place % len(wire)] = byte
    data = wire + bytes(damaged) + wire
    assert same(said(connected(version), [data]), said_slowly(data, version))


@given(st.binary(max_size=40), versions)
@examples(300)
def test_any_bytes_give_packets_or_one_error(data, version):
    connection = connected(version)
    assert same(said(connection, [data]), said_slowly(data, version))
    assert connection.held <= len(data)


@given(versions.flatmap(connects), versions, topics, binaries, st.lists(st.integers(0), max_size=3))
@examples(100)
def test_what_comes_behind_connect_waits_for_the_login(connect, version, topic, payload, cuts):
    connect.version = version
    if version == 4:
        connect.properties = None
        if connect.will:
            connect.will.properties = None
        connect.username = connect.username or ""
    message = Publish(topic, payload, 1, packet_id=7)
    connection = ServerProtocol(SIZE, ALIASES)
    found: list[Packet] = []
    for chunk in split_at(connect.encode() + message.encode(version), cuts):
        for event in connection.receive_data(chunk):
            found.append(as_packet(event, version))
            connection.pause()
    assert [without_pairs(packet) for packet in found] == [without_pairs(connect)]
    connection.accept()
    assert said(connection, [b""]) == [message]
    assert connection.held == 0


# --- sizes


@pytest.mark.parametrize("first", [0x30, 0x32, 0x40, 0x82, 0xC0, 0xE0])
def test_a_packet_that_is_too_large_is_refused_by_its_header(first):
    """Rule 4 of the design; v5 [MQTT-3.2.2-15]: the code is 0x95"""
    header = bytes((first,)) + encode_varint(SIZE)
    for chunks in ([header], [header[:1], header[1:2], header[2:]]):
        connection = connected(5)
        assert said(connection, chunks) == [ReasonCode.PACKET_TOO_LARGE]
        assert connection.state is State.CLOSED
        assert connection.held == 0


def test_a_packet_of_the_largest_size_is_taken():
    """5.0 section 3.1.2.11.4: the size is that of the whole packet."""
    for excess, expected in ((0, Publish), (1, ReasonCode)):
        packet = Publish("a", bytes(SIZE - 8 + excess))
        wire = packet.encode(5)
        assert len(wire) == SIZE + excess
        (found,) = said(connected(5), [wire])
        assert isinstance(found, expected)


def test_a_stranger_gets_less():
    """Before the login a packet is bounded by what a CONNECT can sensibly be."""
    connection = ServerProtocol(1 << 28, ALIASES)
    header = b"\x10" + encode_varint(MAXIMUM_CONNECT)
    assert said(connection, [header]) == [ReasonCode.QUOTA_EXCEEDED]
    large = Connect("x" * 33_000, version=4, username="y" * 33_000, password=bytes(33_000))
    assert said(ServerProtocol(1 << 28, ALIASES), [large.encode()]) == [large]


def test_millions_of_filters_are_refused():
    connection = connected(5, 1 << 28)
    header = b"\x82" + encode_varint(MAXIMUM_CONTROL)
    assert said(connection, [header]) == [ReasonCode.QUOTA_EXCEEDED]


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"\x30\xff\xff\xff\xff", [ReasonCode.MALFORMED_PACKET]),  # a fifth digit would follow
        (b"\x30\xff\xff\xff\x80", [ReasonCode.MALFORMED_PACKET]),
        (b"\x30\xff\xff\xff", []),
        (b"\x30\x80\x00", [ReasonCode.MALFORMED_PACKET]),  # v5 [MQTT-1.5.5-1]
        (b"\x30\xff\xff\xff\x7f", [ReasonCode.PACKET_TOO_LARGE]),
    ],
)
def test_remaining_length(data, expected):
    """Section 2.2.3 of 3.1.1, 1.5.5 of 5.0"""
    assert said(connected(5), [data]) == expected
    assert said(connected(5), [data[n : n + 1] for n in range(len(data))]) == expected


@pytest.mark.parametrize("chunk", [1460, 65536])
def test_a_packet_in_many_chunks_is_joined_once(chunk):
    """Joined at every chunk, 16 MiB would be copied thousands of times."""
    packet = Publish("a", bytes(16 << 20))
    data = packet.encode(5)
    connection = connected(5, 1 << 28)
    joins = 0

    def count(frame: object, event: str, called: object) -> None:
        nonlocal joins
        joins += event == "c_call" and getattr(called, "__name__", "") == "join"

    events: list[Event] = []
    sys.setprofile(count)
    try:
        for start in range(0, len(data), chunk):
            events += connection.receive_data(data[start : start + chunk])
    finally:
        sys.setprofile(None)
    assert [as_packet(event, 5) for event in events] == [packet]
    assert joins <= 2
    assert connection.held == 0


# --- orders


SAYABLE: list[Packet] = [
    Connect("client"),
    Connack(),
    Publish("a", b""),
    Puback(1),
    Pubrec(1),
    Pubrel(1),
    Pubcomp(1),
    Subscribe(1, [Subscription("a")]),
    Suback(1, [0]),
    Unsubscribe(1, ["a"]),
    Unsuback(1, [0]),
    Pingreq(),
    Pingresp(),
    Disconnect(),
    Auth(),
]
SERVERS_ONLY = {PacketType.CONNACK, PacketType.SUBACK, PacketType.UNSUBACK, PacketType.PINGRESP}


@pytest.mark.parametrize("packet", SAYABLE, ids=lambda packet: packet.TYPE.name)
def test_the_first_packet_is_connect(packet):
    """[MQTT-3.1.0-1]"""
    connection = ServerProtocol(SIZE, ALIASES)
    found = said(connection, [packet.encode(5)])
    if packet.TYPE is PacketType.CONNECT:
        assert found == [packet]
    else:
        assert found == [ReasonCode.PROTOCOL_ERROR]
        assert connection.state is State.CLOSED
        assert said(connection, [Connect("client").encode()]) == []


@pytest.mark.parametrize("packet", SAYABLE, ids=lambda packet: packet.TYPE.name)
def test_what_a_client_may_say(packet):
    """[MQTT-3.1.0-2]: no second CONNECT; and nothing that only a server says"""
    found = said(connected(5), [packet.encode(5)])
    if packet.TYPE in SERVERS_ONLY | {PacketType.CONNECT}:
        assert found == [ReasonCode.PROTOCOL_ERROR]
    else:
        assert found == [packet]


def test_packet_type_0_and_auth_in_3_1_1_are_errors():
    """Section 2.2.1 of 3.1.1: reserved, forbidden"""
    assert said(connected(4), [b"\x00\x00"]) == [ReasonCode.PROTOCOL_ERROR]
    assert said(connected(5), [b"\x00\x00"]) == [ReasonCode.PROTOCOL_ERROR]
    assert said(connected(4), [b"\xf0\x00"]) == [ReasonCode.PROTOCOL_ERROR]


def test_a_protocol_that_is_not_ours():
    """[MQTT-3.1.2-2]"""
    for name in (b"\x00\x06MQIsdp\x04", b"\x00\x04MQTT\x03", b"\x00\x04MQTT\x06"):
        body = name + b"\x02\x00\x00\x00\x00"
        wire = b"\x10" + encode_varint(len(body)) + body
        found = said(ServerProtocol(SIZE, ALIASES), [wire])
        assert found == [ReasonCode.UNSUPPORTED_PROTOCOL_VERSION]
    assert said(ServerProtocol(SIZE, ALIASES), [b"GET / HTTP/1.1\r\n\r\n"]) == [
        ReasonCode.PROTOCOL_ERROR
    ]


def test_after_the_end_nothing_is_said_or_kept():
    connection = connected(5)
    events = connection.receive_data(Pingreq().encode(5) * 3)
    assert next(events) == Pingreq()
    connection.close()
    assert list(events) == []
    assert said(connection, [Pingreq().encode(5), b"\x30"]) == []
    assert connection.held == 0


def test_paused_nothing_is_lost():
    connection = connected(4)
    data = b"".join(Puback(n).encode(4) for n in range(1, 6))
    found = []
    for event in connection.receive_data(data[:-1]):
        found.append(as_packet(event, 4))
        if len(found) == 2:
            connection.pause()
    assert len(found) == 2
    assert said(connection, [data[-1:], b"\xc0"]) == []
    assert connection.held == 3 * 4 + 1
    connection.accept()
    assert said(connection, [b""]) == [Puback(3), Puback(4), Puback(5)]
    assert said(connection, [b"\x00"]) == [Pingreq()]


# --- PUBLISH


@pytest.mark.parametrize("version", [4, 5])
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_a_plain_publish_is_not_wrapped(version, qos):
    packet = Publish("a/b", b"payload", qos, packet_id=qos and 258)
    (event,) = connected(version).receive_data(packet.encode(version))
    assert isinstance(event, tuple)
    assert event[:4] == (0x30 | qos << 1, b"\0\3a/b", qos and 258, b"payload")


@pytest.mark.parametrize(
    ("wire", "code"),
    [
        ("36 07 0001 61 0001 00 00", ReasonCode.MALFORMED_PACKET),  # QoS 3 [MQTT-3.3.1-4]
        ("3e 07 0001 61 0001 00 00", ReasonCode.MALFORMED_PACKET),
        ("38 05 0001 61 00 00", ReasonCode.MALFORMED_PACKET),  # DUP, QoS 0 [MQTT-3.3.1-2]
        ("32 07 0001 61 0000 00 00", ReasonCode.PROTOCOL_ERROR),  # id 0 [MQTT-2.2.1-3]
        ("30 05 0001 2b 00 00", ReasonCode.MALFORMED_PACKET),  # + [MQTT-3.3.2-2]
        ("30 05 0001 23 00 00", ReasonCode.MALFORMED_PACKET),  # #
        ("30 05 0001 00 00 00", ReasonCode.MALFORMED_PACKET),  # U+0000 [MQTT-1.5.4-2]
        ("30 05 0001 ff 00 00", ReasonCode.MALFORMED_PACKET),  # no UTF-8 [MQTT-1.5.4-1]
        ("30 07 0003 eda080 00 00", ReasonCode.MALFORMED_PACKET),  # a surrogate
        ("30 05 0000 00 00 00", ReasonCode.PROTOCOL_ERROR),  # no topic, no alias
        ("30 05 00ff 61 00 00", ReasonCode.MALFORMED_PACKET),  # the topic is longer than the packet
        ("30 01 00", ReasonCode.MALFORMED_PACKET),
        ("30 00", ReasonCode.MALFORMED_PACKET),
        ("32 05 0001 61 00 01", ReasonCode.MALFORMED_PACKET),  # where are the properties?
        ("30 04 0001 61 05", ReasonCode.MALFORMED_PACKET),  # properties longer than the packet
    ],
)
def test_a_publish_that_is_wrong(wire, code):
    assert said(connected(5), [bytes.fromhex(wire)]) == [code]


def test_a_byte_order_mark_stays():
    """[MQTT-1.5.3-3], v5 [MQTT-1.5.4-3]"""
    (packet,) = said(connected(5), [Publish("\ufeffa", b"x" * 9).encode(5)])
    assert isinstance(packet, Publish)
    assert packet.topic == "\ufeffa"


def with_alias(alias: int, topic: str = "") -> bytes:
    return Publish(topic, b"x", properties={Property.TOPIC_ALIAS: alias}).encode(5)


def test_topic_aliases():
    """v5 [MQTT-3.3.2-10] [MQTT-3.3.2-12], section 3.3.2.3.4"""
    connection = connected(5)
    found = said(
        connection,
        [with_alias(1, "a"), with_alias(10, "b"), with_alias(1), with_alias(1, "c"), with_alias(1)],
    )
    assert [packet.topic for packet in found] == ["a", "b", "a", "c", "c"]  # type: ignore[union-attr]
    assert all(not packet.properties for packet in found)  # type: ignore[union-attr]
    # Another connection knows nothing of it [MQTT-3.3.2-7].
    assert said(connected(5), [with_alias(1)]) == [ReasonCode.PROTOCOL_ERROR]


@pytest.mark.parametrize(
    ("wire", "code"),
    [
        (with_alias(11, "a"), ReasonCode.TOPIC_ALIAS_INVALID),  # [MQTT-3.3.2-9]
        (with_alias(0, "a"), ReasonCode.TOPIC_ALIAS_INVALID),  # [MQTT-3.3.2-8]
        (with_alias(2), ReasonCode.PROTOCOL_ERROR),
        (with_alias(1, "a/#"), ReasonCode.MALFORMED_PACKET),
    ],
)
def test_topic_aliases_that_are_wrong(wire, code):
    assert said(connected(5), [wire]) == [code]


def test_an_alias_needs_to_be_allowed():
    """v5 [MQTT-3.2.2-17] [MQTT-3.2.2-18]"""
    connection = ServerProtocol(SIZE, 0)
    list(connection.receive_data(Connect("client").encode()))
    connection.accept()
    assert said(connection, [with_alias(1, "a")]) == [ReasonCode.TOPIC_ALIAS_INVALID]


def test_a_client_sends_no_subscription_identifiers():
    """v5 [MQTT-3.3.4-6]"""
    packet = Publish("a", b"", properties={Property.SUBSCRIPTION_IDENTIFIER: [1]})
    assert said(connected(5), [packet.encode(5)]) == [ReasonCode.PROTOCOL_ERROR]


@pytest.mark.parametrize("data", [b"\0", b"\0\0", b"\0\1", bytes(40)])
def test_zeros_are_no_packet_in_any_state(data):
    """Before the first PUBLISH nothing is taken for a repetition of it."""
    for connection in (ServerProtocol(SIZE, ALIASES), connected(4), connected(5)):
        found = said(connection, [data, data])
        assert found == [ReasonCode.PROTOCOL_ERROR]


@pytest.mark.parametrize(
    ("sent", "hint"),
    [
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc", "listener with tls: true"),
        (b"GET /mqtt HTTP/1.1\r\n", "listener with protocol: websocket"),
    ],
)
def test_who_comes_to_the_wrong_listener_is_told_to_the_log(sent: bytes, hint: str) -> None:
    with pytest.raises(ProtocolError, match=hint):
        list(ServerProtocol(SIZE, ALIASES).receive_data(sent))
