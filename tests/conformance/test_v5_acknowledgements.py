"""MQTT 5.0, sections 3.4 to 3.7: PUBACK, PUBREC, PUBREL, PUBCOMP; and what makes answers longer."""

from __future__ import annotations

import pytest
from broker.conftest import FakeAccess, lasting
from client_v5 import disconnect, joined, properties, publish, wire

from appliance.broker.broker import Broker
from appliance.broker.limits import Features, Limits
from appliance.broker.values import Action
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Puback, Pubcomp, Pubrec, Pubrel

P = Property
statement = pytest.mark.statement

# --- reason codes that the server sends


@pytest.mark.parametrize(
    ("qos", "heard", "nobody_hears", "denied"),
    [
        pytest.param(
            *(1, "40 02 0001", "40 03 0002 10", "40 03 0003 87"),
            marks=statement("5.0", "MQTT-3.4.2-1"),
        ),
        pytest.param(
            *(2, "50 02 0001", "50 02 0002", "50 03 0003 87"),
            marks=statement("5.0", "MQTT-3.5.2-1"),
        ),
    ],
    ids=["PUBACK", "PUBREC"],
)
def test_the_answer_says_what_became_of_the_message(
    broker: Broker, access: FakeAccess, qos: int, heard: str, nobody_hears: str, denied: str
) -> None:
    access.deny("user", Action.PUBLISH, "no/#")
    joined(broker, "watcher").subscribe("a")
    client = joined(broker)
    assert client.say(publish("a", b"x", qos, 1)) == wire(heard)
    assert client.say(publish("b", b"x", qos, 2)) == wire(nobody_hears)
    assert client.say(publish("no/a", b"x", qos, 3)) == wire(denied)


@statement("5.0", "MQTT-3.4.2-1", "MQTT-3.5.2-1")
@pytest.mark.parametrize("limits", [Limits(queue_messages=1, inflight=1)])
@pytest.mark.parametrize(("qos", "answer"), [(1, "40 03 0009 97"), (2, "50 03 0009 97")])
def test_a_message_that_there_is_no_room_for_is_refused(
    broker: Broker, qos: int, answer: str
) -> None:
    client = joined(broker, "busy")
    client.subscribe("a", 2)
    sender = joined(broker, "sender")
    for _ in range(2):
        assert sender.publish("a", b"x", 2) == 0
    assert sender.say(publish("a", b"x", qos, 9)) == b""  # it waits: the reader may make room
    sender.wait()
    assert sender.say() == wire(answer)


@statement("5.0", "MQTT-3.6.2-1")
def test_pubrel_of_a_message_that_is_under_way_and_of_one_that_is_not(broker: Broker) -> None:
    client = joined(broker)
    client.subscribe("a", 2)
    joined(broker, "sender").publish("a", b"x", 2)
    assert client.hear() == publish("a", b"x", 2, 1)
    assert client.say("50 02 0001") == wire("62 02 0001")
    assert client.say("50 03 0001 10") == wire("62 02 0001")
    assert client.say("70 02 0001") == b""
    assert client.say("50 02 0001") in (wire("62 02 0001"), wire("62 03 0001 92"))


@statement("5.0", "MQTT-3.7.2-1", "MQTT-4.3.3-11")
def test_pubcomp_of_a_message_that_is_under_way_and_of_one_that_is_not(broker: Broker) -> None:
    client = joined(broker)
    client.say(publish("a", b"x", 2, 5))
    assert client.say("62 02 0005") == wire("70 02 0005")
    for pubrel in ("62 02 0005", "62 03 0005 92"):
        assert client.say(pubrel) in (wire("70 02 0005"), wire("70 03 0005 92"))


# --- reason codes that a client sends

RECEIVED = {0x00, 0x10, 0x80, 0x83, 0x87, 0x90, 0x91, 0x97, 0x99}
RELEASED = {0x00, 0x92}


@pytest.mark.parametrize(
    ("first", "codes"),
    [
        pytest.param(0x40, RECEIVED, id="PUBACK", marks=statement("5.0", "MQTT-3.4.2-1")),
        pytest.param(0x50, RECEIVED, id="PUBREC", marks=statement("5.0", "MQTT-3.5.2-1")),
        pytest.param(0x62, RELEASED, id="PUBREL", marks=statement("5.0", "MQTT-3.6.2-1")),
        pytest.param(0x70, RELEASED, id="PUBCOMP", marks=statement("5.0", "MQTT-3.7.2-1")),
    ],
)
def test_reason_codes_of_other_packets_break_the_protocol(
    broker: Broker, first: int, codes: set[int]
) -> None:
    for code in range(256):
        client = joined(broker)
        heard = client.say(bytes((first, 3, 0, 1, code)))
        assert client.closed == (code not in codes), f"0x{code:02x}"
        if client.closed:
            assert heard in (disconnect(0x81), disconnect(0x82))


@statement("5.0", "MQTT-4.3.2-3", "MQTT-4.3.3-3", "MQTT-4.3.3-5")
@pytest.mark.parametrize("form", ["short", "with a code", "with empty properties", "with words"])
def test_every_form_of_an_acknowledgement_is_one(broker: Broker, form: str) -> None:
    """Sections 3.4.2.1 to 3.7.2.1: without a reason code it is 0x00."""

    def said(kind: type[Puback | Pubrec | Pubcomp], packet_id: int) -> bytes:
        short = kind(packet_id).encode(5)
        behind = {
            "short": b"",
            "with a code": b"\0",
            "with empty properties": b"\0\0",
            "with words": b"\0" + properties("1f 0002 6f6b 26 0001 61 0001 62"),
        }[form]
        return bytes((short[0], len(short) - 2 + len(behind))) + short[2:] + behind

    client = joined(broker, properties={P.RECEIVE_MAXIMUM: 1})
    client.subscribe("a", 2)
    sender = joined(broker, "sender")
    for n, qos in ((b"1", 1), (b"2", 2), (b"3", 0), (b"4", 1)):
        sender.publish("a", n, qos)
    assert client.hear() == publish("a", b"1", 1, 1) + publish("a", b"3")
    assert client.say(said(Puback, 1)) == publish("a", b"2", 2, 2)
    assert client.say(said(Pubrec, 2)) == wire("62 02 0002")
    assert client.say(said(Pubcomp, 2)) == publish("a", b"4", 1, 3)


@statement("5.0", "MQTT-4.3.3-11")
@pytest.mark.parametrize(
    "pubrel",
    [
        "62 02 0005",
        "62 03 0005 00",
        "62 04 0005 00 00",
        "62 03 0005 92",
        "62 09 0005 00 05 1f 0002 6f6b",
    ],
)
def test_every_form_of_pubrel_is_one(broker: Broker, pubrel: str) -> None:
    watcher, client = joined(broker, "watcher"), joined(broker)
    watcher.subscribe("a")
    client.say(publish("a", b"x", 2, 5))
    assert client.say(pubrel) == wire("70 02 0005")
    assert watcher.hear() == publish("a", b"x")


@statement("5.0", "MQTT-4.13.1-1")
@pytest.mark.parametrize("first", ["40", "50", "62", "70"])
@pytest.mark.parametrize(
    ("behind", "code"),
    [
        ("00", 0x81),
        ("01 00", 0x81),
        ("05 0001 00 00 00", 0x81),
        ("04 0001 00 01", 0x81),
        ("04 0001 00 05", 0x81),
        ("06 0001 00 02 0100", 0x81),
        ("0a 0001 00 06 1f 0000 1f 0000", 0x82),
        ("02 0000", 0x82),
    ],
    ids=[
        "empty",
        "half an identifier",
        "a byte too many",
        "properties cut",
        "properties longer than the packet",
        "a property of PUBLISH",
        "two reason strings",
        "identifier 0",
    ],
)
def test_acknowledgements_that_are_wrong_end_the_connection(
    broker: Broker, first: str, behind: str, code: int
) -> None:
    client = joined(broker, **lasting(5))
    assert client.say(f"{first} {behind}") == disconnect(code) and client.closed


# --- reason strings that would be too long

#: What makes the server send each packet, its first byte, and the bytes of its shortest form.
WITH_WORDS = {
    "PUBACK": (publish("no/a", b"x", 1, 7), 0x40, 5, "3.4.2"),
    "PUBREC": (publish("no/a", b"x", 2, 7), 0x50, 5, "3.5.2"),
    "PUBREL": (wire("50 02 0007"), 0x62, 5, "3.6.2"),
    "PUBCOMP": (wire("62 02 0007"), 0x70, 5, "3.7.2"),
    "SUBACK": (wire("82 0a 0007 00 0004 6e6f2f23 00"), 0x90, 6, "3.9.2"),
    "UNSUBACK": (wire("a2 09 0007 00 0004 6e6f2f23"), 0xB0, 6, "3.11.2"),
    "DISCONNECT": (wire("82 03 0007 00"), 0xE0, 3, "3.14.2"),
}
#: The last number in the names of the two statements, which for most sections are 2 and 3.
_NUMBERS = {"3.9.2": (1, 2), "3.11.2": (1, 2), "3.14.2": (3, 4)}


@pytest.mark.parametrize("limits", [Limits(topic_alias=0, inflight=65535)])  # a CONNACK of 5 bytes
@pytest.mark.parametrize(
    ("said", "first", "short"),
    [
        pytest.param(
            said,
            first,
            short,
            id=kind,
            marks=statement("5.0", *[f"MQTT-{section}-{n}" for n in _NUMBERS.get(section, (2, 3))]),
        )
        for kind, (said, first, short, section) in WITH_WORDS.items()
    ],
)
def test_no_words_in_a_packet_that_would_be_too_large(
    broker: Broker, access: FakeAccess, said: bytes, first: int, short: int
) -> None:
    for action in (Action.PUBLISH, Action.SUBSCRIBE):
        access.deny("user", action, "no/#")
    plain = joined(broker).say(said)
    assert plain[0] == first and len(plain) <= short, "without words, unless they are configured"
    broker.features = Features(reason_strings=True)
    full = joined(broker).say(said)
    assert full[0] == first
    if len(full) > short:
        at = len(plain) if first not in (0x90, 0xB0) else 4
        assert full[at + 1] == P.REASON_STRING and full[at] == len(full) - len(plain) - (at != 4)
    for limit in {max(5, short), max(5, short, len(full) - 1)}:
        client = joined(broker, properties={P.MAXIMUM_PACKET_SIZE: limit})
        assert client.say(said) == (full if len(full) <= limit else plain)
    client = joined(broker, properties={P.MAXIMUM_PACKET_SIZE: max(5, len(full))})
    assert client.say(said) == full


@statement("5.0", "MQTT-3.6.1-1")
def test_the_server_sends_pubrel_with_its_flags(broker: Broker) -> None:
    client = joined(broker, **lasting(5))
    client.subscribe("a", 2)
    joined(broker, "sender").publish("a", b"x", 2)
    client.hear()
    assert client.say(Pubrec(1).encode(5)) == wire("62 02 0001") == Pubrel(1).encode(5)
    client.lose()
    assert joined(broker, **lasting(5)).hear() == wire("62 02 0001")
