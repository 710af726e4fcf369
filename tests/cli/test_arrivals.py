"""When messages come, and how many a second."""

from __future__ import annotations

from itertools import count

from appliance.cli import arrivals
from appliance.cli.arrivals import Arrivals


def test_the_rate_of_each_topic() -> None:
    times = iter((0.0, 0.0, 0.1, 0.2, 1.0))
    noted = Arrivals(lambda: next(times))
    told = [noted.note(topic).split()[1] for topic in ("a", "b", "a", "a", "b")]
    assert told == ["-", "-", "10.0", "10.0", "1.0"]


def test_topics_are_bounded() -> None:
    clock = count()
    noted = Arrivals(lambda: next(clock))
    for number in range(arrivals.TOPICS + 5):
        noted.note(f"t/{number}")
    assert len(noted._times) == arrivals.TOPICS
    for _ in range(arrivals.MESSAGES * 2):
        noted.note("a")
    assert len(noted._times["a"]) == arrivals.MESSAGES
