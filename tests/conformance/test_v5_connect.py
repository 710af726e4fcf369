"""MQTT 5.0, section 3.1: CONNECT."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from broker.conftest import FakeAccess, lasting
from client_v5 import (
    ACCEPTED,
    CLEAN_START,
    PASSWORD,
    SESSION_PRESENT,
    USER_NAME,
    WILL,
    WILL_RETAIN,
    Client,
    connack,
    connect,
    disconnect,
    field,
    joined,
    packet,
    properties,
    publish,
    turned_away,
    wire,
)

from appliance.broker.broker import Broker
from appliance.broker.limits import Features, Limits
from appliance.broker.values import Action
from appliance.mqtt.codec import Property
from appliance.mqtt.reason import ReasonCode

P = Property
statement = pytest.mark.statement

#: Session Expiry Interval 100 s.
KEPT = properties("11 00000064")


def watching(broker: Broker, topic_filter: str = "#", qos: int = 2) -> Client:
    """A client that is sent what the others publish."""
    watcher = joined(broker, "watcher")
    assert watcher.subscribe(topic_filter, qos, retain_as_published=1) == qos
    return watcher


# --- 3.1.0


@statement("5.0", "MQTT-3.1.0-1", "MQTT-3.14.0-1")
@pytest.mark.parametrize(
    "first",
    [
        "20 03 00 00 00",
        "30 04 0001 61 00",
        "40 02 0001",
        "50 02 0001",
        "62 02 0001",
        "70 02 0001",
        "82 07 0001 00 0001 61 00",
        "90 04 0001 00 00",
        "a2 06 0001 00 0001 61",
        "b0 04 0001 00 00",
        "c0 00",
        "d0 00",
        "e0 00",
        "f0 00",
        "00 00",
    ],
    ids=lambda data: f"type {int(data[0], 16)}",
)
def test_the_first_packet_is_connect(broker: Broker, first: str) -> None:
    watcher = watching(broker)
    client = Client(broker)
    assert client.say(first, connect("c")) == b""
    assert client.closed and client.transport.asked is None
    assert watcher.hear() == b""


@statement("5.0", "MQTT-3.1.0-2", "MQTT-3.2.0-2")
@pytest.mark.parametrize("client_id", ["client", "another"])
def test_a_second_connect_is_a_protocol_error(broker: Broker, client_id: str) -> None:
    client = joined(broker)
    assert client.say(connect(client_id)) == disconnect(0x82)
    assert client.closed and broker.sessions == {}


# --- 3.1.2.1, 3.1.2.2 name and version

#: What the standard lets a server say before it closes, in the form of 3.1.1 or of 5.0; or nothing.
UNSUPPORTED = (b"", wire("20 02 00 01"), connack(0x84))


@statement("5.0", "MQTT-3.1.2-1", "MQTT-3.14.0-1")
@pytest.mark.parametrize("name", ["MQTT5", "mqtt", "MQIsdp", "MQT", "", "MQTT\ufeff"])
def test_another_protocol_name_is_not_served(broker: Broker, name: str) -> None:
    client = Client(broker)
    assert client.say(connect("c", name=name)) in UNSUPPORTED
    assert client.closed and client.transport.asked is None


@statement("5.0", "MQTT-3.1.2-2", "MQTT-3.14.0-1")
@pytest.mark.parametrize("version", [0, 1, 2, 3, 6, 0x85, 0xFF])
def test_another_version_is_not_served(broker: Broker, version: int) -> None:
    client = Client(broker)
    assert client.say(connect("c", version=version)) in UNSUPPORTED
    assert client.closed and client.transport.asked is None


# --- 3.1.2.3 flags


@statement("5.0", "MQTT-3.1.2-3", "MQTT-3.1.4-1")
def test_the_reserved_flag_is_malformed(broker: Broker) -> None:
    assert turned_away(Client(broker), connect("c", flags=CLEAN_START | 0x01))


# --- 3.1.2.4 Clean Start


@statement("5.0", "MQTT-3.1.2-4", "MQTT-3.1.4-4", "MQTT-3.2.2-2")
@pytest.mark.parametrize("connected", [True, False], ids=["connected", "absent"])
def test_clean_start_discards_the_session(broker: Broker, connected: bool) -> None:
    before = joined(broker, **lasting(5))
    before.subscribe("a", 1)
    sender = joined(broker, "sender")
    if not connected:
        before.lose()
    sender.publish("a", b"1", 1)
    client = Client(broker)
    assert client.log_in(connect("client", props=KEPT)) == ACCEPTED
    assert sender.publish("a", b"2", 1) == 0x10
    assert client.hear() == b""
    client.lose()
    again = Client(broker)
    assert again.log_in(connect("client", flags=0)) != ACCEPTED  # the new one is there
    assert sender.publish("a", b"3", 1) == 0x10


@statement("5.0", "MQTT-3.1.2-5", "MQTT-3.1.2-23", "MQTT-3.1.4-4", "MQTT-3.2.2-3", "MQTT-4.5.0-1")
def test_without_clean_start_the_session_goes_on(broker: Broker) -> None:
    client = Client(broker)
    assert client.log_in(connect("c", flags=0, props=KEPT)) == ACCEPTED
    client.subscribe("a", 2)
    client.lose()
    sender = joined(broker, "sender")
    sender.publish("a", b"1", 1)
    again = Client(broker)
    heard = again.log_in(connect("c", flags=0, props=KEPT))
    assert heard == SESSION_PRESENT + publish("a", b"1", 1, 1)
    sender.publish("a", b"2")
    assert again.hear() == publish("a", b"2")


@statement("5.0", "MQTT-3.1.2-5", "MQTT-4.3.3-10")
def test_a_qos_2_exchange_of_the_clients_goes_on(broker: Broker) -> None:
    watcher = watching(broker)
    client = joined(broker, **lasting(5))
    assert client.say(publish("a", b"x", 2, 7)) == wire("50 02 0007")
    client.lose()
    again = joined(broker, **lasting(5))
    assert again.say(publish("a", b"x", 2, 7, dup=True)) == wire("50 02 0007")
    assert again.say("62 02 0007") == wire("70 02 0007")
    assert watcher.hear() == publish("a", b"x", 2, 1)


@statement("5.0", "MQTT-3.1.2-6", "MQTT-3.1.4-4", "MQTT-3.2.2-3")
def test_without_clean_start_and_without_a_session_there_is_a_new_one(broker: Broker) -> None:
    client = Client(broker)
    assert client.log_in(connect("c", flags=0)) == ACCEPTED
    assert client.say("82 07 0001 00 0001 61 00") == wire("90 04 0001 00 00")
    joined(broker, "sender").publish("a", b"x")
    assert client.hear() == publish("a", b"x")


# --- 3.1.2.5 the will

WILL_PAYLOAD: tuple[bytes | str, ...] = ("c", b"\0", "w", "gone")
IS_GONE = publish("w", b"gone")


def die_silently(client: Client, broker: Broker) -> None:
    client.lose()


def be_silent_too_long(client: Client, broker: Broker) -> None:
    broker.tick(broker.now + 16)
    assert client.hear() == disconnect(0x8D)


def break_the_protocol(client: Client, broker: Broker) -> None:
    assert client.say("82 02 0001") == disconnect(0x81)


def leave_with_the_will(client: Client, broker: Broker) -> None:
    assert client.say("e0 01 04") == b""


def leave_with_an_error(client: Client, broker: Broker) -> None:
    assert client.say("e0 01 80") == b""


def be_taken_over(client: Client, broker: Broker) -> None:
    joined(broker, "c")
    assert client.hear() == disconnect(0x8E)


ENDS = [
    die_silently,
    be_silent_too_long,
    break_the_protocol,
    leave_with_the_will,
    leave_with_an_error,
    be_taken_over,
]
End = Callable[[Client, Broker], None]


@statement("5.0", "MQTT-3.1.2-7", "MQTT-3.1.2-8", "MQTT-3.1.2-22")
@pytest.mark.parametrize("kept", [b"\0", KEPT], ids=["session ends", "session is kept"])
@pytest.mark.parametrize("end", ENDS, ids=lambda end: end.__name__)
def test_the_will_is_published_when_the_connection_ends(
    broker: Broker, end: End, kept: bytes
) -> None:
    watcher = watching(broker)
    client = Client(broker)
    client.log_in(connect(*WILL_PAYLOAD, flags=CLEAN_START | WILL, keep_alive=10, props=kept))
    broker.tick(broker.now + 5)
    assert watcher.hear() == b""
    end(client, broker)
    assert watcher.hear() == IS_GONE
    assert client.closed or end is die_silently


@statement("5.0", "MQTT-3.1.2-8", "MQTT-3.1.2-10", "MQTT-3.14.4-3")
@pytest.mark.parametrize("goodbye", ["e0 00", "e0 01 00", "e0 02 00 00"])
@pytest.mark.parametrize("delay", ["", "18 0000000a"], ids=["at once", "delayed"])
def test_a_normal_disconnect_removes_the_will(broker: Broker, goodbye: str, delay: str) -> None:
    watcher = watching(broker)
    client = Client(broker)
    payload = ("c", properties(delay), "w", "gone")
    client.log_in(connect(*payload, flags=CLEAN_START | WILL, props=KEPT))
    assert client.say(goodbye) == b"" and client.closed
    broker.tick(broker.now + 50)
    again = Client(broker)
    again.log_in(connect("c", flags=0))
    again.lose()
    broker.tick(broker.now + 1000)
    assert watcher.hear() == b""


@statement("5.0", "MQTT-3.1.2-10")
def test_a_will_is_published_once(broker: Broker) -> None:
    watcher = watching(broker)
    client = Client(broker)
    client.log_in(connect(*WILL_PAYLOAD, flags=CLEAN_START | WILL, props=KEPT))
    client.lose()
    assert watcher.hear() == IS_GONE
    again = Client(broker)
    assert again.log_in(connect("c", flags=0, props=KEPT)) == SESSION_PRESENT
    again.lose()
    broker.tick(broker.now + 1000)
    assert watcher.hear() == b""


@statement("5.0", "MQTT-3.1.2-8")
@pytest.mark.parametrize("end", ["lost", "e0 01 04", "82 02 0001"])
def test_the_will_waits_for_its_delay(broker: Broker, end: str) -> None:
    watcher = watching(broker)
    client = Client(broker)
    payload = ("c", properties("18 0000000a"), "w", "gone")  # 10 s
    client.log_in(connect(*payload, flags=CLEAN_START | WILL, props=KEPT))
    client.lose() if end == "lost" else client.say(end)
    broker.tick(broker.now + 9)
    assert watcher.hear() == b""
    broker.tick(broker.now + 1)
    assert watcher.hear() == IS_GONE


@statement("5.0", "MQTT-3.1.2-8")
@pytest.mark.parametrize(
    "end_session",
    [
        lambda broker: broker.tick(broker.now + 100),
        lambda broker: joined(broker, "c", clean=True).lose(),
    ],
    ids=["it expires", "a clean start"],
)
def test_the_will_does_not_wait_longer_than_the_session_lasts(
    broker: Broker, end_session: Callable[[Broker], None]
) -> None:
    watcher = watching(broker)
    client = Client(broker)
    payload = ("c", properties("18 00000e10"), "w", "gone")  # an hour
    client.log_in(connect(*payload, flags=CLEAN_START | WILL, props=KEPT))
    client.lose()
    broker.tick(broker.now + 50)
    assert watcher.hear() == b""
    end_session(broker)
    assert watcher.hear() == IS_GONE


@statement("5.0", "MQTT-3.1.2-8")
def test_without_a_session_that_is_kept_no_will_waits(broker: Broker) -> None:
    watcher = watching(broker)
    client = Client(broker)
    payload = ("c", properties("18 00000e10"), "w", "gone")
    client.log_in(connect(*payload, flags=CLEAN_START | WILL))
    client.lose()
    assert watcher.hear() == IS_GONE


@statement("5.0", "MQTT-3.1.3-9", "MQTT-3.1.2-8")
@pytest.mark.parametrize("absent", [True, False], ids=["came back", "took over"])
def test_a_new_connection_in_time_keeps_the_will_back(broker: Broker, absent: bool) -> None:
    watcher = watching(broker)
    client = Client(broker)
    payload = ("c", properties("18 0000000a"), "w", "gone")
    client.log_in(connect(*payload, flags=WILL, props=KEPT))
    if absent:
        client.lose()
        broker.tick(broker.now + 9)
    again = Client(broker)
    assert again.log_in(connect("c", flags=0, props=KEPT)) == SESSION_PRESENT
    broker.tick(broker.now + 1000)
    again.say("e0 00")
    broker.tick(broker.now + 1000)
    assert watcher.hear() == b""


@statement("5.0", "MQTT-3.1.2-9", "MQTT-3.1.4-1")
@pytest.mark.parametrize(
    "payload",
    [("c",), ("c", b"\0"), ("c", b"\0", "w"), ("c", "w", "gone"), ("c", b"\0", "w", b"\0\5gone")],
    ids=["nothing", "no topic", "no payload", "no properties", "less payload than it says"],
)
def test_a_will_that_is_not_all_there_is_malformed(
    broker: Broker, payload: tuple[bytes | str, ...]
) -> None:
    assert turned_away(Client(broker), connect(*payload, flags=CLEAN_START | WILL))


@statement("5.0", "MQTT-3.1.2-11", "MQTT-3.1.2-13", "MQTT-3.1.4-1")
@pytest.mark.parametrize(
    "flags",
    [
        pytest.param(flags, id=f"QoS {flags >> 3 & 3}, retain {flags >> 5 & 1}")
        for flags in (0x08, 0x10, 0x18, 0x20, 0x28, 0x30)
    ],
)
def test_will_flags_without_a_will_are_malformed(broker: Broker, flags: int) -> None:
    assert turned_away(Client(broker), connect("c", flags=CLEAN_START | flags))
    assert turned_away(Client(broker), connect(*WILL_PAYLOAD, flags=CLEAN_START | flags))


@statement("5.0", "MQTT-3.1.2-12")
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_the_will_has_its_qos(broker: Broker, qos: int) -> None:
    watcher = watching(broker)
    client = Client(broker)
    client.log_in(connect(*WILL_PAYLOAD, flags=CLEAN_START | WILL | qos << 3))
    client.lose()
    assert watcher.hear() == publish("w", b"gone", qos)


@statement("5.0", "MQTT-3.1.2-12", "MQTT-3.1.4-1")
def test_a_will_qos_of_3_is_malformed(broker: Broker) -> None:
    data = connect(*WILL_PAYLOAD, flags=CLEAN_START | WILL | 0x18)
    assert turned_away(Client(broker), data)


@pytest.mark.parametrize(
    "retain",
    [
        pytest.param(False, marks=statement("5.0", "MQTT-3.1.2-14"), id="not retained"),
        pytest.param(True, marks=statement("5.0", "MQTT-3.1.2-15"), id="retained"),
    ],
)
def test_the_will_is_retained_or_not(broker: Broker, retain: bool) -> None:
    watcher = watching(broker)
    client = Client(broker)
    flags = CLEAN_START | WILL | (WILL_RETAIN if retain else 0)
    client.log_in(connect(*WILL_PAYLOAD, flags=flags))
    client.lose()
    assert watcher.hear() == publish("w", b"gone", retain=retain)
    later = joined(broker, "later")
    later.subscribe("w")
    assert later.hear() == (publish("w", b"gone", retain=True) if retain else b"")


@statement("5.0", "MQTT-3.1.3-10", "MQTT-3.1.3-1", "MQTT-3.3.2-18")
def test_the_will_has_its_properties_and_their_order(broker: Broker) -> None:
    watcher = watching(broker)
    client = Client(broker)
    message = [
        "01 01",  # UTF-8
        "03 0004 74657874",  # content type "text"
        "08 0001 72",  # response topic "r"
        "09 0002 aabb",  # correlation data
        "26 0001 62 0001 31",  # b: 1
        "26 0001 61 0001 32",  # a: 2
        "26 0001 62 0001 31",  # b: 1
        "26 0001 62 0001 30",  # b: 0
    ]
    payload = ("c", properties("18 00000000", *message), "w", "gone")
    client.log_in(connect(*payload, flags=CLEAN_START | WILL))
    client.lose()
    assert watcher.hear() == publish("w", b"gone", props=properties(*message))


@statement("5.0", "MQTT-3.3.2-6")
def test_the_will_has_its_whole_expiry_interval_when_it_is_published(broker: Broker) -> None:
    """Section 3.1.3.2.4: it is the message's lifetime from then on."""
    watcher = watching(broker)
    client = Client(broker)
    payload = ("c", properties("02 0000001e"), "w", "gone")  # 30 s
    client.log_in(connect(*payload, flags=CLEAN_START | WILL))
    broker.tick(broker.now + 1000)
    client.lose()
    assert watcher.hear() == publish("w", b"gone", props=properties("02 0000001e"))


# --- 3.1.2.8, 3.1.2.9 user name and password


@statement("5.0", "MQTT-3.1.2-16", "MQTT-3.1.2-18", "MQTT-3.1.4-1")
@pytest.mark.parametrize(
    ("flags", "payload"),
    [(0, ("c", "user")), (0, ("c", "user", "secret")), (USER_NAME, ("c", "user", "secret"))],
    ids=["a user name", "both", "a password"],
)
def test_what_no_flag_announces_must_not_be_there(
    broker: Broker, flags: int, payload: tuple[str, ...]
) -> None:
    assert turned_away(Client(broker), connect(*payload, flags=CLEAN_START | flags))


@statement("5.0", "MQTT-3.1.2-17", "MQTT-3.1.2-19", "MQTT-3.1.4-1")
@pytest.mark.parametrize(
    ("flags", "payload"),
    [
        (USER_NAME, ("c",)),
        (PASSWORD, ("c",)),
        (USER_NAME | PASSWORD, ("c", "user")),
        (USER_NAME, ("c", b"\0\5user")),
    ],
    ids=["no user name", "no password", "no password behind the name", "less than it says"],
)
def test_what_a_flag_announces_must_be_there(
    broker: Broker, flags: int, payload: tuple[bytes | str, ...]
) -> None:
    assert turned_away(Client(broker), connect(*payload, flags=CLEAN_START | flags))


@statement(
    "5.0", "MQTT-3.1.2-16", "MQTT-3.1.2-17", "MQTT-3.1.2-18", "MQTT-3.1.2-19", "MQTT-3.1.3-1"
)
@pytest.mark.parametrize(
    ("flags", "payload", "user", "password"),
    [
        (0, ("c",), None, None),
        (USER_NAME, ("c", "user"), "user", None),
        (USER_NAME, ("c", ""), "", None),
        (USER_NAME | PASSWORD, ("c", "user", "secret"), "user", b"secret"),
        (PASSWORD, ("c", "secret"), None, b"secret"),
        (PASSWORD, ("c", b"\0\2\xff\0"), None, b"\xff\0"),
    ],
    ids=["neither", "user", "empty user", "both", "password alone", "password that is no text"],
)
def test_user_name_and_password_are_what_the_packet_has(
    broker: Broker,
    flags: int,
    payload: tuple[bytes | str, ...],
    user: str | None,
    password: bytes | None,
) -> None:
    client = Client(broker)
    assert client.log_in(connect(*payload, flags=CLEAN_START | flags), user) == ACCEPTED
    assert client.transport.asked is not None
    assert (client.transport.asked.username, client.transport.asked.password) == (user, password)


# --- 3.1.2.10 keep alive


@statement("5.0", "MQTT-3.1.2-22", "MQTT-3.2.2-22")
@pytest.mark.parametrize("keep_alive", [1, 10, 65535])
def test_one_and_a_half_keep_alive_and_the_connection_is_closed(
    broker: Broker, keep_alive: int
) -> None:
    watcher = watching(broker)
    client = Client(broker)
    data = connect(*WILL_PAYLOAD, flags=CLEAN_START | WILL, keep_alive=keep_alive)
    assert client.log_in(data) == ACCEPTED
    broker.tick(broker.now + 1.49 * keep_alive)
    assert not client.closed
    broker.tick(broker.now + 0.02 * keep_alive)
    assert client.hear() == disconnect(0x8D) and client.closed
    assert watcher.hear() == IS_GONE


@statement("5.0", "MQTT-3.1.2-22")
@pytest.mark.parametrize(
    "sign_of_life", ["c0 00", "30 04 0001 61 00", "40 02 0001", "82 07 0001 00 0001 61 00"]
)
def test_every_packet_is_a_sign_of_life(broker: Broker, sign_of_life: str) -> None:
    client = joined(broker, keep_alive=10)
    for _ in range(5):
        broker.tick(broker.now + 14)
        client.say(sign_of_life)
    assert not client.closed
    broker.tick(broker.now + 16)
    assert client.closed


@statement("5.0", "MQTT-3.1.2-22")
def test_a_packet_that_does_not_end_is_no_sign_of_life(broker: Broker) -> None:
    client = joined(broker, keep_alive=10)
    client.say("30 7f 0001 61 00")
    for _ in range(4):
        broker.tick(broker.now + 4)
        if not client.closed:
            client.say(b"x")
    assert client.hear() == disconnect(0x8D) and client.closed


@statement("5.0", "MQTT-3.1.2-22")
def test_without_keep_alive_a_client_may_be_silent(broker: Broker) -> None:
    client = joined(broker, keep_alive=0)
    broker.tick(broker.now + 1_000_000)
    assert client.say("c0 00") == wire("d0 00")


# --- 3.1.2.11.2 Session Expiry Interval


@statement("5.0", "MQTT-3.1.2-23", "MQTT-4.1.0-2")
@pytest.mark.parametrize("ending", ["lost", "e0 00"])
def test_the_session_is_kept_as_long_as_was_asked_for(broker: Broker, ending: str) -> None:
    client = joined(broker, clean=False, properties={P.SESSION_EXPIRY_INTERVAL: 100})
    client.subscribe("a", 1)
    client.lose() if ending == "lost" else client.say(ending)
    broker.tick(broker.now + 99)
    again = Client(broker)
    assert again.log_in(connect("client", flags=0, props=KEPT)) == SESSION_PRESENT
    assert joined(broker, "sender").publish("a", b"x", 1) == 0
    assert again.hear() == publish("a", b"x", 1, 1)
    again.lose()
    broker.tick(broker.now + 100)
    assert Client(broker).log_in(connect("client", flags=0)) == ACCEPTED


@statement("5.0", "MQTT-3.1.2-23")
@pytest.mark.parametrize("limits", [Limits(session_expiry=1000)])
def test_a_longer_interval_than_allowed_is_told(broker: Broker) -> None:
    """Section 3.2.2.3.2."""
    client = Client(broker)
    answer = client.log_in(connect("c", props=properties("11 ffffffff")))
    assert answer[:4] == wire("20 0e 00 00") and wire("11 000003e8") in answer
    client.lose()
    broker.tick(broker.now + 999)
    again = Client(broker)
    assert again.log_in(connect("c", flags=0)) == SESSION_PRESENT


# --- 3.1.2.11.4 Maximum Packet Size


@statement("5.0", "MQTT-3.1.2-24", "MQTT-3.1.2-25")
@pytest.mark.parametrize("qos", [0, 1, 2])
@pytest.mark.parametrize("present", [True, False], ids=["at once", "queued"])
def test_a_message_that_is_too_large_is_left_out(broker: Broker, qos: int, present: bool) -> None:
    few = {P.MAXIMUM_PACKET_SIZE: 20, P.RECEIVE_MAXIMUM: 1, P.SESSION_EXPIRY_INTERVAL: 100}
    client = joined(broker, clean=False, properties=few)
    client.subscribe("a", qos)
    largest = 20 - len(publish("a", b"", qos))
    if not present:
        client.lose()
    sender = joined(broker, "sender")
    for size in (largest + 1, 1000, largest, largest + 1):
        assert sender.publish("a", bytes(size), qos) == 0
    if not present:
        client = joined(broker, clean=False, properties=few)
    # The window of 1 is free for the message that fits, as if the others had been sent and done.
    heard = client.hear()
    if qos == 0 and not present:
        assert heard == b""
    else:
        assert len(heard) == 20 and heard.endswith(bytes(largest))


@statement("5.0", "MQTT-3.1.2-24")
def test_properties_count_for_the_packet_size(broker: Broker) -> None:
    client = joined(broker, properties={P.MAXIMUM_PACKET_SIZE: 20})
    client.say(packet(0x82, b"\0\1", properties("0b 01"), field("a"), b"\0"))
    sender = joined(broker, "sender")
    for size in (14, 13, 12):  # 20 bytes and less, before the identifier takes two
        sender.publish("a", bytes(size))
    assert client.hear() == publish("a", bytes(12), props=properties("0b 01"))


@statement("5.0", "MQTT-3.1.2-24", "MQTT-3.1.2-26")
@pytest.mark.parametrize("topic", ["a", "a/long/topic"])
def test_an_alias_counts_for_the_packet_size(broker: Broker, topic: str) -> None:
    client = joined(broker, properties={P.MAXIMUM_PACKET_SIZE: 2000, P.TOPIC_ALIAS_MAXIMUM: 5})
    client.subscribe("#")
    sender = joined(broker, "sender")
    sender.publish(topic, b"x")  # which gives the topic its alias
    assert client.hear() == publish(topic, b"x", props=properties("23 0001"))
    for size in range(1970, 2010):
        sender.publish(topic, bytes(size))
        assert len(client.hear()) <= 2000


@statement("5.0", "MQTT-3.1.2-24")
def test_no_answer_is_larger_than_the_client_takes(broker: Broker) -> None:
    client = joined(broker, properties={P.MAXIMUM_PACKET_SIZE: 20})
    many = b"".join(field(f"{n}") + b"\0" for n in range(30))
    assert len(client.say(packet(0x82, b"\0\1\0", many))) <= 20


@statement("5.0", "MQTT-3.1.2-24")
@pytest.mark.parametrize("size", [1, 4, 10])
def test_a_client_that_cannot_take_its_connack_is_not_sent_one(broker: Broker, size: int) -> None:
    client = Client(broker)
    props = properties(b"\x27" + size.to_bytes(4, "big"))
    assert len(client.log_in(connect("c", props=props))) <= size


# --- 3.1.2.11.5 Topic Alias Maximum


@statement("5.0", "MQTT-3.1.2-26", "MQTT-3.3.2-11", "MQTT-3.3.2-8")
@pytest.mark.parametrize("maximum", [1, 2, 3])
def test_no_alias_is_above_the_clients_maximum(broker: Broker, maximum: int) -> None:
    client = joined(broker, properties={P.TOPIC_ALIAS_MAXIMUM: maximum})
    client.subscribe("#")
    sender = joined(broker, "sender")
    names: dict[int, str] = {}
    used = set()
    for n in range(40):
        topic = f"a/long/name/{n % 5}"
        sender.publish(topic, b"x")
        (message,) = client.messages()
        alias = (message.properties or {}).get(P.TOPIC_ALIAS)
        if alias is None:
            assert message.topic == topic
            continue
        assert isinstance(alias, int) and 1 <= alias <= maximum
        used.add(alias)
        if message.topic:
            names[alias] = message.topic
        assert names[alias] == topic
    assert used == set(range(1, maximum + 1))


@statement("5.0", "MQTT-3.1.2-26")
def test_the_first_message_has_topic_and_alias_and_the_next_only_the_alias(broker: Broker) -> None:
    client = joined(broker, properties={P.TOPIC_ALIAS_MAXIMUM: 5})
    client.subscribe("#", 2)
    sender = joined(broker, "sender")
    for qos in (0, 1, 2):
        sender.publish("a/long/topic", b"x", qos)
    first = publish("a/long/topic", b"x", props=properties("23 0001"))
    then = [publish("", b"x", qos, qos, props=properties("23 0001")) for qos in (1, 2)]
    assert client.hear() == b"".join([first, *then])


@statement("5.0", "MQTT-3.1.2-27")
@pytest.mark.parametrize("asked", [{}, {P.TOPIC_ALIAS_MAXIMUM: 0}], ids=["absent", "0"])
def test_without_a_maximum_there_are_no_aliases(broker: Broker, asked: dict[P, int]) -> None:
    client = joined(broker, properties=asked)
    client.subscribe("#", 1)
    sender = joined(broker, "sender")
    for n in range(1, 4):
        sender.publish("a/long/topic", b"x", 1)
        assert client.hear() == publish("a/long/topic", b"x", 1, n)


# --- 3.1.2.11.6 and 3.1.2.11.7: what the client asks to be told

INFORMATION = b"\x1a" + field("answers/c")


@statement("5.0", "MQTT-3.1.2-28")
@pytest.mark.parametrize("asked", ["", "19 00"], ids=["absent", "0"])
def test_response_information_comes_only_to_who_asks(broker: Broker, asked: str) -> None:
    broker.features = Features(response_information="answers/%c")
    assert Client(broker).log_in(connect("c", props=properties(asked))) == ACCEPTED


@statement("5.0", "MQTT-3.1.2-28")
def test_response_information_comes_to_who_asks(broker: Broker) -> None:
    broker.features = Features(response_information="answers/%c")
    answer = Client(broker).log_in(connect("c", props=properties("19 01")))
    assert answer[:4] == wire("20 15 00 00") and INFORMATION in answer


#: What is answered with an error, and that answer without words.
REFUSED = {
    "PUBACK": (publish("no/a", b"x", 1, 7), {"40 03 0007 87"}),
    "PUBREC": (publish("no/a", b"x", 2, 7), {"50 03 0007 87"}),
    "PUBREL": (wire("50 02 0007"), {"62 03 0007 92", "62 02 0007"}),
    "PUBCOMP": (wire("62 02 0007"), {"70 03 0007 92", "70 02 0007"}),
    "SUBACK": (wire("82 0a 0007 00 0004 6e6f2f23 00"), {"90 04 0007 00 87"}),
    "UNSUBACK": (wire("a2 09 0007 00 0004 6e6f2f23"), {"b0 04 0007 00 11"}),
}


@statement("5.0", "MQTT-3.1.2-29")
@pytest.mark.parametrize("kind", REFUSED)
def test_who_wants_no_problem_information_gets_none(
    broker: Broker, access: FakeAccess, kind: str
) -> None:
    broker.features = Features(reason_strings=True)
    for action in (Action.PUBLISH, Action.SUBSCRIBE):
        access.deny("user", action, "no/#")
    said, short = REFUSED[kind]
    client = joined(broker, properties={P.REQUEST_PROBLEM_INFORMATION: 0})
    assert client.say(said) in set(map(wire, short))


@statement("5.0", "MQTT-3.1.2-29")
@pytest.mark.parametrize("kind", ["PUBACK", "PUBREC"])
@pytest.mark.parametrize("asked", [{}, {P.REQUEST_PROBLEM_INFORMATION: 1}], ids=["absent", "1"])
def test_who_does_not_say_so_is_told_why(
    broker: Broker, access: FakeAccess, kind: str, asked: dict[P, int]
) -> None:
    """What it is that the others are not sent."""
    broker.features = Features(reason_strings=True)
    for action in (Action.PUBLISH, Action.SUBSCRIBE):
        access.deny("user", action, "no/#")
    said, _ = REFUSED[kind]
    client = joined(broker, properties=asked)
    client.send(said)
    (answer,) = client.received()
    assert answer.properties is not None  # type: ignore[union-attr]
    assert answer.properties[P.REASON_STRING]  # type: ignore[union-attr]


# --- 3.1.3 payload


@statement("5.0", "MQTT-3.1.3-1", "MQTT-3.1.3-3")
def test_the_payload_is_read_in_its_order(broker: Broker) -> None:
    watcher = watching(broker)
    client = Client(broker)
    will_properties = properties("26 0001 6b 0001 76")
    data = connect("1", will_properties, "2", "3", "4", "5", flags=CLEAN_START | 0xC4)
    assert client.log_in(data, "4") == ACCEPTED
    asked = client.transport.asked
    assert asked is not None
    assert (asked.client_id, asked.username, asked.password) == ("1", "4", b"5")
    client.lose()
    assert watcher.hear() == publish("2", b"3", props=will_properties)


@statement("5.0", "MQTT-3.1.3-2")
def test_the_client_identifier_says_which_session_is_meant(broker: Broker) -> None:
    for name in ("one", "One", "two"):
        client = joined(broker, name, **lasting(5))
        client.subscribe(f"of/{name}", 1)
        client.lose()
    sender = joined(broker, "sender")
    sender.publish("of/one", b"x", 1)
    for name, expected in (("two", b""), ("One", b""), ("one", publish("of/one", b"x", 1))):
        again = Client(broker)
        assert again.log_in(connect(name, flags=0)) == SESSION_PRESENT + expected


@statement("5.0", "MQTT-3.1.3-3", "MQTT-3.1.4-1")
def test_a_connect_without_a_client_identifier_is_malformed(broker: Broker) -> None:
    assert turned_away(Client(broker), connect())


@statement("5.0", "MQTT-3.1.3-5")
@pytest.mark.parametrize(
    "client_id",
    [
        "0",
        "Z",
        "0123456789abcdefghijklm",
        "nopqrstuvwxyzABCDEFGHIJ",
        "KLMNOPQRSTUVWXYZ",
        "a" * 23,
    ],
)
def test_short_plain_client_identifiers_are_allowed(broker: Broker, client_id: str) -> None:
    assert Client(broker).log_in(connect(client_id)) == ACCEPTED
    assert set(broker.sessions) == {client_id}


@statement("5.0", "MQTT-3.1.3-6", "MQTT-3.1.3-7", "MQTT-3.2.2-16")
@pytest.mark.parametrize("flags", [CLEAN_START, 0], ids=["clean start", "no clean start"])
def test_a_client_without_an_identifier_is_given_one(broker: Broker, flags: int) -> None:
    names = set()
    for _ in range(20):
        client = Client(broker)
        answer = client.log_in(connect("", flags=flags))
        assert answer[0] == 0x20 and answer[2:4] == b"\0\0"
        _, _, assigned = answer[5:].partition(b"\x12")
        size = int.from_bytes(assigned[:2], "big")
        names.add(assigned[2 : 2 + size].decode())
    assert len(names) == 20 and "" not in names
    assert names == set(broker.sessions)


@statement("5.0", "MQTT-3.1.3-7")
def test_the_identifier_that_was_given_is_the_clients_from_then_on(broker: Broker) -> None:
    client = Client(broker)
    answer = client.connect("", clean=True, properties={P.SESSION_EXPIRY_INTERVAL: 100})
    assert answer.properties is not None
    name = answer.properties[P.ASSIGNED_CLIENT_IDENTIFIER]
    assert isinstance(name, str)
    client.subscribe("a", 1)
    client.lose()
    joined(broker, "sender").publish("a", b"x", 1)
    again = Client(broker)
    assert again.log_in(connect(name, flags=0)) == SESSION_PRESENT + publish("a", b"x", 1)


@statement("5.0", "MQTT-3.1.3-8", "MQTT-3.2.2-6", "MQTT-3.2.2-7")
def test_a_client_identifier_that_is_not_accepted_is_told_so(broker: Broker) -> None:
    owner = joined(broker, user="owner", **lasting(5))
    client = Client(broker)
    assert client.log_in(connect("client", flags=0), "thief") == connack(0x85)
    assert client.closed
    assert owner.say("c0 00") == wire("d0 00")


# --- 3.1.4 actions


@statement("5.0", "MQTT-3.1.4-1", "MQTT-4.13.1-1", "MQTT-3.14.0-1")
@pytest.mark.parametrize(
    "data",
    [
        packet(0x10, field("MQTT"), b"\5\2\0\0"),
        packet(0x10, field("MQTT"), b"\5\2\0"),
        packet(0x10, field("MQTT"), b"\5"),
        packet(0x10, field("MQTT")),
        packet(0x10),
        connect("c", b"\0"),
        connect(b"\0\2c"),
        connect("c", props=b"\5\x11\0\0\0"),
        connect("c", props=properties("0a 00")),
        connect("c", props=properties("02 00000001")),
        connect("c", props=properties("11 00000001 11 00000001")),
        connect("c", props=properties("21 0000")),
        connect("c", props=properties("21 0005 21 0005")),
        connect("c", props=properties("27 00000000")),
        connect("c", props=properties("22 0005 22 0005")),
        connect("c", props=properties("17 02")),
        connect("c", props=properties("19 02")),
        connect("c", props=properties("17 01 17 01")),
        connect("c", props=properties("15 0001 61 15 0001 61")),
        connect("c", props=properties("16 0001 61")),
        connect("c", properties("11 00000001"), "w", "x", flags=CLEAN_START | WILL),
        connect("c", properties("18 00000001 18 00000001"), "w", "x", flags=CLEAN_START | WILL),
        connect("c", properties("01 02"), "w", "x", flags=CLEAN_START | WILL),
        connect("c", b"\0", "w/#", "x", flags=CLEAN_START | WILL),
        connect("c", b"\0", "", "x", flags=CLEAN_START | WILL),
    ],
    ids=[
        "no property length",
        "cut in the keep alive",
        "cut behind the version",
        "cut behind the name",
        "empty",
        "a byte behind its end",
        "a client identifier longer than the packet",
        "properties longer than the packet",
        "no such property",
        "a property of PUBLISH",
        "session expiry twice",
        "Receive Maximum 0",
        "Receive Maximum twice",
        "Maximum Packet Size 0",
        "Topic Alias Maximum twice",
        "Request Problem Information 2",
        "Request Response Information 2",
        "Request Problem Information twice",
        "two authentication methods",
        "authentication data without a method",
        "a will with a property of CONNECT",
        "two will delays",
        "a will with a format that there is not",
        "a will topic with a wildcard",
        "an empty will topic",
    ],
)
def test_a_connect_that_is_wrong_ends_the_connection(broker: Broker, data: bytes) -> None:
    assert turned_away(Client(broker), data)
    assert broker.sessions == {}


@statement("5.0", "MQTT-3.1.4-2", "MQTT-3.2.2-6", "MQTT-3.2.2-7", "MQTT-4.13.2-1")
def test_a_client_that_fails_authentication_is_closed(broker: Broker) -> None:
    client = Client(broker)
    client.say(connect("c", "user", "wrong", flags=CLEAN_START | USER_NAME | PASSWORD))
    client.client.refuse(ReasonCode.NOT_AUTHORIZED, "wrong password")
    broker.flush()
    assert client.hear() == connack(0x87) and client.closed
    assert broker.sessions == {}


@statement("5.0", "MQTT-3.1.4-3", "MQTT-4.13.2-1")
@pytest.mark.parametrize("flags", [CLEAN_START, 0], ids=["clean start", "no clean start"])
def test_a_client_that_is_connected_already_is_told_so_and_closed(
    broker: Broker, flags: int
) -> None:
    before = joined(broker, "c", **lasting(5))
    now = Client(broker)
    assert now.log_in(connect("c", flags=flags)) == (ACCEPTED if flags else SESSION_PRESENT)
    assert before.hear() == disconnect(0x8E) and before.closed
    assert now.say("c0 00") == wire("d0 00")


@statement("5.0", "MQTT-3.1.4-5", "MQTT-3.2.0-1", "MQTT-3.2.2-8")
def test_an_accepted_connect_is_answered_with_success(broker: Broker) -> None:
    assert Client(broker).log_in(connect("c")) == ACCEPTED


@statement("5.0", "MQTT-3.1.4-6")
@pytest.mark.parametrize("together", [True, False], ids=["in one chunk", "while it is decided"])
def test_what_comes_behind_a_refused_connect_has_no_effect(broker: Broker, together: bool) -> None:
    watcher = watching(broker)
    before = joined(broker, "victim", **lasting(5))
    before.subscribe("kept", 1)
    client = Client(broker)
    behind = [
        publish("a", b"x", retain=True),
        publish("a", b"x", 1),
        publish("a", b"x", 2) + wire("62 02 0001"),
        wire("82 07 0001 00 0001 61 00"),
        wire("a2 09 0002 00 0004 6b657074"),
        wire("c0 00"),
    ]
    if together:
        assert client.say(connect("victim"), *behind) == b""
    else:
        client.say(connect("victim"))
        assert client.say(*behind) == b""
    client.client.refuse(ReasonCode.NOT_AUTHORIZED, "wrong password")
    broker.flush()
    assert client.hear() == connack(0x87) and client.closed
    client.send(*behind)
    assert client.hear() == b"" and watcher.hear() == b""
    assert broker.retained.get("a") is None
    assert set(broker.sessions) == {"watcher", "victim"}
    assert before.say("c0 00") == wire("d0 00")
    joined(broker, "sender").publish("kept", b"x")
    assert before.hear() == publish("kept", b"x")


@statement("5.0", "MQTT-3.2.0-1", "MQTT-3.1.4-5")
def test_what_comes_behind_an_accepted_connect_is_done_after_connack(broker: Broker) -> None:
    watcher = watching(broker)
    client = Client(broker)
    assert client.say(connect("c"), "c0 00", publish("a", b"x", 1, 5)) == b""
    assert watcher.hear() == b""
    client.user = "user"
    client.let_in()
    assert client.hear() == ACCEPTED + wire("d0 00 40 02 0005")
    assert watcher.hear() == publish("a", b"x", 1)
