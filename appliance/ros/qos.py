"""Chooses the QoS for a topic from the endpoints found on it; pure."""

from __future__ import annotations

from collections.abc import Sequence

from appliance.ros.node import Durability, Endpoint, QosProfile, Reliability
from appliance.ros.payload.definitions import Bulk

#: ROS's own default, and enough for a fast reader.
DEPTH = 10

#: The depth for small messages: a burst, or a second at 1 kHz in which none was taken.
BURST = 1000

#: The depth of a subscription, by what can make its messages large.
ROOM = {Bulk.NOTHING: BURST, Bulk.NUMBERS: 100, Bulk.BYTES: DEPTH}

#: For requests and responses: many clients may await a response at the same time. With ROS's own
#: depth of 10 the others are lost, and their clients never get a response.
CALLS = QosProfile(depth=BURST)

#: The limit for the sum of the publishers' depths: a stalled reader holds so many samples.
MAX_DEPTH = 100


def subscription_qos(
    publishers: Sequence[Endpoint], keep: int = 1, bulk: Bulk = Bulk.BYTES
) -> QosProfile:
    """The QoS to subscribe with: it matches all of `publishers` and loses the least.

    Without publishers it is best effort and volatile, which matches any. `keep` is how many samples
    the route queues; the middleware holds at least as many, and a burst of messages if their `bulk`
    allows it: a sample that it has no room for is lost for all of MQTT.
    """
    reliable = all(end.qos.reliability is Reliability.RELIABLE for end in publishers)
    latched = all(end.qos.durability is Durability.TRANSIENT_LOCAL for end in publishers)
    # A late subscriber's history needs room for the samples that every publisher holds for it, and
    # a topic without keys has one history for all publishers (/tf_static: many with one sample
    # each), so their depths add up. A depth that discovery does not report counts as one.
    latched_depth = sum(max(1, end.qos.depth) for end in publishers) if latched else 0
    return QosProfile(
        Reliability.RELIABLE if publishers and reliable else Reliability.BEST_EFFORT,
        Durability.TRANSIENT_LOCAL if publishers and latched else Durability.VOLATILE,
        max(keep, ROOM[bulk], min(latched_depth, MAX_DEPTH)),
    )


def publisher_qos(subscribers: Sequence[Endpoint], keep: int = 1) -> QosProfile:
    """The QoS to publish with: it matches all of `subscribers`.

    Reliable matches every subscription. So does transient local, but it delivers the last message,
    which may be an old command, to late subscribers: it is used only if a subscription requests it,
    and with no more samples than the `keep` of the route.
    """
    latched = any(end.qos.durability is Durability.TRANSIENT_LOCAL for end in subscribers)
    return QosProfile(
        Reliability.RELIABLE,
        Durability.TRANSIENT_LOCAL if latched else Durability.VOLATILE,
        keep if latched else max(keep, DEPTH),
    )


def mqtt_qos(profile: QosProfile) -> int:
    """The MQTT QoS of a ROS topic's messages: best effort is 0, reliable 1."""
    return 1 if profile.reliability is Reliability.RELIABLE else 0


def mqtt_retain(profile: QosProfile) -> bool:
    """Whether a ROS topic's messages are retained on MQTT: transient local ones are."""
    return profile.durability is Durability.TRANSIENT_LOCAL
