"""What a listener restricts: versions, client ids, QoS, retained messages; and the payload size."""

from __future__ import annotations

import pytest

from appliance.broker.broker import Broker
from appliance.broker.limits import Limits, Terms
from appliance.mqtt.codec import Properties, Property
from appliance.mqtt.packets import Connack, Disconnect, Publish, Will
from broker.conftest import Join, Peer

statement = pytest.mark.statement
both = pytest.mark.parametrize("version", [4, 5])
qos_of_publish = pytest.mark.parametrize("qos", [0, 1, 2])


def joined(broker: Broker, version: int, terms: Terms) -> Peer:
    peer = Peer(broker, version, terms)
    assert peer.connect("restricted").reason_code == 0
    return peer


def refused(broker: Broker, version: int, terms: Terms, **options: object) -> int:
    """The code of the CONNACK, behind which the connection is closed, and nothing is left."""
    peer = Peer(broker, version, terms)
    peer.say_connect(**options)  # type: ignore[arg-type]
    assert peer.transport.asked is None, "the login was begun"
    answer = peer.only(Connack)
    assert isinstance(answer, Connack)
    assert peer.transport.closed
    assert "client" not in broker.sessions
    return answer.reason_code


# Versions and client ids


@statement("5.0", "MQTT-3.1.2-2")
@statement("3.1.1", "MQTT-3.1.2-2")
@pytest.mark.parametrize(("version", "others", "code"), [(5, {3, 4}, 0x84), (4, {3, 5}, 0x84)])
def test_a_version_that_is_not_spoken(
    broker: Broker, version: int, others: set[int], code: int
) -> None:
    peer = Peer(broker, version, Terms(versions=frozenset(others)))
    peer.say_connect()
    written = bytes(peer.transport.written)
    assert written == (b"\x20\x03\x00\x84\x00" if version == 5 else b"\x20\x02\x00\x01")
    assert peer.transport.closed
    assert refused(broker, version, Terms(versions=frozenset(others))) == code


@both
def test_a_client_id_begins_as_it_should(broker: Broker, version: int) -> None:
    terms = Terms(client_id_prefixes=("robot-", "arm-"))
    for client_id in ("client", "Robot-1", "a"):
        assert refused(broker, version, terms, client_id=client_id) == 0x85
    assert Peer(broker, version, terms).connect("arm-1").reason_code == 0


@both
def test_an_id_that_the_broker_gives_begins_as_it_should_too(broker: Broker, version: int) -> None:
    assert refused(broker, version, Terms(client_id_prefixes=("robot-",)), client_id="") == 0x85
    assert Peer(broker, version, Terms(client_id_prefixes=("auto-",))).connect("").reason_code == 0


# QoS


@statement("5.0", "MQTT-3.2.2-9")
def test_a_client_is_told_what_is_restricted(broker: Broker) -> None:
    told = {
        terms: Peer(broker, 5, terms).connect(f"c{terms.max_qos}{terms.retain}").properties or {}
        for terms in (Terms(), Terms(max_qos=1), Terms(max_qos=0, retain=False))
    }
    found = [
        (each.get(Property.MAXIMUM_QOS), each.get(Property.RETAIN_AVAILABLE))
        for each in told.values()
    ]
    assert found == [(None, None), (1, None), (0, 0)]


@both
@pytest.mark.parametrize("max_qos", [0, 1])
@qos_of_publish
def test_no_message_has_a_higher_qos(
    broker: Broker, join: Join, version: int, max_qos: int, qos: int
) -> None:
    reader = join("reader")
    reader.subscribe("a", 2)
    peer = joined(broker, version, Terms(max_qos=max_qos))
    packet_id = 7 if qos else None
    peer.send(Publish("a", b"x", qos, False, False, packet_id))
    if qos <= max_qos:
        assert reader.payloads() == [b"x"]
        assert not peer.transport.closed
        return
    assert reader.received() == []
    assert peer.received() == ([Disconnect(0x9B)] if version == 5 else [])
    assert peer.transport.closed


@statement("5.0", "MQTT-3.2.2-10")
@both
@qos_of_publish
def test_subscriptions_are_granted_with_that_qos(
    broker: Broker, join: Join, version: int, qos: int
) -> None:
    peer = joined(broker, version, Terms(max_qos=1))
    assert peer.subscribe("a", qos) == min(qos, 1)
    join("writer").publish("a", b"x", 2)
    assert [message.qos for message in peer.messages()] == [min(qos, 1)]


@statement("5.0", "MQTT-3.2.2-12")
@both
def test_no_will_has_a_higher_qos(broker: Broker, version: int) -> None:
    code = refused(broker, version, Terms(max_qos=1), will=Will("a", b"x", 2))
    assert code == (0x9B if version == 5 else 0x87)  # 3.1.1 has "not authorized" for it
    peer = Peer(broker, version, Terms(max_qos=1))
    assert peer.connect(will=Will("a", b"x", 1)).reason_code == 0


# Retained messages


@both
@qos_of_publish
@pytest.mark.parametrize("is_decoded", [False, True], ids=["raw", "decoded"])
def test_nothing_is_retained(broker: Broker, version: int, qos: int, is_decoded: bool) -> None:
    properties: Properties | None = None
    if is_decoded and version == 5:
        properties = {Property.CONTENT_TYPE: "x"}
    peer = joined(broker, version, Terms(retain=False))
    peer.send(Publish("a", b"x", 0, False))
    peer.send(Publish("a", b"x", qos, True, False, 7 if qos else None, properties))
    assert peer.received() == ([Disconnect(0x9A)] if version == 5 else [])
    assert peer.transport.closed
    assert len(broker.retained) == 0


@statement("5.0", "MQTT-3.2.2-13")
@both
def test_no_will_is_retained(broker: Broker, version: int) -> None:
    code = refused(broker, version, Terms(retain=False), will=Will("a", b"x", 0, True))
    assert code == (0x9A if version == 5 else 0x87)


def test_who_may_not_retain_gets_what_others_have_retained(broker: Broker, join: Join) -> None:
    join("other").publish("a", b"kept", retain=True)
    peer = joined(broker, 5, Terms(retain=False))
    peer.subscribe("a")
    assert peer.payloads() == [b"kept"]


# The payload


@both
@qos_of_publish
@pytest.mark.parametrize("is_decoded", [False, True], ids=["raw", "decoded"])
def test_a_payload_is_as_large_as_allowed(
    join: Join, broker: Broker, version: int, qos: int, is_decoded: bool
) -> None:
    broker.use(Limits(payload_size=10), broker.features)
    given: Properties | None = None
    if is_decoded and version == 5:
        given = {Property.CONTENT_TYPE: "x"}
    reader, writer = join("reader"), join("writer", version=version)
    reader.subscribe("a", 2)
    assert writer.publish("a", b"0123456789", qos, properties=given) in (0, 0x10)
    code = writer.publish("a", b"0123456789.", qos, properties=given)
    # 3.1.1 cannot refuse: it is acknowledged, and dropped.
    assert code == (0x97 if qos and version == 5 else 0)
    assert reader.payloads() == [b"0123456789"]
    assert not writer.transport.closed
    assert broker.counters.publish_refused == 1


@both
@pytest.mark.parametrize("qos", [0, 2])
def test_what_the_listener_does_not_take_ends_the_connection_whatever_its_size(
    broker: Broker, version: int, qos: int
) -> None:
    broker.use(Limits(payload_size=10), broker.features)
    peer = joined(broker, version, Terms(max_qos=1, retain=False))
    peer.send(Publish("a", b"0123456789.", qos, qos == 0, False, 7 if qos else None))
    assert peer.received() == ([Disconnect(0x9B if qos else 0x9A)] if version == 5 else [])
    assert peer.transport.closed


@both
def test_a_will_is_no_larger_either(broker: Broker, version: int) -> None:
    broker.use(Limits(payload_size=10), broker.features)
    code = refused(broker, version, Terms(), will=Will("a", b"0123456789."))
    assert code == (0x97 if version == 5 else 0x88)  # 3.1.1: server unavailable
