"""Which version of MQTT each server is spoken to in."""

from __future__ import annotations

from appliance.mqtt.codec import V5, V311
from appliance.upstream.versions import ServerVersions


def test_a_server_that_says_that_it_does_not_know_mqtt_5_is_believed():
    versions = ServerVersions(V5)
    versions.refused(1)
    versions.answered(1, V311)
    assert [versions.of(server) for server in range(3)] == [V5, V311, V5]


def test_two_closes_in_a_row_are_followed_by_one_try_of_3_1_1():
    versions = ServerVersions(V5)
    tried = []
    for _ in range(7):  # of a proxy whose broker is down
        tried.append(versions.of(0))
        at_once = versions.closed(0, tried[-1])
        assert at_once == (versions.of(0) == V311)
    assert tried == [V5, V5, V311, V5, V5, V311, V5]
    assert versions.of(1) == V5


def test_a_server_that_has_accepted_3_1_1_is_asked_for_5_once_each_time():
    versions = ServerVersions(V5)
    versions.closed(0, V5)
    assert versions.closed(0, V5)
    versions.answered(0, V311)
    assert versions.of(0) == V5  # it may have been a proxy, or be a newer one now
    assert versions.closed(0, V5) and versions.of(0) == V311
    versions.answered(0, V311)
    versions.answered(0, V5)
    assert not versions.closed(0, V5)


def test_who_refuses_a_login_in_3_1_1_is_closed_once_and_asked_again():
    versions = ServerVersions(V5)
    versions.closed(0, V5)
    versions.closed(0, V5)
    versions.answered(0, V311)  # CONNACK with an error
    assert versions.of(0) == V5 and versions.closed(0, V5) and versions.of(0) == V311


def test_a_try_of_3_1_1_that_shows_nothing_is_not_repeated():
    versions = ServerVersions(V5)
    versions.closed(0, V5)
    versions.failed(0)  # before the second close: closes are still in a row
    assert versions.closed(0, V5) and versions.of(0) == V311
    versions.failed(0)
    assert [versions.of(0), versions.closed(0, V5), versions.of(0)] == [V5, False, V5]


def test_3_1_1_stays_3_1_1():
    versions = ServerVersions(V311)
    for _ in range(3):
        assert not versions.closed(0, V311) and versions.of(0) == V311
