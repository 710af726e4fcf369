"""What QoS to use, given the endpoints found on a topic: pure (CONVENTIONS, QoS)."""

from __future__ import annotations

from collections.abc import Sequence

from appliance.ros.node import Durability, Endpoint, QosProfile, Reliability
from appliance.ros.payload.definitions import Bulk

#: ROS's own default, and enough for a reader that is fast.
DEPTH = 10

#: For messages that are small: a burst of them, or a second of 1 kHz in which nobody took any.
BURST = 1000

#: What a subscription has room for, by what can make its messages large.
ROOM = {Bulk.NOTHING: BURST, Bulk.NUMBERS: 100, Bulk.BYTES: DEPTH}

#: For requests and answers: many clients may wait for theirs at the same time. With ROS's own depth
#: of 10, what comes on top of these is lost, and who asked waits in vain.
CALLS = QosProfile(depth=BURST)

#: Publishers' depths add up to no more than this: a stalled reader holds so many samples.
MAX_DEPTH = 100


def subscription_qos(
    publishers: Sequence[Endpoint], keep: int = 1, bulk: Bulk = Bulk.BYTES
) -> QosProfile:
    """What to subscribe with, to be matched with all of `publishers` and lose the least.

    Without publishers: best effort and volatile, which matches whatever appears. `keep` is how many
    samples the route wants to queue; the middleware holds at least as many, and a burst of messages
    as far as their `bulk` allows: what it has no room for is lost, whoever listens on MQTT.
    """
    reliable = all(end.qos.reliability is Reliability.RELIABLE for end in publishers)
    latched = all(end.qos.durability is Durability.TRANSIENT_LOCAL for end in publishers)
    # A late subscriber's history has to have room for what every publisher keeps for it, and a
    # topic without keys has one history for all of them (/tf_static: many that keep one sample
    # each), so their depths add up. A depth that discovery did not tell counts as one.
    kept = sum(max(1, end.qos.depth) for end in publishers) if latched else 0
    return QosProfile(
        Reliability.RELIABLE if publishers and reliable else Reliability.BEST_EFFORT,
        Durability.TRANSIENT_LOCAL if publishers and latched else Durability.VOLATILE,
        max(keep, ROOM[bulk], min(kept, MAX_DEPTH)),
    )


def publisher_qos(subscribers: Sequence[Endpoint], keep: int = 1) -> QosProfile:
    """What to publish with, to be matched with all of `subscribers`.

    Reliable is matched with every subscription. Transient local would be too, but it hands the last
    message, which may be an old command, to whoever subscribes late: only where one asks for it,
    and no more of them than the `keep` of the route.
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
