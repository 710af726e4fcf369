"""Rates of a link: what passes in which time."""

from __future__ import annotations

import pytest

from appliance.upstream.rates import TokenBucket


@pytest.mark.parametrize("rate", [0.5, 1.0, 100.0, 30_000.0])
@pytest.mark.parametrize("start", [0.0, 1.8e9])
def test_no_more_than_the_rate_passes(rate: float, start: float) -> None:
    """A receiver that counts in any second sees little more than the rate, whenever that begins."""
    bucket = TokenBucket(rate, start)
    now = start + 100
    passed: list[float] = []
    while len(passed) < 3 * rate + 10:
        due = bucket.due(now)
        if due > now:
            now = due
        else:
            bucket.take(1)
            passed.append(now)
    within = max(1, int(1.05 * rate) + 2)  # of a second
    assert all(later - first > 0.999 for first, later in zip(passed, passed[within:], strict=False))
    assert passed[-1] - passed[0] == pytest.approx((len(passed) - 1) / rate, abs=0.06)


def test_bytes_of_a_large_message_are_waited_for_afterwards() -> None:
    bucket = TokenBucket(1000, 0.0)
    assert bucket.due(0.0) == 0.0
    bucket.take(10_050)
    assert bucket.due(5.0) == pytest.approx(10.001)
    assert bucket.due(10.1) == 10.1


def test_time_that_stands_still_or_runs_back_gives_nothing() -> None:
    bucket = TokenBucket(10, 5.0)
    bucket.take(1)
    for now in (5.0, 4.0, 5.0):
        assert bucket.due(now) == pytest.approx(5.1)
