"""The limits of a fleet's broker: of its kind, and what its CONNACK announces."""

from __future__ import annotations

import pytest

from appliance.mqtt.codec import V5, V311, Properties, Property
from appliance.upstream.limits import (
    KINDS,
    LARGEST_PACKET,
    FleetLimits,
    alpn,
    kind_of_host,
)
from appliance.upstream.rules import BrokerKind

ANNOUNCED: Properties = {
    Property.RECEIVE_MAXIMUM: 20,
    Property.MAXIMUM_QOS: 1,
    Property.RETAIN_AVAILABLE: 0,
    Property.MAXIMUM_PACKET_SIZE: 1000,
    Property.TOPIC_ALIAS_MAXIMUM: 16,
    Property.WILDCARD_SUBSCRIPTION_AVAILABLE: 0,
    Property.SUBSCRIPTION_IDENTIFIER_AVAILABLE: 0,
    Property.SHARED_SUBSCRIPTION_AVAILABLE: 0,
    Property.SERVER_KEEP_ALIVE: 5,
}


def test_what_a_connack_announces_holds() -> None:
    found = KINDS["generic"].announced(ANNOUNCED, V5)
    assert found == FleetLimits(
        window=20,
        qos=1,
        retain=False,
        packet_size=1000,
        topic_aliases=16,
        wildcards=False,
        identifiers=False,
        shared=False,
        server_keep_alive=5,
    )
    assert found.keep_alive(30) == 5


def test_what_it_does_not_name_is_the_standards_default() -> None:
    for properties in (None, {}):
        assert KINDS["generic"].announced(properties, V5) == FleetLimits(topic_aliases=0)


def test_the_lower_of_both_holds() -> None:
    more: Properties = {
        Property.TOPIC_ALIAS_MAXIMUM: 65_535,
        Property.MAXIMUM_PACKET_SIZE: 1 << 20,
        Property.RETAIN_AVAILABLE: 1,
        Property.SUBSCRIPTION_IDENTIFIER_AVAILABLE: 1,
    }
    found = KINDS["azure-event-grid"].announced(more, V5)
    assert (found.topic_aliases, found.packet_size, found.qos) == (10, 512 << 10, 1)
    assert (found.retain, found.identifiers) == (False, False)
    aws = KINDS["aws-iot"]
    assert aws.announced(ANNOUNCED, V5).packet_size == 1000
    assert aws.announced(ANNOUNCED, V5).window == 20
    assert aws.announced({}, V5).window == aws.announced(None, V311).window == 100


def test_3_1_1_announces_nothing() -> None:
    found = KINDS["generic"].announced(None, V311)
    assert (found.window, found.packet_size, found.retain) == (65_535, LARGEST_PACKET, True)
    assert (found.topic_aliases, found.identifiers, found.user_properties) == (0, False, False)
    assert not found.auth and not found.shared and found.wildcards


@pytest.mark.parametrize(
    ("kind", "wanted", "used"),
    [
        ("generic", 30, 30),
        ("aws-iot", 10, 30),
        ("aws-iot", 5000, 1200),
        ("aws-iot", 300, 300),
        ("azure-event-grid", 5000, 1160),
        ("rabbitmq", 65_535, 65_535),
    ],
)
def test_keep_alive(kind: BrokerKind, wanted: int, used: int) -> None:
    assert KINDS[kind].keep_alive(wanted) == used


def test_a_server_that_wants_no_keep_alive() -> None:
    announced = KINDS["generic"].announced({Property.SERVER_KEEP_ALIVE: 0}, V5)
    assert announced.keep_alive(30) == 0


@pytest.mark.parametrize(
    ("topic", "size", "why"),
    [
        ("a/b/c/d/e/f/g/h", 128 << 10, ""),
        ("a/b/c/d/e/f/g/h/i", 100, "a topic with 8 slashes, and 7 is the most"),
        ("x" * 256, 1000, ""),
        ("ü" * 129, 1000, "a topic of 258 bytes, and 256 is the most"),
        ("a", (128 << 10) + 1, "131073 bytes, and 131072 is the most"),
        ("$aws/rules/name/a/b/c/d/e/f/g/h", 100, ""),
        ("$aws/rules/name/a/b/c/d/e/f/g/h/i", 100, "a topic with 8 slashes, and 7 is the most"),
    ],
)
def test_what_aws_does_not_take(topic: str, size: int, why: str) -> None:
    assert KINDS["aws-iot"].unsendable(topic, size) == why
    assert KINDS["generic"].unsendable(topic, size) == ""


def test_filters_with_wildcards() -> None:
    limits = KINDS["generic"].announced(ANNOUNCED, V5)
    assert limits.unusable("a/+") == limits.unusable("#") == "no wildcards in subscriptions"
    assert limits.unusable("a/b") == ""


def test_rates() -> None:
    generic, aws = KINDS["generic"], KINDS["aws-iot"]
    assert generic.rates(None, None) == (None, None)
    assert generic.rates(3.0, 1000) == (3.0, 1000)
    assert aws.rates(None, None) == (100, 512 << 10)
    assert aws.rates(3.0, 1 << 30) == (3.0, 512 << 10)


def test_a_kind_by_its_host() -> None:
    assert kind_of_host("x-ats.iot.eu-west-1.amazonaws.com") == "aws-iot"
    assert kind_of_host("ns.westeurope-1.TS.eventgrid.azure.net") == "azure-event-grid"
    assert kind_of_host("amazonaws.com.example") is None


def test_alpn_on_port_443() -> None:
    assert alpn("aws-iot", 443, (), has_login=False) == ["x-amzn-mqtt-ca"]
    assert alpn("aws-iot", 443, (), has_login=True) == ["mqtt"]
    assert alpn("aws-iot", 443, ("mine",), has_login=False) == ["mine"]
    assert alpn("aws-iot", 8883, (), has_login=False) == []
    assert alpn("generic", 443, (), has_login=False) == []
