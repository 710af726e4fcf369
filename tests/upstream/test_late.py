"""How old what comes from the fleet may be."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.upstream.late import LEAST_WINDOW, Freshness, Verdict, greatest_age, judge

TIMES = st.floats(0, 1e6)


def verdict(
    now: float = 10.0,
    arrived_at: float = 10.0,
    left_after: float = 9.8,
    late: float | None = 0.5,
    expiry: float | None = None,
    dup: bool = False,
    retain: bool = False,
) -> Verdict:
    return judge(
        now=now,
        arrived_at=arrived_at,
        left_after=left_after,
        late=late,
        expiry=expiry,
        dup=dup,
        retain=retain,
    )


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ({}, Verdict.TAKE),
        ({"left_after": 9.5}, Verdict.TAKE),
        ({"left_after": 9.49}, Verdict.LATE),
        ({"now": 10.31}, Verdict.LATE),  # it waited here
        ({"left_after": -math.inf}, Verdict.LATE),
        ({"left_after": math.nan}, Verdict.LATE),
        ({"left_after": -math.inf, "late": None}, Verdict.TAKE),
        ({"dup": True}, Verdict.REPEATED),
        ({"dup": True, "late": None}, Verdict.TAKE),
        ({"expiry": 0}, Verdict.EXPIRED),
        ({"expiry": 0, "late": None}, Verdict.EXPIRED),
        ({"expiry": 0, "retain": True}, Verdict.EXPIRED),
        ({"expiry": 1}, Verdict.TAKE),
        ({"expiry": 1, "arrived_at": 9.0}, Verdict.EXPIRED),
        ({"retain": True, "left_after": -math.inf, "dup": True}, Verdict.TAKE),
    ],
)
def test_verdicts(said: dict[str, float], expected: Verdict) -> None:
    assert verdict(**said) is expected  # type: ignore[arg-type]


def test_the_greatest_age_is_passed_on() -> None:
    assert greatest_age(now=10.0, left_after=9.75, dup=False, retain=False) == 0.25
    assert greatest_age(now=10.0, left_after=10.5, dup=False, retain=False) == 0.0
    for dup, retain in ((True, False), (False, True)):
        assert greatest_age(now=10.0, left_after=9.75, dup=dup, retain=retain) == math.inf


@given(TIMES, TIMES, st.none() | st.floats(0, 100), st.none() | st.floats(0, 100), st.booleans())
def test_nothing_that_is_taken_is_older_than_the_rule_allows(
    now: float, left_after: float, late: float | None, expiry: float | None, dup: bool
) -> None:
    taken = verdict(now, now, left_after, late, expiry, dup) is Verdict.TAKE
    age = greatest_age(now=now, left_after=left_after, dup=dup, retain=False)
    if taken and late is not None:
        assert age <= late


def test_what_was_sent_before_a_sleep_tells_nothing() -> None:
    """The clock stands still in sleep: what the fleet held meanwhile looks as if it were new."""
    freshness = Freshness()
    freshness.session_began(1.0)
    freshness.ping_sent()
    freshness.woke(2.0)
    assert freshness.left_after(0) == freshness.left_after(1) == -math.inf
    freshness.ping_answered(1.5)  # the one that was under way
    freshness.session_began(1.9)
    assert freshness.left_after(0) == freshness.left_after(1) == -math.inf
    freshness.ping_sent()
    freshness.ping_answered(2.0)
    assert freshness.left_after(0) == freshness.left_after(1) == 2.0


def test_an_answered_ping_tells_the_age_of_what_comes_after_it() -> None:
    freshness = Freshness()
    assert freshness.left_after(0) == freshness.left_after(1) == -math.inf
    freshness.ping_sent()
    freshness.ping_sent()
    assert freshness.left_after(0) == -math.inf
    freshness.ping_answered(1.0)
    assert freshness.left_after(0) == freshness.left_after(1) == 1.0
    freshness.ping_answered(2.0)
    assert freshness.left_after(0) == freshness.left_after(1) == 2.0


def test_a_new_session_has_nothing_from_before_its_connection() -> None:
    freshness = Freshness()
    freshness.session_began(5.0)
    assert freshness.left_after(0) == freshness.left_after(1) == 5.0


def test_a_full_window_hides_the_age_of_what_waits_behind_it() -> None:
    """After a silence of the network a broker sends what was in flight, and then what waited."""
    freshness = Freshness()
    freshness.session_began(0.0)
    freshness.ping_sent()
    for _ in range(LEAST_WINDOW):  # what the broker had in flight before it answered
        freshness.message_received()
    freshness.ping_answered(10.0)
    assert freshness.left_after(0) == 10.0
    assert freshness.left_after(1) == 0.0  # the next one may have waited there since then
    for _ in range(LEAST_WINDOW):
        freshness.message_acknowledged()
    freshness.ping_sent()
    for _ in range(LEAST_WINDOW - 1):
        freshness.message_received()
    freshness.ping_answered(11.0)
    assert freshness.left_after(1) == 11.0


def test_what_is_unacknowledged_here_may_fill_the_window_there() -> None:
    freshness = Freshness()
    freshness.session_began(0.0)
    for _ in range(LEAST_WINDOW):
        freshness.message_received()
    freshness.ping_sent()
    freshness.ping_answered(1.0)
    assert freshness.left_after(1) == 0.0
    freshness.message_acknowledged()
    freshness.ping_sent()
    freshness.ping_answered(2.0)
    assert freshness.left_after(1) == 2.0


class Server:
    """A fleet's broker with a window, behind a line that delays and stops: the naive truth."""

    def __init__(self, window: int) -> None:
        self.window = window
        self.in_flight = 0
        self.waiting: list[float] = []
        #: What is on its way to us, by when it was published; None is a PINGRESP.
        self.line: list[float | None] = []

    def publish(self, now: float) -> None:
        self.waiting.append(now)
        self._send()

    def _send(self) -> None:
        while self.waiting and self.in_flight < self.window:
            self.in_flight += 1
            self.line.append(self.waiting.pop(0))

    def acknowledged(self) -> None:
        self.in_flight -= 1
        self._send()


def test_no_message_is_older_than_it_is_taken_for() -> None:
    """Whatever a line and a broker with at least the least window do."""
    known = sum(_play(random.Random(seed)) for seed in range(150))
    assert known > 1000  # it does not just call everything old


def _play(random_: random.Random) -> int:
    """Returns of how many messages it was known that they are younger than two seconds."""
    server, freshness = Server(random_.randint(LEAST_WINDOW, 30)), Freshness()
    freshness.session_began(0.0)
    to_server: list[str] = []
    pings: list[float] = []
    unacknowledged, now, known = 0, 0.0, 0
    for _ in range(1500):
        now += random_.random() * 0.1
        what = random_.random()
        if what < 0.4:
            server.publish(now)
        elif what < 0.6 and to_server:
            count = random_.randint(1, 40)
            for packet in to_server[:count]:
                if packet == "ping":
                    server.line.append(None)
                else:
                    server.acknowledged()
            del to_server[:count]
        elif what < 0.8:
            count = random_.randint(1, 40)
            came, server.line = server.line[:count], server.line[count:]
            for published_at in came:
                if published_at is None:
                    freshness.ping_answered(pings.pop(0))
                    continue
                left_after = freshness.left_after(1)
                freshness.message_received()
                assert published_at >= left_after
                known += now - left_after < 2.0
                unacknowledged += 1
        elif what < 0.9:
            for _ in range(random_.randint(0, unacknowledged)):
                unacknowledged -= 1
                freshness.message_acknowledged()
                to_server.append("ack")
        else:
            freshness.ping_sent()
            pings.append(now)
            to_server.append("ping")
    return known
