"""The soak's oracle finds what is wrong with made-up histories, and nothing in right ones."""

from __future__ import annotations

import itertools

import pytest

from appliance.mqtt.packets import Publish, Subscription
from soak.model import Model
from soak.records import Grant, Message, Session
from soak.rights import SHARE, Rights, acl, matches

RIGHTS = {
    "all": Rights(("t/#",), ("t/#",)),
    "fenced": Rights(("t/#",), ("t/#",), ("t/secret/#",)),
    "reader": Rights(("t/#",), ()),
}
ALL = RIGHTS["all"]


@pytest.fixture
def model() -> Model:
    ticks = itertools.count()
    return Model(RIGHTS, lambda: float(next(ticks)))


def kinds(model: Model) -> list[str]:
    return [violation.kind for violation in model.violations]


def subscribe(model: Model, session: Session, topic_filter: str, qos: int) -> Grant:
    grant = model.subscribing(session, Subscription(topic_filter, qos))
    model.subscribed(session, topic_filter, grant)
    return grant


def publish(
    model: Model, topic: str, qos: int, *, acknowledge: bool = True, retain: bool = False
) -> Message:
    message = model.message("pub", ALL, topic, qos, retain=retain)
    model.sent(message)
    if acknowledge:
        model.acknowledged(message, "PUBACK")
    return message


def deliver(
    model: Model,
    session: Session,
    message: Message,
    qos: int,
    *,
    dup: bool = False,
    retain: bool = False,
) -> None:
    packet_id = 1 if qos else None
    packet = Publish(message.topic, message.payload, qos, retain, dup, packet_id)
    known = model.identify(session, packet)
    assert known is message
    model.delivered(session, packet, message)


@pytest.mark.parametrize(
    ("topic_filter", "topic", "expected"),
    [
        ("a/#", "a", True),
        ("a/#", "a/b/c", True),
        ("a/#", "ab", False),
        ("a/+", "a/", True),
        ("a/+", "a", False),
        ("+/b", "a/b", True),
        ("#", "a/b", True),
        ("#", "$SYS/a", False),
        ("+/a", "$SYS/a", False),
        ("$SYS/#", "$SYS/a", True),
        ("$share/g/a/+", "a/b", True),
        ("a.b", "axb", False),
    ],
)
def test_filters_match_topics_as_section_4_7_says(
    topic_filter: str, topic: str, expected: bool
) -> None:
    assert matches(topic_filter, topic) is expected


def test_the_access_rules_become_an_acl_file_with_denials_first() -> None:
    lines = acl({"u": Rights(("r",), ("w",), ("d/#",))}).splitlines()
    assert lines == ["user u", "topic deny d/#", "topic read r", "topic write w"]


def test_a_right_history_is_right(model: Model) -> None:
    session = model.begin("sub", ALL)
    subscribe(model, session, "t/+", 1)
    for qos in (0, 1, 2):
        deliver(model, session, publish(model, "t/a", qos), min(qos, 1))
    late = publish(model, "t/a", 1, acknowledge=False)
    deliver(model, session, late, 1)
    model.acknowledged(late, "PUBACK")
    assert model.owed == 0
    model.finish()
    assert kinds(model) == []


@pytest.mark.parametrize("qos", [1, 2])
def test_an_acknowledged_message_that_never_comes_is_lost(model: Model, qos: int) -> None:
    session = model.begin("sub", ALL)
    subscribe(model, session, "t/+", 2)
    publish(model, "t/a", qos)
    assert model.owed == 1
    model.finish()
    assert kinds(model) == ["lost"]
    assert "message 1 of pub to t/a" in str(model.violations[0])


def test_what_may_get_lost_is_not_owed(model: Model) -> None:
    session = model.begin("sub", ALL)
    early = publish(model, "t/a", 1, acknowledge=False)
    subscribe(model, session, "t/+", 1)
    model.acknowledged(early, "PUBACK")
    publish(model, "t/a", 0)
    publish(model, "t/a", 1, acknowledge=False)
    model.refused(publish(model, "t/a", 1, acknowledge=False), 0x97, "PUBACK")
    subscribe(model, session, "t/b", 0)
    grant = model.subscribing(session, Subscription("t/+", 0))
    during = publish(model, "t/a", 1)
    model.subscribed(session, "t/+", grant)
    publish(model, "t/a", 1)
    model.unsubscribing(session, "t/+")
    publish(model, "t/a", 1)
    assert not session.owed and during.outcome == "acknowledged"
    model.finish()
    assert kinds(model) == []


def test_a_subscription_that_is_replaced_is_not_interrupted(model: Model) -> None:
    session = model.begin("sub", ALL)
    subscribe(model, session, "t/+", 1)
    grant = model.subscribing(session, Subscription("t/+", 2))
    message = publish(model, "t/a", 2)
    model.subscribed(session, "t/+", grant)
    assert session.owed[message].qos == 1
    model.finish()
    assert kinds(model) == ["lost"]


def test_a_session_that_ends_is_owed_what_was_passed_over(model: Model) -> None:
    session = model.begin("sub", ALL)
    subscribe(model, session, "t/+", 1)
    publish(model, "t/a", 1)
    deliver(model, session, publish(model, "t/a", 1), 1)
    publish(model, "t/a", 1)
    model.end(session)
    assert kinds(model) == ["lost"]
    assert model.counts["void"] == 2


@pytest.mark.parametrize("qos", [0, 1, 2])
def test_a_second_time_is_once_too_often(model: Model, qos: int) -> None:
    session = model.begin("sub", ALL)
    subscribe(model, session, "t/+", 2)
    message = publish(model, "t/a", qos)
    deliver(model, session, message, qos)
    deliver(model, session, message, qos)
    assert kinds(model) == ["duplicate"]


@pytest.mark.parametrize(("qos", "expected"), [(1, []), (2, ["duplicate"])])
def test_what_the_publisher_had_to_send_again_may_come_again(
    model: Model, qos: int, expected: list[str]
) -> None:
    session = model.begin("sub", ALL)
    subscribe(model, session, "t/+", 2)
    message = publish(model, "t/a", qos, acknowledge=False)
    model.sent(message, " again")
    model.acknowledged(message, "PUBACK")
    deliver(model, session, message, qos)
    deliver(model, session, message, qos)
    assert kinds(model) == expected


def test_first_arrivals_are_in_the_order_of_sending(model: Model) -> None:
    session = model.begin("sub", ALL)
    subscribe(model, session, "t/#", 2)
    first, second = publish(model, "t/a", 1), publish(model, "t/a", 1)
    other = publish(model, "t/b", 1)
    deliver(model, session, other, 1)
    deliver(model, session, second, 1)
    assert kinds(model) == []
    deliver(model, session, first, 1)
    assert kinds(model) == ["order"]


def test_what_nobody_sent_or_subscribed_to_must_not_come(model: Model) -> None:
    session = model.begin("sub", ALL)
    subscribe(model, session, "t/a", 1)
    elsewhere = publish(model, "t/b", 1)
    deliver(model, session, elsewhere, 1)
    before = model.message("pub", ALL, "t/a", 1)
    deliver(model, session, before, 1)
    model.identify(session, Publish("t/a", b"pub 99 1 t/a\n"))
    model.identify(session, Publish("t/a", b""))
    assert kinds(model) == ["not subscribed", "invented", "invented", "invented"]


def test_a_subscription_that_was_given_up_gets_nothing_new(model: Model) -> None:
    session = model.begin("sub", ALL)
    subscribe(model, session, "t/a", 1)
    before = publish(model, "t/a", 1)
    model.unsubscribing(session, "t/a")
    during = publish(model, "t/a", 1)
    model.unsubscribed(session, "t/a", model.clock() - 2)
    after = publish(model, "t/a", 1)
    for message in (before, during, after):
        deliver(model, session, message, 1)
    assert kinds(model) == ["not subscribed"]


def test_a_suback_for_what_was_given_up_meanwhile_owes_nothing(model: Model) -> None:
    session = model.begin("sub", ALL)
    grant = model.subscribing(session, Subscription("t/a", 1))
    model.unsubscribing(session, "t/a")
    model.subscribed(session, "t/a", grant)
    publish(model, "t/a", 1)
    assert model.owed == 0 and not model.holds(session, "t/a")


def test_a_changed_payload_is_found(model: Model) -> None:
    session = model.begin("sub", ALL)
    subscribe(model, session, "t/a", 1)
    message = publish(model, "t/a", 1)
    model.identify(session, Publish("t/a", message.payload + b"!"))
    assert kinds(model) == ["changed"]


@pytest.mark.parametrize(("granted", "received"), [(1, 2), (1, 0), (2, 1)])
def test_the_qos_is_the_lesser_of_the_two(model: Model, granted: int, received: int) -> None:
    session = model.begin("sub", ALL)
    subscribe(model, session, "t/a", granted)
    deliver(model, session, publish(model, "t/a", 2), received)
    assert "QoS" in kinds(model)


def test_access_is_kept_both_ways(model: Model) -> None:
    fenced = model.begin("fenced", RIGHTS["fenced"])
    subscribe(model, fenced, "t/#", 1)
    secret = publish(model, "t/secret/a", 1)
    assert model.owed == 0
    deliver(model, fenced, secret, 1)
    forbidden = model.message("reader", RIGHTS["reader"], "t/a", 1)
    model.sent(forbidden)
    deliver(model, fenced, forbidden, 1)
    assert kinds(model) == ["not permitted", "not permitted"]
    assert not RIGHTS["fenced"].may_subscribe("t/secret/+")


def test_retained_messages_come_with_the_subscription(model: Model) -> None:
    old, new = (publish(model, "t/a", 1, retain=True) for _ in range(2))
    session = model.begin("sub", ALL)
    subscribe(model, session, "t/#", 1)
    assert model.owed == 1
    deliver(model, session, new, 1, retain=True)
    assert model.owed == 0
    deliver(model, session, old, 1, retain=True)
    deliver(model, session, new, 1, retain=True)
    assert kinds(model) == ["stale", "duplicate"]
    model.finish()
    other = model.begin("other", ALL)
    subscribe(model, other, "t/a", 1)
    model.finish()
    assert kinds(model)[-1] == "lost retained"


def test_a_retained_message_is_stale_only_if_no_earlier_subscribe_can_have_asked(
    model: Model,
) -> None:
    old = publish(model, "t/a", 1, retain=True)
    session = model.begin("sub", ALL)
    subscribe(model, session, "t/a", 1)
    new = publish(model, "t/a", 1, retain=True)
    again = model.subscribing(session, Subscription("t/a", 1))
    deliver(model, session, old, 1, retain=True)  # it was on its way
    model.subscribed(session, "t/a", again)
    deliver(model, session, old, 1, dup=True, retain=True)  # sent again to another connection
    assert kinds(model) == []
    deliver(model, session, old, 1, retain=True)
    assert kinds(model) == ["stale"]
    deliver(model, session, new, 1, retain=True)


def test_a_shared_subscription_is_owed_each_message_once(model: Model) -> None:
    members = [model.begin(name, ALL) for name in ("one", "two")]
    for session in members:
        subscribe(model, session, f"{SHARE}g/t/#", 2)
    first, second = publish(model, "t/a", 2), publish(model, "t/a", 1)
    assert model.owed == 2
    deliver(model, members[0], first, 2)
    deliver(model, members[1], second, 1)
    assert model.owed == 0 and kinds(model) == []
    model.left(members[1])
    deliver(model, members[0], second, 1)  # the other left before it had acknowledged it
    assert kinds(model) == []
    deliver(model, members[1], first, 2)
    publish(model, "t/a", 1)
    model.finish()
    assert kinds(model) == ["duplicate", "lost"]
