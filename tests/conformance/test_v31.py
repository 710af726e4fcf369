"""MQTT 3.1, as old devices speak it: taken as 3.1.1, where that forbids what 3.1 allowed."""

from __future__ import annotations

import logging

import pytest
from broker.conftest import FakeAccess, Peer
from client_v311 import ACCEPTED, Client, connect, wire

from appliance.broker.broker import Broker
from appliance.broker.values import Action

CLEAN_SESSION = 0x02


def hello(client_id: str = "c", **options) -> bytes:
    return connect(client_id, name="MQIsdp", level=3, **options)


def join(broker: Broker, client_id: str = "c", **options) -> Client:
    client = Client(broker)
    assert client.log_in(hello(client_id, **options)) == ACCEPTED
    return client


def test_it_logs_in_and_says_so(broker: Broker, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    client = join(broker)
    assert client.say("c0 00") == wire("d0 00")
    assert "connected: MQTT 3.1, keep alive" in caplog.text


def test_the_length_of_a_client_id_is_not_limited_to_23(broker: Broker) -> None:
    """As in every broker today, and in 3.1.1."""
    join(broker, "x" * 100)


@pytest.mark.parametrize("flags", [0, CLEAN_SESSION])
def test_a_client_id_is_needed(broker: Broker, flags: int) -> None:
    """Section 3.1: an empty one is not valid, whatever Clean Session says."""
    client = Client(broker)
    assert client.say(hello("", flags=flags)) == wire("20 02 00 02")
    assert client.closed


def test_the_reserved_flag_is_not_looked_at(broker: Broker) -> None:
    join(broker, flags=CLEAN_SESSION | 1)


def test_session_present_is_not_said(broker: Broker) -> None:
    """Section 3.2: that byte is reserved."""
    client = join(broker, flags=0)
    assert client.say("82 06 0001 0001 61 01") == wire("90 03 0001 01")
    client.lose()
    again = join(broker, flags=0)
    assert "c" in broker.sessions and again.say("c0 00") == wire("d0 00")
    assert broker.sessions["c"].subscriptions


@pytest.mark.parametrize("first", ["82", "8a", "80"])
def test_requests_may_be_marked_as_duplicates(broker: Broker, first: str) -> None:
    """Sections 3.8 and 3.10; DUP says that it comes again, and the rest is not looked at."""
    client = join(broker)
    assert client.say(f"{first} 06 0001 0001 61 01") == wire("90 03 0001 01")
    other = {"82": "a2", "8a": "aa", "80": "a0"}[first]
    assert client.say(f"{other} 05 0002 0001 61") == wire("b0 02 0002")


@pytest.mark.parametrize("first", ["62", "6a"])
def test_qos_2_with_a_repeated_pubrel(broker: Broker, first: str) -> None:
    reader = Peer(broker, 5)
    reader.connect("reader")
    reader.subscribe("a")
    client = join(broker)
    assert client.say("34 06 0001 61 0007 78") == wire("50 02 0007")
    assert client.say(f"{first} 02 0007") == wire("70 02 0007")
    assert client.say(f"{first} 02 0007") == wire("70 02 0007")
    assert reader.payloads() == [b"x"]


def test_messages_to_and_from_others(broker: Broker) -> None:
    """The bytes of 3.1.1, also on the way that spares taking them apart."""
    old, new = join(broker, "old"), Client(broker)
    assert new.log_in(connect("new")) == ACCEPTED
    for client in (old, new):
        assert client.say("82 06 0001 0001 61 00") == wire("90 03 0001 00")
    for sender, other in ((old, new), (new, old)):
        for _ in range(2):
            message = wire("30 04 0001 61 78")
            assert (sender.say(message), other.hear()) == (message, message)


def test_a_refused_subscription_is_told_all_the_same(broker: Broker, access: FakeAccess) -> None:
    """3.1 has no way to say so. To be granted what is not given is worse than an unknown byte."""
    client = join(broker)
    access.deny("user", Action.SUBSCRIBE, "a")
    assert client.say("82 06 0001 0001 61 01") == wire("90 03 0001 80")
