"""Which topic filter ends the connection of a link is found, and left out."""

from __future__ import annotations

from appliance.upstream.unanswered import LEFT_OUT_FOR, UnansweredFilters


def test_the_filter_that_ends_the_connection_is_found_and_left_out_for_an_hour():
    unanswered = UnansweredFilters()
    filters = ["a", "bad", "c", "worse"]
    ends = 0
    while True:
        left = [each for each in filters if each not in unanswered.left_out(0)]
        rounds = [[each] for each in left] if unanswered.one_by_one else [left]
        asked = next((each for each in rounds if {"bad", "worse"} & set(each)), None)
        if asked is None:
            break
        ends += 1
        unanswered.closed(asked, 0)
    unanswered.answered()
    assert unanswered.left_out(LEFT_OUT_FOR - 1) == ["bad", "worse"] and ends == 10
    assert not unanswered.one_by_one
    assert unanswered.left_out(LEFT_OUT_FOR) == []


def test_ends_with_an_answer_between_are_of_another_reason():
    unanswered = UnansweredFilters()
    for _ in range(3):
        assert unanswered.closed(["a"], 0) is None and unanswered.closed(["a"], 0) is None
        assert unanswered.one_by_one
        unanswered.answered()
    assert not unanswered.one_by_one and unanswered.left_out(0) == []
