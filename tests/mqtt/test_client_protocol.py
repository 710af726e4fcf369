"""What a server may send a client, and when; the short forms against the full decoder."""

from __future__ import annotations

import itertools
from unittest.mock import ANY

import pytest
from examples import examples
from hypothesis import example, given
from hypothesis import strategies as st
from test_connection import (
    SAYABLE,
    check_damage,
    check_splits,
    resolve,
    said,
    some_cuts,
    some_damage,
    versions,
    with_pairs,
    without_pairs,
)
from test_properties import packets, publishes

from appliance.mqtt.client_protocol import ClientProtocol
from appliance.mqtt.codec import (
    Properties,
    Property,
    encode_properties,
    encode_property_list,
    encode_varint,
    find_topic_alias,
)
from appliance.mqtt.framing import (
    DEFAULT_PAIRS,
    MAXIMUM_CONNECT,
    MAXIMUM_CONTROL,
    UNAUTHENTICATED_PAIRS,
    State,
)
from appliance.mqtt.packets import (
    Auth,
    Connack,
    Connect,
    Disconnect,
    Packet,
    PacketType,
    Pingresp,
    Puback,
    Publish,
    Pubrec,
    Suback,
    UnusablePublish,
    decode_packet,
)
from appliance.mqtt.reason import ContentError, ProtocolError, ReasonCode

SIZE = 100_000
ALIASES = 10
METHOD = {Property.AUTHENTICATION_METHOD: "m"}

AFTER_CONNACK = {
    PacketType.PUBLISH,
    PacketType.PUBACK,
    PacketType.PUBREC,
    PacketType.PUBREL,
    PacketType.PUBCOMP,
    PacketType.SUBACK,
    PacketType.UNSUBACK,
    PacketType.PINGRESP,
}


def started(version: int = 5, size: int = SIZE, method: bool = False, **fields) -> ClientProtocol:
    """A client that has sent CONNECT."""
    properties = {Property.TOPIC_ALIAS_MAXIMUM: ALIASES} | (METHOD if method else {})
    fields.setdefault("client_id", "client")
    connect = Connect(version=version, properties=properties, **fields)  # type: ignore[arg-type]
    return ClientProtocol(connect, size)


def connected(version: int = 5, size: int = SIZE, method: bool = False) -> ClientProtocol:
    """A client that has got CONNACK."""
    client = started(version, size, method)
    properties = METHOD if method and version == 5 else None
    assert said(client, [Connack(properties=properties).encode(version)]) == [  # type: ignore[arg-type]
        Connack(properties=properties)  # type: ignore[arg-type]
    ]
    assert client.state is State.CONNECTED
    return client


def said_slowly(data: bytes, version: int) -> list[Packet | ReasonCode]:
    """What `said` is to find after CONNACK, by the standard's words and the full decoder."""
    found: list[Packet | ReasonCode] = []
    aliases: dict[int, str] = {}
    try:
        while data:
            if data[0] < 0x10:
                raise ProtocolError(ReasonCode.PROTOCOL_ERROR, "reserved")
            digits = list(itertools.takewhile(lambda byte: byte >= 0x80, data[1:5]))
            if len(digits) == 4:
                raise ProtocolError(ReasonCode.MALFORMED_PACKET, "five digits")
            if len(digits) + 1 >= len(data):
                break
            digits.append(data[1 + len(digits)])
            if len(digits) > 1 and not digits[-1]:
                raise ProtocolError(ReasonCode.MALFORMED_PACKET, "a digit too many")
            length = sum((digit & 0x7F) << 7 * place for place, digit in enumerate(digits))
            size = 1 + len(digits) + length
            if size > 127 or len(data) >= size:
                kind = data[0] >> 4
                if kind not in AFTER_CONNACK and not (kind == 14 and version == 5):
                    raise ProtocolError(ReasonCode.PROTOCOL_ERROR, "not now")
                if size > SIZE:
                    raise ProtocolError(ReasonCode.PACKET_TOO_LARGE, "too large")
            if len(data) < size:
                break
            body = data[size - length : size]
            try:
                packet = without_pairs(decode_packet(data[0], body, version))
                if isinstance(packet, Publish):
                    # A server may send these; what else `resolve` checks holds for both sides.
                    numbers = (packet.properties or {}).pop(Property.SUBSCRIPTION_IDENTIFIER, None)
                    resolve(packet, aliases)
                    if numbers is not None:
                        packet.properties = {
                            **(packet.properties or {}),
                            Property.SUBSCRIPTION_IDENTIFIER: numbers,
                        }
            except ContentError:
                if data[0] >> 4 != 3:
                    raise
                packet = unusable(data[0], body, version, aliases)
            found.append(packet)
            if isinstance(packet, Disconnect):
                break
            data = data[size:]
    except UnicodeDecodeError:  # of 3.1.1 [MQTT-1.5.3-1]
        found.append(ReasonCode.MALFORMED_PACKET)
    except ProtocolError as error:
        found.append(error.code)
    return found


def unusable(first: int, body: bytes, version: int, aliases: dict[int, str]) -> UnusablePublish:
    """A message that its publisher has made so, where the packet is in order beside that."""
    end = 2 + int.from_bytes(body[:2], "big")
    topic = body[2:end].decode(errors="strict" if version == 4 else "replace")
    packet_id = None
    if first & 6:
        packet_id = int.from_bytes(body[end : end + 2], "big")
        end += 2
        if not packet_id or end > len(body):
            raise ProtocolError(ReasonCode.MALFORMED_PACKET, "no packet id")
    alias = find_topic_alias(body, end, len(body), 1 << 20) if version == 5 else None
    if alias is not None and not 0 < alias <= ALIASES:
        raise ProtocolError(ReasonCode.TOPIC_ALIAS_INVALID, "too many")
    if alias is None and not topic:
        raise ProtocolError(ReasonCode.MALFORMED_PACKET, "no topic")
    if alias is not None:
        if not topic and alias not in aliases:
            raise ProtocolError(ReasonCode.PROTOCOL_ERROR, "never said")
        topic = aliases[alias] = topic or aliases[alias]
    qos = first >> 1 & 3
    return UnusablePublish(topic, b"", qos, bool(first & 1), first >= 0x38, packet_id, flaw=ANY)


@st.composite
def conversations(draw) -> tuple[int, list[bytes]]:
    """A version and packets of a server, some of them the same several times."""
    version = draw(versions)
    wires = []
    drawn = draw(st.lists(packets(version) | publishes(version), min_size=1, max_size=6))
    for packet in drawn:
        if packet.TYPE in AFTER_CONNACK or draw(st.integers(0, 5)) == 0:
            wires += [packet.encode(version)] * draw(st.integers(1, 3))
    return version, draw(st.permutations(wires))


@given(conversations(), some_cuts)
@examples(300)
def test_any_split_gives_the_same_events_as_the_full_decoder(conversation, cuts):
    check_splits(connected, said_slowly, conversation, cuts)


@given(conversations(), some_damage, some_cuts)
@examples(400)
def test_damaged_bytes_are_refused_as_by_the_full_decoder(conversation, damage, cuts):
    check_damage(connected, said_slowly, conversation, damage, cuts)


@given(st.binary(max_size=60), versions, st.booleans(), st.booleans())
@examples(500)
def test_any_bytes_give_packets_or_one_error(data, version, method, before):
    client = (started if before else connected)(version, method=method)
    found = said(client, [data])
    assert sum(isinstance(each, ReasonCode) for each in found) <= 1
    assert client.held <= len(data)


# --- which packets, and when


@pytest.mark.parametrize("version", [4, 5])
@pytest.mark.parametrize("packet", SAYABLE, ids=lambda packet: packet.TYPE.name)
def test_what_a_server_may_send_first(packet, version):
    """[MQTT-3.2.0-1]"""
    data = b"\xf0\x00" if isinstance(packet, Auth) else packet.encode(version)
    found = said(started(version), [data])
    allowed = isinstance(packet, Connack) or (isinstance(packet, Disconnect) and version == 5)
    assert found == ([packet] if allowed else [ReasonCode.PROTOCOL_ERROR])


@pytest.mark.parametrize("version", [4, 5])
@pytest.mark.parametrize("packet", SAYABLE, ids=lambda packet: packet.TYPE.name)
def test_what_a_server_may_send_after_connack(packet, version):
    """v5 [MQTT-3.2.0-2]: one CONNACK; and nothing that only a client sends"""
    data = b"\xf0\x00" if isinstance(packet, Auth) else packet.encode(version)
    found = said(connected(version), [data])
    kind = packet.TYPE
    allowed = kind in AFTER_CONNACK or (kind is PacketType.DISCONNECT and version == 5)
    if allowed and kind is PacketType.UNSUBACK and version == 4:
        assert [type(each) for each in found] == [type(packet)]
    else:
        assert found == ([packet] if allowed else [ReasonCode.PROTOCOL_ERROR])


def test_nothing_counts_after_disconnect_or_a_refusal():
    """v5 [MQTT-3.14.4-1] [MQTT-3.2.2-7]"""
    client = connected()
    assert said(client, [Disconnect(0x8B).encode(5) + Pingresp().encode(5)]) == [Disconnect(0x8B)]
    assert client.state is State.CLOSED
    client = started()
    assert said(client, [Connack(reason_code=0x87).encode(5) + bytes(9)]) == [
        Connack(reason_code=0x87)
    ]
    assert client.state is State.CLOSED
    assert client.held == 0


def test_packets_behind_connack_are_those_of_a_connection():
    message = Publish("a", b"x", 1, packet_id=1)
    data = Connack().encode(5) + message.encode(5)
    for cut in range(len(data)):
        assert said(started(), [data[:cut], data[cut:]]) == [Connack(), message]


@pytest.mark.parametrize("version", [4, 5])
@pytest.mark.statement("5.0", "MQTT-3.2.2-4")
def test_no_session_after_a_clean_start(version):
    """3.1.1 [MQTT-3.2.2-1]"""
    connack = Connack(session_present=True)
    assert said(started(version), [connack.encode(version)]) == [ReasonCode.PROTOCOL_ERROR]
    client = started(version, clean_start=False)
    assert said(client, [connack.encode(version)]) == [connack]


def test_an_empty_identifier_is_replaced():
    """v5 [MQTT-3.2.2-16]"""
    assert said(started(client_id=""), [Connack().encode(5)]) == [ReasonCode.PROTOCOL_ERROR]
    connack = Connack(properties={Property.ASSIGNED_CLIENT_IDENTIFIER: "c"})
    assert said(started(client_id=""), [connack.encode(5)]) == [connack]


@pytest.mark.parametrize(
    ("wire", "code"),
    [
        ("20 03 02 00 00", ReasonCode.MALFORMED_PACKET),  # a reserved flag [MQTT-3.2.2-1]
        ("21 03 00 00 00", ReasonCode.MALFORMED_PACKET),  # flags of the header [MQTT-2.1.3-1]
        ("20 03 01 87 00", ReasonCode.PROTOCOL_ERROR),  # refused, with a session [MQTT-3.2.2-6]
        ("20 03 00 01 00", ReasonCode.PROTOCOL_ERROR),  # no such reason [MQTT-3.2.2-8]
        ("20 02 00 00", ReasonCode.MALFORMED_PACKET),  # 3.1.1 accepts version 5?
        ("20 02 00 06", ReasonCode.PROTOCOL_ERROR),
        ("20 06 00 00 03 21 00 00", ReasonCode.PROTOCOL_ERROR),  # Receive Maximum 0
        ("20 08 00 00 05 27 00 00 00 00", ReasonCode.PROTOCOL_ERROR),  # Maximum Packet Size 0
        ("20 05 00 00 02 24 02", ReasonCode.PROTOCOL_ERROR),  # Maximum QoS 2
        ("20 07 00 00 04 25 01 25 01", ReasonCode.PROTOCOL_ERROR),  # twice
        ("20 05 00 00 02 01 01", ReasonCode.MALFORMED_PACKET),  # a property of PUBLISH
        ("20 04 00 00 00 00", ReasonCode.MALFORMED_PACKET),  # a byte too many
        ("20 00", ReasonCode.MALFORMED_PACKET),
    ],
)
def test_a_connack_that_is_wrong(wire, code):
    assert said(started(), [bytes.fromhex(wire)]) == [code]


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        (1, ReasonCode.UNSUPPORTED_PROTOCOL_VERSION),
        (2, ReasonCode.CLIENT_IDENTIFIER_NOT_VALID),
        (5, ReasonCode.NOT_AUTHORIZED),
    ],
)
def test_a_server_of_3_1_1_refuses_version_5_in_its_own_words(code, reason):
    """3.1.1 [MQTT-3.1.2-2]"""
    for version in (4, 5):
        client = started(version)
        assert said(client, [bytes((0x20, 2, 0, code))]) == [Connack(reason_code=reason)]
        assert client.state is State.CLOSED


@pytest.mark.parametrize(
    ("data", "hint"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "HTTP.*ws:"),
        (b"\x15\x03\x01\x00\x02\x02\x46", "TLS.*mqtts:"),
    ],
)
def test_a_peer_that_speaks_something_else(data, hint):
    with pytest.raises(ProtocolError, match=hint):
        list(started().receive_data(data))


# --- authentication


def auth(code: int, method: str = "m") -> Auth:
    return Auth(code, {Property.AUTHENTICATION_METHOD: method})


def test_authentication():
    """v5 [MQTT-4.12.0-2]"""
    client = started(method=True)
    steps = [auth(0x18), auth(0x18), Connack(properties=dict(METHOD))]
    assert said(client, [step.encode(5) for step in steps]) == steps
    client.reauthenticating = True
    again = [auth(0x18), auth(0)]
    assert said(client, [step.encode(5) for step in again]) == again
    assert not client.reauthenticating
    assert said(client, [auth(0).encode(5)]) == [ReasonCode.PROTOCOL_ERROR]


@pytest.mark.parametrize(
    ("packet", "before"),
    [
        (auth(0), True),  # before CONNACK only 0x18 [MQTT-4.12.0-2]
        (auth(0x19), True),
        (auth(0x18, "n"), True),  # another method [MQTT-4.12.0-5]
        (Connack(), True),  # without the method [MQTT-4.12.0-5]
        (Connack(properties={Property.AUTHENTICATION_METHOD: "n"}), True),
        (auth(0x18), False),  # only the client begins again
        (auth(0x19), False),
        (auth(0), False),
    ],
)
def test_authentication_that_is_wrong(packet, before):
    client = started(method=True) if before else connected(method=True)
    assert said(client, [packet.encode(5)]) == [ReasonCode.PROTOCOL_ERROR]


def test_the_method_of_an_answer_is_that_of_connect():
    """v5 [MQTT-4.12.0-5], also when the client authenticates again"""
    client = connected(method=True)
    client.reauthenticating = True
    assert said(client, [auth(0, "n").encode(5)]) == [ReasonCode.PROTOCOL_ERROR]


def test_no_authentication_without_a_method():
    """v5 [MQTT-4.12.0-6]"""
    connack = Connack(properties=dict(METHOD))
    assert said(started(), [auth(0x18).encode(5)]) == [ReasonCode.PROTOCOL_ERROR]
    assert said(started(), [connack.encode(5)]) == [ReasonCode.PROTOCOL_ERROR]
    assert said(connected(), [auth(0x18).encode(5)]) == [ReasonCode.PROTOCOL_ERROR]


# --- sizes


@pytest.mark.parametrize("first", [0x30, 0x32, 0x40, 0x90, 0xB0, 0xE0])
def test_a_packet_that_is_too_large_is_refused_by_its_header(first):
    """v5 [MQTT-3.1.2-24]: the code is 0x95"""
    header = bytes((first,)) + encode_varint(SIZE)
    for chunks in ([header], [header[:1], header[1:2], header[2:]]):
        client = connected()
        assert said(client, chunks) == [ReasonCode.PACKET_TOO_LARGE]
        assert client.state is State.CLOSED
        assert client.held == 0


def test_a_packet_of_the_largest_size_is_taken():
    """5.0 section 3.1.2.11.4: the size is that of the whole packet."""
    for excess, expected in ((0, Publish), (1, ReasonCode)):
        wire = Publish("a", bytes(SIZE - 8 + excess)).encode(5)
        assert len(wire) == SIZE + excess
        (found,) = said(connected(), [wire])
        assert isinstance(found, expected)


def test_control_packets_are_small():
    client = started(size=1 << 28)
    header = b"\x20" + encode_varint(MAXIMUM_CONNECT)
    assert said(client, [header]) == [ReasonCode.QUOTA_EXCEEDED]
    client = connected(size=1 << 28)
    header = b"\x90" + encode_varint(MAXIMUM_CONTROL)
    assert said(client, [header]) == [ReasonCode.QUOTA_EXCEEDED]


@pytest.mark.parametrize(
    "packet",
    [
        Puback(1),
        Suback(1, [0]),
        Disconnect(0x87),
        Publish("a", b""),
    ],
    ids=lambda packet: packet.TYPE.name,
)
def test_user_properties_are_counted_and_not_decoded(packet):
    # Those of a message are its publisher's: it alone is refused.
    many = UnusablePublish if isinstance(packet, Publish) else ReasonCode
    for count, expected in ((DEFAULT_PAIRS, type(packet)), (DEFAULT_PAIRS + 1, many)):
        packet.properties = {Property.USER_PROPERTY: [("a", "b")] * count}
        client = connected()
        (found,) = client_events(client, packet.encode(5))
        assert isinstance(found, expected)
        if isinstance(found, ReasonCode):
            assert found is ReasonCode.QUOTA_EXCEEDED
        else:
            assert Property.USER_PROPERTY not in (found.properties or {})
            assert client.cost > 0


def client_events(client: ClientProtocol, data: bytes) -> list[object]:
    try:
        return list(client.receive_data(data))
    except ProtocolError as error:
        return [error.code]


def test_few_user_properties_before_connack():
    for count, expected in (
        (UNAUTHENTICATED_PAIRS, Connack()),
        (UNAUTHENTICATED_PAIRS + 1, ReasonCode.QUOTA_EXCEEDED),
    ):
        packet = Connack(properties={Property.USER_PROPERTY: [("a", "b")] * count})
        assert said(started(), [packet.encode(5)]) == [expected]


# --- PUBLISH and acknowledgements


@pytest.mark.statement("5.0", "MQTT-3.3.2-10")
def test_topic_aliases_up_to_the_announced_maximum():
    """v5 [MQTT-3.1.2-26] [MQTT-3.3.2-7]"""

    def wire(alias: int, topic: str = "") -> bytes:
        return Publish(topic, b"x", properties={Property.TOPIC_ALIAS: alias}).encode(5)

    client = connected()
    found = said(client, [wire(1, "a"), wire(ALIASES, "b"), wire(1), wire(ALIASES)])
    assert [packet.topic for packet in found] == ["a", "b", "a", "b"]  # type: ignore[union-attr]
    assert client.held > 0
    assert said(connected(), [wire(ALIASES + 1, "a")]) == [ReasonCode.TOPIC_ALIAS_INVALID]
    assert said(connected(), [wire(0, "a")]) == [ReasonCode.TOPIC_ALIAS_INVALID]
    assert said(connected(), [wire(1)]) == [ReasonCode.PROTOCOL_ERROR]
    none = ClientProtocol(Connect("client"), SIZE)
    assert said(none, [Connack().encode(5), wire(1, "a")]) == [
        Connack(),
        ReasonCode.TOPIC_ALIAS_INVALID,
    ]


def test_subscription_identifiers_are_taken():
    """5.0 section 3.3.2.3.8"""
    packet = Publish("a", b"", properties={Property.SUBSCRIPTION_IDENTIFIER: [1, 2]})
    (found,) = connected().receive_data(packet.encode(5))
    assert isinstance(found, Publish)
    assert found.properties == packet.properties
    assert with_pairs(found).properties == packet.properties


@pytest.mark.parametrize(
    ("wire", "event"),
    [
        ("40 02 0102", 0x040102),
        ("40 03 0102 00", 0x040102),
        ("40 03 0102 10", 0x10040102),
        ("40 04 0102 97 00", 0x97040102),
        ("62 03 0102 92", 0x92060102),
    ],
)
def test_an_acknowledgement_without_properties_is_a_number(wire, event):
    assert list(connected().receive_data(bytes.fromhex(wire))) == [event]


@pytest.mark.parametrize(
    ("version", "wire", "code"),
    [
        (5, "40 02 0000", ReasonCode.PROTOCOL_ERROR),  # id 0 [MQTT-2.2.1-3]
        (5, "40 03 0000 10", ReasonCode.PROTOCOL_ERROR),
        (5, "40 03 0001 01", ReasonCode.PROTOCOL_ERROR),  # no such code [MQTT-3.4.2-1]
        (5, "40 04 0001 10 01", ReasonCode.MALFORMED_PACKET),  # properties that are not there
        (5, "40 05 0001 10 00 00", ReasonCode.MALFORMED_PACKET),
        (5, "41 03 0001 10", ReasonCode.MALFORMED_PACKET),  # flags [MQTT-2.1.3-1]
        (5, "60 03 0001 92", ReasonCode.MALFORMED_PACKET),  # [MQTT-3.6.1-1]
        (5, "40 01 01", ReasonCode.MALFORMED_PACKET),
        (4, "40 03 0001 00", ReasonCode.MALFORMED_PACKET),  # 3.1.1 has no reason codes
        (4, "40 04 0001 00 00", ReasonCode.MALFORMED_PACKET),
        (4, "b0 03 0001 00", ReasonCode.MALFORMED_PACKET),
        (4, "90 03 0001 87", ReasonCode.PROTOCOL_ERROR),  # [MQTT-3.9.3-2]
    ],
)
def test_an_acknowledgement_that_is_wrong(version, wire, code):
    assert said(connected(version), [bytes.fromhex(wire)]) == [code]


def test_properties_of_an_acknowledgement_are_decoded():
    packet = Pubrec(1, 0x97, {Property.REASON_STRING: "full"})
    assert said(connected(), [packet.encode(5)]) == [packet]


BETWEEN = [b"\x40\x03\x00\x01\x10", b"\xd0\x00", b"\x40\x04\x00\x02\x00\x00", b"\x70\x02\x00\x03"]
FORMS = [(b"\x40\x02", b""), (b"\x40\x03", b"\x10"), (b"\x40\x04", b"\x10\0")]
RUNS = st.lists(
    st.builds(
        lambda form, ids: b"".join(form[0] + each.to_bytes(2, "big") + form[1] for each in ids),
        st.sampled_from(FORMS),
        st.lists(st.integers(1, 65535), min_size=1, max_size=20),
    )
    | st.sampled_from(BETWEEN),
    max_size=6,
).map(b"".join)


WRONG = [b"\x40\x02\0\0", b"\x40\x03\0\0\x10", b"\x40\x03\0\1\x87", b"\x40\x04\0\1\x10\1"]


@example(b"", WRONG[0], [])
@example(b"", WRONG[3], [])
@given(RUNS, st.binary(max_size=5) | st.sampled_from(WRONG), st.lists(st.integers(0, 300)))
def test_pubacks_that_are_taken_at_once_are_the_same(data: bytes, end: bytes, cuts: list[int]):
    """As those that `receive_data` yields, however the bytes arrive; and so is what follows."""

    def said_by(taking: bool) -> list[object]:
        client, events = connected(), []
        try:
            for start, stop in itertools.pairwise([0, *sorted(cuts), len(data) + len(end)]):
                part = (data + end)[start:stop]
                if taking:
                    packet_ids, code, part = client.take_pubacks(part)
                    kind = code << 24 | PacketType.PUBACK << 16
                    events += [kind | each for each in packet_ids]
                events += client.receive_data(part)
                assert not taking or client.held <= len(data + end)
        except ProtocolError as error:
            events.append(error.code)
        return [*events, client.held, client.take_pubacks(b"\x40\x02\x00\x01"), client.state]

    assert said_by(taking=True) == said_by(taking=False)


def test_pubacks_are_taken_only_after_connack():
    client = started()
    assert client.take_pubacks(b"\x40\x02\x00\x01") == ((), 0, b"\x40\x02\x00\x01")
    client = connected()
    packet_ids, code, rest = client.take_pubacks(b"\x40\x02\x12\x34\x40\x02\x00\x02\x40\x02\x00")
    assert (list(packet_ids), code, rest) == ([0x1234, 2], 0, b"\x40\x02\x00")
    client.pause()
    assert client.take_pubacks(b"\x40\x02\x00\x01") == ((), 0, b"\x40\x02\x00\x01")


@pytest.mark.parametrize("end", [b"", b"\0"], ids=["code", "code-and-length"])
def test_pubacks_of_messages_that_nobody_subscribes_to_are_taken_at_once(end: bytes):
    size = bytes((3 + len(end),))
    data = b"".join(b"\x40" + size + bytes((1, each)) + b"\x10" + end for each in range(100))
    packet_ids, code, rest = connected().take_pubacks(data + b"\x40\x02\x00\x01")
    assert (list(packet_ids), code) == ([0x100 + each for each in range(100)], 0x10)
    assert rest == b"\x40\x02\x00\x01"
    old = connected(4)
    assert old.take_pubacks(data) == ((), 0, data)  # of 3.1.1, which has no reason codes


FLAWS: list[tuple[Properties, str]] = [
    (
        {Property.USER_PROPERTY: [("a", "b")] * (DEFAULT_PAIRS + 1)},
        "more than 1000 User Properties",
    ),
    ({Property.RESPONSE_TOPIC: "a/#"}, "response topic: "),
    ({Property.RESPONSE_TOPIC: ""}, "response topic: "),
    ({Property.PAYLOAD_FORMAT_INDICATOR: 2}, "PAYLOAD_FORMAT_INDICATOR must not be 2"),
]


@pytest.mark.parametrize("qos", [0, 1, 2])
@pytest.mark.parametrize(("properties", "flaw"), FLAWS)
def test_what_a_publisher_has_put_in_ends_no_connection(
    qos: int, properties: Properties, flaw: str
) -> None:
    """Its server may pass it on as it is; a server itself refuses it."""
    client, server = connected(), Publish("t", b"x", properties=properties).encode(5)
    packet_id = 7 if qos else None
    for said_first in (
        {Property.TOPIC_ALIAS: 3, **properties},
        {**properties, Property.TOPIC_ALIAS: 3},
    ):
        packet = Publish("t", b"x", qos, packet_id=packet_id, properties=said_first)
        (event,) = said(client, [packet.encode(5)])
        assert isinstance(event, UnusablePublish) and event.flaw.startswith(flaw)
        assert (event.topic, event.qos, event.packet_id) == ("t", qos, packet_id)
        assert not event.payload and event.properties is None
        again = Publish("", b"y", properties={Property.TOPIC_ALIAS: 3})
        assert [each.topic for each in said(client, [again.encode(5)])] == ["t"]
    with pytest.raises(ProtocolError):
        decode_packet(
            server[0], server[1 + len(encode_varint(len(server) - 2)) :], 5, DEFAULT_PAIRS
        )


@pytest.mark.parametrize(
    "more", [b"\x7f", b"\x23\0\0", b"\x23\0", b"\x23\0\x63", b"\x26\0", b"\x26\0\1a\0\5"]
)
def test_a_packet_that_is_wrong_as_well_ends_it(more: bytes) -> None:
    """An unknown property, an alias of 0 or above the maximum, and one that is cut off."""
    wrong = b"\x08\0\3a/#" + more
    body = b"\0\1t" + encode_varint(len(wrong)) + wrong
    (code,) = said(connected(), [b"\x30" + encode_varint(len(body)) + body])
    assert isinstance(code, ReasonCode)


@pytest.mark.parametrize("properties", [{}, {Property.RESPONSE_TOPIC: "#"}])
@pytest.mark.parametrize("topic", ["a/+", "\x85"])
def test_a_wrong_topic_is_wrong_under_its_alias_too(topic: str, properties: Properties) -> None:
    client = connected()
    alias: Properties = {Property.TOPIC_ALIAS: 3}
    wires = [
        Publish(topic, b"", properties={**alias, **properties}).encode(5),
        Publish("", b"", properties=alias).encode(5),
        Publish("good", b"", properties=alias).encode(5),
        Publish("", b"", properties=alias).encode(5),
    ]
    events = [event for wire in wires for event in said(client, [wire])]
    assert [isinstance(event, UnusablePublish) for event in events] == [True, True, False, False]
    assert [event.topic for event in events] == [topic, topic, "good", "good"]


@given(publishes(5))
def test_the_alias_is_found(packet: Publish) -> None:
    data = encode_properties(packet.properties)
    alias = (packet.properties or {}).get(Property.TOPIC_ALIAS)
    assert find_topic_alias(data, 0, len(data), 1 << 20) == alias


def test_no_alias_is_looked_for_behind_millions_of_properties() -> None:
    """A stranger's message of 16 MiB costs no more than one of a thousand properties."""
    alias: Properties = {Property.TOPIC_ALIAS: 3}
    client = connected(size=1 << 25)
    assert len(said(client, [Publish("t", b"", properties=alias).encode(5)])) == 1
    for tail in (b"", encode_property_list(alias)):
        properties = b"\x26\0\0\0\0" * (1 << 20) + tail
        body = b"\0\1t" + encode_varint(len(properties)) + properties
        wire = b"\x30" + encode_varint(len(body)) + body
        (event,) = said(client, [wire])
        assert isinstance(event, UnusablePublish) and event.topic == "t"
    # It may have got another topic there.
    (code,) = said(client, [Publish("", b"", properties=alias).encode(5)])
    assert code == ReasonCode.PROTOCOL_ERROR
