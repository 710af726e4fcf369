"""Answers across a link find the way back, and a token is good for nothing else."""

from __future__ import annotations

import re
import sys
from itertools import count

import pytest

from appliance.upstream.answers import (
    LIFETIME,
    MOST_BYTES,
    MOST_LEVELS,
    MOST_TOKENS,
    Answers,
    new_token,
    reply_filter,
    reply_topic,
)
from upstream.links import link


@pytest.fixture
def answers() -> Answers:
    numbers = count()
    return Answers(link(""), lambda: f"t{next(numbers)}")


def test_a_request_from_there_is_answered_there(answers: Answers) -> None:
    here = answers.for_request_in("fleet/r2/reset/_call", "answers/alice", 0.0)
    assert here == "r2/_upstream/fleet/t0"
    assert answers.for_answer_out(here, 1.0) == "answers/alice"
    assert answers.for_answer_out(here, 2.0) == "answers/alice"  # there may be several
    for other in ("r2/_upstream/fleet/t1", "r2/_upstream/other/t0", "r2/t0", "r2/_upstream/fleet/"):
        assert answers.for_answer_out(other, 1.0) is None
    # A token of one direction is none of the other.
    assert answers.for_answer_in("fleet/r2/_answers/t0", 1.0) is None


def test_an_answer_is_not_taken_for_a_message_of_the_robot() -> None:
    """Who may only call cannot make the robot say that it is online, or command it."""
    answers = Answers(link('out: [{topic: "events/#"}], in: [{topic: cmd_vel}]'))
    for topic in ("_appliance/state", "_answers/0", "events/alarm", "cmd_vel", "events/_reply/a"):
        assert answers.for_request_in("x", f"fleet/r2/{topic}", 0.0) is None, topic
    assert len(answers) == 0
    for topic in ("r2/other", "r3/events/x", "r3/arm/_reply/1"):
        assert answers.for_request_in("x", f"fleet/{topic}", 0.0), topic


def test_an_answer_is_not_taken_for_that_of_another_call() -> None:
    """Who may call one service cannot say what another one has answered to somebody else."""
    answers = Answers(link('out: [{topic: "#"}], in: [{topic: get/_call}, {topic: get/_call/+}]'))
    for call in ("fleet/r2/get/_call", "fleet/r2/get/_call/7"):
        for other in ("arm/_reply/42", "_reply/42", "get/_replying/1", "get/x/_reply/1"):
            assert answers.for_request_in(call, f"fleet/r2/{other}", 0.0) is None, other
        assert answers.for_request_in(call, "fleet/r2/get/_reply/alice/1", 0.0)
    # It is a call of none of the robot's services.
    assert answers.for_request_in("fleet/r2/get", "fleet/r2/get/_reply/1", 0.0) is None


@pytest.mark.parametrize("kind", ["_call", "_goal", "_cancel", "_param/_set", "_param/x/set"])
def test_an_answer_is_not_taken_for_that_of_a_call_below_a_prefix_of_its_own(kind: str) -> None:
    answers = Answers(
        link(
            'in: [{topic: reset/_call, remote_prefix: "vehicles/7/"},'
            f' {{topic: other/{kind}/+, remote_prefix: "vehicles/7/"}}]'
        )
    )
    there = kind.rpartition("/")[0]
    other = f"vehicles/7/other/{there and there + '/'}_reply/42"
    assert reply_topic(f"vehicles/7/other/{kind}/42") == other
    for call in ("vehicles/7/reset/_call", "fleet/r2/reset/_call"):
        assert answers.for_request_in(call, other, 0.0) is None
        assert answers.for_request_in(call, "vehicles/8/other/_reply/42", 0.0)
    assert answers.for_request_in("vehicles/7/reset/_call", "vehicles/7/reset/_reply/1", 0.0)
    deeper = other.replace("42", "alice/42")  # where a client of MQTT 5 may listen
    assert answers.for_request_in("fleet/r2/reset/_call", deeper, 0.0) is None
    assert answers.for_request_in(f"vehicles/7/other/{kind}/42", other, 0.0)


def test_rules_that_came_later_hold_for_answers_too() -> None:
    answers = Answers(link("in: [{topic: reset/_call}]"))
    here = [
        answers.for_request_in("fleet/r2/reset/_call", topic, 0.0)
        for topic in ("fleet/r2/state", "fleet/r2/reset/_reply/1", "answers/alice")
    ]
    assert all(here)
    answers.use(link('in: [{topic: reset/_call}], out: [{topic: "#"}]'))
    assert answers.for_request_in("fleet/r2/reset/_call", "fleet/r2/state", 0.0) is None
    there = [answers.for_answer_out(topic or "", 0.0) for topic in here]
    assert there == [None, "fleet/r2/reset/_reply/1", "answers/alice"]


def test_a_response_topic_of_slashes_costs_nothing(answers: Answers) -> None:
    deep = "/" * (MOST_LEVELS - 1)
    assert answers.for_request_in("x", deep, 0.0)
    for topic in (deep + "/", "/" * 60_000):
        assert answers.for_request_in("x", topic, 0.0) is None
        assert answers.for_request_out(topic, 0.0, "bob") is None


def test_a_request_from_here_is_answered_here(answers: Answers) -> None:
    there = answers.for_request_out("clients/bob/answers", 0.0, "bob")
    assert there == "fleet/r2/_answers/t0"
    assert answers.for_answer_in(there, 1.0) == "clients/bob/answers"
    for other in ("fleet/r2/_answers/t1", "fleet/r3/_answers/t0", "fleet/r2/_answers/t0/x"):
        assert answers.for_answer_in(other, 1.0) is None
    assert answers.for_answer_out("r2/_upstream/fleet/t0", 1.0) is None


def test_tokens_end(answers: Answers) -> None:
    here = answers.for_request_in("x", "answers/alice", 0.0)
    assert here is not None
    assert answers.for_answer_out(here, LIFETIME - 0.1) == "answers/alice"
    # Another request with the same Response Topic has the same token, which then holds for longer.
    assert answers.for_request_in("x", "answers/alice", 100.0) == here
    assert answers.for_request_in("x", "answers/bob", 101.0) != here
    assert answers.for_answer_out(here, LIFETIME + 99.9) == "answers/alice"
    assert len(answers) == 2
    assert answers.for_answer_out(here, LIFETIME + 100.0) is None
    assert len(answers) == 1
    assert answers.for_answer_out(here, LIFETIME + 500.0) is None
    assert len(answers) == 0
    assert answers.for_request_in("x", "answers/alice", 1000.0) != here


def test_the_oldest_tokens_end_when_there_are_too_many(answers: Answers) -> None:
    first = answers.for_request_in("x", "answers/0", 0.0)
    second = answers.for_request_in("x", "answers/1", 0.0)
    assert first and second
    for number in range(2, MOST_TOKENS):
        answers.for_request_in("x", f"answers/{number}", 1.0)
    answers.for_request_in("x", "answers/0", 2.0)  # it is the newest again
    assert len(answers) == MOST_TOKENS
    answers.for_request_in("x", "answers/another", 3.0)
    assert len(answers) == MOST_TOKENS
    assert answers.for_answer_out(first, 3.0) == "answers/0"
    assert answers.for_answer_out(second, 3.0) is None


def test_long_response_topics_do_not_fill_the_memory(answers: Answers) -> None:
    for end in ("x", "\U0001f916"):  # with a character of four bytes in it, each takes four
        topics = [f"{number:06}".ljust(60_000, "x") + end for number in range(300)]
        for topic in topics:
            last = answers.for_request_in("x", topic, 0.0)
        assert len(answers) == MOST_BYTES // sys.getsizeof(topics[0])
        assert last is not None and answers.for_answer_out(last, 0.0) is not None


@pytest.mark.parametrize("long", [False, True])
def test_requests_of_one_user_do_not_take_away_the_answers_of_others(
    answers: Answers, long: bool
) -> None:
    def ask(user: str, number: int) -> str:
        topic = f"{user}/{number}/" + ("x" * 60_000 if long and user == "mallory" else "")
        there = answers.for_request_out(topic, 0.0, user)
        assert there is not None
        return there

    def is_answered(there: str) -> bool:
        return answers.for_answer_in(there, 0.0) is not None

    of_alice = [ask("alice", number) for number in range(100)]
    first = ask("mallory", 0)
    for number in range(1, 200 if long else MOST_TOKENS + 200):
        last = ask("mallory", number)
    of_bob = [ask("bob", number) for number in range(100)]
    assert all(map(is_answered, [*of_alice, *of_bob]))
    assert is_answered(last) and not is_answered(first)
    assert len(answers) <= MOST_TOKENS
    for number in range(MOST_TOKENS):  # an equal share of three
        ask("bob", 100 + number)
    kept = sum(len(answers._going._owned[user].tokens) for user in ("alice", "mallory"))
    assert kept >= 100 + (130 if long else MOST_TOKENS // 3)


def test_who_asks_with_the_response_topic_of_another_does_not_own_it(answers: Answers) -> None:
    there = answers.for_request_out("answers", 0.0, "alice")
    assert there is not None
    for number in range(MOST_TOKENS + 10):
        answers.for_request_out("answers" if not number else f"m/{number}", 0.0, "mallory")
    assert answers.for_answer_in(there, 0.0) == "answers"


@pytest.mark.parametrize("topic", ["", "a/#", "+", "$SYS/x", "$CONTROL/a", "a\nb", "x" * 65_536])
def test_response_topics_that_nobody_may_use(answers: Answers, topic: str) -> None:
    assert answers.for_request_in("x/_call/7", topic, 0.0) is None
    assert answers.for_request_out(topic, 0.0, "bob") is None
    assert answers.for_call_out("fleet/r2/x/_call", topic, 0.0, "bob") is None
    assert len(answers) == 0


CALLS = [
    ("fleet/r2/reset/_call", "fleet/r2/reset/_reply"),
    ("fleet/r2/nav/_goal", "fleet/r2/nav/_reply"),
    ("fleet/r2/nav/_cancel", "fleet/r2/nav/_reply"),
    ("fleet/r2/arm/_param/speed/set", "fleet/r2/arm/_param/speed/_reply"),
    ("fleet/r2/arm/_param/_set", "fleet/r2/arm/_param/_reply"),
]


@pytest.mark.parametrize(("call", "reply"), CALLS)
def test_calls_of_3_1_1_have_a_token(answers: Answers, call: str, reply: str) -> None:
    """Both ways: what one appliance asks for, another answers."""
    called = answers.for_call_out(call, "clients/bob", 0.0, "bob")
    assert called == f"{call}/t0"
    other = Answers(link(""))
    here = other.for_request_in(called, None, 0.0)
    assert here is not None and here.startswith("r2/_upstream/fleet/")
    back = other.for_answer_out(here, 1.0)
    assert back == f"{reply}/t0"
    assert reply_filter(call) == f"{reply}/+"
    assert answers.for_answer_in(back, 1.0) == "clients/bob"
    assert answers.for_answer_in(f"{reply}/t1", 1.0) is None
    assert answers.for_answer_in(f"{reply}/x/t0", 1.0) is None


@pytest.mark.parametrize(
    "topic",
    [
        "fleet/r2/cmd_vel",
        "fleet/r2/reset/_call",  # without a token: nobody to answer
        "fleet/r2/reset/_call/",
        "_call/7",
        "fleet/r2/set/7",
        "fleet/r2/arm/_param/speed/7",
        "fleet/r2/_set/7",
        "",
        "/",
    ],
)
def test_what_is_no_call_of_3_1_1(answers: Answers, topic: str) -> None:
    assert reply_topic(topic) is None
    assert answers.for_request_in(topic, None, 0.0) is None
    assert answers.for_call_out(topic.rpartition("/")[0] + "x", "clients/bob", 0.0, "bob") is None


def test_a_topic_of_many_levels_is_cheap_to_look_at() -> None:
    """Of a stranger: `_param/_param/…` must not cost more than its length."""
    assert reply_topic("_param/" * 9000 + "x") is None
    assert reply_topic("_param/" * 9000 + "set/x") is not None
    assert reply_filter("a/#") is None


def test_tokens_cannot_be_guessed() -> None:
    tokens = {new_token() for _ in range(1000)}
    assert len(tokens) == 1000
    assert all(re.fullmatch("[0-9a-f]{32}", token) for token in tokens)
