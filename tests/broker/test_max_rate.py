"""A rate for a subscription: the newest of each topic, no more often than that, and the last."""

from __future__ import annotations

import random
from itertools import pairwise

import pytest

from appliance.broker.broker import Broker
from appliance.broker.limits import Limits, UserLimits
from appliance.broker.max_rate import FORGOTTEN_PER_COST_UNIT, GATHERED, TOPIC_SIZE
from appliance.broker.values import Action
from appliance.mqtt.codec import Properties, Property
from appliance.mqtt.packets import Publish, Suback, Subscribe, Subscription, Unsubscribe
from appliance.mqtt.reason import ReasonCode

from .conftest import FakeAccess, Join, Peer, check_accounts, drops, lasting, waiting_bytes


def rate(value: str, **more: object) -> Properties:
    pairs = [("max-rate", value)]
    return {Property.USER_PROPERTY: pairs, **{Property[name]: v for name, v in more.items()}}


def passes(broker: Broker, seconds: float) -> None:
    """Let the time pass, as the event loop's timer does."""
    broker.accounting.now += seconds
    broker.send_due()


def say(publisher: Peer, *payloads: bytes, topic: str = "a", **options: bool) -> None:
    for payload in payloads:
        publisher.publish(topic, payload, **options)


def test_the_first_comes_at_once_and_the_newest_when_the_interval_is_over(
    broker: Broker, join: Join
) -> None:
    reader, publisher = join("reader"), join("publisher")
    assert reader.subscribe("+", 1, properties=rate("2")) == 0  # QoS 0 is granted
    say(publisher, b"1", b"2", b"3")
    say(publisher, b"other", topic="b")
    assert reader.payloads() == [b"1", b"other"]
    passes(broker, 0.49)
    assert reader.payloads() == []
    passes(broker, 0.01 + GATHERED)
    assert reader.payloads() == [b"3"]
    say(publisher, b"4")
    passes(broker, 0.4)
    assert reader.payloads() == []  # the interval has begun with what was sent late
    passes(broker, 0.1 + GATHERED)
    assert reader.payloads() == [b"4"]
    passes(broker, 1)
    assert reader.payloads() == []
    assert broker.counters.publish_throttled == 1 and not len(broker.rates)
    say(publisher, b"5")
    assert reader.payloads() == [b"5"]


def test_what_comes_behind_the_interval_is_sent_although_the_timer_is_late(
    broker: Broker, join: Join
) -> None:
    reader, publisher = join("reader"), join("publisher")
    reader.subscribe("a", properties=rate("2"))
    say(publisher, b"1", b"2")
    broker.accounting.now += 0.5
    say(publisher, b"3")
    assert reader.payloads() == [b"1", b"3"]
    passes(broker, 0.3)
    assert reader.payloads() == []


@pytest.mark.parametrize("qos", [1, 2])
def test_a_message_of_any_qos_is_received_by_who_asked_for_a_rate(join: Join, qos: int) -> None:
    reader, publisher = join("reader"), join("publisher")
    reader.subscribe("a", properties=rate("1", SUBSCRIPTION_IDENTIFIER=[7]))
    assert publisher.publish("a", b"1", qos) == 0  # somebody subscribed
    (message,) = reader.messages()
    assert message.qos == 0
    assert message.properties == {Property.SUBSCRIPTION_IDENTIFIER: [7]}
    assert publisher.publish("a", b"2", qos) == 0


@pytest.mark.parametrize(
    ("value", "why"),
    [
        ("0", "above 0"),
        ("0.0000001", "six digits"),
        ("-1", "above 0"),
        ("1e3", "above 0"),
        ("nan", "above 0"),
        ("", "above 0"),
        ("१", "above 0"),
        ("9" * 65000, "above 0"),
    ],
)
def test_a_wrong_rate_is_refused_with_a_reason(join: Join, value: str, why: str) -> None:
    reader = join("reader")
    reader.subscribe("a", 1)
    reader.send(Subscribe(9, [Subscription("a"), Subscription("b")], rate(value)))
    answer = reader.only(Suback)
    assert isinstance(answer, Suback) and answer.properties is not None
    assert answer.reason_codes == [ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR] * 2
    reason = answer.properties[Property.REASON_STRING]
    assert isinstance(reason, str) and "max-rate" in reason and why in reason
    assert [*reader.session.subscriptions] == ["a"]  # as it was
    assert reader.session.subscriptions["a"].qos == 1


def test_two_rates_and_a_shared_subscription_are_refused(join: Join) -> None:
    reader = join("reader")
    twice = {Property.USER_PROPERTY: [("max-rate", "1"), ("other", "x"), ("max-rate", "1")]}
    assert reader.subscribe("a", properties=twice) == ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR
    filters = [Subscription("$share/g/a"), Subscription("a", 2)]
    reader.send(Subscribe(9, filters, rate("1")))
    answer = reader.only(Suback)
    assert isinstance(answer, Suback) and answer.properties is not None
    assert answer.reason_codes == [ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR, 0]
    assert "shared" in str(answer.properties[Property.REASON_STRING])


def test_a_retained_message_is_the_first_one(broker: Broker, join: Join) -> None:
    publisher, reader = join("publisher"), join("reader")
    say(publisher, b"retained", retain=True)
    reader.subscribe("#", properties=rate("2"))
    say(publisher, b"newer", retain=True)
    (first,) = reader.messages()
    assert (first.payload, first.retain) == (b"retained", True)
    passes(broker, 0.5 + GATHERED)
    (second,) = reader.messages()
    assert (second.payload, second.retain) == (b"newer", False)
    # [MQTT-3.8.4-4]: they are sent again, and not more often than that.
    reader.subscribe("#", properties=rate("2"))
    assert reader.messages() == []
    passes(broker, 0.5 + GATHERED)
    (again,) = reader.messages()
    assert (again.payload, again.retain) == (b"newer", True)


def test_another_rate_or_none_loses_nothing(broker: Broker, join: Join) -> None:
    """[MQTT-3.8.4-3]: no message is lost because a subscription is replaced."""
    reader, publisher = join("reader"), join("publisher")
    reader.subscribe("a", properties=rate("2"))
    say(publisher, b"1", b"2")
    reader.subscribe("a", properties=rate("0.5"))
    assert reader.payloads() == [b"1", b"2"]
    say(publisher, b"3", b"4")
    assert reader.subscribe("a", 1) == 1
    assert reader.payloads() == [b"3", b"4"]
    say(publisher, b"5", b"6")
    assert reader.payloads() == [b"5", b"6"]


def test_the_highest_rate_of_overlapping_subscriptions_holds(broker: Broker, join: Join) -> None:
    reader, publisher = join("reader"), join("publisher")
    reader.subscribe("+", properties=rate("1", SUBSCRIPTION_IDENTIFIER=[1]))
    reader.subscribe("a", properties=rate("4", SUBSCRIPTION_IDENTIFIER=[2]))
    say(publisher, b"1", b"2")
    passes(broker, 0.25 + GATHERED)
    messages = reader.messages()
    assert [message.payload for message in messages] == [b"1", b"2"]
    for message in messages:
        assert message.properties is not None
        ids = message.properties[Property.SUBSCRIPTION_IDENTIFIER]
        assert isinstance(ids, list) and sorted(ids) == [1, 2]
    reader.subscribe("#", 0)  # all of them
    passes(broker, 1)
    say(publisher, b"3", b"4")
    assert reader.payloads() == [b"3", b"4"]


def test_no_local_and_the_rules_hold(broker: Broker, join: Join, access: FakeAccess) -> None:
    reader, publisher = join("reader", user="reader"), join("publisher")
    reader.subscribe("a", properties=rate("1"), no_local=True)
    reader.publish("a", b"own")
    say(publisher, b"1", b"2")
    access.deny("reader", Action.RECEIVE, "a")
    broker.rules_changed()
    passes(broker, 1.1)
    assert reader.payloads() == [b"1"] and broker.counters.publish_dropped == 1
    say(publisher, b"3")
    passes(broker, 1.1)
    assert reader.payloads() == []


def test_a_message_that_expires_while_it_waits_is_dropped(broker: Broker, join: Join) -> None:
    reader, publisher = join("reader"), join("publisher")
    reader.subscribe("a", properties=rate("0.1"))
    expiry = {Property.MESSAGE_EXPIRY_INTERVAL: 3}
    publisher.publish("a", b"1", properties=expiry)
    publisher.publish("a", b"2", properties=expiry)
    passes(broker, 10.1)
    assert reader.payloads() == [b"1"] and waiting_bytes(broker) == 0
    assert drops(broker) == {"expired": 1}


@pytest.mark.parametrize("how", ["unsubscribe", "lose", "end"])
def test_nothing_is_left_behind(broker: Broker, join: Join, how: str) -> None:
    reader = join("reader", **(lasting(5) if how == "lose" else {}))
    publisher = join("publisher")
    reader.subscribe("a", properties=rate("0.001"))
    reader.subscribe("b", properties=rate("1000"))
    for topic in ("a", "b"):
        say(publisher, b"1", b"2", topic=topic)
    assert waiting_bytes(broker) > 2 * TOPIC_SIZE and len(broker.rates) == 2
    if how == "unsubscribe":
        reader.send(Unsubscribe(5, ["a", "b"]))
    elif how == "lose":
        reader.lose()
    else:
        reader.disconnect()
    assert waiting_bytes(broker) == 0 and len(broker.rates) == 0
    if how == "lose":  # its rate is kept
        again = join("reader", **lasting(5))
        say(publisher, b"3", b"4")
        assert again.payloads() == [b"3"]


def test_ended_subscriptions_do_not_make_the_schedule_grow(broker: Broker, join: Join) -> None:
    publisher = join("publisher")
    for number in range(300):
        reader = join(f"reader{number}")
        reader.subscribe("a", properties=rate("0.000001"))
        say(publisher, b"1")
        reader.disconnect()
    assert len(broker.rates._heap) <= 65


@pytest.mark.parametrize("limits", [Limits(queue_messages=2)])
def test_without_room_to_wait_comes_the_first_of_each_interval(broker: Broker, join: Join) -> None:
    reader, publisher = join("reader"), join("publisher")
    reader.subscribe("#", properties=rate("1"))
    for payload in (b"1", b"2"):
        for topic in ("a", "b", "c"):
            say(publisher, payload, topic=topic)
    assert broker.counters.publish_dropped == 1
    passes(broker, 1.1)
    assert sorted((m.topic, m.payload) for m in reader.messages()) == [
        ("a", b"1"),
        ("a", b"2"),
        ("b", b"1"),
        ("b", b"2"),
        ("c", b"1"),
    ]
    say(publisher, b"3", topic="c")
    assert reader.payloads() == [b"3"]


@pytest.mark.parametrize(
    ("limits", "most"),
    [
        (Limits(queue_bytes=20_000), 5_000),  # of the session
        (Limits(user=UserLimits(memory=12_000)), 3_000),  # of the user
    ],
)
def test_topics_without_end_take_nothing_from_what_waits(
    broker: Broker, join: Join, most: int
) -> None:
    """And the first message of each comes, although there is no room to know it."""
    reader, publisher = join("reader"), join("publisher", user="mallory")
    reader.subscribe("#", properties=rate("0.001"))
    reader.subscribe("cmd", 1)
    before = reader.session.bytes
    for number in range(500):
        say(publisher, b"1", topic=f"t/{number}")
    assert reader.session.bytes == before
    assert most - 400 < reader.session.topic_bytes <= most
    assert len(reader.messages()) == 500 and broker.counters.publish_dropped == 0
    say(publisher, b"2", topic="t/499")
    assert reader.payloads() == [b"2"]  # without a rate
    check_accounts(broker)
    passes(broker, 2000)
    assert waiting_bytes(broker) == 0


@pytest.mark.parametrize("limits", [Limits(queue_bytes=20_000)])
def test_what_waits_for_an_interval_leaves_half_to_qos_1(broker: Broker, join: Join) -> None:
    reader, publisher = join("reader"), join("publisher")
    reader.subscribe("#", properties=rate("0.001"))
    reader.subscribe("cmd", 1)
    for number in range(2):
        for topic in range(10):
            say(publisher, b"%d" % number * 2000, topic=f"t/{topic}")
    assert 5_000 < reader.session.bytes <= 10_000
    assert len(reader.messages()) == 10 and broker.counters.publish_dropped > 5
    assert publisher.publish("cmd", bytes(6000), 1) == 0
    assert reader.session.congestion is None or not reader.session.congestion.awaited


def test_all_topics_are_forgotten_at_once_and_counted(broker: Broker, join: Join) -> None:
    """It is bounded, and who does it again and again has others have their turn."""
    reader, publisher = join("reader"), join("publisher")
    reader.subscribe("#", properties=rate("0.001"))
    for number in range(20_000):
        say(publisher, b"", topic=f"t/{number}")
    reader.messages()
    (limit,) = reader.session.rate_limits.values()
    assert 11_000 < len(limit._topics) < 14_000
    before = broker.counters.cost
    reader.subscribe("#", properties=rate("0.002"))
    assert broker.counters.cost - before > 11_000 // FORGOTTEN_PER_COST_UNIT
    assert reader.session.topic_bytes == 0


def test_of_a_slow_client_one_message_of_a_topic_waits(broker: Broker, join: Join) -> None:
    """And not one in the queue and another one for its turn: they may be images."""
    reader, publisher = join("reader"), join("publisher")
    reader.subscribe("a", properties=rate("2"))
    say(publisher, b"0" * 50_000)
    reader.slow()
    for number in range(1, 20):
        say(publisher, b"%d" % number * 50_000)
        passes(broker, 0.1)
    assert waiting_bytes(broker) < 150_000
    reader.messages()
    reader.fast()
    passes(broker, 1)
    assert [payload[:2] for payload in reader.payloads()] == [b"19"]


@pytest.mark.parametrize("seed", range(3))
def test_it_agrees_with_a_naive_one(broker: Broker, join: Join, seed: int) -> None:
    """Of each topic: never two in an interval, only newer ones, and the last in the end."""
    dice = random.Random(seed)
    reader, publisher = join("reader"), join("publisher")
    reader.subscribe("#", properties=rate("10"))
    came: dict[str, list[tuple[float, int]]] = {}
    last: dict[str, int] = {}

    def look() -> None:
        for message in reader.messages():
            assert isinstance(message, Publish)
            came.setdefault(message.topic, []).append((broker.now, int(message.payload)))

    for number in range(2000):
        topic = dice.choice("abcdefgh")
        last[topic] = number
        publisher.publish(topic, b"%d" % number)
        look()
        if dice.random() < 0.5:
            broker.accounting.now += dice.random() * 0.03
            if broker.rates.next_at <= broker.now:
                broker.send_due()
            look()
    passes(broker, 1)
    look()
    for topic, messages in came.items():
        for (before, older), (after, newer) in pairwise(messages):
            assert after - before >= 0.1 - 1e-6 and newer > older, topic
        assert messages[-1][1] == last[topic]
        # As many as the rate allows, but for what is gathered.
        assert len(messages) >= 0.6 * (messages[-1][0] - messages[0][0]) / 0.1
