"""Routing and delivery: subscriptions, retained messages, sessions, wills, rules and limits.

Statements of the standards are named as `[MQTT-…]`, those of 5.0 with `v5` where they differ.
"""

from __future__ import annotations

import gc

import pytest

from appliance.broker.broker import Broker
from appliance.broker.limits import Limits
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.broker.values import Action, Identity
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import (
    Connack,
    Puback,
    Publish,
    Pubrec,
    Pubrel,
    Suback,
    Subscribe,
    Subscription,
    Unsuback,
    Will,
)
from appliance.mqtt.reason import ReasonCode

from .conftest import ALONE, FakeAccess, FakeStore, Join, Peer, drops, lasting, waiting_bytes

EXPIRY = Property.SESSION_EXPIRY_INTERVAL
MESSAGE_EXPIRY = Property.MESSAGE_EXPIRY_INTERVAL


# --- routing


@pytest.mark.parametrize("sent", [0, 1, 2])
@pytest.mark.parametrize("granted", [0, 1, 2])
def test_a_message_comes_with_the_lower_of_both_qos(join: Join, version, sent, granted):
    """[MQTT-3.8.4-6], v5 [MQTT-3.8.4-8]"""
    subscriber = join("subscriber", version=version)
    assert subscriber.subscribe("a/+", granted) == granted
    join("publisher", version=version).publish("a/b", b"x", sent)
    (message,) = subscriber.drain()
    assert (message.topic, message.payload, message.qos) == ("a/b", b"x", min(sent, granted))
    assert not message.dup and not message.retain
    assert not subscriber.session.inflight


@pytest.mark.parametrize("qos", [0, 1, 2])
def test_both_versions_get_each_others_messages(join: Join, qos):
    """5.0 section 4.1 knows no difference of versions; properties stay with those who know them."""
    peers = {version: join(f"v{version}", version=version) for version in (4, 5)}
    for peer in peers.values():
        peer.subscribe("a", 2)
    properties = {Property.CONTENT_TYPE: "text/plain", Property.USER_PROPERTY: [("a", "b")]}
    peers[5].publish("a", b"five", qos, properties=dict(properties))
    peers[4].publish("a", b"four", qos)
    old = peers[4].drain()
    new = peers[5].drain()
    assert [(m.payload, m.properties) for m in old] == [(b"five", None), (b"four", None)]
    assert [(m.payload, m.properties) for m in new] == [(b"five", properties), (b"four", None)]


def test_overlapping_subscriptions_give_one_message_with_the_highest_qos(join: Join, version):
    """[MQTT-3.3.5-1], v5 [MQTT-3.3.4-2]"""
    subscriber = join("subscriber", version=version)
    for topic_filter, qos in (("a/#", 0), ("a/b", 2), ("+/b", 1)):
        subscriber.subscribe(topic_filter, qos)
    join("publisher").publish("a/b", b"x", 2)
    assert [message.qos for message in subscriber.drain()] == [2]


def test_overlapping_subscriptions_bring_all_their_identifiers(join: Join):
    """v5 [MQTT-3.3.4-3] [MQTT-3.3.4-4]"""
    subscriber = join("subscriber")
    for topic_filter, identifier in (("a/#", 7), ("a/b", 300_000), ("+/b", 7)):
        properties = {Property.SUBSCRIPTION_IDENTIFIER: [identifier]}
        subscriber.subscribe(topic_filter, 1, properties=properties)
    subscriber.subscribe("a/+")
    other = join("other")
    other.subscribe("a/b")
    join("publisher").publish("a/b", b"x", 1)
    (message,) = subscriber.drain()
    assert message.properties is not None
    assert sorted(message.properties[Property.SUBSCRIPTION_IDENTIFIER]) == [7, 7, 300_000]  # type: ignore[type-var, arg-type]
    assert [m.properties for m in other.messages()] == [None]


def test_a_subscription_made_again_replaces_the_old_one(join: Join, version):
    """[MQTT-3.8.4-3]"""
    subscriber = join("subscriber", version=version)
    publisher = join("publisher")
    subscriber.subscribe("a", 2)
    subscriber.subscribe("a", 0)
    publisher.publish("a", b"x", 2)
    assert [message.qos for message in subscriber.messages()] == [0]
    if version == 5:
        subscriber.subscribe("a", 0, properties={Property.SUBSCRIPTION_IDENTIFIER: [3]})
        subscriber.subscribe("a", 0, properties={Property.SUBSCRIPTION_IDENTIFIER: [4]})
        publisher.publish("a")
        (message,) = subscriber.messages()
        assert message.properties == {Property.SUBSCRIPTION_IDENTIFIER: [4]}


def test_a_subscription_made_again_as_it_is_costs_the_others_nothing(join: Join, broker: Broker):
    """What is cached of all clients' routes stays valid."""
    subscriber = join("subscriber")
    subscriber.subscribe("a", 1)
    epoch = broker.router.epoch
    subscriber.subscribe("a", 1)
    assert broker.router.epoch == epoch
    subscriber.subscribe("a", 2)
    assert broker.router.epoch > epoch


def test_no_local_keeps_a_clients_own_messages_from_it(join: Join):
    """v5 [MQTT-3.8.3-3]"""
    peer, other = join("peer"), join("other")
    peer.subscribe("a", no_local=True)
    other.subscribe("a", no_local=True)
    peer.publish("a", b"mine")
    assert peer.payloads() == []
    assert other.payloads() == [b"mine"]
    other.publish("a", b"theirs")
    assert peer.payloads() == [b"theirs"]
    peer.subscribe("#")  # Another subscription asks for the same messages, without No Local.
    peer.publish("a", b"mine again")
    assert peer.payloads() == [b"mine again"]


def test_wildcards_do_not_match_topics_that_begin_with_a_dollar(join: Join, broker: Broker):
    """[MQTT-4.7.2-1]"""
    peers = {name: join(name) for name in ("#", "+/broker", "$SYS/#")}
    for name, peer in peers.items():
        peer.subscribe(name)
    inside = broker.attach("inside", FakeLink())
    broker.publish(Message("$SYS/broker", b"x"), inside)
    broker.flush()
    assert {name: peer.payloads() for name, peer in peers.items()} == {
        "#": [],
        "+/broker": [],
        "$SYS/#": [b"x"],
    }


def test_clients_do_not_publish_to_topics_that_begin_with_a_dollar(join: Join):
    """[MQTT-4.7.2-1], section 4.7.2: clients do not exchange messages with them."""
    subscriber, publisher = join("subscriber"), join("publisher")
    subscriber.subscribe("$SYS/#")
    assert publisher.publish("$SYS/broker/uptime", b"0", 1) == ReasonCode.NOT_AUTHORIZED
    assert subscriber.payloads() == []
    assert not publisher.transport.closed


def test_no_subscriber_is_told_to_a_5_0_publisher(join: Join):
    """5.0 section 3.4.2.1"""
    publisher = join("publisher")
    assert publisher.publish("nobody", b"", 1) == ReasonCode.NO_MATCHING_SUBSCRIBERS
    # At PUBREC it is not known yet who will have subscribed at PUBREL; mosquitto says 0, too.
    assert publisher.publish("nobody", b"", 2) == ReasonCode.SUCCESS


def test_unsubscribe_ends_the_delivery_of_new_messages(join: Join, version):
    """[MQTT-3.10.4-1] [MQTT-3.10.4-2] [MQTT-3.10.4-4]; v5 [MQTT-3.10.4-1] [MQTT-3.11.3-1]"""
    subscriber = join("subscriber", version=version)
    publisher = join("publisher")
    subscriber.subscribe("a")
    subscriber.subscribe("b", 1)
    publisher.publish("b", b"begun", 1)
    (begun,) = subscriber.messages()  # What is in flight is finished; what is new is not sent.
    answer = subscriber.unsubscribe("a", "never", "b")
    if version == 5:
        assert list(answer.reason_codes) == [0x00, 0x11, 0x00]
    publisher.publish("a", b"new")
    publisher.publish("b", b"new", 1)
    subscriber.acknowledge(begun)
    assert subscriber.drain() == []


def test_a_filter_is_compared_character_by_character(join: Join):
    """[MQTT-3.10.4-1]: UNSUBSCRIBE a/+ leaves a/b."""
    subscriber = join("subscriber")
    subscriber.subscribe("a/b")
    assert list(subscriber.unsubscribe("a/+").reason_codes) == [ReasonCode.NO_SUBSCRIPTION_EXISTED]
    join("publisher").publish("a/b")
    assert subscriber.payloads() == [b"payload"]


def test_each_filter_of_a_subscribe_has_its_own_answer(join: Join, version, access: FakeAccess):
    """[MQTT-3.8.4-4] [MQTT-3.8.4-5], v5 [MQTT-3.8.4-5] [MQTT-3.8.4-6]"""
    access.deny("user", Action.SUBSCRIBE, "secret/#")
    subscriber = join("subscriber", version=version)
    filters = ["a", "secret/x", "$share/g/a", "b"]
    subscriber.send(Subscribe(9, [Subscription(name, 1) for name in filters]))
    answer = subscriber.only(Suback)
    assert isinstance(answer, Suback)
    codes = list(answer.reason_codes)
    if version == 4:
        assert codes == [1, 0x80, 1, 1]
    else:
        assert codes == [1, 0x87, 1, 1]
    assert set(subscriber.session.subscriptions) == {"a", "$share/g/a", "b"}


def test_messages_of_one_topic_keep_their_order(join: Join, version):
    """[MQTT-4.6.0-5] [MQTT-4.6.0-6], v5 [MQTT-4.6.0-5]"""
    subscriber = join("subscriber", version=version)
    subscriber.subscribe("a/#", 2)
    publisher = join("publisher", version=version)
    publisher.send(*[Publish("a", b"%d" % n, 1, packet_id=n + 1) for n in range(100)])
    assert all(isinstance(packet, Puback) for packet in publisher.received())
    assert [m.payload for m in subscriber.drain()] == [b"%d" % n for n in range(100)]


class FakeLink:
    """A link of a session inside the appliance."""

    def __init__(self) -> None:
        self.writable = True
        self.messages: list[tuple[str, bytes, int, int]] = []

    def publish(self, message, qos, packet_id, dup, retain, subscription_ids) -> None:
        self.messages.append((message.topic, message.payload, qos, packet_id))

    def pubrel(self, packet_id: int) -> None: ...

    def close(self, reason: ReasonCode, message: str) -> None: ...


def test_a_session_inside_the_appliance_publishes_and_receives(
    join: Join, broker: Broker, access: FakeAccess
):
    access.deny(None, Action.PUBLISH, "#")
    access.deny(None, Action.RECEIVE, "#")
    link = FakeLink()
    inside = broker.attach("_bridge", link)
    with pytest.raises(ValueError, match="_bridge"):
        broker.attach("_bridge", link)
    assert broker.subscribe(inside, Subscription("a/#", 1, no_local=True)) == (1, "")
    peer = join()
    peer.subscribe("a/#")
    assert broker.publish(Message("a/b", b"out"), inside) == ReasonCode.SUCCESS
    broker.flush()
    assert peer.payloads() == [b"out"]
    peer.publish("a/c", b"in", 1)
    assert link.messages == [("a/c", b"in", 1, 1)]
    assert inside.puback(1)
    broker.detach(inside)
    assert broker.publish(Message("a/b", b"late"), inside) == ReasonCode.SUCCESS  # only to `peer`
    assert "_bridge" not in broker.sessions
    assert peer.broker.subscription_count == 1


def test_a_client_cannot_have_the_id_of_a_session_inside_the_appliance(broker: Broker):
    broker.attach("_bridge", FakeLink())
    answer = Peer(broker).connect("_bridge")
    assert answer.reason_code == ReasonCode.CLIENT_IDENTIFIER_NOT_VALID


@pytest.mark.parametrize("version", [4, 5])
def test_a_client_cannot_have_an_id_that_may_be_needed_inside(broker: Broker, version: int):
    """Whether the part of the appliance is there now, or comes with the next configuration."""
    answer = Peer(broker, version).connect("_bridge")
    assert answer.reason_code == ReasonCode.CLIENT_IDENTIFIER_NOT_VALID
    assert not broker.sessions


def test_a_session_of_before_does_not_keep_the_appliance_from_its_id(
    broker: Broker, caplog: pytest.LogCaptureFixture
):
    """From a version that let clients have such ids."""
    session, _ = broker.connect(
        FakeLink(), Identity("ann", "_bridge"), clean_start=False, expiry=100, will=None
    )
    broker.subscribe(session, Subscription("a"))
    link = session.link
    assert link is not None
    broker.disconnect(session, link, publish_will=False)
    inside = broker.attach("_bridge", FakeLink())
    assert broker.sessions["_bridge"] is inside and broker.subscription_count == 0
    assert "'_bridge'" in caplog.text
    with pytest.raises(ValueError, match="already"):
        broker.attach("_bridge", FakeLink())


# --- retained messages


def retained(broker: Broker, version: int, topic_filter: str = "#", qos: int = 2) -> list[Publish]:
    """What a new subscriber is sent."""
    peer = Peer(broker, version)
    peer.connect("reader")
    peer.subscribe(topic_filter, qos)
    messages = peer.drain()
    peer.disconnect()
    return messages


def test_a_retained_message_is_kept_for_new_subscriptions(join: Join, broker: Broker, version):
    """[MQTT-3.3.1-5] [MQTT-3.3.1-6] [MQTT-3.3.1-8], v5 [MQTT-3.3.1-5] [MQTT-3.3.1-8]"""
    publisher = join("publisher", version=version)
    for qos, payload in ((0, b"zero"), (1, b"one"), (2, b"two")):
        publisher.publish("a", payload, qos, retain=True)  # replaces the one before
        (message,) = retained(broker, version)
        assert (message.payload, message.qos, message.retain) == (payload, qos, True)
    assert [message.qos for message in retained(broker, version, qos=1)] == [1]
    assert [message.qos for message in retained(broker, version, qos=0)] == [0]
    assert retained(broker, version, "b") == []


def test_an_empty_retained_message_clears_the_topic(join: Join, broker: Broker, version):
    """[MQTT-3.3.1-10] [MQTT-3.3.1-11], v5 [MQTT-3.3.1-6] [MQTT-3.3.1-7]"""
    publisher = join("publisher", version=version)
    subscriber = join("subscriber", version=version)
    subscriber.subscribe("a")
    publisher.publish("a", b"x", retain=True)
    publisher.publish("a", b"", retain=True)
    assert retained(broker, version) == []
    assert (len(broker.retained), broker.retained.bytes) == (0, 0)
    assert subscriber.payloads() == [b"x", b""]  # it goes to who listens like any other
    code = publisher.publish("a", b"", 1, retain=True)  # and once more, with nothing there
    assert code == ReasonCode.SUCCESS and broker.retained.bytes == 0
    assert subscriber.payloads() == [b""]


def test_a_message_without_retain_leaves_the_retained_one(join: Join, broker: Broker, version):
    """[MQTT-3.3.1-12], v5 [MQTT-3.3.1-8]"""
    publisher = join("publisher", version=version)
    publisher.publish("a", b"kept", retain=True)
    publisher.publish("a", b"passing")
    publisher.publish("a", b"")
    assert [message.payload for message in retained(broker, version)] == [b"kept"]


def test_live_messages_have_no_retain_flag_unless_asked_for(join: Join, version):
    """[MQTT-3.3.1-9], v5 [MQTT-3.3.1-12] [MQTT-3.3.1-13]"""
    plain = join("plain", version=version)
    plain.subscribe("a")
    as_published = join("as published")
    as_published.subscribe("a", retain_as_published=True)
    publisher = join("publisher", version=version)
    publisher.publish("a", b"1", retain=True)
    publisher.publish("a", b"2")
    assert [message.retain for message in plain.messages()] == [False, False]
    assert [message.retain for message in as_published.messages()] == [True, False]


@pytest.mark.parametrize(
    ("handling", "first", "again"),
    [(0, [b"x"], [b"x"]), (1, [b"x"], []), (2, [], [])],
)
def test_retain_handling(join: Join, handling, first, again):
    """v5 [MQTT-3.3.1-9] [MQTT-3.3.1-10] [MQTT-3.3.1-11]"""
    join("publisher").publish("a", b"x", retain=True)
    subscriber = join("subscriber")
    subscriber.subscribe("a", retain_handling=handling)
    assert subscriber.payloads() == first
    subscriber.subscribe("a", retain_handling=handling)
    assert subscriber.payloads() == again
    subscriber.unsubscribe("a")
    subscriber.subscribe("a", retain_handling=handling)  # which is new once more
    assert subscriber.payloads() == first


def test_subscribing_again_sends_retained_messages_again_in_3_1_1(join: Join):
    """[MQTT-3.8.4-3]"""
    join("publisher").publish("a", b"x", retain=True)
    subscriber = join("subscriber", version=4)
    for _ in range(2):
        subscriber.subscribe("a")
        assert subscriber.payloads() == [b"x"]


def test_retained_messages_come_behind_the_suback_and_with_its_identifier(join: Join):
    """[MQTT-3.8.4-1]; v5 [MQTT-3.3.4-3]"""
    publisher = join("publisher")
    for topic in ("a/1", "a/2", "b"):
        publisher.publish(topic, topic.encode(), retain=True)
    subscriber = join("subscriber")
    properties = {Property.SUBSCRIPTION_IDENTIFIER: [5]}
    subscriber.send(Subscribe(1, [Subscription("a/+"), Subscription("b")], properties))
    suback, *messages = subscriber.received()
    assert isinstance(suback, Suback)
    assert [message.topic for message in messages] == ["a/1", "a/2", "b"]  # type: ignore[union-attr]
    assert all(message.properties == properties for message in messages)  # type: ignore[union-attr]


def test_a_retained_message_keeps_its_properties(join: Join, broker: Broker):
    """v5 [MQTT-3.3.2-4] [MQTT-3.3.2-15] [MQTT-3.3.2-16] [MQTT-3.3.2-17] [MQTT-3.3.2-20]"""
    properties = {
        Property.PAYLOAD_FORMAT_INDICATOR: 1,
        Property.CONTENT_TYPE: "text/plain",
        Property.RESPONSE_TOPIC: "answers",
        Property.CORRELATION_DATA: b"\0\1",
        Property.USER_PROPERTY: [("b", "1"), ("a", "2"), ("b", "1")],
    }
    join("publisher").publish("a", b"x", 1, retain=True, properties=dict(properties))
    (message,) = retained(broker, 5)
    assert message.properties == properties


@pytest.mark.parametrize("qos", [1, 2])
def test_more_retained_messages_than_the_window_all_arrive(join: Join, version, qos):
    """v5 [MQTT-3.3.4-9]; the rest waits for the acknowledgements."""
    publisher = join("publisher")
    expected = {f"a/{n}": b"%d" % n for n in range(75)}
    for topic, payload in expected.items():
        publisher.publish(topic, payload, qos, retain=True)
    subscriber = join("subscriber", version=version)
    subscriber.subscribe("a/+", qos)
    first = subscriber.messages()
    assert len(first) == 20
    publisher.publish("a/0", b"newer", qos)  # waits behind them
    subscriber.acknowledge(*first)
    messages = first + subscriber.drain()
    assert {m.topic: m.payload for m in messages if m.retain} == expected
    assert [m.payload for m in messages if m.topic == "a/0"][-1] == b"newer"
    assert all(m.qos == qos for m in messages)


@pytest.mark.parametrize("limits", [Limits(retained_messages=2, user=ALONE)])
def test_the_number_of_retained_messages_is_bounded(join: Join, broker: Broker):
    publisher = join("publisher")
    subscriber = join("subscriber")
    assert publisher.publish("a", b"1", 1, retain=True) == ReasonCode.NO_MATCHING_SUBSCRIBERS
    publisher.publish("b", b"1", 1, retain=True)
    assert publisher.publish("c", b"1", 1, retain=True) == ReasonCode.QUOTA_EXCEEDED
    subscriber.subscribe("#", 0, retain_handling=2)
    publisher.publish("a", b"2", 1, retain=True)  # replacing is no growth
    assert {m.topic: m.payload for m in retained(broker, 5)} == {"a": b"2", "b": b"1"}
    publisher.publish("a", b"", 1, retain=True)
    publisher.publish("c", b"3", 1, retain=True)
    assert {m.topic: m.payload for m in retained(broker, 5)} == {"b": b"1", "c": b"3"}
    assert drops(broker) == {"not_retained": 1}


@pytest.mark.parametrize("limits", [Limits(retained_messages=1, user=ALONE)])
def test_who_is_there_gets_a_message_that_cannot_be_retained(join: Join, broker: Broker):
    publisher = join("publisher")
    subscriber = join("subscriber")
    subscriber.subscribe("#", 1)
    publisher.publish("a", b"1", 1, retain=True)
    assert publisher.publish("alarm", b"fire", 1, retain=True) == ReasonCode.QUOTA_EXCEEDED
    assert [(m.topic, m.payload) for m in subscriber.messages()] == [
        ("a", b"1"),
        ("alarm", b"fire"),
    ]
    assert len(broker.retained) == 1


@pytest.mark.parametrize("limits", [Limits(retained_bytes=4200, user=ALONE)])
def test_the_bytes_of_retained_messages_are_bounded(join: Join, broker: Broker):
    publisher = join("publisher")
    assert publisher.publish("a", bytes(3000), 1, retain=True) < 0x80
    assert publisher.publish("b", bytes(3000), 1, retain=True) == ReasonCode.QUOTA_EXCEEDED
    assert publisher.publish("a", bytes(3400), 1, retain=True) < 0x80
    assert publisher.publish("a", bytes(4000), 1, retain=True) == ReasonCode.QUOTA_EXCEEDED
    assert [len(message.payload) for message in retained(broker, 5)] == [3400]
    user_properties = {Property.USER_PROPERTY: [("k", "v")] * 1000}
    code = publisher.publish("a", b"x", 1, retain=True, properties=user_properties)
    assert code == ReasonCode.QUOTA_EXCEEDED, "properties are bytes as well"


# --- message expiry


def test_the_time_that_is_left_is_sent(join: Join, broker: Broker, version):
    """v5 [MQTT-3.3.2-6]"""
    publisher = join("publisher")
    publisher.publish("a", b"x", 1, retain=True, properties={MESSAGE_EXPIRY: 100})
    broker.tick(broker.now + 30)
    (message,) = retained(broker, version)
    assert message.properties == ({MESSAGE_EXPIRY: 70} if version == 5 else None)


def test_an_expired_retained_message_is_gone(join: Join, broker: Broker):
    """v5 [MQTT-3.3.2-5]"""
    join("publisher").publish("a", b"x", retain=True, properties={MESSAGE_EXPIRY: 100})
    broker.tick(broker.now + 100)
    assert retained(broker, 5) == []
    assert (len(broker.retained), broker.retained.bytes) == (0, 0)


def test_an_expired_queued_message_is_not_sent(join: Join, broker: Broker):
    """v5 [MQTT-3.3.2-5]"""
    subscriber = join("subscriber", **lasting(5))
    subscriber.subscribe("a", 1)
    subscriber.lose()
    publisher = join("publisher")
    publisher.publish("a", b"short", 1, properties={MESSAGE_EXPIRY: 10})
    publisher.publish("a", b"long", 1, properties={MESSAGE_EXPIRY: 100})
    publisher.publish("a", b"for ever", 1)
    broker.tick(broker.now + 10)
    subscriber = join("subscriber", **lasting(5))
    messages = subscriber.drain()
    assert [m.payload for m in messages] == [b"long", b"for ever"]
    assert messages[0].properties == {MESSAGE_EXPIRY: 90}


def test_an_expired_message_for_a_slow_client_is_not_sent(join: Join, broker: Broker):
    """v5 [MQTT-3.3.2-5], QoS 0 too"""
    subscriber = join("subscriber")
    subscriber.subscribe("#")
    subscriber.slow()
    publisher = join("publisher")
    publisher.publish("a", b"short", properties={MESSAGE_EXPIRY: 10})
    publisher.publish("b", b"long", properties={MESSAGE_EXPIRY: 100})
    broker.tick(broker.now + 50)
    subscriber.fast()
    (message,) = subscriber.messages()
    assert (message.payload, message.properties) == (b"long", {MESSAGE_EXPIRY: 50})


def test_a_will_expires_from_when_it_was_published(join: Join, broker: Broker):
    """v5 section 3.1.3.2.4: the interval begins when the server publishes the will."""
    will = Will("w", b"x", 1, True, {MESSAGE_EXPIRY: 100})
    peer = join("peer", will=will)
    broker.tick(broker.now + 1000)
    peer.lose()
    broker.tick(broker.now + 40)
    (message,) = retained(broker, 5)
    assert message.properties == {MESSAGE_EXPIRY: 60}


# --- sessions


def test_a_clean_session_ends_with_its_connection(join: Join, broker: Broker, version):
    """[MQTT-3.1.2-6], v5 section 3.1.2.11.2: an expiry of 0"""
    peer = join(version=version)
    peer.subscribe("a", 1)
    assert broker.subscription_count == 1
    peer.lose()
    assert broker.sessions == {}
    assert broker.subscription_count == 0


def test_a_session_goes_on_with_what_it_missed(join: Join, broker: Broker, version):
    """[MQTT-3.1.2-4] [MQTT-3.1.2-5] [MQTT-3.2.2-2], v5 [MQTT-3.1.2-5] [MQTT-3.2.2-3]"""
    peer = Peer(broker, version)
    assert not peer.connect(**lasting(version)).session_present
    peer.subscribe("a", 1)
    peer.disconnect()
    publisher = join("publisher")
    for qos in (0, 1, 2):
        publisher.publish("a", b"%d" % qos, qos)
    back = Peer(broker, version)
    assert back.connect(**lasting(version)).session_present
    assert [(m.payload, m.qos, m.dup) for m in back.drain()] == [
        (b"1", 1, False),
        (b"2", 1, False),
    ]


def test_clean_start_discards_the_session(join: Join, broker: Broker, version):
    """[MQTT-3.1.2-6] [MQTT-3.2.2-1], v5 [MQTT-3.1.2-4] [MQTT-3.2.2-2]"""
    peer = join(version=version, **lasting(version))
    peer.subscribe("a", 1)
    peer.lose()
    join("publisher").publish("a", b"x", 1)
    back = Peer(broker, version)
    assert not back.connect().session_present
    assert back.drain() == []
    assert broker.subscription_count == 0


def test_a_session_of_3_1_1_goes_on_in_5_0_and_back(join: Join):
    join(version=4, **lasting(4)).subscribe("a", 1)
    peer = join(version=5, **lasting(5))
    join("publisher").publish("a", b"1", 1)
    assert peer.payloads() == [b"1"]  # not acknowledged
    peer = join(version=4, **lasting(4))
    (message,) = peer.messages()
    assert (message.payload, message.dup, message.properties) == (b"1", True, None)


def test_a_session_expires(join: Join, broker: Broker, store: FakeStore):
    """v5 section 3.1.2.11.2; [MQTT-4.1.0-1]"""
    peer = join(**lasting(5, 100))
    peer.subscribe("a", 1)
    broker.tick(broker.now + 1000)  # while connected, nothing expires
    peer.lose()
    join("publisher").publish("a", bytes(1000), 1)
    broker.tick(broker.now + 99)
    assert "client" in broker.sessions
    broker.tick(broker.now + 1)
    assert "client" not in broker.sessions
    assert broker.counters.sessions_expired == 1
    assert waiting_bytes(broker) == 0
    assert "client" not in store.sessions
    back = Peer(broker)
    assert not back.connect(**lasting(5, 100)).session_present


def test_a_session_that_has_expired_between_two_ticks_is_not_continued(broker: Broker, join: Join):
    peer = join(**lasting(5, 100))
    peer.lose()
    broker.accounting.now += 100
    assert not Peer(broker).connect(**lasting(5)).session_present


def test_a_session_that_is_taken_up_again_does_not_expire(join: Join, broker: Broker):
    peer = join(**lasting(5, 100))
    peer.lose()
    broker.tick(broker.now + 50)
    peer = join(**lasting(5, 100))
    broker.tick(broker.now + 500)
    peer.lose()
    broker.tick(broker.now + 99)
    assert "client" in broker.sessions


@pytest.mark.parametrize("limits", [Limits(session_expiry=500)])
@pytest.mark.parametrize("asked", [501, 0xFFFF_FFFF])
def test_the_session_expiry_is_capped_and_that_is_told(broker: Broker, asked):
    """v5 section 3.2.2.3.2: the server says which interval it uses."""
    peer = Peer(broker)
    answer = peer.connect(properties={EXPIRY: asked}, clean=False)
    assert answer.properties is not None
    assert answer.properties[EXPIRY] == 500
    peer.lose()
    broker.tick(broker.now + 500)
    assert broker.sessions == {}


@pytest.mark.parametrize("limits", [Limits(session_expiry=500)])
def test_a_session_of_3_1_1_expires_too(broker: Broker, join: Join):
    """Section 3.1.2.4 of 3.1.1 lets an administrator limit how long sessions are kept."""
    join(version=4, **lasting(4)).lose()
    broker.tick(broker.now + 499)
    assert "client" in broker.sessions
    broker.tick(broker.now + 1)
    assert broker.sessions == {}


def test_disconnect_may_change_the_expiry(join: Join, broker: Broker, store: FakeStore):
    """v5 section 3.14.2.2.2"""
    join(**lasting(5, 100)).disconnect(0, {EXPIRY: 1000})
    broker.tick(broker.now + 999)
    assert "client" in broker.sessions
    peer = join(**lasting(5, 100))
    assert peer.session.expiry == 100
    peer.disconnect(0, {EXPIRY: 0})
    assert broker.sessions == {}
    assert store.sessions == set(), "nothing of it is kept"


def test_disconnect_may_not_give_an_expiry_to_a_session_without(join: Join, broker: Broker):
    """v5 [MQTT-3.14.2-2]"""
    peer = join()
    peer.disconnect(0, {EXPIRY: 10})
    assert peer.farewell() == ReasonCode.PROTOCOL_ERROR
    assert broker.sessions == {}


def test_an_expiry_of_0_at_a_new_connection_ends_the_session_with_it(
    join: Join, broker: Broker, store: FakeStore
):
    join(**lasting(5)).lose()
    join(clean=False).lose()
    assert broker.sessions == {}
    assert store.sessions == set(), "nothing of it is kept"


@pytest.mark.parametrize("limits", [Limits(sessions=3)])
def test_the_number_of_sessions_is_bounded(join: Join, broker: Broker):
    for name in "abc":
        join(name, **lasting(5))
    refused = Peer(broker)
    assert refused.connect("d").reason_code == ReasonCode.QUOTA_EXCEEDED
    assert refused.transport.closed
    join("a")  # in place of its own


@pytest.mark.lengthy
def test_connecting_again_and_again_does_not_make_the_broker_grow(join: Join, broker: Broker):
    """Rule 3 of the design; deadlines that no longer hold are not kept for days."""
    for _ in range(3000):
        will = Will("w", b"", properties={Property.WILL_DELAY_INTERVAL: 5})
        join(**lasting(5, 100_000), will=will).lose()
    assert len(broker._deadlines) < 500


# --- take-over


def test_a_second_connection_takes_over(join: Join, broker: Broker, version):
    """[MQTT-3.1.4-2], v5 [MQTT-3.1.4-3]"""
    first = join(version=version, **lasting(version))
    first.subscribe("a", 1)
    second = Peer(broker, version)
    assert second.connect(**lasting(version)).session_present
    if version == 5:
        assert first.farewell() == ReasonCode.SESSION_TAKEN_OVER
    else:
        assert first.transport.closed and first.received() == []
    join("publisher").publish("a", b"x", 1)
    assert [m.payload for m in second.drain()] == [b"x"]
    first.lose()  # the network notices later
    assert broker.sessions["client"].link is second.client.output
    assert len(broker.clients) == 2


def test_a_clean_session_that_is_taken_over_is_not_continued(join: Join, broker: Broker, version):
    join(version=version).subscribe("a")
    second = Peer(broker, version)
    answer = second.connect(clean=False, properties=None)
    assert not answer.session_present
    assert broker.subscription_count == 0


@pytest.mark.parametrize("thief", ["thief", None])
def test_another_user_does_not_get_the_session(join: Join, broker: Broker, version, thief):
    """Rule 1 of the design: a client id belongs to the user that created its session."""
    will = Will("will", b"x")
    owner = join(version=version, will=will, **lasting(version))
    owner.subscribe("a", 1)
    watcher = join("watcher")
    watcher.subscribe("will")
    for clean in (True, False):
        peer = Peer(broker, version)
        answer = peer.connect(user=thief, clean=clean)
        assert answer.reason_code == ReasonCode.CLIENT_IDENTIFIER_NOT_VALID
        assert peer.transport.closed
    assert not owner.transport.closed
    owner.lose()
    for clean in (True, False):
        assert Peer(broker, version).connect(user=thief, clean=clean).reason_code >= 0x80
    join("publisher").publish("a", b"x", 1)
    back = Peer(broker, version)
    assert back.connect(**lasting(version)).session_present
    assert [message.payload for message in back.drain()] == [b"x"]
    assert watcher.payloads() == [b"x"]  # once, for the lost connection


def test_nothing_changes_before_the_client_is_known(join: Join, broker: Broker, version):
    """[MQTT-3.1.4-2], rule 1 of the design"""
    owner = join(version=version, **lasting(version))
    owner.subscribe("a", 1)
    stranger = Peer(broker, version)
    will = Will("a", b"from a stranger", 1, True)
    stranger.say_connect(user="user", clean=True, will=will)
    stranger.send(Subscribe(1, [Subscription("#")]), Publish("a", b"from a stranger", retain=True))
    assert stranger.received() == []
    assert not owner.transport.closed
    stranger.client.refuse(ReasonCode.NOT_AUTHORIZED, "wrong password")
    broker.flush()
    answer = stranger.only(Connack)
    assert answer == Connack(False, ReasonCode.NOT_AUTHORIZED)
    assert stranger.transport.closed
    stranger.lose()
    assert not owner.transport.closed
    assert owner.received() == []
    assert set(broker.sessions) == {"client"}
    assert len(broker.retained) == 0
    assert broker.counters.connects_refused == 1


# --- wills


@pytest.mark.parametrize("qos", [0, 1, 2])
@pytest.mark.parametrize("retain", [False, True])
def test_a_will_is_published_when_the_connection_is_lost(
    join: Join, broker: Broker, version, qos, retain
):
    """[MQTT-3.1.2-8] [MQTT-3.1.2-16] [MQTT-3.1.2-17], v5 [MQTT-3.1.2-14] [MQTT-3.1.2-15]"""
    watcher = join("watcher", version=version)
    watcher.subscribe("w", 2)
    peer = join(version=version, will=Will("w", b"gone", qos, retain))
    peer.lose()
    (message,) = watcher.drain()
    assert (message.payload, message.qos, message.retain) == (b"gone", qos, False)
    assert [m.qos for m in retained(broker, version)] == ([qos] if retain else [])


def test_a_normal_disconnect_discards_the_will(join: Join, version):
    """[MQTT-3.1.2-10] [MQTT-3.14.4-3], v5 [MQTT-3.14.4-3]"""
    watcher = join("watcher")
    watcher.subscribe("w")
    peer = join(version=version, will=Will("w", b"gone"), **lasting(version))
    peer.disconnect()
    peer.lose()
    join(version=version, **lasting(version)).lose()  # and it does not come back
    assert watcher.payloads() == []


@pytest.mark.parametrize("code", [0x04, 0x80, 0x93])
def test_a_disconnect_with_another_code_publishes_the_will(join: Join, code):
    """v5 section 3.14.2.1; [MQTT-3.1.2-8]"""
    watcher = join("watcher")
    watcher.subscribe("w")
    join(will=Will("w", b"gone")).disconnect(code)
    assert watcher.payloads() == [b"gone"]


def test_breaking_the_protocol_publishes_the_will(join: Join, version):
    """[MQTT-3.1.2-8]"""
    watcher = join("watcher")
    watcher.subscribe("w")
    peer = join(version=version, will=Will("w", b"gone"))
    peer.send(b"\x00\x00")
    assert peer.transport.closed
    assert watcher.payloads() == [b"gone"]


def test_a_will_is_published_at_a_take_over(join: Join, version):
    """v5 section 3.1.4: the connection was closed by the server, without DISCONNECT 0x00"""
    watcher = join("watcher")
    watcher.subscribe("w")
    join(version=version, will=Will("w", b"gone"), **lasting(version))
    join(version=version, **lasting(version))
    assert watcher.payloads() == [b"gone"]


def test_the_rules_are_asked_when_the_will_is_published(join: Join, access: FakeAccess, version):
    """Rule 5 of the design"""
    watcher = join("watcher")
    watcher.subscribe("w/#")
    first = join("first", version=version, user="bad", will=Will("w/1", b"gone"))
    second = join("second", version=version, user="good", will=Will("w/2", b"gone"))
    access.deny("bad", Action.PUBLISH, "w/#")
    watcher.broker.rules_changed()
    first.lose()
    second.lose()
    assert [message.topic for message in watcher.messages()] == ["w/2"]
    assert watcher.broker.counters.publish_refused == 1


def delayed(seconds: int) -> Will:
    return Will("w", b"gone", 1, False, {Property.WILL_DELAY_INTERVAL: seconds})


def test_a_will_waits_for_its_delay(join: Join, broker: Broker):
    """v5 [MQTT-3.1.3-9], section 3.1.3.2.2"""
    watcher = join("watcher")
    watcher.subscribe("w")
    join(**lasting(5, 1000), will=delayed(50)).lose()
    broker.tick(broker.now + 49)
    assert watcher.messages() == []
    broker.tick(broker.now + 1)
    (message,) = watcher.messages()
    assert (message.payload, message.properties) == (b"gone", None)  # the delay is not forwarded
    broker.tick(broker.now + 1000)
    assert watcher.messages() == []


def test_a_new_connection_in_time_keeps_the_will_back(join: Join, broker: Broker):
    """v5 [MQTT-3.1.3-9]"""
    watcher = join("watcher")
    watcher.subscribe("w")
    join(**lasting(5, 1000), will=delayed(50)).lose()
    broker.tick(broker.now + 49)
    join(**lasting(5, 1000))
    broker.tick(broker.now + 100)
    assert watcher.messages() == []


@pytest.mark.parametrize("way", ["expiry", "clean start", "no expiry"])
def test_a_delayed_will_is_published_at_the_sessions_end(join: Join, broker: Broker, way):
    """v5 [MQTT-3.1.2-10] (published by whichever comes first), section 3.1.3.2.2"""
    watcher = join("watcher")
    watcher.subscribe("w")
    if way == "no expiry":
        join(will=delayed(5000)).lose()
    else:
        join(**lasting(5, 1000), will=delayed(5000)).lose()
        assert watcher.messages() == []
        if way == "expiry":
            broker.tick(broker.now + 1000)
        else:
            join()
    assert [m.payload for m in watcher.messages()] == [b"gone"]


def test_stopping_publishes_no_wills_and_keeps_sessions(join: Join, broker: Broker):
    """CONVENTIONS: wills are not sent, sessions are kept"""
    watcher = join("watcher", **lasting(5))
    watcher.subscribe("w", 1)
    peer = join(will=Will("w", b"gone", 1), **lasting(5))
    broker.close(lambda session: session.close_link(ReasonCode.SERVER_SHUTTING_DOWN, "stop"))
    assert peer.farewell() == ReasonCode.SERVER_SHUTTING_DOWN
    assert set(broker.sessions) == {"watcher", "client"}
    assert not broker.sessions["watcher"].queue


# --- access


@pytest.mark.parametrize("qos", [0, 1, 2])
def test_publishing_is_refused(join: Join, access: FakeAccess, broker: Broker, version, qos):
    """[MQTT-3.3.5-2], v5 sections 3.4.2.1 and 3.5.2.1: 0x87; 3.1.1 is acknowledged"""
    access.deny("user", Action.PUBLISH, "forbidden/#")
    watcher = join("watcher")
    watcher.subscribe("#")
    peer = join(version=version)
    code = peer.publish("forbidden/x", b"x", qos, retain=True)
    assert code == (ReasonCode.NOT_AUTHORIZED if version == 5 and qos else 0)
    assert not peer.transport.closed
    assert watcher.messages() == [] and len(broker.retained) == 0
    assert broker.counters.publish_refused == 1
    peer.publish("allowed", b"x", qos)
    assert watcher.payloads() == [b"x"]


def test_a_message_is_not_delivered_to_who_may_not_read_it(join: Join, access: FakeAccess):
    """Rule 5: at delivery, live and retained"""
    access.deny("blind", Action.RECEIVE, "a/secret")
    join("publisher").publish("a/secret", b"x", retain=True)
    blind, other = join("blind", user="blind"), join("other")
    for peer in (blind, other):
        assert peer.subscribe("a/+") == 0
    join("publisher").publish("a/secret", b"y")
    assert blind.payloads() == []
    assert other.payloads() == [b"x", b"y"]


def test_changed_rules_hold_at_once(join: Join, access: FakeAccess, broker: Broker):
    publisher, subscriber = join("publisher", user="writer"), join("subscriber", user="reader")
    subscriber.subscribe("#")
    publisher.publish("a", b"1", 1)
    access.deny("writer", Action.PUBLISH, "a")
    broker.rules_changed()
    assert publisher.publish("a", b"2", 1) == ReasonCode.NOT_AUTHORIZED
    publisher.publish("b", b"3")
    access.deny("reader", Action.RECEIVE, "b")
    broker.rules_changed()
    publisher.publish("b", b"4")
    assert subscriber.payloads() == [b"1", b"3"]


def test_changed_rules_hold_for_what_waits(join: Join, access: FakeAccess, broker: Broker):
    """Rule 5: checked against the rules in force when it is delivered"""
    subscriber = join("subscriber", user="reader", **lasting(5))
    subscriber.subscribe("#", 1)
    publisher = join("publisher")
    subscriber.slow()
    for topic in ("secret", "open"):
        for qos in (0, 1):
            publisher.publish(topic, topic.encode(), qos)
    access.deny("reader", Action.RECEIVE, "secret")
    broker.rules_changed()
    subscriber.fast()
    assert [m.topic for m in subscriber.drain()] == ["open", "open"]
    assert drops(broker) == {"forbidden": 2}


def test_changed_rules_hold_for_what_is_in_flight_to_an_absent_client(
    join: Join, access: FakeAccess, broker: Broker, store: FakeStore
):
    """Rule 5: it would be delivered, for all we know the first time, when the client is back."""
    subscriber = join("subscriber", user="reader", **lasting(5))
    subscriber.subscribe("#", 2)
    publisher = join("publisher")
    for topic in ("secret", "open"):
        publisher.publish(topic, topic.encode(), 1)
        publisher.publish(topic, topic.encode(), 2)
    subscriber.lose()
    access.deny("reader", Action.RECEIVE, "secret")
    broker.rules_changed()
    subscriber = join("subscriber", user="reader", **lasting(5))
    assert [m.topic for m in subscriber.drain()] == ["open", "open"]
    assert not store.owed


def test_changed_rules_hold_for_retained_messages_under_way(
    join: Join, access: FakeAccess, broker: Broker
):
    publisher = join("publisher")
    topics = [f"{name}/{n}" for n in range(30) for name in ("open", "secret")]
    for topic in topics:
        publisher.publish(topic, b"x", 1, retain=True)
    subscriber = join("subscriber", user="reader")
    subscriber.subscribe("#", 1)
    sent = subscriber.messages()
    access.deny("reader", Action.RECEIVE, "secret/#")
    broker.rules_changed()
    subscriber.acknowledge(*sent)
    rest = subscriber.drain()
    assert all(message.topic.startswith("open/") for message in rest)
    assert {m.topic for m in sent + rest} >= {t for t in topics if t.startswith("open/")}


def test_a_held_qos_2_message_is_checked_when_it_is_released(join: Join, access: FakeAccess):
    watcher = join("watcher")
    watcher.subscribe("#")
    peer = join(user="writer")
    peer.send(Publish("a", b"x", 2, packet_id=1))
    peer.only(Pubrec)
    access.deny("writer", Action.PUBLISH, "a")
    peer.broker.rules_changed()
    peer.send(Pubrel(1))
    assert watcher.payloads() == []


# --- bounds


@pytest.mark.parametrize("limits", [Limits(subscriptions=3)])
def test_the_number_of_subscriptions_is_bounded(join: Join, version):
    """v5 section 3.9.3: 0x97"""
    peer = join(version=version)
    for name in "abc":
        assert peer.subscribe(name) == 0
    assert peer.subscribe("d") == (0x97 if version == 5 else 0x80)
    assert peer.subscribe("a", 1) == 1  # again, which is no more
    peer.unsubscribe("b")
    assert peer.subscribe("d") == 0


@pytest.mark.parametrize("limits", [Limits(topic_levels=4)])
@pytest.mark.parametrize("shared", ["", "$share/g/"])
def test_the_levels_of_topics_and_filters_are_bounded(join: Join, shared):
    """More is malformed, as for mosquitto; the group of a shared subscription does not count"""
    peer = join("peer")
    assert peer.subscribe(f"{shared}a/b/c/d") == 0
    assert peer.publish("a/b/c/d", b"", 1) == 0
    peer.received()
    peer.send(Publish("a/b/c/d/e", b"", 1, packet_id=9))
    assert peer.farewell() == ReasonCode.MALFORMED_PACKET
    other = join("other")
    other.send(Subscribe(1, [Subscription(f"{shared}a/b/c/d/e")]))
    assert other.farewell() == ReasonCode.MALFORMED_PACKET


@pytest.mark.parametrize("limits", [Limits(queue_messages=5, inflight=2)])
def test_the_queue_is_bounded_in_messages(join: Join, broker: Broker):
    """The newest are dropped, and counted; v5: 0x97 when nobody else could have it."""
    subscriber = join("subscriber", **lasting(5))
    subscriber.subscribe("a", 1)
    publisher = join("publisher")
    codes = [publisher.publish("a", b"%d" % n, 1) for n in range(9)]
    assert codes == [0] * 7 + [ReasonCode.QUOTA_EXCEEDED] * 2
    assert drops(broker) == {"queue_full": 2}
    assert [m.payload for m in subscriber.drain()] == [b"%d" % n for n in range(7)]
    subscriber.lose()
    codes = [publisher.publish("a", b"%d" % n, 2) for n in range(9)]
    subscriber = join("subscriber", **lasting(5))
    assert len(subscriber.drain()) == 5


@pytest.mark.parametrize("limits", [Limits(queue_bytes=10_000)])
def test_the_queue_is_bounded_in_bytes(join: Join, broker: Broker):
    subscriber = join("subscriber", **lasting(5))
    subscriber.subscribe("#", 1)
    subscriber.lose()
    other = join("other", **lasting(5))
    other.subscribe("#", 1)
    publisher = join("publisher")
    for _ in range(5):
        publisher.publish("a", bytes(3000), 1)
        other.drain()
    session = broker.sessions["subscriber"]
    assert len(session.queue) == 2 and session.bytes <= 10_000
    properties = {Property.USER_PROPERTY: [("key" * 10, "value")] * 1000}
    publisher.publish("a", b"", 1, properties=properties)
    assert len(session.queue) == 2, "properties are bytes as well"


@pytest.mark.parametrize("limits", [Limits(memory=12_000, user=ALONE)])
def test_all_queues_together_are_bounded(join: Join, broker: Broker):
    for name in "abcd":
        peer = join(name, **lasting(5))
        peer.subscribe("#", 1)
        peer.lose()
    publisher = join("publisher")
    for _ in range(3):
        publisher.publish("t", bytes(2000), 1)
    assert broker.accounting.queued_bytes <= 12_000
    assert sum(len(session.queue) for session in broker.sessions.values()) == 3
    # QoS 2 that is held until its PUBREL counts as well.
    assert publisher.publish("t", bytes(3000), 2) == ReasonCode.QUOTA_EXCEEDED


def test_a_slow_client_gets_the_newest_of_each_topic(join: Join, broker: Broker):
    """CONVENTIONS: keep latest"""
    subscriber = join("subscriber")
    subscriber.subscribe("#")
    publisher = join("publisher")
    subscriber.slow()
    for n in range(10):
        publisher.publish("a", b"a%d" % n)
        publisher.publish("b", b"b%d" % n)
    assert subscriber.messages() == []
    subscriber.fast()
    assert subscriber.payloads() == [b"a9", b"b9"]
    assert broker.counters.publish_dropped == 18
    publisher.publish("a", b"now")
    assert subscriber.payloads() == [b"now"]
    assert waiting_bytes(broker) == 0


def test_what_a_slow_client_missed_ends_with_its_connection(join: Join, broker: Broker, version):
    """QoS 0 is not kept for who is not there, nor for when it is back."""
    subscriber = join("subscriber", version=version, **lasting(version))
    subscriber.subscribe("#")
    subscriber.slow()
    join("publisher").publish("a", b"missed")
    subscriber.lose()
    assert waiting_bytes(broker) == 0
    subscriber = join("subscriber", version=version, **lasting(version))
    subscriber.fast()
    assert subscriber.messages() == []


@pytest.mark.parametrize("limits", [Limits(queue_messages=3, queue_bytes=6000)])
def test_what_waits_for_a_slow_client_is_bounded(join: Join, broker: Broker):
    subscriber = join("subscriber")
    subscriber.subscribe("#")
    subscriber.slow()
    publisher = join("publisher")
    for n in range(10):
        publisher.publish(f"t/{n}", b"x")
    assert len(subscriber.session.latest) == 3
    publisher.publish("t/0", bytes(5000))  # has no room beside the others
    assert subscriber.session.bytes <= 6000
    subscriber.fast()
    assert {m.topic for m in subscriber.messages()} <= {"t/0", "t/1", "t/2"}


def test_a_slow_client_does_not_delay_another(join: Join):
    """Rule 3"""
    slow, quick = join("slow"), join("quick")
    for peer in (slow, quick):
        peer.subscribe("#", 1)
    slow.slow()
    publisher = join("publisher")
    for n in range(50):
        publisher.publish("a", b"%d" % n, n % 2)
        quick.acknowledge(*quick.messages())
    assert not quick.session.queue
    assert len(slow.session.queue) == 25


def test_subscribing_again_and_again_does_not_make_the_broker_grow(join: Join, broker: Broker):
    """Rule 3: who asks for retained messages and does not read them gets them once, later."""
    publisher = join("publisher")
    for n in range(100):
        publisher.publish(f"a/{n}", bytes(1000), retain=True)
    subscriber = join("subscriber", version=4)
    subscriber.slow()
    for n in range(100):
        subscriber.send(Subscribe(1, [Subscription("#")] * 100))
        publisher.publish("a/0", b"%d" % n, retain=True)
    assert len(subscriber.session.replays) <= 200
    subscriber.received()
    subscriber.fast()
    sent = subscriber.messages()
    assert len(sent) <= 300
    assert [m.payload for m in sent if m.topic == "a/0"][-1] == b"99"


def test_one_chunk_of_subscribes_does_not_make_the_broker_grow(join: Join, broker: Broker):
    """Rule 3: the retained messages go out as far as the network takes them."""
    publisher = join("publisher")
    publisher.publish("a", bytes(1_000_000), retain=True)
    subscriber = join("subscriber", version=4)
    largest = 0
    write = subscriber.transport.write

    def watch(chunks: list[bytes]) -> None:
        nonlocal largest
        largest = max(largest, sum(map(len, chunks)))
        write(chunks)

    subscriber.transport.write = watch  # type: ignore[method-assign]
    subscriber.send(*[Subscribe(1, [Subscription("#")])] * 200)
    assert largest < 10_000_000


@pytest.mark.lengthy
def test_routes_of_invented_topics_are_not_kept_for_ever(join: Join):
    """Rule 3: the cache of a client is bounded, in routes and in bytes."""
    publisher = join("publisher")
    for n in range(3000):
        publisher.publish(f"{n}/" + "x" * 10_000)
    routes = publisher.session.routes
    assert len(routes) <= 1024
    assert sum(map(len, routes)) < 2_000_000
    publisher = join("publisher", **lasting(5))
    publisher.publish("a")
    session = publisher.session
    publisher.lose()
    assert not session.routes


# --- what the store and observers are told


def test_the_store_knows_the_subscriptions_of_lasting_sessions(join: Join, store: FakeStore):
    """Port Store"""
    peer, other = join("peer", **lasting(5)), join("other")
    for client in (peer, other):
        client.subscribe("a", 1)
        client.subscribe("b")
        client.subscribe("a", 2)
        client.unsubscribe("b")
    assert store.subscriptions == {("peer", "a"): 2}


def test_observers_are_told_what_happens(join: Join, broker: Broker, access: FakeAccess):
    """Port Observer: amqtt's plugins listen there"""
    told: list[tuple[object, ...]] = []

    class Listening:
        def connected(self, session) -> None:
            told.append(("connected", session.client_id))

        def disconnected(self, session) -> None:
            told.append(("disconnected", session.client_id))

        def subscribed(self, session, topic_filter: str, qos: int) -> None:
            told.append(("subscribed", session.client_id, topic_filter, qos))

        def unsubscribed(self, session, topic_filter: str) -> None:
            told.append(("unsubscribed", session.client_id, topic_filter))

        def published(self, session, message: Message) -> None:
            told.append(("published", session.client_id, message.topic))

        def refused(self, session, message: Message) -> None:
            told.append(("refused", session.client_id, message.topic))

        def retained(self, message: Message) -> None:
            told.append(("retained", message.topic, message.payload))

    broker.observer = Listening()
    access.deny("user", Action.PUBLISH, "no")
    peer = join("peer", version=4, will=Will("w", b"gone"))
    peer.subscribe("a", 1)
    peer.unsubscribe("a", "never")
    for qos in (0, 1, 2):
        peer.publish("a", b"x", qos)
    peer.publish("no")
    peer.publish("r", b"x", retain=True)
    peer.lose()
    assert told == [
        ("connected", "peer"),
        ("subscribed", "peer", "a", 1),
        ("unsubscribed", "peer", "a"),
        *[("published", "peer", "a")] * 3,
        ("refused", "peer", "no"),
        ("published", "peer", "r"),
        ("retained", "r", b"x"),
        ("disconnected", "peer"),
        ("published", "peer", "w"),
    ]


def test_the_store_knows_what_is_retained(join: Join, broker: Broker, store: FakeStore):
    """Port Store: kept, replaced, deleted, expired"""
    publisher = join("publisher")
    publisher.publish("a", b"1", retain=True)
    publisher.publish("a", b"2", retain=True)
    publisher.publish("b", b"3", retain=True)
    publisher.publish("c", b"4", retain=True, properties={MESSAGE_EXPIRY: 1})
    assert store.kept == {"a": b"2", "b": b"3", "c": b"4"}
    publisher.publish("b", b"", retain=True)
    broker.tick(broker.now + 1)
    retained(broker, 5)
    assert store.kept == {"a": b"2"}


def test_the_store_knows_what_is_owed(join: Join, broker: Broker, store: FakeStore):
    """Port Store: queued once, settled once, whichever way the message takes."""
    subscriber = join("subscriber", **lasting(5))
    subscriber.subscribe("a", 2)
    publisher = join("publisher")
    for qos in (1, 2):
        for n in range(30):  # in flight, and behind the window
            publisher.publish("a", b"%d" % n, qos)
    assert len(store.owed) == 60 and set(store.owed.values()) == {1}
    assert len(subscriber.drain()) == 60
    assert not store.owed
    subscriber.lose()
    for qos in (1, 2):
        publisher.publish("a", b"x", qos)
    publisher.publish("a", b"x", 1, properties={MESSAGE_EXPIRY: 1})
    assert len(store.owed) == 3 and set(store.owed.values()) == {1}
    broker.tick(broker.now + 1)
    subscriber = join("subscriber", **lasting(5))
    assert len(subscriber.drain()) == 2
    assert not store.owed
    assert isinstance(subscriber.unsubscribe("a"), Unsuback)


def retain_thirty(join: Join) -> Peer:
    """Who has published so many retained messages; the payload is their number."""
    publisher = join("publisher")
    for n in range(30):
        publisher.publish(f"r/{n}", b"%d" % n, 1, retain=True)
    return publisher


def test_a_closed_window_holds_up_no_qos_0(join: Join):
    """v5 [MQTT-3.3.4-8]; a subscription whose retained messages wait does not either"""
    publisher = retain_thirty(join)
    subscriber = join("subscriber")
    subscriber.subscribe("r/+", 1)
    subscriber.subscribe("live")
    first = subscriber.messages()
    assert len(first) == 20
    for n in range(3):
        publisher.publish("live", b"%d" % n)
        publisher.publish("live", b"%d with" % n, properties={MESSAGE_EXPIRY: 5})
    assert [m.payload for m in subscriber.messages()] == [
        payload for n in range(3) for payload in (b"%d" % n, b"%d with" % n)
    ]
    subscriber.subscribe("r/1")  # an own subscription for QoS 0
    assert [m.qos for m in subscriber.messages()] == [0]
    subscriber.acknowledge(*first)
    assert len(subscriber.drain()) == 10


def test_retained_messages_wait_for_the_next_connection(join: Join):
    """[MQTT-4.1.0-1]: those of QoS 1 and 2 are part of what the session owes"""
    retain_thirty(join)
    subscriber = join("subscriber", **lasting(5))
    subscriber.subscribe("r/+", 1)
    assert len(subscriber.messages()) == 20  # lost with the connection
    subscriber.lose()
    subscriber = join("subscriber", **lasting(5))
    assert sorted(int(m.payload) for m in subscriber.drain()) == list(range(30))


def test_unsubscribing_ends_the_retained_messages_too(join: Join):
    retain_thirty(join)
    subscriber = join("subscriber")
    subscriber.subscribe("r/+", 1)
    first = subscriber.messages()
    subscriber.unsubscribe("r/+")
    subscriber.acknowledge(*first)
    assert subscriber.drain() == []


def test_what_is_retained_meanwhile_is_what_is_sent(join: Join, broker: Broker):
    """A retained message that waits for its turn is looked up then: the newest, or none."""
    publisher = retain_thirty(join)
    subscriber = join("subscriber")
    subscriber.subscribe("r/+", 1, retain_as_published=True)
    first = subscriber.messages()
    sent = {m.topic for m in first}
    rest = [f"r/{n}" for n in range(30) if f"r/{n}" not in sent]
    publisher.publish(rest[0], b"new", 1, retain=True)
    publisher.publish(rest[1], b"", 1, retain=True)
    subscriber.acknowledge(*first)
    messages = subscriber.drain()
    assert {m.payload for m in messages if m.topic == rest[0]} == {b"new"}
    assert [m.payload for m in messages if m.topic == rest[1]] == [b""]
    assert {m.topic for m in messages} == set(rest)
    assert len(broker.retained) == 29


# --- memory


def test_a_broker_that_nobody_uses_any_more_is_freed():
    """What refers to each other in circles is found by the garbage collector, compiled as well."""

    def brokers() -> int:
        gc.collect()
        return sum(type(each) is Broker for each in gc.get_objects())

    before = brokers()
    broker = Broker(FakeAccess(), FakeStore())
    broker.attach("inside", InsideLink())
    assert brokers() == before + 1
    del broker
    assert brokers() <= before
