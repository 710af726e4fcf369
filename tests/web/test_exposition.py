"""Prometheus's text format; the oracle is the parser of `prometheus_client`."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families

from appliance.broker.histogram import BOUNDS, Histogram
from appliance.web.exposition import SHOWN, Exposition, labels


def parsed(found: Exposition) -> dict[str, tuple[str, dict[tuple[str, ...], float]]]:
    """By family: its kind, and its samples by name and label values."""
    return {
        family.name: (
            family.type,
            {(each.name, *each.labels.values()): each.value for each in family.samples},
        )
        for family in text_string_to_metric_families(bytes(found).decode())
    }


def test_what_it_says():
    found = Exposition()
    found.gauge("size", "How large it is.", 3)
    found.counter("done_total", "What was done.", 12345678901234567890)
    found.family("gauge", "a", "None.", [])
    found.family("gauge", "open_fds", "Files.", [("", math.inf)], prefix="process_")
    found.family("gauge", "b", "Two.", [(labels(x="1"), 0.1), (labels(x="2"), -math.inf)])
    assert parsed(found) == {
        "appliance_size": ("gauge", {("appliance_size",): 3.0}),
        "appliance_done": ("counter", {("appliance_done_total",): 12345678901234567890}),
        "appliance_a": ("gauge", {}),
        "process_open_fds": ("gauge", {("process_open_fds",): math.inf}),
        "appliance_b": (
            "gauge",
            {("appliance_b", "1"): 0.1, ("appliance_b", "2"): -math.inf},
        ),
    }
    assert bytes(found).endswith(b"\n")


@given(
    st.text(alphabet=st.characters(exclude_categories=["Cs", "Cc"]) | st.just("\n"), max_size=20)
)
def test_labels_are_what_they_were(value: str):
    found = Exposition()
    found.family("gauge", "x", "X.", [(labels(name=value, other='"\\'), 1)])
    found.histograms("y", "Y.", [(labels(name=value), Histogram())])
    families = parsed(found)
    assert families["appliance_x"][1] == {("appliance_x", value, '"\\'): 1.0}
    assert families["appliance_y"][1]["appliance_y_count", value] == 0.0


@given(st.lists(st.floats(0, 10), max_size=30))
def test_histograms(durations: list[float]):
    histogram = Histogram()
    for each in durations:
        histogram.observe(each)
    found = Exposition()
    found.histograms("t", "T.", [(labels(route="100 %d"), histogram)])
    kind, samples = parsed(found)["appliance_t"]
    assert kind == "histogram"
    assert samples["appliance_t_count", "100 %d"] == len(durations)
    assert math.isclose(samples["appliance_t_sum", "100 %d"], sum(durations), abs_tol=1e-9)
    for bound in (BOUNDS[place] for place in SHOWN):
        below = sum(each <= bound for each in durations)
        assert samples["appliance_t_bucket", "100 %d", repr(bound)] == below
    assert samples["appliance_t_bucket", "100 %d", "+Inf"] == len(durations)
