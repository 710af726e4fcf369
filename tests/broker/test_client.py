"""The client handler, packet by packet: CONNECT, keep alive, QoS 1 and 2, errors, limits.

Statements of the standards are named as `[MQTT-…]`, those of 5.0 with `v5` where they differ.
"""

from __future__ import annotations

import gc
import random
import weakref
from collections import deque
from collections.abc import Iterator
from typing import Any

import pytest

from appliance.broker import client
from appliance.broker.backpressure import PATIENCE
from appliance.broker.broker import Broker
from appliance.broker.limits import Limits
from appliance.broker.message import Message
from appliance.broker.subscribing import Step, subscribe
from appliance.broker.values import Action
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import (
    Auth,
    Connack,
    Connect,
    Disconnect,
    Packet,
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
from appliance.mqtt.reason import ReasonCode

from .conftest import (
    FakeAccess,
    FakeStore,
    Join,
    Peer,
    check_accounts,
    drops,
    lasting,
    waiting_bytes,
)

P = Property


# --- CONNECT and CONNACK


def test_connack_of_3_1_1(broker: Broker):
    """[MQTT-3.2.0-1] [MQTT-3.2.2-1]"""
    peer = Peer(broker, 4)
    peer.say_connect()
    peer.let_in()
    assert bytes(peer.transport.written) == bytes.fromhex("20 02 00 00")


@pytest.mark.parametrize("limits", [Limits(packet_size=5000, inflight=7, topic_alias=3)])
def test_connack_of_5_0_tells_the_limits(broker: Broker):
    """v5 section 3.2.2.3"""
    answer = Peer(broker).connect()
    assert answer.properties is not None
    assert answer.properties[P.MAXIMUM_PACKET_SIZE] == 5000
    assert answer.properties[P.RECEIVE_MAXIMUM] == 7
    assert answer.properties[P.TOPIC_ALIAS_MAXIMUM] == 3
    assert P.SHARED_SUBSCRIPTION_AVAILABLE not in answer.properties
    assert P.SESSION_EXPIRY_INTERVAL not in answer.properties
    assert P.ASSIGNED_CLIENT_IDENTIFIER not in answer.properties


def test_a_client_without_an_id_is_given_one(broker: Broker):
    """v5 [MQTT-3.1.3-6] [MQTT-3.1.3-7] [MQTT-3.2.2-16]"""
    names = set()
    for _ in range(3):
        answer = Peer(broker).connect("")
        assert answer.properties is not None
        names.add(answer.properties[P.ASSIGNED_CLIENT_IDENTIFIER])
    assert len(names) == 3 and names == set(broker.sessions)
    assert Peer(broker, 4).connect("").reason_code == 0  # [MQTT-3.1.3-6]
    assert len(broker.sessions) == 4


def test_3_1_1_without_an_id_needs_a_clean_session(broker: Broker):
    """[MQTT-3.1.3-8] [MQTT-3.1.3-9]: 0x02, then closed"""
    peer = Peer(broker, 4)
    peer.say_connect("", clean=False)
    assert peer.received() == [Connack(False, ReasonCode.CLIENT_IDENTIFIER_NOT_VALID)]
    assert peer.transport.closed


@pytest.mark.parametrize(
    ("code", "return_code"),
    [
        (ReasonCode.BAD_USER_NAME_OR_PASSWORD, 4),
        (ReasonCode.NOT_AUTHORIZED, 5),
        (ReasonCode.SERVER_BUSY, 3),
        (ReasonCode.BANNED, 5),
    ],
)
def test_refusals(broker: Broker, version, code, return_code):
    """[MQTT-3.2.2-4] [MQTT-3.2.2-5], v5 [MQTT-3.2.2-6] [MQTT-3.2.2-7]"""
    peer = Peer(broker, version)
    peer.say_connect()
    peer.client.refuse(code, "for a reason")
    broker.flush()
    answer = bytes(peer.transport.written)
    assert answer == (
        b"\x20\x03\0" + bytes((code, 0))
        if version == 5
        else b"\x20\x02\0\5"[:3] + bytes((return_code,))
    )
    assert peer.transport.closed and broker.sessions == {}
    peer.client.accept("user")  # too late
    assert broker.sessions == {}


def test_an_unknown_version_is_told_so(broker: Broker):
    """[MQTT-3.1.2-2]: 0x01"""
    for data in ("10 0c 0004 4d515454 06 02 003c 0000", "10 0e 0006 4d5149736470 04 02 003c 0000"):
        peer = Peer(broker, 4)
        peer.send(bytes.fromhex(data))
        assert peer.received() == [Connack(False, ReasonCode.UNSUPPORTED_PROTOCOL_VERSION)]
        assert peer.transport.closed


@pytest.mark.parametrize(
    "data",
    [
        "c0 00",  # PINGREQ first [MQTT-3.1.0-1]
        "30 05 0001 61 00 00",
        "00 00",
        "10 10 0004 4d515454 05 03 0000 00 0003 616263",  # the reserved flag [MQTT-3.1.2-3]
        "10 0f 0004 4d515454 04 1a 0000 0003 616263",  # will QoS without a will
        "16 03 01",  # TLS on the plain listener
        "47 45 54 20 2f 20 48 54 54 50",  # GET / HTTP
    ],
)
def test_what_is_no_connect_is_not_answered(broker: Broker, data):
    """[MQTT-3.1.4-1], v5 [MQTT-3.1.4-1] [MQTT-4.13.1-1]; section 4.8"""
    peer = Peer(broker, 4)
    peer.send(bytes.fromhex(data))
    assert peer.received() == []
    assert peer.transport.asked is None
    if data != "16 03 01":
        assert peer.transport.closed


def test_a_second_connect_is_a_protocol_error(join: Join, version):
    """[MQTT-3.1.0-2]"""
    peer = join(version=version)
    peer.send(Connect("client", version=version))
    if version == 5:
        assert peer.farewell() == ReasonCode.PROTOCOL_ERROR
    assert peer.transport.closed


def test_packets_behind_connect_are_done_after_the_login(broker: Broker, version):
    """5.0 section 3.1.4, non-normative: a client may send them without waiting for CONNACK."""
    peer = Peer(broker, version)
    peer.send(
        Connect("client", version=version, username="user"),
        Subscribe(1, [Subscription("a")]),
        Publish("a", b"x", 1, packet_id=2),
        Pingreq(),
        bytes((0xE0,)),
    )
    assert peer.received() == []
    peer.send(bytes((0,)))
    peer.client.accept("user")
    broker.flush()
    kinds = [type(packet) for packet in peer.received()]
    assert kinds == [Connack, Suback, Publish, Puback, Pingresp]
    assert peer.transport.closed


def test_a_login_of_a_client_that_has_left_comes_to_nothing(broker: Broker):
    peer = Peer(broker)
    peer.say_connect(**lasting(5))
    peer.lose()
    peer.let_in()
    assert broker.sessions == {} and broker.clients == set()
    assert peer.received() == []


def test_enhanced_authentication_is_refused(broker: Broker):
    """v5 [MQTT-4.12.0-1]"""
    peer = Peer(broker)
    peer.say_connect(properties={P.AUTHENTICATION_METHOD: "SCRAM", P.AUTHENTICATION_DATA: b"x"})
    assert peer.received() == [Connack(False, ReasonCode.BAD_AUTHENTICATION_METHOD)]
    assert peer.transport.closed


def test_auth_without_a_method_is_a_protocol_error(join: Join):
    """v5 [MQTT-4.12.0-7]"""
    peer = join()
    peer.send(Auth(0x19, {P.AUTHENTICATION_METHOD: "SCRAM"}))
    assert peer.farewell() == ReasonCode.PROTOCOL_ERROR


# --- keep alive


def test_one_and_a_half_keep_alive_without_a_packet_ends_it(join: Join, broker: Broker, version):
    """[MQTT-3.1.2-24], v5 [MQTT-3.1.2-22]"""
    peer = join(version=version, keep_alive=10)
    broker.tick(broker.now + 15)
    peer.send(Pingreq())
    peer.only(Pingresp)  # [MQTT-3.12.4-1]
    broker.tick(broker.now + 15)
    assert not peer.transport.closed
    broker.tick(broker.now + 0.5)
    if version == 5:
        assert peer.farewell() == ReasonCode.KEEP_ALIVE_TIMEOUT
    assert peer.transport.closed and broker.sessions == {}


def test_half_a_packet_is_no_sign_of_life(join: Join, broker: Broker):
    """A packet counts when it has come, [MQTT-3.1.2-22]"""
    peer = join(keep_alive=10)
    for _ in range(4):
        broker.tick(broker.now + 4)
        peer.client.receive(b"\x30\x7f"[:1] if not peer.client.protocol.held else b"\x7f")
    assert peer.transport.closed


def test_every_packet_counts_for_the_keep_alive(join: Join, broker: Broker, version):
    peer = join(version=version, keep_alive=10)
    for packet in (
        Publish("a", b"x" * 10),
        Publish("a", b"x", 1, packet_id=1),
        Puback(5),
        Subscribe(2, [Subscription("b")]),
        Unsubscribe(3, ["b"]),
        Pubrel(4),
    ):
        broker.tick(broker.now + 14)
        peer.send(packet)
    assert not peer.transport.closed


def test_without_keep_alive_a_client_may_be_silent(join: Join, broker: Broker, version):
    """[MQTT-3.1.2-24]: zero turns it off"""
    peer = join(version=version, keep_alive=0)
    broker.tick(broker.now + 1_000_000)
    assert not peer.transport.closed


@pytest.mark.parametrize("limits", [Limits(keep_alive=60)])
@pytest.mark.parametrize(("asked", "given"), [(0, 60), (30, None), (60, None), (61, 60)])
def test_a_longer_keep_alive_than_allowed_is_shortened(broker: Broker, asked, given):
    """v5 [MQTT-3.1.2-21] [MQTT-3.2.2-21] [MQTT-3.2.2-22]"""
    peer = Peer(broker)
    answer = peer.connect(keep_alive=asked)
    assert (answer.properties or {}).get(P.SERVER_KEEP_ALIVE) == given
    broker.tick(broker.now + 1.5 * (given or asked))
    assert not peer.transport.closed
    broker.tick(broker.now + 1)
    assert peer.transport.closed


# --- QoS from the client


def test_qos_1_is_acknowledged_and_delivered_each_time(join: Join, version):
    """[MQTT-4.3.2-2], v5 [MQTT-4.3.2-4] [MQTT-4.3.2-5]: a DUP is a new message to the receiver"""
    watcher = join("watcher")
    watcher.subscribe("a")
    peer = join(version=version)
    peer.send(Publish("a", b"1", 1, packet_id=65535))
    assert peer.received() == [Puback(65535)]
    peer.send(Publish("a", b"1", 1, dup=True, packet_id=65535))
    assert peer.received() == [Puback(65535)]
    messages = watcher.messages()
    assert [(m.payload, m.dup) for m in messages] == [(b"1", False)] * 2  # [MQTT-3.3.1-3]


def test_qos_2_is_delivered_once_and_only_when_it_is_released(join: Join, version):
    """[MQTT-4.3.3-2], v5 [MQTT-4.3.3-8] [MQTT-4.3.3-10] [MQTT-4.3.3-11] [MQTT-4.3.3-12]"""
    watcher = join("watcher")
    watcher.subscribe("a", 2)
    peer = join(version=version)
    for dup in (False, True, True):
        peer.send(Publish("a", b"1", 2, dup=dup, packet_id=9))
        assert peer.received() == [Pubrec(9)]
    assert watcher.received() == []
    peer.send(Pubrel(9))
    assert peer.received() == [Pubcomp(9)]
    assert [m.payload for m in watcher.drain()] == [b"1"]
    peer.send(Pubrel(9))  # again, because PUBCOMP was lost
    (answer,) = peer.received()
    assert isinstance(answer, Pubcomp)
    assert watcher.drain() == []
    peer.send(Publish("a", b"2", 2, packet_id=9))  # the id is free: a new message [MQTT-4.3.3-12]
    peer.send(Pubrel(9))
    assert [m.payload for m in watcher.drain()] == [b"2"]


def test_qos_2_goes_on_after_a_new_connection(join: Join, broker: Broker, version):
    """[MQTT-4.1.0-1] [MQTT-4.4.0-1]: the ids of QoS 2 belong to the session"""
    watcher = join("watcher")
    watcher.subscribe("a", 2)
    peer = join(version=version, **lasting(version))
    peer.send(Publish("a", b"1", 2, packet_id=9))
    peer.lose()
    peer = join(version=version, **lasting(version))
    peer.send(Publish("a", b"1", 2, dup=True, packet_id=9), Pubrel(9))
    assert peer.received() == [Pubrec(9), Pubcomp(9)]
    peer.send(Publish("a", b"2", 2, packet_id=10))
    peer.lose()
    join(version=version)  # a clean start: what was not released is gone
    assert [m.payload for m in watcher.drain()] == [b"1"]
    assert waiting_bytes(broker) == 0


def test_what_is_refused_keeps_the_qos_2_exchange_whole(join: Join, access: FakeAccess, version):
    """v5 [MQTT-4.3.3-9]: an error ends it; 3.1.1 has no errors, [MQTT-3.3.5-2]"""
    access.deny("user", Action.PUBLISH, "no")
    peer = join(version=version)
    peer.send(Publish("no", b"", 2, packet_id=1))
    if version == 5:
        assert peer.received() == [Pubrec(1, ReasonCode.NOT_AUTHORIZED)]
    else:
        assert peer.received() == [Pubrec(1)]
        peer.send(Pubrel(1))
        assert peer.received() == [Pubcomp(1)]
    assert not peer.session.received


@pytest.mark.parametrize("limits", [Limits(inflight=3)])
def test_more_than_the_receive_maximum_ends_the_connection(join: Join):
    """v5 [MQTT-3.3.4-7], section 3.3.4: 0x93"""
    peer = join()
    for packet_id in (1, 2, 3):
        peer.send(Publish("a", b"", 2, packet_id=packet_id))
    peer.send(Publish("a", b"", 1, packet_id=4))  # answered at once, so that it takes no room
    peer.send(Publish("a", b"", 2, dup=True, packet_id=1), Pubrel(1))
    peer.send(Publish("a", b"", 2, packet_id=5))
    assert not peer.transport.closed
    peer.send(Publish("a", b"", 2, packet_id=6))
    assert peer.farewell() == ReasonCode.RECEIVE_MAXIMUM_EXCEEDED


@pytest.mark.parametrize("limits", [Limits(inflight=3)])
def test_the_receive_maximum_is_a_connections(join: Join):
    """v5 section 4.9: the quota begins anew with each connection"""
    peer = join(**lasting(5))
    peer.send(*[Publish("a", b"", 2, packet_id=n) for n in (1, 2, 3)])
    peer.lose()
    peer = join(**lasting(5))
    peer.send(*[Publish("a", b"", 2, packet_id=n) for n in (4, 5, 6)])
    assert not peer.transport.closed
    assert set(peer.session.received) == {1, 2, 3, 4, 5, 6}
    peer.send(*[Pubrel(n) for n in range(1, 7)])
    assert not peer.session.received


@pytest.mark.parametrize("limits", [Limits(queue_bytes=20_000)])
def test_unfinished_qos_2_messages_are_bounded_in_bytes(join: Join, broker: Broker, version):
    """Rule 3 of the design"""
    peer = join(version=version)
    for packet_id in range(1, 20):
        if not peer.transport.closed:
            peer.send(Publish("a", bytes(5000), 2, packet_id=packet_id))
    assert broker.accounting.queued_bytes <= 20_000
    answers = [p.reason_code for p in peer.received() if isinstance(p, Pubrec)]
    assert len([code for code in answers if code < 0x80]) == 3
    if version == 5:
        assert answers[-1] == ReasonCode.QUOTA_EXCEEDED


# --- QoS to the client


def test_qos_1_to_a_client(join: Join, version):
    """[MQTT-4.3.2-1], v5 [MQTT-4.3.2-1] [MQTT-4.3.2-2] [MQTT-4.3.2-3]"""
    peer = join(version=version)
    peer.subscribe("a", 1)
    publisher = join("publisher")
    ids = []
    for n in range(3):
        publisher.publish("a", b"%d" % n, 2)
        (message,) = peer.messages()
        assert (message.qos, message.dup) == (1, False)
        ids.append(message.packet_id)
    assert len(set(ids)) == 3 and None not in ids
    assert set(peer.session.inflight) == set(ids)
    for packet_id in ids:
        peer.send(Puback(packet_id))
    assert not peer.session.inflight and peer.received() == []


def test_qos_2_to_a_client(join: Join, version):
    """[MQTT-4.3.3-1], v5 [MQTT-4.3.3-1] to [MQTT-4.3.3-7]"""
    peer = join(version=version)
    peer.subscribe("a", 2)
    join("publisher").publish("a", b"x", 2)
    (message,) = peer.messages()
    packet_id = message.packet_id
    assert (message.qos, message.dup) == (2, False) and packet_id
    peer.send(Pubrec(packet_id))
    assert peer.received() == [Pubrel(packet_id)]
    assert packet_id in peer.session.inflight  # [MQTT-2.3.1-4]: not free before PUBCOMP
    assert waiting_bytes(peer.broker) == 0  # but its bytes are
    peer.send(Pubrec(packet_id))
    assert peer.received() == [Pubrel(packet_id)]
    peer.send(Pubcomp(packet_id))
    assert not peer.session.inflight


def test_what_is_unacknowledged_is_sent_again_after_a_new_connection(join: Join, version):
    """[MQTT-4.4.0-1] [MQTT-4.6.0-1], v5 [MQTT-4.4.0-1] [MQTT-3.3.1-1]"""
    peer = join(version=version, **lasting(version))
    peer.subscribe("#", 2)
    publisher = join("publisher")
    for n in range(6):
        publisher.publish("a", b"%d" % n, 1 + n % 2)
    first = peer.messages()
    assert [m.payload for m in first] == [b"%d" % n for n in range(6)]
    ids = [m.packet_id for m in first]
    peer.send(Puback(ids[0]), Pubrec(ids[1]), Pubrec(ids[3]), Pubcomp(ids[3]))
    peer.lose()
    publisher.publish("a", b"later", 1)
    peer = join(version=version, **lasting(version))
    packets = peer.received()
    assert [p.packet_id for p in packets if isinstance(p, Pubrel)] == [ids[1]]
    again = [p for p in packets if isinstance(p, Publish)]
    assert [(m.packet_id, m.payload, m.qos, m.dup) for m in again[:-1]] == [
        (ids[2], b"2", 1, True),
        (ids[4], b"4", 1, True),
        (ids[5], b"5", 2, True),
    ]
    assert (again[-1].payload, again[-1].dup) == (b"later", False)
    assert again[-1].packet_id not in ids[1:]
    peer.send(Pubcomp(ids[1]))
    peer.acknowledge(*again)
    assert peer.drain() == [] and not peer.session.inflight


def test_nothing_is_sent_again_on_the_same_connection(join: Join, broker: Broker, version):
    """v5 [MQTT-4.4.0-1]; rule 2 of the design: nothing is dropped by a timer either"""
    peer = join(version=version)
    peer.subscribe("a", 1)
    join("publisher").publish("a", b"x", 1)
    (message,) = peer.messages()
    for _ in range(100):
        broker.tick(broker.now + 60)
    assert peer.messages() == []
    peer.send(Puback(message.packet_id))
    assert not peer.session.inflight


@pytest.mark.lengthy
def test_packet_ids_in_use_are_passed_over(join: Join):
    """[MQTT-2.3.1-2], v5 [MQTT-2.2.1-4]"""
    peer = join()
    peer.subscribe("a", 1)
    publisher = join("publisher")
    publisher.publish("a", b"held", 1)
    (held,) = peer.messages()
    ids = [held.packet_id]
    for _ in range(65535 // 15 + 2):
        publisher.send(*[Publish("a", b"x", 1, packet_id=1)] * 15)
        messages = peer.messages()
        ids += [message.packet_id for message in messages]
        peer.send(*[Puback(message.packet_id) for message in messages])
    assert len(ids) > 65536 and ids.count(held.packet_id) == 1
    assert set(ids) == set(range(1, 65536))


def test_acknowledgements_of_nothing_do_no_harm(join: Join, version):
    """The exchange is ended for the client, as mosquitto does: without 0x92, in 5.0, too"""
    peer = join(version=version)
    peer.subscribe("a", 2)
    peer.send(Puback(7), Pubrec(7), Pubcomp(7), Pubrel(7))
    assert peer.received() == [Pubrel(7), Pubcomp(7)]
    assert not peer.transport.closed


@pytest.mark.parametrize(("qos", "answer"), [(1, Pubrec), (1, Pubcomp), (2, Puback), (2, Pubcomp)])
def test_the_wrong_acknowledgement_ends_the_connection(join: Join, version, qos, answer):
    """v5 section 4.13; the message stays, for the next connection"""
    peer = join(version=version, **lasting(version))
    peer.subscribe("a", 2)
    join("publisher").publish("a", b"one", qos)
    (message,) = peer.messages()
    assert message.packet_id
    peer.send(answer(message.packet_id))
    assert peer.transport.closed
    if version == 5:
        assert peer.farewell() == ReasonCode.PROTOCOL_ERROR
    again = join(version=version, **lasting(version))
    assert [m.payload for m in again.drain()] == [b"one"]


def test_a_pubrec_with_an_error_ends_the_exchange(join: Join):
    """v5 [MQTT-4.3.3-4], section 4.3.3; an error is the end, whenever it comes"""
    peer = join()
    peer.subscribe("a", 2)
    publisher = join("publisher")
    publisher.publish("a", b"x", 2)
    (message,) = peer.messages()
    peer.send(Pubrec(message.packet_id, ReasonCode.QUOTA_EXCEEDED))
    assert peer.received() == [] and not peer.session.inflight
    publisher.publish("a", b"x", 2)
    (message,) = peer.messages()
    peer.send(Pubrec(message.packet_id))
    peer.only(Pubrel)
    peer.send(Pubrec(message.packet_id, ReasonCode.QUOTA_EXCEEDED))
    assert peer.received() == [] and not peer.session.inflight


def test_a_puback_with_an_error_is_an_acknowledgement(join: Join):
    """v5 section 4.3.2: the message is not sent again"""
    peer = join()
    peer.subscribe("a", 1)
    join("publisher").publish("a", b"x", 1)
    (message,) = peer.messages()
    peer.send(Puback(message.packet_id, ReasonCode.UNSPECIFIED_ERROR, {P.REASON_STRING: "no"}))
    assert not peer.session.inflight and not peer.transport.closed


@pytest.mark.parametrize("qos", [1, 2])
def test_no_more_in_flight_than_the_client_can_take(join: Join, qos):
    """v5 [MQTT-3.3.4-9]"""
    peer = join(properties={P.RECEIVE_MAXIMUM: 3})
    peer.subscribe("#", 2)
    publisher = join("publisher")
    for n in range(10):
        publisher.publish("a", b"%d" % n, qos)
    publisher.publish("a", b"qos 0")  # [MQTT-3.3.4-8]: it is not held up
    first = peer.messages()
    assert [m.payload for m in first] == [b"0", b"1", b"2", b"qos 0"]
    if qos == 2:
        peer.send(Pubrec(first[0].packet_id))
        peer.only(Pubrel)  # the exchange goes on, and its place is taken until PUBCOMP
        peer.send(Pubcomp(first[0].packet_id))
    else:
        peer.send(Puback(first[0].packet_id))
    (fourth,) = peer.messages()
    assert fourth.payload == b"3"
    peer.acknowledge(*first[1:3], fourth)
    assert [m.payload for m in peer.drain()] == [b"%d" % n for n in range(4, 10)]


@pytest.mark.parametrize("qos", [1, 2])
def test_a_smaller_window_holds_for_what_is_sent_again(join: Join, qos):
    """v5 [MQTT-3.3.4-9] [MQTT-4.4.0-1]: sent again with the old ids, and not too many at once"""
    peer = join(**lasting(5))
    peer.subscribe("#", qos)
    publisher = join("publisher")
    for n in range(30):
        publisher.publish("a", b"%d" % n, qos)
    ids = [message.packet_id for message in peer.messages()]
    assert len(ids) == 20
    peer.lose()
    options = lasting(5)
    options["properties"][P.RECEIVE_MAXIMUM] = 3  # type: ignore[index]
    peer = join(**options)
    messages = peer.messages()
    assert [m.packet_id for m in messages] == ids[:3]
    received = list(messages)
    while messages:
        peer.acknowledge(messages[0])
        new = peer.messages()
        received += new
        messages = messages[1:] + new
        assert len(messages) <= 3
    assert [m.payload for m in received] == [b"%d" % n for n in range(30)]
    assert [m.packet_id for m in received[:20]] == ids
    assert [m.dup for m in received] == [True] * 20 + [False] * 10
    assert not peer.session.inflight


def unanswered(join: Join, count: int) -> tuple[Peer, Peer, list[int | None]]:
    """A client, who publishes to it, and the ids of so many messages that it leaves unanswered."""
    peer = join(**lasting(5))
    peer.subscribe("#", 1)
    publisher = join("publisher")
    for n in range(count):
        publisher.publish("a", b"%d" % n, 1)
    return peer, publisher, [message.packet_id for message in peer.messages()]


def test_a_connection_that_is_lost_while_it_is_sent_again(join: Join):
    """[MQTT-4.4.0-1], twice"""
    peer, _, ids = unanswered(join, 10)
    options = lasting(5)
    options["properties"][P.RECEIVE_MAXIMUM] = 3  # type: ignore[index]
    for _ in range(2):
        peer.lose()
        peer = join(**options)
        assert [m.packet_id for m in peer.messages()] == ids[:3]
    peer.lose()
    peer = join(**lasting(5))
    assert [m.packet_id for m in peer.drain()] == ids
    assert not peer.session.inflight


def test_what_waits_to_be_sent_again_may_be_acknowledged(join: Join):
    peer, publisher, ids = unanswered(join, 6)
    peer.lose()
    options = lasting(5)
    options["properties"][P.RECEIVE_MAXIMUM] = 1  # type: ignore[index]
    peer = join(**options)
    peer.send(*[Puback(packet_id) for packet_id in reversed(ids)])
    peer.drain()
    publisher.publish("a", b"new", 1)
    assert [m.payload for m in peer.drain()] == [b"new"]
    assert not peer.session.inflight and not peer.session.resends


# --- Maximum Packet Size


@pytest.mark.parametrize("qos", [0, 1, 2])
def test_no_packet_is_larger_than_the_client_takes(join: Join, broker: Broker, qos):
    """v5 [MQTT-3.1.2-24] [MQTT-3.1.2-25]: dropped as if it had been sent and acknowledged"""
    largest = 100
    peer = join(properties={P.MAXIMUM_PACKET_SIZE: largest}, clean=False)
    peer.subscribe("#", 2)
    publisher = join("publisher")
    around = len(Publish("a", b"", qos, packet_id=1 if qos else None).encode(5))
    for size in (largest - around, largest - around + 1):
        publisher.publish("a", bytes(size), qos)
    publisher.publish("a", b"", qos, properties={P.USER_PROPERTY: [("key", "x" * 100)]})
    publisher.publish("a", b"last", qos)
    messages = peer.drain()
    assert [len(m.payload) for m in messages] == [largest - around, 4]
    assert not peer.session.inflight
    assert drops(broker) == {"too_large": 2}


def test_a_large_packet_size_lets_everything_through(join: Join):
    peer = join(properties={P.MAXIMUM_PACKET_SIZE: 10_000})
    properties = {P.SUBSCRIPTION_IDENTIFIER: [1]}
    peer.subscribe("a/#", 1, properties=properties)
    peer.subscribe("b", 1)
    publisher = join("publisher", version=4)
    for topic in ("a", "b"):
        for size in (0, 100, 9_000, 9_980, 10_000):
            publisher.publish(topic, bytes(size), size % 3)
    assert [len(m.payload) for m in peer.drain()] == [0, 100, 9_000, 9_980] * 2


def test_what_is_in_flight_is_dropped_when_the_client_takes_no_more(join: Join):
    peer = join(**lasting(5))
    peer.subscribe("#", 1)
    join("publisher").publish("a", bytes(500), 1)
    peer.lose()
    options = lasting(5)
    options["properties"][P.MAXIMUM_PACKET_SIZE] = 100  # type: ignore[index]
    peer = join(**options)
    assert peer.messages() == [] and not peer.session.inflight


@pytest.mark.parametrize("limits", [Limits(packet_size=200)])
def test_a_larger_packet_than_allowed_ends_the_connection(join: Join):
    """v5 [MQTT-3.2.2-15]: 0x95"""
    peer = join()
    peer.send(Publish("a", bytes(300)).encode(5)[:10])
    assert peer.farewell() == ReasonCode.PACKET_TOO_LARGE


# --- DISCONNECT and errors


@pytest.mark.parametrize(
    ("data", "code"),
    [
        ("00 00", 0x82),
        ("10 0c 0004 4d515454 05 02 0000 0000", 0x82),
        ("20 03 00 00 00", 0x82),
        ("36 07 0001 61 0001 00 00", 0x81),
        ("30 06 0002 2b 61 00 00", 0x81),
        ("30 05 0001 23 00 00", 0x81),
        ("32 06 0001 61 0000 00", 0x82),
        ("30 07 0001 61 09 23 0001", 0x81),
        ("30 07 0001 61 03 23 0063", 0x94),
        ("30 07 0001 61 03 23 0000", 0x94),
        ("30 06 0000 03 23 0001", 0x82),
        ("30 06 0001 61 02 0b 01", 0x82),  # a Subscription Identifier [MQTT-3.3.4-6]
        ("80 07 0001 00 0001 61 00", 0x81),  # reserved flags [MQTT-3.8.1-1]
        ("82 03 0001 00", 0x82),  # no filter [MQTT-3.8.3-2]
        ("82 07 0000 00 0001 61 00", 0x81),  # packet id 0
        ("82 07 0001 00 0001 61 03", 0x82),  # QoS 3
        ("82 07 0001 00 0001 61 30", 0x82),  # retain handling 3
        ("82 07 0001 00 0001 61 40", 0x81),  # reserved option bits [MQTT-3.8.3-5]
        ("82 11 0001 00 000b 2473686172652f672f6161 04", 0x82),  # No Local, shared [MQTT-3.8.3-4]
        ("82 09 0001 02 0b00 0001 61 00", 0x82),  # Subscription Identifier 0
        ("a2 03 0001 00", 0x82),  # UNSUBSCRIBE without a filter [MQTT-3.10.3-2]
        ("60 02 0001", 0x81),  # PUBREL with flags 0 [MQTT-3.6.1-1]
        ("40 03 0001 55", 0x82),
        ("e0 02 00 05", 0x81),
    ],
)
def test_errors_have_the_standards_codes(join: Join, data, code):
    """v5 [MQTT-4.13.1-1], section 4.13"""
    peer = join()
    peer.send(bytes.fromhex(data))
    assert peer.farewell() == code


@pytest.mark.parametrize("data", ["c0 01 00", "e0 02 05 00", "30 80 80 80 80 01"])
def test_errors_that_mosquitto_does_not_answer(join: Join, data):
    """A PINGREQ with a body, DISCONNECT with a reason of the server's, a length of five bytes"""
    peer = join()
    peer.send(bytes.fromhex(data))
    assert peer.transport.closed and peer.received() == []


@pytest.mark.parametrize(
    ("body", "answer"),
    [
        ("05 02 0000 02 2400 0001 61", "20 03 00 81 00"),  # a property that is not CONNECT's
        ("05 02 0000 02 7f00 0001 61", "20 03 00 81 00"),  # one that nobody knows
        ("05 02 0000 06 210001210002 0001 61", "20 03 00 82 00"),  # one that is there twice
        ("05 02 0000 02 2100 0001 61", "20 03 00 81 00"),  # one that is cut off
        ("05 02 0000 00 0001 61 ff", "20 03 00 81 00"),  # a byte too many
        ("05 02 0000 00 0002 eda0", "20 03 00 85 00"),  # a client id that is not UTF-8
        ("05 02 0000 00 0001 07", "20 03 00 85 00"),  # or cannot be printed
        ("05 82 0000 00 0001 61", ""),  # a user name that is not there
        ("05 03 0000 00 0001 61", ""),  # the reserved flag
        ("06 02 0000 00 0001 61", "20 02 00 01"),
        ("04 02 0000 0001 61 ff", ""),
    ],
)
def test_wrong_connects(broker: Broker, body, answer):
    """v5 section 4.13: what of a CONNECT is answered, as mosquitto does"""
    rest = bytes.fromhex("0004 4d515454" + body)
    peer = Peer(broker)
    peer.send(bytes((0x10, len(rest))) + rest)
    assert peer.transport.closed and bytes(peer.transport.written).hex() == answer.replace(" ", "")


def test_errors_of_3_1_1_just_close(join: Join, broker: Broker):
    """Section 4.8 of 3.1.1; nobody else is touched"""
    other = join("other")
    peer = join(version=4)
    peer.send(Pingreq(), bytes.fromhex("30 05 0001 2b 00 00"), Pingreq())
    assert peer.received() == [Pingresp()]
    assert peer.transport.closed and not other.transport.closed
    assert set(broker.sessions) == {"other"}


def test_disconnect_is_the_last_packet(join: Join, version):
    """[MQTT-3.14.4-1] [MQTT-3.14.4-2]"""
    watcher = join("watcher")
    watcher.subscribe("#")
    peer = join(version=version)
    peer.send(Publish("a", b"1"), Disconnect(), Publish("a", b"2"), Pingreq())
    assert peer.transport.closed and peer.received() == []
    peer.send(Publish("a", b"3"))
    assert watcher.payloads() == [b"1"]


def test_a_lost_connection_that_is_lost_again(join: Join, broker: Broker):
    peer = join(**lasting(5))
    peer.lose()
    peer.lose()
    peer.send(Pingreq())
    peer.fast()
    assert peer.received() == []
    join(**lasting(5))
    peer.lose()
    assert broker.sessions["client"].link is not None


def test_unsuback_of_3_1_1_has_no_codes(join: Join):
    """[MQTT-3.10.4-5], section 3.11"""
    peer = join(version=4)
    peer.send(Unsubscribe(258, ["a", "b"]))
    assert bytes(peer.transport.written) == bytes.fromhex("b0 02 0102")
    peer.only(Unsuback)


def test_a_topic_alias_is_resolved_for_the_receivers(join: Join):
    """v5 [MQTT-3.3.2-7]: aliases are of one connection and one direction"""
    watcher = join("watcher")
    watcher.subscribe("a/#")
    peer = join()
    peer.send(Publish("a/long/topic", b"1", properties={P.TOPIC_ALIAS: 1}))
    peer.send(Publish("", b"2", properties={P.TOPIC_ALIAS: 1}))
    assert [(m.topic, m.properties) for m in watcher.messages()] == [("a/long/topic", None)] * 2
    assert not watcher.transport.closed


@pytest.mark.parametrize("end", ["lost", "disconnected", "taken over", "refused"])
def test_the_memory_of_a_client_is_free_at_once(broker: Broker, end: str):
    """However it ends, and not only when garbage is looked for."""
    gc.disable()
    try:
        peer = Peer(broker)
        if end == "refused":
            peer.say_connect()
            peer.client.refuse(ReasonCode.NOT_AUTHORIZED, "the test says so")
        else:
            peer.connect(**lasting(5))
            peer.subscribe("a", 1)
        if end == "lost":
            peer.lose()
        elif end == "disconnected":
            peer.disconnect()
        elif end == "taken over":
            Peer(broker).connect(**lasting(5))
        broker.flush()
        wire = weakref.ref(peer.transport)  # which is held by the client
        del peer
        assert wire() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("limits", [Limits(queue_messages=2, inflight=2)])
@pytest.mark.parametrize("topic_filter", ["a", "$share/g/a"])
def test_an_absent_client_without_room_is_no_reason_to_refuse_what_others_take(
    join: Join, broker: Broker, topic_filter
):
    """As QoS 0 it goes to who is there: a client, or ROS."""
    absent = join("absent", **lasting(5))
    absent.subscribe("a", 2)
    absent.lose()
    publisher = join("publisher")
    codes = [publisher.publish("a", b"%d" % number, 2) for number in range(4)]
    assert codes == [0, 0, 0x97, 0x97]
    taker = join("taker")
    taker.subscribe(topic_filter, 0)
    for number in range(4):
        assert publisher.publish("a", b"%d" % number, 2) == 0
    assert [m.payload for m in taker.drain()] == [b"0", b"1", b"2", b"3"]
    taker.lose()
    assert publisher.publish("a", b"4", 2) == 0x97


@pytest.mark.patches
@pytest.mark.parametrize("waits", [False, True])
def test_a_packet_cut_in_two_is_as_old_as_its_first_byte(
    broker: Broker, monkeypatch: pytest.MonkeyPatch, waits: bool
):
    """Also when what is before it takes some turns."""
    ages = []
    publish_to = Broker.publish_to

    def told(self: Broker, targets: Any, route: Any, message: Message, origin: Any) -> int:
        ages.append(message.age)
        return publish_to(self, targets, route, message, origin)

    def slow(*args: Any, **options: Any) -> Iterator[Step]:
        yield None
        yield from subscribe(*args, **options)

    monkeypatch.setattr(Broker, "publish_to", told)
    monkeypatch.setattr(client, "subscribe", slow)
    peer = Peer(broker, 4)
    peer.connect("a")
    command = Publish("x", b"go", 1, packet_id=7).encode(4)
    if waits:
        peer.send(Subscribe(1, [Subscription("x")]).encode(4) + command[:5])
    else:
        peer.send(command[:5])
    broker.accounting.now += 3
    if waits:
        peer.go_on()
    broker.accounting.now += 0.05
    peer.send(command[5:] + command[:5])
    broker.accounting.now += 0.05
    peer.send(command[5:])
    assert ages == [pytest.approx(3.05), 0.0]


@pytest.mark.parametrize("full", ["drop-oldest", "refuse"])
@pytest.mark.parametrize("own", ["a", "b"])
@pytest.mark.parametrize("seed", range(10))
def test_acknowledgements_in_one_chunk_do_what_they_do_one_by_one(
    access: FakeAccess, seed: int, own: str, full: str
) -> None:
    """The window is filled once for many of them; the same is sent, in the same order, and what
    the reader publishes behind them finds the same room, also for itself."""
    chance = random.Random(seed)
    script: list[tuple[int, int]] = []  # how many are published, and then acknowledged
    for _ in range(12):
        script.append((chance.randint(0, 80), chance.randint(0, 60)))
    sent = []
    for together in (True, False):
        limits = Limits(inflight=50, queue_messages=100, queue_full=full)  # type: ignore[arg-type]
        broker = Broker(access, FakeStore(), limits)
        broker.tick(1000.0)
        reader, writer = Peer(broker), Peer(broker)
        for peer, name in ((reader, "reader"), (writer, "writer")):
            assert peer.connect(name).reason_code == ReasonCode.SUCCESS
        reader.subscribe("a", qos=1)
        arrived: list[tuple[int | None, bytes]] = []
        answers: list[int] = []
        unacknowledged: deque[int | None] = deque()
        number = 0
        for published, acknowledged in script:
            for _ in range(published):
                number += 1
                writer.send(Publish("a", b"%d" % number, packet_id=writer.next_id(), qos=1))
            for each in reader.messages():
                arrived.append((each.packet_id, each.payload))
                unacknowledged.append(each.packet_id)
            first = [
                unacknowledged.popleft() for _ in range(min(acknowledged, len(unacknowledged)))
            ]
            packets: list[Packet] = [Puback(each or 0) for each in first]
            packets.insert(len(packets) // 2, Puback(60_000))  # of no message
            packets.append(Publish(own, b"between", packet_id=reader.next_id(), qos=1))
            if reader.session.congestion is not None:
                reader.session.congestion._allowance.change(-PATIENCE)  # nobody waits for it
            if together:
                reader.send(*packets)
            else:
                for packet in packets:
                    reader.send(packet)
            for each in reader.received():
                if isinstance(each, Publish):
                    arrived.append((each.packet_id, each.payload))
                    unacknowledged.append(each.packet_id)
                elif isinstance(each, Puback):
                    answers.append(each.reason_code)
        sent.append((arrived, answers, drops(broker)))
        assert len(arrived) > 100
        # What the two hold is given back, as the fixture would check.
        check_accounts(broker)
    assert sent[0] == sent[1]


@pytest.mark.parametrize("full", ["drop-oldest", "refuse", "disconnect"])
def test_what_comes_behind_an_acknowledgement_finds_its_room(access: FakeAccess, full: str) -> None:
    limits = Limits(inflight=1, queue_messages=6, queue_full=full)  # type: ignore[arg-type]
    broker = Broker(access, FakeStore(), limits)
    reader, writer = Peer(broker), Peer(broker)
    reader.connect("reader")
    writer.connect("writer")
    reader.subscribe("a", 1)
    for number in range(7):
        assert writer.publish("a", b"%d" % number, 1) == 0
    (first,) = reader.messages()
    assert reader.session.congestion is not None
    reader.session.congestion._allowance.change(-PATIENCE)
    reader.send(Puback(first.packet_id or 0), Publish("a", b"own", 1, packet_id=9))
    second, answer = reader.received()
    assert isinstance(second, Publish) and second.payload == b"1"
    assert isinstance(answer, Puback) and (answer.packet_id, answer.reason_code) == (9, 0)
    assert not drops(broker) and not reader.transport.closed
    check_accounts(broker)


def test_names_that_are_not_ascii_cost_more(broker: Broker) -> None:
    """They are examined character by character, before anybody knows who it is."""

    class Asking:
        """An exchange that goes on."""

        def step(self, data: bytes) -> bytes:
            return b"more"

    def cost(data: bytes) -> int:
        peer = Peer(broker)
        peer.transport.exchanges["SCRAM"] = Asking()
        before = broker.counters.cost
        peer.say_connect(properties={P.AUTHENTICATION_METHOD: "SCRAM", P.AUTHENTICATION_DATA: data})
        assert isinstance(peer.received()[0], Auth)
        return broker.counters.cost - before

    name = "\u0e01" * 85
    plain = cost(b"n,,n=" + b"x" * len(name.encode()))
    assert cost(f"n,,n={name}".encode()) - plain >= len(name)
