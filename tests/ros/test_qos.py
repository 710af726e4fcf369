"""QoS chosen from the endpoints found."""

from __future__ import annotations

import pytest

from appliance.ros.node import Durability, Endpoint, QosProfile, Reliability
from appliance.ros.payload.definitions import Bulk
from appliance.ros.qos import mqtt_qos, mqtt_retain, publisher_qos, subscription_qos

BEST_EFFORT, RELIABLE = Reliability.BEST_EFFORT, Reliability.RELIABLE
VOLATILE, LATCHED = Durability.VOLATILE, Durability.TRANSIENT_LOCAL


def ends(*profiles: QosProfile) -> list[Endpoint]:
    return [Endpoint("/n", "std_msgs/msg/String", profile) for profile in profiles]


def test_without_publishers_whatever_appears_is_matched():
    assert subscription_qos([]) == QosProfile(BEST_EFFORT, VOLATILE, 10)


@pytest.mark.parametrize(
    ("reliability", "expected"),
    [
        ([RELIABLE], RELIABLE),
        ([BEST_EFFORT], BEST_EFFORT),
        ([RELIABLE, RELIABLE], RELIABLE),
        ([RELIABLE, BEST_EFFORT], BEST_EFFORT),
    ],
)
def test_reliable_when_all_publishers_are(reliability, expected):
    found = ends(*(QosProfile(one) for one in reliability))
    assert subscription_qos(found).reliability is expected


@pytest.mark.parametrize(
    ("durability", "expected"),
    [
        ([VOLATILE], VOLATILE),
        ([LATCHED], LATCHED),
        ([LATCHED, LATCHED], LATCHED),
        ([LATCHED, VOLATILE], VOLATILE),
    ],
)
def test_transient_local_when_all_publishers_are(durability, expected):
    found = ends(*(QosProfile(RELIABLE, one) for one in durability))
    assert subscription_qos(found).durability is expected


@pytest.mark.parametrize("reliability", list(Reliability))
@pytest.mark.parametrize("durability", list(Durability))
@pytest.mark.parametrize("other_reliability", list(Reliability))
@pytest.mark.parametrize("other_durability", list(Durability))
def test_every_publisher_and_subscriber_is_matched(
    reliability, durability, other_reliability, other_durability
):
    found = ends(
        QosProfile(reliability, durability), QosProfile(other_reliability, other_durability)
    )
    wanted = subscription_qos(found)
    offered = publisher_qos(found)
    assert all(end.qos.satisfies(wanted) for end in found)
    assert all(offered.satisfies(end.qos) for end in found)


@pytest.mark.parametrize(
    ("depths", "keep", "expected"),
    [
        ([1], 1, 10),
        ([0] * 30, 1, 30),  # unknown depths count as one: /tf_static
        ([30, 30], 1, 60),
        ([1000], 1, 100),
        ([1], 500, 500),
    ],
)
def test_depth_has_room_for_all_publishers_and_for_keep(depths, keep, expected):
    found = ends(*(QosProfile(RELIABLE, LATCHED, depth) for depth in depths))
    assert subscription_qos(found, keep).depth == expected


def test_depth_of_volatile_publishers_changes_nothing():
    assert subscription_qos(ends(QosProfile(depth=1), QosProfile(depth=50))).depth == 10


def test_a_burst_has_room_as_far_as_messages_are_small():
    found = ends(QosProfile(depth=1))
    assert subscription_qos(found, 1, Bulk.NOTHING).depth == 1000
    assert subscription_qos(found, 5000, Bulk.NOTHING).depth == 5000
    assert subscription_qos(found, 1, Bulk.NUMBERS).depth == 100
    assert subscription_qos(found, 1, Bulk.BYTES).depth == 10


def test_published_commands_are_kept_for_late_subscribers_only_where_one_asks():
    assert publisher_qos([]) == QosProfile(RELIABLE, VOLATILE, 10)
    volatile, latched = QosProfile(BEST_EFFORT, VOLATILE), QosProfile(RELIABLE, LATCHED)
    assert publisher_qos(ends(volatile)).durability is VOLATILE
    assert publisher_qos(ends(volatile, latched)) == QosProfile(RELIABLE, LATCHED, 1)
    assert publisher_qos(ends(latched), 5).depth == 5


def test_mqtt_qos_and_retain():
    assert mqtt_qos(QosProfile(BEST_EFFORT)) == 0
    assert mqtt_qos(QosProfile(RELIABLE)) == 1
    assert not mqtt_retain(QosProfile(RELIABLE, VOLATILE))
    assert mqtt_retain(QosProfile(RELIABLE, LATCHED))
