"""MQTT 5.0, sections 4.1, 4.3 to 4.6 and 4.9: sessions, QoS, order, flow control."""

from __future__ import annotations

import pytest
from broker.conftest import FakeAccess, lasting
from client_v5 import (
    ACCEPTED,
    SESSION_PRESENT,
    Client,
    connect,
    joined,
    owed,
    packet,
    properties,
    publish,
    wire,
)

from appliance.broker.broker import Broker
from appliance.broker.limits import Limits
from appliance.broker.values import Action
from appliance.mqtt.codec import Property

P = Property
statement = pytest.mark.statement

#: Session Expiry Interval 100 s.
KEPT = properties("11 00000064")
KEEP = {P.SESSION_EXPIRY_INTERVAL: 100}


def again(broker: Broker, client_id: str = "client", **options: object) -> Client:
    """The client is back: a new connection to its session; what it hears is not heard yet."""
    client = Client(broker)
    answer = client.connect(client_id, **{**lasting(5, 100), **options})
    assert answer.session_present and answer.reason_code == 0
    return client


def acknowledgement(first: int, packet_id: int) -> bytes:
    return bytes((first, 2)) + packet_id.to_bytes(2, "big")


# --- 4.1 session state


@statement("5.0", "MQTT-4.1.0-1")
@pytest.mark.parametrize("interval", [0, 1, 100])
def test_the_session_lasts_as_long_as_its_connection(broker: Broker, interval: int) -> None:
    client = joined(broker, **lasting(5, interval))
    client.subscribe("a", 2)
    watcher, sender = joined(broker, "watcher"), joined(broker, "sender")
    watcher.subscribe("b")
    sender.publish("a", b"1", 2)
    assert client.hear() == publish("a", b"1", 2, 1)
    assert client.say(publish("b", b"x", 2, 9)) == wire("50 02 0009")
    broker.tick(broker.now + 1_000_000)
    assert client.say("50 02 0001") == wire("62 02 0001")
    assert client.say("62 02 0009") == wire("70 02 0009")
    assert watcher.hear() == publish("b", b"x")
    sender.publish("a", b"2", 1)
    assert client.hear() == publish("a", b"2", 1, 2)


@statement("5.0", "MQTT-4.1.0-2")
@pytest.mark.parametrize("interval", [0, 1, 100])
def test_a_session_is_discarded_with_all_that_is_in_it(broker: Broker, interval: int) -> None:
    client = joined(broker, **lasting(5, interval))
    client.subscribe("a", 2)
    sender = joined(broker, "sender")
    sender.publish("a", b"1", 1)
    assert client.say(publish("b", b"x", 2, 9)) == publish("a", b"1", 1) + wire("50 02 0009")
    client.lose()
    broker.tick(broker.now + interval)
    assert set(broker.sessions) == {"sender"}
    assert sender.publish("a", b"2", 1) == 0x10
    client = Client(broker)
    assert client.log_in(connect("client", flags=0)) == ACCEPTED
    assert client.say("62 02 0009") in (wire("70 03 0009 92"), wire("70 02 0009"))
    sender.publish("a", b"3", 1)
    assert client.hear() == b""


# --- 4.3.1 QoS 0


@statement("5.0", "MQTT-4.3.1-1")
def test_qos_0(broker: Broker) -> None:
    client = joined(broker, **lasting(5))
    client.subscribe("a", 2)
    assert joined(broker, "sender").say(publish("a", b"x")) == b""
    assert client.hear() == publish("a", b"x")
    client.lose()
    assert again(broker).hear() == b""


# --- 4.3.2 QoS 1


@statement("5.0", "MQTT-4.3.2-1", "MQTT-4.3.2-2", "MQTT-2.2.1-4")
def test_qos_1_is_sent_with_a_new_identifier_and_without_dup(broker: Broker) -> None:
    client, sender = joined(broker), joined(broker, "sender")
    client.subscribe("a", 1)
    for n in range(1, 6):
        sender.say(publish("a", b"x", 1, 7, dup=n > 1))
        assert client.hear() == publish("a", b"x", 1, n)
    client.say("40 02 0002", "40 02 0004")
    sender.publish("a", b"x", 1)
    (message,) = client.messages()
    assert message.packet_id not in (0, 1, 3, 5) and not message.dup


@statement("5.0", "MQTT-4.3.2-3", "MQTT-4.4.0-1", "MQTT-3.3.1-1")
@pytest.mark.parametrize("late", ["50 02 0001", "70 02 0001", "40 02 0002", "62 02 0001"])
def test_qos_1_is_unacknowledged_until_puback(broker: Broker, late: str) -> None:
    client = joined(broker, **lasting(5, 100))
    client.subscribe("a", 1)
    joined(broker, "sender").publish("a", b"x", 1)
    assert client.hear() == publish("a", b"x", 1, 1)
    client.say(late)  # which does not acknowledge it
    for _ in range(2):
        client.lose()
        client = again(broker)
        assert client.hear() == publish("a", b"x", 1, 1, dup=True)
    assert client.say("40 02 0001") == b""
    client.lose()
    assert again(broker).hear() == b""


@statement("5.0", "MQTT-4.3.2-4", "MQTT-4.5.0-1")
def test_the_server_is_responsible_for_qos_1_from_puback_on(broker: Broker) -> None:
    absent = joined(broker, "absent", **lasting(5, 100))
    absent.subscribe("a", 1)
    absent.lose()
    sender = joined(broker, "sender")
    assert sender.say(publish("a", b"x", 1, 7)) == wire("40 02 0007")
    sender.lose()
    assert again(broker, "absent").hear() == publish("a", b"x", 1, 1)


@pytest.mark.parametrize(
    ("qos", "answer"),
    [
        pytest.param(1, "40 02 0007", marks=statement("5.0", "MQTT-4.3.2-5")),
        pytest.param(2, "50 02 0007", marks=statement("5.0", "MQTT-4.3.3-12")),
    ],
)
@pytest.mark.parametrize("dup", [False, True])
def test_after_the_last_answer_the_same_identifier_is_a_new_message(
    broker: Broker, qos: int, answer: str, dup: bool
) -> None:
    watcher, sender = joined(broker, "watcher"), joined(broker, "sender")
    watcher.subscribe("a")
    for n in range(3):
        payload = b"%d" % n
        assert sender.say(publish("a", payload, qos, 7, dup=dup)) == wire(answer)
        if qos == 2:
            assert sender.say("62 02 0007") == wire("70 02 0007")
        assert watcher.hear() == publish("a", payload)


# --- 4.3.3 QoS 2, from the server


@statement("5.0", "MQTT-4.3.3-1", "MQTT-4.3.3-2", "MQTT-4.3.3-4")
def test_qos_2_is_sent_with_a_new_identifier_and_without_dup(broker: Broker) -> None:
    client, sender = joined(broker), joined(broker, "sender")
    client.subscribe("a", 2)
    for n in range(1, 6):
        sender.say(publish("a", b"x", 2, 7), "62 02 0007")
        assert client.hear() == publish("a", b"x", 2, n)
    assert client.say("50 02 0003") == wire("62 02 0003")
    assert client.say("50 02 0005") == wire("62 02 0005")
    sender.publish("a", b"x", 2)
    (message,) = client.messages()
    assert message.packet_id not in range(6) and not message.dup


@statement("5.0", "MQTT-4.3.3-3", "MQTT-4.3.3-5", "MQTT-4.3.3-6", "MQTT-4.4.0-1")
def test_every_state_of_qos_2_goes_on_after_a_new_connection(broker: Broker) -> None:
    client = joined(broker, **lasting(5, 100))
    client.subscribe("a", 2)
    joined(broker, "sender").publish("a", b"x", 2)
    assert client.hear() == publish("a", b"x", 2, 1)
    for _ in range(2):
        client.lose()
        client = again(broker)
        assert client.hear() == publish("a", b"x", 2, 1, dup=True)
    assert client.say("50 02 0001") == wire("62 02 0001")
    for _ in range(2):
        client.lose()
        client = again(broker)
        assert client.hear() == wire("62 02 0001"), "and no PUBLISH any more"
    assert client.say("70 02 0001") == b""
    client.lose()
    assert again(broker).hear() == b""


@statement("5.0", "MQTT-4.3.3-6")
def test_pubrec_again_is_answered_with_pubrel_again(broker: Broker) -> None:
    client = joined(broker, **lasting(5, 100))
    client.subscribe("a", 2)
    joined(broker, "sender").publish("a", b"x", 2)
    client.hear()
    for _ in range(3):
        assert client.say("50 02 0001") == wire("62 02 0001")
    client.lose()
    client = again(broker)
    assert client.hear() == wire("62 02 0001")
    assert client.say("50 02 0001") == wire("62 02 0001")


@statement("5.0", "MQTT-4.3.3-7", "MQTT-4.3.3-3")
@pytest.mark.parametrize("qos", [1, 2])
def test_what_was_sent_does_not_expire(broker: Broker, qos: int) -> None:
    client = joined(broker, **lasting(5, 100))
    client.subscribe("a", 2)
    expires = properties("02 0000000a")  # 10 s
    joined(broker, "sender").say(publish("a", b"x", qos, 7, props=expires), "62 02 0007")
    assert client.hear() == publish("a", b"x", qos, 1, props=expires)
    client.lose()
    broker.tick(broker.now + 50)
    client = again(broker)
    (message,) = client.messages()
    assert (message.payload, message.packet_id, message.dup) == (b"x", 1, True)
    if qos == 2:
        assert client.say("50 02 0001") == wire("62 02 0001")
        broker.tick(broker.now + 50)
        assert client.say("70 02 0001") == b""


# --- 4.3.3 QoS 2, to the server


@statement("5.0", "MQTT-4.3.3-8", "MQTT-4.3.3-11", "MQTT-4.5.0-1")
def test_the_server_is_responsible_for_qos_2_from_pubrec_on(broker: Broker) -> None:
    absent = joined(broker, "absent", **lasting(5, 100))
    absent.subscribe("a", 2)
    absent.lose()
    sender = joined(broker, "sender", **lasting(5, 100))
    assert sender.say(publish("a", b"x", 2, 7)) == wire("50 02 0007")
    sender.lose()
    sender = again(broker, "sender")
    assert sender.say("62 02 0007") == wire("70 02 0007")
    sender.lose()
    assert again(broker, "absent").hear() == publish("a", b"x", 2, 1)


@statement("5.0", "MQTT-4.3.3-9")
def test_after_a_pubrec_with_an_error_the_same_identifier_is_a_new_message(
    broker: Broker, access: FakeAccess
) -> None:
    access.deny("user", Action.PUBLISH, "no/#")
    watcher, sender = joined(broker, "watcher"), joined(broker, "sender")
    watcher.subscribe("#")
    for _ in range(2):
        assert sender.say(publish("no/a", b"1", 2, 7)) == wire("50 03 0007 87")
    assert sender.say(publish("a", b"2", 2, 7)) == wire("50 02 0007")
    assert sender.say("62 02 0007") == wire("70 02 0007")
    assert watcher.hear() == publish("a", b"2")


@statement("5.0", "MQTT-4.3.3-10")
@pytest.mark.parametrize("dup", [False, True])
@pytest.mark.parametrize("reconnect", [False, True])
def test_until_pubrel_the_same_identifier_is_the_same_message(
    broker: Broker, dup: bool, reconnect: bool
) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("a", 2)
    sender = joined(broker, "sender", **lasting(5, 100))
    assert sender.say(publish("a", b"x", 2, 7)) == wire("50 02 0007")
    for _ in range(3):
        if reconnect:
            sender.lose()
            sender = again(broker, "sender")
        assert sender.say(publish("a", b"x", 2, 7, dup=dup)) == wire("50 02 0007")
    assert sender.say("62 02 0007") == wire("70 02 0007")
    assert watcher.hear() == publish("a", b"x", 2, 1)


@statement("5.0", "MQTT-4.3.3-11", "MQTT-4.3.3-10")
def test_pubrel_again_is_answered_with_pubcomp_again(broker: Broker) -> None:
    watcher = joined(broker, "watcher")
    watcher.subscribe("a")
    sender = joined(broker, "sender", **lasting(5, 100))
    sender.say(publish("a", b"x", 2, 7))
    assert sender.say("62 02 0007") == wire("70 02 0007")
    sender.lose()
    sender = again(broker, "sender")
    assert sender.say("62 02 0007") in (wire("70 02 0007"), wire("70 03 0007 92"))
    assert watcher.hear() == publish("a", b"x")


@statement("5.0", "MQTT-4.3.3-13")
def test_an_expired_message_of_qos_2_is_brought_to_its_end(broker: Broker) -> None:
    absent = joined(broker, "absent", **lasting(5, 1000))
    absent.subscribe("a", 2)
    absent.lose()
    sender = joined(broker, "sender")
    data = publish("a", b"x", 2, 7, props=properties("02 0000000a"))
    assert sender.say(data) == wire("50 02 0007")
    broker.tick(broker.now + 50)
    assert sender.say(data) == wire("50 02 0007")
    assert sender.say("62 02 0007") == wire("70 02 0007")
    assert again(broker, "absent").hear() == b""


# --- 4.4 sending again


@statement("5.0", "MQTT-4.4.0-1", "MQTT-4.6.0-6", "MQTT-3.3.1-1")
def test_what_is_unacknowledged_is_sent_again_in_its_order(broker: Broker) -> None:
    client, sender = joined(broker, **lasting(5, 100)), joined(broker, "sender")
    client.subscribe("#", 2)
    for n in range(1, 9):
        sender.publish(f"a/{n % 2}", b"%d" % n, 1 + n // 2 % 2)
    first = client.messages()
    assert [message.packet_id for message in first] == list(range(1, 9))
    for message in first[3:5]:
        client.acknowledge(message)
    client.lose()
    sender.publish("a/0", b"new", 1)
    client = again(broker)
    *resent, new = client.messages()
    left = first[:3] + first[5:]
    expected = [(one.topic, one.payload, one.qos, one.packet_id, True) for one in left]
    assert expected == [(one.topic, one.payload, one.qos, one.packet_id, one.dup) for one in resent]
    assert (new.payload, new.dup) == (b"new", False) and new.packet_id not in range(9)


@statement("5.0", "MQTT-4.4.0-1")
@pytest.mark.parametrize("qos", [1, 2])
def test_nothing_is_sent_again_at_any_other_time(broker: Broker, qos: int) -> None:
    client = joined(broker, **lasting(5, 1000))
    client.subscribe("a", 2)
    joined(broker, "sender").publish("a", b"x", qos)
    assert client.hear() == publish("a", b"x", qos, 1)
    for seconds in (1, 20, 60, 3600, 86400):
        broker.tick(broker.now + seconds)
        assert client.say("c0 00") == wire("d0 00")
    if qos == 2:
        client.say("50 02 0001")
        for seconds in (1, 20, 60, 3600, 86400):
            broker.tick(broker.now + seconds)
            assert client.say("c0 00") == wire("d0 00")


@statement("5.0", "MQTT-4.4.0-1", "MQTT-3.1.2-4")
def test_nothing_is_sent_again_to_a_new_session(broker: Broker) -> None:
    client = joined(broker, **lasting(5, 100))
    client.subscribe("a", 2)
    sender = joined(broker, "sender")
    sender.publish("a", b"1", 1)
    sender.publish("a", b"2", 2)
    client.lose()
    assert Client(broker).log_in(connect("client", props=KEPT)) == ACCEPTED
    assert Client(broker).log_in(connect("client", flags=0, props=KEPT)) == SESSION_PRESENT


@statement("5.0", "MQTT-4.4.0-2")
@pytest.mark.parametrize("code", ["80", "83", "87", "90", "91", "97", "99"])
@pytest.mark.parametrize(("qos", "first"), [(1, "40"), (2, "50")])
def test_an_error_is_an_acknowledgement(broker: Broker, qos: int, first: str, code: str) -> None:
    client = joined(broker, clean=False, properties={P.RECEIVE_MAXIMUM: 1, **KEEP})
    client.subscribe("a", 2)
    sender = joined(broker, "sender")
    sender.publish("a", b"1", qos)
    sender.publish("a", b"2", qos)
    assert client.hear() == publish("a", b"1", qos, 1)
    assert client.say(f"{first} 03 0001 {code}") == publish("a", b"2", qos, 2)
    client.lose()
    assert again(broker).hear() == publish("a", b"2", qos, 2, dup=True)


# --- 4.5 message receipt


@statement("5.0", "MQTT-4.5.0-1")
@pytest.mark.parametrize("qos", [1, 2])
def test_a_message_is_for_everyone_with_a_matching_subscription(broker: Broker, qos: int) -> None:
    filters = ["a/b", "a/+", "#", "+/b", "a/b/#"]
    there = [joined(broker, f"there {name}") for name in filters]
    absent = [joined(broker, f"absent {name}", **lasting(5, 100)) for name in filters]
    for client, topic_filter in zip(there + absent, filters * 2, strict=True):
        client.subscribe(topic_filter, 2)
    other = joined(broker, "other", **lasting(5, 100))
    other.subscribe("a", 2)
    for client in (*absent, other):
        client.lose()
    sender = joined(broker, "sender")
    assert sender.publish("a/b", b"x", qos) == 0
    sender.lose()
    for client in there:
        assert client.hear() == publish("a/b", b"x", qos, 1)
    for name in filters:
        assert again(broker, f"absent {name}").hear() == publish("a/b", b"x", qos, 1)
    assert again(broker, "other").hear() == b""


# --- 4.6 order


@statement("5.0", "MQTT-4.6.0-5", "MQTT-4.6.0-6")
@pytest.mark.parametrize("qos", [0, 1, 2])
@pytest.mark.parametrize("maximum", [1, 3, 65535])
def test_messages_of_a_topic_keep_their_order(broker: Broker, qos: int, maximum: int) -> None:
    client = joined(broker, properties={P.RECEIVE_MAXIMUM: maximum})
    client.subscribe("#", 2)
    one, two = joined(broker, "one"), joined(broker, "two")
    for n in range(60):
        one.publish("a", b"one %d" % n, qos)
        two.publish("a", b"two %d" % n, qos)
        one.publish("b", b"one %d" % n, qos)
    heard = [(message.topic, message.payload) for message in client.drain()]
    for topic, name in (("a", "one"), ("a", "two"), ("b", "one")):
        of_one = [p for t, p in heard if t == topic and p.startswith(name.encode())]
        assert of_one == [b"%s %d" % (name.encode(), n) for n in range(60)]


@statement("5.0", "MQTT-4.6.0-5", "MQTT-4.6.0-6", "MQTT-4.4.0-1")
@pytest.mark.parametrize("qos", [1, 2])
def test_the_order_holds_through_new_connections(broker: Broker, qos: int) -> None:
    few: dict[str, object] = {"properties": {P.RECEIVE_MAXIMUM: 4, **KEEP}}
    client = joined(broker, clean=False, **few)
    client.subscribe("a", 2)
    sender = joined(broker, "sender")
    seen: list[bytes] = []
    sent = 0
    for taken in (1, 2, 0, 4, 3, 1):
        for _ in range(5):
            sender.publish("a", b"%d" % sent, qos)
            sent += 1
        messages = client.messages()
        seen += [message.payload for message in messages]
        client.acknowledge(*messages[:taken])
        client.lose()
        client = again(broker, **few)
    seen += [message.payload for message in client.drain()]
    # "The final copy of each message will be in the order that they were published."
    final = sorted(set(seen), key=lambda payload: len(seen) - seen[::-1].index(payload))
    assert final == [b"%d" % n for n in range(sent)]
    firsts = sorted(set(seen), key=seen.index)
    assert firsts == [b"%d" % n for n in range(sent)]


@statement("5.0", "MQTT-4.6.0-5")
@pytest.mark.parametrize("qos", [1, 2])
def test_the_server_acknowledges_in_the_order_in_which_messages_came(
    broker: Broker, qos: int
) -> None:
    """What section 4.6 asks of a client; and the messages go on in this order, too."""
    watcher, sender = joined(broker, "watcher"), joined(broker, "sender")
    watcher.subscribe("a")
    ids = [9, 3, 7, 1, 65535, 2]
    heard = sender.say(*[publish("a", b"%d" % n, qos, n) for n in ids])
    assert heard == b"".join(acknowledgement(0x40 if qos == 1 else 0x50, n) for n in ids)
    if qos == 2:
        released = [acknowledgement(0x62, n) for n in ids]
        assert sender.say(*released) == b"".join(acknowledgement(0x70, n) for n in ids)
    assert watcher.hear() == b"".join(publish("a", b"%d" % n) for n in ids)


@statement("5.0", "MQTT-4.6.0-5")
def test_pubrels_go_in_the_order_of_the_pubrecs(broker: Broker) -> None:
    client = owed(joined(broker), 4)
    order = (3, 1, 4, 2)
    heard = client.say(*[acknowledgement(0x50, n) for n in order])
    assert heard == b"".join(acknowledgement(0x62, n) for n in order)


# --- 4.9 flow control


@statement("5.0", "MQTT-4.9.0-1", "MQTT-3.3.4-9")
@pytest.mark.parametrize(
    ("limits", "maximum", "quota"),
    [
        (Limits(), None, 20),
        (Limits(), 5, 5),
        (Limits(), 1, 1),
        (Limits(inflight=100), 50, 50),
        (Limits(inflight=3), 50, 3),
    ],
)
def test_the_send_quota_is_within_the_receive_maximum(
    broker: Broker, maximum: int | None, quota: int
) -> None:
    client = joined(broker, properties={P.RECEIVE_MAXIMUM: maximum} if maximum else {})
    client.subscribe("a", 2)
    sender = joined(broker, "sender")
    for _ in range(quota + 5):
        sender.publish("a", b"x", 1)
    assert len(client.messages()) == quota


@statement("5.0", "MQTT-4.9.0-1", "MQTT-4.9.0-2")
def test_the_send_quota_is_a_connections(broker: Broker) -> None:
    """Section 4.9: it is no part of the session state."""
    client = joined(broker, clean=False, properties={P.RECEIVE_MAXIMUM: 2, **KEEP})
    client.subscribe("a", 2)
    sender = joined(broker, "sender")
    for n in range(8):
        sender.publish("a", b"%d" % n, 1 + n % 2)
    assert client.payloads() == [b"0", b"1"]
    client.lose()
    client = again(broker, properties={P.RECEIVE_MAXIMUM: 5, **KEEP})
    assert client.payloads() == [b"0", b"1", b"2", b"3", b"4"]
    client.lose()
    client = again(broker, properties={P.RECEIVE_MAXIMUM: 1, **KEEP})
    assert client.payloads() == [b"0"]
    assert client.say("40 02 0001") == publish("a", b"1", 2, 2, dup=True)


@statement("5.0", "MQTT-4.9.0-2", "MQTT-3.3.4-9")
def test_the_quota_does_not_grow_above_its_beginning(broker: Broker) -> None:
    client = joined(broker, properties={P.RECEIVE_MAXIMUM: 2})
    client.subscribe("a", 2)
    for packet_id in range(1, 10):  # acknowledgements of nothing
        client.say(acknowledgement(0x40, packet_id), acknowledgement(0x70, packet_id))
        client.say(packet(0x50, packet_id.to_bytes(2, "big"), b"\x80"))
    sender = joined(broker, "sender")
    for n in range(5):
        sender.publish("a", b"%d" % n, 1)
    assert client.payloads() == [b"0", b"1"]


@statement("5.0", "MQTT-4.9.0-3", "MQTT-3.3.4-10")
def test_with_the_quota_used_up_all_else_goes_on(broker: Broker) -> None:
    client = joined(broker, properties={P.RECEIVE_MAXIMUM: 1})
    client.subscribe("a", 1)
    sender = joined(broker, "sender")
    sender.publish("a", b"1", 1)
    sender.publish("a", b"2", 1)
    assert client.hear() == publish("a", b"1", 1, 1)
    assert client.say("c0 00") == wire("d0 00")
    assert client.say("82 07 0002 00 0001 62 02") == wire("90 04 0002 00 02")
    assert client.say(publish("c", b"x", 1, 3)) == wire("40 03 0003 10")
    assert client.say(publish("c", b"x", 2, 4)) == wire("50 02 0004")
    assert client.say("62 02 0004") == wire("70 02 0004")
    assert client.say("a2 06 0005 00 0001 62") == wire("b0 04 0005 00 00")
    assert client.say("40 02 0001") == publish("a", b"2", 1, 2)
