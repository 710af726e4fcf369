"""`$SYS`: mosquitto's topic names, and correct values."""

from __future__ import annotations

import pytest

from appliance.broker.broker import Broker
from appliance.broker.sys_topics import PREFIX, LoadAverage, SysTopics
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Pingreq
from appliance.mqtt.topics import check_topic

from .conftest import Join, lasting

#: CONVENTIONS, "$SYS".
NAMES = {
    "version",
    "uptime",
    "heap/current",
    *(f"clients/{name}" for name in ("connected", "disconnected", "expired", "maximum", "total")),
    *(f"messages/{name}" for name in ("received", "sent", "stored")),
    *(f"publish/messages/{name}" for name in ("received", "sent", "dropped")),
    *(f"publish/bytes/{name}" for name in ("received", "sent")),
    *(f"bytes/{name}" for name in ("received", "sent")),
    "subscriptions/count",
    "shared_subscriptions/count",
    "retained messages/count",
    "store/messages/count",
    "store/messages/bytes",
    *(
        f"load/{what}/{minutes}min"
        for what in ("messages/received", "messages/sent", "publish/received", "publish/sent")
        for minutes in (1, 5, 15)
    ),
    *(
        f"load/{what}/{minutes}min"
        for what in ("publish/dropped", "bytes/received", "bytes/sent", "connections", "sockets")
        for minutes in (1, 5, 15)
    ),
}


@pytest.fixture
def sys_topics(broker: Broker) -> SysTopics:
    return SysTopics(broker, "1.2.3", lambda: 123_456)


def values(sys_topics: SysTopics) -> dict[str, str]:
    return {topic.removeprefix(PREFIX): text.decode() for topic, text in sys_topics.update()}


def test_the_names_are_mosquittos(sys_topics: SysTopics):
    topics = [topic for topic, _ in sys_topics.update()]
    for topic in topics:
        check_topic(topic)
    assert {topic.removeprefix(PREFIX) for topic in topics} >= NAMES
    assert len(set(topics)) == len(topics)


def test_only_what_changed_is_said_again(sys_topics: SysTopics, broker: Broker, join: Join):
    assert values(sys_topics)["version"] == "appliance version 1.2.3"
    assert values(sys_topics) == {}
    broker.tick(broker.now + 90)
    assert values(sys_topics) == {"uptime": "90 seconds"}
    join()
    changed = values(sys_topics)
    assert changed["clients/connected"] == "1" and "version" not in changed


def test_the_figures(sys_topics: SysTopics, broker: Broker, join: Join):
    subscriber = join("subscriber", **lasting(5, 60))
    subscriber.subscribe("a", 1)
    publisher = join("publisher", version=4)
    for n in range(3):
        publisher.publish("a", b"12345", 1, retain=n == 2)
    publisher.send(Pingreq())
    figures = values(sys_topics)
    expected = {
        "clients/connected": 2,
        "clients/disconnected": 0,
        "clients/maximum": 2,
        "clients/total": 2,
        "publish/messages/received": 3,
        "publish/messages/sent": 3,
        "publish/bytes/received": 15,
        "publish/bytes/sent": 15,
        "messages/received": 2 + 1 + 3 + 1,  # CONNECT, SUBSCRIBE, PUBLISH, PINGREQ
        "messages/sent": 2 + 1 + 3 + 3 + 1,  # CONNACK, SUBACK, PUBACK, PUBLISH, PINGRESP
        "bytes/received": broker.counters.bytes_received,
        "subscriptions/count": 1,
        "retained messages/count": 1,
        "messages/stored": 4,  # three in flight, one retained
    }
    assert broker.counters.bytes_received > 100
    assert {name: int(figures[name]) for name in expected} == expected
    assert int(figures["store/messages/bytes"]) > 20 and figures["heap/current"] == "123456"
    subscriber.drain()
    figures = values(sys_topics)
    assert (figures["messages/stored"], figures["messages/received"]) == ("1", "10")
    subscriber.lose()
    changed = values(sys_topics)
    assert (changed["clients/connected"], changed["clients/disconnected"]) == ("1", "1")
    broker.tick(broker.now + 60)
    changed = values(sys_topics)
    assert (changed["clients/expired"], changed["clients/total"]) == ("1", "1")
    assert (changed["clients/disconnected"], changed["subscriptions/count"]) == ("0", "0")


def test_what_goes_out_as_it_came_in_is_counted_too(sys_topics: SysTopics, join: Join, version):
    subscriber, other = join("subscriber", version=version), join("other", version=9 - version)
    for peer in (subscriber, other):
        peer.subscribe("a")
    subscriber.publish("a", b"12345")
    figures = values(sys_topics)
    assert figures["publish/messages/received"] == "1" and figures["publish/bytes/received"] == "5"
    assert figures["publish/messages/sent"] == "2" and figures["publish/bytes/sent"] == "10"


def test_what_waits_is_counted_once_wherever_it_waits(
    sys_topics: SysTopics, broker: Broker, join: Join
):
    subscriber = join("subscriber", **lasting(5))
    subscriber.subscribe("a", 2)
    publisher = join("publisher")
    for qos in (1, 2):
        for _ in range(15):
            publisher.publish("a", b"x", qos, properties={Property.CONTENT_TYPE: "text/plain"})
    figures = values(sys_topics)
    assert figures["messages/stored"] == figures["store/messages/count"] == "30"
    assert int(figures["store/messages/bytes"]) == broker.accounting.queued_bytes


def test_a_session_inside_the_appliance_is_no_client(sys_topics: SysTopics, broker: Broker):
    class Deaf:
        writable = True

    broker.attach("_bridge", Deaf())  # type: ignore[arg-type]
    figures = values(sys_topics)
    assert (figures["clients/total"], figures["clients/disconnected"]) == ("0", "0")


def test_load_is_a_moving_average_a_minute():
    load = LoadAverage()
    total = 0
    for _ in range(100):
        total += 50
        load.update(total, 10)  # 300 a minute, for long
    averages = dict(load.values())
    assert float(averages["1min"]) == pytest.approx(300, rel=0.01)
    assert float(averages["5min"]) == pytest.approx(300, rel=0.1)
    assert float(averages["1min"]) > float(averages["5min"]) > float(averages["15min"]) > 0
    for _ in range(1000):
        load.update(total, 10)
    assert {text for _, text in load.values()} == {"0.00"}
    load.update(total + 5, 600)  # longer than the window: what was there before is forgotten
    assert float(dict(load.values())["1min"]) == pytest.approx(0.5)


def test_no_time_between_two_updates_does_no_harm(sys_topics: SysTopics, join: Join):
    join()
    assert values(sys_topics)["load/connections/1min"] == "0.00"
