"""MQTT 3.1.1, chapters 3.1 and 3.2: CONNECT, the will, and CONNACK."""

from __future__ import annotations

import string

import pytest
from broker.conftest import FakeAccess
from client_v311 import (
    ACCEPTED,
    CLEAN_SESSION,
    PASSWORD,
    SESSION_PRESENT,
    USER_NAME,
    WILL,
    WILL_RETAIN,
    Client,
    connect,
    field,
    joined,
    packet,
    refused,
    wire,
)

from appliance.broker.broker import Broker
from appliance.broker.values import Action
from appliance.mqtt.packets import Will
from appliance.mqtt.reason import ReasonCode

statement = pytest.mark.statement

# --- the first packet, and the second


@statement("3.1.1", "MQTT-3.1.0-1", "MQTT-4.8.0-1")
@pytest.mark.parametrize(
    "first",
    [
        "20 02 00 00",
        "31 04 0001 61 78",
        "32 06 0001 61 0001 78",
        "40 02 0001",
        "50 02 0001",
        "62 02 0001",
        "70 02 0001",
        "82 06 0001 0001 61 00",
        "90 03 0001 00",
        "a2 05 0001 0001 61",
        "b0 02 0001",
        "c0 00",
        "d0 00",
        "e0 00",
        "00 00",
        "f0 00",
    ],
)
def test_what_comes_before_connect_closes_the_connection(broker: Broker, first: str) -> None:
    client = Client(broker)
    assert refused(client, first, connect("c"))
    assert client.transport.asked is None
    assert broker.sessions == {} and len(broker.retained) == 0


@statement("3.1.1", "MQTT-3.1.0-2", "MQTT-4.8.0-1")
@pytest.mark.parametrize("client_id", ["c", "another"])
def test_a_second_connect_closes_the_connection(broker: Broker, client_id: str) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("w")
    client = joined(broker, "c", will=Will("w", b"gone"))
    assert refused(client, connect(client_id), "c0 00")
    assert watcher.hear() == wire("30 07 0001 77 676f6e65")
    assert set(broker.sessions) == {"watcher"}


@statement("3.1.1", "MQTT-3.1.0-2")
def test_a_second_connect_before_the_first_is_answered(broker: Broker) -> None:
    client = Client(broker)
    assert client.log_in(connect("c") + connect("c")) == ACCEPTED
    assert client.closed
    assert broker.sessions == {}


# --- protocol name, level and reserved flag


@statement("3.1.1", "MQTT-3.1.2-1")
@pytest.mark.parametrize(
    ("name", "level"),
    [
        (name, level)
        for name in ("", "MQT", "MQTTT", "mqtt", "Mqtt", "MQIsdp", "HTTP")
        for level in (3, 4, 5)
        if (name, level) != ("MQIsdp", 3)  # which is MQTT 3.1, see test_v31.py
    ],
)
def test_another_protocol_is_not_taken_for_mqtt(broker: Broker, name: str, level: int) -> None:
    client = Client(broker)
    # It may be told what the server speaks, in the form that 3.1 knows too, or nothing.
    assert client.say(connect("c", name=name, level=level), "c0 00") in (b"", wire("20 02 00 01"))
    assert client.closed
    assert client.transport.asked is None and broker.sessions == {}


@statement("3.1.1", "MQTT-3.1.2-2", "MQTT-3.2.2-4", "MQTT-3.2.2-5")
@pytest.mark.parametrize("level", [0, 1, 2, 3, 6, 7, 0x83, 0x84, 0xFF])
def test_an_unsupported_level_is_answered_and_closed_upon(broker: Broker, level: int) -> None:
    client = Client(broker)
    assert client.say(connect("c", level=level), "c0 00") == wire("20 02 00 01")
    assert client.closed
    assert client.transport.asked is None and broker.sessions == {}


@statement("3.1.1", "MQTT-3.1.2-3", "MQTT-3.1.4-1")
@pytest.mark.parametrize("flags", [0x01, 0x03])
def test_the_reserved_connect_flag_closes_the_connection(broker: Broker, flags: int) -> None:
    assert refused(Client(broker), connect("c", flags=flags))


# --- what does not conform

ALL = CLEAN_SESSION | WILL | USER_NAME | PASSWORD
FIVE = ("c", "w", b"gone", "user", b"secret")


@statement("3.1.1", "MQTT-3.1.4-1", "MQTT-4.8.0-1")
@pytest.mark.parametrize(
    "data",
    [
        "10 00",
        "10 04 0004 4d51",
        "10 06 0004 4d515454",
        "10 07 0004 4d515454 04",
        "10 08 0004 4d515454 04 02",
        "10 09 0004 4d515454 04 02 00",
        "10 0b 0004 4d515454 04 02 0000 00",
        "10 0d 0004 4d515454 04 02 0000 0002 63",
        "10 0e 0004 4d515454 04 02 0000 0001 63 00",
        "10 ff ff ff ff 01",
    ],
    ids=[
        "empty",
        "in the name",
        "behind the name",
        "behind the level",
        "behind the flags",
        "in the keep alive",
        "in the client id's length",
        "in the client id",
        "a byte too many",
        "a length of five bytes",
    ],
)
def test_a_malformed_connect_gets_no_connack(broker: Broker, data: str) -> None:
    client = Client(broker)
    assert refused(client, data)
    assert client.transport.asked is None and broker.sessions == {}


@statement("3.1.1", "MQTT-3.1.4-1", "MQTT-3.2.2-6")
@pytest.mark.parametrize("topic", ["", "w/+", "#"])
def test_a_will_topic_that_is_none_gets_no_connack(broker: Broker, topic: str) -> None:
    """None of the return codes says so, and it could never be published."""
    assert refused(Client(broker), connect("c", topic, "gone", flags=CLEAN_SESSION | WILL))


@pytest.mark.parametrize(
    ("flags", "fields"),
    [
        pytest.param(CLEAN_SESSION, (), marks=statement("3.1.1", "MQTT-3.1.3-3"), id="no id"),
        *[
            pytest.param(flags, fields, marks=statement("3.1.1", *ids), id=name)
            for name, ids, flags, fields in (
                ("will flag, no will", ["MQTT-3.1.2-9"], CLEAN_SESSION | WILL, FIVE[:1]),
                ("will flag, no will message", ["MQTT-3.1.2-9"], CLEAN_SESSION | WILL, FIVE[:2]),
                ("a will, no will flag", ["MQTT-3.1.2-11"], CLEAN_SESSION, FIVE[:3]),
                (
                    "will QoS 1, no will flag",
                    ["MQTT-3.1.2-11", "MQTT-3.1.2-13"],
                    CLEAN_SESSION | 0x08,
                    FIVE[:1],
                ),
                (
                    "will QoS 2, no will flag",
                    ["MQTT-3.1.2-11", "MQTT-3.1.2-13"],
                    CLEAN_SESSION | 0x10,
                    FIVE[:1],
                ),
                (
                    "will retain, no will flag",
                    ["MQTT-3.1.2-11", "MQTT-3.1.2-15"],
                    CLEAN_SESSION | WILL_RETAIN,
                    FIVE[:1],
                ),
                ("will QoS 3", ["MQTT-3.1.2-14"], CLEAN_SESSION | WILL | 0x18, FIVE[:3]),
                ("user name, no flag", ["MQTT-3.1.2-18"], CLEAN_SESSION, ("c", "user")),
                ("flag, no user name", ["MQTT-3.1.2-19"], CLEAN_SESSION | USER_NAME, ("c",)),
                ("password, no flag", ["MQTT-3.1.2-20"], ALL & ~PASSWORD, FIVE),
                ("flag, no password", ["MQTT-3.1.2-21"], ALL, FIVE[:4]),
                (
                    "password without user name",
                    ["MQTT-3.1.2-22"],
                    CLEAN_SESSION | PASSWORD,
                    ("c", b"secret"),
                ),
                ("no id, other fields", ["MQTT-3.1.3-1", "MQTT-3.1.3-3"], ALL, FIVE[1:]),
            )
        ],
    ],
)
def test_flags_and_fields_that_do_not_agree_close_the_connection(
    broker: Broker, flags: int, fields: tuple[bytes | str, ...]
) -> None:
    client = Client(broker)
    assert refused(client, connect(*fields, flags=flags))
    assert client.transport.asked is None and broker.sessions == {}


@statement("3.1.1", "MQTT-3.1.3-1", "MQTT-3.1.3-3", "MQTT-3.1.2-9", "MQTT-3.1.2-19")
@statement("3.1.1", "MQTT-3.1.2-21")
def test_the_fields_are_taken_in_their_order(broker: Broker) -> None:
    client = Client(broker)
    client.say(connect(*FIVE, flags=ALL | WILL_RETAIN | 0x10, keep_alive=0x0102))
    asked = client.transport.asked
    assert asked is not None
    assert (asked.client_id, asked.username, asked.password) == ("c", "user", b"secret")
    assert asked.will == Will("w", b"gone", 2, True)
    assert asked.keep_alive == 0x0102


# --- client ids

LETTERS = string.digits + string.ascii_letters


@statement("3.1.1", "MQTT-3.1.3-5", "MQTT-3.1.4-4")
@pytest.mark.parametrize(
    "client_id",
    [*LETTERS, LETTERS[:23], LETTERS[23:46], LETTERS[-23:]],
)
def test_short_client_ids_of_digits_and_letters_are_allowed(broker: Broker, client_id: str) -> None:
    assert Client(broker).log_in(connect(client_id)) == ACCEPTED
    assert set(broker.sessions) == {client_id}


@statement("3.1.1", "MQTT-3.1.3-2")
def test_the_client_id_identifies_the_session(broker: Broker) -> None:
    names = ["c", "C", "c ", "cc", "ç", "c\u0327"]
    for name in names:
        client = Client(broker)
        assert client.log_in(connect(name, flags=0)) == ACCEPTED, "known already"
        client.subscribe(f"of/{name}")
        client.lose()
    publisher = joined(broker, "publisher")
    for name in names:
        client = Client(broker)
        assert client.log_in(connect(name, flags=0)) == SESSION_PRESENT
        publisher.publish(f"of/{name}", name.encode())
        assert client.payloads() == [name.encode()]


@statement("3.1.1", "MQTT-3.1.3-6", "MQTT-3.1.3-2")
def test_clients_without_an_id_are_given_one_each(broker: Broker) -> None:
    clients = [Client(broker) for _ in range(3)]
    for number, client in enumerate(clients):
        assert client.log_in(connect("")) == ACCEPTED
        client.subscribe(f"of/{number}")
    assert len(broker.sessions) == 3 and "" not in broker.sessions
    publisher = joined(broker, "publisher")
    for number in range(3):
        publisher.publish(f"of/{number}", b"%d" % number)
    assert [client.payloads() for client in clients] == [[b"0"], [b"1"], [b"2"]]
    assert not any(client.closed for client in clients)


@statement("3.1.1", "MQTT-3.1.3-7", "MQTT-3.1.3-8", "MQTT-3.2.2-4", "MQTT-3.2.2-5")
def test_no_client_id_with_clean_session_0_is_rejected(broker: Broker) -> None:
    client = Client(broker)
    assert client.say(connect("", flags=0), "c0 00") == wire("20 02 00 02")
    assert client.closed
    assert broker.sessions == {}


@statement("3.1.1", "MQTT-3.1.3-9", "MQTT-3.2.2-4", "MQTT-3.2.2-5")
@pytest.mark.parametrize("flags", [0, CLEAN_SESSION])
def test_the_client_id_of_another_users_session_is_rejected(broker: Broker, flags: int) -> None:
    owner = joined(broker, "c", clean=False)
    thief = Client(broker)
    assert thief.log_in(connect("c", flags=flags), user="thief") == wire("20 02 00 02")
    assert thief.closed and not owner.closed


# --- the answer


@statement("3.1.1", "MQTT-3.1.4-4", "MQTT-3.2.2-1", "MQTT-3.2.2-3")
@pytest.mark.parametrize("flags", [0, CLEAN_SESSION])
def test_who_is_new_has_no_session(broker: Broker, flags: int) -> None:
    assert Client(broker).log_in(connect("c", flags=flags)) == ACCEPTED


@statement("3.1.1", "MQTT-3.2.2-2", "MQTT-3.1.2-4")
@pytest.mark.parametrize("end", ["e0 00", None], ids=["DISCONNECT", "lost"])
def test_a_stored_session_is_present(broker: Broker, end: str | None) -> None:
    for answer in (ACCEPTED, SESSION_PRESENT, SESSION_PRESENT):
        client = Client(broker)
        assert client.log_in(connect("c", flags=0)) == answer
        if end is None:
            client.lose()
        else:
            assert refused(client, end)


@statement("3.1.1", "MQTT-3.2.2-1", "MQTT-3.2.2-3", "MQTT-3.1.4-3")
def test_clean_session_1_says_that_there_is_no_session(broker: Broker) -> None:
    joined(broker, "c", clean=False).lose()
    client = Client(broker)
    assert client.log_in(connect("c")) == ACCEPTED
    client.lose()
    assert Client(broker).log_in(connect("c", flags=0)) == ACCEPTED, "it ended with its connection"


@statement("3.1.1", "MQTT-3.2.2-4", "MQTT-3.2.2-5")
@pytest.mark.parametrize(
    ("code", "return_code"),
    [
        (ReasonCode.CLIENT_IDENTIFIER_NOT_VALID, 2),
        (ReasonCode.SERVER_UNAVAILABLE, 3),
        (ReasonCode.BAD_USER_NAME_OR_PASSWORD, 4),
        (ReasonCode.NOT_AUTHORIZED, 5),
    ],
)
def test_a_refusal_has_no_session_and_closes(
    broker: Broker, code: ReasonCode, return_code: int
) -> None:
    joined(broker, "c", clean=False).lose()
    client = Client(broker)
    client.say(connect("c", flags=0))
    client.client.refuse(code, "for a reason")
    broker.flush()
    assert client.hear() == bytes((0x20, 2, 0, return_code))
    assert client.closed


@statement("3.1.1", "MQTT-3.2.0-1")
def test_connack_comes_before_everything_else(broker: Broker) -> None:
    client = joined(broker, "c", clean=False)
    client.subscribe("#", 2)
    client.lose()
    publisher = joined(broker, "publisher")
    publisher.publish("a", b"x", 1)
    client = Client(broker)
    assert client.say(connect("c", flags=0), "c0 00", "82 06 0001 0001 61 00") == b""
    publisher.publish("a", b"y", 1)
    assert client.hear() == b""
    client.client.accept("user")
    broker.flush()
    heard = client.hear()
    assert heard.startswith(SESSION_PRESENT)
    for other in ("32 06 0001 61 0001 78", "32 06 0001 61 0002 79", "d0 00", "90 03 0001 00"):
        assert wire(other) in heard[4:]


@statement("3.1.1", "MQTT-3.1.4-5", "MQTT-3.1.2-8")
@pytest.mark.parametrize("early", [True, False])
def test_nothing_behind_a_rejected_connect_is_processed(broker: Broker, early: bool) -> None:
    watcher, owner = joined(broker, "watcher"), joined(broker, "c", clean=False)
    watcher.subscribe("#", 2)
    client = Client(broker)
    fields = ("c", "w", b"gone")
    behind = [
        "31 04 0001 61 78",
        "33 06 0001 61 0001 78",
        "34 06 0001 61 0002 78",
        "62 02 0002",
        "82 06 0003 0001 61 00",
        "c0 00",
        connect("c"),
    ]
    client.say(connect(*fields, flags=CLEAN_SESSION | WILL), *(behind if early else ()))
    client.client.refuse(ReasonCode.NOT_AUTHORIZED, "wrong password")
    broker.flush()
    assert client.hear() == wire("20 02 00 05")
    assert client.say(*behind) == b"" and client.closed
    client.lose()
    assert watcher.hear() == b"" and not owner.closed
    assert len(broker.retained) == 0


@statement("3.1.1", "MQTT-3.1.4-2")
@pytest.mark.parametrize("clean", [True, False])
def test_a_client_id_that_is_connected_is_taken_over(broker: Broker, clean: bool) -> None:
    first = joined(broker, "c", clean=clean)
    second = Client(broker)
    second.say(connect("c", flags=CLEAN_SESSION if clean else 0))
    assert not first.closed, "closed before it is known who asks"
    second.let_in()
    assert first.closed and first.hear() == b""
    assert second.hear() == (ACCEPTED if clean else SESSION_PRESENT)
    assert second.say("c0 00") == wire("d0 00")


# --- sessions


@statement("3.1.1", "MQTT-3.1.2-4", "MQTT-3.1.2-5", "MQTT-3.1.4-3", "MQTT-4.5.0-1")
def test_clean_session_0_resumes_with_what_was_missed(broker: Broker) -> None:
    client = joined(broker, "c", clean=False)
    client.subscribe("one", 1)
    client.subscribe("two", 2)
    client.disconnect()
    publisher = joined(broker, "publisher")
    for qos in (1, 2):
        publisher.publish("one", b"%d" % qos, qos)
        publisher.publish("two", b"%d" % qos, qos)
        publisher.publish("three", b"%d" % qos, qos)
    client = Client(broker)
    assert client.log_in(connect("c", flags=0)) == SESSION_PRESENT + wire(
        "32 08 0003 6f6e65 0001 31"
        "32 08 0003 74776f 0002 31"
        "32 08 0003 6f6e65 0003 32"
        "34 08 0003 74776f 0004 32"
    )
    publisher.publish("one", b"live", 0)
    assert client.hear() == wire("30 09 0003 6f6e65 6c697665"), "it is still subscribed"


@statement("3.1.1", "MQTT-3.1.2-4")
def test_a_session_is_stored_as_often_as_it_is_left(broker: Broker) -> None:
    joined(broker, "c", clean=False).subscribe("a", 1)
    publisher = joined(broker, "publisher")
    for number in range(3):
        client = Client(broker)
        assert client.log_in(connect("c", flags=0)) == SESSION_PRESENT
        publisher.publish("a", b"%d" % number, 1)
        assert [message.payload for message in client.drain()] == [b"%d" % number]
        client.lose()


@statement("3.1.1", "MQTT-3.1.2-6", "MQTT-3.1.4-3")
def test_clean_session_1_discards_all_of_the_old_session(broker: Broker) -> None:
    watcher, publisher = joined(broker, "watcher"), joined(broker, "publisher")
    watcher.subscribe("from/c", 2)
    client = joined(broker, "c", clean=False)
    client.subscribe("a", 1)
    publisher.publish("a", b"in flight", 1)
    assert client.say("34 0b 0006 66726f6d2f63 0007 31").endswith(wire("50 02 0007"))
    client.lose()
    publisher.publish("a", b"missed", 1)
    client = Client(broker)
    assert client.log_in(connect("c")) == ACCEPTED
    publisher.publish("a", b"no subscription", 1)
    assert client.hear() == b""
    # The QoS 2 message of the old session is not released by the new one, nor taken for its own.
    assert client.say("62 02 0007") == wire("70 02 0007")
    assert watcher.hear() == b""
    assert client.say("34 0b 0006 66726f6d2f63 0007 32", "62 02 0007") == wire(
        "50 02 0007 70 02 0007"
    )
    assert [message.payload for message in watcher.drain()] == [b"2"]


@statement("3.1.1", "MQTT-3.1.2-6")
def test_the_state_of_a_clean_session_is_not_used_again(broker: Broker) -> None:
    client = joined(broker, "c")
    client.subscribe("a", 1)
    publisher = joined(broker, "publisher")
    publisher.publish("a", b"in flight", 1)
    client.lose()
    publisher.publish("a", b"missed", 1)
    client = Client(broker)
    assert client.log_in(connect("c", flags=0)) == ACCEPTED
    publisher.publish("a", b"no subscription", 1)
    assert client.hear() == b""


@statement("3.1.1", "MQTT-3.1.2-7")
@pytest.mark.parametrize("clean", [True, False])
def test_retained_messages_outlive_the_session(broker: Broker, clean: bool) -> None:
    client = joined(broker, "c", clean=clean)
    client.publish("a", b"kept", 1, retain=True)
    client.disconnect()
    joined(broker, "c").disconnect()
    assert broker.sessions == {}
    reader = joined(broker, "reader")
    assert reader.say("82 06 0001 0001 61 00") == wire("90 03 0001 00 31 07 0001 61 6b657074")


# --- the will


def watching(broker: Broker) -> Client:
    watcher = joined(broker, "watcher")
    assert watcher.subscribe("w", 2) == 2
    return watcher


def will(qos: int, retain: bool) -> bytes:
    """CONNECT of `c` with a will."""
    flags = CLEAN_SESSION | WILL | qos << 3 | (WILL_RETAIN if retain else 0)
    return connect("c", "w", "gone", flags=flags)


@statement("3.1.1", "MQTT-3.1.2-8", "MQTT-3.1.2-9", "MQTT-3.1.2-14")
@pytest.mark.parametrize("qos", [0, 1, 2])
@pytest.mark.parametrize(
    "retain",
    [
        pytest.param(False, marks=statement("3.1.1", "MQTT-3.1.2-16")),
        pytest.param(True, marks=statement("3.1.1", "MQTT-3.1.2-17")),
    ],
)
def test_the_will_is_published_as_connect_says(broker: Broker, qos: int, retain: bool) -> None:
    watcher, client = watching(broker), Client(broker)
    assert client.log_in(will(qos, retain)) == ACCEPTED
    assert watcher.hear() == b""
    client.lose()
    packet_id = b"\0\1" if qos else b""
    assert watcher.hear() == packet(0x30 | qos << 1, field("w"), packet_id, b"gone")
    later = joined(broker, "later")
    later.subscribe("w", 2)
    kept = packet(0x31 | qos << 1, field("w"), packet_id, b"gone")
    assert later.hear() == (kept if retain else b"")


@statement("3.1.1", "MQTT-3.1.2-8")
@pytest.mark.parametrize("end", ["error", "keep alive", "taken over"])
def test_the_will_is_published_however_the_connection_ends(broker: Broker, end: str) -> None:
    watcher = watching(broker)
    client = joined(broker, "c", will=Will("w", b"gone"), keep_alive=10)
    if end == "error":
        client.say("36 06 0001 61 0001 78")
    elif end == "keep alive":
        broker.tick(broker.now + 16)
    else:
        joined(broker, "c")
    assert watcher.hear() == wire("30 07 0001 77 676f6e65")


@statement("3.1.1", "MQTT-3.1.2-10")
@pytest.mark.parametrize("then", ["expires", "is cleaned", "goes on"])
@pytest.mark.parametrize("end", ["e0 00", None], ids=["DISCONNECT", "published"])
def test_a_will_is_published_once_at_most(broker: Broker, end: str | None, then: str) -> None:
    watcher = watching(broker)
    client = joined(broker, "c", clean=False, will=Will("w", b"gone"))
    if end is not None:
        client.say(end)
    client.lose()
    assert watcher.payloads() == ([] if end else [b"gone"])
    client.lose()
    if then != "expires":
        joined(broker, "c", clean=then == "is cleaned").lose()
    broker.tick(broker.now + 2 * broker.limits.session_expiry)
    assert set(broker.sessions) == {"watcher"}
    assert watcher.payloads() == []


@statement("3.1.1", "MQTT-3.1.2-12")
def test_without_the_will_flag_there_is_no_will(broker: Broker) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("#")
    joined(broker, "c", clean=False, will=Will("w", b"first")).say("e0 00")
    joined(broker, "c", clean=False).lose()
    assert watcher.hear() == b""


@statement("3.1.1", "MQTT-3.1.2-8", "MQTT-3.1.2-12")
def test_the_will_is_that_of_the_connection(broker: Broker) -> None:
    watcher = watching(broker)
    for payload in (b"first", b"second"):
        joined(broker, "c", clean=False, will=Will("w", payload)).lose()
        assert watcher.payloads() == [payload]


@statement("3.1.1", "MQTT-3.3.5-2", "MQTT-3.1.2-8")
def test_a_will_is_published_by_who_may(broker: Broker, access: FakeAccess) -> None:
    watcher = watching(broker)
    access.deny("user", Action.PUBLISH, "w")
    joined(broker, "c", will=Will("w", b"not allowed")).lose()
    joined(broker, "d", user="other", will=Will("w", b"allowed")).lose()
    assert watcher.payloads() == [b"allowed"]


# --- keep alive


@statement("3.1.1", "MQTT-3.1.2-24")
@pytest.mark.parametrize("keep_alive", [1, 10, 65535])
def test_silence_for_one_and_a_half_keep_alive_ends_it(broker: Broker, keep_alive: int) -> None:
    watcher, client = watching(broker), Client(broker)
    flags = CLEAN_SESSION | WILL
    assert client.log_in(connect("c", "w", "gone", flags=flags, keep_alive=keep_alive)) == ACCEPTED
    for number in range(3):
        broker.tick(broker.now + 1.49 * keep_alive)
        assert not client.closed
        assert client.say("c0 00" if number else "30 04 0001 61 78") in (b"", wire("d0 00"))
    broker.tick(broker.now + 1.51 * keep_alive)
    assert client.closed and client.hear() == b""
    assert watcher.hear() == wire("30 07 0001 77 676f6e65"), "as if the network had failed"


@statement("3.1.1", "MQTT-3.1.2-24")
def test_part_of_a_packet_is_no_packet(broker: Broker) -> None:
    client = joined(broker, "c", keep_alive=10)
    for byte in (b"\x30", b"\x10", b"\0", b"\1"):
        broker.tick(broker.now + 4)
        assert client.say(byte) == b""
    assert client.closed


@statement("3.1.1", "MQTT-3.1.2-24")
def test_a_keep_alive_of_0_is_none(broker: Broker) -> None:
    client = joined(broker, "c", keep_alive=0)
    broker.tick(broker.now + 10_000_000)
    assert client.say("c0 00") == wire("d0 00")
