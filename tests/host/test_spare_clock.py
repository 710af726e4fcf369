"""The processor time that a thread leaves to clients on the same computer."""

from __future__ import annotations

import threading
import time

import pytest

from appliance.host.clock import LEAST_SHARE, SWITCH_TIME, SpareClock


def grown(*, worked: float, waited: float, turns: int = 10, seconds: float = 10.0) -> float:
    """The part of so many seconds that is left, when the thread worked and waited such a part."""
    clock = SpareClock()
    steps = 1000
    step = seconds / steps
    first = clock.grow(1.0, 0.0, 0.0, 0)
    for number in range(1, steps + 1):
        passed = number * step
        grown = clock.grow(1.0 + passed, worked * passed, waited * passed, turns * number)
    return (grown - first) / seconds


def test_work_is_taken_off() -> None:
    assert grown(worked=0.3, waited=0) == pytest.approx(0.7)


def test_a_moment_until_a_turn_is_no_load() -> None:
    """As it is on a computer that has time: it is taken off, and nothing else."""
    waited = 10 * SWITCH_TIME / 0.01
    assert grown(worked=0.3, waited=waited) == pytest.approx(0.7 - waited)


@pytest.mark.parametrize("part", [0.05, 0.3])
def test_who_gets_half_of_what_it_needs_leaves_half_of_the_rest(part: float) -> None:
    measured = grown(worked=part, waited=part, turns=0)
    assert measured == pytest.approx((1 - 2 * part) / 2, abs=0.005)


def test_others_are_taken_to_have_a_least_share() -> None:
    measured = grown(worked=0.001, waited=0.5, turns=0)
    assert measured == pytest.approx(0.499 * LEAST_SHARE)


def test_load_is_forgotten() -> None:
    clock = SpareClock()
    clock.grow(1.0, 0, 0, 0)
    before = clock.grow(2.0, 0.1, 0.8, 1)
    clock.grow(4.0, 0.2, 0.8, 2)
    assert clock.grow(5.0, 0.2, 0.8, 2) - before > 3 - 0.11


@pytest.mark.parametrize("steps", [1, 10, 1000])
def test_load_is_forgotten_over_a_rest(steps: int) -> None:
    """Nothing new is seen then; what was seen before it says less and less."""
    clock = SpareClock()
    clock.grow(1.0, 0, 0, 0)
    before = clock.grow(1.01, 0.0001, 0.009, 1)
    for step in range(1, steps + 1):
        grown = clock.grow(1.01 + 10.0 * step / steps, 0.0001, 0.009, 1)
    assert grown - before > 9.0


def test_a_load_of_just_now_is_not_forgotten_at_once() -> None:
    clock = SpareClock()
    clock.grow(1.0, 0, 0, 0)
    before = clock.grow(1.1, 0.01, 0.09, 1)
    assert clock.grow(1.3, 0.01, 0.09, 1) - before < 0.2 * LEAST_SHARE + 0.01


def test_what_the_looks_do_not_show_at_once_is_taken_off_later() -> None:
    """The processor may be lost between the looks at the time and at what was worked until then."""
    clock = SpareClock()
    before = clock.grow(1.0, 0, 0, 0)
    for step in range(100):
        late = 0.1 * step
        clock.grow(1.0 + late, late + 0.1, 0, 0)
        grown = clock.grow(1.1 + late, late + 0.1, 0, 0)
    assert grown - before == pytest.approx(0)


def test_it_does_not_go_on_while_its_thread_works() -> None:
    """On a real computer, whatever else runs there, and whatever the system says of that."""
    measured: list[float] = []
    passed: list[float] = []

    def work() -> None:
        clock = SpareClock()
        clock()
        began, until = time.monotonic(), time.thread_time() + 0.1
        while time.thread_time() < until:
            measured.append(clock())
        passed.append(time.monotonic() - began)
        clock.close()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert measured == sorted(measured)
    assert measured[-1] - measured[0] < passed[0] - 0.05
