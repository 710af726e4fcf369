"""Quantiles of durations, in each bucket and above the last; compiled as well (test_compiled)."""

from __future__ import annotations

import pytest

from appliance.broker.histogram import BOUNDS, Histogram


def of(*durations: float) -> Histogram:
    histogram = Histogram()
    for seconds in durations:
        histogram.observe(seconds)
    return histogram


def test_there_is_no_quantile_of_nothing() -> None:
    assert Histogram().quantile(0.99) is None


@pytest.mark.parametrize("bucket", range(len(BOUNDS)))
def test_a_quantile_is_within_its_bucket(bucket: int) -> None:
    low, high = (0.0, *BOUNDS)[bucket : bucket + 2]
    histogram = of(*([(low + high) / 2] * 4))
    assert histogram.quantile(0.5) == pytest.approx(low + (high - low) / 2)
    assert histogram.quantile(1.0) == pytest.approx(high)


@pytest.mark.parametrize("seconds", [5.1, 45.0, 1e9])
def test_above_the_last_bucket_it_is_the_last_bound(seconds: float) -> None:
    """After a stall, such as that of a computer that has slept."""
    assert of(seconds).quantile(0.99) == 5.0
    assert of(*[0.0001] * 200, seconds).quantile(0.5) == pytest.approx(0.00005, rel=0.1)


def test_a_negative_duration_counts_as_none() -> None:
    histogram = of(-3.0, 0.3)
    assert histogram.total == 0.3
    assert histogram.counts[0] == 1
    both = of(0.3)
    both.add(histogram)
    assert sum(both.counts) == 3
    assert both.total == pytest.approx(0.6)
