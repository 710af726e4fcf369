"""The checkers find what they are for, and accept what is right."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from upstream.account import (
    Command,
    Receipt,
    State,
    answers,
    growth,
    inventions,
    lateness,
    latest_only,
    loss,
    newest_kept,
    order,
    repeated,
    repetition,
    spans,
    truth,
)

MIB = 1 << 20


def test_spans() -> None:
    assert spans([]) == ""
    assert spans([5, 3, 4, 9, 9]) == "3-5, 9"
    assert spans(range(1, 100, 2)).endswith("19 and 40 more")


def test_loss_is_what_was_acknowledged_and_did_not_come() -> None:
    assert not loss("s", {1, 2}, [2, 1, 3])
    assert loss("s", {1, 2, 3, 7}, [2]) == ["s: LOST 3 of 4: 1, 3, 7"]


def test_what_was_never_sent() -> None:
    assert not inventions("s", 3, [1, 3])
    assert inventions("s", 3, [0, 3, 4]) == ["s: 2 came that were never sent: 0, 4"]


def test_order_with_runs_that_are_sent_again() -> None:
    assert not order("s", [1, 2, 3, 5, 8], 0)
    assert not order("s", [1, 2, 3, 2, 3, 4, 3, 4, 5], 2)
    assert order("s", [1, 2, 3, 2, 3, 4], 0) == ["s: goes back 1 times, 0 reconnects: 3 → 2"]
    assert "4 for the first time after 5" in order("s", [1, 2, 3, 5, 4], 1)[0]
    assert order("s", [1, 1], 0), "the same one twice goes back"
    shuffled = order("s", list(range(100, 0, -1)), 100)
    assert len(shuffled) == 11 and shuffled[-1] == "s: 89 more out of order"


@given(st.integers(0, 2**32), st.integers(0, 8))
def test_order_accepts_what_a_link_with_a_window_does(seed: int, reconnects: int) -> None:
    """A model: in order, and from the oldest that was not settled on after each reconnect."""
    dice = random.Random(seed)
    received: list[int] = []
    settled = 0
    for _ in range(reconnects + 1):
        upto = settled + dice.randrange(10)
        received += range(settled + 1, upto + 1)
        settled = dice.randint(settled, upto)
    assert not order("s", received, reconnects)
    assert repeated(received) == len(received) - len(set(received))
    if len(set(received)) > 2:
        broken = sorted(set(received))
        broken[0], broken[1] = broken[1], broken[0]
        assert order("s", broken, 100)


def receipts(*pairs: tuple[float, int]) -> list[Receipt]:
    return [Receipt(time, number) for time, number in pairs]


def test_repetition_within_the_bound() -> None:
    steady = receipts(*((number / 10, number) for number in range(1, 101)))  # 10 a second
    again = receipts(*((11 + number / 100, number) for number in range(91, 101)))
    assert not repetition("s", steady + again, [10.5], window=0, linger=1.5)
    assert not repetition("s", steady + again, [10.5], window=10, linger=0)
    wrong = repetition("s", steady + again, [10.5], window=3, linger=0.8)
    assert wrong == [
        "s: 6 REPEATED that were acknowledged more than 0.8 s before the end,"
        " and not among the last 3: 91-96"
    ]
    assert "without an interruption: 91-100" in repetition("s", steady + again, [20], 100, 9)[0]
    assert not repetition("s", steady, [], 0, 0)


def test_repetition_a_second_time_counts_from_the_last_time() -> None:
    twice = receipts((1, 1), (2, 2), (11, 1), (12, 2), (21, 1))
    assert not repetition("s", twice, [2.5, 12.5], window=2, linger=0)
    assert repetition("s", twice, [2.5, 12.5], window=1, linger=1)


def test_newest_kept() -> None:
    assert not newest_kept("s", 10, range(6, 11), 5)
    assert not newest_kept("s", 10, range(1, 11), 0)
    assert not newest_kept("s", 10, [8, 9, 10, 10], None)
    assert newest_kept("s", 10, [6, 7, 9, 10], 6) == [
        "s: 1 are missing behind the oldest kept (6): 8"
    ]
    assert newest_kept("s", 10, range(1, 8), 3) == [
        "s: 3 are missing behind the oldest kept (1): 8-10"
    ]
    assert newest_kept("s", 10, range(6, 11), 4) == [
        "s: 5 kept + 4 dropped = 9, and 10 were published"
    ]
    assert newest_kept("s", 10, [], 10) == ["s: NOTHING of 10 was kept"]
    assert newest_kept("s", 0, [], 0) == []
    assert newest_kept("s", 10, [11], 9)


def test_latest_only() -> None:
    published = {"a": [b"1", b"2"], "b": [b"1", b""], "c": []}
    assert not latest_only(published, {"a": [b"2"], "b": [b""]})
    assert "a: 2 came" in latest_only(published, {"a": [b"1", b"2"], "b": [b""]})[0]
    assert "b: 0 came" in latest_only(published, {"a": [b"2"]})[0]
    assert "b: 1 came, the last b'1'" in latest_only(published, {"a": [b"2"], "b": [b"1"]})[0]
    assert latest_only({}, {"x": [b"1"]}) == ["x came, and was not published"]


def test_lateness() -> None:
    fresh = [Command(1, 0.0, 0.4), Command(2, 1.0, 1.55)]
    assert not lateness(fresh, 0.5, 0.1)
    (problem,) = lateness([*fresh, Command(3, 2.0, 9.0)], 0.5, 0.1)
    assert problem == "1 LATE commands: 3; 3 was 7.000 s old, and 0.5 s is the limit"


def test_answers() -> None:
    calls = {"1": "answers/a", "2": "answers/b"}
    topics = {"answers/a", "answers/b"}
    right = [("answers/a", "1"), ("answers/b", "2")]
    assert not answers(calls, right, topics)
    assert "1 of 2 calls UNANSWERED: ['2']" in answers(calls, right[:1], topics)[0]
    assert "more than once: ['1']" in answers(calls, [*right, right[0]], topics)[0]
    assert "not at answers/b" in answers(calls, [right[0], ("answers/a", "2")], topics)[0]
    assert "to nothing" in answers(calls, [*right, ("answers/a", "3")], topics)[0]
    assert "nobody waits" in answers({"1": "x"}, [("x", "1")], topics)[0]


def test_growth() -> None:
    flat = [(float(second), 50 * MIB + second % 3 * MIB) for second in range(100)]
    assert not growth(flat, 5 * MIB)
    assert not growth([*flat[:50], (50.0, 500 * MIB), *flat[50:]], 5 * MIB), "a single peak"
    rising = [(float(second), (50 + second) * MIB) for second in range(100)]
    assert growth(rising, 64 * MIB) == ["memory GREW from 55.0 to 145.0 MiB; 64 allowed"]
    assert not growth([], 1)


def test_truth() -> None:
    states = [State(0, "online"), State(12, "offline"), State(21, "online")]
    spans_ = [(0.0, 10.0, True), (10.0, 20.0, False), (20.0, 30.0, True)]
    assert not truth(states, spans_, 3)
    assert "is dead the fleet's broker says online" in truth(states, spans_, 1.5)[0]
    flapping = [*states, State(25, "offline"), State(26, "online")]
    assert "works the fleet's broker says offline" in truth(flapping, spans_, 3)[0]
    assert not truth(states, [(10.0, 11.0, False)], 3), "a span that is too short says nothing"
    assert "says nothing" in truth([], spans_, 3)[0]
