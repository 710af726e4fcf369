"""paho-mqtt 2, MQTT 3.1.1 and 5, through TLS."""

from __future__ import annotations

import contextlib
import time
from typing import Any

import pytest
from appliance_process import ApplianceProcess, BrokerProcess
from paho.mqtt.enums import MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.subscribeoptions import SubscribeOptions
from paho_peer import V5, V311, Peer, brief, properties
from waiting import PATIENCE, eventually

QOS = [0, 1, 2]
both_versions = pytest.mark.parametrize("version", [V311, V5], ids=["v311", "v5"])


@pytest.mark.statement("3.1.1", "MQTT-7.0.0-2")
@both_versions
@pytest.mark.parametrize("qos", QOS)
def test_publish_and_subscribe(
    broker: BrokerProcess, version: MQTTProtocolVersion, qos: int, topic: str
) -> None:
    with Peer(broker, version) as sender, Peer(broker, version, user="bob") as receiver:
        assert receiver.subscribe(topic, qos) == qos
        for number in range(50):
            sender.publish(topic, str(number), qos)
        received = [brief(message) for message in receiver.receive(50)]
        assert received == [(topic, str(number), qos, False) for number in range(50)]
        receiver.unsubscribe(topic)
        receiver.subscribe(f"{topic}/other", qos)
        sender.publish(topic, "unheard", qos)
        sender.publish(f"{topic}/other", "heard", qos)
        assert receiver.payloads(1) == ["heard"]


@pytest.mark.parametrize("qos", QOS)
def test_both_versions_at_once(broker: BrokerProcess, qos: int, topic: str) -> None:
    with Peer(broker, V311) as old, Peer(broker, V5) as new:
        for peer in (old, new):
            peer.subscribe(topic, qos)
        new.publish(topic, "new", qos, ContentType="text/plain", UserProperty=[("a", "1")])
        for peer in (old, new):
            assert brief(peer.message()) == (topic, "new", qos, False)
        old.publish(topic, "old", qos)
        for peer in (old, new):
            message = peer.message()
            assert brief(message) == (topic, "old", qos, False)
        assert message.properties.isEmpty()


@both_versions
@pytest.mark.parametrize("qos", QOS)
def test_a_megabyte(
    broker: BrokerProcess, version: MQTTProtocolVersion, qos: int, topic: str
) -> None:
    payload = bytes(range(256)) * 4096
    with Peer(broker, version) as sender, Peer(broker, version) as receiver:
        receiver.subscribe(topic, qos)
        for number in range(5):
            sender.publish(topic, payload + bytes((number,)), qos)
        for number in range(5):
            assert receiver.message().payload == payload + bytes((number,))


@both_versions
def test_retained(broker: BrokerProcess, version: MQTTProtocolVersion, topic: str) -> None:
    with Peer(broker, version) as sender:
        for qos in QOS:
            sender.publish(f"{topic}/{qos}", "old", qos, retain=True)
            sender.publish(f"{topic}/{qos}", str(qos), qos, retain=True)
        with Peer(broker, version) as receiver:
            receiver.subscribe(f"{topic}/#", 2)
            received = sorted(brief(message) for message in receiver.receive(3))
            assert received == [(f"{topic}/{qos}", str(qos), qos, True) for qos in QOS]
        for qos in QOS:
            sender.publish(f"{topic}/{qos}", b"", qos, retain=True)
        with Peer(broker, version) as receiver:
            receiver.subscribe(f"{topic}/#", 2)
            sender.publish(topic, "live")
            assert brief(receiver.message()) == (topic, "live", 1, False)


@both_versions
@pytest.mark.parametrize("qos", QOS)
def test_will(broker: BrokerProcess, version: MQTTProtocolVersion, qos: int, topic: str) -> None:
    with Peer(broker, version) as watcher:
        watcher.subscribe(f"{topic}/#", 2)
        dying = Peer(broker, version)
        table: dict[str, Any] = {}
        if version == V5:
            user = [("a", "1"), ("a", "2")]
            table = {"ContentType": "text/plain", "UserProperty": user}
        will = properties(PacketTypes.WILLMESSAGE, **table) if table else None
        dying.client.will_set(f"{topic}/will", "gone", qos, True, will)
        dying.start()
        dying.kill()
        message = watcher.message()
        assert brief(message) == (f"{topic}/will", "gone", qos, False)
        if version == V5:
            for name, value in table.items():
                assert getattr(message.properties, name) == value
        watcher.publish(f"{topic}/will", b"", retain=True)
        watcher.message()

        leaving = Peer(broker, version)
        leaving.client.will_set(f"{topic}/will", "gone", qos)
        leaving.start().stop()
        watcher.publish(topic, "end")
        assert watcher.payloads(1) == ["end"]


def test_a_delayed_will_is_due_only_when_the_client_stays_away(
    broker: BrokerProcess, topic: str
) -> None:
    def dying(name: str) -> Peer:
        peer = Peer(broker, V5, f"{topic[-12:]}-{name}", clean=False, expiry=60)
        delay = properties(PacketTypes.WILLMESSAGE, WillDelayInterval=10)
        peer.client.will_set(f"{topic}/{name}", "gone", 1, False, delay)
        return peer.start()

    with Peer(broker, V5) as watcher:
        watcher.subscribe(f"{topic}/#")
        first, second = dying("first"), dying("second")
        first.kill()
        back = Peer(broker, V5, f"{topic[-12:]}-first", clean=False, expiry=60)
        with back:
            assert back.session_present
            killed_at = time.monotonic()
            second.kill()  # after the first, so its will comes after the first's would have
            assert watcher.message().topic == f"{topic}/second"
            assert time.monotonic() - killed_at > 9.9


def test_properties_are_passed_on_unchanged(broker: BrokerProcess, topic: str) -> None:
    table: dict[str, Any] = {
        "PayloadFormatIndicator": 1,
        "ContentType": "application/json; charset=utf-8",
        "ResponseTopic": f"{topic}/answer",
        "CorrelationData": b"\x00\xff\x00",
        "UserProperty": [("b", "1"), ("a", "2"), ("b", "1"), ("", ""), ("ö", "€")],
    }
    with Peer(broker, V5) as sender, Peer(broker, V5) as receiver:
        receiver.subscribe(topic, 2)
        for qos in QOS:
            sender.publish(topic, "{}", qos, **table)
            message = receiver.message()
            assert message.qos == qos
            assert message.properties.json() == properties(PacketTypes.PUBLISH, **table).json()
            assert message.properties.UserProperty == table["UserProperty"]
            assert message.properties.CorrelationData == table["CorrelationData"]


@pytest.mark.parametrize("qos", QOS)
def test_the_expiry_that_is_left_is_told(broker: BrokerProcess, qos: int, topic: str) -> None:
    with Peer(broker, V5) as sender, Peer(broker, V5) as receiver:
        receiver.subscribe(topic, 2)
        sender.publish(topic, "x", qos, retain=True, MessageExpiryInterval=1000)
        assert receiver.message().properties.MessageExpiryInterval in range(990, 1001)
        with Peer(broker, V5) as late:
            late.subscribe(topic, 2)
            assert late.message().properties.MessageExpiryInterval in range(990, 1001)
        sender.publish(topic, b"", retain=True)


def test_expired_messages_are_gone(appliance: ApplianceProcess, topic: str) -> None:
    def absent() -> Peer:
        return Peer(appliance, V5, topic[-12:], clean=False, expiry=60)

    with absent() as peer:
        peer.subscribe(f"{topic}/queued")
    with Peer(appliance, V5) as sender:
        for name in ("queued", "retained"):
            retain = name == "retained"
            sender.publish(f"{topic}/{name}", "old", retain=retain, MessageExpiryInterval=1)
        sender.publish(f"{topic}/queued", "lasting")

        def gone() -> bool:
            with Peer(appliance, V5) as late:
                late.subscribe(f"{topic}/#")
                late.publish(f"{topic}/live", "live")
                return bool(late.message().payload == b"live")

        # What was queued is older than what was retained: when that is gone, so is this.
        eventually(gone, "a retained message expires")
    with absent() as peer:
        assert peer.session_present
        assert peer.payloads(1) == ["lasting"]


def test_subscription_identifiers(broker: BrokerProcess, topic: str) -> None:
    with Peer(broker, V5) as sender, Peer(broker, V5) as receiver:
        sender.publish(f"{topic}/a", "retained", retain=True)
        receiver.subscribe(f"{topic}/a", 1, identifier=268_435_455)
        receiver.subscribe(f"{topic}/b", 1)
        assert receiver.message().properties.SubscriptionIdentifier == [268_435_455]
        sender.publish(f"{topic}/a", "a")
        sender.publish(f"{topic}/b", "b", ContentType="b")
        assert receiver.message().properties.SubscriptionIdentifier == [268_435_455]
        assert not hasattr(receiver.message().properties, "SubscriptionIdentifier")
        # Another identifier, or none, takes the place of the one before.
        receiver.subscribe(f"{topic}/a", SubscribeOptions(1, retainHandling=2), identifier=1)
        sender.publish(f"{topic}/a", "a")
        assert receiver.message().properties.SubscriptionIdentifier == [1]
        sender.publish(f"{topic}/a", b"", retain=True)


def test_one_message_has_the_identifiers_of_all_subscriptions(
    appliance: ApplianceProcess, topic: str
) -> None:
    # The standard allows a copy for each as well; mosquitto sends those.
    with Peer(appliance, V5) as peer:
        peer.subscribe(f"{topic}/+", 0, identifier=7)
        peer.subscribe(f"{topic}/#", 2, identifier=9)
        peer.subscribe(f"{topic}/a", 1)
        peer.publish(f"{topic}/a", "a", 2)
        message = peer.message()
        assert message.qos == 2
        assert sorted(message.properties.SubscriptionIdentifier) == [7, 9]
        peer.publish(f"{topic}/end", "end")
        assert peer.payloads(1) == ["end"]


def test_no_local(broker: BrokerProcess, topic: str) -> None:
    with Peer(broker, V5) as peer, Peer(broker, V5) as other:
        peer.subscribe(topic, SubscribeOptions(1, noLocal=True))
        peer.publish(topic, "own")
        other.publish(topic, "other's")
        assert peer.payloads(1) == ["other's"]
        # What it has retained itself it does not hear live, but a new subscription finds it.
        peer.publish(topic, "retained", retain=True)
        with Peer(broker, V5) as late:
            late.subscribe(topic, SubscribeOptions(1, noLocal=True))
            assert brief(late.message()) == (topic, "retained", 1, True)
        peer.publish(topic, b"", retain=True)


def test_retain_as_published(broker: BrokerProcess, topic: str) -> None:
    with Peer(broker, V5) as sender, Peer(broker, V5) as as_published, Peer(broker, V5) as plain:
        as_published.subscribe(topic, SubscribeOptions(1, retainAsPublished=True))
        plain.subscribe(topic, SubscribeOptions(1))
        sender.publish(topic, "retained", retain=True)
        sender.publish(topic, "live")
        sender.publish(topic, b"", retain=True)
        assert [message.retain for message in as_published.receive(3)] == [True, False, True]
        assert [message.retain for message in plain.receive(3)] == [False, False, False]


@pytest.mark.parametrize(
    ("handling", "first", "again"), [(0, True, True), (1, True, False), (2, False, False)]
)
def test_retain_handling(
    broker: BrokerProcess, topic: str, handling: int, first: bool, again: bool
) -> None:
    with Peer(broker, V5) as peer:
        peer.publish(topic, "retained", retain=True)
        for expected in (first, again):
            peer.subscribe(topic, SubscribeOptions(1, retainHandling=handling))
            peer.publish(topic, "live")
            texts = ["retained", "live"] if expected else ["live"]
            assert peer.payloads(len(texts)) == texts
        peer.unsubscribe(topic)
        peer.publish(topic, b"", retain=True)


@both_versions
def test_a_session_is_continued(
    broker: BrokerProcess, version: MQTTProtocolVersion, topic: str
) -> None:
    def client(clean: bool = False) -> Peer:
        return Peer(broker, version, topic[-12:], clean=clean, expiry=0 if clean else 600)

    with Peer(broker, version) as sender:
        with client() as peer:
            assert not peer.session_present
            peer.subscribe(f"{topic}/+", 2)
        for number in range(100):
            sender.publish(f"{topic}/{number % 3}", str(number), 1 + number % 2)
        with client() as peer:
            assert peer.session_present
            received = peer.receive(100)
            for qos in (1, 2):  # paho hands a QoS 2 message out at PUBREL, later than one of QoS 1
                texts = [message.payload.decode() for message in received if message.qos == qos]
                assert texts == [str(number) for number in range(qos - 1, 100, 2)]
            sender.publish(f"{topic}/live", "live", 0)  # so that nothing is under way at the kill
            assert peer.payloads(1) == ["live"]
            peer.kill()
        sender.publish(f"{topic}/a", "after the kill")
        with client() as peer:
            assert peer.payloads(1) == ["after the kill"]
        with client(clean=True) as peer:
            assert not peer.session_present
        with client() as peer:  # and the clean one has left nothing behind
            assert not peer.session_present
            sender.publish(f"{topic}/a", "unheard")
            peer.subscribe(f"{topic}/b", 1)
            sender.publish(f"{topic}/b", "heard")
            assert peer.payloads(1) == ["heard"]
        client(clean=True).start().stop()


@both_versions
def test_what_was_not_acknowledged_is_sent_again(
    broker: BrokerProcess, version: MQTTProtocolVersion, topic: str
) -> None:
    def client(manual_ack: bool) -> Peer:
        options: dict[str, Any] = {"clean": False, "expiry": 600, "manual_ack": manual_ack}
        return Peer(broker, version, topic[-12:], **options)

    with Peer(broker, version) as sender:
        with client(manual_ack=True) as silent:
            silent.subscribe(topic)
            for text in "abc":
                sender.publish(topic, text)
            assert silent.payloads(3) == ["a", "b", "c"]
            silent.kill()
        with client(manual_ack=False) as back:
            assert back.session_present
            received = back.receive(3)
            assert [message.payload.decode() for message in received] == ["a", "b", "c"]
            assert all(message.dup for message in received)
            sender.publish(topic, "new")
            message = back.message()
            assert (message.payload, message.dup) == (b"new", False)


@both_versions
def test_exactly_once_over_lost_connections(
    broker: BrokerProcess, version: MQTTProtocolVersion, topic: str
) -> None:
    with Peer(broker, version) as sender:
        receiver = Peer(broker, version, topic[-12:], clean=False, expiry=600).start()
        receiver.subscribe(topic, 2)
        received: list[str] = []
        for number in range(300):
            sender.client.publish(topic, str(number), 2)
        for _ in range(3):
            received += receiver.payloads(40)
            receiver.kill()
            receiver.start()  # the same object: it knows what it was in the middle of
            assert receiver.session_present
        received += receiver.payloads(300 - len(received))
        sender.publish(topic, "end", 2)
        assert receiver.payloads(1) == ["end"]
        assert received == [str(number) for number in range(300)]
        receiver.stop()


def test_a_receive_maximum_is_kept_to(broker: BrokerProcess, topic: str) -> None:
    options: dict[str, Any] = {"manual_ack": True, "receive_maximum": 2}
    with Peer(broker, V5, **options) as slow, Peer(broker, V5) as sender:
        slow.subscribe(topic)
        slow.subscribe(f"{topic}/other", 0)
        for number in range(5):
            sender.publish(topic, str(number))
        sender.publish(f"{topic}/other", "QoS 0 waits for nobody", 0)
        received = slow.receive(3)
        texts = [message.payload.decode() for message in received]
        assert texts == ["0", "1", "QoS 0 waits for nobody"]
        for number in range(2, 5):
            slow.client.ack(received.pop(0).mid, 1)
            received.insert(1, slow.message())
            assert received[1].payload.decode() == str(number)


@both_versions
def test_take_over(broker: BrokerProcess, version: MQTTProtocolVersion, topic: str) -> None:
    def client() -> Peer:
        return Peer(broker, version, topic[-12:], clean=False, expiry=600)

    with Peer(broker, version) as sender, client() as first:
        first.subscribe(topic)
        with client() as second:
            code = first.disconnected.get(timeout=PATIENCE)
            if version == V5 and broker.name == "appliance":  # mosquitto 2.0.11 does not tell
                assert code.value == 0x8E
            assert second.session_present
            sender.publish(topic, "for the second")
            assert second.payloads(1) == ["for the second"]


@pytest.mark.parametrize("qos", [1, 2])
def test_a_publish_that_is_refused_is_told(
    appliance: ApplianceProcess, qos: int, topic: str
) -> None:
    """paho releases a QoS 2 message that was refused, and tells what PUBCOMP says."""
    with Peer(appliance, V5, user="bob") as sender:
        assert sender.publish("elsewhere", "1", qos).is_failure
        assert not sender.publish(topic, "2", qos).is_failure


@both_versions
def test_a_client_without_an_id_gets_one(
    broker: BrokerProcess, version: MQTTProtocolVersion
) -> None:
    with Peer(broker, version) as one, Peer(broker, version) as two:
        if version == V5:
            assert one.connack and two.connack
            names = {peer.connack.AssignedClientIdentifier for peer in (one, two)}
            assert len(names) == 2


def test_connack_tells_what_holds(appliance: ApplianceProcess) -> None:
    with Peer(appliance, V5, "x", expiry=0xFFFF_FFFF) as peer:
        assert peer.connack is not None
        told = peer.connack.json()
    assert told == {
        "SessionExpiryInterval": 7 * 24 * 3600,
        "ReceiveMaximum": 20,
        "TopicAliasMaximum": 10,
    }


def test_topic_aliases(broker: BrokerProcess, topic: str) -> None:
    with Peer(broker, V5) as sender, Peer(broker, V5) as receiver:
        receiver.subscribe(f"{topic}/#")
        sender.publish(f"{topic}/a", "1", TopicAlias=1)
        sender.publish(f"{topic}/b", "2", TopicAlias=2)
        sender.publish("", "3", TopicAlias=1)
        sender.publish("", "4", 0, TopicAlias=2)
        sender.publish(f"{topic}/c", "5", TopicAlias=1)
        sender.publish("", "6", 2, TopicAlias=1)
        received = receiver.receive(6)
        assert [message.topic[-1] for message in received] == list("ababcc")
        assert all(not hasattr(message.properties, "TopicAlias") for message in received)


@both_versions
def test_many_clients(broker: BrokerProcess, version: MQTTProtocolVersion, topic: str) -> None:
    count = 30
    with contextlib.ExitStack() as stack:
        peers = [stack.enter_context(Peer(broker, version)) for _ in range(count)]
        for number, peer in enumerate(peers):
            peer.subscribe(f"{topic}/#", number % 3)
        for number, peer in enumerate(peers):
            peer.publish(f"{topic}/{number}", str(number), number % 3)
        for peer in peers:
            assert sorted(map(int, peer.payloads(count))) == list(range(count))
