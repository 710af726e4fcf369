"""MQTT 5.0, sections 3.15 and 4.12: AUTH and enhanced authentication."""

from __future__ import annotations

import pytest
from broker.conftest import lasting
from client_v5 import (
    ACCEPTED,
    CLEAN_START,
    WILL,
    Client,
    Wire,
    connack,
    connect,
    disconnect,
    field,
    is_closed,
    joined,
    packet,
    properties,
    publish,
    wire,
)

from appliance.broker.broker import Broker
from appliance.broker.limits import Features
from appliance.broker.values import Accepted, Refusal
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Auth, Connack
from appliance.mqtt.reason import ReasonCode

P = Property
statement = pytest.mark.statement

#: Properties: an authentication method, and data.
METHOD = b"\x15" + field("M")
OTHER = b"\x15" + field("m")
DATA = b"\x16" + field("data")

CONTINUE = ReasonCode.CONTINUE_AUTHENTICATION
BAD = Refusal(ReasonCode.NOT_AUTHORIZED, "the proof is wrong")

Answer = bytes | Accepted | Refusal


class Scripted:
    """An exchange that knows its answers, and remembers what it was told."""

    def __init__(self, *answers: Answer) -> None:
        self.answers = list(answers)
        self.told: list[bytes] = []

    def step(self, data: bytes) -> Answer:
        self.told.append(data)
        return self.answers.pop(0)


def auth(code: int, *items: Wire) -> bytes:
    return packet(0xF0, bytes((code,)), properties(*items))


def beginning(broker: Broker, *answers: Answer, **options: object) -> tuple[Client, Scripted]:
    """A client that has sent CONNECT with the method and data; what it was told is not heard."""
    client, exchange = Client(broker), Scripted(*answers)
    client.transport.exchanges["M"] = exchange
    client.send(connect("c", **{"props": properties(METHOD, DATA), **options}))  # type: ignore[arg-type]
    assert client.transport.asked is None, "it is not by its password that it comes in"
    return client, exchange


def authenticated(broker: Broker, *later: Answer) -> tuple[Client, Scripted]:
    """A client that is in, and the exchange for the next time that it authenticates itself."""
    client, _ = beginning(broker, Accepted("user", b""))
    assert client.hear()[:4] == wire("20 0d 00 00")
    again = Scripted(*later)
    client.transport.exchanges["M"] = again
    return client, again


# --- 4.12 from CONNECT to CONNACK


@statement("5.0", "MQTT-4.12.0-2", "MQTT-4.12.0-5", "MQTT-3.15.2-1", "MQTT-3.2.0-1", "MQTT-3.1.4-5")
def test_an_exchange_of_several_steps(broker: Broker) -> None:
    client, exchange = beginning(broker, b"one", b"two", Accepted("user", b"well"))
    asked = {P.AUTHENTICATION_METHOD: "M"}
    assert client.received() == [Auth(CONTINUE, {**asked, P.AUTHENTICATION_DATA: b"one"})]
    assert broker.sessions == {}
    client.send(auth(0x18, METHOD, "16 0001 31"))
    assert client.received() == [Auth(CONTINUE, {**asked, P.AUTHENTICATION_DATA: b"two"})]
    client.send(auth(0x18, METHOD, "16 0001 32"))
    (answer,) = client.received()
    assert isinstance(answer, Connack) and answer.properties is not None
    assert (answer.session_present, answer.reason_code) == (False, 0)
    assert answer.properties[P.AUTHENTICATION_METHOD] == "M"
    assert answer.properties[P.AUTHENTICATION_DATA] == b"well"
    assert exchange.told == [b"data", b"1", b"2"]
    assert client.say("c0 00") == wire("d0 00")
    identity = client.session.identity
    assert identity is not None and identity.username == "user"


@statement("5.0", "MQTT-4.12.0-2", "MQTT-4.12.0-5")
def test_data_may_be_missing_on_both_sides(broker: Broker) -> None:
    client, exchange = beginning(broker, b"", Accepted("user", b""), props=properties(METHOD))
    assert client.hear() == auth(0x18, METHOD)
    client.send(auth(0x18, METHOD))
    (answer,) = client.received()
    assert isinstance(answer, Connack) and answer.properties is not None
    assert answer.properties[P.AUTHENTICATION_METHOD] == "M"
    assert P.AUTHENTICATION_DATA not in answer.properties
    assert exchange.told == [b"", b""]


@statement("5.0", "MQTT-3.1.2-5", "MQTT-4.12.0-5")
def test_a_session_goes_on_after_an_exchange(broker: Broker) -> None:
    client = joined(broker, "c", **lasting(5))
    client.subscribe("a", 1)
    client.lose()
    joined(broker, "sender").publish("a", b"x", 1)
    client, _ = beginning(broker, Accepted("user", b""), flags=0)
    heard = client.hear()
    assert heard[0] == 0x20 and heard[2:4] == b"\1\0"
    assert heard.endswith(publish("a", b"x", 1))


@statement("5.0", "MQTT-4.12.0-1", "MQTT-3.2.2-8", "MQTT-3.14.0-1")
@pytest.mark.parametrize("method", [OTHER, b"\x15" + field("GS2-KRB5"), b"\x15\0\0"])
def test_a_method_that_is_not_offered(broker: Broker, method: bytes) -> None:
    client, exchange = beginning(broker, b"one", props=properties(method, DATA))
    assert client.hear() in (connack(0x8C), connack(0x87)) and client.closed
    assert exchange.told == [] and broker.sessions == {}


@statement("5.0", "MQTT-4.12.0-4", "MQTT-3.2.2-6", "MQTT-3.2.2-7", "MQTT-3.14.0-1", "MQTT-3.1.4-2")
@pytest.mark.parametrize("steps", [0, 1, 3])
def test_a_refusal_at_any_step(broker: Broker, steps: int) -> None:
    client, _ = beginning(broker, *[b"more"] * steps, BAD)
    for _ in range(steps):
        assert client.hear()[0] == 0xF0
        client.send(auth(0x18, METHOD, DATA))
    assert client.hear() == connack(0x87) and client.closed
    assert broker.sessions == {}


@statement("5.0", "MQTT-3.1.4-6")
def test_what_comes_behind_a_refused_exchange_has_no_effect(broker: Broker) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("#")
    client = Client(broker)
    client.transport.exchanges["M"] = Scripted(BAD)
    heard = client.say(
        connect("c", b"\0", "w", "gone", flags=CLEAN_START | WILL, props=properties(METHOD)),
        publish("a", b"x"),
    )
    assert heard == connack(0x87) and client.closed
    assert watcher.hear() == b""


@statement("5.0", "MQTT-3.1.2-30", "MQTT-3.14.0-1", "MQTT-4.13.1-1")
@pytest.mark.parametrize(
    "data",
    [
        publish("a", b"x"),
        publish("a", b"x", 1),
        "82 07 0001 00 0001 61 00",
        "a2 06 0001 00 0001 61",
        "c0 00",
        "40 02 0001",
        connect("c"),
        "20 03 00 00 00",
    ],
    ids=["QoS 0", "QoS 1", "SUBSCRIBE", "UNSUBSCRIBE", "PINGREQ", "PUBACK", "CONNECT", "CONNACK"],
)
def test_nothing_but_auth_may_come_before_connack(broker: Broker, data: Wire) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("#")
    client, exchange = beginning(broker, b"one", Accepted("user", b""))
    client.hear()
    assert client.say(data, auth(0x18, METHOD, DATA)) in (b"", connack(0x82))
    assert client.closed and exchange.told == [b"data"]
    assert watcher.hear() == b"" and set(broker.sessions) == {"watcher"}


@statement("5.0", "MQTT-3.1.2-30", "MQTT-3.14.4-1", "MQTT-3.14.0-1")
@pytest.mark.parametrize("goodbye", ["e0 00", "e0 01 80", "e0 02 82 00"])
def test_a_client_may_give_up_in_between(broker: Broker, goodbye: str) -> None:
    client, exchange = beginning(broker, b"one", Accepted("user", b""))
    client.hear()
    assert client.say(goodbye, auth(0x18, METHOD, DATA)) == b"" and client.closed
    assert exchange.told == [b"data"] and broker.sessions == {}


@statement("5.0", "MQTT-4.12.0-3", "MQTT-4.12.0-5", "MQTT-3.15.2-1", "MQTT-3.15.1-1")
@pytest.mark.parametrize(
    "wrong",
    [
        auth(0x00, METHOD, DATA),
        auth(0x19, METHOD, DATA),
        auth(0x01, METHOD, DATA),
        auth(0x80, METHOD, DATA),
        auth(0x18, OTHER, DATA),
        auth(0x18, DATA),
        auth(0x18),
        wire("f0 00"),
        wire("f0 01 18"),
        auth(0x18, METHOD, METHOD),
        auth(0x18, METHOD, DATA, DATA),
        auth(0x18, METHOD, "21 0005"),
        b"\xf1" + auth(0x18, METHOD, DATA)[1:],
    ],
    ids=[
        "0x00",
        "0x19",
        "no such code",
        "an error",
        "another method",
        "no method",
        "no properties",
        "empty",
        "code alone",
        "two methods",
        "two data",
        "a property of CONNECT",
        "reserved flags",
    ],
)
def test_an_auth_that_is_no_answer_ends_it(broker: Broker, wrong: bytes) -> None:
    client, exchange = beginning(broker, b"one", Accepted("user", b""))
    client.hear()
    heard = client.say(wrong)
    assert heard == b"" or (heard == connack(heard[3]) and heard[3] >= 0x80)
    assert client.closed and exchange.told == [b"data"] and broker.sessions == {}


# --- 4.12 without a method


@statement("5.0", "MQTT-4.12.0-6")
def test_without_a_method_there_is_no_auth_and_no_method(broker: Broker) -> None:
    client = Client(broker)
    client.transport.exchanges["M"] = Scripted(b"one")
    assert client.log_in(connect("c")) == ACCEPTED
    assert client.transport.asked is not None


@statement("5.0", "MQTT-4.12.0-7", "MQTT-4.13.1-1")
@pytest.mark.parametrize("code", [0x00, 0x18, 0x19])
def test_auth_without_a_method_in_connect_breaks_the_protocol(broker: Broker, code: int) -> None:
    client = joined(broker)
    assert client.say(auth(code, METHOD, DATA)) == disconnect(0x82) and client.closed


@statement("5.0", "MQTT-4.12.0-7", "MQTT-3.1.4-6")
def test_auth_before_connack_without_a_method(broker: Broker) -> None:
    client = Client(broker)
    assert client.say(connect("c"), auth(0x18, METHOD, DATA)) == b""
    client.client.refuse(ReasonCode.NOT_AUTHORIZED, "wrong password")
    broker.flush()
    assert client.hear() == connack(0x87) and client.closed


# --- 4.12.1 authenticating anew


@statement("5.0", "MQTT-4.12.1-1", "MQTT-4.12.0-2", "MQTT-4.12.0-5", "MQTT-3.15.2-1")
def test_a_client_authenticates_itself_anew(broker: Broker) -> None:
    client, exchange = authenticated(broker, b"prove it", Accepted("user", b"well"))
    client.subscribe("a")
    asked = {P.AUTHENTICATION_METHOD: "M"}
    client.send(auth(0x19, METHOD, DATA))
    assert client.received() == [Auth(CONTINUE, {**asked, P.AUTHENTICATION_DATA: b"prove it"})]
    # "The flow of other packets can continue using the previous authentication."
    joined(broker, "sender").publish("a", b"x")
    assert client.hear() == publish("a", b"x")
    assert client.say("c0 00") == wire("d0 00")
    client.send(auth(0x18, METHOD, "16 0001 31"))
    assert client.received() == [Auth(0, {**asked, P.AUTHENTICATION_DATA: b"well"})]
    assert exchange.told == [b"data", b"1"]
    assert client.say("c0 00") == wire("d0 00")


@statement("5.0", "MQTT-4.12.1-2", "MQTT-4.13.2-1")
@pytest.mark.parametrize("steps", [0, 1])
def test_who_fails_to_authenticate_anew_is_closed(broker: Broker, steps: int) -> None:
    client, _ = authenticated(broker, *[b"more"] * steps, BAD)
    client.send(auth(0x19, METHOD, DATA))
    for _ in range(steps):
        assert client.hear()[0] == 0xF0
        client.send(auth(0x18, METHOD, DATA))
    assert client.hear() == disconnect(0x87) and client.closed


@statement("5.0", "MQTT-4.12.1-1", "MQTT-4.12.1-2")
def test_nobody_becomes_another_user(broker: Broker) -> None:
    client, _ = authenticated(broker, Accepted("another", b""))
    assert is_closed(client, 0x87, auth(0x19, METHOD, DATA))


@statement("5.0", "MQTT-4.12.1-1", "MQTT-4.12.1-2", "MQTT-4.13.1-1", "MQTT-3.15.2-1")
@pytest.mark.parametrize(
    ("wrong", "codes"),
    [
        (auth(0x19, OTHER, DATA), (0x82, 0x8C)),
        (auth(0x19, DATA), (0x82,)),
        (auth(0x18, METHOD, DATA), (0x82,)),
        (auth(0x00, METHOD, DATA), (0x82,)),
        (auth(0x01, METHOD, DATA), (0x81, 0x82)),
        (wire("f0 00"), (0x81, 0x82)),
    ],
    ids=["another method", "no method", "an answer", "success", "no such code", "empty"],
)
def test_an_auth_that_begins_nothing_ends_the_connection(
    broker: Broker, wrong: bytes, codes: tuple[int, ...]
) -> None:
    client, exchange = authenticated(broker, b"one")
    assert client.say(wrong) in map(disconnect, codes) and client.closed
    assert exchange.told == []


# --- 3.15


@statement("5.0", "MQTT-3.15.1-1", "MQTT-2.1.3-1")
@pytest.mark.parametrize("flags", range(1, 16))
def test_reserved_flags_of_auth_are_malformed(broker: Broker, flags: int) -> None:
    client, exchange = authenticated(broker, b"one")
    data = auth(0x19, METHOD, DATA)
    assert client.say(bytes((0xF0 | flags,)) + data[1:]) == disconnect(0x81) and client.closed
    assert exchange.told == []


@statement("5.0", "MQTT-3.15.2-2", "MQTT-3.15.2-3")
def test_auth_has_no_words(broker: Broker) -> None:
    """So there are none that would make it too large."""
    broker.features = Features(reason_strings=True)
    client, _ = beginning(broker, b"one", Accepted("user", b"well"))
    assert client.received() == [
        Auth(CONTINUE, {P.AUTHENTICATION_METHOD: "M", P.AUTHENTICATION_DATA: b"one"})
    ]
    client.send(auth(0x18, METHOD, DATA, "1f 0002 6f6b", "26 0001 61 0001 62"))
    (answer,) = client.received()
    assert isinstance(answer, Connack) and answer.properties is not None
    assert not {P.REASON_STRING, P.USER_PROPERTY} & set(answer.properties)
