"""Which server is dialled next, and when."""

from __future__ import annotations

import random

from appliance.upstream.backoff import (
    CONTESTED,
    LASTED,
    LONGEST,
    LONGEST_RETURN,
    RETURN_AFTER,
    SHORTEST,
    Backoff,
)


def test_the_bound_doubles_up_to_less_than_a_minute():
    backoff = Backoff(1, lambda: 1.0)
    waits = [backoff.failed(n) for n in range(9)]
    assert waits == [1, 2, 4, 8, 16, 32, 45, 45, 45]
    assert backoff.failed(9) <= LONGEST
    for n in range(2000):  # no overflow
        assert backoff.failed(n) == LONGEST


def test_waits_are_spread_over_the_whole_bound():
    backoff = Backoff(1, random.Random(1).random)
    for n in range(7):
        backoff.failed(n)
    waits = [backoff.failed(7) for _ in range(1000)]
    assert 0 <= min(waits) < 2 and 43 < max(waits) <= LONGEST
    assert 19 < sum(waits) / len(waits) < 26


def test_a_connection_that_lasted_makes_waits_short_again_and_keeps_its_server():
    backoff = Backoff(2, lambda: 1.0)
    for n in range(7):
        backoff.failed(n)
    assert backoff.server == 1
    backoff.connected(10)
    assert backoff.failed(10 + LASTED) == SHORTEST
    assert backoff.server == 1
    assert backoff.failed(50) == SHORTEST and backoff.server == 0


def test_a_connection_that_ends_at_once_counts_as_a_failure():
    """A broker that accepts and closes is not dialled a hundred times a second."""
    backoff = Backoff(1, lambda: 1.0)
    waits = []
    for n in range(4):
        backoff.connected(n)
        waits.append(backoff.failed(n + 0.5))
    assert waits == [1, 2, 4, 8]


def test_servers_are_tried_in_order_before_the_bound_grows():
    backoff = Backoff(3, lambda: 1.0)
    tried = []
    for n in range(7):
        tried.append((backoff.server, backoff.failed(n)))
    assert tried == [(0, 1), (1, 1), (2, 1), (0, 2), (1, 2), (2, 2), (0, 4)]


def test_after_five_minutes_the_first_server_is_tried_again():
    backoff = Backoff(3, lambda: 1.0)
    backoff.failed(100)
    assert backoff.server == 1 and not backoff.is_return_due(101)
    backoff.connected(101)
    assert backoff.return_at == 100 + RETURN_AFTER
    assert not backoff.is_return_due(99 + RETURN_AFTER)
    assert backoff.is_return_due(100 + RETURN_AFTER)
    backoff.stayed(100 + RETURN_AFTER)
    assert not backoff.is_return_due(101 + RETURN_AFTER)
    assert backoff.is_return_due(100 + 2 * RETURN_AFTER)
    backoff.returned(100 + 2 * RETURN_AFTER)
    assert backoff.server == 0 and backoff.return_at is None


def test_a_connection_that_is_lost_after_five_minutes_is_followed_by_the_first_server():
    backoff = Backoff(3, lambda: 1.0)
    backoff.failed(0)
    backoff.connected(1)
    backoff.failed(RETURN_AFTER + 1)
    assert backoff.server == 0 and backoff.return_at is None


def test_a_first_server_that_answers_and_accepts_nothing_is_returned_to_less_and_less_often():
    backoff = Backoff(2, lambda: 1.0)
    now = 0.0
    backoff.failed(now)
    intervals = []
    for _ in range(6):
        backoff.connected(now)
        assert backoff.server == 1 and backoff.return_at is not None
        intervals.append(backoff.return_at - now)
        now = backoff.return_at
        backoff.returned(now)
        backoff.failed(now)
    assert intervals == [300, 600, 1200, 2400, LONGEST_RETURN, LONGEST_RETURN]
    now = backoff.return_at or 0
    backoff.returned(now)
    backoff.connected(now)
    backoff.failed(now + LASTED)  # a connection has lasted
    backoff.failed(now + LASTED)
    assert backoff.server == 1 and backoff.return_at == now + LASTED + RETURN_AFTER


def test_who_is_closed_on_three_times_a_minute_waits_for_a_minute():
    """As by mosquitto 2.0 when another client takes the client id over."""
    backoff = Backoff(1, lambda: 0.5)
    for now in (0, 20, 40):
        assert not backoff.is_contested(now)
        backoff.connected(now)
        wait = backoff.closed(now + 1)
    assert wait == CONTESTED and backoff.is_contested(41)
    backoff.connected(101)
    assert backoff.closed(102) < CONTESTED  # the third within a longer time


def test_closes_after_a_long_time_or_of_a_server_that_is_away_between_are_no_takeovers():
    backoff = Backoff(1, lambda: 0.5)
    for now in (0, LASTED, 2 * LASTED, 3 * LASTED):
        backoff.connected(now)
        assert backoff.closed(now + LASTED) == 0.5 * SHORTEST
    for now in (1000, 1010, 1020, 1030):
        backoff.connected(now)
        assert backoff.closed(now + 1) < CONTESTED
        backoff.failed(now + 2)  # it is started again


def test_who_is_taken_over_three_times_a_minute_waits_for_a_minute():
    backoff = Backoff(1, lambda: 0.5)
    for now in (0, 20):
        backoff.connected(now)
        assert backoff.taken_over(now) == 0.5 * SHORTEST
        assert not backoff.is_contested(now)
    assert backoff.taken_over(59) == CONTESTED
    assert backoff.is_contested(59)
    assert backoff.taken_over(59 + 61) == 0.5 * SHORTEST  # the third within a longer time


def test_after_the_clock_was_set_the_bound_is_the_first_again():
    """Certificates that were not valid yet may be now: who calls this dials at once."""
    backoff = Backoff(1, lambda: 1.0)
    for n in range(7):
        backoff.failed(n)
    backoff.clock_was_set()
    assert backoff.failed(8) == SHORTEST
