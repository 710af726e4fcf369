"""Acknowledged means stored: packets wait for commits, and what happens when the store fails."""

from __future__ import annotations

import pytest

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.mqtt.packets import Puback, Pubcomp, Publish, Pubrec, Pubrel

from .conftest import FakeStore, Join, Peer, drops, lasting
from .test_broker import FakeLink


def held_back(join: Join, store: FakeStore, version: int = 5) -> tuple[Peer, Peer]:
    """A stored session's client and a publisher to it, between whom the store stands."""
    subscriber, publisher = join("subscriber", **lasting(5)), join("publisher", version=version)
    subscriber.subscribe("a", 2)
    subscriber.subscribe("c")
    store.holding = True
    return subscriber, publisher


def test_bytes_wait_for_the_commit(join: Join, store: FakeStore):
    """Rule 2 of the design"""
    subscriber, publisher = held_back(join, store)
    publisher.send(Publish("a", b"x", 1, packet_id=1))
    assert publisher.received() == [] and subscriber.received() == []
    store.commit()
    publisher.only(Puback)
    assert subscriber.payloads() == [b"x"]


def test_who_depends_on_nothing_stored_does_not_wait(join: Join, store: FakeStore):
    """Rule 2: not even a subscriber to the same message, or the publisher of another one."""
    _, publisher = held_back(join, store)
    other, third = join("other"), join("third")
    other.subscribe("a", 1)
    publisher.send(Publish("a", b"x", 1, packet_id=1))
    assert other.payloads() == [b"x"] and publisher.received() == []
    assert third.publish("b", qos=1) == 0x10
    assert third.publish("a", qos=0) == 0 and other.payloads() == [b"payload"]


def test_nothing_passes_what_waits(join: Join, store: FakeStore):
    """[MQTT-4.6.0-6]: the order stays, from batch to batch."""
    subscriber, publisher = held_back(join, store)
    publisher.send(Publish("a", b"1", 1, packet_id=1), Publish("c", b"2"))
    publisher.send(Publish("c", b"3"))
    store.batch += 1  # the first batch is being written
    publisher.send(Publish("a", b"4", 1, packet_id=2))
    assert subscriber.received() == []
    store.committed = 1
    store._tell(True)
    assert subscriber.payloads() == [b"1", b"2", b"3"]
    publisher.only(Puback)
    store.commit()
    assert subscriber.payloads() == [b"4"]
    publisher.only(Puback)


def test_who_makes_room_does_not_wait_for_what_was_retained_meanwhile(
    broker: Broker, join: Join, store: FakeStore
):
    """Rule 2: what the bridge retains, while a subscriber's window is full, is not its matter."""
    subscriber, inside = join("subscriber"), broker.attach("inside", FakeLink())
    subscriber.subscribe("a", 1)
    window = broker.limits.inflight
    for number in range(window + 1):
        broker.publish(Message("a", b"%d" % number, 1), inside)
    broker.flush()
    sent = subscriber.messages()
    assert len(sent) == window
    store.holding = True
    broker.publish(Message("b", b"x", 1, True), inside)
    broker.flush()
    subscriber.send(Puback(sent[0].packet_id))
    assert subscriber.payloads() == [b"%d" % window]


def test_a_failed_commit_closes_the_connections_concerned(join: Join, store: FakeStore):
    """Rule 2: without an acknowledgement"""
    subscriber, publisher = held_back(join, store)
    other = join("other")
    publisher.send(Publish("a", b"x", 1, packet_id=1))
    store.commit(kept=False)
    assert publisher.received() == [] and publisher.transport.closed
    assert subscriber.received() == [] and subscriber.transport.closed
    assert not other.transport.closed
    store.commit()
    other.send(Publish("a", b"x", 1, packet_id=1))
    other.only(Puback)


def test_a_failed_commit_closes_a_connection_that_was_ending(join: Join, store: FakeStore):
    _, publisher = held_back(join, store)
    publisher.send(Publish("a", b"x", 1, packet_id=1), bytes((0xE0, 0)))
    store.commit(kept=False)
    assert publisher.received() == [] and publisher.transport.closed


def test_bytes_wait_for_the_commit_when_the_client_leaves_too(join: Join, store: FakeStore):
    """Rule 2: the acknowledgement does not leave ahead of it with the last bytes."""
    _, publisher = held_back(join, store)
    publisher.send(Publish("a", b"x", 1, packet_id=1), bytes((0xE0, 0)))
    assert publisher.received() == []
    store.commit()
    publisher.only(Puback)
    assert publisher.transport.closed


def failing(join: Join, store: FakeStore, version: int = 5) -> tuple[Peer, Peer]:
    subscriber, publisher = held_back(join, store, version)
    store.commit(kept=False)
    return subscriber, publisher


@pytest.mark.parametrize("qos", [1, 2])
def test_what_cannot_be_stored_is_refused(
    join: Join, broker: Broker, store: FakeStore, qos: int
) -> None:
    subscriber, publisher = failing(join, store)
    other = join("other", **lasting(5))  # a session can be made, and is stored later
    other.subscribe("b", 1)
    assert publisher.publish("a", qos=qos) == 0x97
    assert publisher.publish("new", qos=qos, retain=True) == 0x97
    assert set(drops(broker)) == {"not_stored"}
    assert publisher.publish("nobody", qos=qos) in (0, 0x10)
    assert publisher.publish("a", b"0") == 0
    assert subscriber.payloads() == [b"0"]
    store.commit()
    assert publisher.publish("a", b"1", qos=qos) == 0
    assert subscriber.payloads() == [b"1"]
    assert publisher.publish("new", qos=qos, retain=True) in (0, 0x10)


@pytest.mark.parametrize("qos", [1, 2])
def test_3_1_1_is_not_told_a_lie(join: Join, store: FakeStore, qos: int):
    subscriber, publisher = failing(join, store, version=4)
    publisher.send(Publish("a", b"x", qos, packet_id=1))
    assert publisher.received() == [] and publisher.transport.closed
    store.commit()
    assert subscriber.received() == []


def test_the_exchanges_under_way_wait_for_the_store(join: Join, store: FakeStore):
    """PUBREL of both sides depends on the store, and cannot be refused."""
    subscriber, publisher = join("subscriber", **lasting(5)), join("publisher")
    subscriber.subscribe("a", 2)
    publisher.send(Publish("a", b"1", 2, packet_id=1), Pubrel(1))
    publisher.received()
    (first,) = subscriber.messages()
    publisher.send(Publish("a", b"2", 2, packet_id=2))
    publisher.only(Pubrec)
    store.holding = True
    store.commit(kept=False)
    publisher.send(Pubrel(2))
    subscriber.send(Pubrec(first.packet_id))
    assert publisher.received() == [] and subscriber.received() == []
    store.commit()
    publisher.only(Pubcomp)
    released, second = subscriber.received()
    assert isinstance(released, Pubrel) and isinstance(second, Publish)
    assert second.payload == b"2"


def test_what_the_appliance_publishes_itself_waits_in_memory(
    join: Join, broker: Broker, store: FakeStore
):
    """It cannot be told to try again."""
    subscriber, _ = failing(join, store)
    inside = broker.attach("inside", FakeLink())
    assert broker.publish(Message("a", b"x", 1), inside) == 0
    broker.flush()
    assert subscriber.received() == []
    store.commit()
    assert subscriber.payloads() == [b"x"]
    broker.detach(inside)
