"""What a thread leaves of the processor to the clients of the same computer."""

from __future__ import annotations

import threading
import time

import pytest

from appliance.clock import LEAST_SHARE, TURN_TAKES, WorkClock


def grown(*, worked: float, waited: float, turns: int = 10, seconds: float = 10.0) -> float:
    """The part of so many seconds that counts, when the thread worked and waited such a part."""
    clock = WorkClock()
    steps = 1000
    step = seconds / steps
    first = clock.grow(1.0, 0.0, 0.0, 0)
    for number in range(1, steps + 1):
        passed = number * step
        grown = clock.grow(1.0 + passed, worked * passed, waited * passed, turns * number)
    return (grown - first) / seconds


def test_work_counts() -> None:
    assert grown(worked=0.3, waited=0) == pytest.approx(0.3)


def test_a_moment_until_a_turn_is_no_load() -> None:
    """As it is on a computer that has time: it counts as such, and nothing else."""
    waited = 10 * TURN_TAKES / 0.01
    assert grown(worked=0.3, waited=waited) == pytest.approx(0.3 + waited)


@pytest.mark.parametrize("part", [0.05, 0.3])
def test_who_gets_half_of_what_it_needs_leaves_half_of_the_rest(part: float) -> None:
    measured = grown(worked=part, waited=part, turns=0)
    assert measured == pytest.approx(2 * part + (1 - 2 * part) / 2, abs=0.005)


def test_others_are_taken_to_have_a_least_share() -> None:
    measured = grown(worked=0.001, waited=0.5, turns=0)
    assert measured == pytest.approx(0.501 + 0.499 * (1 - LEAST_SHARE))


def test_load_is_forgotten() -> None:
    clock = WorkClock()
    clock.grow(1.0, 0, 0, 0)
    before = clock.grow(2.0, 0.1, 0.8, 1)
    clock.grow(4.0, 0.2, 0.8, 2)
    assert clock.grow(5.0, 0.2, 0.8, 2) - before < 0.11


@pytest.mark.parametrize("steps", [1, 10, 1000])
def test_load_is_forgotten_over_a_rest(steps: int) -> None:
    """Nothing new is seen then; what was seen before it says less and less."""
    clock = WorkClock()
    clock.grow(1.0, 0, 0, 0)
    before = clock.grow(1.01, 0.0001, 0.009, 1)
    for step in range(1, steps + 1):
        grown = clock.grow(1.01 + 10.0 * step / steps, 0.0001, 0.009, 1)
    assert grown - before < 1.0


def test_a_load_of_just_now_is_not_forgotten_at_once() -> None:
    clock = WorkClock()
    clock.grow(1.0, 0, 0, 0)
    before = clock.grow(1.1, 0.01, 0.09, 1)
    assert clock.grow(1.3, 0.01, 0.09, 1) - before > 0.2 * (1 - LEAST_SHARE) - 0.01


def test_it_grows_with_the_work_of_its_thread() -> None:
    """On a real computer, whatever else runs there, and whatever the system says of that."""
    measured: list[float] = []

    def work() -> None:
        clock = WorkClock()
        clock()
        until = time.thread_time() + 0.1
        while time.thread_time() < until:
            measured.append(clock())
        clock.close()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert measured == sorted(measured)
    assert measured[-1] - measured[0] > 0.05
